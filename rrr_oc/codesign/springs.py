"""The springs that a design may use, their bounds, and the configurations that they form."""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np

from rrr_oc.codesign.task import PHASES, Task, overloads
from rrr_oc.effects import Clutched, DesignSpring, Effect, design_forms
from rrr_oc.effects.design_form import DesignForm
from rrr_oc.errors import UserError, meant
from rrr_oc.kept import Listener
from rrr_oc.model.parameters import by_effect
from rrr_oc.schema import Interval, Schema, check_interval, check_names, read_json, validated
from rrr_oc.storage import plain


def configurations() -> dict[str, tuple[str, ...]]:
    """Names of the effects that each configuration has: "SA" none, then every combination of those that have a design form."""
    kinds = {label: kind.name for label, kind in design_forms().items()}
    some = [labels for count in range(1, len(kinds) + 1) for labels in itertools.combinations(kinds, count)]
    return {"SA": ()} | {"+".join(labels): tuple(kinds[label] for label in labels) for labels in some}


def allowed_configurations() -> str:
    """The names of configurations, in words."""
    return f"SA, which has no springs, or one or more of {', '.join(design_forms())}, in this order and joined by '+'"


def offered(task: Task) -> tuple[str, ...]:
    """The configurations whose springs a task offers, those of the fewest kinds first."""
    kinds = {kind.name for kind, _ in _entries(task)}
    return tuple(name for name, needed in configurations().items() if kinds.issuperset(needed))


def holding(task: Task, asked: Sequence[str] | None, names: Sequence[str], listener: Listener) -> tuple[str, ...]:
    """The configurations to solve: those asked for, or else those of `names` that have a spring on each joint that needs one.

    A joint needs one where its torque limit does not hold the arm and its load at an end of a phase; the listener is told.
    Raises `UserError` where a configuration that is asked for lacks such a spring, or all do.
    """
    weak = overloads(task)
    lacking = {name: [joint for joint in weak if joint not in _sprung(task, name)] for name in asked or names}
    kept = tuple(name for name, joints in lacking.items() if not joints)
    if not kept or (asked and len(kept) < len(lacking)):
        name = next(name for name, joints in lacking.items() if joints)
        told, others = weak[lacking[name][0]], ", ".join(n for n in names if n not in lacking or not lacking[n])
        mend = "a smaller payload, a greater limit or a spring on that joint is needed"
        raise UserError(
            f"task {task.name!r}: {told}; {name} has no spring there: {mend}{f', as in {others}' if others else ''}"
        )
    for told in weak.values():
        left = ", ".join(name for name in lacking if name not in kept)
        listener.note(f"Note: task {task.name!r}: {told}, so a spring has to help{f'; {left} is left out' if left else ''}.")
    return kept


def _sprung(task: Task, configuration: str) -> set[str]:
    """The joints on which the springs of a configuration act; one between drive and link takes no load from the drive."""
    kinds = configurations().get(configuration, ())
    entries = [(kind, given) for kind, given in _entries(task) if kind.name in kinds and not kind.moves_link]
    return {joint for kind, given in entries for joint in _joints(kind, given)}


@dataclass(frozen=True, eq=False)
class SpringBounds:
    """One spring that a design may use.

    Attributes:
        effect: The spring.
        lower, upper: Bounds of its parameters, in their order.
        hardware: Where the parameters are functions of the hardware (`DesignForm.derived`), the bounds of that by symbol [SI].
        fixed: Where such hardware is given, its values [SI].
        known: Whether it is an effect of the arm and no part of the design; then `lower` = `upper`, and any effect of the links
            or of the rigid body will do.
    """

    effect: Effect
    lower: np.ndarray
    upper: np.ndarray
    hardware: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    fixed: Mapping[str, float] = field(default_factory=dict)
    known: bool = False

    @property
    def place(self) -> tuple[str, tuple[int, ...]]:
        """What it is and on which joints; it may be mounted there in several ways, of which one can be."""
        return self.effect.name, self.effect.joints

    @property
    def form(self) -> DesignForm:
        """The spring's form in a co-design; raises `UserError` where it has none."""
        if not isinstance(self.effect, DesignSpring):
            raise UserError(f"{self.effect.name} has no form in a co-design")
        return self.effect.design

    def held(self, hardware: Mapping[str, float], keep_free: Sequence[str]) -> "SpringBounds":
        """The spring fixed to hardware, except the names in `keep_free`; itself where it is known or fixed already."""
        if self.known or self.fixed:
            return self
        box = self.lower, self.upper
        lower, upper, fixed = self.form.held(self.effect.joints, box, self.hardware, hardware, keep_free)
        return SpringBounds(self.effect, lower, upper, fixed=fixed)


def mounting(effect: Effect) -> dict[str, Any]:
    """How a spring is mounted: the values of its effect's options, as plain data."""
    return plain({key: getattr(effect, key) for key in effect.options})


def acting(effect: Effect) -> list[int]:
    """Indices of the phases in which a spring acts: of one with a clutch its own alone, in the other it is held as it is."""
    return [i for i, name in enumerate(PHASES) if not isinstance(effect, Clutched) or effect.phase == name]


