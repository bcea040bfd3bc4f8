"""What differs between two calibrated models, by more than their errors, and between what two diagnoses say."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from scipy.stats import norm

from rrr_oc.calibration.calibrated_model import KINEMATICS, CalibratedModel, Estimate, Term
from rrr_oc.calibration.model_file import options_of
from rrr_oc.effects.words import NORMAL
from rrr_oc.errors import UserError
from rrr_oc.robot.inertial_parameters import seen_quantities

LEVEL = 0.05  # probability that any number of two equal arms is called changed
As = Literal["rival", "undecided", "small", "possible", "not_confirmed"]


@dataclass(frozen=True)
class Side:
    """A model to compare, and the content of diagnosis.json where it is from a diagnosis."""

    name: str
    model: CalibratedModel
    told: Mapping[str, Any] | None = None


@dataclass(frozen=True)
class Change:
    """A number that both models have.

    Attributes:
        effect: Name of the effect; "link" for what torques feel of a link and all beyond it.
        joints: Names of its joints.
        parameter: Its name; of links "first_moment" or "inertia".
        unit: Of the values.
        a, b: The values.
        std_a, std_b: Their standard errors, as half of the 95 % interval has them, which knows that noise is an estimate as well; None
            where a model's recordings do not determine the number.
        sigmas: (b − a) / √(std_a² + std_b²); None without both.
        changed: Whether that is more than chance explains; None without.
    """

    effect: str
    joints: tuple[str, ...]
    parameter: str
    unit: str
    a: float
    b: float
    std_a: float | None
    std_b: float | None
    sigmas: float | None = None
    changed: bool | None = None


@dataclass(frozen=True)
class Alone:
    """An effect that one of the models has and the other has not.

    Attributes:
        effect: Its name.
        joints: Names of its joints; none of what is on the arm as a whole.
        recordings: "all", or those that have it.
        parameters: Value, standard error and unit of each.
        elsewhere: As what the other diagnosis has it; None where it does not name it, and without diagnoses.
        of: Name of the effect whose rival it is there.
    """

    effect: str
    joints: tuple[str, ...]
    recordings: Literal["all"] | tuple[str, ...]
    parameters: Mapping[str, tuple[float, float | None, str]]
    elsewhere: As | None = None
    of: str | None = None


@dataclass(frozen=True)
class Compared:
    """Two models side by side.

    Attributes:
        changes: Every number that both have, the most changed first.
        limit: |sigmas| from which a number is called changed: of equal arms, any of all numbers exceeds it with probability `LEVEL`
            (Bonferroni); 0 where there is none.
        only_a, only_b: Effects that one of them has.
        errors: Error of each joint's torque over the recorded one's standard deviation, by joint, of both; None where it is not known.
        verdicts: Of both diagnoses; None without.
    """

    changes: tuple[Change, ...]
    limit: float
    only_a: tuple[Alone, ...]
    only_b: tuple[Alone, ...]
    errors: Mapping[str, tuple[float | None, float | None]]
    verdicts: tuple[str | None, str | None]


def compare_models(a: Side, b: Side) -> Compared:
    """Raises `UserError` unless both are models of arms with the same joints, which sit and turn alike."""
    _check_same_arm(a, b)
    pairs, only_a, only_b = _paired(a.model, b.model)
    found = [*_of_terms(a.model, b.model, pairs), *_of_links(a.model, b.model)]
    number = sum(one.sigmas is not None for one in found)
    limit = float(norm.isf(LEVEL / 2 / number)) if number else 0.0
    found = [replace(one, changed=None if one.sigmas is None else abs(one.sigmas) > limit) for one in found]
    found.sort(key=lambda one: -abs(one.sigmas or 0.0))
    errors = zip(a.model.joints, a.model.nrmse, b.model.nrmse, strict=True)
    return Compared(
        tuple(found),
        limit,
        tuple(_alone(term, a.model, b.told) for term in only_a),
        tuple(_alone(term, b.model, a.told) for term in only_b),
        {joint: (_known(x), _known(y)) for joint, x, y in errors},
        (_verdict(a), _verdict(b)),
    )


def common_numbers(sides: Sequence[Side]) -> Iterator[tuple[Change, ...]]:
    """For each number that all models have, the first model's beside that of each, itself too; raises `UserError` as `compare_models`."""
    first, every = sides[0], list[dict[Any, Change]]()
    for side in sides:
        _check_same_arm(first, side)
        found, own = [*_of_terms(first.model, side.model, _paired(first.model, side.model)[0])], dict[Any, Change]()
        for one in [*found, *_of_links(first.model, side.model)]:
            key = (one.effect, one.joints, one.parameter)
            own[(*key, sum(key == other[:3] for other in own))] = one  # a link's moment is one of several directions
        every.append(own)
    for key in every[0]:
        if all(key in own for own in every):
            yield tuple(own[key] for own in every)


