"""Tasks against geometry and statics done by hand, and every way in which a task file can be wrong."""

import copy
import importlib.resources
import json
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pinocchio as pin
import pytest
from chains import joint, link, robot

from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.search.proposals import SearchOptions
from rrr_oc.codesign.springs import holding as able
from rrr_oc.codesign.springs import spring_bounds
from rrr_oc.codesign.task import NEAR, load_task, overloads
from rrr_oc.errors import UserError

PAPER = json.loads(importlib.resources.files("rrr_oc.data").joinpath("paper.json").read_text())
LINK = 0.3  # [m], links 2 and 3


def task_file(folder: Path, **changes) -> Path:
    """The preset `paper` with changes as `outer__inner=value`; None takes a key away."""
    content = copy.deepcopy(PAPER)
    for path, value in changes.items():
        *outer, last = path.split("__")
        place = content
        for key in outer:
            place = place[key]
        if value is None:
            del place[last]
        else:
            place[last] = value
    file = folder / "task.json"
    file.write_text(json.dumps(content))
    return file


def elbow(x: float, up: bool = True) -> list[float]:
    """q2, q3 [°] that put the tool at (x, 0) in the shoulder's plane, links of equal length: law of cosines."""
    q2 = math.degrees(math.acos(x / (2 * LINK)))
    return [q2, -2 * q2] if up else [-q2, 2 * q2]


def test_the_papers_ends_are_the_inverse_kinematics():
    task = load_task("paper")
    np.testing.assert_allclose(np.degrees(task.start), elbow(0.15), atol=1e-6)  # the least squares' 1e-8 m
    np.testing.assert_allclose(np.degrees(task.release), elbow(0.40), atol=1e-6)
    np.testing.assert_allclose(np.degrees(task.start), [75.52, -151.04], atol=0.006)  # facts.md, two digits
    np.testing.assert_allclose(np.degrees(task.release), [48.19, -96.38], atol=0.006)


def test_keys_may_be_spelled_as_in_recording_sets(tmp_path):
    """And texts for people are not read."""
    path = task_file(tmp_path)
    content = json.loads(path.read_text())
    other = {("payload" if k == "payload_kg" else k): v for k, v in content.items()} | {"comment": "mine"}
    path.write_text(json.dumps(other))
    assert load_task(path).payload == content["payload_kg"]
    path.write_text(json.dumps(content | {"payload": 2.0}))
    with pytest.raises(UserError, match="'payload_kg' and 'payload' stand in one object"):
        load_task(path)


def holding(task, q: np.ndarray, payload: float) -> np.ndarray:
    """Gravity torque of joints 2 and 3 by numeric pinocchio, the payload a point mass on link 3 [Nm]."""
    urdf = importlib.resources.files("rrr_oc.urdf").joinpath(f"{task.robot.name}.urdf").read_text()
    model = pin.buildModelFromXML(urdf)
    model.inertias[3] += pin.Inertia(payload, task.tool.position, np.zeros((3, 3)))
    return pin.computeGeneralizedGravity(model, model.createData(), np.r_[0, q])[1:]


def test_holding_torques():
    """Against numeric pinocchio, and against facts.md's digits."""
    task = load_task("paper")
    inverse, zero, seen = task.model().inverse, np.zeros(3), []
    for payload in (5.0, 0.0):
        for q in (task.start, task.release):
            tau = np.array(inverse(task.full(q), zero, zero, payload, [], [])[0]).ravel()[1:]
            np.testing.assert_allclose(tau, holding(task, q, payload), rtol=1e-12)
            seen += tau.tolist()
    np.testing.assert_allclose(
        seen, [10.339, 4.256, 27.572, 11.351, 2.982, 0.578, 7.952, 1.540], atol=1e-3
    )  # three digits, the last of 11.351 off by one


