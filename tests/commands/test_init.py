"""`rrr-oc init`: what it writes is read by the real readers, for arms with and without limits, masses and level axes."""

import json
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from chains import joint, link, robot

from rrr_oc.cli import main
from rrr_oc.codesign.springs import spring_bounds
from rrr_oc.codesign.study import Request, prepared
from rrr_oc.codesign.task import TaskFile, load_task, overloads
from rrr_oc.commands.init import write_example
from rrr_oc.errors import UserError
from rrr_oc.recordings.header import Header, RecordingEntry, read_header
from rrr_oc.recordings.reader import load_recordings
from rrr_oc.robot.rigid_body import rigid_body
from rrr_oc.schema import parsed
from rrr_oc.simulation.export import mjcf
from rrr_oc.storage import write_csv

CHAIN7 = Path(__file__).resolve().parents[1] / "data" / "chain7.urdf"
LIMIT = '<limit lower="{0}" upper="{1}" velocity="{2}" effort="50"/>'


def an_arm(folder: Path, limit: str, kind: str = "revolute", mass: str = '<mass value="2"/>') -> Path:
    """Two links of 0.4 m that turn about horizontal axes on a column that turns."""
    link = (
        f'<inertial><origin xyz="0.2 0 0"/>{mass}<inertia ixx="0.01" iyy="0.03" izz="0.03" ixy="0" ixz="0" iyz="0"/></inertial>'
    )
    links = "".join(f'<link name="l{i}">{link if i else ""}</link>' for i in range(4))
    places = (("0 0 0.3", "0 0 1"), ("0 0.1234 0.1", "0 -1 0"), ("0.4 0 0", "0 -1 0"))
    joints = "".join(
        f'<joint name="joint {i}" type="{kind}"><parent link="l{i}"/><child link="l{i + 1}"/><origin xyz="{at}"/>'
        f'<axis xyz="{axis}"/>{limit}</joint>'
        for i, (at, axis) in enumerate(places)
    )
    path = folder / "my arm.urdf"
    path.write_text(f'<robot name="arm">{links}{joints}</robot>')
    return path


ARMS = {
    "bundled": lambda folder: "rrr",
    "seven skewed axes": lambda folder: CHAIN7,
    "with an offset that few digits do not tell": lambda folder: an_arm(folder, LIMIT.format(-2.0, 2.5, 2.0)),
    "endless": lambda folder: an_arm(folder, "", "continuous"),
}


@pytest.mark.parametrize("arm", ARMS)
def test_the_task_can_be_done_and_the_set_only_lacks_recordings(tmp_path, arm):
    made = write_example(ARMS[arm](tmp_path), tmp_path / "set")
    assert (made.no_task, len(made.moving)) == ("", 2)
    task = load_task(tmp_path / "set" / "task.json")
    body = rigid_body(task.robot)
    for q in (task.start, task.release):
        assert np.all((task.lower <= q) & (q <= task.upper))
        assert np.all(np.isfinite(np.array(body.tool_position(task.full(q), task.tool.position))))
    assert len(spring_bounds(task, "PEA")) == 2
    with pytest.raises(UserError, match=r"first\.csv: no recordings yet: a header and no rows"):
        load_recordings(tmp_path / "set" / "recordings")
    rows = 200
    names = (tmp_path / "set" / "recordings" / "first.csv").read_text().splitlines()[0].split(",")
    t = np.arange(rows) / 50
    motion = {"q": np.sin(t), "dq": np.cos(t), "tau": np.sin(3 * t)}
    write_csv(tmp_path / "set" / "recordings" / "first.csv", {n: t if n == "t" else motion[n.split("_")[0]] for n in names})
    assert load_recordings(tmp_path / "set" / "recordings").joints == made.joints


