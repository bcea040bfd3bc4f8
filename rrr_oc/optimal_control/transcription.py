"""Direct collocation: an optimal-control problem on a mesh as a sparse nonlinear program with exact derivatives."""

from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from rrr_oc.errors import UserError
from rrr_oc.optimal_control.interval import Interval, interval_functions
from rrr_oc.optimal_control.problem import Guess, Phase, Problem, Side
from rrr_oc.optimal_control.scatter import Scatter, nonzeros_of, sum_into
from rrr_oc.optimal_control.scheme import Scheme

SAME_NODE = 1e-9  # [1] of a phase's time, within which a node is where a boundary is; doubled, nothing changes


@dataclass(frozen=True, eq=False)
class _Block:
    """Indices of one phase's variables and rows."""

    duration: int
    nodes: np.ndarray  # (nx, N + 1)
    stage_x: np.ndarray  # (nx, d, N)
    controls: np.ndarray  # (nu, d, N), see `Scheme.basis`
    rows: slice
    gather: np.ndarray  # (nz, N): variables of each interval


@dataclass(frozen=True, eq=False)
class _Program:
    """A nonlinear program that is being put together.

    Attributes:
        value: Variables in their own units.
        data: The problem's data.
        lam_g: Multipliers of the rows.
        rows: Constraints, in the order of `Transcription.row_bounds`.
        jacobian, hessian: Entries of the derivatives by the scaled variables.
    """

    value: ca.MX
    data: ca.MX
    lam_g: ca.MX
    rows: list[ca.MX]
    jacobian: Scatter
    hessian: Scatter


