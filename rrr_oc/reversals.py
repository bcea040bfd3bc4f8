"""What happens when a joint reverses, where plain dry friction is only nearly the law and what is missing may be its own course.

How a real joint changes direction no model knows: for which of them that spoils a diagnosis, and in which way the sign changes.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from rrr_oc.calibrate import with_widths
from rrr_oc.calibrated import CalibratedModel, Term
from rrr_oc.diagnose import Found
from rrr_oc.effects import Effect
from rrr_oc.effects.dry_friction import DryFriction
from rrr_oc.effects.empirical import Empirical
from rrr_oc.evidence import Bench
from rrr_oc.fitting import Fitted, refit
from rrr_oc.regression import variance, without_reversals

BLURRED = 1.2  # of the variance away from reversals: where it is larger with them, they do not count


def blurred_joints(bench: Bench, found: Found) -> np.ndarray:
    """The joints of which no law of the catalogue explains what happens when they reverse, (n,).

    Abrupt dry friction may hold a joint for a moment then, and may be anything below its level; a term that no law stands behind
    may take up even that.
    """
    clear = replace(bench, prepared=without_reversals(bench.prepared))
    lawless = [j for t in found.fitted.model.terms if isinstance(t.effect, Empirical) for j in t.effect.joints]
    models = found.fitted.model, refit(clear, found.plain.model).model
    after, before = (variance(bench.prepared, m) > BLURRED * variance(clear.prepared, m) for m in models)
    return after | (before & np.isin(range(bench.n), lawless))


def other_turns(bench: Bench, found: Found) -> dict[int, Term]:
    """Dry friction, by joint, that changes sign in another way than tanh and so explains what laws of speed were found for.

    All of them or some: with the fewer parameters the model must do as well (Akaike's criterion).
    """
    base, fitted, result = len(found.plain.model.terms), found.fitted, {}
    for number, plain in enumerate(found.plain.model.terms):
        if plain.effect == DryFriction(joints := plain.effect.joints):
            laws = [t for t in fitted.model.terms[base:] if t.effect.of_speed and t.effect.joints == joints]
            ways = [_with_fewer(bench, fitted, number, form, laws) for form in plain.effect.forms()[1:]]
            most = max(ways, key=lambda way: (way[0], -way[1].misfit))
            if most[0]:
                fitted, result[joints[0]] = most[1], most[1].model.terms[number]
    return result


def _with_fewer(bench: Bench, fitted: Fitted, number: int, form: Effect, laws: Sequence[Term]) -> tuple[int, Fitted]:
    """How many of some terms leave where another has this form and the fit does as well, and the fit."""
    terms, fewer, left, dropped = list(fitted.model.terms), fitted, list(laws), 0
    terms[number] = replace(terms[number], effect=form)
    while left:
        tried = []
        for law in left:
            model = replace(fitted.model, terms=tuple(t for t in terms if t is not law))
            tried.append(refit(bench, with_widths(bench.prepared, model)))
        k = min(range(len(left)), key=lambda i: tried[i].misfit)
        dropped += len(left[k].estimates)
        if tried[k].better_than(fitted) < -2 * dropped:
            break
        fewer, terms = tried[k], [t for t in terms if t is not left[k]]
        del left[k]
    return len(laws) - len(left), fewer


def with_turns(model: CalibratedModel, turned: Mapping[int, Term]) -> CalibratedModel:
    """The model with dry friction that changes sign as these terms do."""

    def alike(term: Term) -> Term:
        other = turned.get(term.effect.joints[0]) if isinstance(term.effect, DryFriction) else None
        return term if other is None else replace(term, effect=other.effect, width=other.width)

    return replace(model, terms=tuple(alike(t) for t in model.terms))
