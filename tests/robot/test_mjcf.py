"""MJCF against MuJoCo: mass matrix, bias forces and positions of the robot that is read, and what cannot be read."""

import sys

import mujoco
import numpy as np
import pytest

from rrr_oc.cli import main
from rrr_oc.errors import UserError
from rrr_oc.recordings.reader import load_recordings
from rrr_oc.robot.rigid_body import rigid_body
from rrr_oc.robot.robot import load_robot
from validation.fuzz_inputs import MJCF as ARM

TIP = '<site name="attachment_site" pos="0.01 0.02 0.15"/>'


def _written(folder, text=ARM):
    path = folder / "arm.xml"
    path.write_text(text, encoding="utf-8")
    return path


def _compare(robot, mj, tip, states=20):
    """Greatest errors of the mass matrix, the bias forces and the position of the tool at random states."""
    data, body, rng = mujoco.MjData(mj), rigid_body(robot), np.random.default_rng(0)
    places, dofs = ([getattr(mj.joint(j), name)[0] for j in robot.joints] for name in ("qposadr", "dofadr"))
    worst = np.zeros(3)
    for _ in range(states):
        q, dq = rng.uniform(-2, 2, robot.n), rng.normal(size=robot.n)
        data.qpos[places], data.qvel[dofs] = q, dq
        mujoco.mj_forward(mj, data)
        mass = np.zeros((mj.nv, mj.nv))
        for i in range(mj.nv):
            mujoco.mj_mulM(mj, data, mass[i], np.eye(mj.nv)[i])

        def torque(ddq, q=q, dq=dq):
            return np.array(body.inverse_dynamics(q, dq, ddq, robot.inertial, robot.gravity)).ravel()

        bias = torque(np.zeros(robot.n))
        own = np.array([torque(one) - bias for one in np.eye(robot.n)])
        position = np.array(body.tool_position(q, robot.tool.position)).ravel()
        errors = own - mass[np.ix_(dofs, dofs)], bias - data.qfrc_bias[dofs], position - tip(data)
        worst = np.maximum(worst, [np.abs(e).max() for e in errors])
    return worst


def test_the_robot_is_mujocos(tmp_path):
    robot = load_robot(_written(tmp_path))
    text = ARM.replace('<mesh name="gone" file="gone.stl"/>', "").replace('<geom type="mesh" mesh="gone"/>', "")
    mj = mujoco.MjModel.from_xml_string(text.replace('<geom type="mesh" mesh="gone" material="grey"/>', ""))
    mj.dof_armature[:] = 0  # it stands on the drives' side here
    assert robot.joints == ("shoulder", "elbow", "wrist")
    assert robot.tool_link == "attachment_site"
    assert np.all(_compare(robot, mj, lambda data: data.site("attachment_site").xpos) < 1e-9)
    for link in ("upper", "fore", "bracket", "hand"):  # frames of bodies, also where the joint is elsewhere
        joint, pose = robot.frames[link]
        frame = np.linalg.multi_dot([np.eye(4), *robot.placements[: joint + 1], pose])
        data = mujoco.MjData(mj)
        data.qpos[:] = 0
        mujoco.mj_kinematics(mj, data)
        np.testing.assert_allclose(frame[:3, 3], data.body(link).xpos, atol=1e-12)
        np.testing.assert_allclose(frame[:3, :3].ravel(), data.body(link).xmat, atol=1e-12)


def test_limits_gravity_and_what_is_not_used(tmp_path):
    robot = load_robot(_written(tmp_path))
    np.testing.assert_allclose(np.degrees(robot.lower), [-100, -np.inf, -np.inf])
    np.testing.assert_allclose(np.degrees(robot.upper), [120, np.inf, np.inf])
    assert robot.effort.tolist() == [75.0, 60.0, np.inf]
    assert np.all(np.isinf(robot.velocity))
    assert robot.gravity.tolist() == [1, -0.5, -9]
    assert load_robot(tmp_path / "arm.xml", gravity=(0, 0, -1)).gravity.tolist() == [0, 0, -1]
    said = "\n".join(robot.notes)
    for what in ("armature to shoulder, elbow, wrist", "damping to", "dry friction to shoulder,", "a spring to elbow,"):
        assert what in said
    assert "gains of the actuators servo," in said
    assert "limits the torque of shoulder unevenly" in said


