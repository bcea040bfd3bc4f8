"""What the functions return: the content of the files that a command writes, as it is said at the console, as a table, and drawn.

Every result has a short `repr`, an `_repr_html_` for notebooks, `to_dataframe()` and, but for exports and comparisons, `plot()`. Tables
have the units of the console, in their columns' names or in a column of their own; angles of springs and laws are in degrees.
"""

import html
import shutil
import weakref
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from io import BytesIO
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import msgspec
import numpy as np

from rrr_oc.calibration.calibrated_model import CalibratedModel
from rrr_oc.calibration.model_file import load_model
from rrr_oc.codesign.design_file import Configuration, DesignFile
from rrr_oc.diagnosis.diagnosis_file import DiagnosisFile
from rrr_oc.effects.words import joint_words, listed, words
from rrr_oc.errors import UserError
from rrr_oc.model.metrics import decrease
from rrr_oc.recordings.recording import RecordingSet
from rrr_oc.report import design_words, diagnosis_words
from rrr_oc.report.design_figures import draw_torques, read_motions
from rrr_oc.report.diagnosis_figures import draw_prediction
from rrr_oc.report.figures import COLOURS, plt, save_figure
from rrr_oc.report.tables import spring_unit
from rrr_oc.schema import built
from rrr_oc.storage import read_npz, read_utf8

Rows = tuple[list[str], list[list[Any]]]  # names of the columns, and their values row by row


class Temporary:
    """A folder that goes when nothing refers to it any more, and with the program."""

    def __init__(self, name: str) -> None:
        self.path = Path(mkdtemp(prefix=f"rrr-oc-{name}-"))
        weakref.finalize(self, shutil.rmtree, self.path, ignore_errors=True)


@dataclass(frozen=True)
class Picture:
    """A drawing, which notebooks show; `figure` is matplotlib's."""

    figure: Any

    def save(self, path: str | Path) -> Path:
        """Write it to a file, in the format of its name."""
        return save_figure(self.figure, Path(path))

    def _repr_png_(self) -> bytes:
        file = BytesIO()
        self.figure.savefig(file, format="png", dpi=110, bbox_inches="tight")
        plt.close(self.figure)
        return file.getvalue()


@dataclass(frozen=True, repr=False, eq=False)
class Result:
    """A result.

    Attributes:
        folder: Where its files are.
        content: What it is made of: the content of its file, in SI units.
        temporary: The folder, where it goes with the result; None for one that was given.
    """

    folder: Path
    content: Any
    temporary: Temporary | None = None

    @property
    @abstractmethod
    def said(self) -> str:
        """The result in a sentence or two."""

    @abstractmethod
    def table(self) -> Rows:
        """Names of columns, and rows."""

    def to_dataframe(self) -> Any:
        """The result as a `pandas.DataFrame`; raises `UserError` where pandas is not installed."""
        try:
            pandas = import_module("pandas")
        except ImportError:
            raise UserError(
                "to_dataframe needs the package pandas, which is not installed; table() gives the same without"
            ) from None
        columns, rows = self.table()
        return pandas.DataFrame(rows, columns=columns)

    def __repr__(self) -> str:
        first = self.said.split(". ")[0].removesuffix(".")
        return f"<{type(self).__name__} in {self.folder}: {first}>"

    def _repr_html_(self) -> str:
        columns, rows = self.table()
        head = "".join(f"<th>{html.escape(name)}</th>" for name in columns)
        body = "".join(f"<tr>{''.join(f'<td>{html.escape(_shown(x))}</td>' for x in row)}</tr>" for row in rows[:SHOWN])
        more = f"<p>{len(rows) - SHOWN} more rows</p>" * (len(rows) > SHOWN)
        return f"<p>{html.escape(self.said)}</p><table><tr>{head}</tr>{body}</table>{more}"


SHOWN = 30  # rows of a table in a notebook


def _shown(value: Any) -> str:
    return "–" if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)


