"""Which law a diagnosis names where several explain the recordings nearly as well, and what it does where none does."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from recorded import as_set, multisine, record
from scipy.signal import lsim

from rrr_oc.calibration.calibrate import calibrate
from rrr_oc.diagnosis.diagnosis_file import to_json
from rrr_oc.diagnosis.procedure import diagnose
from rrr_oc.effects.sensor.torque_gain import TorqueGain
from rrr_oc.effects.transmission.torque_ripple import TorqueRipple
from rrr_oc.report.diagnosis_report import write_diagnosis


def test_ripples_of_many_orders_are_found_and_what_is_weaker_than_they(planar):
    plant, rng, orders = planar(1), np.random.default_rng(8), {12: 0.4, 24: 0.3, 31: 0.2, 40: 0.15}
    made = [record(plant, f"{i}.csv", rng, 10.0, 0.01) for i in range(4)]
    gear = [replace(r, tau=r.tau + 0.1 + sum(a * np.sin(k * r.q + k) for k, a in orders.items())) for r in made]
    found = [f.term for f in diagnose(as_set(plant, gear)).findings]
    ripples = {round(t.named["order"]): t.named["amplitude"] for t in found if t.effect == TorqueRipple((0,))}
    assert ripples == pytest.approx(orders, rel=0.05)
    assert [t.effect.name for t in found if t.effect != TorqueRipple((0,)) and not t.effect.black_box] == ["torque_offset"]


@pytest.mark.parametrize("gain", [-0.9, 9.0])
def test_a_gain_at_its_bound_is_none(gain):
    """There all that the joint has scales with it."""
    assert not TorqueGain((0,)).possible({"gain": gain}, 0.0)
    assert TorqueGain((0,)).possible({"gain": 0.9 * gain}, 0.0)


def test_what_is_decided_by_the_past_is_said_to_be(planar):
    """An oscillator of 7 rad/s follows the load, as a payload that sloshes: nothing of the instant explains its torque."""
    plant, rng, made, w = planar(1), np.random.default_rng(3), [], 7.0
    for i in range(4):
        motion = multisine(1, np.arange(1000) / 100, rng)
        r, load = record(plant, f"{i}.csv", rng, 10.0, 0.01, motion), plant.load(*motion)[0]
        state = [[0.0, 1.0], [-(w**2), -0.1 * w]], [[0.0], [w**2]], [[1.0, 0.0]], [[0.0]]
        made.append(replace(r, tau=r.tau + 0.3 * (lsim(state, load, r.t, [load[0], 0.0])[1] - load)))
    found = diagnose(as_set(plant, made))
    content = to_json(found)
    assert {e["effect"] for e in content["effects"]} <= {"time_delay"}  # it is late, too
    assert all(u["depends_on"] == ["load_torque", "time"] for u in content["unexplained"])
    assert any(abs(f.term.named["frequency"] / w - 1) < 0.15 for f in found.findings if f.term.effect.name == "echo")


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


def test_a_spring_that_engages_in_part_of_the_range_and_an_offset_are_no_harness_and_ripples(planar):
    """Though these, one by one, explain more."""
    plant, rng = planar(1), np.random.default_rng(3)
    made = [record(plant, f"{i}.csv", rng, 12.0, pea={0: (1.0, 0.0)}) for i in range(4)]
    found = diagnose(as_set(plant, [replace(r, tau=r.tau - 0.5, springs=()) for r in made])).findings
    values = {f.term.effect.name: f.term.named for f in found}
    assert set(values) == {"parallel_spring", "torque_offset"}
    assert values["parallel_spring"]["stiffness"] == pytest.approx(1.0, rel=0.05)
    assert values["torque_offset"]["offset"] == pytest.approx(-0.5, rel=0.1)


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
    assert "These recordings do not decide what it is" in (tmp_path / "report.html").read_text()
    (suggested,) = content["suggested_recordings"]
    assert (tmp_path / suggested["trajectory"]).exists()


def test_friction_that_grows_with_load_goes_before_friction_over_position(planar):
    """In slow motion load is all but a function of position: one law of three parameters explains most of both, and dry friction over the
    position may take up a part of that over the load."""
    plant, rng, made = planar(1), np.random.default_rng(2), []
    for i in range(4):
        motion = tuple(1.5 * x for x in multisine(1, np.arange(1200) / 100, rng, 0.3))
        r, turn = record(plant, f"{i}.csv", rng, 12.0, 0.01, motion), np.tanh(motion[1] / plant.width)
        law = 0.25 * np.abs(plant.load(*motion)) + 0.03 * np.cos(2 * motion[0] + 3)
        made.append(replace(r, tau=r.tau + turn * law))
    said: list[str] = []
    diagnosis = diagnose(as_set(plant, made), lambda step: said.append(step.said))
    found = [f.term for f in diagnosis.findings]
    assert next(line for line in said if "friction" in line).startswith("load_dependent_friction")
    assert {t.effect.name for t in found} == {"load_dependent_friction", "position_dependent_friction"}
    (by_load,) = (t for t in found if t.effect.name == "load_dependent_friction")
    assert by_load.values[0] > 0.05
    assert diagnosis.held_out[1][0] < 0.3 * diagnosis.held_out[0][0]  # to the noise


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
    one, other = (calibrate(s) for s in (as_set(plant, [torn]), as_set(plant, [whole])))
    for term, whole_term in zip(one.terms, other.terms, strict=True):
        for e, w in zip(term.estimates, whole_term.estimates, strict=True):
            assert e.std is not None
            assert w.std is not None
            assert e.std < 4 * w.std  # of half the time
