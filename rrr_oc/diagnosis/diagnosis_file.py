"""The diagnosis as data: what `diagnosis.json` holds."""

from collections.abc import Sequence
from typing import Any, Literal

import msgspec
import numpy as np
from msgspec import Struct

from rrr_oc.calibration.calibrated_model import Term
from rrr_oc.calibration.estimator.left_out import Fall
from rrr_oc.calibration.link_findings import Fallen, OffLink, entries
from rrr_oc.diagnosis.claims.dependence import variables
from rrr_oc.diagnosis.findings import named
from rrr_oc.diagnosis.held_out import ranges
from rrr_oc.diagnosis.knobs import FAR
from rrr_oc.diagnosis.result import LINK_ERRORS, Diagnosis, Event, Finding, Undecided, shown_as
from rrr_oc.effects import BlackBox, OfEach
from rrr_oc.effects.words import listed
from rrr_oc.recordings.recording import RecordingSet
from rrr_oc.storage import plain

FORMAT = "rrr_oc-diagnosis/1"
Files = Literal["all", "each"] | tuple[str, ...]  # recordings; "each": all, with another value in each
Joint = str | tuple[str, ...] | None  # one joint, several, or the arm as a whole


class PlaceEntry(Struct, forbid_unknown_fields=True):
    """A range of a variable in which the error of the plain model is concentrated.

    Attributes:
        variable: `q_<joint>`, `dq_<joint>`, `ddq_<joint>`, `load_torque`, `time`, `payload` or `spring_torque`.
        range: Least and greatest value, in `unit`.
        unit: Unit of the variable.
        share_of_error: Of the joint's squared error [1].
        share_of_time: Of the time in which the joint moves [1].
    """

    variable: str
    range: tuple[float, float]
    unit: str
    share_of_error: float
    share_of_time: float


class Errors(Struct, forbid_unknown_fields=True):
    """Error of a joint's torque over the recorded one's standard deviation, by the plain model.

    Attributes:
        calibration: On the recordings that it was calibrated on [1].
        held_out: On recordings that took no part [1].
    """

    calibration: float | None
    held_out: float | None


class Mismatch(Struct, forbid_unknown_fields=True):
    """How the plain model fails on a joint.

    Attributes:
        joint: The joint.
        significant: Whether it fails by more than the noise.
        p_value: Probability of such a failure by chance.
        nrmse: How large the error is.
        where: Up to three ranges in which it is concentrated.
        recordings: Recordings in which it fails.
    """

    joint: str
    significant: bool
    p_value: float
    nrmse: Errors
    where: tuple[PlaceEntry, ...]
    recordings: tuple[str, ...]


class EstimateEntry(Struct, forbid_unknown_fields=True):
    """An estimated parameter, or an option that the effect was found with.

    Attributes:
        value: The estimate, in `unit`; of a vector or a matrix a list; null where every recording has its own.
        std: Its standard error, in the same shape; null for options, and where the recordings do not determine it.
        unit: Its unit; "1" or nothing for none.
        interval: 95 % interval; null as well.
        by_recording: The value, its standard error and interval by recording, where `recordings` is "each".
    """

    unit: str
    value: Any = None
    std: Any = None
    interval: tuple[float, float] | None = None
    by_recording: dict[str, dict[str, Any]] | None = None


class HeldOut(Struct, forbid_unknown_fields=True):
    """Error of a joint's torque over the recorded one's standard deviation, on blocks of some seconds that were left out.

    Attributes:
        held_out_before: Without an effect, beside all other laws; a black-box term beside all else [1].
        held_out_after: With it [1].
    """

    held_out_before: float | None
    held_out_after: float | None


class Named(Struct, forbid_unknown_fields=True):
    """An effect on its joints.

    Attributes:
        effect: Name of the effect.
        joint: The joint it acts on; a list of two for a pair, null for the arm as a whole.
    """

    effect: str
    joint: Joint


class Share(Struct, forbid_unknown_fields=True):
    """A share with its 95 % interval.

    Attributes:
        share: The share [1].
        interval: Of it; null where there is too little data.
    """

    share: float
    interval: tuple[float, float] | None


