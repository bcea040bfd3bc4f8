"""Commands that act later than they are recorded: in what is predicted, in its derivatives, and in a calibration."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rrr_oc.calibration.calibrate import calibrate
from rrr_oc.calibration.calibrated_model import CalibratedModel
from rrr_oc.calibration.inverse_dynamics import plain_model
from rrr_oc.calibration.jacobian import Prediction
from rrr_oc.errors import UserError
from rrr_oc.recordings.reader import load_recordings
from rrr_oc.storage import write_csv

URDF = """<robot name="pendulum"><link name="base"/><link name="l1"><inertial><origin xyz="0 0 -0.4"/><mass value="0.7"/>
<inertia ixx="0.004" ixy="0" ixz="0" iyy="0.004" iyz="0" izz="0.001"/></inertial></link>
<joint name="j1" type="revolute"><parent link="base"/><child link="l1"/><axis xyz="0 1 0"/>
<limit lower="-3" upper="3" effort="60" velocity="9"/></joint></robot>"""
KP, KD, DRY, VISCOUS, ROTOR = 18.0, 0.5, 0.11, 0.45, 0.028
WIDTH = 0.03  # [rad/s]


def motion(t: np.ndarray, seed: int) -> np.ndarray:
    """Angle, speed and acceleration of the pendulum, (3, K), exact at all times."""
    rng, found = np.random.default_rng(seed), np.zeros((3, t.size))
    for w in 2 * np.pi * np.array([0.2, 0.33, 0.55, 0.8]):
        a, p = rng.uniform(0.2, 0.5), rng.uniform(0, 6)
        found += a * np.array([np.sin(w * t + p), w * np.cos(w * t + p), -(w**2) * np.sin(w * t + p)])
    return found


def command(t: np.ndarray, seed: int, wait: float) -> np.ndarray:
    """What is commanded at t so that the pendulum moves as `motion` says if it acts `wait` later."""
    q, dq, ddq = motion(t + wait, seed)
    torque = (0.7 * 0.4**2 + 0.004 + ROTOR) * ddq + 0.7 * 9.81 * 0.4 * np.sin(q) + DRY * np.tanh(dq / WIDTH) + VISCOUS * dq
    return q + (torque + KD * dq) / KP


def written(folder: Path, wait: float, rate: float = 50.0, seconds: float = 20.0) -> Path:
    """Three recordings of an encoder of 14 bit."""
    files, step = [f"r{k}.csv" for k in range(3)], 2 * np.pi / 2**14
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "arm.urdf").write_text(URDF)
    for seed, file in enumerate(files):
        t = np.arange(0, seconds, 1 / rate)
        write_csv(
            folder / file, {"t": t, "q_j1": np.round(motion(t, seed)[0] / step) * step, "command_j1": command(t, seed, wait)}
        )
    head = {"format": "rrr_oc-recordings/1", "robot": "arm.urdf", "joints": ["j1"], "torque": "command", "kp": KP, "kd": KD}
    (folder / "recordings.json").write_text(json.dumps(head | {"recordings": [{"file": file} for file in files]}))
    return folder


def with_wait(model: CalibratedModel, wait: float) -> CalibratedModel:
    terms = (t.with_values(np.array([wait])) if t.effect.name == "command_delay" else t for t in model.terms)
    return replace(model, terms=tuple(terms))


def test_what_is_recorded_asks_for_what_the_command_gains_meanwhile(tmp_path):
    recordings = load_recordings(written(tmp_path, 0.0))
    model, r = plain_model(recordings), recordings.recordings[0]
    assert r.command is not None
    gained = with_wait(model, 0.013).output_torque(r) - model.output_torque(r)
    at = r.t > 0.1
    np.testing.assert_allclose(gained[0, at], KP * (r.command[0] - np.interp(r.t - 0.013, r.t, r.command[0]))[at], atol=1e-9)


@pytest.mark.parametrize("wait", [-0.004, 0.0, 0.013])
def test_derivatives_by_a_wait_are_those_of_differences(tmp_path, wait):
    recordings = load_recordings(written(tmp_path, 0.0))
    model, r = with_wait(plain_model(recordings), wait), recordings.recordings[0]
    (k,) = [i for i, t in enumerate(model.terms) if t.effect.name == "command_delay"]
    assert all(len(t.estimates) == 1 for t in model.terms)
    found = Prediction(model, r).by_parameters()[0, :, k]
    there, here = (with_wait(model, wait + x).output_torque(r)[0] for x in (1e-3, -1e-3))
    inside = slice(20, -20)
    scale = np.abs(found[inside]).max()
    np.testing.assert_allclose(
        found[inside], ((there - here) / 2e-3)[inside], atol=0.1 * scale
    )  # a line between samples has corners


@pytest.mark.parametrize("wait", [0.0, 0.02])
def test_a_delay_of_commands_is_no_viscous_friction(tmp_path, wait):
    """20 ms look like 0.36 Nm s/rad; the intervals of all that is estimated hold what is true."""
    model = calibrate(load_recordings(written(tmp_path, wait)))
    truth = {"dry_friction": DRY, "viscous_friction": VISCOUS, "armature": ROTOR, "command_delay": wait}
    found = {t.effect.name: t.estimates[0] for t in model.terms}
    assert set(found) == set(truth)
    for name, true in truth.items():
        interval = found[name].interval
        assert interval is not None
        assert interval[0] <= true <= interval[1], name
    assert found["viscous_friction"].value == pytest.approx(VISCOUS, abs=0.05)
    assert found["command_delay"].value == pytest.approx(wait, abs=0.002)


@pytest.mark.parametrize("gains", [{"kp": None}, {"kp": {"j1": None}, "kd": {"j1": KD}}])
def test_a_kp_that_is_not_known_follows_from_the_masses(tmp_path, gains):
    """With intervals that hold the truth and are wider than those of a known kp; errors of the file's masses are errors of kp."""
    known = calibrate(load_recordings(written(tmp_path, 0.02)))
    header = json.loads((tmp_path / "recordings.json").read_text())
    (tmp_path / "recordings.json").write_text(json.dumps(header | gains))
    recordings = load_recordings(tmp_path)
    assert recordings.estimated_kp["j1"] == pytest.approx(KP, rel=0.02)
    assert any(note.startswith("kp is not known: 18") for note in recordings.notes)
    found = {t.effect.name: t.estimates[0] for t in calibrate(recordings).terms}
    sure = {t.effect.name: t.estimates[0] for t in known.terms}
    truth = {"dry_friction": DRY, "viscous_friction": VISCOUS, "armature": ROTOR, "command_delay": 0.02, "controller_gain": 1.0}
    assert set(found) == set(truth)
    for name, true in truth.items():
        low, high = found[name].interval or (np.nan, np.nan)
        assert low <= true <= high, name
        assert name == "controller_gain" or high - low > 0.9 * np.diff(sure[name].interval or (0, np.inf))


def test_neither_kp_nor_masses_known_is_an_error(tmp_path):
    header = json.loads((written(tmp_path, 0.0) / "recordings.json").read_text()) | {"kp": None, "inertial": "identify"}
    (tmp_path / "recordings.json").write_text(json.dumps(header))
    with pytest.raises(UserError, match="kp of j1 is not known, and the masses are not either"):
        load_recordings(tmp_path)
