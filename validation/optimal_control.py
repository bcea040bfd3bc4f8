"""Does the collocation find optima that are known from outside, and does it converge at the order it should?

Every problem here has a solution by other means: in closed form, or from an indirect method. Each is solved with every scheme
on meshes of doubling fineness; the errors of cost, states and parameters against the known solution, and the orders measured
from them, go to a table (Markdown), a figure (PNG) and `optimal_control.json`.

    python validation/optimal_control.py [--out results/validation] [--figure-only]

Sources: Bryson & Ho, "Applied Optimal Control" (1975), secs. 2.7 (brachistochrone), 3.9 (minimum time), 3.11 example 2
(double integrator with a bound on the position, "Bryson–Denham"); Jacobson & Mayne, "Differential Dynamic Programming" (1970)
and Maurer & Augustin in "Online Optimization of Large Scale Systems" (2001), 17–55 (Rayleigh).
The sources are cited from memory; no number is taken from them, every reference is derived or computed below.
"""

import argparse
import json
import platform
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from pathlib import Path

import casadi as ca
import numpy as np
from scipy.integrate import solve_bvp, solve_ivp
from scipy.optimize import brentq, root
from scipy.special import j0, j1

from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.search.proposals import motion_guess
from rrr_oc.codesign.springs import spring_bounds
from rrr_oc.codesign.task import load_task
from rrr_oc.effects.elastic.parallel_spring import ParallelSpring
from rrr_oc.model.symbolic_model import Model
from rrr_oc.optimal_control.problem import Bounded, Guess, Phase, PhaseGuess, Problem
from rrr_oc.optimal_control.refinement import Refinement, mesh_error, refine
from rrr_oc.optimal_control.scheme import Scheme, scheme, uniform_mesh
from rrr_oc.optimal_control.solver import Options, Solution, Solver, solve
from rrr_oc.optimal_control.transcription import Transcription
from rrr_oc.report.figures import save_figure
from rrr_oc.robot.robot import load_robot
from rrr_oc.storage import write_json, write_text

SCHEMES = {
    "Hermite–Simpson": scheme("hermite-simpson"),
    "Lobatto 4": scheme("lobatto", 4),
    "Gauss 2": scheme("gauss", 2),
    "Gauss 3": scheme("gauss", 3),
    "Radau 2": scheme("radau", 2),
    "Radau 3": scheme("radau", 3),
}
MESHES = (4, 8, 16, 32, 64)
GRAVITY = 9.81  # m/s²
OPTIONS = Options(tolerance=1e-12)
# What the solver leaves: IPOPT widens every inequality bound by 1e-8 relative (`bound_relax_factor`), and where there is
# none it stops at a scaled 1e-12 of the optimality conditions, which leaves some 1e-11 of rounding in states and cost.
FLOOR, BOUNDED_FLOOR = 3e-11, 1e-7


@dataclass(frozen=True, eq=False)
class Case:
    """A problem with its known solution.

    Attributes:
        name, title: Key in the json, and words in table and figure.
        problem, guess: What is solved, and from where.
        cost: Known optimal cost.
        states: Known states: normalised time (K,) -> (nx, K) of the first phase; None where only the cost is known.
        parameters: Known optimal parameters.
        meshes: Intervals a phase.
        floor, state_floor: Relative errors below which nothing is measured but solver and rounding.
        remark: What the table says about it.
    """

    name: str
    title: str
    problem: Problem
    guess: Guess
    cost: float
    states: Callable[[np.ndarray], np.ndarray] | None = None
    parameters: np.ndarray = field(default_factory=lambda: np.zeros(0))
    meshes: Sequence[int] = MESHES
    floor: float = FLOOR
    state_floor: float = FLOOR
    remark: str = ""


