# pyright: reportAttributeAccessIssue=false
"""The recordings of `rrr-oc demo`, made by an arm with hidden physics, and the truth about it.

    .venv/bin/python -m validation.demo --out rrr_oc/data/demo

The plant is that of `validation/chains/`, which shares no code with the package: an arm of two joints in a vertical plane moves as
planned, and encoders of 18 bit and noisy torques are written down at 100 Hz. Its URDF has the usual errors of masses, and does not know
that a hose pulls at the elbow, that the grease of the shoulder is thick at low speed, and that a camera was mounted at the tool.
truth.json says so; of all commands `rrr-oc demo` alone reads it, after its diagnosis.
"""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from validation.chains.arms import Arm, ArmKind, described, random_arm
from validation.chains.chain import Chain, measure
from validation.chains.effects import Effect
from validation.chains.motions import Pace, points, sines
from validation.chains.plant import planned

SEED = 4
CAMERA = 0.35  # [kg] at the tool
HIDDEN = {
    "a hose that pulls at the elbow": Effect("cable_harness", (1,), {"stiffness": 0.8, "rest": 0.3}),  # [Nm/rad], [rad]
    "grease that is thick at low speed": Effect("stribeck", (0,), {"excess": 0.6, "velocity": 0.12}),  # [Nm], [rad/s]
}
KIND = ArmKind("yy", (0.35, 0.3), (3.0, 1.5), dry=(0.05, 0.08), viscous=(0.05, 0.08), rotor=(0.2, 0.4), width=0.015)
CHAIN = Chain(rate=100.0, bits=18, position_noise=1e-5, torque_noise=0.02)
PACE = Pace(12.0, 2.0, 1.2, 0.12)
MOTIONS = (sines, points, sines, points)


class DemoArm(Arm):
    """An arm with names as people say them."""

    @property
    def joints(self) -> tuple[str, ...]:
        return ("shoulder", "elbow")

    @property
    def links(self) -> tuple[str, ...]:
        return ("upper_arm", "forearm")


def arms() -> tuple[Arm, Arm]:
    """The arm as it is, and as its file has it."""
    rng = np.random.default_rng(SEED)
    drawn = random_arm(KIND, rng)
    designed = DemoArm(**{name: getattr(drawn, name) for name in drawn.__dataclass_fields__})
    return designed.with_mass(CAMERA), described(designed, rng)


def write(out: Path) -> None:
    """The arm's file, its recordings with their header, and the truth."""
    true, listed = arms()
    (out / "recordings").mkdir(parents=True, exist_ok=True)
    (out / "arm.urdf").write_text(listed.urdf.replace('name="arm"', 'name="demo"'))
    files = []
    for i, motion in enumerate(MOTIONS):
        rng = np.random.default_rng([SEED, i])
        plan = motion(true.n, PACE, rng)
        exact = planned(true, [*HIDDEN.values()], plan, np.zeros_like(plan[1]))
        rows = measure(CHAIN, exact.t, (exact.q, exact.v, exact.tau), true.usual, rng)
        files.append(f"{motion.__name__}{i // 2 + 1}.csv")
        names = ["t", *(f"{kind}_{joint}" for kind in ("q", "tau") for joint in true.joints)]
        table = np.vstack([rows.t, rows.q, rows.tau]).T
        np.savetxt(out / "recordings" / files[-1], table, fmt="%.6g", delimiter=",", header=",".join(names), comments="")
    (out / "recordings" / "recordings.json").write_text(json.dumps(header(true.joints, files), indent=1) + "\n")
    (out / "truth.json").write_text(json.dumps(truth(true, listed), indent=1) + "\n")


def header(joints: Sequence[str], files: Sequence[str]) -> dict[str, Any]:
    """The content of recordings.json."""
    return {
        "format": "rrr_oc-recordings/1", "robot": "../arm.urdf", "joints": joints, "torque": "motor",
        "recordings": [{"file": file} for file in files],
    }  # fmt: skip


def truth(true: Arm, listed: Arm) -> dict[str, Any]:
    """What is hidden: effects with their parameters [SI], and what the camera does to the forearm, about the elbow."""
    effects = [{"says": says, **effect.truth(true)} for says, effect in HIDDEN.items()]
    of_arm, of_file = (moments(arm.bodies[-1].inertia) for arm in (true, listed))
    links = {"says": f"a camera of {CAMERA:g} kg at the tool", "link": true.links[-1], "joint": true.joints[-1]}
    return {"effects": effects, "links": [links | of_arm | {"urdf": of_file}]}


def moments(body: pin.Inertia) -> dict[str, Any]:
    """First moment (3,) [kg m] in the frame of the body's joint, and inertia about this joint's axis y [kg m²]."""
    about = body.inertia + body.mass * (body.lever @ body.lever * np.eye(3) - np.outer(body.lever, body.lever))
    return {"first_moment": (body.mass * body.lever).tolist(), "inertia": about[1, 1]}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    write(parser.parse_args().out)
