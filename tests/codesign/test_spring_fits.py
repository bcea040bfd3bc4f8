"""Springs fitted to a motion that is held: compared with closed forms and with many draws."""

import numpy as np
import pytest
from small_searches import design_of

from rrr_oc.codesign.search.proposals import motion_guess, sobol_points
from rrr_oc.codesign.search.spring_fits import TIMES, HeldMotion, fitted_springs
from rrr_oc.codesign.springs import drawn_bounds, from_drawn

VIA = np.array([[[0.2, -0.4], [0.3, 0.8]], [[-0.3, 0.1], [0.6, -0.2]]])  # [rad] phases, joints, points


def motions(design) -> list[HeldMotion]:
    return [HeldMotion.of(design, phase) for phase in motion_guess(design, design.problem.p_upper, (1.5, 2.5), VIA).phases]


def mean_square(design, phases, theta) -> float:
    """Mean squared torque over both phases, by the design's own torques."""
    sums = []
    for i, motion in enumerate(phases):
        load, _ = design.torques(motion.q, motion.dq, motion.ddq, design.task.payloads[i], theta, design.model.widths)
        sums.append(motion.weight * np.square(np.array(load)).sum() / TIMES)
    return sum(sums) / sum(motion.weight for motion in phases)


def test_what_is_left_is_the_mean_squared_torque():
    """Times weigh by the durations of their phases."""
    for name in ("PEA", "BPEA", "PEA+BPEA"):
        design = design_of(name)
        phases = motions(design)
        left, theta = fitted_springs(design, phases, 2)[0]
        assert left == pytest.approx(mean_square(design, phases, theta), rel=1e-9), name


@pytest.mark.parametrize("name", ["PEA", "BPEA", "PEA+BPEA"])
def test_no_draw_of_thousands_leaves_less(name):
    design = design_of(name)
    phases, (low, high) = motions(design), drawn_bounds(design.springs)
    left, theta = fitted_springs(design, phases, 4)[0]
    assert np.all(design.problem.p_lower - 1e-9 <= theta)
    assert np.all(theta <= design.problem.p_upper + 1e-9)
    draws = from_drawn(design.springs, low[:, None] + (high - low)[:, None] * sobol_points(len(low), 2048, 5).T)
    assert left <= min(mean_square(design, phases, draw) for draw in draws.T)
