"""Purchasable hardware: the best springs and pulleys of a catalogue, searched over all of it, the rest re-optimised."""

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import Meta, field
from scipy.interpolate import RegularGridInterpolator

from rrr_oc.codesign.design_problem import CoDesign, SpringBounds
from rrr_oc.codesign.multistart import Optimum, SearchOptions, continued, transcribed
from rrr_oc.effects import design_forms
from rrr_oc.effects.design_form import DesignForm
from rrr_oc.errors import UserError
from rrr_oc.optimal_control.solver import Options, Solution, Solver, SolverFailure
from rrr_oc.parallel import unordered
from rrr_oc.schema import Positive, Schema, Text, check_names, read_preset

METHODS = ("exhaustive", "screened")


@dataclass(frozen=True)
class Catalogue:
    """What can be bought.

    Attributes:
        name: Where it is from.
        lists: By label of the springs' design form, values in SI units: by joint name where one quantity is bought, else by the
            quantity's symbol (pulleys with their cable included).
    """

    name: str
    lists: Mapping[str, Mapping[str, tuple[float, ...]]]


Sizes = Annotated[list[Positive], Meta(min_length=1)]


def load_catalogue(source: str | Path = "prototype") -> Catalogue:
    """The bundled catalogue of the prototype, or a JSON file of the same form; raises `UserError`."""
    forms = {label: kind.design for label, kind in design_forms().items() if kind.design is not None and kind.design.shop}
    keys: list[Any] = [("format", Literal["rrr_oc-catalogue/1"]), ("name", Text | None, None)]
    keys += [(form.shop, dict[str, Sizes], field(default_factory=dict)) for form in forms.values()]
    schema = msgspec.defstruct("CatalogueFile", keys, bases=(Schema,))
    where, given = read_preset("catalogue", source, {"prototype": "catalogue.json"}, schema)
    lists = {label: _lists(f"{where}: {form.shop}", form, getattr(given, form.shop)) for label, form in forms.items()}
    return Catalogue(given.name or str(source), lists)


def _lists(where: str, form: DesignForm, given: Mapping[str, Sequence[float]]) -> dict[str, tuple[float, ...]]:
    """What can be bought of one kind of spring, as `Catalogue.lists` holds it."""
    if len(form.bought) == 1:
        names = {joint: (joint, form.bought[0].unit) for joint in given}
    else:
        names = {q.symbol: (q.key, q.unit) for q in form.bought}
        check_names(given, [key for key, _ in names.values()], where)
        missing = [key for key, _ in names.values() if key not in given]
        if given and missing:
            raise UserError(f"{where}: key {missing[0]!r} is missing; required are {', '.join(q.key for q in form.bought)}")
    return {name: tuple(sorted({size * unit for size in given[key]})) for name, (key, unit) in names.items() if given}


@dataclass(frozen=True)
class Coverage:
    """How much of the catalogue was searched, and what that says.

    Attributes:
        combinations: In the catalogue.
        distinct: Of those, that differ in what the arm feels (kappa, rho, stiffnesses).
        solved: Of those, solved with the hardware held.
        complete: Whether that is every one of them.
        neighbours: Whether of the parallel springs only those were solved whose stiffness lies next to the optimal one of
            their biarticular spring. That the best is among them is likely, as the cost is smooth, and not certain.
        relaxed: Problems solved with parallel stiffnesses free, or off the catalogue, to screen the rest.
        margin: By how much the screening value (interpolated) of the best biarticular spring that was left out exceeds the
            best cost, relative; infinite where none was left out.
        failed: Problems that IPOPT did not solve.
    """

    combinations: int
    distinct: int
    solved: int
    complete: bool
    neighbours: bool
    relaxed: int
    margin: float
    failed: int


@dataclass(frozen=True, eq=False)
class CatalogueResult:
    """The best of a catalogue.

    Attributes:
        design: The problem with the best hardware held and the rest free.
        optimum: Its optimum.
        hardware: What to buy, SI units.
        coverage: What was searched.
        runners_up: Costs of the next best on the fine mesh, with their hardware.
    """

    design: CoDesign
    optimum: Optimum
    hardware: dict[str, float]
    coverage: Coverage
    runners_up: list[dict]


