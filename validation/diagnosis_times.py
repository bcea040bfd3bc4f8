"""How long does a diagnosis take, how much memory does it need, and what does it claim?

    python validation/diagnosis_times.py --out results/times
    python validation/diagnosis_times.py --tree OTHER --out results/others --cases results/times/cases --against results/times

Each row is `rrr-oc diagnose` on one recording set: in a process of its own, with one job and one thread of linear algebra, with low
priority and without compiled C from earlier runs. A row that needs more processor time than `--limit` is ended there. The sets are

- `sealed`: cases of the independent plant in validation/concealed, made when they are first asked for,
- `shared`: inputs on which a diagnosis once went wrong, made by a script in the folder `cases` of `--shared`,
- `real`: recordings of real arms from the folder `recordings` of `--shared`; of `train` and `test`, `train` is diagnosed,
- `paper`: recordings of the paper's own arm, as labelled and with labels removed, as in studies/prototype_recordings.py.

`--tree` names the checkout whose code diagnoses; inputs are made by this one. A row that is there is not run again: delete its file
in OUT/rows to have it done anew. OUT/work has the whole result of each diagnosis and what it said, OUT/times.md the table, and
OUT/times.json all rows. `--against` puts another run, its folder or its times.json, beside this one (OUT/against.md). That of an
earlier version is validation/diagnosis_times.json.
"""

import json
import math
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Annotated, Any

import typer

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from rrr_oc.errors import UserError, entry_point
from rrr_oc.recordings.header import HEADER
from rrr_oc.report.tables import NONE, markdown
from rrr_oc.storage import check_folder, hash_of, new_folder, number, write_json, write_text
from validation.concealed.cases import Case, Concealed, declare

