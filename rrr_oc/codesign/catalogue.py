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
from rrr_oc.effects import design_forms
from rrr_oc.effects.design_form import DesignForm
from rrr_oc.errors import UserError
from rrr_oc.schema import Positive, Schema, Text, check_names, read_preset

ROUNDED = 1e-4  # [1] by which hardware may be outside the task's bounds, as lists are printed with four or five digits; doubled, one with
# three digits would still be met


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
    return {label: kind.design for label, kind in design_forms().items() if kind.design is not None and kind.design.shop}


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


@dataclass(frozen=True, eq=False)
class Choices:
    """What a catalogue offers for a design.

    Attributes:
        design: The design.
        of_spring: For each of its springs the distinct choices within the task's bounds.
        combinations: Number of combinations before equivalent hardware is merged.
    """

    design: CoDesign
    of_spring: list[list[Choice]]
    combinations: int

    @property
    def distinct(self) -> int:
        """Number of distinct combinations."""
        return int(np.prod([len(s) for s in self.of_spring]))

    @cached_property
    def derived(self) -> int | None:
        """Index of the spring whose parameters are functions of its hardware (a biarticular one); None where there is none."""
        return next((i for i, s in enumerate(self.design.springs) if s.hardware), None)

    def merged(self, choices: Sequence[Choice | None]) -> Choice:
        """One choice from those of the springs; None leaves a spring free."""
        both = [c or Choice({}, s.lower, s.upper) for s, c in zip(self.design.springs, choices, strict=True)]
        hardware = {name: size for c in both for name, size in c.hardware.items()}
        return Choice(hardware, np.concatenate([c.lower for c in both]), np.concatenate([c.upper for c in both]))

    def alone(self, choice: Choice, spring: int) -> Choice:
        """A choice for one spring, the others free."""
        return self.merged([choice if i == spring else None for i in range(len(self.of_spring))])

    def all(self) -> list[Choice]:
        """Every distinct combination."""
        return [self.merged(c) for c in itertools.product(*self.of_spring)]

    def neighbours(self, choice: Choice, parameters: np.ndarray) -> list[Choice]:
        """A choice of the derived spring with the catalogued stiffnesses next below and above the optimal ones of each
        parallel spring, which stand in `parameters`."""
        lists, at = [], 0
        for i, kinds in enumerate(self.of_spring):
            rows = slice(at, at + len(kinds[0].lower))
            if i == self.derived:
                lists.append([Choice(choice.hardware, choice.lower[rows], choice.upper[rows])])
            else:
                above = int(np.searchsorted([c.lower[0] for c in kinds], parameters[at]))
                lists.append(kinds[max(above - 1, 0) : above + 1])
            at = rows.stop
        return [self.merged(c) for c in itertools.product(*lists)]


def choices_of(design: CoDesign, catalogue: Catalogue) -> Choices:
    """What a catalogue offers within the task's bounds; raises `UserError` where it has nothing for a spring."""
    offers = [_distinct(spring, _inside(design, spring, catalogue)) for spring in design.springs]
    return Choices(design, [kinds for kinds, _ in offers], int(np.prod([count for _, count in offers], dtype=int)))


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
