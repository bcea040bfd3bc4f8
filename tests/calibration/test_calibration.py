"""Calibration: a concealed truth is found again, with honest intervals; what cannot be known is said to be unknown."""

import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from chains import arm as chain
from chains import random_chain
from recorded import Plant, as_set, behind_gear, multisine, real, record

from rrr_oc.calibration.calibrate import calibrate, data_of, fit
from rrr_oc.calibration.calibrated_model import CalibratedModel, Estimate, Term, nominal_term
from rrr_oc.calibration.estimator.data import low_frequency
from rrr_oc.calibration.estimator.fitting import PlainFitter
from rrr_oc.calibration.estimator.intervals import covariance, half_width
from rrr_oc.calibration.inverse_dynamics import plain_model
from rrr_oc.calibration.model_file import load_model, save_model
from rrr_oc.calibration.parameter_vector import labels, widened, with_parameter_values
from rrr_oc.calibration.regression import filtered_residuals, rows
from rrr_oc.calibration.response import calibrate_evolution, calibrate_response
from rrr_oc.calibration.samples import prepare
from rrr_oc.effects.elastic.parallel_spring import ParallelSpring
from rrr_oc.effects.transmission.joint_elasticity import JointElasticity
from rrr_oc.errors import UserError
from rrr_oc.numerics.rank import undetermined
from rrr_oc.recordings.importers import import_prototype
from rrr_oc.recordings.reader import load_recordings
from rrr_oc.recordings.recording import RecordingSet
from rrr_oc.robot.inertial_parameters import base_parameters, from_log_cholesky, is_physical, pseudo_inertia, to_log_cholesky
from rrr_oc.robot.rigid_body import rigid_body
from rrr_oc.robot.robot import load_robot

TRUTH = np.array([[5.2, 7.1, 3.3], [14.0, 21.0, 9.0], [0.31, 0.22, 0.12]])  # dry, viscous, armature of three joints
PEA = {1: (13.705, 1.92), 2: (1.318, 2.44)}


def eight(plant: Plant, seed: int, seconds: float = 15.0, **options):
    """The protocol's eight recordings: with and without 5 kg, with and without springs, each twice."""
    rng = np.random.default_rng(seed)
    mounted = [(payload, pea) for payload in (5.0, 0.0) for pea in (PEA, None)] * 2
    return [
        record(plant, f"{i}.csv", rng, seconds, payload=payload, pea=pea, tool=(0.3, 0, 0), **options)
        for i, (payload, pea) in enumerate(mounted)
    ]


def one(dry=2.0, viscous=1.5, armature=0.2, folder=None, width=0.05) -> Plant:
    """A plant of one joint."""
    path = folder / "one.urdf"
    path.write_text(chain(1))
    return Plant(path, np.array([dry]), np.array([viscous]), np.array([armature]), width)


def values(model: CalibratedModel) -> np.ndarray:
    """The parameters of all terms but the lags of the torques."""
    return np.concatenate([term.values for term in model.prompt_terms])


def estimates(model: CalibratedModel) -> list[Estimate]:
    return [e for term in model.prompt_terms for e in term.estimates]


def estimate(model: CalibratedModel, label: str):
    return dict(zip(labels(model), (e for t in model.terms for e in t.estimates), strict=True))[label]


@pytest.fixture(scope="module")
def concealed() -> tuple[RecordingSet, CalibratedModel]:
    """A noisy set of the plant with `TRUTH`, and what calibration makes of it."""
    recordings = as_set(Plant("rrr", *TRUTH), eight(Plant("rrr", *TRUTH), seed=3))
    return recordings, calibrate(recordings)


