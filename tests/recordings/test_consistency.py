"""Columns of the wrong sign, order, unit or clock: each is put into a right set, found, and named with its mend."""

import json
from dataclasses import replace

import numpy as np
import pytest
from commands import rrr_oc
from swung import CENTRE, JOINTS, PLANT, columns, without, written

from rrr_oc.recordings.consistency import check_consistency
from rrr_oc.recordings.reader import load_recordings

RIGHT = without(("ddq",), columns())


def scaled(factor: float, *names: str) -> dict[str, np.ndarray]:
    """The set with some columns times a factor."""
    return RIGHT | {name: factor * RIGHT[name] for name in names}


def exchanged(i: int, j: int, *kinds: str) -> dict[str, np.ndarray]:
    """The set with columns of two joints in each other's place."""
    one, other = JOINTS[i], JOINTS[j]
    pairs = [(f"{kind}_{a}", f"{kind}_{b}") for kind in kinds for a, b in ((one, other), (other, one))]
    return RIGHT | {to: RIGHT[of] for to, of in pairs}


MISTAKES = {
    "sign of a torque": (
        scaled(-1, "tau_joint2"),
        "sign",
        "tau_joint2 fits with the opposite sign: NRMSE of the torque of joint2 ",
    ),
    "sign of a torque without gravity": (scaled(-1, "tau_joint1"), "sign", "tau_joint1 fits with the opposite sign: "),
    "sign of a position": (scaled(-1, "q_joint2", "dq_joint2"), "sign", "q_joint2 and its rates fit with the opposite sign: "),
    "a joint that turns the other way": (
        scaled(-1, "q_joint3", "dq_joint3", "tau_joint3"),
        "sign",
        "q_joint3, its rates and tau_joint3 fit with the opposite signs: ",
    ),
    "torques swapped": (exchanged(1, 2, "tau"), "order", "tau_joint2 and tau_joint3 fit when they are swapped: "),
    "positions swapped": (
        exchanged(1, 2, "q", "dq"),
        "order",
        "q_joint2 and q_joint3, with their rates, fit when they are swapped: ",
    ),
    "joints swapped": (
        exchanged(0, 1, "q", "dq", "tau"),
        "order",
        "all columns of joint1 and joint2 fit when they are swapped: ",
    ),
    "torque in Ncm": (
        scaled(100, "tau_joint2"),
        "unit",
        "tau_joint2 is 99.8 times what the arm needs, as if in Ncm: ",
    ),
    "angles in rad taken for degrees": (
        without(("dq",), scaled(np.pi / 180, *(f"q_{joint}" for joint in JOINTS))),
        "unit",
        "positions fit when they are multiplied by 57.3, as angles in rad that were taken for degrees: ",
    ),
}


def doubts(folder, header=None, **files):
    return check_consistency(load_recordings(written(folder, header, **files))).doubts


def test_a_right_set_is_not_doubted(tmp_path):
    found = check_consistency(load_recordings(written(tmp_path, a=RIGHT, b=without(("dq",), RIGHT))))
    assert found.doubts == ()
    assert max(found.nrmse) < 0.2


@pytest.mark.parametrize(("wrong", "kind", "said"), MISTAKES.values(), ids=MISTAKES)
def test_a_mistake_is_named_with_its_mend(tmp_path, wrong, kind, said):
    """And nothing else, but that a motion of degrees is too small to tell much."""
    wrong = without(("dq",), wrong) if "multiplied" in said else wrong
    found = [doubt for doubt in doubts(tmp_path, a=wrong) if doubt.kind != "excitation"]
    assert [doubt.kind for doubt in found] == [kind]
    (doubt,) = found
    assert doubt.said.startswith(said)
    assert (doubt.after or 1) < 0.05 < 0.2 < (doubt.before or 0)  # what is left is the noise and the width of dry friction
    assert set(doubt.columns) <= set(RIGHT)


@pytest.mark.parametrize("name", ["sign of a torque", "sign of a torque without gravity", "torques swapped"])
def test_a_mistake_of_one_recording_is_named_with_its_file(tmp_path, name):
    wrong, kind, said = MISTAKES[name]
    (doubt,) = doubts(tmp_path, a=RIGHT, b=wrong, c=RIGHT)
    assert doubt.kind == kind
    assert doubt.said.startswith(f"b.csv: {said}")


def test_a_spring_hides_no_wrong_sign(tmp_path):
    """The sign is as wrong, though the rigid arm alone explains the torque badly either way."""
    for stiffness, at in ((40.0, -1.0), (15.0, 0.5)):
        sprung = RIGHT["tau_joint3"] + stiffness * (RIGHT["q_joint3"] - at)
        (doubt,) = doubts(tmp_path / f"{stiffness}", a=RIGHT | {"tau_joint3": -sprung})
        assert (doubt.kind, doubt.columns) == ("sign", ("tau_joint3",))
        assert doubts(tmp_path / f"{stiffness}_right", a=RIGHT | {"tau_joint3": sprung}) == ()


