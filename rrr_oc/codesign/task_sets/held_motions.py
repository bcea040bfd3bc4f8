"""The cost of a task on a held motion, as a function of the springs alone."""

import casadi as ca
import numpy as np

from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.task import PHASES
from rrr_oc.optimal_control.solver import Solution
from rrr_oc.optimal_control.transcription import Transcription

Along = list[tuple[list[np.ndarray], np.ndarray]]  # for each phase: (q, dq, ddq, payload, need) at the stages, and weights [s]


class SpringCost:
    """The cost of one task by its springs. The dynamics are evaluated once a motion, the springs for every set of parameters.

    The torque that a motion needs without springs does not depend on them; the load torque is that torque minus the springs'.
    """

    def __init__(self, design: CoDesign, transcription: Transcription, data: np.ndarray) -> None:
        self.design, self.transcription = design, transcription
        self.widths = design.widths(data)
        self._rates = [self._rate(phase, design.power_width(data)) for phase in range(len(PHASES))]

    def _rate(self, phase: int, power: float) -> ca.Function:
        """(q, dq, ddq, payload, need, p, widths) -> the cost's rate and its gradient by p; `power` is the width of power [W]."""
        design, m = self.design, len(self.design.task.moving)
        q, dq, ddq, need = (ca.SX.sym(name, m) for name in ("q", "dq", "ddq", "need"))
        p, widths = ca.SX.sym("p", len(design.problem.parameters)), ca.SX.sym("widths", self.widths.size)
        payload = ca.SX.sym("payload")
        load = need - design.torques(q, dq, ddq, payload, design.engaged(phase, p), widths)[1]
        rate = design.cost_rate(dq, ddq, load, power)
        outputs = [rate, ca.densify(ca.gradient(rate, p))]
        return ca.Function("rate", [q, dq, ddq, payload, need, p, widths], outputs)

    def along(self, w: np.ndarray, parameters: np.ndarray) -> Along:
        """A motion (scaled variables) at all stages, for each phase: (q, dq, ddq, payload, need), each with one column a stage, and
        the weights of the quadrature [s]. Of the parameters (np,) only those of known effects matter."""
        t, m = self.transcription, len(self.design.task.moving)
        solution = Solution.bare(t, w)
        phases = []
        for i, (block, fractions) in enumerate(zip(t.blocks, t.mesh, strict=True)):
            x = solution.values[block.stage_x].reshape(len(block.stage_x), -1)
            ddq = self.design.accelerations(x, solution.controls(i).reshape(m, -1))
            columns = [x[:m], x[m : 2 * m], ddq, np.full((1, x.shape[1]), self.design.task.payloads[i])]
            torques = self.design.torques(*columns, self.design.engaged(i, parameters), self.widths)
            columns.append(np.array(torques[0]) + np.array(torques[1]))
            phases.append((columns, (solution.durations[i] * t.scheme.b[:, None] * fractions).ravel()))
        return phases

    def __call__(self, along: Along, parameters: np.ndarray) -> tuple[float, np.ndarray]:
        """The cost along a motion, as `along` gives it, and its gradient by the parameters (np,)."""
        total, slope = 0.0, np.zeros(len(parameters))
        for rate, (columns, weights) in zip(self._rates, along, strict=True):
            value, gradient = rate(*columns, parameters, self.widths)
            total += float(np.array(value).ravel() @ weights)
            slope += np.array(gradient) @ weights
        return total, slope
