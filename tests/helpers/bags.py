"""Bags of ROS 2 with joint states of a made-up motion, by a writer that is not the reader's."""

import pytest
from prototype import JOINTS

DEFINITION = """std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
START = 1_700_000_000_000_000_000


def joint_state(stamp, names, position, velocity, effort):
    header = {"stamp": {"sec": stamp // 10**9, "nanosec": stamp % 10**9}, "frame_id": ""}
    return {"header": header, "name": list(names), "position": position, "velocity": velocity, "effort": effort}


def states(rows=100, velocity=True, effort=True):
    """Joint states of a made-up motion, in shuffled joint order, with a gripper's messages in between."""
    for k in range(rows):
        t, stamp = 0.01 * k, START + k * 10_000_000
        q = [0.1 * t, 1 + 0.2 * t, -1 - 0.3 * t]
        order = [2, 0, 1] if k % 2 else [0, 1, 2]
        names = [JOINTS[i] for i in order] + ["finger"]
        speeds = [(0.1, 0.2, -0.3)[i] for i in order] + [0.0]
        efforts = [float(i + k) for i in order] + [0.0]
        yield joint_state(stamp, names, [q[i] for i in order] + [0.0], speeds if velocity else [], efforts if effort else [])
        yield joint_state(stamp + 5, ["finger"], [0.0], [], [])


def write_mcap(path, messages, topics=("/joint_states",)):
    mcap = pytest.importorskip("mcap_ros2.writer", reason="needs the extra 'test'")
    pytest.importorskip("rosbags", reason="needs the extra 'ros'")
    with path.open("wb") as file, mcap.Writer(file) as writer:
        schema = writer.register_msgdef("sensor_msgs/msg/JointState", DEFINITION)
        other = writer.register_msgdef("std_msgs/msg/String", "string data")
        writer.write_message("/log", other, {"data": "hello"}, log_time=START)
        for i, message in enumerate(messages):
            writer.write_message(topics[i % len(topics)], schema, message, log_time=START + i)
    return path
