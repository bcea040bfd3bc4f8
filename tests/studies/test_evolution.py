"""Evolutionary trials: what they find, that a kill changes nothing, and that a cluster gives the same numbers."""

import json
import pickle
import signal
import subprocess
import sys
import time
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from small_searches import LABELS, SMALL, TASK, numbers

from rrr_oc.errors import UserError
from studies.paper.encoding import Analytic, Encoding
from studies.paper.evolution import evolve
from studies.paper.experiments import experiment, run_evolution
from studies.paper.run_store import Run

TRIAL = """
import sys
from pathlib import Path
from studies.paper.evolution import Protocol
from studies.paper.experiments import run_evolution
labels = {labels!r}
run_evolution(Path(sys.argv[1]), labels, {protocol!r}, 3)
"""


def folder(store: Path, model: str = "analytic") -> Path:
    return store / "BPEA" / "rest" / f"evolution-{model}" / "3"


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory) -> tuple[dict, dict]:
    store = tmp_path_factory.mktemp("whole")
    found = run_evolution(store, LABELS, SMALL, 3)[1]
    with np.load(folder(store) / "arrays.npz") as arrays:
        return found, dict(arrays)


def test_a_trial_gets_better_and_says_what_it_found(uninterrupted):
    found, history = uninterrupted
    assert found["evaluations"] == 150 * 12
    assert history["best"][-1] == found["cost"] < 0.5 * history["best"][0]
    assert np.all(np.diff(history["best"]) <= 0)
    assert np.all(np.diff(history["core_s"]) > 0)
    known = Encoding(experiment(TASK, "BPEA"))
    assert Analytic(known)(np.array([found["x"]])).cost[0] == pytest.approx(found["cost"], rel=1e-12)
    assert found["engine"] == pytest.approx(found["analytic"], rel=2e-3)  # 960 steps a phase
    assert set(found["hardware"]) == {"k_b", "q_0", "r_1", "r_2", "r_3"}


def test_killed_at_random_moments_it_ends_the_same(uninterrupted, tmp_path):
    """kill -9, three times at least, some of them while a checkpoint is written; each time the trial goes on from its last one."""
    rng, code = np.random.default_rng(), TRIAL.format(labels=LABELS, protocol=SMALL)
    killed, saved = 0, folder(tmp_path) / "checkpoint.npz"
    for _ in range(12):
        before = saved.stat().st_mtime_ns if saved.exists() else 0
        process = subprocess.Popen([sys.executable, "-c", code, str(tmp_path)])
        while killed < 3 and process.poll() is None and (not saved.exists() or saved.stat().st_mtime_ns == before):
            time.sleep(0.002)
        if killed < 3:
            time.sleep(rng.uniform(0, 0.15))
            process.send_signal(signal.SIGKILL)
        if process.wait(timeout=120) == 0:
            break
        assert process.returncode == -signal.SIGKILL
        killed += 1
    assert killed >= 1, "every process ended before it could be killed"
    found = json.loads((folder(tmp_path) / "run.json").read_text())["found"]
    assert numbers(found) == numbers(uninterrupted[0])
    with np.load(folder(tmp_path) / "arrays.npz") as arrays:
        for key in ("evaluations", "best", "median"):
            np.testing.assert_array_equal(arrays[key], uninterrupted[1][key])
        assert np.all(np.diff(arrays["core_s"]) > 0)  # adds up over the parts
    assert not saved.exists()


def test_what_was_found_is_taken_from_the_store_only_for_the_same_question(uninterrupted, tmp_path):
    design, small = experiment(TASK, "PEA"), replace(SMALL, generations=3)
    first = evolve(design, small, 0, tmp_path / "0", {"a": 1})
    assert evolve(design, small, 0, tmp_path / "0", {"a": 1}) == first  # times included: nothing was run
    other = evolve(design, replace(small, generations=4), 0, tmp_path / "0", {"a": 1})
    assert other["evaluations"] == 48
    (tmp_path / "0" / "run.json").write_text("{")
    with pytest.raises(UserError, match="delete its folder"):
        evolve(design, small, 0, tmp_path / "0", {"a": 1})


def test_a_checkpoint_runs_no_code(tmp_path):
    """A results folder may come from somebody else."""

    class Harm:
        def __reduce__(self):
            return Path.touch, (tmp_path / "harm",)

    design, small = experiment(TASK, "PEA"), replace(SMALL, generations=3)
    asked = {**asdict(small), "seed": 0, "start": None}
    harmful = np.frombuffer(pickle.dumps(Harm()), np.uint8)
    Run(tmp_path / "0", asked).save({"state": harmful, "costs": np.zeros((1, 1))})
    assert evolve(design, small, 0, tmp_path / "0", {})["generations"] == 3
    assert not (tmp_path / "harm").exists()


def test_evolution_from_a_design_never_ends_above_it(tmp_path):
    known = Encoding(experiment(TASK, "PEA"))
    low, high = known.region
    start = (low + high) / 2
    found = evolve(known.design, replace(SMALL, generations=2, sigma=1e-4), 0, tmp_path / "0", {}, start)
    assert found["cost"] <= Analytic(known)(start[None]).cost[0]
    with pytest.raises(UserError, match="has shape"):
        evolve(known.design, SMALL, 0, tmp_path / "1", {}, start[1:])


@pytest.mark.parametrize("wrong", [{"model": "dream"}, {"generations": 0}, {"population": 2}, {"sigma": 0.0}, {"every": 0}])
def test_unusable_protocols_are_refused(wrong):
    with pytest.raises(UserError, match="evolution"):
        replace(SMALL, **wrong)
