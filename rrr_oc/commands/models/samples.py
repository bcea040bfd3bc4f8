"""Arms drawn from what recordings leave open of a model, for learning and testing on all of them."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from rrr_oc.calibration.calibrated_model import Alternative, CalibratedModel
from rrr_oc.codesign.posterior.members import itself_and_others, moved
from rrr_oc.effects import BodyChange, OnlyRecorded
from rrr_oc.errors import UserError
from rrr_oc.robot.possible_bodies import SameTorques

MOST_DRAWS = 100  # for a sample; where so few draws are possible arms, more find little else
TURNED = np.array([3.0, 5.0, 7.0])  # [m/s²], gravity along no axis


@dataclass(frozen=True)
class Sample:
    """A drawn arm.

    Attributes:
        model: Its model, without intervals.
        says: Which model it is drawn from: `AS_CALIBRATED`, or in what the other one differs from that.
        refused: Draws before it that were no possible arms.
    """

    model: CalibratedModel
    says: str
    refused: int


def samples(model: CalibratedModel, count: int, seed: int) -> Iterator[Sample]:
    """Arms drawn from the posterior of a model and of the others that its recordings do not tell from it, these in turn.

    Parameters of effects are kept within their bounds. Where links are drawn that are no possible bodies, possible ones take their place
    that need the same torques; a draw for which there are none is drawn again.

    Raises:
        UserError: The model's covariance is not known, or of `MOST_DRAWS` draws none is a possible arm.
    """
    if model.spread is None:
        raise UserError(
            "the model does not say how well its parameters are known, so that none can be drawn; calibrate or diagnose again"
        )
    every = [one for one in itself_and_others(model) if one.model.spread is not None]
    bodies = [_same_torques(one.model) for one in every]
    for k in range(count):
        i = k % len(every)
        yield _drawn(every[i], bodies[i], np.random.default_rng([seed, k]))


def _drawn(one: Alternative, bodies: SameTorques, rng: np.random.Generator) -> Sample:
    """A draw from the posterior of a model."""
    assert one.model.spread is not None
    for refused in range(MOST_DRAWS):
        found = moved(one.model, one.model.spread @ rng.standard_normal(one.model.spread.shape[1]))
        inertial = bodies.bodies(found.robot.inertial)
        if inertial is not None:
            return Sample(replace(found, robot=replace(found.robot, inertial=inertial)), one.says, refused)
    raise UserError(
        f"of {MOST_DRAWS} draws ({one.says}) none is a possible arm: too little is known of its links; record faster motions of all joints"
    )


def _same_torques(model: CalibratedModel) -> SameTorques:
    """Of the model's bodies; whatever the direction of gravity, where an effect turns that."""
    changes = [term.effect for term in model.terms if isinstance(term.effect, BodyChange)]
    turned = any(effect.alters == "gravity" and not isinstance(effect, OnlyRecorded) for effect in changes)
    return SameTorques.of(replace(model.robot, gravity=TURNED) if turned else model.robot)
