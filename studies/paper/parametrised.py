"""Gradient optima within the paper's parametrisation, by IPOPT.

The variables are the springs' parameters, the durations and the path points of `encoding.Encoding`; the cost is E1 by the same
quadrature, differentiated through Akima's path. Akima's weights have kinks where two neighbouring secants are equal, and a spring has
one at its equilibrium: both are smoothed, and the smoothing widths are reduced together. The reported cost is that of the same
variables with exact weights, springs and penalties, as evolution sees it.
"""

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from rrr_oc.codesign.search.proposals import dimensions, proposed_guess, sobol_points
from rrr_oc.codesign.task import PHASES
from rrr_oc.optimal_control.problem import Guess
from rrr_oc.optimal_control.solver import Options
from studies.paper import akima
from studies.paper.encoding import NODES, Analytic, Encoding, Scores, excesses

PATH_WIDTHS = (0.1, 0.01, 0.001)  # smoothing widths of Akima's weights [rad], one solve after the other
SPRING_WIDTHS = (0.1, 0.02, 0.003)  # smoothing widths of the springs [rad], along with those
# Rounds, at most, in which limits are narrowed by their excess between the samples; more would solve for less than 1e-9
TIGHTENINGS = 4
FINE_NODES = 40  # Gauss–Legendre nodes an interval of the reported cost


@dataclass(frozen=True)
class Restricted:
    """A local optimum within the parametrisation.

    Attributes:
        x: The optimum as a vector of the encoding, (size,).
        scores: Scores of that vector, by `Analytic` on a fine quadrature; arrays of one element.
        smooth: Smoothed cost with the smallest widths [N²m²s].
    """

    x: np.ndarray
    scores: Scores
    smooth: float

    @property
    def cost(self) -> float:
        """E1 with penalty [N²m²s]."""
        return float(self.scores.cost[0])


