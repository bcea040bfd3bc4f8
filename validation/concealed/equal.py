# pyright: reportAttributeAccessIssue=false
"""Which catalogue effects would explain a concealed effect as well, from numerical Jacobians of the inverse dynamics.

An effect counts as equal where its columns, beside those of the plain model, take up the residual that the truth leaves.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from validation.concealed.arms import Arm
from validation.concealed.effect import Effect, Signals
from validation.concealed.plain import PlainFit, inverse_dynamics
from validation.concealed.plant import Setup, bodies
from validation.concealed.springs import spring_torque

EPS = 1e-4


@dataclass(frozen=True)
class Candidate:
    """A catalogue effect as columns (B, n, N, k), with the joints it sits on."""

    effect: str
    joint: str | list[str] | None
    columns: np.ndarray


class Jacobian:
    """Columns of the catalogue's effects along given motions."""

    def __init__(self, arm: Arm, setup: Setup, x: Signals, fit: PlainFit):
        self.arm, self.setup, self.x, self.fit = arm, setup, x, fit
        self.models = bodies(arm, setup, [])
        self.base = self.torque(self.models, x.q)
        self.sign = np.tanh(x.dq / arm.width)

    def torque(self, models: list[pin.Model], q: np.ndarray) -> np.ndarray:
        x = self.x
        return np.array(
            [
                inverse_dynamics(m, q[b], x.dq[b], x.ddq[b]) - spring_torque(self.setup.springs[b], self.arm, q[b])
                for b, m in enumerate(models)
            ]
        )

    def on(self, j: int, *rows: np.ndarray) -> np.ndarray:
        """Columns that are nil on all joints but j; each row (B, N)."""
        out = np.zeros((*self.x.q.shape, len(rows)))
        for k, row in enumerate(rows):
            out[:, j, :, k] = row
        return out

    def edited(self, change) -> np.ndarray:
        """Derivative with respect to an edit of the models, `change(model, b)` of size EPS, (B, n, N, 1)."""
        models = [m.copy() for m in self.models]
        for b, m in enumerate(models):
            change(m, b)
        return ((self.torque(models, self.x.q) - self.base) / EPS)[..., None]

    def candidates(self) -> Iterator[Candidate]:
        for j, joint in enumerate(self.arm.joints):
            yield from self.joint_candidates(j, joint)
        yield from self.body_candidates()
        yield from self.pair_candidates()
        yield Candidate("torque_gain", None, self.x.tau[..., None])
        yield Candidate("time_delay", None, np.gradient(self.x.tau, self.x.t, axis=2)[..., None])

    def joint_candidates(self, j: int, joint: str) -> Iterator[Candidate]:
        x, s = self.x, self.sign[:, j]
        q, dq, one = x.q[:, j], x.dq[:, j], np.ones_like(s)
        yield Candidate("torque_offset", joint, self.on(j, one))
        yield Candidate("torque_offset", joint, self.on(j, *(one * of[:, None] for of in np.eye(len(q)))))  # another in each
        yield Candidate("torque_gain", joint, self.on(j, x.tau[:, j]))
        yield Candidate("coulomb_asymmetry", joint, self.on(j, s**2))
        yield Candidate("viscous_asymmetry", joint, self.on(j, dq * s))
        yield Candidate("quadratic_drag", joint, self.on(j, dq * np.abs(dq)))
        yield Candidate("load_dependent_friction", joint, self.on(j, np.abs(self.base[:, j]) * s))
        drives = self.fit.coefficients[j]
        rotor = self.base[:, j] + drives[2] * x.ddq[:, j]
        for motor in (rotor, rotor + drives[0] * s + drives[1] * dq):
            yield Candidate("load_dependent_friction", joint, self.on(j, np.abs(motor) * s))
        yield Candidate("cable_harness", joint, self.on(j, q, one))
        for rest in np.quantile(q, [0.1, 0.3, 0.5, 0.7, 0.9]):
            off = q - rest
            yield Candidate("cable_harness", joint, self.on(j, off, off**3, one, off**2))
        shifted = x.q.copy()
        shifted[:, j] -= EPS
        turned = ((self.torque(self.models, shifted) - self.base) / EPS)[..., None]
        yield Candidate("encoder_offset", joint, turned)
        yield Candidate("encoder_offset", joint, turned * np.eye(len(q))[:, None, None, :])
        fast = np.abs(dq).max()
        for v in fast * np.array([0.08, 0.15, 0.22, 0.3]):
            e = np.exp(-((dq / v) ** 2)) * s
            yield Candidate("stribeck", joint, self.on(j, e, e * dq**2))
        friction = self.fit.coefficients[j, 0] * s + self.fit.coefficients[j, 1] * dq
        for constant in x.t[-1] * np.array([0.15, 0.25, 0.4, 0.5]):
            decay = np.exp(-x.t / constant)
            yield Candidate("friction_drift", joint, self.on(j, decay * friction, decay * x.t * friction))
        for order in range(1, 25):
            wave = np.cos(order * q), np.sin(order * q)
            yield Candidate("torque_ripple", joint, self.on(j, *wave))
            if order < 9:
                yield Candidate("position_dependent_friction", joint, self.on(j, *(w * s for w in wave)))
        for equilibrium in np.quantile(q, np.linspace(0.1, 0.9, 17)):
            for side in (1.0, -1.0):
                part = np.maximum(side * (equilibrium - q), 0.0)
                yield Candidate("parallel_spring", joint, self.on(j, part, (part > 0) * 1.0))
        yield from self.spring_candidates(j, joint)

    def spring_candidates(self, j: int, joint: str) -> Iterator[Candidate]:
        listed = [sp.get("pea", {}).get(joint) for sp in self.setup.springs]
        if not any(listed):
            return
        only = [{"pea": {joint: sp}} if sp else {} for sp in listed]
        tau = np.array([spring_torque(o, self.arm, self.x.q[b])[j] for b, o in enumerate(only)])
        rigid = np.array([sp["stiffness_Nm_per_rad"] if sp else 0.0 for sp in listed])[:, None] * (tau != 0)
        yield Candidate("spring_stiffness", joint, self.on(j, tau))
        yield Candidate("spring_preload", joint, self.on(j, rigid))
        yield Candidate("spring_hysteresis", joint, self.on(j, np.abs(tau) * self.sign[:, j]))

    def body_candidates(self) -> Iterator[Candidate]:
        arm = self.arm
        tool = arm.model.frames[arm.model.getFrameId(arm.tool_link)]
        parent, point = tool.parentJoint, tool.placement.act(arm.tool_point)

        def add(joint: int, mass: float, point: np.ndarray, inertia=None):
            body = pin.Inertia(mass, point, np.zeros((3, 3)) if inertia is None else inertia)
            return lambda m, b: m.appendBodyToJoint(joint, body, pin.SE3.Identity())

        yield Candidate("payload_mass", None, self.edited(add(parent, EPS, point)))
        if self.setup.payload.max() > 0:
            yield Candidate(
                "payload_com",
                None,
                np.concatenate([self.edited(self.moved(parent, point, tool.placement.rotation[:, k])) for k in range(3)], -1),
            )
        none = self.edited(lambda m, b: setattr(m.gravity, "linear", (1 - EPS) * m.gravity.linear))
        yield Candidate("missing_gravity", None, none)
        for j, joint in enumerate(arm.joints):
            unit = np.eye(3)
            shift = [self.edited(add(j + 1, EPS, 0.2 * e)) for e in unit]
            turn = [self.edited(add(j + 1, 0.0, np.zeros(3), EPS * np.outer(e, e))) for e in unit]
            yield Candidate(
                "link_inertial", joint, np.concatenate([self.edited(add(j + 1, EPS, 0 * unit[0])), *shift, *turn], -1)
            )

        def tilt(k: int):
            turn = np.cross(self.setup.gravity, np.eye(3)[k]) * EPS
            return lambda m, b: setattr(m.gravity, "linear", m.gravity.linear + turn)

        yield Candidate("gravity_tilt", None, np.concatenate([self.edited(tilt(k)) for k in (0, 1)], -1))

    def moved(self, parent: int, point: np.ndarray, axis: np.ndarray):
        """Edit that moves the listed payload along an axis: one body more at the new place, one less at the old."""

        def change(m: pin.Model, b: int) -> None:
            mass = float(self.setup.payload[b])
            before = pin.Inertia(mass, point, np.zeros((3, 3)))
            after = pin.Inertia(mass, point + EPS * axis, np.zeros((3, 3)))
            m.inertias[parent] = pin.Inertia.FromDynamicParameters(
                m.inertias[parent].toDynamicParameters() + after.toDynamicParameters() - before.toDynamicParameters()
            )

        return change

    def pair_candidates(self) -> Iterator[Candidate]:
        x, arm = self.x, self.arm
        for a in range(arm.n - 1):
            b, names = a + 1, [arm.joints[a], arm.joints[a + 1]]
            rate = x.dq[:, a] + x.dq[:, b]
            rub = np.tanh(rate / arm.width), rate
            yield Candidate("coupled_friction", names, self.on(a, *rub) + self.on(b, *rub))
            for rho in (way * r for way in (1, -1) for r in (0.4, 0.6, 0.85, 1.1, 1.4)):
                one, qa, qb = np.ones_like(rate), x.q[:, a], x.q[:, b]
                on_a = self.on(a, qa + rho * qb, one, qb)
                on_b = self.on(b, rho * (qa + rho * qb), rho * one, qa + 2 * rho * qb)
                yield Candidate("two_sided_biarticular_spring", names, on_a + on_b)
            for rho in (0.4, 0.6, 0.85, 1.1, 1.3):
                stretch = -x.q[:, a] - rho * x.q[:, b]
                for phi in np.quantile(stretch, [0.15, 0.25, 0.35, 0.45, 0.55]):
                    part = np.maximum(stretch - phi, 0.0)
                    inside = (part > 0) * 1.0
                    on_a = self.on(a, part, inside, -inside * x.q[:, b])
                    on_b = self.on(b, rho * part, rho * inside, part - rho * inside * x.q[:, b])
                    yield Candidate("biarticular_spring", names, on_a + on_b)


