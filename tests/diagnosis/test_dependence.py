"""On which signals the torque of a law depends, as its equation has it."""

import pytest

from rrr_oc.calibration.calibrated_model import Estimate, Term
from rrr_oc.calibration.estimator.left_out import Fall
from rrr_oc.diagnosis.claims.dependence import once_of_each, variables
from rrr_oc.diagnosis.result import Finding
from rrr_oc.effects import CATALOGUE, Delay
from rrr_oc.effects.base import SOUGHT
from rrr_oc.effects.black_box.empirical import Empirical

LAWS = {name: kind for name, kind in CATALOGUE.items() if kind.role in SOUGHT and kind.role != "black_box"}
SIGNALS = {"q", "dq", "ddq", "load", "sign", "time", "spring"}
J, N = 1, 3


def term(name: str, **values: float) -> Term:
    """A law of the second of three joints, or of the first two, with these values, else the nominal ones or 0.1."""
    kind = CATALOGUE[name]
    effect = kind({"arm": (), "pair": (0, 1)}.get(kind.placement, (J,)))
    estimates = tuple(Estimate(values.get(p.name, p.nominal or 0.1)) for p in effect.parameters)
    return Term(effect, estimates, None if effect.width is None else effect.width.nominal)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("stribeck", {("dq", J)}),
        ("quadratic_drag", {("dq", J)}),
        ("viscous_asymmetry", {("dq", J)}),
        ("coulomb_asymmetry", {("sign", J)}),
        ("coupled_friction", {("dq", 0), ("dq", 1)}),
        ("load_dependent_friction", {("load", J), ("sign", J)}),
        ("position_dependent_friction", {("q", J), ("sign", J)}),
        ("presliding_hysteresis", {("q", J), ("sign", J)}),
        ("cable_harness", {("q", J)}),
        ("parallel_spring", {("q", J)}),
        ("biarticular_spring", {("q", 0), ("q", 1)}),
        ("two_sided_biarticular_spring", {("q", 0), ("q", 1)}),
        ("spring_stiffness", {("spring", J)}),
        ("torque_ripple", {("q", J)}),
        ("torque_gain", {("load", J)}),
    ],
)
def test_a_law_depends_on_what_its_equation_has(name, expected):
    """And on nothing else."""
    assert set(variables(term(name), N)) == expected


def test_friction_that_drifts_depends_on_time_beside_the_motion_of_its_joint():
    on = variables(term("friction_drift"), N)
    assert ("time", -1) in on
    assert {kind for kind, j in on if j == J} <= {"dq", "sign"}
    assert {j for kind, j in on} == {J, -1}


@pytest.mark.parametrize("name", [name for name, kind in LAWS.items() if not issubclass(kind, Delay)])
def test_every_law_depends_on_something_of_the_arm(name):
    """A delay is none that is claimed: it is a part of every model."""
    on = variables(term(name), N)
    assert on
    assert len(on) == len(set(on))
    assert {kind for kind, _ in on} <= SIGNALS
    assert all(j == -1 if kind == "time" else 0 <= j < N for kind, j in on)


@pytest.mark.parametrize(
    ("name", "values", "expected"),
    [
        ("parallel_spring", {"stiffness": 10.0, "equilibrium": -2.0}, {("q", J)}),
        ("biarticular_spring", {"kappa": 5.0, "rho": 0.5, "phi": 2.5}, {("q", 0), ("q", 1)}),
        ("controller_gain", {"kp_scale": 1.0, "kd_scale": 1.3}, {("dq", J)}),
    ],
)
def test_a_law_depends_on_its_variables_wherever_its_torque_is(name, values, expected):
    """Springs that pull beyond 1 rad alone, as of a joint that moves from -3 to -1 rad, and a gain of the speeds alone."""
    assert set(variables(term(name, **values), N)) == expected


def test_functions_of_the_same_variables_at_a_joint_are_told_once():
    """With the largest of them; of other joints, other variables and laws each by itself."""

    def finding(effect, size: float) -> Finding:
        return Finding(Term(effect, ()), 1.0, 9.0, 0.0, innovations=Fall(0, size, size, size, 1.0))

    load = [Empirical((0,), (("load", 0),), (-1.0,), (1.0,), (order,)) for order in (3, 8)]
    others = [Empirical((1,), (("load", 1),), (-1.0,), (1.0,), (3,)), Empirical((0,), (("q", 0),), (-1.0,), (1.0,), (3,))]
    law = CATALOGUE["torque_offset"]((0,))
    found = once_of_each([finding(load[0], 0.1), finding(load[1], 0.2), *(finding(e, 0.05) for e in (*others, law))])
    assert [f.with_function for f in found] == [True, False, False, False, False]
