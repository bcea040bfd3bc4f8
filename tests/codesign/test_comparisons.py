"""Springs that balance an arm at rest, and designs at equal cycle times."""

import importlib.resources
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.search.comparisons import EQUAL, at_cycle_times, balancing_springs, cycle_times, stretched
from rrr_oc.codesign.search.local_optima import Optimum, follow_to_fine_mesh
from rrr_oc.codesign.search.proposals import SearchOptions, motion_guess
from rrr_oc.codesign.springs import spring_bounds
from rrr_oc.codesign.task import load_task
from rrr_oc.optimal_control.refinement import Refinement

TASK = load_task("paper")
QUICK = SearchOptions(fine=12, widths=(0.03,), refinement=Refinement(1e-3))


def design_of(configuration: str) -> CoDesign:
    return CoDesign(TASK, spring_bounds(TASK, configuration))


def holding_torques(q: np.ndarray, payload: float) -> np.ndarray:
    """Torques that hold joints 2 and 3 at q (2, K), by numeric Pinocchio."""
    model = pin.buildModelFromXML(importlib.resources.files("rrr_oc.urdf").joinpath("rrr.urdf").read_text())
    model.inertias[3] += pin.Inertia(payload, np.array([0.3, 0, 0]), np.zeros((3, 3)))
    data = model.createData()
    return np.array([pin.computeGeneralizedGravity(model, data, np.r_[0, c])[1:] for c in q.T]).T


def test_balancing_springs_are_what_a_grid_finds():
    """A spring k max(q_eq − q, 0) on each joint, against the best of a grid over q_eq with the best k for each."""
    found = balancing_springs(design_of("PEA"))
    assert found is not None
    springs = design_of("PEA").hardware(found)
    q = TASK.start[:, None] + np.outer(TASK.release - TASK.start, np.linspace(0, 1, 101))
    needed = np.array([holding_torques(q, payload) for payload in (TASK.payload, 0.0)])

    def left(row: int, k: float, q_eq: float) -> float:
        return np.square(needed[:, row] - k * np.maximum(q_eq - q[row], 0)).sum()

    for row, (stiffest, low, high) in enumerate(((13.7052, -10, 140), (1.32, -140, 140))):
        best = np.inf
        for q_eq in np.radians(np.linspace(low, high, 601)):
            shape = np.maximum(q_eq - q[row], 0)
            k = float(np.clip((needed[:, row] @ shape).sum() / max(2 * shape @ shape, 1e-12), 0, stiffest))
            best = min(best, left(row, k, q_eq))
        assert (
            left(row, springs[f"k_p{row + 2}"], springs[f"q_eq{row + 2}"]) <= 1.002 * best
        )  # other postures, smoothed springs


def test_nothing_balances_without_springs():
    assert balancing_springs(design_of("SA")) is None


def test_default_times_are_those_of_stiff_actuation_and_of_the_best():
    assert cycle_times(2.2, 9.5) == (2.2, 9.5)
    assert cycle_times(9.5, 2.2) == (2.2, 9.5)
    assert cycle_times(2.2, 2.21) == (2.21,)
    assert cycle_times(None, 4.0) == (4.0,)


@pytest.fixture(scope="module")
def stiff() -> Optimum:
    found = follow_to_fine_mesh(design_of("SA"), QUICK, motion_guess(design_of("SA"), np.zeros(0), [1.5, 1.5]))
    assert found is not None
    return found


def test_a_stretched_motion_is_still_a_motion(stiff):
    """Angles as before, speeds and accelerations by the factor and its square; each phase within its bounds."""
    design, s = design_of("SA"), np.linspace(0, 1, 7)
    before = stiff.solution.guess().phases
    both, go, back = (guess.phases for guess in stretched(design, stiff.solution, 4.0))
    factor = stiff.solution.durations.sum() / 4.0
    for old, new in zip(before, both, strict=True):
        np.testing.assert_allclose(new.states(s)[:2], old.states(s)[:2])
        np.testing.assert_allclose(new.states(s)[2:], factor * old.states(s)[2:])
        np.testing.assert_allclose(new.controls(s), factor**2 * old.controls(s))
    assert [p.duration for p in both] == pytest.approx((stiff.solution.durations / factor).tolist())
    assert [p.duration for p in go] == pytest.approx([4.0 - before[1].duration, before[1].duration])
    assert [p.duration for p in back] == pytest.approx([before[0].duration, 4.0 - before[0].duration])
    assert max(p.duration for guess in stretched(design, stiff.solution, 9.9) for p in guess.phases) == 5.0


def test_designs_take_the_time_that_they_are_given(stiff):
    design, own = design_of("SA"), float(stiff.solution.durations.sum())
    found = at_cycle_times(design, stiff.solution, [own, 3.0, 2.05], [], QUICK)
    assert set(found) == {own, 3.0}  # in 2.05 s the joints would be faster than they may be
    assert found[own].cost == stiff.cost
    assert found[3.0].durations.sum() == pytest.approx(3.0, rel=1.001 * EQUAL)
    more = at_cycle_times(design_of("PEA"), _sprung(stiff), [3.0], [(design, found)], QUICK)
    assert more[3.0].durations.sum() == pytest.approx(3.0, rel=1.001 * EQUAL)
    assert more[3.0].cost < found[3.0].cost


def _sprung(stiff: Optimum):
    design = design_of("PEA")
    middle = np.mean([np.concatenate([getattr(s, side) for s in design.springs]) for side in ("lower", "upper")], axis=0)
    found = follow_to_fine_mesh(design, QUICK, replace(stiff.solution.guess(), parameters=middle))
    assert found is not None
    return found.solution
