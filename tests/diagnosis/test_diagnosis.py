"""Diagnosis of recordings that an independent plant made, with an effect concealed in them or with none."""

import itertools
import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import chains
import msgspec
import numpy as np
import pytest
from recorded import Plant, as_set, by_engine, multisine, point_to_point, record
from typer.testing import CliRunner

from rrr_oc.calibration.calibrate import calibrate
from rrr_oc.calibration.calibrated_model import Estimate, Term, nominal_term
from rrr_oc.calibration.friction_width import widened
from rrr_oc.calibration.inverse_dynamics import fit_terms, plain_model
from rrr_oc.calibration.jacobian import Prediction
from rrr_oc.calibration.model_file import load_model, save_model
from rrr_oc.calibration.prediction_error import evaluate_inverse
from rrr_oc.calibration.regression import rows
from rrr_oc.calibration.samples import prepare
from rrr_oc.commands import app
from rrr_oc.diagnosis.diagnosis_file import DiagnosisFile, to_json
from rrr_oc.diagnosis.findings import Finding
from rrr_oc.diagnosis.held_out import folds_of
from rrr_oc.diagnosis.procedure import diagnose, ready
from rrr_oc.diagnosis.signatures import table, trials, view
from rrr_oc.diagnosis.suggestion import suggest
from rrr_oc.effects import Trial
from rrr_oc.effects.black_box.empirical import Empirical
from rrr_oc.effects.friction.coulomb_asymmetry import CoulombAsymmetry
from rrr_oc.effects.friction.quadratic_drag import QuadraticDrag
from rrr_oc.effects.priors import Priors
from rrr_oc.effects.sensor.torque_gain import TorqueGain
from rrr_oc.effects.sensor.torque_offset import TorqueOffset
from rrr_oc.effects.transmission.torque_ripple import TorqueRipple
from rrr_oc.model.symbolic_model import Model
from rrr_oc.numerics.rank import pseudo_inverse
from rrr_oc.recordings.reader import load_recordings
from rrr_oc.recordings.recording import Recording
from rrr_oc.report.diagnosis_report import write_diagnosis
from rrr_oc.report.diagnosis_words import sentence
from rrr_oc.robot.robot import ToolPoint, load_robot
from rrr_oc.simulation.replay import pieces
from validation.concealed.build import build
from validation.concealed.cases import Case, Concealed
from validation.concealed.write import write_case

TOOL = (0.3, 0.0, 0.0)  # of the last link [m]


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Folder of a short case of the plant, made once for each declaration."""
    folder, cases = tmp_path_factory.mktemp("cases"), {}

    def make(key: str, robot: str, *concealed: Concealed) -> tuple[Path, dict]:
        if key not in cases:
            case = Case(key, "test", 11, robot, concealed, short=True)
            (folder / "sealed").mkdir(exist_ok=True)
            write_case(build(case), folder)
            truth = json.loads((folder / "sealed" / f"{case.id}.json").read_text())
            cases[key] = (folder / case.id, truth)
        return cases[key]

    return make


def run(*arguments: object) -> None:
    result = CliRunner().invoke(app, [str(a) for a in arguments], catch_exceptions=False)
    assert result.exit_code == 0, result.output


@cache
def output(case: Path) -> Path:
    """Where a case's diagnosis is, made once."""
    run("diagnose", case / "data", "--out", case / "out", "--jobs", 1)
    return case / "out"


def diagnosed(case: Path) -> dict:
    out = output(case)
    text = (out / "diagnosis.json").read_text()
    assert msgspec.json.decode(text, type=DiagnosisFile).held_out in ("recordings", "blocks")  # as its reference describes it
    files = {"diagnosis.json", "model.json", "report.html", "figures.npz", "before_after.png", "prediction.png"}
    assert {p.name for p in out.iterdir()} >= files
    return json.loads(text)


@pytest.mark.parametrize(
    ("robot", "effect"),
    [("arm2", "load_dependent_friction"), ("arm2", "encoder_offset"), ("arm1", "stribeck"), ("arm2", "torque_gain")],
)
def test_names_what_was_concealed(made, robot, effect):
    case, truth = made(f"{effect}/{robot}", robot, Concealed(effect, 2.0))
    found = diagnosed(case)
    (hidden,) = truth["effects"]
    assert found["format"] == "rrr_oc-diagnosis/1"
    assert found["verdict"] == "missing_physics"
    assert [(e["effect"], e["joint"], e["recordings"]) for e in found["effects"]] == [(effect, hidden["joint"], "all")]
    for name, parameter in found["effects"][0]["parameters"].items():
        true = hidden["parameters"][name]["value"]
        assert abs(parameter["value"] - true) < 5 * parameter["std"] + 0.02 * abs(true)  # the plant's law is sampled
    assert all(m["significant"] == (m["joint"] == hidden["joint"]) for m in found["mismatch"] if m["joint"] == hidden["joint"])


