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

import mujoco
import numpy as np
from mujoco import rollout

from rrr_oc.codesign.task import PHASES
from rrr_oc.errors import UserError
from rrr_oc.paper.encoding import Candidates, Encoding, Scores, load_torque, scores
from rrr_oc.simulation.engine_model import Controller, Settings, Twin, controller, twin

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
        q, forward = (values.reshape(rows) for values in (q, forward))
        after = speed[:, :, :, 1:].reshape(rows)
        found = self._follow(candidates, q, after, forward, speed[:, :, 0, 0])
        position, tau = found[0], found[1]
        h = candidates.durations / self.steps
        E1 = np.einsum("mpnk,pk->k", tau**2, h)
        return scores(design, candidates, E1, position, tau)

    def _follow(self, candidates: Candidates, q, after, forward, start) -> np.ndarray:
        """Positions and controllers' torques of the moving joints (2, m, phases, steps, K)."""
        task, control, moving = self.encoding.design.task, self._control, list(self.encoding.design.task.moving)
        n, (_, phases, steps, count) = task.robot.n, q.shape
        k_p, k_d = (v[moving].reshape(-1, 1, 1, 1) for v in (control.k_p, control.k_d))
        h = candidates.durations / steps  # (phases, K)
        u = np.zeros((phases, count, steps + 1, n))
        u[:, :, :steps, moving] = np.transpose(k_p * q + k_d * after + forward, (1, 3, 2, 0))
        u[:, :, steps] = u[:, :, steps - 1]
        initial = np.zeros((phases, count, 1 + 3 * n))  # time, q, dq, activations
        initial[:, :, [1 + j for j in moving]] = np.transpose(q[:, :, 0], (1, 2, 0))
        initial[:, :, [1 + n + j for j in moving]] = np.transpose(start, (1, 2, 0))
        initial[:, :, 1 + 2 * n :] = u[:, :, 0]
        models, data = self._models(candidates, h), self._data
        rates = (np.diff(u, axis=2) / h[:, :, None, None]).reshape(phases * count, steps, n)
        with self._twins[0].effects():
            states, _ = self._pool.rollout(models, data, initial.reshape(phases * count, -1), rates)
        states = np.concatenate([initial[:, :, None], np.asarray(states).reshape(phases, count, steps, -1)], axis=2)
        at, speed = (np.transpose(states[:, :, :, [first + j for j in moving]], (3, 0, 2, 1)) for first in (1, 1 + n))
        tau = np.transpose(u[:, :, :steps, moving], (3, 0, 2, 1)) - k_p * at[:, :, :-1] - k_d * speed[:, :, 1:]
        return np.stack([at[:, :, :-1], tau])

    def _models(self, candidates: Candidates, h: np.ndarray) -> list:
        """A model a phase and candidate, with the candidate's springs and step; made once, and set anew each time."""
        size = len(candidates.theta)
        while len(self._made[0]) < h.shape[1]:
            for made, engine in zip(self._made, self._twins, strict=True):
                made.append(copy(engine.mj))
        for made, steps in zip(self._made, h, strict=True):
            for mj, step, theta in zip(made, steps, candidates.theta.T, strict=False):
                mj.opt.timestep = step
                mj.numeric_data[:size] = theta  # which stand first in what the compiled springs read
        return [mj for made in self._made for mj in made[: h.shape[1]]]

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
            engine.grip(payload)
            engines.append(engine)
        return engines

    @cached_property
    def _pool(self) -> rollout.Rollout:
        return rollout.Rollout(nthread=self.threads if self.threads > 1 else 0)

    @cached_property
    def _data(self) -> list:
        return [mujoco.MjData(self._twins[0].mj) for _ in range(self.threads)]
