"""A motion with drives under two controls: the engine does what the equations say, and P control lags by what it must."""

from dataclasses import replace

import numpy as np
import pytest
from small_searches import smooth_motion

from rrr_oc.errors import UserError
from rrr_oc.robot.drives import load_actuators
from rrr_oc.simulation.engine_model import K_P
from studies.paper.driven import DrivenArm, Followed, follow


@pytest.fixture(scope="module")
def moved():
    return smooth_motion()


@pytest.fixture(scope="module")
def arm(moved):
    design, _, theta = moved
    drives = load_actuators(design.task.joints)
    return DrivenArm(design, theta, replace(drives, resistance=np.array([1.0, 1.5]), regeneration=np.array([0.0, 0.3])))


@pytest.fixture(scope="module")
def followed(arm, moved) -> dict[str, Followed]:
    worse, motion = replace(arm, payload=1.1, friction=1.3), moved[1]
    return {
        "P": follow(arm, motion, "P"),
        "feed-forward": follow(arm, motion, "feed-forward"),
        "P, other arm": follow(worse, motion, "P"),
        "feed-forward, other arm": follow(worse, motion, "feed-forward", arm),
    }


def test_with_feed_forward_the_motors_do_what_the_equations_say(arm, moved, followed):
    """E1 of the plan, and its energy by Eq. 7 to 11, from the engine's motor torque alone."""
    motion, drives, energy = moved[1], arm.drives, 0.0
    for k in motion.phases():
        current = [
            np.array(drives.current(*column)).astype(float).ravel()
            for column in zip(motion.dq[:, k].T, motion.ddq[:, k].T, motion.tau_load[:, k].T, strict=True)
        ]
        power = drives.resistance[:, None] * np.square(current).T + drives.torque_constant[:, None] * motion.dq[
            :, k
        ] * np.transpose(current)
        counted = np.maximum(power, 0) - drives.regeneration[:, None] * np.maximum(-power, 0)
        energy += np.trapezoid(counted.sum(axis=0), motion.t[k])
    found = followed["feed-forward"]
    planned = motion.metrics().E1_total
    assert pytest.approx(planned, rel=2e-3) == found.E1  # 400 samples a phase
    assert found.energy == pytest.approx(energy, rel=2e-3)
    assert found.rms_error < 1e-4
    assert not found.saturated


def test_p_control_lags_by_the_motor_torque_over_its_gain(arm, moved, followed):
    """k_p (q_ref − q) is the whole torque; the motion is slow enough that the lag hardly changes it."""
    squares, time = 0.0, 0.0
    for phase, theta in zip(moved[1].by_phase(arm.design.task), arm.thetas, strict=True):
        lag = arm.motor_torque(phase, np.zeros((3, *phase.q.shape)), theta)[1:] / K_P
        squares, time = squares + np.trapezoid((lag**2).mean(axis=0), phase.t), time + phase.t[-1]
    assert followed["P"].rms_error == pytest.approx(np.sqrt(squares / time), rel=0.1)
    assert followed["P"].end_error > 100 * followed["feed-forward"].end_error


def test_an_arm_unlike_the_known_one_is_followed_less_well(followed):
    for control in ("P", "feed-forward"):
        assert followed[f"{control}, other arm"].energy > 1.1 * followed[control].energy
        assert followed[f"{control}, other arm"].rms_error > followed[control].rms_error
    assert followed["feed-forward, other arm"].rms_error < 0.5 * followed["P, other arm"].rms_error


def test_an_unknown_control_is_refused(arm, moved):
    with pytest.raises(UserError, match="control is 'PID'; allowed are P, feed-forward"):
        follow(arm, moved[1], "PID")
    with pytest.raises(UserError, match="resistance_Ohm of joint2, joint3"):
        follow(replace(arm, drives=load_actuators(arm.design.task.joints)), moved[1], "P")