def test_what_is_decided_by_the_past_is_said_to_be(made):
    """A payload that sloshes: nothing of the instant explains it."""
    case, truth = made("sloshing", "arm3", Concealed("sloshing_payload", 3.0))
    found = diagnosed(case)
    assert found["effects"] == []
    assert all(u["depends_on"] == ["load_torque", "time"] for u in found["unexplained"])
    model = load_model(output(case) / "model.json")
    frequency = truth["effects"][0]["parameters"]["omega"]["value"]
    assert any(abs(t.named["frequency"] / frequency - 1) < 0.15 for t in model.terms if t.effect.name == "echo")


def test_repaired_model_predicts_unseen_recordings(made, tmp_path):
    case, truth = made("load_dependent_friction/arm2", "arm2", Concealed("load_dependent_friction", 2.0))
    found = diagnosed(case)
    run("calibrate", case / "data", "--out", tmp_path / "plain")
    unseen, joint = load_recordings(case / "unseen"), truth["effects"][0]["joint"]
    plain, repaired = (evaluate_inverse(load_model(at / "model.json"), unseen) for at in (tmp_path / "plain", output(case)))
    for file in plain:
        assert repaired[file][joint]["nrmse"] < 0.7 * plain[file][joint]["nrmse"]
    for when in ("before", "after"):
        entry = found["bootstrap"][joint][when]
        assert entry["value"] == pytest.approx(found["nrmse"]["held_out"][when][joint])
        assert entry["interval"][0] < entry["value"] < entry["interval"][1]
    assert found["bootstrap"][joint]["ratio"]["interval"][1] < 1
    assert found["simulated"]["after"][joint]["tau_load"] < found["simulated"]["before"][joint]["tau_load"]


@pytest.mark.parametrize("robot", ["arm1", "arm3"])
def test_stays_silent_where_nothing_is_missing(made, robot):
    case, _ = made(f"clean/{robot}", robot)
    found = diagnosed(case)
    assert found["verdict"] == "nothing_missing"
    assert found["effects"] == []
    assert found["unexplained"] == []
    assert not any(m["significant"] for m in found["mismatch"])


def test_what_is_held_out_leaves_recordings_of_its_kind_behind():
    """Every other recording carries a payload: taking every other one out would leave none."""
    plant, rng = Plant("rrr", np.ones(3), np.ones(3), 0.1 * np.ones(3)), np.random.default_rng(1)
    made = [record(plant, f"{i}.csv", rng, 4.0, payload=2.0 * (i % 2)) for i in range(8)]
    way, _, folds = folds_of(ready(as_set(plant, made), Priors())[1].data)
    assert way == "recordings"
    assert sorted(k for held in folds for k in held) == list(range(8))
    for held in folds:
        assert {k % 2 for k in held} == {0, 1}


@pytest.fixture
def planar(tmp_path):
    """Makes a plant of so many joints whose axes are horizontal and parallel."""

    def make(joints: int) -> Plant:
        urdf = tmp_path / "arm.urdf"
        urdf.write_text(chains.arm(joints))
        return Plant(urdf, np.ones(joints), np.ones(joints), 0.1 * np.ones(joints))

    return make


@pytest.mark.parametrize("width", [0.014, 0.03, 0.07])
def test_nothing_is_missing_whatever_the_width_of_dry_friction(planar, width):
    """A width that is some per cent off would look like a law of low speeds."""
    plant, rng = replace(planar(1), width=width), np.random.default_rng(3)
    slow = (multisine(1, np.arange(1500) / 100, rng, 0.3) for _ in range(4))
    made = [record(plant, f"{i}.csv", rng, 15.0, 0.005, motion) for i, motion in enumerate(slow)]
    assert not diagnose(as_set(plant, made)).findings


TURNS = {
    "arctan": lambda x: 2 / np.pi * np.arctan(x),
    "root": lambda x: x / np.sqrt(1 + x**2),
    "ratio": lambda x: x / (1 + np.abs(x)),
    "clip": lambda x: np.clip(x, -1, 1),
}