def _phase(rates: ca.Function, start: Sequence[float], end: Sequence[float], duration: tuple[float, float], **bounds) -> Phase:
    """A phase without bounds but those given, scales 1."""
    nx, nu = rates.size1_in(0), rates.size1_in(1)
    parts = {}
    for kind, names in (
        ("x", [f"x{i}" for i in range(nx)]),
        ("u", [f"u{i}" for i in range(nu)]),
        ("path", bounds.pop("paths", ())),
    ):
        far = np.full(len(names), np.inf)
        own = {key.removeprefix(f"{kind}_"): bounds[key] for key in bounds if key.startswith(f"{kind}_")}
        parts[kind] = replace(Bounded(tuple(names), -far, far, np.ones(len(names))), **own)
    return Phase("motion", rates, start=np.array(start, float), end=np.array(end, float), duration=duration, **parts)


def _rates(nx: int, law: Callable, parameters: int = 0) -> ca.Function:
    """The `Phase.rates` of law(x, u, p) -> (dx, cost rate, path) with one control and no data."""
    x, u, p = ca.SX.sym("x", nx), ca.SX.sym("u"), ca.SX.sym("p", parameters)
    dx, cost, path = law(x, u, p)
    return ca.Function("rates", [x, u, p, ca.SX.sym("d", 0)], [ca.vertcat(*dx), cost, ca.vertcat(*path)])


def _straight(phase: Phase, duration: float, control: float = 0.0) -> Guess:
    """A straight line from start to end (to the start where the end is free), one constant control."""
    start, end = phase.start, np.where(np.isnan(phase.end), phase.start, phase.end)
    return Guess(
        (
            PhaseGuess(
                duration,
                lambda s: start[:, None] + (end - start)[:, None] * s,
                lambda s: np.full((len(phase.u), len(s)), control),
            ),
        ),
        np.zeros(0),
    )


def double_integrator() -> Case:
    """x'' = u from rest to rest over d = 1 in T = 1, min ∫u² dt: x = 3 s² − 2 s³, u = 6 − 12 s, cost 12 d²/T³."""
    phase = _phase(_rates(2, lambda x, u, p: ((x[1], u), u**2, ())), [0, 0], [1, 0], (1, 1))
    return Case(
        "double_integrator",
        "Double integrator, min ∫u²",
        Problem((phase,)),
        _straight(phase, 1.0),
        cost=12.0,
        states=lambda s: np.array([3 * s**2 - 2 * s**3, 6 * s - 6 * s**2]),
        remark="polynomials of degree 3 and 1: every scheme here is exact",
    )


def linear_quadratic() -> Case:
    """x' = −x + u, x(0) = 1, min ∫(x² + u²) dt over T = 4, end free.

    With r = √2 and τ = T − t the Riccati equation −P' = 1 − 2 P − P², P(T) = 0 has P = sinh(r τ)/E(τ),
    E(τ) = r cosh(r τ) + sinh(r τ); then x = E(T − t)/E(T), u = −P x and the cost is P(0).
    """
    T, r = 4.0, np.sqrt(2)
    phase = _phase(_rates(1, lambda x, u, p: ((-x + u,), x**2 + u**2, ())), [1], [np.nan], (T, T))

    def envelope(tau):
        return r * np.cosh(r * tau) + np.sinh(r * tau)

    return Case(
        "linear_quadratic",
        "Linear quadratic regulator",
        Problem((phase,)),
        _straight(phase, T),
        cost=np.sinh(r * T) / envelope(T),
        states=lambda s: (envelope(T * (1 - s)) / envelope(T))[None],
        remark="hyperbolic functions; free end",
    )


