"""The libraries of terms among which peers look for what a calibrated model lacks.

Two of them, so that a peer is seen both as its documentation teaches it and with all that this project knows:

- `textbook`: functions of a joint's own position, speed, load and time, and of its neighbours, one regression for each joint;
- `signatures`: the linearised torques that the diagnosis itself compares, of all joints in one regression.

The parameters of the plain model stay free: what its dry friction, viscous friction and armature can take up is taken out of every
term (Frisch & Waugh, Econometrica 1, 1933), so that a term's weight is what it adds to the plain model.

Rows are the samples that the diagnosis prepared: spikes removed, no rests, speeds and accelerations from short windows.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from rrr_oc.calibration.calibrated_model import CalibratedModel
from rrr_oc.calibration.estimator.data import Data
from rrr_oc.calibration.jacobian import Prediction
from rrr_oc.calibration.samples import noise, prepare, residuals
from rrr_oc.diagnosis.procedure import ready
from rrr_oc.diagnosis.signatures import table
from rrr_oc.effects import Trial
from rrr_oc.effects.priors import Priors
from rrr_oc.recordings.recording import Recording, RecordingSet

EVERY = 4  # of the prepared samples, 12 ms apart, one is a row of a textbook regression; half as many rows hide faint effects
SIGN = 0.05  # speed over which dry friction changes sign [rad/s], as the plain model has it
WAVES, ROUGH_WAVES = 24, 4  # cycles a turn of torques, and of dry friction, that are periodic in a joint's position
SPEEDS, TIMES = (0.1, 0.2, 0.3), (0.2, 0.4)  # shares of the largest speed and of the duration at which friction falls
HINGES = (0.2, 0.4, 0.6, 0.8)  # quantiles of the position at which a one-sided spring may begin
RIPPLES = 3  # orders of ripple that a screen keeps for a joint; of any other effect it keeps the best shape
SPRINGS = ("cable_harness", "parallel_spring", "spring_stiffness", "spring_preload")
GRAVITY = ("payload_mass", "payload_com", "link_inertial", "gravity_tilt", "encoder_offset")
# Which effects a term of the textbook means. A claim is right if any of them is, so that no peer loses by a name.
MEANS: dict[str, tuple[str, ...]] = {
    "1": ("torque_offset", "coulomb_asymmetry"),
    "q": SPRINGS,
    "hinge": ("parallel_spring", "spring_stiffness", "spring_preload"),
    "drag": ("quadratic_drag",),
    "load": ("torque_gain",),
    "load sign": ("load_dependent_friction", "spring_hysteresis"),
    "slow sign": ("stribeck",),
    "early sign": ("friction_drift",),
    "gravity": GRAVITY,
    "wave": ("torque_ripple",),
    "wave sign": ("position_dependent_friction",),
    "load rate": ("time_delay", "joint_elasticity"),
    "payload": ("payload_mass", "payload_com"),
    "other q": ("biarticular_spring",),
    "other speed": ("coupled_friction",),
}


@dataclass(frozen=True)
class Meaning:
    """What a column stands for: the names of effects, any of which it may be, and the joint or joints by name; None for the arm."""

    effects: tuple[str, ...]
    joint: Any


@dataclass(frozen=True)
class Problem:
    """A regression of what the plain model leaves.

    Attributes:
        x: Of each recording the terms (K, C), in standard deviations of the noise.
        y: Of each recording what is left (K,), in the same unit.
        meanings: What each group of columns stands for.
        group: Group of each column, (C,).
        screen: Which columns take part, from the numbers of the recordings that are seen.
        predict: For a recording and coefficients (C,) the torque at all samples [Nm], (n, K).
    """

    x: list[np.ndarray]
    y: list[np.ndarray]
    meanings: list[Meaning]
    group: np.ndarray
    screen: Callable[[Sequence[int] | np.ndarray], np.ndarray]
    predict: Callable[[Recording, np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Plain:
    """A recording set with its calibrated plain model.

    Attributes:
        recordings: The set.
        model: The plain model.
        data: The prepared recordings.
        trials: All ways in which effects of the catalogue might be missing.
        noise: Standard deviation of each joint's recorded torque's noise [Nm], (n,).
    """

    recordings: RecordingSet
    model: CalibratedModel
    data: Data
    trials: tuple[Trial, ...]
    noise: np.ndarray

    @classmethod
    def of(cls, recordings: RecordingSet) -> "Plain":
        """Calibrate; raises `UserError` for recordings too short for the filters."""
        whole, fitter, trials, model = ready(recordings, Priors())
        return cls(recordings, model, fitter.data, trials, np.maximum(noise(whole, model), 1e-9))


# --- terms of a textbook ---


def textbook(plain: Plain) -> list[Problem]:
    """One regression for each joint."""
    left = [residuals(p, plain.model) for p in plain.data.prepared]
    return [_of_joint(plain, j, left) for j in range(plain.data.n)]


def _of_joint(plain: Plain, j: int, left: Sequence[np.ndarray]) -> Problem:
    seen = [p.recording for p in plain.data.prepared]
    scale = _Scale.of(seen, j)
    rows = [np.flatnonzero(p.moving[j])[::EVERY] for p in plain.data.prepared]
    names = list(_terms(plain.model, seen[0], j, scale))
    x = [np.array(list(_terms(plain.model, r, j, scale).values()))[:, k].T for r, k in zip(seen, rows, strict=True)]
    own = [_plain_terms(r, j)[:, k].T for r, k in zip(seen, rows, strict=True)]
    y = [part[j, k] / plain.noise[j] for part, k in zip(left, rows, strict=True)]
    shares = np.linalg.lstsq(np.concatenate(own), np.concatenate(x), rcond=None)[0]
    kinds = list(dict.fromkeys(name[:-1] for name in names))
    joints = plain.recordings.joints

    def predict(recording: Recording, coefficients: np.ndarray) -> np.ndarray:
        result = np.zeros_like(recording.q)
        result[j] = coefficients @ np.array(list(_terms(plain.model, recording, j, scale).values()))
        result[j] -= (shares @ coefficients) @ _plain_terms(recording, j)
        return result

    every = np.arange(len(names))
    return Problem(
        [(a - b @ shares) / plain.noise[j] for a, b in zip(x, own, strict=True)],
        y,
        [Meaning(MEANS[kind], joints[j] if other < 0 else [joints[j], joints[other]]) for kind, _, other in kinds],
        np.array([kinds.index(name[:-1]) for name in names]),
        lambda _: every,
        predict,
    )


def _plain_terms(r: Recording, j: int) -> np.ndarray:
    """Dry friction, viscous friction and armature of joint j, each of size 1, (3, K)."""
    return np.array([np.tanh(r.dq[j] / SIGN), r.dq[j], r.ddq[j]])


@dataclass(frozen=True)
class _Scale:
    """What the terms of a joint refer to: its largest speed [rad/s], the longest duration [s], positions of hinges [rad]."""

    speed: float
    duration: float
    hinges: tuple[float, ...]

    @classmethod
    def of(cls, seen: Sequence[Recording], j: int) -> "_Scale":
        q, dq = (np.concatenate([getattr(r, name)[j] for r in seen]) for name in ("q", "dq"))
        duration = max(float(np.ptp(r.t)) for r in seen)
        return cls(float(np.quantile(np.abs(dq), 0.99)), duration, tuple(np.quantile(q, HINGES).tolist()))


def _terms(model: CalibratedModel, r: Recording, j: int, scale: _Scale) -> dict[tuple[str, int, int, int], np.ndarray]:
    """Terms of joint j at all samples, by kind, number (of an order or place), other joint (or −1), and part; (K,) each."""
    q, dq, t = r.q[j], r.dq[j], r.clock
    load = model.torques(r)[1][j]
    sign = np.tanh(dq / SIGN)
    found = {
        ("1", 0, -1, 0): np.ones_like(q),
        ("q", 0, -1, 0): q,
        ("drag", 0, -1, 0): dq * np.abs(dq),
        ("load", 0, -1, 0): load,
        ("load sign", 0, -1, 0): np.abs(load) * sign,
        ("load rate", 0, -1, 0): np.gradient(load, r.t),
    }
    found |= {("slow sign", 0, -1, k): np.exp(-((dq / (s * scale.speed)) ** 2)) * sign for k, s in enumerate(SPEEDS)}
    found |= {("early sign", 0, -1, k): np.exp(-t / (s * scale.duration)) * sign for k, s in enumerate(TIMES)}
    for k, at in enumerate(scale.hinges):
        found |= {("hinge", k, -1, 0): np.maximum(at - q, 0.0), ("hinge", k, -1, 1): np.maximum(q - at, 0.0)}
    for k in range(1, WAVES + 1):
        waves = np.sin(k * q), np.cos(k * q)
        found |= {("gravity" if k == 1 else "wave", k, -1, part): wave for part, wave in enumerate(waves)}
        if k <= ROUGH_WAVES:
            found |= {("wave sign", k, -1, part): wave * sign for part, wave in enumerate(waves)}
    found |= {("payload", 0, -1, k): r.payload * wave for k, wave in enumerate((np.ones_like(q), np.sin(q), np.cos(q)))}
    for i in (j - 1, j + 1):
        if 0 <= i < len(r.q):
            rate = dq + r.dq[i]
            found |= {
                ("other q", 0, i, 0): r.q[i],
                ("other speed", 0, i, 0): np.tanh(rate / SIGN),
                ("other speed", 0, i, 1): rate,
            }
    return found


# --- the diagnosis's own signatures ---


def signatures(plain: Plain) -> Problem:
    """One regression for all joints, whose columns are those of all trials, with the plain parameters' share taken out."""
    data, model, n = plain.data, plain.model, plain.data.n
    found, own = table(data.prepared, model, plain.trials), data.rows(model)
    count = np.maximum(own.moving.sum(axis=1), 1)
    size = np.maximum(np.sqrt(np.sum(own.residual**2, axis=1) / count), 1e-9)  # root mean square of each joint, (n,)
    plain_columns = np.concatenate([own.jacobian[j, :, : len(model.values)] / size[j] for j in range(n)])
    basis, triangle = np.linalg.qr(plain_columns)
    columns = np.zeros((n, len(data.at), found.start[-1]))
    for j in range(n):
        columns[j][:, found.used[j]] = found.values[j][data.at] / size[j]
    flat = columns.reshape(n * len(data.at), -1)
    along = basis.T @ flat
    flat -= basis @ along
    shares = np.linalg.pinv(triangle) @ along  # of the plain parameters, (p, C)
    y = own.residual / size[:, None]
    stretches = [slice(a, b) for a, b in pairwise(data.edges)]
    x = [columns[:, s].reshape(-1, flat.shape[1]) for s in stretches]
    left = [y[:, s].reshape(-1) for s in stretches]
    places = [(t.effect.name, t.effect.joints) for t in plain.trials]
    kinds = list(dict.fromkeys(places))
    group = np.repeat([kinds.index(place) for place in places], [len(t.points) for t in plain.trials])
    return Problem(
        x,
        left,
        [Meaning((name,), _named(plain, joints)) for name, joints in kinds],
        group,
        _Screen.of(x, left, found.start, places).columns,
        lambda recording, coefficients: _by_trials(plain, shares, found.start, recording, coefficients),
    )


