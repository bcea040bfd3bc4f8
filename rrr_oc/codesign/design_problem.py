"""The co-design problem: motion, durations and springs of a task together, as an optimal-control problem."""

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import casadi as ca
import numpy as np
from scipy.interpolate import CubicSpline

from rrr_oc.codesign.task import PHASES, Task
from rrr_oc.effects import Effect, design_forms
from rrr_oc.effects.design_form import DesignForm
from rrr_oc.errors import UserError
from rrr_oc.model.symbolic_model import Model
from rrr_oc.optimal_control.problem import Guess, Phase, PhaseGuess, Problem
from rrr_oc.robot.drives import Actuators
from rrr_oc.schema import check_names


def configurations() -> dict[str, tuple[str, ...]]:
    """Names of the effects that each configuration has: "SA" none, then every combination of those that have a design form."""
    kinds = {label: kind.name for label, kind in design_forms().items()}
    some = [labels for count in range(1, len(kinds) + 1) for labels in itertools.combinations(kinds, count)]
    return {"SA": ()} | {"+".join(labels): tuple(kinds[label] for label in labels) for labels in some}


CONFIGURATIONS = configurations()  # of the springs that are known as this module is imported
COSTS = ("load", "motor", "energy")
FLOOR = "height of the tool"
COST_UNITS = {"load": "N²m²s", "motor": "N²m²s", "energy": "J"}


@dataclass(frozen=True, eq=False)
class SpringBounds:
    """One spring that a design may use.

    Attributes:
        effect: The spring.
        lower, upper: Bounds of its parameters, in their order.
        hardware: Of a spring whose parameters are functions of its hardware (`DesignForm.derived`), the bounds of that by symbol
            in SI units; else empty.
        fixed: Of such a spring of given hardware, the hardware in SI units; else empty.
        known: Whether it is there in any case, with `lower` = `upper`, and no part of the design: then it may be any effect on
            the links or of the rigid body.
    """

    effect: Effect
    lower: np.ndarray
    upper: np.ndarray
    hardware: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    fixed: Mapping[str, float] = field(default_factory=dict)
    known: bool = False

    @property
    def form(self) -> DesignForm:
        """The spring's form in a co-design; raises `UserError` where it has none."""
        if self.effect.design is None:
            raise UserError(f"{self.effect.name} has no form in a co-design")
        return self.effect.design


def spring_bounds(task: Task, configuration: str) -> tuple[SpringBounds, ...]:
    """The springs of a configuration (`configurations`) with the task's bounds; raises `UserError` for crossed ones."""
    every, known = configurations(), [kind.name for kind in design_forms().values()]
    if configuration not in every:
        raise UserError(f"unknown configuration {configuration!r}; there are {', '.join(every)}")
    kinds = every[configuration]
    for entry in task.springs:
        if entry.get("effect") not in known:
            raise UserError(f"task {task.name!r}: a spring's effect is {' or '.join(known)}, got {entry.get('effect')!r}")
    springs = tuple(_spring(task, entry) for entry in task.springs if entry.get("effect") in kinds)
    missing = [k for k in kinds if k not in {s.effect.name for s in springs}]
    if missing:
        raise UserError(f"task {task.name!r} offers no {missing[0]}, which configuration {configuration} needs")
    return springs


def drawn_bounds(springs: Sequence[SpringBounds]) -> tuple[np.ndarray, np.ndarray]:
    """Bounds of the numbers that a search draws for springs: the hardware where parameters are functions of it and it is free, else
    the effect's own parameters."""
    lower = [[lo for lo, _ in s.hardware.values()] if s.hardware else s.lower for s in springs]
    upper = [[hi for _, hi in s.hardware.values()] if s.hardware else s.upper for s in springs]
    return np.concatenate([np.zeros(0), *lower]), np.concatenate([np.zeros(0), *upper])


def from_drawn(springs: Sequence[SpringBounds], drawn: np.ndarray) -> np.ndarray:
    """Parameters (p, ...) of a design from such numbers (drawn, ...), one after the other."""
    rows, at = [np.zeros((0, *np.shape(drawn)[1:]))], 0
    for spring in springs:
        size = len(spring.hardware) or len(spring.lower)
        numbers = np.asarray(drawn[at : at + size], float)
        values = spring.form.parameters(numbers) if spring.hardware else numbers
        bounds = (b.reshape(-1, *[1] * (values.ndim - 1)) for b in (spring.lower, spring.upper))
        rows.append(np.clip(values, *bounds))
        at += size
    return np.concatenate(rows)


