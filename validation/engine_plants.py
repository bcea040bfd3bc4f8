"""Does the diagnosis hold on recordings that MuJoCo makes, of arms and of friction that it was never shown?

    python validation/engine_plants.py --sets 40 --out results/engine_plants

Serial arms of 1 to 7 joints with random links, axes, friction and armature follow multisines or go from point to point, with and
without stops, under a stiff controller. Dry friction is MuJoCo's constraint, which holds a joint, or a torque that changes sign in
one of five ways over a random width. Sampling, resolution and noise are random, too; speeds, current and inertial parameters are
given or not. Three sets of five have nothing missing, the others have one effect: an unlisted payload and a harness in every other
recording, more friction in one, as of a gear that was cold, the rest in all. A link behind a gear that gives is a second joint of
the engine. A set that is done is not done again. The plant shares no physics with the package.
"""

import json
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import mujoco
import numpy as np
import typer
from rich.console import Console
from rich.progress import track
from rich.table import Table
from scipy.special import erf
from scipy.stats import binomtest

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

# pyright: reportAttributeAccessIssue=false
# (mujoco has no stubs)

from rrr_oc.commands.shared import Jobs
from rrr_oc.diagnosis.diagnosis_file import to_json
from rrr_oc.diagnosis.procedure import diagnose
from rrr_oc.parallel import unordered, workers
from rrr_oc.recordings.reader import load_recordings
from rrr_oc.storage import Made, write_json, write_text

STEP = 0.0005  # [s], of the engine
EFFECTS = (
    "stribeck",
    "torque_gain",
    "parallel_spring",
    "payload_mass",
    "torque_ripple",
    "coulomb_asymmetry",
    "quadratic_drag",
    "cable_harness",
    "friction_drift",
    "unexplained",
    "joint_elasticity",
    "backlash",
    "load_dependent_friction",
    "encoder_offset",
    "time_delay",
    "gravity_tilt",
    "presliding_hysteresis",
    "link_inertial",
    "coupled_friction",
    "torque_offset",
    "payload_com",
    "position_dependent_friction",
    "biarticular_spring",
    "spring_stiffness",
    "spring_preload",
    "spring_hysteresis",
    "another_friction",
)
UNNAMED = ("unexplained", "another_friction")  # of them, that no law of the catalogue is
LEAD = 1.0  # [s] before a recording begins, in which a link behind its gear comes to rest
LISTED = 0.5  # [rad], the equilibrium of a spring that recordings list
PRESLIDING = 0.015  # [rad], in which a bristle is at its level
HELD = 2.0  # [kg], a payload that recordings list
SIGNS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "tanh": np.tanh,
    "erf": erf,
    "arctan": lambda x: 2 / np.pi * np.arctan(x),
    "root": lambda x: x / np.sqrt(1 + x * x),
    "clip": lambda x: np.clip(x, -1, 1),
}
console = Console()


