"""The calibrated model as data: what `model.json` holds, and the torques that it predicts for a recording."""

import json
import math
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from rrr_oc.effects import CATALOGUE, Effect
from rrr_oc.errors import UserError
from rrr_oc.model.recorded_physics import Physics
from rrr_oc.model.symbolic_model import Model
from rrr_oc.recordings.recording import Recording, RecordingSet
from rrr_oc.robot.robot import Robot, ToolPoint, load_robot
from rrr_oc.storage import write_json

FORMAT = "rrr_oc-model/1"
KINEMATICS = 1e-3  # [m] and 1: what two descriptions of a robot may differ by
Kind = Literal["motor", "load", "current"]


@dataclass(frozen=True)
class Estimate:
    """A parameter as recordings tell it, in its own unit.

    Attributes:
        value: The estimate, within the parameter's bounds.
        std: Standard error; None where the recordings do not decide it.
        interval: 95 % confidence interval, cut at the bounds; None as `std`.
        at_bound: Whether the estimate is held by a bound.
    """

    value: float
    std: float | None = None
    interval: tuple[float, float] | None = None
    at_bound: bool = False


@dataclass(frozen=True)
class Term:
    """An effect in a model of recordings, and for which of them it holds.

    Attributes:
        effect: The effect on its joints.
        estimates: One per parameter of the effect.
        width: Smoothing width, in the unit of `Effect.width`; None where the effect has none.
        recordings: "all", or the files of the recordings that have it.
        groups: Labels of physical set-ups that have it too, in whichever set they stand.
    """

    effect: Effect
    estimates: tuple[Estimate, ...]
    width: float | None = None
    recordings: Literal["all"] | tuple[str, ...] = "all"
    groups: tuple[str, ...] = ()

    def holds_for(self, recording: Recording) -> bool:
        """Whether the effect is at work in a recording."""
        if "springs" in self.effect.inputs and self.effect.joints not in [spring.joints for spring, _ in recording.springs]:
            return False
        return self.recordings == "all" or recording.file in self.recordings or recording.group in self.groups

    @property
    def values(self) -> np.ndarray:
        """The parameters' values, (number of parameters,)."""
        return np.array([e.value for e in self.estimates])

    @property
    def named(self) -> dict[str, float]:
        """The parameters' values by name."""
        return {p.name: e.value for p, e in zip(self.effect.parameters, self.estimates, strict=True)}

    def with_values(self, values: np.ndarray) -> "Term":
        """The same term with bare values."""
        return replace(self, estimates=tuple(Estimate(float(v)) for v in values))


def nominal_term(effect: Effect) -> Term:
    """A term at its parameters' nominal values, for all recordings."""
    width = None if effect.width is None else effect.width.nominal
    return Term(effect, tuple(Estimate(p.nominal) for p in effect.parameters), width)


