"""Diagnosis of a recording set: calibration, selection of effects, comparison with alternatives, validation on held-out recordings."""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.stats import chi2

from rrr_oc.calibration import calibrate
from rrr_oc.calibration.calibrated_model import CalibratedModel, Term
from rrr_oc.calibration.friction_width import with_widths
from rrr_oc.calibration.inverse_dynamics import Fit, plain_model
from rrr_oc.calibration.samples import Prepared, prepare, thinned, without_reversals, without_spikes
from rrr_oc.diagnosis.candidate_fits import above_noise
from rrr_oc.diagnosis.contest import Finding, contested
from rrr_oc.diagnosis.cross_validation import Fold, Shares, Split, beside_effects, mean_nrmse, nrmse, splits, validated, weighed
from rrr_oc.diagnosis.fitting import SAME, Bench, Fitted, extended, refit
from rrr_oc.diagnosis.mismatch import FAR, mismatch
from rrr_oc.diagnosis.reversals import blurred_joints, other_turns, with_turns
from rrr_oc.diagnosis.selection import BlackBoxUse, Found, select_effects
from rrr_oc.diagnosis.signatures import view
from rrr_oc.diagnosis.suggestion import Suggestion, suggest
from rrr_oc.recordings.recording import RecordingSet
from rrr_oc.robot.inertial_parameters import precision, prior

WALD_P = 0.0027  # largest p-value of a linear effect that is kept (three standard errors); twice as much keeps fainter ones


@dataclass(frozen=True)
class Diagnosis:
    """The result of a diagnosis.

    Attributes:
        recordings: The set.
        plain, model: Without and with the effects, both calibrated on all recordings.
        findings: The effects and black-box terms, most important first.
        shares: Contribution of each finding on held-out recordings.
        calibration: NRMSE of each joint with the plain and the extended model on all recordings, two of (n,).
        held_out: The same on recordings that took part in no fit and no selection.
        way: "recordings" or "blocks": what was held out.
        mismatch: One entry per joint, as in the file.
        suggestions: Recordings that would separate effects which these do not separate.
        folds: The held-out fits behind `held_out`.
        above_noise: Residual of the final model over noise, (n,).
    """

    recordings: RecordingSet
    plain: CalibratedModel
    model: CalibratedModel
    findings: tuple[Finding, ...]
    shares: Shares
    calibration: tuple[np.ndarray, np.ndarray]
    held_out: tuple[np.ndarray, np.ndarray]
    way: str
    mismatch: tuple[dict[str, Any], ...]
    suggestions: tuple[Suggestion, ...] = ()
    folds: tuple[Fold, ...] = ()
    above_noise: tuple[float, ...] = ()

    @property
    def verdict(self) -> str:
        """One of "missing_physics", "nothing_missing" and "cannot_tell"."""
        if not self.findings:
            return "cannot_tell" if max(self.above_noise, default=0.0) > FAR else "nothing_missing"
        undecided = all(len(f.rivals) > 3 for f in self.findings if not f.term.effect.black_box)
        named = any(not f.term.effect.black_box for f in self.findings)
        return "cannot_tell" if named and undecided else "missing_physics"


@dataclass(frozen=True)
class _Searched:
    """The selection on all recordings.

    Attributes:
        recordings: The set.
        whole: All samples, without the reversals that were left out.
        bench: The thinned samples on which effects are selected.
        plain: The plain model, calibrated.
        start: The plain model with the friction widths estimated on the bench.
        begin: The same with identified inertial parameters, if any; every selection starts from it.
        found: The outcome of the selection.
    """

    recordings: RecordingSet
    whole: Sequence[Prepared]
    bench: Bench
    plain: CalibratedModel
    start: CalibratedModel
    begin: CalibratedModel
    found: Found


def diagnose(recordings: RecordingSet, report: Callable[[str], None] = lambda _: None, jobs: int = -1) -> Diagnosis:
    """Diagnose a recording set.

    Args:
        report: Receives one line of progress at a time.
        jobs: Processes for the held-out fits (-1: one per core).

    Raises:
        UserError: The recordings are too short for the filter.
    """
    at = _searched(recordings, report)
    bench, plain = at.bench, at.plain
    fitted, findings = contested(bench, at.found, report)
    way, every = splits(bench)
    report("fitting without the recordings that are held out")
    folds = validated(every, at.begin, _black_box_use(bench, plain, findings), jobs)
    held_out = mean_nrmse(np.concatenate([f.before for f in folds])), mean_nrmse(np.concatenate([f.after for f in folds]))
    if _refuted(findings, fitted, held_out):
        report("the selected effects predict held-out recordings worse: they are dropped")
        findings = []
    model, shares = plain, Shares()
    if findings:
        report("measuring what each effect contributes on held-out recordings")
        fitted, model, findings, shares = _kept(at, every, fitted, findings, report)
    if not findings:
        fitted, held_out = at.found.plain, (held_out[0], held_out[0])
        folds = [replace(f, model=f.plain, after=f.before) for f in folds]
    left = above_noise(bench, fitted)
    calibration = mean_nrmse(nrmse(bench, plain)), mean_nrmse(nrmse(bench, model))
    return Diagnosis(
        recordings,
        plain,
        model,
        tuple(findings),
        shares,
        calibration,
        held_out,
        way,
        mismatch(bench, refit(bench, plain), fitted, findings, left, (calibration[0], held_out[0])),
        tuple(suggest(recordings, plain, findings, bool(np.any(left > FAR)), view(bench.prepared, plain))),
        tuple(folds),
        tuple(left.tolist()),
    )


