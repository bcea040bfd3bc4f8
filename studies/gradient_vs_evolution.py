"""Gradient against evolution: the paper's seven experiments by its own protocol, and the gradient optima beside them.

    python studies/gradient_vs_evolution.py --protocol reduced          # minutes
    python studies/gradient_vs_evolution.py --protocol full --jobs 4    # the paper's budget
    python studies/gradient_vs_evolution.py --workers tcp://host:8786   # the same on a Dask cluster that shares the folder

What does each find, at what cost, and do the paper's conclusions hold? For each experiment (SA, PEA, BPEA, both, and with purchasable
hardware): (a) the paper's CMA-ES, ten trials of 64 × 1000 evaluations in MuJoCo, and the same in the analytic model; (b) IPOPT from Sobol
points; (c) CMA-ES over IPOPT; (d) IPOPT within the paper's Akima parametrisation; (e) evolution that starts at (d). Then the time
that the gradient needs to reach evolution's cost; springs alone on a fixed motion; and the optima played on an arm whose physics the
model lacks.

Every run is a folder of the store `OUT/runs`; the same command continues an interrupted study. Tables and figures are made from the
store.
"""

import json
import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.markdown import Markdown
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from rrr_oc import parallel
from rrr_oc.codesign.task import load_task
from rrr_oc.commands.shared import Jobs, Workers
from rrr_oc.errors import UserError, entry_point
from rrr_oc.report.console import wide_console
from rrr_oc.storage import Made, write_json, write_npz, write_text

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from studies.paper.comparison import FREE_MOTION, NEAR, evolved_of, summarise
from studies.paper.comparison_figures import draw_comparison
from studies.paper.comparison_report import tables
from studies.paper.encoding import Encoding
from studies.paper.engine_population import STEPS
from studies.paper.evolution import Protocol
from studies.paper.experiments import (
    ENDS,
    EXPERIMENTS,
    GRADIENT,
    candidate_motion,
    experiment,
    folder_of,
    run_evolution,
    run_fixed,
    run_gradient,
    run_race,
    run_restricted,
    spring_torques,
    stored_motion,
)
from studies.paper.run_store import Run, all_runs

STAGES = ("engine", "model", "gradient", "restricted", "again", "race", "fixed", "transfer", "tables")
console = wide_console()


@dataclass(frozen=True)
class Size:
    """Size of a study.

    Attributes:
        trials, generations, population, steps: Evolutionary trials, generations, candidates a generation, engine steps a phase.
        again: Evolutionary trials from the restricted optimum.
        starts, restricted: Starting points of IPOPT, and of IPOPT within the parametrisation.
        races: Races an experiment and target.
        durations: Durations of a phase of the fixed motion [s].
    """

    trials: int = 10
    generations: int = 1000
    population: int = 64
    steps: int = STEPS
    again: int = 1
    starts: int = 20
    restricted: int = 8
    races: int = 3
    durations: tuple[float, ...] = (2.0, 3.0, 4.0)

    def protocol(self, model: str, sigma: float = 0.15) -> Protocol:
        """Settings of the evolution."""
        return Protocol(model, self.generations, self.population, sigma, steps=self.steps)  # pyright: ignore[reportArgumentType]


SIZES = {"full": Size(), "reduced": Size(3, 60, 24, 120, 1, 4, 4, 1, (3.0,))}
AGAIN_SIGMA = 0.03  # around the restricted optimum
Job = tuple[Callable, tuple]


