"""One interval of a collocated phase as CasADi functions with exact first and second derivatives."""

from dataclasses import dataclass
from functools import lru_cache

import casadi as ca
import numpy as np
import scipy.sparse

from rrr_oc.compiler import available, digest, library
from rrr_oc.optimal_control.problem import Phase
from rrr_oc.optimal_control.scatter import multiplied, nonzeros_of
from rrr_oc.optimal_control.scheme import Scheme


@dataclass(frozen=True, eq=False)
class Interval:
    """Functions of the unscaled variables of one interval, z = (p, T, x_0, x_1, stages that are no nodes, variables of the
    controls); dense outputs.

    Rows: the defects of the stages, the defect of the step where the last stage is not the node, then the path constraints of each
    stage. Defects are divided by the states' scales.

    Attributes:
        rows: Number of rows.
        value: (z, fraction, d) -> (costs (nc,), rows).
        gradient: (z, fraction, d) -> gradients of the costs (nz, nc).
        jacobian: (z, fraction, d) -> nonzeros of the rows' Jacobian, which stand at `jacobian_at` (rows, columns).
        hessian: (z, fraction, d, lam_f (nc,), lam_g) -> nonzeros of one triangle of the Lagrangian's Hessian, at `hessian_at`.
    """

    rows: int
    value: ca.Function
    gradient: ca.Function
    jacobian: ca.Function
    jacobian_at: tuple[np.ndarray, np.ndarray]
    hessian: ca.Function
    hessian_at: tuple[np.ndarray, np.ndarray]


@lru_cache(maxsize=256)
def interval_functions(phase: Phase, s: Scheme, n_p: int, n_d: int, compiled: bool) -> Interval:
    """The functions of an interval of a phase with n_p parameters and n_d data. The 256 used last are kept, by the phase's identity."""
    nx, nu = len(phase.x), len(phase.u)
    p, T, h, d = ca.SX.sym("p", n_p), ca.SX.sym("T"), ca.SX.sym("h"), ca.SX.sym("d", n_d)
    x0, x1, X, U = ca.SX.sym("x0", nx), ca.SX.sym("x1", nx), ca.SX.sym("X", nx, len(s.inner)), ca.SX.sym("U", nu, s.d)
    stages = [*([x0] if s.shares_first else []), *ca.horzsplit(X), *([x1] if s.shares_last else [])]
    controls = U @ ca.DM(s.basis.T)
    rates = [phase.rates(x, controls[:, i], p, d) for i, x in enumerate(stages)]
    F, step = ca.horzcat(*[r[0] for r in rates]), h * T
    defects = [x - x0 - step * (F @ ca.DM(s.A[i])) for i, x in enumerate(stages) if not (i == 0 and s.shares_first)]
    if not s.shares_last:
        defects.append(x1 - x0 - step * (F @ ca.DM(s.b)))
    cost = step * sum(float(b) * r[1] for b, r in zip(s.b, rates, strict=True))
    rows = ca.vertcat(*[defect / phase.x.scale for defect in defects], *[r[2] for r in rates])
    z = ca.vertcat(p, T, x0, x1, ca.vec(X), ca.vec(U))
    slopes = ca.jacobian(rows, z)
    gradient, hessian, hessian_at = _by_stages(phase, s, n_p, n_d)
    functions = [
        ca.Function("value", [z, h, d], [ca.densify(cost), ca.densify(rows)]),
        gradient,
        ca.Function("jacobian", [z, h, d], [slopes.nz[:]]),
        hessian,
    ]
    value, gradient, jacobian, hessian = _as_c(functions) if compiled and available() else functions
    return Interval(rows.numel(), value, gradient, jacobian, nonzeros_of(slopes.sparsity()), hessian, hessian_at)


