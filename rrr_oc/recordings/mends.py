"""Which mistakes in columns, or in the robot's file, would explain the torques of a recording set: hypotheses, and the choice among them.

A hypothesis is believed only if it mends every joint whose torque is poorly explained. Of those that do, the one with the least errors
and the fewest mistakes is said, beside the others that are about as good.
"""

import itertools
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rrr_oc.recordings.comparison import Comparison, Reading
from rrr_oc.recordings.header import EFFORTS
from rrr_oc.recordings.plausibility import DEGREES
from rrr_oc.recordings.recording import RecordingSet

LEAST_ERROR = 0.03  # NRMSE below which smaller is no better: what smoothing leaves; doubled, mends of small errors are missed
BAD, BETTER, GOOD = (
    0.5,
    0.5,
    0.35,
)  # a joint above the first is poor; a mend leaves the second's share, and no more than the last
FAIR = 0.7  # share that signs of several poor joints may leave of each, and NRMSE unless it was `AGAINST`; at 1, springs look like mistakes
AGAINST = 1.2  # NRMSE from which a torque contradicts the arm, whatever physics is missing; at 1, missing springs do
SPOILT = 1.5  # times its error that a joint may have with a mend; doubled, mends of one joint at the cost of another pass
SURE = 2.5  # fall of the summed logarithms with which a mend is for any error; at 1.5, an arm with a missing spring gets one
WORTH = 0.7  # fall of the summed logarithms of the errors that a mistake must explain: a factor of two; doubled, one of four
CLEAR, CLEAN = 1.2, 0.1  # or fall by the first, if no joint's error is above the second; doubled, missing physics gets mends
RIVAL = 0.7  # by which these sums, with `WORTH` for each mistake, may differ between rivals; doubled, more of them are told
MOST_RIVALS = 3  # that are told; doubled, a sentence takes two lines more
SCALES = (1 / 8, 8.0)  # a torque so much smaller or larger than the arm's is in another unit; at 3, a missing payload is one
NEARER = (0.5, 2.0)  # and so where nothing else is left; doubled, gains are left to the diagnosis
ALIKE = 0.2  # by which factors of all joints may differ that have one cause; doubled, heavy payloads look like a unit
UNITS = {1e3: "mNm", 1e2: "Ncm", 9.80665: "kgf m", 980.665: "gf m", 98.0665: "kgf cm", 1e-3: "kNm", 0.112985: "in lbf"}
ANGLES = {  # what positions are multiplied by
    DEGREES: "angles in rad that were taken for degrees",
    1 / DEGREES: "angles in degrees",
    2 * np.pi: "angles in turns",
}
GEARS = {1 / n: f"angles before a gear of 1:{n}" for n in (2, 3, 4, 5, 6, 8, 10, 20, 50, 100)}  # of one joint
MASSES = {0.45359: "lb", 1e-3: "g", 0.10197: "N"}  # of payloads, over a kg
ZEROS = np.radians([-180, -150, -120, -90, -60, -45, -30, -15, 15, 30, 45, 60, 90, 120, 150])  # that are tried first
LEAST_ANGLE, MOST_ANGLE = 0.2, 13.0  # [rad] between which the largest angle of recordings lies; two turns
FINER = np.radians([10, 5, 2, 1, 0.5])  # steps by which the best of them is moved
LEAST_ZERO = np.radians(3)  # that is said; smaller ones are the diagnosis' to find
LEAST_SHIFT = 0.03  # [m] by which a zero moves the centre of what turns: a file's error of three usual deviations; doubled, large zeros pass
WEIGHT = (0.5, 2.0)  # a link's mass over the file's between which it is left to the diagnosis
UNITS_OF_GAINS = {1 / DEGREES: "Nm/°"}
SIDES = {"x": 0, "y": 1, "z": 2}


