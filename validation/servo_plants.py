"""What does a calibration say of arms that follow commanded angles, where no torque is recorded?

    python validation/servo_plants.py --count 20 --out results/servo_plants

Each plant is a random arm of one to three joints in MuJoCo, whose dry friction is the engine's constraint, moved by its own position loop:
an inner cycle of 1 or 2 ms reads an encoder and holds the torque; the commands are sent 50 to 200 times a second, held between, and act 0
to 20 ms late. Rows are written at the rate of the commands. With the right gains, intervals of dry friction, viscous friction and rotors, and
of the time by which commands act late, are compared with the truth. With --nominal the plain model without a delay is calibrated beside it.
"""

# pyright: reportAttributeAccessIssue=false
# (mujoco's wheel has no stubs)

import json
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import mujoco
import numpy as np
import typer

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from rrr_oc.calibration.calibrate import calibrate, fit
from rrr_oc.calibration.calibrated_model import CalibratedModel
from rrr_oc.calibration.inverse_dynamics import plain_model
from rrr_oc.effects import LateCommand
from rrr_oc.errors import entry_point
from rrr_oc.recordings.reader import load_recordings
from rrr_oc.report.tables import markdown
from rrr_oc.storage import write_csv, write_json, write_text
from validation.chains.arms import Arm, ArmKind, described, random_arm
from validation.chains.chain import FINE, rounded
from validation.chains.motions import Pace, sines

KINDS = {1: "y", 2: "yy", 3: "zyy"}
TRUTH = {"dry_friction": "dry", "viscous_friction": "viscous", "armature": "rotor"}
BANDWIDTH = (12.0, 25.0)  # [rad/s] of the position loops


@dataclass(frozen=True)
class Servo:
    """A position loop at each joint.

    Attributes:
        kp, kd: Gains, (n,) [Nm/rad], [Nm s/rad].
        rate: Of commands and rows [Hz].
        cycle: Of the inner loop, over which a torque is held [s].
        late: By how much a command acts after it is recorded, beside being held [s].
        bits: Of the encoders over a turn.
    """

    kp: np.ndarray
    kd: np.ndarray
    rate: float
    cycle: float
    late: float
    bits: int

    @property
    def wait(self) -> float:
        """By how much commands act late for slow motion [s]: half the time for which they are held, in the engine's steps, and their delay.

        They change where an inner cycle begins, which therefore adds nothing.
        """
        return 0.5 / self.rate - 0.5 / FINE + self.late


