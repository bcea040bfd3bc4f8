"""Evaluation: NRMSE against numbers worked out here with scipy's filter, predictions sample by sample, simulated signals."""

import csv
from dataclasses import replace

import numpy as np
import pytest
from recorded import Plant, as_set, record
from scipy.signal import savgol_filter

from rrr_oc.calibration.calibrate import calibrate
from rrr_oc.calibration.calibrated_model import CalibratedModel, Estimate, Term
from rrr_oc.calibration.inverse_dynamics import plain_model
from rrr_oc.calibration.prediction_error import SIGNALS, error, evaluate_inverse, evaluate_simulated, summary, write_predictions
from rrr_oc.effects import CATALOGUE
from rrr_oc.errors import UserError
from rrr_oc.recordings.recording import RecordingSet
from rrr_oc.robot.rigid_body import rigid_body

TRUTH = np.array([[5.2, 7.1, 3.3], [14.0, 21.0, 9.0], [0.31, 0.22, 0.12]])


def known(recordings: RecordingSet, truth: np.ndarray = TRUTH) -> CalibratedModel:
    """The model with these parameters, without any calibration."""
    start = plain_model(recordings)
    return replace(
        start, terms=tuple(t.with_values(v) for t, v in zip(start.prompt_terms, truth.T.reshape(-1, 1), strict=True))
    )


@pytest.fixture(scope="module")
def pair() -> tuple[RecordingSet, CalibratedModel]:
    plant, rng = Plant("rrr", *TRUTH), np.random.default_rng(0)
    made = [record(plant, f"{i}.csv", rng, 8.0, payload=p, tool=(0.3, 0, 0)) for i, p in enumerate((0.0, 5.0))]
    recordings = as_set(plant, made)
    return recordings, known(recordings)


def by_hand(recorded: np.ndarray, predicted: np.ndarray, samples: int) -> tuple[float, float]:
    """NRMSE and RMSE on a uniform 100 Hz grid; scipy's filter agrees with ours away from the ends, of which 0.1 s go."""
    a, b = (savgol_filter(x, samples, 3, mode="interp") if samples else x for x in (recorded, predicted))
    a, b = a[10:-10], b[10:-10]
    rmse = np.sqrt(np.mean((a - b) ** 2))
    return rmse / np.std(a), rmse


@pytest.mark.parametrize(("window", "samples"), [(0.0, 0), (0.14, 15), (0.3, 31)])
def test_nrmse_is_what_a_calculator_gives(window, samples):
    rng, t = np.random.default_rng(1), np.arange(500) / 100
    recorded = np.sin(2 * t) + 0.1 * rng.standard_normal(500)
    predicted = np.sin(2 * t + 0.1)
    found = error(t, recorded[None], predicted[None], (slice(0, 500),), window)
    assert (found["nrmse"][0], found["rmse"][0]) == pytest.approx(by_hand(recorded, predicted, samples), rel=1e-9)


def test_nrmse_of_plain_cases():
    t = np.arange(101) / 100
    square = np.where(np.arange(101) % 2, 1.0, -1.0)[None]  # spread 1 over the 81 samples that stay, but for their odd number
    found = error(t, square, square + 0.5, (slice(0, 101),), 0.0)
    assert found["rmse"][0] == pytest.approx(0.5)
    assert found["nrmse"][0] == pytest.approx(0.5 / np.sqrt(1 - (1 / 81) ** 2))
    constant = error(t, np.full((1, 101), 3.0), square, (slice(0, 101),), 0.0)
    assert np.isnan(constant["nrmse"][0])  # nothing to compare with
    assert constant["rmse"][0] > 0
    short = error(t[:15], square[:, :15], square[:, :15], (slice(0, 15),), 0.0)
    assert np.isnan(short["nrmse"][0])  # 0.14 s less twice 0.1 s


