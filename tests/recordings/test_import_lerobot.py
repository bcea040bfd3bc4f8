"""Data sets of LeRobot as both versions lay them out: the same numbers again in SI units, and what is wrong with a wrong one."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from rrr_oc import cli
from rrr_oc.errors import UserError
from rrr_oc.recordings.importers import import_lerobot
from rrr_oc.recordings.reader import load_recordings

pa = pytest.importorskip("pyarrow")
parquet = pytest.importorskip("pyarrow.parquet")

RATE = 50  # [1/s]
JOINTS = ("joint1", "joint2", "joint3")
LENGTHS = (120, 90)
KINDS = (".pos", ".vel", ".torque")


def _episode(number: int) -> dict[str, np.ndarray]:
    """Positions [rad], speeds [rad/s] and torques [Nm] (3, K) by the ending of their names."""
    t, w = np.arange(LENGTHS[number]) / RATE, np.array([[1.0], [1.5], [2.0]])
    q = 0.3 * np.sin(w * t + number)
    return {"t": t, ".pos": q, ".vel": 0.3 * w * np.cos(w * t + number), ".torque": 2.0 * q + 1.0}


def _rows(number: int, kinds=KINDS) -> dict:
    """An episode as LeRobot stores it: 32 bits, positions in degrees, joint by joint."""
    e = _episode(number)
    degrees = {".pos": np.degrees(e[".pos"]), ".vel": np.degrees(e[".vel"]), ".torque": e[".torque"]}
    state = np.stack([degrees[kind][j] for j in range(3) for kind in kinds]).T
    count = len(e["t"])
    return {
        "action": pa.array(state[:, ::-1].tolist(), pa.list_(pa.float32())),
        "observation.state": pa.array(state.tolist(), pa.list_(pa.float32(), state.shape[1])),
        "timestamp": pa.array(e["t"], pa.float32()),
        "frame_index": pa.array(range(count), pa.int64()),
        "episode_index": pa.array([number] * count, pa.int64()),
    }


def write(folder: Path, version: str, kinds=KINDS, named=True) -> Path:
    """A data set of two episodes: one file each (2.1), or one for both whose rows are not in order (3.0)."""
    names = [f"{joint}{kind}" for joint in JOINTS for kind in kinds]
    numbers = {"dtype": "float32", "shape": [len(names)], "names": names if named else None}
    if version == "v2.1" and named:
        numbers = {**numbers, "names": {"motors": names}}
    single = {name: {"dtype": "int64", "shape": [1], "names": None} for name in ("frame_index", "episode_index")}
    features = {
        "action": numbers,
        "observation.state": numbers,
        "observation.images.top": {"dtype": "video", "shape": [480, 640, 3], "names": ["height", "width", "channels"]},
        "timestamp": {"dtype": "float32", "shape": [1], "names": None},
        **single,
    }
    (folder / "meta").mkdir(parents=True)
    info = {"codebase_version": version, "fps": RATE, "total_episodes": 2, "features": features}
    (folder / "meta" / "info.json").write_text(json.dumps(info))
    data = folder / "data" / "chunk-000"
    data.mkdir(parents=True)
    tables = [pa.table(_rows(number, kinds)) for number in range(2)]
    if version == "v2.1":
        for number, table in enumerate(tables):
            parquet.write_table(table, data / f"episode_{number:06d}.parquet")
    else:
        both = pa.concat_tables(tables[::-1])
        parquet.write_table(both.take(list(range(len(both)))[::-1]), data / "file-000.parquet")
    return folder


def _check(made) -> None:
    """The set against the motion it was made of; LeRobot keeps 32 bits, of angles up to 100°."""
    assert [r.file for r in made.recordings] == ["episode_000000.csv", "episode_000001.csv"]
    for number, r in enumerate(made.recordings):
        e = _episode(number)
        np.testing.assert_allclose(r.t, e["t"], atol=1e-6)
        for name, kind in (("q", ".pos"), ("dq", ".vel"), ("tau", ".torque")):
            np.testing.assert_allclose(getattr(r, name), e[kind], atol=1e-6)
        assert not any(name.startswith("dq_") for name in r.computed)


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_both_layouts_by_their_names(tmp_path, version):
    _check(import_lerobot(write(tmp_path / "data", version), "rrr", tmp_path / "set", unit="deg"))


def test_a_mapping_names_numbers_without_names(tmp_path):
    rows = [
        f'{column}_{joint} = {{ column = "observation.state.{3 * j + k}"{unit} }}'
        for j, joint in enumerate(JOINTS)
        for k, (column, unit) in enumerate((("q", ', unit = "deg"'), ("dq", ', unit = "deg/s"'), ("tau", "")))
    ]
    (tmp_path / "map.toml").write_text("\n".join(["[columns]", *rows]))
    _check(import_lerobot(write(tmp_path / "data", "v3.0", named=False), "rrr", tmp_path / "set", tmp_path / "map.toml"))


def test_by_the_command(tmp_path, monkeypatch, capsys):
    out = tmp_path / "set"
    arguments = [str(write(tmp_path / "data", "v3.0")), "--robot", "rrr", "--out", str(out), "--unit", "deg"]
    monkeypatch.setattr(sys, "argv", ["rrr-oc", "import", "lerobot", *arguments])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert not ended.value.code
    assert "episode_000001.csv" in capsys.readouterr().out
    assert (out / "recordings.json").is_file()


def _no_torque(folder: Path) -> dict:
    write(folder, "v2.1", kinds=(".pos", ".vel"))
    return {}


def _wrong_names(folder: Path) -> dict:
    write(folder, "v2.1", named=False)
    return {"mapping": None}


def _another_version(folder: Path) -> dict:
    write(folder, "v1.6")
    return {}


def _mapped(text: str):
    def make(folder: Path) -> dict:
        write(folder, "v3.0")
        (folder / "map.toml").write_text(text)
        return {"mapping": folder / "map.toml"}

    return make


def _pointer(folder: Path) -> dict:
    write(folder, "v3.0")
    (folder / "data/chunk-000/file-000.parquet").write_text("version https://git-lfs.github.com/spec/v1\n")
    return {}


ALL = "\n".join(f'{c}_{j} = "observation.state.{j}{k}"' for j in JOINTS for c, k in (("q", ".pos"), ("tau", ".torque")))
MISTAKES = {
    "no torque": (_no_torque, "no feature is named as torques or currents, without which an arm cannot be calibrated"),
    "no names": (_wrong_names, "--map says which column holds them if one does"),
    "version": (_another_version, "found 'v1.6'; versions 2 and 3 can be read"),
    "degrees as radians": (lambda folder: write(folder, "v3.0") and {"unit": "rad"}, "rad"),
    "unit": (lambda folder: write(folder, "v3.0") and {"unit": "m"}, "--unit"),
    "column": (
        _mapped("[columns]\n" + ALL.replace("joint2.torque", "elbow.torque")),
        "no column 'observation.state.elbow.torque'",
    ),
    "missing": (_mapped('[columns]\nq_joint1 = "observation.state.joint1.pos"\n'), "'q_joint2' is missing"),
    "key": (_mapped("[columns]\n" + ALL + '\nx = "action.0"\n'), "'x'"),
    "no parquet": (_pointer, "no readable Parquet file"),
    "nothing": (lambda folder: {}, "a folder with meta/info.json is required"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_one_sentence_and_leaves_no_set(tmp_path, mistake):
    make, said = MISTAKES[mistake]
    options = make(tmp_path / "data")
    with pytest.raises(UserError) as error:
        import_lerobot(tmp_path / "data", "rrr", tmp_path / "set", **{"unit": "deg", **options})
    assert said in str(error.value)
    assert "\n" not in str(error.value)
    assert not (tmp_path / "set").exists()


def test_joints_that_names_do_not_tell_are_named(tmp_path):
    folder = write(tmp_path / "data", "v3.0")
    info = folder / "meta/info.json"
    info.write_text(info.read_text().replace("joint2.pos", "elbow.pos"))
    with pytest.raises(UserError, match="is by its name the position of joint 'joint2'; --map says which it is"):
        import_lerobot(folder, "rrr", tmp_path / "set")


@pytest.mark.parametrize("effort", [".current", "_load"])
def test_currents_and_loads_with_a_constant_per_joint(effort, tmp_path, monkeypatch, capsys):
    """The torques of the other tests, taken for amperes or counts."""
    folder = write(tmp_path / "data", "v3.0")
    info = folder / "meta" / "info.json"
    info.write_text(info.read_text().replace(".torque", effort))
    call = ["rrr-oc", "import", "lerobot", str(folder), "--robot", "rrr", "--unit", "deg", "--out", str(tmp_path / "set")]
    for constants, status in ((None, 2), ("joint1=2,joint2=0.5", 2), ("joint1=2,joint2=0.5,joint3=-0.1", 0)):
        monkeypatch.setattr(sys, "argv", [*call, *([] if constants is None else ["--torque-constant", constants])])
        with pytest.raises(SystemExit) as ended:
            cli.main()
        assert (ended.value.code or 0) == status
        printed = capsys.readouterr().err
        if status:
            missing = "joint1, joint2, joint3" if constants is None else "joint3"
            assert f"--torque-constant JOINT=NUMBER is required for {missing}: Nm at the joint's output" in printed
    made = load_recordings(tmp_path / "set")
    for number, r in enumerate(made.recordings):
        expected = np.array([[2.0], [0.5], [-0.1]]) * _episode(number)[".torque"]
        np.testing.assert_allclose(made.output_torque(r), expected, atol=1e-6)


GAINS = ["--kp", "300", "--kd", "joint1=2,joint2=1,joint3=0"]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ([], "no feature is named as torques or currents"),
        (["--kp", "300"], "--kp is given and --kd is not; a loop that follows commands needs both"),
        (["--kp", "much", "--kd", "1"], "--kp is 'much'; a number, or JOINT=NUMBER, comma-separated, is required"),
        (["--kp", "300", "--kd", "wrist=2"], "kd: unknown joint 'wrist'"),
        (GAINS, None),
    ],
)
def test_commands_of_a_loop_with_gains(options, said, tmp_path, monkeypatch, capsys):
    """A data set of positions and commands alone: the frames' `action` holds the same names in the other order."""
    folder = write(tmp_path / "data", "v3.0", kinds=(".pos",))
    info = json.loads((folder / "meta" / "info.json").read_text())
    info["features"]["action"]["names"] = [f"{joint}.pos" for joint in reversed(JOINTS)]
    (folder / "meta" / "info.json").write_text(json.dumps(info))
    for file in folder.glob("data/*/*.parquet"):  # commands 0.02 rad ahead
        table = parquet.read_table(file)
        ahead = [[x + float(np.degrees(0.02)) for x in row] for row in table["action"].to_pylist()]
        column = table.column_names.index("action")
        parquet.write_table(table.set_column(column, "action", pa.array(ahead, pa.list_(pa.float32()))), file)
    call = ["rrr-oc", "import", "lerobot", str(folder), "--robot", "rrr", "--unit", "deg", "--out", str(tmp_path / "set")]
    monkeypatch.setattr(sys, "argv", [*call, *options])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    printed = " ".join(capsys.readouterr().err.split())
    if said is not None:
        assert ended.value.code == 2
        assert said in printed
        return
    made = load_recordings(tmp_path / "set")
    assert made.torque == "command"
    for r in made.recordings:
        np.testing.assert_allclose(r.command - r.q, 0.02, atol=1e-6)
        expected = 300 * 0.02 - np.array([[2.0], [1.0], [0.0]]) * r.dq
        np.testing.assert_allclose(made.output_torque(r), expected, atol=1e-3)
