"""Gradient optima within the parametrisation and springs alone, against searches that use no gradient."""

import numpy as np
import pytest
from scipy.optimize import minimize

from rrr_oc.codesign.search.proposals import motion_guess
from rrr_oc.codesign.task import load_task
from studies.paper.encoding import Analytic, Encoding
from studies.paper.experiments import experiment
from studies.paper.fixed_motion import _exact, _sampled, best_springs
from studies.paper.parametrised import RestrictedDesign, proposals

TASK = load_task("paper")


@pytest.fixture(scope="module")
def restricted():
    known = Encoding(experiment(TASK, "BPEA"))
    program = RestrictedDesign(known)
    found = [program.solve(program.start(g)) for g in proposals(known, 2, 0)]
    return known, program, min((f for f in found if f is not None), key=lambda f: f.cost)


def test_an_optimum_keeps_the_limits_and_has_evolutions_cost(restricted):
    known, _, best = restricted
    scores = Analytic(known, 40)(best.x[None])
    assert scores.cost[0] == best.cost
    assert scores.excess[0] < 1e-7
    assert best.smooth == pytest.approx(scores.E1[0], rel=2e-3)  # widths of 0.001 and 0.003 rad, 12 nodes


def test_no_candidate_nearby_is_better(restricted):
    """1,200 random steps of three sizes, by the exact cost with penalties: what the smoothing shifts is all that may be gained."""
    known, _, best = restricted
    rng = np.random.default_rng(0)
    for size in (1e-2, 1e-3, 1e-4):
        steps = best.x + size * rng.standard_normal((400, known.size))
        assert Analytic(known, 40)(np.clip(steps, 0, 1)).cost.min() > best.cost * (1 - 1e-3)


def test_smoothing_vanishes_with_its_width(restricted):
    """The program's own cost at one point tends to the exact one as both widths go to zero."""
    known, program, best = restricted
    encoding, exact = program.encoding, float(Analytic(known)(best.x[None]).E1[0])
    _, durations, via = encoding.split(encoding.values(best.x[None]))
    start = np.r_[encoding.decode(best.x[None]).theta[:, 0], durations[:, 0], *[v[:, :, 0].ravel("F") for v in via]]
    margin = np.zeros((6, 2))
    errors = [abs(program.cost(start, (w, w), margin) / exact - 1) for w in (1e-1, 1e-2, 1e-3, 1e-5)]
    assert errors[0] > errors[1] > errors[-1]
    assert errors[-1] < 1e-6


def test_springs_alone_are_those_of_a_search_without_gradients():
    """PEA on a motion of 3 s: four parameters by Nelder–Mead on the exact cost, from the found point and from afar."""
    design = experiment(TASK, "PEA")
    phases = motion_guess(design, np.zeros(0), [3.0, 3.0]).phases
    found = best_springs(design, phases, starts=4)
    motion, h = _sampled(design, phases)
    lower, upper = design.problem.p_lower, design.problem.p_upper

    def cost(theta: np.ndarray) -> float:
        return _exact(design, np.clip(theta, lower, upper), motion, h)

    for start in (found.parameters, np.array([8.0, 1.5, 0.5, 0.5])):
        searched = minimize(cost, start, method="Nelder-Mead", options={"maxfev": 1500, "xatol": 1e-6, "fatol": 1e-6})
        assert searched.fun * (1 + 1e-4) >= found.E1
    assert pytest.approx(cost(found.parameters), rel=1e-12) == found.E1
