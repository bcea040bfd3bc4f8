"""The co-design problem: motion, durations and springs of a task together, as an optimal-control problem."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import casadi as ca
import numpy as np
from scipy.interpolate import CubicSpline

from rrr_oc.codesign.task import PHASES, Task
from rrr_oc.effects import Effect
from rrr_oc.effects.elastic.biarticular_spring import (
    HARDWARE_LIMITS,
    BiarticularSpring,
    hardware_exists,
    pick_hardware,
    reduced,
)
from rrr_oc.effects.elastic.parallel_spring import ParallelSpring
from rrr_oc.errors import UserError
from rrr_oc.model.symbolic_model import Model
from rrr_oc.optimal_control.problem import Guess, Phase, PhaseGuess, Problem
from rrr_oc.robot.drives import Actuators
from rrr_oc.schema import check_names

CONFIGURATIONS = {
    "SA": (),
    "PEA": ("parallel_spring",),
    "BPEA": ("biarticular_spring",),
    "PEA+BPEA": ("parallel_spring", "biarticular_spring"),
}
HARDWARE = ("k_b", "q_0", "r_1", "r_2", "r_3")
COSTS = ("load", "motor", "energy")
FLOOR = "height of the tool"
COST_UNITS = {"load": "N²m²s", "motor": "N²m²s", "energy": "J"}


@dataclass(frozen=True, eq=False)
class SpringBounds:
    """One spring that a design may use.

    Attributes:
        effect: The spring.
        lower, upper: Bounds of its parameters, in their order.
        hardware: For a biarticular spring the bounds of k_b, q_0, r_1, r_2, r_3 in SI units; else empty.
        fixed: For a biarticular spring of given hardware its k_b, r_1, r_2, r_3 in SI units; else empty.
        known: Whether it is there in any case, with `lower` = `upper`, and no part of the design: then it may be any effect on
            the links or of the rigid body.
    """

    effect: Effect
    lower: np.ndarray
    upper: np.ndarray
    hardware: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    fixed: Mapping[str, float] = field(default_factory=dict)
    known: bool = False


def spring_bounds(task: Task, configuration: str) -> tuple[SpringBounds, ...]:
    """The springs of a configuration (`CONFIGURATIONS`) with the task's bounds; raises `UserError` for crossed ones."""
    if configuration not in CONFIGURATIONS:
        raise UserError(f"unknown configuration {configuration!r}; there are {', '.join(CONFIGURATIONS)}")
    kinds, known = CONFIGURATIONS[configuration], ("parallel_spring", "biarticular_spring")
    for entry in task.springs:
        if entry.get("effect") not in known:
            raise UserError(f"task {task.name!r}: a spring's effect is {' or '.join(known)}, got {entry.get('effect')!r}")
    springs = tuple(_spring(task, entry) for entry in task.springs if entry.get("effect") in kinds)
    missing = [k for k in kinds if k not in {s.effect.name for s in springs}]
    if missing:
        raise UserError(f"task {task.name!r} offers no {missing[0]}, which configuration {configuration} needs")
    return springs


def drawn_bounds(springs: Sequence[SpringBounds]) -> tuple[np.ndarray, np.ndarray]:
    """Bounds of the numbers that a search draws for springs: k_b, q_0, r_1, r_2, r_3 of a biarticular one whose hardware is free,
    else the effect's own parameters."""
    lower = [[lo for lo, _ in (s.hardware[h] for h in HARDWARE)] if s.hardware else s.lower for s in springs]
    upper = [[hi for _, hi in (s.hardware[h] for h in HARDWARE)] if s.hardware else s.upper for s in springs]
    return np.concatenate([np.zeros(0), *lower]), np.concatenate([np.zeros(0), *upper])


def from_drawn(springs: Sequence[SpringBounds], drawn: np.ndarray) -> np.ndarray:
    """Parameters (p, ...) of a design from such numbers (drawn, ...), one after the other."""
    rows, at = [np.zeros((0, *np.shape(drawn)[1:]))], 0
    for spring in springs:
        size = len(HARDWARE) if spring.hardware else len(spring.lower)
        numbers = np.asarray(drawn[at : at + size], float)
        values = np.array(reduced(*numbers)) if spring.hardware else numbers
        bounds = (b.reshape(-1, *[1] * (values.ndim - 1)) for b in (spring.lower, spring.upper))
        rows.append(np.clip(values, *bounds))
        at += size
    return np.concatenate(rows)


