"""`rrr-oc export`: an arm, with the springs of a design, as files for other programs."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from rrr_oc.calibration.calibrated_model import CalibratedModel
from rrr_oc.calibration.model_file import load_model, save_model
from rrr_oc.codesign.springs import SavedSprings, saved_springs
from rrr_oc.codesign.task import Task, load_task
from rrr_oc.codesign.trajectory import FORMATS, sampled, saved_motion
from rrr_oc.codesign.transfer import of_all_joints, uncalibrated, unknown_joints
from rrr_oc.commands.models.samples import samples as drawn_arms
from rrr_oc.commands.output import Json, Output, Quiet
from rrr_oc.commands.shared import MOST, check_apart, check_payload
from rrr_oc.effects import OfEach
from rrr_oc.errors import UserError
from rrr_oc.model.symbolic_model import Model
from rrr_oc.recordings.reader import load_recordings
from rrr_oc.recordings.recording import Recording
from rrr_oc.simulation.agreement import Differences, differences, largest_of
from rrr_oc.simulation.export import mjcf, urdf_of
from rrr_oc.simulation.export_into import check_into
from rrr_oc.simulation.export_into import into as into_mjcf
from rrr_oc.storage import check_folder, new_files, write_json, write_text

app = typer.Typer(add_completion=False)
SAMPLES = "samples"  # folder of drawn arms
OF_SAMPLES = ("samples.json", "[0-9][0-9][0-9]*.xml", "[0-9][0-9][0-9]*.json")  # its files


@app.command()
def export(
    out: Annotated[Path, typer.Option(help="folder for arm.xml and arm.urdf")],
    model: Annotated[
        Path | None,
        typer.Argument(help="model.json that calibrate or diagnose wrote; left out: the arm of --task as its file has it"),
    ] = None,
    design: Annotated[Path | None, typer.Option(help="summary.json of a design, whose springs are mounted")] = None,
    configuration: Annotated[str | None, typer.Option(help="of --design: which one, such as PEA")] = None,
    task: Annotated[str | None, typer.Option(help="of --design: its task file, or a bundled task")] = None,
    recordings: Annotated[
        Path | None,
        typer.Option(help="a recording set: the arm as it was in one of its recordings, with the springs that this lists"),
    ] = None,
    recording: Annotated[str | None, typer.Option(help="of --recordings: which one, such as sweep2.csv")] = None,
    into: Annotated[
        Path | None, typer.Option(help="MJCF of the same arm, into a copy of which the numbers and springs are written")
    ] = None,
    trajectory: Annotated[
        str | None, typer.Option(help=f"of --design: its motion for controllers, comma-separated of {', '.join(FORMATS)}")
    ] = None,
    rate: Annotated[float, typer.Option(help="of --trajectory \\[Hz]")] = 500.0,
    payload: Annotated[float, typer.Option(help="mass held at the tool, for arm.xml \\[kg]")] = 0.0,
    samples: Annotated[
        int,
        typer.Option(
            help="further arms, drawn from what the recordings leave open of the model, to randomise a simulation",
            min=0,
            max=MOST,
        ),
    ] = 0,
    seed: Annotated[int, typer.Option(help="of --samples", min=0)] = 0,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Write an arm for other programs: MJCF that plain MuJoCo runs, and the URDF with identified inertias."""
    output = Output(quiet, as_json)
    check_folder(out)
    check_payload(payload)
    found = None if model is None else load_model(model)
    wanted, springs = _designed(design, configuration, task)
    chosen, recorded_files = _recorded(recordings, recording, found, wanted)
    if samples and found is None:
        raise UserError("--samples needs a model.json, from which arms are drawn")
    if found is None and wanted is None:
        raise UserError("nothing to export: a model.json, or --design with --configuration and --task, is required")
    read = [path for path in (model, design, into) if path is not None]
    texts = _trajectories(out, trajectory, rate, design, configuration, wanted)
    written = [out / "arm.xml", out / "arm.urdf", *([] if into is None else [_filled(out, into)]), *texts]
    written += [out / SAMPLES / pattern for pattern in OF_SAMPLES] if samples else []
    check_apart([*read, *(() if wanted is None else wanted.files), *recorded_files], written)
    asked = _Asked(found, wanted, springs, chosen, payload)
    files = _write_arm(output, out, asked)
    if into is not None:
        files |= _write_into(output, into, _filled(out, into), asked)
    if found is not None and samples:
        files |= _write_samples(output, out, asked, samples, seed)
    for place, text in texts.items():
        write_text(place, text)
        output.show(f"{place} has the motion of the design at {rate:g} Hz.")
    output.result(files | ({"trajectory": list(map(str, texts))} if texts else {}))


