"""Does a command that is killed leave anything half-written, and does it go on to the same numbers?

    python validation/kills.py --kills 50 --others 16 --out results/kills

Each command begins in a folder that has the results of an earlier run with other settings, and is killed (SIGKILL): half of the times
at a random moment, half just before a random one of the changes that it makes to its folder (a file opened to be written, renamed or
removed). Then every file must be whole and of one run, old or new, as must all of them together. The command is given again: nothing
temporary may be left, and all numbers must be those, bit for bit, of a run that nobody disturbed.

The other disturbances come at a random change of the folder, too: Ctrl-C (which comes at random moments as well), a full disk, a
folder that must no longer be written. A file that is cut off is one of a finished run. These must end with a sentence, not with a fault
of the program; after Ctrl-C, results may be those that the run had by then. The last column says how much of the time that a
disturbed run had taken the next one did not need again (median). Linux only.
"""

import csv
import io
import json
import operator
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import matplotlib.image
import numpy as np
import typer
from rich.progress import track

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from rrr_oc.errors import entry_point
from rrr_oc.report.tables import markdown
from rrr_oc.storage import TEMPORARY, write_json, write_text
from validation.concealed.build import build
from validation.concealed.cases import Case, Concealed
from validation.concealed.write import write_case

ROOT = Path(__file__).resolve().parents[1]
KILLS = "killed at a moment", "killed at a change"
OTHERS = "Ctrl-C", "Ctrl-C at a moment", "disk full", "folder read-only", "file cut off"
AT_A_MOMENT = {KILLS[0]: signal.SIGKILL, OTHERS[1]: signal.SIGINT}
SENTENCE = {2, 130}  # exit statuses of a run that says why it ended
NO_RESULTS = ("wall_s", "seconds", "peak_MB")  # keys of JSON files
LONGEST = 600.0  # [s] of a run
KEPT = ("cases/", "oracle/")  # folders in which a study keeps what it has done; they may hold old and new files side by side
SECONDS = 8.0  # of a recording
# What a run counts its changes with, and disturbs itself at one of them: its number (0: none), the disturbance, the file for their
# number, and then what Python is to run.
CHILD = """
import os, resource, runpy, signal, sys
at, what, counted = int(sys.argv[1]), sys.argv[2], sys.argv[3]
sys.argv = sys.argv[4:]
here, seen, signal_of = os.getcwd(), 0, {"killed at a change": signal.SIGKILL, "Ctrl-C": signal.SIGINT}
def changed(event, args):
    global seen
    if event == "open":
        if not isinstance(args[0], str) or not (args[2] or 0) & (os.O_WRONLY | os.O_RDWR):
            return
    elif event not in ("os.rename", "os.remove", "os.mkdir", "os.rmdir"):
        return
    if not os.path.abspath(args[0]).startswith(os.path.join(here, "out")):
        return
    seen += 1
    if seen != at:
        return
    if what in signal_of:
        os.kill(os.getpid(), signal_of[what])
    elif what == "disk full":
        resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))
    elif what == "folder read-only":
        for folder, _, _ in [*os.walk(os.path.join(here, "out"))]:
            os.chmod(folder, 0o555)
signal.signal(signal.SIGINT, signal.default_int_handler)
sys.addaudithook(changed)
try:
    if sys.argv[0] == "-m":
        sys.argv = sys.argv[1:]
        runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
    else:
        sys.path.insert(0, os.path.dirname(sys.argv[0]))
        runpy.run_path(sys.argv[0], run_name="__main__")
finally:
    with open(counted, "w") as file:
        file.write(str(seen))
"""


@dataclass(frozen=True)
class Subject:
    """A command, with what it reads and the folder `out` that it writes.

    Attributes:
        name: In the table.
        old, new: What Python runs for the earlier run, and for the one that is disturbed.
        share: Of all kills; slow commands have fewer.
    """

    name: str
    old: Sequence[str]
    new: Sequence[str]
    share: float


