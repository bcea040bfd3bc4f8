"""The tables of a co-design study as Markdown, made from its summary alone, beside the paper's numbers."""

from typing import Any

from rrr_oc.codesign.task import PHASES
from rrr_oc.model.metrics import decrease
from rrr_oc.report.tables import SPRINGS, markdown, table_3, table_4


def report(summary: dict[str, Any]) -> str:
    """The whole report in Markdown: results, Table 3, Table 4, certificates, optima, what each search layer contributed."""
    found = summary["configurations"]
    parts = [
        f"# Co-design of springs and motion, preset `{summary['preset']}`\n",
        f"Cost: {summary['cost']}. Seed {summary['seed']}, {summary['starts']} starts a configuration, "
        f"{summary['wall_s']:.0f} s.\n",
        "## Optima\n",
        _optima_table(found),
        *_idle(found),
        "`published springs`: Table 4's hardware, its motion re-optimised on this model. `engine`: re-simulated in MuJoCo with "
        "feed-forward and the paper's P-controllers, load torque read from the engine. `mesh error`: between the nodes, "
        "relative. `over limits`: the largest excess of a limit between the nodes, relative to its scale (the mesh is not "
        "refined for it). `smoothing`: exact, non-smooth springs on the same motion against the smoothed ones. `2nd order`: "
        "strict is sufficient for a local optimum; weak is less, some bound is touched with next to no multiplier.\n",
    ]
    if "SA" in found:
        parts += [
            "## Relative decrease against stiff actuation (Table 3, simulation columns): ours | paper\n",
            _decreases(found),
        ]
    parts += ["## Hardware and durations (Table 4): ours | paper\n", _hardware(found)]
    parts += ["## Certificates\n", *[_certificate(name, c) for name, c in found.items()]]
    return "\n".join(parts)


def does_nothing(c: dict[str, Any]) -> bool:
    """Whether a design has springs and none of them does anything."""
    return bool(c.get("idle")) and set(c["idle"]) == set(c["mounted"])


def _idle(found: dict) -> list[str]:
    """A sentence for each spring that does nothing along the motion of its design."""
    return [
        f"**{name}: {label} is {why}** ({', '.join(f'{k} {v}' for k, v in c['mounted'][label].items())}).\n"
        for name, c in found.items()
        for label, why in c.get("idle", {}).items()
    ]


def _optima_table(found: dict) -> str:
    header = [
        "",
        "E1 [N²m²s]",
        "decrease",
        "published springs",
        "engine",
        "energy balance",
        "mesh error",
        "over limits",
        "smoothing",
        "2nd order",
        "wall [s]",
    ]
    stiff = found.get("SA", {}).get("E1")
    rows = []
    for name, c in found.items():
        certificate, engine = c["certificate"], c["mujoco"]
        fall = "" if stiff is None or name == "SA" else f"{100 * decrease(c['E1'], stiff):.1f} %"
        if does_nothing(c):
            fall = "springs do nothing"
        rows.append(
            [
                name,
                f"{c['E1']:.3f}",
                fall,
                "" if c.get("published_springs_E1") is None else f"{c['published_springs_E1']:.2f}",
                f"{engine['E1']:.3f}",
                f"{engine['energy_residual']:.1e}",
                f"{certificate['mesh']['error']:.1e}{'' if certificate['mesh']['converged'] else ' (not met)'}",
                f"{certificate['violation']:.0e}",
                f"{certificate['smoothing']:.1e}",
                certificate["second_order"],
                f"{c['wall_s']:.0f}",
            ]
        )
    return markdown(header, rows)


def _decreases(found: dict) -> str:
    return "In percent.\n\n" + table_3({n: [c] for n, c in found.items()}, list(found["SA"]["E1_joint"]), "E1", digits=1)


