"""Reports as HTML pages: what they say first, names that are not markup, nothing from a network, and how a browser shows them."""

import json
import os
import re
from base64 import b64decode
from dataclasses import replace
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import designs
import numpy as np
import pea_bpea as study
import pytest
from chains import arm
from commands import rrr_oc, run
from filled import filled
from msgspec import structs
from own_arm import OWN, own_model, own_task
from recorded import Plant, as_set, record

from rrr_oc.calibration.calibrated_model import Estimate, Term
from rrr_oc.calibration.estimator.left_out import Fall
from rrr_oc.calibration.inverse_dynamics import plain_model
from rrr_oc.calibration.model_file import save_model
from rrr_oc.calibration.samples import blocks_of
from rrr_oc.codesign.certificate import MeshQuality
from rrr_oc.codesign.design_file import DesignFile
from rrr_oc.diagnosis.diagnosis_file import DiagnosisFile
from rrr_oc.diagnosis.result import Diagnosis, Finding, Fold
from rrr_oc.effects.elastic.parallel_spring import ParallelSpring
from rrr_oc.report.design_figures import ARM, design_figures, read_motions
from rrr_oc.report.design_report import optima_table, report, small_too
from rrr_oc.report.design_words import bound, cautions, hardware, verdict
from rrr_oc.report.diagnosis_figures import diagnosis_figures
from rrr_oc.report.diagnosis_report import about, write_diagnosis
from rrr_oc.report.figures import Panel, draw, plt, thinned
from rrr_oc.report.pages.design_page import write_design_page
from rrr_oc.report.pages.diagnosis_curves import POINTS, curves, held_out_predictions
from rrr_oc.report.pages.diagnosis_model import model_numbers
from rrr_oc.report.pages.diagnosis_page import first_shown, write_diagnosis_page
from rrr_oc.report.pages.page import PLOTLY, STEPS, packed
from rrr_oc.robot.robot import load_robot
from rrr_oc.schema import read_json
from rrr_oc.storage import read_npz

MARKUP = "<b>x</b>&\"'"  # a name that is markup where it is not escaped
FILE = "<i>0</i>&\"'.csv"
LARGEST = 2_000_000  # bytes of an ordinary page, as one can send it
SHOWN_AT = [(width, scheme) for width in (1280, 390) for scheme in ("light", "dark")]
pages = pytest.mark.parametrize("name", ["design", "set", "diagnosis"])


def made_diagnosis(joints: tuple[str, ...]) -> Diagnosis:
    """Two recordings with an unlisted spring at joint 2, which the extended models have and the plain ones lack."""
    plant, rng = Plant("rrr", np.full(3, 1.0), np.full(3, 4.0), np.full(3, 0.1)), np.random.default_rng(0)
    made = [record(plant, file, rng, 25.0, pea={1: (15.0, 1.5)}) for file in (FILE, "1.csv")]
    recordings = as_set(plant, [replace(r, springs=()) for r in made], robot=replace(load_robot("rrr"), joints=joints))
    start, truth = plain_model(recordings), [v for _ in joints for v in (1.0, 4.0, 0.1)]
    terms = tuple(t.with_values(np.array([v])) for t, v in zip(start.prompt_terms, truth, strict=True))
    plain = replace(start, terms=terms, noise=np.ones(3))
    spring = Term(ParallelSpring((1,)), (Estimate(15.0), Estimate(1.5)), 0.003)
    model, errors = replace(plain, terms=(*plain.terms, spring)), (np.array([[0.1, 0.4, 0.1]]), np.array([[0.1, 0.1, 0.1]]))
    folds, none = (
        tuple(Fold((k,), plain, model, *((1 + k) * e for e in errors)) for k in range(2)),
        np.full(3, 0.1),
    )
    held = (none, none), (none, none)
    return Diagnosis(recordings, plain, model, (), (), (), (), (), (), *held, "recordings", (), (), folds, (0.0,) * 3)


@pytest.fixture(scope="module")
def diagnosis() -> Diagnosis:
    return made_diagnosis((MARKUP, "elbow_joint", "wrist_joint"))


