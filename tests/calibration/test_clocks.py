"""Torques with a clock of their own are found, undone and told; friction that changes is no clock."""

from dataclasses import replace

import numpy as np
import pytest
from recorded import Plant, as_set, multisine, record

from rrr_oc.calibration.calibrate import calibrate
from rrr_oc.recordings.recording import RecordingSet

TRUTH = np.array([[2.0, 3.0, 1.5], [3.0, 4.0, 2.0], [0.2, 0.3, 0.1]])


def recorded(late: tuple[float, ...], drift: tuple[float, ...], grows: float = 0.0) -> RecordingSet:
    """Recordings of the paper's arm whose torques are late by these times in the middle, and by so much more at the end than at the
    begin [s]; viscous friction grows by a share over each."""
    plant, rng, made = Plant("rrr", *TRUTH), np.random.default_rng(82), []
    for i, (middle, more) in enumerate(zip(late, drift, strict=True)):
        fine = np.arange(12000) / 1000
        motion = multisine(3, fine, rng)
        course = fine / fine[-1] - 0.5
        torque = plant.torque(*motion) + grows * course * TRUTH[1][:, None] * motion[1]
        moved = np.array([np.interp(fine - middle - more * course, fine, x) for x in torque])[:, ::10]
        r = record(plant, f"{i}.csv", rng, 12.0, motion=tuple(x[:, ::10] for x in motion))
        made.append(replace(r, tau=moved + 0.01 * moved.std(axis=1, keepdims=True) * rng.standard_normal(moved.shape)))
    return as_set(plant, made)


def values(recordings: RecordingSet) -> tuple[np.ndarray, list[str]]:
    """Dry friction, viscous friction and rotors, (3, n), and what is told of clocks."""
    model = calibrate(recordings)
    return np.array([t.values[0] for t in model.prompt_terms]).reshape(3, 3).T, model.report["clocks"]


@pytest.mark.parametrize(
    ("late", "drift", "told"),
    [
        ((0.0, 0.008, -0.004), (0.0, 0.0, 0.0), ["0.csv", "1.csv", "2.csv"]),
        ((0.004, 0.004, 0.004), (0.010, 0.010, 0.010), ["0.csv", "1.csv", "2.csv"]),
    ],
    ids=["set by hand", "drift apart"],
)
def test_clocks_of_torques_are_undone_and_told(late, drift, told):
    (dry, viscous, _), said = values(recorded(late, drift))
    np.testing.assert_allclose(dry, TRUTH[0], rtol=0.02)
    np.testing.assert_allclose(viscous, TRUTH[1], rtol=0.02)
    assert {s.split(":")[0] for s in said} <= set(told)
    assert len(said) >= 2
    assert ("fall behind the positions by" if drift[2] else "earlier") in said[-1]
    if drift[2]:
        assert float(said[-1].split(" ms over it")[0].split()[-1]) == pytest.approx(10, abs=1)  # told in two digits


@pytest.mark.parametrize("grows", [0.0, 0.3])
def test_one_delay_and_friction_that_grows_are_no_clocks(grows):
    assert values(recorded((0.005, 0.005, 0.005), (0.0, 0.0, 0.0), grows))[1] == []
