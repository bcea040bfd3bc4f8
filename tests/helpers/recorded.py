# pyright: reportAttributeAccessIssue=false, reportCallIssue=false, reportArgumentType=false
"""Recordings of a made-up plant for the tests: numeric Pinocchio, friction and springs written out here.

It shares with the package only the classes that hold recordings and the derivatives of their reader.
"""

import os
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import mujoco
import numpy as np
import pinocchio as pin
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicHermiteSpline

from rrr_oc.calibration.jacobian import Prediction
from rrr_oc.effects import Trial
from rrr_oc.effects.elastic.parallel_spring import ParallelSpring
from rrr_oc.model.motion import Motion
from rrr_oc.numerics.savitzky_golay import differentiate, split
from rrr_oc.recordings.recording import Recording, RecordingSet
from rrr_oc.robot.robot import Robot, load_robot

URDF = Path(__file__).resolve().parents[2] / "rrr_oc" / "urdf"


@dataclass(frozen=True)
class Plant:
    """A robot's URDF, dry friction [Nm] that turns within `width` [rad/s], viscous friction [Nm s/rad], armature [kg m²]."""

    urdf: str | Path
    dry: np.ndarray
    viscous: np.ndarray
    armature: np.ndarray
    width: float = 0.05
    model: pin.Model = field(init=False)

    def __post_init__(self) -> None:
        path = URDF / f"{self.urdf}.urdf" if self.urdf in ("rrr", "rrr_prototype") else self.urdf
        object.__setattr__(self, "model", pin.buildModelFromUrdf(str(path)))

    @property
    def n(self) -> int:
        """Number of joints."""
        return self.model.nq

    def torque(self, q, dq, ddq, payload: float = 0.0, tool=(0.0, 0.0, 0.0), pea: dict | None = None) -> np.ndarray:
        """Motor torque (n, K) [Nm]; `pea` maps a joint's number to (stiffness [Nm/rad], equilibrium [rad])."""
        load = self.load(q, dq, ddq, payload, tool, pea)
        drive = self.dry[:, None] * np.tanh(dq / self.width) + self.viscous[:, None] * dq + self.armature[:, None] * ddq
        return load + drive

    def load(self, q, dq, ddq, payload: float = 0.0, tool=(0.0, 0.0, 0.0), pea: dict | None = None) -> np.ndarray:
        """Load torque of Eq. 6 (n, K) [Nm]."""
        model = self.model.copy()
        model.appendBodyToJoint(self.n, pin.Inertia(payload, np.zeros(3), np.zeros((3, 3))), pin.SE3(np.eye(3), np.array(tool)))
        data = model.createData()
        tau = np.array([pin.rnea(model, data, *x) for x in zip(q.T, dq.T, ddq.T, strict=True)]).T
        for joint, (stiffness, equilibrium) in (pea or {}).items():
            tau[joint] -= stiffness * np.maximum(equilibrium - q[joint], 0.0)
        return tau


def multisine(n: int, t: np.ndarray, rng: np.random.Generator, fastest: float = 0.8) -> tuple[np.ndarray, ...]:
    """q, dq, ddq (n, K) of four sines a joint, from 0.1 Hz to `fastest`, with exact derivatives."""
    q, dq, ddq = np.zeros((3, n, t.size))
    for f in rng.uniform(0.1, fastest, (4, n)):
        w, phase, a = 2 * np.pi * f[:, None], rng.uniform(0, 2 * np.pi, (n, 1)), rng.uniform(0.1, 0.35, (n, 1))
        q, dq, ddq = q + a * np.sin(w * t + phase), dq + a * w * np.cos(w * t + phase), ddq - a * w**2 * np.sin(w * t + phase)
    return q, dq, ddq


def record(
    plant: Plant,
    name: str,
    rng: np.random.Generator,
    seconds: float = 10.0,
    noise: float = 0.02,
    motion: tuple[np.ndarray, ...] | None = None,
    pea: dict | None = None,
    payload: float = 0.0,
    tool=(0.0, 0.0, 0.0),
    load: bool = False,
) -> Recording:
    """One recording at 100 Hz with an encoder of 18 bits; `noise` is a share of the torque's spread, white."""
    t = np.arange(round(100 * seconds)) / 100
    q, dq, ddq = multisine(plant.n, t, rng) if motion is None else motion
    tau = (plant.load if load else plant.torque)(q, dq, ddq, payload, tool, pea)
    tau = tau + noise * tau.std(axis=1, keepdims=True) * rng.standard_normal(tau.shape)
    count = 2 * np.pi / 2**18
    seen, segments = count * np.round(q / count), split(t)
    springs = tuple(
        (ParallelSpring((j,), active="below"), {"stiffness": k, "equilibrium": rest}) for j, (k, rest) in (pea or {}).items()
    )
    computed = tuple(f"{kind}_{joint}" for kind in ("dq", "ddq") for joint in list(plant.model.names)[1:])
    rates = differentiate(t, seen, segments), differentiate(t, seen, segments, 2)
    motion = Motion(t, seen, *rates, np.full(t.size, payload), segments)
    return replace(Recording.planned(name, motion, springs), tau=tau, computed=computed)