def main(
    protocol: Annotated[str, typer.Option(help="full (the paper's budget) or reduced (minutes)")] = "reduced",
    preset: Annotated[str, typer.Option(help="paper, prototype, or the path of a task file")] = "paper",
    experiments: Annotated[str, typer.Option(help="comma-separated, of " + ", ".join(EXPERIMENTS))] = ",".join(EXPERIMENTS),
    ends: Annotated[
        str, typer.Option(help="comma-separated: rest at the ends of a phase, or free, as in the authors' code")
    ] = ",".join(ENDS),
    stages: Annotated[str, typer.Option(help="comma-separated, of " + ", ".join(STAGES))] = ",".join(STAGES),
    out: Annotated[Path, typer.Option(help="folder of the store and of the results")] = Path("results/gradient_vs_evolution"),
    jobs: Jobs = -1,
    workers: Workers = parallel.LOCAL,
) -> None:
    """Run what is missing in the store, then write report.md, summary.json and figures."""
    names, wanted = _listed("experiments", experiments, EXPERIMENTS), _listed("stages", stages, STAGES)
    here = _listed("ends", ends, ENDS)
    if protocol not in SIZES:
        raise UserError(f"--protocol is {protocol!r}; allowed are {', '.join(SIZES)}")
    if out.exists() and not out.is_dir():
        raise UserError(f"--out {out} is a file; give a folder")
    size, store, task = SIZES[protocol], out / "runs", load_task(preset)
    for name in names:
        _ = experiment(task, name)
    transferred = Made(
        [out / "transfer.json"], preset, [Path(__file__).with_name(name) for name in ("transfer_to_plant.py", "paper")]
    )
    began = time.perf_counter()
    with parallel.workers(jobs, workers):
        for stage in wanted:
            if stage in JOBS:
                _run(stage, [run for run in JOBS[stage](store, preset, names, size) if run[1][1]["ends"] in here])
        if "transfer" in wanted:
            from transfer_to_plant import transfer  # which needs the validation's plant, beside this package

            write_json(out / "transfer.json", transfer(out, preset, names))
            transferred.keep()
    if "tables" in wanted:
        summary = summarise(store, preset) | {
            "protocol": protocol,
            "command": f"python studies/gradient_vs_evolution.py --protocol {protocol} --preset {preset}",
            "wall_s": time.perf_counter() - began,
        }
        if transferred.there:
            summary["transfer"] = json.loads((out / "transfer.json").read_text())
        write_json(out / "summary.json", summary)
        text = tables(summary)
        write_text(out / "report.md", text)
        _motions(out, preset, summary)
        draw_comparison(out, summary)
        console.print(Markdown(text))
        console.print(f"Everything is in {out}: report.md, summary.json, figures; a folder a run in {store}.")


def _motions(out: Path, preset: str, summary: dict) -> None:
    """Write the motions of Figure 5, torques summed over the joints: the best evolutionary trial and the gradient optimum."""
    task = load_task(preset)
    runs = [r for r in all_runs(out / "runs") if r.asked["preset"] == preset and r.asked["ends"] == "rest"]
    for name, entry in summary["rest"].items():
        design = experiment(task, name)
        chosen = {}
        best = evolved_of(entry)
        if best is not None:
            chosen["evolution"] = candidate_motion(Encoding(design), np.array(best["x"])), best["parameters"]
        known = [r for r in runs if r.asked["experiment"] == name and r.asked["way"] in FREE_MOTION]
        if known:
            run = min(known, key=lambda r: (r.found or {})["E1"])
            chosen["gradient"] = stored_motion(run), (run.found or {})["parameters"]
        for column, (motion, parameters) in chosen.items():
            torques = spring_torques(design, np.array(parameters), motion)
            arrays = {"t": motion.t, "phase": motion.phase, "load": motion.tau_load.sum(axis=0)}
            for key, start in (("pea", "parallel"), ("bpea", "biarticular")):
                summed = (torque.sum(axis=0) for label, torque in torques.items() if label.startswith(start))
                arrays[key] = sum(summed, np.zeros(motion.t.size))
            write_npz(out / "motions" / f"{name} {column}.npz", arrays)


def _listed(option: str, given: str, known: Iterable[str]) -> list[str]:
    names = [n.strip() for n in given.split(",") if n.strip()]
    wrong = [n for n in names if n not in known]
    if wrong or not names:
        raise UserError(f"--{option} has {wrong[0]!r}; there are {', '.join(known)}" if wrong else f"--{option} names none")
    return [n for n in known if n in names]


