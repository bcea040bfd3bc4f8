"""A diagnosis in words: the verdict, a sentence for each finding, and how sure it is.

Everything is made from the content of `diagnosis.json`, typed. The words for an effect are in its own file (`Effect.plain`).
"""

import math
import re
from collections.abc import Mapping, Sequence
from statistics import fmean
from typing import Any

from msgspec import to_builtins

from rrr_oc.calibration.estimator.knobs import CLOCK_ERROR
from rrr_oc.calibration.link_findings import Fallen, OffDirection, OffLink
from rrr_oc.diagnosis import diagnosis_file as file
from rrr_oc.diagnosis.diagnosis_file import DiagnosisFile
from rrr_oc.diagnosis.knobs import CLAIM, MATTERS
from rrr_oc.diagnosis.result import LESS_PROBABLE, LINK_ERRORS
from rrr_oc.effects import CATALOGUE, Delay, Effect
from rrr_oc.effects.words import default_sentence, joint_words, listed, read, rounded, words
from rrr_oc.model.metrics import WORTHLESS

SURE = 0.999  # probability above which no closer number is shown; nearer to 1, digits that no recordings support
# Above both times the error within the fit and this NRMSE, held-out recordings count as badly
# predicted and the verdict says so; doubled, a model that fits too few recordings passes as complete
POOR_RATIO, POOR_NRMSE = 3.0, 0.2
EACH = 3  # joints whose errors the verdict tells one by one; of more it tells the range
SMALL = "The model has this, too, since it lowers an error on data left out, if by little: nothing of it is sure."
DEGREES = {
    "rad": (180 / math.pi, "°"),
    "rad/s": (180 / math.pi, " °/s"),
    "rad/s²": (180 / math.pi, " °/s²"),
}  # by the file's unit
OF_LINKS = (
    ("mass", "a mass of", "kg"),
    ("centre", "its centre of mass at", "m"),
    ("inertia", "an inertia about that of", "kg m²"),
)
ACROSS = 1e-3  # share of a first moment that the description has along it, at most, where it is across the described one
REST, NOISE = "not explained", "noise"
LAST = ("seen, no law", REST, NOISE)  # parts of an error that no law is
SHOWN = 6  # events that are listed
Found = file.Named | file.Unexplained  # what was found on joints
QUANTITIES = {"q": "position", "dq": "speed", "ddq": "acceleration"}  # by the prefix of a variable's name in the file


def sentence(found: DiagnosisFile) -> str:
    """The verdict."""
    if found.verdict == "nothing_missing":
        poor, useless = _unforeseen(found), [worthless(joint, found) for joint in worthless_joints(found)]
        if useless:
            others = f"Of the other joints nothing is missing. {' '.join(useless)}"
            return others if len(useless) < len(found.bootstrap) else f"These recordings tell nothing. {' '.join(useless)}"
        few = f" But it predicts recordings left out of the fit badly ({poor}): these are too few or too short to show more."
        nothing = "Nothing that matters" if found.small else "Nothing"
        return f"{nothing} is missing: the calibrated model explains these recordings to their noise.{few * bool(poor)}"
    if not (missing(found) or found.unexplained):
        if found.verdict == "missing_physics":
            return " ".join(
                [
                    "With other links than described the model explains these recordings to their noise.",
                    *off_links(found.link_findings),
                ]
            )
        return " ".join(undecided(found)) or _undecided(found)
    lacking, gain = listed(_lacking(found)), _gain_held_out(found)
    if found.verdict == "cannot_tell":
        return f"Something is missing, and these recordings do not decide what: {lacking}, or others that do as well.{gain}"
    left = left_over(found)
    if all((e.probability or 1.0) < 0.5 for e in (*missing(found), *found.unexplained)):
        return f"The model predicts better with {lacking}, but of claims like this fewer than half are right.{gain}{f' {left}' * bool(left)}"
    return f"The calibrated model lacks {lacking}.{gain}{f' {left}' * bool(left)}"


def left_over(found: DiagnosisFile) -> str:
    """A sentence on joints whose error is far above the noise with all that was found; nothing where there are none."""
    over = found.left_over
    if not over:
        return ""
    rest = listed([f"{_times(x)} the noise on {joint_words(joint)}" for joint, x in over.items()])
    if len(over) > EACH:
        names = listed([joint_words(joint) for joint in over])
        low, high = (_times(edge(over.values())) for edge in (min, max))
        rest = f"{low.split()[0]} to {high} the noise on {names}"
    return f"What is left is still {rest}: more is missing, or of another shape."


