"""The reference of effects: a page for each that says all its file declares, and examples against laws written out."""

import re

import numpy as np
import pytest
from recorded import Plant

from docs.from_code import effects
from docs.from_code.examples import ARMATURE, DRY, PAYLOAD, SPRING, VISCOUS, Example, example, followed
from rrr_oc.effects import CATALOGUE
from rrr_oc.effects.base import SOUGHT, View
from rrr_oc.robot.robot import load_robot

PAGES = effects.pages()
STIFFNESS, REST = SPRING.values()


def shown(name: str) -> Example:
    found = example(name)
    assert found is not None
    return found


def test_every_effect_has_a_page_and_a_row_in_the_index():
    assert set(PAGES) == {"index.md", *(f"{name}.md" for name in CATALOGUE)}
    assert re.findall(r"\]\((\w+)\.md\) \| `", PAGES["index.md"]) == [k.name for of in effects.groups().values() for k in of]
    assert sum(map(len, effects.groups().values())) == len(CATALOGUE)


@pytest.mark.parametrize("name", CATALOGUE)
def test_a_page_says_what_the_file_declares(name):
    kind, text = CATALOGUE[name], PAGES[f"{name}.md"]
    assert f"`{name}`" in text
    assert kind.equation in text
    assert text.count("<svg") == text.count("</svg>") == 1
    for parameter in kind.parameters if isinstance(kind.parameters, tuple) else ():
        (row,) = re.findall(rf"^\| `{parameter.name}` \| (.*?) \|", text, re.M)
        assert row == ("–" if parameter.unit == "1" else parameter.unit)
    if kind.role in SOUGHT:
        assert f"taken as {kind.prior.probability:g} before" in text
        assert kind.prior.source in text
        assert all(f"{number:g}" in text for number, _ in kind.prior.typical.values())
    resembling = [k for k in CATALOGUE.values() if kind.resembles and k.resembles == kind.resembles and k is not kind]
    assert all(f"({k.name}.md)" in text for k in resembling)


def test_every_unit_of_a_prior_is_said_in_words():
    one = np.ones(3)
    view = View(0 * one, one, one, one, 1.0, one, np.ones((3, 1)), one, (), one, one, one)
    assert all(view.unit(unit, (0,)) > 0 for unit in effects.UNITS)  # a word for what is no unit is a KeyError
    assert {unit for kind in CATALOGUE.values() for _, unit in kind.prior.typical.values()} <= {"", *effects.UNITS}


LAWS = {
    "viscous_friction": lambda r, load, c: VISCOUS[1] * r.dq[1],
    "dry_friction": lambda r, load, c: DRY[1] * np.tanh(r.dq[1] / 0.05),
    "armature": lambda r, load, c: ARMATURE[1] * r.ddq[1],
    "quadratic_drag": lambda r, load, c: c["coefficient"] * r.dq[1] * np.abs(r.dq[1]),
    "load_dependent_friction": lambda r, load, c: c["mu"] * np.abs(load[1]) * np.tanh(r.dq[1] / 0.05),
    "parallel_spring": lambda r, load, c: -c["stiffness"] * np.maximum(c["equilibrium"] - r.q[1], 0),
    "spring_stiffness": lambda r, load, c: -(c["scale"] - 1) * STIFFNESS * np.maximum(REST - r.q[1], 0),
    "torque_offset": lambda r, load, c: c["offset"] + 0 * r.q[1],
}  # fmt: skip


@pytest.mark.parametrize("name", LAWS)
def test_examples_are_the_laws(name):
    """The change of the motor torque of joint 2, with the law written out; springs turn within 1 mrad."""
    of = shown(name)
    expected = LAWS[name](of.recording, of.load, of.curves[0].theta)
    assert of.joint == 1
    np.testing.assert_allclose(of.curves[0].change[1], expected, atol=2e-3 * np.abs(expected).max())
    np.testing.assert_allclose(of.curves[0].change[[0, 2]], 0, atol=1e-9)


def test_the_example_of_a_payload_is_pinocchios():
    """Load torques with both masses, less one another; the load that is shown is the one with the listed mass and spring."""
    plant, of, tool = (
        Plant("rrr", np.zeros(3), np.zeros(3), np.zeros(3)),
        shown("payload_mass"),
        load_robot("rrr").tool.position,
    )
    r, more = of.recording, of.curves[0].theta["mass"]
    light, heavy = (plant.load(r.q, r.dq, r.ddq, mass, tool) for mass in (PAYLOAD, PAYLOAD + more))
    np.testing.assert_allclose(of.curves[0].change, heavy - light, atol=1e-9 * np.abs(heavy).max())
    light[1] -= STIFFNESS * np.maximum(REST - r.q[1], 0)
    np.testing.assert_allclose(of.load, light, atol=1e-3)  # the spring's width of 1 mrad


@pytest.mark.parametrize(
    ("name", "variable"),
    [
        ("viscous_friction", ("dq", 1)),
        ("stribeck", ("dq", 1)),
        ("armature", ("ddq", 1)),
        ("parallel_spring", ("q", 1)),
        ("position_dependent_friction", ("q", 1)),  # of two branches
        ("load_dependent_friction", ("load", 1)),
        ("time_delay", None),
        ("friction_drift", None),
    ],
)
def test_pictures_stand_over_the_variable_that_the_law_has(name, variable):
    assert followed(shown(name)) == variable


def test_sentences_have_the_numbers_of_the_example():
    of = shown("stribeck")
    assert of.sentence().startswith("Dry friction of joint 2 is higher when it moves slowly: ")
    assert f"{of.theta['excess']:.3g} Nm" in of.sentence()
    assert shown("echo").sentence() == ""
    assert "(0.00727, 0.00727, 0.00727) kg m²" in shown("link_inertial").sentence()
