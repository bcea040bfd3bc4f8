"""Certificates against re-solved problems, placed saddles, and quadrature and integration by other means."""

import json
import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from phases import changed, unbounded
from scipy.sparse import csc_array
from test_design_problem import TASK, design_of, solved, trapezoid

from rrr_oc.codesign.certificate import Certificate, certify, exact_cost, reintegrate
from rrr_oc.codesign.clearance import Surroundings
from rrr_oc.codesign.design_file import data
from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.search.local_optima import Optimum
from rrr_oc.optimal_control.optimality import Kkt, _factor
from rrr_oc.optimal_control.problem import Guess, Phase, PhaseGuess, Problem
from rrr_oc.optimal_control.refinement import Refinement, mesh_error, refine
from rrr_oc.optimal_control.scheme import Scheme, scheme, uniform_mesh
from rrr_oc.optimal_control.solver import Options, Solution, Solver, solve
from rrr_oc.optimal_control.transcription import Transcription
from rrr_oc.storage import write_json

TIGHT = Options(tolerance=1e-10)


def certificate_of(design: CoDesign, solution: Solution) -> Certificate:
    optimum = Optimum(solution, refine(solution, Refinement(rounds=0))[1], 1)
    return certify(design, optimum)


@pytest.fixture(scope="module")
def certified() -> dict[str, tuple[CoDesign, Solution, Certificate]]:
    """SA, PEA and BPEA on coarse meshes, solved tightly; multipliers are those of the mesh, whatever its error."""
    found = {}
    for name, intervals in (("SA", 12), ("PEA", 16), ("BPEA", 12)):
        design = design_of(name)
        near = solved(design, intervals, 0.01)
        solution = Solver(near.transcription, TIGHT).solve(near, near.problem.data)
        found[name] = design, solution, certificate_of(design, solution)
    return found


def resolved(design: CoDesign, solution: Solution, move: Callable[[Problem], Problem] = lambda p: p) -> float:
    """The optimal cost of a moved problem on the same mesh, warm from the solution."""
    transcription = Transcription(move(design.problem), solution.transcription.scheme, solution.transcription.mesh)
    return Solver(transcription, TIGHT).solve(solution, design.data(0.01)).cost


def slope(design: CoDesign, solution: Solution, moved: Callable[[float], float], step: float) -> float:
    """Relative fall of the cost by one unit outward, by central differences of re-solved problems."""
    return (moved(-step) - moved(step)) / (2 * step) / solution.cost


def hardware_moved(design: CoDesign, name: str, side: int) -> Callable[[float], CoDesign]:
    def move(step: float) -> CoDesign:
        (spring,) = design.springs
        bounds = dict(spring.hardware)
        pair = list(bounds[name])
        pair[side] += step if side else -step
        bounds[name] = (pair[0], pair[1])
        return replace(design, springs=(replace(spring, hardware=bounds),))

    return move


def saving(certificate: Certificate, name: str) -> float:
    """The number of the certificate's sentence, as a fraction; its record must say the same."""
    (bound,) = [b for b in certificate.active if b.name == name]
    number = float(re.search(r"would save (\S+) % of E1", bound.sentence)[1]) / 100
    assert number == pytest.approx(bound.saving, rel=0.051)  # two digits: 0.05 of 1.0
    assert name in bound.sentence
    return bound.saving


# Central differences of a smooth optimal value: the step's square, and the solver's 1e-10 over the step.
CLOSE = dict[str, Any](rel=5e-3)


@pytest.mark.parametrize(
    ("name", "side", "words", "unit", "step"),
    [
        ("k_b", 1, "the upper bound of k_b", 1.0, 0.05),
        ("r_2", 1, "the upper bound of r_2", 1e-3, 5e-5),
        ("r_1", 0, "the lower bound of r_1", 1e-3, 5e-5),
        ("r_3", 0, "the lower bound of r_3", 1e-3, 5e-5),
    ],
)
def test_savings_of_biarticular_hardware(certified, name, side, words, unit, step):
    """In per cent of E1 by Nm/rad and by mm."""
    design, solution, certificate = certified["BPEA"]
    move = hardware_moved(design, name, side)
    by_hand = slope(design, solution, lambda h: resolved(move(h), solution), step) * unit
    assert saving(certificate, words) == pytest.approx(by_hand, **CLOSE)


