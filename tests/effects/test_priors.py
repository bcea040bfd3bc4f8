"""Priors of effects: all are declared, sizes make sense on an arm, and users may override them."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from recorded import Plant, as_set, by_trial, record

from rrr_oc.calibration.inverse_dynamics import plain_model
from rrr_oc.calibration.jacobian import Prediction
from rrr_oc.calibration.samples import prepare
from rrr_oc.diagnosis.signatures import black_box_trials, trials, view
from rrr_oc.effects import CATALOGUE, Effect, Prior, Signals, View
from rrr_oc.effects.base import PARTLY, SOUGHT
from rrr_oc.effects.black_box.empirical import Empirical
from rrr_oc.effects.body.link_inertial import LinkInertial
from rrr_oc.effects.elastic.biarticular_spring import BiarticularSpring
from rrr_oc.effects.elastic.parallel_spring import ParallelSpring
from rrr_oc.effects.elastic.spring_stiffness import SpringStiffness
from rrr_oc.effects.friction.coupled_friction import CoupledFriction
from rrr_oc.effects.friction.stribeck import Stribeck
from rrr_oc.effects.priors import Priors, load_priors
from rrr_oc.effects.transmission.joint_elasticity import JointElasticity
from rrr_oc.errors import UserError
from rrr_oc.robot.parameters import Parameter
from rrr_oc.robot.robot import load_robot

PAGE = Path(__file__).resolve().parents[2] / "docs" / "priors.md"
MISSING = [name for name, kind in CATALOGUE.items() if kind.role in SOUGHT]
each_effect = pytest.mark.parametrize("name", MISSING)


@pytest.fixture(scope="module")
def seen() -> View:
    """Three joints with round numbers, and a listed spring on the second."""
    return View(
        low=np.array([-1.0, -0.5, 0.0]),
        high=np.array([1.0, 0.5, 3.0]),
        speed=np.array([2.0, 1.0, 4.0]),
        usual_speed=np.array([1.0, 0.5, 2.0]),
        duration=20.0,
        widths=np.full(3, 0.05),
        positions=np.random.default_rng(0).uniform([[-1.0], [-0.5], [0.0]], [[1.0], [0.5], [3.0]], (3, 200)),
        inertia=np.array([2.0, 1.0, 0.1]),
        springs=((1,),),
        dry=np.array([3.0, 2.0, 0.5]),
        torque=np.array([20.0, 30.0, 5.0]),
        mass=np.array([4.0, 3.0, 1.0]),
    )


@pytest.fixture(scope="module")
def arm():
    """A plain model of the paper's arm, its recordings with a listed spring and payload, and what they show."""
    plant = Plant("rrr", np.array([2.0, 3.0, 1.5]), np.array([3.0, 4.0, 2.0]), np.array([0.2, 0.3, 0.1]))
    rng, tool = np.random.default_rng(1), load_robot("rrr").tool.position
    recordings = as_set(plant, [record(plant, f"{x}.csv", rng, 6.0, pea={1: (6.0, 0.5)}, payload=2.0, tool=tool) for x in "ab"])
    start, prepared = plain_model(recordings), prepare(recordings)
    values = np.array([plant.dry, plant.viscous, plant.armature]).T.reshape(-1, 1)
    model = replace(start, terms=tuple(t.with_values(v) for t, v in zip(start.prompt_terms, values, strict=True)))
    return model, prepared, view(prepared, model)


@each_effect
def test_it_declares_a_prior(name):
    """A size of each amplitude, and where the numbers come from."""
    prior = CATALOGUE[name].prior
    assert "prior" in vars(CATALOGUE[name])
    assert 0 < prior.probability <= 0.05
    assert prior.typical
    assert all(number > 0 for number, _ in prior.typical.values())
    assert prior.source
    assert prior.where_springs > 0
    assert prior.where_exact > 0


def test_black_box_terms_of_a_joint_are_rarer_than_laws():
    laws = [k.prior.probability for k in CATALOGUE.values() if k.role == "law" and k.placement == "joint"]
    together = sum(k.prior.probability for k in CATALOGUE.values() if k.role == "black_box")
    assert 0.005 <= together <= 0.01
    assert together < 0.1 * sum(laws)


