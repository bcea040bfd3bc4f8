# pyright: reportAttributeAccessIssue=false
"""Catalogue effects of springs and of the rigid body."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pinocchio as pin

from validation.concealed.arms import Arm, holding_torque
from validation.concealed.effect import Body, Effect, Forces, State, any_joint, loaded_joint
from validation.concealed.springs import bpea_tension, pea_torque


@dataclass(frozen=True)
class CableHarness(Effect):
    name = "cable_harness"
    equation = "tau = -stiffness (q - rest)"

    @classmethod
    def draw(cls, arm, motion, rng):
        j = any_joint(motion, rng)
        return cls((j,), 0.1 * arm.coulomb[j], {"rest": rng.uniform(*np.quantile(motion.q[:, j], [0.1, 0.9]))})

    def push(self, s: State, f: Forces, memory: Any) -> None:
        f.link[:, self.j] -= self.mask * self.strength * (s.q[:, self.j] - self.shape["rest"])

    def parameters(self, arm: Arm):
        return {"stiffness": (self.strength, "Nm/rad"), "rest": (self.shape["rest"], "rad")}


@dataclass(frozen=True)
class HardeningHarness(CableHarness):
    """As stiff again at the ends of the motion as in its middle, or up to four times; the strength is the stiffness in its middle."""

    name = "hardening_harness"
    told = "cable_harness"
    equation = "tau = -stiffness (q - rest) - hardening (q - rest)^3"

    @classmethod
    def draw(cls, arm, motion, rng):
        drawn = super().draw(arm, motion, rng)
        end = float(np.abs(motion.q[:, drawn.j] - drawn.shape["rest"]).max())
        return replace(drawn, shape=drawn.shape | {"ratio": rng.uniform(1.0, 4.0) / end**2})

    def push(self, s: State, f: Forces, memory: Any) -> None:
        x = s.q[:, self.j] - self.shape["rest"]
        f.link[:, self.j] -= self.mask * self.strength * (x + self.shape["ratio"] * x**3)

    def parameters(self, arm: Arm):
        return {**super().parameters(arm), "hardening": (self.strength * self.shape["ratio"], "Nm/rad³")}


@dataclass(frozen=True)
class ParallelSpring(Effect):
    """Unilateral; its equilibrium lies inside the motion, so that it engages and lets go."""

    name = "parallel_spring"
    equation = "tau = stiffness (equilibrium - q) where q is on the active side, else 0"

    @classmethod
    def draw(cls, arm, motion, rng):
        j = loaded_joint(motion, rng, 0.1)
        active = str(rng.choice(["below", "below", "above"]))
        quantile = rng.uniform(0.45, 0.85) if active == "below" else rng.uniform(0.15, 0.55)
        return cls((j,), 0.2 * arm.coulomb[j], {"equilibrium": float(np.quantile(motion.q[:, j], quantile)), "active": active})

    def push(self, s: State, f: Forces, memory: Any) -> None:
        spring = {
            "stiffness_Nm_per_rad": self.strength,
            "equilibrium_rad": self.shape["equilibrium"],
            "active": self.shape["active"],
        }
        f.link[:, self.j] += self.mask * pea_torque(spring, s.q[:, self.j])

    def parameters(self, arm: Arm):
        return {
            "stiffness": (self.strength, "Nm/rad"),
            "equilibrium": (self.shape["equilibrium"], "rad"),
            "active": (self.shape["active"], ""),
        }


@dataclass(frozen=True)
class BiarticularSpring(Effect):
    name = "biarticular_spring"
    equation = "tau_a = kappa max(-q_a - rho q_b - phi, 0), tau_b = rho tau_a"

    @classmethod
    def draw(cls, arm, motion, rng):
        a = int(rng.integers(arm.n - 1))
        rho = rng.uniform(0.4, 1.3)
        stretch = -motion.q[:, a] - rho * motion.q[:, a + 1]
        phi = float(np.quantile(stretch, rng.uniform(0.2, 0.55)))
        return cls((a, a + 1), 0.2 * arm.coulomb[a], {"rho": rho, "phi": phi})

    def push(self, s: State, f: Forces, memory: Any) -> None:
        a, b = self.joints
        stretch = -s.q[:, a] - self.shape["rho"] * s.q[:, b] - self.shape["phi"]
        torque = self.mask * self.strength * np.maximum(stretch, 0.0)
        f.link[:, a] += torque
        f.link[:, b] += self.shape["rho"] * torque

    def parameters(self, arm: Arm):
        return {
            "kappa": (self.strength, "Nm/rad"),
            "rho": (self.shape["rho"], "1"),
            "phi": (self.shape["phi"], "rad"),
        }


@dataclass(frozen=True)
class TwoSidedBiarticularSpring(Effect):
    """Never slack; its lever has either sign, as the cable is led straight or crossed."""

    name = "two_sided_biarticular_spring"
    equation = "tau_a = -kappa (q_a + rho q_b - phi), tau_b = rho tau_a"

    @classmethod
    def draw(cls, arm, motion, rng):
        a = int(rng.integers(arm.n - 1))
        rho = float(rng.choice([-1, 1]) * rng.uniform(0.4, 1.6))
        length = motion.q[:, a] + rho * motion.q[:, a + 1]
        return cls((a, a + 1), 0.1 * arm.coulomb[a], {"rho": rho, "phi": float(np.quantile(length, rng.uniform(0.2, 0.8)))})

    def push(self, s: State, f: Forces, memory: Any) -> None:
        (a, b), rho = self.joints, self.shape["rho"]
        pull = self.mask * self.strength * (self.shape["phi"] - s.q[:, a] - rho * s.q[:, b])
        f.link[:, a] += pull
        f.link[:, b] += rho * pull

    def parameters(self, arm: Arm):
        return {
            "kappa": (self.strength, "Nm/rad"),
            "rho": (self.shape["rho"], "1"),
            "phi": (self.shape["phi"], "rad"),
        }


@dataclass(frozen=True)
class ListedSpring(Effect):
    """An effect on the listed springs of one joint, or on the listed two-joint spring (`joints` has two then)."""

    @classmethod
    def draw(cls, arm, motion, rng):
        kinds = sorted({("pea", j) for s in motion.springs for j in s.get("pea", {})})
        kinds += [("bpea", None)] if any("bpea" in s for s in motion.springs) else []
        if not kinds:
            raise ValueError("no spring is listed in any recording: a spring effect has nothing to act on")
        kind, joint = kinds[rng.integers(len(kinds))]
        if kind == "pea":
            joints, listed = (arm.index(joint),), [s.get("pea", {}).get(joint) for s in motion.springs]
        else:
            listed = [s.get("bpea") for s in motion.springs]
            first = next(s for s in listed if s)
            joints = tuple(arm.index(j) for j in first["joints"])
        return cls(joints, 0.05, {"direction": float(rng.choice([-1, 1])), "listed": listed})

    def others(self, q: np.ndarray, b: int, change) -> np.ndarray:
        """Torque difference on this effect's joints in recording b, where `change` maps a listed to the true spring."""
        spring = self.shape["listed"][b]
        if len(self.joints) == 1:
            return np.array([pea_torque(change(spring), q[self.j]) - pea_torque(spring, q[self.j])])
        qa, qb = q[list(self.joints)]
        tension = bpea_tension(change(spring), qa, qb) - bpea_tension(spring, qa, qb)
        return tension * np.array([spring["radius2_m"], spring["radius3_m"]])

    def push(self, s: State, f: Forces, memory: Any) -> None:
        for b in np.flatnonzero(self.mask):
            if self.shape["listed"][b]:
                f.link[b, list(self.joints)] += self.others(s.q[b], int(b), self.changed)

    def changed(self, spring: dict) -> dict:
        raise NotImplementedError