@dataclass(frozen=True, eq=False)
class Mistake:
    """One mistake.

    Attributes:
        kind: "sign", "order", "unit", "coupling" or "zero" of columns, "payload", or "robot" of the robot's file and mounting.
        columns: That it is about.
        said: A sentence with the mend.
        joint: The joint whose error shows it; None for the worst of all.
    """

    kind: str
    columns: tuple[str, ...]
    said: str
    joint: int | None = None


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """Mistakes that would explain the torques.

    Attributes:
        mistakes: One or more.
        after: NRMSE of each joint without them, (n,).
        reading: Of the columns without them; None where the robot's file is mistaken.
        equals: Other causes that no recording of these columns tells from it.
    """

    mistakes: tuple[Mistake, ...]
    after: np.ndarray
    reading: Reading | None = None
    equals: tuple[str, ...] = ()

    @property
    def cost(self) -> float:
        """Its errors and mistakes; less is better."""
        return score(self.after) + WORTH * len(self.mistakes)

    @property
    def said(self) -> str:
        """All mistakes, in words."""
        return " and ".join(mistake.said for mistake in self.mistakes)


def score(nrmse: np.ndarray) -> float:
    """Sum of the logarithms of the errors, (n,), none below `LEAST_ERROR`."""
    return float(np.nansum(np.log(np.maximum(nrmse, LEAST_ERROR))))


def mended(before: np.ndarray, hypothesis: Hypothesis, poor: np.ndarray) -> bool:
    """Whether every joint that is poor is explained so much better that a mistake is sure; errors (n,) without the mend.

    Signs of several joints may leave more than other mistakes, which physics that is missing could resemble.
    """
    after, signs = hypothesis.after, all(mistake.kind == "sign" for mistake in hypothesis.mistakes)
    if np.any(after > np.maximum(SPOILT * before, GOOD)):
        return False
    if np.sum(poor) == 1 or not signs:
        return bool(np.all((after < np.minimum(BETTER * before, GOOD))[poor]))
    return bool(np.all((after < FAIR * before)[poor] & ((after < FAIR) | (before > AGAINST))[poor]))


def best_of(
    hypotheses: Sequence[Hypothesis], before: np.ndarray, poor: np.ndarray
) -> tuple[Hypothesis, tuple[str, ...]] | None:
    """The best hypothesis, and its rivals in words; None where none is sure. Errors before (n,), and which joints are poor (n,)."""
    if poor.any():
        sure = [h for h in hypotheses if mended(before, h, poor) and h.cost < score(before)]
    else:
        sure = [h for h in hypotheses if len(h.mistakes) == 1 and _explains(before, h.after)]
    if not sure:
        return None
    ordered = sorted(sure, key=lambda h: h.cost)
    best = ordered[0]
    near = [h.said for h in ordered[1:] if h.cost < best.cost + RIVAL and len(h.mistakes) <= len(best.mistakes)]
    others = [said for said in dict.fromkeys([*best.equals, *near]) if said != best.said]
    return best, tuple(others[: MOST_RIVALS + len(best.equals)])


def _explains(before: np.ndarray, after: np.ndarray) -> bool:
    """Whether errors (n,) fall so much that a mistake is sure though no joint is poor."""
    gain = np.log(np.maximum(before, LEAST_ERROR)) - np.log(np.maximum(after, LEAST_ERROR))
    if not np.isfinite(gain).any():
        return False
    fall = score(before) - score(after)
    return bool((fall > SURE and after[np.nanargmax(gain)] < GOOD) or (fall > CLEAR and np.nanmax(after) < CLEAN))


def torque_column(recordings: RecordingSet) -> str:
    """What the names of the columns of torques begin with."""
    return EFFORTS.get(recordings.torque, "tau")


def of_columns(compared: Comparison, several: bool) -> Iterator[Hypothesis]:
    """Mistakes in columns, and of how the arm is mounted; of signs all combinations if `several`, else one."""
    if compared.nominal or several:
        yield from _gravity(compared)
    yield from _signs(compared, several)
    yield from _orders(compared)
    if compared.nominal:
        yield from _angles(compared, several)
        yield from _sums(compared)
        yield from _zeros(compared)


def of_robot(compared: Comparison) -> Iterator[Hypothesis]:
    """Mistakes of the robot's file and of what it holds: axes, a link's mass, and the payload.

    One with which the arm explains no more than no arm at all is none.
    """
    if not compared.nominal:
        return
    bare = score(compared.nrmse(Reading.as_given(compared.samples.recordings.robot.n), alone=True))
    for hypothesis in (*_axes(compared), *_links(compared), *_payload(compared)):
        if score(hypothesis.after) < bare - WORTH:
            yield hypothesis


