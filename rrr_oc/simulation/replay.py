"""Recorded motions followed by a model in the engine, many candidates at once on all cores."""

# pyright: reportAttributeAccessIssue=false
# (mujoco's wheel has no stubs)

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from rrr_oc.model.motion import Motion
from rrr_oc.model.recorded_physics import Physics
from rrr_oc.model.symbolic_model import Model
from rrr_oc.numerics.savitzky_golay import differentiate
from rrr_oc.robot.robot import Robot
from rrr_oc.simulation.engine_model import Controller, Settings, Twin, controller, twin
from rrr_oc.simulation.generated_c import installed
from rrr_oc.simulation.rollout import Following, Simulated, State, Workers, linear, roll_out

SETTINGS = Settings(effects="native", timestep=1e-3, integrator="implicitfast")
BANDWIDTH = 40.0  # [rad/s], of controllers whose gains are not known
NO_LIMIT = 1e6  # [Nm]; a URDF's effort of 0 or beyond this means that none is known
ASTRAY = np.pi  # [rad]; a simulation further off the recording counts as diverged, and its numbers as unknown
# Of the largest payload; a smaller change does not begin a new piece: twice as much, and half as many pieces
PAYLOAD_STEP = 0.02
CHUNK = 4_000_000  # states of all candidates held in memory at once


@dataclass(frozen=True)
class Hidden:
    """Part of the state along a motion that no encoder sees.

    Attributes:
        twist: Positions and speeds of the links ahead of their drives, one below the other, (2 n, K) or more rows.
        effects: Internal states of the effects, (number, K).
    """

    twist: np.ndarray
    effects: np.ndarray


def tracking_controller(robot: Robot, k_p: float | None = None, recorded: np.ndarray | None = None) -> Controller:
    """Joint controllers that follow the recordings of a robot, limited to its efforts where these are known.

    Args:
        k_p: Gain [Nm/rad]; None: not known, a bandwidth of `BANDWIDTH` on the least inertia of each joint.
        recorded: Largest recorded torque of each joint [Nm], (n,); where it exceeds the effort, that is no limit.
    """
    plain = Model(robot, robot.tool)
    gain = BANDWIDTH**2 * plain.body.free_inertia(robot.inertial) if k_p is None else k_p
    most = np.zeros(robot.n) if recorded is None else recorded
    limit = np.where((robot.effort > most) & (robot.effort < NO_LIMIT), robot.effort, np.inf)
    return replace(controller(plain, gain), limit=limit)


def replay(physics: Physics, motion: Motion, control: Controller, forward: np.ndarray | None = None) -> Simulated:
    """The engine follows a recorded motion.

    Pieces between gaps, and between changes of the payload, are followed one by one, each from the recorded state.

    Args:
        forward: Torque that is fed forward to the controllers [Nm], (n, K); by default the motor torque of the model itself.
    """
    physics = physics.arm
    forward = physics.torques(motion)[0] if forward is None else forward
    engine = twin(physics.built, physics.theta, control, SETTINGS, physics.widths)
    hidden = Hidden(physics.twist(motion), physics.states(motion))
    q, dq, tau = (x[0] for x in follow([engine], motion, forward[None], as_recorded(control), hidden))
    ddq = load = np.full_like(q, np.nan)
    if not np.isnan(q).any():
        ddq = accelerations(motion, dq)
        load = physics.torques(Motion(motion.t, q, dq, ddq, motion.payload, motion.segments, motion.start))[1]
    return Simulated(motion.t, q, dq, ddq, motion.payload, motion.segments, motion.start, tau_motor=tau, tau_load=load)


def as_recorded(control: Controller, timestep: float = SETTINGS.timestep) -> Following:
    """How recordings are followed: under "implicitfast", without use of the noise in their accelerations."""
    return Following(control, timestep, lead=1.0, smooth=False, least=2)


def accelerations(motion: Motion, dq: np.ndarray) -> np.ndarray:
    """Derivative of speeds (…, n, K) along a motion [rad/s²]; where a piece is too short for one, as recorded."""
    flat = differentiate(motion.t, dq.reshape(-1, dq.shape[-1]), motion.segments).reshape(dq.shape)
    return np.where(np.isnan(flat) & np.isfinite(dq), motion.ddq, flat)


