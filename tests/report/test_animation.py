"""Moving pictures: as many frames as the motion lasts, and what is wrong with a wrong call."""

import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from recorded import Plant, as_set, record

from rrr_oc import cli
from rrr_oc.codesign.task import load_task
from rrr_oc.commands.moving.sources import designed
from rrr_oc.recordings.writer import save_recordings
from rrr_oc.report.moving.rendering import NoRenderer
from rrr_oc.report.moving.scene import TENSION, Scene, ShownSpring, shapes, spring_shapes, tension_colour


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A recording set of half a second, and the npz of a design that stands still and swings one joint."""
    folder, plant = tmp_path_factory.mktemp("animation"), Plant("rrr", np.ones(3), np.ones(3), np.ones(3))
    recordings = as_set(plant, [record(plant, f"{k}.csv", np.random.default_rng(k), 0.5) for k in range(2)])
    save_recordings(replace(recordings), folder / "set")
    t = np.linspace(0.0, 0.4, 21)
    q = np.array([0.5 + t, 0 * t - 1.0])
    rates = {"dq": 0 * q, "ddq": 0 * q, "twist": np.zeros((3, *q.shape)), "phase": (np.arange(21) > 10).astype(int)}
    np.savez(folder / "PEA.npz", t=t, q=q, tau_load=q, tau_spring=0 * q, payload=np.full(21, 5.0), **rates)
    return folder


def run(monkeypatch, *arguments) -> int:
    monkeypatch.setattr(sys, "argv", ["rrr-oc", "animate", *map(str, arguments)])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    return int(ended.value.code or 0)


@pytest.mark.parametrize(
    ("source", "options", "seconds"), [("PEA.npz", ["--task", "paper"], 0.4), ("set", ["--recording", "1.csv"], 0.49)]
)
def test_a_picture_lasts_as_long_as_the_motion(folder, monkeypatch, tmp_path, source, options, seconds):
    assert run(monkeypatch, folder / source, *options, "--out", tmp_path / "a.gif", "--quiet") == 0
    with Image.open(tmp_path / "a.gif") as picture:
        frames = [picture.seek(k) or np.asarray(picture.convert("L"), float) for k in range(picture.n_frames)]
    assert len(frames) == int(seconds * 20 + 1e-9) + 1
    assert np.abs(frames[-1] - frames[0]).max() > 50  # it moves


def test_lines_where_there_is_no_renderer_and_it_is_said(folder, monkeypatch, tmp_path, capsys):
    def missing(scene, at):
        raise NoRenderer("no screen")
        yield

    monkeypatch.setattr("rrr_oc.report.moving.animation.rendered", missing)
    assert run(monkeypatch, folder / "PEA.npz", "--task", "paper", "--out", tmp_path / "a.gif") == 0
    said = capsys.readouterr()
    assert "MuJoCo's renderer does not work here (no screen)" in said.err
    assert "drawn by matplotlib" in said.out
    assert run(monkeypatch, folder / "PEA.npz", "--task", "paper", "--out", tmp_path / "b.gif", "--renderer", "matplotlib") == 0
    assert "does not work" not in capsys.readouterr().err
    assert (tmp_path / "a.gif").read_bytes() == (tmp_path / "b.gif").read_bytes()


def test_mp4_has_a_frame_for_each_of_gif(folder, monkeypatch, tmp_path):
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    assert run(monkeypatch, folder / "PEA.npz", "--task", "paper", "--out", tmp_path / "a.mp4", "--renderer", "matplotlib") == 0
    assert ffmpeg.count_frames_and_secs(str(tmp_path / "a.mp4"))[0] == 9


def test_payload_and_springs_are_seen_when_they_are_there():
    task, t = load_task("paper"), np.array([0.0, 1.0])
    q = np.array([[0.3, 0.3], [0.5, 1.0], [-1.0, 0.2]])
    springs = ShownSpring((1,), np.array([0.0, 4.0])), ShownSpring((1, 2), np.array([2.0, 2.0]))
    scene = Scene(task.robot, task.tool, t, q, {}, (), np.array([5.0, 0.0]), "", springs)
    points, held, free = scene.points(np.arange(2)), shapes(scene, 0), shapes(scene, 1)
    balls = [np.flatnonzero(np.all(s.ends[:, 0] == s.ends[:, 1], axis=1)) for s in (held, free)]
    assert [len(b) for b in balls] == [1, 0]
    np.testing.assert_allclose(held.ends[balls[0][0], 0], points[0, -1], atol=1e-12)
    np.testing.assert_allclose(tension_colour(0), TENSION[0])
    np.testing.assert_allclose(tension_colour(1), TENSION[-1])
    slack, taut = (spring_shapes(scene, springs[0], k) for k in range(2))
    assert not np.allclose(slack.colour, taut.colour)
    across = spring_shapes(scene, springs[1], 0).ends
    axis = across[0, 0] - points[0, 2]  # beside the joint, as far as the other end is beside its own
    np.testing.assert_allclose(across[-1, 1] - points[0, 3], axis, atol=1e-9)
    assert 0 < np.linalg.norm(axis) < 0.2


def test_springs_of_a_design_are_those_of_its_study(tmp_path, folder):
    """Torques of springs from summary.json against Eq. 3, by hand."""
    label = ("parallel_spring[joint2]", "parallel_spring[joint3]")
    numbers = {"stiffness": 13.0, "equilibrium": 1.9}
    entry = {"mounted": {x: {"active": "below"} for x in label}, "parameters": dict.fromkeys(label, numbers)}
    (tmp_path / "summary.json").write_text(json.dumps({"configurations": {"PEA": entry}}))
    shutil.copyfile(folder / "PEA.npz", tmp_path / "PEA.npz")
    scene = designed(tmp_path / "PEA.npz", "paper")
    assert [spring.joints for spring in scene.springs] == [(1,), (2,)]
    for spring in scene.springs:
        np.testing.assert_allclose(spring.tension, 13.0 * np.maximum(1.9 - scene.q[spring.joints[0]], 0), rtol=1e-12)


def test_the_arm_is_drawn_where_kinematics_has_it():
    """The paper's arm stretched along x, links of 0.3 m from a shoulder 0.3 m high, by hand."""
    task = load_task("paper")
    t = np.array([0.0, 1.0])
    scene = Scene(task.robot, task.tool, t, np.zeros((3, 2)), {}, (), 0 * t, "")
    points = scene.points(np.array([0]))[0]
    np.testing.assert_allclose(points[0], 0.0, atol=1e-12)
    lengths = np.linalg.norm(np.diff(points[-3:], axis=0), axis=1)
    np.testing.assert_allclose(lengths, [np.linalg.norm(task.robot.placements[2][:3, 3]), 0.3], atol=1e-12)


MISTAKES = {
    "no task": (["PEA.npz", "--out", "a.gif"], "--task is missing"),
    "other arm": (["PEA.npz", "--task", "{task}", "--out", "a.gif"], "no task at"),
    "no npz": (["set/0.csv", "--task", "paper", "--out", "a.gif"], "no readable npz file"),
    "no recording": (["set", "--recording", "2.csv", "--out", "a.gif"], "there are 0.csv, 1.csv"),
    "no picture": (["set", "--out", "a.avi"], "allowed are names that end in .gif or .mp4"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_one_sentence_and_leaves_no_file(folder, monkeypatch, tmp_path, capsys, mistake):
    (source, *options), said = MISTAKES[mistake]
    options = [tmp_path / o if o.startswith("a.") else o for o in options]
    assert run(monkeypatch, folder / source, *options, "--quiet") == 2
    assert said in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
