"""Recordings of real arms: what the diagnosis claims about each set, and how well its model predicts recordings it has not seen.

    python studies/real_arms.py recordings --published published.json --out results/real_arms

Every set below the folder is diagnosed blind, in a process of its own: folders with `recordings.json`, folders that hold two of
them, `train` and `test`, and the public recordings of the paper's own arm in their source's layout, which are converted and
diagnosed in the variants of studies/prototype_recordings.py. The diagnosis is given `train` alone.

NRMSE is that of `rrr-oc evaluate` on the files of `test`. A set without `test` has the held-out figure of its own diagnosis, and the
regressions are held to the same recordings. Beside the plain and the diagnosed model stand two regressions of the torque itself on
q, dq, ddq and payload of all joints, without physics: boosted trees, and a ridge over splines.

What is published about the sets is in a file of the user's; the diagnosis never sees it:

    {"set": {"text": "a spring at joint 2", "effects": [{"effect": "parallel_spring", "joint": "joint2"}],
             "absent": [{"effect": "gravity_tilt"}]}}

A set's result is in out/sets/<set>.json when it is whole, so that an interrupted run goes on where it was; delete the file to have
it done again. Results of other recordings or of other code are made anew. The full report of its diagnosis is in out/diagnoses/<set>.
"""

import json
import multiprocessing
import resource
import shutil
import signal
import sys
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from pathlib import Path
from typing import Annotated, Any, cast

import numpy as np
import typer
from prototype_recordings import VARIANTS, boosted_trees, variant
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn
from rich.table import Table
from sklearn.linear_model import RidgeCV
from sklearn.model_selection import KFold
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import SplineTransformer, StandardScaler

from rrr_oc.calibration.calibrated_model import CalibratedModel
from rrr_oc.calibration.prediction_error import error, evaluate_inverse
from rrr_oc.calibration.samples import BLOCKS
from rrr_oc.diagnosis.procedure import diagnose
from rrr_oc.diagnosis.result import Diagnosis
from rrr_oc.errors import UserError, entry_point
from rrr_oc.parallel import one_thread
from rrr_oc.recordings.header import HEADER
from rrr_oc.recordings.importers import import_prototype
from rrr_oc.recordings.importers.prototype import PATTERN
from rrr_oc.recordings.reader import load_recordings
from rrr_oc.recordings.recording import RecordingSet
from rrr_oc.report.console import wide_console
from rrr_oc.report.diagnosis_report import write_diagnosis
from rrr_oc.report.tables import NONE, markdown
from rrr_oc.schema import Schema, read_json
from rrr_oc.storage import Made, check_folder, number, write_json, write_text

STEP = 0.01  # [s] between the samples that a regression is trained on; doubled, half the time, and noise counts for more
SURE = 0.999  # probabilities above it are not shown closer; nearer to 1, digits that no data support
LARGEST = 1e16  # inverse of the smallest p-value that is shown as a number; below it, rounding decides
KNOTS = 8  # of the splines over each input; more follow finer shapes, and need more samples
PENALTIES = np.logspace(-4, 4, 17)  # of which a ridge picks one; a narrower range restricts it
FIFTHS = KFold(5)  # by which it picks: contiguous, since samples alike their neighbours would make it pick too small a one
REGRESSIONS: dict[str, Callable[[], Any]] = {  # without physics, for one joint; nothing is tuned to a set by hand
    "trees": boosted_trees,
    "splines": lambda: make_pipeline(StandardScaler(), SplineTransformer(KNOTS), RidgeCV(PENALTIES, cv=FIFTHS)),
}
MODELS = ("plain", "diagnosed", *REGRESSIONS)  # the columns of NRMSE, in their order
VERDICTS = {  # how a verdict stands in the table
    "missing_physics": "physics is missing",
    "nothing_missing": "nothing is missing",
    "cannot_tell": "cannot tell",
}
WORDS = ("set", "joint", "claim", "parameters", "probability", "published")  # the columns of words, in their order
HEADINGS = (*WORDS, *MODELS, "time [s]", "memory [MB]")  # all columns
LEGEND = """\
The first row of a set has the verdict, which recordings were held out, what is published about the set, the mean NRMSE over its
joints, and time and peak memory of the diagnosis. Below it stands each joint with what is claimed about it and its NRMSE; claims
without a joint come first.

- **probability**: as stated by the diagnosis; where it states none, the p-value of the claim.
- **published**: `known` what is known to be there; `known, as rival` where the claim lists it as indistinguishable; `known, not
  claimed` what was missed; `known to be absent` what is not there; `not published` what the file does not mention.
- **held out**: `test` are recordings that the diagnosis was never given; `folds` the held-out figure of the diagnosis itself, each
  recording predicted by the search without it; `blocks` the same for pieces of a lone recording.
- **NRMSE** (lower is better; 1 is a constant torque) of the plain calibrated model, the diagnosed model, boosted trees and a ridge
  over splines.
"""
console = wide_console()


