"""Springs against their laws written out, their own energies, and a dense search for hardware; then the whole catalogue.

Every effect: names of the contract, derivatives, dissipation, energy, limits, agreement of numpy and CasADi, signatures against
differences of predictions, `model.json`.
"""

import re
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from recorded import Plant, as_set, by_trial, record
from scipy.integrate import solve_ivp

from rrr_oc.calibration.calibrated_model import CalibratedModel, Estimate, Term
from rrr_oc.calibration.inverse_dynamics import plain_model
from rrr_oc.calibration.jacobian import Prediction
from rrr_oc.calibration.model_file import load_model, save_model
from rrr_oc.calibration.samples import prepare
from rrr_oc.diagnosis.signatures import Tables, table, trials, view, without_sensors
from rrr_oc.effects import (
    CATALOGUE,
    BlackBox,
    BodyChange,
    Delay,
    Effect,
    LinkSpring,
    MotionShift,
    MovesLink,
    Signals,
    Trial,
    WithStates,
)
from rrr_oc.effects.black_box.echo import Echo
from rrr_oc.effects.black_box.empirical import Empirical
from rrr_oc.effects.black_box.friction_change import FrictionChange
from rrr_oc.effects.black_box.friction_course import FrictionCourse
from rrr_oc.effects.elastic.biarticular_spring import (
    HARDWARE_LIMITS,
    BiarticularSpring,
    hardware_exists,
    pick_hardware,
    reduced,
)
from rrr_oc.effects.elastic.cable_harness import CableHarness
from rrr_oc.effects.elastic.parallel_spring import ParallelSpring
from rrr_oc.effects.elastic.two_sided_biarticular_spring import TwoSidedBiarticularSpring
from rrr_oc.effects.friction.coupled_friction import CoupledFriction
from rrr_oc.effects.friction.load_dependent_friction import LoadDependentFriction
from rrr_oc.errors import UserError
from rrr_oc.model.motion import Motion
from rrr_oc.model.recorded_physics import states_along
from rrr_oc.model.symbolic_model import Model
from rrr_oc.numerics.smooth import TURNS, ramp, ramp_integral
from rrr_oc.numerics.smooth import sign as smooth_sign
from rrr_oc.recordings.header import Loop
from rrr_oc.robot.robot import load_robot

WINDINGS = [(1, 1), (1, -1), (-1, 1), (-1, -1)]
SPRINGS = [ParallelSpring((1,), "below"), ParallelSpring((1,), "above"), *[BiarticularSpring((1, 2), w) for w in WINDINGS]]
each_spring = pytest.mark.parametrize(
    "spring", SPRINGS, ids=lambda s: f"{s.name}-{getattr(s, 'active', '') or s.winding}".replace(" ", "")
)
BOUNDS = {"k_b": (0.0, 14.0), "q_0": (-2.5, 1.2), "r_1": (0.014, 0.039), "r_2": (0.019, 0.036), "r_3": (0.012, 0.045)}


def random_theta(spring, rng) -> np.ndarray:
    return rng.uniform([2, -1], [20, 1]) if len(spring.parameters) == 2 else rng.uniform([2, 0.3, -1], [20, 2, 1])


def torques(spring, q: np.ndarray, theta: np.ndarray, width: float) -> np.ndarray:
    """On all joints."""
    named = dict(zip([p.name for p in spring.parameters], theta, strict=True))
    tau = np.zeros(len(q))
    for joint, value in zip(spring.joints, spring.torque(Signals(q), named, width), strict=True):
        tau[joint] += float(value)
    return tau


def pull(spring, q: np.ndarray, theta: np.ndarray) -> float:
    """By how much the spring is stretched, slack below 0 [rad]; written out."""
    if isinstance(spring, ParallelSpring):
        return theta[1] - q[1] if spring.active == "below" else q[1] - theta[1]
    (w_a, w_b), (_, rho, phi) = spring.winding, theta
    return -w_a * q[1] - w_b * rho * q[2] - phi


@pytest.mark.parametrize("active", ["below", "above"])
def test_parallel_spring_is_eq_3(active):
    """−k (q − q_eq) on the active side of q_eq, nothing on the other."""
    spring, k, q_eq = ParallelSpring((0,), active), 7.0, 0.4
    for q in np.linspace(-2, 2, 41):
        taut = q <= q_eq if active == "below" else q >= q_eq
        found = torques(spring, np.array([q]), np.array([k, q_eq]), 0.0)
        np.testing.assert_allclose(found, [-k * (q - q_eq) if taut else 0], atol=1e-13)  # rounding


@pytest.mark.parametrize("winding", WINDINGS)
def test_biarticular_spring_is_eq_5_in_hardware(winding):
    """The cable leaves the spring's pulley r_1 and runs over r_2 and r_3: its tension is the spring's torque over r_1.

    The spring turns by −(± r_2 q_a ± r_3 q_b)/r_1 from rest, and pulls where that is more than q_0.
    """
    rng, taut = np.random.default_rng(1), 0
    for q in rng.uniform(-1.5, 1.5, (60, 3)):
        k_b, q_0, r_1, r_2, r_3 = (rng.uniform(*BOUNDS[k]) for k in ("k_b", "q_0", "r_1", "r_2", "r_3"))
        turn = -(winding[0] * r_2 * q[1] + winding[1] * r_3 * q[2]) / r_1 - q_0
        tension = k_b * max(turn, 0) / r_1
        expected = [0, winding[0] * r_2 * tension, winding[1] * r_3 * tension]
        theta = np.array(reduced(k_b, q_0, r_1, r_2, r_3))
        found = torques(BiarticularSpring((1, 2), winding), q, theta, 0.0)
        np.testing.assert_allclose(found, expected, atol=1e-12)  # rounding
        taut += turn > 0
    assert 10 < taut < 50  # both sides were seen


@each_spring
def test_smooth_law_is_exact_outside_its_width(spring):
    """And within it off by no more than 3/16 of the width, which it is in the middle."""
    rng, width, inside = np.random.default_rng(2), 0.2, 0
    for q in rng.uniform(-1.5, 1.5, (200, 3)):
        theta = random_theta(spring, rng)
        smooth, exact = torques(spring, q, theta, width), torques(spring, q, theta, 0.0)
        if abs(pull(spring, q, theta)) >= width:
            np.testing.assert_allclose(smooth, exact, atol=1e-12)
        else:
            ratio = 1 if isinstance(spring, ParallelSpring) else max(1, theta[1])
            excess = np.abs(smooth - exact).max() / (theta[0] * ratio)
            assert 0 < excess <= 3 / 16 * width * (1 + 1e-12)
            inside += 1
    assert inside > 5