@dataclass(frozen=True, eq=False)
class Transcription:
    """A problem on a mesh. The scaled variables are w = (p, then for each phase T, nodes, stages, controls).

    Where the problem has several costs, the last variables are levels, one for each group, that its costs do not exceed, and whose
    sum is minimised.

    Attributes:
        mesh: For each phase the intervals' fractions of its duration, each (N,).
        compiled: Whether the intervals' functions run as C (a few times faster; some seconds to compile, once a machine).
            They cannot be differentiated any further.
    """

    problem: Problem
    scheme: Scheme
    mesh: tuple[np.ndarray, ...]
    compiled: bool = False

    def __getstate__(self) -> dict:
        """Without the compiled functions, which cannot be passed between processes."""
        return {name: value for name, value in self.__dict__.items() if name != "functions"}

    @cached_property
    def blocks(self) -> tuple[_Block, ...]:
        """Layout of the variables and rows, phase by phase."""
        blocks, n_p, row = [], len(self.problem.parameters), 0
        w, s = n_p, self.scheme
        for phase, fractions in zip(self.problem.phases, self.mesh, strict=True):
            nx, nu, N = len(phase.x), len(phase.u), len(fractions)
            duration, w = w, w + 1

            def take(*shape: int) -> np.ndarray:
                nonlocal w
                indices = w + np.arange(np.prod(shape, dtype=int)).reshape(shape, order="F")
                w += indices.size
                return indices

            nodes = take(nx, N + 1)
            stage_x, controls = np.empty((nx, s.d, N), int), np.empty((nu, s.d, N), int)
            stage_x[:, s.inner] = own = take(nx, len(s.inner), N)
            if s.shares_last:
                stage_x[:, -1] = nodes[:, 1:]
            if s.shares_first:  # controls at nodes are shared too: the control is continuous
                stage_x[:, 0], node_u = nodes[:, :-1], take(nu, N + 1)
                controls[:, 0], controls[:, -1] = node_u[:, :-1], node_u[:, 1:]
                controls[:, s.inner] = take(nu, len(s.inner), N)
            else:
                controls[:] = take(nu, s.d, N)
            shared = np.repeat(np.r_[np.arange(n_p), duration][:, None], N, axis=1)
            inside = [x.reshape(-1, N, order="F") for x in (own, controls)]
            gather = np.vstack([shared, nodes[:, :-1], nodes[:, 1:], *inside])
            rows = slice(row, row + self._interval(phase).rows * N)
            row = rows.stop
            blocks.append(_Block(duration, nodes, stage_x, controls, rows, gather))
        return tuple(blocks)

    @cached_property
    def size(self) -> int:
        """Number of variables."""
        return int(self.blocks[-1].gather.max()) + 1 + self.levels

    @property
    def levels(self) -> int:
        """Number of levels; none where the problem has one cost alone."""
        return len(set(self.problem.groups)) if self.leveled else 0

    @property
    def leveled(self) -> int:
        """Number of rows that hold a cost below a level."""
        return len(self.problem.groups) if len(self.problem.groups) > 1 else 0

    @cached_property
    def scale(self) -> np.ndarray:
        """Magnitude of each variable (size,): value = scale * w."""
        scale = np.ones(self.size)
        scale[: len(self.problem.parameters)] = self.problem.p_scale
        for phase, block in zip(self.problem.phases, self.blocks, strict=True):
            scale[block.nodes] = phase.x.scale[:, None]
            scale[block.stage_x] = phase.x.scale[:, None, None]
            scale[block.controls] = phase.u.scale[:, None, None]
        return scale

    @cached_property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Bounds of the scaled variables, (size,) each."""
        lower, upper = np.full(self.size, -np.inf), np.full(self.size, np.inf)
        n_p = len(self.problem.parameters)
        lower[:n_p], upper[:n_p] = self.problem.p_lower, self.problem.p_upper
        for phase, block in zip(self.problem.phases, self.blocks, strict=True):
            lower[block.duration], upper[block.duration] = phase.duration
            for side, x, u in ((lower, phase.x.lower, phase.u.lower), (upper, phase.x.upper, phase.u.upper)):
                side[block.nodes] = x[:, None]
                side[block.stage_x] = x[:, None, None]
                side[block.controls] = u[:, None, None]
            for node, values in ((0, phase.start), (-1, phase.end)):
                fixed = np.flatnonzero(~np.isnan(values))
                lower[block.nodes[fixed, node]] = upper[block.nodes[fixed, node]] = values[fixed]
        return lower / self.scale, upper / self.scale

    @cached_property
    def row_bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Bounds of the constraints, phase by phase, then the design's, those of the links, of the phases' boundaries,
        of the cycles, and of the costs."""
        sides = [], []
        for phase, fractions in zip(self.problem.phases, self.mesh, strict=True):
            first, paths = self._defects(phase), len(phase.path)
            for side, bound, none in zip(sides, (phase.path.lower, phase.path.upper), (-np.inf, np.inf), strict=True):
                rows = np.repeat(np.r_[np.zeros(first), np.tile(bound, self.scheme.d)][:, None], len(fractions), axis=1)
                if self.scheme.shares_first:  # the node's constraint stands once, with the interval before it
                    rows[first : first + paths, 1:] = none
                side.append(rows.ravel(order="F"))
        designs, equal = len(self.problem.designs), len(self._linked[0]) + sum(len(names) for *_, names in self._boundaries)
        cycles = np.array([cycle.duration for cycle in self.problem.cycles], float).reshape(-1, 2).T
        least = np.r_[np.full(designs, -np.inf), np.zeros(equal), cycles[0], np.full(self.leveled, -np.inf)]
        most = np.r_[np.zeros(designs + equal), cycles[1], np.zeros(self.leveled)]
        return np.concatenate([*sides[0], least]), np.concatenate([*sides[1], most])

    @cached_property
    def _linked(self) -> tuple[np.ndarray, np.ndarray]:
        """Variables that links set equal: those before and those after."""
        pairs = [
            (self.blocks[link.before].nodes[state, -1], self.blocks[link.after].nodes[state, 0])
            for link in self.problem.links
            for state in link.states
        ]
        before, after = np.array(pairs, int).reshape(-1, 2).T
        return before, after

    @property
    def _boundaries(self) -> list[tuple[ca.Function, np.ndarray | None, np.ndarray, tuple[str, ...]]]:
        """Boundary conditions of each phase: the function, indices of its data, of the states there, and names."""
        found = []
        for phase, block, fractions in zip(self.problem.phases, self.blocks, self.mesh, strict=True):
            for boundary in phase.boundaries:
                node, where = _node(boundary.end, fractions)
                names = tuple(f"{name} at {where} of {phase.name!r}" for name in boundary.names)
                found.append((boundary.function, phase.data, block.nodes[:, node], names))
        return found

    def row_name(self, row: int) -> str:
        """The name of a constraint and its instant, for messages."""
        for phase, block, fractions in zip(self.problem.phases, self.blocks, self.mesh, strict=True):
            if row < block.rows.stop:
                interval, local = divmod(row - block.rows.start, self._interval(phase).rows)
                path = local - self._defects(phase)
                motion = f"the motion of {phase.x.names[local % len(phase.x)]}"
                name = motion if path < 0 else phase.path.names[path % len(phase.path)]
                return f"{name} at {np.cumsum(fractions)[interval]:.0%} of phase {phase.name!r}"
        phases, links = self.problem.phases, self.problem.links
        ends = [
            f"{phases[link.before].x.names[i]} from {phases[link.before].name!r} to {phases[link.after].name!r}"
            for link in links
            for i in link.states
        ]
        bounded = [name for *_, names in self._boundaries for name in names]
        cycles = [f"duration of {' and '.join(phases[i].name for i in cycle.phases)}" for cycle in self.problem.cycles]
        names = [*self.problem.designs, *ends, *bounded, *cycles, *(f"cost {k + 1}" for k in range(self.leveled))]
        return names[row - self.blocks[-1].rows.stop]

    @property
    def path_rows(self) -> list[tuple[str, np.ndarray]]:
        """For each phase and path, in their order, the path's name and its rows."""
        found = []
        for phase, block, fractions in zip(self.problem.phases, self.blocks, self.mesh, strict=True):
            rows = np.arange(block.rows.start, block.rows.stop).reshape(len(fractions), -1)[:, self._defects(phase) :]
            found += [(name, rows[:, i :: len(phase.path)].ravel()) for i, name in enumerate(phase.path.names)]
        return found

    def _defects(self, phase: Phase) -> int:
        return len(phase.x) * self.scheme.defects

    def _interval(self, phase: Phase) -> Interval:
        d = self.problem.data.size if phase.data is None else len(phase.data)
        return interval_functions(phase, self.scheme, len(self.problem.parameters), d, self.compiled)

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
            values = motion.controls(stages.ravel()).reshape(block.controls.shape)
            w[block.controls] = np.einsum("kd,udn->ukn", np.linalg.inv(self.scheme.basis), values)
        w /= self.scale
        if self.levels:  # while the levels are 0, these rows are the costs
            costs = np.array(self.functions["nlp"](w, self.problem.data)[1]).ravel()[-self.leveled :]
            groups = np.array(self.problem.groups)
            w[-self.levels :] = [costs[groups == g].max() for g in range(self.levels)]
        return w

    @cached_property
    def functions(self) -> dict[str, ca.Function]:
        """The nonlinear program for `casadi.nlpsol`: "nlp", "grad_f", "jac_g", "hess_lag", derivatives exact.

        Each interval's cost and rows depend on that interval's variables only. So their derivatives are one small symbolic
        function, mapped over the intervals and scattered into the sparse whole.
        """
        w, d = ca.MX.sym("w", self.size), ca.MX.sym("d", self.problem.data.size)
        lam_f, lam_g = ca.MX.sym("lam_f"), ca.MX.sym("lam_g", self.row_bounds[0].size)
        lam_c = lam_g[-self.leveled :] if self.levels else lam_f
        costs, gradients = [ca.MX(0) for _ in self.problem.groups], [[] for _ in self.problem.groups]
        program = _Program(w * self.scale, d, lam_g, [], Scatter(), Scatter())
        value, rows, jacobian, hessian = program.value, program.rows, program.jacobian, program.hessian
        for phase, block, fractions in zip(self.problem.phases, self.blocks, self.mesh, strict=True):
            interval = self._interval(phase)
            N, nz = len(fractions), block.gather.shape[0]
            z = ca.reshape(value[block.gather.ravel(order="F").tolist()], nz, N)
            own, weight = list(phase.costs), phase.weight / self.problem.cost_scale
            h, gather = ca.MX(ca.DM(fractions).T), block.gather
            data = ca.repmat(d if phase.data is None else d[phase.data.tolist()], 1, N)
            each, g = interval.value.map(N)(z, h, data)
            rows.append(ca.vec(g))
            slopes = interval.gradient.map(N)(z, h, data)  # those of each interval's costs side by side
            for k, cost in enumerate(own):
                costs[cost] += weight * ca.sum2(each[k, :])
                gradients[cost].append((gather, slopes[:, k :: len(own)] * ca.DM(weight * self.scale[gather])))
            multipliers = ca.reshape(lam_g[block.rows], interval.rows, N)
            row_of = np.arange(block.rows.start, block.rows.stop).reshape(-1, N, order="F")
            i, j = interval.jacobian_at
            values = interval.jacobian.map(N)(z, h, data)
            jacobian.add(row_of[i], gather[j], values * ca.DM(self.scale[gather[j]]))
            i, j = interval.hessian_at
            values = interval.hessian.map(N)(z, h, data, ca.repmat(weight * lam_c[own], 1, N), multipliers)
            both = self.scale[gather[i]] * self.scale[gather[j]]
            hessian.add(np.minimum(gather[i], gather[j]), np.maximum(gather[i], gather[j]), values * ca.DM(both))
        self._add_design(program)
        self._add_links(program)
        self._add_boundaries(program)
        self._add_cycles(program)
        cost, gradient = self._objective(w, costs, gradients, program)
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

    def _objective(self, w, costs, gradients, program: _Program) -> tuple[ca.MX, ca.MX]:
        """The objective and its gradient; where there are several costs, adds the rows that hold each below its group's level."""
        if not self.levels:
            ((gather, slopes), *others) = gradients[0]
            gradient = sum((sum_into(self.size, *one) for one in others), sum_into(self.size, gather, slopes))
            return costs[0], ca.densify(gradient)
        levels, first = self.size - self.levels + np.array(self.problem.groups), self.row_bounds[0].size - self.leveled
        program.rows.append(ca.vertcat(*costs) - w[levels.tolist()])
        for k, entries in enumerate(gradients):
            for gather, slopes in entries:
                program.jacobian.add(np.full(gather.size, first + k), gather, slopes)
        program.jacobian.add(first + np.arange(levels.size), levels, ca.MX(ca.DM(-np.ones(levels.size))))
        own = np.where(np.arange(self.size) >= self.size - self.levels, 1.0, 0.0)
        return ca.sum1(w[-self.levels :]), ca.MX(ca.DM(own))

    def _add_links(self, program: _Program) -> None:
        """Rows that hold linked states equal, each divided by its scale."""
        before, after = self._linked
        if not before.size:
            return
        at = self.blocks[-1].rows.stop + len(self.problem.designs) + np.arange(before.size)
        unit = self.scale[before]
        program.rows.append((program.value[before.tolist()] - program.value[after.tolist()]) / ca.DM(unit))
        program.jacobian.add(at, before, ca.MX(ca.DM(self.scale[before] / unit)))
        program.jacobian.add(at, after, ca.MX(ca.DM(-self.scale[after] / unit)))

    def _add_design(self, program: _Program) -> None:
        design = self.problem.design
        if design is None:
            return
        p, data = (ca.SX.sym(name, design.size1_in(i)) for i, name in enumerate("pd"))
        own = ca.Function("design", [p, data], [design(p, data)])
        self._add_rows(program, own, np.arange(p.numel()), self.blocks[-1].rows.stop)

    def _add_boundaries(self, program: _Program) -> None:
        at = self.blocks[-1].rows.stop + len(self.problem.designs) + len(self._linked[0])
        n_p = len(self.problem.parameters)
        for boundary, which, nodes, names in self._boundaries:
            x, p = (ca.SX.sym(name, boundary.size1_in(i)) for i, name in enumerate("xp"))
            data = ca.SX.sym("d", self.problem.data.size)
            of_phase = data if which is None else data[which.tolist()]
            own = ca.Function("boundary", [ca.vertcat(p, x), data], [boundary(x, p, of_phase)])
            self._add_rows(program, own, np.r_[:n_p, nodes], at)
            at += len(names)

    def _add_cycles(self, program: _Program) -> None:
        """Rows with the durations of cycles."""
        at = self.row_bounds[0].size - self.leveled - len(self.problem.cycles)
        for k, cycle in enumerate(self.problem.cycles):
            own = [self.blocks[i].duration for i in cycle.phases]
            program.rows.append(ca.sum1(program.value[own]))
            program.jacobian.add(np.full(len(own), at + k), np.array(own), ca.MX(ca.DM(self.scale[own])))

    def _add_rows(self, program: _Program, function: ca.Function, indices: np.ndarray, at: int) -> None:
        """Rows from `at` on: a function of the variables at `indices`, in increasing order, in their own units, and of the data."""
        z, data = (ca.SX.sym(name, function.size1_in(i)) for i, name in enumerate(("z", "data")))
        outputs, lam, scale = function(z, data), ca.SX.sym("lam", function.size1_out(0)), self.scale[indices]
        where, d, own = program.value[indices.tolist()], program.data, program.lam_g[at : at + lam.numel()]
        program.rows.append(function(where, d))
        first, second = ca.jacobian(outputs, z), ca.triu(ca.hessian(ca.dot(lam, outputs), z)[0])
        slopes = ca.Function("slopes", [z, data], [first.nz[:]])(where, d)
        curvatures = ca.Function("curvatures", [z, data, lam], [second.nz[:]])(where, d, own)
        i, j = nonzeros_of(first.sparsity())
        program.jacobian.add(at + i, indices[j], slopes * ca.DM(scale[j].tolist()))
        i, j = nonzeros_of(second.sparsity())
        program.hessian.add(indices[i], indices[j], curvatures * ca.DM((scale[i] * scale[j]).tolist()))


def _node(end: Side | float, fractions: np.ndarray) -> tuple[int, str]:
    """Index of the node at an end of a phase or after a share of its time, and where that is, in words.

    Raises:
        UserError: The mesh has no node there.
    """
    if isinstance(end, str):
        return (0 if end == "start" else -1), f"the {end}"
    nodes = np.r_[0, np.cumsum(fractions)]
    node = int(np.abs(nodes - end).argmin())
    if abs(nodes[node] - end) > SAME_NODE:
        raise UserError(f"a mesh without a node at {end:g} of the time, where a boundary is; the nearest is at {nodes[node]:g}")
    return node, f"{end:.0%}"
