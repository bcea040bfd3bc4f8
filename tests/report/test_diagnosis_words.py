"""What reports and console say about findings and how sure they are, on made-up contents of diagnosis.json."""

import re

import numpy as np
import pytest
from filled import filled

from rrr_oc.calibration.link_findings import Fallen, OffLink
from rrr_oc.diagnosis.diagnosis_file import ClaimEntry, DiagnosisFile, PlaceEntry, Refuted, Unexplained
from rrr_oc.effects import CATALOGUE, Effect
from rrr_oc.effects.words import Number, joint_words, read
from rrr_oc.report import diagnosis_words as say
from rrr_oc.report.diagnosis_words import percent, unsaid, variable
from rrr_oc.report.pages import diagnosis_claims, diagnosis_page
from rrr_oc.robot.parameters import Parameter


def of(kind, function):
    """The function of plain data, of which a test has no more than it is about."""
    return lambda given, *others: function(filled(given, kind), *others)


sentence, rows, anatomy, events, told_apart, on_prior, not_claimed = (
    of(DiagnosisFile, f)
    for f in (say.sentence, say.rows, say.anatomy, say.events, say.told_apart, say.on_prior, say.not_claimed)
)
claims, record_next, remaining, small, page = (
    of(DiagnosisFile, f)
    for f in (
        diagnosis_claims.claims,
        diagnosis_claims.record_next,
        diagnosis_claims.remaining,
        diagnosis_claims.small,
        diagnosis_page.diagnosis_page,
    )
)
plain, rivals = of(ClaimEntry, say.plain), of(ClaimEntry, say.rivals)
placed, touches = of(Refuted, say.placed), of(Refuted, say.touches)
lowered, place = of(Fallen, say.lowered), of(PlaceEntry, say.place)
most_like, unexplained = of(Unexplained, say.most_like), of(Unexplained, say.unexplained)
off_links, if_identified = (
    lambda found, f=f, key=key: f([filled(one, OffLink) for one in found[key]])
    for f, key in ((say.off_links, "link_findings"), (say.if_identified, "if_identified"))
)
BOX = next(name for name, kind in CATALOGUE.items() if kind.role == "black_box")


def entry(effect: str, joint="a", probability: float = 0.5, **more) -> dict:
    return {"effect": effect, "joint": joint, "probability": probability, **more}


def test_a_claim_that_rests_on_its_prior_is_told():
    """Of a law, and of a torque that no law explains; whether a claim does is in the file."""
    drag, box = entry("quadratic_drag", "b", claim_rests_on_prior=True), entry(BOX, "b", claim_rests_on_prior=True)
    assert on_prior({}) == on_prior({"priors": [entry("stribeck", claim_rests_on_prior=False)]}) == []
    sure, *said = [entry("stribeck", claim_rests_on_prior=False), drag, box]
    assert on_prior({"priors": [sure, *said]}) == [
        f"The claim of {what} rests on what was believed before: had it been 10 times less probable, it would not be made."
        for what in ("quadratic drag of b", "a torque on b that no effect explains")
    ]


def test_what_is_not_claimed_is_listed():
    assert not_claimed({}) == not_claimed({"possible": [], "not_confirmed": []}) == []
    possible = [
        entry("torque_ripple", "a", 0.61, recordings="all"),
        entry("payload_mass", None, 0.08, recordings=["1.csv", "2.csv"]),
        entry("coupled_friction", ["a", "b"], 0.07, recordings="all"),
    ]
    first, second = not_claimed({"possible": possible, "not_confirmed": [entry(BOX, "b", 0.9996), entry(BOX, "b", 0.9997)]})
    assert first == "Possible, not claimed: torque ripple of a, payload mass in 1.csv, 2.csv, coupled friction of a and b."
    assert second.startswith("Not confirmed, not claimed: a torque on b that no effect explains. ")


def test_what_is_small_is_said_with_its_size():
    size = {"joint": "a", "share": 0.004, "interval": [-0.001, 0.009], "innovations": None}
    one = stribeck() | {"probability": None, "lowers_error": size}
    header, body = small({"small": [one]})
    assert len(header) == len(body[0])
    assert body == [[plain(one), "a", "0.4 % (95 %: -0.1 to 0.9 %)"]]
    assert "0.400 Nm" in plain(one)
    assert small({"small": [one | {"effect": BOX}]})[1][0][0] == "a torque on a that no effect explains"
    assert small({})[1] == []
    noise = {
        "verdict": "nothing_missing",
        "bootstrap": {},
        "nrmse": {"calibration": {"before": {}}, "held_out": {"before": {}}},
    }
    assert sentence(noise | {"small": [one]}).startswith("Nothing that matters is missing:")
    assert sentence(noise).startswith("Nothing is missing:")


def test_a_link_that_is_off_is_said_with_as_many_decimals_in_each_direction():
    off = {"value": [0.0619, 0.0873, 0.045], "urdf": [0.0, -0.009, 0.08], "sigmas": 10.2}
    (said,) = off_links({"link_findings": [{"link": "link5", "directions": [], "lowers_error": None, "centre": off}]})
    assert (
        "it fits with its centre of mass at (0.0619, 0.0873, 0.0450) m instead of (0.0000, -0.0090, 0.0800) m, 10 times" in said
    )


