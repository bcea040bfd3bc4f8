# pyright: reportAttributeAccessIssue=false
"""The pictures of the documentation: of `rrr-oc demo`, of the priors, and of tables that stand in the pages.

    python -m docs.from_code.pictures FOLDER

makes them in docs/images from a folder in which `rrr-oc demo` ran.
"""

import argparse
import base64
import io
import itertools
import json
import re
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import mujoco
import numpy as np

import rrr_oc
from rrr_oc.diagnosis.diagnosis_file import DiagnosisFile
from rrr_oc.diagnosis.stages import _Reader
from rrr_oc.diagnosis.structures.search import Memory
from rrr_oc.effects import CATALOGUE, Effect
from rrr_oc.effects.words import joint_words, words
from rrr_oc.report.diagnosis_figures import diagnosis_figures
from rrr_oc.report.figures import Curve, Figure, Panel, draw, key, save_figure
from rrr_oc.report.pages.diagnosis_claims import claims
from rrr_oc.report.pages.diagnosis_curves import LEFT, Curves
from rrr_oc.schema import read_json
from rrr_oc.storage import read_npz

IMAGES = Path(__file__).resolve().parents[1] / "images"
FALL = 0.5  # [s], in which the demo's arm reaches no stop
TICKS = tuple(float(f"{m}e{d}") for d in range(-3, 5) for m in (1, 2, 5))  # of logarithmic axes
COPIED = {"demo.png": "diagnosis/prediction.png", "design.gif": "design.gif", "motion.png": "design/arm_PEA.png"}


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


def laws(folder: Path) -> Any:
    """Each claim's law within the band of what was recorded."""
    found, curves = read_json(folder / "diagnosis.json", DiagnosisFile), read_npz(folder / "figures.npz")
    titles = [claim.title for claim in claims(found, curves["files"].tolist())]
    return draw([[Panel(f, "") for f in diagnosis_figures(found, curves, titles) if f.name.startswith("law_")]])


def clouds(folder: Path) -> Any:
    """What is left of the first claim's joint over position and speed, by the calibrated and by the repaired model."""
    found, curves = read_json(folder / "diagnosis.json", DiagnosisFile), read_npz(folder / "figures.npz")
    j = curves["joints"].tolist().index(found.effects[0].joint)
    shown = [f for f in diagnosis_figures(found, curves) if f.name.startswith("position_")]
    rows = [dict(zip(LEFT, curves[f"left {k} {j}"], strict=True)) for k in range(len(curves["files"]))]
    whole = {name: np.concatenate([one[name] for one in rows]) for name in LEFT} | {"limit": shown[0].data[key(0, j)]["limit"]}
    return draw([[Panel(replace(f, data={"": whole}), "", f.title) for f in shown]])


def drawn(folder: Path) -> Any:
    """By how much arms drawn from what the recordings leave open fall otherwise than the repaired model, in plain MuJoCo."""
    with TemporaryDirectory() as out:
        files = rrr_oc.export(folder / "model.json", out, samples=20, quiet=True)
        *others, repaired = [fallen(path) for path in (*files.samples, files.mjcf)]
    data = {f"{k} {j}": (angles - repaired)[j] for k, angles in enumerate(others) for j in range(2)}
    data["t"], axes = np.linspace(0, FALL, repaired.shape[1]), ("time [s]", "difference of the angle [°]")
    panels = []
    for j, joint in enumerate(("shoulder", "elbow")):
        curves = tuple(Curve("t", f"{k} {j}", "after", "a drawn arm", width=1) for k in range(len(others)))
        panels.append(Panel(Figure("drawn", joint, axes, curves, {"": data}), ""))
    return draw([panels])


def fallen(path: str | Path) -> np.ndarray:
    """Angles [°] of an arm that falls from one posture (n, K)."""
    model = mujoco.MjModel.from_xml_path(str(path))
    data, rows = mujoco.MjData(model), []
    data.qpos[:] = 1.0, 0.5
    for _ in range(round(FALL / model.opt.timestep)):
        mujoco.mj_step(model, data)
        rows.append(np.degrees(data.qpos.copy()))
    return np.array(rows).T


def recorded(folder: Path) -> Any:
    """A recording."""
    return rrr_oc.load(folder).plot().figure


