"""Which physics a calibrated model lacks: candidates compete after all parameters are estimated anew with each of them.

Forward: the trial with the most evidence joins the model, is fitted with everything else on the exact equations, and what it made
superfluous leaves again, until nothing is left beyond chance. Then each effect must hold against every other in its place; those
that do as well are its rivals.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from rrr_oc.calibrate import bounds, parameter_values, with_parameter_values, with_widths
from rrr_oc.calibrated import CalibratedModel, Estimate, Term
from rrr_oc.effects import Effect
from rrr_oc.effects.empirical import Empirical
from rrr_oc.evidence import Bench, Candidate, Evidence, chance, independent, pseudo_inverse, robust_p, significant
from rrr_oc.inference import box_step, normal_equations
from rrr_oc.regression import Rows, noise, rows
from rrr_oc.signatures import trials, view

MOST = 8  # effects
TRIED = 5  # candidates that are fitted exactly in each round
CLOSE = 0.4  # of the best score, for a candidate to be tried
DOUBT = 0.05  # p-value of the robust test, all effects together
CONFIRMED = 0.3  # of the fall of the squared residual in the fit, that recordings left out of it must show
STEADY = 3.0  # standard errors by which a fit must be better
LEAST_SHARE = 0.007  # of the squared residual of a joint before any effect is added, for an effect to be named
FLOOR = 1.1  # of the deviation that the noise accounts for
MARGIN = 1.1  # by which an empirical term must do better than a law of the catalogue
RARE = 0.25  # of the evidence for what is mounted in all recordings and listed in none
SAME = 9.0  # twice the log-likelihood within which two models do equally well
CALL = 10.0  # times that, within which it takes an exact fit to say so
DOUBTFUL = 3.0  # times what an effect must be worth, as foreseen, below which it is tried without it
MANY = 3  # parameters, beyond which two effects may be the simpler explanation
NEAR = 0.6  # of the likelihood of what is in place, for others to be fitted there
PAIRS = 6  # of them that are tried
ROUNDING = 1e-10  # Nm
STEPS, TOLERANCE = 12, 1e-5  # of Gauss–Newton; of the squared residual


@dataclass(frozen=True)
class Fitted:
    """A model fitted to a bench.

    Attributes:
        model: With the parameters found.
        rows: There.
    """

    model: CalibratedModel
    rows: Rows

    @property
    def squares(self) -> np.ndarray:
        """Sum of squared residuals of each joint (n,)."""
        return np.maximum(np.sum(self.rows.residual**2, axis=1), 1e-300)

    @property
    def misfit(self) -> float:
        """Sum of the logarithms of the joints' squared residuals; less is better."""
        return float(np.sum(np.log(self.squares)))

    @property
    def counts(self) -> np.ndarray:
        """Independent rows of each joint (n,)."""
        return independent(self.rows)

    def better_than(self, other: "Fitted") -> float:
        """Growth of twice the log-likelihood over another fit of the same rows."""
        return float(self.counts @ np.log(other.squares / self.squares))


@dataclass(frozen=True)
class Finding:
    """An effect that the model lacked.

    Attributes:
        term: In the model.
        likelihood: What twice the log-likelihood falls by without it.
        dimensions: Coefficients.
        tests: Effects at their joints that competed.
        rivals: Names and joints of effects that do as well in its place.
    """

    term: Term
    likelihood: float
    dimensions: int
    tests: int
    rivals: tuple[tuple[str, tuple[int, ...]], ...] = ()

    @property
    def p_value(self) -> float:
        """Of the likelihood, all trials together."""
        return float(min(1.0, self.tests * chi2.sf(self.likelihood, self.dimensions)))