def test_a_first_moment_is_said_with_its_change_and_what_would_do_the_same():
    more = {"joint": "a", "quantity": "first_moment", "value": 0.364, "urdf": 0.293, "interval": [0.36, 0.368], "unit": "kg m"}
    across = more | {"value": 0.033, "urdf": 0.0, "interval": [0.031, 0.035]}
    size = {"joint": "a", "share": 0.5, "interval": [0.4, 0.6]}
    one = {"link": "l1", "directions": [more, across], "lowers_error": size, "indistinguishable_from": ["torque_gain"]}
    (said,) = off_links({"link_findings": [one]})
    assert "first moment of what turns about a is 0.364 kg m (95 %: 0.360 to 0.368) instead of 0.293, +24 ± 1 %" in said
    assert "has a part of 0.033 kg m (95 %: 0.031 to 0.035) across its direction there" in said
    assert "lowers the error of a by 50.0 % (95 %: 40.0 to 60.0 %)" in said
    assert "there is torque gain: these recordings do not tell" in said
    (said,) = off_links({"link_findings": [{**one, "indistinguishable_from": []}]})
    assert said.endswith("Either that is so, or it takes up what the model lacks.")
    del one["indistinguishable_from"]
    head, told = if_identified({"if_identified": [one]})
    assert '"identify"' in head
    assert told.startswith("The link “l1” is not as")
    whole = sentence({"verdict": "missing_physics", "effects": [], "unexplained": [], "link_findings": [one]})
    assert "rrr-oc diagnose says what would" in whole


def test_what_is_said_above_is_not_said_again():
    assert unsaid(["B never moved.", "A is off.", "A is off."], "Nothing is missing. B never moved.", "") == ["A is off."]


def test_a_range_without_width_is_one_number():
    mass = {"variable": "payload", "range": [2.8157, 2.8157], "unit": "kg", "share_of_error": 0.89, "share_of_time": 0.44}
    assert place(mass) == "the payload of 2.82 kg, with 89 % of the error in 44 % of the time"
    assert place({**mass, "range": [1.0, 2.8157]}).startswith("the payload from 1.0 to 2.8 kg, ")


def test_numbers_and_names():
    assert [percent(p) for p in (None, np.nan, 0.054, 0.949, 0.953, 0.9989, 0.9995, 1.0)] == [
        "not known",
        "not known",
        "5 %",
        "95 %",
        "95.3 %",
        "99.9 %",
        "> 99.9 %",
        "> 99.9 %",
    ]
    assert lowered({"joint": "a", "share": 0.84, "interval": [0.8, 0.876]}) == "a by 84.0 % (95 %: 80.0 to 87.6 %)"
    assert lowered({"joint": "a", "share": 0.84, "interval": None}) == "a by 84.0 %"
    one = entry("stribeck", "a", rivals=[{"effect": "quadratic_drag", "joint": "a"}, {"effect": "torque_ripple", "joint": "b"}])
    assert rivals(one) == ["quadratic drag", "torque ripple of b"]
    assert placed(entry("payload_mass", None)) == "payload mass"


def number(value, unit: str, half: float | None = None) -> dict:
    interval = None if half is None else [value - half, value + half]
    return {"value": value, "std": None if half is None else half / 1.96, "unit": unit, "interval": interval}


def found_effect(effect: str, joint, recordings="all", **parameters) -> dict:
    return entry(
        effect,
        joint,
        0.97,
        recordings=recordings,
        equation="law",
        parameters=parameters,
        lowers_error={"joint": "joint1", "share": 0.123456789, "interval": [0.1, 0.2], "innovations": None},
        nrmse={"held_out_before": 0.123456789, "held_out_after": 0.0123456789},
        log_odds=12.3456789,
        reaches=0.987654321,
        rivals=[],
    )