def believed(_: Path) -> Any:
    """How probable each law of the catalogue is on one joint before any recording."""
    kinds = sorted((k for k in CATALOGUE.values() if k.role == "law" and k.prior), key=lambda k: -k.prior.probability)
    data = {"": {"x": [100 * k.prior.probability for k in kinds], "y": [k.called() for k in kinds]}}
    curve = Curve("x", "y", "after", mode="markers", width=9)
    axes = ("probability before any recording [%]", "")
    return draw(
        [[Panel(Figure("priors", "", axes, (curve,), data, log="x", ticks=TICKS, names=True), "")]],
        (7.5, 0.23 * len(kinds) + 0.6),
    )


@dataclass(frozen=True)
class Drawn:
    """A table of a page as a picture: numbers of some columns by row.

    Attributes:
        page: Name of the page.
        head: How the table begins.
        columns: Name in the legend, column, and which number of a cell, of each kind of point.
        axis: Title of the horizontal axis.
        names: Columns that name a row.
        log: Whether the axis is logarithmic.
    """

    page: str
    head: str
    columns: tuple[tuple[str, str | int, int], ...]
    axis: str
    names: int = 1
    log: bool = True

    def __call__(self, _: Path) -> Any:
        """The picture."""
        text = (IMAGES.parent / self.page).read_text(encoding="utf-8")
        lines = itertools.takewhile(lambda line: line.startswith("|"), text[text.index(self.head) :].splitlines())
        header, _line, *rows = [[cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]] for line in lines]
        data: dict[str, Any] = {"y": [", ".join(filter(None, row[: self.names])) for row in rows]}
        for name, column, place in self.columns:
            every = [
                re.findall(r"-?\d*\.?\d+", row[column if isinstance(column, int) else header.index(column)]) for row in rows
            ]
            data[name] = [float(numbers[place]) if len(numbers) > place else np.nan for numbers in every]
        roles = ("before", "after", "recorded") if len(self.columns) > 1 else ("after",)
        curves = tuple(Curve(c[0], "y", r, c[0], "markers", 9) for c, r in zip(self.columns, roles, strict=False))
        figure = Figure(self.page, "", (self.axis, ""), curves, {"": data}, log="x" * self.log, ticks=TICKS, names=True)
        return draw([[Panel(figure, "")]], (7.5, 0.25 * len(rows) + 0.6))


DRAWN: dict[str, tuple[str, Callable[[Path], Any]]] = {
    "discovery.png": ("diagnosis", discovery),
    "laws.png": ("diagnosis", laws),
    "calibration.png": ("diagnosis", clouds),
    "drawn_arms.png": ("diagnosis", drawn),
    "recording.png": ("recordings", recorded),
    "priors.png": ("", believed),
    "evolution.png": (
        "",
        Drawn(
            "gradient_vs_evolution.md",
            "| | evolution, MuJoCo |",
            (("best of ten by evolution", "evolution, model", 0), ("gradient", "gradient, Sobol (b)", 0)),
            "E1 [N²m²s]",
        ),
    ),
    "transfer.png": (
        "",
        Drawn(
            "transfer.md",
            "| arm | springs | labelled model |",
            (("designed on the labelled model", "labelled model", 1), ("designed on the repaired model", "repaired model", 1)),
            "E1 measured on the arm [N²m²s]",
            2,
        ),
    ),
    "real_arms.png": (
        "",
        Drawn(
            "real_arms.md",
            "| set | published |",
            (("calibrated model", "NRMSE plain", 0), ("with what was found", "diagnosed", 0), ("splines", "splines", 0)),
            "error of unseen torque over its standard deviation",
        ),
    ),
    "hidden_springs.png": (
        "",
        Drawn(
            "validation.md",
            "| arm | joints | claimed | described: planned |",
            (("designed on the described arm", "true", 0), ("designed on the repaired one", 7, 0)),
            "cost on the true arm, of ten arms [N²m²s]",
        ),
    ),
    "peers.png": (
        "",
        Drawn(
            "peers.md",
            "| tool; library | effect and joint right |",
            (("named", "effect and joint right", 0),),
            "of 48 effects, with their joint",
            log=False,
        ),
    ),
}
MADE = (*COPIED, *DRAWN)


def write(demo: Path, images: Path) -> None:
    """Make the pictures from the folder of the demo."""
    for name, made in COPIED.items():
        shutil.copyfile(demo / made, images / name)
    for name, (folder, picture) in DRAWN.items():
        save_figure(picture(demo / folder), images / name, dpi=90)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    write(parser.parse_args().folder / "demo", IMAGES)


if __name__ == "__main__":
    main()
