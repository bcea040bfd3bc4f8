"""The list of springs to order, as people read it."""

from types import SimpleNamespace
from typing import Any

import numpy as np

from rrr_oc.codesign.parts.limits import SpringLimits
from rrr_oc.codesign.parts.order_list import order_list
from rrr_oc.effects.design_form import Axis
from rrr_oc.report.design_report import order_table
from rrr_oc.report.design_words import bound, mounts, part_limits


def rows_of(axis: Axis, turn: tuple[float, float], limits: SpringLimits) -> dict[str, dict[str, str]]:
    """The rows by make."""
    found: Any = SimpleNamespace(parts=order_list({"parallel_spring[elbow]": axis}, {"parallel_spring[elbow]": turn}, limits))
    header, rows = order_table(found)
    assert [row[0] for row in rows] == ["parallel spring of elbow", "", ""]  # the name once
    return {row[1].partition(",")[0]: dict(zip(header, row, strict=True)) for row in rows}


def test_a_row_has_what_a_maker_needs_in_mm_and_degrees():
    rows = rows_of(Axis(2.0, np.radians(30.0)), (np.radians(20.0), np.radians(120.0)), SpringLimits())
    torsion = rows["torsion"]
    assert torsion["rate"].startswith("2 Nm/rad ± ")
    assert torsion["unloaded at"].startswith("30.0 ± ")
    assert (torsion["deflection"], torsion["load"], torsion["energy [J]"]) == ("20.0 … 120.0°", "4.19 Nm", "4.39")
    pulley = float(rows["extension"]["made as"].split()[-2]) / 1e3
    assert rows["extension"]["rate"].split()[0] == f"{2 / pulley**2 / 1e3:.4g}"
    assert float(rows["extension"]["load"].split()[0]) == np.round(2 * np.radians(120) / pulley, 1)
    assert rows["compression"][""] == "closed, ground ends"
    assert torsion[""].startswith("rod below ")


def test_a_row_says_why_a_spring_cannot_be_built():
    rows = rows_of(Axis(50.0, 0.0), (0.0, np.radians(300.0)), SpringLimits(outside_mm=40.0))
    assert all(row[""].startswith("cannot be built: ") for row in rows.values())
    assert "are allowed" in rows["torsion"][""] or "is required" in rows["torsion"][""]


def test_a_spring_that_does_nothing_is_not_listed():
    axes = {"a[b]": Axis(0.0, 0.0), "c[d]": Axis(1.0, 0.0)}
    assert order_list(axes, {"a[b]": (0.0, 1.0), "c[d]": (0.0, 0.0)}, SpringLimits()) == []


def test_limits_in_words():
    assert "over 1e+06 cycles" in part_limits(SpringLimits())
    assert part_limits(SpringLimits(turn_deg=180.0, energy_J=15.0)).endswith(
        "Limits of the design were a turn of 180° and 15 J."
    )
    said = bound("moving the limit of the turn of the parallel_spring[joint3] (180 °) outward by one ° would save 1 % of E1")
    assert said.startswith("Moving the limit of the turn of the parallel spring of joint3 (180 °)")


def test_the_angle_of_the_pulley_at_a_spring_is_told_for_each_winding():
    """Its turn beyond the slack angle is what the law calls s r_2/r_1, with s = −w_a q_a − w_b r_3/r_2 q_b − φ."""
    found: Any = SimpleNamespace(mounted={"biarticular_spring[hip,knee]": {"winding": [1, -1]}})
    (sentence,) = mounts(found)
    assert sentence.endswith("at 0, its pulley r_1 is at 0, too; else at (− r_2 hip + r_3 knee)/r_1.")
