"""The stages of a diagnosis: how far it is, and what each has found as plain data, from which an interrupted diagnosis goes on.

The data are in the terms of model.json: effects on joints, values, intervals, recordings. A diagnosis that nobody interrupts goes on
with what it reads back, too (`rrr_oc.kept`), so that both end in the same numbers.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import msgspec
import numpy as np
from msgspec import Struct

from rrr_oc.calibration.calibrated_model import CalibratedModel
from rrr_oc.calibration.estimator.data import Data, Noise
from rrr_oc.calibration.estimator.evidence import Hyperparameters, Joint, Start
from rrr_oc.calibration.link_findings import OffLink
from rrr_oc.calibration.model_file import (
    AlternativeEntry,
    TermEntry,
    alternative_entry,
    alternative_of,
    effect_of,
    options_of,
    spread_entry,
    spread_of,
    term_entry,
    term_of,
    terms_of,
)
from rrr_oc.diagnosis.events import Event
from rrr_oc.diagnosis.findings import Fall, Finding, Like, Possible, Undecided
from rrr_oc.diagnosis.fitting import Fitter
from rrr_oc.diagnosis.structures.search import Search, State
from rrr_oc.diagnosis.suggestion import Suggestion
from rrr_oc.effects.base import Prior
from rrr_oc.kept import Kept, known, save
from rrr_oc.model.motion import Motion
from rrr_oc.progress import Progress
from rrr_oc.recordings.recording import Recording
from rrr_oc.robot.robot import Robot
from rrr_oc.schema import built
from rrr_oc.storage import number, plain

# Share of the time of a diagnosis that each stage takes, by experience
SHARES = {
    "plain model": 0.06,
    "search": 0.5,
    "held-out check": 0.15,
    "search without parts": 0.2,
    "tracking": 0.08,
    "report": 0.01,
}
MOST = 1e300  # of a score; JSON has no infinity
Scores = list[tuple[list[int], float]]  # effects of a structure, by their numbers, and its score [nats]
S = TypeVar("S", bound=Struct)


@dataclass(frozen=True)
class Stages:
    """What a diagnosis has done so far.

    Attributes:
        start: The model that calibration starts from.
        kept: Where it is kept; None where it is not.
        progress: Is told how far it is.
    """

    start: CalibratedModel
    kept: Kept | None = None
    progress: Progress = field(default_factory=lambda: Progress(SHARES))

    def saved(self, name: str, schema: type[S]) -> S | None:
        """A stage that is there already."""
        found = None if self.kept is None else known(self.kept, name)
        return None if found is None else built(found, schema)

    def keep(self, name: str, content: S) -> S:
        """Save a stage; as it is read back."""
        data = plain(msgspec.to_builtins(content, enc_hook=lambda scalar: scalar.item()))  # of numpy
        result = built(data, type(content))  # before it is saved, so that nothing is that could not be read
        if self.kept is not None:
            save(self.kept, name, data)
        return result

    def once(self, name: str, schema: type[S], make: Callable[[], S]) -> S:
        """A stage that is there already, or is made and saved."""
        found = self.saved(name, schema)
        return self.keep(name, make()) if found is None else found


class ModelData(Struct):
    """What a diagnosis changes of a model: its effects, its links (10, n), noise and errors, and what is not known of it."""

    effects: list[TermEntry]
    inertial: list[list[float]]
    noise: list[float]
    nrmse: list[float]
    report: dict[str, Any]
    spread: list[list[float]] | None = None
    alternatives: list[AlternativeEntry] = []
    unexplained: list[float] | None = None

    @classmethod
    def of(cls, model: CalibratedModel) -> "ModelData":
        robot = model.robot
        links, errors = robot.inertial.tolist(), (model.noise.tolist(), model.nrmse.tolist())
        left = None if model.unexplained is None else model.unexplained.tolist()
        unknown = spread_entry(model.spread), [alternative_entry(one) for one in model.alternatives], left
        return cls([term_entry(t, robot) for t in model.terms], links, *errors, dict(model.report), *unknown)

    def model(self, start: CalibratedModel) -> CalibratedModel:
        """The model with what it has in common with others from `start`."""
        robot = replace(start.robot, inertial=np.array(self.inertial))
        errors = {"noise": np.array(self.noise), "nrmse": np.array(self.nrmse)}
        terms = terms_of(self.effects, robot)
        own = replace(
            start, robot=robot, terms=terms, report=self.report, spread=spread_of(self.spread, terms, robot), **errors
        )
        left = None if self.unexplained is None else np.array(self.unexplained)
        return replace(own, alternatives=tuple(alternative_of(one, own) for one in self.alternatives), unexplained=left)


class NoiseData(Struct):
    """The noise of a joint, see `data.Noise`, and what its rows count in it, see `evidence.Joint`."""

    filters: list[list[float]]
    spreads: list[float]
    turning: float
    freedom: float | None  # of Student's distribution; None where it is normal
    weights: list[float]
    log_det: float

    @classmethod
    def of(cls, data: Data, j: int, one: Joint) -> "NoiseData":
        noise, weights = one.noise, one.weights(data, j).tolist()
        filters, spreads = [f.tolist() for f in noise.filters], noise.spreads.tolist()
        return cls(filters, spreads, noise.turning, number(one.freedom), weights, one.log_det)

    def joint(self, data: Data, j: int) -> Joint:
        noise = Noise(tuple(np.array(f) for f in self.filters), np.array(self.spreads), self.turning)
        freedom = np.inf if self.freedom is None else self.freedom
        return Joint.weighted(data, j, noise, freedom, np.array(self.weights), self.log_det)


class Sought(Struct):
    """An effect in some set-ups (none: in all), as structures are compared by it; further ones of a structure are numbered."""

    effect: str
    joints: tuple[int, ...]
    options: dict[str, Any]
    groups: tuple[str, ...]
    number: int = 1


class StateData(Struct):
    """A structure, fitted.

    Attributes:
        model, links: The model, and the errors of its links in standard deviations of their prior.
        score: Logarithm of its posterior probability, up to a constant.
        noise, sigma, discrepancy, links_over_declared: What is estimated beside the parameters, see `evidence.Hyperparameters`.
    """

    model: ModelData
    links: list[float]
    score: float
    noise: list[NoiseData]
    sigma: list[float]
    discrepancy: list[float]
    links_over_declared: list[float]

    @classmethod
    def of(cls, at: State) -> "StateData":
        post, model = at.fitted.posterior, ModelData.of(at.fitted.model)
        noise, hyper = [NoiseData.of(post.data, j, one) for j, one in enumerate(post.joints)], post.hyper
        measured = hyper.sigma.tolist(), hyper.discrepancy.tolist(), hyper.links.tolist()
        return cls(model, at.fitted.links.tolist(), float(at.score), noise, *measured)

    def state(self, fitter: Fitter, start: CalibratedModel) -> State:
        """The structure under the hyperparameters that were estimated."""
        joints = tuple(one.joint(fitter.data, j) for j, one in enumerate(self.noise))
        noise = tuple(one.noise for one in joints)
        begin = Start(
            Hyperparameters(noise, np.array(self.sigma), np.array(self.discrepancy), np.array(self.links_over_declared)), joints
        )
        return State(fitter.fit(self.model.model(start), np.array(self.links), begin, fixed=True), self.score)


class SearchData(Struct):
    """The structures that a search accepted, and the scores of all others.

    Attributes:
        path: The structures, the best last.
        sought: All effects that were tried.
        fitted, predicted: Logarithm of the posterior probability of structures that were fitted, and of further ones as predicted.
    """

    path: list[StateData]
    sought: list[Sought]
    fitted: Scores
    predicted: Scores

    @classmethod
    def of(cls, search: Search) -> "SearchData":
        number = dict[tuple[Any, ...], int]()
        every = [_scores(known, number) for known in (search.visited, search.predicted)]
        sought = [Sought(e.name, e.joints, options_of(e), groups, *more) for e, groups, *more in number]
        return cls([StateData.of(at) for at in search.path], sought, *every)

    def search(self, search: Search, start: CalibratedModel) -> Search:
        """The search with what it remembers."""
        own = [(effect_of(s.effect, s.joints, s.options), s.groups, *([s.number] if s.number > 1 else [])) for s in self.sought]
        fitted, predicted = (
            {frozenset(own[k] for k in some): score for some, score in of} for of in (self.fitted, self.predicted)
        )
        path = [one.state(search.fitter, start) for one in self.path]
        return replace(search, visited=fitted, predicted=predicted, path=path)


def _scores(known: Mapping[frozenset, float], number: dict[tuple[Any, ...], int]) -> Scores:
    """Scores of structures in their order; effects that have no number get one."""
    result = []
    for structure, score in known.items():
        some = [number.setdefault(one, len(number)) for one in sorted(structure, key=repr)]
        result.append((some, float(np.clip(score, -MOST, MOST))))
    return result


@dataclass(frozen=True)
class Fold:
    """What was found without some of the recordings, and the errors on them.

    Attributes:
        held: Indices of the held-out recordings (of the blocks of a single recording).
        plain, model: Without and with the effects that a search on the rest finds, fitted to the rest.
        before, after: Their NRMSE on the held-out recordings, each (number held out, n).
    """

    held: tuple[int, ...]
    plain: CalibratedModel
    model: CalibratedModel
    before: np.ndarray
    after: np.ndarray


class FoldData(Struct):
    """See `Fold`."""

    held: tuple[int, ...]
    plain: ModelData
    model: ModelData
    before: list[list[float]]
    after: list[list[float]]

    @classmethod
    def of(cls, fold: Fold) -> "FoldData":
        models = ModelData.of(fold.plain), ModelData.of(fold.model)
        return cls(fold.held, *models, fold.before.tolist(), fold.after.tolist())

    def fold(self, start: CalibratedModel) -> Fold:
        models = self.plain.model(start), self.model.model(start)
        return Fold(self.held, *models, np.array(self.before), np.array(self.after))


class FindingData(Struct):
    """See `findings.Finding`."""

    term: TermEntry
    probability: float
    alone: float
    worth: float
    p_value: float
    rivals: tuple[tuple[str, tuple[int, ...]], ...]
    prior: Prior | None
    fall: Fall | None
    innovations: Fall | None
    like: tuple[TermEntry, float] | None
    reach: float | None
    with_function: bool

    @classmethod
    def of(cls, f: Finding, robot: Robot) -> "FindingData":
        like = f.like and (term_entry(f.like.term, robot), f.like.reach)
        numbers = f.probability, f.alone, f.worth, f.p_value
        return cls(
            term_entry(f.term, robot), *numbers, f.rivals, f.prior, f.fall, f.innovations, like, f.reach, f.with_function
        )

    def finding(self, robot: Robot) -> Finding:
        numbers, like = (
            (self.probability, self.alone, self.worth, self.p_value),
            self.like and Like(term_of(self.like[0], robot), self.like[1]),
        )
        return Finding(
            term_of(self.term, robot),
            *numbers,
            self.rivals,
            self.prior,
            self.fall,
            self.innovations,
            like,
            self.reach,
            self.with_function,
        )


class UndecidedData(Struct):
    """See `findings.Undecided`."""

    terms: list[TermEntry]
    probability: float

    @classmethod
    def of(cls, u: Undecided, robot: Robot) -> "UndecidedData":
        return cls([term_entry(t, robot) for t in u.terms], u.probability)

    def undecided(self, robot: Robot) -> Undecided:
        return Undecided(tuple(term_of(t, robot) for t in self.terms), self.probability)


class SuggestionData(Struct):
    """See `suggestion.Suggestion`; motions of (n, K)."""

    why: str
    separates: tuple[str, ...]
    t: list[float]
    motion: list[list[list[float]]]
    payload: list[float]

    @classmethod
    def of(cls, s: Suggestion) -> "SuggestionData":
        m = s.motion
        return cls(s.why, s.separates, m.t.tolist(), np.array([m.q, m.dq, m.ddq]).tolist(), m.payload.tolist())

    def suggestion(self) -> Suggestion:
        motion = Motion(np.array(self.t), *np.array(self.motion), payload=np.array(self.payload))
        return Suggestion(self.why, self.separates, Recording.planned("suggested", motion))


class ResultData(Struct):
    """See `procedure.Diagnosis`."""

    plain: ModelData
    model: ModelData
    findings: list[FindingData]
    small: list[FindingData]
    undecided: list[UndecidedData]
    links: tuple[OffLink, ...]
    late: list[FindingData]
    possible: tuple[Possible, ...]
    refuted: list[FindingData]
    calibration: tuple[list[float], ...]
    held_out: tuple[list[float], ...]
    way: str
    mismatch: tuple[dict[str, Any], ...]
    suggestions: list[SuggestionData]
    folds: list[FoldData]
    above_noise: tuple[float, ...]
    idle: tuple[tuple[int, float, float], ...]
    priors: str | None
    failed: dict[str, str]
    events: list[Event]
    anatomy: list[dict[str, float]]
