"""The reference of files: current, complete, and with examples that the readers accept; keys of two spellings."""

import json
import re
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

from docs.from_code.files import COLUMNS, pages
from rrr_oc.codesign.catalogue import load_catalogue
from rrr_oc.codesign.springs import spring_bounds
from rrr_oc.codesign.task import load_task
from rrr_oc.effects.priors import load_priors
from rrr_oc.errors import UserError
from rrr_oc.recordings.reader import load_recordings
from rrr_oc.robot.drives import load_actuators
from rrr_oc.schema import parsed, without_comments
from rrr_oc.storage import write_csv

FOLDER = Path(__file__).resolve().parents[2] / "docs" / "reference"
EXAMPLES = Path(str(files("rrr_oc.data"))) / "examples"
PAGES = pages()


def test_the_committed_pages_are_current():
    found = {path.name: path.read_text(encoding="utf-8") for path in FOLDER.glob("*.md")}
    assert found == PAGES, "python -m docs.from_code.files writes them anew"


@pytest.mark.parametrize("name", PAGES)
def test_every_key_has_a_type_a_default_and_a_sentence(name):
    rows = [line.strip("|").split(" | ") for line in PAGES[name].splitlines() if line.startswith("| `")]
    assert rows
    for row in rows:
        cells = dict(zip(COLUMNS, (cell.strip() for cell in row), strict=True))
        assert all(cells.values())
        assert re.search(r"[a-z].*\.$", cells["meaning"]), row


@pytest.mark.parametrize(
    ("page", "row"),
    [
        ("recordings", "| `payload` or `payload_kg` | number | kg | `0.0` | ≥ 0 and ≤ 10000 | Mass at the tool;"),
        ("recordings", '| `inertial` | text | – | `"nominal"` | `"nominal"` or `"identify"` | Whether the URDF'),
        ("recordings", "| `radius1_m` | number | m | required | ≥ 1e-06 and ≤ 5 |"),
        ("task", "| `acceleration_deg_per_s2` | number | °/s² | none | ≥ 1e-12 | Greatest acceleration. |"),
        ("task", "`r_2_mm`: bounds [mm]"),
        ("task", "| `gravity` | list of 3 numbers | m/s² | none | ≥ -10000 and ≤ 10000 | Acceleration of gravity in the base frame. Default: "
         "the MJCF's; of a URDF [0, 0, -9.81]. |"),
        ("actuators", "| `viscous_A_s_per_rad` | number | A s/rad | required | ≥ 0 |"),
        ("priors", "| `probability` | number | – | none | > 0 and < 1 |"),
        ("model", "| `interval` | list of 2 numbers | – | required | any | 95 % interval; null as well. |"),
    ],
)  # fmt: skip
def test_a_row_says_key_type_unit_default_and_allowed_values(page, row):
    assert row in PAGES[f"{page}.md"]


@pytest.mark.parametrize("name", ["recordings.json", "task.json", "tasks.json", "actuators.json", "catalogue.json"])
def test_examples_have_comments_and_stand_on_their_page(name):
    text = (EXAMPLES / name).read_text(encoding="utf-8")
    assert "//" in text
    assert text.rstrip() in PAGES[f"{name.removesuffix('.json')}.md"]
    with pytest.raises(json.JSONDecodeError):
        json.loads(text)
    assert parsed(name, text) == json.loads(without_comments(text))


def test_the_readers_accept_the_examples(tmp_path):
    task = load_task(EXAMPLES / "task.json")
    assert (task.name, task.payload, len(spring_bounds(task, "PEA"))) == ("shelf", 2.0, 1)
    assert load_actuators(["joint1"], str(EXAMPLES / "actuators.json")).resistance == [0.6]
    assert load_catalogue(EXAMPLES / "catalogue.json").lists["PEA"]["joint3"] == (0.7, 1.3)
    assert load_priors(EXAMPLES / "priors.toml").given["stribeck"].probability == 0.2
    (tmp_path / "recordings.json").write_text((EXAMPLES / "recordings.json").read_text(encoding="utf-8"))
    t = np.arange(300) / 100
    columns = {"t": t} | {f"{kind}_joint{j}": np.sin(t * j) for j in (1, 2, 3) for kind in ("q", "tau")}
    for file in ("sweep1.csv", "sweep2.csv"):
        write_csv(tmp_path / file, columns)
    first, second = load_recordings(tmp_path).recordings
    assert (first.payload.max(), second.payload.max(), len(second.springs), second.group) == (0.0, 5.0, 1, "with spring")


def test_comments_are_blanks_and_places_of_errors_stay():
    assert parsed("f", '{"a": "http://x", // "b": 1\n "c\\"//": 2}') == {"a": "http://x", 'c"//': 2}
    with pytest.raises(UserError, match="line 2, column 6"):
        parsed("f", '{ // a comment\n "a" 1}')


def a_set(folder: Path, entry: str, column: str = "") -> Path:
    text = '{"format": "rrr_oc-recordings/1", "robot": "rrr", "joints": ["joint1", "joint2", "joint3"], "recordings": [{"file": "a.csv"%s}]}'
    (folder / "recordings.json").write_text(text % entry)
    t = np.arange(300) / 100
    columns = {"t": t} | {f"{kind}_joint{j}": np.sin(t * j) for j in (1, 2, 3) for kind in ("q", "tau")}
    write_csv(folder / "a.csv", columns | dict.fromkeys(column.split(), 1.5 + 0 * t))
    return folder


@pytest.mark.parametrize("key", ["payload", "payload_kg"])
def test_both_spellings_of_the_payload_are_read(tmp_path, key):
    assert load_recordings(a_set(tmp_path, f', "{key}": 2.5')).recordings[0].payload.max() == 2.5
    of_column = load_recordings(a_set(tmp_path, "", key)).recordings[0]
    assert (of_column.payload.max(), of_column.ignored) == (1.5, ())
    text = (EXAMPLES / "task.json").read_text(encoding="utf-8").replace('"payload_kg": 2.0', f'"{key}": 2.5')
    (tmp_path / "task.json").write_text(text)
    assert load_task(tmp_path / "task.json").payload == 2.5


def test_both_spellings_of_a_position_are_read(tmp_path):
    tool = ', "payload": 1}], "tool": {"link": "link3", "%s": [0.1, 0.2, 0.3]}, "comment": [{"a": 0'
    found = [load_recordings(a_set(tmp_path, tool % key)).tool.position for key in ("position", "position_m")]
    np.testing.assert_array_equal(*found)
    text = (EXAMPLES / "task.json").read_text(encoding="utf-8")
    (tmp_path / "task.json").write_text(text.replace("position_m", "position"))
    mine, example = load_task(tmp_path / "task.json"), load_task(EXAMPLES / "task.json")
    np.testing.assert_array_equal([*mine.start, *mine.tool.position], [*example.start, *example.tool.position])


def test_both_spellings_at_once_are_an_error(tmp_path):
    both = "'payload'.*'payload_kg' stand in one object and mean the same; one is allowed"
    with pytest.raises(UserError, match=r"recordings\[0\]: " + both):
        load_recordings(a_set(tmp_path, ', "payload": 1, "payload_kg": 1'))
    with pytest.raises(UserError, match=r"a.csv, line 1: " + both):
        load_recordings(a_set(tmp_path, "", "payload payload_kg"))
    text = (EXAMPLES / "task.json").read_text(encoding="utf-8").replace('"payload_kg"', '"payload": 1, "payload_kg"')
    (tmp_path / "task.json").write_text(text)
    with pytest.raises(UserError, match=r"task.json: " + both):
        load_task(tmp_path / "task.json")
