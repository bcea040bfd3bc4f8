"""Diagnosis of a recording set: the plain model, the most probable structure, and one check of the whole on held-out recordings."""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import replace
from time import perf_counter

import numpy as np

from rrr_oc.calibration.calibrate import data_of, first_estimate
from rrr_oc.calibration.calibrated_model import CalibratedModel
from rrr_oc.calibration.clocks import on_one_clock
from rrr_oc.calibration.estimator.fitting import Fitted, plain_std
from rrr_oc.calibration.estimator.intervals import described
from rrr_oc.calibration.inverse_dynamics import finished, plain_model
from rrr_oc.calibration.measurement import common_delay
from rrr_oc.calibration.prediction_error import mean_nrmse
from rrr_oc.calibration.samples import Prepared, prepare, without_spikes
from rrr_oc.diagnosis.alternatives import alternatives, beside, decided
from rrr_oc.diagnosis.claims.anatomy import anatomy
from rrr_oc.diagnosis.claims.classes import separated, with_links
from rrr_oc.diagnosis.claims.dependence import by_degree
from rrr_oc.diagnosis.claims.effect_size import LeftOut, confirmed, predictive
from rrr_oc.diagnosis.claims.reliability import judged
from rrr_oc.diagnosis.events import WHOLLY, events, unexplained_events, unlike_laws, without
from rrr_oc.diagnosis.findings import found, further, moved
from rrr_oc.diagnosis.fitting import Fitter
from rrr_oc.diagnosis.held_out import errors_of, joints_made_worse, nrmse, repeated
from rrr_oc.diagnosis.knobs import CLAIM, FAR, MATTERS
from rrr_oc.diagnosis.mismatch import filtered_noise, idle, left_over, mismatch, unexplained
from rrr_oc.diagnosis.result import Diagnosis, Event, Finding, Fold, Possible, Suggestion
from rrr_oc.diagnosis.signatures import trials, view
from rrr_oc.diagnosis.stages import SHARES, Stages
from rrr_oc.diagnosis.structures.search import FittedStructure, Memory, StructureSearch
from rrr_oc.diagnosis.suggestion import suggest
from rrr_oc.effects import Trial
from rrr_oc.effects.priors import Priors
from rrr_oc.errors import noted
from rrr_oc.kept import Kept
from rrr_oc.progress import Progress, Step
from rrr_oc.recordings.recording import RecordingSet

CHECK = "held-out check"  # the last stage of the procedure
Settled = tuple[Fitted, StructureSearch, Fitted, list[Finding], list[Possible], list[Finding]]
ALIKE = 0.001  # by how much the delay that a search ends with may differ from that with which it was made [s]


def diagnose(
    recordings: RecordingSet,
    report: Callable[[Step], None] = lambda _: None,
    priors: Priors | None = None,
    kept: Kept | None = None,
) -> Diagnosis:
    """Diagnose a recording set.

    Args:
        report: Is told how far the diagnosis is.
        priors: What is believed of effects; what they declare by default.
        kept: Where its stages are kept, so that it goes on after an interruption; nowhere by default.

    Raises:
        UserError: The recordings are too short for the filter.
    """
    priors = priors or Priors()
    stages, model = _begin(Stages(recordings, plain_model(recordings), kept, Progress(SHARES, report)), priors)
    return stages.once(CHECK, lambda: _made(stages, model, priors))


