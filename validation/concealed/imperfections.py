"""The small faults that every real arm has, of all joints at once: friction of several parts, clocks, somebody's filter."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.interpolate import CubicHermiteSpline
from scipy.signal import butter, sosfilt

from validation.concealed.arms import Arm
from validation.concealed.effect import Effect, Forces, Signals, State

LAWS = ("tanh", "tanh", "algebraic", "arctan", "bristles")  # of the change of dry friction's sign with speed
WIDTH = (0.015, 0.08)  # [rad/s] over which it changes, drawn per arm on a logarithmic scale, and ± 25 % per joint
REACH = (2e-4, 2e-3)  # of the bristles [rad]
EXCESS = (0.04, 0.16)  # of dry friction that falls off with speed, a tenth on average
FALL = (0.03, 0.15)  # speed over which it falls, as a share of the arm's fastest reference
LOAD = (0.003, 0.02)  # of the load that rubs
RIPPLE = (0.01, 0.05)  # of dry friction
POSITION = (0.01, 0.05)  # of dry friction
ASYMMETRY = (0.01, 0.06)  # of dry friction
CLOCK = 3e-3  # largest offset of a joint's clock [s]
CLOCK_DRIFT = 2e-3  # largest change of it over a recording [s]
LAG = (2e-3, 6e-3)  # of filtered speeds [s]; accelerations pass the filter twice


@dataclass(frozen=True)
class SmallFriction(Effect):
    """Several small parts at every joint. All of `shape` but the law are arrays (n,); a part that is nil is not there.

    The sign of the speed v is tanh(v/w), v/√(v² + w²), 2/π arctan(π v/2w), or a bristle's z with reach dz/dt = |v| (tanh(v/w) − z).
    """

    name = "small_friction"
    equation = (
        "-(f_c + excess exp(-(v/velocity)²) + asymmetry/2 s + level cos(order q - phase) + mu |tau_l|) s + amplitude sin(...)"
    )
    catalogue = False

    @classmethod
    def of_arm(cls, arm: Arm, rng: np.random.Generator) -> "SmallFriction":
        n, level = arm.n, arm.coulomb
        law = str(rng.choice(LAWS))
        shape = {
            "law": law,
            "width": arm.width * rng.uniform(0.75, 1.25, n),
            "reach": rng.uniform(*REACH, n) if law == "bristles" else np.zeros(n),
            "level": level,
            "excess": level * rng.uniform(*EXCESS, n),
            "velocity": arm.speed * rng.uniform(*FALL, n),
            "mu": rng.uniform(*LOAD, n),
            "asymmetry": level * rng.uniform(*ASYMMETRY, n) * rng.choice([-1, 1], n),
            "ripple": level * rng.uniform(*RIPPLE, n),
            "ripple_order": rng.integers(5, 25, n),
            "ripple_phase": rng.uniform(0, 2 * np.pi, n),
            "wave": level * rng.uniform(*POSITION, n),
            "wave_order": rng.integers(1, 5, n),
            "wave_phase": rng.uniform(0, 2 * np.pi, n),
        }
        return cls(tuple(range(n)), 1.0, shape)

    def without(self, effect: str, joints: tuple[int, ...]) -> "SmallFriction":
        """The same less one part of a joint; itself where it has no such part."""
        if effect not in SIZES:
            return self
        size = self.shape[SIZES[effect]].copy()
        size[list(joints)] = 0
        return replace(self, shape=self.shape | {SIZES[effect]: size})

    def memory(self, shape: tuple[int, int]):
        return np.zeros(shape)

    def push(self, s: State, f: Forces, memory: Any) -> None:
        x = self.shape
        sign, slope = self.sign(s.w)
        bristles = x["reach"] > 0
        f.sign[:] = np.where(bristles, memory, sign)
        f.slope[:] = np.where(bristles, 0.0, slope)
        f.dry += x["excess"] * np.exp(-((s.w / x["velocity"]) ** 2)) + 0.5 * x["asymmetry"] * f.sign
        f.dry += x["wave"] * np.cos(x["wave_order"] * s.theta - x["wave_phase"])
        f.rotor += x["ripple"] * np.sin(x["ripple_order"] * s.theta + x["ripple_phase"])
        f.mu += x["mu"]

    def sign(self, w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Of speeds (..., n), and its derivative [s/rad]; bristles start from tanh."""
        width = self.shape["width"]
        v = w / width
        if self.shape["law"] == "algebraic":
            root = np.sqrt(1 + v**2)
            return v / root, 1 / (width * root**3)
        if self.shape["law"] == "arctan":
            return 2 / np.pi * np.arctan(np.pi / 2 * v), 1 / (width * (1 + (np.pi / 2 * v) ** 2))
        sign = np.tanh(v)
        return sign, (1 - sign**2) / width

    def advance(self, s: State, memory: Any, step: float):
        if not self.shape["reach"].any():
            return memory
        towards = np.tanh(s.w / self.shape["width"])
        passed = np.abs(s.w) * step / np.maximum(self.shape["reach"], 1e-9)
        return towards + (memory - towards) * np.exp(-passed)

    def parts(self, j: int) -> dict[str, dict[str, tuple[Any, str]]]:
        """What is really there at a joint: effect of the catalogue -> parameter -> (value, unit)."""
        x = {k: v if k == "law" else v[j] for k, v in self.shape.items()}
        every = {
            "stribeck": {"excess": (x["excess"], "Nm"), "velocity": (x["velocity"], "rad/s")},
            "load_dependent_friction": {"mu": (x["mu"], "1")},
            "coulomb_asymmetry": {"asymmetry": (x["asymmetry"], "Nm")},
            "torque_ripple": harmonic(x["ripple"], x["ripple_order"], x["ripple_phase"]),
            "position_dependent_friction": harmonic(x["wave"], x["wave_order"], x["wave_phase"]),
            "presliding_hysteresis": {
                "stiffness": (x["level"] / max(x["reach"], 1e-12), "Nm/rad"),
                "law": ("smooth_dahl", ""),
            },
        }
        return {effect: p for effect, p in every.items() if x[SIZES[effect]] != 0}