def turned(plant: Plant, turn: str, drag: float) -> list[Recording]:
    """Recordings of one joint whose dry friction changes sign over 0.04 rad/s in another way, with quadratic drag."""
    rng, made = np.random.default_rng(3), []
    for i in range(4):
        motion = multisine(1, np.arange(1500) / 100, rng, 0.5)
        r, dq = record(plant, f"{i}.csv", rng, 15.0, 0.005, motion), motion[1]
        made.append(replace(r, tau=r.tau + TURNS[turn](dq / 0.04) - np.tanh(dq / plant.width) + drag * dq * np.abs(dq)))
    return made


@pytest.mark.parametrize("turn", ["arctan", "root", "ratio", "clip"])
def test_dry_friction_may_change_sign_in_other_ways(planar, turn):
    """What is between tanh and the other way looks like laws of speed; beside it, a true one is still named."""
    plant = planar(1)
    assert not diagnose(as_set(plant, turned(plant, turn, 0.0))).findings
    (drag,) = diagnose(as_set(plant, turned(plant, turn, 0.3))).findings
    assert drag.term.effect == QuadraticDrag((0,))
    assert drag.term.values == pytest.approx([0.3], rel=0.1)


def test_a_law_is_named_rather_than_a_series_that_also_says_how_friction_changes_sign(planar):
    plant, rng, made = planar(2), np.random.default_rng(5), []
    for i in range(4):
        motion = multisine(2, np.arange(1000) / 100, rng, 0.4)
        r = record(plant, f"{i}.csv", rng, 10.0, 0.003, motion)
        made.append(
            replace(r, tau=r.tau + np.clip(motion[1] / 0.05, -1, 1) - np.tanh(motion[1] / plant.width) + [[0.0], [0.4]])
        )
    (found,) = diagnose(as_set(plant, made)).findings
    assert found.term.effect == TorqueOffset((1,))
    assert found.term.values == pytest.approx([0.4], rel=0.05)


def test_ripples_of_many_orders_are_found_and_what_is_weaker_than_they(planar):
    plant, rng, orders = planar(1), np.random.default_rng(8), {12: 0.4, 24: 0.3, 31: 0.2, 40: 0.15}
    made = [record(plant, f"{i}.csv", rng, 10.0, 0.01) for i in range(4)]
    gear = [replace(r, tau=r.tau + 0.1 + sum(a * np.sin(k * r.q + k) for k, a in orders.items())) for r in made]
    found = [f.term for f in diagnose(as_set(plant, gear)).findings]
    ripples = {round(t.named["order"]): t.named["amplitude"] for t in found if t.effect == TorqueRipple((0,))}
    assert ripples == pytest.approx(orders, rel=0.05)
    assert [t.effect.name for t in found if t.effect != TorqueRipple((0,))] == ["torque_offset"]


@pytest.mark.parametrize("gain", [-0.6, 1.5])
def test_a_gain_at_its_bound_is_none(gain):
    """There all that the joint has scales with it."""
    assert not TorqueGain((0,)).possible({"gain": gain}, 0.0)
    assert TorqueGain((0,)).possible({"gain": 0.9 * gain}, 0.0)


@pytest.mark.parametrize(("seed", "loss"), [(1, 1.0), (2, 1.0)])
def test_abrupt_dry_friction_that_holds_a_joint_for_a_moment_is_no_effect(planar, seed, loss):
    plant, rng = planar(1), np.random.default_rng(seed)
    found = diagnose(as_set(plant, [by_engine(plant, f"{i}.csv", rng, loss) for i in range(4)]))
    assert not found.findings


def test_a_tilt_is_found_where_one_of_its_angles_does_nothing(planar):
    """Arms that move in a plane hardly feel a tilt about an axis in it; what is fitted to it is beyond all bounds."""
    plant, rng = planar(2), np.random.default_rng(3)
    plant.model.gravity.linear = 9.81 * np.array([np.sin(0.03), 0.0, -np.cos(0.03)])
    found = diagnose(as_set(plant, [record(plant, f"{i}.csv", rng, 6.0) for i in range(4)]))
    (finding,) = found.findings
    equal = {"gravity_tilt", "encoder_offset", "backlash"}  # all turn the first link
    assert finding.term.effect.name in equal
    assert equal <= {finding.term.effect.name, *(name for name, _ in finding.rivals)}


