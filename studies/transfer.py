"""From recordings to designs that hold on the arm: the paper's own failure of transfer, and co-design on a repaired model.

    python studies/transfer.py --out results/transfer

The arm is a plant that shares no physics code with rrr_oc (validation/concealed): the prototype under P-controllers, recorded along
Eq. 14's sweeps by the paper's protocol. Two questions:

- The paper's Table 2: the plain model, calibrated as there, fits its sweeps and fails on the fast task of stiff actuation. The arm
  "drives" has the motors of Eq. 7-9. What is missing, which recording tells it, and how well is the task predicted then?
- The other arms hide something that a design of springs should know. Springs and motion are optimised twice, on the model as
  labelled and on the one that the diagnosis repaired; the arm itself says what each costs.

What an arm hides is drawn from the seed and written to `truth.json` when everything else is done. Every stage leaves its files in
--out and is not done again; a folder of other options or other code is refused.
"""

import json
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import matplotlib
import numpy as np
import typer
from rich.markdown import Markdown
from scipy.interpolate import CubicHermiteSpline

from rrr_oc import parallel
from rrr_oc.calibration.calibrated_model import CalibratedModel
from rrr_oc.calibration.model_file import load_model, save_model
from rrr_oc.calibration.prediction_error import error
from rrr_oc.calibration.response import calibrate_response
from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.optimum import SAVED, SampledMotion, resimulate, sample_motion
from rrr_oc.codesign.search.multistart import solve_multistart
from rrr_oc.codesign.search.proposals import SearchOptions
from rrr_oc.codesign.springs import offered, spring_bounds
from rrr_oc.codesign.task import PHASES, Task, load_task
from rrr_oc.codesign.transfer import repaired
from rrr_oc.commands.shared import Jobs, Workers
from rrr_oc.data.published import published
from rrr_oc.diagnosis.procedure import diagnose
from rrr_oc.errors import UserError, entry_point
from rrr_oc.model.metrics import measure
from rrr_oc.model.motion import Motion
from rrr_oc.model.parameters import by_effect
from rrr_oc.numerics.savitzky_golay import smooth
from rrr_oc.optimal_control.refinement import Refinement
from rrr_oc.recordings.header import Spring
from rrr_oc.recordings.reader import load_recordings
from rrr_oc.recordings.recording import Recording, RecordingSet
from rrr_oc.recordings.springs import spring_json
from rrr_oc.recordings.writer import write_set
from rrr_oc.report.console import wide_console
from rrr_oc.report.diagnosis_report import write_diagnosis
from rrr_oc.report.figures import save_figure
from rrr_oc.report.tables import markdown
from rrr_oc.robot.drives import load_actuators
from rrr_oc.storage import hash_of, write_json, write_npz, write_text

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from studies.calibration import SIGNALS, Run, coverage, draw_coverage, follow, table
from studies.paper.run_store import all_code
from studies.paper.sweeps import PROTOTYPE_SWEEP, Sweep, protocol, sweep
from validation.concealed.arms import PROTOTYPE_MOTOR, Arm, rrr_arm
from validation.concealed.catalogue import effect_type
from validation.concealed.effect import Effect, Signals
from validation.concealed.plant import LEAD, Plant, Setup
from validation.concealed.plant import signals as logged
from validation.concealed.sensors import Sensing, sample

matplotlib.use("Agg")
import matplotlib.pyplot as plt

PLANT = Path(__file__).resolve().parents[1] / "validation" / "concealed"  # the code of the arm
STEP = 2e-3  # of the plant [s]
NOISE = 0.25  # of the recorded torque, about 1 % of joint 2's [Nm]
GROUPS = ("payload", "bare")  # set-up of the arm in the task's phases, as in the protocol's recordings
console = wide_console()


# --- the arm ---


@dataclass(frozen=True)
class Hidden:
    """An effect of the plant, of a strength drawn from a range [its own unit].

    Attributes:
        loaded: Whether it is there with a payload only.
    """

    effect: str
    joints: tuple[int, ...]
    strength: tuple[float, float]
    shape: Mapping[str, Any] = field(default_factory=dict)
    loaded: bool = False


