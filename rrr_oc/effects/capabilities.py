"""What an effect can do beside giving a torque, a small base class for each.

An effect's file derives from those that it needs and overrides what it is about. Other folders ask by `isinstance`. What springs
can do is in `effects/springs.py`.
"""

# pyright: reportAttributeAccessIssue=false
# (mujoco's wheel has no stubs)

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from rrr_oc.effects.base import Effect, Signals, Trial, View
from rrr_oc.effects.words import ByRecording, listed
from rrr_oc.errors import UserError
from rrr_oc.robot.parameters import Parameter


@dataclass(frozen=True)
class Body:
    """The rigid body as a `BodyChange` may change it; casadi or numpy.

    Attributes:
        inertial: Inertial parameters of the links without payload, as `Robot.inertial`, (10, n).
        gravity: Gravity in the base frame [m/s²], (3,).
        payload: Mass at the tool [kg].
        position: The payload's point in the frame of the joint that carries it [m], (3,).
    """

    inertial: Any
    gravity: Any
    payload: Any
    position: Any


class BodyChange(Effect):
    """The rigid body is not what the URDF and the labels say; `alters` names the field of `Body`."""

    side = "body"

    def change(self, body: Body, theta: Mapping[str, Any]) -> Body:
        """The rigid body with the effect."""
        raise NotImplementedError


class OnlyRecorded(BodyChange):
    """The torque is recorded as if the rigid body were another one; the arm itself is as without the effect."""


@dataclass(frozen=True)
class OfEach(Effect):
    """What has one parameter, and may have another value of it in every set-up, as a zero that is found anew at each start.

    Attributes:
        each: Labels of the set-ups with a value of their own, after which the parameters are then called; in others it is 0. Empty:
            one value for all.
        here: The set-up at hand, for laws of which symbols are made; by default that of the signals.
        plain_each: As `plain`, for another value in each; the parameter is the values with their recordings (`words.ByRecording`).
    """

    plain_each: ClassVar[str] = ""

    each: tuple[str, ...] = ()
    here: str = ""

    def __post_init__(self) -> None:
        if self.each:
            (one,) = self.parameters
            object.__setattr__(self, "parameters", tuple(replace(one, name=label) for label in self.each))
            object.__setattr__(self, "amplitudes", self.each)

    @property
    def of_all(self) -> Parameter:
        """The parameter that is the same in all set-ups."""
        return type(self).parameters[0]

    def value(self, signals: Signals, theta: Mapping[str, Any]) -> Any:
        """The parameter in the set-up of `signals`."""
        return theta.get(self.here or signals.group, 0.0) if self.each else theta[self.of_all.name]

    def course(self, theta: Mapping[str, float]) -> str:
        """Its values over the set-ups, in their order, in words."""
        values, unit = [theta[label] for label in self.each], self.of_all.unit.removeprefix("1")
        steps = np.diff(values)
        way = ", lower each time" if np.all(steps < 0) else ", higher each time" if np.all(steps > 0) else ""
        ends = " to ".join(
            f"{value:+.3g} {unit}".rstrip() + f" in {label}" for value, label in zip(values, self.each, strict=True)
        )
        return f"from {ends}{way}"

    @property
    def partly(self):
        return 0.0 if self.each else super().partly

    def scales(self, view, trial, prior=None):
        if not self.each:
            return super().scales(view, trial, prior)
        number, unit = (prior or self.prior).typical[self.of_all.name]
        return np.full(len(trial.points), number * view.unit(unit, self.joints))

    @classmethod
    def trials(cls, view):
        yield from super().trials(view)
        if len(view.groups) > 1:
            for j in range(view.n):
                yield cls((j,), view.groups).trial(view)

    @classmethod
    def sentence(cls, joints, values):
        value = values.get(cls.parameters[0].name)
        if isinstance(value, ByRecording):
            return cls.plain_each.format(joints=listed(joints), **values)
        return super().sentence(joints, values)


class MotionShift(Effect):
    """The recorded positions are shifted by a constant."""

    side = "motion"

    def shift(self, signals: Signals, theta: Mapping[str, Any], width: Any) -> tuple[Any, ...]:
        """True less recorded position of each of `joints` [rad], constant."""
        raise NotImplementedError


class Delay(Effect):
    """The recorded torque lags the recorded motion, of its joint or, if it has none, of all joints alike."""

    side = "sensor"
    placement = "arm"
    held = True  # whether the estimator finds it first, and holds it while other parameters and their intervals are found

    def delay(self, theta: Mapping[str, float]) -> float:
        """By how much what is recorded lags what is true [s]."""
        raise NotImplementedError

    def wait(self, theta: Mapping[str, float]) -> float:
        """By how much later than it is recorded a command acts [s]."""
        return 0.0

    def torque(self, signals, theta, width):
        """None on any joint; the recorded torque is later."""
        return tuple(0 * signals.q[j] for j in self.joints)


class LateCommand(Delay):
    """The commands of a loop act later than they are recorded. This looks like viscous friction, and is estimated with it."""

    recorded_as = ("command",)
    held = False

    def delay(self, theta):
        """Torques are as late as positions: 0."""
        return 0.0


class LoopChange(Effect):
    """The loop that follows recorded commands has other gains than are listed."""

    side = "sensor"
    recorded_as = ("command",)

    def gains(self, kp: Any, kd: Any, theta: Mapping[str, Any]) -> tuple[Any, Any]:
        """Gains of a joint's loop [Nm/rad], [Nm s/rad], from the listed ones."""
        raise NotImplementedError


