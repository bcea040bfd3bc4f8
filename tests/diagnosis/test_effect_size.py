"""Sizes of effects on data that they were not fitted to: intervals against draws, falls against fits to the rest alone."""

from dataclasses import replace

import chains
import numpy as np
import pytest
from recorded import Plant, as_set, record

from rrr_oc.calibration.calibrated_model import Estimate, Term
from rrr_oc.calibration.estimator import left_out
from rrr_oc.calibration.estimator.evidence import NoiseStart
from rrr_oc.calibration.estimator.left_out import Fall, block_edges
from rrr_oc.diagnosis.claims.effect_size import Falls, LeftOut, confirmed, predictive, scales_load
from rrr_oc.diagnosis.procedure import ready
from rrr_oc.diagnosis.result import Finding
from rrr_oc.diagnosis.structures.search import StructureSearch
from rrr_oc.effects import CATALOGUE
from rrr_oc.effects.friction.quadratic_drag import QuadraticDrag
from rrr_oc.effects.priors import Priors
from rrr_oc.effects.sensor.torque_offset import TorqueOffset

RECORDINGS = 4


def made(folder, coefficient, other=0.0, disturbance=0.0):
    """A fitter of recordings of two joints with drag at joint 2, and maybe at joint 1, and its plain model fitted.

    At joint 2 there may be a slow disturbance, too, of this amplitude [Nm].
    """
    urdf = folder / "arm.urdf"
    urdf.write_text(chains.arm(2))
    plant, rng = Plant(urdf, np.ones(2), np.ones(2), 0.1 * np.ones(2)), np.random.default_rng(1)
    recordings = [record(plant, f"{i}.csv", rng, 6.0, 0.02) for i in range(RECORDINGS)]
    recordings = [replace(r, tau=r.tau + [[other], [coefficient]] * r.dq * np.abs(r.dq)) for r in recordings]
    slow = [disturbance * np.sin(0.5 * r.t + i) for i, r in enumerate(recordings)]
    recordings = [replace(r, tau=r.tau + np.array([0 * x, x])) for r, x in zip(recordings, slow, strict=True)]
    _, fitter, every, plain = ready(as_set(plant, recordings), Priors())
    return fitter, fitter.fit(plain, fitter.data.links.none), every


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    return made(tmp_path_factory.mktemp("arm"), 0.1)


def with_terms(arm, *terms: Term):
    """The neighbours of a fit with further terms, and these as findings."""
    fitter, begin, every = arm
    fitted = fitter.fit(replace(begin.model, terms=(*begin.model.terms, *terms)), begin.links, begin.posterior)
    near = StructureSearch.of(fitter, every).neighbours(fitted)
    return near, [Finding(t, 1.0, 10.0, 0.0) for t in fitted.extra]


def drag() -> Term:
    return Term(QuadraticDrag((1,)), (Estimate(0.1),))


def offset(joint: int) -> Term:
    return Term(TorqueOffset((joint,)), (Estimate(0.01),))


def test_what_is_there_predicts_and_what_is_not_does_not(arm):
    near, findings = with_terms(arm, offset(0), drag())
    kept, out = predictive(LeftOut(near), findings)
    assert [f.term.effect.name for f in kept] == ["quadratic_drag"]
    assert kept[0].joint == 1
    assert kept[0].matters
    assert 0.1 < kept[0].fall.low < kept[0].fall.share < kept[0].fall.high < 1
    assert [f.term.effect.name for f in out] == ["torque_offset"]
    assert out[0].fall.high < 0.02


@pytest.mark.parametrize(("other", "order"), [(0.3, [(1,), (0,)]), (0.5, [(0,), (1,)])])
def test_what_takes_more_of_a_joints_torque_comes_first(tmp_path, other, order):
    """Joint 2 is the faster one; the order of findings does not matter."""
    arm = made(tmp_path, 0.3, other)
    near, findings = with_terms(arm, Term(QuadraticDrag((0,)), (Estimate(0.5),)), drag())
    kept, _ = predictive(LeftOut(near), findings)
    again, _ = predictive(LeftOut(near), findings[::-1])
    assert [f.term.effect.joints for f in kept] == [f.term.effect.joints for f in again] == order
    for f in kept:
        (j,) = f.term.effect.joints
        left = np.sqrt(np.mean(near.linear.fitted.residual[j] ** 2)) / near.linear.fitter.data.torque[j]
        assert f.fall.of_torque == pytest.approx(left * f.fall.share / (1 - f.fall.share), rel=0.15)  # rms after, of all data
    assert kept[0].fall.of_torque > 1.2 * kept[1].fall.of_torque


