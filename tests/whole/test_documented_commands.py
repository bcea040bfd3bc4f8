"""Every command and every Python example of README and docs runs, with reduced options, or has a reason why it does not.

docs/start.md runs first, in its order, in a folder that holds nothing but the URDF and, later, recordings of a made-up arm. The other
pages go on in that folder, but README.md, which begins in an empty one (tests/whole/test_readme.py).
"""

import glob
import json
import re
import shlex
import shutil
import subprocess
import sys
from functools import reduce
from pathlib import Path

import mujoco
import numpy as np
import pytest
from bags import states, write_mcap
from doc_pages import CURRENT, ROOT, blocks, code
from prototype import JOINTS, write_prototype
from recorded import URDF, Plant, as_set, record

from rrr_oc import cli
from rrr_oc.commands import COMMANDS
from rrr_oc.recordings.recording import Recording
from rrr_oc.recordings.writer import save_recordings
from rrr_oc.schema import parsed
from rrr_oc.storage import write_csv

START = ROOT / "docs" / "start.md"
OWN_PATH = (START, ROOT / "README.md")
WORKED = ROOT / "docs" / "worked_example.md"
# Later pages use what earlier ones write
ORDER = (
    "worked_example.md",
    "recordings.md",
    "calibration.md",
    "diagnosis.md",
    "priors.md",
    "codesign.md",
    "export.md",
)
TRUTH = np.array([[5.2, 7.1, 3.3], [14.0, 21.0, 9.0], [0.31, 0.22, 0.12]])  # friction and armature of the made-up arm
# Options behind a documented command; of one that is given twice the last one counts
REDUCED = {
    "design": ["--configurations", "PEA", "--starts", "1", "--motions", "0", "--tolerance", "1e-2", "--jobs", "1"],
    "diagnose": ["--no-simulate", "--jobs", "1"],
    "excite": ["--starts", "1", "--harmonics", "4", "--duration", "8"],
    "stand_in_arm": ["--speeds", "1,0.7", "--joint", ""],  # hides a payload alone
}
STIFF = {**REDUCED, "design": [*REDUCED["design"], "--configurations", "SA"]}  # where nothing is made of the design
# Commands that are not run, by how they begin, with the reason and the test of the same code in a reduced form
NOT_RUN = {
    "make": ("it sets up an environment; .ci/run runs it", ".ci/run"),
    "pip install": ("it would change the environment of the tests", "pyproject.toml"),
    "pip download": ("it asks the network", "docs/worked_example.md"),
    "git clone": ("it asks the network", "docs/worked_example.md"),
    "python -m zipfile": ("it unpacks what is not there", "docs/worked_example.md"),
    "python -m http.server": ("it serves until it is stopped", "tests/test_docs.py"),
    "python -m mujoco.viewer": (
        "it opens a window; the model that it shows is loaded here",
        "tests/whole/test_documented_commands.py",
    ),
    "rrr-oc view": ("it serves until it is stopped", "tests/report/test_viewer.py"),
    "rrr-oc import arrays": ("needs arrays of one's own", "tests/recordings/test_import_arrays.py"),
    "rrr-oc import lerobot": ("needs a data set of LeRobot", "tests/recordings/test_import_lerobot.py"),
    "python -m pytest tests/benchmarks": ("benchmarks, for idle machines", "tests/benchmarks"),
    "validation/search_seeds.py": ("an hour", "tests/codesign/test_multistart.py"),
    "validation/other_arms.py": ("hours, and needs robot files of others", "tests/validation/test_other_arms.py"),
    "studies/pea_bpea.py": ("minutes", "tests/whole/test_study.py"),
    "studies/buildable_springs.py": ("half an hour", "tests/studies/test_buildable_springs.py"),
    "studies/natural_dynamics.py": ("an hour", "tests/whole/test_natural_dynamics_study.py"),
    "studies/calibration.py": ("needs the authors' recordings", "tests/whole/test_calibration_study.py"),
    "studies/concealed_physics.py": ("hours", "tests/whole/test_concealed_study.py"),
    "studies/prototype_recordings.py": (
        "needs the authors' recordings; the same as a part of real_arms",
        "studies/real_arms.py",
    ),
    "rrr-oc calibrate go2_legs": ("needs recordings of a real robot", "tests/recordings/test_commanded_angles.py"),
    "rrr-oc evaluate FL/model.json": ("needs recordings of a real robot", "tests/recordings/test_commanded_angles.py"),
    "studies/real_arms.py": ("needs recordings of real arms", "tests/whole/test_real_arms_study.py"),
    "studies/gradient_vs_evolution.py": ("minutes to hours", "tests/whole/test_comparison_study.py"),
    "studies/transfer.py": ("an hour", "tests/whole/test_transfer_study.py"),
    "validation/concealed/make_cases.py": ("minutes to hours", "tests/whole/test_concealed_study.py"),
    "validation/optimal_control.py": ("minutes", "tests/optimal_control/test_transcription.py"),
    "rrr-oc design studies/panda": ("minutes, and the URDF is on the network", "tests/codesign/test_spring_choice.py"),
    "rrr-oc design twelve_tasks": ("minutes", "tests/codesign/test_task_sets.py"),
    "validation/task_sets.py": ("minutes", "tests/codesign/test_task_sets.py"),
    "validation/scaling.py": ("minutes", "tests/benchmarks/bench_codesign.py"),
    "validation/analytic_vs_mujoco.py": ("minutes", "tests/simulation/test_tracking.py"),
    "validation/servo_plants.py": ("an hour", "tests/calibration/test_late_commands.py"),
    "validation/calibration_coverage.py": ("hours", "tests/calibration/test_calibration.py"),
    "validation/calibration_ways.py": ("minutes", "tests/calibration/test_calibration.py"),
    "validation/diagnosis_times.py": ("hours", "tests/validation/test_diagnosis_times.py"),
    "validation/kills.py": ("minutes", "tests/whole/test_study.py"),
    "validation/known_misses.py": ("half an hour", "tests/validation/test_known_misses.py"),
    "python docs/dependencies.py": ("it writes a page; a test compares that page", "tests/test_packaging.py"),
    "python -m docs.from_code": ("it writes into the pages; a test makes them elsewhere", "tests/whole/test_readme.py"),
    "python -m validation.demo": ("it writes into the package; a test compares", "tests/commands/test_demo.py"),
    "python -m validation.chains": ("minutes to hours", "tests/validation/test_chains.py"),
    "validation/peers/": ("hours, and needs other tools", "tests/validation/test_peers.py"),
    "validation/engine_plants.py": ("minutes to hours", "tests/diagnosis/test_dry_friction.py"),
    "validation/open_world.py": ("half an hour", "tests/validation/test_open_world.py"),
    "validation/hidden_springs.py": ("an hour", "tests/validation/test_hidden_springs.py"),
    "validation/every_arm.py": ("minutes, and needs robot files of others", "tests/validation/test_every_arm.py"),
    "validation/fuzz_inputs.py": ("an hour", "tests/validation/test_fuzz_inputs.py"),
    "validation/awkward_sets.py": ("an hour", "tests/validation/test_awkward_sets.py"),
}


