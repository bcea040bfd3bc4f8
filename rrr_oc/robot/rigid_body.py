"""Rigid-body dynamics as casadi Functions, made by Pinocchio's own algorithms on casadi.SX.

`pinocchio.casadi` serves where it can be imported (conda-forge); PyPI's wheel lacks it, and the extension `_rigid_body`,
built against the wheel's headers, runs the same algorithms on the same chain.
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache

import casadi as ca
import numpy as np

from rrr_oc.robot.robot import Robot, ToolPoint


@dataclass(frozen=True)
class RigidBody:
    """M, C, G of Eq. 1 and what follows from them, for a chain's kinematics.

    Every Function takes casadi or numpy arguments. `q`, `dq`, `ddq`, `tau` are (n,); `inertial` is (10, n) as in
    `Robot.inertial`; `gravity` is (3,) [m/s²].

    Attributes:
        mass_matrix: (q, inertial) -> M (n, n) [kg m²].
        coriolis_matrix: (q, dq, inertial) -> C (n, n) [kg m²/s], the one for which dM/dt - 2 C is skew.
        gravity_torque: (q, inertial, gravity) -> G (n,) [Nm].
        inverse_dynamics: (q, dq, ddq, inertial, gravity) -> M ddq + C dq + G (n,) [Nm].
        forward_dynamics: (q, dq, tau, inertial, gravity) -> ddq (n,) [rad/s²].
        joint_frames: q -> (12, n), each joint's rotation (column-major) and origin [m] in the base frame.
    """

    n: int
    mass_matrix: ca.Function
    coriolis_matrix: ca.Function
    gravity_torque: ca.Function
    inverse_dynamics: ca.Function
    forward_dynamics: ca.Function
    joint_frames: ca.Function

    @cached_property
    def tool_position(self) -> ca.Function:
        """(q, tool) -> position [m] of the point `tool` (3,) of the last joint's frame, in the base frame, (3,)."""
        q, tool = ca.SX.sym("q", self.n), ca.SX.sym("tool", 3)
        return ca.Function("tool_position", [q, tool], [self._point(q, tool, self.n - 1)], ["q", "tool"], ["position"])

    @cached_property
    def tool_jacobian(self) -> ca.Function:
        """(q, tool) -> d position / d q (3, n) [m/rad]."""
        q, tool = ca.SX.sym("q", self.n), ca.SX.sym("tool", 3)
        jacobian = ca.jacobian(self._point(q, tool, self.n - 1), q)
        return ca.Function("tool_jacobian", [q, tool], [jacobian], ["q", "tool"], ["jacobian"])

    def tool_height(self, q, tool: ToolPoint, gravity: np.ndarray):
        """Height of a point of a link against gravity, from the base [m]; `q` (n,) and the result are casadi's or numbers."""
        position = self._point(q, ca.DM(tool.position), tool.joint)
        return ca.dot(ca.DM(upwards(gravity)), position)

    def free_inertia(self, inertial: np.ndarray) -> np.ndarray:
        """Each joint's inertia at q = 0 with the other joints free, 1/(M⁻¹)_ii: the least there, (n,) [kg m²]."""
        return 1 / np.diag(np.linalg.inv(np.asarray(self.mass_matrix(np.zeros(self.n), inertial))))

    def _point(self, q, tool, joint: int):
        frame = self.joint_frames(q)[:, joint]
        return ca.reshape(frame[:9], 3, 3) @ tool + frame[9:]


def rigid_body(robot: Robot) -> RigidBody:
    """The chain's dynamics; inertial parameters, payload and gravity stay inputs of the Functions. Made once for each kinematics."""
    return _of_kinematics(robot.placements.tobytes(), robot.axes.tobytes())


@lru_cache(maxsize=64)
def _of_kinematics(placements: bytes, axes: bytes) -> RigidBody:
    chain = np.frombuffer(placements).reshape(-1, 4, 4), np.frombuffer(axes).reshape(-1, 3)
    try:
        import pinocchio.casadi as symbolic  # type: ignore[import-not-found]
    except ImportError:
        return RigidBody(len(chain[0]), **_from_extension(*chain))
    return RigidBody(len(chain[0]), **_from_pinocchio(*chain, symbolic))


def upwards(gravity: np.ndarray) -> np.ndarray:
    """Unit vector against gravity (3,); zeros without gravity."""
    return -gravity / max(float(np.linalg.norm(gravity)), 1e-12)


def with_payload(inertial, joint: int, mass, position):
    """Inertial parameters (10, n), numpy or casadi, with a point mass [kg] on one joint's link, at a position [m] in its frame.

    The result has the casadi type of the arguments.
    """
    x, y, z = position[0], position[1], position[2]
    point = ca.vertcat(1, x, y, z, y * y + z * z, -x * y, x * x + z * z, -x * z, -y * z, x * x + y * y)
    columns = ca.horzsplit(ca.SX(inertial) if isinstance(inertial, np.ndarray) else inertial)
    return ca.horzcat(*[c + mass * point if i == joint else c for i, c in enumerate(columns)])


def _from_extension(placements: np.ndarray, axes: np.ndarray) -> dict[str, ca.Function]:
    import rrr_oc.robot._rigid_body as extension

    texts = extension.chain_functions(placements[:, :3, :].reshape(-1).tolist(), axes.reshape(-1).tolist())
    return {name: ca.Function.deserialize(text) for name, text in texts.items()}


def _from_pinocchio(placements: np.ndarray, axes: np.ndarray, symbolic) -> dict[str, ca.Function]:
    """The same Functions from `pinocchio.casadi`, the twin of `_rigid_body.cpp`."""
    n = len(axes)
    symbols = {name: ca.SX.sym(name, n) for name in ("q", "dq", "ddq", "tau")}
    q, dq, ddq, tau = symbols.values()
    symbols |= {"inertial": ca.SX.sym("inertial", 10, n), "gravity": ca.SX.sym("gravity", 3)}
    model = symbolic.Model()
    for i in range(n):
        placement = symbolic.SE3(ca.SX(placements[i, :3, :3]), ca.SX(placements[i, :3, 3]))
        joint = symbolic.JointModelRevoluteUnaligned(ca.SX(axes[i]))
        model.addJoint(i, joint, placement, f"joint{i}")
        model.inertias[i + 1] = symbolic.Inertia.FromDynamicParameters(symbols["inertial"][:, i])
    model.gravity.linear = symbols["gravity"]
    data = model.createData()
    mass = symbolic.crba(model, data, q)
    mass = ca.triu(mass) + ca.triu(mass, False).T
    symbolic.forwardKinematics(model, data, q)
    frames = [ca.vertcat(ca.vec(data.oMi[i + 1].rotation), data.oMi[i + 1].translation) for i in range(n)]
    outputs = {
        "mass_matrix": ("q inertial", mass),
        "coriolis_matrix": ("q dq inertial", symbolic.computeCoriolisMatrix(model, model.createData(), q, dq)),
        "gravity_torque": ("q inertial gravity", symbolic.computeGeneralizedGravity(model, model.createData(), q)),
        "inverse_dynamics": ("q dq ddq inertial gravity", symbolic.rnea(model, model.createData(), q, dq, ddq)),
        "forward_dynamics": ("q dq tau inertial gravity", symbolic.aba(model, model.createData(), q, dq, tau)),
        "joint_frames": ("q", ca.horzcat(*frames)),
    }
    return {
        name: ca.Function(name, [symbols[key] for key in inputs.split()], [out], inputs.split(), ["out"])
        for name, (inputs, out) in outputs.items()
    }