def test_of_two_that_stand_for_each_other_one_predicts(arm):
    """Each alone is not missed beside the other; both are."""
    near, findings = with_terms(arm, drag(), drag())
    left_out = LeftOut(near)
    kept, out = predictive(left_out, findings)
    assert len(kept) == len(out) == 1
    both = tuple(left_out.of(f.term) for f in findings)
    assert abs(left_out.falls(1, both, both[:1]).error.share) < 0.02 < kept[0].fall.low


def test_falls_are_those_of_exact_fits_to_the_other_recordings(arm, monkeypatch):
    """With blocks as long as recordings, of which each is predicted once, and the same hyperparameters."""
    monkeypatch.setattr(left_out, "BLOCK", 1e3)
    monkeypatch.setattr(left_out, "LEAST_BLOCKS", 1)
    fitter, begin, _ = arm
    near, findings = with_terms(arm, drag())
    assert list(block_edges(near.level.edges)) == list(fitter.data.edges)
    squares, hyper = np.zeros(2), near.linear.fitted.posterior.hyper
    fall = predictive(LeftOut(near), findings)[0][0].fall
    for held in range(RECORDINGS):
        rest, out = fitter.data.part([k for k in range(RECORDINGS) if k != held]), fitter.data.part([held])
        for k, terms in enumerate(((), (drag(),))):
            model = replace(begin.model, terms=(*begin.model.terms, *terms))
            fitted = replace(fitter, data=rest).fit(model, begin.links, NoiseStart.of(rest, hyper), fixed=True)
            squares[k] += np.sum(out.rows(fitted.model).residual[1] ** 2)
    assert fall.share == pytest.approx(1 - np.sqrt(squares[1] / squares[0]), rel=0.06)  # ways of changing sign are not mixed


def test_what_is_fast_shows_in_innovations_under_a_slow_disturbance(tmp_path):
    """Of drag under a large disturbance the error shows little, and its innovations most."""
    fitter, begin, every = made(tmp_path, 0.6, disturbance=1.0)
    near, findings = with_terms((fitter, begin, every), drag())
    (f,) = predictive(LeftOut(near), findings)[0]
    assert f.innovations.low > 0.05
    assert f.innovations.share > 2 * f.fall.share


@pytest.mark.parametrize(
    ("error", "innovations", "otherwise", "scaling"),
    [
        ((0.001, -0.01, 0.012), (0.1, 0.05, 0.15), True, False),  # what scales the load scales errors of the motion, too
        ((0.1, 0.05, 0.15), (0.001, -0.01, 0.012), True, True),
        ((0.1, 0.05, 0.15), (0.2, 0.15, 0.25), True, True),
        ((0.001, -0.01, 0.012), (0.001, -0.01, 0.012), False, False),
        ((0.1, 0.05, 0.15), (-0.1, -0.15, -0.05), False, False),  # innovations that rise count always
        ((0.1, 0.08, 0.12), (-0.03, -0.04, -0.02), False, False),
        ((0.3, 0.25, 0.35), (-0.03, -0.04, -0.02), True, True),  # but for little beside what falls
    ],
)
def test_what_scales_the_load_has_to_lower_the_error_itself(error, innovations, otherwise, scaling):
    both = Fall(0, *error), Fall(0, *innovations)
    assert Falls(*both).predicts == otherwise
    assert Falls(*both).surest is max(both, key=lambda f: f.low)
    assert Falls(*both, scales=True).predicts == scaling
    assert Falls(*both, scales=True).surest is both[0]


@pytest.mark.parametrize(
    ("name", "joints", "scales"),
    [
        ("torque_gain", (0,), True),
        ("torque_gain", (), True),
        ("payload_mass", (), True),
        ("quadratic_drag", (0,), False),
        ("load_dependent_friction", (0,), False),
        ("parallel_spring", (0,), False),
    ],
)
def test_gains_and_bodies_scale_the_load(name, joints, scales):
    assert scales_load(CATALOGUE[name](joints)) == scales


def test_sizes_are_those_of_fits_without_each(arm):
    """Refitted without it, a model has the error of the plain fit; what does nothing goes."""
    fitter, begin, every = arm
    near, findings = with_terms(arm, offset(0), drag())
    search = StructureSearch.of(fitter, every)
    fitted, kept, out = confirmed(search, begin, near.linear.fitted, predictive(LeftOut(near), findings)[0] + findings[:1])
    assert [f.term.effect.name for f in kept] == [t.effect.name for t in fitted.extra] == ["quadratic_drag"]
    assert [f.term.effect.name for f in out] == ["torque_offset"]
    plain, whole = (LeftOut(search.neighbours(one)).whole[0, 1] for one in (begin, fitted))
    assert kept[0].fall.share == pytest.approx(1 - np.sqrt(np.sum(whole**2) / np.sum(plain**2)), rel=1e-2)
