"""Files of a case: the recordings that the tool is given, the unseen ones for scoring, and the sealed truth."""

import csv
import json
import os
import shutil
from pathlib import Path

import numpy as np

from validation.concealed.build import Built
from validation.concealed.loop import commands, gains
from validation.concealed.sensors import sample
from validation.concealed.strength import Scaled

VERSION = 1
ONLY_SMALL = "only_small_parts"  # verdict on an imperfect arm without a strong effect


def write_case(built: Built, out: Path) -> None:
    """`out/<id>/data`, `out/<id>/unseen` and `out/sealed/<id>.json`; each appears complete or not at all, the truth last."""
    case_id = built.case.id
    temporary, final = out / f".{case_id}.tmp", out / case_id
    for stale in (temporary, final):
        if stale.exists():
            shutil.rmtree(stale)
    everything = range(len(built.kinds))
    seen, unseen = everything[: built.seen], everything[built.seen :]
    rows = write_set(built, temporary / "data", seen) + write_set(built, temporary / "unseen", unseen)
    os.replace(temporary, final)
    sealed = out / "sealed" / f"{case_id}.json"
    sealed.parent.mkdir(parents=True, exist_ok=True)
    draft = sealed.with_suffix(".tmp")
    draft.write_text(json.dumps(truth(built, rows), indent=1, default=plain_number), encoding="utf-8")
    os.replace(draft, sealed)


def plain_number(x):
    return x.tolist() if isinstance(x, np.ndarray | np.generic) else str(x)


def file_name(b: int) -> str:
    return f"rec{b + 1:02d}.csv"


def write_set(built: Built, folder: Path, which: range) -> list[int]:
    """One folder in the contract's format; returns the rows of each recording."""
    folder.mkdir(parents=True)
    rows = [write_csv(built, b, folder / file_name(b)) for b in which]
    (folder / "recordings.json").write_text(json.dumps(header(built, which), indent=1), encoding="utf-8")
    if not built.arm.bundled:
        (folder / "arm.urdf").write_text(built.arm.stated_urdf or built.arm.urdf, encoding="utf-8")
    else:
        (folder / f"{built.arm.name}.urdf").write_text(built.arm.stated_urdf or built.arm.urdf, encoding="utf-8")
    return rows


def header(built: Built, which: range) -> dict:
    arm, case = built.arm, built.case
    recordings = []
    for b in which:
        entry: dict = {"file": file_name(b)}
        if built.setup.payload[b] > 0:
            entry["payload"] = float(built.setup.payload[b])
        if built.setup.springs[b]:
            entry["springs"] = built.setup.springs[b]
        if built.groups[b] is not None:
            entry["group"] = built.groups[b]
        recordings.append(entry)
    out = {
        "format": "rrr_oc-recordings/1",
        "robot": f"{arm.name}.urdf" if arm.bundled else "arm.urdf",
        "joints": list(arm.joints),
        "torque": case.torque,
        "inertial": case.inertial,
        "gravity": built.setup.gravity.tolist(),
        "tool": {"link": arm.tool_link, "position": arm.tool_point.tolist()},
    }
    if built.constants is not None:
        out["actuators"] = {j: {"torque_constant": float(k)} for j, k in zip(arm.joints, built.constants, strict=True)}
    if case.torque == "command":
        out |= {
            key: dict(zip(arm.joints, gain.tolist(), strict=True)) for key, gain in zip(("kp", "kd"), gains(arm), strict=True)
        }
    return out | {"recordings": recordings}


def write_csv(built: Built, b: int, path: Path) -> int:
    """One recording; short sets have a few rows with a NaN besides. Returns the number of rows."""
    rng = built.case.rng(f"noise of recording {b}")
    x = sample(built.signals, b, built.sensing, rng, None if built.ends is None else built.ends[b])
    effort, tau = "tau", x["tau"]
    if built.case.torque == "command":
        speeds = np.array([np.interp(x["t"], built.signals.t, row) for row in built.signals.dq[b]])
        effort, tau = "command", commands(built.arm, x["q"], speeds, tau)
    if built.constants is not None:
        effort, tau = "current", tau / built.constants[:, None]
    joints = built.arm.joints
    columns = ["t", *(f"q_{j}" for j in joints), *(f"{effort}_{j}" for j in joints)]
    table = [x["t"], *x["q"], *tau]
    for derivative in ("dq", "ddq"):
        if derivative in x:
            columns += [f"{derivative}_{j}" for j in joints]
            table += [*x[derivative]]
    values = np.array(table)
    if built.case.short:
        values[1 + rng.integers(2 * len(joints)), rng.integers(10, values.shape[1] - 10, 3)] = np.nan
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows([f"{v:.9g}" for v in row] for row in values.T)
    return values.shape[1]


