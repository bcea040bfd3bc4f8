# pyright: reportAttributeAccessIssue=false
"""What a concealed effect may do to the plant: edit bodies, push on joints, change friction, falsify recorded signals."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np
import pinocchio as pin

from validation.concealed.arms import Arm


@dataclass
class Body:
    """The rigid body of one recording before simulation; effects edit it."""

    model: pin.Model
    payload: float  # [kg]
    point: np.ndarray  # of the payload in the tool link's frame [m]
    tool: pin.Frame


@dataclass
class State:
    """What the plant knows at one instant. Arrays (B, n): B recordings, n joints."""

    t: float
    q: np.ndarray  # link [rad]
    v: np.ndarray  # link [rad/s]
    a: np.ndarray  # link, one step ago [rad/s²]
    theta: np.ndarray  # motor at the output; equals q where the joint is rigid [rad]
    w: np.ndarray  # motor [rad/s]
    alpha: np.ndarray  # motor, one step ago [rad/s²]
    load: np.ndarray  # transmitted load torque, one step ago [Nm]
    motor: np.ndarray  # motor torque, one step ago [Nm]


@dataclass
class Forces:
    """What effects add up at one instant, (B, n). Friction torque = −scale (dry · sign + viscous · w)."""

    link: np.ndarray  # torque on the link [Nm]
    rotor: np.ndarray  # torque on the motor side [Nm]
    damp: np.ndarray  # −d rotor / d w, for the implicit step [Nm s/rad]
    sign: np.ndarray  # the smoothed sign of w, or a bristle's deflection in [−1, 1]
    slope: np.ndarray  # d sign / d w [s/rad]
    dry: np.ndarray  # level of dry friction [Nm]
    viscous: np.ndarray  # [Nm s/rad]
    scale: np.ndarray  # of dry and viscous friction [1]
    mu: np.ndarray  # share of |load torque| that rubs [1]


@dataclass
class Signals:
    """Signals as a perfect data logger would see them, (B, n, T); effects of the sensing chain edit them."""

    t: np.ndarray  # (T,) [s]
    q: np.ndarray
    dq: np.ndarray
    ddq: np.ndarray
    tau: np.ndarray  # motor or load torque [Nm]


@dataclass
class Motion:
    """A baseline motion, from which an effect draws where it sits and how strong it must be."""

    q: np.ndarray  # (B, n, T)
    dq: np.ndarray
    load: np.ndarray
    payload: np.ndarray  # listed, (B,) [kg]
    springs: list[dict]  # listed, one per recording
    duration: float  # [s]


@dataclass(frozen=True)
class Effect:
    """One effect of a given strength; strength zero is no effect at all.

    `mask` (B,) is 1 in the recordings that have it. `shape` holds what stays fixed while the strength is scaled.
    """

    joints: tuple[int, ...] = ()
    strength: float = 0.0
    shape: dict[str, Any] = field(default_factory=dict)
    mask: np.ndarray = field(default_factory=lambda: np.ones(1))

    name: ClassVar[str]
    told: ClassVar[str] = ""  # name in the truth, of a variant of another effect
    equation: ClassVar[str]
    catalogue: ClassVar[bool] = True
    global_effect: ClassVar[bool] = False  # belongs to no joint: `joint` is null in the truth
    smallest: ClassVar[float] = 1e-9
    largest: ClassVar[float] = np.inf

    @property
    def in_truth(self) -> str:
        return self.told or self.name

    def of(self, strength: float) -> "Effect":
        return replace(self, strength=strength)

    def on(self, mask: np.ndarray) -> "Effect":
        return replace(self, mask=np.asarray(mask, float))

    @property
    def j(self) -> int:
        return self.joints[0]

    # What a child overrides ------------------------------------------------------------------------------------------
    @classmethod
    def draw(cls, arm: Arm, motion: Motion, rng: np.random.Generator) -> "Effect":
        """Where the effect sits and its fixed numbers; the strength is the first probe."""
        raise NotImplementedError

    def parameters(self, arm: Arm) -> Mapping[str, tuple[Any, str]]:
        """The truth: name -> (value, unit)."""
        raise NotImplementedError

    def depends_on(self, arm: Arm) -> list[str]:
        """The variables of an effect outside the catalogue."""
        return []

    def edit(self, body: Body) -> None:
        """Change the rigid body of a recording that has the effect."""

    def memory(self, shape: tuple[int, int]) -> Any:
        """Internal state at the start, or None."""
        return None

    def push(self, s: State, f: Forces, memory: Any) -> None:
        """Add torques and friction."""

    def advance(self, s: State, memory: Any, step: float) -> Any:
        """The internal state one step on."""
        return memory

    def sense(self, x: Signals, arm: Arm) -> None:
        """Falsify what is recorded."""


def loaded_joint(motion: Motion, rng: np.random.Generator, share: float = 0.3) -> int:
    """A joint whose load torque is not small beside the others'."""
    load = motion.load.std(axis=(0, 2))
    return int(rng.choice(np.flatnonzero(load >= share * load.max())))


def any_joint(motion: Motion, rng: np.random.Generator) -> int:
    return int(rng.integers(motion.q.shape[1]))