def _named(plain: Plain, joints: tuple[int, ...]) -> Any:
    names = [plain.recordings.joints[j] for j in joints]
    return None if not names else names[0] if len(names) == 1 else names


@dataclass(frozen=True)
class _Screen:
    """Sure independence screening (Fan & Lv, J. R. Statist. Soc. B 70, 2008): of each effect's shapes the one that explains most.

    Attributes:
        grams, moments: Of each recording and trial XᵀX (m, m) and Xᵀy (m,).
        start: First column of each trial.
        places: Effect and joints of each trial.
    """

    grams: list[list[np.ndarray]]
    moments: list[list[np.ndarray]]
    start: np.ndarray
    places: list[tuple[str, tuple[int, ...]]]

    @classmethod
    def of(cls, x: Sequence[np.ndarray], y: Sequence[np.ndarray], start: np.ndarray, places: list) -> "_Screen":
        parts = [slice(a, b) for a, b in pairwise(start)]
        grams = [[part[:, s].T @ part[:, s] for s in parts] for part in x]
        return cls(grams, [[part[:, s].T @ left for s in parts] for part, left in zip(x, y, strict=True)], start, places)

    def columns(self, seen: Sequence[int] | np.ndarray) -> np.ndarray:
        """Numbers of the columns that are kept, from these recordings."""
        by_place: dict[tuple, list[tuple[float, int]]] = {}
        for k, place in enumerate(self.places):
            gram, moment = sum(self.grams[r][k] for r in seen), sum(self.moments[r][k] for r in seen)
            gain = float(moment @ np.linalg.lstsq(gram, moment, rcond=1e-9)[0])
            by_place.setdefault(place, []).append((gain, k))
        kept = []
        for (name, _), found in by_place.items():
            best = sorted(found, reverse=True)[: RIPPLES if name == "torque_ripple" else 1]
            kept += [np.arange(self.start[k], self.start[k + 1]) for gain, k in best if gain > 0]
        return np.sort(np.concatenate([*kept, np.zeros(0, int)])).astype(int)


