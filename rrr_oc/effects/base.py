"""What every effect is: one piece of physics beside the rigid body, written once as a CasADi expression."""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from rrr_oc.robot.parameters import Parameter

SIDES = {
    "motion": "the links do not move as the encoders say, as behind a gear that gives",
    "body": "the rigid body is not what the URDF and the labels say, as with a payload nobody noted",
    "link": "the torque acts on the links beside the drive, as springs do, and enters Eq. 1",
    "drive": "the torque acts between motor and link, as friction in a gear does, and the motor sees it",
    "sensor": "the recorded torque is not the true one",
}  # in the order in which a prediction goes from the recorded motion to the recorded torque


@dataclass(frozen=True)
class Signals:
    """What an effect may depend on at one instant; casadi or numpy, (n,) where not said otherwise.

    Attributes:
        q, dq, ddq: Joint positions [rad], speeds [rad/s], accelerations [rad/s²].
        load: Torque that the drives pass to the links (the load torque of Eq. 1) [Nm]; inverse dynamics knows it, forward
            dynamics solves for it.
        time: Since the start of the motion [s], scalar.
        payload: Mass at the tool [kg], scalar.
        states: The effect's own internal states, (number of states,).
        friction: Torque of the plain dry and viscous friction of each joint's drive [Nm].
        springs: The springs that a recording lists, by their joints: (effect, its parameters, its width).
    """

    q: Any
    dq: Any = None
    ddq: Any = None
    load: Any = None
    time: Any = None
    payload: Any = None
    states: Any = None
    friction: Any = None
    springs: Any = None


@dataclass(frozen=True)
class Body:
    """The rigid body as an effect of the side "body" may change it; casadi or numpy.

    Attributes:
        inertial: Of the links, without payload, (10, n).
        gravity: In the base frame [m/s²], (3,).
        payload: Mass at the tool [kg].
        position: The payload's point in the frame of the joint that carries it [m], (3,).
    """

    inertial: Any
    gravity: Any
    payload: Any
    position: Any


@dataclass(frozen=True)
class View:
    """What recordings show of an arm, so that effects can say where and how they might be present.

    Attributes:
        low, high: Least and greatest position of each joint [rad], (n,).
        speed: Largest speed of each joint [rad/s], (n,).
        duration: Of the longest recording [s].
        widths: Speeds over which each joint's dry friction changes sign [rad/s], (n,).
        positions: A sample of joint positions [rad], (n, K).
        inertia: What each joint's drive moves at these, the median, without payload [kg m²], (n,).
        springs: Joints of the springs that recordings list.
        payload: Whether a recording lists a payload, or the model has found one.
    """

    low: np.ndarray
    high: np.ndarray
    speed: np.ndarray
    duration: float
    widths: np.ndarray
    positions: np.ndarray
    inertia: np.ndarray
    springs: tuple[tuple[int, ...], ...]
    payload: bool

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.low)


@dataclass(frozen=True)
class Trial:
    """One way in which an effect might be present, linear in its coefficients c.

    The change of the prediction is Σ c_k · change(points[k]) / size.
    """

    effect: "Effect"
    points: tuple[dict[str, float], ...]
    size: float = 1.0
    width: float | None = None


