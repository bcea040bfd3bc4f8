"""How often a claim like this one is right: a logistic regression on sealed arms whose recordings passed a chain of measurement.

The odds of the search compare models, all of which are a little wrong, so that they are no frequency. The coefficients are data,
`rrr_oc/data/reliability.json`, which `python -m validation.chains.reliability` makes again from diagnoses and their truth.
"""

import importlib.resources
from collections.abc import Mapping
from functools import cache
from typing import Any

import msgspec
import numpy as np
from msgspec import Struct
from scipy.special import expit

NAMES = ("constant", "log odds", "lower end of the fall", "what functions explain more", "rivals", "error over noise", "size")
LEAST, MOST = 1e-3, 0.999  # that are said: the cases are some hundred


class Regression(Struct, forbid_unknown_fields=True):
    """The coefficients of a logistic regression on `NAMES`, by kind of claim, and from how many claims of which cases they are.

    Attributes:
        law, dependence: For an effect that is named, and for the joint and the variables of a torque that is described.
        claims: Numbers of both.
        cases: Of how many sealed cases, from which to which.
    """

    law: tuple[float, ...]
    dependence: tuple[float, ...]
    claims: tuple[int, int]
    cases: str


def features(entry: Mapping[str, Any], anatomy: Mapping[str, float]) -> np.ndarray:
    """The quantities of an entry of `effects` or `unexplained`, with the parts of its joint's error, as of `NAMES`, (7,)."""
    size = entry["lowers_error"]
    ends = [x["interval"][0] for x in (size, size["innovations"]) if x is not None and x["interval"] is not None]
    noise, rest = anatomy.get("noise", 0.0), anatomy.get("not explained", 0.0)
    return np.array(
        [
            1.0,
            np.log(max(entry["log_odds"], 1.0)),
            np.clip(max(ends, default=0.0), -0.2, 1.0),
            1 - np.clip(1.0 if entry.get("reaches") is None else entry["reaches"], 0.0, 1.0),
            np.log1p(len(entry.get("rivals", ()))),
            0.5 * np.log1p(max(rest, 0.0) / max(noise, 1e-12)),
            np.log(max(size["of_torque"], 1e-4)),
        ]
    )


def probability(entry: Mapping[str, Any], anatomy: Mapping[str, float]) -> float:
    """How often claims like an entry are right."""
    known = regression()
    return probability_of(features(entry, anatomy), np.array(known.law if "effect" in entry else known.dependence))


def probability_of(quantities: np.ndarray, coefficients: np.ndarray) -> float:
    """The probability by a regression."""
    return float(np.clip(expit(quantities @ coefficients), LEAST, MOST))


@cache
def regression() -> Regression:
    """The coefficients."""
    return msgspec.json.decode(
        importlib.resources.files("rrr_oc.data").joinpath("reliability.json").read_bytes(), type=Regression
    )