def _spring(task: Task, entry: Mapping) -> SpringBounds:
    where = f"task {task.name!r}: {entry['effect']}"
    needed = "joint" if entry["effect"] == "parallel_spring" else "joints"
    if needed not in entry:
        raise UserError(f"{where} lacks the key {needed!r}")
    if entry["effect"] == "parallel_spring":
        check_names(entry, ("effect", "joint", "active", "stiffness_Nm_per_rad", "equilibrium_deg"), where)
        effect = ParallelSpring((task.robot.index(entry["joint"]),), entry.get("active", "below"))
        stiffness = _bounds(where, entry, "stiffness_Nm_per_rad", 1.0)
        equilibrium = _bounds(where, entry, "equilibrium_deg", np.pi / 180)
        if stiffness[0] < 0:
            raise UserError(f"{where}: stiffness_Nm_per_rad must be 0 or more, got {stiffness[0]:g} … {stiffness[1]:g}")
        return SpringBounds(effect, np.array([stiffness[0], equilibrium[0]]), np.array([stiffness[1], equilibrium[1]]))
    keys = {"k_b": "k_b_Nm_per_rad", "q_0": "q_0_deg", "r_1": "r_1_mm", "r_2": "r_2_mm", "r_3": "r_3_mm"}
    check_names(entry, ("effect", "joints", "winding", *keys.values()), where)
    units = {"k_b": 1.0, "q_0": np.pi / 180, "r_1": 1e-3, "r_2": 1e-3, "r_3": 1e-3}
    bounds = {name: _bounds(where, entry, key, units[name]) for name, key in keys.items()}
    if bounds["k_b"][0] != 0 or not bounds["k_b"][1] > 0:
        raise UserError(f"{where}: k_b_Nm_per_rad must reach from 0 to above 0, got {entry['k_b_Nm_per_rad']}")
    if not bounds["q_0"][0] < 0 < bounds["q_0"][1]:
        raise UserError(f"{where}: q_0_deg must have a negative lower and a positive upper bound, got {entry['q_0_deg']}")
    if min(bounds[r][0] for r in ("r_1", "r_2", "r_3")) <= 0:
        raise UserError(f"{where}: radii must be above 0 mm")
    effect = BiarticularSpring(tuple(task.robot.index(j) for j in entry["joints"]), tuple(entry.get("winding", (1, 1))))
    ratio = bounds["r_1"][1] / bounds["r_2"][0]
    kappa = bounds["k_b"][1] * (bounds["r_2"][1] / bounds["r_1"][0]) ** 2
    wider = 1.05  # the hardware's inequalities bind, not this box around them
    lower = [0.0, bounds["r_3"][0] / bounds["r_2"][1] / wider, bounds["q_0"][0] * ratio * wider]
    upper = [kappa * wider, bounds["r_3"][1] / bounds["r_2"][0] * wider, bounds["q_0"][1] * ratio * wider]
    return SpringBounds(effect, np.array(lower), np.array(upper), bounds)


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
        hardware = [f"{h} {side}" for s in self.springs if s.hardware for h in HARDWARE for side in ("lower", "upper")]
        return ("payload", *widths, *hardware)

    def data(self, width: float | None = None) -> np.ndarray:
        """Values of the problem's data, all smoothing widths [rad] set to `width` if given."""
        widths = self.model.widths if width is None else np.full(self.model.widths.size, width)
        hardware = [s.hardware[h][side] for s in self.springs if s.hardware for h in HARDWARE for side in (0, 1)]
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
                bounds = {h: (d[offset + 2 * i], d[offset + 2 * i + 1]) for i, h in enumerate(HARDWARE)}
                rows.append(hardware_exists(p[at], p[at + 1], p[at + 2], bounds))
                names += HARDWARE_LIMITS
                offset += 2 * len(HARDWARE)
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
            if spring.known:
                continue
            if spring.fixed:
                found |= {**spring.fixed, "q_0": named["phi"] * spring.fixed["r_2"] / spring.fixed["r_1"]}
            elif spring.hardware:
                found |= pick_hardware(named["kappa"], named["rho"], named["phi"], spring.hardware)
            elif isinstance(spring.effect, ParallelSpring):
                number = spring.effect.joints[0] + 1
                found |= {f"k_p{number}": named["stiffness"], f"q_eq{number}": named["equilibrium"]}
        return found

    def with_physics(self, effects: Sequence[tuple[Effect, np.ndarray]]) -> "CoDesign":
        """The same problem on an arm that has further effects of known parameters, which come after the springs'."""
        given = [
            SpringBounds(effect, np.asarray(theta, float), np.asarray(theta, float), known=True) for effect, theta in effects
        ]
        return replace(self, springs=(*self.springs, *given))

    def with_fixed(self, hardware: Mapping[str, float], keep_free: Sequence[str] = ()) -> "CoDesign":
        """The same problem with springs fixed to hardware, except the names in `keep_free`.

        Of a biarticular spring kappa and rho are fixed by k_b and the radii; q_0 free leaves phi free within its bounds.
        """
        springs = []
        for spring in self.springs:
            lower, upper = spring.lower.copy(), spring.upper.copy()
            if spring.known:
                springs.append(spring)
                continue
            if spring.hardware:
                fixed = {h: hardware[h] for h in HARDWARE if h != "q_0"}
                kappa, rho, phi = reduced(fixed["k_b"], hardware.get("q_0", 0.0), fixed["r_1"], fixed["r_2"], fixed["r_3"])
                ratio = fixed["r_1"] / fixed["r_2"]
                free = [b * ratio for b in spring.hardware["q_0"]] if "q_0" in keep_free else [phi, phi]
                bounds = np.array([kappa, rho, free[0]]), np.array([kappa, rho, free[1]])
                springs.append(SpringBounds(spring.effect, *bounds, fixed=fixed))
                continue
            if not isinstance(spring.effect, ParallelSpring):
                springs.append(spring)
                continue
            number = spring.effect.joints[0] + 1
            for i, name in enumerate((f"k_p{number}", f"q_eq{number}")):
                if name not in keep_free:
                    lower[i] = upper[i] = hardware[name]
            springs.append(SpringBounds(spring.effect, lower, upper))
        return CoDesign(self.task, tuple(springs), self.cost, self.actuators, self.at_rest)


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
