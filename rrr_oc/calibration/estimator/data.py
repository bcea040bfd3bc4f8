"""Recordings as the data of an estimate: which rows count, where joints turn, their noise, and what no law is exact enough for."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.linalg import toeplitz
from scipy.sparse import csr_matrix
from scipy.sparse.linalg import spsolve_triangular

from rrr_oc.calibration.calibrated_model import CalibratedModel
from rrr_oc.calibration.estimator.knobs import CLOCK_ERROR, DISCREPANCY, FRICTION_DISCREPANCY, MEMORY, PAST
from rrr_oc.calibration.regression import Rows, filtered, filtered_residuals, rows
from rrr_oc.calibration.samples import STRIDE, TURNS, Prepared, kept_rows
from rrr_oc.effects import Effect, Signals
from rrr_oc.numerics.smooth import sign
from rrr_oc.recordings.recording import Recording
from rrr_oc.robot.link_errors import LinkErrors

ROWS_PER_LAG = 30  # rows that each lag needs; with fewer the order is lower
LEAST_TURNING = 20  # rows at reversals from which their larger noise is estimated
EVERY = 2  # rows of which one is used: beyond 6 Hz derivatives of recorded positions are not exact
SLOW, SIGN = (0.02, 0.05, 0.12), 0.03  # speeds below which dry friction may be off, and width of its sign [rad/s]
EARLY = 0.005  # [s] by which friction may change sign before or after the motion turns; doubled, inertia is known less well
LEAST_DRY = 0.02  # of a joint's torque, the least dry friction that priors of friction refer to; doubled, weak friction is believed larger
ORDERS = {"q": 8, "dq": 4, "load": 4}  # of the cosines of a discrepancy over each variable


@dataclass(frozen=True, eq=False)
class Data:
    """Recordings ready for an estimate.

    Attributes:
        prepared: The recordings.
        start: The model that the discrepancy refers to, about calibrated; its terms are the plain ones.
        links: What is not known of the links' inertial parameters.
        free: Whether these errors may exceed the declared ones, as of a URDF; else they have the prior of links of which nothing is known.
        whole: All recordings, if these are a part of them.
        noise: Of each joint's rows, where these are `cleared` (n,) [Nm].
    """

    prepared: tuple[Prepared, ...]
    start: CalibratedModel
    links: LinkErrors
    free: bool
    whole: tuple[Prepared, ...] = ()
    noise: np.ndarray | None = None
    _friction: dict[tuple[Effect, float], np.ndarray] = field(default_factory=dict, repr=False)

    def part(self, keep: Sequence[int]) -> "Data":
        """The data of some of the recordings."""
        return self.of(tuple(self.prepared[i] for i in keep))

    def of(self, prepared: tuple[Prepared, ...]) -> "Data":
        """The data of parts of the recordings."""
        return Data(prepared, self.start, self.links, self.free, self.every)

    @property
    def every(self) -> tuple[Prepared, ...]:
        return self.whole or self.prepared

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.prepared[0].measured)

    @cached_property
    def torque(self) -> np.ndarray:
        """Standard deviation of each joint's recorded torque, (n,) [Nm]."""
        return np.maximum(np.concatenate([p.measured for p in self.every], axis=1).std(axis=1), 1e-9)

    @cached_property
    def edges(self) -> np.ndarray:
        """First row of each recording, and the number of rows, (R + 1,)."""
        return np.cumsum([0, *(len(k) for k in self.kept)]).astype(int)

    @cached_property
    def kept(self) -> tuple[np.ndarray, ...]:
        """Of each recording the rows of `regression.rows` that are used: every `EVERY`-th of a stretch."""
        return tuple(
            np.concatenate([np.arange(s.start, s.stop, EVERY) for s in kept_rows(p.recording)[1]] or [np.zeros(0, int)])
            for p in self.prepared
        )

    @cached_property
    def at(self) -> np.ndarray:
        """The rows of `regression.rows` that are used, (M,)."""
        first = np.cumsum([0, *(p.counted.shape[1] for p in self.prepared)])
        return np.concatenate([a + k for a, k in zip(first, self.kept, strict=False)])

    def rows(self, model: CalibratedModel, widths: Sequence[tuple[int, ...]] = ()) -> Rows:
        """Residuals and derivatives of a model at the rows that are used, those by widths as of `regression.rows` last."""
        found = rows(self.prepared, model, True, widths)
        residual, jacobian = (self.cleared(x[:, self.at]) for x in (found.residual, found.jacobian))
        return replace(found, residual=residual, jacobian=jacobian, moving=self.counted)

    def residual(self, model: CalibratedModel) -> np.ndarray:
        """The residual of a model at the rows that are used, (n, M)."""
        return self.cleared(filtered_residuals(self.prepared, model)[:, self.at])

    def in_noise(self, sigma: np.ndarray) -> "Data":
        """The same data, cleared for white noise of these standard deviations (n,) [Nm]."""
        other = replace(self, noise=sigma, _friction={})
        for name in ("features", "at", "kept", "edges", "torque", "label", "counted", "turning", "place"):
            if name in self.__dict__:
                other.__dict__[name] = self.__dict__[name]
        return other

    @cached_property
    def turns(self) -> np.ndarray:
        """What `cleared` takes off each joint's rows: how torques change if friction changes sign earlier than the motion turns, (n, M).

        When it does differs from arm to arm by some ms, since bearings yield, joints stick and engines smooth friction. Inertia
        would make up for that. With an unknown time of the standard deviation `EARLY`, which changes torques by a column c, and
        white noise of the deviation σ, rows are as in white noise if they lose the share 1 − 1/√(1 + |c|²/σ²) of their part along c;
        recording by recording, so that this holds for each by itself.
        """
        assert self.noise is not None
        every = [np.array([self._early(p.recording, j) for j in range(self.n)]) for p in self.prepared]
        passed = [p.passed(x, range(self.n)) for p, x in zip(self.prepared, every, strict=True)]
        found = np.concatenate(passed, axis=1)[:, self.at]
        squares = np.array([np.sum(part**2, axis=1) for part in np.split(found, self.edges[1:-1], axis=1)]).T
        share = 1 - 1 / np.sqrt(1 + squares / np.maximum(self.noise, 1e-12)[:, None] ** 2)
        return found * np.repeat(np.sqrt(share / np.maximum(squares, 1e-24)), np.diff(self.edges), axis=1)

    def _early(self, r: Recording, j: int) -> np.ndarray:
        """Change of a joint's torque along a recording if its dry friction changes sign earlier by `EARLY`, (K,) [Nm]."""
        parts = [
            np.gradient(sign(r.dq[j, s], SIGN), r.t[s]) if s.stop - s.start > 1 else np.zeros(s.stop - s.start)
            for s in r.segments
        ]
        return EARLY * self.dry[j] * np.concatenate(parts)

    @cached_property
    def dry(self) -> np.ndarray:
        """Dry friction of each joint, as `dry_friction` has it, (n,) [Nm]."""
        speed = np.quantile(np.abs(np.concatenate([p.recording.dq for p in self.every], axis=1)), 0.99, axis=1)
        return dry_friction(self.start, self.torque, np.maximum(speed, 1e-3))

    def cleared(self, x: np.ndarray) -> np.ndarray:
        """Rows (n, M) or (n, M, p) less what each recording has of `turns`, if noise is given."""
        if self.noise is None:
            return x
        return np.array([_cleared(one, turn, self.edges) for one, turn in zip(x, self.turns, strict=True)])

    @property
    def groups(self) -> tuple[str, ...]:
        """Physical set-up of each recording."""
        return tuple(p.recording.group for p in self.prepared)

    @cached_property
    def labels(self) -> tuple[str, ...]:
        """The distinct groups."""
        return tuple(dict.fromkeys(self.groups))

    def least_payload(self, scope: Sequence[str] | None) -> float:
        """The smallest listed payload in recordings of these groups (None: all groups) [kg]."""
        inside = [p for p in self.prepared if scope is None or p.recording.group in scope]
        return min((float(p.recording.payload.min()) for p in inside), default=0.0)

    @cached_property
    def label(self) -> np.ndarray:
        """Number of the group of each row, (M,)."""
        numbers = [self.labels.index(g) for g in self.groups]
        return np.repeat(numbers, np.diff(self.edges))

    @cached_property
    def counted(self) -> np.ndarray:
        """Rows that count, (n, M)."""
        return np.concatenate([p.counted for p in self.prepared], axis=1)[:, self.at]

    def friction(self, form: Effect, width: float) -> np.ndarray:
        """What dry friction of 1 Nm that changes sign in a given way adds to the recorded torque, filtered, at the rows used, (M,)."""
        if (form, width) not in self._friction:
            (p,) = form.parameters

            def law(r: Recording) -> np.ndarray:
                return np.reshape(-form.torque(Signals(r.q, r.dq), {p.name: 1.0}, width)[0], (1, -1))

            self._friction[form, width] = filtered(self.prepared, law, list(form.joints))[0, self.at]
        return self._friction[form, width]

    @cached_property
    def turning(self) -> np.ndarray:
        """Rows at which a joint turns, (n, M)."""
        return np.concatenate([p.turning for p in self.prepared], axis=1)[:, self.at]

    @cached_property
    def may_stick(self) -> np.ndarray:
        """Rows whose filter reaches to where a joint turns or rests, so that friction may be there what it is at rest, (n, M)."""
        # of a copy: sizes of a sparse matrix sort its entries in place, and sums their last digits
        rests = [(abs(p.matrix.copy()) @ (~p.moving).T.astype(float)).T > TURNS for p in self.prepared]
        return self.turning | np.concatenate(rests, axis=1)[:, self.at]

    @cached_property
    def place(self) -> np.ndarray:
        """Number of rows without a gap before each row; −1 where a row does not count, (n, M)."""
        begins = np.zeros(self.edges[-1], bool)
        for p, k, first in zip(self.prepared, self.kept, self.edges, strict=False):
            for s in kept_rows(p.recording)[1]:
                begins[first + np.searchsorted(k, s.start)] = True
        result = np.full(self.counted.shape, -1)
        for j, counted in enumerate(self.counted):
            broken = begins | ~np.concatenate([[False], counted[:-1]])
            last = np.maximum.accumulate(np.where(broken, np.arange(len(counted)), 0))
            result[j] = np.where(counted, np.arange(len(counted)) - last, -1)
        return result

    @cached_property
    def features(self) -> tuple[np.ndarray, ...]:
        """For each joint the functions of which a discrepancy is made, of the declared size, (M, F) [Nm]."""
        parts = [self._features(p, r) for r, p in enumerate(self.prepared)]
        return tuple(np.concatenate([part[j] for part in parts])[self.at] for j in range(self.n))

    def _features(self, p: Prepared, number: int) -> list[np.ndarray]:
        r, start, result = p.recording, self.start, []
        motor, load = start.torques(r)
        late = CLOCK_ERROR * np.gradient(np.array([load, motor - load]), r.t, axis=2)  # of the load and of the drive
        q_all = np.concatenate([x.recording.q for x in self.every], axis=1)
        dq_all = np.concatenate([np.abs(x.recording.dq) for x in self.every], axis=1)
        low, high = np.quantile(q_all, [0.002, 0.998], axis=1)
        speed = np.maximum(np.quantile(dq_all, 0.99, axis=1), 1e-3)
        for j in range(self.n):
            reach = max(3.0 * float(np.std(load[j])), 1e-6)
            span = max(high[j] - low[j], 1e-3)
            x = {
                "q": np.clip((r.q[j] - low[j]) / span, 0, 1),
                "dq": np.clip(np.abs(r.dq[j]) / speed[j], 0, 1),
                "load": np.clip(0.5 + load[j] / reach / 2, 0, 1),
            }
            series = {k: [np.cos(np.pi * o * v) / (1 + o) for o in range(1, ORDERS[k] + 1)] for k, v in x.items()}
            both = [a * b for a in series["q"][:3] for b in (*series["load"][:2], *series["dq"][:2])]
            shapes = np.array([*series["q"], *series["dq"], *series["load"], *both])
            slow = [np.exp(-((r.dq[j] / v) ** 2)) for v in SLOW]
            turned, one = sign(r.dq[j], SIGN), np.ones_like(load[j])
            steady = np.zeros((6 * len(self.prepared), len(one)))
            torque, friction = DISCREPANCY * self.torque[j], FRICTION_DISCREPANCY * self.dry[j]
            steady[6 * number : 6 * number + 6] = (
                torque * one,
                torque * load[j] / reach,
                friction * turned,
                friction * r.dq[j] / speed[j],
                *late[:, j],
            )
            every = np.concatenate([torque * shapes, friction * turned * np.array([*shapes, *slow]), late[:, j], steady])
            result.append(p.passed(every, np.full(len(every), j)).T)
        return result