def test_saving_of_parallel_stiffness(certified):
    design, solution, certificate = certified["PEA"]

    def moved(h: float) -> float:
        return resolved(design, solution, lambda p: replace(p, p_upper=p.p_upper + np.array([h, 0, 0, 0])))

    words = "the upper bound of parallel_spring[joint2].stiffness"
    assert saving(certificate, words) == pytest.approx(slope(design, solution, moved, 0.05), **CLOSE)


def test_saving_of_a_duration(certified):
    design, solution, certificate = certified["PEA"]

    def moved(h: float) -> float:
        def longer(p: Problem) -> Problem:
            return replace(p, phases=(replace(p.phases[0], duration=(1.0, 5.0 + h)), p.phases[1]))

        return resolved(design, solution, longer)

    assert saving(certificate, "the upper bound of duration of go") == pytest.approx(
        slope(design, solution, moved, 0.01), **CLOSE
    )


def limits_moved(row: int, kind: str, unit: float) -> Callable[[float], Callable[[Problem], Problem]]:
    """Both sides of an acceleration, or the upper side of a state's limit, outward in both phases."""

    def by(h: float) -> Callable[[Problem], Problem]:
        def move(p: Problem) -> Problem:
            phases = []
            for phase in p.phases:
                step = h * unit * np.eye(len(getattr(phase, kind)))[row]
                upper = {f"{kind}_upper": getattr(phase, kind).upper + step}
                phases.append(changed(phase, **upper, **({"u_lower": phase.u.lower - step} if kind == "u" else {})))
            return replace(p, phases=tuple(phases))

        return move

    return by


@pytest.mark.parametrize(
    ("words", "row", "kind"),
    [("the acceleration limit of joint3", 1, "u"), ("the upper speed limit of joint3", 3, "x")],
)
@pytest.mark.parametrize("method", [scheme("lobatto", 4), scheme("gauss", 3), scheme("radau", 3)], ids=lambda s: s.name)
def test_savings_of_motion_limits(certified, method: Scheme, words, row, kind):
    """By degree/s² and degree/s, for schemes whose stages are nodes and for those whose are not."""
    design, known, _ = certified["SA"]
    t = Transcription(design.problem, method, uniform_mesh(design.problem, 12))
    solution = Solver(t, TIGHT).solve(known.guess(), design.data(0.01))
    by = limits_moved(row, kind, np.pi / 180)
    by_hand = slope(design, solution, lambda h: resolved(design, solution, by(h)), 0.05)
    assert saving(certificate_of(design, solution), words) == pytest.approx(by_hand, rel=2e-2)  # the active set moves a little


@pytest.mark.parametrize("method", [scheme("lobatto", 4), scheme("gauss", 3)], ids=lambda s: s.name)
def test_savings_of_torque_limits_and_floor(certified, method: Scheme):
    """PEA peaks at 6.5 Nm in joint 3 and dips to −0.28 m: held to 6 Nm and −0.15 m, both limits bind. By Nm and by mm."""
    _, known, _ = certified["PEA"]

    def held(torque: float, floor: float) -> CoDesign:
        return design_of("PEA", replace(TASK, torque=np.array([np.inf, torque]), around=Surroundings(floor)))

    design = held(6.0, -0.15)
    t = Transcription(design.problem, method, uniform_mesh(design.problem, 12))
    solution = Solver(t, TIGHT).solve(known.guess(), design.data(0.01))
    certificate = certificate_of(design, solution)
    near = dict[str, Any](rel=2e-2)  # the active set moves a little
    by_hand = slope(design, solution, lambda h: resolved(held(6.0 + h, -0.15), solution), 0.02)
    assert saving(certificate, "the limit of the load torque of joint3") == pytest.approx(by_hand, **near)
    by_hand = slope(design, solution, lambda h: resolved(held(6.0, -0.15 - h), solution), 2e-4) * 1e-3
    assert saving(certificate, "the floor") == pytest.approx(by_hand, **near)


