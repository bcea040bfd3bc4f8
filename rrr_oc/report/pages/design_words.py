"""A co-design study in words: the verdict, what is to be made or bought, and what to be careful about; made from its summary alone."""

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from rrr_oc.codesign.study import does_nothing
from rrr_oc.effects import design_forms
from rrr_oc.effects.words import listed, words
from rrr_oc.model.metrics import decrease
from rrr_oc.report.design_report import Quantity, of_joint
from rrr_oc.report.tables import spring_unit

AGREES = 0.01  # [1] of E1 by which MuJoCo may differ before the page warns; doubled, only errors of the model are told
OVER = 0.05  # [1] of a limit's scale by which it may be exceeded between the nodes before the page warns
FAR = 0.1  # [1] of E1 by which the calibrated twin may differ from the plan before the page warns
FOLLOWED = 0.05  # [rad] of tracking error in the twin above which the page warns
Summary = Mapping[str, Any]


def best_of(found: Mapping[str, Any], bought: bool = False) -> str | None:
    """The cheapest configuration whose springs do something, of all or of those with hardware of the catalogue; None without one."""
    some = [n for n, c in found.items() if c["springs"] and not does_nothing(c) and (n.endswith("*") or not bought)]
    return min(some, key=lambda name: found[name]["cost"], default=None)


def kinds_of_springs(names: Iterable[str]) -> list[tuple[str, str]]:
    """Of each kind of springs in some configurations its label and what it is, as a phrase."""
    labels = {label for name in names for label in name.rstrip("*").split("+")}
    return [(label, kind.design.words) for label, kind in design_forms().items() if label in labels]


def verdict(summary: Summary) -> str:
    """Which configuration is best, by how much, and what hardware that is."""
    found, quantity = summary["configurations"], Quantity(*summary["quantity"])
    best, bought, stiff = best_of(found), best_of(found, bought=True), found.get("SA")
    if best is None or (stiff is not None and stiff["cost"] < found[best]["cost"]):
        name, c = min(found.items(), key=lambda item: item[1]["cost"])
        some = (
            "no springs help this task"
            if any(c["springs"] for c in found.values())
            else "no configuration with springs was asked for"
        )
        return f"{name} costs {quantity.name} = {_cost(c, quantity)}; {some}."
    parts = [f"{best} is best: {_gain(found, best, quantity)}."]
    if bought is not None:
        parts.append(f"To buy for {bought}: {hardware(found[bought], summary['joints'])}.")
        parts += [f"Then {_gain(found, bought, quantity)}."] * (bought != best)
    else:
        tried = any("not_bought" in c for c in found.values())
        why = "no choice of the catalogue could be solved" if tried else "no catalogue of springs to buy was searched"
        parts.append(f"To be made: {hardware(found[best], summary['joints'])}; {why}.")
    return " ".join(parts)


def _cost(c: Mapping[str, Any], quantity: Quantity) -> str:
    return f"{c['cost']:.4g} {quantity.unit}"


def _gain(found: Mapping[str, Any], name: str, quantity: Quantity) -> str:
    c, stiff = found[name], found.get("SA")
    if stiff is None:
        return f"{quantity.name} is {_cost(c, quantity)}, without stiff actuation among the configurations to compare it with"
    less = 100 * decrease(c["cost"], stiff["cost"])
    return f"{quantity.name} is {_cost(c, quantity)}, {less:.1f} % less than the {_cost(stiff, quantity)} of stiff actuation"


def hardware(c: Mapping[str, Any], joints: Sequence[str]) -> str:
    """The springs of a design, in a designer's units."""
    left, said = dict(c["springs"]), []
    for n, joint in enumerate(joints, 1):
        if f"k_p{n}" in left and f"q_eq{n}" in left:
            stiffness, slack = _number("k_p", left.pop(f"k_p{n}")), _number("q_eq", left.pop(f"q_eq{n}"))
            said.append(f"a spring of {stiffness} on {joint}, slack at {slack}")
    if "k_b" in left:
        said.append(f"a spring of {_number('k_b', left.pop('k_b'))} across two joints")
    shown = ", ".join(f"{of_joint(name, joints)} = {_number(name, value)}" for name, value in left.items())
    mounted = c.get("mounted", {}).items()
    acting = [f"; the {placed(label)} acts in the phase “{ways['phase']}” only" for label, ways in mounted if "phase" in ways]
    return listed(said) + f" with {shown}" * bool(said and shown) + shown * (not said) + "".join(acting)


def in_twin(found: Mapping[str, Any], best: str) -> str:
    """What the best design needs in the calibrated twin, beside what was planned; "" without a twin."""
    twin = found[best].get("calibrated")
    if twin is None:
        return ""
    needed, stiff = twin["engine"]["E1"], (found.get("SA", {}).get("calibrated") or {}).get("engine")
    less = (
        ""
        if stiff is None or best == "SA"
        else f", {100 * decrease(needed, stiff['E1']):.1f} % less than stiff actuation there"
    )
    return f"In the twin {best} needs E1 = {needed:.4g} N²m²s{less}; {found[best]['E1']:.4g} N²m²s were planned."


