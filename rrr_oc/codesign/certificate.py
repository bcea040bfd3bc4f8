"""The certificate of an optimum: optimality conditions, active bounds, discretisation and smoothing errors."""

from collections.abc import Callable, Iterator
from itertools import chain, pairwise

import numpy as np
from msgspec import Struct
from scipy.integrate import solve_ivp

from rrr_oc.codesign.bounds.on_motion import SpringBound, solution_bound
from rrr_oc.codesign.bounds.over_motions import task_bound
from rrr_oc.codesign.clearance import FLOOR
from rrr_oc.codesign.design_problem import COSTS, CoDesign, torque_path
from rrr_oc.codesign.search.local_optima import Optimum
from rrr_oc.optimal_control.optimality import Kkt
from rrr_oc.optimal_control.refinement import mesh_error
from rrr_oc.optimal_control.solver import Solution

_SAVING = 1e-6  # [1] a bound that saves no more of the cost by one unit is not listed; doubled, the list is a little shorter
# [1] of a variable's scale: a parameter this close to its bound is at it; doubled, bounds further away are listed
_TOUCHED = 1e-4
PIECES = 8  # of an interval for the exact cost, whose rate has kinks; doubled, they are met four times as well
_Bound = tuple[str, float, str, float]  # name, value [unit], unit, decrease of the cost for moving it outward by one unit
_DESIGNER = {
    "rad": (180 / np.pi, "°"),
    "rad/s": (180 / np.pi, "°/s"),
    "rad/s²": (180 / np.pi, "°/s²"),
    "rad/s³": (180 / np.pi, "°/s³"),
    "m": (1e3, "mm"),
}


class ActiveBound(Struct, frozen=True):
    """A bound that is active at the optimum and costs something.

    Attributes:
        name: What is bounded, and on which side.
        value: The bound, in `unit`.
        unit: Degrees and millimetres rather than SI units.
        saving: Relative decrease of the cost for moving the bound outward by one unit, to first order [1].
        sentence: The same in words.
    """

    name: str
    value: float
    unit: str
    saving: float
    sentence: str


class MeshQuality(Struct, frozen=True):
    """How exact the last mesh is.

    Attributes:
        error: Largest relative error between the nodes [1].
        quadrature: Relative error of the cost's quadrature [1].
        change: Relative change of the cost from the mesh before; null with one mesh alone [1].
        converged: Whether error and change are within the tolerance.
    """

    error: float
    quadrature: float
    change: float | None
    converged: bool


class Reintegration(Struct, frozen=True):
    """How far an adaptive integration of the controls is from the plan, see `reintegrate`.

    Attributes:
        state: Largest difference of the states at the phases' ends, over their scales [1].
        cost: Relative difference of the cost [1].
    """

    state: float
    cost: float


class Certificate(Struct, frozen=True):
    """What is known of an optimum.

    Attributes:
        primal: Residual of the constraints, scaled; the largest [1].
        dual: Residual of the gradient of the Lagrangian, scaled; the largest [1].
        complementarity: Residual of the complementarity conditions, scaled; the largest [1].
        second_order: Whether the second-order condition is "strict", "weak" or "violated". The biarticular spring stands with kappa, rho
            and phi, so equivalent hardware makes no null directions.
        curvature: Smallest eigenvalue of the Hessian of the Lagrangian on the null space of the active constraints, variables
            scaled and weighted by their share of time, cost relative [1].
        flattest: The variables that dominate its eigenvector.
        active: Bounds with their multipliers, largest saving first.
        sensitivity: Relative change of the cost by one more kg of payload [1/kg].
        mesh: How exact the last mesh is.
        violation: Largest excess of a limit between the nodes, relative to its scale [1].
        smoothing: Relative change of the cost with exact, non-smooth springs on the same motion [1].
        exact_cost: The cost with exact springs, in the cost's unit.
        reintegration: How far an adaptive integration of the controls is from the plan.
        reached: Number of independent starts that led to it; 0 where it was put together from motions or found from other optima.
        bound: What no springs can be better than on the same motion; null where that is not known.
        least: What no springs and no motion of the task can be better than; null where that is not known [N²m²s].
    """

    primal: float
    dual: float
    complementarity: float
    second_order: str
    curvature: float
    flattest: tuple[str, ...]
    active: tuple[ActiveBound, ...]
    sensitivity: float
    mesh: MeshQuality
    violation: float
    smoothing: float
    exact_cost: float
    reintegration: Reintegration
    reached: int
    bound: SpringBound | None
    least: float | None


