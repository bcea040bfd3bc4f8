"""Recorded motions followed by the calibrated model in the engine, many candidates at once on all cores."""

# pyright: reportAttributeAccessIssue=false
# (mujoco's wheel has no stubs)

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import mujoco
import numpy as np
from mujoco import rollout
from scipy.interpolate import CubicHermiteSpline

from rrr_oc.calibration.calibrated_model import CalibratedModel
from rrr_oc.model.symbolic_model import Model
from rrr_oc.numerics.savitzky_golay import differentiate
from rrr_oc.recordings.recording import Recording, RecordingSet
from rrr_oc.robot.robot import BUNDLED
from rrr_oc.simulation.engine_model import K_P, Controller, Settings, Twin, controller, twin
from rrr_oc.simulation.generated_c import installed

SETTINGS = Settings(effects="native", timestep=1e-3, integrator="implicitfast")
BANDWIDTH = 40.0  # [rad/s], of controllers whose gains are not known
NO_LIMIT = 1e6  # [Nm]; a URDF's effort of 0 or beyond this means that none is known
ASTRAY = np.pi  # [rad] off the recording: a simulation that diverged
FELT = 0.02  # of the largest payload, by which it may change before the engine takes notice
CHUNK = 4_000_000  # states of all candidates held at once


@dataclass(frozen=True)
class Replayed:
    """What the engine did along a recording, at the recording's own times; joints (n,), time last.

    Attributes:
        q, dq, ddq: Motion [rad, rad/s, rad/s²], shape (n, K); ddq is the derivative of dq as in the recording's reader.
        tau_motor: Torque of the controllers [Nm], shape (n, K).
        tau_load: M ddq + C dq + G less the springs' torque along that motion [Nm], shape (n, K).

    All NaN where the simulation diverged.
    """

    q: np.ndarray
    dq: np.ndarray
    ddq: np.ndarray
    tau_motor: np.ndarray
    tau_load: np.ndarray


def tracking_controller(model: CalibratedModel, recordings: RecordingSet | None = None) -> Controller:
    """Joint controllers for a calibrated robot: `twin.controller`, with the paper's gain for its own arms.

    Of another robot's controllers nothing is known; they get a bandwidth of `BANDWIDTH` on the least inertia of each joint. The
    URDF's effort is their limit, but for joints whose recorded torque goes beyond it.
    """
    plain = Model(model.robot, model.tool)
    gain = K_P if model.source in BUNDLED else BANDWIDTH**2 * plain.body.free_inertia(model.robot.inertial)
    control, effort = controller(plain, gain), model.robot.effort
    most = np.zeros_like(effort)
    if recordings is not None:
        most = np.max([np.abs(recordings.output_torque(r)).max(axis=1) for r in recordings.recordings], axis=0)
    return replace(control, limit=np.where((effort > most) & (effort < NO_LIMIT), effort, np.inf))


def replay(model: CalibratedModel, recording: Recording, control: Controller) -> Replayed:
    """The engine follows a recording; the controllers are helped by the model's own motor torque, fed forward.

    Pieces between gaps, and between changes of the payload, are followed one by one, each from the recorded state.
    """
    physics = model.physics(recording)
    forward = physics.torques(recording)[0]
    engine = twin(physics.built, physics.theta, control, SETTINGS, physics.widths)
    start = physics.twist(recording), physics.states(recording)
    q, dq, tau = (x[0] for x in follow([engine], recording, control, forward[None], forward[None], SETTINGS.timestep, *start))
    if np.isnan(q).any():
        return Replayed(q, dq, np.full_like(q, np.nan), tau, np.full_like(q, np.nan))
    ddq = accelerations(recording, dq)
    moved = replace(recording, q=q, dq=dq, ddq=ddq)
    return Replayed(q, dq, ddq, tau, physics.torques(moved)[1])


def accelerations(recording: Recording, dq: np.ndarray) -> np.ndarray:
    """Derivative of speeds (…, n, K) along a recording; where a piece is too short for one, what was recorded."""
    flat = differentiate(recording.t, dq.reshape(-1, dq.shape[-1]), recording.segments).reshape(dq.shape)
    return np.where(np.isnan(flat) & np.isfinite(dq), recording.ddq, flat)


