"""The paper's parametrisation: what vectors stand for, and what they cost by three routes that do not know each other."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from scipy.interpolate import Akima1DInterpolator

from rrr_oc.codesign.clearance import Surroundings
from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.springs import spring_bounds
from rrr_oc.codesign.task import load_task
from rrr_oc.effects.elastic.biarticular_spring import reduced
from rrr_oc.errors import UserError
from rrr_oc.robot.rigid_body import rigid_body, with_payload
from studies.paper.encoding import WEIGHT, Analytic, Encoding
from studies.paper.engine_population import Engine
from studies.paper.experiments import candidate_motion, experiment

TASK = load_task("paper")
RNG = np.random.default_rng(5)


def encoding(name: str = "PEA+BPEA", ends: str = "rest") -> Encoding:
    return Encoding(experiment(TASK, name, ends))


def calm(known: Encoding, count: int) -> np.ndarray:
    """Vectors of slow motions, near the middle of the region of initial means."""
    low, high = known.region
    x = low + (high - low) * RNG.uniform(0.35, 0.65, (count, known.size))
    n = known.size - 2 - 20
    x[:, n : n + 2] = RNG.uniform(0.5, 1.0, (count, 2))
    return x


def by_hand(known: Encoding, x: np.ndarray, samples: int = 20_000) -> tuple[float, np.ndarray]:
    """E1 from scipy's spline, the exact spring laws typed here, and inverse dynamics; and the fastest speeds [rad/s] (phase, m)."""
    values = known.values(x[None])[:, 0]
    k2, e2, k3, e3, k_b, q_0, r_1, r_2, r_3 = values[:9]
    body, total, fastest = rigid_body(TASK.robot), 0.0, []
    for i in range(2):
        T, via = values[9 + i], values[11 + 10 * i : 21 + 10 * i].reshape(2, 5)
        start, end = TASK.ends(i)
        t = (np.arange(samples) + 0.5) / samples * T
        path = [Akima1DInterpolator(np.linspace(0, T, 7), np.r_[s, v, e]) for s, v, e in zip(start, via, end, strict=True)]
        q, dq, ddq = (TASK.full(np.array([p(t, d) for p in path])) for d in range(3))
        held = with_payload(ca.SX(TASK.robot.inertial), TASK.tool.joint, TASK.payloads[i], list(TASK.tool.position))
        inertial = np.array(ca.evalf(held))
        tau = np.array(
            body.inverse_dynamics.map(samples)(
                q, dq, ddq, np.tile(inertial, samples), np.tile(TASK.robot.gravity[:, None], samples)
            )
        )
        pull = k_b / r_1**2 * np.maximum(-r_2 * q[1] - r_3 * q[2] - r_1 * q_0, 0)
        load2 = tau[1] - k2 * np.maximum(e2 - q[1], 0) - r_2 * pull
        load3 = tau[2] - k3 * np.maximum(e3 - q[2], 0) - r_3 * pull
        total += float(np.sum(load2**2 + load3**2)) * T / samples
        fastest.append(np.abs(dq[1:]).max(axis=1))
    return total, np.array(fastest)


def test_vectors_stand_for_what_they_say():
    known = encoding()
    assert known.size == 4 + 5 + 2 + 20
    x = RNG.random((3, known.size))
    candidates, values = known.decode(x), known.values(x)
    hardware = values[4:9]
    np.testing.assert_allclose(candidates.theta[4:], np.array(reduced(*hardware)), rtol=1e-12)
    np.testing.assert_array_equal(candidates.durations, 1 + 4 * x[:, 9:11].T)
    q = candidates.motion(np.array([0.0, 1.0]))[0]  # (m, phases, intervals, ends, K)
    np.testing.assert_allclose(q[:, 0, 0, 0, 1], TASK.start, atol=1e-12)
    np.testing.assert_allclose(q[:, 0, -1, 1, 1], TASK.release, atol=1e-12)
    np.testing.assert_allclose(q[0, 1, :-1, 1, 2], values[21:26, 2], atol=1e-12)
    assert np.abs(candidates.motion(np.array([0.0, 1.0]))[1][:, :, [0, -1], [0, 1]]).max() < 1e-12  # at rest


