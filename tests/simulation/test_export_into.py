"""A model's numbers written into a user's MJCF, read again by MuJoCo."""

import json
import re
import sys
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from recorded import real

from rrr_oc import cli
from rrr_oc.calibration.calibrated_model import CalibratedModel, nominal_term
from rrr_oc.calibration.model_file import save_model
from rrr_oc.effects.body.payload_com import PayloadCom
from rrr_oc.effects.elastic.biarticular_spring import BiarticularSpring
from rrr_oc.effects.elastic.cable_harness import CableHarness
from rrr_oc.effects.friction.dry_friction import DryFriction
from rrr_oc.effects.friction.quadratic_drag import QuadraticDrag
from rrr_oc.effects.friction.stribeck import Stribeck
from rrr_oc.effects.friction.viscous_friction import ViscousFriction
from rrr_oc.effects.sensor.encoder_offset import EncoderOffset
from rrr_oc.effects.transmission.armature import Armature
from rrr_oc.effects.transmission.torque_ripple import TorqueRipple
from rrr_oc.errors import UserError
from rrr_oc.model.symbolic_model import Model
from rrr_oc.robot.robot import Robot, load_robot, urdf_text
from rrr_oc.simulation.export_into import check_into, into

# Degrees, defaults that would change what is added, a joint away from its body's origin, a fixed body with mass, a mesh in a folder
ARM = """<!-- before -->
<mujoco model="arm">
  <compiler angle="degree" meshdir="meshes"/>
  <option gravity="0 0 -9.81" timestep="0.002"/>
  <asset><mesh name="case" file="case.stl"/></asset>
  <default>
    <joint damping="2 0.5" armature="0.1" frictionloss="0.2"/>
    <general gear="50" ctrlrange="-1 1" forcerange="-3 3"/>
    <tendon damping="3" limited="true" range="-1 1"/>
  </default>
  <worldbody>
    <light pos="0 0 3"/>
    <body name="upper" pos="0 0 0.1" euler="10 20 30">
      <joint name="shoulder" axis="0 1 1" range="-100 120"/>
      <inertial pos="0.01 0.02 0.2" mass="4" fullinertia="0.05 0.06 0.03 0.001 0.002 -0.003"/>
      <geom type="mesh" mesh="case"/>
      <body name="fore" pos="0 0 0.4" quat="0.8 0.6 0 0">
        <!-- the elbow -->
        <joint name="elbow" axis="0 1 0" pos="0.03 0 0.02"/>
        <geom type="box" size="0.03 0.04 0.2" pos="0 0.01 0.2" mass="2"/>
        <body name="bracket" pos="0 0 0.1" euler="0 0 45"><geom size="0.05" mass="0.5" pos="0.1 0 0"/></body>
      </body>
    </body>
  </worldbody>
  <actuator><position name="servo" joint="shoulder" kp="100"/></actuator>
  <keyframe><key name="home" qpos="0.1 0.2"/></keyframe>
</mujoco>
"""
OF_JOINTS = {"dry": [1.5, 0.25], "viscous": [1 / 3, 0.5], "armature": [0.3, 1 / 7]}
EFFECTS = (
    *(DryFriction((j,)) for j in range(2)), *(ViscousFriction((j,)) for j in range(2)), *(Armature((j,)) for j in range(2)),
    QuadraticDrag((0,)), BiarticularSpring((0, 1)), CableHarness((1,)), TorqueRipple((0,)), Stribeck((1,)), PayloadCom(()),
)  # fmt: skip
THETA = np.array(
    [*OF_JOINTS["dry"], *OF_JOINTS["viscous"], *OF_JOINTS["armature"],
     0.1, 20 / 3, 2 / 3, -0.3, 4.0, 1 / 3, 0.7, 5.0, 0.3, 0.4, 0.3, 0.01, 0.02, 0.03]
)  # fmt: skip


@pytest.fixture
def user(tmp_path):
    path = tmp_path / "user" / "arm.xml"
    path.parent.mkdir()
    path.write_text(ARM)
    return path