def wanders(found: DiagnosisFile) -> list[str]:
    """A sentence on joints whose error wanders; none where there are none."""
    each = listed([f"{x:.2g} Nm on {joint_words(joint)}" for joint, x in found.wander.items()])
    said = "A part of the error changes over seconds, whatever the arm does, as the zero of a torque sensor that wanders"
    return [f"{said}: {each} (rms). It counts as noise."] if each else []


def _times(ratio: float) -> str:
    return f"{ratio:.{int(ratio < 10)}f} times"


def _undecided(found: DiagnosisFile) -> str:
    """The verdict where something is missing and nothing is claimed: on joints with an error, on joints that never moved, or on both."""
    still = {e.joint for e in found.idle}
    names = [_missed(m, found) for m in found.mismatch if m.significant and m.joint not in still]
    missed = f"Something is missing on {'; on '.join(names)}. These recordings do not decide what it is: nothing was found that explains it."
    moved = "Nothing is missing on the joints that move, and these recordings do not tell of the others." if still else ""
    said = missed if names else moved or "Something is missing, and these recordings do not decide what."
    return " ".join([said, *idle(found)])


def _missed(m: file.Mismatch, found: DiagnosisFile) -> str:
    """A joint with an error, how large that is, and where most of it is."""
    times = found.left_over.get(m.joint)
    size = "far beyond the noise" if times is None else f"{_times(times)} the noise"
    most = next((w for w in m.where if w.variable != "time"), None)
    where = "" if most is None else f", most of it at {place(most)}"
    return f"{joint_words(m.joint)}, where the error is {size}{where}"


def unsaid(lines: Sequence[str], *texts: str) -> list[str]:
    """The lines that none of the texts above them has said already."""
    return [line for line in dict.fromkeys(lines) if not any(line in text for text in texts)]


def events(found: DiagnosisFile) -> list[str]:
    """A sentence on events; none where there are none."""
    each = [
        f"{joint_words(e.joint)} in {e.recording} at {e.begin:.2f} to {e.end:.2f} s ({e.peak:+.2g} Nm)" for e in found.events
    ]
    more = f" and {len(each) - SHOWN} more" * (len(each) > SHOWN)
    what = f"{len(each)} stretch{'es' * (len(each) > 1)} of time took no part, since nothing explains a joint's torque there"
    return (
        [f"{what}, as if it was pushed: {listed(each[:SHOWN]) if not more else ', '.join(each[:SHOWN]) + more}."]
        if each
        else []
    )


def most_like(u: file.Unexplained) -> str:
    """The law that an unexplained torque is most like, in a sentence; nothing where there is none."""
    like = u.most_like
    if not like:
        return ""
    values = [f"{symbol} = {value}" for symbol, value in numbers(like.parameters).items()]
    given = f" ({', '.join(values)})" * bool(values)
    return f"It is most like {called(like.effect)}{given}, which explains {100 * like.reaches:.0f} % of it."


def anatomy(found: DiagnosisFile) -> tuple[list[str], list[list[str]]]:
    """The error of each joint that is left as parts are added to the robot's file, as a table: its header, and a row for each part, in
    percent of the file's. Noise is what would be left at best."""
    joints = list(found.anatomy)
    names = dict.fromkeys(p.part for own in found.anatomy.values() for p in own if p.part not in LAST)
    body = {name: [""] * len(joints) for name in (*names, *LAST) if name != REST}
    for k, own in enumerate(found.anatomy.values()):
        shares, left = {p.part: p.share for p in own}, 1.0
        for name in body:
            if name in shares:
                left -= shares[name]
                body[name][k] = f"{100 * max(shares[name] if name == NOISE else left, 0.0) ** 0.5:.3g}"
    return ["with", *map(joint_words, joints)], [[_part(name), *cells] for name, cells in body.items() if any(cells)]


def _part(name: str) -> str:
    """A part of an error in words."""
    effect, _, joint = name.partition("@")
    known = f"{called(effect)}{f' of {listed(list(map(joint_words, joint.split())))}' * bool(joint)}"
    return known if effect in CATALOGUE else "noise alone" if name == NOISE else name