def _signs(compared: Comparison, several: bool) -> Iterator[Hypothesis]:
    """Opposite signs of positions, of torques or of both."""
    given, n = Reading.as_given(len(compared.samples.recordings.joints)), len(compared.samples.recordings.joints)
    turns = (
        itertools.product((1.0, -1.0), repeat=n) if several else (1 - 2 * row for row in np.vstack([np.zeros(n), np.eye(n)]))
    )
    for turned in [np.array(x) for x in turns] if compared.nominal else [np.ones(n)]:
        reading = replace(given, q=np.diag(turned))
        with_sign = {sign: compared.nrmse(replace(reading, tau=sign * np.eye(n))) for sign in (1.0, -1.0)}
        gain = np.log(np.maximum(with_sign[1.0], LEAST_ERROR) / np.maximum(with_sign[-1.0], LEAST_ERROR))
        each = [(gain > WORTH), *(np.arange(n) == j for j in range(n))]
        for flips in (np.zeros(n, bool), np.ones(n, bool), *(each if several else each[1:])):
            signs = np.where(flips, -1.0, 1.0)
            mistakes = _wrong_signs(compared.samples.recordings, turned, signs)
            if mistakes and (several or len(mistakes) == 1):
                after = np.where(flips, with_sign[-1.0], with_sign[1.0])
                turned_over = [m for m in mistakes if m.joint is not None and turned[m.joint] < 0]
                equals = ("all positions and their rates fit with the opposite sign",) * int(
                    not compared.nominal and flips.all()
                ) + tuple(
                    f"the axis of {compared.samples.recordings.joints[m.joint]} points the other way than in the robot's file"
                    for m in turned_over
                    if m.joint is not None and len(m.columns) == 2
                )
                yield Hypothesis(mistakes, after, replace(reading, tau=np.diag(signs)), equals)


def _wrong_signs(recordings: RecordingSet, turned: np.ndarray, signs: np.ndarray) -> tuple[Mistake, ...]:
    """Mistakes of signs of positions and torques, (n,) each, that are told one by one, or as one where all are alike."""
    torque, n = torque_column(recordings), len(signs)
    kinds = [(turned[j] < 0, signs[j] < 0) for j in range(n)]
    if n > 1 and all(kind == kinds[0] for kind in kinds) and any(kinds[0]):
        q, tau = (tuple(f"{name}_{joint}" for joint in recordings.joints) for name in ("q", torque))
        said = {
            (False, True): (tau, f"all {'commands' if torque == 'command' else 'torques'} fit with the opposite sign"),
            (True, False): (q, "all positions and their rates fit with the opposite sign"),
            (True, True): ((*q, *tau), "all columns fit with the opposite sign"),
        }[kinds[0]]
        return (Mistake("sign", *said),)
    result = []
    for j, (q, tau) in enumerate(kinds):
        names = f"q_{recordings.joints[j]}", f"{torque}_{recordings.joints[j]}"
        if q and tau:
            said = f"{names[0]}, its rates and {names[1]} fit with the opposite signs"
            result.append(Mistake("sign", names, said, j))
        elif q:
            result.append(Mistake("sign", names[:1], f"{names[0]} and its rates fit with the opposite sign", j))
        elif tau:
            result.append(Mistake("sign", names[1:], f"{names[1]} fits with the opposite sign", j))
    return tuple(result)


def _orders(compared: Comparison) -> Iterator[Hypothesis]:
    """Columns of two joints in each other's place: torques, positions, or all."""
    names, torque = compared.samples.recordings.joints, torque_column(compared.samples.recordings)
    given = Reading.as_given(len(names))
    for i, j in itertools.combinations(range(len(names)), 2):
        swap = np.eye(len(names))
        swap[[i, j]] = swap[[j, i]]
        tau, q = (tuple(f"{kind}_{names[k]}" for k in (i, j)) for kind in (torque, "q"))
        of = {
            f"{tau[0]} and {tau[1]} fit when they are swapped": (tau, replace(given, tau=swap)),
            f"{q[0]} and {q[1]}, with their rates, fit when they are swapped": (q, replace(given, q=swap)),
            f"all columns of {names[i]} and {names[j]} fit when they are swapped": (
                (*q, *tau),
                replace(given, q=swap, tau=swap),
            ),
        }
        for said, (columns, reading) in list(of.items())[: None if compared.nominal else 1]:
            yield Hypothesis((Mistake("order", columns, said),), compared.nrmse(reading), reading)


