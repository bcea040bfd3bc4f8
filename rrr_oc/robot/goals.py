"""Where a tool is to be, as an equality of the joints' angles: a position and, where wanted, a direction."""

from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
from scipy.linalg import null_space

from rrr_oc.robot.rigid_body import RigidBody
from rrr_oc.robot.robot import ToolPoint

# [1] of the largest singular value, below which the joints cannot move the tool that way; doubled, nothing changes
STILL = 1e-9


@dataclass(frozen=True)
class Goal:
    """A place of the tool, and the direction that an axis of its link has there.

    Attributes:
        position: In the base frame [m].
        axis: Unit vector in the tool's link, or None where any direction will do.
        towards: Unit vector in the base frame.
        rows: Combinations of the errors that the moving joints can change, (k, 3) or (k, 5); empty until `reachable` finds them.
    """

    position: tuple[float, float, float]
    axis: tuple[float, float, float] | None = None
    towards: tuple[float, float, float] = (0.0, 0.0, 1.0)
    rows: tuple[tuple[float, ...], ...] = ()

    def pointing(self, body: RigidBody, tool: ToolPoint, q):
        """The axis in the base frame (3,), 0 without one; `q` (n,) and the result are casadi's or numbers."""
        return ca.reshape(body.joint_frames(q)[:9, tool.joint], 3, 3) @ ca.DM(self.axis or (0.0, 0.0, 0.0))

    def errors(self, body: RigidBody, tool: ToolPoint, q):
        """Error of the position [m] and, across `towards`, of the direction [1], (3,) or (5,), of a tool on the last link."""
        missed = body.tool_position(q, tool.position) - ca.DM(self.position)
        if self.axis is None:
            return missed
        return ca.vertcat(missed, ca.DM(null_space(np.array([self.towards])).T) @ self.pointing(body, tool, q))

    def equalities(self, body: RigidBody, tool: ToolPoint, q):
        """What is 0 where the tool is there, each independent of the others (k,)."""
        return ca.DM(np.array(self.rows)) @ self.errors(body, tool, q)

    def reachable(self, slopes: np.ndarray) -> "Goal":
        """The goal with its `rows`, from derivatives of the errors by the moving joints' angles in some postures, (postures, errors, m)."""
        ways, sizes, _ = np.linalg.svd(np.concatenate(list(slopes), axis=1), full_matrices=False)
        return replace(self, rows=tuple(map(tuple, ways.T[sizes > STILL * sizes[0]].tolist())))
