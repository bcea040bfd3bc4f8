"""Exported files, read again by the programs that they are for."""

import json
import re
import sys
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pinocchio as pin
import pytest
from chains import arm

from rrr_oc import cli
from rrr_oc.calibration.calibrated_model import CalibratedModel, Term, nominal_term
from rrr_oc.calibration.model_file import save_model
from rrr_oc.effects import CATALOGUE
from rrr_oc.effects.elastic.biarticular_spring import BiarticularSpring
from rrr_oc.effects.elastic.parallel_spring import ParallelSpring
from rrr_oc.effects.elastic.spring_stiffness import SpringStiffness
from rrr_oc.effects.friction.dry_friction import DryFriction
from rrr_oc.effects.friction.load_dependent_friction import LoadDependentFriction
from rrr_oc.model.symbolic_model import Model
from rrr_oc.robot.robot import BUNDLED, load_robot, urdf_text
from rrr_oc.simulation.export import mjcf, urdf
from rrr_oc.storage import write_csv

STATES = np.random.default_rng(0).uniform(-1.5, 1.5, (20, 3, 3))  # q, dq, ddq of each


def torque(mj: mujoco.MjModel, q, dq, ddq) -> np.ndarray:
    """What plain MuJoCo needs for a motion, (n,) [Nm]."""
    data = mujoco.MjData(mj)
    data.qpos[:], data.qvel[:], data.qacc[:] = q, dq, ddq
    mujoco.mj_inverse(mj, data)
    return data.qfrc_inverse.copy()


@pytest.mark.parametrize("name", BUNDLED)
def test_a_urdf_read_again_has_the_inertial_parameters(name, tmp_path):
    robot = load_robot(name)
    changed = robot.inertial * np.random.default_rng(1).uniform(0.9, 1.1, robot.inertial.shape[1])
    (tmp_path / "arm.urdf").write_text(urdf(urdf_text(name), replace(robot, inertial=changed)))
    np.testing.assert_allclose(load_robot(tmp_path / "arm.urdf").inertial, changed, rtol=1e-9, atol=1e-10)


def test_a_locked_joint_is_fixed_and_its_link_is_part_of_the_one_before(tmp_path):
    robot = load_robot("rrr", ["joint1", "joint2"])
    (tmp_path / "arm.urdf").write_text(urdf(urdf_text("rrr"), robot))
    again = load_robot(tmp_path / "arm.urdf")
    assert again.joints == ("joint1", "joint2")
    np.testing.assert_allclose(again.inertial, robot.inertial, rtol=1e-9, atol=1e-10)


def test_joints_without_a_range_have_none_in_mjcf(tmp_path):
    """The range 0 to 0 in a URDF says none; MuJoCo refuses it."""
    (tmp_path / "arm.urdf").write_text(arm(2).replace('lower="-2" upper="2"', 'lower="0" upper="0"', 1))
    robot = load_robot(tmp_path / "arm.urdf")
    made = mjcf(Model(robot, robot.tool), np.zeros(0))
    assert mujoco.MjModel.from_xml_string(made.text).jnt_limited.tolist() == [0, 1]


def test_a_flat_link_is_read_again_whatever_the_digits_of_its_moments_of_inertia(tmp_path):
    """The largest moment of a plate is the two others' sum, which six digits of each may miss."""
    (tmp_path / "arm.urdf").write_text(arm(2))
    robot, rng = load_robot(tmp_path / "arm.urdf"), np.random.default_rng(0)
    for a, b in rng.uniform(0.001, 0.01, (40, 2)):
        plate = np.array([2.0, 0, 0, 0, a, 0, b, 0, 0, a + b])
        made = mjcf(Model(replace(robot, inertial=np.column_stack([plate, plate])), robot.tool), np.zeros(0))
        moments = mujoco.MjModel.from_xml_string(made.text).body_inertia[1]
        np.testing.assert_allclose(np.sort(moments), np.sort([a, b, a + b]), rtol=3e-5)


