"""Steel wire of springs: diameters, strength, moduli, and the stress that it stands, from `rrr_oc/data/spring_wire.json`."""

import importlib.resources
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import msgspec
import numpy as np


class Drawn(msgspec.Struct, frozen=True):
    """A kind of wire.

    Attributes:
        name: What it is called.
        diameter_mm: Least and greatest diameter of which its strength is known.
        A_MPa, m: Of its tensile strength A/d^m, d in mm.
        moduli_GPa: Up to each diameter [mm], Young's modulus and shear modulus.
        yields: Share of the tensile strength that a stress may reach once [1], by kind of stress.
        endures: Share of the tensile strength up to which a stress may go from zero and back [1], by kind of stress, for each number of
            `WireFile.cycles`, or the first of them.
    """

    name: str
    diameter_mm: tuple[float, float]
    A_MPa: float
    m: float
    moduli_GPa: tuple[tuple[float, float, float], ...]
    yields: dict[str, float]
    endures: dict[str, tuple[float, ...]]


class WireFile(msgspec.Struct, frozen=True):
    """What is known of steel wire.

    Attributes:
        density_kg_per_m3: Of steel.
        diameters_mm: Preferred ones.
        wires: The kinds, the strongest first.
        cycles: Numbers of cycles of `Drawn.endures`.
        shear_strength: Share of the tensile strength at which wire shears [1].
        tolerance_mm: Up to each diameter [mm], by how much it may be off.
    """

    density_kg_per_m3: float
    diameters_mm: tuple[float, ...]
    wires: tuple[Drawn, ...]
    cycles: tuple[float, ...]
    shear_strength: float
    tolerance_mm: tuple[tuple[float, float], ...]


@dataclass(frozen=True, eq=False)
class Wire:
    """Wire of some diameters.

    Attributes:
        kind: Index of its kind in `steel().wires`, (...).
        d: Diameter [m], (...).
        tensile: Strength [Pa], (...); NaN where there is no wire of this diameter.
        E, G: Young's modulus and shear modulus [Pa], (...).
    """

    kind: np.ndarray
    d: np.ndarray
    tensile: np.ndarray
    E: np.ndarray
    G: np.ndarray

    def of_kind(self, read: Callable[[Drawn], Any]) -> np.ndarray:
        """What is read of each one's kind, (...)."""
        return np.array([read(kind) for kind in steel().wires])[self.kind]


@cache
def steel() -> WireFile:
    """What is known of steel wire."""
    return msgspec.json.decode(
        importlib.resources.files("rrr_oc.data").joinpath("spring_wire.json").read_bytes(), type=WireFile
    )


def wire(diameter: np.ndarray, name: str | None = None) -> Wire:
    """Wire of diameters [m], (...): of a kind, or of the strongest that there is of each."""
    mm = np.asarray(1e3 * diameter)
    kinds = {i: kind for i, kind in enumerate(steel().wires) if name in (None, kind.name)}
    there = [(kind.diameter_mm[0] <= mm) & (mm <= kind.diameter_mm[1]) for kind in kinds.values()]
    columns = np.select([t[..., None] for t in there], [_drawn(kind, mm) for kind in kinds.values()], np.nan)
    return Wire(np.select(there, [*kinds]), mm / 1e3, *np.moveaxis(columns, -1, 0))


def _drawn(kind: Drawn, mm: np.ndarray) -> np.ndarray:
    """Strength and moduli of a kind [Pa], (..., 3)."""
    up_to, E, G = np.array(kind.moduli_GPa).T
    at = np.minimum(np.searchsorted(up_to, mm), len(up_to) - 1)
    return np.stack([1e6 * kind.A_MPa / mm**kind.m, 1e9 * E[at], 1e9 * G[at]], axis=-1)