def refit(bench: Bench, model: CalibratedModel, steps: int = STEPS, without_last: Rows | None = None) -> Fitted:
    """All parameters of a model, fitted to a bench within their bounds; inertial ones freely where they are unknown.

    Args:
        without_last: Rows of the model without its last term; their derivatives then serve all along, which is nearly as good.
    """
    found = rows(bench.prepared, model, bench.identify, without_last)
    straight = not bench.identify and all(_straight(term.effect) for term in model.terms)
    for _ in range(steps):
        found = _without_rounding(found, model)
        weights = found.deviation() ** -2
        matrix, right = normal_equations(found, weights)
        values = parameter_values(model)
        low, high = bounds(model.terms)
        size = len(values)
        free = np.full(matrix.shape[0] - size, np.inf)
        step = box_step(matrix, right, np.concatenate([low - values, -free]), np.concatenate([high - values, free]))
        cost = float(weights @ np.sum(found.residual**2, axis=1))
        if step @ (2 * right - matrix @ step) < TOLERANCE * cost:
            break  # what is to be gained is nothing beside what is left
        for share in (1.0, 0.4, 0.1):
            there = _moved(model, values + share * step[:size], share * step[size:])
            known = replace(found, residual=found.residual - share * (found.jacobian @ step)) if straight else None
            tried = known or rows(bench.prepared, there, bench.identify, without_last)
            after = float(weights @ np.sum(tried.residual**2, axis=1))
            if after < cost:
                break
        else:
            break
        model, found = there, tried
        if after > cost * (1 - TOLERANCE):
            break
    return Fitted(model, found)


def _straight(effect: Effect) -> bool:
    """Whether the prediction stays linear in all parameters with this effect; gain and load multiply what others do."""
    return effect.plain or (effect.linear and effect.side != "sensor" and not effect.load_dependent)


def _without_rounding(found: Rows, model: CalibratedModel) -> Rows:
    """The rows without derivatives that are nothing but rounding, as those by a mass that no motion shows."""
    values = np.ones(found.jacobian.shape[2])
    own = parameter_values(model)
    values[: len(own)] = np.maximum(np.abs(own), 1.0)
    nothing = np.max(np.abs(found.jacobian), axis=(0, 1)) * values < ROUNDING
    return replace(found, jacobian=np.where(nothing, 0.0, found.jacobian)) if nothing.any() else found


def search(
    bench: Bench,
    model: CalibratedModel,
    report: Callable[[str], None] = lambda _: None,
    contest: bool = True,
    unnamed_too: bool = True,
) -> tuple[Fitted, list[Finding]]:
    """The model with the effects that the recordings hold beyond chance, and what speaks for each, most important first.

    Args:
        report: Is told what happens, a line at a time.
        contest: Whether each effect must hold against others in its place in the end.
        unnamed_too: Whether torques that no law of the catalogue describes are looked for.
    """
    base = len(model.terms)
    fitted = refit(bench, model)
    plain = fitted
    first = evidence = gathered(bench, fitted.model)
    while len(fitted.model.terms) - base < MOST:
        chosen = _next(bench, evidence, plain, fitted, unnamed_too, report)
        if chosen is None:
            break
        fitted = _rewidened(bench, _pruned(bench, plain, chosen, base, evidence.tests, report))
        evidence = gathered(bench, fitted.model)
    return _contested(bench, plain, fitted, base, first, report) if contest else (fitted, [])


def _rewidened(bench: Bench, fitted: Fitted) -> Fitted:
    """The fit with dry friction as abrupt as the new model shows it; what was missing had distorted it."""
    model = with_widths(bench.prepared, fitted.model, free=True)
    changed = any(a.width != b.width for a, b in zip(model.terms, fitted.model.terms, strict=True))
    return refit(bench, model) if changed else fitted


def unnamed(bench: Bench, model: CalibratedModel, j: int) -> Evidence:
    """The evidence for torques on a joint that no law of the catalogue describes."""
    seen = view(bench.prepared, model)
    torques = [
        np.concatenate(parts, axis=1) for parts in zip(*(model.torques(p.recording) for p in bench.prepared), strict=True)
    ]
    motor, load = ((x.min(axis=1), np.maximum(x.max(axis=1), x.min(axis=1) + 1e-6)) for x in torques)
    acceleration = np.quantile(np.concatenate([np.abs(p.recording.ddq) for p in bench.prepared], axis=1), 0.99, axis=1)
    return Evidence.gather(bench, model, list(Empirical.surfaces(seen, j, load, motor, np.maximum(acceleration, 1e-3))))


