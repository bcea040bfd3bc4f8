# pyright: reportAttributeAccessIssue=false
"""Arms with a little of everything wrong, recorded at dull work: the bench on which strong effects are tried on top of that."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from validation.concealed.arms import Arm
from validation.concealed.bench import Bench, make_arm
from validation.concealed.cases import Case
from validation.concealed.effect import Effect, Signals
from validation.concealed.effects_sensor import TimeDelay, TorqueGain
from validation.concealed.equal import Jacobian, equal_effects
from validation.concealed.imperfections import LAG, WIDTH, Clocks, SmallFriction, SpeedFilter
from validation.concealed.plain import PlainFit, calibrate, smoothed, subset, thinned
from validation.concealed.plant import History, Setup, signals
from validation.concealed.sensors import Sensing
from validation.concealed.stated import perturbed
from validation.concealed.work import DULL, EVERY_JOINT, OTHERS

SEEN = (3, 5)  # recordings that the tool gets
UNSEEN = 2  # further ones, of other motions
SECONDS = (8.0, 20.0)  # that a recording lasts [s]
SWEPT = 0.4  # share of the sets with one sweep
FILTERED = 0.5  # share of the sets that have speeds and accelerations, of the drives' filter
GAIN = (0.003, 0.02)  # error of a torque channel's gain, either sign
DELAY = (5e-4, 3e-3)  # of all torque channels [s]
NOISE = (0.01, 0.02)  # of the torque's standard deviation
COLOURED = (0.3, 0.7)  # share of the noise's variance that is coloured
SPEED_NOISE = (5e-4, 2e-3)  # of the drives' speeds [rad/s]
ACCELERATION_NOISE = (0.02, 0.1)  # [rad/s²]
WIDTHS = np.geomspace(0.3, 4.0, 10)  # of the sign's change that the plain calibration tries, over the arm's own
RIVAL = 0.05  # share of an effect's squared residual that another effect may leave and still count as its equal
TAIL = 0.1  # [s] that the simulation goes on, for clocks that run ahead
FINE = 1e-3  # step of an arm whose dry friction has bristles [s]
RECORDING = (Clocks, SpeedFilter)  # faults of the recording, which come after all others


def imperfect_arm(case: Case) -> Arm:
    """The case's arm with a width of its own, and the URDF that the tool is told."""
    arm, rng = make_arm(case), case.rng("imperfections")
    width = float(np.exp(rng.uniform(*np.log(WIDTH))))
    return replace(arm, width=width, stated_urdf=perturbed(arm.urdf, rng))


def motions(case: Case) -> tuple[tuple[str, ...], int]:
    """Kinds of the recordings, and how many of them the tool sees."""
    rng = case.rng("motions")
    seen = int(rng.integers(SEEN[0], SEEN[1] + 1))
    kinds = [str(rng.choice(EVERY_JOINT)), *(str(k) for k in rng.choice(DULL, seen - 1))]
    if rng.random() < SWEPT:
        kinds[-1] = "sweep_up"
    return (*kinds, *(str(k) for k in rng.choice(OTHERS, UNSEEN, replace=False))), seen


def faults(case: Case, arm: Arm, ends: np.ndarray) -> list[Effect]:
    """The small parts of an arm whose recordings end at `ends` (B,) [s]; what is wrong with the recording comes last."""
    rng = case.rng("faults")
    out: list[Effect] = [SmallFriction.of_arm(arm, rng)]
    for j in range(arm.n):
        out.append(TorqueGain((j,), rng.uniform(*GAIN), {"direction": float(rng.choice([-1, 1]))}))
    out += [TimeDelay((), rng.uniform(*DELAY)), Clocks.of_arm(arm, ends, rng)]
    if rng.random() < FILTERED:
        out.append(SpeedFilter((), rng.uniform(*LAG)))
    return [e.on(np.ones(len(ends))) for e in out]