def test_concealed_parameters_are_recovered(concealed):
    model = concealed[1]
    true = TRUTH.T.ravel()
    friction = [k for k, label in enumerate(labels(model)) if "friction" in label]
    # what the project promises; of the armature, an error of a link's inertia takes a part, as large as URDFs have
    np.testing.assert_allclose(values(model)[friction], true[friction], rtol=0.02)
    lags = [t.estimates[0] for t in model.terms[9:]]
    found, true = [*estimates(model), *lags], [*true, 0.0, 0.0, 0.0]
    # 4.5 standard errors: twelve independent estimates exceed that once in 10⁴ sets
    assert all(abs(e.value - x) < 4.5 * e.std for e, x in zip(found, true, strict=True))
    assert all(0.02 < e.std / abs(e.value) * 100 < 3 for e in estimates(model))  # and no interval is idle
    assert all(e.interval[0] < e.value < e.interval[1] for e in found)
    assert all(e.std < 1e-3 for e in lags)  # [s]
    assert model.report["at_bound"] == model.report["undetermined"] == []
    assert 1 < model.report["condition"] < 100
    assert [t.width for t in model.terms if t.width] == pytest.approx([0.05] * 3, rel=0.03)  # the plant's own
    assert np.all(model.nrmse < 0.02)  # the noise's share, smoothed


def test_noise_is_told_from_motion(concealed):
    recordings, model = concealed
    expected = [np.mean([0.02 * r.tau[j].std() for r in recordings.recordings]) for j in range(3)]
    np.testing.assert_allclose(model.noise, expected, rtol=0.1)  # recordings differ by some per cent


@pytest.mark.parametrize("width", [0.01, 0.03])
def test_abrupt_friction_gets_its_own_width(tmp_path, width):
    plant = one(folder=tmp_path, width=width)
    rng = np.random.default_rng(5)
    model = calibrate(as_set(plant, [record(plant, f"{i}.csv", rng, 20.0) for i in range(2)]))
    assert model.terms[0].width == pytest.approx(width, rel=0.02)
    np.testing.assert_allclose(values(model), [2.0, 1.5, 0.2], rtol=0.02)


def test_a_width_is_an_estimate_like_any_other(tmp_path):
    plant, rng = one(folder=tmp_path, width=0.03), np.random.default_rng(5)
    recordings = as_set(plant, [record(plant, f"{i}.csv", rng, 20.0) for i in range(3)])
    start = plain_model(recordings)
    off = replace(start, terms=tuple(widened(t, {(0,): 0.033}) for t in start.prompt_terms))
    near, far = fit(recordings, off), fit(recordings, start)
    std = np.array([e.std for e in estimates(far)])
    assert near.terms[0].width == pytest.approx(far.terms[0].width, rel=2e-3)
    assert np.all(
        np.abs(values(near) - values(far)) < 0.64 * std
    )  # each ends where a step gains less than 0.05 nats: within 0.32
    fitter = PlainFitter.of(data_of(recordings, prepare(recordings), start, far))
    fitted = fitter.closest(fitter.begin(start))
    own = covariance(fitted)
    pinned = np.linalg.inv(fitted.posterior.matrix[:-1, :-1])  # the width is the last parameter
    # a wider sign needs a higher level, and less viscous friction
    assert np.all(np.sqrt(np.diag(own))[:2] > 1.005 * np.sqrt(np.diag(pinned))[:2])


def test_rounding_carries_no_parameter_over_its_bound(concealed):
    _, model = concealed
    moved = with_parameter_values(model.prompt_terms, np.full(len(values(model)), -1e-9))
    assert all(v >= 0 for t in moved for v in t.values)


def test_spikes_are_taken_out_and_counted(concealed):
    recordings, clean = concealed
    rng, spiked = np.random.default_rng(0), []
    for r in recordings.recordings:
        tau = r.tau.copy()
        for row in tau:
            row[rng.choice(len(row), 15, replace=False)] += 20 * row.std()
        spiked.append(replace(r, tau=tau))
    model = calibrate(replace(recordings, recordings=tuple(spiked)))
    assert all(abs(n - 120) <= 10 for n in model.report["spikes"].values())
    std = np.array([e.std for e in estimates(clean)])
    assert np.all(np.abs(values(model) - values(clean)) < std)


def test_a_parameter_at_its_bound_keeps_an_interval(tmp_path):
    plant, rng = one(viscous=-0.05, folder=tmp_path), np.random.default_rng(1)  # an arm that gains speed: beyond the bound
    model = calibrate(as_set(plant, [record(plant, f"{i}.csv", rng, 15.0) for i in range(3)]))
    viscous = estimate(model, "viscous_friction[j1].coefficient")
    assert viscous.value == 0
    assert viscous.at_bound
    assert viscous.interval[0] == 0
    assert model.report["at_bound"] == ["viscous_friction[j1].coefficient"]
    assert estimate(model, "dry_friction[j1].level").value == pytest.approx(2.0, rel=0.05)  # the bound's bias is small


