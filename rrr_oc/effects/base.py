"""What every effect is: one piece of physics beside the rigid body, written once as a CasADi expression.

An effect declares what it is, and derives from a class for each thing that it can do beside (`effects/capabilities.py`,
`effects/springs.py`), so that no other folder asks for one by its name or its own class.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Literal

import numpy as np

from rrr_oc.effects.words import default_sentence, listed, words
from rrr_oc.robot.parameters import Parameter

SIDES = {
    "motion": "the links do not move as the encoders say, as behind a gear that gives",
    "body": "the rigid body is not what the URDF and the labels say, as with a payload nobody noted",
    "link": "the torque acts on the links beside the drive, as springs do, and enters Eq. 1",
    "drive": "the torque acts between motor and link, as friction in a gear does, and the motor sees it",
    "sensor": "the recorded torque is not the true one",
}  # in the order in which a prediction goes from the recorded motion to the recorded torque
PLACEMENTS = {
    "joint": "one joint",
    "joint or arm": "one joint, or all joints alike",
    "many": "one joint, which may have several of it",
    "pair": "two joints",
    "spring": "the joints of a spring that a recording lists; absent where none is",
    "arm": "the arm as a whole, no single joint",
}
Input = Literal["load", "friction", "rotor", "springs"]
Role = Literal["plain", "law", "black_box", "design"]
SOUGHT: tuple[Role, ...] = ("law", "black_box")  # what a diagnosis looks for
Scope = Literal["everywhere", "set_up", "some", "mounted"]
# Probability that an effect that is present is so in some recordings only, by `Effect.scope`
PARTLY: dict[Scope, float] = {"everywhere": 0.0, "set_up": 0.1, "mounted": 0.5, "some": 1.0}
SECANTS = (-4.0, -1.0, 1.0, 4.0)  # of the typical size of a parameter, at which effects that are not linear in it are tried
SIGN_WIDTH = Parameter(
    "width", "rad/s", 0.05, lower=0.0
)  # of friction that changes sign with a speed; fits and solvers replace it


@dataclass(frozen=True)
class Signals:
    """What an effect may depend on at one instant; casadi or numpy, (n,) where not said otherwise.

    Attributes:
        q, dq, ddq: Joint positions [rad], speeds [rad/s], accelerations [rad/s²].
        load: Torque that the drives pass to the links (the load torque of Eq. 1) [Nm].
        time: Time since the start of the motion, or of the session where recordings have a common clock [s], scalar.
        payload: Mass at the tool [kg], scalar.
        states: The effect's own internal states, (number of states,).
        friction: Torque of the plain dry and viscous friction of each joint's drive [Nm].
        rotor: Torque of the inertia of each joint's rotor [Nm].
        springs: The springs that a recording lists, by their joints: (effect, its parameters, its width).
        group: Label of the recording's set-up.
        braking: Torque kd dq against the motion by the listed gains of a loop whose commands are recorded [Nm]; 0 without one.
    """

    q: Any
    dq: Any = None
    ddq: Any = None
    load: Any = None
    time: Any = None
    payload: Any = None
    states: Any = None
    friction: Any = None
    rotor: Any = None
    springs: Any = None
    group: Any = None
    braking: Any = None


@dataclass(frozen=True)
class Prior:
    """What is believed of an effect before any recording is seen.

    Attributes:
        probability: That it is present at one place (a joint, a pair of joints, a listed spring, the arm) of an arm.
        typical: Standard deviation of each amplitude about 0 as (number, unit), in units that transfer between arms: those of
            `View.unit`, or "" for the parameter's own unit. Where `Effect.scales` is overridden, of what that refers to.
        source: Where the numbers come from.
        where_springs: Factor of the odds on arms that carry springs.
        where_exact: Factor of the odds where the links' inertial parameters are known exactly.
    """

    probability: float = 0.01
    typical: Mapping[str, tuple[float, str]] = field(default_factory=dict)
    source: str = ""
    where_springs: float = 1.0
    where_exact: float = 1.0


def canonical_wave(theta: Mapping[str, float]) -> dict[str, float]:
    """Parameters of a wave, amplitude · sin(order q ± phase), with an amplitude above 0 and a phase within ±π."""
    phase = theta["phase"] + (np.pi if theta["amplitude"] < 0 else 0.0)
    return {**theta, "amplitude": abs(theta["amplitude"]), "phase": float(np.angle(np.exp(1j * phase)))}


@dataclass(frozen=True)
class View:
    """What recordings show of an arm, so that effects can say where and how they might be present.

    Attributes:
        low, high: Least and greatest position of each joint [rad], (n,).
        speed: Largest speed of each joint [rad/s], (n,).
        usual_speed: Its median while it moves, in the recording in which that is least; infinite if it rests in all [rad/s], (n,).
        duration: Time at the end of the recordings, at most [s], as `Signals.time` counts it.
        widths: Speeds over which each joint's dry friction changes sign [rad/s], (n,).
        positions: A sample of joint positions [rad], (n, K).
        inertia: Median over these positions of the inertia that each joint's drive moves, without payload [kg m²], (n,).
        springs: Joints of the springs that recordings list.
        dry: Dry friction of each joint [Nm], (n,); where drives have none, as where the load torque is recorded, a share of `torque`.
        torque: Standard deviation of each joint's recorded torque [Nm], (n,).
        mass: Mass of each joint's link [kg], (n,).
        groups: Labels of the set-ups.
    """

    low: np.ndarray
    high: np.ndarray
    speed: np.ndarray
    usual_speed: np.ndarray
    duration: float
    widths: np.ndarray
    positions: np.ndarray
    inertia: np.ndarray
    springs: tuple[tuple[int, ...], ...]
    dry: np.ndarray
    torque: np.ndarray
    mass: np.ndarray
    groups: tuple[str, ...] = ()

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.low)

    @property
    def length(self) -> float:
        """Length that stands for the arm [m]: its radius of gyration about the joint that moves the largest inertia."""
        return float(np.sqrt(self.inertia.max() / self.mass.sum()))

    def unit(self, name: str, joints: Sequence[int]) -> float:
        """A unit of `Prior.typical` in SI units, for an effect on these joints; of a pair the smaller, of the arm the largest."""
        travel = self.high - self.low
        units = {
            "": np.ones(self.n),
            "dry": self.dry,
            "dry/speed": self.dry / self.speed,
            "dry/speed²": self.dry / self.speed**2,
            "torque": self.torque,
            "torque/travel": self.torque / travel,
            "torque/travel³": self.torque / travel**3,
            "travel": travel,
            "mass": self.mass,
            "arm's mass": np.full(self.n, self.mass.sum()),
            "mass length": self.mass * self.length,
            "mass length²": self.mass * self.length**2,
            "inertia": self.inertia,
        }
        return float(np.min(units[name][list(joints)]) if joints else np.max(units[name]))


@dataclass(frozen=True, eq=False)
class Trial:
    """One way in which an effect might be present, with a prediction linear in its coefficients c. Each is equal to itself alone.

    The change of the prediction is Σ c_k · change(points[k]) / size.

    Attributes:
        effect: The effect on its joints.
        points: For each coefficient the parameters at which the change of the prediction is computed.
        size: By which these changes are divided: the step of a difference where the prediction is not linear, else 1.
        width: Smoothing width, in the unit of `Effect.width`.
    """

    effect: "Effect"
    points: tuple[dict[str, float], ...]
    size: float = 1.0
    width: float | None = None


@dataclass(frozen=True)
class Effect:
    """One piece of physics, placed on its joints.

    A subclass in a file of its own under `rrr_oc/effects/` appears in the catalogue by itself; others are added by
    `effects.register`. All attributes but `joints` are declarations of the class; a subclass with further fields (`options`) is
    a frozen dataclass as well.

    Attributes:
        name: Key in files.
        equation: The law in a line, for people.
        parameters: Its parameters.
        amplitudes: Those parameters in which it is linear and with which it vanishes.
        step: Amplitude at which trials compute the change of the prediction: 1, or the step of a finite difference where the
            prediction is not linear in the amplitudes.
        width: Smoothing width of what is not smooth in it; None where all is smooth.
        states: Internal states of a `WithStates`, nominal = initial value.
        side: Where on the way from links to motor it acts, see `SIDES`.
        inputs: Which of the signals beside the motion its torque depends on: "load", so that forward dynamics must solve for the
            load; "friction", the plain friction of its joint; "rotor", its rotor's inertia; "springs", those that a recording lists.
        provides: Which of these signals its torque is part of: "friction", "rotor", "springs" (which a recording may list), or "".
        motor: Which number of a motor and its gear its first parameter is, see `drives.MotorAndGear`; "" for none.
        role: "plain": part of every calibrated model. "law": a diagnosis looks for it. "black_box": no law of the catalogue; it
            stands for a torque that none explains. "design": a co-design may use it; a diagnosis does not look for it.
        scope: In which recordings it may be present. "everywhere": all or none. "set_up": all, none, or those of some set-ups.
            "some": never all, where it would be what every model has. "mounted": as "set_up", and it is put on and taken off between
            recordings, so that it is more probable where only some have it.
        placement: See `PLACEMENTS`.
        recorded_as: With which recorded signals (see `recordings.header`) a diagnosis looks for it.
        resembles: What other description its torque may be taken for. "friction_over_speed": another course of plain dry friction
            over the speed. "position_harmonic", "constant": a harmonic and the mean of a series over the joint's position. Or "".
        alters: The field of `Body` that a `BodyChange` changes.
        moves_link: Whether it is a `MovesLink`, so that the link moves relative to its drive.
        options: Dataclass fields beside the parameters that users choose and reports show, with the values allowed; of a field that
            is a tuple, the values of each element.
        composed: Where parameters are the components of vectors or matrices: shown name to parameters' names, nested.
        title: What people call it, followed by "of" and its joints; "" for its name with spaces.
        plain: What was found, in a sentence for people: a format with "joints", the parameters' names (`words.Number`) and options;
            "" for one that is made of the name, the joints and the parameters.
        prior: What is believed of it before any recording is seen.
        joints: Indices of the joints it acts on; none for the arm as a whole.
    """

    name: ClassVar[str]
    equation: ClassVar[str] = ""
    parameters: ClassVar[tuple[Parameter, ...]]
    amplitudes: ClassVar[tuple[str, ...]] = ()
    step: ClassVar[float] = 1.0
    width: ClassVar[Parameter | None] = None
    states: ClassVar[tuple[Parameter, ...]] = ()
    side: ClassVar[str] = "link"
    inputs: ClassVar[tuple[Input, ...]] = ()
    provides: ClassVar[Literal["", "friction", "rotor", "springs"]] = ""
    motor: ClassVar[Literal["", "dry_Nm", "viscous_Nm_s_per_rad", "inertia_kg_m2"]] = ""
    role: ClassVar[Role] = "law"
    scope: ClassVar[Scope] = "everywhere"
    placement: ClassVar[Literal["joint", "joint or arm", "many", "pair", "spring", "arm"]] = "joint"
    recorded_as: ClassVar[tuple[str, ...]] = ("motor", "load", "current", "command")
    resembles: ClassVar[Literal["", "friction_over_speed", "position_harmonic", "constant"]] = ""
    alters: ClassVar[Literal["", "inertial", "gravity", "payload", "position"]] = ""
    moves_link: ClassVar[bool] = False
    options: ClassVar[Mapping[str, tuple[Any, ...]]] = {}
    composed: ClassVar[Mapping[str, Any]] = {}
    title: ClassVar[str] = ""
    plain: ClassVar[str] = ""
    prior: ClassVar[Prior] = Prior()

    joints: tuple[int, ...]

    def torque(self, signals: Signals, theta: Mapping[str, Any], width: Any) -> tuple[Any, ...]:
        """Torque on each of `on` [Nm] for parameters `theta` by name; `width` is in the unit of `Effect.width`.

        Without `Signals.states` the arm has been at rest. For the side "sensor": the error of the recorded torque; the true one is
        `signals.load`. By default none, for an effect that changes the motion or the body.
        """
        if self.side not in ("motion", "body"):
            raise NotImplementedError(f"{self.name} acts on the side {self.side!r} and needs a torque")
        return tuple(0 * signals.q[j] for j in self.joints)

    def on(self, n: int) -> tuple[int, ...]:
        """The joints of `torque`, of n: its own, or all where it is of all joints alike."""
        return tuple(range(n)) if self.placement == "joint or arm" and not self.joints else self.joints

    def renumbered(self, numbers: Sequence[int]) -> "Effect":
        """The same effect on a robot where joint j has the number `numbers[j]`."""
        return replace(self, joints=tuple(numbers[j] for j in self.joints))

    def energy(self, signals: Signals, theta: Mapping[str, Any], width: Any) -> Any:
        """Energy stored [J], with torque = −d energy / d q; 0 where nothing is stored."""
        return 0.0

    # in fits

    @property
    def linear(self) -> bool:
        """Whether predictions are linear in all its parameters, those of other effects held."""
        return len(self.parameters) == len(self.amplitudes) and self.side in ("link", "drive", "sensor")

    def possible(self, theta: Mapping[str, float], payload: float) -> bool:
        """Whether parameters lie within their bounds; `payload` [kg] is the least listed of where the effect is at work."""
        return all(p.lower <= theta[p.name] <= p.upper for p in self.parameters)

    def canonical(self, theta: Mapping[str, float]) -> dict[str, float]:
        """The parameters in their usual range, where several sets of values give the same law."""
        return dict(theta)

    def starts(self, theta: dict[str, float]) -> Iterator[tuple["Effect", dict[str, float]]]:
        """Other forms of the effect on the same joints, and parameters, from which a fit may end higher than from a fit's own."""
        yield from ()

    @property
    def sign_forms(self) -> tuple["Effect", ...]:
        """For plain dry friction, whose width that of all friction of the joint follows: itself with each way to change sign.

        The first is the default; empty for all other effects.
        """
        return ()

    # beliefs before recordings are seen

    @property
    def partly(self) -> float:
        """Probability that, if it is present, it is so in some recordings only."""
        return PARTLY[self.scope]

    # beside other effects

    def equivalents(self, theta: Mapping[str, float]) -> Iterator[tuple["Effect", dict[str, float]]]:
        """Effects, with parameters, of the same law over part of the range, more probable where only some recordings have it."""
        yield from ()

    # of black-box terms, see `BlackBox`

    @property
    def black_box(self) -> bool:
        """Whether `role` is "black_box"."""
        return self.role == "black_box"

    @property
    def validity(self) -> tuple[tuple[tuple[str, int], float, float], ...]:
        """What a term depends on, with the range of validity (least, greatest)."""
        return ()

    def without_range(self) -> "Effect":
        """The effect without the range that recordings gave it, for comparisons."""
        return self

    # in words

    @property
    def law(self) -> str:
        """The equation in the form that these options have."""
        return self.equation

    @property
    def said(self) -> Mapping[str, Any]:
        """What the entry of a diagnosis says beside joints, recordings and parameters."""
        return {}

    def derived(self, found: Mapping[str, tuple[float, float | None]]) -> Mapping[str, Any]:
        """What follows from parameters (value, standard error) and is told beside them, as `diagnosis.json` has parameters."""
        return {}

    @classmethod
    def called(cls) -> str:
        """What people call it."""
        return cls.title or words(cls.name)

    @classmethod
    def sentence(cls, joints: Sequence[str], values: Mapping[str, Any]) -> str:
        """What was found, for people, on joints of these names; `values` holds `words.Number` and options by name."""
        if not cls.plain:
            return default_sentence(cls.name, joints, values)
        return cls.plain.format(
            joints=listed(joints), own=joints[0] if joints else "", other=joints[-1] if joints else "", **values
        )

    # trials: the ways in which recordings might hold the effect

    @classmethod
    def trials(cls, view: View) -> Iterator[Trial]:
        """The ways in which recordings might hold the effect; none for what a diagnosis does not look for.

        By default one for each of `shapes` on every joint, every listed spring or the arm, as `placement` says; none for black-box
        terms, which have `BlackBox.black_box_trials`.
        """
        if cls.amplitudes and cls.role != "black_box":
            each = [(j,) for j in range(view.n)]
            places = {"arm": [()], "spring": view.springs, "joint or arm": [*each, ()][: None if view.n > 1 else 1]}
            for joints in places.get(cls.placement, each):
                for shape in cls.shapes(view, joints):
                    yield cls(joints).trial(view, **shape)
                    yield from cls(joints).secants(view, **shape)

    @classmethod
    def shapes(cls, view: View, joints: tuple[int, ...]) -> Sequence[Mapping[str, float]]:
        """Values of the parameters that are no amplitudes, one mapping for each of the default `trials`."""
        return ({},)

    def trial(self, view: View, **shape: float) -> Trial:
        """A trial with these values of the parameters in which the effect is not linear."""
        base = {p.name: shape.get(p.name, 0.0) for p in self.parameters}
        return Trial(self, tuple(base | {a: self.step} for a in self.amplitudes), self.step, self.sign_width(view))

    def secants(self, view: View, **shape: float) -> Iterator[Trial]:
        """Trials of an effect whose torque is not linear in its only parameter, by how much it changes at several sizes of it."""
        if self.linear or self.side == "body" or len(self.parameters) > 1:
            return
        near = self.trial(view, **shape)
        typical = float(self.scales(view, near)[0])
        for parameter in self.parameters:
            for size in (share * typical for share in SECANTS):
                if parameter.lower <= size <= parameter.upper:
                    yield replace(near, points=({parameter.name: size},), size=size)

    def scales(self, view: View, trial: Trial, prior: Prior | None = None) -> np.ndarray:
        """Prior standard deviations of a trial's coefficients, (m,), by `prior` or that of the class.

        By default the coefficients are amplitudes, one for each point.
        """
        typical, result = (prior or self.prior).typical, []
        for point in trial.points:
            name = next((a for a in self.amplitudes if point[a] != 0.0), self.amplitudes[0])
            number, unit = typical.get(name, (1.0, ""))
            result.append(number * view.unit(unit, self.joints) * trial.size / (point[name] or trial.size))
        return np.array(result)

    def sign_width(self, view: View) -> float | None:
        """Smoothing width that suits the recordings: that of the joint's dry friction where it is one of speed."""
        if self.width is None:
            return None
        return float(view.widths[self.joints[0]]) if self.width.unit == "rad/s" else self.width.nominal

    def combined(self, points: Sequence[Mapping[str, float]], coefficients: np.ndarray) -> dict[str, float]:
        """Parameters that amount to Σ c_k · change(points[k])."""
        return dict(points[0]) | dict(zip(self.amplitudes, map(float, coefficients), strict=True))
