"""Priors of all effects: those that the effects declare, with what a user knows better about an arm, from a TOML file."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta
from msgspec import field as key

from rrr_oc.effects import CATALOGUE, BlackBox
from rrr_oc.effects.base import SOUGHT, Effect, Prior, Trial, View
from rrr_oc.schema import Schema, check_names, read_toml, validated

# Neither 0 nor 1, which no recording could contradict
Probability = Annotated[float, Meta(gt=0, lt=1, description="a number above 0 and below 1 is required")]
Size = Annotated[float, Meta(gt=0, le=1e300, description="a finite number above 0 is required")]


class Context(Schema, frozen=True):
    """What is known of the arm as a whole.

    Attributes:
        springs: Whether the arm carries springs; by default it does where a recording lists one.
        inertias: Whether the links' inertial parameters are known exactly.
        excluded: Effects that the arm cannot have, as `backlash` of direct drives; they are not sought.
    """

    springs: bool | None = None
    inertias: Literal["exact", "nominal"] = "nominal"
    excluded: tuple[str, ...] = ()


class Given(Schema, frozen=True):
    """What is known of one effect.

    Attributes:
        probability: That it is present at one place (a joint, a pair of joints, a listed spring, the arm); by default as declared.
        typical: Typical sizes, by the names and in the units of the declared prior; by default as declared.
    """

    probability: Probability | None = None
    typical: dict[str, Size] = key(default_factory=dict)


@dataclass(frozen=True)
class Priors:
    """What is believed of effects before any recording is seen.

    Attributes:
        given: Priors by effect's name that replace those declared.
        springs: Whether the arm carries springs; None where nobody said so.
        exact_inertias: Whether the links' inertial parameters are known exactly.
        excluded: Names of effects that are not sought.
        file: Where they were read from; None for what the effects declare.
    """

    given: Mapping[str, Prior] = field(default_factory=dict)
    springs: bool | None = None
    exact_inertias: bool = False
    excluded: tuple[str, ...] = ()
    file: str | None = None

    def of(self, kind: type[Effect]) -> Prior:
        """The prior of an effect."""
        return self.given.get(kind.name, kind.prior)

    def chance(self, effect: Effect, view: View) -> float:
        """Probability that an effect is present on its joints.

        Springs that recordings list count as a statement that the arm carries springs, unless `springs` says otherwise.
        """
        prior, springs = self.of(type(effect)), self.springs
        odds = prior.probability / (1 - prior.probability)
        if springs or (springs is None and view.springs):
            odds *= prior.where_springs
        elif springs is not None:
            odds /= prior.where_springs
        if self.exact_inertias:
            odds *= prior.where_exact
        return odds / (1 + odds)

    def scales(self, view: View, trial: Trial) -> np.ndarray:
        """Prior standard deviations of a trial's coefficients, (m,)."""
        return trial.effect.scales(view, trial, self.of(type(trial.effect)))


def load_priors(path: str | Path) -> Priors:
    """Read a file with a table for each effect that differs, and `context`.

    Raises `UserError` where it is missing or no TOML, for an unknown effect or amplitude, and for numbers that are not allowed.
    """
    tables = read_toml(path)
    context = validated(path, tables.pop("context", {}), Context, "context")
    sought = [name for name, kind in CATALOGUE.items() if kind.role in SOUGHT]
    check_names(tables, sought, path, "effect")
    check_names(
        context.excluded, [n for n in sought if not issubclass(CATALOGUE[n], BlackBox)], f"{path}: context.excluded", "effect"
    )
    found = validated(path, tables, dict[str, Given])
    given = {name: _changed(path, CATALOGUE[name], one) for name, one in found.items()}
    return Priors(given, context.springs, context.inertias == "exact", context.excluded, str(path))


def _changed(path: str | Path, kind: type[Effect], given: Given) -> Prior:
    """The declared prior with what is given; an amplitude without a declared size has its own unit."""
    prior = kind.prior
    declared = prior.typical or dict.fromkeys(kind.amplitudes, (1.0, ""))
    check_names(given.typical, declared, f"{path}: {kind.name}.typical", "amplitude")
    typical = {name: (given.typical.get(name, number), unit) for name, (number, unit) in declared.items()}
    return replace(prior, probability=given.probability or prior.probability, typical=typical, source=f"given in {path}")
