"""What is hidden in an arm: torques that its motors need beyond plain physics, twists behind its encoders, faults of its sensors.

Every law stands by itself, for this plant; those with `inside` are in the catalogue of the tool under the same name.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np

from validation.chains.arms import Arm


class Motion(NamedTuple):
    """Motion and load of the joints, (n,) or (n, F): q [rad], v [rad/s], s the sign of v by which dry friction turns, load [Nm]; t [s]."""

    q: Any
    v: Any
    s: Any
    load: Any
    t: Any


Numbers = Mapping[str, float]
Torque = Callable[[Numbers, Motion, tuple[int, ...]], tuple[Any, ...]]


@dataclass(frozen=True)
class Law:
    """A law that can be hidden.

    Attributes:
        draw: Parameters [SI] for a joint of dry friction d and usual torque u [Nm].
        torque: What the motors need more, a row for each joint; of a "twist" how far the encoder is ahead of the link [rad], of a
            "sensor" what is added to a torque, of the "encoder" to a position.
        inside: Whether the tool's catalogue has it.
        acts: On what.
        joints: How many.
        whole: Whether it needs the whole motion at once.
    """

    draw: Callable[[np.random.Generator, float, float], dict[str, float]]
    torque: Torque
    inside: bool = True
    acts: Literal["motor", "twist", "sensor", "encoder", "tool"] = "motor"
    joints: int = 1
    whole: bool = False


def own(f: Callable[[Numbers, Any, Any, Any], Any]) -> Torque:
    """A law of the joint's own position, speed and sign."""
    return lambda p, x, j: (f(p, x.q[j[0]], x.v[j[0]], x.s[j[0]]),)


def bristle(p: Numbers, x: Motion, j: tuple[int, ...]) -> tuple[np.ndarray]:
    """Dahl's friction in place of the plain one: dz = dv − |dv| z over a range."""
    z, moved, state = np.zeros_like(x.q[j[0]]), np.diff(x.q[j[0]], prepend=x.q[j[0]][0]) / p["range"], 0.0
    for k, step in enumerate(moved):
        state = np.sign(step) + (state - np.sign(step)) * np.exp(-abs(step)) if step else state
        z[k] = state
    return (p["level"] * (z - x.s[j[0]]),)


def on_crank(p: Numbers, q: Any, force: Callable[[Any], Any]) -> Any:
    """Torque against a pull [N], given by its length [m], between a crank's pin and a fixed point."""
    a, b, angle = p["crank"], p["far"], q + p["angle"]
    length = np.sqrt(a * a + b * b - 2 * a * b * np.cos(angle))
    return force(length) * a * b * np.sin(angle) / length


def wave(p: Numbers, t: Any) -> Any:
    """Three slow sines, of size 1."""
    return sum(np.sin(2 * np.pi * t / p["period"] * k + p["phase"] * k) for k in (1, 1.7, 2.3)) / 1.2


def detent(p: Numbers, q: Any) -> Any:
    """Torque near places that are a pitch apart."""
    x = ((q - p["place"] + p["pitch"] / 2) % p["pitch"] - p["pitch"] / 2) / p["width"]
    return p["amplitude"] * x * np.exp(0.5 - x * x / 2)


