# pyright: reportAttributeAccessIssue=false
"""Arms that loops drive to commanded angles, in MuJoCo: position actuators, dry friction as a constraint, damping and armature.

Nothing of it is the package's but the classes that hold recordings and the derivatives of their reader.
"""

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
from recorded import Plant, as_set, multisine

from rrr_oc.model.motion import Motion
from rrr_oc.numerics.savitzky_golay import differentiate, split
from rrr_oc.recordings.header import Loop
from rrr_oc.recordings.recording import Recording, RecordingSet

STEP = 1e-3  # [s] of the engine
EVERY = 10  # steps between two samples: 100 Hz
ENCODER = 2 * np.pi / 2**16  # [rad]


def driven(plant: Plant, true: Loop, name: str, rng: np.random.Generator, seconds: float = 10.0) -> tuple[np.ndarray, ...]:
    """t (K,), positions and commands (n, K) of an arm whose position actuators have the gains of `true`."""
    model = mujoco.MjModel.from_xml_path(str(_with_actuators(plant, true, name)))
    data, half = mujoco.MjData(model), np.arange(2 * round(seconds / STEP)) * STEP / 2
    every, rates, _ = multisine(plant.n, half, rng)
    t, commands, held = half[::2], every[:, ::2], every[:, 1::2]  # held over a step: its middle, or they would lag
    data.qpos[:], data.qvel[:] = commands[:, 0], rates[:, 0]
    q = np.zeros((plant.n, t.size))
    for k in range(t.size):
        data.ctrl[:] = held[:, k]
        q[:, k] = data.qpos
        mujoco.mj_step(model, data)
    return t[::EVERY], q[:, ::EVERY], commands[:, ::EVERY]


def driven_set(plant: Plant, true: Loop, listed: Loop, rng: np.random.Generator, number: int = 4) -> RecordingSet:
    """Recordings of such an arm, whose header has the gains of `listed`."""
    made = []
    for i in range(number):
        t, q, command = driven(plant, true, f"{i}", rng)
        made.append(recorded(plant, f"{i}.csv", listed, t, ENCODER * np.round(q / ENCODER), command))
    return replace(as_set(plant, made), torque="command")


def recorded(plant: Plant, name: str, listed: Loop, t: np.ndarray, q: np.ndarray, command: np.ndarray) -> Recording:
    """A recording of positions and commands (n, K) alone."""
    segments = split(t)
    dq, ddq = differentiate(t, q, segments), differentiate(t, q, segments, 2)
    motion = Motion(t, q, dq, ddq, np.zeros(t.size), segments)
    computed = tuple(f"{kind}_{joint}" for kind in ("dq", "ddq") for joint in list(plant.model.names)[1:])
    tau = listed.kp[:, None] * (command - q) - listed.kd[:, None] * dq
    return replace(Recording.planned(name, motion), tau=tau, command=command, loop=listed, computed=computed)


def _with_actuators(plant: Plant, true: Loop, name: str) -> Path:
    """The plant's arm as MJCF beside its URDF, driven by position actuators."""
    spec = mujoco.MjSpec.from_file(str(plant.urdf))
    spec.option.timestep, spec.option.integrator = STEP, mujoco.mjtIntegrator.mjINT_RK4  # implicit damping is armature
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    joints = [joint.name for joint in spec.joints]
    for j, joint in enumerate(spec.joints):
        joint.limited, joint.frictionloss, joint.armature = False, plant.dry[j], plant.armature[j]
        joint.damping[0] = plant.viscous[j]
        joint.solref_friction[:] = 2 * STEP, 1.0  # as hard as the step allows
    for j, joint in enumerate(joints):
        motor = spec.add_actuator(name=joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        motor.gaintype, motor.biastype = mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_AFFINE
        motor.gainprm[0], motor.biasprm[:3] = true.kp[j], (0.0, -true.kp[j], -true.kd[j])
    path = Path(plant.urdf).with_name(f"driven_{name}.xml")
    spec.compile()
    path.write_text(spec.to_xml())
    return path
