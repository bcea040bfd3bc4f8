"""The paper's seven experiments by its own protocol, and the gradient optima beside them."""

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from rrr_oc import parallel
from rrr_oc.codesign import CONFIGURATIONS, CoDesign, spring_bounds
from rrr_oc.errors import UserError
from rrr_oc.evolution import Protocol, evolve
from rrr_oc.report import published_springs
from rrr_oc.task import Task, load_task

EXPERIMENTS = (*CONFIGURATIONS, "PEA*", "BPEA*", "PEA+BPEA*")
ENDS = ("rest", "free")
FREE_HARDWARE = ("q_eq2", "q_eq3", "q_0")
console = Console()


def experiment(task: Task, name: str, ends: str) -> CoDesign:
    """One of the paper's experiments; a starred one has Table 4's purchasable stiffnesses and pulleys, its equilibria are free."""
    base = name.rstrip("*")
    design = CoDesign(task, spring_bounds(task, base), at_rest=ends == "rest")
    return design.with_fixed(published_springs(name), FREE_HARDWARE) if name.endswith("*") else design


def trial(preset: str, name: str, ends: str, protocol: Protocol, seed: int, folder: Path) -> dict[str, Any]:
    """One evolutionary trial of an experiment, in its folder."""
    labels = {"preset": preset, "experiment": name, "ends": ends, "method": "evolution"}
    return evolve(experiment(load_task(preset), name, ends), protocol, seed, folder, labels) | labels | {"seed": seed}


def trials(out: Path, preset: str, names, ends: str, protocol: Protocol, count: int) -> Iterator[tuple]:
    """Arguments of all trials, seed by seed, so that what is interrupted has as many of each."""
    for seed in range(count):
        for name in names:
            folder = out / "runs" / name / ends / f"evolution-{protocol.model}" / str(seed)
            yield preset, name, ends, protocol, seed, folder


def main(
    experiments: Annotated[str, typer.Option()] = ",".join(EXPERIMENTS),
    ends: Annotated[str, typer.Option()] = "rest",
    model: Annotated[str, typer.Option()] = "engine",
    count: Annotated[int, typer.Option()] = 10,
    out: Annotated[Path, typer.Option()] = Path("results/gradient_vs_evolution"),
    workers: Annotated[str, typer.Option()] = parallel.LOCAL,
    jobs: Annotated[int, typer.Option()] = -1,
) -> None:
    """Run the trials."""
    names, protocol = experiments.split(","), Protocol(model=model)
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()
    with parallel.workers(workers), Progress(*columns, console=console) as progress:
        bar = progress.add_task("trials", total=count * len(names))
        for found in parallel.unordered(trial, trials(out, "paper", names, ends, protocol, count), jobs):
            progress.advance(bar)
            progress.console.print(f"{found['experiment']} {found['seed']}: {found['cost']:.3f} {found['generations']} {found['core_s']:.0f} s")


def run() -> None:
    try:
        typer.run(main)
    except UserError as error:
        Console(stderr=True).print(f"[red]Error:[/red] {error}", highlight=False, soft_wrap=True)
        raise SystemExit(2) from None


if __name__ == "__main__":
    run()