@each_spring
@pytest.mark.parametrize("width", [1e-3, 0.5])
def test_torque_is_the_slope_of_the_energy(spring, width):
    q, theta = ca.SX.sym("q", 3), ca.SX.sym("theta", len(spring.parameters))
    named = {p.name: theta[i] for i, p in enumerate(spring.parameters)}
    gradient = ca.Function("gradient", [q, theta], [ca.gradient(spring.energy(Signals(q), named, width), q)])
    rng = np.random.default_rng(3)
    for at in rng.uniform(-1.5, 1.5, (50, 3)):
        values = random_theta(spring, rng)
        found = -np.array(gradient(at, values)).ravel()
        np.testing.assert_allclose(found, torques(spring, at, values, width), atol=1e-10)  # cancellation within the width


@each_spring
def test_energy_is_none_where_slack_and_the_parabola_where_taut(spring):
    """k s²/2, and w²/10 of it more, which the width stores."""
    rng, width = np.random.default_rng(4), 0.1
    names = [p.name for p in spring.parameters]
    for q in rng.uniform(-1.5, 1.5, (50, 3)):
        theta = random_theta(spring, rng)
        s, found = pull(spring, q, theta), float(spring.energy(Signals(q), dict(zip(names, theta, strict=True)), width))
        if s <= -width:
            assert found == pytest.approx(0, abs=1e-15)
        elif s >= width:
            assert found == pytest.approx(theta[0] * (s**2 / 2 + width**2 / 10), rel=1e-12)


@pytest.mark.parametrize("name", CATALOGUE)
def test_what_stores_energy_gives_it_back(name):
    """Any effect of the catalogue that has an energy."""
    kind, rng = CATALOGUE[name], np.random.default_rng(5)
    try:
        effect = kind((0,))
    except UserError:
        effect = kind((0, 1))
    q = ca.SX.sym("q", 2)
    theta = {p.name: float(np.clip(p.nominal + rng.uniform(0.1, 0.5), p.lower, p.upper)) for p in effect.parameters}
    energy = ca.SX(effect.energy(Signals(q), theta, 0.3))
    if not energy.is_constant():
        gradient = ca.Function("gradient", [q], [ca.gradient(energy, q)])
        for at in rng.uniform(-2, 2, (30, 2)):
            np.testing.assert_allclose(
                -np.array(gradient(at)).ravel(), torques(effect, at, np.array([*theta.values()]), 0.3), atol=1e-10
            )


@pytest.mark.parametrize("turn", TURNS)
def test_every_way_to_change_sign_is_odd_monotonic_and_exact_in_the_limit(turn):
    x, at = ca.SX.sym("x"), np.linspace(-3, 3, 61)
    for width in (0.3, 0.0):
        symbolic = np.array(ca.Function("sign", [x], [smooth_sign(x, width, turn)])(at)).ravel()
        np.testing.assert_allclose(symbolic, found := smooth_sign(at, width, turn), atol=1e-12)
        np.testing.assert_allclose(found, -found[::-1], atol=1e-12)
        assert np.all(np.diff(found) >= 0)
    np.testing.assert_array_equal(found, np.sign(at))
    assert smooth_sign(1e9, 0.3, turn) == pytest.approx(1.0, abs=1e-8)


@pytest.mark.parametrize("width", [1e-3, 0.7])
def test_ramp_is_twice_continuously_differentiable(width):
    """Value, slope and curvature from both sides of ±w, and exactly there; the third derivative jumps, so that is all of it."""
    x = ca.SX.sym("x")
    orders = [ramp(x, width)]
    for _ in range(3):
        orders.append(ca.gradient(orders[-1], x))
    function = ca.Function("orders", [x], [ca.vertcat(*orders)])

    def at(place: float) -> np.ndarray:
        return np.array(function(place)).ravel() * width ** np.array([-1, 0, 1, 2])  # dimensionless

    for edge, known in ((-width, [0, 0, 0]), (width, [1, 1, 0])):
        for place in (edge * (1 - 1e-9), edge, edge * (1 + 1e-9)):
            np.testing.assert_allclose(at(place)[:3], known, atol=1e-8)  # 1e-9 away times the third derivative of 3
    assert abs(at(-width * (1 - 1e-9))[3] - at(-width * (1 + 1e-9))[3]) > 1
    assert at(0.0)[0] == pytest.approx(3 / 16)


def test_ramp_against_its_integral_and_its_limits():
    rng = np.random.default_rng(6)
    for x, width in np.column_stack([rng.uniform(-2, 2, 100), rng.uniform(0.01, 1, 100)]):
        step = 1e-5
        slope = (float(ramp_integral(x + step, width)) - float(ramp_integral(x - step, width))) / (2 * step)
        assert slope == pytest.approx(float(ramp(x, width)), abs=1e-8)  # step²/width of truncation, at most
        assert float(ramp(x, 0)) == max(x, 0)
        assert float(ramp_integral(x, 0)) == pytest.approx(max(x, 0) ** 2 / 2, rel=1e-15)
        assert float(ramp(x, width)) - float(ramp(-x, width)) == pytest.approx(x, abs=1e-14)  # as of the exact ramp


def test_two_smooth_springs_back_to_back_are_a_linear_one():
    """One below and one above the same equilibrium, equally stiff: the widths cancel."""
    for q in np.linspace(-0.3, 0.3, 31):
        pair = sum(torques(ParallelSpring((0,), side), np.array([q]), np.array([4.0, 0.1]), 0.2) for side in ("below", "above"))
        np.testing.assert_allclose(pair, [-4.0 * (q - 0.1)], atol=1e-14)


def test_a_spring_across_two_joints_pulls_both_ways_as_two_of_one_way_do():
    """kappa (1, rho) times the stretch, and two springs of Eq. 5 back to back, of opposite windings."""
    rng, theta = np.random.default_rng(22), np.array([6.0, -0.8, 0.3])
    spring = TwoSidedBiarticularSpring((1, 2))
    pair = [(BiarticularSpring((1, 2), (way, -way)), np.array([6.0, 0.8, -way * 0.3])) for way in (1, -1)]
    for q in rng.uniform(-2, 2, (30, 3)):
        found = torques(spring, q, theta, 0.0)
        np.testing.assert_allclose(found, [0, 1, -0.8] * np.array(-6.0 * (q[1] - 0.8 * q[2] - 0.3)), atol=1e-12)
        np.testing.assert_allclose(found, sum(torques(one, q, numbers, 0.0) for one, numbers in pair), atol=1e-12)


