"""Recording sets of robots without torque sensors: commanded angles and the gains of the loop that follows them."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from recorded import Plant, multisine, real, record

from rrr_oc.calibration.calibrate import calibrate
from rrr_oc.errors import UserError
from rrr_oc.recordings.consistency import check_consistency
from rrr_oc.recordings.header import Loop
from rrr_oc.recordings.importers import import_csv
from rrr_oc.recordings.reader import load_recordings
from rrr_oc.recordings.recording import RecordingSet
from rrr_oc.recordings.writer import save_recordings
from rrr_oc.robot.robot import load_robot
from rrr_oc.storage import write_csv

JOINTS = ("joint1", "joint2", "joint3")
KP, KD = {"joint1": 400.0, "joint2": 600.0, "joint3": 300.0}, {"joint1": 4.0, "joint2": 6.0, "joint3": 0.0}
HEADER = {"format": "rrr_oc-recordings/1", "robot": "rrr", "joints": list(JOINTS), "torque": "command", "kp": KP, "kd": KD}
GAINS = np.array([[*KP.values()], [*KD.values()]])[:, :, None]


def arm_columns() -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Columns of an arm that Pinocchio's torques move, with the commands that ask for these, and the torques (3, K) [Nm]."""
    plant = Plant("rrr", np.array([2.0, 3.0, 1.5]), np.array([3.0, 4.0, 2.0]), np.array([0.2, 0.3, 0.1]))
    t = np.arange(1000) / 100
    q, dq, ddq = multisine(3, t, np.random.default_rng(3))
    tau = plant.torque(q, dq, ddq)
    command = q + (tau + GAINS[1] * dq) / GAINS[0]
    of = {"q": q, "dq": dq, "command": command}
    return {"t": t, **{f"{kind}_{j}": x[i] for kind, x in of.items() for i, j in enumerate(JOINTS)}}, tau


def write(folder: Path, columns: dict[str, np.ndarray], **changes) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    header = {**HEADER, "recordings": [{"file": "a.csv"}], **changes}
    (folder / "recordings.json").write_text(json.dumps({k: v for k, v in header.items() if v is not None}))
    rows = zip(*(x.tolist() for x in columns.values()), strict=True)
    (folder / "a.csv").write_text(",".join(columns) + "\n" + "".join(",".join(map(repr, row)) + "\n" for row in rows))
    return folder


@pytest.mark.parametrize("gains", ["by joint", "one number"])
def test_torques_are_those_of_the_loop(tmp_path, gains):
    columns, tau = arm_columns()
    if gains == "by joint":
        found = load_recordings(write(tmp_path, columns))
    else:
        for i, joint in enumerate(JOINTS):
            columns[f"command_{joint}"] = columns[f"q_{joint}"] + (tau[i] + 2 * columns[f"dq_{joint}"]) / 500
        found = load_recordings(write(tmp_path, columns, kp=500, kd=2))
    (r,) = found.recordings
    np.testing.assert_allclose(r.tau, tau, atol=1e-9)
    np.testing.assert_allclose(found.output_torque(r), tau, atol=1e-9)
    assert not r.ignored
    assert found.torque == "command"


def test_gains_may_differ_by_recording(tmp_path):
    """Torques, a copy of the set, and the check are those of each recording's own gains."""
    columns, tau = arm_columns()
    write(tmp_path, columns)
    softer = columns | {
        f"command_{j}": columns[f"q_{j}"] + (tau[i] + KD[j] * columns[f"dq_{j}"]) / 250 for i, j in enumerate(JOINTS)
    }
    write_csv(tmp_path / "b.csv", softer)
    header = HEADER | {"recordings": [{"file": "a.csv"}, {"file": "b.csv", "kp": 250}]}
    (tmp_path / "recordings.json").write_text(json.dumps(header))
    found = load_recordings(tmp_path)
    save_recordings(found, tmp_path / "copy")
    for one in (found, load_recordings(tmp_path / "copy")):
        for r in one.recordings:
            np.testing.assert_allclose(r.tau, tau, atol=1e-9)
    assert check_consistency(found).doubts == ()
    (tmp_path / "recordings.json").write_text(json.dumps(header | {"torque": "motor"}))
    with pytest.raises(UserError, match=r"recordings\[1\]: has gains of a loop; torque 'motor' has none"):
        load_recordings(tmp_path)


