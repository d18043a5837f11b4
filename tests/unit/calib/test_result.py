"""Results: derived quantities, their uncertainty, compensation, files."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ftcalib import BadCalibration, CalibrationDataset, CalibrationResult, Parameters, solve
from ftcalib.model import predict

RNG = np.random.default_rng(1)
R = Rotation.random(10, rng=RNG).as_matrix()
TRUTH = Parameters(
    Rotation.from_euler("xyz", [0.1, 3.0, 1.0]).as_matrix(),
    np.array([0.6, -0.4, -20.0]),
    np.array([3.0, -5.0, 8.0]),
    np.array([0.01, -0.02, 0.07]),
    np.array([0.1, 0.2, -0.3]),
)
COV = np.tile(np.diag([0.05, 0.05, 0.05, 0.001, 0.001, 0.001]) ** 2, (10, 1, 1))
DATA = CalibrationDataset(
    R,
    predict(TRUTH, R) + RNG.normal(size=(10, 6)) * np.sqrt(np.diag(COV[0])),
    COV,
    np.full(10, 1000),
    np.arange(10.0),
)
RESULT = solve(DATA, g_m_s2=9.81, provenance={"serial": "FT1", "argv": ["calibrate"]})


def test_every_promised_key_is_in_the_file_with_its_value() -> None:
    document: dict[str, Any] = json.loads(json.dumps(RESULT.to_dict(), allow_nan=False))
    assert document["format"] == "ftdrive.calibration/1"
    assert document["schema_version"] == 1
    assert document["method"] == "ml"
    assert document["n_poses"] == 10
    assert document["dof"] == 45
    assert document["noise_source"] == "measured"
    assert document["g_m_s2"] == 9.81
    assert document["weight_N"] == np.linalg.norm(RESULT.gravity_force_base_N)
    assert document["mass_kg"] == document["weight_N"] / 9.81
    quantities = {
        "mass_kg", "weight_N", "gravity_force_base_N", "R_flange_sensor", "force_bias_N", "torque_bias_Nm",
        "p_sensor_com_m", "tilt_alpha_rad", "tilt_beta_rad",
    }  # fmt: skip
    assert set(document["sigma"]) == quantities
    assert quantities < set(document)
    assert np.shape(document["sigma"]["R_flange_sensor"]) == (3,)
    force = np.linalg.norm(RESULT.residuals[:, :3], axis=1)
    torque = np.linalg.norm(RESULT.residuals[:, 3:], axis=1)
    assert document["residual"] == pytest.approx(
        {
            "force_rms_N": np.sqrt(np.mean(force**2)),
            "force_max_N": force.max(),
            "torque_rms_Nm": np.sqrt(np.mean(torque**2)),
            "torque_max_Nm": torque.max(),
        }
    )
    assert set(document["predicted_error"]) == {"force_rms_N", "torque_rms_Nm"}
    assert document["provenance"] == {"serial": "FT1", "argv": ["calibrate"], "dataset_sha256": DATA.sha256()}
    assert len(document["parameter_names"]) == len(document["covariance"]) == 15
    np.testing.assert_array_equal(document["residuals"], DATA.wrench - predict(RESULT.parameters, DATA.R_base_flange))


def test_sigmas_of_mass_and_tilt_agree_with_sampling() -> None:
    rng = np.random.default_rng(2)
    steps = rng.multivariate_normal(np.zeros(15), RESULT.covariance, 1000)
    samples = [replace(RESULT, parameters=RESULT.parameters.moved(step)) for step in steps]
    common_gain = {
        "weight_N": 0.002 * RESULT.weight_N,
        "mass_kg": 0.002 * RESULT.mass_kg,
    }  # of sigma, not of covariance
    for name in ("mass_kg", "weight_N", "tilt_alpha_rad", "tilt_beta_rad"):
        spread = np.hypot(np.std([getattr(s, name) for s in samples]), common_gain.get(name, 0.0))
        assert spread == pytest.approx(RESULT.sigma[name], rel=0.06), name


@pytest.mark.parametrize("F_b", [[0, 20.0, 0], [0, -20.0, 0], [0, 0, 0]])
def test_an_undefined_tilt_has_a_finite_uncertainty(F_b: list[float]) -> None:
    parameters = replace(RESULT.parameters, gravity_force_base_N=np.array(F_b))
    result = replace(RESULT, parameters=parameters)
    assert result.sigma["tilt_beta_rad"] == np.pi
    json.dumps(result.to_dict() if any(F_b) else result.sigma["weight_N"], allow_nan=False)


def test_predicted_error_is_the_mean_over_all_orientations() -> None:
    rng = np.random.default_rng(3)
    cov = RESULT.wrench_covariance(Rotation.random(40_000, rng=rng).as_matrix()).mean(axis=0)
    force_N, torque_Nm = RESULT.predicted_error()
    assert force_N == pytest.approx(np.sqrt(np.trace(cov[:3, :3])), rel=3e-3)
    assert torque_Nm == pytest.approx(np.sqrt(np.trace(cov[3:, 3:])), rel=3e-3)


def test_wrench_covariance_predicts_the_spread_of_predictions() -> None:
    rng = np.random.default_rng(4)
    steps = rng.multivariate_normal(np.zeros(15), RESULT.covariance, 4000)
    spread = np.cov([predict(RESULT.parameters.moved(step), R[0]) for step in steps], rowvar=False)
    stated = RESULT.wrench_covariance(R[0])
    np.testing.assert_allclose(np.diag(spread), np.diag(stated), rtol=0.1)
    np.testing.assert_allclose(RESULT.wrench_covariance(R)[0], stated)


def test_compensate_leaves_the_contact() -> None:
    contact = RNG.normal(size=(10, 6))
    wrench = predict(RESULT.parameters, R) + contact
    np.testing.assert_allclose(RESULT.compensate(wrench, R), contact, atol=1e-12)
    np.testing.assert_allclose(RESULT.compensate(wrench[3], R[3]), contact[3], atol=1e-12)


@pytest.mark.parametrize(
    ("wrench", "rotation"), [((6,), (10, 3, 3)), ((10, 6), (3, 3)), ((10, 5), (10, 3, 3)), ((), ())]
)
def test_compensate_rejects_shapes_that_do_not_belong_together(
    wrench: tuple[int, ...], rotation: tuple[int, ...]
) -> None:
    with pytest.raises(ValueError, match="expected"):
        RESULT.compensate(np.zeros(wrench), np.zeros(rotation))


def test_a_file_gives_back_the_same_result(tmp_path: Path) -> None:
    RESULT.save(tmp_path / "c.json")
    again = CalibrationResult.load(tmp_path / "c.json")
    assert again.to_dict() == RESULT.to_dict()
    np.testing.assert_array_equal(again.covariance, RESULT.covariance)
    np.testing.assert_array_equal(again.R_flange_sensor, RESULT.R_flange_sensor)
    with pytest.raises(FileExistsError, match=r"c\.json exists already"):
        RESULT.save(tmp_path / "c.json")
    assert CalibrationResult.from_dict({**RESULT.to_dict(), "new": 1}).to_dict() == RESULT.to_dict()


def test_the_id_names_the_numbers_and_not_their_history(tmp_path: Path) -> None:
    RESULT.save(tmp_path / "c.json")
    assert CalibrationResult.load(tmp_path / "c.json").id == RESULT.id
    assert replace(RESULT, provenance={}).id == RESULT.id
    moved = replace(RESULT.parameters, force_bias_N=RESULT.force_bias_N + 1e-12)
    assert replace(RESULT, parameters=moved).id != RESULT.id


def without(name: str) -> str:
    return json.dumps({k: v for k, v in RESULT.to_dict().items() if k != name})


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("", "the file is empty"),
        ("nonsense", "this is not valid JSON"),
        ("3", "a JSON int"),
        ("{}", "the field 'format' is missing"),
        (json.dumps(DATA.to_dict()), "the format is 'ftdrive.dataset/1'"),
        ('{"format": "ftdrive.calibration/2"}', "version '2' of ftdrive.calibration"),
        (without("chi2"), "lacks the field chi2"),
        (json.dumps({**RESULT.to_dict(), "covariance": [[1]]}), "covariance must be"),
        (json.dumps({**RESULT.to_dict(), "covariance": (-np.eye(15)).tolist()}), "not positive definite"),
        (json.dumps({**RESULT.to_dict(), "force_bias_N": "x"}), "cannot be read"),
        (json.dumps({**RESULT.to_dict(), "force_bias_N": [0, float("nan"), 0]}), "force_bias_N must be finite"),
        (json.dumps({**RESULT.to_dict(), "R_flange_sensor": (-np.eye(3)).tolist()}), "must be a rotation matrix"),
    ],
)
def test_a_file_that_is_something_else_is_named_in_one_sentence(tmp_path: Path, content: str, words: str) -> None:
    path = tmp_path / "c.json"
    path.write_text(content)
    with pytest.raises(BadCalibration, match=words) as caught:
        CalibrationResult.load(path)
    assert str(caught.value).count("c.json") == 1


def with_a_changed_bias(path: Path) -> dict[str, Any]:
    """Write a file whose force bias is 6 N larger along z; return what it holds."""
    document = json.loads(path.read_text())
    document["force_bias_N"][2] += 6.0
    path.write_text(json.dumps(document))
    return dict(document)


def test_a_file_whose_numbers_are_not_those_of_its_id_is_refused_or_marked(tmp_path: Path) -> None:
    path = tmp_path / "c.json"
    RESULT.save(path)
    document = with_a_changed_bias(path)
    for names in ((), ("checksum",), ("id",)):  # each of both reveals it
        path.write_text(json.dumps({name: value for name, value in document.items() if name not in names}))
        with pytest.raises(BadCalibration, match=r"c\.json: .*not that of calibration .* edited.*--force"):
            CalibrationResult.load(path)
        edited = CalibrationResult.load(path, accept_edited=True)
        assert edited.is_edited
        assert edited.force_bias_N[2] == RESULT.force_bias_N[2] + 6.0
    edited.save(tmp_path / "again.json")
    assert CalibrationResult.load(tmp_path / "again.json").is_edited
    assert CalibrationResult.load(tmp_path / "again.json").id != RESULT.id
    assert not RESULT.is_edited


def test_what_the_id_does_not_cover_is_covered_by_the_checksum(tmp_path: Path) -> None:
    path = tmp_path / "c.json"
    RESULT.save(path)
    document = json.loads(path.read_text())
    path.write_text(json.dumps(document | {"findings": [], "verdict": "good"}))
    assert RESULT.verdict != "good"
    with pytest.raises(BadCalibration, match="edited"):
        CalibrationResult.load(path)


def test_a_verdict_unlike_its_findings_is_refused_or_follows_them() -> None:
    better = RESULT.to_dict() | {"verdict": "good"}
    assert RESULT.verdict != "good"
    with pytest.raises(BadCalibration, match="edited"):
        CalibrationResult.from_dict(better)
    edited = CalibrationResult.from_dict(better, accept_edited=True)
    assert edited.is_edited
    assert edited.verdict == RESULT.verdict


@pytest.mark.parametrize(
    "change",
    [
        {"method": 5},
        {"noise_source": None},
        {"components": [1]},
        {"findings": None},
        {"findings": [5]},
        {"findings": [{"code": "constant_force", "severity": "limit", "values": {"force_N": "x"}}]},
    ],
)
def test_an_unknown_word_is_one_sentence(change: dict[str, Any]) -> None:
    with pytest.raises(BadCalibration, match="cannot be read"):
        CalibrationResult.from_dict({**RESULT.to_dict(), **change})


def test_a_flipped_bit_is_refused_or_changes_nothing(tmp_path: Path) -> None:
    path = tmp_path / "c.json"
    RESULT.save(path)
    content, rng, refused = path.read_bytes(), np.random.default_rng(1), 0
    for place in rng.integers(0, len(content), 100).tolist():
        damaged = bytearray(content)
        damaged[place] ^= 1 << int(rng.integers(8))
        path.write_bytes(damaged)
        try:
            found = CalibrationResult.load(path)
        except BadCalibration:
            refused += 1
        else:
            assert found.to_dict() == RESULT.to_dict()
    assert refused > 50


def test_provenance_must_be_writable() -> None:
    with pytest.raises(ValueError, match="provenance cannot be written"):
        solve(DATA, provenance={"x": object()})