@pytest.mark.parametrize(
    ("effect", "joint", "parameters", "said"),
    [
        ("payload_mass", None, {"mass": number(1.001234567890123, "kg", 0.02)},
         "The model has 1.00 kg (95 %: 0.98 to 1.02 kg) less at the tool than the arm."),
        ("payload_mass", None, {"mass": number(-0.5, "kg", 0.1)},
         "The model has 0.5 kg (95 %: 0.4 to 0.6 kg) more at the tool than the arm."),
        ("load_dependent_friction", "elbow_joint", {"mu": number(0.1195, "1", 0.011)},
         "Dry friction of elbow grows with its load: 0.12 Nm per Nm (95 %: 0.11 to 0.13 Nm per Nm)."),
        ("load_dependent_friction", "a",
         {"mu": number(-0.05, "1"), "follows": {"value": "motor", "std": None, "unit": ""}},
         "Dry friction of a falls with the torque of its motor: 0.0500 Nm per Nm."),
        ("cable_harness", "a", {"stiffness": number(2.0, "Nm/rad"), "rest": number(0.0, "rad"), "hardening": number(0.8, "Nm/rad³")},
         "Something elastic, such as a cable, a hose or a spring that acts both ways, pulls a back towards "
         "0.00°: 2.00 Nm/rad, and 0.800 Nm/rad³ times the third "
         "power of the angle."),
        ("biarticular_spring", ["a", "b"],
         {"kappa": number(8.0, "Nm/rad"), "rho": number(0.5, "1"), "phi": number(-0.1, "rad", 0.01), "winding": {"value": [1, -1]}},
         "A spring that no recording lists acts across a and b: 8.00 Nm/rad at a, with a lever of 0.500 times that at b; it pulls "
         "while a minus 0.500 times b is below 5.7° (95 %: 5.2 to 6.3°), and is slack beyond."),
        ("biarticular_spring", ["a", "b"],
         {"kappa": number(8.0, "Nm/rad"), "rho": number(0.5, "1"), "phi": number(-0.1, "rad"), "winding": {"value": [-1, -1]}},
         "A spring that no recording lists acts across a and b: 8.00 Nm/rad at a, with a lever of 0.500 times that at b; it pulls "
         "while a plus 0.500 times b is above -5.73°, and is slack beyond."),
        ("two_sided_biarticular_spring", ["a", "b"],
         {"kappa": number(6.0, "Nm/rad"), "rho": number(-0.8, "1"), "phi": number(0.3, "rad")},
         "A spring that no recording lists acts across a and b and pulls both ways: 6.00 Nm/rad at a, with a lever of -0.800 times "
         "that at b; it rests where a minus 0.800 times b is 17.2°."),
        ("torque_ripple", "a", {"amplitude": number(0.75, "Nm"), "order": number(10.0, "1"), "phase": number(0.0, "rad", 0.1)},
         "The torque of a ripples with its angle: by 0.750 Nm either way, 10.0 times per turn; it pushes forward most at 9.0° "
         "(95 %: 8.4 to 9.6°) and every 36.0° from there."),
        ("position_dependent_friction", "a",
         {"amplitude": number(-0.5, "Nm"), "order": number(2.0, "1"), "phase": number(0.2, "rad")},
         "Dry friction of a changes with its angle: by -0.500 Nm either way, 2.00 times per turn; it is largest at -84.3° and every "
         "180° from there."),
        ("torque_gain", None, {"gain": number(0.4, "1")}, "The recorded torque of all joints is 40.0 % too large."),
        ("gravity_tilt", None, {"about_x": number(0.01745329, "rad", 0.0035), "about_y": number(0.0, "rad", 0.0035)},
         "The arm's base is not level: turned by 1.0° (95 %: 0.8 to 1.2°) about x and 0.0° (95 %: -0.2 to 0.2°) about y of the base "
         "frame."),
        ("gravity_tilt", None, {"about_x": number(0.0, "rad"), "about_y": number(-1.570796, "rad"),
                                "angle": number(1.570796, "rad", 0.001), "axis": {"value": [0.0, -1.0, 0.0], "std": None, "unit": "1"}},
         "The arm's base is not level: turned by 90.00° (95 %: 89.94 to 90.06°) about the axis (0.00, -1.00, 0.00), which is 0.00° "
         "about x and -90.0° about y of the base frame."),
        ("coupled_friction", ["a", "b"],
         {"coulomb": number(1.0, "Nm"), "viscous": number(0.25, "Nm s/rad"), "form": {"value": "other", "std": None, "unit": ""}},
         "Friction of a follows the speed of b: dry friction of 1.00 Nm and viscous friction of 0.250 Nm s/rad."),
        ("rubber_nobody_knows", "wrist_2_joint", {"very_stiff": number(1 / 3, "Nm/rad", 0.0123)},
         "The arm has rubber nobody knows of wrist 2, which the model lacks: very stiff 0.33 Nm/rad (95 %: 0.32 to 0.35 Nm/rad)."),
    ],
)  # fmt: skip
def test_a_finding_is_a_sentence_with_number_unit_and_interval(effect, joint, parameters, said):
    assert plain(found_effect(effect, joint, **parameters)) == said


def test_a_value_of_each_recording_is_told_with_it():
    each = {
        "0.csv": {"value": 0.05, "std": 0.001, "interval": [0.048, 0.052]},
        "1.csv": {"value": -0.03, "std": 0.001, "interval": None},
    }
    said = plain(found_effect("encoder_offset", "a", "each", offset={"unit": "rad", "by_recording": each}))
    assert said == (
        "The zero of the encoder of a is another in every recording: it reads 2.9° in 0.csv and -1.72° in 1.csv too much."
    )


