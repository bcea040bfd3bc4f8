# pyright: reportAttributeAccessIssue=false
"""Does every undamaged set, however awkward, get through a whole diagnosis, or is it refused in one sentence?

    python validation/awkward_sets.py --sets 80 --out results/awkward

Real logs are short or slow, of joints that rest or of links that no torque depends on, saturated, of coarse encoders, late or of wrong columns.
Small arms are recorded in such ways on a plant that shares no code with the package: Pinocchio's recursive Newton–Euler and friction. Each set
goes through `rrr-oc diagnose` in a process of its own. Set i follows from i alone: the first are awkward in one way each, the others in two.
An interrupted run goes on where it was, and `--only I` shows one set. Counted are exit statuses, warnings of Python and steps that failed.
The counts and all faults are in out/awkward.json.
"""

import json
import os
import re
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pinocchio as pin
import typer

LONGEST = 900  # [s] of one diagnosis
WARNED = re.compile(r"\w+Warning: .*")  # of Python, with its file and line before it
DRY, VISCOUS, ROTOR, WIDTH = 0.4, 0.2, 0.03, 0.02  # of each joint [Nm], [Nm s/rad], [kg m²], [rad/s]
LINK = (1.5, 0.15, 0.01)  # mass [kg], distance of its centre [m], moments of inertia [kg m²]
# Axis, and mass, centre and inertia, of each joint's link; links are 0.3 m long, along z
ARMS = {
    "pendulum": [("0 1 0", *LINK)],
    "planar": [("0 1 0", *LINK), ("0 1 0", *LINK)],
    "turntable": [("0 0 1", *LINK)],  # no gravity
    "pan and tilt": [("0 0 1", *LINK), ("0 1 0", *LINK)],
    "massless": [("0 1 0", *LINK), ("0 1 0", 1e-6, 0.0, 1e-9)],  # its torque is friction alone
    "wrist": [("0 1 0", *LINK), ("0 0 1", 0.5, 0.1, 1e-4)],  # its centre is on its axis
    "three": [("0 0 1", *LINK), ("0 1 0", *LINK), ("0 1 0", *LINK)],
    "parallel axes": [("0 0 1", *LINK), ("0 0 1", *LINK)],  # without gravity in any joint
}


@dataclass(frozen=True)
class Way:
    """How an arm is recorded.

    Attributes:
        seconds, rate, count: Length [s], samples a second, and number of recordings.
        amplitude, fastest: Of the motion [rad], [rad/s].
        still: Whether the last joint stays where it is.
        one_way: Whether joints only go forward.
        scale: Of all torques.
        noise: Of torques, over their size.
        limit: Where the drives saturate, over the largest torque.
        late: Delay of the torques [s].
        bits: Of the encoders.
        twice: Whether all recordings are the first one.
        swapped, absolute: Whether the columns of torque are in another order, and the last angle is the sum of all.
        spring: Stiffness of a spring at the last joint that no header lists and that is always taut [Nm/rad].
        wander: Rms of torques that depend on time alone [Nm].
        heavier: Masses and inertias over those of the URDF.
        inertial, torque: As in the header.
    """

    seconds: float = 4.0
    rate: float = 100.0
    count: int = 3
    amplitude: float = 1.0
    fastest: float = 2.0
    still: bool = False
    one_way: bool = False
    scale: float = 1.0
    noise: float = 0.01
    limit: float = np.inf
    late: float = 0.0
    bits: int = 20
    twice: bool = False
    swapped: bool = False
    absolute: bool = False
    spring: float = 0.0
    wander: float = 0.0
    heavier: float = 1.0
    inertial: str = "nominal"
    torque: str = "motor"


