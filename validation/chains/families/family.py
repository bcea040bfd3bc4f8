"""What a family of arms is: its arms, motions, chain of measurement and plant, as data."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from validation.chains.arms import ArmKind
from validation.chains.chain import Chain
from validation.chains.motions import Pace
from validation.chains.plant import Control


@dataclass(frozen=True)
class Family:
    """A family.

    Attributes:
        says: What it is, in one line.
        arm: What its arms have in common.
        chain: A chain of measurement.
        pace: Of its motions.
        control: Its controller, of arms that MuJoCo moves; None where links move exactly as planned.
        recordings: To learn from; two more of another motion are for tests.
        points: Whether it learns from point-to-point motions rather than sines; tests have the other kind.
        pushes: From outside in a recording, on average.
        current: Whether currents are recorded [A].
    """

    says: str
    arm: ArmKind
    chain: Callable[[np.random.Generator], Chain]
    pace: Pace
    control: Control | None = None
    recordings: int = 3
    points: bool = False
    pushes: float = 0.0
    current: bool = False
