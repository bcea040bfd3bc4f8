"""Rows of the regression: what is kept from one model to the next, and the filter of many columns at once."""

from dataclasses import replace

import numpy as np
import pytest
from recorded import Plant, as_set, record

from rrr_oc.calibration.calibrated_model import CalibratedModel, Estimate, Term
from rrr_oc.calibration.inverse_dynamics import plain_model
from rrr_oc.calibration.jacobian import Prediction
from rrr_oc.calibration.parameter_vector import widened
from rrr_oc.calibration.regression import rows
from rrr_oc.calibration.samples import Prepared, prepare
from rrr_oc.effects import CATALOGUE


def term(name: str, joints: tuple[int, ...], *values: float, width: float | None = None) -> Term:
    return Term(CATALOGUE[name](joints), tuple(Estimate(v) for v in values), width)


ADDED = {
    "nothing": [],
    "tilt": [term("gravity_tilt", (), 0.05, -0.1)],
    "another tilt": [term("gravity_tilt", (), 0.02, 0.1)],
    "payload": [term("payload_mass", (), 0.4)],
    "friction by load": [term("load_dependent_friction", (1,), 0.1, width=0.05)],
    "gain": [term("torque_gain", (1,), -0.1)],
    "gain and delay": [term("torque_gain", (1,), -0.1), term("time_delay", (), 0.023)],
    "gear": [term("joint_elasticity", (1,), 2000.0, 0.003)],
}


@pytest.fixture(scope="module")
def arm() -> tuple[CalibratedModel, tuple[Prepared, ...]]:
    plant = Plant("rrr", np.array([2.0, 3.0, 1.5]), np.array([3.0, 4.0, 2.0]), np.array([0.2, 0.3, 0.1]))
    rng = np.random.default_rng(71)
    recordings = as_set(plant, [record(plant, f"{i}.csv", rng, 6.0, payload=1.0 + i) for i in range(2)])
    model = plain_model(recordings)
    drives = np.array([plant.dry, plant.viscous, plant.armature]).T.reshape(-1, 1)
    terms = tuple(t.with_values(v) for t, v in zip(model.prompt_terms, drives, strict=True))
    return replace(model, terms=terms), prepare(recordings)


def test_derivatives_by_inertial_parameters_that_are_kept_hold_for_other_models(arm):
    """Against recordings that are prepared anew, for which nothing is kept; in both orders of each two models."""
    plain, prepared = arm
    heavier = replace(plain.robot, inertial=1.1 * plain.robot.inertial)
    models = [replace(plain, terms=(*plain.terms, *added)) for added in ADDED.values()]
    models += [replace(plain, robot=heavier), replace(plain, robot=replace(plain.robot, gravity=np.array([0.0, 1.0, -9.0])))]
    seen = []
    for model in (*models, *reversed(models)):
        found = rows(prepared, model, inertial=True)
        anew = rows([replace(p) for p in prepared], model, inertial=True)
        np.testing.assert_array_equal(found.jacobian, anew.jacobian)
        np.testing.assert_array_equal(found.residual, anew.residual)
        seen.append(found.jacobian[:, :, -30:])
    for i, name in enumerate(ADDED):
        differs = i > 0 and np.abs(seen[i] - seen[0]).max() > 1e-3 * np.abs(seen[0]).max()
        assert differs == (name not in ("nothing", "payload")), name


@pytest.mark.parametrize("name", ADDED)
def test_columns_are_filtered_as_single_signals_are(arm, name):
    plain, prepared = arm
    model = replace(plain, terms=(*plain.terms, *ADDED[name]))
    raw = Prediction(model, prepared[0].recording).by_parameters(inertial=True)
    found = rows(prepared[:1], model, inertial=True).jacobian
    for k in range(raw.shape[2]):
        expected = prepared[0].passed(raw[:, :, k], range(3))
        if name != "gear":  # whose unknown start is projected out
            np.testing.assert_allclose(found[:, :, k], expected, rtol=1e-9, atol=1e-9)  # rounding, and what counts as none
        elif not 9 <= k < 11:  # the gear's own parameters, which also change how the link may swing at first
            assert np.sum(found[:, :, k] ** 2) <= np.sum(expected**2) * (1 + 1e-9)


def test_a_term_that_holds_for_no_recording_has_columns_of_zeros(arm):
    plain, prepared = arm
    gear = replace(ADDED["gear"][0], recordings=("elsewhere.csv",))
    for terms, inertial, columns in (((gear,), False, 2), ((gear,), True, 32), ((*plain.terms, gear), False, 11)):
        found = rows(prepared, replace(plain, terms=terms), inertial).jacobian
        assert found.shape[2] == columns
        assert not np.any(found[:, :, columns - (32 if inertial else 2) :][:, :, :2])


@pytest.mark.parametrize("name", ["nothing", "friction by load", "gain and delay", "stribeck", "gear"])
def test_derivatives_by_widths_of_friction_against_differences(arm, name):
    plain, prepared = arm
    added = {**ADDED, "stribeck": [term("stribeck", (1,), 0.5, 0.2, width=0.05)]}[name]
    model = replace(plain, terms=tuple(widened(t, {(j,): 0.05 for j in range(3)}) for t in (*plain.terms, *added)))
    found = rows(prepared, model, widths=[(0,), (1,), (2,)]).jacobian[:, :, len(model.values) :]
    for j in range(3):
        ends = []
        for change in (0.999, 1.001):
            there = replace(model, terms=tuple(widened(t, {(j,): 0.05 * change}) for t in model.terms))
            ends.append(rows(prepared, there).residual)
        expected = (ends[0] - ends[1]) / np.log(1.001 / 0.999)
        largest = np.abs(expected).max()
        assert largest > 1e-3
        # of a gear, the width's part in how the link swings is neglected; else the error of the difference, of second order
        assert np.abs(found[:, :, j] - expected).max() < (0.05 if name == "gear" else 1e-4) * largest


def test_derivatives_by_elastic_gears_have_the_change_of_unknown_starts(arm):
    """How a link may swing at the start of a recording depends on the gear; against differences of the whole residual."""
    plain, prepared = arm
    gear = term("joint_elasticity", (1,), 300.0, 0.004)
    model, size = replace(plain, terms=(*plain.terms, gear)), len(plain.values)
    found = rows(prepared, model)
    for k, value in enumerate(gear.values):
        ends = []
        for change in (0.9995, 1.0005):
            there = gear.with_values(np.where(np.arange(2) == k, change * value, gear.values))
            ends.append(rows(prepared, replace(model, terms=(*plain.terms, there))).residual)
        expected = (ends[0] - ends[1]) / (0.001 * value)
        assert np.abs(expected).max() > 1e-6
        assert np.abs(found.jacobian[:, :, size + k] - expected).max() < 0.01 * np.abs(expected).max()
