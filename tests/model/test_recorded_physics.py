"""Derivatives of recorded torques, of effects that move the links or have internal states, against differences of the whole model."""

from dataclasses import replace

import numpy as np
import pytest
from recorded import Plant, as_set, multisine, record

from rrr_oc.calibration.calibrated_model import CalibratedModel, Estimate, Term
from rrr_oc.calibration.inverse_dynamics import plain_model
from rrr_oc.calibration.jacobian import Prediction
from rrr_oc.effects import CATALOGUE, Delay
from rrr_oc.effects.black_box.echo import Echo
from rrr_oc.model.motion import Motion
from rrr_oc.model.recorded_physics import later
from rrr_oc.numerics.along import along
from rrr_oc.recordings.recording import Recording

STEP = 1e-3  # share of a parameter, over which differences are taken on both sides
GEARS, STATES = (CATALOGUE[name] for name in ("joint_elasticity", "presliding_hysteresis"))
OTHERS = (CATALOGUE[name] for name in ("encoder_offset", "torque_gain", "time_delay", "load_dependent_friction"))
OFFSET, GAIN, DELAY, BY_LOAD = OTHERS
MODELS = {
    "a gear": [Term(GEARS((1,)), (Estimate(900.0), Estimate(0.004)))],
    "two gears, an offset": [
        Term(GEARS((0,)), (Estimate(2000.0), Estimate(0.003))),
        Term(GEARS((1,)), (Estimate(900.0), Estimate(0.004))),
        Term(OFFSET((2,)), (Estimate(0.05),)),
    ],
    "bristles": [Term(STATES((2,)), (Estimate(300.0), Estimate(0.8)), 0.05)],
    "an echo behind a gear, with friction by load": [
        Term(GEARS((1,)), (Estimate(900.0), Estimate(0.004))),
        Term(BY_LOAD((1,)), (Estimate(0.05),), 0.05),
        Term(Echo((1,)), (Estimate(8.0), Estimate(0.3), Estimate(0.2), Estimate(0.1))),
    ],
    "efforts without most of gravity, a tilt and friction by load": [
        Term(CATALOGUE["missing_gravity"](()), (Estimate(0.8),)),
        Term(CATALOGUE["gravity_tilt"](()), (Estimate(0.05), Estimate(-0.1))),
        Term(BY_LOAD((1,)), (Estimate(0.1),), 0.05),
    ],
    "one gain of all joints, and another of one": [
        Term(GAIN(()), (Estimate(0.3),)),
        Term(GAIN((1,)), (Estimate(-0.1),)),
        Term(CATALOGUE["gravity_tilt"](()), (Estimate(0.05), Estimate(-0.1))),
    ],
    "bristles, a gear and sensors": [
        Term(STATES((1,)), (Estimate(300.0), Estimate(0.8)), 0.05),
        Term(GEARS((1,)), (Estimate(900.0), Estimate(0.004))),
        Term(GAIN((1,)), (Estimate(-0.1),)),
        Term(DELAY(()), (Estimate(0.023),)),
    ],
}


@pytest.fixture(scope="module")
def arm() -> tuple[CalibratedModel, Recording]:
    plant = Plant("rrr", np.array([2.0, 3.0, 1.5]), np.array([3.0, 4.0, 2.0]), np.array([0.2, 0.3, 0.1]))
    rng = np.random.default_rng(61)
    recordings = as_set(plant, [record(plant, "0.csv", rng, 6.0, motion=multisine(3, np.arange(600) / 100, rng))])
    model = plain_model(recordings)
    drives = np.array([plant.dry, plant.viscous, plant.armature]).T.reshape(-1, 1)
    model = replace(model, terms=tuple(t.with_values(v) for t, v in zip(model.prompt_terms, drives, strict=True)))
    return model, recordings.recordings[0]


@pytest.mark.parametrize("name", MODELS)
def test_derivatives_are_those_of_the_whole_model(arm, name):
    """To first order: derivatives neglect that a gear's own load changes with its link's motion, and an echo behind it with both."""
    (plain, recording), added = arm, MODELS[name]
    model, echo = replace(plain, terms=(*plain.terms, *added)), any(isinstance(term.effect, Echo) for term in added)
    found, column = Prediction(model, recording).by_parameters()[:, :, len(plain.values) :], 0
    for i, term in enumerate(added, len(plain.terms)):
        for k, value in enumerate(term.values):
            there = []
            # torques are linear between samples: they are differentiated over whole samples of 10 ms
            step = 0.01 if isinstance(term.effect, Delay) else STEP * value
            for sign in (1, -1):
                moved = term.with_values(term.values + sign * step * (np.arange(len(term.values)) == k))
                terms = (*model.terms[:i], moved, *model.terms[i + 1 :])
                there.append(replace(model, terms=terms).output_torque(recording))
            slope = (there[0] - there[1]) / (2 * step)
            inside = slice(5, -5)  # before a recording began there is nothing that is late
            off = np.sqrt(np.mean((found[:, inside, column] - slope[:, inside]) ** 2) / np.mean(slope[:, inside] ** 2))
            tolerance = 0.2 if echo and term.effect.moves_link else 0.03 if term.effect.side == "motion" else 5e-3
            assert off < tolerance, f"{term.effect.name} {term.effect.parameters[k].name}: {off:.2g}"
            column += 1
    assert column == found.shape[2]


