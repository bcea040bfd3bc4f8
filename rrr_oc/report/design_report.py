"""The tables of a co-design study as Markdown, made from its summary alone, beside the paper's numbers."""

from collections.abc import Sequence
from typing import Any, NamedTuple

from rrr_oc.codesign.study import does_nothing
from rrr_oc.codesign.task import PHASES
from rrr_oc.model.metrics import decrease
from rrr_oc.report.tables import SPRINGS, markdown, table_3, table_4


class Quantity(NamedTuple):
    """What a study minimises: its name and unit."""

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


def report(summary: dict[str, Any]) -> str:
    """The whole report in Markdown: results, Table 3, Table 4, certificates, optima, what each search layer contributed."""
    found, quantity = summary["configurations"], Quantity(*summary["quantity"])
    published = "`published springs`: Table 4's hardware, its motion re-optimised on this model. " if summary["paper"] else ""
    parts = [
        f"# Co-design of springs and motion, preset `{summary['preset']}`\n",
        f"Cost: {summary['cost']}. Seed {summary['seed']}, {summary['starts']} starts a configuration, "
        f"{summary['wall_s']:.0f} s.\n",
        "## Optima\n",
        _optima_table(found, quantity, summary["paper"]),
        *_idle(found),
        f"{published}`engine`: {quantity.engine}re-simulated in MuJoCo with "
        "feed-forward and the paper's P-controllers, load torque read from the engine. `mesh error`: between the nodes, "
        "relative. `over limits`: the largest excess of a limit between the nodes, relative to its scale (the mesh is not "
        "refined for it). `smoothing`: exact, non-smooth springs on the same motion against the smoothed ones. `2nd order`: "
        "strict is sufficient for a local optimum; weak is less, some bound is touched with next to no multiplier.\n",
    ]
    beside = summary["paper"]
    if "SA" in found:
        title = "## Relative decrease against stiff actuation" + (
            " (Table 3, simulation columns): ours | paper\n" if beside else "\n"
        )
        parts += [title, _decreases(found, beside)]
    parts += ["## Hardware and durations" + (" (Table 4): ours | paper\n" if beside else "\n")]
    parts += [_hardware(found, beside, summary["joints"])]
    parts += ["## Certificates\n", *[_certificate(name, c, quantity) for name, c in found.items()]]
    return "\n".join(parts)


def _idle(found: dict) -> list[str]:
    """A sentence for each spring that does nothing along the motion of its design."""
    return [
        f"**{name}: {label} is {why}** ({', '.join(f'{k} {v}' for k, v in c['mounted'][label].items())}).\n"
        for name, c in found.items()
        for label, why in c.get("idle", {}).items()
    ]


def _optima_table(found: dict, quantity: Quantity, beside: bool) -> str:
    header = [
        "",
        quantity.title,
        "decrease",
        *(["published springs"] if beside else []),
        "engine",
        "energy balance",
        "mesh error",
        "over limits",
        "smoothing",
        "2nd order",
        "wall [s]",
    ]
    stiff = found.get("SA", {}).get("cost")
    rows = []
    for name, c in found.items():
        certificate, engine = c["certificate"], c["mujoco"]
        fall = "" if stiff is None or name == "SA" else f"{100 * decrease(c['cost'], stiff):.1f} %"
        if does_nothing(c):
            fall = "springs do nothing"
        rows.append(
            [
                name,
                f"{c['cost']:.3f}",
                fall,
                *([_published(c)] if beside else []),
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


def _published(c: dict) -> str:
    return "" if c.get("published_springs_E1") is None else f"{c['published_springs_E1']:.2f}"


def _decreases(found: dict, beside: bool) -> str:
    ours, joints = {n: [c] for n, c in found.items()}, list(found["SA"]["E1_joint"])
    return "In percent.\n\n" + table_3(ours, joints, "E1", digits=1, beside=beside)


def of_joint(name: str, joints: Sequence[str]) -> str:
    """A spring's quantity with the joint's own name in place of its number, as in "k_p of elbow"; one across joints as it is."""
    symbol = name.rstrip("0123456789")
    number = name.removeprefix(symbol)
    return f"{symbol} of {joints[int(number) - 1]}" if number and not symbol.endswith("_") else name


def _hardware(found: dict, beside: bool, joints: Sequence[str]) -> str:
    used = {n for c in found.values() for n in c["springs"]}
    names = [n for n in SPRINGS if n in used] + sorted(used - set(SPRINGS))
    ours = {n: [{"springs": c["springs"], "durations": [c["durations"][p] for p in PHASES]}] for n, c in found.items()}
    if beside:
        return table_4(ours, names, digits=3)
    return table_4(ours, names, 3, None, {name: of_joint(name, joints) for name in names})


def _certificate(name: str, c: dict, quantity: Quantity) -> str:
    k = c["certificate"]
    lines = [
        f"### {name}\n",
        f"Residuals: primal {k['primal']:.1e}, dual {k['dual']:.1e}, complementarity {k['complementarity']:.1e} (scaled). "
        f"Second-order condition: {k['second_order']}, smallest curvature {k['curvature']:.1e} along "
        f"{', '.join(k['flattest'])}. Error between the nodes {k['mesh']['error']:.1e}"
        f"{'' if k['mesh']['converged'] else ' (tolerance not met)'}, limits exceeded between the nodes by at most "
        f"{k['violation']:.1e} of their scale. Exact springs on this motion: {quantity.name} = {k['exact_cost']:.4f} {quantity.unit}. "
        "An adaptive integrator run with these controls "
        f"ends {k['reintegration']['state']:.1e} away with a cost that differs by {k['reintegration']['cost']:.1e}. "
        f"The tool comes down to {c['lowest_tool_m']:.3f} m above the base. "
        f"{_origin(c)} One more kg of payload: {100 * k['sensitivity']:+.1f} % of {quantity.name}.\n",
    ]
    lines += [f"- {bound['sentence']}" for bound in k["active"]]
    if "not_bought" in c:
        lines.append(f"\nNo choice of the catalogue could be solved: {c['not_bought']}")
    if "catalogue" in c:
        cover = c["catalogue"]
        lines.append(f"\n{_coverage(cover)}")
    if c.get("optima"):
        header = [quantity.title, "reached", "t_go [s]", "t_return [s]", "refined", "hardware"]
        rows = [
            [
                f"{o['cost']:.3f}",
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
