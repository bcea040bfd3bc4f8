"""`rrr-oc compare`: what is called changed between arms that were changed by hand, and what only one of them has."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from commands import rrr_oc as command
from designs import design, summary
from msgspec import structs
from recorded import Plant, as_set, record

import rrr_oc
from rrr_oc.calibration.calibrate import calibrate
from rrr_oc.calibration.calibrated_model import CalibratedModel, Estimate, Term
from rrr_oc.calibration.model_file import save_model
from rrr_oc.codesign.design_file import QuantityEntry, data
from rrr_oc.comparison.models import Side, compare_models
from rrr_oc.effects import CATALOGUE
from rrr_oc.effects.words import NORMAL
from rrr_oc.errors import UserError
from rrr_oc.robot.robot import load_robot

FRICTION = np.array([[5.2, 7.1, 3.3], [14.0, 21.0, 9.0], [0.31, 0.22, 0.12]])  # dry, viscous, rotors of the arm


def calibrated(seed: int, friction: np.ndarray = FRICTION, pea: dict | None = None) -> CalibratedModel:
    """Of two recordings of the paper's arm with noise of its own."""
    plant, rng = Plant("rrr", *friction), np.random.default_rng(seed)
    return calibrate(as_set(plant, [record(plant, f"{i}.csv", rng, 8.0, pea=pea) for i in range(2)]))


@pytest.fixture(scope="module")
def arm() -> CalibratedModel:
    return calibrated(0)


def changed(a: CalibratedModel, b: CalibratedModel) -> set[tuple[str, tuple[str, ...]]]:
    return {(one.effect, one.joints) for one in compare_models(Side("a", a), Side("b", b)).changes if one.changed}


def test_an_arm_recorded_twice_has_not_changed(arm):
    found = compare_models(Side("a", arm), Side("b", calibrated(1)))
    assert [one for one in found.changes if one.changed] == []
    assert found.only_a == found.only_b == ()
    assert 2.5 < found.limit < 3.5


def test_friction_that_rose_is_what_has_changed(arm):
    worn = FRICTION.copy()
    worn[0, 1] *= 1.3
    assert changed(arm, calibrated(2, worn)) == {("dry_friction", ("joint2",))}


def test_numbers_are_differences_over_the_joint_standard_error(arm):
    """Of a model with numbers written here."""
    pairs = [((1.0, 0.3), (2.5, 0.4), 3.0), ((1.0, 0.0), (1.0, 0.0), None), ((1.0, None), (9.0, 0.1), None)]
    for (x, sx), (y, sy), sigmas in pairs:
        both = [with_harness(arm, x, sx), with_harness(arm, y, sy)]
        found = compare_models(Side("a", both[0]), Side("b", both[1]))
        (one,) = [one for one in found.changes if one.parameter == "stiffness"]
        assert (one.a, one.b) == (x, y)
        assert (one.std_a, one.std_b) == (pytest.approx(sx), pytest.approx(sy))
        assert one.sigmas == (None if sigmas is None else pytest.approx(sigmas))
        assert one.changed is (None if sigmas is None else sigmas > found.limit)


def with_harness(model: CalibratedModel, stiffness: float, std: float | None = 0.1) -> CalibratedModel:
    """With a harness at joint 2, of which the rest is known exactly; its covariance is that of the other numbers alone."""
    interval = None if std is None else (stiffness - NORMAL * std, stiffness + NORMAL * std)
    term = Term(CATALOGUE["cable_harness"]((1,)), (Estimate(stiffness, std, interval), Estimate(0.3)))
    assert model.spread is not None
    size = len(model.values)
    spread = np.insert(model.spread, [size, size], 0.0, axis=0)
    return replace(model, terms=(*model.terms, term), spread=spread)


