"""Maximum likelihood: in the right basin, predictions of left-out poses, with the noise the data show."""

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

from ftcalib import Parameters
from ftcalib.known import Constraints, Known
from ftcalib.likelihood.descent import Descent, Statistics, coefficients, coefficients_derivative, features, wrench_gram
from ftcalib.likelihood.fit import Fit, fit
from ftcalib.likelihood.session import Drift
from ftcalib.likelihood.session_noise import CHUNK, Noise, summed_products
from ftcalib.likelihood.variance_components import squared_length
from ftcalib.model import Array, jacobian, predict

WEIGHT_N = 20.0
SIGMA = np.repeat([0.2, 0.2 * 0.025], 3)  # a hundredth of the weight
WHITE = np.diag(SIGMA**2)
DRIFTS: tuple[Drift, ...] = ("auto", "linear", "random-walk", "none")


def truth(rng: np.random.Generator) -> Parameters:
    down = Rotation.from_rotvec(np.append(0.035 * rng.normal(size=2), 0.0)).apply([0.0, 0.0, -WEIGHT_N])
    com = rng.normal(size=3)
    return Parameters(
        Rotation.random(rng=rng).as_matrix(),
        down,
        5 * rng.normal(size=3),
        0.08 * com / np.linalg.norm(com),
        0.3 * rng.normal(size=3),
    )


def haar(rng: np.random.Generator, n: int) -> Array:
    return np.asarray(Rotation.random(n, rng=rng).as_matrix())


def cone(rng: np.random.Generator, n: int, degrees: float) -> Array:
    """Tool axis within an angle of straight down, wrist free."""
    lean = np.arccos(1 - rng.uniform(size=n) * (1 - np.cos(np.deg2rad(degrees))))
    azimuth, spin = rng.uniform(0, 2 * np.pi, (2, n))
    tilted = Rotation.from_rotvec(np.column_stack([lean * np.cos(azimuth), lean * np.sin(azimuth), 0 * lean]))
    turned = Rotation.from_rotvec(spin[:, None] * [0.0, 0.0, 1.0])
    return np.asarray((tilted * Rotation.from_rotvec([np.pi, 0, 0]) * turned).as_matrix())


def noise(rng: np.random.Generator, n: int, sigma: Array = SIGMA) -> Array:
    return np.asarray(rng.normal(size=(n, 6)) * sigma)


def bound(p: Parameters, R: Array, weights: Array) -> Array:
    """Cramer-Rao bound (5,) of the mean square error of each block."""
    J = jacobian(p, R)
    information = np.einsum("nai,nab,nbj->ij", J, np.broadcast_to(weights, (len(R), 6, 6)), J, optimize=True)
    return np.asarray(np.diag(np.linalg.inv(information)).reshape(5, 3).sum(axis=1))


def squared(best: Fit, p: Parameters) -> Array:
    return np.asarray((best.parameters.difference(p) ** 2).reshape(5, 3).sum(axis=1))


# Sufficient statistics


def test_statistics_under_drift_are_those_of_the_dense_covariance() -> None:
    rng = np.random.default_rng(3)
    p, R = truth(rng), haar(rng, 9)
    wrench, T = predict(p, R) + rng.normal(size=(9, 6)), rng.normal(size=(9, 6, 2))
    walk = np.array([0.5, 0, 1, 0, 0.2, 0])
    noise = Noise(np.tile(np.eye(6), (9, 1, 1)), np.arange(9.0), walk, effects=(T, np.array([0.3, 2.0])))
    q = p.moved(0.1 * rng.normal(size=15))
    J, e = jacobian(q, R), wrench - predict(q, R)
    X = np.concatenate([J, e[..., None]], axis=2)
    expected = summed_products(X, noise.solve(X))
    H, g, cost = Statistics.of_noise(features(R), wrench, noise, coefficients(p)).normal_equations(q)
    np.testing.assert_allclose(H, expected[:15, :15], atol=1e-9 * np.abs(expected).max())
    np.testing.assert_allclose(g, expected[:15, 15], atol=1e-9 * np.abs(expected).max())
    assert cost == pytest.approx(expected[15, 15])


