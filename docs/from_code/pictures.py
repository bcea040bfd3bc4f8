"""The pictures of the documentation that show `rrr-oc demo`.

    python -m docs.from_code.pictures FOLDER

makes them in docs/images from a folder in which `rrr-oc demo` ran.
"""

import argparse
import base64
import io
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np

from rrr_oc.diagnosis.diagnosis_file import DiagnosisFile
from rrr_oc.diagnosis.stages import _Reader
from rrr_oc.diagnosis.structures.search import Memory
from rrr_oc.effects import Effect
from rrr_oc.effects.words import joint_words, words
from rrr_oc.report.diagnosis_figures import diagnosis_figures
from rrr_oc.report.figures import Curve, Figure, Panel, draw, save_figure
from rrr_oc.report.pages.diagnosis_claims import claims
from rrr_oc.report.pages.diagnosis_curves import LEFT, Curves
from rrr_oc.schema import read_json
from rrr_oc.storage import read_npz

IMAGES = Path(__file__).resolve().parents[1] / "images"
COPIED = {"demo.png": "diagnosis/prediction.png", "design.gif": "design.gif"}
MADE = (*COPIED, "discovery.png")


def discovery(folder: Path) -> Any:
    """How the first claim of a diagnosis came about: what the plain model leaves, the law, the search, and what was left out."""
    found, curves = read_json(folder / "diagnosis.json", DiagnosisFile), read_npz(folder / "figures.npz")
    titles = [claim.title for claim in claims(found, curves["files"].tolist())]
    shown = {figure.name: figure for figure in diagnosis_figures(found, curves, titles)}
    joint = curves["joints"].tolist().index(found.effects[0].joint)
    return draw(
        [
            [Panel(left(curves, joint), ""), Panel(shown["law_0"], "", f"2  {shown['law_0'].title}")],
            [Panel(search(folder, curves), ""), Panel(shown["errors"], "", "4  On recordings that were left out")],
        ],
        (5.2, 2.6),
    )


def left(curves: Curves, j: int) -> Figure:
    """What the plain model leaves of a joint's torque, over its position."""
    rows = np.concatenate([curves[f"left {k} {j}"] for k in range(len(curves["files"]))], axis=1)
    x, y = np.degrees(rows[LEFT.index("q")]), rows[LEFT.index("residual_before")]
    joint = joint_words(str(curves["joints"][j]))
    title = f"1  What a calibrated model leaves of the torque of {joint}"
    curve = Curve("x", "y", "before", mode="markers", width=2)
    return Figure("left", title, (f"position of {joint} [°]", "torque [Nm]"), (curve,), {"": {"x": x, "y": y}})


def search(folder: Path, curves: Curves) -> Figure:
    """The steps of the search, each with what it adds to the logarithm of the model's probability."""
    kept = json.loads((folder / ".search.json").read_text(encoding="utf-8"))["found"]["pickle"]
    memory: Memory = _Reader(io.BytesIO(base64.b64decode(kept)), None).load()  # type: ignore[arg-type]
    models, scores = [model for model, *_ in memory.path], np.array([score for _, _, score, *_ in memory.path])
    base = len(models[0].terms)
    names = ["calibrated model", *(f"+ {named(model.terms[base:][-1].effect, curves)}" for model in models[1:])]
    data = {"": {"x": scores - scores[0], "y": names, "gain": [f"{gain:+.3g}" for gain in np.diff(scores, prepend=scores[0])]}}
    axes = ("gain of log probability [nats]", "")
    curve = Curve("x", "y", "after", mode="markers", width=9, text="gain")
    return Figure("search", "3  The search adds what raises the probability", axes, (curve,), data, names=True)


def named(effect: Effect, curves: Curves) -> str:
    """An effect with its joint."""
    on = " and ".join(joint_words(str(curves["joints"][j])) for j in effect.joints)
    return f"{words(effect.name)}{f' of {on}' * bool(on)}"


def write(demo: Path, images: Path) -> None:
    """Make the pictures from the folder of the demo."""
    for name, made in COPIED.items():
        shutil.copyfile(demo / made, images / name)
    save_figure(discovery(demo / "diagnosis"), images / "discovery.png", dpi=90)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    write(parser.parse_args().folder / "demo", IMAGES)


if __name__ == "__main__":
    main()
