"""A co-design study in sentences: the verdict, what is to be made or bought, what is known, and what to be careful about."""

import math
import re
from collections.abc import Iterable, Mapping, Sequence

from rrr_oc.codesign.design_file import (
    COMPARISON,
    Bought,
    ChoiceEntry,
    Configuration,
    DesignFile,
    Foreseen,
    MovedEntry,
    OfMotors,
    Priced,
    QuantityEntry,
)
from rrr_oc.codesign.design_problem import COSTS
from rrr_oc.codesign.parts.limits import SpringLimits
from rrr_oc.codesign.parts.order_list import Part
from rrr_oc.codesign.search.proposals import SearchOptions
from rrr_oc.codesign.transfer import uncalibrated
from rrr_oc.effects import design_forms
from rrr_oc.effects.words import joint_words, listed, words
from rrr_oc.model.metrics import decrease
from rrr_oc.report.tables import NONE, spring_unit

MANY = 3.0  # times the planned E1 from which it is told as that
MOTOR_TORQUE = COSTS["motor"].name
AGREES = 0.01  # [1] of E1 by which MuJoCo may differ before a reader is warned; doubled, only errors of the model are told
OVER = 0.05  # [1] of a limit's scale by which it may be exceeded between the nodes before a reader is warned
UNDER = 0.005  # [m] below the base's plane from which a reader is warned; doubled, motions a little deeper are not told
FAR = 0.1  # [1] of E1 by which the calibrated twin may differ from the plan before a reader is warned
FOLLOWED = 0.05  # [rad] of tracking error in the twin above which a reader is warned
UNDERCUT = 1e-5  # [1] of the cost by which a bound may have been undercut before it is said; doubled, less of IPOPT's tolerance is told
# of a search by default, and what it is; where there are fewer, a reader is warned
USUAL = {
    "starts": (SearchOptions.starts, "starts"),
    "motions": (SearchOptions.motions, "proposed motions"),
    "springs": (SearchOptions.springs, "springs tried with other motions"),
    "rounds": (SearchOptions.rounds, "rounds of motions"),
}
SECOND_ORDER = {
    "strict": "The second-order condition is strict, which is sufficient for a local optimum.",
    "weak": "The second-order condition is weak: some bound is touched with next to no multiplier, and a local optimum is not proved.",
    "violated": "The second-order condition is violated: some small change lowers the cost, so this is no local optimum.",
}
OBJECTIVES = {"sum": "the weighted sum of the tasks' costs", "worst": "the greatest of the tasks' weighted costs"}
TRANSFERRED = (
    "Each optimum tracked by P-controllers with the model's own torque as feed-forward; E1 [N²m²s], and its decrease against SA, of the "
    "load torque that the engine gives, and, where the drives' friction is given, of the one that follows from the motor torque."
)
Found = Mapping[str, Configuration]


def best_of(found: Found, bought: bool = False) -> str | None:
    """The cheapest configuration whose springs do something, of all or of those with hardware of the catalogue; None without one."""
    some = [n for n, c in found.items() if c.springs and not c.does_nothing and (n.endswith("*") or not bought)]
    return min(some, key=lambda name: found[name].cost, default=None)


def kinds_of_springs(names: Iterable[str]) -> list[tuple[str, str]]:
    """Of each kind of springs in some configurations its label and what it is, as a phrase."""
    labels = {label for name in names for label in name.rstrip("*").split("+")}
    return [(label, kind.design.words) for label, kind in design_forms().items() if label in labels]


def title(study: DesignFile) -> str:
    """What a study is of."""
    if study.single:
        return f"Springs and motion for task “{study.name}”"
    return f"One set of springs for {len(study.tasks)} tasks: “{study.name}”"


def minimised(study: DesignFile) -> list[str]:
    """What is minimised, over what is uncertain, and how the arm moves at the tasks' ends, a sentence each."""
    said, unsure = [f"The cost of a task is {study.cost}, {study.quantity.title}."], study.uncertain
    if not study.single:
        equal = ", all weights equal" if len({t.weight for t in study.tasks}) == 1 else ""
        said.append(f"Minimised is {OBJECTIVES[study.objective]}{equal}.")
    what = [f"payloads within ±{100 * unsure.payload:g} %"] if unsure.payload else []
    what += [f"{name} in its 95 % interval" for name in unsure.model]
    if what:
        said.append(f"The cost of a task is that of the worst case of {listed(what)}, with the same motion in all cases.")
    if unsure.over != "calibrated":
        said.append(f"Minimised is its {unsure.over} over the models that the recordings allow, with the same motion in all.")
    return [*said, *ends_in_words(study), *rules(study)]


