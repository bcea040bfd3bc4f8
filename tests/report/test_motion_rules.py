"""What a report says of what the motions may do, and of motions below the base's plane."""

import designs
from msgspec.structs import replace

from rrr_oc.codesign.clearance import Capsule, KeepOut
from rrr_oc.codesign.design_file import DesignFile, LimitsEntry, PassedPoint
from rrr_oc.report import design_words as say
from rrr_oc.report.design_report import motors_table, optima_table

POST = KeepOut("post", capsule=Capsule((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 0.1))
JUMPING = LimitsEntry((0.0, 1.0), 1.0, 2.0, None)


def study(lowest: float, **changes) -> DesignFile:
    """Of one task with these keys, whose links come down to this height [m]."""
    made = designs.summary(PEA=designs.design(1.0, {"t": designs.moved(1.0, lowest_link_m=lowest)}))
    return replace(made, tasks=(replace(made.tasks[0], **changes),))


def test_rules_of_a_task_without_any():
    said = say.rules(study(0.1, limits={"b": JUMPING}))
    assert said == [
        "No floor keeps links and tool above the base's plane.",
        "Accelerations may jump, also where a phase begins and ends.",
    ]
    paper = say.rules(replace(study(0.1, limits={"b": JUMPING}), paper=True))
    assert all(sentence.endswith(" as in the paper.") for sentence in paper)


def test_rules_of_a_task_with_floor_keep_out_and_jerk():
    limits = {"b": replace(JUMPING, jerk_rad_per_s3=10.0)}
    floor, post, jerk = say.rules(study(0.1, floor_m=0.0, keep_outs=(POST,), limits=limits))
    assert floor == "Links and tool stay above a floor at 0 m."
    assert post == "They keep out of post."
    assert jerk.startswith("The jerk is limited")


def test_points_on_the_way_are_told():
    rules = say.rules(study(0.1, limits={"b": JUMPING}, via=(PassedPoint("go", 0.3), PassedPoint("return", 0.5))))
    assert rules[1] == "The arm passes given points at 30 % of “go” and at 50 % of “return”."


def test_a_motion_below_the_base_is_told_where_no_floor_was_given():
    (told,) = [sentence for sentence in say.cautions(study(-0.284)) if "below" in sentence]
    assert told == (
        "The motion of PEA goes below the base's plane, by up to 0.28 m (PEA); floor_m in the task keeps links and tool above it."
    )
    for other in (study(-0.284, floor_m=-0.3), study(0.01)):
        assert not [sentence for sentence in say.cautions(other) if "below" in sentence]


def test_what_the_motors_do_stands_beside_what_the_load_needs():
    """E1 falls by 90 %, the motors' squared torque by 20 % and their work by 10 %."""

    def moved(E1: float, squared: float, work: float) -> designs.MovedEntry:
        return designs.moved(E1, motors=designs.metrics(squared) | {"work_J": work})

    stiff, best = designs.design(100.0, {"t": moved(100.0, 200.0, 50.0)}), designs.design(10.0, {"t": moved(10.0, 160.0, 45.0)})
    made = designs.summary(SA=replace(stiff, mounted={}), PEA=best)
    header, rows = optima_table(made)
    assert header[:5] == ["", "E1 [N²m²s]", "decrease", "motor torque² [N²m²s]", "decrease"]
    assert [row[:5] for row in rows] == [
        ["SA", "100.000", "", "200.000", ""],
        ["PEA", "10.000", "90.0 %", "160.000", "20.0 %"],
    ]
    table = motors_table(made)
    assert table is not None
    assert table[1][1] == ["PEA", "160.000", "20.0 %", "45.000", "10.0 %", "1", "2"]
    assert "Of the motors themselves, with their friction, rotors and gears, that is 20.0 % less motor torque²" in say.verdict(
        made
    )
    unknown = designs.summary(SA=designs.design(100.0), PEA=designs.design(10.0))
    assert motors_table(unknown) is None
    assert "motor torque²" not in " ".join(optima_table(unknown)[0])
