# pyright: reportAttributeAccessIssue=false
# (pinocchio has no stubs)
"""What is read from a URDF, and what is turned away at the door and with which words."""

import re
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from chains import arm, joint, link, random_chain, robot

from rrr_oc.errors import UserError
from rrr_oc.robot.rigid_body import rigid_body
from rrr_oc.robot.robot import BUNDLED, load_robot

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def load(tmp_path):
    def from_text(text: str, **options):
        path = tmp_path / "arm.urdf"
        path.write_text(text)
        return load_robot(path, **options)

    return from_text


@pytest.mark.parametrize("name", BUNDLED)
def test_bundled_robots(name):
    """The copy inside the package is the one in models/, and stands as drawn: joint 1 upright, 2 and 3 about −y."""
    found = load_robot(name)
    assert (ROOT / "models/urdf" / f"{name}.urdf").read_bytes() == (ROOT / "rrr_oc/urdf" / f"{name}.urdf").read_bytes()
    assert found.joints == ("joint1", "joint2", "joint3")
    assert found.links == ("link1", "link2", "link3")
    np.testing.assert_allclose(found.axes, [[0, 0, 1], [0, -1, 0], [0, -1, 0]], atol=1e-15)
    np.testing.assert_array_equal(found.gravity, [0, 0, -9.81])


@pytest.mark.parametrize("joints", [1, 6, 7])
def test_everything_of_a_chain(load, joints):
    """Against Pinocchio's reading of the same text."""
    text = random_chain(joints, joints)
    found, model = load(text), pin.buildModelFromXML(text)
    assert found.name == "arm"
    assert found.n == joints
    assert found.joints == tuple(f"j{i + 1}" for i in range(joints))
    assert found.links == tuple(f"l{i + 1}" for i in range(joints))
    np.testing.assert_allclose(found.placements, [p.homogeneous for p in list(model.jointPlacements)[1:]], atol=1e-15)
    np.testing.assert_allclose(np.linalg.norm(found.axes, axis=1), 1, atol=1e-15)
    for i in range(joints):
        inertia = model.inertias[i + 1]
        np.testing.assert_allclose(found.inertial[:, i], inertia.toDynamicParameters(), atol=1e-15)
        second = inertia.inertia - inertia.mass * pin.skew(inertia.lever) @ pin.skew(inertia.lever)  # Steiner, by hand
        np.testing.assert_allclose(found.inertial[4:, i], second[[0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]], atol=1e-13)
    np.testing.assert_array_equal((found.lower, found.upper), (np.full(joints, -2), np.full(joints, 2)))
    np.testing.assert_array_equal((found.velocity, found.effort), (np.full(joints, 3), np.full(joints, 50)))
    assert found.tool.joint == joints - 1
    np.testing.assert_allclose(found.tool.position, model.frames[model.getFrameId("tool")].placement.translation, atol=1e-15)


def test_without_a_tool_frame_the_tool_is_at_the_end_of_the_last_link(load):
    """A payload at the joint itself would be seen by no torque of it."""
    np.testing.assert_allclose(load(arm(2)).tool.position, [0.2, 0, 0], atol=1e-15)  # its centre is half as far


def test_continuous_joints_have_no_range_but_one_coordinate(load):
    """With limits of speed and effort, and without a <limit> at all; the dynamics are those of a revolute joint."""
    bounded = '<limit effort="5" velocity="2"/>'
    parts = [link("base", 0), link("l1"), link("l2"), joint("j1", "base", "l1", "continuous", bounded)]
    found = load(robot(*parts, joint("j2", "l1", "l2", "continuous", "")))
    assert found.n == 2
    np.testing.assert_array_equal(found.lower, [-np.inf, -np.inf])
    np.testing.assert_array_equal(found.upper, [np.inf, np.inf])
    np.testing.assert_array_equal(found.velocity, [2, np.inf])
    np.testing.assert_array_equal(found.effort, [5, np.inf])
    revolute = load(arm(2))
    np.testing.assert_array_equal(found.axes, revolute.axes)
    np.testing.assert_allclose(found.placements, revolute.placements, atol=1e-15)
    np.testing.assert_allclose(found.inertial, revolute.inertial, atol=1e-15)