def test_what_positions_and_commands_cannot_tell_is_said(tmp_path):
    """Only where neither masses nor a payload are known."""
    said = "in proportion to kp alone; a recording with a known payload tells kp"
    loaded = {"inertial": "identify", "recordings": [{"file": "a.csv", "payload": 1.0}]}
    for k, (changes, expected) in enumerate((({}, False), ({"inertial": "identify"}, True), (loaded, False))):
        notes = load_recordings(write(tmp_path / str(k), arm_columns()[0], **changes)).notes
        assert any(note.endswith(said) for note in notes) == expected


def test_a_set_that_is_written_is_the_same_again(tmp_path):
    original = load_recordings(write(tmp_path / "a", arm_columns()[0]))
    save_recordings(original, tmp_path / "b")
    copy = load_recordings(tmp_path / "b")
    for name in ("q", "dq", "tau", "command"):
        np.testing.assert_array_equal(getattr(copy.recordings[0], name), getattr(original.recordings[0], name))
    assert "tau_joint1" not in (tmp_path / "b" / "a.csv").read_text().splitlines()[0]


def test_the_torque_follows_other_speeds():
    """As where speeds come from shorter windows."""
    arm = Plant("rrr", np.ones(3), np.ones(3), np.ones(3))
    r = record(arm, "a.csv", np.random.default_rng(0), 2.0)
    robot, loop = load_robot("rrr"), Loop(GAINS[0, :, 0], GAINS[1, :, 0])
    driven = replace(r, command=r.q + 0.1, loop=loop, dq=0.5 + r.dq)
    found = RecordingSet(robot, "rrr", "command", "nominal", robot.tool, (None,) * 3, (driven,), Path("made_up"))
    np.testing.assert_allclose(found.output_torque(driven), GAINS[0] * 0.1 - GAINS[1] * (0.5 + r.dq), atol=1e-9)


def without(columns: dict[str, np.ndarray], name: str) -> dict[str, np.ndarray]:
    return {k: v for k, v in columns.items() if k != name}


MISTAKES = {
    "kd of no joint": ({"kd": {**KD, "wrist": 1.0}}, None, "kd: unknown joint 'wrist'"),
    "kp of 0": ({"kp": 0.0}, None, "kp: found 0 for 'joint1'; a finite number of Nm/rad above 0 is required"),
    "kd below 0": ({"kd": -1.0}, None, "kd: found -1 for 'joint1'; a finite number of Nm s/rad of 0 or more is required"),
    "kp as text": ({"kp": "20"}, None, "kp"),
    "no command": ({}, lambda c: without(c, "command_joint2"), "column 'command_joint2' is missing"),
    "degrees": (
        {},
        lambda c: c | {f"command_{j}": np.degrees(c[f"command_{j}"]) for j in JOINTS},
        "'command_joint1' looks like degrees",
    ),
    "counts": ({"kp": 6e5, "kd": 0.0}, None, "kp in Nm/rad, kd in Nm s/rad and commands in rad are required"),
}  # fmt: skip


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_one_sentence(tmp_path, mistake):
    changes, change, said = MISTAKES[mistake]
    columns = arm_columns()[0]
    with pytest.raises(UserError) as error:
        load_recordings(write(tmp_path, columns if change is None else change(columns), **changes))
    assert said in str(error.value)
    assert "\n" not in str(error.value)


def test_commands_of_a_joint_that_turns_over_are_on_its_turn(tmp_path):
    """Positions within ±π that jump, and commands that jump a little earlier or later."""
    columns, tau = arm_columns()
    for kind in ("q", "command"):
        columns[f"{kind}_joint1"] = (columns[f"{kind}_joint1"] + np.pi - 0.1 + np.pi) % (2 * np.pi) - np.pi
    (r,) = load_recordings(write(tmp_path, columns)).recordings
    assert "q_joint1" in r.turned
    np.testing.assert_allclose(r.tau, tau, atol=1e-9)