@dataclass(frozen=True)
class Prototype:
    """An arm to record and to work with: the plant's prototype, and what it conceals.

    Attributes:
        eq9: Whether its drives are those of Eq. 7-9, else with dry and viscous friction and armature.
    """

    name: str
    seed: int
    hidden: tuple[Hidden, ...] = ()
    eq9: bool = False

    @property
    def arm(self) -> Arm:
        """Its plain physics."""
        return rrr_arm("rrr_prototype", np.random.default_rng(self.seed), motor=PROTOTYPE_MOTOR if self.eq9 else None)

    def effects(self, payload: np.ndarray) -> list[Effect]:
        """What it conceals, for recordings with these payloads (B,) [kg]."""
        rng, found = np.random.default_rng([self.seed, 1]), []
        for h in self.hidden:
            effect = effect_type(h.effect)(h.joints, float(rng.uniform(*h.strength)), dict(h.shape))
            found.append(effect.on(np.where(payload > 0, 1.0, 0.0) if h.loaded else np.ones(len(payload))))
        return found

    def moves(
        self, plans: Sequence[Recording], forward: Sequence[np.ndarray] | None = None
    ) -> list[tuple[Signals, np.ndarray]]:
        """The plans as the arm moves: signals without noise, `tau` the motor torque, and the load torque (n, K) [Nm].

        Args:
            forward: Motor torque [Nm] that the P-controllers are helped by, (n, K) at each plan's times. They take positions, so
                it is put into those: q_ref + forward / k_p.
        """
        arm, payload = self.arm, np.array([p.payload[0] for p in plans])
        effects = self.effects(payload)
        steps = [round(float(np.ptp(p.t)) / STEP) for p in plans]
        lead, aims = round(LEAD / STEP), []
        for i, p in enumerate(plans):
            t = np.minimum(np.arange(max(steps) + 1) * STEP, np.ptp(p.t))
            aim = CubicHermiteSpline(p.t - p.t[0], p.q, p.dq, axis=1)(t)
            if forward is not None:
                aim += np.stack([np.interp(t, p.t - p.t[0], row) for row in forward[i]]) / arm.kp[:, None]
            aims.append(np.concatenate([np.repeat(aim[:, :1], lead, axis=1), aim], axis=1))
        history = Plant(arm, Setup(payload, [mounted(p, arm.joints) for p in plans]), effects, STEP).run(np.stack(aims))
        seen, found = logged(history, arm, effects, "motor"), []
        for i, count in enumerate(steps):
            k = slice(lead, lead + count + 1)
            one = Signals(seen.t[k], *(x[i : i + 1, :, k] for x in (seen.q, seen.dq, seen.ddq, seen.tau)))
            found.append((one, history.load[i, :, k]))
        return found

    def record(self, folder: Path, plans: Sequence[Recording], forward: Sequence[np.ndarray] | None = None) -> RecordingSet:
        """Recordings of the plans in the contract's form, noisy; those that are there already are taken."""
        if (folder / "recordings.json").exists():
            return load_recordings(folder)
        arm = self.arm
        sensing, tables = Sensing(np.full(arm.n, NOISE), speeds=True), {}
        for k, (plan, (one, _)) in enumerate(zip(plans, self.moves(plans, forward), strict=True)):
            rows = sample(one, 0, sensing, np.random.default_rng([self.seed, 2, k, len(plans)]))
            columns = {f"{key}_{joint}": rows[key][j] for key in ("q", "dq", "tau") for j, joint in enumerate(arm.joints)}
            tables[f"{plan.file}.csv"] = {"t": rows["t"], **columns}
        header = {
            "joints": list(arm.joints),
            "torque": "motor",
            "tool": {"link": arm.tool_link, "position": arm.tool_point.tolist()},
            "recordings": [
                {
                    "file": f"{p.file}.csv",
                    "group": group(p),
                    "payload": float(p.payload[0]),
                    "springs": spring_json(p.springs, arm.joints),
                }
                for p in plans
            ],
        }
        return write_set(folder, "rrr_prototype", header, tables)

    def truth(self) -> list[dict[str, Any]]:
        """What it conceals, for the report."""
        found: list[dict[str, Any]] = [
            {
                "effect": e.name,
                "joint": [self.arm.joints[j] for j in e.joints],
                "parameters": {k: v for k, (v, _) in e.parameters(self.arm).items()},
            }
            for e in self.effects(np.ones(1))
        ]
        return found + (
            [{"effect": "the drives of Eq. 7-9", "joint": list(self.arm.joints), "parameters": {}}] if self.eq9 else []
        )


