"""Purchasable hardware: the best springs and pulleys of a catalogue, searched over all of it, the rest re-optimised."""

import importlib.resources
import itertools
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import joblib
import numpy as np

from rrr_oc.codesign import CoDesign
from rrr_oc.effects.biarticular_spring import reduced
from rrr_oc.errors import UserError
from rrr_oc.parameters import check_names
from rrr_oc.search import Optimum, SearchOptions, continued, transcribed
from rrr_oc.solve import Options, Solution, Solver, SolverFailure


@dataclass(frozen=True)
class Catalogue:
    """What can be bought.

    Attributes:
        name: Where it is from.
        parallel: Stiffnesses by joint name [Nm/rad].
        biarticular: Lists of k_b [Nm/rad], r_1, r_2, r_3 [m] (cable included).
    """

    name: str
    parallel: Mapping[str, tuple[float, ...]]
    biarticular: Mapping[str, tuple[float, ...]]


def load_catalogue(source: str | Path = "prototype") -> Catalogue:
    """The bundled catalogue of the prototype, or a JSON file of the same form; raises `UserError`."""
    if str(source) == "prototype":
        text, where = importlib.resources.files("rrr_oc.data").joinpath("catalogue.json").read_text(), "catalogue 'prototype'"
    elif Path(source).is_file():
        text, where = Path(source).read_text(), str(source)
    else:
        raise UserError(f"no catalogue at {str(source)!r}; give a JSON file or 'prototype'")
    try:
        content = json.loads(text)
    except json.JSONDecodeError as error:
        raise UserError(f"{where}: not valid JSON: {error}") from None
    if not isinstance(content, dict) or content.get("format") != "rrr_oc-catalogue/1":
        raise UserError(f'{where}: expected an object with "format": "rrr_oc-catalogue/1"')
    check_names(content, ("format", "name", "parallel_springs_Nm_per_rad", "biarticular_spring"), where)
    pulleys = content.get("biarticular_spring", {})
    check_names(pulleys, ("k_b_Nm_per_rad", "r_1_mm", "r_2_mm", "r_3_mm"), f"{where}: biarticular_spring")
    parallel = {j: _list(where, j, v, 1.0) for j, v in content.get("parallel_springs_Nm_per_rad", {}).items()}
    units = {"k_b": ("k_b_Nm_per_rad", 1.0), "r_1": ("r_1_mm", 1e-3), "r_2": ("r_2_mm", 1e-3), "r_3": ("r_3_mm", 1e-3)}
    biarticular = {h: _list(where, key, pulleys[key], unit) for h, (key, unit) in units.items()} if pulleys else {}
    return Catalogue(str(content.get("name", source)), parallel, biarticular)


def _list(where: str, key: str, values: object, unit: float) -> tuple[float, ...]:
    if not isinstance(values, list) or not values or not all(isinstance(v, int | float) and v > 0 for v in values):
        raise UserError(f"{where}: {key} must be a list of numbers above 0, got {values!r}")
    return tuple(sorted({float(v) * unit for v in values}))


