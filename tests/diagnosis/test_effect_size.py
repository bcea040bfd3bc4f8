"""Sizes of effects on data that they were not fitted to: intervals against draws, falls against fits to the rest alone."""

from dataclasses import replace

import chains
import numpy as np
import pytest
from recorded import Plant, as_set, record

from rrr_oc.calibration.calibrated_model import Estimate, Term
from rrr_oc.calibration.estimator import left_out
from rrr_oc.calibration.estimator.evidence import Start
from rrr_oc.calibration.estimator.left_out import block_edges, fall_of
from rrr_oc.diagnosis import effect_size
from rrr_oc.diagnosis.effect_size import falls, sized
from rrr_oc.diagnosis.findings import Finding
from rrr_oc.diagnosis.knobs import MATTERS
from rrr_oc.diagnosis.procedure import ready
from rrr_oc.diagnosis.structures.search import Search
from rrr_oc.effects.friction.quadratic_drag import QuadraticDrag
from rrr_oc.effects.priors import Priors
from rrr_oc.effects.sensor.torque_offset import TorqueOffset

RECORDINGS = 4
NOISE = np.full(2, np.inf)  # nothing that is left is beyond it


def made(folder, coefficient, other=0.0):
    """A fitter of recordings of two joints with drag at joint 2, and maybe at joint 1, and its plain model fitted."""
    urdf = folder / "arm.urdf"
    urdf.write_text(chains.arm(2))
    plant, rng = Plant(urdf, np.ones(2), np.ones(2), 0.1 * np.ones(2)), np.random.default_rng(1)
    recordings = [record(plant, f"{i}.csv", rng, 6.0, 0.02) for i in range(RECORDINGS)]
    recordings = [replace(r, tau=r.tau + [[other], [coefficient]] * r.dq * np.abs(r.dq)) for r in recordings]
    _, fitter, every, plain = ready(as_set(plant, recordings), Priors())
    return fitter, fitter.fit(plain, fitter.data.links.none), every


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    return made(tmp_path_factory.mktemp("arm"), 0.1)


def with_terms(arm, *terms: Term):
    """The neighbours of a fit with further terms, and these as findings."""
    fitter, begin, every = arm
    fitted = fitter.fit(replace(begin.model, terms=(*begin.model.terms, *terms)), begin.links, begin.posterior)
    near = Search.of(fitter, every).neighbours(fitted)
    return near, [Finding(t, 1.0, 1.0, 10.0, 0.0) for t in fitted.extra]


def drag() -> Term:
    return Term(QuadraticDrag((1,)), (Estimate(0.1),))


def offset(joint: int) -> Term:
    return Term(TorqueOffset((joint,)), (Estimate(0.01),))


def test_what_is_there_matters_and_what_is_not_is_small(arm):
    near, findings = with_terms(arm, offset(0), drag())
    claimed, small = sized(near, findings, NOISE)
    assert [f.term.effect.name for f in claimed] == ["quadratic_drag"]
    assert claimed[0].fall.joint == 1
    assert 0.1 < claimed[0].fall.low < claimed[0].fall.share < claimed[0].fall.high < 1
    assert [f.term.effect.name for f in small] == ["torque_offset"]
    assert small[0].fall.high < 0.02


@pytest.mark.parametrize(("other", "order"), [(0.3, [(1,), (0,)]), (0.5, [(0,), (1,)])])
def test_what_takes_more_of_a_joints_torque_comes_first(tmp_path, other, order):
    """Joint 2 is the faster one; the order of findings does not matter."""
    arm = made(tmp_path, 0.3, other)
    near, findings = with_terms(arm, Term(QuadraticDrag((0,)), (Estimate(0.5),)), drag())
    claimed, _ = sized(near, findings, NOISE)
    again, _ = sized(near, findings[::-1], NOISE)
    assert [f.term.effect.joints for f in claimed] == [f.term.effect.joints for f in again] == order
    for f in claimed:
        (j,) = f.term.effect.joints
        left = np.sqrt(np.mean(near.linear.fitted.residual[j] ** 2)) / near.linear.fitter.data.torque[j]
        assert f.fall.of_torque == pytest.approx(left * f.fall.share / (1 - f.fall.share), rel=0.15)  # rms after, of all data
    assert claimed[0].fall.of_torque > 1.2 * claimed[1].fall.of_torque


