"""Scale an effect until the residual that it leaves after plain calibration is a stated multiple of the noise."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from validation.concealed.effect import Effect


@dataclass(frozen=True)
class Scaled:
    """An effect with the ratio it reached; `per_joint` (n,) is residual RMS / noise in the recordings that have it."""

    effect: Effect
    requested: float
    reached: float
    per_joint: np.ndarray
    probes: int


def scale(
    effect: Effect, target: float, measure: Callable[[Effect], np.ndarray], tolerance: float = 0.12, probes: int = 6
) -> Scaled:
    """Log-log secant on the strength; the largest joint's ratio counts. Returns the closest probe."""
    tried: list[tuple[float, float, np.ndarray]] = []
    strength = effect.strength
    for _ in range(probes):
        strength = float(np.clip(strength, effect.smallest, effect.largest))
        per_joint = measure(effect.of(strength))
        tried.append((strength, float(per_joint.max()), per_joint))
        ratio = tried[-1][1]
        if abs(ratio / target - 1) <= tolerance or (ratio < target and strength >= effect.largest):
            break
        if ratio > target and strength <= effect.smallest:
            break
        strength = next_strength(tried, target)
    best = min(tried, key=lambda x: abs(np.log(max(x[1], 1e-12) / target)))
    return Scaled(effect.of(best[0]), target, best[1], best[2], len(tried))


def next_strength(tried: list[tuple[float, float, np.ndarray]], target: float) -> float:
    """From the last two probes, with an exponent held between 0.4 and 3; proportional after the first."""
    s, r = tried[-1][:2]
    exponent = 1.0
    if len(tried) > 1:
        s0, r0 = tried[-2][:2]
        if s0 != s and r0 > 0 and r > 0:
            with np.errstate(divide="ignore"):  # the logarithm of 0 after a probe that diverged, whose ratio is infinite
                exponent = float(np.clip(np.log(r / r0) / np.log(s / s0), 0.4, 3.0))
    return s * float(np.clip((target / max(r, 1e-9)) ** (1 / exponent), 1 / 30, 30))