class Known(Schema, frozen=True):
    """An effect that is known to be there, or not; without a joint, anywhere. Several names mean any of them."""

    effect: str | list[str]
    joint: str | list[str] | None = None

    @property
    def names(self) -> list[str]:
        """The effect's names."""
        return [self.effect] if isinstance(self.effect, str) else self.effect

    def means(self, claim: Mapping[str, Any]) -> bool:
        """Whether an entry with "effect" and "joint" is this effect."""
        return claim["effect"] in self.names and (self.joint is None or _joints(self.joint) == _joints(claim["joint"]))


class Published(Schema, frozen=True):
    """What is published about a set: in words, which effects are there, and which are known not to be."""

    text: str = ""
    effects: tuple[Known, ...] = ()
    absent: tuple[Known, ...] = ()


@dataclass(frozen=True)
class RealSet:
    """A recording set to diagnose.

    Attributes:
        name: Its path below the folder of all sets.
        train: The folder that the diagnosis is given; in its source's layout where there is a variant.
        test: The folder that it is not given; None where there is none.
        variant: Which of the prototype's labels are left; None for sets in our own format.
    """

    name: str
    train: Path
    test: Path | None = None
    variant: str | None = None


@dataclass(frozen=True)
class Part:
    """A stretch of recording as regressions see it: t (K,) [s], inputs x (K, inputs), torque y (n, K) [Nm], its segments."""

    t: np.ndarray
    x: np.ndarray
    y: np.ndarray
    segments: tuple[slice, ...]


# --- which sets there are ---


def sets_below(folder: Path, out: Path) -> list[RealSet]:
    """All sets below a folder, or the folder itself, by name; nothing in the folder of results is one."""
    if not folder.is_dir():
        raise UserError(f"{folder}: no such folder; one that holds recording sets is required")
    found = list(_sets(folder, "", out))
    if not found:
        raise UserError(f"{folder}: holds no recording set, a folder with {HEADER}, and no folder `train` that is one")
    return found


def _sets(folder: Path, name: str, out: Path) -> Iterator[RealSet]:
    shown = name or folder.resolve().name
    if (folder / "train" / HEADER).is_file():
        yield RealSet(shown, folder / "train", folder / "test" if (folder / "test" / HEADER).is_file() else None)
    elif (folder / HEADER).is_file():
        yield RealSet(shown, folder)
    elif any(PATTERN.fullmatch(path.name) for path in folder.iterdir()):
        yield from (RealSet(f"{shown}/{labels}", folder, None, labels) for labels in VARIANTS)
    else:
        for below in sorted(path for path in folder.iterdir() if path.is_dir() and path.resolve() != out.resolve()):
            yield from _sets(below, f"{name}/{below.name}".lstrip("/"), out)


def chosen(sets: Sequence[RealSet], only: Sequence[str]) -> list[RealSet]:
    """The sets of these names, or below folders of these names; all where none is given."""
    names = {s.name for s in sets} | {s.name.rpartition("/")[0] for s in sets if "/" in s.name}
    unknown = [name for name in only if name not in names]
    if unknown:
        raise UserError(f"--only is {unknown[0]!r}; the sets are {', '.join(s.name for s in sets)}")
    return [s for s in sets if not only or s.name in only or s.name.rpartition("/")[0] in only]


# --- one set, blind ---


