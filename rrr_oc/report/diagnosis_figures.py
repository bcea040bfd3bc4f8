"""The figures of a diagnosis, from the content of diagnosis.json and the data of `pages.diagnosis_curves`."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from rrr_oc.calibration.prediction_error import SIGNALS
from rrr_oc.diagnosis.diagnosis_file import DiagnosisFile
from rrr_oc.effects.words import joint_words
from rrr_oc.report.diagnosis_words import of_variable, same
from rrr_oc.report.figures import Curve, Figure, Panel, draw, key
from rrr_oc.report.pages.diagnosis_curves import LAW, LEFT, PREDICTED, Curves

SIGNAL_NAMES: dict[str, str] = dict(
    zip(SIGNALS, ("position", "speed", "acceleration", "motor torque", "load torque"), strict=True)
)
WIDE = 30.0  # ratio of errors from which only powers of ten are on the axis
MODELS = {"before": "plain model", "after": "extended model"}
ERROR = "error [% of the standard deviation]"  # of a figure's axis
BY = ("recording", "joint")
ALL = "all"  # the choice that joins the data of all recordings
PATCHES = "Patches of one colour are torque that the model does not explain; an even mixture of pale colours is noise."
DRIFT = "A drift or a step is torque that depends on time or on the recording, not on the motion alone."


def draw_errors(found: DiagnosisFile) -> Any:
    """Held-out error of each joint with its interval, before and after, and of the simulated torques where there are any."""
    return draw([[Panel(figure, "") for figure in errors(found)]], (3.9, 0.42 * len(found.bootstrap) + 1.0), share=True)


def draw_prediction(curves: Curves) -> Any:
    """Torque of each joint in the recording that the plain model predicts worst, and what both models make of it, held out."""
    figure, k = prediction(curves), int(curves["worst"])
    file = str(curves["files"][k])
    titles = [f"{joint_words(joint)}, {file}" for joint in curves["joints"].tolist()]
    return draw([[Panel(figure, key(k, j), title)] for j, title in enumerate(titles)], (11, 1.8))


def diagnosis_figures(found: DiagnosisFile, curves: Curves, titles: Sequence[str] = ()) -> list[Figure]:
    """The figures of the page.

    Args:
        titles: Of the claims.
    """
    return [*errors(found), prediction(curves), *_left(curves), *_laws(curves, titles)]


def _laws(curves: Curves, titles: Sequence[str]) -> list[Figure]:
    """The torque of each claim over what was recorded of it."""
    figures = []
    for i, title in enumerate(titles):
        x, low, high, law = curves.get(f"law {i}", np.empty((len(LAW), 0)))
        if not len(x):
            continue
        factor, words = of_variable(str(curves["over"][i]))
        shown = (
            Curve("x", "law", "after", "the law", band=("low", "high")),
            Curve("x", "low", "recorded", "recorded, less all else", width=1),
            Curve("x", "high", "recorded", "recorded, less all else", width=1),
        )
        inside = float(np.mean((low <= law) & (law <= high)))
        said = (
            "The band holds 95 % of what is left of the recorded torque once all else is taken away; the law "
            f"{'lies in it' if inside == 1 else f'lies in it over {100 * inside:.0f} % of the axis'}."
        )
        data = {"": {"x": factor * x, "low": low, "high": high, "law": law}}
        name, head, axes = f"law_{i}", f"The law: {title[:1].lower()}{title[1:]}", (words, "torque [Nm]")
        figures.append(Figure(name, head, axes, shown, data, name, {"": said}, height=300))
    return figures


def errors(found: DiagnosisFile) -> list[Figure]:
    """Held-out errors before and after: of the prediction, and of the simulated torques where there are any."""
    joints, simulated = list(found.bootstrap), found.simulated
    models = {"before": MODELS["before"]} if same(found) else MODELS
    own = {k: [(b.value, b.interval) for b in (getattr(found.bootstrap[j], k) for j in joints)] for k in models}
    said = "A dot further left is a smaller error; a line is its 95 % interval."
    figures = [_errors(("errors", "Predicted from the motion", said), joints, own, models)]
    if simulated is None or all("why_not" in getattr(simulated, k) for k in MODELS):
        return figures
    for signal in ("tau_motor", "tau_load"):
        own = {k: [(getattr(simulated, k).get(joint, {}).get(signal), None) for joint in joints] for k in models}
        name = SIGNAL_NAMES[signal]
        said = f"The error of the {name} while the MuJoCo model tracks the recorded motion with its controllers."
        figures.append(_errors((signal, f"In closed loop: {name}", said), joints, own, models))
    return figures


def _errors(
    words: tuple[str, str, str], joints: Sequence[str], entries: Mapping[str, Sequence[Any]], models: Mapping[str, str]
) -> Figure:
    """Errors by joint.

    Args:
        words: Name, title and caption.
        joints: Names.
        entries: Of each model a value and its interval or None by joint, None where it is not known [1].
        models: What the models are called.
    """
    name, title, said = words
    columns: dict[str, Any] = {"joint": [joint_words(joint) for joint in joints]}
    for k, pairs in entries.items():
        values = 100 * np.array([value for value, _ in pairs], float)
        known = [i if i and None not in i else (value, value) for value, i in pairs]
        low, high = 100 * np.array(known, float).reshape(-1, 2).T
        columns |= {k: values, f"{k}_below": _up(values - low), f"{k}_above": _up(high - values)}
    curves = tuple(Curve(k, "joint", k, said, "markers", 10, bars=(f"{k}_below", f"{k}_above")) for k, said in models.items())
    ends = np.concatenate(
        [e for k in entries for e in (columns[k] - columns[f"{k}_below"], columns[k] + columns[f"{k}_above"])]
    )
    figure = Figure(name, title, (ERROR, ""), curves, {"": columns}, name, {"": said}, log="x", names=True)
    return replace(figure, ticks=_ticks(ends), height=130 + 34 * len(joints))


def _up(widths: np.ndarray) -> np.ndarray:
    """Widths of at least 0; of what is not known 0."""
    return np.nan_to_num(np.maximum(widths, 0.0))


def _ticks(ends: np.ndarray) -> tuple[float, ...]:
    """Where an axis of these errors has numbers: at powers of ten if the errors are far apart, else closer, so that two are between them."""
    positive = ends[ends > 0]
    low, high = (float(positive.min()), float(positive.max())) if positive.size else (1.0, 1.0)
    decades = range(math.floor(math.log10(low)) - 1, math.ceil(math.log10(high)) + 2)
    for steps in ((1,), (1, 2, 5), range(1, 10)):
        ticks = tuple(float(f"{m}e{d}") for d in decades for m in steps)
        if high > WIDE * low or (len(steps) > 1 and sum(low <= tick <= high for tick in ticks) > 1):
            return ticks
    return tuple(sorted({float(f"{value:.2g}") for value in (low, high)}))


def prediction(curves: Curves) -> Figure:
    """Torques over time by recording and joint."""
    shown = (
        Curve("t", "recorded", "recorded", "recorded", width=5),
        Curve("t", "before", "before", MODELS["before"], width=1.5),
        Curve("t", "after", "after", MODELS["after"], width=1.5),
    )
    pairs = [
        (k, j) for k in range(len(curves["files"])) for j in range(len(curves["joints"])) if f"predicted {k} {j}" in curves
    ]
    data = {key(k, j): dict(zip(PREDICTED, curves[f"predicted {k} {j}"], strict=True)) for k, j in pairs}
    captions = {
        key(*at): f"The closer a curve lies to the grey one, the better. {_missed(*curves['missed'][at])}" for at in pairs
    }
    axes = ("time [s]", "torque [Nm]")
    return Figure("prediction", "Recorded and predicted torque", axes, shown, data, "predicted", captions, BY)


def _missed(before: float, after: float) -> str:
    """Rms of what each model misses [Nm], in a sentence."""
    if before == after:
        return f"Both models are the same here; they miss the torque by {before:.3g} Nm rms."
    return f"The plain model misses the torque by {before:.3g} Nm rms, the extended model by {after:.3g} Nm rms."


def _left(curves: Curves) -> list[Figure]:
    """What is left of a joint's torque over position, load and time, with the plain and, if that is another, with the extended model."""
    count, n, data = len(curves["files"]), len(curves["joints"]), {}
    for j in range(n):
        own = [dict(zip(LEFT, curves[f"left {k} {j}"], strict=True)) for k in range(count)]
        ends = np.concatenate([columns["residual_before"] for columns in own])
        limit = np.array([max(float(np.nanquantile(np.abs(ends), 0.98)), 1e-9)])
        data |= {key(k, j): {**columns, "limit": limit} for k, columns in enumerate(own)}
        data[key(ALL, j)] = {"joined": [key(k, j) for k in range(count)]}
    remains, figures = curves["remains"], []  # rms [Nm], (recordings, n, 2)
    whole = np.sqrt(np.average(remains**2, axis=0, weights=curves["samples"]))
    different = not np.array_equal(remains[..., 0], remains[..., 1])
    for i, (model, words) in enumerate(list(MODELS.items())[: 1 + different]):
        sizes = {key(k, j): remains[k, j, i] for k in range(count) for j in range(n)}
        sizes |= {key(ALL, j): whole[j, i] for j in range(n)}
        residual = f"residual_{model}"
        for name, over, axes, curve, see in (
            ("position", "over position and speed", ("position [rad]", "speed [rad/s]"), _cloud("q", residual), PATCHES),
            ("load", "over load and speed", ("load torque [Nm]", "speed [rad/s]"), _cloud(f"load_{model}", residual), PATCHES),
            ("time", "over time", ("time since start [s]", "residual [Nm]"), Curve("t", residual, model, "", "markers", 3), DRIFT),
        ):  # fmt: skip
            captions = {k: f"{size:.3g} Nm rms are left. {see}" for k, size in sizes.items()}
            title, limit = f"{words.capitalize()}, {over}", "limit" if curve.colour else ""
            figures.append(
                Figure(f"{name}_{model}", title, axes, (curve,), data, "left", captions, ("shown", "joint"), limit=limit)
            )
    return figures


def _cloud(x: str, residual: str) -> Curve:
    return Curve(x, "dq", mode="markers", width=4, colour=residual)
