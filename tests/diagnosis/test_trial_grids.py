"""Shapes of laws that are not linear are tried on grids: what lies between two points must be seen from one of them."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from recorded import Plant, as_set, multisine, record

from rrr_oc.calibration.regression import rows
from rrr_oc.diagnosis.procedure import ready
from rrr_oc.diagnosis.signatures import table
from rrr_oc.effects import Trial
from rrr_oc.effects.priors import Priors

SEEN = 0.65  # least share of the squared torque beyond the plain model that one of two neighbours explains
FREE = {"damping_time"}  # chosen with the stiffness
NAMES = (
    "stribeck", "presliding_hysteresis", "joint_elasticity", "friction_drift", "parallel_spring", "biarticular_spring",
    "position_dependent_friction",
)  # fmt: skip


def neighbours(trials: Sequence[Trial]) -> Iterator[tuple[Trial, Trial]]:
    """Each trial with the next one that differs in one number alone."""
    for i, a in enumerate(trials):
        for b in trials[i + 1 :]:
            if (a.effect, a.width, len(a.points)) == (b.effect, b.width, len(b.points)):
                changed = {k for p, q in zip(a.points, b.points, strict=True) for k in p if p[k] != q[k]} - FREE
                if len(changed) == 1:
                    yield a, b
                    break


def half(x: float, y: float) -> float:
    """Half way between two numbers, in the logarithm where they have the same sign."""
    return float(np.sign(x) * np.sqrt(x * y)) if x * y > 0 else (x + y) / 2


def beyond(plain: np.ndarray, columns: np.ndarray) -> float:
    """The squares of a first column that the others, and plain ones, do not explain."""
    every = np.hstack([plain, columns[:, 1:]])
    every = every / np.maximum(np.linalg.norm(every, axis=0), 1e-12)
    return float(np.sum((columns[:, 0] - every @ np.linalg.lstsq(every, columns[:, 0], rcond=1e-9)[0]) ** 2))


def test_a_shape_between_two_trials_is_seen_from_one_of_them():
    plant = Plant("rrr_prototype", np.full(3, 5.0), np.full(3, 20.0), np.full(3, 0.2))
    rng = np.random.default_rng(0)
    made = [record(plant, f"{i}.csv", rng, 10.0, 0.005, multisine(3, np.arange(1000) / 100, rng, 0.4)) for i in range(3)]
    _, fitter, every, model = ready(as_set(plant, made), Priors())
    prepared = fitter.data.prepared
    plain = np.concatenate(rows(prepared, model, True).jacobian)  # (n M, p), joint by joint
    hidden = {}
    for name in NAMES:
        pairs = list(neighbours([t for t in every if t.effect.name == name]))
        assert pairs
        middle = [
            replace(a, points=tuple({k: half(p[k], q[k]) for k in p} for p, q in zip(a.points, b.points, strict=True)))
            for a, b in pairs
        ]
        found = [table(prepared, model, some) for some in (middle, [a for a, _ in pairs], [b for _, b in pairs])]
        for k, one in enumerate(middle):
            x, a, b = (np.concatenate(t.of(k)) for t in found)
            share = 1 - min(beyond(plain, np.hstack([x[:, :1], y])) for y in (a, b)) / beyond(plain, x[:, :1])
            if share < SEEN:
                hidden[name, one.effect.joints, *one.points[0].values()] = share
    assert not hidden