def uncommented(path: Path) -> str:
    """A file with its hints, lines and parts behind //, made part of it."""
    lines = []
    for line in path.read_text().splitlines():
        hint = re.match(r'( *)// (, )?"(\w+)": (.*)$', line) or re.match(r"( *)// (, )(\{.*)$", line)
        lines.append(line.replace("// ", "", 1) if hint else line)
    return "\n".join(lines)


def test_hints_name_every_optional_key_and_are_valid_once_uncommented(tmp_path):
    write_example("rrr", tmp_path / "set")
    for file, structures in (("recordings/recordings.json", (Header, RecordingEntry)), ("task.json", (TaskFile,))):
        text = (tmp_path / "set" / file).read_text()
        keys = {key for structure in structures for key in structure.__struct_fields__}
        assert not [key for key in keys if f'"{key}"' not in text and f'"{key}_kg"' not in text]
        (tmp_path / "set" / file).write_text(uncommented(tmp_path / "set" / file))
    for key in ("tool", "actuators"):
        assert key in parsed("f", (tmp_path / "set" / "recordings" / "recordings.json").read_text())
    first, second = read_header(tmp_path / "set" / "recordings" / "recordings.json").recordings
    assert (first.payload, first.group, list(first.springs), second.file) == (2.0, "first day", ["pea"], "second.csv")
    around = load_task(tmp_path / "set" / "task.json").around
    assert (around.floor, around.link_radius, [one.name for one in around.keep_outs]) == (0.0, 0.03, ["post"])


def test_the_floor_is_the_bases_plane_where_both_ends_are_above_it(tmp_path):
    """An arm of 0.8 m on a column of 0.4 m, whose joints let it do no more than hang, has none."""
    write_example(an_arm(tmp_path, LIMIT.format(-2.0, 2.5, 2.0)), tmp_path / "above")
    write_example(an_arm(tmp_path, LIMIT.format(-1.6, -1.2, 2.0)), tmp_path / "below")
    floors = [load_task(tmp_path / name / "task.json").around.floor for name in ("above", "below")]
    assert floors == [0.0, -np.inf]
    assert '"floor_m": null,' in (tmp_path / "below" / "task.json").read_text()


def test_an_arm_without_masses_gets_a_set_that_identifies_them_and_no_task(tmp_path, capsys):
    arm = an_arm(tmp_path, LIMIT.format(-2.0, 2.5, 2.0), mass='<mass value="0"/>')
    made = write_example(arm, tmp_path / "set")
    assert "mass 0 kg" in made.no_task
    assert read_header(tmp_path / "set" / "recordings" / "recordings.json").inertial == "identify"
    assert not (tmp_path / "set" / "task.json").exists()
    assert "There is no task.json" in (tmp_path / "set" / "README.md").read_text()


def test_an_arm_with_a_gripper_needs_its_joints_named(tmp_path):
    """The fingers branch and slide; without `joints` the error names what is in the way."""
    arm = an_arm(tmp_path, LIMIT.format(-2.0, 2.5, 2.0))
    finger = '<link name="f{0}"/><joint name="finger {0}" type="prismatic"><parent link="l3"/><child link="f{0}"/>{1}</joint>'
    fingers = "".join(finger.format(i, LIMIT.format(0, 0.1, 1)) for i in range(2))
    arm.write_text(arm.read_text().replace("</robot>", f"{fingers}</robot>"))
    with pytest.raises(
        UserError, match=r"'finger 0' is prismatic.*; --joints 'joint 0,joint 1,joint 2' leaves the others still"
    ):
        write_example(arm, tmp_path / "without")
    joint = '<joint name="joint {}" type="{}"><parent link="l{}"/>'.format
    two = arm.read_text().replace(joint(1, "revolute", 1), joint(1, "revolute", 0))
    (tmp_path / "two.urdf").write_text(two.replace(joint(2, "revolute", 2), joint(2, "fixed", 2)))
    with pytest.raises(UserError, match="; --joints names those of one arm"):  # two arms of one joint: neither is the arm
        write_example(tmp_path / "two.urdf", tmp_path / "without")
    joints = ["joint 0", "joint 1", "joint 2"]
    made = write_example(arm, tmp_path / "set", joints)
    assert list(made.joints) == joints
    assert load_task(tmp_path / "set" / "task.json").robot.joints == tuple(joints)
    assert read_header(tmp_path / "set" / "recordings" / "recordings.json").joints == tuple(joints)


