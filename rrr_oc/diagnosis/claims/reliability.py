"""How often a claim like this one is right: a logistic regression on sealed arms whose recordings passed a chain of measurement.

The odds of the search compare models, all of which are a little wrong, so that they are no frequency. The coefficients are data,
`rrr_oc/data/reliability.json`, which `python -m validation.chains.reliability` makes again from diagnoses and their truth.
"""

import importlib.resources
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache

import msgspec
import numpy as np
from msgspec import Struct
from scipy.special import expit

from rrr_oc.diagnosis.knobs import LIKELY
from rrr_oc.diagnosis.result import Finding

NAMES = (
    "constant",
    "log odds",
    "lower end of the fall",
    "what functions explain more",
    "rivals",
    "share of what is left that is no noise",
    "size",
    "findings beside it on its joint",
)
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


def judged(findings: Sequence[Finding], anatomy: Sequence[Mapping[str, float]]) -> list[Finding]:
    """Findings with how often claims like each are right. A law that is right less often than `LIKELY` is not named.

    Args:
        anatomy: Of each joint the parts of its error, see `anatomy.anatomy`.
    """
    result, known = [], regression()
    for f in findings:
        parts, beside = anatomy[f.joint], sum(g.joint == f.joint and not g.with_function for g in findings if g is not f)
        law = probability_of(_features_of(f, parts, beside, True), known.law)
        named = not (f.term.effect.black_box or f.with_function) and law >= LIKELY
        right = law if named else probability_of(_features_of(f, parts, beside, False), known.dependence)
        result.append(replace(f, named=named, right=None if f.with_function else right))
    return result


def _features_of(f: Finding, parts: Mapping[str, float], beside: int, law: bool) -> np.ndarray:
    lows = [x.low for x in (f.fall, f.innovations) if x is not None and np.isfinite([x.low, x.high]).all()]
    return features(f.worth, lows, (f.of_torque, beside), parts, f.reach if law else None, len(f.rivals) * law)


def features(
    log_odds: float,
    lows: Sequence[float],
    of_joint: tuple[float, int],
    parts: Mapping[str, float],
    reach: float | None = None,
    rivals: int = 0,
) -> np.ndarray:
    """What is known of a claim, as of `NAMES`, (8,).

    Args:
        log_odds: By how much it raises the logarithm of the posterior probability [nats].
        lows: Lower ends of the falls of the error and of its innovations [1].
        of_joint: The larger of both over the joint's torque [1], and how many other findings are surest on this joint.
        parts: Of its joint's error.
        reach: Share of what a function explains that the law explains; of a law that was compared with one.
        rivals: How many laws may be in its place.
    """
    noise, rest = parts.get("noise", 0.0), parts.get("not explained", 0.0)
    return np.array(
        [
            1.0,
            np.log(max(log_odds, 1.0)),
            np.clip(max(lows, default=0.0), -0.2, 1.0),
            1 - np.clip(1.0 if reach is None else reach, 0.0, 1.0),
            np.log1p(rivals),
            max(rest, 0.0) / max(max(rest, 0.0) + noise, 1e-12),
            np.log(max(of_joint[0], 1e-4)),
            np.log1p(of_joint[1]),
        ]
    )


def probability_of(quantities: np.ndarray, coefficients: Sequence[float] | np.ndarray) -> float:
    """The probability by a regression."""
    return float(np.clip(expit(quantities @ np.asarray(coefficients)), LEAST, MOST))


@cache
def regression() -> Regression:
    """The coefficients."""
    return msgspec.json.decode(
        importlib.resources.files("rrr_oc.data").joinpath("reliability.json").read_bytes(), type=Regression
    )