def test_torques_beyond_the_motors_are_said(tmp_path):
    columns, _ = arm_columns()
    columns["command_joint3"] = columns["command_joint3"] + np.where(np.arange(1000) < 100, 3.0, 0.0)
    found = load_recordings(write(tmp_path, columns))
    limit = found.robot.effort[2]
    beyond = np.mean(np.abs(found.recordings[0].tau[2]) > limit)
    assert beyond > 0.05
    said = (
        f"joint3 more than its effort limit, {limit:g} Nm, in up to {100 * beyond:.2g} % of the rows, where a motor gives less"
    )
    assert any(said in note for note in found.notes)
    np.testing.assert_array_equal(found.clipped(found.recordings[0])[2], np.abs(found.recordings[0].tau[2]) > limit)
    friction = [e.value for term in calibrate(found).terms if "viscous" in term.effect.name for e in term.estimates]
    np.testing.assert_allclose(friction, [3.0, 4.0, 2.0], rtol=0.1)  # smoothing
    assert check_consistency(found).doubts == ()


def test_a_limit_below_most_torques_is_doubted_and_nothing_left_out(tmp_path):
    columns, _ = arm_columns()
    columns["command_joint3"] = columns["command_joint3"] + np.where(np.arange(1000) < 600, 3.0, 0.0)
    found = load_recordings(write(tmp_path, columns))
    assert any("all rows count: kp, kd, a command or this limit of the robot's file is wrong" in note for note in found.notes)
    assert not found.clipped(found.recordings[0]).any()


WRONG_GAINS = {
    "kp": ({"kp": {**KP, "joint2": 6000.0}}, 10.0, "kp of joint2 is NUMBER times what the arm needs: "),
    "a smaller kp": ({"kp": {**KP, "joint2": 60.0}}, 0.1, "kp of joint2 is NUMBER times what the arm needs: "),
    "Nm/°": (
        {"kp": {j: k * np.pi / 180 for j, k in KP.items()}, "kd": 0.0},
        np.pi / 180,
        "kp of all joints is NUMBER times what the arm needs, as if in Nm/°: ",
    ),
    "kd": ({"kd": {**KD, "joint2": 900.0}}, None, "what kp and kd make of commands fits with a smaller kd than is listed: "),
}


@pytest.mark.parametrize("gains", WRONG_GAINS)
def test_wrong_gains_are_named(tmp_path, gains):
    changes, times, said = WRONG_GAINS[gains]
    (doubt,) = check_consistency(load_recordings(write(tmp_path, arm_columns()[0], **changes))).doubts
    match = re.search(said.replace("NUMBER", r"([\d.]+)"), doubt.said)
    assert match is not None, doubt.said
    if times is not None:
        assert float(match[1]) == pytest.approx(times, rel=0.12)  # dry friction at reversals


def test_a_kp_that_is_not_known_is_told_beside_a_loop_that_brakes(tmp_path):
    """Whose kd makes most of what is commanded."""
    columns, tau = arm_columns()
    for i, j in enumerate(JOINTS):
        columns[f"command_{j}"] = columns[f"q_{j}"] + (tau[i] + 60 * columns[f"dq_{j}"]) / KP[j]
    kp = load_recordings(write(tmp_path, columns, kp={"joint1": KP["joint1"]}, kd=60.0)).estimated_kp
    assert kp == pytest.approx({j: KP[j] for j in JOINTS[1:]}, rel=0.1)  # dry friction at reversals


READINGS = {
    "command": ("command_joint2", "command_joint2 fits with the opposite sign"),
    "positions": ("q_joint2 dq_joint2", "q_joint2 and its rates fit with the opposite sign"),
    "all": ("q_joint2 dq_joint2 command_joint2", "q_joint2, its rates and command_joint2 fit with the opposite signs"),
}


