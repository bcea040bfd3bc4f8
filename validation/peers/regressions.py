"""How peers choose terms: sparse regressions of PySINDy and scikit-learn, and boosted trees, by their defaults and tuned.

Tuning is the same for all: whole recordings are left out in turn, and the sparsest model is taken whose error on them is within one
standard error of the least (Breiman et al., "Classification and Regression Trees", 1984, sec. 3.4.3). The model without any term
takes part, so that a peer can say that nothing is missing.
"""

import warnings
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from sklearn.ensemble import HistGradientBoostingRegressor
from sklearn.inspection import permutation_importance
from sklearn.linear_model import LassoCV, lasso_path

from validation.peers.library import Problem

# pyright: reportMissingImports=false
# (PySINDy is in the extra "peers")

FOLDS = 4  # at most, of whole recordings
THRESHOLDS = np.geomspace(0.02, 0.8, 10)  # of coefficients, as shares of the residual's size
PENALTIES = np.geomspace(1e-3, 1.0, 30)  # of the lasso, as shares of the least that keeps no term
RIDGE = 1e-5  # of STLSQ, for each row; its default is 0.05 for all rows, of which there are thousands
INCLUDED = 0.9  # share of an ensemble's models that must have a term (Fasel et al., Proc. R. Soc. A 478, 2022)
Path = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]  # (X, y, strengths) -> coefficients (strengths, C)


