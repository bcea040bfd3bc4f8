"""Recordings as rows of a least-squares problem: filtered residuals of the inverse dynamics and their derivatives.

Derivatives are exact, from the model's expressions, for effects that add a torque of the instant; by differences for effects that
move the links, have internal states or act in the sensors.
"""

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, replace
from weakref import WeakKeyDictionary

import numpy as np

from rrr_oc.calibration.calibrated_model import CalibratedModel
from rrr_oc.calibration.jacobian import Columns, Prediction
from rrr_oc.calibration.samples import Prepared, kept_rows, residuals
from rrr_oc.effects import MovesLink
from rrr_oc.model.recorded_physics import DIFFERENCE, Physics
from rrr_oc.recordings.recording import Recording

START_EFFECT = 1e-3  # of a recording's torque: a smaller effect of a stretch's unknown start is neglected; doubled, no change
# Derivatives by the inertial parameters that `_derivatives` found last, and what they depend on; they last as long as the recording
_REGRESSORS: WeakKeyDictionary[Prepared, tuple[Hashable, np.ndarray]] = WeakKeyDictionary()
ROUNDING = 1e-10  # [Nm]: a parameter (of 1, or of its value if that is more) whose derivatives are all smaller has none


@dataclass(frozen=True)
class Rows:
    """Residuals r = filtered (measured − predicted) and J = filtered d predicted / d parameters, over all recordings.

    Attributes:
        residual: (n, M) [Nm]; 0 where a joint rests.
        jacobian: (n, M, p); 0 where a joint rests.
        moving: Rows that count, (n, M).
    """

    residual: np.ndarray
    jacobian: np.ndarray
    moving: np.ndarray


def rows(
    prepared: Sequence[Prepared], model: CalibratedModel, inertial: bool = False, widths: Sequence[tuple[int, ...]] = ()
) -> Rows:
    """The rows of a model: derivatives by the parameters of its terms in their order.

    Args:
        inertial: Whether derivatives by the inertial parameters (10, n) follow, link by link in the order of `Robot.inertial`.
        widths: Joints of whose friction those by the logarithm of the width over which it changes sign follow.
    """
    parts = [_rows(p, model, inertial, widths) for p in prepared]
    jacobian = np.concatenate([p.jacobian for p in parts], axis=1)
    values = model.values
    sizes = np.maximum(np.abs(np.append(values, np.zeros(jacobian.shape[2] - len(values)))), 1.0)
    largest = np.maximum(jacobian.max(axis=(0, 1), initial=0.0), -jacobian.min(axis=(0, 1), initial=0.0))
    jacobian[:, :, largest * sizes < ROUNDING] = 0.0  # such as by a mass that nothing moves
    return Rows(
        residual=np.concatenate([p.residual for p in parts], axis=1),
        jacobian=jacobian,
        moving=np.concatenate([p.moving for p in parts], axis=1),
    )


def filtered_residuals(prepared: Sequence[Prepared], model: CalibratedModel) -> np.ndarray:
    """The residuals of `rows` alone, (n, M)."""
    return np.concatenate([_filtered_residuals(p, model) for p in prepared], axis=1)


def filtered(prepared: Sequence[Prepared], law: Callable[[Recording], np.ndarray], joints: Sequence[int]) -> np.ndarray:
    """Torques (m, K) of joints (m,), computed from each recording by `law`, filtered, at the rows of `rows`, (m, M)."""
    return np.concatenate([p.passed(law(p.recording), joints) for p in prepared], axis=1)


def _starts(prepared: Prepared, model: CalibratedModel, physics: Physics) -> list[np.ndarray]:
    """Orthonormal bases (kept, m) of what the unknown starts of the stretches may add to the filtered torque of each joint."""
    r, n = prepared.recording, len(prepared.measured)
    found = physics.starts(r, model.torque == "load")
    if not len(found):
        return []
    found = np.array([physics.late(r, one) for one in found])
    passed = prepared.passed(found.reshape(-1, len(r.t)), np.tile(np.arange(n), len(found))).reshape(len(found), n, -1)
    inside = np.zeros((len(kept_rows(r)[1]), passed.shape[2]))
    for row, stretch in zip(inside, kept_rows(r)[1], strict=True):
        row[stretch] = 1.0
    columns = (passed[:, None] * inside[:, None]).reshape(-1, n, passed.shape[2])  # of each start, in one stretch each
    least = START_EFFECT * np.linalg.norm(prepared.passed(prepared.measured, range(n)), axis=1)
    found = [np.linalg.svd(columns[:, j].T, full_matrices=False)[:2] for j in range(n)]
    return [u[:, size > least[j]] for j, (u, size) in enumerate(found)]  # others have died away