def test_statistics_give_the_normal_equations_of_the_data() -> None:
    rng = np.random.default_rng(1)
    p, R = truth(rng), haar(rng, 9)
    np.testing.assert_allclose(features(R) @ coefficients(p).T, predict(p, R), atol=1e-13)
    T = coefficients_derivative(p)
    np.testing.assert_allclose(np.einsum("dcm,nm->ncd", T, features(R)), jacobian(p, R), atol=1e-13)

    A = rng.normal(size=(9, 6, 8))
    weights, wrench = A @ np.swapaxes(A, 1, 2), predict(p, R) + rng.normal(size=(9, 6))
    q = p.moved(0.1 * rng.normal(size=15))
    J, e = jacobian(q, R), wrench - predict(q, R)
    expected = [np.einsum("nai,nab,nbj->ij", J, weights, J), np.einsum("nai,nab,nb->i", J, weights, e)]
    H, g, cost = Statistics.of(features(R), wrench, weights, coefficients(p)).normal_equations(q)
    np.testing.assert_allclose(H, expected[0], rtol=1e-9, atol=1e-9 * np.abs(expected[0]).max())
    np.testing.assert_allclose(g, expected[1], atol=1e-9 * np.abs(expected[1]).max())
    assert cost == pytest.approx(np.einsum("na,nab,nb", e, weights, e))

    reference = np.zeros((6, 10))
    reference[:, 9] = wrench.mean(axis=0)
    parts = [wrench_gram(R[part], wrench[part], reference) for part in (slice(0, 4), slice(4, 9))]
    summed = Statistics.of_gram(parts[0] + parts[1], weights[0], reference)
    whole = Statistics.of(features(R), wrench, np.broadcast_to(weights[0], (9, 6, 6)), np.zeros((6, 10)))
    for k in range(3):
        ours, other = np.asarray(summed.normal_equations(q)[k]), np.asarray(whole.normal_equations(q)[k])
        np.testing.assert_allclose(ours, other, atol=1e-8 * np.abs(other).max())


# Basins


@pytest.mark.slow
@pytest.mark.parametrize(("n", "degrees", "weight_in_sigma"), [(6, 180, 10), (12, 40, 30)])
def test_no_start_reaches_a_lower_minimum(n: int, degrees: float, weight_in_sigma: float) -> None:
    sigma = SIGMA * 100 / weight_in_sigma
    for seed in range(4):
        rng = np.random.default_rng(seed)
        p, R = truth(rng), haar(rng, n) if degrees == 180 else cone(rng, n, degrees)
        wrench = predict(p, R) + noise(rng, n, sigma)
        descent = Descent(R, wrench, Constraints(Known(), 9.8))
        weights = np.broadcast_to(np.diag(1 / sigma**2), (n, 6, 6))
        lowest = descent.minima(weights)[0].chi2
        statistics = Statistics.of(features(R), wrench, weights, coefficients(p))
        starts = [p, *(p.moved(np.append(turn, np.zeros(12))) for turn in 3 * rng.normal(size=(4, 3)))]
        assert lowest < min(descent.down(statistics, start).chi2 for start in starts) + 1e-6


@pytest.mark.slow
def test_the_odds_of_the_second_basin_are_those_of_being_wrong() -> None:
    azimuth = np.arange(8) * np.pi / 4
    expected, wrong, seen = 0.0, 0, 0
    for seed in range(120):
        rng = np.random.default_rng(seed)
        lean = np.deg2rad(40) * np.column_stack([np.cos(azimuth), np.sin(azimuth), 0 * azimuth])
        lean[0] *= rng.uniform(0.4, 1)  # all but one of the same tilt: up and down look alike
        R = (Rotation.from_rotvec(lean) * Rotation.from_rotvec([np.pi, 0, 0])).as_matrix()
        p = truth(rng)
        best = fit(R, predict(p, R) + noise(rng, 8, 5 * SIGMA), np.diag((5 * SIGMA) ** 2), drift="none")
        if best.second_basin_chi2 is not None and best.second_basin_chi2 < 12:
            seen += 1
            expected += 1 / (1 + np.exp(best.second_basin_chi2 / 2))
            wrong += bool(np.linalg.norm(best.parameters.difference(p)[:3]) > np.pi / 2)
    assert seen > 20
    assert abs(wrong - expected) < 3 * np.sqrt(expected)


