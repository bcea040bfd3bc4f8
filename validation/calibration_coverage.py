"""Do 95 % intervals of a calibration hold the truth 95 % of the time?

    python validation/calibration_coverage.py --repetitions 500 --out results/coverage

Short data sets of an independent plant (numeric Pinocchio, friction written out here) with encoder quantisation, jittered and lost
samples, and torque noise of which a third is correlated over 50 ms. Every repetition draws its motions, friction and noise
anew. Coverage is pooled over all parameters and repetitions, with its own interval; so is it by kind of parameter.
"""

import json
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import pinocchio as pin
import typer
from rich.console import Console
from rich.table import Table
from scipy.stats import beta

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

# pyright: reportAttributeAccessIssue=false
# (pin's wheel has no stubs)

from rrr_oc.calibration.calibrate import calibrate
from rrr_oc.calibration.parameter_vector import labels
from rrr_oc.commands.shared import Jobs
from rrr_oc.model.motion import Motion
from rrr_oc.numerics.savitzky_golay import differentiate, split
from rrr_oc.parallel import ordered, workers
from rrr_oc.recordings.recording import Recording, RecordingSet
from rrr_oc.robot.robot import Robot, load_robot
from rrr_oc.storage import write_json

WIDTH = 0.05  # [rad/s], of the plant's dry friction
STEP = 0.01  # [s]
console = Console()


def motion(n: int, t: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A multisine per joint with its exact derivatives, (n, K) each."""
    q, dq, ddq = np.zeros((3, n, t.size))
    for f in rng.uniform(0.1, 0.6, (4, n)):  # [Hz]
        w, phase = 2 * np.pi * f[:, None], rng.uniform(0, 2 * np.pi, (n, 1))
        a = rng.uniform(0.1, 0.4, (n, 1))  # [rad]
        q += a * np.sin(w * t + phase)
        dq += a * w * np.cos(w * t + phase)
        ddq -= a * w**2 * np.sin(w * t + phase)
    return q, dq, ddq


def noise(shape: tuple[int, int], deviation: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """White noise with a third of its variance correlated over 50 ms, (n, K) [Nm]."""
    keep, slow, drive = np.exp(-STEP / 0.05), np.zeros(shape), rng.standard_normal(shape)
    slow[:, 0] = drive[:, 0]
    for k in range(1, shape[1]):
        slow[:, k] = keep * slow[:, k - 1] + np.sqrt(1 - keep**2) * drive[:, k]
    return deviation[:, None] * (np.sqrt(2 / 3) * rng.standard_normal(shape) + np.sqrt(1 / 3) * slow)


def record(
    model: pin.Model, truth: np.ndarray, seconds: float, name: str, rng: np.random.Generator, width: float = WIDTH
) -> Recording:
    """One recording: `truth` (3, n) holds dry friction, viscous friction and armature; `width` [rad/s] is of the dry friction."""
    t = np.arange(round(seconds / STEP)) * STEP + rng.uniform(-0.15, 0.15, round(seconds / STEP)) * STEP
    t = t[rng.random(t.size) > 0.02]
    q, dq, ddq = motion(model.nq, t, rng)
    data = model.createData()
    tau = np.array([pin.rnea(model, data, *x) for x in zip(q.T, dq.T, ddq.T, strict=True)]).T  # pyright: ignore
    tau = tau + truth[0, :, None] * np.tanh(dq / width) + truth[1, :, None] * dq + truth[2, :, None] * ddq
    tau += noise(tau.shape, 0.02 * tau.std(axis=1), rng)
    count = 2 * np.pi / 2**18
    seen = count * np.round((q + 1e-5 * rng.standard_normal(q.shape)) / count)
    segments = split(t)
    computed = tuple(f"{kind}_{joint}" for kind in ("dq", "ddq") for joint in list(model.names)[1:])
    rates = differentiate(t, seen, segments), differentiate(t, seen, segments, 2)
    planned = Recording.planned(name, Motion(t, seen, *rates, np.zeros(t.size), segments))
    return replace(planned, tau=tau, computed=computed)


def repetition(seed: int, urdf: str, count: int, seconds: float) -> dict[str, tuple[float, float, float, float]]:
    """By parameter: truth, estimate and interval."""
    rng = np.random.default_rng(seed)
    robot: Robot = load_robot(urdf)
    model = pin.buildModelFromUrdf(str(Path(__file__).parents[1] / "rrr_oc" / "urdf" / f"{urdf}.urdf"))
    truth = rng.uniform([[2], [2], [0.05]], [[6], [20], [0.4]], (3, robot.n))
    recordings = tuple(record(model, truth, seconds, f"{i}.csv", rng) for i in range(count))
    whole = RecordingSet(robot, urdf, "motor", "nominal", robot.tool, (None,) * robot.n, recordings, Path())
    found = calibrate(replace(whole))
    estimates = [e for term in found.terms for e in term.estimates]
    return {
        name: (float(true), e.value, *e.interval)  # pyright: ignore
        for name, true, e in zip(labels(found), truth.T.ravel(), estimates, strict=True)
    }


def share(hits: np.ndarray) -> tuple[float, float, float]:
    """A share and its 95 % interval (Clopper–Pearson)."""
    k, n = int(hits.sum()), hits.size
    return k / n, float(beta.ppf(0.025, k, n - k + 1)), float(beta.ppf(0.975, k + 1, n - k) if k < n else 1.0)


def main(
    repetitions: Annotated[int, typer.Option(min=1)] = 500,
    recordings: Annotated[int, typer.Option(min=1)] = 4,
    seconds: Annotated[float, typer.Option(min=2.0)] = 10.0,
    robot: Annotated[str, typer.Option(help="bundled model")] = "rrr",
    jobs: Jobs = 2,
    out: Annotated[Path, typer.Option(help="folder of the results")] = Path("results/calibration_coverage"),
) -> None:
    """Measure the coverage; writes coverage.json."""
    began = time.perf_counter()
    with workers(jobs):
        results = ordered(repetition, [(seed, robot, recordings, seconds) for seed in range(repetitions)])
    names = list(results[0])
    table = np.array([[r[name] for name in names] for r in results])  # (repetitions, parameters, 4)
    true, value, low, high = np.moveaxis(table, 2, 0)
    hits = (low <= true) & (true <= high)
    groups = {"pooled": names} | {kind: [n for n in names if n.startswith(kind)] for kind in ("dry", "viscous", "armature")}
    summary = {"repetitions": repetitions, "recordings": recordings, "seconds": seconds, "robot": robot, "coverage": {}}
    shown = Table("parameters", "coverage", "95 % interval", "bias / std", "std [%]")
    for group, members in groups.items():
        pick = [names.index(n) for n in members]
        got, a, b = share(hits[:, pick])
        error = (value - true)[:, pick]
        bias, spread = float(np.mean(error.mean(0) / error.std(0))), float(np.mean(error.std(0) / true[:, pick].mean(0)))
        summary["coverage"][group] = {"share": got, "interval": [a, b], "bias_over_std": bias, "relative_std": spread}
        shown.add_row(group, f"{100 * got:.1f} %", f"{100 * a:.1f} … {100 * b:.1f} %", f"{bias:+.2f}", f"{100 * spread:.2f}")
    summary["wall_s"] = time.perf_counter() - began
    write_json(out / "coverage.json", json.loads(json.dumps(summary)))
    console.print(shown)


if __name__ == "__main__":
    typer.run(main)
