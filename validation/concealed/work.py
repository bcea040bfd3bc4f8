"""Motions of real work, dull and slow beside the reference motions of an identification: moves with rests, repeated stations, scans.

As in `trajectories.KINDS`, each is called with (arm, t, low, high, rng) and gives joint angles [rad], (n, T).
"""

from collections.abc import Callable

import numpy as np

from validation.concealed.arms import Arm

DULL = (
    "point_to_point",
    "stations",
    "stations",
    "scan",
    "one_by_one",
    "pick_and_place",
)  # what an imperfect arm is recorded in
EVERY_JOINT = ("point_to_point", "stations")  # of those, the ones in which every joint moves; one recording at least is of them
OTHERS = ("multisine", "spline", "point_to_point", "pick_and_place")  # its unseen recordings

Blend = Callable[[np.ndarray], np.ndarray]


def quintic(u: np.ndarray) -> np.ndarray:
    """From 0 to 1 with speed and acceleration zero at both ends."""
    return u**3 * (10 - 15 * u + 6 * u**2)


def trapezium(share: float) -> Blend:
    """From 0 to 1 with constant acceleration, constant speed, constant deceleration; `share` of the time to speed up."""

    def blend(u: np.ndarray) -> np.ndarray:
        top = 1 / (1 - share)  # speed in the middle
        start, end = top * u**2 / (2 * share), 1 - top * (1 - u) ** 2 / (2 * share)
        return np.where(u < share, start, np.where(u > 1 - share, end, top * (u - share / 2)))

    return blend


def any_blend(rng: np.random.Generator) -> Blend:
    return quintic if rng.random() < 0.5 else trapezium(rng.uniform(0.15, 0.4))


def travelled(t: np.ndarray, goals: np.ndarray, moves: np.ndarray, rests: np.ndarray, blend: Blend) -> np.ndarray:
    """Angles [rad], (n, T), through the goals (K, n) in turn: K − 1 moves and the rest after each take `moves` and `rests` [s]."""
    q, clock = np.tile(goals[0][:, None], (1, len(t))), 0.0
    for start, goal, move, rest in zip(goals[:-1], goals[1:], moves, rests, strict=True):
        later = t >= clock
        u = np.clip((t[later] - clock) / move, 0.0, 1.0)
        q[:, later] = start[:, None] + (goal - start)[:, None] * blend(u)
        clock += move + rest
    return q


def paced(arm: Arm, goals: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Seconds of each move at 0.3 to 0.8 of the arm's fastest reference; at least 0.6."""
    distance = np.abs(np.diff(goals, axis=0)) / arm.speed
    return np.maximum(1.8 * distance.max(axis=1) / rng.uniform(0.3, 0.8), 0.6)


def point_to_point(arm: Arm, t, low, high, rng) -> np.ndarray:
    """Always on to another posture, with rests."""
    count = int(t[-1]) + 2  # moves of 0.6 s with rests of 0.4 s would need no more
    goals = low + rng.uniform(0.0, 1.0, (count, len(low))) * (high - low)
    return travelled(t, goals, paced(arm, goals, rng), rng.uniform(0.4, 2.0, count - 1), any_blend(rng))


def stations(arm: Arm, t, low, high, rng) -> np.ndarray:
    """Two or three postures again and again."""
    count = int(t[-1]) + 2
    few = low + rng.uniform(0.0, 1.0, (int(rng.integers(2, 4)), len(low))) * (high - low)
    goals = few[np.arange(count) % len(few)]
    return travelled(t, goals, paced(arm, goals, rng), np.full(count - 1, rng.uniform(0.3, 1.5)), any_blend(rng))


def one_by_one(arm: Arm, t, low, high, rng) -> np.ndarray:
    """Joints move in turn, while the others hold."""
    n, count = len(low), int(t[-1]) + 2
    goals = np.tile(low + rng.uniform(0.2, 0.8, n) * (high - low), (count, 1))
    for k in range(1, count):
        goals[k] = goals[k - 1]
        j = (k - 1) % n
        goals[k, j] = rng.uniform(low[j], high[j])
    return travelled(t, goals, paced(arm, goals, rng), rng.uniform(0.2, 0.8, count - 1), any_blend(rng))


def scan(arm: Arm, t, low, high, rng) -> np.ndarray:
    """One joint slowly back and forth, a second one steps on after every line; the others hold."""
    n, count = len(low), 2 * (int(t[-1]) + 2)
    middle = low + rng.uniform(0.3, 0.7, n) * (high - low)
    j = int(rng.integers(n))
    k = int(rng.choice([i for i in range(n) if i != j] or [j]))
    line = rng.uniform(0.2, 0.5) * (high[j] - low[j])
    goals = np.tile(middle, (count, 1))
    lines = np.arange(count)
    goals[:, j] = middle[j] + line * np.where((lines + 1) // 2 % 2, 0.5, -0.5)
    if k != j:
        goals[:, k] = low[k] + (high[k] - low[k]) * np.clip(0.2 + 0.06 * (lines // 2), 0.0, 0.8)
    moves = np.where(lines[:-1] % 2 == 0, line / rng.uniform(0.06, 0.3), 1.0)  # [s]; the first speed is in rad/s
    return travelled(t, goals, moves, np.full(count - 1, 0.2), trapezium(0.1))


WORK = {"point_to_point": point_to_point, "stations": stations, "one_by_one": one_by_one, "scan": scan}
