"""What a report says of each claim, of what stays unexplained, and of what to record next, from the content of `diagnosis.json`."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from rrr_oc.diagnosis.diagnosis_file import ClaimEntry, DiagnosisFile, Unexplained
from rrr_oc.diagnosis.result import LESS_PROBABLE
from rrr_oc.effects.words import joint_words, listed, rounded
from rrr_oc.report import diagnosis_words as say

Claim = ClaimEntry | Unexplained
CONCENTRATED = 1.5  # share of the error over share of the time from which a range tells where a model fails


@dataclass(frozen=True)
class ClaimText:
    """A claim as a report has it.

    Attributes:
        title: What it is and on which joint.
        sentence: What was left out, with number, unit and interval.
        law: The law that was fitted; nothing for what no law explains.
        numbers: What its symbols are, with unit and interval.
        facts: Sentences by their headings.
    """

    title: str
    sentence: str
    law: str
    numbers: str
    facts: tuple[tuple[str, str], ...]


def claims(found: DiagnosisFile, files: Sequence[str]) -> list[ClaimText]:
    """The claims of a diagnosis, most important first, then torques of which no law is sure.

    Args:
        files: All recordings.
    """
    return [
        *(_claim(say.placed(e), say.told(e), e, found, files) for e in say.missing(found)),
        *(
            _claim(f"torque on {joint_words(u.joint)} whose law is not sure", say.unexplained(u), u, found, files)
            for u in found.unexplained
        ),
    ]


def _claim(title: str, sentence: str, e: Claim, found: DiagnosisFile, files: Sequence[str]) -> ClaimText:
    facts = (
        ("Where", _where(e, found, files)),
        ("Rests on", _rests_on(e, found)),
        ("Could also be", _could_be(e)),
        ("On unseen data", _unseen(e, found)),
    )
    law, numbers = "", ""
    if isinstance(e, ClaimEntry):
        law, numbers = e.equation, ", ".join(f"{symbol} = {value}" for symbol, value in say.numbers(e.parameters).items())
    return ClaimText(title[:1].upper() + title[1:], sentence, law, numbers, facts)


def _where(e: Claim, found: DiagnosisFile, files: Sequence[str]) -> str:
    own = [joint_words(joint) for joint in say.joints_of(e)]
    some = say.some_recordings(e)
    every = {1: "the only recording", 2: "both recordings"}.get(len(files), f"all {len(files)} recordings")
    there = f"in {every}"
    if e.recordings == "each":
        there = "in every recording, with a value of its own"
    elif some and len(some) < len(files):
        there = f"in {len(some)} of {len(files)} recordings ({', '.join(some)}); the others are explained without it"
    return f"{f'On {listed(own)}' if own else 'On the arm as a whole'}, {there}.{_concentrated(e, found)}"


def _concentrated(e: Claim, found: DiagnosisFile) -> str:
    """Where the plain model fails most on the claim's joint, if its error is concentrated anywhere."""
    joints = {*say.joints_of(e), e.lowers_error.joint}
    places = [w for m in found.mismatch if m.joint in joints for w in m.where if w.variable != "time"]
    places = [w for w in places if w.share_of_error > CONCENTRATED * w.share_of_time]
    if not places:
        return ""
    most = max(places, key=lambda w: w.share_of_error / max(w.share_of_time, 1e-9))
    return f" The model without it fails most at {say.place(most)}."


def _rests_on(e: Claim, found: DiagnosisFile) -> str:
    either = " or one of its rivals" * (isinstance(e, ClaimEntry) and bool(e.rivals))
    text = (
        f"Probability {say.percent(e.probability)} that it{either} is there: of claims like this one about sealed arms, so many were "
        f"right. It raises the posterior odds by {e.log_odds:.0f} nats."
    )
    prior = next((p for p in found.priors if p.joint == e.joint and p.effect == getattr(e, "effect", None)), None)
    if prior is not None:
        text += f" Before these recordings it was given a probability of {100 * prior.probability:.2g} % ({prior.source})."
    if prior is not None and prior.claim_rests_on_prior:
        text += f" That matters: had it been {LESS_PROBABLE:g} times less probable before, it would not be claimed."
    return text


def _could_be(e: Claim) -> str:
    if isinstance(e, Unexplained):
        return (
            "A law that the catalogue lacks, or a known one in another shape: the model only has a curve through what was recorded, which "
            f"holds in its range alone. {say.most_like(e)}".strip()
        )
    if not e.rivals:
        return "Nothing else of the catalogue explains these recordings as well; a law that the catalogue lacks might."
    others = listed(say.rivals(e))
    return f"{others[:1].upper()}{others[1:]}, which these recordings do not tell apart from it."


