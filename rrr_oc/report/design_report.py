"""A co-design study in tables and sections, made from its summary alone, and its report in Markdown."""

import math
from collections.abc import Iterator, Sequence

from rrr_oc.codesign.design_file import (
    ChoiceEntry,
    Compromise,
    Configuration,
    DesignFile,
    MetricsEntry,
    MovedEntry,
    QuantityEntry,
)
from rrr_oc.codesign.task import PHASES
from rrr_oc.model.metrics import decrease
from rrr_oc.report import design_words as say
from rrr_oc.report.sections import Passage, Section, as_markdown
from rrr_oc.report.tables import NONE, SPRINGS, Table, table_3, table_4

LOCAL_OPTIMA = "Distinct local optima (those not refined carry the error of their mesh):"
LAYERS = "What each layer contributed (coarse mesh):"
FRONT = (
    "The first row is the optimum of the set, the last has the springs of the first task alone; those between favour the first task more "
    "and more, and are on the first fine mesh."
)
CASES = "The same springs and the same motion in every scenario; the {} of a task is its cost."
FORESEEN = "The same springs and the same motion on every arm that the recordings behind the model allow."
AT_TIMES = (
    "Springs and motions where both phases together take a given time. The rows “balanced at rest” have springs of the same kinds that "
    "leave the least torque where the arm stands still on the straight way between start and release, as they would be chosen without "
    "an optimal motion; their motions are the best that were found."
)
AT_TIMES_NOTE = (
    "In brackets the decrease against SA at the same time. The search begins at the optimum's own time and goes from time to time; what it "
    "finds are local optima."
)
MOTORS = "What the motors do along the same motions, with their friction, the inertia of the rotors and the losses of the gears, at the joints:"
MOTORS_NOTE = (
    "The work is what the motors do; what flows back to them does not count. Decreases are against stiff actuation. E1 of the load torque "
    "leaves out all that motors pay for themselves."
)
LEFT_OPEN = (
    "A range holds 95 % of the draws from what is not known of the parameters and the links, of the calibrated model and of every other "
    "that the recordings do not tell from it."
)
ORDERS = (
    "An extension or compression spring is pulled by a cable on a pulley of that radius. Wire is music wire up to 6.5 mm and chrome-vanadium "
    "wire above; the coil is the mean diameter, the size the outside diameter and the greatest length in use, with hooks. The unloaded angle "
    "is that of the joint, or of the pulley r_1 of a cable across two joints; the deflection is counted from there. Tolerances are those of "
    "quality 2. A torsion spring would touch a rod of the diameter given. An extension spring is wound with the initial tension given, or "
    "with gaps and none, where its cable gets slack or carries little. Compression springs need a rod or a tube. The masses do not act on "
    "the arm."
)
MOTION = ("arm", "torque", "spring", "angle", "speed", "acceleration")  # figures of the page
CERTIFICATES = "Certificates"  # the title from which on the command shows no more


def report(study: DesignFile) -> str:
    """The whole report in Markdown."""
    said = [*say.minimised(study), f"Seed {study.seed}, {study.starts} starts a configuration, {study.wall_s:.0f} s."]
    parts = [f"# {say.title(study)}\n", " ".join(said) + "\n", say.verdict(study) + "\n"]
    parts += [f"**{sentence}**\n" for sentence in say.cautions(study)]
    return "\n".join([*parts, as_markdown(sections(study))])


def sections(study: DesignFile) -> list[Section]:
    """What a report says after its verdict; a section without parts is left out."""
    made = [
        Section("The motion and what the springs do", (Passage(figures=MOTION),)),
        Section("Optima", tuple(_optima(study))),
        Section("At equal cycle times", tuple(_at_times(study))),
        Section("Hardware and durations", (_hardware(study), *_mounted(study), *_postures(study))),
        Section("Springs to order", tuple(_orders(study))),
        Section("Which springs are worth their price", tuple(_choices(study))),
        Section("Between the set and its first task", tuple(_fronts(study))),
        Section("Scenarios", tuple(_scenarios(study))),
        Section("What the recordings leave open", tuple(_open(study))),
        Section(CERTIFICATES, tuple(_certificates(study))),
        Section("In the twin calibrated on recordings", tuple(_twin(study))),
    ]
    return [section for section in made if section.parts]


