# pyright: reportAttributeAccessIssue=false
"""The plant: exact signals of an arm that moves as planned (Pinocchio), or that a controller moves (MuJoCo)."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import mujoco
import numpy as np
import pinocchio as pin

from validation.chains.arms import Arm
from validation.chains.chain import FINE, rounded
from validation.chains.effects import Effect, Motion


@dataclass(frozen=True)
class Control:
    """A controller: PD with the gravity of the arm's file, in steps.

    Attributes:
        rate: Of its steps, over each of which it holds a torque [Hz].
        bandwidth: Of the position loop [rad/s].
        bits: Of the encoders that it sees.
        cutoff: Of its filter of the speed [Hz].
        gravity: Share of the gravity that it adds.
    """

    rate: float
    bandwidth: float = 20.0
    bits: int = 16
    cutoff: float = 60.0
    gravity: float = 1.0


class Exact(NamedTuple):
    """Exact signals at the fine rate: t (F,); at the encoders q, v, a; torque at its sensor tau; dry friction as the arm had it; pushes
    from outside, (n, F)."""

    t: np.ndarray
    q: np.ndarray
    v: np.ndarray
    a: np.ndarray
    tau: np.ndarray
    dry: np.ndarray
    pushed: np.ndarray


def torques(model: pin.Model, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
    """What the links need (n, K) [Nm]."""
    data = model.createData()
    return np.array([pin.rnea(model, data, *x) for x in zip(q.T, v.T, a.T, strict=True)]).T.reshape(q.shape)


def planned(arm: Arm, effects: Sequence[Effect], plan: tuple[np.ndarray, ...], pushed: np.ndarray) -> Exact:
    """Signals of an arm whose links move exactly as planned: t (F,), q, v, a (n, F)."""
    t, q, v, a = plan
    load = torques(arm.model, q, v, a)
    seen = [q.copy(), v.copy(), a.copy()]
    width = arm.kind.width or 0.005
    for effect in effects:
        for j, ahead in effect.of(Motion(q, v, np.tanh(v / width), load, t)) if effect.law.acts == "twist" else ():
            for row, x in zip(seen, (ahead, *derivatives(ahead)), strict=True):
                row[j] += x
    q, v, a = seen
    sign = np.tanh(v / width)
    dry = arm.dry[:, None] * sign
    tau = load + arm.rotor[:, None] * a + arm.viscous[:, None] * v + dry - pushed
    for effect in effects:
        for j, more in effect.of(Motion(q, v, sign, load, t)) if effect.law.acts == "motor" else ():
            tau[j] += more
    return Exact(t, q, v, a, tau, dry, pushed)


def derivatives(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """First and second, of a row at the fine rate."""
    first = np.gradient(x) * FINE
    return first, np.gradient(first) * FINE


def controlled(
    arm: Arm, listed: Arm, effects: Sequence[Effect], plan: tuple[np.ndarray, ...], pushed: np.ndarray, control: Control
) -> Exact:
    """Signals of an arm that a controller moves along a plan. Dry friction is the engine's constraint.

    Args:
        listed: The arm as its file has it, which is all that the controller knows.
    """
    t, q_plan, v_plan, _ = plan
    spec = mujoco.MjSpec.from_string(arm.urdf)
    model = spec.compile()
    model.opt.timestep = 1 / FINE
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT) | int(mujoco.mjtDisableBit.mjDSBL_LIMIT)
    model.dof_armature[:], model.dof_frictionloss[:] = arm.rotor, arm.dry
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = q_plan[:, 0], v_plan[:, 0]
    known, mass = listed.model, np.zeros((arm.n, arm.n))
    workspace = known.createData()
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, mass)
    kp, kd = control.bandwidth**2 * np.diag(mass), 1.6 * control.bandwidth * np.diag(mass)
    every, step = round(FINE / control.rate), 2 * np.pi / 2**control.bits
    share, before, speed, load = (
        1 - np.exp(-2 * np.pi * control.cutoff / control.rate),
        rounded(data.qpos, step),
        v_plan[:, 0],
        np.zeros(arm.n),
    )
    log, motor = np.zeros((5, arm.n, t.size)), np.zeros(arm.n)
    for k in range(t.size):
        mujoco.mj_step1(model, data)
        q, v = data.qpos.copy(), data.qvel.copy()
        if k % every == 0:
            read = rounded(q, step)
            speed = speed + share * ((read - before) * control.rate * (k > 0) + speed * (k == 0) - speed)
            before = read
            motor = kp * (q_plan[:, k] - read) + kd * (v_plan[:, k] - speed)
            motor = motor + control.gravity * pin.computeGeneralizedGravity(known, workspace, read)
        data.qfrc_applied[:] = motor - arm.viscous * v + pushed[:, k]
        if effects:
            x = Motion(q, v, np.tanh(v / 0.01), load, t[k])
            for effect in effects:
                for j, more in effect.of(x) if effect.law.acts == "motor" else ():
                    data.qfrc_applied[j] -= more
        mujoco.mj_step2(model, data)
        a, held = data.qacc, data.qfrc_constraint
        load = data.qfrc_applied + held - arm.rotor * a
        log[:, :, k] = q, v, a, motor, -held
    return Exact._make((t, *log, pushed))
