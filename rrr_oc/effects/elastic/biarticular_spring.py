"""Spring across two joints, wound over pulleys (BPEA)."""

import math
from dataclasses import dataclass

import casadi as ca
import numpy as np

from rrr_oc.effects.base import Prior, Signals
from rrr_oc.effects.design_form import Axis, DesignForm, Quantity, angle
from rrr_oc.effects.springs import ListedSpring, Listing, Wound
from rrr_oc.errors import UserError
from rrr_oc.robot.parameters import Parameter

WIDER = 1.05  # factor by which the parameters' box is wider than the hardware allows, so that `exists` binds, not the box
NAMES = ("k_b", "q_0", "r_1", "r_2", "r_3")  # of Eq. 5, in the order of the quantities
RADII = ("radius1_m", "radius2_m", "radius3_m")  # keys in the header of a recording set
HARDWARE_LIMITS = (
    "r_3 at its largest, r_2 at its smallest",
    "r_3 at its smallest, r_2 at its largest",
    "k_b and r_2 at their largest, r_1 at its smallest",
    "k_b and r_3 at their largest, r_1 at its smallest",
    "q_0 and r_1 at their largest, r_2 at its smallest",
    "q_0 at its smallest, r_1 at its largest, r_2 at its smallest",
    "q_0 and r_1 at their largest, r_3 at its smallest",
    "q_0 at its smallest, r_1 at its largest, r_3 at its smallest",
    "k_b and q_0 at their largest",
    "k_b at its largest, q_0 at its smallest",
)


def reduced(k_b, q_0, r_1, r_2, r_3):
    """(kappa, rho, phi) of hardware: stiffness [Nm/rad], equilibrium [rad], radii [m] (any type with arithmetic)."""
    return k_b * (r_2 / r_1) ** 2, r_3 / r_2, r_1 * q_0 / r_2


def wound(ending: str = "") -> tuple[Quantity, ...]:
    """The quantities of Eq. 5, whose symbols have an ending."""
    radii = (Quantity(f"{r}{ending}", f"{r}_mm", "m", 1e-3) for r in NAMES[2:])
    return Quantity(f"k_b{ending}", "k_b_Nm_per_rad", "Nm/rad"), angle(f"q_0{ending}", "q_0_deg"), *radii


