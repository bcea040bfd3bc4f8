"""A co-design study in tables and sentences, made from its summary alone, and its report in Markdown."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from rrr_oc.codesign.study import does_nothing, uncalibrated
from rrr_oc.codesign.task import PHASES
from rrr_oc.effects.words import joint_words
from rrr_oc.model.metrics import decrease
from rrr_oc.report.tables import NONE, SPRINGS, Table, markdown, spring_unit, table_3, table_4

SECOND_ORDER = {
    "strict": "The second-order condition is strict, which is sufficient for a local optimum.",
    "weak": "The second-order condition is weak: some bound is touched with next to no multiplier, and a local optimum is not proved.",
    "violated": "The second-order condition is violated: some small change lowers the cost, so this is no local optimum.",
}
TRANSFERRED = (
    "Each optimum tracked by P-controllers with the model's own torque as feed-forward; E1 [N²m²s], and its decrease against SA, of the "
    "load torque that the engine gives, and, where the drives' friction is given, of the one that follows from the motor torque."
)
LOCAL_OPTIMA = "Distinct local optima (those not refined carry the error of their mesh)"
UNDERCUT = 1e-5  # [1] of the cost by which a bound may have been undercut before it is said; doubled, less of IPOPT's tolerance is told
LAYERS = "What each layer contributed (coarse mesh)"


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
    parts = [
        f"# Co-design of springs and motion, task `{summary['preset']}`\n",
        f"Cost: {summary['cost']}. Seed {summary['seed']}, {summary['starts']} starts a configuration, "
        f"{summary['wall_s']:.0f} s.\n",
        *[f"{sentence}\n" for sentence in ends_in_words(summary)],
        "## Optima\n",
        markdown(*optima_table(found, quantity, summary["paper"])),
        *_idle(found),
        *_beyond(found),
        " ".join(f"`{name}`: {words}" for name, words in columns_in_words(quantity, summary["paper"]).items()) + "\n",
    ]
    beside = summary["paper"]
    if "SA" in found:
        title = "## Relative decrease against stiff actuation" + (
            " (Table 3, simulation columns): ours | paper\n" if beside else "\n"
        )
        parts += [title, "In percent.\n\n" + markdown(*decrease_table(found, beside))]
    parts += ["## Hardware and durations" + (" (Table 4): ours | paper\n" if beside else "\n")]
    parts += [markdown(*hardware_table(found, beside, summary["joints"]))]
    parts += ["## Certificates\n", *[_certificate(name, c, quantity, summary["joints"]) for name, c in found.items()]]
    if (transferred := transfer_table(found)) is not None:
        parts += ["\n## In the twin calibrated on recordings\n", f"{transferred_in_words(found)}\n", markdown(*transferred)]
    return "\n".join(parts)


def ends_in_words(summary: Mapping[str, Any]) -> list[str]:
    """What a reader should know of a task whose ends are not both at rest, a sentence each."""
    speeds = summary.get("speeds", {})
    said = {
        "moving": "The arm does not stop at the {}: its speed there is the same at the end of one phase as at the start of the next.",
        "free": "The speed at the {} is free at the end of one phase and at the start of the next, and may jump between them.",
    }
    sentences = [said[speed].format(end) for end, speed in speeds.items() if speed in said]
    if sentences:
        sentences.append("No bound over all motions is stated: its proof needs an arm that rests at both ends.")
    return sentences


def _idle(found: dict) -> list[str]:
    """A sentence for each spring that does nothing along the motion of its design."""
    return [
        f"**{name}: {label} is {why}** ({', '.join(f'{k} {v}' for k, v in c['mounted'][label].items())}).\n"
        for name, c in found.items()
        for label, why in c.get("idle", {}).items()
    ]


def _beyond(found: dict) -> list[str]:
    """A sentence for each spring that a motion turns further than its law is known."""
    return [
        f"**{name}: the law of {label} is {how}.**\n" for name, c in found.items() for label, how in c.get("beyond", {}).items()
    ]


def optima_table(found: dict, quantity: Quantity, beside: bool) -> Table:
    """A row for each configuration; `beside` adds the cost with the springs that the paper published."""
    header = ["", quantity.title, "decrease", *(["published springs"] if beside else []), "engine", "energy balance"]
    header += ["mesh error", "over limits", "smoothing", "2nd order", "wall [s]"]
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
    return header, rows


def columns_in_words(quantity: Quantity, beside: bool) -> dict[str, str]:
    """What the columns of `optima_table` show, a sentence or two each."""
    published = {"published springs": "Table 4's hardware, its motion re-optimised on this model."} if beside else {}
    return published | {
        "engine": f"{quantity.engine}re-simulated in MuJoCo with feed-forward and P-controllers, load torque read from "
        "the engine.",
        "mesh error": "between the nodes, relative.",
        "over limits": "the largest excess of a limit between the nodes, relative to its scale; meshes are refined for limits of range, "
        "speed and acceleration.",
        "smoothing": "exact, non-smooth springs on the same motion against the smoothed ones.",
        "2nd order": "strict is sufficient for a local optimum; weak is less, some bound is touched with next to no multiplier.",
    }


def _published(c: dict) -> str:
    return "" if c.get("published_springs_E1") is None else f"{c['published_springs_E1']:.2f}"


def decrease_table(found: dict, beside: bool) -> Table:
    """Relative decreases against stiff actuation [%], which must be among the configurations; `beside`: with the paper's."""
    ours, joints = {n: [c] for n, c in found.items()}, list(found["SA"]["E1_joint"])
    return table_3(ours, joints, "E1", digits=1, beside=beside)


