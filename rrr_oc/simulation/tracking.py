"""Reference motions followed in the physics engine, phase by phase, under the paper's controllers; what the engine then read."""

# pyright: reportAttributeAccessIssue=false
# (mujoco's wheel has no stubs)

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import mujoco
import numpy as np
from mujoco import rollout
from scipy.interpolate import Akima1DInterpolator, CubicHermiteSpline

from rrr_oc.errors import UserError
from rrr_oc.model import metrics
from rrr_oc.model.metrics import Metrics
from rrr_oc.model.symbolic_model import Model
from rrr_oc.simulation import generated_c as native
from rrr_oc.simulation.engine_model import DEFAULT, Controller, Settings, Twin, controller, twin


@dataclass(frozen=True)
class ReferencePhase:
    """A phase of motion to follow; joints that stand still have rows of their own.

    Attributes:
        name: Used in messages.
        t: Times [s], shape (K,), increasing.
        q, dq, ddq: Motion [rad, rad/s, rad/s²], shape (n, K).
        payload: Mass at the tool [kg].
        tau_load: Load torque of Eq. 6 [Nm], shape (n, K), fed forward.
    """

    name: str
    t: np.ndarray
    q: np.ndarray
    dq: np.ndarray
    ddq: np.ndarray
    payload: float
    tau_load: np.ndarray

    def __post_init__(self) -> None:
        if self.t.ndim != 1 or self.t.size < 3 or not np.all(np.diff(self.t) > 0):
            raise UserError(f"phase {self.name!r}: needs at least 3 increasing times, got an array of shape {self.t.shape}")
        for name in ("q", "dq", "ddq", "tau_load"):
            value = getattr(self, name)
            if value.shape != (self.q.shape[0], self.t.size) or not np.all(np.isfinite(value)):
                raise UserError(f"phase {self.name!r}: {name} must be finite, of shape (n, {self.t.size}), got {value.shape}")
        if not 0 <= self.payload < np.inf:
            raise UserError(f"phase {self.name!r}: payload {self.payload} kg must be finite and not negative")


@dataclass(frozen=True)
class TrackedPhase:
    """A phase as the engine moved it, at every step; joints (n,), time last.

    Attributes:
        t: Times on the reference's clock [s], shape (K,).
        q, dq, ddq: Motion [rad, rad/s, rad/s²], shape (n, K).
        tau_motor: Torque of the controllers, after the limits [Nm]: `qfrc_actuator`.
        tau_load: Load torque M ddq + C dq + G − tau_spring [Nm], shape (n, K): `mj_rne` at the engine's `qacc` (which knows
            no armature, so the motors' inertia and friction stand on the drive's side) less `qfrc_spring`.
        tau_spring: Torque of the effects on the links [Nm], shape (n, K): `qfrc_spring`.
        kinetic, potential: Energy of the links and payload [J], shape (K,): from the engine, without the armature's.
        stored: In springs [J], shape (K,): the engine's for native effects; of generated ones, which the engine knows only as
            torques, their own expression at the engine's positions.
        work_load, dissipated: Of tau_load, and in the joints' friction, since the start [J], shape (K,).
        reference: What was to be followed.
    """

    name: str
    payload: float
    t: np.ndarray
    q: np.ndarray
    dq: np.ndarray
    ddq: np.ndarray
    tau_motor: np.ndarray
    tau_load: np.ndarray
    tau_spring: np.ndarray
    kinetic: np.ndarray
    potential: np.ndarray
    stored: np.ndarray
    work_load: np.ndarray
    dissipated: np.ndarray
    reference: ReferencePhase

    @property
    def energy_residual(self) -> float:
        """Largest |change of kinetic, potential and stored energy − work of tau_load| over the work's total variation."""
        total = self.kinetic + self.potential + self.stored
        change = total - total[0] - self.work_load
        turnover = np.trapezoid(np.sum(np.abs(self.tau_load * self.dq), axis=0), self.t)
        return float(np.max(np.abs(change)) / max(turnover, 1e-12))

    @property
    def error(self) -> np.ndarray:
        """Largest |q − q_ref| of each joint [rad], shape (n,)."""
        return np.max(np.abs(self.q - _position(self.reference)(self.t)), axis=1)