def test_prototype_preset_is_what_facts_say():
    task = load_task("prototype")
    np.testing.assert_allclose(np.degrees(task.start), [69.295, -138.590])
    np.testing.assert_allclose(np.degrees(task.release), [19.471, -38.942])
    radii = [2 * LINK * np.cos(q[0]) for q in (task.start, task.release)]
    np.testing.assert_allclose(radii, [0.2121, 0.5657], atol=5e-5)  # four digits; they are the wrist's, at 0.3 m
    assert task.tool.position[0] == 0.310
    np.testing.assert_allclose(np.degrees(task.speed), 120)
    assert np.all(np.isinf(task.acceleration))
    np.testing.assert_array_equal(task.torque, [157.5, 95.25])
    widened = np.degrees(
        [np.r_[task.lower], np.r_[task.upper]]
    )  # start–release widened by a quarter, within q2 −10…150°, q3 ±140°
    np.testing.assert_allclose(widened[0], [19.471 - 49.824 / 4 if 19.471 - 49.824 / 4 > -10 else -10, -140], atol=1e-9)
    np.testing.assert_allclose(widened[1], [69.295 + 49.824 / 4, -38.942 + 99.648 / 4], atol=1e-9)
    np.testing.assert_allclose(task.robot.inertial[0], [4.524, 4.029, 2.181])


def test_paper_preset_is_what_facts_say():
    task = load_task("paper")
    np.testing.assert_allclose(np.degrees(task.speed), 90)
    np.testing.assert_allclose(np.degrees(task.acceleration), 180)
    np.testing.assert_array_equal(task.tool.position, [0.3, 0, 0])
    np.testing.assert_allclose(task.robot.inertial[0], [4.480, 4.045, 2.181])
    assert (task.payloads, task.duration, task.joints) == ((5.0, 0.0), (1.0, 5.0), ("joint2", "joint3"))
    assert (task.around.floor, task.around.keep_outs, task.jerky) == (-np.inf, (), [])
    np.testing.assert_array_equal(task.ends(0), [task.start, task.release])
    np.testing.assert_array_equal(task.ends(1), [task.release, task.start])
    np.testing.assert_array_equal(task.full(np.array([[1.0, 2], [3, 4]])), [[0, 0], [1, 2], [3, 4]])


def test_an_end_that_is_passed_at_speed_needs_less_time(tmp_path):
    """Joint 3 turns by w = 54.66° at 90 °/s and 180 °/s². From rest to rest half a second each, over 22.5°, is for acceleration and
    braking, the rest at full speed; with one end at speed one of both; with two it takes w/v = 0.61 s."""
    way = elbow(0.15)[0] * 2 - elbow(0.40)[0] * 2
    for moving in (0, 1, 2):
        needed = (2 - moving) * 0.5 + (way - (2 - moving) * 22.5) / 90
        ends = dict.fromkeys(("release__speed", "start__speed")[:moving], "moving")
        task = load_task(task_file(tmp_path, duration_s=[0.2, needed + 1e-3], **ends))
        assert task.speeds == ("moving" if moving > 1 else "rest", "moving" if moving else "rest")
        assert task.at_rest == (moving == 0)
        with pytest.raises(UserError, match=f"joint3 needs {needed:.2f} s"):
            load_task(task_file(tmp_path, duration_s=[0.2, needed - 1e-3], **ends))


def test_elbow_up_is_chosen_where_both_fit(tmp_path):
    both = {"limits__joint2__range_deg": [-180, 180], "limits__joint3__range_deg": [-180, 180]}
    task = load_task(task_file(tmp_path, **both))
    np.testing.assert_allclose(np.degrees(task.release), elbow(0.40), atol=1e-5)
    up_is_down = load_task(task_file(tmp_path, gravity=[0, 0, 9.81], **both))
    np.testing.assert_allclose(np.degrees(up_is_down.release), elbow(0.40, up=False), atol=1e-5)
    ranges = {"limits__joint2__range_deg": [-180, 180], "limits__joint3__range_deg": [0, 180]}
    down = load_task(task_file(tmp_path, **ranges))
    np.testing.assert_allclose(np.degrees(down.release), elbow(0.40, up=False), atol=1e-5)