def measured(measurement: Mapping[str, file.Measured]) -> list[str]:
    """A sentence on the joints whose torques are recorded late or early, as far as the recordings tell; none where there are none."""
    each = [
        f"{joint_words(joint)} by {1e3 * late:.1f} ms ({' to '.join(f'{1e3 * x:.1f}' for x in m.interval)})"
        for joint, m in measurement.items()
        if m.interval and m.interval[0] * m.interval[1] > 0 and abs(late := m.torque_late_s or 0.0) > CLOCK_ERROR
    ]
    return [f"The recorded torque lags the motion, as the model has it: of {listed(each)}."] if each else []


def _gain_held_out(found: DiagnosisFile) -> str:
    """Held-out errors before and after, over all joints that what was found touches; nothing where they are not known."""
    touched = {joint for e in (*missing(found), *found.unexplained) for joint in touches(e, list(found.bootstrap))}
    told = {
        joint: (before, after)
        for joint, b in found.bootstrap.items()
        if joint in touched and b.ratio.value is not None
        if (before := b.before.value) is not None and (after := b.after.value) is not None
    }
    if not told:
        return ""
    if not any(gains(found.bootstrap[joint]) for joint in told):
        return (
            " That changes what the model's numbers mean, not how well it predicts: without it, friction and links take the torque up, and "
            "the error on data left out of the fit is as small."
        )
    left_out = "recordings" if found.held_out != "blocks" else "blocks of the recording"
    better = {joint: pair for joint, pair in told.items() if gains(found.bootstrap[joint])}
    if len(told) > EACH:
        both = list(zip(*told.values(), strict=True))
        means, worst = ([_told_error(of(x)) for x in both] for of in (fmean, max))
        return (
            f" On {left_out} left out of the fit the error of the torque goes from {' to '.join(means)} of its standard deviation, as the mean "
            f"of the {len(told)} joints that this touches, and at the worst of them from {' to '.join(worst)}."
        )
    each = [f"{joint_words(joint)}'s torque goes from {_told_error(a)} to {_told_error(b)}" for joint, (a, b) in better.items()]
    others = listed([joint_words(joint) for joint in told if joint not in better])
    rest = f"; that of {others} does not fall" * (len(better) < len(told))
    return f" On {left_out} left out of the fit the error of {listed(each)} of its standard deviation{rest}."


def gains(errors: file.Bootstrap) -> bool:
    """Whether a joint's error held out falls by a share that matters."""
    ratio = errors.ratio.value
    return ratio is not None and ratio < 1 - MATTERS


def _told_error(value: float) -> str:
    return f"{rounded(100 * value)} %"


def error(entry: file.Mean) -> str:
    """An error held out, as a share of the torque's standard deviation, with its interval."""
    low, high = entry.interval or (None, None)
    if entry.value is None:
        return "an error that is not known"
    if low is None or high is None or low == high:
        return _told_error(entry.value)
    return f"{_told_error(entry.value)} (95 %: {rounded(100 * low)} to {_told_error(high)})"


def share(size: Fallen | file.Share) -> str:
    """By which share an effect lowers an error, with its interval."""
    between = "" if size.interval is None else " (95 %: {:.1f} to {:.1f} %)".format(*(100 * x for x in size.interval))
    return f"{100 * size.share:.1f} %{between}"


def worthless_joints(found: DiagnosisFile) -> list[str]:
    """Joints whose torque the model that is reported explains no better than a constant does."""
    after = found.nrmse.calibration.after
    still = {e.joint for e in found.idle}  # of which more is known
    return [joint for joint, value in after.items() if value is not None and value > WORTHLESS and joint not in still]


def worthless(joint: str, found: DiagnosisFile) -> str:
    """Such a joint in a sentence."""
    nrmse = found.nrmse.calibration.after[joint] or 0.0
    return (
        f"The torque of {joint_words(joint)} is explained no better than by a constant (its error is {rounded(nrmse)} times its standard "
        "deviation): the joint hardly moves here, or its units, signs or columns, gravity, tool or payload are not as declared."
    )


def read_in(unit: str) -> tuple[float, str]:
    """Factor from a unit of the file to the one in which people read it, and that as it stands behind a number."""
    return DEGREES.get(unit, (1.0, f" {unit}" * (unit != "1")))


def place(where: file.PlaceEntry) -> str:
    """A range in which an error is concentrated, in words."""
    factor, unit = read_in(where.unit)
    low, high = (factor * x for x in where.range)
    ends = [rounded(x, (high - low) / 10) for x in (low, high)]
    where_it_is = f"of {rounded(low)}" if ends[0] == ends[1] else f"from {' to '.join(ends)}"
    return (
        f"{variable(where.variable)} {where_it_is}{unit}, with {100 * where.share_of_error:.0f} % of the error in "
        f"{100 * where.share_of_time:.0f} % of the time"
    )


