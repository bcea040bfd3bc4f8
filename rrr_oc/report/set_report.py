"""A study of a set of tasks in tables and sentences, made from its summary alone, and its report in Markdown."""

from typing import Any

from rrr_oc.codesign.task import PHASES
from rrr_oc.effects.words import listed
from rrr_oc.report.design_report import SECOND_ORDER, Quantity, hardware_table
from rrr_oc.report.tables import NONE, Table, markdown

OBJECTIVES = {"sum": "the weighted sum of the tasks' costs", "worst": "the greatest of the tasks' weighted costs"}
WORDS = {
    "set": "with the springs of the set, the same for all tasks.",
    "alone": "with the best springs for this task alone that the search found.",
    "first's": "with the springs tuned to the first task alone, and the best motions for them.",
    "more than alone": "what sharing the springs costs.",
    "MuJoCo": "E1 [N²m²s] of the load torque in the simulation of the set's motion.",
}


def report(summary: dict[str, Any]) -> str:
    """The whole report in Markdown: totals, tasks, springs, front, certificates."""
    found, quantity = summary["configurations"], Quantity(*summary["quantity"])
    parts = [
        f"# One set of springs for {len(summary['tasks'])} tasks, set `{summary['set']}`\n",
        f"{minimised(summary)} Cost of a task: {summary['cost']}. Seed {summary['seed']}, {summary['starts']} starts a configuration, "
        f"{summary['wall_s']:.0f} s.\n",
        "## The set\n",
        markdown(*totals_table(summary)),
        " ".join(f"`{name}`: {words}" for name, words in WORDS.items()) + "\n",
        *[f"**{sentence}**\n" for sentence in cautions(summary)],
    ]
    for name in found:
        parts += [f"## The tasks with {name}\n", markdown(*tasks_table(summary, name))]
    parts += ["## Springs\n", markdown(*springs_table(summary))]
    for name, c in found.items():
        if c["choice"]:
            parts += [f"## Which springs are worth their price, {name}\n", choice_sentence(c, quantity) + "\n"]
            parts += [markdown(*choice_table(c, quantity)), "![Cost against the number of springs](choice.png)\n"]
        if c["front"]:
            parts += [f"## Between the set and its first task, {name}\n", FRONT + "\n", markdown(*front_table(c, quantity))]
        if len(next(iter(c["tasks"].values()))["scenarios"]) > 1:
            parts += [f"## Scenarios of {name}\n", markdown(*scenarios_table(summary, name))]
    parts += ["## Certificates\n"]
    for name, c in found.items():
        parts += [f"### {name}\n", " ".join(set_sentences(summary, name)) + "\n", markdown(*certificates_table(c))]
    return "\n".join(parts)


FRONT = (
    "The first row is the optimum of the set, the last has the springs of the first task alone; those between favour the first task more "
    "and more, and are on the first fine mesh."
)


def minimised(summary: dict[str, Any]) -> str:
    """What is minimised, and over what is uncertain, in a sentence or two."""
    weights = {t["weight"] for t in summary["tasks"]}
    equal = ", all weights equal" if len(weights) == 1 else ""
    said = f"Minimised is {OBJECTIVES[summary['objective']]}{equal}."
    unsure = summary["uncertain"]
    what = [f"payloads within ±{100 * unsure['payload']:g} %"] if unsure["payload"] else []
    what += [f"{name} in its 95 % interval" for name in unsure["model"]]
    return said + (
        f" The cost of a task is that of the worst case of {listed(what)}, with the same motion in all cases." if what else ""
    )


def _share(value: float, reference: float) -> str:
    return f"{100 * (value / reference - 1):+.1f} %" if reference else NONE


def totals_table(summary: dict[str, Any]) -> Table:
    """The objective of each configuration with the set's springs, with those of each task alone, and with the first task's."""
    found, quantity = summary["configurations"], Quantity(*summary["quantity"])
    stiff = found.get("SA", {}).get("cost")
    header = [
        "",
        f"set, {quantity.title}",
        "less than SA",
        "alone",
        "more than alone",
        "first's",
        "more than the set",
        "wall [s]",
    ]
    rows = []
    for name, c in found.items():
        less = "" if stiff is None or name == "SA" else f"{100 * (1 - c['cost'] / stiff):.1f} %"
        shares = [_share(c["cost"], c["alone"]), _share(c["with_first"], c["cost"])] if c["springs"] else ["", ""]
        others = [f"{c['alone']:.3f}", shares[0], f"{c['with_first']:.3f}", shares[1]]
        rows.append([name, f"{c['cost']:.3f}", less, *others, f"{c['wall_s']:.0f}"])
    return header, rows