def test_tool_height_is_geometry():
    task, rng = load_task("paper"), np.random.default_rng(3)
    model = task.model()
    for q1, q2, q3 in rng.uniform(-3, 3, (20, 3)):
        height = 0.07 + LINK * math.sin(q2) + 0.3 * math.sin(q2 + q3)
        assert float(model.tool_height(np.array([q1, q2, q3]))) == pytest.approx(height, abs=1e-12)


@pytest.mark.parametrize(("longest", "feasible"), [(1.1072, False), (1.1076, True)])
def test_least_time_is_that_of_a_trapezoid_of_speed(tmp_path, longest, feasible):
    """Joint 3 goes 54.6656° at 90 °/s and 180 °/s²: 54.6656/90 + 90/180 = 1.10740 s."""
    file = task_file(tmp_path, duration_s=[0.1, longest])
    if feasible:
        assert load_task(file).duration == (0.1, longest)
    else:
        with pytest.raises(UserError, match=r"joint3 needs 1\.11 s for its 54\.7°"):
            load_task(file)


def test_a_short_way_needs_the_time_of_a_triangle_of_speed(tmp_path):
    """10° at 180 °/s²: full speed is never reached, 2 sqrt(10/180) = 0.4714 s."""
    ends = {"start": {"angles_deg": [40, -90]}, "release": {"angles_deg": [50, -90]}}
    assert load_task(task_file(tmp_path, duration_s=[0.1, 0.472], **ends)).duration[1] == 0.472
    with pytest.raises(UserError, match=r"joint2 needs 0\.47 s"):
        load_task(task_file(tmp_path, duration_s=[0.1, 0.471], **ends))