# What is not sensor noise


@pytest.mark.slow
def test_bumped_poses_are_rejected_and_no_others() -> None:
    rng, n, bumped = np.random.default_rng(0), 12, 3
    p, R = truth(rng), haar(rng, n)
    push = rng.normal(size=(bumped, 3))
    push *= (WEIGHT_N * rng.uniform(0.2, 1, bumped) / np.linalg.norm(push, axis=1))[:, None]
    wrench = predict(p, R) + noise(rng, n)
    wrench[:bumped] += np.concatenate([push, np.cross(0.1 * rng.normal(size=(bumped, 3)), push)], axis=1)
    best = fit(R, wrench, WHITE)
    assert np.flatnonzero(best.weights == 0).tolist() == list(range(bumped))
    assert best.dof == 6 * (n - bumped) - 15
    distances = squared_length(best.left_out_residuals, best.left_out_cov)
    assert (distances[:bumped] > 22).all()
    assert (squared(best, p) / bound(p, R[bumped:], np.linalg.inv(WHITE)) < 4).all()


@pytest.mark.slow
def test_inexact_orientations_are_found_and_weighed() -> None:
    sigma, turn = SIGMA / 10, np.deg2rad(0.3)
    error, least, found = np.zeros(5), np.zeros(5), []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        p, R = truth(rng), haar(rng, 24)
        wrench = predict(p, R) + noise(rng, 24, sigma)
        reported = R @ Rotation.from_rotvec(turn * rng.normal(size=(24, 3))).as_matrix()
        best = fit(reported, wrench, np.diag(sigma**2))
        found.append(best.components.get("rotation_rad", 0.0))
        error += squared(best, p)
        J = jacobian(p, R)[..., :3]
        least += bound(p, R, np.linalg.inv(np.diag(sigma**2) + turn**2 * J @ np.swapaxes(J, 1, 2)))
    assert np.median(found) == pytest.approx(turn, rel=0.1)
    np.testing.assert_allclose(error / least, 1, atol=0.5)  # without: 1.3 1.4 13 6 30


def drifting(rng: np.random.Generator, n: int, kind: str) -> tuple[Parameters, Array, Array, Array]:
    p, R = truth(rng), haar(rng, n)
    size = 0.07 * np.repeat([1, 0.025], 3)
    bias = np.cumsum(rng.normal(size=(n, 6)), axis=0) if kind == "walk" else np.linspace(0, 20, n)[:, None] * np.ones(6)
    bias = bias * size
    wrench = predict(p, R) + noise(rng, n, SIGMA / 10) + bias
    end = bias[-1]
    return p.moved(np.concatenate([np.zeros(6), end[:3], np.zeros(3), end[3:]])), R, wrench, bias


@pytest.mark.slow
def test_a_drifting_bias_is_followed() -> None:
    turned, covered, changes = [], [], []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        p, R, wrench, bias = drifting(rng, 60, "walk")
        best = fit(R, wrench, np.diag((SIGMA / 10) ** 2))
        e = best.parameters.difference(p)
        turned.append(e[:3])
        covered.append(np.abs(e) < 1.96 * np.sqrt(np.diag(best.covariance)))
        assert best.drift is not None
        changes.append((best.drift.change - (bias[-1] - bias[0])) / best.drift.sigma)
        assert [best.components[f"walk_f{axis}_N"] for axis in "xyz"] == pytest.approx([0.07] * 3, rel=0.5)
    assert np.sqrt(np.mean(np.sum(np.square(turned), axis=1))) < np.deg2rad(0.026)  # without drift: 0.077
    assert 0.9 < np.mean(covered) < 0.99
    assert 0.7 < np.std(changes) < 1.4


