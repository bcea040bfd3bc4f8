# pyright: reportAttributeAccessIssue=false
"""Catalogue effects of the sensing chain: what the logger writes is not what the joint did."""

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from validation.concealed.arms import Arm
from validation.concealed.effect import Effect, Motion, Signals, any_joint, loaded_joint
from validation.concealed.loop import gains


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
class CommonGain(Effect):
    """One gain of the torque channels of all joints."""

    name = "common_gain"
    told = "torque_gain"
    equation = "recorded torque = (1 + gain) true, of all joints"
    global_effect = True
    largest = 0.8

    @classmethod
    def draw(cls, arm, motion, rng):
        return cls((), 0.05, {"direction": float(rng.choice([-1, 1]))})

    def sense(self, x: Signals, arm: Arm) -> None:
        x.tau *= 1 + self.mask[:, None, None] * self.shape["direction"] * self.strength

    def parameters(self, arm: Arm):
        return {"gain": (self.shape["direction"] * self.strength, "1")}


@dataclass(frozen=True)
class ControllerGain(Effect):
    """A loop whose kp is not as listed, where its commands are recorded: what it gives is more or less than they say."""

    name = "controller_gain"
    equation = "true torque = kp_scale kp (q_d - q) - kd_scale kd dq"
    largest = 0.5

    @classmethod
    def draw(cls, arm, motion, rng):
        j = loaded_joint(motion, rng)
        return cls((j,), 0.05, {"direction": float(rng.choice([-1, 1])), "kd": float(gains(arm)[1][j])})

    def sense(self, x: Signals, arm: Arm) -> None:
        scale = 1 + self.mask[:, None] * self.shape["direction"] * self.strength
        braking = self.shape["kd"] * x.dq[:, self.j]
        x.tau[:, self.j] = (x.tau[:, self.j] + braking) / scale - braking  # kp times the error, less what is listed

    def parameters(self, arm: Arm):
        return {"kp_scale": (1 + self.shape["direction"] * self.strength, "1"), "kd_scale": (1.0, "1")}


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
class MissingGravity(Effect):
    """The driver takes off a share of what its own model of the arm, with the listed payload, needs against gravity."""

    name = "missing_gravity"
    equation = "recorded torque = true - share G(q)"
    global_effect = True
    largest = 1.0

    @classmethod
    def draw(cls, arm, motion, rng):
        return cls((), 0.2, {"payload": motion.payload.tolist()})

    def sense(self, x: Signals, arm: Arm) -> None:
        tool = arm.model.frames[arm.model.getFrameId(arm.tool_link)]
        for b in np.flatnonzero(self.mask):
            model = arm.model.copy()
            held = pin.Inertia(self.shape["payload"][b], np.zeros(3), np.zeros((3, 3)))
            model.appendBodyToJoint(tool.parentJoint, held, tool.placement * pin.SE3(np.eye(3), arm.tool_point))
            data = model.createData()
            gravity = [pin.computeGeneralizedGravity(model, data, q) for q in np.ascontiguousarray(x.q[b].T)]
            x.tau[b] -= self.strength * np.array(gravity).T

    def parameters(self, arm: Arm):
        return {"share": (self.strength, "1")}


@dataclass(frozen=True)
class Zeros(Effect):
    """A zero that is found anew before every recording; the strength is the spread of what it is off by."""

    @classmethod
    def of_recordings(cls, joint: int, strength: float, motion: Motion, rng: np.random.Generator) -> "Zeros":
        return cls((joint,), strength, {"zeros": rng.normal(size=len(motion.payload))})

    @property
    def offsets(self) -> np.ndarray:
        """Of each recording, (B, 1)."""
        return (self.mask * self.strength * self.shape["zeros"])[:, None]


@dataclass(frozen=True)
class TorqueZeros(Zeros):
    name = "torque_zeros"
    told = "torque_offset"
    equation = "recorded torque = true + offset, another in every recording"

    @classmethod
    def draw(cls, arm, motion, rng):
        j = any_joint(motion, rng)
        return cls.of_recordings(j, 0.1 * arm.coulomb[j], motion, rng)

    def sense(self, x: Signals, arm: Arm) -> None:
        x.tau[:, self.j] += self.offsets

    def parameters(self, arm: Arm):
        return {"offset": (self.offsets[:, 0].tolist(), "Nm")}


@dataclass(frozen=True)
class EncoderZeros(Zeros):
    name = "encoder_zeros"
    told = "encoder_offset"
    equation = "recorded position = true + offset, another in every recording"
    largest = 0.3

    @classmethod
    def draw(cls, arm, motion, rng):
        return cls.of_recordings(loaded_joint(motion, rng), 0.02, motion, rng)

    def sense(self, x: Signals, arm: Arm) -> None:
        x.q[:, self.j] += self.offsets

    def parameters(self, arm: Arm):
        return {"offset": (self.offsets[:, 0].tolist(), "rad")}


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
