"""Files that look right and are not: what would give a wrong result is one sentence instead."""

import fcntl
import importlib.resources
import io
import json
import os
import re
import sys
import tempfile
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from recorded import Plant, as_set, record
from rich.table import Table

from rrr_oc import storage
from rrr_oc.calibration.calibrate import calibrate
from rrr_oc.calibration.inverse_dynamics import plain_model
from rrr_oc.calibration.model_file import load_model, save_model
from rrr_oc.codesign.catalogue import load_catalogue
from rrr_oc.codesign.springs import saved_springs
from rrr_oc.codesign.study import Request, _asked
from rrr_oc.codesign.task import load_task
from rrr_oc.codesign.task_sets.task_set import load_tasks
from rrr_oc.commands.output import Output
from rrr_oc.commands.shared import check_apart
from rrr_oc.effects.priors import load_priors
from rrr_oc.errors import UserError, entry_point
from rrr_oc.kept import kept_motion, once
from rrr_oc.recordings.csv_table import read_table
from rrr_oc.recordings.reader import load_recordings
from rrr_oc.recordings.writer import save_recordings
from rrr_oc.report.console import PlainConsole
from rrr_oc.robot.drives import load_actuators
from rrr_oc.robot.robot import load_robot
from rrr_oc.storage import (
    Made,
    check_file,
    check_folder,
    new_files,
    new_folder,
    plain,
    read_npz,
    read_regular,
    write_npz,
    write_text,
)
from studies.paper.run_store import Run

PLANT = Plant("rrr", np.full(3, 5.0), np.full(3, 10.0), np.full(3, 0.2))


@pytest.fixture(scope="module")
def recordings():
    return as_set(PLANT, [record(PLANT, "0.csv", np.random.default_rng(0), 6.0)])


@pytest.fixture
def model(recordings, tmp_path):
    """A function that reads a model.json again in which values were changed, by their keys."""
    path = tmp_path / "model.json"
    save_model(plain_model(recordings), path)

    def changed(*keys, value):
        content = json.loads(path.read_text())
        place = content
        for key in keys[:-1]:
            place = place[key]
        place[keys[-1]] = value
        path.write_text(json.dumps(content))
        return load_model(path)

    return changed


ENTRY = {"effect": "gravity_tilt", "joints": [], "options": {}, "width": None, "recordings": "all", "groups": []}
ANGLE = {"value": 0.01, "unit": "rad", "std": None, "interval": None, "at_bound": False}
TILT = {**ENTRY, "parameters": {"about_x": ANGLE, "about_y": ANGLE}}
FRICTION = ("effects", 0, "parameters", "level")
SERIES = {"variables": [["q", 0]], "low": [-1.0], "high": [1.0], "orders": [1]}


def series(**changes):
    """A term without a law on the first joint, with other options."""
    coefficient = {**ANGLE, "unit": "Nm"}
    entry = {**ENTRY, "effect": "empirical", "joints": ["joint1"], "width": {"value": 0.05, "unit": "rad/s"}}
    return [{**entry, "options": SERIES | changes, "parameters": {"c_1": coefficient}}]