def test_locked_joints(load):
    """Dynamics with joints locked at zero are those of the whole chain with them at zero and still."""
    text = random_chain(5, 5)
    whole, part = load(text), load(text, joints=["j2", "j3", "j5"])
    kept = [1, 2, 4]
    assert part.joints == ("j2", "j3", "j5")
    assert part.links == ("l2", "l3", "l5")
    q, dq, ddq = np.random.default_rng(0).normal(size=(3, 3))
    full = [np.zeros(5) for _ in range(3)]
    for vector, values in zip(full, (q, dq, ddq), strict=True):
        vector[kept] = values
    expected = np.array(rigid_body(whole).inverse_dynamics(*full, whole.inertial, whole.gravity)).ravel()[kept]
    found = np.array(rigid_body(part).inverse_dynamics(q, dq, ddq, part.inertial, part.gravity)).ravel()
    np.testing.assert_allclose(found, expected, atol=1e-11)  # rounding
    tips = [rigid_body(r).tool_position(v, r.tool.position) for r, v in ((whole, full[0]), (part, q))]
    np.testing.assert_allclose(np.array(tips[1]), np.array(tips[0]), atol=1e-13)
    np.testing.assert_array_equal(load(text, joints=whole.joints).inertial, whole.inertial)  # all of them: the same robot


def test_a_point_on_a_fixed_link_moves_with_the_joint_before_it(load):
    parts = [link("base", 0), link("l1"), link("hand"), link("l2"), joint("j1", "base", "l1")]
    parts += [
        joint("weld", "l1", "hand", "fixed", "", xyz="0.1 0.2 0.3", rpy="0 0 1.5707963267948966"),
        joint("j2", "hand", "l2"),
    ]
    found = load(robot(*parts))
    assert found.links == ("l1", "l2")
    point = found.point("hand", [1, 0, 0])
    assert point.joint == 0
    np.testing.assert_allclose(point.position, [0.1, 1.2, 0.3], atol=1e-12)  # x of the hand is y of the link
    np.testing.assert_allclose(found.inertial[0], [2, 1], rtol=1e-15)  # the hand's mass counts with the link it is fixed to


def test_masses_are_not_needed_where_they_are_not_used(load):
    text = robot(link("base", 0), link("l1", 0), joint("j1", "base", "l1"))
    assert load(text, inertial=False).n == 1
    with pytest.raises(UserError, match="link 'l1', moved by joint 'j1', has no <inertial>"):
        load(text)


@pytest.mark.parametrize(
    ("inside", "said"),
    [
        (
            "<inertial><inertia ixx='1' iyy='1' izz='1' ixy='0' ixz='0' iyz='0'/></inertial>",
            "has an <inertial> without the mass",
        ),
        ("<inertial><mass/><inertia ixx='1' iyy='1' izz='1' ixy='0' ixz='0' iyz='0'/></inertial>", "without the mass"),
        ("<inertial><mass value='2'/></inertial>", "has an <inertial> without the moments"),
        ("", "has no <inertial>"),
    ],
)
def test_a_mass_that_is_missing_is_not_said_to_be_0_kg(load, inside, said):
    links = (link("base", 0), f"<link name='l1'>{inside}</link>")
    text = robot(*links, joint("j1", "base", "l1"))
    with pytest.raises(UserError, match=f"link 'l1', moved by joint 'j1', .*{said}") as error:
        load(text)
    assert "0 kg" not in str(error.value)
    assert load(text, inertial=False).n == 1
    hand = robot(*links, link("hand"), joint("j1", "base", "l1"), joint("grip", "l1", "hand", "fixed"))
    if inside:  # what the hand weighs does not make up for it
        with pytest.raises(UserError, match="link 'l1'"):
            load(hand)
    else:
        assert load(hand).inertial[0, 0] > 0


