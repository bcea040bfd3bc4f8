"""Entries of a design's summary, made up as far as reports need them."""

from typing import Any

import numpy as np
from msgspec.structs import replace

from rrr_oc.codesign.certificate import Certificate, MeshQuality, Reintegration
from rrr_oc.codesign.design_file import (
    Configuration,
    DesignFile,
    Layer,
    MovedEntry,
    QuantityEntry,
    TaskAsked,
    Unsure,
    data,
    typed,
)

SPRINGS = {"k_p2": 10.0, "q_eq2": np.pi / 2, "k_b": 5.0, "r_1": 0.02}
GOOD = Certificate(
    primal=0.0, dual=0.0, complementarity=0.0, second_order="strict", curvature=1.0, flattest=("motion",), active=(), sensitivity=0.1,
    mesh=MeshQuality(1e-7, 1e-7, 1e-7, True), violation=0.0, smoothing=0.0, exact_cost=1.0, reintegration=Reintegration(0.0, 0.0),
    reached=5, bound=None, least=None,
)  # fmt: skip


def metrics(E1: float) -> dict[str, Any]:
    """Metrics of a torque of this E1, of one joint."""
    return {"E1": E1, "E1_joint": {"b": E1}, "rms": {"b": 1.0}, "peak": {"b": 2.0}}


def moved(E1: float, certificate: Certificate = GOOD, **changes: Any) -> MovedEntry:
    """The motion of a task with this E1, which MuJoCo confirms."""
    tracked = metrics(E1) | {"E1_relative_error": 0.0, "energy_residual": 0.0, "tracking_error_rad": 0.0}
    found = metrics(E1) | {
        "cost": E1,
        "alone": E1,
        "with_first": E1,
        "springs_alone": {},
        "durations": {"go": 1.0, "return": 2.0},
        "start": {"b": 0.0},
        "release": {"b": 1.0},
    }
    found |= {"lowest_tool_m": 0.1, "idle": {}, "beyond": {}, "certificate": certificate, "meshes": []}
    return typed(found | {"mujoco": tracked | {"exact_springs": tracked}} | changes, MovedEntry)


def design(cost: float, motions: dict[str, MovedEntry] | None = None, **changes: Any) -> Configuration:
    """The entry of a configuration of this cost, by default with one task."""
    found = {"cost": cost, "alone": cost, "with_first": cost, "springs": SPRINGS, "mounted": {"parallel_spring[b]": {}}}
    found |= {"parameters": {}, "tasks": motions or {"t": moved(cost)}, "wall_s": 1.0}
    return typed(found | changes, Configuration)


def of_task(name: str = "t") -> TaskAsked:
    """A task of this name."""
    return TaskAsked(name, 1.0, 5.0, (1.0, 5.0), None, {"b": 0.0}, {"b": 1.0}, {"start": "rest", "release": "rest"}, {})


def summary(**found: Configuration) -> DesignFile:
    """A study; an underscore at the end of a name stands for a star."""
    named = {name.replace("_", "*"): c for name, c in found.items()}
    tasks = tuple(map(of_task, next(iter(named.values())).tasks))
    return DesignFile(
        name="made up", tasks=tasks, objective="sum", uncertain=Unsure(), cost="load torque²", quantity=QuantityEntry("E1", "N²m²s"),
        paper=False, joints=("a", "b", "c"), moving=("b",), command="", seed=0, starts=10, wall_s=1.0, versions={}, options={},
        configurations=named,
    )  # fmt: skip


def with_motion(c: Configuration, **changes: Any) -> Configuration:
    """The entry with changes of its only motion, and of the certificate of that."""
    (task,) = c.tasks
    old = c.first
    inner = {key: changes.pop(key) for key in list(changes) if key in Certificate.__struct_fields__}
    certificate = typed(data(old.certificate) | inner, Certificate)
    return replace(c, tasks={task: typed(data(replace(old, certificate=certificate)) | changes, MovedEntry)})


def layer(**changes: Any) -> Layer:
    """Two starts that failed."""
    found = {"starts": 2, "failed": 2, "best": None, "median": None, "best_proposal": 7.25, "seconds": 1.0}
    return typed(found | changes, Layer)
