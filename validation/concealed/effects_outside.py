# pyright: reportAttributeAccessIssue=false
"""Effects that the catalogue does not have: the diagnosis must report them as unexplained, with what they depend on."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin

from validation.concealed.arms import Arm
from validation.concealed.effect import Effect, Forces, Signals, State, any_joint, loaded_joint


@dataclass(frozen=True)
class Outside(Effect):
    """Strength in `unit`."""

    catalogue = False
    unit = "Nm"

    def parameters(self, arm: Arm):
        fixed = {k: (v, "") for k, v in self.shape.items() if isinstance(v, float | int)}
        return {"strength": (self.strength, self.unit), **fixed}

    def depends_on(self, arm: Arm) -> list[str]:
        return [f"q_{arm.joints[self.j]}"]


@dataclass(frozen=True)
class MagneticDetent(Outside):
    name = "magnetic_detent"
    equation = "tau = strength exp(-((q - centre)/width)^2 / 2)"

    @classmethod
    def draw(cls, arm, motion, rng):
        j = any_joint(motion, rng)
        centre = float(rng.uniform(*np.quantile(motion.q[:, j], [0.25, 0.75])))
        return cls((j,), 0.3 * arm.coulomb[j], {"centre": centre, "width": rng.uniform(0.04, 0.12)})

    def push(self, s: State, f: Forces, memory: Any) -> None:
        x = (s.q[:, self.j] - self.shape["centre"]) / self.shape["width"]
        f.link[:, self.j] += self.mask * self.strength * np.exp(-0.5 * x**2)


@dataclass(frozen=True)
class EndStopCushion(Outside):
    name = "end_stop_cushion"
    equation = "tau = -strength max((q - start)/depth, 0)^3"

    @classmethod
    def draw(cls, arm, motion, rng):
        j = any_joint(motion, rng)
        depth = float(rng.uniform(0.15, 0.3) * np.ptp(motion.q[:, j]))
        return cls((j,), arm.coulomb[j], {"start": float(motion.q[:, j].max() - depth), "depth": depth})

    def push(self, s: State, f: Forces, memory: Any) -> None:
        depth = (s.q[:, self.j] - self.shape["start"]) / self.shape["depth"]
        f.link[:, self.j] -= self.mask * self.strength * np.maximum(depth, 0.0) ** 3


@dataclass(frozen=True)
class CrossFan(Outside):
    """Air drag on one joint that depends on how far another joint stretches the arm."""

    name = "cross_fan"
    unit = "Nm s²/rad²"
    equation = "tau_a = -strength dq_a |dq_a| (1 + cos 2 q_b)"

    @classmethod
    def draw(cls, arm, motion, rng):
        a = int(rng.integers(arm.n - 1))
        return cls((a, a + 1), 0.2 * arm.viscous[a])

    def push(self, s: State, f: Forces, memory: Any) -> None:
        a, b = self.joints
        drag = self.mask * self.strength * (1 + np.cos(2 * s.q[:, b]))
        f.link[:, a] -= drag * s.v[:, a] * np.abs(s.v[:, a])

    def depends_on(self, arm: Arm) -> list[str]:
        return [f"dq_{arm.joints[self.joints[0]]}", f"q_{arm.joints[self.joints[1]]}"]


@dataclass(frozen=True)
class DirectionalStiffness(Outside):
    name = "directional_stiffness"
    unit = "Nm/rad"
    equation = "tau = -strength (q - rest) (1 + sgn(dq))/2"

    @classmethod
    def draw(cls, arm, motion, rng):
        j = any_joint(motion, rng)
        shape = {"rest": float(np.quantile(motion.q[:, j], rng.uniform(0.3, 0.7))), "width": arm.width}
        return cls((j,), 0.2 * arm.coulomb[j], shape)

    def push(self, s: State, f: Forces, memory: Any) -> None:
        up = 0.5 * (1 + np.tanh(s.v[:, self.j] / self.shape["width"]))
        f.link[:, self.j] -= self.mask * self.strength * (s.q[:, self.j] - self.shape["rest"]) * up

    def depends_on(self, arm: Arm) -> list[str]:
        return [f"q_{arm.joints[self.j]}", f"sign(dq_{arm.joints[self.j]})"]


@dataclass(frozen=True)
class PostureTorque(Outside):
    """A hose over two joints whose pull is not that of a spring across them."""

    name = "posture_torque"
    equation = "tau_a = strength sin(2 q_a + 3 q_b)"

    @classmethod
    def draw(cls, arm, motion, rng):
        a = int(rng.integers(arm.n - 1))
        return cls((a, a + 1), 0.2 * arm.coulomb[a])

    def push(self, s: State, f: Forces, memory: Any) -> None:
        a, b = self.joints
        f.link[:, a] += self.mask * self.strength * np.sin(2 * s.q[:, a] + 3 * s.q[:, b])

    def depends_on(self, arm: Arm) -> list[str]:
        return [f"q_{arm.joints[j]}" for j in self.joints]


@dataclass(frozen=True)
class SloshingPayload(Outside):
    """A liquid of this mass at the tool swings along the link's y axis on a hidden spring: x'' = −ω² x − 2 ζ ω x' − (a − g)·e.

    It pushes the tool with −m x'' e; the acceleration of the tool is the one of the step before.
    """

    name = "sloshing_payload"
    unit = "kg"
    equation = "force at the tool = -strength x'' along a transverse axis of the last link, x hidden"
    global_effect = True

    @classmethod
    def draw(cls, arm, motion, rng):
        frame = arm.model.frames[arm.model.getFrameId(arm.tool_link)]
        joint = frame.parentJoint
        shape = {
            "model": arm.model,
            "joint": joint,
            "point": frame.placement * pin.SE3(np.eye(3), arm.tool_point),
            "omega": rng.uniform(4.0, 9.0),
            "damping": rng.uniform(0.05, 0.15),
        }
        return cls((), 0.5, shape)

    def memory(self, shape: tuple[int, int]):
        return {
            "x": np.full(shape[0], np.nan),
            "v": np.zeros(shape[0]),
            "force": np.zeros(shape),
            "data": self.shape["model"].createData(),
        }

    def tool_motion(self, data, q, v, a) -> tuple[float, np.ndarray]:
        """Acceleration less gravity along e, and the joint torques of a unit force along e."""
        model, joint, point = self.shape["model"], self.shape["joint"], self.shape["point"]
        pin.computeJointJacobians(model, data, q)
        pin.forwardKinematics(model, data, q, v, a)
        jacobian = pin.getJointJacobian(model, data, joint, pin.LOCAL)
        spatial, twist = point.actInv(data.a[joint]), point.actInv(data.v[joint])
        local = spatial.linear + np.cross(twist.angular, twist.linear)
        gravity = data.oMi[joint].rotation.T @ model.gravity.linear
        row = (point.toActionMatrixInverse() @ jacobian)[1]
        return float((local - gravity)[1]), row

    def push(self, s: State, f: Forces, memory: Any) -> None:
        f.link += memory["force"]

    def advance(self, s: State, memory: Any, step: float):
        omega, zeta = self.shape["omega"], self.shape["damping"]
        for b in np.flatnonzero(self.mask):
            drive, row = self.tool_motion(memory["data"], s.q[b], s.v[b], s.a[b])
            if np.isnan(memory["x"][b]):  # starts at rest
                memory["x"][b] = -drive / omega**2
            acceleration = -(omega**2) * memory["x"][b] - 2 * zeta * omega * memory["v"][b] - drive
            memory["v"][b] += step * acceleration
            memory["x"][b] += step * memory["v"][b]
            memory["force"][b] = -self.strength * acceleration * row
        return memory

    def depends_on(self, arm: Arm) -> list[str]:
        return ["time", *(f"ddq_{j}" for j in arm.joints), *(f"q_{j}" for j in arm.joints)]


@dataclass(frozen=True)
class SensorSaturation(Outside):
    """The torque channel clips softly at a share 1 − strength of its largest value."""

    name = "sensor_saturation"
    unit = "1"
    equation = "recorded = tau / (1 + |tau/L|^12)^(1/12), L = (1 - strength) largest torque"
    largest = 0.9

    @classmethod
    def draw(cls, arm, motion, rng):
        j = loaded_joint(motion, rng)
        return cls((j,), 0.3, {"top": float(np.abs(motion.load[:, j]).max() + arm.coulomb[j] + 0.5 * arm.viscous[j])})

    def sense(self, x: Signals, arm: Arm) -> None:
        limit = (1 - self.strength) * self.shape["top"]
        tau = x.tau[:, self.j]
        clipped = tau / (1 + (np.abs(tau) / limit) ** 12) ** (1 / 12)
        x.tau[:, self.j] += self.mask[:, None] * (clipped - tau) * (self.strength > 0)

    def depends_on(self, arm: Arm) -> list[str]:
        return ["load_torque"]


@dataclass(frozen=True)
class CrossTalk(Outside):
    name = "cross_talk"
    unit = "1"
    equation = "recorded tau_a = true tau_a + strength tau_b"

    @classmethod
    def draw(cls, arm, motion, rng):
        b = loaded_joint(motion, rng)
        a = int(rng.choice([j for j in range(arm.n) if j != b]))
        return cls((a, b), 0.05)

    def sense(self, x: Signals, arm: Arm) -> None:
        a, b = self.joints
        x.tau[:, a] += self.mask[:, None] * self.strength * x.tau[:, b]

    def depends_on(self, arm: Arm) -> list[str]:
        other = arm.joints[self.joints[1]]
        return ["load_torque", f"q_{other}", f"sign(dq_{other})", f"dq_{other}"]


@dataclass(frozen=True)
class SpeedDependentGain(Outside):
    name = "speed_dependent_torque_constant"
    unit = "s/rad"
    equation = "recorded = (1 + strength |dq|) true"

    @classmethod
    def draw(cls, arm, motion, rng):
        return cls((loaded_joint(motion, rng),), 0.1)

    def sense(self, x: Signals, arm: Arm) -> None:
        x.tau[:, self.j] *= 1 + self.mask[:, None] * self.strength * np.abs(x.dq[:, self.j])

    def depends_on(self, arm: Arm) -> list[str]:
        return ["load_torque", f"dq_{arm.joints[self.j]}"]


@dataclass(frozen=True)
class SupplySag(Outside):
    """The drive believes in a full supply: when all motors draw power, the recorded torque overstates the true one."""

    name = "power_supply_sag"
    unit = "1"
    equation = "recorded = (1 + strength P / P_max) true, P the mechanical power of all motors where positive"
    global_effect = True

    @classmethod
    def draw(cls, arm, motion, rng):
        return cls((), 0.1)

    def sense(self, x: Signals, arm: Arm) -> None:
        power = np.maximum((x.tau * x.dq).sum(axis=1, keepdims=True), 0.0)
        x.tau *= 1 + self.mask[:, None, None] * self.strength * power / power.max()

    def depends_on(self, arm: Arm) -> list[str]:
        return ["load_torque", *(f"dq_{j}" for j in arm.joints)]


@dataclass(frozen=True)
class GainDrift(Outside):
    """The torque channel's gain drifts with time since start (a strain gauge that warms up)."""

    name = "torque_gain_drift"
    unit = "1"
    equation = "recorded = (1 + strength t / T) true"

    @classmethod
    def draw(cls, arm, motion, rng):
        return cls((loaded_joint(motion, rng),), 0.1)

    def sense(self, x: Signals, arm: Arm) -> None:
        x.tau[:, self.j] *= 1 + self.mask[:, None] * self.strength * np.maximum(x.t, 0.0) / x.t[-1]

    def depends_on(self, arm: Arm) -> list[str]:
        return ["time", "load_torque"]
