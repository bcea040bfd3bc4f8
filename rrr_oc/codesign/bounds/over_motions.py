"""A lower bound of E1 over all motions of a task and all springs that a design allows.

The arm is at rest at both ends of a phase, and its accelerations are at most a. So at a time t before the end of one phase and t after
the start of the next its angles q and q' are within a t² / 2 of the same posture, and the torques s and s' that springs give there differ
by at most G a t², where G bounds the stiffness of the springs. But the torques tau and tau' that are needed with and without payload
differ by more. By the triangle inequality

    |tau − s|² + |tau' − s'|²  ≥  Σ_joints max(|tau − tau'| − G a t², 0)² / 2 ,

where |tau − tau'| is bounded by intervals over all angles, speeds and accelerations that are possible at t. The right-hand side is
integrated over half of the shortest phase, and added for release and start. Without springs, |tau|² is bounded in the same way.

A spring that a clutch connects in one phase only can give two torques in one posture, so the joints on which one acts are left out of
the sum.
"""

import itertools

import numpy as np

from rrr_oc.codesign.bounds.on_motion import Needed, SpringPlace
from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.springs import SpringBounds
from rrr_oc.codesign.task import Task
from rrr_oc.effects import Clutched
from rrr_oc.numerics.enclosure import NotEnclosed, enclosed, enclosures, evaluated

BOXES = 20_000  # of a spring's parameters, in each of which its stiffness is bounded; doubled, that is closer
STEPS = 200  # in which half of the shortest phase is divided; doubled, the bound over all motions is up to a per cent larger
PIECES = 100  # of what is possible at an instant of that; doubled, the intervals are narrower, most where arms are free to move


def task_bound(design: CoDesign) -> float | None:
    """The bound [N²m²s]; None where the cost is not E1, the arm is not at rest between phases or its accelerations have no limits,
    where clutched springs act on all joints, or where a torque has no interval form."""
    task, springs = design.task, [spring for spring in design.springs if not spring.known]
    if design.cost != "load" or not task.at_rest or any(task.goals) or not np.all(np.isfinite(task.acceleration)):
        return None
    clutched = {j for spring in springs if isinstance(spring.effect, Clutched) for j in spring.effect.joints}
    lasting = [row for row, j in enumerate(task.moving) if j not in clutched]
    if not lasting:
        return None
    step = task.duration[0] / 2 / STEPS
    t = step * np.arange(1, STEPS + 1)
    try:
        stiffness = sum((_stiffness(task, spring) for spring in springs), np.zeros((len(task.moving),) * 2))
        total = 0.0
        for posture in (task.start, task.release):
            (low, high), (least, most) = (_needed_near(design, posture, payload, t) for payload in task.payloads)
            if springs:
                apart = np.maximum(low - most, least - high) - np.outer(stiffness @ task.acceleration, t**2)
                rate = (np.maximum(apart, 0) ** 2)[lasting].sum(axis=0) / 2
            else:
                rate = sum((np.maximum(np.maximum(a, -b), 0) ** 2).sum(axis=0) for a, b in ((low, high), (least, most)))
            total += step * float(np.sum(rate))
    except NotEnclosed:
        return None
    return total


def _needed_near(design: CoDesign, posture: np.ndarray, payload: float, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Least and greatest torque without springs [Nm], (m, T), over all motions at a time t (T,) away from rest in a posture."""
    task, a = design.task, design.task.acceleration[:, None]
    bare = CoDesign(task, tuple(spring for spring in design.springs if spring.known))
    constants, m = (bare.known_parameters.tolist(), [0.0] * bare.model.widths.size), len(task.moving)
    way, speed = a * t**2 / 2, np.minimum(a * t, task.speed[:, None])
    angles = [np.clip(posture[:, None] + side * way, task.lower[:, None], task.upper[:, None]) for side in (-1, 1)]
    lower, upper = _pieces(np.vstack([angles[0], -speed]), np.vstack([angles[1], speed]))
    push = np.broadcast_to(a, (m, lower.shape[1]))
    lower, upper = np.vstack([lower, -push]), np.vstack([upper, push])
    motion = enclosures(lower, upper)
    found = evaluated(bare.torques, [motion[:m], motion[m : 2 * m], motion[2 * m :], [payload], *constants])[0]
    value = np.array(bare.torques(*np.split((lower + upper) / 2, 3), payload, *constants)[0])
    steepest = np.array([np.maximum(-f.slopes[0], f.slopes[1])[:, :, 0] for f in found])
    reach = (steepest * (upper - lower) / 2).sum(axis=1)
    least, greatest = (x.reshape(m, -1, t.size) for x in (value - reach, value + reach))
    return least.min(axis=1), greatest.max(axis=1)


def _pieces(lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Boxes (d, P) cut into equal pieces along all axes, (d, pieces × P), about `PIECES` each."""
    count = int(PIECES ** (1 / len(lower)))
    first = np.array(list(itertools.product(range(count), repeat=len(lower)))).T[:, :, None] / count
    below, above = (lower[:, None, :] + part * (upper - lower)[:, None, :] for part in (first, first + 1 / count))
    return below.reshape(len(lower), -1), above.reshape(len(lower), -1)


def _stiffness(task: Task, spring: SpringBounds) -> np.ndarray:
    """Upper bounds of |d torque / d angle| of a spring [Nm/rad], (m, m), over all angles and all that its bounds allow."""
    place = SpringPlace(
        spring, Needed(np.empty((0, 0)), np.empty((0, 0)), task.moving, np.empty(0), np.empty(0))
    )  # of no motion
    joints = place.rows
    count = int(BOXES ** (1 / max(len(place.others), 1)))
    axes = [np.linspace(a, b, count + 1 if b > a else 2) for a, b in zip(spring.lower, spring.upper, strict=True)]
    lower, upper = (
        np.array(list(itertools.product(*(axes[i][s] for i in place.others)))).T for s in (slice(-1), slice(1, None))
    )
    size = lower.shape[1]
    angles = [np.repeat(limit[joints][:, None], size, axis=1) for limit in (task.lower, task.upper)]
    parameters = enclosures(np.vstack([angles[0], lower]), np.vstack([angles[1], upper]))
    q = dict(zip(spring.effect.joints, parameters, strict=False))
    strongest, bound = np.maximum(place.strongest(lower, upper), 0), np.zeros((len(task.moving),) * 2)
    for row, part in zip(joints, map(enclosed, place.shape(parameters[len(joints) :], q)), strict=True):
        if part.slopes is None:  # the same torque everywhere
            continue
        slopes = np.maximum(-part.slopes[0], part.slopes[1])[: len(joints), :, 0]
        bound[row, joints] = (strongest * slopes).max(axis=1)
    return bound
