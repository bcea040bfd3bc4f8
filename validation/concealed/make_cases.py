"""Make the sealed cases:

python validation/concealed/make_cases.py --out DIR [--only KIND] [--seed N] [--jobs 2] [--limit N]
"""

import argparse
import os
import sys
import time
from collections.abc import Iterable
from pathlib import Path
from typing import cast

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")  # before numpy: the jobs share the cores
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from joblib import Parallel, delayed  # noqa: E402
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn  # noqa: E402

from validation.concealed.build import build  # noqa: E402
from validation.concealed.cases import Case, declare  # noqa: E402
from validation.concealed.write import write_case  # noqa: E402


def make(case: Case, out: Path) -> tuple[str, float]:
    """Build and write one case; its id and the seconds it took."""
    start = time.perf_counter()
    write_case(build(case), out)
    return case.id, time.perf_counter() - start


def chosen(seed: int, only: str | None, limit: int | None) -> list[Case]:
    """The cases whose kind is `only`, or whose key begins with it; `limit` of them, drawn at random, for ids are hashes."""
    cases = sorted(declare(seed), key=lambda c: c.id)
    if only:
        cases = [c for c in cases if c.kind == only or c.key.startswith(only)]
        if not cases:
            raise SystemExit(f"--only {only}: no such kind; there are {', '.join(sorted({c.kind for c in declare(seed)}))}")
    return cases[:limit]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--only", help="a kind of case, or the beginning of a key such as single/stribeck")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--limit", type=int)
    options = parser.parse_args()
    out: Path = options.out
    (out / "sealed").mkdir(parents=True, exist_ok=True)
    cases = chosen(options.seed, options.only, options.limit)
    todo = [c for c in cases if not ((out / "sealed" / f"{c.id}.json").exists() and (out / c.id).is_dir())]
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    seconds = []
    with Progress(*columns) as progress:
        bar = progress.add_task("cases", total=len(cases), completed=len(cases) - len(todo))
        parallel = Parallel(n_jobs=options.jobs, return_as="generator_unordered")
        made = cast("Iterable[tuple[str, float]]", parallel(delayed(make)(c, out) for c in todo))
        for _, took in made:
            seconds.append(took)
            progress.advance(bar)
    if seconds:
        print(
            f"{len(seconds)} cases made, {sum(seconds) / len(seconds):.1f} s each on one core, {max(seconds):.1f} s the longest"
        )


if __name__ == "__main__":
    main()