DESIGN = ["-m", "rrr_oc", "design", "paper", "--configurations", "SA,PEA", "--starts", "1", "--motions", "0"]
DESIGN += ["--tolerance", "1e-2", "--catalogue", "none", "--quiet", "--out", "out"]
DIAGNOSE = ["--jobs", "1", "--quiet", "--out", "out"]
STUDY = [str(ROOT / "studies" / "concealed_physics.py"), "--jobs", "1", "--out", "out", "--cases"]
SUBJECTS = (
    Subject("rrr-oc design", [*DESIGN, "--intervals", "10", "--jobs", "1"], [*DESIGN, "--intervals", "8", "--jobs", "2"], 0.16),
    Subject(
        "rrr-oc calibrate",
        ["-m", "rrr_oc", "calibrate", "old/clean/data", "--quiet", "--out", "out"],
        ["-m", "rrr_oc", "calibrate", "new/clean/data", "--quiet", "--out", "out"],
        0.4,
    ),
    Subject(
        "rrr-oc diagnose",
        ["-m", "rrr_oc", "diagnose", "old/clean/data", *DIAGNOSE],
        ["-m", "rrr_oc", "diagnose", "new/short/data", *DIAGNOSE],
        0.24,
    ),
    Subject("concealed_physics.py", [*STUDY, "old"], [*STUDY, "new"], 0.2),
)


# --- runs ---


@dataclass(frozen=True)
class Ended:
    """How a run ended: its exit status (a signal is negative), what it said, its time [s] and the number of its changes."""

    status: int
    said: str
    wall_s: float
    changes: int


def run(folder: Path, what: Sequence[str], fault: str = "", at: int = 0, moment: float = LONGEST) -> Ended:
    """Python on `what` in a folder, disturbed at a change, or given a signal at a moment [s]; what it has begun must end with it."""
    counted = folder.with_suffix(".changes")
    counted.unlink(missing_ok=True)
    command = [sys.executable, "-c", CHILD, str(at), fault, str(counted), *what]
    if fault == "folder read-only" and os.getuid() == 0:  # root may write everywhere, unless it gives that up
        command = ["setpriv", "--bounding-set=-dac_override", *command]
    environment = os.environ | {"PYTHONPATH": str(ROOT), "MPLBACKEND": "Agg"}
    began = time.perf_counter()
    with (folder.with_suffix(".log")).open("w+", encoding="utf-8") as log:
        process = subprocess.Popen(command, cwd=folder, env=environment, stdout=log, stderr=log, start_new_session=True)
        try:
            process.wait(moment)
        except subprocess.TimeoutExpired:
            if moment == LONGEST:
                raise
            process.send_signal(AT_A_MOMENT[fault])
            process.wait(LONGEST)
        wall = time.perf_counter() - began
        _wait_for_children(process.pid)
        log.seek(0)
        said = log.read()
    return Ended(process.returncode, said, wall, int(counted.read_text()) if counted.is_file() else 0)


def _wait_for_children(session: int) -> None:
    """Wait until worker processes have seen that they are alone; raises TimeoutError where they do not."""
    for _ in range(600):
        try:
            os.killpg(session, 0)
        except ProcessLookupError:
            return
        time.sleep(0.1)
    raise TimeoutError(f"processes of session {session} still run")


# --- files ---


def files(folder: Path) -> dict[str, bytes]:
    """Visible files by their names; hidden ones are temporary, or those in which a run keeps what it has done."""
    every = {path.relative_to(folder): path for path in sorted(folder.rglob("*")) if path.is_file()}
    return {
        name.as_posix(): path.read_bytes() for name, path in every.items() if not any(p.startswith(".") for p in name.parts)
    }


def temporary(folder: Path) -> list[str]:
    """Names of what is left of files that were being written."""
    return [path.name for path in folder.rglob("*") if TEMPORARY.fullmatch(path.name)]


def content(name: str, data: bytes) -> Any:
    """The results in a file, in a form that can be compared; raises an error where the file is not whole."""
    kind = Path(name).suffix
    if kind == ".json":
        return _results(json.loads(data))
    if kind == ".npz":
        with np.load(io.BytesIO(data)) as file:
            return {key: (file[key].dtype.str, file[key].shape, file[key].tobytes()) for key in file.files}
    if kind == ".csv":
        rows = list(csv.reader(data.decode().splitlines()))
        if not data.endswith(b"\n") or len({len(row) for row in rows}) != 1:
            raise ValueError(f"{name}: rows of several lengths")
        return rows
    if kind == ".png":
        matplotlib.image.imread(io.BytesIO(data))
        return None  # a picture of numbers that are compared
    if kind in (".html", ".md"):
        if not data.decode().rstrip().endswith("</html>" if kind == ".html" else ""):
            raise ValueError(f"{name}: has no end")
        return None
    raise ValueError(f"{name}: nothing is known of such files")