def rules(study: DesignFile) -> list[str]:
    """What the motions may do, a sentence each: floor, keep-outs, and whether accelerations may jump."""
    said, own = list[str](), " as in the paper" * study.paper
    floors = {task.floor_m for task in study.tasks}
    if floors == {None}:
        said.append(f"No floor keeps links and tool above the base's plane{own}.")
    elif None not in floors:
        heights = ", ".join(f"{floor:g} m" for floor in sorted(floor for floor in floors if floor is not None))
        said.append(f"Links and tool stay above a floor at {heights}.")
    names = list(dict.fromkeys(one.name for task in study.tasks for one in task.keep_outs))
    if names:
        said.append(f"They keep out of {listed(names)}.")
    points = [point for task in study.tasks for point in task.via]
    passed = dict.fromkeys(f"at {100 * point.time_share:.0f} % of “{point.phase}”" for point in points)
    if passed:
        said.append(f"The arm passes given points {listed([*passed])}.")
    jerks = [limit.jerk_rad_per_s3 for task in study.tasks for limit in task.limits.values()]
    if jerks and None not in jerks:
        said.append("The jerk is limited, so that accelerations do not jump, and are 0 where the arm rests between the phases.")
    elif jerks:
        said.append(f"Accelerations may jump, also where a phase begins and ends{own}.")
    return said


def ends_in_words(study: DesignFile) -> list[str]:
    """What a reader should know of tasks whose ends are not both at rest, a sentence each."""
    told = {
        "moving": "The arm does not stop at the {}: its speed there is the same at the end of one phase as at the start of the next.",
        "free": "The speed at the {} is free at the end of one phase and at the start of the next, and may jump between them.",
    }
    speeds = [item for task in study.tasks for item in task.speeds.items()]
    said = list(dict.fromkeys(told[speed].format(end) for end, speed in speeds if speed in told))
    free = [end for end in ("start", "release") if any(getattr(task, end) is None for task in study.tasks)]
    if free:
        said.append(
            f"The posture at {listed([f'the {end}' for end in free])} is free, and designed with the motion: the tool is held there."
        )
    return said + [
        "No bound over all motions is stated: its proof needs an arm that rests in known postures at both ends."
    ] * bool(said)


def verdict(study: DesignFile) -> str:
    """Which configuration is best, by how much, what hardware that is, and what it costs that tasks share it."""
    found, quantity = study.configurations, study.quantity
    best, bought, stiff = best_of(found), best_of(found, bought=True), found.get("SA")
    if best is None or (stiff is not None and stiff.cost < found[best].cost):
        name, c = min(found.items(), key=lambda item: item[1].cost)
        some = "no configuration with springs was asked for"
        if left := [n for n in study.unfinished if n not in ("SA", COMPARISON)]:
            some = f"the study was ended before {listed(left)} {'were' if len(left) > 1 else 'was'} designed"
        if any(c.springs for c in found.values()):
            some = f"no springs help {'this task' if study.single else 'these tasks'}"
        return f"{name} costs {quantity.name} = {_cost(c, quantity)}; {some}."
    parts = [f"{best} is best: {_gain(study, best)}."]
    parts += _of_motors(study, best)
    if not study.single:
        parts.append(_shared(study, found[best]))
    if bought is not None:
        parts.append(f"To buy for {bought}: {hardware(found[bought], study.joints)}.")
        parts += [f"Then {_gain(study, bought)}."] * (bought != best)
    else:
        tried = any(c.not_bought for c in found.values())
        why = "no choice of the catalogue could be solved" if tried else "no catalogue of springs to buy was searched"
        parts.append(f"To be made: {hardware(found[best], study.joints)}; {why}.")
    return " ".join(parts)


