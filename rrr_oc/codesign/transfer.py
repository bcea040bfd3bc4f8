"""Optima in the twin calibrated on recordings, and designs on the arm with the physics that a diagnosis found."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from rrr_oc.calibration.calibrated_model import KINEMATICS, CalibratedModel
from rrr_oc.calibration.model_file import robot_of
from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.optimum import SampledMotion, describe, start_of
from rrr_oc.codesign.task import PHASES, Task
from rrr_oc.effects import Body, BodyChange, OnlyRecorded
from rrr_oc.errors import UserError
from rrr_oc.model.metrics import Metrics, measure
from rrr_oc.model.recorded_physics import Physics
from rrr_oc.model.symbolic_model import Model
from rrr_oc.robot.drives import Actuators, MotorAndGear
from rrr_oc.robot.inertial_parameters import is_possible
from rrr_oc.simulation.engine_model import Settings, twin
from rrr_oc.simulation.tracking import Reference, Tracked, check_gears, track


def check_transfer(design: CoDesign, calibrated: CalibratedModel) -> None:
    """Raise `UserError` unless every optimum of the design can be simulated with the calibrated model: it has the joints of the
    task's robot, every term holds for all recordings, and no gear or spring between drive and link gives."""
    check_joints(design.task, calibrated)
    if design.series.rows:
        raise UserError(
            "the design has springs between drives and links; a model of recordings without them says nothing of such drives"
        )
    some = [term.effect.name for term in calibrated.terms if term.recordings != "all"]
    if some:
        raise UserError(f"the model's {some[0]} holds for single recordings only; a model whose terms hold for all is needed")
    arm = _calibrated_arm(design, calibrated, np.zeros(len(design.model.parameters)))
    check_gears(twin(arm.model, arm.theta, settings=Settings("native")))


def check_joints(task: Task, calibrated: CalibratedModel) -> None:
    """Raise `UserError` unless a model has the joints of a task's robot."""
    if calibrated.joints != task.robot.joints:
        raise _other_joints(task, calibrated)


def _other_joints(task: Task, calibrated: CalibratedModel) -> UserError:
    own = ", ".join(task.robot.joints)
    return UserError(
        f"the model has the joints {', '.join(calibrated.joints)}, but the task's robot {own}; the model's must be among these, in "
        'their order: "joints" of the task says which are the arm\'s'
    )


def unknown_joints(task: Task, calibrated: CalibratedModel) -> tuple[str, ...]:
    """Joints of a task's robot of which a model says nothing."""
    return tuple(joint for joint in task.robot.joints if joint not in calibrated.joints)


def uncalibrated(joints: Sequence[str]) -> str:
    """A sentence on joints that a calibrated model says nothing of."""
    return f"the model says nothing of {', '.join(joints)}: links as the task has them, without friction and rotor inertia"


