"""What a population of the paper's parametrisation costs in MuJoCo: every candidate's phases followed in the engine, all at once.

A phase is cut into equal steps, so that all candidates can be rolled out together, each in a model with its own springs (their
exact law, as C), step and payload. The engine is integrated as a leapfrog, which is of second order: positions
stand in the middle of the steps, speeds at their ends, and a step's torque is u − k_p q of its middle less k_d dq of its end. So E1
is the midpoint rule over the drives' torques, and no jump of the acceleration falls on a sample. Load torque and reference are fed
forward; what the engine makes otherwise of a motion, its controllers have to add, and it counts.
"""

# pyright: reportAttributeAccessIssue=false
# (mujoco's wheel has no stubs)

from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from rrr_oc.codesign.task import PHASES
from rrr_oc.errors import UserError
from rrr_oc.simulation.engine_model import Controller, Settings, Twin, controller, twin
from rrr_oc.simulation.rollout import State, Workers, roll_out
from studies.paper.encoding import Candidates, Encoding, Scores, load_torque, scores

STEPS = 144  # a phase: E1 within 0.2 % (0.1 % on average) of its limit, and stable at 5 s a phase


@dataclass(frozen=True, eq=False)
class Engine:
    """The cost of candidates by the engine's own motion and torques.

    Attributes:
        encoding: What the vectors stand for.
        steps: A phase; a multiple of the path's intervals, so that accelerations jump between two steps.
        threads: That roll out, side by side.
    """

    encoding: Encoding
    steps: int = STEPS
    threads: int = 1

    def __post_init__(self) -> None:
        if self.steps < 1 or self.steps % (self.encoding.via + 1):
            raise UserError(
                f"steps a phase must be a multiple of the path's {self.encoding.via + 1} intervals, got {self.steps}"
            )

    def __call__(self, x: np.ndarray) -> Scores:
        """Cost of vectors (K, size)."""
        candidates = self.encoding.decode(x)
        design, count = self.encoding.design, candidates.durations.shape[1]
        per, moving = self.steps // (self.encoding.via + 1), list(design.task.moving)
        middle, ends = (np.arange(per) + 0.5) / per, np.arange(per + 1) / per
        q, dq, ddq = candidates.motion(middle)  # (m, phases, intervals, per, K)
        forward = load_torque(design, candidates.theta, q, dq, ddq)
        speed = candidates.motion(ends)[1]
        rows = (len(moving), len(PHASES), self.steps, count)
        reference = [self._all_joints(x.reshape(rows)) for x in (q, speed[:, :, :, 1:], forward)]
        at_rest = self._all_joints(speed[:, :, 0, :1])[:, :, 0]
        position, tau = self._follow(candidates, reference, at_rest)
        h = candidates.durations / self.steps
        E1 = np.einsum("mpnk,pk->k", tau**2, h)
        return scores(design, candidates, E1, position, tau)

    def _all_joints(self, values: np.ndarray) -> np.ndarray:
        """Signals of the moving joints (m, phases, S, K) as those of all joints, one phase and candidate after the other, (B, n, S)."""
        _, phases, steps, count = values.shape
        result = np.zeros((phases, count, self.encoding.design.task.robot.n, steps))
        result[:, :, list(self.encoding.design.task.moving)] = np.transpose(values, (1, 3, 0, 2))
        return result.reshape(phases * count, -1, steps)

    def _follow(self, candidates: Candidates, reference: list[np.ndarray], speed: np.ndarray) -> np.ndarray:
        """Positions and controllers' torques of the moving joints at the middles of the steps, (2, m, phases, steps, K).

        Args:
            reference: q_ref at the middles, dq_ref at the ends, tau_ff at the middles of the steps, (B, n, steps) each.
            speed: At the beginning, (B, n) [rad/s].
        """
        h = candidates.durations / self.steps  # (phases, K)
        u = self._control.signal(*reference)
        u = np.concatenate([u, u[:, :, -1:]], axis=2)
        start = State(reference[0][:, :, 0], speed, np.zeros((len(u), 0)))
        with self._twins[0].effects():
            found = roll_out(self._models(candidates), u, h.ravel(), start, self._workers)
        q = found.q[:, :, :-1]
        both = np.stack([q, self._control.torque(u[:, :, :-1], q, found.dq[:, :, 1:])])
        both = both[:, :, list(self.encoding.design.task.moving)].reshape(2, *h.shape, -1, self.steps)
        return np.ascontiguousarray(np.transpose(both, (0, 3, 1, 4, 2)))

    def _models(self, candidates: Candidates) -> list:
        """A model for each phase and candidate, with the candidate's springs; made once, and set anew each time."""
        size, count = candidates.theta.shape
        for made, engine in zip(self._made, self._twins, strict=True):
            made.extend(copy(engine.mj) for _ in range(count - len(made)))
            for mj, theta in zip(made, candidates.theta.T, strict=False):
                mj.numeric_data[:size] = theta  # which stand first in what the compiled springs read
        return [mj for made in self._made for mj in made[:count]]

    @cached_property
    def _made(self) -> list[list]:
        return [[] for _ in PHASES]

    @cached_property
    def _control(self) -> Controller:
        """The paper's, without limits: what the task allows is a penalty, as in the analytic model."""
        control = controller(self.encoding.design.model)
        return replace(control, limit=np.full_like(control.limit, np.inf))

    @cached_property
    def _twins(self) -> list[Twin]:
        """The engine with each phase's payload, springs exact."""
        model, engines = self.encoding.design.model, []
        settings = Settings(effects="generated", integrator="implicitfast")
        for payload in self.encoding.design.task.payloads:
            theta = [p.nominal for p in model.parameters]
            engine = twin(model, theta, self._control, settings, np.zeros(model.widths.size))
            engine.set_payload(payload)
            engines.append(engine)
        return engines

    @cached_property
    def _workers(self) -> Workers:
        return Workers(self.threads)
