"""Diagnosis of effects that only some of the recordings have."""

from dataclasses import replace

import numpy as np
import pytest
from recorded import Plant, as_set, by_trial, multisine, record

from rrr_oc.calibration.calibrated_model import Estimate, Term
from rrr_oc.calibration.inverse_dynamics import plain_model
from rrr_oc.calibration.jacobian import Prediction
from rrr_oc.calibration.samples import prepare
from rrr_oc.diagnosis.diagnosis_file import to_json
from rrr_oc.diagnosis.held_out import folds_of
from rrr_oc.diagnosis.procedure import diagnose, ready
from rrr_oc.diagnosis.signatures import trials, view
from rrr_oc.diagnosis.structures.search import StructureSearch
from rrr_oc.effects.elastic.parallel_spring import ParallelSpring
from rrr_oc.effects.priors import Priors
from rrr_oc.effects.sensor.torque_offset import TorqueOffset
from rrr_oc.recordings.recording import Recording
from rrr_oc.simulation.replay import pieces

TOOL = (0.3, 0.0, 0.0)  # of the last link [m]


def test_what_is_held_out_leaves_recordings_of_its_kind_behind():
    """Every other recording carries a payload: taking every other one out would leave none."""
    plant, rng = Plant("rrr", np.ones(3), np.ones(3), 0.1 * np.ones(3)), np.random.default_rng(1)
    made = [record(plant, f"{i}.csv", rng, 4.0, payload=2.0 * (i % 2)) for i in range(8)]
    folds = folds_of(ready(as_set(plant, made), Priors())[1].data)
    assert sorted(k for held in folds for k in held) == list(range(8))
    for held in folds:
        assert {k % 2 for k in held} == {0, 1}


@pytest.mark.parametrize("everywhere", [True, False])
def test_an_effect_of_some_groups_is_that_of_all_where_nothing_speaks_against_it(planar, everywhere):
    plant, rng = planar(1), np.random.default_rng(8)
    made_up = [replace(record(plant, f"{k}.csv", rng, 6.0), group="ab"[k % 2]) for k in range(4)]
    offset = [replace(r, tau=r.tau - 2.0) if everywhere or r.group == "a" else r for r in made_up]
    (finding,) = diagnose(as_set(plant, offset)).findings
    assert (finding.term.effect, finding.term.groups) == (TorqueOffset((0,)), () if everywhere else ("a",))
    assert finding.term.values == pytest.approx([-2.0], rel=0.02)


def test_a_spring_that_is_slack_in_one_recording_is_that_of_all(planar):
    """What a trial of another equilibrium ruled out there, the fitted spring allows."""
    plant, rng, made = planar(1), np.random.default_rng(4), []
    for k in range(4):
        q, dq, ddq = (np.array([1.0, 1.0, 1.0, 0.3])[k] * x for x in multisine(1, np.arange(800) / 100, rng))
        r = record(plant, f"{k}.csv", rng, 8.0, motion=(q, dq, ddq))
        made.append(replace(r, tau=r.tau + 8.0 * np.maximum(r.q - 0.35, 0.0), group=str(k)))  # [Nm], [rad]
    assert made[3].q.max() < 0.35 < min(r.q.max() for r in made[:3])
    _, fitter, every, plain = ready(as_set(plant, made), Priors())
    effect = ParallelSpring((0,), active="above")
    width = next(t.width for t in every if t.effect == effect)
    law = Term(effect, (Estimate(7.0), Estimate(0.3)), width, (), ("0", "1", "2"))
    fit = fitter.fit(replace(plain, terms=(*plain.terms, law)), fitter.data.links.none)
    search = StructureSearch.of(fitter, [t for t in every if isinstance(t.effect, ParallelSpring)])
    (spring,) = search.run(fit).fitted.extra
    assert (spring.effect, spring.recordings, spring.groups) == (effect, "all", ())
    assert spring.values == pytest.approx([8.0, 0.35], rel=0.05)


