"""Eq. 7 to 10 against the formulas written out, friction that never drives, and bad input."""

import json

import casadi as ca
import numpy as np
import pytest

from rrr_oc.errors import UserError
from rrr_oc.robot.drives import Actuators, Drive, MotorAndGear, actuators_of, load_actuators

JOINTS = ("joint1", "joint2", "joint3")
# facts.md: k_t, c_0, nu, c_v2, c_1, c_12, J_m of the prototype's joints 1, 2, 3
K_T, C_0, NU = np.array([10.89, 12.34, 10.89]), np.array([0.5669, 0.7080, 0.5085]), np.array([2.5853, 3.3084, 2.1345])
C_V2, C_1, C_12 = np.array([-0.7760, -1.2718, -0.5508]), np.array([0.098, 0.082, 0.098]), np.array([-0.014, 0.011, 0.005])
J_M = np.array([0.0, 0.0559, 0.0034])
each_form = pytest.mark.parametrize("form", ["dissipative", "printed"])


def numbers(expression) -> np.ndarray:
    return np.array(ca.evalf(expression)).ravel()


def with_resistance(tmp_path, ohms: float = 0.8) -> Actuators:
    rows = {"torque_constant_Nm_per_A": K_T, "c_0_A": C_0, "viscous_A_s_per_rad": NU, "c_v2_A_s2_per_rad2": C_V2}
    rows |= {"c_1_A_per_Nm": C_1, "c_12_A_per_Nm": C_12, "inertia_A_s2_per_rad": J_M}
    content = {j: {k: float(v[i]) for k, v in rows.items()} | {"resistance_Ohm": ohms} for i, j in enumerate(JOINTS)}
    path = tmp_path / "drives.json"
    path.write_text(json.dumps(content))
    return load_actuators(JOINTS, str(path))


def written_out(form: str, dq, ddq, tau) -> np.ndarray:
    """Eq. 7 with Eq. 9 for speeds below 1 rad/s, where c_v2 dq² still grows slower than nu dq."""
    s = np.tanh(20 * dq)
    load = tau * s if form == "printed" else np.abs(tau) * s
    return J_M * ddq + s * (C_0 + NU * np.abs(dq) + C_V2 * dq**2) + C_1 * tau + C_12 * load


@each_form
def test_current_is_eq_7_and_9(form):
    drives, rng = load_actuators(JOINTS, form=form), np.random.default_rng(0)
    for _ in range(50):
        dq = rng.uniform(0.2, 1, 3) * rng.choice([-1, 1], 3)  # at 0.2 rad/s |dq| and dq tanh(20 dq) are 3e-4 of dq apart
        ddq, tau = rng.uniform(-5, 5, 3), rng.uniform(0.1, 40, 3) * rng.choice([-1, 1], 3)
        np.testing.assert_allclose(numbers(drives.current(dq, ddq, tau)), written_out(form, dq, ddq, tau), atol=2e-3)
        np.testing.assert_allclose(numbers(drives.motor_torque(dq, ddq, tau)), K_T * numbers(drives.current(dq, ddq, tau)))


@each_form
def test_eq_10_is_the_inverse_of_eq_7_and_9(form):
    drives, rng = load_actuators(JOINTS, form=form), np.random.default_rng(1)
    for _ in range(200):
        dq, ddq = rng.uniform(-4, 4, 3), rng.uniform(-5, 5, 3)
        tau = rng.uniform(0.05, 60, 3) * rng.choice([-1, 1], 3)  # from 0.05 Nm on |tau| is not rounded
        back = numbers(drives.load_torque(dq, ddq, drives.current(dq, ddq, tau)))
        np.testing.assert_allclose(back, tau, rtol=1e-10, atol=1e-10)  # rounding, c_1 being 0.1
        amperes = rng.uniform(-8, 8, 3)
        again = drives.load_torque(dq, ddq, amperes)
        keep = np.abs(numbers(again)) > 0.05
        np.testing.assert_allclose(numbers(drives.current(dq, ddq, again))[keep], amperes[keep], atol=1e-10)