def by_engine(plant: Plant, name: str, rng: np.random.Generator, loss: float) -> Recording:
    """A recording of 15 s by MuJoCo, whose dry friction is a constraint: a joint that reverses may stand still for a moment."""
    model = mujoco.MjModel.from_xml_path(str(plant.urdf))
    model.opt.integrator, model.opt.timestep = mujoco.mjtIntegrator.mjINT_IMPLICITFAST, 0.001
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    model.jnt_limited[:], model.dof_frictionloss[:] = 0, loss
    model.dof_damping[:], model.dof_armature[:] = plant.viscous, plant.armature
    data, t = mujoco.MjData(model), np.arange(15000) / 1000
    q, dq, _ = multisine(plant.n, t, rng)
    data.qpos[:], data.qvel[:] = q[:, 0], dq[:, 0]
    seen = np.empty((2, plant.n, t.size))
    for k in range(t.size):
        data.qfrc_applied[:] = 200 * (q[:, k] - data.qpos) + 20 * (dq[:, k] - data.qvel)
        seen[:, :, k] = data.qpos, data.qfrc_applied
        mujoco.mj_step(model, data)
    positions, tau = seen[:, :, ::10]
    made = record(plant, name, rng, 15.0, motion=(positions, *np.zeros((2, plant.n, 1500))))
    return replace(made, tau=tau + 0.01 * tau.std(axis=1, keepdims=True) * rng.standard_normal(tau.shape))


def point_to_point(plant: Plant, noise: float, always: float) -> list[Recording]:
    """Four recordings of one joint with a second of rest after each move and speeds that are trapezoids, with 0.4 Nm more: always in
    the share `always`, the rest while the joint moves."""
    rng, made = np.random.default_rng(1), []
    shape = np.repeat([1.0, 0.0, -1.0, 0.0], [30, 60, 30, 100])
    for i in range(4):
        sizes = np.diff(rng.uniform(-1.0, 1.0, 8), prepend=0.0) / 0.27
        ddq = np.concatenate([size * shape for size in sizes])[None]
        dq = np.concatenate([[[0.0]], np.cumsum(ddq[:, :-1], axis=1) / 100], axis=1)
        q = np.concatenate([[[0.0]], np.cumsum(dq[:, :-1] + ddq[:, :-1] / 200, axis=1) / 100], axis=1)
        ddq[:, 1:] = (ddq[:, 1:] + ddq[:, :-1]) / 2  # where it jumps
        r = record(plant, f"{i}.csv", rng, ddq.size / 100, noise, (q, dq, ddq))
        made.append(replace(r, tau=r.tau + 0.4 * np.maximum(always, np.tanh(r.dq / plant.width) ** 2)))
    return made


def behind_gear(plant: Plant, recorded: Recording, motion: tuple[np.ndarray, ...], through: Callable) -> Recording:
    """A recording (of one joint) with the torque that a gear passes to its link as `through(twist, its rate)` [Nm] says.

    The link by an adaptive integrator on Pinocchio's forward dynamics; it begins without twist, so that it swings at first.
    """
    t, data = recorded.t, plant.model.createData()
    curve = CubicHermiteSpline(t, motion[0][0], motion[1][0])

    def passed(at, x):
        return through(curve(at) - x[0], curve(at, 1) - x[1])

    def slope(at, x):
        return [x[1], pin.aba(plant.model, data, x[:1], x[1:], np.array([passed(at, x)]))[0]]

    link = solve_ivp(slope, (t[0], t[-1]), [curve(t[0]), curve(t[0], 1)], "LSODA", t, rtol=1e-8, atol=1e-10).y
    return replace(recorded, tau=plant.torque(*motion) - plant.load(*motion) + passed(t, link))


def real(name: str) -> Path:
    """The folder of a set of real recordings; skips where it is not at hand."""
    folder = Path(os.environ.get("RRR_OC_SHARED", Path(__file__).resolve().parents[3] / "shared")) / "recordings" / name
    if not folder.is_dir():
        pytest.skip(f"{folder} is not there; set RRR_OC_SHARED")
    return folder


def as_set(
    plant: Plant, recordings, inertial: str = "nominal", torque: str = "motor", robot: Robot | None = None
) -> RecordingSet:
    """The recordings as a set; the robot with its URDF's inertial parameters, or only its kinematics."""
    source = str(plant.urdf) if plant.urdf in ("rrr", "rrr_prototype") else Path(plant.urdf)
    arm = robot or load_robot(source, None, inertial == "nominal")
    return RecordingSet(arm, source, torque, inertial, arm.tool, (None,) * arm.n, tuple(recordings), Path("made_up"))


def by_trial(at: Prediction, trial: Trial) -> np.ndarray:
    """Change of `CalibratedModel.output_torque` for each coefficient of a trial, (m, n, K) [Nm]."""
    true = at.before_sensors(trial)
    return true if trial.effect.side == "sensor" else np.array([at.physics.passed_on(at.recording, change) for change in true])
