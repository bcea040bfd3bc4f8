"""What is not known of the links' inertial parameters: errors of a URDF, or all of them where a set says "identify".

Whatever the errors, the links are physical bodies if those of the plain model are, with a mass within `HEAVIEST` of the file's and a
centre and radii of gyration within the link's reach.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import casadi as ca
import numpy as np

from rrr_oc.robot.inertial_parameters import (
    SMALLEST_LENGTH,
    from_log_cholesky,
    of_pseudo_inertia,
    pseudo_inertia,
    to_log_cholesky,
)
from rrr_oc.robot.robot import Robot

HEAVIEST = 10.0  # times its mass in the file, or the arm's mean, that a link may weigh, or one over it; ten thousand if no masses are known
LIGHTEST = 1e-9  # [kg] of a link below which its centre counts as that of none
OF_URDF = 7  # errors of a link of a URDF: mass, centre, second moments about it


@dataclass(frozen=True)
class LinkErrors:
    """Errors of the links' inertial parameters, in standard deviations of their prior, (k,), link by link.

    Attributes:
        plain: Inertial parameters without errors (10, n).
        std: Standard deviations of the errors (k,): of the logarithm of the mass, of the centre of mass [m] and of the logarithms of
            the second moments about it, 7 a link; or of log-Cholesky coordinates, 10 a link; or none, of links that are known exactly.
        most: Ends of the changes of these, the lower and the upper ones (2, k): x = std · error becomes x / √(1 + (x / end)²), of slope 1
            and curvature 0 at 0.
    """

    plain: np.ndarray
    std: np.ndarray
    most: tuple[np.ndarray, np.ndarray] | tuple[float, float] = (-np.inf, np.inf)

    @property
    def none(self) -> np.ndarray:
        """No errors (k,)."""
        return np.zeros(len(self.std))

    def at(self, errors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The inertial parameters (10, n), and their derivatives by the errors (10 n, k)."""
        n = self.plain.shape[1]
        each = len(self.std) // n
        links, slopes = self.plain.copy(), np.zeros((10 * n, len(self.std)))
        if not each:
            return links, slopes
        root = np.sqrt(1 + (self.std * errors / np.where(errors < 0, *self.most)) ** 2)
        change, rate = self.std * errors / root, self.std / root**3
        for i in range(n):
            own = slice(each * i, each * i + each)
            if each == OF_URDF:
                links[:, i], slope = _erroneous()(self.plain[:, i], change[own])
            else:
                links[:, i], slope = from_log_cholesky()(to_log_cholesky(self.plain[:, i]) + change[own])
            slopes[10 * i : 10 * i + 10, own] = slope * rate[own]
        return links, slopes


def most_of(robot: Robot, each: int) -> tuple[np.ndarray, np.ndarray]:
    """`LinkErrors.most` of a robot's links with so many errors a link.

    A link reaches as far as the next joint, the tool and the frames that are fixed to it, its centre of mass, and a body of even density
    with its radii of gyration r, √3 r. A centre changes by less than that, and no radius of gyration becomes larger.
    """
    low, high = [], []
    mean = float(np.mean(robot.inertial[0]))
    for i, parameters in enumerate(robot.inertial.T):
        fixed = [pose[:3, 3] for joint, pose in robot.frames.values() if joint == i]
        ends = [*robot.placements[i + 1 : i + 2, :3, 3], *fixed, *[robot.tool.position] * (robot.tool.joint == i)]
        mass, centre, second = _described(parameters)
        radii = np.sqrt(second)
        reach = max(SMALLEST_LENGTH, *(float(np.linalg.norm(x)) for x in (centre, *ends)), 3**0.5 * float(radii.max()))
        heavy, wide = np.log(HEAVIEST), np.log(reach / radii)
        own = [heavy, *[reach] * 3, *(2 * wide)] if each == OF_URDF else [2 * heavy, *np.maximum(wide, heavy), *[reach] * 6]
        low += own
        high += [heavy + np.log(max(mean / mass, 1.0)), *own[1:]] if each == OF_URDF else own
    return -np.array(low), np.array(high)


def _described(parameters: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Mass [kg], centre [m], (3,), and second moments along the axes about it over the mass [m²], (3,), of a link's ten numbers."""
    mass = max(float(parameters[0]), LIGHTEST)
    centre = parameters[1:4] / mass
    return mass, centre, np.maximum(np.diag(pseudo_inertia(parameters))[:3] / mass - centre**2, LIGHTEST)


@cache
def _erroneous() -> Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """(ten parameters of a link, errors (7,)) -> (the ten with the errors, their derivatives by the errors (10, 7)).

    The pseudo-inertia P becomes exp(error of mass) A P Aᵀ, in which A stretches the link about its centre and shifts it.
    """
    plain, error = ca.SX.sym("plain", 4, 4), ca.SX.sym("error", OF_URDF)
    centre = plain[:3, 3] / ca.fmax(plain[3, 3], LIGHTEST)
    stretched = ca.diagcat(ca.diag(ca.exp(error[4:] / 2)), 1)
    change = _shift(centre + error[1:4]) @ stretched @ _shift(-centre)
    found = of_pseudo_inertia(ca.exp(error[0]) * change @ plain @ change.T)
    function = ca.Function("erroneous", [plain, error], [found, ca.densify(ca.jacobian(found, error))])

    def evaluate(parameters: np.ndarray, errors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        value, slopes = function(pseudo_inertia(parameters), errors)
        return np.array(value).ravel(), np.array(slopes)

    return evaluate


def _shift(by: ca.SX) -> ca.SX:
    """Of homogeneous coordinates, (4, 4)."""
    return ca.vertcat(ca.horzcat(ca.SX.eye(3), by), ca.SX([[0, 0, 0, 1]]))