ROOT = Path(__file__).resolve().parents[1]
SEED = 9201  # of the sealed cases
NICE = 10  # priority of the diagnoses; others come first
GRACE = 5  # [s] of processor time between the signal that a limit sends and the one that cannot be ignored
ALIKE = 0.05  # relative difference of a parameter up to which two claims are the same
SAID = 400  # last characters of a diagnosis's output that its row keeps
ONE_THREAD = {f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL")}
# What a diagnosis runs as: its limit [s] of processor time, the signal's grace [s], its priority, and then the command's arguments.
CHILD = """
import os, resource, runpy, sys
limit, grace, priority = map(int, sys.argv[1:4])
resource.setrlimit(resource.RLIMIT_CPU, (limit, limit + grace))
resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
os.setpriority(os.PRIO_PROCESS, 0, max(priority, os.getpriority(os.PRIO_PROCESS, 0)))
sys.argv = ["rrr-oc", *sys.argv[4:]]
runpy.run_module("rrr_oc", run_name="__main__", alter_sys=True)
"""


class AbsentError(Exception):
    """What a row needs is not there: says what."""


@dataclass(frozen=True)
class Row:
    """One diagnosis.

    Attributes:
        name: Group and name, as in real/franka_panda.
        source: From the folder of made sets and the folder of shared inputs to the set; raises `AbsentError`.
    """

    name: str
    source: Callable[[Path, Path], Path]


@dataclass(frozen=True)
class Run:
    """Where and how rows are run: the code's checkout, the folders of results, made sets and shared inputs, and the limit [s]."""

    tree: Path
    out: Path
    cases: Path
    shared: Path
    limit: int

    def result(self, row: Row) -> Path:
        """The file of a row."""
        return self.out / "rows" / f"{row.name}.json"


# --- recording sets ---


def sealed(key: str | Case, cases: Path, _: Path) -> Path:
    """A case of the independent plant, by its key or as it is declared here; made unless it is there."""
    case = next(c for c in declare(SEED) if c.key == key) if isinstance(key, str) else key
    folder = cases / "sealed" / case.id / "data"
    if not (cases / "sealed" / "sealed" / f"{case.id}.json").is_file() or not folder.is_dir():
        apart(make_sealed, case, cases / "sealed")
    return folder


def make_sealed(case: Case, out: Path) -> None:
    from validation.concealed.build import build
    from validation.concealed.write import write_case

    write_case(build(case), out)


def shared_case(name: str, cases: Path, shared: Path) -> Path:
    """An input of `cases`: as it lies there, or as the script beside it makes it."""
    there, script, made = shared / "cases" / name, shared / "cases" / "make.py", cases / "shared"
    if (there / HEADER).is_file():
        return there
    if not made.is_dir():
        if not script.is_file():
            raise AbsentError(f"{script} is missing")
        with new_folder(made) as temporary:
            subprocess.run([sys.executable, "-B", script, temporary], check=True, env=os.environ | ONE_THREAD)
    return _present(made / name)


def real(name: str, _: Path, shared: Path) -> Path:
    """Recordings of a real arm; of a set that is split, the part that is no test."""
    folder = shared / "recordings" / name
    return _present(folder / "train" if (folder / "train").is_dir() else folder)


def paper(labels: str, cases: Path, shared: Path) -> Path:
    """The recordings of the paper's own arm with some of their labels."""
    source, folder = shared / "recordings" / "rrr_prototype", cases / "paper" / labels
    if not folder.is_dir():
        if not source.is_dir():
            raise AbsentError(f"{source} is missing")
        apart(make_paper, labels, source, folder)
    return folder


def make_paper(labels: str, source: Path, folder: Path) -> None:
    from rrr_oc.recordings.importers import import_prototype
    from rrr_oc.recordings.reader import load_recordings
    from rrr_oc.recordings.writer import save_recordings
    from validation.prototype_labels import variant

    converted = folder.with_name("converted")
    if not converted.is_dir():
        import_prototype(source, converted)
    save_recordings(variant(load_recordings(converted), labels), folder)


def apart(function: Callable[..., None], *arguments: Any) -> None:
    """Call a function in a process of its own, so that this one, and with it its children's peak of memory, stays small."""
    os.environ.update(ONE_THREAD)
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        pool.submit(function, *arguments).result()


def _present(folder: Path) -> Path:
    if not (folder / HEADER).is_file():
        raise AbsentError(f"{folder / HEADER} is missing")
    return folder


def coupled_of_seven(ratio: float) -> Case:
    """Coupled friction on seven joints, which the seed's own cases lack."""
    return Case(f"times/coupled_friction/{ratio}", "single", SEED, "arm7", (Concealed("coupled_friction", ratio),))


SHORT = ("gain", "wall", "no_gravity", "zeros", "rest", "direction", "sweep", "motor_side", "pair")
SHORT += ("columns/dq_zero", "columns/ddq_zero", "columns/dq_motor_side")
REAL = ("kinova_joint7", "xl330_pendulum", "staubli_tx40", "kuka_kr300", "franka_panda", "double_pendulum")
SEALED = {  # name: key
    "clean_4_joints": "clean/0",
    "clean_2_joints": "clean/163",
    "stribeck_3_joints": "single/stribeck/1.0/rrr",
    "stribeck_6_joints": "single/stribeck/3.0/arm",
    "elasticity_3_joints": "single/joint_elasticity/3.0/rrr",
    "elasticity_4_joints": "single/joint_elasticity/3.0/arm",
    "backlash_3_joints": "single/backlash/3.0/rrr",
    "backlash_4_joints": "single/backlash/1.0/arm",
    "pair_3_joints": "pair/25",
    "pair_5_joints": "pair/2",
    "imperfect_5_joints": "imperfect/22",
    "imperfect_asymmetry_5_joints": "imperfect/119",
}
LONG = {
    "coupled_7_joints": coupled_of_seven(3.0),
    "coupled_weak_7_joints": coupled_of_seven(1.0),
    "imperfect_7_joints": "imperfect/36",
    "imperfect_drag_7_joints": "imperfect/121",
}
LABELS = ("bare", "labelled", "no_payload", "no_springs")
ROWS = (  # in the order in which they are run: those that may take longest come last
    *(Row(f"shared/{name}", partial(shared_case, name)) for name in SHORT),
    *(Row(f"real/{name}", partial(real, name)) for name in REAL),
    *(Row(f"sealed/{name}", partial(sealed, key)) for name, key in SEALED.items()),
    Row("shared/ripple3", partial(shared_case, "ripple3/train")),
    *(Row(f"paper/{name}", partial(paper, name)) for name in LABELS),
    *(Row(f"sealed/{name}", partial(sealed, key)) for name, key in LONG.items()),
)


# --- one row ---


def once(row: Row, run: Run) -> dict[str, Any]:
    """A row's result: the one that is there, or a new one; of a row whose input is missing, why it was skipped."""
    file = run.result(row)
    if not file.is_file():
        try:
            data = row.source(run.cases, run.shared)
        except AbsentError as why:
            return {"row": row.name, "skipped": str(why)}
        write_json(file, measured(row, data, run))
    return json.loads(file.read_text(encoding="utf-8"))


def measured(row: Row, data: Path, run: Run) -> dict[str, Any]:
    """Diagnose a set in a process of its own, and say what that took and what it found."""
    work, header = run.out / "work" / row.name, json.loads((data / HEADER).read_text(encoding="utf-8"))
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    used = timed(["diagnose", str(data.resolve()), "--out", "diagnosis", "--jobs", "1"], work, run)
    found = work / "diagnosis" / "diagnosis.json"
    return {
        "row": row.name,
        "joints": len(header["joints"]),
        "recordings": len(header["recordings"]),
        "limit_s": run.limit,
        "code": hash_of([run.tree / "rrr_oc"]),
        "commit": commit(run.tree),
        **used,
        **(claimed(json.loads(found.read_text(encoding="utf-8"))) if found.is_file() else {}),
    }


def timed(command: Sequence[str], work: Path, run: Run) -> dict[str, Any]:
    """Run a command of `rrr-oc` in a folder, and say how it ended and what it and its children used."""
    began, load, log = time.perf_counter(), os.getloadavg()[0], work / "log.txt"
    with log.open("w", encoding="utf-8") as file:
        child = [sys.executable, "-c", CHILD, *map(str, (run.limit, GRACE, NICE)), *command]
        process = subprocess.Popen(child, cwd=work, env=environment(run, work), stdout=file, stderr=file)
        try:
            _, ended, used = os.wait4(process.pid, 0)
        except BaseException:
            process.kill()
            raise
    process.returncode = status = os.waitstatus_to_exitcode(ended)
    return {
        "status": status,
        "ended": status in (-signal.SIGXCPU, -signal.SIGKILL) and used.ru_utime + used.ru_stime >= run.limit - 1,
        "processor_s": used.ru_utime + used.ru_stime,
        "user_s": used.ru_utime,
        "system_s": used.ru_stime,
        "wall_s": time.perf_counter() - began,
        "peak_MB": megabytes(used),
        "load": [load, os.getloadavg()[0]],
        "said": log.read_text(encoding="utf-8", errors="replace")[-SAID:],
    }


def environment(run: Run, work: Path) -> dict[str, str]:
    """Of a diagnosis: this checkout's code and one thread; compiled C is new in each row, compiled Python is kept for all."""
    fonts = os.environ.get("MPLCONFIGDIR", str(Path.home() / ".cache" / "matplotlib"))
    code = {"PYTHONPATH": str(run.tree), "PYTHONPYCACHEPREFIX": str(run.out / "bytecode"), "PYTHONDONTWRITEBYTECODE": ""}
    places = {"XDG_CACHE_HOME": str(work), "TMPDIR": str(work), "MPLCONFIGDIR": fonts, "MPLBACKEND": "Agg"}
    return {**os.environ, **ONE_THREAD, **code, **places}


def warm(run: Run) -> None:
    """Have Python compiled before the first row, which it would count for."""
    command = [sys.executable, "-m", "rrr_oc", "diagnose", "--help"]
    subprocess.run(command, cwd="/", env=environment(run, run.out), capture_output=True, check=True)


def megabytes(used: resource.struct_rusage) -> float:
    """Largest resident memory of a process or one of its children [MB]."""
    return used.ru_maxrss * (1e-6 if sys.platform == "darwin" else 1024e-6)  # in bytes there, in KiB elsewhere


def commit(tree: Path) -> str:
    """What git calls the state of a checkout; empty where it is none."""
    asked = subprocess.run(["git", "describe", "--always", "--dirty"], cwd=tree, capture_output=True, text=True, check=False)
    return asked.stdout.strip()


def claimed(found: Mapping[str, Any]) -> dict[str, Any]:
    """Verdict, claims and mean held-out errors from the content of diagnosis.json."""
    held = found["nrmse"]["held_out"]
    return {
        "verdict": found["verdict"],
        "claims": [claim(entry) for entry in (*found["effects"], *found["unexplained"])],
        "nrmse": {when: mean(held[when].values()) for when in ("before", "after")},
        "nrmse_by_joint": held,
    }


def claim(entry: Mapping[str, Any]) -> dict[str, Any]:
    """An effect or an unexplained torque of diagnosis.json."""
    parameters = entry.get("parameters", {}).items()
    return {
        "effect": entry.get("effect", "unexplained"),
        "joint": entry["joint"],
        "recordings": entry["recordings"],
        "probability": entry.get("probability"),
        "parameters": {name: {key: p.get(key) for key in ("value", "std", "unit")} for name, p in parameters},
        "depends_on": entry.get("depends_on", []),
        "rivals": entry.get("rivals", []),
    }


def mean(values: Any) -> float | None:
    """The mean of what is known; None where nothing is."""
    known = [v for v in values if v is not None]
    return number(sum(known) / len(known)) if known else None


# --- tables ---


def table(results: Sequence[Mapping[str, Any]]) -> str:
    """All rows in Markdown."""
    header = ["row", "joints", "recordings", "processor time [s]", "peak memory [MB]", "exit", "verdict", "claims"]
    rows = []
    for r in results:
        if "skipped" in r:
            rows.append([r["row"], *[""] * 4, "skipped", "", r["skipped"], "", ""])
            continue
        errors = [shown(r.get("nrmse", {}).get(when)) for when in ("before", "after")]
        cells = [r["row"], str(r["joints"]), str(r["recordings"]), f"{r['processor_s']:.1f}", f"{r['peak_MB']:.0f}", how(r)]
        rows.append([*cells, r.get("verdict", NONE), claims(r), *errors])
    text = markdown([*header, "NRMSE held out, before", "after"], rows)
    states = sorted({r["commit"] or r["code"] for r in results if "skipped" not in r})
    return text + f"\nCode of {', '.join(states)}; one job, one thread.\n" * bool(states)


def how(result: Mapping[str, Any]) -> str:
    """How a row ended."""
    return f"ended at {result['limit_s']} s" if result["ended"] else str(result["status"])


def claims(result: Mapping[str, Any]) -> str:
    """The claims of a row in words; of one that failed the last that it said."""
    if "claims" not in result:
        return NONE if result["ended"] else result["said"].strip().rpartition("\n")[2]
    return "; ".join(f"{named(c)} ({', '.join([*sizes(c), chance(c)])})" for c in result["claims"]) or "nothing"


def named(one: Mapping[str, Any]) -> str:
    """Effect, joint and recordings of a claim."""
    joint = one["joint"] if isinstance(one["joint"], str) else " and ".join(one["joint"] or [])
    some = "" if one["recordings"] == "all" else f"in {', '.join(one['recordings'])}"
    depends = f"over {', '.join(one['depends_on'])}" if one["depends_on"] else ""
    return " ".join(filter(None, (one["effect"].replace("_", " "), joint, depends, some)))


def sizes(one: Mapping[str, Any]) -> list[str]:
    """Parameters of a claim with their units."""
    each = one["parameters"].items()
    return [f"{name} {shown(p['value'])} {p['unit'] if p['unit'] not in (None, '1') else ''}".strip() for name, p in each]


def chance(one: Mapping[str, Any]) -> str:
    """The probability of a claim."""
    p = one["probability"]
    return "no probability" if p is None else "> 99.9 %" if p > 0.999 else f"{100 * p:.1f} %"


def shown(value: Any) -> str:
    """A number with three digits, several, a word, or a dash for what is unknown."""
    if isinstance(value, list):
        return f"[{', '.join(map(shown, value))}]"
    return NONE if value is None else f"{value:.3g}" if isinstance(value, float) else str(value)


def comparison(results: Sequence[Mapping[str, Any]], others: Mapping[str, Mapping[str, Any]]) -> str:
    """Rows of this run beside those of another in Markdown: ratios are this over the other."""
    header = ["row", "processor time [s], other", "this", "ratio", "peak memory [MB], other", "this", "ratio"]
    header += ["exit, other", "this", "NRMSE held out, other", "this", "claims differ"]
    both = [(r, others[r["row"]]) for r in results if r["row"] in others and "skipped" not in r]
    rows = []
    for r, o in both:
        times = [f"{o['processor_s']:.1f}", f"{r['processor_s']:.1f}", ratio(r, o, "processor_s")]
        memory = [f"{o['peak_MB']:.0f}", f"{r['peak_MB']:.0f}", ratio(r, o, "peak_MB")]
        errors = [shown(x.get("nrmse", {}).get("after")) for x in (o, r)]
        rows.append([r["row"], *times, *memory, how(o), how(r), *errors, differences(r, o)])
    whole = [(r, o) for r, o in both if not r["ended"] and not o["ended"]]
    if not whole:
        return markdown(header, rows)
    sums = [sum(pair[k]["processor_s"] for pair in whole) for k in (1, 0)]
    middle = math.exp(sum(math.log(r["processor_s"] / o["processor_s"]) for r, o in whole) / len(whole))
    text = f"{len(whole)} rows that neither run ended: {sums[0]:.0f} s, now {sums[1]:.0f} s, geometric mean of the ratios {middle:.3f}."
    return f"{markdown(header, rows)}\n{text}\n"


def ratio(result: Mapping[str, Any], other: Mapping[str, Any], key: str) -> str:
    """This over the other; a bound where one of them was ended, and nothing where both were."""
    if result["ended"] and other["ended"]:
        return NONE
    sign = "< " if other["ended"] else "> " if result["ended"] else ""
    return f"{sign}{result[key] / other[key]:.3f}"


def differences(result: Mapping[str, Any], other: Mapping[str, Any]) -> str:
    """What this run claims besides (+), no longer (−), and with other parameters."""
    if "claims" not in result or "claims" not in other:
        return NONE
    here, there = ({named(c): c for c in x["claims"]} for x in (result, other))
    verdict = f"{other['verdict']} → {result['verdict']}" if other["verdict"] != result["verdict"] else ""
    more, less = ([f"{sign} {name}" for name in a if name not in b] for sign, a, b in (("+", here, there), ("−", there, here)))
    moved = [f"{name}: {change}" for name in here if name in there and (change := changes(here[name], there[name]))]
    return "; ".join(filter(None, (verdict, *more, *less, *moved))) or "no"


def changes(one: Mapping[str, Any], other: Mapping[str, Any]) -> str:
    """Parameters of a claim that differ between two runs."""
    values = [{name: p["value"] for name, p in x["parameters"].items()} for x in (other, one)]
    names = [name for name in dict.fromkeys((*values[0], *values[1])) if not alike(*(v.get(name) for v in values))]
    return ", ".join(f"{name} {shown(values[0].get(name))} → {shown(values[1].get(name))}" for name in names)


def alike(a: Any, b: Any) -> bool:
    """Whether two values of a parameter are the same but for rounding and little else."""
    if isinstance(a, list) and isinstance(b, list):
        return len(a) == len(b) and all(map(alike, a, b))
    if isinstance(a, int | float) and isinstance(b, int | float):
        return math.isclose(a, b, rel_tol=ALIKE)
    return a == b


# --- command line ---


def chosen(patterns: Sequence[str], rows: Sequence[Row] = ROWS) -> list[Row]:
    """The rows of these names or patterns, in their order; all where none is given."""
    for pattern in patterns:
        if not any(fnmatchcase(row.name, pattern) for row in rows):
            raise UserError(f"--rows is {pattern!r}; the rows are {', '.join(row.name for row in rows)}")
    return [row for row in rows if not patterns or any(fnmatchcase(row.name, pattern) for pattern in patterns)]


def run_all(rows: Sequence[Row], run: Run) -> list[dict[str, Any]]:
    """Run rows one after the other; a line for each, and the tables of all rows that are there after each."""
    skipped: dict[str, dict[str, Any]] = {}
    results: list[dict[str, Any]] = []
    for row in rows:
        result = once(row, run)
        if "skipped" in result:
            skipped[row.name] = result
            print(f"{row.name}: skipped, {result['skipped']}", flush=True)
        else:
            print(f"{row.name}: {result['processor_s']:.1f} s, exit {how(result)}; {claims(result)}", flush=True)
        every = stored(run.out)
        names = list(dict.fromkeys([r.name for r in (*ROWS, *rows)]))
        results = [found for name in names if (found := every.get(name, skipped.get(name)))]
        write_json(run.out / "times.json", results)
        write_text(run.out / "times.md", table(results))
    return results


def stored(out: Path) -> dict[str, dict[str, Any]]:
    """The rows in a folder of results, or in a file as times.json, by name."""
    if out.is_file():
        found = json.loads(out.read_text(encoding="utf-8"))
    else:
        found = [json.loads(file.read_text(encoding="utf-8")) for file in sorted((out / "rows").rglob("*.json"))]
    return {r["row"]: r for r in found if "skipped" not in r}


def check_tree(tree: Path) -> None:
    """Raise `UserError` unless Python takes the package from this checkout."""
    asked = [sys.executable, "-c", "import rrr_oc; print(rrr_oc.__file__)"]
    found = subprocess.run(
        asked, cwd="/", env=os.environ | {"PYTHONPATH": str(tree)}, capture_output=True, text=True, check=False
    )
    if found.returncode or not Path(found.stdout.strip()).is_relative_to(tree):
        raise UserError(f"--tree is {tree}; a checkout with the package rrr_oc is required")


def main(
    out: Annotated[Path, typer.Option(help="folder of the results")] = Path("results/diagnosis_times"),
    tree: Annotated[Path, typer.Option(help="the checkout whose code is to diagnose; with compiled extensions")] = ROOT,
    rows: Annotated[
        list[str] | None, typer.Option(help="only this row, or rows like real/*; may be given several times")
    ] = None,
    cases: Annotated[Path | None, typer.Option(help="folder of the sets that are made; default: cases in OUT")] = None,
    shared: Annotated[
        Path,
        typer.Option(envvar="RRR_OC_SHARED", help="folder with cases and recordings; rows that need what it lacks are skipped"),
    ] = ROOT.parent / "shared",
    limit: Annotated[int, typer.Option(min=1, help="processor time [s] at which a row is ended")] = 600,
    against: Annotated[Path | None, typer.Option(help="folder, or times.json, of another run to compare with")] = None,
) -> None:
    """Time diagnoses; writes times.md, times.json, rows/ and work/, with --against also against.md."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))  # so that a diagnosis ends with this process
    check_folder(out)
    others = {} if against is None else stored(against)
    if against is not None and not others:
        raise UserError(f"--against is {against}; the folder of another run, or its times.json, is required")
    check_tree(tree.resolve())
    run = Run(tree.resolve(), out.resolve(), (cases or out / "cases").resolve(), shared.resolve(), limit)
    warm(run)
    results = run_all(chosen(rows or []), run)
    print(table(results))
    if others:
        text = comparison(results, others)
        write_text(out / "against.md", text)
        print(text)


entry = entry_point(lambda: typer.run(main))

if __name__ == "__main__":
    entry()