WRONG = {
    "unknown key": ({"colour": 1}, r"unknown key 'colour'; allowed are format, robot"),
    "key missing": ({"start": None}, "key 'start' is missing"),
    "crossed range": (
        {"limits__joint2__range_deg": [150, -10]},
        r"limits\.joint2\.range_deg: bounds are crossed: 150 … -10",
    ),
    "crossed duration": ({"duration_s": [5, 1]}, "duration_s: bounds are crossed: 5 … 1"),
    "three durations": ({"duration_s": [1, 2, 3]}, r"duration_s: found \[1, 2, 3\]; a list of 2 numbers"),
    "no duration": ({"duration_s": [0, 5]}, r"duration_s: found \[0.0, 5.0\]; durations above 0"),
    "out of reach": (
        {"release__position_m": [0.7, 0, 0.07]},
        r"release at \[0.7, 0.0, 0.07\] m is out of reach .* nearer than 0\.1000 m",
    ),
    "sideways": ({"release__position_m": [0.3, 0.2, 0.07]}, r"nearer than 0\.2000 m"),
    "end outside range": (
        {"start": {"angles_deg": [10, 10]}},
        r"joint3 would stand at 10.00°, outside its range -180.00° … 0.00°",
    ),
    "three angles": ({"start": {"angles_deg": [1, 1, 1]}}, "start.angles_deg: found .*; one number per moving joint"),
    "angles and position": ({"start": {"angles_deg": [1, 1], "position_m": [1, 1, 1]}}, 'either "angles_deg" or "position_m"'),
    "speed at an end": (
        {"start": {"angles_deg": [75, -150], "speed": "fast"}},
        "speed: found 'fast'; allowed are 'rest', 'moving', 'free'",
    ),
    "too little time": ({"duration_s": [0.2, 1.0]}, r"the task cannot be done: joint3 needs 1\.11 s .* allows 1 s"),
    "below the floor": ({"floor_m": 0.1}, r"at the start the tool stands 0\.0700 m high, below floor_m = 0.1 m"),
    "negative payload": ({"payload_kg": -1}, "payload_kg: found -1; a finite number from 0 to 10000"),
    "payload is no number": ({"payload_kg": float("nan")}, "payload_kg: found nan; a finite number"),
    "unknown joint": ({"moving": ["joint2", "joint9"]}, "no joint 'joint9'; it has joint1, joint2, joint3"),
    "unknown joint in limits": ({"limits__joint9": {}}, "limits: unknown joint 'joint9'; allowed are joint2, joint3"),
    "wrong order": ({"moving": ["joint3", "joint2"]}, "moving: found joint3, joint2; different joints, base first"),
    "nothing moves": ({"moving": []}, r"moving: found \[\]; a list with at least one entry"),
    "no speed": ({"limits__joint2__speed_deg_per_s": 0}, "speed_deg_per_s: found 0; a finite number above 0"),
    "speed in words": ({"limits__joint2__speed_deg_per_s": "fast"}, "speed_deg_per_s: found 'fast'; a finite number above 0"),
    "negative torque": ({"limits__joint2__torque_Nm": -3}, "torque_Nm: found -3; a finite number above 0"),
    "unknown limit": ({"limits__joint2__jerk": 3}, "limits.joint2: unknown key 'jerk'"),
    "unknown link": ({"tool": {"link": "hand", "position_m": [0, 0, 0]}}, "no link 'hand'; it has base"),
    "tool on the base": ({"tool": {"link": "base", "position_m": [0, 0, 0]}}, "link 'base' .* does not move"),
    "position without the last link": ({"tool": {"link": "link2", "position_m": [0.1, 0, 0]}}, "give angles_deg"),
    "out of reach, where": ({"release__position_m": [0.7, 0, 0.07]}, r"at \[0\.6, 0\.0, 0\.07\] m"),
    "position in mm": ({"release__position_m": [400, 0, 70]}, "; the position looks like mm"),
    "ranges in rad": (
        {
            "start": {"position_m": [0.15, 0, 0.07]},
            "limits__joint2__range_deg": [-0.2, 2.6],
            "limits__joint3__range_deg": [-3.1, 0.0],
        },
        "start .* is out of reach .*; the joint ranges are in degrees, and these look like rad",
    ),
    "a coordinate that no joint changes": (
        {"release__position_m": [0.3, 0.2, 0.07]},
        r"at \[0\.3, 0\.0, 0\.07\] m; joint2, joint3 cannot change y",
    ),
    "a moving joint locked": ({"locked_deg": {"joint2": 10}}, "locked_deg: unknown locked joint 'joint2'; allowed are joint1"),
    "locked outside the range": ({"locked_deg": {"joint1": 1e4}}, r"locked_deg\.joint1: found 10000; its range is"),
    "a motor for one joint of two": (
        {"actuators": {"joint2": {"dry_Nm": 1.0}}},
        "actuators: key 'joint3' is missing; every moving joint, or none",
    ),
    "a gear that gains": (
        {"actuators": {"joint2": {"efficiency": 1.2}, "joint3": {}}},
        "efficiency: found 1.2; a number above 0, and up to 1",
    ),
    "missing robot": ({"robot": "nowhere.urdf"}, "no robot at 'nowhere.urdf'"),
}


@pytest.mark.parametrize(("changes", "message"), WRONG.values(), ids=WRONG.keys())
def test_a_wrong_task_is_explained(tmp_path, changes, message):
    with pytest.raises(UserError, match=message):
        load_task(task_file(tmp_path, **changes))


def test_a_wrong_file_is_explained(tmp_path):
    with pytest.raises(UserError, match=r"no task at 'nowhere.json'.* bundled one: paper, prototype"):
        load_task("nowhere.json")
    file = tmp_path / "task.json"
    for content, message in ((b"{", "not valid JSON"), (b"\xff\xfe\x00", "UTF-8"), (b"[]", "an object with format")):
        file.write_bytes(content)
        with pytest.raises(UserError, match=message):
            load_task(file)


MALFORMED = {
    "payload in words": {"payload_kg": "heavy"},
    "payload a list": {"payload_kg": [5]},
    "two coordinates": {"start__position_m": [0.15, 0]},
    "position in words": {"start__position_m": "here"},
    "position not finite": {"start__position_m": [float("nan"), 0, 0.07]},
    "angles in words": {"start": {"angles_deg": ["a", "b"]}},
    "moving a number": {"moving": 3},
    "limits a list": {"limits": []},
    "a limit a number": {"limits__joint2": 3},
    "tool without position": {"tool": {"link": "link3"}},
    "tool a word": {"tool": "link3"},
    "floor in words": {"floor_m": "ground"},
    "springs a number": {"springs": 3},
    "gravity of two": {"gravity": [0, 0]},
    "gravity in words": {"gravity": "down"},
    "margin in words": {"path_margin": "wide"},
    "margin shuts the ends out": {"path_margin": -0.3},
}


