"""Designs followed in the physics engine, phase by phase, under the paper's controllers, and the engine's torques and energies."""

# pyright: reportAttributeAccessIssue=false
# (mujoco's wheel has no stubs)

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import mujoco
import numpy as np

from rrr_oc.effects import WithStates
from rrr_oc.errors import UserError
from rrr_oc.model import metrics
from rrr_oc.model.metrics import Metrics
from rrr_oc.model.motion import Motion
from rrr_oc.model.symbolic_model import Model
from rrr_oc.simulation import generated_c
from rrr_oc.simulation.engine_model import DEFAULT, Controller, Settings, Twin, controller, twin
from rrr_oc.simulation.rollout import Following, Simulated, State, position, roll_out

DIVERGED = 1e3  # rad, rad/s; a simulation beyond is rejected: no arm gets there, and one that diverges passes it in a few steps


@dataclass(frozen=True, eq=False, kw_only=True)
class Reference(Motion):
    """A phase of motion to follow; joints that stand still have rows of their own, and the payload is constant.

    Attributes:
        name: Used in messages.
        feed_forward: Torque that the controllers add, such as the load torque of Eq. 6 [Nm], shape (n, K).
        theta: Parameters of the effects in this phase; None where they are the simulation's.
        twist: q, dq, ddq of the links less those of their drives, (3, n, K), which gears that give need; None for no such gears.
    """

    name: str
    feed_forward: np.ndarray
    theta: np.ndarray | None = None
    twist: np.ndarray | None = None

    @cached_property
    def drives(self) -> Motion:
        """The motion of the drives."""
        return self if self.twist is None else self.of_drives(self.twist)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.t.ndim != 1 or self.t.size < 3 or not np.all(np.diff(self.t) > 0):
            raise UserError(f"phase {self.name!r}: needs at least 3 increasing times, got an array of shape {self.t.shape}")
        for name in ("q", "dq", "ddq", "feed_forward"):
            value = getattr(self, name)
            if value.shape != (self.q.shape[0], self.t.size) or not np.all(np.isfinite(value)):
                raise UserError(f"phase {self.name!r}: {name} must be finite, of shape (n, {self.t.size}), got {value.shape}")
        mass = self.payload
        if mass.shape != self.t.shape or np.any(mass != mass[0]) or not 0 <= mass[0] < np.inf:
            raise UserError(f"phase {self.name!r}: payload {mass} kg must be one finite mass, not negative")


@dataclass(frozen=True, eq=False, kw_only=True)
class TrackedPhase(Simulated):
    """A phase as the engine moved the links, at every step, on the reference's clock.

    `tau_motor` is the engine's `qfrc_actuator`; `tau_load` is `mj_rne` at the engine's `qacc`, which contains no armature, so that
    the motors' inertia and friction stand on the drive's side, less `qfrc_spring`.

    Attributes:
        tau_spring: Torque of the effects on the links [Nm], shape (n, K): `qfrc_spring`.
        kinetic, potential: Energy of the links and payload [J], shape (K,): from the engine, without the armature's.
        stored: In springs [J], shape (K,): the engine's for native effects; of generated ones, which the engine knows only as
            torques, their own expression at the engine's positions.
        work_load, dissipated: Of tau_load, and in the joints' friction, since the start [J], shape (K,).
        reference: The phase to be followed.
        twist: q, dq, ddq of the links less those of their drives, (3, n, K).
    """

    twist: np.ndarray
    tau_spring: np.ndarray
    kinetic: np.ndarray
    potential: np.ndarray
    stored: np.ndarray
    work_load: np.ndarray
    dissipated: np.ndarray
    reference: Reference

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
        return np.max(np.abs(self.q - position(self.reference)(self.t)), axis=1)


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
    def tracking_error(self) -> float:
        """Largest |q − q_ref| of any joint in any phase [rad]."""
        return float(max(np.max(p.error) for p in self.phases))

    @property
    def saturated(self) -> np.ndarray:
        """Whether each joint's controller ran into its limit, shape (n,)."""
        return np.any([np.any(np.abs(p.tau_motor) >= self.control.limit[:, None], axis=1) for p in self.phases], axis=0)