def test_a_harness_may_harden_and_has_a_third_parameter_only_then(arm, tmp_path):
    """−k x − h x³ about its rest, whose energy it gives back; it is the linear law where h is 0; `model.json` keeps which it is."""
    plain, hard = CableHarness((1,)), CableHarness((1,), True)
    assert [p.name for p in plain.parameters] == ["stiffness", "rest"]
    assert [p.name for p in hard.parameters] == ["stiffness", "rest", "hardening"]
    q, theta = np.random.default_rng(23).uniform(-2, 2, (30, 3)), np.array([3.0, 0.4, -0.7])
    for at in q:
        found, x = torques(hard, at, theta, 0.0), at[1] - 0.4
        np.testing.assert_allclose(found, [0, -3.0 * x + 0.7 * x**3, 0], atol=1e-12)  # rounding
        np.testing.assert_allclose(torques(plain, at, theta[:2], 0.0), torques(hard, at, theta * [1, 1, 0], 0.0), atol=1e-12)
        named = dict(zip(("stiffness", "rest", "hardening"), theta, strict=True))
        sides = [float(hard.energy(Signals(at + step * np.eye(3)[1]), named, None)) for step in (1e-5, -1e-5)]
        assert -(sides[0] - sides[1]) / 2e-5 == pytest.approx(found[1], abs=1e-8)  # rounding over the step
    terms = tuple(Term(e, tuple(map(Estimate, theta[: len(e.parameters)]))) for e in (plain, hard))
    save_model(replace(arm[0], terms=terms, noise=np.ones(3), nrmse=np.ones(3)), tmp_path / "model.json")
    assert load_model(tmp_path / "model.json").terms == terms


def test_torques_of_several_springs_add_up_in_a_model():
    """Three springs on two joints, some of them on the same, through `Model`: Eq. 6."""
    robot = load_robot("rrr")
    springs = (ParallelSpring((1,)), ParallelSpring((2,), "above"), BiarticularSpring((1, 2), (1, -1)))
    model, bare, rng = Model(robot, robot.tool, springs), Model(robot, robot.tool), np.random.default_rng(7)
    widths = np.array([0.1, 0.2, 0.3])
    for q, dq, ddq in rng.normal(size=(20, 3, 3)):
        theta = [random_theta(s, rng) for s in (springs[0], springs[0], springs[2])]
        # the second spring sits on joint 2, the helper's `torques` places it there by itself
        expected = sum(torques(s, q, t, w) for s, t, w in zip(springs, theta, widths, strict=True))
        tau, spring = (np.array(o).ravel() for o in model.inverse(q, dq, ddq, 1.5, np.concatenate(theta), widths))
        np.testing.assert_allclose(spring, expected, atol=1e-12)
        rigid = np.array(bare.inverse(q, dq, ddq, 1.5, [], [])[0]).ravel()
        np.testing.assert_allclose(tau, rigid - expected, atol=1e-11)
        again = np.array(model.forward(q, dq, tau, 1.5, np.concatenate(theta), widths)).ravel()
        np.testing.assert_allclose(again, ddq, atol=1e-9)  # the mass matrix's condition
        stored = sum(
            float(s.energy(Signals(q), dict(zip([p.name for p in s.parameters], t, strict=True)), w))
            for s, t, w in zip(springs, theta, widths, strict=True)
        )
        assert float(model.energy(q, dq, 1.5, np.concatenate(theta), widths)[2]) == pytest.approx(stored, rel=1e-12)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: BiarticularSpring((1,)), "two different joints"),
        (lambda: BiarticularSpring((1, 1)), "two different joints"),
        (lambda: TwoSidedBiarticularSpring((1, 1)), r"two different joints, got \(1, 1\)"),
        (lambda: BiarticularSpring((0, 1), (1, 0)), r"winding is 2 of 1 or -1, got \(1, 0\)"),
        (lambda: BiarticularSpring((0, 1), (1,)), r"winding is 2 of 1 or -1"),  # pyright: ignore[reportArgumentType]
        (lambda: LoadDependentFriction((0,), "gear"), "follows load, motor, motor without friction, got 'gear'"),  # pyright: ignore[reportArgumentType]
        (lambda: ParallelSpring((0,), "left"), "active is 'below' or 'above', got 'left'"),  # pyright: ignore[reportArgumentType]
    ],
)
def test_springs_that_are_turned_away(make, message):
    with pytest.raises(UserError, match=message):
        make()


@pytest.mark.parametrize(
    ("stiffness", "equilibrium", "possible"), [(5.0, 1.0, True), (-0.1, 1.0, False), (5.0, 13.0, False), (0.0, -12.0, True)]
)
def test_springs_that_push_or_rest_out_of_reach_are_impossible(stiffness, equilibrium, possible):
    theta = {"stiffness": stiffness, "equilibrium": equilibrium}
    assert ParallelSpring((0,)).possible(theta, 0.0) == possible


def random_hardware(rng) -> dict[str, float]:
    return {name: float(rng.uniform(*bounds)) for name, bounds in BOUNDS.items()}


def inequalities(kappa: float, rho: float, phi: float) -> np.ndarray:
    return np.array(hardware_exists(kappa, rho, phi, BOUNDS)).ravel()


def found_by_search(kappa: float, rho: float, phi: float, points: int = 300) -> bool:
    """Whether any r_1, r_2 of a dense grid, edges included, leaves r_3, k_b and q_0, which follow, within bounds."""
    r_1, r_2 = np.meshgrid(*(np.linspace(*BOUNDS[r], points) for r in ("r_1", "r_2")))
    within = np.ones(r_1.shape, bool)
    for name, value in (("r_3", rho * r_2), ("k_b", kappa * (r_1 / r_2) ** 2), ("q_0", phi * r_2 / r_1)):
        within &= (BOUNDS[name][0] <= value) & (value <= BOUNDS[name][1])
    return bool(within.any())


def test_hardware_that_exists_passes_and_is_picked_again():
    """Every corner of the bounds too."""
    rng = np.random.default_rng(8)
    corners = [dict(zip(BOUNDS, c, strict=True)) for c in np.array(np.meshgrid(*BOUNDS.values())).reshape(5, -1).T]
    for hardware in [*[random_hardware(rng) for _ in range(500)], *corners]:
        kappa, rho, phi = (float(v) for v in reduced(*(hardware[k] for k in BOUNDS)))
        limits = inequalities(kappa, rho, phi)
        assert limits.size == len(HARDWARE_LIMITS)
        assert limits.max() <= 1e-12  # corners reach 0 but for rounding
        picked = pick_hardware(kappa, rho, phi, BOUNDS)
        np.testing.assert_allclose(reduced(*(picked[k] for k in BOUNDS)), (kappa, rho, phi), rtol=1e-12, atol=1e-14)
        for name, (low, high) in BOUNDS.items():
            slack = 1e-9 * max(abs(low), abs(high))
            assert low - slack <= picked[name] <= high + slack, name


def test_the_inequalities_hold_exactly_where_a_search_finds_hardware():
    """Random (kappa, rho, phi) over a wider region; those too near a limit for the grid to tell are left out."""
    rng, seen = np.random.default_rng(9), {True: 0, False: 0}
    for _ in range(400):
        target = (rng.uniform(0, 90), rng.uniform(0.2, 2.8), rng.uniform(-6, 3))
        worst = inequalities(*target).max()
        if worst > 0:
            assert not found_by_search(*target)
            with pytest.raises(UserError, match="no hardware within bounds gives kappa"):
                pick_hardware(*target, BOUNDS)
        elif worst < -0.02:
            assert found_by_search(*target)
        seen[bool(worst > 0)] += 1
    assert min(seen.values()) > 50


