"""`rrr-oc demo`: the way from recordings to springs in a minute or two, on an arm with hidden physics."""

import json
import shlex
import webbrowser
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any

import typer

from rrr_oc.commands.output import Output, Quiet, progress_alone
from rrr_oc.commands.shared import Jobs
from rrr_oc.commands.tour.truth import beside
from rrr_oc.errors import UserError, ends_at_once
from rrr_oc.schema import built, read_json
from rrr_oc.storage import check_folder, read_utf8, write_text

BUNDLED = files("rrr_oc.data") / "demo"
GIVEN = ("arm.urdf", "task.json", "recordings/recordings.json")  # what a user has of an arm; and the recordings
TRUTH = "truth.json"  # which nothing reads before the diagnosis is done
app = typer.Typer(add_completion=False)


@app.command()
def demo(
    out: Annotated[Path, typer.Option(help="folder to make; the same command goes on with one that it began")] = Path("demo"),
    jobs: Jobs = -1,
    page: Annotated[bool, typer.Option("--open/--no-open", help="open the diagnosis in the browser when it is written")] = True,
    quiet: Quiet = False,
) -> None:
    """Diagnose the recordings of an arm, open the truth about it, design a spring for it, and show that in motion: in a minute or two.

    The arm and its recordings come with this package. Every step is a command that works as well on an arm of yours.
    """
    output = Output(quiet)
    check_folder(out)
    _give(out)
    output.show(f"1  {out}: the URDF of an arm, 4 recordings of 12 s, and a task. Something about this URDF is wrong.")
    with ends_at_once():
        from rrr_oc.commands import run
    steps = _commands(out, jobs)
    _tell(output, 2, "Do signs, units or clocks of the recordings contradict the URDF?", steps["check"])
    run([*steps["check"], *["--quiet"] * quiet])
    _tell(output, 3, "Where does a calibrated model of this arm fail, and which physics would mend it?", steps["diagnose"])
    with progress_alone():
        run([*steps["diagnose"], *["--quiet"] * quiet])
    diagnosis = json.loads(read_utf8(out / "diagnosis" / "diagnosis.json"))
    _show_diagnosis(diagnosis, out, page, output)
    _show_truth(diagnosis, out, output)
    _tell(
        output, 5, "Which spring and motion lift 1 kg with the least torque, on the arm as it was found to be?", steps["design"]
    )
    with progress_alone():
        run([*steps["design"], *["--quiet"] * quiet])
    _show_design(out, output)
    _tell(output, 6, "What does that look like?", steps["animate"])
    with progress_alone():
        run([*steps["animate"], *["--quiet"] * quiet])
    output.show(f"   {out / 'design.gif'} shows it.\n")
    _show_next(out, output)


def _give(out: Path) -> None:
    """Write what a user has of an arm; raises `UserError` where a folder has something else in it."""
    recordings = [f"recordings/{path.name}" for path in (BUNDLED / "recordings").iterdir() if path.name.endswith(".csv")]
    texts = {name: (BUNDLED / name).read_text(encoding="utf-8") for name in (*GIVEN, *sorted(recordings))}
    if out.is_dir() and any(out.iterdir()):
        others = [n for n, text in texts.items() if not (out / n).is_file() or read_utf8(out / n).decode() != text]
        if others:
            raise UserError(f"{out}: has something other than a demo in it; give a new or an empty folder by --out")
    for name, text in texts.items():
        write_text(out / name, text)


def _commands(out: Path, jobs: int) -> dict[str, list[str]]:
    """What the steps run, by the name of the command."""
    recordings, task, diagnosis, design = (str(out / name) for name in ("recordings", "task.json", "diagnosis", "design"))
    together = [] if jobs == -1 else ["--jobs", str(jobs)]
    quick = shlex.split("--configurations SA,PEA --starts 2 --motions 0 --intervals 16 --tolerance 1e-3 --cycle-times none")
    model = ["--model", f"{diagnosis}/model.json", "--repaired"]
    return {
        "check": ["check", recordings],
        "diagnose": ["diagnose", recordings, "--out", diagnosis, *together],
        "design": ["design", task, *model, *quick, "--out", design, *together],
        "animate": ["animate", f"{design}/PEA.npz", "--task", task, "--out", str(out / "design.gif")],
    }


def _tell(output: Output, number: int, question: str, command: Sequence[str]) -> None:
    output.show(f"\n{number}  {question}\n   $ rrr-oc {shlex.join(command)}")


def _show_diagnosis(diagnosis: Mapping[str, Any], out: Path, page: bool, output: Output) -> None:
    from rrr_oc.diagnosis.diagnosis_file import DiagnosisFile
    from rrr_oc.report import diagnosis_words as told

    found = built(diagnosis, DiagnosisFile)
    output.show(f"   {told.sentence(found)}")
    for line in [*map(told.plain, told.missing(found)), *told.off_links(found.link_findings)]:
        output.show(f"   {line}")
    report = (out / "diagnosis" / "report.html").absolute()
    opened = page and webbrowser.open(report.as_uri())
    output.show(f"   {out / 'diagnosis' / 'report.html'} is the report{', and opens in your browser' * opened}.")


def _show_truth(diagnosis: Mapping[str, Any], out: Path, output: Output) -> None:
    """Open the truth, and put it beside the claims."""
    text = (BUNDLED / TRUTH).read_text(encoding="utf-8")
    write_text(out / TRUTH, text)
    output.show(f"\n4  What was hidden in the arm? No step before this one has read it; now it is {out / TRUTH}.")
    header = ["hidden", "quantity", "true", "found", "95 % interval", "holds the truth"]
    output.table(header, beside(json.loads(text), diagnosis))


def _show_design(out: Path, output: Output) -> None:
    from rrr_oc.codesign.design_file import DesignFile
    from rrr_oc.report.design_words import verdict

    output.show(f"   {verdict(read_json(out / 'design' / 'summary.json', DesignFile))}")
    output.show(f"   {out / 'design' / 'report.html'} is the report.")


def _show_next(out: Path, output: Output) -> None:
    recordings, model = (shlex.quote(str(out / name)) for name in ("recordings", "diagnosis/model.json"))
    output.show(
        f"Go on with what {out} holds, as in\n"
        f"   $ rrr-oc export {model} --out {shlex.quote(str(out / 'mujoco'))}\n"
        f"   $ rrr-oc evaluate {model} {recordings} --simulate\n"
        "and with an arm of your own:\n"
        "   $ rrr-oc init arm.urdf --out arm"
    )
