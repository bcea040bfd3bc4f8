"""Calibration of a recording set: the parameters of the plain model estimated from the recordings."""

from collections.abc import Sequence

from rrr_oc.calibration.calibrated_model import CalibratedModel
from rrr_oc.calibration.friction_width import with_widths
from rrr_oc.calibration.inertial_identification import identify
from rrr_oc.calibration.inverse_dynamics import Fit, fit_terms, plain_model
from rrr_oc.calibration.samples import Prepared, prepare
from rrr_oc.recordings.recording import RecordingSet


def calibrate(recordings: RecordingSet) -> CalibratedModel:
    """The plain model, calibrated on inverse dynamics.

    Raises:
        UserError: The recordings are too short for the filter.
    """
    prepared = prepare(recordings)
    return fit(recordings, prepared, with_widths(prepared, plain_model(recordings))).model


def fit(recordings: RecordingSet, prepared: Sequence[Prepared], start: CalibratedModel) -> Fit:
    """A model fitted to the recordings; inertial parameters are estimated too where the set says "identify"."""
    return (identify if recordings.inertial == "identify" else fit_terms)(recordings, prepared, start)