@pytest.mark.parametrize(
    ("keys", "value", "said"),
    [
        ((*FRICTION, "value"), -3.0, "effects[0].parameters.level.value: found -3; 0 to inf are allowed"),
        ((*FRICTION, "value"), 1e300, "effects[0].parameters.level.value: found 1e+300; a finite number from"),
        ((*FRICTION, "unit"), "A", "effects[0].parameters.level.unit: found 'A'; 'Nm' is required"),
        ((*FRICTION, "interval"), [2.0, 1.0], "effects[0].parameters.level.interval: bounds are crossed: 2 … 1"),
        ((*FRICTION, "std"), -1.0, "effects[0].parameters.level.std: found -1.0; a finite number of 0 or more"),
        (("effects", 0, "width", "value"), -1.0, "effects[0].width.value: found -1.0"),
        (("effects", 0, "width", "unit"), "rad", "effects[0].width.unit: found 'rad'; 'rad/s' is required"),
        (("effects", 0, "joints"), [], "effects[0].joints: found []; 1 different joint are required by dry_friction"),
        (("effects", 0, "joints"), ["joint1", "joint2"], "effects[0].joints: found ['joint1', 'joint2']; 1 different"),
        (("effects",), [TILT | {"joints": ["joint1"]}], "effects[0].joints: found ['joint1']; no joint is required"),
        (("effects",), [{**TILT, "effect": "torque_gain", "joints": ["joint1", "joint2"]}], "effects[0].joints: found"),
        (("effects",), [TILT, TILT], "effects[1]: gravity_tilt stands in effects[0] already"),
        (("effects", 0, "recordings"), "0.csv", "effects[0].recordings: found '0.csv'; allowed is 'all'"),
        (("effects", 0, "options"), {"turn": 3}, "effects[0].options.turn: found 3; a text is required"),
        (("effects", 0, "options"), {"joints": [2]}, "effects[0].options: unknown option 'joints'"),
        (
            ("effects",),
            series(low=[1.0]),
            "effects[0].options: found variables (('q', 0),) from (1.0,) to (1.0,); a rising range",
        ),
        (("effects",), series(orders=[1, 1]), "effects[0].options: found orders (1, 1)"),
        (("effects",), series(variables=[["q", 3]]), "effects[0].options: found joint 3; 0 to 2 are allowed"),
        (("noise", "joint1"), -1.0, "noise.joint1: found -1.0; a finite number of 0 or more"),
        (("robot", "inertial", "link1", 0), -2.0, "robot.inertial.link1: found [-2.0"),
        (("robot", "inertial", "link2", 9), 9.0, "robot.inertial.link2: found ["),
        (("robot", "inertial", "link3", 0), 1e-300, "robot.inertial.link3: found [1e-300"),  # its centre would overflow
        (("robot", "inertial", "link3"), "heavy", "robot.inertial.link3: found 'heavy'"),
        (("gravity",), [0, 0, -1e300], "gravity[2]: found -1e+300"),
    ],
)
def test_a_model_that_no_arm_can_have_is_refused(model, keys, value, said):
    with pytest.raises(UserError) as caught:
        model(*keys, value=value)
    assert f"model.json: {said}" in str(caught.value)


def test_models_that_are_right_are_read(model):
    assert len(model("effects", value=[TILT]).terms) == 1
    assert len(model("effects", value=series()).terms) == 1


DRIVE = {
    "torque_constant_Nm_per_A": 10.0, "c_0_A": 0.5, "viscous_A_s_per_rad": 2.0, "c_v2_A_s2_per_rad2": -0.5, "c_1_A_per_Nm": 0.1,
    "c_12_A_per_Nm": 0.01, "inertia_A_s2_per_rad": 0.0, "resistance_Ohm": 0.6,
}  # fmt: skip


@pytest.mark.parametrize(
    ("key", "value"),
    [
        *((key, value) for key in ("torque_constant_Nm_per_A", "c_1_A_per_Nm", "resistance_Ohm") for value in (0, -1)),
        *(("regeneration", value) for value in (-0.1, 1.1, "all")),
        *((key, -1) for key in ("c_0_A", "viscous_A_s_per_rad", "inertia_A_s2_per_rad")),
        *(("c_12_A_per_Nm", value) for value in (0.1, -0.1)),
        *(("c_0_A", value) for value in (1e10, 10**400, "1", False, None)),
    ],
)
def test_a_drive_that_none_has_is_refused(tmp_path, key, value):
    (tmp_path / "drives.json").write_text(json.dumps({"j": DRIVE}))
    assert load_actuators(["j"], str(tmp_path / "drives.json")).resistance == 0.6
    (tmp_path / "drives.json").write_text(json.dumps({"j": DRIVE | {key: value}}))
    with pytest.raises(UserError, match=f"drives.json: j.*{key}"):
        load_actuators(["j"], str(tmp_path / "drives.json"))


