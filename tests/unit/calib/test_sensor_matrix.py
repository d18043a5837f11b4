import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ftcalib import BadCalibration, CalibrationDataset, CalibrationResult, Setup, solve
from ftcalib.model import Array, Parameters, predict, skew
from ftcalib.sensor_matrix import SIZE, Response, SensorMatrix
from tests.loaded_sensor import LEVER_M, TOOL, LoadedSensor


def parameters(R: Array | None = None) -> Parameters:
    R = Rotation.from_rotvec([0.3, -0.2, 1.0]).as_matrix() if R is None else R
    return Parameters(R, *map(np.array, ([0.1, 0, -12.0], [1.0, 2, 3], [0.01, -0.02, 0.06], [0.1, 0.2, 0.3])))


def errors(rng: np.random.Generator, size: float = 0.01) -> Array:
    F = np.repeat([1.0, LEVER_M], 3)
    return np.asarray(size * rng.normal(size=(6, 6)) * F[:, None] / F)


def calibration_of(E: Array, p: Parameters) -> tuple[Parameters, Response]:
    """Calibrate a tool by readings without noise of a sensor with these errors."""
    R = Rotation.random(24, rng=3).as_matrix()
    sigma = np.repeat([3e-3, 1e-4], 3)
    wrench = predict(p, R) + (predict(p, R) - p.bias) @ E.T + sigma * np.random.default_rng(0).normal(size=(24, 6))
    dataset = CalibrationDataset.of(R, wrench, wrench_cov=np.diag(sigma**2))
    result = solve(dataset)
    assert result.response is not None
    return result.parameters, result.response


def test_decoding_by_known_errors_is_exact_to_first_order() -> None:
    rng, p = np.random.default_rng(0), parameters()
    E = errors(rng, 0.001)
    found, seen = calibration_of(E, p)
    exact = SensorMatrix(E, 1e-12 * np.eye(39), "loads", LEVER_M)
    contact = exact.contact_response(found, seen)
    true_flange = rng.normal(size=(20, 6)) * np.repeat([60.0, 6.0], 3)

    def in_sensor(R: Array) -> Array:
        return np.concatenate([half @ R for half in np.split(true_flange, 2, axis=1)], axis=1)

    read = in_sensor(p.R_flange_sensor) @ (np.eye(6) + E).T
    left = contact.decode(read) - in_sensor(found.R_flange_sensor)
    before = read - in_sensor(found.R_flange_sensor)
    assert np.abs(left).max() < 0.05 * np.abs(before).max()
    weight_N, com_m = contact.true_load(seen)
    assert weight_N == pytest.approx(p.weight_N, rel=1e-4)
    np.testing.assert_allclose(com_m, p.p_sensor_com_m, atol=2e-4)


def test_sigma_follows_the_prior_and_the_contact() -> None:
    contact = SensorMatrix.usual(0.02).contact_response(parameters())
    along_x = contact.covariance(np.array([100.0, 0, 0, 0, 0, 0]))
    assert np.sqrt(along_x[0, 0]) == pytest.approx(np.hypot(2.0, 0.25), rel=1e-6)
    np.testing.assert_allclose(contact.covariance(np.full(6, 2.0)), 4 * contact.covariance(np.ones(6)))
    assert not contact.covariance(np.zeros(6)).any()
    assert contact.decoder is None


def test_differences_between_the_axes_show_nothing_of_what_is_common_to_them() -> None:
    found = parameters()
    sure = Response(np.zeros(SIZE), 1e-16 * np.eye(15 + SIZE))
    learnt = SensorMatrix.usual(0.02).contact_response(found, sure)
    assert learnt.scale_sigma == pytest.approx(0.02 * np.sqrt(0.5), rel=0.2)
    C = learnt.hidden_covariance
    weight = found.gravity_force_base_N / found.weight_N
    assert np.sqrt(weight @ C[3:6, 3:6] @ weight) == pytest.approx(learnt.scale_sigma * found.weight_N)
    # The antisymmetric part shows in no orientation either; its size follows the numbers that show.
    assert (np.sqrt(np.diag(C)[:3]) > 0.002).all()


def test_a_rotation_of_the_sensor_turns_the_contact() -> None:
    exact = SensorMatrix(np.zeros((6, 6)), np.zeros((39, 39)), "loads", floor=0.0)
    turned = exact.contact_response(parameters(), None, 1e-6 * np.eye(3)).covariance(np.array([0, 0, 100.0, 0, 0, 0]))
    np.testing.assert_allclose(np.sqrt(np.diag(turned)), [0.1, 0.1, 0, 0, 0, 0], atol=1e-9)


