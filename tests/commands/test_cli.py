"""The command line: what it prints and writes, and that a mistake is one sentence, exit status 2 and no file."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import mujoco
import numpy as np
import pytest
from commands import heeds_ctrl_c
from commands import rrr_oc as run
from prototype import write_prototype
from recorded import Plant, as_set, real, record
from threadpoolctl import threadpool_info

from rrr_oc import __version__, cli
from rrr_oc.commands import COMMANDS, load
from rrr_oc.diagnosis import procedure
from rrr_oc.effects import CATALOGUE
from rrr_oc.errors import STATUSES
from rrr_oc.recordings import reader
from rrr_oc.recordings.writer import save_recordings

TRUTH = np.array([[5.2, 7.1, 3.3], [14.0, 21.0, 9.0], [0.31, 0.22, 0.12]])


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A folder with a recording set `set` and the model that the command made of it, `out/model.json`."""
    folder, plant, rng = tmp_path_factory.mktemp("cli"), Plant("rrr", *TRUTH), np.random.default_rng(0)
    save_recordings(as_set(plant, [record(plant, f"{i}.csv", rng, 6.0) for i in range(2)]), folder / "set")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["rrr-oc", "calibrate", str(folder / "set"), "--out", str(folder / "out")])
        with pytest.raises(SystemExit) as ended:
            cli.main()
    assert ended.value.code == 0
    return folder