class Lowered(Fallen):
    """By how much an effect lowers the error of a joint on data that it was not fitted to, beside all other effects.

    Attributes:
        innovations: The same of the error's innovations, what an autoregression does not foresee of it: what is fast and lies under a
            slow disturbance shows there alone.
        of_torque: The larger fall of both, over the standard deviation of the joint's torque [1].
    """

    innovations: Share | None
    of_torque: float | None


class ClaimEntry(Named):
    """An effect that the tool adds to the model.

    Attributes:
        recordings: Recordings that have it.
        equation: Its law.
        parameters: Estimates by parameter.
        p_value: Of its amplitudes being 0, by Wald's test; it decides nothing.
        probability: How often claims like this one are right, it or one of its rivals; null of what is small.
        log_odds: By how much it raises the logarithm of the posterior probability [nats].
        nrmse: Error without and with it.
        lowers_error: Its size, on data that it was not fitted to.
        reaches: Share of what the best flexible function in its place explains that it explains [1]; null where that was not asked.
        indistinguishable_from: Names of the effects that explain these recordings as well.
        rivals: The same with their joints.
        follows: Of friction that grows with a torque: whether that is the load's or the motor's.
    """

    recordings: Files
    equation: str
    parameters: dict[str, EstimateEntry]
    p_value: float
    probability: float | None
    log_odds: float
    nrmse: HeldOut
    lowers_error: Lowered
    reaches: float | None
    indistinguishable_from: tuple[str, ...]
    rivals: tuple[Named, ...]
    follows: Literal["load", "motor"] | None = None


class MemberEntry(Named):
    """An effect of a class that the recordings do not decide in.

    Attributes:
        recordings: Recordings that have it.
        parameters: Estimates by parameter.
    """

    recordings: Files
    parameters: dict[str, EstimateEntry]


class Class(Struct, forbid_unknown_fields=True):
    """Effects and errors of the links, of which one explains a mismatch, and which say different things of the arm.

    Attributes:
        members: The effects, the most probable first, then `link_errors`.
        probability: That one of them is there.
        decided_by: The suggested recording that would decide, as `suggested_recordings[0]`; null where none would.
    """

    members: tuple[MemberEntry, ...]
    probability: float
    decided_by: str | None


class PossibleEntry(Named):
    """An effect that is less probable than a claim needs.

    Attributes:
        recordings: Recordings that may have it.
        probability: Of the effect.
    """

    recordings: Files
    probability: float


class Refuted(Named):
    """An effect that all recordings together make probable, and that parts of them do not confirm.

    Attributes:
        probability: Of the effect, on all recordings.
    """

    probability: float


class Idle(Struct, forbid_unknown_fields=True):
    """A joint that never moved enough to tell anything.

    Attributes:
        joint: The joint.
        torque: Mean torque that no model has there; dry friction may hold it [Nm].
        std: Its standard deviation over the recordings [Nm].
    """

    joint: str
    torque: float
    std: float


class Valid(Struct, forbid_unknown_fields=True):
    """Where an empirical torque holds.

    Attributes:
        variable: As in `where` of `mismatch`.
        range: Least and greatest value that was recorded.
    """

    variable: str
    range: tuple[float, float]


class LikeEntry(Named):
    """A law that a torque is most like.

    Attributes:
        parameters: Its numbers, as they were found in the torque's place.
        reaches: Share of what the best function of the torque's variables explains that the law explains [1].
    """

    parameters: dict[str, EstimateEntry]
    reaches: float


class Unexplained(Struct, forbid_unknown_fields=True):
    """A torque of which no law is sure; the model carries it as an empirical term, or as a law that is too often another.

    Attributes:
        joint: The joint it acts on.
        depends_on: Variables that it depends on, also `sign(dq_<joint>)`.
        recordings: Recordings that have it.
        p_value: As of an effect.
        probability: How often claims like this one are right: that something of this joint depends on these variables.
        log_odds: As of an effect.
        lowers_error: As of an effect.
        most_like: The law of the catalogue that comes closest; null where none comes close.
        parameters: Where `recordings` is "each", its values by recording; else empty.
        validity: Where it holds.
        description: A sentence.
    """

    joint: str
    depends_on: tuple[str, ...]
    recordings: Files
    p_value: float
    probability: float | None
    log_odds: float
    lowers_error: Lowered
    most_like: LikeEntry | None
    parameters: dict[str, EstimateEntry]
    validity: tuple[Valid, ...]
    description: str


