"""Electrical servo drives: current, load torque and energy (Eq. 7–11)."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated

import casadi as ca
import msgspec
import numpy as np
from msgspec import Meta

from rrr_oc.errors import UserError
from rrr_oc.numerics.smooth import ramp
from rrr_oc.schema import NonNegative, Positive, Schema, Share, read_preset

STEEPNESS = 20.0  # [s/rad], of tanh in place of the sign, as in the authors' code
LOAD_WIDTH = 0.05  # [Nm] within which |tau_l| is rounded; doubled, friction at small loads is smoother and larger


class Drive(Schema, frozen=True):
    """A joint's drive in an actuator file, with the coefficients of `Actuators` in their order.

    Attributes:
        torque_constant_Nm_per_A: Motor torque at the joint's output by current.
        c_0_A: Dry friction.
        viscous_A_s_per_rad: Viscous friction, nu of Eq. 9.
        c_v2_A_s2_per_rad2: Friction with the square of speed.
        c_1_A_per_Nm: Current by load torque.
        c_12_A_per_Nm: Friction by load torque, less than c_1 in magnitude.
        inertia_A_s2_per_rad: Inertia of rotor and gear, J_m of Eq. 7.
        resistance_Ohm: Of the windings; electrical energy needs it.
        regeneration: Share of the power flowing back from the drive that is kept; the rest is lost, as in a brake resistor.
    """

    torque_constant_Nm_per_A: Positive
    c_0_A: NonNegative
    viscous_A_s_per_rad: NonNegative
    c_v2_A_s2_per_rad2: float
    c_1_A_per_Nm: Positive
    c_12_A_per_Nm: float
    inertia_A_s2_per_rad: NonNegative
    resistance_Ohm: Positive = math.nan
    regeneration: Share = 1.0

    def __post_init__(self) -> None:
        if abs(self.c_12_A_per_Nm) >= self.c_1_A_per_Nm:  # Eq. 10 divides by c_1 ± c_12
            raise ValueError(f"c_12_A_per_Nm: found {self.c_12_A_per_Nm:g}; a magnitude below c_1_A_per_Nm is required")


class MotorAndGear(Schema, frozen=True):
    """A joint's motor and gear, all at the joint's output.

    Attributes:
        dry_Nm: Dry friction.
        viscous_Nm_s_per_rad: Viscous friction.
        inertia_kg_m2: Inertia of rotor and gear.
        efficiency: Share of the motor's power that the gear passes on to the load, or of the load's to the motor [1].
        torque_constant_Nm_per_A: Motor torque by current; electrical energy needs it.
        resistance_Ohm: Of the windings; electrical energy needs it.
    """

    dry_Nm: NonNegative = 0.0
    viscous_Nm_s_per_rad: NonNegative = 0.0
    inertia_kg_m2: NonNegative = 0.0
    efficiency: Annotated[float, Meta(gt=0, le=1, description="a number above 0, and up to 1, is required")] = 1.0
    torque_constant_Nm_per_A: Positive | None = None
    resistance_Ohm: Positive | None = None

    def __post_init__(self) -> None:
        if self.resistance_Ohm is not None and self.torque_constant_Nm_per_A is None:
            raise ValueError(
                "resistance_Ohm: a resistance needs torque_constant_Nm_per_A, by which currents follow from torques"
            )

    @property
    def drive(self) -> Drive:
        """The same in currents; where no torque constant is known, one of 1 Nm/A stands for it, and currents are torques.

        A load torque τ takes τ/η of the motor while it is driven and leaves η τ while it drives, with the efficiency η. That is
        c_1 τ + c_12 sgn(dq) |τ| with c_1 = (1/η + η)/2 and c_12 = (1/η − η)/2.
        """
        k, eta = self.torque_constant_Nm_per_A or 1.0, self.efficiency
        resistance = math.nan if self.resistance_Ohm is None else self.resistance_Ohm
        return Drive(
            torque_constant_Nm_per_A=k,
            c_0_A=self.dry_Nm / k,
            viscous_A_s_per_rad=self.viscous_Nm_s_per_rad / k,
            c_v2_A_s2_per_rad2=0.0,
            c_1_A_per_Nm=(1 / eta + eta) / 2 / k,
            c_12_A_per_Nm=(1 / eta - eta) / 2 / k,
            inertia_A_s2_per_rad=self.inertia_kg_m2 / k,
            resistance_Ohm=resistance,
        )


@dataclass(frozen=True, eq=False)
class Actuators:
    """The drives of some joints (m). Coefficients in amperes, at the joint's output, as their authors give them.

    Eq. 7 and 9: I = J ddq + nu dq + c_1 tau_l + sgn(dq) (c_0 + c_v2 dq² + c_12 |tau_l|).

    Eq. 9 prints c_12 sgn(dq) tau_l, which would drive the joint where tau_l < 0; that form is `form="printed"`. The
    dissipative |tau_l| is the default. With c_v2 < 0 the friction nu v + c_v2 v² would fall beyond its greatest value and turn
    negative; it is held constant from there on.

    Attributes:
        joints: Names (m).
        torque_constant: Motor torque at the output by current [Nm/A], (m,).
        c_0: [A]. viscous: nu [A s/rad]. c_v2: [A s²/rad²]. c_1, c_12: [A/Nm]. inertia: J_m [A s²/rad]. All (m,).
        resistance: Of the windings [Ω], (m,); NaN where unknown.
        regeneration: Share of the power flowing back from each drive that is kept [1], (m,).
        form: "dissipative" or "printed".
    """

    joints: tuple[str, ...]
    torque_constant: np.ndarray
    c_0: np.ndarray
    viscous: np.ndarray
    c_v2: np.ndarray
    c_1: np.ndarray
    c_12: np.ndarray
    inertia: np.ndarray
    resistance: np.ndarray
    regeneration: np.ndarray
    form: str = "dissipative"

    @property
    def reflected_inertia(self) -> np.ndarray:
        """Inertia of the drives at the joints [kg m²], (m,): `inertia` is in amperes per acceleration."""
        return self.inertia / self.c_1

    def current(self, dq, ddq, tau_load) -> ca.SX:
        """Currents I (m,) [A] that drive the load torque (Eq. 7 with Eq. 9)."""
        currents = []
        for i in range(len(self.joints)):
            t = tau_load[i]
            size = t if self.form == "printed" else ramp(t, LOAD_WIDTH) + ramp(-t, LOAD_WIDTH)
            by_load = self.c_1[i] * t, self.c_12[i] * (size * ca.tanh(STEEPNESS * dq[i]))
            currents.append(self.inertia[i] * ddq[i] + self._friction(i, dq[i]) + by_load[0] + by_load[1])
        return ca.vertcat(*currents)

    def load_torque(self, dq, ddq, current) -> ca.SX:
        """Load torque tau_l (m,) [Nm] from the currents (Eq. 10).

        In the dissipative form |tau_l| has the sign of what is left of the current, which decides between the two cases.
        """
        torques = []
        for i in range(len(self.joints)):
            left = current[i] - self.inertia[i] * ddq[i] - self._friction(i, dq[i])
            direction = ca.tanh(STEEPNESS * dq[i]) * (1 if self.form == "printed" else ca.sign(left))
            torques.append(left / (self.c_1[i] + self.c_12[i] * direction))
        return ca.vertcat(*torques)

    @cached_property
    def load_from_motor(self) -> ca.Function:
        """(dq, ddq, tau_motor) -> (tau_load, d tau_load / d tau_motor), each (m,), by Eq. 10; on numbers also (m, K)."""
        dq, ddq, motor = (ca.SX.sym(name, len(self.joints)) for name in ("dq", "ddq", "tau_motor"))
        load = self.load_torque(dq, ddq, motor / self.torque_constant)
        return ca.Function("load_from_motor", [dq, ddq, motor], [load, ca.diag(ca.jacobian(load, motor))])

    @cached_property
    def motor_from_load(self) -> ca.Function:
        """(dq, ddq, tau_load) -> `motor_torque` (m,); on numbers also (m, K)."""
        dq, ddq, load = (ca.SX.sym(name, len(self.joints)) for name in ("dq", "ddq", "tau_load"))
        return ca.Function("motor_from_load", [dq, ddq, load], [self.motor_torque(dq, ddq, load)])

    def motor_torque(self, dq, ddq, tau_load) -> ca.SX:
        """tau_a = k_t I (m,) [Nm]."""
        return ca.SX(self.torque_constant) * self.current(dq, ddq, tau_load)

    def power(self, dq, current, width) -> ca.SX:
        """Electrical power of each drive (m,) [W], R I² + k_t dq I (Eq. 8, whose integral is Eq. 11).

        What flows back counts as far as it is kept: max(P, 0) − regeneration · max(−P, 0). Each drive counts by itself: what one gives
        back, no other one draws.

        Args:
            width: Of the smooth ramp in the place of max [W]; 0 is exact.
        """
        self.check_resistance()
        flowing = ca.SX(self.resistance) * current**2 + ca.SX(self.torque_constant) * ca.SX(dq) * current
        drawn = ca.vertcat(*[ramp(one, width) for one in ca.vertsplit(flowing)])
        kept = ca.SX(self.regeneration)
        return kept * flowing + (1 - kept) * drawn  # because ramp(P) − ramp(−P) = P

    @cached_property
    def exact_power(self) -> ca.Function:
        """(dq, current) -> `power`, each (m,); on numbers also (m, K)."""
        dq, current = (ca.SX.sym(name, len(self.joints)) for name in ("dq", "current"))
        return ca.Function("exact_power", [dq, current], [self.power(dq, current, 0.0)])

    def check_resistance(self) -> None:
        """Raise `UserError` where a winding resistance, which electrical power needs, is unknown."""
        unknown = [j for j, r in zip(self.joints, self.resistance, strict=True) if not np.isfinite(r)]
        if unknown:
            raise UserError(f"electrical energy needs resistance_Ohm of {', '.join(unknown)} in the actuator file")

    def _friction(self, i: int, v) -> ca.SX:
        """Part that depends on speed alone [A]."""
        s = ca.tanh(STEEPNESS * v)
        speed = v * s  # |v|, smooth
        if self.c_v2[i] < 0:
            peak = -self.viscous[i] / (2 * self.c_v2[i])
            speed = peak - ramp(peak - speed, 0.05)  # 0.05 rad/s: width of the blend
        return s * (self.c_0[i] + self.viscous[i] * speed + self.c_v2[i] * speed**2)


def load_actuators(joints: Sequence[str], source: str = "prototype", form: str = "dissipative") -> Actuators:
    """The drives of these joints from a bundled file, or from the path of a JSON file of the same form; raises `UserError`."""
    if form not in ("dissipative", "printed"):
        raise UserError(f"the form of Eq. 9 is 'dissipative' or 'printed', got {form!r}")
    where, drives = read_preset("actuators", source, {"prototype": "actuators.json"}, dict[str, Drive])
    for joint in joints:
        if joint not in drives:
            raise UserError(f"{where}: no joint {joint!r}; there are {', '.join(drives)}")
    return actuators_of({joint: drives[joint] for joint in joints}, form)


def actuators_of(drives: Mapping[str, Drive], form: str = "dissipative") -> Actuators:
    """Drives by joint as the actuators of these joints."""
    rows = [msgspec.structs.astuple(drive) for drive in drives.values()]
    return Actuators(tuple(drives), *np.array(rows).T, form=form)
