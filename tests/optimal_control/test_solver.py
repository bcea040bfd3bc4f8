"""Solving, mesh errors and refinement against solutions in closed form and against an ODE solver."""

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from phases import changed, unbounded
from scipy.integrate import solve_ivp

from rrr_oc.optimal_control.problem import Bounded, Cycle, Guess, Link, Phase, PhaseGuess, Problem
from rrr_oc.optimal_control.refinement import MeshError, Refinement, mesh_error, refine
from rrr_oc.optimal_control.scheme import scheme, uniform_mesh
from rrr_oc.optimal_control.solver import Options, Solution, Solver, SolverFailure, solve
from rrr_oc.optimal_control.transcription import Transcription

TIGHT = Options(tolerance=1e-12)
METHODS = [scheme("hermite-simpson"), scheme("lobatto", 4), scheme("gauss", 2), scheme("gauss", 3), scheme("radau", 3)]
each_method = pytest.mark.parametrize("method", METHODS, ids=lambda s: f"{s.name}-{s.d}")


def phase(law, start, end, duration, data: int = 0, parameters: int = 0, **bounds) -> Phase:
    """One control; law(x, u, p, d) -> (rates, cost rate, paths)."""
    nx = len(start)
    x, u, p, d = ca.SX.sym("x", nx), ca.SX.sym("u"), ca.SX.sym("p", parameters), ca.SX.sym("d", data)
    dx, cost, paths = law(x, u, p, d)
    rates = ca.Function("rates", [x, u, p, d], [ca.vertcat(*dx), cost, ca.vertcat(*paths)])
    of_path = {key: bounds.pop(key) for key in list(bounds) if key.startswith("path")}
    path = Bounded(of_path["paths"], of_path["path_lower"], of_path["path_upper"], np.ones(len(paths))) if paths else Bounded()
    states = unbounded(("place", "speed", "third")[:nx])
    free = Phase("motion", rates, states, unbounded(("push",)), np.array(start, float), np.array(end, float), duration, path)
    return changed(free, **bounds)


def guess(ph: Phase, duration: float, parameters=()) -> Guess:
    end = np.where(np.isnan(ph.end), ph.start, ph.end)
    line = PhaseGuess(duration, lambda s: ph.start[:, None] + (end - ph.start)[:, None] * s, lambda s: np.zeros((1, len(s))))
    return Guess((line,), np.asarray(parameters, float))


def regulator() -> tuple[Problem, Guess]:
    """x' = −x + u, x(0) = 1, min ∫(x² + u²) over 2; a unit of cost scale other than 1."""
    ph = phase(lambda x, u, p, d: ((u - x,), x**2 + u**2, ()), [1], [np.nan], (2, 2))
    return Problem((ph,), cost_scale=0.3), guess(ph, 2)