def follow(
    engines: Sequence[Twin], motion: Motion, forward: np.ndarray, following: Following, hidden: Hidden | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Several engines along one recorded motion.

    Args:
        forward: Torque fed forward [Nm], (engines, n, K): the motor torque that each model expects.
        hidden: Where each piece begins; without it links begin with their drives, and internal states at their nominal values.

    Returns:
        q, dq and motor torque at the motion's times, each (engines, n, K); NaN where a simulation diverged, and as recorded at a
        sample between two gaps.
    """
    found, alone = np.full((3, len(engines), *motion.q.shape), np.nan), np.ones(motion.t.size, bool)
    workers = Workers(min(len(engines), os.cpu_count() or 1))
    with installed(*{engine.library for engine in engines if engine.library is not None}):
        for k in pieces(motion):
            alone[k] = False
            start = motion.t[0] if motion.start is None else motion.start
            piece = Motion(motion.t[k], motion.q[:, k], motion.dq[:, k], motion.ddq[:, k], motion.payload[k], start=start)
            behind = None if hidden is None else Hidden(hidden.twist[:, k], hidden.effects[:, k])
            size = max(1, CHUNK // (len(following.grid(piece)[0]) * motion.q.size // len(motion.t) * 3))
            for first in range(0, len(engines), size):
                some = slice(first, first + size)
                found[:, some, :, k] = _follow(engines[some], piece, forward[some, :, k], following, behind, workers)
    for values, recorded in zip(found, (motion.q, motion.dq, forward), strict=True):
        values[..., alone] = recorded[..., alone]
    with np.errstate(invalid="ignore"):
        astray = ~(np.abs(found[0] - motion.q).max(axis=(1, 2)) < ASTRAY)
    found[:, astray] = np.nan
    return found[0], found[1], found[2]


def pieces(motion: Motion) -> list[slice]:
    """Slices of at least two samples within which there is neither a gap nor a change of payload above `PAYLOAD_STEP`."""
    result, payload = [], motion.payload
    step = PAYLOAD_STEP * float(payload.max())
    for s in motion.segments:
        ends = [s.start]
        for k in (np.flatnonzero(np.diff(payload[s])) + 1 + s.start).tolist():
            if abs(payload[k] - payload[ends[-1]]) > step and k - ends[-1] > 1 and s.stop - k > 1:
                ends.append(k)
        result += [slice(a, b) for a, b in pairwise([*ends, s.stop]) if b - a > 1]
    return result


def _follow(
    engines: Sequence[Twin],
    piece: Motion,
    forward: np.ndarray,
    following: Following,
    hidden: Hidden | None,
    workers: Workers,
) -> np.ndarray:
    """q, dq, torque (3, engines, n, K) along a piece of a motion; the torque of a step stands at its middle."""
    t, h = following.grid(piece)
    u = following.signal(piece, forward, t, h)
    for engine in engines:
        engine.set_payload(float(piece.payload[0]))
        engine.mj.dof_solref[:, 0] = 2 * h  # the hardest friction that the engine allows; by default it yields over 20 ms
    found = roll_out([engine.mj for engine in engines], u, h, _start(engines, piece, hidden), workers)
    q, dq = found.q[:, engines[0].dofs], found.dq[:, engines[0].dofs]
    torque = following.control.torque(u[:, :, :-1], q[:, :, :-1], dq[:, :, 1:])
    return np.stack([linear(piece.clock, *signal) for signal in ((t, q), (t, dq), (t[:-1] + h / 2, torque))])


def _start(engines: Sequence[Twin], piece: Motion, hidden: Hidden | None) -> State:
    """The first instant of a piece, for each engine."""
    first, n = engines[0], len(piece.q)
    twist = None if hidden is None else hidden.twist[: 2 * n, 0].reshape(2, n)
    start = first.coordinates(piece.q[:, 0], piece.dq[:, 0], twist)
    effects = np.array([s.nominal for s in first.model.states]) if hidden is None else hidden.effects[:, 0]
    q, dq, effects = (np.tile(x, (len(engines), 1)) for x in (*start, effects))
    return State(q, dq, effects, float(piece.clock[0]))
