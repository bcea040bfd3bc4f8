"""Units that cannot be right: raised only where the recording and the robot contradict each other by a known factor; absurd numbers."""

from collections.abc import Mapping

import numpy as np

from rrr_oc.errors import UserError
from rrr_oc.numerics.savitzky_golay import differentiate
from rrr_oc.robot.robot import Robot

DEGREES = 180 / np.pi
RPM = 60 / (2 * np.pi)
FACTORS = (  # measured derivative over computed one -> what it looks like
    (DEGREES, "{rate} is in degrees"),
    (1 / DEGREES, "{value} is in degrees"),
    (RPM, "{rate} is in revolutions per minute"),
    (1e3, "t is in milliseconds"),
    (1e6, "t is in microseconds"),
    (1e9, "t is in nanoseconds"),
)
TOLERANCE = 0.1  # of the factor; filters and noise move it by less
CORRELATION = 0.95  # above it two signals are one up to their scale
LONGEST_STEP = 10.0  # [s] between samples
SLOW_STEP, SLOW_SPEED, SLOW_TRAVEL = 0.5, 0.003, 0.5  # [s], [rad/s], [rad]: travels far, sampled rarely, never this fast
TORQUE_FACTOR = 10.0  # a median torque above this many effort limits is in a smaller unit
ABSURD = 1e9  # in any unit: beyond what an arm does, and its powers beyond what floating-point numbers hold
ROWS = 20_000  # a longer recording is judged by its first rows


def check_magnitudes(where: str, columns: Mapping[str, np.ndarray]) -> None:
    """Raise `UserError` where a signal (K,) but the time holds a number that no sensor gives."""
    for name, values in columns.items():
        largest = float(np.max(np.abs(values)))
        if name != "t" and largest > ABSURD:
            raise UserError(f"{where}: {name} reaches {largest:.3g}; magnitudes up to {ABSURD:g} are allowed")


def check_time(where: str, t: np.ndarray) -> None:
    """Raise `UserError` where the median step of t (K,) is no time between samples in seconds."""
    step = float(np.median(np.diff(t)))
    if step > LONGEST_STEP:
        units = (("milliseconds", 1e3), ("microseconds", 1e6), ("nanoseconds", 1e9))
        unit = next((name for name, factor in units if step / factor < SLOW_STEP), None)
        looks = f"; it looks like {unit}" if unit else ""
        raise UserError(
            f"{where}: column 't' has a median step of {step:g}; the unit is s, up to {LONGEST_STEP:g} s are allowed{looks}"
        )


def check_slowness(where: str, t: np.ndarray, q: np.ndarray, dq: np.ndarray) -> None:
    """Raise `UserError` where time in milliseconds explains a slow recording whose dq (n, K) was computed from q (n, K)."""
    step = float(np.median(np.diff(t)))
    travel = float(np.max(np.ptp(q, axis=1)))
    speed = float(np.max(np.abs(dq)))
    if step >= SLOW_STEP and travel >= SLOW_TRAVEL and speed < SLOW_SPEED:
        raise UserError(
            f"{where}: column 't' has a median step of {step:g}, and no joint is faster than {speed:.2g} rad/s; "
            "the unit is s, it looks like milliseconds"
        )


def check_positions(where: str, robot: Robot, q: np.ndarray) -> None:
    """Raise `UserError` where a joint's positions q (n, K) fit its range in degrees and by far not in radians."""
    for i, joint in enumerate(robot.joints):
        low, high = float(q[i].min()), float(q[i].max())
        room = robot.upper[i] - robot.lower[i]
        if high - low > 2 * room and max(-low, high) > 2 * np.pi and (high - low) / DEGREES <= 1.2 * room:
            raise UserError(
                f"{where}: column 'q_{joint}' spans {low:.3g} … {high:.3g}, the joint's range is "
                f"{robot.lower[i]:.3g} … {robot.upper[i]:.3g} rad; the unit is rad, it looks like degrees"
            )


def check_derivative(
    where: str, t: np.ndarray, segments: tuple[slice, ...], value: tuple[str, np.ndarray], rate: tuple[str, np.ndarray]
) -> None:
    """Raise `UserError` where a measured rate (K,) is the derivative of a value (K,) up to a factor that a unit explains.

    `value` and `rate` are (column's name, samples).
    """
    longest = max(segments, key=lambda s: s.stop - s.start)
    part = slice(longest.start, min(longest.stop, longest.start + ROWS))
    measured = rate[1][part]
    computed = differentiate(t[part], value[1][None, part], [slice(0, len(measured))])[0]
    scales = float(np.std(measured)), float(np.std(computed))
    if not (all(np.isfinite(scales)) and min(scales) > 0):
        return
    covariance = float(np.mean((measured - measured.mean()) * (computed - computed.mean())))
    correlation, ratio = covariance / (scales[0] * scales[1]), scales[0] / scales[1]
    looks = None
    if correlation < -CORRELATION:
        looks = f"is minus the derivative of '{value[0]}'; one of them has the wrong sign"
    elif correlation > CORRELATION:
        names = next((text for factor, text in FACTORS if abs(ratio / factor - 1) < TOLERANCE), None)
        if names is not None:
            explained = names.format(value=f"'{value[0]}'", rate=f"'{rate[0]}'")
            looks = f"is {ratio:.4g} times the derivative of '{value[0]}'; units are rad and s, it looks as if {explained}"
    if looks is not None:
        raise UserError(f"{where}: column '{rate[0]}' {looks}")


def check_torques(where: str, robot: Robot, torque: np.ndarray, columns: tuple[str, ...], unit: str) -> None:
    """Raise `UserError` where most of a joint's output torques (n, K) [Nm] lie beyond ten times its effort limit."""
    for i, column in enumerate(columns):
        middle, limit = float(np.median(np.abs(torque[i]))), float(robot.effort[i])
        if limit > 0 and middle > TORQUE_FACTOR * limit:
            raise UserError(
                f"{where}: column '{column}' has a median magnitude of {middle:.3g} Nm at the output, and the effort limit "
                f"is {limit:g} Nm; the unit is {unit}, it looks like m{unit}"
            )