def _of_motors(study: DesignFile, name: str) -> list[str]:
    """What a design saves of what the motors do, a sentence; none where these, or stiff actuation, are not among what is known."""
    stiff, own = study.configurations.get("SA"), study.configurations[name].first.motors
    other = None if stiff is None else stiff.first.motors
    if not study.single or own is None or other is None:
        return []
    pairs = [(MOTOR_TORQUE, own.E1, other.E1), ("work", own.work_J, other.work_J), ("peak torque", *_peaks(own, other))]
    pairs = [pair for pair in pairs if pair[0] != study.quantity.name]
    said = [f"{abs(share):.1f} % {'less' if share >= 0 else 'more'} {what}" for what, share in _shares(pairs)]
    return [f"Of the motors themselves, with their friction, rotors and gears, that is {listed(said)}."]


def _peaks(own: OfMotors, other: OfMotors) -> tuple[float, float]:
    """Peak torques of the joint at which the stiff arm's is the greatest."""
    joint = max(other.peak, key=lambda j: other.peak[j])
    return own.peak[joint], other.peak[joint]


def _shares(pairs: Iterable[tuple[str, float, float]]) -> list[tuple[str, float]]:
    return [(what, 100 * float(decrease(own, other))) for what, own, other in pairs if other]


def _cost(c: Configuration, quantity: QuantityEntry) -> str:
    return f"{c.cost:.4g} {quantity.unit}"


def _gain(study: DesignFile, name: str) -> str:
    quantity, c, stiff = study.quantity, study.configurations[name], study.configurations.get("SA")
    what = "" if study.single else " in the worst task" if study.objective == "worst" else " for all tasks together"
    said = f"{quantity.name} is {_cost(c, quantity)}{what}"
    if stiff is None:
        return f"{said}, without stiff actuation among the configurations to compare it with"
    said = f"{said}, {100 * decrease(c.cost, stiff.cost):.1f} % less than the {_cost(stiff, quantity)} of stiff actuation"
    return said + _at_its_time(c, stiff)


def _at_its_time(c: Configuration, stiff: Configuration) -> str:
    """By how much a design is better than stiff actuation in the same cycle time; "" where that was not compared."""
    own, other = (sum(one.first.durations.values()) for one in (c, stiff))
    known = {at.cycle_s: at.cost for at in stiff.at_cycle_times}
    pairs = [(at.cycle_s, at.cost, known.get(at.cycle_s)) for at in c.at_cycle_times]  # none of hardware that is bought
    shares = {seconds: 100 * decrease(a, b) for seconds, a, b in pairs if a is not None and b is not None}
    if not shares:
        return ""
    times, (least, most) = list(shares), (min(shares.values()), max(shares.values()))
    span = f"{times[0]:.3g} s" if len(times) == 1 else f"{times[0]:.3g} to {times[-1]:.3g} s"
    said = f"{least:.1f} %" if most - least < 0.05 else f"{least:.1f} to {most:.1f} %"
    return f", though in {own:.3g} s in the place of {other:.3g} s; where both take equally long, {span}, it is {said}"


def _shared(study: DesignFile, c: Configuration) -> str:
    """What sharing the springs costs, and what those of the first task would cost."""
    said = f"Springs of its own for each task would need {100 * (1 - c.alone / c.cost):.1f} % less"
    return f"{said}; the springs of “{study.tasks[0].name}” need {100 * (c.with_first / c.cost - 1):.1f} % more."


def of_joint(name: str, joints: Sequence[str]) -> str:
    """A spring's quantity with the joint's own name in place of its number, as in "k_p of elbow"; one across joints as it is."""
    symbol = name.rstrip("0123456789")
    number = name.removeprefix(symbol)
    return f"{symbol} of {joint_words(joints[int(number) - 1])}" if number and not symbol.endswith("_") else name


def hardware(c: Configuration, joints: Sequence[str]) -> str:
    """The springs of a design, in a designer's units."""
    left, said = dict(c.springs), []
    for n, joint in enumerate(joints, 1):
        if f"k_p{n}" in left and f"q_eq{n}" in left:
            stiffness, unloaded = _number("k_p", left.pop(f"k_p{n}")), _number("q_eq", left.pop(f"q_eq{n}"))
            said.append(f"a spring of {stiffness} on {joint}, unloaded at {unloaded}")
    if "k_b" in left:
        said.append(f"a spring of {_number('k_b', left.pop('k_b'))} across two joints")
    shown = spring_words(left, joints)
    phased = ((label, ways["phase"]) for label, ways in c.mounted.items() if "phase" in ways)
    acting = [f"; the {placed(label)} acts in the phase “{phase}” only" for label, phase in phased]
    return listed(said) + f" with {shown}" * bool(said and shown) + shown * (not said) + "".join(acting)