def test_every_inequality_is_needed():
    """For each there is a target, off from hardware at that limit, that breaks this one alone."""
    targets = np.random.default_rng(10).uniform([0, 0.25, -6], [120, 2.6, 3], (20000, 3)).T
    inputs = ca.SX.sym("target", 3)
    limits = ca.Function("limits", [inputs], [hardware_exists(inputs[0], inputs[1], inputs[2], BOUNDS)])
    over = np.array(limits(targets)) > 0
    broken = {int(row) for row in over[:, over.sum(axis=0) == 1].argmax(axis=0)}
    assert broken == set(range(len(HARDWARE_LIMITS)))


def test_no_spring_at_all_is_hardware():
    """kappa = 0: a spring of no stiffness, whatever the rest."""
    assert pick_hardware(0.0, 1.0, 0.0, BOUNDS)["k_b"] == 0
    assert inequalities(0.0, 1.0, 0.0).max() <= 0


# --- the whole catalogue ---

CONTRACT = {
    "coulomb_asymmetry": "asymmetry",
    "stribeck": "excess velocity",
    "quadratic_drag": "coefficient",
    "load_dependent_friction": "mu",
    "presliding_hysteresis": "stiffness",
    "friction_drift": "ratio time_constant",
    "position_dependent_friction": "amplitude",
    "torque_ripple": "amplitude order phase",
    "torque_gain": "gain",
    "torque_offset": "offset",
    "controller_gain": "kp_scale kd_scale",
    "backlash": "gap",
    "joint_elasticity": "stiffness",
    "cable_harness": "stiffness rest",
    "encoder_offset": "offset",
    "coupled_friction": "coulomb viscous",
    "parallel_spring": "stiffness equilibrium",
    "biarticular_spring": "kappa rho phi",
    "two_sided_biarticular_spring": "kappa rho phi",
    "viscous_asymmetry": "asymmetry",
    "missing_gravity": "share",
    "spring_stiffness": "scale",
    "spring_preload": "offset",
    "spring_hysteresis": "loss",
    "payload_mass": "mass",
    "payload_com": "x y z",
    "link_inertial": "mass",  # beside vectors, whose components have names of their own
    "gravity_tilt": "about_x about_y",
    "time_delay": "delay",
}
SEARCHED = [name for name in CONTRACT if name != "time_delay"]  # a delay is a part of every model
LISTED = {(1,): (ParallelSpring((1,)), {"stiffness": 6.0, "equilibrium": 0.8}, 1e-3)}
SAMPLES = 40
LOOP = Loop(np.array([300.0, 400.0, 200.0]), np.array([3.0, 5.0, 2.0]))  # for the effects of recorded commands


def placed(name: str) -> Effect:
    """An effect of the catalogue on joints of an arm with three."""
    kind = CATALOGUE[name]
    if kind is Empirical:
        return Empirical((1,), (("q", 1), ("load", 1)), (-1.0, -20.0), (1.0, 20.0), (2, 1), "turned")
    return kind({"arm": (), "pair": (1, 2)}.get(kind.placement, (1,)))


def admissible(effect: Effect, rng) -> dict[str, float]:
    """Random parameters within their bounds; a joint stiffness as soft as real ones."""
    theta = {p.name: float(np.clip(rng.uniform(0.2, 0.8) + min(p.nominal, 1.0), p.lower, p.upper)) for p in effect.parameters}
    return {**theta, "stiffness": 400.0} if effect.name == "joint_elasticity" else theta


def random_signals(rng) -> dict[str, np.ndarray]:
    """Arrays that `Signals` may hold, of three joints."""
    found = {k: rng.normal(0, scale, (3, SAMPLES)) for k, scale in (("q", 1.0), ("dq", 0.5), ("ddq", 3.0), ("load", 12.0))}
    found |= {"time": rng.uniform(0, 20, SAMPLES), "payload": rng.uniform(0, 5, SAMPLES)}
    found |= {"rotor": -0.3 * found["ddq"], "braking": 1.5 * found["dq"]}
    return found | {"states": rng.uniform(-1, 1, (2, SAMPLES)), "friction": -np.sign(found["dq"]) * rng.uniform(1, 2, (3, 1))}


def parts_of(effect: Effect, signals: Signals, theta, width) -> list[tuple]:
    """Torque on the effect's joints, the rate of its states, and the shift."""
    rate = effect.rate(signals, theta, width) if isinstance(effect, WithStates) else ()
    shift = effect.shift(signals, theta, width) if isinstance(effect, MotionShift) else ()
    return [effect.torque(signals, theta, width), rate, shift]


def law(effect: Effect, arrays: dict[str, np.ndarray], theta: dict[str, float], width: float | None = 0.05) -> np.ndarray:
    """These by numpy, one below the other."""
    parts = parts_of(effect, Signals(**arrays, springs=LISTED), theta, width)
    rows = [np.broadcast_to(np.asarray(x, float), (SAMPLES,)) for part in parts for x in part]
    return np.array(rows).reshape(-1, SAMPLES)


def symbolic(effect: Effect, width: float | None = 0.05) -> tuple[ca.Function, list[str]]:
    """The same as a CasADi Function of (inputs by name, theta)."""
    shapes = {"q": 3, "dq": 3, "ddq": 3, "load": 3, "time": 1, "payload": 1, "states": 2, "friction": 3, "rotor": 3}
    shapes["braking"] = 3
    inputs = {k: ca.SX.sym(k, rows) for k, rows in shapes.items()}
    theta = ca.SX.sym("theta", len(effect.parameters))
    named = {p.name: theta[i] for i, p in enumerate(effect.parameters)}
    parts = parts_of(effect, Signals(**inputs, springs=LISTED), named, width)
    out = ca.vertcat(*(ca.SX(x) for part in parts for x in part))
    return ca.Function("law", [*inputs.values(), theta], [out], [*inputs, "theta"], ["torque"]), list(inputs)


each_effect = pytest.mark.parametrize("name", CATALOGUE)


def printed_torques(law: str, values: dict[str, Any]) -> list[np.ndarray]:
    """The torques of an effect's law as it is printed, with numbers in the place of its names: an evaluator of its own."""
    parts = dict(part.split(" = ", 1) for part in re.split(r", (?=\w+ = )", law))
    known = {**values, "sgn": lambda x: smooth_sign(x, 0.05), "exp": np.exp, "cos": np.cos, "sin": np.sin, "abs": abs}
    known["max"] = lambda x, _: ramp(x, 0.05)
    for name in sorted(parts, key=lambda part: (part.startswith("tau"), part)):
        text = re.sub(r"\|([^|]+)\|", r"abs(\1)", parts[name]).replace("^", "**")
        text = re.sub(r"([\w)]) (?=[\w(])", r"\1 * ", text)  # a product is written as a space
        known[name] = eval(text, {"__builtins__": {}}, known)
    return [known[name] for name in ("tau", "tau_a", "tau_b") if name in parts]