def rayleigh() -> Case:
    """x1' = x2, x2' = −x1 + x2 (1.4 − 0.14 x2²) + 4 u from (−5, −5), free end at 2.5, min ∫(u² + x1²) dt.

    Known by the indirect method, solved here: u = −2 λ2, λ1' = −2 x1 + λ2, λ2' = −λ1 − λ2 (1.4 − 0.42 x2²), the cost as a
    fifth equation; `scipy.integrate.solve_bvp` to 1e-6, then shooting on λ(0) with an explicit method of order 8 to 1e-13.
    The literature prints the cost as 29.376 (Maurer & Augustin); the number used is the computed one, 29.3760788.
    """
    T = 2.5

    def law(x, u, p):
        return (x[1], -x[0] + x[1] * (1.4 - 0.14 * x[1] ** 2) + 4 * u), u**2 + x[0] ** 2, ()

    def adjoint(t, y):
        x1, x2, l1, l2, _ = y
        u = -2 * l2
        slopes = x2, -x1 + x2 * (1.4 - 0.14 * x2**2) + 4 * u, -2 * x1 + l2, -l1 - l2 * (1.4 - 0.42 * x2**2), u**2 + x1**2
        return np.array(slopes)

    def shoot(multipliers):
        return solve_ivp(adjoint, (0, T), [-5, -5, *multipliers, 0], "DOP853", rtol=1e-13, atol=1e-13, dense_output=True)

    phase = _phase(_rates(2, law), [-5, -5], [np.nan, np.nan], (T, T))
    problem, guess = Problem((phase,), cost_scale=10.0), _straight(phase, T)
    coarse = solve(problem, guess, 20)  # only a start: its states, and multipliers from u = −2 λ2 and λ1 = −λ2' − λ2 (…)
    s = np.linspace(0, 1, 201)
    x, u = coarse.at(0, s)
    l2 = -u[0] / 2
    l1 = -np.gradient(l2, T * s) - l2 * (1.4 - 0.42 * x[1] ** 2)
    start = np.vstack([x, l1, l2, np.cumsum(u[0] ** 2 + x[0] ** 2) * T / len(s)])
    first = solve_bvp(adjoint, lambda a, b: np.r_[a[:2] + 5, a[4], b[2:4]], T * s, start, tol=1e-6)
    found = root(lambda multipliers: shoot(multipliers).y[2:4, -1], first.y[2:4, 0], tol=1e-13)
    shot = shoot(found.x)
    if np.abs(shot.y[2:4, -1]).max() > 1e-10:
        raise RuntimeError(f"the indirect reference failed: {first.message}; {found.message}")
    return Case(
        "rayleigh",
        "Rayleigh oscillator",
        problem,
        guess,
        cost=float(shot.y[4, -1]),
        states=lambda s: shot.sol(T * s)[:2],
        meshes=(16, 32, 64, 128, 256),
        floor=1e-10,  # the indirect reference misses the end by less
        state_floor=1e-10,
        remark="nonlinear; free end; indirect reference",
    )


def brachistochrone() -> Case:
    """x' = v sin θ, y' = v cos θ, v' = g cos θ from rest at the origin to (1, 1) m in the least time.

    The cycloid x = R (φ − sin φ), y = R (1 − cos φ), v = 2 √(g R) sin(φ/2), θ = φ/2, φ = t √(g/R), whose end φ_1 solves
    φ − sin φ = 1 − cos φ (Johann Bernoulli, 1697; Bryson & Ho, sec. 2.7).
    """
    last = float(brentq(lambda a: a - np.sin(a) - (1 - np.cos(a)), 1.0, 6.0, xtol=1e-15))  # type: ignore[arg-type]
    R = 1 / (1 - np.cos(last))
    T = last * np.sqrt(R / GRAVITY)

    def law(x, u, p):
        return (x[2] * ca.sin(u), x[2] * ca.cos(u), GRAVITY * ca.cos(u)), 1, ()

    def states(s):
        a = last * s
        return np.array([R * (a - np.sin(a)), R * (1 - np.cos(a)), 2 * np.sqrt(GRAVITY * R) * np.sin(a / 2)])

    once = {"u_lower": np.array([-0.5]), "u_upper": np.array([np.pi])}  # without them a stage may be off by 2 π
    phase = _phase(_rates(3, law), [0, 0, 0], [1, 1, np.nan], (0.1, 5.0), **once)
    return Case(
        "brachistochrone", "Brachistochrone", Problem((phase,)), _straight(phase, 0.8, 0.8), T, states, remark="free final time"
    )