def test_limits_that_are_missing_are_said_of_joints_that_do_not_move_too(load):
    full = arm(3)
    assert load(full).notes == ()
    limits = re.findall("<limit[^>]*>", full)
    assert len(limits) == 3
    head, _, tail = full.rpartition(limits[2])
    text = head + '<limit effort="5" velocity="0"/>' + tail
    notes = load(text, joints=["j1", "j2"]).notes
    assert [note.partition(":")[0] for note in notes] == ["the URDF gives no range of j3", "the URDF gives no speed of j3"]
    whole = load(text)
    assert (whole.lower[2], whole.upper[2]) == (-np.inf, np.inf)
    assert (whole.lower[1], whole.upper[1]) == (-2, 2)
    endless = text.replace('type="revolute"', 'type="continuous"').replace("type='revolute'", "type='continuous'")
    (speed,) = load(endless).notes
    assert speed.startswith("the URDF gives no speed of j3")


def test_a_torque_limit_of_0_is_none(load):
    """Of revolute and endless joints alike; files are made so where nobody knows the limit."""
    text = arm(2).replace('effort="50"', 'effort="0"')
    for kind in ("revolute", "continuous"):
        found = load(text.replace("revolute", kind, 1))
        np.testing.assert_array_equal(found.effort, [np.inf, np.inf])
        (note,) = found.notes
        assert note == "the URDF gives no limit of torque of j1, j2: 'effort' of <limit> is 0"


def test_names_and_points_that_are_not_there(load):
    found = load(arm(2))
    assert found.index("j2") == 1
    with pytest.raises(UserError, match="no joint 'elbow'; it has j1, j2"):
        found.index("elbow")
    with pytest.raises(UserError, match="no link 'hand'; it has base, l1, l2"):
        found.point("hand", [0, 0, 0])
    with pytest.raises(UserError, match=r"link 'base' .* does not move; a tool needs one of l1, l2"):
        found.point("base", [0, 0, 0])
    for position in ([0, 0], [0, 0, np.nan], [0, np.inf, 0]):
        with pytest.raises(UserError, match="three finite numbers"):
            found.point("l1", position)


def test_missing_and_unreadable_files(tmp_path):
    with pytest.raises(
        UserError, match=r"no robot at .*nothing\.urdf.*give the path of a URDF or MJCF, or one of rrr, rrr_prototype"
    ):
        load_robot(tmp_path / "nothing.urdf")
    with pytest.raises(UserError, match="no robot at"):
        load_robot(tmp_path)  # a folder
    binary = tmp_path / "mesh.stl"
    binary.write_bytes(b"\x80\x81\xff\xfe\x00")
    with pytest.raises(UserError, match="not a text file"):
        load_robot(binary)


