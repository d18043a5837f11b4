"""Gains of a sensor: what is identifiable, found exactly; what is not, refused; and what it is worth."""

from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calib import BadDataset, CalibrationDataset, NotObservable, Parameters, solve
from calib.extras.gain import Payload, estimate_force_gain, estimate_wrench_gain, wrench_gain_linearised
from calib.model import Array, predict

Indices = NDArray[np.int64]

WEIGHT_N = 20.0
SIGMA = np.repeat([0.05, 0.05 * 0.025], 3)


@dataclass(frozen=True)
class World:
    """A sensor with a force gain of a few percent, and what it reads."""

    parameters: Parameters
    gain: Array
    R_base_flange: Array
    wrench: Array

    def reading(self, R_base_flange: Array, contact_N: Array | float = 0.0) -> Array:
        p = self.parameters
        true = p.gravity_force_base_N @ (R_base_flange @ p.R_flange_sensor) + contact_N
        return np.asarray(true @ self.gain.T + p.force_bias_N)


def world(seed: int, n: int = 24, gain: float = 0.02, noise: float = 1.0) -> World:
    rng = np.random.default_rng(seed)
    parameters = Parameters(
        Rotation.random(rng=rng).as_matrix(),
        WEIGHT_N * Rotation.from_euler("xy", [1.5, 1], degrees=True).apply([0, 0, -1]),
        5 * rng.normal(size=3),
        np.array([0.02, -0.01, 0.077]),
        rng.normal(size=3),
    )
    R_base_flange = Rotation.random(n, rng=rng).as_matrix()
    it = World(
        parameters, np.eye(3) + gain * rng.normal(size=(3, 3)), R_base_flange, predict(parameters, R_base_flange)
    )
    it.wrench[:, :3] = it.reading(R_base_flange)
    it.wrench[:, :] += noise * SIGMA * rng.normal(size=(n, 6))
    return it


def covariances(n: int) -> Array:
    return np.tile(np.diag(SIGMA**2), (n, 1, 1))


def start_of(it: World) -> Parameters:
    n = len(it.wrench)
    dataset = CalibrationDataset(it.R_base_flange, it.wrench, covariances(n), np.zeros(n, np.int64), np.full(n, np.nan))
    return solve(dataset).parameters


@pytest.mark.parametrize("n", [6, 24])
def test_one_known_weight_gives_the_force_gain_exactly(n: int) -> None:
    it = world(0, n, gain=0.05, noise=0.0)
    found = estimate_force_gain(it.parameters, it.R_base_flange, it.wrench[:, :3], covariances(n)[:, :3, :3], WEIGHT_N)
    np.testing.assert_allclose(found.M, it.gain @ it.parameters.R_flange_sensor.T, atol=1e-9)
    np.testing.assert_allclose(found.gravity_force_base_N, it.parameters.gravity_force_base_N, atol=1e-8)
    np.testing.assert_allclose(found.force_bias_N, it.parameters.force_bias_N, atol=1e-8)
    assert found.dof == 3 * n - 14
    # The polar convention: the parts are a symmetric positive gain and a rotation, and make up M.
    np.testing.assert_allclose(found.gain @ found.R_flange_sensor.T, found.M, atol=1e-13)
    np.testing.assert_allclose(found.gain, found.gain.T, atol=1e-14)
    assert np.linalg.eigvalsh(found.gain).min() > 0
    assert np.linalg.det(found.R_flange_sensor) == pytest.approx(1)


def test_contact_through_the_gain_comes_out_true() -> None:
    it = world(1, gain=0.05, noise=0.0)
    found = estimate_force_gain(it.parameters, it.R_base_flange, it.wrench[:, :3], covariances(24)[:, :3, :3], WEIGHT_N)
    R = Rotation.random(4, rng=np.random.default_rng(2)).as_matrix()
    contact_N = np.random.default_rng(3).normal(size=(4, 3)) * 10
    compensated = found.compensate_force(it.reading(R, contact_N), R)
    in_flange = compensated @ found.R_flange_sensor.T  # free of any convention
    np.testing.assert_allclose(in_flange, contact_N @ it.parameters.R_flange_sensor.T, atol=1e-8)
    one = found.compensate_force(it.reading(R, contact_N)[0], R[0])
    np.testing.assert_allclose(one, compensated[0], atol=1e-12)


