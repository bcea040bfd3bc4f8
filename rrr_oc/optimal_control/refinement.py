"""The error of a collocated solution between its nodes, and finer meshes until it is small."""

from dataclasses import dataclass, replace

import numpy as np

from rrr_oc.optimal_control.scheme import scheme
from rrr_oc.optimal_control.solver import Options, Solution, Solver

SMALL = 0.1  # [1] of the tolerance of the cost that an interval may lose by one switch; doubled, more rounds, fewer intervals
# Initial barrier parameter over the scaled cost [1] on the first mesh on which limits hold everywhere. Ten times as much leads away to
# other optima; with a thousandth, flat valleys take many more iterations. On later meshes it is the second number.
BARRIER, LATER = 1e-5, 1e-8
NEAR = 1e-4  # [1] of its scale: a control this close to a limit is at it; doubled, more intervals are split that need not be


@dataclass(frozen=True)
class MeshError:
    """How far a collocated solution is from solving the differential equations between its nodes.

    Attributes:
        intervals: For each phase, the relative error of each interval: ∫ |x' − f(x, u)| dt over the states' scale, and the
            error of the cost's quadrature over the whole cost (N,).
        largest: The largest of them.
        quadrature: Relative difference between the cost with the scheme's weights and by fine quadrature on the same motion.
            Not the cost's distance from the optimum: that shows in its change from mesh to mesh.
        excess: For each phase, the largest excess of a bound of a state or a path in each interval, relative to its scale times its
            easing (N,).
        violation: Largest excess of bounds between the nodes, relative to the variables' scales; of paths, in their own unit.
    """

    intervals: tuple[np.ndarray, ...]
    largest: float
    quadrature: float
    excess: tuple[np.ndarray, ...]
    violation: float


def mesh_error(solution: Solution) -> MeshError:
    """Integrate the residual of the interpolants (Betts, "Practical Methods for Optimal Control", section 4.7)."""
    nodes, weights = np.polynomial.legendre.leggauss(2 * solution.transcription.scheme.d + 3)
    inside, weights = (nodes + 1) / 2, weights / 2
    intervals, excesses, fine_total, violation = [], [], np.zeros(len(solution.problem.groups)), 0.0
    scale = _magnitude(solution)
    for i, (phase, block) in enumerate(zip(solution.problem.phases, solution.transcription.blocks, strict=True)):
        _, x, dx, u = solution.sample(i, inside)
        f, cost, path = solution.rates(i, x, u)
        h = solution.transcription.mesh[i] * solution.durations[i]
        defect = np.einsum("xnk,k,n->xn", np.abs(dx - f), weights, h)
        magnitude = phase.x.scale + np.abs(solution.values[block.nodes]).max(axis=1)
        coarse = solution.rates(i, solution.values[block.stage_x], solution.controls(i))[1]
        fine = np.einsum("cnk,k,n->cn", cost, weights, h)
        quadrature = np.abs(fine - np.einsum("cdn,d,n->cn", coarse, solution.transcription.scheme.b, h)) * phase.weight / scale
        intervals.append(np.maximum((defect / magnitude[:, None]).max(axis=0), quadrature.max(axis=0)))
        np.add.at(fine_total, list(phase.costs), phase.weight * fine.sum(axis=1))
        over = np.zeros(len(h))
        for value, of in ((x, phase.x), (u, phase.u), (path, phase.path)):
            lower, upper, size = (part[:, None, None] for part in (of.lower, of.upper, of.scale))
            excess = np.maximum(lower - value, value - upper) / size
            violation = max(violation, float(excess.max(initial=0.0)))
            if value is not u:
                over = np.maximum(over, (excess.max(axis=2, initial=0.0) / of.easings[:, None]).max(axis=0, initial=0.0))
        excesses.append(over)
    largest = max(float(e.max()) for e in intervals)
    quadrature = abs(solution.problem.cost(fine_total) - solution.cost) / scale
    return MeshError(tuple(intervals), largest, quadrature, tuple(excesses), violation)


@dataclass(frozen=True)
class Refinement:
    """When a mesh is fine enough.

    Attributes:
        tolerance: Relative tolerance of the error between the nodes and of the cost's change from mesh to mesh.
        excess: Excess of a bound of a state or a path between the nodes, relative to its scale times its easing, that is small enough.
        rounds: Largest number of finer meshes.
        largest: Largest number of intervals a phase.
    """

    tolerance: float = 1e-6
    excess: float = 1e-5
    rounds: int = 12
    largest: int = 640


