"""Do peers find what a calibrated model lacks? Sealed cases, the same for all, against the truth that is opened afterwards.

    python validation/concealed/make_cases.py --out cases --only single --seed 5001 --limit 20
    python validation/peers/discovery.py cases --out results/peers

A peer is given what the plain calibrated model leaves of the recorded torque, and looks for terms that explain it: in a textbook's
library, and in that of the diagnosis's own signatures (`library.py`); how it is set up is in `regressions.py`. The project's tool is
run by its own command. A case's result is in OUT/discovery/<way>/<case>.json when it is whole, so that an interrupted run goes on
where it was. Times are processor times of one process.

`--sets` takes recordings of real arms, folders with `train` and `test`, for the error on `test` alone.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")  # before numpy: processor times of one thread
ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

import numpy as np  # noqa: E402

from rrr_oc.calibration.calibrated_model import CalibratedModel  # noqa: E402
from rrr_oc.calibration.model_file import load_model  # noqa: E402
from rrr_oc.calibration.prediction_error import error, evaluate_inverse  # noqa: E402
from rrr_oc.calibration.samples import residuals  # noqa: E402
from rrr_oc.recordings.header import HEADER  # noqa: E402
from rrr_oc.recordings.reader import load_recordings  # noqa: E402
from rrr_oc.recordings.recording import Recording, RecordingSet  # noqa: E402
from rrr_oc.storage import write_json  # noqa: E402
from validation.peers.library import (  # noqa: E402
    EVERY,
    INPUTS,
    OTHERS,
    Meaning,
    Plain,
    Problem,
    prepared_unseen,
    raw_inputs,
    signatures,
    textbook,
)
from validation.peers.regressions import ON_SIGNATURES, ON_TEXTBOOK, SPARSE, boosted  # noqa: E402

OURS, PEERS = "rrr_oc", "peers"
Predict = Callable[[Recording], np.ndarray]


# --- the project's own tool ---


def diagnosed(data: Path, unseen: RecordingSet) -> dict[str, Any]:
    """Claims of `rrr-oc diagnose`, most important first, its error on unseen recordings, and its processor time [s]."""
    with tempfile.TemporaryDirectory() as folder:
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        command = [
            sys.executable,
            "-m",
            "rrr_oc",
            "diagnose",
            str(data),
            "--out",
            folder,
            "--jobs",
            "1",
            "--no-simulate",
            "--quiet",
        ]
        subprocess.run(command, check=True, env=os.environ | {"PYTHONPATH": str(ROOT), "MPLBACKEND": "Agg"})
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        found = json.loads((Path(folder) / "diagnosis.json").read_text(encoding="utf-8"))
        nrmse = of_model(load_model(Path(folder) / "model.json"), unseen)
    claims = [{"effects": [e["effect"]], "joint": e["joint"], "rivals": e["rivals"]} for e in found["effects"]]
    claims += [{"effects": [], "joint": e["joint"], "depends_on": e["depends_on"]} for e in found["unexplained"]]
    seconds = sum(getattr(after, key) - getattr(before, key) for key in ("ru_utime", "ru_stime"))
    return {"claims": claims, "nrmse": nrmse, "seconds": seconds}


def of_model(model: CalibratedModel, unseen: RecordingSet) -> float:
    """NRMSE of the predicted torque, mean over recordings and joints that move."""
    errors = evaluate_inverse(model, unseen).values()
    return float(np.mean([joint["nrmse"] for one in errors for joint in one.values() if joint["nrmse"] is not None]))


# --- peers ---


def compared(data: Path, unseen: RecordingSet) -> dict[str, Any]:
    """The plain model, and every peer's claims, error on unseen recordings, and processor time [s]."""
    began = time.process_time()
    plain = Plain.of(load_recordings(data))
    prepared = time.process_time() - began
    result: dict[str, Any] = {"plain": of_model(plain.model, unseen), "prepare_s": prepared, "ways": {}}
    for library, names in (("textbook", ON_TEXTBOOK), ("signatures", ON_SIGNATURES)):
        began = time.process_time()
        problems = textbook(plain) if library == "textbook" else [signatures(plain)]
        made = time.process_time() - began
        for name in names:
            began = time.process_time()
            found = [SPARSE[name](problem) for problem in problems]
            spent = time.process_time() - began
            claims = claimed(problems, found)
            predict = summed([(p.predict, c) for p, c in zip(problems, found, strict=True)])
            result["ways"][f"{name}; {library}"] = {
                "claims": claims,
                "nrmse": corrected(plain, unseen, predict),
                "seconds": spent + made,
            }
    result["ways"]["scikit-learn, boosted trees"] = by_trees(plain, unseen)
    return result


