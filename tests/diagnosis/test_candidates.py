"""Gains of candidates from products by block against evidences of the extended problems, solved as a whole."""

from dataclasses import replace

import chains
import numpy as np
import pytest
from recorded import Plant, as_set, real, record

from rrr_oc.calibration.estimator.evidence import at_size, solve
from rrr_oc.calibration.link_findings import FAR
from rrr_oc.diagnosis.knobs import EXCESS
from rrr_oc.diagnosis.procedure import ready
from rrr_oc.diagnosis.structures import neighbours
from rrr_oc.diagnosis.structures.candidates import Screen
from rrr_oc.diagnosis.structures.linear import Level
from rrr_oc.diagnosis.structures.search import StructureSearch
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


def screened(fitter, at, trials, hyper=None, structure=None):
    """Neighbours of a fit among some trials, and the screen beside a structure (the fit's own by default)."""
    near = StructureSearch.of(fitter, trials).neighbours(at)
    here = near.at(near.linear.own if structure is None else structure, hyper or at.posterior.hyper, fixed=True)
    return near, here, Screen.of(near.level, near.tables(None), here.structure, near.blocks, here.solution)


def dense(near, structure, hyper):
    """The posterior of a structure by `solve`, from all rows."""
    columns = np.concatenate([near.linear.columns, *(a.columns for a in structure)], axis=2)
    post = near.linear.fitted.posterior
    return solve(
        post.data, near.linear.residual, columns, near.linear.prior_with(structure), replace(post, hyper=hyper), fixed=True
    )


@pytest.mark.parametrize("exact", [False, True])
def test_gains_are_differences_of_evidence(fitted, exact):
    """For the same hyperparameters: those estimated, and those of an arm whose laws are exact; in all groups and in one."""
    fitter, at, every = fitted
    hyper, chosen = at.posterior.hyper, laws(every, TorqueOffset, QuadraticDrag, CoulombAsymmetry)
    if exact:
        hyper = replace(hyper, links=np.full(2, 0.01), discrepancy=np.full(2, 0.01))
    near, here, screen = screened(fitter, at, chosen, hyper)
    found, base = screen.candidates(), dense(near, (), hyper)
    assert here.solution.log_evidence == pytest.approx(base.log_evidence, abs=1e-6)
    assert {c.scope for c in found} >= {None, ("a",)}
    keys = {(t.effect.name, t.effect.joints) for t in chosen}
    assert {c.key for c in found} <= keys
    assert {("torque_offset", (0,)), ("quadratic_drag", (1,))} <= {c.key for c in found}  # not what gains nothing
    for c in found:
        added = near.linear.candidate(near.tables(None), c)
        whole = dense(near, (added,), hyper)
        gain = whole.log_evidence - base.log_evidence + np.log(EXCESS[c.excess])
        assert c.gain - c.log_prior == pytest.approx(gain, abs=1e-3 + 1e-5 * abs(gain)), (c.key, c.scope)
        np.testing.assert_allclose(c.coefficients, whole.step[len(base.step) :], rtol=1e-4, atol=1e-7)
        assert c.log_prior == pytest.approx(fitter.log_prior(c.trial.effect, c.scope))


@pytest.mark.parametrize("unit", [1.0, 1e-6])
def test_gains_in_the_place_of_others_are_differences_of_evidence(fitted, unit):
    """The screen beside two effects says what trials gain without one or both of them, in whatever units these are."""
    fitter, at, every = fitted
    offsets, drags = laws(every, TorqueOffset), laws(every, QuadraticDrag)
    near, _, screen = screened(fitter, at, [*offsets, *drags])
    best = {c.key: c for c in reversed(screen.candidates()) if c.scope is None}
    two = tuple(
        near.linear.candidate(near.tables(None), best[key]) for key in (("quadratic_drag", (1,)), ("torque_offset", (0,)))
    )
    two = (replace(two[0], columns=unit * two[0].columns, precision=unit**2 * two[0].precision), two[1])
    near, _, screen = screened(fitter, at, [*offsets, *drags], structure=two)
    hyper = at.posterior.hyper
    for out in ((0,), (1,), (0, 1)):
        less = tuple(a for i, a in enumerate(two) if i not in out)
        base = dense(near, less, hyper)
        found = screen.candidates([near.level.p + i for i in out])
        assert found
        for c in found:
            whole = dense(near, (*less, near.linear.candidate(near.tables(None), c)), hyper)
            gain = whole.log_evidence - base.log_evidence + np.log(EXCESS[c.excess])
            assert c.gain - c.log_prior == pytest.approx(gain, abs=1e-3 + 1e-5 * abs(gain)), (out, c.key, c.scope)


