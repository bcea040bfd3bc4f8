"""The page of a co-design study, made from its saved files alone: summary.json, one npz a configuration, and the arm's pictures."""

import base64
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rrr_oc.effects.words import joint_words
from rrr_oc.report import design_report as tell
from rrr_oc.report.design_report import Quantity
from rrr_oc.report.pages import design_words as say
from rrr_oc.report.pages.page import Curve, Figure, columns, key, render, thinned
from rrr_oc.storage import write_text

POINTS = 2000  # of a curve, at most
NEAR = 0.4  # [1] of a curve's range within which a limit is drawn
BY = ("configuration", "joint")
QUANTITIES = {
    "q": "range_rad",
    "dq": "speed_rad_per_s",
    "tau_load": "torque_Nm",
}  # rows of an npz with their limits in the summary
RELEASE = Curve("release", "{}_span", "limit", "payload released", dash="dot", width=1.5)
SIDES = ("lower", "upper")  # of a limit
LIMITS = tuple(Curve("ends", f"{{}}_{side}", "limit", "limit", dash="dash", width=1.5) for side in SIDES)
Arrays = Mapping[str, np.ndarray]


def write_design_page(folder: Path) -> Path:
    """Write report.html from the files in the folder of a study; nothing is solved. Raises `UserError` where it cannot be written."""
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    motions = {}
    for name in summary["configurations"]:
        with np.load(folder / f"{name}.npz") as file:
            motions[name] = {n: file[n] for n in file.files}
    pictures = {name: folder / f"arm_{name}.png" for name in motions}
    drawn = {name: base64.b64encode(path.read_bytes()).decode() for name, path in pictures.items() if path.is_file()}
    write_text(folder / "report.html", design_page(summary, motions, drawn))
    return folder / "report.html"


def design_page(summary: Mapping[str, Any], motions: Mapping[str, Arrays], pictures: Mapping[str, str]) -> str:
    """The page as HTML.

    Args:
        summary: The content of summary.json.
        motions: Arrays of each configuration's npz.
        pictures: PNG of the arm's motion in base64, of configurations that have one.
    """
    found, quantity, beside = summary["configurations"], Quantity(*summary["quantity"]), summary["paper"]
    best = say.best_of(found) or next(iter(found))
    data = {
        key(name, j): joint_columns(m, j, summary.get("limits", {}).get(joint, {}), POINTS)
        for name, m in motions.items()
        for j, joint in _joints(m)
    }
    captions = {k: captions_of(c) for k, c in data.items()}
    return render(
        "design.html",
        figures_of(BY, captions),
        {"motion": {k: columns(c) for k, c in data.items()}},
        summary=summary,
        quantity=quantity,
        best=best,
        verdict=say.verdict(summary),
        kinds=say.kinds_of_springs(found),
        ends=tell.ends_in_words(summary),
        cautions=say.cautions(summary),
        configurations=[(name, name) for name in found],
        joints=[(str(j), joint_words(joint)) for j, joint in _joints(motions[best])],
        optima=tell.optima_table(found, quantity, beside),
        columns_in_words=tell.columns_in_words(quantity, beside),
        decreases=tell.decrease_table(found, beside) if "SA" in found else None,
        hardware=tell.hardware_table(found, beside, summary["joints"]),
        symbols=say.symbols(found),
        certificates={name: _certificate(c, quantity, summary["joints"]) for name, c in found.items()},
        twin=tell.transfer_table(found),
        in_twin=say.in_twin(found, best),
        told={"twin": tell.transferred_in_words(found), "optima": tell.LOCAL_OPTIMA, "layers": tell.LAYERS},
        pictures=pictures,
    )


def _joints(motion: Arrays) -> list[tuple[int, str]]:
    return list(enumerate(motion["joints"].tolist()))


def _certificate(c: Mapping[str, Any], quantity: Quantity, joints: Sequence[str]) -> dict[str, Any]:
    return {
        "sentences": tell.certificate_sentences(dict(c), quantity),
        "bounds": [say.bound(bound["sentence"]) for bound in c["certificate"]["active"]],
        "coverage": tell.coverage(c["catalogue"]) if "catalogue" in c else None,
        "optima": tell.local_optima_table(dict(c), quantity, joints) if c.get("optima") else None,
        "layers": tell.layers_table(dict(c)) if c.get("layers") else None,
    }


