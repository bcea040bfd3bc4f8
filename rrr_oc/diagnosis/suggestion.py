"""Recordings that would decide between effects which the recordings at hand do not distinguish."""

import contextlib
from collections.abc import Sequence

import casadi as ca
import numpy as np

from rrr_oc.calibration.calibrated_model import CalibratedModel
from rrr_oc.calibration.estimator.knobs import DECISIVE
from rrr_oc.calibration.regression import rows
from rrr_oc.calibration.samples import Prepared
from rrr_oc.diagnosis.result import LINK_ERRORS, Finding, Suggestion
from rrr_oc.diagnosis.signatures import table, trials
from rrr_oc.effects import Trial, View
from rrr_oc.errors import UserError
from rrr_oc.excitation.design import ExcitationSearch, excite, times
from rrr_oc.excitation.fourier_series import Series
from rrr_oc.excitation.information import information, model_sensitivity
from rrr_oc.excitation.limits import MotionLimits, Rig, robot_limits
from rrr_oc.model.motion import Motion
from rrr_oc.numerics.rank import pseudo_inverse
from rrr_oc.recordings.header import Spring
from rrr_oc.recordings.recording import Recording, RecordingSet

DURATION, STEP = 20.0, 0.01  # length and sampling time of a suggested motion [s]; a longer one decides more
CANDIDATES = 10  # random motions that are compared; twice as many take twice the time for a slightly better one
HARMONICS = 4  # of a random motion's base frequency, which is one to three periods in `DURATION`
FASTER = 1.3  # largest speed of a suggested motion over the speed recorded; twice as fast may be more than the arm can follow
SHARES = (1.0, 0.8, 0.6, 0.4, 0.2)  # amplitudes that are tried until torque limits and floor are kept
OPTIMISED = 4  # joints up to which a motion is optimised, which takes a second; of more joints the best random one is suggested
ITERATIONS = 10  # of IPOPT; twice as many take a second more for a little more information


def suggest(
    recordings: RecordingSet, plain: CalibratedModel, findings: Sequence[Finding], undecided: bool, seen: View, seed: int = 0
) -> list[Suggestion]:
    """For each effect with rivals the motion, of several random ones, on which their torques differ most, and by how much.

    The difference is what remains when the rival and the plain parameters are fitted to it, in units of the noise. All motions
    keep to the limits of `_rig`; where no motion is found that does, nothing is suggested.

    Args:
        undecided: Whether there is a mismatch that no finding explains; then a motion that determines friction and inertia well is
            suggested, too.
    """
    contested = [f for f in findings if f.rivals]
    if not contested and not undecided:
        return []
    springs = max((r.springs for r in recordings.recordings), key=len)
    rig = _rig(recordings, plain, seen, springs)
    motions = [_prepared(motion, springs) for motion in _within_limits(rig, seed)]
    every, result = trials(seen, plain.torque), []
    if undecided:
        optimised = [_prepared(motion, springs) for motion in _optimised(rig, plain, seed)]
        why = "of the motions tried this one determines friction and inertia best; record it more than once, so that some can be held out"
        for best in sorted([*motions, *optimised], key=lambda m: -_log_information(m, plain))[:1]:
            result.append(Suggestion(why, (), best.recording))
    for finding in contested if motions else ():
        own = Trial(finding.term.effect, (finding.term.named,), width=finding.term.width)
        rivals = [[t for t in every if (t.effect.name, t.effect.joints) == rival] for rival in finding.rivals]
        links = LINK_ERRORS in finding.rivals
        rivals = [rival for rival in rivals if rival] or [[]] * links  # an empirical term is in no catalogue
        if not rivals:
            continue
        apart = [min(_difference(m, plain, own, rival, links) for rival in rivals) for m in motions]
        best = int(np.argmax(apart))
        names = (finding.term.effect.name, *dict.fromkeys(name for name, _ in finding.rivals))
        result.append(Suggestion(_why(apart[best]), names, motions[best].recording))
    return result


