"""Does an arm that nobody tried before go through all commands, from its robot file to exported models?

    pip download --no-deps --dest wheels example-robot-data && unzip -q -d arms wheels/*.whl
    python validation/every_arm.py arms --out results/every_arm

Robot files (URDF, MJCF) are searched below the folder, in the order of their paths. Of each, the arm is the chain that `rrr-oc init` takes: all
joints of a serial chain, else the longest chain from the base, of several of the same length the one that the file has first; fingers at its
end whose links the file gives no mass are left out. Chains with fewer than two joints are no arm, and one whose joints sit and weigh as those
of an earlier file is not tried again. At most `--most` are tried.

Each arm goes through these steps in a process of its own, with a limit of processor time for all of them:

    init          a task and a recording set are begun
    design        one configuration, PEA, two starts on a coarse mesh
    recordings    three of 12 s, made up: the arm with friction and armatures in MuJoCo on sums of sines, with noise
    check         nothing is wrong with them
    calibrate     the torques are explained, with an NRMSE below `EXPLAINED` in every joint
    export        MuJoCo reads the model, and runs it

A result is in out/<arm>.json as soon as it is known; the same command goes on with the others, and `--again` makes failures anew. table.md
has all.
"""

import contextlib
import io
import json
import multiprocessing
import resource
import shutil
import sys
import time
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import msgspec
import mujoco
import numpy as np
import typer

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from rrr_oc import cli
from rrr_oc.calibration.model_file import load_model
from rrr_oc.effects import plain_effects
from rrr_oc.errors import UserError, entry_point
from rrr_oc.model.motion import Motion
from rrr_oc.model.recorded_physics import Physics
from rrr_oc.model.symbolic_model import Model
from rrr_oc.recordings.header import HEADER, Header
from rrr_oc.report.tables import markdown
from rrr_oc.robot.robot import Robot, arm_of, load_robot, urdf_text
from rrr_oc.robot.urdf import TURNS
from rrr_oc.schema import read_json
from rrr_oc.simulation.replay import replay, tracking_controller
from rrr_oc.storage import write_csv, write_json, write_text

# pyright: reportAttributeAccessIssue=false
# (mujoco's wheel has no stubs)

STEPS = ("init", "design", "recordings", "check", "calibrate", "export")
DESIGN = [
    "--configurations",
    "PEA",
    "--starts",
    "2",
    "--motions",
    "0",
    "--tolerance",
    "1e-2",
    "--intervals",
    "8",
    "--jobs",
    "1",
]
EXPLAINED = 0.2  # NRMSE of a joint's torque up to which it counts as explained; the noise is `NOISE`
NOISE = 0.02  # [1] of each torque's standard deviation
ROUNDED = 1e-4  # [rad], deviation of recorded positions
SECONDS, RATE = 12.0, 100.0  # of a recording [s], [Hz]
SHARE = 0.35  # of a joint's range by which it moves to each side of the middle of its range
FASTEST = 2.0  # [rad/s], of a joint whose file allows more
WIDEST = 1.0  # [rad], to each side
DRY, VISCOUS, ARMATURE = 0.15, 0.1, 0.1  # friction and armature over what gravity and inertia need at most: usual for gears


@dataclass(frozen=True)
class Arm:
    """A chain of a robot file; `joints` is None where it is the whole robot."""

    name: str
    file: Path
    joints: tuple[str, ...] | None


class Failed(Exception):
    """What a step did not do."""


def arms(folder: Path, most: int) -> list[Arm]:
    """The arms of the robot files below a folder."""
    found, seen = [], set()
    for file in sorted(path for kind in ("urdf", "xml") for path in folder.rglob(f"*.{kind}")):
        joints = chain_of(file)
        if joints is None or len(joints) < 2:
            continue
        robot = load_robot(file, joints, inertial=False)
        key = (robot.placements.round(4).tobytes(), robot.inertial.round(4).tobytes())
        if key in seen:
            continue
        seen.add(key)
        name = file.stem if file.stem not in {arm.name for arm in found} else f"{file.parent.parent.name}_{file.stem}"
        found.append(Arm(name, file, None if whole(file) and load_robot(file, inertial=False).joints == joints else joints))
    return found[:most]


