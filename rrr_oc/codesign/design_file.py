"""A design study as data: what `summary.json` holds, for one task or for several."""

from collections.abc import Mapping
from typing import Any, Literal, TypeVar

import msgspec
from msgspec import Struct

from rrr_oc.codesign.certificate import Certificate
from rrr_oc.codesign.clearance import KeepOut
from rrr_oc.codesign.parts.limits import SpringLimits
from rrr_oc.codesign.parts.order_list import Part
from rrr_oc.codesign.purchasable import Coverage
from rrr_oc.codesign.search.motions import Covered
from rrr_oc.storage import plain

COMPARISON = "the comparison at equal cycle times"  # among what is unfinished
FORMAT = "rrr_oc-design/1"
T = TypeVar("T")


class MetricsEntry(Struct, frozen=True, forbid_unknown_fields=True):
    """The paper's metrics of a torque.

    Attributes:
        E1: Integral of the squared torque, summed over the moving joints [N²m²s].
        E1_joint: The same by joint [N²m²s].
        rms: Root mean square by joint [Nm].
        peak: Greatest magnitude by joint [Nm].
    """

    E1: float
    E1_joint: dict[str, float]
    rms: dict[str, float]
    peak: dict[str, float]


class OfMotors(MetricsEntry, frozen=True):
    """Metrics of the motor torque that a motion needs of given motors and gears, at the joint's output; its E1 is the motor torque squared.

    Attributes:
        work_J: Work that the motors do; what flows back does not count.
        electrical_J: Electrical energy (Eq. 11); null where a winding resistance is unknown.
    """

    work_J: float
    electrical_J: float | None = None


class Tracking(MetricsEntry, frozen=True):
    """Metrics of the load torque in MuJoCo.

    Attributes:
        E1_relative_error: Relative to the planned E1; null where the cost is another [1].
        energy_residual: What the balance of energy misses, relative [1].
        tracking_error_rad: Greatest distance from the planned angles.
    """

    E1_relative_error: float | None
    energy_residual: float
    tracking_error_rad: float


class SimulatedOptimum(Tracking, frozen=True):
    """Metrics of the load torque in MuJoCo, with the smoothed springs of the design.

    Attributes:
        exact_springs: The same with exact springs.
    """

    exact_springs: Tracking


class Transferred(Struct, frozen=True, forbid_unknown_fields=True):
    """A motion tracked in the calibrated model.

    Attributes:
        engine: Of the load torque along the simulated motion.
        eq10: Of the load torque that follows from the motor torque; null where the drives are not known.
        motor: Of the motor torque.
        tracking_error_rad: Greatest distance from the planned angles.
        saturated: Whether a controller reached its limit.
        uncalibrated: Joints that the model says nothing of.
    """

    engine: MetricsEntry
    eq10: MetricsEntry | None
    motor: MetricsEntry
    tracking_error_rad: float
    saturated: bool
    uncalibrated: tuple[str, ...] = ()


class MeshRow(Struct, frozen=True, forbid_unknown_fields=True):
    """A solve on one mesh.

    Attributes:
        intervals: Their number in each phase.
        cost: The cost, in its unit.
        error: Largest relative error between the nodes [1].
        quadrature: Relative error of the cost's quadrature [1].
        violation: Largest excess of a limit between the nodes, relative to its scale [1].
        iterations: Of IPOPT.
        seconds: Wall time [s].
        change: Relative change of the cost from the mesh before; null on the first [1].
        converged: Whether error and change are within the tolerance; null on the first.
    """

    intervals: tuple[int, ...]
    cost: float
    error: float
    quadrature: float
    violation: float
    iterations: int
    seconds: float
    change: float | None = None
    converged: bool | None = None


class Case(Struct, frozen=True, forbid_unknown_fields=True):
    """A motion in one case of what is uncertain.

    Attributes:
        payload_kg: The payload in this case.
        parameters: Values of the uncertain parameters of the model, by name.
        E1: As planned [N²m²s].
        mujoco: E1 in MuJoCo, which knows the case [N²m²s].
        says: What the case is; empty where payload and parameters say it.
    """

    payload_kg: float
    parameters: dict[str, float]
    E1: float
    mujoco: float
    says: str = ""


class OfMember(Struct, frozen=True, forbid_unknown_fields=True):
    """A design on the arm as one model has it that the recordings allow.

    Attributes:
        says: In what the model differs from the calibrated one, or "as calibrated".
        E1: Range over 95 % of what the recordings leave open of its numbers [N²m²s].
        cost: The same of the cost, in the cost's unit.
        E1_itself: At its own numbers [N²m²s].
        decided_by: File of a motion whose recording would tell the model from the calibrated one, or of the calibrated one its numbers:
            one that the diagnosis suggests, or the designed motion; null where both models show the same torques.
    """

    says: str
    E1: tuple[float, float]
    cost: tuple[float, float]
    E1_itself: float
    decided_by: str | None


