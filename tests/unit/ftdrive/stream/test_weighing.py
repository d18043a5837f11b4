"""Weighing a stream: rest, refusals, tare as the zero, poses, parts."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import ftdrive
from ftcalib import CalibrationResult
from ftcalib.model import Array
from ftcalib.sensor_matrix import SensorMatrix
from ftdrive.errors import ConfigError
from ftdrive.stream.samples import Paired
from ftdrive.stream.stream import Stream
from ftdrive.stream.weighing import WORDS, CannotWeigh, Scale, count_of, load_values, weigh_in_motion
from tests.fake_clock import FakeClock
from tests.unit.ftdrive.stream.simulated import P_FLANGE_SENSOR_M, TRUTH, G, calibrated, info, paired, replayed

POSE = Rotation.from_euler("xz", [170, 25], degrees=True).as_matrix()
COM_M = np.array([0.01, 0.02, 0.15])
NOTHING = np.zeros(6)


def part(R: Array, mass_kg: float) -> Array:
    down = TRUTH.gravity_force_base_N / np.linalg.norm(TRUTH.gravity_force_base_N)
    force_N = mass_kg * G * down @ (R @ TRUTH.R_flange_sensor)
    return np.concatenate([force_N, np.cross(COM_M, force_N)], axis=-1)


def inertia(R: Array, mass_kg: float, p_sensor_m: Array) -> Array:
    """Wrench (n, 6) of a point mass that turns with the flange, whose origin rests."""
    at_m = R @ (P_FLANGE_SENSOR_M + TRUTH.R_flange_sensor @ p_sensor_m)
    acceleration = np.gradient(np.gradient(at_m, 1e-3, axis=0), 1e-3, axis=0)
    force_N = -mass_kg * np.einsum("nij,ni->nj", R @ TRUTH.R_flange_sensor, acceleration)
    return np.hstack([force_N, np.cross(p_sensor_m, force_N)])


def rests(*each: tuple[Array, Array], seconds: float = 1.0) -> Paired:
    """Rest in each pose with a wrench on the tool."""
    n = round(1000 * seconds)
    R = np.concatenate([np.tile(R, (n, 1, 1)) for R, _ in each])
    return paired(R, push=np.concatenate([np.tile(wrench, (n, 1)) for _, wrench in each]))


def stream(rows: Paired) -> Stream:
    return replayed(info(calibrated()), rows, clock=FakeClock())


def read(source: Stream, seconds: float) -> None:
    source.clock.sleep(seconds)
    source.read(0.0)


def test_a_tare_is_the_zero() -> None:
    drift = np.array([0.2, -0.1, 0.3, 0.002, 0.001, 0])
    source = stream(rests((POSE, drift), (POSE, drift + part(POSE, 0.8))))
    read(source, 0.98)
    Scale(source).zero()
    read(source, 1.0)
    weight = Scale(source).weigh()
    assert weight.mass_kg == pytest.approx(0.8, abs=4 * weight.mass_sigma_kg)
    assert weight.mass_sigma_kg < 2e-3
    values = load_values(weight, source.info)
    p_flange_m = P_FLANGE_SENSOR_M + TRUTH.R_flange_sensor @ weight.p_sensor_com_m
    np.testing.assert_allclose(values["p_flange_com_m"], p_flange_m, atol=1e-4)
    C = TRUTH.R_flange_sensor @ weight.com_covariance @ TRUTH.R_flange_sensor.T
    np.testing.assert_allclose(values["p_flange_com_sigma_m"], np.sqrt(np.diag(C)), rtol=0.01)
    without = load_values(weight, info(calibrated(), height=False))
    assert (without["p_flange_com_m"], without["p_flange_com_sigma_m"]) == (None, None)
    assert without["p_sensor_com_m"] == values["p_sensor_com_m"]


def test_the_library_waits_for_rest_and_joins_poses() -> None:
    poses = [POSE, Rotation.from_euler("x", 90, degrees=True).as_matrix(), np.eye(3)]
    source = stream(rests(*((R, part(R, 1.5)) for R in poses), seconds=0.6))
    weight = ftdrive.weigh(source, poses=3)
    assert (weight.poses, weight.line) == (3, None)
    np.testing.assert_allclose(weight.p_sensor_com_m, COM_M, atol=4 * weight.com_sigma_m.max())


def test_what_moves_is_refused() -> None:
    turning = Rotation.from_rotvec(np.outer(np.arange(600) * 1e-3, [0.0, 0.0, 0.1])) * Rotation.from_matrix(POSE)
    t_s = np.arange(3000) * 1e-3
    trembling = np.where(t_s < 2, 0.0, 0.4 * np.sin(2 * np.pi * 9 * t_s))
    cases = (
        ("moving", 1.0, paired(turning.as_matrix())),
        ("unsteady", 1.0, rests((POSE, NOTHING), (POSE, part(POSE, 1.0)), seconds=0.7)),
        ("unsteady", 3.0, paired(np.tile(POSE, (3000, 1, 1)), push=np.outer(trembling, [0, 0, 1, 0, 0, 0]))),
        ("samples", 1.0, rests((POSE, NOTHING), seconds=0.3)),
        ("contact", 1.0, rests((POSE, np.array([2.0, 8.0, 0, 0, 0, 0])))),
    )
    for code, seconds, rows in cases:
        source = stream(rows)
        read(source, seconds)
        with pytest.raises(CannotWeigh) as refusal:
            Scale(source).weigh()
        assert refusal.value.code == code
        assert str(refusal.value) == f"not weighed: {WORDS[code]}"


def test_a_zero_needs_an_empty_gripper_at_rest() -> None:
    for code, wrench in (("unsteady", part(POSE, 0.1)), ("not-empty", part(POSE, 1.0))):
        source = stream(rests((POSE, NOTHING), (POSE, wrench)))
        read(source, 1.02 if code == "unsteady" else 2.0)
        with pytest.raises(CannotWeigh) as refusal:
            Scale(source).zero()
        assert refusal.value.code == code
        assert source.processor.monitor.reference()[1] == float("inf")


def as_read(wrench: Array, calibration: CalibrationResult) -> Array:
    """Return what the sensor reads of contacts (n, 6)."""
    return wrench @ np.linalg.inv(calibration.contact.decode(np.eye(6)))


def carried(
    mass_kg: float, *, push: Array = NOTHING, empty_s: float = 6.0, sensor: SensorMatrix | None = None
) -> Stream:
    """An arm that turns without rest; after `empty_s` it has a part, and from 4 s later on a push.

    The errors of the sensor are those that known loads have shown.
    """
    t_s = np.arange(0, empty_s + 8.0, 1e-3)
    R = (Rotation.from_rotvec(np.outer(t_s, [0.3, 0.2, 0.1])) * Rotation.from_matrix(POSE)).as_matrix()
    calibration = replace(calibrated(), sensor=sensor)
    weight = as_read(part(R, mass_kg) + inertia(R, mass_kg, COM_M), calibration)
    tool_kg = float(np.linalg.norm(TRUTH.gravity_force_base_N)) / G
    wrench = inertia(R, tool_kg, TRUTH.p_sensor_com_m) + weight * (t_s > empty_s)[:, None]
    wrench[t_s > empty_s + 4] += push
    source = replayed(info(calibration), paired(R, push=wrench), clock=FakeClock())
    source.track = "show"
    return source


@pytest.mark.slow
def test_a_part_is_weighed_while_the_arm_carries_it() -> None:
    source = carried(0.8)
    read(source, 5.0)
    empty = ftdrive.weigh(source, moving=True)
    assert not empty.is_something
    read(source, 4.0)
    weight = ftdrive.weigh(source, moving=True)
    assert weight.is_something
    assert weight.mass_kg == pytest.approx(0.8, abs=4 * weight.mass_sigma_kg)
    np.testing.assert_allclose(weight.p_sensor_com_m, COM_M, atol=4 * weight.com_sigma_m.max())
    values = load_values(weight, source.info)
    assert (values["in_motion"], values["poses"], values["line_sensor"]) == (True, 0, None)
    assert values.keys() == load_values(empty, source.info).keys()


@pytest.mark.slow
def test_a_part_that_a_sensor_known_by_loads_carries_is_weighed_without_its_error() -> None:
    usual = SensorMatrix.usual(0.03)
    error = usual.sigma * np.random.default_rng(3).normal(size=(6, 6)) + 0.03 * np.eye(6)
    sensor = replace(usual, error=error, covariance=1e-3 * usual.covariance, source="loads", floor=0.0)
    source = carried(2.0, sensor=sensor)
    read(source, 9.5)
    weight = ftdrive.weigh(source, moving=True)
    sigma_kg = np.hypot(weight.mass_sigma_kg, weight.scale_sigma * weight.mass_kg)
    assert abs(weight.mass_kg - 2.0) < 4 * sigma_kg < 0.02
    np.testing.assert_allclose(weight.p_sensor_com_m, COM_M, atol=4 * weight.com_sigma_m.max())
    # What is subtracted of the reading is as the sensor reads it.
    units = np.concatenate([np.eye(3), np.cross(COM_M, np.eye(3))], axis=1)
    gain = np.trace(as_read(units, source.info.calibration)[:, :3]) / 3
    assert weight.moment[0][0] == pytest.approx(gain * 2.0, rel=0.002)
    assert abs(gain - 1) > 0.01


@pytest.mark.slow
def test_a_push_in_motion_is_refused_until_it_is_over() -> None:
    source = carried(0.8, push=np.array([3.0, 4.0, 0, 0, 0, 0.2]))
    read(source, 10.6)
    for _ in range(3):
        with pytest.raises(CannotWeigh) as refusal:
            weigh_in_motion(source)
        assert refusal.value.code == "undecided"
        read(source, 0.4)


def test_parts_are_counted_or_not() -> None:
    source = stream(rests((POSE, NOTHING), (POSE, part(POSE, 1.0))))
    read(source, 0.98)
    Scale(source).zero()
    read(source, 1.0)
    weight = Scale(source).weigh()
    assert count_of(weight, 0.5) == 2
    assert count_of(weight, 1.0) == 1
    with pytest.raises(CannotWeigh) as refusal:
        count_of(weight, 0.4)
    assert refusal.value.code == "count"
    with pytest.raises(CannotWeigh):
        count_of(weight, 0.001)  # sigma is larger than such a part


def test_weighing_in_motion_needs_a_stream_that_follows() -> None:
    source = carried(0.0)
    with pytest.raises(CannotWeigh, match="too few samples"):
        weigh_in_motion(source)
    source.track = "off"
    with pytest.raises(ConfigError, match="track"):
        weigh_in_motion(source)