@pytest.mark.parametrize("change", ["payload", "gain"])
def test_what_only_one_recording_has_is_found_there(planar, change):
    """Nothing but pieces of that recording can confirm it."""
    plant, rng = planar(1), np.random.default_rng(2)
    made = [
        record(plant, f"{i}.csv", rng, 10.0, 0.01, None, None, 0.5 * (change == "payload" and i == 1), TOOL) for i in range(4)
    ]
    made = [replace(r, payload=0 * r.t) for r in made]
    other = {"payload": 1.0, "gain": 1.1}[change] * made[1].tau
    recordings = as_set(plant, [made[0], replace(made[1], tau=other), *made[2:]])
    recordings = replace(recordings, tool=recordings.robot.point(recordings.robot.links[-1], TOOL))
    (found,) = diagnose(recordings).findings
    names = {"payload": "payload_mass", "gain": "torque_gain"}
    assert found.term.effect.name == names[change]
    assert found.term.groups == ("1.csv",)


def test_a_payload_that_runs_through_many_values_costs_no_more(planar):
    """What a payload does to the links is affine in its mass: the same as with each mass by itself."""
    plant, rng = planar(2), np.random.default_rng(8)
    r = record(plant, "0.csv", rng, 3.0)
    ramp = replace(r, payload=np.linspace(0.0, 2.0, len(r.t)))
    whole = as_set(plant, [ramp])
    whole = replace(whole, tool=whole.robot.point(whole.robot.links[-1], [0.2, 0.1, 0]))
    model, at = plain_model(whole), [0, 150, 299]
    moving = Prediction(model, prepare(whole)[0].recording)
    for k in at:
        held = replace(whole, recordings=(replace(r, payload=np.full(len(r.t), ramp.payload[k])),))
        alone = Prediction(model, prepare(held)[0].recording)
        for a, b in zip(moving.partials, alone.partials, strict=True):
            assert a[..., k] == pytest.approx(b[..., k], abs=1e-9)
        trial = next(t for t in trials(view(prepare(whole), model), "motor") if t.effect.name == "payload_com")
        assert by_trial(moving, trial)[..., k] == pytest.approx(by_trial(alone, trial)[..., k], abs=1e-9)
    assert 10 < len(pieces(ramp)) < 60


def with_changes(plant: Plant, rng: np.random.Generator, change, count: int = 5) -> list[Recording]:
    """Recordings of 10 s, each with what `change` adds to the torque of one of this number."""
    made = [record(plant, f"{i}.csv", rng, 10.0, 0.01) for i in range(count)]
    return [replace(r, tau=r.tau + change(i, r)) for i, r in enumerate(made)]


def test_an_effect_may_be_another_in_each_recording(planar):
    plant, rng, truth = planar(1), np.random.default_rng(9), {1: 0.6, 3: -0.5, 4: 1.2}
    found = diagnose(as_set(plant, with_changes(plant, rng, lambda i, r: truth.get(i, 0.0)))).findings
    assert {f.term.effect.name for f in found} == {"torque_offset"}
    (offset,) = (f.term for f in found)
    assert offset.named == pytest.approx({f"{i}.csv": truth.get(i, 0.0) for i in range(len(offset.values))}, abs=0.01)


def test_friction_may_be_another_in_some_recordings(planar):
    """As of a gear that was cold: no law of the catalogue, and friction that grows with load least of all."""
    plant, rng, truth = planar(1), np.random.default_rng(3), {0: (0.6, 0.3), 1: (0.3, 0.1), 2: (0.15, 0.1)}

    def change(i: int, r: Recording) -> np.ndarray:
        dry, viscous = truth.get(i, (0.0, 0.0))
        return dry * np.tanh(r.dq / plant.width) + viscous * r.dq

    found = diagnose(as_set(plant, with_changes(plant, rng, change, 6)))
    terms = [f.term for f in found.findings]
    assert {(t.effect.name, t.effect.joints, t.groups) for t in terms} == {("friction_course", (0,), ())}
    dry, viscous = (t.values[0] for t in found.model.terms[:2])
    for speed in (0.3, 1.0):  # by how much it is larger than in the last recording, which is as usual
        size = {"friction": dry + viscous * speed, "dry": 1.0, "viscous": speed}
        more = sum(size[t.effect.part] * (t.values - t.values[-1]) for t in terms)
        np.testing.assert_allclose(more, [np.dot(truth.get(i, (0, 0)), (1, speed)) for i in range(6)], atol=0.03)