def gathered(bench: Bench, model: CalibratedModel) -> Evidence:
    """The evidence for every trial at a model."""
    seen = view(bench.prepared, model)
    return Evidence.gather(bench, model, trials(seen, model.torque))


def _next(bench: Bench, evidence: Evidence, plain: Fitted, fitted: Fitted, unnamed_too: bool, report) -> Fitted | None:
    """The model with the best further effect, or empirical term where no effect comes near it; None where all is chance."""
    named = _best(bench, evidence, contenders(evidence, fitted.model), plain, fitted)
    joints = () if not unnamed_too else _noisy(bench, fitted) if named is None else [_joint(evidence, named[2])]
    others = []
    for j in joints:
        surfaces = unnamed(bench, fitted.model, j)
        others.append(_best(bench, surfaces, contenders(surfaces, fitted.model), plain, fitted))
    other = max((o for o in others if o is not None), key=lambda o: o[0], default=None)
    if named is None and other is None:
        return None
    chosen = other if named is None or (other is not None and other[0] > MARGIN * named[0] + SAME) else named
    assert chosen is not None
    report(f"{described(chosen[2], fitted.model)}: evidence {chosen[0]:.0f}")
    if chosen[2].trial.effect.simulated:
        return _best_start(bench, chosen[1].model, (0.8, 1.0, 1.2))
    return refit(bench, chosen[1].model)


def fit_of(bench: Bench, evidence: Evidence, fitted: Fitted, candidate: Candidate) -> Fitted:
    """The model with a candidate, fitted; where all is linear, as the evidence has it already."""
    model, effect = extended(fitted.model, candidate), candidate.trial.effect
    if effect.simulated:
        return _best_start(bench, model, (1.0,), fitted.rows)
    if not effect.linear:
        return refit(bench, model, without_last=fitted.rows)
    return Fitted(model, replace(fitted.rows, residual=evidence.left_by(candidate)))


def _best(
    bench: Bench, evidence: Evidence, candidates: Sequence[Candidate], plain: Fitted, fitted: Fitted
) -> tuple[float, Fitted, Candidate] | None:
    """Score, fit and candidate of the best that is beyond chance and explains a share of the error worth a name."""
    best = None
    for candidate in candidates:
        tried = fit_of(bench, evidence, fitted, candidate)
        gain = tried.better_than(fitted)
        score = gain - candidate.penalty
        share = np.max((fitted.squares - tried.squares) / plain.squares)
        steady = (
            candidate.trial.effect.linear
            or steadily_better(bench, tried, fitted)
            or _settled(bench, evidence, tried, candidate)
        )
        last = tried.model.terms[-1]
        possible = last.effect.possible(last.named, bench.least_payload(candidate.scope))
        if gain > candidate.least and share > LEAST_SHARE and steady and possible:
            score -= _rarity(bench, tried, candidate.trial.effect, candidate.scope is None) * gain
            best = (score, tried, candidate) if best is None or score > best[0] else best
    return best


def _settled(bench: Bench, evidence: Evidence, fitted: Fitted, candidate: Candidate) -> bool:
    """Whether a candidate that acts in a few places only leaves nothing but noise, and is beyond chance there."""
    effect = candidate.trial.effect
    return not effect.simulated and not _noisy(bench, fitted) and robust_p(evidence, candidate) * evidence.tests < DOUBT


def _rarity(bench: Bench, fitted: Fitted, effect: Effect, everywhere: bool) -> float:
    """Share of its evidence that an effect loses for being unlikely.

    That somebody mounted something for all recordings and listed it for none. While a model is far from the noise, all laws are
    wrong, and likelihoods alone compare what else they happen to take up.
    """
    return RARE if effect.mounted and everywhere and _noisy(bench, fitted) else 0.0


