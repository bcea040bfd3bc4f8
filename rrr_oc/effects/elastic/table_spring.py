"""Spring across one joint whose torque is a table, for co-designs."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from rrr_oc.effects.design_form import DesignForm, Quantity, angle
from rrr_oc.effects.springs import DesignSpring, LinkSpring
from rrr_oc.errors import UserError
from rrr_oc.numerics.cubic_spline import natural_spline
from rrr_oc.robot.parameters import Parameter

ROWS = (3, 200)  # least and greatest number; a table of more rows makes every evaluation of the dynamics slower
HARDENING = ((-90.0, -4.0), (-45.0, -1.25), (0.0, 0.0), (45.0, 1.25), (90.0, 4.0))
MOUNTINGS = ("as listed", "mirrored")


@dataclass(frozen=True)
class TableSpring(LinkSpring, DesignSpring):
    """A spring as its maker or a test bench describes it: the torque f(x) that holds it at an angle x from its equilibrium.

    tau = −number f(q − equilibrium), or number f(equilibrium − q) where it is mounted the other way round. `number` is how many springs
    act in parallel, or a scale.

    f is the natural cubic spline through the rows of the table; beyond the first and last row the stiffness stays what it is there.
    So torque and stiffness are continuous, and the stored energy is the integral of the spline. A spline overshoots beside a kink;
    there the rows must be close.
    """

    name = "table_spring"
    equation = "tau = -number f(q - equilibrium), f through the rows of a table"
    plain = "{number} springs as listed in a table pull {joints} towards {equilibrium:deg}."
    parameters = (Parameter("number", "1", 1.0, lower=0.0), Parameter("equilibrium", "rad"))
    amplitudes = ("number",)
    role = "design"
    options = {"mounting": MOUNTINGS}  # noqa: RUF012
    design = DesignForm(
        "NPEA",
        "springs across one joint as a table lists them",
        (Quantity("n_n", "number", "1", lowest=0.0), angle("q_n", "equilibrium_deg")),
        tables={"table_deg_Nm": ("angle_deg", "torque_Nm")},
    )

    mounting: Literal["as listed", "mirrored"] = "as listed"
    table_deg_Nm: tuple[tuple[float, float], ...] = HARDENING

    def __post_init__(self) -> None:
        super().__post_init__()
        rows = np.array(self.table_deg_Nm, float).reshape(-1, 2)
        if not ROWS[0] <= len(rows) <= ROWS[1]:
            raise UserError(f"table_deg_Nm has {len(rows)} rows; {ROWS[0]} to {ROWS[1]} are required")
        endless = np.any(~np.isfinite(rows), axis=1)
        if np.any(endless):
            raise UserError(f"table_deg_Nm: row {_first(endless)} has no finite numbers")
        falls = np.diff(rows[:, 0]) <= 0
        if np.any(falls):
            at = _first(falls) + 1
            raise UserError(
                f"table_deg_Nm: row {at} has the angle {rows[at - 1, 0]:g}° after {rows[at - 2, 0]:g}°; angles must ascend"
            )
        if [0.0, 0.0] not in rows.tolist():
            raise UserError("table_deg_Nm has no row [0, 0]; angles are from the equilibrium, where the spring has no torque")

    @property
    def _sign(self) -> int:
        return 1 if self.mounting == "as listed" else -1

    @property
    def _spline(self):
        return natural_spline(tuple((float(np.radians(angle)), torque) for angle, torque in self.table_deg_Nm))

    def _angle(self, signals, theta):
        return self._sign * (signals.q[self.joints[0]] - theta["equilibrium"])

    def torque(self, signals, theta, width):
        return (-self._sign * theta["number"] * self._spline.value(self._angle(signals, theta)),)

    def energy(self, signals, theta, width):
        spline = self._spline
        return theta["number"] * (spline.integral(self._angle(signals, theta)) - spline.integral(0.0))

    def known_range(self, theta):
        ends = sorted(theta["equilibrium"] + self._sign * np.radians(self.table_deg_Nm[i][0]) for i in (0, -1))
        return ends[0], ends[1]


def _first(wrong: np.ndarray) -> int:
    """Number of the first row, from 1, where something is wrong."""
    return int(np.argmax(wrong)) + 1
