"""Diagnosis of a recording set: calibration, selection of effects, comparison with alternatives, validation on held-out recordings."""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.stats import chi2

from rrr_oc import parallel
from rrr_oc.calibration.calibrate import identify
from rrr_oc.calibration.calibrated_model import CalibratedModel, Term
from rrr_oc.calibration.friction_width import with_widths
from rrr_oc.calibration.inverse_dynamics import Fit, fit_terms, plain_model
from rrr_oc.calibration.prediction_error import error
from rrr_oc.calibration.regression import rows
from rrr_oc.calibration.samples import Prepared, prepare, thinned, without_reversals, without_spikes
from rrr_oc.diagnosis.contest import Finding, contested
from rrr_oc.diagnosis.evidence import Bench
from rrr_oc.diagnosis.fitting import Fitted, refit
from rrr_oc.diagnosis.mismatch import FAR, mismatch
from rrr_oc.diagnosis.reversals import blurred_joints, other_turns, with_turns
from rrr_oc.diagnosis.selection import SAME, Found, Lawless, above_noise, as_seen, select_effects, worth
from rrr_oc.diagnosis.signatures import view
from rrr_oc.diagnosis.suggestion import Suggestion, suggest
from rrr_oc.recordings.recording import Recording, RecordingSet
from rrr_oc.robot.inertial_parameters import precision, prior

FOLDS = 4  # of the recordings, each held out once; twice as many double the time
FOLDS_OF_MANY, MANY_JOINTS = 2, 5  # folds of arms with so many joints or more, where a selection takes minutes
BLOCKS = 4  # contiguous pieces of a single recording, each held out once
FEW_EFFECTS = 5  # up to which the removal of each is tried when a black-box term is worth nothing; more cost time
SHORT = 10  # samples; shorter segments are left out of the blocks
WALD_P = 0.0027  # largest p-value of a linear effect that is kept (three standard errors); twice as much keeps fainter ones
LEAST_WORTH = 0.002  # relative fall of the held-out squared residual for an effect to be kept; twice as much drops the faintest
HARM = 0.05  # relative rise of any fold's squared residual above which a black-box term is removed; twice as much keeps more
HEAVY = 5e8  # bytes of signatures above which another process computes them instead of receiving them
VERDICTS = ("missing_physics", "nothing_missing", "cannot_tell")


@dataclass(frozen=True)
class Shares:
    """What each effect contributes on held-out recordings; one entry per effect.

    Attributes:
        share: Fall of the squared residual when the effect is added, relative to the plain model's squared residual.
        worth: The fall as `selection.worth` measures it; for an effect with separate parameters in several groups, beside the others.
        before, after: NRMSE of the effect's joints without and with it.
        least: Smallest relative fall over the folds.
    """

    share: tuple[float, ...]
    worth: tuple[float, ...]
    before: tuple[float, ...]
    after: tuple[float, ...]
    least: tuple[float, ...]


@dataclass(frozen=True)
class Fold:
    """The models found without some of the recordings, and their errors on them.

    Attributes:
        held: Indices of the held-out recordings (of the blocks of a single recording).
        plain, model: Without and with effects, selected and fitted on the rest.
        before, after: Their NRMSE on the held-out recordings, each (number held out, n).
    """

    held: tuple[int, ...]
    plain: CalibratedModel
    model: CalibratedModel
    before: np.ndarray
    after: np.ndarray


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
        """One of `VERDICTS`."""
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
    way, folds = _folds(bench)
    outcomes = _without_each(folds, at, findings, report, jobs)
    held_out = _mean([o.before for o in outcomes]), _mean([o.after for o in outcomes])
    if _refuted(findings, fitted, held_out):
        report("the selected effects predict held-out recordings worse: they are dropped")
        findings = []
    model, shares = plain, Shares((), (), (), (), ())
    if findings:
        report("measuring what each effect contributes on held-out recordings")
        fitted, model, findings, shares = _claimed(at, folds, fitted, findings, report)
    if not findings:
        fitted, held_out = at.found.plain, (held_out[0], held_out[0])
        outcomes = [replace(o, model=o.plain, after=o.before) for o in outcomes]
    left = above_noise(bench, fitted)
    calibration = _nrmse(bench, plain), _nrmse(bench, model)
    where = mismatch(bench, refit(bench, plain), fitted, findings, left, (calibration[0], held_out[0]))
    suggestions = suggest(recordings, plain, findings, bool(np.any(left > FAR)), view(bench.prepared, plain))
    return Diagnosis(
        recordings,
        plain,
        model,
        tuple(findings),
        shares,
        calibration,
        held_out,
        way,
        where,
        tuple(suggestions),
        tuple(outcomes),
        tuple(left.tolist()),
    )