def test_a_linear_drift_is_named_and_measured() -> None:
    rng = np.random.default_rng(4)
    p, R, wrench, bias = drifting(rng, 24, "line")
    for drift in DRIFTS[:2]:
        best = fit(R, wrench, np.diag((SIGMA / 10) ** 2), drift=drift)
        assert not any(name.startswith("walk") for name in best.components)
        assert best.drift is not None
        np.testing.assert_allclose(best.drift.change, bias[-1] - bias[0], atol=4 * best.drift.sigma.max())
        e = best.parameters.difference(p)
        assert e @ np.linalg.solve(best.covariance, e) < stats.chi2.isf(1e-3, 15)
    assert best.dof == 6 * 24 - 15 - 6


@pytest.mark.parametrize("drift", DRIFTS[1:3])
def test_left_out_poses_are_predicted_as_by_a_new_fit(drift: Drift) -> None:
    rng = np.random.default_rng(6)
    _, R, wrench, _ = drifting(rng, 11, "walk")
    best = fit(R, wrench, np.diag((SIGMA / 10) ** 2), drift=drift, gain_sigma=0.0)
    J, e, order = jacobian(best.parameters, R).reshape(66, 15), best.residuals.ravel(), np.arange(66)
    V: Array = np.zeros((66, 66))
    for i in range(11):
        V[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] = best.noise.D[i]
    if drift == "linear":
        J = np.concatenate([J, np.kron(np.linspace(-1, 1, 11)[:, None], np.eye(6))], axis=1)
    else:
        V = np.asarray(np.linalg.inv(best.noise.solve(np.eye(66).reshape(11, 6, 66)).reshape(66, 66)))
    for k in (0, 5, 10):
        own, rest = order[6 * k : 6 * k + 6], np.delete(order, slice(6 * k, 6 * k + 6))
        W = np.linalg.inv(V[np.ix_(rest, rest)])
        x = np.linalg.solve(J[rest].T @ W @ J[rest], J[rest].T @ W @ e[rest])
        expected = e[own] - J[own] @ x - V[np.ix_(own, rest)] @ W @ (e[rest] - J[rest] @ x)
        np.testing.assert_allclose(best.left_out_residuals[k], expected, atol=1e-7)


# What is known before


def random_known(name: str, p: Parameters, rng: np.random.Generator) -> Known:
    small = 0.004
    tilted = Rotation.from_rotvec(small * rng.normal(size=3)).as_matrix()
    if name == "rotation":
        return Known(R_flange_sensor=p.R_flange_sensor)
    if name == "rotation about":
        return Known(R_flange_sensor=tilted @ p.R_flange_sensor, R_tolerance_rad=small)
    if name == "direction":
        return Known(gravity_direction_base=p.gravity_force_base_N)
    if name == "direction about":
        return Known(gravity_direction_base=tilted @ p.gravity_force_base_N, direction_tolerance_rad=small)
    if name == "mass":
        return Known(mass_kg=WEIGHT_N / 9.80665)
    if name == "mass about":
        return Known(mass_kg=(WEIGHT_N + 0.02 * rng.normal()) / 9.80665, mass_tolerance_kg=0.02 / 9.80665)
    turn = Rotation.from_rotvec([0, 0, rng.uniform(0, 6)]).as_matrix()
    if name == "yaw":
        return Known(R_flange_sensor=turn @ p.R_flange_sensor, yaw_only=True)
    lean = Rotation.from_rotvec(small * np.append(rng.normal(size=2), 0)).as_matrix()
    return Known(R_flange_sensor=turn @ lean @ p.R_flange_sensor, yaw_only=True, R_tolerance_rad=small)