def plant(seed: int) -> tuple[Arm, Arm, Servo]:
    """An arm, as its file has it, and its loops."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 4))
    kind = ArmKind(
        KINDS[n],
        (0.16, 0.12),
        (0.5, 0.25),
        dry=(0.08, 0.2),
        viscous=(0.05, 0.15),
        rotor=(0.5, 2),
        hangs=bool(rng.integers(2)),
        width=0.0,
    )
    arm = random_arm(kind, rng)
    spec = mujoco.MjSpec.from_string(arm.urdf)
    model = spec.compile()
    data, mass = mujoco.MjData(model), np.zeros((n, n))
    model.dof_armature[:] = arm.rotor
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, mass)
    bandwidth = rng.uniform(*BANDWIDTH)
    kp = np.round(bandwidth**2 * np.diag(mass), 3)
    servo = Servo(
        kp, np.round(rng.uniform(0.3, 0.8) * kp / bandwidth, 4), float(rng.choice([50, 100, 200])), float(rng.choice([1e-3, 2e-3])),
        float(rng.choice([0.0, 0.01, 0.02])), int(rng.choice([12, 14])),
    )  # fmt: skip
    return arm, described(arm, rng), servo


def followed(arm: Arm, servo: Servo, goal: np.ndarray) -> np.ndarray:
    """What the encoders read (n, F) at the fine rate while the loops follow commands (n, F) that change at the rate of commands."""
    model = mujoco.MjSpec.from_string(arm.urdf).compile()
    model.opt.timestep = 1 / FINE
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT) | int(mujoco.mjtDisableBit.mjDSBL_LIMIT)
    model.dof_armature[:], model.dof_frictionloss[:], model.dof_damping[:] = arm.rotor, arm.dry, arm.viscous
    data = mujoco.MjData(model)
    data.qpos[:] = goal[:, 0]
    every, step, late = round(FINE * servo.cycle), 2 * np.pi / 2**servo.bits, round(FINE * servo.late)
    seen, torque = np.zeros(goal.shape), np.zeros(arm.n)
    for k in range(goal.shape[1]):
        seen[:, k] = rounded(data.qpos, step)
        if k % every == 0:
            torque = servo.kp * (goal[:, max(k - late, 0)] - seen[:, k]) - servo.kd * data.qvel
        data.qfrc_applied[:] = torque
        mujoco.mj_step(model, data)
    return seen


def write(folder: Path, seed: int, recordings: int = 3) -> tuple[Arm, Servo]:
    """The recordings of a plant."""
    arm, listed, servo = plant(seed)
    rng, files = np.random.default_rng([seed, 1]), [f"r{k}.csv" for k in range(recordings)]
    every = round(FINE / servo.rate)
    for file in files:
        t, q, _, _ = sines(arm.n, Pace(15, 2.5, 1.1, 0.15), rng)
        goal = np.repeat(q[:, ::every], every, axis=1)[:, : t.size]
        seen = followed(arm, servo, goal)
        columns = {f"q_{j}": x for j, x in zip(arm.joints, seen[:, ::every], strict=True)}
        columns |= {f"command_{j}": x for j, x in zip(arm.joints, goal[:, ::every], strict=True)}
        write_csv(folder / file, {"t": t[::every]} | columns)
    gains = {name: dict(zip(arm.joints, x.tolist(), strict=True)) for name, x in (("kp", servo.kp), ("kd", servo.kd))}
    header = {"format": "rrr_oc-recordings/1", "robot": "arm.urdf", "joints": list(arm.joints), "torque": "command", **gains}
    write_text(folder / "arm.urdf", listed.urdf)
    write_text(folder / "recordings.json", json.dumps(header | {"recordings": [{"file": file} for file in files]}))
    return arm, servo


def judged(model: CalibratedModel, arm: Arm, servo: Servo, way: str) -> Iterator[dict[str, Any]]:
    """Each parameter of a calibrated model beside the truth."""
    for term in model.terms:
        name = TRUTH.get(term.effect.name, "delay" if isinstance(term.effect, LateCommand) else None)
        if name is not None:
            (j,), (found,) = term.effect.joints, term.estimates
            true = servo.wait if name == "delay" else float(getattr(arm, name)[j])
            holds = None if found.interval is None else bool(found.interval[0] <= true <= found.interval[1])
            yield {
                "way": way,
                "parameter": name,
                "joint": arm.joints[j],
                "true": true,
                "value": found.value,
                "interval": found.interval,
                "holds": holds,
            }


def rows(found: list[dict[str, Any]]) -> list[list[str]]:
    """By way and parameter: how many intervals there are and how many hold, the median error and the median half width, relative."""
    result = []
    for way, name in dict.fromkeys((one["way"], one["parameter"]) for one in found):
        some = [one for one in found if (one["way"], one["parameter"]) == (way, name)]
        known = [one for one in some if one["interval"] is not None]
        errors = [abs(one["value"] / one["true"] - 1) for one in some]
        widths = [(one["interval"][1] - one["interval"][0]) / 2 / one["true"] for one in known]
        holds = sum(one["holds"] for one in known)
        share = f"{100 * holds / max(len(known), 1):.0f} %"
        result.append(
            [
                way,
                name,
                str(len(some)),
                f"{holds} of {len(known)}",
                share,
                f"{100 * np.median(errors):.1f} %",
                f"{100 * np.median(widths or [np.nan]):.1f} %",
            ]
        )
    return result


def main(
    count: Annotated[int, typer.Option(help="plants")] = 20,
    first: Annotated[int, typer.Option(help="seed of the first")] = 0,
    nominal: Annotated[bool, typer.Option(help="calibrate without a delay of commands, too")] = False,
    out: Annotated[Path, typer.Option(help="folder for the recordings and results; what is in it is replaced")] = Path(
        "results/servo_plants"
    ),
) -> None:
    """Calibrate the plants, and count the intervals that hold the truth."""
    found: list[dict[str, Any]] = []
    for seed in range(first, first + count):
        arm, servo = write(out / f"plant{seed}", seed)
        recordings = load_recordings(out / f"plant{seed}")
        models = {"with the delay": calibrate(recordings)}
        if nominal:
            plain = plain_model(recordings)
            models["without"] = fit(
                recordings, replace(plain, terms=tuple(t for t in plain.terms if not isinstance(t.effect, LateCommand)))
            )
        for way, model in models.items():
            found += [{"plant": seed, "rate": servo.rate, **one} for one in judged(model, arm, servo, way)]
        write_json(out / "servo_plants.json", {"parameters": found})
        typer.echo(
            f"plant {seed}: {arm.n} joints, {servo.rate:g} Hz, wait {1e3 * servo.wait:.1f} ms; missed "
            + ", ".join(
                f"{one['way']} {one['parameter']} {one['joint']} {one['value']:.4g} ({one['true']:.4g})"
                for one in found
                if one["plant"] == seed and one["holds"] is False
            )
        )
    head = ["way", "parameter", "joints", "intervals that hold", "share", "median error", "median half width"]
    write_text(out / "servo_plants.md", markdown(head, rows(found)))
    typer.echo(markdown(head, rows(found)))


run = entry_point(lambda: typer.run(main))

if __name__ == "__main__":
    run()