def test_a_joint_that_rests_is_not_determined():
    plant, rng = Plant("rrr", *TRUTH), np.random.default_rng(2)
    made = []
    for i in range(2):
        motion = multisine(3, np.arange(1500) / 100, rng)
        for x in motion:
            x[0] = 0.0
        made.append(record(plant, f"{i}.csv", rng, 15.0, motion=motion))
    model = calibrate(as_set(plant, made))
    assert model.report["undetermined"] == [
        "dry_friction[joint1].level",
        "viscous_friction[joint1].coefficient",
        "armature[joint1].inertia",
    ]  # its torque is as late as that of others
    assert all(e.std is None and e.interval is None for t in model.terms[:3] for e in t.estimates)
    assert model.report["resting_share"]["joint1"] == 1
    off, std = values(model)[3:] - TRUTH.T.ravel()[3:], np.array([e.std for e in estimates(model)[3:]])
    assert np.all(np.abs(off) < 3 * std)
    assert np.all(std < np.array([0.02, 0.02, 0.2] * 2) * TRUTH.T.ravel()[3:])


def test_currents_and_load_torques(tmp_path):
    plant, rng = one(folder=tmp_path), np.random.default_rng(4)
    motor = as_set(plant, [record(plant, "a.csv", rng, 15.0)])
    (r,) = motor.recordings
    current = replace(motor, torque="current", torque_constant=(8.0,), recordings=(replace(r, tau=r.tau / 8),))
    a, b = calibrate(motor), calibrate(current)
    np.testing.assert_allclose(values(b), values(a), rtol=1e-9)
    np.testing.assert_allclose(b.predict(r), a.predict(r) / 8)
    load = calibrate(as_set(plant, [record(plant, "a.csv", rng, 15.0, load=True)], torque="load"))
    assert [t.effect.name for t in load.terms] == ["torque_lag"]  # the drives are not in it
    assert load.nrmse[0] < 0.02
    with pytest.raises(UserError, match="only inverse dynamics"):
        calibrate_response(as_set(plant, [r], torque="load"))


def test_too_short_recordings_are_refused(tmp_path):
    plant = one(folder=tmp_path)
    with pytest.raises(UserError, match=r"rows are left after the filter; pieces of 0\.5 s and more"):
        calibrate(as_set(plant, [record(plant, "a.csv", np.random.default_rng(0), 0.4)]))


@pytest.mark.parametrize("joints", [1, 3])
def test_inertial_parameters_are_identified(joints, tmp_path):
    plant = one(folder=tmp_path) if joints == 1 else Plant("rrr", *TRUTH)
    rng = np.random.default_rng(6)
    made = [record(plant, f"{i}.csv", rng, 15.0) for i in range(4)]
    truth = as_set(plant, made).robot
    massless = replace(truth, inertial=np.zeros((10, joints)))  # nothing of the truth leaks in
    model = calibrate(as_set(plant, made[:3], "identify", robot=massless))
    base = base_parameters(truth)
    # no motion tells an armature about a fixed axis from its link's inertia: their sum is known, and the prior shares it out
    shared = [0] if joints == 1 else [0, 1]
    named = zip(labels(model), (e for t in model.terms for e in t.estimates), strict=True)
    assert [label for label, e in named if e.std is None] == [f"armature[{truth.joints[j]}].inertia" for j in shared]
    true, found = (
        robot.inertial + sum(np.outer(about(truth.axes[j]), np.arange(joints) == j) * armature[j] for j in range(joints))
        for robot, armature in ((truth, plant.armature), (model.robot, values(model)[2::3]))
    )
    for entry, want, got in zip(
        model.report["base_parameters"], base.projection @ true.T.ravel(), base.projection @ found.T.ravel(), strict=True
    ):
        rotors = [e.std or 0.0 for e in estimates(model)[2::3]]  # which are part of it
        assert abs(got - want) < 4.5 * np.hypot(entry["std"], max(rotors)) + 1e-9, entry  # as above
    assert model.report["smallest_pseudo_inertia"] > 0
    # unseen motion: better than 3 %, of which noise is 2 %
    unseen = made[3]
    error = model.predict(unseen) - unseen.tau
    assert np.all(error.std(axis=1) < 0.03 * unseen.tau.std(axis=1))


