"""Gradient optima within the paper's parametrisation: what Akima's path through five points a phase costs against a free motion.

The variables are the springs' parameters, the durations and the points of `candidates.Encoding`; the cost is E1 by the same quadrature,
with derivatives through the path. Akima's weights have kinks where two neighbouring secants are equal, and so has a spring at its
equilibrium: both are smoothed, and the widths driven down together. What is reported is the cost of the same point with exact weights,
springs and penalties, as evolution sees it.
"""

import time
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from rrr_oc.codesign.proposals import decode, dimensions, motion_guess, sobol_points
from rrr_oc.codesign.task import PHASES
from rrr_oc.numerics import akima
from rrr_oc.optimal_control.problem import Guess
from rrr_oc.optimal_control.solver import Options
from rrr_oc.paper.encoding import NODES, Analytic, Encoding, Scores, excesses

WIDTHS = (0.1, 0.01, 0.001)  # of Akima's weights [rad], which weigh differences between steps from point to point
SPRINGS = (0.1, 0.02, 0.003)  # of the springs [rad], along with them
TIGHTER = 4  # rounds in which limits are narrowed by what the path exceeds them between the samples
FINE = 40  # nodes an interval of the reported cost


@dataclass(frozen=True)
class Restricted:
    """A local optimum within the parametrisation.

    Attributes:
        x: As a vector of the encoding, (size,).
        scores: Of that vector, by `Analytic` on a fine quadrature; arrays of one element.
        smooth: The cost that IPOPT saw with the last widths.
        core_s: Processor time [s].
    """

    x: np.ndarray
    scores: Scores
    smooth: float
    core_s: float

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
            more, above, bounds = self._phase(i, theta, T[i], via[i], widths[0], data, margin[:, i])
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

    def start_at(self, x: np.ndarray) -> np.ndarray:
        """Variables of a vector of the encoding."""
        decoded = self.encoding.decode(x[None])
        _, T, via = self.encoding.split(self.encoding.values(x[None]))
        return np.concatenate([decoded.theta[:, 0], T[:, 0], *[np.ravel(v[:, :, 0], order="F") for v in via]])

    def cost(self, w: np.ndarray, widths: tuple[float, float], margin: np.ndarray) -> float:
        """The program's cost [N²m²s] of variables, with the widths of Akima's weights and of the springs [rad]."""
        return float(self._f(w / self._scale, widths, margin)) * self.encoding.design.problem.cost_scale

    def solve(self, start: np.ndarray) -> Restricted | None:
        """The optimum near a start; None where IPOPT finds none."""
        began, w = time.process_time(), start
        margin = np.zeros((3 * len(self.encoding.design.task.moving), len(PHASES)))
        smooth = np.inf
        for k, widths in enumerate(zip(WIDTHS, SPRINGS, strict=True)):
            solved = self._run(k > 0, w, widths, margin)
            if solved is None:
                return None
            w, smooth = solved
        for _ in range(TIGHTER):
            x = self._vector(w)
            over = excesses(self.encoding.design, self.encoding.decode(x[None]))[:, :, :, 0]  # (kinds, phases, m)
            if over.max() < 1e-9:
                break
            margin += 1.02 * np.transpose(over, (0, 2, 1)).reshape(margin.shape) + 1e-9
            solved = self._run(True, w, (WIDTHS[-1], SPRINGS[-1]), margin)
            if solved is None:
                return None
            w, smooth = solved
        x = self._vector(w)
        return Restricted(x, Analytic(self.encoding, FINE)(x[None]), smooth, time.process_time() - began)

    def _vector(self, w: np.ndarray) -> np.ndarray:
        task, n = (
            self.encoding.design.task,
            len(self._box[0]) - len(PHASES) * (1 + len(self.encoding.design.task.moving) * self.encoding.via),
        )
        via = w[n + len(PHASES) :].reshape(len(PHASES), self.encoding.via, len(task.moving))
        return self.encoding.encode(w[:n], w[n : n + len(PHASES)], np.swapaxes(via, 1, 2))

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

    def _phase(self, i: int, theta, T, via, width, data, margin) -> tuple[ca.MX, ca.MX, np.ndarray]:
        """Cost of a phase, and rows that may not exceed the bounds that come third."""
        design, m = self.encoding.design, via.shape[0]
        phase, task, h = design.problem.phases[i], design.task, T / (self.encoding.via + 1)
        start, end = (ca.MX(x) for x in task.ends(i))
        points = [start, *ca.horzsplit(via), end]
        nodes, weights = np.polynomial.legendre.leggauss(NODES)
        cubics = akima.cubics(points, design.at_rest, width)
        samples = [akima.motion(c, (s + 1) / 2, h) for c in cubics for s in nodes]
        ends = [akima.motion(c, s, h) for c in cubics for s in (0, 0.25, 0.5, 0.75, 1)]
        count = len(samples)
        x = ca.horzcat(*[ca.vertcat(q, dq) for q, dq, _ in samples])
        u = ca.horzcat(*[ddq for _, _, ddq in samples])
        _, rate, path = phase.rates.map(count)(x, u, ca.repmat(theta, 1, count), ca.repmat(data, 1, count))
        cost = h * ca.dot(rate, ca.DM(np.tile(weights / 2, len(cubics))).T)
        rows, highest = [], []
        limits = (
            (0, task.lower, task.upper, np.ones(m)),
            *((k, -v, v, v) for k, v in ((1, task.speed), (2, task.acceleration))),
        )
        for kind, lower, upper, scale in limits:
            known = np.flatnonzero(np.isfinite(upper)).tolist()
            values = [point[kind] for point in (*ends, *(samples if kind < 2 else ()))]
            for value in values:
                for j in known:
                    narrowed = margin[kind * m + j]
                    rows += [value[j] / scale[j] + narrowed, -value[j] / scale[j] + narrowed]
                    highest += [upper[j] / scale[j], -lower[j] / scale[j]]
        flat = ca.vec(path)
        low, high = (np.tile(b, count) for b in (phase.path_lower, phase.path_upper))
        above, below = np.flatnonzero(np.isfinite(high)).tolist(), np.flatnonzero(np.isfinite(low)).tolist()
        rows += [flat[k] for k in above] + [-flat[k] for k in below]
        return cost, ca.vertcat(*rows), np.concatenate([highest, high[above], -low[below]])


def proposals(encoding: Encoding, count: int, seed: int) -> list[Guess]:
    """Sobol starts as the free search's: springs, durations and smooth paths with two points a phase and joint."""
    design, via = encoding.design, 2
    return [motion_guess(design, *decode(design, x, via)) for x in sobol_points(dimensions(design, via), count, seed)]


def _solver(nlp: dict[str, Any], options: Options, barrier: float | None) -> ca.Function:
    """IPOPT for a program; with a barrier, begun from it as near an optimum."""
    ipopt = replace(options, barrier=None).ipopt()
    if barrier is not None:
        ipopt |= {"mu_strategy": "monotone", "mu_init": barrier}
    every: dict[str, Any] = {"ipopt": ipopt, "print_time": False, "expand": True}
    return ca.nlpsol("restricted", "ipopt", nlp, every)
