"""Faults of sensors, drivers and files that leave every column possible: what is told of them, a part of a sentence each."""

import itertools
from collections.abc import Mapping, Sequence

import numpy as np
from scipy.ndimage import median_filter

MOVED = (
    0.02  # [rad] of travel of a joint that is not listed, or of a speed beside a position that stays; doubled, small ones pass
)
FROZEN, STEPS = 0.1, 5.0  # [s] and resolutions of the encoder by which a position must stay behind; doubled, short freezes pass
ALIKE = 2.0  # times its travel that the integral of a speed may be; beyond, its unit is wrong; doubled, the motor's side passes
CUT_ROWS, CUT_RUN = (
    0.01,
    5,
)  # share of rows at the largest torque, and rows in a row, that make a limit; doubled, short ones pass
CUT_LEVEL, CUT_TIMES = (
    0.01,
    6.0,
)  # the share of the range below it that has so many times fewer rows; a sine's peak has 2.4 times
# Times its noise that a torque at a limit is off it at most, the share of the limit that this may be, and `CUT_TIMES` in noise
REACH, WIDEST, NOISY_TIMES = 3.0, 0.1, 3.0
# Sizes of a torque from which its resolution is known, and times this, a gap about 0 that makes a dead band; doubled, small ones stay
LEVELS, BAND = 8, 3.0
# Times this quantile of the deviations from the running median that make a spike; doubled, small ones stay
SPIKE, USUAL = 10.0, 0.9
FAR = 5.0  # steps from sample to sample, usual ones or around it, below which a deviation is none; doubled, small spikes stay
AGAIN = 0.5  # share of a recording's rows that stand in another one; doubled, copies of the half pass


def unlisted(columns: Mapping[str, np.ndarray], held: Mapping[str, float]) -> list[str]:
    """Of positions of joints that are not listed: those that move, and those that stand elsewhere than the arm has them.

    Args:
        columns: Positions (K,) [rad] by the joint's name.
        held: Angles at which the robot's joints are locked [rad], by name.
    """
    found = []
    for joint, q in columns.items():
        q = q[np.isfinite(q)]
        if not len(q):
            continue
        at, middle = held.get(joint, 0.0), float(np.median(q))
        if np.ptp(q) > MOVED:
            found.append(
                f"q_{joint} moves by {np.degrees(np.ptp(q)):.3g}° and {joint} is not one of the joints listed: the arm is taken as if it stood"
                f" still at {np.degrees(at):.3g}°"
            )
        elif abs(middle - at) > MOVED:
            found.append(
                f"q_{joint} stands at {np.degrees(middle):.3g}°, where the arm is taken to have {np.degrees(at):.3g}°; "
                f'"fixed_deg" says another angle'
            )
    return found


def frozen(t: np.ndarray, segments: Sequence[slice], q: Mapping[str, np.ndarray], dq: Mapping[str, np.ndarray]) -> list[str]:
    """Of positions that stay the same for a while in which the recorded speed goes on; (K,) by the joint's name."""
    found = []
    for joint in [joint for joint in q if joint in dq]:
        worst = max((_longest_stay(t[s], q[joint][s], dq[joint][s]) for s in segments), key=lambda one: one[2])
        if worst[2] > 0:
            begin, end, way = worst
            found.append(
                f"q_{joint} is the same from {begin:.3f} to {end:.3f} s, in which dq_{joint} goes on by {np.degrees(way):.2g}°: "
                "the encoder stood still; a NaN there leaves rows out"
            )
    return found


def _longest_stay(t: np.ndarray, q: np.ndarray, dq: np.ndarray) -> tuple[float, float, float]:
    """Begin and end [s] of the stay of a position (K,) during which its speed goes on most, and how far [rad]; 0 for none."""
    steps = np.abs(np.diff(q))
    integral = np.append(0.0, np.cumsum(np.diff(t) * (dq[1:] + dq[:-1]) / 2))
    travel = float(np.sum(steps))
    if not travel > 0 or not 1 / ALIKE < np.sum(np.abs(np.diff(integral))) / travel < ALIKE:
        return 0.0, 0.0, 0.0
    ends = np.flatnonzero(np.append(steps > 0, True))
    begins = np.append(0, ends[:-1] + 1)
    ways = np.where(t[ends] - t[begins] > FROZEN, np.abs(integral[ends] - integral[begins]), 0.0)
    k = int(np.argmax(ways))
    enough = ways[k] > max(MOVED, STEPS * float(np.min(steps[steps > 0])))
    return (float(t[begins[k]]), float(t[ends[k]]), float(ways[k])) if enough else (0.0, 0.0, 0.0)


def white_noise(torque: np.ndarray) -> np.ndarray:
    """Standard deviation of white noise in torques (n, K), from their second differences, (n,); steps and spikes are none."""
    second = np.diff(torque, 2, axis=1)
    return np.minimum(np.std(second, axis=1), np.quantile(np.abs(second), 0.683, axis=1)) / np.sqrt(6)


def flat_top(torque: np.ndarray) -> tuple[np.ndarray, float]:
    """Where a noisy torque (K,) stays about its largest sizes, (K,), and their level; no proof of a limit, as steady friction does so, too."""
    size, reach = np.abs(torque), REACH * float(white_noise(torque[None])[0])
    level = float(np.median(size[size >= np.max(size) - 2 * reach]))
    at, below = size > level - reach, (size > level - 3 * reach) & (size <= level - reach)
    enough = _longest(at) >= CUT_RUN and np.mean(at) > CUT_ROWS and np.sum(at) > NOISY_TIMES * np.sum(below)
    return at & enough & (0 < reach < WIDEST * level), level


