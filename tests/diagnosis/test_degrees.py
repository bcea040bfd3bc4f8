"""What is said of a missing torque where more or less is known of it: the law, on what it depends, when nothing explains it; of how much
of the error each part is, and how often that is right."""

from dataclasses import replace

import chains
import msgspec
import numpy as np
import pytest
from filled import filled
from recorded import Plant, as_set, record
from scipy.special import logit

from rrr_oc.diagnosis.claims import reliability
from rrr_oc.diagnosis.claims.dependence import Shape, reached
from rrr_oc.diagnosis.claims.reliability import LEAST, MOST, NAMES, Regression, features, judged, probability_of, regression
from rrr_oc.diagnosis.diagnosis_file import DiagnosisFile, Unexplained, to_json
from rrr_oc.diagnosis.procedure import diagnose
from rrr_oc.report.diagnosis_words import wanders


def bump(q):
    """A torque that is unlike any law of the catalogue [Nm]."""
    return 1.2 * np.exp(-(((q - 0.3) / 0.35) ** 2)) - 0.8 * np.exp(-(((q + 0.9) / 0.3) ** 2))


@pytest.fixture(scope="module")
def described(tmp_path_factory):
    (urdf := tmp_path_factory.mktemp("arm") / "arm.urdf").write_text(chains.arm(1))
    plant, rng = Plant(urdf, np.ones(1), np.ones(1), 0.1 * np.ones(1)), np.random.default_rng(5)
    made = [record(plant, f"{i}.csv", rng, 12.0, 0.01) for i in range(3)]
    return diagnose(as_set(plant, [replace(r, tau=r.tau + bump(r.q)) for r in made]))


def test_a_torque_over_the_angle_that_no_law_is_like_is_told_as_that(described):
    """It is in the model, with its variables and the law that comes closest, and no law is named."""
    found = to_json(described)
    assert found["effects"] == []
    assert [u["depends_on"] for u in found["unexplained"]] == [["q_j1"]]
    (u,) = found["unexplained"]
    assert u["lowers_error"]["interval"][0] > 0.5
    assert u["most_like"] is None or u["most_like"]["reaches"] < 0.9
    (term,) = (f.term for f in described.findings)
    assert term == described.model.terms[-1]
    q = np.linspace(-1.5, 1.5, 50)
    there = (q > term.effect.low[0]) & (q < term.effect.high[0])
    basis = term.effect.basis(type("S", (), {"q": q[None], "dq": 0 * q[None]}), 0.1)
    torque = sum(c * b for c, b in zip(term.values, basis, strict=True))
    left, of_links = (torque + bump(q))[there], np.array([np.ones(there.sum()), np.sin(q[there]), np.cos(q[there])]).T
    left -= of_links @ np.linalg.lstsq(of_links, left, rcond=None)[0]  # it opposes what is added to the motor's torque
    assert np.std(left) < 0.15 * np.std(bump(q)[there])


def test_the_parts_of_an_error_add_up_to_it(described):
    (parts,) = described.anatomy
    assert sum(parts.values()) == pytest.approx(1, abs=1e-9)
    assert 0.02 < parts["seen, no law"] < 0.3
    assert 0 < parts["noise"] < 0.05
    assert abs(parts["not explained"]) < 0.05


@pytest.fixture(scope="module")
def dragged(tmp_path_factory):
    """A diagnosis that names one law."""
    (urdf := tmp_path_factory.mktemp("arm") / "arm.urdf").write_text(chains.arm(1))
    plant, rng = Plant(urdf, np.ones(1), np.ones(1), 0.1 * np.ones(1)), np.random.default_rng(8)
    made = [record(plant, f"{i}.csv", rng, 6.0, 0.01) for i in range(3)]
    return diagnose(as_set(plant, [replace(r, tau=r.tau + 0.6 * r.dq * np.abs(r.dq)) for r in made]))


@pytest.mark.parametrize(
    ("law", "dependence", "verdict"), [(0.8, 0.9, "missing_physics"), (0.3, 0.9, "missing_physics"), (0.3, 0.2, "cannot_tell")]
)
def test_a_law_that_is_rather_wrong_than_right_is_told_as_what_its_torque_is_most_like(
    dragged, monkeypatch, law, dependence, verdict
):
    """Probabilities are made up, of a claim that names a law and of one that tells joint and variables."""
    of_law, of_dependence = ((logit(p), *(len(NAMES) - 1) * [0.0]) for p in (law, dependence))
    made_up = Regression(of_law, of_dependence, (1, 1), "")
    monkeypatch.setattr(reliability, "regression", lambda: made_up)
    found = to_json(replace(dragged, findings=tuple(judged(dragged.findings, dragged.anatomy))))
    assert found["verdict"] == verdict
    named = [(e["effect"], pytest.approx(e["probability"])) for e in found["effects"]]
    if law > 0.5:
        assert (named, found["unexplained"]) == ([("quadratic_drag", law)], [])
        return
    assert named == []
    (u,) = found["unexplained"]
    told = msgspec.convert(u, Unexplained)  # all that the file declares
    assert (told.joint, told.depends_on, pytest.approx(told.probability), told.recordings) == (
        "j1",
        ("dq_j1",),
        dependence,
        "all",
    )
    assert told.parameters == {}
    assert told.most_like is not None
    assert (told.most_like.effect, told.most_like.joint) == ("quadratic_drag", "j1")
    assert told.most_like.parameters["coefficient"].value == pytest.approx(0.6, rel=0.05)
    assert "of which no law is sure" in told.description


