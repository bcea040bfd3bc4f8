"""What the plain model of the paper's own arm leaves out, found on its public recordings, as labelled and with labels removed:

python studies/prototype_recordings.py DATASET [--out results/prototype_recordings] [--variant NAME ...]

DATASET is the set that `rrr-oc import prototype` makes. Variants: `labelled` (all labels as they are), `no_payload` (the tool must
find which recordings carried a payload, and how much), `no_springs` (which had springs, and how stiff), `bare` (the recordings
without payload and springs: neither may be invented). A variant that is done is not done again.

Beside the repaired model stands what flexible regressions with no physics of their own make of the plain model's residual, trained on
the same recordings and held to the same others: boosted trees, and a ridge over splines.
"""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from sklearn.ensemble import HistGradientBoostingRegressor
from sklearn.linear_model import RidgeCV
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import PolynomialFeatures, SplineTransformer, StandardScaler

from rrr_oc.calibration.calibrated_model import CalibratedModel
from rrr_oc.calibration.prediction_error import error
from rrr_oc.calibration.samples import Prepared, prepare
from rrr_oc.diagnosis.procedure import diagnose
from rrr_oc.diagnosis.result import Diagnosis
from rrr_oc.errors import entry_point
from rrr_oc.parallel import one_thread
from rrr_oc.recordings.reader import load_recordings
from rrr_oc.recordings.recording import RecordingSet
from rrr_oc.report.diagnosis_report import write_diagnosis
from rrr_oc.report.tables import markdown
from rrr_oc.storage import Made, write_json, write_text

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from validation.prototype_labels import VARIANTS, variant

THINNED = 4  # samples for one that a black box is trained on
console = Console()


def boosted_trees() -> HistGradientBoostingRegressor:
    """A regression for one joint; nothing is tuned to a set by hand."""
    return HistGradientBoostingRegressor(max_iter=200, learning_rate=0.05, random_state=0)


def diagnosed(recordings: RecordingSet, name: str, out: Path) -> dict[str, Any]:
    """Diagnose a variant, write its report, return the content of its diagnosis.json."""
    folder = out / name
    done, boxes = folder / "diagnosis.json", folder / "black_box.json"

    def make() -> None:
        console.rule(name)
        with one_thread():
            found = diagnose(variant(recordings, name), lambda step: console.print(step.said, highlight=False))
        write_json(boxes, black_boxes(found))
        write_diagnosis(found, folder)

    Made([done, boxes], name, [Path(__file__), *recordings.files]).once(make)
    return json.loads(done.read_text(encoding="utf-8")) | {"black_box": json.loads(boxes.read_text(encoding="utf-8"))}


def black_boxes(diagnosis: Diagnosis) -> dict[str, dict[str, float]]:
    """NRMSE of each joint on the recordings that each fold of the diagnosis held out, by black box and joint."""
    joints, prepared = diagnosis.model.joints, prepare(diagnosis.recordings)
    kinds = {
        "boosted trees": boosted_trees,
        "ridge over splines": lambda: make_pipeline(
            StandardScaler(), SplineTransformer(8), PolynomialFeatures(1), StandardScaler(), RidgeCV(np.logspace(-2, 6, 17))
        ),
    }
    found = {}
    for name, make in kinds.items():
        errors = []
        for fold in diagnosis.folds if diagnosis.way == "recordings" else ():
            train, test = ([p for i, p in enumerate(prepared) if (i in fold.held) == held] for held in (False, True))
            x = np.concatenate([_features(p, fold.plain)[::THINNED] for p in train])
            y = np.concatenate([(p.measured - fold.plain.output_torque(p.recording)).T[::THINNED] for p in train])
            boxes = [make().fit(x, column) for column in y.T]
            for p in test:
                there, r = _features(p, fold.plain), p.recording
                predicted = fold.plain.output_torque(r) + np.array([box.predict(there) for box in boxes])
                errors.append(error(r.t, p.measured, predicted, r.segments)["nrmse"])
        found[name] = dict(zip(joints, map(float, np.mean(errors, axis=0)), strict=True)) if errors else {}
    return found


def _features(prepared: Prepared, plain: CalibratedModel) -> np.ndarray:
    """What a residual may depend on, (K, features): motion, direction, payload, listed springs, load and predicted torque, time."""
    r = prepared.recording
    springs = np.full(len(r.t), float(len(r.springs)))
    return np.vstack([r.q, r.dq, r.ddq, np.tanh(r.dq / 0.05), *plain.torques(r), r.payload, springs, r.t - r.t[0]]).T


def report(recordings: RecordingSet, found: dict[str, dict[str, Any]]) -> str:
    """Effects and errors of all variants in Markdown."""
    carried = [r.file for r in recordings.recordings if r.payload.any()]
    sprung = [r.file for r in recordings.recordings if r.springs]
    parts = [
        "# The prototype's recordings diagnosed\n",
        f"Labels: a payload in {', '.join(carried) or 'none'}; springs in {', '.join(sprung) or 'none'}.\n",
    ]
    for name, content in found.items():
        rows = []
        for e in content["effects"]:
            values = ", ".join(f"{k} {_value(v['value'])} {v['unit']}" for k, v in e["parameters"].items() if "value" in v)
            where = e["recordings"] if isinstance(e["recordings"], str) else ", ".join(e["recordings"])
            rows.append([e["effect"], str(e["joint"]), where, values, f"{e['lowers_error']['share']:.3f}"])
        for u in content["unexplained"]:
            size, depends = f"{u['lowers_error']['share']:.3f}", ", ".join(u["depends_on"])
            rows.append(["unexplained", u["joint"], str(u["recordings"]), depends, size])
        held = content["nrmse"]["held_out"]
        boxes = content["black_box"]
        errors = [
            [j, f"{held['before'][j]:.3f}", f"{held['after'][j]:.3f}", f"{held['after'][j] / held['before'][j]:.2f}"]
            + [f"{box[j] / held['before'][j]:.2f}" if box else "" for box in boxes.values()]
            for j in held["before"]
        ]
        parts += [
            f"## {name}\n",
            markdown(["effect", "joint", "recordings", "parameters", "lowers the error by"], rows),
            markdown(["joint", "NRMSE held out, plain", "extended", "ratio", *(f"ratio of {box}" for box in boxes)], errors),
        ]
    return "\n".join(parts)


def _value(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--out", type=Path, default=Path("results/prototype_recordings"))
    parser.add_argument("--variant", nargs="+", choices=VARIANTS, default=list(VARIANTS))
    options = parser.parse_args()
    recordings = load_recordings(options.dataset)
    found = {name: diagnosed(recordings, name, options.out) for name in options.variant}
    write_json(options.out / "summary.json", found)
    text = report(recordings, found)
    write_text(options.out / "report.md", text)
    console.print(text, highlight=False, markup=False)


run = entry_point(main)

if __name__ == "__main__":
    run()
