"""Motions with one swing more or less than given ones.

On springs an arm swings. Motions that differ by a swing are different local optima, between which IPOPT does not move. A swing is what a joint
does from one turn to the next but one: run through again, or left out, it makes another motion from which IPOPT starts."""

from collections.abc import Iterator

import numpy as np

from rrr_oc.optimal_control.problem import PhaseGuess

POINTS = 401  # at which a motion is sampled; doubled, quick swings are seen more exactly, which IPOPT does not need
TURN = 3e-3  # [rad] by which a joint must move back to have turned; doubled, the smallest swings are left as they are
SAME = 0.02  # [1] of a phase by which swings of two joints must differ to be two; doubled, fewer motions are solved
_Sampled = tuple[np.ndarray, np.ndarray, np.ndarray]  # t [s] (K,), states (nx, K), controls (nu, K)


def turns(angle: np.ndarray) -> list[int]:
    """Indices of the first and the last sample of an angle [rad] (K,), and of those between at which it turns back."""
    found, last, way = [0], 0, 0.0
    for i, moved in enumerate(angle):
        if way * (moved - angle[last]) > 0 or (way == 0 and abs(moved - angle[0]) > TURN):
            way, last = np.sign(moved - angle[last]), i
        elif way and abs(moved - angle[last]) > TURN:
            found.append(last)
            way, last = -way, i
    return [*found, len(angle) - 1]


def with_other_swings(
    phase: PhaseGuess, orders: tuple[np.ndarray, np.ndarray], duration: tuple[float, float]
) -> list[PhaseGuess]:
    """The motion of a phase with one swing of a joint run through twice, and with one left out, for every swing.

    Args:
        orders: How often states and controls are derived by time (nx,), (nu,); there are as many joints, whose angles are the
            first states, as controls.
        duration: Least and greatest duration of the phase [s], to which times are scaled where they are outside.
    """
    s = np.linspace(0, 1, POINTS)
    motion, joints = (s * phase.duration, phase.states(s), phase.controls(s)), len(orders[1])
    made = []
    for start, end in _swings(motion[1][:joints]):
        made.append(_repeated(motion, start, end, joints))
        if end - start < POINTS - 1:
            made.append(_left_out(motion, start, end, joints))
    return [_guess(one, orders, duration) for one in made]


def _swings(q: np.ndarray) -> Iterator[tuple[int, int]]:
    """Indices of the first and the last sample of every swing of the joints (m, K); swings at nearly the same time are one."""
    found: list[tuple[int, int]] = []
    for at in map(turns, q):
        for swing in zip(at, at[2:], strict=False):
            if all(max(abs(a - b) for a, b in zip(swing, other, strict=True)) > SAME * POINTS for other in found):
                found.append(swing)
    return iter(found)


def _repeated(motion: _Sampled, start: int, end: int, joints: int) -> _Sampled:
    """A motion that runs through a part twice; where the part does not end as it starts, each time is half the way ahead or behind."""
    t, x, u = motion
    moved, length = x[:joints, end] - x[:joints, start], t[end] - t[start]
    part = x[:, start : end + 1].copy()
    part[:joints] -= 0.5 * moved[:, None] * (t[start : end + 1] - t[start]) / length
    again = part.copy()
    again[:joints] += 0.5 * moved[:, None]
    return (
        np.r_[t[: end + 1], t[start + 1 :] + length],
        np.hstack([x[:, :start], part, again[:, 1:], x[:, end + 1 :]]),
        np.hstack([u[:, : end + 1], u[:, start + 1 :]]),
    )


def _left_out(motion: _Sampled, start: int, end: int, joints: int) -> _Sampled:
    """A motion without a part; the way that the part has gone is shared by what is before it and what is after it."""
    t, x, u = motion
    moved, length = x[:joints, end] - x[:joints, start], t[end] - t[start]
    share = (0.0 if start == 0 else 1.0 if end == len(t) - 1 else 0.5) * moved
    before, after = x[:, : start + 1].copy(), x[:, end + 1 :].copy()
    before[:joints] += share[:, None] * t[: start + 1] / max(t[start], t[1])
    after[:joints] -= (moved - share)[:, None] * (t[-1] - t[end + 1 :]) / max(t[-1] - t[end], t[1])
    return (
        np.r_[t[: start + 1], t[end + 1 :] - length],
        np.hstack([before, after]),
        np.hstack([u[:, : start + 1], u[:, end + 1 :]]),
    )


def _guess(motion: _Sampled, orders: tuple[np.ndarray, np.ndarray], duration: tuple[float, float]) -> PhaseGuess:
    """A sampled motion as a starting point, run through within some durations [s]."""
    t, x, u = motion
    T = float(np.clip(t[-1], *duration))
    faster, times = t[-1] / T, t / t[-1]
    x, u = (values * faster ** order[:, None] for values, order in zip((x, u), orders, strict=True))

    def between(values: np.ndarray, s: np.ndarray) -> np.ndarray:
        return np.array([np.interp(s, times, row) for row in values])

    return PhaseGuess(T, lambda s: between(x, s), lambda s: between(u, s))