def about(axis: np.ndarray) -> np.ndarray:
    """Ten inertial parameters of 1 kg m² about an axis."""
    return np.concatenate([np.zeros(4), np.outer(axis, axis)[[0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]]])


def test_the_ways_on_the_simulated_response_agree(tmp_path):
    plant, rng = one(folder=tmp_path, width=0.01), np.random.default_rng(7)  # nearly the engine's friction
    recordings = as_set(plant, [record(plant, f"{i}.csv", rng, 4.0) for i in range(2)])
    gradient = calibrate_response(recordings)
    evolution = calibrate_evolution(recordings, generations=40, population=12)
    a, b = (m.report["objective"] for m in (gradient, evolution))
    assert abs(a / b - 1) < 0.01
    np.testing.assert_allclose(values(gradient), [2.0, 1.5, 0.2], rtol=0.02)  # samples of 10 ms blur the friction fed forward
    np.testing.assert_allclose(values(evolution), values(gradient), rtol=0.02)
    assert all(e.std > 0 for t in gradient.terms for e in t.estimates)
    assert gradient.report["history"][-1][1] <= gradient.report["history"][0][1]
    assert gradient.report["evaluations"] < evolution.report["evaluations"] / 5
    assert all(late[1] <= early[1] for early, late in pairwise(evolution.report["history"]))


def test_model_file_round_trip(concealed, tmp_path):
    recordings, model = concealed
    save_model(model, tmp_path / "model.json")
    again = load_model(tmp_path / "model.json")
    assert again.terms == model.terms
    for r in recordings.recordings[:2]:  # with a spring and without
        np.testing.assert_array_equal(again.predict(r), model.predict(r))
    save_model(again, tmp_path / "again.json")
    assert (tmp_path / "again.json").read_text() == (tmp_path / "model.json").read_text()


def test_terms_hold_for_files_and_groups(concealed):
    recordings, model = concealed
    r = recordings.recordings[1]
    spring = nominal_term(ParallelSpring((1,), active="below")).with_values(np.array([10.0, 1.0]))
    bare = model.predict(r)
    for term, holds in (
        (spring, True),
        (replace(spring, recordings=("1.csv",)), True),
        (replace(spring, recordings=("0.csv",)), False),
        (replace(spring, recordings=(), groups=("1.csv",)), True),
    ):
        assert isinstance(term, Term)
        changed = replace(model, terms=(*model.terms, term)).predict(r)
        expected = 10 * np.maximum(1.0 - r.q[1], 0) if holds else 0 * r.q[1]
        np.testing.assert_allclose(bare[1] - changed[1], expected, atol=0.02)  # the ramp's rounding


