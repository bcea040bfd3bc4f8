"""Bounds of what springs can reach, on a motion and on any: against random springs and motions, closed forms, a relaxation on a grid."""

from dataclasses import replace
from typing import Any

import designs
import msgspec
import numpy as np
import pytest
from scipy.optimize import lsq_linear
from test_design_problem import TASK, design_of, sampled, solved, springs_by_hand, torque_by_hand

from rrr_oc.codesign.bounds import on_motion as bound
from rrr_oc.codesign.bounds import over_motions
from rrr_oc.codesign.bounds.on_motion import Needed, SpringBound, bound_on_motion, needed_by, solution_bound
from rrr_oc.codesign.bounds.over_motions import task_bound
from rrr_oc.codesign.certificate import exact_cost
from rrr_oc.codesign.design_file import data
from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.purchasable import Coverage
from rrr_oc.codesign.springs import SpringBounds, spring_bounds
from rrr_oc.codesign.task import load_task
from rrr_oc.effects import CATALOGUE
from rrr_oc.effects.elastic.biarticular_spring import hardware_exists, reduced
from rrr_oc.optimal_control.solver import Solution
from rrr_oc.report.design_words import bounds_in_words
from rrr_oc.robot.drives import load_actuators

KINDS = ("PEA", "BPEA", "PEA+BPEA")


@pytest.fixture(scope="module")
def optima() -> dict[str, tuple[CoDesign, Solution]]:
    return {name: (design := design_of(name), solved(design, 30)) for name in ("SA", *KINDS)}


def random_hardware(configuration: str, count: int) -> list[dict[str, float]]:
    """Springs in a designer's terms, uniformly within the task's bounds, a third of each size at its largest."""
    rng, draws = np.random.default_rng(0), []
    quantities = {
        "PEA": {"k_p2": (0, 13.7052), "k_p3": (0, 1.32), "q_eq2": np.radians([-10, 140]), "q_eq3": np.radians([-140, 140])},
        "BPEA": {
            "k_b": (0, 13.7052),
            "q_0": (-np.pi, np.pi),
            "r_1": (0.014, 0.039),
            "r_2": (0.019, 0.036),
            "r_3": (0.014, 0.039),
        },
    }
    bounds = {k: v for kind, own in quantities.items() if kind in configuration.split("+") for k, v in own.items()}
    for _ in range(count):
        draws.append({k: high if rng.random() < 1 / 3 else rng.uniform(low, high) for k, (low, high) in bounds.items()})
    return draws


@pytest.mark.parametrize("configuration", KINDS)
def test_no_random_springs_are_better(optima, configuration):
    """10⁴ springs by formulas of their own, on the motion of the optimum and on that of the stiff arm."""
    for motion in (configuration, "SA"):
        design, solution = optima[motion]
        needed, cost = needed_by(solution, design)
        found = bound_on_motion(design_of(configuration).springs, needed, cost)
        q = needed.q[[1, 2]]
        costs = [
            float(((needed.tau - springs_by_hand(hardware, q)) ** 2 @ needed.weights).sum())
            for hardware in random_hardware(configuration, 5000)
        ]
        assert 0 < found.lower <= min(costs)
        assert found.lower <= found.mixture <= found.lower * (1 + 1.1 * bound.TOLERANCE)
        assert found.lower <= cost * (1 + 1e-9)


@pytest.mark.parametrize("configuration", KINDS)
def test_the_optimum_of_a_design_nearly_reaches_it(optima, configuration):
    """Springs of an optimum are the best on its motion, locally; no mixture on these motions gains more than a per cent."""
    design, solution = optima[configuration]
    found = solution_bound(solution, design)
    assert found is not None
    assert found.cost == pytest.approx(exact_cost(design, solution), rel=1e-4)  # 3 against 9 points of quadrature
    assert 0 <= found.excess < 0.01
    assert found.excess == pytest.approx(found.cost / found.lower - 1)


def test_without_springs_it_is_the_cost_itself(optima):
    design, solution = optima["SA"]
    found = solution_bound(solution, design)
    assert found is not None
    assert found.lower == pytest.approx(exact_cost(design, solution), rel=1e-6)


