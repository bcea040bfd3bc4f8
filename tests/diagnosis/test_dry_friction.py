"""Diagnosis of arms whose dry friction changes sign in many ways, holds a joint, or stays at rest."""

from dataclasses import replace

import numpy as np
import pytest
from recorded import Plant, as_set, by_engine, multisine, point_to_point, record

from rrr_oc.calibration.calibrated_model import nominal_term
from rrr_oc.calibration.parameter_vector import widened
from rrr_oc.diagnosis.procedure import diagnose, ready
from rrr_oc.effects.friction.coulomb_asymmetry import CoulombAsymmetry
from rrr_oc.effects.friction.quadratic_drag import QuadraticDrag
from rrr_oc.effects.priors import Priors
from rrr_oc.effects.sensor.torque_offset import TorqueOffset
from rrr_oc.recordings.recording import Recording


@pytest.mark.parametrize("width", [0.014, 0.07])
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


@pytest.mark.parametrize("turn", TURNS)
def test_dry_friction_may_change_sign_in_other_ways(planar, turn):
    """What is between tanh and the other way looks like laws of speed."""
    plant = planar(1)
    assert not diagnose(as_set(plant, turned(plant, turn, 0.0))).findings


def test_a_law_of_speed_is_named_where_dry_friction_changes_sign_in_another_way(planar):
    plant = planar(1)
    (drag,) = diagnose(as_set(plant, turned(plant, "clip", 0.3))).findings
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


def test_abrupt_dry_friction_that_holds_a_joint_for_a_moment_is_no_large_effect(planar):
    """No law of the catalogue holds a joint: what stands for it is told, and is less than a hundredth of the torque."""
    plant, rng = planar(1), np.random.default_rng(1)
    found = diagnose(as_set(plant, [by_engine(plant, f"{i}.csv", rng, 1.0) for i in range(4)]))
    assert all(f.fall and f.fall.of_torque < 0.01 for f in found.findings)


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


@pytest.mark.parametrize(("name", "width", "noise"), [("torque_offset", 0.02, 0.05), ("coulomb_asymmetry", 0.02, 0.02)])
def test_of_two_laws_alike_in_motion_the_one_that_holds_at_rest_is_named(planar, name, width, noise):
    plant = replace(planar(1), width=width)
    (finding,) = diagnose(as_set(plant, point_to_point(plant, noise, 1.0 if name == "torque_offset" else 0.0))).findings
    assert finding.term.effect.name == name


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


def test_a_joint_that_stands_still_is_no_reason_to_fail(planar):
    plant, rng = planar(2), np.random.default_rng(5)
    made = []
    for i in range(3):
        q, dq, ddq = multisine(2, np.arange(1000) / 100, rng)
        still = np.array([[0.0], [1.0]])
        r = record(plant, f"{i}.csv", rng, 10.0, 0.01, (still * q, still * dq, still * ddq))
        made.append(r)
    assert not diagnose(as_set(plant, made)).findings
