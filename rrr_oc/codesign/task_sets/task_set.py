"""A set of tasks that one set of springs has to serve, read from a file, and its co-design problem."""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

import casadi as ca
import msgspec
import numpy as np
from msgspec import Meta

from rrr_oc.calibration.calibrated_model import CalibratedModel
from rrr_oc.codesign.design_problem import CoDesign, Scenario
from rrr_oc.codesign.springs import SpringBounds, each
from rrr_oc.codesign.task import PHASES, PRESETS, End, Task, TaskFile, load_task, read_task, task_of
from rrr_oc.errors import UserError
from rrr_oc.optimal_control.problem import Guess, Link, Problem
from rrr_oc.schema import Interval, Payload, Positive, Schema, Text, check_interval, check_names, parsed, read_preset
from rrr_oc.storage import plain, read_utf8

SETS = ("twelve_tasks",)
FORMAT = "rrr_oc-tasks/1"
UNCERTAIN = 4  # quantities that may be uncertain together; each doubles the number of scenarios
Objective = Literal["sum", "worst"]


class TaskEntry(Schema, frozen=True):
    """One task of a set: a file of its own, or the base with what is given here in the place of its own.

    Attributes:
        name: Name in reports; by default the file's, or the number in the list.
        weight: Factor on its cost; of one task alone it counts for nothing.
        task: A bundled task or the path of a task's file, relative to this file; by default the base.
        payload_kg: Mass that it carries from start to release.
        start: Where the arm takes the payload.
        release: Where it lets it go.
        duration_s: Least and greatest duration of each way, above 0.
    """

    name: Text | None = None
    weight: Positive = 1.0
    task: Text | None = None
    payload_kg: Payload | None = None
    start: End | None = None
    release: End | None = None
    duration_s: Interval | None = None

    def __post_init__(self) -> None:
        check_interval("duration_s", self.duration_s)
        if self.duration_s is not None and not self.duration_s[0] > 0:
            raise ValueError(f"duration_s: found {list(self.duration_s)}; durations above 0 are required")

    @property
    def changes(self) -> dict[str, Any]:
        """What it puts in the place of the base's, by key."""
        given = {key: getattr(self, key) for key in ("payload_kg", "start", "release", "duration_s")}
        return {key: value for key, value in given.items() if value is not None}


class Uncertain(Schema, frozen=True):
    """What is not known while springs and motions are designed; the cost of a task is that of the worst case.

    Attributes:
        payload: Share of the payload by which it may be smaller or larger [1].
        model: Parameters of the model that `--model` names, as `effect[joint].parameter`, each anywhere in its 95 % interval.
    """

    payload: Annotated[float, Meta(ge=0, lt=1)] = 0.0
    model: tuple[Text, ...] = ()


class TaskSetFile(Schema, frozen=True):
    """The content of a set's file.

    Attributes:
        format: What the file is.
        tasks: The tasks. They need the same arm, moving joints and springs.
        base: A bundled task or the path of a task's file, relative to this file; for tasks that have no file of their own.
        name: Name in reports; by default the file's.
        objective: Whether the weighted sum of the tasks' costs is minimised, or the greatest of the weighted costs.
        uncertain: What is not known while springs and motions are designed.
    """

    format: Literal["rrr_oc-tasks/1"]
    tasks: Annotated[tuple[TaskEntry, ...], Meta(min_length=1)]
    base: Text | None = None
    name: Text | None = None
    objective: Objective = "sum"
    uncertain: Uncertain | None = None


@dataclass(frozen=True, eq=False)
class TaskSet:
    """Tasks that the same springs serve, each with a motion of its own.

    Attributes:
        name: Name in reports.
        tasks: The tasks (T), with different names, of the same arm, moving joints and springs.
        weights: Factors on their costs [1], (T,).
        objective: "sum" of the weighted costs, or the "worst" of them.
        payload: Share of the payload by which it may be smaller or larger [1].
        model: Parameters of a calibrated model that may lie anywhere in their 95 % interval.
    """

    name: str
    tasks: tuple[Task, ...]
    weights: np.ndarray
    objective: Objective = "sum"
    payload: float = 0.0
    model: tuple[str, ...] = ()

    @classmethod
    def of_one(cls, task: Task) -> "TaskSet":
        """A task alone."""
        return cls(task.name, (task,), np.ones(1))

    @property
    def first(self) -> Task:
        """The first task, or the only one."""
        return self.tasks[0]

    @property
    def contents(self) -> list[Any]:
        """All that the set says, as plain data, to tell whether two sets are the same."""
        of = [f.name for f in fields(Task) if f.name not in ("robot", "tool", "files", "goals", "via")]
        tasks = [
            {name: getattr(task, name) for name in of}
            | {"tool": task.tool.position, "goals": [goal and asdict(goal) for goal in task.goals]}
            | {"via": [asdict(passed) for passed in task.via]}
            for task in self.tasks
        ]
        return plain([tasks, self.weights, self.objective, self.payload, self.model])


