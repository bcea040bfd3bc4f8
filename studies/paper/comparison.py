"""Summary of a store of runs: best and distribution of each way, processor times, rank-sum tests. Nothing is solved here."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from rrr_oc.codesign.optimum import describe
from rrr_oc.codesign.task import Speed, load_task
from studies.paper.encoding import WEIGHT, Encoding
from studies.paper.experiments import ENDS, EXPERIMENTS, candidate_motion, experiment, roles
from studies.paper.run_store import Run, all_runs
from studies.paper.statistics import compare, rank

WAYS = {
    "evolution-engine": "evolution, MuJoCo",
    "evolution-analytic": "evolution, model",
    "again-analytic": "evolution from (d)",
    "restricted": "gradient, Akima (d)",
    "multistart": "gradient, Sobol (b)",
    "cma-ipopt": "gradient, CMA-ES (c)",
}
EVOLVED = ("evolution-engine", "evolution-analytic")  # the first of these that was run stands for evolution in tables
FREE_MOTION, AKIMA = ("multistart", "cma-ipopt"), ("restricted", "again-analytic", "evolution-engine", "evolution-analytic")
PAIRS = (("PEA", "SA"), ("BPEA", "SA"), ("PEA+BPEA", "SA"), ("BPEA", "PEA"), ("PEA+BPEA", "BPEA"))
STARRED = (("PEA*", "SA"), ("BPEA*", "SA"), ("PEA+BPEA*", "SA"), ("BPEA*", "PEA*"), ("PEA+BPEA*", "BPEA*"))
CURVE = 24  # points of an anytime curve
NEAR = 1.01  # [1] times the best known cost counts as having reached it; times to it would shorten with a larger one


def summarise(store: Path, preset: str) -> dict[str, Any]:
    """Plain data on all runs of a preset: by ends, experiment and way; rank-sum tests; races; fixed motions."""
    runs = [run for run in all_runs(store) if run.asked.get("preset") == preset]
    found: dict[str, Any] = {"preset": preset}
    for ends in ENDS:
        found[ends] = {}
        for name in EXPERIMENTS:
            ways = {way: _way(preset, name, ends, way, _of(runs, name, ends, way)) for way in WAYS}
            if any(ways.values()):
                found[ends][name] = {way: entry for way, entry in ways.items() if entry}
        for entry in found[ends].values():
            _near(entry)
    found["races"] = {kind: _races(runs, kind) for kind in ("race", "race-best")}
    fixed = [run for run in runs if run.asked["way"].startswith("fixed")]
    found["fixed"] = [{k: run.asked[k] for k in ("experiment", "duration_s")} | (run.found or {}) for run in fixed]
    found["tests"] = {way: _tests(found["rest"], way) for way in EVOLVED}
    return found


def _of(runs: Iterable[Run], name: str, ends: str, way: str) -> list[Run]:
    return [r for r in runs if (r.asked["experiment"], r.asked["ends"], _way_of(r.asked)) == (name, ends, way)]


def _way_of(asked: Mapping[str, Any]) -> str:
    return asked["way"] + (f"-{asked['model']}" if "model" in asked else "")


def _way(preset: str, name: str, ends: Speed, way: str, runs: list[Run]) -> dict[str, Any] | None:
    """Summary of one way's runs of an experiment; None where there are none."""
    if not runs:
        return None
    runs = sorted(runs, key=lambda r: r.asked["seed"])
    design = experiment(load_task(preset), name, ends)
    scale = WEIGHT * design.problem.cost_scale
    results = [r.found or {} for r in runs]
    evolved = "generations" in results[0]
    E1 = [f["analytic"] + scale * f["limits_exceeded"] if evolved else f["E1"] for f in results]
    k = int(np.argmin(E1))
    best = results[k]
    entry = {
        "E1": E1,
        "best": E1[k],
        "median": float(np.median(E1)),
        "engine": best.get("engine"),
        "core_s": [f["core_s"] for f in results],
        "durations": best["durations"],
        "hardware": best["hardware"],
        "parameters": best["parameters"],
        "curve": _curve(runs, evolved, E1),
    }
    if evolved:
        encoding = Encoding(design, runs[k].asked["via"])
        motion = candidate_motion(encoding, np.array(best["x"]))
        figures = describe(design, motion.metrics())
        entry |= {key: figures[key] for key in ("E1_joint", "rms", "peak")}
        entry |= {"roles": roles(design, np.array(best["parameters"]), motion), "x": best["x"]}
        entry |= {"evaluations": [f["evaluations"] for f in results], "stopped": [f["stopped"] for f in results]}
        entry["to_its_best_core_s"] = _reached(runs[k], best["cost"] * 1.001)
        entry["own_cost"] = [f["cost"] for f in results]
        return entry
    entry |= {key: best[key] for key in ("E1_joint", "rms", "peak", "roles", "optima", "starts", "failed")}
    return entry | ({"x": best["x"]} if "x" in best else {})