def with_stops(plant: Plant, name: str, rng: np.random.Generator) -> Recording:
    """Motions of a second or two with stops between them, where some of the friction stays."""
    t, n = np.arange(2000) / 100, plant.n
    q, dq, ddq = np.zeros((3, n, len(t)))
    resting, stuck = np.ones(len(t), bool), np.zeros((n, len(t)))
    at = 50
    while at < len(t) - 250:
        count, size = int(rng.integers(100, 200)), rng.uniform(-1.0, 1.0, (n, 1)) - 0.5 * q[:, at : at + 1]
        s, seconds, own = np.arange(count) / count, count / 100, slice(at, at + count)
        q[:, at:] += size * np.concatenate([10 * s**3 - 15 * s**4 + 6 * s**5, np.ones(len(t) - at - count)])
        dq[:, own] = size * (30 * s**2 - 60 * s**3 + 30 * s**4) / seconds
        ddq[:, own] = size * (60 * s - 180 * s**2 + 120 * s**3) / seconds**2
        resting[own] = False
        at += count + int(rng.integers(60, 120))
        stuck[:, own.stop : at] = rng.uniform(0.0, 1.0, (n, 1)) * np.sign(size) * plant.dry[:, None]
    stopped = record(plant, name, rng, 20.0, 0.005, motion=(q, dq, ddq))
    return replace(stopped, tau=stopped.tau + stuck * resting)


def test_nothing_is_missing_where_joints_stop_and_some_of_their_friction_stays(planar):
    plant, rng = planar(2), np.random.default_rng(7)
    found = diagnose(as_set(plant, [with_stops(plant, f"{i}.csv", rng) for i in range(4)]))
    assert found.findings == ()
    dry = [term.values[0] for term in found.plain.terms if term.effect.name == "dry_friction"]
    assert dry == pytest.approx(plant.dry, rel=0.02)


@pytest.mark.parametrize(
    ("name", "width", "noise"),
    [
        ("torque_offset", 0.02, 0.02),
        ("torque_offset", 0.02, 0.2),
        ("torque_offset", 0.05, 0.02),
        ("coulomb_asymmetry", 0.05, 0.02),
    ],
)
def test_of_two_laws_alike_in_motion_the_one_that_holds_at_rest_is_named(planar, name, width, noise):
    plant = replace(planar(1), width=width)
    (finding,) = diagnose(as_set(plant, point_to_point(plant, noise, 1.0 if name == "torque_offset" else 0.0))).findings
    assert finding.term.effect.name == name


def test_a_motion_is_suggested_that_tells_a_series_from_its_rival(made):
    case, _ = made("clean/arm2", "arm2")
    recordings = load_recordings(case / "data")
    prepared, plain = prepare(recordings), plain_model(recordings)
    effect = Empirical((1,), (("q", 1),), (-1.0,), (1.0,), edges=((1, 0.9, 3), (-1, 0.1, 3)))

    def apart(size: float) -> str:
        found = Finding(Term(effect, (Estimate(size), Estimate(-size)), 0.05), 1.0, 0.6, 50.0, 1e-9, (("torque_offset", (1,)),))
        (suggestion,) = suggest(recordings, replace(plain, noise=np.full(2, 0.01)), [found], False, view(prepared, plain))
        assert suggestion.separates == ("empirical", "torque_offset")
        return suggestion.why

    assert "differ by 0" not in apart(300.0)
    assert apart(300.0) != apart(3.0)


@pytest.mark.parametrize("undecided", [False, True])
def test_a_suggested_motion_keeps_to_what_the_arm_can_do(planar, undecided):
    """Recorded with the joints in step: most motions within their ranges would need more torque and come lower than recorded."""
    plant, made = planar(2), []
    t = np.arange(1000) / 100
    for i, w in enumerate((0.6, 0.8, 1.0)):
        one = np.array([0.8 * np.sin(w * t), 0.8 * w * np.cos(w * t), -0.8 * w**2 * np.sin(w * t)])
        motion = tuple(np.array([[0.3], [-1.5]]) * (k == 0) + np.array([[1.0], [-2.0]]) * x for k, x in enumerate(one))
        made.append(record(plant, f"{i}.csv", np.random.default_rng(i), 10.0, motion=motion, payload=3.0, tool=(0.4, 0.0, 0.0)))
    recordings = replace(as_set(plant, made), tool=ToolPoint(1, np.array([0.4, 0.0, 0.0])))
    weak = replace(
        recordings.robot, effort=np.full(2, 1e-3), velocity=np.full(2, 1e-3)
    )  # below what was recorded, which counts
    recordings = replace(recordings, robot=weak)
    plain = calibrate(recordings)
    seen = view(prepare(recordings), plain)
    arm = Model(weak, recordings.tool)
    largest = np.max([np.abs(r.tau).max(axis=1) for r in made], axis=0)
    lowest = min(float(arm.tool_height(q)) for r in made for q in r.q.T)
    found = Finding(Term(TorqueOffset((1,)), (Estimate(0.5),)), 1.0, 0.6, 50.0, 1e-9, (("coulomb_asymmetry", (1,)),))
    (suggestion,) = suggest(recordings, plain, [] if undecided else [found], undecided, seen)
    m = suggestion.motion
    assert np.all((seen.low <= m.q.T) & (seen.high >= m.q.T))
    assert np.all(np.abs(m.dq).max(axis=1) <= seen.speed)
    assert np.all(np.abs(plain.torques(m)[0]).max(axis=1) <= 1.01 * largest)  # planned with dry friction of a wider transition
    assert min(float(arm.tool_height(q)) for q in m.q.T) >= lowest
    np.testing.assert_allclose(m.dq[:, [0, -1]], 0, atol=1e-9)
    assert np.ptp(m.q, axis=1).min() > 0.05