class BiarticularForm(DesignForm):
    """Five quantities of hardware, of which the effect's three parameters are functions (`reduced`); the spring has their names.

    Below they are called as in Eq. 5, whatever the symbols of the quantities are.
    """

    derived = True
    limits = HARDWARE_LIMITS

    def name(self, quantity, joints):
        return quantity.symbol

    def _called(self, numbers):
        """What stands by the quantities' symbols, by the names of Eq. 5; what is missing is left out."""
        return {name: numbers[q.symbol] for name, q in zip(NAMES, self.quantities, strict=True) if q.symbol in numbers}

    def _by_symbol(self, numbers):
        """The inverse of `_called`."""
        symbols = dict(zip(NAMES, (q.symbol for q in self.quantities), strict=True))
        return {symbols[name]: value for name, value in numbers.items()}

    def wrong(self, bounds):
        bounds = self._called(bounds)
        (k_low, k_high), (q_low, q_high) = bounds["k_b"], np.degrees(bounds["q_0"])
        if k_low != 0 or not k_high > 0:
            return f"k_b_Nm_per_rad must reach from 0 to above 0, got {k_low:g} … {k_high:g}"
        if not q_low < 0 < q_high:
            return f"q_0_deg must have a negative lower and a positive upper bound, got {q_low:g} … {q_high:g}"
        if min(bounds[r][0] for r in ("r_1", "r_2", "r_3")) <= 0:
            return "radii must be above 0 mm"
        return None

    def box(self, bounds):
        bounds = self._called(bounds)
        ratio = bounds["r_1"][1] / bounds["r_2"][0]
        kappa = bounds["k_b"][1] * (bounds["r_2"][1] / bounds["r_1"][0]) ** 2
        lower = [0.0, bounds["r_3"][0] / bounds["r_2"][1] / WIDER, bounds["q_0"][0] * ratio * WIDER]
        upper = [kappa * WIDER, bounds["r_3"][1] / bounds["r_2"][0] * WIDER, bounds["q_0"][1] * ratio * WIDER]
        return np.array(lower), np.array(upper)

    def parameters(self, numbers):
        return np.array(reduced(*numbers))

    def exists(self, theta, bounds):
        return hardware_exists(theta[0], theta[1], theta[2], self._called(bounds))

    def axis(self, hardware, joints):
        """The pulley of radius r_1, from which the cable goes on."""
        k_b, q_0, r_1, r_2, _ = (hardware[q.symbol] for q in self.quantities)
        return Axis(k_b, q_0, r_2 / r_1, r_1)

    def inverse_radii(self, theta, bounds, fixed):
        """1/r_2 with the largest r_2, where r_3 = rho r_2 and r_1 = phi r_2/q_0 are within their bounds, too."""
        if fixed:
            return (1 / self._called(fixed)["r_2"],)
        (q_low, q_high), r_1, r_2, r_3 = (self._called(bounds)[name] for name in ("q_0", "r_1", "r_2", "r_3"))
        return 1 / r_2[1], theta[1] / r_3[1], theta[2] / (q_high * r_1[1]), theta[2] / (q_low * r_1[1])

    def with_largest_pulleys(self, theta, bounds):
        r_2 = max(1 / max(self.inverse_radii(theta, bounds, {})), self._called(bounds)["r_2"][0])
        return {**bounds, **self._by_symbol({"r_2": (r_2, r_2)})}

    def strongest(self, lower, upper, bounds):
        """kappa = k_b / s² is greatest where s = r_1/r_2 is least: with r_2 at its largest, as far as phi = s q_0 allows."""
        bounds = self._called(bounds)
        (r1_low, r1_high), (r2_low, r2_high), (r3_low, r3_high) = (bounds[r] for r in ("r_1", "r_2", "r_3"))
        phi, q_0 = np.maximum(np.maximum(lower[2], -upper[2]), 0), np.where(lower[2] > 0, bounds["q_0"][1], -bounds["q_0"][0])
        largest, smallest = np.minimum(r2_high, r3_high / lower[1]), np.maximum(r2_low, r3_low / upper[1])
        least, most = np.maximum(r1_low / largest, phi / q_0), r1_high / smallest
        exists = (smallest <= r2_high) & (largest >= r2_low) & (least <= most)
        return np.where(exists, bounds["k_b"][1] / least**2, -1.0)

    def named(self, joints, theta, bounds, fixed):
        if fixed:
            held = self._called(fixed)
            return self._by_symbol({**held, "q_0": theta["phi"] * held["r_2"] / held["r_1"]})
        return self._by_symbol(pick_hardware(**theta, bounds=self._called(bounds))) if bounds else {}

    def held(self, joints, box, bounds, hardware, keep_free):
        """kappa and rho are fixed by k_b and the radii; q_0 free leaves phi free within its bounds."""
        if not bounds:
            return *box, {}
        bounds, keep_free, given = self._called(bounds), self._called(dict.fromkeys(keep_free)), self._called(hardware)
        fixed = {name: given[name] for name in NAMES if name != "q_0"}
        kappa, rho, phi = reduced(fixed["k_b"], given.get("q_0", 0.0), fixed["r_1"], fixed["r_2"], fixed["r_3"])
        ratio = fixed["r_1"] / fixed["r_2"]
        free = [b * ratio for b in bounds["q_0"]] if "q_0" in keep_free else [phi, phi]
        return np.array([kappa, rho, free[0]]), np.array([kappa, rho, free[1]]), self._by_symbol(fixed)


@dataclass(frozen=True)
class Biarticular(Wound):
    """The law of `BiarticularSpring`, which others with the same cable have.

    Attributes:
        winding: w_a and w_b, each 1 or −1.
        pulleys: r_1/r_2, by which phi follows the spring's own equilibrium q_0.
    """

    parameters = (Parameter("kappa", "Nm/rad", 10.0, lower=0.0), Parameter("rho", "1", 1.0, lower=0.0), Parameter("phi", "rad"))
    amplitudes = ("kappa",)
    width = Parameter("width", "rad", 1e-3, lower=0.0)
    placement = "pair"
    options = {"winding": (1, -1)}  # noqa: RUF012

    winding: tuple[int, int] = (1, 1)
    pulleys: float = 1.0

    def stretch(self, signals, theta):
        (a, b), (wa, wb) = self.joints, self.winding
        return -wa * signals.q[a] - wb * theta["rho"] * signals.q[b] - theta["phi"]

    def lever(self, theta):
        return self.winding[0], self.winding[1] * theta["rho"]

    def moved(self, theta, offset):
        return {**theta, "phi": theta["phi"] + self.pulleys * offset}