def test_filters_stop_at_gaps():
    t = np.concatenate([np.arange(200) / 100, 5 + np.arange(200) / 100])
    step = np.where(t < 4, 0.0, 10.0)[None] + np.sin(9 * t)
    halves = (slice(0, 200), slice(200, 400))
    assert error(t, step, step + 1, halves)["rmse"][0] == pytest.approx(1, abs=1e-9)
    pieces = [savgol_filter(step[0, s], 15, 3, mode="interp") for s in halves]
    kept = np.concatenate(pieces)[(t >= t[0] + 0.1) & (t <= t[-1] - 0.1)]
    found = error(t, step, 0 * step, halves, 0.14)
    assert found["rmse"][0] == pytest.approx(np.sqrt(np.mean(kept**2)), rel=1e-9)


def test_a_perfect_model_leaves_the_noise(pair):
    recordings, model = pair
    found = evaluate_inverse(model, recordings, window=0.0)
    assert set(found) == {"0.csv", "1.csv"}
    for r in recordings.recordings:
        for j, joint in enumerate(recordings.joints):
            nrmse, rmse = by_hand(r.tau[j], model.predict(r)[j], 0)
            assert found[r.file][joint] == {"nrmse": pytest.approx(nrmse), "rmse": pytest.approx(rmse)}
            assert nrmse < 0.035  # noise is 2 % of the spread; encoder counts and the window of derivatives add to it


def test_means_are_over_recordings_and_skip_what_is_unknown():
    entry = lambda x: {"a": {"nrmse": x, "rmse": 2.0}}  # noqa: E731
    found = summary({"1.csv": entry(0.1), "2.csv": entry(0.3), "3.csv": entry(None)})
    assert found["mean"]["inverse"]["a"] == {"nrmse": pytest.approx(0.2), "rmse": 2.0}
    assert found["simulated"] == {}
    assert summary({"1.csv": entry(None)})["mean"]["inverse"]["a"]["nrmse"] is None


def test_predictions_stand_at_every_sample(pair, tmp_path):
    recordings, model = pair
    write_predictions(model, recordings, tmp_path / "deep" / "folder")
    for r in recordings.recordings:
        with (tmp_path / "deep" / "folder" / r.file).open() as file:
            table = list(csv.reader(file))
        assert table[0] == ["t", "tau_joint1", "tau_joint2", "tau_joint3"]
        numbers = np.array(table[1:], float)
        np.testing.assert_array_equal(numbers[:, 0], r.t)
        np.testing.assert_array_equal(numbers[:, 1:].T, model.predict(r))


def test_currents_are_predicted_in_amperes(pair):
    recordings, model = pair
    constants = (10.0, 12.0, 8.0)
    amperes = tuple(replace(r, tau=r.tau / np.array(constants)[:, None]) for r in recordings.recordings)
    currents = replace(recordings, torque="current", torque_constant=constants, recordings=amperes)
    other = replace(model, torque="current", torque_constant=constants)
    a, b = evaluate_inverse(model, recordings), evaluate_inverse(other, currents)
    for file in a:
        for joint, k in zip(recordings.joints, constants, strict=True):
            assert b[file][joint]["nrmse"] == pytest.approx(a[file][joint]["nrmse"])
            assert b[file][joint]["rmse"] == pytest.approx(a[file][joint]["rmse"] / k)


def test_the_engine_follows_what_was_recorded(pair):
    recordings, model = pair
    found = evaluate_simulated(model, recordings)
    for file in found:
        for joint in recordings.joints:
            errors = {signal: found[file][joint][signal]["nrmse"] for signal in SIGNALS}
            # what sampling friction every 10 ms costs, on top of 2 % noise that the window takes most of
            assert errors["q"] < 0.002, (file, joint)
            assert errors["dq"] < 0.02, (file, joint)
            assert errors["tau_motor"] < 0.03, (file, joint)
            assert errors["tau_load"] < 0.1, (file, joint)  # the same error, over a third of the spread
    wrong = known(recordings, TRUTH * np.array([[1.0], [1.3], [1.0]]))
    worse = evaluate_simulated(wrong, recordings)
    for joint in recordings.joints:
        assert worse["0.csv"][joint]["tau_motor"]["nrmse"] > 2 * found["0.csv"][joint]["tau_motor"]["nrmse"]


