"""The error of a collocated solution between its nodes, and finer meshes until it is small."""

from dataclasses import dataclass, replace

import numpy as np

from rrr_oc.optimal_control.solver import Options, Solution, Solver


@dataclass(frozen=True)
class MeshError:
    """How far a collocated solution is from solving the differential equations between its nodes.

    Attributes:
        intervals: For each phase, the relative error of each interval: ∫ |x' − f(x, u)| dt over the states' scale, and the
            error of the cost's quadrature over the whole cost (N,).
        largest: The largest of them.
        quadrature: Relative difference between the cost with the scheme's weights and by fine quadrature on the same motion.
            Not the cost's distance from the optimum: that shows in its change from mesh to mesh.
        violation: Largest excess of bounds between the nodes, relative to the variables' scales; of paths, in their own unit.
    """

    intervals: tuple[np.ndarray, ...]
    largest: float
    quadrature: float
    violation: float


def mesh_error(solution: Solution) -> MeshError:
    """Integrate the residual of the interpolants (Betts, "Practical Methods for Optimal Control", section 4.7)."""
    nodes, weights = np.polynomial.legendre.leggauss(2 * solution.transcription.scheme.d + 3)
    inside, weights = (nodes + 1) / 2, weights / 2
    intervals, fine_total, violation = [], np.zeros(len(solution.problem.groups)), 0.0
    scale = _magnitude(solution)
    for i, (phase, block) in enumerate(zip(solution.problem.phases, solution.transcription.blocks, strict=True)):
        _, x, dx, u = solution.sample(i, inside)
        f, cost, path = solution.rates(i, x, u)
        h = solution.transcription.mesh[i] * solution.durations[i]
        defect = np.einsum("xnk,k,n->xn", np.abs(dx - f), weights, h)
        magnitude = phase.x_scale + np.abs(solution.values[block.nodes]).max(axis=1)
        coarse = solution.rates(i, solution.values[block.stage_x], solution.values[block.stage_u])[1]
        fine = np.einsum("cnk,k,n->cn", cost, weights, h)
        quadrature = np.abs(fine - np.einsum("cdn,d,n->cn", coarse, solution.transcription.scheme.b, h)) * phase.weight / scale
        intervals.append(np.maximum((defect / magnitude[:, None]).max(axis=0), quadrature.max(axis=0)))
        np.add.at(fine_total, list(phase.costs), phase.weight * fine.sum(axis=1))
        for value, lower, upper, size in (
            (x, phase.x_lower, phase.x_upper, phase.x_scale),
            (u, phase.u_lower, phase.u_upper, phase.u_scale),
            (path, phase.path_lower, phase.path_upper, np.ones(len(phase.paths))),
        ):
            excess = np.maximum(lower[:, None, None] - value, value - upper[:, None, None]) / size[:, None, None]
            violation = max(violation, float(excess.max(initial=0.0)))
    largest = max(float(e.max()) for e in intervals)
    return MeshError(tuple(intervals), largest, abs(solution.problem.cost(fine_total) - solution.cost) / scale, violation)


@dataclass(frozen=True)
class Refinement:
    """When a mesh is fine enough.

    Attributes:
        tolerance: Relative tolerance of the error between the nodes and of the cost's change from mesh to mesh.
        rounds: Largest number of finer meshes.
        largest: Largest number of intervals a phase.
    """

    tolerance: float = 1e-6
    rounds: int = 12
    largest: int = 640


def refine(
    solution: Solution, refinement: Refinement | None = None, options: Options | None = None
) -> tuple[Solution, list[dict]]:
    """Solve on finer meshes until the error between the nodes and the change of the cost are below the tolerance.

    Intervals whose error is too large are split into two to four by the scheme's order. The barrier parameter starts small, so
    that a refined solve does not move to another optimum of nearly the same cost. IPOPT's tolerance is a thousandth of the
    mesh's, because its barrier adds to the cost in proportion to the number of bounds.

    Returns:
        The last solution, and one row a mesh: intervals, cost, error, quadrature, violation, iterations and seconds; from the
        second row on also the relative `change` of the cost and whether the mesh has `converged`. It has not where `rounds`
        or `largest` ended the refinement. Limits hold at nodes and stages; `violation` is their largest excess in between,
        and no part of the tolerance.
    """
    refinement, options = refinement or Refinement(), options or Options()
    options = replace(options, barrier=1e-8, tolerance=min(options.tolerance, 1e-3 * refinement.tolerance))
    error = mesh_error(solution)
    rows = [mesh_row(solution, error)]
    for _ in range(refinement.rounds):
        mesh = _split(solution, error, refinement)
        if mesh is None:
            break
        finer = replace(solution.transcription, mesh=mesh)
        previous, solution = solution, Solver(finer, options).solve(solution.guess())
        error = mesh_error(solution)
        change = abs(solution.cost - previous.cost) / _magnitude(solution)
        converged = max(error.largest, change) <= refinement.tolerance
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


def _split(solution: Solution, error: MeshError, refinement: Refinement) -> tuple[np.ndarray, ...] | None:
    """A finer mesh; None where it would be too fine. If every interval is within the tolerance, the worst third is split."""
    order = solution.transcription.scheme.d + 1
    threshold = min(refinement.tolerance, np.quantile(np.concatenate(error.intervals), 2 / 3))
    meshes = []
    for fractions, errors in zip(solution.transcription.mesh, error.intervals, strict=True):
        pieces = np.clip(np.ceil((errors / refinement.tolerance) ** (1 / order)), 2, 4)
        pieces = np.where(errors > threshold, pieces, 1).astype(int)
        meshes.append(np.repeat(fractions / pieces, pieces))
    return None if max(len(m) for m in meshes) > refinement.largest else tuple(meshes)