def whole(file: Path) -> bool:
    """Whether a robot file is a serial chain of revolute joints."""
    try:
        load_robot(file, inertial=False)
    except UserError:
        return False
    return True


def chain_of(file: Path) -> tuple[str, ...] | None:
    """The joints of a file's arm up to the last one that moves a mass; None where it is no robot file, or its joints cannot be read."""
    try:
        joints = load_robot(file, inertial=False).joints if whole(file) else arm_of(file) or first_longest(file)
        load_robot(file, joints, inertial=False)
    except UserError:
        return None
    while joints:
        try:
            return load_robot(file, joints).joints
        except UserError:
            joints = joints[:-1]
    return None


def first_longest(file: Path) -> tuple[str, ...]:
    """The first of the longest chains of joints that turn, from the base on."""
    below: dict[str, list[ElementTree.Element]] = {}
    for joint in ElementTree.fromstring(urdf_text(file)).findall("joint"):
        below.setdefault(_end(joint, "parent"), []).append(joint)

    def longest(link: str) -> tuple[str, ...]:
        ways = []
        for joint in below.get(link, []):
            turns = joint.get("type") in TURNS and joint.find("mimic") is None
            ways.append(((str(joint.get("name")),) if turns else ()) + longest(_end(joint, "child")))
        return max(ways, key=len, default=())

    roots = sorted(set(below) - {_end(joint, "child") for ways in below.values() for joint in ways})
    return longest(roots[0]) if roots else ()


def _end(joint: ElementTree.Element, which: str) -> str:
    element = joint.find(which)
    return "" if element is None else element.get("link", "")


def command(*arguments: str) -> str:
    """What a command of rrr-oc prints as JSON; raises `Failed` with its sentence where it ends otherwise than well."""
    out, err = io.StringIO(), io.StringIO()
    sys.argv = ["rrr-oc", *arguments]
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            cli.main()
            code = 0
        except SystemExit as stop:
            code = stop.code
    if code:
        raise Failed(err.getvalue().strip().splitlines()[-1] if err.getvalue().strip() else f"exit status {code}")
    return out.getvalue()


def made_up(robot: Robot, seed: int) -> Iterator[dict[str, np.ndarray]]:
    """The columns of three recordings of an arm with friction and armatures in MuJoCo, with noise."""
    rng = np.random.default_rng(seed)
    rigid = Physics(Model(robot, robot.tool), np.zeros(0), np.zeros(0), robot.inertial)
    motions = [sines(robot, rng) for _ in range(3)]
    most = np.max([np.abs(rigid.torques(motion)[0]).max(axis=1) for motion in motions], axis=0)
    inertia = rigid.model.body.free_inertia(robot.inertial)
    effects = tuple(kind((j,)) for j in range(robot.n) for kind in plain_effects() if kind.side != "sensor")
    sizes = {"dry_friction": DRY * most, "viscous_friction": VISCOUS * most, "armature": ARMATURE * inertia}
    theta = np.array([sizes[effect.name][effect.joints[0]] for effect in effects])
    widths = np.array([effect.width.nominal for effect in effects if effect.width is not None])
    arm = Physics(Model(robot, robot.tool, effects), theta, widths, robot.inertial)
    for motion in motions:
        simulated = replay(arm, motion, tracking_controller(robot, recorded=np.full(robot.n, np.inf)))
        if np.isnan(simulated.q).any():
            raise Failed("the simulation diverged")
        tau = simulated.tau_motor + NOISE * simulated.tau_motor.std(axis=1, keepdims=True) * rng.normal(size=motion.q.shape)
        q = simulated.q + ROUNDED * rng.normal(size=motion.q.shape)
        rows = zip(robot.joints, q, tau, strict=True)
        columns = {"t": motion.t}
        for joint, own, torque in rows:
            columns |= {f"q_{joint}": own, f"tau_{joint}": torque}
        yield columns


