"""From a declared case to its simulated signals and its truth."""

from dataclasses import dataclass, replace

import numpy as np

from validation.concealed.arms import Arm
from validation.concealed.bench import Bench, make_arm
from validation.concealed.cases import IMPERFECT, Case
from validation.concealed.effect import Signals
from validation.concealed.imperfect import ImperfectBench
from validation.concealed.plain import PlainFit
from validation.concealed.plant import Setup
from validation.concealed.sensors import Sensing
from validation.concealed.small_parts import small_parts, with_stated_error
from validation.concealed.strength import Scaled
from validation.concealed.trajectories import SHORT, STANDARD, UNSEEN


@dataclass(frozen=True)
class Built:
    """A finished case: `seen` recordings come first, then the unseen ones."""

    case: Case
    arm: Arm
    setup: Setup
    seen: int
    groups: tuple[str | None, ...]
    kinds: tuple[str, ...]  # of trajectory
    signals: Signals
    sensing: Sensing
    scaled: tuple[Scaled, ...]
    equal: tuple[dict | None, ...]  # per effect, `equal_effects`
    fit: PlainFit  # noise-free, of the seen recordings
    constants: np.ndarray | None  # torque constants of `current` data [Nm/A]
    ends: np.ndarray | None = None  # of the recordings, where they differ (B,) [s]
    small: tuple[dict, ...] | None = None  # faults of an imperfect arm, in the truth's form
    imperfections: np.ndarray | None = None  # residual that they leave after plain calibration (n,) [Nm]


def build(case: Case, duration: float | None = None) -> Built:
    """Simulate the baseline, scale each effect alone, then simulate all of them together."""
    if case.kind == IMPERFECT:
        return build_imperfect(case, duration)
    arm = make_arm(case)
    duration = duration or (15.0 if case.short else 30.0)  # [s]
    kinds = (*SHORT, *UNSEEN[:2]) if case.short else (*STANDARD, *UNSEEN)
    seen = len(kinds) - (2 if case.short else 3)
    bench = Bench(case, arm, kinds, seen, duration)
    scaled = tuple(bench.concealed(what, i) for i, what in enumerate(case.concealed))
    equal = tuple(bench.equal(x.effect) for x in scaled)
    final = bench.signals([s.effect for s in scaled])
    fit = bench.fit(final)
    return Built(case, arm, bench.setup, seen, bench.groups, kinds, final, bench.sensing, scaled, equal, fit, bench.constants)


def build_imperfect(case: Case, duration: float | None = None) -> Built:
    """The same on an arm with small faults everywhere."""
    bench = ImperfectBench(case, duration)
    scaled = tuple(bench.concealed(what, i) for i, what in enumerate(case.concealed))
    equal = tuple(bench.equal(x.effect) for x in scaled)
    strong = [s.effect for s in scaled]
    final = bench.signals(strong)
    return Built(
        case=case,
        arm=bench.arm,
        setup=bench.setup,
        seen=bench.seen,
        groups=bench.groups,
        kinds=bench.kinds,
        signals=final,
        sensing=bench.sensing,
        scaled=tuple(replace(s, effect=with_stated_error(bench, s.effect)) for s in scaled),
        equal=equal,
        fit=bench.fit(final),
        constants=bench.constants,
        ends=bench.ends,
        small=tuple(small_parts(bench, strong)),
        imperfections=bench.imperfections,
    )