class ImperfectBench(Bench):
    """A bench whose arm has the small faults in every simulation. Ratios are over the floor that they and the noise leave."""

    def __init__(self, case: Case, duration: float | None = None):
        arm = imperfect_arm(case)
        kinds, seen = motions(case)
        drawn = np.round(case.rng("durations").uniform(*SECONDS, len(kinds)), 1)
        self.ends = drawn if duration is None else np.full(len(kinds), duration)
        self.faults = faults(case, arm, self.ends)
        self.told = replace(arm, urdf=arm.stated_urdf)
        self.width = np.full(arm.n, arm.width)
        super().__init__(case, arm, kinds, seen, float(self.ends.max()) + TAIL)
        self.width = self.best_width()
        fit = self.fit(self.signals([]))
        self.floor, self.imperfections = fit.residual, fit.rms()
        self.level = np.hypot(self.sensing.torque_noise, self.imperfections)  # noise and small faults (n,) [Nm]

    @property
    def listed(self) -> Setup:
        return Setup(self.setup.payload[: self.seen], self.setup.springs[: self.seen], self.setup.gravity)

    def step(self) -> float:
        return min(super().step(), FINE if self.faults[0].shape["reach"].any() else np.inf)

    def noise(self, x: Signals) -> Sensing:
        rng = self.case.rng("noise")
        deviation = np.maximum(rng.uniform(*NOISE) * x.tau.std(axis=(0, 2)), 0.005)  # [Nm]
        filtered = any(isinstance(e, SpeedFilter) for e in self.faults)
        return Sensing(
            deviation,
            coloured=rng.uniform(*COLOURED),
            encoder_bits=int(rng.integers(17, 21)),
            speeds=filtered,
            speed_noise=rng.uniform(*SPEED_NOISE),
            accelerations=filtered,
            acceleration_noise=rng.uniform(*ACCELERATION_NOISE),
        )

    def small(self, effects: Sequence[Effect]) -> list[Effect]:
        """The faults less those whose place a strong effect takes."""
        taken = {(e.name, e.joints) for e in effects if e.strength > 0}
        friction, *others = self.faults
        assert isinstance(friction, SmallFriction)
        for name, joints in taken:
            friction = friction.without(name, joints)
        return [friction, *(e for e in others if (e.name, e.joints) not in taken)]

    def together(self, effects: Sequence[Effect]) -> list[Effect]:
        """Faults and strong effects, in the order in which they act on the recorded signals."""
        small = self.small(effects)
        last = [e for e in small if isinstance(e, RECORDING)]
        return [*(e for e in small if not isinstance(e, RECORDING)), *effects, *last]

    def history(self, effects: list[Effect]) -> History:
        return super().history([e for e in self.together(effects) if not isinstance(e, RECORDING)])

    def signals(self, effects: list[Effect]) -> Signals:
        history = self.history(effects)
        finite = bool(np.all(np.isfinite(history.ddtheta)))
        return signals(history, self.arm, self.together(effects) if finite else [], self.case.torque)

    def thin(self, x: Signals, rate: float = 25.0) -> Signals:
        """The seen recordings at a lower rate [Hz], smoothed where transmissions ring."""
        return subset(thinned(smoothed(x) if self.rings else x, rate), slice(self.seen))

    def calibrated(self, x: Signals, width: np.ndarray) -> PlainFit:
        """As the tool would, of seen recordings: with the URDF that it is told, and a width (n,) of the sign's change."""
        return calibrate(self.told, self.listed, x, width, x.t <= self.ends[: self.seen, None])

    def fit(self, x: Signals) -> PlainFit:
        return self.calibrated(self.thin(x, 50.0), self.width)

    def best_width(self) -> np.ndarray:
        """Of each joint's dry friction, by the residual that it leaves (n,) [rad/s]."""
        x, widths = self.thin(self.signals([]), 50.0), np.outer(WIDTHS, self.width)
        left = np.array([self.calibrated(x, w).rms() for w in widths])
        return np.take_along_axis(widths, left.argmin(axis=0)[None], axis=0)[0]

    def ratio(self, fit: PlainFit, has: np.ndarray) -> np.ndarray:
        return replace(fit, residual=fit.residual - self.floor).rms(has) / self.level

    def equal(self, effect: Effect) -> dict | None:
        x, without = (self.thin(self.signals(e)) for e in ([effect], []))
        fit = self.calibrated(x, self.width)
        fit = replace(fit, residual=fit.residual - self.calibrated(without, self.width).residual)
        return equal_effects(Jacobian(self.told, self.listed, x, fit), self.level, effect, 4.0, RIVAL)