def harmonic(amplitude: float, order: int, phase: float) -> dict[str, tuple[Any, str]]:
    """Parameters of what is periodic in a joint's angle."""
    return {"amplitude": (amplitude, "Nm"), "order": (order, "cycles per joint turn"), "phase": (phase, "rad")}


SIZES = {
    "stribeck": "excess",
    "load_dependent_friction": "mu",
    "coulomb_asymmetry": "asymmetry",
    "torque_ripple": "ripple",
    "position_dependent_friction": "wave",
    "presliding_hysteresis": "reach",
}  # the entry of `SmallFriction.shape` that is nil where an effect is not there


@dataclass(frozen=True)
class Clocks(Effect):
    """What is stamped t was measured at t + offset + drift t/end, by a clock of each joint; `drift` (B, n), `end` (B,) [s]."""

    name = "clocks"
    equation = "recorded x_j(t) = x_j(t + offset_j + drift_j t/end)"
    catalogue = False

    @classmethod
    def of_arm(cls, arm: Arm, ends: np.ndarray, rng: np.random.Generator) -> "Clocks":
        shape = {
            "offset": rng.uniform(-CLOCK, CLOCK, arm.n),
            "drift": rng.uniform(-CLOCK_DRIFT, CLOCK_DRIFT, (len(ends), arm.n)),
            "end": ends,
        }
        return cls(tuple(range(arm.n)), 1.0, shape)

    def sense(self, x: Signals, arm: Arm) -> None:
        for b, end in enumerate(self.shape["end"]):
            for j in range(arm.n):
                at = np.clip(x.t + self.shape["offset"][j] + self.shape["drift"][b, j] * x.t / end, x.t[0], x.t[-1])
                x.q[b, j] = CubicHermiteSpline(x.t, x.q[b, j], x.dq[b, j])(at)
                for signal in (x.dq, x.ddq, x.tau):
                    signal[b, j] = np.interp(at, x.t, signal[b, j])


@dataclass(frozen=True)
class SpeedFilter(Effect):
    """The drives' own speeds and accelerations: a causal Butterworth filter of second order once, and twice."""

    name = "speed_filter"
    equation = "recorded dq = F dq, ddq = F F ddq, F a low-pass filter that lags by `lag`"
    catalogue = False

    @property
    def cutoff(self) -> float:
        """[Hz]; such a filter delays slow signals by √2 / ω."""
        return np.sqrt(2) / (2 * np.pi * self.strength)

    def sense(self, x: Signals, arm: Arm) -> None:
        sos = butter(2, self.cutoff, fs=1 / (x.t[1] - x.t[0]), output="sos")
        x.dq[:] = sosfilt(sos, x.dq, axis=2)
        x.ddq[:] = sosfilt(sos, sosfilt(sos, x.ddq, axis=2), axis=2)