def _by_trials(
    plain: Plain, shares: np.ndarray, start: np.ndarray, recording: Recording, coefficients: np.ndarray
) -> np.ndarray:
    at, used = Prediction(plain.model, recording), np.flatnonzero(coefficients)
    result = np.zeros_like(recording.q)
    for k in np.unique(np.searchsorted(start, used, side="right") - 1).tolist():
        changes = [at.physics.late(recording, change) for change in at.before_sensors(plain.trials[k])]
        result += np.tensordot(coefficients[start[k] : start[k + 1]], np.array(changes), 1)
    if len(used):
        result -= at.by_parameters() @ (shares @ coefficients)
    return result


# --- inputs of regressions without terms ---


def raw_inputs(r: Recording, model: CalibratedModel, names: Sequence[str]) -> tuple[np.ndarray, list[tuple[str, Any]]]:
    """Position, speed, acceleration and load of all joints, payload and time, (K, inputs), with what each is."""
    load = model.torques(r)[1]
    labels = [(kind, name) for kind in ("q", "dq", "ddq", "load") for name in names]
    return np.vstack([r.q, r.dq, r.ddq, load, r.payload, r.clock]).T, [*labels, ("payload", None), ("time", None)]


# What an input of the trees that matters most stands for, if it is the joint's own; classes of effects, far wider than a term's.
INPUTS: dict[str, tuple[str, ...]] = {
    "q": (*SPRINGS, *GRAVITY, "torque_ripple", "position_dependent_friction", "backlash"),
    "dq": ("stribeck", "quadratic_drag", "coulomb_asymmetry", "torque_offset", "presliding_hysteresis"),
    "ddq": ("link_inertial", "time_delay", "joint_elasticity", "payload_mass"),
    "load": (
        "load_dependent_friction",
        "torque_gain",
        "joint_elasticity",
        "spring_hysteresis",
        "spring_stiffness",
        "time_delay",
    ),
    "payload": ("payload_mass", "payload_com"),
    "time": ("friction_drift",),
}
OTHERS = ("coupled_friction", "biarticular_spring")  # what an input of another joint stands for


def prepared_unseen(recordings: RecordingSet) -> list[Recording]:
    """Recordings with speeds and accelerations as those have that the terms were fitted to, at all samples."""
    return [p.recording for p in prepare(recordings)]