def test_friction_that_two_recordings_have_in_common_is_a_change_of_these(planar):
    """As of a load on a bearing that was mounted twice: what changes from recording to recording has no such course."""
    plant, rng = planar(2), np.random.default_rng(3)

    def change(i: int, r: Recording) -> np.ndarray:
        return [[0.0], [float(i in (0, 3))]] * (0.6 * np.tanh(r.dq / plant.width) + 0.3 * r.dq)

    (finding,) = diagnose(as_set(plant, with_changes(plant, rng, change, 6))).findings
    assert (finding.term.effect.name, finding.term.effect.joints) == ("friction_change", (1,))
    assert finding.term.groups == ("0.csv", "3.csv")
    assert finding.term.values == pytest.approx([0.6, 0.3], abs=0.02)


def test_friction_that_falls_from_recording_to_recording_is_one_entry(planar):
    """As of a gear that warms up over a session whose clock nobody kept: not a change of some recordings, one beside the other."""
    plant, rng, truth = planar(2), np.random.default_rng(4), [0.9, 0.6, 0.4, 0.25, 0.1]
    found = diagnose(as_set(plant, with_changes(plant, rng, lambda i, r: [[0.0], [truth[i]]] * r.dq)))
    effect = found.findings[0].term.effect
    assert (effect.name, effect.joints) == ("friction_course", (1,))
    assert all(f.term.groups == () for f in found.findings)
    (told,) = to_json(found)["unexplained"]
    assert (told["joint"], told["recordings"], told["depends_on"]) == ("j2", "each", ["time", "dq_j2"])
    ((name, viscous),) = told["parameters"].items()
    assert (name, viscous["unit"]) == ("viscous", "Nm s/rad")
    values = {file: one["value"] for file, one in viscous["by_recording"].items()}
    assert list(values) == [f"{i}.csv" for i in range(5)]
    values = np.array(list(values.values()))
    assert np.all(np.diff(values) < 0)
    np.testing.assert_allclose(np.diff(values), np.diff(truth), atol=0.05)  # what all have in common is plain friction
    assert "viscous friction that changes from recording to recording" in told["description"]
    assert "lower each time" in told["description"]


def test_payloads_may_be_others_in_each_recording(planar):
    plant, rng, truth = planar(1), np.random.default_rng(2), {1: 1.0, 3: 3.0}
    made = [record(plant, f"{i}.csv", rng, 10.0, 0.01, None, None, truth.get(i, 0.0), TOOL) for i in range(5)]
    recordings = as_set(plant, [replace(r, payload=0 * r.t) for r in made])
    recordings = replace(recordings, tool=recordings.robot.point(recordings.robot.links[-1], TOOL))
    found = diagnose(recordings).findings
    assert {f.term.effect.name for f in found} == {"payload_mass"}
    assert {g: f.term.values[0] for f in found for g in f.term.groups} == pytest.approx({"1.csv": 1.0, "3.csv": 3.0}, rel=0.02)


def test_a_spring_of_one_recording_of_many_beside_a_law_of_all(planar):
    """Engaged half of the time in one of eight: what counts is whether it helps there."""
    plant, rng = planar(1), np.random.default_rng(11)

    def change(i: int, r: Recording) -> np.ndarray:
        return 0.6 * r.dq * np.abs(r.dq) - (i == 2) * 8.0 * np.maximum(0.0 - r.q, 0.0)

    found = diagnose(as_set(plant, with_changes(plant, rng, change, 8))).findings
    assert {(f.term.effect.name, f.term.groups) for f in found} == {("quadratic_drag", ()), ("parallel_spring", ("2.csv",))}


def test_a_payload_that_was_listed_and_not_mounted(planar):
    plant, rng = planar(1), np.random.default_rng(12)
    made = [record(plant, f"{i}.csv", rng, 10.0, 0.01, None, None, 3.0 * (i == 3), TOOL) for i in range(4)]
    made = [replace(r, payload=0 * r.t + 3.0 * (i in (1, 3))) for i, r in enumerate(made)]
    recordings = as_set(plant, made)
    recordings = replace(recordings, tool=recordings.robot.point(recordings.robot.links[-1], TOOL))
    (found,) = diagnose(recordings).findings
    assert (found.term.effect.name, found.term.groups) == ("payload_mass", ("1.csv",))
    assert found.term.values == pytest.approx([-3.0], rel=0.02)