def touches(e: Found, joints: Sequence[str]) -> list[str]:
    """The joints whose torque an effect changes: its own; of a link's body also those that carry it; of the arm all."""
    own, kind = joints_of(e), CATALOGUE.get(getattr(e, "effect", ""))
    known = [joint for joint in own if joint in joints]
    if not known:
        return list(joints)
    if kind is not None and kind.side == "body":
        return list(joints[: max(map(joints.index, known)) + 1])
    return known


def plain(e: file.ClaimEntry | file.MemberEntry) -> str:
    """What was found, in a sentence with number, unit and interval; the recordings that need it, where some do not."""
    files = some_recordings(e)
    only = f" It is needed in {listed(files)}; the other recordings are explained without it."
    return told(e) + only * bool(files)


def told(e: file.ClaimEntry | file.MemberEntry) -> str:
    """What was found, in a sentence with number, unit and interval."""
    kind, joints = CATALOGUE.get(e.effect), [joint_words(joint) for joint in joints_of(e)]
    values = numbers(e.parameters)
    said_itself = {option: getattr(e, option, None) for option in (kind.options if kind else ())}
    values |= {option: value for option, value in said_itself.items() if value is not None}
    said = default_sentence(e.effect, joints, values) if kind is None else kind.sentence(joints, values)
    return said[:1].upper() + said[1:]


def unexplained(u: file.Unexplained) -> str:
    """A torque of which no law is sure, in a sentence."""
    carried = u.description.partition("the model carries it as ")[2]
    some = f" in {listed(some_recordings(u))}" * bool(some_recordings(u))
    head = f"A torque on {joint_words(u.joint)}{some} depends on {depends(u)}, and which law it follows is not sure"
    like = most_like(u)
    return f"{head}{f'; the model carries it as {carried}' * bool(carried)}.{f' {like}' * bool(like)}"


def variable(name: str) -> str:
    """A variable of the file in words: "position of wrist 2" for "q_wrist_2_joint"."""
    sign = re.fullmatch(r"sign\(dq_(.+)\)", name)
    if sign:
        return f"the direction of {joint_words(sign[1])}"
    quantity = re.fullmatch(r"(ddq|dq|q)_(.+)", name)
    return f"the {QUANTITIES[quantity[1]]} of {joint_words(quantity[2])}" if quantity else f"the {words(name)}"


def of_variable(name: str) -> tuple[float, str]:
    """Factor from SI to the unit in which people read a variable of the file, and what is at its axis."""
    units = {"ddq": "rad/s²", "dq": "rad/s", "q": "rad", "load": "Nm", "time": "s"}
    factor, unit = read_in(units[name.split("_")[0]])
    return factor, f"{variable(name).removeprefix('the ')} [{unit.strip()}]"


def depends(u: file.Unexplained) -> str:
    """What an unexplained torque depends on."""
    return listed([variable(name) for name in u.depends_on])


def told_apart(found: DiagnosisFile, names: Sequence[str]) -> str:
    """The effects that a suggested recording tells apart, each with its joints: an effect that was found and its rivals."""
    if not names:
        return "friction and inertia of all joints"
    for e in found.effects:
        if e.effect == names[0] and {r.effect for r in e.rivals} == set(names[1:]):
            return ", ".join(dict.fromkeys([placed(e), *map(placed, e.rivals)]))
    return ", ".join(map(called, names))


def rows(found: DiagnosisFile) -> tuple[list[str], list[list[str]]]:
    """The findings as a table: its header, and a row for each effect."""
    header = [
        "what is missing",
        "recordings",
        "probability",
        "lowers the error of",
        "as good",
    ]
    body = [
        [
            placed(e),
            ", ".join(some_recordings(e)) or e.recordings,
            percent(e.probability),
            lowered(e.lowers_error),
            ", ".join(rivals(e)) or "nothing",
        ]
        for e in missing(found)
    ]
    return header, body


def missing(found: DiagnosisFile) -> list[file.ClaimEntry]:
    """The effects that are physics, not delays of what is recorded."""
    return [e for e in found.effects if not issubclass(CATALOGUE.get(e.effect, Effect), Delay)]