@pytest.mark.parametrize("name", ["SA", "PEA", "BPEA"])
def test_sensitivity_to_payload(certified, name):
    design, solution, certificate = certified[name]

    def heavier(h: float) -> float:
        return resolved(replace(design, task=replace(TASK, payload=5.0 + h)), solution)

    assert certificate.sensitivity == pytest.approx(-slope(design, solution, heavier, 0.01), **CLOSE)


@pytest.mark.parametrize("name", ["SA", "PEA", "BPEA"])
def test_residuals_are_those_of_a_tight_solve(certified, name):
    _, solution, certificate = certified[name]
    assert max(certificate.primal, certificate.dual, certificate.complementarity) < 1e-7  # IPOPT relaxes bounds by 1e-8
    assert certificate.second_order in ("strict", "weak")
    assert certificate.curvature > -1e-4
    assert certificate.mesh.error == mesh_error(solution).largest
    savings = [b.saving for b in certificate.active]
    assert savings == sorted(savings, reverse=True)


def test_residuals_see_a_disturbed_solution(certified):
    _, solution, certificate = certified["PEA"]
    off = replace(solution, w=solution.w + 1e-3 * np.random.default_rng(0).normal(size=solution.w.size))
    wrong = Kkt(off)
    assert wrong.primal > 1e-4
    assert wrong.dual > 100 * certificate.dual


def test_a_certificate_is_plain_data(certified, tmp_path):
    for name, (_, _, certificate) in certified.items():
        write_json(tmp_path / f"{name}.json", data(certificate))
        assert json.loads((tmp_path / f"{name}.json").read_text())["second_order"] == certificate.second_order


def test_how_often_an_optimum_was_reached_is_said():
    design = design_of("SA")
    solution = solved(design, 8)
    optimum = Optimum(solution, refine(solution, Refinement(rounds=0))[1], 3)
    assert certify(design, optimum).reached == 3


def valley(potential: Callable, lower: float = -2.0, upper: float = 2.0, place: float = 1.0) -> Problem:
    """min over p of ∫ (V(p) + u² + c x²) dt with x' = u from 0 to 0 in 1 s: at a stationary p the motion is x = u = 0."""
    x, u, p, d = ca.SX.sym("x"), ca.SX.sym("u"), ca.SX.sym("p"), ca.SX.sym("d", 0)
    phase = Phase(
        name="motion",
        rates=ca.Function("rates", [x, u, p, d], [u, potential(p) + u**2 + place * x**2, ca.SX(0, 1)]),
        x=unbounded(("place",)),
        u=unbounded(("push",)),
        start=np.zeros(1),
        end=np.zeros(1),
        duration=(1.0, 1.0),
    )
    return Problem((phase,), ("p",), np.full(1, lower), np.full(1, upper), np.ones(1))


def placed(problem: Problem, p: float) -> Solution:
    """The point x = u = 0 at p with no multipliers, as if a solver had stopped there."""
    t = Transcription(problem, scheme("lobatto", 4), uniform_mesh(problem, 5))
    w = np.zeros(t.size)
    w[0], w[t.blocks[0].duration] = p, 1.0
    return Solution(t, w, np.zeros(t.row_bounds[0].size), np.zeros(t.size), 1.0, "placed", 0, 0.0)


def double_well(p):
    return (p**2 - 1) ** 2


