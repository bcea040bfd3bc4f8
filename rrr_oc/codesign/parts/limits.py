"""What a task allows the springs of a design to be."""

from typing import Annotated

from msgspec import Meta

from rrr_oc.schema import Interval, Positive, Schema, check_interval

Cycles = Annotated[float, Meta(ge=1, description="a number of cycles of 1 or more is required")]


class SpringLimits(Schema, frozen=True):
    """Limits of springs as parts.

    The first four, by default none, are limits of motion and springs as they are designed together, for springs in parallel with a
    joint (`parallel_spring`) and those with a cable across two (`biarticular_spring`, `clutched_biarticular_spring`). The others are
    limits of the parts that are worked out for what was designed.

    Attributes:
        torque_Nm: Greatest torque of a spring in parallel with a joint.
        turn_deg: Greatest turn of such a spring from its equilibrium.
        force_N: Greatest force in the cable of a spring across two joints.
        energy_J: Greatest energy that a spring stores.
        safety: Least safety of the wire's stress, against a permanent set and over the cycles [1].
        cycles: How often a spring has to stand the motion.
        outside_mm: Greatest outside diameter.
        length_mm: Greatest length in use, of an extension spring drawn out and with its hooks.
        index: Least and greatest mean diameter of a coil over the wire's [1].
        coils: Least number of active coils.
        pulley_mm: Least and greatest radius of a pulley by which a cable may pull a spring in parallel with a joint.
    """

    torque_Nm: Positive | None = None
    turn_deg: Positive | None = None
    force_N: Positive | None = None
    energy_J: Positive | None = None
    safety: Positive = 1.2
    cycles: Cycles = 1e6
    outside_mm: Positive = 80.0
    length_mm: Positive = 200.0
    index: Interval = (4.0, 12.0)
    coils: Positive = 3.0
    pulley_mm: Interval = (14.0, 40.0)

    @property
    def of_design(self) -> dict[str, float]:
        """The limits of motion and springs that there are, by key."""
        keys = ("torque_Nm", "turn_deg", "force_N", "energy_J")
        return {key: value for key in keys if (value := getattr(self, key)) is not None}

    def __post_init__(self) -> None:
        check_interval("index", self.index)
        check_interval("pulley_mm", self.pulley_mm)
        for key, least in (("index", 1.5), ("pulley_mm", 1.0)):
            if getattr(self, key)[0] < least:
                raise ValueError(f"{key}: found {list(getattr(self, key))}; {least:g} or more is required")