def test_a_finding_names_the_recordings_that_have_it_and_the_frame_of_a_vector():
    vector = {"value": [0.1, -0.2, 1 / 3], "std": [0.01, 0.02, None], "unit": "kg m"}
    matrix = {"value": [[0.5, 0, 0], [0, 0.25, 0], [0, 0, 2 / 3]], "std": [[0.1] * 3] * 3, "unit": "kg m²"}
    mass = {"value": -0.7, "std": 0.1, "unit": "kg"}
    said = plain(
        found_effect("link_inertial", "wrist_2_joint", ["1.csv", "2.csv"], mass=mass, first_moment=vector, inertia=matrix)
    )
    assert "The link that wrist 2 moves has 0.7 kg (95 %: 0.5 to 0.9 kg) less mass than the URDF says" in said
    assert "(0.10 ± 0.02, -0.20 ± 0.04, 0.333) kg m" in said
    assert "(0.5 ± 0.2, 0.2 ± 0.2, 0.7 ± 0.2) kg m²" in said
    assert said.endswith(
        "in the frame of wrist 2. It is needed in 1.csv and 2.csv; the other recordings are explained without it."
    )


@pytest.mark.parametrize("name", [name for name, kind in CATALOGUE.items() if kind.role == "law"])
def test_every_effect_has_a_sentence_of_its_own_with_all_that_was_found(name):
    kind = CATALOGUE[name]
    joints = {"arm": None, "pair": ["left_joint", "right_joint"]}.get(kind.placement, "left_joint")
    parameters = {p.name: number(0.3333333333333333, p.unit, 0.0123456789) for p in kind.parameters}
    if kind.composed:
        values = {"mass": 0.3, "first_moment": [0.1] * 3, "inertia": [[0.1] * 3] * 3}
        parameters = {key: {"value": v, "std": None, "unit": "kg"} for key, v in values.items()}
    options = {key: [1, -1] if key == "winding" else allowed[0] for key, allowed in kind.options.items()}
    parameters |= {key: {"value": value, "std": None, "unit": ""} for key, value in options.items()}
    said = plain(found_effect(name, joints, **parameters))
    assert kind.plain, "no words of its own"
    assert not re.search(r"[_{}]|\d{6}", said)
    assert said.endswith(".")
    assert joints is None or "left" in said
    least = len(kind.parameters) if not kind.composed else 3
    assert len(re.findall(r"\(95 %|kg", said)) >= least


def test_an_effect_of_another_package_is_said_by_its_name_joints_and_parameters():
    class Rubber(Effect):
        name = "rubber_band"
        parameters = (Parameter("rest_angle", "rad"),)

    said = Rubber.sentence(("a", "b"), {"rest_angle": Number(0.5, "rad", (0.4, 0.6))})
    assert said == "The arm has rubber band of a and b, which the model lacks: rest angle 0.5 rad (95 %: 0.4 to 0.6 rad)."
    Rubber.plain = "{own} is tied to {other} at {rest_angle:abs deg}."
    assert Rubber.sentence(("a", "b"), {"rest_angle": Number(-0.5, "rad")}) == "a is tied to b at 28.6°."


@pytest.mark.parametrize(
    ("number", "shown"),
    [
        (Number(12345.678, "N", (12000.0, 12700.0)), "12300 N (95 %: 12000 to 12700 N)"),
        (Number(1.0012345678901234, "kg"), "1.00 kg"),
        (Number(1e-9, "m"), "1e-09 m"),
        (Number(0.0, "m"), "0.00 m"),
        (Number(2.5, "1", (2.5, 2.5)), "2.50"),
        (Number(-0.001, "m", (-0.2, 0.2)), "0.0 m (95 %: -0.2 to 0.2 m)"),
    ],
)
def test_a_number_has_the_digits_that_its_interval_supports(number, shown):
    assert str(number) == shown


def test_an_interval_that_is_not_determined_is_left_out():
    assert str(read({"value": 1.0, "std": None, "unit": "Nm", "interval": None})) == "1.00 Nm"
    assert str(read({"value": 1.0, "std": None, "unit": "Nm", "interval": [None, None]})) == "1.00 Nm"


def test_names_are_words():
    assert [joint_words(name) for name in ("wrist_2_joint", "joint2", "joint", "_joint")] == [
        "wrist 2",
        "joint2",
        "joint",
        "joint",
    ]
    found = [variable(name) for name in ("q_wrist_2_joint", "ddq_j2", "sign(dq_elbow_joint)", "load_torque")]
    assert found == ["the position of wrist 2", "the acceleration of j2", "the direction of elbow", "the load torque"]
    assert unexplained(TORQUE) == (
        "A torque on elbow depends on the position of wrist 2 and the direction of elbow, and which law it follows is not sure; "
        "the model carries it as a sum of 3 cosines, valid in the ranges given."
    )


TORQUE = {
    "joint": "elbow_joint",
    "depends_on": ["q_wrist_2_joint", "sign(dq_elbow_joint)"],
    "recordings": "all",
    "probability": 0.97,
    "log_odds": 12.3456789,
    "lowers_error": {"joint": "elbow_joint", "share": 0.123456789, "interval": [0.1, 0.2], "innovations": None},
    "most_like": None,
    "description": "a torque on elbow_joint that depends on …; the model carries it as a sum of 3 cosines, valid in the ranges given",
}
LIKE = {
    "effect": "torque_ripple",
    "joint": "elbow_joint",
    "parameters": {"amplitude": number(0.75, "Nm", 0.05), "order": number(10.0, "1")},
    "reaches": 0.6183,
}