def test_the_engine_carries_the_gravity_that_a_driver_leaves_out_of_its_efforts(pair):
    """The recorded torque lacks 70 % of the torque at rest; the arm that is simulated does not."""
    recordings, model = pair
    plant, still = Plant("rrr", *TRUTH), np.zeros(recordings.recordings[0].q.shape)
    gravity = [plant.load(r.q, still, still, float(r.payload[0]), (0.3, 0, 0)) for r in recordings.recordings]
    less = tuple(replace(r, tau=r.tau - 0.7 * g) for r, g in zip(recordings.recordings, gravity, strict=True))
    shown = replace(recordings, recordings=less)
    known_of = replace(model, terms=(*model.terms, Term(CATALOGUE["missing_gravity"](()), (Estimate(0.7),))))
    for r, g in zip(recordings.recordings, gravity, strict=True):
        np.testing.assert_allclose(known_of.output_torque(r), model.output_torque(r) - 0.7 * g, atol=1e-9)  # rounding
    whole, found, unknown = (
        evaluate_simulated(one, of) for one, of in ((model, recordings), (known_of, shown), (model, shown))
    )
    for joint in ("joint2", "joint3"):
        for signal in ("q", "tau_motor"):
            right, same = (x["1.csv"][joint][signal]["rmse"] for x in (whole, found))
            assert same == pytest.approx(right, rel=1e-6), (joint, signal)
        assert unknown["1.csv"][joint]["tau_motor"]["rmse"] > 10 * found["1.csv"][joint]["tau_motor"]["rmse"]


def test_other_robots_and_signals_are_refused(pair):
    recordings, model = pair
    with pytest.raises(UserError, match="records torque 'load', but the model predicts 'motor'"):
        evaluate_inverse(model, replace(recordings, torque="load"))
    other = replace(recordings, robot=replace(recordings.robot, joints=("a", "b", "c")))
    with pytest.raises(UserError, match="records the joints a, b, c, but the model has joint1"):
        evaluate_simulated(model, other)


def test_the_recordings_say_where_gravity_pulls_and_where_the_payload_is():
    """A model of bare recordings predicts others with a payload at a tool of theirs, or hung from a ceiling."""
    plant, rng, tool = Plant("rrr", np.ones(3), np.ones(3), 0.1 * np.ones(3)), np.random.default_rng(3), (0.2, 0.0, 0.1)
    bare = as_set(plant, [record(plant, f"{i}.csv", rng, 8.0) for i in range(2)])
    model = calibrate(bare)
    loaded = as_set(plant, [record(plant, "l.csv", rng, 8.0, payload=2.0, tool=tool)])
    loaded = replace(loaded, tool=loaded.robot.point(loaded.robot.links[-1], tool))
    up = replace(bare.robot, gravity=-bare.robot.gravity)
    body, own = rigid_body(up), bare.recordings[0]
    change = along_samples(body, up, own) - along_samples(body, bare.robot, own)
    hung = replace(bare, robot=up, recordings=(replace(own, tau=own.tau + change),))
    for other in (loaded, hung):
        errors = evaluate_inverse(model, other)
        assert all(e["nrmse"] < 0.05 for file in errors.values() for e in file.values())
    assert evaluate_inverse(model, replace(hung, robot=bare.robot))["0.csv"]["joint2"]["nrmse"] > 0.5
    longer = replace(bare.robot, placements=bare.robot.placements + 0.01 * (np.arange(16).reshape(4, 4) == 7))
    with pytest.raises(UserError, match="sits or turns otherwise than in the model"):
        evaluate_inverse(model, replace(bare, robot=longer))


def along_samples(body, robot, r) -> np.ndarray:
    columns = [body.inverse_dynamics(*x, robot.inertial, robot.gravity) for x in zip(r.q.T, r.dq.T, r.ddq.T, strict=True)]
    return np.hstack([np.array(c) for c in columns])