def prototypes(seed: int) -> dict[str, Prototype]:
    """The arms by name."""
    return {
        "drives": Prototype("drives", seed, eq9=True),
        "payload": Prototype(
            "payload", seed, (Hidden("payload_mass", (), (1.0, 2.0), {"direction": 1.0, "listed": 5.0}, loaded=True),)
        ),
        "spring": Prototype(
            "spring", seed, (Hidden("parallel_spring", (1,), (3.0, 6.0), {"equilibrium": 1.4, "active": "below"}),)
        ),
        "harness": Prototype("harness", seed, (Hidden("cable_harness", (2,), (2.0, 4.0), {"rest": -0.5}),)),
    }


def group(plan: Recording) -> str:
    """Label of a physical set-up."""
    return "_".join([*(["payload"] if plan.payload[0] else []), *(["springs"] if plan.springs else [])]) or "bare"


def mounted(plan: Recording, joints: Sequence[str]) -> dict[str, Any]:
    """The springs of a plan as the plant takes them."""
    listed = spring_json(plan.springs, joints)
    return listed | ({"bpea": listed["bpea"][0]} if "bpea" in listed else {})


# --- designs ---


@dataclass(frozen=True)
class Designed:
    """Springs and motion of a task, and what the model they were designed on says of them: E1, and the engine's [N²m²s]."""

    motion: SampledMotion
    springs: tuple[Spring, ...]
    hardware: Mapping[str, float]
    predicted: float
    engine: float

    def plans(self, task: Task) -> list[Recording]:
        """The two phases as motions to make; payload as labelled."""
        return [
            Recording.planned(name, phase, self.springs) for name, phase in zip(PHASES, self.motion.by_phase(task), strict=True)
        ]


def designed(folder: Path, name: str, design: CoDesign, options: SearchOptions) -> Designed:
    """The best design found, from its file where it has been found before."""
    file, content = folder / f"{name}.npz", folder / f"{name}.json"
    if not content.exists():
        began = time.perf_counter()
        solution = solve_multistart(design, options).whole().best.solution
        motion, own = sample_motion(design, solution), [s.effect for s in design.springs if not s.known]
        engine = measure([(p.t, p.tau_load[list(design.task.moving)]) for p in resimulate(design, solution, motion).phases])
        write_npz(file, motion.arrays | {"joints": np.array(design.task.joints)})
        count = sum(len(e.parameters) for e in own)
        write_json(content, {
            "E1": solution.cost, "engine": engine.E1_total, "durations": solution.durations.tolist(),
            "theta": solution.parameters[:count].tolist(), "hardware": design.hardware(solution.parameters),
            "wall_s": time.perf_counter() - began,
        })  # fmt: skip
    found = json.loads(content.read_text(encoding="utf-8"))
    saved = np.load(file)
    motion = SampledMotion(**{key: saved[key] for key in SAVED})
    springs = tuple(by_effect([s.effect for s in design.springs if not s.known], found["theta"]))
    return Designed(motion, springs, found["hardware"], found["E1"], found["engine"])


def helped_by(model: CalibratedModel, plans: Sequence[Recording]) -> list[np.ndarray]:
    """The motor torque that a model predicts for each plan, in the recordings' own terms, (n, K) [Nm]."""
    return [model.output_torque(planned(p)) for p in plans]


def planned(p: Recording) -> Recording:
    """A plan whose group, the arm's set-up, is that of the protocol without springs."""
    return replace(p, group=group(replace(p, springs=())))


