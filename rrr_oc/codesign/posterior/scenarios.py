"""Members of a posterior as the scenarios of a design, so that the search minimises the mean or the worst of their costs."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from rrr_oc.calibration.calibrated_model import CalibratedModel
from rrr_oc.codesign.design_problem import CoDesign, Scenario
from rrr_oc.codesign.posterior.members import Member, moved
from rrr_oc.codesign.springs import SpringBounds, each
from rrr_oc.codesign.transfer import repaired

Over = Literal["calibrated", "mean", "worst"]
DIRECTIONS = 2  # of what is not known that the search reckons with; doubled, a solve takes almost twice as long
MOST = 4  # other models that the search reckons with, those whose holding torques differ most; doubled, likewise
# [1] standard deviations to both sides along each: for the worst the ends of 95 %, for the mean so that all members have the variance
REACH = {"worst": 1.96, "mean": float(np.sqrt(DIRECTIONS + 0.5))}


def over_members(design: CoDesign, every: Sequence[Member], over: Over) -> CoDesign:
    """The design on the calibrated arm, with members of its posterior as scenarios if the search is over their "mean" or "worst" cost.

    These are the calibrated model, the other models, and the calibrated one changed along the directions of its covariance that change
    the torques most by which the arm is held at the task's ends.

    Args:
        design: Of the task as it was asked for, without effects of the arm.
    """
    first = every[0].model
    if over == "calibrated":
        return repaired(design, first, ("", ""))
    usual = _holding(design, first)
    others = [m for m in every[1:] if all(t.recordings == "all" for t in m.model.terms)]
    others = sorted(others, key=lambda m: -float(np.linalg.norm(_holding(design, m.model) - usual)))[:MOST]
    said = [(m.says, m.model) for m in (every[0], *others)] + _along_directions(design, first, REACH[over], usual)
    arms = [(says, repaired(design, model, ("", ""))) for says, model in said]
    known = _all_known([arm for _, arm in arms])
    whole = replace(arms[0][1], springs=(*design.springs, *known))
    return replace(whole, scenarios=tuple(_scenario(says, arm, whole) for says, arm in arms), over=over)


def _along_directions(
    design: CoDesign, model: CalibratedModel, reach: float, usual: np.ndarray
) -> list[tuple[str, CalibratedModel]]:
    """The model changed to both sides along the directions of its covariance that change its holding torques most."""
    if model.spread is None:
        return []
    slopes = np.array([_holding(design, moved(model, column)) - usual for column in model.spread.T])
    directions = np.linalg.svd(slopes.T, full_matrices=False)[2][:DIRECTIONS]
    return [
        (
            f"changed along direction {k} of what is not known, to the {side} side",
            moved(model, sign * reach * model.spread @ way),
        )
        for k, way in enumerate(directions, 1)
        for sign, side in ((-1, "one"), (1, "other"))
    ]


def _holding(design: CoDesign, model: CalibratedModel) -> np.ndarray:
    """Torques by which the moving joints are held at both ends of the task, with the payload and without, without the design's springs
    (4 m,) [Nm]."""
    there = repaired(replace(design, springs=()), model, ("", ""))
    rest, ends = np.zeros(len(there.task.moving)), (there.task.start, there.task.release)
    known, widths = there.known_parameters, there.model.widths
    held = [there.torques(end, rest, rest, payload, known, widths)[0] for end in ends for payload in there.task.payloads]
    return np.concatenate([np.array(torque).ravel() for torque in held])


def _all_known(arms: Sequence[CoDesign]) -> tuple[SpringBounds, ...]:
    """The known effects of all arms, each once: as the first has them, those that it lacks without amplitude."""
    result = [s for s in arms[0].springs if s.known]
    for arm in arms[1:]:
        for spring in arm.springs:
            if spring.known and spring.effect not in [s.effect for s in result]:
                result.append(_absent(spring))
    return tuple(result)


def _absent(spring: SpringBounds) -> SpringBounds:
    """A known effect without amplitude."""
    off = np.array([p.name in spring.effect.amplitudes for p in spring.effect.parameters])
    values = np.where(off, 0.0, spring.lower)
    return SpringBounds(spring.effect, values, values, known=True)


def _scenario(says: str, arm: CoDesign, whole: CoDesign) -> Scenario:
    """An arm as a scenario of the design that has the effects of all."""
    own, theta = {s.effect: s for s in arm.springs if s.known}, []
    for spring, at in each(whole.springs, range(len(whole.model.parameters))):
        if spring.known:
            theta += zip(at.values(), own.get(spring.effect, _absent(spring)).lower.tolist(), strict=True)
    payload = arm.task.payload / whole.task.payload if whole.task.payload else 1.0
    return Scenario(payload, tuple(theta), arm.task.robot.inertial, says)