@pytest.fixture(scope="module")
def folders(tmp_path_factory, diagnosis) -> dict[str, Path]:
    """A study of an arm whose moving joint has markup for its name, with a calibrated model of it, one of a set of such tasks, and a
    diagnosis of such an arm."""
    folder = tmp_path_factory.mktemp("pages")
    preset = own_task(folder)
    (folder / "arm.urdf").write_text(arm(3).replace('"j2"', quoteattr(MARKUP)))
    Path(preset).write_text(Path(preset).read_text().replace('"j2"', json.dumps(MARKUP)))
    with pytest.MonkeyPatch.context() as patch:
        command = [*OWN, "--preset", preset, "--model", own_model(folder), "--out", str(folder / "design")]
        assert run(study, patch, *command) == 0
        tasks = [{"name": MARKUP}, {"name": "light", "payload_kg": 0.5}]
        together = {"format": "rrr_oc-tasks/1", "base": "task.json", "tasks": tasks, "uncertain": {"payload": 0.2}}
        (folder / "set.json").write_text(json.dumps(together))
        assert rrr_oc(patch, "design", str(folder / "set.json"), *OWN, "--front", "1", "--out", str(folder / "set")) == 0
    numbers = {joint: dict.fromkeys(("q", "dq", "ddq", "tau_motor", "tau_load"), 0.25) for joint in diagnosis.model.joints}
    simulated = {"held_out": True, "before": numbers, "after": {"why_not": "a <gap> moves the link by itself"}}
    write_diagnosis(diagnosis, folder / "diagnosis", simulated, "rrr-oc diagnose arm --out diagnosis")
    return {name: folder / name for name in ("design", "set", "diagnosis")}


def text_of(folder: Path) -> str:
    return (folder / "report.html").read_text()


def without_plotly(text: str) -> str:
    script = (files("rrr_oc.report") / "templates" / PLOTLY).read_text(encoding="utf-8")
    assert text.count(script) == text.count("plotly.js (basic - minified) v") == 1
    return text.replace(script, "")


def payload(text: str) -> dict[str, Any]:
    (found,) = re.findall(r'<script type="application/json" id="data">(.*?)</script>', text)
    page = json.loads(found)
    tables = page["data"].values()
    for columns in (columns for table in tables for columns in table.values() if "joined" not in columns):
        columns |= {name: unpacked(column) for name, column in columns.items()}
    return page


def unpacked(column: Any) -> list[Any]:
    """What the page's script makes of a column."""
    if isinstance(column, list):
        return column
    steps = np.frombuffer(b64decode(column["steps"]), "<u2")
    values = column["low"] + (column["high"] - column["low"]) / STEPS * steps.astype(float)
    return [None if step > STEPS else value for step, value in zip(steps.tolist(), values.tolist(), strict=True)]


@pages
def test_a_page_is_whole_in_one_file_and_asks_no_network(folders, name):
    text = text_of(folders[name])
    assert len(text.encode()) < LARGEST
    rest = without_plotly(text)
    assert '<meta name="viewport" content="width=device-width' in rest
    assert "prefers-color-scheme: dark" in rest
    links = re.findall(r'(?:src|href)\s*=\s*["\']?([^"\'> ]*)', rest)
    assert links == ["https://doi.org/10.1177/17298806241228371"]
    assert not re.search(r"<link|@import|url\(|<iframe|fetch\(|XMLHttpRequest", rest)


@pages
def test_reports_of_an_own_arm_do_not_speak_of_the_papers(folders, name):
    """Neither of its presets, nor of its equations by number, nor of its controllers, whoever's idea these were."""
    texts = [re.sub(r"<(style|script|pre)[ >].*?</\1>", "", without_plotly(text_of(folders[name])), flags=re.S)]
    texts += [path.read_text() for path in folders[name].glob("report.md")]
    assert len(texts) == (1 if name == "diagnosis" else 2)
    for text in texts:
        assert re.findall(r"\bpresets?\b|Eq\. ?\d|paper's|paper’s", text) == []