BRANCH = [link("base", 0), link("l1"), link("l2"), link("l3"), joint("j1", "base", "l1"), joint("j2", "l1", "l2")]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "not well-formed XML"),
        ("<robot><link name='a'></robot>", "not well-formed XML: mismatched tag"),
        ("<mujoco/>", "the outer element is <mujoco>; a URDF has <robot>"),
        ("<robot name='a'/>", "not a usable URDF"),
        (robot(link("base")), "has no revolute joint"),
        (robot(link("base"), link("l1"), joint("j1", "base", "l1", "fixed", "")), "has no revolute joint"),
        (arm(3, {2: "prismatic"}), "joint 'j2' is prismatic; allowed are revolute, continuous and fixed"),
        (arm(3, {1: "floating"}), "joint 'j1' is floating"),
        (arm(3, {1: "planar"}), "joint 'j1' is planar"),
        (arm(3, {1: "revolut"}), "joint 'j1' is revolut;"),
        (arm(1).replace(' type="revolute"', ""), "joint 'j1' has no type; allowed are revolute"),
        (
            robot(*BRANCH, joint("j3", "l1", "l3")),
            "no serial chain: joint 'j3' is attached to 'j1'; branches are not supported",
        ),
        (robot(*BRANCH[:2], BRANCH[4], joint("j2", "l1", "l2")), "not a usable URDF"),
        (robot(link("base", 0), link("l1"), joint("j1", "base", "l1", inside="")), "joint 'j1' has no <limit>"),
        (arm(2).replace('velocity="3"/>', 'velocity="3"/><mimic joint="j2"/>', 1), "joint 'j1' mimics another"),
        (arm(2).replace('<axis xyz="0 -1 0"/>', '<axis xyz="0 0 0"/>', 1), "has the axis '0 0 0'; three numbers"),
        (arm(2).replace('<axis xyz="0 -1 0"/>', '<axis xyz="0 1e-300 0"/>', 1), "has the axis '0 1e-300 0'; three numbers"),
        (
            arm(2).replace('velocity="3"', 'velocity="fast"', 1),
            "line 13: joint 'j1' has <limit velocity='fast'>; a finite number with a decimal point is required",
        ),
        (
            arm(2).replace('lower="-2" upper="2"', 'lower="2" upper="-2"', 1),
            "line 13: joint 'j1' has crossed limits: lower 2 is above upper -2 rad",
        ),
        (arm(2).replace('effort="50"', 'effort="-50"', 1), "line 13: joint 'j1' has the limit effort='-50'; 0 or more"),
        (arm(2).replace(' velocity="3"', "", 1), "line 12: joint 'j1' makes it not a usable URDF: .*limit has no velocity"),
        (100 * "<robot>" + "<a>", "elements stand within each other 101 deep; 100 are allowed"),
        (
            robot(link("base", 0), link("l1", -1.0), joint("j1", "base", "l1")),
            "line 5: link 'l1' has the mass -1 kg; 0 or more",
        ),
        (robot(link("base", 0), link("l1").replace('"1.0"', '"0"'), joint("j1", "base", "l1")), "has mass 0 kg"),
        (robot(link("base", 0), link("l1", 1.0, (1, 1, 3)), joint("j1", "base", "l1")), "none above the sum of the other two"),
        (robot(link("base", 0), link("l1", 1.0, (-1, 2, 2)), joint("j1", "base", "l1")), "must be positive"),
    ],
)
def test_robots_that_are_turned_away(load, text, message):
    with pytest.raises(UserError, match=message):
        load(text)


@pytest.mark.parametrize("number", ["0,5", "nan", "inf", "1e400", "", "1_0", "٣", "0x10"])
@pytest.mark.parametrize(("element", "key", "line"), [("mass", "value", 12), ("inertia", "ixx", 13)])
@pytest.mark.parametrize("inertial", [True, False])
def test_a_number_that_is_none_does_not_become_0(load, number, element, key, line, inertial):
    """In the tool, whose mass counts with the link that it is fixed to; also where masses are not trusted."""
    hand = link("hand").replace('mass value="1.0"', f'mass value="{number}"' if element == "mass" else 'mass value="1.0"')
    hand = hand.replace('ixx="0.02"', f'ixx="{number}"') if element == "inertia" else hand
    text = robot(link("base", 0), link("l1"), joint("j1", "base", "l1"), hand, joint("grip", "l1", "hand", "fixed", ""))
    with pytest.raises(UserError, match=f"robot 'arm', line {line}: link 'hand' has <{element} {key}={number!r}>; a finite"):
        load(text, inertial=inertial)


def test_an_inertia_without_one_of_its_moments_is_turned_away(load):
    with pytest.raises(UserError, match="line 6: link 'l1' has an <inertia> without 'iyy'; ixx, ixy, ixz, iyy, iyz, izz are"):
        load(arm(1).replace('iyy="0.03"', ""))


def test_blanks_around_numbers_and_what_is_only_seen_do_no_harm(load):
    found = load(
        arm(1)
        .replace('"0.3 0 0"', '" 0.3\t0\n0 "')
        .replace('e="1.0"', 'e=" 1.0 "')
        .replace("<inertial>", "<visual/><inertial>")
    )
    np.testing.assert_array_equal(found.inertial, load(arm(1)).inertial)


