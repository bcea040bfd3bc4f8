"""What does a calibration say of arms whose recordings passed a chain of measurement?

    python -m validation.chains.make --out cases --count 48
    python -m validation.chains.calibrations cases --out results/chains

Intervals of dry friction, viscous friction and rotors are compared with the truth, and the error on recordings of another motion with
that of the true bodies and parameters in the same model. Effects that are hidden are in neither. A case that is done is not done again.
"""

import argparse
import json
import time
import traceback
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from rrr_oc.calibration.calibrate import calibrate
from rrr_oc.calibration.calibrated_model import CalibratedModel
from rrr_oc.calibration.inverse_dynamics import plain_model
from rrr_oc.calibration.prediction_error import evaluate_inverse
from rrr_oc.parallel import one_thread
from rrr_oc.recordings.reader import load_recordings
from rrr_oc.recordings.recording import RecordingSet
from rrr_oc.robot.robot import load_robot
from rrr_oc.storage import write_json
from validation.chains.make import cases_of

TRUE = {"dry_friction": "dry", "viscous_friction": "viscous", "armature": "rotor"}
SHARP = 0.005  # [rad/s], width of the sign of friction that a constraint makes
HEAD = ("cases", "failed", "dry", "viscous", "rotor", "error of dry", "of rotor", "NRMSE", "of the truth", "ratio", "seconds")


def calibrated(folder: Path) -> dict[str, Any]:
    """Parameters with their intervals beside the truth, errors beside those of the true arm, and the time."""
    truth = json.loads((folder / "sealed" / "truth.json").read_text())
    result: dict[str, Any] = {"case": truth["case"], "kind": truth["kind"], "effects": [e["effect"] for e in truth["effects"]]}
    began = time.process_time()
    try:
        recordings = load_recordings(folder / "recordings")
        model = calibrate(recordings)
        result["seconds"] = time.process_time() - began
        tests = load_recordings(folder / "recordings" / "test")
        best = true_model(tests, truth, folder / "sealed" / "true.urdf")
        errors = {"model": evaluate_inverse(model, tests), "truth": evaluate_inverse(best, tests)}
        return result | {"parameters": list(parameters(model, truth)), "errors": errors, "links": model.report["link_findings"]}
    except Exception:
        return result | {"failed": traceback.format_exc(), "seconds": time.process_time() - began}


def parameters(model: CalibratedModel, truth: dict[str, Any]) -> Iterable[dict[str, Any]]:
    """Of the plain model, with the truth."""
    for term in model.terms:
        name = TRUE.get(term.effect.name)
        if name:
            (j,), (found,) = term.effect.joints, term.estimates
            joint = model.joints[j]
            yield {"kind": name, "joint": joint, "true": truth[name][joint], "value": found.value, "interval": found.interval}


def true_model(recordings: RecordingSet, truth: dict[str, Any], urdf: Path) -> CalibratedModel:
    """The plain model with the true bodies, friction and rotors."""
    model = plain_model(recordings)
    robot = replace(model.robot, inertial=load_robot(urdf, model.joints, True, tuple(recordings.gravity)).inertial)
    terms = []
    for term in model.terms:
        name, joint = TRUE.get(term.effect.name), model.joints[term.effect.joints[0]]
        values = term.values if name is None else np.array([truth[name][joint]])
        terms.append(replace(term.with_values(values), width=term.width and (truth["sign_width"] or SHARP)))
    return replace(model, robot=robot, terms=tuple(terms))


def row(results: Sequence[dict[str, Any]]) -> list[str]:
    """A family's row of the table."""
    done = [r for r in results if "failed" not in r]
    found = [p for r in done for p in r["parameters"]]
    cells = [str(len(results)), str(len(results) - len(done))]
    for kind in TRUE.values():
        some = [p for p in found if p["kind"] == kind]
        holds = [p["interval"] is not None and p["interval"][0] <= p["true"] <= p["interval"][1] for p in some]
        cells.append(f"{sum(holds)} of {len(some)}")
    for kind in ("dry", "rotor"):
        off = [abs(p["value"] / p["true"] - 1) for p in found if p["kind"] == kind and p["true"] > 0]
        cells.append(f"{100 * np.median(off):.1f} %" if off else "–")
    pairs = np.array([pair for r in done for pair in error_pairs(r["errors"])]).reshape(-1, 2)
    if len(pairs):
        cells += [f"{x:.3f}" for x in np.median(pairs, axis=0)] + [f"{np.median(pairs[:, 0] / pairs[:, 1]):.2f}"]
    else:
        cells += ["–"] * 3
    return [*cells, f"{np.median([r['seconds'] for r in results]):.1f}"]


def error_pairs(errors: dict[str, Any]) -> Iterable[tuple[float, float]]:
    """NRMSE of the model and of the true arm, joint by joint, root mean square over the recordings."""
    files = list(errors["model"])
    for joint in errors["model"][files[0]]:
        pair = [[errors[who][file][joint]["nrmse"] for file in files] for who in ("model", "truth")]
        if all(x is not None for one in pair for x in one):
            yield tuple(float(np.sqrt(np.mean(np.square(one)))) for one in pair)  # pyright: ignore[reportReturnType]


def table(results: Sequence[dict[str, Any]]) -> str:
    """By family, and for arms with nothing missing alone."""
    groups: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for r in results:
        family = r["case"].split("-")[0]
        groups[family].append(r)
        groups[f"{family}, {'clean' if r['kind'] == 'clean' else 'not clean'}"].append(r)
    lines = [" | ".join(("family", *HEAD)), " | ".join(["---"] * (len(HEAD) + 1))]
    return "\n".join([*lines, *(" | ".join((name, *row(some))) for name, some in sorted(groups.items()))])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    results = []
    for folder in cases_of(options.cases):
        file = options.out / "calibrations" / f"{folder.name}.json"
        if not file.exists():
            with one_thread():
                write_json(file, json.loads(json.dumps(calibrated(folder))))
            print(folder.name, flush=True)
        results.append(json.loads(file.read_text()))
    print(table(results))


if __name__ == "__main__":
    main()