@pytest.mark.parametrize("changes", MALFORMED.values(), ids=MALFORMED.keys())
def test_a_malformed_value_is_the_users_to_mend(tmp_path, changes):
    """Style: validate at the door. Every one of these must be a `UserError`, none a traceback from inside."""
    with pytest.raises(UserError):
        load_task(task_file(tmp_path, **changes))


def test_a_locked_joint_stands_where_the_task_says(tmp_path):
    """In positions, and not in rates."""
    ends = {"start": {"angles_deg": [70, -100]}, "release": {"angles_deg": [40, -90]}}
    still, turned = (load_task(task_file(tmp_path, locked_deg=d, **ends)) for d in ({}, {"joint1": 30.0}))
    np.testing.assert_allclose(still.full(still.start), [0.0, *np.radians([70, -100])])
    np.testing.assert_allclose(turned.full(turned.start), np.radians([30, 70, -100]))
    np.testing.assert_array_equal(turned.full_rates(np.ones((2, 4)))[0], np.zeros(4))
    assert turned.full(np.zeros((2, 4))).shape == (3, 4)


def test_springs_on_locked_joints_and_springs_given_twice_are_refused(tmp_path):
    spring = PAPER["springs"][0]
    for springs, message in (
        ([spring | {"joint": "joint1"}], "joint1 does not move in this task; moving are joint2, joint3"),
        ([spring, spring], "two entries are a parallel_spring of joint2; one is allowed"),
    ):
        with pytest.raises(UserError, match=message):
            spring_bounds(load_task(task_file(tmp_path, springs=springs)), "PEA")


def test_a_locked_joint_changes_what_holding_costs(tmp_path):
    """Gravity along y instead of z: what the moving joints hold depends on where joint 1 is locked."""
    ends = {"start": {"angles_deg": [70, -100]}, "release": {"angles_deg": [40, -90]}}
    q = np.radians([70, -100])
    found = []
    for angle in (0.0, 90.0):
        task = load_task(task_file(tmp_path, locked_deg={"joint1": angle}, gravity=[0, -9.81, 0], **ends))
        design = CoDesign(task, ())
        found.append(np.array(design.torques(q, 0 * q, 0 * q, 5.0, [], [])[0]).ravel())
        full = np.array(task.model().inverse(task.full(q), np.zeros(3), np.zeros(3), 5.0, [], [])[0]).ravel()
        np.testing.assert_allclose(found[-1], full[1:], atol=1e-12)
    assert np.abs(found[0] - found[1]).max() > 1.0


def test_a_search_without_starts_is_refused():
    with pytest.raises(UserError, match="1 start or more, got starts=0"):
        SearchOptions(starts=0)


def rounded_arm(folder: Path, **changes) -> Path:
    """A task of an arm in whose file π/2 has five digits, so that no position of its plane is exactly in reach."""
    first = joint("j1", "base", "l1", xyz="0 0 0.07", rpy="1.5708 0 0", axis="0 0 1", inside=LIMIT)
    second = joint("j2", "l1", "l2", rpy="0.00003 0 0", axis="0 0 1", inside=LIMIT)
    mount = joint("mount", "l2", "tool0", "fixed", "")
    links = [link("base", 0), link("l1"), link("l2"), link("tool0", 0)]
    (folder / "arm.urdf").write_text(robot(*links, first, second, mount))
    limits = {"j1": {}, "j2": {}}
    own = {
        "robot": "arm.urdf",
        "moving": ["j1", "j2"],
        "limits": limits,
        "springs": [],
        "tool": None,
        "payload_kg": 0.5,
        "duration_s": [1.0, 9.0],
    }
    return task_file(folder, **own | changes)


LIMIT = '<limit lower="-3" upper="3" effort="12" velocity="3"/>'


