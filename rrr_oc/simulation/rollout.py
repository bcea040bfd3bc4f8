"""References followed in the engine: control signals, many engines stepped by `mujoco.rollout`, and the states that they reach.

Tracking of designs, replay of recordings and the population of the paper's evolution are all followed in this way. They
differ in numbers only: the step, the integrator of the compiled models, and the instants at which the reference is read.
"""

# pyright: reportAttributeAccessIssue=false
# (mujoco's wheel has no stubs)

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import mujoco
import numpy as np
from mujoco import rollout
from scipy.interpolate import Akima1DInterpolator, CubicHermiteSpline

from rrr_oc.model.motion import Motion
from rrr_oc.simulation.engine_model import Controller


@dataclass(frozen=True, eq=False, kw_only=True)
class Simulated(Motion):
    """What the engine did; joints (n,), time last. All NaN where the simulation diverged.

    Attributes:
        tau_motor: Torque of the controllers, after the limits [Nm], shape (n, K).
        tau_load: Load torque M ddq + C dq + G − tau_spring along that motion [Nm], shape (n, K).
    """

    tau_motor: np.ndarray
    tau_load: np.ndarray


@dataclass(frozen=True)
class Following:
    """How a reference is followed: q_ref, dq_ref and tau_ff pass linearly from one step to the next.

    Attributes:
        control: The joint controllers.
        timestep: Longest step [s]; a motion is cut into equal steps no longer than this.
        lead: By how many steps dq_ref is read ahead. Under RK4, which reads the speed at every stage: 0. Under an integrator
            that damps with the speed at the step's end: 1; with 0 the torque would gain k_d h ddq, which looks like armature.
        smooth: Whether dq_ref and tau_ff are interpolated by cubics between samples; else linearly, as suits noisy samples.
        least: Smallest number of steps.
    """

    control: Controller
    timestep: float
    lead: float = 0.0
    smooth: bool = True
    least: int = 1

    def grid(self, motion: Motion) -> tuple[np.ndarray, float]:
        """Ends of the steps on the motion's clock [s], shape (S + 1,), and the step [s]."""
        steps = max(self.least, int(np.ceil((motion.t[-1] - motion.t[0]) / self.timestep)))
        first, last = motion.clock[[0, -1]].tolist()
        return np.linspace(first, last, steps + 1, retstep=True)

    def signal(self, motion: Motion, forward: np.ndarray, at: np.ndarray, h: float) -> np.ndarray:
        """u = k_p q_ref + k_d dq_ref + tau_ff [Nm] at times (S + 1,) of the motion's clock, shape (..., n, S + 1).

        Args:
            forward: Torque fed forward at the motion's samples [Nm], (..., n, K).
            h: The step [s].
        """
        t, ahead = motion.clock, at + self.lead * h
        q = position(motion)(at)
        if self.smooth:
            dq = CubicHermiteSpline(t, motion.dq, motion.ddq, axis=1)(ahead)
            return self.control.signal(q, dq, Akima1DInterpolator(t, forward, axis=-1)(at))
        return self.control.signal(q, linear(ahead, t, motion.dq), linear(at, t, forward))


def position(motion: Motion) -> CubicHermiteSpline:
    """q_ref over the motion's clock: the cubic with q and dq of the samples, (n,)."""
    return CubicHermiteSpline(motion.clock, motion.q, motion.dq, axis=1)


def linear(at: np.ndarray, t: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Signals (..., K) known at times t (K,), interpolated linearly, (..., S)."""
    rows = [np.interp(at, t, row) for row in values.reshape(-1, len(t))]
    return np.array(rows).reshape(*values.shape[:-1], len(at))


@dataclass(frozen=True)
class State:
    """State of B engines with nv coordinates, at one instant or, with time as a last axis, at several.

    Attributes:
        q, dq: Coordinates of the engine [rad] and their rates [rad/s], shape (B, nv).
        effects: Internal states of the effects, shape (B, number).
        time: [s].
    """

    q: np.ndarray
    dq: np.ndarray
    effects: np.ndarray
    time: float = 0.0


@dataclass(frozen=True)
class Workers:
    """Threads that step engines side by side; their pool lives as long as this object."""

    threads: int = 1

    @cached_property
    def pool(self) -> rollout.Rollout:
        """MuJoCo's pool, of no threads where one is enough."""
        return rollout.Rollout(nthread=self.threads if self.threads > 1 else 0)


def roll_out(models: Sequence, u: np.ndarray, h: float | np.ndarray, start: State, workers: Workers | None = None) -> State:
    """Engines stepped under their control signals, from a start.

    Args:
        models: B mjModels with the actuators of `Twin.mj`; their timestep is set.
        u: Control signals at the ends of the steps [Nm], (B, n, S + 1); linear in between.
        h: Step [s], (B,), or one for all.

    Returns:
        The states at the ends of the steps, (B, ·, S + 1), the start first. Of an engine that diverges they are far off or NaN.
    """
    workers, h = workers or Workers(), np.broadcast_to(np.asarray(h, float), (len(models),))
    for mj, step in zip(models, h, strict=True):
        mj.opt.timestep = step
    rates = np.moveaxis(np.diff(u) / h[:, None, None], 1, 2)
    rates = np.concatenate([rates, np.zeros((*rates.shape[:2], start.effects.shape[1]))], axis=2)  # which the effects set
    time = np.full((len(models), 1), start.time)
    initial = np.concatenate([time, start.q, start.dq, u[:, :, 0], start.effects], axis=1)
    data = [mujoco.MjData(models[0]) for _ in range(workers.threads)]
    found = np.asarray(workers.pool.rollout(list(models), data, initial, rates)[0])
    found = np.moveaxis(np.concatenate([initial[:, None], found], axis=1), 1, 2)
    count, n = start.q.shape[1], u.shape[1]
    return State(found[:, 1 : 1 + count], found[:, 1 + count : 1 + 2 * count], found[:, 1 + 2 * count + n :], start.time)
