"""What was hidden in an arm beside what a diagnosis claims."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from rrr_oc.commands.shared import shown


def beside(truth: Mapping[str, Any], diagnosis: Mapping[str, Any]) -> Iterator[list[str]]:
    """For each quantity that is hidden: what it is, its name, true value, found value, interval, and whether this holds the truth.

    Where the diagnosis does not claim it, the last three say so.
    """
    for effect in truth["effects"]:
        claims = [e for e in diagnosis["effects"] if (e["effect"], e["joint"]) == (effect["effect"], effect["joint"])]
        for name, value in effect["parameters"].items():
            found = claims[0]["parameters"][name] if claims else None
            unit = f" {found['unit']}" if found else ""
            yield [effect["says"], f"{effect['joint']}: {name}", f"{shown(value)}{unit}", *_compared(found, value)]
    for link in truth["links"]:
        off = [one for one in diagnosis["link_findings"] if one["link"] == link["link"]]
        directions = [d for one in off for d in one["directions"] if d["joint"] == link["joint"]]
        for quantity, unit in (("first_moment", "kg m"), ("inertia", "kg m²")):
            found = next((d for d in directions if d["quantity"] == quantity), None)
            value = link[quantity]
            if quantity == "first_moment":  # a vector, of which one direction was found
                value = float(np.dot(value, found["along"])) if found else float(np.linalg.norm(value))
            name = f"{link['link']}: {quantity.replace('_', ' ')}"
            yield [link["says"], name, f"{shown(value)} {unit}", *_compared(found, value)]


def _compared(found: Mapping[str, Any] | None, value: float) -> list[str]:
    if found is None:
        return ["not claimed", "–", "–"]
    if not found["interval"]:
        return [shown(found["value"]), "not determined", "–"]
    low, high = found["interval"]
    return [shown(found["value"]), f"{shown(low)} … {shown(high)}", "yes" if low <= value <= high else "no"]