def files(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_calibrate_writes_a_model(folder):
    content = json.loads((folder / "out" / "model.json").read_text())
    assert content["format"] == "rrr_oc-model/1"
    found = [(p["value"], p["unit"]) for e in content["effects"] for p in e["parameters"].values()]
    np.testing.assert_allclose([x for x, unit in found if unit != "s"], TRUTH.T.ravel(), rtol=0.15)  # twelve seconds
    assert all(abs(x) < 2e-3 for x, unit in found if unit == "s")  # torques are not late
    assert {unit for _, unit in found} == {"Nm", "Nm s/rad", "kg m²", "s"}
    assert list((folder / "out").iterdir()) == [folder / "out" / "model.json"]


def test_evaluate_prints_json_alone(folder, monkeypatch, capsys):
    assert run(monkeypatch, "evaluate", folder / "out" / "model.json", folder / "set") == 0
    result = json.loads(capsys.readouterr().out)
    assert set(result) == {"inverse", "simulated", "mean"}
    assert set(result["inverse"]["0.csv"]["joint2"]) == {"nrmse", "rmse"}
    assert result["simulated"] == {}
    assert 0 < result["mean"]["inverse"]["joint1"]["nrmse"] < 0.03


def test_evaluate_writes_all_that_is_asked_for(folder, monkeypatch, tmp_path, capsys):
    arguments = ["--simulate", "--out", tmp_path / "deep" / "e.json", "--predictions", tmp_path / "p", "--window", "0.3"]
    assert run(monkeypatch, "evaluate", folder / "out" / "model.json", folder / "set", *arguments) == 0
    result = json.loads((tmp_path / "deep" / "e.json").read_text())
    assert set(result["simulated"]["1.csv"]["joint3"]) == {"q", "dq", "ddq", "tau_motor", "tau_load"}
    assert sorted(p.name for p in (tmp_path / "p").iterdir()) == ["0.csv", "1.csv"]
    rows = (tmp_path / "p" / "0.csv").read_text().splitlines()
    assert len(rows) == len((folder / "set" / "0.csv").read_text().splitlines())
    assert "mean NRMSE" in capsys.readouterr().out


def test_diagnose_takes_what_is_known_of_the_arm(folder, monkeypatch, tmp_path, capsys):
    (tmp_path / "known.toml").write_text('[context]\ninertias = "exact"\n[stribeck]\nprobability = 0.2\n')
    given, found = [], procedure.diagnose

    def noting(recordings, report, priors, kept):
        given.append((priors, {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}))
        return found(recordings, report, priors, kept)

    monkeypatch.setattr(procedure, "diagnose", noting)
    options = ["--no-simulate", "--jobs", "1", "--priors", tmp_path / "known.toml"]
    assert run(monkeypatch, "diagnose", folder / "set", "--out", tmp_path / "o", *options) == 0
    ((priors, threads),) = given
    assert priors.exact_inertias
    assert priors.given["stribeck"].probability == 0.2
    assert threads == {1}  # several would wait for each other
    printed = capsys.readouterr()
    assert "Nothing is missing: the calibrated model explains these recordings to their noise." in printed.out
    assert re.search(r"^ +\d+\.\d s  search \(\d+% done", printed.err, re.M), "progress where there is no terminal"
    assert "tracking the recordings" not in printed.err
    content = json.loads((tmp_path / "o" / "diagnosis.json").read_text())
    assert content["effects"] == content["unexplained"] == []
    assert "Nothing is missing" in (tmp_path / "o" / "report.html").read_text()


def commands_with_results(folder: Path, out: Path) -> dict[str, list]:
    """Arguments of commands whose results are also to be had as JSON, with a key of these."""
    return {
        "format": ["calibrate", folder / "set", "--out", out / "c"],
        "verdict": ["diagnose", folder / "set", "--out", out / "d", "--no-simulate", "--jobs", "1"],
        "mean": ["evaluate", folder / "out" / "model.json", folder / "set"],
        "effects": ["effects"],
        "recordings": ["import", "prototype", write_prototype(out / "raw", [3, 7]), out / "i"],
    }


@pytest.mark.parametrize("key", ["format", "verdict", "mean", "effects", "recordings"])
def test_results_are_to_be_had_as_json_alone_and_in_silence(key, folder, monkeypatch, tmp_path, capsys):
    for options in (["--json"], ["--quiet"], ["--quiet", "--json"]):
        out = tmp_path / "".join(options)
        out.mkdir()
        assert run(monkeypatch, *commands_with_results(folder, out)[key], *options) == 0
        printed = capsys.readouterr()
        if "--json" in options:
            assert json.loads(printed.out)[key]
        else:
            assert printed.out == ""
        assert "--quiet" not in options or printed.err == ""


def test_a_quiet_command_still_says_its_error(monkeypatch, tmp_path, capsys):
    assert run(monkeypatch, "calibrate", tmp_path / "nowhere", "--out", tmp_path / "o", "--quiet", "--json") == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.startswith("Error: ")


def test_the_catalogue_as_json_has_every_effect(monkeypatch, capsys):
    assert run(monkeypatch, "effects", "--json") == 0
    found = {e["effect"]: e for e in json.loads(capsys.readouterr().out)["effects"]}
    assert set(found) == set(CATALOGUE)
    for name, kind in CATALOGUE.items():
        assert found[name]["law"] == kind.equation
        if isinstance(kind.parameters, tuple):
            assert found[name]["parameters"] == [{"name": p.name, "unit": p.unit} for p in kind.parameters]


MISTAKES = {
    "no such set": (["calibrate", "{0}/nowhere", "--out", "{1}/o"], "nowhere"),
    "truncated header": (["calibrate", "{1}/truncated", "--out", "{1}/o"], "recordings.json"),
    "out is a file": (["calibrate", "{0}/set", "--out", "{0}/set/0.csv"], "0.csv"),
    "no such model": (["evaluate", "{0}/nowhere.json", "{0}/set"], "nowhere.json"),
    "no model": (["evaluate", "{0}/set/recordings.json", "{0}/set", "--predictions", "{1}/p"], "recordings.json"),
    "other torque": (["evaluate", "{0}/out/model.json", "{1}/load", "--predictions", "{1}/p"], "'load'"),
    "window": (["evaluate", "{0}/out/model.json", "{0}/set", "--window", "-1"], "--window is -1 s"),
    "window nan": (["evaluate", "{0}/out/model.json", "{0}/set", "--window", "nan"], "--window is nan s"),
    "column": (["calibrate", "{1}/column", "--out", "{1}/o"], "tau_joint2"),
    "folder taken": (["import", "prototype", "{1}/raw", "{0}/set"], "raw"),
    "no bag": (["import", "ros", "{1}/truncated/recordings.json", "--robot", "rrr", "--out", "{1}/m"], "bag"),
    "out under a file": (["calibrate", "{0}/set", "--out", "{0}/set/0.csv/o"], "cannot be written"),
    "diagnosis into a file": (["diagnose", "{0}/set", "--out", "{0}/set/0.csv"], "0.csv: is a file; a folder is required"),
    "no processes": (["diagnose", "{0}/set", "--out", "{1}/o", "--jobs", "0"], "--jobs is 0"),
    "too few processes": (["diagnose", "{0}/set", "--out", "{1}/o", "--jobs", "-5"], "--jobs is -5"),
    "no priors": (["diagnose", "{0}/set", "--out", "{1}/o", "--priors", "{1}/nowhere.toml"], "nowhere.toml"),
    "unknown effect": (["diagnose", "{0}/set", "--out", "{1}/o", "--priors", "{1}/unknown.toml"], "stribek"),
    "certain": (["diagnose", "{0}/set", "--out", "{1}/o", "--priors", "{1}/certain.toml"], "above 0 and below 1"),
    "no TOML": (["diagnose", "{0}/set", "--out", "{1}/o", "--priors", "{0}/set/0.csv"], "not valid TOML"),
    "evaluation into a folder": (
        ["evaluate", "{0}/out/model.json", "{0}/set", "--out", "{0}/set", "--predictions", "{1}/p"],
        "set: is a folder; the name of a file is required",
    ),
    "predictions into a file": (
        ["evaluate", "{0}/out/model.json", "{0}/set", "--out", "{1}/e.json", "--predictions", "{0}/set/0.csv"],
        "0.csv: is a file; a folder is required",
    ),
    "model over": (["evaluate", "{0}/out/model.json", "{0}/set", "--out", "{0}/out/model.json"], "would be overwritten"),
    "set over by a model": (
        ["calibrate", "{1}/named", "--out", "{1}/named"],
        "model.json: is read by this command and would be",
    ),
    "set over by a diagnosis": (["diagnose", "{1}/named", "--out", "{1}/named"], "model.json: is read by this command"),
    "header over": (["evaluate", "{0}/out/model.json", "{0}/set", "--out", "{0}/set/recordings.json"], "would be overwritten"),
    "predictions over": (
        ["evaluate", "{0}/out/model.json", "{0}/set", "--predictions", "{0}/out/../set"],
        "0.csv: is read by this command and would be overwritten",
    ),
    "absurd": (["calibrate", "{1}/absurd", "--out", "{1}/o"], "q_joint2 reaches"),
    "constant no number": (
        ["import", "ros", "{0}/x.mcap", "--robot", "rrr", "--out", "{1}/m", "--torque-constant", "a=nan"],
        "--torque-constant is 'a=nan'",
    ),
    "constants": (
        ["import", "ros", "{0}/x.mcap", "--robot", "rrr", "--out", "{1}/m", "--torque-constant", "a:3"],
        "--torque-constant is 'a:3'",
    ),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_one_sentence_and_leaves_no_file(mistake, folder, monkeypatch, tmp_path, capsys):
    text = (folder / "set" / "recordings.json").read_text()
    table, other = ((folder / "set" / file).read_text() for file in ("0.csv", "1.csv"))
    absurd = table.replace(table.splitlines()[9].split(",")[2], "1e200", 1)
    for name, header, rows in (
        ("truncated", text[: len(text) // 2], table),
        ("load", text.replace('"motor"', '"load"'), table),
        ("column", text, table.replace("tau_joint2", "tau_j2")),
        ("absurd", text, absurd),
    ):
        (tmp_path / name).mkdir()
        (tmp_path / name / "recordings.json").write_text(header)
        (tmp_path / name / "0.csv").write_text(rows)
        (tmp_path / name / "1.csv").write_text(other.replace("tau_joint2", "tau_j2") if name == "column" else other)
    (tmp_path / "named").mkdir()
    (tmp_path / "named" / "recordings.json").write_text(text.replace("0.csv", "model.json"))
    (tmp_path / "named" / "model.json").write_text(table)
    (tmp_path / "named" / "1.csv").write_text(other)
    (tmp_path / "unknown.toml").write_text("[stribek]\nprobability = 0.5\n")
    (tmp_path / "certain.toml").write_text("[stribeck]\nprobability = 1\n")
    arguments, said = MISTAKES[mistake]
    before = files(folder) | files(tmp_path)
    assert run(monkeypatch, *(a.format(folder, tmp_path) for a in arguments)) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.startswith("Error: ")
    assert printed.err.count("\n") == 1
    assert said in printed.err
    assert "Traceback" not in printed.err
    assert files(folder) | files(tmp_path) == before


def test_an_interrupt_is_one_word_and_leaves_no_file(folder, monkeypatch, tmp_path, capsys):
    def interrupted(_):
        raise KeyboardInterrupt

    monkeypatch.setattr(reader, "load_recordings", interrupted)
    assert run(monkeypatch, "calibrate", folder / "set", "--out", tmp_path / "o") == 130
    assert capsys.readouterr().err == "Interrupted.\n"
    assert not (tmp_path / "o").exists()


def test_a_place_that_cannot_be_written_is_told_before_the_work(folder, monkeypatch, tmp_path, capsys):
    """Not a question of rights: tests may run as root, whom the kernel lets write everywhere but into its own files."""
    monkeypatch.setattr(reader, "load_recordings", lambda _: pytest.fail("it began to work"))
    for arguments in (["calibrate", folder / "set", "--out"], ["diagnose", folder / "set", "--out"]):
        assert run(monkeypatch, *arguments, "/proc/results") == 2
        assert "/proc/results: cannot be written" in capsys.readouterr().err


def test_what_was_left_out_and_what_cannot_be_right_is_told(folder, monkeypatch, tmp_path, capsys):
    header = json.loads((folder / "set" / "recordings.json").read_text())
    rows = (folder / "set" / "0.csv").read_text().splitlines()
    cells = [row.split(",") for row in rows]
    turned = [",".join(cells[0] + ["vel_joint1"])]
    places = [k for k, name in enumerate(cells[0]) if name.startswith("tau_")]
    for i, row in enumerate(cells[1:]):
        changed = [str(-float(x)) if k in places else x for k, x in enumerate(row)]
        turned.append(",".join(["nan" if 100 <= i < 150 and k == 1 else x for k, x in enumerate(changed)] + ["0"]))
    (tmp_path / "recordings.json").write_text(json.dumps(header | {"recordings": [{"file": "0.csv", "payload": 1.0}]}))
    (tmp_path / "0.csv").write_text("\n".join(turned))
    assert run(monkeypatch, "calibrate", tmp_path, "--out", tmp_path / "out [/x]") == 0
    printed = capsys.readouterr()
    assert "0.csv: 50 of 600 rows are left out" in printed.err
    assert "0.csv: column vel_joint1 mean nothing here" in printed.err
    assert "the torque of joint2 is explained no better than by a constant" in printed.err
    assert "if they are right, the arm has physics that this model lacks, and rrr-oc diagnose" in printed.err
    assert "out [/x]" in printed.out


def test_export_writes_both_files(folder, monkeypatch, tmp_path, capsys):
    assert run(monkeypatch, "export", folder / "out" / "model.json", "--out", tmp_path / "e", "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert found["not_in_mjcf"] == []
    assert {Path(found[k]).name for k in ("mjcf", "urdf")} == {"arm.xml", "arm.urdf"}
    joints = mujoco.MjModel.from_xml_path(found["mjcf"])
    np.testing.assert_allclose(joints.dof_frictionloss, TRUTH[0], rtol=0.15)


def test_help_keeps_its_units(monkeypatch, capsys):
    assert run(monkeypatch, "evaluate", "--help") == 0
    assert "[s]" in capsys.readouterr().out


def test_unknown_options_and_commands_end_with_status_2(monkeypatch, capsys):
    for arguments in (["calibrate"], ["fly"], ["calibrate", "x", "--out", "y", "--way", "magic"]):
        assert run(monkeypatch, *arguments) == 2
        assert "Traceback" not in capsys.readouterr().err


def test_a_real_set_passes_through_calibrate_and_evaluate(monkeypatch, tmp_path, capsys):
    dataset = real("xl330_pendulum")
    assert run(monkeypatch, "calibrate", dataset, "--out", tmp_path) == 0
    capsys.readouterr()
    assert run(monkeypatch, "evaluate", tmp_path / "model.json", dataset) == 0
    result = json.loads(capsys.readouterr().out)
    assert all(e["nrmse"] is not None and e["nrmse"] < 0.6 for e in result["mean"]["inverse"].values())


HEAVY = {"casadi", "matplotlib", "mujoco", "pinocchio", "scipy"}  # packages that take long to import
WITH_LISTS = {"design", "effects", "excite", "export", "import", "init"}  # commands whose options list what heavy modules know


def helped(*command: str) -> tuple[str, set[str]]:
    """The help of a command, and the names of all modules that it imports, in a process of its own."""
    code = f"import sys; sys.argv = {['rrr-oc', *command, '--help']}; from rrr_oc.cli import main\ntry: main()\nfinally: print(*sys.modules)"
    printed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    text, modules = printed.rstrip().rsplit("\n", 1)
    return text, set(modules.split())


def test_help_imports_nothing_heavy_and_names_every_command():
    """The modules that are imported are what decides how long the help takes, on any machine."""
    text, modules = helped()
    assert "typer" in modules
    assert not modules & (HEAVY | {"numpy", "joblib", "msgspec"})
    assert not [name for name in modules if name.startswith("rrr_oc.commands.")]
    assert all(f" {name} " in text for name in COMMANDS)
    assert all(str(status) in text for status in STATUSES)


@pytest.mark.parametrize("name", sorted(set(COMMANDS) - WITH_LISTS))
def test_help_of_a_command_imports_nothing_heavy(name):
    text, modules = helped(name)
    assert "--quiet" in text
    assert not modules & (HEAVY | {"joblib"})


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_a_module_and_says_what_it_does(name):
    command = load(name)
    assert command.help
    assert COMMANDS[name][1].endswith(".")
    for part in getattr(command, "commands", {"": command}).values():
        assert not [p.name for p in part.params if p.name != "help" and not p.help], "every option is explained"


def test_the_module_is_the_command():
    run = subprocess.run([sys.executable, "-m", "rrr_oc", "--version"], capture_output=True, text=True, check=True)
    assert run.stdout == f"{__version__}\n"


@pytest.mark.parametrize("after", [0.0, 0.15, 0.4, 0.8])
def test_an_early_interrupt_is_one_line(after, tmp_path):
    """Ctrl-C at any time from the command's first line on, mostly while modules are imported: whole seconds, on a busy machine."""
    code = "import os; from rrr_oc.cli import main; os.write(1, b'.'); main()"
    command = [sys.executable, "-c", code, "calibrate", str(real("xl330_pendulum")), "--out", str(tmp_path / "o")]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True, preexec_fn=heeds_ctrl_c) as process:
        os.read(process.stdout.fileno(), 1)
        time.sleep(0.02 + after)
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=60)
    assert said.strip() == "Interrupted."
    assert process.returncode == 130
    assert not (tmp_path / "o").exists()


@pytest.mark.parametrize(
    ("typed", "offered"),
    [
        (["d"], {"demo", "design", "diagnose"}),
        (["import", ""], {"prototype", "ros", "csv", "arrays", "lerobot"}),
        (["design", "--co"], {"--configurations", "--cost"}),
        (["diagnose", "somewhere"], set()),  # which leaves names of files to the shell
    ],
)
def test_the_shell_completes_commands_and_options(typed, offered):
    """As bash asks, with the script that --show-completion prints."""
    asked = {"_RRR_OC_COMPLETE": "complete_bash", "COMP_WORDS": " ".join(["rrr-oc", *typed]), "COMP_CWORD": str(len(typed))}
    start = "import sys; sys.argv[0] = 'rrr-oc'; from rrr_oc.cli import main; main()"
    done = subprocess.run([sys.executable, "-c", start], env={**os.environ, **asked}, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    assert set(done.stdout.split()) == offered


@pytest.mark.parametrize(
    ("command", "question"),
    [
        (["desing", "paper"], "No such command 'desing'. Did you mean 'design'?"),
        (["design", "papper", "--out", "x"], "Did you mean 'paper'?"),
        (["design", "paper", "--configurations", "SA,pea", "--out", "x"], "Did you mean 'PEA'?"),
        (["design", "paper", "--cost", "enrgy", "--out", "x"], "Did you mean 'energy'?"),
        (["design", "task.json", "--out", "x"], "Did you mean 'payload_kg'?"),
    ],
)
def test_wrong_names_are_answered_with_the_most_like(command, question, monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(tmp_path)
    Path("task.json").write_text('{"format": "rrr_oc-task/1", "paylod_kg": 2.0}')
    assert run(monkeypatch, *command) == 2
    assert question in " ".join(capsys.readouterr().err.replace("│", " ").split())


def test_a_name_that_is_like_none_gets_no_question(monkeypatch, capsys):
    assert run(monkeypatch, "fly") == 2
    assert "Did you mean" not in capsys.readouterr().err