def test_mjcf_needs_the_torques_of_pinocchio_and_of_the_springs_laws():
    robot = load_robot("rrr")
    pea, bpea = ParallelSpring((1,)), BiarticularSpring((1, 2))
    model = Model(robot, robot.tool, (pea, bpea))
    theta = model.theta(
        {
            model.label(pea): {"stiffness": 30.0, "equilibrium": 0.4},
            model.label(bpea): {"kappa": 20.0, "rho": 0.8, "phi": 0.3},
        }
    )
    made = mjcf(model, theta, payload=2.0)
    assert made.left_out == ()
    mj = mujoco.MjModel.from_xml_string(made.text)
    body = pin.buildModelFromXML(urdf_text("rrr"))
    body.appendBodyToJoint(3, pin.Inertia(2.0, np.zeros(3), np.zeros((3, 3))), pin.SE3(np.eye(3), robot.tool.position))
    data = body.createData()
    slack = []
    for share, dq, ddq in STATES:
        q = robot.lower + (robot.upper - robot.lower) * (0.5 + share / 3.2)  # limits push back beyond
        stretch = max(0.4 - q[1], 0.0), max(-q[1] - 0.8 * q[2] - 0.3, 0.0)
        slack.append([s == 0 for s in stretch])
        springs = np.array([0.0, 30.0 * stretch[0] + 20.0 * stretch[1], 0.8 * 20.0 * stretch[1]])
        np.testing.assert_allclose(torque(mj, q, dq, ddq), pin.rnea(body, data, q, dq, ddq) - springs, rtol=1e-7, atol=1e-7)
    assert 0 < np.mean(slack) < 1  # both sides of the springs are met
    np.testing.assert_allclose(mj.jnt_range, np.array([robot.lower, robot.upper]).T, rtol=1e-5)  # the digits that MuJoCo writes
    np.testing.assert_allclose(mj.actuator_ctrlrange[:, 1], robot.effort)


def test_what_mujoco_cannot_express_is_named():
    robot = load_robot("rrr")
    friction = LoadDependentFriction((1,))
    made = mjcf(Model(robot, robot.tool, (friction,)), [0.1])
    (one,) = made.left_out
    assert "load_dependent_friction" in one
    assert "load_dependent_friction" in made.text.split("-->")[0]
    mujoco.MjModel.from_xml_string(made.text)


STIFFNESS, EQUILIBRIUM = 9.0, 1.2  # [Nm/rad], [rad], of the spring in `saved`


def saved(folder, **change) -> Path:
    """A summary.json with what is read of a design for the paper's task: springs of joints 2 and 3."""
    entry = {
        "mounted": {"parallel_spring[joint2]": {"active": "below"}, "parallel_spring[joint3]": {"active": "below"}},
        "parameters": {
            "parallel_spring[joint2]": {"stiffness": STIFFNESS, "equilibrium": EQUILIBRIUM},
            "parallel_spring[joint3]": {"stiffness": 1.0, "equilibrium": -1.2},
        },
        "cost": 1.0,
    } | change
    (folder / "summary.json").write_text(json.dumps({"preset": "paper", "configurations": {"PEA": entry}}))
    return folder / "summary.json"


def run(monkeypatch, *arguments) -> int:
    monkeypatch.setattr(sys, "argv", ["rrr-oc", "export", *map(str, arguments)])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    return int(ended.value.code or 0)


def model_file(folder: Path, joints: int, terms: tuple[Term, ...] = ()) -> Path:
    """model.json of the paper's arm with as many joints, by default with dry friction of the last one."""
    robot = load_robot("rrr", [f"joint{k + 1}" for k in range(joints)])
    terms = terms or (nominal_term(DryFriction((joints - 1,))).with_values(np.array([0.7])),)
    nothing = np.zeros(joints)
    text, constants = urdf_text("rrr"), (None,) * joints
    arm = CalibratedModel(robot, "rrr", text, robot.tool, "motor", constants, "nominal", terms, nothing, nothing)
    save_model(arm, folder / f"model{joints}.json")
    return folder / f"model{joints}.json"


