"""Samples of a moving arm: their means, and rows of wrench and motion, against motions with known derivatives."""

from unittest.mock import Mock

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ftcalib.errors import BadDataset
from ftcalib.model import Array, skew
from ftcalib.motion import samples
from ftcalib.motion.samples import MEAN_S, NARROW_S, WIDE_S, Means, motion_rows, row_filter

AXIS = np.array([0.36, 0.48, 0.8])
TURN_RAD, TURN_HZ, SWING_HZ = 3.5, 0.05, np.array([0.11, 0.07, 0.09])
STEP_S = 1e-3


def angle(t: Array) -> Array:
    return np.asarray(TURN_RAD * np.sin(2 * np.pi * TURN_HZ * t))


def place(t: Array) -> Array:
    return np.asarray([0.3, -0.2, 0.1] * np.sin(2 * np.pi * np.outer(t, SWING_HZ)))


def derivative(f: object, t: Array) -> Array:
    return np.asarray((f(t + STEP_S) - f(t - STEP_S)) / (2 * STEP_S))  # type: ignore[operator]


def columns(t: Array) -> Array:
    """The 21 numbers of a motion: a turn about one axis, and a swing of the flange."""
    R = Rotation.from_rotvec(np.outer(angle(t), AXIS)).as_matrix()
    rate = derivative(angle, t)
    Omega = derivative(lambda s: derivative(angle, s), t)[:, None, None] * skew(AXIS)
    Omega = Omega + rate[:, None, None] ** 2 * skew(AXIS) @ skew(AXIS)
    acceleration = np.einsum("nji,nj->ni", R, derivative(lambda s: derivative(place, s), t))
    return np.hstack([R.reshape(-1, 9), acceleration, Omega.reshape(-1, 9)])


def streams(seconds: float, delay_s: float = 0.0) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """A stream with the motion itself and its rate in place of a wrench, and poses; both at 10 ms."""
    t: Array = np.arange(round(seconds / MEAN_S)) * np.float64(MEAN_S)
    happened = t - delay_s
    motion = columns(happened)
    motion[:, :9] += MEAN_S**2 / 12 * derivative(lambda s: derivative(columns, s), happened)[:, :9]  # as a mean is
    R = Rotation.from_rotvec(np.outer(angle(t), AXIS)).as_matrix().reshape(-1, 9)
    return (t, np.hstack([motion, derivative(columns, happened)])), (t, np.hstack([R, place(t)]))