def _noisy(bench: Bench, fitted: Fitted) -> list[int]:
    """The joints with more residual than the noise of single samples accounts for."""
    passed = np.sqrt(
        np.mean(np.concatenate([np.asarray(p.matrix.multiply(p.matrix).sum(axis=1)).ravel() for p in bench.prepared]))
    )
    floor = noise(bench.prepared, fitted.model) * passed
    return np.flatnonzero(fitted.rows.deviation() > FLOOR * floor).tolist()


def _joint(evidence: Evidence, candidate: Candidate) -> int:
    """The joint on which a candidate explains most."""
    change = evidence.signature(candidate.number, candidate.scope) @ candidate.coefficients
    return int(np.argmax(evidence.weights * np.sum(change**2, axis=1)))


def contenders(evidence: Evidence, model: CalibratedModel) -> list[Candidate]:
    """The candidates worth an exact fit: beyond chance, robustly so, near the best; of each effect at its joints the best."""
    others = len(evidence.bench.prepared) > 1
    result: list[Candidate] = []
    for candidate in evidence.candidates():
        if result and (len(result) >= TRIED or candidate.score < min(CLOSE * result[0].score, result[0].score - SAME)):
            break
        if candidate.likelihood < candidate.least:
            continue
        same = any(_key(c) == _key(candidate) for c in result)
        if same or _present(candidate, model):
            continue
        beyond_chance = not candidate.trial.effect.linear or robust_p(evidence, candidate) * evidence.tests < DOUBT
        if beyond_chance and (not others or evidence.confirmed(candidate) > CONFIRMED):
            result.append(candidate)
    return result


def _best_start(bench: Bench, model: CalibratedModel, shares: Sequence[float], without_last: Rows | None = None) -> Fitted:
    """The best fit from several starts of the last term, of which the prediction is no smooth function: all forms, these shares."""
    last, fits = model.terms[-1], []
    for effect in last.effect.forms():
        for share in shares:
            start = replace(last, effect=effect).with_values(share * last.values)
            fits.append(refit(bench, replace(model, terms=(*model.terms[:-1], start)), 3, without_last))
    return min(fits, key=lambda f: f.misfit)


def steadily_better(bench: Bench, one: Fitted, other: Fitted) -> bool:
    """Whether the fit is better all along, not by luck in a few places: differences of squares by block of time."""
    weights = one.rows.deviation() ** -2
    fall = weights @ (other.rows.residual**2 - one.rows.residual**2)
    blocks = bench.by_block(fall)
    return bool(blocks.sum() > STEADY * np.sqrt(np.sum((blocks - blocks.mean()) ** 2) + 1e-300))


def _key(candidate: Candidate):
    effect = candidate.trial.effect
    return effect.name, effect.joints


def _present(candidate: Candidate, model: CalibratedModel) -> bool:
    """Whether the model has the effect there already."""
    effect, scope = candidate.trial.effect, candidate.scope
    return not effect.many and any(
        t.effect.name == effect.name
        and t.effect.joints == effect.joints
        and (not t.groups or scope is None or set(scope) & set(t.groups))
        for t in model.terms
    )


def extended(model: CalibratedModel, candidate: Candidate) -> CalibratedModel:
    """The model with a candidate's effect."""
    return replace(model, terms=(*model.terms, term(candidate)))


def term(candidate: Candidate) -> Term:
    """A candidate as a term."""
    trial = candidate.trial
    theta = trial.effect.combined(trial.points, candidate.coefficients)
    estimates = tuple(Estimate(float(theta[p.name])) for p in trial.effect.parameters)
    if candidate.scope is None:
        return Term(trial.effect, estimates, trial.width)
    return Term(trial.effect, estimates, trial.width, recordings=(), groups=candidate.scope)