def _searched(recordings: RecordingSet, report: Callable[[str], None]) -> _Searched:
    """The selection on all recordings, repeated where errors at reversals hide or imitate effects."""
    report("calibrating the plain model")
    whole = prepare(recordings)
    start = with_widths(whole, plain_model(recordings))
    plain = _final(recordings, whole, start).model
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
        plain = _final(recordings, whole, plain).model
        found = select_effects(bench, begin, report)
    return _Searched(recordings, whole, bench, plain, start, begin, found)


def _without_each(
    folds: Sequence[tuple[Bench, list[int]]],
    at: _Searched,
    findings: Sequence[Finding],
    report: Callable[[str], None],
    jobs: int,
) -> list[Fold]:
    """Selection and fit without each fold of the recordings."""
    empirical = any(f.term.effect.black_box for f in findings)
    lawless = "beside" if empirical or _few_cycles(at.bench, at.plain, findings) else "never"
    every = [fold for _, fold in folds]
    held = [(bench, at.begin, every, k, bool(findings), lawless) for k, (bench, _) in enumerate(folds)]
    report("fitting without the recordings that are held out")
    return parallel.ordered(_held_out, held, 1 if not findings else jobs)


def _claimed(
    at: _Searched,
    folds: Sequence[tuple[Bench, list[int]]],
    fitted: Fitted,
    findings: Sequence[Finding],
    report: Callable[[str], None],
) -> tuple[Fitted, CalibratedModel, list[Finding], Shares]:
    """The findings that contribute on held-out recordings and differ significantly from 0, and the model with them."""
    kept, shares = _weighed(folds, at.begin, fitted, findings)
    if not kept and any(f.term.effect.black_box for f in findings):
        report("looking for effects of the catalogue first")
        fitted, findings = contested(at.bench, select_effects(at.bench, at.begin, report, "after"), report)
        kept, shares = _weighed(folds, at.begin, fitted, findings)
    base = len(at.start.terms)
    fit = _calibrated(at, fitted, kept)
    sure = list(itertools.compress(kept, _sure(fit.model.terms[base:], fit.covariance.matrix)))
    if len(sure) < len(kept):
        kept, shares = _weighed(folds, at.begin, fitted, sure)
        fit = _calibrated(at, fitted, kept)
    model = fit.model
    kept = [replace(f, term=t) for f, t in zip(kept, model.terms[base:], strict=True)]
    return fitted, model if kept else at.plain, kept, shares


def _few_cycles(bench: Bench, plain: CalibratedModel, findings: Sequence[Finding]) -> bool:
    """Whether one is among them that only takes the place of a series, such as a ripple of less than two cycles."""
    seen, terms = view(bench.prepared, plain), [f.term for f in findings]
    return any(t.effect.is_sparse(seen, t.named) for t in terms)


def _refuted(findings: Sequence[Finding], fitted: Fitted, held_out: tuple[np.ndarray, np.ndarray]) -> bool:
    """Whether held-out recordings refute the findings: selection and fit without them raise their errors significantly.

    Findings that hold in some recordings only exempt the set, since the training recordings may not contain the effect.
    """
    everywhere = all(f.term.recordings == "all" for f in findings)
    change = 2 * np.log(np.maximum(held_out[1], 1e-300) / np.maximum(held_out[0], 1e-300))
    return bool(findings and everywhere and np.nansum(fitted.counts * change) > SAME)


def _final(recordings: RecordingSet, prepared: Sequence[Prepared], model: CalibratedModel) -> Fit:
    """The model with estimates, intervals and report."""
    way = identify if recordings.inertial == "identify" else fit_terms
    return way(recordings, prepared, model)


def _folds(bench: Bench) -> tuple[str, list[tuple[Bench, list[int]]]]:
    """Benches with the indices of the recordings to hold out; a single recording is cut into blocks."""
    count = len(bench.prepared)
    if count == 1:
        bench, count, way = _blocks(bench), BLOCKS, "blocks"
    else:
        bench, way = bench if bench.signatures.nbytes < HEAVY else bench.on(bench.prepared), "recordings"
    number = min(count, FOLDS_OF_MANY if bench.n >= MANY_JOINTS else FOLDS)
    alike = sorted(range(count), key=lambda i: (*_mounted(bench.prepared[i].recording), bench.labels.index(bench.groups[i])))
    return way, [(bench, sorted(alike[k::number])) for k in range(number)]  # recordings of one set-up go to different folds