def test_a_structure_on_some_recordings_is_that_of_their_rows(fitted):
    """Products of some blocks against the same problem with the other rows taken out."""
    fitter, at, every = fitted
    near, here, screen = screened(fitter, at, laws(every, TorqueOffset, QuadraticDrag))
    added = tuple(near.linear.candidate(near.tables(None), c) for c in screen.candidates()[:2])
    some, data = (0, 3), fitter.data
    free = np.full(near.level.p, np.inf)
    level = Level(replace(near.linear, prior=replace(near.linear.prior, lower=-free, upper=free)))
    found = [level.solved(s, some, at.posterior.hyper, fixed=True) for s in ((), added)]
    rows = np.concatenate([np.arange(data.edges[k], data.edges[k + 1]) for k in some])
    expected = []
    for structure in ((), added):
        prior = at_size(near.linear.prior_with(structure), at.posterior.hyper.links)
        columns = np.concatenate([near.linear.columns, *(a.columns for a in structure)], axis=2)
        matrix, right = np.diag(prior.precision), prior.precision * prior.mean
        for j, one in enumerate(at.posterior.joints):
            white = one.white[rows][:, rows].toarray()
            x, y, f = (white @ z[rows] for z in (columns[j], near.linear.residual[j], data.features[j]))
            noise = at.posterior.hyper.sigma[j] ** 2 * np.eye(len(rows)) + at.posterior.hyper.discrepancy[j] ** 2 * f @ f.T
            matrix, right = matrix + x.T @ np.linalg.solve(noise, x), right + x.T @ np.linalg.solve(noise, y)
        expected.append(np.linalg.solve(matrix, right))
    for one, step in zip(found, expected, strict=True):
        np.testing.assert_allclose(one.step, step, rtol=1e-5, atol=1e-7)
    assert here.key == frozenset()


def test_several_shapes_of_an_effect_share_its_prior(fitted):
    """Each has a part of it; what they gain is added up."""
    fitter, at, every = fitted
    (trial, *_) = laws(every, QuadraticDrag)
    one, two = (screened(fitter, at, [replace(trial) for _ in range(k)])[2].candidates() for k in (1, 2))
    assert len(one) == len(two)
    assert [c.gain for c in two] == pytest.approx([c.gain for c in one], abs=1e-9)


def test_a_harness_that_is_an_offset_is_none(fitted):
    """With no stiffness, its torque of a rest far away: where the prior of the rest is 0."""
    fitter, at, every = fitted
    trial = next(t for t in every if isinstance(t.effect, CableHarness) and t.effect.joints == (1,))
    low, high = fitter.view.low[1], fitter.view.high[1]
    for rest, believed in ((low, True), ((low + high) / 2, True), (high + 2 * (high - low), False), (-40.0, False)):
        assert fitter.believed(trial, {"stiffness": 1.0, "rest": rest}) is believed
    for c in screened(fitter, at, [trial])[2].candidates():
        assert fitter.believed(c.trial, c.trial.effect.combined(c.trial.points, c.coefficients))


@pytest.mark.parametrize(("alike", "names"), [(0.01, {"torque_offset", "quadratic_drag"}), (0.99, {"torque_offset"})])
def test_effects_of_different_joints_are_added_at_once(fitted, monkeypatch, alike, names):
    """An offset on the first joint, and drag on the second that gains less: at once, if that counts as alike."""
    fitter, at, every = fitted
    monkeypatch.setattr(neighbours, "ALIKE", alike)
    search = StructureSearch.of(fitter, laws(every, QuadraticDrag, TorqueOffset))
    first = search._better(search.scored(at))
    assert first is not None
    assert {t.effect.name for t in first.fitted.extra} == names


def test_a_fit_begins_with_links_that_can_be(fitted, monkeypatch):
    """Bodies are exponential in errors of the links: a prediction may move these so far that no number holds the result."""
    fitter, at, every = fitted
    search = StructureSearch.of(fitter, laws(every, QuadraticDrag))
    _, here, _ = screened(fitter, at, laws(every, QuadraticDrag))
    plain, far = sum(len(t.estimates) for t in at.model.terms), here.solution.step.copy()
    far[plain : plain + len(at.links)] = 1e4
    begun = []
    monkeypatch.setattr(type(fitter), "fit", lambda self, model, links, *_, **__: begun.append((model, links)) or at)
    search.fit(at, replace(here, solution=replace(here.solution, step=far)))
    ((model, links),) = begun
    assert np.all(np.abs(links) <= np.maximum(np.abs(at.links), FAR))
    assert np.all(np.isfinite(model.robot.inertial))


def test_a_gas_spring_is_found_where_errors_of_the_links_explain_much_of_it():
    """Of an industrial arm, published: two-sided, some 7 kNm/rad about -96 degrees. Errors of links are several times as large as
    declared without it, and a prediction far from linear in them."""
    _, fitter, every, plain = ready(load_recordings(real("kuka_kr300") / "train"), Priors())
    near = [t for t in every if t.effect.name in ("cable_harness", "parallel_spring", "link_inertial", "torque_offset")]
    first = fitter.begin(plain)
    fitter, first = fitter.holding(fitter.delay_of(first), first)
    search = StructureSearch.of(fitter, [t for t in near if t.effect.joints == (1,)])
    begin = search.scored(first)
    found = search._better(begin)
    assert np.any(begin.fitted.posterior.hyper.links > 3)
    assert found is not None
    (spring,) = found.fitted.extra
    assert spring.effect.name == "cable_harness"
    assert spring.named["stiffness"] == pytest.approx(7000, rel=0.1)
    assert np.degrees(spring.named["rest"]) == pytest.approx(-96, abs=4)