def test_a_calibration_of_the_loads_has_the_rotation_of_their_fit() -> None:
    # An error E = [r]x of force and torque, in a sensor that is turned by r, cancels in its readings.
    cancelling = np.concatenate([parameters().R_flange_sensor, np.kron(np.eye(2), skew(np.eye(3))).reshape(3, 36).T])
    alone = cancelling * np.repeat([1.0, 0.0], [3, 36])[:, None]
    contact = np.array([0, 0, 100.0, 1, 2, 3])
    for columns, sigma in ((cancelling, [0, 0, 0]), (alone, [0.1, 0.1, 0])):
        sensor = SensorMatrix(np.zeros((6, 6)), 1e-6 * columns @ columns.T, "loads", floor=0.0)
        of_loads = sensor.contact_response(parameters()).covariance(contact)
        np.testing.assert_allclose(np.sqrt(np.maximum(np.diag(of_loads)[:3], 0)), sigma, atol=1e-8)
        # Another run has a rotation of its own.
        other = sensor.contact_response(parameters(), None, 4e-6 * np.eye(3)).covariance(contact)
        np.testing.assert_allclose(np.sqrt(np.diag(other)[:3]), [0.2, 0.2, 0], atol=1e-8)


@pytest.mark.slow
def test_a_result_knows_whether_its_poses_are_of_the_loads() -> None:
    result = solved()
    own = {"datasets": ["0", result.provenance["dataset_sha256"]]}
    exact = SensorMatrix(np.zeros((6, 6)), np.zeros((39, 39)), "loads", floor=0.0)
    of_loads, other = (replace(result, sensor=one).contact for one in (replace(exact, provenance=own), exact))
    assert not of_loads.error_covariance.any()
    assert (np.diag(other.error_covariance)[:3] > 0).all()


def test_a_weighed_tool_shows_the_gain_common_to_all_axes() -> None:
    found, seen = parameters(), Response(np.zeros(SIZE), 1e-8 * np.eye(15 + SIZE))
    excess = 0.03, 0.002
    usual = SensorMatrix.usual(lever_m=LEVER_M)
    plain, weighed = (usual.contact_response(found, seen, None, one) for one in (None, excess))
    force = np.array([30.0, -20, 40])
    true = np.concatenate([force, np.cross(found.p_sensor_com_m, force)])
    error, error_before = (np.linalg.norm((one.decode(1.03 * true) - true)[:3]) for one in (weighed, plain))
    assert error < 0.1 * error_before
    along = force / np.linalg.norm(force)
    sigma = [float(np.sqrt(along @ one.covariance(true)[:3, :3] @ along)) for one in (plain, weighed)]
    assert sigma[1] < 0.7 * sigma[0]


@cache
def solved() -> CalibrationResult:
    (tool,) = LoadedSensor(1).runs([TOOL])
    described = Setup(
        sensor_accuracy_percent=3.0, sensor_range=(130.0, 10.0), tool_mass_kg=1.3, tool_mass_sigma_kg=3e-3
    )
    return solve(tool.dataset, setup=described)


def test_a_result_keeps_what_is_known_of_its_sensor(tmp_path: Path) -> None:
    result = solved()
    assert result.sensor is not None
    assert result.sensor.source == "data sheet"
    assert result.sensor.lever_m == pytest.approx(10 / 130)
    result.save(tmp_path / "a.json")
    again = CalibrationResult.load(tmp_path / "a.json")
    assert again.weighed_kg == (1.3, 3e-3)
    assert (
        again.contact_sigma(np.eye(6)[2], np.eye(3))
        < replace(again, weighed_kg=None).contact_sigma(np.eye(6)[2], np.eye(3))
    ).any()
    contact = np.array([10.0, 20, 30, 1, 2, 3])
    R = Rotation.random(rng=2).as_matrix()
    np.testing.assert_array_equal(again.contact_sigma(contact, R), result.contact_sigma(contact, R))
    many = result.contact_sigma(np.tile(contact, (2, 1)), np.tile(R, (2, 1, 1)))
    np.testing.assert_allclose(many[1], result.contact_sigma(contact, R))
    assert (result.contact_sigma(np.zeros(6), R) < 0.2 * result.contact_sigma(contact, R)).all()


def test_compensating_one_sample_or_many_decodes_alike() -> None:
    result = solved()
    assert result.response is not None
    wrench, R = np.random.default_rng(5).normal(size=(9, 6)), Rotation.random(9, rng=6).as_matrix()
    many = result.compensate(wrench, R)
    np.testing.assert_allclose([result.compensate(*one) for one in zip(wrench, R, strict=True)], many, atol=1e-12)
    assert result.compensator.decoder is not None


def test_a_file_is_read_back_and_damage_is_named(tmp_path: Path) -> None:
    sensor = SensorMatrix.usual(0.01)
    sensor.save(tmp_path / "sensor.json")
    np.testing.assert_array_equal(SensorMatrix.load(tmp_path / "sensor.json").covariance, sensor.covariance)
    text = (tmp_path / "sensor.json").read_text()
    (tmp_path / "broken.json").write_text(re.sub('"floor": [^,]*', '"floor": 0.5', text))
    with pytest.raises(BadCalibration, match="checksum"):
        SensorMatrix.load(tmp_path / "broken.json")
    (tmp_path / "other.json").write_text('{"format": "ftdrive.calibration/1"}')
    with pytest.raises(BadCalibration, match=r"ftdrive\.sensor/1"):
        SensorMatrix.load(tmp_path / "other.json")
