"""Direct collocation: an optimal-control problem on a mesh as a sparse nonlinear program with exact derivatives.

Every scheme is an implicit Runge–Kutta method with d stages (A, b, c) an interval of length h: with f the rates at the
stages, x_i = x_0 + h Σ_j A_ij f_j and x_1 = x_0 + h Σ_j b_j f_j; the cost is quadrature with b. Hermite–Simpson is
Lobatto IIIA with three stages (the first and last stages of Lobatto's methods are the nodes, so neighbours share them,
controls included); Lobatto IIIA, Gauss–Legendre and Radau IIA have a chosen number of stages. See Betts, "Practical
Methods for Optimal Control", ch. 4; Hairer & Wanner II, IV.5.
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache

import casadi as ca
import numpy as np

from rrr_oc.compiler import digest, library
from rrr_oc.errors import UserError
from rrr_oc.optimal_control.problem import Guess, Phase, Problem

SCHEMES = ("hermite-simpson", "lobatto", "gauss", "radau")


@dataclass(frozen=True, eq=False)
class Scheme:
    """A collocation method.

    Attributes:
        name: One of `SCHEMES`.
        c: Stages in [0, 1], shape (d,).
        A, b: Runge–Kutta coefficients, shapes (d, d) and (d,).
        order: Of the Runge–Kutta method. The optimal cost converges with it for smooth problems; so do the states, except
            that controls shared at the nodes hold the states of Lobatto's methods back to order 4.
    """

    name: str
    c: np.ndarray
    A: np.ndarray
    b: np.ndarray
    order: int

    @property
    def d(self) -> int:
        """Number of stages."""
        return len(self.c)

    @property
    def shares_first(self) -> bool:
        """Whether the first stage is the node at the interval's start."""
        return self.c[0] == 0

    @property
    def shares_last(self) -> bool:
        """Whether the last stage is the node at the interval's end."""
        return self.c[-1] == 1

    def at(self, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Interpolation inside an interval at s in [0, 1], (K,): weights of stage values and of stage rates.

        Returns:
            Lagrange weights (K, d), so that u(s) = weights @ u_stages, and their integrals from 0 (K, d), so that
            x(s) = x_0 + h integrals @ f_stages.
        """
        powers = np.vander(s, self.d, increasing=True)  # (K, d)
        integrals = powers * np.asarray(s)[:, None] / np.arange(1, self.d + 1)
        inverse = np.linalg.inv(np.vander(self.c, self.d, increasing=True))
        return powers @ inverse, integrals @ inverse


@lru_cache
def scheme(name: str = "gauss", stages: int = 3) -> Scheme:
    """A collocation scheme of so many stages; Hermite–Simpson always has 3."""
    if name not in SCHEMES:
        raise UserError(f"unknown collocation scheme {name!r}; there are {', '.join(SCHEMES)}")
    fewest = 2 if name == "lobatto" else 1
    if not fewest <= stages <= 9:
        raise UserError(f"{name} with {stages} stages; allowed are {fewest} … 9")
    if name == "hermite-simpson":
        c, order = np.array([0.0, 0.5, 1.0]), 4
    elif name == "lobatto":  # the ends and the extrema of the Legendre polynomial
        inner = np.asarray(np.polynomial.legendre.Legendre.basis(stages - 1).deriv().roots(), float)
        c, order = np.r_[0.0, (np.sort(inner) + 1) / 2, 1.0], 2 * stages - 2
    elif name == "gauss":
        c, order = (np.asarray(np.polynomial.legendre.leggauss(stages)[0], float) + 1) / 2, 2 * stages
    else:
        c, order = np.array(ca.collocation_points(stages, "radau")), 2 * stages - 1
    d = len(c)
    inverse = np.linalg.inv(np.vander(c, d, increasing=True))
    integrals = np.vander(c, d, increasing=True) * c[:, None] / np.arange(1, d + 1)
    b = (1 / np.arange(1, d + 1)) @ inverse
    return Scheme(name, c, integrals @ inverse, b, order)


def uniform_mesh(problem: Problem, intervals: int) -> tuple[np.ndarray, ...]:
    """`intervals` equal fractions for each phase."""
    if intervals < 1:
        raise UserError(f"a mesh needs at least 1 interval a phase, got {intervals}")
    return tuple(np.full(intervals, 1 / intervals) for _ in problem.phases)


@dataclass(frozen=True, eq=False)
class _Block:
    """Where one phase's variables and rows stand."""

    duration: int
    nodes: np.ndarray  # (nx, N + 1)
    stage_x: np.ndarray  # (nx, d, N)
    stage_u: np.ndarray  # (nu, d, N)
    rows: slice
    gather: np.ndarray  # (nz, N): variables of each interval


@dataclass(frozen=True, eq=False)
class Transcription:
    """A problem on a mesh. Variables w = (p, and a phase at a time T, nodes, stages, controls), scaled.

    Attributes:
        mesh: For each phase the intervals' fractions of its duration, each (N,).
        compiled: Whether the intervals' functions run as C (a few times faster; some seconds to compile, once a machine).
            They cannot be differentiated any further.
    """

    problem: Problem
    scheme: Scheme
    mesh: tuple[np.ndarray, ...]
    compiled: bool = False

    @cached_property
    def blocks(self) -> tuple[_Block, ...]:
        """Layout of the variables and rows, phase by phase."""
        blocks, w, row = [], len(self.problem.parameters), 0
        s = self.scheme
        for phase, fractions in zip(self.problem.phases, self.mesh, strict=True):
            nx, nu, N = len(phase.states), len(phase.controls), len(fractions)
            duration, w = w, w + 1

            def take(*shape: int) -> np.ndarray:
                nonlocal w
                indices = w + np.arange(np.prod(shape, dtype=int)).reshape(shape, order="F")
                w += indices.size
                return indices

            nodes = take(nx, N + 1)
            own = [i for i in range(s.d) if not (i == 0 and s.shares_first) and not (i == s.d - 1 and s.shares_last)]
            stage_x = np.empty((nx, s.d, N), int)
            stage_x[:, own, :] = take(nx, len(own), N)
            stage_u = np.empty((nu, s.d, N), int)
            if s.shares_first:  # controls at nodes are shared too: the control is continuous
                stage_x[:, 0, :], node_u = nodes[:, :-1], take(nu, N + 1)
                stage_x[:, -1, :] = nodes[:, 1:]
                stage_u[:, 0, :], stage_u[:, -1, :] = node_u[:, :-1], node_u[:, 1:]
                stage_u[:, own, :] = take(nu, len(own), N)
            else:
                if s.shares_last:
                    stage_x[:, -1, :] = nodes[:, 1:]
                stage_u[:] = take(nu, s.d, N)
            gather = self._gather(duration, nodes, stage_x, stage_u, own)
            rows = slice(row, row + self._interval(phase).rows * N)
            row = rows.stop
            blocks.append(_Block(duration, nodes, stage_x, stage_u, rows, gather))
        return tuple(blocks)

    def _gather(self, duration, nodes, stage_x, stage_u, own) -> np.ndarray:
        N, n_p = nodes.shape[1] - 1, len(self.problem.parameters)
        shared = np.repeat(np.r_[np.arange(n_p), duration][:, None], N, axis=1)
        stages = stage_x[:, own, :].reshape(-1, N, order="F") if own else np.empty((0, N), int)
        controls = stage_u.reshape(-1, N, order="F")
        return np.vstack([shared, nodes[:, :-1], nodes[:, 1:], stages, controls])

    @cached_property
    def size(self) -> int:
        """Number of variables."""
        return int(self.blocks[-1].gather.max()) + 1

    @cached_property
    def scale(self) -> np.ndarray:
        """Magnitude of each variable (size,): value = scale * w."""
        scale = np.ones(self.size)
        scale[: len(self.problem.parameters)] = self.problem.p_scale
        for phase, block in zip(self.problem.phases, self.blocks, strict=True):
            for indices, magnitude in (
                (block.nodes, phase.x_scale),
                (block.stage_x, phase.x_scale),
                (block.stage_u, phase.u_scale),
            ):
                scale[indices] = np.reshape(magnitude, (-1,) + (1,) * (indices.ndim - 1))
        return scale

    @cached_property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Bounds of the scaled variables, (size,) each."""
        lower, upper = np.full(self.size, -np.inf), np.full(self.size, np.inf)
        n_p = len(self.problem.parameters)
        lower[:n_p], upper[:n_p] = self.problem.p_lower, self.problem.p_upper
        for phase, block in zip(self.problem.phases, self.blocks, strict=True):
            lower[block.duration], upper[block.duration] = phase.duration
            for side, x, u in ((lower, phase.x_lower, phase.u_lower), (upper, phase.x_upper, phase.u_upper)):
                side[block.nodes] = x[:, None]
                side[block.stage_x] = x[:, None, None]
                side[block.stage_u] = u[:, None, None]
            for node, values in ((0, phase.start), (-1, phase.end)):
                fixed = np.flatnonzero(~np.isnan(values))
                lower[block.nodes[fixed, node]] = upper[block.nodes[fixed, node]] = values[fixed]
        return lower / self.scale, upper / self.scale

    @cached_property
    def row_bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Bounds of the constraints, phase by phase, then the design's."""
        lower, upper = [], []
        for phase, fractions in zip(self.problem.phases, self.mesh, strict=True):
            N, defects = len(fractions), self._defects(phase)
            low = np.zeros((defects + self.scheme.d * len(phase.paths), N))
            high = np.zeros_like(low)
            low[defects:] = np.tile(phase.path_lower, self.scheme.d)[:, None]
            high[defects:] = np.tile(phase.path_upper, self.scheme.d)[:, None]
            if self.scheme.shares_first and phase.paths:  # the node's constraint stands once, with the interval before it
                low[defects : defects + len(phase.paths), 1:] = -np.inf
                high[defects : defects + len(phase.paths), 1:] = np.inf
            lower.append(low.ravel(order="F"))
            upper.append(high.ravel(order="F"))
        n_design = len(self.problem.designs)
        return np.concatenate([*lower, np.full(n_design, -np.inf)]), np.concatenate([*upper, np.zeros(n_design)])

    def row_name(self, row: int) -> str:
        """What a constraint is about, in words."""
        for phase, block, fractions in zip(self.problem.phases, self.blocks, self.mesh, strict=True):
            if row < block.rows.stop:
                per_interval = self._interval(phase).rows
                interval, local = divmod(row - block.rows.start, per_interval)
                time = f"at {np.cumsum(fractions)[interval]:.0%} of phase {phase.name!r}"
                if local < self._defects(phase):
                    return f"the motion of {phase.states[local % len(phase.states)]} {time}"
                return f"{phase.paths[(local - self._defects(phase)) % len(phase.paths)]} {time}"
        return self.problem.designs[row - self.blocks[-1].rows.stop]

    @property
    def path_rows(self) -> list[tuple[str, np.ndarray]]:
        """For each phase and path, in their order, the path's name and its rows."""
        found = []
        for phase, block, fractions in zip(self.problem.phases, self.blocks, self.mesh, strict=True):
            rows = np.arange(block.rows.start, block.rows.stop).reshape(len(fractions), -1)[:, self._defects(phase) :]
            found += [(name, rows[:, i :: len(phase.paths)].ravel()) for i, name in enumerate(phase.paths)]
        return found

    def _defects(self, phase: Phase) -> int:
        s = self.scheme
        return len(phase.states) * (s.d - s.shares_first + (not s.shares_last))

    def _interval(self, phase: Phase) -> "_Interval":
        problem = self.problem
        sizes = len(problem.parameters), problem.data.size
        return _interval(phase, self.scheme, *sizes, problem.cost_scale, self.compiled)

    def pack(self, guess: Guess) -> np.ndarray:
        """Scaled variables from a guess, states and controls sampled at the mesh's nodes and stages."""
        w = np.zeros(self.size)
        w[: len(self.problem.parameters)] = guess.parameters
        for block, fractions, motion in zip(self.blocks, self.mesh, guess.phases, strict=True):
            start = np.r_[0, np.cumsum(fractions)]
            stages = np.clip(start[:-1] + self.scheme.c[:, None] * fractions, 0, 1)  # (d, N)
            w[block.duration] = motion.duration
            w[block.stage_x] = motion.states(stages.ravel()).reshape(block.stage_x.shape)
            w[block.nodes] = motion.states(np.clip(start, 0, 1))
            w[block.stage_u] = motion.controls(stages.ravel()).reshape(block.stage_u.shape)
        return w / self.scale

    @cached_property
    def functions(self) -> dict[str, ca.Function]:
        """The nonlinear program for `casadi.nlpsol`: "nlp", "grad_f", "jac_g", "hess_lag", derivatives exact.

        Each interval's cost and rows depend on that interval's variables only. So their derivatives are one small symbolic
        function, mapped over the intervals and scattered into the sparse whole.
        """
        w, d = ca.MX.sym("w", self.size), ca.MX.sym("d", self.problem.data.size)
        lam_f, lam_g = ca.MX.sym("lam_f"), ca.MX.sym("lam_g", self.row_bounds[0].size)
        cost, gradient, rows = ca.MX(0), ca.MX(self.size, 1), []
        jacobian, hessian = _Scatter(), _Scatter()
        value = w * self.scale
        for phase, block, fractions in zip(self.problem.phases, self.blocks, self.mesh, strict=True):
            interval = self._interval(phase)
            N, nz = len(fractions), block.gather.shape[0]
            z = ca.reshape(value[block.gather.ravel(order="F").tolist()], nz, N)
            h, data, gather = ca.MX(ca.DM(fractions).T), ca.repmat(d, 1, N), block.gather
            magnitude = ca.DM(self.scale[gather])
            costs, g = interval.value.map(N)(z, h, data)
            cost, rows = cost + ca.sum2(costs), [*rows, ca.vec(g)]
            slopes = interval.gradient.map(N)(z, h, data) * magnitude
            gradient += _sum_into(self.size, gather, slopes)
            n_rows = interval.rows
            multipliers = ca.reshape(lam_g[block.rows], n_rows, N)
            row_of = block.rows.start + np.arange(n_rows)[:, None] + n_rows * np.arange(N)
            i, j = interval.jacobian_at
            values = interval.jacobian.map(N)(z, h, data)
            jacobian.add(row_of[i], gather[j], values * ca.DM(self.scale[gather[j]]))
            i, j = interval.hessian_at
            values = interval.hessian.map(N)(z, h, data, ca.repmat(lam_f, 1, N), multipliers)
            both = self.scale[gather[i]] * self.scale[gather[j]]
            hessian.add(np.minimum(gather[i], gather[j]), np.maximum(gather[i], gather[j]), values * ca.DM(both))
        self._add_design(value, d, lam_g, rows, jacobian, hessian)
        total_rows, triu = self.row_bounds[0].size, hessian.matrix(self.size, self.size)
        g, jac = ca.vertcat(*rows), jacobian.matrix(total_rows, self.size)
        return {
            "nlp": ca.Function("nlp", [w, d], [cost, g], ["x", "p"], ["f", "g"]),
            "grad_f": ca.Function("nlp_grad_f", [w, d], [cost, gradient], ["x", "p"], ["f", "grad_f_x"]),
            "jac_g": ca.Function("nlp_jac_g", [w, d], [g, jac], ["x", "p"], ["g", "jac_g_x"]),
            "hess_lag": ca.Function(
                "nlp_hess_l", [w, d, lam_f, lam_g], [triu], ["x", "p", "lam_f", "lam_g"], ["triu_hess_gamma_x_x"]
            ),
        }

    def _add_design(self, value, d, lam_g, rows, jacobian, hessian) -> None:
        design = self.problem.design
        if design is None:
            return
        n_p, start = len(self.problem.parameters), self.blocks[-1].rows.stop
        p, scale = value[:n_p], self.problem.p_scale
        rows.append(design(p, d))
        symbols = [ca.SX.sym("p", n_p), ca.SX.sym("d", d.size1()), ca.SX.sym("lam", len(self.problem.designs))]
        outputs = design(*symbols[:2])
        for scatter, expression, multipliers in (
            (jacobian, ca.jacobian(outputs, symbols[0]), ()),
            (hessian, ca.triu(ca.hessian(ca.dot(symbols[2], outputs), symbols[0])[0]), (lam_g[start:],)),
        ):
            function = ca.Function("derivative", symbols[: 2 + len(multipliers)], [expression])
            i, j = (np.array(k, int) for k in function.sparsity_out(0).get_triplet())
            values = ca.MX(function(p, d, *multipliers)).nz[:]
            magnitude = scale[j] if not multipliers else scale[i] * scale[j]
            offset = start if not multipliers else 0
            scatter.add((i + offset)[:, None], j[:, None], (values * ca.DM(magnitude)) if i.size else ca.MX(0, 1))


class _Scatter:
    """Collects entries of a sparse matrix, (rows, columns, values) of equal shape; entries at one place add up."""

    def __init__(self) -> None:
        self._rows: list[np.ndarray] = []
        self._columns: list[np.ndarray] = []
        self._values: list[ca.MX] = []

    def add(self, rows: np.ndarray, columns: np.ndarray, values: ca.MX) -> None:
        self._rows.append(rows.ravel(order="F"))
        self._columns.append(columns.ravel(order="F"))
        self._values.append(ca.vec(values))

    def matrix(self, n_rows: int, n_columns: int) -> ca.MX:
        rows, columns = np.concatenate(self._rows), np.concatenate(self._columns)
        keys, slot = np.unique(columns * n_rows + rows, return_inverse=True)
        sparsity = ca.Sparsity.triplet(n_rows, n_columns, (keys % n_rows).tolist(), (keys // n_rows).tolist())
        summed = ca.MX(_incidence(keys.size, slot)) @ ca.vertcat(*self._values)
        return ca.MX(sparsity, summed)


def _incidence(n_rows: int, slot: np.ndarray) -> ca.DM:
    """Sparse 0/1 matrix that adds value k to row slot[k]."""
    return ca.DM(ca.Sparsity.triplet(n_rows, slot.size, slot.tolist(), list(range(slot.size))), 1)


def _sum_into(size: int, gather: np.ndarray, values: ca.MX) -> ca.MX:
    return ca.MX(_incidence(size, gather.ravel(order="F"))) @ ca.vec(values)


@dataclass(frozen=True, eq=False)
class _Interval:
    """Functions of one interval, of z = (p, T, x_0, x_1, own stages, stage controls), unscaled; their outputs are dense.

    Rows: the stages' defects, the step's defect where the last stage is not the node, then the path constraints at each
    stage; defects are divided by the states' scales.

    Attributes:
        rows: Number of rows.
        value: (z, fraction, d) -> (cost, rows).
        gradient: (z, fraction, d) -> gradient of the cost (nz,).
        jacobian: (z, fraction, d) -> nonzeros of the rows' Jacobian, which stand at `jacobian_at` (rows, columns).
        hessian: (z, fraction, d, lam_f, lam_g) -> nonzeros of one triangle of the Lagrangian's Hessian, at `hessian_at`.
    """

    rows: int
    value: ca.Function
    gradient: ca.Function
    jacobian: ca.Function
    jacobian_at: tuple[np.ndarray, np.ndarray]
    hessian: ca.Function
    hessian_at: tuple[np.ndarray, np.ndarray]


@lru_cache(maxsize=64)
def _interval(phase: Phase, s: Scheme, n_p: int, n_d: int, cost_scale: float, compiled: bool) -> _Interval:
    nx, nu = len(phase.states), len(phase.controls)
    own = s.d - s.shares_first - s.shares_last
    p, T, h, d = ca.SX.sym("p", n_p), ca.SX.sym("T"), ca.SX.sym("h"), ca.SX.sym("d", n_d)
    x0, x1, X, U = ca.SX.sym("x0", nx), ca.SX.sym("x1", nx), ca.SX.sym("X", nx, own), ca.SX.sym("U", nu, s.d)
    stages = [*([x0] if s.shares_first else []), *ca.horzsplit(X), *([x1] if s.shares_last else [])]
    rates = [phase.rates(x, U[:, i], p, d) for i, x in enumerate(stages)]
    F, step = ca.horzcat(*[r[0] for r in rates]), h * T
    defects = [x - x0 - step * (F @ ca.DM(s.A[i])) for i, x in enumerate(stages) if not (i == 0 and s.shares_first)]
    if not s.shares_last:
        defects.append(x1 - x0 - step * (F @ ca.DM(s.b)))
    cost = step * sum(float(b) * r[1] for b, r in zip(s.b, rates, strict=True)) / cost_scale
    rows = ca.vertcat(*[defect / phase.x_scale for defect in defects], *[r[2] for r in rates])
    z = ca.vertcat(p, T, x0, x1, ca.vec(X), ca.vec(U))
    slopes = ca.jacobian(rows, z)
    jacobian_at = slopes.sparsity().get_triplet()
    gradient, hessian, hessian_at = _by_stages(phase, s, n_p, n_d, cost_scale)
    functions = [
        ca.Function("value", [z, h, d], [cost, ca.densify(rows)]),
        gradient,
        ca.Function("jacobian", [z, h, d], [slopes.nz[:]]),
        hessian,
    ]
    value, gradient, jacobian, hessian = _as_c(functions) if compiled else functions
    at = (np.array(jacobian_at[0], int), np.array(jacobian_at[1], int))
    return _Interval(rows.numel(), value, gradient, jacobian, at, hessian, hessian_at)


def _by_stages(phase: Phase, s: Scheme, n_p: int, n_d: int, cost_scale: float):
    """Gradient of an interval's cost and Hessian of its Lagrangian, from those of one stage at y = (p, T, x, u).

    Stage j's share of the Lagrangian, but for terms linear in z, is T (σ l − ν·f) + μ·path, where l is the cost rate,
    σ = h b_j lam_f / cost_scale, ν = h Σ_i A_ij λ_i / x_scale (and b_j times the step's multipliers), and λ_i and μ multiply
    the stage's defects and paths.
    """
    nx, nu, ng, d = len(phase.states), len(phase.controls), len(phase.paths), s.d
    y, data = ca.SX.sym("y", n_p + 1 + nx + nu), ca.SX.sym("d", n_d)
    sigma, nu_f, mu = ca.SX.sym("sigma"), ca.SX.sym("nu", nx), ca.SX.sym("mu", ng)
    p, T, x, u = ca.vertsplit(y, [0, n_p, n_p + 1, n_p + 1 + nx, y.numel()])
    f, rate, path = phase.rates(x, u, p, data)
    share = T * (sigma * rate - ca.dot(nu_f, f)) + ca.dot(mu, path)
    second = ca.triu(ca.hessian(share, y)[0])
    slope = ca.Function("slope", [y, data, sigma], [ca.densify(ca.gradient(T * sigma * rate, y))])
    curvature = ca.Function("curvature", [y, data, sigma, nu_f, mu], [second.nz[:]])
    i, j = (np.array(k, int) for k in second.sparsity().get_triplet())

    own = d - s.shares_first - s.shares_last
    shared, controls = np.arange(n_p + 1), n_p + 1 + (2 + own) * nx
    places = []  # of each stage's y in z
    for k in range(d):
        position = 0 if k == 0 and s.shares_first else 1 if k == d - 1 and s.shares_last else 2 + k - s.shares_first
        places.append(np.r_[shared, n_p + 1 + position * nx + np.arange(nx), controls + k * nu + np.arange(nu)])
    nz, n_defects = controls + d * nu, d - s.shares_first + (not s.shares_last)
    z, h, c = ca.MX.sym("z", nz), ca.MX.sym("h"), ca.MX.sym("d", n_d)
    lam_f, lam_g = ca.MX.sym("lam_f"), ca.MX.sym("lam_g", nx * n_defects + ng * d)
    weights = np.vstack([s.A[int(s.shares_first) :], *([] if s.shares_last else [s.b])])  # (n_defects, d)
    nu_all = ca.reshape(lam_g[: nx * n_defects], nx, n_defects) @ ca.DM(weights) * h / phase.x_scale
    mu_all = ca.reshape(lam_g[nx * n_defects :], ng, d)
    ys = [z[k.tolist()] for k in places]
    slopes = [slope(ys[k], c, h * float(s.b[k]) / cost_scale) for k in range(d)]
    summed = _sum_into(nz, np.concatenate(places), ca.vertcat(*slopes))
    gradient = ca.Function("gradient", [z, h, c], [ca.densify(summed)])  # nodes that are no stages have none
    curvatures = [curvature(ys[k], c, h * float(s.b[k]) / cost_scale * lam_f, nu_all[:, k], mu_all[:, k]) for k in range(d)]
    ends = [np.sort(np.vstack([k[i], k[j]]), axis=0) for k in places]
    keys, slot = np.unique(np.hstack([a * nz + b for a, b in ends]), return_inverse=True)
    hessian = ca.Function("hessian", [z, h, c, lam_f, lam_g], [_sum_into(keys.size, slot, ca.vertcat(*curvatures))])
    return gradient, hessian, (keys // nz, keys % nz)


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