def commands(text: str) -> list[str]:
    """Commands with their arguments, in the order of the page; a bare name such as `rrr-oc design` is none, nor is one with "…"."""
    beginning = r"(?:rrr-oc \w|(?:\.venv/bin/)?python -?\w|make \w|make$|pip (?:install|download)|git clone|(?:studies|validation)/[\w/]+\.py )"
    found = [command for command in code(text) if re.match(beginning, command) and not re.search(r"[A-Z]+ ?…|… |\[--", command)]
    return [
        c
        for c in dict.fromkeys(found)
        if not re.fullmatch(r"rrr-oc [\w-]+(?: (?:[a-z]+|--?\w+ FILE.*|.*[A-Z]{4,} --out DIR))?", c)
    ]


def plain(command: str) -> str:
    """Without the interpreter, where a script is named."""
    return re.sub(r"^(?:\.venv/bin/)?python (?=studies|validation)", "", command.removeprefix(".venv/bin/"))


def why_not(command: str) -> tuple[str, str] | None:
    return next((reason for begin, reason in NOT_RUN.items() if plain(command).startswith(begin)), None)


def run(command: str, monkeypatch: pytest.MonkeyPatch, reduced: dict[str, list[str]] = REDUCED) -> None:
    """Run a command of `rrr-oc` in the present folder, reduced, or a script."""
    if plain(command).startswith("studies/"):
        script, *rest = shlex.split(plain(command))
        subprocess.run([sys.executable, ROOT / script, *rest, *reduced.get(Path(script).stem, [])], check=True)
        return
    words = [name for word in shlex.split(command)[1:] for name in (sorted(glob.glob(word)) if "*" in word else [word])]
    monkeypatch.setattr(sys, "argv", ["rrr-oc", *words, *reduced.get(words[0], [])])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code in (0, None), command


