"""Diagnosis of a recording set: the plain model, the most probable structure, and one check of the whole on held-out recordings."""

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from time import perf_counter
from typing import Any

import numpy as np

from rrr_oc.calibration.calibrate import data_of, first_estimate
from rrr_oc.calibration.calibrated_model import CalibratedModel
from rrr_oc.calibration.estimator.fitting import Fitted, plain_std
from rrr_oc.calibration.estimator.intervals import described
from rrr_oc.calibration.inverse_dynamics import finished, plain_model
from rrr_oc.calibration.link_findings import OffLink
from rrr_oc.calibration.measurement import common_delay
from rrr_oc.calibration.prediction_error import mean_nrmse
from rrr_oc.calibration.samples import Prepared, prepare, without_spikes
from rrr_oc.diagnosis.alternatives import alternatives, beside, decided
from rrr_oc.diagnosis.claims.anatomy import anatomy
from rrr_oc.diagnosis.claims.classes import separated, with_links
from rrr_oc.diagnosis.claims.dependence import by_degree
from rrr_oc.diagnosis.claims.effect_size import LeftOut, confirmed, predictive
from rrr_oc.diagnosis.events import Event, events, unlike_laws, without
from rrr_oc.diagnosis.files.stages import (
    SHARES,
    FindingData,
    FoldData,
    ModelData,
    ResultData,
    SearchData,
    Stages,
    SuggestionData,
    UndecidedData,
)
from rrr_oc.diagnosis.findings import Finding, Possible, Undecided, found, further, moved
from rrr_oc.diagnosis.fitting import Fitter
from rrr_oc.diagnosis.held_out import Fold, errors_of, joints_made_worse, nrmse, repeated
from rrr_oc.diagnosis.knobs import CLAIM, MATTERS
from rrr_oc.diagnosis.mismatch import FAR, above_noise, filtered_noise, idle, mismatch, unexplained
from rrr_oc.diagnosis.signatures import trials, view
from rrr_oc.diagnosis.structures.search import Search, State
from rrr_oc.diagnosis.suggestion import Suggestion, suggest
from rrr_oc.effects import Trial
from rrr_oc.effects.priors import Priors
from rrr_oc.errors import noted
from rrr_oc.kept import Kept
from rrr_oc.progress import Progress, Step
from rrr_oc.recordings.recording import RecordingSet

CHECK = "held-out check"  # the last stage of the procedure
AGAIN = "search with the delay that was found"
ALIKE = 0.001  # by how much the delay that a search ends with may differ from that with which it was made [s]


@dataclass(frozen=True)
class Diagnosis:
    """The result of a diagnosis.

    Attributes:
        recordings: The set.
        plain, model: Without and with the effects that are claimed, fitted to all recordings.
        findings: The effects and black-box terms of `model` that matter, most important first.
        undecided: Effects that cannot be told from errors of the links.
        links: Links that are far from the URDF's in `model`.
        small: Effects that the model has, too, though they lower no joint's error by a share that matters.
        possible: What may be present but is not claimed.
        refuted: What is as sure, but does not lower the error on data that it was not fitted to.
        calibration: NRMSE of each joint with the plain and the extended model on all recordings, two of (n,).
        held_out: The same on recordings that took part in no fit and no selection.
        way: "recordings" or "blocks": what was held out.
        mismatch: One entry per joint, as in the file.
        suggestions: Recordings that would separate effects which these do not separate.
        folds: The held-out fits behind `held_out`.
        above_noise: Residual of the final model over noise, (n,).
        idle: Joints that never move enough to tell anything, with the mean torque that the model leaves there and its spread [Nm].
        priors: File from which priors were read; None for what the effects declare.
        failed: Optional steps that failed, and why.
        late: A delay that the torques of all joints have in common; the model has it joint by joint.
        events: Stretches of time that took no part, since nothing explains a joint's torque there.
        anatomy: Of each joint the parts of the error of the robot's file, see `anatomy.anatomy`.
    """

    recordings: RecordingSet
    plain: CalibratedModel
    model: CalibratedModel
    findings: tuple[Finding, ...]
    undecided: tuple[Undecided, ...]
    links: tuple[OffLink, ...]
    small: tuple[Finding, ...]
    possible: tuple[Possible, ...]
    refuted: tuple[Finding, ...]
    calibration: tuple[np.ndarray, np.ndarray]
    held_out: tuple[np.ndarray, np.ndarray]
    way: str
    mismatch: tuple[dict[str, Any], ...]
    suggestions: tuple[Suggestion, ...] = ()
    folds: tuple[Fold, ...] = ()
    above_noise: tuple[float, ...] = ()
    idle: tuple[tuple[int, float, float], ...] = ()
    priors: str | None = None
    failed: Mapping[str, str] = field(default_factory=dict)
    late: tuple[Finding, ...] = ()
    events: tuple[Event, ...] = ()
    anatomy: tuple[dict[str, float], ...] = ()

    @property
    def verdict(self) -> str:
        """One of "missing_physics", "nothing_missing" and "cannot_tell"."""
        if not self.findings:
            if self.undecided:
                return "cannot_tell"
            held = any(abs(mean) > FAR * max(float(self.model.noise[j]), spread) for j, mean, spread in self.idle)
            if held or max(self.above_noise, default=0.0) > FAR:
                return "cannot_tell"
            return "missing_physics" if self.links else "nothing_missing"
        contested = all(len(f.rivals) > 3 for f in self.findings if not f.term.effect.black_box)
        named = any(not f.term.effect.black_box for f in self.findings)
        return "cannot_tell" if named and contested else "missing_physics"


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
    stages = Stages(plain_model(recordings), kept, Progress(SHARES, report))
    return _restored(stages.once(CHECK, ResultData, lambda: _made(recordings, priors or Priors(), stages)), recordings, stages)