@pytest.mark.parametrize(("share", "named"), [(1e-4, False), (3e-3, True)])
def test_what_is_finer_than_any_model_is_not_named(planar, share, named):
    plant, rng = planar(1), np.random.default_rng(10)
    made = [record(plant, f"{i}.csv", rng, 10.0, noise=1e-5) for i in range(3)]
    ripple = [replace(r, tau=r.tau + share * np.std(r.tau) * np.sqrt(2) * np.sin(9 * r.q)) for r in made]
    assert bool(diagnose(as_set(plant, ripple)).findings) is named


def test_friction_that_all_but_vanishes_is_found(planar):
    """At the times and friction that trials are made of, its ratio would be below −1."""
    plant, rng = planar(1), np.random.default_rng(4)
    made = [record(plant, f"{i}.csv", rng, 10.0, noise=0.01) for i in range(4)]
    friction = [np.exp(-r.t / 8.0) * (np.tanh(r.dq / plant.width) + r.dq) for r in made]
    weak = [replace(r, tau=r.tau - 0.95 * f) for r, f in zip(made, friction, strict=True)]
    found = diagnose(as_set(plant, weak)).findings[0].term
    assert found.effect.name == "friction_drift"
    assert found.named["ratio"] == pytest.approx(-0.95, abs=0.05)
    assert found.named["time_constant"] == pytest.approx(8.0, rel=0.15)


def test_friction_of_a_joint_becomes_as_abrupt_as_it_is_all_at_once(planar):
    """One law of the right width beside one of the wrong width does no better than both of the wrong one."""
    plant, rng = planar(1), np.random.default_rng(6)
    made = [record(plant, f"{i}.csv", rng, 10.0) for i in range(3)]
    uneven = [replace(r, tau=r.tau + np.tanh(r.dq / plant.width) ** 2) for r in made]
    _, fitter, _, model = ready(as_set(plant, uneven), Priors())
    laws = (*model.terms, nominal_term(CoulombAsymmetry((0,))))
    wrong = replace(model, terms=tuple(widened(t, {(0,): 0.07}) for t in laws))
    right = fitter.fit(wrong, fitter.data.links.none).model.terms
    assert [t.width for t in right if t.width is not None] == pytest.approx([plant.width, plant.width], rel=0.02)
    assert right[-1].values == pytest.approx([2.0], rel=0.03)


def test_what_few_recordings_leave_open_of_links_stays_near_what_is_believed(planar):
    """Inertial parameters fitted to a slow motion predict a fast one where what is believed beside it counts."""
    plant, rng = planar(3), np.random.default_rng(12)
    motions = [multisine(3, np.arange(400) / 100, rng, fastest) for fastest in (0.15, 1.5)]
    recordings = as_set(plant, [record(plant, f"{k}.csv", rng, 4.0, motion=m) for k, m in enumerate(motions)], "identify")
    _, fitter, _, plain = ready(recordings, Priors())
    none, left = fitter.data.links.none, []
    for wide in (100.0, 1.0):
        slow = replace(
            fitter, data=replace(fitter.data.part([0]), links=replace(fitter.data.links, std=wide * fitter.data.links.std))
        )
        fitted = slow.fit(plain, none)
        left.append(np.linalg.norm(rows(fitter.data.part([1]).prepared, fitted.model).residual))
    assert left[1] < 0.8 * left[0], left


@pytest.mark.parametrize("everywhere", [True, False])
def test_an_effect_of_some_groups_is_that_of_all_where_nothing_speaks_against_it(planar, everywhere):
    plant, rng = planar(1), np.random.default_rng(8)
    made_up = [replace(record(plant, f"{k}.csv", rng, 6.0), group="ab"[k % 2]) for k in range(4)]
    offset = [replace(r, tau=r.tau - 2.0) if everywhere or r.group == "a" else r for r in made_up]
    (finding,) = diagnose(as_set(plant, offset)).findings
    assert (finding.term.effect, finding.term.groups) == (TorqueOffset((0,)), () if everywhere else ("a",))
    assert finding.term.values == pytest.approx([-2.0], rel=0.02)