def certify(design: CoDesign, optimum: Optimum, offered: CoDesign | None = None) -> Certificate:
    """The certificate of an optimum of a design; `offered` has the springs that it is compared with, by default the design's own."""
    solution = optimum.solution
    kkt = Kkt(solution)
    second_order, curvature, direction = kkt.second_order()
    exact = exact_cost(design, solution)
    error, last = mesh_error(solution), optimum.meshes[-1]
    return Certificate(
        primal=kkt.primal,
        dual=kkt.dual,
        complementarity=kkt.complementarity,
        second_order=second_order,
        curvature=curvature,
        flattest=kkt.dominant(direction),
        active=_active(design, solution, kkt),
        sensitivity=float(kkt.data_gradient[0]) / solution.cost,
        mesh=MeshQuality(error.largest, error.quadrature, last.get("change"), last.get("converged", False)),
        violation=error.violation,
        smoothing=abs(exact - solution.cost) / solution.cost,
        exact_cost=exact,
        reintegration=Reintegration(**reintegrate(solution)),
        reached=optimum.reached,
        bound=solution_bound(solution, design, offered),
        least=task_bound(offered or design),
    )


def _active(design: CoDesign, solution: Solution, kkt: Kkt) -> tuple[ActiveBound, ...]:
    bounds = chain(
        _parameter_bounds(design, solution),
        _hardware_bounds(design, kkt),
        _motion_bounds(design, solution),
        _path_bounds(design, solution),
    )
    active = (_described(design, solution, *bound) for bound in bounds)
    return tuple(sorted((b for b in active if b.saving > _SAVING), key=lambda b: -b.saving))


def _described(design: CoDesign, solution: Solution, name: str, value: float, unit: str, gain: float) -> ActiveBound:
    factor, readable = _DESIGNER.get(unit, (1.0, unit))
    value, saving = float(value * factor), float(gain / factor / solution.cost)
    cost = "E1" if design.cost == "load" else f"the cost [{COSTS[design.cost].unit}]"
    sentence = f"moving {name} ({value:.4g} {readable}) outward by one {readable} would save {100 * saving:.2g} % of {cost}"
    return ActiveBound(name, value, readable, saving, sentence)


def _parameter_bounds(design: CoDesign, solution: Solution) -> Iterator[_Bound]:
    """Bounds of springs' parameters and of durations."""
    problem, t = solution.problem, solution.transcription
    entries = [(i, n, p.unit) for i, (n, p) in enumerate(zip(problem.parameters, design.model.parameters, strict=True))]
    entries += [(b.duration, f"duration of {p.name}", "s") for p, b in zip(problem.phases, t.blocks, strict=True)]
    lower, upper = t.bounds
    for index, name, unit in entries:
        force = solution.lam_w[index] / t.scale[index] * problem.cost_scale
        side, bound = ("upper", upper) if force > 0 else ("lower", lower)
        if lower[index] < upper[index] and abs(solution.w[index] - bound[index]) < _TOUCHED and force:
            yield f"the {side} bound of {name}", bound[index] * t.scale[index], unit, abs(force)


def _hardware_bounds(design: CoDesign, kkt: Kkt) -> Iterator[_Bound]:
    """Bounds of springs' hardware, of which the parameters are functions."""
    units = {s.form.name(q, s.effect.joints): q.si for s in design.springs if s.hardware for q in s.form.quantities}
    for name, value, slope in zip(design.data_names, kkt.solution.problem.data, kkt.data_gradient, strict=True):
        quantity, _, side = name.rpartition(" ")
        if quantity in units:
            yield f"the {side} bound of {quantity}", value, units[quantity], -slope if side == "upper" else slope


def _motion_bounds(design: CoDesign, solution: Solution) -> Iterator[_Bound]:
    """Limits of range, speed, acceleration and jerk: the multipliers of all instants together."""
    t, task = solution.transcription, design.task
    fixed = np.flatnonzero(t.bounds[0] == t.bounds[1])

    def inner(state: int) -> list[np.ndarray]:
        """Indices of a state's variables at all nodes and stages of each phase but those that the task fixes."""
        return [np.setdiff1d(np.r_[b.nodes[state], b.stage_x[state].ravel()], fixed) for b in t.blocks]

    force = solution.lam_w / t.scale * solution.problem.cost_scale
    for j, joint in enumerate(task.joints):
        for kind, unit, row, limits in (
            ("range", "rad", j, (task.lower[j], task.upper[j])),
            ("speed", "rad/s", design.series.speed_state(j), (-task.speed[j], task.speed[j])),
        ):
            for side, sign, value in zip(("lower", "upper"), (-1, 1), limits, strict=True):
                yield f"the {side} {kind} limit of {joint}", value, unit, _positive(sign * force, inner(row))
        controls, (is_state, row) = [np.unique(b.controls[j]) for b in t.blocks], design.acceleration(j)
        accelerations = inner(row) if is_state else controls
        limits = [("acceleration", task.acceleration[j], "rad/s²", accelerations)]
        limits += [("jerk", task.jerk[j], "rad/s³", controls)] * is_state
        for kind, limit, unit, indices in limits:
            if np.isfinite(limit):
                total = _positive(-force, indices) + _positive(force, indices)
                yield f"the {kind} limit of {joint}", limit, unit, total