def examine(one: RealSet, out: Path, report: Callable[[str], None]) -> dict[str, Any]:
    """Diagnose a set, write the report of its diagnosis, and predict the held-out recordings in all ways."""
    began = time.perf_counter()
    recordings = loaded(one, out)
    with one_thread():
        diagnosis = diagnose(recordings, lambda step: report(step.said or step.stage))
    content = write_diagnosis(diagnosis, out / "diagnoses" / one.name)
    wall, memory = time.perf_counter() - began, peak_memory()
    test = None if one.test is None else load_recordings(one.test)
    if test is None:
        held, files = {"recordings": "folds"}.get(diagnosis.way, diagnosis.way), recordings
        nrmse = {"plain": content["nrmse"]["held_out"]["before"], "diagnosed": content["nrmse"]["held_out"]["after"]}
    else:
        held, files = "test", test
        nrmse = {"plain": mean_errors(diagnosis.plain, test), "diagnosed": mean_errors(diagnosis.model, test)}
    every = splits(diagnosis, test)
    for kind, make in REGRESSIONS.items():
        report(f"fitting {kind} for comparison")
        nrmse[kind] = dict(zip(recordings.joints, regression_errors(make, every), strict=True))
    return {
        "set": one.name,
        "joints": list(recordings.joints),
        "verdict": content["verdict"],
        "claims": [_claim(e, recordings) for e in (*content["effects"], *content["unexplained"])],
        "held_out": {"way": held, "files": [r.file for r in files.recordings]},
        "nrmse": nrmse,
        "wall_s": wall,
        "peak_memory_MB": memory,
        "notes": list(recordings.notes),
    }


def loaded(one: RealSet, out: Path) -> RecordingSet:
    """The recordings that the diagnosis is given; the prototype's are converted into `out` before."""
    if one.variant is None:
        return load_recordings(one.train)
    converted = out / "converted" / one.name

    def convert() -> None:
        shutil.rmtree(converted, ignore_errors=True)
        import_prototype(one.train, converted)

    Made([converted], one.name, [one.train]).once(convert)
    return variant(load_recordings(converted), one.variant)


def mean_errors(model: CalibratedModel, recordings: RecordingSet) -> dict[str, float | None]:
    """NRMSE of the predicted signal, mean over the recordings, by joint; None for joints that never move."""
    errors = list(evaluate_inverse(model, recordings).values())
    return {j: mean([e[j]["nrmse"] for e in errors]) for j in model.joints}


def mean(values: Sequence[float | None]) -> float | None:
    """The mean of what is known, None where nothing is."""
    known = [v for v in values if v is not None]
    return float(np.mean(known)) if known else None


def peak_memory() -> float:
    """Largest resident memory of this process and of those that it waited for [MB]."""
    unit = 1e-6 if sys.platform == "darwin" else 1024e-6  # ru_maxrss is in bytes there, in KiB elsewhere
    return unit * max(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))


def _claim(entry: Mapping[str, Any], recordings: RecordingSet) -> dict[str, Any]:
    """What the table needs of an entry of diagnosis.json, an effect or an unexplained torque."""
    some = entry["recordings"]
    return {
        "effect": entry.get("effect", "unexplained"),
        "joint": entry["joint"],
        "recordings": some if isinstance(some, str) else f"{len(some)} of {len(recordings.recordings)}",
        "parameters": {
            k: {"value": v["value"], "unit": v["unit"]} for k, v in entry.get("parameters", {}).items() if "value" in v
        },
        "depends_on": entry.get("depends_on", []),
        "probability": entry.get("probability"),
        "p_value": entry.get("p_value"),
        "rivals": entry.get("rivals", []),
    }


# --- regressions without physics ---


def parts(recordings: RecordingSet) -> list[Part]:
    """The recordings as regressions see them."""
    return [
        Part(r.t, np.vstack([r.q, r.dq, r.ddq, r.payload]).T, recordings.output_torque(r), tuple(r.segments))
        for r in recordings.recordings
    ]


def splits(diagnosis: Diagnosis, test: RecordingSet | None) -> list[tuple[list[Part], list[Part]]]:
    """Training and held-out parts: of `test`, else as the diagnosis held its own recordings out."""
    own = parts(diagnosis.recordings)
    if test is not None:
        return [(own, parts(test))]
    if diagnosis.way == "recordings":
        held = [set(fold.held) for fold in diagnosis.folds]
    else:
        own = [piece for part in own for piece in blocks(part)]
        held = [{k} for k in range(len(own))]
    return [([p for k, p in enumerate(own) if k not in h], [p for k, p in enumerate(own) if k in h]) for h in held]