def _reached(run: Run, cost: float) -> float | None:
    """Processor time until a trial's best is at most `cost` [s]; None where it never is."""
    arrays = run.arrays
    k = np.flatnonzero(arrays["best"] <= cost)
    return float(arrays["core_s"][k[0]]) if k.size else None


def _curve(runs: list[Run], evolved: bool, final: Sequence[float]) -> dict[str, list]:
    """Best cost so far against processor time [s]: least, median and largest over the runs."""
    times, values = [], []
    for run, last in zip(runs, final, strict=True):
        arrays = run.arrays
        t, v = (arrays["core_s"], arrays["best"]) if evolved else (arrays["core_s"], np.fmin.accumulate(arrays["polished"]))
        total = (run.found or {})["core_s"]
        times.append(np.r_[t, total] if not evolved else t)
        values.append(np.r_[v, last] if not evolved else v)
    grid = np.geomspace(max(min(t[0] for t in times), 1e-3), max(t[-1] for t in times), CURVE)
    rows = np.array(
        [[v[max(np.searchsorted(t, g, side="right") - 1, 0)] for g in grid] for t, v in zip(times, values, strict=True)]
    )
    rows = np.where(np.isfinite(rows), rows, 1e9)
    columns = {"core_s": grid, "least": rows.min(axis=0), "median": np.median(rows, axis=0), "largest": rows.max(axis=0)}
    return {k: [float(f"{x:.5g}") for x in v] for k, v in columns.items()}


def _near(entry: dict[str, Any]) -> None:
    """Add the best known cost of an experiment, of all ways and within the parametrisation, and when each way came within `NEAR` of it."""
    for key, ways in (("best_known", tuple(WAYS)), ("best_akima", AKIMA)):
        bests = [entry[w]["best"] for w in ways if w in entry]
        known = min(bests) if bests else None
        for way in (w for w in WAYS if w in entry):
            curve = entry[way]["curve"]
            near = [t for t, v in zip(curve["core_s"], curve["least"], strict=True) if known is not None and v <= NEAR * known]
            entry[way][f"near_{key}_core_s"] = near[0] if near else None
        if known is not None:
            entry[key] = known


def _races(runs: Iterable[Run], kind: str) -> dict[str, dict[str, Any]]:
    found: dict[str, list] = {}
    for run in runs:
        if run.asked["way"] == kind and run.asked["ends"] == "rest":
            found.setdefault(run.asked["experiment"], []).append((run.asked["target"], run.found))
    return {name: _race(*zip(*races, strict=True)) for name, races in found.items()}


def _race(targets: Sequence[float], results: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Races of one experiment; `core_s` is the median over all of them, None where half or more did not reach the target."""
    times = [f["core_s"] for f in results if f["reached"] is not None]
    median = float(np.median([*times, *[np.inf] * (len(results) - len(times))]))
    return {
        "target": targets[0],
        "races": len(results),
        "won": len(times),
        "core_s": median if np.isfinite(median) else None,
        "starts": [f["starts"] for f in results],
        "reached": [f["reached"] for f in results],
    }


def _tests(experiments: Mapping[str, Any], way: str) -> dict[str, Any] | None:
    costs = {name: entry[way]["E1"] for name, entry in experiments.items() if way in entry and len(entry[way]["E1"]) > 1}
    pairs = [pair for pair in (*PAIRS, *STARRED) if all(name in costs for name in pair)]
    if not pairs:
        return None
    four = {name: costs[name] for name in EXPERIMENTS[:4] if name in costs}
    return {
        "trials": {name: len(values) for name, values in costs.items()},
        "pairs": [asdict(c) for c in compare(costs, pairs)],
        "ranking": asdict(rank(four)) if len(four) > 1 else None,
    }


def evolved_of(entry: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """The evolutionary trials of an experiment: in the engine, or where there are none, in the model."""
    return next((entry[way] for way in EVOLVED if way in entry), None)


def best_of(entry: Mapping[str, Any], ways: Sequence[str]) -> Mapping[str, Any] | None:
    """The cheapest of some ways of an experiment; None where none of them was run."""
    known = [entry[w] for w in ways if w in entry]
    return min(known, key=lambda e: e["best"]) if known else None
