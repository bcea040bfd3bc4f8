"""Links whose mass, centre or inertia recordings show to be far from the URDF's."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import norm

from rrr_oc.calibration.estimator.fitting import FAR, Fitted
from rrr_oc.calibration.estimator.intervals import covariance
from rrr_oc.robot.link_errors import OF_URDF

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
class LinkFinding:
    """A link whose inertial parameters differ from the URDF's by far more than those of URDFs usually do.

    Attributes:
        link: Its number.
        quantities: What differs, by name: "mass" [kg], "centre" [m], "inertia" [kg m²].
        probability: That one of them differs by more than `FAR` declared standard deviations.
    """

    link: int
    quantities: dict[str, Quantity]
    probability: float


def link_findings(fitted: Fitted) -> list[LinkFinding]:
    """The links of a fit that are known to be off; none where the set says that links are unknown, or priors that they are exact."""
    data, size = fitted.posterior.data, len(fitted.model.values)
    if not data.free or not len(fitted.links):
        return []
    std = np.sqrt(np.diag(covariance(fitted)))[size : size + len(fitted.links)]
    known = np.abs(fitted.links) - QUANTILE * std > FAR
    result = []
    for i in range(len(fitted.links) // OF_URDF):
        own = slice(OF_URDF * i, OF_URDF * (i + 1))
        sigmas = np.where(known[own], np.abs(fitted.links[own]), 0.0)
        found, urdf = (_described(x[:, i]) for x in (fitted.model.robot.inertial, data.links.plain))
        off = {
            name: Quantity(found[name], urdf[name], float(sigmas[part].max()))
            for name, part in PARTS.items()
            if sigmas[part].any()
        }
        if off:
            beyond = norm.cdf((np.abs(fitted.links[own]) - FAR) / std[own])
            result.append(LinkFinding(i, off, float(beyond.max())))
    return result


def entries(found: Sequence[LinkFinding], links: Sequence[str]) -> list[dict[str, Any]]:
    """Findings as in files.

    Args:
        links: Names of the links.
    """

    def plain(values: tuple[float, ...]) -> float | list[float]:
        return values[0] if len(values) == 1 else list(values)

    return [
        {"link": links[f.link]}
        | {name: {"value": plain(q.value), "urdf": plain(q.urdf), "sigmas": q.sigmas} for name, q in f.quantities.items()}
        for f in found
    ]


def _described(inertial: np.ndarray) -> dict[str, tuple[float, ...]]:
    """Mass, centre and moments of inertia about it of a link's ten parameters (mass, first moment, xx, xy, yy, xz, yz, zz)."""
    mass, first = float(inertial[0]), inertial[1:4]
    centre = first / mass if mass > 0 else np.zeros(3)
    moments = inertial[[4, 6, 9]] - mass * (centre @ centre - centre**2)
    return {"mass": (mass,), "centre": tuple(map(float, centre)), "inertia": tuple(map(float, moments))}