def _angles(compared: Comparison, several: bool) -> Iterator[Hypothesis]:
    """Positions in another unit, or of the motor's side of a gear; of one joint alone, too, where joints are poor."""
    names, torque = compared.samples.recordings.joints, torque_column(compared.samples.recordings)
    n, largest = len(names), np.max([np.max(np.abs(r.q), axis=1) for r in compared.samples.recordings.recordings], axis=0)
    for factor, how in (ANGLES | GEARS).items():
        every = (np.ones(n, bool),) * (n == 1 or factor in ANGLES)
        for which in (*every, *(np.eye(n, dtype=bool) if several and n > 1 else ())):
            if not LEAST_ANGLE < factor * np.max(largest[which]) < MOST_ANGLE:
                continue
            times = np.where(which, factor, 1.0)
            reading = Reading(np.diag(times), np.diag(times) if torque == "command" else np.eye(n), np.zeros(n))
            q = tuple(f"q_{joint}" for joint, one in zip(names, which, strict=True) if one)
            some, they = ("positions", "they are") if len(q) == n > 1 else (q[0], "it is")
            said = f"{some} {'fit' if len(q) == n > 1 else 'fits'} when {they} multiplied by {factor:.3g}, as {how}"
            yield Hypothesis((Mistake("unit", q, said),), compared.nrmse(reading), reading)


def _sums(compared: Comparison) -> Iterator[Hypothesis]:
    """Angles counted from an earlier link than the one before, and torques of motors that act from there, as of a parallelogram.

    With motors' angles u = A q the torques of the joints are Aᵀ those of the motors, as the power of both is the same.
    """
    recordings = compared.samples.recordings
    names, torque, n = recordings.joints, torque_column(recordings), len(recordings.joints)
    for i, j in itertools.combinations(range(n), 2) if torque != "command" else ():
        for sign, word in ((1.0, "+"), (-1.0, "−")):
            to_joint, to_torque = np.eye(n), np.eye(n)
            to_joint[j, i], to_torque[i, j] = -sign, sign
            what = f"q_{names[i]} {word} {names[j]}'s own angle"
            tau = (f"{torque}_{names[i]}", f"{torque}_{names[j]}")
            motors = f"{tau[0]} and {tau[1]} are of motors that turn by such angles"
            matrix = f'"coupling" with "q": {_rows(to_joint)}'
            both = f'{matrix} and "tau": {_rows(to_torque)}'
            only = f'"coupling" with "tau": {_rows(to_torque)}'
            given = Reading.as_given(n)
            for said, columns, reading in (
                (f"q_{names[j]} fits as {what}: {matrix} reads it so", (f"q_{names[j]}",), replace(given, q=to_joint)),
                (
                    f"q_{names[j]} fits as {what}, and {motors}, as of a parallelogram: {both} reads them so",
                    (f"q_{names[j]}", *tau),
                    replace(given, q=to_joint, tau=to_torque),
                ),
                (
                    f"{tau[0]} and {tau[1]} fit as torques of a parallelogram: {only} reads them so",
                    tau,
                    replace(given, tau=to_torque),
                ),
            ):
                yield Hypothesis((Mistake("coupling", columns, said),), compared.nrmse(reading), reading)


def _rows(matrix: np.ndarray) -> str:
    return json.dumps([[int(x) for x in row] for row in matrix])


