"""Commands that simulate and plan motions: what they write, against closed forms and independent dynamics; and their mistakes."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from chains import arm
from commands import rrr_oc as run
from recorded import Plant, as_set, record

from rrr_oc.calibration.calibrate import calibrate
from rrr_oc.calibration.model_file import save_model
from rrr_oc.commands import COMMANDS, load
from rrr_oc.commands.output import Output
from rrr_oc.effects import CATALOGUE
from rrr_oc.excitation.information import information, model_sensitivity
from rrr_oc.excitation.limits import Rig, robot_limits
from rrr_oc.model.motion import Motion
from rrr_oc.model.symbolic_model import Model
from rrr_oc.recordings.writer import save_recordings
from rrr_oc.robot.robot import load_robot

TRUTH = np.array([[5.2, 7.1, 3.3], [14.0, 21.0, 9.0], [0.31, 0.22, 0.12]])
QUICK = ["--starts", "1", "--harmonics", "4", "--duration", "8"]


def test_all_that_is_counted_has_an_upper_end():
    """Counts size arrays: one that is typed with zeros too many would take all memory. A seed counts nothing, and -1 processes are all."""
    options = [(name, p) for name in COMMANDS for p in getattr(load(name), "params", []) if hasattr(p, "type_descriptor")]
    counts = [(name, p) for name, p in options if p.type_descriptor.annotation is int and p.name not in ("seed", "jobs")]
    assert {"starts", "intervals", "motions", "front", "harmonics"} <= {p.name for _, p in counts}
    assert [(name, p.name) for name, p in counts if p.max is None] == []


def table(path: Path) -> dict[str, np.ndarray]:
    """The columns of a CSV file."""
    names = path.read_text().splitlines()[0].split(",")
    return dict(zip(names, np.loadtxt(path, delimiter=",", skiprows=1).T, strict=True))


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A recording set `set` and a model of it."""
    folder, plant, rng = tmp_path_factory.mktemp("commands"), Plant("rrr", *TRUTH), np.random.default_rng(0)
    recordings = as_set(plant, [record(plant, f"{i}.csv", rng, 6.0) for i in range(2)])
    save_recordings(recordings, folder / "set")
    model = replace(
        calibrate(recordings), robot=recordings.robot
    )  # the links of the plant, not what the recordings say of them
    save_model(model, folder / "model.json")
    for name in ("arm.urdf", "arm.xml"):  # models under names that commands write to
        (folder / name).write_text((folder / "model.json").read_text())
    return folder


def test_simulate_writes_a_motion_that_obeys_the_equations(folder, monkeypatch, tmp_path, capsys):
    """The motion stays by the recording, and its load torque is the rigid body's of Pinocchio on that motion."""
    assert run(monkeypatch, "simulate", folder / "model.json", folder / "set", "--out", tmp_path, "--json") == 0
    result = json.loads(capsys.readouterr().out)
    assert set(result) == {"simulated", "mean"}
    assert set(result["simulated"]["1.csv"]["joint3"]) == {"q", "dq", "ddq", "tau_motor", "tau_load"}
    assert result["mean"]["simulated"]["joint2"]["q"]["nrmse"] < 0.05
    assert sorted(p.name for p in tmp_path.iterdir()) == ["0.csv", "1.csv"]
    recorded, found = table(folder / "set" / "0.csv"), table(tmp_path / "0.csv")
    joints = ("joint1", "joint2", "joint3")
    np.testing.assert_array_equal(found["t"], recorded["t"])
    q, dq, ddq, load = (np.array([found[f"{s}_{j}"] for j in joints]) for s in ("q", "dq", "ddq", "tau_load"))
    assert (
        np.max(np.abs(q - np.array([recorded[f"q_{j}"] for j in joints]))) < 0.02
    )  # [rad], a few encoder-noise torques over the gain
    model = Plant("rrr", *TRUTH).model
    expected = np.array([pin.rnea(model, model.createData(), *x) for x in zip(q.T, dq.T, ddq.T, strict=True)]).T
    np.testing.assert_allclose(load, expected, atol=1e-6 * np.abs(expected).max())


def test_simulate_shows_a_table(folder, monkeypatch, tmp_path, capsys):
    assert run(monkeypatch, "simulate", folder / "model.json", folder / "set", "--out", tmp_path) == 0
    printed = capsys.readouterr()
    assert "mean NRMSE" in printed.out
    assert "tau_motor" in printed.out
    assert "tracking the recordings" in printed.err


