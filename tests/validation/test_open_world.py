"""Cases whose law the catalogue lacks: what is said of them is judged by the plant's own classes."""

import pytest

from validation.open_world import hidden, report, said, share


def truth(effect="cable_harness", joint="joint2", ratio=3.0, equal=(), in_catalogue=True):
    classes = {"equal": [{"effect": e, "joint": j} for e, j in equal], "within_noise": []}
    one = {
        "effect": effect,
        "joint": joint,
        "in_catalogue": in_catalogue,
        "ratio": {"requested": ratio},
        "equal_effects": classes,
    }
    return {"kind": "single", "effects": [one]}


def diagnosis(effects=(), unexplained=(), verdict="missing_physics"):
    claims = [{"effect": e, "joint": j, "rivals": [{"effect": r, "joint": k} for r, k in rivals]} for e, j, rivals in effects]
    return {"effects": claims, "unexplained": [{"joint": j} for j in unexplained], "verdict": verdict}


@pytest.mark.parametrize(
    ("found", "what", "wrong"),
    [
        (diagnosis([("backlash", "joint2", ())]), "false", ["backlash joint2"]),
        (diagnosis([("backlash", "joint2", ())], ["joint2"]), "false", ["backlash joint2"]),
        (diagnosis([("torque_offset", "joint2", ())]), "equal", []),
        (diagnosis([("torque_offset", "joint1", ())]), "false", ["torque_offset joint1"]),
        (diagnosis([("backlash", "joint2", [("torque_offset", "joint2")])]), "equal", []),
        (diagnosis(unexplained=["joint1", "joint2"]), "unexplained", []),
        (diagnosis(unexplained=["joint1"]), "elsewhere", []),
        (diagnosis(verdict="cannot_tell"), "cannot tell", []),
        (diagnosis(verdict="nothing_missing"), "nothing", []),
    ],
)
def test_what_is_said_is_judged_by_what_is_equal_on_the_data(found, what, wrong):
    assert said(truth(equal=[("torque_offset", "joint2")]), found) == (what, wrong)


@pytest.mark.parametrize(("more", "what"), [(None, "false"), (0.05, "false"), (0.01, "as good"), (-0.1, "as good")])
def test_claims_are_as_good_as_the_law_whose_error_they_reach(more, what):
    assert said(truth(), diagnosis([("backlash", "joint2", ())]), more)[0] == what


def test_only_cases_with_one_effect_that_can_be_seen_are_hidden():
    assert hidden(truth())
    assert not hidden(truth(ratio=0.5))
    assert not hidden(truth(in_catalogue=False))
    assert not hidden({"kind": "clean", "effects": []})
    assert not hidden(truth() | {"kind": "imperfect"})  # whose small faults may be claimed


def test_the_report_counts_cases_and_claims():
    results = [
        (
            truth(),
            {
                "case": "a",
                "seconds": 1.0,
                "more_error": 0.3,
                "diagnosis": diagnosis([("backlash", "joint2", ()), ("echo", "joint2", ())]),
            },
        ),
        (truth(), {"case": "b", "seconds": 2.0, "more_error": None, "diagnosis": diagnosis(unexplained=["joint2"])}),
        (truth("stribeck"), {"case": "c", "seconds": 3.0, "crash": "Traceback"}),
    ]
    summary, text = report(results)
    assert summary["said"] == {"false": 1, "unexplained": 1}
    assert (summary["claims"], summary["false_claims"], summary["crashed"]) == (2, 2, ["c"])
    assert "| `cable_harness` | 2 | 1 |" in text
    assert "Cases with a false claim: 1 of 2, 9 to 91 %." in text  # Wilson
    assert share(0, 0) == "none of none"