WAYS: dict[str, dict[str, Any]] = {
    "usual": {},
    "0.7 s": {"seconds": 0.7},
    "1 s": {"seconds": 1.0},
    "3 s": {"seconds": 3.0},
    "slow": {"fastest": 0.03},
    "still": {"still": True},
    "small": {"amplitude": 0.01, "fastest": 0.05},
    "one way": {"one_way": True},
    "saturated": {"limit": 0.5},
    "torque 0": {"scale": 0.0},
    "tiny torques": {"scale": 1e-6},
    "huge torques": {"scale": 1e6},
    "no noise": {"noise": 0.0},
    "noise alone": {"noise": 10.0},
    "12 bits": {"bits": 12},
    "20 Hz": {"rate": 20.0, "seconds": 10.0},
    "1 kHz": {"rate": 1000.0, "seconds": 3.0},
    "50 ms late": {"late": 0.05},
    "twice": {"twice": True},
    "one": {"count": 1},
    "two": {"count": 2},
    "swapped": {"swapped": True},
    "absolute": {"absolute": True},
    "spring": {"spring": 3.0},
    "wander": {"wander": 0.3},
    "heavier": {"heavier": 1.3},
    "identify": {"inertial": "identify"},
    "load": {"torque": "load"},
}


def urdf(arm: list[tuple[str, float, float, float]], effort: float = 100.0) -> str:
    """A chain of these links, with a limit of the torques [Nm]."""
    text = '<robot name="arm"><link name="l0"/>'
    for i, (axis, mass, centre, inertia) in enumerate(arm, 1):
        text += (
            f'<link name="l{i}"><inertial><origin xyz="0 0 {centre}"/><mass value="{mass}"/><inertia ixx="{inertia}" ixy="0" ixz="0" '
            f'iyy="{inertia}" iyz="0" izz="{inertia}"/></inertial></link><joint name="j{i}" type="revolute"><parent link="l{i - 1}"/>'
            f'<child link="l{i}"/><origin xyz="0 0 {0.3 * (i > 1)}"/><axis xyz="{axis}"/>'
            f'<limit lower="-12" upper="12" effort="{effort}" velocity="10"/></joint>'
        )
    return text + "</robot>"


def motion(rng: np.random.Generator, way: Way, t: np.ndarray, n: int) -> np.ndarray:
    """Angles, speeds and accelerations (3, n, K) of Fourier series of four harmonics."""
    order = 2 * np.pi * 0.2 * np.arange(1, 5)[:, None, None]
    phase, size = rng.uniform(0, 2 * np.pi, (4, n, 1)), rng.uniform(0.5, 1, (4, n, 1)) / order
    x = order * t + phase
    found = np.array([(size * part).sum(axis=0) for part in (np.sin(x), order * np.cos(x), -(order**2) * np.sin(x))])
    found *= min(way.amplitude / np.abs(found[0]).max(), way.fastest / np.abs(found[1]).max())
    if way.one_way:
        fast = 1.05 * np.abs(found[1]).max()
        found[0] += fast * t
        found[1] += fast
    if way.still:
        found[:, -1] = np.array([0.4, 0, 0])[:, None]
    return found


def recorded(rng: np.random.Generator, way: Way, arm: list[tuple[str, float, float, float]]) -> dict[str, np.ndarray]:
    """A recording's columns."""
    real = [(axis, way.heavier * mass, centre, way.heavier * inertia) for axis, mass, centre, inertia in arm]
    model, t = pin.buildModelFromXML(urdf(real)), np.arange(0, way.seconds, 1 / way.rate)
    data, n = model.createData(), len(arm)
    q, dq, ddq = motion(rng, way, t, n)
    tau = np.array([pin.rnea(model, data, *x) for x in zip(q.T, dq.T, ddq.T, strict=True)]).T
    if way.torque == "motor":
        tau += DRY * np.tanh(dq / WIDTH) + VISCOUS * dq + ROTOR * ddq
    tau[-1] += way.spring * (q[-1] - 3.0)
    tau += way.wander * np.cumsum(rng.standard_normal(tau.shape), axis=1) / np.sqrt(t.size / 2)
    tau = np.array([np.interp(t - way.late, t, x) for x in tau])
    tau = tau + way.noise * tau.std() * rng.standard_normal(tau.shape)
    most = way.limit * np.abs(tau).max()
    tau = way.scale * np.clip(tau, -most, most)
    step = 2 * np.pi / 2**way.bits
    q = step * np.round(q / step)
    if way.absolute:
        q[-1] = q.sum(axis=0)
    names = [f"j{k + 1}" for k in range(n)]
    columns = {f"q_{name}": x for name, x in zip(names, q, strict=True)}
    return {"t": t} | columns | {f"tau_{name}": x for name, x in zip(names, tau[::-1] if way.swapped else tau, strict=True)}