def _spring(task: Task, entry: Mapping) -> SpringBounds:
    where = f"task {task.name!r}: {entry['effect']}"
    kind = next(kind for kind in design_forms().values() if kind.name == entry["effect"])
    form, place = kind.design, "joints" if kind.placement == "pair" else "joint"
    assert form is not None
    check_names(entry, ("effect", place, *form.options, *(q.key for q in form.quantities)), where)
    if place not in entry:
        raise UserError(f"{where} lacks the key {place!r}")
    names = entry[place] if place == "joints" else [entry[place]]
    options = {key: tuple(v) if isinstance(v := entry[key], list) else v for key in form.options if key in entry}
    effect = kind(tuple(task.robot.index(joint) for joint in names), **options)
    bounds = {q.symbol: _bounds(where, entry, q.key, q.unit) for q in form.quantities}
    if (wrong := form.wrong(bounds)) is not None:
        raise UserError(f"{where}: {wrong}")
    return SpringBounds(effect, *form.box(bounds), bounds if form.derived else {})


def _bounds(where: str, entry: Mapping, key: str, unit: float) -> tuple[float, float]:
    try:
        low, high = (float(v) for v in entry[key])
    except (KeyError, TypeError, ValueError):
        raise UserError(f"{where}: {key} must be two numbers [lower, upper], got {entry.get(key)!r}") from None
    if not low <= high:
        raise UserError(f"{where}: bounds of {key} are crossed: {low:g} … {high:g}; the lower must not be above the upper")
    return low * unit, high * unit