def test_a_payload_that_no_torque_shows_is_said(tmp_path):
    header = {"recordings": [{"file": "a.csv", "payload_kg": 1500}]}
    (doubt,) = doubts(tmp_path, header, a=RIGHT)
    assert doubt.kind == "payload"
    assert doubt.said.startswith("the torques fit better without the listed payload of up to 1500 kg: ")


def test_two_mistakes_are_named_one_after_the_other(tmp_path):
    wrong = scaled(-1, "tau_joint2", "tau_joint3")
    assert {doubt.columns for doubt in doubts(tmp_path, a=wrong)} == {("tau_joint2",), ("tau_joint3",)}


def test_a_torque_that_is_late_is_named_with_its_lag(tmp_path):
    wrong = RIGHT | {"tau_joint2": np.interp(RIGHT["t"] - 0.1, RIGHT["t"], RIGHT["tau_joint2"])}
    (doubt,) = doubts(tmp_path, a=wrong)
    assert (doubt.kind, doubt.columns) == ("clock", ("tau_joint2",))
    assert doubt.said.startswith("tau_joint2 is 0.1 s late beside the positions: ")


def test_a_torque_that_the_arm_does_not_explain_is_said(tmp_path, monkeypatch, capsys):
    """As where a spring carries most of the weight."""
    assert rrr_oc(monkeypatch, "check", str(written(tmp_path, a=scaled(0.3, "tau_joint2")))) == 0
    assert "Warning: the rigid arm explains the torque of joint2 no better than a constant does" in capsys.readouterr().err


def test_what_no_motion_shows_is_said(tmp_path):
    still = RIGHT | {"q_joint3": 0 * RIGHT["t"] + CENTRE[2], "dq_joint3": 0 * RIGHT["t"]}
    said = [doubt.said for doubt in doubts(tmp_path, a=still) if doubt.kind == "excitation"]
    assert any(one.startswith("joint3 never moves more than 0°: its friction and rotor inertia cannot be told") for one in said)
    rng = np.random.default_rng(0)
    noisy = RIGHT | {f"tau_{joint}": RIGHT[f"tau_{joint}"] + rng.normal(0, 90, RIGHT["t"].shape) for joint in JOINTS}
    said = [doubt.said for doubt in doubts(tmp_path, a=noisy)]
    assert len([one for one in said if "the inertia of the links is hardly seen there; record it faster" in one]) == 3


def test_missing_physics_is_no_mistake_in_columns(tmp_path):
    """A spring across the elbow, and 5 kg at the tool: the diagnosis' to find."""
    t = RIGHT["t"]
    sprung = RIGHT | {"tau_joint3": RIGHT["tau_joint3"] + 15 * (RIGHT["q_joint3"] + 1.0)}
    loaded = RIGHT | {f"tau_{j}": RIGHT[f"tau_{j}"] + m * np.cos(t) for j, m in (("joint2", 20.0), ("joint3", 8.0))}
    assert doubts(tmp_path, a=sprung) == doubts(tmp_path, a=loaded) == ()


def test_masses_that_are_not_known_explain_no_wrong_sign(tmp_path):
    identify = {"inertial": "identify"}
    assert doubts(tmp_path, identify, a=RIGHT) == ()
    (doubt,) = doubts(tmp_path, identify, a=scaled(-1, "tau_joint2"))
    assert doubt.columns == ("tau_joint2",)
    (doubt,) = doubts(tmp_path, identify, a=exchanged(1, 2, "tau"))
    assert doubt.columns == ("tau_joint2", "tau_joint3")


def test_a_set_that_tells_nothing_ends_in_no_error(tmp_path):
    """Five rows, torques of one value, and accelerations beyond all measure."""
    short = {name: values[:5] for name, values in RIGHT.items()}
    flat = RIGHT | {f"tau_{joint}": 0 * RIGHT["t"] for joint in JOINTS}
    assert {doubt.kind for doubt in doubts(tmp_path, a=short)} <= {"excitation"}
    assert {doubt.kind for doubt in doubts(tmp_path, a=flat)} <= {"excitation"}
    fast = without(("dq",), RIGHT | {"t": RIGHT["t"] / 1e4})  # accelerations of 1e8 rad/s²
    assert check_consistency(load_recordings(written(tmp_path, a=fast))).nrmse[0] >= 0