class BiarticularSpring(Biarticular, ListedSpring):
    """Unilateral spring and cable over pulleys at two joints (Eq. 5, Figure 3).

    Eq. 5 has five hardware parameters (k_b, q_0, r_1, r_2, r_3) but three degrees of freedom:
    kappa = k_b (r_2/r_1)², rho = r_3/r_2, phi = r_1 q_0 / r_2 give, with s = −w_a q_a − w_b rho q_b − phi,
    tau_a = w_a kappa s₊ and tau_b = w_b rho kappa s₊. The windings w = ±1 are the four arrangements of the cable;
    (1, 1) is the one that Eq. 5 prints.
    """

    name = "biarticular_spring"
    equation = "tau_a = w_a kappa max(s, 0), tau_b = w_b rho kappa max(s, 0), s = -w_a q_a - w_b rho q_b - phi, w = 1 or -1"
    plain = (
        "A spring that no recording lists acts across {joints}: {kappa} at {own}, with a lever of {rho} times that at "
        "{other}; it pulls while {own} {sign} {rho:bare} times {other} is {side} {slack:deg}, and is slack beyond."
    )
    prior = Prior(
        0.0005, {"kappa": (1.0, "torque")}, "as springs across one joint; across two they are rarer", where_springs=10.0
    )
    listing = Listing("bpea", ("stiffness_Nm_per_rad", "equilibrium_rad", *RADII), zero=RADII[2:])
    design = BiarticularForm(
        "BPEA",
        "a spring across two joints",
        wound(),
        shop="biarticular_spring",
    )

    @property
    def law(self):
        """With the signs that this winding has."""
        (a, b), terms = self.winding, {1: "-", -1: "+"}
        stretch = f"{terms[a]} q_a {terms[b]} rho q_b - phi".removeprefix("+ ").replace("- q_a", "-q_a")
        return f"tau_a = {'-' * (a < 0)}kappa max({stretch}, 0), tau_b = {'-' * (a != b)}rho tau_a"

    @classmethod
    def sentence(cls, joints, values):
        """s > 0 in words: w_a q_a + w_b rho q_b < −phi, divided by w_a."""
        a, b = values.get("winding", (1, 1))
        told = {"sign": "plus" if a == b else "minus", "side": "below" if a > 0 else "above"}
        return super().sentence(joints, {**values, **told, "slack": values["phi"] if a < 0 else -values["phi"]})

    @classmethod
    def from_entry(cls, joints, entry):
        """Raises `UserError` where the radii give no finite torque."""
        radii = [entry[key] for key in RADII]
        kappa, rho, phi = reduced(entry["stiffness_Nm_per_rad"], entry["equilibrium_rad"], *radii)
        if not all(math.isfinite(value) for value in (kappa, rho, phi)):
            raise UserError(f"radii {radii} m give no finite torque; check the unit")
        a, b = map(int, entry.get("winding", (1, 1)))
        return cls(joints, (a, b), pulleys=radii[0] / radii[1]), {"kappa": kappa, "rho": rho, "phi": phi}

    def entry(self, theta):
        """With r_2 = 1 m: Eq. 5 decides kappa, rho and phi only, and a change of q_0 the ratio r_1/r_2."""
        r = self.pulleys
        radii = dict(zip(RADII, (r, 1.0, theta["rho"]), strict=True))
        numbers = {"stiffness_Nm_per_rad": theta["kappa"] * r**2, "equilibrium_rad": theta["phi"] / r, **radii}
        return {**numbers, "winding": list(self.winding)}

    def scales(self, view, trial, prior=None):
        """The typical torque, on both joints as the geometric mean, is that at the recorded position that stretches the spring most."""
        number, unit = (prior or self.prior).typical["kappa"]
        theta, (a, b) = trial.points[0], self.joints
        stretch = float(np.max(self.stretch(Signals(view.positions), theta)))
        typical = math.sqrt(view.unit(unit, (a,)) * view.unit(unit, (b,)) / theta["rho"])
        return np.array([number * typical / max(stretch, 1e-3)])

    @classmethod
    def trials(cls, view):
        for a in range(view.n - 1):
            for winding in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
                for rho in (0.35, 0.6, 0.9, 1.3, 1.9):
                    stretch = -winding[0] * view.positions[a] - winding[1] * rho * view.positions[a + 1]
                    for share in (0.05, 0.25, 0.45, 0.65, 0.8, 0.92):
                        phi = float(np.quantile(stretch, share))
                        yield cls((a, a + 1), winding).trial(view, rho=rho, phi=phi)