def _cleared(x: np.ndarray, turn: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Rows (M,) or (M, p) of a joint less their parts along a column (M,), recording by recording."""
    pairs = (np.split(one, edges[1:-1]) for one in (x, turn))
    return np.concatenate([part - np.tensordot(column, column @ part, 0) for part, column in zip(*pairs, strict=True)])


def dry_friction(model: CalibratedModel, torque: np.ndarray, speed: np.ndarray) -> np.ndarray:
    """Plain dry friction of each joint [Nm], at least `LEAST_DRY` of its torque, and half of its friction at the largest speed, (n,).

    The latter, since a plain model that lacks friction may share out what there is between dry and viscous in any way.
    """
    dry, whole = LEAST_DRY * torque, np.zeros(len(torque))
    for term in model.terms:
        effect = term.effect
        if effect.role == "plain" and effect.provides == "friction":
            (at,) = effect.torque(Signals(0 * speed, speed), term.named, 0.0)
            whole[effect.joints[0]] += abs(float(at))
        if effect.sign_forms:
            dry[effect.joints[0]] = max(dry[effect.joints[0]], float(term.values[0]))
    return np.maximum(dry, 0.5 * whole)


@dataclass(frozen=True)
class Noise:
    """Prediction-error filters of the residual of one joint.

    Attributes:
        filters: For each order k = 0 … p the weights of the k rows before, (k,).
        spreads: Standard deviation of the prediction error of each order over that of the last, (p + 1,).
        turning: Standard deviation at rows where the joint turns, over that elsewhere.
    """

    filters: tuple[np.ndarray, ...]
    spreads: np.ndarray
    turning: float

    @classmethod
    def of(
        cls,
        residual: np.ndarray,
        place: np.ndarray,
        turning: np.ndarray,
        taken: np.ndarray | None = None,
        memory: float = MEMORY,
    ) -> "Noise":
        """Estimated by least squares from a residual (M,), with the sum of each filter's weights at most exp(−Δt / `memory`).

        An offset passes a filter by 1 − that sum, so that a sum near 1 would hide it. Least squares over the rows with a full past
        uses each stretch between gaps as it is; Yule and Walker's equations take its ends for 0, which biases short stretches, and
        Burg's recursion has no constraint on the sum. A filter that is not stable gives way to that of the order below.

        Args:
            place: Number of rows without a gap before each row; −1 where a row does not count, (M,).
            turning: Where the joint turns, (M,).
            taken: Columns whose products are the covariance of what parameters have taken up of the noise, (M, r); none by default.
            memory: Longest time over which it may stay alike [s].
        """
        order = order_of(float(np.count_nonzero(place >= 0)))
        lags = np.zeros((len(residual), order))
        for k in range(order):
            lags[k + 1 :, k] = residual[: -k - 1]
        calm, most = ~turning, float(np.exp(-STRIDE * EVERY / memory))
        lost = np.zeros(order + 1) if taken is None else autocovariance(taken, place, order)
        filters, spreads, factor, covariance = [], [], 1.0, toeplitz(lost)
        for k in range(order + 1):
            rows = (place >= k) & calm
            if np.count_nonzero(rows) < max(3 * k, 10):
                rows = place >= k
            x, y, more = lags[rows, :k], residual[rows], covariance[: k + 1, : k + 1]
            matrix = x.T @ x + len(y) * more[1:, 1:]
            weights = _bounded(matrix + 1e-9 * (y @ y + 1e-300) * np.eye(k), x.T @ y + len(y) * lost[1 : k + 1], most)
            if k and np.abs(np.roots([1.0, *-weights])).max(initial=0.0) >= 1:
                weights = np.append(filters[-1], 0.0)
            filters.append(weights)
            error = np.append(1.0, -weights)
            spreads.append(float(np.sqrt(np.mean((y - x @ weights) ** 2) + error @ more @ error)) if len(y) else 1.0)
        turned = (place >= order) & turning
        if np.count_nonzero(turned) > LEAST_TURNING and spreads[-1] > 0:
            error = residual[turned] - lags[turned] @ filters[-1]
            factor = max(1.0, float(np.sqrt(np.mean(error**2))) / spreads[-1])
        last = spreads[-1] or 1.0
        return cls(tuple(filters), np.maximum(np.array(spreads) / last, 1e-6), factor)

    @property
    def slow_gain(self) -> float:
        """How many times its prediction error the noise is in slow motion, at frequency 0."""
        return 1 / (1 - float(self.filters[-1].sum()))

    def whitening(self, place: np.ndarray, turning: np.ndarray) -> tuple[csr_matrix, float]:
        """The matrix (M, M) that turns the noise white, rows that do not count being 0, and the logarithm of its determinant."""
        order, size = len(self.filters) - 1, len(place)
        at = np.clip(place, 0, order)
        table = np.zeros((order + 1, order + 1))
        for k, weights in enumerate(self.filters):
            table[k] = np.concatenate([[1.0], -weights, np.zeros(order - k)]) / self.spreads[k]
        scale = np.where(place >= 0, np.where(turning, 1 / self.turning, 1.0), 0.0)
        bands = table[at] * scale[:, None]  # (M, order + 1)
        rows = np.repeat(np.arange(size), order + 1)
        columns = rows - np.tile(np.arange(order + 1), size)
        values = bands.ravel()
        kept = (values != 0) & (columns >= 0)
        matrix = csr_matrix((values[kept], (rows[kept], columns[kept])), shape=(size, size))
        counted = place >= 0
        return matrix, float(np.sum(np.log(scale[counted] / self.spreads[at[counted]])))


def low_frequency(residual: np.ndarray, place: np.ndarray, turning: np.ndarray, taken: np.ndarray | None = None) -> float:
    """Standard deviation of white noise that is as strong in slow motion as a residual, below 1/(2 π `PAST`); arguments as of `Noise.of`.

    What is slower still moves no parameter of what turns back and forth.
    """
    noise = Noise.of(residual, place, turning, taken, PAST)
    columns = residual[:, None] if taken is None else np.column_stack([residual, taken])
    square = np.sum((noise.whitening(place, turning)[0] @ columns) ** 2) / max(np.count_nonzero(place >= 0), 1)
    return max(float(np.sqrt(square)) * noise.slow_gain, 1e-9)


def share_of_low_frequency(
    columns: np.ndarray, residual: np.ndarray, place: np.ndarray, turning: np.ndarray, taken: np.ndarray | None = None
) -> np.ndarray:
    """Variance of the noise along columns (M, c), over that of the white noise of `low_frequency`, (c,); arguments as there.

    It is 1 for what is slow, and small for what is faster than most of what is left.
    """
    noise, counted = Noise.of(residual, place, turning, taken, PAST), place >= 0
    white = noise.whitening(place, turning)[0][counted][:, counted]
    along = spsolve_triangular(white.T.tocsr(), columns[counted], lower=False)
    squares = np.sum(along**2, axis=0) / np.maximum(np.sum(columns[counted] ** 2, axis=0), 1e-300)
    return squares / noise.slow_gain**2


def autocovariance(columns: np.ndarray, place: np.ndarray, most: int) -> np.ndarray:
    """Mean over the rows of a process whose covariance is columns (M, r) times their transpose, at 0, 1, … rows, (most + 1,).

    Divided by the same number at all lags, as else it would not be positive definite.
    """
    size, count = len(place), max(np.count_nonzero(place >= 0), 1)
    products = [np.einsum("ij,ij->i", columns[k:], columns[: size - k]) for k in range(most + 1)]
    return np.array([np.sum(one[place[k:] >= k]) / count for k, one in enumerate(products)])


def order_of(count: float) -> int:
    """Number of rows before one on which its noise is taken to depend, where so many rows count."""
    return int(np.clip(count // ROWS_PER_LAG, 0, round(PAST / STRIDE / EVERY)))


def _bounded(matrix: np.ndarray, right: np.ndarray, most: float) -> np.ndarray:
    """Least squares from normal equations, the sum of the solution being at most `most`, (k,)."""
    free, along = np.linalg.solve(matrix, np.column_stack([right, np.ones(len(right))])).T
    return free - along * max(free.sum() - most, 0.0) / along.sum() if len(right) else free