@dataclass(frozen=True)
class SpringStiffness(ListedSpring):
    name = "spring_stiffness"
    equation = "true stiffness = scale * listed"
    largest = 0.9

    def changed(self, spring: dict) -> dict:
        scale = 1 + self.shape["direction"] * self.strength
        return spring | {"stiffness_Nm_per_rad": scale * spring["stiffness_Nm_per_rad"]}

    def parameters(self, arm: Arm):
        return {"scale": (1 + self.shape["direction"] * self.strength, "1")}


@dataclass(frozen=True)
class SpringPreload(ListedSpring):
    name = "spring_preload"
    equation = "true equilibrium = listed + offset"
    largest = 1.5

    def changed(self, spring: dict) -> dict:
        return spring | {"equilibrium_rad": spring["equilibrium_rad"] + self.shape["direction"] * self.strength}

    def parameters(self, arm: Arm):
        return {"offset": (self.shape["direction"] * self.strength, "rad")}


@dataclass(frozen=True)
class SpringHysteresis(ListedSpring):
    """The loss opposes the rate of the spring's own stretch: dq, or r2 dq_a + r3 dq_b."""

    name = "spring_hysteresis"
    equation = "tau = -loss |tau_spring| sgn(stretch rate)"
    largest = 0.7

    @classmethod
    def draw(cls, arm, motion, rng):
        drawn = super().draw(arm, motion, rng)
        return replace(drawn, shape=drawn.shape | {"width": arm.width})

    def push(self, s: State, f: Forces, memory: Any) -> None:
        for b in np.flatnonzero(self.mask):
            spring = self.shape["listed"][b]
            if not spring:
                continue
            ratio = np.array([1.0])
            if len(self.joints) == 2:
                ratio = np.array([1.0, spring["radius3_m"] / spring["radius2_m"]])
            torque = self.others(s.q[b], int(b), lambda x: x | {"stiffness_Nm_per_rad": 2 * x["stiffness_Nm_per_rad"]})
            sign = np.tanh(ratio @ s.v[b, list(self.joints)] / self.shape["width"])
            f.link[b, list(self.joints)] -= self.strength * np.abs(torque) * sign

    def parameters(self, arm: Arm):
        return {"loss": (self.strength, "1")}


