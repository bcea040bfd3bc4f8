"""`rrr-oc view`: without a browser, what is served, where the arm is at a time, and how the command ends."""

import signal
import subprocess
import sys
import urllib.request
from dataclasses import replace

import numpy as np
import pytest
from commands import heeds_ctrl_c
from recorded import Plant, as_set, record

from rrr_oc import cli
from rrr_oc.calibration.calibrate import calibrate
from rrr_oc.calibration.model_file import save_model
from rrr_oc.codesign.task import load_task
from rrr_oc.recordings.writer import save_recordings
from rrr_oc.report.moving.scene import Scene, ShownSpring, tension_colour
from rrr_oc.report.moving.viewer import Shown, Viewer
from rrr_oc.robot.rigid_body import rigid_body

viser = pytest.importorskip("viser")
T = np.linspace(0.0, 1.0, 11)


def _scene(sign: float) -> Scene:
    task = load_task("paper")
    q = np.array([0 * T, 0.5 + sign * T, -1.0 + 0.5 * T])
    tension = ShownSpring((1,), 10 * T), ShownSpring((1, 2), 5 * T)
    return Scene(task.robot, task.tool, T, q, {"load torque": q[1:]}, task.joints, np.where(T < 0.5, 5.0, 0.0), "one", tension)


@pytest.fixture
def viewer():
    shown = {"up.csv": Shown(_scene(1.0), _scene(1.0).q + 0.1), "down.csv": Shown(_scene(-1.0))}
    viewer = Viewer(list(shown), shown.__getitem__, 8571)
    yield viewer
    viewer.stop()


def _at(viewer, frames, q):
    """Whether the frames stand where forward kinematics has the joints at positions q (n,)."""
    placed = np.array(rigid_body(viewer.shown.scene.robot).joint_frames(q)).reshape(12, -1)
    for i, frame in enumerate(frames[1:]):
        np.testing.assert_allclose(frame.position, placed[9:, i], atol=1e-6)
        rotation = viser.transforms.SO3(np.asarray(frame.wxyz)).as_matrix()
        np.testing.assert_allclose(rotation, placed[:9, i].reshape(3, 3, order="F"), atol=1e-6)


def test_the_slider_moves_the_arm_and_its_twin(viewer):
    for k in (0, 4, 10):
        viewer.time.value = T[k]
        viewer.show()
        _at(viewer, viewer.arm, _scene(1.0).q[:, k])
        _at(viewer, viewer.twin, _scene(1.0).q[:, k] + 0.1)
        assert viewer.payload.visible == (T[k] < 0.5)
    lines = viewer._moving
    np.testing.assert_array_equal(lines[0].colors[0, 0], np.round(255 * tension_colour(1.0)))
    np.testing.assert_array_equal(lines[1].colors[0, 0], np.round(255 * tension_colour(0.5)))
    assert "joint2 | 1.50" in viewer.readout.content
    assert np.nanmax(viewer.plot.data[-1]) == pytest.approx(1.5)
    assert np.isfinite(viewer.plot.data[-1]).sum() == 1


def test_another_recording_can_be_chosen_and_it_plays_in_time(viewer):
    viewer.choice.value = "down.csv"
    viewer._choose()
    assert not viewer.twin[0].visible
    viewer.go_on(0.3)
    assert viewer.time.value == 0.0  # it does not play yet
    viewer._toggle()
    viewer.go_on(0.3)
    assert viewer.time.value == pytest.approx(0.3)
    _at(viewer, viewer.arm, _scene(-1.0).q[:, 3])
    viewer.go_on(5.0)
    assert viewer.time.value == pytest.approx(1.0)
    viewer.go_on(0.1)
    assert viewer.time.value == 0.0


def test_a_page_is_served_until_ctrl_c(tmp_path):
    """Recordings beside the model's simulation, in a process of its own."""
    plant = Plant("rrr", np.ones(3), np.ones(3), np.ones(3))
    recordings = as_set(plant, [record(plant, "a.csv", np.random.default_rng(0), 1.0)])
    save_recordings(replace(recordings), tmp_path / "set")
    save_model(calibrate(recordings), tmp_path / "model.json")
    command = [sys.executable, "-m", "rrr_oc", "view", str(tmp_path / "set"), "--model", str(tmp_path / "model.json")]
    command, pipe = [*command, "--port", "8591", "--no-browser"], subprocess.PIPE
    process = subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True, preexec_fn=heeds_ctrl_c)
    assert process.stdout is not None
    line = process.stdout.readline()
    try:
        assert "http://localhost:" in line, process.communicate(timeout=60)
        with urllib.request.urlopen(line.split()[0]) as page:
            assert b"<html" in page.read(2000).lower()
    finally:
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=60)
    assert process.returncode == 0, err
    assert out.strip() == "The viewer has ended."
    assert "Traceback" not in err


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["paper", "--model", "m.json"], "--model goes with a folder"),
        (["nothing.json"], "nothing.json"),
        (["paper"], "pip install viser brings it"),
    ],
)
def test_a_mistake_is_one_sentence(monkeypatch, capsys, arguments, said):
    monkeypatch.setitem(sys.modules, "viser", None)
    monkeypatch.setattr(sys, "argv", ["rrr-oc", "view", *arguments])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == 2
    assert said in capsys.readouterr().err
