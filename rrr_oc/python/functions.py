"""From recordings or a task to results, by the commands of `rrr-oc`.

A folder that is not given is a temporary one, which goes with the result.
"""

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

from rrr_oc.commands import load as command
from rrr_oc.commands import run
from rrr_oc.commands.output import progress_alone
from rrr_oc.errors import UserError, meant
from rrr_oc.python.results import (
    Comparison,
    Design,
    Diagnosis,
    Export,
    Model,
    Recordings,
    Result,
    Simulation,
    Temporary,
)
from rrr_oc.recordings.header import HEADER
from rrr_oc.recordings.reader import load_recordings
from rrr_oc.storage import read_utf8, write_json

Place = str | Path
R = TypeVar("R", bound=Result)
CHANGED = "changed_task.json"  # in the folder of a design: the task with the values that were changed
KINDS = {HEADER: "recordings", "diagnosis.json": "a diagnosis", "summary.json": "a design", "model.json": "a model"}


def load(path: Place) -> Result:
    """What a folder holds: recordings, a diagnosis, a design or a model; or the model of a file model.json.

    Raises `UserError` where it holds none of them, and where they are damaged.
    """
    path = Path(path)
    folder = path if path.is_dir() else path.parent
    if path.name != "model.json" and (folder / HEADER).is_file():
        return Recordings(folder, load_recordings(folder))
    made = {"diagnosis.json": Diagnosis, "summary.json": Design, "model.json": Model}
    for name, result in made.items():
        if (path == folder or path.name == name) and (folder / name).is_file():
            return result(folder, json.loads(read_utf8(folder / name)))
    raise UserError(f"{path}: nothing to load; allowed is a folder with {', '.join(f'{k} ({v})' for k, v in KINDS.items())}")


def calibrate(recordings: Place | Recordings, out: Place | None = None, **options: Any) -> Model:
    """A calibrated model of recordings, by `rrr-oc calibrate`.

    Args:
        recordings: A folder with recordings.json, or what `load` made of it.
        out: Folder for model.json.
        options: Those of the command, as `way="response"`.
    """
    return _run(Model, "calibrate", [_path(recordings)], out, options)


def diagnose(recordings: Place | Recordings, out: Place | None = None, **options: Any) -> Diagnosis:
    """Which physics a calibrated model of recordings lacks, by `rrr-oc diagnose`.

    Args:
        recordings: A folder with recordings.json, or what `load` made of it.
        out: Folder for diagnosis.json, model.json, report.html and figures.
        options: Those of the command, as `simulate=False`, `priors="priors.toml"`, `jobs=2`.
    """
    return _run(Diagnosis, "diagnose", [_path(recordings)], out, options)


def design(task: Place, out: Place | None = None, changed: Mapping[str, Any] | None = None, **options: Any) -> Design:
    """Springs and motion of a task, by `rrr-oc design`.

    Args:
        task: A bundled task, or a file with a task or a set of tasks.
        out: Folder for report.html, summary.json, figures and motions.
        changed: Keys of the task with other values, such as {"payload_kg": 2.0}.
        options: Those of the command, as `configurations="SA,PEA"`, `starts=6`, `model="diagnosis/model.json", repaired=True`.
    """
    if not changed:
        return _run(Design, "design", [task], out, options)
    temporary, folder = _folder("design", out)
    base = str(Path(task).absolute()) if Path(task).is_file() else str(task)
    name = f"{Path(task).stem} with {', '.join(f'{key} = {value}' for key, value in changed.items())}"
    write_json(folder / CHANGED, {"format": "rrr_oc-tasks/1", "base": base, "tasks": [{"name": name, **changed}]})
    return replace(_run(Design, "design", [folder / CHANGED], folder, options), temporary=temporary)


def simulate(
    model: Place | Model | Diagnosis, recordings: Place | Recordings, out: Place | None = None, **options: Any
) -> Simulation:
    """What a model in MuJoCo does while it tracks recordings, by `rrr-oc simulate`.

    Args:
        model: The file model.json of a calibration or diagnosis, or such a result.
        recordings: A folder with recordings.json, or what `load` made of it.
        out: Folder for one CSV a recording.
        options: Those of the command.
    """
    return _run(Simulation, "simulate", [_model(model), _path(recordings)], out, options)


def export(model: Place | Model | Diagnosis | None, out: Place, **options: Any) -> Export:
    """A model as MJCF for plain MuJoCo and as URDF, by `rrr-oc export`.

    Args:
        model: The file model.json of a calibration or diagnosis, or such a result; None for the arm of `task` with the springs of `design`.
        out: Folder for arm.xml and arm.urdf.
        options: Those of the command, as `payload=1.0`, or `design="design/summary.json", configuration="PEA", task="task.json"`.
    """
    return _run(Export, "export", [] if model is None else [_model(model)], out, options)


def compare(*compared: Place | Model | Diagnosis | Design, out: Place | None = None) -> Comparison:
    """What differs between two diagnoses or models by more than its error, between two designs, or in a fleet, by `rrr-oc compare`.

    Args:
        compared: Two or more, each a result, or its folder or file; a model may be compared with a diagnosis. More than two are diagnoses.
        out: Folder for fleet.html, the page of any number of diagnoses.
    """
    places = [str(one.folder if isinstance(one, Result) else one) for one in compared]
    with progress_alone() as results:
        run(["compare", *places, *(["--out", str(out)] if out else [])])
    return Comparison(Path(out or places[-1]), results[-1])


def _path(recordings: Place | Recordings) -> Path:
    return recordings.folder if isinstance(recordings, Recordings) else Path(recordings)


def _model(model: Place | Model | Diagnosis) -> Path:
    return model.folder / "model.json" if isinstance(model, Model | Diagnosis) else Path(model)


def _folder(name: str, out: Place | None) -> tuple[Temporary | None, Path]:
    """The folder of results, and as what it is kept where it is a temporary one."""
    temporary = Temporary(name) if out is None else None
    return temporary, Path(str(out)) if temporary is None else temporary.path


def _run(kind: type[R], name: str, read: list[Any], out: Place | None, options: Mapping[str, Any]) -> R:
    """The result of a command. Raises `UserError` for unknown options and for what the command refuses."""
    temporary, folder = _folder(name, out)
    words = [name, *map(str, read), "--out", str(folder), *_words(name, options)]
    with progress_alone() as results:
        run(words)
    return kind(folder, results[-1], temporary)


def _words(name: str, options: Mapping[str, Any]) -> list[str]:
    """Options of a command as they are typed."""
    known = {p.name: p for p in command(name).params if p.param_type_name == "option" and p.name not in ("out", "as_json")}
    words = []
    for key, value in options.items():
        if key not in known:
            raise UserError(f"{name}: unknown option {key!r}; allowed are {', '.join(known)}{meant(key, known)}")
        if value is None:
            continue
        if known[key].is_flag:
            words += (known[key].opts if value else known[key].secondary_opts)[:1]
            continue
        several = isinstance(value, list | tuple)
        words += [known[key].opts[0], ",".join(map(str, value)) if several else str(value)]
    return words