def _optima(study: DesignFile) -> Iterator[Passage]:
    yield Passage(table=optima_table(study), note=_notes(columns_in_words(study)))
    motors = motors_table(study)
    if motors is not None:
        yield Passage(said=(MOTORS,), table=motors, note=MOTORS_NOTE)
    if study.single and "SA" in study.configurations:
        beside = ", by joint: ours | paper (Table 3, simulation)" if study.paper else ", by joint"
        yield Passage(said=(f"Decrease against stiff actuation in percent{beside}.",), table=decrease_table(study))
    if not study.single:
        yield Passage(figures=("tasks",))
        for name, c in study.configurations.items():
            yield Passage(f"Every task with {name}", table=tasks_table(study, c), of=name)


def _at_times(study: DesignFile) -> Iterator[Passage]:
    table = cycle_times_table(study)
    if table is not None:
        yield Passage(said=(AT_TIMES,), table=table, note=AT_TIMES_NOTE, figures=("cycle_times",))


def _hardware(study: DesignFile) -> Passage:
    beside = ("Table 4, ours | paper:",) if study.paper else ()
    symbols = say.symbols(study.configurations)
    note = "; ".join(
        [f"{symbol}: {words}" for symbol, words in symbols] + ["t_go, t_return: durations with and without the payload."]
    )
    return Passage(said=beside, table=hardware_table(study), note=note if symbols else "")


def _mounted(study: DesignFile) -> Iterator[Passage]:
    for name, c in study.configurations.items():
        if c.mounted and c.catalogue is None:
            yield Passage(f"How the springs of {name} are mounted", points=tuple(say.mounts(c)), of=name)


def _orders(study: DesignFile) -> Iterator[Passage]:
    limits = study.tasks[0].spring_limits
    if limits is not None and any(c.parts for c in study.configurations.values()):
        yield Passage(said=(say.part_limits(limits),), note=ORDERS)
    for name, c in study.configurations.items():
        if c.parts:
            yield Passage(f"Springs of {name}", table=order_table(c), of=name)


def _postures(study: DesignFile) -> Iterator[Passage]:
    if any(None in (task.start, task.release) for task in study.tasks):
        yield Passage("Postures at start and release [°]", table=postures_table(study))


def _choices(study: DesignFile) -> Iterator[Passage]:
    some = {name: (c, c.choice) for name, c in study.configurations.items() if c.choice is not None}
    if some:
        yield Passage(figures=("choice",))
    for name, (c, made) in some.items():
        yield Passage(name, (say.choice(c, made, study.quantity.unit),), table=choice_table(made, study.quantity), of=name)


def _fronts(study: DesignFile) -> Iterator[Passage]:
    some = {name: c.front for name, c in study.configurations.items() if c.front}
    if some:
        yield Passage(figures=("front",))
    for name, points in some.items():
        yield Passage(name, (FRONT,), table=front_table(points, study), of=name)


def _scenarios(study: DesignFile) -> Iterator[Passage]:
    for name, c in study.configurations.items():
        if any(m.scenarios for m in c.tasks.values()):
            which = "mean" if study.uncertain.over == "mean" else "worst one"
            yield Passage(f"Scenarios of {name}", (CASES.format(which),), table=scenarios_table(c), of=name)


def _open(study: DesignFile) -> Iterator[Passage]:
    table = foreseen_table(study)
    if table is not None:
        yield Passage(said=(FORESEEN,), table=table, note=LEFT_OPEN)
    for name, c in study.configurations.items():
        if any(m.foreseen is not None and len(m.foreseen.members) > 1 for m in c.tasks.values()):
            yield Passage(f"Models that the recordings do not tell apart, with {name}", table=members_table(c), of=name)