def _cleared(rows: np.ndarray, starts: list[np.ndarray]) -> np.ndarray:
    """Rows (n, kept) or (n, kept, p) less their projection on what the starts may add."""
    return np.array([x - basis @ (basis.T @ x) for basis, x in zip(starts, rows, strict=True)]) if starts else rows


def _filtered_residuals(prepared: Prepared, model: CalibratedModel) -> np.ndarray:
    """Filtered residuals at the rows that are kept, (n, kept), without what unknown starts of the stretches may add."""
    physics = model.physics(prepared.recording)
    residual = residuals(prepared, model, physics)
    return _cleared(prepared.passed(residual, range(len(residual))), _starts(prepared, model, physics))


def _rows(prepared: Prepared, model: CalibratedModel, inertial: bool, widths: Sequence[tuple[int, ...]]) -> Rows:
    at = Prediction(model, prepared.recording)
    residual = residuals(prepared, model, at.physics)
    jacobian = _derivatives(prepared, at, inertial)
    if widths:
        jacobian = np.concatenate([jacobian, _filtered(prepared, at, at.by_widths(widths))], axis=2)
    starts = _starts(prepared, model, at.physics)
    cleared = _cleared(prepared.passed(residual, range(len(residual))), starts)
    jacobian = _cleared(jacobian, starts)
    if any(basis.size for basis in starts):
        _with_moved_starts(prepared, model, cleared, jacobian)
    return Rows(residual=cleared, jacobian=jacobian, moving=prepared.counted)


def _with_moved_starts(prepared: Prepared, model: CalibratedModel, residual: np.ndarray, jacobian: np.ndarray) -> None:
    """Put into the Jacobian the derivatives by parameters of elastic gears, by which the shape of unknown starts changes too.

    A residual without what starts explain is a variable projection (Golub & Pereyra 1973), whose derivative has a part that is due to
    the change of the projection; for a gear that swings it is as large as the other.
    """
    at = 0
    for i, term in enumerate(model.terms):
        for k, value in enumerate(term.values):
            if isinstance(term.effect, MovesLink) and term.holds_for(prepared.recording):
                step = DIFFERENCE * max(abs(value), DIFFERENCE)
                there = term.with_values(term.values + step * (np.arange(len(term.values)) == k))
                terms = (*model.terms[:i], there, *model.terms[i + 1 :])
                change = residual - _filtered_residuals(prepared, replace(model, terms=terms))
                jacobian[:, :, at + k] = change / step
        at += len(term.values)


def _derivatives(prepared: Prepared, at: Prediction, inertial: bool) -> np.ndarray:
    """Filtered derivatives at the rows that are kept, (n, kept, p); those by inertial parameters once for as long as they hold."""
    depends_on = at.regressor_depends_on if inertial else None
    if depends_on is None:
        return _filtered(prepared, at, at.nonzero_by_parameters(inertial))
    depends_on = depends_on, coarse(at.physics.delays)
    if _REGRESSORS.get(prepared, (None,))[0] != depends_on:
        _REGRESSORS[prepared] = depends_on, _filtered(prepared, at, at.by_inertial())
    return np.concatenate([_filtered(prepared, at, at.nonzero_by_parameters()), _REGRESSORS[prepared][1]], axis=2)


def _filtered(prepared: Prepared, at: Prediction, found: Columns) -> np.ndarray:
    """Derivatives as `Prepared.passed` filters torques, late as they are recorded, at the rows that are kept, (n, kept, p)."""
    result = np.zeros((len(prepared.measured), prepared.counted.shape[1], found.size))
    for j, (columns, late) in enumerate(zip(result, coarse(at.physics.delays), strict=True)):
        own = found.joints == j
        columns[:, found.numbers[own]] = prepared.filter_of(j, late) @ found.values[:, own] * prepared.counted[j][:, None]
    return result


def coarse(delays: Sequence[float]) -> tuple[float, ...]:
    """Delays to a millisecond: so late are derivatives; what is predicted is late by the exact ones."""
    return tuple(np.round(delays, 3).tolist())