def of_joint(name: str, joints: Sequence[str]) -> str:
    """A spring's quantity with the joint's own name in place of its number, as in "k_p of elbow"; one across joints as it is."""
    symbol = name.rstrip("0123456789")
    number = name.removeprefix(symbol)
    return f"{symbol} of {joint_words(joints[int(number) - 1])}" if number and not symbol.endswith("_") else name


def hardware_table(found: dict, beside: bool, joints: Sequence[str]) -> Table:
    """Springs and durations of each configuration; `beside`: with the paper's, by the paper's names."""
    used = {n for c in found.values() for n in c["springs"]}
    names = [n for n in SPRINGS if n in used] + sorted(used - set(SPRINGS))
    ours = {n: [{"springs": c["springs"], "durations": [c["durations"][p] for p in PHASES]}] for n, c in found.items()}
    if beside:
        return table_4(ours, names, digits=3)
    return table_4(ours, names, 3, None, {name: of_joint(name, joints) for name in names})


def transfer_table(found: dict) -> Table | None:
    """E1 in the calibrated twin and its decrease against stiff actuation, by both load torques; None without a twin."""
    known = {name: c["calibrated"] for name, c in found.items() if c.get("calibrated")}
    if not known:
        return None
    stiff, rows = known.get("SA"), []
    routes = ["engine"] + ["eq10"] * any(c["eq10"] is not None for c in known.values())
    for name, c in known.items():
        cells = [name]
        for route in routes:
            if c[route] is None:  # the drives of this one are unknown
                cells += [NONE, NONE]
                continue
            less = "" if stiff is None or name == "SA" else f"{100 * decrease(c[route]['E1'], stiff[route]['E1']):.1f} %"
            cells += [f"{c[route]['E1']:.2f}", less]
        cells += [", ".join(f"{v:.1f}" for v in c["motor"]["rms"].values()), f"{c['tracking_error_rad']:.4f}"]
        rows.append([*cells, "yes" if c["saturated"] else "no"])
    heads = ["engine", "decrease", "from the motor torque", "decrease"][: 2 * len(routes)]
    return ["", *heads, "RMS motor torque [Nm]", "tracking [rad]", "at its limit"], rows


def transferred_in_words(found: Mapping[str, Any]) -> str:
    """How optima were tracked in the calibrated twin, and which joints no recording says anything of."""
    unknown = next((c["calibrated"]["uncalibrated"] for c in found.values() if c.get("calibrated")), [])
    return TRANSFERRED + (f" Beware: {uncalibrated(unknown)}." if unknown else "")


def _certificate(name: str, c: dict, quantity: Quantity, joints: Sequence[str]) -> str:
    lines = [f"### {name}\n", " ".join(certificate_sentences(c, quantity)) + "\n"]
    lines += [f"- {bound['sentence']}" for bound in c["certificate"]["active"]]
    if "not_bought" in c:
        lines.append(f"\nNo choice of the catalogue could be solved: {c['not_bought']}")
    if "catalogue" in c:
        lines.append(f"\n{coverage(c['catalogue'])}")
    if c.get("optima"):
        lines.append(f"\n{LOCAL_OPTIMA}:\n\n" + markdown(*local_optima_table(c, quantity, joints)))
    if c.get("layers"):
        lines.append(f"\n{LAYERS}:\n\n" + markdown(*layers_table(c)))
    return "\n".join(lines) + "\n"


def certificate_sentences(c: dict, quantity: Quantity) -> list[str]:
    """What is known of an optimum, a sentence or two on each subject."""
    k, error = c["certificate"], c["mujoco"]
    worst = max(k["primal"], k["dual"], k["complementarity"])
    met = "within the tolerance" if k["mesh"]["converged"] else "more than the tolerance, which was not met"
    return [
        f"The first-order conditions of an optimum hold to {worst:.1e} (the largest of the primal, dual and complementarity "
        f"residuals, scaled).",
        f"{SECOND_ORDER[k['second_order']]} The cost is flattest along {' and '.join(k['flattest'])}, with a curvature of "
        f"{k['curvature']:.1e}.",
        f"Between the nodes of the mesh the motion misses the dynamics by at most {k['mesh']['error']:.1e} (relative), {met}, and "
        f"exceeds limits by at most {k['violation']:.1e} of their scale.",
        f"With exact springs in the place of smoothed ones, {quantity.name} of this motion is {k['exact_cost']:.4f} {quantity.unit}, "
        f"{k['smoothing']:.1e} away (relative).",
        f"An adaptive integrator run with the same controls ends {k['reintegration']['state']:.1e} away from the planned end, with a "
        f"cost that differs by {k['reintegration']['cost']:.1e}.",
        f"MuJoCo, which simulates the motion with the same springs and P-controllers, finds an E1 of {error['E1']:.4f} N²m²s, "
        f"and follows the motion to {error['tracking_error_rad']:.1e} rad.",
        *bounds_in_words(c),
        f"The lowest point of the tool is {abs(c['lowest_tool_m']):.3f} m {'below' if c['lowest_tool_m'] < 0 else 'above'} the base.",
        _origin(c),
        f"One more kg of payload changes the cost by {100 * k['sensitivity']:+.1f} % of {quantity.name}.",
    ]