def spring_words(springs: Mapping[str, float], joints: Sequence[str]) -> str:
    """Quantities of springs with their joints, in a designer's units."""
    return ", ".join(f"{of_joint(name, joints)} = {_number(name, value)}" for name, value in springs.items())


def _number(name: str, value: float) -> str:
    _, factor, unit = spring_unit(name)
    return f"{value * factor:.4g}{'' if unit == '°' else ' '}{unit}"


def placed(label: str) -> str:
    """A spring's label in words: "parallel spring of joint2" for "parallel_spring[joint2]"."""
    name, joints = _parted(label)
    return f"{words(name)} of {listed(joints)}"


def _parted(label: str) -> tuple[str, list[str]]:
    """A spring's name and its joints, from its label."""
    name, _, joints = label.removesuffix("]").partition("[")
    return name, joints.split(",")


def mounts(c: Configuration) -> list[str]:
    """How each spring of a design is mounted, so that it can be built: where it acts, and where it pulls; a sentence each."""
    told = []
    for label, ways in c.mounted.items():
        joints = [joint_words(joint) for joint in _parted(label)[1]]
        said = [f"in the phase “{ways.get('phase')}” only"] * ("phase" in ways)
        if "active" in ways:
            sign, where = (1, "below") if ways["active"] == "below" else (-1, "above")
            said.append(
                f"where {joints[0]} is {where} the angle at which it is unloaded; there it turns {_turned(joints, [sign])}"
            )
        if "winding" in ways:
            said.append(f"while its cable is taut; then it turns {_turned(joints, ways['winding'])}")
        others = [f"with {words(key)} {value}" for key, value in ways.items() if key not in ("phase", "active", "winding")]
        if said or others:
            told.append(f"The {placed(label)} acts {', '.join([*said, *others])}.")
        if "winding" in ways:
            turn = " ".join(
                f"{'−' if w > 0 else '+'} r_{i} {joint}"
                for i, (joint, w) in enumerate(zip(joints, ways["winding"], strict=True), 2)
            )
            told[-1] += f" Where these joints are at 0, its pulley r_1 is at 0, too; else at ({turn})/r_1."
    return told


def part_limits(limits: SpringLimits) -> str:
    """Within what springs as parts are worked out."""
    return (
        f"Each spring as a part, in every way to make it, the lightest that can be built first. The wire has a safety of {limits.safety:g} or "
        f"more against a permanent set and over {limits.cycles:g} cycles. A spring is at most {limits.outside_mm:g} mm wide and "
        f"{limits.length_mm:g} mm long in use, and its coil {limits.index[0]:g} to {limits.index[1]:g} times as wide as its wire."
        f"{_of_design(limits)}"
    )


def _of_design(limits: SpringLimits) -> str:
    """What of the springs was limited while they were designed."""
    told = {
        "torque_Nm": "a torque of {:g} Nm",
        "turn_deg": "a turn of {:g}°",
        "force_N": "a cable force of {:g} N",
        "energy_J": "{:g} J",
    }
    some = [told[key].format(value) for key, value in limits.of_design.items()]
    return f" Limits of the design were {listed(some)}." if some else ""


def make(part: Part) -> str:
    """How a spring is made and mounted."""
    return part.make if part.pulley_m is None else f"{part.make}, pulley {1e3 * part.pulley_m:.3g} mm"


def of_load(part: Part) -> list[str]:
    """Rate, angle at which a spring is unloaded, deflection in use and load of a part, the first two with their tolerances."""
    off = math.degrees(part.rest_tolerance / (part.pulley_m or 1.0))
    unloaded = f"{math.degrees(part.slack_rad):.1f} ± {off:.0f}°"
    if part.pulley_m is None:
        rate, deflection, load = (
            f"{part.rate:.4g}",
            [math.degrees(x) for x in (part.least, part.greatest)],
            f"{part.load:.3g} Nm",
        )
        units = "Nm/rad", "°"
    else:
        rate, deflection, load = f"{part.rate / 1e3:.4g}", [1e3 * x for x in (part.least, part.greatest)], f"{part.load:.4g} N"
        units = "N/mm", " mm"
    low, high = deflection
    return [f"{rate} {units[0]} ± {100 * part.rate_tolerance:.1f} %", unloaded, f"{low:.1f} … {high:.1f}{units[1]}", load]