def refine(
    solution: Solution, refinement: Refinement | None = None, options: Options | None = None
) -> tuple[Solution, list[dict]]:
    """Solve on finer meshes until the error between the nodes, the change of the cost and the excess of states and paths are below their
    tolerances.

    Intervals whose error is too large are split into two to four by the scheme's order, and so are those in which a control leaves a
    limit, because from the second mesh on limits of controls hold everywhere. That mesh starts with a barrier parameter so large
    (`BARRIER`) that other constraints can become active, and that a flat valley of the cost is followed to its end; later ones with
    a small one, so that the solution does not move to another optimum of nearly the same cost. IPOPT's tolerance is a thousandth of
    the mesh's, because its barrier adds to the cost in proportion to the number of bounds.

    Returns:
        The last solution, and one row a mesh: intervals, cost, error, quadrature, violation, iterations and seconds; from the
        second row on also the relative `change` of the cost and whether the mesh has `converged`. It has not where `rounds`
        or `largest` ended the refinement. Limits of controls hold everywhere, those of states and paths at nodes and stages;
        `violation` is their largest excess in between.
    """
    refinement, options = refinement or Refinement(), options or Options()
    options = replace(options, tolerance=min(options.tolerance, 1e-3 * refinement.tolerance))
    error = mesh_error(solution)
    rows = [mesh_row(solution, error)]
    method = scheme(solution.transcription.scheme.name, solution.transcription.scheme.d, everywhere=True)
    for _ in range(refinement.rounds):
        mesh = _split(solution, error, refinement)
        if mesh is None:
            break
        finer = replace(solution.transcription, scheme=method, mesh=mesh)
        first = not solution.transcription.scheme.everywhere
        barrier = max(BARRIER * _magnitude(solution) / solution.problem.cost_scale, LATER) if first else LATER
        previous, solution = solution, Solver(finer, replace(options, barrier=barrier)).solve(solution.guess())
        error = mesh_error(solution)
        change = abs(solution.cost - previous.cost) / _magnitude(solution)
        excess = max(e.max() for e in error.excess)
        converged = max(error.largest, change) <= refinement.tolerance and excess <= refinement.excess
        rows.append(mesh_row(solution, error) | {"change": change, "converged": converged})
        if converged:
            break
    return solution, rows


def mesh_row(solution: Solution, error: MeshError | None = None) -> dict:
    """A solution's mesh, cost, error and effort as plain data."""
    error = error or mesh_error(solution)
    return {
        "intervals": [len(m) for m in solution.transcription.mesh],
        "cost": solution.cost,
        "error": error.largest,
        "quadrature": error.quadrature,
        "violation": error.violation,
        "iterations": solution.iterations,
        "seconds": solution.seconds,
    }


def _magnitude(solution: Solution) -> float:
    return max(abs(solution.cost), 1e-12 * solution.problem.cost_scale)


def _slowed(solution: Solution) -> list[np.ndarray]:
    """For each phase about how much of the cost, relative, each interval loses because a control leaves a limit there not at once, as
    it might, but as a polynomial (N,): the square of the share of time, times the change."""
    result = []
    for phase, block, fractions in zip(
        solution.problem.phases, solution.transcription.blocks, solution.transcription.mesh, strict=True
    ):
        u, scale = solution.values[block.controls], phase.u.scale[:, None, None]
        gap = np.minimum(u - phase.u.lower[:, None, None], phase.u.upper[:, None, None] - u) / scale
        change = np.where(gap.min(axis=1) < NEAR, gap.max(axis=1), 0.0).max(axis=0)
        result.append(change * fractions**2)
    return result


def _split(solution: Solution, error: MeshError, refinement: Refinement) -> tuple[np.ndarray, ...] | None:
    """A finer mesh; None where it would be too fine. If no interval has a reason to be split, the third with the largest errors is."""
    order, small, pieces = solution.transcription.scheme.d + 1, SMALL * refinement.tolerance, []
    for errors, excess, slowed in zip(error.intervals, error.excess, _slowed(solution), strict=True):
        by_error, by_excess, by_switches = (
            (errors / refinement.tolerance) ** (1 / order),
            excess / refinement.excess,
            slowed / small,
        )
        needed = np.max([by_error, np.sqrt(by_excess), np.sqrt(by_switches)], axis=0)  # both fall with the square of the length
        pieces.append(np.clip(np.ceil(needed), 1, 4).astype(int))
    if all((p == 1).all() for p in pieces):
        threshold = np.quantile(np.concatenate(error.intervals), 2 / 3)
        pieces = [np.where(errors > threshold, 2, 1) for errors in error.intervals]
    meshes = tuple(np.repeat(f / p, p) for f, p in zip(solution.transcription.mesh, pieces, strict=True))
    return None if max(len(m) for m in meshes) > refinement.largest else meshes