def folds(y: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Numbers of the recordings that are left out together, of those that have rows; none where only one has, so that none is seen."""
    own = np.flatnonzero([len(part) > 0 for part in y])
    return np.array_split(own, min(FOLDS, len(own))) if len(own) > 1 else []


def joined(parts: Sequence[np.ndarray], numbers: Sequence[int] | np.ndarray) -> np.ndarray:
    """Rows of these recordings."""
    return np.concatenate([parts[k] for k in numbers])


def compressed(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fewer rows with the same normal equations, by a QR decomposition; no peer loses by it, and all are faster."""
    if len(y) <= x.shape[1] + 1:
        return x, y
    triangle = np.asarray(np.linalg.qr(np.hstack([x, y[:, None]]), mode="r"))
    return triangle[:, :-1], triangle[:, -1]


def tuned(path: Path, problem: Problem, strengths: np.ndarray) -> tuple[np.ndarray, float]:
    """Coefficients (C,) and their strength by the rule of one standard error; zeros and infinity where no term is worth it."""
    count = len(problem.x)
    left = []
    for out in folds(problem.y):
        seen = np.setdiff1d(np.arange(count), out)
        columns = problem.screen(seen)
        found = path(*compressed(joined(problem.x, seen)[:, columns], joined(problem.y, seen)), strengths)
        x, y = joined(problem.x, out)[:, columns], joined(problem.y, out)
        left.append(np.sum((y[:, None] - x @ found.T) ** 2, axis=0) / np.sum(y**2))
    if not left:
        return np.zeros(problem.x[0].shape[1]), np.inf
    mean, error = np.mean(left, axis=0), np.std(left, axis=0, ddof=1) / np.sqrt(len(left))
    best = int(np.argmin(mean))
    coefficients = np.zeros(problem.x[0].shape[1])
    if mean[best] + error[best] >= 1.0:  # of nothing, whose error is 1 by definition
        return coefficients, np.inf
    strength = strengths[mean <= mean[best] + error[best]].max()
    columns = problem.screen(range(count))
    whole = compressed(joined(problem.x, range(count))[:, columns], joined(problem.y, range(count)))
    coefficients[columns] = path(*whole, np.array([strength]))[0]
    return coefficients, float(strength)


def sindy(optimizer: Any, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Coefficients (C,) of a `pysindy.SINDy` whose library are the columns themselves and whose derivative is y."""
    import pysindy

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that a threshold leaves no term, or that iterations ended: both are results here
        model = pysindy.SINDy(optimizer=optimizer, feature_library=pysindy.IdentityLibrary())
        model.fit(x, t=1.0, x_dot=y[:, None])
    return np.asarray(model.coefficients())[0]


def scaled(x: np.ndarray, y: np.ndarray, norm: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Columns and target with root of the sum of squares `norm`, and what turns their coefficients back, (C,)."""
    size, of_y = (np.maximum(np.linalg.norm(part, axis=0) / norm, 1e-300) for part in (x, y))
    return x / size, y / of_y, of_y / size


def stlsq_path(x: np.ndarray, y: np.ndarray, strengths: np.ndarray) -> np.ndarray:
    """Sequentially thresholded least squares, on columns of root mean square 1."""
    import pysindy

    a, b, back = scaled(x, y, np.sqrt(len(y)))
    return np.array([sindy(pysindy.STLSQ(threshold=s, alpha=RIDGE * len(b)), a, b) * back for s in strengths])


def sr3_path(x: np.ndarray, y: np.ndarray, strengths: np.ndarray) -> np.ndarray:
    """Sparse relaxed regularised regression with the l0 norm, on columns of norm 1; the strength is its threshold √(2 λ ν)."""
    import pysindy

    a, b, back = scaled(x, y, 1.0)
    ways = (pysindy.SR3(reg_weight_lam=s**2 / 2, relax_coeff_nu=1.0, max_iter=1000) for s in strengths)
    return np.array([sindy(way, a, b) * back for way in ways])


def lasso(x: np.ndarray, y: np.ndarray, strengths: np.ndarray) -> np.ndarray:
    """The lasso on columns of root mean square 1."""
    a, b, back = scaled(x, y, np.sqrt(len(y)))
    largest = np.max(np.abs(a.T @ b)) / len(b)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of convergence: columns that are nearly equal share a coefficient in any way
        _, found, _ = lasso_path(a, b, alphas=np.sort(strengths)[::-1] * largest, max_iter=2000)
    return (found.T * back)[::-1][np.argsort(np.argsort(strengths))]


def stlsq_default(problem: Problem) -> np.ndarray:
    """PySINDy as `pysindy.SINDy()` has it: STLSQ with threshold 0.1, here of the noise's standard deviation."""
    import pysindy

    return sindy(pysindy.STLSQ(), joined(problem.x, range(len(problem.x))), joined(problem.y, range(len(problem.y))))


def lasso_default(problem: Problem) -> np.ndarray:
    """`LassoCV` as it is, on columns of root mean square 1, with whole recordings left out, at the least error."""
    count = len(problem.x)
    a, b, back = scaled(joined(problem.x, range(count)), joined(problem.y, range(count)), np.sqrt(sum(map(len, problem.y))))
    of = np.repeat(np.arange(count), [len(part) for part in problem.y])
    cv = [(np.flatnonzero(~np.isin(of, out)), np.flatnonzero(np.isin(of, out))) for out in folds(problem.y)]
    if not cv:
        return np.zeros(a.shape[1])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return LassoCV(cv=cv).fit(a, b).coef_ * back


def ensemble(problem: Problem) -> np.ndarray:
    """E-SINDy: 20 models on bootstrapped rows with the tuned threshold; terms that nine in ten of them have, fitted again."""
    import pysindy

    coefficients, strength = tuned(stlsq_path, problem, THRESHOLDS)
    columns = problem.screen(range(len(problem.x)))
    if not np.isfinite(strength):
        return coefficients
    x, y = joined(problem.x, range(len(problem.x)))[:, columns], joined(problem.y, range(len(problem.y)))
    a, b, back = scaled(x, y, np.sqrt(len(y)))
    optimizer = pysindy.EnsembleOptimizer(pysindy.STLSQ(threshold=strength, alpha=RIDGE * len(b)), bagging=True, n_models=20)
    state = np.random.get_state()  # noqa: NPY002 (PySINDy draws from the global generator)
    np.random.seed(0)  # noqa: NPY002
    try:
        sindy(optimizer, a, b)
    finally:
        np.random.set_state(state)  # noqa: NPY002
    often = np.mean([np.asarray(c)[0] != 0 for c in optimizer.coef_list], axis=0) >= INCLUDED
    result = np.zeros(len(coefficients))
    if often.any():
        result[columns[often]] = np.linalg.lstsq(a[:, often], b, rcond=None)[0] * back[often]
    return result


SPARSE: dict[str, Callable[[Problem], np.ndarray]] = {
    "PySINDy, STLSQ, defaults": stlsq_default,
    "PySINDy, STLSQ, tuned": lambda problem: tuned(stlsq_path, problem, THRESHOLDS)[0],
    "PySINDy, SR3, tuned": lambda problem: tuned(sr3_path, problem, THRESHOLDS)[0],
    "PySINDy, ensemble of STLSQ, tuned": ensemble,
    "scikit-learn, LassoCV": lasso_default,
    "scikit-learn, lasso, tuned": lambda problem: tuned(lasso, problem, PENALTIES)[0],
}
ON_TEXTBOOK = tuple(SPARSE)
ON_SIGNATURES = (
    "PySINDy, STLSQ, tuned",
    "PySINDy, SR3, tuned",
    "PySINDy, ensemble of STLSQ, tuned",
    "scikit-learn, lasso, tuned",
)


def boosted(x: Sequence[np.ndarray], y: Sequence[np.ndarray]) -> tuple[Any | None, float, np.ndarray]:
    """Boosted trees by scikit-learn's defaults, of one joint.

    Args:
        x: Of each recording the inputs (K, inputs).
        y: Of each recording what is left (K,).

    Returns:
        The regression fitted to all recordings, the share of the squared residual that those fitted without a recording predict of
        it, and the importance of each input for that (inputs,). None, 0 and zeros where that is not above 0 by one standard error.
    """
    left, important = [], []
    for out in folds(y):
        seen = np.setdiff1d(np.arange(len(x)), out)
        model = HistGradientBoostingRegressor(random_state=0).fit(joined(x, seen), joined(y, seen))
        held, target = joined(x, out), joined(y, out)
        left.append(1.0 - np.sum((target - model.predict(held)) ** 2) / np.sum(target**2))
        found: Any = permutation_importance(model, held, target, n_repeats=2, random_state=0, scoring="neg_mean_squared_error")
        important.append(found.importances_mean)
    gain, error = (float(np.mean(left)), float(np.std(left, ddof=1) / np.sqrt(len(left)))) if left else (0.0, 0.0)
    if gain <= error:
        return None, 0.0, np.zeros(x[0].shape[1])
    whole = HistGradientBoostingRegressor(random_state=0).fit(joined(x, range(len(x))), joined(y, range(len(y))))
    return whole, gain, np.mean(important, axis=0)