@pytest.mark.parametrize(
    ("variables", "orders", "edges"),
    [
        ((("motor", 0), ("time", -1)), (1, 1), ()),
        ((("motor", 1), ("dq", 0)), (1, 2), ()),
        ((("motor", 1),), (), ((1, 0.8, 3), (-1, 0.2, 1))),
        ((("ddq", 0),), (3,), ()),
    ],
)
def test_signature_of_an_unexplained_torque_is_its_exact_derivative(made, variables, orders, edges):
    case, _ = made("clean/arm2", "arm2")
    recordings = load_recordings(case / "data")
    prepared = prepare(recordings)[:1]
    low, high = (-0.5,) * len(variables), (0.5, 15.0)[: len(variables)]
    effect = Empirical((1,), variables, low, high, orders, edges=edges)
    start = plain_model(recordings)
    term = Term(effect, tuple(Estimate(0.1) for _ in effect.parameters), 0.05)
    model = replace(start, terms=(*start.terms, term))
    zero = dict.fromkeys(effect.amplitudes, 0.0)
    trial = Trial(effect, tuple(zero | {name: 1.0} for name in effect.amplitudes), width=0.05)
    exact = rows(prepared, model).jacobian[:, :, len(start.terms) :]
    assert np.abs(exact).max() > 5e-3
    found, signature = table(prepared, model, [trial]), np.zeros_like(exact)
    for j, (values, used) in enumerate(zip(found.values, found.used, strict=True)):
        signature[j][:, used] = values
    np.testing.assert_allclose(signature, exact, atol=1e-6)


@pytest.mark.parametrize("change", ["payload", "gain", "offset"])
def test_what_only_one_recording_has_is_found_there(planar, change):
    """Nothing but pieces of that recording can confirm it."""
    plant, rng = planar(1), np.random.default_rng(2)
    made = [
        record(plant, f"{i}.csv", rng, 10.0, 0.01, None, None, 0.5 * (change == "payload" and i == 1), TOOL) for i in range(4)
    ]
    made = [replace(r, payload=0 * r.t) for r in made]
    other = {"payload": made[1].tau, "gain": 1.1 * made[1].tau, "offset": made[1].tau + 1.0}[change]
    recordings = as_set(plant, [made[0], replace(made[1], tau=other), *made[2:]])
    recordings = replace(recordings, tool=recordings.robot.point(recordings.robot.links[-1], TOOL))
    (found,) = diagnose(recordings).findings
    names = {"payload": "payload_mass", "gain": "torque_gain", "offset": "torque_offset"}
    assert found.term.effect.name == names[change]
    assert found.term.groups == ("1.csv",)


def test_a_spring_that_engages_in_part_of_the_range_and_an_offset_are_no_harness_and_ripples(planar):
    """Though these, one by one, explain more."""
    plant, rng = planar(1), np.random.default_rng(3)
    made = [record(plant, f"{i}.csv", rng, 12.0, pea={0: (1.0, 0.0)}) for i in range(4)]
    found = diagnose(as_set(plant, [replace(r, tau=r.tau - 0.5, springs=()) for r in made])).findings
    values = {f.term.effect.name: f.term.named for f in found}
    assert set(values) == {"parallel_spring", "torque_offset"}
    assert values["parallel_spring"]["stiffness"] == pytest.approx(1.0, rel=0.05)
    assert values["torque_offset"]["offset"] == pytest.approx(-0.5, rel=0.1)


@pytest.mark.parametrize("seed", [3, 4])  # of which the ten fit 5 and 15 of noise
def test_a_payloads_centre_goes_before_a_links_inertial_parameters_that_fit_more_noise(tmp_path, seed):
    """The last link's ten hold all that a payload's three do where all recordings carry it."""
    (tmp_path / "skew.urdf").write_text(chains.random_chain(1, 3))
    plant, rng = Plant(tmp_path / "skew.urdf", np.ones(3), np.ones(3), 0.1 * np.ones(3)), np.random.default_rng(seed)
    off = np.add(TOOL, (0.02, 0.01, 0.0))
    made = [record(plant, f"{i}.csv", rng, 10.0, 0.01, payload=2.0, tool=off) for i in range(4)]
    recordings = as_set(plant, made)
    recordings = replace(recordings, tool=recordings.robot.point(recordings.robot.links[-1], TOOL))
    found = diagnose(recordings).findings
    assert [f.term.effect.name for f in found] == ["payload_com"]