FINGERS = """<body name="left"><joint name="left" type="slide" axis="1 0 0"/><geom size="0.01" mass="0.1"/></body>
<body name="right"><joint name="right" type="slide" axis="1 0 0"/><geom size="0.01" mass="0.1"/></body>"""
LOOP = '<equality><connect name="loop" body1="{}" body2="{}" anchor="0 0 0"/></equality></mujoco>'


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({TIP: FINGERS}, "joint 'left' is slide; allowed are"),
        ({'<joint name="wrist" axis="1 0 0"/>': '<joint name="wrist" type="ball"/>'}, "joint 'wrist' is ball"),
        (
            {'<body name="base" pos="0.1 0.2 0.3" euler="0 90 20">': '<body name="base"><freejoint name="root"/>'},
            "'root' is free",
        ),
        (
            {
                TIP: '<body name="a"><joint name="a"/><geom size="1"/></body><body name="b"><joint name="b"/><geom size="1"/></body>'
            },
            "no serial chain: joint 'b' is attached to 'wrist'",
        ),
        (
            {"</worldbody>": '<body name="second"><joint name="second"/><geom size="1"/></body></worldbody>'},
            "'second' is attached to the base",
        ),
        ({"</mujoco>": LOOP.format("world", "hand")}, "'shoulder' is tied to others by the equality 'loop'"),
        (
            {"</mujoco>": '<tendon><fixed name="belt"><joint joint="elbow" coef="1"/></fixed></tendon></mujoco>'},
            "'elbow' is tied to others by the tendon 'belt'",
        ),
        ({"<inertial": "<inertia"}, "arm.xml: MuJoCo refuses it"),
        ({'mass="2"': 'mass="0"', 'mass="0.5"': 'mass="0"'}, "MuJoCo refuses it"),
    ],
)
def test_what_is_no_arm_is_named(tmp_path, change, told):
    text = ARM
    for old, new in change.items():
        assert old in text
        text = text.replace(old, new)
    with pytest.raises(UserError) as error:
        load_robot(_written(tmp_path, text))
    assert told in str(error.value)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (
            (' pos="0.01 0.02 0.2"', ' pos="0.01"'),
            "refuses it: attribute 'pos' does not have enough data, Element 'inertial', line 12",
        ),
        (("  </worldbody>", ""), "not well-formed XML: mismatched tag: line 31"),
        (('"gone.stl"/>', '"gone.stl">'), "not well-formed XML: mismatched tag: line 4"),
    ],
)
def test_what_mujoco_says_is_told_in_one_line(tmp_path, change, told):
    assert change[0] in ARM
    with pytest.raises(UserError) as error:
        load_robot(_written(tmp_path, ARM.replace(*change)))
    assert told in str(error.value)
    assert len(str(error.value).splitlines()) == 1


def test_a_warning_of_mujoco_does_not_come_beside_the_sentence(tmp_path):
    """Of a body so far away that its inertia is nearly singular; pytest makes an error of a warning."""
    assert 'pos="0 0 0.4" quat' in ARM
    with pytest.raises(UserError, match="'elbow'"):
        load_robot(_written(tmp_path, ARM.replace('pos="0 0 0.4" quat', 'pos="0 0 4e8" quat')))


def test_an_encoding_that_mujoco_does_not_read_is_told(tmp_path):
    (tmp_path / "arm.xml").write_bytes(f"<?xml version='1.0' encoding='utf-16'?>{ARM}".encode("utf-16"))
    with pytest.raises(UserError, match=r"arm\.xml: XML in UTF-8 is required; MuJoCo reads no other encoding"):
        load_robot(tmp_path / "arm.xml")