FORMS = [
    *(ParallelSpring((1,), active) for active in ("below", "above")),
    *(BiarticularSpring((1, 2), (a, b)) for a in (1, -1) for b in (1, -1)),
    *(CableHarness((1,), hardens) for hardens in (False, True)),
    *(CoupledFriction((1, 2), form) for form in ("sum", "difference", "other")),
    TwoSidedBiarticularSpring((1, 2)),
    *(CATALOGUE[name]((1,)) for name in ("torque_ripple", "position_dependent_friction", "quadratic_drag", "stribeck")),
    *(CATALOGUE[name]((1,)) for name in ("viscous_asymmetry", "coulomb_asymmetry")),
]


@pytest.mark.parametrize("effect", FORMS, ids=str)
def test_the_law_that_is_printed_is_the_law_that_is_fitted(effect):
    """Also in the form that its options give it, so that whoever takes law and numbers from a report has the torque."""
    rng = np.random.default_rng(5)
    arrays, theta = random_signals(rng), admissible(effect, rng)
    own = {f"{kind}{end}": arrays[kind][j] for kind in ("q", "dq") for end, j in zip(("_a", "_b"), effect.joints, strict=False)}
    own |= {kind: arrays[kind][effect.joints[0]] for kind in ("q", "dq")}
    found = printed_torques(effect.law, {**own, **theta})
    torques = [t for t in effect.torque(Signals(**arrays), theta, 0.05) if np.any(t)]
    assert len(found) == len(torques)
    for printed, torque in zip(found, torques, strict=True):
        assert np.any(torque)
        np.testing.assert_allclose(printed, torque, rtol=1e-12, atol=1e-12)  # rounding


def test_catalogue_has_the_effects_of_the_contract():
    """By exactly their names; beside them only what every calibrated model has, what stands for no law, and springs of designs."""
    beside = {name for name, kind in CATALOGUE.items() if kind.role != "law"}
    assert set(CATALOGUE) - beside == set(CONTRACT)
    for name, parameters in CONTRACT.items():
        effect = placed(name)
        names = [p.name for p in effect.parameters]
        assert set(parameters.split()) <= set(names)
        assert set(effect.amplitudes) <= set(names)
        assert effect.equation


@each_effect
def test_numpy_and_casadi_agree(name):
    effect, rng = placed(name), np.random.default_rng(11)
    function, order = symbolic(effect)
    for _ in range(5):
        theta, arrays = admissible(effect, rng), random_signals(rng)
        columns_of = [np.atleast_2d(arrays[k]) for k in order]
        found = np.array(function(*columns_of, np.tile(np.array([*theta.values()])[:, None], SAMPLES)))
        np.testing.assert_allclose(found.reshape(-1, SAMPLES), law(effect, arrays, theta), rtol=1e-12, atol=1e-12)  # rounding


@each_effect
def test_derivatives_against_differences(name):
    """CasADi's Jacobians by every input and parameter against central differences of the law in numpy."""
    effect, rng = placed(name), np.random.default_rng(12)
    width = 0.3  # wide, so that differences of 1e-6 see the curve
    function, order = symbolic(effect, width)
    if function.size1_out(0) == 0:
        return  # of the side "body": see `test_body_effects_are_those_of_pinocchio`
    jacobian = function.jacobian()
    theta, arrays, step = admissible(effect, rng), random_signals(rng), 1e-6
    arguments = [*(np.atleast_2d(arrays[k])[:, :1] for k in order), np.array([*theta.values()])]
    found = jacobian(*arguments, np.zeros(function.size1_out(0)))
    for i, key in enumerate([*order, "theta"]):
        for row in range(np.atleast_2d(arguments[i]).shape[0] if key != "theta" else len(theta)):
            sides = []
            for sign in (1, -1):
                moved, values = {k: np.array(v) for k, v in arrays.items()}, dict(theta)
                if key == "theta":
                    parameter = [*theta][row]
                    values[parameter] += sign * step * max(1, abs(theta[parameter]))
                else:
                    np.atleast_2d(moved[key])[row] += sign * step
                sides.append(law(effect, moved, values, width)[:, 0])
            size = step * (max(1, abs([*theta.values()][row])) if key == "theta" else 1)
            expected = (sides[0] - sides[1]) / (2 * size)
            scale = max(1.0, np.abs(expected).max())
            np.testing.assert_allclose(np.array(found[i])[:, row], expected, atol=1e-6 * scale, err_msg=f"{name} by {key}")


def test_body_effects_are_those_of_pinocchio():
    """Torque with each effect of the side "body" against numeric Pinocchio with the bodies and gravity changed there."""
    robot, rng = load_robot("rrr"), np.random.default_rng(13)
    tool = replace(robot.tool, position=np.array([0.3, 0.02, -0.01]))
    reference = Plant("rrr", *np.zeros((3, 3))).model
    for name in ("payload_mass", "payload_com", "gravity_tilt", "link_inertial", "missing_gravity"):
        effect = placed(name)
        theta = {p.name: float(rng.uniform(-0.05, 0.05)) for p in effect.parameters}
        changed, held, point = reference.copy(), 2.0, np.array(tool.position)
        if name == "payload_mass":
            held += theta["mass"]
        if name == "payload_com":
            point = point + [theta[k] for k in "xyz"]
        if name == "gravity_tilt":  # the base turns about a horizontal axis; gravity stays
            turn = pin.exp3(np.array([theta["about_x"], theta["about_y"], 0.0]))
            changed.gravity.linear = turn.T @ changed.gravity.linear
        if name == "missing_gravity":
            changed.gravity.linear = (1 - theta["share"]) * changed.gravity.linear
        if name == "link_inertial":
            whole = changed.inertias[2].toDynamicParameters() + np.array([*theta.values()])
            changed.inertias[2] = pin.Inertia.FromDynamicParameters(whole)
        changed.appendBodyToJoint(3, pin.Inertia(held, np.zeros(3), np.zeros((3, 3))), pin.SE3(np.eye(3), point))
        model = Model(robot, tool, (effect,))
        for q, dq, ddq in rng.normal(size=(10, 3, 3)):
            expected = pin.rnea(changed, changed.createData(), q, dq, ddq)
            found = model.inverse(q, dq, ddq, 2.0, [*theta.values()], [])[0]
            np.testing.assert_allclose(np.array(found).ravel(), expected, atol=1e-10, err_msg=name)  # rounding


FRICTION = ("stribeck", "quadratic_drag", "load_dependent_friction", "spring_hysteresis", "dry_friction", "viscous_friction")


@pytest.mark.parametrize("name", [*FRICTION, "coupled_friction", "coupled_friction-difference"])
def test_friction_never_drives(name):
    """torque · dq ≤ 0, summed over the joints of one effect."""
    kind = name.split("-")[0]
    effect = CoupledFriction((1, 2), "difference") if name.endswith("difference") else placed(kind)
    rng, lost = np.random.default_rng(14), 0.0
    for _ in range(20):
        arrays = random_signals(rng)
        power = np.sum(law(effect, arrays, admissible(effect, rng)) * arrays["dq"][list(effect.joints)], axis=0)
        assert np.all(power <= 0)
        lost -= power.sum()
    assert lost > 1


