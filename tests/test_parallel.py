"""Where calls run must not matter for what they give: in this process, in workers that are killed, on a Dask cluster."""

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_searches import LABELS, OPTIONS, PEA, SMALL, numbers

from rrr_oc import parallel
from rrr_oc.codesign.search.multistart import solve_multistart
from rrr_oc.errors import UserError
from studies.paper.experiments import run_evolution


def number(seed: int) -> float:
    return float(np.random.default_rng(seed).normal())


def killed_once(folder: Path, seed: int) -> float:
    """A number; the first call with seed 3 kills the process that it runs in."""
    mark = folder / "killed"
    if seed == 3 and not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return number(seed)


def killed_always(seed: int) -> float:
    os.kill(os.getpid(), signal.SIGKILL)
    return number(seed)


def inner(seed: int) -> list[float]:
    return parallel.ordered(number, [(seed,), (seed + 1,)])


def test_results_are_those_of_a_loop():
    expected = [number(seed) for seed in range(8)]
    arguments = [(seed,) for seed in range(8)]
    assert parallel.ordered(number, arguments) == expected
    with parallel.workers(2):
        assert parallel.ordered(number, arguments) == expected
        assert sorted(parallel.unordered(number, arguments)) == sorted(expected)
        assert parallel.ordered(number, []) == []
        assert parallel.ordered(number, [(5,)]) == [number(5)]


def test_calls_within_calls_give_the_same():
    with parallel.workers(2):
        assert parallel.ordered(inner, [(0,), (10,)]) == [inner(0), inner(10)]


def test_a_worker_that_is_killed_costs_nothing_but_time(tmp_path):
    with parallel.workers(2):
        assert parallel.ordered(killed_once, [(tmp_path, seed) for seed in range(8)]) == [number(seed) for seed in range(8)]
    assert (tmp_path / "killed").exists()


def test_a_call_that_kills_every_worker_is_an_error():
    with parallel.workers(2), pytest.raises(UserError, match="worker processes ended 3 times"):
        parallel.ordered(killed_always, [(0,), (1,)])


DIES = """
import os, signal, sys
from rrr_oc import parallel
class Dies:
    def __reduce__(self):
        os.kill(os.getpid(), signal.SIGKILL)
        return Dies, ()
def number(n):
    return n
with parallel.workers(2):
    if sys.argv[1] == "after calls":
        print(*parallel.ordered(number, [(n,) for n in range(4)]), flush=True)
    parallel.ordered(number, [(Dies(),), (Dies(),)])
"""


@pytest.mark.parametrize("moment", ["before calls", "after calls"])
def test_workers_end_with_a_program_that_is_killed(moment, tmp_path):
    """The program kills itself when it sends a call, at which its workers run; they are in a process group of their own with it."""
    program = subprocess.Popen(
        [sys.executable, "-c", DIES, moment], stdout=subprocess.PIPE, text=True, cwd=tmp_path, start_new_session=True
    )
    said, _ = program.communicate(timeout=120)
    assert program.returncode == -signal.SIGKILL
    assert said == ("0 1 2 3\n" if moment == "after calls" else "")
    with pytest.raises(ProcessLookupError):  # noqa: PT012
        for _ in range(100):
            os.killpg(program.pid, 0)
            time.sleep(0.2)


@pytest.mark.parametrize("jobs", [0, -2])
def test_unusable_numbers_of_processes_are_refused(jobs):
    with pytest.raises(UserError, match=f"--jobs is {jobs}; allowed are 1 or more, and -1"), parallel.workers(jobs):
        pass


def test_a_cluster_of_two_workers_gives_the_same_numbers(tmp_path):
    """joblib's Dask backend: three trials of the evolution in the engine, and a search for a design."""
    distributed = pytest.importorskip("distributed")
    protocol = replace(SMALL, model="engine", generations=4, every=2, steps=120)
    labels, few = LABELS | {"model": "engine"}, replace(OPTIONS, starts=4)
    stores = {where: tmp_path / where for where in ("local", "dask")}
    arguments = {where: [(store, labels, protocol, seed) for seed in range(3)] for where, store in stores.items()}
    with parallel.workers(2):
        here = parallel.ordered(run_evolution, arguments["local"])
    local = distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None)
    with local as cluster, parallel.workers(where=cluster.scheduler_address):
        there = parallel.ordered(run_evolution, arguments["dask"])
        found = solve_multistart(PEA, few)
    assert [numbers(f) for _, f in there] == [numbers(f) for _, f in here]
    assert len({f["cost"] for _, f in here}) == 3
    np.testing.assert_array_equal(found.best.solution.w, solve_multistart(PEA, few).best.solution.w)


def test_a_scheduler_that_does_not_answer_is_one_sentence(monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr(parallel, "SCHEDULER_TIMEOUT", 0.5)
    with pytest.raises(UserError, match="no Dask scheduler answers"), parallel.workers(where="tcp://127.0.0.1:9"):
        pass
