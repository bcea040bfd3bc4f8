"""Which cases exist: every declaration is a few words and a seed; `build.py` turns it into recordings."""

import hashlib
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from validation.concealed.catalogue import CATALOGUE, FIRST, OUTSIDE, RECORDED_AS, RELATIVES, TWO_JOINTS

RATIOS = (3.0, 1.0, 0.5)  # residual after plain calibration / noise
OWN = tuple(f"set-up {b + 1}" for b in range(8))  # of recordings that share none
FAINT = (0.3, 0.2, 0.1, 0.05)
IMPERFECT = "imperfect"  # the kind whose arms have small faults everywhere
IMPERFECT_CASES = 130  # of a seed
STRONG = (3.0, 8.0)  # strong effects of imperfect arms, over the floor that noise and small faults leave
ROBOTS = ("rrr", "rrr_prototype", "arm1", "arm2", "arm3", "arm4", "arm5", "arm6", "arm7")


@dataclass(frozen=True)
class Concealed:
    """An effect to conceal, how strongly, and in which of the recording groups (None: everywhere)."""

    effect: str
    ratio: float
    groups: tuple[str, ...] | None = None


@dataclass(frozen=True)
class Case:
    """One data set to make. `key` is unique among the cases of a seed."""

    key: str
    kind: str
    seed: int
    robot: str
    concealed: tuple[Concealed, ...] = ()
    short: bool = False  # 4 × 15 s, 2.5 × the noise, jitter, lost samples; else 8 × 30 s
    torque: str = "motor"
    inertial: str = "nominal"
    motor: bool = False  # the prototype's motors, Eq. 7–9
    alone: bool = False  # each recording is a set-up of its own; else two of them are of one group, where groups matter
    locked: int = 0  # further joints of the URDF that are not recorded
    options: dict = field(default_factory=dict)  # of Sensing

    @property
    def id(self) -> str:
        return hashlib.sha256(f"concealed/{self.seed}/{self.key}".encode()).hexdigest()[:12]

    def rng(self, purpose: str) -> np.random.Generator:
        return np.random.default_rng([self.seed, zlib.crc32(f"{self.key}/{purpose}".encode())])


def fitting_robot(names: tuple[str, ...], rng: np.random.Generator, choices: tuple[str, ...] = ROBOTS) -> str:
    """A robot on which all these effects can exist."""
    two = any(name in TWO_JOINTS for name in names)
    return str(rng.choice([r for r in choices if not (two and r == "arm1")]))


def declare(seed: int = 0) -> list[Case]:
    """All cases of a seed, in a fixed order."""
    cases: list[Case] = []
    for make in (
        clean,
        single,
        short_single,
        faint,
        some_recordings,
        several,
        related,
        outside,
        other_data,
        one_recording,
        imperfect,
    ):
        cases += make(seed)
    keys = [c.key for c in cases]
    if len(set(keys)) != len(keys):
        raise ValueError("two cases have the same key")
    return cases


def draw(seed: int, key: str) -> np.random.Generator:
    return np.random.default_rng([seed, zlib.crc32(f"{key}/declare".encode())])


def options(rng: np.random.Generator) -> dict:
    """Half of the standard data sets are tidy; the rest have coloured noise, speeds or mild jitter."""
    return [{}, {}, {}, {"coloured": 0.3}, {"speeds": True}, {"jitter": 0.1}][rng.integers(6)]


def clean(seed: int) -> list[Case]:
    """Nothing is missing: 160 short sets and 20 standard ones."""
    out = []
    for i in range(180):
        key = f"clean/{i}"
        rng = draw(seed, key)
        short = i < 160
        out.append(Case(key, "clean", seed, fitting_robot((), rng), short=short, options={} if short else options(rng)))
    return out


def recorded_as(name: str) -> dict[str, Any]:
    """Options of a case that is to conceal an effect."""
    return {"torque": RECORDED_AS[name]} if name in RECORDED_AS else {}


