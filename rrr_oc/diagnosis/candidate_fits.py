"""Exact fits of candidates: which trials are fitted, and which of the fits explains the residual best."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from rrr_oc.calibration.calibrated_model import CalibratedModel
from rrr_oc.calibration.friction_width import widened
from rrr_oc.calibration.samples import noise
from rrr_oc.diagnosis.evidence import Candidate, Evidence
from rrr_oc.diagnosis.fitting import SAME, Bench, Fitted, best_start, extended, refit, refit_with_widths, steadily_better
from rrr_oc.diagnosis.signatures import black_box_trials, trials, view
from rrr_oc.effects import Effect

EXACT_FITS = 5  # candidates fitted on the exact equations in each round; twice as many cost twice the time
CLOSE = 0.4  # share of the best score that a candidate needs for an exact fit; twice as much leaves fewer candidates
ROBUST_P = 0.05  # largest p-value of the robust score test, corrected for all tests; twice as much doubles its false alarms
CONFIRMED = 0.3  # least fall of the squared residual on left-out recordings, over the fitted one; doubled: rejects more
LEAST_SHARE = 0.007  # share of a joint's squared residual that an effect must explain; twice as much drops the faintest effects
FEWER_LEFT = 2.0  # factor in the squared residual by which a fit is better at any effective sample size; doubled: seldom
HALF = 0.5  # share of the residual above which an effect of some recordings explains most of it; twice as much: never
EXACT = 3e-4  # share of a joint's torque (standard deviation) below which a change counts for nothing: no law is more exact
NOISE_RATIO = 1.1  # residual over noise above which a joint still lacks something; twice as much calls more fits complete
UNLISTED = 0.25  # share of its evidence that a mounted effect loses if all recordings have it and none lists it; doubled: rarer
PRECEDENCE = 0.7  # of the evidence for an effect: a law of its `precedence` with more goes before it where there is noise
NEARLY = 0.8  # share of the best score from which the edge of a piecewise torque is refined; a larger share refines less often
EDGE_STEP, LEAST_STEP = 0.05, 0.002  # first and last step of that refinement, as shares of the range; a finer one costs time


class Choice(NamedTuple):
    """A candidate with its exact fit and the score of that."""

    score: float
    fitted: Fitted
    candidate: Candidate


def gathered(bench: Bench, model: CalibratedModel) -> Evidence:
    """Evidence for every trial of the catalogue at a model."""
    return Evidence.gather(bench, model, trials(view(bench.whole, model), model.torque))


def black_box_evidence(bench: Bench, model: CalibratedModel, j: int) -> Evidence:
    """Evidence for black-box terms on joint j."""
    return Evidence.gather(bench, model, black_box_trials(bench.prepared, view(bench.whole, model), model, j))


def contenders(evidence: Evidence, model: CalibratedModel) -> list[Candidate]:
    """Candidates for an exact fit: significant, also by the robust test, and near the best; one per effect and joints."""
    others, every = len(evidence.bench.prepared) > 1, evidence.candidates()
    result: list[Candidate] = []
    most = max((c.compared for c in every), default=0.0)
    for candidate in every:
        low = result and candidate.score < min(CLOSE * result[0].score, result[0].score - SAME)
        if candidate.compared < most and (low or len(result) >= EXACT_FITS):
            continue
        effect = candidate.trial.effect
        same = any(c.key == candidate.key for c in result)
        if candidate.likelihood < candidate.least or same or present(candidate, model):
            continue
        if _by_amplitude(effect) and not _robust(evidence, candidate):
            continue
        best_scored = candidate is every[0]
        bent = not effect.black_box and len(effect.parameters) > len(effect.amplitudes)
        # a nonlinear effect may fit well with a shape near that of its trial: the first candidate is fitted in any case
        held = not others or (best_scored and bent) or evidence.confirmed(candidate) > CONFIRMED
        if held or (best_scored and _confirmed_as_abrupt(evidence, candidate, model)):
            result.append(candidate)
    return result


def _by_amplitude(effect: Effect) -> bool:
    """Whether its signature is proportional to its amplitude, so that the score test is exact."""
    return effect.linear or effect.black_box


def _robust(evidence: Evidence, candidate: Candidate) -> bool:
    return evidence.robust_p(candidate) * evidence.tests < ROBUST_P


def _confirmed_as_abrupt(evidence: Evidence, candidate: Candidate, model: CalibratedModel) -> bool:
    """Whether a law of speed is confirmed once the width of friction is the one estimated beside that law."""
    if candidate.trial.effect.resembles != "friction_over_speed":
        return False
    bench = evidence.bench
    beside = refit_with_widths(bench, extended(model, candidate.term)).model.terms[: len(model.terms)]
    widths = {t.effect.joints: t.width for t in beside if t.effect.sign_forms and t.width}
    there = refit(bench, replace(model, terms=tuple(widened(t, widths) for t in model.terms))).model
    anew = Evidence.gather(bench, there, [candidate.trial])
    return any(anew.confirmed(c) > CONFIRMED for c in anew.candidates() if c.scope == candidate.scope)


def present(candidate: Candidate, model: CalibratedModel) -> bool:
    """Whether the model has the effect there already."""
    effect, scope = candidate.trial.effect, candidate.scope
    return effect.placement != "many" and any(
        t.effect.name == effect.name
        and t.effect.joints == effect.joints
        and (not t.groups or scope is None or set(scope) & set(t.groups))
        for t in model.terms
    )


def fit_of(bench: Bench, evidence: Evidence, fitted: Fitted, candidate: Candidate) -> Fitted:
    """The model with a candidate, fitted; for a linear effect the fit that the evidence holds already."""
    model, effect = extended(fitted.model, candidate.term), candidate.trial.effect
    if effect.dynamics == "impact":
        return best_start(bench, model, (1.0,), fitted.rows)
    if not effect.linear:
        return refit(bench, model, without_last=fitted.rows)
    return Fitted(model, replace(fitted.rows, residual=evidence.left_by(candidate)))


def best_choice(
    bench: Bench, evidence: Evidence, candidates: Sequence[Candidate], plain: Fitted, fitted: Fitted
) -> Choice | None:
    """The best effect that is significant and explains enough of the residual; None without one."""
    found: list[Choice] = []
    for candidate in candidates:
        tried, effect = fit_of(bench, evidence, fitted, candidate), candidate.trial.effect
        gain, share, last = tried.better_than(fitted), explained(bench, plain, fitted, tried), tried.model.terms[-1]
        possible = last.effect.possible(last.named, bench.least_payload(candidate.scope))
        if not (gain > candidate.least and share > LEAST_SHARE and possible):
            continue
        if not (_by_amplitude(effect) or steadily_better(bench, tried, fitted, candidate.scope)):
            # it acts in few places: the robust test decides, if it explains most of some recordings or only noise is left
            most = candidate.scope is not None and share > HALF
            if not ((most or not noisy(bench, tried)) and effect.dynamics != "impact" and _robust(evidence, candidate)):
                continue
        score = gain - candidate.penalty - rarity(bench, tried, effect, candidate.scope is None) * gain
        found.append(Choice(score, tried, candidate))
    if not found:
        return None
    best = max(found, key=lambda b: b.score)
    equal = [b for b in found if b.score > best.score - SAME]
    if len(equal) > 1:  # equal at the present widths; each may imply other widths of friction
        there = [refit_with_widths(bench, b.fitted.model) for b in equal]
        equal = [Choice(b.score + f.better_than(b.fitted), f, b.candidate) for b, f in zip(equal, there, strict=True)]
        best = max(equal, key=lambda b: b.score)
    precedence = best.candidate.trial.effect.precedence
    if precedence and noisy(bench, best.fitted):
        first = [b for b in found if b.candidate.trial.effect in precedence and b.score > PRECEDENCE * best.score]
        best = max(first, key=lambda b: b.score, default=best)
    # a residual that still holds another effect is correlated, so its effective sample size is small
    fewer = [b for b in found if size(b.candidate) <= size(best.candidate)]
    fewer = [b for b in fewer if b.fitted.misfit < best.fitted.misfit - np.log(FEWER_LEFT)]
    return min(fewer, key=lambda b: b.fitted.misfit, default=best)


def best_black_box(bench: Bench, j: int, plain: Fitted, fitted: Fitted) -> Choice | None:
    """The best black-box term of joint j; None without one."""
    evidence = black_box_evidence(bench, fitted.model, j)
    every = [e for e in (evidence, _at_its_edge(evidence)) if e is not None]
    found = [best_choice(bench, e, contenders(e, fitted.model), plain, fitted) for e in every]
    return max((b for b in found if b is not None), key=lambda b: b.score, default=None)


def _at_its_edge(evidence: Evidence) -> Evidence | None:
    """Evidence for the best piecewise torque with its edge refined from the coarse grid to where it explains most."""
    every, step, there = evidence.candidates(), EDGE_STEP, None
    best = next((c for c in every if c.trial.effect.has_edges), None)
    if best is None or best.score < NEARLY * every[0].score:
        return None
    effect, seen = best.trial.effect, view(evidence.bench.whole, evidence.model)
    while step > LEAST_STEP:
        there = Evidence.gather(evidence.bench, evidence.model, [e.trial(seen) for e in (effect, *effect.near(step))])
        scores = {c.trial.effect: c.score for c in there.candidates()}
        nearest = max(scores, key=lambda e: (scores[e], e == effect), default=effect)  # of equal scores, the present edge
        effect, step = nearest, step / 2 if nearest == effect else step
    return there


def size(candidate: Candidate) -> int:
    """Number of a candidate's parameters."""
    return len(candidate.trial.effect.parameters)