def each(springs: Sequence[SpringBounds], parameters: Any) -> list[tuple[SpringBounds, dict[str, Any]]]:
    """Each spring with its parameters by name, of those of all (np, ...), numbers or casadi's."""
    own = by_effect([spring.effect for spring in springs], parameters)
    return [(spring, named) for spring, (_, named) in zip(springs, own, strict=True)]


def spring_bounds(task: Task, configuration: str) -> tuple[SpringBounds, ...]:
    """The springs of a configuration (`configurations`) with the task's bounds; raises `UserError` for crossed ones."""
    return tuple(ways[0] for ways in ways_to_mount(task, configuration))


def _bounded(task: Task, configuration: str) -> tuple[SpringBounds, ...]:
    """The same, mounted by default where the task leaves that open."""
    kinds = configurations().get(configuration)
    if kinds is None:
        raise UserError(
            f"unknown configuration {configuration!r}; it is {allowed_configurations()}{meant(configuration, configurations())}"
        )
    springs = [_spring(task, kind, given) for kind, given in _entries(task) if kind.name in kinds]
    places = [spring.place for spring in springs]
    for spring in springs:
        if places.count(spring.place) > 1:
            names = " and ".join(task.robot.joints[j] for j in spring.effect.joints)
            raise UserError(f"task {task.name!r}: two entries are a {spring.effect.name} of {names}; one is allowed")
    missing = [kind for kind in kinds if kind not in {s.effect.name for s in springs}]
    if missing:
        there = ", ".join(dict.fromkeys(kind.name for kind, _ in _entries(task)))
        raise UserError(
            f"task {task.name!r} offers no {missing[0]}, which configuration {configuration} needs; it offers {there or 'no springs'}"
        )
    return tuple(springs)


def _entries(task: Task) -> list[tuple[type[DesignSpring], Any]]:
    """The kind of each spring in a task, and its entry as `spring_schema` has it; raises `UserError` for one that is wrong."""
    known, entries = {kind.name: kind for kind in design_forms().values()}, []
    for i, entry in enumerate(task.springs):
        if entry.get("effect") not in [*known]:
            raise UserError(f"task {task.name!r}: a spring's effect is {' or '.join(known)}, got {entry.get('effect')!r}")
        kind = known[entry["effect"]]
        entries.append((kind, validated(f"task {task.name!r}", entry, spring_schema(kind), f".springs[{i}]")))
    return entries


def _joints(kind: type[DesignSpring], given: Any) -> tuple[str, ...]:
    """The joints that the entry of a spring names."""
    return given.joints if kind.placement == "pair" else (given.joint,)


def arrangements(task: Task, configuration: str) -> list[tuple[SpringBounds, ...]]:
    """The springs of a configuration in every way to mount them that the task leaves open, those of `spring_bounds` first.

    An effect's `options`, such as the side on which a spring pulls, are open where the task's entry does not name them.
    """
    return list(itertools.product(*ways_to_mount(task, configuration)))


def ways_to_mount(task: Task, configuration: str) -> list[list[SpringBounds]]:
    """For each spring of a configuration every way to mount it that the task leaves open, that of `spring_bounds` first."""
    springs = _bounded(task, configuration)
    kinds = {spring.effect.name for spring in springs}
    entries = [entry for entry in task.springs if entry["effect"] in kinds]
    return [_with_energy(task, _ways(s, entry)) for s, entry in zip(springs, entries, strict=True)]


def _with_energy(task: Task, ways: list[SpringBounds]) -> list[SpringBounds]:
    """Those ways to mount a spring in which it can keep its energy while a clutch is open; raises `UserError` if there is none."""
    ends, kept, refused = (task.full(task.start), task.full(task.release)), [], []
    for way in ways:
        try:
            if isinstance(way.effect, Clutched):
                if any(task.goals):
                    raise UserError('its clutch needs postures that are known: "posture": "held", or angles_deg')
                lower, upper = way.effect.kept_energy(way.lower, way.upper, ends)
                way = replace(way, lower=lower, upper=upper)
            kept.append(way)
        except UserError as error:
            refused.append(error)
    if not kept:
        raise UserError(f"task {task.name!r}: {task.model().label(ways[0].effect)}: {refused[0]}")
    return kept


def _ways(spring: SpringBounds, entry: Mapping) -> list[SpringBounds]:
    effect = spring.effect
    left = {key: getattr(effect, key) for key in effect.options if key not in entry}
    lists = []
    for key, default in left.items():
        allowed = effect.options[key]
        values = list(itertools.product(allowed, repeat=len(default))) if isinstance(default, tuple) else list(allowed)
        lists.append(sorted(values, key=lambda value, default=default: value != default))
    return [replace(spring, effect=replace(effect, **dict(zip(left, v, strict=True)))) for v in itertools.product(*lists)]