def follow(
    engines: Sequence[Twin],
    recording: Recording,
    control: Controller,
    forward: np.ndarray,
    expected: np.ndarray,
    timestep: float = SETTINGS.timestep,
    twist: np.ndarray | None = None,
    states: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Several engines along one recording.

    Args:
        forward: Torque fed forward [Nm], (engines, n, K).
        expected: Motor torque at the recorded motion [Nm], (engines, n, K): each piece starts where the controllers would hold
            it, q_ref − (expected − forward)/k_p.
        timestep: The longest [s].
        twist: By how much links are ahead of their drives, positions and speeds (and more) one below the other, (2 n, K) or more;
            where each piece starts, of joints whose gears give.
        states: Internal states of the effects, which each piece starts with, (number, K); nominal ones where not given.

    Returns:
        q, dq and motor torque at the recording's times, each (engines, n, K); NaN where a simulation diverged, and as recorded at a
        sample between two gaps.
    """
    found, parts = np.full((3, len(engines), *recording.q.shape), np.nan), pieces(recording)
    with installed(*{engine.library for engine in engines if engine.library is not None}):
        for piece in parts:
            steps = max(2, int(np.ceil((recording.t[piece.stop - 1] - recording.t[piece.start]) / timestep)))
            size = max(1, CHUNK // (steps * 3 * recording.q.shape[0]))
            for first in range(0, len(engines), size):
                some = slice(first, first + size)
                found[:, some, :, piece] = _follow(
                    engines[some], recording, piece, control, forward[some], expected[some], steps, twist, states
                )
    alone = np.ones(recording.t.size, bool)
    for piece in parts:
        alone[piece] = False
    found[0][..., alone], found[1][..., alone], found[2][..., alone] = (
        recording.q[:, alone],
        recording.dq[:, alone],
        forward[..., alone],
    )
    with np.errstate(invalid="ignore"):
        astray = ~(np.abs(found[0] - recording.q).max(axis=(1, 2)) < ASTRAY)  # the engine goes on from zero then
    found[:, astray] = np.nan
    return found[0], found[1], found[2]


def pieces(recording: Recording) -> list[slice]:
    """Slices of at least two samples within which there is neither a gap nor a change of payload to speak of (`FELT`)."""
    result, payload = [], recording.payload
    felt = FELT * float(payload.max())
    for s in recording.segments:
        ends = [s.start]
        for k in (np.flatnonzero(np.diff(payload[s])) + 1 + s.start).tolist():
            if abs(payload[k] - payload[ends[-1]]) > felt and k - ends[-1] > 1 and s.stop - k > 1:
                ends.append(k)
        result += [slice(a, b) for a, b in pairwise([*ends, s.stop]) if b - a > 1]
    return result


def _follow(
    engines, recording: Recording, piece: slice, control: Controller, forward, expected, steps: int, twist, states
) -> np.ndarray:
    """q, dq, torque (3, engines, n, samples of the piece).

    Over a step the integrator damps with the speed at its end and holds all else of its start. So dq_ref is led by a step, and the
    torque of a step is u − k_p q of its start less k_d dq of its end; otherwise k_d would stand k_d h ddq in the torque, which
    looks like armature.
    """
    t = recording.clock[piece]
    fine, h = np.linspace(t[0], t[-1], steps + 1, retstep=True)
    q, dq = recording.q[:, piece], recording.dq[:, piece]
    k_p, k_d = control.k_p[:, None], control.k_d[:, None]
    aim = k_p * CubicHermiteSpline(t, q, dq, axis=1)(fine) + k_d * _linear(fine + h, t, dq)
    u = aim + np.stack([_linear(fine, t, f) for f in forward[:, :, piece]])  # (engines, n, steps + 1)
    start = q[:, 0] - (expected[:, :, piece.start] - forward[:, :, piece.start]) / control.k_p
    held = [s.nominal for s in engines[0].model.states] if states is None else states[:, piece.start]
    held = np.tile(held, (len(engines), 1))  # (engines, states)
    n, seats, gears, count = len(q), engines[0].seats, list(engines[0].gears), engines[0].mj.nv
    initial = np.zeros((len(engines), 1 + 2 * count))
    initial[:, 0], initial[:, 1 + seats], initial[:, 1 + count + seats] = t[0], start, dq[:, 0]
    if gears and twist is not None:
        initial[:, 2 + seats[gears]] = twist[gears, piece.start]
        initial[:, 2 + count + seats[gears]] = twist[[n + j for j in gears], piece.start]
    initial = np.concatenate([initial, u[:, :, 0], held], axis=1)
    models = []
    for engine in engines:
        engine.grip(float(recording.payload[piece.start]))
        engine.mj.opt.timestep = h
        engine.mj.dof_solref[:, 0] = 2 * h  # the hardest friction that the engine allows; by default it yields over 20 ms
        models.append(engine.mj)
    threads = min(len(models), os.cpu_count() or 1)
    data = [mujoco.MjData(models[0]) for _ in range(threads)]
    rates = np.moveaxis(np.diff(u) / h, 1, 2)
    rates = np.concatenate([rates, np.zeros((*rates.shape[:2], held.shape[1]))], axis=2)  # which the effects set
    with rollout.Rollout(nthread=threads if threads > 1 else 0) as pool:
        found = np.asarray(pool.rollout(models, data, initial, rates)[0])  # (engines, steps, 1 + 2 nv + n + states)
    found = np.moveaxis(np.concatenate([initial[:, None], found], axis=1), 1, 2)
    at, speed, activation = (
        found[:, first + which] for first, which in ((1, seats), (1 + count, seats), (1 + 2 * count, np.arange(n)))
    )
    torque = (activation - k_p * at)[:, :, :-1] - k_d * speed[:, :, 1:]
    torque = np.clip(torque, -control.limit[:, None], control.limit[:, None])
    return np.stack(
        [np.stack([_linear(t, x, one) for one in y]) for x, y in ((fine, at), (fine, speed), (fine[:-1] + h / 2, torque))]
    )


def _linear(t: np.ndarray, known: np.ndarray, values: np.ndarray) -> np.ndarray:
    return np.stack([np.interp(t, known, row) for row in values])