class Size(Struct, forbid_unknown_fields=True):
    """Typical size of a parameter.

    Attributes:
        value: The size, in `unit`.
        unit: Its unit, or what it is relative to.
    """

    value: float
    unit: str


class Believed(Named):
    """What was believed of a claimed effect before.

    Attributes:
        probability: Of the effect on one joint of an arm.
        typical: Typical sizes by parameter.
        source: Where these are from.
        claim_rests_on_prior: Whether it would not be claimed with a probability ten times smaller.
    """

    probability: float
    typical: dict[str, Size]
    source: str
    claim_rests_on_prior: bool


class Suggested(Struct, forbid_unknown_fields=True):
    """A motion to record.

    Attributes:
        why: What it would tell.
        separates: Effects that it would tell apart.
        trajectory: CSV file beside this one, with `t` in s and `q_<joint>` in rad.
    """

    why: str
    separates: tuple[str, ...]
    trajectory: str


class BeforeAfter(Struct, forbid_unknown_fields=True):
    """Numbers of the plain and of the extended model.

    Attributes:
        before: Of the plain model, by joint.
        after: With what was found, by joint.
    """

    before: dict[str, float | None]
    after: dict[str, float | None]


class HeldOutErrors(BeforeAfter, forbid_unknown_fields=True):
    """Errors of each joint's torque on what took part in no fit, and whether that is a matter of interpolation.

    Attributes:
        before: Of the plain model [1].
        after: With what was found [1].
        range: Whether what was held out moved where the fit had seen the joint move, by joint. If not, an error tells less of a law.
    """

    range: dict[str, Literal["inside", "outside"]]


class Nrmse(Struct, forbid_unknown_fields=True):
    """Errors of the predicted torque over the recorded one's standard deviation.

    Attributes:
        calibration: On the recordings that the models were fitted to [1].
        held_out: On recordings that took part in no fit and no choice [1].
    """

    calibration: BeforeAfter
    held_out: HeldOutErrors


class Mean(Struct, forbid_unknown_fields=True):
    """A mean over recordings.

    Attributes:
        value: The mean [1].
        interval: 95 % interval from the variation between recordings; null with fewer than three.
    """

    value: float | None
    interval: tuple[float | None, float | None] | None


class Bootstrap(Struct, forbid_unknown_fields=True):
    """Held-out errors of a joint with their intervals.

    Attributes:
        before: Of the plain model.
        after: With what was found.
        ratio: After over before.
    """

    before: Mean
    after: Mean
    ratio: Mean


class SimulatedEntry(Struct, forbid_unknown_fields=True):
    """Errors while the MuJoCo model tracks the recordings with its controllers.

    Attributes:
        held_out: Whether the recordings took no part in the fits.
        before: Of the plain model by joint and signal, or `why_not`, the reason why it was not simulated.
        after: With what was found.
    """

    held_out: bool
    before: dict[str, Any]
    after: dict[str, Any]


class Measured(Struct, forbid_unknown_fields=True):
    """How a joint was measured.

    Attributes:
        torque_late_s: By how much its recorded torque lags its motion [s]; null where the model has no delay.
        interval: 95 % interval of that; null where the recordings do not tell.
        speed_late_s: By how much its recorded speed lags the derivative of its position [s]; null where none was recorded.
        speed_times: How many times that derivative it is [1].
        used: Where speeds come from: the column "dq", the derivative of "q", or both.
    """

    torque_late_s: float | None
    interval: tuple[float, float] | None
    speed_late_s: float | None
    speed_times: float | None
    used: Literal["q", "dq", "q and dq"]


class PartEntry(Struct, forbid_unknown_fields=True):
    """A part of an error.

    Attributes:
        part: What lowers the error: "friction and rotor", "links", an effect as `effect@joint`, "seen, no law"; and what is left: "not
            explained" and "noise".
        share: Of the squared error of the robot's file; negative where the part raises it [1].
    """

    part: str
    share: float


