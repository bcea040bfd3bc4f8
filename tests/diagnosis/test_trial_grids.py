"""Shapes of laws that are not linear are tried on grids: what lies between two points must be seen from one of them."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import pytest
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


class Seen:
    """By how much some trials explain others on the recordings of one arm."""

    def __init__(self) -> None:
        plant = Plant("rrr_prototype", np.full(3, 5.0), np.full(3, 20.0), np.full(3, 0.2))
        rng = np.random.default_rng(0)
        motions = (multisine(3, np.arange(1000) / 100, rng, 0.4) for _ in range(3))
        made = [record(plant, f"{i}.csv", rng, 10.0, 0.005, motion) for i, motion in enumerate(motions)]
        _, self.fitter, self.trials, self.model = ready(as_set(plant, made), Priors())
        # (n M, p), joint by joint
        self.plain = np.concatenate(rows(self.fitter.data.prepared, self.model, True).jacobian)

    def shares(self, trials: Sequence[Trial], others: Sequence[Sequence[Trial]]) -> list[float]:
        """Of each trial's squares beyond the plain model the largest share that one of its others explains."""
        own, theirs = self._columns(trials), iter(self._columns([t for some in others for t in some]))
        pairs = [(x, [next(theirs) for _ in some]) for x, some in zip(own, others, strict=True)]
        return [
            1 - min(beyond(self.plain, np.hstack([x[:, :1], y])) for y in ys) / beyond(self.plain, x[:, :1]) for x, ys in pairs
        ]

    def _columns(self, trials: Sequence[Trial]) -> list[np.ndarray]:
        found = table(self.fitter.data.prepared, self.model, trials)
        return [np.concatenate(found.of(k)) for k in range(len(trials))]


@pytest.fixture(scope="module")
def seen():
    return Seen()


@pytest.mark.parametrize("name", NAMES)
def test_a_shape_between_two_trials_is_seen_from_one_of_them(seen, name):
    pairs = list(neighbours([t for t in seen.trials if t.effect.name == name]))
    middle = [
        replace(a, points=tuple({k: half(p[k], q[k]) for k in p} for p, q in zip(a.points, b.points, strict=True)))
        for a, b in pairs
    ]
    shares = seen.shares(middle, pairs)
    assert min(shares) > SEEN, [(t.effect, t.points[0], s) for t, s in zip(middle, shares, strict=True) if s <= SEEN]


@pytest.mark.parametrize("taut", [0.1, 0.3, 0.6, 0.9])
def test_a_spring_across_two_joints_is_seen_however_seldom_it_is_taut(seen, taut):
    view, some, others = seen.fitter.view, [], []
    for kind in {t.effect for t in seen.trials if t.effect.name == "biarticular_spring"}:
        (a, b), (wa, wb) = kind.joints, kind.winding
        stretch = -wa * view.positions[a] - wb * 0.75 * view.positions[b]
        some.append(kind.trial(view, rho=0.75, phi=float(np.quantile(stretch, 1 - taut))))
        others.append([t for t in seen.trials if t.effect == kind])
    assert min(seen.shares(some, others)) > SEEN


def test_ripples_are_tried_that_the_slowest_recording_shows(planar):
    """What is too fast for the filter in fast motion passes it where the joint moves ten times slower."""
    plant, t, made = planar(1), np.arange(1000) / 100, []
    for k, speed in enumerate((1.0, 0.1)):
        motion = tuple(np.array([x]) for x in (speed * t, speed + 0 * t, 0 * t))
        made.append(record(plant, f"{k}.csv", np.random.default_rng(k), motion=motion))

    def fastest(recordings) -> float:
        _, _, every, _ = ready(as_set(plant, recordings), Priors())
        return max(p["order"] for t in every if t.effect.name == "torque_ripple" for p in t.points)

    assert fastest(made) == fastest(made[1:])
    assert fastest(made) > 9 * fastest(made[:1])