def test_a_relaxation_on_a_grid_agrees(optima):
    """Least squares with bounds over 150 equilibria a joint, of which at most one stiffness can be used where k is not binding: for
    joint 3 alone the largest k is raised until it never binds."""
    design, solution = optima["PEA"]
    needed, _ = needed_by(solution, design)
    spring = design.springs[1]
    free = replace(spring, upper=np.array([1e3, spring.upper[1]]))
    found = bound_on_motion([free], needed, 1.0)
    scale, grid = np.sqrt(needed.weights), np.radians(np.linspace(-140, 140, 150))
    shapes = np.maximum(grid[:, None] - needed.q[2], 0) * scale
    rest = lsq_linear(shapes.T, needed.tau[1] * scale, (0, np.inf)).cost * 2
    on_grid = rest + float(needed.tau[0] ** 2 @ needed.weights)
    assert found.lower <= on_grid * (1 + 1e-9)
    assert on_grid == pytest.approx(found.lower, rel=3e-3)  # the grid's spacing of 2°, and the tolerance


def one_joint(tau: np.ndarray, q: np.ndarray) -> Needed:
    return Needed(q[None], tau[None], (0,), np.full(q.size, 1 / q.size), np.full(q.size, "go"))


def spring_of(stiffness: tuple[float, float], equilibrium: tuple[float, float]) -> SpringBounds:
    (kind,) = [k for k in CATALOGUE.values() if k.name == "parallel_spring"]
    low, high = zip(stiffness, equilibrium, strict=True)
    return SpringBounds(kind((0,)), np.array(low), np.array(high))


Q = np.linspace(0.0, 1.0, 400)


def test_one_spring_at_a_known_equilibrium():
    """min over k of |tau − k φ|² = |tau|² − ⟨tau, φ⟩² / |φ|², and where k ends below that, the parabola there."""
    tau, shape = 3.0 - 2.0 * Q**2, np.maximum(0.8 - Q, 0)
    best = float(tau @ shape / (shape @ shape))
    cases = {
        (0.0, 2 * best): best,
        (0.0, best / 2): best / 2,
        (1.5 * best, 2 * best): 1.5 * best,
        (best / 3, best / 3): best / 3,
    }
    for stiffness, k in cases.items():
        found = bound_on_motion([spring_of(stiffness, (0.8, 0.8))], one_joint(tau, Q), 1.0)
        exact = float(np.mean((tau - k * shape) ** 2))
        assert exact * (1 - bound.TOLERANCE) <= found.lower <= exact * (1 + 1e-9)
        assert found.mixture == pytest.approx(exact, rel=1e-6)


def test_a_spring_that_can_only_hurt():
    """It pushes upwards where −1 Nm are needed: none is best where none is allowed, else the softest with the lowest equilibrium."""
    for softest, exact in ((0.0, 1.0), (2.0, float(np.mean((1 + 2 * np.maximum(0.5 - Q, 0)) ** 2)))):
        found = bound_on_motion([spring_of((softest, 5.0), (0.5, 1.0))], one_joint(-np.ones_like(Q), Q), 2.0)
        assert exact * (1 - bound.TOLERANCE) <= found.lower <= exact * (1 + 1e-9)
        assert found.mixture == pytest.approx(exact, rel=1e-6)
        assert found.excess == pytest.approx(2.0 / found.lower - 1)


def test_one_atom_leaves_no_gap():
    """tau is what one spring gives, and a part that no spring can give: orthogonal to every ramp, as it is that of the other phase."""
    tau, there, back = 4.0 * np.maximum(0.7321 - Q, 0), 0.3, -0.3
    needed = Needed(
        np.r_[Q, Q][None],
        np.r_[tau + there, tau + back][None],
        (0,),
        np.full(2 * Q.size, 0.5 / Q.size),
        np.full(2 * Q.size, "go"),
    )
    found = bound_on_motion([spring_of((0.0, 10.0), (0.0, 1.0))], needed, 0.09)
    assert found.lower == pytest.approx(0.09, rel=1.1 * bound.TOLERANCE)
    assert found.lower <= 0.09 <= found.mixture * (1 + 1e-9)


def test_a_mixture_is_not_a_single_spring():
    """Half of two springs in one place gives all torque, so the bound is 0; the largest stiffness is that of both together."""
    tau = 3.0 * np.maximum(0.3 - Q, 0) + 3.0 * np.maximum(0.9 - Q, 0)
    assert bound_on_motion([spring_of((0.0, 6.0), (0.0, 1.0))], one_joint(tau, Q), 1.0).mixture < 1e-4 * np.mean(tau**2)
    softer = bound_on_motion([spring_of((0.0, 5.0), (0.0, 1.0))], one_joint(tau, Q), 1.0)
    assert softer.lower > 5e-4 * np.mean(tau**2)