@pytest.mark.slow
def test_what_the_force_gain_is_worth() -> None:
    """2 % gains, 24 poses, noise 0.05 N: compensation rms 0.301 N without, 0.022 N with it, in simulation."""
    without, with_gain, misfit, distance = [], [], [], []
    for seed in range(10):
        it = world(seed)
        start = start_of(it)
        found = estimate_force_gain(start, it.R_base_flange, it.wrench[:, :3], covariances(24)[:, :3, :3], WEIGHT_N)
        R = Rotation.random(100, rng=np.random.default_rng(seed + 1000)).as_matrix()
        without.append(np.mean((it.reading(R) - predict(start, R)[:, :3]) ** 2))
        with_gain.append(np.mean(found.compensate_force(it.reading(R), R) ** 2))
        misfit.append(found.chi2 / found.dof)
        p = it.parameters
        error = np.concatenate(
            [
                (found.M - it.gain @ p.R_flange_sensor.T).ravel(),
                found.gravity_force_base_N - p.gravity_force_base_N,
                found.force_bias_N - p.force_bias_N,
            ]
        )
        distance.append(error @ np.linalg.pinv(found.covariance, rtol=1e-9, hermitian=True) @ error)
    assert 0.15 < np.sqrt(np.mean(without)) < 0.6
    assert np.sqrt(np.mean(with_gain)) < 0.03
    assert np.mean(misfit) == pytest.approx(1, abs=0.1)
    assert np.mean(distance) == pytest.approx(14, rel=0.2)


def test_without_the_weight_the_scale_is_undetermined() -> None:
    it = world(0)
    forces = it.wrench[:, :3]
    with pytest.raises(NotObservable, match="scale is undetermined"):
        estimate_force_gain(it.parameters, it.R_base_flange, forces, covariances(24)[:, :3, :3], None)
    with pytest.raises(BadDataset, match="-1 N"):
        estimate_force_gain(it.parameters, it.R_base_flange, forces, covariances(24)[:, :3, :3], -1)


def test_poses_that_leave_the_force_gain_free_are_rejected() -> None:
    it = world(0, 4)
    with pytest.raises(NotObservable, match="12 equations for 14 numbers"):
        estimate_force_gain(it.parameters, it.R_base_flange, it.wrench[:, :3], covariances(4)[:, :3, :3], WEIGHT_N)
    about_one_axis = Rotation.from_rotvec(np.linspace(0, 3, 12)[:, None] * [1, 0, 0]).as_matrix()
    upright = Parameters(np.eye(3), np.array([0, 0, -WEIGHT_N]), np.zeros(3), np.zeros(3), np.zeros(3))
    for p, R in ((it.parameters, about_one_axis), (upright, about_one_axis), (upright, np.tile(np.eye(3), (12, 1, 1)))):
        with pytest.raises(NotObservable, match=r"of 14 parameters.*: tilt"):
            estimate_force_gain(p, R, predict(p, R)[:, :3], covariances(12)[:, :3, :3], WEIGHT_N)


# Three payloads of which the centres of mass form a triangle.
PAYLOADS = (
    Payload(10.0, (0.01, 0.0, 0.05)),
    Payload(20.0, (0.06, 0.02, 0.07)),
    Payload(15.0, (-0.03, 0.08, 0.06)),
)


def wrench_world(
    payloads: tuple[Payload, ...], noise: float, seed: int
) -> tuple[Array, Parameters, Array, Array, Indices]:
    """Gain, parameters, orientations, readings and payload index of 15 poses a payload."""
    rng = np.random.default_rng(seed)
    p = world(seed).parameters
    lever = np.repeat([1.0, 0.05], 3)
    C: Array = np.eye(6) + 0.03 * rng.normal(size=(6, 6)) * lever[:, None] / lever
    index: Indices = np.repeat(np.arange(len(payloads), dtype=np.int64), 15)
    R = Rotation.random(len(index), rng=rng).as_matrix()
    force_N = p.gravity_force_base_N / WEIGHT_N @ (R @ p.R_flange_sensor)
    force_N = force_N * np.array([payload.weight_N for payload in payloads])[index, None]
    arm_m = np.array([payload.p_sensor_com_m for payload in payloads])[index]
    true = np.concatenate([force_N, np.cross(arm_m, force_N)], axis=1)
    y = true @ C.T + np.concatenate([p.force_bias_N, p.torque_bias_Nm])
    readings: Array = y + noise * SIGMA * rng.normal(size=y.shape)
    return C, p, R, readings, index


def test_three_known_payloads_give_the_wrench_gain_exactly() -> None:
    C, p, R, y, index = wrench_world(PAYLOADS, 0.0, 0)
    start = Parameters(p.R_flange_sensor, np.array([0, 0, -1.0]), np.zeros(3), np.zeros(3), np.zeros(3))
    found = estimate_wrench_gain(start, R, y, covariances(45), index.tolist(), PAYLOADS)
    np.testing.assert_allclose(found.gain, C, atol=1e-8)
    np.testing.assert_allclose(found.gravity_direction_base, p.gravity_force_base_N / WEIGHT_N, atol=1e-9)
    np.testing.assert_allclose(found.bias, [*p.force_bias_N, *p.torque_bias_Nm], atol=1e-8)
    assert found.dof == 6 * 45 - 44
    assert np.linalg.matrix_rank(found.covariance, tol=1e-9 * np.linalg.norm(found.covariance), hermitian=True) <= 44