@dataclass(frozen=True, eq=False)
class CoDesign:
    """A task, the springs that may help, and the cost: what becomes an optimal-control problem.

    Attributes:
        task: The task.
        springs: With their bounds; `with_fixed` narrows them. Those that are known stand last; `with_physics` adds them.
        cost: "load" = load torque² (Eq. 13) over the moving joints, "motor" = motor torque² (Eq. 7), "energy" = Eq. 11.
        actuators: Of the moving joints; needed for "motor" and "energy".
        at_rest: Whether the arm is at rest at both ends of each phase.
    """

    task: Task
    springs: tuple[SpringBounds, ...]
    cost: str = "load"
    actuators: Actuators | None = None
    at_rest: bool = True

    def __post_init__(self) -> None:
        if self.cost not in COSTS:
            raise UserError(f"unknown cost {self.cost!r}; there are {', '.join(COSTS)}")
        if self.cost != "load" and self.actuators is None:
            raise UserError(f"cost {self.cost!r} needs the actuators of {', '.join(self.task.joints)}")
        if self.cost == "energy" and self.actuators is not None:
            self.actuators.check_resistance()

    @cached_property
    def model(self) -> Model:
        """The whole arm with the springs."""
        return self.task.model([s.effect for s in self.springs])

    @property
    def data_names(self) -> tuple[str, ...]:
        """Names of the problem's data: payload, smoothing widths, hardware bounds."""
        widths = [f"width of {self.model.label(e)}" for e in self.model.effects if e.width is not None]
        hardware = [f"{h} {side}" for s in self.springs for h in s.hardware for side in ("lower", "upper")]
        return ("payload", *widths, *hardware)

    def data(self, width: float | None = None) -> np.ndarray:
        """Values of the problem's data, all smoothing widths [rad] set to `width` if given."""
        widths = self.model.widths if width is None else np.full(self.model.widths.size, width)
        hardware = [bound for s in self.springs for bounds in s.hardware.values() for bound in bounds]
        return np.r_[self.task.payload, widths, hardware]

    @cached_property
    def problem(self) -> Problem:
        """The optimal-control problem: states q, dq of the moving joints, controls their accelerations."""
        lower = np.concatenate([np.zeros(0), *[s.lower for s in self.springs]])
        upper = np.concatenate([np.zeros(0), *[s.upper for s in self.springs]])
        names = tuple(
            f"{'known ' if s.known else ''}{self.model.label(s.effect)}.{p.name}"
            for s in self.springs
            for p in s.effect.parameters
        )
        design, designs = self._design()
        holding = self._holding_cost()
        return Problem(
            phases=tuple(self._phase(i) for i in range(len(PHASES))),
            parameters=names,
            p_lower=lower,
            p_upper=upper,
            p_scale=np.maximum(np.maximum(np.abs(lower), np.abs(upper)), 1e-3),
            data=self.data(),
            design=design,
            designs=designs,
            cost_scale=holding,
        )

    def _phase(self, index: int) -> Phase:
        task, m = self.task, len(self.task.moving)
        start, end = task.ends(index)
        rest = np.zeros(m) if self.at_rest else np.full(m, np.nan)
        speed = np.where(np.isfinite(task.speed), task.speed, np.pi)
        peak = np.where(np.isfinite(task.acceleration), task.acceleration, 2 * speed)
        limited, floor = np.flatnonzero(np.isfinite(task.torque)), int(np.isfinite(task.floor))
        return Phase(
            name=PHASES[index],
            rates=self._rates(index, limited),
            states=tuple(f"{kind} of {j}" for kind in ("angle", "speed") for j in task.joints),
            controls=tuple(f"acceleration of {j}" for j in task.joints),
            x_lower=np.r_[task.lower, -task.speed],
            x_upper=np.r_[task.upper, task.speed],
            u_lower=-task.acceleration,
            u_upper=task.acceleration,
            start=np.r_[start, rest],
            end=np.r_[end, rest],
            duration=task.duration,
            x_scale=np.r_[np.ones(m), np.ones(m)],
            u_scale=peak,
            paths=(*[torque_path(task.joints[i]) for i in limited], *([FLOOR] if floor else [])),
            path_lower=np.r_[-np.ones(limited.size), np.full(floor, task.floor)],
            path_upper=np.r_[np.ones(limited.size), np.full(floor, np.inf)],
        )

    def _rates(self, index: int, limited: np.ndarray) -> ca.Function:
        task, m, n_data = self.task, len(self.task.moving), len(self.data_names)
        x, u, p, d = (
            ca.SX.sym("x", 2 * m),
            ca.SX.sym("u", m),
            ca.SX.sym("p", len(self.model.parameters)),
            ca.SX.sym("d", n_data),
        )
        payload = d[0] if index == 0 else 0.0
        tau = self._load_torque(x[:m], x[m:], u, payload, p, d[1 : 1 + self.model.widths.size])[0]
        path = ca.vertcat(*[tau[int(i)] / task.torque[i] for i in limited])
        if np.isfinite(task.floor):
            path = ca.vertcat(path, self.model.tool_height(self._all_joints(x[:m])))
        return ca.Function("rates", [x, u, p, d], [ca.vertcat(x[m:], u), self._cost_rate(x[m:], u, tau), path])

    def _load_torque(self, q, dq, ddq, payload, theta, widths) -> tuple[ca.SX, ca.SX]:
        full = [self._all_joints(values) for values in (q, dq, ddq)]
        tau, spring = self.model.inverse(*full, payload, theta, widths)
        moving = list(self.task.moving)
        return tau[moving], spring[moving]

    def _all_joints(self, moving: ca.SX) -> ca.SX:
        full = ca.SX.zeros(self.task.robot.n)
        for row, joint in enumerate(self.task.moving):
            full[joint] = moving[row]
        return full

    def _cost_rate(self, dq, ddq, tau) -> ca.SX:
        if self.cost == "load" or self.actuators is None:
            return ca.sumsqr(tau)
        if self.cost == "motor":
            return ca.sumsqr(self.actuators.motor_torque(dq, ddq, tau))
        return ca.sum1(self.actuators.power(dq, ddq, tau))

    def _design(self) -> tuple[ca.Function | None, tuple[str, ...]]:
        p, d = ca.SX.sym("p", len(self.model.parameters)), ca.SX.sym("d", len(self.data_names))
        rows, names, at, offset = [], [], 0, 1 + self.model.widths.size
        for spring in self.springs:
            size = len(spring.effect.parameters)
            if spring.hardware:
                bounds = {h: (d[offset + 2 * i], d[offset + 2 * i + 1]) for i, h in enumerate(spring.hardware)}
                rows.append(spring.form.exists([p[at + i] for i in range(size)], bounds))
                names += spring.form.limits
                offset += 2 * len(spring.hardware)
            at += size
        return (ca.Function("design", [p, d], [ca.vertcat(*rows)]), tuple(names)) if rows else (None, ())

    def _holding_cost(self) -> float:
        """Cost of holding the loaded arm still at both ends for two seconds without springs: a magnitude for scaling."""
        zero = np.zeros(self.task.robot.n)
        bare = self.task.model()
        total = 0.0
        for end in (self.task.start, self.task.release):
            tau = np.array(bare.inverse(self.task.full(end), zero, zero, self.task.payload, [], [])[0]).ravel()
            total += 2.0 * float((tau[list(self.task.moving)] ** 2).sum())
        return max(total / 10, 1e-3)

    @cached_property
    def torques(self) -> ca.Function:
        """(q, dq, ddq, payload, theta, widths) of the moving joints -> (load torque, spring torque), (m,) each [Nm]."""
        m = len(self.task.moving)
        inputs = [ca.SX.sym(n, m) for n in ("q", "dq", "ddq")]
        inputs += [
            ca.SX.sym("payload"),
            ca.SX.sym("theta", len(self.model.parameters)),
            ca.SX.sym("widths", self.model.widths.size),
        ]
        return ca.Function("torques", inputs, list(self._load_torque(*inputs)))

    def hardware(self, parameters: np.ndarray) -> dict[str, float]:
        """The springs of a solution as a designer names them: k_p2, q_eq2, …, k_b, q_0, r_1, r_2, r_3, in SI and radians."""
        found, numbers = {}, iter(np.asarray(parameters, float).tolist())
        for spring in self.springs:
            named = {p.name: next(numbers) for p in spring.effect.parameters}
            if not spring.known:
                found |= spring.form.named(spring.effect.joints, named, spring.hardware, spring.fixed)
        return found

    def with_physics(self, effects: Sequence[tuple[Effect, np.ndarray]]) -> "CoDesign":
        """The same problem on an arm that has further effects of known parameters, which come after the springs'."""
        given = [
            SpringBounds(effect, np.asarray(theta, float), np.asarray(theta, float), known=True) for effect, theta in effects
        ]
        return replace(self, springs=(*self.springs, *given))

    def with_fixed(self, hardware: Mapping[str, float], keep_free: Sequence[str] = ()) -> "CoDesign":
        """The same problem with springs fixed to hardware, except the names in `keep_free`."""
        springs = tuple(_held(spring, hardware, keep_free) for spring in self.springs)
        return replace(self, springs=springs)


