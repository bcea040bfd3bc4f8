"""Two ways to one objective: how much sooner does the gradient get there, and do both find the truth?

    python validation/calibration_ways.py --out results/calibration_ways

Eight noisy recordings of the independent plant of `calibration_coverage.py`, with dry friction as sharp as the engine's. Least squares
on inverse dynamics, Gauss–Newton on the simulated response from there, and the paper's CMA-ES (64 candidates, sigma 0.15) are
compared by the objective of the last two: NRMSE of the simulated motor torque, summed over joints and recordings.
"""

import json
import sys
import time
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

sys.path.insert(0, str(Path(__file__).resolve().parent))
import pinocchio as pin
from calibration_coverage import record

from rrr_oc.calibration.calibrate import calibrate
from rrr_oc.calibration.response import Response, calibrate_evolution, calibrate_response
from rrr_oc.recordings.recording import RecordingSet
from rrr_oc.robot.robot import load_robot
from rrr_oc.storage import write_json

# pyright: reportAttributeAccessIssue=false
# (pin's wheel has no stubs)

WIDTH = 0.01  # [rad/s]
EQUAL = 1.01  # objectives within 1 % count as equal
console = Console()


def made(robot: str, seconds: float, seed: int) -> tuple[RecordingSet, np.ndarray]:
    """Eight recordings, and the truth (3 n,) joint by joint."""
    rng, arm = np.random.default_rng(seed), load_robot(robot)
    model = pin.buildModelFromUrdf(str(Path(__file__).resolve().parents[1] / "rrr_oc" / "urdf" / f"{robot}.urdf"))
    truth = rng.uniform([[2], [2], [0.05]], [[6], [20], [0.4]], (3, arm.n))
    recordings = tuple(record(model, truth, seconds, f"{i}.csv", rng, WIDTH) for i in range(8))
    return RecordingSet(arm, robot, "motor", "nominal", arm.tool, (None,) * arm.n, recordings, Path()), truth.T.ravel()


def main(
    out: Annotated[Path, typer.Option(help="folder of the results")] = Path("results/calibration_ways"),
    seconds: Annotated[float, typer.Option(min=2.0, help="of each recording")] = 10.0,
    generations: Annotated[int, typer.Option(min=1)] = 100,
    robot: Annotated[str, typer.Option(help="bundled model")] = "rrr",
    seed: Annotated[int, typer.Option(min=0)] = 0,
) -> None:
    """Race the ways; writes ways.json."""
    recordings, truth = made(robot, seconds, seed)
    began = time.perf_counter()
    inverse = calibrate(recordings)
    wall = time.perf_counter() - began
    models = {
        "inverse": inverse,
        "response": calibrate_response(recordings),
        "evolution": calibrate_evolution(recordings, generations=generations),
    }
    values = {way: np.concatenate([t.values for t in m.terms]) for way, m in models.items()}
    response = Response(recordings, inverse)
    reached = dict(zip(values, response.objective(response.residuals(list(values.values()))).tolist(), strict=True))
    best = min(reached.values())
    history = {way: m.report["history"] for way, m in models.items() if way != "inverse"} | {
        "inverse": [(wall, reached["inverse"])]
    }
    soon = {way: next((t for t, value in history[way] if value <= EQUAL * best), None) for way in models}
    gradient = min(t for way, t in soon.items() if way != "evolution" and t is not None)
    summary = {
        "objective": reached,
        "largest_error": {way: float(np.max(np.abs(v / truth - 1))) for way, v in values.items()},
        "wall_s": {way: history[way][-1][0] for way in models},
        "within_1_percent_after_s": soon,
        "evolution_over_best": reached["evolution"] / best - 1,
        "speed_up": None if soon["evolution"] is None else soon["evolution"] / gradient,
        "generations": len(history["evolution"]),
    }
    write_json(out / "ways.json", json.loads(json.dumps(summary)))
    shown = Table("way", "objective", "largest error of a parameter", "wall [s]", "within 1 % of the best after [s]")
    for way in models:
        after = "never" if soon[way] is None else f"{soon[way]:.2f}"
        shown.add_row(way, f"{reached[way]:.5f}", f"{summary['largest_error'][way]:.2%}", f"{history[way][-1][0]:.2f}", after)
    console.print(shown)
    console.print(
        f"evolution ends {summary['evolution_over_best']:.2%} above the best objective; speed-up of the gradient: {summary['speed_up']}"
    )


if __name__ == "__main__":
    typer.run(main)
