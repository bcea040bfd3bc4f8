"""Does a design on a diagnosed arm keep what it promises, and does it know what the diagnosis left open?

    python validation/hidden_springs.py --arms 10 --out results/hidden_springs

Arms of two joints, or of three with an upright first one, hide a spring across their last two joints. Geometry, masses, spring and task are
random; the true links differ from the URDF as URDFs do. MuJoCo makes the recordings, with friction and noise; they are diagnosed; parallel
springs and motion are designed for the arm as described and, `--repaired`, as diagnosed. E1 of both is then computed in the true plant: by
MuJoCo's inverse dynamics of the true links and payload along the designed motion, less the hidden spring's and the designed springs'
torques, written out here. Counted is how often that lies in the foreseen range, how wide this is and what is named to narrow it, and
whether the repaired design is better. An arm that is done is not done again.
"""

import json
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import mujoco
import numpy as np
import typer
from rich.console import Console

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

# pyright: reportAttributeAccessIssue=false
# (mujoco has no stubs)

from rrr_oc.codesign.design_file import data
from rrr_oc.codesign.search.proposals import SearchOptions
from rrr_oc.codesign.study import Request, prepared
from rrr_oc.commands.output import Output
from rrr_oc.diagnosis.procedure import diagnose
from rrr_oc.kept import Keeping, kept_motion
from rrr_oc.optimal_control.refinement import Refinement
from rrr_oc.recordings.reader import load_recordings
from rrr_oc.report.diagnosis_report import write_diagnosis
from rrr_oc.storage import Made, code, read_npz, write_json, write_text
from validation.engine_plants import reference

STEP, RATE, SECONDS, RECORDINGS = 0.0005, 100, 12.0, 4  # of the engine [s]; of the recordings [1/s], [s], [1]
MASS_ERROR, CENTRE_ERROR = 0.02, 0.004  # standard deviations of the true links from the URDF: share of the mass, [m]
NOISE, BITS = 0.01, 16  # of the torque, over its standard deviation [1]; of the encoders
WIDTH = 0.02  # [rad/s] over which dry friction changes sign
CONFIGURATION = "PEA"
NARROW = 1.5  # upper over lower end of a range from which a recording has to be named
console = Console()


@dataclass(frozen=True)
class Spring:
    """A spring and cable over two joints that pulls while s = −w_a q_a − w_b rho q_b − phi is above 0."""

    joints: tuple[int, int]
    winding: tuple[int, int]
    kappa: float
    rho: float
    phi: float

    def torque(self, q: np.ndarray) -> np.ndarray:
        """On all joints, at positions (n, ...), (n, ...) [Nm]."""
        (a, b), (wa, wb), result = self.joints, self.winding, np.zeros_like(q)
        pull = self.kappa * np.maximum(-wa * q[a] - wb * self.rho * q[b] - self.phi, 0.0)
        result[a], result[b] = wa * pull, wb * self.rho * pull
        return result


@dataclass(frozen=True)
class Arm:
    """A made-up arm, and the task that it is designed for.

    Attributes:
        urdf, truth: Its description, and what it is, as a URDF.
        tip: Where the last link holds a payload, along its x axis [m].
        spring: What is hidden.
        dry, viscous, armature: Of each joint.
        payload: Of the task [kg].
        start, release: Of the last two joints [rad].
        stiffest: Of the springs that may be used [Nm/rad], (2,).
    """

    urdf: str
    truth: str
    tip: float
    spring: Spring
    dry: np.ndarray
    viscous: np.ndarray
    armature: np.ndarray
    payload: float
    start: np.ndarray
    release: np.ndarray
    stiffest: np.ndarray

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.dry)

    def model(self, payload: float = 0.0) -> Any:
        """The true links in the engine, without friction and rotors, with a mass at the tip [kg]."""
        held = (
            f'<link name="held"><inertial><mass value="{payload}"/><inertia ixx="1e-9" iyy="1e-9" izz="1e-9" ixy="0" ixz="0" '
            f'iyz="0"/></inertial></link><joint name="grip" type="fixed"><parent link="link{self.n}"/><child link="held"/>'
            f'<origin xyz="{self.tip} 0 0"/></joint>'
        )
        model = mujoco.MjModel.from_xml_string(self.truth.replace("</robot>", held * (payload > 0) + "</robot>"))
        model.opt.timestep, model.opt.integrator = STEP, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
        model.jnt_limited[:] = 0
        return model