@dataclass(frozen=True)
class Tracked:
    """A simulated task: its phases and what they were simulated with."""

    phases: tuple[TrackedPhase, ...]
    twin: Twin
    control: Controller
    settings: Settings

    @cached_property
    def metrics(self) -> Metrics:
        """E1, RMS and peak of the load torque that the engine gives."""
        return metrics.measure([(p.t, p.tau_load) for p in self.phases])

    @property
    def energy_residual(self) -> float:
        """The phases' largest."""
        return max(p.energy_residual for p in self.phases)

    @property
    def saturated(self) -> np.ndarray:
        """Whether each joint's controller ran into its limit, shape (n,)."""
        return np.any([np.any(np.abs(p.tau_motor) >= self.control.limit[:, None], axis=1) for p in self.phases], axis=0)


def track(
    model: Model,
    phases: Sequence[ReferencePhase],
    theta: Sequence[float] | np.ndarray = (),
    control: Controller | None = None,
    settings: Settings = DEFAULT,
    widths: np.ndarray | None = None,
) -> Tracked:
    """Follow a reference in the engine, phase after phase.

    A payload is held in the phases that have one, and let go between them. The reference between its points is the cubic
    with the points' q and dq (and dq with ddq), tau_load Akima's interpolant. The controllers read q and dq at every stage
    of a step, while q_ref, dq_ref and tau_ff pass linearly from one step to the next (under "rk4"; the other integrators hold
    them). Held over a step they would make the torque a saw-tooth of height k_p dq h (0.5 Nm here at 1 ms).

    Raises:
        UserError: As in `twin`; a gear gives; the reference has another number of joints; the simulation diverges.
    """
    control = controller(model) if control is None else control
    for phase in phases:
        if phase.q.shape[0] != model.robot.n:
            raise UserError(
                f"phase {phase.name!r} moves {phase.q.shape[0]} joints, but {model.robot.name!r} has {model.robot.n}"
            )
    engine = twin(model, theta, control, settings, widths)
    check_gears(engine)
    tracked: list[TrackedPhase] = []
    held: np.ndarray | None = None  # internal states of the effects
    with engine.effects():
        for phase in phases:
            if tracked and settings.start == "continue":
                start = tracked[-1].q[:, -1], tracked[-1].dq[:, -1]
            else:
                start = phase.q[:, 0], phase.dq[:, 0]
            held = held if settings.start == "continue" else None
            phase_found, held = _follow(engine, phase, control, start, settings.timestep, held)
            tracked.append(phase_found)
    return Tracked(tuple(tracked), engine, control, settings)


def check_gears(engine: Twin) -> None:
    """Raise `UserError` where a gear gives: a design's reference is that of the links, and drives would have to lead them."""
    if engine.gears:
        joints = ", ".join(engine.model.robot.joints[j] for j in engine.gears)
        raise UserError(
            f"the gear of {joints} gives, and a design's motion is that of the links; only recordings can be replayed"
        )


def _follow(
    engine: Twin, phase: ReferencePhase, control: Controller, start, timestep: float, held: np.ndarray | None
) -> tuple[TrackedPhase, np.ndarray]:
    """One phase: a roll-out in one call, then its states read one by one. And the internal states at its end; `held` at its start."""
    steps = max(1, int(np.ceil((phase.t[-1] - phase.t[0]) / timestep - 1e-9)))
    t = np.linspace(phase.t[0], phase.t[-1], steps + 1)
    engine.grip(phase.payload)
    engine.mj.opt.timestep = t[1] - t[0]
    data = mujoco.MjData(engine.mj)
    data.time, data.qpos[:], data.qvel[:] = t[0], *start
    u = _control_signal(phase, control, t)
    rest = [x for effect in engine.model.effects for x in effect.rest(phase.tau_load[:, 0])] if held is None else held
    u = np.vstack([u, *(np.full_like(t, x) for x in rest)])  # whose rates the effects set
    data.act[:] = u[:, 0]
    physics = mujoco.mjtState.mjSTATE_FULLPHYSICS
    initial = np.zeros(mujoco.mj_stateSize(engine.mj, physics))
    mujoco.mj_getState(engine.mj, data, initial, physics)
    states, _ = rollout.rollout(engine.mj, data, initial, (np.diff(u) / np.diff(t)).T)
    states = np.vstack([initial, np.asarray(states)[0]])[:, 1:]  # without time
    _check_finite(states, data, phase, t)
    count = len(engine.model.states)
    return _read(engine, phase, t, states), states[-1, states.shape[1] - count :]


