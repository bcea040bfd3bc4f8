"""How well a calibrated model predicts recordings, from the measured motion and in simulation: NRMSE by signal and joint."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from rrr_oc.calibration.calibrated_model import CalibratedModel
from rrr_oc.model.recorded_physics import Physics, later
from rrr_oc.numerics.savitzky_golay import WINDOW, smooth
from rrr_oc.recordings.header import Loop
from rrr_oc.recordings.recording import Recording, RecordingSet
from rrr_oc.robot.robot import BUNDLED
from rrr_oc.simulation.engine_model import K_P, Controller
from rrr_oc.simulation.replay import replay, tracking_controller
from rrr_oc.simulation.rollout import Simulated
from rrr_oc.storage import number, write_csv

SIGNALS = ("q", "dq", "ddq", "tau_motor", "tau_load")
DROPPED = 0.1  # [s] left out at the start and at the end of a recording
Errors = dict[str, dict[str, Any]]  # by file, joint and, in simulation, signal: {"nrmse": …, "rmse": …}


def error(
    t: np.ndarray,
    recorded: np.ndarray,
    predicted: np.ndarray,
    segments: Sequence[slice],
    window: float = WINDOW,
    counted: np.ndarray | None = None,
) -> dict[str, np.ndarray]:
    """NRMSE [1] and RMSE [unit of the signal] of each row, both smoothed over `window` [s] (order 3), the ends dropped.

    Args:
        t: Times [s], shape (K,).
        recorded, predicted: Signals (n, K).
        segments: Slices of the samples that no filter may cross.
        counted: The samples that count, (n, K); all of them without it.

    Returns:
        `{"nrmse": (n,), "rmse": (n,)}`: RMSE over the standard deviation of the recorded signal, NaN where that is 0 or
        nothing is left.
    """
    kept = np.broadcast_to((t >= t[0] + DROPPED) & (t <= t[-1] - DROPPED), recorded.shape)
    kept = kept if counted is None else kept & counted
    count = np.maximum(np.sum(kept, axis=1), 1)
    recorded, predicted = (np.where(kept, smooth(t, x, segments, window), 0.0) for x in (recorded, predicted))
    middle = (np.sum(recorded, axis=1) / count)[:, None]
    spread = np.sqrt(np.sum(np.where(kept, recorded - middle, 0.0) ** 2, axis=1) / count)
    rmse = np.where(kept.any(axis=1), np.sqrt(np.sum((predicted - recorded) ** 2, axis=1) / count), np.nan)
    still = spread <= 1e-12 * np.max(np.abs(recorded), axis=1)  # rounding
    return {"nrmse": np.where(still, np.nan, rmse / np.where(still, 1.0, spread)), "rmse": rmse}


def mean_nrmse(errors: np.ndarray) -> np.ndarray:
    """Mean over the recordings in which a joint moves, (R, n) to (n,); NaN where it never moves."""
    known = np.isfinite(errors)
    return np.where(known.any(axis=0), np.where(known, errors, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1), np.nan)


def evaluate_inverse(model: CalibratedModel, recordings: RecordingSet, window: float = WINDOW) -> Errors:
    """Errors of the signal predicted from the measured motion, in the recorded unit, by file and joint; not where it is cut off."""
    model = model.placed(recordings)
    found = {
        r.file: error(r.t, r.tau, model.predict(r), r.segments, window, counted=~recordings.clipped(r))
        for r in recordings.recordings
    }
    return {file: _by_joint(model.joints, errors) for file, errors in found.items()}


def evaluate_simulated(model: CalibratedModel, recordings: RecordingSet, window: float = WINDOW) -> Errors:
    """Errors of `SIGNALS` while the MuJoCo model tracks the recorded motion, by file, joint and signal [SI]."""
    return errors_simulated(model, recordings, simulated(model, recordings), window)


def simulated(model: CalibratedModel, recordings: RecordingSet) -> dict[str, Simulated]:
    """What the MuJoCo model does while it tracks the recorded motion, or follows recorded commands by its own loop, by file."""
    model = model.placed(recordings)
    control = recorded_controller(model, recordings)
    return {r.file: _followed(model.physics(r), r, control) for r in recordings.recordings}


def _followed(physics: Physics, r: Recording, control: Controller) -> Simulated:
    """A recorded motion in the engine; recorded commands by controllers with the gains of their loop, the model's where it has them."""
    gains = physics.gains(r)
    if gains is None or r.command is None:
        return replay(physics, r, control)
    own = Loop(*gains)
    # k_p q_ref + k_d dq_ref + this is k_p q_d: the engine is told nothing of the recorded motion but where it starts
    command = later(r, r.command, physics.waits)
    return replay(physics, r, replace(control, k_p=own.kp, k_d=own.kd), own.torque(command, r.q, r.dq))