class Foreseen(Struct, frozen=True, forbid_unknown_fields=True):
    """What the recordings behind a calibrated model let one foresee of a design.

    Attributes:
        E1: Range over all models that the recordings allow [N²m²s].
        cost: The same of the cost, in the cost's unit.
        members: These models, the calibrated one first.
        widened_by: The model that widens the range most; null where the cost's upper end is at most 1.5 times the lower.
        narrowed_by: File of the motion whose recording would narrow such a range, as `decided_by` of that model.
    """

    E1: tuple[float, float]
    cost: tuple[float, float]
    members: tuple[OfMember, ...]
    widened_by: str | None
    narrowed_by: str | None


class LocalOptimum(Struct, frozen=True, forbid_unknown_fields=True):
    """A local optimum that the search found.

    Attributes:
        cost: Its cost, in the cost's unit.
        reached: Number of independent starts that led to it; 0 where it was found from others.
        refined: Whether its mesh was refined; others carry the error of their mesh.
        durations: Of each phase [s].
        springs: By a designer's names, in SI units and radians.
    """

    cost: float
    reached: int
    refined: bool
    durations: dict[str, float]
    springs: dict[str, float]


class Layer(Struct, frozen=True, forbid_unknown_fields=True):
    """What starts of one source led to, on the coarse mesh.

    Attributes:
        starts: Their number.
        failed: How many led to no optimum.
        best: Least cost; null where all failed.
        median: Median of the costs; null where all failed.
        best_proposal: Least cost of a starting point itself; null where it is not finite.
        seconds: Wall time of all together [s].
    """

    starts: int
    failed: int
    best: float | None
    median: float | None
    best_proposal: float | None
    seconds: float


class MovedEntry(MetricsEntry, frozen=True, kw_only=True):
    """The motion of a task with the springs of a configuration, and metrics of its load torque.

    Attributes:
        cost: Its cost, in the cost's unit; where something is uncertain, of the worst case, or the mean of all.
        alone: The cost with springs of its own; that of the task where there is one alone.
        with_first: The cost with the springs tuned to the first task, and the best motion for these.
        springs_alone: Springs of its own, by a designer's names, in SI units and radians.
        durations: Of each phase [s].
        start: Angles by joint where the arm takes the payload [rad].
        release: Angles by joint where it lets it go [rad].
        lowest_tool_m: Height of the lowest point of the tool above the base.
        motors: What the motors do; null where they are not known.
        lowest_link_m: The same of the lines from joint to joint; null where a file does not say it.
        turns: Least and greatest deflection of each helical spring in the motion [rad], by label; of one across two joints about the
            first of them.
        idle: Springs that do nothing along the motion, by label, and why.
        beyond: Springs that the motion turns further than their law is known, by label, and how far.
        certificate: What is known of the optimum; of several tasks, with the springs held.
        meshes: Each mesh that was solved on.
        mujoco: The motion in MuJoCo.
        scenarios: The cases of what is uncertain; none where nothing is.
        calibrated: The motion in the calibrated model; null where none is given.
        foreseen: The motion on the arm as the recordings allow it to be; null without a calibrated model, and with springs between
            drives and links.
    """

    cost: float
    alone: float
    with_first: float
    springs_alone: dict[str, float]
    durations: dict[str, float]
    start: dict[str, float]
    release: dict[str, float]
    lowest_tool_m: float
    idle: dict[str, str]
    beyond: dict[str, str]
    certificate: Certificate
    meshes: tuple[MeshRow, ...]
    mujoco: SimulatedOptimum
    scenarios: tuple[Case, ...] = ()
    calibrated: Transferred | None = None
    foreseen: Foreseen | None = None
    turns: dict[str, tuple[float, float]] = {}
    lowest_link_m: float | None = None
    motors: OfMotors | None = None