def _mounted(r: Recording) -> tuple[float, int]:
    """Largest payload and number of springs that a recording lists."""
    return float(r.payload.max()), len(r.springs)


def _blocks(bench: Bench) -> Bench:
    (only,) = bench.prepared
    r, pieces = only.recording, []
    began = r.t[0] if r.start is None else r.start
    usable = [np.arange(s.start, s.stop) for s in r.segments if s.stop - s.start > SHORT]
    for part in np.array_split(np.concatenate(usable or [np.arange(len(r.t))]), BLOCKS):
        a, b = int(part[0]), int(part[-1]) + 1
        arrays = {k: getattr(r, k)[..., a:b] for k in ("t", "q", "dq", "ddq", "tau", "payload")}
        segments = tuple(
            slice(max(s.start, a) - a, min(s.stop, b) - a) for s in r.segments if min(s.stop, b) - max(s.start, a) > SHORT
        )
        piece = replace(r, **arrays, segments=segments, start=float(began))
        pieces.append(replace(only, recording=piece, measured=only.measured[:, a:b], moving=only.moving[:, a:b]))
    return bench.on(tuple(pieces))


def _held_out(
    bench: Bench, start: CalibratedModel, folds: Sequence[list[int]], number: int, look: bool, lawless: Lawless
) -> Fold:
    """The plain and the extended model, selected and fitted without one fold, and their errors on that fold.

    If a black-box term is not worth keeping on the other folds, the selection is repeated without such terms.
    """
    fold, rest = folds[number], [i for i in range(len(bench.prepared)) if i not in folds[number]]
    train = bench.part(rest)
    plain = after = refit(train, start)
    if look:
        after = select_effects(train, plain.model, lawless=lawless).fitted
        inner = [(train, [rest.index(i) for i in other]) for k, other in enumerate(folds) if k != number]
        found = after.model.terms[len(start.terms) :]
        doubtful = [k for k, t in enumerate(found) if t.effect.black_box] if len(inner) > 1 else []
        if doubtful and not set(doubtful) <= set(_worth_keeping(inner, plain.model, found)[0]):
            after = select_effects(train, plain.model, lawless="never").fitted
    before, then = (_errors(bench.part(fold), fitted.model) for fitted in (plain, after))
    return Fold(tuple(fold), plain.model, after.model, before, then)


def _errors(bench: Bench, model: CalibratedModel) -> np.ndarray:
    found = []
    for p in bench.prepared:
        r = p.recording
        found.append(error(r.t, p.measured, model.predicted_torque(r), r.segments)["nrmse"])
    return np.array(found)


def _nrmse(bench: Bench, model: CalibratedModel) -> np.ndarray:
    return _mean([_errors(bench, model)])


def _mean(errors: Sequence[np.ndarray]) -> np.ndarray:
    """Mean over the recordings in which a joint moves, (n,); NaN where it never moves."""
    whole = np.concatenate(errors)
    known = np.isfinite(whole)
    return np.where(known.any(axis=0), np.where(known, whole, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1), np.nan)


def _with(start: CalibratedModel, terms: Sequence[Term]) -> CalibratedModel:
    return replace(start, terms=(*start.terms, *terms))


def _at(start: CalibratedModel, fitted: Fitted) -> CalibratedModel:
    """The plain model at its estimates beside the effects; nonlinear effects need a start near the optimum."""
    return replace(start, terms=fitted.model.terms[: len(start.terms)])


def _calibrated(at: _Searched, fitted: Fitted, findings: Sequence[Finding]) -> Fit:
    """The extended model, calibrated on all recordings."""
    terms = [f.term.with_values(np.array(list(f.term.effect.canonical(f.term.named).values()))) for f in findings]
    return _final(at.recordings, at.whole, _with(_at(at.start, fitted), terms))


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


def _weighed(
    folds: Sequence[tuple[Bench, list[int]]], begin: CalibratedModel, fitted: Fitted, findings: Sequence[Finding]
) -> tuple[list[Finding], Shares]:
    """The effects that contribute on held-out recordings, largest contribution first, with their shares."""
    there = _at(begin, fitted)
    ordered = _ordered(folds, there, findings)
    kept, shares = _worth_keeping(folds, there, [f.term for f in ordered])
    return [ordered[k] for k in kept], shares


def _ordered(folds: Sequence[tuple[Bench, list[int]]], start: CalibratedModel, findings: Sequence[Finding]) -> list[Finding]:
    """The effects in descending order of what each alone contributes on held-out recordings."""
    if len(findings) < 2:
        return list(findings)
    alone = [_shares(folds, start, [f.term]).share[0] for f in findings]
    return [findings[k] for k in np.argsort(alone, kind="stable")[::-1]]