def cost_on(arm: Prototype, plans: Sequence[Recording], model: CalibratedModel, rows: Sequence[int]) -> dict[str, float]:
    """E1 [N²m²s] of the plans on the arm itself, the model's torque fed forward, and how far it strays [rad]."""
    moved = arm.moves(plans, helped_by(model, plans))
    e1 = measure([(one.t, load[list(rows)]) for one, load in moved]).E1_total
    stray = max(
        float(np.max(np.abs(one.q[0] - CubicHermiteSpline(p.t, p.q, p.dq, axis=1)(np.minimum(one.t, p.t[-1])))))
        for p, (one, _) in zip(plans, moved, strict=True)
    )
    return {"E1": e1, "stray_rad": stray}


# --- the stages ---


def diagnosed(folder: Path, recordings: RecordingSet) -> tuple[CalibratedModel, CalibratedModel, dict[str, Any]]:
    """The plain and the extended model and the content of diagnosis.json, from their files where they are there."""
    done = folder / "diagnosis.json"
    if not done.exists():
        with parallel.one_thread():
            found = diagnose(recordings, lambda step: console.print(f"  {step.said}", highlight=False))
        save_model(found.plain, folder / "plain.json")
        write_diagnosis(found, folder)
    return load_model(folder / "plain.json"), load_model(folder / "model.json"), json.loads(done.read_text(encoding="utf-8"))


def as_the_paper(file: Path, recordings: RecordingSet) -> CalibratedModel:
    """The plain model calibrated on the simulated response, to the paper's objective: load torque by Eq. 10 of joints 2 and 3."""
    if not file.exists():
        save_model(calibrate_response(recordings, load_actuators(("joint2", "joint3")), timestep=4e-3), file)
    return load_model(file)


def faster(task: Task, motion: Sweep) -> Sweep:
    """The sweeps sped up until each of the task's joints reaches its limit of speed."""
    fastest = np.abs(motion.motion(np.linspace(0, motion.duration, 4000), "rising")[1]).max(axis=1)
    factor = np.ones(len(fastest))
    factor[list(task.moving)] = task.speed / fastest[list(task.moving)]
    factor = np.maximum(factor, 1.0)
    return replace(motion, slow=motion.slow * factor, fast=motion.fast * factor)


def wanted(folder: Path, found: Mapping[str, Any], task: Task, motion: Sweep) -> list[Recording]:
    """Recordings that are still needed: the motions that the diagnosis suggests, and sweeps as fast as the task."""
    quick, plans = faster(task, motion), []
    for direction in ("rising", "falling"):
        plans += [
            sweep(quick, direction, name=f"fast_{direction}{'_payload' if mass else ''}", payload=mass)
            for mass in (task.payload, 0.0)
        ]
    for entry in found["suggested_recordings"]:
        t, *q = np.loadtxt(folder / entry["trajectory"], delimiter=",", skiprows=1).T
        q = np.array(q)
        dq = np.gradient(q, t, axis=1)
        name = Path(entry["trajectory"]).stem
        suggested = Motion(t, q, dq, np.gradient(dq, t, axis=1), np.full(len(t), task.payload))
        plans.append(Recording.planned(name, suggested))
    return plans