def blocks(part: Part) -> list[Part]:
    """As many contiguous pieces of a recording as the diagnosis makes; segments without samples in a piece are left out of it."""
    result = []
    for rows in np.array_split(np.arange(len(part.t)), BLOCKS):
        a, b = int(rows[0]), int(rows[-1]) + 1
        inside = [slice(max(s.start, a) - a, min(s.stop, b) - a) for s in part.segments]
        result.append(Part(part.t[a:b], part.x[a:b], part.y[:, a:b], tuple(s for s in inside if s.stop > s.start)))
    return result


def regression_errors(make: Callable[[], Any], every: Sequence[tuple[list[Part], list[Part]]]) -> list[float | None]:
    """NRMSE of one regression a joint, mean over the held-out parts, n of them; None for joints that never move."""
    errors = []
    for train, held in every:
        strides = [max(1, round(STEP / float(np.median(np.diff(p.t))))) for p in train]
        x = np.concatenate([p.x[::k] for p, k in zip(train, strides, strict=True)])
        y = np.concatenate([p.y.T[::k] for p, k in zip(train, strides, strict=True)])
        varies = np.ptp(x, axis=0) > 0
        fitted = [make().fit(x[:, varies], column) for column in y.T]
        for p in held:
            predicted = np.array([f.predict(p.x[:, varies]) for f in fitted])
            errors.append(error(p.t, p.y, predicted, p.segments)["nrmse"])
    return [mean([number(e) for e in column]) for column in np.array(errors).T]


# --- all sets, each in a process of its own ---


def run_all(sets: Sequence[RealSet], out: Path, jobs: int) -> None:
    """Examine the sets that have no result yet, of these recordings by this code, `jobs` at once; a set that fails has that as its result."""
    todo = [s for s in sets if not _is_done(out, s)]
    running: dict[Connection, tuple[RealSet, SpawnProcess, TaskID]] = {}  # by the end at which a set's progress arrives
    columns = TextColumn("{task.description}", markup=False), BarColumn(20), MofNCompleteColumn(), TimeElapsedColumn()
    with Progress(*columns, console=console) as progress:
        bar = progress.add_task("sets", total=len(sets), completed=len(sets) - len(todo))
        while todo or running:
            while todo and len(running) < jobs:
                one = todo.pop(0)
                running |= _started(one, out, progress.add_task(one.name, total=1))
            for receiver in cast(list[Connection], wait(list(running))):
                one, process, task = running[receiver]
                try:
                    progress.update(task, description=f"{one.name}: {receiver.recv()}")
                except EOFError:
                    process.join()
                    del running[receiver]
                    progress.remove_task(task)
                    progress.update(bar, advance=1)
                    console.print(_ended(one, out, process.exitcode), highlight=False, soft_wrap=True)


def _started(one: RealSet, out: Path, task: TaskID) -> dict[Connection, tuple[RealSet, SpawnProcess, TaskID]]:
    """A new process that examines a set, by the connection that it sends its progress to."""
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    result_file(out, one.name).unlink(missing_ok=True)
    process = context.Process(target=_worker, args=(one, out, sender), daemon=True)
    process.start()
    sender.close()  # so that the end of the process ends the connection
    return {receiver: (one, process, task)}