def _worth_keeping(
    folds: Sequence[tuple[Bench, list[int]]], start: CalibratedModel, terms: Sequence[Term]
) -> tuple[list[int], Shares]:
    """Indices of the terms that contribute on held-out recordings, and their shares (backward elimination).

    A black-box term of all recordings must in addition not harm any fold: it may fit similar motions and no others. Of several terms
    that contribute too little, the one is removed without which the rest predicts best.
    """
    kept = list(range(len(terms)))
    while True:
        shares = _shares(folds, start, [terms[k] for k in kept])
        poor, lawless = [], False
        for k, value, least in zip(kept, shares.worth, shares.least, strict=True):
            unnamed = terms[k].effect.black_box and not terms[k].groups
            if value <= LEAST_WORTH or (unnamed and least < -HARM):
                poor.append(k)
                lawless |= unnamed
        if not poor:
            return kept, shares
        if lawless and len(kept) <= FEW_EFFECTS:
            poor = kept
        left = [_left(folds, start, [terms[i] for i in kept if i != k]) if len(poor) > 1 else 0.0 for k in poor]
        kept = [k for k in kept if k != poor[int(np.argmin(left))]]


def _left(folds: Sequence[tuple[Bench, list[int]]], start: CalibratedModel, terms: Sequence[Term]) -> float:
    """Sum over the joints of the log squared residual on held-out recordings with these effects; smaller is better."""
    squares = []
    for bench, fold in folds:
        train = bench.part([i for i in range(len(bench.prepared)) if i not in fold])
        model = refit(train, _with(start, as_seen(train, start, terms))).model
        squares.append(np.sum(rows(bench.part(fold).prepared, model).residual ** 2, axis=1))
    return float(np.sum(np.log(np.maximum(np.sum(squares, axis=0), 1e-300))))


def _shares(folds: Sequence[tuple[Bench, list[int]]], start: CalibratedModel, terms: Sequence[Term]) -> Shares:
    """Contributions of effects that are added in their order, all parameters fitted without the held-out recordings each time.

    For an effect with separate parameters in several groups, `worth` is measured beside the other groups' terms.
    """
    base, count = len(start.terms), len(terms)
    some = [tuple(range(k)) for k in range(count + 1)]
    after = [tuple(sorted({*some[k + 1], *_siblings(terms, k)})) for k in range(count)]
    pairs = [(tuple(i for i in there if i != k), there) for k, there in enumerate(after)]
    squares: dict[tuple[int, ...], list[np.ndarray]] = {chosen: [] for chosen in (*some, *(c for pair in pairs for c in pair))}
    errors: dict[tuple[int, ...], list[np.ndarray]] = {chosen: [] for chosen in squares}
    for bench, fold in folds:
        train, test = bench.part([i for i in range(len(bench.prepared)) if i not in fold]), bench.part(fold)
        model = _with(start, as_seen(train, start, terms))
        for chosen in squares:
            there = refit(train, replace(model, terms=(*model.terms[:base], *(model.terms[base + k] for k in chosen)))).model
            squares[chosen].append(np.sum(rows(test.prepared, there).residual ** 2, axis=1))
            errors[chosen].append(_errors(test, there))
    noise = np.maximum(np.sum(squares[some[-1]], axis=0), 1e-300)  # joints weigh by the noise that is left
    by_fold = {chosen: np.sum(np.array(each) / noise, axis=1) for chosen, each in squares.items()}
    total, nrmse = {c: x.sum() for c, x in by_fold.items()}, {c: _mean(e) for c, e in errors.items()}
    joints = [list(t.effect.joints) or list(range(start.robot.n)) for t in terms]
    return Shares(
        tuple(float((total[some[k]] - total[some[k + 1]]) / total[()]) for k in range(count)),
        tuple(float(worth(total[()], total[b], total[a])) for b, a in pairs),
        tuple(float(np.nanmean(nrmse[some[k]][j])) for k, j in enumerate(joints)),
        tuple(float(np.nanmean(nrmse[some[k + 1]][j])) for k, j in enumerate(joints)),
        tuple(float(np.min((by_fold[b] - by_fold[a]) / by_fold[()])) for b, a in pairs),
    )


def _siblings(terms: Sequence[Term], k: int) -> list[int]:
    """Indices of the terms with the same effect in other groups."""
    return [i for i, t in enumerate(terms) if t.effect == terms[k].effect and t.groups and terms[k].groups]