@dataclass(frozen=True)
class _Choice:
    """One distinct thing to buy: hardware of some springs, and the bounds that hold the parameters to it."""

    hardware: dict[str, float]
    lower: np.ndarray
    upper: np.ndarray


def search_catalogue(
    design: CoDesign,
    start: Solution,
    catalogue: Catalogue,
    options: SearchOptions | None = None,
    method: str = "exhaustive",
    progress: Callable[[int], None] | None = None,
    finalists: int = 6,
) -> CatalogueResult:
    """The best purchasable hardware, near the continuous optimum `start`, everything else re-optimised for each choice.

    Parallel springs alone: every choice is solved. A biarticular spring alone: every distinct (kappa, rho) is solved
    (`method="exhaustive"`: by Hermite–Simpson on 10 intervals, the best 200 again on the coarse mesh), or all are screened
    and the best solved (`method="screened"`, see `_screened`), as they always are for both kinds together.
    """
    if method not in METHODS:
        raise UserError(f"unknown catalogue search {method!r}; there are {', '.join(METHODS)}")
    if any(s.known for s in design.springs):
        raise UserError("the catalogue's search takes a task as it stands; effects known from a diagnosis are not supported")
    options = options or SearchOptions()
    springs, combinations = _choices(design, catalogue)
    bar = next((i for i, s in enumerate(design.springs) if s.hardware), None)
    distinct = int(np.prod([len(s) for s in springs]))
    run, counts = _Runner(design, start, options, progress), {"relaxed": 0, "margin": float("inf")}
    if bar is not None and (len(springs) > 1 or method == "screened"):
        ranked, counts = _screened(design, run, springs, bar, finalists)
    else:
        choices = [_merge(design, c) for c in itertools.product(*springs)]
        if bar is not None:
            rough = _Runner(design, start, replace(options, scheme="hermite-simpson", coarse=10), progress)
            choices = [choice for _, choice, _ in rough.all(choices)[:200]]
            run.solved, run.failed = rough.solved - len(choices), rough.failed
        ranked = [(cost, choice) for cost, choice, _ in run.all(choices)]
    solved, neighbours = run.solved - counts["relaxed"], bar is not None and len(springs) > 1
    complete = solved == distinct and not run.failed
    coverage = Coverage(combinations, distinct, solved, complete, neighbours and not complete, **counts, failed=run.failed)
    return _finish(design, start, options, [c for _, c in ranked[:finalists]], coverage)


def _screened(
    design: CoDesign,
    run: "_Runner",
    springs: list[list["_Choice"]],
    bar: int,
    finalists: int,
    grid: int = 12,
    margin: float = 0.02,
) -> tuple[list[tuple[float, "_Choice"]], dict]:
    """The catalogue's best by screening, for a biarticular spring with or without parallel ones.

    With the parallel stiffnesses free, the optimal cost is a smooth function of (kappa, rho), below what any catalogued
    parallel springs can give. It is solved on a grid and interpolated for every catalogued (kappa, rho). In the order of
    these values each is solved itself, then with the catalogued stiffnesses next to its optimal ones, until the next
    value lies more than `margin` above the best cost found.
    """
    kinds = springs[bar]
    reach = np.array([[c.lower[0], c.lower[1]] for c in kinds])
    values, relaxed = np.full(len(kinds), -np.inf), 0  # so few that all are solved
    if len(kinds) > grid**2:
        axes = np.geomspace(*_range(reach[:, 0]), grid), np.linspace(*_range(reach[:, 1]), grid)
        low, high = np.min([c.lower for c in kinds], axis=0)[2], np.max([c.upper for c in kinds], axis=0)[2]
        nodes = [_Choice({}, np.array([k, r, low]), np.array([k, r, high])) for k in axes[0] for r in axes[1]]
        solved = {
            (c.lower[_at(design, bar)], c.lower[_at(design, bar) + 1]): cost
            for cost, c, _ in run.all([_alone(design, c, bar) for c in nodes])
        }
        table = np.array([[solved[k, r] for r in axes[1]] for k in axes[0]])
        table = np.where(np.isfinite(table), table, np.nanmax(np.where(np.isfinite(table), table, np.nan)))
        values = RegularGridInterpolator((np.log(axes[0]), axes[1]), np.log(table), method="cubic")(
            np.c_[np.log(reach[:, 0]), reach[:, 1]]
        )
        relaxed = len(nodes)
    order = np.argsort(values, kind="stable")
    ranked: list[tuple[float, _Choice]] = []
    for position in range(0, len(order), 64):
        value = float(np.exp(values[order[position]]))
        if ranked and value > ranked[0][0] * (1 + margin):
            return ranked, {"relaxed": relaxed, "margin": value / ranked[0][0] - 1}
        batch = run.all([_alone(design, kinds[i], bar) for i in order[position : position + 64]])
        if len(springs) == 1:
            ranked = sorted([*ranked, *[(cost, c) for cost, c, _ in batch]], key=lambda r: r[0])
            continue
        relaxed += len(batch)
        limit = ranked[min(finalists, len(ranked)) - 1][0] if ranked else float("inf")
        near = [c for cost, choice, p in batch if cost < limit for c in _neighbours(design, springs, bar, choice, p)]
        ranked = sorted([*ranked, *[(cost, c) for cost, c, _ in run.all(near)]], key=lambda r: r[0])
    return ranked, {"relaxed": relaxed, "margin": float("inf")}


