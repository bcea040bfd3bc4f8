"""Optima on the arm with its drives: followed in MuJoCo under the paper's P control, or with the motor torque of a model fed forward."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, get_args

import numpy as np

from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.optimum import SampledMotion, start_of
from rrr_oc.codesign.task import PHASES
from rrr_oc.effects import Effect
from rrr_oc.errors import UserError
from rrr_oc.model.metrics import measure
from rrr_oc.model.motion import Motion
from rrr_oc.model.recorded_physics import Physics
from rrr_oc.model.symbolic_model import Model
from rrr_oc.numerics.along import along
from rrr_oc.robot.drives import Actuators
from rrr_oc.robot.parameters import Parameter
from rrr_oc.simulation.engine_model import Controller, Settings, controller
from rrr_oc.simulation.rollout import position
from rrr_oc.simulation.tracking import TrackedPhase, track

Control = Literal["P", "feed-forward"]
CONTROLS: tuple[Control, ...] = get_args(Control)
CYCLES = 2  # of which the last counts, when the start no longer shows; doubled, no figure changes


@dataclass(frozen=True)
class DriveFriction(Effect):
    """Friction of some joints' drives by Eq. 9, from the formula of `Actuators.current`, as torques: amperes divided by c_1.

    It is not in the catalogue, so that no diagnosis looks for it.

    Attributes:
        drives: Of the joints.
    """

    name = "drive_friction"
    equation = "tau = -factor (friction of Eq. 9) / c_1"
    parameters = (Parameter("factor", "1", 1.0, lower=0.0),)
    amplitudes = ("factor",)
    side = "drive"
    inputs = ("load",)
    placement = "many"

    drives: Actuators

    def torque(self, signals, theta, width):
        at, c_1 = list(self.joints), self.drives.c_1
        load, still = signals.load[at], np.zeros(len(at))
        current = self.drives.current(signals.dq[at], still, load)
        return tuple(-theta["factor"] * (current[i] / c_1[i] - load[i]) for i in range(len(at)))


@dataclass(frozen=True, eq=False)
class DrivenArm:
    """A design's arm with its springs, behind drives with the friction and inertia of Eq. 7 and 9.

    The motor torque here is what the drive passes on and what its friction and inertia take, so that the current is c_1 times it.

    Attributes:
        design: The design.
        parameters: Of its springs (np,).
        drives: Of the moving joints. The locked joints are held by controllers, without friction.
        payload, friction: Factors on the task's payload and on the friction [1].
    """

    design: CoDesign
    parameters: np.ndarray
    drives: Actuators
    payload: float = 1.0
    friction: float = 1.0

    @cached_property
    def physics(self) -> Physics:
        """The model with numbers; the inertia of the drives, which the engine has of its own, is left out."""
        task = self.design.task
        model = Model(task.robot, task.tool, (*self.design.model.effects, DriveFriction(task.moving, self.drives)))
        return Physics(model, np.r_[self.parameters, self.friction], model.widths, task.robot.inertial)

    @cached_property
    def armature(self) -> np.ndarray:
        """Inertia of the drives at the joints [kg m²], (n,)."""
        return self.design.task.full_rates(self.drives.reflected_inertia)

    @property
    def thetas(self) -> list[np.ndarray]:
        """Parameters of the model in each phase: of the springs, which a clutch may have let go, and of the friction."""
        return [np.r_[self.design.engaged(i, self.parameters), self.friction] for i in range(len(PHASES))]

    def motor_torque(self, motion: Motion, twist: np.ndarray, theta: np.ndarray) -> np.ndarray:
        """The torque that a motion of the task needs from the motors, springs and drives included (n, K) [Nm].

        Args:
            motion: Of the links, with the task's payload, to which `payload` is applied here.
            twist: q, dq, ddq of the links less those of their drives, (3, n, K).
            theta: Of `thetas`.
        """
        physics, drives = self.physics, replace(motion.of_drives(twist), payload=self.payload * motion.payload)
        known = theta, physics.widths, physics.inertial, twist.reshape(-1, len(motion.t)), np.zeros((0, len(motion.t)))
        return along(physics.model.recorded_inverse, *physics.inputs(drives), *known)[0] + self.armature[:, None] * drives.ddq

    def power(self, phase: TrackedPhase) -> np.ndarray:
        """Electrical power of the drives along a simulated motion, what flows back as far as it is kept (m, K) [W]."""
        rows = list(self.design.task.moving)
        current = self.drives.c_1[:, None] * phase.tau_motor[rows]
        return np.array(self.drives.exact_power((phase.dq - phase.twist[1])[rows], current))


@dataclass(frozen=True)
class Followed:
    """What an arm did in one cycle of a task.

    Attributes:
        E1: Load torque² over the moving joints, from the engine [N²m²s].
        energy: Electrical energy of their drives [J].
        rms_error: Root mean square of q − q_ref, over the moving joints and time [rad].
        end_error: Largest |q − q_ref| of a moving joint where a phase ends, at release or start [rad].
        saturated: Whether a controller reached its limit.
    """

    E1: float
    energy: float
    rms_error: float
    end_error: float
    saturated: bool


def p_control(design: CoDesign) -> Controller:
    """The paper's control: tau = k_p (q_ref − q), damped by the friction of the drives alone.

    Locked joints, which have no friction here, keep a derivative gain.
    """
    gains = controller(design.model)
    k_d = gains.k_d.copy()
    k_d[list(design.task.moving)] = 0.0
    return replace(gains, k_d=k_d)


def follow(arm: DrivenArm, motion: SampledMotion, control: Control, known: DrivenArm | None = None) -> Followed:
    """An optimum's motion, repeated by an arm under a control; what it did in the last cycle.

    Args:
        control: "P": `p_control`, which knows the position to be reached and nothing else. "feed-forward": the motor torque that the
            motion needs, with proportional and derivative feedback (`controller`).
        known: The arm as the control knows it, for the torque fed forward; None for the arm itself.

    Raises `UserError` for an unknown control, where no winding resistance is known, and as `track` does.
    """
    if control not in CONTROLS:
        raise UserError(f"control is {control!r}; allowed are {', '.join(CONTROLS)}")
    task, believed = arm.design.task, known or arm

    def forward(phase: Motion, twist: np.ndarray, theta: np.ndarray) -> np.ndarray:
        return np.zeros_like(phase.q) if control == "P" else believed.motor_torque(phase, twist, theta)

    planned = zip(motion.references(task, believed.thetas, forward), arm.thetas, strict=True)
    references = [replace(r, payload=arm.payload * r.payload, theta=theta) for r, theta in planned]
    gains = p_control(arm.design) if control == "P" else controller(arm.design.model)
    settings = Settings("native", start=start_of(arm.design), armature=arm.armature)
    physics = arm.physics
    tracked = track(physics.model, references * CYCLES, physics.theta, gains, settings, physics.widths)
    last, rows = tracked.phases[-len(PHASES) :], list(task.moving)
    errors = [(p.q - position(p.reference)(p.t))[rows] for p in last]
    squares = sum(np.trapezoid((e**2).mean(axis=0), p.t) for e, p in zip(errors, last, strict=True))
    return Followed(
        E1=measure([(p.t, p.tau_load[rows]) for p in last]).E1_total,
        energy=float(sum(np.trapezoid(arm.power(p).sum(axis=0), p.t) for p in last)),
        rms_error=float(np.sqrt(squares / sum(p.t[-1] - p.t[0] for p in last))),
        end_error=float(max(np.abs(e[:, -1]).max() for e in errors)),
        saturated=bool(np.any(tracked.saturated)),
    )