def _unforeseen(found: DiagnosisFile) -> str:
    """The joints whose held-out error is far above the error within the fit, with both."""
    inside, outside = found.nrmse.calibration.before, found.nrmse.held_out.before
    known = [(j, a, b) for j in inside if (a := inside[j]) and (b := outside[j])]
    poor = [(j, a, b) for j, a, b in known if b > max(POOR_RATIO * a, POOR_NRMSE)]
    each = [f"{_told_error(b)} against {_told_error(a)} on {joint_words(j)}" for j, a, b in poor]
    return f"an error of {listed(each)}" * bool(each)


def _lacking(found: DiagnosisFile) -> list[str]:
    """What was found and where, in a few words; effects that only some recordings have are named once for all of them."""
    named = [(placed(e), e) for e in missing(found)]
    named += [(f"a torque on {joint_words(u.joint)} that depends on {depends(u)}", u) for u in found.unexplained]
    files: dict[tuple[str, bool], set[str]] = {}
    for name, entry in named:
        files.setdefault((name, bool(some_recordings(entry))), set()).update(some_recordings(entry))
    return [name + f" in {len(there)} of the recordings" * some for (name, some), there in files.items()]


def on_prior(found: DiagnosisFile) -> list[str]:
    """A sentence for each claim that would not be made, had it been `LESS_PROBABLE` times less probable before the recordings."""
    return [
        f"The claim of {placed(p)} rests on what was believed before: had it been {LESS_PROBABLE:g} times less probable, it would not be made."
        for p in found.priors
        if p.claim_rests_on_prior
    ]


def not_claimed(found: DiagnosisFile) -> list[str]:
    """A sentence each on what is possible and what is not confirmed; none where there is nothing to say."""
    result = []
    if found.possible:
        result.append(f"Possible, not claimed: {_listed(found.possible)}.")
    if found.not_confirmed:
        result.append(
            f"Not confirmed, not claimed: {_listed(found.not_confirmed)}. All recordings together make it probable, but it does "
            "not lower the error of what it was not fitted to."
        )
    return result


def undecided(found: DiagnosisFile) -> list[str]:
    """A sentence on each class of which these recordings do not tell which member is there."""
    result = []
    for one in found.undecided:
        effects = [e for e in one.members if e.effect != LINK_ERRORS[0]]
        each = "; or: ".join(said[:1].lower() + said[1:].rstrip(".") for said in map(plain, effects))
        result.append(f"These recordings do not tell which is so: {each}; or: links are far from the robot's description.")
    return result


def off_links(links: Sequence[OffLink]) -> list[str]:
    """A sentence on each link that is far from the robot's description, by how much that lowers the error, and what does the same."""
    result = []
    for one in links:
        fall, others = _fall(one.lowers_error), one.indistinguishable_from
        or_else = "Either that is so, or it takes up what the model lacks."
        if others is None:
            or_else = (
                "A gain of the torque, a payload, a tilt or a joint's zero may do the same; rrr-oc diagnose says what would."
            )
        elif others:
            or_else = f"Or it is described well, and there is {' or '.join(map(called, others))}: these recordings do not tell."
        result.append(f"{_off(one)}{f' That lowers the error of {fall} on data left out of the fit.' * bool(fall)} {or_else}")
    return result


def if_identified(links: Sequence[OffLink]) -> list[str]:
    """Sentences on how links differ whose bodies are identified, where that explains far more than the described ones do."""
    fall = _fall(links[0].lowers_error) if links else ""
    head = f'Set "inertial" to "identify" in recordings.json: that lowers the error of {fall} on data left out of the fit.'
    return [head, *map(_off, links)] if links else []


def _fall(size: Fallen | None) -> str:
    return lowered(size) if size is not None and size.interval and size.interval[0] > 0 else ""


def _off(one: OffLink) -> str:
    """How a link differs, in a sentence."""
    said = [_direction(d) for d in one.directions]
    said += [
        f"by itself it fits with {how} {_numbers(off.value)} {unit} instead of {_numbers(off.urdf)} {unit}, "
        f"{off.sigmas:.0f} times the usual error"
        for name, how, unit in OF_LINKS
        if (off := getattr(one, name)) is not None
    ]
    return f"The link “{one.link}” is not as the robot's description has it: {'; '.join(said)}."


def _direction(d: OffDirection) -> str:
    """A first moment or an inertia of what turns about a joint, and what the robot's description has."""
    value, urdf, half, unit = d.value, d.urdf, (d.interval[1] - d.interval[0]) / 2, d.unit
    what = f"{words(d.quantity)} of what turns about {joint_words(d.joint)}"
    between = f"{rounded(value, half)} {unit} (95 %: {' to '.join(rounded(x, half) for x in d.interval)})"
    if abs(urdf) < ACROSS * abs(value):
        return f"the {what} has a part of {between} across its direction there"
    more, of = 100 * (value / urdf - 1), 100 * half / abs(urdf)
    digits = int(of < 1)
    return f"the {what} is {between} instead of {rounded(urdf, half)}, {more:+.{digits}f} ± {of:.{digits}f} %"


