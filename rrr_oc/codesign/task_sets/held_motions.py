"""The objective of a set of tasks on held motions, as a function of the springs alone."""

from collections.abc import Sequence

import casadi as ca
import numpy as np

from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.search.local_optima import SOLVED
from rrr_oc.codesign.task_sets.task_set import SetDesign
from rrr_oc.optimal_control.solver import Solution
from rrr_oc.optimal_control.transcription import Transcription


class SpringCost:
    """The cost of one task by its springs. The dynamics are evaluated once a motion, the springs for every set of parameters.

    Springs do not change what a motion needs in all, so the load torque is that need less the springs' torque.
    """

    def __init__(self, design: CoDesign, transcription: Transcription, data: np.ndarray) -> None:
        self.design, self.transcription = design, transcription
        self.widths = data[1 : 1 + design.model.widths.size]
        m, n_p = len(design.task.moving), len(design.problem.parameters)
        dq, ddq, q, need = (ca.SX.sym(name, m) for name in ("dq", "ddq", "q", "need"))
        payload, p, widths = ca.SX.sym("payload"), ca.SX.sym("p", n_p), ca.SX.sym("widths", self.widths.size)
        rate = design.cost_rate(dq, ddq, need - design.torques(q, dq, ddq, payload, p, widths)[1])
        outputs = [rate, ca.densify(ca.gradient(rate, p))]
        self._rate = ca.Function("rate", [q, dq, ddq, payload, need, p, widths], outputs)

    def along(self, w: np.ndarray, parameters: np.ndarray) -> tuple[list[np.ndarray], np.ndarray]:
        """A motion (scaled variables) at all stages: (q, dq, ddq, payload, need), each with one column a stage, and the weights of
        the quadrature [s]. Of the parameters (np,) only those of known effects matter."""
        empty, t = np.empty(0), self.transcription
        solution, m = Solution(t, w, empty, empty, 0.0, SOLVED, 0, 0.0), len(self.design.task.moving)
        columns, weights = [], []
        for i, (block, fractions) in enumerate(zip(t.blocks, t.mesh, strict=True)):
            x, u = solution.values[block.stage_x].reshape(2 * m, -1), solution.controls(i).reshape(m, -1)
            payload = np.full((1, x.shape[1]), self.design.task.payloads[i])
            columns.append(np.vstack([x, u, payload]))
            weights.append((solution.durations[i] * t.scheme.b[:, None] * fractions).ravel())
        q, dq, ddq, payload = np.split(np.hstack(columns), [m, 2 * m, 3 * m])
        need = sum(np.array(torque) for torque in self.design.torques(q, dq, ddq, payload, parameters, self.widths))
        return [q, dq, ddq, payload, np.asarray(need)], np.concatenate(weights)

    def __call__(self, columns: list[np.ndarray], weights: np.ndarray, parameters: np.ndarray) -> tuple[float, np.ndarray]:
        """The cost and its gradient by the parameters (np,)."""
        rate, slope = self._rate(*columns, parameters, self.widths)
        return float(np.array(rate).ravel() @ weights), np.array(slope) @ weights


class HeldMotions:
    """The objective on some motions.

    Args:
        costs: Of each task (T).
        motions: Scaled variables of each task (T).
        parameters: (np,); see `SpringCost.along`.
    """

    def __init__(
        self, design: SetDesign, costs: Sequence[SpringCost], motions: Sequence[np.ndarray], parameters: np.ndarray
    ) -> None:
        self._weights, self._costs = design.tasks.weights, costs
        self._along = [cost.along(w, parameters) for cost, w in zip(costs, motions, strict=True)]

    def cost(self, parameters: np.ndarray) -> tuple[float, np.ndarray]:
        """The objective and its gradient by the parameters (np,)."""
        found = [cost(*along, parameters) for cost, along in zip(self._costs, self._along, strict=True)]
        return sum(w * c for w, (c, _) in zip(self._weights, found, strict=True)), sum(
            w * g for w, (_, g) in zip(self._weights, found, strict=True)
        )
