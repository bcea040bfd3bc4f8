"""Between recordings and design: an optimum in the twin calibrated on recordings, and a design on the arm that they revealed."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from rrr_oc.calibration.calibrated_model import CalibratedModel, Term
from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.optimum import Motion, describe
from rrr_oc.codesign.task import PHASES
from rrr_oc.effects import Body, Effect
from rrr_oc.errors import UserError
from rrr_oc.model.metrics import measure
from rrr_oc.model.recorded_physics import Physics
from rrr_oc.model.symbolic_model import Model
from rrr_oc.recordings.recording import Recording
from rrr_oc.robot.drives import Actuators
from rrr_oc.simulation.engine_model import Settings, twin
from rrr_oc.simulation.tracking import ReferencePhase, check_gears, track


def check_transfer(design: CoDesign, calibrated: CalibratedModel) -> None:
    """Raise `UserError` where a calibrated model is of other joints, or has terms that no simulation of a task can have."""
    if calibrated.joints != design.task.robot.joints:
        raise UserError(
            f"the model has the joints {', '.join(calibrated.joints)}, but the task's robot {', '.join(design.task.robot.joints)}"
        )
    some = [term.effect.name for term in calibrated.terms if term.recordings != "all"]
    if some:
        raise UserError(f"the model's {some[0]} holds for single recordings only; a model whose terms hold for all is needed")
    check_gears(twin(*_parts(design, calibrated, np.zeros(len(design.model.parameters))), settings=Settings("native")))


def repaired(design: CoDesign, calibrated: CalibratedModel, groups: Sequence[str]) -> CoDesign:
    """The design on the arm as recordings showed it, with what a diagnosis added on the links and in the rigid body.

    Of the other effects none changes the load torque of a motion of the links: those of the drives and of the sensors stand between
    it and the recorded torque, those of the side "motion" between the links and the encoders; and effects of a spring that a
    recording lists leave with that spring.

    Args:
        groups: Label of the physical set-up of each phase ("go", "return"), for terms that hold for some groups only.

    Raises:
        UserError: The model is of other joints; an effect other than the payload's comes and goes between the phases.
    """
    task = design.task
    if calibrated.joints != task.robot.joints:
        raise UserError(
            f"the model has the joints {', '.join(calibrated.joints)}, but the task's robot {', '.join(task.robot.joints)}"
        )
    known, payload = [], task.payload
    for term in calibrated.terms:
        effect = term.effect
        if effect.side not in ("link", "body") or "springs" in effect.inputs:
            continue
        there = [term.recordings == "all" or group in term.groups for group in groups]
        if all(there) or (effect.alters == "position" and there[0]):  # without a payload its point means nothing
            known.append((effect, term.values))
        elif effect.alters == "payload" and there[0]:
            payload = effect.change(Body(None, None, payload, None), term.named).payload
        elif any(there):
            raise UserError(f"{effect.name} holds for {' and '.join(term.groups)}, but not in every phase of the task")
    there = replace(task, robot=replace(task.robot, inertial=calibrated.robot.inertial), tool=calibrated.tool, payload=payload)
    return replace(design, task=there).with_physics(known)


def describe_transfer(
    design: CoDesign, motion: Motion, theta: np.ndarray, calibrated: CalibratedModel, drives: Actuators
) -> dict[str, Any]:
    """The paper's metrics of an optimum tracked in the calibrated twin, by both routes to the load torque.

    The robot and its payload's point are the calibrated model's, the springs and the motion the optimum's. What the model predicts
    as motor torque is fed forward, the paper's P-controllers do the rest.

    Returns:
        "engine": from M ddq + C dq + G − tau_spring of the engine's motion; "eq10": from the controllers' torque through Eq. 10,
        each as `describe` gives it; "motor": the same of the motor torque itself; "tracking_error_rad"; "saturated": whether a
        controller ran into its limit.
    """
    task, references = design.task, reference_phases(design, motion, theta, calibrated)
    model, theta = _parts(design, calibrated, theta)
    widths = _widths(design, calibrated)
    tracked = track(model, references, theta, settings=Settings(effects="native"), widths=widths)
    rows = [task.robot.index(joint) for joint in drives.joints]
    by_eq10 = [np.array(drives.load_from_motor(p.dq[rows], p.ddq[rows], p.tau_motor[rows])[0]) for p in tracked.phases]
    return {
        "engine": describe(design, tracked.metrics, task.moving),
        "eq10": describe(design, measure([(p.t, tau) for p, tau in zip(tracked.phases, by_eq10, strict=True)])),
        "motor": describe(design, measure([(p.t, p.tau_motor) for p in tracked.phases]), task.moving),
        "tracking_error_rad": float(max(np.abs(p.error).max() for p in tracked.phases)),
        "saturated": bool(np.any(tracked.saturated)),
    }


def reference_phases(design: CoDesign, motion: Motion, theta: np.ndarray, calibrated: CalibratedModel) -> list[ReferencePhase]:
    """The phases of an optimum as references for controllers; `tau_load` holds the motor torque that the calibrated model expects."""
    task, model, theta = design.task, *_parts(design, calibrated, theta)
    widths, references = _widths(design, calibrated), []
    for i, k in enumerate(motion.phases()):
        q, dq, ddq = (task.full(values[:, k]) for values in (motion.q, motion.dq, motion.ddq))
        t, payload = motion.t[k] - motion.t[k[0]], task.payloads[i]
        planned = Recording.planned(PHASES[i], t, q, dq, ddq, payload)
        motor, _ = Physics(model, theta, widths, model.robot.inertial).torques(planned)
        references.append(ReferencePhase(PHASES[i], t, q, dq, ddq, payload, motor))
    return references


def transfer_table(configurations: Mapping[str, Mapping[str, Any]]) -> str:
    """Decrease against stiff actuation of E1 in the calibrated twin, by both routes, in Markdown; "" where nothing was transferred."""
    known = {name: c["calibrated"] for name, c in configurations.items() if c.get("calibrated")}
    if not known:
        return ""
    stiff = known.get("SA")
    lines = [
        "\n## In the twin calibrated on recordings\n",
        "Each optimum tracked by P-controllers helped by the model's own torque; E1 [N²m²s], and its decrease against SA, of the load "
        "torque that the engine gives, and of the controllers' torque through Eq. 10.\n",
        "|  | engine | decrease | Eq. 10 | decrease | RMS motor torque [Nm] | tracking [rad] | at its limit |",
        "| --- " * 8 + "|",
    ]
    for name, c in known.items():
        cells = []
        for route in ("engine", "eq10"):
            less = "" if stiff is None or name == "SA" else f"{100 * (1 - c[route]['E1'] / stiff[route]['E1']):.1f} %"
            cells += [f"{c[route]['E1']:.2f}", less]
        rms = ", ".join(f"{v:.1f}" for v in c["motor"]["rms"].values())
        limit = "yes" if c["saturated"] else "no"
        lines.append(f"| {name} | {' | '.join(cells)} | {rms} | {c['tracking_error_rad']:.4f} | {limit} |")
    return "\n".join(lines) + "\n"


def _parts(design: CoDesign, calibrated: CalibratedModel, theta: np.ndarray) -> tuple[Model, np.ndarray]:
    """The calibrated robot with the optimum's springs and the calibrated terms, and all their parameters."""
    springs = _springs(design)
    own = theta[: sum(len(e.parameters) for e in springs)]
    terms = _terms(calibrated)
    effects = (*springs, *(term.effect for term in terms))
    return Model(calibrated.robot, calibrated.tool, effects), np.concatenate([own, *(t.values for t in terms)])


def _terms(calibrated: CalibratedModel) -> list[Term]:
    """The calibrated terms but for those of springs that were mounted then."""
    return [term for term in calibrated.terms if "springs" not in term.effect.inputs]


def _springs(design: CoDesign) -> list[Effect]:
    """The springs of the design itself; what is known beside them is among the calibrated terms."""
    return [s.effect for s in design.springs if not s.known]


def _widths(design: CoDesign, calibrated: CalibratedModel) -> np.ndarray:
    own = [e.width.nominal for e in _springs(design) if e.width is not None]
    return np.array(own + [term.width for term in _terms(calibrated) if term.width is not None])