def test_sizes_are_positive_for_all_trials_and_no_larger_than_the_arm_bears(arm):
    """One standard deviation of all coefficients of a trial together: up to a few times the torque that the joint needs anyhow."""
    model, prepared, there = arm
    of_loops = [t for t in trials(there, "command") if t.effect.recorded_as == ("command",)]
    every = trials(there, model.torque) + of_loops + [t for j in range(3) for t in black_box_trials(prepared, there, model, j)]
    assert {trial.effect.name for trial in every} == set(MISSING) - {"time_delay"}  # which is a part of every model
    rng, at = np.random.default_rng(2), Prediction(model, prepared[0].recording)
    for trial in every:
        scales = Priors().scales(there, trial)
        assert scales.shape == (len(trial.points),)
        assert np.all(np.isfinite(scales))
        assert np.all(scales > 0)
        if rng.uniform() < 0.2 or trial.effect.name in ("gravity_tilt", "payload_mass", "payload_com", "time_delay"):
            change = np.einsum("k,kit->it", scales, np.abs(by_trial(at, trial)))
            share = (np.sqrt(np.mean(change**2, axis=1)) / there.torque).max()
            assert share < 5, f"{trial.effect.name} {trial.effect.joints}: {share:.3g}"


def test_default_sizes_are_amplitudes_in_units_of_the_arm(seen):
    for name, joints, shape, expected in [
        ("stribeck", (1,), {"velocity": 0.1}, [0.5 * 2.0]),
        ("quadratic_drag", (2,), {}, [0.3 * 0.5 / 4.0**2]),
        ("torque_offset", (1,), {}, [0.1 * 30.0]),
        ("friction_change", (0,), {}, [0.5 * 3.0, 0.5 * 3.0 / 2.0]),
        ("payload_mass", (), {}, [0.2 * 8.0]),
        ("time_delay", (), {}, [0.005]),
        ("gravity_tilt", (), {}, [0.02, 0.02]),
    ]:
        effect = CATALOGUE[name](joints)
        np.testing.assert_allclose(effect.scales(seen, effect.trial(seen, **shape)), expected)
    length = np.sqrt(2.0 / 8.0)  # inertia of joint 1 [kg m²] over the arm's mass [kg]
    effect = LinkInertial((2,))
    expected = [0.2, *[0.1 * length] * 3, *[0.05 * length**2] * 6]  # times 1 kg
    np.testing.assert_allclose(effect.scales(seen, effect.trial(seen)), expected)


def test_sizes_of_coefficients_that_are_no_amplitudes(seen):
    """What a coefficient of one standard deviation amounts to."""
    (trial,) = (t for t in JointElasticity.trials(seen) if t.effect.joints == (1,) and t.points[0]["stiffness"] > 1e9)
    theta = trial.effect.combined(trial.points, trial.effect.scales(seen, trial))
    assert 30.0 / theta["stiffness"] == pytest.approx(0.01)  # [rad] under the joint's torque
    trial = SpringStiffness((1,)).trial(seen)
    assert trial.effect.combined(trial.points, trial.effect.scales(seen, trial)) == {"scale": pytest.approx(1.2)}
    for trial in ParallelSpring.trials(seen):
        (j,) = trial.effect.joints
        ends = np.array([seen.low[j], seen.high[j]])
        pulls = [abs(float(trial.effect.torque(Signals(np.full(3, q)), trial.points[0], 0.0)[0])) for q in ends]
        assert trial.effect.scales(seen, trial)[0] * max(pulls) == pytest.approx(seen.torque[j])
    for trial in BiarticularSpring.trials(seen):
        pulls = np.abs(trial.effect.torque(Signals(seen.positions), trial.points[0], 0.0)).max(axis=1)
        shares = trial.effect.scales(seen, trial)[0] * pulls / seen.torque[list(trial.effect.joints)]
        assert np.prod(shares) == pytest.approx(1.0)


def test_friction_of_two_joints_is_no_larger_than_that_of_the_joint_with_less(seen):
    """Where one joint drags another's seal along, that is friction of the latter."""
    for form, dry, over_speed in [("sum", 0.5, 0.5 / 4.0), ("difference", 0.5, 0.5 / 4.0), ("other", 2.0, 2.0 / 1.0)]:
        effect = CoupledFriction((1, 2), form)  # pyright: ignore[reportArgumentType]
        np.testing.assert_allclose(effect.scales(seen, effect.trial(seen)), [0.3 * dry, 0.3 * over_speed])