def _results(data: Any) -> Any:
    """Plain data without times and memory."""
    if isinstance(data, dict):
        return {key: _results(value) for key, value in data.items() if key not in NO_RESULTS}
    return [_results(value) for value in data] if isinstance(data, list) else data


def part(found: Any, whole: Any) -> bool:
    """Whether plain data are others with some entries left out."""
    if isinstance(found, dict) and isinstance(whole, dict):
        return all(key in whole and part(value, whole[key]) for key, value in found.items())
    return found == whole


def ages(found: dict[str, bytes], old: dict[str, bytes], new: dict[str, bytes], interrupted: bool = False) -> dict[str, str]:
    """Of each file that two runs write differently: whether it is the old one, the new one, or torn.

    A run that was `interrupted` may have written the results that it had.
    """
    result = {}
    for name, data in found.items():
        if data == old.get(name):
            if name not in new or content(name, data) != content(name, new[name]):
                result[name] = "old"
            continue
        try:
            equal = part if interrupted else operator.eq
            same = name in new and equal(content(name, data), content(name, new[name]))
        except Exception as error:
            result[name] = f"torn ({error})"
            continue
        result[name] = "new" if same else "of no run"
    return result


def differences(found: dict[str, bytes], wanted: dict[str, bytes]) -> list[str]:
    """Names of files that one of two runs lacks, or whose results differ."""
    both = found.keys() & wanted.keys()
    return sorted((found.keys() ^ wanted.keys()) | {n for n in both if content(n, found[n]) != content(n, wanted[n])})


# --- disturbances ---


@dataclass(frozen=True, eq=False)
class Bench:
    """A subject with what its runs leave when nobody disturbs them.

    Attributes:
        folder: What it reads, and the results of the earlier run.
        old, new: Files of the earlier run, and of the one that is to be disturbed.
        ended: How the latter ended.
    """

    subject: Subject
    folder: Path
    old: dict[str, bytes]
    new: dict[str, bytes]
    ended: Ended


def bench(subject: Subject, cases: Path, out: Path) -> Bench:
    """Run both commands undisturbed; raises RuntimeError where one fails."""
    folder, undisturbed = out / "old", out / "new"
    for name in ("old", "new"):
        shutil.copytree(cases / name, folder / name)
    first = run(folder, subject.old)
    shutil.copytree(folder, undisturbed)
    second = run(undisturbed, subject.new)
    for ended in (first, second):
        if ended.status:
            raise RuntimeError(f"{subject.name} ended with {ended.status}: {ended.said}")
    return Bench(subject, folder, files(folder / "out"), files(undisturbed / "out"), second)


def disturbed(on: Bench, fault: str, folder: Path, rng: np.random.Generator) -> dict[str, Any]:
    """What a disturbance left, and how the command went on."""
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(on.folder, folder)
    at = int(rng.integers(1, on.ended.changes + 1))
    moment = float(rng.uniform(0, 1.02 * on.ended.wall_s)) if fault in AT_A_MOMENT else LONGEST
    if fault == "file cut off":
        cut = _cut_off(on, folder, rng)
        ended = Ended(2, cut, 0.0, 0)
    else:
        ended = run(folder, on.subject.new, fault, at if moment == LONGEST else 0, moment)
    for path in [folder / "out", *(folder / "out").rglob("*")]:
        if path.is_dir():
            path.chmod(0o755)
    found = files(folder / "out")
    left = ages(found, on.old, on.new, fault.startswith("Ctrl-C"))
    kinds = {age for name, age in left.items() if not name.startswith(KEPT)}
    cut_off = fault == "file cut off"
    again = run(folder, on.subject.new)
    wrong = differences(files(folder / "out"), on.new)
    return {
        "command": on.subject.name,
        "fault": fault,
        "at": moment if fault in AT_A_MOMENT else at,
        "seconds": [on.ended.wall_s, ended.wall_s, again.wall_s],
        "status": ended.status,
        "said": ended.said[-400:],
        "torn": [] if cut_off else [f"{name}: {age}" for name, age in left.items() if age not in ("old", "new")],
        "mixed": not cut_off and {"old", "new"} <= kinds,
        "missing": [] if cut_off else sorted(on.old.keys() & on.new.keys() - found.keys()),
        "without_a_sentence": fault in OTHERS and ended.status not in SENTENCE | {0},
        "again": again.status,
        "said_again": again.said[-400:] if again.status else "",
        "temporary": temporary(folder / "out"),
        "differs": wrong,
    }