def described(candidate: Candidate, model: CalibratedModel) -> str:
    """Name, joints and groups, for people."""
    joints = ", ".join(model.joints[j] for j in candidate.trial.effect.joints)
    return (
        candidate.trial.effect.name
        + (f" of {joints}" if joints else "")
        + ("" if candidate.scope is None else f" in {candidate.scope}")
    )


def without(model: CalibratedModel, i: int) -> CalibratedModel:
    """The model less one term."""
    return replace(model, terms=(*model.terms[:i], *model.terms[i + 1 :]))


def _pruned(bench: Bench, plain: Fitted, fitted: Fitted, base: int, tests: int, report) -> Fitted:
    """The model without those earlier effects that the newest made superfluous."""

    def superfluous(less: Fitted, i: int, by: float = 1.0) -> bool:
        share = np.max((less.squares - fitted.squares) / plain.squares)
        return bool(share < by * LEAST_SHARE) or fitted.better_than(less) < by * _least(fitted, i, tests)

    i = base
    while i < len(fitted.model.terms) - 1:
        foreseen = _foreseen(fitted, i)
        doubtful = foreseen is None or superfluous(foreseen, i, DOUBTFUL)
        less = refit(bench, without(fitted.model, i)) if doubtful else fitted
        if doubtful and superfluous(less, i):
            report(f"{fitted.model.terms[i].effect.name} is superfluous")
            fitted = less
        else:
            i += 1
    return fitted


def _foreseen(fitted: Fitted, i: int) -> Fitted | None:
    """What the fit without one term would leave if all were linear: its amplitudes at 0, all else where that is best.

    None where the effect does not vanish there.
    """
    model, found = fitted.model, fitted.rows
    start = sum(len(t.estimates) for t in model.terms[:i])
    term = model.terms[i]
    amplitudes = [(start + k, p.nominal) for k, p in enumerate(term.effect.parameters) if p.name in term.effect.amplitudes]
    if any(nominal for _, nominal in amplitudes):
        return None
    own = [k for k, _ in amplitudes]
    inverse = pseudo_inverse(normal_equations(found, found.deviation() ** -2)[0])
    step = -inverse[:, own] @ np.linalg.pinv(inverse[np.ix_(own, own)]) @ parameter_values(model)[own]
    return Fitted(model, replace(found, residual=found.residual - found.jacobian @ step))


def _least(fitted: Fitted, i: int, tests: int) -> float:
    """Likelihood that a term must add to stay."""
    number = len(fitted.model.terms[i].estimates)
    return min(chance(number, fitted.counts, tests), significant(number, tests))