@pytest.mark.parametrize("cell", ["1_0", "٣", "１", "0x1", "1e", "true", "--1", "1 2"])
def test_what_only_python_takes_for_a_number_is_none(tmp_path, cell):
    (tmp_path / "a.csv").write_text(f"t,q\n0,1\n1,{cell}\n", encoding="utf-8")
    with pytest.raises(UserError, match=r"a\.csv, line 3, column 'q': found .*; a number"):
        read_table(tmp_path / "a.csv").columns(["t", "q"])


@pytest.mark.parametrize("delimiter", [",", ";", "\t"])
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_decimals_are_read_exactly(tmp_path, delimiter, end):
    """Each cell is the number that Python's `float` makes of it, to the last bit; comments, blank lines and words harm nothing."""
    rng = np.random.default_rng(0)
    numbers = rng.normal(size=(400, 3)) * 10.0 ** rng.integers(-300, 300, (400, 3))
    spelled = (repr, "{:.25e}".format, "{:.30f}".format, "{:+.7G}".format, " {:.17g} ".format, "{:.0f}".format)
    cells = [[spelled[rng.integers(len(spelled))](float(x)) for x in row] for row in numbers]
    cells[7][1], cells[8][2], cells[9][0], cells[10][2] = "nan", "NaN", "-0.0", "4.9e-324"
    lines = [delimiter.join(row) for row in cells]
    lines[3:3] = ["", " # a, b; c", lines.pop(3) + "# 1,2;3"]
    (tmp_path / "a.csv").write_bytes(end.join([delimiter.join("abc"), *lines]).encode())
    found = read_table(tmp_path / "a.csv").columns("ca")
    expected = np.array([[float(row[i]) for row in cells] for i in (2, 0)])
    np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(np.signbit(found), np.signbit(expected))


def test_a_long_row_does_not_make_up_for_a_short_one(tmp_path):
    (tmp_path / "a.csv").write_text("a,b,c\n1,2,3\n1,2,3,4\n1,2\n")
    with pytest.raises(UserError, match=r"a\.csv, line 3: 4 cells, but the header names 3 columns"):
        read_table(tmp_path / "a.csv").columns("ab")


def test_an_empty_cell_is_nan(tmp_path):
    (tmp_path / "a.csv").write_text("a,b\n0.1,\n,2e-5\n")
    np.testing.assert_array_equal(read_table(tmp_path / "a.csv").columns("ab"), [[0.1, np.nan], [np.nan, 2e-5]])


def test_a_recording_too_short_for_the_filters_does_not_drop_out(recordings, tmp_path):
    save_recordings(recordings, tmp_path / "set")
    lines = (tmp_path / "set" / "0.csv").read_text().splitlines()
    (tmp_path / "set" / "1.csv").write_text("\n".join(lines[:7]) + "\n")
    header = json.loads((tmp_path / "set" / "recordings.json").read_text())
    header["recordings"].append({"file": "1.csv"})
    (tmp_path / "set" / "recordings.json").write_text(json.dumps(header))
    with pytest.raises(UserError, match=r"1\.csv: 6 rows of 0\.05 s are too short for the filters, which take 0\.2 s"):
        calibrate(load_recordings(tmp_path / "set"))


def test_a_link_out_of_the_set_is_not_followed(recordings, tmp_path):
    save_recordings(recordings, tmp_path / "set")
    table = tmp_path / "set" / "0.csv"
    table.rename(tmp_path / "set" / "other.csv")
    table.symlink_to("other.csv")
    (tmp_path / "there").symlink_to(tmp_path / "set", target_is_directory=True)
    assert load_recordings(tmp_path / "there").recordings[0].file == "0.csv"  # within the set, and to the set
    (tmp_path / "secret").write_text("user:password\n")
    table.unlink()
    table.symlink_to(tmp_path / "secret")
    with pytest.raises(UserError, match=r"0\.csv: is a link that leads out of the set's folder") as caught:
        load_recordings(tmp_path / "set")
    assert "password" not in str(caught.value)


HOSTILE = "joint\x1b[31m\x9b2J\u202e\r[bold]:boom:"
SHOWN = "joint\\u001b[31m\\u009b2J\\u202e\\u000d[bold]:boom:"