def is_task_set(source: str) -> bool:
    """Whether a name or a file's content says that it is a set of tasks; whatever else may be wrong with it."""
    if source in SETS:
        return True
    if source in PRESETS or not Path(source).is_file():
        return False
    content = parsed(source, read_utf8(source).decode())
    return isinstance(content, dict) and str(content.get("format", "")).startswith("rrr_oc-tasks/")


def load_tasks(source: str | Path) -> TaskSet:
    """A set of tasks, or a single task as a set; raises `UserError` as `load_task_set` and `load_task` do."""
    if is_task_set(str(source)):
        return load_task_set(source)
    return TaskSet.of_one(load_task(source))


def load_task_set(source: str | Path) -> TaskSet:
    """Read a set of tasks: the name of a bundled one (`SETS`) or the path of a JSON file.

    Raises:
        UserError: The file or one that it names is missing or malformed; a task cannot be done; two tasks have the same name or
            another arm, other moving joints or other springs than the first.
    """
    where, given = read_preset("set of tasks", source, {name: f"{name}.json" for name in SETS}, TaskSetFile)
    folder = Path() if str(source) in SETS else Path(source).parent
    tasks = tuple(_task(f"{where}: tasks[{i}]", folder, given.base, entry, i) for i, entry in enumerate(given.tasks))
    names = [task.name for task in tasks]
    for i, task in enumerate(tasks):
        if task.name in names[:i]:
            raise UserError(f"{where}: tasks[{i}].name: {task.name!r} stands twice; each task needs a name of its own")
        _check_alike(f"{where}: tasks[{i}]", tasks[0], task)
    unsure = given.uncertain or Uncertain()
    if (count := bool(unsure.payload) + len(set(unsure.model))) > UNCERTAIN:
        raise UserError(f"{where}: uncertain: found {count} quantities; at most {UNCERTAIN} are allowed")
    return TaskSet(
        given.name or Path(str(source)).stem,
        tasks,
        np.array([entry.weight if len(tasks) > 1 else 1.0 for entry in given.tasks]),
        given.objective,
        unsure.payload,
        tuple(dict.fromkeys(unsure.model)),
    )


def _task(where: str, folder: Path, base: str | None, entry: TaskEntry, index: int) -> Task:
    """The task of an entry; messages name the entry."""
    named = entry.task or base
    if named is None:
        raise UserError(f"{where}: key 'task' is missing; it is required where the set has no 'base'")
    source = named if named in PRESETS else str(folder / named)
    try:
        content: TaskFile = read_task(source)[1]
    except UserError as error:
        raise UserError(f"{where}: {error}") from None
    name = entry.name or (Path(named).stem if entry.task else str(index + 1))
    return task_of(where, msgspec.structs.replace(content, name=name, **entry.changes), source)


def _check_alike(where: str, first: Task, task: Task) -> None:
    arms = [(t.robot.joints, t.moving, t.robot.placements.tolist(), t.robot.inertial.tolist()) for t in (first, task)]
    for what, (own, other) in (
        ("moving joints", (first.joints, task.joints)),
        ("arm", arms),
        ("springs", (list(first.springs), list(task.springs))),
    ):
        if own != other:
            found = (
                f"found {', '.join(task.joints)} in the place of {', '.join(first.joints)}; " if what == "moving joints" else ""
            )
            raise UserError(f"{where}: {found}the {what} must be those of the first task, as the springs are the same for all")


