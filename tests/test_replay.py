"""Recorded motions followed by models with effects that a diagnosis found."""

from dataclasses import replace

import numpy as np
import pytest
from recorded import Plant, as_set, record

from rrr_oc.calibrate import plain_model
from rrr_oc.calibrated import Estimate, Term
from rrr_oc.effects import CATALOGUE
from rrr_oc.errors import UserError
from rrr_oc.nrmse import error
from rrr_oc.replay import replay, tracking_controller
from rrr_oc.robot import load_robot

FOUND = {
    "load_dependent_friction": ((1,), (0.15,)),
    "presliding_hysteresis": ((2,), (200.0, 1.0)),
    "torque_ripple": ((1,), (1.5, 9.0, 0.4)),
    "friction_drift": ((1,), (0.8, 3.0)),
    "cable_harness": ((2,), (3.0, 0.2)),
    "spring_stiffness": ((1,), (1.3,)),
    "payload_mass": ((), (0.7,)),
    "gravity_tilt": ((), (0.02, -0.03)),
    "encoder_offset": ((1,), (0.05,)),
    "torque_gain": ((2,), (0.1,)),
}


def found(name: str) -> Term:
    joints, values = FOUND[name]
    effect = CATALOGUE[name](joints)
    width = None if effect.width is None else effect.width.nominal
    return Term(effect, tuple(Estimate(v) for v in values), width)


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    """A calibrated model and a recording with a spring and a payload whose clock does not start at 0."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        plant = Plant("rrr", np.array([0.5, 1.0, 0.5]), np.array([3.0, 4.0, 2.0]), np.array([0.2, 0.3, 0.1]))
        rng, tool = np.random.default_rng(0), load_robot("rrr").tool.position
        recording = record(plant, "0.csv", rng, 5.0, pea={1: (6.0, 0.8)}, payload=2.0, tool=tool)
        start = plain_model(as_set(plant, [recording]))
        values = np.array([plant.dry, plant.viscous, plant.armature]).T.reshape(-1, 1)
        model = replace(start, terms=tuple(t.with_values(v) for t, v in zip(start.terms, values, strict=True)))
        yield model, replace(recording, t=recording.t + 40.0)


@pytest.mark.parametrize("name", FOUND)
def test_the_twin_of_a_repaired_model_follows_with_the_torque_that_is_predicted(name, plain):
    """The engine's own torque along a motion is what inverse dynamics predicts, and without the effect it is not."""
    model, recording = plain
    repaired = replace(model, terms=(*model.terms, found(name)))
    motor = repaired.physics(recording).torques(recording)[0]
    missing = np.sqrt(np.mean((motor - model.torques(recording)[0]) ** 2, axis=1)) / motor.std(axis=1)
    simulated = replay(repaired, recording, tracking_controller(model))
    j = int(np.argmax(missing))
    pairs = {"q": (recording.q, simulated.q), "tau_motor": (motor, simulated.tau_motor)}
    errors = {k: error(recording.t, *pair, recording.segments)["nrmse"][j] for k, pair in pairs.items()}
    assert errors["q"] < 2e-3
    # what noise in the recorded accelerations and dry friction's way at reversals leave: 1 to 3 % of the torque's spread
    assert errors["tau_motor"] < 0.03
    if name == "torque_gain":
        assert missing[j] == 0  # of the sensor
    else:
        assert missing[j] > 2 * errors["tau_motor"]


def test_gears_that_give_are_turned_away(plain):
    model, recording = plain
    term = Term(CATALOGUE["joint_elasticity"]((1,)), (Estimate(500.0), Estimate(0.1)))
    with pytest.raises(UserError, match="one coordinate a joint"):
        replay(replace(model, terms=(*model.terms, term)), recording, tracking_controller(model))