@pages
def test_the_verdict_stands_before_everything_else(folders, name):
    text = without_plotly(text_of(folders[name]))
    first = text.index('<p class="verdict">')
    assert all(text.index(part) > first for part in ("<h2", "<table", "<figure"))
    said = re.findall(r'<p class="verdict">(.*?)</p>', text)
    assert len(said) == 1
    assert said[0].startswith("Nothing is missing" if name == "diagnosis" else "PEA is best: E1 is ")
    assert text.rindex("Sources, and how to make this again") > text.rindex("</figure>")
    assert ("rrr-oc diagnose arm --out diagnosis" if name == "diagnosis" else "rrr-oc design") in text


@pages
def test_names_are_no_markup(folders, name):
    text = without_plotly(text_of(folders[name]))
    names = [MARKUP, FILE] if name == "diagnosis" else [MARKUP]
    for one in names:
        assert one not in text
        assert escape(one).replace("&quot;", "&#34;").replace("&#x27;", "&#39;") in text  # as Jinja writes quotes
    assert "<b>" not in text
    assert "<i>" not in text
    assert "a &lt;gap&gt; moves" in text or name != "diagnosis"


@pages
def test_every_figure_finds_its_data_and_has_a_sentence(folders, name):
    text = text_of(folders[name])
    page, rest = payload(text), without_plotly(text)
    placed = re.findall(r'data-figure="(\w+)"', rest)
    assert sorted(placed) == sorted(page["figures"])
    choices = {
        choice: re.findall(r'<option value="([^"]*)"', options)
        for choice, options in re.findall(r'<select data-choice="(\w+)">(.*?)</select>', rest)
    }
    for figure in page["figures"].values():
        keys = [""]
        for i, choice in enumerate(figure["by"]):
            keys = [key + "|" * bool(i) + value for key in keys for value in choices[choice]]
        for key in keys:
            table = page["data"][figure["table"]]
            assert re.fullmatch(r"[A-Z0-9].*\.", figure["captions"][key])
            if key not in table:  # where the sentence says that there is nothing to show
                continue
            parts = table[key].get("joined", [key])
            curves_of = [c for c in figure["curves"] if c["x"] in table[parts[0]]]
            assert curves_of
            for part in parts:
                for c in (c for c in curves_of if c["y"] in table[part]):
                    assert 0 < len(table[part][c["x"]]) == len(table[part][c["y"]]) <= POINTS


@pages
def test_a_page_is_made_again_from_its_files(folders, name):
    text = text_of(folders[name])
    write = {"design": write_design_page, "set": write_design_page, "diagnosis": write_diagnosis_page}[name]
    (folders[name] / "report.html").unlink()
    assert write(folders[name]) == folders[name] / "report.html"
    assert text_of(folders[name]) == text


def test_the_twin_and_the_units_are_on_the_page_of_a_design(folders):
    text, page = without_plotly(text_of(folders["design"])), payload(text_of(folders["design"]))
    assert re.search(
        r"In the twin PEA needs E1 = [\d.]+ N²m²s, [\d.]+ % less than stiff actuation there; [\d.]+ N²m²s were", text
    )
    with np.load(folders["design"] / "PEA.npz") as file:
        q, load, spring, t = (file[n] for n in ("q", "tau_load", "tau_spring", "t"))
    shown = page["data"]["motion"]["PEA|0"]
    assert (min(shown["q"]), max(shown["q"])) == pytest.approx((np.degrees(q).min(), np.degrees(q).max()), rel=1e-4)
    assert len(t) <= POINTS  # so that all samples are shown, with five digits
    np.testing.assert_allclose(shown["needed"], (load + spring)[0], atol=1e-4 * np.ptp(load + spring))
    assert shown["dq_upper"] == [90.0, 90.0]