def _certificates(study: DesignFile) -> Iterator[Passage]:
    if study.single and any(c.optima for c in study.configurations.values()):
        yield Passage(figures=tuple(f"starts_{phase}" for phase in PHASES))
    for name, c in study.configurations.items():
        yield Passage(f"Certificate of {name}", points=tuple(say.certificate(study, c)), of=name)
        if not study.single:
            yield Passage(said=("Of each motion, its springs held:",), table=motions_table(c), note=_notes(QUALITY), of=name)
        if study.single and c.first.certificate.active:
            bounds = tuple(say.bound(one.sentence) for one in c.first.certificate.active)
            yield Passage(said=("What limits it, the most costly bound first:",), points=bounds, of=name)
        if c.not_bought:
            yield Passage(said=(f"No choice of the catalogue could be solved: {c.not_bought}",), of=name)
        if c.catalogue is not None:
            yield Passage(said=(say.coverage(c.catalogue),), of=name)
        if c.optima:
            yield Passage(said=(LOCAL_OPTIMA,), table=local_optima_table(study, c), of=name)
        if c.layers:
            yield Passage(said=(LAYERS,), table=layers_table(c), of=name)


def _twin(study: DesignFile) -> Iterator[Passage]:
    table, best = transfer_table(study.configurations), say.best_of(study.configurations) or next(iter(study.configurations))
    if table is not None:
        needed = say.in_twin(study, best)
        yield Passage(said=(needed,) if needed else (), table=table, note=say.transferred(study))


LEAST_COST = 0.1  # from which three decimals are three digits
QUALITY = {
    "engine": "re-simulated in MuJoCo with feed-forward and P-controllers, load torque read from the engine.",
    "energy balance": "what it misses in MuJoCo, relative.",
    "mesh error": "between the nodes, relative.",
    "over limits": "the largest excess of a limit between the nodes, relative to its scale; meshes are refined for all limits.",
    "smoothing": "exact, non-smooth springs on the same motion against the smoothed ones.",
    "2nd order": "strict is sufficient for a local optimum; weak is less, some bound is touched with next to no multiplier.",
}  # columns on a motion
SHARED = {
    "alone": "with the best springs for each task alone that the search found.",
    "more than alone": "what sharing the springs costs.",
    "first's": "with the springs tuned to the first task alone, and the best motions for them.",
}  # columns on springs that several tasks share


def small_too(cost: float) -> str:
    """A cost with three decimals; of light arms, whose costs these would round away, with three digits."""
    return f"{cost:.3f}" if abs(cost) >= LEAST_COST or not cost else f"{cost:.3g}"


def _quality(m: MovedEntry) -> list[str]:
    """The cells of `QUALITY`."""
    k = m.certificate
    return [
        small_too(m.mujoco.E1),
        f"{m.mujoco.energy_residual:.1e}",
        f"{k.mesh.error:.1e}{'' if k.mesh.converged else ' (not met)'}",
        f"{k.violation:.0e}",
        f"{k.smoothing:.1e}",
        k.second_order,
    ]


def optima_table(study: DesignFile) -> Table:
    """A row for each configuration: the cost, where the motors are known also their squared torque, and of the paper's tasks the cost with the
    springs that it published."""
    known = study.single and all(c.first.motors is not None for c in study.configurations.values())
    of_load = study.quantity.name == say.MOTOR_TORQUE  # else of the motors
    beside = f"{'E1' if of_load else say.MOTOR_TORQUE} [N²m²s]"
    header = ["", study.quantity.title, "decrease", *([beside, "decrease"] if known else [])]
    header += ["published springs"] * study.paper
    header += [*(QUALITY if study.single else SHARED), "wall [s]"]
    rows = []
    for name, c in study.configurations.items():
        stiff = _stiff(study, name)
        cells = [name, small_too(c.cost), "springs do nothing" if c.does_nothing else fall(c.cost, stiff and stiff.cost)]
        if known:
            own, other = ((one and (one.first if of_load else one.first.motors)) for one in (c, stiff))
            cells += _with_decrease(own, other, "E1")
        if study.paper:
            cells.append("" if c.published_springs is None else f"{c.published_springs:.2f}")
        cells += _quality(c.first) if study.single else _compared(c)
        rows.append([*cells, f"{c.wall_s:.0f}"])
    return header, rows


def fall(own: float | None, stiff: float | None) -> str:
    """A decrease against stiff actuation; "" where there is none."""
    return "" if own is None or not stiff else f"{100 * decrease(own, stiff):.1f} %"


def _stiff(study: DesignFile, name: str) -> Configuration | None:
    """Stiff actuation, with which a configuration is compared; None where it is that itself, or was not asked for."""
    return None if name == "SA" else study.configurations.get("SA")


