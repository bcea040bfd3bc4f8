"""What a store of runs says: each way's best and distribution, its cost in processor time, tests, tables beside the paper's.

All is made from the runs' files alone; nothing is solved.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from rrr_oc.codesign.optimum import describe
from rrr_oc.codesign.task import PHASES, load_task
from rrr_oc.model.metrics import decrease
from rrr_oc.paper.encoding import WEIGHT, Encoding
from rrr_oc.paper.experiments import ENDS, EXPERIMENTS, candidate_motion, experiment, roles
from rrr_oc.paper.run_store import Run, all_runs
from rrr_oc.paper.statistics import compare, rank
from rrr_oc.report.design_report import markdown, published

WAYS = {
    "evolution-engine": "evolution, MuJoCo",
    "evolution-analytic": "evolution, model",
    "again-analytic": "evolution from (d)",
    "restricted": "gradient, Akima (d)",
    "multistart": "gradient, Sobol (b)",
    "cma-ipopt": "gradient, CMA-ES (c)",
}
EVOLVED = ("evolution-engine", "evolution-analytic")  # the first that there is stands for evolution
FREE_MOTION, AKIMA = ("multistart", "cma-ipopt"), ("restricted", "again-analytic", "evolution-engine", "evolution-analytic")
PAIRS = (("PEA", "SA"), ("BPEA", "SA"), ("PEA+BPEA", "SA"), ("BPEA", "PEA"), ("PEA+BPEA", "BPEA"))
STARRED = (("PEA*", "SA"), ("BPEA*", "SA"), ("PEA+BPEA*", "SA"), ("BPEA*", "PEA*"), ("PEA+BPEA*", "BPEA*"))
CURVE = 24  # points of an anytime curve
NEAR = 1.01  # of the best known


def summarise(store: Path, preset: str) -> dict[str, Any]:
    """Plain data of everything in a store that belongs to a preset: by ends, experiment and way; tests; races; fixed motions."""
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


def _way(preset: str, name: str, ends: str, way: str, runs: list[Run]) -> dict[str, Any] | None:
    """One way's runs of an experiment."""
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
    """Processor time until a trial's best is no more than `cost` [s]; None where it never is."""
    arrays = run.arrays
    k = np.flatnonzero(arrays["best"] <= cost)
    return float(arrays["core_s"][k[0]]) if k.size else None


def _curve(runs: list[Run], evolved: bool, final: Sequence[float]) -> dict[str, list]:
    """Best so far against processor time: least, median and largest over the runs."""
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
    """Best known of an experiment, of all ways and within the parametrisation; and when each way's median came within 1 % of each."""
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
    rows = {}
    for name, races in found.items():
        won = [f["core_s"] for _, f in races if f["reached"] is not None]
        rows[name] = {
            "target": races[0][0],
            "races": len(races),
            "won": len(won),
            "core_s": float(np.median([f["core_s"] if f["reached"] is not None else np.inf for _, f in races]))
            if won
            else None,
            "starts": [f["starts"] for _, f in races],
            "reached": [f["reached"] for _, f in races],
        }
        rows[name]["core_s"] = rows[name]["core_s"] if rows[name]["core_s"] not in (None, np.inf) else None
    return rows


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


# --- tables ---


def tables(summary: Mapping[str, Any]) -> str:
    """Everything in Markdown."""
    rest = summary["rest"]
    parts = [
        f"# Gradient against evolution, preset `{summary['preset']}`\n",
        "## Best and distribution of E1 [N²m²s]\n",
        _bests(rest),
    ]
    if summary["free"]:
        parts += ["\nThe same without rest at the ends of a phase, as in the authors' code:\n", _bests(summary["free"])]
    parts += ["\n## Processor time [s]\n", _efforts(summary), "\n## Tests over the trials\n", *_test_tables(summary)]
    parts += ["\n## Table 3: relative decrease against stiff actuation [%], evolution | gradient | paper\n", _table_3(rest)]
    parts.append("Evolution in MuJoCo; of experiments without trials there, in the model.\n")
    parts += ["\n## Table 4: hardware and durations, evolution | gradient | paper\n", _table_4(rest)]
    if summary["fixed"]:
        parts += ["\n## Springs alone, on a straight motion of minimum jerk\n", _fixed(summary["fixed"])]
    parts += ["\n## The paper's conclusions\n", *(f"- {sentence}" for sentence in conclusions(summary))]
    if summary.get("transfer"):
        parts += ["\n## Transfer to the concealed plant\n", transfer_tables(summary["transfer"])]
    return "\n".join(parts) + "\n"