def test_a_page_holds_the_extremes_of_a_long_recording(diagnosis):
    """25 s at 100 Hz are more samples than a curve may have."""
    found = curves(diagnosis, {})
    recorded = diagnosis.recordings.recordings[0]
    assert len(recorded.t) > POINTS
    t, q, dq, *_, after = found["left 0 1"]
    assert 1000 < len(t) <= POINTS
    residual = np.abs(after)
    assert found["remains"][0, 1, 0] > 10 * found["remains"][0, 1, 1]  # the plain model lacks the spring
    assert residual.max() < 5 * found["remains"][0, 1, 1]
    np.testing.assert_array_equal(np.isin(q, recorded.q[1]), True)
    np.testing.assert_array_equal(np.isin(dq, recorded.dq[1]), True)
    assert found["worst"] == 1


def test_the_law_of_a_claim_lies_over_what_was_recorded_of_it(diagnosis):
    """The spring's own torque at the angles of the bins, by its equation; the motor gives what it takes."""
    term = next(term for term in diagnosis.model.terms if term.effect.name == "parallel_spring")
    found = Finding(term, 0.9, 100.0, 1e-9, named=True, fall=Fall(1, 0.4, 0.3, 0.5), right=0.9)
    shown = curves(replace(diagnosis, findings=(found,)), {})
    assert shown["over"].tolist() == [f"q_{diagnosis.model.joints[1]}"]
    x, low, high, law = shown["law 0"]
    stiffness, rest = term.values
    assert len(x) > 20
    assert np.all(np.diff(x) > 0)
    width = 1.05 * np.max(np.diff(x)) * stiffness  # of a bin, over which the median may lie
    np.testing.assert_allclose(law, -stiffness * np.maximum(rest - x, 0.0), atol=width)
    assert np.mean((low <= law) & (law <= high)) > 0.8
    (figure,) = [f for f in diagnosis_figures(filled({}, DiagnosisFile), shown, ["Spring"]) if f.name == "law_0"]
    assert figure.axes == ("position of elbow [°]", "torque [Nm]")
    np.testing.assert_allclose(figure.data[""]["x"], np.degrees(x))


@pages
def test_matplotlib_draws_the_numbers_of_the_page(folders, name):
    """Of each figure with its first data, in every curve that is a line or a cloud of one colour."""
    folder = folders[name]
    if name == "diagnosis":
        found = read_json(folder / "diagnosis.json", DiagnosisFile)
        figures = diagnosis_figures(found, read_npz(folder / "figures.npz"))
    else:
        study = read_json(folder / "summary.json", DesignFile)
        figures = design_figures(study, read_motions(folder, study), read_npz(folder / ARM))
    page = payload(text_of(folder))
    assert sorted(f.name for f in figures) == sorted(page["figures"])
    for figure in figures:
        one = next(key for key, columns in figure.data.items() if "joined" not in columns)
        drawn = draw([[Panel(figure, one)]])
        axis, columns = drawn.axes[0], page["data"][figure.table][one]
        plt.close(drawn)
        shown = [np.column_stack(line.get_data(orig=True)) for line in axis.get_lines()]
        for curve in figure.drawn(one):
            if curve.colour or curve.moves:
                continue
            wanted = np.column_stack([np.array(columns[x], object) for x in (curve.x, curve.y)])
            numbers = [i for i in (0, 1) if not isinstance(wanted[0, i], str)]
            wanted = wanted[:, numbers].astype(float)
            atol = 1e-4 * np.max(np.abs(np.nan_to_num(wanted)))
            assert any(
                len(s) == len(wanted) and np.allclose(s[:, numbers].astype(float), wanted, rtol=1e-4, atol=atol, equal_nan=True)
                for s in shown
            ), (figure.name, curve)


def test_a_page_shows_first_what_the_first_claim_changes(diagnosis):
    """Joint 2 of recording 1 by what the claim says; without a claim what the plain model predicts worst."""
    joints, missed = list(diagnosis.model.joints), np.zeros((2, len(diagnosis.model.joints), 2))
    missed[:, :, 0] = 5.0
    missed[:, 1] = [[3.0, 2.0], [3.0, 1.0]]
    shown = {"missed": missed, "worst": np.array(0)}
    claimed = {"effect": "quadratic_drag", "lowers_error": {"joint": joints[1]}}
    errors = {joint: {"before": {"value": x}} for joint, x in zip(joints, (0.1, 0.2, 0.3), strict=True)}
    found = {"effects": [claimed], "unexplained": [], "bootstrap": errors}
    assert first_shown(filled(found, DiagnosisFile), shown, joints) == ("1", "1")
    assert first_shown(filled(found | {"effects": []}, DiagnosisFile), shown, joints) == ("0", "2")