def _position(phase: ReferencePhase) -> CubicHermiteSpline:
    return CubicHermiteSpline(phase.t, phase.q, phase.dq, axis=1)


def _control_signal(phase: ReferencePhase, control: Controller, t: np.ndarray) -> np.ndarray:
    """u = k_p q_ref + k_d dq_ref + tau_ff [Nm], shape (n, K)."""
    q, dq = _position(phase), CubicHermiteSpline(phase.t, phase.dq, phase.ddq, axis=1)
    tau = Akima1DInterpolator(phase.t, phase.tau_load, axis=1)
    return control.k_p[:, None] * q(t) + control.k_d[:, None] * dq(t) + tau(t)


def _check_finite(states: np.ndarray, data: mujoco.MjData, phase: ReferencePhase, t: np.ndarray) -> None:
    warnings = mujoco.mjtWarning
    counts = [data.warning[w].number for w in (warnings.mjWARN_BADQPOS, warnings.mjWARN_BADQVEL, warnings.mjWARN_BADQACC)]
    if any(counts) or not np.all(np.isfinite(states)):
        lost = np.flatnonzero(~np.all(np.abs(states) < 1e3, axis=1))
        when = f" near t = {t[lost[0]]:.4g} s" if lost.size else ""
        raise UserError(f"phase {phase.name!r}: the simulation diverges{when}; shorten the timestep or lower the gains")


def _read(engine: Twin, phase: ReferencePhase, t: np.ndarray, states: np.ndarray) -> TrackedPhase:
    m, d, n = engine.mj, mujoco.MjData(engine.mj), engine.model.robot.n
    fields = {"q": "qpos", "dq": "qvel", "ddq": "qacc", "tau_motor": "qfrc_actuator", "tau_spring": "qfrc_spring"}
    rows = {name: np.zeros((n, t.size)) for name in (*fields, "tau_load")}
    lost, kinetic, gravity, total, rne = (
        np.zeros((n, t.size)),
        np.zeros(t.size),
        np.zeros(t.size),
        np.zeros(t.size),
        np.zeros(n),
    )
    for k in range(t.size):
        d.time, d.qpos[:], d.qvel[:], d.act[:] = t[k], *np.split(states[k], [n, 2 * n])
        mujoco.mj_forward(m, d)
        mujoco.mj_rne(m, d, 1, rne)
        mujoco.mj_energyPos(m, d)
        mujoco.mj_energyVel(m, d)
        for name, field in fields.items():
            rows[name][:, k] = getattr(d, field)
        rows["tau_load"][:, k], lost[:, k] = rne - d.qfrc_spring, d.qfrc_damper + d.qfrc_constraint
        total[k], kinetic[k] = d.energy[0], d.energy[1] - m.dof_armature @ d.qvel**2 / 2
        gravity[k] = -m.body_mass @ (d.xipos @ m.opt.gravity)
    return TrackedPhase(
        name=phase.name,
        payload=phase.payload,
        t=t,
        **rows,
        kinetic=kinetic,
        potential=gravity,
        stored=total - gravity if engine.library is None else _stored(engine, rows["q"], rows["dq"], phase.payload),
        work_load=_since_start(np.sum(rows["tau_load"] * rows["dq"], axis=0), t),
        dissipated=_since_start(-np.sum(lost * rows["dq"], axis=0), t),
        reference=phase,
    )


def _stored(engine: Twin, q: np.ndarray, dq: np.ndarray, payload: float) -> np.ndarray:
    q = q + np.array(ca.evalf(native.shift(engine.model, engine.theta)))
    return np.asarray(engine.model.energy(q, dq, payload, engine.theta, engine.widths)[2]).reshape(-1)


def _since_start(power: np.ndarray, t: np.ndarray) -> np.ndarray:
    """∫ power dt from the first time on, by the trapezoid rule [J], shape (K,)."""
    return np.concatenate([[0.0], np.cumsum((power[1:] + power[:-1]) / 2 * np.diff(t))])