def errors_simulated(
    model: CalibratedModel, recordings: RecordingSet, found: Mapping[str, Simulated], window: float = WINDOW
) -> Errors:
    """Errors of `SIGNALS` of a simulation of the recordings, as `simulated` gives it, by file, joint and signal [SI].

    What recordings of motor torque say of the load torque is the recorded torque less what the model's drives take, and the
    other way round; both at the recorded motion. What the model's sensors add to a torque is taken off what was recorded.
    """
    model, result = model.placed(recordings), {}
    for r in recordings.recordings:
        measured = _measured(model, recordings, r)
        errors = {s: error(r.t, measured[s], getattr(found[r.file], s), r.segments, window) for s in SIGNALS}
        parts = {s: _by_joint(model.joints, of_signal) for s, of_signal in errors.items()}
        result[r.file] = {joint: {s: parts[s][joint] for s in SIGNALS} for joint in model.joints}
    return result


def recorded_controller(model: CalibratedModel, recordings: RecordingSet | None = None) -> Controller:
    """Controllers for a calibrated arm: with the paper's gain for bundled models, which are its arms; no limit below recorded torques."""
    largest = None
    if recordings is not None:
        largest = np.max([np.abs(recordings.output_torque(r)).max(axis=1) for r in recordings.recordings], axis=0)
    return tracking_controller(model.robot, K_P if model.source in BUNDLED else None, largest)


def summary(inverse: Errors, simulated: Errors | None = None) -> dict[str, Any]:
    """What `rrr-oc evaluate` prints: the errors and their means over the recordings, of each joint."""
    ways = {"inverse": inverse, "simulated": simulated or {}}
    return ways | {"mean": {way: _mean(list(errors.values())) for way, errors in ways.items() if errors}}


def write_predictions(model: CalibratedModel, recordings: RecordingSet, folder: str | Path) -> None:
    """One CSV per recording, named as the recording: t and the predicted signal of every joint, at every sample."""
    model = model.placed(recordings)
    tables = {r.file: (r.t, *model.predict(r)) for r in recordings.recordings}
    for file, columns in tables.items():
        names = ("t", *(f"tau_{joint}" for joint in model.joints))
        write_csv(Path(folder) / file, dict(zip(names, columns, strict=True)))


def write_simulated(found: Mapping[str, Simulated], joints: Sequence[str], folder: str | Path) -> None:
    """One CSV per recording, named as the recording: t and `SIGNALS` of every joint, at every sample; NaN where it diverged."""
    for file, motion in found.items():
        columns = {f"{s}_{joint}": row for s in SIGNALS for joint, row in zip(joints, getattr(motion, s), strict=True)}
        write_csv(Path(folder) / file, {"t": motion.t, **columns})


def _measured(model: CalibratedModel, recordings: RecordingSet, recording: Recording) -> dict[str, np.ndarray]:
    physics = model.physics(recording)
    motor, load = physics.arm.torques(recording)
    true = load if recordings.torque == "load" else motor
    left_out = true - model.true_torque(recording, physics)
    more = physics.recorded(recording, true - left_out) - true
    drive, output = motor - load, recordings.output_torque(recording) - more
    torques = (output + drive, output) if recordings.torque == "load" else (output, output - drive)
    return dict(zip(SIGNALS, (recording.q, recording.dq, recording.ddq, *torques), strict=True))


def _by_joint(joints: tuple[str, ...], errors: Mapping[str, np.ndarray]) -> dict[str, dict[str, float | None]]:
    return {joint: {key: number(values[i]) for key, values in errors.items()} for i, joint in enumerate(joints)}


def _mean(parts: list[Any]) -> Any:
    """The mean of numbers that stand in the same place; null where there is none."""
    if isinstance(parts[0], dict):
        return {key: _mean([p[key] for p in parts]) for key in parts[0]}
    known = [p for p in parts if p is not None]
    return float(np.mean(known)) if known else None