class Recordings(Result):
    """A recording set; `content` is a `RecordingSet`. Its table has every sample, with the names and units of the CSV files."""

    content: RecordingSet

    @property
    def said(self) -> str:
        every = self.content.recordings
        seconds = sum(float(r.t[-1] - r.t[0]) for r in every)
        return f"{len(every)} recordings of {listed(self.content.joints)}, {seconds:.1f} s, {self.content.torque} torque"

    def table(self) -> Rows:
        joints, unit = self.content.joints, "A" if self.content.torque == "current" else "Nm"
        signals = {"q": "rad", "dq": "rad/s", "ddq": "rad/s²", "tau": unit}
        names = [f"{signal}_{joint} [{of}]" for signal, of in signals.items() for joint in joints]
        rows = []
        for r in self.content.recordings:
            values = np.vstack([r.t, *(getattr(r, signal) for signal in signals), r.payload]).T
            rows += [[r.file, *row] for row in values.tolist()]
        return ["recording", "t [s]", *names, "payload [kg]"], rows

    def plot(self, file: str | None = None) -> Picture:
        """Angles and torques of a recording over time; by default of the first."""
        every = {r.file: r for r in self.content.recordings}
        if file is not None and file not in every:
            raise UserError(f"{self.folder}: has no recording {file!r}; there are {', '.join(every)}")
        r = every[file] if file else self.content.recordings[0]
        figure, axes = plt.subplots(2, 1, figsize=(9, 5), sharex=True, layout="constrained")
        for axis, values, label in ((axes[0], np.degrees(r.q), "angle [°]"), (axes[1], r.tau, "torque [Nm]")):
            for row, joint, colour in zip(values, self.content.joints, _colours(len(values)), strict=True):
                axis.plot(r.t - r.t[0], row, lw=1, color=colour, label=joint)
            axis.set_ylabel(label if self.content.torque != "current" or "angle" in label else "current [A]")
        axes[0].legend(fontsize=8)
        axes[0].set_title(r.file, fontsize=10, loc="left")
        axes[1].set_xlabel("time [s]")
        return Picture(figure)


class Model(Result):
    """A calibrated model: the content of model.json."""

    @cached_property
    def model(self) -> CalibratedModel:
        """The model itself."""
        return load_model(self.folder / "model.json")

    @property
    def said(self) -> str:
        errors = [f"{100 * x:.3g} % of {joint}'s" for joint, x in zip(self.model.joints, self.model.nrmse, strict=True)]
        return f"{len(self.model.terms)} effects; the error is {listed(errors)} torque (standard deviations)"

    def table(self) -> Rows:
        rows = []
        for term in self.model.terms:
            joints = ", ".join(self.model.joints[j] for j in term.effect.joints)
            for parameter, e in zip(term.effect.parameters, term.estimates, strict=True):
                rows.append([term.effect.name, joints, parameter.name, *_in_degrees(e.value, e.interval, parameter.unit)])
        return ["effect", "joint", "parameter", "value", "low", "high", "unit"], rows

    def plot(self) -> Picture:
        """Error of each joint's torque over the recorded one's standard deviation."""
        figure, axis = plt.subplots(figsize=(6, 0.4 * len(self.model.joints) + 1), layout="constrained")
        axis.barh(self.model.joints, 100 * np.array(self.model.nrmse), color=COLOURS[0])
        axis.invert_yaxis()
        axis.set_xlabel("error of the torque [% of its standard deviation]")
        return Picture(figure)