def bryson_denham(meshes: Sequence[int], name: str, remark: str) -> Case:
    """x'' = u, x(0) = x(1) = 0, x'(0) = 1 = −x'(1), x ≤ l = 1/9, min ½∫u² dt = 4/(9 l) for l ≤ 1/6 (Bryson & Ho, sec. 3.11).

    The position meets its bound at t = 3 l = 1/3 and leaves it at 2/3; before that, x = l (1 − (1 − t/(3 l))³).
    """
    bound = 1 / 9

    def states(s):
        folded = np.minimum(np.minimum(s, 1 - s) / (3 * bound), 1)
        return np.array([bound * (1 - (1 - folded) ** 3), np.sign(0.5 - s) * (1 - folded) ** 2])

    phase = _phase(
        _rates(2, lambda x, u, p: ((x[1], u), u**2 / 2, ())), [0, 1], [0, -1], (1, 1), x_upper=np.array([bound, np.inf])
    )
    problem = Problem((phase,), cost_scale=4.0)
    return Case(
        name,
        "Bryson–Denham" + (", junctions at nodes" if name.endswith("nodes") else ""),
        problem,
        _straight(phase, 1.0),
        4 / (9 * bound),
        states,
        meshes=meshes,
        floor=BOUNDED_FLOOR,
        state_floor=5e-6,  # near the junctions the bound is active so weakly that an interior-point method keeps off by this
        remark=remark,
    )


def minimum_time(meshes: Sequence[int], name: str, remark: str) -> Case:
    """x'' = u, |u| ≤ 1, from rest to rest over d = 1 in the least time: u = +1, then −1, T = 2 √d (Bryson & Ho, sec. 3.9)."""
    phase = _phase(
        _rates(2, lambda x, u, p: ((x[1], u), 1, ())), [0, 0], [1, 0], (0.5, 10.0), u_lower=-np.ones(1), u_upper=np.ones(1)
    )

    def states(s):
        t = 2 * np.minimum(s, 1 - s)
        return np.array([np.where(s <= 0.5, t**2 / 2, 1 - t**2 / 2), t])

    return Case(
        name,
        "Minimum time" + (", switch at a node" if name.endswith("node") else ""),
        Problem((phase,)),
        _straight(phase, 3.0),
        2.0,
        states,
        meshes=meshes,
        floor=BOUNDED_FLOOR,
        state_floor=BOUNDED_FLOOR,
        remark=remark,
    )


URDF = """<?xml version="1.0"?>
<robot name="{name}">
  <link name="base"/>
  <joint name="joint1" type="revolute">
    <parent link="base"/><child link="link1"/><axis xyz="0 -1 0"/><limit lower="-3" upper="3" effort="100" velocity="100"/>
  </joint>
  <link name="link1">
    <inertial><origin xyz="{centre} 0 0"/><mass value="{mass}"/>
      <inertia ixx="0.01" iyy="{inertia}" izz="{inertia}" ixy="0" ixz="0" iyz="0"/></inertial>
  </link>
  <joint name="tool" type="fixed"><parent link="link1"/><child link="tip"/><origin xyz="{length} 0 0"/></joint>
  <link name="tip"/>
</robot>
"""
ARM = {"mass": 2.0, "centre": 0.25, "inertia": 0.02, "length": 0.5}  # kg, m, kg m² about the centre of mass, m
INERTIA = ARM["inertia"] + ARM["mass"] * ARM["centre"] ** 2  # about the joint [kg m²]
MOMENT = ARM["mass"] * GRAVITY * ARM["centre"]  # [Nm]