def _positive(force: np.ndarray, indices: list[np.ndarray]) -> float:
    """Sum of the positive multipliers."""
    return float(sum(np.maximum(force[i], 0).sum() for i in indices))


def _path_bounds(design: CoDesign, solution: Solution) -> Iterator[_Bound]:
    """Limits of torque and of springs, the floor and keep-outs, rows of the problem: the multipliers of all instants together."""
    task, force = design.task, dict[str, float]()
    for name, rows in solution.transcription.path_rows:
        force[name] = force.get(name, 0.0) + np.abs(solution.lam_g[rows]).sum() * solution.problem.cost_scale
    limits = {torque_path(joint): (limit, "Nm") for joint, limit in zip(task.joints, task.torque, strict=True)}
    limits |= {part.what: (part.limit, part.unit) for part in design.limited_parts}
    for name, total in force.items():
        if name == FLOOR:
            yield FLOOR, task.around.floor, "m", total
        elif name in limits:
            limit, unit = limits[name]
            yield f"the limit of the {name}", limit, unit, total / limit  # the row is what is limited over its limit, ≤ 1
        else:  # a keep-out, from whose surface every row has its own distance
            yield f"the surface of {name}", 0.0, "m", total


def exact_cost(design: CoDesign, solution: Solution) -> float:
    """The cost with exact, non-smooth springs on the same motion and its mesh, by fine quadrature."""
    nodes, weights = _composite(9, PIECES)
    data, total = design.data(0.0), np.zeros(len(solution.problem.groups))
    for i, phase in enumerate(solution.problem.phases):
        _, x, _, u = solution.sample(i, nodes)
        rates = phase.rates(x.reshape(len(x), -1), u.reshape(len(u), -1), solution.parameters[:, None], data[:, None])
        h = solution.transcription.mesh[i] * solution.durations[i]
        total += np.einsum("cnk,k,n->c", np.array(rates[1]).reshape(-1, *x.shape[1:]), weights, h)
    return solution.problem.cost(total)


def _composite(points: int, pieces: int) -> tuple[np.ndarray, np.ndarray]:
    """Nodes in [0, 1] and weights of Gauss's quadrature on equal pieces of that."""
    nodes, weights = np.polynomial.legendre.leggauss(points)
    return ((np.arange(pieces)[:, None] + (nodes + 1) / 2) / pieces).ravel(), np.tile(weights / 2 / pieces, pieces)


def reintegrate(solution: Solution, tolerance: float = 1e-10) -> dict[str, float]:
    """Run the controls through an adaptive integrator (DOP853), interval by interval without resetting the states.

    Returns:
        `state`: largest difference of the states at the phases' ends, over their scales; `cost`: relative difference.
    """
    worst, costs = 0.0, np.zeros(len(solution.problem.groups))
    for i, phase in enumerate(solution.problem.phases):
        nodes, nx = solution.values[solution.transcription.blocks[i].nodes], len(phase.x)
        edges = np.r_[0, np.cumsum(solution.transcription.mesh[i])] * solution.durations[i]
        y = np.r_[nodes[:, 0], np.zeros(costs.size)]
        for k, span in enumerate(pairwise(edges)):
            rates = _rates_in_interval(solution, i, k, span)
            y = solve_ivp(rates, span, y, method="DOP853", rtol=tolerance, atol=tolerance).y[:, -1]
        worst = max(worst, float((np.abs(y[:nx] - nodes[:, -1]) / phase.x.scale).max()))
        costs += y[nx:]
    return {"state": worst, "cost": abs(solution.problem.cost(costs) - solution.cost) / abs(solution.cost)}


def _rates_in_interval(solution: Solution, i: int, k: int, span: tuple[float, float]) -> Callable:
    """(t, y) -> dy/dt of y = (states, costs) in interval k of phase i, which lasts from span[0] to span[1] [s]."""
    phase, (start, end) = solution.problem.phases[i], span
    controls = solution.controls(i)[:, :, k]
    p, d, scheme = solution.parameters, solution.problem.data, solution.transcription.scheme

    def rates(t: float, y: np.ndarray) -> np.ndarray:
        weights = scheme.at(np.array([(t - start) / (end - start)]))[0][0]
        f, cost_rates, _ = phase.rates(y[: len(phase.x)], controls @ weights, p, d)
        return np.r_[np.array(f).ravel(), np.array(cost_rates).ravel()]

    return rates