def test_second_order_is_strict_on_a_convex_problem():
    """V = 0.005 p² has curvature 0.01, by far the smallest: u² + x² alone gives about 2."""
    kkt = Kkt(placed(valley(lambda p: 0.005 * p**2), 0.0))
    verdict, curvature, direction = kkt.second_order()
    assert (verdict, kkt.dominant(direction)) == ("strict", ("p",))
    assert curvature == pytest.approx(0.01, rel=2e-3)  # the inverse iteration stops at 1e-3
    assert max(kkt.primal, kkt.dual) < 1e-12


def test_second_order_where_a_state_costs_nothing():
    """∫u² alone: the Hessian is zero in x, and positive definite all the same on what x' = u leaves."""
    verdict, curvature, _ = Kkt(placed(valley(lambda p: 0.005 * p**2, place=0.0), 0.0)).second_order()
    assert verdict == "strict"
    assert curvature == pytest.approx(0.01, rel=2e-3)


def test_second_order_is_strict_at_the_bottom_of_a_well():
    verdict, curvature, direction = (kkt := Kkt(placed(valley(double_well), 1.0))).second_order()
    assert verdict == "strict"
    assert kkt.dual < 1e-12
    assert 1 < curvature < 8  # V'' = 8; the motion has less, about 2
    assert kkt.dominant(direction) == ("motion",)


def test_second_order_is_violated_at_a_saddle():
    """Between the wells V'' = −4: the first-order conditions hold exactly, and the verdict must not be fooled."""
    kkt = Kkt(placed(valley(double_well), 0.0))
    assert max(kkt.primal, kkt.dual, kkt.complementarity) < 1e-12
    verdict, curvature, direction = kkt.second_order()
    assert (verdict, kkt.dominant(direction)) == ("violated", ("p",))
    assert curvature == pytest.approx(-4, rel=2e-3)


def test_second_order_with_the_saddle_on_a_bound():
    """p ≥ 0 touched without a multiplier is "weak"; pressed on with one (V = p − p²) it is held, and "strict"."""
    assert Kkt(placed(valley(double_well, lower=0.0), 0.0)).second_order()[0] == "weak"
    problem = valley(lambda p: p - p**2, lower=0.0, upper=0.4)
    pressed = placed(problem, 0.0)
    multipliers = np.zeros(pressed.w.size)
    multipliers[0] = -1.0
    kkt = Kkt(replace(pressed, lam_w=multipliers))
    assert kkt.dual < 1e-12
    assert kkt.second_order()[0] == "strict"


def test_a_pivot_that_cancels_is_no_obstacle():
    """−1e-12 + 1e-12 = 0: without another shift the factors do not exist. Two rows that say the same do no harm either."""
    H, none = csc_array([[-1e-12, 0.0], [0.0, 2.0]]), csc_array((0, 2))
    assert _factor(H, none, np.zeros(2))[1] == 0
    twice = csc_array([[1.0, 1.0], [1.0, 1.0]])
    assert _factor(csc_array(np.diag([-1.0, 2.0])), twice, np.zeros(2))[1] == 2  # xᵀHx = 1 along (1, −1)
    assert _factor(csc_array(np.diag([-3.0, 2.0])), twice, np.zeros(2))[1] == 3  # and −1: one more than rows


def test_curvature_against_dense_eigenvalues(certified):
    """SA's reduced Hessian by a dense null space and scipy's generalised eigenvalues."""
    from scipy.linalg import eigh, null_space

    _, solution, certificate = certified["SA"]
    kkt = Kkt(solution)
    free, rows = np.flatnonzero(~kkt.at_bound), np.flatnonzero(kkt.active_rows)
    hessian = kkt.hessian.toarray()[np.ix_(free, free)]
    basis = null_space(kkt.jacobian.toarray()[np.ix_(rows, free)])
    smallest = eigh(basis.T @ hessian @ basis, basis.T @ (kkt.weights[free, None] * basis), eigvals_only=True)[0]
    assert certificate.curvature == pytest.approx(
        smallest, rel=2e-2, abs=1e-6
    )  # bisected to 0.3, then iterated to 1e-3; δ = 1e-9