def _searched(recordings: RecordingSet, report: Callable[[str], None]) -> _Searched:
    """The selection on all recordings, repeated where errors at reversals hide or imitate effects."""
    report("calibrating the plain model")
    whole = prepare(recordings)
    start = with_widths(whole, plain_model(recordings))
    plain = calibrate.fit(recordings, whole, start).model
    unknown = recordings.inertial == "identify"
    belief = (plain.robot.inertial, precision(prior(start.robot), plain.robot.inertial)) if unknown else None
    bench = Bench(tuple(thinned(without_spikes(whole, plain))), unknown, belief)
    report("looking for effects")
    start = with_widths(bench.prepared, start, free=True)
    begin = replace(start, robot=plain.robot) if unknown else start
    found = select_effects(bench, begin, report)
    if np.any(blurred := blurred_joints(bench, found)):
        names = ", ".join(np.array(recordings.joints)[blurred])
        report(f"looking for effects without the moments at which these joints reverse: {names}")
        whole = without_reversals(whole, blurred)
        bench = bench.on(without_reversals(bench.prepared, blurred))
        found = select_effects(bench, begin, report)
    while turned := other_turns(bench, found):
        names = ", ".join(recordings.joints[j] for j in turned)
        report(f"looking for effects where dry friction changes sign in another way: {names}")
        plain, start, begin = (with_turns(m, turned) for m in (plain, start, begin))
        plain = calibrate.fit(recordings, whole, plain).model
        found = select_effects(bench, begin, report)
    return _Searched(recordings, whole, bench, plain, start, begin, found)


def _black_box_use(bench: Bench, plain: CalibratedModel, findings: Sequence[Finding]) -> BlackBoxUse | None:
    """Use of black-box terms without each fold; None where nothing was found.

    They compete where one was found, or an effect that only takes the place of a series, such as a ripple of less than two cycles.
    """
    seen, terms = view(bench.prepared, plain), [f.term for f in findings]
    if any(t.effect.black_box or t.effect.is_sparse(seen, t.named) for t in terms):
        return "beside"
    return "never" if terms else None


def _kept(
    at: _Searched, every: Sequence[Split], fitted: Fitted, findings: Sequence[Finding], report: Callable[[str], None]
) -> tuple[Fitted, CalibratedModel, list[Finding], Shares]:
    """The findings that contribute on held-out recordings and differ significantly from 0, and the model with them."""
    kept, shares = weighed(every, at.begin, fitted, findings)
    if not kept and any(f.term.effect.black_box for f in findings):
        report("looking for effects of the catalogue first")
        fitted, findings = contested(at.bench, select_effects(at.bench, at.begin, report, "after"), report)
        kept, shares = weighed(every, at.begin, fitted, findings)
    base = len(at.start.terms)
    fit = _calibrated(at, fitted, kept)
    sure = list(itertools.compress(kept, _sure(fit.model.terms[base:], fit.covariance.matrix)))
    if len(sure) < len(kept):
        kept, shares = weighed(every, at.begin, fitted, sure)
        fit = _calibrated(at, fitted, kept)
    model = fit.model
    kept = [replace(f, term=t) for f, t in zip(kept, model.terms[base:], strict=True)]
    return fitted, model if kept else at.plain, kept, shares


def _calibrated(at: _Searched, fitted: Fitted, findings: Sequence[Finding]) -> Fit:
    """The extended model, calibrated on all recordings."""
    terms = [f.term.with_values(np.array(list(f.term.effect.canonical(f.term.named).values()))) for f in findings]
    return calibrate.fit(at.recordings, at.whole, extended(beside_effects(at.start, fitted), *terms))


def _refuted(findings: Sequence[Finding], fitted: Fitted, held_out: tuple[np.ndarray, np.ndarray]) -> bool:
    """Whether held-out recordings refute the findings: selection and fit without them raise their errors significantly.

    Findings that hold in some recordings only exempt the set, since the training recordings may not contain the effect.
    """
    everywhere = all(f.term.recordings == "all" for f in findings)
    change = 2 * np.log(np.maximum(held_out[1], 1e-300) / np.maximum(held_out[0], 1e-300))
    return bool(findings and everywhere and np.nansum(fitted.counts * change) > SAME)


def _sure(terms: Sequence[Term], covariance: np.ndarray) -> list[bool]:
    """Whether each linear effect differs significantly from 0 beside all other terms (Wald's test); nonlinear ones count as sure.

    Args:
        covariance: Of the parameters of all terms of the model, these terms last, (p, p); NaN for undetermined ones.
    """
    sure, at = [], len(covariance) - sum(len(t.estimates) for t in terms)
    for t in terms:
        own = slice(at, at := at + len(t.estimates))
        away, matrix = t.values - [p.nominal for p in t.effect.parameters], covariance[own, own]
        known = np.all(np.isfinite(matrix))
        far = not known or away @ np.linalg.pinv(matrix, hermitian=True) @ away > chi2.isf(WALD_P, len(away))
        sure.append(not t.effect.linear or bool(far))
    return sure
