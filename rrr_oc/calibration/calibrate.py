"""Calibration of a recording set: the parameters of the plain model, and of the links, by the estimator of the diagnosis.

A calibration is a diagnosis with an empty catalogue: the same data, noise, discrepancy, priors and Gauss–Newton (`docs/discovery.md`,
sections 1 to 3). Where a set says "nominal", links have the errors that URDFs usually have, of a common size that is estimated. Where it
says "identify", they have the wide prior of `inertial_parameters.prior` in log-Cholesky coordinates of the pseudo-inertias (Rucker &
Wensing 2022), so that they stay physically consistent whatever the recordings leave open.
"""

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from msgspec.structs import replace as told_with

from rrr_oc.calibration.calibrated_model import CalibratedModel
from rrr_oc.calibration.clocks import clock_lags, errors_of, on_one_clock
from rrr_oc.calibration.estimator.data import Data
from rrr_oc.calibration.estimator.fitting import Fitted, PlainFitter
from rrr_oc.calibration.estimator.intervals import described, fit_report
from rrr_oc.calibration.estimator.knobs import CENTRE_ERROR, INERTIA_ERROR, MASS_ERROR
from rrr_oc.calibration.inverse_dynamics import finished, plain_model
from rrr_oc.calibration.link_findings import entries, fall_against, in_directions, link_findings, with_falls
from rrr_oc.calibration.samples import Prepared, pieces_of, prepare, shortened, thinned, without_spikes
from rrr_oc.errors import UserError
from rrr_oc.recordings.recording import RecordingSet
from rrr_oc.robot.inertial_parameters import prior
from rrr_oc.robot.link_errors import LinkErrors, most_of

LEAST_ROWS = 10  # with which an estimate is tried
POOR = 0.05  # of a joint's torque, the error from which links of which nothing is known are tried in the place of the URDF's
FAR_BETTER = 0.3  # share by which these must lower the error of a joint on data left out; doubled, "identify" is proposed less


def calibrate(recordings: RecordingSet) -> CalibratedModel:
    """The plain model, calibrated on inverse dynamics.

    Raises:
        UserError: The recordings are too short for the filter.
    """
    return fit(recordings, plain_model(recordings))


def fit(recordings: RecordingSet, nominal: CalibratedModel) -> CalibratedModel:
    """All parameters of a model's terms and the errors of its links, from the values that they have."""
    began = time.perf_counter()
    model, lags = first_estimate(recordings, prepare(recordings), nominal)
    recordings = on_one_clock(recordings, lags)
    whole = prepare(recordings)
    clean = without_spikes(whole, model)
    fitter = PlainFitter.of(data_of(recordings, clean, nominal, model))
    found = fitter.closest(fitter.begin(nominal))
    far_off = {"link_findings": entries(with_falls(fitter, found, link_findings(found)))}
    report = {"way": "inverse dynamics"} | fit_report(found, clean) | far_off | if_identified(recordings, clean, fitter, found)
    return finished(recordings, whole, described(found), report, began)


def if_identified(recordings: RecordingSet, prepared: Sequence[Prepared], fitter: PlainFitter, found: Fitted) -> dict[str, Any]:
    """What links of which nothing is known explain beyond those of a URDF on data left out, and how they differ; nothing if not far more."""
    poor = np.sqrt(np.mean(found.residual**2, axis=1)) > POOR * fitter.data.torque
    if not (fitter.data.free and np.any(poor)):
        return {}
    unknown = replace(recordings, inertial="identify")
    nominal = plain_model(unknown)
    other = PlainFitter.of(data_of(unknown, prepared, nominal, fitter.data.start))
    identified = other.closest(other.begin(nominal))
    fall = fall_against(identified, found)
    if fall is None or fall.interval is None or fall.interval[0] < FAR_BETTER:
        return {}
    return {"if_identified": entries([told_with(f, lowers_error=fall) for f in in_directions(identified, fitter.data.links)])}


def first_estimate(
    recordings: RecordingSet, whole: Sequence[Prepared], nominal: CalibratedModel, exact: bool = False
) -> tuple[CalibratedModel, np.ndarray]:
    """A model fitted about a nominal one to a part of the recordings, from which spikes and the size of a discrepancy can be judged, and
    the lags of torques that have clocks of their own (R, 2) [s], without which it is fitted.

    Args:
        exact: Whether the links of a URDF are known exactly.
    """
    fitter, fitted = _of_some(recordings, whole, nominal, exact)
    begun = fitter.least_squares(fitted).model
    lags = clock_lags(whole, begun)
    while lags.any():
        again = on_one_clock(recordings, lags)
        undone = prepare(again)
        fitter, other = _of_some(again, undone, nominal, exact)
        after, before = errors_of(undone, fitter.least_squares(other).model), errors_of(whole, begun)
        # clocks are set in each recording, and drift apart alike in all
        kept = lags * np.array([after < before, np.full(len(after), after.sum() < before.sum())]).T
        if np.array_equal(kept, lags):
            return other.model, lags
        lags = kept
    return fitted.model, lags


def _of_some(
    recordings: RecordingSet, whole: Sequence[Prepared], nominal: CalibratedModel, exact: bool
) -> tuple[PlainFitter, Fitted]:
    """A fit to a part of the recordings."""
    fitter = PlainFitter.of(data_of(recordings, shortened(whole), nominal, nominal, exact))
    levels = fitter.fit(nominal, fitter.data.links.none)  # of friction, before which nothing is known of how it changes sign
    return fitter, fitter.with_signs(fitter.fit(levels.model, levels.links, levels.posterior))


def data_of(
    recordings: RecordingSet,
    prepared: Sequence[Prepared],
    nominal: CalibratedModel,
    about: CalibratedModel,
    exact: bool = False,
) -> Data:
    """Recordings ready for an estimate, thinned and an only one in pieces, with the errors of the links of a nominal model.

    Args:
        about: The model that the discrepancy refers to.
        exact: Whether the links of a URDF are known exactly.

    Raises:
        UserError: Fewer than `LEAST_ROWS` rows are left.
    """
    count = sum(p.counted.shape[1] for p in prepared)
    if count < LEAST_ROWS:
        raise UserError(f"{recordings.path}: {count} rows are left after the filter; pieces of 0.5 s and more are needed")
    bench, unknown = thinned(prepared), recordings.inertial == "identify"
    of_urdf = () if exact else (MASS_ERROR, *[CENTRE_ERROR] * 3, *[INERTIA_ERROR] * 3)
    std = prior(nominal.robot).std if unknown else np.tile(of_urdf, recordings.robot.n)
    most = most_of(nominal.robot, len(std) // recordings.robot.n)
    links = LinkErrors(nominal.robot.inertial, std, most)
    return Data(pieces_of(bench[0]) if len(bench) == 1 else bench, about, links, not unknown)