def spring_for_a_motion() -> Case:
    """A parallel spring for an arm that swings as q = m + A sin θ, θ = ω t, from θ = −π/2 to π/2 in gravity; min ∫τ² dt.

    τ = I q'' + M cos q − k (q_eq − q) with the spring taut throughout is a least-squares fit of I q'' + M cos q by
    (1, q): with averages over the half swing (those of a whole turn by symmetry; J_n Bessel functions)

        ⟨q̃²⟩ = A²/2, ⟨q'' q̃⟩ = −A² ω²/2, ⟨cos q⟩ = cos m J_0(A), ⟨cos q · q̃⟩ = −A sin m J_1(A)
        k = I ω² + 2 M sin m J_1(A)/A,  q_eq = m + M cos m J_0(A)/k
        cost = T (I² A² ω⁴/2 + M² (1 + cos 2m J_0(2A))/2 + 2 M I ω² A sin m J_1(A) − (k (q_eq − m))² − k² A²/2).

    Collocated: states q, dq, θ; the control is q'', tied to −A ω² sin θ by a path constraint, so that only the spring is
    free. Torques come from the URDF through `Model` and `ParallelSpring`.
    """
    middle, A, omega = np.radians(30), 0.5, 2.0
    k = INERTIA * omega**2 + 2 * MOMENT * np.sin(middle) * j1(A) / A
    q_eq = middle + MOMENT * np.cos(middle) * j0(A) / k
    T = np.pi / omega
    square = INERTIA**2 * A**2 * omega**4 / 2 + MOMENT**2 * (1 + np.cos(2 * middle) * j0(2 * A)) / 2
    square += 2 * MOMENT * INERTIA * omega**2 * A * np.sin(middle) * j1(A)
    cost = T * (square - (k * (q_eq - middle)) ** 2 - k**2 * A**2 / 2)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "pendulum.urdf"
        path.write_text(URDF.format(name="pendulum", **ARM))
        robot = load_robot(path, gravity=(0, 0, -GRAVITY))
    model = Model(robot, robot.tool, (ParallelSpring((0,)),))

    def law(x, u, p):
        tau = model.inverse(x[0], x[1], u, 0.0, p, model.widths)[0]
        return (x[1], u, omega), tau**2, (u + A * omega**2 * ca.sin(x[2]),)

    tied = {"paths": ("swing",), "path_lower": np.zeros(1), "path_upper": np.zeros(1)}
    phase = _phase(_rates(3, law, 2), [middle - A, 0, -np.pi / 2], [np.nan] * 3, (T, T), **tied)
    bounds = np.array([0.0, -np.pi]), np.array([100.0, np.pi])
    problem = Problem((phase,), ("k", "q_eq"), *bounds, np.array([k, q_eq]).round())
    guess = Guess(_straight(phase, T).phases, np.array([1.0, 1.5]))

    def states(s):
        theta = np.pi * (s - 0.5)
        return np.array([middle + A * np.sin(theta), A * omega * np.cos(theta), theta])

    return Case(
        "spring_for_a_motion",
        "Spring for a given swing",
        problem,
        guess,
        cost,
        states,
        np.array([k, q_eq]),
        remark="URDF and `ParallelSpring`; k and q_eq too",
    )


def _steering_cost(inertia: float, stiffness: complex, a: float, T: float) -> complex:
    """Least ∫τ² dt that takes I q'' + k q = τ from rest at a to rest at −a in T: δᵀ W⁻¹ δ, W the reachability Gramian.

    With w = √(k/I), W = ∫ b(s) b(s)ᵀ ds for b(s) = (sin(w s)/w, cos(w s))/I, and δ = (−a − a cos(w T), a w sin(w T)).
    """
    w = np.sqrt(stiffness / inertia)
    sine, cosine = np.sin(2 * w * T), np.cos(2 * w * T)
    gramian = np.array(
        [[(T / 2 - sine / (4 * w)) / w**2, (1 - cosine) / (4 * w**2)], [(1 - cosine) / (4 * w**2), T / 2 + sine / (4 * w)]]
    )
    miss = np.array([-a - a * np.cos(w * T), a * w * np.sin(w * T)])
    return complex(miss @ np.linalg.solve(gramian / inertia**2, miss))