def units(rigid: Comparison, compared: Comparison) -> Iterator[Hypothesis]:
    """Torques that are a multiple of the arm's which no gain explains; of all joints together if they are alike.

    Of commands they are told by kp alone, since kd moves the arm as friction does.
    """
    recordings = compared.samples.recordings
    names, torque, n = recordings.joints, torque_column(recordings), len(recordings.joints)
    given, loops = compared, torque == "command"
    rigid, compared = rigid.without_braking, compared.without_braking
    if loops:
        said = "what kp and kd make of commands fits with a smaller kd than is listed"
        columns = tuple(f"command_{joint}" for joint in names)
        sizes = [np.std(c.samples.read(Reading.as_given(n), c.samples.torque), axis=1) for c in (compared, given)]
        # over the deviation of the torques with kd, as the errors that it is compared with
        after = compared.nrmse(Reading.as_given(n)) * sizes[0] / np.maximum(sizes[1], 1e-12)
        yield Hypothesis((Mistake("unit", columns, said),), after)
    for sign, opposite in ((1.0, ""), (-1.0, "minus ")):
        factors = rigid.factors(replace(Reading.as_given(n), tau=sign * np.eye(n)))
        far = far_factors(factors)
        clear = not far.any()  # nearer ones are told where they explain all
        far = far_factors(factors, NEARER) if clear else far
        if not far.any():
            continue
        known = np.log(factors[np.isfinite(factors)])
        scale, mistakes = float(np.exp(np.mean(known))), []
        reading = replace(Reading.as_given(n), tau=sign * np.eye(n))
        if n > 1 and np.ptp(known) < ALIKE:
            tau = tuple(f"{torque}_{joint}" for joint in names)
            what = "kp of all joints is" if loops else "all torques are"
            said = f"{what} {opposite}{scale:.3g} times {_needed(scale, loops)}"
            heavier = (f"all links are {scale:.3g} times as heavy as in the robot's file",) * (sign > 0)
            after = compared.nrmse(reading, scale=1 / scale)
            if not clear or np.nanmax(after) < CLEAN:
                yield Hypothesis((Mistake("unit", tau, said),), after, equals=heavier)
            if len(known) == n:
                continue
        for j in np.flatnonzero(far).tolist():
            what = f"kp of {names[j]}" if loops else f"{torque}_{names[j]}"
            said = f"{what} is {opposite}{factors[j]:.3g} times {_needed(factors[j], loops)}"
            mistakes.append(Mistake("unit", (f"{torque}_{names[j]}",), said, j))
        each = np.where(far, factors, 1.0)
        after = compared.nrmse(reading, scale=1 / each[:, None])
        if not clear or np.nanmax(after) < CLEAN:
            other = ("links, payload or gears are others than in the robot's file, as of another arm",) * clear
            yield Hypothesis(tuple(mistakes), after, equals=other)


def far_factors(factors: np.ndarray, scales: tuple[float, float] = SCALES) -> np.ndarray:
    """Where torques are such a multiple of the arm's, (n,), as `Comparison.factors` has it, that no gain explains it."""
    with np.errstate(invalid="ignore"):
        return (factors > 0) & ~((factors > scales[0]) & (factors < scales[1]))


def _needed(factor: float, loops: bool) -> str:
    """What torques, or kp of loops, are so many times, the unit that explains it, and the mend."""
    units = UNITS_OF_GAINS if loops else UNITS
    unit = next((f", as if in {unit}" for of, unit in units.items() if abs(factor / of - 1) < 0.1), "")
    return f"what the arm needs{unit}: divided by that"


def _zeros(compared: Comparison) -> Iterator[Hypothesis]:
    """The zero of one joint's positions."""
    names = compared.samples.recordings.joints
    for j, joint in enumerate(names):
        at, after = 0.0, compared.nrmse(Reading.as_given(len(names)))
        for steps in (ZEROS, *((-step, step) for step in FINER)):
            for zero in [at + step for step in steps]:
                reading = replace(Reading.as_given(len(names)), zero=zero * (np.arange(len(names)) == j))
                there = compared.nrmse(reading)
                if score(there) < score(after):
                    at, after = zero, there
        if abs(at) > LEAST_ZERO and 2 * np.sin(abs(at) / 2) * _lever(compared, j) > LEAST_SHIFT:
            reading = replace(Reading.as_given(len(names)), zero=at * (np.arange(len(names)) == j))
            said = f"q_{joint} fits with {np.degrees(at):+.3g}° added to it"
            yield Hypothesis((Mistake("zero", (f"q_{joint}",), said, j),), after, reading)


def _lever(compared: Comparison, j: int) -> float:
    """Distance [m] from a joint to the centre of what turns about it, by its largest weight in the recordings; infinite without gravity."""
    robot = compared.samples.recordings.robot
    weight = np.max(np.abs(compared.samples.load(Reading.as_given(robot.n), rates=False)[j]))
    force = np.sum(robot.inertial[0, j:]) * np.linalg.norm(robot.gravity)
    return float(weight / force) if weight > 1e-6 * force > 0 else np.inf


