"""D-optimal motions: Fourier series of greatest information within an arm's limits, by IPOPT from random starts."""

import math
import uuid
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from rrr_oc.errors import UserError
from rrr_oc.excitation.fourier_series import Series
from rrr_oc.excitation.information import Information
from rrr_oc.excitation.limits import UNITS, PathLimits, Rig, signals, states_within
from rrr_oc.model.motion import Motion
from rrr_oc.parallel import once_per_process, unordered

STEP = 0.01  # default sampling of a planned recording [s]
MOST = 1_000_000  # samples of a motion; doubled, a file of seven joints has 800 MB


def times(duration: float, step: float) -> np.ndarray:
    """Sampling times from 0 to the duration [s]; raises `UserError` for a step that is not within it, or more than `MOST` of them."""
    if not 0 < step <= duration:
        raise UserError(f"the sampling step must be above 0 and at most the duration, {duration:g} s, got {step:g} s")
    if duration / step >= MOST:
        raise UserError(
            f"a motion of {duration:g} s has more than {MOST} samples of {step:g} s; at most {MOST * step:g} s are allowed"
        )
    return np.linspace(0, duration, round(duration / step) + 1)


@dataclass(frozen=True)
class ExcitationSearch:
    """How a motion is searched for.

    Attributes:
        duration: Of the motion [s].
        harmonics: Of the base frequency 1/duration.
        starts: Random starts from which IPOPT runs: the best of `draws` a start.
        draws: Random motions drawn for each start.
        seed: Of the random motions.
        iterations: Limit, of each run of IPOPT.
        step: Sampling of the result [s].
    """

    duration: float = 20.0
    harmonics: int = 8
    starts: int = 3
    draws: int = 30
    seed: int = 0
    iterations: int = 150
    step: float = STEP

    def __post_init__(self) -> None:
        if not 0 < self.duration < math.inf:
            raise UserError(f"duration must be above 0 and finite, got {self.duration} s")
        if self.harmonics < 3:
            raise UserError(f"harmonics must be 3 or more, so that a motion is left that starts at rest, got {self.harmonics}")
        for name in ("starts", "draws", "iterations"):
            if getattr(self, name) < 1:
                raise UserError(f"{name} must be 1 or more, got {getattr(self, name)}")
        times(self.duration, self.step)


@dataclass(frozen=True, eq=False)
class Excitation:
    """A motion found, and statistics of the search.

    Attributes:
        motion: The motion; it starts and ends at the same pose, at rest.
        log_det: Of S on the motion's samples [nat].
        drawn: The cost, −log det S / its size, of all random motions drawn.
        solved: The cost where IPOPT ended from each start; infinite where a limit is broken.
        status: IPOPT's return status of the best run; at the limit of iterations the motion is usable, but no local optimum.
    """

    motion: Motion
    log_det: float
    drawn: np.ndarray
    solved: np.ndarray
    status: str


def excite(
    information: Information,
    search: ExcitationSearch = ExcitationSearch(),
    report: Callable[[int, float], None] = lambda done, value: None,
) -> Excitation:
    """The motion within a rig's limits of greatest information; raises `UserError` where none is found that keeps the limits.

    Args:
        report: Is told how many starts are done and the least cost so far, infinite where none keeps the limits yet.
    """
    rig, problem = information.rig, _problem(information, search)
    starts, drawn = problem.starts()
    runs: dict[int, _Run] = {}
    report(0, math.inf)
    key = uuid.uuid4().hex
    for index, run in unordered(_solved, [(key, information, search, index, x) for index, x in enumerate(starts)]):
        runs[index] = run
        report(len(runs), min(run.value for run in runs.values()))
    best = min((runs[index] for index in range(len(starts))), key=lambda run: run.value)
    if not math.isfinite(best.value):
        worst = min(runs.values(), key=lambda run: run.violation)
        raise UserError(
            f"no motion found that keeps the limits: at best the {worst.violated} is broken by {worst.violation:.3g} "
            f"[{UNITS[worst.violated]}] ({worst.status} after {worst.iterations} iterations); loosen it or give more starts"
        )
    t = times(search.duration, search.step)
    motion = Motion(t, *problem.series.motion(best.x, rig.limits, t), np.full(len(t), rig.payload))
    solved = np.array([runs[index].value for index in range(len(starts))])
    return Excitation(motion, information.log_det(motion), drawn, solved, best.status)