def test_an_impossible_inertia_of_a_part_is_said(load):
    """Real arms have such parts; the body that moves is a possible one."""
    parts = link("base", 0), link("l1"), joint("j1", "base", "l1"), link("hand", 1.0, (0.001, 0.001, 0.01))
    (note,) = load(robot(*parts, joint("grip", "l1", "hand", "fixed", ""))).notes
    assert note.startswith("line 13 of the URDF gives link 'hand' the principal moments of inertia 0.001, 0.001, 0.01 kg m²")


def test_many_comments_before_the_robot_take_no_time(load):
    """A search for <mujoco> that goes back and forth between them would take hours."""
    assert load("<?xml version='1.0'?>\n" + 40 * "<!-- a -->\n" + arm(1).partition("?>")[2]).n == 1


def test_joints_of_any_type_may_be_left_out(load):
    """A gripper's fingers, one of which mimics the other, are locked at zero as revolute joints are."""
    fingers = [link("f1", 0.1), link("f2", 0.1)]
    kinds = {"prismatic": "<axis xyz='0 1 0'/><limit lower='0' upper='1' effort='1' velocity='1'/>", "fixed": ""}
    mimic = "<mimic joint='g1'/>"
    arms = []
    for kind, inside in kinds.items():
        other = inside + (mimic if kind == "prismatic" else "")
        both = [joint("g1", "l2", "f1", kind, inside), joint("g2", "l2", "f2", kind, other)]
        arms.append(load(arm(2).replace("</robot>", "".join([*fingers, *both]) + "</robot>"), joints=["j1", "j2"]))
    np.testing.assert_allclose(arms[0].inertial, arms[1].inertial, atol=1e-12)
    with pytest.raises(UserError, match="joint 'g1' is prismatic"):
        load(arm(2).replace("</robot>", fingers[0] + joint("g1", "l2", "f1", "prismatic", kinds["prismatic"]) + "</robot>"))


def test_of_several_tool_frames_the_one_that_is_called_so(load):
    fixed = "".join(
        link(name, 0) + joint(f"to_{name}", "l2", name, "fixed", f"<origin xyz='{x} 0 0'/>")
        for name, x in (("camera", 0.1), ("tool0", 0.3), ("wrist_cover", 0.05))
    )
    found = load(arm(2).replace("</robot>", fixed + "</robot>"))
    assert found.tool_link == "tool0"
    assert found.tool.position[0] == pytest.approx(0.3)


def test_a_urdf_may_declare_its_encoding(tmp_path):
    path = tmp_path / "arm.urdf"
    text = arm(2).replace('<?xml version="1.0"?>', '<?xml version="1.0" encoding="ISO-8859-1"?><!-- für -->')
    path.write_bytes(text.encode("latin-1"))
    assert load_robot(path).joints == ("j1", "j2")


@pytest.mark.parametrize(
    ("joints", "message"),
    [
        (["j1", "hip"], "no joint 'hip'; it has j1, j2, j3"),
        (["j2", "j1"], "j2, j1 are not in the order of the chain: j1, j2, j3"),
        (["j1", "j1"], "not in the order"),
        ([], "no revolute joint"),
    ],
)
def test_joints_that_cannot_be_kept(load, joints, message):
    with pytest.raises(UserError, match=message):
        load(arm(3), joints=joints)


NAMES = {"of an earlier link": "l1", "of the base": "base", "of its own link": "l2"}


@pytest.mark.parametrize("joints", [["j1"], None, "the other"])
@pytest.mark.parametrize("name", NAMES.values(), ids=NAMES)
def test_a_joint_may_have_the_name_of_a_link(load, name, joints):
    """Locked, kept, or the only one kept: the same robot as where it has a name of its own."""
    own = arm(2)
    found = load(own.replace('joint name="j2"', f'joint name="{name}"'), joints=[name] if joints == "the other" else joints)
    expected = load(own, joints=["j2"] if joints == "the other" else joints)
    assert found.joints == tuple(name if joint == "j2" else joint for joint in expected.joints)
    np.testing.assert_array_equal(found.inertial, expected.inertial)
    np.testing.assert_array_equal(found.placements, expected.placements)