def test_the_numbers_of_the_page_make_the_torque_of_the_model(diagnosis, tmp_path):
    """By hand from the printed numbers, which have three digits: what the motor does beyond the load torque."""
    plain, recorded = diagnosis.plain, diagnosis.recordings.recordings[0]
    save_model(plain, tmp_path / "model.json")
    header, rows = model_numbers(json.loads((tmp_path / "model.json").read_text()))
    assert header == ["joint", "dry friction", "viscous friction", "armature", "sgn(dq)"]
    by_hand = np.zeros_like(recorded.tau)
    for j, (_, *cells) in enumerate(rows):
        level, coefficient, inertia, width = (float(re.findall(r"\d+\.\d+", cell)[0]) for cell in cells)
        assert cells[-1].startswith("tanh(x), x = dq / (")
        by_hand[j] = level * np.tanh(recorded.dq[j] / width) + coefficient * recorded.dq[j] + inertia * recorded.ddq[j]
    exact = plain.predicted_torque(recorded) - plain.torques(recorded)[1]
    np.testing.assert_allclose(by_hand, exact, atol=5e-3 * np.abs(exact).max())


def test_a_note_keeps_the_case_of_a_files_name(diagnosis):
    first, *others = diagnosis.recordings.recordings
    recordings = replace(diagnosis.recordings, recordings=(replace(first, file="kp100.csv", dropped=3), *others))
    assert ". kp100.csv: 3 of " in about(recordings)


def test_a_diagnosis_that_adds_nothing_shows_each_map_once(diagnosis, tmp_path):
    folds = tuple(replace(f, model=f.plain) for f in diagnosis.folds)
    write_diagnosis(replace(diagnosis, model=diagnosis.plain, folds=folds), tmp_path)
    text = text_of(tmp_path)
    assert sorted(payload(text)["figures"]) == ["errors", "load_before", "position_before", "prediction", "time_before"]
    assert re.search(r"Both models are the same here; they miss the torque by \d+(\.\d+)? Nm rms\.", text)


def test_a_packed_column_is_what_it_was_to_what_can_be_seen():
    rng = np.random.default_rng(0)
    column = 1e3 + np.where(rng.random(5000) < 0.1, np.nan, rng.normal(size=5000))
    again = np.array(unpacked(packed(column)), float)
    np.testing.assert_array_equal(np.isnan(again), np.isnan(column))
    half_a_step = 0.51 * (np.nanmax(column) - np.nanmin(column)) / STEPS
    np.testing.assert_allclose(again[np.isfinite(column)], column[np.isfinite(column)], atol=half_a_step, rtol=0)
    assert len(json.dumps(packed(column))) < 3 * column.size
    assert packed(np.array(["<b>", "b"])) == ["<b>", "b"]
    assert packed([1.0, np.nan, 1 / 3]) == [1.0, None, 0.33333]
    assert unpacked(packed(np.full(100, 7.0))) == [7.0] * 100
    assert unpacked(packed(np.full(100, np.nan))) == [None] * 100


def test_thinned_samples_have_the_extremes_and_are_no_more_than_asked_for():
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(3, 10_000))
    rows[1, 1234], rows[2, 4321] = 50.0, np.nan
    index = thinned(rows, 500, (0, 1, 2))
    assert len(index) <= 500
    assert np.all(np.diff(index) > 0)
    assert {0, 9999, 1234} <= set(index.tolist())
    np.testing.assert_array_equal(np.nanmax(rows[:, index], axis=1), np.nanmax(rows, axis=1))
    np.testing.assert_array_equal(np.nanmin(rows[:, index], axis=1), np.nanmin(rows, axis=1))
    np.testing.assert_array_equal(thinned(rows[:, :400], 500, (0,)), np.arange(400))


