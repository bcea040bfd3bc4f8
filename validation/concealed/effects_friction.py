"""Catalogue effects of friction and transmission."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from validation.concealed.arms import Arm, twisting_inertia
from validation.concealed.effect import Effect, Forces, State, any_joint, loaded_joint


@dataclass(frozen=True)
class CoulombAsymmetry(Effect):
    name = "coulomb_asymmetry"
    equation = "tau = -(f_c + asymmetry/2 sgn(dq)) sgn(dq)"

    @classmethod
    def draw(cls, arm, motion, rng):
        j = any_joint(motion, rng)
        return cls((j,), 0.2 * arm.coulomb[j], {"direction": float(rng.choice([-1, 1])), "width": arm.width})

    def push(self, s: State, f: Forces, memory: Any) -> None:
        half = 0.5 * self.shape["direction"] * self.strength
        f.dry[:, self.j] += self.mask * half * np.tanh(s.w[:, self.j] / self.shape["width"])

    def parameters(self, arm: Arm):
        return {"asymmetry": (self.shape["direction"] * self.strength, "Nm")}


@dataclass(frozen=True)
class ViscousAsymmetry(Effect):
    """The coefficient for w > 0 less that for w < 0; half of it is added on one side and taken off on the other."""

    name = "viscous_asymmetry"
    equation = "tau = -(f_v + asymmetry/2 sgn(dq)) dq"

    @classmethod
    def draw(cls, arm, motion, rng):
        j = any_joint(motion, rng)
        return cls((j,), 0.2 * arm.viscous[j], {"direction": float(rng.choice([-1, 1]))})

    def push(self, s: State, f: Forces, memory: Any) -> None:
        f.viscous[:, self.j] += self.mask * 0.5 * self.shape["direction"] * self.strength * np.sign(s.w[:, self.j])

    def parameters(self, arm: Arm):
        return {"asymmetry": (self.shape["direction"] * self.strength, "Nm s/rad")}


@dataclass(frozen=True)
class Stribeck(Effect):
    name = "stribeck"
    equation = "tau = -(f_c + excess exp(-(dq/velocity)^2)) sgn(dq)"

    @classmethod
    def draw(cls, arm, motion, rng):
        j = any_joint(motion, rng)
        fast = np.abs(motion.dq[:, j]).max()
        return cls((j,), 0.5 * arm.coulomb[j], {"velocity": rng.uniform(0.12, 0.3) * fast})

    def push(self, s: State, f: Forces, memory: Any) -> None:
        x = s.w[:, self.j] / self.shape["velocity"]
        f.dry[:, self.j] += self.mask * self.strength * np.exp(-(x**2))

    def parameters(self, arm: Arm):
        return {"excess": (self.strength, "Nm"), "velocity": (self.shape["velocity"], "rad/s")}


@dataclass(frozen=True)
class QuadraticDrag(Effect):
    """A falling branch (negative coefficient) stops falling where viscous and quadratic slope cancel."""

    name = "quadratic_drag"
    equation = "tau = -coefficient dq |dq| (held at its slope's sign change where the coefficient is negative)"

    @classmethod
    def draw(cls, arm, motion, rng):
        j = any_joint(motion, rng)
        return cls((j,), 0.2 * arm.viscous[j], {"direction": float(rng.choice([-1, 1])), "viscous": arm.viscous[j]})

    def push(self, s: State, f: Forces, memory: Any) -> None:
        w, c = s.w[:, self.j], self.shape["direction"] * self.strength
        speed = np.abs(w)
        if c < 0:
            speed = np.minimum(speed, self.shape["viscous"] / (-2.0 * c))
        f.rotor[:, self.j] -= self.mask * c * np.sign(w) * speed**2

    def parameters(self, arm: Arm):
        return {"coefficient": (self.shape["direction"] * self.strength, "Nm s²/rad²")}


@dataclass(frozen=True)
class LoadDependentFriction(Effect):
    name = "load_dependent_friction"
    equation = "tau = -mu |tau_l| sgn(dq)"
    largest = 0.6

    @classmethod
    def draw(cls, arm, motion, rng):
        return cls((loaded_joint(motion, rng),), 0.08)

    def push(self, s: State, f: Forces, memory: Any) -> None:
        f.mu[:, self.j] += self.mask * self.strength

    def parameters(self, arm: Arm):
        return {"mu": (self.strength, "1")}


@dataclass(frozen=True)
class MotorDependentFriction(Effect):
    """Friction that grows with the torque of the motor, which also turns the rotor, and which overcomes friction or not.

    Both torques are those of one step before.
    """

    name = "motor_dependent_friction"
    told = "load_dependent_friction"
    equation = "tau = -mu |tau_m| sgn(dq), tau_m the motor's torque, or tau_l + armature ddq"
    largest = 0.5

    @classmethod
    def draw(cls, arm, motion, rng):
        shape = {"whole": bool(rng.random() < 0.5), "armature": arm.armature}
        return cls((loaded_joint(motion, rng),), 0.08, shape)

    def push(self, s: State, f: Forces, memory: Any) -> None:
        j = self.j
        turning = s.load[:, j] + self.shape["armature"][j] * s.alpha[:, j]
        level = self.mask * self.strength * np.abs(s.motor[:, j] if self.shape["whole"] else turning)
        f.rotor[:, j] -= level * f.sign[:, j]
        f.damp[:, j] += level * f.slope[:, j]

    def parameters(self, arm: Arm):
        return {"mu": (self.strength, "1"), "follows": ("motor" if self.shape["whole"] else "motor without friction", "")}


@dataclass(frozen=True)
class PreslidingHysteresis(Effect):
    """The strength is δ = f_c / σ0 [rad], the bristle's reach. Laws of the deflection z in [−1, 1]:

    `dahl`, `lugre`: δ dz/dt = v − |v| z; `maxwell_slip`: the mean of five saturated elements that yield at
    0.3 to 1.7 δ; `smooth_dahl`: δ dz/dt = |v| (tanh(v / width) − z), which tends to the plain law as δ → 0, where the
    others tend to an ideal sign (weak strengths are only reachable with it).
    """

    name = "presliding_hysteresis"
    equation = "tau = -f_c z,  dz/dt = (dq - |dq| z) stiffness / f_c"
    smallest, largest = 5e-5, 0.3

    @classmethod
    def draw(cls, arm, motion, rng):
        law = str(rng.choice(["dahl", "lugre", "maxwell_slip", "smooth_dahl", "smooth_dahl"]))
        j = any_joint(motion, rng)
        return cls((j,), 0.02, {"law": law, "level": arm.coulomb[j], "width": arm.width})

    def memory(self, shape: tuple[int, int]):
        return np.zeros((5, shape[0]) if self.shape["law"] == "maxwell_slip" else (1, shape[0]))

    def push(self, s: State, f: Forces, memory: Any) -> None:
        if self.strength <= 0.0:
            return
        on, j = self.mask > 0, self.j
        f.sign[:, j] = np.where(on, memory.mean(axis=0), f.sign[:, j])
        f.slope[:, j] = np.where(on, 0.0, f.slope[:, j])
        if self.shape["law"] == "lugre":  # bristle damping of 20 ms of its stiffness, at small deflections
            rate = (s.w[:, j] - np.abs(s.w[:, j]) * memory[0]) / self.strength
            f.rotor[:, j] -= self.mask * self.shape["level"] * 0.02 * np.clip(rate, -5.0, 5.0)

    def advance(self, s: State, memory: Any, step: float):
        if self.strength <= 0.0:
            return memory
        v, law = s.w[:, self.j], self.shape["law"]
        if law == "maxwell_slip":
            yields = self.strength * np.linspace(0.3, 1.7, 5)[:, None]
            return np.clip(memory + v * step / yields, -1.0, 1.0)
        towards = np.tanh(v / self.shape["width"]) if law == "smooth_dahl" else np.sign(v)
        return towards + (memory - towards) * np.exp(-np.abs(v) * step / self.strength)

    def parameters(self, arm: Arm):
        value = self.shape["level"] / self.strength if self.strength > 0 else np.inf
        return {"stiffness": (value, "Nm/rad"), "law": (self.shape["law"], "")}


@dataclass(frozen=True)
class FrictionDrift(Effect):
    """Dry and viscous friction change together with time since the start of each recording."""

    name = "friction_drift"
    equation = "friction = (1 + ratio exp(-t/time_constant)) steady friction"
    largest = 3.0

    @classmethod
    def draw(cls, arm, motion, rng):
        j = any_joint(motion, rng)
        shape = {"time_constant": rng.uniform(0.15, 0.5) * motion.duration, "direction": float(rng.choice([1, 1, 1, -0.3]))}
        return cls((j,), 0.3, shape)

    def push(self, s: State, f: Forces, memory: Any) -> None:
        decay = np.exp(-max(s.t, 0.0) / self.shape["time_constant"])
        f.scale[:, self.j] += self.mask * self.shape["direction"] * self.strength * decay

    def parameters(self, arm: Arm):
        return {
            "ratio": (self.shape["direction"] * self.strength, "1"),
            "time_constant": (self.shape["time_constant"], "s"),
        }


@dataclass(frozen=True)
class PositionDependentFriction(Effect):
    name = "position_dependent_friction"
    equation = "tau = -(f_c + amplitude cos(order q - phase)) sgn(dq)"

    @classmethod
    def draw(cls, arm, motion, rng):
        j = any_joint(motion, rng)
        reach = np.ptp(motion.q[:, j])
        order = max(1, round(rng.uniform(0.8, 2.0) * 2 * np.pi / reach))
        shape = {"order": order, "phase": rng.uniform(0, 2 * np.pi), "level": arm.coulomb[j]}
        return cls((j,), 0.2 * arm.coulomb[j], shape)

    def push(self, s: State, f: Forces, memory: Any) -> None:
        f.dry[:, self.j] += self.mask * self.strength * np.cos(self.shape["order"] * s.theta[:, self.j] - self.shape["phase"])

    def parameters(self, arm: Arm):
        return {
            "amplitude": (self.strength, "Nm"),
            "order": (self.shape["order"], "cycles per joint turn"),
            "phase": (self.shape["phase"], "rad"),
        }


@dataclass(frozen=True)
class TorqueRipple(Effect):
    name = "torque_ripple"
    equation = "tau = amplitude sin(order q + phase)"

    @classmethod
    def draw(cls, arm, motion, rng):
        j = any_joint(motion, rng)
        return cls((j,), 0.1 * arm.coulomb[j], {"order": int(rng.integers(5, 25)), "phase": rng.uniform(0, 2 * np.pi)})

    def push(self, s: State, f: Forces, memory: Any) -> None:
        angle = self.shape["order"] * s.theta[:, self.j] + self.shape["phase"]
        f.rotor[:, self.j] += self.mask * self.strength * np.sin(angle)

    def parameters(self, arm: Arm):
        return {
            "amplitude": (self.strength, "Nm"),
            "order": (self.shape["order"], "cycles per joint turn"),
            "phase": (self.shape["phase"], "rad"),
        }


@dataclass(frozen=True)
class CoupledFriction(Effect):
    """A gear or seal that turns with dq_a + dq_b rubs on both joints (a coupled wrist)."""

    name = "coupled_friction"
    equation = "tau_a = tau_b = -(coulomb sgn(dq_a + dq_b) + viscous (dq_a + dq_b))"

    @classmethod
    def draw(cls, arm, motion, rng):
        a = int(rng.integers(arm.n - 1))
        pair = (a, a + 1) if rng.random() < 0.5 else (a + 1, a)
        level = 0.2 * min(arm.coulomb[list(pair)])
        return cls(pair, level, {"viscous_per_coulomb": rng.uniform(0.3, 1.5), "width": arm.width})

    def push(self, s: State, f: Forces, memory: Any) -> None:
        a, b = self.joints
        rate = s.w[:, a] + s.w[:, b]
        sign = np.tanh(rate / self.shape["width"])
        torque = self.strength * (sign + self.shape["viscous_per_coulomb"] * rate)
        slope = self.strength * ((1 - sign**2) / self.shape["width"] + self.shape["viscous_per_coulomb"])
        for j in (a, b):
            f.rotor[:, j] -= self.mask * torque
            f.damp[:, j] += self.mask * slope

    def parameters(self, arm: Arm):
        return {
            "coulomb": (self.strength, "Nm"),
            "viscous": (self.strength * self.shape["viscous_per_coulomb"], "Nm s/rad"),
        }


@dataclass(frozen=True)
class JointElasticity(Effect):
    """Two inertias: the armature before the spring, the link behind it. The strength is the compliance [rad/Nm].

    No stiffer than a step of 1 ms can follow; below that compliance the effect no longer changes.
    """

    name = "joint_elasticity"
    equation = "tau_l = stiffness (theta - q); the recorded position is theta"
    largest = 1 / 60.0
    gap = 0.0

    @classmethod
    def at(cls, arm: Arm, j: int, strength: float) -> "JointElasticity":
        return cls((j,), strength, {"stiffest": stiffest(arm, j, 1e-3)})

    @classmethod
    def draw(cls, arm, motion, rng):
        return cls.at(arm, loaded_joint(motion, rng), 1e-3)

    @property
    def stiffness(self) -> float:
        return min(1 / max(self.strength, 1e-12), self.shape["stiffest"])

    def parameters(self, arm: Arm):
        return {"stiffness": (self.stiffness, "Nm/rad")}


@dataclass(frozen=True)
class Backlash(Effect):
    """Two inertias with a dead zone between them; positions are the motor's. The strength is the gap [rad]."""

    name = "backlash"
    equation = "tau_l = contact stiffness * dead zone(theta - q, gap/2)"
    smallest, largest = 1e-3, 0.3

    @classmethod
    def at(cls, arm: Arm, j: int, strength: float) -> "Backlash":
        return cls((j,), strength, {"contact": stiffest(arm, j, 5e-4)})

    @classmethod
    def draw(cls, arm, motion, rng):
        return cls.at(arm, loaded_joint(motion, rng), 0.02)

    @property
    def stiffness(self) -> float:
        return self.shape["contact"]

    @property
    def gap(self) -> float:
        return self.strength

    def parameters(self, arm: Arm):
        return {"gap": (self.strength, "rad"), "contact_stiffness": (self.stiffness, "Nm/rad")}


def stiffest(arm: Arm, j: int, step: float) -> float:
    """Stiffness at which a transmission's resonance is 0.7 / step [Nm/rad]."""
    return float(twisting_inertia(arm)[j] * (0.7 / step) ** 2)