@pytest.mark.parametrize("name", ["coulomb_asymmetry", "friction_drift", "position_dependent_friction"])
def test_friction_that_varies_about_the_plain_level_never_drives_with_it(name):
    """Up to the plain level they take from it or add to it; beyond it they would drive, and the test would see that."""
    effect, rng, width, driven = placed(name), np.random.default_rng(15), 0.05, 0
    for beyond in (1.0, 1.5):
        for _ in range(20):
            arrays = random_signals(rng)
            level = rng.uniform(1, 2)
            plain = -level * np.tanh(arrays["dq"][1] / width)
            arrays["friction"] = np.tile(plain, (3, 1))
            most = {"asymmetry": 2 * level, "ratio": 1.0, "amplitude": level}
            theta = admissible(effect, rng)
            theta |= {k: rng.choice([-1, 1]) * beyond * v for k, v in most.items() if k in theta}
            if name == "friction_drift":
                arrays["time"] = 0 * arrays["time"]  # when it is strongest
            power = (law(effect, arrays, theta, width)[0] + plain) * arrays["dq"][1]
            if beyond == 1:
                assert np.all(power <= 1e-12)  # rounding
            driven += beyond > 1 and bool(np.any(power > 1e-6))
    assert driven > 3


def test_bristles_give_back_no_more_than_they_took():
    """Dahl's state stays within ±1, and friction's work is what the bristles store and what is lost, which is never negative."""
    effect, rng = placed("presliding_hysteresis"), np.random.default_rng(16)
    arrays, theta = random_signals(rng), {"stiffness": 300.0, "level": 2.0}
    torque, rate = law(effect, arrays, theta, 0.0)
    z, dq = arrays["states"][0], arrays["dq"][1]
    stored = theta["level"] ** 2 / theta["stiffness"] * z * rate  # d/dt of level² z²/(2 stiffness)
    lost = -torque * dq - stored
    np.testing.assert_allclose(lost, theta["level"] * np.abs(dq) * z**2, atol=1e-12)
    edge = {**arrays, "states": np.sign(dq)[None]}
    np.testing.assert_allclose(law(effect, edge, theta, 0.0)[1], 0, atol=1e-9)  # it slips


@pytest.mark.parametrize(("stiffness", "time"), [(40.0, 0.01), (40.0, 0.05), (2000.0, 0.002)])
def test_a_link_behind_its_spring_against_an_adaptive_integrator(stiffness, time):
    """Under a load, an inertia and a gravity that change, sampled unevenly, as it begins and when it begins otherwise."""
    t = np.sort(np.arange(400) / 100 + np.random.default_rng(15).uniform(-2e-3, 2e-3, 400))
    theta, effect = {"stiffness": stiffness, "damping_time": time}, placed("joint_elasticity")

    def given(at):
        return 10 * np.sin(2 * at) + 4 * np.cos(3 * at), 5 * np.cos(at), 0.3 + 0.1 * np.sin(2 * at)

    def slope(at, y):
        load, more, mass = given(at)
        return [y[1], -(load + (stiffness + more) * y[0] + stiffness * time * y[1]) / mass]

    found = effect.motion(t, *given(t), theta)
    for more, off in ((np.zeros((3, t.size)), np.zeros(2)), *zip(effect.free(t, *given(t)[1:], theta), np.eye(2), strict=True)):
        start = found[:2, 0] + off
        exact = solve_ivp(slope, (t[0], t[-1]), start, t_eval=t, rtol=1e-9, atol=1e-11).y
        exact = np.array([*exact, [slope(*x)[1] for x in zip(t, exact.T, strict=True)]])
        off = np.abs(found + more - exact).max(axis=1) / np.abs(exact).max(axis=1)
        assert np.all(off < (0.002, 0.01, 0.05)), off


def test_a_link_of_estimates_gone_astray_stays_within_reason():
    """An inertia that changes sign, as the sum of wrong estimates may, and a gear far too soft."""
    t = np.arange(3000) / 100
    load, mass = 10 * np.sin(2 * t), 0.5 + np.sin(t)
    found = placed("joint_elasticity").motion(t, load, 0 * t - 5.0, mass, {"stiffness": 2.0, "damping_time": 0.0})
    assert np.all(np.isfinite(found))
    assert np.abs(found[0]).max() <= 1.0


@pytest.mark.parametrize("damping", [0.0, 2.0, 20.0])
def test_a_link_falls_through_the_gap_as_grease_lets_it(damping):
    """Under a constant load that changes sign: M x'' + damping x' = -load from rest, to the other end, where it stays."""
    t, mass, load, gap = np.arange(400) / 400, 0.5, 3.0, 0.1
    late = np.clip(t - 0.25, 0, None)
    found = placed("backlash").motion(t, np.where(late > 0, load, -load), 0 * t, mass + 0 * t, {"gap": gap, "damping": damping})
    fallen = load / mass * late**2 / 2
    if damping:
        fallen = load / damping * (late - mass / damping * (1 - np.exp(-damping / mass * late)))
    exact = np.maximum(gap / 2 - fallen, -gap / 2)
    np.testing.assert_allclose(found[0], exact, atol=0.03 * gap)
    assert found[0, -1] == -gap / 2
    assert not np.any(found[1:, late == 0])


def test_an_echo_has_the_course_that_its_rates_have():
    """Against an adaptive integrator, from rest."""
    t, effect = np.arange(300) / 100, placed("echo")
    theta = {"frequency": 7.0, "damping": 0.15, "lag": 0.3, "swing": -0.2}

    def load(at):
        return np.array([0 * at, 5 + 4 * np.sin(3 * at) ** 2, 0 * at])

    def slope(at, x):
        return effect.rate(Signals(np.zeros(3), load=load(at), states=x), theta, None)

    exact = solve_ivp(slope, (0, t[-1]), effect.rest(load(0.0)), t_eval=t, rtol=1e-9, atol=1e-10).y
    np.testing.assert_allclose(effect.course(t, load(t)[1], theta), exact, atol=2e-3 * np.abs(exact).max())