class Bought(Coverage, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The search of a catalogue.

    Attributes:
        gap: Cost of buying instead of making: relative to the continuous optimum [1].
        runners_up: Cost and hardware of the best choices, on the fine mesh.
    """

    gap: float
    runners_up: tuple[dict[str, float], ...]


class Priced(Struct, frozen=True, forbid_unknown_fields=True):
    """The best that was found with some number of springs.

    Attributes:
        count: Number of springs.
        cost: The objective without the price, in the cost's unit.
        priced: The objective with the price, in the cost's unit.
        springs: By a designer's names, in SI units and radians.
        mounted: How each is mounted, by its label.
    """

    count: int
    cost: float
    priced: float
    springs: dict[str, float]
    mounted: dict[str, dict[str, Any]]


class ChoiceEntry(Struct, frozen=True, forbid_unknown_fields=True):
    """Which of the offered springs are worth their price.

    Attributes:
        price: Of a spring, in the cost's unit.
        offered: Number of places for springs.
        chosen: Index of the best point at this price.
        solved: Number of sets of springs that were solved with their motions.
        points: The least cost that was found for each number of springs, fewest first.
    """

    price: float
    offered: int
    chosen: int
    solved: int
    points: tuple[Priced, ...]


class Compromise(Struct, frozen=True, forbid_unknown_fields=True):
    """The best springs where the first task weighs more than in the set.

    Attributes:
        share: Share of the objective that is the first task's cost alone; 0 is the set's own objective [1].
        first: Cost of the first task, in the cost's unit.
        total: The set's own objective, in the cost's unit.
        springs: By a designer's names, in SI units and radians.
    """

    share: float
    first: float
    total: float
    springs: dict[str, float]


class Balancing(Struct, frozen=True, forbid_unknown_fields=True):
    """Springs of the same kinds that balance the arm at rest, and the best motion that was found for them.

    Attributes:
        springs: By a designer's names, in SI units and radians.
        cost: In the cost's unit.
        cycle_s: Duration of both phases together.
    """

    springs: dict[str, float]
    cost: float
    cycle_s: float


class AtCycleTime(Struct, frozen=True, forbid_unknown_fields=True):
    """The least costs that were found where both phases together take a given time; null where no motion was found.

    Attributes:
        cycle_s: The time.
        cost: Of springs that are designed for it, in the cost's unit.
        balancing: Of the springs that balance the arm at rest.
    """

    cycle_s: float
    cost: float | None
    balancing: float | None


class Configuration(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The best springs of one configuration and the motions for them.

    Attributes:
        cost: The objective, in the cost's unit; of one task its cost.
        alone: The objective with springs of its own for each task, in the cost's unit.
        with_first: The objective with the springs tuned to the first task, in the cost's unit.
        springs: By a designer's names, in SI units and radians.
        mounted: How each spring is mounted, by its label.
        parameters: Values by label and name, of the springs and of effects that the arm has, in SI units.
        tasks: The motions, by task.
        parts: The springs as parts, each in every way in which it can be made; of several tasks for all of them.
        optima: The distinct local optima of a task that is designed for alone, cheapest first.
        layers: Starts, by their source; none without springs that several tasks share.
        covered: What the search for motions of held springs has solved; null where several tasks share the springs.
        change: By how much springs and motions fell when they were solved together on the refined meshes, relative; null where that
            problem was not solved [1].
        front: Optima between that of the set and that of the first task.
        choice: What was chosen at a price; null without one.
        catalogue: How the catalogue was searched; null for springs that are made.
        not_bought: Why no choice of the catalogue could be solved; null otherwise.
        published_springs: Cost with the hardware that was published for the task, motion re-optimised; null where there is none.
        balancing: Springs that balance the arm at rest, to compare with; null where there are none, and where several tasks share the
            springs.
        at_cycle_times: The configuration at cycle times that all configurations have in common.
        interrupted: Whether the search was ended before all starts were made.
        wall_s: Wall time.
    """

    cost: float
    alone: float
    with_first: float
    springs: dict[str, float]
    mounted: dict[str, dict[str, Any]]
    parameters: dict[str, dict[str, float]]
    tasks: dict[str, MovedEntry]
    parts: tuple[Part, ...] = ()
    optima: tuple[LocalOptimum, ...] = ()
    layers: dict[str, Layer] = {}
    covered: Covered | None = None
    change: float | None = None
    front: tuple[Compromise, ...] = ()
    choice: ChoiceEntry | None = None
    catalogue: Bought | None = None
    not_bought: str | None = None
    published_springs: float | None = None
    balancing: Balancing | None = None
    at_cycle_times: tuple[AtCycleTime, ...] = ()
    interrupted: bool = False
    wall_s: float

    @property
    def first(self) -> MovedEntry:
        """The motion of the first task, or of the only one."""
        return next(iter(self.tasks.values()))

    @property
    def does_nothing(self) -> bool:
        """Whether there are springs and none of them does anything in any task."""
        return bool(self.mounted) and all(set(moved.idle) == set(self.mounted) for moved in self.tasks.values())


class LimitsEntry(Struct, frozen=True, forbid_unknown_fields=True):
    """Limits of a joint; null where there is none.

    Attributes:
        range_rad: Least and greatest angle.
        speed_rad_per_s: Greatest speed [rad/s].
        acceleration_rad_per_s2: Greatest acceleration [rad/s²].
        torque_Nm: Greatest load torque.
        jerk_rad_per_s3: Greatest rate of the acceleration [rad/s³].
    """

    range_rad: tuple[float | None, float | None]
    speed_rad_per_s: float | None
    acceleration_rad_per_s2: float | None
    torque_Nm: float | None
    jerk_rad_per_s3: float | None = None


class PassedPoint(Struct, frozen=True, forbid_unknown_fields=True):
    """A point that the arm passes.

    Attributes:
        phase: Which way: "go" or "return".
        time_share: Share of the phase's time after which it is there [1].
    """

    phase: str
    time_share: float


class TaskAsked(Struct, frozen=True, forbid_unknown_fields=True):
    """A task that was asked for.

    Attributes:
        name: Its name.
        weight: Factor on its cost [1].
        payload_kg: What it carries from start to release.
        duration_s: Least and greatest duration of each phase.
        cycle_s: Least and greatest duration of both phases together; null where only `duration_s` bounds it.
        start: Angles by joint where the arm takes the payload [rad]; null where the posture is free.
        release: Angles by joint where it lets it go [rad]; null where the posture is free.
        speeds: Whether the arm is at rest, moving or free at start and release.
        limits: Of the moving joints, by name.
        spring_limits: Of the springs as parts; null where a file does not say it.
        floor_m: Height that tool and links stay above; null where there is no floor.
        keep_outs: What tool and links keep out of.
        link_radius_m: Of the links about the lines from joint to joint.
        via: Points that the arm passes on its ways.
    """

    name: str
    weight: float
    payload_kg: float
    duration_s: tuple[float, float]
    cycle_s: tuple[float, float] | None
    start: dict[str, float] | None
    release: dict[str, float] | None
    speeds: dict[str, str]
    limits: dict[str, LimitsEntry]
    spring_limits: SpringLimits | None = None
    floor_m: float | None = None
    keep_outs: tuple[KeepOut, ...] = ()
    link_radius_m: float = 0.0
    via: tuple[PassedPoint, ...] = ()


class Unsure(Struct, frozen=True, forbid_unknown_fields=True):
    """What is not known while springs and motions are designed.

    Attributes:
        payload: Share of the payload by which it may be smaller or larger [1].
        model: Parameters of the model that may lie anywhere in their 95 % interval.
        over: Whether the calibrated model's cost is minimised, or the mean or the worst over the models that its recordings allow.
    """

    payload: float = 0.0
    model: tuple[str, ...] = ()
    over: Literal["calibrated", "mean", "worst"] = "calibrated"


class QuantityEntry(Struct, frozen=True, forbid_unknown_fields=True):
    """What is minimised.

    Attributes:
        name: Its name in tables and figures.
        unit: Its unit.
    """

    name: str
    unit: str

    @property
    def title(self) -> str:
        """Head of a column."""
        return f"{self.name} [{self.unit}]"

    @property
    def engine(self) -> str:
        """What the column of the engine shows, if that is not the cost."""
        return "" if self.name == "E1" else "E1 [N²m²s] of the load torque, "


class DesignFile(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The content of the file.

    Attributes:
        format: What the file is.
        name: Name of the task or of the set of tasks.
        tasks: The tasks.
        objective: Of several tasks, whether the weighted sum of the costs is minimised or the greatest weighted cost.
        uncertain: What is not known while springs and motions are designed.
        cost: What the cost of a task is, in words.
        quantity: Name and unit of the cost.
        paper: Whether the task is one of the paper's, whose published results stand beside ours.
        joints: All joints of the arm.
        moving: Those that move.
        command: What makes the study again.
        seed: Of the random starts.
        starts: Starts a configuration.
        wall_s: Wall time of the run.
        versions: Of this program, Python and what results may depend on.
        options: Options of the search.
        configurations: The results by configuration; a star marks hardware of the catalogue.
        unfinished: Configurations, and the comparison of all, that the study was ended before, as by Ctrl-C.
    """

    format: Literal["rrr_oc-design/1"] = FORMAT
    name: str
    tasks: tuple[TaskAsked, ...]
    objective: Literal["sum", "worst"]
    uncertain: Unsure
    cost: str
    quantity: QuantityEntry
    paper: bool
    joints: tuple[str, ...]
    moving: tuple[str, ...]
    command: str
    seed: int
    starts: int
    wall_s: float
    versions: dict[str, str]
    options: dict[str, Any]
    configurations: dict[str, Configuration]
    unfinished: tuple[str, ...] = ()

    @property
    def single(self) -> bool:
        """Whether there is one task alone."""
        return len(self.tasks) == 1


def typed(found: Mapping[str, Any], schema: type[T]) -> T:
    """A structure from what was computed: numpy's types as Python's, NaN and infinity as null."""
    return msgspec.convert(data(found), schema)


def data(found: Any) -> Any:
    """Structures, and whatever is in them, as plain data for JSON."""
    return plain(msgspec.to_builtins(found, enc_hook=plain))
