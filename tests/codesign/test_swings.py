"""Motions with a swing more or less: what they are made of, and where they lead."""

from dataclasses import replace

import numpy as np
import pytest
from small_searches import OPTIONS, design_of

from rrr_oc.codesign.search.local_optima import follow_to_fine_mesh
from rrr_oc.codesign.search.motions import MotionSearch
from rrr_oc.codesign.search.swings import turns, with_other_swings
from rrr_oc.optimal_control.problem import Guess, PhaseGuess

S = np.linspace(0, 1, 2001)
ORDERS = np.array([0, 0, 1, 1]), np.array([2, 2])


def swinging(number: float, T: float = 3.0, drift: float = 0.0) -> PhaseGuess:
    """Joint 1 swings `number` times with an amplitude of 0.2 rad about a line, joint 2 stands still."""
    rate, still = 2 * np.pi * number, np.zeros_like

    def states(s: np.ndarray) -> np.ndarray:
        dq = (0.2 * rate * np.sin(rate * s) + drift) / T
        return np.array([0.2 - 0.2 * np.cos(rate * s) + drift * s, still(s), dq, still(s)])

    return PhaseGuess(T, states, lambda s: np.array([0.2 * rate**2 * np.cos(rate * s) / T**2, still(s)]))


def test_turns_are_counted_and_placed():
    angle = swinging(2.5).states(S)[0]
    at = turns(angle)
    np.testing.assert_allclose(S[at], [0, 0.2, 0.4, 0.6, 0.8, 1.0], atol=1e-3)
    assert turns(np.linspace(0.0, 1.0, 50)) == [0, 49]
    assert turns(np.zeros(50)) == [0, 49]
    rng = np.random.default_rng(0)
    assert len(turns(angle + rng.uniform(-1e-3, 1e-3, S.size))) == len(at)  # less than what counts as a turn


@pytest.mark.parametrize("drift", [0.0, 0.1])
def test_a_swing_is_repeated_or_left_out(drift):
    """Of two and a half swings each becomes two, and each but the whole is left out: four swings from turn to turn but one."""
    phase = swinging(2.5, drift=drift)
    first, last = phase.states(np.array([0.0, 1.0]))[:2].T
    made = with_other_swings(phase, ORDERS, (0.5, 20.0))
    assert len(made) == 8
    for i, one in enumerate(made):
        x = one.states(S)
        assert len(turns(x[0])) == (8 if i % 2 == 0 else 4)
        assert one.duration == pytest.approx(4.2 if i % 2 == 0 else 1.8, abs=0.03)  # one swing takes 1.2 s
        np.testing.assert_allclose(x[:2, [0, -1]].T, [first, last], atol=1e-6)
        assert np.abs(np.diff(x[0])).max() < 0.01  # no jump where it was put together
        moved = np.cumsum((x[2, 1:] + x[2, :-1]) / 2) * one.duration / (S.size - 1)
        np.testing.assert_allclose(x[0, 1:] - x[0, 0], moved, atol=0.01 + 1.5 * drift)  # speeds are those of the angles


def test_a_swing_is_made_faster_where_there_is_no_time_for_it():
    slow, fast = (with_other_swings(swinging(2.0, T=4.0), ORDERS, (1.0, most))[0] for most in (20.0, 4.0))
    assert (slow.duration, fast.duration) == (pytest.approx(6.0, abs=0.02), 4.0)
    faster = slow.duration / fast.duration
    np.testing.assert_allclose(fast.states(S)[:2], slow.states(S)[:2], atol=1e-9)
    np.testing.assert_allclose(fast.states(S)[2:], faster * slow.states(S)[2:], atol=1e-9)
    np.testing.assert_allclose(fast.controls(S), faster**2 * slow.controls(S), atol=1e-9)


def test_swings_of_two_joints_at_one_time_are_one():
    alone = swinging(2.0)
    both = PhaseGuess(3.0, lambda s: alone.states(s)[[0, 0, 2, 2]], lambda s: alone.controls(s)[[0, 0]])
    assert len(with_other_swings(both, ORDERS, (0.5, 20.0))) == len(with_other_swings(alone, ORDERS, (0.5, 20.0)))


def test_a_motion_that_does_not_swing_has_no_others():
    straight = PhaseGuess(1.0, lambda s: np.array([s, -s, 0 * s + 1, 0 * s - 1]), lambda s: np.zeros((2, s.size)))
    assert with_other_swings(straight, ORDERS, (0.5, 5.0)) == []


def test_the_search_goes_from_one_number_of_swings_to_the_best():
    """With springs that carry most of the load, each phase has optima with different numbers of turns. From few and from many turns
    two steps lead to the same best motion, which costs less than both. With the springs free from there on, the cost falls: with wide
    springs in between it rose."""
    hardware = {"k_p2": 9.0, "q_eq2": 1.731, "k_p3": 0.32, "q_eq3": 2.443, "k_b": 13.7, "q_0": -0.5}
    design = design_of("PEA+BPEA").with_fixed(hardware | {"r_1": 0.014, "r_2": 0.036, "r_3": 0.01577})
    search, parameters = MotionSearch(design, replace(OPTIONS, fine=24)), design.problem.p_lower
    proposed = search.proposed(parameters, 4)
    ends = []
    for which in (0, -1):
        phases = [some[which].solution.guess().phases[0] for some in proposed]
        ends.append(sum(len(turns(phase.states(S)[0])) for phase in phases))
        costs = []
        for _ in range(3):
            motions = search.with_other_swings(Guess(tuple(phases), parameters))
            costs.append([some[0].cost for some in motions])
            phases = [some[0].solution.guess().phases[0] for some in motions]
        np.testing.assert_allclose(costs[1], [7.0072, 6.0354], rtol=1e-4)  # of the mesh of 24 intervals
        np.testing.assert_allclose(costs[2], costs[1], rtol=1e-6)
    assert ends[0] < ends[1]
    guess, options = Guess(tuple(phases), parameters), replace(OPTIONS, fine=24)
    narrow, wide = (follow_to_fine_mesh(design_of("PEA+BPEA"), one, guess) for one in (options.narrow, options))
    assert narrow is not None
    assert narrow.cost < sum(costs[2])
    assert wide is None or narrow.cost < wide.cost