def test_a_drift_within_an_only_recording_goes_on_from_block_to_block(planar):
    plant, rng = planar(1), np.random.default_rng(2)
    whole = record(plant, "0.csv", rng, 40.0, 0.01)
    friction = np.tanh(whole.dq / plant.width) + whole.dq
    warm = replace(whole, tau=whole.tau + 0.5 * np.exp(-whole.t / 5.0) * friction)
    found = diagnose(as_set(plant, [warm]))
    (drift,) = found.findings
    assert drift.term.effect.name == "friction_drift"
    assert drift.term.named == pytest.approx({"ratio": 0.5, "time_constant": 5.0}, rel=0.05)
    assert found.held_out[1][0] < 0.2 * found.held_out[0][0]


def test_recorded_load_torque_may_hold_what_no_law_explains(planar, tmp_path):
    """A detent: on the link's side, for no drive is in what was recorded."""
    plant, rng = planar(1), np.random.default_rng(4)
    made = [record(plant, f"{i}.csv", rng, 12.0, 0.01, load=True) for i in range(4)]
    made = [replace(r, tau=r.tau + 1.5 * np.exp(-((r.q / 0.25) ** 2))) for r in made]
    found = diagnose(as_set(plant, made, torque="load"))
    (term,) = (f.term for f in found.findings if f.term.effect.black_box)
    assert term.effect.side == "link"
    assert term.effect.depends_on == (("q", 0),)
    assert found.held_out[1][0] < 0.3 * found.held_out[0][0]
    save_model(found.model, tmp_path / "model.json")
    assert load_model(tmp_path / "model.json").terms == found.model.terms


def test_a_joint_that_stands_still_is_no_reason_to_fail(planar):
    plant, rng = planar(2), np.random.default_rng(5)
    made = []
    for i in range(3):
        q, dq, ddq = multisine(2, np.arange(1000) / 100, rng)
        still = np.array([[0.0], [1.0]])
        r = record(plant, f"{i}.csv", rng, 10.0, 0.01, (still * q, still * dq, still * ddq))
        made.append(r)
    assert not diagnose(as_set(plant, made)).findings


def test_pieces_too_short_for_the_filter_do_not_count(planar):
    """After 8 s bursts of 8 samples between gaps, and one recording only: blocks are made of what can be used."""
    plant, rng = planar(1), np.random.default_rng(6)
    whole = record(plant, "0.csv", rng, 16.0, 0.01)
    kept = np.flatnonzero((whole.t < 8) | (np.arange(len(whole.t)) % 40 < 8))
    arrays = {name: getattr(whole, name)[..., kept] for name in ("t", "q", "dq", "ddq", "tau", "payload")}
    gaps = np.flatnonzero(np.diff(arrays["t"]) > 0.05) + 1
    ends = [0, *gaps.tolist(), len(kept)]
    torn = replace(whole, **arrays, segments=tuple(slice(a, b) for a, b in itertools.pairwise(ends)))
    assert not diagnose(as_set(plant, [torn])).findings
    one, other = (fit_terms(s, prepare(s), plain_model(s)).model for s in (as_set(plant, [torn]), as_set(plant, [whole])))
    for term, whole_term in zip(one.terms, other.terms, strict=True):
        for e, w in zip(term.estimates, whole_term.estimates, strict=True):
            assert e.std is not None
            assert w.std is not None
            assert e.std < 4 * w.std  # of half the time


def test_a_mismatch_that_nothing_explains_is_said_to_be_one(planar, tmp_path):
    """Torques of another course in every recording: beyond the noise, and nothing holds on recordings left out."""
    plant, rng, made = planar(1), np.random.default_rng(7), []
    for i in range(4):
        r = record(plant, f"{i}.csv", rng, 12.0, 0.003)
        f, phase = rng.uniform(1.2, 2.0, 3), rng.uniform(0, 6.3, 3)
        made.append(replace(r, tau=r.tau + 0.4 * np.sin(2 * np.pi * f[:, None] * r.t + phase[:, None]).sum(axis=0)))
    found = diagnose(as_set(plant, made))
    assert found.findings == ()
    assert found.verdict == "cannot_tell"
    assert found.mismatch[0]["significant"]
    content = write_diagnosis(found, tmp_path)
    assert "these recordings do not decide what" in (tmp_path / "report.html").read_text()
    (suggested,) = content["suggested_recordings"]
    assert (tmp_path / suggested["trajectory"]).exists()