def failure(out: Path, arm: Prototype, task: Task, motion: Sweep, options: SearchOptions) -> dict[str, Any]:
    """The paper's Table 2 on an arm with its drives, before and after the diagnosis, and after the recording that was missing."""
    drives, here = load_actuators(task.joints), out / arm.name
    sweeps = arm.record(here / "sweeps", protocol(motion))
    paper = as_the_paper(here / "as_the_paper.json", sweeps)
    fast = designed(out / "designs" / "labelled", "SA", CoDesign(task, ()), options)
    plans = fast.plans(task)
    tried = arm.record(here / "task", plans, helped_by(paper, plans))
    _, first, found = diagnosed(here / "diagnosis", sweeps)
    added = arm.record(here / "wanted", wanted(here / "diagnosis", found, task, motion))
    more = replace(sweeps, recordings=(*sweeps.recordings, *added.recordings))
    plain_more, second, found_more = diagnosed(here / "diagnosis_with_wanted", more)
    models = {
        "calibrated as in the paper": (paper, sweeps),
        "repaired from the sweeps": (first, sweeps),
        "calibrated with the wanted recordings": (plain_more, more),
        "repaired with the wanted recordings": (second, more),
    }
    rows, runs, by_joint = {}, {}, {}
    for name, (model, seen) in models.items():
        try:
            training, runs[name] = followed(model, seen, drives), followed(model, tried, drives)
        except UserError as error:  # a gear that gives, for which the twin has no coordinate
            rows[name] = str(error)
            continue
        rows[name] = {f"training, {kind}": v[:5] for kind, v in table(training, 0.15, 0.1).items()}
        rows[name]["the task"] = table(runs[name], 0.15, 0.1)["without springs"][:5]
        by_joint[name] = load_errors(runs[name], drives.joints)
    shares, motions = coverage(sweeps, out / "designs" / "labelled")
    only = {"SA": shares["SA"]}
    save_figure(draw_coverage(sweeps, {"SA": motions["SA"]}, only), out / "task_outside_the_sweeps.png")
    save_figure(draw_task(runs, drives.joints), out / "task_load_torque.png")
    return {
        "table": rows,
        "by_joint": by_joint,
        "outside": shares["SA"],
        "speeds": {
            j: {"task": float(np.abs(fast.motion.dq[k]).max()), "sweeps": fastest(sweeps, j), "with_wanted": fastest(more, j)}
            for k, j in enumerate(task.joints)
        },
        "recorded": {"sweeps": [r.file for r in sweeps.recordings], "wanted": [r.file for r in added.recordings]},
        "found": {"sweeps": brief(found), "with_wanted": brief(found_more)},
    }


def fastest(recordings: RecordingSet, joint: str) -> float:
    """Largest recorded speed of a joint [rad/s]."""
    return max(float(np.abs(r.dq[recordings.joints.index(joint)]).max()) for r in recordings.recordings)


def followed(model: CalibratedModel, recordings: RecordingSet, drives) -> list[Run]:
    """Every recording of a set followed by a model in the engine."""
    return [follow(model, recordings, r, drives) for r in recordings.recordings]


def load_errors(runs: Sequence[Run], joints: Sequence[str]) -> dict[str, float]:
    """NRMSE of the load torque by Eq. 10 of each joint, mean over the recordings."""
    signal = SIGNALS[4]
    found = [error(r.recording.t, r.recorded[signal], r.simulated[signal], r.recording.segments)["nrmse"] for r in runs]
    return dict(zip(joints, np.mean(found, axis=0).tolist(), strict=True))


def loop(out: Path, arm: Prototype, task: Task, motion: Sweep, names: Sequence[str], options: SearchOptions) -> dict[str, Any]:
    """Designs on the model as labelled and on the repaired one: what each predicts of E1, and what the arm says.

    "on_arm": the controllers are helped by the torque that the design's own calibrated model predicts. "steered": the labelled
    design with the help of the repaired model, so that what is left of the difference is that of springs and motion alone.
    """
    here = out / arm.name
    sweeps = arm.record(here / "sweeps", protocol(motion))
    plain, model, found = diagnosed(here / "diagnosis", sweeps)
    result: dict[str, Any] = {"found": brief(found), "designs": {}}
    for name in names:
        labelled = CoDesign(task, spring_bounds(task, name))
        entry = {}
        for kind, design, steering, folder in (
            ("labelled", labelled, {"on_arm": plain, "steered": model}, "labelled"),
            ("repaired", repaired(labelled, model, GROUPS), {"on_arm": model}, arm.name),
        ):
            console.print(f"{arm.name}: {name}, {kind}", highlight=False)
            best = designed(out / "designs" / folder, name, design, options)
            entry[kind] = {"predicted": best.predicted, "engine": best.engine, "springs": dict(best.hardware)}
            for way, own in steering.items():
                entry[kind][way] = cached(
                    here / f"{name}_{kind}_{way}.json", lambda b=best, o=own: cost_on(arm, b.plans(task), o, task.moving)
                )
        result["designs"][name] = entry
    return result


