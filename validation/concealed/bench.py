"""One declared case's arm, references and set-ups, on which effects are tried until each is as strong as asked for."""

from dataclasses import replace
from typing import Any

import numpy as np

from validation.concealed.arms import PROTOTYPE_MOTOR, Arm, generated_arm, holding_torque, rrr_arm
from validation.concealed.cases import OWN, Case, Concealed
from validation.concealed.catalogue import SENSED, effect_type
from validation.concealed.effect import Effect, Motion, Signals
from validation.concealed.equal import Jacobian, equal_effects
from validation.concealed.plain import PlainFit, calibrate, calibrate_inertials, smoothed, subset, thinned
from validation.concealed.plant import LEAD, History, Plant, Setup, signals
from validation.concealed.sensors import Sensing
from validation.concealed.strength import Scaled, scale
from validation.concealed.trajectories import reference

STEP = 2e-3  # [s]
FINE_STEP = {"joint_elasticity": 1e-3, "presliding_hysteresis": 1e-3, "backlash": 5e-4}  # [s]
PLACES = 5  # that are tried where no strength that is allowed shows, as of an encoder's offset about a vertical axis
HIDDEN = 0.5  # of the strength that is asked for
TWO_INERTIAS = {"joint_elasticity", "backlash"}
GROUPS = ("a", "a", "b", "b", "c", "c", "d", "d")


def make_arm(case: Case) -> Arm:
    rng = case.rng("arm")
    if case.robot.startswith("rrr"):
        return rrr_arm(case.robot, rng, motor=PROTOTYPE_MOTOR if case.motor else None)
    n = int(case.robot.removeprefix("arm"))
    return generated_arm(n, rng, extra=case.locked, wrong_inertials=case.inertial == "identify")