def test_first_moments_of_links_are_those_of_the_bodies(arm):
    """The last link is 1 kg heavier at 0.2 m: by hand, on an arm of which nothing else changes."""
    inertial = arm.robot.inertial.copy()
    inertial[0, 2] += 1.0
    inertial[1, 2] += 0.2
    found = compare_models(Side("a", arm), Side("b", replace(arm, robot=replace(arm.robot, inertial=inertial))))
    moments: dict[tuple[str, ...], float] = {}
    for one in found.changes:
        if one.parameter == "first_moment":  # in two directions across the axis
            moments[one.joints] = float(np.hypot(moments.get(one.joints, 0.0), one.b - one.a))
    reach = float(np.linalg.norm(arm.robot.placements[2, :3, 3]))
    assert moments == pytest.approx({("joint3",): 0.2, ("joint2",): reach})


TOLD = {
    "format": "rrr_oc-diagnosis/1",
    "verdict": "missing_physics",
    "effects": [{"effect": "two_sided_spring", "joint": "joint2", "rivals": [{"effect": "cable_harness", "joint": "joint2"}]}],
    "undecided": [{"members": [{"effect": "torque_offset", "joint": "joint1"}]}],
    "possible": [{"effect": "cable_harness", "joint": "joint1"}],
}


@pytest.mark.parametrize(
    ("told", "elsewhere", "of"),
    [
        (TOLD, "rival", "two_sided_spring"),
        ({**TOLD, "effects": []}, None, None),
        ({**TOLD, "effects": [], "small": [{"effect": "cable_harness", "joint": "joint2"}]}, "small", None),
        ({"undecided": [{"members": [{"effect": "cable_harness", "joint": "joint2"}]}]}, "undecided", None),
    ],
)
def test_what_is_new_may_be_in_the_other_diagnosis_as_something_else(arm, told, elsewhere, of):
    found = compare_models(Side("a", arm, told), Side("b", with_harness(arm, 6.0)))
    assert found.only_a == ()
    (one,) = found.only_b
    assert (one.effect, one.joints, one.elsewhere, one.of) == ("cable_harness", ("joint2",), elsewhere, of)
    assert one.parameters["stiffness"] == (6.0, pytest.approx(0.1), "Nm/rad")


def test_an_effect_of_some_recordings_is_not_that_of_all(arm):
    whole = with_harness(arm, 6.0)
    some = replace(whole, terms=(*arm.terms, replace(whole.terms[-1], recordings=("1.csv",))))
    found = compare_models(Side("a", whole), Side("b", some))
    assert [one.recordings for one in (*found.only_a, *found.only_b)] == ["all", ("1.csv",)]


@pytest.fixture
def folders(arm, tmp_path) -> tuple[Path, Path]:
    """Of a model, and of a diagnosis of the same arm with a harness."""
    for name, model in (("a", arm), ("b", with_harness(arm, 6.0))):
        (tmp_path / name).mkdir()
        save_model(model, tmp_path / name / "model.json")
    (tmp_path / "b" / "diagnosis.json").write_text(json.dumps(TOLD))
    return tmp_path / "a", tmp_path / "b"


def test_the_console_tells_what_differs(folders, monkeypatch, capsys):
    a, b = folders
    assert command(monkeypatch, "compare", a, b) == 0
    said = capsys.readouterr().out
    assert "None of" in said
    assert "Only in B: cable harness of joint2 (stiffness 6.0 Nm/rad (95 %: 5.8 to 6.2 Nm/rad) and rest 17.2°)" in said
    assert "A has nothing of it" in said
    assert "dry friction" not in said
    assert command(monkeypatch, "compare", a / "model.json", b / "diagnosis.json", "--all") == 0
    assert "dry friction" in capsys.readouterr().out


def test_json_and_python_have_the_same(folders, monkeypatch, capsys):
    a, b = folders
    assert command(monkeypatch, "compare", a, b, "--json") == 0
    printed, found = json.loads(capsys.readouterr().out), rrr_oc.compare(rrr_oc.load(a), b)
    assert found.content == printed
    assert printed["only_b"][0]["effect"] == "cable_harness"
    columns, rows = found.table()
    assert columns[-2:] == ["in standard errors", "changed"]
    assert len(rows) == len(printed["changes"])
    assert "cable harness only in B" in repr(found)
    assert found._repr_html_().startswith("<p>None of")
    assert capsys.readouterr().out == ""