class Diagnosis(Result):
    """A diagnosis: the content of diagnosis.json. Its table has a row for each parameter of what is missing."""

    @cached_property
    def file(self) -> DiagnosisFile:
        """The content, typed."""
        return built(self.content, DiagnosisFile)

    @property
    def said(self) -> str:
        return diagnosis_words.sentence(self.file)

    @cached_property
    def model(self) -> Model:
        """The repaired model."""
        return Model(self.folder, None, self.temporary)

    def table(self) -> Rows:
        rows = []
        for e in diagnosis_words.missing(self.file):
            lowered = e.lowers_error
            size = [e.probability, lowered.joint, 100 * lowered.share, ", ".join(e.indistinguishable_from)]
            joint = listed([joint_words(one) for one in diagnosis_words.joints_of(e)])
            for name, entry in e.parameters.items():
                rows.append([words(e.effect), joint, name, *_in_degrees(entry.value, entry.interval, entry.unit), *size])
        for link in self.file.link_findings:
            fall, others = link.lowers_error, ", ".join(link.indistinguishable_from or ())
            size = [link.probability, *([fall.joint, 100 * fall.share] if fall else [None, None])]
            for d in link.directions:
                rows.append([f"link {link.link}", d.joint, words(d.quantity), d.value, *d.interval, d.unit, *size, others])
        header = ["what is missing", "joint", "parameter", "value", "low", "high", "unit", "probability"]
        return [*header, "lowers the error of", "by [%]", "as good"], rows

    def plot(self) -> Picture:
        """Torques of the recording that the plain model predicts worst, recorded and predicted without and with what was found."""
        return Picture(draw_prediction(read_npz(self.folder / "figures.npz")))


class Design(Result):
    """Designs of a task or a set of tasks: the content of summary.json. Its table has a row for each configuration."""

    @cached_property
    def study(self) -> DesignFile:
        """The content, typed."""
        return msgspec.convert(self.content, DesignFile)

    @property
    def said(self) -> str:
        return design_words.verdict(self.study)

    def __getitem__(self, name: str) -> Configuration:
        """A configuration, such as "PEA"; raises `UserError` for one that was not designed."""
        if name not in self.study.configurations:
            raise UserError(f"{self.folder}: has no configuration {name!r}; there are {', '.join(self.study.configurations)}")
        return self.study.configurations[name]

    def table(self) -> Rows:
        found, stiff = self.study.configurations, self.study.configurations.get("SA")
        springs = list(dict.fromkeys(name for c in found.values() for name in c.springs))
        rows = []
        for name, c in found.items():
            less = None if stiff is None or name == "SA" else 100 * float(decrease(c.cost, stiff.cost))
            seconds = [sum(moved.durations.values()) for moved in c.tasks.values()]
            own = [c.springs[s] * spring_unit(s)[1] if s in c.springs else None for s in springs]
            rows.append([name, c.cost, less, sum(seconds), *own])
        units = [f"{s} [{spring_unit(s)[2]}]" for s in springs]
        return ["configuration", self.study.quantity.title, "less than SA [%]", "duration [s]", *units], rows

    def plot(self) -> Picture:
        """Torque over time without and with springs; raises `UserError` for a set of tasks."""
        if not self.study.single:
            raise UserError(f"{self.folder}: is a design for {len(self.study.tasks)} tasks; plot() draws that of one")
        return Picture(draw_torques(self.study, read_motions(self.folder, self.study)))


class Simulation(Result):
    """Errors of a model in MuJoCo that tracks recordings; its folder has one CSV a recording."""

    @property
    def said(self) -> str:
        mean = self.content["mean"]["simulated"]
        errors = [f"{_percent(found['tau_motor']['nrmse'])} of {joint}'s" for joint, found in mean.items()]
        return f"{len(self.content['simulated'])} recordings; the error is {listed(errors)} motor torque (standard deviations)"

    def table(self) -> Rows:
        rows = [
            [file, joint, signal, error["nrmse"], error["rmse"]]
            for file, joints in self.content["simulated"].items()
            for joint, signals in joints.items()
            for signal, error in signals.items()
        ]
        return ["recording", "joint", "signal", "NRMSE", "RMSE [SI]"], rows

    def plot(self, file: str | None = None) -> Picture:
        """Simulated angles over time; by default of the first recording."""
        files = list(self.content["simulated"])
        if file is not None and file not in files:
            raise UserError(f"{self.folder}: has no recording {file!r}; there are {', '.join(files)}")
        path = self.folder / (file or files[0])
        names, *lines = read_utf8(path).decode().splitlines()
        columns = dict(zip(names.split(","), np.loadtxt(lines, delimiter=",", ndmin=2).T, strict=True))
        figure, axis = plt.subplots(figsize=(9, 3), layout="constrained")
        joints = [name for name in columns if name.startswith("q_")]
        for name, colour in zip(joints, _colours(len(joints)), strict=True):
            axis.plot(columns["t"], np.degrees(columns[name]), lw=1, color=colour, label=name.removeprefix("q_"))
        axis.set(xlabel="time [s]", ylabel="simulated angle [°]")
        axis.legend(fontsize=8)
        return Picture(figure)


