"""Is every damaged input read, or refused in one sentence?

    python validation/fuzz_inputs.py --inputs 10000 --out results/fuzz

Right files are changed at random: robot files (URDF and MJCF), tasks, headers and CSV files of recordings, calibrated models, and the options
of commands. Each changed input is given to the reader that the commands use, in this process; of a command everything up to its long
computation runs. There are three outcomes:

    read      without a warning of Python, to finite numbers
    refused   by a `UserError` of one sentence, without words of the program's insides
    fault     anything else, also a reader that takes longer than `LONGEST`

Input i follows from the seed and i alone: an interrupted run goes on where it was, and `--only KIND:I` shows one input and its outcome.
The counts and all faults are in out/fuzz.json, the table in out/fuzz.md.
"""

import contextlib
import importlib.resources
import io
import json
import re
import signal
import sys
import tempfile
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from copy import deepcopy
from pathlib import Path
from typing import Annotated, Any
from unittest.mock import patch

import numpy as np
import typer

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from rrr_oc.calibration.inverse_dynamics import plain_model
from rrr_oc.calibration.model_file import load_model, save_model
from rrr_oc.codesign.springs import configurations, spring_bounds
from rrr_oc.codesign.task import load_task
from rrr_oc.commands import load
from rrr_oc.commands.init import write_example
from rrr_oc.errors import UserError, entry_point
from rrr_oc.recordings.reader import load_recordings
from rrr_oc.recordings.writer import write_set
from rrr_oc.report.tables import markdown
from rrr_oc.robot.robot import arm_of, load_robot, urdf_text
from rrr_oc.schema import parsed
from rrr_oc.storage import write_json, write_text

LONGEST = 30  # [s] of one input
WORDIEST = 1200  # characters of a sentence; lists of names of large robots are long
INSIDES = re.compile(r"Traceback|Error:|<class|object at 0x|\bNone\b|[Ee]rrno|std::|site-packages|mjXError")
KEPT_EVERY = 100  # inputs after which what was found is written
NUMBERS = [0, -1, 1, 3, 0.5, -1e-9, 1e-300, 5e-324, 1e9, 1e10, 1e300, -1e300, 10**400, float("inf"), float("nan")]
TEXTS = [
    "",
    " ",
    "joint1",
    "joint2",
    "elbow",
    "rrr",
    "all",
    "0.csv",
    "below",
    "../0.csv",
    "/dev/zero",
    "\x1b[2J",
    "٣",
    "\ud800",
    "ä" * 3000,
]
VALUES = [None, True, False, [], {}, [[]], [None], {"": None}, [[[[[[]]]]]], *NUMBERS, *TEXTS]
WORDS = [
    "",
    "nan",
    "0,5",
    "-1",
    "0",
    "1e300",
    "1e-320",
    "inf",
    "x",
    "1 2 3",
    "0 0 0",
    "1 2",
    "-0",
    "1e6",
    "true",
    "&amp;",
    "\x7f",
    "🙂",
    "9" * 400,
]
CELLS = [
    "nan",
    "",
    "inf",
    "1_0",
    "٣",
    "1e400",
    "-1e300",
    "1e12",
    "0",
    "x",
    '"1"',
    "1;2",
    "#",
    "\0",
    "1,1",
    "true",
    "1e-320",
    "- 1",
    "0x1",
]
# Bodies that are turned, a joint away from its body's origin, one whose zero is elsewhere (ref), a fixed body with mass, masses
# from geoms and as tensors, and a mesh that is not there.
MJCF = """<mujoco model="arm">
  <compiler angle="degree"/>
  <option gravity="1 -0.5 -9"/>
  <asset><mesh name="gone" file="gone.stl"/><material name="grey" rgba=".5 .5 .5 1"/></asset>
  <default><joint armature="0.1" damping="2"/><default class="light"><geom density="300"/></default></default>
  <worldbody>
    <geom type="mesh" mesh="gone"/>
    <body name="base" pos="0.1 0.2 0.3" euler="0 90 20">
      <inertial pos="0 0 0" mass="3" diaginertia="1 1 1"/>
      <body name="upper" pos="0 0 0.1" euler="10 20 30">
        <joint name="shoulder" axis="0 1 1" range="-100 120" frictionloss="0.3"/>
        <inertial pos="0.01 0.02 0.2" mass="4" fullinertia="0.05 0.06 0.03 0.001 0.002 -0.003"/>
        <geom type="mesh" mesh="gone" material="grey"/>
        <body name="fore" pos="0 0 0.4" quat="0.8 0.6 0 0">
          <joint name="elbow" axis="0 1 0" pos="0.03 0 0.02" ref="25" stiffness="3"/>
          <geom class="light" type="box" size="0.03 0.04 0.2" pos="0 0.01 0.2" mass="2"/>
          <body name="bracket" pos="0 0 0.1" euler="0 0 45"><geom size="0.05" mass="0.5" pos="0.1 0 0"/></body>
          <body name="hand" pos="0 0.02 0.4">
            <joint name="wrist" axis="1 0 0"/>
            <geom type="capsule" size="0.03 0.1" pos="0 0 0.05" mass="0.7"/>
            <site name="attachment_site" pos="0.01 0.02 0.15"/>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="servo" joint="shoulder" kp="100" gear="50" forcerange="-2 1.5"/>
    <motor joint="elbow" gear="-30" ctrlrange="-2 2"/>
  </actuator>
</mujoco>
"""
BUNDLED = importlib.resources.files("rrr_oc.data")
HEADER = {  # with everything that a header may hold
    "format": "rrr_oc-recordings/1", "robot": "rrr", "joints": ["joint1", "joint2", "joint3"], "gravity": [0.0, 0.0, -9.81],
    "tool": {"link": "link3", "position": [0.3, 0.0, 0.0]}, "actuators": {"joint2": {"torque_constant": 12.34}}, "inertial": "identify",
    "recordings": [
        {"file": "0.csv", "payload": 5.0, "group": "first", "springs": {
            "pea": {"joint2": {"stiffness_Nm_per_rad": 13.7, "equilibrium_rad": 1.9, "active": "below"}},
            "bpea": {"stiffness_Nm_per_rad": 11.0, "equilibrium_rad": -1.2, "radius1_m": 0.015, "radius2_m": 0.036, "radius3_m": 0.014,
                     "joints": ["joint2", "joint3"]}}},
    ],
}  # fmt: skip