def test_fine_cosines_of_a_series_are_smaller_and_edges_reach_the_same_torque(seen):
    series = Empirical((1,), (("q", 1),), (-0.5,), (0.5,), (3,))
    np.testing.assert_allclose(series.scales(seen, series.trial(seen)), 0.2 * 30.0 / np.array([2.0, 3.0, 4.0]))
    both = replace(series, orders=(), edges=((1, 0.8, 3), (-1, 0.35, 1)))
    q = Signals(np.array([[0.0, 0.0], [0.5, -0.5], [0.0, 0.0]]), np.zeros((3, 2)))
    above, below = both.basis(q, 0.05)
    at_ends = both.scales(seen, both.trial(seen)) * [above[0], below[1]]
    np.testing.assert_allclose(at_ends, 0.2 * 30.0)


def test_springs_are_more_probable_where_springs_are(seen):
    """Listed ones, or by what a user says, which counts more."""
    spring, law, bare = ParallelSpring((0,)), Stribeck((0,)), replace(seen, springs=())
    declared = spring.prior.probability
    assert Priors().chance(spring, bare) == pytest.approx(declared)
    more = Priors().chance(spring, seen)
    assert more / (1 - more) == pytest.approx(10 * declared / (1 - declared))
    assert Priors(springs=True).chance(spring, bare) == pytest.approx(more)
    less = Priors(springs=False).chance(spring, seen)
    assert less / (1 - less) == pytest.approx(declared / (1 - declared) / 10)
    for priors in (Priors(), Priors(springs=True), Priors(springs=False, exact_inertias=True)):
        assert priors.chance(law, seen) == pytest.approx(law.prior.probability)


def test_links_that_are_known_exactly_lack_nothing(seen):
    link = LinkInertial((1,))
    assert Priors(exact_inertias=True).chance(link, seen) < 0.02 * Priors().chance(link, seen)


@each_effect
def test_what_may_be_in_some_recordings_only(name):
    kind = CATALOGUE[name]
    assert kind((0, 1) if kind.placement == "pair" else (0,)).partly == PARTLY[kind.scope]
    assert (PARTLY[kind.scope] == 0) == (kind.scope == "everywhere")


def test_a_file_overrides_what_it_names(tmp_path, seen):
    path = tmp_path / "priors.toml"
    path.write_text(
        "[stribeck]\nprobability = 0.2\ntypical.excess = 0.1\n[friction_change.typical]\ndry = 0.7\n"
        '[joint_elasticity]\ntypical.twist = 0.02\n[context]\nsprings = true\ninertias = "exact"\nexcluded = ["backlash"]\n'
    )
    priors = load_priors(path)
    assert priors.springs is True
    assert priors.exact_inertias
    assert priors.excluded == ("backlash",)
    assert priors.of(Stribeck) == Prior(0.2, {"excess": (0.1, "dry")}, f"given in {path}")
    assert priors.chance(Stribeck((1,)), seen) == pytest.approx(0.2)
    np.testing.assert_allclose(priors.scales(seen, Stribeck((1,)).trial(seen, velocity=0.1)), [0.1 * 2.0])
    change = CATALOGUE["friction_change"]
    assert priors.of(change).probability == change.prior.probability
    np.testing.assert_allclose(priors.scales(seen, change((0,)).trial(seen)), [0.7 * 3.0, 0.5 * 3.0 / 2.0])
    trial = next(iter(JointElasticity.trials(seen)))
    np.testing.assert_allclose(priors.scales(seen, trial), 2 * Priors().scales(seen, trial))
    assert priors.of(LinkInertial) == LinkInertial.prior


