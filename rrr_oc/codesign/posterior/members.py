"""The members of a posterior: the calibrated model, and the others that its recordings do not tell from it, each with draws."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rrr_oc.calibration.calibrated_model import Alternative, CalibratedModel
from rrr_oc.calibration.parameter_vector import bounds

DRAWS = 64  # of the calibrated model, whose central 95 % are its range; doubled, the ends are known to a tenth of the range
OF_OTHERS = 16  # of every other model
AS_CALIBRATED = "as calibrated"


@dataclass(frozen=True)
class Member:
    """A model of the arm that the recordings allow, and draws from what they leave open of it.

    Attributes:
        says: In what it differs from the calibrated model, or `AS_CALIBRATED`.
        model: It.
        draws: The same with other parameters and links, of independent draws; none where its covariance is not known.
        decided_by: File of a motion that would tell it from the calibrated model; None without one.
    """

    says: str
    model: CalibratedModel
    draws: tuple[CalibratedModel, ...]
    decided_by: str | None = None


def itself_and_others(model: CalibratedModel) -> tuple[Alternative, ...]:
    """A calibrated model, and the others that its recordings do not tell from it."""
    return (Alternative(replace(model, alternatives=()), AS_CALIBRATED), *model.alternatives)


def members(model: CalibratedModel) -> tuple[Member, ...]:
    """The members of a calibrated model, itself first."""
    return tuple(
        Member(one.says, one.model, drawn(one.model, OF_OTHERS if i else DRAWS, [0, i]), one.decided_by)
        for i, one in enumerate(itself_and_others(model))
    )


def drawn(model: CalibratedModel, count: int, seed: int | Sequence[int]) -> tuple[CalibratedModel, ...]:
    """Draws from the posterior of a model, in pairs that are opposite, so that their mean is the model's; none without a covariance.

    Inertial parameters change as the torques of recorded motions do, in proportion to the draw: what no torque depends on then changes
    none, however little is known of it, though single links may be no possible bodies.
    """
    if model.spread is None:
        return ()
    numbers = np.random.default_rng(seed).standard_normal((count // 2, model.spread.shape[1]))
    return tuple(moved(model, model.spread @ way) for way in np.concatenate([numbers, -numbers]))


def moved(model: CalibratedModel, change: np.ndarray) -> CalibratedModel:
    """A model with changed parameters of its terms, kept within their bounds, and of its links, (p + 10 n,)."""
    size, robot = len(model.values), model.robot
    values = iter(np.clip(model.values + change[:size], *bounds(model.terms)).tolist())
    terms = tuple(term.with_values(np.array([next(values) for _ in term.estimates])) for term in model.terms)
    inertial = robot.inertial + change[size:].reshape(robot.n, -1).T
    return replace(model, terms=terms, robot=replace(robot, inertial=inertial), spread=None, alternatives=())