class Reached(Exception):
    """The long computation of a command, which is not begun."""


class Random:
    """Random choices of one input."""

    def __init__(self, seed: int, kind: str, index: int) -> None:
        self.rng = np.random.default_rng([seed, sum(kind.encode()), index])

    def one(self, choices: Any) -> Any:
        """One of several things."""
        every = list(choices)
        return every[int(self.rng.integers(len(every)))]

    def upto(self, most: int) -> int:
        """A whole number from 0 to `most`."""
        return int(self.rng.integers(most + 1))


def damaged(r: Random, data: bytes) -> bytes:
    """A file that is cut off, has a few bytes changed, or is in another encoding."""
    change = r.upto(5)
    if change == 0:
        return data[: r.upto(len(data))]
    if change == 1:
        text = data.decode(errors="replace")
        return text.encode(r.one(["utf-8-sig", "utf-16", "utf-32", "latin-1"]), errors="replace")
    found = bytearray(data)
    for _ in range(1 + r.upto(3)):
        at = r.upto(len(found) - 1)
        if change < 4:
            found[at] = r.upto(255)
        elif change == 4:
            del found[at : at + 1 + r.upto(20)]
        else:
            found[at:at] = r.one([b"\0", b"<", b">", b'"', b"{", b"[", b",", b"\xff", b"1e999", b"//", b"<!--", b"&x;"])
        if not found:
            break
    return bytes(found)


