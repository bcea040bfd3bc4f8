"""The plain model of inverse dynamics: what a calibration starts from, and what is said of it at the end.

The plain model has the effects of the role "plain" in every joint: dry friction, viscous friction, armature, and a lag of the torque.
"""

import platform
import time
from collections.abc import Sequence
from dataclasses import replace
from importlib.metadata import version
from typing import Any

import numpy as np

from rrr_oc import __version__
from rrr_oc.calibration.calibrated_model import CalibratedModel, nominal_term
from rrr_oc.calibration.clocks import said_of_clocks
from rrr_oc.calibration.measurement import measurement
from rrr_oc.calibration.prediction_error import error, mean_nrmse
from rrr_oc.calibration.samples import Prepared, noise
from rrr_oc.effects import CATALOGUE, LoopChange, plain_effects
from rrr_oc.recordings.recording import RecordingSet
from rrr_oc.robot.inertial_parameters import links_from_log_cholesky, prior
from rrr_oc.robot.robot import BUNDLED, urdf_text
from rrr_oc.robot.urdf import posed

PACKAGES = ("casadi", "mujoco", "numpy", "pin", "scipy")


def plain_model(recordings: RecordingSet) -> CalibratedModel:
    """The model that calibration starts from, its parameters at their nominal 0.

    Links that are to be identified start from the bodies of the prior, since a URDF may give them no mass.
    """
    robot, n = recordings.robot, recordings.robot.n
    if recordings.inertial == "identify":
        robot = replace(robot, inertial=links_from_log_cholesky(prior(robot).centre)[0])
    effects = [kind((j,)) for j in range(n) for kind in plain_effects(recordings.torque)]
    changes = [kind for kind in CATALOGUE.values() if issubclass(kind, LoopChange)]  # of gains that are estimates
    effects += [kind((recordings.joints.index(joint),)) for joint in recordings.estimated_kp for kind in changes]
    return CalibratedModel(
        robot=robot,
        source=str(recordings.source) if str(recordings.source) in BUNDLED else "urdf",
        urdf=posed(urdf_text(recordings.source), robot.held),
        tool=recordings.tool,
        torque=recordings.torque,
        torque_constant=recordings.torque_constant,
        inertial=recordings.inertial,
        terms=tuple(map(nominal_term, sorted(effects, key=lambda effect: effect.side == "sensor"))),
        noise=np.full(n, np.nan),
        nrmse=np.full(n, np.nan),
        versions={"rrr_oc": __version__, "python": platform.python_version()} | {p: version(p) for p in PACKAGES},
    )


def finished(
    recordings: RecordingSet, prepared: Sequence[Prepared], model: CalibratedModel, report: dict[str, Any], began: float
) -> CalibratedModel:
    """The model with its noise, its NRMSE on the recordings calibrated on, and a report; `began` as of `time.perf_counter`."""
    errors = [
        error(r.t, recordings.output_torque(r), model.predicted_torque(r), r.segments, counted=~recordings.clipped(r))["nrmse"]
        for r in recordings.recordings
    ]
    more = {"wall_s": time.perf_counter() - began, "recordings": [r.file for r in recordings.recordings]}
    more |= {"measurement": measurement(recordings, model), "clocks": said_of_clocks(recordings)}
    return replace(model, noise=noise(prepared, model), nrmse=mean_nrmse(np.array(errors)), report=report | more)
