"""A design's motion for controllers: numbers against the motion in closed form, and texts read again."""

import json
import re
import sys

import numpy as np
import pytest

from rrr_oc import cli
from rrr_oc.codesign.task import load_task
from rrr_oc.codesign.trajectory import FORMATS, Trajectory, as_csv, as_ros2, as_urscript, sampled, saved_motion
from rrr_oc.errors import UserError
from rrr_oc.storage import write_npz

TASK = load_task("paper")
GO, BACK = 1.2345, 2.0  # [s]
PLACES = np.array([1.0, -2.0])[:, None]


def motion(t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """q, dq, ddq (2, K) of the moving joints: sines about `PLACES`, with accelerations that the phases have in common."""
    w = np.array([2.0, 3.0])[:, None]
    return PLACES + 0.3 * np.sin(w * t), 0.3 * w * np.cos(w * t), -0.3 * w**2 * np.sin(w * t)


@pytest.fixture
def saved(tmp_path):
    """An npz as a design has it, with the release sampled twice, and a gear that gives at its second joint."""
    t = np.concatenate([np.linspace(0, GO, 400), GO + np.linspace(0, BACK, 500)])
    q, dq, ddq = motion(t)
    twist = np.zeros((3, *q.shape))
    twist[0, 1] = 0.01
    phase = np.repeat([0, 1], [400, 500])
    tau = np.where(phase == 0, 3.0, -2.0) * np.ones((2, 1))
    arrays = {"t": t, "q": q, "dq": dq, "ddq": ddq, "tau_load": tau, "tau_spring": 0 * tau, "phase": phase}
    write_npz(tmp_path / "PEA.npz", arrays | {"payload": np.where(phase == 0, 5.0, 0.0), "twist": twist})
    return tmp_path / "PEA.npz"


@pytest.mark.parametrize("rate", [50.0, 125.0, 1000.0])
def test_the_points_lie_on_the_motion_at_equal_steps_and_at_its_end(rate, saved):
    found = sampled(saved_motion(saved, TASK), TASK, rate)
    steps = np.diff(found.t)
    np.testing.assert_allclose(steps[:-1], 1 / rate, rtol=1e-9)
    assert found.t[0] == 0.0
    assert found.t[-1] == GO + BACK
    assert 1e-3 / rate < steps[-1] < (1 + 1e-3) / rate + 1e-12
    q, dq, ddq = motion(found.t)
    # cubics between samples 4 ms apart: (3 rad/s · 4 ms)⁴ / 384 of 0.3 rad; accelerations by straight lines: (12e-3)² / 8 of 2.7 rad/s²
    np.testing.assert_allclose(found.q[1:], q - [[0.0], [0.01]], atol=1e-9)
    np.testing.assert_allclose(found.dq[1:], dq, atol=1e-8)
    np.testing.assert_allclose(found.ddq[1:], ddq, atol=1e-4)
    np.testing.assert_array_equal(found.q[0], TASK.full(q)[0])
    np.testing.assert_array_equal(found.torque[1], np.where(found.t < GO, 3.0, -2.0))  # no step between the phases is smeared
    np.testing.assert_array_equal(found.payload, np.where(found.t < GO, 5.0, 0.0))


def test_csv_is_read_again(saved):
    found = sampled(saved_motion(saved, TASK), TASK, 100.0)
    header, *rows = as_csv(found).splitlines()
    assert header.split(",")[:4] == ["t", "q_joint1", "q_joint2", "q_joint3"]
    numbers = np.array([row.split(",") for row in rows], float)
    np.testing.assert_array_equal(numbers[:, 2], found.q[1])
    np.testing.assert_array_equal(numbers[:, header.split(",").index("tau_joint3")], found.torque[2])


def test_ros_reads_the_yaml_as_its_message(saved):
    yaml = pytest.importorskip("yaml")
    found = sampled(saved_motion(saved, TASK), TASK, 100.0)
    message = yaml.safe_load(as_ros2(found))
    assert list(message) == ["header", "joint_names", "points"]
    assert message["joint_names"] == ["joint1", "joint2", "joint3"]
    times = [p["time_from_start"]["sec"] + 1e-9 * p["time_from_start"]["nanosec"] for p in message["points"]]
    assert np.all(np.diff(times) > 0)
    np.testing.assert_allclose(times, found.t, atol=1e-9)
    for k in (0, 7, -1):
        point = message["points"][k]
        assert set(point) == {"positions", "velocities", "accelerations", "effort", "time_from_start"}
        np.testing.assert_array_equal(point["velocities"], found.dq[:, k])


def of_six(rate: float) -> Trajectory:
    t = np.append(np.arange(20) / rate, 19.5 / rate)
    rows = np.sin(np.arange(6)[:, None] + t)
    return Trajectory(t, rows, rows, rows, 0 * t, joints=tuple(f"j{k}" for k in range(6)), torque=rows)


def test_the_script_goes_to_the_start_and_then_point_by_point():
    found = of_six(125.0)
    first, *moves = re.findall(r"^  (\w+)\(\[(.*?)\](?:, t=([\d.e-]+))?", as_urscript(found), re.M)
    assert first[0] == "movej"
    assert {kind for kind, _, _ in moves} == {"servoj"}
    points = np.array([row.split(",") for _, row, _ in (first, *moves)], float)
    np.testing.assert_allclose(points, found.q.T, atol=1e-8)
    np.testing.assert_allclose([float(h) for _, _, h in moves], np.diff(found.t))


def test_a_robot_that_urscript_does_not_move_is_refused(saved):
    with pytest.raises(UserError, match="the robot has 3 joints; URScript moves robots of 6"):
        as_urscript(sampled(saved_motion(saved, TASK), TASK, 100.0))
    with pytest.raises(UserError, match="--rate is 1000 Hz; up to 500 Hz is allowed"):
        as_urscript(of_six(1000.0))


@pytest.mark.parametrize("rate", [0.0, -1.0, np.inf, np.nan, 1e9])
def test_a_rate_that_cannot_be_is_refused(rate, saved):
    with pytest.raises(UserError, match="--rate is"):
        sampled(saved_motion(saved, TASK), TASK, rate)


def run(monkeypatch, capsys, *arguments) -> tuple[int, str, str]:
    monkeypatch.setattr(sys, "argv", ["rrr-oc", "export", *map(str, arguments)])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    return int(ended.value.code or 0), *capsys.readouterr()


def test_the_command_writes_the_motion_of_a_design(saved, monkeypatch, capsys, tmp_path):
    springs = {f"parallel_spring[joint{k}]": {"stiffness": 1.0, "equilibrium": 1.0} for k in (2, 3)}
    entry = {"mounted": {name: {"active": "below"} for name in springs}, "parameters": springs, "cost": 1.0}
    (tmp_path / "summary.json").write_text(json.dumps({"preset": "paper", "configurations": {"PEA": entry}}))
    design = [
        "--design",
        tmp_path / "summary.json",
        "--configuration",
        "PEA",
        "--task",
        "paper",
        "--json",
        "--out",
        tmp_path / "e",
    ]
    status, printed, _ = run(monkeypatch, capsys, *design, "--trajectory", "csv, ros2", "--rate", "100")
    assert status == 0
    assert json.loads(printed)["trajectory"] == [str(tmp_path / "e" / f"trajectory.{kind}") for kind in ("csv", "yaml")]
    assert (
        len((tmp_path / "e" / "trajectory.csv").read_text().splitlines())
        == len(sampled(saved_motion(saved, TASK), TASK, 100.0).t) + 1
    )
    for given, said in (
        ([*design, "--trajectory", "gcode"], f"unknown format 'gcode'; allowed are {', '.join(FORMATS)}"),
        (["--trajectory", "csv", "--out", tmp_path / "f"], "nothing to export"),
        ([*design, "--trajectory", "urscript"], "URScript moves robots of 6"),
    ):
        status, _, error = run(monkeypatch, capsys, *given)
        assert status == 2
        assert said in error
    saved.unlink()
    status, _, error = run(monkeypatch, capsys, *design, "--trajectory", "csv")
    assert status == 2
    assert "PEA.npz" in error