def test_each_block_of_an_only_recording_is_predicted_by_the_models_that_did_not_see_it(diagnosis):
    (recorded, *_), plain, model = diagnosis.recordings.recordings, diagnosis.plain, diagnosis.model
    blocks = blocks_of(recorded)
    even, odd = tuple(range(0, len(blocks), 2)), tuple(range(1, len(blocks), 2))
    first = replace(diagnosis.folds[0], held=even, plain=plain, model=plain)
    second = replace(diagnosis.folds[0], held=odd, plain=model, model=model)
    before, after = held_out_predictions(replace(diagnosis, way="blocks", folds=(first, second)), 0, recorded) or (
        (),
        (),
    )
    np.testing.assert_array_equal(before, after)
    for k, block in enumerate(blocks):
        np.testing.assert_array_equal(before[:, block], (plain, model)[k % 2].predicted_torque(recorded)[:, block])


def tracked(E1: float, missed: float = 0.0) -> dict[str, Any]:
    """Metrics in MuJoCo, where the planned angles are missed by up to `missed` [rad]."""
    found = designs.metrics(E1) | {"E1_relative_error": 0.0, "energy_residual": 0.0, "tracking_error_rad": missed}
    return found | {"exact_springs": found}


STIFF = designs.design(200.0, springs={}, mounted={})
IDLE = {"parallel_spring[b]": "never taut"}


def test_the_verdict_compares_at_equal_cycle_times_what_was_compared():
    """A starred design is not; a time at which no motion was found says nothing."""

    def at(*costs: float | None) -> list[dict]:
        return [{"cycle_s": t, "cost": cost, "balancing": None} for t, cost in zip((2.5, 4.0, 6.0), costs, strict=True)]

    stiff = designs.design(200.0, springs={}, mounted={}, at_cycle_times=at(200.0, 210.0, 220.0))
    study = designs.summary(SA=stiff, PEA=designs.design(50.0, at_cycle_times=at(None, 52.5, 44.0)), PEA_=designs.design(60.0))
    said = verdict(study)
    assert "75.0 % less than the 200 N²m²s of stiff actuation, though in 3 s in the place of 3 s" in said
    assert "where both take equally long, 4 to 6 s, it is 75.0 to 80.0 %" in said
    assert "PEA*" in said
    text = report(study)
    assert "| PEA | 50.000 (3.00 s) | – | 52.500 (75.0 %) | 44.000 (80.0 %) |" in text


def test_the_verdict_of_a_design_names_the_best_its_gain_and_what_is_bought():
    said = verdict(designs.summary(SA=STIFF, PEA=designs.design(50.0), PEA_=designs.design(60.0)))
    assert said.startswith("PEA is best: E1 is 50 N²m²s, 75.0 % less than the 200 N²m²s of stiff actuation. To buy for PEA*: ")
    springs = "a spring of 10 Nm/rad on b, unloaded at 90° and a spring of 5 Nm/rad across two joints with r_1 = 20 mm"
    assert hardware(designs.design(1.0), ["a", "b", "c"]) == springs
    assert said.endswith(f"{springs}. Then E1 is 60 N²m²s, 70.0 % less than the 200 N²m²s of stiff actuation.")
    assert "no catalogue of springs to buy was searched" in verdict(designs.summary(SA=STIFF, PEA=designs.design(50.0)))
    alone = verdict(designs.summary(PEA=designs.design(50.0, not_bought="none converged")))
    assert "no choice of the catalogue could be solved" in alone
    assert "without stiff actuation among the configurations" in alone
    nothing = verdict(designs.summary(SA=STIFF, PEA=designs.with_motion(designs.design(199.0), idle=IDLE)))
    assert nothing == "PEA costs E1 = 199 N²m²s; no springs help this task."


