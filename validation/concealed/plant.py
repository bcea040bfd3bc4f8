# pyright: reportAttributeAccessIssue=false
"""The plant: controllers, motors, friction, transmission and rigid body, simulated in time for all recordings at once.

Motor:  A θ'' = τ_m − f(w, τ_l) − τ_l,       f = scale (dry sign(w) + viscous w) + mu |τ_l| sign(w) + (gain − 1) τ_l
Link:   M(q) q'' + C(q, q') q' + g(q) = τ_l + τ_springs + τ_effects
Rigid joints have θ = q. Elastic ones have τ_l = k dz(θ − q) + d (w − q'), dz a dead zone for backlash.

Integrator: leapfrog with positions at the steps and speeds between them. Friction and controller damping enter the solve
linearised about the predicted speed, which is second order and stable for stiff friction; positions need ω h < 2.
"""

from dataclasses import dataclass, field

import numpy as np
import pinocchio as pin

from validation.concealed.arms import Arm, rotor_inertia, twisting_inertia
from validation.concealed.effect import Body, Effect, Forces, Signals, State
from validation.concealed.effects_friction import Backlash, JointElasticity
from validation.concealed.springs import SpringBank

LEAD = 1.0  # the arm settles at the start of its reference for this long before t = 0 [s]


@dataclass(frozen=True)
class Setup:
    """What is mounted in each of the B recordings."""

    payload: np.ndarray  # listed, (B,) [kg]
    springs: list[dict]  # listed, one per recording
    gravity: np.ndarray = field(default_factory=lambda: np.array([0.0, 0.0, -9.81]))


@dataclass(frozen=True)
class History:
    """The simulated truth, (B, n, T); t = 0 is the start of the recordings."""

    t: np.ndarray
    q: np.ndarray  # link
    dq: np.ndarray
    ddq: np.ndarray
    theta: np.ndarray  # motor
    dtheta: np.ndarray
    ddtheta: np.ndarray
    motor: np.ndarray  # motor torque [Nm]
    load: np.ndarray  # torque that enters Eq. 1 [Nm]
    friction: np.ndarray  # all friction torque on the motor side [Nm]


def bodies(arm: Arm, setup: Setup, effects: list[Effect]) -> list[pin.Model]:
    """One model per recording, with its payload and every effect that changes the rigid body."""
    models = []
    tool = arm.model.frames[arm.model.getFrameId(arm.tool_link)]
    for b, payload in enumerate(setup.payload):
        body = Body(arm.model.copy(), float(payload), arm.tool_point, tool)
        body.model.gravity.linear = setup.gravity
        for effect in effects:
            if effect.mask[b] and effect.strength > 0:
                effect.edit(body)
        placement = tool.placement * pin.SE3(np.eye(3), body.point)  # locked joints may lie between joint and link
        inertia = pin.Inertia(body.payload, np.zeros(3), np.zeros((3, 3)))
        body.model.appendBodyToJoint(tool.parentJoint, inertia, placement)
        models.append(body.model)
    return models


@dataclass
class Transmission:
    """Which joints have two inertias in which recordings, (B, n)."""

    flexible: np.ndarray  # bool
    stiffness: np.ndarray  # [Nm/rad]
    gap: np.ndarray  # total play [rad]
    damping: np.ndarray  # [Nm s/rad]

    def torque(self, twist: np.ndarray, rate: np.ndarray) -> np.ndarray:
        """Transmitted torque [Nm]; inside the gap the lubricant still transmits a quarter of the damping."""
        stretch = twist - np.clip(twist, -self.gap / 2, self.gap / 2)
        return self.stiffness * stretch + self.damping * np.where(stretch == 0, 0.25, 1.0) * rate


def transmission(arm: Arm, effects: list[Effect], shape: tuple[int, int]) -> Transmission | None:
    """The joints with elasticity or backlash, or None where all are rigid."""
    x = Transmission(np.zeros(shape, bool), np.zeros(shape), np.zeros(shape), np.zeros(shape))
    for effect in effects:
        if isinstance(effect, JointElasticity | Backlash) and effect.strength > 0:
            j, on = effect.j, effect.mask > 0
            x.flexible[on, j] = True
            x.stiffness[on, j] = effect.stiffness
            x.gap[on, j] = effect.gap
    x.damping = 0.4 * np.sqrt(x.stiffness * twisting_inertia(arm))
    return x if x.flexible.any() else None


