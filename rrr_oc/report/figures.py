"""How figures are drawn and saved: without a screen, whole or not at all."""

from pathlib import Path
from typing import Any

import matplotlib

from rrr_oc.storage import new_file

matplotlib.use("Agg")
import matplotlib.pyplot as plt

COLOURS = ("#1f4e79", "#c55a11", "#548235", "#7030a0", "#7f6000", "#833c0b", "#385723")
FOOTER = {"fontsize": 8, "color": "0.35"}  # text properties of notes


def save_figure(figure: Any, path: Path, dpi: int = 130) -> Path:
    """Write a figure, whole or not at all, in the format of its name, and close it; raises `UserError` where the file cannot be written."""
    with new_file(path) as file:
        figure.savefig(file, format=path.suffix[1:], dpi=dpi, bbox_inches="tight")
    plt.close(figure)
    return path