@dataclass(frozen=True)
class Plant:
    """What a set is made with, drawn from its number.

    Attributes:
        urdf: Its text.
        tip: Where the last link holds a payload, along its x axis [m].
        effect: What is hidden, or "nothing".
        joint: Where.
        strength: Of the effect, about 1.
        sign: How dry friction changes sign; "constraint" for MuJoCo's own.
        width: Over which it does [rad/s].
        dry, viscous, armature: Of each joint.
    """

    urdf: str
    tip: float
    effect: str
    joint: int
    strength: float
    sign: str
    width: float
    dry: np.ndarray
    viscous: np.ndarray
    armature: np.ndarray

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.dry)

    @property
    def other(self) -> int:
        """The joint that shares an effect with the joint that has it."""
        return self.joint - 1 if self.joint else min(1, self.n - 1)

    @property
    def spring(self) -> float:
        """Stiffness of the spring that recordings list, at the joint [Nm/rad]; 0 without."""
        return 8 * self.dry[self.joint] if self.effect.startswith("spring_") else 0.0

    def model(self, payload: float) -> Any:
        """The engine's model with a mass at the last link's tip [kg]."""
        off = np.array([0.05, -0.04, 0.03]) * self.strength * (self.effect == "payload_com")
        link = f'<link name="held"><inertial><mass value="{payload}"/><inertia ixx="1e-8" iyy="1e-8" izz="1e-8" ixy="0" ixz="0" iyz="0"/>'
        link += f'</inertial></link><joint name="grip" type="fixed"><parent link="link{self.n}"/><child link="held"/>'
        link += f'<origin xyz="{self.tip + off[0]} {off[1]} {off[2]}"/></joint>'
        spec = mujoco.MjSpec.from_string(self.urdf.replace("</robot>", (link if payload else "") + "</robot>"))
        if self.effect in ("joint_elasticity", "backlash"):
            self._gear(spec)
        model = spec.compile()
        model.opt.timestep, model.opt.integrator = STEP, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
        at = [model.joint(f"joint{i + 1}").id for i in range(self.n)]
        model.jnt_limited[at] = 0
        model.dof_damping[at], model.dof_armature[at] = self.viscous, self.armature
        if self.sign == "constraint":
            model.dof_frictionloss[at] = self.dry * (
                np.arange(self.n) != self.joint if self.effect == "presliding_hysteresis" else 1
            )
        if self.effect == "link_inertial":
            model.body_mass[self.joint + 1] *= 1 + 0.15 * self.strength
            model.body_inertia[self.joint + 1] *= 1 + 0.15 * self.strength
        if self.effect == "gravity_tilt":
            model.opt.gravity[:] = 9.81 * np.array([0.02 * self.strength, 0.03 * self.strength, -1.0])
        mujoco.mj_setConst(model, mujoco.MjData(model))
        return model

    def _gear(self, spec: Any) -> None:
        """Make the link behind the joint's gear move by itself, about a joint of its own."""
        drive = spec.joint(f"joint{self.joint + 1}")
        rigid = spec.copy().compile()
        data, inertia = mujoco.MjData(rigid), np.zeros((self.n, self.n))
        mujoco.mj_forward(rigid, data)
        mujoco.mj_fullM(rigid, data, inertia)
        own = inertia[self.joint, self.joint]
        twist = spec.body(f"link{self.joint + 1}").add_joint(
            name="twist", type=mujoco.mjtJoint.mjJNT_HINGE, axis=drive.axis, pos=drive.pos
        )
        if self.effect == "joint_elasticity":
            twist.stiffness[0], twist.damping[0] = own * (30 / self.strength) ** 2, own * 6
        else:
            twist.limited, twist.range, twist.damping[0] = 1, [-0.01 * self.strength, 0.01 * self.strength], own * 5
            twist.solref_limit, twist.solimp_limit = [0.002, 1.0], [0.99, 0.999, 0.001, 0.5, 2.0]

    def torque(self, q: np.ndarray, v: np.ndarray, t: float, mounted: bool, load: np.ndarray, bristle: float) -> np.ndarray:
        """What acts on the joints beside the engine's own forces and the motors (n,) [Nm], under what their links need (n,) [Nm]."""
        j, i, dry, k = self.joint, self.other, self.dry[self.joint], self.strength * self.dry[self.joint]
        turn = SIGNS.get(self.sign, np.tanh)(v / self.width)
        result = -self.dry * turn if self.sign in SIGNS else np.zeros(self.n)
        if self.effect == "presliding_hysteresis":
            result[j] = -dry * bristle
        pull = self.spring * (LISTED - q[j])
        result[j] += max(pull, 0.0)
        result[j] += {
            "stribeck": lambda: -k * np.exp(-((v[j] / 0.15) ** 2)) * turn[j],
            "parallel_spring": lambda: 3 * k * max(0.4 - q[j], 0.0),
            "torque_ripple": lambda: 0.5 * k * np.sin(7 * q[j] + 1),
            "coulomb_asymmetry": lambda: -0.5 * k * turn[j] * (v[j] > 0),
            "quadratic_drag": lambda: -0.7 * k * v[j] * abs(v[j]),
            "cable_harness": lambda: -1.5 * k * (q[j] - 0.3) * mounted,
            "friction_drift": lambda: -0.6 * self.strength * (dry * turn[j] + self.viscous[j] * v[j]) * np.exp(-t / 5),
            "unexplained": lambda: -0.8 * k * np.cos(3 * q[j]) * v[j],
            "load_dependent_friction": lambda: -0.1 * self.strength * abs(load[j]) * turn[j],
            "position_dependent_friction": lambda: -0.4 * k * turn[j] * np.cos(3 * q[j] + 1),
            "spring_stiffness": lambda: 0.15 * self.strength * max(pull, 0.0),
            "spring_preload": lambda: max(pull + 0.1 * self.strength * self.spring, 0.0) - max(pull, 0.0),
            "spring_hysteresis": lambda: -0.15 * self.strength * max(pull, 0.0) * turn[j],
        }.get(self.effect, lambda: 0.0)()
        if self.effect == "coupled_friction":
            between = 0.6 * k * np.tanh((v[j] - v[i]) / self.width)
            result[[j, i]] += -between, between
        if self.effect == "biarticular_spring":
            stretched = 3 * k * max(0.6 - q[j] - 0.7 * q[i], 0.0)
            result[[j, i]] += stretched, 0.7 * stretched
        return result


