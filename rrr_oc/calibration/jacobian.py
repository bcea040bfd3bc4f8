"""Derivatives of the torque that a model predicts for a recording by the model's parameters.

Exact, from the model's expressions, for effects that add a torque of the instant; by differences for effects that move the
links, have internal states or act in the sensors.
"""

import itertools
from collections.abc import Sequence

import numpy as np

from rrr_oc.calibration.calibrated_model import CalibratedModel, Term
from rrr_oc.model.recorded_physics import Physics
from rrr_oc.numerics.along import along
from rrr_oc.recordings.recording import Recording


def derivatives(
    model: CalibratedModel,
    recording: Recording,
    inertial: bool = False,
    last: bool = False,
    physics: Physics | None = None,
) -> np.ndarray:
    """d `CalibratedModel.output_torque` / d (parameters of the terms, inertial parameters), (n, K, p).

    Args:
        inertial: Whether the derivatives by the inertial parameters (10, n) are wanted too, link by link.
        last: Whether only those by the parameters of the last term are wanted.
        physics: `model.physics(recording)`, if it is at hand.
    """
    physics = physics or model.physics(recording)
    terms = model.terms[-1:] if last else model.terms
    result = _by_terms(model, recording, terms, physics)
    if inertial:
        result = np.concatenate([result, _sensitivity(physics, recording, model.torque, "inertial")], axis=2)
    if any(t.effect.side == "sensor" for t in model.terms):
        for k in range(result.shape[2]):
            result[:, :, k] = physics.passed_on(recording, result[:, :, k])
    which = [i for i, t in enumerate(terms) if _needs_differences(t) and t.holds_for(recording)]
    if which:
        true = model.true_torque(recording, physics)
        numbers, columns = _places(physics, recording, terms)
        found = physics.by_differences(recording, [numbers[i] for i in which], true, model.torque == "load")
        for i, part in zip(which, found, strict=True):
            result[:, :, columns[i]] = part
    return result


def _needs_differences(term: Term) -> bool:
    """Whether the term is no torque of the instant, so that no expression gives its derivatives."""
    return term.effect.side in ("motion", "sensor") or bool(term.effect.states)


def _places(physics: Physics, recording: Recording, terms: Sequence[Term]) -> tuple[list[int], list[slice]]:
    """Number of each term's effect in `Physics`, where it holds, and its columns in the Jacobian.

    The effects of a recording are the springs that it lists, then the terms that hold; `terms` are the last of these.
    """
    holding = np.cumsum([t.holds_for(recording) for t in terms])
    first = len(physics.model.effects) - int(holding[-1])
    ends = np.cumsum([0, *(len(t.estimates) for t in terms)])
    return (holding - 1 + first).tolist(), [slice(a, b) for a, b in itertools.pairwise(ends)]


def _by_terms(model: CalibratedModel, recording: Recording, terms: Sequence[Term], physics: Physics) -> np.ndarray:
    """Exact derivatives of the true torque by the terms' parameters; 0 for terms that do not hold, and by those without any."""
    sizes = [len(t.estimates) for t in terms]
    result = np.zeros((model.robot.n, len(recording.t), sum(sizes)))
    if all(_needs_differences(t) for t in terms):
        return result
    by_theta = _sensitivity(physics, recording, model.torque, "theta")
    holding = np.repeat([t.holds_for(recording) for t in terms], sizes)
    result[:, :, holding] = by_theta[:, :, by_theta.shape[2] - np.count_nonzero(holding) :]
    return result


def _sensitivity(physics: Physics, recording: Recording, torque: str, by: str) -> np.ndarray:
    function = physics.model.sensitivity("load" if torque == "load" else "motor", by)
    n, columns = physics.model.robot.n, function.size2_out(0)
    if columns == 0:
        return np.zeros((n, len(recording.t), 0))
    (found,) = along(function, *physics.inputs(recording), physics.theta, physics.widths, physics.inertial)
    return found.reshape(n, len(recording.t), columns)