def _by_stages(phase: Phase, s: Scheme, n_p: int, n_d: int):
    """Gradients of an interval's costs and Hessian of its Lagrangian, from those of one stage at y = (p, T, x, u).

    Stage j's share of the Lagrangian, but for terms linear in z, is T (σ·l − ν·f) + μ·path, where l are the cost rates,
    σ = h b_j lam_f, ν = h Σ_i A_ij λ_i / (scale of x) (and b_j times the step's multipliers), and λ_i and μ multiply
    the stage's defects and paths.
    """
    nx, nu, ng, nc, d = len(phase.x), len(phase.u), len(phase.path), phase.rates.numel_out(1), s.d
    y, data = ca.SX.sym("y", n_p + 1 + nx + nu), ca.SX.sym("d", n_d)
    sigma, weight, nu_f, mu = ca.SX.sym("sigma", nc), ca.SX.sym("weight"), ca.SX.sym("nu", nx), ca.SX.sym("mu", ng)
    p, T, x, u = ca.vertsplit(y, [0, n_p, n_p + 1, n_p + 1 + nx, y.numel()])
    f, rate, path = phase.rates(x, u, p, data)
    share = T * (ca.dot(sigma, rate) - ca.dot(nu_f, f)) + ca.dot(mu, path)
    second = ca.triu(ca.hessian(share, y)[0])
    slope = ca.Function("slope", [y, data, weight], [ca.densify(ca.jacobian(T * weight * rate, y).T)])
    curvature = ca.Function("curvature", [y, data, sigma, nu_f, mu], [second.nz[:]])
    i, j = nonzeros_of(second.sparsity())

    shared, controls = np.arange(n_p + 1), n_p + 1 + (2 + len(s.inner)) * nx
    nz, n_defects = controls + d * nu, s.defects
    places = []  # each stage's y as a linear function of z, (y, nz)
    for k in range(d):
        position = 0 if k == 0 and s.shares_first else 1 if k == d - 1 and s.shares_last else 2 + k - s.shares_first
        place = np.zeros((y.numel(), nz))
        copied = np.r_[shared, n_p + 1 + position * nx + np.arange(nx)]
        place[np.arange(copied.size), copied] = 1.0
        place[copied.size :, controls:] = np.kron(s.basis[k], np.eye(nu))
        places.append(place)
    z, h, c = ca.MX.sym("z", nz), ca.MX.sym("h"), ca.MX.sym("d", n_d)
    lam_f, lam_g = ca.MX.sym("lam_f", nc), ca.MX.sym("lam_g", nx * n_defects + ng * d)
    weights = np.vstack([s.A[int(s.shares_first) :], *([] if s.shares_last else [s.b])])  # (n_defects, d)
    nu_all = ca.reshape(lam_g[: nx * n_defects], nx, n_defects) @ ca.DM(weights) * h / phase.x.scale
    mu_all = ca.reshape(lam_g[nx * n_defects :], ng, d)
    ys = [multiplied(scipy.sparse.coo_array(place), z) for place in places]
    transposed = scipy.sparse.coo_array(np.hstack([place.T for place in places]))
    slopes = [slope(ys[k], c, h * float(s.b[k])) for k in range(d)]
    summed = [multiplied(transposed, ca.vertcat(*[one[:, cost] for one in slopes])) for cost in range(nc)]
    gradient = ca.Function("gradient", [z, h, c], [ca.densify(ca.horzcat(*summed))])  # nodes that are no stages have none
    curvatures = [curvature(ys[k], c, h * float(s.b[k]) * lam_f, nu_all[:, k], mu_all[:, k]) for k in range(d)]
    matrix, hessian_at = _congruence(places, i, j)
    hessian = ca.Function("hessian", [z, h, c, lam_f, lam_g], [multiplied(matrix, ca.vertcat(*curvatures))])
    return gradient, hessian, hessian_at


def _congruence(places: list[np.ndarray], i: np.ndarray, j: np.ndarray):
    """The map from the entries (i, j) of one triangle of every stage's Hessian H to those of one triangle of Σ Cᵀ H C.

    Args:
        places: C of each stage, (y, nz); each column belongs to one row.

    Returns:
        The matrix, and the rows and columns in z of the entries that it gives.
    """
    rows, columns, factors, count, nz = [], [], [], 0, places[0].shape[1]
    for C in places:
        for a, b in zip(i, j, strict=True):
            first, second = (ends.ravel() for ends in np.meshgrid(np.flatnonzero(C[a]), np.flatnonzero(C[b]), indexing="ij"))
            once = first <= second if a == b else np.full(first.size, True)
            rows.append(np.minimum(first, second)[once] * nz + np.maximum(first, second)[once])
            columns.append(np.full(rows[-1].size, count))
            factors.append((C[a, first] * C[b, second])[once])
            count += 1
    keys, slot = np.unique(np.concatenate(rows), return_inverse=True)
    matrix = scipy.sparse.coo_array((np.concatenate(factors), (slot, np.concatenate(columns))), (keys.size, count))
    return matrix, (keys // nz, keys % nz)


def _as_c(functions: list[ca.Function]) -> list[ca.Function]:
    """The same functions from a compiled library."""
    generator = ca.CodeGenerator("interval", {"with_header": False})
    for function in functions:
        generator.add(function)
    code = generator.dump()
    optimise = "-O1" if code.count("\n") < 20_000 else "-O0"  # gcc's time grows faster than the code: 40 s for 7 joints
    flags = (optimise, "-DGCC_HASCLASSVISIBILITY")  # the latter exports what casadi marks
    path = library(f"interval-{digest(code, *flags)}", code, flags)
    return [ca.external(function.name(), str(path)) for function in functions]