def _number(name: str, value: float) -> str:
    _, factor, unit = spring_unit(name)
    return f"{value * factor:.4g}{'' if unit == '°' else ' '}{unit}"


def placed(label: str) -> str:
    """A spring's label in words: "parallel spring of joint2" for "parallel_spring[joint2]"."""
    name, _, joints = label.removesuffix("]").partition("[")
    return f"{words(name)} of {listed(joints.split(','))}"


def bound(sentence: str) -> str:
    """The sentence of an active bound with the names of springs and their parameters in words."""
    said = re.sub(r"(\w+\[[^\]]*\])\.(\w+)", lambda m: f"{words(m[2])} of the {placed(m[1])}", sentence)
    return f"{said[:1].upper()}{said[1:]}."


def symbols(found: Mapping[str, Any]) -> list[tuple[str, str]]:
    """What the symbols of the springs in a study mean."""
    used = {name for c in found.values() for name in c["springs"]}
    known = {
        "k_p": "stiffness of a spring in parallel with a joint",
        "q_eq": "angle of the joint at which that spring is slack",
        "k_t": "stiffness of a spring across one joint that pulls both ways",
        "q_t": "angle of the joint at which that spring is slack",
        "k_v": "stiffness of a cable's spring over a pulley at one joint",
        "q_v": "angle of the joint at which that cable is slack",
        "r1_v": "with r2_v to r5_v the radii of that pulley, whose profile is in a CSV file beside the results",
        "n_n": "number of springs in parallel, each as its table says, across one joint",
        "q_n": "angle of the joint at which the angle of that table is 0",
        "k_c": "stiffness of a spring that a clutch connects to one joint in one phase",
        "q_c": "angle of the joint at which that spring is slack, in the middle between start and release",
        "k_bc": "with q_0c and r_1c to r_3c a spring across two joints that a clutch connects in one phase, named as if always connected",
        "k_b": "stiffness of a spring across two joints",
        "q_0": "angle that sets where the spring across two joints is slack",
        "r_1": "radius of the pulley at the spring, which turns its stiffness into torque",
        "r_2": "radius of the pulley at the first of the two joints",
        "r_3": "radius of the pulley at the second of the two joints",
    }
    used |= {name.rstrip("0123456789") for name in used}  # those with the number of a joint
    return [(symbol, meaning) for symbol, meaning in known.items() if symbol in used]


def cautions(summary: Summary) -> list[str]:
    """What a reader should know before using the results, a sentence each; none where there is nothing."""
    found = summary["configurations"]
    said = [sentence for name, c in found.items() for sentence in _cautions(name, c)]
    best = best_of(found)
    if best is None or "catalogue" in found[best]:
        return said
    if found[best]["certificate"]["reached"] < 2:
        which = (
            "only one start led to this optimum"
            if found[best]["certificate"]["reached"]
            else "no start led to this optimum itself"
        )
        least = found[best]["certificate"]["least"]
        but = f", though none below {least:.4g} N²m²s" if least else ""
        said.append(f"{best}: {which}; more starts, or another seed, may find a better one{but}.")
    return said


def _cautions(name: str, c: Mapping[str, Any]) -> list[str]:
    k, said = c["certificate"], []
    said += [f"the {placed(label)} is {why}: it does nothing in this design" for label, why in c.get("idle", {}).items()]
    said += [f"the law of the {placed(label)} is {how}: beyond, it is a guess" for label, how in c.get("beyond", {}).items()]
    if not k["mesh"]["converged"]:
        said.append(f"the tolerance of the mesh was not met; the error between its nodes is {k['mesh']['error']:.1e}")
    differs = c["mujoco"]["E1"] / c["E1"] - 1
    if abs(differs) > AGREES:
        said.append(f"MuJoCo finds an E1 that is {100 * differs:+.1f} % away from the planned one")
    if k["violation"] > OVER:
        said.append(f"a limit is exceeded between the nodes by {100 * k['violation']:.0f} % of its scale")
    if k["second_order"] == "violated":
        said.append("the result is no local optimum: a condition of second order is violated")
    if c.get("interrupted"):
        said.append("the search was interrupted, so that fewer starts were made than asked for")
    if "not_bought" in c:
        said.append(f"no choice of the catalogue could be solved: {c['not_bought']}")
    if (twin := c.get("calibrated")) is not None:
        differs = twin["engine"]["E1"] / c["E1"] - 1
        if abs(differs) > FAR:
            said.append(f"in the calibrated twin E1 is {100 * differs:+.0f} % away from the planned one")
        if twin["saturated"]:
            said.append("in the calibrated twin a controller reaches its limit")
        if twin["tracking_error_rad"] > FOLLOWED:
            said.append(f"in the calibrated twin the motion is missed by up to {twin['tracking_error_rad']:.2f} rad")
    return [f"{name}: {sentence}." for sentence in said]
