"""A model: a robot with effects. One symbolic definition for optimal control, simulation and identification."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import casadi as ca
import numpy as np

from rrr_oc.effects import Body, BodyChange, Effect, OnlyRecorded, Signals
from rrr_oc.errors import UserError
from rrr_oc.model.parameters import by_effect
from rrr_oc.robot.parameters import Parameter
from rrr_oc.robot.rigid_body import RigidBody, rigid_body, with_payload
from rrr_oc.robot.robot import Robot, ToolPoint

CHAIN = ("q", "dq", "ddq", "time", "payload", "theta", "widths", "inertial")  # arguments of `Model.motor_inverse`


@dataclass(frozen=True)
class Model:
    """A robot, where it holds its payload, and the effects at work in it.

    The parameters of all effects are one vector `theta`, effect by effect; `widths` has one smoothing width for each effect that
    declares one.
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

    def tool_height(self, q):
        """Height of the tool against gravity, from the base [m]; `q` (n,) and the result are casadi's or numbers."""
        return self.body.tool_height(q, self.tool, self.robot.gravity)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Parameters of all effects, in the order of `theta`."""
        return tuple(p for effect in self.effects for p in effect.parameters)

    @property
    def widths(self) -> np.ndarray:
        """Nominal smoothing widths, one for each effect that has one."""
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
        pairs = [(label, p) for label, effect in zip(labels, self.effects, strict=True) for p in effect.parameters]
        return np.array([values.get(label, {}).get(p.name, p.nominal) for label, p in pairs])

    def values(self, theta: Sequence[float] | np.ndarray) -> dict[str, dict[str, float]]:
        """The parameters by label and name; the inverse of `theta`."""
        return {self.label(effect): named for effect, named in by_effect(self.effects, np.asarray(theta, float).tolist())}

    def effect_torques(self, signals: Signals, theta: ca.SX, widths: ca.SX) -> list[ca.SX]:
        """Torque of each effect on all joints [Nm], each (n,); `signals` must hold what the effects depend on."""
        return [self._on_joints(*one) for one in self.with_signals(signals, theta, widths)]

    def side_torque(self, side: str, signals: Signals, theta: ca.SX, widths: ca.SX) -> ca.SX:
        """Torque of all effects that act on one side, of `effects.base.SIDES`, on all joints (n,) [Nm]."""
        torques = [self._on_joints(*one) for one in self.with_signals(signals, theta, widths) if one[0].side == side]
        return sum(torques, ca.SX.zeros(self.robot.n))

    @cached_property
    def inverse(self) -> ca.Function:
        """(q, dq, ddq, payload, theta, widths) -> (tau_load, tau_spring), each (n,) [Nm].

        Eq. 6: tau_load = M ddq + C dq + G − tau_spring, where tau_spring sums the effects that act on the links.
        """
        q, dq, ddq, payload, theta, widths = self._symbols("q", "dq", "ddq")
        inertial, gravity = self.rigid(self.robot.inertial, payload, theta, widths)
        total = self.body.inverse_dynamics(q, dq, ddq, inertial, gravity)
        spring = self.side_torque("link", Signals(q, dq, ddq, payload=payload), theta, widths)
        return ca.Function("inverse", [q, dq, ddq, payload, theta, widths], [total - spring, spring])

    @cached_property
    def motor_inverse(self) -> ca.Function:
        """(q, dq, ddq, time, payload, theta, widths, inertial) -> (tau_motor, tau_load), each (n,) [Nm].

        Eq. 6, tau_load = M ddq + C dq + G − (torque of the effects on the links); then tau_motor = tau_load − (torque of the effects
        in the drives), which may depend on tau_load. `inertial` (10, n) excludes the payload; `time` [s] is since the motion's start.
        """
        arguments, motor, load = self._motor_chain()
        return ca.Function("motor_inverse", arguments, [motor, load], list(CHAIN), ["tau_motor", "tau_load"])

    @cached_property
    def drive_torque(self) -> ca.Function:
        """(q, dq, ddq, time, payload, theta, widths, tau_load, states) -> torque of the effects in the drives (n,) [Nm]."""
        q, dq, ddq, payload, theta, widths = self._symbols("q", "dq", "ddq")
        time, load, states = ca.SX.sym("time"), ca.SX.sym("tau_load", self.robot.n), ca.SX.sym("states", len(self.states))
        signals = Signals(q, dq, ddq, load=load, time=time, payload=payload, states=states)
        torque = ca.densify(self.side_torque("drive", signals, theta, widths))
        return ca.Function("drive_torque", [q, dq, ddq, time, payload, theta, widths, load, states], [torque])

    def sensitivity(self, signal: Literal["motor", "load"], by: Literal["theta", "inertial", "widths"]) -> ca.Function:
        """Arguments of `motor_inverse` -> d tau_signal / d by, exact: (n, number of parameters), (n, 10 n), link by link, or (n, number of
        widths).

        Called on (n, K) arrays it returns the K Jacobians side by side.
        """
        if (signal, by) not in self._sensitivities:
            arguments, motor, load = self._motor_chain()
            jacobian = ca.jacobian({"motor": motor, "load": load}[signal], arguments[CHAIN.index(by)])
            name, dense = f"{signal}_by_{by}", ca.densify(jacobian)
            self._sensitivities[signal, by] = ca.Function(name, arguments, [dense], list(CHAIN), ["jacobian"])
        return self._sensitivities[signal, by]

    @cached_property
    def load_partials(self) -> ca.Function:
        """(q, dq, ddq, carried, gravity, theta, widths) -> load torque and its derivatives by the first five, exact.

        `carried` (10, n) holds the links with their payload, as `rigid` gives it. Called on (n, K) arrays, with `carried` repeated
        K times, it returns each derivative's K Jacobians side by side.
        """
        q, dq, ddq, _, theta, widths = self._symbols("q", "dq", "ddq")
        carried, gravity = ca.SX.sym("carried", 10, self.robot.n), ca.SX.sym("gravity", 3)
        load = self.body.inverse_dynamics(q, dq, ddq, carried, gravity)
        load -= self.side_torque("link", Signals(q, dq, ddq), theta, widths)
        by = [ca.densify(ca.jacobian(load, x)) for x in (q, dq, ddq, carried, gravity)]
        return ca.Function("load_partials", [q, dq, ddq, carried, gravity, theta, widths], [load, *by])

    @cached_property
    def _sensitivities(self) -> dict[tuple[str, str], ca.Function]:
        return {}

    @cached_property
    def forward(self) -> ca.Function:
        """(q, dq, tau_load, payload, theta, widths) -> ddq (n,) [rad/s²], the inverse of `inverse` in its third argument."""
        q, dq, tau, payload, theta, widths = self._symbols("q", "dq", "tau")
        inertial, gravity = self.rigid(self.robot.inertial, payload, theta, widths)
        spring = self.side_torque("link", Signals(q, dq, payload=payload), theta, widths)
        ddq = self.body.forward_dynamics(q, dq, tau + spring, inertial, gravity)
        return ca.Function("forward", [q, dq, tau, payload, theta, widths], [ddq])

    @cached_property
    def energy(self) -> ca.Function:
        """(q, dq, payload, theta, widths) -> (kinetic, potential, stored by effects) [J]; potential is zero at the base."""
        q, dq, _, payload, theta, widths = self._symbols("q", "dq", "unused")
        inertial, gravity = self.rigid(self.robot.inertial, payload, theta, widths)
        kinetic = dq.T @ self.body.mass_matrix(q, inertial) @ dq / 2
        frames, potential = self.body.joint_frames(q), ca.SX(0)
        for i in range(self.robot.n):
            rotation, origin = ca.reshape(frames[:9, i], 3, 3), frames[9:, i]
            potential -= ca.dot(gravity, inertial[0, i] * origin + rotation @ inertial[1:4, i])
        signals = Signals(q, dq, payload=payload)
        stored = sum((e.energy(signals, named, width) for e, named, width in self._unpacked(theta, widths)), ca.SX(0))
        return ca.Function("energy", [q, dq, payload, theta, widths], [kinetic, potential, stored])

    @cached_property
    def recorded_inverse(self) -> ca.Function:
        """As `motor_inverse`, with two more arguments: shift (3 n,) and states.

        `shift` is the motion of the links less that of the drives: positions, speeds, accelerations, one below the other; `states`
        are those of all effects, in their order.
        """
        arguments, motor, load = self._motor_chain(moved=True)
        return ca.Function("recorded_inverse", arguments, [motor, load], [*CHAIN, "shift", "states"], ["tau_motor", "tau_load"])

    @cached_property
    def recorded_load(self) -> ca.Function:
        """Arguments of `recorded_inverse` -> tau_load alone, which is quicker."""
        arguments, _, load = self._motor_chain(moved=True)
        return ca.Function("recorded_load", arguments, [load], [*CHAIN, "shift", "states"], ["tau_load"])

    def rigid(self, inertial, payload, theta, widths, without: type[Effect] | tuple[()] = ()) -> tuple[ca.SX, ca.SX]:
        """Inertial parameters with payload (10, n) and gravity (3,), with the changes by effects of the side "body".

        `without`: A kind of these effects that is left out.
        """
        body = Body(ca.SX(inertial), ca.SX(self.robot.gravity), payload, list(self.tool.position))
        for effect, named, _ in self._unpacked(theta, widths):
            if isinstance(effect, BodyChange) and not isinstance(effect, without):
                body = effect.change(body, named)
        gravity = ca.vertcat(*body.gravity) if isinstance(body.gravity, list) else body.gravity
        return with_payload(body.inertial, self.tool.joint, body.payload, body.position), gravity

    @property
    def states(self) -> tuple[Parameter, ...]:
        """Internal states of all effects."""
        return tuple(p for effect in self.effects for p in effect.states)

    def _motor_chain(self, moved: bool = False) -> tuple[list[ca.SX], ca.SX, ca.SX]:
        """Arguments in the order of `CHAIN` (and shift and states), motor torque and load torque."""
        n = self.robot.n
        q, dq, ddq, payload, theta, widths = self._symbols("q", "dq", "ddq")
        time, inertial = ca.SX.sym("time"), ca.SX.sym("inertial", 10, n)
        shift, states = ca.SX.sym("shift", 3 * n), ca.SX.sym("states", len(self.states))
        carried, gravity = self.rigid(inertial, payload, theta, widths)
        signals = Signals(q, dq, ddq, time=time, payload=payload, states=states if moved else None)
        arguments, links = [q, dq, ddq, time, payload, theta, widths, inertial], signals
        if moved:
            arguments += [shift, states]
            links = replace(signals, q=q + shift[:n], dq=dq + shift[n : 2 * n], ddq=ddq + shift[2 * n :])
        load = self.body.inverse_dynamics(links.q, links.dq, links.ddq, carried, gravity)
        load -= self.side_torque("link", links, theta, widths)
        felt = load  # by the drives, whatever of it is recorded
        if any(isinstance(effect, OnlyRecorded) for effect in self.effects):
            whole = self.body.inverse_dynamics(
                links.q, links.dq, links.ddq, *self.rigid(inertial, payload, theta, widths, OnlyRecorded)
            )
            felt = load + whole - self.body.inverse_dynamics(links.q, links.dq, links.ddq, carried, gravity)
        motor = load - self.side_torque("drive", replace(signals, load=felt), theta, widths)
        return arguments, motor, load

    def with_signals(self, signals: Signals, theta, widths):
        """(effect, signals that it may depend on, its parameters by name, its width) for each effect.

        To `signals` are added its own states, the plain friction, the rotors' inertia and the listed springs by their joints; of
        several springs on the same joints the first counts.
        """
        unpacked = list(self._unpacked(theta, widths))
        springs = {e.joints: (e, named, width) for e, named, width in reversed(unpacked) if e.provides == "springs"}
        signals, state = replace(signals, springs=springs), 0
        friction, rotor = ca.SX.zeros(self.robot.n), ca.SX.zeros(self.robot.n)
        for e, named, width in unpacked:
            if e.provides == "friction" and not e.states and signals.dq is not None:
                friction += self._on_joints(e, signals, named, width)
            if e.provides == "rotor" and signals.ddq is not None:
                rotor += self._on_joints(e, signals, named, width)
        for e, named, width in unpacked:
            own = None if signals.states is None else signals.states[state : state + len(e.states)]
            state += len(e.states)
            yield e, replace(signals, states=own, friction=friction, rotor=rotor), named, width

    def _on_joints(self, effect: Effect, signals: Signals, named, width) -> ca.SX:
        torque = ca.SX.zeros(self.robot.n)
        for joint, value in zip(effect.on(self.robot.n), effect.torque(signals, named, width), strict=True):
            torque[joint] += value
        return torque

    def _unpacked(self, theta, widths):
        w = 0
        for effect, named in by_effect(self.effects, theta):
            yield effect, named, widths[w] if effect.width is not None else None
            w += effect.width is not None

    def _symbols(self, *names: str) -> tuple[ca.SX, ...]:
        vectors = [ca.SX.sym(name, self.robot.n) for name in names]
        theta = ca.SX.sym("theta", len(self.parameters))
        return *vectors, ca.SX.sym("payload"), theta, ca.SX.sym("widths", len(self.widths))
