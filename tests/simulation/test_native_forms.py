"""MuJoCo's own forms of effects, in exported files that plain MuJoCo runs, against the laws of the effects."""

import math

import mujoco
import numpy as np
import pytest

from rrr_oc.effects.base import Effect, Signals
from rrr_oc.effects.elastic.biarticular_spring import BiarticularSpring
from rrr_oc.effects.elastic.cable_harness import CableHarness
from rrr_oc.effects.elastic.parallel_spring import ParallelSpring
from rrr_oc.effects.elastic.spring_preload import SpringPreload
from rrr_oc.effects.elastic.spring_stiffness import SpringStiffness
from rrr_oc.effects.friction.dry_friction import DryFriction
from rrr_oc.effects.friction.load_dependent_friction import LoadDependentFriction
from rrr_oc.effects.friction.presliding_hysteresis import PreslidingHysteresis
from rrr_oc.effects.friction.quadratic_drag import QuadraticDrag
from rrr_oc.effects.friction.stribeck import Stribeck
from rrr_oc.effects.friction.viscous_friction import ViscousFriction
from rrr_oc.effects.sensor.time_delay import TimeDelay
from rrr_oc.effects.sensor.torque_lag import TorqueLag
from rrr_oc.effects.transmission.torque_ripple import TorqueRipple
from rrr_oc.model.symbolic_model import Model
from rrr_oc.robot.robot import load_robot
from rrr_oc.simulation.engine_model import Settings, twin
from rrr_oc.simulation.export import mjcf

ROBOT = load_robot("rrr")


def exported(effects: tuple[Effect, ...], theta: list[float]) -> tuple[Model, mujoco.MjModel]:
    """A model with effects, and its file as plain MuJoCo reads it."""
    model = Model(ROBOT, ROBOT.tool, effects)
    made = mjcf(model, theta)
    assert made.left_out == ()
    return model, mujoco.MjModel.from_xml_string(made.text)


def needed(mj: mujoco.MjModel, q, dq, ddq) -> np.ndarray:
    """Torque of the motors that a motion needs in plain MuJoCo, (n,) [Nm]; passive motors are there already."""
    data = mujoco.MjData(mj)
    data.qpos[:], data.qvel[:], data.qacc[:] = q, dq, ddq
    mujoco.mj_forward(mj, data)
    data.qacc[:] = ddq
    mujoco.mj_inverse(mj, data)
    return data.qfrc_inverse - data.qfrc_actuator


PEA, BPEA = ParallelSpring((1,)), BiarticularSpring((1, 2))
EXACT = {
    "cable_harness": ((CableHarness((1,)),), [12.0, 0.4]),
    "quadratic_drag": ((ViscousFriction((1,)), QuadraticDrag((1,)), QuadraticDrag((2,))), [2.0, 0.75, -0.25]),
    "torque_ripple": (
        (TorqueRipple((1,)), TorqueRipple((1,)), TorqueRipple((2,))),
        [1.5, 7.0, 0.5, 0.25, 30.0, -2.0, 0.5, 2.0, 1.0],
    ),
    "stiffer": ((PEA, SpringStiffness((1,))), [20.0, 0.5, 1.3]),
    "softer": ((BPEA, SpringStiffness((1, 2))), [20.0, 0.8, 0.3, 0.75]),
    "moved": ((PEA, SpringPreload((1,))), [20.0, 0.5, 0.25]),
    "moved across two joints": ((BPEA, SpringPreload((1, 2))), [20.0, 0.8, 0.3, -0.25]),
    "softer and moved": ((PEA, SpringStiffness((1,)), SpringPreload((1,))), [20.0, 0.5, 0.75, 0.25]),
    "beside a second spring": ((PEA, ParallelSpring((1,)), SpringStiffness((1,))), [20.0, 0.5, 8.0, 1.0, 2.0]),
}