def heavier(robot: Robot) -> Robot:
    """Links that are not those of the file."""
    return replace(robot, inertial=robot.inertial * np.array([0.9, 1.25]))


def without_looks(text: str) -> mujoco.MjModel:
    """The file without its mesh, which is not there."""
    return mujoco.MjModel.from_xml_string(re.sub(r'<(geom type="mesh"|mesh name)[^>]*/>', "", text))


def test_the_file_needs_the_torques_of_the_model(user, tmp_path):
    """At random states, against the model's own laws; friction by bristles is 0 there, before anything moved."""
    robot = heavier(load_robot(user))
    model = Model(robot, robot.tool, EFFECTS)
    made = into(user, tmp_path / "new.xml", model, THETA, 1.5)
    assert made.left_out == ()
    (tmp_path / "new.xml").write_text(made.text)
    check_into(tmp_path / "new.xml", model, THETA, 1.5)
    mj = without_looks(made.text)
    data, rng = mujoco.MjData(mj), np.random.default_rng(0)
    widths = np.array([1e-9 if e.width.unit == "rad/s" else 0.0 for e in EFFECTS if e.width is not None])
    silent = np.array([0.0 if p.name == "excess" else x for p, x in zip(model.parameters, THETA, strict=True)])
    for q, dq, ddq in rng.uniform(-1.0, 1.0, (20, 3, 2)):
        law = np.array(model.motor_inverse(q, dq, ddq, 0.0, 1.5, silent, widths, robot.inertial)[0]).reshape(-1)
        data.qpos[:], data.qvel[:], data.qacc[:] = q, dq, ddq
        mujoco.mj_inverse(mj, data)
        own = np.array([0.7 * np.sin(5.0 * q[0] + 0.3), 0.0])  # of the ripple, which is an actuator and no passive force
        dry = np.array(OF_JOINTS["dry"]) * np.sign(dq)  # of the friction loss, a constraint
        inverse = data.qfrc_inverse + data.qfrc_constraint
        np.testing.assert_allclose(inverse - own + dry, law, rtol=1e-7, atol=1e-7)


def test_everything_else_is_kept(user, tmp_path):
    robot = load_robot(user)
    text = into(user, tmp_path / "new.xml", Model(robot, robot.tool, EFFECTS[:6]), THETA[:6]).text
    for kept in (
        "<!-- before -->",
        "<!-- the elbow -->",
        "<light",
        'name="home"',
        'name="servo"',
        'euler="10 20 30"',
        'angle="degree"',
    ):
        assert kept in text
    assert 'meshdir="user/meshes"' in text
    same = set(ARM.splitlines()) & set(text.splitlines())
    assert (
        len(same) >= len(set(ARM.splitlines())) - 4
    )  # the settings with the folder, two joints, and where springs would be added
    before, after = map(without_looks, (ARM, text))
    for name in (
        "body_mass",
        "body_inertia",
        "body_pos",
        "jnt_range",
        "geom_size",
        "key_qpos",
        "actuator_gainprm",
        "actuator_gear",
    ):
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name))
    np.testing.assert_allclose(after.dof_damping, OF_JOINTS["viscous"], rtol=1e-15)
    np.testing.assert_array_equal(after.dof_dampingpoly, 0.0)  # the file's default had some


def test_an_arm_that_is_elsewhere_is_refused(user, tmp_path):
    robot = load_robot("rrr")
    with pytest.raises(UserError, match="no joint"):
        into(user, tmp_path / "new.xml", Model(robot, robot.tool, ()), np.zeros(0))
    moved = load_robot(user)
    moved = replace(moved, placements=moved.placements + 0.01 * (np.arange(2) == 1)[:, None, None] * np.eye(4)[3])
    with pytest.raises(UserError, match="joint 'elbow' is not where the model has it"):
        into(user, tmp_path / "new.xml", Model(moved, moved.tool, ()), np.zeros(0))


def test_a_body_that_cannot_be_is_refused(user, tmp_path):
    """The bracket that is fixed to the fore keeps its mass, and the fore would have less than none."""
    robot = load_robot(user)
    lighter = replace(robot, inertial=robot.inertial * np.array([1.0, 0.1]))
    with pytest.raises(UserError, match="body 'fore' is one that no body can have"):
        into(user, tmp_path / "new.xml", Model(lighter, robot.tool, ()), np.zeros(0))