class Comparison(Result):
    """Diagnoses, models or designs side by side; `folder` is the last one's, or that of the page. Its table has a row for each number that
    differs, or agrees, and of a fleet one for each arm."""

    @property
    def said(self) -> str:
        return self.content["said"]

    def table(self) -> Rows:
        if self.content["kind"] == "designs":
            return self._of_designs()
        if self.content["kind"] == "fleet":
            arms = self.content["arms"]
            return list(arms[0]), [list(arm.values()) for arm in arms]
        rows = []
        for one in self.content["changes"]:
            factor, unit = diagnosis_words.DEGREES.get(one["unit"], (1.0, one["unit"]))
            numbers = [factor * one["a"], factor * one["b"], factor * (one["b"] - one["a"])]
            joints = ", ".join(one["joints"])
            rows.append([one["effect"], joints, one["parameter"], *numbers, unit.strip(), one["sigmas"], one["changed"]])
        header = ["effect", "joint", "parameter", "A", "B", "B − A", "unit", "in standard errors", "changed"]
        return header, rows

    def _of_designs(self) -> Rows:
        rows = []
        for name, pair in self.content["configurations"].items():
            rows += [
                [name, self.content["cost"], self.content["unit"], *pair["cost"]],
                [name, "duration", "s", *pair["seconds"]],
            ]
            for spring, both in pair["springs"].items():
                _, factor, unit = spring_unit(spring)
                rows.append([name, spring, unit, *(None if x is None else factor * x for x in both)])
        return ["configuration", "quantity", "unit", "A", "B"], rows


class Export(Result):
    """Files for other programs, and what they do not hold."""

    @property
    def mjcf(self) -> str:
        """Path of the MJCF."""
        return self.content["mjcf"]

    @property
    def urdf(self) -> str | None:
        """Path of the URDF; None for an arm without a model."""
        return self.content.get("urdf")

    @property
    def samples(self) -> list[str]:
        """Paths of the MJCF of drawn arms; beside each lies its model, with the ending .json."""
        return self.content.get("samples", [])

    @property
    def said(self) -> str:
        left = self.content["not_in_mjcf"]
        return listed([f for f in (self.mjcf, self.urdf) if f]) + f"; not in the MJCF: {'; '.join(left)}" * bool(left)

    def table(self) -> Rows:
        files = [[kind, self.content[kind]] for kind in ("mjcf", "urdf", "into") if kind in self.content]
        files += [["drawn arm", path] for path in self.samples]
        return ["what", "file or reason"], [*files, *(["not in mjcf", reason] for reason in self.content["not_in_mjcf"])]


def _in_degrees(value: Any, interval: Sequence[float] | None, unit: str) -> list[Any]:
    """Value, ends of the 95 % interval and unit of an estimate, angles in degrees; None where there is none."""
    factor, shown = diagnosis_words.DEGREES.get(unit, (1.0, unit))
    return [*(x * factor if isinstance(x, float) else x for x in (value, *(interval or (None, None)))), shown.strip()]


def _percent(value: float | None) -> str:
    return "–" if value is None else f"{100 * value:.3g} %"


def _colours(count: int) -> list[str]:
    return [COLOURS[i % len(COLOURS)] for i in range(count)]