@pytest.mark.parametrize("name", ["a gear", "two gears, an offset"])
def test_starts_are_changes_of_the_torque_by_the_links_own_motion(arm, name):
    """Against the inverse dynamics at the displaced motion, with stiffness and inertia by differences."""
    (plain, recording), added = arm, MODELS[name]
    physics = replace(plain, terms=(*plain.terms, *added)).physics(recording)
    found, shift, n = physics.starts(recording, False), physics.shift(recording), 3
    states, base = np.zeros((0, len(recording.t))), physics.torques(recording)[0]
    gears = [(e, theta, e.joints[0]) for e, theta, _ in physics.named() if e.moves_link]
    assert len(found) == 2 * len(gears)
    for number, (effect, theta, j) in enumerate(gears):
        here, there = (along_shift(physics, recording, shift, states, [2 * n + j], a) for a in (-1.0, 1.0))
        inertia = (there[1][j] - here[1][j]) / 2
        here, there = (along_shift(physics, recording, shift, states, [j], a) for a in (-1e-5, 1e-5))
        stiffness = (there[1][j] - here[1][j]) / 2e-5
        for k, free in enumerate(effect.free(recording.t, stiffness, inertia, theta)):
            usual = np.sqrt(np.mean(physics.twist(recording)[k * n + j] ** 2))
            moved = along_shift(physics, recording, shift, states, [j, n + j, 2 * n + j], 1e-3 * usual * free)[0]
            expected = (moved - base) / 1e-3
            np.testing.assert_allclose(found[2 * number + k], expected, atol=0.01 * np.abs(expected).max())


def along_shift(physics, motion, shift, states, rows, more):
    """Motor and load torque with some rows of the shift increased."""
    there = shift.copy()
    there[rows] += more
    values = physics.theta, physics.widths, physics.inertial
    return along(physics.model.recorded_inverse, *physics.inputs(motion), *values, there, states)


def test_friction_by_load_feels_the_gravity_that_is_not_recorded(arm):
    plain, recording = arm
    friction, silent = Term(BY_LOAD((1,)), (Estimate(0.1),), 0.05), Term(CATALOGUE["missing_gravity"](()), (Estimate(1.0),))
    models = [replace(plain, terms=(*plain.terms, *more)) for more in ((friction,), (friction, silent), (silent,), ())]
    rubs, both, alone, bare = (model.output_torque(recording) for model in models)
    np.testing.assert_allclose(both - alone, rubs - bare, atol=1e-9)  # rounding
    assert np.abs(alone - bare)[1].max() > 1.0  # [Nm]


def test_delayed_signals_are_interpolated_within_each_segment():
    rng = np.random.default_rng(62)
    t = np.cumsum(rng.uniform(0.5, 1.5, 60)) / 100
    x, segments = rng.normal(size=(3, 60)), (slice(0, 30), slice(30, 31), slice(31, 60))
    motion = Motion(t, x, x, x, 0 * t, segments)
    for delay in (0.0, 0.013, -0.02, 5.0):
        expected = [np.interp(t[s] - delay, t[s], row[s]) for row in x for s in segments]
        np.testing.assert_allclose(later(motion, x, [delay] * 3).ravel(), np.concatenate(expected), atol=1e-12)


def test_what_is_kept_of_the_links_holds_for_other_models(arm):
    """Against a copy of the recording, for which nothing is kept, and against the model's inverse dynamics in one piece."""
    plain, recording = arm
    spring = Term(CATALOGUE["parallel_spring"]((1,)), (Estimate(20.0), Estimate(0.3)), 0.05)
    tilt = Term(CATALOGUE["gravity_tilt"](()), (Estimate(0.05), Estimate(-0.1)))
    by_load = Term(BY_LOAD((1,)), (Estimate(0.05),), 0.05)
    heavier = replace(plain.robot, inertial=1.1 * plain.robot.inertial)
    models = [replace(plain, terms=(*plain.terms, *added)) for added in ([], [spring], [tilt], [by_load], *MODELS.values())]
    models += [replace(plain, robot=heavier), replace(plain, robot=replace(plain.robot, gravity=np.array([0.0, 1.0, -9.0])))]
    loads = []
    for model in (*models, *reversed(models)):
        found = model.output_torque(recording)
        np.testing.assert_allclose(found, model.output_torque(replace(recording)), rtol=1e-12, atol=1e-12)  # rounding
        physics = model.physics(recording)
        loads.append(physics.torques(recording)[1])
        if not any(e.states or e.side == "motion" or isinstance(e, Delay) for e in physics.model.effects):
            values = physics.theta, physics.widths, physics.inertial
            whole = along(physics.model.motor_inverse, *physics.inputs(recording), *values)
            np.testing.assert_allclose(physics.torques(recording), whole, rtol=1e-12, atol=1e-12)
    changed = [np.abs(load - loads[0]).max() > 1e-3 for load in loads[: len(models)]]
    assert changed == [False, True, True, False, True, True, False, True, True, True, True, True, True]