def test_names_do_not_command_the_terminal(capsys, monkeypatch):
    output = Output()
    table = Table(HOSTILE)
    table.add_row(HOSTILE)
    output.show(table)
    output.show(HOSTILE)
    output.note(HOSTILE)
    output.result({HOSTILE: HOSTILE})
    with output.steps(HOSTILE) as step, output.count(HOSTILE, 1) as count:
        step(HOSTILE)
        count(1, HOSTILE)

    def fail():
        raise UserError(HOSTILE)

    with pytest.raises(SystemExit):
        entry_point(fail)()
    printed = capsys.readouterr()
    assert printed.out.count(SHOWN) == 3
    assert printed.err.count(SHOWN) == 6
    assert not set("\x1b\x9b\u202e\r") & set(printed.out + printed.err)
    Output(as_json=True).result({"a": "\x9b"})
    assert json.loads(capsys.readouterr().out) == {"a": "\x9b"}


@pytest.mark.parametrize("disk", ["free", "full"])
def test_a_fault_of_the_program_is_one_sentence_and_a_log(capsys, monkeypatch, tmp_path, disk):
    def full(**_):
        raise OSError("No space left on device")

    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(sys, "argv", ["rrr-oc", "calibrate", "my set"])
    if disk == "full":
        monkeypatch.setattr(tempfile, "mkstemp", full)
    with pytest.raises(SystemExit) as ended:
        entry_point(lambda: {}[HOSTILE])()
    assert ended.value.code == 70
    said, logs = capsys.readouterr().err, list(tmp_path.iterdir())
    assert said.startswith("Error: rrr-oc failed through a fault of its own, KeyError (")
    if disk == "free":
        assert said.count("\n") == 1
        assert said.endswith(f"; {logs[0]} has what a report needs\n")
    log = logs[0].read_text() if logs else said
    assert "rrr-oc calibrate 'my set'" in log
    assert "Traceback (most recent call last)" in log
    assert f"numpy {np.__version__}" in log


def test_progress_on_a_terminal_takes_names_literally():
    file, output = io.StringIO(), Output()
    output.__dict__["_beside"] = PlainConsole(
        file=file, force_terminal=True, width=200, markup=False
    )  # where a terminal would be
    with output.steps(HOSTILE) as step:
        step(HOSTILE)
    with output.count(HOSTILE, 1) as count:
        count(1, HOSTILE)
    written = file.getvalue()
    assert SHOWN in written
    assert not set("\x9b\u202e") & set(written)
    assert "\x1b[31m\\u009b" not in written


def test_a_name_that_no_file_can_have_is_refused(tmp_path):
    """Wherever a path is looked at first; with a null byte the system is not asked, and Python's error is another one."""
    path = tmp_path / "a\0b"
    for use in (check_file, check_folder, lambda at: check_apart([], [at]), lambda at: check_apart([at], [])):
        with pytest.raises(UserError, match=r"is no name of a file|cannot be written"):
            use(path)
    for read in (read_regular, load_model, read_table, load_priors, load_robot, load_recordings):
        with pytest.raises(UserError):
            read(path)


def test_links_in_a_circle_are_refused(recordings, tmp_path):
    """Before a computation as well as after it, at the name itself and behind it; Python's own error depends on its version."""
    (tmp_path / "circle").symlink_to("circle")
    said = "is, or lies behind, a link that leads in a circle"
    for path in (tmp_path / "circle", tmp_path / "circle" / "model.json"):
        for use in (check_file, check_folder, lambda at: check_apart([], [at]), lambda at: check_apart([at], [])):
            with pytest.raises(UserError, match=said):
                use(path)
        for read in (read_regular, load_model, read_table, load_priors, load_robot, load_recordings):
            with pytest.raises(UserError):
                read(path)
        for write in (lambda at: new_files(at, []), new_folder):
            with pytest.raises(UserError, match="cannot be written"), write(path):
                pass
    save_recordings(recordings, tmp_path / "set")
    (tmp_path / "set" / "0.csv").unlink()
    (tmp_path / "set" / "0.csv").symlink_to("0.csv")
    with pytest.raises(UserError, match=rf"0\.csv: {said}"):
        load_recordings(tmp_path / "set")