def test_exact_cost_is_that_of_exact_springs_on_the_same_motion():
    """Trapezoid of numeric pinocchio with springs by hand; smoothed over 0.1 rad they are 1e-3 of E1 apart."""
    design = design_of("PEA")
    solution = solved(design, 12, width=0.1)
    exact = exact_cost(design, solution)
    assert exact == pytest.approx(trapezoid(design, solution), rel=1e-5)  # 1200 points a phase; 9 Gauss points over the kink
    smooth = solved(design, 12, width=0.1)
    certificate = certificate_of(design, smooth)
    assert certificate.exact_cost == pytest.approx(exact, rel=1e-6)
    assert certificate.smoothing == pytest.approx(abs(exact - solution.cost) / solution.cost, rel=1e-3)


def oscillator() -> tuple[Problem, Guess]:
    """Rayleigh's, from (−5, −5), free at its end after 2.5."""
    x, u, p, d = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("p", 0), ca.SX.sym("d", 0)
    rates = ca.vertcat(x[1], -x[0] + x[1] * (1.4 - 0.14 * x[1] ** 2) + 4 * u)
    phase = Phase(
        name="motion",
        rates=ca.Function("rates", [x, u, p, d], [rates, ca.sumsqr(x[0]) + u**2, ca.SX(0, 1)]),
        x=unbounded(("place", "speed")),
        u=unbounded(("push",)),
        start=np.full(2, -5.0),
        end=np.full(2, np.nan),
        duration=(2.5, 2.5),
    )
    still = PhaseGuess(2.5, lambda s: -5 + 0 * np.vstack([s, s]), lambda s: np.zeros((1, len(s))))
    return Problem((phase,)), Guess((still,), np.zeros(0))


@pytest.mark.parametrize("method", [scheme("lobatto", 4), scheme("gauss", 3)], ids=lambda s: s.name)
def test_reintegration_tells_a_coarse_mesh_from_a_fine_one(method):
    """Order 6 at the nodes: from 3 to 48 intervals the ends' error falls by far more than a thousand."""
    coarse, fine = (reintegrate(solve(*oscillator(), n, method)) for n in (3, 48))
    assert coarse["state"] > 1e-2
    assert coarse["cost"] > 1e-3
    assert fine["state"] < 1e-6
    assert fine["cost"] < 1e-6


def test_reintegration_of_an_arm(certified):
    """Accelerations are the controls: each interval's polynomial, integrated twice by numpy, is the motion."""
    from numpy.polynomial import Polynomial

    for design, solution, certificate in certified.values():
        total, widths = 0.0, solution.problem.data[1 : 1 + design.model.widths.size]
        for i, payload in enumerate(TASK.payloads):
            block, lengths = solution.transcription.blocks[i], solution.transcription.mesh[i] * solution.durations[i]
            state = solution.values[block.nodes[:, 0]]
            for k, h in enumerate(lengths):
                u = [Polynomial.fit(h * solution.transcription.scheme.c, solution.controls(i)[j, :, k], 3) for j in (0, 1)]
                dq = [p.integ(k=state[2 + j], lbnd=0) for j, p in enumerate(u)]
                q = [p.integ(k=state[j], lbnd=0) for j, p in enumerate(dq)]
                t = np.linspace(0, h, 400)
                values = (np.array([p(t) for p in row]) for row in (q, dq, u))
                tau = np.array(design.torques(*values, payload, solution.parameters, widths)[0])
                total += np.trapezoid((tau**2).sum(axis=0), t)
                state = np.array([p(h) for p in (*q, *dq)])
            np.testing.assert_allclose(state, solution.values[block.nodes[:, -1]], atol=1e-8)
        assert certificate.reintegration.state < 1e-8
        # 400 points an interval leave 1e-6
        assert certificate.reintegration.cost == pytest.approx(abs(total / solution.cost - 1), abs=1e-5)