def test_broken_model_files(concealed, tmp_path):
    save_model(concealed[1], tmp_path / "model.json")
    text = (tmp_path / "model.json").read_text()
    content = json.loads(text)
    broken = {
        "truncated": text[: len(text) // 2],
        "format": json.dumps(content | {"format": "other/1"}),
        "effect": text.replace('"viscous_friction"', '"magic"', 1),
        "missing": json.dumps({k: v for k, v in content.items() if k != "effects"}),
        "not finite": json.dumps(content).replace('"value": 0.', '"value": NaN, "was": 0.', 1),
        "list": "[]",
        "empty": "",
        "kind": json.dumps(content | {"torque": "thrust"}),
        "number": json.dumps(content | {"joints": 3}),
    }
    for name, wrong in broken.items():
        path = tmp_path / f"{name}.json"
        path.write_text(wrong)
        with pytest.raises(UserError) as caught:
            load_model(path)
        assert path.name in str(caught.value)
        assert "\n" not in str(caught.value), name
    with pytest.raises(UserError, match="nowhere"):
        load_model(tmp_path / "nowhere.json")


def test_rows_have_exact_derivatives(concealed):
    recordings, model = concealed
    spring = nominal_term(ParallelSpring((1,), active="below")).with_values(np.array([4.0, 0.3]))
    some = replace(recordings, recordings=recordings.recordings[:2])
    prepared, bent = prepare(some), replace(model, terms=(*model.terms, spring))
    found, at, step = rows(prepared, bent), bent.values, 1e-6
    for i in (0, 4, 8, 12, 13):
        moved = at + step * np.eye(at.size)[i]
        numbers = iter(moved)
        shifted = replace(bent, terms=tuple(t.with_values(np.array([next(numbers) for _ in t.estimates])) for t in bent.terms))
        slope = -(rows(prepared, shifted).residual - found.residual) / step
        # derivatives are late by whole milliseconds
        np.testing.assert_allclose(found.jacobian[:, :, i], slope, rtol=0, atol=5e-3 * np.abs(slope).max())
        np.testing.assert_allclose(filtered_residuals(prepared, shifted), rows(prepared, shifted).residual)


def test_nonlinear_terms_are_fitted_together(tmp_path):
    plant, rng = one(folder=tmp_path), np.random.default_rng(9)
    made = [record(plant, f"{i}.csv", rng, 15.0, pea={0: (6.0, 0.2)}) for i in range(3)]
    recordings = as_set(plant, [replace(r, springs=()) for r in made])  # nobody noted the spring
    start = plain_model(recordings)
    spring = nominal_term(ParallelSpring((0,), active="below")).with_values(np.array([2.0, 0.0]))
    model = fit(recordings, replace(start, terms=(*start.terms, spring)))
    np.testing.assert_allclose(values(model), [2.0, 1.5, 0.2, 6.0, 0.2], rtol=0.02)


def elastic(folder, stiffness: float, time: float, fastest: float, noise: float, start: list[float]):
    """Three recordings of a joint with an elastic gear, and their fit from stiffness and damping time `start`."""
    plant, rng, made = one(folder=folder), np.random.default_rng(31), []
    for i in range(3):
        motion = multisine(1, np.arange(1500) / 100, rng, fastest)
        recorded = record(plant, f"{i}.csv", rng, 15.0, motion=motion)
        recorded = behind_gear(plant, recorded, motion, lambda twist, rate: stiffness * (twist + time * rate))
        made.append(replace(recorded, tau=recorded.tau + noise * rng.standard_normal(recorded.tau.shape)))
    recordings = as_set(plant, made)
    plain, gear = plain_model(recordings), nominal_term(JointElasticity((0,))).with_values(np.array(start))
    return recordings, fit(recordings, replace(plain, terms=(*plain.terms, gear)))


def test_an_elastic_gear_is_fitted_whatever_the_links_start_was(tmp_path):
    recordings, model = elastic(tmp_path, 8.0, 0.004, 0.8, 0.005, [12.0, 0.01])
    np.testing.assert_allclose(values(model), [2.0, 1.5, 0.2, 8.0, 0.004], rtol=0.02)
    for r in recordings.recordings:  # which begin while the link swings
        blind, seen = (np.sqrt(np.mean((tau - r.tau) ** 2)) for tau in (model.output_torque(r), model.predicted_torque(r)))
        assert seen < 0.3 * blind
        cut = replace(r, segments=(slice(0, 1), slice(1, 800), slice(800, len(r.t))))  # a sample alone has no start
        assert np.sqrt(np.mean((model.predicted_torque(cut) - r.tau) ** 2)) < 0.3 * blind


def test_intervals_cover_under_autocorrelated_noise():
    """A line through AR(1) noise of 0.2 s: 600 intervals for the slope, which naive ones (0.43 of the width) would miss."""
    rng, hits, naive = np.random.default_rng(10), 0, 0
    count, stretches, step, repetitions = 300, 3, 0.04, 600
    regressor = np.sin(np.arange(count * stretches) * step * 2)
    place, turning = np.tile(np.arange(count), stretches), np.zeros(count * stretches, bool)
    for _ in range(repetitions):
        drive = rng.standard_normal(count * stretches)
        noise, keep = np.zeros_like(drive), np.exp(-step / 0.2)
        for k in range(1, noise.size):
            noise[k] = keep * noise[k - 1] + drive[k]
        square = regressor @ regressor
        slope = regressor @ noise / square
        left = noise - slope * regressor
        std = low_frequency(left, place, turning, regressor[:, None] * left.std() / square**0.5) / square**0.5
        hits += abs(slope) < half_width(len(left)) * std
        naive += abs(slope) < 1.96 * left.std() / square**0.5
    # three binomial standard errors of 0.9 %, and 1 % for slopes whose noise is not flat over the cosines' band
    assert 0.915 < hits / repetitions < 0.985
    assert naive / repetitions < 0.75


def test_null_directions_are_found():
    a = np.random.default_rng(12).standard_normal((30, 4))
    a[:, 2] = 3 * a[:, 0]
    np.testing.assert_array_equal(undetermined(a.T @ a), [True, False, True, False])
    assert np.all(undetermined(np.zeros((2, 2))))


def test_log_cholesky_is_one_to_one():
    rng, forth = np.random.default_rng(13), from_log_cholesky()
    for _ in range(20):
        xi = rng.normal(0, 0.7, 10)
        parameters, jacobian = forth(xi)
        assert is_physical(parameters)
        assert np.linalg.eigvalsh(pseudo_inertia(parameters))[0] > 0
        np.testing.assert_allclose(to_log_cholesky(parameters), xi, atol=1e-9)
        for i in range(10):
            step = 1e-6 * np.eye(10)[i]
            np.testing.assert_allclose(jacobian[:, i], (forth(xi + step)[0] - forth(xi - step)[0]) / 2e-6, atol=1e-7, rtol=1e-6)


def test_base_parameters_hold_all_that_torques_tell(tmp_path):
    """As many as the rank of Pinocchio's own regressor; what changes none of them changes no torque."""
    path = tmp_path / "random.urdf"
    path.write_text(random_chain(3, 4))
    robot, model, rng = load_robot(path), pin.buildModelFromUrdf(str(path)), np.random.default_rng(14)
    data = model.createData()
    regressor = np.vstack([pin.computeJointTorqueRegressor(model, data, *rng.normal(0, 2, (3, 4))) for _ in range(60)])
    base = base_parameters(robot)
    assert len(base.names) == len(base.units) == np.linalg.matrix_rank(regressor, tol=1e-8 * np.abs(regressor).max())
    projection = base.projection
    null = np.linalg.svd(projection)[2][len(projection) :]
    body, state = rigid_body(robot), rng.normal(0, 1, (3, 4))
    for direction, moves in ((null.T @ rng.normal(size=len(null)), False), (projection[3], True)):
        changed = robot.inertial + direction.reshape(4, 10).T
        torques = [np.array(body.inverse_dynamics(*state, i, robot.gravity)).ravel() for i in (robot.inertial, changed)]
        assert np.allclose(*torques, atol=1e-9) != moves


def shared_set(name: str, tmp_path: Path) -> Path:
    """The folder of a set of real recordings, of which the prototype's are imported; skips where it is not at hand."""
    folder = real(name)
    if name != "rrr_prototype":
        return folder
    import_prototype(folder, tmp_path / name)
    return tmp_path / name


@pytest.mark.parametrize(
    ("name", "nrmse"),
    # what the sets gave when this test was written, and a tenth more
    [("rrr_prototype", [0.116, 0.134, 0.144]), ("staubli_tx40", [0.049, 0.051, 0.072, 0.077, 0.145, 0.42])],
)
def test_real_recordings(name, nrmse, tmp_path):
    model = calibrate(load_recordings(shared_set(name, tmp_path)))
    assert np.all(model.nrmse < nrmse)
    assert all(
        np.isfinite(e.value) and (e.interval is None or e.interval[0] <= e.value <= e.interval[1])
        for t in model.terms
        for e in t.estimates
    )
    if name == "rrr_prototype":  # the authors' own calibration in MuJoCo: damping 40.0, 22.8; friction loss 7.9, 6.1
        intervals = [model.terms[k].estimates[0].interval for k in (4, 7)]
        assert all(low < damping < high for (low, high), damping in zip(intervals, (39.958, 22.831), strict=True))