class DiagnosisFile(Struct, forbid_unknown_fields=True):
    """The content of `diagnosis.json`; a number that could not be computed is null, wherever it stands.

    Attributes:
        format: What the file is.
        verdict: Whether physics is missing; it cannot be told where there is a mismatch that no effect explains.
        held_out: What took no part in fits and choices: whole recordings, or blocks of the only one.
        mismatch: Where the plain model fails, a joint each.
        left_over: Joints whose error exceeds the noise with all effects, by how many times [1].
        wander: Joints whose error changes over seconds whatever the arm does, as the zero of a torque sensor, with its rms [Nm].
        effects: Laws that the model has beyond friction and rotors, most important first; and, last, a delay of all torques, which is no
            physics that is missing.
        undecided: Effects that these recordings do not tell from errors of the links; the model does not have them.
        small: What else the model has, though it lowers no joint's error by a share that matters; nothing of it is sure.
        link_findings: Links that are far from the URDF's in the model.
        possible: What is less probable than a claim needs.
        not_confirmed: What is as sure, but does not lower the error on data that it was not fitted to.
        unexplained: Torques of which no law is sure; the model has them.
        events: Stretches of time in which nothing explains a joint's torque, such as pushes; they took no part.
        anatomy: By joint the parts of the squared error of the robot's file, on data left out; the shares add up to 1.
        idle: Joints that never moved enough to tell anything, with the torque that is left there.
        measurement: How each joint was measured.
        priors_file: File that was given by `--priors`.
        priors: What was believed of the claimed effects before.
        suggested_recordings: Motions to record.
        nrmse: Errors of the models.
        versions: Of the programs that made it.
        bootstrap: Held-out errors with intervals, by joint.
        alone: Held-out recordings whose set-up no other recording has.
        simulated: Errors in closed loop.
        failed: Optional steps that failed, and why; all else stands.
    """

    format: Literal["rrr_oc-diagnosis/1"]
    verdict: Literal["missing_physics", "nothing_missing", "cannot_tell"]
    held_out: Literal["recordings", "blocks"]
    mismatch: tuple[Mismatch, ...]
    left_over: dict[str, float]
    wander: dict[str, float]
    effects: tuple[ClaimEntry, ...]
    undecided: tuple[Class, ...]
    small: tuple[ClaimEntry, ...]
    possible: tuple[PossibleEntry, ...]
    not_confirmed: tuple[Refuted, ...]
    unexplained: tuple[Unexplained, ...]
    idle: tuple[Idle, ...]
    link_findings: tuple[OffLink, ...]
    priors_file: str | None
    priors: tuple[Believed, ...]
    suggested_recordings: tuple[Suggested, ...]
    nrmse: Nrmse
    versions: dict[str, str]
    bootstrap: dict[str, Bootstrap]
    alone: tuple[str, ...]
    measurement: dict[str, Measured]
    events: tuple[Event, ...]
    anatomy: dict[str, tuple[PartEntry, ...]]
    simulated: SimulatedEntry | None = None
    failed: dict[str, str] = {}


def to_json(diagnosis: Diagnosis) -> dict[str, Any]:
    """The content of `diagnosis.json`."""
    model, joints = diagnosis.model, diagnosis.model.joints

    def by_joint(pair: tuple[np.ndarray, np.ndarray]) -> dict[str, Any]:
        before, after = (dict(zip(joints, values.tolist(), strict=True)) for values in pair)
        return {"before": before, "after": after}

    anatomy = dict(zip(joints, diagnosis.anatomy, strict=False))

    found = {
        "format": FORMAT,
        "verdict": diagnosis.verdict,
        "held_out": diagnosis.way,
        "mismatch": list(diagnosis.mismatch),
        "left_over": {j: x for j, x in zip(joints, diagnosis.above_noise, strict=False) if x > FAR},
        "wander": {j: x for j, x in zip(joints, diagnosis.wander, strict=False) if x > 0},
        "effects": [_claim(diagnosis, f) for f in (*diagnosis.findings, *diagnosis.late) if f.named],
        "undecided": [_class(diagnosis, u) for u in diagnosis.undecided],
        "small": [_claim(diagnosis, f) | {"probability": None} for f in diagnosis.small],
        "possible": [
            {**named(p.key, joints), "recordings": _files(diagnosis.recordings, p.groups), "probability": p.probability}
            for p in diagnosis.possible
        ],
        "not_confirmed": [{**named(f.key, joints), "probability": f.probability} for f in diagnosis.refuted],
        "unexplained": [_unexplained(diagnosis, f) for f in diagnosis.findings if not (f.named or f.with_function)],
        "events": [msgspec.to_builtins(e) for e in diagnosis.events],
        "anatomy": {j: [{"part": part, "share": x} for part, x in parts.items()] for j, parts in anatomy.items()},
        "measurement": dict(model.report.get("measurement", {})),
        "idle": [{"joint": joints[j], "torque": mean, "std": std} for j, mean, std in diagnosis.idle],
        "link_findings": entries(diagnosis.links),
        "priors_file": diagnosis.priors,
        "priors": [_prior(f, joints) for f in diagnosis.findings if f.prior],
        "suggested_recordings": [
            {"why": s.why, "separates": list(s.separates), "trajectory": f"suggested_{k}.csv"}
            for k, s in enumerate(diagnosis.suggestions, 1)
        ],
        "nrmse": {
            "calibration": by_joint(diagnosis.calibration),
            "held_out": {**by_joint(diagnosis.held_out), "range": ranges(diagnosis.recordings, diagnosis.folds)},
        },
        "versions": dict(model.versions),
        "failed": dict(diagnosis.failed),
    }
    return plain(found)