def _numbers(value: float | Sequence[float]) -> str:
    if isinstance(value, float | int):
        return rounded(value)
    finest = max(map(abs, value)) / 100  # of all components alike
    return f"({', '.join(rounded(x, finest) for x in value)})"


def idle(found: DiagnosisFile) -> list[str]:
    """A sentence on each joint that never moved enough to tell anything."""
    return [
        f"{joint_words(e.joint).capitalize()} never moved: nothing can be told of it. A torque of {e.torque:.3g} Nm is left "
        "there, which an offset of the sensor, a load or dry friction may hold; record motions of this joint."
        for e in found.idle
    ]


def extrapolated(found: DiagnosisFile) -> list[str]:
    """A sentence on the joints whose held-out errors are of motions that the fit had not seen."""
    ranges = found.nrmse.held_out.range
    names = [joint_words(joint) for joint, place in ranges.items() if place == "outside"]
    what = "recordings" if found.held_out == "recordings" else "blocks"
    sentence = (
        f"Some {what} move {listed(names)} at angles or speeds that the others do not reach. Predicted without these, a law has to hold "
        "where it was never fitted, and an error tells less against it."
    )
    return [sentence] * bool(names)


def not_made(found: DiagnosisFile) -> list[str]:
    """A sentence on each optional step that failed."""
    return [f"Not made: {step}, since it failed ({why}); all else stands." for step, why in found.failed.items()]


def _listed(entries: Sequence[file.PossibleEntry | file.Refuted]) -> str:
    some = [f" in {', '.join(files)}" * bool(files) for files in map(some_recordings, entries)]
    named = [f"{placed(e)}{where}" for e, where in zip(entries, some, strict=True)]
    return ", ".join(dict.fromkeys(named))


def same(found: DiagnosisFile) -> bool:
    """Whether the extended model predicts as the plain one, so that it is not shown beside it."""
    return all(b.before == b.after for b in found.bootstrap.values())


def numbers(parameters: Mapping[str, file.EstimateEntry]) -> dict[str, Any]:
    """Estimates and options as people read them, see `effects.words.read`."""
    known = {name: {k: v for k, v in to_builtins(entry).items() if v is not None} for name, entry in parameters.items()}
    return {name: read(entry) for name, entry in known.items()}


def percent(probability: float | None) -> str:
    """A probability; none is shown as certain."""
    if probability is None or math.isnan(probability):
        return "not known"
    if probability > SURE:
        return f"> {100 * SURE:.1f} %"
    return f"{100 * probability:.{int(probability > CLAIM)}f} %"


def lowered(size: Fallen) -> str:
    """By how much an effect lowers the error of a joint, with its interval."""
    return f"{joint_words(size.joint)} by {share(size)}"


def rivals(e: file.ClaimEntry) -> list[str]:
    """What may be there in an effect's place, with its joint where that is another."""
    named = [called(r.effect) if r.joint == e.joint else placed(r) for r in e.rivals]
    return list(dict.fromkeys(named))


def placed(e: file.Named) -> str:
    """An effect and where it is."""
    where = listed([joint_words(joint) for joint in joints_of(e)])
    if is_black_box(e):
        return f"a torque on {where} that no effect explains"
    return called(e.effect) + f" of {where}" * bool(where)


def is_black_box(e: file.Named) -> bool:
    """Whether it stands for a torque that no law explains."""
    kind = CATALOGUE.get(e.effect)
    return kind is not None and kind.role == "black_box"


def called(effect: str) -> str:
    """What people call an effect of this name; one that is not known, by its name with spaces."""
    kind = CATALOGUE.get(effect)
    return words(effect) if kind is None else kind.called()


def joints_of(e: Found) -> list[str]:
    """The joints of an effect or of an unexplained torque, none of what is on the arm as a whole."""
    joint = e.joint
    return [] if joint is None else [joint] if isinstance(joint, str) else list(joint)


def some_recordings(entry: Found) -> Sequence[str]:
    """The recordings that have it, none if all do."""
    recordings = getattr(entry, "recordings", "all")
    return () if isinstance(recordings, str) else recordings
