"""The main study as its users run it: what it leaves in its folder, and what it says to those who ask wrongly."""

import copy
import json
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import designs
import msgspec
import numpy as np
import pea_bpea as study
import pytest
from chains import arm, joint, link, robot
from commands import rrr_oc, run
from own_arm import OWN, PAPER, own_model, own_task, with_robot

from rrr_oc.calibration.model_file import load_model, save_model
from rrr_oc.codesign import study as steps
from rrr_oc.codesign.design_file import COMPARISON
from rrr_oc.codesign.springs import arrangements, saved_springs, spring_bounds
from rrr_oc.codesign.task import load_task
from rrr_oc.commands import design as design_command
from rrr_oc.commands.output import Output
from rrr_oc.errors import UserError
from rrr_oc.optimal_control.solver import SolverFailure
from rrr_oc.report import study_files
from rrr_oc.report.design_report import layers_table

ROOT = Path(__file__).resolve().parents[2]
STUDY = ROOT / "studies" / "pea_bpea.py"
TINY = [
    "--configurations",
    "SA,PEA",
    "--starts",
    "2",
    "--motions",
    "0",
    "--tolerance",
    "1e-3",
    "--catalogue",
    "none",
    "--jobs",
    "1",
]
CONTRACT = {"cost", "springs", "mounted", "parameters", "published_springs", "wall_s"}  # of a configuration
OF_MOTION = {"E1", "E1_joint", "rms", "peak", "durations", "certificate", "mujoco"}


