"""Arrays of numpy and MATLAB: the numbers of CSV columns again, and what is wrong with a wrong file."""

import sys
from pathlib import Path

import numpy as np
import pytest
from scipy import io

from rrr_oc import cli
from rrr_oc.errors import UserError
from rrr_oc.recordings.importers import import_arrays

T = 0.01 * np.arange(200)  # [s]
Q = np.array([0.5 * np.sin(2 * T), 1.0 + 0.4 * np.cos(3 * T), -0.3 * np.sin(4 * T)])  # [rad], (3, K)
TAU = np.array([2.0 + T, -1.0 + 0.1 * T, 0.5 * np.cos(T)])  # [Nm]
COLUMNS = {
    "t": "time",
    **{f"q_joint{k + 1}": f"q.{k}" for k in range(3)},
    **{f"tau_joint{k + 1}": f"effort.{k}" for k in range(3)},
}


def mapping(folder: Path, columns=COLUMNS, head: str = "") -> Path:
    lines = [f'{name} = "{column}"' for name, column in columns.items()]
    (folder / "map.toml").write_text("\n".join([head, "[columns]", *lines]))
    return folder / "map.toml"


def check(made) -> None:
    (recording,) = made.recordings
    np.testing.assert_allclose(recording.t, T, atol=1e-15)
    np.testing.assert_array_equal(recording.q, Q)
    np.testing.assert_array_equal(recording.tau, TAU)


@pytest.mark.parametrize("turned", [False, True])
def test_tables_of_numpy_with_time_along_either_side(turned, tmp_path):
    arrays = {"time": T, "q": Q.T if turned else Q, "effort": TAU.T if turned else TAU, "name": np.array("arm")}
    np.savez(tmp_path / "a.npz", **arrays)
    check(import_arrays([tmp_path / "a.npz"], "rrr", tmp_path / "set", mapping(tmp_path)))


@pytest.mark.parametrize("compressed", [False, True])
def test_variables_of_matlab(compressed, tmp_path):
    """As MATLAB has them: vectors are tables of one row or column."""
    io.savemat(tmp_path / "a.mat", {"time": T[:, None], "q": Q, "effort": TAU.T, "text": "arm"}, do_compression=compressed)
    check(import_arrays([tmp_path / "a.mat"], "rrr", tmp_path / "set", mapping(tmp_path)))


def test_a_structure_of_matlab(tmp_path):
    io.savemat(tmp_path / "a.mat", {"log": {"time": T, "q": Q, "drive": {"effort": TAU}}})
    names = {"time": "log.time", "q": "log.q", "effort": "log.drive.effort"}
    columns = {k: names[c.split(".")[0]] + c[len(c.split(".")[0]) :] for k, c in COLUMNS.items()}
    check(import_arrays([tmp_path / "a.mat"], "rrr", tmp_path / "set", mapping(tmp_path, columns)))


def test_a_rate_in_place_of_times(tmp_path):
    np.savez(tmp_path / "a.npz", q=Q, effort=TAU)
    columns = {k: c for k, c in COLUMNS.items() if k != "t"}
    check(import_arrays([tmp_path / "a.npz"], "rrr", tmp_path / "set", mapping(tmp_path, columns, "rate_Hz = 100")))


def write_wrong(folder: Path, kind: str) -> Path:
    path = folder / f"a.{'mat' if kind in ('broken', 'new') else 'txt' if kind == 'text' else 'npz'}"
    if kind == "new":
        path.write_bytes(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM" + bytes(400))
    elif kind == "lengths":
        np.savez(path, time=T, q=Q, effort=TAU[:, :150])
    elif kind == "missing":
        np.savez(path, time=T, q=Q)
    elif kind == "objects":
        np.savez(path, time=T, q=np.array([{}, []], object), effort=TAU)
    else:
        path.write_bytes(b"nothing that anyone reads")
    return path


WRONG = {
    "new": "is a MAT file of version 7.3; save it with",
    "broken": "no readable MAT file",
    "text": "a file .npz or .mat is required",
    "zip": "no readable npz file",
    "objects": "no readable npz file",
    "lengths": "columns of one length are required; found time of 200, q.0 of 200, q.1 of 200, q.2 of 200, effort.0 of 150",
    "missing": "no column 'effort.0', which .*map.toml takes for 'tau_joint1'; there are time, q.0, q.1, q.2",
}


@pytest.mark.parametrize("kind", WRONG)
def test_a_wrong_file_is_one_sentence(kind, tmp_path):
    path = write_wrong(tmp_path, kind)
    with pytest.raises(UserError, match=WRONG[kind]):
        import_arrays([path], "rrr", tmp_path / "set", mapping(tmp_path))
    assert not (tmp_path / "set").exists()


def test_the_command(tmp_path, monkeypatch, capsys):
    np.savez(tmp_path / "a.npz", time=T, q=Q, effort=TAU)
    call = [
        "rrr-oc",
        "import",
        "arrays",
        tmp_path / "a.npz",
        "--map",
        mapping(tmp_path),
        "--robot",
        "rrr",
        "--out",
        tmp_path / "set",
    ]
    monkeypatch.setattr(sys, "argv", list(map(str, call)))
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert not ended.value.code
    assert "a.csv" in capsys.readouterr().out