def _with_decrease(own: MetricsEntry | None, stiff: MetricsEntry | None, what: str) -> list[str]:
    """A figure of a motion, and its decrease against stiff actuation."""
    value = None if own is None else getattr(own, what)
    return [NONE if value is None else small_too(value), fall(value, stiff and getattr(stiff, what))]


def motors_table(study: DesignFile) -> Table | None:
    """Squared torque, RMS, peak, work and energy of the motors of one task; None where they are not known, and for several tasks."""
    moved = {name: c.first.motors for name, c in study.configurations.items()}
    known = {name: m for name, m in moved.items() if m is not None}
    if not study.single or not known:
        return None
    columns = {f"{say.MOTOR_TORQUE} [N²m²s]": "E1", "work [J]": "work_J"}
    if all(m.electrical_J is not None for m in known.values()):
        columns["electrical energy [J]"] = "electrical_J"
    header = ["", *(cell for title in columns for cell in (title, "decrease"))]
    rows = []
    for name, m in known.items():
        stiff = _stiff(study, name)
        cells = [cell for what in columns.values() for cell in _with_decrease(m, stiff and stiff.first.motors, what)]
        rows.append([name, *cells, *(", ".join(f"{x:.3g}" for x in by.values()) for by in (m.rms, m.peak))])
    return [*header, f"RMS of {', '.join(study.moving)} [Nm]", "peak [Nm]"], rows


def _compared(c: Configuration | MovedEntry) -> list[str]:
    """The cells of `SHARED`."""
    more = f"{100 * (c.cost / c.alone - 1):+.1f} %" if c.alone else NONE
    return [f"{c.alone:.3f}", more, f"{c.with_first:.3f}"]


def _notes(columns: dict[str, str]) -> str:
    return " ".join(f"“{name}”: {words}" for name, words in columns.items())


def columns_in_words(study: DesignFile) -> dict[str, str]:
    """What the columns of `optima_table` show, a sentence or two each."""
    published = {"published springs": "Table 4's hardware, its motion re-optimised on this model."} if study.paper else {}
    if not study.single:
        return published | SHARED
    return published | QUALITY | {"engine": study.quantity.engine + QUALITY["engine"]}


def tasks_table(study: DesignFile, c: Configuration) -> Table:
    """A row for each task of a configuration."""
    header = ["task", "weight", "payload [kg]", study.quantity.title, *SHARED, *(f"t_{phase} [s]" for phase in PHASES)]
    rows = []
    for task in study.tasks:
        m = c.tasks[task.name]
        cells = [task.name, f"{task.weight:g}", f"{task.payload_kg:g}", small_too(m.cost), *_compared(m)]
        rows.append([*cells, *(f"{m.durations[phase]:.3f}" for phase in PHASES)])
    return header, rows


def motions_table(c: Configuration) -> Table:
    """What is known of each task's motion, its springs held."""
    header = ["task", *QUALITY, "conditions", "re-integration", "tracking [rad]"]
    rows = []
    for task, m in c.tasks.items():
        more = (say.residual(m), m.certificate.reintegration.state, m.mujoco.tracking_error_rad)
        rows.append([task, *_quality(m), *(f"{value:.0e}" for value in more)])
    return header, rows


def decrease_table(study: DesignFile) -> Table:
    """Relative decreases of one task against stiff actuation [%], which must be among the configurations."""
    moved = {name: c.first for name, c in study.configurations.items()}
    ours = {name: [{"E1": m.E1, "E1_joint": m.E1_joint, "rms": m.rms, "peak": m.peak}] for name, m in moved.items()}
    return table_3(ours, list(moved["SA"].E1_joint), "E1", digits=1, beside=study.paper)


def hardware_table(study: DesignFile) -> Table:
    """Springs of each configuration, and durations of one task; of several tasks also the springs of the first alone."""
    shown: dict[str, dict[str, float]] = {}
    for name, c in study.configurations.items():
        shown[name] = c.springs
        if not study.single and c.springs and c.catalogue is None:
            shown[f"{name}, {study.tasks[0].name} alone"] = c.first.springs_alone
    used = {n for springs in shown.values() for n in springs}
    names = [n for n in SPRINGS if n in used] + sorted(used - set(SPRINGS))
    times = {name: list(c.first.durations.values()) for name, c in study.configurations.items()}
    ours = {name: [{"springs": springs, "durations": times.get(name, (0.0, 0.0))}] for name, springs in shown.items()}
    if study.paper:
        return table_4(ours, names, digits=3)
    header, rows = table_4(ours, names, 3, None, {name: say.of_joint(name, study.joints) for name in names})
    end = None if study.single else -len(PHASES)  # each task has durations of its own
    return header[:end], [row[:end] for row in rows]


