"""An example of every effect: what it changes in the motor torque of the paper's arm, along one simple motion.

The effect stands in the model as a diagnosis would put it there, with amplitudes of one standard deviation of its prior, so that
the size is a usual one.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from rrr_oc.calibration.calibrated_model import CalibratedModel, Estimate, Term, nominal_term
from rrr_oc.calibration.inverse_dynamics import plain_model
from rrr_oc.calibration.samples import Prepared, prepare
from rrr_oc.diagnosis.signatures import black_box_trials, trials, view
from rrr_oc.effects import CATALOGUE, BlackBox, Effect, Trial, View, listed_springs
from rrr_oc.effects.base import SOUGHT
from rrr_oc.effects.words import Number, Several
from rrr_oc.model.motion import Motion
from rrr_oc.recordings.header import Loop
from rrr_oc.recordings.recording import Recording, RecordingSet
from rrr_oc.robot.robot import load_robot

J = 1  # the joint that carries the effect: joint 2, which lifts the arm
SECONDS, STEP, PAYLOAD = 10.0, 0.01, 2.0  # [s], [s], [kg]
# Each joint's sine [°], [°], [Hz]; a second one, so that acceleration is no function of position
CENTRES, SWINGS, HERTZ = (0.0, 60.0, -90.0), (60.0, 45.0, 50.0), (0.15, 0.2, 0.33)
SECOND, FASTER = 0.25, 2.6  # its amplitude and frequency over those of the first
SPRING = {"stiffness_Nm_per_rad": 6.0, "equilibrium_rad": 2.0}  # of joint 2, in parallel, as the recording lists it
DRY, VISCOUS, ARMATURE = (2.0, 3.0, 1.5), (3.0, 4.0, 2.0), (0.2, 0.3, 0.1)  # [Nm], [Nm s/rad], [kg m²], of the plain model
LATE = (0.004, 0.005, 0.006)  # [s], by which its torques are late
KP, KD = 600.0, 5.0  # [Nm/rad], [Nm s/rad], of the loop, for effects of recorded commands
FEW = 4  # curves that a picture shows, the largest ones
SHAPE = 0.25  # where in the list of an effect's trials the example is taken
CLOSE = 0.05  # share of a curve's mean square that a variable may leave open if the curve is said to follow it


@dataclass(frozen=True)
class Curve:
    """The change of the motor torque by an effect with one amplitude.

    Attributes:
        theta: Its parameters.
        change: Motor torque with the effect less that without it (n, K) [Nm].
    """

    theta: dict[str, float]
    change: np.ndarray


@dataclass(frozen=True)
class Example:
    """An effect on the example arm.

    Attributes:
        effect: The effect on its joints.
        recording: The motion.
        load: Load torque without the effect (n, K) [Nm].
        theta: Its parameters with all amplitudes.
        curves: One for each amplitude, the largest changes first.
        joint: The joint whose torque changes most.
    """

    effect: Effect
    recording: Recording
    load: np.ndarray
    theta: dict[str, float]
    curves: tuple[Curve, ...]
    joint: int

    def sentence(self) -> str:
        """How a diagnosis would tell of it; "" where the effect has no words of its own."""
        kind, joints = type(self.effect), tuple(f"joint {j + 1}" for j in self.effect.joints)
        if not kind.plain:
            return ""
        units = {p.name: p.unit for p in self.effect.parameters}

        def shown(part: Any) -> Number | Several:
            if isinstance(part, str):
                return Number(self.theta[part], units[part])
            return Several(tuple(map(shown, part)), units[part[0] if isinstance(part[0], str) else part[0][0]])

        values = {name: shown(part) for name, part in (kind.composed or {name: name for name in units}).items()}
        said = kind.sentence(joints, {**{name: getattr(self.effect, name) for name in kind.options}, **values})
        return said[:1].upper() + said[1:]


@dataclass(frozen=True)
class _Arm:
    """The example arm: its plain model, the motion, and what a diagnosis sees of it."""

    model: CalibratedModel
    prepared: Prepared
    view: View

    def trials(self, name: str) -> list[Trial]:
        """The ways in which a diagnosis would try an effect."""
        recorded = CATALOGUE[name].recorded_as
        torque = "motor" if "motor" in recorded else recorded[0]
        of_two = replace(self.view, groups=(*self.view.groups, "another"))  # for what differs between recordings
        for seen in (self.view, of_two):
            every = [*trials(seen, torque), *black_box_trials([self.prepared], seen, self.model, J)]
            if found := [trial for trial in every if trial.effect.name == name]:
                return found
        return list(CATALOGUE[name].trials(self.view))


@cache
def _arm() -> _Arm:
    robot, t = load_robot("rrr"), np.arange(round(SECONDS / STEP)) * STEP
    centre, swing = (np.radians(x)[:, None] for x in (CENTRES, SWINGS))
    omega = 2 * np.pi * np.array(HERTZ)[:, None]
    sines = [(swing, omega), (SECOND * swing, FASTER * omega)]
    q = centre + np.sum([a * np.sin(w * t) for a, w in sines], axis=0)
    dq, ddq = (
        np.sum(x, axis=0) for x in zip(*((a * w * np.cos(w * t), -a * w**2 * np.sin(w * t)) for a, w in sines), strict=True)
    )
    motion = Motion(t, q, dq, ddq, np.full(t.size, PAYLOAD))
    recording = Recording.planned("example", motion, (listed_springs()["pea"].from_entry((J,), SPRING),))
    recording = replace(recording, loop=Loop(np.full(robot.n, KP), np.full(robot.n, KD)))
    unknown = (None,) * robot.n
    recordings = RecordingSet(robot, "rrr", "motor", "nominal", robot.tool, unknown, (recording,), Path("example"))
    model = plain_model(recordings)
    model = replace(model, terms=tuple(term.with_values(_sizes(term)) for term in model.prompt_terms))
    recording = replace(recording, tau=model.output_torque(recording))
    (prepared,) = prepare(replace(recordings, recordings=(recording,)))
    r = prepared.recording
    prepared = replace(prepared, recording=replace(r, command=r.q + (r.tau + KD * r.dq) / KP))
    return _Arm(model, prepared, view([prepared], model))


def _sizes(term: Term) -> np.ndarray:
    """Parameters of the plain model, by their unit; nominal ones for a unit that is not known."""
    known = {"Nm": DRY, "Nm s/rad": VISCOUS, "kg m²": ARMATURE, "s": LATE}
    joint, parameters = term.effect.joints[0], term.effect.parameters
    return np.array([known[p.unit][joint] if p.unit in known else p.nominal for p in parameters])


@cache
def example(name: str) -> Example | None:
    """The example of an effect of the catalogue; None where a diagnosis that looks for it would not try it on this arm."""
    arm, kind = _arm(), CATALOGUE[name]
    recording = arm.prepared.recording
    of = [t for t in arm.trials(name) if t.effect.joints[:1] in ((), (J,))] if kind.role in SOUGHT else []
    if kind.role in SOUGHT and not of:
        return None
    whole, terms = _typical(arm, _chosen(of)) if kind.role in SOUGHT else _alone(arm, kind)
    effect = whole.effect
    without = replace(arm.model, terms=tuple(t for t in arm.model.terms if t.effect != effect))
    plain = without.output_torque(recording)
    curves = [
        Curve(term.named, replace(without, terms=(*without.terms, term)).output_torque(recording) - plain) for term in terms
    ]
    sizes = [float(np.sqrt(np.mean(curve.change**2))) for curve in curves]
    order = [k for k in np.argsort(sizes)[::-1][:FEW] if sizes[k] > 0.05 * max(sizes)]
    largest = np.sqrt(np.mean(sum(np.abs(c.change) for c in curves) ** 2, axis=1))
    _, load = arm.model.torques(recording)
    return Example(effect, recording, load, whole.named, tuple(curves[k] for k in order), int(np.argmax(largest)))


def _alone(arm: _Arm, kind: type[Effect]) -> tuple[Term, Sequence[Term]]:
    """The term of the plain model, or of a spring of co-designs with its nominal parameters."""
    found = [t for t in arm.model.terms if t.effect.name == kind.name and t.effect.joints == (J,)]
    term = found[0] if found else nominal_term(kind((J, J + 1) if kind.placement == "pair" else (J,)))
    term = term if found or kind.role != "plain" else term.with_values(_sizes(term))
    return term, [term]


def _chosen(of: Sequence[Trial]) -> Trial:
    """A usual shape; of a black-box term one over the joint's position."""
    if isinstance(of[0].effect, BlackBox):
        return next((t for t in of if isinstance(t.effect, BlackBox) and t.effect.depends_on[:1] == (("q", J),)), of[0])
    return of[int(SHAPE * (len(of) - 1))]