def test_bristles_between_samples_follow_the_motion():
    """Against an adaptive integrator on the motion itself, which turns around within the bristles' reach and few samples."""
    t, size, turn = np.arange(200) / 100, 0.01, 30.0
    theta, effect = {"stiffness": 3000.0, "level": 2.0}, placed("presliding_hysteresis")

    def motion(at):
        x = turn * at
        return [np.array([0 * x, y, 0 * x]) for y in (size * np.sin(x), size * turn * np.cos(x), -size * turn**2 * np.sin(x))]

    def slope(at, z):
        return effect.rate(Signals(*motion(at)[:2], states=z), theta, 0.0)[0]

    exact = solve_ivp(slope, (0, t[-1]), [0.0], t_eval=t, rtol=1e-9, atol=1e-10, max_step=1e-3).y
    q, dq, ddq = motion(t)
    found = states_along(Motion(t, q, dq, ddq, 0 * t), effect, theta, 0.0)
    assert np.abs(exact).max() > 0.99  # it slips
    assert np.mean(np.abs(exact) < 0.9) > 0.1  # and turns around
    assert np.abs(found - exact).max() < 0.03  # 0.020; with half as many steps 0.072


@each_effect
def test_an_effect_derives_from_what_it_says_that_it_is(name):
    """Models ask for the class; an effect that only declares the side, states or role would do nothing there."""
    kind = CATALOGUE[name]
    assert (kind.side == "body") == issubclass(kind, BodyChange) == bool(kind.alters)
    assert (kind.side == "motion") == issubclass(kind, MotionShift | MovesLink)
    assert bool(kind.states) == issubclass(kind, WithStates)
    assert (kind.provides == "springs") == issubclass(kind, LinkSpring)
    assert (kind.role == "black_box") == issubclass(kind, BlackBox)


@each_effect
def test_what_is_said_of_an_effect_holds(name):
    """Whether it depends on the load, and that it has a torque where it acts on torques."""
    effect, rng = placed(name), np.random.default_rng(17)
    theta, arrays = admissible(effect, rng), random_signals(rng)
    before, after = (law(effect, {**arrays, "load": load}, theta) for load in (arrays["load"], 1.1 * arrays["load"]))
    differs = bool(np.any(np.abs(before - after) > 1e-9))
    of_load = "load" in effect.inputs or name in ("torque_gain", "controller_gain")  # "load" of a sensor is the true torque
    assert differs == of_load
    nothing = effect.side == "body" or effect.moves_link or isinstance(effect, Delay)
    assert (before.size > 0 and bool(np.any(before != 0))) == (not nothing)


def test_laws_at_their_ends():
    rng = np.random.default_rng(18)
    arrays = random_signals(rng)
    fast = {**arrays, "dq": np.sign(arrays["dq"]) * 50.0}
    assert np.all(law(placed("stribeck"), fast, {"excess": 3.0, "velocity": 0.1}) == 0)
    slow = {**arrays, "dq": np.sign(arrays["dq"]) * 1e-3}
    found = law(placed("stribeck"), slow, {"excess": 3.0, "velocity": 0.1}, 0.0)[0]
    np.testing.assert_allclose(found, -3 * np.sign(slow["dq"][1]), rtol=1e-3)  # (dq/velocity)² = 1e-4
    late = {**arrays, "time": np.full(SAMPLES, 1e4)}
    np.testing.assert_allclose(law(placed("friction_drift"), late, {"ratio": 0.7, "time_constant": 5.0}), 0, atol=1e-12)
    start = {**arrays, "time": np.zeros(SAMPLES)}
    found = law(placed("friction_drift"), start, {"ratio": 0.7, "time_constant": 5.0})[0]
    np.testing.assert_allclose(found, 0.7 * arrays["friction"][1], rtol=1e-15)
    mu = law(placed("load_dependent_friction"), fast, {"mu": 0.2})[0]
    np.testing.assert_allclose(mu, -0.2 * np.abs(arrays["load"][1]) * np.sign(fast["dq"][1]), rtol=1e-12)
    still = arrays["load"][1] - arrays["rotor"][1]
    rotor = law(LoadDependentFriction((1,), "motor without friction"), fast, {"mu": 0.2})[0]
    np.testing.assert_allclose(rotor, -0.2 * np.abs(still) * np.sign(fast["dq"][1]), rtol=1e-12)
    whole = law(LoadDependentFriction((1,), "motor"), fast, {"mu": 0.2})[0]
    motor = still - arrays["friction"][1] - whole  # which the law itself is part of
    np.testing.assert_allclose(whole, -0.2 * np.abs(motor) * np.sign(fast["dq"][1]), rtol=1e-12)
    asymmetry = law(placed("coulomb_asymmetry"), fast, {"asymmetry": 1.4})[0]
    np.testing.assert_allclose(asymmetry, -0.7, rtol=1e-12)  # in both directions: 1.4 more against dq > 0 than against dq < 0
    asymmetry = law(placed("viscous_asymmetry"), fast, {"asymmetry": 0.3})[0]
    np.testing.assert_allclose(asymmetry, -0.15 * 50.0, rtol=1e-12)  # in both directions, as of dry friction
    q, dq = arrays["q"][1], arrays["dq"][1]
    ripple = law(placed("torque_ripple"), arrays, {"amplitude": 2.0, "order": 7.0, "phase": 0.3})[0]
    np.testing.assert_allclose(ripple, 2 * np.sin(7 * q + 0.3), rtol=1e-12)
    drag = law(placed("quadratic_drag"), arrays, {"coefficient": 0.4})[0]
    np.testing.assert_allclose(drag, -0.4 * dq**2 * np.sign(dq), rtol=1e-12)


# --- through a model of recordings ---


@pytest.fixture(scope="module")
def arm():
    """A calibrated model of the paper's arm and its recordings, with a listed spring and payload, in two recordings."""
    plant = Plant("rrr", np.array([2.0, 3.0, 1.5]), np.array([3.0, 4.0, 2.0]), np.array([0.2, 0.3, 0.1]))
    rng = np.random.default_rng(19)
    tool = load_robot("rrr").tool.position
    recordings = as_set(
        plant, [record(plant, f"{i}.csv", rng, 6.0, pea={1: (6.0, 0.5)}, payload=2.0, tool=tool) for i in range(2)]
    )
    recordings = replace(recordings, recordings=tuple(replace(r, loop=LOOP) for r in recordings.recordings))
    start = plain_model(recordings)
    values = np.array([plant.dry, plant.viscous, plant.armature]).T.reshape(-1, 1)
    model = replace(start, terms=tuple(t.with_values(v) for t, v in zip(start.prompt_terms, values, strict=True)))
    prepared = prepare(recordings)
    by_name: dict[str, list[Trial]] = {}
    for torque in ("motor", "command"):
        for trial in trials(view(prepared, model), torque):
            if torque == "motor" or trial.effect.recorded_as == ("command",):
                by_name.setdefault(trial.effect.name, []).append(trial)
    span = tuple(prepared[0].recording.q[1].min() + x * np.ptp(prepared[0].recording.q[1]) for x in (0.1, 0.9))
    surface = Empirical((1,), (("q", 1), ("load", 1)), (span[0], -30.0), (span[1], 30.0), (2, 1), "turned")
    zero = dict.fromkeys(surface.amplitudes, 0.0)
    by_name["empirical"] = [Trial(surface, tuple(zero | {a: 1.0} for a in surface.amplitudes), width=0.05)]
    for kind in (Echo, FrictionChange, FrictionCourse):
        by_name[kind.name] = list(kind.black_box_trials(view(prepared, model), 1, {}, "motor"))
    return model, prepared, by_name