def test_encode_turns_decode_round():
    """Hardware is not unique, so parameters are compared, and the rest of the vector."""
    known = encoding()
    x = RNG.random(known.size)
    candidate, via = known.decode(x[None]), known.split(known.values(x[None]))[2][..., 0]
    back = known.encode(candidate.theta[:, 0], candidate.durations[:, 0], via)
    np.testing.assert_allclose(known.decode(back[None]).theta, candidate.theta, rtol=1e-6)
    np.testing.assert_allclose(back[9:], x[9:], atol=1e-12)


def test_the_cost_against_another_spline_and_springs_by_hand():
    """Without rest at the ends, as scipy's spline has none; Gauss with many nodes against 20,000 midpoints over kinks."""
    known = encoding("PEA+BPEA", "free")
    for x in calm(known, 3):
        E1, fastest = by_hand(known, x)
        scores = Analytic(known, 80)(x[None])
        assert scores.E1[0] == pytest.approx(E1, rel=2e-4)
        over = np.maximum(fastest / TASK.speed - 1, 0).sum()
        assert scores.excess[0] >= over - 1e-6
        assert scores.cost[0] == pytest.approx(E1 + WEIGHT * known.design.problem.cost_scale * scores.excess[0], rel=2e-4)


def test_twelve_nodes_are_enough():
    """The quadrature that evolution sees, against a fine one; kinks of springs within an interval leave up to a per cent."""
    known = encoding()
    x = calm(known, 20)
    np.testing.assert_allclose(Analytic(known)(x).E1, Analytic(known, 100)(x).E1, rtol=1e-2)


@pytest.mark.parametrize(("name", "ends"), [("SA", "rest"), ("PEA+BPEA", "rest"), ("PEA+BPEA", "free"), ("BPEA*", "rest")])
def test_the_engine_agrees(name, ends):
    """First order in the step: at 144 steps within 0.5 % for slow motions, at 1440 within a tenth of that."""
    known = encoding(name, ends)
    x = calm(known, 8)
    exact = Analytic(known, 100)(x).E1
    np.testing.assert_allclose(Engine(known)(x).E1, exact, rtol=5e-3)
    np.testing.assert_allclose(Engine(known, 1440)(x).E1, exact, rtol=5e-4)


def test_the_engine_gives_the_same_with_threads_and_in_parts():
    known = encoding("BPEA")
    x = calm(known, 6)
    whole, engine = Engine(known, 120)(x), Engine(known, 120, threads=2)
    np.testing.assert_array_equal(engine(x).cost, whole.cost)
    np.testing.assert_array_equal(engine(x[4:]).cost, whole.cost[4:])


def test_a_motion_of_a_candidate_has_its_cost():
    known = encoding("PEA")
    x = calm(known, 1)[0]
    metrics = candidate_motion(known, x).metrics()
    assert metrics.E1_total == pytest.approx(Analytic(known, 40)(x[None]).E1[0], rel=2e-3)  # trapezoids of 1/30 interval


def test_hardware_that_is_fixed_is_no_variable():
    known = encoding("PEA+BPEA*")
    assert known.size == 3 + 2 + 20  # q_eq2, q_eq3 and phi
    theta = known.decode(RNG.random((4, known.size))).theta
    np.testing.assert_allclose(theta[0], 8.2276)
    np.testing.assert_allclose(theta[2], 0.6589)
    np.testing.assert_allclose(theta[4], 13.7052 * (36 / 14) ** 2)
    assert np.ptp(theta[5]) < 1e-12 < np.ptp(theta[6])


def test_limits_of_torque_and_of_the_tools_height_are_penalised():
    """A path that is far below a floor, and needs more torque than allowed, by 5 mm and 1 Nm tighter limits each."""
    known, x = encoding("SA"), calm(encoding("SA"), 1)
    plain = Analytic(known)(x)
    for change in ({"around": Surroundings(0.069)}, {"torque": np.array([5.0, 2.0])}):
        tighter = Encoding(CoDesign(replace(TASK, **change), spring_bounds(TASK, "SA")))
        limited = Analytic(tighter)(x)
        assert limited.E1[0] == pytest.approx(plain.E1[0], rel=1e-12)
        assert limited.excess[0] > plain.excess[0]


def test_other_costs_are_refused():
    from rrr_oc.robot.drives import load_actuators

    design = CoDesign(TASK, (), "motor", load_actuators(TASK.joints))
    with pytest.raises(UserError, match="cost 'load' only"):
        Encoding(design)
    with pytest.raises(UserError, match="multiple of the path's 6"):
        Engine(encoding(), 100)