def weakest(part: Part) -> str:
    """The least safety of a part, and of what."""
    return f"{part.safety:.2f} ({min(part.safeties, key=lambda one: part.safeties[one])})"


def remarks(part: Part) -> str:
    """What else a maker needs to know of a part, or why it cannot be built."""
    if part.why_not:
        return f"cannot be built: {listed(part.why_not)}"
    if part.rod_m is not None:
        return f"rod below {1e3 * part.rod_m:.0f} mm"
    if part.initial_tension_N is None:
        return "closed, ground ends"
    return f"wound with {part.initial_tension_N:.3g} N" if part.initial_tension_N else "wound with gaps"


def _turned(joints: Sequence[str], signs: Sequence[int]) -> str:
    towards = {1: "larger", -1: "smaller"}
    return listed([f"{joint} towards {towards[sign]} angles" for joint, sign in zip(joints, signs, strict=True)])


def bound(sentence: str) -> str:
    """The sentence of an active bound with the names of springs and their parameters in words."""
    said = re.sub(r"(\w+\[[^\]]*\])\.(\w+)", lambda m: f"{words(m[2])} of the {placed(m[1])}", sentence)
    said = re.sub(r"\w+\[[^\]]*\]", lambda m: placed(m[0]), said)
    return f"{said[:1].upper()}{said[1:]}."


def in_twin(study: DesignFile, best: str) -> str:
    """What the best design of one task needs in the calibrated twin, beside what was planned; "" without a twin."""
    found = study.configurations
    moved, stiff = found[best].first, found["SA"].first.calibrated if "SA" in found else None
    if moved.calibrated is None or not study.single:
        return ""
    needed = moved.calibrated.engine.E1
    less = (
        ""
        if stiff is None or best == "SA"
        else f", {100 * decrease(needed, stiff.engine.E1):.1f} % less than stiff actuation there"
    )
    return f"In the twin {best} needs E1 = {needed:.4g} N²m²s{less}; {moved.E1:.4g} N²m²s were planned."


def transferred(study: DesignFile) -> str:
    """How optima were tracked in the calibrated twin, and which joints no recording says anything of."""
    some = (m.calibrated.uncalibrated for c in study.configurations.values() for m in c.tasks.values() if m.calibrated)
    unknown = next(some, ())
    return TRANSFERRED + (f" Beware: {uncalibrated(unknown)}." if unknown else "")


def certificate(study: DesignFile, c: Configuration) -> list[str]:
    """What is known of a result, a sentence or two on each subject."""
    return of_motion(c, c.first, study.quantity) if study.single else of_set(c)


def of_motion(c: Configuration, m: MovedEntry, quantity: QuantityEntry) -> list[str]:
    """What is known of springs and motion of one task."""
    k = m.certificate
    met = "within the tolerance" if k.mesh.converged else "more than the tolerance, which was not met"
    return [
        f"The first-order conditions of an optimum hold to {residual(m):.1e} (the largest of the primal, dual and complementarity "
        f"residuals, scaled).",
        f"{SECOND_ORDER[k.second_order]} The cost is flattest along {' and '.join(k.flattest)}, with a curvature of {k.curvature:.1e}.",
        f"Between the nodes of the mesh the motion misses the dynamics by at most {k.mesh.error:.1e} (relative), {met}, and "
        f"exceeds limits by at most {k.violation:.1e} of their scale.",
        f"With exact springs in the place of smoothed ones, {quantity.name} of this motion is {k.exact_cost:.4f} {quantity.unit}, "
        f"{k.smoothing:.1e} away (relative).",
        f"An adaptive integrator run with the same controls ends {k.reintegration.state:.1e} away from the planned end, with a "
        f"cost that differs by {k.reintegration.cost:.1e}.",
        f"MuJoCo, which simulates the motion with the same springs and P-controllers, finds an E1 of {m.mujoco.E1:.4f} N²m²s, "
        f"and follows the motion to {m.mujoco.tracking_error_rad:.1e} rad.",
        *bounds_in_words(c),
        f"The lowest point of the tool is {_height(m.lowest_tool_m)}"
        + (f", that of the links {_height(m.lowest_link_m)}." if m.lowest_link_m is not None else "."),
        _origin(c),
        f"One more kg of payload changes the cost by {100 * k.sensitivity:+.1f} % of {quantity.name}.",
    ]


