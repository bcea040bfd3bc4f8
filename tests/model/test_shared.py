"""What is derived once and shared: models of equal parts, filters of a recording; each lasts as long as it should."""

import gc
import weakref
from dataclasses import replace

import numpy as np
from recorded import Plant, as_set, record

from rrr_oc.calibration.samples import prepare
from rrr_oc.effects.elastic.parallel_spring import ParallelSpring
from rrr_oc.model.shared_model import shared_model
from rrr_oc.robot.robot import load_robot


def test_models_of_equal_parts_are_one():
    robot, spring = load_robot("rrr"), ParallelSpring((1,))
    model = shared_model(robot, robot.tool, (spring,))
    assert shared_model(load_robot("rrr"), robot.tool, (ParallelSpring((1,)),)) is model
    assert shared_model(replace(robot, inertial=2 * robot.inertial), robot.tool, (spring,)) is model
    assert np.all(np.isnan(model.robot.inertial))  # its functions take them as an argument
    for other in (
        shared_model(robot, robot.tool, ()),
        shared_model(robot, robot.tool, (ParallelSpring((1,), active="above"),)),
        shared_model(robot, replace(robot.tool, position=robot.tool.position + 0.1), (spring,)),
        shared_model(replace(robot, gravity=-robot.gravity), robot.tool, (spring,)),
        shared_model(replace(robot, joints=("a", "b", "c")), robot.tool, (spring,)),
    ):
        assert other is not model


def test_a_common_filter_lasts_as_long_as_its_recording():
    plant = Plant("rrr", np.ones(3), np.ones(3), 0.1 * np.ones(3))
    (prepared,) = prepare(as_set(plant, [record(plant, "a.csv", np.random.default_rng(0), 5.0)]))
    assert replace(prepared, measured=0 * prepared.measured).matrix is prepared.matrix
    matrix = weakref.ref(prepared.matrix)
    del prepared
    gc.collect()
    assert matrix() is None