TWIN = {
    "engine": designs.metrics(150.0),
    "eq10": None,
    "motor": designs.metrics(1.0),
    "saturated": True,
    "tracking_error_rad": 0.2,
}
CAUTIONS = {
    "a spring that is never taut": ({"idle": IDLE}, "the parallel spring of b is never taut"),
    "a mesh that was not met": ({"mesh": MeshQuality(1e-3, 0.0, None, False)}, "the tolerance of the mesh was not met"),
    "an engine that disagrees": ({"mujoco": tracked(103.0)}, "MuJoCo finds an E1 that is +3.0 % away"),
    "an engine far off": (
        {"mujoco": tracked(4760.0, 0.3)},
        "MuJoCo finds an E1 that is 47.6 times the planned one: the arm does not follow the motion there",
    ),
    "an engine far off that follows": (
        {"mujoco": tracked(4760.0, 0.001)},
        "MuJoCo finds an E1 that is 47.6 times the planned one: the arm follows the motion, but ",
    ),
    "a limit that is exceeded": ({"violation": 0.1}, "exceeded between the nodes by 10 % of its scale"),
    "no local optimum": ({"second_order": "violated"}, "is no local optimum"),
    "one start": ({"reached": 1}, "only one start led to this optimum; more starts, or another seed, may find a better one."),
    "no start": ({"reached": 0}, "no start led to this optimum itself"),
    "one start, and a bound": ({"reached": 1, "least": 12.5}, "may find a better one, though none below 12.5 N²m²s."),
    "a twin that needs more": ({"calibrated": TWIN}, "in the calibrated twin E1 is +50 % away"),
}


def test_costs_of_light_arms_keep_their_digits():
    assert [small_too(x) for x in (563.2281, 0.1, 0.01234567, 0.0001241794, 0.0)] == [
        "563.228",
        "0.100",
        "0.0123",
        "0.000124",
        "0.000",
    ]
    _, rows = optima_table(designs.summary(SA=STIFF, PEA=designs.design(0.0001241794)))
    assert rows[1][1] == "0.000124"


@pytest.mark.parametrize("few", [{"starts": 4}, {"motions": 0}, {"starts": 4, "motions": 12}, {"springs": 4, "rounds": 2}])
def test_a_small_search_is_warned_of(few):
    """However often its starts led to the optimum: they may all have missed the motions of a better one."""
    usual = {"starts": 20, "motions": 48, "springs": 24, "rounds": 4}
    study = structs.replace(designs.summary(SA=STIFF, PEA=designs.design(100.0)), options=usual | few)
    (said,) = cautions(study)
    assert said.startswith("The search was small, with ")
    what = {
        "starts": "starts",
        "motions": "proposed motions",
        "springs": "springs tried with other motions",
        "rounds": "rounds of motions",
    }
    assert {key for key in usual if f"{few.get(key)} {what[key]} in the place of {usual[key]}" in said} == set(few)


@pytest.mark.parametrize(("changes", "said"), CAUTIONS.values(), ids=CAUTIONS.keys())
def test_what_a_reader_should_know_is_said(changes, said):
    whole = designs.design(100.0)
    assert any(said in line for line in cautions(designs.summary(SA=STIFF, PEA=designs.with_motion(whole, **changes))))
    assert cautions(designs.summary(SA=STIFF, PEA=whole)) == []


def test_a_search_that_was_interrupted_is_said():
    assert any("was interrupted" in line for line in cautions(designs.summary(SA=designs.design(100.0, interrupted=True))))


def test_what_an_interrupted_study_has_not_done_is_said():
    left = ("PEA", "PEA+BPEA", "the comparison at equal cycle times")
    study = structs.replace(designs.summary(SA=STIFF), unfinished=left)
    told = "PEA, PEA+BPEA and the comparison at equal cycle times"
    assert cautions(study)[0] == f"Unfinished: {told}. The same command goes on with it."
    assert verdict(study).endswith("the study was ended before PEA and PEA+BPEA were designed.")
    assert verdict(structs.replace(study, unfinished=())).endswith("no configuration with springs was asked for.")


