"""Recordings that would decide between effects which the recordings at hand do not tell apart."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rrr_oc.calibration.calibrated_model import CalibratedModel
from rrr_oc.calibration.regression import rows
from rrr_oc.calibration.samples import Prepared
from rrr_oc.diagnosis.contest import Finding
from rrr_oc.diagnosis.signatures import table, trials
from rrr_oc.effects import Trial, View
from rrr_oc.numerics.rank import pseudo_inverse
from rrr_oc.recordings.recording import Recording, RecordingSet

DURATION, STEP = 20.0, 0.01  # s
TRIED = 10  # motions
HARMONICS = 4
FASTER = 1.3  # than what was recorded, at most
DECISIVE = 25.0  # χ² of the difference, above which a motion is said to decide


@dataclass(frozen=True)
class Suggestion:
    """A motion to record.

    Attributes:
        why: In words.
        separates: Names of the effects.
        t: Times [s], (K,).
        q: Positions [rad], (n, K).
    """

    why: str
    separates: tuple[str, ...]
    t: np.ndarray
    q: np.ndarray


def suggest(
    recordings: RecordingSet, plain: CalibratedModel, findings: Sequence[Finding], undecided: bool, seen: View, seed: int = 0
) -> list[Suggestion]:
    """For each effect with rivals the motion, of several, on which their torques differ most, and by how much.

    What counts is the difference that is left when the rival and the plain parameters do their best, in units of the noise.

    Args:
        undecided: Whether there is a mismatch that nothing found explains; then the motion which excites most is suggested.
    """
    contested = [f for f in findings if f.rivals]
    if not contested and not undecided:
        return []
    motions = [_motion(recordings, seen, np.random.default_rng([seed, k])) for k in range(TRIED)]
    every = trials(seen, plain.torque)
    result = []
    if undecided:
        known = [_known(m, plain) for m in motions]
        motion = motions[int(np.argmax(known))].recording
        why = "of several motions this one tells most of friction and inertia; record it more than once, so that some can be held out"
        result.append(Suggestion(why, (), motion.t, motion.q))
    for finding in contested:
        own = _trial(finding)
        rivals = [[t for t in every if (t.effect.name, t.effect.joints) == rival] for rival in finding.rivals]
        rivals = [rival for rival in rivals if rival]  # an empirical term is in no catalogue
        if not rivals:
            continue
        apart = [min(_difference(m, plain, own, rival) for rival in rivals) for m in motions]
        best = int(np.argmax(apart))
        names = (finding.term.effect.name, *dict.fromkeys(name for name, _ in finding.rivals))
        motion = motions[best].recording
        result.append(Suggestion(_why(apart[best]), names, motion.t, motion.q))
    return result


def _known(motion: Prepared, plain: CalibratedModel) -> float:
    """Logarithm of the determinant of what a motion tells of friction and inertia (D-optimality), but for what none tells."""
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


def _trial(finding: Finding) -> Trial:
    """The effect as found, its linear parameters as coefficients."""
    effect, values = finding.term.effect, finding.term.values
    named = {p.name: float(v) for p, v in zip(effect.parameters, values, strict=True)}
    return Trial(effect, (named,), width=finding.term.width)


def _difference(motion: Prepared, plain: CalibratedModel, own: Trial, rival: Sequence[Trial]) -> float:
    """χ² of the effect's torque that neither the rival, in any of its shapes, nor the plain parameters can take up."""
    found = rows([motion], plain)
    signatures = table([motion], plain, [own, *rival])
    total = 0.0
    deviation = np.where(np.isfinite(plain.noise), plain.noise, 1.0)
    columns = int(signatures.start[-1])
    matrix, right, power = np.zeros((columns - 1 + found.jacobian.shape[2],) * 2), 0.0, 0.0
    for j, (values, used) in enumerate(zip(signatures.values, signatures.used, strict=True)):
        whole = np.zeros((len(values), columns))
        whole[:, used] = values
        target, others = whole[:, 0] / deviation[j], np.hstack([whole[:, 1:], found.jacobian[j]]) / deviation[j]
        matrix += others.T @ others
        right = right + others.T @ target
        power += float(target @ target)
    total = power - float(right @ pseudo_inverse(matrix) @ right)
    return max(total, 0.0)


def _motion(recordings: RecordingSet, seen: View, rng: np.random.Generator) -> Prepared:
    """A random Fourier series within the range and a little above the speed of what was recorded."""
    t = np.arange(round(DURATION / STEP) + 1) * STEP
    base = 2 * np.pi / DURATION
    k = np.arange(1, HARMONICS + 1) * rng.choice([1, 2, 3])
    coefficients = rng.normal(size=(seen.n, 2, HARMONICS)) / k
    wave = np.stack([np.sin(base * np.outer(k, t)), np.cos(base * np.outer(k, t))])  # (2, harmonics, K)
    slope = np.stack([np.cos(base * np.outer(k, t)), -np.sin(base * np.outer(k, t))]) * (base * k)[None, :, None]
    bend = -wave * ((base * k) ** 2)[None, :, None]
    q, dq, ddq = (np.einsum("jsh,shk->jk", coefficients, x) for x in (wave, slope, bend))
    scale = np.minimum((seen.high - seen.low) / np.ptp(q, axis=1), FASTER * seen.speed / np.max(np.abs(dq), axis=1))
    middle = (seen.high + seen.low) / 2 - scale * (q.max(axis=1) + q.min(axis=1)) / 2
    q, dq, ddq = scale[:, None] * q + middle[:, None], scale[:, None] * dq, scale[:, None] * ddq
    payload = max(float(r.payload.max()) for r in recordings.recordings)
    springs = max((r.springs for r in recordings.recordings), key=len)
    recording = Recording.planned("suggested", t, q, dq, ddq, payload, springs)
    return Prepared(recording, np.zeros_like(q), np.ones(q.shape, bool), 0.2, np.zeros(seen.n, int))