def test_pushes_are_told_with_their_times_and_change_nothing(planar):
    """Without them the recordings are explained to their noise, by the same friction."""
    plant, rng = planar(1), np.random.default_rng(6)
    made = [record(plant, f"{i}.csv", rng, 15.0, 0.01) for i in range(3)]
    times = [(3.1, 9.4), (5.2,), (2.2, 7.7, 11.6)]
    pushed = [
        replace(r, tau=r.tau + 3.0 * sum(np.abs(r.t - t) < 0.1 for t in some)) for r, some in zip(made, times, strict=True)
    ]
    found, clean = (diagnose(as_set(plant, one)) for one in (pushed, made))
    assert found.findings == clean.findings == clean.events == ()
    assert found.verdict == "nothing_missing"
    true = [(f"{i}.csv", t) for i, some in enumerate(times) for t in some]
    assert [e.recording for e in found.events] == [file for file, _ in true]
    assert all(e.begin < t < e.end < e.begin + 1 for e, (_, t) in zip(found.events, true, strict=True))
    assert all(1 < e.peak < 4 for e in found.events)
    own, other = ([t.values for t in one.model.terms if t.effect.name == "dry_friction"] for one in (found, clean))
    np.testing.assert_allclose(own, other, rtol=0.02)


def test_what_comes_again_where_the_state_does_is_no_event(planar):
    """A detent that the joint passes every few seconds is as large and as short as a push."""
    plant, rng = planar(1), np.random.default_rng(7)
    made = [record(plant, f"{i}.csv", rng, 15.0, 0.01) for i in range(3)]
    there = [replace(r, tau=r.tau + 3.0 * np.exp(-(((r.q - 0.2) / 0.06) ** 2))) for r in made]
    assert diagnose(as_set(plant, there)).events == ()


def shape(share):
    """Something with which the error falls by a share."""
    return Shape(None, share)  # pyright: ignore[reportArgumentType]


class Place:
    """A place whose falls are shares."""

    @staticmethod
    def measure(falls):
        return type("Fall", (), {"share": falls})


def test_reach_is_what_is_explained_of_what_the_best_explains():
    """By rms: a law that leaves 0.6 of a torque of which a function leaves nothing reaches 0.4; what makes it worse reaches less than 0."""
    every = reached(Place(), [shape(1.0), shape(0.4), shape(0.0), shape(-0.5)])  # pyright: ignore[reportArgumentType]
    assert [s.reach for s in every] == pytest.approx([1.0, 0.4, 0.0, -0.5])
    assert [s.reach for s in reached(Place(), [shape(0.0)])] == [0.0]  # pyright: ignore[reportArgumentType]


def quantities(log_odds=50.0):
    return features(log_odds, [0.4], (0.05, 0), {"noise": 0.01, "not explained": 0.0}, 1.0)


def test_a_probability_is_that_of_the_regression_and_never_certain():
    law = regression().law
    sure = probability_of(quantities(), law)
    assert len(quantities()) == len(NAMES) == len(law) == len(regression().dependence)
    assert LEAST <= sure <= MOST
    assert sure == pytest.approx(1 / (1 + np.exp(-quantities() @ np.array(law))))
    assert probability_of(quantities(log_odds=1e9), law) <= MOST


def test_a_zero_that_wanders_is_told_and_no_law_is_found_in_it(planar):
    """The torque's zero takes a random walk, of 1 % of the torque's spread in a second."""
    plant, rng = planar(2), np.random.default_rng(9)
    made = [record(plant, f"{i}.csv", rng, 12.0, 0.005) for i in range(3)]
    walks = [np.cumsum(rng.standard_normal(r.tau.shape), axis=1) * 0.1 * 0.01 for r in made]
    sizes = np.mean([r.tau.std(axis=1, keepdims=True) for r in made], axis=0)
    found = diagnose(as_set(plant, [replace(r, tau=r.tau + sizes * walk) for r, walk in zip(made, walks, strict=True)]))
    assert (found.findings, found.undecided, found.links) == ((), (), ())
    assert found.verdict == "nothing_missing"
    assert all(0.003 < x / size < 0.1 for x, size in zip(found.wander, sizes[:, 0], strict=True))
    content = to_json(found) | {"bootstrap": {}}
    assert content["wander"] == dict(zip(("j1", "j2"), found.wander, strict=True))
    (said,) = wanders(filled(content, DiagnosisFile))
    assert "as the zero of a torque sensor that wanders" in said