def tasks_table(summary: dict[str, Any], name: str) -> Table:
    """A row for each task of a configuration."""
    quantity, given = Quantity(*summary["quantity"]), {t["name"]: t for t in summary["tasks"]}
    header = ["task", "weight", "payload [kg]", f"set, {quantity.title}", "alone", "more than alone", "first's"]
    header += ["MuJoCo", *(f"t_{phase} [s]" for phase in PHASES), "2nd order", "mesh error"]
    rows = []
    for task, c in summary["configurations"][name]["tasks"].items():
        mesh = c["certificate"]["mesh"]
        rows.append(
            [
                task,
                f"{given[task]['weight']:g}",
                f"{given[task]['payload_kg']:g}",
                f"{c['cost']:.3f}",
                f"{c['alone']:.3f}",
                _share(c["cost"], c["alone"]),
                f"{c['with_first']:.3f}",
                f"{c['mujoco']['E1']:.3f}",
                *(f"{c['durations'][phase]:.3f}" for phase in PHASES),
                c["certificate"]["second_order"],
                f"{mesh['error']:.1e}{'' if mesh['converged'] else ' (not met)'}",
            ]
        )
    return header, rows


def springs_table(summary: dict[str, Any]) -> Table:
    """The springs of the set in each configuration, and of the first task alone."""
    first = summary["tasks"][0]["name"]
    rows: dict[str, Any] = {}
    for name, c in summary["configurations"].items():
        if c["springs"]:
            task = c["tasks"][first]
            rows[name] = {"springs": c["springs"], "durations": task["durations"]}
            rows[f"{name}, {first} alone"] = {"springs": task["springs_alone"], "durations": task["durations"]}
    header, cells = hardware_table(rows, False, summary["joints"])
    return header[: -len(PHASES)], [row[: -len(PHASES)] for row in cells]


def front_table(c: dict[str, Any], quantity: Quantity) -> Table:
    """Optima between that of the set and that of the first task alone."""
    rows = [
        [
            f"{p['share']:.2f}",
            f"{p['first']:.3f}",
            f"{p['total']:.3f}",
            ", ".join(f"{k} {v:.4g}" for k, v in p["springs"].items()),
        ]
        for p in c["front"]
    ]
    return ["share of the first task", f"first task, {quantity.title}", f"set, {quantity.title}", "springs"], rows


def choice_sentence(c: dict[str, Any], quantity: Quantity) -> str:
    """Which number of springs is best at the price, and how far the front can be trusted."""
    choice = c["choice"]
    best, unit = choice["points"][choice["chosen"]], quantity.unit
    which = f": {springs_of(best)}" if best["count"] else ""
    said = (
        f"At a price of {choice['price']:g} {unit} a spring, {best['count']} of {choice['offered']} springs are best{which}. "
    )
    said += f"{choice['solved']} sets of springs were solved with their motions, each to a local optimum on the first fine mesh; so "
    said += (
        "no cost in this table is proven to be the least. A number of springs that is missing did not cost less than fewer. "
    )
    return said + f"Refined, and searched for better motions, the chosen springs cost {c['cost']:.4g} {unit}."


def springs_of(point: dict[str, Any]) -> str:
    """The springs of a point of the front and how each is mounted."""
    named = []
    for label, ways in point["mounted"].items():
        kind, joints = label.rstrip("]").split("[")
        shown = [" ".join(f"{v:+d}" for v in way) if isinstance(way, list) else str(way) for way in ways.values()]
        where = f"across {joints.replace(',', ' and ')}" if "," in joints else f"on {joints}"
        name = kind.removesuffix("_spring").replace("_", " ")
        named.append(f"{name} {where}" + (f" ({', '.join(shown)})" if shown else ""))
    return ", ".join(named) or NONE


