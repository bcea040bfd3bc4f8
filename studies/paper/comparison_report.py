"""The comparison of ways to solve the paper's experiments as a Markdown report, made from its summary alone."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from rrr_oc.codesign.task import PHASES
from rrr_oc.model.metrics import decrease
from rrr_oc.report.tables import SPRINGS, markdown, table_3, table_4
from studies.paper.comparison import EVOLVED, FREE_MOTION, WAYS, best_of, evolved_of
from studies.paper.experiments import EXPERIMENTS


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
    parts += ["\n## Table 3: relative decrease against stiff actuation [%], evolution | gradient | paper\n", _decreases(rest)]
    parts.append("Evolution in MuJoCo; of experiments without trials there, in the model.\n")
    parts += ["\n## Table 4: hardware and durations, evolution | gradient | paper\n", _hardware(rest)]
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


def _decreases(rest: Mapping[str, Any]) -> str:
    if "SA" not in rest:
        return ""
    joints = list((best_of(rest["SA"], tuple(WAYS)) or {})["E1_joint"])
    ours = {name: (evolved_of(entry), best_of(entry, FREE_MOTION)) for name, entry in rest.items()}
    return markdown(*table_3(ours, joints, "best", digits=0))


def _hardware(rest: Mapping[str, Any]) -> str:
    ours = {}
    for name, entry in rest.items():
        both = evolved_of(entry), best_of(entry, FREE_MOTION)
        ours[name] = [None if e is None else {"springs": e["hardware"], "durations": e["durations"]} for e in both]
    return markdown(*table_4(ours, SPRINGS, digits=2, formats=(".4g", ".2f")))


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
    best = {n: e for n in EXPERIMENTS[:4] if n in rest and (e := best_of(rest[n], FREE_MOTION))}
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
            found = {n: [e] for n, e in stage.items()}
            parts.append(markdown(*table_3(found, list(stage["SA"]["E1_joint"]), "plant", 0, measured=True)))
    return "\n".join(parts)