class SavedDesign(msgspec.Struct, frozen=True):
    """What makes a configuration's springs, of its entry in summary.json.

    Attributes:
        mounted: How each spring is mounted, by its label.
        parameters: Values by label and name, of the springs and of effects that the arm has.
        choice: Where springs had a price, what was chosen from; then only some of the configuration's springs are mounted.
    """

    mounted: dict[str, dict[str, Any]]
    parameters: dict[str, dict[str, float]]
    choice: dict[str, Any] | None = None


class SavedStudy(msgspec.Struct, frozen=True):
    """Of a summary.json what is read again.

    Attributes:
        configurations: The designs by name.
    """

    configurations: dict[str, SavedDesign]


@dataclass(frozen=True)
class SavedSprings:
    """The springs of a saved design.

    Attributes:
        mounted: Each with its parameters by name.
        known: Labels of effects that the arm had when it was designed for.
    """

    mounted: tuple[tuple[Effect, dict[str, float]], ...]
    known: tuple[str, ...]


def saved_springs(path: str | Path, name: str, task: Task) -> SavedSprings:
    """The springs of a configuration of a study's summary.json, which was made for the task.

    Raises `UserError` where it is no such file, has no such configuration, or was made for a task with other springs.
    """
    designs = read_json(path, SavedStudy).configurations
    check_names([name], designs, path, "configuration")
    saved = designs[name]
    for way in arrangements(task, name.rstrip("*")):
        effects = {task.model().label(s.effect): s.effect for s in way}
        if saved.choice is not None:
            effects = {label: e for label, e in effects.items() if label in saved.mounted}
        if saved.mounted == {label: mounting(effect) for label, effect in effects.items()}:
            lacking = [
                f"{label}: {p.name}"
                for label, e in effects.items()
                for p in e.parameters
                if p.name not in saved.parameters.get(label, {})
            ]
            if lacking:
                raise UserError(
                    f"{path}: configurations.{name}.parameters: {lacking[0]} is missing; one value a parameter is required"
                )
            mounted = tuple(
                (e, {p.name: saved.parameters[label][p.name] for p in e.parameters}) for label, e in effects.items()
            )
            return SavedSprings(mounted, tuple(label for label in saved.parameters if label not in effects))
    found = ", ".join(saved.mounted) or "none"
    raise UserError(f"{path}: configuration {name} has the springs {found}, which task {task.name!r} does not offer so mounted")


def drawn_bounds(springs: Sequence[SpringBounds]) -> tuple[np.ndarray, np.ndarray]:
    """Bounds of the numbers that a search draws for springs: the hardware where parameters are functions of it and it is free, else
    the effect's own parameters."""
    pairs = [np.array([*s.hardware.values()]).T if s.hardware else np.array([s.lower, s.upper]) for s in springs]
    lower, upper = np.concatenate([np.zeros((2, 0)), *pairs], axis=1)
    return lower, upper


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


def spring_schema(kind: type[DesignSpring]) -> Any:
    """The structure of a spring's entry in a task."""
    form, pair = kind.design, kind.placement == "pair"
    keys: list[Any] = [("effect", Literal[kind.name]), ("joints", tuple[str, str]) if pair else ("joint", str)]
    keys += [(key, Interval) for key in dict.fromkeys(q.key for q in form.quantities)]
    keys += [(key, list[tuple[(float,) * len(columns)]]) for key, columns in form.tables.items()]
    for key, allowed in kind.options.items():
        default, one = getattr(kind, key), Literal[allowed]
        values: Any = tuple[(one,) * len(default)] if isinstance(default, tuple) else one
        keys.append((key, values | None, None))
    return msgspec.defstruct(f"{kind.__name__}Bounds", keys, bases=(Schema,))


def _spring(task: Task, kind: type[DesignSpring], given: Any) -> SpringBounds:
    where, form = f"task {task.name!r}: {kind.name}", kind.design
    names = _joints(kind, given)
    if len(set(names)) < len(names):
        raise UserError(f"{where}: joints: found {', '.join(names)}; two different joints are required")
    locked = [joint for joint in names if task.robot.index(joint) not in task.moving]
    if locked:
        raise UserError(f"{where}: {locked[0]} does not move in this task; moving are {', '.join(task.joints)}")
    options = {key: value for key in kind.options if (value := getattr(given, key)) is not None}
    options |= {key: tuple(getattr(given, key)) for key in form.tables}
    try:
        effect = kind(tuple(task.robot.index(joint) for joint in names), **options)
    except UserError as error:
        raise UserError(f"{where}: {error}") from None
    bounds = {q.symbol: _bounds(where, q.key, getattr(given, q.key), q.unit) for q in form.quantities}
    if (wrong := form.wrong(bounds)) is not None:
        raise UserError(f"{where}: {wrong}")
    return SpringBounds(effect, *form.box(bounds), bounds if form.derived else {})


def _bounds(where: str, key: str, given: Interval, unit: float) -> tuple[float, float]:
    try:
        check_interval(key, given)
    except ValueError as error:
        raise UserError(f"{where}: {str(error).removeprefix(f'{key}: ').replace('bounds', f'bounds of {key}')}") from None
    return given[0] * unit, given[1] * unit