def _run(stage: str, jobs: list[Job]) -> None:
    """All runs of a stage, with a progress bar; runs that have ended are read from the store."""
    columns = BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TextColumn("{task.fields[last]}")
    with Progress(TextColumn("{task.description:12}"), *columns, console=console) as progress:
        bar = progress.add_task(stage, total=len(jobs), last="")
        for labels, found in parallel.unordered(_call, jobs):
            told = found.get("E1", found.get("reached"))
            last = f"{labels['experiment']} {labels['ends']}: {'nothing' if told is None else f'{told:.3f}'}, {found['core_s']:.1f} s"
            progress.update(bar, advance=1, last=last)
            if not console.is_terminal:
                progress.console.print(f"{stage}: {last}")


def _call(function: Callable, arguments: tuple) -> Any:
    return function(*arguments)


def _labels(preset: str, name: str, ends: str, way: str, **more: str) -> dict[str, str]:
    return {"preset": preset, "experiment": name, "ends": ends, "way": way, **more}


def _evolutions(store: Path, preset: str, names: list[str], size: Size, model: str, ends: str) -> Iterable[Job]:
    """Seed by seed, so that an interrupted study has equally many trials of each experiment."""
    for seed in range(size.trials):
        for name in names:
            labels = _labels(preset, name, ends, "evolution", model=model)
            yield run_evolution, (store, labels, size.protocol(model), seed)


def _engine(store: Path, preset: str, names: list[str], size: Size) -> Iterable[Job]:
    return _evolutions(store, preset, names, size, "engine", "rest")


def _model(store: Path, preset: str, names: list[str], size: Size) -> Iterable[Job]:
    for ends in ENDS:
        yield from _evolutions(store, preset, names, size, "analytic", ends)


def _gradient(store: Path, preset: str, names: list[str], size: Size) -> Iterable[Job]:
    for ends, ways in (("rest", tuple(GRADIENT)), ("free", ("multistart",))):
        for name in names:
            for way in ways:
                yield run_gradient, (store, _labels(preset, name, ends, way), size.starts, 0)


def _restricted(store: Path, preset: str, names: list[str], size: Size) -> Iterable[Job]:
    for ends in ENDS:
        for name in names:
            yield run_restricted, (store, _labels(preset, name, ends, "restricted"), size.restricted, 0)


def _again(store: Path, preset: str, names: list[str], size: Size) -> Iterable[Job]:
    for seed in range(size.again):
        for name in names:
            labels = _labels(preset, name, "rest", "restricted")
            found = Run(folder_of(store, labels, 0), {**labels, "starts": size.restricted, "seed": 0}).found
            if found is None:
                raise UserError(f"{name}: evolution from the restricted optimum needs the stage 'restricted' before")
            begun = _labels(preset, name, "rest", "again", model="analytic")
            yield run_evolution, (store, begun, size.protocol("analytic", AGAIN_SIGMA), seed, found["x"])


def _race(store: Path, preset: str, names: list[str], size: Size) -> Iterable[Job]:
    """Races to the best evolutionary trial in the engine (in the model where there is none), and to 1 % above the best known cost."""
    rest = summarise(store, preset)["rest"]
    for seed in range(size.races):
        for name in names:
            entry = rest.get(name, {})
            evolved = entry.get("evolution-engine", entry.get("evolution-analytic"))
            targets = {
                "race": evolved and evolved["best"],
                "race-best": NEAR * entry["best_known"] if "best_known" in entry else None,
            }
            for way, target in targets.items():
                if target is not None:
                    yield run_race, (store, _labels(preset, name, "rest", way), target, 2 * size.starts, seed)


def _fixed(store: Path, preset: str, names: list[str], size: Size) -> Iterable[Job]:
    for duration in size.durations:
        for name in (n for n in EXPERIMENTS if n in names and not n.endswith("*")):
            yield run_fixed, (store, _labels(preset, name, "rest", f"fixed-{duration:g}s"), duration, 0)


JOBS: dict[str, Callable[[Path, str, list[str], Size], Iterable[Job]]] = {
    "engine": _engine,
    "model": _model,
    "gradient": _gradient,
    "restricted": _restricted,
    "again": _again,
    "race": _race,
    "fixed": _fixed,
}


run = entry_point(lambda: typer.run(main))

if __name__ == "__main__":
    run()