def _prior(finding: Finding, joints: Sequence[str]) -> dict[str, Any]:
    """What was believed of an effect before, and whether its claim rests on that."""
    prior, units = finding.prior, {p.name: p.unit for p in finding.term.effect.parameters}
    assert prior is not None
    typical = {name: {"value": size, "unit": unit or units.get(name, "")} for name, (size, unit) in prior.typical.items()}
    return {
        **named(finding.key, joints),
        "probability": prior.probability,
        "typical": typical,
        "source": prior.source,
        "claim_rests_on_prior": finding.rests_on_prior,
    }


def _lowered(finding: Finding, joints: Sequence[str]) -> dict[str, Any]:
    assert finding.fall is not None
    fast = None if finding.innovations is None else _share(finding.innovations)
    return {"joint": joints[finding.fall.joint], **_share(finding.fall), "innovations": fast, "of_torque": finding.of_torque}


def _share(fall: Fall) -> dict[str, Any]:
    interval = [fall.low, fall.high] if np.isfinite([fall.low, fall.high]).all() else None
    return {"share": fall.share, "interval": interval}


def _claim(diagnosis: Diagnosis, finding: Finding) -> dict[str, Any]:
    joints, fall = diagnosis.model.joints, finding.fall
    assert fall is not None
    return {
        **named(finding.key, joints),
        "recordings": files_of(finding.term, diagnosis.recordings),
        "equation": finding.term.effect.law,
        **finding.term.effect.said,
        "parameters": _parameters(finding.term, diagnosis.recordings),
        "p_value": finding.p_value,
        "probability": finding.right,
        "log_odds": finding.worth,
        "nrmse": {"held_out_before": fall.before, "held_out_after": fall.before - fall.of_torque},
        "lowers_error": _lowered(finding, joints),
        "reaches": finding.reach,
        "indistinguishable_from": list(dict.fromkeys(name for name, _ in finding.rivals)),
        "rivals": [named(rival, joints) for rival in finding.rivals],
    }


def _class(diagnosis: Diagnosis, u: Undecided) -> dict[str, Any]:
    """An undecided class, with the links last."""
    joints, names = diagnosis.model.joints, {LINK_ERRORS[0], *(t.effect.name for t in u.terms)}
    deciding = [k for k, s in enumerate(diagnosis.suggestions) if set(s.separates) == names]
    members = [
        named(shown_as(t), joints)
        | {"recordings": files_of(t, diagnosis.recordings), "parameters": _parameters(t, diagnosis.recordings)}
        for t in u.terms
    ]
    links = {**named(LINK_ERRORS, joints), "recordings": "all", "parameters": {}}
    return {
        "members": [*members, links],
        "probability": u.probability,
        "decided_by": f"suggested_recordings[{deciding[0]}]" if deciding else None,
    }