@pytest.fixture(scope="module")
def out(tmp_path_factory) -> Path:
    """The folder of a tiny run, made by the command itself."""
    folder = tmp_path_factory.mktemp("study") / "results"
    done = subprocess.run(
        [sys.executable, str(STUDY), *TINY, "--out", str(folder)], capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    assert "Everything is in" in done.stdout
    return folder


@pytest.fixture(scope="module")
def summary(out) -> dict:
    return json.loads((out / "summary.json").read_text())


def motion(c: dict) -> dict:
    """The entry of the only task."""
    (found,) = c["tasks"].values()
    return found


@pytest.fixture(scope="module")
def motions(summary) -> dict:
    """The motion of each configuration."""
    return {name: motion(c) for name, c in summary["configurations"].items()}


def test_the_springs_of_a_summary_are_read_again(out, summary):
    found, task = summary["configurations"]["PEA"]["parameters"], load_task("paper")
    springs = saved_springs(out / "summary.json", "PEA", task)
    assert {task.model().label(effect): theta for effect, theta in springs.mounted} == found
    assert len(found) == 2
    assert saved_springs(out / "summary.json", "SA", task).mounted == springs.known == ()


def test_summary_holds_what_the_contract_says(summary, motions):
    assert set(summary["configurations"]) == {"SA", "PEA"}
    assert {"name", "tasks", "seed", "starts", "versions", "options"} <= set(summary)
    assert (summary["name"], summary["seed"], summary["starts"]) == ("paper", 0, 2)
    assert {"casadi", "pin", "mujoco", "numpy", "python"} <= set(summary["versions"])
    for name, found in motions.items():
        assert set(summary["configurations"][name]) >= CONTRACT
        assert set(found) >= OF_MOTION
        assert set(found["durations"]) == {"go", "return"}
        assert all(1 - 1e-6 <= t <= 5 + 1e-6 for t in found["durations"].values())
        for by_joint in (found["E1_joint"], found["rms"], found["peak"]):
            assert set(by_joint) == {"joint2", "joint3"}
        assert summary["configurations"][name]["wall_s"] > 0
        assert found["certificate"]["second_order"] in ("strict", "weak")
        assert {"primal", "dual", "complementarity", "active", "sensitivity", "mesh", "reintegration"} <= set(
            found["certificate"]
        )


def test_springs_are_listed_as_parts(out, summary):
    for name, found in summary["configurations"].items():
        labels = {part["label"] for part in found["parts"]}
        assert labels == {label for label in found["mounted"] if label not in found["tasks"]["paper"]["idle"]}, name
        for part in found["parts"]:
            assert part["energy_J"] == pytest.approx(part["load"] * part["greatest"] / 2)
    assert "## Springs to order" in (out / "report.md").read_text()


def test_springs_are_in_si_and_radians_and_within_bounds(summary):
    found = summary["configurations"]
    assert found["SA"]["springs"] == {}
    springs = found["PEA"]["springs"]
    assert set(springs) == {"k_p2", "q_eq2", "k_p3", "q_eq3"}
    bounds = {"k_p2": (0, 13.7052), "k_p3": (0, 1.32), "q_eq2": np.radians([-10, 140]), "q_eq3": np.radians([-140, 140])}
    for name, (low, high) in bounds.items():
        assert low - 1e-6 <= springs[name] <= high + 1e-6  # IPOPT's relaxation


def test_numbers_agree_with_known_ones(summary):
    """facts.md, section 4; a mesh tolerance of 1e-3 and two starts: SA's usual local optimum is 564.11."""
    found, motions = summary["configurations"], {name: motion(c) for name, c in summary["configurations"].items()}
    assert motions["SA"]["E1"] == pytest.approx(563.6, rel=2e-3)
    assert motions["PEA"]["E1"] == pytest.approx(66.75, rel=5e-3)
    assert found["PEA"]["published_springs"] == pytest.approx(84.9, rel=5e-3)
    assert found["SA"]["published_springs"] is None


@pytest.mark.parametrize("name", ["SA", "PEA"])
def test_motion_files_integrate_to_e1(out, motions, name):
    """Trapezoid phase by phase; time is the last axis."""
    found = motions[name]
    with np.load(out / f"{name}.npz") as file:
        m = {k: file[k] for k in file.files}
    assert set(m) >= {"t", "q", "dq", "ddq", "tau_load", "tau_spring", "phase", "payload"}
    samples = m["t"].size
    for key in ("q", "dq", "ddq", "tau_load", "tau_spring"):
        assert m[key].shape == (2, samples)
    assert m["phase"].shape == m["payload"].shape == (samples,)
    by_joint = np.zeros(2)
    for i, (duration, payload) in enumerate(zip(found["durations"].values(), (5.0, 0.0), strict=True)):
        k = m["phase"] == i
        assert np.all(np.diff(m["t"][k]) > 0)
        assert np.ptp(m["t"][k]) == pytest.approx(duration, rel=1e-9)
        assert np.all(m["payload"][k] == payload)
        by_joint += np.trapezoid(m["tau_load"][:, k] ** 2, m["t"][k], axis=-1)
        for rate, value in (("dq", "q"), ("ddq", "dq")):
            steps = np.diff(m["t"][k]) * (m[rate][:, k][:, 1:] + m[rate][:, k][:, :-1]) / 2
            drift = np.cumsum(steps, axis=-1) - (m[value][:, k][:, 1:] - m[value][:, k][:, :1])
            assert np.abs(drift).max() < 1e-2  # trapezoids over 20 ms while accelerations turn round by up to 6 rad/s²
    assert by_joint.sum() == pytest.approx(found["E1"], rel=1e-4)
    np.testing.assert_allclose(by_joint, list(found["E1_joint"].values()), rtol=1e-4)
    rms = np.sqrt(by_joint / sum(found["durations"].values()))
    np.testing.assert_allclose(rms, list(found["rms"].values()), rtol=1e-4)
    np.testing.assert_allclose(np.abs(m["tau_load"]).max(axis=1), list(found["peak"].values()), rtol=1e-9)


def test_the_engine_agrees(motions):
    for found in motions.values():
        assert found["mujoco"]["E1"] == pytest.approx(found["E1"], rel=1e-3)  # MuJoCo's steps of 1 to 2 ms
        assert set(found["mujoco"]["E1_joint"]) == {"joint2", "joint3"}
        assert found["mujoco"]["exact_springs"]["E1"] == pytest.approx(found["E1"], rel=2e-3)


def test_report_and_figures_are_there(out, summary):
    text = (out / "report.md").read_text()
    assert (out / "report.html").is_file()
    assert f"{summary['configurations']['PEA']['cost']:.3f}" in text
    figures = {"torques", "landscape", "trajectory_SA", "trajectory_PEA", "arm_SA", "arm_PEA", "cycle_times"}
    assert {f.stem for f in out.glob("*.png")} == figures
    assert all(f.read_bytes().startswith(b"\x89PNG") for f in out.glob("*.png"))
    assert not list(out.glob("*.tmp*"))


def test_designs_are_compared_at_equal_times_and_with_springs_that_balance(out, summary):
    found, text = summary["configurations"], (out / "report.md").read_text()
    stiff, sprung = (found[name]["at_cycle_times"] for name in ("SA", "PEA"))
    took = {name: sum(motion(c)["durations"].values()) for name, c in found.items()}
    assert [at["cycle_s"] for at in stiff] == [at["cycle_s"] for at in sprung] == sorted(took.values())
    own = {name: c["at_cycle_times"][sorted(took.values()).index(took[name])]["cost"] for name, c in found.items()}
    assert own == {name: c["cost"] for name, c in found.items()}
    for at, other in zip(sprung, stiff, strict=True):
        assert at["cost"] < at["balancing"] < other["cost"]  # springs at all, and better ones
    assert found["SA"]["balancing"] is None
    assert found["PEA"]["cost"] < found["PEA"]["balancing"]["cost"]
    assert set(found["PEA"]["balancing"]["springs"]) == set(found["PEA"]["springs"])
    assert "PEA, balanced at rest" in text
    assert "The parallel spring of joint2 acts where joint2 is below the angle at which it is unloaded; there it turns" in text


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ("0.5", "--cycle-times has 0.5 s; task 'paper' allows 2 … 10 s"),
        ("3,nan", "--cycle-times has nan s"),
        ("x", "numbers above 0"),
    ],
)
def test_wrong_cycle_times_are_told(tmp_path, monkeypatch, capsys, asked, message):
    assert rrr_oc(monkeypatch, "design", "paper", "--out", str(tmp_path), "--cycle-times", asked) == 2
    assert message in " ".join(capsys.readouterr().err.split())