def test_a_torque_that_is_described_says_which_law_it_is_most_like_and_how_much():
    like = (
        "It is most like torque ripple (amplitude = 0.75 Nm (95 %: 0.70 to 0.80 Nm), order = 10.0), which explains 62 % of it."
    )
    assert most_like(TORQUE) == most_like({}) == ""
    assert most_like(TORQUE | {"most_like": LIKE}) == like
    assert most_like({"most_like": LIKE | {"parameters": {}, "reaches": 0.5}}) == (
        "It is most like torque ripple, which explains 50 % of it."
    )
    assert unexplained(TORQUE | {"most_like": LIKE}) == f"{unexplained(TORQUE)} {like}"
    found = {"effects": [], "unexplained": [TORQUE], "bootstrap": bootstrap(elbow_joint=(0.4, 0.2)), "mismatch": []}
    (claim,) = claims(found, ["0.csv"])
    assert (claim.title, claim.law, claim.numbers) == ("Torque on elbow whose law is not sure", "", "")
    facts = dict(claim.facts)
    assert facts["Rests on"].startswith("Probability 97.0 % that it is there")
    assert facts["Could also be"].startswith("A law that the catalogue lacks, or a known one in another shape")
    assert facts["Could also be"].endswith("holds in its range alone.")
    assert "lowers the error of elbow's torque by 12.3 %" in facts["On unseen data"]
    (claim,) = claims(found | {"unexplained": [TORQUE | {"most_like": LIKE}]}, ["0.csv"])
    assert dict(claim.facts)["Could also be"] == f"{facts['Could also be']} {like}"


RIVAL = found_effect("payload_mass", None, mass=number(1.0, "kg", 0.02)) | {
    "rivals": [{"effect": "link_inertial", "joint": "wrist_2_joint"}, {"effect": "link_inertial", "joint": "wrist_3_joint"}]
}


def test_rivals_have_their_own_joints_also_in_what_to_record_next():
    assert rivals(RIVAL) == ["inertial parameters of the link of wrist 2", "inertial parameters of the link of wrist 3"]
    said = told_apart({"effects": [RIVAL]}, ["payload_mass", "link_inertial"])
    assert said == "payload mass, inertial parameters of the link of wrist 2, inertial parameters of the link of wrist 3"
    assert told_apart({"effects": []}, ["payload_mass", "link_inertial"]) == "payload mass, inertial parameters of the link"


def stribeck(recordings="all") -> dict:
    return found_effect("stribeck", "a", recordings, excess=number(0.4, "Nm"), velocity=number(0.1, "rad/s"))


def bootstrap(**pairs) -> dict:
    one = lambda value: {"value": value, "interval": None}  # noqa: E731
    return {j: {"before": one(a), "after": one(b), "ratio": one(b / a)} for j, (a, b) in pairs.items()}


def test_the_error_held_out_is_that_of_all_joints_that_the_effect_touches():
    joints = ["a", "b", "c", "d"]
    assert touches(entry("link_inertial", "c"), joints) == ["a", "b", "c"]  # those that carry the link
    assert touches(entry("stribeck", "c"), joints) == ["c"]
    assert touches(entry("payload_mass", None), joints) == joints
    errors = bootstrap(a=(0.4, 0.2), b=(0.3, 0.25), c=(0.6, 0.06), d=(0.5, 0.5))
    found = {"verdict": "missing_physics", "unexplained": [], "bootstrap": errors}
    friction = sentence(found | {"effects": [found_effect("stribeck", "b")]})
    assert friction.endswith("the error of b's torque goes from 30.0 % to 25.0 % of its standard deviation.")
    link = sentence(found | {"effects": [found_effect("link_inertial", "c")]})
    assert (
        "a's torque goes from 40.0 % to 20.0 %, b's torque goes from 30.0 % to 25.0 % and c's torque goes from 60.0 % to 6.00 %"
        in link
    )
    whole = sentence(found | {"effects": [found_effect("payload_mass", None)]})
    assert "goes from 45.0 % to 25.2 % of its standard deviation, as the mean of the 4 joints that this touches" in whole
    assert "from 60.0 % to 50.0 %." in whole


def test_an_effect_that_changes_no_prediction_is_said_to_change_none():
    """A gain of all torques, which heavier links stand for: an error that stays is not told as a gain."""
    found = {"verdict": "missing_physics", "unexplained": [], "mismatch": []}
    found |= {"effects": [found_effect("torque_gain", None, gain=number(0.4, "1"))]}
    found |= {"bootstrap": bootstrap(joint1=(0.013, 0.0131), b=(0.0032, 0.0032))}
    assert sentence(found).endswith("and the error on data left out of the fit is as small.")
    (claim,) = claims(found, ["0.csv"])
    assert "a model without it predicts such recordings as well" in dict(claim.facts)["On unseen data"]
    assert "beyond the angles" not in dict(claim.facts)["On unseen data"]
    (claim,) = claims(found | {"nrmse": {"held_out": {"range": {"joint1": "outside"}}}}, ["0.csv"])
    assert dict(claim.facts)["On unseen data"].endswith(
        "or the law does not hold beyond the angles and speeds that it was fitted to."
    )
    better = found | {"bootstrap": bootstrap(joint1=(0.047, 0.008), b=(0.0032, 0.0032))}
    assert sentence(better).endswith(
        "the error of joint1's torque goes from 4.70 % to 0.800 % of its standard deviation; that of b does not fall."
    )
    (claim,) = claims(better, ["0.csv"])
    unseen = dict(claim.facts)["On unseen data"]
    assert unseen == (
        "On stretches of some seconds left out of the fit, it lowers the error of joint1's torque by 12.3 % (95 %: 10.0 to 20.0 %), "
        "beside all other laws that were found. On whole recordings left out, with all that was found, joint1's goes from 4.70 % to 0.800 % "
        "of the torque's standard deviation."
    )