def _cut_off(on: Bench, folder: Path, rng: np.random.Generator) -> str:
    """Cut off a random file of the finished run, one of those that it keeps for itself included; its name."""
    shutil.rmtree(folder / "out")
    shutil.copytree(on.folder.with_name("new") / "out", folder / "out")
    some = sorted(path for path in (folder / "out").rglob("*") if path.is_file())
    one = some[int(rng.integers(len(some)))]
    one.write_bytes(one.read_bytes()[: int(rng.integers(one.stat().st_size))])
    return one.name


# --- command line ---


def table(results: Sequence[dict[str, Any]]) -> str:
    """Counts by command and disturbance, in Markdown."""
    header = ["command", "disturbed", "times", "torn files", "old beside new", "files missing until it is given again"]
    header += ["no sentence", "temporary files left", "went on", "same numbers", "time of a run that it saved"]
    rows = []
    for name in dict.fromkeys(r["command"] for r in results):
        for fault in (*KILLS, *OTHERS):
            some = [r for r in results if (r["command"], r["fault"]) == (name, fault)]
            bad = [sum(bool(r[key]) for r in some) for key in ("torn", "mixed", "missing", "without_a_sentence", "temporary")]
            good = [sum(not r[key] for r in some) for key in ("again", "differs")]
            # of what the run had done, and would have done again from the start
            spared = [(whole - again) / max(min(first, whole), 1e-9) for whole, first, again in (r["seconds"] for r in some)]
            share = f"{100 * max(float(np.median(spared)), 0.0):.0f} %" if some and fault in AT_A_MOMENT else "–"
            rows += [[name, fault, *map(str, (len(some), *bad, *good)), share]] * bool(some)
    return markdown(header, rows)


def main(
    out: Annotated[Path, typer.Option(help="folder of the results; new or empty")],
    kills: Annotated[int, typer.Option(min=1, help="number of kills in all")] = 50,
    others: Annotated[int, typer.Option(min=0, help="number of other disturbances in all")] = 20,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    only: Annotated[str, typer.Option(help="part of a command's name")] = "",
) -> None:
    """Disturb commands and write kills.md and kills.json."""
    out, rng, results = out.resolve(), np.random.default_rng(seed), []
    for name, number in (("old", 6), ("new", 5)):
        (out / "cases" / name / "sealed").mkdir(parents=True)
        for kind, hidden in (("clean", ()), ("short", (Concealed("quadratic_drag", 3.0),))):
            case = Case(f"{kind}/kills", kind, number, "arm1", hidden, short=True)
            write_case(build(case, SECONDS), out / "cases" / name)
            for place, end in ((out / "cases" / name, ""), (out / "cases" / name / "sealed", ".json")):
                (place / f"{case.id}{end}").rename(place / f"{kind}{end}")  # old and new ones have the same names
    for subject in (s for s in SUBJECTS if only in s.name):
        on = bench(subject, out / "cases", out / subject.name)
        todo = [KILLS[i % 2] for i in range(round(kills * subject.share))]
        todo += [OTHERS[i % len(OTHERS)] for i in range(others // len(SUBJECTS))]
        for fault in track(todo, subject.name):
            results.append(disturbed(on, fault, out / subject.name / "work", rng))
            write_json(out / "kills.json", results)
            write_text(out / "kills.md", table(results))
    print(table(results))


entry = entry_point(lambda: typer.run(main))

if __name__ == "__main__":
    entry()