@pytest.mark.parametrize("with_model", [False, True])
def test_a_designs_springs_pull_on_the_arm_in_plain_mujoco(with_model, monkeypatch, tmp_path, capsys):
    """An arm at rest needs gravity less the springs, by their laws written out here; only with a model there is friction."""
    options = ["--design", saved(tmp_path), "--configuration", "PEA", "--task", "paper", "--json", "--out", tmp_path / "e"]
    assert run(monkeypatch, *([model_file(tmp_path, 3)] if with_model else []), *options) == 0
    found = json.loads(capsys.readouterr().out)
    assert ("urdf" in found) is with_model
    assert (tmp_path / "e" / "arm.urdf").exists() is with_model
    mj, body = mujoco.MjModel.from_xml_path(found["mjcf"]), pin.buildModelFromXML(urdf_text("rrr"))
    robot = load_robot("rrr")
    assert bool(mj.dof_frictionloss.any()) is with_model
    if not with_model:
        assert found["not_in_mjcf"] == ["joint1 is held by the task; here it moves"]
    slack = []
    for share, _, _ in STATES:
        q = robot.lower + (robot.upper - robot.lower) * (0.5 + share / 3.2)  # limits push back beyond
        stretch = np.maximum([0.0, EQUILIBRIUM - q[1], -1.2 - q[2]], 0.0)
        slack.append(stretch[2] == 0)
        gravity = pin.computeGeneralizedGravity(body, body.createData(), q)
        still = torque(mj, q, np.zeros(3), np.zeros(3))
        np.testing.assert_allclose(still, gravity - np.array([0.0, STIFFNESS, 1.0]) * stretch, rtol=1e-6, atol=1e-6)
    assert 0 < np.mean(slack) < 1


def recordings_of_two(folder: Path) -> Path:
    """A recording set of the paper's arm at rest in two files, of which the second lists a spring."""
    (folder / "set").mkdir()
    t = np.arange(200) / 100
    moved = {f"{kind}_joint{k + 1}": np.sin(t) for kind in ("q", "tau") for k in range(3)}
    for name in ("bare.csv", "sprung.csv"):
        write_csv(folder / "set" / name, {"t": t} | moved)
    spring = {"stiffness_Nm_per_rad": 10.0, "equilibrium_rad": 1.0}
    every = [{"file": "bare.csv"}, {"file": "sprung.csv", "springs": {"pea": {"joint2": spring}}}]
    header = {"format": "rrr_oc-recordings/1", "robot": "rrr", "joints": ["joint1", "joint2", "joint3"], "recordings": every}
    (folder / "set" / "recordings.json").write_text(json.dumps(header))
    return folder / "set"


def test_the_arm_as_it_was_in_a_recording_has_the_springs_that_this_lists_as_they_were_found(monkeypatch, tmp_path, capsys):
    terms = (
        replace(nominal_term(SpringStiffness((1,))).with_values(np.array([1.5])), recordings=("sprung.csv",)),
        nominal_term(DryFriction((2,))).with_values(np.array([0.7])),
    )
    model, folder = model_file(tmp_path, 3, terms), recordings_of_two(tmp_path)
    for name, stiffness in (("bare.csv", []), ("sprung.csv", [15.0])):
        out = tmp_path / name
        assert run(monkeypatch, model, "--recordings", folder, "--recording", name, "--json", "--out", out) == 0
        found = json.loads(capsys.readouterr().out)
        assert found["not_in_mjcf"] == []
        mj = mujoco.MjModel.from_xml_path(found["mjcf"])
        np.testing.assert_allclose(mj.tendon_stiffness, stiffness)
        np.testing.assert_allclose(mj.dof_frictionloss, [0.0, 0.0, 0.7])


DESIGN = ["--design", "{0}/summary.json", "--configuration", "PEA", "--task", "paper"]
MISTAKES = {
    "nothing": ([], {}, "nothing to export: a model.json, or --design with --configuration and --task, is required"),
    "no task": (DESIGN[:4], {}, "--task is missing: --design, --configuration, --task go together"),
    "no configuration": ([*DESIGN[:2], *DESIGN[4:]], {}, "--configuration is missing: --design"),
    "no such design": (["--design", "{0}/nowhere.json", *DESIGN[2:]], {}, "nowhere.json: cannot be read"),
    "other file": (["--design", "{model}", *DESIGN[2:]], {}, "key 'configurations' is missing"),
    "not solved": ([*DESIGN[:3], "BPEA", *DESIGN[4:]], {}, "unknown configuration 'BPEA'; allowed are PEA"),
    "other springs": (DESIGN, {"mounted": {"parallel_spring[joint1]": {"active": "below"}}}, "which task 'paper' does not offer so mounted"),
    "no value": (
        DESIGN,
        {"parameters": {"parallel_spring[joint2]": {"stiffness": 1.0}}},
        "configurations.PEA.parameters: parallel_spring[joint2]: equilibrium is missing",
    ),
    "no recording": (["{model}", "--recordings", "{set}"], {}, "--recording is missing; allowed are bare.csv, sprung.csv"),
    "other recording": (
        ["{model}", "--recordings", "{set}", "--recording", "x.csv"],
        {},
        "--recording is 'x.csv'; allowed are bare.csv, sprung.csv",
    ),
    "recording and design": (
        [*DESIGN, "--recording", "x.csv"],
        {},
        "--recordings and --recording go together, with a model.json and without --design",
    ),
    "recordings of other joints": (
        ["{two}", "--recordings", "{set}", "--recording", "bare.csv"],
        {},
        "the model has the joints joint1, joint2, but",
    ),
}  # fmt: skip