def hardware_exists(kappa, rho, phi, bounds):
    """Inequalities ≤ 0 on (kappa, rho, phi) that hold exactly where hardware within bounds exists.

    With s = r_1/r_2, the radii allow s up to r_1max/a and down to r_1min/b, where a = max(r_2min, r_3min/rho) and
    b = min(r_2max, r_3max/rho) bound r_2; the spring needs s ≥ |phi|/|q_0|max and s ≤ sqrt(k_max/kappa). Each lower end
    of s against each upper end, and a ≤ b, written out so that every one is smooth and dimensionless.

    Args:
        bounds: `{"k_b": (0, k_max), "q_0": (q_min ≤ 0, q_max ≥ 0), "r_1": (lo, hi), "r_2": …, "r_3": …}`; values may be
            symbolic, so that multipliers turn into sensitivities to them.

    Returns:
        casadi column of 10 inequalities; `HARDWARE_LIMITS` says in words what each one runs into.
    """
    k_max = bounds["k_b"][1]
    (q_low, q_high), (r1_low, r1_high), (r2_low, r2_high), (r3_low, r3_high) = (bounds[k] for k in ("q_0", "r_1", "r_2", "r_3"))
    return ca.vertcat(
        rho * r2_low / r3_high - 1,
        1 - rho * r2_high / r3_low,
        kappa * r1_low**2 / (k_max * r2_high**2) - 1,
        kappa * rho**2 * r1_low**2 / (k_max * r3_high**2) - 1,
        phi * r2_low / (q_high * r1_high) - 1,
        phi * r2_low / (q_low * r1_high) - 1,
        (phi * r3_low / (q_high * r1_high) - rho) / 2,
        (phi * r3_low / (q_low * r1_high) - rho) / 2,
        kappa * ca.fmax(phi, 0) ** 2 / (k_max * q_high**2) - 1,
        kappa * ca.fmin(phi, 0) ** 2 / (k_max * q_low**2) - 1,
    )


def pick_hardware(kappa: float, rho: float, phi: float, bounds) -> dict[str, float]:
    """Hardware within bounds that gives (kappa, rho, phi): of all that do, radii in the middle of what is left open.

    Raises `UserError` where there is none (by more than a relative 1e-6, which solvers leave).
    """
    slack, k_max = 1 + 1e-6, bounds["k_b"][1]
    r2_low, r2_high = max(bounds["r_2"][0], bounds["r_3"][0] / rho), min(bounds["r_2"][1], bounds["r_3"][1] / rho)
    q_max = bounds["q_0"][1] if phi > 0 else -bounds["q_0"][0]
    ratio_low = max(bounds["r_1"][0] / r2_high, abs(phi) / q_max)
    ratio_high = min(bounds["r_1"][1] / r2_low, (k_max / kappa) ** 0.5 if kappa > 0 else float("inf"))
    if r2_low > r2_high * slack or ratio_low > ratio_high * slack:
        raise UserError(f"no hardware within bounds gives kappa = {kappa:g} Nm/rad, rho = {rho:g}, phi = {phi:g} rad")
    ratio = (ratio_low + min(ratio_high, 2 * ratio_low + 1)) / 2
    r2_low, r2_high = max(r2_low, bounds["r_1"][0] / ratio), min(r2_high, bounds["r_1"][1] / ratio)
    r_2 = (r2_low + r2_high) / 2
    return {"k_b": kappa * ratio**2, "q_0": phi / ratio, "r_1": ratio * r_2, "r_2": r_2, "r_3": rho * r_2}
