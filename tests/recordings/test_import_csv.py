"""CSV files in foreign columns and units: the same numbers again in SI units, and what is wrong with a wrong mapping."""

import sys
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
from recorded import real

from rrr_oc import cli
from rrr_oc.errors import UserError
from rrr_oc.recordings.importers import import_csv
from rrr_oc.recordings.importers.column_mapping import QUANTITIES, UNITS
from rrr_oc.recordings.reader import load_recordings

START = 1_700_000_000_000.0  # [ms] since 1970
T = 0.01 * np.arange(200)  # [s]
Q = np.array([0.5 * np.sin(2 * T), 1.0 + 0.4 * np.cos(3 * T), -0.3 * np.sin(4 * T)])  # [rad], (3, K)
DQ = np.array([np.cos(2 * T), -1.2 * np.sin(3 * T), -1.2 * np.cos(4 * T)])  # [rad/s]
TAU = np.array([2.0 + T, -1.0 + 0.1 * T, 0.5 * np.cos(T)])  # [Nm]
MAPPING = """
[columns]
t = { column = "stamp", unit = "ms" }
payload_kg = { column = "held", unit = "g" }
q_joint1 = { column = "p1", unit = "deg" }
q_joint2 = { column = "p2", unit = "deg", factor = -1, zero = 90 }
q_joint3 = { column = "p3", unit = "rev", factor = 0.01 }
dq_joint1 = { column = "v1", unit = "rpm" }
dq_joint2 = { column = "v2", unit = "°/s", factor = -1 }
dq_joint3 = { column = "v3", unit = "mrad/s" }
tau_joint1 = { column = "m1", unit = "Ncm" }
tau_joint2 = "m2"
tau_joint3 = { column = "m3", unit = "mNm" }
"""


def write(folder: Path, mapping: str = MAPPING) -> tuple[Path, Path]:
    """A file with a controller's columns, separated by semicolons, with one that nobody wants; and its mapping."""
    columns = {
        "stamp": START + 1e3 * T,
        "state": 7 + 0 * T,
        "p1": Q[0] * 180 / np.pi,
        "p2": 90 - Q[1] * 180 / np.pi,
        "p3": Q[2] / (2 * np.pi) * 100,  # of the motor, before a gear of 1:100
        "v1": DQ[0] * 30 / np.pi,
        "v2": -DQ[1] * 180 / np.pi,
        "v3": DQ[2] * 1e3,
        "m1": TAU[0] * 100,
        "m2": TAU[1],
        "m3": TAU[2] * 1e3,
        "held": 1500 + 0 * T,
    }
    rows = [";".join(map(repr, row)) for row in np.array(list(columns.values())).T.tolist()]
    (folder / "log.csv").write_text("\n".join([";".join(columns), *rows]) + "\n")
    (folder / "mapping.toml").write_text(mapping)
    return folder / "log.csv", folder / "mapping.toml"


def test_foreign_units_signs_zeros_and_ratios_become_si(tmp_path):
    file, mapping = write(tmp_path)
    import_csv([file], "rrr", tmp_path / "out", mapping)
    (found,) = load_recordings(tmp_path / "out").recordings
    np.testing.assert_allclose(found.t, T, atol=2e-7)  # stamps of 1.7e12 ms hold steps of 2.4e-4 ms
    for array, truth in ((found.q, Q), (found.dq, DQ), (found.tau, TAU), (found.payload, 1.5 + 0 * T)):
        np.testing.assert_allclose(array, truth, rtol=1e-13, atol=1e-13)
    assert not [name for name in found.computed if name.startswith("dq")]


