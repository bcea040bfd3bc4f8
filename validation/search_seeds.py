"""Does the search find the same optimum from every seed?

    python validation/search_seeds.py paper prototype arm/task.json --seeds 10 --out results/seeds

Every configuration of every task is searched from every seed with the defaults of `rrr-oc design`, but a looser mesh. For each the
table has the best cost of all seeds, how many seeds came within 0.1 % of it, the worst, to how many bests one start or none led, and
the median time of a processor. Results are kept seed by seed: the same command goes on where it was.
"""

import json
import time
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.progress import track

from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.search.coarse import coarse_search
from rrr_oc.codesign.search.multistart import SHARES, solve_multistart
from rrr_oc.codesign.search.proposals import SearchOptions
from rrr_oc.codesign.springs import arrangements, offered
from rrr_oc.codesign.task import load_task
from rrr_oc.errors import entry_point
from rrr_oc.optimal_control.refinement import Refinement
from rrr_oc.progress import Progress
from rrr_oc.report.tables import markdown
from rrr_oc.storage import Made, check_folder, write_json, write_text

WITHIN = 1e-3  # [1] of the best cost


def searched(task: str, configuration: str, options: SearchOptions) -> dict[str, float]:
    """Cost, time of this processor [s] and how often the optimum was reached."""
    began = time.process_time()
    ways = [CoDesign(load_task(task), springs) for springs in arrangements(load_task(task), configuration)]
    coarse = coarse_search(ways, options, Progress(SHARES))
    best = solve_multistart(ways[coarse.way], options, coarse=coarse).whole().best
    return {"cost": best.cost, "reached": best.reached, "seconds": time.process_time() - began}


def write_searched(file: Path, task: str, name: str, options: SearchOptions) -> None:
    """What `searched` finds, into a file."""
    write_json(file, searched(task, name, options))


def row(label: str, name: str, found: list[dict[str, float]]) -> list[str]:
    """A row of the table."""
    costs = np.array([f["cost"] for f in found])
    close = int(np.sum(costs <= costs.min() * (1 + WITHIN)))
    worst, median = costs.max() / costs.min() - 1, np.median([f["seconds"] for f in found])
    once = sum(f["reached"] < 2 for f in found)
    return [label, name, f"{costs.min():.4f}", f"{close} of {len(costs)}", f"{100 * worst:.2f} %", str(once), f"{median:.0f}"]


def main(
    tasks: Annotated[list[str], typer.Argument(help="bundled tasks or task files")],
    out: Annotated[Path, typer.Option(help="folder of the results")],
    seeds: Annotated[int, typer.Option(min=1, help="number of seeds, from 0")] = 10,
    starts: Annotated[int, typer.Option(min=1, help="starts of a search")] = SearchOptions.starts,
    motions: Annotated[int, typer.Option(min=0, help="proposed motions of each phase")] = SearchOptions.motions,
    springs: Annotated[int, typer.Option(min=1, help="springs tried with some of these motions")] = SearchOptions.springs,
    rounds: Annotated[int, typer.Option(min=1, help="times that motions are searched")] = SearchOptions.rounds,
    configurations: Annotated[str, typer.Option(help="comma-separated; default: all that a task offers")] = "",
    tolerance: Annotated[float, typer.Option(min=1e-8, max=1e-2, help="mesh tolerance, relative")] = 1e-4,
) -> None:
    """Search from every seed and write the table."""
    check_folder(out)
    wanted = {t: [n for n in offered(load_task(t)) if not configurations or n in configurations.split(",")] for t in tasks}
    cases = [(t, n, seed) for seed in range(seeds) for t in tasks for n in wanted[t]]
    results: dict[tuple[str, str], list[dict[str, float]]] = {}
    for task, name, seed in track(cases, "searches"):
        file = out / f"{load_task(task).name}_{name}_{seed}.json"
        options = SearchOptions(
            starts, seed=seed, motions=motions, springs=springs, rounds=rounds, refinement=Refinement(tolerance)
        )
        made = Made([file], [task, name, asdict(options)], [Path(__file__), Path(task)])
        made.once(partial(write_searched, file, task, name, options))
        results.setdefault((task, name), []).append(json.loads(file.read_text()))
        rows = [row(load_task(t).name, n, results[t, n]) for t in tasks for n in wanted[t] if (t, n) in results]
        header = ["task", "springs", "best E1", "within 0.1 %", "worst", "one start or none", "processor [s]"]
        write_text(out / "seeds.md", markdown(header, rows) + "\n")
    print((out / "seeds.md").read_text())


run = entry_point(lambda: typer.run(main))

if __name__ == "__main__":
    run()