def test_a_search_that_is_cut_short_is_still_a_bound(optima, monkeypatch):
    design, solution = optima["BPEA"]
    whole = solution_bound(solution, design)
    monkeypatch.setattr(bound, "BOXES", 50)
    short = solution_bound(solution, design)
    assert whole is not None
    assert short is not None
    assert short.boxes < whole.boxes
    assert 0 <= short.lower < whole.lower


def test_the_greatest_amplitude_is_that_of_the_hardware():
    """Random hardware lies below it, in boxes and at points; a spring of that amplitude exists, a stiffer one does not."""
    (spring,) = design_of("BPEA").springs
    bounds, form, rng = spring.hardware, spring.form, np.random.default_rng(0)
    hardware = np.array([rng.uniform(*bounds[q.symbol], 500) for q in form.quantities])
    theta = np.array(reduced(*hardware))
    half = rng.uniform(0, 0.2, theta.shape) * [[0], [1], [1]]
    assert np.all(theta[0] <= form.strongest(theta - half, theta + half, bounds) * (1 + 1e-12))
    strongest = form.strongest(theta, theta, bounds)

    def excess(kappa: float, rho: float, phi: float) -> float:
        return float(np.array(hardware_exists(kappa, rho, phi, bounds)).max())

    for kappa, (_, rho, phi) in zip(strongest, theta.T, strict=True):
        assert excess(kappa, rho, phi) == pytest.approx(0.0, abs=1e-9)
        assert excess(1.001 * kappa, rho, phi) > 1e-4
    box = np.array([rng.uniform(a, b, 2000) for a, b in zip(spring.lower, spring.upper, strict=True)])
    possible = np.array([excess(0.0, *other) <= 0 for other in box[1:].T])
    assert 100 < possible.sum() < 1900
    np.testing.assert_array_equal(form.strongest(box, box, bounds) >= 0, possible)


def test_what_is_not_known_is_not_said(optima, monkeypatch):
    design, solution = optima["PEA"]
    moved = CoDesign(TASK, design.springs, "motor", load_actuators(TASK.joints))
    assert solution_bound(solution, moved) is None
    kind = type(design.springs[0].effect)
    monkeypatch.setattr(kind, "torque", lambda self, signals, theta, width: (np.exp(theta["equilibrium"] - signals.q[1]),))
    assert solution_bound(solution, design) is None


def test_springs_that_are_offered_beside_those_held(optima):
    """A design whose stiffnesses are held is compared with all springs of the task, or with its own at other equilibria."""
    design, solution = optima["PEA"]
    values = design.hardware(solution.parameters)
    held = design.with_fixed({**values, "k_p2": 9.0}, ("q_eq2", "q_eq3"))
    own, offered = solution_bound(solution, held), solution_bound(solution, held, design)
    assert own is not None
    assert offered is not None
    assert own.lower > 1.05 * offered.lower
    assert own.cost == offered.cost


def test_the_sentences(optima):
    """Numbers and shares as they are, and no more said than known."""
    design, solution = optima["PEA"]
    found = solution_bound(solution, design)
    assert found is not None

    def said(springs: dict, bound: SpringBound | None = None, least: float | None = None, **more: Any) -> list[str]:
        of_motion = designs.moved(50.0, msgspec.structs.replace(designs.GOOD, bound=bound, least=least))
        return bounds_in_words(designs.design(50.0, {"t": of_motion}, springs=springs, **more))

    known, some = found, {"k_p2": 1.0}
    (sentence,) = said(some, known)
    assert (
        f"no springs of these kinds, of any size within the task's bounds, reach an E1 below {found.lower:.4g} N²m²s"
        in sentence
    )
    assert f"this design is {100 * found.excess:.2g} % above" in sentence
    coverage = Coverage(8, 4, 3, 2, 2, 0, 0, 0.1, 0.0)
    searched = data(coverage) | {"gap": 0.1, "runners_up": []}
    assert "in the catalogue or not" in said(some, known, catalogue=searched)[0]
    assert "is not known" in said(some, SpringBound(0.0, 0.1, 1.0, None, 1))[0]
    assert said(some) == said({}) == said({}, None, 0.0) == []
    assert "no motion of the task and no springs of these kinds" in said(some, None, 12.5)[0]
    assert said({}, known, 12.5) == [
        "On this motion there are no springs to choose.",
        "It is proved that no motion of the task reaches an E1 below 12.5 N²m²s, 25 % of this design's.",
    ]


