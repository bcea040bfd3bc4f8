"""Reversals of a joint: where smoothed dry friction is inexact, and which smoothed sign describes a joint best.

Near a reversal the recorded speed does not resolve the direction of motion, and errors there can look like further effects.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.stats import median_abs_deviation

from rrr_oc.calibration.calibrated_model import CalibratedModel, Term
from rrr_oc.calibration.regression import variance
from rrr_oc.calibration.samples import SPEED_WINDOW, without_reversals
from rrr_oc.diagnosis.candidate_fits import noisy
from rrr_oc.diagnosis.fitting import Bench, Fitted, as_abrupt, refit, with_turn, without
from rrr_oc.diagnosis.selection import Found
from rrr_oc.numerics.savitzky_golay import smooth

LEAST_SAMPLES = 7  # in the window that smooths positions; doubled, motion is taken for noise
VARIANCE_RATIO = 1.2  # with reversals over without, above which reversals are left out; twice as much keeps nearly all


def blurred_joints(bench: Bench, found: Found) -> np.ndarray:
    """Joints whose reversals no law of the catalogue explains, (n,).

    At a reversal dry friction may take any value below its level. A black-box term may fit that, so the variance is also compared
    without black-box terms. Where little more than noise is to be explained, bristles that bend by less than the resolution of the
    recorded positions do not count as an explanation.
    """
    clear, model = without_reversals(bench.prepared), found.fitted.model
    lawful = without(model, *(t for t in model.terms if t.effect.black_box))
    result = np.zeros(bench.n, bool)
    for one in (model,) if len(lawful.terms) == len(model.terms) else (model, refit(bench, lawful).model):
        result |= variance(bench.prepared, one) > VARIANCE_RATIO * variance(clear, one)
    much = noisy(bench, found.plain)
    travels = {t.effect.joints: t.effect.travel(t.named) for t in lawful.terms}
    for (j, *_), travel in ((joints, travel) for joints, travel in travels.items() if travel is not None):
        result[j] |= j not in much and travel < _resolution(bench, j)
    return result


def _resolution(bench: Bench, j: int) -> float:
    """Standard deviation of a joint's recorded positions about a smooth motion [rad], from the median absolute deviation."""
    off = []
    for r in (p.recording for p in bench.prepared):
        window = max(SPEED_WINDOW, LEAST_SAMPLES * float(np.median(np.diff(r.t))))
        off.append(r.q[j] - smooth(r.t, r.q[j : j + 1], r.segments, window)[0])
    return float(median_abs_deviation(np.concatenate(off), scale="normal"))  # pyright: ignore[reportArgumentType] (stubs)


def other_turns(bench: Bench, found: Found) -> dict[int, Term]:
    """Dry friction, by joint, that changes sign in another way than by default and so explains what laws of speed were found for.

    The model with fewer laws must fit as well by Akaike's criterion. The joints of an arm are alike: the others take the most common
    sign where they do not fit worse with it.
    """
    plain, fitted, result = found.plain.model.terms, found.fitted, {}
    default = [i for i, term in enumerate(plain) if term.effect in term.effect.sign_forms[:1]]
    for number in default:
        laws = [
            t
            for t in fitted.model.terms[len(plain) :]
            if t.effect.resembles == "friction_over_speed" and t.effect.joints == plain[number].effect.joints
        ]
        others = range(1, len(plain[number].effect.sign_forms))
        ways = [_with_fewer(bench, fitted, number, turn, laws) for turn in others]
        most = max(ways, key=lambda way: (way[0], -way[1].misfit))
        if most[0]:
            fitted, result[number] = most[1], most[1].model.terms[number]
    turns = Counter(term.effect.sign_forms.index(term.effect) for term in result.values())
    for number in [i for i in default if turns and i not in result]:
        tried = as_abrupt(bench, with_turn(fitted.model, number, turns.most_common(1)[0][0]))
        if tried.better_than(fitted) > 0:
            fitted, result[number] = tried, tried.model.terms[number]
    return {term.effect.joints[0]: term for term in result.values()}


def _with_fewer(bench: Bench, fitted: Fitted, number: int, turn: int, laws: Sequence[Term]) -> tuple[int, Fitted]:
    """Number of laws that can be removed if a joint's dry friction has this smoothed sign, and the fit without them."""
    model, fewer, left, dropped = with_turn(fitted.model, number, turn), fitted, list(laws), 0
    while left:
        tried = [as_abrupt(bench, without(model, law)) for law in left]
        k = min(range(len(left)), key=lambda i: tried[i].misfit)
        dropped += len(left[k].estimates)
        if tried[k].better_than(fitted) < -2 * dropped:
            break
        fewer, model = tried[k], without(model, left.pop(k))
    return len(laws) - len(left), fewer


def with_turns(model: CalibratedModel, turned: Mapping[int, Term]) -> CalibratedModel:
    """The model whose dry friction has the smoothed sign of these terms, by joint."""

    def alike(term: Term) -> Term:
        other = turned.get(term.effect.joints[0]) if term.effect.sign_forms else None
        return term if other is None else replace(term, effect=other.effect, width=other.width)

    return replace(model, terms=tuple(alike(t) for t in model.terms))