def test_close_to_zero_torque_the_two_are_apart_by_the_rounding_alone():
    drives = load_actuators(JOINTS)
    dq = np.array([0.3, -0.7, 1.5])
    for tau in np.linspace(-0.05, 0.05, 21):
        back = numbers(drives.load_torque(dq, 0 * dq, drives.current(dq, 0 * dq, np.full(3, tau))))
        # rounding lifts |tau| by at most 2 * 3/16 * 0.05 Nm, of which c_12/(c_1 − |c_12|) comes back
        assert np.all(np.abs(back - tau) <= 0.019 * np.abs(C_12) / (C_1 - np.abs(C_12)) + 1e-12)


def test_friction_never_drives_the_joint():
    """Power lost in friction ≥ 0 up to 6 rad/s, where nu v + c_v2 v² alone would have turned over long ago."""
    drives, zero = load_actuators(JOINTS[1:]), np.zeros(2)
    assert np.any((C_0 + NU * 6 + C_V2 * 36)[1:] < 0)  # the grid reaches where the plain quadratic drives
    for speed in np.linspace(-6, 6, 121):
        for load in np.linspace(-60, 60, 13):
            dq, tau = np.full(2, speed), np.full(2, load)
            lost = K_T[1:] * (numbers(drives.current(dq, zero, tau)) - C_1[1:] * tau) * dq
            assert np.all(lost >= -1e-12)  # rounding of 60 Nm


def test_friction_of_every_joint_grows_and_then_stays():
    """Without load; the blend's width of 0.05 rad/s leaves it at most 1e-3 A from the greatest value beyond."""
    drives = load_actuators(JOINTS)
    speeds = np.linspace(0, 6, 601)
    friction = np.array([numbers(drives.current(np.full(3, v), np.zeros(3), np.zeros(3))) for v in speeds])
    assert np.all(np.diff(friction, axis=0) >= -1e-12)
    np.testing.assert_allclose(friction[-1], C_0 - NU**2 / (4 * C_V2), atol=1e-3 + 0.02 * np.abs(C_12).max())
    slope = np.diff(friction[speeds > 0.3], axis=0) / 0.01
    assert (
        np.abs(np.diff(slope, axis=0)).max() < 0.01 * 2 * 1.5 * np.abs(C_V2).max() * 2
    )  # no kink: curvature stays of the order of c_v2


def test_the_printed_form_drives_the_joint_under_negative_load():
    """Why the dissipative form is the default: c_12 sgn(dq) tau_l at tau_l < 0 pushes along with dq."""
    dq, tau, zero = np.full(3, 0.5), np.full(3, -40.0), np.zeros(3)
    part = [
        numbers(load_actuators(JOINTS, form=f).current(dq, zero, tau) - load_actuators(JOINTS, form=f).current(dq, zero, zero))
        - C_1 * tau
        for f in ("dissipative", "printed")
    ]
    assert np.all(part[0][1:] * dq[1:] > 0)
    assert np.all(part[1][1:] * dq[1:] < 0)


def test_power_is_eq_8(tmp_path):
    """U I with U = R I + k_t dq."""
    drives = with_resistance(tmp_path)
    dq, ddq, tau = np.array([0.4, -0.9, 0.7]), np.array([1.0, 2.0, -3.0]), np.array([3.0, 20.0, -8.0])
    amperes = written_out("dissipative", dq, ddq, tau)
    found = numbers(drives.power(dq, drives.current(dq, ddq, tau), 0.1))
    np.testing.assert_allclose(found, (0.8 * amperes + K_T * dq) * amperes, rtol=1e-3)  # tanh at 0.4


@pytest.mark.parametrize("kept", [0.0, 0.6, 1.0])
def test_of_a_weight_lifted_and_lowered_what_flows_back_counts_as_far_as_it_is_kept(kept):
    """In closed form, without friction: at a constant speed v a weight needs P = R I² ± tau v with I = tau / k_t."""
    zero, k_t, ohms = np.zeros(1), 10.0, 2.0
    drive = Actuators(("j",), np.array([k_t]), *[zero] * 3, np.array([1 / k_t]), zero, zero, np.array([ohms]), np.array([kept]))
    tau, v, duration = 20.0, 1.5, 3.0
    heat, work = ohms * (tau / k_t) ** 2 * duration, tau * v * duration
    dq = v * np.array([[1.0, -1.0]])
    current = np.array(drive.current(zero, zero, np.array([tau]))).astype(float).reshape(1, 1) @ np.ones((1, 2))
    up, down = duration * np.array(drive.exact_power(dq, current))[0]
    assert up == pytest.approx(heat + work)
    assert down == pytest.approx(kept * (heat - work))
    for width in (0.5, 20.0):  # smoothed, it counts more, by at most 3/16 of the width and only within it
        smooth = numbers(drive.power(dq[:, 1], current[:, 1], width))[0] * duration
        assert 0 <= smooth - down <= (1 - kept) * duration * 3 / 16 * width * (abs(heat - work) < width * duration) + 1e-12