def test_the_example_reads_currents_of_some_joints(tmp_path):
    columns = {"time_ms": 1e3 * T, "load_kg": 2 + 0 * T}
    for j, sign, zero in ((1, 1, 0), (2, -1, 90)):
        columns |= {
            f"pos{j}": zero + sign * np.degrees(Q[j - 1]),
            f"speed{j}": sign * DQ[j - 1] * 30 / np.pi,
            f"i{j}": sign * TAU[j - 1] / 5.5 * 1e3,
        }
    np.savetxt(tmp_path / "a.csv", np.array(list(columns.values())).T, "%.17g", ",", header=",".join(columns))
    found = import_csv(
        [tmp_path / "a.csv"], "rrr", tmp_path / "out", str(files("rrr_oc.data") / "examples" / "csv_mapping.toml")
    )
    assert (found.torque, found.joints) == ("current", ("joint1", "joint2"))
    np.testing.assert_allclose(found.recordings[0].q, Q[:2], rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(found.output_torque(found.recordings[0]), TAU[:2], rtol=1e-13)


def test_an_empty_cell_is_a_row_dropped_and_time_begins_at_the_first_stamp(tmp_path):
    file, mapping = write(tmp_path)
    lines = file.read_text().splitlines()
    lines[1] = ";" + lines[1].split(";", 1)[1]
    file.write_text("\n".join(lines))
    (found,) = import_csv([file], "rrr", tmp_path / "out", mapping).recordings
    assert (found.t[0], found.dropped, len(found.t)) == (0.0, 1, 199)


def test_every_quantity_begins_with_its_si_unit():
    assert {units[0] for units in map(list, UNITS.values())} == {"s", "rad", "rad/s", "rad/s²", "Nm", "A", "kg"}
    assert all(next(iter(units.values())) == 1.0 for units in UNITS.values())
    assert set(QUANTITIES.values()) == set(UNITS)


MISTAKES = {
    "column not there": (('"p1"', '"p9"'), "log.csv, line 1: no column 'p9', which {map} takes for 'q_joint1'; there are stamp, state, p1"),
    "unit not known": (('"Ncm"', '"Nfoo"'), "columns.tau_joint1.unit: unit 'Nfoo' is not known; units of torque are Nm, kNm, Ncm"),
    "unit of something else": (('"Ncm"', '"mA"'), "columns.tau_joint1.unit: 'mA' is a unit of current; units of torque are Nm"),
    "column of no set": (("q_joint1", "pos_joint1"), "columns: unknown column of a set 'pos_joint1'; allowed are t, q_joint1"),
    "column left out": (('tau_joint2 = "m2"', ""), "columns: 'tau_joint2' is missing; required are t, q_joint1"),
    "key not known": (("zero", "offset"), "columns.q_joint2: unknown key 'offset'; allowed are column, unit, factor, zero"),
    "factor 0": (("factor = -1,", "factor = 0,"), "columns.q_joint2.factor: found 0; a finite number other than 0 is required"),
    "zero not finite": (("zero = 90", "zero = nan"), "columns.q_joint2.zero: found nan; a finite number is required"),
    "constant not finite": (("[columns]", "torque_constant.joint1 = inf\n[columns]"), "torque_constant.joint1: found inf; a finite number"),
    "constant of no joint": (("[columns]", "torque_constant.elbow = 1\n[columns]"), "torque_constant: unknown joint 'elbow'; allowed"),
    "joint not there": (("\n[columns]", 'joints = ["elbow"]\n[columns]'), "elbow"),
    "kind of torque": (("\n[columns]", 'torque = "voltage"\n[columns]'), "torque: found 'voltage'; allowed are 'motor', 'load', 'current'"),
    "no constants": (("\n[columns]", 'torque = "current"\n[columns]'), "unknown column of a set 'tau_joint1'; allowed are t, q_joint1"),
    "no TOML": (("[columns]", "[columns"), "mapping.toml: not valid TOML"),
    "degrees taken for radians": (('"v2", unit = "°/s"', '"v2"'), "it looks as if 'dq_joint2' is in degrees"),
}  # fmt: skip


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_in_the_mapping_is_one_sentence(mistake, tmp_path):
    change, said = MISTAKES[mistake]
    assert change[0] in MAPPING
    file, mapping = write(tmp_path, MAPPING.replace(*change))
    with pytest.raises(UserError) as raised:
        import_csv([file], "rrr", tmp_path / "out", mapping)
    assert said.format(map=mapping) in str(raised.value)
    assert not (tmp_path / "out").exists()


def test_files_that_make_no_set_are_told(tmp_path):
    file, mapping = write(tmp_path)
    with pytest.raises(UserError, match="no CSV file given; at least one is required"):
        import_csv([], "rrr", tmp_path / "out", mapping)
    with pytest.raises(UserError, match=r"another file has the same name; .* it becomes 'log\.csv'"):
        import_csv([file, file], "rrr", tmp_path / "out", mapping)
    with pytest.raises(UserError, match=r"nowhere\.toml: cannot be read: No such file"):
        import_csv([file], "rrr", tmp_path / "out", tmp_path / "nowhere.toml")
    file.write_text(file.read_text().replace(";7.0;", ";on;").replace(repr(TAU[1].tolist()[3]), "x", 1))
    with pytest.raises(
        UserError, match="line 5, column 'm2': found 'x'; a number"
    ):  # text in a column that is not used is no matter
        import_csv([file], "rrr", tmp_path / "out", mapping)


def test_the_command_makes_a_set_or_says_what_is_wrong(monkeypatch, tmp_path, capsys):
    file, mapping = write(tmp_path)

    def run(*arguments) -> int:
        monkeypatch.setattr(sys, "argv", ["rrr-oc", "import", "csv", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            cli.main()
        return int(ended.value.code or 0)

    assert run(file, "--map", mapping, "--robot", "rrr", "--out", tmp_path / "out") == 0
    assert "log.csv" in capsys.readouterr().out
    assert len(load_recordings(tmp_path / "out").recordings) == 1
    assert run(file, "--map", mapping, "--robot", "rrr", "--out", tmp_path / "out") == 2
    assert "exists already; give a new or an empty folder" in capsys.readouterr().err
    assert run(file, "--robot", "rrr", "--out", tmp_path / "other") == 2
    assert "--map" in capsys.readouterr().err


SEPARATED = {
    "spaces": ("  ", "."),
    "one space": (" ", "."),
    "tabs": ("\t", "."),
    "bars": ("|", "."),
    "semicolons": (";", "."),
    "decimal commas": (";", ","),
    "decimal commas and tabs": ("\t", ","),
    "decimal commas and spaces": (" ", ","),
}


@pytest.mark.parametrize("name", SEPARATED)
def test_any_separator_and_decimal_commas_are_read(name, tmp_path):
    """The same file, also with a column of texts that have points, which nobody reads, and whole numbers in the first row."""
    separator, point = SEPARATED[name]
    file, mapping = write(tmp_path)
    header, first, *rows = [line.split(";") for line in file.read_text().splitlines()]
    first[3] = "12"
    plain = [[*header, "note"], *([*row, "v1.0"] for row in (first, *rows))]
    (tmp_path / "plain.csv").write_text("\n".join(",".join(row) for row in plain))
    lines = [plain[0], *([cell.replace(".", point) for cell in row[:-1]] + row[-1:] for row in plain[1:])]
    (tmp_path / "other.csv").write_text("\n".join(separator.join(line) for line in lines))
    one, other = import_csv([tmp_path / "plain.csv", tmp_path / "other.csv"], "rrr", tmp_path / "set", mapping).recordings
    for signal in ("t", "q", "dq", "tau", "payload"):
        np.testing.assert_array_equal(getattr(one, signal), getattr(other, signal))


def test_points_beside_decimal_commas_are_refused(tmp_path):
    """1.234,5 may be a thousand, and 0.5 beside 0,5 two programs."""
    file, mapping = write(tmp_path)
    text = file.read_text().splitlines()
    cells = text[7].split(";")
    cells[2] = cells[2].replace(".", ",")
    file.write_text("\n".join([*text[:7], ";".join(cells), *text[8:]]))
    with pytest.raises(UserError, match=r"line 8, column 'p1': found '.*,.*'; a number with a decimal point, or nan"):
        import_csv([file], "rrr", tmp_path / "set", mapping)


@pytest.mark.parametrize("name", ["space.csv", "comma.csv"])
def test_logs_that_were_refused_are_read(name, tmp_path):
    cases = real("").parent / "cases"
    if not (cases / name).is_file():
        pytest.skip(f"{cases / name} is not there")
    (recording,) = import_csv([cases / name], cases / "arm2.urdf", tmp_path / "set", cases / "map.toml").recordings
    assert recording.q[:, 0] == pytest.approx([-0.7827898, -0.4108157])
    assert recording.tau[:, 1] == pytest.approx([0.514212, -0.2782032])


def test_a_rate_takes_the_place_of_a_column_of_times(tmp_path):
    file, mapping = write(tmp_path, "rate_Hz = 100\n" + MAPPING.replace('t = { column = "stamp", unit = "ms" }\n', ""))
    (recording,) = import_csv([file], "rrr", tmp_path / "set", mapping).recordings
    np.testing.assert_allclose(recording.t, T, rtol=1e-15)
    np.testing.assert_allclose(recording.q, Q, rtol=1e-12)


RATES = {
    "rate_Hz = 0": "rate_Hz: found 0; a finite number above 0 is required",
    "rate_Hz = inf": "rate_Hz: found inf; a finite number is required",
    "rate_Hz = 100": "found both rate_Hz and a column for t; one of them",
}


@pytest.mark.parametrize("line", RATES)
def test_a_rate_that_cannot_be_is_refused(line, tmp_path):
    text = MAPPING if line.endswith("100") else MAPPING.replace('t = { column = "stamp", unit = "ms" }\n', "")
    file, mapping = write(tmp_path, f"{line}\n{text}")
    with pytest.raises(UserError, match=RATES[line]):
        import_csv([file], "rrr", tmp_path / "set", mapping)


def test_counts_of_a_drive_and_their_constant_make_torques(tmp_path):
    text = MAPPING.replace('tau_joint1 = { column = "m1", unit = "Ncm" }', 'current_joint1 = { column = "m1", unit = "raw" }')
    text = text.replace('tau_joint2 = "m2"', 'current_joint2 = { column = "m2", unit = "raw" }')
    text = text.replace('tau_joint3 = { column = "m3", unit = "mNm" }', 'current_joint3 = { column = "m3", unit = "mA" }')
    constants = "[torque_constant]\njoint1 = 0.01\njoint2 = 1.0\njoint3 = 1.0\n"
    file, mapping = write(tmp_path, f'torque = "current"\n{text}\n{constants}')
    made = import_csv([file], "rrr", tmp_path / "set", mapping)
    np.testing.assert_allclose(made.output_torque(made.recordings[0]), TAU, rtol=1e-12)


@pytest.mark.parametrize(("column", "name"), [("m2", "tau_joint2"), ("v3", "dq_joint3")])
def test_a_column_without_numbers_is_named_as_the_file_has_it(column, name, tmp_path):
    """As loggers write a signal that their robot does not report."""
    file, mapping = write(tmp_path)
    header, *rows = [line.split(";") for line in file.read_text().splitlines()]
    for row in rows:
        row[header.index(column)] = "nan"
    file.write_text("\n".join(";".join(row) for row in (header, *rows)))
    with pytest.raises(
        UserError, match=rf"log\.csv, line 1: column '{column}', which .*mapping\.toml takes for '{name}', holds no number"
    ):
        import_csv([file], "rrr", tmp_path / "set", mapping)


def test_dates_and_times_are_seconds(tmp_path):
    """In a log of one's own and in a set's own files; of any zone, with and without fractions."""
    log, mapping = write(tmp_path)
    rows = log.read_text().splitlines()
    stamps = [f"2026-03-29T01:59:{59 + t:06.3f}+01:00" if t < 0.995 else f"2026-03-29 01:00:{t - 1:06.3f}Z" for t in T]
    log.write_text("\n".join([rows[0], *(f"{at};{row.partition(';')[2]}" for at, row in zip(stamps, rows[1:], strict=True))]))
    mapping.write_text(MAPPING.replace('{ column = "stamp", unit = "ms" }', '"stamp"'))
    (found,) = import_csv([log], "rrr", tmp_path / "set", mapping).recordings
    np.testing.assert_allclose(found.t, T, atol=1e-6)
    np.testing.assert_allclose(found.q, Q, atol=1e-9)


COUNTS = np.round(400 * np.sin(3 * T))
BIT = np.where(COUNTS < 0, 1024 - COUNTS, COUNTS)  # the size, and bit 10 below 0
LOADS = """
torque = "current"
joints = ["joint1", "joint2"]
[torque_constant]
joint1 = 0.01
joint2 = 0.01
[columns]
t = "t"
q_joint1 = "a"
q_joint2 = "b"
current_joint1 = { column = "load1", unit = "raw", sign_bit = 10 }
current_joint2 = { column = "load2", unit = "raw", sign_bit = 10, factor = -1 }
"""


def loads(folder: Path, mapping: str, second: np.ndarray = BIT) -> np.ndarray:
    """Currents of two joints (2, K) as they are read."""
    table = np.array([T, *Q[:2], BIT, second]).T
    np.savetxt(folder / "log.csv", table, delimiter=",", header="t,a,b,load1,load2", comments="")
    (folder / "map.toml").write_text(mapping)
    (found,) = import_csv([folder / "log.csv"], "rrr", folder / "set", folder / "map.toml").recordings
    return found.tau


def test_counts_with_a_sign_bit_are_numbers_of_either_sign(tmp_path):
    np.testing.assert_array_equal(loads(tmp_path, LOADS), [COUNTS, -COUNTS])


@pytest.mark.parametrize(
    ("mapping", "second", "said"),
    [
        (LOADS.replace(", sign_bit = 10", ""), BIT, "column 'load1' has counts from 0 to 1424"),
        (LOADS, COUNTS, "column 'load2' has other cells than counts from 0 to 2047, of which bit 10 may be a sign"),
        (LOADS.replace("sign_bit = 10", "sign_bit = 40"), BIT, "sign_bit: found 40"),
    ],
    ids=["not said", "of both signs", "no bit"],
)
def test_counts_that_are_misunderstood_are_refused(tmp_path, mapping, second, said):
    with pytest.raises(UserError, match=said):
        loads(tmp_path, mapping, second)


def test_counts_are_read_as_they_are_where_that_is_said(tmp_path):
    np.testing.assert_array_equal(loads(tmp_path, LOADS.replace("sign_bit = 10", "sign_bit = 0")), [BIT, -BIT])
