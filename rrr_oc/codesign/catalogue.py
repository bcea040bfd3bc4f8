"""A catalogue of purchasable springs and pulleys, and the distinct choices that it offers for the springs of a design."""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import Meta, field

from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.springs import SpringBounds
from rrr_oc.codesign.task_sets.task_set import SetDesign
from rrr_oc.effects import design_forms
from rrr_oc.effects.design_form import DesignForm
from rrr_oc.errors import UserError
from rrr_oc.schema import Positive, Schema, Text, check_names, read_preset

ROUNDED = 1e-4  # [1] by which hardware may be outside the task's bounds, as lists are printed with four or five digits; doubled, one with
# three digits would still be met
BETWEEN = 1e-4  # [1] of a parameter's range in the catalogue, within which it is taken to be in the catalogue; doubled, ties are split sooner


@dataclass(frozen=True)
class Catalogue:
    """Purchasable springs and pulleys.

    Attributes:
        name: Used in messages.
        lists: Values [SI] by label of the springs' design form, and there by joint name where one quantity is bought, else by the
            quantity's symbol (pulleys with their cable included).
    """

    name: str
    lists: Mapping[str, Mapping[str, tuple[float, ...]]]


Sizes = Annotated[list[Positive], Meta(min_length=1)]


def load_catalogue(source: str | Path = "prototype") -> Catalogue:
    """The bundled catalogue of the prototype, or a JSON file of the same form; raises `UserError`."""
    where, given = read_preset("catalogue", source, {"prototype": "catalogue.json"}, catalogue_schema())
    lists = {label: _lists(f"{where}: {form.shop}", form, getattr(given, form.shop)) for label, form in _sold().items()}
    return Catalogue(given.name or str(source), lists)


def catalogue_schema() -> Any:
    """The structure of a catalogue's file: a list of sizes for each kind of spring that can be bought."""
    keys: list[Any] = [("format", Literal["rrr_oc-catalogue/1"]), ("name", Text | None, None)]  # pyright: ignore[reportOperatorIssue]
    keys += [(form.shop, dict[str, Sizes], field(default_factory=dict)) for form in _sold().values()]
    return msgspec.defstruct("CatalogueFile", keys, bases=(Schema,))


def _sold() -> dict[str, DesignForm]:
    """Forms of the springs that can be bought, by label."""
    return {label: kind.design for label, kind in design_forms().items() if kind.design.shop}


def _lists(where: str, form: DesignForm, given: Mapping[str, Sequence[float]]) -> dict[str, tuple[float, ...]]:
    """What can be bought of one kind of spring, as `Catalogue.lists` holds it."""
    if len(form.bought) == 1:
        names = {joint: (joint, form.bought[0].unit) for joint in given}
    else:
        names = {q.symbol: (q.key, q.unit) for q in form.bought}
        check_names(given, [key for key, _ in names.values()], where)
        missing = [key for key, _ in names.values() if key not in given]
        if given and missing:
            raise UserError(f"{where}: key {missing[0]!r} is missing; required are {', '.join(q.key for q in form.bought)}")
    return {name: tuple(sorted({size * unit for size in given[key]})) for name, (key, unit) in names.items() if given}


@dataclass(frozen=True)
class Choice:
    """Hardware of some springs [SI], and the bounds of the parameters that hold a design to it."""

    hardware: dict[str, float]
    lower: np.ndarray
    upper: np.ndarray


Kinds = tuple[np.ndarray, ...]  # indices of choices, by spring


