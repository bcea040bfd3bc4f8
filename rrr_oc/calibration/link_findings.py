"""Links that recordings show to be far from the URDF's: in the directions that torques see, and their mass, centre or inertia by themselves."""

from collections.abc import Sequence
from dataclasses import replace as renewed
from typing import Any, Literal

import numpy as np
from msgspec import Struct, to_builtins
from msgspec.structs import replace
from scipy.stats import norm

from rrr_oc.calibration.estimator.evidence import NoiseStart
from rrr_oc.calibration.estimator.fitting import FAR, Fitted, PlainFitter
from rrr_oc.calibration.estimator.intervals import covariance, half_width
from rrr_oc.calibration.estimator.left_out import surest_fall
from rrr_oc.robot.inertial_parameters import seen_quantities
from rrr_oc.robot.link_errors import OF_URDF, LinkErrors
from rrr_oc.storage import plain

ALARMS = (
    0.03  # of files whose links are as they usually are, of which a link is told; halved, a link must be off by a tenth more
)
QUANTILE = 1.96  # of the normal distribution, of a 95 % interval
PARTS = {"mass": slice(0, 1), "centre": slice(1, 4), "inertia": slice(4, 7)}  # of a link's errors


class Fallen(Struct, forbid_unknown_fields=True):
    """By how much the error of a joint falls on data left out of the fit.

    Attributes:
        joint: The joint where that is surest.
        share: Of the rms before [1].
        interval: 95 % interval, from the variation between blocks of some seconds; null with fewer than two.
    """

    joint: str
    share: float
    interval: tuple[float, float] | None


class Off(Struct, forbid_unknown_fields=True):
    """A mass, centre or moments of inertia about it that differ from the URDF's.

    Attributes:
        value: As found; the three components of a vector [kg, m, kg m²].
        urdf: The same in the URDF [kg, m, kg m²].
        sigmas: By how many declared standard deviations they differ; the largest of the components.
    """

    value: float | tuple[float, ...]
    urdf: float | tuple[float, ...]
    sigmas: float


class OffDirection(Struct, forbid_unknown_fields=True):
    """A first moment or an inertia of what turns about a joint that differs from the URDF's by more than it does in 98 of 100 files.

    Attributes:
        joint: The joint.
        quantity: Which of the two: of the joint's own link, and of what base parameters add of the outer ones.
        value: As found.
        urdf: The same in the URDF.
        interval: 95 % interval from the recordings alone, whatever is believed of the URDF.
        unit: Of these.
        along: Unit vector in the joint's frame along which the first moment counts, or the axis.
    """

    joint: str
    quantity: Literal["first_moment", "inertia"]
    value: float
    urdf: float
    interval: tuple[float, float]
    unit: str
    along: tuple[float, float, float]


class OffLink(Struct, forbid_unknown_fields=True, omit_defaults=True):
    """A link that differs from the URDF by more than what is usual.

    Attributes:
        link: The link's name in the robot's description.
        directions: What torques see of it.
        probability: That one of these differs by more than what is usual.
        lowers_error: Fall of the error against links within three declared standard deviations of the URDF.
        indistinguishable_from: Names of effects that explain these recordings as well beside such links, where they were sought.
        mass: Its mass, if this is known by itself to be off by three declared standard deviations.
        centre: Its centre of mass, in its joint's frame, if so.
        inertia: Its moments of inertia about the centre, if so.
    """

    link: str
    directions: tuple[OffDirection, ...]
    probability: float
    lowers_error: Fallen | None = None
    indistinguishable_from: tuple[str, ...] | None = None
    mass: Off | None = None
    centre: Off | None = None
    inertia: Off | None = None


def link_findings(fitted: Fitted) -> list[OffLink]:
    """The links of a fit that are known to be off; none where the set says that links are unknown, or priors that they are exact."""
    data, size = fitted.posterior.data, len(fitted.model.values)
    if not data.free or np.linalg.norm(fitted.links) < usual_of(1):  # which bounds the difference in any direction
        return []
    std = np.sqrt(np.diag(covariance(fitted, loose=True))[size : size + len(fitted.links)])
    known = np.abs(fitted.links) - QUANTILE * std > FAR
    result = []
    for one in in_directions(fitted, data.links):
        i = fitted.model.robot.links.index(one.link)
        own = slice(OF_URDF * i, OF_URDF * (i + 1))
        sigmas = np.where(known[own], np.abs(fitted.links[own]), 0.0)
        found, urdf = (_described(x[:, i]) for x in (fitted.model.robot.inertial, data.links.plain))
        off = {k: Off(found[k], urdf[k], float(sigmas[part].max())) for k, part in PARTS.items() if sigmas[part].any()}
        result.append(replace(one, **off))
    return result