def changed_xml(r: Random, text: str) -> bytes:
    """XML with values replaced, attributes and elements removed, doubled, renamed or put elsewhere, and sometimes broken."""
    for _ in range(1 + r.upto(2)):
        change, lines, parts = r.upto(7), text.splitlines(), text.split('"')
        at, row = 2 * r.upto(max(len(parts) // 2 - 1, 0)) + 1, r.upto(len(lines) - 1)
        if change <= 2 and len(parts) > 2:
            parts[at] = r.one([*WORDS, *parts[1::2]])
            text = '"'.join(parts)
        elif change == 3 and len(parts) > 2:
            attributes = list(re.finditer(r'\s[\w:]+="[^"]*"', text))
            found = r.one(attributes) if attributes else None
            text = text if found is None else text[: found.start()] + text[found.end() :]
        elif change == 4:
            text = "\n".join([*lines[:row], *([lines[row]] * (2 * r.upto(1))), *lines[row + 1 :]])
        elif change == 5:
            elements = list(re.finditer(r"<[^<>]+/>", text))
            found, where = (r.one(elements), r.one(elements)) if elements else (None, None)
            if found is not None and where is not None:
                text = text[: where.end()] + found[0] + text[where.end() :]
        elif change == 6:
            names = sorted(set(re.findall(r"</?(\w+)", text)))
            text = text.replace(r.one(names), r.one([*names, "x", "include", "joint", "link"]), 1) if names else text
        elif len(parts) > 2:
            parts[at] = " ".join(_scaled(r, word) for word in parts[at].split(" "))
            text = '"'.join(parts)
    data = text.encode(errors="surrogatepass")
    return damaged(r, data) if r.upto(9) == 0 else data


def _scaled(r: Random, word: str) -> str:
    try:
        return repr(float(word) * r.one([-1, 0, 1e-3, 1e3, 1e9, 1e-12]))
    except ValueError:
        return word


def places(data: Any, path: tuple = ()) -> list[tuple]:
    """The paths to all values inside plain data."""
    inside = data.items() if isinstance(data, dict) else enumerate(data) if isinstance(data, list) else ()
    return [path, *(place for key, value in inside for place in places(value, (*path, key)))]


def changed_data(r: Random, right: Any) -> Any:
    """Plain data with a few values replaced, removed, added, doubled, scaled, renamed or exchanged."""
    data = deepcopy(right)
    for _ in range(1 + r.upto(2)):
        paths = places(data)[1:]
        if not paths:
            break
        path = r.one(paths)
        place, key = _inside(data, path[:-1]), path[-1]
        value, change = place[key], r.upto(15)
        if change > 7:  # mild, so that many of the files are read
            scaled = isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e300
            place[key] = r.one([-value, 0.9 * value, 1.5 * value, value + 0.1]) if scaled else value
        elif change == 0:
            del place[key]
        elif change == 1 and isinstance(value, dict):
            value[r.one(["payload", "comment", "joint1", "x", "\x00", "gravity"])] = deepcopy(r.one(VALUES))
        elif change == 2 and isinstance(value, list) and value:
            value.append(deepcopy(r.one(value)))
        elif change == 3 and isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e300:
            place[key] = r.one([-value, 1e3 * value, 1e-3 * value, value + 1, 1e9 * value])
        elif change == 4 and isinstance(place, dict):
            place[r.one([str(key).upper(), f"{key}_", "joint9"])] = place.pop(key)
        elif change == 5:
            place[key] = deepcopy(_inside(data, r.one(paths)))
        else:
            place[key] = deepcopy(r.one(VALUES))
    return data


def _inside(data: Any, path: tuple) -> Any:
    for key in path:
        data = data[key]
    return data


def changed_json(r: Random, right: Any) -> bytes:
    """The text of changed data, which is sometimes damaged as well."""
    data = json.dumps(changed_data(r, right), ensure_ascii=bool(r.upto(1))).encode(errors="surrogatepass")
    return damaged(r, data) if r.upto(9) == 0 else data


def changed_csv(r: Random, text: str) -> bytes:
    """A table with cells, rows and columns changed, with other separators, and sometimes damaged."""
    rows = [line.split(",") for line in text.splitlines()[: r.one([4, 40, *[10**6] * 4])]]
    for _ in range(r.upto(2)):
        change, row, column = r.upto(7), r.upto(len(rows) - 1), r.upto(max(len(rows[0]) - 1, 0))
        if change <= 2 and rows[row]:
            rows[row][r.upto(len(rows[row]) - 1)] = r.one([*CELLS, *rows[row]])
        elif change == 3:
            rows.insert(row, list(r.one(rows)))
        elif change == 4:
            rows[row] = r.one([[], rows[row] + [""], rows[row][:-1], ["#", *rows[row]]])
        elif change == 5:
            rows = [
                [*one[:column], *([one[column]] * (2 * r.upto(1)) if len(one) > column else []), *one[column + 1 :]]
                for one in rows
            ]
        elif change == 6:
            factor = r.one([0.0, -1.0, 0.9, 1.01, 57.3, 1e-3, 1e9, 1e308])
            rows[1:] = [
                [*one[:column], _scaled_cell(one[column], factor), *one[column + 1 :]] if len(one) > column else one
                for one in rows[1:]
            ]
        else:
            rows[1:] = [rows[1:][i] for i in r.rng.permutation(len(rows) - 1)]
        rows = rows or [[""]]
    separator = r.one([*[","] * 9, ";", "\t", " , "])
    data = r.one(["\n", "\r\n", "\r"]).join(separator.join(one) for one in rows).encode()
    return damaged(r, data) if r.upto(9) == 0 else data


def _scaled_cell(cell: str, factor: float) -> str:
    try:
        return repr(float(cell) * factor)
    except ValueError:
        return cell


def changed_options(r: Random, commands: dict[str, list[str]]) -> list[str]:
    """The words of a command with options changed, removed, doubled or added."""
    name = r.one(commands)
    words, other = [name, *commands[name]], r.one(commands.values())
    numbers = ["0", "-1", "1e9", "nan", "inf", "", "x", "1e-300", "1,2", "1_0", "9" * 30, "0x10", " 3"]
    for _ in range(1 + r.upto(1)):
        change, at = r.upto(5), 1 + r.upto(max(len(words) - 2, 0))
        if at >= len(words):
            break
        if change <= 2:
            words[at] = r.one([*numbers, *other, "/dev/zero", "/", "\x1b[2J", "PEA,PEA", "PEA+BPEA", "none", "--", "-h"])
        elif change == 3:
            del words[at]
        else:
            words.insert(at, r.one([*other, *numbers, "--json", "--quiet", "--repaired", "--inertial"]))
    return words


def finite(*values: Any) -> None:
    """Raise an error where something that was read is no finite number."""
    if not all(np.all(np.isfinite(value)) for value in values):
        raise ArithmeticError("what was read is not finite")


class Inputs:
    """Right inputs in a folder, how each kind is changed, and how it is read.

    Attributes:
        kinds: By kind, a function that writes one changed input and returns what is to be run, and what it shows of the input.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.urdf = [urdf_text("rrr"), urdf_text("rrr_prototype")]
        write_text(folder / "arm.xml", MJCF)
        write_text(folder / "bare.csv", _table())
        self.recordings = self._recordings()
        write_example("rrr", folder / "begun")  # with every optional key that has a value
        self.tasks = [parsed(name, (folder / "begun" / "task.json").read_text()) for name in ("task",)]
        self.tasks += [parsed(name, BUNDLED.joinpath(name).read_text()) for name in ("paper.json", "prototype.json")]
        self.headers = [json.loads((folder / "set" / "recordings.json").read_text()), HEADER]
        save_model(plain_model(self.recordings), folder / "model.json")
        self.model = json.loads((folder / "model.json").read_text())
        self.kinds: dict[str, Callable[[Random], tuple[Callable[[], None], bytes]]] = {
            "urdf": self._urdf,
            "mjcf": self._mjcf,
            "task": self._task,
            "header": self._header,
            "csv": self._csv,
            "model": self._model,
            "options": self._options,
        }

    def _recordings(self) -> Any:
        joints = [f"joint{k}" for k in (1, 2, 3)]
        rows = np.loadtxt(io.StringIO(_table()), delimiter=",", skiprows=1)
        names = _table().splitlines()[0].split(",")
        return write_set(
            self.folder / "set",
            "rrr",
            {"joints": joints, "torque": "motor", "recordings": [{"file": "0.csv"}]},
            {"0.csv": dict(zip(names, rows.T, strict=True))},
        )

    def _written(self, name: str, data: bytes) -> Path:
        (self.folder / name).write_bytes(data)
        return self.folder / name

    def _urdf(self, r: Random) -> tuple[Callable[[], None], bytes]:
        data = changed_xml(r, r.one(self.urdf))
        return (lambda: self._robot(self._written("fuzzed.urdf", data))), data

    def _mjcf(self, r: Random) -> tuple[Callable[[], None], bytes]:
        data = changed_xml(r, MJCF)
        return (lambda: self._robot(self._written("fuzzed.xml", data))), data

    def _robot(self, path: Path) -> None:
        arm_of(path)
        robot = load_robot(path)
        finite(robot.inertial, robot.placements, robot.axes, robot.gravity, robot.tool.position)

    def _task(self, r: Random) -> tuple[Callable[[], None], bytes]:
        data = changed_json(r, r.one(self.tasks))

        def read() -> None:
            task = load_task(self._written("fuzzed_task.json", data))
            finite(task.start, task.release, task.payload, task.duration, task.robot.inertial)
            for name in configurations():
                with contextlib.suppress(UserError):  # a task need not offer every spring
                    finite(*(x for bounds in spring_bounds(task, name) for x in (bounds.lower, bounds.upper)))

        return read, data

    def _header(self, r: Random) -> tuple[Callable[[], None], bytes]:
        data = changed_json(r, r.one(self.headers))
        return (lambda: self._set(self._written("set/fuzzed.json", data))), data

    def _csv(self, r: Random) -> tuple[Callable[[], None], bytes]:
        data = changed_csv(r, (self.folder / "bare.csv").read_text())
        header = self.headers[0] | {"recordings": [{"file": "fuzzed.csv"}]}

        def read() -> None:
            self._written("set/fuzzed.csv", data)
            self._set(self._written("set/csv.json", json.dumps(header).encode()))

        return read, data

    def _set(self, path: Path) -> None:
        for one in load_recordings(path).recordings:
            finite(one.t, one.q, one.dq, one.ddq, one.tau, one.payload)

    def _model(self, r: Random) -> tuple[Callable[[], None], bytes]:
        right = self.model | {"robot": self.model["robot"] | {"urdf": r.one(self.urdf)}}
        if r.upto(3) == 0:
            right["robot"]["urdf"] = changed_xml(r, right["robot"]["urdf"]).decode(errors="replace")
        data = changed_json(r, right)

        def read() -> None:
            model = load_model(self._written("fuzzed_model.json", data)).placed(self.recordings)
            finite(model.values, model.robot.inertial, model.predict(self.recordings.recordings[0]))

        return read, data

    def _options(self, r: Random) -> tuple[Callable[[], None], bytes]:
        words = changed_options(r, self._commands())
        return (lambda: run(words)), " ".join(words).encode(errors="replace")

    def _commands(self) -> dict[str, list[str]]:
        """Right words of every command that has a reader before a long computation; results go into the folder."""
        set_, model, out = str(self.folder / "set"), str(self.folder / "model.json"), str(self.folder / "out")
        return {
            "design": ["paper", "--out", out, "--configurations", "PEA,BPEA", "--starts", "3", "--seed", "1", "--tolerance", "1e-4",
                       "--cost", "load", "--intervals", "20", "--jobs", "1", "--model", model],
            "calibrate": [set_, "--out", out, "--way", "inverse"],
            "diagnose": [set_, "--out", out, "--jobs", "1"],
            "evaluate": [model, set_, "--out", f"{out}/error.json", "--window", "0.1"],
            "simulate": [model, set_, "--out", out, "--window", "0.1"],
            "excite": ["rrr", "--out", f"{out}.csv", "--duration", "10", "--harmonics", "3", "--acceleration", "5", "--speed", "1",
                       "--torque", "50", "--floor", "0", "--payload", "1", "--starts", "1", "--seed", "0", "--jobs", "1"],
            "export": [model, "--out", out, "--payload", "1.0", "--rate", "100"],
            "check": [set_, "--json"],
            "effects": ["--json"],
        }  # fmt: skip


def _table() -> str:
    """A recording of the paper's arm: made-up sines and torques that go with them."""
    t = np.arange(300) / 100
    columns = {"t": t}
    for k in (1, 2, 3):
        columns[f"q_joint{k}"] = 0.5 * np.sin((1 + 0.3 * k) * t + k)
        columns[f"dq_joint{k}"] = 0.5 * (1 + 0.3 * k) * np.cos((1 + 0.3 * k) * t + k)
        columns[f"tau_joint{k}"] = 5.0 * np.cos(t * k) + columns[f"q_joint{k}"]
    rows = [",".join(columns), *(",".join(f"{x:.9g}" for x in row) for row in zip(*columns.values(), strict=True))]
    return "\n".join(rows) + "\n"


LONG_ONES = (
    "rrr_oc.codesign.study.solve_multistart",
    "rrr_oc.codesign.study.solve_set",
    "rrr_oc.diagnosis.procedure.diagnose",
    "rrr_oc.calibration.prediction_error.evaluate_inverse",
    "rrr_oc.calibration.prediction_error.evaluate_simulated",
    "rrr_oc.calibration.prediction_error.simulated",
    "rrr_oc.calibration.calibrate.calibrate",
    "rrr_oc.calibration.response.calibrate_response",
    "rrr_oc.calibration.response.calibrate_evolution",
    "rrr_oc.commands.excite.model_sensitivity",
    "rrr_oc.commands.models.export.mjcf",
)


def _reached(*_: Any, **__: Any) -> None:
    raise Reached


def run(words: list[str]) -> None:
    """A command up to its long computation; what the command line refuses is a `UserError` as well."""
    with contextlib.ExitStack() as stack:
        for name in LONG_ONES:
            stack.enter_context(patch(name, _reached))
        printed = io.StringIO()
        stack.enter_context(contextlib.redirect_stdout(printed))
        stack.enter_context(contextlib.redirect_stderr(printed))
        try:
            load(words[0]).main(args=words[1:], prog_name=words[0], standalone_mode=False)
        except Reached:
            return
        except typer.Exit:
            return
        except Exception as error:
            said = getattr(error, "format_message", None)  # of the parser of command lines
            if said is None:
                raise
            raise UserError(said()) from None


def sentence_fault(said: str) -> str | None:
    """What is wrong with the sentence of a refusal, if something is."""
    if "\n" in said.strip():
        return "more than one line"
    if len(said) > WORDIEST:
        return f"{len(said)} characters"
    if found := INSIDES.search(said):
        return f"words of the program's insides: {found[0]}"
    return None if re.search(r"\w{3}", said) else "no words"


@contextlib.contextmanager
def limited(seconds: int) -> Iterator[None]:
    """Raise `TimeoutError` after some seconds."""

    def over(*_: Any) -> None:
        raise TimeoutError(f"longer than {seconds} s")

    before = signal.signal(signal.SIGALRM, over)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def outcome(read: Callable[[], None]) -> tuple[str, str]:
    """ "read", "refused" or "fault", and what was said."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            with limited(LONGEST):
                read()
        except UserError as error:
            wrong = sentence_fault(str(error))
            return ("refused", str(error)) if wrong is None else ("fault", f"sentence: {wrong}: {str(error)[:600]}")
        except Exception as error:
            frames = [f"{Path(f.filename).name}:{f.lineno}" for f in traceback.extract_tb(error.__traceback__)][-4:]
            return "fault", f"{type(error).__name__}: {str(error)[:300]} ({' '.join(frames)})"
    return "read", ""


def main(
    out: Annotated[Path, typer.Option(help="folder of the results")],
    inputs: Annotated[int, typer.Option(help="inputs altogether")] = 10_000,
    seed: Annotated[int, typer.Option(help="of all inputs")] = 0,
    only: Annotated[str | None, typer.Option(help="KIND or KIND:I: this kind alone, or one input, which is shown")] = None,
) -> None:
    """Read changed inputs, and count what comes of them."""
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        made = Inputs(Path(folder))
        if only is not None and ":" in only:
            kind, index = only.split(":")
            read, shown = made.kinds[kind](Random(seed, kind, int(index)))
            print(shown.decode(errors="replace"), outcome(read), sep="\n")
            return
        kinds = [only] if only is not None else list(made.kinds)
        out.mkdir(parents=True, exist_ok=True)
        _all(made, kinds, out, inputs, seed)


def _all(made: Inputs, kinds: list[str], out: Path, inputs: int, seed: int) -> None:
    """All inputs from where an earlier run was, the kinds in turn."""
    place = out / "fuzz.json"
    known = json.loads(place.read_text()) if place.is_file() else {"seed": seed, "done": 0, "counts": {}, "faults": []}
    if known["seed"] != seed:
        raise UserError(f"{place} is of seed {known['seed']}; another folder is required for seed {seed}")
    counts = {kind: Counter(known["counts"].get(kind, {})) for kind in kinds}
    for i in range(known["done"], inputs):
        kind, index = kinds[i % len(kinds)], i // len(kinds)
        read, _ = made.kinds[kind](Random(seed, kind, index))
        found, said = outcome(read)
        counts[kind][found] += 1
        if found == "fault":
            known["faults"].append({"input": f"{kind}:{index}", "said": said})
            print(f"{kind}:{index} {said}", flush=True)
        if (i + 1) % KEPT_EVERY == 0 or i + 1 == inputs:
            write_json(place, known | {"done": i + 1, "counts": counts})
    rows = [
        [kind, *(str(c[name]) for name in ("read", "refused", "fault")), str(sum(c.values()))] for kind, c in counts.items()
    ]
    total = sum(counts.values(), Counter())
    rows.append(["all", *(str(total[name]) for name in ("read", "refused", "fault")), str(sum(total.values()))])
    text = markdown(["kind", "read", "refused in a sentence", "faults", "inputs"], rows)
    write_text(out / "fuzz.md", text)
    print(text)


entry = entry_point(lambda: typer.run(main))

if __name__ == "__main__":
    entry()