def of_all_joints(task: Task, calibrated: CalibratedModel) -> CalibratedModel:
    """A model of some joints of a task's robot as one of all of them: the others have no friction, and links as the task has them.

    What a calibration changed of a link, with all that was held still on it, is added to that link.

    Raises:
        UserError: The model has a joint that the task's robot lacks, or one that sits or turns otherwise there; a link would be no
            possible body; an effect moves a payload that another joint carries.
    """
    robot, own = task.robot, calibrated.robot
    if own.joints == robot.joints:
        return calibrated
    at = [robot.joints.index(joint) for joint in own.joints if joint in robot.joints]
    if len(at) < own.n or at != sorted(at):
        raise _other_joints(task, calibrated)
    for i, j in enumerate(at):
        follows = j == 0 if i == 0 else at[i - 1] == j - 1  # nothing turns between it and the one before
        apart = [np.abs(own.axes[i] - robot.axes[j]).max()] + [np.abs(own.placements[i] - robot.placements[j]).max()] * follows
        if max(apart) > KINEMATICS:
            raise UserError(
                f"joint {own.joints[i]} of the model sits or turns otherwise in the task's robot; the same robot is required"
            )
    inertial = robot.inertial.copy()
    inertial[:, at] += own.inertial - robot_of(calibrated.urdf, own.joints, own.gravity.tolist()).inertial
    for j in at:
        if not is_possible(inertial[:, j]):
            raise UserError(
                f"link {robot.links[j]!r} would be no possible body: the model has changed it with all that was held still on it by more "
                "than it weighs alone; a model of all joints is needed"
            )
    moved = [t.effect.name for t in calibrated.terms if t.effect.alters == "position"]
    if moved and at[calibrated.tool.joint] != task.tool.joint:
        carrier, other = own.joints[calibrated.tool.joint], robot.joints[task.tool.joint]
        raise UserError(f"the model's {moved[0]} is of a payload on {carrier}; the task's is carried by {other}")
    terms = tuple(replace(t, effect=t.effect.renumbered(at)) for t in calibrated.terms)
    spread, size = calibrated.spread, len(calibrated.values)
    if spread is not None:
        links = np.zeros((robot.n, 10, spread.shape[1]))
        links[at] = spread[size:].reshape(own.n, 10, -1)
        spread = np.concatenate([spread[:size], links.reshape(10 * robot.n, -1)])
    noise, nrmse, left = np.full((3, robot.n), np.nan)
    noise[at], nrmse[at], left[at] = (
        calibrated.noise,
        calibrated.nrmse,
        0.0 if calibrated.unexplained is None else calibrated.unexplained,
    )
    constants = dict(zip(at, calibrated.torque_constant, strict=True))
    return replace(
        calibrated,
        robot=replace(robot, inertial=inertial, gravity=own.gravity),
        tool=task.tool,
        torque_constant=tuple(constants.get(j) for j in range(robot.n)),
        terms=terms,
        noise=noise,
        nrmse=nrmse,
        spread=spread,
        unexplained=np.nan_to_num(left),
        alternatives=tuple(replace(a, model=of_all_joints(task, a.model)) for a in calibrated.alternatives),
    )


def motors_of(calibrated: CalibratedModel, task: Task) -> dict[str, MotorAndGear]:
    """Motors and gears of a task's moving joints as a calibrated model has them: its dry and viscous friction and its rotors' inertia,
    where they hold for all recordings. Other effects of the drives are left out.

    Raises `UserError` where the model says nothing of a moving joint, or has none of these of any.
    """
    if unknown := [joint for joint in task.joints if joint not in calibrated.joints]:
        raise UserError(f"--actuators model: the model has no joint {unknown[0]!r}; it has {', '.join(calibrated.joints)}")
    found = {joint: dict[str, float]() for joint in task.joints}
    for term in calibrated.terms:
        key = term.effect.motor
        for joint in (calibrated.joints[j] for j in term.effect.joints):
            if key and term.recordings == "all" and joint in found:
                found[joint][key] = found[joint].get(key, 0.0) + float(term.values[0])
    if not any(found.values()):
        raise UserError(f"--actuators model: the model has no friction and no rotor of {', '.join(task.joints)}")
    return {joint: MotorAndGear(**known) for joint, known in found.items()}


def repaired(design: CoDesign, calibrated: CalibratedModel, groups: Sequence[str]) -> CoDesign:
    """The design on the calibrated arm: with its inertial parameters, its payload, and its effects of the sides "link" and "body".

    The other effects change the recorded torque, not the load torque of a given motion of the links: those of drives and sensors
    act between load torque and recording, those of the side "motion" between links and encoders. Effects that scale the recorded
    springs are left out, because the design brings its own springs, and so is what is only in the records.

    Args:
        groups: Label of the physical set-up of each phase ("go", "return"), for terms that hold for some groups only.

    Raises:
        UserError: The model has other joints; an effect, other than of the payload, holds in one phase only.
    """
    check_joints(design.task, calibrated)
    known, payload = [], design.task.payload
    for term in calibrated.terms:
        effect = term.effect
        if effect.side not in ("link", "body") or "springs" in effect.inputs or isinstance(effect, OnlyRecorded):
            continue
        holds = [term.recordings == "all" or group in term.groups for group in groups]
        if all(holds) or (effect.alters == "position" and holds[0]):  # in the return phase there is no payload to be displaced
            known.append((effect, term.values))
        elif isinstance(effect, BodyChange) and effect.alters == "payload" and holds[0]:
            payload = effect.change(Body(None, None, payload, None), term.named).payload
        elif any(holds):
            raise UserError(f"{effect.name} holds for {' and '.join(term.groups)}, but not in every phase of the task")
    robot = replace(design.task.robot, inertial=calibrated.robot.inertial)
    task = replace(design.task, robot=robot, tool=calibrated.tool, payload=payload)
    return replace(design, task=task).with_physics(known)


