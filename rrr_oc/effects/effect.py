"""What every effect is: one piece of physics beside the rigid body, written once as a CasADi expression."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from rrr_oc.parameters import Parameter

SIDES = {
    "link": "the torque acts on the links beside the drive, as springs do, and enters Eq. 1",
    "drive": "the torque acts between motor and link, as friction in a gear does, and the motor sees it",
}  # in the order in which `Model` goes from the motion to the motor torque


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
    """

    q: Any
    dq: Any = None
    ddq: Any = None
    load: Any = None
    time: Any = None
    payload: Any = None
    states: Any = None


@dataclass(frozen=True)
class Effect(ABC):
    """One piece of physics, placed on its joints.

    A subclass in a file of its own under `rrr_oc/effects/` appears in the catalogue by itself.

    Attributes:
        name: Key in files (class attribute).
        parameters: Its parameters (class attribute).
        width: Smoothing width of what is not smooth in it (class attribute; None where all is smooth). The nominal value is
            used unless a solver drives it down.
        states: Internal states, nominal = initial value (class attribute).
        load_dependent: Whether its torque depends on `Signals.load`, so that forward dynamics must solve for the load.
        side: Where on the way from links to motor it acts (class attribute), see `SIDES`.
        joints: Indices of the joints it acts on.
    """

    name: ClassVar[str]
    parameters: ClassVar[tuple[Parameter, ...]]
    width: ClassVar[Parameter | None] = None
    states: ClassVar[tuple[Parameter, ...]] = ()
    load_dependent: ClassVar[bool] = False
    side: ClassVar[str] = "link"

    joints: tuple[int, ...]

    @abstractmethod
    def torque(self, signals: Signals, theta: Mapping[str, Any], width: Any) -> tuple[Any, ...]:
        """Torque on each of `joints` [Nm] for parameters `theta` by name; `width` is in the unit of `Effect.width`."""

    def rate(self, signals: Signals, theta: Mapping[str, Any], width: Any) -> tuple[Any, ...]:
        """Time derivative of each internal state."""
        return ()

    def energy(self, signals: Signals, theta: Mapping[str, Any], width: Any) -> Any:
        """Energy stored [J], with torque = −d energy / d q; 0 where nothing is stored."""
        return 0.0

    def native(self, spec: Any, joints: tuple[str, ...], theta: Mapping[str, float]) -> bool:
        """Put the exact law into a `mujoco.MjSpec` whose joints have these names; False where MuJoCo has no form of it."""
        return False
