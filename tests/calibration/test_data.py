"""Noise of a diagnosis against the dense covariance of an autoregressive process, and errors of links against Pinocchio."""

from types import SimpleNamespace

import numpy as np
import pinocchio as pin
import pytest
from scipy.linalg import block_diag, solve_discrete_lyapunov, toeplitz
from scipy.optimize import minimize
from scipy.signal import lfilter

from rrr_oc.calibration.estimator.data import EVERY, Noise, _bounded
from rrr_oc.calibration.estimator.evidence import Joint
from rrr_oc.calibration.estimator.knobs import CENTRE_ERROR, INERTIA_ERROR, MASS_ERROR, MEMORY
from rrr_oc.calibration.samples import STRIDE
from rrr_oc.robot.inertial_parameters import is_possible
from rrr_oc.robot.link_errors import LinkErrors

FIRST, SECOND = 1.2, -0.5  # of the process y_k = FIRST y_k−1 + SECOND y_k−2 + e_k
OF_URDF = (MASS_ERROR, *[CENTRE_ERROR] * 3, *[INERTIA_ERROR] * 3)
INNOVATION = 0.3  # standard deviation of e_k


def covariances(count: int) -> np.ndarray:
    """Autocovariances 0 … count − 1 of the process, from its state's Lyapunov equation."""
    step = np.array([[FIRST, SECOND], [1.0, 0.0]])
    state = solve_discrete_lyapunov(step, np.diag([INNOVATION**2, 0.0]))
    return np.array([(np.linalg.matrix_power(step, k) @ state)[0, 0] for k in range(count)])


def exact_noise(turning: float = 1.0) -> Noise:
    """The process as filters of orders 0, 1 and 2."""
    g = covariances(3)
    one = g[1] / g[0]
    spreads = np.sqrt([g[0], g[0] * (1 - one**2), INNOVATION**2]) / INNOVATION
    return Noise((np.zeros(0), np.array([one]), np.array([FIRST, SECOND])), spreads, turning)


def places(*lengths: int) -> np.ndarray:
    """Places of rows in stretches of these lengths; a negative length stands for rows that do not count."""
    return np.concatenate([np.arange(k) if k > 0 else np.full(-k, -1) for k in lengths])


PLACE = places(15, -2, 11, 6, -1)  # of which 32 count


def dense(place: np.ndarray) -> np.ndarray:
    """Covariance of the process over the rows that count; stretches are independent."""
    lengths = np.diff([*np.flatnonzero(place[place >= 0] == 0), np.count_nonzero(place >= 0)])
    return block_diag(*(toeplitz(covariances(k)) for k in lengths))


def test_whitening_is_the_root_of_the_dense_covariance():
    """Also across gaps; the determinant as well."""
    counted = PLACE >= 0
    white, log_det = exact_noise().whitening(PLACE, np.zeros(len(PLACE), bool))
    w = white.toarray()
    assert not np.any(w[~counted])
    assert not np.any(w[:, ~counted])
    w = w[np.ix_(counted, counted)]
    np.testing.assert_allclose(w @ dense(PLACE) @ w.T, INNOVATION**2 * np.eye(len(w)), atol=1e-12)
    expected = -0.5 * np.linalg.slogdet(dense(PLACE))[1] + len(w) * np.log(INNOVATION)
    assert log_det == pytest.approx(expected, abs=1e-10)


def test_rows_at_reversals_are_noisier():
    turning = np.zeros(len(PLACE), bool)
    turning[[4, 20]] = True
    white, log_det = exact_noise(turning=3.0).whitening(PLACE, turning)
    counted = PLACE >= 0
    w = white.toarray()[np.ix_(counted, counted)]
    assert log_det == pytest.approx(np.linalg.slogdet(w)[1], abs=1e-10)
    calm = exact_noise().whitening(PLACE, turning)[0].toarray()
    np.testing.assert_allclose(white.toarray()[[4, 20]], calm[[4, 20]] / 3.0)


def test_noise_of_a_simulated_process_is_estimated_and_made_white():
    rng, place = np.random.default_rng(0), places(3000, -5, 3000)
    y = np.concatenate([lfilter([1.0], [1.0, -FIRST, -SECOND], INNOVATION * rng.standard_normal(6105))[100:]])
    y = y * (place >= 0)
    data = SimpleNamespace(torque=np.full(9, 1e3), place=place[None], turning=np.zeros((1, len(place)), bool))
    one, sigma = Joint.estimated(data, 0, y)
    assert sigma == pytest.approx(INNOVATION, rel=0.03)  # three standard errors
    filters = one.noise.filters[-1]
    np.testing.assert_allclose(filters, [FIRST, SECOND, *np.zeros(len(filters) - 2)], atol=0.06)  # some five of them
    error = (one.white @ y)[place >= 0] / sigma
    assert np.std(error) == pytest.approx(1.0, rel=0.01)
    correlation = [np.mean(error[k:] * error[:-k]) for k in range(1, 20)]
    assert np.max(np.abs(correlation)) < 0.06  # white noise of 6000 samples: standard deviation 0.013