def test_both_ends_are_in_front_of_the_arm_and_above_a_table(tmp_path):
    for k, arm in enumerate(("rrr", an_arm(tmp_path, LIMIT.format(-3.0, 3.0, 2.0)))):
        write_example(arm, tmp_path / str(k))
        task = load_task(tmp_path / str(k) / "task.json")
        body, reach = rigid_body(task.robot), 0.7 if arm == "rrr" else 0.9
        for q in (task.start, task.release):
            x, _, z = np.array(body.tool_position(task.full(q), task.tool.position)).ravel()
            assert x > 0
            assert 0 < z < 0.6 * reach


@pytest.mark.parametrize(("scale", "effort"), [(1.0, "50"), (0.01, "2"), (1.0, "17")], ids=["2 kg links", "20 g links", "weak"])
def test_the_payload_suits_the_arm(tmp_path, scale, effort):
    """Its motors hold it without springs, so that nothing has to be said before a search."""
    limit = LIMIT.format(-2.0, 2.5, 2.0).replace("50", effort)
    text = an_arm(tmp_path, limit, mass=f'<mass value="{2 * scale}"/>')
    text.write_text(re.sub(r'(i[xyz]{2})="(0\.0\d)"', lambda m: f'{m[1]}="{float(m[2]) * scale}"', text.read_text()))
    write_example(text, tmp_path / "set")
    task = load_task(tmp_path / "set" / "task.json")
    assert 0.001 <= task.payload <= 0.1 * 4 * scale + 1e-12
    assert overloads(task) == {}


def test_a_locked_joint_stands_within_its_range(tmp_path):
    """The first joint's range lacks 0; so does a finger's, which is no joint of the arm."""
    arm = an_arm(tmp_path, LIMIT.format(-2.0, 2.5, 2.0))
    text = arm.read_text().replace("-2.0", "0.5", 1)
    finger = '<link name="f"/><joint name="f" type="revolute"><parent link="l3"/><child link="f"/>' + LIMIT.format(0.2, 0.4, 1)
    arm.write_text(text.replace("</robot>", f"{finger}</joint></robot>"))
    made = write_example(arm, tmp_path / "set", ["joint 0", "joint 1", "joint 2"])
    assert made.no_task == ""
    task = load_task(tmp_path / "set" / "task.json")
    assert np.degrees(task.locked[0]) == pytest.approx(np.degrees(1.5), abs=0.05)
    assert task.robot.held == pytest.approx({"f": 0.3})


def test_an_arm_without_a_tool_frame_holds_the_payload_beyond_its_last_joint(tmp_path):
    """Of one joint, whose own frame does not move."""
    arm = an_arm(tmp_path, LIMIT.format(-2.0, 2.5, 2.0))
    made = write_example(arm, tmp_path / "set", ["joint 2"])
    assert made.moving == ("joint 2",)
    np.testing.assert_allclose(load_task(tmp_path / "set" / "task.json").tool.position, [0.4, 0, 0])


