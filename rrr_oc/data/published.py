"""The paper's Tables 2 to 4, read from `paper_results.json`, where they are typed once."""

import importlib.resources
import json
from typing import Any

import numpy as np

_UNITS = {"_deg": np.pi / 180, "_mm": 1e-3}


def published() -> dict[str, Any]:
    """The tables as printed: of Table 2 the "nrmse" of stiff actuation, which the paper smooths by an amount that it does not say; of
    Table 3 "decrease_percent" (simulation) and "real_world_percent" by configuration; of Table 4 "springs" by configuration."""
    return json.loads(importlib.resources.files("rrr_oc.data").joinpath("paper_results.json").read_text())


def published_springs(configuration: str) -> dict[str, float]:
    """Table 4's hardware of a configuration in SI units and radians; empty for SA."""
    springs = {}
    for key, value in published()["springs"].get(configuration, {}).items():
        unit = next((u for u in _UNITS if key.endswith(u)), "")
        if not key.startswith("t_"):
            springs[key.removesuffix(unit)] = value * _UNITS.get(unit, 1.0)
    return springs