def test_what_a_reader_should_know_of_a_set_names_the_task():
    """A spring that does nothing in one task alone is no reason to warn; one that does nothing in any is."""
    some = {"a": designs.moved(60.0, idle=IDLE, beyond={"table_spring[b]": "known from 0° to 9°"}), "b": designs.moved(40.0)}
    (said,) = cautions(designs.summary(PEA=designs.design(100.0, some)))
    assert said == "PEA: in task a the law of the table spring of b is known from 0° to 9°: beyond, it is a guess."
    every = {name: designs.moved(50.0, idle=IDLE) for name in "ab"}
    assert cautions(designs.summary(PEA=designs.design(100.0, every))) == [
        "PEA: the parallel spring of b is never taut: it does nothing in any task."
    ]


def test_the_verdict_of_a_set_says_what_sharing_costs():
    shared = designs.design(100.0, {"a": designs.moved(60.0), "b": designs.moved(40.0)}, alone=80.0, with_first=125.0)
    said = verdict(designs.summary(PEA=shared))
    assert "PEA is best: E1 is 100 N²m²s for all tasks together, without stiff actuation" in said
    assert "Springs of its own for each task would need 20.0 % less; the springs of “a” need 25.0 % more." in said


def test_a_bound_is_told_in_words():
    sentence = "moving the upper bound of parallel_spring[b].stiffness (13 Nm/rad) outward would save 12 % of E1"
    assert (
        bound(sentence)
        == "Moving the upper bound of stiffness of the parallel spring of b (13 Nm/rad) outward would save 12 % of E1."
    )


@pages
def test_a_browser_shows_a_page_wide_and_narrow_light_and_dark(folders, browser, tmp_path, name):
    artifacts, said, asked, papers = Path(os.environ.get("RRR_OC_ARTIFACTS", tmp_path)), [], [], {}
    artifacts.mkdir(parents=True, exist_ok=True)
    for width, scheme in SHOWN_AT:
        context = browser.new_context(viewport={"width": width, "height": 900}, color_scheme=scheme)
        page = context.new_page()
        page.on("console", lambda message: said.append(message.text))
        page.on("pageerror", lambda error: said.append(str(error)))
        page.on("request", lambda request: asked.append(request.url.split(":")[0]))
        page.goto((folders[name] / "report.html").as_uri())
        drawn = page.eval_on_selector_all(".plot", "plots => plots.map(p => p.querySelectorAll('.main-svg').length > 0)")
        assert drawn
        assert all(drawn)
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        wide = page.eval_on_selector_all(".plot .main-svg", "plots => plots.map(p => p.getBoundingClientRect().right)")
        assert max(wide) <= width
        tables = page.eval_on_selector_all(
            ".wide:has(table)", "parts => parts.map(part => part.scrollWidth - part.clientWidth)"
        )
        assert tables
        assert max(tables) <= 0  # a table that is cut is not read
        papers[scheme] = page.evaluate("getComputedStyle(document.body).backgroundColor")
        inks = page.eval_on_selector_all(".plot .xtick text", "texts => texts.map(text => getComputedStyle(text).fill)")
        assert set(inks) == {page.evaluate("getComputedStyle(document.body).color")}
        _every_choice_is_shown(page)
        page.screenshot(path=artifacts / f"{name}_{width}_{scheme}.png", full_page=True)
        context.close()
    assert said == []
    assert set(asked) <= {"file", "data", "blob"}
    assert papers["light"] != papers["dark"]
    assert len(list(artifacts.glob(f"{name}_*.png"))) == len(SHOWN_AT)


def _every_choice_is_shown(page: Any) -> None:
    """Each select, turned to its last option, changes what is shown, and leaves one part of each kind visible."""
    first = {select.get_attribute("data-choice"): select.input_value() for select in page.query_selector_all("select")}
    for choice, before in first.items():
        select = page.locator(f'select[data-choice="{choice}"]')
        options = select.locator("option").evaluate_all("options => options.map(option => option.value)")
        others = [option for option in options if option != before]
        captions = page.locator("figcaption").all_text_contents()
        for option in others[-1:]:
            select.select_option(option)
            assert page.locator("figcaption").all_text_contents() != captions
            shown = "parts => [...new Set(parts.filter(part => !part.hidden).map(part => part.dataset.of))]"
            assert page.locator(f'[data-choice="{choice}"][data-of]').evaluate_all(shown) in ([], [option])
        select.select_option(before)
