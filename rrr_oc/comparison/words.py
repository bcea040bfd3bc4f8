"""Comparisons as people read them: rows of tables, and sentences."""

from collections.abc import Mapping

from rrr_oc.codesign.design_file import DesignFile
from rrr_oc.comparison.designs import Pair
from rrr_oc.comparison.models import LEVEL, Alone, Change, Compared
from rrr_oc.effects.words import NORMAL, Number, joint_words, listed, rounded, words
from rrr_oc.report.diagnosis_words import DEGREES, called
from rrr_oc.report.tables import spring_unit

Both = tuple[float | None, float | None]
CHANGES = ["what", "joint", "parameter", "A", "B", "B − A", "in standard errors", ""]
ELSEWHERE = {
    "rival": "{other} has it as a rival of {of}",
    "undecided": "{other} leaves it undecided",
    "small": "{other} has it as small",
    "possible": "{other} has it as possible",
    "not_confirmed": "{other} has it as not confirmed",
    None: "{other} has nothing of it",
}


def change_row(one: Change) -> list[str]:
    """A number that both models have, in the units of the console; its columns are `CHANGES`."""
    factor, unit = DEGREES.get(one.unit, (1.0, f" {one.unit}" * (one.unit != "1")))
    wide = [0.0 if std is None else NORMAL * std * factor for std in (one.std_a, one.std_b)]
    a, b = (f"{rounded(x * factor, half)}{unit}" for x, half in zip((one.a, one.b), wide, strict=True))
    difference = rounded((one.b - one.a) * factor, max(wide)) + unit
    sigmas = "–" if one.sigmas is None else f"{one.sigmas:+.1f}"
    what = "link and all beyond" if one.effect == "link" else called(one.effect)
    joints = listed([joint_words(joint) for joint in one.joints])
    return [what, joints, words(one.parameter), a, b, difference, sigmas, "changed" if one.changed else ""]


def verdict(found: Compared) -> str:
    """How many numbers have changed, and what only one of the models has."""
    judged = [one for one in found.changes if one.changed is not None]
    changed = sum(bool(one.changed) for one in judged)
    said = f"{changed or 'None'} of {len(judged)} numbers differ{'s' * (changed < 2)} by more than {found.limit:.2f} standard errors"
    if not judged:
        said = "The models do not say how well their numbers are known"
    alone = [
        f"{called(one.effect)} only in {name}" for name, some in (("A", found.only_a), ("B", found.only_b)) for one in some
    ]
    return f"{said}{f'; {listed(alone)}' * bool(alone)}"


def sentences(found: Compared) -> list[str]:
    """What a table of the numbers does not say."""
    rest = sum(one.changed is None for one in found.changes)
    lines = [f"{verdict(found)}."]
    if found.limit:
        lines.append(f"Of equal arms one of the numbers would by chance in {100 * LEVEL:.0f} % of comparisons.")
    if rest:
        lines.append(f"Of {rest} more numbers recordings tell too little.")
    for name, other, some in (("A", "B", found.only_a), ("B", "A", found.only_b)):
        lines += [f"Only in {name}: {_present(one)}; {_elsewhere(one, other)}." for one in some]
    errors = [f"{joint_words(joint)} {_percent(x)} → {_percent(y)}" for joint, (x, y) in found.errors.items()]
    lines.append(f"Error of the torque over its standard deviation: {listed(errors)}.")
    a, b = found.verdicts
    if a is not None and b is not None:
        lines.append(f"Verdict: {words(a)} → {words(b)}.")
    return lines


def _elsewhere(one: Alone, other: str) -> str:
    return ELSEWHERE[one.elsewhere].format(other=other, of=one.of and called(one.of))


def _present(one: Alone) -> str:
    """An effect with its numbers."""
    where = f" of {listed([joint_words(joint) for joint in one.joints])}" * bool(one.joints)
    some = "" if one.recordings == "all" else f" in {listed(one.recordings)}"
    numbers = [f"{words(name)} {_number(*number)}" for name, number in one.parameters.items()]
    return f"{called(one.effect)}{where}{some}{f' ({listed(numbers)})' * bool(numbers)}"


def _number(value: float, std: float | None, unit: str) -> str:
    factor, shown = DEGREES.get(unit, (1.0, unit))
    half = NORMAL * (std or 0.0)
    return str(Number(value, shown.strip(), (value - half, value + half) if half else None) * factor)


def _percent(error: float | None) -> str:
    return "–" if error is None else f"{100 * error:.3g} %"


def design_verdict(design: DesignFile, pairs: Mapping[str, Pair]) -> str:
    """The change of the cost of each configuration that both designs have."""
    name, unit = design.quantity.name, design.quantity.unit
    both = {key: (a, b) for key, pair in pairs.items() for a, b in [pair.cost] if a is not None and b is not None}
    costs = [f"{key} {rounded(a)} → {rounded(b)} {unit} ({_ratio(a, b)})" for key, (a, b) in both.items()]
    return f"{name}: {', '.join(costs)}" if costs else "No configuration is in both designs"


def design_table(design: DesignFile, pairs: Mapping[str, Pair]) -> tuple[list[str], list[list[str]]]:
    """Header and rows of two designs: cost, duration and springs of each configuration."""
    rows = []
    for name, pair in pairs.items():
        rows.append([name, design.quantity.title, *_cells(pair.cost, 1.0), _ratio(*pair.cost)])
        rows.append(["", "duration [s]", *_cells(pair.seconds, 1.0), _ratio(*pair.seconds)])
        for spring, both in pair.springs.items():
            _, factor, unit = spring_unit(spring)
            apart = "–" if None in both else f"{rounded((both[1] - both[0]) * factor)} {unit}"  # type: ignore[operator]
            rows.append(["", f"{spring} [{unit}]", *_cells(both, factor), apart])
    return ["configuration", "", "A", "B", "B against A"], rows


def _cells(both: Both, factor: float) -> list[str]:
    return ["–" if x is None else rounded(x * factor) for x in both]


def _ratio(a: float | None, b: float | None) -> str:
    return f"{100 * (b / a - 1):+.1f} %" if a and b is not None else "–"