# --- over all motions ---


def test_the_torque_near_a_posture_is_enclosed():
    """Random motions from rest with bounded accelerations, by numeric pinocchio; the ends of the intervals are nearly reached early."""
    design, rng = design_of("SA"), np.random.default_rng(0)
    t, a = np.array([0.02, 0.1, 0.3]), TASK.acceleration
    for posture, payload in ((TASK.release, 5.0), (TASK.start, 0.0)):
        low, high = over_motions._needed_near(design, posture, payload, t)
        for i, time in enumerate(t):
            sides = rng.choice([-1.0, 1.0], (3, 2, 300)) * rng.random((3, 2, 300)) ** rng.choice([0, 1], 300)
            dq, ddq = (a * np.minimum(time, TASK.speed / a))[:, None] * sides[1], a[:, None] * sides[2]
            q = np.clip(posture[:, None] + (a * time**2 / 2)[:, None] * sides[0], TASK.lower[:, None], TASK.upper[:, None])
            tau = torque_by_hand({}, q, dq, ddq, payload)
            assert np.all(low[:, i, None] <= tau)
            assert np.all(tau <= high[:, i, None])
            if i == 0:
                np.testing.assert_allclose([tau.min(axis=1), tau.max(axis=1)], [low[:, 0], high[:, 0]], rtol=0.02)


@pytest.mark.parametrize("configuration", ["PEA", "BPEA"])
def test_the_stiffness_bounds_that_of_random_springs(configuration):
    """Differences of the springs' torques, written out, at random angles; the stiffest come near the bound."""
    springs, rng, step = design_of(configuration).springs, np.random.default_rng(0), 1e-6
    bound = sum(over_motions._stiffness(TASK, spring) for spring in springs)
    found = np.zeros((2, 2))
    for hardware in random_hardware(configuration, 4000):
        q = rng.uniform(TASK.lower, TASK.upper)[:, None]
        for k in range(2):
            moved = q + step * np.eye(2)[:, [k]]
            found[:, k] = np.maximum(
                found[:, k], np.abs(springs_by_hand(hardware, moved) - springs_by_hand(hardware, q))[:, 0] / step
            )
    assert np.all(found <= bound + 1e-6)
    assert np.all(found >= 0.8 * bound)


def test_every_design_is_above_the_bound_over_motions(optima):
    """In the windows that the bound counts, by torques on the dense motion; and what is proved of the paper's task."""
    known = {"SA": 205.0, "PEA": 20.0, "BPEA": 7.7, "PEA+BPEA": 7.5}  # less than any finer division finds
    for name, (design, solution) in optima.items():
        least, hardware, window, cost = task_bound(design), design.hardware(solution.parameters), TASK.duration[0] / 2, 0.0
        for phase, payload in enumerate(TASK.payloads):
            t, q, dq, ddq = sampled(solution, phase)
            for part in (t <= window, t >= t[-1] - window):
                tau = torque_by_hand(hardware, q[:, part], dq[:, part], ddq[:, part], payload)
                cost += float(np.trapezoid((tau**2).sum(axis=0), t[part]))
        assert least is not None
        assert known[name] < least < cost


def test_with_more_steps_more_is_proved(monkeypatch):
    values = []
    for steps, pieces in ((20, 1), (40, 1), (40, 20)):
        monkeypatch.setattr(over_motions, "STEPS", steps)
        monkeypatch.setattr(over_motions, "PIECES", pieces)
        values.append(task_bound(design_of("PEA")))
    assert values[0] < values[1] < values[2]


def test_nothing_is_proved_of_motions_that_may_jump():
    prototype = load_task("prototype")  # without limits of acceleration
    assert task_bound(CoDesign(prototype, spring_bounds(prototype, "PEA"))) is None
    assert task_bound(replace(design_of("PEA"), task=replace(TASK, speeds=("rest", "moving")))) is None
    assert task_bound(replace(design_of("PEA"), cost="motor", actuators=load_actuators(TASK.joints))) is None