def explained(bench: Bench, plain: Fitted, less: Fitted, more: Fitted) -> float:
    """Largest `worth` of an effect over the joints whose torque it changes by more than `EXACT`."""
    felt = less.squares - more.squares > plain.rows.moving.sum(axis=1) * (EXACT * bench.torque) ** 2
    return float(np.max(np.where(felt, worth(plain.squares, less.squares, more.squares), 0.0)))


def worth(plain, less, more):
    """Relative fall of the squared residual from `less` (without the effect) to `more` (with it).

    It is relative to the geometric mean of the plain model's squared residual and of `less`. Relative to the first alone, no effect
    would count beside one that is a hundred times as strong; relative to the second alone, small errors of the strong law would
    count as effects.
    """
    return (less - more) / np.sqrt(plain * less)


def rarity(bench: Bench, fitted: Fitted, effect: Effect, everywhere: bool) -> float:
    """Share of its evidence that an effect loses for a low prior: something mounted in all recordings and listed in none.

    It applies while the residual is far above the noise: all models are wrong there, and the likelihood also rewards what a law
    absorbs of other effects.
    """
    return UNLISTED if effect.scope == "mounted" and everywhere and noisy(bench, fitted) else 0.0


def noisy(bench: Bench, fitted: Fitted) -> list[int]:
    """Joints whose residual exceeds what the noise of single samples explains."""
    return np.flatnonzero(above_noise(bench, fitted) > NOISE_RATIO).tolist()


def above_noise(bench: Bench, fitted: Fitted) -> np.ndarray:
    """Standard deviation of each joint's filtered residual over that of filtered sample noise, (n,)."""
    gains = [np.asarray(p.matrix.multiply(p.matrix).sum(axis=1)).ravel() for p in bench.prepared]
    passed = np.sqrt(np.mean(np.concatenate(gains)))
    return fitted.rows.deviation() / np.maximum(noise(bench.prepared, fitted.model) * passed, 1e-9)
