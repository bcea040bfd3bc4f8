"""Whether what a diagnosis finds is what a case conceals, by names, joints and the plant's own equal effects."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

ABSENT = 0.01  # residual after plain calibration over noise, below which no data of this size hold an effect
IMPERFECT = "imperfect"  # the kind whose arms have small faults everywhere


def read(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text(encoding="utf-8"))


def place(joint: Any) -> tuple[str, ...]:
    """A joint, a list of two or null, to compare by."""
    return () if joint is None else tuple(sorted([joint] if isinstance(joint, str) else joint))


def key(entry: Mapping[str, Any]) -> tuple[str, tuple[str, ...]]:
    return entry["effect"], place(entry["joint"])


def how_named(truth: Mapping[str, Any], found: Mapping[str, Any]) -> str | None:
    """In which way an effect of a diagnosis names one of the truth: "itself", "rival", "equal"; None where it does not."""
    if key(found) == key(truth):
        return "itself"
    if key(truth) in [key(r) for r in found.get("rivals", [])]:
        return "rival"
    classes = truth.get("equal_effects") or {}
    same = [key(e) for kind in ("equal", "within_noise") for e in classes.get(kind, [])]
    return "equal" if key(found) in same else None


def small(truth: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """The faults of an imperfect arm for which the catalogue has a name."""
    return [e for e in truth.get("small", []) if e["in_catalogue"]]