def track(
    model: Model,
    phases: Sequence[Reference],
    theta: Sequence[float] | np.ndarray = (),
    control: Controller | None = None,
    settings: Settings = DEFAULT,
    widths: np.ndarray | None = None,
) -> Tracked:
    """Follow a reference in the engine, phase after phase.

    A payload is held in the phases that have one, and let go between them. The reference between its points is the cubic
    with the points' q and dq (and dq with ddq), the torque fed forward Akima's interpolant. The controllers read q and dq at
    every stage of a step, while q_ref, dq_ref and tau_ff pass linearly from one step to the next (under "rk4"; the other
    integrators hold them). Held over a step they would make the torque a saw-tooth of height k_p dq h (0.5 Nm here at 1 ms).

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
    check_gears(engine, phases)
    following, tracked, end = Following(control, settings.timestep), [], None
    with engine.effects():
        for phase in phases:
            theta = engine.theta if phase.theta is None else phase.theta
            own = engine if np.array_equal(theta, engine.theta) else twin(model, theta, control, settings, widths)
            found, end = _follow(own, phase, following, end if settings.start == "continue" else None)
            tracked.append(found)
    return Tracked(tuple(tracked), engine, control, settings)


def check_gears(engine: Twin, phases: Sequence[Reference] = ()) -> None:
    """Raise `UserError` where a gear gives, and a reference does not say how its drive leads the link."""
    if engine.elastic_joints and not (phases and all(phase.twist is not None for phase in phases)):
        joints = ", ".join(engine.model.robot.joints[j] for j in engine.elastic_joints)
        raise UserError(
            f"the gear of {joints} gives, and a design's motion is that of the links; only recordings can be replayed"
        )


def _follow(engine: Twin, phase: Reference, following: Following, start: State | None) -> tuple[TrackedPhase, State]:
    """One phase from a state, or from its own first point, and the state at its end."""
    t, h = following.grid(phase)
    if start is None:
        stateful = (effect for effect in engine.model.effects if isinstance(effect, WithStates))
        rest = [x for effect in stateful for x in effect.rest(phase.feed_forward[:, 0])]
        twist = None if phase.twist is None else phase.twist[:2, :, 0]
        start = State(*engine.coordinates(phase.drives.q[:, 0], phase.drives.dq[:, 0], twist), np.array(rest))
    engine.set_payload(float(phase.payload[0]))
    u = following.signal(phase.drives, phase.feed_forward, t, h)
    found = roll_out([engine.mj], u[None], h, State(start.q[None], start.dq[None], start.effects[None]))
    q, dq, effects = found.q[0], found.dq[0], found.effects[0]
    fine = np.all(np.abs(np.concatenate([q, dq])) < DIVERGED, axis=0) & np.all(np.isfinite(effects), axis=0)
    if not np.all(fine):
        when = t[np.argmin(fine)]
        raise UserError(
            f"phase {phase.name!r}: the simulation diverges near t = {when:.4g} s; shorten the timestep or lower the gains"
        )
    end = State(q[:, -1], dq[:, -1], effects[:, -1])
    return _read(engine, phase, t, np.concatenate([q, dq, u, effects])), end


def _read(engine: Twin, phase: Reference, t: np.ndarray, states: np.ndarray) -> TrackedPhase:
    """Torques and energies of the engine at its states (2 nv + activations, K), on the reference's clock (K,)."""
    m, d, n = engine.mj, mujoco.MjData(engine.mj), engine.model.robot.n
    at, gears = engine.dofs, list(engine.elastic_joints)
    fields = {"tau_motor": "qfrc_actuator", "tau_spring": "qfrc_spring"}
    rows = {name: np.zeros((n, t.size)) for name in (*fields, "tau_load")}
    lost, accelerations, rne = np.zeros((n, t.size)), np.zeros((m.nv, t.size)), np.zeros(m.nv)
    kinetic, gravity, total = np.zeros((3, t.size))
    for k in range(t.size):
        d.time, d.qpos[:], d.qvel[:], d.act[:] = t[k], *np.split(states[:, k], [m.nv, 2 * m.nv])
        mujoco.mj_forward(m, d)
        mujoco.mj_rne(m, d, 1, rne)
        mujoco.mj_energyPos(m, d)
        mujoco.mj_energyVel(m, d)
        for name, field in fields.items():
            rows[name][:, k] = getattr(d, field)[at]
        rows["tau_load"][:, k], lost[:, k] = (rne - d.qfrc_spring)[at], (d.qfrc_damper + d.qfrc_constraint)[at]
        accelerations[:, k] = d.qacc
        total[k], kinetic[k] = d.energy[0], d.energy[1] - m.dof_armature @ d.qvel**2 / 2
        gravity[k] = -m.body_mass @ (d.xipos @ m.opt.gravity)
    moved, twist = (states[: m.nv], states[m.nv : 2 * m.nv], accelerations), np.zeros((3, n, t.size))
    twist[:, gears] = [x[at[gears] + 1] for x in moved]
    q, dq, ddq = (x[at] + by for x, by in zip(moved, twist, strict=True))
    own = engine.library is None and not gears  # springs that are the engine's
    return TrackedPhase(
        t, q, dq, ddq, np.full(t.size, phase.payload[0]), twist=twist,
        tau_motor=rows["tau_motor"], tau_load=rows["tau_load"], tau_spring=rows["tau_spring"],
        kinetic=kinetic, potential=gravity,
        stored=total - gravity if own else _stored(engine, q, dq, float(phase.payload[0])),
        work_load=_since_start(np.sum(rows["tau_load"] * dq, axis=0), t),
        dissipated=_since_start(-np.sum(lost * (dq - twist[1]), axis=0), t),
        reference=phase,
    )  # fmt: skip


def _stored(engine: Twin, q: np.ndarray, dq: np.ndarray, payload: float) -> np.ndarray:
    q = q + np.array(ca.evalf(generated_c.shift(engine.model, engine.theta)))
    return np.asarray(engine.model.energy(q, dq, payload, engine.theta, engine.widths)[2]).reshape(-1)


def _since_start(power: np.ndarray, t: np.ndarray) -> np.ndarray:
    """∫ power dt from the first time on, by the trapezoid rule [J], shape (K,)."""
    return np.concatenate([[0.0], np.cumsum((power[1:] + power[:-1]) / 2 * np.diff(t))])