class Plant:
    """An arm with its effects, ready to be driven along references."""

    def __init__(self, arm: Arm, setup: Setup, effects: list[Effect], step: float = 1e-3, controlled: bool = True):
        self.arm, self.effects, self.step, self.controlled = arm, effects, step, controlled
        self.shape = (len(setup.payload), arm.n)
        self.models = bodies(arm, setup, effects)
        self.data = [m.createData() for m in self.models]
        self.springs = SpringBank(setup.springs, arm)
        self.flex = transmission(arm, effects, self.shape)
        self.memory = [e.memory(self.shape) for e in effects]
        self.armature = np.broadcast_to(arm.armature, self.shape)
        if self.flex is not None:
            self.armature = np.where(self.flex.flexible, rotor_inertia(arm), self.armature)
        ratio = np.ones(arm.n) if arm.motor is None else arm.motor.constant * arm.motor.c1
        self.gain, self.dry, self.viscous, self.ones, self.zeros = (
            np.tile(x, (self.shape[0], 1)) for x in (ratio, arm.coulomb, arm.viscous, np.ones(arm.n), np.zeros(arm.n))
        )

    def run(self, reference: np.ndarray, speed: np.ndarray | None = None, start_speed: np.ndarray | None = None) -> History:
        """Track `reference` (B, n, T), one column per step; the first columns up to LEAD seconds lie before t = 0."""
        batch, n, steps = reference.shape
        lead = round(LEAD / self.step) if self.controlled else 0
        rate = np.gradient(reference, self.step, axis=2) if speed is None else speed
        out = np.empty((9, steps, batch, n))
        zero, half = np.zeros((batch, n)), self.step / 2
        q = reference[:, :, 0].copy()
        v = zero if start_speed is None else start_speed
        s = State(-lead * self.step, q, v, zero, q, v, zero, zero, zero)
        s.motor, s.a, s.alpha, s.load, _ = self.solve(s, reference[:, :, 0], rate[:, :, 0])
        u, v = v - half * s.alpha, v - half * s.a  # speeds of motor and link half a step earlier
        for k in range(steps):
            s.t = (k - lead) * self.step
            s.v, s.w = v + half * s.a, u + half * s.alpha
            motor, a, alpha, load, friction = self.solve(s, reference[:, :, k], rate[:, :, k])
            out[:, k] = s.q, v + half * a, a, s.theta, u + half * alpha, alpha, motor, load, friction
            v = v + self.step * a
            u = v if self.flex is None else np.where(self.flex.flexible, u + self.step * alpha, v)
            q = s.q + self.step * v
            theta = q if self.flex is None else np.where(self.flex.flexible, s.theta + self.step * u, q)
            s = State(s.t, q, v, a, theta, u, alpha, load, motor)
            self.memory = [e.advance(s, m, self.step) for e, m in zip(self.effects, self.memory, strict=True)]
        return History((np.arange(steps) - lead) * self.step, *np.moveaxis(out, 1, -1))

    def mass_and_bias(self, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """M(q) (B, n, n) and C q' + g (B, n)."""
        mass, bias = np.empty((*self.shape, self.shape[1])), np.empty(self.shape)
        for b, (model, data) in enumerate(zip(self.models, self.data, strict=True)):
            mass[b] = pin.crba(model, data, q[b])
            bias[b] = pin.nonLinearEffects(model, data, q[b], v[b])
        return mass, bias

    def forces(self, s: State) -> Forces:
        """What springs, friction and effects add at the predicted state."""
        arm = self.arm
        sign = np.tanh(s.w / arm.width)
        f = Forces(
            link=self.zeros.copy() if self.springs.empty else self.springs.torque(s.q),
            rotor=self.zeros.copy(),
            damp=self.zeros.copy(),
            sign=sign,
            slope=(1 - sign**2) / arm.width,
            dry=self.dry.copy(),
            viscous=self.viscous.copy(),
            scale=self.ones.copy(),
            mu=self.zeros.copy(),
        )
        if arm.motor is not None:
            self.motor_losses(s, f)
        for effect, memory in zip(self.effects, self.memory, strict=True):
            if effect.strength > 0:
                effect.push(s, f, memory)
        return f

    def motor_losses(self, s: State, f: Forces) -> None:
        """Eq. 9's c_v2 and c_12; c_v2's fall of friction ends where ν + 2 c_v2 |v| = 0."""
        m = self.arm.motor
        assert m is not None
        speed = np.minimum(np.abs(s.w), m.nu / (2 * np.abs(m.cv2)))
        f.rotor -= m.constant * m.cv2 * f.sign * speed**2
        f.mu += m.constant * m.c12

    def solve(self, s: State, reference: np.ndarray, rate: np.ndarray):
        """Motor torque, link and motor acceleration, load torque and friction at a step; all (B, n)."""
        arm, half = self.arm, self.step / 2
        mass, bias = self.mass_and_bias(s.q, s.v)
        f = self.forces(s)
        free = self.zeros
        if self.controlled:
            free = arm.kp * (reference - s.theta) + arm.kd * (rate - s.w)
        motor = np.clip(free, -arm.effort, arm.effort)
        kd = np.where(free == motor, arm.kd, 0.0) if self.controlled else 0.0
        rub = f.scale * (f.dry * f.sign + f.viscous * s.w) - f.rotor
        damp = (
            f.scale * (np.maximum(f.dry, 0.0) * f.slope + f.viscous) + f.damp + np.maximum(f.mu, 0.0) * np.abs(s.load) * f.slope
        )
        inertia = self.armature + half * (damp + kd)
        # The linearisation is about the predicted speed w* = w_half + h/2 α_old: f(w) ≈ f(w*) + D (h/2) (α − α_old).
        drive = motor - rub + half * (damp + kd) * s.alpha
        gain = self.gain
        if self.flex is None:
            a, load, gain = self.rigid(mass, bias - f.link, inertia, drive, gain, f, s.load)
            alpha = a
        else:
            a, alpha, load, gain = self.elastic(s, mass, bias - f.link, inertia, drive, gain, f)
        change = half * (alpha - s.alpha)
        motor = motor - kd * change
        return motor, a, alpha, load, rub + damp * change + (gain - 1.0) * load

    @staticmethod
    def rigid(mass, bias, inertia, drive, gain, f: Forces, load: np.ndarray):
        """One inertia per joint: (g M + A) a = drive − g bias, g = gain + mu sign(w) sgn(τ_l), with sgn(τ_l) consistent."""
        n = mass.shape[1]
        loaded = bool(f.mu.any())
        a, g = load, gain
        for _ in range(4 if loaded else 1):
            g = gain + f.mu * f.sign * np.sign(load)
            matrix = g[:, :, None] * mass
            matrix[:, range(n), range(n)] += inertia
            a = np.linalg.solve(matrix, (drive - g * bias)[:, :, None])[:, :, 0]
            new = np.einsum("bij,bj->bi", mass, a) + bias
            settled = not loaded or np.array_equal(np.sign(new), np.sign(load))
            load = new
            if settled:
                break
        return a, load, g

    def elastic(self, s: State, mass, bias, inertia, drive, gain, f: Forces):
        """Two inertias where the transmission gives; the other joints as in `rigid`, with last step's sgn(τ_l)."""
        assert self.flex is not None
        soft = self.flex.flexible
        through = self.flex.torque(s.theta - s.q, s.w - s.v)
        g = gain + f.mu * f.sign * np.sign(np.where(soft, through, s.load))
        row = np.where(soft, 1.0, g)
        matrix = row[:, :, None] * mass
        n = mass.shape[1]
        matrix[:, range(n), range(n)] += np.where(soft, 0.0, inertia)
        right = np.where(soft, through, drive) - row * bias
        a = np.linalg.solve(matrix, right[:, :, None])[:, :, 0]
        alpha = np.where(soft, (drive - g * through) / inertia, a)
        load = np.where(soft, through, np.einsum("bij,bj->bi", mass, a) + bias)
        return a, alpha, load, g


def signals(history: History, arm: Arm, effects: list[Effect], torque: str) -> Signals:
    """What the logger would see without noise: motor-side positions, and motor or load torque, after the sensing effects."""
    tau = history.load if torque == "load" else history.motor
    x = Signals(history.t, *(np.array(a) for a in (history.theta, history.dtheta, history.ddtheta, tau)))
    for effect in effects:
        if effect.strength > 0:
            effect.sense(x, arm)
    return x
