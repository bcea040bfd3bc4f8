"""An optimum's motion, sampled densely, its metrics, and its simulation in MuJoCo."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.parts.order_list import Part, order_list
from rrr_oc.codesign.search.local_optima import transcribed
from rrr_oc.codesign.search.proposals import SearchOptions
from rrr_oc.codesign.springs import acting, each, mounting
from rrr_oc.codesign.task import PHASES, Task
from rrr_oc.effects import DesignSpring, Effect, Wound
from rrr_oc.effects.base import Signals
from rrr_oc.model.metrics import Metrics, measure
from rrr_oc.model.motion import Motion
from rrr_oc.optimal_control.problem import Guess
from rrr_oc.optimal_control.solver import Solution
from rrr_oc.simulation.engine_model import Form, Settings, twin
from rrr_oc.simulation.engine_model import Start as StartOfPhase
from rrr_oc.simulation.tracking import Reference, Tracked, track

SAVED = ("t", "q", "dq", "ddq", "tau_load", "tau_spring", "phase", "payload", "twist")  # arrays of a saved design's motion
IDLE = 1e-3  # [1] of the largest torque: a spring that adds no more does nothing; doubled, weak springs are called idle sooner


@dataclass(frozen=True, eq=False, kw_only=True)
class SampledMotion(Motion):
    """A task's motion sampled densely; rows are the moving joints (m), time is the last axis (K).

    Time 0 is the start of the task; the instant between two phases is sampled twice.

    Attributes:
        tau_load, tau_spring: [Nm], (m, K).
        phase: Index of the phase of each sample, not decreasing, (K,); the phases are the segments.
        twist: q, dq, ddq of the links less those of their drives, (3, m, K); 0 but for springs in series.
    """

    tau_load: np.ndarray
    tau_spring: np.ndarray
    phase: np.ndarray
    twist: np.ndarray

    def __post_init__(self) -> None:
        ends = np.searchsorted(self.phase, np.arange(len(PHASES) + 1)).tolist()
        object.__setattr__(self, "segments", tuple(slice(a, b) for a, b in pairwise(ends)))

    def phases(self) -> list[np.ndarray]:
        """Indices of each phase's samples."""
        return [np.arange(len(self.t))[s] for s in self.segments]

    def metrics(self) -> Metrics:
        """E1, RMS and peak of the load torque, by the trapezoid rule phase by phase."""
        return measure([(self.t[k], self.tau_load[:, k]) for k in self.phases()])

    def by_phase(self, task: Task) -> list[Motion]:
        """The motion of all joints (n, K) in each phase, from time 0, with the task's payloads."""
        rows = [(k, [task.full(self.q[:, k]), *(task.full_rates(x[:, k]) for x in (self.dq, self.ddq))]) for k in self.phases()]
        return [
            Motion(self.t[k] - self.t[k[0]], *values, payload=np.full(len(k), payload))
            for (k, values), payload in zip(rows, task.payloads, strict=True)
        ]

    def references(
        self, task: Task, thetas: Sequence[np.ndarray], torque: Callable[[Motion, np.ndarray, np.ndarray], np.ndarray]
    ) -> list[Reference]:
        """The phases as references of a tracking controller, with the parameters of the model in each; `torque` gives the feed-forward
        (n, K) [Nm] from a phase, its twist (3, n, K) and these."""
        twists = [np.array([task.full_rates(x[:, k]) for x in self.twist]) for k in self.phases()]
        return [
            Reference(p.t, p.q, p.dq, p.ddq, p.payload, name=name, feed_forward=torque(p, twist, own), theta=own, twist=twist)
            for name, p, twist, own in zip(PHASES, self.by_phase(task), twists, thetas, strict=True)
        ]

    @property
    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays of `SAVED` by name, from which `SampledMotion(**arrays)` restores the motion."""
        return {name: getattr(self, name) for name in SAVED}


def sample_motion(design: CoDesign, solution: Solution, tolerance: float = 2e-5) -> SampledMotion:
    """The optimum on enough points that the trapezoid rule gives its cost to a relative `tolerance`; with costs other than "load", on
    33 points an interval."""
    for points in (5, 9, 17, 33):
        motion = _sample(design, solution, points)
        if design.cost == "load" and abs(motion.metrics().E1_total - solution.cost) <= tolerance * solution.cost:
            break
    return motion


def _sample(design: CoDesign, solution: Solution, points: int) -> SampledMotion:
    widths = design.widths(solution.problem.data)
    m, start, parts = len(design.task.moving), 0.0, []
    for i, payload in enumerate(design.task.payloads):
        t, x, _, u = solution.sample(i, np.linspace(0, 1, points))
        keep = np.r_[np.flatnonzero(np.tile(np.arange(points) < points - 1, t.shape[0])), t.size - 1]
        ddq = solution.rates(i, x, u)[0][m : 2 * m]
        x, u, ddq = (v.reshape(len(v), -1)[:, keep] for v in (x, u, ddq))
        q, dq, twist = x[:m], x[m : 2 * m], design.series.twist(x, ddq, design.accelerations(x, u), solution.parameters)
        tau, spring = (np.array(v) for v in design.torques(q, dq, ddq, payload, design.engaged(i, solution.parameters), widths))
        n = len(keep)
        parts.append((start + t.ravel()[keep], q, dq, ddq, tau, spring, np.full(n, i), np.full(n, payload), twist))
        start += solution.durations[i]
    columns = [np.concatenate(column, axis=-1) for column in zip(*parts, strict=True)]
    return SampledMotion(**dict(zip(SAVED, columns, strict=True)))


def mounted(design: CoDesign) -> dict[str, dict[str, Any]]:
    """How each spring of a design is mounted: the values of its effect's options, by its label."""
    return {design.model.label(s.effect): mounting(s.effect) for s in design.springs if not s.known}