def equal_effects(
    jacobian: Jacobian, noise: np.ndarray, effect: Effect, rows_per_sample: float, largest: float = np.inf
) -> dict:
    """The candidates that take up all but 0.1 % of the residual's variance, and those that do so within the noise.

    Candidates are confined to the recordings that have the effect. `rows_per_sample`: how many recorded samples stand
    behind each sample of the Jacobian. "Within the noise": what they leave would raise χ² by less than 9, or by no more
    than 1.5 times what the linearised truth itself leaves, nor by more than the share `largest` of the whole. "Nearest" are
    the best six, equal or not.
    """
    fit, arm = jacobian.fit, jacobian.arm
    mask = effect.mask[: len(fit.residual)]
    basis = [np.linalg.qr(fit.regressor[:, j].reshape(-1, 3))[0] for j in range(fit.residual.shape[1])]
    weight = 1 / noise
    target = fit.residual * weight[:, None]
    total = float(np.sum(target**2)) * rows_per_sample
    best: dict[tuple, float] = {}
    samples = mask[:, None] if fit.inside is None else mask[:, None] * fit.inside
    for c in jacobian.candidates():
        left = remaining(c.columns * samples[:, None, :, None], basis, weight, target) * rows_per_sample
        key = (c.effect, tuple(c.joint) if isinstance(c.joint, list) else c.joint)
        best[key] = min(best.get(key, np.inf), left)

    def named(keys):
        return [
            {"effect": e, "joint": list(j) if isinstance(j, tuple) else j, "chi2_left": round(best[e, j], 3)} for e, j in keys
        ]

    names = tuple(arm.joints[j] for j in effect.joints)
    own = best.get((effect.in_truth, names if len(names) > 1 else (names[0] if names else None)), 0.0)
    order = sorted(best, key=lambda k: best[k])
    return {
        "chi2_of_residual": round(total, 1),
        "equal": named(k for k in order if best[k] < 1e-3 * total),
        "within_noise": named(k for k in order if best[k] < max(9.0, min(1.5 * own, largest * total))),
        "nearest": named(order[:6]),
    }


def remaining(columns: np.ndarray, basis: list[np.ndarray], weight: np.ndarray, target: np.ndarray) -> float:
    """Squared norm of the weighted residual that columns and plain model together cannot express."""
    k = columns.shape[-1]
    touched = [j for j in range(columns.shape[1]) if np.any(columns[:, j])]
    parts = []
    for j in touched:
        c = columns[:, j].reshape(-1, k)
        parts.append(weight[j] * (c - basis[j] @ (basis[j].T @ c)))
    total = float(np.sum(target**2))
    if not parts:
        return total
    a = np.concatenate(parts)
    y = np.concatenate([target[:, j].reshape(-1) for j in touched])
    size = np.linalg.norm(a, axis=0)
    keep = size > 1e-9 * max(size.max(), 1e-30)
    a = a[:, keep] / size[keep]
    theta = np.linalg.lstsq(a, y, rcond=1e-9)[0]
    return total - float(y @ y) + float(np.sum((y - a @ theta) ** 2))
