"""Models fitted under their evidence: Gauss–Newton on the exact equations, with priors, noise and discrepancy estimated on the way.

The one estimator: of a calibration, whose model has plain terms alone, and of a diagnosis, whose models have effects beyond these.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Self

import numpy as np

from rrr_oc.calibration.calibrated_model import CalibratedModel, Term
from rrr_oc.calibration.estimator.data import Data, Noise, low_frequency, share_of_low_frequency
from rrr_oc.calibration.estimator.evidence import (
    LEAST,
    Hyperparameters,
    NoiseStart,
    ParameterPrior,
    Posterior,
    root_of_covariance,
    solve,
)
from rrr_oc.calibration.estimator.knobs import CLOCK_ERROR, INNER_CYCLE
from rrr_oc.calibration.estimator.left_out import std_by_blocks
from rrr_oc.calibration.parameter_vector import WIDTHS, bounds, widened, with_parameter_values
from rrr_oc.calibration.regression import rows
from rrr_oc.calibration.samples import shortened
from rrr_oc.effects import Delay, Effect
from rrr_oc.robot.link_errors import OF_URDF

FAR = 3.0  # declared standard deviations from which an error of a link is more than what files usually have
STEPS = 60  # most steps of Gauss–Newton; links of which little is known lie in curved valleys
STEPS_ON = 3  # most steps of a fit that goes on from one to a part of the recordings; doubled, it takes twice the time
GAIN = 0.05  # fall of the cost, in nats, below which no further step follows
FEW = 3  # steps after which evidence is not expected to rise by more than it has risen
IDLE = 0.5  # nats: after two steps that raise evidence and likelihood by less, with hardly less to gain, no further one follows
PATIENCE = 3  # steps without more evidence after which hyperparameters stay as they are
NONLINEAR = 0.01  # of the squared change over a step, by which residuals may miss the prediction without new derivatives
DAMPINGS = (0.0, 0.001, 0.03, 0.3, 3.0, 30.0, 300.0)  # of a step, tried until the cost falls
LINK_STEP = 100.0  # standard deviations by which one step may change an error of a link; bodies are exponential in them
HELD = 1e-9  # standard deviation of a delay that is held [s]
APART = CLOCK_ERROR / 3  # [s] by which delays of joints differ, whose torques one clock takes
WIDE = 30.0  # prior standard deviation of plain friction and armature, as a multiple of the joint's torque
CLOSER, ALIKE = (
    4,
    1.0,
)  # most fits of least squares, whose weights depend on what the one before leaves; nats of a gain that ends them
OTHER_SIGN = 3.0  # nats from which another way in which friction changes sign is fitted


@dataclass(frozen=True)
class Fitted:
    """A model fitted to data.

    Attributes:
        model: At the estimates.
        links: Errors of the links in standard deviations of their prior, (k,).
        posterior: Of the parameters, from which the model was reached.
        residual: Of the model, (n, M) [Nm].
        base: Number of plain terms.
        bent: Root of the covariance by which a discrepancy bends parameters that were fitted as if there were none, (p, r); None
            where it was part of the fit.
        by_blocks: Standard errors of the parameters (p,) from differences between blocks, and the number of blocks; None where they follow
            from the posterior.
    """

    model: CalibratedModel
    links: np.ndarray
    posterior: Posterior
    residual: np.ndarray
    base: int
    bent: np.ndarray | None = None
    by_blocks: tuple[np.ndarray, int] | None = None

    @property
    def log_evidence(self) -> float:
        return self.posterior.log_evidence

    @property
    def extra(self) -> tuple[Term, ...]:
        """The effects that were added to the plain model."""
        return self.model.terms[self.base :]


@dataclass(frozen=True)
class PlainFitter:
    """Fits of models to data.

    Attributes:
        data: The data.
        plain_std: Prior standard deviations of the parameters of the plain terms, those of `Data.start`.
        farthest: Declared standard deviations by which a link of a URDF may be off at most.
        holds_delays: Whether delays of the torque stay as they are.
        wide: Of each effect beyond the plain terms, how many times wider its prior is than declared; what is likeliest by default.
    """

    data: Data
    plain_std: np.ndarray
    farthest: float = field(default=np.inf, kw_only=True)
    holds_delays: bool = field(default=False, kw_only=True)
    wide: tuple[float, ...] | None = field(default=None, kw_only=True)

    @classmethod
    def of(cls, data: Data) -> "PlainFitter":
        """Of models with the terms of `data.start`."""
        return cls(data, plain_std(data))

    def begin(self, nominal: CalibratedModel) -> Fitted:
        """The fit of `data.start`, from the values of its terms and the links of a nominal model on."""
        few = self.few()
        fitted = few.with_signs(few.fit(replace(self.data.start, robot=nominal.robot), self.data.links.none))
        if few is not self:
            start = NoiseStart.of(self.data, fitted.posterior.hyper)
            fitted = self.fit(fitted.model, fitted.links, start, steps=STEPS_ON)
        return fitted

    def delay_of(self, fitted: Fitted) -> float:
        """By how much the torques are late in the model that predicts best, the median over joints, each counting by how well it tells; 0
        where no delay is in it [s].

        What is likeliest is decided by what is fast. There the way in which friction sticks where a joint turns looks like a delay, for
        which laws that are not there would make up elsewhere; and a law that is missing looks like a delay of its joint. One clock takes
        the torques of all joints.
        """
        free = replace(self, holds_delays=False).least_squares(fitted)
        at = delays_of(free)
        return weighted_median(free.model.values[at], 1 / (variances_of_delays(free) + APART**2)) if len(at) else 0.0

    def holding(self, delay: float, fitted: Fitted) -> tuple[Self, Fitted]:
        """What holds a delay of all torques, and a fit with it."""
        held = [t.with_values(np.array([delay])) if is_held(t.effect) else t for t in fitted.model.terms]
        holding = replace(self, holds_delays=True)
        return holding, holding.fit(replace(fitted.model, terms=tuple(held)), fitted.links, fitted.posterior)

    def few(self) -> Self:
        """What fits models to a part of the recordings, evenly over them; itself where they are short."""
        some = shortened(self.data.prepared)
        return self if some == self.data.prepared else replace(self, data=self.data.of(some))

    def fit(
        self,
        model: CalibratedModel,
        links: np.ndarray,
        start: Posterior | NoiseStart | None = None,
        fixed: bool = False,
        steps: int = STEPS,
        wanted: float = -np.inf,
    ) -> Fitted:
        """All parameters of a model fitted, with hyperparameters that begin with those of `start`, or stay `fixed` there.

        At most so many steps of Gauss–Newton are made, and fewer if the evidence would have to rise more than it may to be as `wanted`.
        """
        data, (residual, columns) = self.data, self.linearised(model, links)
        best, highest, last, fall, idle, exact, first = None, -np.inf, np.inf, np.inf, 0, True, 0
        about, began, stalled, nearest = residual, -np.inf, 0, np.full(data.n, np.inf)
        for number in range(steps):
            post = solve(data, residual, columns, self.prior(model, links), start, fixed)
            start, stalled = post, 0 if post.log_evidence > highest + IDLE else stalled + 1
            nearest = np.minimum(nearest, post.hyper.links) if stalled else post.hyper.links
            # errors of links that grow and shrink in turn stay as near to the declared ones as they came
            if stalled == PATIENCE and not fixed:
                start, fixed = replace(post, hyper=replace(post.hyper, links=nearest)), True
            before = post.misfit + post.prior_cost(0 * post.step)
            expected = before - post.predicted(post.step)
            best = Fitted(model, links, post, residual, len(data.start.terms))
            idle = idle + 1 if max(post.log_evidence - highest, fall / 2) < IDLE and expected > last / 2 else 0
            began, highest, last = began if number else post.log_evidence, max(highest, post.log_evidence), expected
            hopeless = 2 * highest - began + (0.0 if number + 1 >= FEW else expected) < wanted
            if expected < GAIN or idle == 2 or hopeless or number + 1 == steps:
                break
            for rung in range(first, len(DAMPINGS)):
                step = post.damped(DAMPINGS[rung])
                farthest = np.abs(step[len(model.values) :][: len(links)]).max(initial=0.0)
                step = step * min(1.0, LINK_STEP / max(farthest, 1e-300))
                there, errors = self.moved(model, links, step)
                after = data.residual(there)
                cost = post.cost(after) + post.prior_cost(step)
                if cost < before:
                    break
            else:
                if exact:
                    break
                (about, columns), exact, fall = self.linearised(model, links), True, 0.0
                continue
            first = max(rung - 1, 0)
            missed = np.sum((after - (residual - columns @ step)) ** 2)
            linear = missed <= NONLINEAR**2 * np.sum((after - residual) ** 2)
            model, links, residual, fall = there, errors, after, before - cost
            # a width has no derivative where there is no friction, and may have one after the step
            without = not np.all(np.any(columns, axis=(0, 1)))
            if linear and rung == 0 and not without:
                best = Fitted(model, links, post, residual, len(data.start.terms))
                break
            exact = without or bool(missed > NONLINEAR * np.sum((about - after) ** 2))
            if exact:
                about, columns = self.linearised(model, links)
        assert best is not None
        return best

    def with_signs(self, fitted: Fitted) -> Fitted:
        """The fit whose dry friction changes sign in the most probable of its ways, one of `Effect.sign_forms` at each joint."""
        tried: set[tuple[int, Effect]] = set()
        while True:
            terms, better = fitted.model.terms, False
            for i, gain, form, width in self._other_signs(fitted):
                if gain <= OTHER_SIGN or (i, form) in tried:
                    continue
                tried.add((i, form))
                # as the model has it: behind a gear or a delay, friction does not change sign where the recorded speed does
                alone = with_form(fitted.model.terms, i, form, width)
                change = fitted.residual - self.data.residual(replace(fitted.model, terms=alone))
                if self._gains(fitted, dict(enumerate(change[:, :, None])))[0] > OTHER_SIGN:
                    terms, better = with_form(terms, i, form, width), True
            if not better:
                return fitted
            there = replace(fitted.model, terms=terms)
            new = self.fit(there, fitted.links, fitted.posterior, wanted=fitted.log_evidence)
            if new.log_evidence > fitted.log_evidence:
                fitted = new

    def _other_signs(self, fitted: Fitted) -> Iterator[tuple[int, float, Effect, float]]:
        """For each term of dry friction its number, the largest gain of a form and width, all else linear, and these two."""
        data = self.data
        for i, term in enumerate(fitted.model.terms[: fitted.base]):
            others = [(f, w) for f in term.effect.sign_forms for w in WIDTHS]
            if others and term.width:
                (j,), own = term.effect.joints, data.friction(term.effect, term.width)
                changes = term.values[0] * np.array([data.friction(*other) - own for other in others]).T
                gains = self._gains(fitted, {j: changes})
                best = int(np.argmax(gains))
                yield i, float(gains[best]), *others[best]

    def _gains(self, fitted: Fitted, changes: Mapping[int, np.ndarray]) -> np.ndarray:
        """By how much changes of the prediction raise the log likelihood, all else linear, (c,).

        Args:
            changes: Of joints that change, (M, c) each [Nm].
        """
        post, gains, slope = fitted.posterior, 0.0, 0.0
        for j, change in changes.items():
            one, sigma = post.joints[j], post.hyper.sigma[j]
            d, y, x = one.white @ change, one.white @ fitted.residual[j], one.white @ post.columns[j]
            left = one.beyond_discrepancy(d, (sigma / post.hyper.discrepancy[j]) ** 2) / sigma**2
            slope = slope + x.T @ left
            gains = gains + y @ left - 0.5 * np.sum(d * left, axis=0)
        return np.asarray(gains + 0.5 * np.sum((root_of_covariance(post.matrix).T @ slope) ** 2, axis=0))

    def closest(self, fitted: Fitted) -> Fitted:
        """The model that predicts the recordings best, in least squares about a fit, with the posterior that goes with it.

        Where a law is missing, noise and discrepancy take up what other parameters would explain in part, and the likeliest parameters
        are not those that predict best. Those of least squares estimate the model of the least distance from what is true (L2
        calibration, Tuo & Wu 2015). Noise counts as white, with the spectrum in slow motion of what is left, as friction and inertia
        are seen in slow motion. Of effects that are faster, the prior and the covariance are of the noise along them. The discrepancy,
        of the likeliest size, bends them beside the noise.
        """
        near = self.least_squares(fitted)
        shares = noise_along_effects(self.data, near)
        cleared = self.data.in_noise(at_low_frequency(self.data, near).sigma)
        found = replace(self, data=cleared, holds_delays=True).least_squares(near, fitted, shares)
        of_noise, of_loops = bent(found.posterior, fitted.posterior.hyper.discrepancy), by_inner_loop(found)
        of_noise = np.hstack([of_noise, of_loops]) if of_loops.size else of_noise
        residual, columns = self.linearised(found.model, found.links)  # which others compare with those of fits
        times = np.ones(len(found.posterior.step))  # by which standard errors are less than in noise of slow motion
        first, last = (found.model.offsets[i] for i in (found.base, -1))
        times[first:last] = np.repeat(shares, [len(t.values) for t in found.extra]) ** -0.5
        matrix = times[:, None] * found.posterior.matrix * times
        whole = replace(found.posterior, data=self.data, residual=residual, columns=columns, matrix=matrix)
        std, number = std_by_blocks(found.posterior)
        std[delays_of(near)] = np.sqrt(variances_of_delays(near))  # rows without the time of reversals tell less of delays
        return replace(found, posterior=whole, residual=residual, bent=of_noise, by_blocks=(std, number))

    def least_squares(self, fitted: Fitted, likeliest: Fitted | None = None, shares: np.ndarray | None = None) -> Fitted:
        """The fit whose noise is white, as strong as that of a fit in slow motion, without a discrepancy.

        Effects keep the width of the prior that they have in the likeliest fit, which is the first one by default; where the noise along
        them is a share of that, (m,), their prior has the same share of its precision.
        """
        widths = np.array(self.widths_of_priors((likeliest or fitted).extra))
        last, kept = np.inf, replace(self, wide=tuple(widths if shares is None else widths / np.sqrt(shares)))
        for _ in range(CLOSER):
            start = NoiseStart.of(self.data, at_low_frequency(self.data, fitted))
            fitted = kept.fit(fitted.model, fitted.links, start, fixed=True)
            if abs(fitted.log_evidence - last) < ALIKE:
                break
            last = fitted.log_evidence
        return fitted

    def linearised(self, model: CalibratedModel, links: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The residual (n, M) of a model, and derivatives of its prediction (n, M, p).

        These are by the terms' parameters, the links' errors and the logarithms of the widths of dry friction.
        """
        found, size = self.data.rows(model, list(self.widths(model))), len(model.values)
        last = size + 10 * self.data.n
        by_links = found.jacobian[:, :, size:last] @ self.data.links.at(links)[1]
        return found.residual, np.concatenate([found.jacobian[:, :, :size], by_links, found.jacobian[:, :, last:]], axis=2)

    def widths(self, model: CalibratedModel) -> dict[tuple[int, ...], float]:
        """Width of the sign of each joint's dry friction [rad/s]."""
        return {t.effect.joints: float(t.width) for t in model.terms if t.effect.sign_forms and t.width}

    def moved(self, model: CalibratedModel, links: np.ndarray, step: np.ndarray) -> tuple[CalibratedModel, np.ndarray]:
        """The model after a change of its parameters, and the links' errors."""
        size, k = len(model.values), len(links)
        terms = with_parameter_values(model.terms, model.values + step[:size])
        errors = links + step[size : size + k]
        there = replace(model, terms=terms, robot=replace(model.robot, inertial=self.data.links.at(errors)[0]))
        new = {
            joints: float(np.clip(w * np.exp(s), WIDTHS[0], WIDTHS[-1]))
            for (joints, w), s in zip(self.widths(model).items(), step[size + k :], strict=True)
        }
        return replace(there, terms=tuple(widened(t, new) for t in there.terms)), errors

    def prior(self, model: CalibratedModel, links: np.ndarray) -> ParameterPrior:
        """The prior of changes of a model's parameters: of plain terms, effects, errors of the links and widths, in this order."""
        base, values, widths = len(self.data.start.terms), model.values, np.array(list(self.widths(model).values()))
        low, high = bounds(model.terms)
        mean, precision, flat, lower, upper = self.of_effects(model.terms[base:])
        plain, size, k, end = len(self.plain_std), len(values), len(links), len(values) + len(links) + len(widths)
        low[plain:], high[plain:] = np.maximum(low[plain:], lower), np.minimum(high[plain:], upper)
        factor = np.array([p.factor for t in model.terms for p in t.effect.parameters], float)
        f = np.flatnonzero(np.isfinite(factor))  # parameters that one step may change by a factor at most
        low[f], high[f] = np.maximum(low[f], values[f] / factor[f]), np.minimum(high[f], values[f] * factor[f])
        farthest, number = np.full(k, self.farthest), np.arange(end)
        delays = np.array([is_held(t.effect) for t in model.terms[:base] for _ in t.estimates], bool)
        std = np.where(delays & self.holds_delays, HELD, self.plain_std)
        return ParameterPrior(
            mean=np.concatenate([np.zeros(plain), mean, -links, 0 * widths]),  # of plain terms so wide that it draws nothing
            precision=np.concatenate([std**-2.0, precision, np.ones(end - size)]),
            proper=(number >= plain) & (number < size + k),
            links=np.where((number >= size) & (number < size + k), 1 + (number - size) // OF_URDF, 0) * self.data.free,
            lower=np.concatenate([np.minimum(low - values, 0), -farthest - links, np.log(WIDTHS[0] / widths)]),
            upper=np.concatenate([np.maximum(high - values, 0), farthest - links, np.log(WIDTHS[-1] / widths)]),
            flat=np.concatenate([np.zeros(plain), flat, np.zeros(end - size)]),
        )

    def widths_of_priors(self, terms: Sequence[Term]) -> tuple[float, ...]:
        """Of effects beyond the plain terms, how many times wider than declared the likeliest prior is."""
        return (1.0,) * len(terms)

    def of_effects(self, terms: Sequence[Term]) -> np.ndarray:
        """Mean, precision and flat precision of changes, and bounds, of the parameters of effects beyond the plain terms, (5, m)."""
        if terms:
            raise ValueError(f"no prior of {', '.join(t.effect.name for t in terms)}; a model of plain terms is required")
        return np.zeros((5, 0))


def is_held(effect: Effect) -> bool:
    """Whether an effect is a delay that is held where others are found."""
    return isinstance(effect, Delay) and effect.held


def delays_of(fitted: Fitted) -> np.ndarray:
    """Numbers of the delays that are held among the parameters of a fit's terms."""
    return np.flatnonzero([is_held(t.effect) for t in fitted.model.terms for _ in t.estimates])


def variances_of_delays(fitted: Fitted) -> np.ndarray:
    """Of its posterior [s²]."""
    return np.sum(root_of_covariance(fitted.posterior.matrix)[delays_of(fitted)] ** 2, axis=1)


def weighted_median(values: np.ndarray, weights: np.ndarray) -> float:
    """The value with half of the weights at smaller ones."""
    order = np.argsort(values)
    shares = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(shares, shares[-1] / 2)])


