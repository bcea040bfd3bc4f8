"""Exported files read again, and compared with the model that they were made of: mass matrix, gravity, and the torques of motions."""

# pyright: reportAttributeAccessIssue=false
# (mujoco's wheel has no stubs)

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import casadi as ca
import mujoco
import numpy as np

from rrr_oc.effects import Effect, ExportTwin, MotionShift, MovesLink
from rrr_oc.errors import UserError
from rrr_oc.model.motion import Motion
from rrr_oc.model.symbolic_model import Model
from rrr_oc.numerics.along import along
from rrr_oc.robot.mjcf import compiled
from rrr_oc.robot.rigid_body import rigid_body
from rrr_oc.robot.robot import load_robot
from rrr_oc.simulation.engine_model import body_of
from rrr_oc.simulation.export import as_in_a_file, with_effects

LARGEST = 0.01  # relative: a file that is further off is none of the model
COUNT = (
    100  # states, or rows of a motion, that are compared; more find nothing else, for links are the same ten numbers everywhere
)
SPAN, SPEED, ACCELERATION = 1.5, 1.5, 5.0  # [rad], [rad/s], [rad/s²] of states, where no motion is given
SHARP = 1e-9  # width of smoothed corners of springs, which files do not have

Differences = dict[str, dict[str, float]]


def differences(
    files: Mapping[str, Path], model: Model, theta: np.ndarray, payload: float = 0.0, motion: Motion | None = None
) -> Differences:
    """The largest difference of each file's mass matrix, gravity and torques from the model's, relative to the largest of their joint's.

    Compared is what a file has: of an MJCF links, payload, springs, rotors and friction that is proportional to speed or its square; of a
    URDF the links, without the payload. Friction that changes sign with the speed is left out, since its form in the engine is another;
    so is what `as_in_a_file` and `without_form` leave out.

    Args:
        files: "mjcf" and "urdf", as far as there are any.
        theta: Parameters of the effects, as in `Model.theta`.
        payload: Listed mass at the tool [kg].
        motion: Whose states are compared; random ones by default.

    Returns:
        By file "mass matrix", "gravity" and "torque"; no file whose joints are not the model's alone, as with gears that give.
    """
    model, theta, _ = as_in_a_file(model, theta)
    states, result = _states(model, motion), Differences()
    if "mjcf" in files and not any(isinstance(effect, MovesLink | MotionShift) for effect in model.effects):
        in_files = with_effects(model, theta, [_has_form(effect) for effect in model.effects])
        result["mjcf"] = _largest(_of_mjcf(files["mjcf"], states), _of_model(*in_files, payload, states))
    if "urdf" in files:
        robot = replace(model.robot, inertial=body_of(model, theta).inertial)
        bare, read = Model(robot, robot.tool), load_robot(files["urdf"], robot.joints, True, tuple(robot.gravity), robot.held)
        none = np.zeros(0)
        result["urdf"] = _largest(_of_model(Model(read, read.tool), none, 0.0, states), _of_model(bare, none, 0.0, states))
    return result


def largest_of(found: Differences) -> tuple[str, str, float] | None:
    """File, quantity and size of the largest difference, None without any; raises `UserError` where it is above `LARGEST`."""
    every = [(size, file, name) for file, sizes in found.items() for name, size in sizes.items()]
    if not every:
        return None
    size, file, name = max(every)
    if not size <= LARGEST:
        raise UserError(
            f"the {file.upper()} differs from the model: its {name} by {100 * size:.3g} %; up to {100 * LARGEST:g} % are allowed. "
            "Nothing is exported"
        )
    return file, name, size


Quantities = dict[str, np.ndarray]  # "mass matrix" (n, n, K) [kg m²], "gravity" and "torque" (n, K) [Nm]


def _largest(found: Quantities, wanted: Quantities) -> dict[str, float]:
    """The largest difference of each, over the largest value of its joint, or a thousandth of that of all joints."""
    result = {}
    for name, true in wanted.items():
        sizes = np.max(np.abs(true), axis=tuple(range(1, true.ndim)))
        if name == "mass matrix":
            sizes = np.sqrt(np.max(np.diagonal(true), axis=0))
            sizes = np.outer(sizes, sizes)[:, :, None]
        else:
            sizes = np.maximum(sizes, max(1e-3 * float(sizes.max()), 1e-9))[:, None]
        result[name] = float(np.max(np.abs(found[name] - true) / sizes))
    return result


def _states(model: Model, motion: Motion | None) -> tuple[np.ndarray, ...]:
    """q, dq, ddq of a motion at even distances, or at random, each (n, K)."""
    if motion is not None:
        rows = np.unique(np.linspace(0, len(motion.t) - 1, COUNT).astype(int))
        return motion.q[:, rows], motion.dq[:, rows], motion.ddq[:, rows]
    rng, n = np.random.default_rng(0), model.robot.n
    spans = zip((SPAN, SPEED, ACCELERATION), rng.uniform(-1, 1, (3, n, COUNT)), strict=True)
    return tuple(span * x for span, x in spans)


def _has_form(effect: Effect) -> bool:
    """Whether an MJCF has the effect in the same form."""
    turns = effect.width is not None and effect.width.unit == "rad/s"
    return effect.side == "body" or (
        isinstance(effect, ExportTwin) and not effect.states and not turns and effect.side in ("link", "drive")
    )


def _of_model(model: Model, theta: np.ndarray, payload: float, states: tuple[np.ndarray, ...]) -> Quantities:
    """Of a model whose effects are functions of the instant."""
    (q, dq, ddq), n = states, model.robot.n
    widths = np.full(len(model.widths), SHARP)

    def torque(*motion: np.ndarray) -> np.ndarray:
        zero = np.zeros((1, motion[0].shape[1]))
        return along(model.motor_inverse, *motion, zero, payload + zero, theta, widths, model.robot.inertial)[0]

    carried, gravity = (np.array(ca.evalf(ca.SX(x))) for x in model.rigid(model.robot.inertial, payload, theta, widths))
    still, body = torque(q, 0 * q, 0 * q), rigid_body(model.robot)
    columns = [torque(q, 0 * q, np.tile(unit[:, None], q.shape[1])) - still for unit in np.eye(n)]
    pulled = along(body.gravity_torque, q, carried, gravity.reshape(3, 1))[0]
    return {"mass matrix": np.array(columns).swapaxes(0, 1), "gravity": pulled, "torque": torque(q, dq, ddq)}


def _of_mjcf(path: Path, states: tuple[np.ndarray, ...]) -> Quantities:
    """Of a file, by the engine's own inverse dynamics; without friction that changes sign, limits and contacts."""
    mj = compiled(path)
    mj.dof_frictionloss[:] = 0
    mj.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_LIMIT) | int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    data, n = mujoco.MjData(mj), len(states[0])
    mass, gravity, torque = np.zeros((n, n, len(states[0].T))), np.zeros(states[0].shape), np.zeros(states[0].shape)
    for k, (q, dq, ddq) in enumerate(zip(*(x.T for x in states), strict=True)):
        data.qpos[:], data.qvel[:], data.qacc[:] = q, 0.0, 0.0
        mujoco.mj_forward(mj, data)
        gravity[:, k], whole = data.qfrc_bias, np.zeros((n, n))
        mujoco.mj_fullM(mj, data, whole)
        mass[:, :, k] = whole
        data.qvel[:], data.qacc[:] = dq, ddq
        mujoco.mj_inverse(mj, data)
        mujoco.mj_fwdActuation(mj, data)
        torque[:, k] = data.qfrc_inverse - data.qfrc_actuator
    return {"mass matrix": mass, "gravity": gravity, "torque": torque}