def oscillator_codesign() -> Case:
    """Two springs for an arm without gravity that goes from a to −a with a payload and returns without: the whole chain.

    URDF, task file, `CoDesign`, two phases. With one spring below and one above q = 0, equally stiff, the torque is
    I q'' + k q exactly, the smoothing widths cancelling; the cost of each phase is `_steering_cost` with I = I_arm + m l² and
    I_arm. Its smallest sum over k is the reference. Resonance, k = I (π/T)², would make one of the phases free, but not both.
    """
    a, T, payload = 0.6, 0.8, 1.0
    loaded = INERTIA + payload * ARM["length"] ** 2

    def total(k):
        return _steering_cost(loaded, k, a, T) + _steering_cost(INERTIA, k, a, T)

    best = brentq(lambda k: total(k + 1e-30j).imag, 1.0, 15.0, xtol=1e-14)  # its derivative, by a complex step, is zero there
    stiffness = {
        "stiffness_Nm_per_rad": [0.0, 20.0],
        "equilibrium_deg": [0.0, 0.0],
        "effect": "parallel_spring",
        "joint": "joint1",
    }
    content = {
        "format": "rrr_oc-task/1",
        "robot": "oscillator.urdf",
        "gravity": [0, 0, 0],
        "moving": ["joint1"],
        "start": {"angles_deg": [np.degrees(a)]},
        "release": {"angles_deg": [-np.degrees(a)]},
        "payload_kg": payload,
        "duration_s": [T, T],
        "limits": {"joint1": {"range_deg": [-90, 90], "speed_deg_per_s": 2000, "torque_Nm": "none"}},
        "springs": [stiffness | {"active": "below"}, stiffness | {"active": "above"}],
    }
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "oscillator.urdf").write_text(URDF.format(name="oscillator", **ARM))
        (Path(folder) / "task.json").write_text(json.dumps(content))
        task = load_task(Path(folder) / "task.json")
    design = CoDesign(task, spring_bounds(task, "PEA"))
    return Case(
        "oscillator_codesign",
        "Co-design of two springs",
        design.problem,
        motion_guess(design, np.array([2.0, 0.0, 3.0, 0.0]), (T, T)),
        total(best).real,
        parameters=np.array([best, 0, best, 0]),
        remark="URDF, task file, `CoDesign`, two phases, payload",
    )


def cases() -> list[Case]:
    """All problems."""
    return [
        double_integrator(),
        linear_quadratic(),
        rayleigh(),
        brachistochrone(),
        spring_for_a_motion(),
        oscillator_codesign(),
        bryson_denham((6, 12, 24, 48), "bryson_denham_at_nodes", "three stages or more are exact"),
        bryson_denham((8, 16, 32, 64), "bryson_denham", "inside intervals: low order, whatever the scheme"),
        minimum_time(
            (4, 8, 16, 32),
            "minimum_time_at_a_node",
            "exact where the control may jump, first order in the states where it may not",
        ),
        minimum_time((5, 11, 21, 41), "minimum_time", "mid-interval: low order, whatever the scheme"),
    ]


def measure(case: Case, method: Scheme, intervals: int) -> dict:
    """One solve, with its errors relative to the known solution."""
    solver = Solver(Transcription(case.problem, method, uniform_mesh(case.problem, intervals)), OPTIONS)
    solution = solver.solve(case.guess, check=False)
    return {"intervals": intervals, **_errors(case, solution), "status": solution.status, "iterations": solution.iterations}


