"""Inertial parameters of links: the identifiable combinations, physical consistency, and a prior."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Literal

import casadi as ca
import numpy as np

from rrr_oc.numerics.rank import independent_columns
from rrr_oc.robot.rigid_body import rigid_body
from rrr_oc.robot.robot import Robot
from rrr_oc.robot.urdf import LARGEST, possible

NAMES = ("m", "mx", "my", "mz", "Ixx", "Ixy", "Iyy", "Ixz", "Iyz", "Izz")  # the rows of `Robot.inertial`
UNITS = ("kg", *["kg m"] * 3, *["kg m²"] * 6)
ROUNDING = 1e-6  # of a combination of base parameters; doubled or halved, nothing changes
SMALLEST_LENGTH = 0.05  # [m], assumed of a link whose next joint lies at its own origin; doubled, its prior is twice as wide


@dataclass(frozen=True)
class BaseParameters:
    """The identifiable combinations of inertial parameters: beta = independent + mixing @ dependent.

    Attributes:
        independent, dependent: Indices into the 10 n inertial parameters, link by link.
        mixing: Coefficients of the dependent parameters, (independent, dependent).
        names: Of the combinations, such as "Izz[link2] + 0.16 m[link3]".
        units: Of the combinations.
    """

    independent: np.ndarray
    dependent: np.ndarray
    mixing: np.ndarray
    names: tuple[str, ...]
    units: tuple[str, ...]

    @property
    def projection(self) -> np.ndarray:
        """beta = projection @ (all 10 n inertial parameters)."""
        matrix = np.zeros((len(self.independent), len(self.independent) + len(self.dependent)))
        matrix[np.arange(len(self.independent)), self.independent] = 1.0
        matrix[:, self.dependent] = self.mixing
        return matrix


def base_parameters(robot: Robot) -> BaseParameters:
    """The base parameters of a chain under its gravity (Gautier & Khalil 1990), from QR of torques at random states.

    A column that depends on those before it is regrouped into them: outer links into those nearer to the base.
    """
    n, count, rng = robot.n, 40 * robot.n, np.random.default_rng(0)
    inertial = ca.SX.sym("inertial", 10, n)
    q, dq, ddq = (ca.SX.sym(name, n) for name in ("q", "dq", "ddq"))
    torque = rigid_body(robot).inverse_dynamics(q, dq, ddq, inertial, robot.gravity)
    regressor = ca.Function("regressor", [q, dq, ddq, inertial], [ca.densify(ca.jacobian(torque, inertial))])
    states = rng.uniform(-np.pi, np.pi, (n, count)), rng.normal(0, 2, (n, count)), rng.normal(0, 5, (n, count))
    body = np.tile(
        np.array([[1.0, 0, 0, 0, 1, 0, 1, 0, 0, 1]]).T, n
    )  # any body; the regressor's expression divides by the mass
    matrix = np.array(regressor(*states, body)).reshape(n * count, 10 * n)
    upper = np.asarray(np.linalg.qr(matrix / np.sqrt(n * count), mode="r"))
    chosen = independent_columns(upper)  # the diagonal of R alone is unreliable after a dependent column
    dependent = np.setdiff1d(np.arange(10 * n), chosen)
    mixing = np.linalg.lstsq(upper[:, chosen], upper[:, dependent], rcond=None)[0]
    mixing[np.abs(mixing) < 1e-9] = 0.0
    names = tuple(_name(robot, int(c), row, dependent) for c, row in zip(chosen, mixing, strict=True))
    return BaseParameters(chosen, dependent, mixing, names, tuple(UNITS[c % 10] for c in chosen))


def _name(robot: Robot, column: int, mixing: np.ndarray, dependent: np.ndarray) -> str:
    every = [f"{name}[{link}]" for link in robot.links for name in NAMES]
    result = every[column]
    for coefficient, other in zip(mixing, dependent, strict=True):
        if coefficient != 0:
            size = "" if abs(abs(coefficient) - 1) < 1e-9 else f"{abs(coefficient):.4g} "
            result += f" {'-' if coefficient < 0 else '+'} {size}{every[other]}"
    return result


@dataclass(frozen=True)
class Seen:
    """A quantity of what turns about a joint that torques see: a combination of base parameters.

    Attributes:
        joint: Number of the joint.
        quantity: "first_moment" [kg m] or "inertia" [kg m²].
        along: Unit vector in the joint's frame along which the first moment counts, or the joint's axis, (3,).
        row: It is row @ (all 10 n inertial parameters): the joint's own link, and what base parameters add of the outer ones.
    """

    joint: int
    quantity: Literal["first_moment", "inertia"]
    along: np.ndarray
    row: np.ndarray

    @property
    def unit(self) -> str:
        return "kg m" if self.quantity == "first_moment" else "kg m²"


def seen_quantities(robot: Robot) -> list[Seen]:
    """First moments and inertias about joints that torques see: the first moment along its own direction, and across that.

    The mass beyond a joint is seen through the first moment about the joint before alone, in chains of joints that turn.
    """
    base, values, result = base_parameters(robot), robot.inertial.T.ravel(), []
    chosen, rows = base.independent, base.projection
    for k, axis in enumerate(robot.axes):
        own = rows[(chosen >= 10 * k + 1) & (chosen < 10 * k + 4)]
        back = np.linalg.pinv(own[:, 10 * k + 1 : 10 * k + 4])  # (3, r), from what is seen to the moment in its plane
        plane = np.linalg.svd(back, full_matrices=False)[0].T[: len(own)]
        moment = plane @ (back @ (own @ values))
        if np.linalg.norm(moment) > 0 and len(plane) == 2:
            first = moment / np.linalg.norm(moment)
            plane = np.array([first, [-first[1], first[0]]]) @ plane
        result += [Seen(k, "first_moment", along, along @ back @ own) for along in plane]
        own = rows[(chosen >= 10 * k + 4) & (chosen < 10 * k + 10)]
        x, y, z = axis
        about = np.array([x * x, 2 * x * y, y * y, 2 * x * z, 2 * y * z, z * z])
        weights = about @ np.linalg.pinv(own[:, 10 * k + 4 : 10 * k + 10])
        if np.allclose(weights @ own[:, 10 * k + 4 : 10 * k + 10], about, atol=ROUNDING):
            result.append(Seen(k, "inertia", axis, weights @ own))
    return result


def pseudo_inertia(parameters: np.ndarray) -> np.ndarray:
    """The 4×4 pseudo-inertia of a body: second moments, first moments and mass; positive definite for every physical body.

    Wensing, Kim & Slotine 2018: [[Σ, h], [hᵀ, m]] with Σ = tr(I)/2 − I, from the ten numbers of `Robot.inertial`.
    """
    mass, first, (xx, xy, yy, xz, yz, zz) = parameters[0], parameters[1:4], parameters[4:]
    inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    moments = np.trace(inertia) / 2 * np.eye(3) - inertia
    return np.block([[moments, first[:, None]], [first[None, :], np.array([[mass]])]])


def of_pseudo_inertia(p: ca.SX) -> ca.SX:
    """The ten inertial parameters of a body with a pseudo-inertia (4, 4); the inverse of `pseudo_inertia`."""
    xx, yy, zz = p[1, 1] + p[2, 2], p[0, 0] + p[2, 2], p[0, 0] + p[1, 1]
    return ca.vertcat(p[3, 3], p[:3, 3], xx, -p[0, 1], yy, -p[0, 2], -p[1, 2], zz)


def about_centre(parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centre of mass [m], (3,), and rotational inertia about it [kg m²], (3, 3), of a link's ten numbers (`Robot.inertial`)."""
    mass, centre, (xx, xy, yy, xz, yz, zz) = parameters[0], parameters[1:4] / parameters[0], parameters[4:]
    about_origin = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return centre, about_origin - mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))