def regulated(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Its optimum by the Riccati equation, with τ = 2 − t and r² = 2.

    x = E(τ)/E(2) and u = −P x for P = sinh(r τ)/E(τ), E(τ) = r cosh(r τ) + sinh(r τ).
    """
    r, tau = np.sqrt(2), 2 - t

    def envelope(s):
        return r * np.cosh(r * s) + np.sinh(r * s)

    x = envelope(tau) / envelope(2)
    return x, -np.sinh(r * tau) / envelope(tau) * x


def rayleigh(scale: float = 1.0) -> tuple[Problem, Guess]:
    """A nonlinear oscillator from (−5, −5), min ∫(x² + d u²), d = 1.

    Its cost is 29.3760788, by shooting in `validation/optimal_control.py`.
    """

    def law(x, u, p, d):
        return (x[1], -x[0] + x[1] * (1.4 - 0.14 * x[1] ** 2) + 4 * u), x[0] ** 2 + d * u**2, ()

    ph = phase(law, [-5, -5], [np.nan, np.nan], (2.5, 2.5), data=1)
    return Problem((ph,), data=np.array([1.0]), cost_scale=scale), guess(ph, 2.5)


@each_method
def test_regulator_comes_out_as_riccati_says(method):
    solution = solve(*regulator(), intervals=16, method=method, options=TIGHT)
    s = np.linspace(0, 1, 40)
    x, u = solution.at(0, s)
    known_x, known_u = regulated(2 * s)
    assert solution.cost == pytest.approx(-regulated(np.zeros(1))[1][0], rel=1e-5)  # P(0), since x(0) = 1; h⁴ for h = 1/8
    np.testing.assert_allclose(x[0], known_x, atol=1e-4)  # the interpolants' h³ at least
    np.testing.assert_allclose(u[0], known_u, atol=3e-3)  # Gauss 2 interpolates the control linearly
    assert solution.status == "Solve_Succeeded"
    np.testing.assert_array_equal(solution.durations, [2.0])


def test_cost_is_in_its_own_unit_whatever_the_scale():
    costs = [solve(*rayleigh(scale), options=TIGHT).cost for scale in (1e-2, 1.0, 1e3)]
    np.testing.assert_allclose(costs, costs[0], rtol=1e-9)  # the solver's tolerance, scaled
    assert costs[0] == pytest.approx(29.3760788, rel=1e-6)  # 40 intervals of Gauss 3


@each_method
def test_interpolation_is_the_collocation_polynomial(method):
    """At the stages x, x' = f and u; at the nodes x, from both sides; `sample` and `at` agree."""
    solution = solve(*rayleigh(), intervals=9, method=method, options=TIGHT)
    block, T = solution.transcription.blocks[0], 2.5
    edges = np.linspace(0, 1, 10)
    close = dict[str, Any](atol=1e-9)  # the solver's tolerance
    np.testing.assert_allclose(solution.at(0, edges)[0], solution.values[block.nodes], **close)
    np.testing.assert_allclose(solution.at(0, edges[1:] - 1e-13)[0], solution.values[block.nodes[:, 1:]], **close)
    t, x, dx, u = solution.sample(0, method.c)
    np.testing.assert_allclose(x, solution.values[block.stage_x].swapaxes(1, 2), **close)
    np.testing.assert_allclose(u, solution.controls(0).swapaxes(1, 2), **close)
    np.testing.assert_allclose(t, T * (edges[:-1, None] + method.c / 9), rtol=1e-13)
    x1, x2 = x
    np.testing.assert_allclose(dx, np.array([x2, -x1 + x2 * (1.4 - 0.14 * x2**2) + 4 * u[0]]), **close)
    inside = np.array([0.13, 0.57, 0.92])
    t, x, dx, u = solution.sample(0, inside)
    for found, sampled in zip(solution.at(0, t.ravel() / T), (x, u), strict=True):
        np.testing.assert_allclose(found, sampled.reshape(len(found), -1), **close)
    step = 1e-6
    slope = (solution.sample(0, inside + step)[1] - solution.sample(0, inside - step)[1]) / (2 * step * T / 9)
    np.testing.assert_allclose(dx, slope, rtol=1e-6, atol=1e-6)  # step² of truncation, 1e-16/step of rounding


@each_method
def test_mesh_error_brackets_the_true_error_of_every_interval(method):
    """Against x' = f(x, u) integrated anew from each node: the residual's integral is 1 to 8 times its outcome.

    The residual of a method of d stages crosses zero d times; the factor is how much of it cancels, 2 to 6 here.
    """
    solution = solve(*rayleigh(), intervals=32, method=method, options=TIGHT)
    rates, edges = solution.problem.phases[0].rates, np.linspace(0, 1, 33)
    nodes = solution.values[solution.transcription.blocks[0].nodes]
    t, x, _, _ = solution.sample(0, np.linspace(0, 1, 21)[1:-1])
    magnitude = 1 + np.abs(nodes).max(axis=1)
    for k in range(32):

        def slope(time, y, k=k):
            s = np.clip([time / 2.5], edges[k], edges[k + 1] - 1e-13)
            return np.array(rates(y, solution.at(0, s)[1][:, 0], [], [1.0])[0]).ravel()

        anew = solve_ivp(slope, 2.5 * edges[k : k + 2], nodes[:, k], "DOP853", t[k], rtol=1e-12, atol=1e-13)
        true = (np.abs(anew.y - x[:, k]) / magnitude[:, None]).max()
        assert 0.9 * true < mesh_error(solution).intervals[0][k] < 8 * true  # 0.9: the residual's flow may stretch it
    assert mesh_error(solution).largest == mesh_error(solution).intervals[0].max()


def test_mesh_error_of_the_quadrature():
    """x' = u = 1 is exact; the cost ∫x⁸ dt = 1/9 has the quadrature's error alone, known exactly: 2-point Gauss a quarter."""
    ph = phase(lambda x, u, p, d: ((u,), x**8, ()), [0], [np.nan], (1, 1), u_lower=np.ones(1), u_upper=np.ones(1))
    solution = solve(Problem((ph,)), guess(ph, 1), 4, scheme("gauss", 2), TIGHT)
    nodes = np.concatenate([(np.array([-1, 1]) / np.sqrt(3) + 1) / 8 + k / 4 for k in range(4)])
    rule = (nodes**8).mean()
    assert solution.cost == pytest.approx(rule, rel=1e-9)
    assert mesh_error(solution).quadrature == pytest.approx(abs(rule - 1 / 9) / rule, rel=1e-9)


def test_mesh_error_sees_bounds_broken_between_the_stages():
    """u = 3 (1 − 2 s)² − 0.5 through three Lobatto stages at 2.5, −0.5, 2.5 is within bounds −0.4 only at the nodes."""
    ph = phase(lambda x, u, p, d: ((u,), u**2, ()), [0], [np.nan], (1, 1), u_lower=np.full(1, -0.4))
    t = Transcription(Problem((ph,)), scheme("hermite-simpson"), (np.ones(1),))
    curve = Guess((PhaseGuess(1.0, lambda s: 0 * s[None], lambda s: (3 * (1 - 2 * s) ** 2 - 0.5)[None]),), np.zeros(0))
    solution = Solution(t, t.pack(curve), np.zeros(0), np.zeros(0), 1.0, "made up", 0, 0.0)
    assert isinstance(mesh_error(solution), MeshError)
    assert mesh_error(solution).violation == pytest.approx(0.1, abs=1e-3)  # nine Gauss points, of which the fifth is the middle


@each_method
def test_refinement_reaches_its_tolerance(method):
    first = solve(*rayleigh(), intervals=6, method=method)
    last, rows = refine(first, Refinement(tolerance=1e-5))
    assert mesh_error(first).largest > 1e-2
    assert mesh_error(last).largest <= 1e-5
    assert last.cost == pytest.approx(29.3760788, rel=1e-5)
    assert abs(rows[-1]["cost"] - rows[-2]["cost"]) <= 1e-5 * last.cost
    assert rows[0]["intervals"] == [6]
    assert rows[-1]["intervals"] == [len(last.transcription.mesh[0])]
    assert sum(last.transcription.mesh[0]) == pytest.approx(1, abs=1e-12)


def test_refinement_puts_intervals_where_the_error_is():
    """A boundary layer of width 0.01 at the start: the finest interval lies there, and the middle stays coarse."""
    ph = phase(lambda x, u, p, d: ((-100 * x + 100 * u,), x**2 + u**2, ()), [1], [np.nan], (1, 1))
    last, _ = refine(solve(Problem((ph,)), guess(ph, 1), 8), Refinement(tolerance=1e-6))
    mesh = last.transcription.mesh[0]
    middle = mesh[np.searchsorted(np.cumsum(mesh), 0.5)]
    assert mesh.argmin() < len(mesh) / 2
    assert mesh[0] < middle / 4


@pytest.mark.parametrize("method", [scheme("gauss", 3), scheme("lobatto", 4)], ids=lambda s: s.name)
def test_free_time_and_bounded_control(method):
    """Least time for a double integrator over 1 with |u| ≤ 1 is 2, switching at a node here."""
    ph = phase(lambda x, u, p, d: ((x[1], u), 1, ()), [0, 0], [1, 0], (0.5, 9), u_lower=-np.ones(1), u_upper=np.ones(1))
    solution = solve(Problem((ph,)), guess(ph, 3), 8, method, TIGHT)
    assert solution.durations[0] == pytest.approx(2, abs=1e-7)  # IPOPT widens the bounds by 1e-8
    assert solution.cost == pytest.approx(solution.durations[0], rel=1e-12)


@pytest.mark.parametrize("method", [scheme("gauss", 3), scheme("lobatto", 4)], ids=lambda s: s.name)
def test_refined_motions_keep_limits_between_the_nodes(method):
    """Least time over 1 with −1 ≤ u ≤ 2 is √3, switching at a third of it, which is no node; with a speed of at most 0.8 as well, it is
    0.4 + 0.65 + 0.8: 0.16 while speeding up, 0.52 at that speed, 0.32 while slowing down."""
    for fastest, least in ((np.inf, np.sqrt(3)), (0.8, 0.4 + 0.52 / 0.8 + 0.8)):
        limits: dict[str, Any] = {"u_lower": -np.ones(1), "u_upper": np.full(1, 2.0), "x_upper": np.array([np.inf, fastest])}
        ph = phase(lambda x, u, p, d: ((x[1], u), 1, ()), [0, 0], [1, 0], (0.5, 9), **limits)
        first = solve(Problem((ph,)), guess(ph, 3), 8, method)
        last, rows = refine(first, Refinement(tolerance=1e-6))
        assert rows[-1]["converged"]
        assert rows[-1]["violation"] <= 1e-5 < rows[0]["violation"]
        _, x, _, u = last.sample(0, np.linspace(0, 1, 101))
        assert -1 - 1e-7 <= u.min() <= u.max() <= 2 + 1e-7  # rounding of the interpolation
        assert x[1].max() <= fastest + 1e-5
        assert last.cost == pytest.approx(least, rel=1e-5)


def test_state_and_path_constraint_are_the_same():
    """Bryson–Denham, min ½∫u² with x ≤ 1/9: 4/(9 l) = 4, the bound on the state or as a path constraint."""
    start, end, cap = [0, 1], [0, -1], dict[str, Any](x_upper=np.array([1 / 9, np.inf]))
    bounded = phase(lambda x, u, p, d: ((x[1], u), u**2 / 2, ()), start, end, (1, 1), **cap)
    limits: dict[str, Any] = {"paths": ("cap",), "path_lower": np.array([-np.inf]), "path_upper": np.array([1 / 9])}
    path = phase(lambda x, u, p, d: ((x[1], u), u**2 / 2, (x[0],)), start, end, (1, 1), **limits)
    for ph in (bounded, path):  # a third of the way is a node, so that the scheme is exact; a stage of Radau's is the node
        solution = solve(Problem((ph,)), guess(ph, 1), 12, scheme("radau", 3), TIGHT)
        assert solution.cost == pytest.approx(4, rel=2e-7)  # IPOPT widens bounds by 1e-8


def test_parameters_are_found():
    """min over p of ∫(sin(t) − p_0 − p_1 t)² for t in [0, π/2]: the straight line of least squares."""
    law = lambda x, u, p, d: ((1, u), (ca.sin(x[0]) - p[0] - p[1] * x[0]) ** 2 + u**2, ())  # noqa: E731
    ph = phase(law, [0, 0], [np.nan, 0], (np.pi / 2, np.pi / 2), parameters=2)
    problem = Problem((ph,), ("offset", "slope"), np.full(2, -5.0), np.full(2, 5.0), np.array([0.5, 2.0]))
    a = np.pi / 2
    known = np.linalg.solve([[a, a**2 / 2], [a**2 / 2, a**3 / 3]], [1, 1])  # ∫sin = 1, ∫t sin t = 1
    np.testing.assert_allclose(solve(problem, guess(ph, a, [0, 0]), 8, options=TIGHT).parameters, known, rtol=1e-7)


def test_a_design_constraint_binds_and_has_its_multiplier():
    """min ∫(p − 1)² over 1 with p² ≤ d = 0.25: p = 0.5, dJ/dd = −(1 − p)/p = −1 by hand, the multiplier of p² − d."""
    ph = phase(lambda x, u, p, d: ((u,), (p - 1) ** 2 + u**2, ()), [0], [0], (1, 1), parameters=1, data=1)
    p, d = ca.SX.sym("p"), ca.SX.sym("d")
    design = ca.Function("design", [p, d], [p**2 - d])
    problem = Problem((ph,), ("p",), -np.ones(1), np.ones(1), np.full(1, 0.3), np.array([0.25]), design, ("size",))
    solution = solve(problem, guess(ph, 1, [0.1]), 4)
    assert solution.parameters[0] == pytest.approx(0.5, abs=1e-7)
    assert solution.lam_g[-1] == pytest.approx(1, rel=1e-5)  # the barrier leaves its 1e-8 over the constraint's slack


def test_infeasible_motion_is_named():
    """A distance of 1 in 1 s with |u| ≤ 1 needs 2 s."""
    ph = phase(lambda x, u, p, d: ((x[1], u), u**2, ()), [0, 0], [1, 0], (1, 1), u_lower=-np.ones(1), u_upper=np.ones(1))
    with pytest.raises(SolverFailure, match=r"the motion of (place|speed) at .* of phase 'motion'") as failure:
        solve(Problem((ph,)), guess(ph, 1), 5)
    assert failure.value.status == "Infeasible_Problem_Detected"
    assert failure.value.violation > 1e-3
    assert failure.value.iterations > 0


def test_infeasible_path_and_design_are_named():
    limits: dict[str, Any] = {"paths": ("clearance",), "path_lower": np.zeros(1), "path_upper": np.full(1, np.inf)}
    ph = phase(lambda x, u, p, d: ((u,), u**2, (-1 - x**2,)), [0], [0], (1, 1), **limits)
    with pytest.raises(SolverFailure, match=r"clearance at .* of phase 'motion', by 1 "):
        solve(Problem((ph,)), guess(ph, 1), 5)
    ph = phase(lambda x, u, p, d: ((u,), u**2 + p, ()), [0], [0], (1, 1), parameters=1)
    p, d = ca.SX.sym("p"), ca.SX.sym("d", 0)
    problem = Problem(
        (ph,), ("p",), -np.ones(1), np.ones(1), np.ones(1), design=ca.Function("g", [p, d], [p**2 + 2]), designs=("size",)
    )
    with pytest.raises(SolverFailure, match="most violated: size, by 2 "):
        solve(problem, guess(ph, 1, [0.5]), 5)


def test_an_unfinished_solve_raises_or_is_handed_out():
    problem, start = rayleigh()
    solver = Solver(Transcription(problem, scheme(), uniform_mesh(problem, 10)), Options(iterations=2))
    with pytest.raises(SolverFailure, match="after 2 iterations with 'Maximum_Iterations_Exceeded'"):
        solver.solve(start)
    solution = solver.solve(start, check=False)
    assert (solution.status, solution.iterations) == ("Maximum_Iterations_Exceeded", 2)


def test_a_warm_start_takes_fewer_iterations():
    ph = rayleigh()[0].phases[0]
    problem = replace(
        rayleigh()[0], phases=(changed(ph, u_lower=np.full(1, -1.0), u_upper=np.full(1, 1.0)),)
    )  # bounds that bind
    solver = Solver(Transcription(problem, scheme(), uniform_mesh(problem, 20)))
    cold = solver.solve(guess(ph, 2.5))
    near = np.array([1.02])
    moved, again = solver.solve(guess(ph, 2.5), near), solver.solve(cold, near)
    assert solver.solve(cold).iterations < cold.iterations / 2
    assert again.iterations < moved.iterations
    assert again.cost == pytest.approx(moved.cost, rel=1e-6)
    np.testing.assert_array_equal(again.problem.data, near)
    np.testing.assert_array_equal(cold.problem.data, [1.0])


def test_continuation_in_the_data():
    problem, start = rayleigh()
    solver = Solver(Transcription(problem, scheme(), uniform_mesh(problem, 20)))
    weights = [np.array([w]) for w in (0.7, 0.5, 0.3)]
    followed = solver.solve(start)
    for weight in weights:
        followed = solver.solve(followed, weight)
    assert followed.cost == pytest.approx(solve(replace(problem, data=weights[-1]), start, 20).cost, rel=1e-7)


@each_method
def test_a_solution_is_a_guess_for_another_mesh(method):
    coarse = solve(*rayleigh(), intervals=10, method=method)
    t = replace(coarse.transcription, mesh=(np.r_[np.full(10, 0.05), np.full(5, 0.1)],))
    w = t.pack(coarse.guess()) * t.scale
    s = np.r_[0, np.cumsum(t.mesh[0])].clip(0, 1)
    np.testing.assert_allclose(w[t.blocks[0].nodes], coarse.at(0, s)[0], atol=1e-12)
    cold = Solver(t).solve(guess(coarse.problem.phases[0], 2.5))
    warm = Solver(t, Options(barrier=1e-8)).solve(coarse.guess())
    assert warm.cost == pytest.approx(cold.cost, rel=1e-8)
    assert warm.iterations <= cold.iterations


def oscillator(links: tuple[Link, ...], speed: float = np.nan) -> Solution:
    """A mass of 2 kg on a spring k, pushed by u at a cost of ∫ u², from −b to b within 0.4 s and back to −b within 1.1 s."""

    def law(x, u, p, d):
        return (x[1], (u - p * x[0]) / 2), u**2, ()

    ways = [phase(law, [a, speed], [-a, speed], (T, T), parameters=1) for a, T in ((-0.3, 0.4), (0.3, 1.1))]
    box = {"p_lower": np.zeros(1), "p_upper": np.full(1, 1e3), "p_scale": np.full(1, 10.0)}
    problem = Problem(tuple(ways), ("stiffness",), **box, links=links)
    lines = [
        PhaseGuess(T, lambda s, a=a: np.array([a - 2 * a * s, 0 * s]), lambda s: 0 * s[None])
        for a, T in ((-0.3, 0.4), (0.3, 1.1))
    ]
    return solve(problem, Guess(tuple(lines), np.full(1, 20.0)), 20, scheme("lobatto", 4), TIGHT)


def test_a_cycle_at_the_natural_frequency_needs_no_push():
    """x = A sin(ω t) passes −b and b in 0.4 s, and turns on both sides in the other 1.1 s: ω = 2π/1.5, so k = 2 ω². With a stop at both
    ends, as at any other frequency, it needs a push."""
    cycle = oscillator((Link(0, 1, (1,)), Link(1, 0, (1,))))
    omega = 2 * np.pi / 1.5
    assert cycle.cost < 1e-10
    assert cycle.parameters[0] == pytest.approx(2 * omega**2, rel=1e-5)  # h⁶ for h = 1.1/20
    amplitude = 0.3 / np.sin(0.2 * omega)
    speed = amplitude * omega * np.cos(0.2 * omega)
    for i in range(2):
        np.testing.assert_allclose(cycle.at(i, np.array([0.0, 1.0]))[0][1], speed, rtol=1e-5)
    assert np.abs(cycle.at(1, np.linspace(0, 1, 201))[0][0]).max() == pytest.approx(amplitude, rel=1e-4)
    rest = oscillator((), speed=0.0)
    assert rest.cost > 1
    np.testing.assert_allclose(rest.at(0, np.array([0.0, 1.0]))[0][1], 0, atol=1e-12)


def test_phases_share_the_time_of_a_cycle():
    """A mass m = 2 kg moved by a from rest to rest within T costs ∫ u² = 12 m² a² / T³. Within 3 s together, ways of 0.3 m and 1.2 m take
    T ∝ √a, 1 s and 2 s; a tight bound of the first alone leaves the second the rest."""

    def law(x, u, p, d):
        return (x[1], u / 2), u**2, ()

    ways, lines = (0.3, 1.2), []
    for a in ways:
        lines.append(PhaseGuess(1.2, lambda s, a=a: np.array([a * s, 0 * s]), lambda s: 0 * s[None]))
    for longest, times in ((9.0, (1.0, 2.0)), (0.8, (0.8, 2.2))):
        phases = tuple(phase(law, [0.0, 0.0], [a, 0.0], (0.1, most)) for a, most in zip(ways, (longest, 9.0), strict=True))
        problem = Problem(phases, cycles=(Cycle((0, 1), (0.0, 3.0)),))
        found = solve(problem, Guess(tuple(lines), np.zeros(0)), 4, scheme("lobatto", 4), TIGHT)
        np.testing.assert_allclose(found.durations, times, rtol=1e-6)
        cost = sum(12 * 4 * a**2 / T**3 for a, T in zip(ways, times, strict=True))
        assert found.cost == pytest.approx(cost, rel=1e-6)