def sines(robot: Robot, rng: np.random.Generator) -> Motion:
    """A sum of three sines in every joint, within its range and speed."""
    t = np.arange(0, SECONDS, 1 / RATE)
    known = np.isfinite(robot.lower) & np.isfinite(robot.upper) & (robot.upper > robot.lower)
    low, high = np.where(known, robot.lower, -np.pi), np.where(known, robot.upper, np.pi)
    speed = np.minimum(np.where(robot.velocity > 0, 0.8 * robot.velocity, FASTEST), FASTEST)
    widest = np.minimum(SHARE * (high - low), WIDEST)
    waves, omega = rng.uniform(0.4, 1.0, (robot.n, 3)), 2 * np.pi * rng.uniform(0.1, 0.5, (robot.n, 3))
    phase = rng.uniform(0, 2 * np.pi, (robot.n, 3))
    waves *= (widest / waves.sum(axis=1))[:, None]
    slower = np.minimum(1.0, speed / (waves * omega).sum(axis=1))[:, None]
    angle = slower[..., None] * omega[..., None] * t + phase[..., None]
    rate = slower * omega
    q = ((low + high) / 2)[:, None] + np.einsum("ij,ijk->ik", waves, np.sin(angle))
    dq = np.einsum("ij,ijk->ik", waves * rate, np.cos(angle))
    ddq = -np.einsum("ij,ijk->ik", waves * rate**2, np.sin(angle))
    return Motion(t, q, dq, ddq, np.zeros(len(t)))


def record(folder: Path, seed: int) -> None:
    """Fill the recording set that `rrr-oc init` began."""
    header = msgspec.to_builtins(read_json(folder / HEADER, Header))
    robot = load_robot(folder / header["robot"], header["joints"])
    files = []
    for i, columns in enumerate(made_up(robot, seed)):
        files.append({"file": ("first.csv", "second.csv", "third.csv")[i]})
        write_csv(folder / files[-1]["file"], columns)
    kept = {key: header[key] for key in ("format", "robot", "joints", "torque", "inertial", "gravity")}
    write_json(folder / HEADER, kept | {"recordings": files})


def checked(folder: Path) -> None:
    """Raise `Failed` where `rrr-oc check` doubts a column of an arm that has none to be doubted."""
    doubts = json.loads(command("check", str(folder), "--json"))["doubts"]
    if doubts:
        raise Failed(f"doubts: {doubts[0]['said']}")


def calibrated(folder: Path, out: Path) -> None:
    """Raise `Failed` where a joint's torque is not explained."""
    command("calibrate", str(folder), "--out", str(out), "--json")
    model = load_model(out / "model.json")
    worst = int(np.argmax(np.nan_to_num(model.nrmse, nan=np.inf)))
    if not model.nrmse[worst] <= EXPLAINED:
        raise Failed(f"NRMSE of {model.joints[worst]} is {model.nrmse[worst]:.3g}")


def exported(model: Path, out: Path) -> None:
    """Raise `Failed` where plain MuJoCo cannot run what was exported."""
    command("export", str(model), "--out", str(out), "--json")
    arm = mujoco.MjModel.from_xml_path(str(out / "arm.xml"))
    data = mujoco.MjData(arm)
    for _ in range(100):
        mujoco.mj_step(arm, data)
    if not np.all(np.isfinite(data.qpos)):
        raise Failed("the exported arm diverges")


def designed(folder: Path) -> None:
    """Raise `Failed` where no design is found, or there is no task."""
    if not (folder / "task.json").is_file():
        raise Failed((folder / "README.md").read_text().partition("There is no task.json: ")[2].partition("\n")[0])
    command("design", str(folder / "task.json"), *DESIGN, "--out", str(folder / "design"), "--json")