def truth(built: Built, rows: list[int]) -> dict:
    """What is sealed."""
    case, arm = built.case, built.arm
    effects = [truth_of(built, s, i) for i, s in enumerate(built.scaled)] + motor_truth(built)
    ratio = built.fit.rms() / built.sensing.torque_noise
    return {
        "format": "concealed-truth/1",
        "version": VERSION,
        "case": case.id,
        "key": case.key,
        "kind": case.kind,
        "seed": case.seed,
        "verdict": "missing_physics" if effects else "nothing_missing" if built.small is None else ONLY_SMALL,
        "robot": case.robot,
        "joints": list(arm.joints),
        "short": case.short,
        "torque": case.torque,
        "inertial": case.inertial,
        "locked_joints": case.locked,
        "effects": effects,
        **imperfect_truth(built),
        "baseline": {
            "coulomb_Nm": arm.coulomb,
            "viscous_Nms_per_rad": arm.viscous,
            "armature_kgm2": arm.armature,
            "dry_friction": f"coulomb tanh(dq / {arm.width})",
            "kp_Nm_per_rad": arm.kp,
            "kd_Nms_per_rad": arm.kd,
        },
        "noise": {
            "torque_std_Nm": built.sensing.torque_noise,
            "coloured_share": built.sensing.coloured,
            "position_std_rad": built.sensing.position_noise,
            "encoder_bits": built.sensing.encoder_bits,
            "jitter": built.sensing.jitter,
            "lost": built.sensing.lost,
            "speeds_recorded": built.sensing.speeds,
        },
        "plain_calibration": {
            "residual_over_noise": ratio,
            "torque_std_Nm": built.signals.tau[: built.seen].std(axis=(0, 2)),
            "coulomb_viscous_armature": built.fit.coefficients,
        },
        "noise_floor_nrmse": built.sensing.torque_noise / built.signals.tau[built.seen :].std(axis=(0, 2)),
        "recordings": [
            {"file": file_name(b), "unseen": b >= built.seen, "trajectory": k, "rows": rows[b]}
            for b, k in enumerate(built.kinds)
        ],
    }


def imperfect_truth(built: Built) -> dict:
    """What only an imperfect arm has: `small`, its faults, and `floor`, over which its ratios are."""
    if built.small is None or built.imperfections is None:
        return {}
    noise = built.sensing.torque_noise
    floor = {"imperfections_Nm": built.imperfections, "floor_Nm": np.hypot(noise, built.imperfections)}
    return {"small": list(built.small), "floor": floor}


def truth_of(built: Built, scaled: Scaled, index: int) -> dict:
    effect, arm = scaled.effect, built.arm
    names = [arm.joints[j] for j in effect.joints]
    everywhere = bool(np.all(effect.mask > 0))
    out = {
        "effect": effect.in_truth,
        "in_catalogue": effect.catalogue,
        "joint": None if effect.global_effect else (names[0] if len(names) == 1 else names),
        "recordings": "all" if everywhere else [file_name(int(b)) for b in np.flatnonzero(effect.mask)],
        "equation": effect.equation,
        "parameters": {k: {"value": v, "unit": u} for k, (v, u) in effect.parameters(arm).items()},
        "ratio": {"requested": scaled.requested, "reached": scaled.reached, "per_joint": scaled.per_joint},
    }
    if not effect.catalogue:
        out["depends_on"] = effect.depends_on(arm)
    if built.equal[index] is not None:
        out["equal_effects"] = built.equal[index]
    return out


def motor_truth(built: Built) -> list[dict]:
    """What Eq. 7–9 conceal beyond the plain model: gain k c_1 on the load, k c_12 friction with the load, k c_v2 drag.

    As recorded = (1 + gain) × true has it, where c_12 and c_v2 are of the recorded torque: theirs are divided by k c_1.
    """
    motor = built.arm.motor
    if motor is None:
        return []
    out = []
    for j, joint in enumerate(built.arm.joints):
        gain = motor.constant[j] * motor.c1[j]
        for name, key, value, unit in (
            ("torque_gain", "gain", gain - 1, "1"),
            ("load_dependent_friction", "mu", motor.constant[j] * motor.c12[j] / gain, "1"),
            ("quadratic_drag", "coefficient", motor.constant[j] * motor.cv2[j] / gain, "Nm s²/rad²"),
        ):
            entry = {"effect": name, "in_catalogue": True, "joint": joint, "recordings": "all", "equation": "Eq. 9"}
            out.append(entry | {"parameters": {key: {"value": value, "unit": unit}}})
    return out