@dataclass(frozen=True)
class _Asked:
    """What is exported: the arm of a model or of a task, or of both, with springs, as in a recording, and with a payload [kg]."""

    found: CalibratedModel | None
    wanted: Task | None
    springs: SavedSprings
    chosen: Recording | None
    payload: float

    def arm(self, found: CalibratedModel | None) -> tuple[Model, np.ndarray, list[str]]:
        """The arm with this model in the place of its own, as `_arm` gives it."""
        return _arm(found, self.wanted, self.springs) if self.chosen is None or found is None else _as_in(found, self.chosen)


def _write_arm(output: Output, out: Path, asked: _Asked) -> dict[str, Any]:
    """arm.xml, and of a model arm.urdf, read again; their part of the result."""
    arm, theta, left_out = asked.arm(asked.found)
    made = mjcf(arm, theta, asked.payload, left_out)
    write_text(out / "arm.xml", made.text)
    files: dict[str, Any] = {"mjcf": str(out / "arm.xml")}
    output.show(f"{out / 'arm.xml'} runs in plain MuJoCo: python -m mujoco.viewer --mjcf={out / 'arm.xml'}")
    apart, in_urdf = _read_again({"mjcf": out / "arm.xml"}, arm, theta, asked.payload, asked.chosen), list[str]()
    if asked.found is not None:
        own = (arm, theta, left_out) if asked.wanted is None else _arm(asked.found, None, SavedSprings((), ()))
        files["urdf"], in_urdf, more = _write_urdf(output, out / "arm.urdf", asked.found, own, asked.chosen)
        apart |= more
    _tell(output, apart)
    for one in made.left_out:
        output.note(f"Not in arm.xml: {one}.")
    return files | {"not_in_mjcf": list(made.left_out), "not_in_urdf": in_urdf, "differences": apart}


def _write_samples(output: Output, out: Path, asked: _Asked, count: int, seed: int) -> dict[str, Any]:
    """Drawn arms in `SAMPLES`, in the place of those that are there; their part of the result."""
    assert asked.found is not None
    rows, refused = [], 0
    with new_files(out / SAMPLES, OF_SAMPLES) as folder:
        for k, one in enumerate(drawn_arms(asked.found, count, seed), 1):
            number = f"{k:0{max(len(str(count)), 3)}d}"
            names = {"mjcf": f"{number}.xml", "model": f"{number}.json"}
            arm, theta, left_out = asked.arm(one.model)
            write_text(folder / names["mjcf"], mjcf(arm, theta, asked.payload, left_out).text)
            _read_again({"mjcf": folder / names["mjcf"]}, arm, theta, asked.payload, asked.chosen)
            save_model(one.model, folder / names["model"])
            rows.append(names | {"drawn_from": one.says})
            refused += one.refused
        write_json(folder / "samples.json", {"seed": seed, "refused_draws": refused, "samples": rows})
    output.show(f"{out / SAMPLES} has {count} drawn arms, an MJCF and a model.json each.")
    if refused:
        output.note(f"{refused} draws were no possible arms, and were drawn again.")
    return {"samples": [str(out / SAMPLES / row["mjcf"]) for row in rows], "refused_draws": refused}


def _write_urdf(
    output: Output, place: Path, found: CalibratedModel, own: tuple[Model, np.ndarray, list[str]], chosen: Recording | None
) -> tuple[str, list[str], Differences]:
    """The URDF of a model, `own` as `_arm` gives it: its place, what is not in it, and how far it is from the model."""
    arm, theta, left_out = own
    made = urdf_of(found.urdf, arm, theta, left_out)
    write_text(place, made.text)
    output.show(f"{place} has the inertial parameters of the model.")
    return str(place), list(made.left_out), _read_again({"urdf": place}, arm, theta, 0.0, chosen)


def _tell(output: Output, apart: Differences) -> None:
    """Show the largest difference of all files."""
    largest = largest_of(apart)
    if largest is not None:
        file, quantity, size = largest
        said = "of what they have, mass matrix, gravity and torques differ from the model's"
        output.show(f"Read again, {said} by {size:.1g} of the largest at most ({quantity} in the {file.upper()}).")


def _read_again(files: dict[str, Path], arm: Model, theta: np.ndarray, payload: float, chosen: Recording | None) -> Differences:
    """How far files are from the model, at the states of a recording or at random; raises `UserError`, and leaves none, if too far."""
    try:
        found = differences(files, arm, theta, payload, chosen)
        largest_of(found)
    except UserError:
        for path in files.values():
            path.unlink()
        raise
    return found


def _filled(out: Path, user: Path) -> Path:
    return out / f"{user.stem}_with_model.xml"