@pytest.mark.parametrize(
    ("name", "block", "information"),
    [
        ("rotation about", slice(0, 3), 3 / 0.004**2),
        ("yaw about", slice(0, 3), 2 / 0.004**2),
        ("direction about", slice(3, 6), 2 / (0.004 * WEIGHT_N) ** 2),
        ("mass about", slice(3, 6), 1 / 0.02**2),
    ],
)
def test_a_tolerance_counts_as_a_measurement_of_that_sigma(name: str, block: slice, information: float) -> None:
    rng = np.random.default_rng(10)
    p, R = truth(rng), haar(rng, 8)
    wrench = predict(p, R) + 1e-3 * noise(rng, 8)
    free = fit(R, wrench, WHITE, drift="none", gain_sigma=0.0)
    best = fit(R, wrench, WHITE, known=random_known(name, p, rng), drift="none", gain_sigma=0.0)
    added = np.linalg.inv(best.covariance) - np.linalg.inv(free.covariance)
    assert np.trace(added[block, block]) == pytest.approx(information, rel=0.05)


@pytest.mark.parametrize("name", ["rotation", "direction", "mass", "yaw"])
def test_an_exact_constraint_is_the_limit_of_a_tolerance(name: str) -> None:
    rng = np.random.default_rng(8)
    p, R = truth(rng), haar(rng, 8)
    wrench = predict(p, R) + noise(rng, 8)
    exact = random_known(name, p, rng)
    soft = Known(exact.R_flange_sensor, 1e-6, exact.yaw_only, exact.gravity_direction_base, 1e-6, exact.mass_kg, 1e-6)
    hard, nearly = (fit(R, wrench, WHITE, known=one, gain_sigma=0.0) for one in (exact, soft))
    sigma = np.sqrt(np.diag(nearly.covariance))
    assert (np.abs(hard.parameters.difference(nearly.parameters)) < 1e-3 * sigma + 1e-6).all()
    np.testing.assert_allclose(np.sqrt(np.diag(hard.covariance)), sigma, atol=2e-5)
    assert hard.dof == nearly.dof
    assert hard.chi2 == pytest.approx(nearly.chi2, rel=1e-3)


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"R_flange_sensor": 2 * np.eye(3)}, "must be a rotation matrix"),
        ({"R_flange_sensor": np.diag([1.0, 1, -1])}, "must be a rotation matrix"),
        ({"gravity_direction_base": [0, 0, 0]}, "three numbers, not all 0"),
        ({"mass_kg": 0.0}, "mass_kg is 0"),
        ({"mass_kg": 1.0, "mass_tolerance_kg": -1.0}, r"mass_tolerance_kg is -1\.0"),
    ],
)
def test_impossible_knowledge_is_refused(fields: dict[str, object], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        Known(**fields)  # type: ignore[arg-type]  # the point of the test


# Many poses, and readings below the resolution


def test_many_poses_are_predicted_in_parts_as_they_would_be_at_once() -> None:
    rng = np.random.default_rng(8)
    n = CHUNK + 50
    p, R = truth(rng), haar(rng, n)
    best = fit(R, predict(p, R) + noise(rng, n), WHITE, drift="none")
    assert len(list(best.noise.parts())) == 2
    J = jacobian(best.parameters, R)
    hat = J @ np.linalg.inv(np.einsum("nia,ij,njb->ab", J, np.linalg.inv(WHITE), J)) @ np.swapaxes(J, 1, 2)
    others = np.linalg.inv(np.eye(6) - hat @ np.linalg.inv(WHITE))
    residuals = np.einsum("nij,nj->ni", others, best.residuals)
    np.testing.assert_allclose(best.left_out_residuals, residuals, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(best.left_out_cov, others @ WHITE, rtol=1e-9, atol=1e-12)


def test_residuals_below_what_a_sensor_resolves_are_the_noise() -> None:
    rng = np.random.default_rng(21)
    tool, R = truth(rng), Rotation.random(24, rng=rng).as_matrix()
    found = fit(R, predict(tool, R) + rng.normal(size=(24, 6)) * SIGMA / 2000, None)
    assert found.chi2 == pytest.approx(found.dof, rel=0.01)