def usual_of(directions: int) -> float:
    """Declared standard deviations that a file whose links are as they usually are exceeds in none of so many directions, but for `ALARMS`
    of such files (Bonferroni)."""
    return float(norm.ppf(1 - ALARMS / (2 * directions)))


def in_directions(fitted: Fitted, described: LinkErrors) -> list[OffLink]:
    """What differs from a URDF in directions that torques see, by the link that has most of it.

    What files usually have in a direction is the declared covariance of the errors along it. What mass and centre are believed to be
    tells nothing of a direction: its interval is of the recordings alone.

    Args:
        described: The errors that are declared of the links of the URDF.
    """
    robot, size, result = fitted.model.robot, len(fitted.model.values), dict[int, list[tuple[OffDirection, float]]]()
    own = slice(size, size + len(fitted.links))
    spread = covariance(fitted, loose=True)[own, own]
    (nominal, usual), (bodies, slopes) = described.at(described.none), fitted.posterior.data.links.at(fitted.links)
    half = half_width(min(one.count for one in fitted.posterior.joints))
    every = seen_quantities(renewed(robot, inertial=nominal))
    for seen in every:
        value, urdf = (float(seen.row @ x.T.ravel()) for x in (bodies, nominal))
        limit, slope = usual_of(len(every)) * np.linalg.norm(seen.row @ usual), seen.row @ slopes
        std, off = max(float(np.sqrt(slope @ spread @ slope)), 1e-12), abs(value - urdf)
        if off - half * std > limit:
            of_links = (seen.row * (bodies - nominal).T.ravel()).reshape(-1, 10).sum(axis=1)
            link = int(np.argmax(of_links * np.sign(value - urdf)))
            interval = value - half * std, value + half * std
            x, y, z = seen.along.tolist()
            told = OffDirection(robot.joints[seen.joint], seen.quantity, value, urdf, interval, seen.unit, (x, y, z))
            result.setdefault(link, []).append((told, float(norm.cdf((off - limit) / std))))
    return [OffLink(robot.links[i], tuple(d for d, _ in some), max(p for _, p in some)) for i, some in sorted(result.items())]


def with_falls(fitter: PlainFitter, fitted: Fitted, found: Sequence[OffLink]) -> list[OffLink]:
    """Findings of a fit with the fall of the error against links as declared."""
    if not found:
        return []
    links, post = np.clip(fitted.links, -FAR, FAR), fitted.posterior
    model = renewed(fitted.model, robot=renewed(fitted.model.robot, inertial=fitter.data.links.at(links)[0]))
    declared = renewed(fitter, farthest=FAR).fit(model, links, NoiseStart(post.hyper, post.joints), fixed=True)
    return [replace(f, lowers_error=fall_against(fitted, declared)) for f in found]


def fall_against(fitted: Fitted, other: Fitted) -> Fallen | None:
    """By how much a fit lowers the error on data left out, against another fit of the same rows, on the joint where it is surest."""
    best = surest_fall(fitted.posterior, other.posterior)
    if best is None:
        return None
    return Fallen(fitted.model.joints[best.joint], best.share, (best.low, best.high) if np.isfinite(best.low) else None)


def entries(found: Sequence[OffLink]) -> list[dict[str, Any]]:
    """Findings as in files."""
    return plain(to_builtins(found))


def _described(inertial: np.ndarray) -> dict[str, Any]:
    """Mass, centre and moments of inertia about it of a link's ten parameters (mass, first moment, xx, xy, yy, xz, yz, zz)."""
    mass, first = float(inertial[0]), inertial[1:4]
    centre = first / mass if mass > 0 else np.zeros(3)
    moments = inertial[[4, 6, 9]] - mass * (centre @ centre - centre**2)
    return {"mass": mass, "centre": tuple(map(float, centre)), "inertia": tuple(map(float, moments))}
