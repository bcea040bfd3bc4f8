"""What a report says of a design whose cost recordings leave open."""

import designs
import pytest

from rrr_oc.report.design_report import foreseen_table, members_table, report
from rrr_oc.report.design_words import cautions

MEMBER = {"says": "as calibrated", "E1": (4.0, 5.0), "cost": (4.0, 5.0), "E1_itself": 4.5, "decided_by": "PEA.npz"}
OTHER = {"says": "cable_harness of b", "E1": (8.0, 9.0), "cost": (8.0, 9.0), "E1_itself": 8.5, "decided_by": "suggested_1.csv"}


def study(*members, **changes):
    """A study of one design that these members foresee."""
    ends = [min(m["E1"][0] for m in members), max(m["E1"][1] for m in members)]
    found = {"E1": ends, "cost": ends, "members": members, "widened_by": None, "narrowed_by": None} | changes
    return designs.summary(PEA=designs.with_motion(designs.design(4.5), foreseen=found))


@pytest.mark.parametrize(
    ("narrowed", "said"),
    [
        (
            "suggested_1.csv",
            "between 4 and 9, by a factor of 2.25 (cable_harness of b); the motion of suggested_1.csv, recorded, would",
        ),
        (None, "cable_harness of b shows the same torques, and the zero of a sensor, or parts taken apart, have to tell"),
    ],
)
def test_a_wide_range_is_warned_of_with_what_would_narrow_it(narrowed, said):
    one = study(MEMBER, OTHER, widened_by="cable_harness of b", narrowed_by=narrowed)
    assert any(said in sentence for sentence in cautions(one))
    assert said in report(one)


def test_a_narrow_range_is_told_without_a_warning():
    one = study(MEMBER)
    assert not any("leave the cost open" in sentence for sentence in cautions(one))
    _, rows = foreseen_table(one) or ([], [])
    assert rows == [["PEA", "4.500", "4 and 5", "1.25", "–"]]
    assert "4 and 5" in report(one)


def test_every_model_that_recordings_allow_has_a_row():
    one = study(MEMBER, OTHER)
    header, rows = members_table(one.configurations["PEA"])
    assert [row[header.index("the arm")] for row in rows] == ["as calibrated", "cable_harness of b"]
    assert [row[header.index("decided by recording")] for row in rows] == ["PEA.npz", "suggested_1.csv"]


def test_without_a_calibrated_model_nothing_is_foreseen():
    assert foreseen_table(designs.summary(PEA=designs.design(1.0))) is None
