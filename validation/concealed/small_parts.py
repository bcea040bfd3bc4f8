# pyright: reportAttributeAccessIssue=false
"""What of the small faults the truth lists, and how large each shows: linearised, as if it were alone, beside the plain model."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from validation.concealed.catalogue import CATALOGUE
from validation.concealed.effect import Body, Effect, Forces, Signals, State
from validation.concealed.effects_body import LinkInertial, inertial_parameters
from validation.concealed.effects_sensor import TimeDelay, TorqueGain
from validation.concealed.imperfect import ImperfectBench
from validation.concealed.imperfections import Clocks, SmallFriction, SpeedFilter
from validation.concealed.plain import inverse_dynamics
from validation.concealed.plant import bodies
from validation.concealed.stated import inertial_errors


@dataclass(frozen=True)
class TrueBody(Effect):
    """One joint's body as it is, in an arm as it is stated."""

    def edit(self, body: Body) -> None:
        body.model.inertias[self.j + 1] = self.shape["inertia"]


def small_parts(bench: ImperfectBench, effects: Sequence[Effect]) -> list[dict[str, Any]]:
    """The faults that are left beside strong effects, in the form of the truth's effects."""
    links = {e.j for e in effects if isinstance(e, LinkInertial)}
    seen = Seen(bench, effects)
    out = []
    for fault in bench.small(effects):
        if isinstance(fault, SmallFriction):
            out += friction_parts(bench, seen, fault)
        elif isinstance(fault, TorqueGain):
            torque = seen.on(fault.j, fault.shape["direction"] * fault.strength * seen.recorded.tau[:, fault.j])
            out.append(entry(bench, fault.name, fault.j, fault.equation, fault.parameters(bench.arm), seen.ratio(torque)))
        elif isinstance(fault, TimeDelay):
            torque = -fault.strength * np.gradient(seen.recorded.tau, seen.recorded.t, axis=2)
            out.append(entry(bench, fault.name, None, fault.equation, fault.parameters(bench.arm), seen.ratio(torque)))
        else:
            out += recording_parts(bench, fault)
    out += [part for j, part in enumerate(link_parts(bench, seen)) if j not in links]
    return sorted(out, key=lambda p: -p["ratio"]["reached"] if p["ratio"] else 0.0)


def entry(bench: ImperfectBench, effect: str, j: int | None, equation: str, parameters: Mapping, ratio: Any) -> dict[str, Any]:
    return {
        "effect": effect,
        "in_catalogue": effect in CATALOGUE,
        "joint": None if j is None else bench.arm.joints[j],
        "recordings": "all",
        "equation": equation,
        "parameters": {k: {"value": v, "unit": u} for k, (v, u) in parameters.items()},
        "ratio": ratio,
    }