def single(seed: int) -> list[Case]:
    """Every effect of the catalogue at three strengths, once on an arm of the paper and once on a generated one."""
    out = []
    for name in CATALOGUE:
        for ratio in RATIOS:
            for family, choices in (("rrr", ROBOTS[:2]), ("arm", ROBOTS[2:])):
                key = f"single/{name}/{ratio}/{family}"
                rng = draw(seed, key)
                robot = fitting_robot((name,), rng, choices)
                concealed = (Concealed(name, ratio),)
                out.append(Case(key, "single", seed, robot, concealed, options=options(rng), **recorded_as(name)))
    return out


def short_single(seed: int) -> list[Case]:
    """Every effect of the catalogue in a small and untidy data set."""
    out = []
    for name in CATALOGUE:
        for ratio in RATIOS[:2]:
            key = f"short/{name}/{ratio}"
            robot = fitting_robot((name,), draw(seed, key))
            out.append(Case(key, "short", seed, robot, (Concealed(name, ratio),), short=True, **recorded_as(name)))
    return out


def faint(seed: int) -> list[Case]:
    """Every effect of the catalogue about as weak as can be told from noise, in a small and untidy data set."""
    out = []
    for name in CATALOGUE:
        for ratio in FAINT:
            key = f"faint/{name}/{ratio}"
            robot = fitting_robot((name,), draw(seed, key))
            out.append(Case(key, "faint", seed, robot, (Concealed(name, ratio),), short=True, **recorded_as(name)))
    return out


def some_recordings(seed: int) -> list[Case]:
    """Effects that only one group of two recordings has."""
    names = (
        "payload_mass",
        "payload_com",
        "torque_gain",
        "torque_offset",
        "encoder_offset",
        "cable_harness",
        "parallel_spring",
        "spring_stiffness",
        "spring_preload",
        "gravity_tilt",
        "time_delay",
        "load_dependent_friction",
    )
    return [_of_a_group(seed, "some", name, ratio, ["a", "b", "c", "d"]) for name in names for ratio in RATIOS[:2]]


def one_recording(seed: int) -> list[Case]:
    """Effects that one recording has of eight, or of four in an untidy set, none of which shares a set-up with another."""
    names = (
        "payload_mass",
        "torque_gain",
        "torque_offset",
        "cable_harness",
        "parallel_spring",
        "spring_stiffness",
        "time_delay",
    )
    return [_of_a_group(seed, "alone", name, ratio, OWN) for name in names for ratio in RATIOS[:2]]


def _of_a_group(seed: int, kind: str, name: str, ratio: float, groups: Sequence[str]) -> Case:
    """An effect that one of the groups has; where each recording is one, some sets are short."""
    key, alone = f"{kind}/{name}/{ratio}", groups is OWN
    rng = draw(seed, key)
    short = alone and bool(rng.random() < 0.3)
    group = str(rng.choice(groups[:4] if short else groups))
    return Case(key, kind, seed, fitting_robot((name,), rng), (Concealed(name, ratio, (group,)),), short=short, alone=alone)


def several(seed: int) -> list[Case]:
    """Pairs and triples of the catalogue as it was first."""
    out = []
    for kind, count, size in (("pair", 36, 2), ("triple", 18, 3)):
        for i in range(count):
            key = f"{kind}/{i}"
            rng = draw(seed, key)
            names = tuple(str(x) for x in rng.choice(list(FIRST), size, replace=False))
            while {"joint_elasticity", "backlash"} <= set(names):  # one transmission is one or the other
                names = tuple(str(x) for x in rng.choice(list(FIRST), size, replace=False))
            robot = fitting_robot(names, rng, tuple(r for r in ROBOTS if r != "arm1"))
            concealed = tuple(Concealed(n, float(rng.choice([3.0, 2.0, 1.0]))) for n in names)
            out.append(Case(key, kind, seed, robot, concealed, options=options(rng)))
    return out


