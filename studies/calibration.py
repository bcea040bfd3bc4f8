"""The paper's calibration, on recordings of its own arm: Table 2, Figure 4, and the two ways side by side.

    rrr-oc import prototype FOLDER_OF_THE_AUTHORS_FILES recordings/prototype
    python studies/calibration.py recordings/prototype --out results/calibration

Dry friction, viscous friction and armature of every joint are found by (a) the paper's way, CMA-ES on MuJoCo rollouts, and by
(b) least squares on inverse dynamics, then Gauss–Newton on the same rollouts. Both minimise the same objective: NRMSE of the
load torque by Eq. 10, summed over joints 2 and 3 and the recordings. Way (b) is repeated with each recording left out in turn.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import matplotlib.pyplot as plt
import numpy as np
import typer
from rich.markdown import Markdown
from scipy.spatial import KDTree

from rrr_oc.calibration.calibrated_model import CalibratedModel
from rrr_oc.calibration.model_file import save_model
from rrr_oc.calibration.parameter_vector import labels
from rrr_oc.calibration.prediction_error import error, recorded_controller
from rrr_oc.calibration.response import POPULATION, calibrate_evolution, calibrate_response
from rrr_oc.codesign.springs import configurations
from rrr_oc.data.published import published
from rrr_oc.errors import UserError, entry_point
from rrr_oc.numerics.savitzky_golay import smooth, split
from rrr_oc.recordings.reader import load_recordings
from rrr_oc.recordings.recording import Recording, RecordingSet
from rrr_oc.report.console import wide_console
from rrr_oc.report.figures import save_figure
from rrr_oc.report.tables import markdown
from rrr_oc.robot.drives import Actuators, load_actuators
from rrr_oc.simulation.replay import replay
from rrr_oc.simulation.rollout import Simulated
from rrr_oc.storage import check_folder, write_json, write_text

SIGNALS = ("q", "dq", "ddq", "tau_motor", "tau_load by Eq. 10", "tau_load of the engine", "tau_load of the engine, own drives")
EQ10 = SIGNALS[4]
ENDS = ((0.15, 0.1), (3.0, 5.0))  # window and time dropped at both ends [s]: the contract's, and those of the authors' code
NEAR = np.radians([5.0, 5.0])  # a motion is covered where a recorded (q, dq) lies within 5° and 5 °/s
EQUAL = 1.01  # objectives within 1 % count as equal
console = wide_console()


@dataclass(frozen=True)
class Run:
    """A recording followed by a model in the engine, and both load torques of it."""

    recording: Recording
    replayed: Simulated
    recorded: dict[str, np.ndarray]
    simulated: dict[str, np.ndarray]


def follow(model: CalibratedModel, recordings: RecordingSet, recording: Recording, drives: Actuators) -> Run:
    """Signals of the drives' joints by name of `SIGNALS`; the two engine routes differ in what the recorded load torque is.

    "by Eq. 10": both motor torques through Eq. 10. "of the engine": M ddq + C dq + G less the springs' torque, against the recorded
    motor torque through Eq. 10; "own drives": against the recorded motor torque less what the model's own drives take.
    """
    r, found = recording, replay(model.physics(recording), recording, recorded_controller(model))
    j = [model.robot.index(name) for name in drives.joints]
    torque = recordings.output_torque(r)
    motor, load = model.torques(r)
    eq10 = [np.array(drives.load_from_motor(dq[j], a[j], m[j])[0]) for dq, a, m in
            ((r.dq, r.ddq, torque), (found.dq, found.ddq, found.tau_motor))]  # fmt: skip
    recorded = (r.q[j], r.dq[j], r.ddq[j], torque[j], eq10[0], eq10[0], (torque - motor + load)[j])
    simulated = (found.q[j], found.dq[j], found.ddq[j], found.tau_motor[j], eq10[1], found.tau_load[j], found.tau_load[j])
    return Run(r, found, dict(zip(SIGNALS, recorded, strict=True)), dict(zip(SIGNALS, simulated, strict=True)))


def table(runs: Sequence[Run], window: float, dropped: float) -> dict[str, list[float]]:
    """NRMSE of every signal, mean over joints and recordings, without and with springs."""
    result = {}
    for kind, mounted in (("without springs", False), ("with springs", True)):
        some = [run for run in runs if bool(run.recording.springs) == mounted]
        if some:
            result[kind] = [float(np.mean([_error(run, signal, window, dropped) for run in some])) for signal in SIGNALS]
    return result


def _error(run: Run, signal: str, window: float, dropped: float) -> float:
    r, both = run.recording, (run.recorded[signal], run.simulated[signal])
    inside = np.broadcast_to((r.t >= r.t[0] + dropped) & (r.t <= r.t[-1] - dropped), both[0].shape)
    return float(np.mean(error(r.t, *both, r.segments, window, inside)["nrmse"]))


def apart(runs: Sequence[Run], window: float, dropped: float) -> dict[str, float]:
    """NRMSE between the two recorded load torques, by Eq. 10 and by the model's own drives, without and with springs.

    Both are made of the same recorded motor torque. A simulation that agreed perfectly with its own drives would still be as far
    from Eq. 10, and no dry friction, viscous friction or armature enters the engine's load torque but through the motion.
    """
    own = "tau_load of the engine, own drives"
    moved = [replace(run, simulated=run.simulated | {EQ10: run.recorded[own]}) for run in runs]
    return {kind: values[SIGNALS.index(EQ10)] for kind, values in table(moved, window, dropped).items()}


def left_out(recordings: RecordingSet, drives: Actuators, timestep: float) -> list[Run]:
    """Each recording followed by the model calibrated, the gradient way, on all others."""
    runs = []
    for i, r in enumerate(recordings.recordings):
        others = tuple(x for k, x in enumerate(recordings.recordings) if k != i)
        model = calibrate_response(replace(recordings, recordings=others), drives, timestep=timestep)
        runs.append(follow(model, recordings, r, drives))
        console.print(f"left out {r.file}", highlight=False)
    return runs


def piece(recordings: RecordingSet, seconds: float) -> RecordingSet:
    """The middle of every recording, so long [s]; the whole where that is 0."""
    if seconds == 0:
        return recordings
    return replace(recordings, recordings=tuple(_middle(r, seconds) for r in recordings.recordings))


def _middle(r: Recording, seconds: float) -> Recording:
    kept = np.abs(r.t - (r.t[0] + r.t[-1]) / 2) <= seconds / 2
    arrays = {name: getattr(r, name)[..., kept] for name in ("t", "q", "dq", "ddq", "tau", "payload")}
    return replace(r, **arrays, segments=split(arrays["t"]))


def race(gradient: CalibratedModel, evolution: CalibratedModel) -> dict[str, Any]:
    """When each way came within 1 % of the better objective of the two, and the ratio of the times."""
    histories = {"gradient": gradient.report["history"], "evolution": evolution.report["history"]}
    best = min(h[-1][1] for h in histories.values())
    reached = {way: next((t for t, value in h if value <= EQUAL * best), None) for way, h in histories.items()}
    a, b = reached["evolution"], reached["gradient"]
    return {
        "objective": {way: h[-1][1] for way, h in histories.items()},
        "seconds": reached,
        "evaluations": {"gradient": gradient.report["evaluations"], "evolution": evolution.report["evaluations"]},
        "wall_s": {"gradient": gradient.report["wall_s"], "evolution": evolution.report["wall_s"]},
        "speed_up": a / b if a and b else None,
    }


def coverage(
    recordings: RecordingSet, tasks: Path | None
) -> tuple[dict[str, dict[str, float]], dict[str, dict[str, np.ndarray]]]:
    """Share of each optimised task's time that lies outside the recorded (q, dq), by task and joint; and the tasks' motions."""
    seen = np.concatenate([np.stack([r.q, r.dq]) for r in recordings.recordings], axis=2)  # (2, n, K)
    shares, motions = {}, {}
    for file in sorted(tasks.glob("*.npz"), key=_place) if tasks else ():
        m = dict(np.load(file))
        t = np.linspace(m["t"][0], m["t"][-1], 2000)
        names, shares[file.stem], motions[file.stem] = [str(x) for x in m["joints"]], {}, {}
        for name in (x for x in names if x in recordings.joints):
            row, j = names.index(name), recordings.joints.index(name)
            states = np.stack([np.interp(t, m["t"], m[key][row]) for key in ("q", "dq")])
            nearest = KDTree((seen[:, j] / NEAR[:, None]).T).query((states / NEAR[:, None]).T, p=np.inf)[0]
            shares[file.stem][name] = float(np.mean(nearest > 1))
            motions[file.stem][name] = np.vstack([states, nearest > 1])
    return shares, motions


def _place(file: Path) -> tuple[bool, int, str]:
    """Where a configuration's file stands: as in the paper's tables, starred ones last, others by name."""
    name, known = file.stem.rstrip("*"), list(configurations())
    return file.stem.endswith("*"), known.index(name) if name in known else len(known), name


def draw_coverage(recordings: RecordingSet, motions: dict[str, dict[str, np.ndarray]], shares) -> Any:
    """Figure 4 for every joint: recorded (q, dq), and those of the optimised tasks."""
    joints, plain = recordings.joints, list(dict.fromkeys(name.rstrip("*") for name in motions))
    figure, axes = plt.subplots(1, len(joints), figsize=(5.5 * len(joints), 4.5), squeeze=False)
    colours = plt.get_cmap("tab10").colors  # pyright: ignore[reportAttributeAccessIssue]
    for axis, joint in zip(axes[0], joints, strict=True):
        j = joints.index(joint)
        for k, r in enumerate(recordings.recordings):
            axis.plot(*np.degrees([r.q[j, ::5], r.dq[j, ::5]]), ".", ms=1, color="0.7", label="recorded" if k == 0 else None)
        for name, by_joint in motions.items():
            if joint in by_joint:
                style = {"color": colours[plain.index(name.rstrip("*")) % 10], "ls": "--" if name.endswith("*") else "-"}
                label = f"{name}: {shares[name][joint]:.0%} outside"
                axis.plot(*np.degrees(by_joint[joint][:2]), lw=1.2, label=label, **style)
        axis.set(title=joint, xlabel="position [°]", ylabel="speed [°/s]")
        axis.legend(fontsize=8, markerscale=8, loc="upper center", bbox_to_anchor=(0.5, -0.14))
    figure.subplots_adjust(wspace=0.25)
    return figure


def draw_overlays(runs: Sequence[Run], drives: Actuators, window: float = 0.15) -> Any:
    """Recorded and simulated motor and load torque of one recording without and one with springs."""
    chosen = [next(run for run in runs if bool(run.recording.springs) == s) for s in (False, True) if any(
        bool(run.recording.springs) == s for run in runs)]  # fmt: skip
    signals = SIGNALS[3:5]
    figure, axes = plt.subplots(len(drives.joints) * len(signals), len(chosen), figsize=(7.5 * len(chosen), 11), squeeze=False)
    for column, run in enumerate(chosen):
        r, row = run.recording, 0
        for signal in signals:
            pair = [smooth(r.t, side[signal], r.segments, window) for side in (run.recorded, run.simulated)]
            for i, joint in enumerate(drives.joints):
                axis = axes[row, column]
                axis.plot(r.t, pair[0][i], color="0.6", lw=2, label="recorded")
                axis.plot(r.t, pair[1][i], color="#c55a11", lw=1, label="simulated")
                nrmse = error(r.t, run.recorded[signal], run.simulated[signal], r.segments, window)["nrmse"][i]
                axis.set_ylabel(f"{signal.split(' by')[0]}, {joint} [Nm]", fontsize=8)
                axis.set_title(f"{signal}, {joint}: NRMSE {nrmse:.3f}", fontsize=9)
                row += 1
        axes[0, column].legend(fontsize=8)
        axes[0, column].annotate(f"{r.file}, {'with' if r.springs else 'without'} springs, {r.payload.max():g} kg", (0.5, 1.25),
                                 xycoords="axes fraction", ha="center")  # fmt: skip
        axes[-1, column].set_xlabel("time [s]")
    figure.tight_layout()
    return figure


def report(summary: dict[str, Any]) -> str:
    """The tables in Markdown."""
    parts = ["# Calibration\n", "## Table 2: NRMSE, mean over joints 2 and 3 and the recordings\n", _nrmse(summary)]
    parts.append("Load torques of the recorded motor torque, by Eq. 10 and by the calibrated drives, differ by (NRMSE)\n")
    for entry in summary["table"]:
        both = ", ".join(f"{value:.4f} {kind}" for kind, value in entry["drives_apart"].items())
        parts.append(f"- {entry['way']}, {entry['window_s']:g} s, {entry['dropped_s']:g} s: {both}")
    rows = []
    for name, p in summary["parameters"].items():
        interval = "not compared" if p["interval"] is None else f"{p['interval'][0]:.3f} … {p['interval'][1]:.3f}"
        rows.append([name, f"{p['gradient']:.3f}", interval, "" if p["evolution"] is None else f"{p['evolution']:.3f}"])
    parts += ["\n## Parameters\n", markdown(["parameter", "gradient", "95 % interval", "evolution"], rows)]
    if r := summary["race"]:
        seconds = {way: "never" if s is None else f"{s:.1f} s" for way, s in r["seconds"].items()}
        rows = [
            [way, f"{r['objective'][way]:.4f}", str(r["evaluations"][way]), f"{r['wall_s'][way]:.1f} s", seconds[way]]
            for way in ("gradient", "evolution")
        ]
        header = ["", "objective", "evaluations", "wall", "within 1 % of the better after"]
        parts += ["## Two ways to one objective\n", markdown(header, rows)]
        parts.append(f"Speed-up: {r['speed_up']:.0f}\n" if r["speed_up"] else "The objectives differ by more than 1 %.\n")
    if outside := summary["outside"]:
        joints = sorted({j for by_joint in outside.values() for j in by_joint})
        rows = [[task, *(f"{shares[j]:.0%}" if j in shares else "" for j in joints)] for task, shares in outside.items()]
        parts += ["## Share of the optimised tasks that lies outside the recorded (q, dq)\n", markdown(["task", *joints], rows)]
    return "\n".join(parts)


def _nrmse(summary: dict[str, Any]) -> str:
    paper = published()["nrmse"]
    rows = [
        [f"paper, {kind.removeprefix('training, ')}", "", *(f"{v:.4f}" for v in values), "", ""]
        for kind, values in paper.items()
        if kind.startswith("training")
    ]
    for entry in summary["table"]:
        for kind, values in entry["nrmse"].items():
            ends = f"{entry['window_s']:g}, {entry['dropped_s']:g}"
            rows.append([f"{entry['way']}, {kind}", ends, *(f"{v:.4f}" for v in values)])
    return markdown(["", "smoothed over, dropped [s]", *SIGNALS], rows)


def _parameters(models: dict[str, CalibratedModel]) -> dict[str, dict[str, Any]]:
    """Each parameter's value by either way, and its interval by the gradient way."""
    estimates = {way: [e for term in m.terms for e in term.estimates] for way, m in models.items()}
    evolved = [e.value for e in estimates["evolution"]] if "evolution" in models else [None] * len(estimates["gradient"])
    rows = zip(labels(models["gradient"]), estimates["gradient"], evolved, strict=True)
    return {name: {"gradient": g.value, "interval": g.interval, "evolution": other} for name, g, other in rows}


