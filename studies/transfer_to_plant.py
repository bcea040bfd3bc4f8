"""Optima played on an arm whose physics the model lacks: the stand-in for the paper's real world.

The plant of validation/concealed, which shares no code with this package, hides where the payload's centre really is and a dress pack
that pulls on a joint. The tool gets recordings of sweeps only: it calibrates, diagnoses what is missing, and designs again on the
repaired model. Each optimum is then followed on the plant by the paper's P-controllers, helped by the motor torque that the calibrated
(or repaired) model expects, and E1 is integrated over the load torque of the plant itself.
"""

import shutil
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from rrr_oc.calibration.calibrated_model import CalibratedModel
from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.optimum import SampledMotion, describe, sample_motion
from rrr_oc.codesign.search.multistart import continue_from
from rrr_oc.codesign.search.proposals import SearchOptions
from rrr_oc.codesign.task import PHASES, load_task
from rrr_oc.codesign.transfer import describe_transfer, reference_phases, repaired
from rrr_oc.diagnosis.procedure import diagnose
from rrr_oc.errors import UserError
from rrr_oc.model.metrics import measure
from rrr_oc.optimal_control.problem import Guess, PhaseGuess
from rrr_oc.optimal_control.refinement import Refinement
from rrr_oc.parallel import one_thread
from rrr_oc.recordings.reader import load_recordings
from rrr_oc.robot.drives import load_actuators
from rrr_oc.simulation.tracking import Reference
from rrr_oc.storage import Made
from studies.paper.comparison import FREE_MOTION
from studies.paper.encoding import Encoding
from studies.paper.experiments import candidate_motion, experiment, stored_motion
from studies.paper.run_store import Run, all_runs
from validation.concealed.build import Built, build
from validation.concealed.cases import Case, Concealed
from validation.concealed.plant import LEAD, Plant, Setup
from validation.concealed.write import write_set

HIDDEN = (Concealed("payload_com", 3.0), Concealed("cable_harness", 3.0))
PLANT = Path(__file__).resolve().parents[1] / "validation" / "concealed"  # the code of the plant
STEP = 1e-3  # of the plant [s]
SETTLED = 0.2  # [s] that the reference stands still after a phase
console = Console()


@dataclass(frozen=True, eq=False)
class Played:
    """A design with the parameters of its springs alone, and its motion, ready to be played."""

    design: CoDesign
    parameters: np.ndarray
    motion: SampledMotion
    predicted: float


def transfer(out: Path, preset: str, names: Sequence[str]) -> dict[str, Any]:
    """Predicted, simulated and played E1 of each experiment's optimum, before and after repair of the model.

    Raises `UserError` where the store has no gradient optimum of an experiment, or the preset is of another arm than the plant's.
    """
    task = load_task(preset)
    if task.robot.name != "rrr":
        raise UserError(f"the plant is the paper's arm 'rrr'; preset {preset!r} is of {task.robot.name!r}")
    built = build(Case("transfer", "pair", 0, "rrr", HIDDEN))
    data = out / "plant"

    def make() -> None:
        shutil.rmtree(data, ignore_errors=True)
        write_set(built, data, range(built.seen))

    Made([data], "plant", [Path(__file__), PLANT]).once(make)
    with one_thread():
        diagnosis = diagnose(load_recordings(data))
    found = [f.term for f in diagnosis.findings]
    console.print(f"diagnosed: {', '.join(t.effect.name for t in found) or 'nothing'}")
    runs = [r for r in all_runs(out / "runs") if r.asked["preset"] == preset and r.asked["ends"] == "rest"]
    before = {name: _optimum(experiment(task, name), runs, name) for name in names}
    evolved = {name: p for name in names if (p := _evolved(experiment(task, name), runs, name)) is not None}
    after = {name: _again(played, diagnosis.model) for name, played in before.items()}
    stages = {
        "before repair": _played(before, diagnosis.plain, built),
        "after repair": _played(after, diagnosis.model, built),
        "evolution, before repair": _played(evolved, diagnosis.plain, built),
    }
    hidden = [
        {
            "effect": s.effect.name,
            "parameters": {k: np.asarray(v).tolist() for k, (v, _) in s.effect.parameters(built.arm).items()},
        }
        for s in built.scaled
    ]
    return {
        "concealed": "; ".join(_words(h["effect"], h["parameters"]) for h in hidden),
        "diagnosed": "; ".join(_words(t.effect.name, _named(t)) for t in found) or "nothing",
        "stages": stages,
    }


def _words(name: str, parameters: Mapping[str, Any]) -> str:
    numbers = ", ".join(f"{k} {v:.3g}" if isinstance(v, float) else f"{k} {v}" for k, v in parameters.items())
    return f"{name} ({numbers})"


def _named(term) -> dict[str, float]:
    return {p.name: float(v) for p, v in zip(term.effect.parameters, term.values, strict=True)}


def _optimum(design: CoDesign, runs: Sequence[Run], name: str) -> Played:
    """The best gradient optimum of the store."""
    known = [r for r in runs if r.asked["experiment"] == name and r.asked["way"] in FREE_MOTION]
    if not known:
        raise UserError(f"{name}: the transfer needs a gradient optimum; run the stage 'gradient' before")
    run = min(known, key=lambda r: (r.found or {})["E1"])
    found = run.found or {}
    return Played(design, np.array(found["parameters"]), stored_motion(run), found["E1"])


