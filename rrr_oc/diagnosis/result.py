"""What a diagnosis finds, as it is computed, kept, written and shown."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from msgspec import Struct

from rrr_oc.calibration.calibrated_model import CalibratedModel, Term
from rrr_oc.calibration.estimator.knobs import DISCREPANCY
from rrr_oc.calibration.estimator.left_out import Fall
from rrr_oc.calibration.link_findings import OffLink
from rrr_oc.diagnosis.knobs import CLAIM, FAR, LIKELY, MATTERS
from rrr_oc.effects import OfEach
from rrr_oc.effects.base import Prior
from rrr_oc.recordings.recording import Recording, RecordingSet

LESS_PROBABLE = 10.0  # times that an effect may be less probable beforehand before its claim is said to rest on that
Key = tuple[str, tuple[int, ...]]  # name and joints of an effect, by which it is shown
LINK_ERRORS: Key = ("link_errors", ())  # as the links stand among what an effect cannot be told from


def shown_as(term: Term) -> Key:
    """Name and joints of a term's effect."""
    return term.effect.name, term.effect.joints


@dataclass(frozen=True)
class Like:
    """A law that a torque is most like.

    Attributes:
        term: The law.
        reach: Share of what the best function of the same variables explains that it explains.
    """

    term: Term
    reach: float


@dataclass(frozen=True)
class Finding:
    """An effect that the plain model lacks.

    Attributes:
        term: The effect as a term of the extended model.
        probability: That it or one of its rivals is present.
        worth: Fall of the log posterior probability without it [nats].
        p_value: Of its amplitudes being 0 (Wald's test).
        rivals: Names and joints of effects that may be present in its place.
        prior: What was believed of it before: its declared or given prior with the probability that it has on this arm.
        fall: By how much it lowers the error of a joint on data that it was not fitted to.
        innovations: The same of the error's innovations, which a slow disturbance does not hide.
        like: Of a black-box term: the law that it is most like.
        reach: Of a law: share of what the best flexible function in its place explains that it explains; None where that was not asked.
        with_function: Whether it is told with a function beside it: a law that this torque is most like, or one more function of the same
            variables.
        right: How often claims like this one are right; None of what is no claim of its own.
        named: Whether it is claimed as this law; else only that a torque on its joint depends on its variables.
    """

    term: Term
    probability: float
    worth: float
    p_value: float
    rivals: tuple[Key, ...] = ()
    prior: Prior | None = None
    fall: Fall | None = None
    innovations: Fall | None = None
    like: Like | None = None
    reach: float | None = None
    with_function: bool = False
    right: float | None = None
    named: bool = False

    @property
    def joint(self) -> int:
        """Where it is surest."""
        assert self.fall is not None
        return self.fall.joint

    @property
    def of_torque(self) -> float:
        """By how much the error or its innovations fall, over the joint's torque."""
        return max((f.of_torque for f in (self.fall, self.innovations) if f), default=0.0)

    @property
    def matters(self) -> bool:
        """Whether it lowers the error of a joint, or the error's innovations, by a share that matters; a function by more than the best law
        may be wrong."""
        least = DISCREPANCY if self.term.effect.black_box else 0.0
        return any(f.share >= MATTERS and f.explained >= least for f in (self.fall, self.innovations) if f)

    @property
    def of_each(self) -> bool:
        """Whether it has another value in each recording."""
        return isinstance(self.term.effect, OfEach) and bool(self.term.effect.each)

    @property
    def key(self) -> Key:
        """Name and joints."""
        return shown_as(self.term)

    @property
    def rests_on_prior(self) -> bool:
        """Whether it would not be claimed, had its odds beforehand been `LESS_PROBABLE` times lower.

        Posterior odds are prior odds times the Bayes factor, so that they would be lower by as much.
        """
        return self.probability * (1 - CLAIM) < LESS_PROBABLE * CLAIM * (1 - self.probability)


@dataclass(frozen=True)
class Undecided:
    """Effects of which one, or else errors of the links, explains a mismatch; they say different things of the arm.

    Attributes:
        terms: The effects, the most probable first.
        probability: That one of all these is there.
    """

    terms: tuple[Term, ...]
    probability: float

    @property
    def contested(self) -> Finding:
        """The first effect with the others as its rivals."""
        rivals = (*map(shown_as, self.terms[1:]), LINK_ERRORS)
        return Finding(self.terms[0], self.probability, 0.0, 1.0, rivals)


@dataclass(frozen=True)
class Possible:
    """An effect that may be present but is not claimed."""

    key: Key
    groups: tuple[str, ...]
    probability: float


@dataclass(frozen=True)
class Suggestion:
    """A motion to record, why (in words), and the names of the effects that it separates."""

    why: str
    separates: tuple[str, ...]
    motion: Recording


class Event(Struct, frozen=True, rename={"begin": "from", "end": "to"}):
    """A stretch of time in which a joint's torque is not explained by anything.

    Attributes:
        joint: The joint.
        recording: File of the recording.
        begin: Time in the file at which it begins [s].
        end: Time in the file at which it ends [s].
        peak: Largest error of the plain model, smoothed as its rows are [Nm].
    """

    joint: str
    recording: str
    begin: float
    end: float
    peak: float


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
        above_noise: Residual of the final model, less what of it wanders, over noise, (n,).
        wander: Rms of what of each joint's residual changes over seconds whatever the arm does, where that is far above noise, else 0, (n,)
            [Nm].
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
    wander: tuple[float, ...] = ()
    idle: tuple[tuple[int, float, float], ...] = ()
    priors: str | None = None
    failed: Mapping[str, str] = field(default_factory=dict)
    late: tuple[Finding, ...] = ()
    events: tuple[Event, ...] = ()
    anatomy: tuple[dict[str, float], ...] = ()

    @property
    def verdict(self) -> str:
        """One of "missing_physics", "nothing_missing" and "cannot_tell": so where nothing explains an error, or none of the claims is right
        more often than not."""
        if not self.findings:
            if self.undecided:
                return "cannot_tell"
            held = any(abs(mean) > FAR * max(float(self.model.noise[j]), spread) for j, mean, spread in self.idle)
            if held or max(self.above_noise, default=0.0) > FAR:
                return "cannot_tell"
            return "missing_physics" if self.links else "nothing_missing"
        contested = all(len(f.rivals) > 3 for f in self.findings if not f.term.effect.black_box)
        laws = any(not f.term.effect.black_box for f in self.findings)
        sure = self.links or any(f.right is not None and f.right >= LIKELY for f in self.findings)
        return "missing_physics" if sure and not (laws and contested) else "cannot_tell"