def main(
    dataset: Annotated[Path, typer.Argument(help="a recording set of the paper's arm, as `rrr-oc import prototype` makes it")],
    out: Annotated[Path, typer.Option(help="folder of the results")] = Path("results/calibration"),
    tasks: Annotated[
        Path | None, typer.Option(help="folder of studies/pea_bpea.py, whose motions are held against them")
    ] = None,
    generations: Annotated[int, typer.Option(min=0, help=f"of CMA-ES, {POPULATION} candidates each; 0 leaves it out")] = 40,
    race_seconds: Annotated[
        float,
        typer.Option(min=0, help="CMA-ES, and the gradient way beside it, get the middle of each recording, so long; 0: all"),
    ] = 15.0,
    timestep: Annotated[float, typer.Option(help="of the engine while calibrating [s]")] = 4e-3,
    seed: Annotated[int, typer.Option(min=0, help="of CMA-ES")] = 0,
    joints: Annotated[str, typer.Option(help="whose load torques are compared")] = "joint2,joint3",
) -> None:
    """Calibrate both ways; writes report.md, summary.json, model.json, model_evolution.json and figures."""
    check_folder(out)
    recordings, drives = load_recordings(dataset), load_actuators(joints.split(","))
    if tasks is not None and not any(tasks.glob("*.npz")):
        raise UserError(f"--tasks {tasks}: holds no npz; the folder of a run of studies/pea_bpea.py is required")
    models = {"gradient": calibrate_response(recordings, drives, timestep=timestep)}
    console.print(f"gradient: {models['gradient'].report['objective']:.4f} in {models['gradient'].report['wall_s']:.1f} s")
    raced = None
    if generations:
        some = piece(recordings, race_seconds)
        raced = calibrate_response(some, drives, timestep=timestep)
        models["evolution"] = calibrate_evolution(some, drives, generations, seed, timestep=timestep)
        console.print(
            f"evolution: {models['evolution'].report['objective']:.4f} in {models['evolution'].report['wall_s']:.1f} s"
        )
    runs = {f"{way}, training": [follow(m, recordings, r, drives) for r in recordings.recordings] for way, m in models.items()}
    runs["gradient, left out"] = left_out(recordings, drives, timestep)
    shares, motions = coverage(recordings, tasks)
    summary = {
        "recordings": [r.file for r in recordings.recordings],
        "joints": list(drives.joints),
        "signals": list(SIGNALS),
        "table": [
            {
                "way": way,
                "window_s": window,
                "dropped_s": dropped,
                "nrmse": table(some, window, dropped),
                "drives_apart": apart(some, window, dropped),
            }
            for way, some in runs.items()
            for window, dropped in ENDS
        ],
        "parameters": _parameters(models),
        "race": race(raced, models["evolution"]) | {"seconds_of_each": race_seconds} if raced else None,
        "outside": shares,
    }
    save_model(models["gradient"], out / "model.json")
    if generations:
        save_model(models["evolution"], out / "model_evolution.json")
    write_json(out / "summary.json", json.loads(json.dumps(summary)))
    text = report(summary)
    write_text(out / "report.md", text)
    for name, figure in (
        ("coverage", draw_coverage(recordings, motions, shares)),
        ("overlays", draw_overlays(runs["gradient, training"], drives)),
        ("overlays_left_out", draw_overlays(runs["gradient, left out"], drives)),
    ):
        save_figure(figure, out / f"{name}.png", dpi=110)
    console.print(Markdown(text))
    console.print(f"Everything is in {out}.", highlight=False, soft_wrap=True)


run = entry_point(lambda: typer.run(main))

if __name__ == "__main__":
    run()
