"""Files made up from the structures that describe them, and files that are nearly right: a sentence, or a result that physics allows.

A short run is part of the tests. The long one: python -m pytest tests/whole/test_fuzz.py --hypothesis-profile=long, with 20 000 inputs to
each test, or as many as the environment variable RRR_OC_EXAMPLES says.
"""

import importlib.resources
import json
import types
from collections.abc import Callable
from contextlib import suppress
from copy import deepcopy
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import msgspec
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from recorded import Plant, as_set, record

from rrr_oc.calibration.inverse_dynamics import plain_model
from rrr_oc.calibration.model_file import ModelFile, load_model, save_model
from rrr_oc.codesign.catalogue import catalogue_schema, load_catalogue
from rrr_oc.codesign.springs import spring_bounds, spring_schema
from rrr_oc.codesign.task import TaskFile, load_task
from rrr_oc.effects import design_forms
from rrr_oc.errors import UserError
from rrr_oc.recordings.header import Header
from rrr_oc.recordings.reader import load_recordings
from rrr_oc.recordings.springs import springs_schema
from rrr_oc.recordings.writer import save_recordings
from rrr_oc.robot.drives import Drive, load_actuators
from rrr_oc.robot.robot import load_robot
from validation.fuzz_inputs import CELLS, HEADER, TEXTS, VALUES, places

LONG = settings.get_current_profile_name() == "long"
NAMES = ["payload", "payload_kg", "comment", "joint1", "x", "\x00"]
HOSTILE = st.sampled_from(VALUES).map(deepcopy)


def of(schema: Any) -> st.SearchStrategy:
    """Values that a type admits, as JSON has them; for `Any` whatever JSON has."""
    origin, inside = get_origin(schema), get_args(schema)
    if origin is Annotated:
        meta = next((m for m in inside[1:] if isinstance(m, msgspec.Meta)), msgspec.Meta())
        if inside[0] is float:
            low, high = (
                next((b for b in pair if b is not None), end)
                for pair, end in (((meta.ge, meta.gt), -1e9), ((meta.le, meta.lt), 1e9))
            )
            return st.floats(float(low), float(high)) | st.sampled_from([float(low), float(high)])
        return of(inside[0]).filter(lambda value: len(value) >= (meta.min_length or 0))
    if origin in (Union, types.UnionType):
        return st.one_of([of(member) for member in inside])
    if origin is Literal:
        return st.sampled_from(inside)
    if origin is tuple and inside[1:] != (...,):
        return st.tuples(*map(of, inside)).map(list)
    if origin in (list, tuple):
        return st.lists(of(inside[0]), max_size=3)
    if origin is dict:
        return st.dictionaries(st.sampled_from(["joint1", "joint2", "joint3"]), of(inside[1]), max_size=3)
    if isinstance(schema, type) and issubclass(schema, msgspec.Struct):
        fields = msgspec.structs.fields(schema)
        needed = {f.encode_name: of(f.type) for f in fields if f.required}
        return st.fixed_dictionaries(needed, optional={f.encode_name: of(f.type) for f in fields if not f.required})
    plain = {float: st.floats(-10, 10), int: st.integers(-3, 3), str: st.sampled_from(TEXTS), bool: st.booleans()}
    return plain.get(schema, st.none() if schema is types.NoneType else HOSTILE)


@st.composite
def nearly(draw: Callable, right: Any, schema: Any) -> Any:
    """A file that is right, with some values replaced, taken away, added or doubled, or its parts by others that the structure admits."""
    data, whole = deepcopy(right), draw(of(schema)) if draw(st.booleans()) else {}
    for _ in range(draw(st.integers(0, 3))):
        path = draw(st.sampled_from(places(data)[1:] or [()]))
        if not path:
            break
        place = data
        for key in path[:-1]:
            place = place[key]
        value, change = place[path[-1]], draw(st.integers(0, 5))
        if change == 0:
            del place[path[-1]]
        elif change == 1 and isinstance(value, dict):
            value[draw(st.sampled_from(NAMES))] = draw(HOSTILE)
        elif change == 2 and isinstance(value, list) and value:
            value.append(deepcopy(draw(st.sampled_from(value))))
        elif change == 3 and len(path) == 1 and path[0] in whole:
            place[path[0]] = whole[path[0]]
        elif change == 4 and isinstance(value, float | int) and abs(value) < 1e300:
            place[path[-1]] = draw(st.sampled_from([-value, 1e3 * value, 1e-3 * value, value + 1, 0]))
        else:
            place[path[-1]] = draw(HOSTILE)
    return data