def _held(spring: SpringBounds, hardware: Mapping[str, float], keep_free: Sequence[str]) -> SpringBounds:
    """The spring fixed to hardware, except the names in `keep_free`."""
    if spring.known or spring.fixed:
        return spring
    box = spring.lower, spring.upper
    lower, upper, fixed = spring.form.held(spring.effect.joints, box, spring.hardware, hardware, keep_free)
    return SpringBounds(spring.effect, lower, upper, fixed=fixed)


def torque_path(joint: str) -> str:
    """Name of the path that a joint's torque limit bounds."""
    return f"load torque of {joint}"


def motion_guess(
    design: CoDesign, parameters: np.ndarray, durations: Sequence[float] | np.ndarray, via: np.ndarray | None = None
) -> Guess:
    """A rest-to-rest motion through points, minimum-jerk in time along a cubic spline.

    Args:
        design: The problem.
        parameters: Its parameters (np,).
        durations: Of the phases [s].
        via: Points passed at equal fractions of the way [rad], (phases, m, K); default none.
    """
    return Guess(
        tuple(
            _phase_guess(design.task, i, T, np.empty((len(design.task.moving), 0)) if via is None else via[i])
            for i, T in enumerate(durations)
        ),
        np.asarray(parameters, float),
    )


def _phase_guess(task: Task, index: int, T: float, via: np.ndarray) -> PhaseGuess:
    start, end = task.ends(index)
    points = np.column_stack([start, via, end])
    along = np.linspace(0, 1, points.shape[1])
    path: Callable = CubicSpline(along, points, axis=1) if points.shape[1] > 2 else _line(points)

    def states(s: np.ndarray) -> np.ndarray:
        sigma, rate = s**3 * (10 - 15 * s + 6 * s**2), 30 * s**2 * (1 - s) ** 2 / T
        q = np.clip(path(sigma), task.lower[:, None], task.upper[:, None])
        return np.vstack([q, np.clip(path(sigma, 1) * rate, -task.speed[:, None], task.speed[:, None])])

    def controls(s: np.ndarray) -> np.ndarray:
        sigma, rate = s**3 * (10 - 15 * s + 6 * s**2), 30 * s**2 * (1 - s) ** 2 / T
        curve = 60 * s * (1 - s) * (1 - 2 * s) / T**2
        limit = task.acceleration[:, None]
        return np.clip(path(sigma, 2) * rate**2 + path(sigma, 1) * curve, -limit, limit)

    return PhaseGuess(T, states, controls)


def _line(points: np.ndarray) -> Callable:
    slope = (points[:, 1] - points[:, 0])[:, None]
    return lambda s, order=0: (points[:, :1] + slope * s, slope + 0 * s, 0 * slope * s)[order]