def _made(recordings: RecordingSet, priors: Priors, stages: Stages) -> ResultData:
    """The result of all stages up to the check on held-out recordings."""
    whole, fitter, every, _ = ready(recordings, priors, stages)
    fitter, plain, some = _begun(fitter, every, stages.start)
    failed = dict[str, str]()
    begin, search, complete, findings, (possible, worse) = _settled(fitter, every, plain, stages)
    named = complete
    complete, findings = by_degree(search, complete, findings)
    if complete is not named:
        complete, findings, more = confirmed(search, begin, complete, findings)
        worse = [*worse, *more]
    large, small = [f for f in findings if f.matters], [f for f in findings if not f.matters]
    large, undecided, as_good = separated(search, complete, large, small, failed)
    findings = [*large, *small]
    folds = repeated(search, begin, findings, stages, failed)
    # what has a value of its own in each recording says nothing of those left out
    judged = joints_made_worse(recordings, folds) - {f.joint for f in findings if f.of_each}
    if gone := [f for f in findings if f.joint in judged]:
        findings, worse = [f for f in findings if f not in gone], [*worse, *gone]
        folds = repeated(search, begin, findings, stages, failed, ", less what is worse")
    kept = tuple(f.term for f in findings)
    final = complete if kept else plain
    if kept and kept != complete.extra:  # some are missing, or in another order
        model = replace(complete.model, terms=(*complete.model.terms[: complete.base], *kept))
        final = fitter.fit(model, complete.links, complete.posterior)
    alone, with_all = (LeftOut(search.neighbours(one)) for one in (begin, final))
    parts = anatomy(alone, with_all, findings, filtered_noise(fitter.data, final.model))
    closest = fitter.closest(final)
    undecided, instead, links = with_links(undecided, search, closest, failed)
    as_good = [*as_good, *instead]
    with noted(failed, "alternative: all effects that are not refuted"):
        as_good = [*beside(fitter, complete, findings, worse, bool(undecided)), *as_good]
    way = "recordings" if len(recordings.recordings) > 1 else "blocks"
    return _assembled(
        recordings,
        whole,
        fitter,
        (plain, final, closest, as_good),
        (findings, undecided, links, possible, worse),
        (way, folds, failed, some, parts),
    )


def _settled(
    fitter: Fitter, every: tuple[Trial, ...], plain: Fitted, stages: Stages
) -> tuple[Fitted, Search, Fitted, list[Finding], tuple[list[Possible], list[Finding]]]:
    """The plain fit and a search under one delay of all torques, that of the model with what predicts; the fit with that, it, and what is
    possible and what does not predict."""
    delay, name = fitter.delay_of(plain), "search"
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
        if abs(delay - last) < ALIKE or name == AGAIN:
            return begin, search, complete, findings, (possible, [*out, *worse])
        name = AGAIN


def _searched(fitter: Fitter, every: tuple[Trial, ...], begin: Fitted, stages: Stages, name: str) -> tuple[Search, State]:
    """A search on all recordings, and its best structure."""
    stages.progress.tell("search")
    moves = itertools.count(1)

    def report(said: str, structures: int) -> None:
        number = next(moves)
        # how many moves there will be is not known before
        stages.progress.tell("search", number / (number + 3), said, structures, "structures")

    search = Search.of(fitter, every, report)

    def made() -> SearchData:
        search.run(begin)
        return SearchData.of(search)

    data = stages.once(name, SearchData, made)
    search = data.search(replace(search, report=lambda *_: None), stages.start)
    return search, search.path[-1]