@dataclass(frozen=True)
class Effect(ABC):
    """One piece of physics, placed on its joints.

    A subclass in a file of its own under `rrr_oc/effects/` appears in the catalogue by itself.

    Attributes:
        name: Key in files (class attribute).
        equation: The law in a line, for people (class attribute).
        parameters: Its parameters (class attribute).
        amplitudes: Those parameters in which it is linear and with which it vanishes (class attribute).
        width: Smoothing width of what is not smooth in it (class attribute; None where all is smooth). The nominal value is
            used unless a solver drives it down.
        states: Internal states, nominal = initial value (class attribute).
        load_dependent: Whether its torque depends on `Signals.load`, so that forward dynamics must solve for the load.
        side: Where on the way from links to motor it acts (class attribute), see `SIDES`.
        plain: Whether every calibrated model has it (class attribute).
        local: Whether it may be present in some recordings only, as what depends on how the arm was set up (class attribute).
        partial: Whether it is never present in all of them, where it would be what every model has (class attribute).
        of_arm: Whether it belongs to no single joint (class attribute).
        of_spring: Whether it is one of a spring that a recording lists, and absent where none is (class attribute).
        of_friction: Whether it depends on `Signals.friction` (class attribute).
        of_speed: Whether it may stand for another course of plain dry friction over its joint's speed (class attribute).
        many: Whether a joint may have more than one of it (class attribute).
        abrupt: Whether predictions are no smooth function of its parameters (class attribute).
        simulated: Whether the links' own motion follows from the recording by `motion`, not `shift` (class attribute).
        driven: Whether its internal states follow from the recorded load by `course`, not from the motion by `rate` (class attribute).
        lawless: Whether it is no law of the catalogue but stands for what none explains (class attribute).
        mounted: Whether it is put on and taken off between recordings, hence likelier where only some have it (class attribute).
        joints: Indices of the joints it acts on.
    """

    name: ClassVar[str]
    equation: ClassVar[str] = ""
    parameters: ClassVar[tuple[Parameter, ...]]
    amplitudes: ClassVar[tuple[str, ...]] = ()
    width: ClassVar[Parameter | None] = None
    states: ClassVar[tuple[Parameter, ...]] = ()
    load_dependent: ClassVar[bool] = False
    side: ClassVar[str] = "link"
    plain: ClassVar[bool] = False
    local: ClassVar[bool] = False
    partial: ClassVar[bool] = False
    of_arm: ClassVar[bool] = False
    of_spring: ClassVar[bool] = False
    of_friction: ClassVar[bool] = False
    of_speed: ClassVar[bool] = False
    many: ClassVar[bool] = False
    abrupt: ClassVar[bool] = False
    simulated: ClassVar[bool] = False
    driven: ClassVar[bool] = False
    lawless: ClassVar[bool] = False
    mounted: ClassVar[bool] = False

    joints: tuple[int, ...]

    @abstractmethod
    def torque(self, signals: Signals, theta: Mapping[str, Any], width: Any) -> tuple[Any, ...]:
        """Torque on each of `joints` [Nm] for parameters `theta` by name; `width` is in the unit of `Effect.width`.

        Without `Signals.states` the arm has been at rest. Of the side "sensor": what the recorded torque has too much, from the
        true one, which is `signals.load`.
        """

    def rate(self, signals: Signals, theta: Mapping[str, Any], width: Any) -> tuple[Any, ...]:
        """Time derivative of each internal state, affine in the states."""
        return ()

    def rest(self, load: np.ndarray) -> tuple[float, ...]:
        """Internal states of an arm that has been at rest under a load torque (n,) [Nm]."""
        return tuple(state.nominal for state in self.states)

    def course(self, t: np.ndarray, load: np.ndarray, theta: Mapping[str, float]) -> np.ndarray:
        """Internal states along a stretch (number, K) under the joint's load torque (K,) [Nm] at times t (K,) [s], if it is `driven`."""
        raise NotImplementedError

    def energy(self, signals: Signals, theta: Mapping[str, Any], width: Any) -> Any:
        """Energy stored [J], with torque = −d energy / d q; 0 where nothing is stored."""
        return 0.0

    def change(self, body: Body, theta: Mapping[str, Any]) -> Body:
        """The rigid body with the effect, for the side "body"."""
        return body

    def shift(self, signals: Signals, theta: Mapping[str, Any], width: Any) -> tuple[Any, ...]:
        """True less recorded position of each of `joints` [rad], the same all along, for the side "motion" if not `simulated`."""
        return ()

    def motion(
        self, t: np.ndarray, load: np.ndarray, stiffness: np.ndarray, inertia: np.ndarray, theta: Mapping[str, float]
    ) -> np.ndarray:
        """True less recorded position, speed and acceleration of the joint along a stretch, (3, K), for the side "motion".

        Args:
            t: Times [s], (K,).
            load: Torque that the recorded motion would need if it were the link's [Nm], (K,).
            stiffness, inertia: By how much that torque grows with the joint's position and acceleration, (K,).
        """
        raise NotImplementedError

    @property
    def window(self) -> float:
        """Over which the load is smoothed that `motion` is given [s]; 0 for as it is."""
        return 0.0

    def sharper(self) -> "Effect | None":
        """The effect with the next sharper form of its law, among which the residual of a last fit decides; None beyond the last."""
        return None

    def free(self, t: np.ndarray, stiffness: np.ndarray, inertia: np.ndarray, theta: Mapping[str, float]) -> np.ndarray:
        """What adds to `motion` when a stretch begins 1 rad or 1 rad/s off, (2, 3, K), to first order; () where that is known."""
        return np.zeros((0, 3, len(t)))

    def native(self, spec: Any, joints: tuple[str, ...], theta: Mapping[str, float]) -> bool:
        """Put the exact law into a `mujoco.MjSpec` whose joints have these names; False where MuJoCo has no form of it."""
        return False

    def gear(self, twist: Any, theta: Mapping[str, float], stiffest: float) -> None:
        """Make the `mujoco.MjsJoint` by which the link moves otherwise than its drive what the effect says, if it is `simulated`.

        Args:
            stiffest: What the engine's step can follow [Nm/rad].
        """
        raise NotImplementedError

    @property
    def linear(self) -> bool:
        """Whether predictions are linear in all its parameters, those of other effects held."""
        return len(self.parameters) == len(self.amplitudes) and self.side in ("link", "drive", "sensor")

    def possible(self, theta: Mapping[str, float], payload: float) -> bool:
        """Whether parameters lie within their bounds; `payload` [kg] is the least listed of where the effect is at work."""
        return all(p.lower <= theta[p.name] <= p.upper for p in self.parameters)

    def canonical(self, theta: Mapping[str, float]) -> dict[str, float]:
        """The same law in the parameters that people expect, where several stand for it."""
        return dict(theta)

    @property
    def depends_on(self) -> tuple[tuple[str, int], ...]:
        """What a torque that is `lawless` depends on: ("q", joint), ("load", joint), ("sign", joint), ("time", −1), …"""
        return ()

    @property
    def validity(self) -> tuple[tuple[tuple[str, int], float, float], ...]:
        """What it depends on with the range beyond which nothing is known of it."""
        return ()

    def words(self, theta: Mapping[str, float]) -> str:
        """What the model carries for a torque that is `lawless`, in words."""
        raise NotImplementedError

    def starts(self, theta: dict[str, float]) -> Iterator[tuple["Effect", dict[str, float]]]:
        """Forms of the effect on the same joints, and parameters, from which a fit is to begin that began here, if it is `abrupt`."""
        yield self, theta

    @classmethod
    def trials(cls, view: View) -> Iterator[Trial]:
        """The ways in which recordings might hold the effect; none for what a diagnosis does not look for.

        By default one for each joint, linear in the only parameter; none of what is `lawless`: the catalogue goes first, and what is
        left over asks for those by `unnamed`.
        """
        if cls.amplitudes and not cls.lawless:
            for j in range(view.n):
                yield cls((j,)).trial(view)

    @classmethod
    def unnamed(cls, view: View, j: int, ranges: Mapping[tuple[str, int], tuple[float, float]], torque: str) -> Iterator[Trial]:
        """The ways in which a joint might have what is `lawless`.

        Args:
            ranges: (least, greatest) of everything that a torque may depend on, by kind and joint as in `depends_on`.
        """
        yield from ()

    def trial(self, view: View, **shape: float) -> Trial:
        """A trial with these values of the parameters in which the effect is not linear."""
        points = tuple(
            {p.name: shape.get(p.name, 0.0) for p in self.parameters} | {amplitude: 1.0} for amplitude in self.amplitudes
        )
        return Trial(self, points, width=self.sign_width(view))

    def sign_width(self, view: View) -> float | None:
        """Smoothing width that suits the recordings: that of the joint's dry friction where it is one of speed."""
        if self.width is None:
            return None
        return float(view.widths[self.joints[0]]) if self.width.unit == "rad/s" else self.width.nominal

    def combined(self, points: Sequence[Mapping[str, float]], coefficients: np.ndarray) -> dict[str, float]:
        """Parameters that amount to Σ c_k · change(points[k])."""
        return dict(points[0]) | dict(zip(self.amplitudes, map(float, coefficients), strict=True))