def _range(values: np.ndarray) -> tuple[float, float]:
    return float(values.min()), float(values.max())


def _at(design: CoDesign, spring: int) -> int:
    """Where a spring's parameters begin."""
    return sum(len(s.lower) for s in design.springs[:spring])


def _alone(design: CoDesign, choice: "_Choice", spring: int) -> "_Choice":
    """A choice for one spring, the others free."""
    return _merge(design, [choice if i == spring else None for i in range(len(design.springs))])


def _neighbours(design: CoDesign, springs, bar: int, choice: "_Choice", parameters: np.ndarray) -> list["_Choice"]:
    """The choice with the catalogued stiffnesses next below and above the optimal ones of each parallel spring."""
    lists = []
    for i, kinds in enumerate(springs):
        at = _at(design, i)
        if i == bar:
            rows = slice(at, at + 3)
            lists.append([_Choice(choice.hardware, choice.lower[rows], choice.upper[rows])])
            continue
        stiffness = np.array([c.lower[0] for c in kinds])
        above = int(np.searchsorted(stiffness, parameters[at]))
        lists.append([kinds[k] for k in sorted({max(above - 1, 0), min(above, len(kinds) - 1)})])
    return [_merge(design, c) for c in itertools.product(*lists)]


def _choices(design: CoDesign, catalogue: Catalogue) -> tuple[list[list[_Choice]], int]:
    """For each spring its distinct choices within the task's bounds, and the number of combinations before merging."""
    lists, combinations = [], 1
    for spring in design.springs:
        distinct, count = _distinct(spring, _inside(design, spring, catalogue))
        lists.append(distinct)
        combinations *= count
    return lists, combinations


def _inside(design: CoDesign, spring: SpringBounds, catalogue: Catalogue) -> dict[str, list[float]]:
    """What the catalogue has of each quantity of a spring within the task's bounds, by the name that a designer uses."""
    form, joints = spring.form, [design.task.robot.joints[j] for j in spring.effect.joints]
    lists = catalogue.lists.get(form.label, {})
    what = f"catalogue {catalogue.name!r} has no {spring.effect.name.replace('_', ' ')} for {' and '.join(joints)}"
    inside = {}
    for i, q in enumerate(form.quantities):
        if q.free:
            continue
        low, high = spring.hardware[q.symbol] if form.derived else (spring.lower[i], spring.upper[i])
        values = lists.get(joints[0] if len(form.bought) == 1 else q.symbol, ())
        found = [v for v in values if low * (1 - 1e-4) <= v <= high * (1 + 1e-4)]
        if not found:
            raise UserError(f"{what} within the task's bounds: no {q.symbol} of {low:g} … {high:g}" if lists else what)
        inside[form.name(q, spring.effect.joints)] = found
    return inside


