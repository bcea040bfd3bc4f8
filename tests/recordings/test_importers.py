"""Importers: the prototype's layout, made up and real where it is at hand, and bags of ROS: MCAP files that another writer made."""

import contextlib
import sqlite3
import sys
import warnings

import numpy as np
import pytest
from bags import START, states, write_mcap
from prototype import JOINTS, write_prototype
from recorded import real

from rrr_oc.effects.elastic.parallel_spring import ParallelSpring
from rrr_oc.errors import UserError
from rrr_oc.model.symbolic_model import Model
from rrr_oc.recordings.importers import JointStates, import_prototype, import_ros
from rrr_oc.recordings.reader import load_recordings


def test_prototype_units_signs_and_times(tmp_path):
    found = import_prototype(write_prototype(tmp_path / "raw", [3, 4, 7, 12]), tmp_path / "out")
    assert (found.robot.name, found.torque, found.joints) == ("rrr_prototype", "motor", JOINTS)
    assert [r.group for r in found.recordings] == ["payload", "springs", "payload+springs", "bare"]
    assert [r.payload[0] for r in found.recordings] == [5.0, 0.0, 5.0, 0.0]
    assert [len(r.springs) for r in found.recordings] == [0, 2, 2, 0]
    effect, theta = found.recordings[1].springs[1]
    assert effect == ParallelSpring((2,), active="below")
    assert theta == {"stiffness": 1.318, "equilibrium": pytest.approx(np.radians(140))}
    np.testing.assert_allclose(found.tool.position, found.robot.tool.position)  # 0.310 m, the bundled model's
    moved = import_prototype(tmp_path / "raw", tmp_path / "moved", 0.355)
    np.testing.assert_allclose(moved.tool.position, [0.355, 0, 0])
    recording = found.recordings[0]
    t = recording.t
    assert (t[0], t[-1]) == pytest.approx((0.010, 0.004 + 0.006 * 198))  # within what all three motors cover
    amplitudes, signs = np.radians([20, 40, 60])[:, None], np.array([1, 1, -1])[:, None]
    # interpolation leaves step² / 8 · 9 · amplitude, and the text six decimals of a degree
    np.testing.assert_allclose(recording.q, signs * amplitudes * np.sin(3 * t), atol=0.006**2 / 8 * 9 * 1.05 + 2e-8)
    np.testing.assert_allclose(recording.dq, signs * amplitudes * 3 * np.cos(3 * t), atol=0.006**2 / 8 * 27 * 1.05 + 2e-8)
    np.testing.assert_allclose(recording.tau, signs * np.array([[1], [2], [3]]) * t, atol=2e-6)
    assert recording.computed == tuple(f"ddq_{joint}" for joint in JOINTS)


