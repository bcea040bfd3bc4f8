"""A made-up set of recordings of the bundled arm, all of whose joints swing: columns by name, as a CSV file has them."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from recorded import Plant

from rrr_oc.storage import write_csv

JOINTS = ("joint1", "joint2", "joint3")
PLANT = Plant("rrr", np.array([3.0, 4.0, 2.0]), np.array([6.0, 5.0, 3.0]), np.array([0.1, 0.2, 0.1]))
CENTRE, RATES = np.array([0.0, 1.2, -1.4])[:, None], np.array([1.1, 1.7, 2.3])[:, None]


def columns(seconds: float = 12.0, rate: float = 100.0) -> dict[str, np.ndarray]:
    """A motion of the bundled arm with its rates, and its torques with a little noise."""
    t = np.arange(round(seconds * rate)) / rate
    phases = RATES * t, 2.7 * RATES * t + 1
    q = CENTRE + 0.6 * np.sin(phases[0]) + 0.15 * np.sin(phases[1])
    dq = RATES * (0.6 * np.cos(phases[0]) + 0.405 * np.cos(phases[1]))
    ddq = -(RATES**2) * (0.6 * np.sin(phases[0]) + 1.0935 * np.sin(phases[1]))
    tau = PLANT.torque(q, dq, ddq) + np.random.default_rng(0).normal(0, 0.05, q.shape)
    found = {"t": t}
    for kind, values in (("q", q), ("dq", dq), ("ddq", ddq), ("tau", tau)):
        found |= {f"{kind}_{joint}": values[i] for i, joint in enumerate(JOINTS)}
    return found


def without(kinds: tuple[str, ...], of: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {name: values for name, values in of.items() if name.partition("_")[0] not in kinds}


def written(folder: Path, header: dict[str, Any] | None = None, **files: dict[str, np.ndarray]) -> Path:
    """The folder, with recordings.json and a CSV file for each of `files`."""
    for name, content in files.items():
        write_csv(folder / f"{name}.csv", content)
    own = {"format": "rrr_oc-recordings/1", "robot": "rrr", "joints": list(JOINTS)}
    entries = {"recordings": [{"file": f"{name}.csv"} for name in files]}
    (folder / "recordings.json").write_text(json.dumps(own | entries | (header or {})))
    return folder