@pytest.mark.parametrize("seed", [0, 1])
def test_a_payload_that_errors_of_the_links_could_replace_is_claimed(seed):
    """They predict held-out recordings as well, but only at many times the size that a URDF's errors have."""
    plant, rng = Plant("rrr", np.array([1.0, 2.0, 1.0]), np.full(3, 2.0), np.full(3, 0.3)), np.random.default_rng(seed)
    tool = load_robot("rrr").tool.position
    made = [record(plant, f"{i}.csv", rng, 8.0, 0.003, payload=1.0, tool=tool) for i in range(4)]
    (found,) = diagnose(as_set(plant, [replace(r, payload=0 * r.t) for r in made])).findings
    assert found.term.effect.name == "payload_mass"
    assert found.term.values == pytest.approx([1.0], abs=0.01)


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
        assert moving.by_trial(trial)[..., k] == pytest.approx(alone.by_trial(trial)[..., k], abs=1e-9)
    assert 10 < len(pieces(ramp)) < 60


def with_changes(plant: Plant, rng: np.random.Generator, change, count: int = 5) -> list[Recording]:
    """Recordings of 10 s, each with what `change` adds to the torque of one of this number."""
    made = [record(plant, f"{i}.csv", rng, 10.0, 0.01) for i in range(count)]
    return [replace(r, tau=r.tau + change(i, r)) for i, r in enumerate(made)]


def test_friction_that_grows_with_load_goes_before_friction_over_position(planar):
    """In slow motion load is all but a function of position: one law of three parameters explains most of both."""
    plant, rng, made = planar(1), np.random.default_rng(2), []
    for i in range(4):
        motion = tuple(1.5 * x for x in multisine(1, np.arange(1200) / 100, rng, 0.3))
        r, turn = record(plant, f"{i}.csv", rng, 12.0, 0.01, motion), np.tanh(motion[1] / plant.width)
        law = 0.25 * np.abs(plant.load(*motion)) + 0.03 * np.cos(2 * motion[0] + 3)
        made.append(replace(r, tau=r.tau + turn * law))
    said: list[str] = []
    found = [f.term for f in diagnose(as_set(plant, made), lambda step: said.append(step.said)).findings]
    assert next(line for line in said if "friction" in line).startswith("load_dependent_friction")
    assert {t.effect.name for t in found} == {"load_dependent_friction", "position_dependent_friction"}
    assert found[0].values[0] == pytest.approx(0.25, rel=0.15)


def test_an_effect_may_be_another_in_each_recording(planar):
    plant, rng, truth = planar(1), np.random.default_rng(9), {1: 0.6, 3: -0.5, 4: 1.2}
    found = diagnose(as_set(plant, with_changes(plant, rng, lambda i, r: truth.get(i, 0.0)))).findings
    assert {f.term.effect.name for f in found} == {"torque_offset"}
    assert {g: f.term.values[0] for f in found for g in f.term.groups} == pytest.approx(
        {f"{i}.csv": v for i, v in truth.items()}, abs=0.01
    )


@pytest.mark.parametrize("truth", [{1: (0.4, 0.2)}, {0: (0.6, 0.3), 1: (0.3, 0.1), 2: (0.15, 0.1)}])
def test_friction_may_be_another_in_some_recordings(planar, truth):
    """As of a gear that was cold: no law of the catalogue, and friction that grows with load least of all."""
    plant, rng = planar(2), np.random.default_rng(3)

    def change(i: int, r: Recording) -> np.ndarray:
        dry, viscous = truth.get(i, (0.0, 0.0))
        return np.outer([0, 1], dry * np.tanh(r.dq[1] / plant.width) + viscous * r.dq[1])

    found = diagnose(as_set(plant, with_changes(plant, rng, change, 6)))
    assert {(f.term.effect.name, f.term.effect.joints) for f in found.findings} == {("friction_change", (1,))}
    values = {g: f.term.values for f in found.findings for g in f.term.groups}
    assert values == {f"{i}.csv": pytest.approx(v, abs=0.02) for i, v in truth.items()}
    said = sentence(to_json(found) | {"bootstrap": {}})
    assert (
        f"lacks a torque on j2 that depends on the speed of j2 and the direction of j2 in {len(truth)} of the recordings."
        in said
    )


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


def test_leaving_out_what_alone_knows_of_a_parameter_says_nothing_of_it():
    """A column of zeros has neither an estimate nor a say."""
    matrix = np.array([[4.0, 0.0, 1.0], [0.0, 0.0, 0.0], [1.0, 0.0, 2.0]])
    inverse = pseudo_inverse(matrix)
    assert np.all(inverse[1] == pytest.approx(0.0, abs=1e-12))
    np.testing.assert_allclose(inverse[np.ix_([0, 2], [0, 2])], np.linalg.inv(matrix[np.ix_([0, 2], [0, 2])]), atol=1e-12)