def test_energy_needs_resistances():
    with pytest.raises(UserError, match=r"resistance.* of joint2, joint3"):
        load_actuators(("joint2", "joint3")).power(np.ones(2), np.ones(2), 0.0)


def test_bad_input(tmp_path):
    with pytest.raises(UserError, match=r"no joint 'elbow'; there are joint1, joint2, joint3"):
        load_actuators(("elbow",))
    with pytest.raises(UserError, match=r"'dissipative' or 'printed', got 'guessed'"):
        load_actuators(JOINTS, form="guessed")
    with pytest.raises(
        UserError, match=r"no actuators at 'nowhere.json'; give the path of a JSON file or the name of a bundled one: prototype"
    ):
        load_actuators(JOINTS, "nowhere.json")
    path = tmp_path / "drives.json"
    path.write_text("{")
    with pytest.raises(UserError, match=r"drives\.json, line 1, column 2: not valid JSON"):
        load_actuators(JOINTS, str(path))
    path.write_text(json.dumps({"joint1": {"colour": 1}}))
    with pytest.raises(UserError, match="unknown key 'colour'; allowed are torque_constant"):
        load_actuators(("joint1",), str(path))


@pytest.mark.parametrize(
    "content",
    [{"joint1": {}}, {"joint1": dict.fromkeys(Drive.__struct_fields__, "many")}, {"joint1": [1, 2]}, [1, 2]],
    ids=["a coefficient is missing", "not a number", "no object", "a list"],
)
def test_malformed_actuators_are_the_users_to_mend(tmp_path, content):
    path = tmp_path / "drives.json"
    path.write_text(json.dumps(content))
    with pytest.raises(UserError):
        load_actuators(("joint1",), str(path))


def test_a_motor_and_gear_in_torques_is_a_drive_in_currents():
    """A gear of 80 % takes 5/4 of the load's torque where it drives the load and passes on 4/5 where the load drives it."""
    given = {"dry_Nm": 2.0, "viscous_Nm_s_per_rad": 3.0, "inertia_kg_m2": 0.5, "efficiency": 0.8}
    dq, ddq, tau = np.array([1.5, 1.5, -1.5, -1.5]), np.array([2.0, -1.0, 2.0, -1.0]), np.array([10.0, -10.0, 10.0, -10.0])
    expected = 2.0 * np.sign(dq) + 3.0 * dq + 0.5 * ddq + np.where(tau * dq > 0, tau / 0.8, tau * 0.8)
    for more in ({}, {"torque_constant_Nm_per_A": 7.0, "resistance_Ohm": 0.9}):
        drive = MotorAndGear(**given, **more).drive
        motors = actuators_of({"a": drive})
        np.testing.assert_allclose(
            np.array(motors.motor_from_load(dq[None], ddq[None], tau[None])).ravel(), expected, rtol=1e-9
        )
        current = np.array([numbers(motors.current(dq[i : i + 1], ddq[i : i + 1], tau[i : i + 1]))[0] for i in range(4)])
        np.testing.assert_allclose(current * more.get("torque_constant_Nm_per_A", 1.0), expected, rtol=1e-9)
    power = float(np.array(motors.exact_power(dq[:1], expected[:1] / 7.0)).item())
    assert power == pytest.approx(0.9 * (expected[0] / 7) ** 2 + dq[0] * expected[0])


def test_a_resistance_needs_a_torque_constant():
    with pytest.raises(ValueError, match="a resistance needs torque_constant_Nm_per_A"):
        MotorAndGear(resistance_Ohm=1.0)
