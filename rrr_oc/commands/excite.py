"""`rrr-oc excite`: a motion to record that determines friction and inertia well."""

import math
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from rrr_oc import parallel
from rrr_oc.commands.output import Json, Output, Quiet
from rrr_oc.commands.shared import MOST, Jobs, Joints, Seed, Workers, check_apart, check_payload, named
from rrr_oc.effects import plain_effects
from rrr_oc.errors import UserError
from rrr_oc.excitation.design import Excitation, ExcitationSearch
from rrr_oc.excitation.design import excite as optimised
from rrr_oc.excitation.information import INERTIAL, Information, information, model_sensitivity
from rrr_oc.excitation.limits import UNITS, Rig, robot_limits, stands
from rrr_oc.model.symbolic_model import Model
from rrr_oc.robot.robot import BUNDLED, Robot, load_robot
from rrr_oc.schema import LARGEST
from rrr_oc.storage import check_file, write_csv

UNITS_INERTIAL: dict[str, str] = dict(
    zip(INERTIAL, ["kg", *["kg m"] * 3, *["kg m²"] * 6], strict=True)
)  # of the columns of a link
NOISE = 1.0  # [Nm] of every joint's torque, for which standard errors are told; they are proportional to it
app = typer.Typer(add_completion=False)


@app.command()
def excite(
    urdf: Annotated[str, typer.Argument(help=f"path of the robot's URDF or MJCF, or a bundled model: {', '.join(BUNDLED)}")],
    out: Annotated[Path, typer.Option(help="CSV file of the motion: t, q, dq and ddq of every joint")],
    joints: Joints = None,
    duration: Annotated[float, typer.Option(help="of the motion \\[s]")] = 20.0,
    harmonics: Annotated[int, typer.Option(max=200, help="of the base frequency 1/duration; more are faster motions")] = 8,
    acceleration: Annotated[float, typer.Option(help="limit of every joint \\[rad/s²]")] = 5.0,
    speed: Annotated[float | None, typer.Option(help="limit of every joint \\[rad/s], if below the URDF's")] = None,
    torque: Annotated[
        float | None, typer.Option(help="limit of every joint's motor torque \\[Nm], if below the URDF's")
    ] = None,
    floor: Annotated[
        float | None,
        typer.Option(help="height that the tool stays above \\[m]; default: 0, the base's plane, unless the arm hangs from it"),
    ] = None,
    payload: Annotated[float, typer.Option(help="held at the tool \\[kg]")] = 0.0,
    starts: Annotated[int, typer.Option(min=1, max=MOST, help="random starts of the search")] = 3,
    seed: Seed = 0,
    jobs: Jobs = -1,
    workers: Workers = parallel.LOCAL,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Design a recording for an arm: the motion within its limits that determines friction and inertia best (D-optimal).

    It begins and ends at rest in the same pose and may be repeated. A collision of the arm with itself is not looked for.
    """
    output = Output(quiet, as_json)
    search = ExcitationSearch(duration, harmonics, starts, seed=seed)
    check_file(out)
    check_apart([Path(urdf)], [out])
    check_payload(payload)
    if floor is not None and not abs(floor) <= LARGEST:
        raise UserError(f"--floor is {floor:g} m; a finite height is required")
    robot = load_robot(urdf, named(joints))
    height = floor if floor is not None else 0.0 if stands(robot) else -math.inf
    rig = _rig(robot, {"speed": speed, "torque": torque}, acceleration, height, payload)
    for note in (*robot.notes, *_unlimited(robot, rig)):
        output.note(f"Note: {note}.")
    with output.steps("stating the problem"):
        known = model_sensitivity(rig)
        asked = information(rig, [name for name in known.names if name != "payload"], noise=NOISE, sensitivity=known)
    with parallel.workers(jobs, workers), output.count("motion", starts) as count:
        found = optimised(
            asked, search, lambda done, value: count(done, "starts" if math.isinf(value) else f"starts, best {value:.3f}")
        )
    motion = found.motion
    columns = {
        f"{kind}_{j}": row for kind in ("q", "dq", "ddq") for j, row in zip(robot.joints, getattr(motion, kind), strict=True)
    }
    write_csv(out, {"t": motion.t, **columns})
    result = _result(rig, asked, found)
    output.result(result | {"path": str(out)})
    _show_motion(result, output)
    if asked.inseparable:
        output.show(f"No motion determines these apart from the parameters above: {', '.join(asked.inseparable)}.")
    output.show(_what_to_do(out, robot, float(motion.t[-1])))


def _what_to_do(out: Path, robot: Robot, seconds: float) -> str:
    """What stands in the file, and what to record."""
    columns = f"t [s], and q_, dq_ and ddq_ [rad, rad/s, rad/s²] of {', '.join(robot.joints)}"
    follow = "Let the arm's own controller follow q, and record t, the measured q, and the torque or current of each."
    return f"{out} holds the motion of {seconds:g} s: {columns}. {follow}"


def _rig(robot: Robot, less: dict[str, float | None], acceleration: float, floor: float, payload: float) -> Rig:
    """The arm with the effects of every calibrated model, within its limits or the lower ones of `less`."""
    for name, limit in {**less, "acceleration": acceleration}.items():
        if limit is not None and not 0 < limit <= LARGEST:
            raise UserError(f"--{name} is {limit:g} {UNITS[name]}; above 0 is required{f', up to {LARGEST:g}' * (limit > 0)}")
    effects = tuple(kind((j,)) for j in range(robot.n) for kind in plain_effects())
    model = Model(robot, robot.tool, effects)
    known = robot_limits(robot, acceleration, floor)
    tighter = {name: np.minimum(getattr(known, name), math.inf if limit is None else limit) for name, limit in less.items()}
    limits = type(known)(known.lower, known.upper, tighter["speed"], known.acceleration, tighter["torque"], floor)
    return Rig(model, limits, np.array([p.nominal for p in model.parameters]), payload)


def _unlimited(robot: Robot, rig: Rig) -> list[str]:
    """What nothing limits, a sentence each."""
    missing = {
        "range; it is taken to turn by ±180°": ~(np.isfinite(robot.lower) & np.isfinite(robot.upper)),
        "speed; --speed gives one": ~np.isfinite(rig.limits.speed),
        "torque; --torque gives one": ~np.isfinite(rig.limits.torque),
    }
    named = {
        what: [j for j, bare in zip(robot.joints, bare_joints, strict=True) if bare] for what, bare_joints in missing.items()
    }
    hangs = ["the arm hangs from its base: nothing keeps the tool from what is below; --floor does"]
    found = [f"{', '.join(joints)}: the URDF has no limit of the {what}" for what, joints in named.items() if joints]
    return found + hangs * math.isinf(rig.limits.floor)


def _result(rig: Rig, asked: Information, found: Excitation) -> dict[str, Any]:
    motion, names = found.motion, rig.model.robot.joints
    spans = {"position_rad": motion.q, "speed_rad_per_s": motion.dq, "acceleration_rad_per_s2": motion.ddq}
    effects = {f"{rig.model.label(e)}.{p.name}": p.unit for e in rig.model.effects for p in e.parameters}
    unit = {name: effects.get(name) or UNITS_INERTIAL[name.rsplit(".", 1)[1]] for name in asked.interest}
    return {
        "standard_errors": {
            name: {"value": value if math.isfinite(value) else None, "unit": unit[name]}
            for name, value in asked.deviations(motion).items()
        },
        "noise_Nm": NOISE,
        "samples": len(motion.t),
        "condition": asked.condition(motion),
        "inseparable": list(asked.inseparable),
        "joints": {
            joint: {kind: [float(x[j].min()), float(x[j].max())] for kind, x in spans.items()} for j, joint in enumerate(names)
        },
        "status": found.status,
    }


def _show_motion(result: dict[str, Any], output: Output) -> None:
    rows = []
    for joint, spans in result["joints"].items():
        q = np.degrees(spans["position_rad"])
        fastest = (f"{max(map(abs, spans[kind])):.2f}" for kind in ("speed_rad_per_s", "acceleration_rad_per_s2"))
        rows.append([joint, f"{q[0]:.0f} … {q[1]:.0f}", *fastest])
    output.table(["joint", "position [°]", "speed [rad/s]", "acceleration [rad/s²]"], rows)
    title = f"standard error, for noise of {result['noise_Nm']:g} Nm in each of {result['samples']} samples"
    errors = [
        [name, "not determined" if error["value"] is None else f"{error['value']:.3g}", error["unit"]]
        for name, error in result["standard_errors"].items()
    ]
    output.table(["parameter", title, "unit"], errors)