@pytest.mark.parametrize(
    ("innovations", "said"),
    [
        (None, False),
        ({"share": 0.12, "interval": [0.1, 0.14]}, False),
        ({"share": 0.345, "interval": [0.3, 0.4]}, True),
    ],
)
def test_a_claim_says_what_it_explains_of_what_is_fast_where_that_is_more(innovations, said):
    """Of the error it explains 12.3 %."""
    one = stribeck()
    one["lowers_error"] |= {"innovations": innovations}
    found = {"effects": [one], "unexplained": [], "bootstrap": bootstrap(joint1=(0.4, 0.2)), "mismatch": []}
    (claim,) = claims(found, ["0.csv"])
    unseen = dict(claim.facts)["On unseen data"]
    fast = "Of what is fast in that error, which nothing before foretells, it explains 34.5 % (95 %: 30.0 to 40.0 %)."
    assert unseen.startswith(
        "On stretches of some seconds left out of the fit, it lowers the error of joint1's torque by 12.3 % (95 %: 10.0 to 20.0 %), "
        f"beside all other laws that were found. {f'{fast} ' * said}On whole recordings left out"
    )
    assert ("what is fast" in unseen) == said


@pytest.mark.parametrize(
    ("recordings", "said"),
    [
        ("all", "On a, in all 3 recordings."),
        ("each", "On a, in every recording, with a value of its own."),
        (["0.csv"], "On a, in 1 of 3 recordings (0.csv); the others are explained without it."),
        (["0.csv", "1.csv", "2.csv"], "On a, in all 3 recordings."),
    ],
)
def test_a_claim_says_where_it_is(recordings, said):
    where = {"variable": "q_a", "range": [0.1, 0.2], "unit": "rad", "share_of_error": 0.7, "share_of_time": 0.2}
    found = {"effects": [stribeck(recordings)], "unexplained": [], "bootstrap": bootstrap(a=(0.4, 0.2))}
    (claim,) = claims(found | {"mismatch": []}, ["0.csv", "1.csv", "2.csv"])
    assert dict(claim.facts)["Where"] == said
    assert (claim.law, claim.numbers) == ("law", "excess = 0.400 Nm, velocity = 0.100 rad/s")
    worst = {"joint": "a", "where": [where, {**where, "variable": "time", "share_of_error": 0.99}]}
    (claim,) = claims(found | {"mismatch": [worst]}, ["0.csv", "1.csv", "2.csv"])
    assert dict(claim.facts)["Where"] == (
        f"{said} The model without it fails most at the position of a from 5.7 to 11.5°, with 70 % of the error in 20 % of the time."
    )


def test_a_claim_says_what_it_rests_on_and_what_else_it_could_be():
    prior = {"effect": "stribeck", "joint": "a", "probability": 0.0005, "source": "a book", "claim_rests_on_prior": True}
    one = stribeck() | {"rivals": [{"effect": "quadratic_drag", "joint": "a"}]}
    found = {"effects": [one], "unexplained": [], "bootstrap": bootstrap(a=(0.4, 0.2)), "mismatch": [], "priors": [prior]}
    facts = dict(claims(found, ["0.csv"])[0].facts)
    assert facts["Rests on"] == (
        "Probability 97.0 % that it or one of its rivals is there: of claims like this one about sealed arms, so many were right. It raises "
        "the posterior odds by 12 nats. Before these recordings it was given a probability of 0.05 % (a book). That matters: had it been "
        "10 times less probable before, it would not be claimed."
    )
    assert facts["Could also be"] == "Quadratic drag, which these recordings do not tell apart from it."
    sure = found | {"effects": [stribeck()], "priors": [prior | {"claim_rests_on_prior": False}]}
    facts = dict(claims(sure, ["0.csv"])[0].facts)
    assert "Probability 97.0 % that it is there" in facts["Rests on"]
    assert facts["Rests on"].endswith("it was given a probability of 0.05 % (a book).")
    (claim,) = claims(found | {"priors": []}, ["0.csv"])
    assert dict(claim.facts)["Rests on"].endswith("by 12 nats.")
    assert facts["Could also be"].startswith("Nothing else of the catalogue")


