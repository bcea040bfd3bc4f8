"""Diagnosis of a recording set: the plain model, the most probable structure, and one check of the whole on held-out recordings."""

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import astuple, dataclass, field, replace
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
from rrr_oc.diagnosis.classes import separated, with_links
from rrr_oc.diagnosis.effect_size import sized
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
from rrr_oc.diagnosis.held_out import Check, Fold, acts_on, checked, errors_of, nrmse, repeated
from rrr_oc.diagnosis.knobs import MATTERS
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


@dataclass(frozen=True)
class Diagnosis:
    """The result of a diagnosis.

    Attributes:
        recordings: The set.
        plain, model: Without and with the effects that are claimed, fitted to all recordings.
        findings: The effects and black-box terms that are claimed, most important first.
        undecided: Effects that cannot be told from errors of the links.
        links: Links that are far from the URDF's in `model`.
        small: Effects that are as sure, but lower no joint's error by a share that matters; the model does not have them.
        possible: What may be present but is not claimed.
        refuted: What is as sure, but does not lower the error on data that it was not fitted to.
        shares: Contribution of each finding, and of what is small, on held-out recordings.
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
    shares: "Shares"
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

    @property
    def verdict(self) -> str:
        """One of "missing_physics", "nothing_missing" and "cannot_tell"."""
        if not self.findings:
            # what matters and is no claim may be a part of what no law explains
            part = any(f.fall and f.fall.low > MATTERS for f in self.small)
            if self.undecided or part:
                return "cannot_tell"
            held = any(abs(mean) > FAR * max(float(self.model.noise[j]), spread) for j, mean, spread in self.idle)
            if held or max(self.above_noise, default=0.0) > FAR:
                return "cannot_tell"
            return "missing_physics" if self.links else "nothing_missing"
        contested = all(len(f.rivals) > 3 for f in self.findings if not f.term.effect.black_box)
        named = any(not f.term.effect.black_box for f in self.findings)
        return "cannot_tell" if named and contested else "missing_physics"


@dataclass(frozen=True)
class Shares:
    """What each effect contributes on held-out recordings; one entry per effect, NaN where it is not known.

    Attributes:
        share: Fall of the squared residual when the effect is added, relative to the plain model's squared residual.
        before, after: Mean NRMSE of the joints whose torque it changes, without and with it.
    """

    share: tuple[float, ...] = ()
    before: tuple[float, ...] = ()
    after: tuple[float, ...] = ()

    @classmethod
    def of(cls, checks: Sequence[Check], findings: Sequence[Finding], n: int) -> "Shares":
        """From checks in which the findings were added in their order."""
        total = np.sum([c.squares for c in checks], axis=(0, 2))
        errors = [mean_nrmse(np.concatenate([c.errors[k] for c in checks])) for k in range(len(findings) + 1)]
        joints = [acts_on(f.term.effect, n) for f in findings]
        return cls(
            tuple(float((total[k] - total[k + 1]) / max(total[0], 1e-300)) for k in range(len(findings))),
            tuple(float(mean_nrmse(errors[k][j])) for k, j in enumerate(joints)),
            tuple(float(mean_nrmse(errors[k + 1][j])) for k, j in enumerate(joints)),
        )


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
    begin = fitter.begin(stages.start)
    search, at = _searched(fitter, every, begin, stages)
    findings, possible, failed = *found(search, at), dict[str, str]()
    stages.progress.tell("held-out check", 0.2, f"effects checked: {len(findings)}")
    complete = search.completed(at)
    findings = [*moved(findings, at.fitted, complete), *further(search, complete, len(at.fitted.extra))]
    near = search.neighbours(complete)
    findings, rest = sized(near, findings, filtered_noise(fitter.data, complete.model))
    worse = [f for f in rest if f.fall and f.fall.share <= 0]
    small = [f for f in rest if f not in worse]
    findings, undecided, as_good = separated(search, complete, findings, small, failed)
    shares = Shares(*[(np.nan,) * len([*findings, *small])] * 3)
    with noted(failed, "shares of effects"):
        shares = Shares.of(checked(near, [*findings, *small]), [*findings, *small], fitter.data.n)
    folds = repeated(search, begin, findings, stages, failed)
    kept = tuple(f.term for f in findings)
    final = complete if kept else begin
    if kept and kept != complete.extra:  # some are missing, or in another order
        model = replace(complete.model, terms=(*complete.model.terms[: complete.base], *kept))
        final = fitter.fit(model, complete.links, complete.posterior)
    closest = fitter.closest(final)
    undecided, instead, links = with_links(undecided, search, closest, failed)
    as_good = [*as_good, *instead]
    with noted(failed, "alternative: all effects that are not refuted"):
        as_good = [*beside(fitter, complete, findings, worse, bool(undecided)), *as_good]
    small = with_intervals(complete, small)
    way = "recordings" if len(recordings.recordings) > 1 else "blocks"
    return _assembled(
        recordings,
        whole,
        fitter,
        (begin, final, closest, as_good),
        (findings, undecided, links, small, possible, worse),
        (way, shares, folds, failed),
    )


def _searched(fitter: Fitter, every: tuple[Trial, ...], begin: Fitted, stages: Stages) -> tuple[Search, State]:
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

    data = stages.once("search", SearchData, made)
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
    (findings, undecided, links, small, possible, refuted), (way, shares, folds, failed) = told, check
    near_begin = fitter.closest(begin) if findings else closest
    plain, model = (
        finished(recordings, whole, described(one), {"way": "inverse dynamics"}, perf_counter())
        for one in (near_begin, closest)
    )
    findings = [replace(f, term=t) for f, t in zip(findings, model.terms[final.base :], strict=True)]
    if not findings:
        folds = [replace(f, model=f.plain, after=f.before) for f in folds]
    before, after = map(mean_nrmse, errors_of(folds, fitter.data.n))
    left = above_noise(fitter.data, final)
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
        [FindingData.of(f, model.robot) for f in findings],
        [UndecidedData.of(u, model.robot) for u in undecided],
        tuple(links),
        [FindingData.of(f, model.robot) for f in _late(fitter, closest)],
        [FindingData.of(f, model.robot) for f in small],
        tuple(possible),
        [FindingData.of(f, model.robot) for f in refuted],
        astuple(shares),
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
    )


def _late(fitter: Fitter, fitted: Fitted) -> list[Finding]:
    """A delay of all joints' torques, if it matters."""
    found = common_delay(fitter, fitted)
    if found is None or found[1].low <= MATTERS:
        return []
    term, fall, p_value = found
    return [Finding(term, 1 - p_value, 1 - p_value, 0.0, p_value, (), None, fall)]


def _restored(data: ResultData, recordings: RecordingSet, stages: Stages) -> Diagnosis:
    """A result with its recordings."""
    plain, model, start = data.plain.model(stages.start), data.model.model(stages.start), stages.start
    told = {name: getattr(data, name) for name in data.__struct_fields__}
    told |= {name: tuple(f.finding(model.robot) for f in told[name]) for name in ("findings", "late", "small", "refuted")}
    told |= {name: tuple(map(np.array, told[name])) for name in ("calibration", "held_out")}
    told |= {"undecided": tuple(u.undecided(model.robot) for u in data.undecided), "shares": Shares(*data.shares)}
    told |= {"suggestions": tuple(s.suggestion() for s in data.suggestions), "folds": tuple(f.fold(start) for f in data.folds)}
    return Diagnosis(**told | {"recordings": recordings, "plain": plain, "model": model})


def with_intervals(fitted: Fitted, findings: Sequence[Finding]) -> list[Finding]:
    """Findings of a fit with the standard errors and intervals of their terms."""
    terms = {id(t): shown for t, shown in zip(fitted.model.terms, described(fitted).terms, strict=True)} if findings else {}
    return [replace(f, term=terms[id(f.term)]) for f in findings]
