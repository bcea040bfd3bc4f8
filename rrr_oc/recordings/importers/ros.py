"""Bags of ROS 1 and ROS 2 with sensor_msgs/JointState messages, turned into a recording set."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from rrr_oc.errors import UserError
from rrr_oc.recordings.recording import RecordingSet
from rrr_oc.recordings.writer import constants, write_files
from rrr_oc.robot.robot import load_robot

TYPE = "sensor_msgs/msg/JointState"  # in all distributions of ROS the same
SPELLINGS = (TYPE, "sensor_msgs/JointState")
KINDS = "a file .bag (ROS 1), .db3 or .mcap (ROS 2), or a folder with metadata.yaml (ROS 2)"


@dataclass(frozen=True)
class JointStates:
    """How joint states are to be understood; keys and values as in `recordings.json`.

    Attributes:
        joints: Joints recorded, in the order of the chain. Default: all of the robot's.
        topic: Topic of the joint states. Default: the only one there is.
        torque: What the efforts are: "motor" or "load" torque [Nm], or "current" [A].
        inertial: "nominal" or "identify".
        torque_constant: By joint [Nm/A], for currents.
    """

    joints: Sequence[str] | None = None
    topic: str | None = None
    torque: str = "motor"
    inertial: str = "nominal"
    torque_constant: Mapping[str, float] = field(default_factory=dict)


EFFORTS_OF_STATES = ("motor", "load", "current")  # what efforts of joint states may be


def import_ros(
    files: Sequence[str | Path], robot: str | Path, out: str | Path, states: JointStates | None = None
) -> RecordingSet:
    """Write bags, each one recording, of a robot (bundled model, URDF or MJCF) as a new recording set in the folder `out`.

    A bag is a file .bag, .db3 or .mcap, or the folder of a bag of ROS 2. Time is the header's stamp, from the first one on. Joints
    are found by name; messages with none of them are another device's and skipped. Without velocities, speeds are computed when the
    set is read.

    Raises:
        UserError: The package rosbags is missing; a file is no bag or holds no joint states; a message lacks a joint or a stamp; the
            topic reports no effort; two messages of one time differ; `out` exists.
    """
    if not files:
        raise UserError("no bag given; at least one is required")
    states = states or JointStates()
    if states.torque not in EFFORTS_OF_STATES:
        raise UserError(
            f"torque: found {states.torque!r}; joint states have efforts: {', '.join(EFFORTS_OF_STATES)} are allowed"
        )
    names = load_robot(robot, None, states.inertial == "nominal").joints if states.joints is None else states.joints
    effort = "current" if states.torque == "current" else "tau"
    header = {
        "joints": list(names),
        "torque": states.torque,
        "inertial": states.inertial,
        "actuators": constants(states.torque_constant),
    }

    def read(file: Path) -> dict[str, np.ndarray]:
        topic, messages = _messages(file, states.topic)
        columns = _columns(file, _samples(file, messages, names), names, effort)
        _check_effort(f"{file}: topic {topic!r}", [columns.get(f"{effort}_{joint}") for joint in names], names)
        return columns

    return write_files(out, robot, header, files, read)


def _samples(file: Path, messages: Iterable[Any], joints: Sequence[str]) -> list[tuple[int, tuple[float, ...]]]:
    """Stamp [ns] and position, velocity (NaN where there is none) and effort of all joints, by message."""
    samples = []
    for number, message in enumerate(messages, 1):
        where = f"{file}, joint state {number}"
        present = [joint for joint in joints if joint in message.name]
        if not present:
            continue
        if len(present) < len(joints):
            missing = next(joint for joint in joints if joint not in present)
            raise UserError(f"{where}: joint {missing!r} is missing; found {', '.join(message.name)}")
        values = []
        for kind in ("position", "velocity", "effort"):
            array = getattr(message, kind)
            if len(array) == 0 and kind != "position":
                values += [np.nan] * len(joints)
                continue
            if len(array) != len(message.name):
                raise UserError(
                    f"{where}: {len(array)} values of {kind} for {len(message.name)} joints; one per joint is required"
                )
            values += [float(array[message.name.index(joint)]) for joint in joints]
        samples.append((message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec, tuple(values)))
    if not samples:
        raise UserError(f"{file}: no joint state holds any of {', '.join(joints)}")
    return samples


def _check_effort(where: str, efforts: Sequence[np.ndarray | None], joints: Sequence[str]) -> None:
    """Raise `UserError` where the efforts of joints are missing throughout, or all of them are 0, as drivers without them report."""
    missing = [joint for joint, row in zip(joints, efforts, strict=True) if row is None]
    silent = not missing and not any(np.any(np.nan_to_num(row)) for row in efforts if row is not None)
    if missing or silent:
        of = "" if silent or len(missing) == len(joints) else f" of {', '.join(missing)}"
        zeros = ", only zeros" if silent else ""
        raise UserError(
            f"{where} reports no effort{of}{zeros}; torques or currents are required, perhaps of another topic (--topic)"
        )


def _columns(
    file: Path, samples: list[tuple[int, tuple[float, ...]]], joints: Sequence[str], effort: str
) -> dict[str, np.ndarray]:
    """Columns of a recording, sorted by time; a message that stands twice counts once."""
    if len({stamp for stamp, _ in samples}) == 1 and len(samples) > 1:
        raise UserError(
            f"{file}: all {len(samples)} messages have the stamp {samples[0][0]} ns; header stamps that advance are required"
        )
    samples = sorted(samples, key=lambda sample: sample[0])
    kept = samples[:1]
    for stamp, values in samples[1:]:
        if stamp != kept[-1][0]:
            kept.append((stamp, values))
        elif not np.array_equal(values, kept[-1][1], equal_nan=True):
            raise UserError(f"{file}: two different joint states have the stamp {stamp} ns; one per time is required")
    t = np.array([stamp - kept[0][0] for stamp, _ in kept]) * 1e-9
    arrays = np.array([values for _, values in kept]).T
    names = [f"{kind}_{joint}" for kind in ("q", "dq", effort) for joint in joints]
    given = {name: array for name, array in zip(names, arrays, strict=True) if not np.all(np.isnan(array))}
    return {"t": t, **given}


def _messages(file: Path, topic: str | None) -> tuple[str, list[Any]]:
    """The topic, and its joint states in the order of the log."""
    try:
        from rosbags import rosbag1, rosbag2
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise UserError("reading bags of ROS needs one more package: pip install rosbags") from None
    if not file.exists():
        raise UserError(f"{file}: no such file; {KINDS} is required")
    first = file.suffix == ".bag"
    types = get_typestore(Stores.ROS1_NOETIC if first else Stores.ROS2_HUMBLE)
    decode = types.deserialize_ros1 if first else types.deserialize_cdr
    try:
        with rosbag1.Reader(file) if first else rosbag2.Reader(file) as bag:
            of_topics = {c.topic: c.msgtype for c in bag.connections}
            name = topic or _only_topic(file, of_topics)
            if of_topics.get(name, TYPE) not in SPELLINGS:
                raise UserError(f"{file}: topic {name!r} carries {of_topics[name]}; {TYPE} is required")
            chosen = [c for c in bag.connections if c.topic == name]
            found = [decode(bytes(data), TYPE) for _, _, data in (bag.messages(chosen) if chosen else ())]
    except UserError:
        raise
    except Exception as error:  # the decoders raise whatever broken bytes lead to
        said = str(error) or type(error).__name__
        raise UserError(f"{file}: not a readable bag of ROS ({KINDS}): {said}") from error
    if not found:
        raise UserError(f"{file}: no message of topic {name!r}")
    return name, found


def _only_topic(file: Path, of_topics: Mapping[str, str]) -> str:
    topics = sorted(topic for topic, kind in of_topics.items() if kind in SPELLINGS)
    if not topics:
        raise UserError(f"{file}: no topic carries joint states ({TYPE}); there are {', '.join(sorted(of_topics)) or 'none'}")
    if len(topics) > 1:
        raise UserError(f"{file}: {len(topics)} topics carry joint states: {', '.join(topics)}; name one ({TYPE})")
    return topics[0]