def with_form(terms: Sequence[Term], i: int, form: Effect, width: float) -> tuple[Term, ...]:
    """Terms of which one has another effect, and all friction on its joint another width of the sign."""
    changed = [replace(t, effect=form) if k == i else t for k, t in enumerate(terms)]
    return tuple(widened(t, {form.joints: width}) for t in changed)


def at_low_frequency(data: Data, fitted: Fitted) -> Hyperparameters:
    """Hyperparameters of white noise that is as strong in slow motion as what a fit leaves of the torques, and of no discrepancy.

    What the parameters have taken up of the noise is added to what is left, as the posterior has it.
    """
    white = Noise((np.zeros(0),), np.ones(1), 1.0)
    sigma = [low_frequency(*noise) for noise in _noises(data, fitted)]
    return Hyperparameters((white,) * data.n, np.array(sigma), np.full(data.n, LEAST), fitted.posterior.hyper.links)


def noise_along_effects(data: Data, fitted: Fitted) -> np.ndarray:
    """Variance of the noise along each effect beyond the plain terms, over that in slow motion, at most 1, (m,).

    Of an effect with several parameters that of the one along which it is largest.
    """
    edges, post = np.array(fitted.model.offsets[fitted.base :]), fitted.posterior
    noise, squares = np.zeros((2, edges[-1] - edges[0]))
    for columns, sigma, own in zip(post.columns, post.hyper.sigma, _noises(data, fitted), strict=True):
        x = columns[:, edges[0] : edges[-1]]
        weights = np.sum(x**2, axis=0) / sigma**2
        if weights.any():
            noise += weights * share_of_low_frequency(x, *own)
            squares += weights
    each = np.where(squares > 0, noise / np.maximum(squares, 1e-300), 1.0)
    return np.array([min(each[a:b].max(), 1.0) for a, b in pairwise(edges - edges[0])])


