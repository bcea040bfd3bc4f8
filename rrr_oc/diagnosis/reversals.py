"""What happens when a joint reverses, where plain dry friction is only nearly the law and what is missing may be its own course.

How a real joint changes direction no model knows: for which of them that spoils a diagnosis, and in which way the sign changes.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.stats import median_abs_deviation

from rrr_oc.calibration.calibrated_model import CalibratedModel, Term
from rrr_oc.calibration.regression import variance
from rrr_oc.calibration.samples import SPEED_WINDOW, without_reversals
from rrr_oc.diagnosis.evidence import Bench
from rrr_oc.diagnosis.fitting import Fitted, as_abrupt, refit, with_turn
from rrr_oc.diagnosis.selection import Found, noisy
from rrr_oc.effects.friction.dry_friction import DryFriction
from rrr_oc.effects.friction.presliding_hysteresis import PreslidingHysteresis
from rrr_oc.numerics.savitzky_golay import smooth
from rrr_oc.numerics.smooth import TURNS

LEAST = 7  # samples of a smooth motion, from which positions are told
BLURRED = 1.2  # of the variance away from reversals: where it is larger with them, they do not count


def blurred_joints(bench: Bench, found: Found) -> np.ndarray:
    """The joints of which no law of the catalogue explains what happens when they reverse, (n,).

    Abrupt dry friction may hold a joint for a moment then, and may be anything below its level; a term that no law stands behind
    may take up even that, so that it is asked without such, too. Where hardly more than noise was to be explained, bristles that bend
    by less than recorded positions tell are none.
    """
    clear, model = without_reversals(bench.prepared), found.fitted.model
    lawful = replace(model, terms=tuple(t for t in model.terms if not t.effect.lawless))
    result = np.zeros(bench.n, bool)
    for one in (model,) if len(lawful.terms) == len(model.terms) else (model, refit(bench, lawful).model):
        result |= variance(bench.prepared, one) > BLURRED * variance(clear, one)
    bristles = [(t.effect.joints[0], t.named) for t in lawful.terms if isinstance(t.effect, PreslidingHysteresis)]
    much = noisy(bench, found.plain)
    for j, theta in bristles:
        result[j] |= j not in much and theta["level"] < theta["stiffness"] * _resolution(bench, j)
    return result


def _resolution(bench: Bench, j: int) -> float:
    """Deviation of a joint's recorded positions from a smooth motion [rad]."""
    off = []
    for r in (p.recording for p in bench.prepared):
        window = max(SPEED_WINDOW, LEAST * float(np.median(np.diff(r.t))))
        off.append(r.q[j] - smooth(r.t, r.q[j : j + 1], r.segments, window)[0])
    return float(median_abs_deviation(np.concatenate(off), scale="normal"))  # pyright: ignore[reportArgumentType] (stubs)


def other_turns(bench: Bench, found: Found) -> dict[int, Term]:
    """Dry friction, by joint, that changes sign in another way than tanh and so explains what laws of speed were found for.

    All of them or some: with the fewer parameters the model must do as well (Akaike's criterion). Joints of an arm are alike, so that
    the others follow where they do not fit worse.
    """
    plain, fitted, result = found.plain.model.terms, found.fitted, {}
    tanh = [i for i, term in enumerate(plain) if term.effect == DryFriction(term.effect.joints)]
    for number in tanh:
        laws = [
            t for t in fitted.model.terms[len(plain) :] if t.effect.of_speed and t.effect.joints == plain[number].effect.joints
        ]
        ways = [_with_fewer(bench, fitted, number, turn, laws) for turn in TURNS if turn != "tanh"]
        most = max(ways, key=lambda way: (way[0], -way[1].misfit))
        if most[0]:
            fitted, result[number] = most[1], most[1].model.terms[number]
    turns = Counter(term.effect.turn for term in result.values())
    for number in [i for i in tanh if turns and i not in result]:
        terms = with_turn(fitted.model.terms, number, turns.most_common(1)[0][0])
        tried = as_abrupt(bench, replace(fitted.model, terms=terms))
        if tried.better_than(fitted) > 0:
            fitted, result[number] = tried, tried.model.terms[number]
    return {term.effect.joints[0]: term for term in result.values()}


def _with_fewer(bench: Bench, fitted: Fitted, number: int, turn: str, laws: Sequence[Term]) -> tuple[int, Fitted]:
    """How many laws leave where a joint's dry friction has this turn and the fit does as well, and the fit."""
    terms, fewer, left, dropped = with_turn(fitted.model.terms, number, turn), fitted, list(laws), 0
    while left:
        tried = []
        for law in left:
            model = replace(fitted.model, terms=tuple(t for t in terms if t is not law))
            tried.append(as_abrupt(bench, model))
        k = min(range(len(left)), key=lambda i: tried[i].misfit)
        dropped += len(left[k].estimates)
        if tried[k].better_than(fitted) < -2 * dropped:
            break
        fewer, terms = tried[k], tuple(t for t in terms if t is not left[k])
        del left[k]
    return len(laws) - len(left), fewer


def with_turns(model: CalibratedModel, turned: Mapping[int, Term]) -> CalibratedModel:
    """The model with dry friction that changes sign as these terms do."""

    def alike(term: Term) -> Term:
        other = turned.get(term.effect.joints[0]) if isinstance(term.effect, DryFriction) else None
        return term if other is None else replace(term, effect=other.effect, width=other.width)

    return replace(model, terms=tuple(alike(t) for t in model.terms))