def recorded(count: int, seconds: float, pea: dict | None = None) -> list[Recording]:
    """Recordings of a plain arm, or of one with a spring."""
    plant, rng = Plant("rrr", *TRUTH), np.random.default_rng(0)
    return [record(plant, f"{i}.csv", rng, seconds, pea=pea) for i in range(count)]


def columns(r: Recording) -> dict[str, np.ndarray]:
    return {"t": r.t} | {f"{kind}_{joint}": getattr(r, kind)[j] for j, joint in enumerate(JOINTS) for kind in ("q", "tau")}


@pytest.fixture(scope="module")
def started(tmp_path_factory) -> tuple[Path, list[str]]:
    """A folder with a URDF in which the commands of docs/start.md ran in their order, and these commands.

    Recordings come where the page says that they are put into the folder and listed. Nobody lists the spring at joint 2.
    """
    folder, done = tmp_path_factory.mktemp("pages"), []
    shutil.copy(URDF / "rrr.urdf", folder / "arm.urdf")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for command in commands(START.read_text()):
            if command.startswith("rrr-oc check"):
                header, every = Path("arm/recordings/recordings.json"), recorded(2, 5.0, {1: (9.0, 1.2)})
                for r in every:
                    write_csv(header.parent / r.file, columns(r))
                content = parsed(str(header), header.read_text()) | {"recordings": [{"file": r.file} for r in every]}
                header.write_text(json.dumps(content))
            if why_not(command) is None:
                run(command, patch)
                done.append(command)
            elif "mujoco.viewer" in command:
                assert mujoco.MjModel.from_xml_path(command.partition("--mjcf=")[2]).nv == 3
    return folder, done


def test_the_path_of_start(started):
    folder, done = started
    names = [command.split()[1] for command in done]
    assert names[:6] == ["init", "design", "animate", "excite", "check", "diagnose"]
    assert {"design", "export"} <= set(names[6:])
    found = json.loads((folder / "arm/diagnosis/diagnosis.json").read_text())["effects"]
    assert [(e["effect"], e["joint"]) for e in found] in ([("cable_harness", "joint2")], [("parallel_spring", "joint2")])
    assert json.loads((folder / "arm/redesign/summary.json").read_text())["configurations"]["PEA"]["cost"] > 0
    assert (folder / "arm/pea.gif").stat().st_size > 10_000


@pytest.fixture(scope="module")
def folder(started) -> Path:
    """The same folder, with what the other pages take for granted: a task, recordings in every layout, files about them."""
    folder, r = started[0], recorded(3, 4.0)
    task = (ROOT / "rrr_oc" / "data" / "paper.json").read_text()
    (folder / "task.json").write_text(task.replace('"robot": "rrr"', '"robot": "arm.urdf"'))
    tasks = {"format": "rrr_oc-tasks/1", "base": "task.json", "tasks": [{"name": "as it is"}, {"payload_kg": 2.0}]}
    (folder / "tasks.json").write_text(json.dumps(tasks))
    (folder / "mapping.toml").write_text("[columns]\n" + "".join(f'{name} = "{name}"\n' for name in columns(r[0])))
    for one in r[:2]:
        write_csv(folder / one.file, columns(one))
    save_recordings(as_set(Plant("rrr", *TRUTH), r[2:]), folder / "recordings" / "other")
    for layout in ("FOLDER", re.search(r"import prototype (elastic\S+)", WORKED.read_text())[1]):  # type: ignore[index]
        write_prototype(folder / layout, [3, 4], rows=400)
    renamed = zip(JOINTS, ("shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint"), strict=True)
    urdf = reduce(lambda text, names: text.replace(f'"{names[0]}"', f'"{names[1]}"'), renamed, (URDF / "rrr.urdf").read_text())
    (folder / "ur10.urdf").write_text(urdf)
    (folder / "priors.toml").write_text(dict(blocks((ROOT / "docs" / "priors.md").read_text()))["toml"])
    return folder


