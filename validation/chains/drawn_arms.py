"""Do arms that are drawn from a diagnosis enclose recordings that took no part?

    python -m validation.chains.make --out cases --seed 21 --count 20
    python -m validation.chains.drawn_arms cases --out results/drawn_arms

Each case is diagnosed, and arms are drawn from its model as `rrr-oc export --samples` draws them. The recordings of another motion are
then predicted by each arm. Counted is, joint by joint, in which share of the rows the torque lies in the central 90 % of these:

- "true": the plant's own torque at its own motion, and the drawn arms alone;
- "recorded": the recorded torque, and the drawn arms with the noise that the model has.

Rows where a joint rests are left out, since dry friction may hold anything there, and rows of pushes, which are no part of the arm. A
case that is done is not done again.
"""

import argparse
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import norm

from rrr_oc.calibration.calibrated_model import CalibratedModel
from rrr_oc.calibration.model_file import load_model, save_model
from rrr_oc.commands.models.samples import samples
from rrr_oc.diagnosis.procedure import diagnose
from rrr_oc.model.motion import Motion
from rrr_oc.parallel import one_thread
from rrr_oc.recordings.reader import load_recordings
from rrr_oc.recordings.recording import Recording
from rrr_oc.storage import read_npz, write_json
from validation.chains.make import cases_of

INSIDE = 0.9  # share of the draws that a band holds
RESTS = 0.05  # [1] of a joint's largest speed, below which it counts as at rest
EVERY = 5  # rows, of which one is counted; with all nothing changes


def measured(folder: Path, model: CalibratedModel, count: int, seed: int) -> dict[str, Any]:
    """Share of the rows inside the bands, by kind and joint, mean over the recordings of a case that took no part."""
    truth = json.loads((folder / "sealed" / "truth.json").read_text())
    tests, known = load_recordings(folder / "recordings" / "test"), read_npz(folder / "sealed" / "missing.npz")
    drawn = list(samples(model, count, seed))
    arms = [one.model.placed(tests) for one in drawn]
    shares: dict[str, list[np.ndarray]] = {"true": [], "recorded": []}
    for r in tests.recordings:
        own = {name: known[f"test/{r.file}|{name}"].astype(float) for name in ("t", "q", "v", "a", "tau")}
        rows = counted(own["t"], own["v"], truth["events"].get(f"test/{r.file}", []), truth["joints"])
        exact = Recording.planned(r.file, Motion(own["t"], own["q"], own["v"], own["a"], np.zeros(own["t"].shape)))
        torques = np.array([prompt(arm, exact) for arm in arms])
        shares["true"].append(inside(torques, 0.0, own["tau"], rows))
        moving = np.array([np.interp(r.t, own["t"], one.astype(float)) > 0.5 for one in rows])
        predicted = np.array([arm.predicted_torque(r) for arm in arms])
        shares["recorded"].append(inside(predicted, model.noise, tests.output_torque(r), moving))
    joints = {kind: np.nanmean(found, axis=0).tolist() for kind, found in shares.items()}
    return {"case": truth["case"], "kind": truth["kind"], "refused": sum(one.refused for one in drawn), "inside": joints}


def prompt(model: CalibratedModel, exact: Recording) -> np.ndarray:
    """Torque at the sensor of a motion, without the delays of a chain of measurement, (n, K) [Nm]."""
    return model.output_torque(exact, replace(model.physics(exact), delays=(), waits=()))


def counted(t: np.ndarray, v: np.ndarray, events: Sequence[dict[str, Any]], joints: Sequence[str]) -> np.ndarray:
    """Rows (n, K) in which a joint moves and nothing pushes the arm."""
    pushed = np.zeros(t.shape, bool)
    for event in events:
        pushed |= (t >= event["from"]) & (t <= event["to"])
    return (np.abs(v) > RESTS * np.abs(v).max(axis=1, keepdims=True)) & ~pushed & np.ones((len(joints), 1), bool)


def inside(torques: np.ndarray, noise: np.ndarray | float, wanted: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Share of the counted rows in which a torque (n, K) is in the central part of torques (draws, n, K) with normal noise, (n,).

    The distribution function of draws with noise is the mean of theirs; NaN where no row counts.
    """
    std = np.broadcast_to(np.maximum(noise, 1e-12), (torques.shape[1],))[:, None]
    below = np.mean(norm.cdf((wanted - torques) / std), axis=0)
    share = np.abs(below - 0.5) <= INSIDE / 2
    return np.array([np.mean(one[k][::EVERY]) if k.any() else np.nan for one, k in zip(share, rows, strict=True)])


def table(results: Sequence[dict[str, Any]]) -> str:
    """A row for each case, and the means over joints of all and of those with a joint in which nothing is hidden."""
    kinds = ("true", "recorded")
    lines = [" | ".join(("case", "kind", "refused draws", *(f"inside: {kind}" for kind in kinds)))]
    lines.append(" | ".join(["---"] * 5))
    for r in results:
        cells = [", ".join(f"{100 * x:.0f}" for x in r["inside"][kind]) for kind in kinds]
        lines.append(" | ".join((r["case"], r["kind"], str(r["refused"]), *cells)))
    for what, some in (("all", results), ("clean", [r for r in results if r["kind"] == "clean"])):
        means = [np.nanmean(np.concatenate([r["inside"][kind] for r in some])) if some else np.nan for kind in kinds]
        lines.append(" | ".join((f"mean, {what}", "", "", *(f"{100 * x:.1f} %" for x in means))))
    return "\n".join(lines)


def once(folder: Path, out: Path, count: int, seed: int) -> dict[str, Any]:
    """The result of a case, whose model and result are kept."""
    file, result = out / folder.name / "model.json", out / folder.name / "inside.json"
    with one_thread():
        if not file.exists():
            save_model(diagnose(load_recordings(folder / "recordings")).model, file)
        if not result.exists():
            write_json(result, measured(folder, load_model(file), count, seed))
            print(folder.name, flush=True)
    return json.loads(result.read_text())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--samples", type=int, default=100, help="arms that are drawn for a case")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    print(table([once(folder, options.out, options.samples, options.seed) for folder in cases_of(options.cases)]))


if __name__ == "__main__":
    main()