def reach_s(row_s: float) -> float:
    """From the ends of the streams to the first and last row: the filter, its derivative, and that of the poses."""
    return MEAN_S * (len(row_filter(row_s)) // 2 + 1 + 5)


def around(row_s: float) -> Array:
    """Times of the means that a row sees."""
    half = len(row_filter(row_s)) // 2 + 1
    return np.asarray(MEAN_S * np.arange(-half, half + 1))


def mean_speed(t: Array, row_s: float, swing_rad_s: Array | float) -> Array:
    times = (t[:, None] + around(row_s)).ravel()
    return np.asarray((np.abs(derivative(angle, times)) + swing_rad_s).reshape(len(t), -1).mean(axis=1))


@pytest.mark.parametrize(("row_s", "seconds", "delay_s"), [(NARROW_S, 20.0, 0.0), (WIDE_S, 75.5, 0.03)])
def test_motion_and_wrench_are_differentiated_and_filtered_alike(row_s: float, seconds: float, delay_s: float) -> None:
    wrench, poses = streams(seconds, delay_s)  # of 75 s are more rows than are filtered at once
    rows = motion_rows(wrench, poses, delay_s, row_s)
    assert len(rows) == int((seconds - MEAN_S - delay_s - 2 * reach_s(row_s)) / row_s)
    np.testing.assert_allclose(np.diff(rows.t_s), row_s)
    np.testing.assert_allclose(rows.t_s / MEAN_S, np.round(rows.t_s / MEAN_S), atol=1e-6)
    assert (rows.row_s, rows.delay_s) == (row_s, delay_s)
    np.testing.assert_allclose(rows.motion.columns(), rows.wrench[:, :21], atol=1e-6)
    np.testing.assert_allclose(rows.rate.columns(), rows.wrench[:, 21:], atol=5e-5)
    happened = rows.t_s - delay_s
    np.testing.assert_allclose(rows.wrench[:, :9], columns(happened)[:, :9], atol=5e-4)  # no phase
    swing = np.linalg.norm(derivative(place, (happened[:, None] + around(row_s)).ravel()), axis=1)
    np.testing.assert_allclose(rows.speed_rad_s, mean_speed(happened, row_s, swing / 0.5), atol=1e-4)


def test_a_band_passes_motion_and_stops_vibration() -> None:
    for row_s, passed_Hz, stopped_Hz in ((WIDE_S, 1.0, 8.5), (NARROW_S, 0.43, 3.7)):
        kernel = row_filter(row_s)
        half = len(kernel) // 2
        assert kernel.sum() == pytest.approx(1)
        np.testing.assert_allclose(kernel, kernel[::-1])

        def left(hz: float, kernel: Array = kernel, half: int = half) -> float:
            return float(kernel @ np.cos(2 * np.pi * hz * MEAN_S * np.arange(-half, half + 1)))

        assert left(passed_Hz) == pytest.approx(1, abs=2e-3)
        assert left(0.56 / row_s) == pytest.approx(0.5, abs=5e-3)
        assert abs(left(stopped_Hz)) < 2e-3
        step = round(row_s / MEAN_S)
        assert abs(kernel[step:] @ kernel[:-step]) < 0.05 * (kernel @ kernel)  # white noise stays white


def test_rows_near_a_gap_are_left_out() -> None:
    (t, values), poses = streams(12.0)
    reach = around(WIDE_S)[-1]
    whole = motion_rows((t, values), poses).t_s
    for gap, missing in ((0.05, False), (0.08, True)):
        beside = (t < 6.0) | (t >= 6.0 + gap - MEAN_S / 2)
        for some in (
            motion_rows((t[beside], values[beside]), poses),
            motion_rows((t, values), (t[beside], poses[1][beside])),
        ):
            if not missing:
                np.testing.assert_array_equal(some.t_s, whole)
                np.testing.assert_allclose(some.motion.columns(), some.wrench[:, :21], atol=1e-3)
                continue
            before, after = some.t_s[some.t_s < 6.0].max(), some.t_s[some.t_s > 6.0].min()
            assert len(whole) - len(some) == round((after - before) / WIDE_S) - 1
            assert 0 <= 6.0 - MEAN_S - before - reach < WIDE_S + MEAN_S / 2
            assert 0 <= after - 6.0 - gap - reach < WIDE_S + MEAN_S / 2


def test_a_gap_of_hours_costs_no_work(monkeypatch: pytest.MonkeyPatch) -> None:
    (t, values), (_, poses) = streams(24.0)
    later = np.where(t < 12.0, t, t + 80_000.0)
    chunk = Mock(side_effect=samples._chunk)
    monkeypatch.setattr(samples, "_chunk", chunk)
    rows = motion_rows((later, values), (later, poses))
    assert 100 < len(rows) < 200
    assert chunk.call_count <= 3


def test_the_ends_that_both_streams_have_count() -> None:
    (t, values), (t_pose, poses) = streams(12.0)
    rows = motion_rows((t[150:], values[150:]), (t_pose[:1000], poses[:1000]), 0.02)
    assert rows.t_s[0] == pytest.approx(1.5 + reach_s(WIDE_S))
    assert 0 <= 9.99 + 0.02 - reach_s(WIDE_S) - rows.t_s[-1] < WIDE_S + 3 * MEAN_S
    few = motion_rows((t[:195], values[:195]), (t_pose, poses))
    assert len(few) == 8
    with pytest.raises(BadDataset, match=r"overlap by only 1\.9 s"):
        motion_rows((t[:191], values[:191]), (t_pose, poses))


def test_without_positions_the_acceleration_is_unknown() -> None:
    wrench, (t, poses) = streams(10.0)
    with_positions, without = (motion_rows(wrench, (t, some)) for some in (poses, poses[:, :9]))
    assert not without.motion.acceleration_m_s2.any()
    np.testing.assert_array_equal(without.motion.R_base_flange, with_positions.motion.R_base_flange)
    np.testing.assert_allclose(without.speed_rad_s, mean_speed(without.t_s, WIDE_S, 0.0), atol=1e-4)


def test_means_weigh_samples_by_their_distance() -> None:
    rng = np.random.default_rng(0)
    t, values = np.sort(rng.uniform(0.2, 0.7, 400)), rng.standard_normal((400, 2))
    means = Means()
    means.add(t[:0], values[:0])
    means.add(t, values)
    weight = np.maximum(1 - np.abs(t - MEAN_S * np.arange(20, 71)[:, None]) / MEAN_S, 0.0)
    weight /= weight.sum(axis=1, keepdims=True)
    t_mean, mean = means.result()
    assert means.samples == 400
    np.testing.assert_allclose(t_mean, weight @ t)
    np.testing.assert_allclose(mean, weight @ values, atol=1e-12)


@pytest.mark.parametrize("wrong", ["time", "value", "nothing", "order"])
def test_samples_that_cannot_be_used_are_refused(wrong: str) -> None:
    t, values, means = np.arange(3.0), np.ones((3, 1)), Means()
    if wrong == "nothing":
        with pytest.raises(BadDataset, match="no samples"):
            means.result()
        return
    (values[1] if wrong == "value" else t)[0 if wrong == "value" else 2] = 0.5 if wrong == "order" else np.nan
    with pytest.raises(BadDataset, match="times decrease" if wrong == "order" else "not a finite number"):
        means.add(t, values)


@pytest.mark.parametrize(
    ("at", "value", "words"),
    [
        (0.02, 1e308, "sample 3 at 0.02 s has the value 1e\\+308, more than any device reports"),
        (1e6, 1.0, "no sample for 1e\\+06 s before sample 3 at 1e\\+06 s: split the recording there"),
        (1e300, 1.0, "sample 3 at 1e\\+300 s"),
    ],
)
@pytest.mark.parametrize("pieces", [1, 2])
def test_times_and_values_that_no_device_has_are_named(at: float, value: float, words: str, pieces: int) -> None:
    t, values, means = np.array([0.0, 0.01, at]), np.array([[1.0], [1.0], [value]]), Means()
    *before, last = np.array_split(np.arange(3), pieces)
    for rows in before:
        means.add(t[rows], values[rows])
    with pytest.raises(BadDataset, match=words):
        means.add(t[last], values[last])