def _solved(key: str, information: Information, search: ExcitationSearch, index: int, x: np.ndarray) -> tuple[int, "_Run"]:
    return index, once_per_process(key, lambda: _problem(information, search)).solve(x)


def _problem(information: Information, search: ExcitationSearch) -> "_Problem":
    return _Problem(information, Series(search.duration, search.harmonics), search)


@dataclass(frozen=True, eq=False)
class _Run:
    """Where IPOPT ended: coefficients, the cost (infinite where a limit is broken), and its return status."""

    x: np.ndarray
    value: float
    status: str
    iterations: int
    violation: float
    violated: str


@dataclass(frozen=True, eq=False)
class _Problem:
    """The nonlinear program: coefficients x, the criterion, limits on the grid."""

    information: Information
    series: Series
    search: ExcitationSearch

    @property
    def rig(self) -> Rig:
        return self.information.rig

    @cached_property
    def _symbols(self) -> tuple[ca.MX, list[ca.MX], list[ca.MX]]:
        """x (2 N − 1, moving), q, dq, ddq of all joints (n, M), and the moving ones (moving, M)."""
        limits, moving = self.rig.limits, self.rig.limits.moving
        x = ca.MX.sym("x", 2 * self.series.harmonics - 1, moving.size)
        place = ca.DM(np.eye(limits.lower.size)[:, moving])
        rows = [(ca.DM(basis) @ x).T for basis in self.series.basis(self.series.grid)]
        full = [place @ r for r in rows]
        full[0] += np.where(limits.lower == limits.upper, limits.lower, 0.0)[:, None]
        return x, full, rows

    @cached_property
    def criterion(self) -> ca.Function:
        """x -> the cost, −log det S / its size."""
        x, full, _ = self._symbols
        n, m = full[0].shape
        p = len(self.information.scale)
        values = self.information.rows.map(m)(*full)
        stacked = ca.vertcat(*[ca.reshape(values[i, :], p, m).T for i in range(n)])
        cost = -2 * ca.sum1(ca.log(ca.diag(_cholesky(p)(stacked.T @ stacked / m)))) / p
        return ca.Function("criterion", [ca.vec(x)], [cost])

    @cached_property
    def path(self) -> PathLimits:
        """The torque limits that motions may come near, and the floor."""
        return self.rig.path.near(states_within(self.rig.limits, 400, 0))

    @cached_property
    def linear(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """A, low and high with low ≤ A vec(x) ≤ high: ranges, speeds and accelerations on the grid."""
        limits, moving, m = self.rig.limits, self.rig.limits.moving, len(self.series.grid)
        middle, half = (limits.upper + limits.lower)[moving] / 2, (limits.upper - limits.lower)[moving] / 2
        rows, centres, rooms = [], [], []
        sizes = half, limits.speed[moving], limits.acceleration[moving]
        for basis, size, centre in zip(
            self.series.basis(self.series.grid), sizes, (middle, 0 * middle, 0 * middle), strict=True
        ):
            bounded = np.flatnonzero(np.isfinite(size))
            rows.append(np.kron(np.eye(moving.size)[bounded], basis))
            centres.append(np.repeat(centre[bounded], m))
            rooms.append(np.repeat(self.series.margin * size[bounded], m))
        centre, room = np.concatenate(centres), np.concatenate(rooms)
        return np.vstack(rows), centre - room, centre + room

    @cached_property
    def constraints(self) -> tuple[ca.Function, ca.Function]:
        """vec(x) -> the linear rows and, for each of the rig's path limits, its values on the grid; and vec(x) -> these and their
        Jacobian, by the chain rule through the motion, since CasADi's own needs a sweep for each coefficient.
        """
        x, full, _ = self._symbols
        n, moving, m, values = self.rig.limits.lower.size, self.rig.limits.moving, len(self.series.grid), self.path.function
        matrix = ca.sparsify(ca.DM(self.linear[0]))
        stacked = ca.vertcat(matrix @ ca.vec(x), ca.vec(values.map(m)(*full).T))
        motion = signals(n)
        local = ca.jacobian(values(*motion), ca.vertcat(*motion))[:, [k * n + int(j) for k in range(3) for j in moving]]
        slopes = ca.reshape(ca.Function("slopes", [*motion], [ca.densify(local)]).map(m)(*full), -1, m).T
        bases, r, blocks = [ca.DM(basis) for basis in self.series.basis(self.series.grid)], len(self.path.names), []
        for i in range(r):
            column = [[slopes[:, (k * moving.size + j) * r + i] for k in range(3)] for j in range(moving.size)]
            blocks.append(
                ca.horzcat(*[sum(ca.repmat(s, 1, b.shape[1]) * b for s, b in zip(c, bases, strict=True)) for c in column])
            )
        jacobian = ca.vertcat(matrix, *blocks)
        unused = ca.MX.sym("p", 0)
        return (
            ca.Function("constraints", [ca.vec(x)], [stacked]),
            ca.Function("jac_g", [ca.vec(x), unused], [stacked, jacobian], ["x", "p"], ["g", "jac_g_x"]),
        )

    @cached_property
    def solver(self) -> ca.Function:
        x = ca.MX.sym("x", self.criterion.size1_in(0))
        options = {
            "print_time": False,
            "jac_g": self.constraints[1],
            "ipopt": {
                "print_level": 0,
                "sb": "yes",
                "hessian_approximation": "limited-memory",
                "linear_solver": "mumps",
                "mu_init": 1e-2,
                "tol": 1e-4,  # of the cost per parameter; smaller differences of information do not matter to a user
                "constr_viol_tol": 1e-7,
                "bound_relax_factor": 0.0,
                "max_iter": self.search.iterations,
            },
        }
        return ca.nlpsol("excitation", "ipopt", {"x": x, "f": self.criterion(x), "g": self.constraints[0](x)}, options)

    def starts(self) -> tuple[list[np.ndarray], np.ndarray]:
        """The best random motion of each group of draws, those within torque limits and floor first; and the costs of all draws."""
        rng, s = np.random.default_rng(self.search.seed), self.search
        drawn = [self.series.random(self.rig.limits, rng) for _ in range(s.starts * s.draws)]
        values = np.array([self.value(x) for x in drawn])
        broken = np.array([max(self.rig.excess(*self._between(x)).values()) for x in drawn])
        keys = np.lexsort([values, np.maximum(broken, 0)])
        first = [next(k for k in keys if k // s.draws == i) for i in range(s.starts)]
        return [drawn[k] for k in first], values

    def solve(self, x: np.ndarray) -> _Run:
        """IPOPT from x, again with tighter torque limits and floor until they hold between the grid's points."""
        path, margin = self.path, np.zeros(len(self.path.names))
        run = self._run(x, margin)
        for _ in range(3):
            margin += 2 * np.maximum(path.excess(*self._between(run.x)), 0)
            crossed = np.any(path.low + margin >= path.high - margin)
            if run.violation <= 0 or run.violated not in path.names or crossed:
                break
            run = self._run(run.x, margin)
        return run

    def _run(self, x: np.ndarray, margin: np.ndarray) -> _Run:
        _, low, high = self.linear
        path, m = self.path, len(self.series.grid)
        low, high = np.append(low, np.repeat(path.low + margin, m)), np.append(high, np.repeat(path.high - margin, m))
        end = np.asarray(self.solver(x0=x.ravel("F"), lbg=low, ubg=high)["x"])
        x, stats = end.reshape(x.shape, order="F"), self.solver.stats()
        excess = self.rig.excess(*self._between(x))
        worst = max(excess, key=lambda kind: excess[kind])
        value = self.value(x) if excess[worst] <= 0 else math.inf
        return _Run(x, value, stats["return_status"], stats["iter_count"], excess[worst], worst)

    def value(self, x: np.ndarray) -> float:
        """The cost at coefficients (2 N − 1, moving joints)."""
        return float(np.asarray(self.criterion(x.ravel("F")))[0, 0])

    def _between(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The motion at 8 times as many points as the grid has."""
        count = 8 * len(self.series.grid)
        return self.series.motion(x, self.rig.limits, np.arange(count) * self.series.duration / count)


def _cholesky(p: int) -> ca.Function:
    """S -> R with S = Rᵀ R, (p, p) each; 1e-10 on the diagonal keeps it real."""
    matrix = ca.SX.sym("S", p, p)
    return ca.Function("cholesky", [matrix], [ca.chol(ca.tril2symm(ca.tril(matrix)) + 1e-10 * ca.SX.eye(p))])