def describe_transfer(
    design: CoDesign, motion: SampledMotion, theta: np.ndarray, calibrated: CalibratedModel, drives: Actuators | None
) -> dict[str, Any]:
    """The paper's metrics of an optimum tracked in the calibrated twin, with the load torque computed in two ways.

    Robot and tool point are the calibrated model's, springs and motion the optimum's. The motor torque that the model predicts is
    fed forward; the paper's P-controllers add the feedback.

    Args:
        theta: Parameters of the design's springs (np,).
        drives: Of the moving joints; None where they are unknown.

    Returns:
        "engine": metrics of M ddq + C dq + G − tau_spring along the simulated motion; "eq10": of the load torque by Eq. 10 from the
        motor torque, None without drives; "motor": of the motor torque itself; each as `describe` gives it. "tracking_error_rad".
        "saturated": whether a controller reached its limit.
    """
    task, arm = design.task, _calibrated_arm(design, calibrated, theta)
    references = reference_phases(design, motion, theta, calibrated)
    tracked = track(
        arm.model, references, arm.theta, settings=Settings(effects="native", start=start_of(design)), widths=arm.widths
    )
    return {
        "engine": describe(design, tracked.metrics, task.moving),
        "eq10": None if drives is None else describe(design, _by_eq10(tracked, drives, task.moving)),
        "motor": describe(design, measure([(p.t, p.tau_motor) for p in tracked.phases]), task.moving),
        "tracking_error_rad": tracked.tracking_error,
        "saturated": bool(np.any(tracked.saturated)),
    }


def _by_eq10(tracked: Tracked, drives: Actuators, rows: Sequence[int]) -> Metrics:
    """Metrics of the load torque by Eq. 10 from the motor torque of the joints in `rows`, which have these drives."""
    at = list(rows)
    return measure([(p.t, np.array(drives.load_from_motor(p.dq[at], p.ddq[at], p.tau_motor[at])[0])) for p in tracked.phases])


def reference_phases(
    design: CoDesign, motion: SampledMotion, theta: np.ndarray, calibrated: CalibratedModel
) -> list[Reference]:
    """The phases of an optimum, with the motor torque [Nm] that the calibrated model predicts as feed-forward."""
    arms = [_calibrated_arm(design, calibrated, design.engaged(i, theta)) for i in range(len(PHASES))]
    like = arms[0]
    return motion.references(
        design.task, [arm.theta for arm in arms], lambda phase, _, own: replace(like, theta=own).torques(phase)[0]
    )


def _calibrated_arm(design: CoDesign, calibrated: CalibratedModel, theta: np.ndarray) -> Physics:
    """The calibrated robot with the design's springs and with the calibrated terms but those that scale the recorded springs."""
    springs = [s.effect for s in design.springs if not s.known]  # known effects are among the terms
    terms = [t for t in calibrated.terms if "springs" not in t.effect.inputs and not isinstance(t.effect, OnlyRecorded)]
    model = Model(calibrated.robot, calibrated.tool, (*springs, *(term.effect for term in terms)))
    own = theta[: sum(len(e.parameters) for e in springs)]
    widths = [e.width.nominal for e in springs if e.width is not None] + [t.width for t in terms if t.width is not None]
    return Physics(model, np.concatenate([own, *(t.values for t in terms)]), np.array(widths), model.robot.inertial)
