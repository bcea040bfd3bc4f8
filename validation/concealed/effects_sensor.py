"""Catalogue effects of the sensing chain: what the logger writes is not what the joint did."""

from dataclasses import dataclass

import numpy as np

from validation.concealed.arms import Arm
from validation.concealed.effect import Effect, Signals, any_joint, loaded_joint


@dataclass(frozen=True)
class TorqueGain(Effect):
    name = "torque_gain"
    equation = "recorded torque = (1 + gain) true"
    largest = 0.8

    @classmethod
    def draw(cls, arm, motion, rng):
        return cls((loaded_joint(motion, rng),), 0.05, {"direction": float(rng.choice([-1, 1]))})

    def sense(self, x: Signals, arm: Arm) -> None:
        x.tau[:, self.j] *= 1 + self.mask[:, None] * self.shape["direction"] * self.strength

    def parameters(self, arm: Arm):
        return {"gain": (self.shape["direction"] * self.strength, "1")}


@dataclass(frozen=True)
class TorqueOffset(Effect):
    name = "torque_offset"
    equation = "recorded torque = true + offset"

    @classmethod
    def draw(cls, arm, motion, rng):
        j = any_joint(motion, rng)
        return cls((j,), 0.1 * arm.coulomb[j], {"direction": float(rng.choice([-1, 1]))})

    def sense(self, x: Signals, arm: Arm) -> None:
        x.tau[:, self.j] += self.mask[:, None] * self.shape["direction"] * self.strength

    def parameters(self, arm: Arm):
        return {"offset": (self.shape["direction"] * self.strength, "Nm")}


@dataclass(frozen=True)
class EncoderOffset(Effect):
    name = "encoder_offset"
    equation = "recorded position = true + offset"
    largest = 0.6

    @classmethod
    def draw(cls, arm, motion, rng):
        return cls((loaded_joint(motion, rng),), 0.02, {"direction": float(rng.choice([-1, 1]))})

    def sense(self, x: Signals, arm: Arm) -> None:
        x.q[:, self.j] += self.mask[:, None] * self.shape["direction"] * self.strength

    def parameters(self, arm: Arm):
        return {"offset": (self.shape["direction"] * self.strength, "rad")}


@dataclass(frozen=True)
class TimeDelay(Effect):
    """One delay for the torque channels of all joints."""

    name = "time_delay"
    equation = "recorded torque(t) = true torque(t - delay)"
    global_effect = True
    largest = 0.4

    @classmethod
    def draw(cls, arm, motion, rng):
        return cls((), 0.01)

    def sense(self, x: Signals, arm: Arm) -> None:
        for b in np.flatnonzero(self.mask):
            for j in range(arm.n):
                x.tau[b, j] = np.interp(x.t - self.strength, x.t, x.tau[b, j])

    def parameters(self, arm: Arm):
        return {"delay": (self.strength, "s")}