def claimed(problems: Sequence[Problem], found: Sequence[np.ndarray]) -> list[dict[str, Any]]:
    """What the terms that are kept mean, those that explain the largest torque first, as a multiple of the noise."""
    claims = []
    for problem, coefficients in zip(problems, found, strict=True):
        for group in np.unique(problem.group[np.flatnonzero(coefficients)]).tolist():
            own = np.flatnonzero(problem.group == group)
            size = np.sqrt(np.mean(np.concatenate([part[:, own] @ coefficients[own] for part in problem.x]) ** 2))
            meaning: Meaning = problem.meanings[group]
            if meaning.effects:
                claims.append({"effects": list(meaning.effects), "joint": meaning.joint, "weight": float(size)})
    return sorted(claims, key=lambda c: -c["weight"])


def summed(parts: Sequence[tuple[Callable[[Recording, np.ndarray], np.ndarray], np.ndarray]]) -> Predict:
    """The sum of predictions (n, K) [Nm]."""
    return lambda recording: np.sum([predict(recording, coefficients) for predict, coefficients in parts], axis=0)


def corrected(plain: Plain, unseen: RecordingSet, predict: Predict) -> float:
    """As `of_model`, of the plain model with a prediction of what it leaves added to it."""
    model, errors = plain.model.placed(unseen), []
    for r, sharp in zip(unseen.recordings, prepared_unseen(unseen), strict=True):
        whole = model.output_torque(r) + predict(sharp)
        errors.append(error(r.t, unseen.output_torque(r), whole, r.segments)["nrmse"])
    return float(np.nanmean(errors))


def by_trees(plain: Plain, unseen: RecordingSet) -> dict[str, Any]:
    """Boosted trees: joints by the share that trees explain, in noise; each with the input that matters most."""
    began, names = time.process_time(), plain.recordings.joints
    parts = plain.data.prepared
    left = [residuals(p, plain.model) for p in parts]
    inputs = [raw_inputs(p.recording, plain.model, names) for p in parts]
    claims, models = [], []
    for j, joint in enumerate(names):
        rows = [np.flatnonzero(p.moving[j])[::EVERY] for p in parts]
        y = [part[j, k] / plain.noise[j] for part, k in zip(left, rows, strict=True)]
        model, gain, important = boosted([part[k] for (part, _), k in zip(inputs, rows, strict=True)], y)
        models.append(model)
        if model is not None:
            kind, other = inputs[0][1][int(np.argmax(important))]
            of = joint if other in (None, joint) else [joint, other]
            effects = INPUTS[kind] if other in (None, joint) else OTHERS
            weight = float(np.sqrt(gain * np.mean(np.concatenate(y) ** 2)))
            claims.append({"effects": list(effects), "joint": of, "weight": weight})
    spent = time.process_time() - began

    def predict(recording: Recording) -> np.ndarray:
        x = raw_inputs(recording, plain.model, names)[0]
        return np.array([np.zeros(len(x)) if m is None else m.predict(x) * s for m, s in zip(models, plain.noise, strict=True)])

    nrmse = corrected(plain, unseen, predict)
    return {"claims": sorted(claims, key=lambda c: -c["weight"]), "nrmse": nrmse, "seconds": spent}


# --- all cases, and real arms ---


def places(cases: Path | None, sets: Sequence[Path]) -> Iterator[tuple[str, Path, Path]]:
    """Name, folder that may be seen, and folder that may not, of each case and set; arms of fewer joints, which are quick, first."""
    if cases is not None:
        whole = [f.parent for f in cases.glob("*/data") if (cases / "sealed" / f"{f.parent.name}.json").is_file()]
        for folder in sorted(whole, key=lambda f: (joints(f), f.name)):
            yield folder.name, folder / "data", folder / "unseen"
    for folder in sets:
        yield f"real_{folder.name}", folder / "train", folder / "test"


def joints(case: Path) -> int:
    """Number of joints that a case's recordings have."""
    return len(json.loads((case / "data" / HEADER).read_text(encoding="utf-8"))["joints"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", type=Path, nargs="?", help="a folder that validation/concealed/make_cases.py made")
    parser.add_argument("--out", type=Path, default=Path("results/peers"))
    parser.add_argument("--way", choices=(OURS, PEERS), nargs="*", default=[OURS, PEERS], help="which of the two to run")
    parser.add_argument("--sets", type=Path, nargs="*", default=[], help="folders of real arms, each with train and test")
    options = parser.parse_args()
    for name, seen, hidden in places(options.cases, options.sets):
        for way in options.way:
            path = options.out / "discovery" / way / f"{name}.json"
            if path.exists():
                continue
            unseen = load_recordings(hidden)
            write_json(path, (diagnosed if way == OURS else compared)(seen, unseen) | {"case": name})
            print(f"{name}: {way}", flush=True)


if __name__ == "__main__":
    main()