@dataclass(frozen=True)
class CalibratedModel:
    """A robot with the parameters that recordings gave it.

    Attributes:
        robot: The chain, with the inertial parameters in use.
        source: Name of the bundled model, or "urdf".
        urdf: Text of the URDF that the kinematics come from.
        tool: Where a payload is held.
        torque: What `predict` returns: "motor" or "load" torque [Nm], or "current" [A].
        torque_constant: Per joint [Nm/A at the output]; None where it is not given.
        inertial: "nominal": the URDF's inertial parameters; "identify": estimated ones.
        terms: The effects, in the order in which they are added up.
        noise: Standard deviation of the recorded signal's noise, one per joint, at the joint's output [Nm].
        nrmse: Of the predicted torque over the recordings calibrated on, mean over recordings, one per joint [1].
        report: How it was found: correlations, conditioning, wall time and the like, as plain data.
        versions: Of the packages that made it.
        compiled: Models in use, shared by the copies that `replace` makes.
    """

    robot: Robot
    source: str
    urdf: str
    tool: ToolPoint
    torque: Kind
    torque_constant: tuple[float | None, ...]
    inertial: Literal["nominal", "identify"]
    terms: tuple[Term, ...]
    noise: np.ndarray
    nrmse: np.ndarray
    report: Mapping[str, Any] = field(default_factory=dict)
    versions: Mapping[str, str] = field(default_factory=dict)
    compiled: dict[tuple[Any, ...], Model] = field(default_factory=dict, compare=False, repr=False)

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints, base first."""
        return self.robot.joints

    @property
    def values(self) -> np.ndarray:
        """The parameters of all terms, in their order."""
        return np.concatenate([np.zeros(0), *(term.values for term in self.terms)])

    def physics(self, recording: Recording) -> Physics:
        """What is at work in a recording: the springs it lists, then the terms that hold for it."""
        terms = [term for term in self.terms if term.holds_for(recording)]
        effects = (*(spring for spring, _ in recording.springs), *(term.effect for term in terms))
        robot = self.robot  # its inertial parameters enter as numbers
        tool = self.tool.joint, *self.tool.position.tolist()
        key = (robot.placements.tobytes(), robot.axes.tobytes(), robot.gravity.tobytes(), tool, effects)
        if key not in self.compiled:
            self.compiled[key] = Model(self.robot, self.tool, effects)
        springs = [theta[p.name] for effect, theta in recording.springs for p in effect.parameters]
        widths = [effect.width.nominal for effect, _ in recording.springs if effect.width is not None]
        return Physics(
            self.compiled[key],
            np.concatenate([springs, *(term.values for term in terms)]),
            np.array(widths + [term.width for term in terms if term.width is not None]),
            robot.inertial,
        )

    def torques(self, recording: Recording) -> tuple[np.ndarray, np.ndarray]:
        """Motor torque and load torque that a recorded motion needs, each (n, K) [Nm]."""
        return self.physics(recording).torques(recording)

    def true_torque(self, recording: Recording, physics: Physics | None = None) -> np.ndarray:
        """The torque that is recorded, motor or load, as a perfect sensor has it, from the recorded motion, (n, K) [Nm]."""
        motor, load = (physics or self.physics(recording)).torques(recording)
        return load if self.torque == "load" else motor

    def output_torque(self, recording: Recording, physics: Physics | None = None) -> np.ndarray:
        """What `RecordingSet.output_torque` measures, from the recorded motion, (n, K) [Nm]."""
        physics = physics or self.physics(recording)
        return physics.recorded(recording, self.true_torque(recording, physics))

    def predicted_torque(self, recording: Recording) -> np.ndarray:
        """As `output_torque`, with the start of links that move by themselves behind their gears estimated from the recorded torque.

        Two numbers for each such joint and each stretch without a gap, of which the motion of the drives says nothing; least squares.
        """
        physics = self.physics(recording)
        result, starts = self.output_torque(recording, physics), physics.starts(recording, self.torque == "load")
        left = recording.tau * self._unit - result
        for s in recording.segments if len(starts) else ():
            if s.stop - s.start > len(starts):
                sizes = np.maximum(np.std(np.diff(left[:, s]), axis=1), 1e-9)[:, None]  # of noise, more or less
                columns = (starts[:, :, s] / sizes).reshape(len(starts), -1).T
                size = np.linalg.lstsq(columns, (left[:, s] / sizes).ravel(), rcond=1e-9)[0]
                result[:, s] += np.tensordot(size, starts[:, :, s], 1)
        return result

    def predict(self, recording: Recording) -> np.ndarray:
        """The recorded signal, in its own unit, as `predicted_torque` has it, (n, K), at every sample."""
        return self.predicted_torque(recording) / self._unit

    @property
    def _unit(self) -> np.ndarray:
        """Torque [Nm] that a recorded 1 stands for, (n, 1)."""
        return np.array(self.torque_constant, float)[:, None] if self.torque == "current" else np.ones((self.robot.n, 1))

    def placed(self, recordings: RecordingSet) -> "CalibratedModel":
        """The model under the gravity and with the torque constants of recordings and, where they list a payload, with it at their tool.

        Raises `UserError` unless the recordings are of this robot's joints, as they are in space, and of the signal that is predicted.
        """
        if recordings.joints != self.joints:
            raise UserError(
                f"{recordings.path}: records the joints {', '.join(recordings.joints)}, but the model has {', '.join(self.joints)}"
            )
        if recordings.torque != self.torque:
            raise UserError(f"{recordings.path}: records torque {recordings.torque!r}, but the model predicts {self.torque!r}")
        arm, own = recordings.robot, self.robot
        apart = [
            np.abs(a - b).max(axis=(1, 2))
            for a, b in ((arm.placements, own.placements), (arm.axes[..., None], own.axes[..., None]))
        ]
        other = np.flatnonzero(np.max(apart, axis=0) > KINEMATICS)
        if len(other):
            raise UserError(
                f"{recordings.path}: joint {self.joints[other[0]]} of {recordings.source} sits or turns otherwise than in the model; "
                "recordings of the same robot are required"
            )
        loaded = any(np.any(r.payload > 0) for r in recordings.recordings)
        tool = recordings.tool if loaded else self.tool
        constants = recordings.torque_constant if self.torque == "current" else self.torque_constant
        return replace(self, robot=replace(own, gravity=recordings.gravity), tool=tool, torque_constant=constants)


def save_model(model: CalibratedModel, path: str | Path) -> None:
    """Write `model.json`, whole or not at all."""
    write_json(path, to_json(model))


def to_json(model: CalibratedModel) -> dict[str, Any]:
    """The content of `model.json`."""
    robot = model.robot
    return {
        "format": FORMAT,
        "versions": dict(model.versions),
        "robot": {
            "name": robot.name,
            "source": model.source,
            "urdf": model.urdf,
            "inertial": dict(zip(robot.links, robot.inertial.T.tolist(), strict=True)),
            "inertial_order": "m [kg], m c [kg m] (x, y, z), I about the joint's frame [kg m²] (xx, xy, yy, xz, yz, zz)",
        },
        "joints": list(robot.joints),
        "gravity": robot.gravity.tolist(),
        "tool": {"joint": robot.joints[model.tool.joint], "position": model.tool.position.tolist()},
        "torque": model.torque,
        "torque_constant": dict(zip(robot.joints, model.torque_constant, strict=True)),
        "inertial": model.inertial,
        "effects": [_term_json(term, robot) for term in model.terms],
        "noise": {joint: number(v) for joint, v in zip(robot.joints, model.noise, strict=True)},
        "nrmse": {joint: number(v) for joint, v in zip(robot.joints, model.nrmse, strict=True)},
        "report": dict(model.report),
    }


def _term_json(term: Term, robot: Robot) -> dict[str, Any]:
    options = {f.name: getattr(term.effect, f.name) for f in fields(term.effect) if f.name != "joints"}
    return {
        "effect": term.effect.name,
        "joints": [robot.joints[j] for j in term.effect.joints],
        "options": {name: list(value) if isinstance(value, tuple) else value for name, value in options.items()},
        "width": None
        if term.width is None or term.effect.width is None
        else {"value": term.width, "unit": term.effect.width.unit},
        "recordings": "all" if term.recordings == "all" else list(term.recordings),
        "groups": list(term.groups),
        "parameters": {
            p.name: {
                "value": e.value,
                "unit": p.unit,
                "std": number(e.std),
                "interval": None if e.interval is None else list(e.interval),
                "at_bound": e.at_bound,
            }
            for p, e in zip(term.effect.parameters, term.estimates, strict=True)
        },
    }


def number(value: float | None) -> float | None:
    """A number for JSON, which has neither NaN nor infinity."""
    return None if value is None or not math.isfinite(value) else float(value)


def load_model(path: str | Path) -> CalibratedModel:
    """Read `model.json`.

    Raises:
        UserError: The file is missing, no JSON, of another format, or something in it is missing or wrong; the message names
            the file and the key.
    """
    path = Path(path)
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UserError(
            f"{path}: cannot be read: {error.strerror}; a model.json that rrr-oc calibrate wrote is needed"
        ) from None
    except (ValueError, RecursionError) as error:
        raise UserError(f"{path}: not usable JSON: {error}; a model.json that rrr-oc calibrate wrote is needed") from None
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        found = data.get("format") if isinstance(data, dict) else type(data).__name__
        raise UserError(f"{path}: format is {found!r}; {FORMAT!r} is required (a recording set is calibrated first)")
    try:
        return _from_json(data)
    except KeyError as error:
        raise UserError(f"{path}: key {error.args[0]!r} is missing") from None
    except UserError as error:
        raise UserError(f"{path}: {error}") from None
    except (TypeError, ValueError, AttributeError) as error:
        raise UserError(f"{path}: not a whole model: {error}") from None


def _from_json(data: Mapping[str, Any]) -> CalibratedModel:
    described, joints = data["robot"], tuple(data["joints"])
    robot = _robot(described["name"], described["urdf"], joints, data["gravity"])
    inertial = np.array([described["inertial"][link] for link in robot.links], float).T
    if inertial.shape != (10, robot.n) or not np.all(np.isfinite(inertial)):
        raise UserError(f"robot.inertial: ten finite numbers for each of {', '.join(robot.links)} are required")
    tool = ToolPoint(robot.index(data["tool"]["joint"]), _vector(data["tool"]["position"], 3, "tool.position"))
    for key, allowed in (("torque", ("motor", "load", "current")), ("inertial", ("nominal", "identify"))):
        if data[key] not in allowed:
            raise UserError(f"{key}: found {data[key]!r}; allowed are {', '.join(allowed)}")
    constants = tuple(data["torque_constant"][joint] for joint in joints)
    if data["torque"] == "current" and not all(constants):
        raise UserError("torque_constant: torque 'current' needs one for every joint [Nm/A]")
    return CalibratedModel(
        robot=replace(robot, inertial=inertial),
        source=str(described["source"]),
        urdf=described["urdf"],
        tool=tool,
        torque=data["torque"],
        torque_constant=constants,
        inertial=data["inertial"],
        terms=tuple(_term(entry, robot) for entry in data["effects"]),
        noise=np.array([data["noise"][joint] for joint in joints], float),
        nrmse=np.array([data["nrmse"][joint] for joint in joints], float),
        report=data["report"],
        versions=data["versions"],
    )


def _robot(name: str, urdf: str, joints: Sequence[str], gravity: Sequence[float]) -> Robot:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "model.urdf"
        file.write_text(urdf, encoding="utf-8")
        robot = load_robot(file, joints, inertial=False, gravity=_vector(gravity, 3, "gravity").tolist())
    return replace(robot, name=name)


def _term(entry: Mapping[str, Any], robot: Robot) -> Term:
    name = entry["effect"]
    if name not in CATALOGUE:
        raise UserError(f"effects: unknown effect {name!r}; this version knows {', '.join(sorted(CATALOGUE))}")
    options = {key: _as_tuples(value) for key, value in entry["options"].items()}
    effect = CATALOGUE[name](tuple(robot.index(joint) for joint in entry["joints"]), **options)
    estimates = tuple(_estimate(entry["parameters"][p.name], f"{name}.{p.name}") for p in effect.parameters)
    width = None
    if effect.width is not None:
        width = float(entry["width"]["value"])
        if not 0 <= width < math.inf:
            raise UserError(f"{name}: width {width} {effect.width.unit}; a finite number of 0 or more is required")
    recordings = entry["recordings"] if entry["recordings"] == "all" else tuple(entry["recordings"])
    return Term(effect, estimates, width, recordings, tuple(entry["groups"]))


def _as_tuples(value: Any) -> Any:
    return tuple(_as_tuples(item) for item in value) if isinstance(value, list) else value


def _estimate(entry: Mapping[str, Any], where: str) -> Estimate:
    value = float(entry["value"])
    if not math.isfinite(value):
        raise UserError(f"{where}: found {value}; a finite number is required")
    interval = None if entry["interval"] is None else tuple(_vector(entry["interval"], 2, f"{where}: interval").tolist())
    return Estimate(value, entry["std"], interval, bool(entry["at_bound"]))  # pyright: ignore[reportArgumentType]


def _vector(values: Any, count: int, where: str) -> np.ndarray:
    vector = np.array(values, float)
    if vector.shape != (count,) or not np.all(np.isfinite(vector)):
        raise UserError(f"{where}: found {values!r}; {count} finite numbers are required")
    return vector
