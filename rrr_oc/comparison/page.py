"""The page of a fleet: what was found on which arm, which numbers stand out, and each number over the arms."""

from pathlib import Path

import numpy as np

from rrr_oc.comparison.fleet import Fleet
from rrr_oc.comparison.words import claimed_numbers, fleet_table, fleet_verdict, outlier_table
from rrr_oc.diagnosis.diagnosis_file import ClaimEntry
from rrr_oc.effects.words import NORMAL, words
from rrr_oc.report.diagnosis_words import read_in
from rrr_oc.report.figures import Curve, Figure
from rrr_oc.report.pages.page import render
from rrr_oc.storage import write_text

PAGE = "fleet.html"


def write_fleet_page(found: Fleet, folder: Path) -> Path:
    """Write fleet.html."""
    text = render(
        "fleet.html",
        figures := fleet_figures(found),
        verdict=fleet_verdict(found),
        arms=fleet_table(found),
        outliers=outlier_table(found),
        limit=found.limit,
        names=[figure.name for figure in figures],
    )
    write_text(folder / PAGE, text)
    return folder / PAGE


def fleet_figures(found: Fleet) -> list[Figure]:
    """Each number of each effect that two arms have or more, with its interval."""
    figures = []
    for k, name in enumerate(found.findings):
        own = {
            arm: claimed_numbers(cells[k])
            for arm, cells in zip(found.arms, found.cells, strict=True)
            if isinstance(cells[k], ClaimEntry)
        }
        for parameter in dict.fromkeys(p for numbers in own.values() for p in numbers) if len(own) > 1 else ():
            some = {arm: numbers[parameter] for arm, numbers in own.items() if parameter in numbers}
            factor, unit = read_in(next(iter(some.values()))[2])
            half = np.array([NORMAL * factor * (std or 0.0) for _, std, _ in some.values()])
            data = {"": {"x": [factor * value for value, *_ in some.values()], "y": list(some), "half": half}}
            curve = Curve("x", "y", "after", mode="markers", width=10, bars=("half", "half"))
            axes = (f"{words(parameter)} [{unit.strip() or 1}]", "")
            at = f"number_{len(figures)}"
            figures.append(
                Figure(at, f"{name}: {words(parameter)}", axes, (curve,), data, at, names=True, height=130 + 34 * len(some))
            )
    return figures