def test_joints_that_turn_a_stretched_arm_about_itself_do_not_make_its_task(tmp_path):
    """As a humanoid's arm, whose shoulder sits askew and whose elbow and wrist roll: the joints that are level move no tool."""
    axes = ("0 0 1", "0 -0.9 0.4", "1 0 0", "1 0 0")
    names = ["base", *(f"l{i}" for i in range(1, 5))]
    joints = [joint(f"j{i + 1}", names[i], names[i + 1], axis=axis) for i, axis in enumerate(axes)]
    (tmp_path / "arm.urdf").write_text(robot(link("base", 0), *map(link, names[1:]), *joints))
    made = write_example(tmp_path / "arm.urdf", tmp_path / "made")
    assert made.no_task == ""
    assert set(made.moving) & {"j1", "j2"}
    task = load_task(tmp_path / "made" / "task.json")
    body = rigid_body(task.robot)
    ends = [np.array(body.tool_position(task.full(q), task.tool.position)).ravel() for q in (task.start, task.release)]
    assert np.linalg.norm(ends[1] - ends[0]) > 0.1


def test_an_arm_whose_limits_are_0_gets_as_far_as_the_first_solve(tmp_path):
    """MuJoCo refuses an actuator that may give no torque."""
    arm = an_arm(tmp_path, '<limit effort="0" velocity="0"/>', "continuous")
    notes = write_example(arm, tmp_path / "set").notes
    assert "the URDF gives no limit of torque of joint 0, joint 1, joint 2: 'effort' of <limit> is 0" in notes
    said: list[str] = []
    listener = cast(Any, SimpleNamespace(note=said.append))
    study = prepared(Request(str(tmp_path / "set" / "task.json"), tmp_path / "design"), None, listener)
    assert list(study.designs) == ["SA", "PEA"]
    assert said == []
    assert "ctrlrange" not in mjcf(study.tasks.first.model(), []).text


def test_limits_that_the_urdf_lacks_are_said_by_every_reader(tmp_path, capsys):
    made = write_example(an_arm(tmp_path, '<limit velocity="2" effort="50"/>'), tmp_path / "set")
    (note,) = made.notes
    assert note.startswith("the URDF gives no range of joint 0, joint 1, joint 2:")
    text = (tmp_path / "set" / "task.json").read_text()
    text = re.sub(r'"position_m": \[[^\]]*\](?=\}, // of)', '"angles_deg": [10, 20]', text)  # in reach wherever joint 0 stands
    (tmp_path / "set" / "task.json").write_text(text.replace('"joint 0": 0.0', '"joint 0": 20.0'))
    task = load_task(tmp_path / "set" / "task.json")  # an angle of a joint without a range is allowed
    assert (task.locked[0], task.robot.notes) == (pytest.approx(np.radians(20)), made.notes)
    t = np.arange(200) / 50
    names = (tmp_path / "set" / "recordings" / "first.csv").read_text().splitlines()[0].split(",")
    write_csv(
        tmp_path / "set" / "recordings" / "first.csv",
        {n: np.cos(t) if n.startswith("dq") else t if n == "t" else np.sin(t) for n in names},
    )
    assert note in load_recordings(tmp_path / "set" / "recordings").notes


def test_the_command_says_what_comes_next(tmp_path, capsys, monkeypatch):
    def run(*words: object) -> int:
        monkeypatch.setattr("sys.argv", ["rrr-oc", *map(str, words)])
        with pytest.raises(SystemExit) as ended:
            main()
        return int(ended.value.code or 0)

    assert run("init", "rrr", "--out", tmp_path / "set") == 0
    said = capsys.readouterr().out
    commands = re.findall(r"^rrr-oc (\w+)", said, re.M)
    assert commands == ["calibrate", "diagnose", "design"]
    readme = (tmp_path / "set" / "README.md").read_text()
    assert all(line in readme for line in said.splitlines() if line.startswith("rrr-oc"))
    assert "Take a joint that you do not record" in readme
    assert run("init", "rrr", "--out", tmp_path / "set") == 2
    assert "is there already" in capsys.readouterr().err
    assert run("init", tmp_path / "nowhere.urdf", "--out", tmp_path / "b") == 2
    assert "no robot at" in capsys.readouterr().err
    assert run("init", "rrr", "--out", tmp_path / "c", "--json") == 0
    assert json.loads(capsys.readouterr().out)["moving"] == ["joint2", "joint3"]
