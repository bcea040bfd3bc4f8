"""The co-design problem: motion, durations and springs of a task together, as an optimal-control problem."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple, get_args

import casadi as ca
import numpy as np
from scipy.interpolate import CubicSpline

from rrr_oc.codesign.clearance import Clearance
from rrr_oc.codesign.parts.constraints import Limited, limited
from rrr_oc.codesign.series_elastic import POINTS, SeriesElastic
from rrr_oc.codesign.springs import SpringBounds, acting, each
from rrr_oc.codesign.task import PHASES, Task
from rrr_oc.effects import Clutched, Effect
from rrr_oc.effects.base import Signals
from rrr_oc.errors import UserError, meant
from rrr_oc.model.parameters import offsets
from rrr_oc.model.symbolic_model import Model
from rrr_oc.optimal_control.problem import Boundary, Bounded, Cycle, Guess, Link, Phase, PhaseGuess, Problem, Side
from rrr_oc.robot.drives import Actuators
from rrr_oc.robot.goals import Goal

# [W/rad] width over which drawn power gives way to returned power, by the springs' width; doubled, solves are easier and further off
POWER_WIDTH = 10.0
NARROW = 1e-3  # [rad] springs' width where none is given, by which that of power follows
# Factor on the tolerance by which limits of torque, of springs and of distances, and of accelerations whose jerk is limited, are exceeded
# between the nodes: 0.1 % or 1 mm instead of 10⁻⁵. They fall slowly with the mesh; a tenth of it takes three times as many intervals
EASING = 100.0


class CostKind(NamedTuple):
    """What is minimised: in words, its name in tables and figures, and its unit."""

    words: str
    name: str
    unit: str


COSTS = {
    "load": CostKind("load torque²", "E1", "N²m²s"),
    "motor": CostKind("motor torque²", "motor torque²", "N²m²s"),
    "energy": CostKind("electrical energy", "energy", "J"),
}


@dataclass(frozen=True, eq=False)
class Scenario:
    """One case of what is not known while the motion is planned.

    Attributes:
        payload: Factor on the payload [1].
        theta: Values of parameters of known effects, by their index among the problem's parameters.
        inertial: Inertial parameters of the links (10, n); None for those of the task's robot.
        says: What the case is, in words.
    """

    payload: float = 1.0
    theta: tuple[tuple[int, float], ...] = ()
    inertial: np.ndarray | None = None
    says: str = ""

    def task(self, task: Task) -> Task:
        """A task in this case."""
        robot = task.robot if self.inertial is None else replace(task.robot, inertial=self.inertial)
        return replace(task, payload=task.payload * self.payload, robot=robot)


@dataclass(frozen=True, eq=False)
class CoDesign:
    """A task, the springs that may help, and the cost.

    Attributes:
        task: The task.
        springs: With their bounds, which `with_fixed` narrows. Known effects, added by `with_physics`, come last.
        cost: "load" = load torque² (Eq. 13) over the moving joints, "motor" = motor torque² (Eq. 7), "energy" = Eq. 11,
            in which the power that flows back counts as far as the actuators keep it.
        actuators: Of the moving joints; needed for "motor" and "energy".
        scenarios: Cases in which springs and motion must do; limits of torque hold in each.
        over: What the cost is of several cases: that of the worst, or their mean.
    """

    task: Task
    springs: tuple[SpringBounds, ...]
    cost: str = "load"
    actuators: Actuators | None = None
    scenarios: tuple[Scenario, ...] = (Scenario(),)
    over: str = "worst"

    def __post_init__(self) -> None:
        if self.cost not in COSTS:
            raise UserError(f"unknown cost {self.cost!r}; there are {', '.join(COSTS)}{meant(self.cost, COSTS)}")
        if self.cost != "load" and self.actuators is None:
            raise UserError(f"cost {self.cost!r} needs the actuators of {', '.join(self.task.joints)}")
        if self.cost == "energy" and self.actuators is not None:
            self.actuators.check_resistance()
        clutched = [s.effect.name for s in self.springs if isinstance(s.effect, Clutched)]
        if clutched and not self.task.at_rest:
            raise UserError(f"{clutched[0]} needs an arm that is at rest between the phases, where its clutch opens and closes")
        self._check_series()

    def _check_series(self) -> None:
        if not self.series.rows:
            return
        name = next(s.effect.name for s in self.springs if s.effect.moves_link)
        if self.cost == "load":
            raise UserError(f"{name} changes what the motors do, not the load torque; the costs motor and energy show it")
        if len(self.scenarios) > 1:
            raise UserError(
                f"{name} makes the motion depend on what is carried; one scenario is allowed, got {len(self.scenarios)}"
            )
        if not self.task.at_rest:
            raise UserError(f"{name} needs an arm that is at rest between the phases, while the load of its springs changes")

    @property
    def costs(self) -> int:
        """Number of costs of which the greatest counts."""
        return 1 if self.over == "mean" else len(self.scenarios)

    @cached_property
    def series(self) -> SeriesElastic:
        """The joints with springs between drive and link; those of known effects are not among them."""
        firsts = zip(self.springs, offsets(self.model.effects)[:-1], strict=True)
        own = [(s.effect.joints[0], first) for s, first in firsts if s.effect.moves_link and not s.known]
        found = [(self.task.moving.index(joint), first) for joint, first in own]
        rows, compliances = zip(*sorted(found), strict=True) if found else ((), ())
        return SeriesElastic(len(self.task.moving), rows, compliances)

    @cached_property
    def model(self) -> Model:
        """The whole arm with the springs."""
        return self.task.model([s.effect for s in self.springs])

    @property
    def known_parameters(self) -> np.ndarray:
        """Parameters of the known effects of the arm, (known,)."""
        return np.concatenate([np.zeros(0), *(spring.lower for spring in self.springs if spring.known)])

    def engaged(self, phase: int, parameters):
        """The parameters (np,), numbers or casadi's, as they act in a phase: springs that a clutch has let go have no amplitude."""
        pairs = ((s.effect, p) for s in self.springs for p in s.effect.parameters)
        return parameters * np.array([p.name not in e.amplitudes or phase in acting(e) for e, p in pairs], float)

    @property
    def data_names(self) -> tuple[str, ...]:
        """Names of the problem's data: payload, smoothing widths of the springs and of power, hardware bounds."""
        widths = [f"width of {self.model.label(e)}" for e in self.model.effects if e.width is not None]
        power = ["width of power"] if self.cost == "energy" else []
        bounded = [(s, q) for s in self.springs if s.hardware for q in s.form.quantities]
        hardware = [f"{s.form.name(q, s.effect.joints)} {side}" for s, q in bounded for side in ("lower", "upper")]
        return ("payload", *widths, *power, *hardware)

    def data(self, width: float | None = None) -> np.ndarray:
        """Values of the problem's data, all smoothing widths [rad] set to `width` if given, that of power [W] in proportion."""
        widths = self.model.widths if width is None else np.full(self.model.widths.size, width)
        power = [POWER_WIDTH * (NARROW if width is None else width)] if self.cost == "energy" else []
        hardware = [bound for s in self.springs for bounds in s.hardware.values() for bound in bounds]
        return np.r_[self.task.payload, widths, power, hardware]

    def widths(self, data):
        """Smoothing widths of the springs among the problem's data, numbers or casadi's."""
        return data[1 : 1 + self.model.widths.size]

    def power_width(self, data):
        """Smoothing width of power [W] among the problem's data; 0 where the cost is not the energy."""
        return data[1 + self.model.widths.size] if self.cost == "energy" else 0.0

    @cached_property
    def problem(self) -> Problem:
        """The optimal-control problem: states q, dq of the moving joints, controls their accelerations; with springs between drives
        and links as `SeriesElastic` says. Where the jerk has a limit, the acceleration is a state and the jerk the control.

        Phase i starts at the task's end i; where the arm moves there, its speed is that at the end of the other phase, and where its
        posture is free, so are its angles. Springs
        between drives and links hold the arm still at both ends, with the payload of the phase.
        """
        lower = np.concatenate([np.zeros(0), *[s.lower for s in self.springs]])
        upper = np.concatenate([np.zeros(0), *[s.upper for s in self.springs]])
        labels = [(f"{'known ' if s.known else ''}{self.model.label(s.effect)}", s.effect.parameters) for s in self.springs]
        design, designs = self._design()
        return Problem(
            phases=tuple(self._phase(i) for i in range(len(PHASES))),
            parameters=tuple(f"{label}.{p.name}" for label, parameters in labels for p in parameters),
            p_lower=lower,
            p_upper=upper,
            p_scale=np.maximum(np.maximum(np.abs(lower), np.abs(upper)), 1e-3),
            data=self.data(),
            design=design,
            designs=designs,
            cost_scale=self._holding_cost(),
            groups=(0,) * self.costs,
            links=self._links(),
            cycles=() if self.task.cycle is None else (Cycle(tuple(range(len(PHASES))), self.task.cycle),),
        )

    def _links(self) -> tuple[Link, ...]:
        """What the phases have in common where the arm moves on, and where its posture is free: speeds and angles at the task's ends."""
        m, made = len(self.task.moving), []
        for i, (speed, goal) in enumerate(zip(self.task.speeds, self.task.goals, strict=True)):
            moving = (*range(m, 2 * m), *self._jerk_states)
            states = tuple(range(m)) * (goal is not None) + moving * (speed == "moving")
            made += [Link(1 - i, i, states)] * bool(states)
        return tuple(made)

    def _phase(self, index: int) -> Phase:
        task, m, series = self.task, len(self.task.moving), self.series
        own, torque = list(series.rows), np.sqrt(10 * self._holding_cost() / (4 * m))
        e, ends = len(own), zip(task.ends(index), task.speeds[:: 1 if index == 0 else -1], strict=True)
        goals = self.task.goals[:: 1 if index == 0 else -1]
        start, end = (
            np.r_[
                angles if goal is None else np.full(m, np.nan),
                np.full(m, 0.0 if speed == "rest" else np.nan),
                [np.nan] * e,
                np.zeros(e),
                np.full(len(task.jerky), 0.0 if speed == "rest" else np.nan),
            ]
            for (angles, speed), goal in zip(ends, goals, strict=True)
        )
        speed = np.where(np.isfinite(task.speed), task.speed, np.pi)
        of_links, free = task.speed.copy(), np.full(e, np.inf)
        of_links[own] = np.inf  # where a spring stands between drive and link, the drive's speed is limited
        limited, kept = self._torque_rows, self._kept
        bounded, parts = len(limited) * len(self.scenarios), [part.what for part in self.limited_parts]
        jerky, moved = task.jerky, [f"{'the drive of ' * (i in own)}{j}" for i, j in enumerate(task.joints)]
        most = np.where(np.isfinite(task.acceleration), task.acceleration, 2 * speed)
        springs = [f"torque of the spring in series with {task.joints[row]}" for row in own]
        return Phase(
            name=PHASES[index],
            rates=self._rates(index),
            x=Bounded(
                (
                    *(f"{kind} of {j}" for kind in ("angle", "speed") for j in task.joints),
                    *springs,
                    *(f"speed of the drive of {task.joints[row]}" for row in own),
                    *(f"acceleration of {moved[row]}" for row in jerky),
                ),
                np.r_[task.lower, -of_links, -free, -task.speed[own], -task.acceleration[jerky]],
                np.r_[task.upper, of_links, free, task.speed[own], task.acceleration[jerky]],
                np.r_[np.ones(2 * m), np.full(e, torque), np.ones(e), most[jerky]],
                np.repeat([1.0, EASING], [2 * m + 2 * e, len(jerky)]),
            ),
            u=Bounded(
                tuple(f"{'jerk' if i in jerky else 'acceleration'} of {of}" for i, of in enumerate(moved)),
                -self._control_limit,
                self._control_limit,
                np.where(np.isfinite(self._control_limit), self._control_limit, most),
            ),
            start=start,
            end=end,
            duration=task.duration,
            path=Bounded(
                (*[torque_path(task.joints[i]) for i in limited] * len(self.scenarios), *(one.name for one in kept), *parts),
                np.r_[-np.ones(bounded), [one.least for one in kept], np.full(len(parts), -np.inf)],
                np.r_[np.ones(bounded), np.full(len(kept), np.inf), np.ones(len(parts))],
                np.ones(bounded + len(kept) + len(parts)),
                EASING,
            ),
            costs=tuple(range(self.costs)),
            boundaries=self._boundaries(index, torque, tuple(springs)),
        )

    def _boundaries(self, index: int, unit: float, springs: tuple[str, ...]) -> tuple[Boundary, ...]:
        """At both ends of a phase the springs in series hold the arm, over a unit of torque; the tool is where the task wants it, a
        condition of the first phase alone, as the other begins and ends in the same postures. And the points that a phase passes."""
        sides = get_args(Side)
        held = [Boundary(side, self._held_by_springs(index, unit), springs) for side in sides if springs]
        ends = [(side, goal) for side, goal in zip(sides, self.task.goals, strict=True) if goal is not None and index == 0]
        passed = [(via.share, via.goal or via.angles) for via in self.task.via if via.phase == index]
        return (*held, *(self._placed(*one) for one in (*ends, *passed)))

    def _placed(self, at: Side | float, where: Goal | np.ndarray) -> Boundary:
        """The tool is at a place, or the moving joints are at angles (m,)."""
        x, p, d = (ca.SX.sym(name, size) for name, size in self._sizes.items() if name != "u")
        angles = x[: len(self.task.moving)]
        if isinstance(where, np.ndarray):
            there, names = angles - ca.DM(where), tuple(f"angle of {joint}" for joint in self.task.joints)
        else:
            there = where.equalities(self.model.body, self.task.tool, self._all_joints(angles, self.task.locked))
            names = tuple(f"place of the tool, direction {k + 1}" for k in range(there.numel()))
        return Boundary(at, ca.Function("place", [x, p, d], [there]), names)

    def _held_by_springs(self, index: int, unit: float) -> ca.Function:
        """(x, p, d) -> torque of the springs in series less what holds the arm still, over a unit (e,)."""
        m, rows = len(self.task.moving), list(self.series.rows)
        x, p, d = (ca.SX.sym(name, size) for name, size in self._sizes.items() if name != "u")
        still, payload = ca.SX.zeros(m), d[0] if index == 0 else 0.0
        held = self._load_torque(x[:m], still, still, payload, self.engaged(index, p), self.widths(d))[0][rows]
        return ca.Function("boundary", [x, p, d], [(self.series.torques(x) - held) / unit])

    @property
    def _sizes(self) -> dict[str, int]:
        """Numbers of states, controls, parameters and data."""
        m = len(self.task.moving)
        states = 2 * m + 2 * len(self.series.rows) + len(self.task.jerky)
        return {"x": states, "u": m, "p": len(self.model.parameters), "d": len(self.data_names)}

    @property
    def _torque_rows(self) -> list[int]:
        """Rows of the moving joints with limits of torque."""
        return np.flatnonzero(np.isfinite(self.task.torque)).tolist()

    @property
    def _kept(self) -> list[Clearance]:
        """The distances that the arm keeps, of symbols."""
        return self.task.kept(ca.SX.sym("q", self.task.robot.n))

    @property
    def _jerk_states(self) -> tuple[int, ...]:
        """States that are accelerations of the drives of joints with a limit of jerk; the last ones."""
        first = 2 * len(self.task.moving) + 2 * len(self.series.rows)
        return tuple(range(first, first + len(self.task.jerky)))

    @property
    def _control_limit(self) -> np.ndarray:
        """Limit of each control: of an acceleration, or of a jerk (m,)."""
        return np.where(np.isfinite(self.task.jerk), self.task.jerk, self.task.acceleration)

    def acceleration(self, row: int) -> tuple[bool, int]:
        """Whether the acceleration of a moving joint's drive is a state, and its index among these or the controls."""
        jerky = self.task.jerky
        return (True, self._jerk_states[jerky.index(row)]) if row in jerky else (False, row)

    def accelerations(self, x: Any, u: Any) -> Any:
        """Accelerations of the drives (m, ...) [rad/s²] among states and controls; of a guess, an optimum, or casadi's."""
        if not self.task.jerky:
            return u
        ddq = ca.SX(u) if isinstance(u, ca.SX) else np.array(u)
        ddq[self.task.jerky] = x[list(self._jerk_states)]
        return ddq

    @property
    def orders(self) -> tuple[np.ndarray, np.ndarray]:
        """How often each state and each control is derived by time: it grows by that power where a motion is run through faster."""
        m, e, jerky = len(self.task.moving), len(self.series.rows), np.isfinite(self.task.jerk)
        return np.repeat([0, 1, 0, 1, 2], [m, m, e, e, jerky.sum()]), 2 + jerky

    @property
    def limited_parts(self) -> list[Limited]:
        """What the task limits of its springs as parts, of symbols."""
        return self.limited_at(ca.SX.sym("q", len(self.task.moving)), ca.SX.sym("p", len(self.model.parameters)))

    def limited_at(self, q, p) -> list[Limited]:
        """The same at angles of the moving joints (m,) and parameters (np,), numbers or casadi's."""
        signals, limits = Signals(self._all_joints(q, self.task.locked)), self.task.spring_limits
        of_each = (limited(s, self.model.label(s.effect), limits, signals, theta) for s, theta in each(self.springs, p))
        return [one for some in of_each for one in some]

    def _rates(self, index: int) -> ca.Function:
        task, m, series = self.task, len(self.task.moving), self.series
        x, u, p, d = (ca.SX.sym(name, size) for name, size in self._sizes.items())
        q, dq, widths, torques, own = x[:m], x[m : 2 * m], self.widths(d), [], list(series.rows)
        ddq = driven = self.accelerations(x, u)
        for scenario in self.scenarios:
            theta, payload = ca.SX(self.engaged(index, p)), d[0] * scenario.payload if index == 0 else 0.0
            for at, value in scenario.theta:
                theta[at] = value

            there = self if scenario.inertial is None else replace(self, task=scenario.task(self.task))

            def load(ddq: ca.SX, payload=payload, theta=theta, there=there) -> ca.SX:
                return there._load_torque(q, dq, ddq, payload, theta, widths)[0]

            ddq = series.accelerations(load, x, driven)
            tau = load(ddq)
            tau[own] = series.torques(x)
            torques.append(tau)
        speeds, accelerations = ca.SX(dq), driven
        speeds[own] = series.speeds(x)
        costs = ca.vertcat(*[self.cost_rate(speeds, accelerations, tau, self.power_width(d)) for tau in torques])
        if self.over == "mean":
            costs = ca.sum1(costs) / len(self.scenarios)
        path = ca.vertcat(*[tau[i] / task.torque[i] for tau in torques for i in self._torque_rows])
        path = ca.vertcat(path, *[one.value for one in task.kept(self._all_joints(q, task.locked))])
        path = ca.vertcat(path, *[part.over for part in self.limited_at(q, ca.SX(self.engaged(index, p)))])
        return ca.Function(
            "rates", [x, u, p, d], [ca.vertcat(dq, ddq, series.rates(x, driven, p), *[u[j] for j in task.jerky]), costs, path]
        )

    def _load_torque(self, q, dq, ddq, payload, theta, widths) -> tuple[ca.SX, ca.SX]:
        moving = list(self.task.moving)
        rates = (self._all_joints(v) for v in (dq, ddq))
        tau, spring = self.model.inverse(self._all_joints(q, self.task.locked), *rates, payload, theta, widths)
        return tau[moving], spring[moving]

    def _all_joints(self, moving: ca.SX, locked: Sequence[float] = ()) -> ca.SX:
        full = ca.SX(list(locked)) if any(locked) else ca.SX.zeros(self.task.robot.n)
        full[list(self.task.moving)] = moving
        return full

    def cost_rate(self, dq: ca.SX, ddq: ca.SX, tau: ca.SX, width: ca.SX | float) -> ca.SX:
        """The cost's rate at speeds and accelerations of the drives and load torques of the moving joints, (m,) each, in the cost's
        unit per second.

        Args:
            width: Over which drawn power gives way to returned power [W].
        """
        if self.cost == "load" or self.actuators is None:
            return ca.sumsqr(tau)
        if self.cost == "motor":
            return ca.sumsqr(self.actuators.motor_torque(dq, ddq, tau))
        return ca.sum1(self.actuators.power(dq, self.actuators.current(dq, ddq, tau), width))

    def _design(self) -> tuple[ca.Function | None, tuple[str, ...]]:
        p, d = ca.SX.sym("p", len(self.model.parameters)), ca.SX.sym("d", len(self.data_names))
        rows, names, offset = [], [], len(self.data_names) - 2 * sum(len(s.hardware) for s in self.springs)
        for spring, theta in each(self.springs, p):
            if spring.hardware:
                bounds = {h: (d[offset + 2 * i], d[offset + 2 * i + 1]) for i, h in enumerate(spring.hardware)}
                rows.append(spring.form.exists([*theta.values()], bounds))
                names += spring.form.limits
                offset += 2 * len(spring.hardware)
        return (ca.Function("design", [p, d], [ca.vertcat(*rows)]), tuple(names)) if rows else (None, ())

    def _holding_cost(self) -> float:
        """A tenth of the cost of holding the loaded arm still at both ends for two seconds each without springs: a magnitude."""
        ends = (self.task.start, self.task.release)
        held = [np.array(self.task.holding_torque(self.task.full(end), self.task.payload)) for end in ends]
        total = 2.0 * float(np.square(held).sum())
        return max(total / 10, 1e-3)

    @cached_property
    def torques(self) -> ca.Function:
        """(q, dq, ddq, payload, theta, widths) of the moving joints -> (load torque, spring torque), (m,) each [Nm]."""
        sizes = dict.fromkeys(("q", "dq", "ddq"), len(self.task.moving)) | {"payload": 1}
        sizes |= {"theta": len(self.model.parameters), "widths": self.model.widths.size}
        inputs = [ca.SX.sym(name, size) for name, size in sizes.items()]
        return ca.Function("torques", inputs, [ca.densify(tau) for tau in self._load_torque(*inputs)])

    def lifted(self, guess: Guess, phases: Sequence[int] = range(len(PHASES))) -> Guess:
        """A guess of these phases by accelerations of the links, with the torque of springs in series, and with jerks where these have
        limits."""
        if not self.series.rows:
            return replace(guess, phases=tuple(self._with_jerk(phase) for phase in guess.phases))

        def load(phase: int):
            payload, theta = self.task.payloads[phase], self.engaged(phase, guess.parameters)
            return lambda *motion: np.array(self.torques(*motion, payload, theta, self.model.widths)[0])

        parts, compliance = zip(phases, guess.phases, strict=True), guess.parameters[list(self.series.compliances)]
        lifted = (self.series.lifted(part, load(i), compliance) for i, part in parts)
        return replace(guess, phases=tuple(self._with_jerk(phase) for phase in lifted))

    def _with_jerk(self, phase: PhaseGuess) -> PhaseGuess:
        """A guess whose controls are accelerations with those of joints with a limit of jerk as states."""
        rows, s = self.task.jerky, np.linspace(0, 1, POINTS)
        if not rows:
            return phase
        most = self._control_limit[rows][:, None]
        course = CubicSpline(s, phase.controls(s)[rows], axis=1)

        def controls(s: np.ndarray) -> np.ndarray:
            u = phase.controls(s).copy()
            u[rows] = np.clip(course(s, 1) / phase.duration, -most, most)
            return u

        return PhaseGuess(phase.duration, lambda s: np.vstack([phase.states(s), phase.controls(s)[rows]]), controls)

    def hardware(self, parameters: np.ndarray) -> dict[str, float]:
        """The springs of a solution by a designer's names: k_p2, q_eq2, …, k_b, q_0, r_1, r_2, r_3, in SI units and radians."""
        found = {}
        for spring, named in each(self.springs, np.asarray(parameters, float).tolist()):
            if not spring.known:
                bounds = spring.hardware
                if bounds and self.task.spring_limits.force_N is not None:
                    bounds = spring.form.with_largest_pulleys([*named.values()], bounds)
                found |= spring.form.named(spring.effect.joints, named, bounds, spring.fixed)
        return found

    def with_physics(self, effects: Sequence[tuple[Effect, np.ndarray]]) -> "CoDesign":
        """The same problem on an arm that has further effects with known parameters, which come after the springs'."""
        values = [(effect, np.asarray(theta, float)) for effect, theta in effects]
        return replace(self, springs=(*self.springs, *(SpringBounds(e, v, v, known=True) for e, v in values)))

    def with_fixed(self, hardware: Mapping[str, float], keep_free: Sequence[str] = ()) -> "CoDesign":
        """The same problem with springs fixed to hardware, except the names in `keep_free`."""
        return replace(self, springs=tuple(spring.held(hardware, keep_free) for spring in self.springs))


def torque_path(joint: str) -> str:
    """Name of the path that a joint's torque limit bounds."""
    return f"load torque of {joint}"