def test_a_model_of_some_joints_goes_with_a_design_of_all(monkeypatch, tmp_path, capsys):
    design = ["--design", saved(tmp_path), "--configuration", "PEA", "--task", "paper", "--json", "--out", tmp_path / "e"]
    assert run(monkeypatch, model_file(tmp_path, 2), *design) == 0
    found = json.loads(capsys.readouterr().out)
    said = "the model says nothing of joint3: links as the task has them, without friction and rotor inertia"
    assert said in found["not_in_mjcf"]
    assert mujoco.MjModel.from_xml_path(found["mjcf"]).dof_frictionloss.tolist() == [0.0, 0.7, 0.0]


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_one_sentence_and_leaves_no_file(mistake, monkeypatch, tmp_path, capsys):
    arguments, change, said = MISTAKES[mistake]
    saved(tmp_path, **change)
    folder = recordings_of_two(tmp_path)
    given = [a.format(tmp_path, model=model_file(tmp_path, 3), two=model_file(tmp_path, 2), set=folder) for a in arguments]
    assert run(monkeypatch, *given, "--out", tmp_path / "e") == 2
    printed = capsys.readouterr().err
    assert printed.startswith("Error: ")
    assert said in printed
    assert not (tmp_path / "e").exists()


def test_effects_of_the_arm_that_a_repaired_design_was_made_for_are_named(monkeypatch, tmp_path, capsys):
    summary = saved(tmp_path)
    content = json.loads(summary.read_text())
    content["configurations"]["PEA"]["parameters"]["payload_com[joint3]"] = {"x": 0.01}
    summary.write_text(json.dumps(content))
    options = ["--design", summary, "--configuration", "PEA", "--task", "paper", "--json", "--out", tmp_path / "e"]
    assert run(monkeypatch, *options) == 0
    left_out = json.loads(capsys.readouterr().out)["not_in_mjcf"]
    assert "payload_com[joint3]: the design was made for an arm that has it; give its model.json" in left_out


PAGE = (Path(__file__).resolve().parents[2] / "docs" / "export.md").read_text()
TOLD_IN = set(re.findall(r"`(\w+)`", " ".join(re.findall(r"^\| (`.*?) \|", PAGE.split("## What is in")[1], re.M))))


@pytest.mark.parametrize("name", CATALOGUE)
def test_the_documentation_says_which_effects_are_in_the_file(name):
    """Its table has those that are; the list below it those that are not."""
    kind, robot = CATALOGUE[name], load_robot("rrr")
    effect = kind({"arm": (), "pair": (1, 2)}.get(kind.placement, (1,)))
    effects = (ParallelSpring((1,)), effect) if "springs" in effect.inputs else (effect,)
    values = [[0.1 if q.name == "gap" else q.nominal for q in e.parameters] for e in effects]
    made = mjcf(Model(robot, robot.tool, effects), np.concatenate(values))
    assert (made.left_out == ()) is (name in TOLD_IN)
    assert f"`{name}`" in PAGE.split("## What is not")[name not in TOLD_IN]


def test_springs_beside_an_elastic_gear_are_left_out_as_the_documentation_says():
    robot = load_robot("rrr")
    for gives in ("joint_elasticity", "backlash"):
        gear, spring = CATALOGUE[gives]((2,)), ParallelSpring((1,))
        theta = [*(0.1 if q.name == "gap" else q.nominal for q in gear.parameters), 5.0, 1.0]
        assert len(mjcf(Model(robot, robot.tool, (gear, spring)), theta).left_out) == 1