def ready(
    recordings: RecordingSet, priors: Priors, stages: Stages | None = None
) -> tuple[Sequence[Prepared], Fitter, tuple[Trial, ...], CalibratedModel]:
    """All samples, what fits models to the recordings, the trials of the catalogue, and the plain model to start from."""
    stages = stages or Stages(plain_model(recordings))
    whole, nominal, exact = prepare(recordings), stages.start, priors.exact_inertias
    stages.progress.tell("plain model")

    def first() -> ModelData:
        return ModelData.of(first_estimate(recordings, whole, nominal, exact))

    model = stages.once("plain model", ModelData, first).model(nominal)
    data = data_of(recordings, without_spikes(whole, model), nominal, model, exact)
    seen = view(data.prepared, model)
    # a link whose errors are parameters needs no effect that says the same, and whose result need not be a body
    gone = ("inertial",) if len(data.links.std) else ()
    every = trials(seen, model.torque)
    every = tuple(t for t in every if t.effect.name not in priors.excluded and t.effect.alters not in gone)
    families: dict[tuple, list[Trial]] = {}
    for trial in every:
        families.setdefault((trial.effect.name, trial.effect.joints), []).append(trial)
    return whole, Fitter(data, plain_std(data), seen, families, priors), every, replace(model, robot=nominal.robot)


def _assembled(recordings, whole, fitter: Fitter, fits, told, check) -> ResultData:
    begin, final, closest, as_good = fits
    (findings, undecided, links, possible, refuted), (way, folds, failed, some, parts) = told, check
    near_begin = fitter.closest(begin) if findings else closest
    plain, model = (
        finished(recordings, whole, described(one), {"way": "inverse dynamics"}, perf_counter())
        for one in (near_begin, closest)
    )
    findings = [replace(f, term=t) for f, t in zip(findings, model.terms[final.base :], strict=True)]
    if not findings:
        folds = [replace(f, model=f.plain, after=f.before) for f in folds]
    before, after = map(mean_nrmse, errors_of(folds, fitter.data.n))
    left = above_noise(fitter.data, closest)
    calibration = mean_nrmse(nrmse(fitter.data, plain)), mean_nrmse(nrmse(fitter.data, model))
    others = alternatives(fitter, as_good, model, closest, failed)
    model, suggestions = replace(model, alternatives=others, unexplained=unexplained(fitter.data, closest)), ()
    with noted(failed, "suggested recordings"):
        contested = [*findings, *(u.contested for u in undecided)]
        suggestions = suggest(recordings, plain, contested, bool(np.any(left > FAR)), fitter.view)
        model = replace(model, alternatives=decided(model.alternatives, suggestions))
    return ResultData(
        ModelData.of(plain),
        ModelData.of(model),
        [FindingData.of(f, model.robot) for f in findings if f.matters],
        [FindingData.of(f, model.robot) for f in findings if not f.matters],
        [UndecidedData.of(u, model.robot) for u in undecided],
        tuple(links),
        [FindingData.of(f, model.robot) for f in _late(fitter, closest)],
        tuple(possible),
        [FindingData.of(f, model.robot) for f in refuted],
        tuple(x.tolist() for x in calibration),
        (before.tolist(), after.tolist()),
        way,
        mismatch(fitter.data, begin, final, findings, left, (calibration[0], before)),
        [SuggestionData.of(s) for s in suggestions],
        [FoldData.of(f) for f in folds],
        tuple(left.tolist()),
        idle(fitter.data, final.model),
        fitter.priors.file,
        failed,
        some,
        parts,
    )


def _late(fitter: Fitter, fitted: Fitted) -> list[Finding]:
    """A delay of all joints' torques, if it matters."""
    found = common_delay(fitter, fitted)
    if found is None or found[1].low <= MATTERS:
        return []
    term, fall, p_value = found
    return [Finding(term, 1 - p_value, 1 - p_value, np.nan, p_value, (), None, fall)]


def _restored(data: ResultData, recordings: RecordingSet, stages: Stages) -> Diagnosis:
    """A result with its recordings."""
    plain, model, start = data.plain.model(stages.start), data.model.model(stages.start), stages.start
    told = {name: getattr(data, name) for name in data.__struct_fields__}
    told |= {name: tuple(f.finding(model.robot) for f in told[name]) for name in ("findings", "late", "small", "refuted")}
    told |= {name: tuple(map(np.array, told[name])) for name in ("calibration", "held_out")}
    told |= {name: tuple(told[name]) for name in ("events", "anatomy")}
    told |= {"undecided": tuple(u.undecided(model.robot) for u in data.undecided)}
    told |= {"suggestions": tuple(s.suggestion() for s in data.suggestions), "folds": tuple(f.fold(start) for f in data.folds)}
    return Diagnosis(**told | {"recordings": recordings, "plain": plain, "model": model})


def _begun(fitter: Fitter, every: tuple[Trial, ...], start: CalibratedModel) -> tuple[Fitter, Fitted, list[Event]]:
    """What fits models to all but events, the plain fit, and the events."""
    begin, some = fitter.begin(start), list[Event]()
    while new := [e for e in unlike_laws(Search.of(fitter, every), begin, events(begin)) if e not in some]:
        some += new  # beside large ones others do not show
        fitter = replace(fitter, data=fitter.data.of(without(fitter.data.prepared, start.joints, new)))
        begin = fitter.begin(start)
    return fitter, begin, sorted(some, key=lambda e: (e.joint, e.recording, e.begin))