def _write_into(output: Output, user: Path, place: Path, asked: _Asked) -> dict[str, Any]:
    """A copy of a user's MJCF with the model's numbers, read again; its part of the result."""
    (arm, theta, _), payload = asked.arm(asked.found), asked.payload
    made = into_mjcf(user, place, arm, theta, payload)
    write_text(place, made.text)
    try:
        check_into(place, arm, theta, payload)
    except UserError:
        place.unlink()
        raise
    output.show(f"{place} is {user} with the model's numbers and springs.")
    for one in made.left_out:
        output.note(f"Not in {place.name}: {one}.")
    return {"into": str(place), "not_in_into": list(made.left_out)}


def _trajectories(
    out: Path, formats: str | None, rate: float, design: Path | None, configuration: str | None, task: Task | None
) -> dict[Path, str]:
    """Texts of the motion of a design, by the file to write; none where no format is asked for."""
    if formats is None:
        return {}
    if task is None or design is None:
        raise UserError("--trajectory needs --design, --configuration and --task, whose motion is written")
    names = [name.strip() for name in formats.split(",")]
    for name in names:
        if name not in FORMATS:
            raise UserError(f"--trajectory: unknown format {name!r}; allowed are {', '.join(FORMATS)}")
    found = sampled(saved_motion(design.parent / f"{configuration}.npz", task), task, rate)
    return {out / f"trajectory.{FORMATS[name][0]}": FORMATS[name][1](found) for name in names}


def _designed(design: Path | None, configuration: str | None, name: str | None) -> tuple[Task | None, SavedSprings]:
    """The task of a design, and its springs; neither where no design is asked for."""
    given = {"--design": design, "--configuration": configuration, "--task": name}
    missing = [option for option, value in given.items() if value is None]
    if len(missing) == len(given):
        return None, SavedSprings((), ())
    if missing:
        raise UserError(f"{missing[0]} is missing: {', '.join(given)} go together")
    assert design is not None
    assert configuration is not None
    task = load_task(str(name))
    return task, saved_springs(design, configuration, task)


def _recorded(
    dataset: Path | None, name: str | None, found: CalibratedModel | None, task: Task | None
) -> tuple[Recording | None, tuple[Path, ...]]:
    """The recording that is chosen, and the files read; None without --recordings."""
    if dataset is None and name is None:
        return None, ()
    if dataset is None or found is None or task is not None:
        raise UserError("--recordings and --recording go together, with a model.json and without --design")
    recordings = load_recordings(dataset)
    if recordings.joints != found.joints:
        own, other = ", ".join(found.joints), ", ".join(recordings.joints)
        raise UserError(f"the model has the joints {own}, but {dataset} {other}; they must be the same")
    chosen = next((r for r in recordings.recordings if r.file == name), None)
    if chosen is None:
        allowed = ", ".join(r.file for r in recordings.recordings)
        raise UserError(f"--recording is {'missing' if name is None else repr(name)}; allowed are {allowed}")
    return chosen, recordings.files


def _as_in(found: CalibratedModel, chosen: Recording) -> tuple[Model, np.ndarray, list[str]]:
    """The arm as it was in a recording, as `_arm` gives it."""
    physics = found.physics(chosen)
    return physics.built, physics.theta, []


def _arm(found: CalibratedModel | None, task: Task | None, springs: SavedSprings) -> tuple[Model, np.ndarray, list[str]]:
    """The calibrated arm, or the task's, with springs; its parameters, and what is not in it, one sentence each."""
    unknown: tuple[str, ...] = ()
    if task is not None and found is not None:
        unknown, found = unknown_joints(task, found), of_all_joints(task, found)
    terms = () if found is None else found.terms
    left_out = [f"{t.effect.name}: only some recordings have it" for t in terms if t.recordings != "all"]
    each = [t for t in terms if isinstance(t.effect, OfEach) and t.effect.each]
    left_out += [f"{t.effect.name}: another value in every recording" for t in each]
    terms = [t for t in terms if t.recordings == "all" and t not in each]
    if task is not None:
        left_out += [f"{task.robot.joints[j]} is held by the task; here it moves" for j in _held(task)]
        left_out += [f"{t.effect.name}: scales the springs of the recordings" for t in terms if "springs" in t.effect.inputs]
        terms = [t for t in terms if "springs" not in t.effect.inputs]
    if found is None:
        assert task is not None
        left_out += [f"{label}: the design was made for an arm that has it; give its model.json" for label in springs.known]
        robot, tool = task.robot, task.tool
    else:
        robot, tool = found.robot, found.tool
        left_out += [uncalibrated(unknown)] * bool(unknown)
    effects = (*(effect for effect, _ in springs.mounted), *(t.effect for t in terms))
    values = [*(list(theta.values()) for _, theta in springs.mounted), *(t.values for t in terms)]
    return Model(robot, tool, effects), np.concatenate([np.zeros(0), *values]), left_out


def _held(task: Task) -> list[int]:
    return [j for j in range(task.robot.n) if j not in task.moving]