def _bests(experiments: Mapping[str, Any]) -> str:
    rows = []
    for name, entry in experiments.items():
        row = [name]
        for way in WAYS:
            if way not in entry:
                row.append("")
                continue
            values = entry[way]["E1"]
            spread = f" ({np.median(values):.2f}; {max(values):.2f}; n = {len(values)})" if len(values) > 1 else ""
            row.append(f"{entry[way]['best']:.3f}{spread}")
        rows.append(row)
    return markdown(["best (median; worst of n)", *WAYS.values()], rows)


def _efforts(summary: Mapping[str, Any]) -> str:
    header = [
        "",
        "evolution's best",
        "to it: trial",
        "to it: all trials",
        "gradient to it",
        "ratio: trial",
        "ratio: all",
        "within 1 % of the best known",
    ]
    rows = []
    for name, entry in summary["rest"].items():
        if "evolution-engine" not in entry:
            continue
        evolved, race = entry["evolution-engine"], summary["races"]["race"].get(name)
        best = summary["races"]["race-best"].get(name)
        total, reached = sum(evolved["core_s"]), evolved["to_its_best_core_s"]
        quick = race["core_s"] if race else None
        near = "" if not best else (f"{best['core_s']:.2f}" if best["core_s"] else f"not in {max(best['starts'])} starts")
        ratios = [f"{t / quick:.0f}" if quick and t else "" for t in (reached, total)]
        rows.append(
            [
                name,
                f"{evolved['best']:.2f}",
                f"{reached:.0f}" if reached else "",
                f"{total:.0f}",
                f"{quick:.2f}" if quick else "–",
                *ratios,
                near,
            ]
        )
    return markdown(header, rows)


def _test_tables(summary: Mapping[str, Any]) -> list[str]:
    parts = []
    for way, tests in summary["tests"].items():
        if not tests:
            continue
        rows = [
            [
                f"{t['better']} below {t['worse']}",
                f"{tests['trials'][t['better']]}, {tests['trials'][t['worse']]}",
                f"{t['p']:.2g}",
                f"{t['p_holm']:.2g}",
                f"{t['p_paper']:.2g}",
                f"{t['delta']:+.2f}",
                f"{t['ratio']:.3f}",
            ]
            for t in tests["pairs"]
        ]
        header = ["", "trials", "p", "p (Holm)", "p as the paper's", "Cliff's δ", "ratio of medians"]
        parts += [f"\n{WAYS[way]}:\n", markdown(header, rows)]
        ranking = tests["ranking"]
        if ranking:
            parts.append(
                f"Ranking by medians: {' < '.join(ranking['order'])}; it stands in {100 * ranking['by_median']:.1f} % of the bootstrap "
                f"resamples by medians, in {100 * ranking['by_best']:.1f} % by the best trials.\n"
            )
    return parts


def _three(entry: Mapping[str, Any], read: Callable[[Mapping[str, Any]], float], paper: str, digits: int = 1) -> str:
    """Evolution | gradient | paper."""
    ours = [f"{read(e):.{digits}f}" if e else "–" for e in (evolved_of(entry), _best_of(entry, FREE_MOTION))]
    return " \\| ".join([*ours, paper])