def _distinct(spring: SpringBounds, inside: Mapping[str, Sequence[float]]) -> tuple[list[_Choice], int]:
    """The combinations that differ in what the arm feels, and the number of all; of equals the one that leaves most room."""
    form, joints, distinct = spring.form, spring.effect.joints, {}
    items = list(itertools.product(*inside.values()))
    for values in items:
        hardware = dict(zip(inside, values, strict=True))
        box = spring.lower, spring.upper
        lower, upper, _ = form.held(joints, box, spring.hardware, hardware, form.free_names(joints))
        key = tuple(np.round(np.where(lower == upper, lower, 0.0), 9))
        known = distinct.get(key)
        if known is None or np.sum(upper - lower) > np.sum(known.upper - known.lower):
            distinct[key] = _Choice(hardware, lower, upper)
    return list(distinct.values()), len(items)


def _merge(design: CoDesign, choices: Sequence[_Choice | None]) -> _Choice:
    """One choice from those of the springs; None leaves a spring free."""
    lower = [s.lower if c is None else c.lower for s, c in zip(design.springs, choices, strict=True)]
    upper = [s.upper if c is None else c.upper for s, c in zip(design.springs, choices, strict=True)]
    hardware = {k: v for c in choices if c is not None for k, v in c.hardware.items()}
    return _Choice(hardware, np.concatenate(lower), np.concatenate(upper))


class _Runner:
    """Solves choices on the coarse mesh from one start, in parallel."""

    def __init__(self, design: CoDesign, start: Solution, options: SearchOptions, progress) -> None:
        coarse = transcribed(design, options, options.coarse)
        self._design, self._options, self._progress = design, options, progress
        self._w = Solver(coarse, Options(barrier=1e-4)).solve(start.guess(), design.data(options.widths[0])).w
        self.solved = self.failed = 0

    def all(self, choices: list[_Choice]) -> list[tuple[float, _Choice, np.ndarray]]:
        """(cost, choice, parameters), best first. Neighbours are solved in turn, each started from the one before."""
        ordered = sorted(choices, key=lambda c: c.lower.tolist())
        chunks = [ordered[i : i + 40] for i in range(0, len(ordered), 40)]
        arguments = [(self._design, self._options, self._w, c) for c in chunks]
        results: list[tuple[float, _Choice, np.ndarray]] = []
        for part in unordered(_solve_chunk, arguments, self._options.jobs):
            results += part
            self.solved += len(part)
            if self._progress:
                self._progress(self.solved)
        self.failed += sum(not np.isfinite(r[0]) for r in results)
        return sorted(results, key=lambda r: (r[0], r[1].lower.tolist()))


_chunk_solvers: dict[bytes, Solver] = {}


def _solve_chunk(design: CoDesign, options: SearchOptions, w: np.ndarray, choices: list[_Choice]):
    key = w.tobytes()
    if key not in _chunk_solvers:
        _chunk_solvers.clear()
        settings = Options(tolerance=1e-5, iterations=100, barrier=1e-4)
        _chunk_solvers[key] = Solver(transcribed(design, options, options.coarse), settings)
    solver, results, data = _chunk_solvers[key], [], design.data(options.widths[0])
    start: np.ndarray | Solution = w
    for choice in choices:
        bounds = choice.lower, choice.upper
        solution = solver.solve(start, data, check=False, parameters=bounds)
        if solution.status not in ("Solve_Succeeded", "Solved_To_Acceptable_Level"):
            solution = solver.solve(w, data, check=False, parameters=bounds)
        lost = solution.status not in ("Solve_Succeeded", "Solved_To_Acceptable_Level")
        start = w if lost else solution
        results.append((float("inf") if lost else solution.cost, choice, solution.parameters))
    return results


def _finish(
    design: CoDesign, start: Solution, options: SearchOptions, choices: list[_Choice], coverage: Coverage
) -> CatalogueResult:
    """Solve the best choices on the fine mesh, and refine the best of them."""
    names = [name for s in design.springs for name in s.form.free_names(s.effect.joints)]
    held = [design.with_fixed(c.hardware, names) for c in choices]
    guess = start.guess()
    starts = [replace(guess, parameters=np.clip(guess.parameters, c.lower, c.upper)) for c in choices]
    found = continued(list(zip(held, starts, strict=True)), options)
    if not found:
        raise SolverFailure("no choice of the catalogue could be solved", 0, 0.0, "")
    best, optimum = found[0]
    runners_up = [{"cost": o.solution.cost, **held[i].hardware(o.solution.parameters)} for i, o in found]
    return CatalogueResult(held[best], optimum, held[best].hardware(optimum.solution.parameters), coverage, runners_up)