class Seen:
    """The seen recordings of a case, without noise: what was recorded, and the state of the plant."""

    def __init__(self, bench: ImperfectBench, effects: Sequence[Effect]):
        self.bench = bench
        self.recorded = bench.thin(bench.signals(list(effects)))
        h = bench.history(list(effects))
        self.motor, load = (bench.thin(Signals(h.t, h.theta, h.dtheta, h.ddtheta, x)) for x in (h.motor, h.load))
        self.load = load.tau
        fit = bench.calibrated(self.recorded, bench.width)
        assert fit.inside is not None
        self.inside = fit.inside
        self.basis = [np.linalg.qr(fit.regressor[:, j].reshape(-1, 3))[0] for j in range(bench.arm.n)]

    def on(self, j: int, row: np.ndarray) -> np.ndarray:
        """(B, n, N), nil on all joints but j, where it is `row` (B, N)."""
        out = np.zeros_like(self.load)
        out[:, j] = row
        return out

    def ratio(self, torque: np.ndarray) -> dict[str, Any]:
        """Of a torque (B, n, N): what the plain model cannot express of it, over the floor."""
        left = np.empty(self.bench.arm.n)
        for j, basis in enumerate(self.basis):
            y = (torque[:, j] * self.inside).reshape(-1)
            left[j] = np.sqrt(np.sum((y - basis @ (basis.T @ y)) ** 2) / np.sum(self.inside))
        per_joint = left / self.bench.level
        return {"requested": None, "reached": float(per_joint.max()), "per_joint": per_joint}

    def friction(self, fault: SmallFriction) -> np.ndarray:
        """Torque of dry friction with its small parts, (B, n, N)."""
        x, rows = self.motor, (-1, self.bench.arm.n)
        q, w, a, load, motor = (np.moveaxis(s, 1, -1).reshape(rows) for s in (x.q, x.dq, x.ddq, self.load, x.tau))
        state = State(0.0, q, w, a, q, w, a, load, motor)
        zero = np.zeros_like(q)
        f = Forces(**{x.name: zero.copy() for x in fields(Forces)})
        f.dry += self.bench.arm.coulomb
        fault.push(state, f, np.tanh(w / fault.shape["width"]))
        torque = f.dry * f.sign - f.rotor + f.mu * np.abs(load) * f.sign
        return np.moveaxis(torque.reshape(len(x.q), -1, self.bench.arm.n), -1, 1)


def friction_parts(bench: ImperfectBench, seen: Seen, fault: SmallFriction) -> list[dict[str, Any]]:
    """Each part that a joint has; the bristles' size is not known without a simulation of its own."""
    whole, out = seen.friction(fault), []
    for j in range(bench.arm.n):
        for effect, parameters in fault.parts(j).items():
            part = seen.friction(fault.without(effect, (j,)))
            ratio = None if effect == "presliding_hysteresis" else seen.ratio(whole - part)
            out.append(entry(bench, effect, j, CATALOGUE[effect].equation, parameters, ratio))
        sign = {"width": (fault.shape["width"][j], "rad/s"), "law": (fault.shape["law"], "")}
        out.append(entry(bench, "sign_of_friction", j, "dry friction changes its sign by this law", sign, None))
    return out


def recording_parts(bench: ImperfectBench, fault: Effect) -> list[dict[str, Any]]:
    """Clocks and filters, which the catalogue does not have."""
    if isinstance(fault, SpeedFilter):
        return [entry(bench, fault.name, None, fault.equation, {"lag": (fault.strength, "s")}, None)]
    assert isinstance(fault, Clocks)
    out = []
    for j in range(bench.arm.n):
        clock = {"offset": (fault.shape["offset"][j], "s"), "drift": (fault.shape["drift"][: bench.seen, j], "s")}
        out.append(entry(bench, "clock", j, fault.equation, clock, None))
    return out


def link_parts(bench: ImperfectBench, seen: Seen) -> list[dict[str, Any]]:
    """Of each joint's body, true less stated."""
    x, everywhere = seen.recorded, np.ones(bench.seen)

    def torque(effects: list[Effect]) -> np.ndarray:
        models = bodies(bench.told, bench.listed, effects)
        return np.array([inverse_dynamics(m, x.q[b], x.dq[b], x.ddq[b]) for b, m in enumerate(models)])

    base, out = torque([]), []
    for j, error in enumerate(inertial_errors(bench.arm)):
        true = TrueBody((j,), 1.0, {"inertia": bench.arm.model.inertias[j + 1]}, everywhere)
        ratio = seen.ratio(torque([true]) - base)
        out.append(entry(bench, LinkInertial.name, j, LinkInertial.equation, inertial_parameters(error), ratio))
    return out


def with_stated_error(bench: ImperfectBench, effect: Effect) -> Effect:
    """A body on a link whose stated parameters are off already: what the link lacks is both."""
    if not isinstance(effect, LinkInertial):
        return effect
    return replace(effect, shape=effect.shape | {"beside": inertial_errors(bench.arm)[effect.j]})