def test_without_a_file_priors_are_those_declared(tmp_path):
    (tmp_path / "empty.toml").write_text("")
    for priors in (Priors(), load_priors(tmp_path / "empty.toml")):
        assert (priors.springs, priors.exact_inertias, priors.excluded) == (None, False, ())
        assert all(priors.of(kind) == kind.prior for kind in CATALOGUE.values())


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[stribek]", "unknown effect 'stribek'; allowed are backlash, biarticular_spring, "),
        ("[dry_friction]", "unknown effect 'dry_friction'; allowed are "),
        ("[stribeck]\ntypical.level = 1", "stribeck.typical: unknown amplitude 'level'; allowed are excess"),
        ("[stribeck]\ntypical.excess = -1", "stribeck.typical.excess: found -1; a finite number above 0 is required"),
        ("[stribeck]\ntypical.excess = inf", "stribeck.typical.excess: found inf; a finite number is required"),
        ("[stribeck]\ntypical.excess = nan", "stribeck.typical.excess: found nan; a finite number is required"),
        ("[stribeck]\nprobability = -0.1", "stribeck.probability: found -0.1; a number above 0 and below 1 is required"),
        ("[stribeck]\nprobability = 1", "stribeck.probability: found 1; a number above 0 and below 1 is required"),
        ("[stribeck]\nprobabilty = 0.1", "stribeck: unknown key 'probabilty'; allowed are probability, typical"),
        ("stribeck = 1", "stribeck: found 1; an object with probability, typical is required"),
        ("[context]\nsprings = 1", "context.springs: found 1; true or false is required"),
        ("[context]\ninertias = 'x'", "context.inertias: found 'x'; allowed are 'exact', 'nominal'"),
        ("[context]\nspring = true", "context: unknown key 'spring'; allowed are springs, inertias, excluded"),
        (
            "[context]\nexcluded = ['play']",
            "context.excluded: unknown effect 'play'; allowed are backlash, biarticular_spring, ",
        ),
        ("[context]\nexcluded = ['empirical']", "context.excluded: unknown effect 'empirical'; allowed are backlash, "),
        ("[stribeck", "not valid TOML: "),
    ],
)
def test_files_that_are_turned_away(text, message, tmp_path):
    (tmp_path / "priors.toml").write_text(text)
    with pytest.raises(UserError, match=re.escape(f"priors.toml: {message}")):
        load_priors(tmp_path / "priors.toml")


def test_a_file_that_is_not_there_is_turned_away(tmp_path):
    with pytest.raises(UserError, match=r"none\.toml: cannot be read"):
        load_priors(tmp_path / "none.toml")


def test_an_effect_without_a_prior_has_the_default_one(monkeypatch, tmp_path, seen):
    """Its amplitudes are of the order of 1 in their own units, and may be given."""
    kind = type(
        "MadeUp", (Effect,), {"name": "made_up", "parameters": (Parameter("size", "Nm", 0.0),), "amplitudes": ("size",)}
    )
    monkeypatch.setitem(CATALOGUE, "made_up", kind)
    trial = kind((1,)).trial(seen)
    assert Priors().chance(trial.effect, seen) == pytest.approx(Prior().probability)
    np.testing.assert_array_equal(Priors().scales(seen, trial), [1.0])
    (tmp_path / "priors.toml").write_text("[made_up]\ntypical.size = 3.0\n")
    np.testing.assert_array_equal(load_priors(tmp_path / "priors.toml").scales(seen, trial), [3.0])


# --- the page ---

TWIST = {"twist": "rad"}  # unit of what is no parameter of its effect


def row(name: str) -> str:
    """An effect's line in the table of docs/priors.md."""
    kind = CATALOGUE[name]
    units = TWIST | ({p.name: p.unit for p in kind.parameters} if isinstance(kind.parameters, tuple) else {})
    sizes: dict[str, list[str]] = {}
    for key, (number, unit) in kind.prior.typical.items():
        own = units.get(key, "")
        size = f"{number:g} {unit or ('' if own == '1' else own)}".strip()
        sizes.setdefault(size, []).append(f"`{key}`")
    typical = "; ".join(f"{', '.join(keys)} {size}" for size, keys in sizes.items())
    return f"| `{name}` | {kind.prior.probability:g} | {typical} | {kind.prior.source} |"


def test_the_page_has_the_priors_of_the_catalogue():
    """Every effect once, in the catalogue's order, with the numbers that are declared."""
    rows = [line for line in PAGE.read_text().splitlines() if re.match(r"\| `\w+` \| [\d.e-]+ \|", line)]
    assert rows == [row(name) for name in MISSING]