def _unexplained(diagnosis: Diagnosis, finding: Finding) -> dict[str, Any]:
    """A torque that a function describes, or a law that is too often another."""
    term, joints = finding.term, diagnosis.model.joints
    beside = [f.term for f in diagnosis.findings if f.with_function and f.term.effect.joints == term.effect.joints]
    every = (pair for one in (term, *beside) for pair in variables(one, len(joints)))
    on = list(dict.fromkeys(_variable(kind, j, joints) for kind, j in every))
    validity = [{"variable": _variable(kind, j, joints), "range": [low, high]} for (kind, j), low, high in term.effect.validity]
    joint, files = joints[finding.joint], files_of(term, diagnosis.recordings)
    some = "" if files in ("all", "each") else f" in {', '.join(files)}"
    laws = f" beside {listed([one.effect.called() for one in beside])}" * bool(beside)
    if isinstance(term.effect, BlackBox):
        joint, said = joints[term.effect.joints[0]], term.effect.words(term.named)
        like = finding.like and _like(diagnosis, finding.like.term, finding.like.reach)
    else:
        said, like = term.effect.called(), _like(diagnosis, term, 1.0 if finding.reach is None else finding.reach)
    return {
        "joint": joint,
        "depends_on": on,
        "recordings": files,
        "p_value": finding.p_value,
        "probability": finding.right,
        "log_odds": finding.worth,
        "lowers_error": _lowered(finding, joints),
        "most_like": like,
        "parameters": _parameters(term, diagnosis.recordings) if files == "each" else {},
        "validity": validity,
        "description": f"a torque on {joint}{some} that depends on {' and '.join(on)} and of which no law is sure; "
        f"the model carries it as {said}{laws}{', valid in the ranges given' if validity else ''}",
    }


def _like(diagnosis: Diagnosis, term: Term, reach: float) -> dict[str, Any]:
    own = named(shown_as(term), diagnosis.model.joints)
    return {**own, "parameters": _parameters(term, diagnosis.recordings), "reaches": reach}


def _variable(kind: str, j: int, joints: Sequence[str]) -> str:
    if kind in ("load", "motor"):
        return "load_torque"
    if kind in ("time", "payload"):
        return kind
    if kind == "spring":
        return "spring_torque"
    return f"sign(dq_{joints[j]})" if kind == "sign" else f"{kind}_{joints[j]}"


def files_of(term: Term, recordings: RecordingSet) -> str | list[str]:
    """The recordings that have an effect, as in the file."""
    if isinstance(term.effect, OfEach) and term.effect.each:
        return "each"
    if term.recordings == "all":
        return "all"
    return [r.file for r in recordings.recordings if term.holds_for(r)]


def _files(recordings: RecordingSet, groups: Sequence[str]) -> str | list[str]:
    return [r.file for r in recordings.recordings if r.group in groups] if groups else "all"


def _parameters(term: Term, recordings: RecordingSet) -> dict[str, Any]:
    """Values with standard errors and intervals; the components of a vector or matrix under one name."""
    if isinstance(term.effect, OfEach) and term.effect.each:
        by_group = dict(zip(term.effect.each, term.estimates, strict=True))
        each = {r.file: by_group[r.group] for r in recordings.recordings if r.group in by_group}
        shown = {
            file: {"value": e.value, "std": e.std, "interval": e.interval and list(e.interval)} for file, e in each.items()
        }
        return {term.effect.of_all.name: {"unit": term.effect.of_all.unit, "by_recording": shown}}
    by_name = {p.name: (e.value, e.std, p.unit) for p, e in zip(term.effect.parameters, term.estimates, strict=True)}
    result: dict[str, Any] = {
        shown: {"value": _nested(names, by_name, 0), "std": _nested(names, by_name, 1), "unit": by_name[_first(names)][2]}
        for shown, names in term.effect.composed.items()
    }
    if result:
        return result
    for p, e in zip(term.effect.parameters, term.estimates, strict=True):
        result[p.name] = {"value": e.value, "std": e.std, "unit": p.unit, "interval": e.interval and list(e.interval)}
    result |= term.effect.derived({name: (value, std) for name, (value, std, _) in by_name.items()})
    for option in term.effect.options:
        if option in term.effect.said:
            continue  # it stands in the entry itself
        value = getattr(term.effect, option)
        result[option] = {"value": list(value) if isinstance(value, tuple) else value, "std": None, "unit": ""}
    return result


def _nested(names: Any, by_name: dict[str, tuple[Any, ...]], column: int) -> Any:
    """One column of the parameters' data in the nesting of their names."""
    return by_name[names][column] if isinstance(names, str) else [_nested(n, by_name, column) for n in names]


def _first(names: Any) -> str:
    return names if isinstance(names, str) else _first(names[0])