@pytest.mark.parametrize("case", EXACT)
def test_the_torque_of_a_motion_is_that_of_the_laws(case):
    """At random states, to the digits that MuJoCo writes; the effects' own torque is more than that."""
    effects, theta = EXACT[case]
    model, mj = exported(effects, theta)
    plain = mujoco.MjModel.from_xml_string(mjcf(Model(ROBOT, ROBOT.tool, ()), []).text)
    own = []
    for share, dq, ddq in np.random.default_rng(3).uniform(-1.5, 1.5, (30, 3, 3)):
        q = ROBOT.lower + (ROBOT.upper - ROBOT.lower) * (0.5 + share / 3.2)  # limits push back beyond
        law, _ = model.motor_inverse(q, dq, ddq, 0.0, 0.0, theta, np.zeros(len(model.widths)), ROBOT.inertial)
        found = needed(mj, q, dq, ddq)
        np.testing.assert_allclose(found, np.array(law).reshape(-1), rtol=1e-6, atol=1e-6)
        own.append(np.abs(found - needed(plain, q, dq, ddq)).max())
    assert max(own) > 0.1


@pytest.mark.parametrize(
    ("effects", "theta", "tendons"),
    [
        ((PEA, SpringStiffness((1,))), [20.0, 0.5, 1.5], [(30.0, 0.5)]),
        ((PEA, SpringPreload((1,))), [20.0, 0.5, 0.25], [(20.0, 0.75)]),
        ((PEA, SpringStiffness((1,))), [20.0, 0.5, 0.0], []),
    ],
)
def test_a_changed_spring_is_one_tendon_with_its_true_numbers(effects, theta, tendons):
    _, mj = exported(effects, theta)
    found = list(zip(mj.tendon_stiffness, mj.tendon_lengthspring[:, 0], strict=True))
    np.testing.assert_allclose(np.array(found).reshape(-1), np.array(tendons).reshape(-1))


def test_a_change_of_a_spring_that_is_not_there_is_named():
    (one,) = mjcf(Model(ROBOT, ROBOT.tool, (SpringStiffness((1,)),)), [2.0]).left_out
    assert one == "spring_stiffness[joint2]: the spring that it changes is not in the file"


def held(mj: mujoco.MjModel, joint: int, speeds: np.ndarray) -> np.ndarray:
    """Torque of the passive motors on a joint that is led at these speeds, one a step, after each step [Nm]."""
    data, torques = mujoco.MjData(mj), []
    for speed in speeds:
        data.qpos[:], data.qvel[:] = 0.0, 0.0
        data.qvel[joint] = speed
        mujoco.mj_step(mj, data)
        data.qvel[joint] = speed
        mujoco.mj_forward(mj, data)
        torques.append(data.qfrc_actuator[joint])
    return np.array(torques)


@pytest.mark.parametrize("speed", [0.2, -0.3, 0.5, -1.0, 2.5])
def test_stribecks_friction_is_that_of_the_law_in_steady_motion(speed):
    """Away from the width of the smoothed sign, 0.05 rad/s: at four times that it is within 7e-4 of 1, and here exact."""
    effect, values = Stribeck((1,)), {"excess": 2.0, "velocity": 0.4}
    _, mj = exported((DryFriction((1,)), effect), [3.0, *values.values()])
    (law,) = effect.torque(Signals(np.zeros(3), np.array([0.0, speed, 0.0])), values, 0.0)
    (smooth,) = effect.torque(Signals(np.zeros(3), np.array([0.0, speed, 0.0])), values, 0.05)
    found = held(mj, 1, np.full(2000, speed))[-1]
    assert found == pytest.approx(law, abs=1e-4)
    assert found == pytest.approx(smooth, abs=2e-3)
    assert mj.dof_frictionloss[1] == 3.0


