"""The calibrated model: a robot with effects and their estimated parameters, and the torques that it predicts for a recording."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from rrr_oc.effects import Delay, Effect, OfEach
from rrr_oc.errors import UserError
from rrr_oc.model.parameters import offsets
from rrr_oc.model.recorded_physics import Physics
from rrr_oc.model.shared_model import shared_model
from rrr_oc.recordings.recording import Recording, RecordingSet
from rrr_oc.robot.robot import Robot, ToolPoint

KINEMATICS = 1e-3  # [m] and 1, by which two descriptions of a robot may differ; doubled, coarser errors of a URDF pass
Kind = Literal["motor", "load", "current", "command"]


@dataclass(frozen=True)
class Estimate:
    """A parameter estimated from recordings, in its own unit.

    Attributes:
        value: The estimate, within the parameter's bounds.
        std: Standard error; None where the recordings do not determine it.
        interval: 95 % confidence interval, cut at the bounds; None as `std`.
        at_bound: Whether the estimate lies at a bound.
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
    """A robot with effects and their estimated parameters.

    Attributes:
        robot: The chain, with the inertial parameters in use.
        source: Name of the bundled model, or "urdf".
        urdf: Text of the URDF that the kinematics come from.
        tool: Where a payload is held.
        torque: What `predict` returns: "motor" or "load" torque [Nm], "current" [A], or of a loop that follows a "command" its torque [Nm].
        torque_constant: Per joint [Nm/A at the output]; None where it is not given.
        inertial: "nominal": the URDF's inertial parameters; "identify": estimated ones.
        terms: The effects, in the order in which they are added up.
        noise: Standard deviation of the recorded signal's noise, one per joint, at the joint's output [Nm].
        nrmse: Of the predicted torque over the recordings calibrated on, mean over recordings, one per joint [1].
        report: Of the fit: correlations, conditioning, wall time and the like, as plain data.
        spread: Covariance of the p parameters of all terms and of the links' inertial parameters, link by link, as a matrix
            (p + 10 n, r) whose product with its transpose it is; None where it is not known.
        alternatives: Other models that the recordings do not tell from this one.
        unexplained: Rms of the torque that is left beyond noise where a joint's error is far above it, else 0, one per joint (n,) [Nm];
            None where it is not known.
        versions: Of the packages that made it.
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
    spread: np.ndarray | None = None
    alternatives: tuple["Alternative", ...] = ()
    unexplained: np.ndarray | None = None

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints, base first."""
        return self.robot.joints

    @property
    def values(self) -> np.ndarray:
        """The parameters of all terms, in their order."""
        return np.concatenate([np.zeros(0), *(term.values for term in self.terms)])

    @property
    def offsets(self) -> list[int]:
        """Number of the first of `values` of each term, and last that of all."""
        return offsets([term.effect for term in self.terms])

    def without_values(self, recordings: RecordingSet) -> dict[str, list[str]]:
        """Files of recordings for which effects with a value of its own in each have none, so that it counts as 0, by effect and joints."""
        result = {}
        for term in self.terms:
            if isinstance(term.effect, OfEach) and term.effect.each:
                unknown = [r.file for r in recordings.recordings if r.group not in term.effect.each]
                label = f"{term.effect.name} of {', '.join(self.joints[j] for j in term.effect.joints)}"
                result |= {label: unknown} if unknown else {}
        return result

    def physics(self, recording: Recording) -> Physics:
        """What is at work in a recording: the springs it lists, then the terms that hold for it."""
        terms = [term for term in self.prompt_terms if term.holds_for(recording)]
        own = (replace(t.effect, here=recording.group) if _in_symbols(t.effect) else t.effect for t in terms)
        effects = (*(spring for spring, _ in recording.springs), *own)
        springs = [theta[p.name] for effect, theta in recording.springs for p in effect.parameters]
        widths = [effect.width.nominal for effect, _ in recording.springs if effect.width is not None]
        return Physics(
            shared_model(self.robot, self.tool, effects),
            np.concatenate([springs, *(term.values for term in terms)]),
            np.array(widths + [term.width for term in terms if term.width is not None]),
            self.robot.inertial,
            self.delays(recording),
            self.waits(recording),
        )

    @property
    def prompt_terms(self) -> tuple[Term, ...]:
        """The terms that are no delays."""
        return tuple(term for term in self.terms if not isinstance(term.effect, Delay))

    def delays(self, recording: Recording) -> tuple[float, ...]:
        """By how much the recorded torque of each joint lags the motion of a recording [s], (n,)."""
        return self._times(recording, "delay")

    def waits(self, recording: Recording) -> tuple[float, ...]:
        """By how much later than they are recorded the commands of each joint act in a recording [s], (n,)."""
        return self._times(recording, "wait")

    def _times(self, recording: Recording, kind: Literal["delay", "wait"]) -> tuple[float, ...]:
        result = np.zeros(self.robot.n)
        for term in self.terms:
            if isinstance(term.effect, Delay) and term.holds_for(recording):
                result[list(term.effect.joints) or slice(None)] += getattr(term.effect, kind)(term.named)
        return tuple(result.tolist())

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


def _in_symbols(effect: Effect) -> bool:
    """Whether an effect has a value of its own in each set-up, and symbols are made of its law, which know no set-up."""
    return isinstance(effect, OfEach) and effect.side in ("drive", "link")


@dataclass(frozen=True)
class Alternative:
    """A model that recordings do not tell from another one.

    Attributes:
        model: It, with a spread of its own.
        says: In what it differs, in words.
        effects: Names of the effects in which the two differ; "link_errors" stands for the links.
        decided_by: File with the motion, of those that the diagnosis suggests, which would decide; None without one.
    """

    model: CalibratedModel
    says: str
    effects: tuple[str, ...] = ()
    decided_by: str | None = None