def test_a_link_to_nothing_is_no_folder(tmp_path):
    (tmp_path / "link").symlink_to("nothing")
    with pytest.raises(UserError, match=r"link: is a link to nothing; a folder is required"):
        check_folder(tmp_path / "link")
    check_file(tmp_path / "link")  # a file takes its place


@pytest.mark.parametrize("make", [os.mkfifo, lambda path: path.symlink_to("/dev/null")])
def test_only_files_are_read_and_replaced(tmp_path, make):
    """A pipe would be waited for, /dev/zero has no end, and a device that is replaced is gone."""
    path = tmp_path / "thing"
    make(path)
    for use in (check_file, read_table, read_regular, load_model, load_robot, load_priors, lambda at: write_text(at, "")):
        with pytest.raises(UserError, match=r"thing: is (no regular file|a device or a pipe)"):
            use(path)
    assert not path.is_file()


def test_a_file_too_large_is_not_read(tmp_path, monkeypatch):
    (tmp_path / "a").write_text("abc")
    monkeypatch.setattr(storage, "LARGEST", 2)
    with pytest.raises(UserError, match=r"a: has 0\.0 GB; files up to 2e-09 GB are read"):
        read_regular(tmp_path / "a")


READERS = {
    "actuators": lambda path: load_actuators(["joint1"], str(path)),
    "task": load_task,
    "catalogue": load_catalogue,
    "model": load_model,
    "header": load_recordings,
    "summary": lambda path: saved_springs(path, "PEA", load_task("paper")),
    "priors": load_priors,
    "table": lambda path: load_recordings(path.with_name("header.json")),
    "urdf": load_robot,
    "npz": read_npz,
}
BROKEN = {
    "blank": b"\n \x01",
    "latin-1": '{"für": 1}'.encode("latin-1"),
    "utf-16": '{"a": 1}'.encode("utf-16"),
    "utf-16 without a mark": '{"a": 1}'.encode("utf-16-le"),
    "surrogate in a text": b'{"a": ["\\udfff"]}',
    "nul": b"\0" * 100,
    "deep": b"[" * 100_000,
    "not so deep": b'{"a": ' * 400 + b"1" + b"}" * 400,
    "deep TOML": b"a = " + b"[" * 5000,
    "infinite": b'{"a": 1e400}',
    "large": b'{"a": 1' + b"0" * 400 + b"}",
    "larger": b'{"a": 1' + b"0" * 5000 + b"}",
    "large TOML": b"a = 1" + b"0" * 5000,
    "list": b"[]",
    "null": b"null",
    "surrogate": b'{"\\ud800": 1}',
    "zip": b"PK\x03\x04" + b"\0" * 40,
}


@pytest.mark.parametrize("reader", READERS)
def test_whatever_is_no_such_file_is_one_sentence(tmp_path, reader):
    header = {"format": "rrr_oc-recordings/1", "robot": "rrr", "joints": ["joint1", "joint2", "joint3"]}
    (tmp_path / "header.json").write_text(json.dumps(header | {"recordings": [{"file": "a.json"}]}))
    said = dict.fromkeys(BROKEN, "it was read")
    for broken, content in BROKEN.items():
        (tmp_path / "a.json").write_bytes(content)
        try:
            READERS[reader](tmp_path / "a.json")
        except UserError as error:
            said[broken] = "" if len(str(error)) < 700 else f"{len(str(error))} characters"
    assert {broken: what for broken, what in said.items() if what} == {}


def test_a_byte_order_mark_does_no_harm(tmp_path):
    (tmp_path / "a.json").write_bytes(b"\xef\xbb\xbf" + json.dumps({"j": DRIVE}).encode())
    assert load_actuators(["j"], str(tmp_path / "a.json")).c_1 == 0.1


