"""Many arms of one make: what the diagnosis of each found, and the numbers in which an arm stands out from the others."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import t as student

from rrr_oc.comparison.models import LEVEL, As, Change, Side, common_numbers, told_elsewhere
from rrr_oc.diagnosis.diagnosis_file import ClaimEntry, DiagnosisFile, Unexplained
from rrr_oc.report.diagnosis_words import joints_of, missing, placed, variable

FEWEST = 5  # arms from which the scatter of a number among them is told; with fewer none stands out
SIGMA = 1.4826  # standard deviations of a normal distribution in its median absolute deviation


@dataclass(frozen=True)
class Outlier:
    """A number of an arm that stands out from those of the others.

    Attributes:
        arm: Its name.
        of: The number, with the first arm's in `a` and its own in `b`.
        median: Of all arms.
        times: By how many standard deviations of the fleet it is off.
    """

    arm: str
    of: Change
    median: float
    times: float


@dataclass(frozen=True)
class Fleet:
    """Diagnoses of arms of one make.

    Attributes:
        arms: Their names.
        diagnoses: Theirs.
        findings: What was found on any of them, that of most arms first.
        cells: By arm, what its diagnosis has of each finding: the claim, link or torque, as what else it names it, or None.
        outliers: Numbers that stand out, the farthest first.
        limit: Standard deviations from which one does: of equal arms any does with probability `LEVEL` (Bonferroni); 0 with few arms.
    """

    arms: tuple[str, ...]
    diagnoses: tuple[DiagnosisFile, ...]
    findings: tuple[str, ...]
    cells: tuple[tuple[Any, ...], ...]
    outliers: tuple[Outlier, ...]
    limit: float


def fleet(sides: Sequence[Side], diagnoses: Sequence[DiagnosisFile]) -> Fleet:
    """Raises `UserError` unless all are of arms with the same joints, which sit and turn alike."""
    own = [_found(one) for one in diagnoses]
    counts: dict[str, int] = {}
    for name in (name for one in own for name in one):
        counts[name] = counts.get(name, 0) + 1
    findings = sorted(counts, key=lambda name: -counts[name])
    claims = {name: entry for one in own for name, entry in one.items() if isinstance(entry, ClaimEntry)}
    cells = [
        tuple(one.get(name) or _else(claims.get(name), side.told or {}) for name in findings)
        for one, side in zip(own, sides, strict=True)
    ]
    arms = names([Path(side.name) for side in sides])
    outliers, limit = _outliers(sides, arms)
    return Fleet(arms, tuple(diagnoses), tuple(findings), tuple(cells), tuple(outliers), limit)


def _found(one: DiagnosisFile) -> dict[str, Any]:
    """What a diagnosis found, by what it is and where."""
    return {
        **{placed(e): e for e in missing(one)},
        **{f"link {link.link}": link for link in one.link_findings},
        **{_torque(u): u for u in one.unexplained},
    }


def _torque(u: Unexplained) -> str:
    return f"a torque on {' and '.join(joints_of(u))} by {', '.join(map(variable, u.depends_on))}"


def _else(claim: ClaimEntry | None, told: Mapping[str, Any]) -> As | None:
    return None if claim is None else told_elsewhere(claim.effect, tuple(joints_of(claim)), told)[0]


def _outliers(sides: Sequence[Side], arms: Sequence[str]) -> tuple[list[Outlier], float]:
    rows = list(common_numbers(sides))
    if len(sides) < FEWEST or not rows:
        return [], 0.0
    limit = float(student.isf(LEVEL / 2 / (len(rows) * len(arms)), len(arms) - 1))
    found = [one for row in rows for one in _apart(row, arms) if one.times > limit]
    return sorted(found, key=lambda one: -one.times), limit


def _apart(row: Sequence[Change], arms: Sequence[str]) -> Iterator[Outlier]:
    """By how much each arm differs from the median, over the scatter of the others and its own error."""
    values = np.array([one.b for one in row])
    median = float(np.median(values))
    scatter = SIGMA * float(np.median(np.abs(values - median)))
    for arm, one in zip(arms, row, strict=True):
        if one.std_b is not None and (width := float(np.hypot(scatter, one.std_b))) > 0:
            yield Outlier(arm, one, median, abs(one.b - median) / width)


def names(paths: Sequence[Path]) -> tuple[str, ...]:
    """What distinguishes paths: their parts that not all have."""
    parts = [path.absolute().parts for path in paths]
    if len({len(one) for one in parts}) > 1 or len(set(parts)) < len(parts):
        return tuple(map(str, paths))
    return tuple("/".join(p for k, p in enumerate(one) if any(p != other[k] for other in parts)) for one in parts)