def related(seed: int) -> list[Case]:
    """Each relative of a law of the catalogue beside another effect, twice."""
    out = []
    for name in RELATIVES:
        for i in range(2):
            key = f"related/{name}/{i}"
            rng = draw(seed, key)
            names = (name, str(rng.choice(FIRST)))
            robot = fitting_robot(names, rng, tuple(r for r in ROBOTS if r != "arm1"))
            concealed = tuple(Concealed(n, float(rng.choice([3.0, 2.0, 1.0]))) for n in names)
            out.append(Case(key, "related", seed, robot, concealed, options=options(rng), **recorded_as(name)))
    return out


def outside(seed: int) -> list[Case]:
    """Effects that the catalogue does not have, alone and beside one that it has."""
    out = []
    robots = tuple(r for r in ROBOTS if r != "arm1")
    for name in OUTSIDE:
        for ratio in RATIOS:
            key = f"outside/{name}/{ratio}"
            out.append(Case(key, "outside", seed, fitting_robot((name,), draw(seed, key), robots), (Concealed(name, ratio),)))
        key = f"outside_pair/{name}"
        rng = draw(seed, key)
        other = str(rng.choice(list(FIRST)))
        concealed = (Concealed(name, 2.0), Concealed(other, 2.0))
        out.append(Case(key, "outside_pair", seed, fitting_robot((name, other), rng, robots), concealed))
    return out


def other_data(seed: int) -> list[Case]:
    """Other kinds of data: currents, load torques, commands of a loop, unknown inertials, locked joints, the prototype's motors."""
    out = []
    of_motor = ("load_dependent_friction", "stribeck", "torque_ripple")  # a load torque does not hold them
    effects: tuple[str | None, ...] = (None, *of_motor, "cable_harness", "payload_mass", "encoder_offset")
    kinds: dict[str, dict] = {
        "current": {"torque": "current"},
        "load": {"torque": "load"},
        "command": {"torque": "command"},
        "identify": {"inertial": "identify"},
        "locked": {"locked": 2},
        "motor": {"motor": True},
    }
    for kind, extra in kinds.items():
        for name in effects:
            if (kind == "load" and name in of_motor) or (kind == "identify" and name == "payload_mass"):
                continue
            key = f"{kind}/{name}"
            rng = draw(seed, key)
            choices = {"motor": ROBOTS[1:2], "identify": ROBOTS[3:7], "locked": ROBOTS[3:7]}.get(kind, ROBOTS)
            concealed = (Concealed(name, 2.0),) if name else ()
            robot = fitting_robot((name,) if name else (), rng, choices)
            if kind == "motor" and name == "load_dependent_friction":
                continue  # the motors have it already
            out.append(Case(key, kind, seed, robot, concealed, **extra))
    return out


def imperfect(seed: int) -> list[Case]:
    """Arms with small faults everywhere. Half of them have one or two strong effects besides, dealt evenly from the first catalogue."""
    out = []
    rng = draw(seed, IMPERFECT)
    deck = [str(x) for _ in range(1 + IMPERFECT_CASES // len(FIRST)) for x in rng.permutation(list(FIRST))]
    for i in range(IMPERFECT_CASES):
        key = f"{IMPERFECT}/{i}"
        rng = draw(seed, key)
        names: tuple[str, ...] = ()
        if i % 2:
            names = (deck.pop(), deck.pop()) if rng.random() < 0.3 else (deck.pop(),)
        if len(set(names)) < len(names) or {"joint_elasticity", "backlash"} <= set(names):
            names = names[:1]
        concealed = tuple(Concealed(name, round(float(rng.uniform(*STRONG)), 1)) for name in names)
        torque = "current" if rng.random() < 0.2 else "motor"
        out.append(Case(key, IMPERFECT, seed, fitting_robot(names, rng), concealed, torque=torque))
    return out