def described(i: int) -> tuple[str, tuple[str, ...], Way]:
    """Arm, ways by name and as a whole, of set i."""
    rng, arms, names = np.random.default_rng([i, 1]), list(ARMS), list(WAYS)
    some = (names[i],) if i < len(names) else tuple(sorted(map(str, rng.choice(names[1:], 2, replace=False))))
    way = Way()
    for name in some:
        way = replace(way, **WAYS[name])
    return arms[i % len(arms)], some, way


def write_set(i: int, folder: Path) -> None:
    """Set i in a folder."""
    name, _, way = described(i)
    arm, files = ARMS[name], [f"r{k}.csv" for k in range(way.count)]
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "arm.urdf").write_text(urdf(arm, 100 * max(way.scale, 1.0)))
    for k, file in enumerate(files):
        columns = recorded(np.random.default_rng([i, 0 if way.twice else k]), way, arm)
        np.savetxt(folder / file, np.array(list(columns.values())).T, "%.10g", ",", header=",".join(columns), comments="")
    header = {"format": "rrr_oc-recordings/1", "robot": "arm.urdf", "joints": [f"j{k + 1}" for k in range(len(arm))]}
    more = {"torque": way.torque, "inertial": way.inertial, "recordings": [{"file": file} for file in files]}
    (folder / "recordings.json").write_text(json.dumps(header | more))


def outcome(i: int, folder: Path, run: Callable[..., Any] = subprocess.run) -> dict[str, Any]:
    """What comes of the diagnosis of set i."""
    write_set(i, folder / "set")
    command = [sys.executable, "-m", "rrr_oc", "diagnose", str(folder / "set"), "--out", str(folder / "out"), "--jobs", "1"]
    began = time.perf_counter()
    ended = run(
        command, capture_output=True, text=True, timeout=LONGEST, env=os.environ | {"PYTHONWARNINGS": "always"}, check=False
    )
    file, (arm, ways, _) = folder / "out" / "diagnosis.json", described(i)
    found = json.loads(file.read_text()) if ended.returncode == 0 else {}
    return {
        "set": i,
        "arm": arm,
        "ways": ways,
        "status": ended.returncode,
        "seconds": round(time.perf_counter() - began, 1),
        "said": next((line for line in ended.stderr.splitlines() if line.startswith("Error: ")), ""),
        "warned": sorted(set(WARNED.findall(ended.stderr))),
        "failed": found.get("failed", {}),
        "verdict": found.get("verdict"),
        "effects": [[e["effect"], e["joint"]] for e in found.get("effects", ())],
    }


def wrong(one: dict[str, Any]) -> bool:
    """Whether an outcome is a fault."""
    return one["status"] not in (0, 2) or bool(one["warned"] or one["failed"])


def main(
    out: Annotated[Path, typer.Option(help="folder of the results")],
    sets: Annotated[int, typer.Option(help="sets altogether")] = 80,
    only: Annotated[int | None, typer.Option(help="one set, whose files stay in the folder")] = None,
) -> None:
    """Diagnose awkward sets, and count what comes of them."""
    if only is not None:
        print(json.dumps(outcome(only, out / str(only)), indent=1))
        return
    out.mkdir(parents=True, exist_ok=True)
    place = out / "awkward.json"
    every = json.loads(place.read_text()) if place.is_file() else []
    for i in range(len(every), sets):
        with tempfile.TemporaryDirectory() as folder:
            every.append(outcome(i, Path(folder)))
        print(json.dumps(every[-1]), flush=True)
        place.write_text(json.dumps(every, indent=1))
    print(dict(Counter(one["status"] for one in every)), f"{sum(map(wrong, every))} faults in {len(every)} sets")


if __name__ == "__main__":
    typer.run(main)