def test_the_covariance_of_the_wrench_gain_is_honest() -> None:
    distance, misfit = [], []
    for seed in range(10):
        C, p, R, y, index = wrench_world(PAYLOADS, 1.0, seed)
        found = estimate_wrench_gain(p, R, y, covariances(45), index.tolist(), PAYLOADS)
        z = (found.gain - C).ravel() / np.sqrt(np.diag(found.covariance))[:36]
        distance.append(np.mean(z**2))
        misfit.append(found.chi2 / found.dof)
    assert np.mean(distance) == pytest.approx(1, rel=0.2)
    assert np.mean(misfit) == pytest.approx(1, abs=0.05)


COLLINEAR = (Payload(10.0, (0.01, 0, 0.05)), Payload(20.0, (0.03, 0, 0.05)), Payload(15.0, (0.08, 0, 0.05)))


@pytest.mark.parametrize(("payloads", "free"), [(PAYLOADS[:1], 18), (PAYLOADS[:2], 6), (COLLINEAR, 6), (PAYLOADS, 0)])
def test_rank_of_the_wrench_gain(payloads: tuple[Payload, ...], free: int) -> None:
    """One payload leaves 18 of 44 numbers free, two or three on one line 6, three none: and that is what is said."""
    C, p, R, y, index = wrench_world(payloads, 0.0, 0)
    n = len(index)
    weight_N = np.array([payload.weight_N for payload in payloads])[index]
    com_m = np.array([payload.p_sensor_com_m for payload in payloads])[index]
    d = p.gravity_force_base_N / WEIGHT_N
    x = np.concatenate([C.ravel(), d, np.zeros(6)])
    J = wrench_gain_linearised(x, p.R_flange_sensor, R, y, weight_N, com_m)[0].reshape(6 * n, 45)
    tangent = np.linalg.svd(d[None])[2][1:].T
    J = np.concatenate([J[:, :36], J[:, 36:39] @ tangent, J[:, 39:]], axis=1)
    s = np.linalg.svd(J / np.linalg.norm(J, axis=0), compute_uv=False)
    assert int((s > 1e-7 * s[0]).sum()) == 44 - free
    if free:
        with pytest.raises(NotObservable, match=f"do not determine {free} of 44 parameters: use three"):
            estimate_wrench_gain(p, R, y, covariances(n), index.tolist(), payloads)


def test_unknown_centres_of_mass_leave_four_numbers_free() -> None:
    """Derivatives by the three centres of mass, numerically, beside those of the 44: rank 53 - 4."""
    C, p, R, y, index = wrench_world(PAYLOADS, 0.0, 0)
    weight_N = np.array([payload.weight_N for payload in PAYLOADS])[index]
    com_m = np.array([payload.p_sensor_com_m for payload in PAYLOADS])
    d = p.gravity_force_base_N / WEIGHT_N
    x = np.concatenate([C.ravel(), d, np.zeros(6)])

    def linearised(com_m: Array) -> tuple[Array, Array]:
        return wrench_gain_linearised(x, p.R_flange_sensor, R, y, weight_N, com_m[index])

    J = linearised(com_m)[0].reshape(-1, 45)
    h = 1e-3  # the readings are linear in it
    steps = h * np.eye(9).reshape(9, 3, 3)
    by_com = np.stack([(linearised(com_m - e)[1] - linearised(com_m + e)[1]).ravel() / (2 * h) for e in steps], axis=1)
    tangent = np.linalg.svd(d[None])[2][1:].T
    J = np.concatenate([J[:, :36], J[:, 36:39] @ tangent, J[:, 39:], by_com], axis=1)
    s = np.linalg.svd(J / np.linalg.norm(J, axis=0), compute_uv=False)
    assert J.shape[1] == 53
    assert int((s > 1e-7 * s[0]).sum()) == 49
    unknown = (*PAYLOADS[:2], Payload(15.0, None))
    with pytest.raises(NotObservable, match="payload 2 is unknown"):
        estimate_wrench_gain(p, R, y, covariances(45), index.tolist(), unknown)


def test_payloads_that_are_listed_but_never_hung_do_not_count() -> None:
    _, p, R, y, index = wrench_world(PAYLOADS, 0.0, 0)
    with pytest.raises(NotObservable, match="2 known payloads do not determine 6 of 44"):
        estimate_wrench_gain(p, R[:30], y[:30], covariances(30), index[:30].tolist(), PAYLOADS)
    with pytest.raises(BadDataset, match=r"one of 0\.\.1"):
        estimate_wrench_gain(p, R, y, covariances(45), index.tolist(), PAYLOADS[:2])


def test_too_few_poses_of_a_payload_are_rejected() -> None:
    _, p, R, y, index = wrench_world(PAYLOADS, 0.0, 0)
    few = [0, 1, 15, 16, 30, 31]
    with pytest.raises(NotObservable, match=r"of 44 parameters.*: tilt"):
        estimate_wrench_gain(p, R[few], y[few], covariances(6), index[few].tolist(), PAYLOADS)