@dataclass(frozen=True, eq=False)
class Choices:
    """What a catalogue offers for a design.

    Attributes:
        design: The design.
        of_spring: For each of its springs the distinct choices within the task's bounds.
        combinations: Number of combinations before equivalent hardware is merged.
    """

    design: SetDesign
    of_spring: list[list[Choice]]
    combinations: int

    @cached_property
    def bounds(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Bounds of each spring's parameters, (choices, parameters) each."""
        return [(np.array([c.lower for c in kinds]), np.array([c.upper for c in kinds])) for kinds in self.of_spring]

    @property
    def every(self) -> Kinds:
        """All of them."""
        return tuple(np.arange(len(kinds)) for kinds in self.of_spring)

    def between(self, kinds: Kinds) -> tuple[np.ndarray, np.ndarray]:
        """The least bounds of the design's parameters that leave room for each of these choices."""
        pairs = list(zip(self.bounds, kinds, strict=True))
        lower, upper = [low[k].min(axis=0) for (low, _), k in pairs], [high[k].max(axis=0) for (_, high), k in pairs]
        return np.concatenate(lower), np.concatenate(upper)

    def hardware(self, kinds: Kinds) -> dict[str, float]:
        """What is bought, where one choice is left for each spring."""
        chosen = [of[int(k[0])].hardware for of, k in zip(self.of_spring, kinds, strict=True)]
        return {name: size for hardware in chosen for name, size in hardware.items()}

    def halves(self, kinds: Kinds, parameters: np.ndarray) -> tuple[Kinds, Kinds]:
        """These choices in two parts, below and above a parameter: the one that is furthest from what can be bought, relative to the
        catalogue's range, or the one with the widest range where all are in the catalogue."""
        columns = [(spring, column) for spring, (low, _) in enumerate(self.bounds) for column in range(low.shape[1])]

        def rank(entry: tuple[tuple[int, int], float]) -> tuple[float, float]:
            (spring, column), value = entry
            (low, high), sizes = (b[:, column] for b in self.bounds[spring]), self._sizes(kinds, spring, column)
            if (low < high).any() or sizes.min() == sizes.max():
                return -1.0, -1.0
            off = float(np.abs(sizes - value).min() / np.ptp(low))
            return off if off > BETWEEN else 0.0, float(np.ptp(sizes) / np.ptp(low))

        (spring, column), value = max(zip(columns, parameters.tolist(), strict=True), key=rank)
        sizes = self._sizes(kinds, spring, column)
        values = np.unique(sizes)
        above = sizes >= values[np.clip(np.searchsorted(values, value, side="right"), 1, len(values) - 1)]
        below, above = ((*kinds[:spring], kinds[spring][side], *kinds[spring + 1 :]) for side in (~above, above))
        return below, above

    def _sizes(self, kinds: Kinds, spring: int, column: int) -> np.ndarray:
        """What some choices make of a spring's parameter; equal where it differs by rounding only."""
        return np.round(self.bounds[spring][0][kinds[spring], column], 9)


def choices_of(design: SetDesign, catalogue: Catalogue) -> Choices:
    """What a catalogue offers within the task's bounds; raises `UserError` where it has nothing for a spring."""
    offers = [_distinct(spring, _inside(design.first, spring, catalogue)) for spring in design.springs]
    return Choices(design, [kinds for kinds, _ in offers], int(np.prod([count for _, count in offers], dtype=int)))


def can_be_bought(design: CoDesign) -> bool:
    """Whether a design has springs, and catalogues may list all of them."""
    return bool(design.springs) and all(spring.known or spring.form.shop for spring in design.springs)


def check_offers(design: CoDesign, catalogue: Catalogue) -> None:
    """Raise `UserError` where a catalogue has nothing within the task's bounds for a spring of a design."""
    for spring in design.springs:
        _inside(design, spring, catalogue)


def _inside(design: CoDesign, spring: SpringBounds, catalogue: Catalogue) -> dict[str, list[float]]:
    """Values in the catalogue of each quantity of a spring within the task's bounds, by the quantity's name in the design."""
    form, joints = spring.form, [design.task.robot.joints[j] for j in spring.effect.joints]
    lists = catalogue.lists.get(form.label, {})
    what = f"catalogue {catalogue.name!r} has no {spring.effect.name.replace('_', ' ')} for {' and '.join(joints)}"
    inside = {}
    for i, q in enumerate(form.quantities):
        if q.free:
            continue
        low, high = spring.hardware[q.symbol] if form.derived else (spring.lower[i], spring.upper[i])
        values = lists.get(joints[0] if len(form.bought) == 1 else q.symbol, ())
        found = [v for v in values if low * (1 - ROUNDED) <= v <= high * (1 + ROUNDED)]
        if not found:
            raise UserError(f"{what} within the task's bounds: no {q.symbol} of {low:g} … {high:g}" if lists else what)
        inside[form.name(q, spring.effect.joints)] = found
    return inside


def _distinct(spring: SpringBounds, inside: Mapping[str, Sequence[float]]) -> tuple[list[Choice], int]:
    """The combinations that differ in the spring's torque, and the number of all; of equivalent hardware the one with the widest bounds."""
    form, joints, distinct = spring.form, spring.effect.joints, {}
    items = list(itertools.product(*inside.values()))
    for values in items:
        hardware = dict(zip(inside, values, strict=True))
        box = spring.lower, spring.upper
        lower, upper, _ = form.held(joints, box, spring.hardware, hardware, form.free_names(joints))
        key = tuple(np.round(np.where(lower == upper, lower, 0.0), 9))
        known = distinct.get(key)
        if known is None or np.sum(upper - lower) > np.sum(known.upper - known.lower):
            distinct[key] = Choice(hardware, lower, upper)
    return list(distinct.values()), len(items)