def evolved_of(entry: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """The evolutionary trials of an experiment: in the engine, or where there are none, in the model."""
    return next((entry[way] for way in EVOLVED if way in entry), None)


def _best_of(entry: Mapping[str, Any], ways: Sequence[str]) -> Mapping[str, Any] | None:
    known = [entry[w] for w in ways if w in entry]
    return min(known, key=lambda e: e["best"]) if known else None


def _table_3(rest: Mapping[str, Any]) -> str:
    if "SA" not in rest:
        return ""
    theirs, rows = published()["decrease_percent"], []
    joints = list((_best_of(rest["SA"], tuple(WAYS)) or {})["E1_joint"])
    for name, entry in rest.items():
        if name == "SA":
            continue
        row, paper = [name], theirs.get(name, {})
        for key, label in (("E1_joint", "E1"), ("rms", "rms"), ("peak", "peak")):
            for i, joint in enumerate(joints):
                printed = f"{paper[label][i]}" if label in paper else "–"
                row.append(_decreases(rest["SA"], entry, lambda e, k=key, j=joint: e[k][j], printed))
        row.append(_decreases(rest["SA"], entry, lambda e: e["best"], str(paper.get("E1_total", "–"))))
        rows.append(row)
    return markdown(["", *[f"{what} {j}" for what in ("E1", "RMS", "peak") for j in joints], "E1 total"], rows)


def _decreases(stiff: Mapping[str, Any], entry: Mapping[str, Any], read, paper: str) -> str:
    cells = []
    for of in (evolved_of, lambda e: _best_of(e, FREE_MOTION)):
        a, b = of(entry), of(stiff)
        cells.append("–" if a is None or b is None else f"{100 * decrease(read(a), read(b)):.0f}")
    return " \\| ".join([*cells, paper])


def _table_4(rest: Mapping[str, Any]) -> str:
    names = ("k_p2", "q_eq2", "k_p3", "q_eq3", "k_b", "q_0", "r_1", "r_2", "r_3")
    unit = {
        n: ("_deg", 180 / np.pi, "°")
        if n.startswith("q_")
        else ("_mm", 1e3, "mm")
        if n.startswith("r_")
        else ("", 1.0, "Nm/rad")
        for n in names
    }
    theirs, rows = published()["springs"], []
    for name, entry in rest.items():
        paper, row = theirs.get(name, {}), [name]
        known = _best_of(entry, tuple(WAYS)) or {}
        for key in names:
            suffix, factor, _ = unit[key]
            printed = f"{paper[key + suffix]:.4g}" if key + suffix in paper else "–"
            row.append(
                _three(entry, lambda e, k=key, f=factor: e["hardware"][k] * f, printed, 2) if key in known["hardware"] else "–"
            )
        for i, phase in enumerate(PHASES):
            printed = f"{paper[f't_{phase}']:.2f}" if f"t_{phase}" in paper else "–"
            row.append(_three(entry, lambda e, i=i: e["durations"][i], printed, 2))
        rows.append(row)
    return markdown(["", *[f"{n} [{unit[n][2]}]" for n in names], *[f"t_{p} [s]" for p in PHASES]], rows)


def _fixed(fixed: Sequence[Mapping[str, Any]]) -> str:
    times = sorted({f["duration_s"] for f in fixed})
    rows = []
    for name in dict.fromkeys(f["experiment"] for f in fixed):
        row = [name]
        for duration in times:
            E1 = {f["experiment"]: f["E1"] for f in fixed if f["duration_s"] == duration}
            row.append(f"{E1[name]:.1f}" + ("" if name == "SA" else f" ({100 * decrease(E1[name], E1['SA']):.1f} %)"))
        rows.append(row)
    return markdown(["E1 [N²m²s] (decrease)", *[f"{t:g} s a phase" for t in times]], rows)


def conclusions(summary: Mapping[str, Any]) -> list[str]:
    """In words, with numbers, which of the paper's conclusions stand here."""
    rest = summary["rest"]
    best = {n: e for n in EXPERIMENTS[:4] if n in rest and (e := _best_of(rest[n], FREE_MOTION))}
    evolved = {n: rest[n]["evolution-engine"] for n in EXPERIMENTS[:4] if n in rest and "evolution-engine" in rest[n]}
    return [
        *_order_in_words(summary, best),
        *_trajectory_in_words(summary, best),
        *_durations_in_words(best, evolved),
        *_roles_in_words(best, evolved),
    ]


def _order_in_words(summary: Mapping[str, Any], best: Mapping[str, Any]) -> Iterable[str]:
    for better, worse in (("PEA", "SA"), ("BPEA", "PEA"), ("PEA+BPEA", "BPEA")):
        if better not in best or worse not in best:
            continue
        a, b = best[better]["best"], best[worse]["best"]
        text = f"{better} needs less than {worse}: {'stands' if a < b else 'does not stand'} for the gradient optima ({a:.2f} against {b:.2f})"
        for way in EVOLVED:
            tests: Mapping[str, Any] = summary["tests"][way] or {"pairs": []}
            for t in (t for t in tests["pairs"] if (t["better"], t["worse"]) == (better, worse)):
                sure = "significant" if t["p_holm"] < 0.05 and t["delta"] > 0 else "not significant"
                count = f"{tests['trials'][better]} and {tests['trials'][worse]}"
                text += f"; over {count} trials of {WAYS[way]} {sure} (p = {t['p_holm']:.2g} after Holm, Cliff's δ {t['delta']:+.2f})"
        yield text + "."


def _trajectory_in_words(summary: Mapping[str, Any], best: Mapping[str, Any]) -> Iterable[str]:
    fixed = {(f["experiment"], f["duration_s"]): f["E1"] for f in summary["fixed"]}
    names = ("PEA", "BPEA", "PEA+BPEA")
    if not fixed or not {"SA", *names} <= set(best):
        return
    times = sorted({T for _, T in fixed})
    T = times[len(times) // 2]
    pairs = [
        (n, 100 * decrease(fixed[n, T], fixed["SA", T]), 100 * decrease(best[n]["best"], best["SA"]["best"])) for n in names
    ]
    gains = ", ".join(f"{n} {a:.0f} % against {b:.0f} %" for n, a, b in pairs)
    order = " < ".join(sorted(names, key=lambda n: fixed[n, T]))
    yield (
        f"The trajectory decides how much springs save: on a straight motion of {T:g} s a phase, the springs alone optimised, they save "
        f"{gains} with the motion optimised too. There the order is {order}."
    )


def _durations_in_words(best: Mapping[str, Any], evolved: Mapping[str, Any]) -> Iterable[str]:
    for words, entries in (("gradient optima", best), ("best evolutionary trials", evolved)):
        spans = {n: e["durations"] for n, e in entries.items() if n != "SA"}
        if spans:
            inside = sum(3.3 <= t <= 4.8 for d in spans.values() for t in d)
            text = "; ".join(f"{n} {d[0]:.2f}, {d[1]:.2f}" for n, d in spans.items())
            stands = "stands" if inside == 2 * len(spans) else "does not stand"
            yield f"Durations between 3.3 and 4.8 s: {stands} for the {words}, {inside} of {2 * len(spans)} lie there ({text} s)."


def _roles_in_words(best: Mapping[str, Any], evolved: Mapping[str, Any]) -> Iterable[str]:
    for words, entries in (("gradient optimum", best), ("best evolutionary trial", evolved)):
        if "PEA+BPEA" not in entries:
            continue
        parts, shares = [], {}
        for name, start in (("BPEA", "biarticular"), ("PEA", "parallel")):
            springs = [phases for label, phases in entries["PEA+BPEA"]["roles"].items() if label.startswith(start)]
            go, back = (sum(s[p] for s in springs) for p in PHASES)
            shares[name] = go / max(go + back, 1e-12)
            parts.append(f"{name} gives {go:.1f} Nm s going and {back:.1f} Nm s returning")
        stands = "stands" if shares["BPEA"] > 0.9 and shares["PEA"] < 0.75 else "does not stand"
        yield f"BPEA carries the payload, PEA the arm: {stands} for the {words} of PEA+BPEA; {', '.join(parts)}."


def transfer_tables(transfer: Mapping[str, Any]) -> str:
    """Optima played on the concealed plant, with what the model predicted."""
    stages, parts = transfer["stages"], []
    header = ["", *[f"{words} — {what}" for words in stages for what in ("predicted", "twin", "plant")]]
    rows = []
    for name in dict.fromkeys(n for stage in stages.values() for n in stage):
        row = [name]
        for stage in stages.values():
            entry = stage.get(name)
            row += [f"{entry[k]:.2f}" if entry else "" for k in ("predicted", "twin", "plant")]
        rows.append(row)
    parts.append(f"Concealed: {transfer['concealed']}; diagnosed: {transfer['diagnosed']}. E1 [N²m²s]:\n")
    parts.append(markdown(header, rows))
    for words, stage in stages.items():
        if "SA" in stage:
            parts.append(f"Relative decrease against SA on the plant [%], {words} | the paper's real world (Table 3):\n")
            parts.append(_plant_decreases(stage))
    return "\n".join(parts)


def _plant_decreases(stage: Mapping[str, Any]) -> str:
    real, rows = published().get("real_world_percent", {}), []
    joints = list(stage["SA"]["E1_joint"])
    for name, entry in stage.items():
        if name == "SA":
            continue
        row = [name]
        for key, label in (("E1_joint", "E1"), ("rms", "rms"), ("peak", "peak")):
            for i, j in enumerate(joints):
                printed = real.get(name, {}).get(label, ["–", "–"])[i]
                row.append(f"{100 * decrease(entry[key][j], stage['SA'][key][j]):.0f} \\| {printed}")
        rows.append([*row, f"{100 * decrease(entry['plant'], stage['SA']['plant']):.0f}"])
    return markdown(["", *[f"{what} {j}" for what in ("E1", "RMS", "peak") for j in joints], "E1 total"], rows)