def _made(stages: Stages, model: CalibratedModel, priors: Priors) -> Diagnosis:
    """All stages from the first estimate up to the check on held-out recordings."""
    recordings, failed = stages.recordings, dict[str, str]()
    whole, fitter, every = _ready(stages, model, priors)
    fitter, first, disturbed, settled = _apart_from_events(fitter, every, stages)
    begin, search, complete, findings, possible, refuted = settled
    complete, findings, worse = _by_degree(search, begin, complete, findings)
    large, small = [f for f in findings if f.matters], [f for f in findings if not f.matters]
    large, undecided, as_good = separated(search, complete, large, small, failed)
    findings, folds, worst = _checked(search, begin, [*large, *small], stages, failed)
    refuted = [*refuted, *worse, *worst]
    final = _with(fitter, complete, findings) if findings else first
    parts = anatomy(LeftOut(search.neighbours(begin)), LeftOut(search.neighbours(final)), findings)
    closest = fitter.closest(final)
    undecided, instead, links = with_links(undecided, search, closest, failed)
    as_good = [*as_good, *instead]
    with noted(failed, "alternative: all effects that are not refuted"):
        as_good = [*beside(fitter, complete, findings, refuted, bool(undecided)), *as_good]
    plain, model = (
        finished(recordings, whole, described(one), {"way": "inverse dynamics"}, perf_counter())
        for one in (fitter.closest(first) if findings else closest, closest)
    )
    findings = judged([replace(f, term=t) for f, t in zip(findings, model.terms[final.base :], strict=True)], parts)
    folds = folds if findings else [replace(f, model=f.plain, after=f.before) for f in folds]
    before, after = map(mean_nrmse, errors_of(folds, fitter.data.n))
    calibration = [mean_nrmse(nrmse(fitter.data, one)) for one in (plain, model)]
    noisy, suggestions = filtered_noise(fitter.data, closest.model), list[Suggestion]()
    left, slow = left_over(fitter.data, closest, noisy)
    others = alternatives(fitter, as_good, model, closest, failed)
    with noted(failed, "suggested recordings"):
        contested = [*findings, *(u.contested for u in undecided)]
        suggestions = suggest(recordings, plain, contested, bool(np.any(left > FAR)), fitter.view)
    return Diagnosis(
        recordings=recordings,
        plain=plain,
        model=replace(model, alternatives=decided(others, suggestions), unexplained=unexplained(left, noisy)),
        findings=tuple(f for f in findings if f.matters),
        undecided=tuple(undecided),
        links=tuple(links),
        small=tuple(f for f in findings if not f.matters),
        possible=tuple(possible),
        refuted=tuple(refuted),
        calibration=(calibration[0], calibration[1]),
        held_out=(before, after),
        way="recordings" if len(recordings.recordings) > 1 else "blocks",
        mismatch=mismatch(fitter.data, first, final, findings, left, (calibration[0], before)),
        suggestions=tuple(suggestions),
        folds=tuple(folds),
        above_noise=tuple(left.tolist()),
        wander=tuple(slow.tolist()),
        idle=idle(fitter.data, final.model),
        priors=priors.file,
        failed=failed,
        late=_late(fitter, closest),
        events=tuple(disturbed),
        anatomy=tuple(parts),
    )


def _apart_from_events(fitter: Fitter, every: tuple[Trial, ...], stages: Stages) -> tuple[Fitter, Fitted, list[Event], Settled]:
    """What fits models to all but events, the plain fit, the events, and what is found; again where that explains what looked like events."""
    whole = fitter.data
    fitter, first, disturbed = _begun(fitter, every, stages.start)
    settled = _settled(fitter, every, first, stages)
    _, _, complete, findings, _, _ = settled
    still = unexplained_events(whole, first.model, complete.model, disturbed) if findings else disturbed
    if len(still) < len(disturbed):
        fitter, first = _apart_from(replace(fitter, data=whole), stages.start, still)
        settled = _settled(fitter, every, first, stages, "search with all rows")
    return fitter, first, still, settled


def _by_degree(
    search: StructureSearch, begin: Fitted, complete: Fitted, findings: list[Finding]
) -> tuple[Fitted, list[Finding], list[Finding]]:
    """A fit with what the data name and functions in the place of the rest, its findings, and those that do not predict there."""
    named, findings = by_degree(search, complete, findings)
    return (named, findings, []) if named is complete else confirmed(search, begin, named, findings)


def _checked(
    search: StructureSearch, begin: Fitted, findings: list[Finding], stages: Stages, failed: dict[str, str]
) -> tuple[list[Finding], list[Fold], list[Finding]]:
    """The findings of joints whose error does not rise on recordings that are left out, the fits behind that, and the other findings."""
    folds = repeated(search, begin, findings, stages, failed)
    # what has a value of its own in each recording says nothing of those left out
    worse = joints_made_worse(stages.recordings, folds) - {f.joint for f in findings if f.of_each}
    gone = [f for f in findings if f.joint in worse]
    if not gone:
        return findings, folds, []
    findings = [f for f in findings if f not in gone]
    return findings, repeated(search, begin, findings, stages, failed, ", less what is worse"), gone


def _with(fitter: Fitter, complete: Fitted, findings: Sequence[Finding]) -> Fitted:
    """A complete fit with the terms of these findings alone, in this order."""
    kept = tuple(f.term for f in findings)
    model = replace(complete.model, terms=(*complete.model.terms[: complete.base], *kept))
    return complete if kept == complete.extra else fitter.fit(model, complete.links, complete.posterior)


def _settled(fitter: Fitter, every: tuple[Trial, ...], plain: Fitted, stages: Stages, name: str = "search") -> Settled:
    """The plain fit and a search under one delay of all torques, that of the model with what predicts; the fit with that, it, and what is
    possible and what does not predict."""
    delay, again = fitter.delay_of(plain), f"{name} with the delay that was found"
    while True:
        holding, begin = fitter.holding(delay, plain)
        search, at = _searched(holding, every, begin, stages, name)
        findings, possible = found(search, at)
        stages.progress.tell("held-out check", 0.2, f"effects checked: {len(findings)}")
        complete = search.completed(at)
        added = [f for f in further(search, complete, len(at.fitted.extra)) if f.probability >= CLAIM]
        findings = [*moved(findings, at.fitted, complete), *added]
        findings, out = predictive(LeftOut(search.neighbours(complete)), findings)
        complete, findings, worse = confirmed(search, begin, complete, findings)
        last, delay = delay, fitter.delay_of(complete) if findings else delay
        if abs(delay - last) < ALIKE or name == again:
            return begin, search, complete, findings, possible, [*out, *worse]
        name = again


