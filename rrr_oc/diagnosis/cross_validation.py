"""Cross-validation: selection and fit without each fold of the recordings, and what each effect contributes on held-out ones."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rrr_oc import parallel
from rrr_oc.calibration.calibrated_model import CalibratedModel, Term
from rrr_oc.calibration.prediction_error import error
from rrr_oc.calibration.regression import rows
from rrr_oc.diagnosis.candidate_fits import worth
from rrr_oc.diagnosis.contest import Finding
from rrr_oc.diagnosis.fitting import Bench, Fitted, extended, refit
from rrr_oc.diagnosis.selection import BlackBoxUse, select_effects
from rrr_oc.diagnosis.signatures import as_seen

FOLDS = 4  # of the recordings, each held out once; twice as many double the time
FOLDS_OF_MANY, MANY_JOINTS = 2, 5  # folds of arms with so many joints or more, where a selection takes minutes
BLOCKS = 4  # contiguous pieces of a single recording, each held out once; twice as many double the time
SHORT = 10  # samples; shorter segments are left out of the blocks
FEW_EFFECTS = 5  # up to which the removal of each is tried when a black-box term is worth nothing; more cost time
LEAST_WORTH = 0.002  # relative fall of the held-out squared residual for an effect to be kept; twice as much drops the faintest
HARM = 0.05  # relative rise of any fold's squared residual above which a black-box term is removed; twice as much keeps more
HEAVY = 5e8  # bytes of signatures above which another process computes them instead of receiving them


@dataclass(frozen=True)
class Shares:
    """What each effect contributes on held-out recordings; one entry per effect.

    Attributes:
        share: Fall of the squared residual when the effect is added, relative to the plain model's squared residual.
        worth: The fall as `candidate_fits.worth` measures it; for an effect with separate parameters in several groups, beside the others.
        before, after: NRMSE of the effect's joints without and with it.
        least: Smallest relative fall over the folds.
    """

    share: tuple[float, ...] = ()
    worth: tuple[float, ...] = ()
    before: tuple[float, ...] = ()
    after: tuple[float, ...] = ()
    least: tuple[float, ...] = ()


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
class Split:
    """Recordings and the indices of those to hold out."""

    bench: Bench
    held: list[int]

    @property
    def train(self) -> Bench:
        """The bench of the other recordings."""
        return self.bench.part(self.rest)

    @property
    def test(self) -> Bench:
        """The bench of the held-out recordings."""
        return self.bench.part(self.held)

    @property
    def rest(self) -> list[int]:
        """Indices of the other recordings."""
        return [i for i in range(len(self.bench.prepared)) if i not in self.held]


def splits(bench: Bench) -> tuple[str, list[Split]]:
    """What is held out ("recordings", or "blocks" of a single one) and each split of them.

    Recordings of one set-up (payload, number of springs, group) go to different folds.
    """
    way = "recordings"
    if len(bench.prepared) == 1:
        bench, way = _blocks(bench), "blocks"
    elif bench.signatures.nbytes >= HEAVY:
        bench = bench.on(bench.prepared)
    recordings = [p.recording for p in bench.prepared]
    mounted = [(float(r.payload.max()), len(r.springs), bench.labels.index(r.group)) for r in recordings]
    alike = sorted(range(len(recordings)), key=mounted.__getitem__)
    number = min(len(recordings), FOLDS_OF_MANY if bench.n >= MANY_JOINTS else FOLDS)
    return way, [Split(bench, sorted(alike[k::number])) for k in range(number)]


def _blocks(bench: Bench) -> Bench:
    """The bench whose recordings are contiguous pieces of its only one."""
    (only,) = bench.prepared
    r, pieces = only.recording, []
    began = r.t[0] if r.start is None else r.start
    usable = [np.arange(s.start, s.stop) for s in r.segments if s.stop - s.start > SHORT]
    for part in np.array_split(np.concatenate(usable or [np.arange(len(r.t))]), BLOCKS):
        a, b = int(part[0]), int(part[-1]) + 1
        arrays = {k: getattr(r, k)[..., a:b] for k in ("t", "q", "dq", "ddq", "tau", "payload")}
        inside = [(max(s.start, a) - a, min(s.stop, b) - a) for s in r.segments]
        segments = tuple(slice(first, end) for first, end in inside if end - first > SHORT)
        piece = replace(r, **arrays, segments=segments, start=float(began))
        pieces.append(replace(only, recording=piece, measured=only.measured[:, a:b], moving=only.moving[:, a:b]))
    return bench.on(tuple(pieces))


def validated(every: Sequence[Split], start: CalibratedModel, black_box: BlackBoxUse | None, jobs: int) -> list[Fold]:
    """The plain and the extended model, selected and fitted without each fold, and their errors on that fold.

    Args:
        start: The plain model from which fits start.
        black_box: Use of black-box terms in the selections; None for no selection at all, which leaves the plain model.
        jobs: Processes (-1: one per core).
    """
    return parallel.ordered(
        _validated, [(every, k, start, black_box) for k in range(len(every))], 1 if black_box is None else jobs
    )


def _validated(every: Sequence[Split], number: int, start: CalibratedModel, black_box: BlackBoxUse | None) -> Fold:
    """If a black-box term is not worth keeping on the other folds, the selection is repeated without such terms."""
    split = every[number]
    train, test, rest = split.train, split.test, split.rest
    plain = after = refit(train, start)
    if black_box is not None:
        after = select_effects(train, plain.model, black_box=black_box).fitted
        inner = [Split(train, [rest.index(i) for i in other.held]) for other in every if other is not split]
        found = after.model.terms[len(start.terms) :]
        doubtful = {k for k, t in enumerate(found) if t.effect.black_box} if len(inner) > 1 else set()
        if doubtful and not doubtful <= set(_worth_keeping(inner, plain.model, found)[0]):
            after = select_effects(train, plain.model, black_box="never").fitted
    return Fold(tuple(split.held), plain.model, after.model, nrmse(test, plain.model), nrmse(test, after.model))


def nrmse(bench: Bench, model: CalibratedModel) -> np.ndarray:
    """NRMSE of the predicted torque by recording and joint (R, n); NaN where a joint does not move."""
    every = ((p.recording, p.measured) for p in bench.prepared)
    return np.array([error(r.t, tau, model.predicted_torque(r), r.segments)["nrmse"] for r, tau in every])


def mean_nrmse(errors: np.ndarray) -> np.ndarray:
    """Mean over the recordings in which a joint moves, (R, n) to (n,); NaN where it never moves."""
    known = np.isfinite(errors)
    return np.where(known.any(axis=0), np.where(known, errors, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1), np.nan)


def beside_effects(start: CalibratedModel, fitted: Fitted) -> CalibratedModel:
    """The plain model at its estimates beside the effects; nonlinear effects need a start near the optimum."""
    return replace(start, terms=fitted.model.terms[: len(start.terms)])


def weighed(
    every: Sequence[Split], start: CalibratedModel, fitted: Fitted, findings: Sequence[Finding]
) -> tuple[list[Finding], Shares]:
    """The effects that contribute on held-out recordings, largest contribution first (each alone), with their shares."""
    start, ordered = beside_effects(start, fitted), list(findings)
    if len(findings) > 1:
        alone = [_shares(every, start, [f.term]).share[0] for f in findings]
        ordered = [findings[k] for k in np.argsort(alone, kind="stable")[::-1]]
    kept, shares = _worth_keeping(every, start, [f.term for f in ordered])
    return [ordered[k] for k in kept], shares


def _worth_keeping(every: Sequence[Split], start: CalibratedModel, terms: Sequence[Term]) -> tuple[list[int], Shares]:
    """Indices of the terms that contribute on held-out recordings, and their shares (backward elimination).

    A black-box term of all recordings must in addition not harm any fold: it may fit similar motions and no others. Of several terms
    that contribute too little, the one is removed without which the rest predicts best.
    """
    kept = list(range(len(terms)))
    while True:
        shares = _shares(every, start, [terms[k] for k in kept])
        empirical = {k for k in kept if terms[k].effect.black_box and not terms[k].groups}
        values = zip(kept, shares.worth, shares.least, strict=True)
        poor = [k for k, value, least in values if value <= LEAST_WORTH or (k in empirical and least < -HARM)]
        if not poor:
            return kept, shares
        if empirical & set(poor) and len(kept) <= FEW_EFFECTS:
            poor = kept
        left = [_left(every, start, [terms[i] for i in kept if i != k]) if len(poor) > 1 else 0.0 for k in poor]
        kept = [k for k in kept if k != poor[int(np.argmin(left))]]


def _squares(test: Bench, model: CalibratedModel) -> np.ndarray:
    return np.sum(rows(test.prepared, model).residual ** 2, axis=1)


def _left(every: Sequence[Split], start: CalibratedModel, terms: Sequence[Term]) -> float:
    """Sum over the joints of the log squared residual on held-out recordings with these effects; smaller is better."""
    squares = []
    for split in every:
        train = split.train
        model = extended(start, *as_seen(train.prepared, start, terms))
        squares.append(_squares(split.test, refit(train, model).model))
    return float(np.sum(np.log(np.maximum(np.sum(squares, axis=0), 1e-300))))


def _shares(every: Sequence[Split], start: CalibratedModel, terms: Sequence[Term]) -> Shares:
    """Contributions of effects that are added in their order, all parameters fitted without the held-out recordings each time.

    For an effect with separate parameters in several groups, `worth` is measured beside the other groups' terms.
    """
    count = len(terms)
    some = [tuple(range(k)) for k in range(count + 1)]
    after = [tuple(sorted({*some[k + 1], *_siblings(terms, k)})) for k in range(count)]
    pairs = [(tuple(i for i in there if i != k), there) for k, there in enumerate(after)]
    squares: dict[tuple[int, ...], list[np.ndarray]] = {chosen: [] for chosen in (*some, *(c for pair in pairs for c in pair))}
    errors: dict[tuple[int, ...], list[np.ndarray]] = {chosen: [] for chosen in squares}
    for split in every:
        train, test = split.train, split.test
        seen = as_seen(train.prepared, start, terms)
        for chosen in squares:
            model = refit(train, extended(start, *(seen[k] for k in chosen))).model
            squares[chosen].append(_squares(test, model))
            errors[chosen].append(nrmse(test, model))
    noise = np.maximum(np.sum(squares[some[-1]], axis=0), 1e-300)  # joints weigh by the noise that is left
    by_fold = {chosen: np.sum(np.array(each) / noise, axis=1) for chosen, each in squares.items()}
    total = {chosen: x.sum() for chosen, x in by_fold.items()}
    mean = [mean_nrmse(np.concatenate(errors[chosen])) for chosen in some]
    joints = [list(t.effect.joints) or list(range(start.robot.n)) for t in terms]
    return Shares(
        tuple(float((total[some[k]] - total[some[k + 1]]) / total[()]) for k in range(count)),
        tuple(float(worth(total[()], total[b], total[a])) for b, a in pairs),
        tuple(float(np.nanmean(mean[k][j])) for k, j in enumerate(joints)),
        tuple(float(np.nanmean(mean[k + 1][j])) for k, j in enumerate(joints)),
        tuple(float(np.min((by_fold[b] - by_fold[a]) / by_fold[()])) for b, a in pairs),
    )


def _siblings(terms: Sequence[Term], k: int) -> list[int]:
    """Indices of the terms with the same effect in other groups."""
    return [i for i, t in enumerate(terms) if t.effect == terms[k].effect and t.groups and terms[k].groups]