def _errors(case: Case, solution: Solution) -> dict:
    found: dict[str, float | None] = {"cost": solution.cost, "cost_error": float(abs(solution.cost / case.cost - 1))}
    found["state_error"] = found["parameter_error"] = None
    if case.states is not None:
        known = case.states(np.r_[0, np.cumsum(solution.transcription.mesh[0])])
        size = np.abs(known).max(axis=1)
        nodes = solution.values[solution.transcription.blocks[0].nodes]
        found["state_error"] = float((np.abs(nodes - known) / size[:, None]).max())
    if case.parameters.size:
        error = np.abs(solution.parameters - case.parameters)
        found["parameter_error"] = float((error / np.maximum(np.abs(case.parameters), 1)).max())
    return found


def order(intervals: Sequence[int], errors: Sequence[float], floor: float) -> float | None:
    """Least-squares slope of −log error over log intervals, above the floor, less the coarsest mesh where 3 others remain."""
    above = [(n, e) for n, e in zip(intervals, errors, strict=True) if e > floor]
    above = above[1:] if len(above) > 3 else above
    if len(above) < 2:
        return None
    n, e = np.log(np.array(above)).T
    return float(-np.polyfit(n, e, 1)[0])


def study(chosen: Sequence[Case]) -> dict:
    """Every case with every scheme on every mesh."""
    results = {}
    for case in chosen:
        schemes = {}
        for name, method in SCHEMES.items():
            rows = [measure(case, method, n) for n in case.meshes]
            floors = {"cost_error": case.floor, "state_error": case.state_floor, "parameter_error": case.floor}
            columns = {key: [r[key] for r in rows] for key in ("cost_error", "state_error", "parameter_error")}
            orders = {
                key.removesuffix("error") + "order": None if None in errors else order(case.meshes, errors, floors[key])
                for key, errors in columns.items()
            }
            schemes[name] = {"rows": rows, "expected_order": method.order, **orders}
        results[case.name] = {
            "title": case.title,
            "remark": case.remark,
            "known_cost": case.cost,
            "known_parameters": case.parameters.tolist(),
            "floor": case.floor,
            "state_floor": case.state_floor,
            "schemes": schemes,
        }
    return results


def refined(case: Case, tolerance: float) -> dict:
    """What refinement makes of a case that uniform meshes converge slowly on."""
    began = time.perf_counter()
    first = solve(case.problem, case.guess, 8, options=OPTIONS)
    last, rows = refine(first, Refinement(tolerance=tolerance), OPTIONS)
    return {
        "title": case.title,
        "tolerance": tolerance,
        "rows": rows,
        "error_estimate": mesh_error(last).largest,
        **_errors(case, last),
        "seconds": time.perf_counter() - began,
    }