def _axes(compared: Comparison) -> Iterator[Hypothesis]:
    """A joint that turns about another axis of its frame than the robot's file says."""
    robot = compared.samples.recordings.robot
    for j, joint in enumerate(robot.joints):
        for name, side in SIDES.items():
            for sign in (1.0, -1.0):
                axis = sign * np.eye(3)[side]
                if abs(axis @ robot.axes[j]) > 0.5:
                    continue  # the same axis; its direction is a sign of columns
                axes = np.where(np.arange(robot.n)[:, None] == j, axis, robot.axes)
                other = compared.with_robot(axes=axes)
                said = (
                    f"the torques fit when {joint} turns about {'−' if sign < 0 else ''}{name} of its frame in the robot's file"
                )
                yield Hypothesis((Mistake("robot", (), said),), other.nrmse(Reading.as_given(robot.n)))


def _gravity(compared: Comparison) -> Iterator[Hypothesis]:
    """Gravity along another axis of the base, as of an arm on a wall or a ceiling; or none, as where a controller adds the arm's weight."""
    robot = compared.samples.recordings.robot
    size = float(np.linalg.norm(robot.gravity))
    vectors = [sign * size * np.eye(3)[side] for side in SIDES.values() for sign in (1.0, -1.0)]
    others = [gravity for gravity in vectors if size and not np.allclose(gravity, robot.gravity, atol=0.1 * size)]
    for gravity in [*others, *([np.zeros(3)] if size else [])]:
        after = compared.with_robot(gravity=gravity).nrmse(Reading.as_given(robot.n))
        vector = ", ".join(f"{x + 0.0:.3g}" for x in gravity)
        why = (
            "if the arm were mounted otherwise"
            if gravity.any()
            else "where a controller adds the arm's weight to the torques recorded"
        )
        equals = () if gravity.any() else ("springs or counterweights carry the arm's weight",)
        mistake = Mistake("robot", (), f'the torques fit with "gravity": [{vector}], as {why}')
        yield Hypothesis((mistake,), after, equals=equals)


def _payload(compared: Comparison) -> Iterator[Hypothesis]:
    """Listed payloads that were not there, are in another unit, or belong to other recordings."""
    recordings = compared.samples.recordings
    listed = [r.payload for r in recordings.recordings]
    heaviest = max(float(np.max(payload)) for payload in listed)
    if not heaviest > 0:
        return
    told = {f"the torques fit better without the listed payload of up to {heaviest:g} kg": [0 * payload for payload in listed]}
    for factor, unit in MASSES.items():
        told[f"the listed payloads of up to {heaviest:g} kg fit when they are multiplied by {factor:.4g}, as if in {unit}"] = [
            factor * payload for payload in listed
        ]
    sizes = [float(np.median(payload)) for payload in listed]
    for i, j in itertools.combinations(range(len(sizes)), 2):
        if sizes[i] != sizes[j]:
            a, b = recordings.recordings[i].file, recordings.recordings[j].file
            swap = {i: sizes[j], j: sizes[i]}
            told[f"the listed payloads of {a} and {b} ({sizes[i]:g} and {sizes[j]:g} kg) fit when they are swapped"] = [
                np.full(len(payload), swap.get(k, sizes[k])) for k, payload in enumerate(listed)
            ]
    for said, payloads in told.items():
        other = tuple(replace(r, payload=payload) for r, payload in zip(recordings.recordings, payloads, strict=True))
        bare = Comparison(replace(compared.samples, recordings=replace(recordings, recordings=other)), compared.springs)
        yield Hypothesis((Mistake("payload", ("payload",), said),), bare.nrmse(Reading.as_given(recordings.robot.n)))


def _links(compared: Comparison) -> Iterator[Hypothesis]:
    """One link that is far lighter or heavier than in the robot's file, as where a mass was never measured."""
    robot, given = compared.samples.recordings.robot, Reading.as_given(compared.samples.recordings.robot.n)
    by_inertial = compared.samples.regressors(given)
    for k, link in enumerate(robot.links):
        own = by_inertial[:, :, 10 * k : 10 * k + 10] @ robot.inertial[:, k]
        times = 1 + compared.share_of(given, own)
        if times > 0 and not WEIGHT[0] < times < WEIGHT[1]:
            after = compared.nrmse(given, more=(times - 1) * own)
            said = f"the torques fit when {link} is {times:.3g} times as heavy as in the robot's file ({robot.inertial[0, k]:.3g} kg)"
            told = f'{said}; "inertial": "identify" estimates it'
            yield Hypothesis((Mistake("robot", (), told),), after, equals=("torques are in another unit than the header says",))