def _height(metres: float) -> str:
    level = f"{abs(metres):.3f}"
    return "level with the base" if float(level) == 0 else f"{level} m {'below' if metres < 0 else 'above'} the base"


def residual(m: MovedEntry) -> float:
    """The largest residual of the first-order conditions."""
    return max(m.certificate.primal, m.certificate.dual, m.certificate.complementarity)


def of_set(c: Configuration) -> list[str]:
    """What is known of springs that several tasks share."""
    if not c.springs:
        return ["Without springs nothing is shared: every task is solved by itself."]
    worst = max((m.certificate.second_order for m in c.tasks.values()), key=list(SECOND_ORDER).index)
    again = "On the refined meshes, springs and motions together could not be solved once more; only the motions were."
    if c.change is not None:
        fell = f"fell by {c.change:.1e} (relative)" if c.change else "fell no further"
        again = f"Springs and motions were solved once more on the refined meshes, and the objective {fell}."
    began = f"All tasks were solved together from {sum(layer.starts for layer in c.layers.values())} starts."
    if not c.layers:
        began = "The springs were chosen by their price; the search began at the stiff arm alone." if c.choice else _origin(c)
    return [
        began,
        again,
        f"No springs can bring the set below {c.alone:.3f}, the objective of the springs tuned to each task alone, if those optima are "
        "the best ones.",
        "Of the motions with the springs held: " + SECOND_ORDER[worst],
    ]


def bounds_in_words(c: Configuration) -> list[str]:
    """What no springs can be better than, on the motion of the design and on any, a sentence each; none where that is not known."""
    bound, least = c.first.certificate.bound, c.first.certificate.least
    said, which = [], "in the catalogue or not" if c.catalogue is not None else "of any size within the task's bounds"
    if bound is not None and not c.springs:
        said.append("On this motion there are no springs to choose.")
    elif bound is not None and bound.excess is None:
        said.append("How good the springs are on this motion is not known: several in one place, mixed, could give all torque.")
    elif bound is not None and bound.excess is not None:
        above = max(bound.excess, 0.0)
        doubt = min(bound.mixture / bound.lower - 1, above)
        said.append(
            f"On this motion no springs of these kinds, {which}, reach an E1 below {bound.lower:.4g} N²m²s; this design is "
            f"{100 * above:.2g} % above, of which up to {100 * doubt:.2g} % is the tolerance of this bound."
        )
    if least:
        every = (
            f"no motion of the task and no springs of these kinds, {which}, reach"
            if c.springs
            else "no motion of the task reaches"
        )
        share = f"{100 * least / c.first.E1:.0f} % of this design's"
        said.append(f"It is proved that {every} an E1 below {least:.4g} N²m²s, {share}.")
    return said


def _origin(c: Configuration) -> str:
    """Where an optimum comes from."""
    if c.catalogue is not None:
        return "Found by following the continuous optimum to this hardware."
    reached = c.first.certificate.reached
    if c.choice is not None:
        return "Found from the choice of springs by their price."
    if reached == 0:
        said = "No start led to it: it was found from other optima, by other motions for their springs."
    else:
        said = "One start led to it." if reached == 1 else f"{reached} independent starts led to it."
    return f"{said} {_covered(c)}".strip()


def _covered(c: Configuration) -> str:
    """What the search has solved; "" where that is not known."""
    starts, found = sum(layer.starts for layer in c.layers.values()), c.covered
    if found is None or not starts:
        return ""
    if not found.motions:
        return f"Solved were {starts} starts, and no motions for held springs."
    return (
        f"Solved were {starts} starts, and {found.motions} motions for {found.springs} different springs, {found.swings} of them with a "
        "turn to and fro more or less than others."
    )


def coverage(cover: Bought) -> str:
    """What of a catalogue was searched, and what was not."""
    text = f"Catalogue: {cover.combinations} combinations, {cover.distinct} distinct. Branch and bound solved {cover.solved} "
    text += f"problems, {cover.single} of them with the hardware held"
    if cover.margin is not None:
        text += f", and excluded the other {cover.excluded}: by their bounds they cost at least {100 * cover.margin:.1f} % more than "
        text += "the best. These bounds hold as far as each local optimum is the global one of its problem"
    if cover.undercut > UNDERCUT:
        text += f"; one was not, by {100 * cover.undercut:.1g} %"
    text += ". "
    if cover.failed:
        text += f"{cover.failed} could not be solved. "
    if cover.left:
        text += f"The search ended early, with {cover.left} left. "
    return text + f"Cost of buying instead of making: {round(100 * cover.gap, 1) + 0.0:+.1f} % against the continuous optimum."


