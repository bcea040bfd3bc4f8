"""Gains of a loop that nobody knows: what its commands must be times so that they hold and move the arm of the robot's file."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from rrr_oc.errors import UserError
from rrr_oc.recordings.comparison import Comparison, Reading, Samples
from rrr_oc.recordings.header import Loop
from rrr_oc.recordings.recording import RecordingSet


def with_gains(file: Path, recordings: RecordingSet) -> RecordingSet:
    """The set with a number in the place of each kp that is not known (NaN), from all recordings without it.

    The loop's error q_d − q times kp is the torque of the arm, its friction and its rotor. Friction and rotor are estimated with it, so
    that the masses of the robot's file are what tells kp.

    Raises `UserError` where no masses are known, and for a joint whose load hardly changes.
    """
    unknown = np.array([np.zeros(0) if r.loop is None else np.isnan(r.loop.kp) for r in recordings.recordings])
    if not unknown.any():
        return recordings
    joints = [joint for j, joint in enumerate(recordings.joints) if unknown[:, j].any()]
    if recordings.inertial == "identify":
        raise UserError(
            f"{file}: kp of {', '.join(joints)} is not known, and the masses are not either (inertial 'identify'); recordings tell their "
            "ratio alone, and one of the two is required"
        )
    kp = np.full(len(recordings.joints), np.nan)
    for j in np.flatnonzero(unknown.any(axis=0)):
        some = [r for r, without in zip(recordings.recordings, unknown, strict=True) if without[j]]
        ones = [Loop(np.ones_like(r.loop.kp), np.zeros_like(r.loop.kd)) for r in some if r.loop is not None]
        trial = tuple(replace(r, loop=loop) for r, loop in zip(some, ones, strict=True))
        comparison = Comparison(Samples.of(replace(recordings, recordings=trial)))
        kp[j] = 1 / comparison.factors(Reading.as_given(len(kp)))[j]
    found = [joint for joint, one in zip(recordings.joints, kp, strict=True) if joint in joints and not np.isfinite(one)]
    if found:
        raise UserError(
            f"{file}: kp of {', '.join(found)} is not known, and cannot be told: by the masses of the robot's file its load hardly changes, or "
            "does not explain the commands; a kp, or recordings in which gravity or a known payload loads it, are required"
        )
    changed = []
    for r, without in zip(recordings.recordings, unknown, strict=True):
        assert r.loop is not None
        assert r.command is not None
        loop = Loop(np.where(without, kp, r.loop.kp), r.loop.kd)
        changed.append(replace(r, loop=loop, tau=loop.torque(r.command, r.q, r.dq)))
    estimated = {joint: float(one) for joint, one in zip(recordings.joints, kp, strict=True) if np.isfinite(one)}
    return replace(recordings, recordings=tuple(changed), estimated_kp=estimated)
