"""What springs can do: act across joints, be listed in recordings, be designed, and be connected by a clutch."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, Self

import numpy as np

from rrr_oc.effects.base import Effect, Signals
from rrr_oc.effects.capabilities import NativeTwin
from rrr_oc.effects.design_form import DesignForm
from rrr_oc.errors import UserError
from rrr_oc.numerics.smooth import ramp, ramp_integral

PHASES = ("go", "return")  # of a task
BEYOND = 1e6  # [rad] length of a tendon that none reaches


class Elastic(NativeTwin):
    """What pulls its joints back, with the torque lever × rate × pull, from a stretch that each joint's angle shortens by its lever.

    pull = max(stretch, 0) where it goes slack, else the stretch; the rate [Nm/rad] is the first of its amplitudes.
    """

    goes_slack: ClassVar[bool] = True

    def stretch(self, signals: Signals, theta: Mapping[str, Any]) -> Any:
        """How far it is deflected from its equilibrium [rad], as seen from the first of its joints; negative where it is slack."""
        raise NotImplementedError

    def lever(self, theta: Mapping[str, Any]) -> tuple[Any, ...]:
        """Derivative of the stretch by the position of each of `joints`, with the other sign."""
        return (1.0,)

    def torque(self, signals, theta, width):
        stretch = self.stretch(signals, theta)
        pull = theta[self.amplitudes[0]] * (ramp(stretch, width) if self.goes_slack else stretch)
        return tuple(lever * pull for lever in self.lever(theta))

    def energy(self, signals, theta, width):
        stretch = self.stretch(signals, theta)
        return theta[self.amplitudes[0]] * (ramp_integral(stretch, width) if self.goes_slack else stretch**2 / 2)

    def native(self, spec, joints, theta):
        """A fixed tendon whose length is the sum of lever × angle; its spring is slack above the length at which the stretch is 0, or
        nowhere. Several springs of a joint add up."""
        names = [joints[j] for j in self.joints]
        tendon = spec.add_tendon(name="_".join([self.name, *names]))
        for name, lever in zip(names, self.lever(theta), strict=True):
            tendon.wrap_joint(name, lever)
        rest = self.stretch(Signals(dict.fromkeys(self.joints, 0.0)), theta)
        tendon.stiffness = [theta[self.amplitudes[0]], 0.0, theta.get("hardening", 0.0)]
        tendon.springlength = [rest, BEYOND if self.goes_slack else rest]


@dataclass(frozen=True)
class LinkSpring(Effect):
    """A spring across one joint or more, beside their drives; raises `UserError` for joints or options that are none."""

    provides = "springs"
    scope = "mounted"

    def __post_init__(self) -> None:
        if self.placement == "pair" and (len(self.joints) != 2 or self.joints[0] == self.joints[1]):
            raise UserError(f"{self.name} spans two different joints, got {self.joints}")
        for key, allowed in self.options.items():
            value, default = getattr(self, key), getattr(type(self), key)
            several = isinstance(default, tuple)
            if (several and len(value) != len(default)) or any(v not in allowed for v in (value if several else (value,))):
                of = f"{len(default)} of " * several
                raise UserError(f"{self.name}: {key} is {of}{' or '.join(map(repr, allowed))}, got {value!r}")

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

    def profile(self, q: np.ndarray, theta: Mapping[str, float]) -> dict[str, np.ndarray]:
        """Columns of the table by which the spring is made, over angles q (K,) of its joint [rad]; empty where there is no such table.

        The ending of a column's name is its unit. "outline_x_mm" and "outline_y_mm" are a closed outline, which is drawn as well.
        """
        return {}

    def known_range(self, theta: Mapping[str, float]) -> tuple[float, float]:
        """Least and greatest angle of its joint between which its law is known [rad]; beyond, it is continued."""
        return -np.inf, np.inf


class Wound(Elastic, LinkSpring, DesignSpring):
    """A helical spring of a co-design, which is worked out as a part."""


@dataclass(frozen=True)
class Clutched(LinkSpring, DesignSpring):
    """A spring that a clutch connects in one phase of a task alone. Models know no phases: in the other its amplitudes are zero.

    Attributes:
        phase: The phase in which it acts, one of `PHASES`.
    """

    options = {"phase": PHASES}  # noqa: RUF012

    phase: Literal["go", "return"] = "go"

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