@pytest.mark.parametrize("seed", range(3))
def test_an_offset_costs_in_spite_of_the_noise(seed):
    """An autoregression with a unit root would take a constant for noise; that of noise over `MEMORY` passes a part of it."""
    most, place = np.exp(-EVERY * STRIDE / MEMORY), places(400, -5, 300, -1, 200)
    rng, count = np.random.default_rng(seed), len(place)
    offset, noise = 10.0, lfilter([1.0], [1.0, -0.8], rng.standard_normal(count + 100))[100:]
    found = Noise.of((noise + offset) * (place >= 0), place, np.zeros(count, bool))
    assert all(weights.sum() <= most + 1e-9 for weights in found.filters)
    white, _ = found.whitening(place, np.zeros(count, bool))
    order = len(found.filters) - 1
    passed = (white @ np.full(count, offset))[place >= order]
    assert np.all(passed >= offset * (1 - most) - 1e-9)


def test_the_sum_is_bounded_by_least_squares_under_a_constraint():
    rng = np.random.default_rng(5)
    x, most = rng.standard_normal((50, 4)), 0.5
    y = x @ np.array([0.6, 0.4, -0.1, 0.2]) + 0.1 * rng.standard_normal(50)
    found = _bounded(x.T @ x, x.T @ y, most)
    expected = minimize(
        lambda w: np.sum((y - x @ w) ** 2), np.zeros(4), constraints={"type": "ineq", "fun": lambda w: most - w.sum()}
    ).x
    np.testing.assert_allclose(found, expected, atol=1e-5)  # of SLSQP
    np.testing.assert_allclose(_bounded(x.T @ x, x.T @ y, 5.0), np.linalg.lstsq(x, y, rcond=None)[0], rtol=1e-9)


def test_filters_are_stable_of_a_residual_that_grows():
    one = 1.03 ** np.arange(60) * np.cos(1.2 * np.arange(60))
    y, place = np.tile(np.append(one, 0.0), 10), places(*[60, -1] * 10)
    found = Noise.of(y + 1e-3 * np.random.default_rng(0).standard_normal(len(y)) * (place >= 0), place, np.zeros(len(y), bool))
    assert all(np.abs(np.roots([1.0, *-weights])).max(initial=0.0) < 1 for weights in found.filters)


def test_errors_of_links_are_those_of_mass_centre_and_second_moments():
    """Slopes of Pinocchio's parameters; second moments about the centre of mass, mass at the same shape."""
    small = 1e-6
    pin.seed(4)
    bodies = [pin.Inertia.Random() for _ in range(2)]
    links = LinkErrors(np.array([b.toDynamicParameters() for b in bodies]).T, np.tile(OF_URDF, 2))
    found = links.at(links.none)[1]
    assert found.shape == (20, 14)

    def slope(body: pin.Inertia, mass: float = 0.0, centre=(0, 0, 0), moments=(0, 0, 0)) -> np.ndarray:
        """Of the parameters by shares of mass and second moments and a shift of the centre [m]."""
        ends = []
        for s in (small, -small):
            factor, stretch = 1 + s * mass, np.diag(1 + s / 2 * np.array(moments))
            spread = factor * stretch @ (np.trace(body.inertia) / 2 * np.eye(3) - body.inertia) @ stretch
            about = np.trace(spread) * np.eye(3) - spread
            ends.append(pin.Inertia(factor * body.mass, body.lever + s * np.asarray(centre), about).toDynamicParameters())
        return (ends[0] - ends[1]) / 2 / small

    for i, body in enumerate(bodies):
        own = found[10 * i : 10 * i + 10, 7 * i : 7 * i + 7]
        expected = [
            slope(body, mass=MASS_ERROR),
            *(slope(body, centre=CENTRE_ERROR * e) for e in np.eye(3)),
            *(slope(body, moments=INERTIA_ERROR * e) for e in np.eye(3)),
        ]
        np.testing.assert_allclose(own, np.array(expected).T, rtol=1e-6, atol=1e-8)  # of differences over 1e-6
        found[10 * i : 10 * i + 10, 7 * i : 7 * i + 7] = 0
    assert not np.any(found)  # no link's error is in another's parameters


@pytest.mark.parametrize("identified", [True, False])
def test_links_are_bodies_whatever_their_errors(identified):
    """Of a rod, and of a small heavy body far from its joint, whose inertia about its centre is small beside that of a shift."""
    rod = pin.Inertia(2.0, np.array([0.0, 0.0, 0.4]), np.diag([0.1, 0.1, 1e-5]))
    small = pin.Inertia(0.49, np.array([0.0, 0.0, -0.1]), 2e-5 * np.eye(3))
    plain, rng = np.array([b.toDynamicParameters() for b in (rod, small)]).T, np.random.default_rng(2)
    links = LinkErrors(plain, np.full(20, 0.3) if identified else np.tile(OF_URDF, 2))
    np.testing.assert_allclose(links.at(links.none)[0], plain, rtol=1e-12, atol=1e-15)
    for _ in range(100):
        errors = 4 * rng.standard_normal(len(links.std))
        bodies, slopes = links.at(errors)
        assert all(is_possible(body) for body in bodies.T)
        step = 1e-6 * rng.standard_normal(len(links.std))
        change = (links.at(errors + step)[0] - links.at(errors - step)[0]).T.ravel()
        np.testing.assert_allclose(2 * slopes @ step, change, rtol=1e-5, atol=1e-5 * np.abs(change).max())


def test_links_without_mass_have_none_whatever_the_errors():
    bodies, slopes = LinkErrors(np.zeros((10, 1)), np.array(OF_URDF)).at(np.ones(7))
    assert not np.any(bodies)
    assert np.all(np.isfinite(slopes))
