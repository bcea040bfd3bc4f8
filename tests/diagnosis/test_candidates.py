"""Gains of candidates by elimination against evidences of the extended problems, solved as a whole."""

from dataclasses import replace

import chains
import numpy as np
import pytest
from recorded import Plant, as_set, real, record

from rrr_oc.diagnosis.candidates import Screen, joined, signatures
from rrr_oc.diagnosis.evidence import solve
from rrr_oc.diagnosis.knobs import EXCESS
from rrr_oc.diagnosis.procedure import ready
from rrr_oc.diagnosis.search import Search
from rrr_oc.effects import Trial
from rrr_oc.effects.elastic.cable_harness import CableHarness
from rrr_oc.effects.friction.coulomb_asymmetry import CoulombAsymmetry
from rrr_oc.effects.friction.quadratic_drag import QuadraticDrag
from rrr_oc.effects.priors import Priors
from rrr_oc.effects.sensor.torque_offset import TorqueOffset
from rrr_oc.recordings.reader import load_recordings


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    """A fitter of four recordings of two joints in two groups, and its plain model fitted; an offset and drag are missing."""
    urdf = tmp_path_factory.mktemp("arm") / "arm.urdf"
    urdf.write_text(chains.arm(2))
    plant, rng = Plant(urdf, np.ones(2), np.ones(2), 0.1 * np.ones(2)), np.random.default_rng(1)
    made = [replace(record(plant, f"{i}.csv", rng, 6.0, 0.02), group="ab"[i % 2]) for i in range(4)]
    made = [replace(r, tau=r.tau + [[0.05 * (r.group == "a")], [0.0]] + 0.02 * r.dq * np.abs(r.dq)) for r in made]
    _, fitter, every, plain = ready(as_set(plant, made), Priors())
    return fitter, fitter.fit(plain, fitter.data.links.none), every


def laws(every: tuple[Trial, ...], *kinds: type) -> list[Trial]:
    """The first trial of each of these effects on each joint."""
    found: dict = {}
    for trial in every:
        if isinstance(trial.effect, kinds):
            found.setdefault((trial.effect.name, trial.effect.joints), trial)
    return list(found.values())


@pytest.mark.parametrize("exact", [False, True])
def test_gains_are_differences_of_evidence(fitted, exact):
    """For the same sizes: those estimated, and those of an arm whose laws are exact; in all groups and in one."""
    fitter, at, every = fitted
    data, post, chosen = fitter.data, at.posterior, laws(every, TorqueOffset, QuadraticDrag, CoulombAsymmetry)
    if exact:
        post = replace(post, sizes=replace(post.sizes, links=0.01, discrepancy=np.full(2, 0.01)))
    prior = fitter.prior(at.model, at.links)
    post = solve(data, at.residual, post.columns, prior, post, fixed=True)
    found = Screen.of(fitter, at, signatures(data, at.model, chosen), post).candidates()
    assert {c.scope for c in found} >= {None, ("a",)}
    keys = {(t.effect.name, t.effect.joints) for t in chosen}
    assert {c.key for c in found} <= keys
    assert len({c.key for c in found}) >= len(keys) - 1  # not what gains nothing
    for c in found:
        own = signatures(data, at.model, [c.trial])
        columns = np.zeros((2, len(data.at), len(c.trial.points)))
        for j in range(2):
            columns[j][:, own.used[j]] = own.values[j]
        inside = np.array([c.scope is None or data.labels[k] in c.scope for k in data.label])
        columns = np.concatenate([post.columns, columns * inside[None, :, None]], axis=2)
        scales = c.excess * fitter.priors.scales(fitter.view, c.trial)
        whole = solve(data, at.residual, columns, joined(prior, scales), post, fixed=True)
        gain = whole.log_evidence - post.log_evidence + np.log(EXCESS[c.excess])
        assert c.gain - c.log_prior == pytest.approx(gain, abs=1e-3 + 1e-5 * abs(gain)), (c.key, c.scope)
        np.testing.assert_allclose(c.coefficients, whole.step[len(post.step) :], rtol=1e-4, atol=1e-7)
        assert c.log_prior == pytest.approx(fitter.log_prior(c.trial.effect, c.scope))


def test_several_shapes_of_an_effect_share_its_prior(fitted):
    """Each has a part of it; what they gain is added up."""
    fitter, at, every = fitted
    (trial, *_) = laws(every, QuadraticDrag)
    one, two = (
        Screen.of(fitter, at, signatures(fitter.data, at.model, [trial] * k), at.posterior).candidates() for k in (1, 2)
    )
    assert len(one) == len(two)
    assert [c.gain for c in two] == pytest.approx([c.gain for c in one], abs=1e-9)
    assert [c.log_prior for c in two] == pytest.approx([c.log_prior - np.log(2) for c in one])


def test_a_harness_that_is_an_offset_is_none(fitted):
    """With no stiffness, its torque of a rest far away: where the prior of the rest is 0."""
    fitter, at, every = fitted
    trial = next(t for t in every if isinstance(t.effect, CableHarness) and t.effect.joints == (1,))
    low, high = fitter.view.low[1], fitter.view.high[1]
    for rest, believed in ((low, True), ((low + high) / 2, True), (high + 2 * (high - low), False), (-40.0, False)):
        assert fitter.believed(trial, {"stiffness": 1.0, "rest": rest}) is believed
    columns = signatures(fitter.data, at.model, [trial])
    offset = signatures(fitter.data, at.model, laws(every, TorqueOffset)[1:])
    shifted = replace(at, residual=at.residual + np.array([0, 1])[:, None] * offset.values[1][:, 0])
    for c in Screen.of(fitter, shifted, columns, at.posterior).candidates():
        assert fitter.believed(c.trial, c.trial.effect.combined(c.trial.points, c.coefficients))


def test_a_gas_spring_is_found_where_errors_of_the_links_explain_much_of_it():
    """Of an industrial arm, published: two-sided, some 7 kNm/rad about -96 degrees. The links' errors are ten times as large as
    declared without it, and a prediction far from linear in them."""
    _, fitter, every, plain = ready(load_recordings(real("kuka_kr300") / "train"), Priors())
    search = Search(fitter, every)
    begin = search.scored(fitter.with_signs(fitter.fit(plain, fitter.data.links.none)))
    near = [t for t in every if t.effect.name in ("cable_harness", "parallel_spring", "link_inertial", "torque_offset")]
    found = search._added(begin, [t for t in near if t.effect.joints == (1,)])
    assert begin.fitted.posterior.sizes.links > 5
    assert found is not None
    (spring,) = found.fitted.extra
    assert spring.effect.name == "cable_harness"
    assert spring.named["stiffness"] == pytest.approx(7000, rel=0.1)
    assert np.degrees(spring.named["rest"]) == pytest.approx(-96, abs=4)