def spring_words(springs: Mapping[str, float], joints: Sequence[str]) -> str:
    """Quantities of springs with their joints, in a designer's units."""
    units = {name: spring_unit(name)[1:] for name in springs}
    return ", ".join(f"{of_joint(n, joints)} = {value * units[n][0]:.4g} {units[n][1]}" for n, value in springs.items())


def bounds_in_words(c: dict) -> list[str]:
    """What no springs can be better than, on the motion of the design and on any, a sentence each; none where that is not known."""
    bound, least = c["certificate"]["bound"], c["certificate"]["least"]
    said, which = [], "in the catalogue or not" if "catalogue" in c else "of any size within the task's bounds"
    if bound is not None and not c["springs"]:
        said.append("On this motion there are no springs to choose.")
    elif bound is not None and bound["excess"] is None:
        said.append("How good the springs are on this motion is not known: several in one place, mixed, could give all torque.")
    elif bound is not None:
        above = max(bound["excess"], 0.0)
        doubt = min(bound["mixture"] / bound["lower"] - 1, above)
        said.append(
            f"On this motion no springs of these kinds, {which}, reach an E1 below {bound['lower']:.4g} N²m²s; this design is "
            f"{_percent(above)} above, of which up to {_percent(doubt)} is the tolerance of this bound."
        )
    if least:
        all_ = (
            f"no motion of the task and no springs of these kinds, {which}, reach"
            if c["springs"]
            else "no motion of the task reaches"
        )
        said.append(f"It is proved that {all_} an E1 below {least:.4g} N²m²s, {100 * least / c['E1']:.0f} % of this design's.")
    return said


def _percent(x: float) -> str:
    return f"{100 * x:.2g} %"


def local_optima_table(c: dict, quantity: Quantity, joints: Sequence[str]) -> Table:
    """The distinct local optima that a search found."""
    rows = [
        [
            f"{o['cost']:.3f}",
            str(o["reached"] or "from others"),
            f"{o['durations']['go']:.3f}",
            f"{o['durations']['return']:.3f}",
            "yes" if o["refined"] else "no",
            spring_words(o["springs"], joints),
        ]
        for o in c["optima"]
    ]
    return [quantity.title, "reached", "t_go [s]", "t_return [s]", "refined", "hardware"], rows


def layers_table(c: dict) -> Table:
    """What each layer of a search contributed."""
    digits = {"best_proposal": 1, "best": 3, "median": 3}
    rows = [
        [
            layer,
            str(v["starts"]),
            str(v["failed"]),
            *(NONE if v[key] is None else f"{v[key]:.{n}f}" for key, n in digits.items()),  # of a layer whose starts all failed
        ]
        for layer, v in c["layers"].items()
    ]
    return ["layer", "starts", "failed", "best proposal", "best after IPOPT", "median after IPOPT"], rows


def _origin(c: dict) -> str:
    """Where an optimum comes from."""
    if "catalogue" in c:
        return "Found by following the continuous optimum to this hardware."
    reached = c["certificate"]["reached"]
    if reached == 0:
        return "No start led to it: it was found from other optima, by changes of their durations."
    return "One start led to it." if reached == 1 else f"{reached} starts led to it."


def coverage(cover: dict) -> str:
    """What of a catalogue was searched, and what was not."""
    text = f"Catalogue: {cover['combinations']} combinations, {cover['distinct']} distinct. Branch and bound solved {cover['solved']} "
    text += f"problems, {cover['single']} of them with the hardware held"
    if cover["excluded"]:
        text += f", and excluded the other {cover['excluded']}: by their bounds they cost at least {100 * cover['margin']:.1f} % more than "
        text += "the best. These bounds hold as far as each local optimum is the global one of its problem"
    if cover["undercut"] > UNDERCUT:
        text += f"; one was not, by {100 * cover['undercut']:.1g} %"
    text += ". "
    if cover["failed"]:
        text += f"{cover['failed']} could not be solved. "
    if cover["left"]:
        text += f"The search ended early, with {cover['left']} left. "
    return (
        text + f"Cost of buying instead of making: {round(100 * cover['gap'], 1) + 0.0:+.1f} % against the continuous optimum."
    )
