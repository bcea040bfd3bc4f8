"""The chain of measurement of recordings: how late their torques and speeds are, and from which columns speeds come."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.stats import norm

from rrr_oc.calibration.calibrated_model import CalibratedModel, Estimate, Term
from rrr_oc.calibration.estimator.evidence import NoiseStart
from rrr_oc.calibration.estimator.fitting import Fitted, PlainFitter, is_held
from rrr_oc.calibration.estimator.intervals import covariance
from rrr_oc.calibration.estimator.knobs import CLOCK_ERROR
from rrr_oc.calibration.estimator.left_out import Fall, surest_fall
from rrr_oc.calibration.link_findings import QUANTILE
from rrr_oc.effects import CATALOGUE, Delay
from rrr_oc.recordings.recording import RecordingSet

HELD = 1e-9  # [s] within which a delay is held at 0


def measurement(recordings: RecordingSet, model: CalibratedModel) -> dict[str, dict[str, Any]]:
    """By joint: how late its torque and its recorded speed are [s], with a 95 % interval of the former; null where it is not known."""
    result = {}
    for j, joint in enumerate(model.joints):
        late = next((t.estimates[0] for t in model.terms if is_held(t.effect) and t.effect.joints == (j,)), None)
        speeds = [rate for r in recordings.recordings for rate in r.rates if rate.column == f"dq_{joint}"]
        used = [f"dq_{joint}" not in r.computed for r in recordings.recordings]
        result[joint] = {
            "torque_late_s": None if late is None else late.value,
            "interval": None if late is None or late.interval is None else list(late.interval),
            "speed_late_s": float(np.mean([rate.late for rate in speeds])) if speeds else None,
            "speed_times": float(np.mean([rate.times for rate in speeds])) if speeds else None,
            "used": "dq" if all(used) else "q" if not any(used) else "q and dq",
        }
    return result


def common_delay(fitter: PlainFitter, fitted: Fitted) -> tuple[Term, Fall, float] | None:
    """A delay that the torques of all joints have in common and that is longer than usual; None where there is none.

    Returns:
        The term, the fall of the error on the joint where it is surest against torques that are not late, and the p-value.
    """
    terms = fitted.model.terms
    late = [i for i, t in enumerate(terms) if is_held(t.effect)]
    if not late:
        return None
    at, values = [fitted.model.offsets[i] for i in late], np.array([terms[i].values[0] for i in late])
    spread = covariance(fitted)[np.ix_(at, at)] + CLOCK_ERROR**2 / 9 * np.eye(len(at))  # joints differ by a millisecond
    weights = np.linalg.solve(spread, np.ones(len(at)))
    mean, std = float(weights @ values / weights.sum()), float(weights.sum() ** -0.5)
    apart = np.abs(values - mean) > QUANTILE * np.sqrt(np.diag(spread)) + CLOCK_ERROR
    if mean - QUANTILE * std < CLOCK_ERROR or apart.any():
        return None
    size = surest_fall(fitted.posterior, _prompt(fitter, fitted, at).posterior)
    interval = mean - QUANTILE * std, mean + QUANTILE * std
    kind = next(k for k in CATALOGUE.values() if issubclass(k, Delay) and k.placement == "arm")
    return None if size is None else (Term(kind(()), (Estimate(mean, std, interval),)), size, float(2 * norm.sf(mean / std)))


def _prompt(fitter: PlainFitter, fitted: Fitted, at: Sequence[int] | np.ndarray) -> Fitted:
    """The same fit with torques that are not late; `at` are the numbers of the delays among the parameters."""
    model, post = fitted.model, fitted.posterior
    held = np.where(np.isin(np.arange(len(fitter.plain_std)), at), HELD, fitter.plain_std)
    terms = tuple(t.with_values(0 * t.values) if is_held(t.effect) else t for t in model.terms)
    start = NoiseStart(post.hyper, post.joints)
    return replace(fitter, plain_std=held).fit(replace(model, terms=terms), fitted.links, start, fixed=True)