def _longest(at: np.ndarray) -> int:
    """The most rows (K,) that are so one after the other."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], at, [0]])))
    return int(np.max(edges[1::2] - edges[::2], initial=0))


def cut_off(torque: np.ndarray, limit: float = 0.0) -> np.ndarray:
    """Where a torque (K,) is cut off, (K,); nowhere unless there is a limit.

    So many rows in a row have exactly the largest size, whatever its resolution; or up to its noise that of the joint's limit (0: none).
    """
    reach = REACH * float(white_noise(torque[None])[0])
    at = np.abs(torque) > limit - reach
    if 0 < reach < WIDEST * limit < np.inf and np.max(np.abs(torque)) < limit + 2 * reach and _longest(at) >= CUT_RUN:
        return at
    size, largest = np.abs(torque), float(np.max(np.abs(torque)))
    at = size > largest * (1 - 1e-9)
    near = (size > (1 - CUT_LEVEL) * largest) & ~at
    levels = np.unique(size[size > (1 - 10 * CUT_LEVEL) * largest])
    if len(levels) < 3:  # so few that the next one says nothing
        return np.zeros_like(at)
    below = np.sum(near) if near.any() else np.sum(size == levels[-2])
    cut = largest > 0 and _longest(at) >= CUT_RUN and np.mean(at) > CUT_ROWS and np.sum(at) > CUT_TIMES * below
    return at & cut


def zeroed(torque: np.ndarray) -> np.ndarray:
    """Where a torque (K,) is 0 since it is small, as in the dead band of a drive, (K,); nowhere unless there is such a band.

    Many rows are 0 and none is a little off it: the smallest other size is that of many steps of the resolution, below which as many rows
    would lie as between it and twice that.
    """
    size = np.abs(torque)
    at, others = size == 0, np.unique(size[size > 0])
    if len(others) < LEVELS or np.mean(at) < CUT_ROWS:
        return np.zeros_like(at)
    band = float(others[0])
    above, step = np.sum((size >= band) & (size < 2 * band)), np.median(np.diff(others[:LEVELS]))
    return at & (band > BAND * step) & (np.sum(at) > above / ALIKE)


def unsigned(torques: Sequence[np.ndarray], speeds: Sequence[np.ndarray]) -> bool:
    """Whether torques (K,) of a joint that moves both ways, at speeds (K,), look like magnitudes: many are near 0, and none below."""
    tau, dq = np.concatenate(torques), np.concatenate(speeds)
    largest = float(np.max(tau))
    both = min(np.mean(dq > 0), np.mean(dq < 0)) > CUT_ROWS
    return bool(largest > 0 and np.min(tau) >= 0 and both and np.mean(tau < CUT_LEVEL * largest) > CUT_ROWS / ALIKE)


def spikes(q: np.ndarray, turn: float = np.inf) -> np.ndarray:
    """Where a position [rad], or a torque, (K,) jumps away for one or two samples and back, as after a bit that was read wrongly, (K,).

    A motion that goes on equals its running median, whatever its speed; a position that is a whole turn off is unwrapped instead.
    """
    steps, off = np.abs(np.diff(q, prepend=q[:1])), np.abs(q - median_filter(q, 5, mode="nearest"))
    if np.isfinite(turn):
        off = np.abs(off - turn * np.round(off / turn))
    usual = float(np.median(steps[steps > 0])) if steps.any() else np.inf
    around = np.maximum(median_filter(steps, 11, mode="nearest"), usual)
    return (off > SPIKE * float(np.quantile(off, USUAL))) & (off > FAR * around)


def stays(t: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Where a position (K,) [rad] keeps its last value for a while and then jumps, as of an encoder or a bus that stood still, (K,)."""
    result, known = np.zeros(len(q), bool), np.flatnonzero(np.isfinite(q))
    steps = np.abs(np.diff(q[known]))
    usual = float(np.quantile(steps, 0.99)) if len(steps) else 0.0
    changes = np.append(-1, np.flatnonzero(steps > 0))
    for k in np.flatnonzero(steps[changes[1:]] > max(FAR * usual, MOVED)):
        stay = known[changes[k] + 2 : changes[k + 1] + 1]  # without the row that was read
        if len(stay) and t[stay[-1]] - t[stay[0]] > FROZEN:
            result[stay] = True
    return result


def copies(columns: Mapping[str, np.ndarray]) -> list[str]:
    """Of columns (K,), pairs that hold the same changing numbers in every row."""
    pairs = itertools.combinations(columns.items(), 2)
    return [
        f"{b} holds the same numbers as {a} in every row; was one of them recorded?"
        for (a, x), (b, y) in pairs
        if np.ptp(x) > 0 and np.array_equal(x, y)
    ]


def repeated(rows: Sequence[np.ndarray]) -> list[tuple[int, int, float]]:
    """Pairs of recordings (later, earlier) of which one has the other's rows again, and the share; rows (m, K) each."""
    weights = np.random.default_rng(0).uniform(0.5, 1.5, len(rows[0]) if rows else 0)
    marks = [np.unique(np.asarray(weights @ one)) for one in rows]
    shares = (
        (j, i, len(np.intersect1d(marks[i], marks[j], assume_unique=True)) / min(len(marks[i]), len(marks[j])))
        for j in range(len(marks))
        for i in range(j)
    )
    return [(j, i, share) for j, i, share in shares if share > AGAIN]