@dataclass(frozen=True)
class PayloadMass(Effect):
    name = "payload_mass"
    equation = "mass at the tool = listed + mass"
    global_effect = True

    @classmethod
    def draw(cls, arm, motion, rng):
        direction = -1.0 if motion.payload.min() > 0 and rng.random() < 0.5 else 1.0
        return cls((), 0.2, {"direction": direction, "listed": float(motion.payload.min())})

    def edit(self, body: Body) -> None:
        body.payload = max(body.payload + self.shape["direction"] * self.strength, 0.0)

    def parameters(self, arm: Arm):
        mass = self.shape["direction"] * self.strength
        return {"mass": (max(mass, -self.shape["listed"]) if mass < 0 else mass, "kg")}


@dataclass(frozen=True)
class PayloadCom(Effect):
    name = "payload_com"
    equation = "centre of the payload = tool point + (x, y, z) in the link's frame"
    global_effect = True
    largest = 0.5

    @classmethod
    def draw(cls, arm, motion, rng):
        axis = rng.normal(size=3)
        return cls((), 0.05, {"axis": axis / np.linalg.norm(axis)})

    def edit(self, body: Body) -> None:
        body.point = body.point + self.strength * self.shape["axis"]

    def parameters(self, arm: Arm):
        return {k: (float(self.strength * x), "m") for k, x in zip("xyz", self.shape["axis"], strict=True)}


@dataclass(frozen=True)
class LinkInertial(Effect):
    """A body nobody modelled is bolted to a link: mass, first moment and inertia (about the link frame's origin)."""

    name = "link_inertial"
    largest = 5.0
    equation = "a body of this mass, first moment m c and inertia about the link frame's origin is added to the link"

    @classmethod
    def draw(cls, arm, motion, rng):
        gravity = holding_torque(arm.model, arm.lower, arm.upper)
        j = int(rng.choice(np.flatnonzero(gravity > 0.1 * gravity.max())))  # about the vertical it would be an armature
        lever = arm.model.inertias[j + 1].lever
        return cls((j,), 0.3, {"centre": lever * rng.uniform(0.5, 1.8) + rng.uniform(-0.03, 0.03, 3), "radius": 0.04})

    def inertia(self) -> pin.Inertia:
        about_centre = 0.4 * self.strength * self.shape["radius"] ** 2 * np.eye(3)
        return pin.Inertia(self.strength, self.shape["centre"], about_centre)

    def edit(self, body: Body) -> None:
        if self.strength > 0:
            body.model.appendBodyToJoint(self.j + 1, self.inertia(), pin.SE3.Identity())

    def parameters(self, arm: Arm):
        if "beside" in self.shape:  # of a link whose stated parameters are off already
            return inertial_parameters(self.inertia().toDynamicParameters() + self.shape["beside"])
        c, m = self.shape["centre"], self.strength
        about_origin = 0.4 * m * self.shape["radius"] ** 2 * np.eye(3) + m * (c @ c * np.eye(3) - np.outer(c, c))
        return {
            "mass": (m, "kg"),
            "first_moment": ((m * c).tolist(), "kg m"),
            "inertia": (about_origin.tolist(), "kg m²"),
        }


def inertial_parameters(p: np.ndarray) -> dict[str, tuple[Any, str]]:
    """As the truth has them, of Pinocchio's ten: m, m c, and Ixx, Ixy, Iyy, Ixz, Iyz, Izz about the link frame's origin."""
    inertia = p[[4, 5, 7, 5, 6, 8, 7, 8, 9]].reshape(3, 3)
    return {"mass": (float(p[0]), "kg"), "first_moment": (p[1:4].tolist(), "kg m"), "inertia": (inertia.tolist(), "kg m²")}


@dataclass(frozen=True)
class GravityTilt(Effect):
    """The base is turned by the rotation vector w = (about_x, about_y, 0); gravity in the base frame is exp(w)ᵀ g."""

    name = "gravity_tilt"
    equation = "gravity in the base frame = exp((about_x, about_y, 0))^T g"
    global_effect = True
    largest = 0.5

    @classmethod
    def draw(cls, arm, motion, rng):
        angle = rng.uniform(0, 2 * np.pi)
        return cls((), 0.02, {"axis": np.array([np.cos(angle), np.sin(angle)])})

    def edit(self, body: Body) -> None:
        base = pin.exp3(np.array([*(self.strength * self.shape["axis"]), 0.0]))
        body.model.gravity.linear = base.T @ body.model.gravity.linear

    def parameters(self, arm: Arm):
        return {f"about_{k}": (float(self.strength * a), "rad") for k, a in zip("xy", self.shape["axis"], strict=True)}