def _noises(data: Data, fitted: Fitted) -> Iterator[tuple[np.ndarray, ...]]:
    """What `low_frequency` needs of each joint: the residual of a fit, and what its parameters have taken up of the noise."""
    root = root_of_covariance(fitted.posterior.matrix)
    for left, place, turning, columns in zip(fitted.residual, data.place, data.turning, fitted.posterior.columns, strict=True):
        yield left, place, turning, (columns @ root) * (place >= 0)[:, None]


def bent(post: Posterior, size: np.ndarray) -> np.ndarray:
    """Root of the covariance by which discrepancies of these sizes (n,) bend the parameters of a posterior that knows of none, (p, r)."""
    root = root_of_covariance(post.matrix)
    slopes = [
        (one.white @ columns).T @ one.features * (s / sigma**2)
        for one, columns, s, sigma in zip(post.joints, post.columns, size, post.hyper.sigma, strict=True)
    ]
    return root @ (root.T @ np.hstack(slopes))


def by_inner_loop(fitted: Fitted) -> np.ndarray:
    """Root of the covariance of the parameters since a loop acts on positions that are up to a cycle old, (p, loops).

    A position that is late by a time asks for kp times that less viscous friction, which nothing tells apart.
    """
    loops = [p.recording.loop for p in fitted.posterior.data.prepared if p.recording.loop is not None]
    kinds = [t.effect for t in fitted.model.terms[: fitted.base] for _ in t.estimates]
    at = [(i, e.joints[0]) for i, e in enumerate(kinds) if loops and e.motor == "viscous_Nm_s_per_rad"]
    result = np.zeros((len(fitted.posterior.matrix), len(at)))
    for column, (i, j) in enumerate(at):
        result[i, column] = INNER_CYCLE * np.mean([loop.kp[j] for loop in loops])
    return result


def plain_std(data: Data) -> np.ndarray:
    """Prior standard deviations of the plain terms' parameters, (p,).

    Those that their effects declare in the parameters' own units; of others, each alone would add `WIDE` times the torque of a joint.
    """
    found = rows(data.prepared, data.start)
    sizes = np.sqrt(np.mean(found.jacobian**2, axis=1)) / data.torque[:, None]  # (n, p) of a unit of each parameter
    declared = [t.effect.prior.typical.get(p.name, (np.inf, ""))[0] for t in data.start.terms for p in t.effect.parameters]
    return np.minimum(WIDE / np.maximum(sizes.max(axis=0, initial=0.0), 1e-12), declared)