def test_prototype_refuses(tmp_path):
    with pytest.raises(UserError, match="no such folder"):
        import_prototype(tmp_path / "nowhere", tmp_path / "out")
    with pytest.raises(UserError, match="holds no file data_file_M_ExpN"):
        import_prototype(tmp_path, tmp_path / "out")
    raw = write_prototype(tmp_path / "raw", [3])
    with pytest.raises(UserError, match="payload's point is nan m"):
        import_prototype(raw, tmp_path / "out", float("nan"))
    (raw / "data_file_2_Exp3.txt").unlink()
    with pytest.raises(UserError, match=r"data_file_2_Exp3\.txt is missing"):
        import_prototype(raw, tmp_path / "out")
    (raw / "data_file_2_Exp3.txt").write_text("1 2 3\n4 5 6\n")
    with pytest.raises(UserError, match="2 rows of 3 numbers; 7"):
        import_prototype(raw, tmp_path / "out")
    (raw / "data_file_2_Exp3.txt").write_text("0 0 0 0 0 0 0\n1 x 0 0 0 0 0\n")
    with pytest.raises(UserError, match="could not convert string 'x'"):
        import_prototype(raw, tmp_path / "out")
    (raw / "data_file_2_Exp3.txt").write_text("0 0 0 0 0 0 0\n1 0 0 0 0 0 0\n1 0 0 0 0 0 0\n")
    with pytest.raises(UserError, match="row 3: time is 1 s after 1 s"):
        import_prototype(raw, tmp_path / "out")
    (raw / "data_file_2_Exp3.txt").write_text("0 0 0 0 0 0 0\n1 0 0 0\n")
    with pytest.raises(UserError, match=r"from 7 to 4 at row 2; 7 columns of numbers"):
        import_prototype(raw, tmp_path / "out")
    (raw / "data_file_2_Exp3.txt").write_text("")
    with warnings.catch_warnings(action="error"), pytest.raises(UserError, match="0 rows"):
        import_prototype(raw, tmp_path / "out")
    (raw / "data_file_2_Exp3.txt").write_text("".join(f"{1e6 + k} 0 0 0 0 0 0\n" for k in range(9)))
    with pytest.raises(UserError, match="have nothing in common"):
        import_prototype(raw, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_prototype_recordings_obey_gravity_and_the_listed_springs(tmp_path):
    folder = real("rrr_prototype")
    found = import_prototype(folder, tmp_path / "out")
    assert len(found.recordings) == 8
    for r in found.recordings:
        effects = tuple(effect for effect, _ in r.springs)
        model = Model(found.robot, found.tool, effects)
        theta = [value for _, values in r.springs for value in values.values()]
        zero, count = np.zeros(3), len(r.t)
        static = model.inverse.map(count)
        load = np.array(static(r.q, zero, zero, r.payload, np.array(theta)[:, None] if theta else [], model.widths)[0])
        for j in (1, 2):  # torque = gain · (gravity − springs) + Coulomb + viscous + offset; signs and springs decide the gain
            regressors = np.column_stack([load[j], np.tanh(r.dq[j] / 0.02), r.dq[j], np.ones(count)])
            gain, coulomb, viscous, _ = np.linalg.lstsq(regressors, r.tau[j], rcond=None)[0]
            assert 0.75 < gain < 1.3, (r.file, j)  # the payload's place is 15 % off and friction depends on load; else 1
            assert coulomb > 0
            assert viscous > 0


@pytest.mark.parametrize("velocity", [True, False])
def test_bags_round_trip(tmp_path, velocity):
    files = [write_mcap(tmp_path / f"{name}.mcap", states(velocity=velocity)) for name in ("one", "two")]
    found = import_ros(files, "rrr", tmp_path / "out")
    assert [r.file for r in found.recordings] == ["one.csv", "two.csv"]
    recording = load_recordings(tmp_path / "out").recordings[1]
    t = 0.01 * np.arange(100)
    np.testing.assert_allclose(recording.t, t, rtol=1e-15)  # nanoseconds since the first stamp, to rounding
    np.testing.assert_array_equal(recording.q, [0.1 * t, 1 + 0.2 * t, -1 - 0.3 * t])
    np.testing.assert_array_equal(recording.tau, np.arange(100.0) + np.arange(3)[:, None])
    np.testing.assert_allclose(recording.dq, np.array([[0.1], [0.2], [-0.3]]) * np.ones(100), atol=1e-11)  # differences of sums
    assert ("dq_joint1" in recording.computed) is not velocity


def write_bag(path, messages, storage):
    """A bag of ROS 1 ("bag") or of ROS 2 ("db3" or "mcap", a folder), with another topic beside the joint states."""
    pytest.importorskip("rosbags", reason="needs the extra 'ros'")
    from rosbags import rosbag1, rosbag2
    from rosbags.typesys import Stores, get_typestore

    first = storage == "bag"
    types = get_typestore(Stores.ROS1_NOETIC if first else Stores.ROS2_JAZZY)
    state, text, header, time = (
        types.types[name]
        for name in ("sensor_msgs/msg/JointState", "std_msgs/msg/String", "std_msgs/msg/Header", "builtin_interfaces/msg/Time")
    )
    encode = types.serialize_ros1 if first else types.serialize_cdr
    plugin = rosbag2.StoragePlugin.SQLITE3 if storage == "db3" else rosbag2.StoragePlugin.MCAP
    with rosbag1.Writer(path) if first else rosbag2.Writer(path, version=9, storage_plugin=plugin) as bag:
        joints = bag.add_connection("/joint_states", state.__msgtype__, typestore=types)
        log = bag.add_connection("/log", text.__msgtype__, typestore=types)
        bag.write(log, START, encode(text(data="hello"), text.__msgtype__))
        for i, m in enumerate(messages):
            sequence = {"seq": i} if first else {}
            rows = {k: np.array(m[k], float) for k in ("position", "velocity", "effort")}
            message = state(header(stamp=time(**m["header"]["stamp"]), frame_id="", **sequence), name=m["name"], **rows)
            bag.write(joints, START + i, encode(message, state.__msgtype__))
    return path


def write_db3(path, bag):
    """The messages of an MCAP file as ROS 2's SQLite storage has them; by SQLite alone."""
    reader = pytest.importorskip("mcap.reader", reason="needs the extra 'test'")
    with contextlib.closing(sqlite3.connect(path)) as base, bag.open("rb") as file, base:
        base.execute(
            "CREATE TABLE topics (id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT, offered_qos_profiles TEXT)"
        )
        base.execute("CREATE TABLE messages (id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB)")
        known = set()
        for schema, channel, message in reader.make_reader(file).iter_messages():
            if channel.id not in known:
                known.add(channel.id)
                base.execute("INSERT INTO topics VALUES (?, ?, ?, 'cdr', '')", (channel.id, channel.topic, schema.name))
            row = (channel.id, message.log_time, message.data)
            base.execute("INSERT INTO messages (topic_id, timestamp, data) VALUES (?, ?, ?)", row)
    return path


def test_bags_of_sqlite_hold_what_the_mcap_file_does(tmp_path):
    file = write_mcap(tmp_path / "a.mcap", states())
    (one,), (other,) = (
        import_ros([path], "rrr", tmp_path / path.suffix[1:]).recordings for path in (file, write_db3(tmp_path / "a.db3", file))
    )
    for name in ("t", "q", "dq", "tau"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


@pytest.mark.parametrize("storage", ["bag", "db3", "mcap"])
@pytest.mark.parametrize("velocity", [True, False])
def test_bags_of_all_kinds_hold_the_same(tmp_path, storage, velocity):
    """The reader's own writer for what no other package writes here; as folders, and as the file alone."""
    name = "take.bag" if storage == "bag" else "take"
    path = write_bag(tmp_path / name, states(velocity=velocity), storage)
    found = [import_ros([path], "rrr", tmp_path / "out")]
    if storage != "bag":
        found.append(import_ros(list(path.glob(f"*.{storage}")), "rrr", tmp_path / "file"))
    t = 0.01 * np.arange(100)
    for one in found:
        (recording,) = one.recordings
        np.testing.assert_allclose(recording.t, t, rtol=1e-15)
        np.testing.assert_array_equal(recording.q, [0.1 * t, 1 + 0.2 * t, -1 - 0.3 * t])
        np.testing.assert_array_equal(recording.tau, np.arange(100.0) + np.arange(3)[:, None])
        assert ("dq_joint1" in recording.computed) is not velocity


def test_bags_with_some_joints_in_amperes(tmp_path):
    file = write_mcap(tmp_path / "a.mcap", states())
    constants = {"joint2": 12.34, "joint3": 10.89}
    found = import_ros(
        [file], "rrr", tmp_path / "out", JointStates(["joint2", "joint3"], None, "current", "nominal", constants)
    )
    assert found.joints == ("joint2", "joint3")
    np.testing.assert_allclose(found.output_torque(found.recordings[0])[0], 12.34 * (np.arange(100.0) + 1))
    with pytest.raises(UserError, match="torque_constant"):
        import_ros([file], "rrr", tmp_path / "none", JointStates(torque="current"))


def changed(index, **change):
    return [{**message, **change} if i == index else message for i, message in enumerate(states())]


def efforts(change):
    """Joint states with other efforts; those of the gripper alone have none."""
    return [m | {"effort": change(m)} if len(m["name"]) > 1 else m for m in states()]


def without_the_first(message):
    return [np.nan if name == JOINTS[0] else 1.0 for name in message["name"]]


@pytest.mark.parametrize(
    ("messages", "arguments", "sentence"),
    [
        (list(states(effort=False)), {}, "topic '/joint_states' reports no effort; torques or currents are required"),
        (efforts(lambda row: [np.nan] * 4), {}, "topic '/joint_states' reports no effort; torques"),
        (efforts(lambda row: [0.0] * 4), {}, "topic '/joint_states' reports no effort, only zeros; torques"),
        (efforts(without_the_first), {}, "topic '/joint_states' reports no effort of joint1; torques"),
        (changed(4, effort=[1.0]), {}, "1 values of effort for 4 joints"),
        (list(states()), {"joints": ["joint1", "elbow"]}, "'elbow' is missing; found joint1"),
        (list(states()), {"joints": ["elbow"]}, "no joint state holds any of elbow"),
        (list(states()), {"topic": "/robot"}, "no message of topic '/robot'"),
        (list(states()), {"topic": "/log"}, "'/log' carries std_msgs/msg/String"),
        (changed(4, header={"stamp": {"sec": START // 10**9, "nanosec": 0}, "frame_id": ""}), {}, "two different joint states"),
        ([m | {"header": {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""}} for m in states()], {}, "have the stamp 0 ns"),
        ([], {}, "no topic carries joint states"),
    ],
)
def test_bags_refuses(tmp_path, messages, arguments, sentence):
    file = write_mcap(tmp_path / "a.mcap", messages)
    with pytest.raises(UserError, match=sentence):
        import_ros([file], "rrr", tmp_path / "out", JointStates(**arguments))
    assert not (tmp_path / "out").exists()


def test_bags_topics_and_repeated_messages(tmp_path):
    file = write_mcap(tmp_path / "a.mcap", [m for m in states() for _ in range(2)], topics=("/a", "/b"))
    with pytest.raises(UserError, match="2 topics carry joint states: /a, /b; name one"):
        import_ros([file], "rrr", tmp_path / "out")
    assert len(import_ros([file], "rrr", tmp_path / "out", JointStates(topic="/b")).recordings[0].t) == 100
    twice = write_mcap(tmp_path / "b.mcap", [m for m in states() for _ in range(2)])
    assert len(import_ros([twice], "rrr", tmp_path / "again").recordings[0].t) == 100


def test_bags_broken_files(tmp_path):
    data = write_mcap(tmp_path / "a.mcap", states()).read_bytes()
    rng = np.random.default_rng(5)
    outcomes = set()
    for trial in range(60):
        broken = bytearray(data[: rng.integers(len(data))] if trial % 2 else data)
        for _ in range(3):
            broken[rng.integers(len(broken))] = rng.integers(256)
        (tmp_path / "b.mcap").write_bytes(broken)
        try:
            outcomes.add(type(import_ros([tmp_path / "b.mcap"], "rrr", tmp_path / f"out{trial}")))
        except UserError as error:
            outcomes.add(type(error))
    assert UserError in outcomes
    with pytest.raises(UserError, match="no such file"):
        import_ros([tmp_path / "none.mcap"], "rrr", tmp_path / "out")
    with pytest.raises(UserError, match="same name"):
        import_ros([tmp_path / "a.mcap"] * 2, "rrr", tmp_path / "out")
    with pytest.raises(UserError, match="at least one"):
        import_ros([], "rrr", tmp_path / "out")


def test_bags_without_the_package(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rosbags", None)
    with pytest.raises(UserError, match="pip install rosbags"):
        import_ros([tmp_path / "a.mcap"], "rrr", tmp_path / "out")