class RestrictedDesign:
    """The nonlinear program of an encoding: built once, solved from many starts."""

    def __init__(self, encoding: Encoding, options: Options | None = None) -> None:
        self.encoding = encoding
        problem, task = encoding.design.problem, encoding.design.task
        m, n = len(task.moving), len(problem.parameters)
        theta, T = ca.MX.sym("theta", n), ca.MX.sym("T", len(PHASES))
        via = [ca.MX.sym("via", m, encoding.via) for _ in PHASES]
        widths, margin = ca.MX.sym("widths", 2), ca.MX.sym("margin", 3 * m, len(PHASES))
        data = ca.MX(problem.data)
        data[1 : 1 + encoding.design.model.widths.size] = widths[1]
        cost, rows, highest = ca.MX(0), [], []
        for i in range(len(PHASES)):
            path = self._path(i, T[i], via[i], widths[0])
            more, above, bounds = self._phase(i, path, theta, data, margin[:, i])
            cost, rows, highest = cost + more, [*rows, above], [*highest, bounds]
        if problem.design is not None:
            rows.append(problem.design(theta, data))
            highest.append(np.zeros(len(problem.designs)))
        w = ca.vertcat(theta, T, *[ca.vec(v) for v in via])
        self._upper = np.concatenate(highest)
        self._scale = np.r_[problem.p_scale, np.ones(len(PHASES) + m * encoding.via * len(PHASES))]
        angles = [np.tile(b, encoding.via * len(PHASES)) for b in (task.lower, task.upper)]
        springs = problem.p_lower, problem.p_upper
        self._box = [np.r_[p, np.full(len(PHASES), d), a] for p, d, a in zip(springs, task.duration, angles, strict=True)]
        scaled = ca.MX.sym("scaled", w.numel())
        terms = ca.Function("terms", [w, widths, margin], [cost / problem.cost_scale, ca.vertcat(*rows)])
        f, g = terms(scaled * self._scale, widths, margin)
        options = options or Options(tolerance=1e-7, iterations=300)
        self._f = ca.Function("f", [scaled, widths, margin], [f])
        nlp = {"x": scaled, "f": f, "g": g, "p": ca.vertcat(widths, ca.vec(margin))}
        self._solvers = [_solver(nlp, options, barrier) for barrier in (None, 1e-4)]

    def start(self, guess: Guess) -> np.ndarray:
        """Variables (all of them, in their units) of a motion's springs, durations and angles at the points' times."""
        m, s = len(self.encoding.design.task.moving), np.arange(1, self.encoding.via + 1) / (self.encoding.via + 1)
        via = [np.ravel(phase.states(s)[:m], order="F") for phase in guess.phases]
        return np.concatenate([guess.parameters, [phase.duration for phase in guess.phases], *via])

    def cost(self, w: np.ndarray, widths: tuple[float, float], margin: np.ndarray) -> float:
        """The program's cost [N²m²s] of variables, with the widths of Akima's weights and of the springs [rad]."""
        return float(self._f(w / self._scale, widths, margin)) * self.encoding.design.problem.cost_scale

    def solve(self, start: np.ndarray) -> Restricted | None:
        """The optimum near a start; None where IPOPT finds none."""
        w = start
        margin = np.zeros((3 * len(self.encoding.design.task.moving), len(PHASES)))
        smooth = np.inf
        for k, widths in enumerate(zip(PATH_WIDTHS, SPRING_WIDTHS, strict=True)):
            solved = self._run(k > 0, w, widths, margin)
            if solved is None:
                return None
            w, smooth = solved
        for _ in range(TIGHTENINGS):
            x = self._vector(w)
            over = excesses(self.encoding.design, self.encoding.decode(x[None]))[:, :, :, 0]  # (kinds, phases, m)
            if over.max() < 1e-9:
                break
            margin += 1.02 * np.transpose(over, (0, 2, 1)).reshape(margin.shape) + 1e-9
            solved = self._run(True, w, (PATH_WIDTHS[-1], SPRING_WIDTHS[-1]), margin)
            if solved is None:
                return None
            w, smooth = solved
        x = self._vector(w)
        return Restricted(x, Analytic(self.encoding, FINE_NODES)(x[None]), smooth)

    def _vector(self, w: np.ndarray) -> np.ndarray:
        n, m = len(self.encoding.design.problem.parameters), len(self.encoding.design.task.moving)
        parameters, durations, points = np.split(w, [n, n + len(PHASES)])
        via = points.reshape(len(PHASES), self.encoding.via, m)
        return self.encoding.encode(parameters, durations, np.swapaxes(via, 1, 2))

    def _run(self, warm: bool, w: np.ndarray, widths, margin: np.ndarray) -> tuple[np.ndarray, float] | None:
        lower, upper = (b / self._scale for b in self._box)
        solver = self._solvers[warm]
        solved = solver(
            x0=np.clip(w / self._scale, lower, upper),
            p=np.r_[widths, np.ravel(margin, order="F")],
            lbx=lower,
            ubx=upper,
            lbg=-np.inf,
            ubg=self._upper,
        )
        if solver.stats()["return_status"] not in ("Solve_Succeeded", "Solved_To_Acceptable_Level"):
            return None
        return np.array(solved["x"]).ravel() * self._scale, float(solved["f"]) * self.encoding.design.problem.cost_scale

    def _path(self, i: int, T: ca.MX, via: ca.MX, width: Any) -> "_Path":
        design, h = self.encoding.design, T / (self.encoding.via + 1)
        start, end = (ca.MX(x) for x in design.task.ends(i))
        cubics = akima.cubics([start, *ca.horzsplit(via), end], design.task.at_rest, width)
        nodes, weights = np.polynomial.legendre.leggauss(NODES)
        samples = [akima.motion(c, (s + 1) / 2, h) for c in cubics for s in nodes]
        between = [akima.motion(c, s, h) for c in cubics for s in (0, 0.25, 0.5, 0.75, 1)]
        return _Path(h, samples, np.tile(weights / 2, len(cubics)), between)

    def _phase(self, i: int, path: "_Path", theta: ca.MX, data: ca.MX, margin: ca.MX) -> tuple[ca.MX, ca.MX, np.ndarray]:
        """Cost of a phase, expressions of its limits, and their upper bounds."""
        design, count = self.encoding.design, len(path.samples)
        phase, task, m = design.problem.phases[i], design.task, len(design.task.moving)
        x = ca.horzcat(*[ca.vertcat(q, dq) for q, dq, _ in path.samples])
        u = ca.horzcat(*[ddq for _, _, ddq in path.samples])
        _, rate, values = phase.rates.map(count)(x, u, ca.repmat(theta, 1, count), ca.repmat(data, 1, count))
        cost = path.h * ca.dot(rate, ca.DM(path.weights).T)
        rows, highest = [], []
        limits = (
            (0, task.lower, task.upper, np.ones(m)),
            *((k, -v, v, v) for k, v in ((1, task.speed), (2, task.acceleration))),
        )
        for kind, lower, upper, scale in limits:
            points = path.between if kind == 2 else [*path.between, *path.samples]
            for value in (point[kind] for point in points):
                for j in np.flatnonzero(np.isfinite(upper)).tolist():
                    narrowed = margin[kind * m + j]
                    rows += [value[j] / scale[j] + narrowed, -value[j] / scale[j] + narrowed]
                    highest += [upper[j] / scale[j], -lower[j] / scale[j]]
        flat = ca.vec(values)
        low, high = (np.tile(b, count) for b in (phase.path.lower, phase.path.upper))
        above, below = np.flatnonzero(np.isfinite(high)).tolist(), np.flatnonzero(np.isfinite(low)).tolist()
        rows += [flat[k] for k in above] + [-flat[k] for k in below]
        return cost, ca.vertcat(*rows), np.concatenate([highest, high[above], -low[below]])


class _Path(NamedTuple):
    """The motion of a phase, (q, dq, ddq) at every instant: `samples` at the quadrature nodes, whose weights are of an interval
    of length h [s], and `between` at quarters of the intervals, where limits are kept too."""

    h: ca.MX
    samples: list[tuple]
    weights: np.ndarray
    between: list[tuple]


def proposals(encoding: Encoding, count: int, seed: int) -> list[Guess]:
    """Starting points as those of a multistart: Sobol points for springs, durations and paths with two points a phase and joint."""
    design, via = encoding.design, 2
    return [proposed_guess(design, x, via) for x in sobol_points(dimensions(design, via), count, seed)]


def _solver(nlp: dict[str, Any], options: Options, barrier: float | None) -> ca.Function:
    """IPOPT for a program; with an initial barrier parameter, for starts near an optimum."""
    ipopt = replace(options, barrier=None).ipopt()
    if barrier is not None:
        ipopt |= {"mu_strategy": "monotone", "mu_init": barrier}
    every: dict[str, Any] = {"ipopt": ipopt, "print_time": False, "expand": True}
    return ca.nlpsol("restricted", "ipopt", nlp, every)
