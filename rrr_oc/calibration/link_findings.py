"""Links that recordings show to be far from the URDF's: in the directions that torques see, and their mass, centre or inertia by themselves."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.stats import norm

from rrr_oc.calibration.estimator.evidence import Start
from rrr_oc.calibration.estimator.fitting import FAR, Fitted, PlainFitter
from rrr_oc.calibration.estimator.intervals import covariance, half_width
from rrr_oc.calibration.estimator.left_out import Fall, fall_of, squares_left_out
from rrr_oc.robot.inertial_parameters import seen_quantities
from rrr_oc.robot.link_errors import OF_URDF, LinkErrors

USUAL = 2.33  # declared standard deviations within which 98 of 100 files are in one direction; doubled, a link half as heavy again is not told
QUANTILE = 1.96  # of the normal distribution, of a 95 % interval
PARTS = {"mass": slice(0, 1), "centre": slice(1, 4), "inertia": slice(4, 7)}  # of a link's errors


@dataclass(frozen=True)
class Quantity:
    """A mass, a centre or moments of inertia about it, as found and in the URDF, and by how many declared standard deviations they differ.

    Attributes:
        value, urdf: One number, or three.
        sigmas: The largest of the differences.
    """

    value: tuple[float, ...]
    urdf: tuple[float, ...]
    sigmas: float


@dataclass(frozen=True)
class Direction:
    """A first moment [kg m] or an inertia [kg m²] of what turns about a joint that differs from the URDF's.

    Attributes:
        joint: Its number.
        quantity, unit: Which, and its unit.
        along: Unit vector in the joint's frame along which a first moment counts, or the axis.
        value, urdf: As found and in the URDF.
        interval: 95 % interval from the recordings alone, whatever is believed of the URDF.
    """

    joint: int
    quantity: str
    unit: str
    along: tuple[float, ...]
    value: float
    urdf: float
    interval: tuple[float, float]


@dataclass(frozen=True)
class LinkFinding:
    """A link whose inertial parameters differ from the URDF's by more than those of URDFs usually do.

    Attributes:
        link: Its number.
        directions: What torques see of it.
        quantities: What differs by itself, by name: "mass" [kg], "centre" [m], "inertia" [kg m²].
        probability: That one of these differs by more than it usually does.
        fall: Of the error of a joint, against links that differ by no more than `FAR` declared standard deviations.
        rivals: Names and joints of effects that explain as much beside the URDF's links; None where they were not sought.
    """

    link: int
    directions: tuple[Direction, ...]
    quantities: dict[str, Quantity]
    probability: float
    fall: Fall | None = None
    rivals: tuple[tuple[str, tuple[int, ...]], ...] | None = None


def link_findings(fitted: Fitted) -> list[LinkFinding]:
    """The links of a fit that are known to be off; none where the set says that links are unknown, or priors that they are exact."""
    data, size = fitted.posterior.data, len(fitted.model.values)
    if not data.free or np.linalg.norm(fitted.links) < USUAL:  # which bounds the difference in any direction
        return []
    std = np.sqrt(np.diag(covariance(fitted, loose=True))[size : size + len(fitted.links)])
    known = np.abs(fitted.links) - QUANTILE * std > FAR
    result = []
    for finding in in_directions(fitted, data.links):
        i, own = finding.link, slice(OF_URDF * finding.link, OF_URDF * (finding.link + 1))
        sigmas = np.where(known[own], np.abs(fitted.links[own]), 0.0)
        found, urdf = (_described(x[:, i]) for x in (fitted.model.robot.inertial, data.links.plain))
        off = {
            name: Quantity(found[name], urdf[name], float(sigmas[part].max()))
            for name, part in PARTS.items()
            if sigmas[part].any()
        }
        result.append(replace(finding, quantities=off))
    return result


def in_directions(fitted: Fitted, described: LinkErrors) -> list[LinkFinding]:
    """What differs from a URDF in directions that torques see, by the link that has most of it.

    What files usually have in a direction is the declared covariance of the errors along it. What mass and centre are believed to be
    tells nothing of a direction: its interval is of the recordings alone.

    Args:
        described: The errors that are declared of the links of the URDF.
    """
    size, result = len(fitted.model.values), dict[int, list[tuple[Direction, float]]]()
    own = slice(size, size + len(fitted.links))
    spread = covariance(fitted, loose=True)[own, own]
    (plain, usual), (bodies, slopes) = described.at(described.none), fitted.posterior.data.links.at(fitted.links)
    half = half_width(min(one.count for one in fitted.posterior.joints))
    for seen in seen_quantities(replace(fitted.model.robot, inertial=plain)):
        value, urdf = (float(seen.row @ x.T.ravel()) for x in (bodies, plain))
        limit, slope = USUAL * np.linalg.norm(seen.row @ usual), seen.row @ slopes
        std, off = max(float(np.sqrt(slope @ spread @ slope)), 1e-12), abs(value - urdf)
        if off - half * std > limit:
            of_links = (seen.row * (bodies - plain).T.ravel()).reshape(-1, 10).sum(axis=1)
            link = int(np.argmax(of_links * np.sign(value - urdf)))
            interval = value - half * std, value + half * std
            told = Direction(seen.joint, seen.quantity, seen.unit, tuple(seen.along.tolist()), value, urdf, interval)
            result.setdefault(link, []).append((told, float(norm.cdf((off - limit) / std))))
    return [LinkFinding(i, tuple(d for d, _ in some), {}, max(p for _, p in some)) for i, some in sorted(result.items())]


def with_falls(fitter: PlainFitter, fitted: Fitted, found: Sequence[LinkFinding]) -> list[LinkFinding]:
    """Findings of a fit with the fall of the error, on the joint where it is surest, against links as declared."""
    if not found:
        return []
    links, post = np.clip(fitted.links, -FAR, FAR), fitted.posterior
    model = replace(fitted.model, robot=replace(fitted.model.robot, inertial=fitter.data.links.at(links)[0]))
    declared = replace(fitter, farthest=FAR).fit(model, links, Start(post.hyper, post.joints), fixed=True)
    fall = max(falls(fitted, declared), key=lambda f: f.low, default=None)
    return [replace(f, fall=fall) for f in found]


def falls(fitted: Fitted, other: Fitted) -> list[Fall]:
    """By how much a fit lowers the error of each joint that moves, on data left out, against another fit of the same rows."""
    after, before = (squares_left_out(one.posterior) for one in (fitted, other))
    return [fall_of(j, after[:, j], before[:, j]) for j in range(after.shape[1]) if before[:, j].any()]


def entries(found: Sequence[LinkFinding], links: Sequence[str], joints: Sequence[str]) -> list[dict[str, Any]]:
    """Findings as in files.

    Args:
        links, joints: Names.
    """

    def plain(values: tuple[float, ...]) -> float | list[float]:
        return values[0] if len(values) == 1 else list(values)

    def direction(d: Direction) -> dict[str, Any]:
        numbers = {"value": d.value, "urdf": d.urdf, "interval": list(d.interval), "unit": d.unit, "along": list(d.along)}
        return {"joint": joints[d.joint], "quantity": d.quantity} | numbers

    def lowered(f: Fall) -> dict[str, Any]:
        interval = [f.low, f.high] if np.isfinite([f.low, f.high]).all() else None
        return {"joint": joints[f.joint], "share": f.share, "interval": interval}

    return [
        {"link": links[f.link]}
        | {name: {"value": plain(q.value), "urdf": plain(q.urdf), "sigmas": q.sigmas} for name, q in f.quantities.items()}
        | {
            "directions": [direction(d) for d in f.directions],
            "lowers_error": None if f.fall is None else lowered(f.fall),
        }
        | ({} if f.rivals is None else {"indistinguishable_from": list(dict.fromkeys(name for name, _ in f.rivals))})
        for f in found
    ]


def _described(inertial: np.ndarray) -> dict[str, tuple[float, ...]]:
    """Mass, centre and moments of inertia about it of a link's ten parameters (mass, first moment, xx, xy, yy, xz, yz, zz)."""
    mass, first = float(inertial[0]), inertial[1:4]
    centre = first / mass if mass > 0 else np.zeros(3)
    moments = inertial[[4, 6, 9]] - mass * (centre @ centre - centre**2)
    return {"mass": (mass,), "centre": tuple(map(float, centre)), "inertia": tuple(map(float, moments))}