def test_what_stays_unexplained_and_what_to_record_next_are_always_said():
    found = {"effects": [], "unexplained": [], "bootstrap": bootstrap(a=(0.02, 0.02), b=(66.0, 66.0)), "mismatch": []}
    assert remaining(found)[-1].endswith(": 2.00 % on a and 6600 % on b. No joint's error is far above its noise.")
    (check,) = record_next(found)
    assert "rrr-oc evaluate" in check
    errors = {"before": {"a": 0.02, "b": 66.0}, "after": {"a": 0.02, "b": 66.0}}
    still = found | {"nrmse": {"calibration": errors, "held_out": errors}, "verdict": "nothing_missing"}
    assert remaining(still)[0].startswith("The torque of b is explained no better than by a constant")
    assert sentence(still).startswith("Of the other joints nothing is missing. The torque of b is explained no better")
    assert record_next(still)[0].startswith("b in other motions")
    idle = still | {"idle": [{"joint": "b", "torque": 2.0}]}
    assert remaining(idle)[0].startswith("B never moved")
    undecided = idle | {"verdict": "cannot_tell"}
    assert sentence(undecided).startswith(
        "Nothing is missing on the joints that move, and these recordings do not tell of the others. B never moved"
    )
    assert sentence(undecided | {"small": [stribeck()]}) == sentence(undecided)  # nothing of what is small is sure
    missed = {"joint": "a", "significant": True, "where": []}
    assert sentence(undecided | {"mismatch": [missed]}).startswith("Something is missing on a, where the error is far")
    where = [
        {"variable": name, "range": [-0.1, 0.1], "unit": "rad/s", "share_of_error": 0.9, "share_of_time": 0.08}
        for name in ("time", "dq_a")
    ]
    slow = {"mismatch": [{**missed, "where": where}], "left_over": {"a": 3.11}, "verdict": "cannot_tell"}
    assert sentence(found | slow).startswith(
        "Something is missing on a, where the error is 3.1 times the noise, most of it at the speed of a from -6 to 6 °/s, with 90 % of the "
        "error in 8 % of the time. These recordings do not decide what it is"
    )
    assert remaining(idle)[-1].endswith(": 2.00 % on a.")
    assert record_next(idle)[0] == "Motions of b, which never moved here."
    place = {"variable": "q_a", "range": [0.1, 0.2], "unit": "rad", "share_of_error": 0.7, "share_of_time": 0.2}
    left = found | {"left_over": {"a": 7.0}, "mismatch": [{"joint": "a", "where": [place]}]}
    (rest,) = remaining(left)
    assert rest.endswith(": 2.00 % on a and 6600 % on b.")
    part_of = remaining(left | {"effects": [stribeck()]})
    assert part_of == ["What is left is still 7.0 times the noise on a: more is missing, or of another shape.", rest]
    assert "a at the position of a from 5.7 to 11.5°" in record_next(left)[0]
    pushed = {"joint": "a", "recording": "0.csv", "from": 1.0, "to": 1.25, "peak": 4.0}
    assert remaining(left | {"events": [pushed]}) == [*events({"events": [pushed]}), rest]
    doubtful = record_next(found | {"possible": [entry("torque_ripple", "a", 0.5)]})
    assert "they decide about torque ripple of a" in doubtful[0]


def test_events_are_told_with_joint_recording_times_and_peak():
    one = {"joint": "wrist_2_joint", "recording": "1.csv", "from": 2.0, "to": 2.345678, "peak": -3.456}
    said = "took no part, since nothing explains a joint's torque there, as if it was pushed: "
    where = "wrist 2 in 1.csv at 2.00 to 2.35 s (-3.5 Nm)"
    assert events({}) == events({"events": []}) == []
    assert events({"events": [one]}) == [f"1 stretch of time {said}{where}."]
    other = one | {"joint": "a", "recording": "2.csv", "peak": 12.3}
    assert events({"events": [one, other]}) == [f"2 stretches of time {said}{where} and a in 2.csv at 2.00 to 2.35 s (+12 Nm)."]
    (six,) = events({"events": [one] * 6})
    assert (six.count(where), six.count(" and ")) == (6, 1)
    (many,) = events({"events": [one] * 9})
    assert many == f"9 stretches of time {said}{', '.join([where] * 6)} and 3 more."


def test_the_error_that_is_left_falls_part_by_part_to_noise():
    def parts(**shares) -> list[dict]:
        return [{"part": part, "share": share} for part, share in shares.items()]

    ripple, coupled = {"torque_ripple@wrist_2_joint": 0.24}, {"coupled_friction@a wrist_2_joint": 0.11}
    own = {"friction and rotor": 0.64, "links": -0.13, "payload_mass": 0.24}
    rest = {"seen, no law": 0.05, "not explained": 0.08, "noise": 0.01}
    found = {"a": parts(**own, **coupled, **rest), "wrist_2_joint": parts(links=0.51, **ripple, **coupled, noise=0.14)}
    header, body = anatomy({"anatomy": found})
    assert header == ["with", "a", "wrist 2"]
    assert body == [
        ["friction and rotor", "60", ""],
        ["links", "70", "70"],
        ["payload mass", "50", ""],
        ["coupled friction of a and wrist 2", "37.4", "61.6"],
        ["torque ripple of wrist 2", "", "37.4"],
        ["seen, no law", "30", ""],
        ["noise alone", "10", "37.4"],
    ]
    assert anatomy({"anatomy": {"a": parts(links=-0.21)}}) == (["with", "a"], [["links", "110"]])
    assert anatomy({}) == (["with"], [])