def test_the_command_and_calibrate_say_it(tmp_path, monkeypatch, capsys):
    folder = written(tmp_path, a=scaled(-1, "tau_joint2"))
    assert rrr_oc(monkeypatch, "check", str(folder)) == 0
    printed = capsys.readouterr()
    warning = "Warning: tau_joint2 fits with the opposite sign: NRMSE of the torque of joint2"
    assert warning in printed.err
    assert "A diagnosis takes 6 to 90 s of processor time" in printed.out
    assert rrr_oc(monkeypatch, "check", str(folder), "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert [doubt["columns"] for doubt in found["doubts"]] == [["tau_joint2"]]
    assert set(found) == {"doubts", "notes", "nrmse", "diagnosis_s"}
    assert rrr_oc(monkeypatch, "calibrate", str(folder), "--out", str(tmp_path / "out")) == 0
    assert warning in capsys.readouterr().err


ROBOT = {
    "an arm on a wall": ({"gravity": [-9.81, 0, 0]}, None, 'the torques fit with "gravity": [0, 0, -9.81], as if the arm were'),
    "a link of 30 g": ({}, ('<mass value="2.181"/>', '<mass value="0.03"/>'), "the torques fit when link3 is "),
    "an axis": ({}, ("axis", 2), "the torques fit when joint3 turns about −y of its frame in the robot's file"),
}


@pytest.mark.parametrize("name", ROBOT)
def test_a_wrong_robot_is_no_mistake_in_columns(tmp_path, name):
    """It is named first; columns may stand beside it as rivals."""
    header, change, said = ROBOT[name]
    found = load_recordings(written(tmp_path, header, a=RIGHT))
    if change is not None:
        n, robot = 3, found.robot
        light = np.where(np.arange(n) == 2, 0.02, 1.0) * robot.inertial
        turned = np.where(np.arange(n)[:, None] == 2, np.roll(robot.axes, 1, axis=1), robot.axes)
        found = replace(found, robot=replace(robot, inertial=light) if change[0] != "axis" else replace(robot, axes=turned))
    first = [doubt for doubt in check_consistency(found).doubts if doubt.kind != "excitation"]
    assert [(doubt.kind, doubt.said.startswith(said)) for doubt in first] == [("robot", True)]


def test_torques_without_the_weight_of_the_arm_are_named(tmp_path):
    """As those of a controller that adds the weight by itself; springs that carry it would look alike."""
    q = np.array([RIGHT[f"q_{joint}"] for joint in JOINTS])
    weight = PLANT.load(q, 0 * q, 0 * q)
    (doubt,) = doubts(tmp_path, a=RIGHT | {f"tau_{joint}": RIGHT[f"tau_{joint}"] - weight[j] for j, joint in enumerate(JOINTS)})
    assert doubt.said.startswith(
        'the torques fit with "gravity": [0, 0, 0], as where a controller adds the arm\'s weight to the torques'
    )
    assert doubt.rivals == ("springs or counterweights carry the arm's weight",)


def test_all_torques_of_the_opposite_sign_are_one_mistake(tmp_path):
    """Though a payload that nobody noted is at the tool; positions of the opposite sign would look alike, and no swap is said."""
    t = RIGHT["t"]
    heavy = {f"tau_{j}": -RIGHT[f"tau_{j}"] - m * np.cos(t) for j, m in (("joint2", 5.0), ("joint3", 2.0))}
    (doubt,) = doubts(tmp_path, a=RIGHT | heavy | {"tau_joint1": -RIGHT["tau_joint1"]})
    assert doubt.columns == ("tau_joint1", "tau_joint2", "tau_joint3")
    assert doubt.said.startswith("all torques fit with the opposite sign: NRMSE of the torque of joint")


def test_one_unit_of_all_torques_is_one_mistake_and_may_be_heavier_links(tmp_path):
    (doubt, *_) = doubts(tmp_path, a=scaled(100, *(f"tau_{joint}" for joint in JOINTS)))
    assert doubt.said.startswith("all torques are 99.8 times what the arm needs, as if in Ncm: divided by that: NRMSE ")
    assert doubt.rivals[0] == "all links are 99.8 times as heavy as in the robot's file"


def test_a_zero_that_is_off_is_named_with_its_size(tmp_path):
    (doubt,) = doubts(tmp_path, a=RIGHT | {"q_joint3": RIGHT["q_joint3"] - np.radians(30)})
    assert (doubt.kind, doubt.columns) == ("zero", ("q_joint3",))
    assert doubt.said.startswith("q_joint3 fits with +30.5° added to it: ")
    assert doubt.rivals == ("q_joint2 fits with +29° added to it",)


def test_an_angle_from_an_earlier_link_and_torques_of_a_parallelogram_are_named(tmp_path):
    total = RIGHT | {f"{kind}_joint3": RIGHT[f"{kind}_joint2"] + RIGHT[f"{kind}_joint3"] for kind in ("q", "dq")}
    (doubt,) = doubts(tmp_path, a=total)
    assert doubt.said.startswith(
        'q_joint3 fits as q_joint2 + joint3\'s own angle: "coupling" with "q": [[1, 0, 0], [0, 1, 0], [0, -1, 1]]'
    )
    (doubt,) = doubts(tmp_path, a=total | {"tau_joint2": RIGHT["tau_joint2"] - RIGHT["tau_joint3"]})
    assert "as of a parallelogram" in doubt.said
    assert '"tau": [[1, 0, 0], [0, 1, 1], [0, 0, 1]]' in doubt.said


def test_no_mend_is_said_that_leaves_a_poor_joint_poor(tmp_path):
    """A torque of one joint has the wrong sign, that of another is anything: no mistake explains both."""
    wrong = scaled(-1, "tau_joint2") | {"tau_joint3": 30 * np.sin(9 * RIGHT["t"])}
    found = check_consistency(load_recordings(written(tmp_path, a=wrong)))
    assert not [doubt for doubt in found.doubts if doubt.kind != "clock"]
    assert min(found.nrmse[1:]) > 0.9