def choice(c: Configuration, made: ChoiceEntry, unit: str) -> str:
    """Which number of springs is best at the price, and how far the front can be trusted."""
    best = made.points[made.chosen]
    which = f": {springs_of(best)}" if best.count else ""
    return (
        f"At a price of {made.price:g} {unit} a spring, {best.count} of {made.offered} springs are best{which}. "
        f"{made.solved} sets of springs were solved with their motions, each to a local optimum on the first fine mesh; so no cost in this "
        "table is proven to be the least. A number of springs that is missing did not cost less than fewer. "
        f"Refined, and searched for better motions, the chosen springs cost {c.cost:.4g} {unit}."
    )


def springs_of(point: Priced) -> str:
    """The springs of a point of the front and how each is mounted."""
    named = []
    for label, ways in point.mounted.items():
        kind, joints = _parted(label)
        shown = [" ".join(f"{v:+d}" for v in way) if isinstance(way, list) else str(way) for way in ways.values()]
        where = f"{'across' if len(joints) > 1 else 'on'} {' and '.join(joints)}"
        named.append(f"{words(kind.removesuffix('_spring'))} {where}" + (f" ({', '.join(shown)})" if shown else ""))
    return ", ".join(named) or NONE


def symbols(found: Found) -> list[tuple[str, str]]:
    """What the symbols of the springs in a study mean."""
    used = {name for c in found.values() for name in c.springs}
    known = {
        "k_p": "stiffness of a spring in parallel with a joint",
        "q_eq": "angle of the joint at which that spring is unloaded",
        "k_t": "stiffness of a spring across one joint that pulls both ways",
        "q_t": "angle of the joint at which that spring is unloaded",
        "k_v": "stiffness of a cable's spring over a pulley at one joint",
        "q_v": "angle of the joint at which that cable is unloaded",
        "r1_v": "with r2_v to r5_v the radii of that pulley, whose profile is in a CSV file beside the results",
        "n_n": "number of springs in parallel, each as its table says, across one joint",
        "q_n": "angle of the joint at which the angle of that table is 0",
        "k_c": "stiffness of a spring that a clutch connects to one joint in one phase",
        "q_c": "angle of the joint at which that spring is unloaded, in the middle between start and release",
        "k_bc": "with q_0c and r_1c to r_3c a spring across two joints that a clutch connects in one phase, named as if always connected",
        "k_b": "stiffness of a spring across two joints",
        "q_0": "angle that sets where the spring across two joints is unloaded",
        "r_1": "radius of the pulley at the spring, which turns its stiffness into torque",
        "r_2": "radius of the pulley at the first of the two joints",
        "r_3": "radius of the pulley at the second of the two joints",
    }
    used |= {name.rstrip("0123456789") for name in used}  # those with the number of a joint
    return [(symbol, meaning) for symbol, meaning in known.items() if symbol in used]


def cautions(study: DesignFile) -> list[str]:
    """What a reader should know before using the results, a sentence each; none where there is nothing."""
    found = study.configurations
    said = [f"Unfinished: {listed(study.unfinished)}. The same command goes on with it."] if study.unfinished else []
    said += [f"{name}: {sentence}." for name, c in found.items() for sentence in _of_configuration(c)]
    fewer = [
        f"{study.options[key]} {what} in the place of {n}" for key, (n, what) in USUAL.items() if study.options.get(key, n) < n
    ]
    if fewer:
        said.append(f"The search was small, with {listed(fewer)}; a longer one may find designs that need some per cent less.")
    said += _below(study)
    best = best_of(found)
    if best is None or found[best].catalogue is not None or found[best].choice is not None or not study.single:
        return said
    k = found[best].first.certificate
    if k.reached < 2:
        which = "only one start led to this optimum" if k.reached else "no start led to this optimum itself"
        but = f", though none below {k.least:.4g} N²m²s" if k.least else ""
        said.append(f"{best}: {which}; more starts, or another seed, may find a better one{but}.")
    return said