def test_a_mass_that_recordings_do_not_tell_is_not_told():
    parts = {"first_moment": {"value": [1.0] * 3, "std": None, "unit": "kg m"}}
    parts["inertia"] = {"value": [[1.0] * 3] * 3, "std": None, "unit": "kg m²"}
    said = plain(found_effect("link_inertial", "a", mass=number(3.0, "kg", 2000.0), **parts))
    assert "may have the mass that the URDF says, the difference being 0 kg (95 %: -2000 to 2000 kg);" in said


def test_the_table_has_words_and_few_digits():
    header, body = rows({"effects": [RIVAL]})
    assert len(header) == len(body[0])
    assert body == [
        [
            "payload mass",
            "all",
            "97.0 %",
            "joint1 by 12.3 % (95 %: 10.0 to 20.0 %)",
            "inertial parameters of the link of wrist 2, inertial parameters of the link of wrist 3",
        ]
    ]


def test_the_page_has_no_raw_names_and_no_sixteen_digits():
    where = [{"variable": "q_wrist_2_joint", "range": [0.1, 0.2], "unit": "rad", "share_of_error": 0.7, "share_of_time": 0.2}]
    found = {
        "verdict": "missing_physics",
        "held_out": "recordings",
        "effects": [RIVAL | {"lowers_error": RIVAL["lowers_error"] | {"joint": "wrist_2_joint"}}],
        "unexplained": [TORQUE | {"joint": "wrist_2_joint", "most_like": LIKE}],
        "small": [stribeck() | {"probability": None}],
        "events": [{"joint": "wrist_2_joint", "recording": "1.csv", "from": 1 / 3, "to": 2 / 3, "peak": 1 / 3}],
        "anatomy": {
            "wrist_2_joint": [
                {"part": "payload_mass", "share": 1 / 3}, {"part": "torque_ripple@wrist_2_joint", "share": 1 / 3},
                {"part": "noise", "share": 1 / 3}
            ]
        },
        "bootstrap": bootstrap(wrist_2_joint=(0.4, 0.2)),
        "nrmse": {"held_out": {"range": {"wrist_2_joint": "outside"}}},
        "mismatch": [
            {"joint": "wrist_2_joint", "significant": True, "p_value": 1e-6, "nrmse": {"calibration": 0.1, "held_out": 0.2},
             "where": where, "recordings": ["1.csv"]}
        ],
        "suggested_recordings": [{"separates": ["payload_mass", "link_inertial"], "why": "so", "trajectory": "suggested 1.csv"}],
        "versions": {"numpy": "2"},
    }  # fmt: skip
    curves = {"files": ["1.csv"], "joints": ["wrist_2_joint"], "worst": 0, "subject": "An arm.", "command": "", "samples": [3]}
    curves |= {"missed": np.ones((1, 1, 2)), "remains": np.ones((1, 1, 2))}
    curves |= {"predicted 0 0": np.full((4, 3), 1 / 3), "left 0 0": np.full((7, 3), 1 / 3)}
    friction = {"effect": "viscous_friction", "joints": ["wrist_2_joint"], "options": {}, "width": None}
    friction["parameters"] = {"coefficient": number(1 / 3, "Nm s/rad", 0.01)}
    model = {"joints": ["wrist_2_joint"], "effects": [friction]}
    text = page(found, {name: np.array(value) for name, value in curves.items()}, model)
    (payload,) = re.findall(r'<script type="application/json" id="data">(.*?)</script>', text)
    assert not re.search(r"\d\.\d{7}", payload)
    text = re.sub(r"<(style|script)[ >].*?</\1>|<[^>]*>", " ", text, flags=re.S)
    assert "The model has 1.00 kg (95 %: 0.98 to 1.02 kg) less at the tool than the arm." in text
    assert "0.33 Nm s/rad" in text
    assert "payload mass, inertial parameters of the link of wrist 2, inertial parameters of the link of wrist 3" in text
    assert "1 stretch of time took no part" in text
    assert "It is most like torque ripple (amplitude = 0.75 Nm" in text
    assert re.search(r"with\s+wrist 2\s+payload mass\s+81\.6\s+torque ripple of wrist 2\s+57\.7\s+noise alone\s+57\.7\s", text)
    assert "Some recordings move wrist 2 at angles or speeds that the others do not reach." in text
    assert not re.search(r"\w_\w|\d\.\d{7}", text.replace("tau_l", ""))


def test_claims_that_are_rather_wrong_than_right_are_not_said_to_be_lacking():
    found = {"verdict": "missing_physics", "unexplained": [], "bootstrap": {}, "effects": [stribeck() | {"probability": 0.3}]}
    assert "fewer than half are right" in sentence(found)
    assert "lacks" not in sentence(found)
    sure = found | {"effects": [*found["effects"], stribeck() | {"probability": 0.9}]}
    assert sentence(sure).startswith("The calibrated model lacks")