@pytest.mark.parametrize("reading", READINGS)
def test_wrong_signs_are_named(tmp_path, reading):
    names, said = READINGS[reading]
    columns = arm_columns()[0]
    assert check_consistency(load_recordings(write(tmp_path / "right", columns))).doubts == ()
    wrong = columns | {name: -columns[name] for name in names.split()}
    (doubt,) = check_consistency(load_recordings(write(tmp_path / "wrong", wrong))).doubts
    assert said in doubt.said


def test_no_clock_is_named_of_commands(tmp_path):
    """Commands that are early ask for as much more torque as viscous friction takes, whatever the time."""
    columns = arm_columns()[0]
    for lag in (-0.1, 0.1):
        moved = {f"command_{j}": np.interp(columns["t"] + lag, columns["t"], columns[f"command_{j}"]) for j in JOINTS}
        found = check_consistency(load_recordings(write(tmp_path, columns | moved)))
        assert not [doubt for doubt in found.doubts if doubt.kind == "clock"]
        assert (max(found.nrmse) < 0.1) == (lag > 0)


MAPPING = """
torque = "command"
kp = KP
kd = 1.5
[columns]
t = "time"
""" + "\n".join(
    f'q_{j} = {{ column = "angle{i}", unit = "deg" }}\ncommand_{j} = {{ column = "goal{i}", unit = "deg", factor = -1 }}'
    for i, j in enumerate(JOINTS)
)  # fmt: skip


@pytest.mark.parametrize("kp", ["20.0", "{ joint1 = 20.0, joint2 = 30.0, joint3 = 10.0 }"])
def test_columns_of_ones_own_are_imported(tmp_path, kp):
    rng, t = np.random.default_rng(1), np.arange(200) / 100
    q = np.array([0.0, 60.0, -60.0])[:, None] + 20 * np.sin(t * rng.uniform(1, 3, (3, 1)))
    goal = -(q + 2.0)
    table = np.vstack([t, q, goal]).T
    names = ["time", *(f"{kind}{i}" for kind in ("angle", "goal") for i in range(3))]
    (tmp_path / "log.csv").write_text(",".join(names) + "\n" + "\n".join(",".join(map(repr, row)) for row in table.tolist()))
    (tmp_path / "map.toml").write_text(MAPPING.replace("KP", kp))
    made = import_csv([tmp_path / "log.csv"], "rrr", tmp_path / "set", tmp_path / "map.toml")
    (r,) = made.recordings
    each = np.array([20.0, 20.0, 20.0] if kp == "20.0" else [20.0, 30.0, 10.0])[:, None]
    np.testing.assert_allclose(r.command, np.radians(q + 2.0), atol=1e-12)
    np.testing.assert_allclose(made.output_torque(r), each * np.radians(2.0) - 1.5 * r.dq, atol=1e-9)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (MAPPING.replace("kp = KP\n", "kp = -1.0\n"), "kp: found -1"),
        (MAPPING.replace("KP", "{ elbow = 1.0 }"), "kp: unknown joint 'elbow'"),
        (
            MAPPING.replace("KP", "20.0").replace('torque = "command"', 'torque = "motor"'),
            "unknown column of a set 'command_joint1'",
        ),
    ],
)
def test_a_wrong_mapping_is_one_sentence(tmp_path, text, said):
    (tmp_path / "log.csv").write_text("time\n0\n")
    (tmp_path / "map.toml").write_text(text)
    with pytest.raises(UserError, match=said):
        import_csv([tmp_path / "log.csv"], "rrr", tmp_path / "set", tmp_path / "map.toml")


@pytest.mark.parametrize("leg", ["FL", "RR"])
def test_legs_of_a_real_quadruped_are_read(leg):
    """Torques as the motors can give them, and no doubt about a column."""
    for part in ("train", "test"):
        found = load_recordings(real("go2_legs") / leg / part)
        for r in found.recordings:
            np.testing.assert_allclose(r.tau, 20 * (r.command - r.q) - 1.5 * r.dq, atol=1e-9)
            assert np.abs(r.tau).max() < 4
        assert check_consistency(found).doubts == ()
