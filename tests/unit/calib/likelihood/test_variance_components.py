"""Noise of a session: O(n) algebra against dense matrices, restricted likelihood against its definition."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from scipy.integrate import quad

from ftcalib.likelihood.explanation import _prune
from ftcalib.likelihood.session_noise import Noise, centre
from ftcalib.likelihood.variance_components import (
    FORCE,
    RESPONSE,
    ROTATION,
    TORQUE,
    Component,
    Linearised,
    channel_component,
    estimates_of_unknown_variances,
    expected_variances,
    maximise,
    parameter_estimates,
    point,
    score,
)
from ftcalib.model import Array

SLOPE_FORCE, SLOPE_TORQUE = channel_component("slope", FORCE), channel_component("slope", TORQUE)
WALK_FORCE = channel_component("walk", FORCE)
WHITE_FORCE, WHITE_TORQUE = channel_component("white", FORCE), channel_component("white", TORQUE)

N = 15


def dense(D: Array, time: Array, walk: Array, slope: Array) -> Array:
    n = len(D)
    tau = np.cumsum(np.diff(time, prepend=time[0] - 1))
    without_mean = np.eye(n) - 1 / n
    K = without_mean @ np.minimum.outer(tau, tau) @ without_mean
    V = np.asarray(np.kron(K, np.diag(walk**2)), dtype=np.float64)
    V += np.kron(np.outer(centre(time), centre(time)), np.diag(slope**2))
    for i in range(n):
        V[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] += D[i]
    return np.asarray(V, dtype=np.float64)


def covariances(rng: np.random.Generator, n: int = N) -> Array:
    A = rng.normal(size=(n, 6, 9))
    return np.asarray(A @ np.swapaxes(A, 1, 2))


@pytest.mark.parametrize(
    ("walk", "slope"),
    [
        ([0.3, 0, 0.5, 0.1, 0, 20.0], [0] * 6),
        ([0.3, 0, 0.5, 0.1, 0, 0.2], [0, 1.0, 0, 0, 2.0, 3.0]),
        ([1e-4] * 6, [0] * 6),
    ],
)
def test_the_inverse_is_that_of_the_dense_covariance(walk: list[float], slope: list[float]) -> None:
    rng = np.random.default_rng(1)
    D, time = covariances(rng), np.cumsum(rng.uniform(0.1, 3, N))
    noise = Noise(D, time, np.array(walk), np.array(slope))
    V = dense(D, time, np.array(walk), np.array(slope))
    inverse = np.linalg.inv(V)
    X = rng.normal(size=(N, 6, 4))
    np.testing.assert_allclose(noise.solve(X).reshape(-1, 4), inverse @ X.reshape(-1, 4), atol=1e-9)
    blocks = [inverse[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] for i in range(N)]
    np.testing.assert_allclose(noise.blocks, blocks, atol=1e-9)
    assert noise.logdet == pytest.approx(np.linalg.slogdet(V)[1], abs=1e-8)


def test_an_unknown_slope_is_one_of_infinite_variance() -> None:
    rng = np.random.default_rng(2)
    D, time = covariances(rng), np.arange(N, dtype=float)
    unknown = Noise(D, time, None, np.full(6, np.inf))
    line = centre(time)[:, None, None] * np.eye(6)
    np.testing.assert_allclose(unknown.solve(line), 0, atol=1e-12)
    X = rng.normal(size=(N, 6, 2))
    np.testing.assert_allclose(unknown.solve(X), Noise(D, time, None, np.full(6, 1e5)).solve(X), atol=1e-7)


ALL = (WHITE_FORCE, WHITE_TORQUE, ROTATION, WALK_FORCE, channel_component("walk", [5]))
THETA = np.array([0.3, 0.2, 0.05 / 400, 0.4, 0.1])


def problem(rng: np.random.Generator, n: int, components: tuple[Component, ...], theta: Array) -> Linearised:
    J = rng.normal(size=(n, 6, 8))
    J[:, :, :6] = np.eye(6)  # biases are always free
    turn = 20 * rng.normal(size=(n, 6, 3))  # as large as a small turn makes it
    time = np.arange(n, dtype=float)
    D = np.tile(np.eye(6) * 0.04, (n, 1, 1))
    V = D.copy()
    walk = np.zeros(6)
    for c, v in zip(components, theta, strict=True):
        if c.kind == "white":
            V += v * np.diag(c.share)
        elif c.kind == "rotation":
            V += v * turn @ np.swapaxes(turn, 1, 2)
        else:
            walk += np.sqrt(v) * np.array(c.share)
    r = (np.linalg.cholesky(V) @ rng.normal(size=(n, 6, 1)))[..., 0]
    r += np.cumsum(rng.normal(size=(n, 6)) * walk, axis=0)
    return Linearised(
        J,
        r,
        (np.zeros((8, 8)), np.zeros(8)),
        turn,
        D,
        time,
        np.ones(n, bool),
        False,
        {"gain": np.zeros((n, 6, 5)), "cross_talk": np.zeros((n, 6, 6))},
    )


@pytest.mark.parametrize("components", [ALL, (*ALL[:3], SLOPE_FORCE, SLOPE_TORQUE)])
def test_slope_and_curvature_are_those_of_the_restricted_likelihood(components: tuple[Component, ...]) -> None:
    rng = np.random.default_rng(5)
    p = problem(rng, N, ALL, THETA)
    slope, information = score(p, point(p, components, THETA), components, THETA)
    h = 1e-4
    for k in range(len(components)):
        up, down = (point(p, components, THETA * np.exp(s * h * np.eye(len(components))[k])).loglik for s in (1, -1))
        assert slope[k] == pytest.approx((up - down) / (2 * h), rel=1e-5, abs=1e-6), components[k].name
    assert np.linalg.eigvalsh(information).min() > 0


def test_the_restricted_likelihood_is_that_of_error_contrasts() -> None:
    rng = np.random.default_rng(6)
    p = problem(rng, 8, ALL, THETA)
    X = p.J.reshape(-1, 8)
    contrasts = np.linalg.svd(X)[0][:, 8:]

    def exact(theta: Array) -> float:
        D = p.D + theta[0] * np.diag([1, 1, 1, 0, 0, 0.0]) + theta[1] * p.turn @ np.swapaxes(p.turn, 1, 2)
        V = dense(D, p.time, np.sqrt(theta[2]) * np.array([1, 1, 1, 0, 0, 0.0]), np.zeros(6))
        C, y = contrasts.T @ V @ contrasts, contrasts.T @ p.r.ravel()
        return float(-0.5 * (np.linalg.slogdet(C)[1] + y @ np.linalg.solve(C, y)))

    components = (ALL[0], ALL[2], ALL[3])
    thetas = np.exp(rng.normal(size=(4, 3))) / [1, 400, 1]
    ours = [point(p, components, theta).loglik for theta in thetas]
    np.testing.assert_allclose(np.diff(ours), np.diff([exact(theta) for theta in thetas]), atol=1e-8)


def test_what_others_make_needless_is_dropped() -> None:
    white, walk = WHITE_FORCE, WALK_FORCE
    both = (white, walk)
    rng = np.random.default_rng(7)
    for really, needed, kept in (
        ((white,), 0, (white,)),
        ((walk,), 0, (walk,)),
        (both, 0, both),
        ((white,), 2, both),  # whatever the data say
    ):
        p = problem(rng, 40, really, np.full(len(really), 0.3))
        at = maximise(p, both, np.full(2, 0.1))
        assert _prune(p, at, needed).components == kept


def test_unknown_noise_widens_sigma_like_students_distribution() -> None:
    white = Component("white", "white", (1.0,) * 6)
    p = problem(np.random.default_rng(8), 8, (white,), np.array([0.3]))
    p = replace(p, D=1e-6 * p.D)
    at = maximise(p, (white,), np.array([0.3]))
    x, C = estimates_of_unknown_variances(at)
    nu = 6 * 8 - 8
    np.testing.assert_allclose(x[:8], at.step)
    np.testing.assert_allclose(C[:8, :8], at.C[:8, :8] * (1 + (1.96**2 + 1) / (2 * nu)), rtol=1e-3, atol=1e-9)
    assert stats.t.ppf(0.975, nu) / 1.96 == pytest.approx(np.sqrt(C[0, 0] / at.C[0, 0]), rel=2e-3)


def test_many_poses_show_their_noise() -> None:
    p = problem(np.random.default_rng(9), 1000, ALL[:2], THETA[:2])
    at = point(p, ALL[:2], THETA[:2])
    np.testing.assert_array_equal(estimates_of_unknown_variances(at)[1], parameter_estimates(at)[1])


GAINS, CROSS_TALK = RESPONSE


def small(n: int = 12, bumped: int = 2) -> Linearised:
    """A problem of constant columns: 5 of gain as large as 0.5, of which each counts by itself."""
    rng = np.random.default_rng(11)
    turn = np.zeros((n, 6, 3))
    turn[:, :3], turn[:, 3:] = 2.0, 1.0
    response, hysteresis = rng.normal(size=(n, 6, 11)), rng.normal(size=(n, 6, 12))
    response[..., :5] = 0.5
    D = np.tile(np.diag(np.repeat([0.04, 0.01], 3)), (n, 1, 1))
    D[:bumped] *= 100.0
    J, r, kept = rng.normal(size=(n, 6, 8)), rng.normal(size=(n, 6)), np.arange(n) >= bumped
    prior = np.zeros((8, 8)), np.zeros(8)
    effects = {"gain": response[..., :5], "cross_talk": response[..., 5:], "hysteresis": hysteresis}
    effects["cable"] = rng.normal(size=(n, 6, 18))
    return Linearised(J, r, prior, turn, D, np.arange(n, dtype=float), kept, False, effects, 0.5)


@pytest.mark.parametrize("share", [1.0, 1e-3])
def test_the_expected_white_noise_is_that_of_a_normal_likelihood_and_a_uniform_sigma(share: float) -> None:
    white = WHITE_FORCE
    p = problem(np.random.default_rng(12), 8, (white,), np.array([0.05]))
    best = maximise(p, (white,), np.array([0.05]))
    at = point(p, (white,), share * best.theta)
    slope, information = score(p, at, (white,), at.theta)
    variance = at.theta[0]
    gradient, curvature = slope[0] / variance, information[0, 0] / variance**2

    def density(sigma: float) -> float:
        v = sigma**2 - variance
        return float(np.exp(gradient * v - curvature * v**2 / 2))

    most = np.sqrt(variance + 9 / np.sqrt(curvature) + 2 * abs(gradient) / curvature)
    mean = quad(lambda s: s**2 * density(s), 0, most)[0] / quad(density, 0, most)[0]
    np.testing.assert_allclose(expected_variances(p, at), max(mean, variance), rtol=1e-2)