def _searched(
    fitter: Fitter, every: tuple[Trial, ...], begin: Fitted, stages: Stages, name: str
) -> tuple[StructureSearch, FittedStructure]:
    """A search on all recordings, and its best structure."""
    stages.progress.tell("search")
    moves = itertools.count(1)

    def report(said: str, structures: int) -> None:
        number = next(moves)
        # how many moves there will be is not known before
        stages.progress.tell("search", number / (number + 3), said, structures, "structures")

    search = StructureSearch.of(fitter, every, report)

    def memory() -> Memory:
        search.run(begin)
        return search.memory

    search = replace(search, report=lambda *_: None).restored(stages.once(name, memory))
    return search, search.path[-1]


def ready(recordings: RecordingSet, priors: Priors) -> tuple[Sequence[Prepared], Fitter, tuple[Trial, ...], CalibratedModel]:
    """All samples, what fits models to the recordings, the trials of the catalogue, and the plain model to start from."""
    stages, model = _begin(Stages(recordings, plain_model(recordings)), priors)
    return *_ready(stages, model, priors), replace(model, robot=stages.start.robot)


def _begin(stages: Stages, priors: Priors) -> tuple[Stages, CalibratedModel]:
    """The stages of the recordings on one clock, and a first estimate of the plain model."""
    recordings, start, exact = stages.recordings, stages.start, priors.exact_inertias
    stages.progress.tell("plain model")
    model, lags = stages.once("plain model", lambda: first_estimate(recordings, prepare(recordings), start, exact))
    return replace(stages, recordings=on_one_clock(recordings, lags)), model


def _ready(stages: Stages, model: CalibratedModel, priors: Priors) -> tuple[Sequence[Prepared], Fitter, tuple[Trial, ...]]:
    """All samples, what fits models to the recordings, and the trials of the catalogue."""
    recordings, nominal, exact = stages.recordings, stages.start, priors.exact_inertias
    whole = prepare(recordings)
    data = data_of(recordings, without_spikes(whole, model), nominal, model, exact)
    seen = view(data.prepared, model)
    # a link whose errors are parameters needs no effect that says the same, and whose result need not be a body
    gone = ("inertial",) if len(data.links.std) else ()
    every = trials(seen, model.torque)
    every = tuple(t for t in every if t.effect.name not in priors.excluded and t.effect.alters not in gone)
    families: dict[tuple, list[Trial]] = {}
    for trial in every:
        families.setdefault((trial.effect.name, trial.effect.joints), []).append(trial)
    return whole, Fitter(data, plain_std(data), seen, families, priors), every


def _late(fitter: Fitter, fitted: Fitted) -> tuple[Finding, ...]:
    """A delay of all joints' torques, if it matters."""
    found = common_delay(fitter, fitted)
    if found is None or found[1].low <= MATTERS:
        return ()
    term, fall, p_value = found
    return (Finding(term, 1 - p_value, np.nan, p_value, fall=fall, right=1 - p_value, named=True),)


def _begun(fitter: Fitter, every: tuple[Trial, ...], start: CalibratedModel) -> tuple[Fitter, Fitted, list[Event]]:
    """What fits models to all but events, the plain fit, and the events; what a search with all rows explains is none."""
    begin, some, whole = fitter.begin(start), list[Event](), fitter
    while new := [e for e in unlike_laws(StructureSearch.of(fitter, every), begin, events(begin)) if e not in some]:
        some += new  # beside large ones others do not show
        fitter, begin = _apart_from(fitter, start, new)
    if some:
        law = StructureSearch.of(whole, every).run(whole.begin(start)).fitted
        joints = {e.joint for e in unexplained_events(whole.data, begin.model, law.model, some, WHOLLY)}
        still = [e for e in some if e.joint in joints]  # a law that explains some pushes of a joint may be fitted to these
        if len(still) < len(some):
            some = still
            fitter, begin = _apart_from(whole, start, some)
    return fitter, begin, sorted(some, key=lambda e: (e.joint, e.recording, e.begin))


def _apart_from(fitter: Fitter, start: CalibratedModel, some: Sequence[Event]) -> tuple[Fitter, Fitted]:
    """What fits models to all but some events, and the plain fit."""
    fitter = replace(fitter, data=fitter.data.of(without(fitter.data.prepared, start.joints, some)))
    return fitter, fitter.begin(start)
