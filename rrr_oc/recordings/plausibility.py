"""Checks of units and columns: a recording is refused where it contradicts the robot, or itself, by the factor between two units.

A measured rate that is no better than the derivative of its value is not used; what looks wrong and is no error for certain is a
sentence.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from rrr_oc.errors import UserError
from rrr_oc.numerics.savitzky_golay import WINDOW, differentiate, local_polynomial, smooth, window_samples
from rrr_oc.robot.robot import Robot

DEGREES = 180 / np.pi
RPM = 60 / (2 * np.pi)
FACTORS = (  # measured derivative over computed one, and the unit that explains it
    (DEGREES, "{rate} is in degrees"),
    (1 / DEGREES, "{value} is in degrees"),
    (RPM, "{rate} is in revolutions per minute"),
    (1e3, "t is in milliseconds"),
    (1e6, "t is in microseconds"),
    (1e9, "t is in nanoseconds"),
)
# Every threshold decides whether a recording is refused; it lies far from what sensors and filters do to a right one.
TOLERANCE = 0.1  # relative, of a factor; noise and filters change it by less; doubled, rates that are 20 % off would be taken for a unit
CORRELATION = 0.95  # signals correlated above it are taken to be proportional; at 0.9, very noisy speeds would be judged, too
LOW_RATE = (
    20.0  # [Hz], below which a rate is said: derivatives need seven samples of a motion; doubled, usable logs are doubted
)
LONG_GAP, MISSING = 1.0, 0.05  # [s] of a gap, share of a recording's time in gaps, which is said; doubled, more passes
SMALL_TRAVEL = (
    3.5  # [°] below which the travel of all joints is said; a half turn told in radians reads as π°; doubled, small motions are
)
LONGEST_STEP = 10.0  # [s], of a median step; longer ones are another unit of time; doubled, slow logs in seconds would pass
SLOW_STEP, SLOW_TRAVEL = 0.5, 0.05  # [s], [rad]: where a joint travels so far in so long steps, and it might be milliseconds …
USUAL_SPEED = (
    10.0  # [rad/s], … as a thousand times its speed is below the joint's limit, or this; doubled, slower logs are refused
)
ALIKE = 300.0, 3000.0  # ratio of steps within a set from which one is in milliseconds; doubled, sets of more mixed rates pass
TORQUE_FACTOR = 10.0  # a median torque above so many effort limits is in mNm or mA; doubled, limits 50 times too low would pass
ABSURD = 1e9  # in any unit: above it a number is no measurement, and its powers overflow; doubled, nothing changes
STILL = 1e-3  # [rad] of travel, below which a joint stands still; doubled, slow short motions would be taken for standstill
LAG = (
    0.2,
    10,
)  # [s] and samples over which the change of a value and the integral of its rate are compared; doubled, slow drifts count
LEAST_CHANGE = (
    0.01,
    0.05,
)  # [rad], [rad/s] root mean square change over a lag from which they are compared; doubled, small motions are not
SAME_SCALE = 0.01  # by which a rate may be off and be used; doubled, armatures are 1 to 2 % off
LATEST = 0.015  # [s] by which a rate may be late and be used; doubled, filters have taken off more of fast motion than noise
SAME_TIME = 5e-4  # [s] by which a rate may be off and counts as in time; doubled, armatures are 1 % off
NOISIER, QUIETER = (
    1.1,
    0.7,
)  # times the derivative's noise that a rate has at most, in time and late; doubled, noisier rates are used
NOISE_WINDOW = 0.07  # [s] of both when their noise is compared; doubled, both have less
ROWS = 20_000  # first rows by which a derivative is judged; doubled, the check takes twice as long


def check_magnitudes(where: str, columns: Mapping[str, np.ndarray]) -> None:
    """Raise `UserError` where a signal (K,), time excepted, has a magnitude above `ABSURD`."""
    for name, values in columns.items():
        largest = float(np.max(np.abs(values)))
        if name != "t" and largest > ABSURD:
            raise UserError(f"{where}: {name} reaches {largest:.3g}; magnitudes up to {ABSURD:g} are allowed")


def check_time(where: str, t: np.ndarray) -> None:
    """Raise `UserError` where the median step of t (K,) is too long for a sampling interval in seconds."""
    step = float(np.median(np.diff(t)))
    if step > LONGEST_STEP:
        units = (("milliseconds", 1e3), ("microseconds", 1e6), ("nanoseconds", 1e9))
        looks = next((f"; it looks like {name}" for name, factor in units if step / factor < SLOW_STEP), "")
        raise UserError(
            f"{where}: column 't' has a median step of {step:g}; the unit is s, up to {LONGEST_STEP:g} s are allowed{looks}"
        )


def check_slowness(where: str, robot: Robot, t: np.ndarray, q: np.ndarray, dq: np.ndarray) -> None:
    """Raise `UserError` where t (K,) in milliseconds explains a slow motion q (n, K) whose speeds dq (n, K) were computed from it."""
    step, speeds = float(np.median(np.diff(t))), np.max(np.abs(dq), axis=1)
    known = np.isfinite(robot.velocity) & (robot.velocity > 0)
    limits = np.where(known, robot.velocity, USUAL_SPEED)
    if step >= SLOW_STEP and np.max(np.ptp(q, axis=1)) >= SLOW_TRAVEL and np.all(1e3 * speeds < 1.5 * limits):
        raise UserError(
            f"{where}: column 't' has a median step of {step:g}, and no joint is faster than {speeds.max():.2g} rad/s; "
            "the unit is s, it looks like milliseconds"
        )


def check_alike(steps: Mapping[str, float]) -> None:
    """Raise `UserError` where the median step [s] of one recording, by file, is a thousand times that of another."""
    long, short = max(steps, key=steps.__getitem__), min(steps, key=steps.__getitem__)
    if ALIKE[0] < steps[long] / steps[short] < ALIKE[1]:
        raise UserError(
            f"{long}: column 't' has a median step of {steps[long]:g}, and that of {short} {steps[short]:g}; the unit is s, "
            f"{long} looks like milliseconds"
        )


def check_positions(where: str, robot: Robot, q: np.ndarray, least: float = 0.0) -> None:
    """Raise `UserError` where positions q (n, K) span far more than a joint's range, and `least` [rad], and say what they look like."""
    for i, joint in enumerate(robot.joints):
        low, high, room = float(q[i].min()), float(q[i].max()), float(robot.upper[i] - robot.lower[i])
        if not (np.isfinite(room) and high - low > max(2 * room, least) and max(-low, high) > 2 * np.pi):
            continue
        inside = bool(low / DEGREES > robot.lower[i] - room / 2 and high / DEGREES < robot.upper[i] + room / 2)
        whole = bool(np.all(q[i] == np.round(q[i])))
        looks = "degrees, or " * inside + ("an encoder's counts" if whole else "the motor's angle before its gear")
        raise UserError(
            f"{where}: column 'q_{joint}' spans {low:.3g} … {high:.3g}, the joint's range is "
            f"{robot.lower[i]:.3g} … {robot.upper[i]:.3g} rad; the unit is rad at the joint, it looks like {looks}"
        )