def _evolved(design: CoDesign, runs: Sequence[Run], name: str) -> Played | None:
    """The best evolutionary trial in the engine."""
    known = [
        r for r in runs if r.asked["experiment"] == name and (r.asked["way"], r.asked.get("model")) == ("evolution", "engine")
    ]
    if not known:
        return None
    run = min(known, key=lambda r: (r.found or {})["cost"])
    found = run.found or {}
    motion = candidate_motion(Encoding(design, run.asked["via"]), np.array(found["x"]))
    return Played(design, np.array(found["parameters"]), motion, found["analytic"])


def _again(played: Played, model: CalibratedModel) -> Played:
    """The optimum re-optimised from itself on the repaired model's links and rigid body."""
    design, phases = repaired(played.design, model, ("", "")), []  # set-ups are not told apart here
    for k in played.motion.phases():
        t = played.motion.t[k] - played.motion.t[k[0]]
        s, x = t / t[-1], np.vstack([played.motion.q[:, k], played.motion.dq[:, k]])
        u = played.motion.ddq[:, k]
        phases.append(
            PhaseGuess(
                float(t[-1]),
                lambda at, s=s, x=x: np.stack([np.interp(at, s, row) for row in x]),
                lambda at, s=s, u=u: np.stack([np.interp(at, s, row) for row in u]),
            )
        )
    known = [spring.lower for spring in design.springs[len(played.design.springs) :]]
    guess = Guess(tuple(phases), np.concatenate([played.parameters, *known]))
    optima = continue_from([(design, guess)], SearchOptions(refinement=Refinement(1e-5)))
    if not optima:
        raise UserError("the repaired model's optimum was lost on the way from the nominal one")
    solution = optima[0][1].solution
    springs = solution.parameters[: len(played.parameters)]
    return Played(played.design, springs, sample_motion(design, solution), solution.cost)


def _played(designs: Mapping[str, Played], model: CalibratedModel, built: Built) -> dict[str, dict[str, Any]]:
    """For each design E1 as predicted, in the calibrated twin, and on the plant, with the plant's figures by joint."""
    if not designs:
        return {}
    references = [reference_phases(p.design, p.motion, p.parameters, model) for p in designs.values()]
    springs = [_listed(p) for p in designs.values()]
    rows = [(phase, spring) for phases, spring in zip(references, springs, strict=True) for phase in phases]
    longest = max(phase.t[-1] for phase, _ in rows) + SETTLED
    t = np.arange(round(longest / STEP) + 1) * STEP
    lead = round(LEAD / STEP)
    commands = np.stack([_command(phase, t, lead, built.arm.kp) for phase, _ in rows])
    setup = Setup(np.array([phase.payload[0] for phase, _ in rows]), [spring for _, spring in rows])
    effects = [s.effect.on(np.ones(len(rows))) for s in built.scaled]
    history = Plant(built.arm, setup, effects, STEP).run(commands)
    found = {}
    for i, (name, played) in enumerate(designs.items()):
        joints = list(played.design.task.moving)
        pairs = []
        for k in range(len(PHASES)):
            row = i * len(PHASES) + k
            inside = (history.t >= -STEP / 2) & (history.t <= references[i][k].t[-1] + STEP / 2)
            pairs.append((history.t[inside], history.load[row][:, inside]))
        figures = describe(played.design, measure(pairs), tuple(joints))
        twin = describe_transfer(
            played.design, played.motion, played.parameters, model, load_actuators(played.design.task.joints)
        )["engine"]["E1"]
        error = max(
            float(
                np.abs(
                    history.q[i * len(PHASES) + k][:, lead + round(references[i][k].t[-1] / STEP)] - references[i][k].q[:, -1]
                ).max()
            )
            for k in range(len(PHASES))
        )
        found[name] = {
            "predicted": played.predicted,
            "twin": twin,
            "plant": figures.pop("E1"),
            **figures,
            "final_error_rad": error,
        }
    return found


def _command(phase: Reference, t: np.ndarray, lead: int, gain: np.ndarray) -> np.ndarray:
    """Position commands of the P-controllers, (n, T): the reference plus the expected torque over the gain; constant before and after."""
    ahead = phase.feed_forward / gain[:, None]
    q = np.stack([np.interp(t, phase.t, row) for row in phase.q + ahead])
    return np.concatenate([np.repeat(q[:, :1], lead, axis=1), q], axis=1)


def _listed(played: Played) -> dict[str, Any]:
    """Springs as the plant lists them."""
    hardware, joints = played.design.hardware(played.parameters), played.design.task.robot.joints
    pea = {
        joints[n - 1]: {
            "stiffness_Nm_per_rad": hardware[f"k_p{n}"],
            "equilibrium_rad": hardware[f"q_eq{n}"],
            "active": "below",
        }
        for n in range(1, len(joints) + 1)
        if f"k_p{n}" in hardware
    }
    if "k_b" not in hardware:
        return {"pea": pea}
    radii = {f"radius{i}_m": hardware[f"r_{i}"] for i in (1, 2, 3)}
    spanned = next(s.effect.joints for s in played.design.springs if len(s.effect.joints) == 2)
    cable = {
        "stiffness_Nm_per_rad": hardware["k_b"],
        "equilibrium_rad": hardware["q_0"],
        "joints": [joints[j] for j in spanned],
    }
    return {"pea": pea, "bpea": {**cable, **radii}}