def cached(file: Path, work) -> Any:
    """What a function returns, from its file where it has been written before."""
    if not file.exists():
        write_json(file, work())
    return json.loads(file.read_text(encoding="utf-8"))


def brief(found: Mapping[str, Any]) -> dict[str, Any]:
    """Verdict, effects and unexplained torques of a diagnosis in a few words each, and its errors."""
    effects = []
    for e in found["effects"]:
        values = ", ".join(
            f"{k} {shown(v['value'])}{spread(v['std'])} {v['unit']}".strip() for k, v in e["parameters"].items() if "value" in v
        )
        where = "" if isinstance(e["recordings"], str) else f" in {', '.join(e['recordings'])}"
        rivals = f" (or {', '.join(e['indistinguishable_from'])})" if e["indistinguishable_from"] else ""
        joint = e["joint"] if isinstance(e["joint"], str) else ", ".join(e["joint"] or ["the arm"])
        effects.append(f"{e['effect']} of {joint}: {values}{rivals}{where}")
    effects += [f"unexplained, on {u['joint']}, by {' and '.join(u['depends_on'])}" for u in found["unexplained"]]
    wanted = [s["separates"] for s in found["suggested_recordings"]]
    return {"verdict": found["verdict"], "effects": effects, "nrmse": found["nrmse"], "suggested": wanted}


def shown(value: Any) -> str:
    """A number in four digits, other values as they are."""
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def spread(std: Any) -> str:
    return f" ± {std:.2g}" if isinstance(std, float) else ""


# --- figures and report ---


def draw_task(runs: Mapping[str, Sequence[Run]], joints: Sequence[str]) -> Any:
    """Load torque by Eq. 10 along the task: recorded, and simulated by each model."""
    figure, axes = plt.subplots(len(joints), len(PHASES), figsize=(12, 3.2 * len(joints)), layout="constrained", sharex="col")
    signal = SIGNALS[4]
    for column, phase in enumerate(PHASES):
        for i, joint in enumerate(joints):
            axis = axes[i, column]
            for k, (name, every) in enumerate(runs.items()):
                run = every[column]
                r = run.recording
                if k == 0:
                    axis.plot(r.t, smooth(r.t, run.recorded[signal], r.segments)[i], color="0.6", lw=3, label="the arm")
                axis.plot(r.t, smooth(r.t, run.simulated[signal], r.segments)[i], lw=1.2, color=f"C{k}", label=name)
            axis.set_title(f"{phase}, {joint}", fontsize=10)
            axis.set_ylabel("load torque by Eq. 10 [Nm]")
            axis.grid(alpha=0.3)
        axes[-1, column].set_xlabel("time [s]")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=3, fontsize=8)
    return figure


def draw_loop(arms: Mapping[str, Any]) -> Any:
    """E1 of each design: predicted by its own model, and on the arm."""
    bars = (
        ("labelled", "on_arm", "#e3a587", "designed on the labelled model, on the arm"),
        ("labelled", "steered", "#c55a11", "the same, steered with the repaired model"),
        ("repaired", "on_arm", "#1f6fb4", "designed on the repaired model, on the arm"),
    )
    figure, axes = plt.subplots(1, len(arms), figsize=(4.6 * len(arms), 4.2), layout="constrained", sharey=True, squeeze=False)
    for axis, (arm, content) in zip(axes[0], arms.items(), strict=True):
        names = list(content["designs"])
        x = np.arange(len(names))
        for k, (kind, way, colour, label) in enumerate(bars):
            at, entries = x + 0.27 * (k - 1), [content["designs"][name][kind] for name in names]
            axis.bar(at, [e[way]["E1"] for e in entries], 0.25, color=colour, label=label)
            axis.plot(
                at,
                [e["predicted"] for e in entries],
                "_",
                color="k",
                ms=16,
                mew=2,
                label=None if k else "predicted by its model",
            )
        axis.set_yscale("log")
        axis.set_xticks(x, names)
        axis.set_title(f"arm “{arm}”", fontsize=10, loc="left")
        axis.grid(alpha=0.3, axis="y")
    axes[0, 0].set_ylabel("E1 [N²m²s]")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=2, fontsize=9)
    return figure