def _unseen(e: Claim, found: DiagnosisFile) -> str:
    """By how much the claim lowers the error of a joint that was not fitted, and that joint's error before and after."""
    size, errors = e.lowers_error, found.bootstrap
    joints = [size.joint] if size.joint in errors else [joint for joint in say.touches(e, list(errors)) if joint in errors]
    beside = "other laws that were" if isinstance(e, ClaimEntry) else "else that was"
    text = (
        f"On stretches of some seconds left out of the fit, it lowers the error of {joint_words(size.joint)}'s torque by "
        f"{say.share(size)}, beside all {beside} found. "
    )
    if (fast := size.innovations) and fast.share > size.share:
        text += f"Of what is fast in that error, which nothing before foretells, it explains {say.share(fast)}. "
    told = [
        f"{joint_words(joint)}'s goes from {say.error(errors[joint].before)} to {say.error(errors[joint].after)}"
        for joint in joints[: say.EACH]
    ]
    left_out = "blocks" if found.held_out == "blocks" else "whole recordings"
    text += f"On {left_out} left out, with all that was found, {listed(told)} of the torque's standard deviation."
    if any(say.gains(errors[joint]) for joint in joints):
        return text
    ranges = found.nrmse.held_out.range
    beyond = ", or the law does not hold beyond the angles and speeds that it was fitted to"
    return (
        f"{text} So a model without it predicts such {left_out.split()[-1]} as well: its friction and links take the torque up, and their "
        f"numbers are then wrong{beyond * any(ranges.get(joint) == 'outside' for joint in joints)}."
    )


def remaining(found: DiagnosisFile) -> list[str]:
    """What stays unexplained, in at least one sentence."""
    result = [say.worthless(joint, found) for joint in say.worthless_joints(found)]
    over = say.left_over(found)  # of which the verdict speaks where nothing is claimed
    result += [
        *say.events(found),
        *say.wanders(found),
        *say.idle(found),
        *([over] if over and (say.missing(found) or found.unexplained) else []),
    ]
    silent = {*say.worthless_joints(found), *(e.joint for e in found.idle)}
    left = {joint: b.after.value for joint, b in found.bootstrap.items() if b.after.value is not None and joint not in silent}
    if left:
        each = listed([f"{rounded(100 * x)} % on {joint_words(joint)}" for joint, x in left.items()])
        rest = "" if result or over else " No joint's error is far above its noise."
        result.append(f"Left on data that was not fitted, as a share of the torque's standard deviation: {each}.{rest}")
    return result or ["Nothing was held out, so that what is left on unseen data is not known."]


def small(found: DiagnosisFile) -> tuple[list[str], list[list[str]]]:
    """What the model has, too, though it is small, as a table: header and rows."""
    body = [
        [
            say.placed(e) if say.is_black_box(e) else say.told(e),
            joint_words(e.lowers_error.joint),
            say.share(e.lowers_error),
        ]
        for e in found.small
    ]
    return ["what", "lowers the error of", "by"], body


def record_next(found: DiagnosisFile) -> list[str]:
    """What to record next, in at least one sentence; beside the motions that the diagnosis suggests."""
    result = [
        f"{joint_words(joint)} in other motions, larger and faster, once its units, signs, gravity, tool and payload are checked."
        for joint in say.worthless_joints(found)
    ]
    still = [joint_words(e.joint) for e in found.idle]
    result += [f"Motions of {listed(still)}, which never moved here."] * bool(still)
    left = {**{u.joint: np.inf for u in found.unexplained}, **found.left_over}
    places = {m.joint: [w for w in m.where if w.variable != "time"] for m in found.mismatch if m.joint in left}
    worst = [joint for joint in sorted(places, key=lambda joint: -left[joint]) if places[joint]][: say.EACH]
    if worst:
        where = "; ".join(f"{joint_words(joint)} at {say.place(places[joint][0])}" for joint in worst)
        result.append(
            f"More of where the plain model fails most, slowly and fast and both ways, so that the shape of what is missing shows: {where}."
        )
    doubtful = dict.fromkeys([say.placed(e) for e in (*found.possible, *found.not_confirmed)])
    if doubtful:
        result.append(
            f"Further motions with other speeds and payloads, diagnosed together with these: they decide about {listed(list(doubtful))}."
        )
    check = "the model, extended as said above," if say.missing(found) or found.unexplained else "the calibrated model"
    result.append(
        f"A motion that takes no part here and goes beyond what these recordings cover, to check {check} where it was never fitted: "
        "“rrr-oc excite” plans one within the arm's limits, and “rrr-oc evaluate model.json” with the folder of the new recordings says "
        "how large the error is."
    )
    return result


def covered(joints: Sequence[str], motions: Mapping[str, tuple[np.ndarray, np.ndarray]]) -> tuple[list[str], list[list[str]]]:
    """Angles and speeds of the recordings as a table: header and rows.

    Args:
        motions: Angles [rad] and speeds [rad/s] by joint, each (K,).
    """
    body = []
    for joint in joints:
        q, dq = motions[joint]
        low, high, fast = (float(np.degrees(x)) for x in (np.nanmin(q), np.nanmax(q), np.nanmax(np.abs(dq))))
        body.append([joint_words(joint), f"{round(low)} to {round(high)}°", f"{rounded(fast)} °/s"])
    return ["joint", "angles", "speed up to"], body