def order_table(c: Configuration) -> Table:
    """The springs of a configuration as parts, in every way in which they can be made."""
    header = [
        "spring",
        "made as",
        "rate",
        "unloaded at",
        "deflection",
        "load",
        "energy [J]",
        "wire × coil [mm] × coils",
        "size [mm]",
    ]
    rows, before = [], ""
    for p in c.parts:
        named, before = "" if p.label == before else say.placed(p.label), p.label
        cells = [named, say.make(p), *say.of_load(p), f"{p.energy_J:.3g}"]
        wound = f"{1e3 * p.d_m:g} × {1e3 * p.D_m:.1f} × {p.coils:.2f}"
        size = f"{1e3 * p.outside_m:.0f} × {1e3 * p.length_m:.0f}"
        rows.append([*cells, wound, size, f"{p.mass_kg:.3f}", say.weakest(p), say.remarks(p)])
    return [*header, "mass [kg]", "safety", ""], rows


def postures_table(study: DesignFile) -> Table:
    """Angles of the moving joints at the ends of each motion [°]."""
    rows = []
    for label, _, m in _motions(study.configurations):
        for end in ("start", "release"):
            rows.append([label, end, *(f"{math.degrees(angle):.2f}" for angle in getattr(m, end).values())])
    return ["", "end", *study.moving], rows


def _motions(found: say.Found) -> Iterator[tuple[str, tuple[str, str], MovedEntry]]:
    """Each motion, with what its row is called, and its configuration and task."""
    for name, c in found.items():
        for task, m in c.tasks.items():
            yield (name if len(c.tasks) == 1 else f"{name}, {task}"), (name, task), m


def transfer_table(found: say.Found) -> Table | None:
    """E1 in the calibrated twin and its decrease against stiff actuation, by both load torques; None without a twin."""
    known = {of: (label, m.calibrated) for label, of, m in _motions(found) if m.calibrated is not None}
    if not known:
        return None
    rows, routes = [], ["engine"] + ["eq10"] * any(twin.eq10 is not None for _, twin in known.values())
    for (name, task), (label, twin) in known.items():
        cells, (_, stiff) = [label], known.get(("SA", task), ("", None))
        for route in routes:
            own, other = getattr(twin, route), None if stiff is None or name == "SA" else getattr(stiff, route)
            less = own and fall(own.E1, other and other.E1)
            cells += [NONE, NONE] if own is None else [f"{own.E1:.2f}", less]  # without the drives there is no other route
        cells += [", ".join(f"{v:.1f}" for v in twin.motor.rms.values()), f"{twin.tracking_error_rad:.4f}"]
        rows.append([*cells, "yes" if twin.saturated else "no"])
    heads = ["engine", "decrease", "from the motor torque", "decrease"][: 2 * len(routes)]
    return ["", *heads, "RMS motor torque [Nm]", "tracking [rad]", "at its limit"], rows


def local_optima_table(study: DesignFile, c: Configuration) -> Table:
    """The distinct local optima that a search found."""
    rows = [
        [
            small_too(o.cost),
            str(o.reached or "from others"),
            *(f"{o.durations[phase]:.3f}" for phase in PHASES),
            "yes" if o.refined else "no",
            say.spring_words(o.springs, study.joints),
        ]
        for o in c.optima
    ]
    return [study.quantity.title, "reached", *(f"t_{phase} [s]" for phase in PHASES), "refined", "hardware"], rows


def layers_table(c: Configuration) -> Table:
    """What each layer of a search contributed."""
    rows = []
    for name, layer in c.layers.items():
        numbers = ((layer.best_proposal, 1), (layer.best, 3), (layer.median, 3))
        cells = [NONE if value is None else f"{value:.{n}f}" for value, n in numbers]  # none where all starts failed
        rows.append([name, str(layer.starts), str(layer.failed), *cells])
    return ["layer", "starts", "failed", "best proposal", "best after IPOPT", "median after IPOPT"], rows