def is_physical(parameters: np.ndarray) -> bool:
    """Whether ten inertial parameters are physically consistent: finite, with a positive definite pseudo-inertia."""
    return bool(np.all(np.isfinite(parameters)) and np.linalg.eigvalsh(pseudo_inertia(parameters))[0] > 0)


def is_possible(parameters: np.ndarray) -> bool:
    """As `is_physical`, up to rounding, and with bodies without extent, as URDFs have them: mass above 0, moments of a body."""
    if not (np.all(np.isfinite(parameters)) and parameters[0] > 0 and np.all(np.abs(parameters) <= LARGEST)):
        return False
    if not np.all(np.abs(parameters[1:4]) <= LARGEST * parameters[0]):  # a centre further away than any number that is read
        return False
    return possible(np.linalg.eigvalsh(about_centre(parameters)[1]))


@cache
def from_log_cholesky() -> Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """xi (10,) -> (the ten inertial parameters, their derivatives by xi (10, 10)).

    Rucker & Wensing 2022: pseudo-inertia = U Uᵀ with U = exp(alpha) [[exp d1, s12, s13, t1], [0, exp d2, s23, t2],
    [0, 0, exp d3, t3], [0, 0, 0, 1]], so that every xi is a physical body, t its centre of mass [m] and exp(2 alpha) its mass [kg].
    """
    xi = ca.SX.sym("xi", 10)
    alpha, d, s, t = xi[0], xi[1:4], xi[4:7], xi[7:10]
    upper = ca.vertcat(
        ca.horzcat(ca.exp(d[0]), s[0], s[2], t[0]),
        ca.horzcat(0, ca.exp(d[1]), s[1], t[1]),
        ca.horzcat(0, 0, ca.exp(d[2]), t[2]),
        ca.horzcat(0, 0, 0, 1),
    )
    parameters = of_pseudo_inertia(ca.exp(2 * alpha) * upper @ upper.T)
    function = ca.Function("from_log_cholesky", [xi], [parameters, ca.densify(ca.jacobian(parameters, xi))])

    def evaluate(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        found, jacobian = function(values)
        return np.array(found).ravel(), np.array(jacobian)

    return evaluate


def links_from_log_cholesky(xi: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
    """Inertial parameters (10, n) of links with coordinates (10 n,), and each link's derivatives (10, 10)."""
    parts = [from_log_cholesky()(link) for link in xi.reshape(-1, 10)]
    return np.stack([p for p, _ in parts], axis=1), [j for _, j in parts]


def to_log_cholesky(parameters: np.ndarray) -> np.ndarray:
    """xi (10,) of a physical body; the inverse of `from_log_cholesky`."""
    upper = np.linalg.cholesky(pseudo_inertia(parameters)[::-1, ::-1])[::-1, ::-1]  # U Uᵀ with U upper triangular
    u = upper / upper[3, 3]
    return np.array([np.log(upper[3, 3]), *np.log(np.diag(u)[:3]), u[0, 1], u[1, 2], u[0, 2], *u[:3, 3]])


@dataclass(frozen=True)
class BodyPrior:
    """Normal prior of the links in log-Cholesky coordinates, link by link.

    Attributes:
        centre: Mean, (10 n,).
        std: Standard deviation, (10 n,): a factor of e² in mass and of e in the radii of gyration, a link's length in its centre.
    """

    centre: np.ndarray
    std: np.ndarray


def precision(guess: BodyPrior, inertial: np.ndarray) -> np.ndarray:
    """Precision matrix of the prior in inertial parameters (10 n, 10 n), linearised about physical bodies (10, n)."""
    result = np.zeros((guess.std.size,) * 2)
    for i, parameters in enumerate(inertial.T):
        own = slice(10 * i, 10 * i + 10)
        turn = np.linalg.inv(from_log_cholesky()(to_log_cholesky(parameters))[1])
        result[own, own] = turn.T @ np.diag(guess.std[own] ** -2) @ turn
    return result


def prior(robot: Robot) -> BodyPrior:
    """Prior centred at the URDF's values where they are physical, else at 1 kg about the middle of the link."""
    centres, stds = [], []
    for i in range(robot.n):
        tip = robot.tool.position if robot.tool.joint == robot.n - 1 else np.zeros(3)
        reach = robot.placements[i + 1, :3, 3] if i + 1 < robot.n else tip
        length = max(float(np.linalg.norm(reach)), SMALLEST_LENGTH)
        parameters = robot.inertial[:, i]
        centres.append(to_log_cholesky(parameters if is_physical(parameters) else _guess(reach, length)))
        stds.append([1.0, 1.0, 1.0, 1.0, *[length] * 6])
    return BodyPrior(np.concatenate(centres), np.concatenate(stds))


def _guess(reach: np.ndarray, length: float) -> np.ndarray:
    """1 kg about the middle of the link, with a radius of gyration of 0.3 lengths about every axis."""
    centre = reach / 2
    inertia = (0.3 * length) ** 2 * np.eye(3) + centre @ centre * np.eye(3) - np.outer(centre, centre)
    return np.array([1.0, *centre, *inertia[np.tril_indices(3)]])