def _rig(recordings: RecordingSet, plain: CalibratedModel, seen: View, springs: tuple[Spring, ...]) -> Rig:
    """The arm with its largest payload and these springs, and limits that the recordings show to be safe.

    Positions stay within the range recorded and the arm's own; speeds within `FASTER` times the recorded ones and the arm's limits;
    motor torques within the arm's limits, or the recorded ones where these are larger; the tool no lower than recorded.
    """
    every, robot = recordings.recordings, recordings.robot
    payload, known = max(float(r.payload.max()) for r in every), robot_limits(robot)
    still = Motion(np.zeros(1), *np.zeros((3, robot.n, 1)), payload=np.full(1, payload))
    physics = plain.physics(Recording.planned("suggested", still, springs))
    torque = np.max([np.abs(recordings.output_torque(r)).max(axis=1) for r in every], axis=0)
    low, high = np.maximum(seen.low, robot.lower), np.minimum(seen.high, robot.upper)
    outside = low >= high  # recorded beyond the range that the robot's description allows
    q = ca.SX.sym("q", robot.n)
    height = ca.Function("height", [q], [physics.built.tool_height(q)])
    limits = MotionLimits(
        np.where(outside, seen.low, low),
        np.where(outside, seen.high, high),
        np.minimum(FASTER * seen.speed, np.maximum(known.speed, seen.speed)),
        np.full(robot.n, np.inf),
        np.maximum(known.torque, torque),
        min(float(np.min(np.asarray(height(r.q)))) for r in every),
    )
    return Rig(physics.built, limits, physics.theta, payload)


def _within_limits(rig: Rig, seed: int) -> list[Motion]:
    """Up to `CANDIDATES` random Fourier series that keep to the limits."""
    t, result = times(DURATION, STEP), []
    for k in range(3 * CANDIDATES):
        rng = np.random.default_rng([seed, k])
        series = Series(DURATION / rng.choice([1, 2, 3]), HARMONICS)
        x = series.random(rig.limits, rng)
        middle = np.outer(series.still, series.still @ x)
        for share in SHARES:
            motion = series.motion(middle + share * (x - middle), rig.limits, t)
            if max(rig.excess(*motion).values()) <= 0:
                result.append(Motion(t, *motion, np.full(len(t), rig.payload)))
                break
        if len(result) == CANDIDATES:
            break
    return result


def _optimised(rig: Rig, plain: CalibratedModel, seed: int) -> list[Motion]:
    """A D-optimal motion for friction and inertia, if one is found in a second or so."""
    if rig.model.robot.n > OPTIMISED:
        return []
    noise = np.where(np.isfinite(plain.noise) & (plain.noise > 0), plain.noise, 1.0)
    search = ExcitationSearch(DURATION, 2 * HARMONICS, starts=1, draws=CANDIDATES, seed=seed, iterations=ITERATIONS, step=STEP)
    with contextlib.suppress(UserError):  # no motion that keeps the limits; the random ones do
        known = model_sensitivity(rig)
        interest = [name for name in known.names if name != "payload"]
        return [excite(information(rig, interest, noise=noise, sensitivity=known), search).motion]
    return []


def _prepared(motion: Motion, springs: tuple[Spring, ...]) -> Prepared:
    recording, n = Recording.planned("suggested", motion, springs), len(motion.q)
    return Prepared(recording, np.zeros_like(motion.q), np.ones(motion.q.shape, bool), 0.2, np.zeros(n, int))


def _log_information(motion: Prepared, plain: CalibratedModel) -> float:
    """log det of a motion's information on friction and inertia [nat] (D-optimality), but for what no motion determines."""
    columns = np.concatenate(list(rows([motion], plain, inertial=True).jacobian))
    values = np.linalg.eigvalsh(columns.T @ columns)
    return float(np.sum(np.log(np.maximum(values, 1e-12 * values[-1]))))


def _why(apart: float) -> str:
    if apart > DECISIVE:
        return f"on this motion their torques differ by {np.sqrt(apart):.0f} standard deviations of the noise, whatever the rest does"
    return (
        f"on no motion tried do their torques differ by more than {np.sqrt(apart):.1f} standard deviations; record this one with another "
        "payload, or with springs or base set up differently"
    )


def _difference(motion: Prepared, plain: CalibratedModel, own: Trial, rival: Sequence[Trial], links: bool) -> float:
    """χ² of the effect's torque that neither the rival, in any of its shapes, nor the plain parameters, nor `links` explain."""
    found, signatures = rows([motion], plain, inertial=links), table([motion], plain, [own, *rival])
    deviation = np.where(np.isfinite(plain.noise), plain.noise, 1.0)
    size = int(signatures.start[-1]) + found.jacobian.shape[2]
    products = np.zeros((size, size))
    for j, (values, used) in enumerate(zip(signatures.values, signatures.used, strict=True)):
        columns = np.zeros((len(values), size))
        columns[:, used], columns[:, signatures.start[-1] :] = values, found.jacobian[j]
        products += columns.T @ columns / deviation[j] ** 2
    others, right = products[1:, 1:], products[1:, 0]  # the first column is the effect
    return max(float(products[0, 0] - right @ pseudo_inverse(others) @ right), 0.0)