def check_commands(where: str, robot: Robot, command: np.ndarray, q: np.ndarray) -> None:
    """Raise `UserError` where commands (n, K) are positions q (n, K) up to the factor between degrees and radians."""
    for i, joint in enumerate(robot.joints):
        scales = float(np.std(command[i])), float(np.std(q[i]))
        if not min(scales) > 0 or np.corrcoef(command[i], q[i])[0, 1] < CORRELATION:
            continue
        ratio = scales[0] / scales[1]
        for factor, column in ((DEGREES, f"command_{joint}"), (1 / DEGREES, f"q_{joint}")):
            if abs(ratio / factor - 1) < TOLERANCE:
                raise UserError(
                    f"{where}: column 'command_{joint}' moves {ratio:.4g} times as far as 'q_{joint}'; the unit of both is rad, "
                    f"'{column}' looks like degrees"
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
    column = f"{where}: column '{rate[0]}'"
    if correlation < -CORRELATION:
        raise UserError(f"{column} is minus the derivative of '{value[0]}'; one of them has the wrong sign")
    explained = next((text for factor, text in FACTORS if abs(ratio / factor - 1) < TOLERANCE), None)
    if correlation > CORRELATION and explained is not None:
        looks = explained.format(value=f"'{value[0]}'", rate=f"'{rate[0]}'")
        raise UserError(
            f"{column} is {ratio:.4g} times the derivative of '{value[0]}'; units are rad and s, it looks as if {looks}"
        )


@dataclass(frozen=True)
class Rate:
    """A measured rate beside the derivative of its value.

    Attributes:
        column, value: Names of both.
        times: How many times the derivative it is.
        late: By how much it lags the derivative [s].
        std: Standard errors of these two.
        noise: Its noise over that of the derivative.
    """

    column: str
    value: str
    times: float
    late: float
    std: tuple[float, float]
    noise: float

    @property
    def right_scale(self) -> bool:
        """Whether it is as many times the derivative as it should be."""
        return abs(self.times - 1) <= SAME_SCALE + 2 * self.std[0]

    @property
    def is_late(self) -> bool:
        """Whether it is known to be late, or early."""
        return abs(self.late) > SAME_TIME + 2 * self.std[1]

    @property
    def used(self) -> bool:
        """Whether it is better than the derivative: of the same scale, not noisier, and if it is late not by much and much quieter."""
        quiet = self.noise <= (QUIETER if self.is_late else NOISIER)
        return self.right_scale and quiet and abs(self.late) <= LATEST

    @property
    def said(self) -> str:
        """What it is, for people, after its name."""
        if not self.right_scale:
            return f"is {0.0 + self.times:.3g} times the derivative of {self.value}"
        if self.is_late:
            return f"comes {abs(1e3 * self.late):.2g} ms {'later' if self.late > 0 else 'earlier'} than the derivative of {self.value}"
        return f"has {self.noise:.2g} times the noise of the derivative of {self.value}"

    def in_time(self, t: np.ndarray, segments: tuple[slice, ...], rate: np.ndarray) -> np.ndarray:
        """The rate (K,) as it would be if it were not late."""
        result = rate.copy()
        for s in segments if self.is_late else ():
            result[s] = np.interp(t[s] + self.late, t[s], rate[s])
        return result


def measured_rate(
    t: np.ndarray, segments: tuple[slice, ...], value: tuple[str, np.ndarray], rate: tuple[str, np.ndarray], least: float
) -> Rate | None:
    """A measured rate (K,) beside the derivative of a value (K,); None where too little changes to tell.

    The integral of the rate over a span is regressed on the change of the value and of its derivative, which is insensitive to noise and
    resolution: ∫ rate = times (Δ value − late Δ derivative).

    Args:
        value, rate: Names of columns, and their samples.
        least: Change [unit of the value] from which there is something to compare.
    """
    longest = max(segments, key=lambda s: s.stop - s.start)
    part = slice(longest.start, min(longest.stop, longest.start + ROWS))
    times, x, v = t[part], value[1][part], rate[1][part]
    if len(times) < 2 * LAG[1]:
        return None
    span = min(max(LAG[1], round(LAG[0] / float(np.median(np.diff(times))))), len(times) // 2)
    integral = np.append(0.0, np.cumsum(np.diff(times) * (v[1:] + v[:-1]) / 2))
    derivative = differentiate(times, x[None], (slice(0, len(times)),))[0]
    change, summed, turned = (y[span:] - y[:-span] for y in (x, integral, derivative))
    size = float(np.sqrt(np.mean(change**2)))
    if not (np.isfinite(size) and size > least and np.all(np.isfinite(turned))):
        return None
    columns = np.column_stack([change, -turned])
    scale, shift = np.linalg.lstsq(columns, summed, rcond=1e-9)[0]
    late = float(shift / scale) if abs(scale) > SAME_SCALE else 0.0
    left = summed - columns @ [scale, shift]
    spans = max(len(left) / span, 1.0)  # that are independent
    std = np.sqrt(np.mean(left**2) / spans / np.maximum(np.mean(columns**2, axis=0), 1e-300))
    count = min(window_samples(times, NOISE_WINDOW, 7), len(times) - 1 + len(times) % 2)
    own, other = (_noise(times, local_polynomial(times, y[None], k, 3, count)) for y, k in ((v, 0), (x, 1)))
    return Rate(rate[0], value[0], float(scale), late, (float(std[0]), float(std[1])), own / max(abs(scale) * other, 1e-300))


def _noise(t: np.ndarray, x: np.ndarray) -> float:
    """Mean size of what the usual window takes off a signal (1, K), but for the ends, at which filters begin."""
    cut = window_samples(t, WINDOW) if len(t) > 4 * window_samples(t, WINDOW) else 0
    return float(np.mean(np.abs(x - smooth(t, x, (slice(0, len(t)),)))[0, cut : len(t) - cut]))


def is_derivative(t: np.ndarray, segments: tuple[slice, ...], rate: np.ndarray, values: Sequence[np.ndarray]) -> bool:
    """Whether a rate (K,) is the derivative of one of some values (K,)."""
    if not values or np.ptp(rate) == 0:
        return False
    return bool(swapped(t, segments, np.array([0 * rate, *values]), np.array([rate, *(0 * rate for _ in values)])))


def check_changes(where: str, q: np.ndarray, tau: np.ndarray) -> None:
    """Raise `UserError` where nothing was recorded: no position q (n, K) and no torque (n, K) ever changes."""
    if not np.any(np.ptp(q, axis=1)) and not np.any(np.ptp(tau, axis=1)):
        at = "0" if not (np.any(q) or np.any(tau)) else "the same"
        raise UserError(f"{where}: all positions and torques are {at} in every row; nothing was recorded")


def sampling_doubts(t: np.ndarray, segments: tuple[slice, ...]) -> list[str]:
    """What is wrong with the times (K,) of a recording: a low rate, and time that is missing; a part of a sentence each."""
    steps, doubts = np.diff(t), []
    rate = 1 / float(np.median(steps))
    if rate < LOW_RATE:
        counted = "; t goes up by 1 from row to row: is it the number of the row?" * bool(np.all(steps == 1))
        doubts.append(
            f"is sampled at {rate:.3g} Hz; accelerations need {LOW_RATE:g} Hz or more, and friction at reversals needs more{counted}"
        )
    gaps = [float(t[s.start] - t[s.start - 1]) for s in segments[1:]]
    if gaps and (max(gaps) > LONG_GAP or sum(gaps) > MISSING * (t[-1] - t[0])):
        several = f"{len(gaps)} gaps, the longest" if len(gaps) > 1 else "a gap"
        doubts.append(
            f"has {several} of {max(gaps):.3g} s; {sum(gaps):.3g} of {t[-1] - t[0]:.3g} s are missing, and no derivative crosses a gap"
        )
    return doubts


def stands_still(q: np.ndarray) -> bool:
    """Whether no joint moves along q (n, K)."""
    return bool(np.max(np.ptp(q, axis=1)) < STILL)


def swapped(t: np.ndarray, segments: tuple[slice, ...], q: np.ndarray, dq: np.ndarray) -> list[tuple[int, int]]:
    """Pairs (i, j) of joints where dq of i is the derivative of q of j and not of q of i; q, dq (n, K)."""
    longest = max(segments, key=lambda s: s.stop - s.start)
    part = slice(longest.start, min(longest.stop, longest.start + ROWS))
    computed = differentiate(t[part], q[:, part], [slice(0, part.stop - part.start)])
    with np.errstate(invalid="ignore", divide="ignore"):  # a joint at rest is correlated with nothing
        alike = np.corrcoef(dq[:, part], computed)[: len(q), len(q) :] > CORRELATION
    return [(i, j) for i, j in np.argwhere(alike).tolist() if i != j and not alike[i, i]]


def check_loop(where: str, robot: Robot, torque: np.ndarray) -> None:
    """Raise `UserError` where the median of the torque (n, K) [Nm] that commands and gains give exceeds `TORQUE_FACTOR` effort limits."""
    for i, joint in enumerate(robot.joints):
        middle, limit = float(np.median(np.abs(torque[i]))), float(robot.effort[i])
        if limit > 0 and middle > TORQUE_FACTOR * limit:
            raise UserError(
                f"{where}: 'command_{joint}' and the gains give a median torque of {middle:.3g} Nm, and the effort limit of {joint} is "
                f"{limit:g} Nm; kp in Nm/rad, kd in Nm s/rad and commands in rad are required"
            )


def check_torques(where: str, robot: Robot, torque: np.ndarray, columns: tuple[str, ...], unit: str) -> None:
    """Raise `UserError` where the median of a joint's output torque (n, K) [Nm] exceeds `TORQUE_FACTOR` effort limits."""
    for i, column in enumerate(columns):
        middle, limit = float(np.median(np.abs(torque[i]))), float(robot.effort[i])
        if limit > 0 and middle > TORQUE_FACTOR * limit:
            raise UserError(
                f"{where}: column '{column}' has a median magnitude of {middle:.3g} Nm at the output, and the effort limit "
                f"is {limit:g} Nm; the unit is {unit}, it looks like m{unit}"
            )