def _typical(arm: _Arm, trial: Trial) -> tuple[Term, Sequence[Term]]:
    """The term with all coefficients at one standard deviation of their priors, and terms with one of them, the others 0."""
    effect, scales = trial.effect, trial.effect.scales(arm.view, trial)

    def term(coefficients: np.ndarray) -> Term:
        theta = effect.combined(trial.points, coefficients)
        return Term(effect, tuple(Estimate(float(theta[p.name])) for p in effect.parameters), trial.width)

    return term(scales), [term(one) for one in np.diag(scales)]


def followed(of: Example) -> tuple[str, int] | None:
    """The variable of the motion that the first curve follows, as its kind ("q", "dq", "ddq" or "load") and joint.

    Motion to and fro may have a course of its own. None where no variable leaves less than `CLOSE` of the curve's mean square.
    """
    r, y, own = of.recording, of.curves[0].change[of.joint], of.joint
    first = ("dq", "q", "ddq") if of.effect.side == "drive" else ("q", "dq", "ddq")
    every = {(kind, own): getattr(r, kind)[own] for kind in first} | {("load", own): of.load[own]}
    for j in of.effect.joints or range(len(r.q)):
        every |= {(kind, j): getattr(r, kind)[j] for kind in ("q", "dq") if j != own}
    left = {key: _left_open(x, y, r.dq[own] > 0) for key, x in every.items()}
    best = min(left.values())
    if best > CLOSE:
        return None
    return next(
        key for key, share in left.items() if share <= best + 0.01
    )  # the simpler one where there is hardly a difference


def _left_open(x: np.ndarray, y: np.ndarray, up: np.ndarray) -> float:
    """Half the mean square of the steps of y from one x to the next larger one, over that of y; each direction of motion apart."""
    steps = [np.diff(y[way][np.argsort(x[way])]) for way in (up, ~up)]
    return float(sum(np.sum(step**2) for step in steps) / (2 * np.sum(y**2)))