def table(results: dict) -> str:
    """The findings as Markdown: for each problem and scheme the error on the finest mesh and the orders."""
    lines = [
        "# Optimal control against known solutions",
        "",
        "Relative error on the finest mesh, and orders of convergence measured by least squares over the meshes whose error",
        "lies above the floor (the solver's tolerance or the reference's). “exact”: below the floor on every mesh; “—”: fewer",
        "than two meshes above it. In brackets: the order of the Runge–Kutta method. Lobatto 4 reaches it in the cost, whose",
        "error is quadratic in the motion's, and in motions whose control is given; optimal motions converge at order 4, since",
        "neighbours share the control at a node, where the method's multipliers jump.",
        "",
        "| problem | intervals | scheme | cost error | order of cost | state error | order of states | parameters | order |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for result in results["cases"].values():
        for i, (name, found) in enumerate(result["schemes"].items()):
            rows = found["rows"]
            label = f"{result['title']}; {result['remark']}" if i == 0 else ""
            meshes = f"{rows[0]['intervals']} … {rows[-1]['intervals']}" if i == 0 else ""
            cells = [label, meshes, f"{name} ({found['expected_order']})"]
            for key in ("cost", "state", "parameter"):
                errors = [r[f"{key}_error"] for r in rows]
                cells += [
                    _error(errors[-1]),
                    _order(errors, found[f"{key}_order"], result["state_floor" if key == "state" else "floor"]),
                ]
            lines.append("| " + " | ".join(cells) + " |")
    lines += [
        "",
        "## Mesh refinement from 8 uniform intervals, Gauss 3",
        "",
        "| problem | tolerance | meshes | intervals | estimated error | cost error | state error |",
        "|---|---|---|---|---|---|---|",
    ]
    for r in results["refined"].values():
        cells = [r["title"], f"{r['tolerance']:.0e}", str(len(r["rows"])), str(r["rows"][-1]["intervals"][0])]
        cells += [_error(r["error_estimate"]), _error(r["cost_error"]), _error(r["state_error"])]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def _error(error: float | None) -> str:
    return "" if error is None else f"{error:.1e}"


def _order(errors: Sequence[float | None], measured: float | None, floor: float) -> str:
    if errors[0] is None:
        return ""
    if all(e is not None and e <= floor for e in errors):
        return "exact"
    return "—" if measured is None else f"{measured:.2f}"


def figure(results: dict, path: Path) -> None:
    """Error of cost and of states over the intervals, log–log, from the saved results."""
    import matplotlib.pyplot as plt
    from matplotlib.ticker import NullLocator

    chosen = list(results["cases"].values())
    columns = -(-len(chosen) // 2)
    fig, panels = plt.subplots(4, columns, figsize=(3.0 * columns, 11), sharey=True, layout="constrained")
    for i, result in enumerate(chosen):
        moving = any(r["state_error"] is not None for r in next(iter(result["schemes"].values()))["rows"])
        for row, kind in enumerate(("cost", "state" if moving else "parameter")):
            panel, key = panels[2 * (i // columns) + row, i % columns], f"{kind}_error"
            for marker, (name, found) in zip("so^v<>", result["schemes"].items(), strict=True):
                rows = [r for r in found["rows"] if r[key] is not None]
                errors = [max(r[key], 1e-16) for r in rows]
                panel.loglog([r["intervals"] for r in rows], errors, marker=marker, ms=4, lw=1, label=name)
            meshes = [r["intervals"] for r in next(iter(result["schemes"].values()))["rows"]]
            panel.set_xticks(meshes, [str(m) for m in meshes])
            panel.xaxis.set_minor_locator(NullLocator())
            panel.axhline(result["state_floor" if kind == "state" else "floor"], color="0.7", lw=0.8, ls=":")
            panel.grid(alpha=0.3)
            panel.set_title(f"{result['title']}: {kind}{'s' * (kind != 'cost')}", fontsize=8)
    for row, panel in enumerate(panels[:, 0]):
        panel.set_ylabel(f"relative error of {('the cost', 'states or parameters')[row % 2]}")
    fig.supxlabel("intervals a phase")
    panels[0, 0].legend(fontsize=7)
    save_figure(fig, path)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description="Collocation against optimal-control problems with known solutions.")
    parser.add_argument("--out", type=Path, default=Path("results/validation"), help="folder of the results")
    parser.add_argument("--figure-only", action="store_true", help="draw the figure and table again from the saved json")
    arguments = parser.parse_args()
    saved = arguments.out / "optimal_control.json"
    if not arguments.figure_only:
        began, chosen = time.perf_counter(), cases()
        named = {case.name: case for case in chosen}
        slow = {name: refined(named[name], 1e-7) for name in ("bryson_denham", "minimum_time", "rayleigh", "brachistochrone")}
        results = {"cases": study(chosen), "refined": slow}
        versions = {"python": platform.python_version(), "casadi": version("casadi"), "numpy": np.__version__}
        write_json(saved, {"versions": versions, "options": vars(OPTIONS), "seconds": time.perf_counter() - began, **results})
    results = json.loads(saved.read_text())
    write_text(arguments.out / "optimal_control.md", table(results))
    figure(results, arguments.out / "optimal_control.png")
    print(table(results))


if __name__ == "__main__":
    main()