def _worker(one: RealSet, out: Path, sender: Connection) -> None:
    """Examine a set in this process and write its result, or why there is none."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent is interrupted, and ends its children
    try:
        found = examine(one, out, sender.send)
    except UserError as wrong:
        found = {"set": one.name, "failed": str(wrong)}
    except Exception as wrong:
        found = {"set": one.name, "failed": f"{type(wrong).__name__}: {wrong}", "traceback": traceback.format_exc()}
    write_json(result_file(out, one.name), found)
    _made(out, one).keep()


def _ended(one: RealSet, out: Path, exit_code: int | None) -> str:
    """One line on how the process of a set ended; a process that died without a result gets one."""
    file = result_file(out, one.name)
    if not file.is_file():
        how = f"was killed by signal {-exit_code}" if exit_code is not None and exit_code < 0 else f"ended with {exit_code}"
        write_json(file, {"set": one.name, "failed": f"the process {how}; signal 9 is what a system without memory sends"})
    found = read(file)
    if "failed" in found:
        return f"{one.name}: failed: {found['failed']}"
    return f"{one.name}: {VERDICTS.get(found['verdict'], found['verdict'])}, {len(found['claims'])} claims, {found['wall_s']:.0f} s"


def result_file(out: Path, name: str) -> Path:
    """Where the result of a set is."""
    return out / "sets" / f"{name}.json"


def read(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text(encoding="utf-8"))


def _is_done(out: Path, one: RealSet) -> bool:
    return _made(out, one).there and "failed" not in read(result_file(out, one.name))


def _made(out: Path, one: RealSet) -> Made:
    own = Path(__file__)
    read = [own, own.with_name("prototype_recordings.py"), one.train, *([] if one.test is None else [one.test])]
    return Made([result_file(out, one.name)], [one.name, one.variant], read)


# --- the table ---


def judged(result: Mapping[str, Any], published: Published | None) -> dict[str, Any]:
    """A result with what is published: a word for each claim, and the known effects that no claim names."""
    if published is None or "failed" in result:
        return {**result, "published": None}
    left, claims = list(published.effects), []
    for claim in result["claims"]:
        rivals = [{"joint": claim["joint"], **r} for r in claim["rivals"]]
        itself = [k for k in published.effects if k.means(claim)]
        rival = [k for k in published.effects if any(k.means(r) for r in rivals)]
        named = itself or rival[:1]  # one claim is not several effects at once
        left = [k for k in left if k not in named]
        absent = any(k.means(claim) for k in published.absent)
        word = "known" if itself else "known, as rival" if rival else "known to be absent" if absent else "not published"
        claims.append({**claim, "published": word})
    missed = [{"effect": " or ".join(k.names), "joint": k.joint} for k in left]
    return {**result, "claims": claims, "published": {"text": published.text, "missed": missed}}


def published_about(name: str, published: Mapping[str, Published]) -> Published | None:
    """What is published about a set, or else about the folder that it is a variant of."""
    return published.get(name, published.get(name.rpartition("/")[0]))


def rows(result: Mapping[str, Any]) -> list[list[str]]:
    """The rows of a set that was judged, under `HEADINGS`."""
    if "failed" in result:
        return [[result["set"], "", f"failed: {result['failed']}", *[""] * (len(HEADINGS) - 3)]]
    published = result["published"] or {"text": "", "missed": []}
    missed = [{**m, "published": "known, not claimed", "missed": True} for m in published["missed"]]
    claims, joints, nrmse = [*result["claims"], *missed], result["joints"], result["nrmse"]
    held, verdict = result["held_out"], VERDICTS.get(result["verdict"], result["verdict"])
    count = f"held out: {held['way']}, {len(held['files'])} file{'s' * (len(held['files']) != 1)}"
    means = [shown(mean(list(nrmse[m].values()))) for m in MODELS]
    cost = [f"{result['wall_s']:.0f}", f"{result['peak_memory_MB']:.0f}"]
    table = [[result["set"], f"mean of {len(joints)}", verdict, count, "", published["text"], *means, *cost]]
    for joint in (None, *joints):
        errors = [""] * len(MODELS) if joint is None else [shown(nrmse[m][joint]) for m in MODELS]
        here = [_cells(c, joint) for c in claims if _first(c["joint"], joints) == joint]
        for k, cells in enumerate(here or [[""] * 4] * (joint is not None)):
            first = k == 0
            table.append(["", joint or NONE if first else "", *cells, *(errors if first else [""] * len(MODELS)), "", ""])
    return table


def _cells(claim: Mapping[str, Any], joint: str | None) -> list[str]:
    """Claim, parameters, probability and what is published, of a claim in the row of a joint."""
    others = [j for j in _joints(claim["joint"]) if j != joint]
    word = claim["effect"].replace("_", " ") + f" with {', '.join(others)}" * bool(others)
    if claim.get("missed"):
        return [f"({word})", "", "", claim["published"]]
    some = claim["recordings"]
    values = ", ".join(
        f"{k} {_value(v['value'])} {v['unit'] if v['unit'] != '1' else ''}".strip() for k, v in claim["parameters"].items()
    )
    depends = f"depends on {', '.join(claim['depends_on'])}" if claim["depends_on"] else ""
    word += "" if some in ("all", "each") else f" in {some} recordings"
    return [word, values or depends, chance(claim), claim.get("published", "")]


def chance(claim: Mapping[str, Any]) -> str:
    """The probability that a claim states, or else its p-value, or nothing."""
    if claim["probability"] is not None:
        return f"{claim['probability']:.3f}" if claim["probability"] < SURE else f"> {SURE}"
    p = claim["p_value"]
    return "" if p is None else f"p = {p:.0e}" if p * LARGEST > 1 else f"p < {1 / LARGEST:.0e}"


def _value(value: Any) -> str:
    if isinstance(value, list):
        return f"[{', '.join(map(_value, value))}]"
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def shown(value: float | None) -> str:
    """An NRMSE."""
    return NONE if value is None else f"{value:.3f}"


def _joints(joint: str | Sequence[str] | None) -> list[str]:
    """A joint, several or none, to compare by."""
    return [] if joint is None else [joint] if isinstance(joint, str) else sorted(joint)


def _first(joint: Any, joints: Sequence[str]) -> str | None:
    """The joint in whose row a claim stands: its own, which comes first; None for what belongs to none."""
    named = [joint] if isinstance(joint, str) else list(joint or [])
    return named[0] if named and named[0] in joints else None


def totals(results: Sequence[Mapping[str, Any]]) -> dict[str, int]:
    """How many claims are what is published, and how many known effects no claim names, over the sets with anything published."""
    with_words = [r for r in results if r["published"] is not None]
    words = Counter(c["published"] for r in with_words for c in r["claims"])
    missed = sum(len(r["published"]["missed"]) for r in with_words)
    return {
        **{word: words[word] for word in ("known", "known, as rival", "known to be absent", "not published")},
        "known, not claimed": missed,
        "sets": len(with_words),
    }


def report(results: Sequence[Mapping[str, Any]]) -> str:
    """The table in Markdown, with a legend."""
    cells = [[cell.replace("\n", " ") for cell in row] for r in results for row in rows(r)]
    for row in cells:
        row[0] = f"**{row[0]}**" if row[0] else ""
    headings = [f"NRMSE {h}" if h in MODELS else h for h in HEADINGS]
    failed = sum("failed" in r for r in results)
    intro = f"{len(results)} sets of recordings, {failed} of them failed.\n"
    return "\n".join(
        ["# Recordings of real arms diagnosed\n", intro, markdown(headings, cells), LEGEND, in_words(totals(results))]
    )


def in_words(count: Mapping[str, int]) -> str:
    """The totals in a sentence."""
    if not count["sets"]:
        return "Nothing is published about these sets, or no file says so.\n"
    numbers = "; ".join(f"{word}: {number}" for word, number in count.items() if word != "sets")
    return f"Claims by what is published: {numbers}. Sets about which something is published: {count['sets']}.\n"


def table(results: Sequence[Mapping[str, Any]]) -> Table:
    """The table for the console."""
    result = Table(pad_edge=False, padding=(0, 1, 0, 0))
    for heading in WORDS:
        result.add_column(heading, overflow="fold")
    for heading in HEADINGS[len(WORDS) :]:
        result.add_column(heading.replace(" [", "\n["), justify="right", no_wrap=True)
    for r in results:
        for row in rows(r):
            result.add_row(*row, style="bold" if row[0] else None)
        result.add_section()
    return result


def main(
    folder: Annotated[Path, typer.Argument(help="a recording set, or a folder with sets below it")],
    out: Annotated[Path, typer.Option(help="folder of the results")] = Path("results/real_arms"),
    only: Annotated[list[str] | None, typer.Option(help="only the set of this name; may be given several times")] = None,
    published: Annotated[Path | None, typer.Option(help="what is known; default: published.json in FOLDER, if there")] = None,
    jobs: Annotated[int, typer.Option(min=1, help="sets at once, each in a process of its own")] = 1,
) -> None:
    """Diagnose recordings of real arms blind; writes sets/<set>.json, diagnoses/<set>/, summary.json and report.md."""
    check_folder(out)
    if published is None and (folder / "published.json").is_file():
        published = folder / "published.json"
    known = {} if published is None else read_json(published, dict[str, Published])
    sets = chosen(sets_below(folder, out), only or [])
    run_all(sets, out, jobs)
    results = [judged(read(result_file(out, s.name)), published_about(s.name, known)) for s in sets]
    write_json(out / "summary.json", {"sets": results, "totals": totals(results)})
    write_text(out / "report.md", report(results))
    console.print(table(results))
    console.print(in_words(totals(results)), highlight=False, soft_wrap=True)
    console.print(f"{out / 'report.md'} explains the columns; everything is in {out}.", highlight=False, soft_wrap=True)


run = entry_point(lambda: typer.run(main))

if __name__ == "__main__":
    run()