def test_settings_of_the_file_that_override_what_is_written_are_told(user, tmp_path):
    text = ARM.replace('angle="degree"', 'angle="degree" inertiafromgeom="true"')
    user.write_text(text.replace('<geom type="mesh" mesh="case"/>', '<geom size="0.1"/>'))
    robot = heavier(load_robot(user))
    model = Model(robot, robot.tool, ())
    (tmp_path / "new.xml").write_text(into(user, tmp_path / "new.xml", model, np.zeros(0)).text)
    with pytest.raises(UserError, match="links were read again with other masses"):
        check_into(tmp_path / "new.xml", model, np.zeros(0))


def test_joints_of_included_files_are_refused(tmp_path):
    (tmp_path / "inner.xml").write_text(ARM.replace("<!-- before -->\n", ""))
    (tmp_path / "outer.xml").write_text('<mujoco><include file="inner.xml"/></mujoco>')
    robot = load_robot(tmp_path / "outer.xml")
    with pytest.raises(UserError, match="joint 'shoulder' does not stand in this file itself"):
        into(tmp_path / "outer.xml", tmp_path / "new.xml", Model(robot, robot.tool, ()), np.zeros(0))


def test_a_leg_of_a_real_quadruped(tmp_path):
    """A floating base, classes of defaults, meshes that are not there and key frames."""
    file = real("go2_legs") / "go2.xml"
    robot = heavier_legs(load_robot(file, [f"FL_{name}_joint" for name in ("hip", "thigh", "calf")]))
    model = Model(robot, robot.tool, (DryFriction((0,)), CableHarness((2,)), TorqueRipple((1,))))
    theta = np.array([0.3, 7.0, -1.5, 0.2, 5.0, 0.1])
    made = into(file, tmp_path / "new.xml", model, theta, 0.5)
    (tmp_path / "new.xml").write_text(made.text)
    check_into(tmp_path / "new.xml", model, theta, 0.5)
    assert made.left_out == ()
    assert "FR_calf_joint" in made.text


def heavier_legs(robot: Robot) -> Robot:
    return replace(robot, inertial=1.1 * robot.inertial)


def test_what_would_change_the_joints_is_named(user, tmp_path):
    robot = load_robot(user)
    made = into(user, tmp_path / "new.xml", Model(robot, robot.tool, (EncoderOffset((1,)), EFFECTS[0])), np.array([0.1, 1.0]))
    assert made.left_out == ("encoder_offset[elbow]: the zeros of the file's joints stay as they are",)


@pytest.mark.parametrize("own", ["", ' stiffness="3"'])
def test_the_command_writes_the_file_and_says_what_is_not_in_it(own, user, tmp_path, monkeypatch, capsys):
    user.write_text(ARM.replace(' pos="0.03 0 0.02"', ' pos="0.03 0 0.02"' + own))
    robot, nothing = load_robot(user), np.zeros(2)
    terms = (nominal_term(DryFriction((1,))).with_values(np.array([0.7])),)
    arm = CalibratedModel(robot, "urdf", urdf_text(user), robot.tool, "motor", (None, None), "nominal", terms, nothing, nothing)
    save_model(arm, tmp_path / "model.json")
    call = ["rrr-oc", "export", tmp_path / "model.json", "--into", user, "--out", tmp_path / "e", "--json"]
    monkeypatch.setattr(sys, "argv", list(map(str, call)))
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert not ended.value.code
    found = json.loads(capsys.readouterr().out)
    assert found["into"] == str(tmp_path / "e" / "arm_with_model.xml")
    said = ["the file's own stiffness of elbow, 3 Nm/rad, is not the model's and stays"]
    assert found["not_in_into"] == (said if own else [])
    np.testing.assert_allclose(without_looks((tmp_path / "e" / "arm_with_model.xml").read_text()).dof_frictionloss, [0.0, 0.7])
