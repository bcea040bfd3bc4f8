"""The cost of a design in every member of a posterior: what the recordings let one foresee, and what would narrow it."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np

from rrr_oc.calibration.calibrated_model import CalibratedModel
from rrr_oc.calibration.estimator.data import EVERY
from rrr_oc.calibration.estimator.knobs import DECISIVE
from rrr_oc.calibration.samples import STRIDE
from rrr_oc.codesign.design_file import Foreseen, typed
from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.optimum import SampledMotion
from rrr_oc.codesign.posterior.members import Member
from rrr_oc.codesign.transfer import repaired
from rrr_oc.model.metrics import measure
from rrr_oc.model.motion import Motion
from rrr_oc.model.recorded_physics import Physics
from rrr_oc.model.shared_model import shared_model
from rrr_oc.numerics.along import along
from rrr_oc.recordings.recording import Recording

UNEXPLAINED = "with the torques on its links that no effect explains"
CENTRAL = (0.025, 0.975)  # quantiles of the draws that are the ends of a range
WIDE = 1.5  # upper over lower end of a range from which a recording is named; doubled, only ranges of three times are wide


def foreseen(design: CoDesign, motion: SampledMotion, theta: np.ndarray, every: Sequence[Member], file: str) -> Foreseen | None:
    """Ranges of E1 and of the cost of a motion with springs on the arm as each member has it; None where springs stand between drives
    and links, whose motion depends on the load.

    Args:
        design: Of the task as it was asked for, without effects of the arm.
        theta: Parameters of the springs (np,).
        file: Of the designed motion, by which it is named where recording this motion is what would narrow the range.
    """
    if design.series.rows:
        return None
    phases, rate, rows = motion.by_phase(design.task), _cost_rate(design), []
    for member in every:
        if any(t.recordings != "all" for t in member.model.terms):
            continue  # what is there in some recordings only may or may not be there in the task
        costs = np.array([_costs(design, phases, theta, model, rate) for model in (member.model, *member.draws)])
        low, high = np.quantile(costs[1:] if member.draws else costs, CENTRAL, axis=0)
        low, high = np.minimum(low, costs[0]), np.maximum(high, costs[0])
        ranges = {name: (low[i], high[i]) for i, name in enumerate(("E1", "cost"))}
        shows = file if member.model is every[0].model or _told_apart(every[0].model, member.model, phases) else None
        rows.append(ranges | {"says": member.says, "E1_itself": costs[0, 0], "decided_by": member.decided_by or shows})
    rows += _unexplained(design, every[0].model, motion, rows, file)
    whole = {key: (min(r[key][0] for r in rows), max(r[key][1] for r in rows)) for key in ("E1", "cost")}
    widest = _widest(rows) if whole["cost"][1] > WIDE * whole["cost"][0] else None
    narrowed = None if widest is None else widest["decided_by"]
    return typed(whole | {"members": rows, "widened_by": widest and widest["says"], "narrowed_by": narrowed}, Foreseen)


def _unexplained(
    design: CoDesign, model: CalibratedModel, motion: SampledMotion, rows: Sequence[Mapping[str, Any]], file: str
) -> list[dict[str, Any]]:
    """The range of E1 on an arm on whose links act, besides, the torques that the model leaves unexplained, or none if it leaves none.

    The norm of a sum of torques is between the difference and the sum of their norms, and E1 is a norm's square. Of costs other than
    E1 the range stays as it is, since they depend on the drives as well.
    """
    left = np.zeros(model.robot.n) if model.unexplained is None else model.unexplained
    seconds = sum(float(np.ptp(motion.t[k])) for k in motion.phases())
    norm = float(np.sqrt(seconds) * np.linalg.norm(left[list(design.task.moving)]))
    if not norm:
        return []
    ends = {key: (min(r[key][0] for r in rows), max(r[key][1] for r in rows)) for key in ("E1", "cost")}
    for key in ("E1", "cost") if design.cost == "load" else ("E1",):
        low, high = np.sqrt(ends[key])
        ends[key] = (max(low - norm, 0.0) ** 2, (high + norm) ** 2)
    return [ends | {"says": UNEXPLAINED, "E1_itself": rows[0]["E1_itself"], "decided_by": file}]


def _widest(rows: Sequence[Mapping[str, Any]]) -> Mapping[str, Any]:
    """The member that widens the range most: the calibrated model, unless another exceeds its range by more than half of that."""
    low, high = rows[0]["cost"]
    beyond = [max(r["cost"][1] - high, low - r["cost"][0]) for r in rows]
    most = int(np.argmax(beyond))
    return rows[most if beyond[most] > (high - low) / 2 else 0]


def _told_apart(one: CalibratedModel, other: CalibratedModel, phases: Sequence[Motion]) -> bool:
    """Whether recorded torques tell two models apart, by more than noise at the rows of a fit, when the phases of a motion are recorded."""
    apart = 0.0
    for phase in phases:
        recording = Recording.planned("designed", phase)
        change = (one.output_torque(recording) - other.output_torque(recording)) / np.where(one.noise > 0, one.noise, 1.0)[
            :, None
        ]
        apart += float(np.trapezoid(np.nansum(change**2, axis=0), phase.t)) / (STRIDE * EVERY)
    return apart > DECISIVE


def _costs(
    design: CoDesign, phases: Sequence[Motion], theta: np.ndarray, model: CalibratedModel, rate: ca.Function
) -> tuple[float, float]:
    """E1 [N²m²s] and the cost of a motion with springs on the arm that a model has."""
    there = repaired(design, model, ("", ""))
    known = np.append(theta, there.known_parameters)
    arm = shared_model(there.task.robot, there.task.tool, tuple(s.effect for s in there.springs))
    rows, torques, cost = list(there.task.moving), [], 0.0
    for i, (phase, payload) in enumerate(zip(phases, there.task.payloads, strict=True)):
        carried = replace(phase, payload=np.full(len(phase.t), payload))
        physics = Physics(arm, there.engaged(i, known), arm.widths, there.task.robot.inertial)
        tau = physics.torques(carried)[1][rows]
        torques.append((phase.t, tau))
        cost += float(np.trapezoid(along(rate, phase.dq[rows], phase.ddq[rows], tau)[0].ravel(), phase.t))
    return measure(torques).E1_total, cost


def _cost_rate(design: CoDesign) -> ca.Function:
    """(dq, ddq, load torque) of the moving joints (m,) each -> the cost's rate, in the cost's unit per second."""
    m, width = len(design.task.moving), design.power_width(design.data())
    dq, ddq, tau = ca.SX.sym("dq", m), ca.SX.sym("ddq", m), ca.SX.sym("tau", m)
    return ca.Function("rate", [dq, ddq, tau], [ca.densify(design.cost_rate(dq, ddq, tau, width))])