def cycle_times_table(study: DesignFile) -> Table | None:
    """Costs at the optimum's own cycle time and at equal ones, also of springs that balance the arm; None where nothing was compared."""
    found = {name: c for name, c in study.configurations.items() if c.at_cycle_times}
    if not found:
        return None
    times = [at.cycle_s for at in next(iter(found.values())).at_cycle_times]
    stiff = [at.cost for at in found["SA"].at_cycle_times] if "SA" in found else [None] * len(times)
    rows = []
    for name, c in found.items():
        own = sum(c.first.durations.values())
        rows.append(
            [name, *_at_each(c.cost, own, [at.cost for at in c.at_cycle_times], [None if name == "SA" else s for s in stiff])]
        )
        if c.balancing is not None:
            costs = [at.balancing for at in c.at_cycle_times]
            rows.append([f"{name}, balanced at rest", *_at_each(c.balancing.cost, c.balancing.cycle_s, costs, stiff)])
    return ["", "at its own cycle time", *(f"{seconds:.3g} s" for seconds in times)], rows


def _at_each(cost: float, own: float, costs: Sequence[float | None], stiff: Sequence[float | None]) -> list[str]:
    """A cost at its own cycle time [s], and those at others with their decrease against stiff actuation."""
    cells = [f"{small_too(cost)} ({own:.2f} s)"]
    for one, other in zip(costs, stiff, strict=True):
        less = fall(one, other)
        cells.append(NONE if one is None else small_too(one) + f" ({less})" * bool(less))
    return cells


def front_table(points: Sequence[Compromise], study: DesignFile) -> Table:
    """Optima between that of the set and that of the first task alone."""
    title = study.quantity.title
    rows = [[f"{p.share:.2f}", f"{p.first:.3f}", f"{p.total:.3f}", say.spring_words(p.springs, study.joints)] for p in points]
    return ["share of the first task", f"first task, {title}", f"set, {title}", "springs"], rows


def choice_table(choice: ChoiceEntry, quantity: QuantityEntry) -> Table:
    """The front of the number of springs: cost, cost with the price, and which springs."""
    rows = []
    for i, p in enumerate(choice.points):
        mark = " (chosen)" if i == choice.chosen else ""
        rows.append([f"{p.count}{mark}", f"{p.cost:.3f}", f"{p.priced:.3f}", say.springs_of(p)])
    return ["springs", quantity.title, f"with {choice.price:g} a spring", "which"], rows


def scenarios_table(c: Configuration) -> Table:
    """E1 of every task in every scenario, as planned and in MuJoCo; the worst of a task is its cost."""
    rows = []
    for task, m in c.tasks.items():
        for s in m.scenarios:
            known = s.says or ", ".join(f"{k.removeprefix('known ')} {v:.4g}" for k, v in s.parameters.items()) or NONE
            rows.append([task, f"{s.payload_kg:.3g}", known, small_too(s.E1), small_too(s.mujoco)])
    return ["task", "payload [kg]", "model", "E1 [N²m²s]", "MuJoCo"], rows


def foreseen_table(study: DesignFile) -> Table | None:
    """Ranges of E1, and of a cost that is another, of every motion; None without a calibrated model."""
    other, rows = study.quantity.name != "E1", []
    for label, _, m in _motions(study.configurations):
        if (f := m.foreseen) is not None:
            cells = [label, f"{m.E1:.3f}", say.ends(f.E1), say.ratio(f.E1)]
            rows.append([*cells, *([say.ends(f.cost), say.ratio(f.cost)] if other else []), f.narrowed_by or NONE])
    if not rows:
        return None
    more = [f"foreseen {study.quantity.title}", "upper over lower end"] if other else []
    return ["", "E1 planned [N²m²s]", "foreseen E1 [N²m²s]", "upper over lower end", *more, "narrowed by recording"], rows


def members_table(c: Configuration) -> Table:
    """Ranges of E1 of every motion on the arm as each model has it."""
    rows = []
    for task, m in c.tasks.items():
        for one in m.foreseen.members if m.foreseen is not None else ():
            rows.append([task, one.says, f"{one.E1_itself:.3f}", say.ends(one.E1), one.decided_by or NONE])
    return ["task", "the arm", "E1 [N²m²s]", "range of E1 [N²m²s]", "decided by recording"], rows