def profiles(task: Task, springs: Sequence[tuple[Effect, Mapping[str, float]]]) -> dict[str, dict[str, np.ndarray]]:
    """Tables by which springs with given parameters are made (`DesignSpring.profile`), by label, over one turn from the joint's
    least angle."""
    low, tables = np.full(task.robot.n, -np.pi), {}
    low[list(task.moving)] = np.where(np.isfinite(task.lower), task.lower, -np.pi)
    for effect, theta in springs:
        angles = low[effect.joints[0]] + np.radians(np.arange(361.0))
        if isinstance(effect, DesignSpring) and (columns := effect.profile(angles, theta)):
            tables[task.model().label(effect)] = columns
    return tables


def idle_springs(design: CoDesign, motion: SampledMotion, parameters: np.ndarray) -> dict[str, str]:
    """Why a spring does nothing along a motion, by its label, for each that does nothing: its exact torque stays below `IDLE` of the
    largest torque that the motion needs."""
    idle, needed = {}, float(np.max(np.abs(motion.tau_load + motion.tau_spring)))
    for spring, theta in each(design.springs, parameters):
        effect, model = spring.effect, design.task.model([spring.effect])
        if spring.known or effect.moves_link:
            continue
        torques = [
            model.inverse(p.q, p.dq, p.ddq, p.payload[0], [*theta.values()], np.zeros(model.widths.size))[1]
            for phase, p in enumerate(motion.by_phase(design.task))
            if phase in acting(effect)
        ]
        if max(float(np.max(np.abs(np.array(tau)))) for tau in torques) <= IDLE * needed:
            greatest = dict(zip(theta, spring.upper, strict=True))
            soft = all(theta[name] <= IDLE * greatest[name] for name in effect.amplitudes)
            idle[design.model.label(effect)] = "too soft to matter" if soft else "never taut"
    return idle


def turns(design: CoDesign, motion: SampledMotion, parameters: np.ndarray) -> dict[str, tuple[float, float]]:
    """Least and greatest deflection of each helical spring of a design along a motion (`Wound.stretch`) [rad], by its label; 0
    where it is slack."""
    found, q = {}, design.task.full(motion.q)
    for spring, theta in each(design.springs, parameters):
        effect = spring.effect
        if isinstance(effect, Wound) and not spring.known:
            stretch = effect.stretch(Signals(q[:, np.isin(motion.phase, acting(effect))]), theta)
            found[design.model.label(effect)] = max(float(np.min(stretch)), 0.0), max(float(np.max(stretch)), 0.0)
    return found