def test_presliding_builds_up_as_the_bristles_law_says():
    """Dahl's law in closed form: over a way x in one direction the distance of z from ±1 falls by exp(−x stiffness / level)."""
    effect, values = PreslidingHysteresis((2,)), {"stiffness": 40.0, "level": 2.0}
    _, mj = exported((effect,), list(values.values()))
    steps = 2000
    speeds = 0.3 * np.cos(np.linspace(0.0, 6 * np.pi, steps)) + 0.1
    z, expected = 0.0, []
    for speed in speeds:
        end = math.copysign(1.0, speed)
        z = end - (end - z) * math.exp(-abs(speed) * mj.opt.timestep * values["stiffness"] / values["level"])
        expected.append(effect.torque(Signals(np.zeros(3), states=[z]), values, 0.0)[0])
    np.testing.assert_allclose(held(mj, 2, speeds), expected, atol=1e-12)  # both exact over a step of constant speed
    assert np.ptp(expected) > 2.0


def test_friction_by_bristles_slides_as_the_smoothed_law_does():
    """The arm falls from rest with dry friction and Stribeck's excess; the steps of the file are stable."""
    effects, theta = (DryFriction((1,)), ViscousFriction((1,)), Stribeck((1,))), [1.0, 1.0, 0.5, 0.4]
    model, mj = exported(effects, theta)
    engine = twin(model, theta, settings=Settings(timestep=1e-4), widths=np.array([1e-3, 1e-3]))
    ends = []
    for one, step in ((mj, 1e-3), (engine.mj, 1e-4)):
        data = mujoco.MjData(one)
        data.qpos[1:] = 1.0, -1.5  # far from the limits, which simulations do not have
        one.actuator_gainprm[:], one.actuator_biasprm[: one.nu, :3] = 0.0, 0.0  # no controllers
        with engine.effects():
            for _ in range(round(0.3 / step)):
                mujoco.mj_step(one, data)
        ends.append(data.qpos.copy())
    assert np.all(np.abs(ends[0][1:] - [1.0, -1.5]) > 0.1)
    np.testing.assert_allclose(ends[0], ends[1], atol=5e-3)


@pytest.mark.parametrize("delay", [0.0052, 0.02])
def test_a_delayed_torque_is_the_motors_earlier_torque(delay):
    """Sensors of a file with a delay show what the motors gave that much earlier; ripple of the gear is none of it."""
    _, mj = exported((TimeDelay(()), TorqueRipple((0,))), [delay, 3.0, 5.0, 0.3])
    data, joint = mujoco.MjData(mj), ROBOT.joints[1]
    wave = 2 * np.pi * 3.0
    for _ in range(300):
        now = data.time
        data.ctrl[:] = 0.4 * np.sin(wave * now)
        mujoco.mj_step(mj, data)
    earlier = 0.4 * np.sin(wave * (now - delay))
    for joint in ROBOT.joints:
        # straight lines between samples 1 ms apart: (2π 3 · 1 ms)² / 8 of the amplitude
        assert data.sensor(f"{joint}_torque").data[0] == pytest.approx(earlier, abs=4e-5)
    assert abs(earlier - 0.4 * np.sin(wave * now)) > 0.01


def test_each_joint_has_a_sensor_of_its_own_delay():
    """None where the torque is early."""
    _, mj = exported((TorqueLag((0,)), TorqueLag((1,)), TorqueLag((2,))), [0.004, -0.002, 0.01])
    names = [mj.sensor(k).name for k in range(mj.nsensor)]
    assert [f"{joint}_torque" in names for joint in ROBOT.joints] == [True, False, True]
    assert mj.sensor_delay[[names.index(f"{ROBOT.joints[j]}_torque") for j in (0, 2)]] == pytest.approx([0.004, 0.01])


def test_simulations_run_the_generated_laws_of_what_only_files_have():
    """Other laws in the simulation depend on their torque, and its controllers are the first actuators."""
    effects = (QuadraticDrag((1,)), TorqueRipple((1,)), Stribeck((2,)), PreslidingHysteresis((2,)), LoadDependentFriction((1,)))
    engine = twin(
        Model(ROBOT, ROBOT.tool, effects), [p.nominal for e in effects for p in e.parameters], settings=Settings("native")
    )
    assert engine.library is not None
    assert [engine.mj.actuator(i).name for i in range(3)] == list(ROBOT.joints)
    assert not np.any(engine.mj.actuator_gaintype == mujoco.mjtGain.mjGAIN_DCMOTOR)