def test_a_position_is_reached_as_nearly_as_files_say_it(tmp_path):
    task = load_task(rounded_arm(tmp_path))
    for q, position in ((task.start, [0.15, 0, 0.07]), (task.release, [0.4, 0, 0.07])):
        found = np.array(task.model().body.tool_position(task.full(q), task.tool.position)).ravel()
        assert 1e-8 < np.linalg.norm(found - position) < 1e-5  # what five digits of an angle leave, at this reach
    load_task(rounded_arm(tmp_path, release__position_m=[0.4, 0.5 * NEAR, 0.07]))
    with pytest.raises(UserError, match=r"release at .* is out of reach .* nearer than 0\.0030 m"):
        load_task(rounded_arm(tmp_path, release__position_m=[0.4, 3 * NEAR, 0.07]))


def test_torque_limits_are_the_robots_unless_the_task_says_others(tmp_path):
    limits = {"j1": {"torque_Nm": 30.0}, "j2": {}}
    np.testing.assert_array_equal(load_task(rounded_arm(tmp_path, limits=limits)).torque, [30, 12])
    limits = {"j1": {"torque_Nm": "none"}, "j2": {}}
    np.testing.assert_array_equal(load_task(rounded_arm(tmp_path, limits=limits)).torque, [np.inf, 12])
    np.testing.assert_array_equal(load_task("paper").torque, [np.inf, np.inf])  # the paper says none
    endless = (tmp_path / "arm.urdf").read_text().replace('effort="12"', 'effort="0"')
    path = rounded_arm(tmp_path)
    (tmp_path / "arm.urdf").write_text(endless)
    np.testing.assert_array_equal(load_task(path).torque, [np.inf, np.inf])


def test_a_load_that_cannot_be_held_is_said_before_a_search(tmp_path):
    """Statics by hand: 1 kg links with their centre 0.1 m along, the tool 0.6 m away when stretched out."""
    flat = {"start": {"angles_deg": [0, 0]}, "release": {"angles_deg": [60, -60]}}
    spring = {"effect": "parallel_spring", "joint": "j1", "stiffness_Nm_per_rad": [0, 9], "equilibrium_deg": [-90, 90]}
    said: list[str] = []
    listener = cast(Any, SimpleNamespace(note=said.append))
    light = load_task(rounded_arm(tmp_path, payload_kg=0.5, springs=[spring], **flat))
    assert (overloads(light), able(light, None, ["SA", "PEA"], listener), said) == ({}, ("SA", "PEA"), [])
    heavy = load_task(rounded_arm(tmp_path, payload_kg=2.0, springs=[spring], **flat))
    needed = 9.81 * (1 * 0.1 + 1 * 0.4 + 2 * 0.6)
    assert overloads(heavy) == {"j1": f"j1 needs {needed:.4g} Nm to hold 2 kg at the start, and its limit is 12 Nm"}
    assert able(heavy, None, ["SA", "PEA"], listener) == ("PEA",)
    assert said == [f"Note: task 'paper': {overloads(heavy)['j1']}, so a spring has to help; SA is left out."]
    with pytest.raises(UserError, match=r"to hold 2 kg at the start.*SA has no spring there: .*, as in PEA"):
        able(heavy, ["SA"], ["SA", "PEA"], listener)
    with pytest.raises(UserError, match=r"j1 needs .* SA has no spring there: a smaller payload"):
        able(load_task(rounded_arm(tmp_path, payload_kg=2000.0, **flat)), None, ["SA"], listener)


def test_a_locked_joint_whose_range_lacks_0_stands_in_its_middle(tmp_path):
    path = rounded_arm(tmp_path, moving=["j1"], limits={"j1": {}}, start={"angles_deg": [0]}, release={"angles_deg": [30]})
    head, _, tail = (tmp_path / "arm.urdf").read_text().rpartition('lower="-3"')
    (tmp_path / "arm.urdf").write_text(head + 'lower="1"' + tail)
    task = load_task(path)
    np.testing.assert_array_equal(task.locked, [0.0, 2.0])