def arm(number: int) -> Arm:
    """The arm of a number."""
    rng = np.random.default_rng([number, 31])
    n = 2 + number % 2
    size, lengths, masses = 0.7 ** np.arange(n), rng.uniform(0.2, 0.4, n), rng.uniform(2, 5, n) * 0.7 ** np.arange(n)
    centres = np.array([[rng.uniform(0.35, 0.6) * length, *rng.uniform(-0.01, 0.01, 2)] for length in lengths])
    wrong = masses * (1 + MASS_ERROR * rng.standard_normal(n)), centres + CENTRE_ERROR * rng.standard_normal((n, 3))
    urdf, truth = (_urdf(lengths, m, c) for m, c in ((masses, centres), wrong))
    reach = float(9.81 * masses[-2:] @ lengths[-2:])  # [Nm], of the gravity that the spring is compared with
    way, rho = rng.choice([-1, 1], 2), float(rng.uniform(0.5, 1.2))
    slack = rng.uniform(-1.0, 0.8)  # stretch at which it begins to pull, of one that goes from about −1.5 to 1.5
    spring = Spring((n - 2, n - 1), (int(way[0]), int(way[1])), float(rng.uniform(0.15, 0.4) * reach), rho, float(slack))
    while True:
        start, release = rng.uniform(-1.1, 1.1, (2, 2))
        if np.abs(release - start).max() > 0.7:
            break
    payload = float(rng.uniform(0.3, 0.8) * masses[-1])
    levers = np.array([lengths[-2:].sum(), lengths[-1]])
    stiffest = 9.81 * (payload + masses[-2:].sum()) * levers
    dry, viscous, armature = (rng.uniform(*ends, n) * size for ends in ((0.3, 1.5), (0.3, 1.5), (0.02, 0.15)))
    ends = payload, start, release, stiffest
    return Arm(urdf, truth, float(lengths[-1]), spring, dry, viscous, armature, *ends)


def _urdf(lengths: np.ndarray, masses: np.ndarray, centres: np.ndarray) -> str:
    text, n = '<robot name="arm"><link name="link0"/>', len(lengths)
    for i, (length, mass, (x, y, z)) in enumerate(zip(lengths, masses, centres, strict=True)):
        upright, inertia = n > 2 and i == 0, mass * length**2 / 12 + 0.002
        text += (
            f'<link name="link{i + 1}"><inertial><origin xyz="{x} {y} {z}"/><mass value="{mass}"/><inertia ixx="{inertia / 3}" '
        )
        text += f'iyy="{inertia}" izz="{inertia}" ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="joint{i + 1}" type="revolute">'
        text += f'<parent link="link{i}"/><child link="link{i + 1}"/><origin xyz="{lengths[i - 1] if i else 0} 0 0"/>'
        text += (
            f'<axis xyz="{"0 0 1" if upright else "0 -1 0"}"/><limit lower="-3" upper="3" effort="500" velocity="10"/></joint>'
        )
    return text + "</robot>"


def write_recordings(one: Arm, folder: Path, rng: np.random.Generator) -> None:
    """Recordings of the arm that follows sines under a stiff controller, without a payload."""
    names, files = [f"joint{i + 1}" for i in range(one.n)], [f"{i}.csv" for i in range(RECORDINGS)]
    for file in files:
        rows = _recorded(one, rng)
        q, tau = rows[:, 1 : one.n + 1], rows[:, one.n + 1 :]
        q = np.round(q * 2**BITS / 2 / np.pi) / 2**BITS * 2 * np.pi
        tau = tau + NOISE * tau.std(0) * rng.standard_normal(tau.shape)
        lines = [",".join(["t", *(f"q_{j}" for j in names), *(f"tau_{j}" for j in names)])]
        lines += [",".join(f"{x:.9g}" for x in row) for row in np.hstack([rows[:, :1], q, tau])]
        write_text(folder / file, "\n".join(lines) + "\n")
    write_text(folder / "arm.urdf", one.urdf)
    header = {"format": "rrr_oc-recordings/1", "robot": "arm.urdf", "joints": names, "torque": "motor"}
    tool = {"link": f"link{one.n}", "position": [one.tip, 0, 0]}
    write_json(folder / "recordings.json", header | {"tool": tool, "recordings": [{"file": file} for file in files]})