def test_arms_that_are_not_of_one_make_are_refused(arm):
    shorter, placements = load_robot("rrr", ["joint1", "joint2"]), arm.robot.placements.copy()
    placements[2, 0, 3] += 0.1
    with pytest.raises(UserError, match="a has the joints joint1, joint2, joint3, but b joint1, joint2; they must be the same"):
        compare_models(Side("a", arm), Side("b", replace(arm, robot=shorter)))
    with pytest.raises(UserError, match="joint joint3 sits or turns in b otherwise than in a"):
        compare_models(Side("a", arm), Side("b", replace(arm, robot=replace(arm.robot, placements=placements))))
    hanging = replace(arm, robot=replace(arm.robot, gravity=-arm.robot.gravity))
    with pytest.raises(UserError, match="arms that stand or hang alike"):
        compare_models(Side("a", arm), Side("b", hanging))


def written(folder: Path, costs: dict[str, float], springs: dict[str, float], quantity: QuantityEntry | None = None) -> Path:
    """A folder with the summary.json of a design."""
    folder.mkdir()
    found = summary(**{name: design(cost, springs=springs) for name, cost in costs.items()})
    (folder / "summary.json").write_text(json.dumps(data(structs.replace(found, quantity=quantity or found.quantity))))
    return folder


def test_designs_are_side_by_side(tmp_path, monkeypatch, capsys):
    a = written(tmp_path / "a", {"SA": 20.0, "PEA": 10.0}, {"k_p2": 10.0, "q_eq2": np.pi / 2})
    b = written(tmp_path / "b", {"PEA": 8.0, "BPEA": 5.0}, {"k_p2": 12.5, "q_eq2": np.pi / 3})
    assert command(monkeypatch, "compare", a, b / "summary.json") == 0
    printed = capsys.readouterr().out
    assert "E1: PEA 10.0 → 8.00 N²m²s (-20.0 %)." in printed
    assert "-30.0 °" in printed
    found = rrr_oc.compare(a, b)
    assert found.content["configurations"]["PEA"]["cost"] == [10.0, 8.0]
    assert found.content["configurations"]["SA"]["cost"] == [20.0, None]
    rows = {(row[0], row[1]): row[2:] for row in found.table()[1]}
    assert rows["PEA", "q_eq2"] == ["°", pytest.approx(90.0), pytest.approx(60.0)]
    assert rows["BPEA", "duration"] == ["s", None, 3.0]


def test_what_cannot_be_compared_is_said(folders, tmp_path, monkeypatch, capsys):
    a, _ = folders
    one = written(tmp_path / "one", {"PEA": 10.0}, {})
    other = written(tmp_path / "other", {"PEA": 10.0}, {}, QuantityEntry("energy", "J"))
    (tmp_path / "empty").mkdir()
    (tmp_path / "x.json").write_text('{"format": "rrr_oc-tasks/1"}')
    for pair, said in (
        ((a, one), "two of a kind can be compared"),
        ((one, other), "one design minimises E1 [N²m²s], the other energy [J]; the same cost is required"),
        (
            (a, tmp_path / "empty"),
            "nothing to compare; allowed is a folder with one of diagnosis.json, summary.json, model.json",
        ),
        (
            (tmp_path / "x.json", a),
            "its format is 'rrr_oc-tasks/1'; rrr_oc-diagnosis/1, rrr_oc-model/1, rrr_oc-design/1 can be",
        ),
        ((a, tmp_path / "nowhere"), "nowhere"),
    ):
        assert command(monkeypatch, "compare", *pair) == 2
        assert said in capsys.readouterr().err