def _check_same_arm(a: Side, b: Side) -> None:
    one, other = a.model.robot, b.model.robot
    if one.joints != other.joints:
        raise UserError(
            f"{a.name} has the joints {', '.join(one.joints)}, but {b.name} {', '.join(other.joints)}; they must be the same"
        )
    for joint, *pair in zip(one.joints, one.placements, one.axes, other.placements, other.axes, strict=True):
        if max(np.abs(pair[0] - pair[2]).max(), np.abs(pair[1] - pair[3]).max()) > KINEMATICS:
            raise UserError(
                f"joint {joint} sits or turns in {b.name} otherwise than in {a.name}; arms of one make are required"
            )
    if not np.allclose(one.gravity, other.gravity, atol=KINEMATICS):
        raise UserError(
            f"gravity is {one.gravity.tolist()} m/s² in {a.name}, but {other.gravity.tolist()} in {b.name}; "
            "arms that stand or hang alike are required"
        )


def _kind(term: Term) -> tuple[Any, ...]:
    """What two terms must have in common to be the same effect."""
    return term.effect.name, term.effect.joints, term.recordings == "all", repr(sorted(options_of(term.effect).items()))


def _paired(a: CalibratedModel, b: CalibratedModel) -> tuple[list[tuple[int, int]], list[Term], list[Term]]:
    """Numbers of the terms that are the same effect in both, in their order, and the terms that are in one alone."""
    left, pairs = list(range(len(b.terms))), []
    for i, term in enumerate(a.terms):
        same = [k for k in left if _kind(b.terms[k]) == _kind(term)]
        if same:
            pairs.append((i, same[0]))
            left.remove(same[0])
    found = {i for i, _ in pairs}
    return pairs, [t for i, t in enumerate(a.terms) if i not in found], [b.terms[k] for k in left]


def _of_terms(a: CalibratedModel, b: CalibratedModel, pairs: Sequence[tuple[int, int]]) -> Iterator[Change]:
    for i, k in pairs:
        one, other = a.terms[i], b.terms[k]
        joints = tuple(a.joints[j] for j in one.effect.joints)
        for p, x, y in zip(one.effect.parameters, one.estimates, other.estimates, strict=True):
            yield _change(one.effect.name, joints, p.name, p.unit, ((x.value, _error(x)), (y.value, _error(y))))


def _error(e: Estimate) -> float | None:
    """Standard error of a normal distribution with the interval, of which one end may be cut at a bound."""
    return None if e.interval is None else max(e.interval[1] - e.value, e.value - e.interval[0]) / NORMAL


def _of_links(a: CalibratedModel, b: CalibratedModel) -> Iterator[Change]:
    """What torques feel of the links, in the directions of the first model. Standard errors are as much wider than the spread as those
    of the effects' parameters are (median)."""
    wider = [_wider(model) for model in (a, b)]
    for seen in seen_quantities(a.robot):
        both = []
        for model, times in zip((a, b), wider, strict=True):
            links = None if model.spread is None else model.spread[len(model.values) :]
            std = None if links is None else times * float(np.linalg.norm(seen.row @ links))
            both.append((float(seen.row @ model.robot.inertial.T.ravel()), std))
        yield _change("link", (a.joints[seen.joint],), seen.quantity, seen.unit, (both[0], both[1]))


def _wider(model: CalibratedModel) -> float:
    """Standard errors by intervals over those that the model gives, median; 1 where it gives none."""
    every = [(_error(e), e.std) for term in model.terms for e in term.estimates]
    ratios = [error / std for error, std in every if error and std]
    return float(np.median(ratios)) if ratios else 1.0


def _change(
    effect: str,
    joints: tuple[str, ...],
    parameter: str,
    unit: str,
    both: tuple[tuple[float, float | None], tuple[float, float | None]],
) -> Change:
    (x, std_x), (y, std_y) = both
    error = None if std_x is None or std_y is None else float(np.hypot(std_x, std_y))
    return Change(effect, joints, parameter, unit, x, y, std_x, std_y, (y - x) / error if error else None)


def _alone(term: Term, model: CalibratedModel, told: Mapping[str, Any] | None) -> Alone:
    """A term, and what the other diagnosis says of it."""
    joints = tuple(model.joints[j] for j in term.effect.joints)
    parameters = {p.name: (e.value, _error(e), p.unit) for p, e in zip(term.effect.parameters, term.estimates, strict=True)}
    elsewhere, of = told_elsewhere(term.effect.name, joints, told or {})
    return Alone(term.effect.name, joints, term.recordings, parameters, elsewhere, of)


def told_elsewhere(effect: str, joints: tuple[str, ...], told: Mapping[str, Any]) -> tuple[As | None, str | None]:
    """As what a diagnosis names an effect that is not in its model, and whose rival it is there."""

    def same(entry: Mapping[str, Any]) -> bool:
        joint = entry.get("joint")
        own = () if joint is None else (joint,) if isinstance(joint, str) else tuple(joint)
        return entry.get("effect") == effect and own == joints

    for claim in told.get("effects", ()):
        if any(same(rival) for rival in claim.get("rivals", ())):
            return "rival", claim["effect"]
    if any(same(member) for one in told.get("undecided", ()) for member in one.get("members", ())):
        return "undecided", None
    groups: tuple[As, ...] = ("small", "not_confirmed", "possible")
    return next((name for name in groups if any(same(entry) for entry in told.get(name, ()))), None), None


def _verdict(side: Side) -> str | None:
    return None if side.told is None else side.told.get("verdict")


def _known(x: float) -> float | None:
    return float(x) if np.isfinite(x) else None