def extended(model: CalibratedModel, trial: Trial, coefficients: np.ndarray) -> CalibratedModel:
    theta = trial.effect.combined(trial.points, coefficients)
    estimates = tuple(Estimate(float(theta[p.name])) for p in trial.effect.parameters)
    return replace(model, terms=(*model.terms, Term(trial.effect, estimates, trial.width)))


def some(of: list[Trial], count: int = 6) -> list[Trial]:
    return of[:: max(1, len(of) // count)]


@pytest.mark.parametrize("name", SEARCHED)
def test_an_effect_of_no_size_changes_no_prediction(name, arm):
    model, prepared, by_name = arm
    recording = prepared[0].recording
    plain = model.output_torque(recording)
    for trial in some(by_name[name]):
        none = np.zeros(len(trial.points))
        if name == "joint_elasticity":
            none[:] = 1e-12  # compliance [rad/Nm]: stiff, not without stiffness
        found = extended(model, trial, none).output_torque(recording)
        np.testing.assert_allclose(found, plain, atol=1e-7)  # a compliance of 1e-12 times derivatives over samples of 10 ms


@pytest.mark.parametrize("name", [*SEARCHED, "echo", "empirical", "friction_change", "friction_course"])
def test_signatures_are_the_slopes_of_predictions(name, arm):
    """Σ c_k column_k against the difference of predictions with and without the term that c_k stand for."""
    model, prepared, by_name = arm
    at = Prediction(model, prepared[0].recording)
    recording, rng = prepared[0].recording, np.random.default_rng(20)
    plain = model.output_torque(recording)
    seen = 0
    for trial in some(by_name[name]):
        raw = by_trial(at, trial)
        size = np.sqrt(np.mean(raw**2, axis=(1, 2))).max()
        if size < 1e-9 or trial.size > {"backlash": 0.005, "joint_elasticity": 1e-4}.get(name, np.inf):
            continue  # a wide gap and a soft gear are not small
        seen += 1
        wanted = 1e-6 * np.sqrt(np.mean(plain**2))  # so small that squares of it do not show
        coefficients = rng.uniform(0.3, 1, len(raw)) * wanted / size
        if name == "backlash" or abs(trial.size) > 10 * trial.effect.step:  # the change over a finite amount
            coefficients = np.array([trial.size])
        change = extended(model, trial, coefficients).output_torque(recording) - plain
        expected = np.einsum("k,kit->it", coefficients, raw)
        off, spread = np.sqrt(np.mean((change - expected) ** 2)), np.sqrt(np.mean(expected**2))
        tolerance = 5e-3 if name == "backlash" else 1e-3  # squares: 1.4e-3 of the gap of 2 mrad, 3e-4 of a compliance
        assert off < tolerance * spread, f"{trial.effect.name} {trial.effect.joints} {trial.points[0]}: {off / spread:.2g}"
    assert seen


def test_signatures_of_several_recordings_are_those_of_each(arm):
    """Found along all at once, and filtered, at a model with effects on every side."""
    model, prepared, by_name = arm
    every = [trial for name in by_name for trial in some(by_name[name])]
    sizes = {
        "load_dependent_friction": 0.1, "torque_gain": -0.2, "torque_offset": 0.5, "joint_elasticity": 800.0,
        "payload_mass": 1.0, "payload_com": 0.02, "cable_harness": 2.0, "encoder_offset": 0.05, "quadratic_drag": 1.0,
    }  # fmt: skip
    added = {
        n: Term(e, tuple(Estimate(v if p.name in e.amplitudes else p.nominal) for p in e.parameters), e.width and 0.05)
        for n, v, e in ((n, v, placed(n)) for n, v in sizes.items())
    }
    for names in [*((n,) for n in added), tuple(added), ("torque_gain", "payload_mass"), ("cable_harness", "payload_com"), ()]:
        there = replace(model, terms=(*model.terms, *(added[n] for n in names)))
        found = table(prepared, there, every)
        for k, trial in enumerate(every):
            parts = [by_trial(Prediction(without_sensors(there), p.recording), trial) for p in prepared]  # (m, n, K)
            expected = np.concatenate(
                [[p.passed(one, range(3)) for one in part] for p, part in zip(prepared, parts, strict=True)], axis=2
            )
            np.testing.assert_allclose(found.of(k), np.moveaxis(expected, 0, 2), rtol=1e-9, atol=1e-9)


def test_signatures_are_made_anew_where_the_load_has_changed(arm):
    """A spring changes it; what does not depend on it is kept as it is."""
    model, prepared, by_name = arm
    every = [t for name in ("load_dependent_friction", "torque_offset", "torque_ripple") for t in some(by_name[name])]
    tables = Tables(prepared, [np.arange(p.counted.shape[1]) for p in prepared], every, view(prepared, model))
    first, spring = tables.at(model, None), placed("cable_harness")
    nearly = replace(model, robot=replace(model.robot, inertial=model.robot.inertial * (1 + 1e-4)))
    assert tables.at(nearly, None) is first
    there = replace(model, terms=(*model.terms, Term(spring, (Estimate(20.0), Estimate(0.3)))))
    found, expected = tables.at(there, None), table(prepared, there, every)
    for j in range(3):
        np.testing.assert_array_equal(found.used[j], expected.used[j])
        np.testing.assert_allclose(found.values[j], expected.values[j], rtol=1e-12, atol=1e-12)
    assert any(np.abs(found.values[j] - first.values[j]).max() > 0.01 for j in range(3))
    assert tables.at(model, None) is first
    scaled = replace(model, terms=(*model.terms, Term(CATALOGUE["torque_gain"]((1,)), (Estimate(0.25),))))
    found = tables.at(scaled, None)
    for k, trial in enumerate(every):
        expected = [[p.passed(one, range(3)) for one in by_trial(Prediction(scaled, p.recording), trial)] for p in prepared]
        np.testing.assert_allclose(found.of(k), np.moveaxis(np.concatenate(expected, axis=2), 0, 2), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("name", list(CATALOGUE))
def test_an_effect_survives_model_json(name, arm, tmp_path):
    rng, effect = np.random.default_rng(21), placed(name)
    estimates = tuple(
        Estimate(
            float(np.clip(rng.normal(), p.lower, p.upper)),
            float(rng.uniform()),
            (float(rng.normal()) - 3, 3.0),
            bool(rng.integers(2)),
        )
        for p in effect.parameters
    )
    width = None if effect.width is None else 0.037
    terms = (Term(effect, estimates, width), Term(effect, estimates, width, ("0.csv",), ("a", "b")))
    saved = replace(arm[0], terms=terms, noise=np.ones(3), nrmse=np.ones(3))
    save_model(saved, tmp_path / "model.json")
    assert load_model(tmp_path / "model.json").terms == terms
