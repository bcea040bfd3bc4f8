"""The study of the paper's calibration: coverage, race and tables on made-up data whose answers are known."""

from dataclasses import replace
from types import SimpleNamespace

import calibration
import numpy as np
import pytest
from recorded import Plant, as_set, record

from rrr_oc.calibration.inverse_dynamics import plain_model
from rrr_oc.calibration.prediction_error import error
from rrr_oc.robot.drives import load_actuators

TRUTH = np.array([[5.2, 7.1, 3.3], [14.0, 21.0, 9.0], [0.31, 0.22, 0.12]])


@pytest.fixture(scope="module")
def recordings():
    plant, rng = Plant("rrr", *TRUTH), np.random.default_rng(0)
    return as_set(plant, [record(plant, f"{i}.csv", rng, 6.0, pea={1: (5.0, 1.0)} if i else None) for i in range(2)])


def test_share_of_a_task_that_no_recording_covers(recordings, tmp_path):
    (r, _) = recordings.recordings
    still = replace(recordings, recordings=(replace(r, q=0 * r.q, dq=0 * r.dq),))
    t = np.linspace(0, 1, 101)
    ramp = np.radians(20 * t)  # to 20°: 5° of them, a quarter of the time, lie near the recorded rest
    np.savez(tmp_path / "SA.npz", t=t, q=[ramp, 0 * t], dq=[0 * t, 0 * t + 1], joints=["joint2", "joint3"])
    shares, motions = calibration.coverage(still, tmp_path)
    assert shares["SA"]["joint2"] == pytest.approx(0.75, abs=0.01)
    assert shares["SA"]["joint3"] == 1.0  # at 57 °/s
    assert motions["SA"]["joint2"].shape == (3, 2000)
    assert calibration.coverage(still, None) == ({}, {})
    for name in ("PEA*", "mine", "PEA"):
        (tmp_path / f"{name}.npz").write_bytes((tmp_path / "SA.npz").read_bytes())
    shares, motions = calibration.coverage(still, tmp_path)
    assert list(shares) == ["SA", "PEA", "mine", "PEA*"]
    drawn = calibration.draw_coverage(still, motions, shares).axes[1].get_lines()
    assert drawn[2].get_color() == drawn[4].get_color() != drawn[1].get_color()  # bought springs as those made to measure


def test_race_is_decided_by_one_per_cent_of_the_better(recordings):
    def way(*history):
        return SimpleNamespace(report={"history": history, "evaluations": 3, "wall_s": 9.0})

    found = calibration.race(way((0.5, 2.0), (1.0, 1.005)), way((10.0, 1.5), (150.0, 1.008), (200.0, 1.0)))
    assert found["seconds"] == {"gradient": 1.0, "evolution": 150.0}
    assert found["speed_up"] == 150.0
    lost = calibration.race(way((1.0, 1.0)), way((10.0, 1.5)))
    assert lost["seconds"]["evolution"] is None
    assert lost["speed_up"] is None


def test_the_middle_of_recordings(recordings):
    some = calibration.piece(recordings, 2.0)
    for whole, part in zip(recordings.recordings, some.recordings, strict=True):
        assert part.t[-1] - part.t[0] == pytest.approx(2.0, abs=0.02)
        assert part.t[0] - whole.t[0] == pytest.approx(whole.t[-1] - part.t[-1], abs=0.02)
        np.testing.assert_array_equal(part.tau, whole.tau[:, np.isin(whole.t, part.t)])
    assert calibration.piece(recordings, 0) is recordings


def test_the_table_of_a_true_model_shows_noise_alone(recordings):
    start = plain_model(recordings)
    model = replace(
        start, terms=tuple(t.with_values(v) for t, v in zip(start.prompt_terms, TRUTH.T.reshape(-1, 1), strict=True))
    )
    drives = load_actuators(("joint2", "joint3"))
    runs = [calibration.follow(model, recordings, r, drives) for r in recordings.recordings]
    rows = calibration.table(runs, 0.15, 0.1)
    assert set(rows) == {"without springs", "with springs"}
    for values in rows.values():
        named = dict(zip(calibration.SIGNALS, values, strict=True))
        assert named["q"] < 0.002
        assert named["tau_motor"] < 0.03  # noise of 2 %
    for run in runs:  # no more is left of the load torque than of the motor torque; its spread is smaller
        motor, load = (
            error(run.recording.t, run.recorded[s], run.simulated[s], run.recording.segments)["rmse"]
            for s in ("tau_motor", "tau_load of the engine, own drives")
        )
        assert np.all(load < motor)
    apart = calibration.apart(runs, 0.15, 0.1)
    for kind, values in rows.items():  # a true model agrees with its own drives, and is as far from Eq. 10 as those are
        engine = values[calibration.SIGNALS.index("tau_load of the engine")]
        assert engine == pytest.approx(apart[kind], rel=0.05)
    figure = calibration.draw_overlays(runs, drives)
    assert len(figure.axes) == 8
