"""What the delay estimator makes of a moving tool: each of its unknowns by a recording in which it is not zero."""

import numpy as np
import pytest

from ftcalib.model import Array
from ftdrive.stream.pairing import PERIOD_S, DelayEstimator
from ftdrive.stream.samples import Paired
from tests.unit.ftdrive.stream.simulated import NOISE, P_FLANGE_SENSOR_M, TRUTH, Motion, calibrated, paired

MOTION = Motion()
T_S = np.arange(0.0, 2.4, 1e-3)
SIZE = round(PERIOD_S * 1000)


def linearised(origin_m: Array, delay_s: float = 0.0, bias_N: float = 0.0) -> tuple[Array, Array]:
    """Derivative and residual of the force, scaled back to delay in s, errors of the calibration, lever in m."""
    estimator = DelayEstimator(calibrated(), origin_m)
    force_N = MOTION.wrench(T_S - delay_s)[:, :3] + bias_N
    columns = (T_S, force_N, *MOTION.pose(T_S))
    means = (column.reshape(-1, SIZE, *column.shape[1:]).mean(axis=1) for column in columns)
    found = estimator._linearised(*means)
    assert found is not None
    return found[0] @ np.linalg.inv(estimator._scale), found[1]


def test_each_unknown_explains_what_it_does_to_the_force() -> None:
    H, exact = linearised(P_FLANGE_SENSOR_M)
    assert np.abs(exact).max() < 0.02
    for column, change, other in (
        (0, 0.002, linearised(P_FLANGE_SENSOR_M, delay_s=0.002)),
        (7, 0.3, linearised(P_FLANGE_SENSOR_M, bias_N=0.3)),
        *((10 + k, 0.02, linearised(P_FLANGE_SENSOR_M - 0.02 * TRUTH.R_flange_sensor[:, k])) for k in range(3)),
    ):
        left = other[1] - exact
        expected = change * (H[:, 7:10].sum(axis=1) if column == 7 else H[:, column])
        assert np.abs(left).max() > 0.005
        np.testing.assert_allclose(left, expected, atol=0.03 * np.abs(expected).max() + 1e-4)


@pytest.mark.parametrize(("known", "lever_m"), [(True, 0.005), (False, 0.1)])
def test_what_is_expected_before_the_first_motion(known: bool, lever_m: float) -> None:
    calibration = calibrated()
    estimator = DelayEstimator(calibration, P_FLANGE_SENSOR_M if known else np.full(3, np.nan))
    covariance = estimator._scale @ estimator._scale.T
    expected = np.zeros((13, 13))
    expected[0, 0] = 0.05**2
    expected[1:10, 1:10] = calibration.covariance[:9, :9]
    expected[range(4, 7), range(4, 7)] += (0.05 * calibration.weight_N) ** 2  # a part in the gripper
    expected[range(7, 10), range(7, 10)] += 0.5**2
    expected[range(10, 13), range(10, 13)] = lever_m**2
    np.testing.assert_allclose(covariance, expected, atol=1e-9)
    assert (estimator.delay_s, estimator.sigma_s) == (0.0, 0.05)


def test_a_tool_that_turns_slowly_shows_no_delay() -> None:
    for rate_rad_s, shows in ((0.018, False), (0.022, True)):
        R, p = MOTION.pose(np.zeros(1))
        angle = rate_rad_s * T_S
        turn = np.zeros((len(T_S), 3, 3))
        turn[:, 0, 0] = turn[:, 1, 1] = np.cos(angle)
        turn[:, 1, 0], turn[:, 0, 1], turn[:, 2, 2] = np.sin(angle), -np.sin(angle), 1.0
        columns = (T_S, np.zeros((len(T_S), 3)), turn @ R[0], np.tile(p, (len(T_S), 1)))
        means = [column.reshape(-1, SIZE, *column.shape[1:]).mean(axis=1) for column in columns]
        found = DelayEstimator(calibrated(), P_FLANGE_SENSOR_M)._linearised(*means)
        assert (found is not None) == shows


def moved(delay_s: float, seconds: float, seed: int) -> Paired:
    t_s = np.arange(0.0, seconds, 1e-3)
    R, p = MOTION.pose(t_s)
    rows = paired(R, seed=seed)
    noise = NOISE * np.random.default_rng(seed).standard_normal((len(t_s), 6))
    values = {name: getattr(rows, name) for name in ("t_device_s", "seq", "status", "q_rad", "R_base_flange")}
    return Paired(t_host_ns=rows.t_host_ns, raw=MOTION.wrench(t_s - delay_s) + noise, p_base_flange_m=p, **values)


def test_the_error_of_the_delay_is_as_its_sigma_says() -> None:
    left = []
    for seed in range(8):
        estimator = DelayEstimator(calibrated(), P_FLANGE_SENSOR_M)
        estimator.add(moved(0.004, 2.01, seed))
        assert 5e-5 < estimator.sigma_s < 1.5e-4  # 6,000 numbers of 0.05 N, of a force that changes by 10 N/s
        left.append((estimator.delay_s - 0.004) / estimator.sigma_s)
    assert 0.4 < np.sqrt(np.mean(np.square(left))) < 1.6


def test_every_second_is_one_piece_whatever_the_blocks() -> None:
    rows = paired(np.tile(np.eye(3), (3500, 1, 1)))
    for block in (3500, 700, 90):
        estimator = DelayEstimator(calibrated(), P_FLANGE_SENSOR_M)
        blocks = (rows.rows(slice(i, i + block)) for i in range(0, 3500, block))
        pieces = [piece for one in blocks for piece in estimator._whole_seconds(one)]
        assert [(piece.seq[0], len(piece)) for piece in pieces] == [(0, 1000), (1000, 1000), (2000, 1000)]
        assert sum(map(len, estimator._pending)) == 500


def test_a_second_whose_push_looks_like_a_delay_does_not_count() -> None:
    for seconds, found in ((5.01, True), (2.01, False)):
        rows, estimator = moved(0.004, seconds, 0), DelayEstimator(calibrated(), P_FLANGE_SENSOR_M)
        rows.raw[950:1950, 2] += 6.0
        estimator.add(rows)
        assert abs(estimator.delay_s - 0.004) < 3 * estimator.sigma_s
        assert (estimator.sigma_s < 3e-4) == found  # of two seconds, which one is right?