def test_progress_without_a_terminal_is_lines_with_the_time_now_and_then(monkeypatch, capsys):
    """Of 100 steps of 1 s each, the first, every tenth or so and the last are told."""
    clock = iter(range(1000))
    monkeypatch.setattr("rrr_oc.commands.output.time.monotonic", lambda: float(next(clock)))
    with Output().count("PEA", 100) as count:
        for k in range(100):
            count(k + 1, "starts")
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "    1.0 s  PEA: 1 of 100 starts"
    assert lines[1] == "   11.0 s  PEA: 11 of 100 starts"
    assert lines[-1] == "  100.0 s  PEA: 100 of 100 starts"
    assert len(lines) == 11
    with Output(quiet=True).count("PEA", 2) as count, Output(quiet=True).steps("first") as step:
        count(2, "starts")
        step("second")
    assert capsys.readouterr().err == ""


def test_excite_keeps_to_all_limits(monkeypatch, tmp_path, capsys):
    """Read back from the file: range, speed, acceleration, torque with the nominal friction of 0, and the floor."""
    limits = ["--acceleration", 3, "--speed", 1.2, "--torque", 40, "--floor", 0.1, "--payload", 1]
    assert run(monkeypatch, "excite", "rrr", *QUICK, *limits, "--out", tmp_path / "m.csv", "--json") == 0
    result, found = json.loads(capsys.readouterr().out), table(tmp_path / "m.csv")
    robot = load_robot("rrr")
    q, dq, ddq = (np.array([found[f"{s}_{j}"] for j in robot.joints]) for s in ("q", "dq", "ddq"))
    assert np.all(q >= robot.lower[:, None] - 1e-9)
    assert np.all(q <= robot.upper[:, None] + 1e-9)
    assert np.abs(dq).max() <= 1.2
    assert np.abs(ddq).max() <= 3
    np.testing.assert_allclose(np.gradient(q, found["t"], axis=1)[:, 1:-1], dq[:, 1:-1], atol=1e-3)  # steps of 10 ms
    assert np.abs(dq[:, [0, -1]]).max() < 1e-9
    model = Model(robot, robot.tool)
    assert min(float(model.tool_height(x)) for x in q.T) >= 0.1 - 1e-9
    tau = np.array([model.inverse(*x, 1.0, [], [])[0] for x in zip(q.T, dq.T, ddq.T, strict=True)])
    assert np.abs(tau).max() <= 40
    assert result["joints"]["joint2"]["position_rad"] == pytest.approx([q[1].min(), q[1].max()])
    assert result["samples"] == len(found["t"])


def test_standard_errors_are_those_of_least_squares(monkeypatch, tmp_path, capsys):
    """Simulated least squares: Pinocchio's regressor and friction on the motion written, drawn noise of 1 Nm, 400 fits."""
    assert run(monkeypatch, "excite", "rrr", *QUICK, "--out", tmp_path / "m.csv", "--json") == 0
    result, found = json.loads(capsys.readouterr().out), table(tmp_path / "m.csv")
    errors = result["standard_errors"]
    robot, model = load_robot("rrr"), Plant("rrr", *TRUTH).model
    q, dq, ddq = (np.array([found[f"{s}_{j}"] for j in robot.joints]) for s in ("q", "dq", "ddq"))
    data = model.createData()
    bodies = np.stack([pin.computeJointTorqueRegressor(model, data, *x) for x in zip(q.T, dq.T, ddq.T, strict=True)])
    places = dict(zip(("mass", "mx", "my", "mz", "xx", "xy", "yy", "xz", "yz", "zz"), range(10), strict=True))
    columns = []
    for name in errors:
        column = np.zeros((len(q.T), 3))
        if "[" in name:
            joint = robot.joints.index(name[name.index("[") + 1 : name.index("]")])
            kind = {"dry_friction": np.tanh(dq / 0.1), "viscous_friction": dq, "armature": ddq}[name.split("[")[0]]
            column[:, joint] = kind[joint]
        else:
            link, inertial = name.split(".")
            column = bodies[:, :, 10 * robot.links.index(link) + places[inertial]]
        columns.append(column.ravel())
    matrix, rng = np.stack(columns, axis=1), np.random.default_rng(0)
    drawn = np.linalg.lstsq(matrix, rng.standard_normal((len(matrix), 400)), rcond=None)[0].std(axis=1)
    expected = np.array([errors[name]["value"] for name in errors])
    np.testing.assert_allclose(
        drawn, expected, rtol=0.2
    )  # of 400 draws a standard deviation is known to 3.5 %; the worst of 22


def test_a_parameter_that_a_motion_leaves_open_has_no_standard_error():
    """An arm at rest says nothing of viscous friction."""
    robot = load_robot("rrr")
    rig = Rig(Model(robot, robot.tool, (CATALOGUE["viscous_friction"]((0,)),)), robot_limits(robot), np.zeros(1))
    names = [name for name in model_sensitivity(rig).names if "viscous" in name]
    still = Motion(np.arange(10) / 100, *np.zeros((3, robot.n, 10)), payload=np.zeros(10))
    assert information(rig, names).deviations(still) == {names[0]: np.inf}