UNUSED = {
    "a safety controller": '<safety_controller k_velocity="2000000" k_position="stiff"/>',
    "large damping": '<dynamics damping="5e6" friction=""/>',
    "an angle of calibration": '<calibration rising="nan"/>',
}


@pytest.mark.parametrize("unused", UNUSED.values(), ids=UNUSED)
def test_a_number_that_is_not_used_is_not_checked(load, unused):
    text = arm(2)
    found = load(text.replace("</joint>", f"{unused}</joint>"))
    np.testing.assert_array_equal(found.inertial, load(text).inertial)


def test_what_a_fixed_joint_says_beyond_its_place_is_not_used(load):
    """Real grippers have fixed joints that mimic another; a robot may be without a name."""
    inside = '<mimic joint="j1"/><limit lower="?"/><axis xyz="0 0 0"/>'
    text = arm(2).replace("</robot>", link("f", 0.1) + joint("g", "l2", "f", "fixed", inside) + "</robot>")
    for joints in (None, ["j1", "j2"]):
        assert load(text.replace('name="made_up"', ""), joints=joints).inertial[0, 1] == pytest.approx(1.1)


def test_of_a_joint_that_is_not_kept_only_the_place_is_asked(load):
    """Its limits and its axis are not used; where it stands is."""
    strange = '<limit lower="2" upper="-2" effort="all" velocity="-1"/><mimic joint="j1" multiplier="?"/>'
    text = arm(2).replace("</robot>", link("f", 0.1) + joint("g", "l2", "f", "prismatic", strange, axis="0 0 0") + "</robot>")
    assert load(text, joints=["j1", "j2"]).inertial[0, 1] == pytest.approx(1.1)
    head, _, tail = text.rpartition('xyz="0.3 0 0"')
    with pytest.raises(UserError, match=r"joint 'g' has <origin xyz='0.3 0 far'>; 3 finite numbers"):
        load(head + 'xyz="0.3 0 far"' + tail, joints=["j1", "j2"])


def test_locked_joints_stand_at_the_angles_that_are_given(load):
    """Dynamics are those of the whole chain with these joints held there."""
    text, angles = random_chain(5, 5), {"j1": 0.7, "j4": -1.2}
    whole, part = load(text), load(text, joints=["j2", "j3", "j5"], fixed=angles)
    assert dict(part.held) == angles
    kept = [1, 2, 4]
    q, dq, ddq = np.random.default_rng(0).normal(size=(3, 3))
    full = [np.array([0.7, 0, 0, -1.2, 0]), np.zeros(5), np.zeros(5)]
    for vector, values in zip(full, (q, dq, ddq), strict=True):
        vector[kept] = values
    torques = rigid_body(whole).inverse_dynamics(*full, whole.inertial, whole.gravity)
    found = np.array(rigid_body(part).inverse_dynamics(q, dq, ddq, part.inertial, part.gravity)).ravel()
    np.testing.assert_allclose(found, np.array(torques).ravel()[kept], atol=1e-11)  # rounding


def test_a_locked_joint_whose_range_lacks_0_stands_in_its_middle(load):
    text = arm(3)
    head, _, tail = text.rpartition('lower="-2"')
    text = head + 'lower="0.5"' + tail
    found = load(text, joints=["j1", "j2"])
    assert dict(found.held) == {"j3": 1.25}
    assert "joint 'j3' is held at 71.62°, the middle of its range, which lacks 0" in found.notes
    assert dict(load(text, joints=["j1", "j2"], fixed={"j3": 2.0}).held) == {"j3": 2.0}
    for fixed, said in (
        ({"j3": 0.0}, r"fixed_deg\.j3: found 0; its range is 28\.65° … 114\.59°"),
        ({"j1": 0.1}, "fixed_deg: unknown locked joint that turns 'j1'; allowed are j3"),
    ):
        with pytest.raises(UserError, match=said):
            load(text, joints=["j1", "j2"], fixed=fixed)