def test_a_zip_bomb_is_not_unpacked(tmp_path, monkeypatch):
    write_npz(tmp_path / "a.npz", {"a": np.zeros(100_000)})
    assert read_npz(tmp_path / "a.npz")["a"].size == 100_000
    monkeypatch.setattr(storage, "LARGEST", 10_000)
    assert (tmp_path / "a.npz").stat().st_size < 10_000
    with pytest.raises(UserError, match=r"a\.npz: has 0\.0 GB when unpacked"):
        read_npz(tmp_path / "a.npz")


def test_files_that_belong_together_are_replaced_in_one_step(tmp_path, monkeypatch):
    """A process that is killed at any moment leaves the old ones, or new ones, never some of both."""

    def there():
        return {path.name: path.read_text() for path in tmp_path.iterdir() if path.is_file()}

    def write(text, *names):
        with new_files(tmp_path, ["model.json", "report.html", "*.png"]) as folder:
            for name in names:
                write_text(folder / name, text)
                if name == "wrong":
                    raise UserError("no")

    write_text(tmp_path / "kept.csv", "kept")
    write("old", "model.json", "report.html", "a.png")
    with pytest.raises(UserError, match="no"):
        write("new", "model.json", "wrong")
    assert there() == {"kept.csv": "kept", "model.json": "old", "report.html": "old", "a.png": "old"}
    calls, replace = [], os.replace
    monkeypatch.setattr(storage.os, "replace", lambda *ends: calls.append(ends) or replace(*ends))
    write("new", "model.json", "b.png")
    assert there() == {"kept.csv": "kept", "model.json": "new", "b.png": "new"}
    count = len(calls)
    for end in range(count):  # killed before each of the renamings
        monkeypatch.setattr(storage.os, "replace", replace)
        write("old", "model.json", "report.html", "a.png")
        left = iter(range(end))

        def killed(*ends, left=left):
            if next(left, None) is None:
                raise KeyboardInterrupt
            replace(*ends)

        monkeypatch.setattr(storage.os, "replace", killed)
        with pytest.raises(KeyboardInterrupt):
            write("new", "model.json", "b.png")
        assert len({text for name, text in there().items() if name != "kept.csv"}) <= 1