def tried(arm: Arm, work: Path, result: Path, seconds: int) -> None:
    """One arm through all steps; the result is written before each step as if that did not end, since the limit of time ends the process."""
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
    folder = work / arm.name
    shutil.rmtree(folder, ignore_errors=True)
    chosen = [] if arm.joints is None else ["--joints", ",".join(arm.joints)]
    steps: dict[str, Callable[[], Any]] = {
        "init": lambda: command("init", str(arm.file), "--out", str(folder), *chosen, "--json"),
        "design": lambda: designed(folder),
        "recordings": lambda: record(folder / "recordings", seed=len(arm.name)),
        "check": lambda: checked(folder / "recordings"),
        "calibrate": lambda: calibrated(folder / "recordings", folder / "calibrated"),
        "export": lambda: exported(folder / "calibrated" / "model.json", folder / "exported"),
    }
    found: dict[str, Any] = {"arm": arm.name, "file": arm.file.name, "joints": arm.joints, "seconds": {}, "failed": {}}
    for name, step in steps.items():
        write_json(result, found | {"failed": found["failed"] | {name: "not within the limit of time"}, "whole": False})
        began = time.process_time()
        try:
            step()
        except (Failed, UserError) as error:
            found["failed"][name] = str(error)
        except Exception as error:
            found["failed"][name] = f"{type(error).__name__}: {error}"
        found["seconds"][name] = round(time.process_time() - began, 2)
        if name in found["failed"] and name not in ("design", "check"):  # without these, the others can go on
            break
    if folder.exists():
        found["n"] = len(read_json(folder / "recordings" / HEADER, Header).joints)
    write_json(result, found | {"whole": True})


def table(results: Sequence[dict[str, Any]]) -> str:
    """All arms, their times, and what failed."""
    rows = []
    for found in results:
        seconds = [f"{found['seconds'][step]:.1f}" if step in found["seconds"] else "–" for step in STEPS]
        said = "; ".join(f"{step}: {why}" for step, why in found["failed"].items()) or "–"
        rows.append([found["arm"], str(found.get("n", "–")), *seconds, said])
    passed = sum(not found["failed"] for found in results)
    total = sum(sum(found["seconds"].values()) for found in results)
    said = f"{passed} of {len(results)} arms pass all steps; {total / max(len(results), 1):.1f} s of processor time an arm.\n"
    return f"{markdown(['arm', 'joints', *[f'{step} [s]' for step in STEPS], 'failed'], rows)}\n{said}"


def main(
    folder: Annotated[Path, typer.Argument(help="folder below which robot files are searched")],
    out: Annotated[Path, typer.Option(help="folder of the results")],
    most: Annotated[int, typer.Option(help="arms at most")] = 60,
    seconds: Annotated[int, typer.Option(help="limit of processor time of an arm \\[s]")] = 240,
    only: Annotated[str | None, typer.Option(help="comma-separated names of arms")] = None,
    again: Annotated[bool, typer.Option("--again", help="try those anew that failed")] = False,
) -> None:
    """Try every arm of a folder, and write a table."""
    results = []
    for arm in arms(folder, most):
        if only is not None and arm.name not in only.split(","):
            continue
        result = out / f"{arm.name}.json"
        known = json.loads(result.read_text()) if result.is_file() else None
        if known is None or (again and known["failed"]):
            out.mkdir(parents=True, exist_ok=True)
            process = multiprocessing.get_context("spawn").Process(target=tried, args=(arm, out / "work", result, seconds))
            process.start()
            process.join()
            if not result.is_file():
                raise Failed(f"{arm.name}: its process ended before it began, with exit status {process.exitcode}")
            known = json.loads(result.read_text())
            print(f"{arm.name}: {known['failed'] or 'passed'} {known['seconds']}", flush=True)
        results.append(known)
    write_text(out / "table.md", table(results))
    print(table(results))


entry = entry_point(lambda: typer.run(main))

if __name__ == "__main__":
    entry()
