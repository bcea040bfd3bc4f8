"""A model: a robot with effects. One symbolic definition for optimal control, simulation and identification."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import casadi as ca
import numpy as np

from rrr_oc.effects import Effect, Signals
from rrr_oc.errors import UserError
from rrr_oc.parameters import Parameter
from rrr_oc.rigid_body import RigidBody, rigid_body, with_payload
from rrr_oc.robot import Robot, ToolPoint

CHAIN = ("q", "dq", "ddq", "time", "payload", "theta", "widths", "inertial")  # arguments of `Model.motor_inverse`


@dataclass(frozen=True)
class Model:
    """A robot, where it holds its payload, and the effects at work in it.

    The parameters of all effects stand in one vector `theta`, effect by effect; `widths` holds one smoothing width an
    effect that has one.
    """

    robot: Robot
    tool: ToolPoint
    effects: tuple[Effect, ...] = ()

    def __post_init__(self) -> None:
        for effect in self.effects:
            if any(not 0 <= j < self.robot.n for j in effect.joints):
                raise UserError(
                    f"{effect.name} acts on joint {effect.joints}, but {self.robot.name!r} has {self.robot.n} joints"
                )

    @cached_property
    def body(self) -> RigidBody:
        """The rigid-body Functions of the robot."""
        return rigid_body(self.robot)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Parameters of all effects, in the order of `theta`."""
        return tuple(p for effect in self.effects for p in effect.parameters)

    @property
    def widths(self) -> np.ndarray:
        """Nominal smoothing widths, one an effect that has one."""
        return np.array([e.width.nominal for e in self.effects if e.width is not None])

    def label(self, effect: Effect) -> str:
        """Name of an effect with its joints, as in `parallel_spring[joint2]`."""
        return f"{effect.name}[{','.join(self.robot.joints[j] for j in effect.joints)}]"

    def theta(self, values: Mapping[str, Mapping[str, float]]) -> np.ndarray:
        """The vector of parameters from values by label and name; what is not named is nominal."""
        labels = [self.label(e) for e in self.effects]
        unknown = set(values) - set(labels)
        if unknown:
            raise UserError(f"the model has no effect {min(unknown)!r}; it has {', '.join(labels) or 'none'}")
        return np.array(
            [
                values.get(label, {}).get(p.name, p.nominal)
                for label, e in zip(labels, self.effects, strict=True)
                for p in e.parameters
            ]
        )

    def values(self, theta: Sequence[float] | np.ndarray) -> dict[str, dict[str, float]]:
        """The parameters by label and name; the inverse of `theta`."""
        numbers = iter(np.asarray(theta, float).tolist())
        return {self.label(e): {p.name: next(numbers) for p in e.parameters} for e in self.effects}

    def effect_torques(self, signals: Signals, theta: ca.SX, widths: ca.SX) -> list[ca.SX]:
        """For each effect its torque on all joints [Nm], each (n,); `signals` must hold what the effects depend on."""
        return [self._on_joints(e, signals, named, width) for e, named, width in self._unpacked(theta, widths)]

    def side_torque(self, side: str, signals: Signals, theta: ca.SX, widths: ca.SX) -> ca.SX:
        """Torque of all effects that act on one side, of `effects.effect.SIDES`, on all joints (n,) [Nm]."""
        torques = [
            self._on_joints(e, signals, named, width) for e, named, width in self._unpacked(theta, widths) if e.side == side
        ]
        return sum(torques, ca.SX.zeros(self.robot.n))

    def stored_energy(self, signals: Signals, theta: ca.SX, widths: ca.SX) -> ca.SX:
        """Energy stored by all effects [J]."""
        return sum((e.energy(signals, named, width) for e, named, width in self._unpacked(theta, widths)), ca.SX(0))

    @cached_property
    def inverse(self) -> ca.Function:
        """(q, dq, ddq, payload, theta, widths) -> (tau_load, tau_spring), each (n,) [Nm].

        Eq. 6: tau_load = M ddq + C dq + G − tau_spring, where tau_spring sums the effects that act on the links.
        """
        q, dq, ddq, payload, theta, widths = self._symbols("q", "dq", "ddq")
        inertial = with_payload(self.robot.inertial, self.tool.joint, payload, self.tool.position)
        total = self.body.inverse_dynamics(q, dq, ddq, inertial, self.robot.gravity)
        spring = self.side_torque("link", Signals(q, dq, ddq, payload=payload), theta, widths)
        return ca.Function("inverse", [q, dq, ddq, payload, theta, widths], [total - spring, spring])

    @cached_property
    def motor_inverse(self) -> ca.Function:
        """(q, dq, ddq, time, payload, theta, widths, inertial) -> (tau_motor, tau_load), each (n,) [Nm].

        On the way from the motion to the motor: Eq. 6, tau_load = M ddq + C dq + G − (torque of the effects on the links); then
        tau_motor = tau_load − (torque of the effects in the drives), which may depend on tau_load. `inertial` is (10, n), without
        payload; `time` [s] is since the start of the motion. Call it on whole (n, K) arrays.
        """
        arguments, motor, load = self._motor_chain()
        return ca.Function("motor_inverse", arguments, [motor, load], list(CHAIN), ["tau_motor", "tau_load"])

    def sensitivity(self, signal: Literal["motor", "load"], by: Literal["theta", "inertial"]) -> ca.Function:
        """Arguments of `motor_inverse` -> d tau_signal / d by, exact: (n, number of parameters) or (n, 10 n), link by link.

        Called on (n, K) arrays it returns the K Jacobians side by side.
        """
        if (signal, by) not in self._sensitivities:
            arguments, motor, load = self._motor_chain()
            jacobian = ca.jacobian({"motor": motor, "load": load}[signal], arguments[CHAIN.index(by)])
            self._sensitivities[signal, by] = ca.Function(
                f"{signal}_by_{by}", arguments, [ca.densify(jacobian)], list(CHAIN), ["jacobian"]
            )
        return self._sensitivities[signal, by]

    @cached_property
    def _sensitivities(self) -> dict[tuple[str, str], ca.Function]:
        return {}

    @cached_property
    def forward(self) -> ca.Function:
        """(q, dq, tau_load, payload, theta, widths) -> ddq (n,) [rad/s²], the inverse of `inverse` in its third argument."""
        q, dq, tau, payload, theta, widths = self._symbols("q", "dq", "tau")
        inertial = with_payload(self.robot.inertial, self.tool.joint, payload, self.tool.position)
        spring = self.side_torque("link", Signals(q, dq, payload=payload), theta, widths)
        ddq = self.body.forward_dynamics(q, dq, tau + spring, inertial, self.robot.gravity)
        return ca.Function("forward", [q, dq, tau, payload, theta, widths], [ddq])

    @cached_property
    def energy(self) -> ca.Function:
        """(q, dq, payload, theta, widths) -> (kinetic, potential, stored by effects) [J]; potential is zero at the base."""
        q, dq, _, payload, theta, widths = self._symbols("q", "dq", "unused")
        robot = self.robot
        inertial = with_payload(robot.inertial, self.tool.joint, payload, self.tool.position)
        kinetic = dq.T @ self.body.mass_matrix(q, inertial) @ dq / 2
        frames = self.body.joint_frames(q)
        potential = ca.SX(0)
        for i in range(robot.n):
            rotation, origin = ca.reshape(frames[:9, i], 3, 3), frames[9:, i]
            potential -= ca.dot(ca.SX(robot.gravity), inertial[0, i] * origin + rotation @ inertial[1:4, i])
        stored = self.stored_energy(Signals(q, dq, payload=payload), theta, widths)
        return ca.Function("energy", [q, dq, payload, theta, widths], [kinetic, potential, stored])

    def _motor_chain(self) -> tuple[list[ca.SX], ca.SX, ca.SX]:
        """Arguments in the order of `CHAIN`, motor torque and load torque."""
        q, dq, ddq, payload, theta, widths = self._symbols("q", "dq", "ddq")
        time, inertial = ca.SX.sym("time"), ca.SX.sym("inertial", 10, self.robot.n)
        carried = with_payload(inertial, self.tool.joint, payload, self.tool.position)
        signals = Signals(q, dq, ddq, time=time, payload=payload)
        load = self.body.inverse_dynamics(q, dq, ddq, carried, self.robot.gravity)
        load -= self.side_torque("link", signals, theta, widths)
        motor = load - self.side_torque("drive", replace(signals, load=load), theta, widths)
        return [q, dq, ddq, time, payload, theta, widths, inertial], motor, load

    def _on_joints(self, effect: Effect, signals: Signals, named, width) -> ca.SX:
        torque = ca.SX.zeros(self.robot.n)
        for joint, value in zip(effect.joints, effect.torque(signals, named, width), strict=True):
            torque[joint] += value
        return torque

    def _unpacked(self, theta, widths):
        i = w = 0
        for effect in self.effects:
            named = {p.name: theta[i + k] for k, p in enumerate(effect.parameters)}
            yield effect, named, widths[w] if effect.width is not None else None
            i, w = i + len(effect.parameters), w + (effect.width is not None)

    def _symbols(self, *names: str) -> tuple[ca.SX, ...]:
        vectors = [ca.SX.sym(name, self.robot.n) for name in names]
        theta = ca.SX.sym("theta", len(self.parameters))
        return *vectors, ca.SX.sym("payload"), theta, ca.SX.sym("widths", len(self.widths))
