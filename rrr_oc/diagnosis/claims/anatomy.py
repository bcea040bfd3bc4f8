"""The anatomy of an error: from what the robot's file predicts to noise, part by part."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rrr_oc.diagnosis.claims.effect_size import LeftOut
from rrr_oc.diagnosis.mismatch import filtered_noise
from rrr_oc.diagnosis.result import Finding
from rrr_oc.diagnosis.structures.linear import Links

FRICTION, LINKS, NO_LAW, REST, NOISE = "friction and rotor", "links", "seen, no law", "not explained", "noise"
WAYS: tuple[Links, ...] = ("declared", "as fitted")


def anatomy(plain: LeftOut, found: LeftOut, findings: Sequence[Finding]) -> list[dict[str, float]]:
    """Of each joint the shares of the squared error of the robot's file on data left out by which parts lower it, one after the other,
    and what is left; they add up to 1. A part that raises an error has a negative share.

    Args:
        plain, found: Errors about the fits without and with all that was found. What all of it lowers is shared out as the effects lower
            the error one after the other about the latter.
        findings: Those of the latter, in the order of its terms.
    """
    data, model = plain.near.linear.fitter.data, plain.near.linear.fitted.model
    bare = replace(model, robot=replace(model.robot, inertial=data.links.at(data.links.none)[0]), terms=())
    own = found.near.linear.fitted.extra
    every = tuple(found.of(t) for t in own)
    left = [np.sum((data.residual(bare) * data.counted) ** 2, axis=1), *(plain.squares((), how)[0] for how in WAYS)]
    last = found.squares(every)[0] if own else left[-1]
    chain = np.array([found.squares(every[:k])[0] for k in range(len(every) + 1)]) if own else np.zeros((1, data.n))
    acts = np.array([a.columns.any(axis=(1, 2)) for a in every]).reshape(len(every), data.n)
    falls = np.maximum(-np.diff(chain, axis=0), 1e-9 * left[0]) * acts
    falls *= (left[-1] - last) / np.maximum(falls.sum(axis=0), 1e-300)
    noise = filtered_noise(data, found.near.linear.fitted.model)
    noisy = np.minimum(data.counted.sum(axis=1) * noise**2, last)
    parts = {FRICTION: left[0] - left[1], LINKS: left[1] - last - falls.sum(axis=0)}  # links of the reported model
    for f, fall in zip(findings, falls, strict=True):
        name = _part(f, model.joints)
        parts[name] = parts.get(name, 0.0) + fall
    parts |= {REST: last - noisy, NOISE: noisy}
    whole = np.maximum(left[0], 1e-300)
    return [{name: float(squares[j] / whole[j]) for name, squares in parts.items()} for j in range(data.n)]


def _part(finding: Finding, joints: Sequence[str]) -> str:
    """A finding as a part: effect@joint."""
    (name, own), no_law = finding.key, finding.term.effect.black_box or finding.with_function
    return NO_LAW if no_law else "@".join([name, *([" ".join(joints[j] for j in own)] if own else [])])