def test_of_two_that_stand_for_each_other_one_matters(arm):
    """Each alone is not missed beside the other; both are."""
    near, findings = with_terms(arm, drag(), drag())
    claimed, small = sized(near, findings, NOISE)
    assert len(claimed) == len(small) == 1
    assert abs(falls(near, near.linear.own, NOISE)[0].share) < 0.02 < claimed[0].fall.low


def test_falls_are_those_of_exact_fits_to_the_other_recordings(arm, monkeypatch):
    """With blocks as long as recordings, of which each is predicted once, and the same hyperparameters."""
    monkeypatch.setattr(left_out, "BLOCK", 1e3)
    monkeypatch.setattr(left_out, "LEAST_BLOCKS", 1)
    fitter, begin, _ = arm
    near, findings = with_terms(arm, drag())
    assert list(block_edges(near.level.edges)) == list(fitter.data.edges)
    squares, hyper = np.zeros(2), near.linear.fitted.posterior.hyper
    fall = sized(near, findings, NOISE)[0][0].fall
    for held in range(RECORDINGS):
        rest, out = fitter.data.part([k for k in range(RECORDINGS) if k != held]), fitter.data.part([held])
        for k, terms in enumerate(((), (drag(),))):
            model = replace(begin.model, terms=(*begin.model.terms, *terms))
            fitted = replace(fitter, data=rest).fit(model, begin.links, Start.of(rest, hyper), fixed=True)
            squares[k] += np.sum(out.rows(fitted.model).residual[1] ** 2)
    assert fall.share == pytest.approx(1 - np.sqrt(squares[1] / squares[0]), rel=0.06)  # ways of changing sign are not mixed


def test_a_law_explains_more_than_what_no_law_explains(tmp_path):
    """With less noise, what is left is unexplained; a law whose squares are smaller than that may be a part of it."""
    near, findings = with_terms(made(tmp_path, 0.03), drag())
    (fall,) = falls(near, near.linear.own, NOISE)
    assert fall.needed == MATTERS
    rows = near.linear.fitter.data.counted.sum(axis=1)
    after = effect_size.squares(near, near.linear.own, near.linear.fitted.posterior.hyper).sum(axis=0)
    for share in (0.5, 1.0):  # of what is left, that is noise
        (fall,) = falls(near, near.linear.own, np.sqrt(share * after / rows))
        assert fall.needed == pytest.approx(max(1 - np.sqrt(1 / (2 - share)), MATTERS))
    assert 0.02 < fall.low < 1 - np.sqrt(0.5)
    assert sized(near, findings, np.sqrt(after / rows))[0]
    assert not sized(near, findings, np.zeros(2))[0]


def test_intervals_hold_the_true_fall_as_often_as_they_say():
    rng, inside, draws, true = np.random.default_rng(0), 0, 600, 1 - np.sqrt(0.8)
    for _ in range(draws):
        level = rng.gamma(8.0, 1.0, 16)  # of the error, which differs between blocks
        before, after = level * rng.gamma(20.0, 1 / 20, 16), 0.8 * level * rng.gamma(20.0, 1 / 20, 16)
        fall = fall_of(0, after, before)
        inside += fall.low < true < fall.high
    assert 0.92 < inside / draws < 0.98


def test_nothing_can_be_said_of_one_block():
    fall = fall_of(0, np.array([1.0, 0.0]), np.array([2.0, 0.0]))
    assert fall.low == -np.inf


def test_blocks_lie_within_recordings():
    edges = block_edges(np.array([0, 20, 500, 504]))
    assert {0, 20, 500, 504} <= set(edges.tolist())
    assert np.all(np.diff(edges) > 0)
    assert 4 <= np.count_nonzero(edges < 500) - np.count_nonzero(edges < 20) <= 10  # of 480 rows, 38 s