def choice_table(c: dict[str, Any], quantity: Quantity) -> Table:
    """The front of the number of springs: cost, cost with the price, and which springs."""
    choice = c["choice"]
    rows = []
    for i, p in enumerate(choice["points"]):
        mark = " (chosen)" if i == choice["chosen"] else ""
        rows.append([f"{p['count']}{mark}", f"{p['cost']:.3f}", f"{p['priced']:.3f}", springs_of(p)])
    return ["springs", f"set, {quantity.title}", f"with {choice['price']:g} a spring", "which"], rows


def scenarios_table(summary: dict[str, Any], name: str) -> Table:
    """E1 of every task in every scenario, as planned and in MuJoCo; the worst of a task is its cost."""
    rows = []
    for task, c in summary["configurations"][name]["tasks"].items():
        for s in c["scenarios"]:
            known = ", ".join(f"{k.removeprefix('known ')} {v:.4g}" for k, v in s["parameters"].items()) or NONE
            rows.append([task, f"{s['payload_kg']:.3g}", known, f"{s['E1']:.3f}", f"{s['mujoco']:.3f}"])
    return ["task", "payload [kg]", "model", "E1 [N²m²s]", "MuJoCo"], rows


def certificates_table(c: dict[str, Any]) -> Table:
    """What is known of each task's motion, its springs held."""
    rows = []
    for task, found in c["tasks"].items():
        k = found["certificate"]
        residual, energy = max(k["primal"], k["dual"], k["complementarity"]), found["mujoco"]["energy_residual"]
        cells = [
            residual,
            k["violation"],
            k["smoothing"],
            k["reintegration"]["state"],
            energy,
            found["mujoco"]["tracking_error_rad"],
        ]
        rows.append([task, *(f"{value:.0e}" for value in cells)])
    return ["task", "conditions", "over limits", "smoothing", "re-integration", "energy balance", "tracking [rad]"], rows


def set_sentences(summary: dict[str, Any], name: str) -> list[str]:
    """What is known of the springs of a configuration, a sentence or two on each subject."""
    c = summary["configurations"][name]
    if not c["springs"]:
        return ["Without springs nothing is shared: every task is solved by itself."]
    costs = [s["polished"] for s in c["starts"] if s["polished"] is not None]
    near = sum(cost <= min(costs) * 1.01 for cost in costs)
    orders = {found["certificate"]["second_order"] for found in c["tasks"].values()}
    worst = max(orders, key=list(SECOND_ORDER).index)
    return [
        f"{near} of {len(c['starts'])} starts ended within 1 % of the best on the coarse mesh."
        if c["starts"]
        else "The springs were chosen by their price; the search began at the stiff arm alone.",
        _again(c["change"]),
        f"No springs can bring the set below {c['alone']:.3f}, the objective of the springs tuned to each task alone, if those optima are "
        "the best ones.",
        "Of the motions with the springs held: " + SECOND_ORDER[worst],
    ]


def _again(change: float | None) -> str:
    if change is None:
        return "On the refined meshes, springs and motions together could not be solved once more; only the motions were."
    fell = f"fell by {change:.1e} (relative)" if change else "fell no further"
    return f"Springs and motions were solved once more on the refined meshes, and the objective {fell}."


def cautions(summary: dict[str, Any]) -> list[str]:
    """What a reader should know before using the results, a sentence each; none where there is nothing."""
    said = []
    for name, c in summary["configurations"].items():
        tasks = c["tasks"]
        for label in c["mounted"]:
            if all(label in found["idle"] for found in tasks.values()):
                said.append(f"{name}: {label} does nothing in any task.")
        beyond = [(task, *one) for task, found in tasks.items() for one in found.get("beyond", {}).items()]
        said += [f"{name}: in task {task} the law of {label} is {how}." for task, label, how in beyond]
        unmet = [task for task, found in tasks.items() if not found["certificate"]["mesh"]["converged"]]
        if unmet:
            said.append(f"{name}: the tolerance of the mesh was not met for {listed(unmet)}.")
        broken = [task for task, found in tasks.items() if found["certificate"]["second_order"] == "violated"]
        if broken:
            said.append(f"{name}: the motion of {listed(broken)} is no local optimum.")
    return said
