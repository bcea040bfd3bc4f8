"""How much do effects cost in batched rollouts? 64 candidates of 3.5 s at 2 ms on the three-joint arm.

    pytest tests/benchmarks/bench_rollout.py

The engine without effects is the yardstick; generated C is to reach 90 % of its speed, and two threads are to be faster than
one. Speeds are compared between rounds that take turns, so that what else the machine does meets all alike.
"""

import os
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass

import mujoco
import numpy as np
import pytest
from mujoco import rollout

from rrr_oc.effects import CATALOGUE
from rrr_oc.model.symbolic_model import Model
from rrr_oc.robot.robot import load_robot
from rrr_oc.simulation.engine_model import Settings, Twin, twin

CANDIDATES, SECONDS, STEP = 64, 3.5, 2e-3
FORMS = ("bare", "generated", "native")
THETA = np.array([8.3, 1.7, 0.4, -0.6, 36.0, 0.6, -0.05])
ROUNDS = 12
STEPS = CANDIDATES * round(SECONDS / STEP)  # of a rollout


@dataclass(frozen=True)
class Batch:
    """Models that differ in the springs' parameters, their initial states and their controls."""

    models: list[mujoco.MjModel]
    initial: np.ndarray
    control: np.ndarray
    context: Callable[[], AbstractContextManager[None]]

    def run(self, threads: int) -> np.ndarray:
        """Final states of a rollout; the threads' pool is part of the job."""
        data = [mujoco.MjData(self.models[0]) for _ in range(threads)]
        with self.context(), rollout.Rollout(nthread=threads) as pool:
            return np.array(pool.rollout(self.models, data, self.initial, self.control)[0][:, -1])


def batch(form: str, integrator: str) -> Batch:
    """Candidates as in a calibration: springs of PEA+BPEA within ±20 %, damped joints, one reference signal."""
    robot, rng, parallel = load_robot("rrr"), np.random.default_rng(0), CATALOGUE["parallel_spring"]
    springs = (parallel((1,)), parallel((2,)), CATALOGUE["biarticular_spring"]((1, 2)))
    model = Model(robot, robot.tool, () if form == "bare" else springs)
    settings = Settings(
        effects="native" if form == "native" else "generated", timestep=STEP, integrator=integrator, damping=20.0, armature=0.1
    )
    thetas = THETA * rng.uniform(0.8, 1.2, (CANDIDATES, THETA.size))
    twins: list[Twin]
    if form == "bare":
        one = twin(model, settings=settings)
        twins, context = [one] * CANDIDATES, nullcontext
    else:
        twins = [twin(model, theta, settings=settings) for theta in thetas]
        context = twins[0].effects
    steps = round(SECONDS / STEP)
    signal = 300 * np.cos(np.outer(np.arange(steps) * STEP, [1.0, 1.5, 2.0]))  # rate of the controllers' input [Nm/s]
    initial = np.hstack([np.zeros((CANDIDATES, 1)), rng.uniform(-0.5, 0.5, (CANDIDATES, 3)), np.zeros((CANDIDATES, 6))])
    return Batch([t.mj for t in twins], initial, np.tile(signal, (CANDIDATES, 1, 1)), context)


@pytest.fixture(scope="module", autouse=True)
def cache(tmp_path_factory):
    """Compiled effects of the benchmark, away from the user's."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("integrator", ["euler", "rk4"])
@pytest.mark.parametrize("form", FORMS)
def test_rollout(benchmark, form, integrator, threads):
    work = batch(form, integrator)
    benchmark.group = f"{integrator}, {threads} thread(s)"
    benchmark.extra_info["steps"] = STEPS
    final = benchmark.pedantic(work.run, (threads,), rounds=5, warmup_rounds=1)
    assert np.all(np.isfinite(final))
    # each has springs of its own; without any, the controllers have brought all to one motion
    assert len(np.unique(final[:, 1:4], axis=0)) == (1 if form == "bare" else CANDIDATES)


@pytest.mark.parametrize("integrator", ["euler", "rk4"])
def test_generated_effects_leave_the_engine_its_speed(integrator, capsys):
    """90 % of the bare engine's or more, in processor time: what other jobs take of the machine does not count."""
    spent = fastest(integrator, [(form, 1) for form in FORMS], time.process_time)
    with capsys.disabled():
        print(f"\n{integrator}, processor time a step, and share of the bare engine's speed (best of {ROUNDS} rounds):")
        for (form, _), seconds in spent.items():
            print(f"  {form:9s} {1e6 * seconds / STEPS:.2f} µs, {spent['bare', 1] / seconds:.1%}")
    assert spent["bare", 1] / spent["generated", 1] >= 0.9


@pytest.mark.parametrize("integrator", ["euler", "rk4"])
def test_two_threads_are_faster_than_one(integrator, capsys):
    """In wall time, so on a machine with a free second processor only."""
    load, processors = os.getloadavg()[0], len(os.sched_getaffinity(0))
    if processors < 2 or load > processors - 1:
        pytest.skip(f"load {load:.1f} on {processors} processors: no second one is free to compare threads on")
    spent = fastest(integrator, [(form, threads) for form in FORMS for threads in (1, 2)], time.perf_counter)
    with capsys.disabled():
        print(f"\n{integrator}, wall time of one and two threads, and the gain (best of {ROUNDS} rounds, load {load:.1f}):")
        for form in FORMS:
            one, two = spent[form, 1], spent[form, 2]
            print(f"  {form:9s} {one:.3f} s, {two:.3f} s, {one / two:.2f}")
    assert all(spent[form, 2] < spent[form, 1] for form in FORMS)


def fastest(integrator: str, cases: list[tuple[str, int]], clock: Callable[[], float]) -> dict[tuple[str, int], float]:
    """Least time of each (form, threads) by a clock [s], in rounds that take turns."""
    works = {form: batch(form, integrator) for form in FORMS}
    spent = dict.fromkeys(cases, np.inf)
    for _ in range(ROUNDS):
        for form, threads in cases:
            began = clock()
            works[form].run(threads)
            spent[form, threads] = min(spent[form, threads], clock() - began)
    return spent
