"""Listed springs: the exact unilateral laws, Eq. 3 and Eq. 5."""

import numpy as np

from validation.concealed.arms import Arm


def pea_torque(spring: dict, q: np.ndarray) -> np.ndarray:
    """Torque of a unilateral spring across one joint [Nm]: k (q_eq − q) where it is compressed, else 0."""
    stretch = spring["equilibrium_rad"] - q
    stretch = np.maximum(stretch, 0.0) if spring.get("active", "below") == "below" else np.minimum(stretch, 0.0)
    return spring["stiffness_Nm_per_rad"] * stretch


def bpea_tension(spring: dict, qa: np.ndarray, qb: np.ndarray) -> np.ndarray:
    """Torque of Eq. 5 per metre of pulley radius [N]: k_b/r1² Δl where Δl = −r2 q_a − r3 q_b − r1 q0 > 0."""
    r1, r2, r3 = (spring[f"radius{i}_m"] for i in (1, 2, 3))
    length = -r2 * qa - r3 * qb - r1 * spring["equilibrium_rad"]
    return spring["stiffness_Nm_per_rad"] / r1**2 * np.maximum(length, 0.0)


def spring_torque(springs: dict, arm: Arm, q: np.ndarray) -> np.ndarray:
    """Torque of all listed springs of a recording on its joints [Nm], shaped as q (n, ...)."""
    tau = np.zeros_like(q)
    for joint, spring in springs.get("pea", {}).items():
        tau[arm.index(joint)] += pea_torque(spring, q[arm.index(joint)])
    if "bpea" in springs:
        spring = springs["bpea"]
        a, b = (arm.index(j) for j in spring["joints"])
        tension = bpea_tension(spring, q[a], q[b])
        tau[a] += spring["radius2_m"] * tension
        tau[b] += spring["radius3_m"] * tension
    return tau


class SpringBank:
    """The same torques for all recordings at one instant, with q (B, n) and tau (B, n); coefficients stacked once."""

    def __init__(self, springs: list[dict], arm: Arm):
        shape = (len(springs), arm.n)
        self.stiffness, self.equilibrium, self.side = np.zeros(shape), np.zeros(shape), np.ones(shape)
        for b, listed in enumerate(springs):
            for joint, s in listed.get("pea", {}).items():
                at = b, arm.index(joint)
                self.stiffness[at], self.equilibrium[at] = s["stiffness_Nm_per_rad"], s["equilibrium_rad"]
                self.side[at] = 1.0 if s.get("active", "below") == "below" else -1.0
        self.cross = [
            (b, s["bpea"], arm.index(s["bpea"]["joints"][0]), arm.index(s["bpea"]["joints"][1]))
            for b, s in enumerate(springs)
            if "bpea" in s
        ]
        self.empty = not self.cross and not self.stiffness.any()

    def pea(self, q: np.ndarray) -> np.ndarray:
        """Torques of the single-joint springs, (B, n)."""
        return self.stiffness * self.side * np.maximum(self.side * (self.equilibrium - q), 0.0)

    def tension(self, q: np.ndarray) -> list[float]:
        """Tension of each two-joint spring's cable [N], in the order of `cross`."""
        return [float(bpea_tension(s, q[b, i], q[b, j])) for b, s, i, j in self.cross]

    def torque(self, q: np.ndarray) -> np.ndarray:
        tau = self.pea(q)
        for (b, s, i, j), tension in zip(self.cross, self.tension(q), strict=True):
            tau[b, i] += s["radius2_m"] * tension
            tau[b, j] += s["radius3_m"] * tension
        return tau
