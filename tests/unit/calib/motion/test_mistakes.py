"""Mistakes that motion shows: each is named as what it is, with its size, and undone; right rows have none."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ftcalib import Finding
from ftcalib.errors import BadDataset
from ftcalib.model import Array, Parameters
from ftcalib.motion import samples
from ftcalib.motion.estimate import fit_freely
from ftcalib.motion.mistakes import (
    are_bias_steps,
    find_impossible_body,
    find_motion_mistakes,
    find_zeroings,
    fit_bias_steps,
)
from ftcalib.motion.model import HEIGHT, INERTIA, SIZE, MovingLoad, wrench_of
from ftcalib.motion.samples import Means, Motion, MotionRows, require_seconds
from ftcalib.motion.solve import solve_motion
from tests.moving_load import Recorded, Truth, means_of, programme, record
from tests.unit.calib.motion.test_estimate import SIGMA, G, rows_of
from tests.unit.calib.motion.test_motion import load_of

TRUTH = load_of(Truth())
RIGHT = rows_of(150, TRUTH, sigma=SIGMA / 5)
SPREAD_M = 0.6


def found(rows: MotionRows, spread_m: float = SPREAD_M) -> list[Finding]:
    return find_motion_mistakes(rows, fit_freely(rows, None, G), spread_m)[0]


def undone(rows: MotionRows) -> MotionRows:
    return find_motion_mistakes(rows, fit_freely(rows, None, G), SPREAD_M)[1](rows)


def codes(findings: list[Finding]) -> list[str]:
    return [one.code for one in findings]


def of_point(rows: MotionRows, p_flange_point_m: Array, turn_rad: Array) -> MotionRows:
    """The same with poses of another point of the flange, with other axes."""
    X = Rotation.from_rotvec(turn_rad).as_matrix()

    def seen(motion: Motion) -> Motion:
        acceleration = motion.acceleration_m_s2 + motion.Omega_rad2_s2 @ p_flange_point_m
        return Motion(motion.R_base_flange @ X, acceleration @ X, X.T @ motion.Omega_rad2_s2 @ X)

    return replace(rows, motion=seen(rows.motion), rate=seen(rows.rate))


def with_motion(rows: MotionRows, acceleration: float, turning: float) -> MotionRows:
    def seen(motion: Motion) -> Motion:
        return Motion(motion.R_base_flange, acceleration * motion.acceleration_m_s2, turning * motion.Omega_rad2_s2)

    return replace(rows, motion=seen(rows.motion), rate=seen(rows.rate))


def torques_about(rows: MotionRows, p_sensor_point_m: Array) -> MotionRows:
    wrench = rows.wrench.copy()
    wrench[:, 3:] -= np.cross(p_sensor_point_m, wrench[:, :3])
    return replace(rows, wrench=wrench)


def test_right_rows_have_no_mistake_and_stay_as_they_are() -> None:
    rows = rows_of(150, TRUTH)
    assert codes(found(rows)) == []
    assert undone(rows) is rows


@pytest.mark.slow
@pytest.mark.parametrize(
    ("offset_m", "turn_rad"),
    [
        ((0, 0, 0.1), (0, 0, 0)),
        ((0, 0, 0.2), (np.pi, 0, 0)),
        ((0.06, -0.04, 0.15), (0.5, -0.3, 0.1)),
    ],
)
def test_poses_of_a_tcp_are_named_with_the_place_of_the_sensor(
    offset_m: tuple[float, ...], turn_rad: tuple[float, ...]
) -> None:
    point_m, turn = np.array(offset_m), np.array(turn_rad)
    (one,) = found(of_point(RIGHT, point_m, turn))
    assert (one.code, one.severity) == ("poses_of_tcp", "reject")
    expected = Rotation.from_rotvec(turn).inv().apply([0, 0, TRUTH.height_m] - point_m)
    np.testing.assert_allclose(one.values["point_mm"], 1e3 * expected, atol=4)


@pytest.mark.slow
def test_a_sensor_a_little_beside_the_flange_axis_limits_and_is_fitted() -> None:
    rows = of_point(RIGHT, np.array([0.02, 0, 0]), np.zeros(3))
    assert [(one.code, one.severity) for one in found(rows)] == [("poses_of_tcp", "limit")]
    along_x, right = undone(rows).motion.Omega_rad2_s2[:, :, :2], RIGHT.motion.acceleration_m_s2
    aside_m = np.linalg.lstsq(along_x.reshape(-1, 2), (undone(rows).motion.acceleration_m_s2 - right).ravel())[0]
    np.testing.assert_allclose(aside_m, 0, atol=2e-3)
    assert codes(found(of_point(RIGHT, np.array([5e-3, 0, 0]), np.zeros(3)))) == []


def test_units_that_move_the_sensor_from_the_axis_are_named_too() -> None:
    truth = replace(TRUTH, static=replace(TRUTH.static, p_sensor_com_m=np.array([0.012, -0.008, 0.03])))
    rows = rows_of(150, truth, sigma=SIGMA / 5)
    (one,) = found(replace(rows, wrench=rows.wrench / np.repeat([4.4482216, 1.0], 3)))
    assert one.code == "poses_of_tcp"
    assert ["lbf", "N·m"] in one.values["units"]
    (one,) = found(of_point(RIGHT, np.array([0.03, 0, 0.15]), np.zeros(3)))
    assert one.values["units"] == []


def test_the_poses_of_a_tcp_upside_down_limit_where_the_height_shows_nothing() -> None:
    findings = found(of_point(RIGHT, np.array([0, 0, 0.1]), np.array([np.pi, 0, 0])))
    assert [(one.code, one.severity) for one in findings] == [("poses_of_tcp", "limit")]


@pytest.mark.parametrize("point_m", [(0, 0, 0.15), (0.05, -0.03, 0.2)])
def test_torques_about_a_tcp_are_not_taken_for_reversed_ones(point_m: tuple[float, ...]) -> None:
    (one,) = found(torques_about(RIGHT, np.array(point_m)))
    assert (one.code, one.severity) == ("torques_about_tcp", "reject")
    expected = [0, 0, TRUTH.height_m] + TRUTH.static.R_flange_sensor @ point_m
    np.testing.assert_allclose(one.values["point_mm"], 1e3 * expected, atol=7)  # a bias of 9 N has moved too


@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.9, 2.0])
def test_a_wrong_clock_is_named_with_its_factor(factor: float) -> None:
    rows = with_motion(RIGHT, factor**2, factor**2)
    *compensated, one = found(rows)
    # A controller that takes a part of the weight away is likelier than times that are too short.
    assert [cause.code for cause in compensated] == (["wrench_compensated"] if factor < 1 else [])
    assert one.code == "clock_rate"
    assert abs(one.values["factor"] - factor) < 5 * one.values["sigma"]
    assert one.values["rate"] == pytest.approx(1 / factor, rel=0.02)
    np.testing.assert_allclose(undone(rows).motion.Omega_rad2_s2, RIGHT.motion.Omega_rad2_s2, rtol=0.05, atol=1e-9)


def test_positions_in_another_unit_are_named() -> None:
    (one,) = found(with_motion(RIGHT, 1e3, 1.0), SPREAD_M * 1e3)
    assert (one.code, one.values["unit"]) == ("positions_unit", "mm")


@pytest.mark.slow
@pytest.mark.parametrize(("signs", "channels"), [((-1, -1), "forces and torques"), ((1, -1), "torques")])
def test_reversed_channels_are_named_and_turned_back(signs: tuple[int, int], channels: str) -> None:
    rows = replace(RIGHT, wrench=RIGHT.wrench * np.repeat(signs, 3))
    assert [(one.code, one.values["channels"]) for one in found(rows)] == [("reversed_in_motion", channels)]
    np.testing.assert_array_equal(undone(rows).wrench, RIGHT.wrench)


def test_an_arm_that_stands_shows_no_mistake() -> None:
    still = with_motion(RIGHT, 0.0, 0.0)
    rest = wrench_of(TRUTH, still.motion) + (RIGHT.wrench - wrench_of(TRUTH, RIGHT.motion))
    assert codes(found(replace(still, wrench=rest))) == []


def test_other_axes_of_forces_or_torques_are_named() -> None:
    (one,) = found(replace(RIGHT, wrench=RIGHT.wrench[:, [0, 1, 2, 4, 3, 5]]))
    assert one.code == "axes_disagree"


def test_rows_that_no_mistake_explains_have_none() -> None:
    other = rows_of(150, TRUTH, seed=1)
    assert codes(found(replace(RIGHT, wrench=other.wrench)[::2])) == []


@pytest.mark.parametrize(("step_s", "unit"), [(2.0, "ms"), (2e3, "µs"), (2e6, "ns"), (0.1, None)])
def test_times_that_are_no_seconds_are_refused(step_s: float, unit: str | None) -> None:
    t_s: Array = np.float64(step_s) * np.arange(10)
    if unit is None:
        require_seconds(t_s, "the times")
        return
    with pytest.raises(BadDataset, match=f"the times increase in steps of .* and look like {unit}"):
        require_seconds(t_s, "the times")


def test_times_in_ns_are_refused_before_their_gaps() -> None:
    with pytest.raises(BadDataset, match="look like ns"):
        Means().add(2e6 * np.arange(10.0), np.zeros((10, 6)))


# -- zeroing -----------------------------------------------------------------------------------------------------------


def zeroed(recorded: Recorded, at_s: list[float]) -> tuple[Recorded, Array]:
    """The same with the sensor zeroed at these times, and the change of its bias in all."""
    wrench = recorded.wrench.copy()
    for first in np.searchsorted(recorded.t_s, at_s):
        wrench[first:] -= wrench[first - 25 : first].mean(axis=0)
    return replace(recorded, wrench=wrench), wrench[-1] - recorded.wrench[-1]


def test_a_sensor_zeroed_within_the_recording_has_a_bias_for_each_part() -> None:
    joints, stops = programme(1, 20.0)
    truth = Truth()
    at_s = [stops[k][0] + 0.3 for k in (1, 3)]
    recorded, bias = zeroed(record(truth, joints, 20.0, 1), at_s)
    result = solve_motion(*means_of(recorded))
    (one,) = (one for one in result.findings if one.severity != "note")
    assert (one.code, result.verdict) == ("zeroed", "usable")
    np.testing.assert_allclose(np.array(one.values["at_s"]) + recorded.t_s[0], at_s, atol=0.1)
    now = {"force_bias_N": truth.bias[:3] + bias[:3], "torque_bias_Nm": truth.bias[3:] + bias[3:]}
    error = Parameters(**{**truth.to_dict(), **now}).difference(result.parameters) / np.sqrt(np.diag(result.covariance))
    assert np.abs(error).max() < 5


def test_a_contact_that_ends_in_the_pose_of_a_zeroing_is_none() -> None:
    truth = Truth(bias=np.zeros(6))
    joints, stops = programme(1, 20.0)
    start, end = stops[2]
    recorded = record(truth, joints, 20.0, 1, contacts={(start + 0.1, end - 0.2): np.array([0, 0, -25.0, 1.5, 0, 0])})
    wrench, poses = means_of(replace(recorded, wrench=recorded.wrench - _at(recorded, start)))
    at_s, seen = find_zeroings(wrench.result())
    assert np.abs(at_s - (end - 0.2)).min() < 0.1
    assert not are_bias_steps(fit_bias_steps(samples.motion_rows(wrench.result(), poses.result()), at_s), seen).any()


def _at(recorded: Recorded, t_s: float) -> Array:
    first = int(np.searchsorted(recorded.t_s, t_s))
    return np.asarray(recorded.wrench[first - 25 : first].mean(axis=0))


# -- impossible bodies -------------------------------------------------------------------------------------------------


def fit_with(load: MovingLoad, sigma_kg_m2: float = 1e-5, sigma_m: float = 1e-3) -> Any:
    covariance = np.zeros((SIZE, SIZE))
    covariance[INERTIA, INERTIA] = sigma_kg_m2**2 * np.eye(6)
    covariance[HEIGHT, HEIGHT] = sigma_m**2
    return SimpleNamespace(load=load, covariance=covariance)


def test_a_body_that_cannot_exist_is_named() -> None:
    principal = 1e-3 * np.array([1.0, 2.0, 5.0])
    turned = Rotation.from_rotvec([0.3, 0.5, -0.2]).as_matrix()
    J = turned @ np.diag(principal) @ turned.T
    inertia = J[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    (one,) = find_impossible_body(fit_with(replace(TRUTH, inertia=inertia)))
    assert one.code == "inertia_impossible"
    np.testing.assert_allclose(one.values["principal_gm2"], 1e3 * principal)
    assert find_impossible_body(fit_with(replace(TRUTH, inertia=inertia), sigma_kg_m2=1e-3)) == []
    assert find_impossible_body(fit_with(TRUTH)) == []
    assert find_impossible_body(fit_with(replace(TRUTH, inertia=np.zeros(6)))) == []  # a point mass


@pytest.mark.parametrize(
    ("height_m", "sigma_m", "named"), [(-0.01, 1e-3, True), (-0.01, 2e-3, False), (0.6, 0.01, True), (0.3, 1e-3, False)]
)
def test_a_height_that_no_sensor_has_is_named(height_m: float, sigma_m: float, named: bool) -> None:
    findings = find_impossible_body(fit_with(replace(TRUTH, height_m=height_m), sigma_m=sigma_m))
    assert [one.code for one in findings] == ["height_impossible"] * named