def fuzzed(examples: int) -> Callable:
    """Settings of a property: the number of its examples in a short run; a long run has the profile's, and other ones each time."""
    known = [HealthCheck.too_slow, HealthCheck.function_scoped_fixture, HealthCheck.filter_too_much, HealthCheck.data_too_large]
    number = settings().max_examples if LONG else examples
    return settings(max_examples=number, deadline=None, derandomize=not LONG, database=None, suppress_health_check=known)


def bundled(name: str) -> Any:
    return json.loads(importlib.resources.files("rrr_oc.data").joinpath(name).read_text())


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A folder with a recording set, `set`, and a model of it, `model.json`."""
    folder, plant = tmp_path_factory.mktemp("fuzz"), Plant("rrr", np.full(3, 5.0), np.full(3, 10.0), np.full(3, 0.2))
    recordings = as_set(plant, [record(plant, "0.csv", np.random.default_rng(0), 1.0)])
    save_recordings(recordings, folder / "set")
    save_model(plain_model(recordings), folder / "model.json")
    return folder


def written(path: Path, data: Any) -> Path:
    path.write_text(json.dumps(data, ensure_ascii=True), encoding="utf-8")
    return path


def check_robot(robot: Any) -> None:
    assert np.all(np.isfinite(robot.inertial))
    assert np.all(robot.inertial[0] >= 0)
    assert np.all(np.isfinite(robot.placements))
    assert np.all(np.isfinite(robot.gravity))
    assert np.all(robot.lower <= robot.upper)


def check_set(found: Any) -> None:
    check_robot(found.robot)
    for r in found.recordings:
        assert all(np.all(np.isfinite(x)) for x in (r.t, r.q, r.dq, r.ddq, r.tau, r.payload))
        assert np.all(np.diff(r.t) > 0)
        assert np.all((r.payload >= 0) & (r.payload <= 1e4))
        assert all(np.isfinite(value) for _, theta in r.springs for value in theta.values())
        assert all(theta.get("stiffness", 0) >= 0 for _, theta in r.springs)


@fuzzed(80)
@given(data=nearly(HEADER, Header), springs=st.none() | of(springs_schema()))
def test_header(folder, data, springs):
    if springs is not None:
        with suppress(KeyError, IndexError, TypeError):
            data["recordings"][0]["springs"] = springs
    written(folder / "set" / "header.json", data)
    with suppress(UserError):
        check_set(load_recordings(folder / "set" / "header.json"))


@fuzzed(25)
@given(
    data=nearly(bundled("paper.json"), TaskFile),
    spring=st.none() | st.one_of(*(of(spring_schema(k)) for k in design_forms().values())),
)
def test_task(folder, data, spring):
    if spring is not None and isinstance(data.get("springs"), list):
        data["springs"].append(spring)
    written(folder / "task.json", data)
    with suppress(UserError):
        task = load_task(folder / "task.json")
        check_robot(task.robot)
        assert np.all(np.isfinite([task.start, task.release]))
        assert 0 < task.duration[0] <= task.duration[1] < np.inf
        assert 0 <= task.payload <= 1e4
        assert np.all(task.lower < task.upper)
        assert np.all(np.array([task.speed, task.acceleration, task.torque]) > 0)
        for bounds in spring_bounds(task, "PEA+BPEA"):
            assert np.all(np.isfinite([bounds.lower, bounds.upper]))
            assert np.all(bounds.lower <= bounds.upper)


@fuzzed(80)
@given(data=nearly(bundled("catalogue.json"), catalogue_schema()))
def test_catalogue(folder, data):
    with suppress(UserError):
        for lists in load_catalogue(written(folder / "catalogue.json", data)).lists.values():
            assert all(0 < size < np.inf for sizes in lists.values() for size in sizes)


@fuzzed(80)
@given(data=nearly(bundled("actuators.json"), dict[str, Drive]), motion=st.tuples(*[st.floats(-10, 10)] * 3))
def test_actuators(folder, data, motion):
    joints = ("joint1", "joint2")
    with suppress(UserError):
        drives = load_actuators(joints, str(written(folder / "actuators.json", data)))
        currents = [float(x) for x in np.array(drives.current(*([x] * 2 for x in motion))).ravel()]
        assert np.all(np.isfinite(currents))
        assert np.all(drives.torque_constant > 0)
        assert not np.any(drives.resistance <= 0)
        load, gain = drives.load_from_motor(*([x] * 2 for x in motion))
        assert np.all(np.isfinite(np.array(load)))
        assert np.all(np.array(gain).ravel() >= 0)


TERM = {"joints": ["joint2"], "options": {}, "width": None, "recordings": "all", "groups": []}
ESTIMATE = {"value": 0.1, "unit": "1", "std": 0.01, "interval": [0.0, 0.2], "at_bound": False}
TERMS = [
    {**TERM, "effect": "torque_gain", "parameters": {"gain": ESTIMATE}},
    {**TERM, "effect": "stribeck", "width": {"value": 0.05, "unit": "rad/s"},
     "parameters": {"excess": {**ESTIMATE, "unit": "Nm"}, "velocity": {**ESTIMATE, "unit": "rad/s"}}},
    {**TERM, "effect": "empirical", "width": {"value": 0.05, "unit": "rad/s"}, "parameters": {"c_1": {**ESTIMATE, "unit": "Nm"}},
     "options": {"variables": [["q", 0]], "low": [-1.0], "high": [1.0], "orders": [1], "direction": "either", "edges": [],
                 "largest": 9.0, "on_link": False}},
    {**TERM, "effect": "joint_elasticity",
     "parameters": {"stiffness": {**ESTIMATE, "value": 100.0, "unit": "Nm/rad"}, "damping_time": {**ESTIMATE, "value": 0.0, "unit": "s"}}},
    {**TERM, "effect": "biarticular_spring", "joints": ["joint2", "joint3"], "options": {"winding": [1, 1]},
     "width": {"value": 0.001, "unit": "rad"}, "parameters": {
         "kappa": {**ESTIMATE, "unit": "Nm/rad"}, "rho": {**ESTIMATE, "unit": "1"}, "phi": {**ESTIMATE, "unit": "rad"}}},
]  # fmt: skip


@fuzzed(40)
@given(drawn=st.data(), term=st.none() | st.sampled_from(TERMS))
def test_model(folder, drawn, term):
    right = json.loads((folder / "model.json").read_text())
    right |= {"robot": right["robot"] | {"urdf": right["robot"]["urdf"]}, "report": {}, "versions": {}}
    if term is not None:
        right["effects"] = [*right["effects"][:2], term]
    written(folder / "fuzzed.json", drawn.draw(nearly(right, ModelFile)))
    recordings = load_recordings(folder / "set")
    with suppress(UserError):
        model = load_model(folder / "fuzzed.json")
        check_robot(model.robot)
        for t in model.terms:
            assert np.all(np.isfinite(t.values))
            assert all(p.lower <= v <= p.upper for p, v in zip(t.effect.parameters, t.values, strict=True))
        predicted = model.placed(recordings).predict(recordings.recordings[0])
        assert np.all(np.isfinite(predicted))


@fuzzed(80)
@given(drawn=st.data())
def test_csv(folder, drawn):
    lines = (folder / "set" / "0.csv").read_text().splitlines()[: drawn.draw(st.sampled_from([3, 8, 40, 101]))]
    for _ in range(drawn.draw(st.integers(0, 3))):
        row = drawn.draw(st.integers(0, len(lines) - 1))
        cells = lines[row].split(",")
        cell = drawn.draw(st.sampled_from([*CELLS, *cells]))
        cells[drawn.draw(st.integers(0, len(cells) - 1))] = cell
        lines[row] = ",".join(cells)
        change = drawn.draw(st.integers(0, 9))
        if change < 3 and len(lines) > 1:
            other = drawn.draw(st.integers(0, len(lines) - 1))
            lines[row] = {0: lines[other], 1: "", 2: lines[row] + ","}[change]
    ending = drawn.draw(st.sampled_from(["\n", "\r\n", "\r"]))
    data = ending.join(lines).encode(drawn.draw(st.sampled_from(["utf-8", "utf-8-sig", "utf-16"])))
    data = data[: drawn.draw(st.just(len(data)) | st.integers(0, len(data)))]
    (folder / "set" / "fuzzed.csv").write_bytes(data)
    written(folder / "set" / "csv.json", HEADER | {"recordings": [{"file": "fuzzed.csv"}]})
    with suppress(UserError):
        check_set(load_recordings(folder / "set" / "csv.json"))


@fuzzed(80)
@given(drawn=st.data())
def test_urdf(folder, drawn):
    text = importlib.resources.files("rrr_oc.urdf").joinpath("rrr.urdf").read_text()
    for _ in range(drawn.draw(st.integers(1, 3))):
        parts = text.split('"')
        at = 2 * drawn.draw(st.integers(0, len(parts) // 2 - 1)) + 1
        parts[at] = drawn.draw(
            st.sampled_from(["", "nan", "0,5", "-1", "0", "1e300", "inf", "x", "1 2 3", "0 0 0", "<", "&a;", *parts[1::2]])
        )
        text = '"'.join(parts)
    tags = drawn.draw(st.integers(0, 2))
    if tags:
        lines = text.splitlines()
        at = drawn.draw(st.integers(0, len(lines) - 1))
        text = "\n".join([*lines[:at], *([lines[at]] * 2 if tags == 1 else []), *lines[at + 1 :]])
    (folder / "fuzzed.urdf").write_text(text, encoding="utf-8")
    with suppress(UserError):
        check_robot(load_robot(folder / "fuzzed.urdf"))