def _contested(bench: Bench, plain: Fitted, fitted: Fitted, base: int, first: Evidence, report) -> tuple[Fitted, list[Finding]]:
    """Each effect against all others in its place: the better ones take it, the equal ones are named; so do two simpler ones."""
    findings, i = [], base
    while i < len(fitted.model.terms):
        alone = len(fitted.model.terms) == base + 1
        less = plain if alone else refit(bench, without(fitted.model, i))
        evidence = (first if alone else gathered(bench, less.model)).under(fitted.rows)
        own = fitted.model.terms[i]
        rivals, best = [], None
        for candidate in _rivals(evidence, less.model, own):
            tried = fit_of(bench, evidence, less, candidate)
            if tried.better_than(fitted) > -CALL * SAME:
                tried = refit(bench, tried.model)
            better = tried.better_than(fitted)
            simpler = len(own.estimates) - len(candidate.trial.effect.parameters)
            likelier = int(candidate.scope is not None) * (candidate.trial.effect.mounted - own.effect.mounted)
            lead = better + (simpler + 2 * likelier) * SAME
            if simpler <= 0:  # the simplest of equals needs no excuse
                lead -= _rarity(bench, tried, candidate.trial.effect, candidate.scope is None) * tried.better_than(less)
            lead += _rarity(bench, fitted, own.effect, own.recordings == "all") * fitted.better_than(less)
            if lead > (0 if simpler > 0 else SAME) and better > -SAME and (best is None or lead > best[0]):
                best = (lead, tried, candidate)
            if better > -SAME:
                rivals.append((candidate.trial.effect.name, candidate.trial.effect.joints))
        two = None if best is not None else _in_two(bench, less, fitted, own, evidence)
        if two is not None:
            names = " and ".join(t.effect.name for t in two.model.terms[-2:])
            report(f"{names} take the place of {own.effect.name}")
            fitted = _in_place(bench, i, two.model, 2)
            continue  # with the two in its place
        if best is not None:
            ousted = (own.effect.name, own.effect.joints)
            taker = (best[2].trial.effect.name, best[2].trial.effect.joints)
            rivals = [r for r in rivals if r != taker] + ([ousted] if fitted.better_than(best[1]) > -SAME else [])
            report(f"{best[1].model.terms[-1].effect.name} takes the place of {own.effect.name}")
            fitted = _in_place(bench, i, best[1].model, 1)
        dimensions = len(fitted.model.terms[i].effect.amplitudes)
        findings.append(
            Finding(
                fitted.model.terms[i],
                fitted.better_than(less),
                dimensions,
                evidence.tests,
                tuple(dict.fromkeys(rivals)),
            )
        )
        i += 1
    order = sorted(range(len(findings)), key=lambda k: -findings[k].likelihood)
    return fitted, [replace(findings[k], term=fitted.model.terms[base + k]) for k in order]


def _in_two(bench: Bench, less: Fitted, fitted: Fitted, own: Term, evidence: Evidence) -> Fitted | None:
    """The model with two effects in the place of one with more parameters that explains no more; None without such.

    Two laws of the catalogue must explain more than a term that is none, if need be with more parameters.
    """
    number, unnamed_ = len(own.estimates), isinstance(own.effect, Empirical)
    if number <= MANY and not unnamed_:
        return None
    tried = []
    for pair in evidence.pairs(max(number, 2 * MANY + 1) if unnamed_ else number, PAIRS):
        foreseen = Fitted(less.model, replace(less.rows, residual=evidence.left_by(*pair)))
        if foreseen.better_than(less) > NEAR * fitted.better_than(less):
            tried.append(refit(bench, extended(extended(less.model, pair[0]), pair[1])))
    found = min(tried, key=lambda f: f.misfit, default=None)
    if found is None:
        return None
    more = max(sum(len(t.estimates) for t in found.model.terms[-2:]) - number, 0)
    return found if found.better_than(fitted) > SAME * (1 + more if unnamed_ else -1) else None


def _in_place(bench: Bench, i: int, model: CalibratedModel, count: int) -> Fitted:
    """The model with its last terms moved to number i, fitted."""
    terms = list(model.terms)
    terms[i:i] = terms[-count:]
    return refit(bench, replace(model, terms=tuple(terms[: len(model.terms)])))


def _rivals(evidence: Evidence, model: CalibratedModel, own: Term) -> list[Candidate]:
    """The best candidates in an effect's place other than itself, one for each effect at its joints."""
    result: list[Candidate] = []
    every = evidence.candidates()
    most = max((c.likelihood for c in every), default=0.0)
    for candidate in every:
        effect = candidate.trial.effect
        itself = (effect.name, effect.joints) == (own.effect.name, own.effect.joints)
        if itself or any(_key(c) == _key(candidate) for c in result) or _present(candidate, model):
            continue
        if candidate.likelihood < NEAR * most or len(result) >= TRIED:
            break
        result.append(candidate)
    return result


def _moved(model: CalibratedModel, values: np.ndarray, inertial: np.ndarray) -> CalibratedModel:
    terms = with_parameter_values(model.terms, values)
    if not len(inertial):
        return replace(model, terms=terms)
    robot = replace(model.robot, inertial=model.robot.inertial + inertial.reshape(model.robot.n, 10).T)
    return replace(model, terms=terms, robot=robot)