def plant(number: int, rng: np.random.Generator) -> Plant:
    """The plant of a set: three of five have nothing missing."""
    effect = "nothing" if number % 5 < 3 else EFFECTS[(number // 5 * 2 + number % 5 - 3) % len(EFFECTS)]
    n = max(int(rng.integers(1, 8)), 2 if effect in ("coupled_friction", "biarticular_spring") else 1)
    felt = int(n > 1 and effect == "link_inertial")  # below, a link that turns about an upright axis only
    size, lengths = 0.75 ** np.arange(n), rng.uniform(0.15, 0.35, n)
    text = '<robot name="arm"><link name="link0"/>'
    for i, (length, mass) in enumerate(zip(lengths, rng.uniform(2, 6) * size, strict=True)):
        upright = n > 1 and i == 0
        axis = "0 0 1" if upright else ("0 1 0", "0 1 0", "1 0 0", "0 0 1")[rng.integers(4)] if i > 1 else "0 1 0"
        x, y, z = rng.uniform(0.3, 0.6) * length, *rng.uniform(-0.02, 0.02, 2)
        inertia = mass * length**2 / 12 + 0.003
        text += (
            f'<link name="link{i + 1}"><inertial><origin xyz="{x} {y} {z}"/><mass value="{mass}"/><inertia ixx="{inertia / 3}" '
        )
        text += f'iyy="{inertia}" izz="{inertia}" ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="joint{i + 1}" type="revolute">'
        text += f'<parent link="link{i}"/><child link="link{i + 1}"/><origin xyz="{lengths[i - 1] if i else 0} 0 0"/><axis xyz="{axis}"/>'
        text += '<limit lower="-3" upper="3" effort="500" velocity="10"/></joint>'
    return Plant(
        urdf=text + "</robot>",
        tip=float(lengths[-1]),
        effect=effect,
        joint=max(int(rng.integers(n)), felt),
        strength=float(rng.uniform(0.7, 1.3)),
        sign=("constraint", *SIGNS)[rng.integers(len(SIGNS) + 1)],
        width=float(np.exp(rng.uniform(np.log(0.01), np.log(0.08)))),
        dry=rng.uniform(0.3, 2, n) * size,
        viscous=rng.uniform(0.3, 2, n) * size,
        armature=rng.uniform(0.02, 0.2, n) * size,
    )


def reference(kind: str, n: int, seconds: float, rng: np.random.Generator) -> Callable[[float], tuple[np.ndarray, np.ndarray]]:
    """Position and speed (n,) to follow at a time: sines, or points with stops or without."""
    if kind == "sines":
        f, phase = rng.uniform(0.05, 0.4, (n, 4)), rng.uniform(0, 2 * np.pi, (n, 4))
        a, w = 1.3 * rng.dirichlet(np.ones(4), n), 2 * np.pi * f
        return lambda t: ((a * np.sin(w * t + phase)).sum(1), (a * w * np.cos(w * t + phase)).sum(1))
    starts, points = [0.0], [rng.uniform(-1.3, 1.3, n)]
    lasting = []
    while starts[-1] < seconds:
        points.append(rng.uniform(-1.3, 1.3, n))
        lasting.append(np.abs(points[-1] - points[-2]).max() / rng.uniform(0.7, 1.4) + 0.2)
        starts.append(starts[-1] + lasting[-1] + (rng.uniform(0.0, 1.0) if kind == "stops" else 0.0))

    def at(t: float) -> tuple[np.ndarray, np.ndarray]:
        k = min(int(np.searchsorted(starts, t, side="right")) - 1, len(lasting) - 1)
        way, s = points[k + 1] - points[k], min((t - starts[k]) / lasting[k], 1.0)
        return points[k] + way * s**3 * (10 - 15 * s + 6 * s**2), way * 30 * s**2 * (1 - s) ** 2 / lasting[k]

    return at


def recorded(one: Plant, mounted: bool, kind: str, seconds: float, rate: int, rng: np.random.Generator) -> np.ndarray:
    """Rows of t, q, dq and motor torque."""
    unlisted = 0.4 * one.strength * mounted * (one.effect == "payload_mass")
    model = one.model(unlisted + HELD * (one.effect == "payload_com"))
    data, follow, rows, motors = mujoco.MjData(model), reference(kind, one.n, seconds, rng), [], []
    at = [model.joint(f"joint{i + 1}").dofadr[0] for i in range(one.n)]
    lead = round(LEAD / STEP) if model.nv > one.n else 0
    data.qpos[at], data.qvel[at] = follow(0.0)
    data.qvel[:] *= not lead
    mujoco.mj_forward(model, data)
    inertia = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, inertia)
    stiffness, damping = 324 * np.diag(inertia)[at], 25 * np.diag(inertia)[at]
    moved, bristle = np.zeros(model.nv), 0.0
    for k in range(-lead, round(seconds / STEP)):
        q, v = follow(max(k, 0) * STEP)
        v = v * (k >= 0)
        mujoco.mj_forward(model, data)
        place, speed = data.qpos[at], data.qvel[at]
        motor = stiffness * (q - place) + damping * (v - speed) + 0.9 * data.qfrc_bias[at]
        mujoco.mj_mulM(model, data, moved, data.qacc)
        load = (moved + data.qfrc_bias)[at] - one.armature * data.qacc[at]
        data.qfrc_applied[at] = motor + one.torque(place, speed, k * STEP, mounted, load, bristle)
        bristle += STEP / PRESLIDING * (speed[one.joint] - abs(speed[one.joint]) * bristle)  # Dahl's
        motors.append(motor)
        if k >= 0 and k % round(1 / STEP / rate) == 0:
            late = max(len(motors) - 1 - round(0.012 * one.strength / STEP), 0) if one.effect == "time_delay" else -1
            rows.append(np.concatenate([[k * STEP], place, speed, motors[late]]))
        mujoco.mj_step(model, data)
    return np.array(rows)


def make(number: int, folder: Path) -> Plant:
    """Write a recording set; what is in it."""
    rng = np.random.default_rng([number, 20])
    one = plant(number, rng)
    n, rate, kind = one.n, int(rng.choice([50, 100, 250])), str(rng.choice(["sines", "points", "stops"]))
    seconds, count, bits = float(rng.choice([10, 20])), int(rng.integers(3, 8)), int(rng.choice([14, 16, 18]))
    current, speeds, unknown = rng.random(3) < (0.3, 0.6, 0.2)
    constant, share = rng.uniform(5, 15, n), rng.choice([0.01, 0.03, 0.06])
    names = [f"joint{i + 1}" for i in range(n)]
    files = []
    for i in range(count):
        cold = 1 + 0.4 * one.strength * (np.arange(n) == one.joint) * (one.effect == "another_friction" and i == 1)
        rows = recorded(replace(one, dry=cold * one.dry, viscous=cold * one.viscous), i % 2 == 0, kind, seconds, rate, rng)
        q, dq, tau = rows[:, 1 : n + 1], rows[:, n + 1 : 2 * n + 1], rows[:, 2 * n + 1 :]
        q = np.round(q * 2**bits / 2 / np.pi) / 2**bits * 2 * np.pi
        dq = dq + 0.003 * rng.standard_normal(dq.shape)
        tau = tau + share * tau.std(0) * rng.standard_normal(tau.shape)
        tau[:, one.joint] *= 1 + 0.08 * one.strength * (one.effect == "torque_gain")
        tau[:, one.joint] += 0.4 * one.strength * one.dry[one.joint] * (one.effect == "torque_offset")
        q[:, one.joint] += 0.03 * one.strength * (one.effect == "encoder_offset")
        columns = ["t", *(f"q_{j}" for j in names), *(f"dq_{j}" for j in names if speeds)]
        columns += [f"{'current' if current else 'tau'}_{j}" for j in names]
        table = np.hstack([rows[:, :1], q, *([dq] if speeds else []), tau / constant if current else tau])
        lines = [",".join(columns), *(",".join(f"{x:.9g}" for x in row) for row in table)]
        write_text(folder / f"{i}.csv", "\n".join(lines) + "\n")
        files.append({"file": f"{i}.csv"} | ({"payload": HELD} if one.effect == "payload_com" else {}))
        if one.spring:
            files[-1]["springs"] = {"pea": {names[one.joint]: {"stiffness_Nm_per_rad": one.spring, "equilibrium_rad": LISTED}}}
    write_text(folder / "arm.urdf", one.urdf)
    header: dict[str, Any] = {"format": "rrr_oc-recordings/1", "robot": "arm.urdf", "joints": names, "recordings": files}
    header |= {"torque": "current" if current else "motor", "inertial": "identify" if unknown else "nominal"}
    header |= {"tool": {"link": f"link{n}", "position": [one.tip, 0, 0]}}
    if current:
        header["actuators"] = {j: {"torque_constant": k} for j, k in zip(names, constant.tolist(), strict=True)}
    write_json(folder / "recordings.json", header)
    return one


def judged(number: int, out: Path) -> dict[str, Any]:
    """Make a set and diagnose it; what was hidden and what was found."""
    file = out / f"{number:03d}.json"

    def judge() -> None:
        one = make(number, out / f"{number:03d}")
        found = to_json(diagnose(load_recordings(out / f"{number:03d}")))
        claims = [
            {"names": [e["effect"], *(x if isinstance(x, str) else x["effect"] for x in e["indistinguishable_from"])]}
            | {"joint": e["joint"]}
            for e in found["effects"]
        ]
        claims += [{"names": ["unexplained"], "joint": e["joint"]} for e in found["unexplained"]]
        hidden = {"set": number, "effect": one.effect, "joint": f"joint{one.joint + 1}", "joints": one.n, "sign": one.sign}
        write_json(file, hidden | {"claims": claims, "nrmse": found["nrmse"]["held_out"]})

    Made([file], number, [Path(__file__)]).once(judge)
    return json.loads(file.read_text())


def _wanted(effect: str) -> str:
    return "unexplained" if effect in UNNAMED else effect


def main(
    sets: Annotated[int, typer.Option(min=1)] = 40,
    first: Annotated[int, typer.Option(min=0, help="number of the first set")] = 0,
    jobs: Jobs = -1,
    out: Annotated[Path, typer.Option(help="folder of the results")] = Path("results/engine_plants"),
) -> None:
    """Make sets, diagnose them, and compare with what was hidden."""
    with workers(jobs):
        runs = unordered(judged, [(number, out) for number in range(first, first + sets)])
        results = sorted(track(runs, "sets", total=sets), key=lambda r: r["set"])
    shown = Table("set", "joints", "dry friction", "hidden", "found")
    for r in results:
        found = ", ".join(f"{c['names'][0]} {c['joint'] or ''}" for c in r["claims"]) or "nothing"
        hidden = "nothing" if r["effect"] == "nothing" else f"{r['effect']} {r['joint']}"
        shown.add_row(str(r["set"]), str(r["joints"]), r["sign"], hidden, found)
    console.print(shown)
    clean = [bool(r["claims"]) for r in results if r["effect"] == "nothing"]
    others = [r for r in results if r["effect"] != "nothing"]
    named = [
        any(_wanted(r["effect"]) in c["names"] and (c["joint"] is None or r["joint"] in c["joint"]) for c in r["claims"])
        for r in others
    ]
    more = [len(r["claims"]) > 1 for r in others]
    for what, hits in (("false alarms", clean), ("effects named", named), ("with a further claim", more)):
        if hits:
            low, high = binomtest(sum(hits), len(hits)).proportion_ci(method="exact")
            console.print(f"{what}: {sum(hits)} of {len(hits)}, 95 % interval {100 * low:.0f} … {100 * high:.0f} %")


if __name__ == "__main__":
    typer.run(main)