class WithStates(Effect):
    """The torque depends on internal states, the `states`, which follow from the motion."""

    def rate(self, signals: Signals, theta: Mapping[str, Any], width: Any) -> tuple[Any, ...]:
        """Time derivative of each internal state, affine in the states."""
        raise NotImplementedError

    def rest(self, load: np.ndarray) -> tuple[float, ...]:
        """Internal states of an arm that has been at rest under a load torque (n,) [Nm]."""
        return tuple(state.nominal for state in self.states)


class FollowsLoad(WithStates):
    """The internal states follow from the load torque."""

    def course(self, t: np.ndarray, load: np.ndarray, theta: Mapping[str, float]) -> np.ndarray:
        """Internal states (number, K) at times t (K,) [s] under the joint's recorded load torque (K,) [Nm]."""
        raise NotImplementedError


class MovesLink(Effect):
    """The link moves relative to its drive."""

    side = "motion"
    moves_link = True

    def motion(
        self, t: np.ndarray, load: np.ndarray, stiffness: np.ndarray, inertia: np.ndarray, theta: Mapping[str, float]
    ) -> np.ndarray:
        """True less recorded position, speed and acceleration of the joint along a segment, (3, K).

        Args:
            t: Times [s], (K,).
            load: Torque that the recorded motion would need if it were the link's [Nm], (K,).
            stiffness, inertia: Derivatives of that torque by the joint's position [Nm/rad] and acceleration [kg m²], (K,).
        """
        raise NotImplementedError

    def gear(self, twist: Any, theta: Mapping[str, float], stiffest: float) -> None:
        """Set up the `mujoco.MjsJoint` by which the link moves relative to its drive; the engine's step can follow `stiffest` [Nm/rad]."""
        raise NotImplementedError

    @property
    def window(self) -> float:
        """Window over which the load is smoothed that `motion` is given [s]; 0 for none."""
        return 0.0

    def free(self, t: np.ndarray, stiffness: np.ndarray, inertia: np.ndarray, theta: Mapping[str, float]) -> np.ndarray:
        """Change of `motion` by an initial deviation of 1 rad and of 1 rad/s, (2, 3, K), to first order; empty where it is known."""
        return np.zeros((0, 3, len(t)))


class ExportTwin(Effect):
    """MuJoCo has the law as an element of its own, which exported files have.

    Simulations run the generated law all the same: it has the smoothing of the fits, and other laws depend on its torque.
    """

    def native(self, spec: Any, joints: tuple[str, ...], theta: Mapping[str, float]) -> None:
        """Put the law into a `mujoco.MjSpec` whose joints, and the motors of these joints, have these names."""
        raise NotImplementedError

    def passive_motor(self, spec: Any, joint: str, **law: tuple[float, ...]) -> None:
        """A motor of MuJoCo without input or winding, whose torque is its `cogging` (amplitude, order, phase) or its friction.

        `lugre` are stiffness, damping, kinetic level, static level and speed of Stribeck's curve (Canudas de Wit et al. 1995).
        """
        import mujoco  # here: every command imports the effects, few the engine

        motor = spec.add_actuator(name=f"{self.name}_{joint}", target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        # the resistance must be above 0; without a motor constant it plays no part
        motor.set_to_dcmotor(motorconst=[0.0, 0.0], resistance=1.0, ctrlspec=int(mujoco.mjtCtrlInput.mjINPUT_NONE), **law)


class NativeTwin(ExportTwin):
    """MuJoCo has the exact law as an element of its own, which simulations use as well."""


class SpringChange(Effect):
    """A listed spring is not as listed."""

    inputs = ("springs",)
    scope = "set_up"
    placement = "spring"

    def added(self, spring: Any, values: Mapping[str, float], theta: Mapping[str, float]) -> list[dict[str, float]]:
        """Parameters of springs of the same kind that, beside the listed one with these values, give the law; amplitudes may be negative."""
        raise NotImplementedError


class BlackBox(Effect):
    """A term for a torque that no law of the catalogue explains."""

    role = "black_box"

    @property
    def depends_on(self) -> tuple[tuple[str, int], ...]:
        """What it depends on: ("q", joint), ("load", joint), ("sign", joint), ("time", −1), …"""
        raise NotImplementedError

    def words(self, theta: Mapping[str, float]) -> str:
        """What it has found, in words."""
        raise NotImplementedError

    def basis(self, signals: Signals, width: Any) -> list | None:
        """Torque on its joint for each amplitude being 1 [Nm], where the law is linear in all parameters and this is quicker; else None."""
        return None

    def check_options(self, n: int) -> None:
        """Raise `UserError` for options, as read from the file of an arm with n joints, with which there is no such term."""
        beyond = [j for _, j in self.depends_on if j >= n]
        if beyond:
            raise UserError(f"found joint {beyond[0]}; 0 to {n - 1} are allowed")

    @classmethod
    def black_box_trials(
        cls, view: View, j: int, ranges: Mapping[tuple[str, int], tuple[float, float]], torque: str
    ) -> Iterator[Trial]:
        """The ways in which a joint might have such a term, tried on what the catalogue does not explain.

        Args:
            ranges: (least, greatest) of everything that a torque may depend on, by kind and joint as in `depends_on`.
            torque: What is recorded: "motor", "load" or "current".
        """
        yield from ()
