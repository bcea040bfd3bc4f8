"""Comparisons as people read them: rows of tables, and sentences."""

from collections import Counter
from collections.abc import Mapping
from typing import Any

from rrr_oc.calibration.link_findings import OffLink
from rrr_oc.codesign.design_file import DesignFile
from rrr_oc.comparison.designs import Pair
from rrr_oc.comparison.fleet import Fleet
from rrr_oc.comparison.models import LEVEL, Alone, Change, Compared
from rrr_oc.diagnosis.diagnosis_file import ClaimEntry, DiagnosisFile, Unexplained
from rrr_oc.effects.words import NORMAL, Number, joint_words, listed, rounded, words
from rrr_oc.report.diagnosis_words import called, percent, read_in
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
    factor, unit = read_in(one.unit)
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
    factor, shown = read_in(unit)
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


def fleet_verdict(found: Fleet) -> str:
    """What how many arms lack, and which numbers stand out."""
    count, parts = len(found.arms), []
    for k, name in enumerate(found.findings):
        some = [arm for arm, cells in zip(found.arms, found.cells, strict=True) if _found_itself(cells[k])]
        parts.append(f"{name} on {'all' if len(some) == count else listed(some) if len(some) < 4 else f'{len(some)}'}")
    out = Counter(one.arm for one in found.outliers)
    said = f"Found on {count} arms: {'; '.join(parts)}" if parts else f"Nothing was found on any of {count} arms"
    each = [f"{arm} by {number} number{'s' * (number > 1)}" for arm, number in out.items()]
    stands = f"{listed(each)} stand{'s' * (len(out) == 1)} out" if out else "no number of an arm stands out"
    return f"{said}{f'; {stands}' * bool(found.limit)}."


def fleet_table(found: Fleet) -> tuple[list[str], list[list[str]]]:
    """Arms by findings."""
    rows = [
        [arm, words(one.verdict), *map(_cell, cells), _worst(one)]
        for arm, one, cells in zip(found.arms, found.diagnoses, found.cells, strict=True)
    ]
    return ["arm", "verdict", *found.findings, "largest error left out"], rows


def outlier_table(found: Fleet) -> tuple[list[str], list[list[str]]]:
    """Numbers that stand out."""
    rows = []
    for one in found.outliers:
        what, joints, parameter, _, own, *_ = change_row(one.of)
        factor, unit = read_in(one.of.unit)
        half = NORMAL * factor * (one.of.std_b or 0.0)
        rows.append([one.arm, what, joints, parameter, own, f"{rounded(one.median * factor, half)}{unit}", f"{one.times:.1f}"])
    return ["arm", "what", "joint", "parameter", "value", "median of all", "standard deviations off"], rows


def _found_itself(cell: Any) -> bool:
    return cell is not None and not isinstance(cell, str)


def _cell(cell: Any) -> str:
    """What a diagnosis has of a finding: its numbers, or as what else it is named."""
    if not _found_itself(cell):
        return words(cell) if cell else "–"
    if isinstance(cell, OffLink):
        return ", ".join(
            f"{words(d.quantity)} {100 * (d.value / d.urdf - 1):+.3g} %" if d.urdf else words(d.quantity)
            for d in cell.directions
        )
    if isinstance(cell, Unexplained):
        return percent(cell.probability)
    return ", ".join(f"{words(name)} {_with_error(*number)}" for name, number in claimed_numbers(cell).items())


def _with_error(value: float, std: float | None, unit: str) -> str:
    factor, shown = read_in(unit)
    half = NORMAL * factor * (std or 0.0)
    return f"{rounded(factor * value, half)}{f' ± {rounded(half, half)}' * bool(half)}{shown}"


def claimed_numbers(claim: ClaimEntry) -> dict[str, tuple[float, float | None, str]]:
    """Value, standard error by its interval, and unit of the single numbers of a claim."""
    single = {name: e for name, e in claim.parameters.items() if isinstance(e.value, float) and e.unit}
    return {
        n: (e.value, (e.interval[1] - e.interval[0]) / 2 / NORMAL if e.interval else None, e.unit) for n, e in single.items()
    }


def _worst(one: DiagnosisFile) -> str:
    errors = [(b.after.value, joint) for joint, b in one.bootstrap.items() if b.after.value is not None]
    return f"{_percent(max(errors)[0])} ({joint_words(max(errors)[1])})" if errors else "–"