def _recorded(one: Arm, rng: np.random.Generator) -> np.ndarray:
    """Rows of t, q and motor torque."""
    model, follow, rows = one.model(), reference("sines", one.n, SECONDS, rng), []
    model.dof_damping[:], model.dof_armature[:] = one.viscous, one.armature
    at, inertia = mujoco.MjData(model), np.zeros((one.n, one.n))
    at.qpos[:], at.qvel[:] = follow(0.0)
    mujoco.mj_forward(model, at)
    mujoco.mj_fullM(model, at, inertia)
    stiffness, damping = 324 * np.diag(inertia), 25 * np.diag(inertia)
    for k in range(round(SECONDS / STEP)):
        q, v = follow(k * STEP)
        mujoco.mj_forward(model, at)
        motor = stiffness * (q - at.qpos) + damping * (v - at.qvel) + 0.9 * at.qfrc_bias
        at.qfrc_applied[:] = motor + one.spring.torque(at.qpos.copy()) - one.dry * np.tanh(at.qvel / WIDTH)
        if k % round(1 / STEP / RATE) == 0:
            rows.append(np.concatenate([[k * STEP], at.qpos, motor]))
        mujoco.mj_step(model, at)
    return np.array(rows)


def write_task(one: Arm, path: Path) -> None:
    """The task as a file beside the arm's URDF."""
    moving = [f"joint{j + 1}" for j in one.spring.joints]
    limits = {"range_deg": [-80.0, 80.0], "speed_deg_per_s": 90.0, "acceleration_deg_per_s2": 180.0, "torque_Nm": "none"}
    springs = [
        {
            "effect": "parallel_spring",
            "joint": joint,
            "stiffness_Nm_per_rad": [0.0, float(k)],
            "equilibrium_deg": [-150.0, 150.0],
        }
        for joint, k in zip(moving, one.stiffest, strict=True)
    ]
    task = {
        "format": "rrr_oc-task/1",
        "robot": "arm.urdf",
        "moving": moving,
        "payload_kg": one.payload,
        "duration_s": [1.0, 4.0],
    }
    task |= {"tool": {"link": f"link{one.n}", "position_m": [one.tip, 0.0, 0.0]}, "limits": dict.fromkeys(moving, limits)}
    task |= {end: {"angles_deg": np.degrees(getattr(one, end)).tolist()} for end in ("start", "release")}
    write_json(path, task | {"springs": springs})


def true_E1(one: Arm, motion: Mapping[str, np.ndarray], design: Mapping[str, Any]) -> float:
    """E1 [N²m²s] of a designed motion with the designed springs in the true plant."""
    rows, total = list(one.spring.joints), 0.0
    for phase, payload in enumerate((one.payload, 0.0)):
        k = np.flatnonzero(motion["phase"] == phase)
        q, dq, ddq = (np.zeros((one.n, len(k))) for _ in range(3))
        q[rows], dq[rows], ddq[rows] = (motion[name][:, k] for name in ("q", "dq", "ddq"))
        model = one.model(payload)
        at, load = mujoco.MjData(model), np.zeros_like(q)
        for i in range(len(k)):
            at.qpos[:], at.qvel[:], at.qacc[:] = q[:, i], dq[:, i], ddq[:, i]
            mujoco.mj_inverse(model, at)
            load[:, i] = at.qfrc_inverse
        load -= one.spring.torque(q)
        for label, way in design["mounted"].items():
            joint, theta = int(label.rstrip("]")[-1]) - 1, design["parameters"][label]
            side = 1 if way["active"] == "below" else -1
            load[joint] -= side * theta["stiffness"] * np.maximum(side * (theta["equilibrium"] - q[joint]), 0.0)
        total += float(np.trapezoid(np.sum(load[rows] ** 2, axis=0), motion["t"][k]))
    return total


def design(one: Arm, folder: Path, name: str, repaired: bool) -> dict[str, Any]:
    """A design for the arm as described or as diagnosed: E1 planned, foreseen and true."""
    search = SearchOptions(starts=2, motions=2, coarse=8, fine=16, refinement=Refinement(1e-4))
    model = folder / "diagnosis" / "model.json"
    request = Request(str(folder / "task.json"), folder / name, (CONFIGURATION,), search, model=model, repaired=repaired)
    study = prepared(request, None, Output(quiet=True))
    found = data(dict(study.results())[CONFIGURATION])
    (moved,) = found["tasks"].values()
    true = true_E1(one, read_npz(kept_motion(study, CONFIGURATION)), found)
    return {"planned": moved["E1"], "true": true, "foreseen": moved["foreseen"]}