def test_a_gripper_is_held_still_where_its_joints_are_not_listed(tmp_path):
    joints = ("shoulder", "elbow", "wrist")
    text = ARM.replace(TIP, FINGERS).replace("</mujoco>", LOOP.format("left", "right"))
    robot = load_robot(_written(tmp_path, text), joints)
    alone = load_robot(_written(tmp_path), joints)
    assert robot.joints == joints
    assert robot.inertial[0, 2] == pytest.approx(alone.inertial[0, 2] + 0.2, abs=1e-12)


def test_an_actuator_without_gear_says_nothing_of_a_torque(tmp_path, recwarn):
    """As a torque limit of 0 in a URDF; whatever its force is, an endless one too."""
    text = ARM.replace('gear="-30" ctrlrange="-2 2"', 'gear="0"')
    robot = load_robot(_written(tmp_path, text))
    assert np.isinf(robot.effort[robot.joints.index("elbow")])
    assert not recwarn.list


def test_a_body_without_end_is_refused(tmp_path):
    text = ARM.replace('<geom class="light" type="box" size="0.03 0.04 0.2" pos="0 0.01 0.2" mass="2"/>', "")
    text = text.replace('<body name="bracket"', '<geom size="0.05" density="inf"/><body name="bracket"')
    with pytest.raises(UserError, match=r"arm.xml: body 'fore' has the mass .* kg; finite masses are required"):
        load_robot(_written(tmp_path, text))


def test_commands_read_mjcf_and_sets_hold_it_as_urdf(tmp_path, capfd, monkeypatch):
    path = _written(tmp_path, ARM.replace("1 -0.5 -9", "0 0 -9.81"))
    monkeypatch.setattr(sys, "argv", ["rrr-oc", "init", str(path), "--out", str(tmp_path / "set")])
    with pytest.raises(SystemExit) as ended:
        main()
    assert not ended.value.code
    assert "gives armature to" in capfd.readouterr().err
    assert (tmp_path / "set" / "arm.urdf").is_file()
    header = tmp_path / "set" / "recordings" / "recordings.json"
    header.write_text(header.read_text().replace("../arm.urdf", "../../arm.xml"))
    rows = "\n".join(",".join([f"{0.01 * k}", *[f"{0.1 + 0.001 * k}"] * 6]) for k in range(20))
    names = ("shoulder", "elbow", "wrist")
    head = ",".join(["t", *(f"q_{j}" for j in names), *(f"tau_{j}" for j in names)])
    (header.parent / "first.csv").write_text(f"{head}\n{rows}\n")
    read = load_recordings(header.parent)
    own, copy = read.robot, load_robot(tmp_path / "set" / "arm.urdf")
    np.testing.assert_array_equal(own.inertial, copy.inertial)
    np.testing.assert_array_equal(own.placements, copy.placements)
    assert own.notes == copy.notes
    assert any("armature" in note for note in read.notes)


NAMED_ALIKE = """<mujoco><worldbody>
  <body name="shoulder"><joint name="shoulder" axis="0 1 0" range="-1 1"/><geom size="0.05" mass="1"/>
    <body name="gripper" pos="0.3 0 0"><joint name="elbow" axis="0 1 0"/><geom size="0.05" mass="2"/>
      <body name="jaw" pos="0.3 0 0"><joint name="{0}" axis="0 1 0" range="0.2 1"/><geom size="0.05" mass="0.5"/>
</body></body></body></worldbody><compiler angle="radian"/></mujoco>"""


@pytest.mark.parametrize("name", ["gripper", "world", "jaw", "shoulder_of_mine"])
def test_joints_may_have_the_names_of_bodies(tmp_path, name):
    """Desktop arms name joints and bodies alike; the last joint is kept, or locked in the middle of its range, which lacks 0."""
    path = tmp_path / "arm.xml"
    path.write_text(NAMED_ALIKE.format(name))
    assert load_robot(path).joints == ("shoulder", "elbow", name)
    locked = load_robot(path, ["shoulder", "elbow"])
    np.testing.assert_allclose(locked.inertial[0], [1, 2.5])
    assert locked.held == pytest.approx({name: 0.6})
