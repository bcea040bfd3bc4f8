"""Batched rollouts give the same numbers whatever the number of threads, and for each candidate alone."""

import mujoco
import numpy as np
import pytest
from mujoco import rollout

from rrr_oc.effects import CATALOGUE
from rrr_oc.model.symbolic_model import Model
from rrr_oc.robot.robot import load_robot
from rrr_oc.simulation.engine_model import Settings, twin

COUNT, STEPS = 24, 300
THETA = np.array([8.3, 1.7, 36.0, 0.6, -0.05])


@pytest.fixture(autouse=True, scope="module")
def cache(tmp_path_factory):
    """Compiled effects of this module's tests, away from the user's."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


def candidates(settings: Settings) -> tuple[list, np.ndarray, np.ndarray]:
    """Twins that differ in parameters and payload, their initial states, and one control signal each."""
    robot, rng = load_robot("rrr"), np.random.default_rng(0)
    model = Model(robot, robot.tool, (CATALOGUE["parallel_spring"]((1,)), CATALOGUE["biarticular_spring"]((1, 2))))
    thetas = THETA * rng.uniform(0.5, 1.5, (COUNT, THETA.size))
    twins = [twin(model, theta, settings=settings) for theta in thetas]
    for engine in twins:
        engine.set_payload(rng.uniform(0, 5))
    initial = np.hstack([np.zeros((COUNT, 1)), rng.uniform(-1, 1, (COUNT, 6)), np.zeros((COUNT, 3))])
    return twins, initial, rng.normal(0, 200, (COUNT, STEPS, 3))


def roll(twins: list, initial: np.ndarray, control: np.ndarray, threads: int) -> np.ndarray:
    data = [mujoco.MjData(twins[0].mj) for _ in range(max(1, threads))]
    with twins[0].effects(), rollout.Rollout(nthread=threads) as pool:
        return np.array(pool.rollout([t.mj for t in twins], data, initial, control)[0])


@pytest.mark.parametrize("form", ["generated", "native"])
@pytest.mark.parametrize("integrator", ["rk4", "euler", "implicitfast"])
def test_any_number_of_threads_gives_the_same_numbers(form, integrator):
    """Bit for bit, dry friction (a constraint with a solver that starts warm) included."""
    drive = {"damping": [1.0, 2.0, 3.0], "armature": 0.1, "frictionloss": [0.5, 1.0, 1.5]}
    work = candidates(Settings(effects=form, integrator=integrator, timestep=2e-3, **drive))
    inline = roll(*work, threads=0)
    assert np.all(np.isfinite(inline))
    assert len(np.unique(inline[:, -1, 1])) == COUNT  # every candidate moved on its own
    for threads in (1, 2, 3, 5):
        np.testing.assert_array_equal(roll(*work, threads=threads), inline)
    twins, initial, control = work
    for i in (0, COUNT // 2, COUNT - 1):
        one = slice(i, i + 1)
        np.testing.assert_array_equal(roll(twins[one], initial[one], control[one], 0), inline[one])