def diagnosed(number: int, one: Arm, folder: Path) -> dict[str, Any]:
    """What a diagnosis claims; it goes on from the stages that are done."""
    file = folder / "claims.json"

    def make() -> None:
        write_recordings(one, folder, np.random.default_rng([number, 7]))
        write_task(one, folder / "task.json")
        quiet = Output(quiet=True)
        found = diagnose(load_recordings(folder), kept=Keeping(folder / "diagnosis", {"arm": number, "code": code()}, quiet))
        write_diagnosis(found, folder / "diagnosis")
        claims = [f"{f.key[0]} of {' and '.join(f'joint{j + 1}' for j in f.key[1])}" for f in found.findings]
        write_json(file, {"claims": claims, "verdict": found.verdict})

    Made([file, folder / "diagnosis" / "model.json"], number, [Path(__file__)]).once(make)
    return json.loads(file.read_text())


def proved(number: int, out: Path) -> dict[str, Any]:
    """An arm recorded, diagnosed and designed for; what was promised and what is true."""
    folder, file = out / f"{number:03d}", out / f"{number:03d}.json"

    def prove() -> None:
        one = arm(number)
        found = diagnosed(number, one, folder)
        designs = {name: design(one, folder, name, name == "repaired") for name in ("described", "repaired")}
        write_json(file, {"arm": number, "joints": one.n, **found, **designs})

    Made([file], number, [Path(__file__)]).once(prove)
    return json.loads(file.read_text())


def counted(results: list[dict[str, Any]]) -> dict[str, int]:
    """How often what is wanted is so."""
    repaired = [r["repaired"] for r in results]
    inside = [d["foreseen"]["E1"][0] <= d["true"] <= d["foreseen"]["E1"][1] for d in repaired]
    narrow = [d["foreseen"]["E1"][1] <= NARROW * d["foreseen"]["E1"][0] for d in repaired]
    named = [bool(d["foreseen"]["narrowed_by"]) for d in repaired]
    better = [r["repaired"]["true"] <= r["described"]["true"] for r in results]
    return {
        "arms": len(results),
        "true E1 of the repaired design in the foreseen range": sum(inside),
        "range at most 1.5-fold": sum(narrow),
        "range at most 1.5-fold, or a recording named": sum(a or b for a, b in zip(narrow, named, strict=True)),
        "repaired design not worse than the one for the described arm": sum(better),
    }


def table(results: list[dict[str, Any]]) -> str:
    """A row for each arm, in Markdown."""
    head = ("arm", "joints", "claimed", "described: planned", "true", "repaired: planned", "foreseen", "true", "narrowed by")
    lines = [" | ".join(head), " | ".join("---" for _ in head)]
    for r in results:
        one, other = r["described"], r["repaired"]
        low, high = other["foreseen"]["E1"]
        cells = [str(r["arm"]), str(r["joints"]), ", ".join(r["claims"]), f"{one['planned']:.2f}", f"{one['true']:.2f}"]
        cells += [f"{other['planned']:.3f}", f"{low:.3f} … {high:.3f}", f"{other['true']:.3f}"]
        lines.append(" | ".join([*cells, other["foreseen"]["narrowed_by"] or "–"]))
    return "\n".join(f"| {line} |" for line in lines)


def main(
    arms: Annotated[int, typer.Option(min=1)] = 10,
    out: Annotated[Path, typer.Option(help="folder of the results")] = Path("results/hidden_springs"),
) -> None:
    """Make arms, diagnose them, design for them, and compare promises with the true plant."""
    results = []
    for number in range(arms):
        results.append(proved(number, out))
        last = results[-1]
        console.print(f"arm {number}: true {last['repaired']['true']:.3f}, foreseen {last['repaired']['foreseen']['E1']}")
    write_json(out / "summary.json", {"counts": counted(results), "arms": results})
    console.print(table(results), markup=False, soft_wrap=True)
    for what, count in counted(results).items():
        console.print(f"{what}: {count}")


if __name__ == "__main__":
    typer.run(main)
