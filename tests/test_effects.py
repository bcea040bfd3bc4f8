"""Springs against their laws written out, their own energies, and a dense search for hardware."""

import casadi as ca
import numpy as np
import pytest

from rrr_oc.effects import CATALOGUE, Signals
from rrr_oc.effects.biarticular_spring import HARDWARE_LIMITS, BiarticularSpring, hardware_exists, pick_hardware, reduced
from rrr_oc.effects.parallel_spring import ParallelSpring
from rrr_oc.errors import UserError
from rrr_oc.model import Model
from rrr_oc.robot import load_robot
from rrr_oc.smooth import ramp, ramp_integral

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
        (lambda: BiarticularSpring((0, 1), (1, 0)), r"pair of \+1 or -1, got \(1, 0\)"),
        (lambda: BiarticularSpring((0, 1), (1,)), r"pair of \+1 or -1"),  # pyright: ignore[reportArgumentType]
        (lambda: ParallelSpring((0,), "left"), "'below' or 'above' its equilibrium, got 'left'"),  # pyright: ignore[reportArgumentType]
    ],
)
def test_springs_that_are_turned_away(make, message):
    with pytest.raises(UserError, match=message):
        make()


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