def test_excite_tells_which_limits_a_urdf_lacks(monkeypatch, tmp_path, capsys):
    """The first joint turns without end, the second has no limits of speed and effort; the third has all."""
    limits = '<limit lower="-2" upper="2" effort="50" velocity="3"/>'
    bare = limits.replace("50", "0").replace('velocity="3"', 'velocity="0"')
    text = arm(3, {1: "continuous"}).split("<joint")
    text[2] = text[2].replace(limits, bare)
    (tmp_path / "arm.urdf").write_text("<joint".join(text))
    assert run(monkeypatch, "excite", tmp_path / "arm.urdf", *QUICK, "--out", tmp_path / "m.csv") == 0
    printed = capsys.readouterr()
    notes = [line for line in printed.err.splitlines() if line.startswith("Note: ")]
    assert notes == [
        "Note: the URDF gives no speed of j2: 'velocity' of <limit> is 0.",
        "Note: the URDF gives no limit of torque of j2: 'effort' of <limit> is 0.",
        "Note: j1: the URDF has no limit of the range; it is taken to turn by ±180°.",
        "Note: j2: the URDF has no limit of the speed; --speed gives one.",
        "Note: j2: the URDF has no limit of the torque; --torque gives one.",
    ]
    assert "standard error" in printed.out
    assert "of j1, j2, j3. Let the arm's own controller follow q, and record" in printed.out
    assert "motion: 0 of 1 starts" in printed.err
    assert re.search(r"motion: 1 of 1 starts, best -?\d", printed.err)


MISTAKES = {
    "no such robot": (["excite", "nowhere.urdf", "--out", "{1}/m.csv"], "nowhere.urdf"),
    "no such joint": (["excite", "rrr", "--joints", "elbow", "--out", "{1}/m.csv"], "elbow"),
    "no torque": (["excite", "rrr", "--torque", "0", "--out", "{1}/m.csv"], "--torque is 0 Nm; above 0 is required"),
    "no speed": (["excite", "rrr", "--speed", "-1", "--out", "{1}/m.csv"], "--speed is -1 rad/s; above 0 is required"),
    "no acceleration": (["excite", "rrr", "--acceleration", "nan", "--out", "{1}/m.csv"], "--acceleration is nan rad/s²"),
    "no time": (["excite", "rrr", "--duration", "0", "--out", "{1}/m.csv"], "duration must be above 0"),
    "days": (
        ["excite", "rrr", "--duration", "1e9", "--out", "{1}/m.csv"],
        "more than 1000000 samples of 0.01 s; at most 10000 s are allowed",
    ),
    "few harmonics": (["excite", "rrr", "--harmonics", "2", "--out", "{1}/m.csv"], "harmonics must be 3 or more"),
    "payload": (["excite", "rrr", "--payload", "-1", "--out", "{1}/m.csv"], "--payload is -1 kg; 0 to 10000 kg are allowed"),
    "heavy payload": (["excite", "rrr", "--payload", "1e8", "--out", "{1}/m.csv"], "--payload is 1e+08 kg"),
    "payload exported": (["export", "{0}/model.json", "--payload", "inf", "--out", "{1}/o"], "--payload is inf kg"),
    "no floor": (["excite", "rrr", "--floor", "nan", "--out", "{1}/m.csv"], "--floor is nan m; a finite height is required"),
    "high floor": (["excite", "rrr", "--floor", "inf", "--out", "{1}/m.csv"], "--floor is inf m; a finite height is required"),
    "fast": (["excite", "rrr", "--acceleration", "1e300", "--out", "{1}/m.csv"], "above 0 is required, up to 1e+09"),
    "robot over": (["excite", "{0}/arm.urdf", "--out", "{0}/arm.urdf"], "would be overwritten"),
    "model over": (["export", "{0}/arm.xml", "--out", "{0}"], "would be overwritten"),
    "too high": (["excite", "rrr", *QUICK, "--floor", "5", "--out", "{1}/m.csv"], "no motion found that keeps the limits"),
    "motion into a folder": (["excite", "rrr", "--out", "{1}"], "is a folder; the name of a file is required"),
    "no model": (["simulate", "{0}/nowhere.json", "{0}/set", "--out", "{1}/o"], "nowhere.json"),
    "window": (["simulate", "{0}/model.json", "{0}/set", "--window", "-1", "--out", "{1}/o"], "--window is -1 s"),
    "recordings over": (["simulate", "{0}/model.json", "{0}/set", "--out", "{0}/set"], "would be overwritten"),
    "into a file": (["simulate", "{0}/model.json", "{0}/set", "--out", "{0}/model.json"], "is a file; a folder is required"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_one_sentence_and_leaves_no_file(mistake, folder, monkeypatch, tmp_path, capsys):
    arguments, said = MISTAKES[mistake]
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    assert run(monkeypatch, *(a.format(folder, tmp_path) for a in arguments), "--quiet") == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.startswith("Error: ")
    assert printed.err.count("\n") == 1
    assert said in printed.err
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before
    assert not list(tmp_path.iterdir())