# fmt: off
LAWS: dict[str, Law] = {
    "stribeck": Law(lambda r, d, u: {"excess": d * r.uniform(0.5, 1.2), "velocity": r.uniform(0.05, 0.25)},
                    own(lambda p, q, v, s: p["excess"] * np.exp(-((v / p["velocity"]) ** 2)) * s)),
    "quadratic_drag": Law(lambda r, d, u: {"coefficient": u * r.uniform(0.05, 0.2)}, own(lambda p, q, v, s: p["coefficient"] * v * abs(v))),
    "coulomb_asymmetry": Law(lambda r, d, u: {"asymmetry": d * r.uniform(0.3, 0.8)}, own(lambda p, q, v, s: p["asymmetry"] / 2 * s * s)),
    "viscous_asymmetry": Law(lambda r, d, u: {"asymmetry": u * r.uniform(0.06, 0.2)}, own(lambda p, q, v, s: p["asymmetry"] / 2 * v * s)),
    "position_dependent_friction": Law(
        lambda r, d, u: {"amplitude": d * r.uniform(0.3, 0.7), "order": float(r.integers(1, 4)), "phase": r.uniform(0, 6)},
        own(lambda p, q, v, s: p["amplitude"] * s * np.cos(p["order"] * q + p["phase"]))),
    "load_dependent_friction": Law(lambda r, d, u: {"mu": r.uniform(0.06, 0.2)},
                                   lambda p, x, j: (p["mu"] * abs(x.load[j[0]]) * x.s[j[0]],)),
    "friction_drift": Law(lambda r, d, u: {"level": d, "ratio": r.uniform(0.4, 0.9), "time_constant": r.uniform(3, 6)},
                          lambda p, x, j: (p["ratio"] * p["level"] * x.s[j[0]] * np.exp(-x.t / p["time_constant"]),)),
    "presliding_hysteresis": Law(lambda r, d, u: {"level": d, "range": r.uniform(0.03, 0.08)}, bristle, whole=True),
    "torque_ripple": Law(lambda r, d, u: {"amplitude": u * r.uniform(0.06, 0.15), "order": float(r.integers(6, 20)), "phase": r.uniform(0, 6)},
                         own(lambda p, q, v, s: p["amplitude"] * np.sin(p["order"] * q + p["phase"]))),
    "cable_harness": Law(lambda r, d, u: {"stiffness": u * r.uniform(0.15, 0.5), "rest": r.uniform(-0.5, 0.5)},
                         own(lambda p, q, v, s: p["stiffness"] * (q - p["rest"]))),
    "parallel_spring": Law(lambda r, d, u: {"stiffness": u * r.uniform(0.3, 0.9), "equilibrium": r.uniform(-0.2, 0.5)},
                           own(lambda p, q, v, s: -p["stiffness"] * np.maximum(p["equilibrium"] - q, 0))),
    "two_sided_biarticular_spring": Law(
        lambda r, d, u: {"kappa": u * r.uniform(0.15, 0.4), "rho": r.uniform(-0.9, 0.9), "phi": r.uniform(-0.3, 0.3)},
        lambda p, x, j: tuple(p["kappa"] * (x.q[j[0]] + p["rho"] * x.q[j[1]] - p["phi"]) * k for k in (1.0, p["rho"])), joints=2),
    "torque_offset": Law(lambda r, d, u: {"offset": u * r.uniform(0.08, 0.25) * r.choice([-1, 1])},
                         lambda p, x, j: (p["offset"] + 0 * x.load[j[0]],), acts="sensor"),
    "torque_gain": Law(lambda r, d, u: {"gain": r.uniform(0.08, 0.25) * r.choice([-1, 1])},
                       lambda p, x, j: (p["gain"] * x.load[j[0]],), acts="sensor"),
    "encoder_offset": Law(lambda r, d, u: {"offset": r.uniform(0.05, 0.12) * r.choice([-1, 1])},
                          lambda p, x, j: (p["offset"] + 0 * x.q[j[0]],), acts="encoder"),
    "joint_elasticity": Law(lambda r, d, u: {"stiffness": u / r.uniform(0.015, 0.04)},
                            lambda p, x, j: (x.load[j[0]] / p["stiffness"],), acts="twist", whole=True),
    "backlash": Law(lambda r, d, u: {"gap": r.uniform(0.008, 0.03), "soft": 0.1 * u},
                    lambda p, x, j: (p["gap"] / 2 * np.tanh(x.load[j[0]] / p["soft"]),), acts="twist", whole=True),
    "payload_mass": Law(lambda r, d, u: {"share": r.uniform(0.2, 0.5)}, lambda p, x, j: (), acts="tool"),
    "gas_strut": Law(lambda r, d, u: {"force": u / 0.06 * r.uniform(0.3, 0.7), "crank": 0.06, "far": 0.22, "angle": r.uniform(0.4, 1.2)},
                     own(lambda p, q, v, s: on_crank(p, q, lambda x: p["force"] * (1 + 3.5 * (0.26 - x)))), inside=False),
    "coil_on_crank": Law(
        lambda r, d, u: {"stiffness": u / 0.05**2 * r.uniform(0.4, 1), "crank": 0.05, "far": 0.12, "free": 0.07, "angle": r.uniform(-1, 1)},
        own(lambda p, q, v, s: on_crank(p, q, lambda x: p["stiffness"] * np.maximum(x - p["free"], 0))), inside=False),
    "magnetic_detent": Law(
        lambda r, d, u: {"amplitude": u * r.uniform(0.1, 0.3), "place": r.uniform(0, 1), "pitch": r.uniform(0.3, 0.7), "width": 0.06},
        own(lambda p, q, v, s: detent(p, q)), inside=False),
    "pulling_cable": Law(lambda r, d, u: {"amplitude": u * r.uniform(0.12, 0.3), "phase": r.uniform(0, 6)},
                         lambda p, x, j: (p["amplitude"] * np.sin(1.3 * x.q[j[1]] + p["phase"]), 0 * x.q[j[1]]), inside=False, joints=2),
    "one_way_friction": Law(lambda r, d, u: {"amplitude": d * r.uniform(0.6, 1.4), "phase": r.uniform(0, 6)},
                            own(lambda p, q, v, s: p["amplitude"] * (1 + s) / 2 * (1 + np.cos(2 * q + p["phase"])) / 2), inside=False),
    "thermal_wander": Law(lambda r, d, u: {"amplitude": u * r.uniform(0.06, 0.15), "period": r.uniform(8, 15), "phase": r.uniform(0, 6)},
                          lambda p, x, j: (p["amplitude"] * wave(p, x.t) + 0 * x.load[j[0]],), inside=False),
}
# fmt: on


@dataclass(frozen=True)
class Effect:
    """A law at its joints, with its parameters."""

    name: str
    joints: tuple[int, ...]
    parameters: Mapping[str, float]

    @property
    def law(self) -> Law:
        """It."""
        return LAWS[self.name]

    def of(self, x: Motion) -> list[tuple[int, Any]]:
        """What it adds, joint by joint."""
        return list(zip(self.joints, self.law.torque(self.parameters, x, self.joints), strict=True))

    def truth(self, arm: Arm) -> dict[str, object]:
        """The effect as it is sealed."""
        names = [arm.joints[j] for j in self.joints]
        joint = None if self.law.acts == "tool" else names[0] if len(names) == 1 else names
        return {"effect": self.name, "joint": joint, "parameters": dict(self.parameters), "in_catalogue": self.law.inside}


def drawn(arm: Arm, allowed: Callable[[Law], bool], rng: np.random.Generator) -> Effect:
    """An effect at a joint, large enough to be seen."""
    names = [name for name, law in LAWS.items() if law.joints <= arm.n and allowed(law)]
    name = str(rng.choice(names))
    joint = int(rng.integers(arm.n))
    joints = (
        (joint, int(rng.choice([j for j in (joint - 1, joint + 1) if 0 <= j < arm.n])))[: LAWS[name].joints]
        if arm.n > 1
        else (0,)
    )
    u = float(arm.usual[joint])
    parameters = LAWS[name].draw(rng, max(float(arm.dry[joint]), 0.05 * u), u)
    return Effect(name, joints, {k: float(x) for k, x in parameters.items()})