def report(summary: Mapping[str, Any]) -> str:
    """Tables in Markdown."""
    asked = summary["asked"]
    parts = [
        "# Transfer to the arm\n",
        f"Task `{asked['preset']}`, sweeps of {asked['seconds']:g} s, seed {asked['seed']}, {asked['starts']} starts a design. The arm "
        "is the plant of validation/concealed; its P-controllers are helped by the torque that the model at hand predicts.\n",
    ]
    if summary["failure"]:
        parts += _failure_report(summary["failure"], summary["truth"].get("drives", []))
    if summary["loop"]:
        parts += _loop_report(summary["loop"], summary["truth"])
    return "\n".join(parts)


def _failure_report(f: Mapping[str, Any], truth: Sequence[Mapping[str, Any]]) -> list[str]:
    paper = published()["nrmse"]
    kinds_of_paper = [kind for kind in paper if kind != "signals"]
    rows = [["the paper's Table 2", kind, *(f"{v:.4f}" for v in paper[kind])] for kind in kinds_of_paper]
    for name, kinds in f["table"].items():
        if isinstance(kinds, str):
            rows.append([name, kinds, *["–"] * 5])
            continue
        rows += [[name, kind, *(f"{v:.4f}" for v in values)] for kind, values in kinds.items()]
    outside = ", ".join(f"{share:.0%} of {joint}'s" for joint, share in f["outside"].items())
    speeds = ", ".join(
        f"{j} {np.degrees(v['task']):.0f} °/s after sweeps of {np.degrees(v['sweeps']):.0f} °/s" for j, v in f["speeds"].items()
    )
    parts = [
        "## The paper's own failure\n",
        "NRMSE, mean over joints 2 and 3; τ_l by Eq. 10 from recorded and simulated motor torque alike. The task is that of stiff "
        "actuation, optimal and fast; no model has seen it.\n",
        markdown(["model", "on", "q", "dq", "ddq", "τ_a", "τ_l"], rows),
        "τ_l in the task, joint by joint: "
        + "; ".join(f"{name}, {', '.join(f'{j} {v:.4f}' for j, v in e.items())}" for name, e in f["by_joint"].items())
        + ".\n",
        f"{outside} time in the task lies further than 5° or 5 °/s from everything recorded: {speeds}. The recordings that are needed "
        f"are as fast as the task: {', '.join(f['recorded']['wanted'])}.\n",
    ]
    for name, found in (
        ("the sweeps", f["found"]["sweeps"]),
        ("the sweeps and the wanted recordings", f["found"]["with_wanted"]),
    ):
        parts += [f"Diagnosed from {name}: {found['verdict'].replace('_', ' ')}.\n", *[f"- {e}" for e in found["effects"]], ""]
    if truth:
        parts.append(f"The truth: {'; '.join(t['effect'] for t in truth)}.\n")
    return [*parts, "![](task_load_torque.png)\n", "![](task_outside_the_sweeps.png)\n"]


def _loop_report(arms: Mapping[str, Any], truth: Mapping[str, Any]) -> list[str]:
    rows = []
    for arm, content in arms.items():
        for name, d in content["designs"].items():
            one, two = d["labelled"], d["repaired"]
            rows.append([
                arm, name, f"{one['predicted']:.2f}", f"{one['on_arm']['E1']:.2f}", f"{one['steered']['E1']:.2f}",
                f"{two['predicted']:.2f}", f"{two['on_arm']['E1']:.2f}", f"{100 * (1 - two['on_arm']['E1'] / one['steered']['E1']):.1f} %",
                ", ".join(f"{x['stray_rad']:.3f}" for x in (one["on_arm"], one["steered"], two["on_arm"])),
            ])  # fmt: skip
    header = [
        "arm",
        "springs",
        "labelled: predicted",
        "on the arm",
        "steered",
        "repaired: predicted",
        "on the arm",
        "less E1",
        "stray [rad]",
    ]
    parts = [
        "## The loop closed\n",
        "E1 [N²m²s] of springs and motion designed on the model as labelled and on the repaired one. On the arm, the controllers are "
        "helped by the torque that the design's own calibrated model predicts; “steered” is the labelled design helped by the repaired "
        "model, so that springs and motion alone make the difference, which is “less E1”. “Stray” is the largest distance from the "
        "motion that was asked for, in the order of the three.\n",
        markdown(header, rows),
    ]
    for arm, content in arms.items():
        found = "; ".join(content["found"]["effects"]) or "nothing"
        hidden = "; ".join(
            f"{t['effect']} of {', '.join(t['joint']) or 'the arm'}, {', '.join(f'{k} {shown(v)}' for k, v in t['parameters'].items())}"
            for t in truth[arm]
        )
        parts.append(f"- {arm}: found {found}. Hidden: {hidden}.")
    return [*parts, "\n![](designs.png)\n"]