@dataclass(frozen=True)
class Coverage:
    """How much of the catalogue was searched, and what that says.

    Attributes:
        combinations: In the catalogue.
        distinct: Of those, that differ in what the arm feels (kappa, rho, stiffnesses).
        solved: Co-design problems solved with the hardware held.
        relaxed: Problems solved to bound those that were not.
        failed: Of all, that IPOPT did not solve.
        excluded: Distinct combinations ruled out because their relaxed optimum already costs more than the best.
    """

    combinations: int
    distinct: int
    solved: int
    relaxed: int
    failed: int
    excluded: int


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
    progress: Callable[[int, int], None] | None = None,
    finalists: int = 6,
) -> CatalogueResult:
    """The best purchasable hardware, near the continuous optimum `start`, everything else re-optimised for each choice.

    Parallel springs alone, or a biarticular spring alone: every distinct choice is solved. Both together: each distinct
    (kappa, rho) is solved with the parallel stiffnesses free, which bounds from below what any catalogued ones can give;
    in the order of these bounds the parallel springs are enumerated, until the bound is above the best found. The bound
    holds as far as the local optima followed do.
    """
    options = options or SearchOptions()
    springs, combinations = _choices(design, catalogue)
    bar = next((i for i, s in enumerate(design.springs) if s.hardware), None)
    parallel = [i for i, s in enumerate(design.springs) if not s.hardware]
    run = _Runner(design, start, options, progress)
    counts = {"solved": 0, "relaxed": 0, "excluded": 0}
    if bar is None or not parallel:
        choices = [_merge(design, c) for c in itertools.product(*springs)]
        ranked = run.all(choices)
        counts["solved"], distinct = len(choices), len(choices)
    else:
        relaxed = run.all([_merge(design, [None] * bar + [c]) for c in springs[bar]])
        others = list(itertools.product(*[springs[i] for i in parallel]))
        distinct, counts["relaxed"], ranked = len(springs[bar]) * len(others), len(relaxed), []
        for position, (bound, choice) in enumerate(relaxed):
            if ranked and bound > ranked[min(finalists, len(ranked)) - 1][0]:
                counts["excluded"] = (len(relaxed) - position) * len(others)
                break
            candidates = [_merge(design, [*other, _part(design, choice, bar)]) for other in others]
            ranked = sorted(ranked + run.all(candidates), key=lambda r: r[0])
            counts["solved"] += len(candidates)
    coverage = Coverage(combinations, distinct, **counts, failed=run.failed)
    return _finish(design, start, options, [c for _, c in ranked[:finalists]], coverage)


def _choices(design: CoDesign, catalogue: Catalogue) -> tuple[list[list[_Choice]], int]:
    """For each spring its distinct choices within the task's bounds, and the number of combinations before merging."""
    lists, combinations, joints = [], 1, design.task.robot.joints
    for spring in design.springs:
        if spring.hardware:
            if not catalogue.biarticular:
                raise UserError(f"catalogue {catalogue.name!r} has no biarticular_spring")
            inside = {
                h: [v for v in values if spring.hardware[h][0] * (1 - 1e-4) <= v <= spring.hardware[h][1] * (1 + 1e-4)]
                for h, values in catalogue.biarticular.items()
            }
            distinct: dict[tuple[float, float, float], _Choice] = {}
            items = list(itertools.product(*[inside[h] for h in ("k_b", "r_1", "r_2", "r_3")]))
            for k_b, r_1, r_2, r_3 in items:
                kappa, rho, _ = reduced(k_b, 0.0, r_1, r_2, r_3)
                low, high = (q * r_1 / r_2 for q in spring.hardware["q_0"])
                key = (round(float(kappa), 9), round(float(rho), 9), 0.0)
                known = distinct.get(key)
                if known is None or high - low > known.upper[2] - known.lower[2]:  # the one that leaves phi most room
                    hardware = {"k_b": k_b, "r_1": r_1, "r_2": r_2, "r_3": r_3}
                    distinct[key] = _Choice(hardware, np.array([kappa, rho, low]), np.array([kappa, rho, high]))
            lists.append(list(distinct.values()))
            combinations *= len(items)
            continue
        number, joint = spring.effect.joints[0] + 1, joints[spring.effect.joints[0]]
        available = [k for k in catalogue.parallel.get(joint, ()) if spring.lower[0] <= k <= spring.upper[0] * (1 + 1e-4)]
        if not available:
            raise UserError(f"catalogue {catalogue.name!r} has no parallel spring for {joint} within the task's bounds")
        lists.append(
            [
                _Choice({f"k_p{number}": k}, np.array([k, spring.lower[1]]), np.array([k, spring.upper[1]]))
                for k in available
            ]
        )
        combinations *= len(available)
    return lists, combinations