@dataclass(frozen=True, eq=False)
class SetDesign:
    """A set of tasks and the springs that may help it, as one problem: the phases of all tasks, which share the springs.

    Attributes:
        tasks: The set.
        designs: The problem of each task alone (T), with the same springs and equally many scenarios.
    """

    tasks: TaskSet
    designs: tuple[CoDesign, ...]

    @classmethod
    def of_one(cls, design: CoDesign) -> "SetDesign":
        """The problem of a task alone."""
        return cls(TaskSet.of_one(design.task), (design,))

    @property
    def first(self) -> CoDesign:
        """The problem of the first task."""
        return self.designs[0]

    @property
    def springs(self) -> tuple[SpringBounds, ...]:
        """The springs, with their bounds."""
        return self.first.springs

    @property
    def sprung(self) -> bool:
        """Whether there is a spring to be designed."""
        return any(not spring.known for spring in self.springs)

    def data(self, width: float | None = None) -> np.ndarray:
        """Values of the problem's data, those of one task after the other; see `CoDesign.data`."""
        return np.concatenate([design.data(width) for design in self.designs])

    @cached_property
    def problem(self) -> Problem:
        """The joint optimal-control problem. Its cost is the objective, the costs of a task being those of its scenarios."""
        if len(self.designs) == 1:
            return self.first.problem
        alone, size, cases = self.first.problem, len(self.first.data_names), self.first.costs
        shared = self.tasks.objective == "sum" and cases == 1  # then the costs add up and need no levels
        count = 1 if shared else cases * len(self.designs)
        phases = tuple(
            replace(
                phase,
                name=f"{phase.name} of {design.task.name}",
                data=t * size + np.arange(size),
                costs=(0,) if shared else tuple(range(cases * t, cases * (t + 1))),
                weight=float(self.tasks.weights[t]),
            )
            for t, design in enumerate(self.designs)
            for phase in design.problem.phases
        )
        every = ca.SX.sym("d", size * len(self.designs))
        p = ca.SX.sym("p", len(alone.parameters))
        exists = alone.design and ca.Function("design", [p, every], [alone.design(p, every[:size])])
        groups = tuple(k // cases if self.tasks.objective == "sum" else 0 for k in range(count))
        scale = self.total([design.problem.cost_scale for design in self.designs])
        links = tuple(
            Link(len(PHASES) * t + link.before, len(PHASES) * t + link.after, link.states)
            for t, design in enumerate(self.designs)
            for link in design.problem.links
        )
        cycles = tuple(
            replace(cycle, phases=tuple(len(PHASES) * t + i for i in cycle.phases))
            for t, design in enumerate(self.designs)
            for cycle in design.problem.cycles
        )
        joint = replace(alone, phases=phases, links=links, cycles=cycles, groups=groups)
        return replace(joint, data=self.data(), design=exists, cost_scale=scale)

    def total(self, costs: Sequence[float] | np.ndarray) -> float:
        """The objective from the tasks' costs (T,)."""
        weighted = self.tasks.weights * np.asarray(costs, float)
        return float(weighted.sum() if self.tasks.objective == "sum" else weighted.max())

    def guess(self, motions: Sequence[Guess], parameters: np.ndarray) -> Guess:
        """Springs (np,) and the motion of each task (T) as a starting point of the joint problem."""
        return Guess(tuple(phase for motion in motions for phase in motion.phases), parameters)

    def motions(self, guess: Guess) -> list[Guess]:
        """The motion of each task (T), of a starting point of the joint problem."""
        count = len(PHASES)
        return [Guess(guess.phases[count * t : count * (t + 1)], guess.parameters) for t in range(len(self.designs))]

    def with_springs(self, springs: tuple[SpringBounds, ...]) -> "SetDesign":
        """The same tasks with other springs."""
        return replace(self, designs=tuple(replace(design, springs=springs) for design in self.designs))

    def with_fixed(self, hardware: Mapping[str, float], keep_free: Sequence[str] = ()) -> "SetDesign":
        """The same tasks with springs fixed to hardware, except the names in `keep_free`."""
        return replace(self, designs=tuple(design.with_fixed(hardware, keep_free) for design in self.designs))

    def held(self, parameters: np.ndarray) -> list[CoDesign]:
        """The problem of each task alone with the springs held (np,)."""
        return [design.with_fixed(design.hardware(parameters)) for design in self.designs]


def with_uncertainty(design: CoDesign, tasks: TaskSet, model: CalibratedModel | None) -> CoDesign:
    """The design with every combination of the ends of what is uncertain as a scenario.

    The load torque is affine in the payload and in inertial parameters. Along a given motion E1 is then a convex quadratic function of
    them, whose greatest value on a box is at one of its corners. So the worst of these scenarios is the worst case exactly.

    Raises:
        UserError: A parameter is none of a known effect of the design, or the model has no interval for it.
    """
    choices: list[list[tuple[float, Mapping[int, float]]]] = []
    if tasks.payload:
        choices.append([(1 - tasks.payload, {}), (1 + tasks.payload, {})])
    for at, (low, high) in _intervals(design, tasks, model):
        choices.append([(1.0, {at: low}), (1.0, {at: high})])
    scenarios = []
    for corner in itertools.product(*choices):
        values = {at: value for _, one in corner for at, value in one.items()}
        scenarios.append(Scenario(float(np.prod([factor for factor, _ in corner])), tuple(values.items())))
    return replace(design, scenarios=tuple(scenarios))


def _intervals(design: CoDesign, tasks: TaskSet, model: CalibratedModel | None) -> list[tuple[int, tuple[float, float]]]:
    """(index among the design's parameters, 95 % interval) of each uncertain parameter of the model."""
    where = f"set {tasks.name!r}: uncertain.model"
    if not tasks.model:
        return []
    if model is None:
        raise UserError(f"{where}: {tasks.model[0]} needs --model and --repaired, the model that has its 95 % interval")
    terms, known = {(term.effect.name, term.effect.joints): term for term in model.terms}, {}
    for spring, at in each(design.springs, range(len(design.model.parameters))):
        if spring.known:
            effect = spring.effect
            named = zip(at.items(), terms[effect.name, effect.joints].estimates, strict=True)
            intervals = {name: (i, e.interval) for (name, i), e in named if e.interval is not None}
            known |= {f"{design.model.label(effect)}.{name}": found for name, found in intervals.items()}
    if not known:
        raise UserError(f"{where}: found {tasks.model[0]}; the model has no parameter of links or payload with a 95 % interval")
    check_names(tasks.model, known, where, "parameter")
    return [known[name] for name in tasks.model]