def parts(design: CoDesign, parameters: np.ndarray, turned: Mapping[str, tuple[float, float]]) -> list[Part]:
    """The parts of a design whose springs turn so far, by its task's limits."""
    hardware, effects = design.hardware(parameters), {design.model.label(s.effect): s for s in design.springs}
    axes = {label: effects[label].form.axis(hardware, effects[label].effect.joints) for label in turned}
    return order_list(axes, turned, design.task.spring_limits)


def beyond_known(design: CoDesign, motion: SampledMotion, parameters: np.ndarray) -> dict[str, str]:
    """How far a motion goes beyond the angles for which the law of a spring is known, by its label, for each that it goes beyond."""
    said, q = {}, np.degrees(design.task.full(motion.q))
    for spring, theta in each(design.springs, parameters):
        effect = spring.effect
        if isinstance(effect, DesignSpring) and not spring.known:
            (low, high), moved = np.degrees(effect.known_range(theta)), q[effect.joints[0]]
            if moved.min() < low - 1e-6 or moved.max() > high + 1e-6:
                way = f"which moves from {moved.min():.1f}° to {moved.max():.1f}°"
                said[design.model.label(effect)] = f"known from {low:.1f}° to {high:.1f}° of its joint, {way}"
    return said


def restart_arrays(solution: Solution) -> dict[str, np.ndarray]:
    """The variables, the mesh and the kind of controls of an optimum by name, from which `restored` makes it again."""
    t = solution.transcription
    mesh = {f"mesh_{phase}": fractions for phase, fractions in zip(PHASES, t.mesh, strict=True)}
    return {"variables": solution.w, "cost": np.array(solution.cost), "everywhere": np.array(t.scheme.everywhere), **mesh}


def restored(design: CoDesign, options: SearchOptions, arrays: Mapping[str, np.ndarray]) -> Solution:
    """An optimum from its `restart_arrays`, without multipliers; `options` are those of its search."""
    mesh = tuple(arrays[f"mesh_{phase}"] for phase in PHASES)
    problem = replace(design.problem, data=design.data(options.widths[-1]))
    transcription = replace(transcribed(design, options, 1, bool(arrays["everywhere"])), problem=problem, mesh=mesh)
    return Solution.bare(transcription, arrays["variables"], float(arrays["cost"]))


def embedded(solution: Solution, inner: CoDesign, outer: CoDesign) -> Guess | None:
    """An optimum as a starting point for a design with more springs, which do nothing there; None where a spring of `inner` is
    missing in `outer` or mounted in another way, and where `outer` has more springs between drives and links: these cannot do nothing.
    """
    own = {inner.model.label(s.effect): (s.effect, [*theta.values()]) for s, theta in each(inner.springs, solution.parameters)}
    parameters = []
    for spring in outer.springs:
        effect, values = own.pop(outer.model.label(spring.effect), (spring.effect, None))
        if mounting(effect) != mounting(spring.effect):
            return None
        if values is None:
            middle = zip(effect.parameters, spring.lower, spring.upper, strict=True)
            values = [low if p.name in effect.amplitudes else (low + high) / 2 for p, low, high in middle]
        parameters += values
    contained = not own and inner.series.rows == outer.series.rows
    return Guess(solution.guess().phases, np.array(parameters)) if contained else None


def check_simulation(design: CoDesign) -> None:
    """Raise `UserError` where MuJoCo cannot simulate the arm with the design's springs."""
    twin(design.model, design.model.theta({}), settings=Settings("native"))