class Bench:
    """One case's references and set-ups, on which effects are tried."""

    def __init__(self, case: Case, arm: Arm, kinds: tuple[str, ...], seen: int, duration: float):
        self.case, self.arm, self.kinds, self.seen, self.duration = case, arm, kinds, seen, duration
        self.setup = mounted(case, arm, len(kinds))
        some = any(c.groups for c in case.concealed)
        known = (OWN if case.alone else GROUPS)[:seen]
        self.groups = (*known, *self.unseen_groups(known)) if some else (None,) * len(kinds)
        self.histories: dict[tuple, History] = {}
        self.constants = case.rng("current").uniform(5.0, 15.0, arm.n) if case.torque == "current" else None
        self.baseline = self.history([])
        x = self.signals([])
        self.sensing = self.noise(thinned(x, 100.0))
        self.motion = self.baseline_motion(x)
        self.rings = any(c.effect in TWO_INERTIAS for c in case.concealed)
        self.floor = np.zeros(1)
        self.floor = self.fit(x).residual

    def unseen_groups(self, known: tuple[str, ...]) -> tuple[str, ...]:
        """One unseen recording of the group that has an effect, the others of groups that have none."""
        affected = next(c.groups[0] for c in self.case.concealed if c.groups)
        others = [g for g in dict.fromkeys(known) if g != affected]
        return (affected, *others)[: len(self.kinds) - self.seen]

    def references(self, step: float) -> np.ndarray:
        """(B, n, T), with the settling time before t = 0."""
        t = np.arange(round(self.duration / step) + 1) * step
        lead = round(LEAD / step)
        out = []
        for b, kind in enumerate(self.kinds):
            q = reference(kind, self.arm, t, self.case.rng(f"trajectory {b}"))
            out.append(np.concatenate([np.repeat(q[:, :1], lead, axis=1), q], axis=1))
        return np.stack(out)

    def step(self) -> float:
        """Of the simulation [s]."""
        return min(FINE_STEP.get(c.effect, STEP) for c in (*self.case.concealed, Concealed("", 0.0)))

    def history(self, effects: list[Effect]) -> History:
        """Simulated; effects of the sensing chain do not change it, and the last plant's run is kept."""
        moving = [e for e in effects if e.name not in SENSED and e.strength > 0]
        key = tuple((e.name, e.joints, e.strength) for e in moving)
        if key not in self.histories:
            if len(self.histories) > 2:
                self.histories.pop(list(self.histories)[1])
            step = self.step()
            self.histories[key] = Plant(self.arm, self.setup, moving, step).run(self.references(step))
        return self.histories[key]

    def signals(self, effects: list[Effect]) -> Signals:
        return signals(self.history(effects), self.arm, effects, self.case.torque)

    def fit(self, x: Signals) -> PlainFit:
        """Plain calibration of the noise-free seen recordings at 50 Hz; less the smoothing's own residual, if smoothed."""
        setup = Setup(self.setup.payload[: self.seen], self.setup.springs[: self.seen], self.setup.gravity)
        how = calibrate_inertials if self.case.inertial == "identify" else calibrate
        rate = 12.5 if self.case.inertial == "identify" else 50.0
        if not self.rings:
            return how(self.arm, setup, subset(thinned(x, rate), slice(self.seen)))
        fit = how(self.arm, setup, subset(thinned(smoothed(x), rate), slice(self.seen)))
        return replace(fit, residual=fit.residual - self.floor)

    def noise(self, x: Signals) -> Sensing:
        rng, case = self.case.rng("noise"), self.case
        share = rng.uniform(0.01, 0.02) * (2.5 if case.short else 1.0)
        deviation = np.maximum(share * x.tau.std(axis=(0, 2)), 0.005)  # [Nm]
        untidy: dict[str, Any] = {"jitter": 0.15, "lost": 0.02} if case.short else {}
        bits = int(rng.integers(18, 21))
        return Sensing(deviation, encoder_bits=bits, **(untidy | case.options))

    def baseline_motion(self, x: Signals) -> Motion:
        x = subset(thinned(x, 50.0), slice(self.seen))
        load = self.baseline.load[: self.seen, :, :: max(1, self.baseline.load.shape[2] // 1500)]
        return Motion(x.q, x.dq, load, self.setup.payload, self.setup.springs, self.duration)

    def concealed(self, what: Concealed, index: int) -> Scaled:
        """One effect, placed where it shows, and scaled to its ratio as if it were alone."""
        rng, found = self.case.rng(f"effect {index} {what.effect}"), []
        for _ in range(PLACES):
            found.append(self.placed(what, rng))
            if found[-1].reached > HIDDEN * what.ratio:
                break
        return max(found, key=lambda s: min(s.reached, what.ratio))

    def placed(self, what: Concealed, rng: np.random.Generator) -> Scaled:
        effect = effect_type(what.effect).draw(self.arm, self.motion, rng)
        mask = np.array([what.groups is None or g in what.groups for g in self.groups], float)
        effect = effect.on(mask)
        scaled = scale(effect, what.ratio, self.measure)
        if effect.shape.get("law", "smooth_dahl") != "smooth_dahl" and scaled.reached > 1.3 * what.ratio:
            smooth = replace(effect, shape=effect.shape | {"law": "smooth_dahl"})  # an ideal sign alone is already too much
            return scale(smooth, what.ratio, self.measure)
        return scaled

    def equal(self, effect: Effect) -> dict | None:
        """What else would explain the effect; None with unknown inertials and with Eq. 9's motors."""
        if self.case.inertial == "identify" or self.case.motor:
            return None
        setup = Setup(self.setup.payload[: self.seen], self.setup.springs[: self.seen], self.setup.gravity)
        with_it, without = (self.thin(self.signals(e)) for e in ([effect], []))
        fit = calibrate(self.arm, setup, with_it)
        if self.rings:
            fit = replace(fit, residual=fit.residual - calibrate(self.arm, setup, without).residual)
        jacobian = Jacobian(self.arm, setup, with_it, fit)
        return equal_effects(jacobian, self.sensing.torque_noise, effect, 4.0)

    def thin(self, x: Signals) -> Signals:
        """The seen recordings at 25 Hz, smoothed where transmissions ring."""
        return subset(thinned(smoothed(x) if self.rings else x, 25.0), slice(self.seen))

    def measure(self, effect: Effect) -> np.ndarray:
        """Residual RMS after plain calibration over noise, per joint, in the seen recordings that have the effect.

        Infinite where the effect is so strong that the arm is not to be controlled.
        """
        with np.errstate(over="ignore", invalid="ignore"):
            found = self.signals([effect])
        if not all(np.all(np.isfinite(x)) for x in (found.q, found.dq, found.ddq, found.tau)):
            return np.full(self.arm.n, np.inf)
        return self.ratio(self.fit(found), effect.mask[: self.seen] > 0)

    def ratio(self, fit: PlainFit, has: np.ndarray) -> np.ndarray:
        """Of the residual that an effect leaves in the recordings that have it, (n,)."""
        change = fit.residual - self.floor if self.case.motor else fit.residual
        return np.sqrt(np.mean(change[has] ** 2, axis=(0, 2))) / self.sensing.torque_noise


def mounted(case: Case, arm: Arm, batch: int) -> Setup:
    """Listed payloads in half of the recordings, listed springs in half of them (all of them where an effect needs it)."""
    rng = case.rng("setup")
    names = {c.effect for c in case.concealed}
    mass = rng.uniform(2.0, 5.0) if arm.bundled else rng.uniform(0.4, 1.2)  # [kg]
    held = np.arange(batch) % 2 == rng.integers(2)
    if names & {"payload_com", "sloshing_payload"}:
        held[:] = True
    sprung = any(n.startswith("spring_") for n in names)
    springs: list[dict] = [{} for _ in range(batch)]
    if sprung or rng.random() < 0.3:
        listed = draw_springs(arm, rng)
        for b in range(batch):
            if sprung or (b // 2) % 2 == 0:
                springs[b] = listed
    return Setup(np.where(held, mass, 0.0), springs)


def draw_springs(arm: Arm, rng: np.random.Generator) -> dict:
    """Springs about as strong as gravity, on the joints that gravity loads."""
    holding = holding_torque(arm.model, arm.lower, arm.upper)
    loaded = np.flatnonzero(holding > 0.3 * holding.max())
    pea = {}
    for j in loaded[:2]:
        middle = rng.uniform(0.55, 0.9) * (arm.upper[j] - arm.lower[j]) + arm.lower[j]
        stiffness = rng.uniform(0.3, 0.9) * holding[j]
        pea[arm.joints[j]] = {
            "stiffness_Nm_per_rad": round(float(stiffness), 4),
            "equilibrium_rad": round(float(middle), 4),
            "active": "below",
        }
    listed: dict = {"pea": pea}
    j = int(loaded[0])
    if j + 1 < arm.n and rng.random() < 0.4:
        centre = 0.5 * (arm.lower + arm.upper)
        r1, r2, r3 = 0.015, 0.036, round(float(rng.uniform(0.014, 0.03)), 4)
        kappa = rng.uniform(0.1, 0.3) * holding[j]
        slack = (-r2 * centre[j] - r3 * centre[j + 1]) / r1 - rng.uniform(0.0, 1.0)
        listed["bpea"] = {
            "stiffness_Nm_per_rad": round(float(kappa * (r1 / r2) ** 2), 5),
            "equilibrium_rad": round(float(slack), 4),
            "radius1_m": r1,
            "radius2_m": r2,
            "radius3_m": r3,
            "joints": [arm.joints[j], arm.joints[j + 1]],
        }
    return listed
