"""Weighing: sigmas that hold, faults that are named, and a tool with a part as one load."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ftcalib import solve
from ftcalib.after.state import tare
from ftcalib.after.weighing import Weight, drift_since, holding, true_tool, weigh_load
from ftcalib.data.dwell_mean import mean_and_covariance
from ftcalib.errors import BadDataset
from ftcalib.model import Array, Parameters, predict
from ftcalib.sensor_matrix import Calibrated, Response, SensorMatrix, ranges, sensor_error_columns
from tests.first_order import assert_same, propagated
from tests.loaded_sensor import LEVER_M, TIP_M, TOOL, TOOL_COM_M, TOOL_KG, LoadedSensor
from tests.loaded_sensor import NOISE as LOAD_NOISE
from tests.unit.ftdrive.stream.simulated import NOISE, TRUTH, G, calibrated

NEAR = 2 * TRUTH.p_sensor_com_m
NEVER = float("inf")


class Gripper:
    """A tool that holds a part; readings of half a second."""

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        self.mass_kg, self.com_m = float(self.rng.uniform(0.2, 3)), NEAR + self.rng.uniform(-0.04, 0.04, 3)
        self.extra = np.zeros(6)

    def turn(self) -> Array:
        return np.asarray(Rotation.random(rng=self.rng).as_matrix())

    def part(self, R_base_flange: Array) -> Array:
        down = TRUTH.gravity_force_base_N / np.linalg.norm(TRUTH.gravity_force_base_N)
        force_N = self.mass_kg * G * down @ (R_base_flange @ TRUTH.R_flange_sensor)
        return np.concatenate([force_N, np.cross(self.com_m, force_N)])

    def dwell(self, R_base_flange: Array, *, empty: bool = False, n: int = 250) -> Array:
        wrench = predict(TRUTH, R_base_flange) + self.extra + (0 if empty else self.part(R_base_flange))
        return np.asarray(wrench + NOISE * self.rng.normal(size=(n, 6)))

    def weigh(self, reference: Calibrated, *R: Array, since_s: float = 1.0, **options: Any) -> Weight:
        means = [mean_and_covariance(self.dwell(one)) for one in R]
        return weigh_load(
            reference,
            np.array(R),
            np.array([one.mean for one in means]),
            np.array([one.covariance for one in means]),
            **{"drift": drift_since(since_s), "g_m_s2": G, "p_sensor_near_m": NEAR, **options},
        )


@pytest.mark.slow
def test_sigmas_hold_after_a_zero_in_the_same_pose() -> None:
    errors, com = [], []
    for seed in range(100):
        gripper = Gripper(seed)
        R = gripper.turn()
        gripper.extra = gripper.rng.normal(size=6) * np.repeat([0.3, 0.01], 3)  # drift before the zero
        weight = gripper.weigh(tare(calibrated(12, seed % 20), R[None], [gripper.dwell(R, empty=True)]), R)
        assert weight.fault is None
        assert weight.mass_sigma_kg < 1e-3
        errors.append((weight.mass_kg - gripper.mass_kg) / weight.mass_sigma_kg)
        off_m = weight.p_sensor_com_m - gripper.com_m
        com.append(off_m @ np.linalg.solve(weight.com_covariance, off_m) / 3)
        assert weight.line is not None
        force_N = gripper.part(R)[:3]
        assert abs(weight.line @ force_N) == pytest.approx(np.linalg.norm(force_N), rel=1e-2)
    assert 0.75 < np.sqrt(np.mean(np.square(errors))) < 1.15  # the sensor may err, and does not
    assert np.abs(errors).max() < 4
    assert np.mean(com) < 1.2  # along gravity it is assumed, and mostly nearer


def test_what_is_no_weight_is_named() -> None:
    gripper = Gripper(1)
    R = np.array(Rotation.from_euler("x", 180, degrees=True).as_matrix())
    u = gripper.part(R)[:3] / np.linalg.norm(gripper.part(R)[:3])
    aside = np.cross(u, [0.3, 1.0, 0.2])

    def fault(wrench: Array) -> str | None:
        gripper.extra = np.zeros(6)
        reference = tare(calibrated(), R[None], [gripper.dwell(R, empty=True)])
        gripper.extra = np.asarray(wrench)
        return gripper.weigh(reference, R).fault

    assert fault(np.zeros(6)) is None
    assert fault(np.concatenate([0.5 * aside / np.linalg.norm(aside), np.zeros(3)])) == "contact"
    assert fault(np.concatenate([np.zeros(3), 0.1 * u])) == "cable"
    assert fault(np.concatenate([-40 * u, np.zeros(3)])) == "lifted"
    gripper.mass_kg = 0.02
    assert fault(np.concatenate([np.zeros(3), 0.3 * aside])) == "cable"  # a centre of mass far outside


def test_poses_that_disagree_are_named() -> None:
    gripper = Gripper(2)
    poses = [gripper.turn() for _ in range(3)]
    means = []
    for R in poses:
        means.append(mean_and_covariance(gripper.dwell(R)))
        gripper.com_m = gripper.com_m + np.array([0.01, 0, 0])  # it slips
    weight = weigh_load(
        calibrated(),
        np.array(poses),
        np.array([one.mean for one in means]),
        np.array([one.covariance for one in means]),
        drift=drift_since(1.0),
        g_m_s2=G,
        p_sensor_near_m=NEAR,
    )
    assert weight.fault == "changed"


def rough(seed: int = 1) -> tuple[Parameters, Array, Response]:
    """Parameters with large and correlated errors, their covariance, and gain and cross-talk."""
    rng = np.random.default_rng(seed)
    sigma = np.concatenate([np.repeat([0.01, 0.05, 0.04, 5e-4, 3e-3], 3), np.full(11, 5e-3)])
    root = sigma[:, None] * (np.eye(26) + 0.3 * rng.normal(size=(26, 26)))
    C = root @ root.T
    return TRUTH, C, Response(0.01 * rng.normal(size=11), C)


def moved(known: Calibrated, error: Array) -> Calibrated:
    C = known.joint_covariance
    response = None if known.response is None else Response(known.response.coefficients + error[15:], C)
    return Calibrated(known.parameters.moved(error[:15]), C[:15, :15], response)


@pytest.mark.slow
def test_the_covariance_has_all_errors_of_readings_and_calibration() -> None:
    gripper, (tool, C, response) = Gripper(5), rough()
    reference = Calibrated(tool, C[:15, :15], response)
    R = np.array([gripper.turn() for _ in range(3)])
    part = np.array([gripper.part(one) for one in R])
    y = predict(tool, R) + part
    y += response.wrench(tool, R)
    y[:, :3] += part[:, :3] @ response.force_gain.T
    y[:, 3:] += part[:, :3] @ response.cross_talk_m.T
    noise, drift, turn_rad = (
        np.tile(np.diag((0.3 * NOISE) ** 2), (3, 1, 1)),
        3 * NOISE[::-1] * [1, 1, 1, 0.02, 0.02, 0.02],
        4e-3,
    )

    def weighed(y: Array, reference: Calibrated = reference, R: Array = R) -> Weight:
        options: dict[str, Any] = {"drift": drift, "g_m_s2": G, "orientation_sigma_rad": turn_rad}
        return weigh_load(reference, R, y, noise, p_sensor_near_m=gripper.com_m, **options)

    def turned(e: Array) -> Array:
        return np.asarray(R @ Rotation.from_rotvec(e.reshape(3, 3)).as_matrix())

    found = weighed(y)
    x, covariance = found.moment
    np.testing.assert_allclose(x, gripper.mass_kg * np.append(1.0, gripper.com_m), rtol=1e-9)
    expected = (
        propagated(lambda e: weighed(y + e.reshape(3, 6)).moment[0], np.kron(np.eye(3), noise[0]))
        + propagated(lambda e: weighed(y + e).moment[0], np.diag(drift**2))
        + propagated(lambda e: weighed(y, moved(reference, e)).moment[0], C)
        + propagated(lambda e: weighed(y, reference, turned(e)).moment[0], turn_rad**2 * np.eye(9))
    )
    held = Parameters(TRUTH.R_flange_sensor, x[0] * G * tool.down, np.zeros(3), x[1:] / x[0], np.zeros(3))
    columns = sensor_error_columns(tool, response, held, R).reshape(18, -1)
    expected += propagated(lambda e: weighed(y + e.reshape(3, 6)).moment[0], columns @ columns.T)
    assert_same(covariance, expected, 0.02)
    assert found.mass_sigma_kg == pytest.approx(np.sqrt(covariance[0, 0]))
    assert found.least_kg == pytest.approx(4 * found.mass_sigma_kg)
    com = propagated(lambda e: (x + e)[1:] / (x + e)[0], covariance)
    assert_same(found.com_covariance, com)
    assert found.chi2 < 1e-6
    assert (found.dof, found.poses) == (17, 3)


def test_a_tool_with_a_part_predicts_both() -> None:
    z2 = []
    for seed in range(40):
        gripper = Gripper(seed)
        empty = calibrated(12, seed % 5)
        weight = gripper.weigh(empty, *(gripper.turn() for _ in range(4)))
        load = holding(empty, weight, G)
        R = gripper.turn()
        off = predict(load.parameters, R) - predict(TRUTH, R) - gripper.part(R)
        C = load.wrench_covariance(R)
        z2.append(off @ np.linalg.solve(C, off) / 6)
    assert 0.4 < np.mean(z2) < 1.3


def test_a_tool_without_weight_has_no_direction_of_gravity() -> None:
    nothing = Parameters(np.eye(3), np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3))
    reference = holding(calibrated(), Weight(0, 0, 0, np.zeros(3), np.eye(3), None, None, 0, 0, 1), G)
    with pytest.raises(BadDataset, match="no weight"):
        Gripper(0).weigh(replace(reference, parameters=nothing), np.eye(3))


def test_drift_grows_and_ends() -> None:
    assert drift_since(36.0).tolist() == pytest.approx([0.05] * 3 + [1.5e-3] * 3)
    assert not drift_since(-5.0).any()
    assert drift_since(NEVER).tolist() == [1.0] * 3 + [0.03] * 3


def test_a_sensor_known_by_loads_weighs_without_its_error() -> None:
    sensor = LoadedSensor(3, gain=0.05)
    tool = solve(sensor.runs([TOOL])[0].dataset)
    scale = np.where(np.eye(6) > 0, 1.0, 0.5) * ranges(LEVER_M)[:, None] / ranges(LEVER_M)
    covariance = np.diag(np.concatenate([np.full(3, 1e-12), (0.001 * scale.ravel()) ** 2]))
    result = replace(tool, sensor=SensorMatrix(sensor.E, covariance, "loads", LEVER_M, 0.0))
    R = Rotation.random(4, rng=np.random.default_rng(1)).as_matrix()
    u, p = sensor.gravity @ R, TIP_M
    moment = 2.0 * p + TOOL_KG * TOOL_COM_M
    held = sensor.read(np.concatenate([(2.0 + TOOL_KG) * u, np.cross(moment, u)], axis=1)) + tool.parameters.bias
    noise = np.tile(np.diag((0.1 * LOAD_NOISE) ** 2), (4, 1, 1))
    known = {"drift": drift_since(0.0), "g_m_s2": tool.g_m_s2, "p_sensor_near_m": tool.R_flange_sensor.T @ p}
    as_read = weigh_load(result, R, held, noise, **known)
    decoded = weigh_load(result, R, held, noise, **known, contact=result.known_contact)
    sigma_kg = np.hypot(decoded.mass_sigma_kg, decoded.scale_sigma * decoded.mass_kg)
    assert abs(decoded.mass_kg - 2.0) < 3 * sigma_kg < 0.01 * 2.0 < abs(as_read.mass_kg - 2.0)
    # A force at the tip has the errors of the lever too: more than the gain alone.
    assert 0.0003 < decoded.scale_sigma < 0.005
    off_m = decoded.p_sensor_com_m - tool.R_flange_sensor.T @ p
    assert off_m @ np.linalg.solve(decoded.com_covariance, off_m) < 16
    # What the tool and the part read together is as before: the sensor still has its error.
    np.testing.assert_array_equal(decoded.moment[0], as_read.moment[0])
    mass_kg, com_m = true_tool(result)
    assert mass_kg == pytest.approx(TOOL_KG, rel=0.005)
    assert abs(tool.mass_kg / TOOL_KG - 1) > 0.005
    np.testing.assert_allclose(tool.R_flange_sensor @ com_m, TOOL_COM_M, atol=0.001)
    assert true_tool(tool)[0] == tool.mass_kg