def test_what_a_killed_process_left_is_removed(tmp_path):
    stale, used, folder = (tmp_path / f".{name}.0123abcd.rrr_oc" for name in ("stale", "used", "folder"))
    folder.mkdir()
    for path in (stale, used, folder / "inside", tmp_path / ".other.0123abcd.tmp"):
        path.touch()
    with used.open() as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        check_folder(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {used.name, ".other.0123abcd.tmp"}


def test_a_temporary_file_that_another_process_removes_before_it_is_locked_is_made_again(tmp_path, monkeypatch):
    made = []

    new = storage.NEW

    def taken(path):
        new(path)
        made.append(path)
        if len(made) == 1:
            path.unlink()

    monkeypatch.setattr(storage, "NEW", taken)
    write_text(tmp_path / "a", "a")
    assert len(made) == 2
    assert [path.name for path in tmp_path.iterdir()] == ["a"]


def test_a_file_is_on_the_disk_before_it_has_its_name(tmp_path, monkeypatch):
    done, real = [], {name: getattr(os, name) for name in ("fsync", "replace")}
    for name, function in real.items():
        monkeypatch.setattr(storage.os, name, lambda *a, name=name, function=function: (done.append(name), function(*a)))
    write_text(tmp_path / "a", "a")
    assert done == ["fsync", "replace", "fsync"]


def test_results_of_other_code_are_not_taken(tmp_path):
    for asked, code in (({"a": 1}, "old"), ({"a": 2}, "new")):
        Run(tmp_path, asked, code).save({"x": np.ones(1)})
        assert Run(tmp_path, {"a": 1}, "new").saved() is None
        Run(tmp_path, asked, code).finish({"E1": 1.0}, {})
        assert Run(tmp_path, {"a": 1}, "new").found is None
        assert Run(tmp_path, asked, code).found == {"E1": 1.0}
    assert Run(tmp_path, {}).code.startswith(storage.code())


@pytest.mark.parametrize("harm", ["settings", "code", "input", "new input", "result", "second result", "mark"])
def test_what_is_made_once_is_made_again_when_anything_has_changed(tmp_path, monkeypatch, harm):
    files, inputs, calls = [tmp_path / "a.json", tmp_path / "b.csv"], tmp_path / "inputs", []
    inputs.mkdir()
    (inputs / "x").write_text("1")

    def make():
        calls.append(1)
        for file in files:
            file.write_text("made")

    for _ in range(2):
        Made(files, {"a": 1}, [inputs, Path("bundled")]).once(make)
    assert calls == [1]
    changed = {"input": inputs / "x", "new input": inputs / "y", "result": files[0], "second result": files[1]}
    if harm == "code":
        monkeypatch.setattr(storage, "code", lambda: "other")
    elif harm == "mark":
        (tmp_path / ".a.json.made").unlink()
    elif harm != "settings":
        changed[harm].write_text("mad")
    Made(files, {"a": 2 if harm == "settings" else 1}, [inputs, Path("bundled")]).once(make)
    assert calls == [1, 1]
    assert files[1].read_text() == "made"


def test_limits_of_the_arm_are_among_what_a_design_depends_on(tmp_path):
    """A task takes from the URDF what it does not say itself."""
    text = importlib.resources.files("rrr_oc.urdf").joinpath("rrr.urdf").read_text()
    task = json.loads(importlib.resources.files("rrr_oc.data").joinpath("paper.json").read_text())
    (tmp_path / "task.json").write_text(
        json.dumps(task | {"robot": "arm.urdf", "limits": {"joint3": {"range_deg": [-180, 0]}}})
    )
    asked = []
    for speed in ("", "", "9"):
        (tmp_path / "arm.urdf").write_text(re.sub(r'velocity="', f'velocity="{speed}', text))
        request = Request(str(tmp_path / "task.json"), tmp_path / "out", ("SA",))
        asked.append(json.dumps(plain(_asked(request, load_tasks(request.task)))))
    assert asked[0] == asked[1] != asked[2]
    assert "jobs" not in asked[0]


@pytest.mark.parametrize("harm", [None, b"{", b"[1]", b'{"asked": {}}', "result", "motion", "settings"])
def test_a_damaged_result_is_solved_again(tmp_path, harm):
    said = []
    study = SimpleNamespace(out=tmp_path, asked={"code": "1"}, listener=SimpleNamespace(note=said.append))

    def solve():
        write_npz(kept_motion(study, "SA"), {"x": np.ones(1)})
        return {"E1": 0.1 + len(said), "interrupted": False}

    first, saved = once(study, "SA", solve), tmp_path / ".SA.json"
    if harm == "result":
        saved.write_text(saved.read_text().replace("0.1", "0.2"))
    elif harm == "motion":
        kept_motion(study, "SA").write_bytes(kept_motion(study, "SA").read_bytes()[:-9])
    elif harm == "settings":
        study.asked = {"code": "2"}
    elif harm:
        saved.write_bytes(harm)
    found = once(study, "SA", solve)
    assert (found == first) == (harm is None)
    assert [line.split(" ")[1] for line in said] == {None: ["taken"], "settings": ["begun"]}.get(harm, ["what"])
    assert harm != "settings" or said[0].endswith("other settings: version of this program")


def test_what_is_read_is_not_written_over(tmp_path):
    (tmp_path / "link").symlink_to(tmp_path / "in", target_is_directory=True)
    read = [tmp_path / "in" / "model.json", tmp_path / "in" / "a.png"]
    check_apart(read, [tmp_path / "out" / "model.json", tmp_path / "in" / "b.png", tmp_path / "in" / "*.csv"])
    for written in ("in/model.json", "in/../in/model.json", "link/model.json", "in/*.png", "link/*.png"):
        with pytest.raises(UserError, match="is read by this command and would be overwritten"):
            check_apart(read, [Path(f"{tmp_path}/{written}")])