def _below(study: DesignFile) -> list[str]:
    """That motions without a floor pass below the base's plane, and how far the deepest does."""
    free = {task.name for task in study.tasks if task.floor_m is None}
    depths = [
        (m.lowest_link_m, name)
        for name, c in study.configurations.items()
        for task, m in c.tasks.items()
        if task in free and m.lowest_link_m is not None and m.lowest_link_m < -UNDER
    ]
    if not depths:
        return []
    depth, name = min(depths)
    names = listed(list(dict.fromkeys(name for _, name in depths)))
    passes = "motions of" if len(depths) > 1 else "motion of"
    return [
        f"The {passes} {names} go{'es' * (len(depths) == 1)} below the base's plane, by up to {-depth:.2f} m ({name}); floor_m in the task "
        "keeps links and tool above it."
    ]


def _of_configuration(c: Configuration) -> list[str]:
    single = len(c.tasks) == 1
    idle = [label for label in c.mounted if all(label in m.idle for m in c.tasks.values())]
    why = "it does nothing in this design" if single else "it does nothing in any task"
    said = [f"the {placed(label)} is {c.first.idle[label]}: {why}" for label in idle]
    said += ["the search was interrupted, so that fewer starts were made than asked for"] * c.interrupted
    said += [f"no choice of the catalogue could be solved: {c.not_bought}"] * bool(c.not_bought)
    for task, m in c.tasks.items():
        where = "" if single else f"in task {task} "
        said += [where + sentence for sentence in _of_motion(m)]
    return said


def _away(differs: float, decimals: int, tracking_error: float) -> str:
    """A relative difference from what was planned; of what is many times that, how many, and whether the arm follows the motion there,
    which it misses by a greatest angle [rad]."""
    if differs + 1 > MANY:
        why = "the arm does not follow the motion there"
        if tracking_error <= FOLLOWED:
            why = "the arm follows the motion, but beside so little planned torque even its small deviations count"
        return f"{1 + differs:.3g} times the planned one: {why}"
    return f"{100 * differs:+.{decimals}f} % away from the planned one"


def _of_motion(m: MovedEntry) -> list[str]:
    k = m.certificate
    said = [f"the law of the {placed(label)} is {how}: beyond, it is a guess" for label, how in m.beyond.items()]
    if not k.mesh.converged:
        said.append(f"the tolerance of the mesh was not met; the error between its nodes is {k.mesh.error:.1e}")
    differs = 0.0 if m.scenarios else m.mujoco.E1 / m.E1 - 1
    if abs(differs) > AGREES:
        said.append(f"MuJoCo finds an E1 that is {_away(differs, 1, m.mujoco.tracking_error_rad)}")
    if k.violation > OVER:
        said.append(f"a limit is exceeded between the nodes by {100 * k.violation:.0f} % of its scale")
    if k.second_order == "violated":
        said.append("the result is no local optimum: a condition of second order is violated")
    if (twin := m.calibrated) is not None:
        differs = twin.engine.E1 / m.E1 - 1
        if abs(differs) > FAR:
            said.append(f"in the calibrated twin E1 is {_away(differs, 0, twin.tracking_error_rad)}")
        if twin.saturated:
            said.append("in the calibrated twin a controller reaches its limit")
        if twin.tracking_error_rad > FOLLOWED:
            said.append(f"in the calibrated twin the motion is missed by up to {twin.tracking_error_rad:.2f} rad")
    if m.foreseen is not None and m.foreseen.widened_by is not None:
        said.append(left_open(m.foreseen))
    return said


def left_open(f: Foreseen) -> str:
    """That a range is wide, why, and which recording would narrow it."""
    said = f"the recordings leave the cost open between {ends(f.cost)}, by a factor of {ratio(f.cost)}"
    alone = f.widened_by == f.members[0].says
    if f.narrowed_by is None:
        return f"{said}: {f.widened_by} shows the same torques, and the zero of a sensor, or parts taken apart, have to tell"
    return f"{said}{'' if alone else f' ({f.widened_by})'}; the motion of {f.narrowed_by}, recorded, would narrow that"


def ends(interval: tuple[float, float]) -> str:
    """The ends of a range."""
    return f"{interval[0]:.4g} and {interval[1]:.4g}"


def ratio(interval: tuple[float, float]) -> str:
    """The upper end of a range over its lower one."""
    return f"{interval[1] / interval[0]:.2f}" if interval[0] > 0 else NONE