def pages() -> list[Path]:
    """All but those with a path of their own: docs/start.md, and README.md, which tests/whole/test_readme.py follows."""
    others = [page for page in (*CURRENT, *sorted((ROOT / "docs" / "reference").glob("*.md"))) if page not in OWN_PATH]
    return sorted(others, key=lambda page: ORDER.index(page.name) if page.name in ORDER else len(ORDER))


def test_the_commands_of_all_other_pages(monkeypatch, folder, started):
    """Each once, in the order in which one page builds upon another; those that stand in docs/start.md as well ran there."""
    monkeypatch.chdir(folder)
    done = list(started[1])
    for page in pages():
        for command in commands(page.read_text()):
            if why_not(command) is None and command not in done and "*.mcap" not in command:
                run(command, monkeypatch, REDUCED if page == WORKED else STIFF)
                done.append(command)
    assert {command.split()[1] for command in done} >= set(COMMANDS) - {"demo", "effects", "view"}


def test_the_command_for_bags(monkeypatch, tmp_path):
    """Two bags that a ROS 2 writer made."""
    monkeypatch.chdir(tmp_path)
    shutil.copy(URDF / "rrr.urdf", "arm.urdf")
    for name in ("a", "b"):
        write_mcap(tmp_path / f"{name}.mcap", states())
    (command,) = [c for page in pages() for c in commands(page.read_text()) if "*.mcap" in c]
    run(command, monkeypatch)
    assert len(list(tmp_path.glob("recordings/*/*.csv"))) == 2


def test_python_examples_run(monkeypatch, folder):
    """But those of docs/python.md, which go on from the demo: tests/whole/test_readme.py."""
    monkeypatch.chdir(folder)
    seen = 0
    for page in (page for page in CURRENT if page.name != "python.md"):
        for language, content in blocks(page.read_text()):
            if language == "python":
                exec(compile(content, str(page), "exec"), {"__name__": "__main__"})
                seen += 1
    assert seen >= 3


def test_what_is_not_run_has_a_reason_and_a_test():
    every = [command for page in (*OWN_PATH, *pages()) for command in commands(page.read_text())]
    runs = ("rrr-oc ", "studies/stand_in_arm.py ")
    skipped = {command for command in every if not plain(command).startswith(runs) or why_not(command)}
    assert not [command for command in skipped if why_not(command) is None]
    assert not [begin for begin in NOT_RUN if not any(plain(command).startswith(begin) for command in skipped)]
    for begin, (reason, where) in NOT_RUN.items():
        assert reason
        assert (ROOT / where).exists(), begin
        if begin.startswith("studies/"):
            assert Path(begin).stem in (ROOT / where).read_text(), f"{where} does not run {begin}"


def test_the_reader_of_commands():
    """The test's own tool."""
    names = "`rrr-oc` `rrr-oc design` `rrr-oc import csv` `rrr-oc diagnose --priors FILE` `make` `studies/x.py … --y`"
    text = f"{names}\n```\nrrr-oc init a --out b\n```\n"
    assert commands(text) == ["rrr-oc init a --out b", "make"]
    assert why_not(".venv/bin/python studies/transfer.py --arms a") == NOT_RUN["studies/transfer.py"]
    assert why_not("rrr-oc init a --out b") is None