def joint_columns(m: Arrays, j: int, limits: Mapping[str, Any], points: int) -> dict[str, np.ndarray]:
    """What the figures of one joint show, in degrees and Nm; the two phases meet at the instant of "release".

    Args:
        m: Arrays of a motion's npz.
        j: Row of the joint.
        limits: The joint's, as in summary.json.
        points: Of a curve, at most.
    """
    rows = {"t": m["t"], "q": np.degrees(m["q"][j]), "dq": np.degrees(m["dq"][j])}
    rows |= {"tau_load": m["tau_load"][j], "tau_spring": m["tau_spring"][j], "needed": m["tau_load"][j] + m["tau_spring"][j]}
    every = np.array(list(rows.values()))
    shown = dict(zip(rows, every[:, thinned(every, points, range(1, len(rows)))], strict=True))
    released = float(m["t"][m["phase"] == 0][-1])
    shown |= {"release": np.array([released, released]), "ends": m["t"][[0, -1]]}
    if not m["tau_spring"].any():  # without springs there is nothing to tell apart
        del shown["tau_spring"], shown["needed"]
    for name, of in QUANTITIES.items():
        values = [shown[n] for n in (name, "needed") if n in shown and (n == name or name == "tau_load")]
        low, high = float(np.min(values)), float(np.max(values))
        shown[f"{name}_span"] = np.array([low, high])
        bound, unit = limits.get(of), 1.0 if name == "tau_load" else 180 / np.pi
        both = bound if isinstance(bound, list) else [None, None] if bound is None else [-bound, bound]
        for side, value in zip(SIDES, both, strict=True):
            if value is not None and low - NEAR * (high - low) <= value * unit <= high + NEAR * (high - low):
                shown[f"{name}_{side}"] = np.full(2, value * unit)
    return shown


def figures_of(by: tuple[str, ...], captions: Mapping[str, Mapping[str, str]]) -> list[Figure]:
    """The figures of one joint; the data "motion" has its columns by the choices `by`, and `captions` what `captions_of` says."""

    def over_time(name: str, title: str, axis: str, row: str, *curves: Curve) -> Figure:
        marks = (RELEASE, *LIMITS)
        around = tuple(Curve(c.x, c.y.format(row), c.role, c.name, width=c.width, dash=c.dash) for c in marks)
        own = {k: c[name] for k, c in captions.items()}
        return Figure(name, title, "motion", by, ("time [s]", axis), (*curves, *around), own)

    return [
        over_time("angle", "Angle", "angle [°]", "q", Curve("t", "q", "load", "angle")),
        over_time("speed", "Speed", "speed [°/s]", "dq", Curve("t", "dq", "load", "speed")),
        over_time(
            "torque", "Load torque with and without the springs", "torque [Nm]", "tau_load",
            Curve("t", "needed", "needed", "without the springs, same motion"),
            Curve("t", "tau_spring", "spring", "springs"),
            Curve("t", "tau_load", "load", "load torque", width=2.5),
        ),
        Figure(
            "spring", "Torque of the springs over the angle", "motion", by, ("angle [°]", "torque [Nm]"),
            (
                Curve("q", "needed", "needed", "needed for the motion"),
                Curve("q", "tau_spring", "spring", "springs", width=2.5),
                Curve("q", "tau_load", "load", "load torque", width=1.2),
            ),
            {k: c["spring"] for k, c in captions.items()},
        ),
    ]  # fmt: skip


def captions_of(c: Arrays) -> dict[str, str]:
    """What to see in each figure of one joint."""
    t, load, fastest = c["t"], c["tau_load"], float(np.max(np.abs(c["dq"])))
    touched = any(f"dq_{side}" in c and fastest > 0.99 * abs(c[f"dq_{side}"][0]) for side in SIDES)
    said = {
        "angle": f"The joint moves from {c['q'][0]:.0f}° to {c['q'][np.searchsorted(t, c['release'][0])]:.0f}° in {c['release'][0]:.2f} s "
        f"with the payload and returns in {t[-1] - c['release'][0]:.2f} s without it, between {c['q'].min():.0f}° and {c['q'].max():.0f}°.",
        "speed": f"The joint turns with up to {fastest:.0f} °/s{', its limit' if touched else ''}, and rests at both ends of each phase.",
    }
    if "tau_spring" not in c:
        alone = f"No spring acts on this joint: its drive gives the whole torque, {_size(t, load)}."
        loop = "A spring would have to give the torque that this loop shows; where the loop is narrow, one spring can."
        return said | {"torque": alone, "spring": loop}
    needed, spring = c["needed"], c["tau_spring"]
    return said | {
        "torque": f"The same motion without the springs needs {_size(t, needed)}; with them the drive gives {_size(t, load)}.",
        "spring": f"The springs give {spring.min():.1f} to {spring.max():.1f} Nm; the drive gives only what is left between them and the "
        "torque that the motion needs.",
    }


def _size(t: np.ndarray, tau: np.ndarray) -> str:
    rms = np.sqrt(np.trapezoid(tau**2, t) / np.ptp(t))
    return f"{rms:.1f} Nm rms and {np.abs(tau).max():.1f} Nm at most"
