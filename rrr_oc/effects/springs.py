"""What springs can do: act across joints, be listed in recordings, be designed, and be connected by a clutch."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, Self

import numpy as np

from rrr_oc.effects.base import Effect, Signals
from rrr_oc.effects.design_form import DesignForm
from rrr_oc.errors import UserError

PHASES = ("go", "return")  # of a task


def two_sided_tendon(spec: Any, name: str, joint: str, stiffness: float, rest: float, hardening: float = 0.0) -> None:
    """Add a spring to a `mujoco.MjSpec` that pulls a joint towards `rest` [rad] from both sides, with a stiffness [Nm/rad].

    Args:
        hardening: Torque by the third power of the distance [Nm/rad³].
    """
    tendon = spec.add_tendon(name=f"{name}_{joint}")
    tendon.wrap_joint(joint, 1.0)
    tendon.stiffness = [stiffness, 0.0, hardening]
    tendon.springlength = [rest, rest]


class LinkSpring(Effect):
    """A spring across one joint or more, beside their drives."""

    provides = "springs"
    scope = "mounted"

    def lever(self, theta: Mapping[str, Any]) -> tuple[Any, ...]:
        """Derivative of the spring's stretch by the position of each of `joints`, up to a common sign."""
        return (1.0,) * len(self.joints)

    def moved(self, theta: Mapping[str, Any], offset: Any) -> dict[str, Any]:
        """Parameters of the spring with its equilibrium moved by an offset [rad]; by default the parameter `equilibrium`."""
        return {**theta, "equilibrium": theta["equilibrium"] + offset}


@dataclass(frozen=True)
class Listing:
    """The entry of a spring in the header of a recording set, beside its options.

    Attributes:
        key: Key of the springs of this kind among those of a recording.
        quantities: Keys of the numbers, all required; the ending of a key is its unit: `_Nm_per_rad`, `_rad` or `_m`.
        zero: Keys of the lengths that may be 0.
    """

    key: str
    quantities: tuple[str, ...]
    zero: tuple[str, ...] = ()


class ListedSpring(LinkSpring):
    """A spring that a recording may list; by default the quantities of its `listing` are its parameters in their order."""

    listing: ClassVar[Listing]

    @classmethod
    def from_entry(cls, joints: tuple[int, ...], entry: Mapping[str, Any]) -> tuple[Self, dict[str, float]]:
        """The spring on its joints, and its parameters, from the quantities of its `listing` and its options."""
        names = (parameter.name for parameter in cls.parameters)
        options = {key: entry[key] for key in cls.options if key in entry}
        return cls(joints, **options), dict(zip(names, (entry[key] for key in cls.listing.quantities), strict=True))

    def entry(self, theta: Mapping[str, float]) -> dict[str, Any]:
        """The inverse of `from_entry`: quantities and options of the spring with these parameters."""
        values = (theta[parameter.name] for parameter in self.parameters)
        return dict(zip(self.listing.quantities, values, strict=True)) | {key: getattr(self, key) for key in self.options}


class DesignSpring(Effect):
    """A spring that a co-design may use, in the form `design`."""

    design: ClassVar[DesignForm]

    def stretch(self, signals: Signals, theta: Mapping[str, Any]) -> Any:
        """How far a helical spring is deflected from its equilibrium [rad], negative where it is slack; None for springs that are made
        otherwise. Its torque on the first of its joints is its amplitude times that."""
        return None

    def profile(self, q: np.ndarray, theta: Mapping[str, float]) -> dict[str, np.ndarray]:
        """Columns of the table by which the spring is made, over angles q (K,) of its joint [rad]; empty where there is no such table.

        The ending of a column's name is its unit. "outline_x_mm" and "outline_y_mm" are a closed outline, which is drawn as well.
        """
        return {}

    def known_range(self, theta: Mapping[str, float]) -> tuple[float, float]:
        """Least and greatest angle of its joint between which its law is known [rad]; beyond, it is continued."""
        return -np.inf, np.inf


@dataclass(frozen=True)
class Clutched(DesignSpring):
    """A spring that a clutch connects in one phase of a task alone. Models know no phases: in the other its amplitudes are zero.

    Attributes:
        phase: The phase in which it acts, one of `PHASES`.
    """

    options = {"phase": PHASES}  # noqa: RUF012

    phase: Literal["go", "return"] = "go"

    def __post_init__(self) -> None:
        if self.phase not in PHASES:
            raise UserError(f"a clutched spring works in the phase {' or '.join(map(repr, PHASES))}, got {self.phase!r}")

    def kept_energy(
        self, lower: np.ndarray, upper: np.ndarray, ends: tuple[np.ndarray, np.ndarray]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Bounds of its parameters, narrowed to springs that leave their phase with the energy with which they enter it.

        Args:
            lower, upper: Bounds of its parameters, in their order.
            ends: Angles of all joints at the start and at the release [rad], (n,) each.

        Raises `UserError` where there are none.
        """
        raise NotImplementedError