def test_masses_in_grams_are_said(load):
    """Of a link of 1.869 kg that becomes one of 1869 kg; heavy links of large arms are no doubt."""
    text = robot(
        link("base", 0), link("l1", 1869.0, (20, 30, 40)), link("l2"), joint("j1", "base", "l1"), joint("j2", "l1", "l2")
    )
    (note,) = load(text).notes
    assert note == "link 'l1' weighs 1869 kg, which nothing of its size, 0.3 m, does; are masses in g?"
    assert load(text, inertial=False).notes == ()
    assert load(text.replace('xyz="0.3 0 0"', 'xyz="1.2 0 0"')).notes == ()


def test_moments_in_another_unit_are_said(load):
    """Those of the made-up links in kg mm²; arms of every size may have theirs."""
    for moments, notes in (((0.02, 0.03, 0.04), 0), ((2e4, 3e4, 4e4), 1)):
        text = robot(link("base", 0), link("l1", 1.0, moments), link("l2"), joint("j1", "base", "l1"), joint("j2", "l1", "l2"))
        said = [
            note
            for note in load(text).notes
            if note.startswith("link 'l1' has moments of inertia as if its mass were 200 m from")
        ]
        assert len(said) == notes


def test_a_link_without_mass_is_named_and_not_what_is_fixed_to_it(load):
    empty = link("l1").replace('<mass value="1.0"/>', '<mass value="0"/>')
    text = robot(link("base", 0), empty, link("hand", 0), joint("j1", "base", "l1"), joint("grip", "l1", "hand", "fixed"))
    with pytest.raises(UserError, match="link 'l1', moved by joint 'j1', has mass 0 kg"):
        load(text)


XACRO = '<robot name="made_up" xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:include filename="arm.xacro"/></robot>'


def test_a_xacro_is_named_with_what_to_do(tmp_path, monkeypatch):
    (tmp_path / "arm.urdf.xacro").write_text(XACRO)
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(UserError, match=r"is a xacro, of which the tool xacro makes a URDF.*xacro arm.urdf.xacro > arm.urdf"):
        load_robot(tmp_path / "arm.urdf.xacro")


def test_a_xacro_is_expanded_where_the_tool_is(tmp_path, monkeypatch):
    """The tool is stood in for by a script that gives a URDF, or refuses."""
    (tmp_path / "arm.xacro").write_text(XACRO)
    (tmp_path / "made.urdf").write_text(arm(2))
    tool = tmp_path / "xacro"
    tool.write_text(f"#!/bin/sh\n/bin/cat {tmp_path / 'made.urdf'}\n")
    tool.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert load_robot(tmp_path / "arm.xacro").joints == ("j1", "j2")
    tool.write_text("#!/bin/sh\necho No such file: arm.xacro >&2\nexit 2\n")
    with pytest.raises(UserError, match=r"xacro refuses it: No such file: arm\.xacro"):
        load_robot(tmp_path / "arm.xacro")


def test_moments_of_inertia_that_are_nearly_those_of_a_body_become_so(load):
    """Files round, and round up: 0.12 + 1.79 is less than 1.92."""
    found = load(robot(link("base", 0), link("l1", 1.0, (0.00012, 0.00179, 0.00192), "0 0 0"), joint("j1", "base", "l1")))
    assert any("gives link 'l1' the principal moments of inertia 0.00012, 0.00179, 0.00192" in said for said in found.notes)
    assert "link 'l1' moves with the moments of inertia of the nearest body" in found.notes
    xx, _, yy, _, _, zz = found.inertial[4:, 0]
    assert zz < xx + yy
    np.testing.assert_allclose([xx, yy, zz], [0.00012, 0.00179, 0.00192], atol=1.5e-5)
    with pytest.raises(UserError, match="none above the sum"):
        load(robot(link("base", 0), link("l1", 1.0, (0.001, 0.001, 0.01)), joint("j1", "base", "l1")))