# --- command line ---


def main(
    out: Annotated[Path, typer.Option(help="folder of the results")] = Path("results/transfer"),
    arms: Annotated[
        str, typer.Option(help="comma-separated, of drives, payload, spring, harness")
    ] = "drives,payload,spring,harness",
    configurations: Annotated[str, typer.Option(help="comma-separated, of those that the task offers; default: all")] = "",
    preset: Annotated[str, typer.Option(help="the task: a preset of the prototype's robot, or a task file")] = "prototype",
    seconds: Annotated[float, typer.Option(min=10, help="of each sweep; the paper's take 60")] = 60.0,
    starts: Annotated[int, typer.Option(min=1, help="of each search for a design")] = 12,
    tolerance: Annotated[float, typer.Option(min=1e-8, max=1e-2, help="mesh tolerance of the designs, relative")] = 1e-4,
    seed: Annotated[int, typer.Option(min=0, help="of what the arms hide, of the noise and of the searches")] = 0,
    jobs: Jobs = -1,
    workers: Workers = parallel.LOCAL,
) -> None:
    """Writes report.md, summary.json, truth.json, figures, and a folder of recordings, models and designs for each arm."""
    known, names = prototypes(seed), [n.strip() for n in configurations.split(",") if n.strip()]
    chosen = [a.strip() for a in arms.split(",") if a.strip()]
    task = load_task(preset)
    names = names or list(offered(task))
    for given, allowed, option in ((chosen, known, "--arms"), (names, offered(task), "--configurations")):
        if not given or not set(given) <= set(allowed):
            raise UserError(f"{option} is {', '.join(given) or 'empty'}; allowed are {', '.join(allowed)}")
    if task.robot.name != "rrr_prototype":
        raise UserError(f"--preset {preset} is a task of the robot {task.robot.name!r}; the arm here is 'rrr_prototype'")
    asked = {"preset": preset, "seconds": seconds, "starts": starts, "tolerance": tolerance, "seed": seed}
    asked |= {"code": [all_code(), hash_of([Path(__file__), PLANT])]}
    if cached(out / "asked.json", lambda: asked) != asked:
        raise UserError(f"--out {out} holds a run with other options or of other code; give another folder")
    options = SearchOptions(starts=starts, seed=seed, kept=3, refinement=Refinement(tolerance))
    motion = replace(PROTOTYPE_SWEEP, duration=seconds)
    with parallel.workers(jobs, workers):
        failed = failure(out, known["drives"], task, motion, options) if "drives" in chosen else None
        closed = {name: loop(out, known[name], task, motion, names, options) for name in chosen if name != "drives"}
    truth = {name: known[name].truth() for name in chosen}
    write_json(out / "truth.json", truth)
    summary = {"asked": asked, "failure": failed, "loop": closed, "truth": truth}
    write_json(out / "summary.json", summary)
    if closed:
        save_figure(draw_loop(closed), out / "designs.png")
    text = report(summary)
    write_text(out / "report.md", text)
    console.print(Markdown(text))
    console.print(f"Everything is in {out}.", highlight=False, soft_wrap=True)


run = entry_point(lambda: typer.run(main))

if __name__ == "__main__":
    run()