def resimulate(design: CoDesign, solution: Solution, motion: SampledMotion, form: Form = "generated") -> Tracked:
    """Track the optimum in MuJoCo with its load torque as feed-forward and the paper's P-controllers; all joints are simulated.

    Drives have no inertia but those behind springs in series.
    """
    model, widths, inertia = design.model, design.widths(solution.problem.data), rotors(design)

    def load(phase: Motion, twist: np.ndarray, theta: np.ndarray) -> np.ndarray:
        links = np.array(model.inverse(phase.q, phase.dq, phase.ddq, phase.payload[0], theta, widths)[0])
        return links + inertia[:, None] * (phase.ddq - twist[2])

    thetas = [design.engaged(i, solution.parameters) for i in range(len(PHASES))]
    references = motion.references(design.task, thetas, load)
    settings = Settings(effects=form, start=start_of(design), armature=inertia)
    return track(model, references, solution.parameters, settings=settings, widths=widths)


def rotors(design: CoDesign) -> np.ndarray:
    """Inertia of the drives of joints with springs in series, at the joint [kg m²], (n,); 0 for other joints."""
    inertia = np.zeros(len(design.task.moving))
    if design.actuators is not None:
        rows = list(design.series.rows)
        inertia[rows] = design.actuators.reflected_inertia[rows]
    return design.task.full_rates(inertia)


def start_of(design: CoDesign) -> StartOfPhase:
    """How each phase of a task starts in a simulation: where the one before ended, unless the speed or the load of a spring between a
    drive and its link may differ."""
    return "reference" if "free" in design.task.speeds or design.series.rows else "continue"


def describe(design: CoDesign, metrics: Metrics, rows: tuple[int, ...] | None = None) -> dict[str, Any]:
    """E1 [N²m²s] in total and by joint, RMS and peak torque [Nm] by joint; `rows` are the moving joints' rows in the metrics."""
    joints = design.task.joints
    figures = {"E1_joint": metrics.E1, "rms": metrics.rms, "peak": metrics.peak}
    by_joint = {
        key: {j: float(x[row]) for j, row in zip(joints, rows or range(len(joints)), strict=True)} for key, x in figures.items()
    }
    return {"E1": sum(by_joint["E1_joint"].values()), **by_joint}


def describe_motors(design: CoDesign, motion: SampledMotion) -> dict[str, Any] | None:
    """The metrics of `describe` of the motor torque along a motion, "work_J" and "electrical_J"; None where the design has no actuators.

    Drives move as the links, unless springs stand between them.
    """
    motors = design.actuators
    if motors is None:
        return None
    drives, spans, work, electrical = motion.of_drives(motion.twist), [], 0.0, 0.0
    for k in motion.segments:
        t, dq, ddq = drives.t[k], drives.dq[:, k], drives.ddq[:, k]
        torque = np.array(motors.motor_from_load(dq, ddq, motion.tau_load[:, k]))
        spans.append((t, torque))
        work += float(np.trapezoid(np.maximum(torque * dq, 0).sum(axis=0), t))
        if np.all(np.isfinite(motors.resistance)):
            power = np.array(motors.exact_power(dq, torque / motors.torque_constant[:, None]))
            electrical += float(np.trapezoid(power.sum(axis=0), t))
    known = bool(np.all(np.isfinite(motors.resistance)))
    return describe(design, measure(spans)) | {"work_J": work, "electrical_J": electrical if known else None}


def describe_simulation(design: CoDesign, solution: Solution, motion: SampledMotion) -> dict[str, Any]:
    """The paper's metrics of the engine's load torque with smoothed springs (generated C), and under "exact_springs" with exact ones.

    Beside those of `describe`: "E1_relative_error" against the optimum's cost (None for costs other than "load"),
    "energy_residual" [1] and "tracking_error_rad".
    """
    described, planned = [], solution.cost if len(design.scenarios) == 1 else motion.metrics().E1_total
    for form in ("generated", "native"):
        tracked = resimulate(design, solution, motion, form)
        found = describe(design, tracked.metrics, design.task.moving)
        found["E1_relative_error"] = found["E1"] / planned - 1 if design.cost == "load" else None
        described.append(
            found | {"energy_residual": float(tracked.energy_residual), "tracking_error_rad": tracked.tracking_error}
        )
    return {**described[0], "exact_springs": described[1]}