def _merge(design: CoDesign, choices: Sequence[_Choice | None]) -> _Choice:
    """One choice from those of the springs; None leaves a spring free."""
    lower = [s.lower if c is None else c.lower for s, c in zip(design.springs, choices, strict=True)]
    upper = [s.upper if c is None else c.upper for s, c in zip(design.springs, choices, strict=True)]
    hardware = {k: v for c in choices if c is not None for k, v in c.hardware.items()}
    return _Choice(hardware, np.concatenate(lower), np.concatenate(upper))


def _part(design: CoDesign, choice: _Choice, spring: int) -> _Choice:
    """The part of a merged choice that belongs to one spring."""
    at = sum(len(s.lower) for s in design.springs[:spring])
    rows = slice(at, at + len(design.springs[spring].lower))
    return _Choice(choice.hardware, choice.lower[rows], choice.upper[rows])


class _Runner:
    """Solves choices on the coarse mesh from one start, in parallel."""

    def __init__(self, design: CoDesign, start: Solution, options: SearchOptions, progress) -> None:
        coarse = transcribed(design, options, options.coarse)
        self._design, self._options, self._progress = design, options, progress
        self._w = Solver(coarse, Options(barrier=1e-4)).solve(start.guess(), design.data(options.widths[0])).w
        self._done = self.failed = 0

    def all(self, choices: list[_Choice]) -> list[tuple[float, _Choice]]:
        """(cost, choice), best first."""
        chunks = [choices[i : i + 50] for i in range(0, len(choices), 50)]
        jobs = (joblib.delayed(_solve_chunk)(self._design, self._options, self._w, c) for c in chunks)
        results: list[tuple[float, _Choice]] = []
        for part in joblib.Parallel(n_jobs=self._options.jobs, return_as="generator_unordered", batch_size=1)(jobs):
            results += part
            self._done += len(part)
            if self._progress:
                self._progress(self._done, len(results))
        self.failed += sum(not np.isfinite(cost) for cost, _ in results)
        return sorted(results, key=lambda r: (r[0], sorted(r[1].hardware.items())))


_chunk_solvers: dict[bytes, Solver] = {}


def _solve_chunk(design: CoDesign, options: SearchOptions, w: np.ndarray, choices: list[_Choice]) -> list[tuple[float, _Choice]]:
    key = w.tobytes()
    if key not in _chunk_solvers:
        _chunk_solvers.clear()
        _chunk_solvers[key] = Solver(transcribed(design, options, options.coarse), Options(tolerance=1e-5, iterations=100, barrier=1e-3))
    solver, results, data = _chunk_solvers[key], [], design.data(options.widths[0])
    for choice in choices:
        try:
            cost = solver.solve(w, data, parameters=(choice.lower, choice.upper)).cost
        except SolverFailure:
            cost = float("inf")
        results.append((cost, choice))
    return results


def _finish(
    design: CoDesign, start: Solution, options: SearchOptions, choices: list[_Choice], coverage: Coverage
) -> CatalogueResult:
    """Solve the best choices on the fine mesh, and refine the best of them."""
    names = {f"q_eq{s.effect.joints[0] + 1}" for s in design.springs if not s.hardware} | {"q_0"}
    held = [design.with_fixed(c.hardware, tuple(names)) for c in choices]
    guess = start.guess()
    starts = [replace(guess, parameters=np.clip(guess.parameters, c.lower, c.upper)) for c in choices]
    found = continued(list(zip(held, starts, strict=True)), options)
    if not found:
        raise SolverFailure("no choice of the catalogue could be solved", 0, 0.0, "")
    best, optimum = found[0]
    runners_up = [{"cost": o.solution.cost, **held[i].hardware(o.solution.parameters)} for i, o in found]
    return CatalogueResult(held[best], optimum, held[best].hardware(optimum.solution.parameters), coverage, runners_up)