def test_a_layer_whose_starts_all_failed_is_in_the_report():
    assert layers_table(designs.design(1.0, layers={"sobol": designs.layer()}))[1] == [["sobol", "2", "2", "7.2", "–", "–"]]


@pytest.mark.parametrize("step", ["write_text", "draw_all", "write_design_page"])
def test_a_summary_is_never_beside_the_report_of_another_run(out, tmp_path, monkeypatch, step):
    """Whatever ends the writing leaves the files of the run before, all of them."""
    folder = tmp_path / "results"
    shutil.copytree(out, folder)
    before = {path.name: path.read_bytes() for path in folder.iterdir()}

    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(study_files, step, interrupted)
    assert rrr_oc(monkeypatch, "design", "paper", *TINY, "--out", str(folder)) == 130
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


def visible(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir() if not path.name.startswith(".")}


def test_a_motion_is_never_beside_the_summary_of_another_run(out, tmp_path, monkeypatch):
    """A run of other settings that ends before it writes its results leaves those of the run before, motions included; when it is
    given again, it goes on, and nothing of the run before is left."""
    folder, other = tmp_path / "results", [*TINY, "--configurations", "SA", "--intervals", "8"]
    shutil.copytree(out, folder)
    (folder / "PEA_notes.csv").write_text("mine")
    before, write_study = visible(folder), design_command.write_study

    def killed(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(design_command, "write_study", killed)
    assert rrr_oc(monkeypatch, "design", "paper", *other, "--out", str(folder)) == 130
    assert visible(folder) == before
    monkeypatch.setattr(design_command, "write_study", write_study)
    monkeypatch.setattr(steps, "solve_multistart", lambda *a: pytest.fail("it was solved already"))
    assert rrr_oc(monkeypatch, "design", "paper", *other, "--out", str(folder)) == 0
    after = visible(folder)
    assert {name for name in after if "PEA" in name} == {"PEA_notes.csv"}
    with np.load(folder / "SA.npz") as m:
        integral = sum(np.trapezoid((m["tau_load"][:, k] ** 2).sum(0), m["t"][k]) for k in (m["phase"] == 0, m["phase"] == 1))
    found = motion(json.loads(after["summary.json"])["configurations"]["SA"])["E1"]
    assert integral == pytest.approx(found, rel=1e-4)  # trapezoids over 20 ms
    assert after["SA.npz"] != before["SA.npz"]


def test_repeating_the_command_takes_the_saved_results(out, summary, monkeypatch, capsys):
    assert run(study, monkeypatch, *TINY, "--out", str(out)) == 0
    told = capsys.readouterr().err
    assert all(f"{name}: taken from" in told.replace("\n", " ") for name in ("SA", "PEA"))
    again = json.loads((out / "summary.json").read_text())
    assert again["configurations"] == summary["configurations"]
    assert again["wall_s"] < summary["wall_s"] / 2


def task_file(folder: Path, name: str = "task.json", **changes) -> str:
    """The paper's task with changes as `outer__inner=value`."""
    content = copy.deepcopy(PAPER)
    for path, value in changes.items():
        *outer, last = path.split("__")
        place = content
        for key in outer:
            place = place[int(key) if isinstance(place, list) else key]
        place[last] = value
    (folder / name).write_text(json.dumps(content))
    return str(folder / name)


PRISMATIC, FLOATING = arm(3, {2: "prismatic"}), arm(3, {1: "floating"})
MASSLESS = robot(link("base", 0), link("l1"), link("l2", 0), joint("j1", "base", "l1"), joint("j2", "l1", "l2"))
TORQUE = {**PAPER["limits"]["joint2"], "torque_Nm": 5.0}
BAD = {
    "unknown preset": (lambda f: ["--preset", "nowhere"], "no task at 'nowhere'"),
    "missing URDF": (lambda f: ["--preset", task_file(f, robot="gone.urdf")], "no robot at 'gone.urdf'"),
    "unknown configuration": (lambda f: ["--configurations", "SA,XPEA"], "unknown configuration 'XPEA'"),
    "no configuration": (lambda f: ["--configurations", ","], "configuration"),
    "crossed bounds": (lambda f: ["--preset", task_file(f, limits__joint2__range_deg=[150, -10])], "are crossed: 150 … -10"),
    "crossed spring bounds": (
        lambda f: ["--configurations", "PEA", "--preset", task_file(f, springs__0__stiffness_Nm_per_rad=[5, 1])],
        "crossed: 5 … 1",
    ),
    "out of reach": (lambda f: ["--preset", task_file(f, release__position_m=[0.7, 0, 0.07])], "no nearer than 0.1000 m"),
    "too little time": (lambda f: ["--preset", task_file(f, duration_s=[0.2, 1.0])], "joint3 needs 1.11 s"),
    "too weak": (
        lambda f: ["--preset", task_file(f, limits__joint2=TORQUE)],
        "joint2 needs 10.34 Nm to hold 5 kg at the start",
    ),
    "prismatic": (lambda f: ["--preset", with_robot(f, PRISMATIC)], "joint 'j2' is prismatic; allowed are revolute"),
    "floating": (lambda f: ["--preset", with_robot(f, FLOATING)], "joint 'j1' is floating; allowed are revolute"),
    "massless": (lambda f: ["--preset", with_robot(f, MASSLESS)], "'l2', moved by joint 'j2', has no <inertial>"),
    "unknown cost": (lambda f: ["--cost", "beauty"], "unknown cost 'beauty'"),
    "energy without resistances": (lambda f: ["--cost", "energy"], "joint2, joint3"),
    "no actuators": (lambda f: ["--cost", "motor", "--actuators", "gone.json"], "no actuators at"),
    "no catalogue": (lambda f: ["--catalogue", "gone.json"], "no catalogue at 'gone.json'"),
    "no processes": (lambda f: ["--jobs", "0"], "jobs"),
}


@pytest.mark.parametrize(("arguments", "message"), BAD.values(), ids=BAD.keys())
def test_bad_input_is_one_sentence_and_status_2(monkeypatch, capsys, tmp_path, arguments, message):
    folder = tmp_path / "results"
    small = ["--configurations", "SA", "--starts", "2", "--catalogue", "none", "--jobs", "1", "--quiet", "--out", str(folder)]
    assert run(study, monkeypatch, *small, *arguments(tmp_path)) == 2
    told = capsys.readouterr().err.strip()
    assert told.startswith("Error: ")
    assert message in told
    assert len(told.splitlines()) == 1
    assert "Traceback" not in told
    assert not folder.exists()


def test_an_output_path_that_is_a_file_is_told_before_hours_of_solving(monkeypatch, capsys, tmp_path):
    (tmp_path / "results").write_text("mine")
    monkeypatch.setattr(steps, "solve_multistart", lambda *a: pytest.fail("it began to solve"))
    assert run(study, monkeypatch, *TINY, "--out", str(tmp_path / "results")) == 2
    assert "results" in capsys.readouterr().err
    assert (tmp_path / "results").read_text() == "mine"


@pytest.fixture(scope="module")
def own(tmp_path_factory) -> Path:
    """The folder of a study of an arm that is not the paper's, with a calibrated model of it and every other option at its default."""
    folder = tmp_path_factory.mktemp("own")
    preset = own_task(folder)
    with pytest.MonkeyPatch.context() as patch:
        assert run(study, patch, *OWN, "--preset", preset, "--model", own_model(folder), "--out", str(folder / "results")) == 0
    return folder


def test_another_arm_is_tracked_in_its_calibrated_model(own):
    """The bundled catalogue and drives are the prototype's: without others there are neither starred designs nor Eq. 10."""
    found = json.loads((own / "results" / "summary.json").read_text())["configurations"]
    assert list(found) == ["SA", "PEA"]
    for c in map(motion, found.values()):
        assert c["calibrated"]["engine"]["E1"] == pytest.approx(c["E1"], rel=0.01)  # viscous friction is no load torque
        assert c["calibrated"]["eq10"] is None
    assert "In the twin calibrated on recordings" in (own / "results" / "report.md").read_text()


def shop(folder: Path, **springs: list[float]) -> str:
    (folder / "shop.json").write_text(json.dumps({"format": "rrr_oc-catalogue/1", "parallel_springs_Nm_per_rad": springs}))
    return str(folder / "shop.json")


LATE = {
    "a catalogue without springs for the joint": (lambda f: ["--catalogue", shop(f, j3=[5.0])], "no parallel spring for j2"),
    "a catalogue of springs out of bounds": (lambda f: ["--catalogue", shop(f, j2=[50.0])], "no k_p of 0 … 20"),
    "drives of other joints": (lambda f: ["--actuators", "prototype"], "no joint 'j2'"),
    "a cost that needs drives": (lambda f: ["--cost", "motor"], "needs the actuators of j2"),
}


@pytest.mark.parametrize(("arguments", "message"), LATE.values(), ids=LATE.keys())
def test_what_can_be_checked_is_checked_before_the_first_solve(monkeypatch, capsys, tmp_path, arguments, message):
    monkeypatch.setattr(steps, "solve_multistart", lambda *a: pytest.fail("it began to solve"))
    assert (
        run(study, monkeypatch, *OWN, "--preset", own_task(tmp_path), *arguments(tmp_path), "--out", str(tmp_path / "x")) == 2
    )
    assert message in capsys.readouterr().err


def failing(error: BaseException):
    """A function that raises, whatever it is given."""

    def fail(*_, **__):
        raise error

    return fail


STEPS = {
    "the catalogue cannot be solved": ("search_catalogue", SolverFailure("lost", 0, 0.0, ""), 0),
    "the catalogue's search is interrupted": ("search_catalogue", KeyboardInterrupt(), 130),
    "the calibrated model cannot be tracked": ("describe_transfer", UserError("nothing is tracked"), 2),
}


@pytest.mark.parametrize(("step", "error", "status"), STEPS.values(), ids=STEPS.keys())
def test_a_finished_design_is_not_lost_to_a_later_step(monkeypatch, capsys, tmp_path, step, error, status):
    command = [*OWN, "--configurations", "PEA", "--preset", own_task(tmp_path), "--catalogue", shop(tmp_path, j2=[5.0, 8.0])]
    command += ["--model", own_model(tmp_path), "--out", str(tmp_path / "results")]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(steps, step, failing(error))
        assert run(study, patch, *command) == status
    first = json.loads((tmp_path / "results" / "summary.json").read_text())["configurations"]
    assert list(first) == ["PEA"]
    assert "PEA" in (tmp_path / "results" / "report.md").read_text()
    capsys.readouterr()
    assert run(study, monkeypatch, *command) == 0
    assert "PEA: taken from" in capsys.readouterr().err.replace("\n", " ")
    again = json.loads((tmp_path / "results" / "summary.json").read_text())["configurations"]
    assert list(again) == ["PEA", "PEA*"]
    assert again["PEA"]["cost"] == first["PEA"]["cost"]
    assert again["PEA*"]["springs"]["k_p2"] in (5.0, 8.0)


def test_ctrl_c_behind_the_search_keeps_the_design(tmp_path, monkeypatch, capsys):
    """It comes while the design is certified: that ends, the report says what is missing, and the same command goes on from there."""
    certify, command = steps.certify, ["paper", *TINY, "--configurations", "SA,PEA", "--out", str(tmp_path)]

    def interrupted(*arguments):
        signal.raise_signal(signal.SIGINT)
        return certify(*arguments)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(steps, "certify", interrupted)
        assert rrr_oc(patch, "design", *command) == 130
    found = json.loads((tmp_path / "summary.json").read_text())
    assert list(found["configurations"]) == ["SA"]
    assert found["unfinished"][0] == "PEA"
    assert "Unfinished: PEA" in (tmp_path / "report.md").read_text()
    capsys.readouterr()
    assert rrr_oc(monkeypatch, "design", *command) == 0
    assert "SA: taken from" in capsys.readouterr().err


def test_what_is_unfinished_is_what_was_asked_and_is_not_found(tmp_path):
    """Nothing is solved here: entries are made up."""
    request = steps.Request(own_task(tmp_path), tmp_path / "results", ("SA", "PEA"), catalogue=shop(tmp_path, j2=[5.0, 8.0]))
    asked, done = steps.prepared(request, None, Output(quiet=True)), designs.design(1.0)
    assert asked.unfinished({}) == ("SA", "PEA", "PEA*", COMPARISON)
    assert asked.unfinished({"SA": done, "PEA": designs.design(1.0, interrupted=True)}) == ("PEA", "PEA*", COMPARISON)
    assert asked.unfinished({"SA": done, "PEA": done, "PEA*": done}) == (COMPARISON,)
    assert asked.unfinished({"SA": done, "PEA": designs.design(1.0, not_bought="lost")}) == (COMPARISON,)
    alone = replace(asked, request=replace(request, cycle_times=()))
    assert alone.unfinished({"SA": done, "PEA": done, "PEA*": done}) == ()


WRONG_SIDE = {"effect": "parallel_spring", "joint": "j2", "stiffness_Nm_per_rad": [1, 20], "equilibrium_deg": [-180, -100]}


def idle_run(folder: Path, monkeypatch: pytest.MonkeyPatch, *arguments: str, **fixed: str) -> dict:
    preset = own_task(folder, springs=[WRONG_SIDE | fixed])
    assert run(study, monkeypatch, *OWN, *arguments, "--preset", preset, "--out", str(folder / "results")) == 0
    return json.loads((folder / "results" / "summary.json").read_text())["configurations"]


def test_a_spring_that_is_never_taut_is_said_and_its_motion_offered_to_the_stiff_arm(monkeypatch, tmp_path):
    """A spring that pulls below -100° and an arm that stays above -20°; the stiff arm's own search is made worse by 3 %."""
    described, calls = steps._described, []

    def worse(study, name, result, began):
        found = described(study, name, result, began)
        calls.append(name)
        return msgspec.structs.replace(found, cost=1.03 * found.cost) if calls == ["SA"] else found

    monkeypatch.setattr(steps, "_described", worse)
    found = idle_run(tmp_path, monkeypatch, active="below")
    assert motion(found["PEA"])["idle"] == {"parallel_spring[j2]": "never taut"}
    assert found["SA"]["cost"] == pytest.approx(found["PEA"]["cost"], rel=1e-3)  # without the offer, 3 % more
    text = (tmp_path / "results" / "report.md").read_text()
    assert "PEA: the parallel spring of j2 is never taut" in text
    assert "springs do nothing" in text


def test_a_spring_is_mounted_in_the_better_way_unless_the_task_says_how(monkeypatch, tmp_path):
    """With gravity turned round the arm must be held down, which a spring does that acts above its equilibrium."""
    spring = WRONG_SIDE | {"equilibrium_deg": [-140, 10], "stiffness_Nm_per_rad": [0, 20]}
    found = {}
    for name, fixed in (("open", {}), ("fixed", {"active": "below"})):
        preset = own_task(tmp_path, springs=[spring | fixed], gravity=[0, 0, 9.81])
        arguments = [*OWN, "--configurations", "PEA", "--preset", preset, "--out", str(tmp_path / name)]
        assert run(study, monkeypatch, *arguments) == 0
        found[name] = json.loads((tmp_path / name / "summary.json").read_text())["configurations"]["PEA"]
    assert found["open"]["mounted"] == {"parallel_spring[j2]": {"active": "above"}}
    assert motion(found["open"])["idle"] == {}
    assert found["fixed"]["mounted"] == {"parallel_spring[j2]": {"active": "below"}}
    assert found["open"]["cost"] < 0.5 * found["fixed"]["cost"]


def test_what_a_task_leaves_open_is_arranged_in_every_way():
    """Two sides for each parallel spring and four windings for a biarticular one; the bundled task names all of them."""
    task = load_task("paper")
    assert [len(arrangements(task, name)) for name in ("SA", "PEA", "PEA+BPEA")] == [1, 1, 1]
    keys = ("active", "winding")
    bare = replace(task, springs=tuple({k: v for k, v in spring.items() if k not in keys} for spring in task.springs))
    ways = arrangements(bare, "PEA+BPEA")
    assert len({tuple((s.effect.joints, *(getattr(s.effect, k) for k in s.effect.options)) for s in way) for way in ways}) == 16
    assert [s.effect for s in ways[0]] == [s.effect for s in spring_bounds(task, "PEA+BPEA")]


def test_another_arm_is_reported_by_its_own_names_and_without_the_papers_numbers(own):
    text = (own / "results" / "report.md").read_text()
    assert "k_p of j2 [Nm/rad]" in text
    papers = ("ours | paper", "\\|", "k_p2 [", "published springs", "Table 4")
    assert not [part for part in papers if part in text]


def test_the_papers_task_stands_beside_the_papers_numbers(out):
    text = (out / "report.md").read_text()
    assert all(part in text for part in ("ours | paper", "| 13.7039", "k_p2 [Nm/rad]", "published springs"))


def test_another_cost_is_headed_by_its_own_name_and_unit(monkeypatch, tmp_path):
    drive = {"torque_constant_Nm_per_A": 1.0, "c_0_A": 0.0, "viscous_A_s_per_rad": 0.1, "c_v2_A_s2_per_rad2": 0.0}
    drive |= {"c_1_A_per_Nm": 1.0, "c_12_A_per_Nm": 0.0, "inertia_A_s2_per_rad": 0.0, "resistance_Ohm": 1.0}
    (tmp_path / "drives.json").write_text(json.dumps({"j2": drive}))
    command = [*OWN, "--configurations", "SA", "--preset", own_task(tmp_path), "--actuators", str(tmp_path / "drives.json")]
    assert run(study, monkeypatch, *command, "--cost", "energy", "--out", str(tmp_path / "x")) == 0
    text, summary = ((tmp_path / "x" / name).read_text() for name in ("report.md", "summary.json"))
    assert "| energy [J] |" in text
    assert f"{json.loads(summary)['configurations']['SA']['cost']:.3f}" in text
    assert "of energy." in text  # the sensitivity
    assert "E1 = " not in text


def heavy_model(folder: Path) -> str:
    """A calibrated model of the own arm whose last link weighs half as much again."""
    own_model(folder)
    model = load_model(folder / "model.json")
    heavy = replace(model.robot, inertial=model.robot.inertial * np.array([1.0, 1.0, 1.5])[: model.robot.n])
    save_model(replace(model, robot=heavy), folder / "model.json")
    return str(folder / "model.json")


def test_a_design_for_the_repaired_arm_is_cheaper_on_it(monkeypatch, capsys, tmp_path):
    """Three commands from a model: the design as the URDF says and the one as the model says, each on both twins."""
    task, model, found = own_task(tmp_path), heavy_model(tmp_path), {}
    for name, repaired in (("nominal", []), ("repaired", ["--repaired"])):
        command = ["design", task, *OWN, "--configurations", "PEA", "--model", model, *repaired]
        assert rrr_oc(monkeypatch, *command, "--out", str(tmp_path / name), "--json") == 0
        summary = json.loads(capsys.readouterr().out)
        assert summary == json.loads((tmp_path / name / "summary.json").read_text())
        found[name] = motion(summary["configurations"]["PEA"])
    # what was planned is what the twin does only if the design knew the twin's masses; 1 % for the coarse mesh
    assert found["repaired"]["calibrated"]["engine"]["E1"] == pytest.approx(found["repaired"]["E1"], rel=0.01)
    assert found["nominal"]["calibrated"]["engine"]["E1"] > 1.1 * found["nominal"]["E1"]
    assert found["repaired"]["calibrated"]["engine"]["E1"] < 0.98 * found["nominal"]["calibrated"]["engine"]["E1"]
    # a model that leaves nothing open foresees one number, of either design what it costs on this arm; 1 % as above
    for one in found.values():
        assert one["foreseen"]["E1"] == pytest.approx([one["calibrated"]["engine"]["E1"]] * 2, rel=0.01)
    text = (tmp_path / "nominal" / "report.md").read_text()
    assert text.index("## What the recordings leave open") < text.index("## Certificates")


def test_the_study_is_the_command(out, summary, monkeypatch, capsys):
    """The results of the study are those that the command would take again."""
    assert rrr_oc(monkeypatch, "design", "paper", *TINY, "--out", str(out), "--quiet") == 0
    printed = capsys.readouterr()
    assert printed.out == printed.err == ""
    assert json.loads((out / "summary.json").read_text())["configurations"] == summary["configurations"]


def test_a_repaired_arm_needs_a_model(monkeypatch, capsys, tmp_path):
    assert rrr_oc(monkeypatch, "design", "paper", "--repaired", "--out", str(tmp_path / "x")) == 2
    assert (
        capsys.readouterr().err
        == "Error: --repaired needs --model, the file of the model that the designs are to be made for\n"
    )
    assert not (tmp_path / "x").exists()
