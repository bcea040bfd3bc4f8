"""MCAP files (ROS 2 bags) with sensor_msgs/JointState messages, turned into a recording set."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from rrr_oc.errors import UserError
from rrr_oc.recordings.recording import RecordingSet
from rrr_oc.recordings.writer import constants, write_files
from rrr_oc.robot.robot import load_robot

SCHEMAS = ("sensor_msgs/msg/JointState", "sensor_msgs/JointState")


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


def import_mcap(
    files: Sequence[str | Path], robot: str | Path, out: str | Path, states: JointStates | None = None
) -> RecordingSet:
    """Write MCAP files, each one recording, of a robot (bundled model, URDF or MJCF) as a new recording set in the folder `out`.

    Time is the header's stamp, from the first one on. Joints are found by name; messages with none of them are another
    device's and skipped. Without velocities, speeds are computed when the set is read.

    Raises:
        UserError: The packages for MCAP are missing; a file is none or holds no joint states; a message lacks a joint, an
            effort or a stamp; two messages of one time differ; `out` exists.
    """
    if not files:
        raise UserError("no MCAP file given; at least one is required")
    states = states or JointStates()
    names = load_robot(robot, None, states.inertial == "nominal").joints if states.joints is None else states.joints
    effort = "current" if states.torque == "current" else "tau"
    header = {
        "joints": list(names),
        "torque": states.torque,
        "inertial": states.inertial,
        "actuators": constants(states.torque_constant),
    }

    def read(file: Path) -> dict[str, np.ndarray]:
        return _columns(file, _samples(file, states.topic, names), names, effort)

    return write_files(out, robot, header, files, read)


def _samples(file: Path, topic: str | None, joints: Sequence[str]) -> list[tuple[int, tuple[float, ...]]]:
    """Stamp [ns] and position, velocity (NaN where there is none) and effort of all joints, by message."""
    samples = []
    for number, message in enumerate(_messages(file, topic), 1):
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
            if len(array) == 0 and kind == "velocity":
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


def _messages(file: Path, topic: str | None) -> Iterator[Any]:
    """Decoded joint states of one topic in the order of the log."""
    try:
        from mcap.reader import make_reader
        from mcap_ros2.decoder import DecoderFactory
    except ImportError:
        raise UserError("reading MCAP files needs two more packages: pip install 'rrr_oc[mcap]'") from None
    if not file.is_file():
        raise UserError(f"{file}: no such file; an MCAP file is required")
    try:
        with file.open("rb") as stream:
            topic = topic or _only_topic(file, make_reader(stream))
            stream.seek(0)
            reader, found = make_reader(stream, decoder_factories=[DecoderFactory()]), False
            for schema, channel, _, message in reader.iter_decoded_messages([topic]):
                if schema is None or schema.name not in SCHEMAS:
                    name = schema.name if schema else "nothing"
                    raise UserError(f"{file}: topic {channel.topic!r} carries {name}; {SCHEMAS[0]} is required")
                found = True
                yield message
            if not found:
                raise UserError(f"{file}: no message of topic {topic!r}")
    except UserError:
        raise
    except Exception as error:  # the decoders raise whatever broken bytes lead to
        raise UserError(f"{file}: not a readable MCAP file of ROS 2 messages: {error or type(error).__name__}") from error


def _only_topic(file: Path, reader: Any) -> str:
    topics = sorted({c.topic for schema, c, _ in reader.iter_messages() if schema is not None and schema.name in SCHEMAS})
    if not topics:
        raise UserError(f"{file}: no topic carries joint states ({SCHEMAS[0]})")
    if len(topics) > 1:
        raise UserError(f"{file}: {len(topics)} topics carry joint states: {', '.join(topics)}; name one ({SCHEMAS[0]})")
    return topics[0]