def _hardware(found: dict) -> str:
    used = {n for c in found.values() for n in c["springs"]}
    names = [n for n in SPRINGS if n in used] + sorted(used - set(SPRINGS))
    ours = {n: [{"springs": c["springs"], "durations": [c["durations"][p] for p in PHASES]}] for n, c in found.items()}
    return table_4(ours, names, digits=3)


def _certificate(name: str, c: dict) -> str:
    k = c["certificate"]
    lines = [
        f"### {name}\n",
        f"Residuals: primal {k['primal']:.1e}, dual {k['dual']:.1e}, complementarity {k['complementarity']:.1e} (scaled). "
        f"Second-order condition: {k['second_order']}, smallest curvature {k['curvature']:.1e} along "
        f"{', '.join(k['flattest'])}. Error between the nodes {k['mesh']['error']:.1e}"
        f"{'' if k['mesh']['converged'] else ' (tolerance not met)'}, limits exceeded between the nodes by at most "
        f"{k['violation']:.1e} of their scale. Exact springs on this motion: E1 = {k['exact_cost']:.4f}. "
        "An adaptive integrator run with these controls "
        f"ends {k['reintegration']['state']:.1e} away with a cost that differs by {k['reintegration']['cost']:.1e}. "
        f"The tool comes down to {c['lowest_tool_m']:.3f} m above the base. "
        f"{_origin(c)} One more kg of payload: {100 * k['sensitivity']:+.1f} % of E1.\n",
    ]
    lines += [f"- {bound['sentence']}" for bound in k["active"]]
    if "not_bought" in c:
        lines.append(f"\nNo choice of the catalogue could be solved: {c['not_bought']}")
    if "catalogue" in c:
        cover = c["catalogue"]
        lines.append(f"\n{_coverage(cover)}")
    if c.get("optima"):
        header = ["E1", "reached", "t_go [s]", "t_return [s]", "refined", "hardware"]
        rows = [
            [
                f"{o['E1']:.3f}",
                str(o["reached"] or "by hopping"),
                f"{o['durations']['go']:.3f}",
                f"{o['durations']['return']:.3f}",
                "yes" if o["refined"] else "no",
                ", ".join(f"{key} {value:.4g}" for key, value in o["springs"].items()),
            ]
            for o in c["optima"]
        ]
        lines.append("\nDistinct local optima (those not refined carry the error of their mesh):\n\n" + markdown(header, rows))
    if c.get("layers"):
        header = ["layer", "starts", "failed", "best proposal", "best after IPOPT", "median after IPOPT"]
        rows = [
            [layer, str(v["starts"]), str(v["failed"]), f"{v['best_proposal']:.1f}", f"{v['best']:.3f}", f"{v['median']:.3f}"]
            for layer, v in c["layers"].items()
        ]
        lines.append("\nWhat each layer contributed (coarse mesh):\n\n" + markdown(header, rows))
    return "\n".join(lines) + "\n"


def _origin(c: dict) -> str:
    """Where an optimum comes from."""
    if "catalogue" in c:
        return "Found by following the continuous optimum to this hardware."
    if c["certificate"]["share"] == 0:
        return "Found by hopping over the durations from the best optimum that a start reached."
    return f"{100 * c['certificate']['share']:.0f} % of the starts reached it."


def _coverage(cover: dict) -> str:
    """What of a catalogue was searched, and what was not."""
    text = f"Catalogue: {cover['combinations']} combinations, {cover['distinct']} distinct; {cover['solved']} solved with the "
    text += f"hardware held, {cover['relaxed']} more with free stiffnesses to screen, {cover['failed']} failed. "
    if cover["complete"]:
        text += "So every distinct one was solved. "
    if cover["neighbours"]:
        text += "For each biarticular spring only the stiffnesses next to its optimal ones were solved. "
    if cover["margin"] is not None:
        text += f"The best biarticular spring left out screens {100 * cover['margin']:.1f} % above the best (interpolated). "
    return (
        text + f"Cost of buying instead of making: {round(100 * cover['gap'], 1) + 0.0:+.1f} % against the continuous optimum."
    )
