"""Results: derived quantities, their uncertainty, compensation, files."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ftcalib import BadCalibration, CalibrationDataset, CalibrationResult, Parameters, SensorMatrix, Setup, solve
from ftcalib.model import DriftResult, predict, weight_and_tilt
from ftcalib.result import MotionResult, _weight_and_tilt_sigma, require_positive_definite
from ftcalib.sensor_matrix import SIZE, Response

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
    R, predict(TRUTH, R) + RNG.normal(size=(10, 6)) * np.sqrt(np.diag(COV[0])), COV, np.full(10, 1000), np.arange(10.0)
)
EXACT = Setup(sensor_accuracy_percent=0.0)
RESULT = solve(DATA, g_m_s2=9.81, setup=EXACT, provenance={"serial": "FT1", "argv": ["calibrate"]})


def test_every_promised_key_is_in_the_file_with_its_value() -> None:
    document: dict[str, Any] = json.loads(json.dumps(RESULT.to_dict(), allow_nan=False))
    assert document["format"] == "ftdrive.calibration/2"
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


@pytest.mark.parametrize("F_b", [[0, 20.0, 0], [0, -20.0, 0], [0, 0, 0]])
def test_an_undefined_tilt_has_a_finite_uncertainty(F_b: list[float]) -> None:
    parameters = replace(RESULT.parameters, gravity_force_base_N=np.array(F_b))
    result = replace(RESULT, parameters=parameters)
    assert result.sigma["tilt_beta_rad"] == np.pi
    json.dumps(result.to_dict() if any(F_b) else result.sigma["weight_N"], allow_nan=False)


def test_predicted_error_is_the_mean_over_all_orientations() -> None:
    # The mean of squares of entries over the rotations of the cube is that over all.
    cov = RESULT.wrench_covariance(Rotation.create_group("O").as_matrix()).mean(axis=0)
    force_N, torque_Nm = RESULT.predicted_error()
    assert force_N == pytest.approx(np.sqrt(np.trace(cov[:3, :3])), rel=1e-9)
    assert torque_Nm == pytest.approx(np.sqrt(np.trace(cov[3:, 3:])), rel=1e-9)


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


def test_a_file_of_the_first_version_has_no_mean_of_the_bias() -> None:
    document = RESULT.to_dict()
    del document["mean_bias"]
    earlier = CalibrationResult.from_dict({**document, "format": "ftdrive.calibration/1"})
    assert earlier.mean_bias is None
    assert earlier.id == RESULT.id
    drifting = CalibrationResult.from_dict(replace(RESULT, mean_bias=np.arange(6.0)).to_dict())
    np.testing.assert_array_equal(drifting.mean_bias, np.arange(6.0))


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("", "the file is empty"),
        ("nonsense", "this is not valid JSON"),
        ("3", "a JSON int"),
        ("{}", "the field 'format' is missing"),
        (json.dumps(DATA.to_dict()), "the format is 'ftdrive.dataset/1'"),
        ('{"format": "ftdrive.calibration/3"}', "version '3' of ftdrive.calibration"),
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


def test_tilt_angles_reproduce_the_gravity_force() -> None:
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(500, 3))
    for F_b in [*directions, *np.eye(3), *-np.eye(3)]:
        weight, alpha, beta = weight_and_tilt(F_b)
        up = [np.cos(alpha) * np.sin(beta), -np.sin(alpha), np.cos(alpha) * np.cos(beta)]
        np.testing.assert_allclose(-weight * np.array(up), F_b, atol=1e-15)
        assert abs(alpha) <= np.pi / 2
        assert -np.pi < beta <= np.pi


def test_tilt_of_the_usual_mountings() -> None:
    assert weight_and_tilt(np.array([0, 0, -20.0])) == (20.0, 0.0, 0.0)
    np.testing.assert_allclose(weight_and_tilt(np.array([0, 0, 20.0])), [20, 0, np.pi])
    assert weight_and_tilt(np.array([-20.0, 0, 0]))[2] == pytest.approx(np.pi / 2)
    np.testing.assert_allclose(weight_and_tilt(np.array([0, 20.0, 0])), [20, np.pi / 2, 0])
    # Table II of the paper: 20.047 N are 2.044 kg, so eq. 48 cannot mean the square of the norm.
    assert weight_and_tilt(np.array([0, 0, -20.047]))[0] / 9.80665 == pytest.approx(2.044, abs=5e-4)


@pytest.mark.parametrize("F_b", [[0.6, -0.4, -20.0], [3.0, 10.0, 0.0]])
def test_sigmas_of_weight_and_tilt_are_those_of_their_derivative(F_b: list[float]) -> None:
    force, h = np.array(F_b), 1e-6
    A = 0.01 * np.random.default_rng(5).normal(size=(3, 5))
    derivative = np.transpose(
        [(np.array(weight_and_tilt(force + h * e)) - weight_and_tilt(force - h * e)) / (2 * h) for e in np.eye(3)]
    )
    expected = np.sqrt(np.diag(derivative @ A @ A.T @ derivative.T))
    np.testing.assert_allclose(_weight_and_tilt_sigma(force, A @ A.T), expected, rtol=1e-6)
    large = _weight_and_tilt_sigma(force, 1e6 * np.eye(3))
    assert large[1:] == (np.pi, np.pi)
    assert large[0] == pytest.approx(1e3)


def test_a_weight_of_zero_has_the_sigma_of_its_components() -> None:
    found = _weight_and_tilt_sigma(np.zeros(3), np.diag([1.0, 4.0, 4.0]))
    assert found == pytest.approx((3.0, np.pi, np.pi))


@pytest.mark.parametrize(("least", "accepted"), [(-0.9e-6, True), (-1.1e-6, False), (0.5, True)])
def test_a_covariance_may_be_indefinite_by_rounding(least: float, accepted: bool) -> None:
    units = 10.0 ** np.arange(-3, 2)
    covariance = np.eye(5)
    covariance[0, 3] = covariance[3, 0] = 1 - least
    covariance *= np.outer(units, units)
    known = np.zeros((7, 7))
    known[:5, :5] = covariance
    for one in (covariance, known):  # what is exactly known has no variance
        if accepted:
            require_positive_definite(one)
        else:
            with pytest.raises(ValueError, match="positive definite"):
                require_positive_definite(one)
    require_positive_definite(np.zeros((7, 7)))


def response(gain: float, cross_talk: float) -> Response:
    coefficients = np.append(np.full(5, gain), np.full(6, cross_talk))
    covariance = np.zeros((15 + SIZE, 15 + SIZE))
    covariance[:15, :15] = RESULT.covariance
    covariance[15:, 15:] = 1e-9 * np.eye(SIZE)
    return Response(coefficients, covariance)


def test_sigmas_of_the_tool_allow_for_what_is_hidden() -> None:
    exact_arm = replace(RESULT, hidden_covariance=np.zeros((15, 15)))
    shift = np.arange(15.0) * 1e-4
    found = response(0.03, 0.02)
    one = replace(exact_arm, response=found, gain_sigma=found.gain_sigma, cable_shift=shift)
    of_sensor = one.contact.hidden_covariance
    hidden = of_sensor + np.outer(shift, shift)
    np.testing.assert_allclose(one.tool_covariance - RESULT.covariance, hidden, atol=1e-12)
    along = RESULT.gravity_force_base_N / RESULT.weight_N
    assert one.scale_sigma == pytest.approx(np.sqrt(along @ of_sensor[3:6, 3:6] @ along) / RESULT.weight_N)
    lagging = replace(one, components={"hysteresis": 0.01})
    assert lagging.scale_sigma == pytest.approx(np.hypot(one.scale_sigma, 0.01))
    perfect = replace(exact_arm, sensor=SensorMatrix.usual(0.0))
    assert perfect.scale_sigma == pytest.approx(0.002)
    # All of the scale counts once, in the weight and in the force along it.
    along_N = np.abs(RESULT.gravity_force_base_N)
    of_estimates = _weight_and_tilt_sigma(RESULT.gravity_force_base_N, RESULT.covariance[3:6, 3:6])[0]
    for result in (exact_arm, one, lagging, perfect):
        weight_N = np.hypot(of_estimates, result.scale_sigma * RESULT.weight_N)
        assert result.sigma["weight_N"] == pytest.approx(weight_N, rel=1e-3)
        assert result.sigma["mass_kg"] == pytest.approx(weight_N / 9.81, rel=1e-3)
        cable_N = 0.0 if result.cable_shift is None else shift[3:6]
        expected = np.sqrt(np.diag(RESULT.covariance)[3:6] + (result.scale_sigma * along_N) ** 2 + cable_N**2)
        np.testing.assert_allclose(result.sigma["gravity_force_base_N"], expected)
    exact = RESULT.covariance.copy()
    exact[:3], exact[:, :3] = 0.0, 0.0
    np.testing.assert_array_equal(replace(RESULT, covariance=exact, cable_shift=shift).sigma["R_flange_sensor"], 0)


def test_the_id_is_of_all_that_compensation_depends_on() -> None:
    motion = MotionResult(np.eye(3), 0.01, 0.05, np.eye(23), 0.9)
    covariance = RESULT.covariance * 1.01
    changes: list[dict[str, Any]] = [
        {"covariance": covariance},
        {"gain_sigma": 0.01},
        {"g_m_s2": 9.8},
        {"response": response(0.01, 0.0)},
        {"motion": motion},
        {"motion": replace(motion, delay_s=0.02)},
        {"motion": replace(motion, inertia_kg_m2=2 * np.eye(3))},
    ]
    ids = [replace(RESULT, **change).id for change in changes]
    assert len({RESULT.id, *ids}) == len(changes) + 1
    assert replace(RESULT, motion=replace(motion, used_share=0.5)).id == ids[4]


def test_noise_explains_the_residuals_unless_a_test_says_otherwise() -> None:
    for p_value, explains in ((0.9e-3, False), (1.1e-3, True), (None, False)):
        assert replace(RESULT, p_value=p_value).noise_explains == explains
    assert replace(RESULT, p_value=None, quality={}).noise_explains
    motion = MotionResult(np.eye(3), 0.01, 0.05, np.eye(23), 0.9)
    for share, explains in ((1.0, True), (1.01, False)):
        error = share * np.array(RESULT.predicted_error())
        quality = {**RESULT.quality, "next_use_force_rms_N": error[0], "next_use_torque_rms_Nm": error[1]}
        assert replace(RESULT, p_value=None, motion=motion, quality=quality).noise_explains == explains
    np.testing.assert_array_equal(replace(RESULT, quality={}).likely_error(), RESULT.predicted_error())
    old = {name: value for name, value in RESULT.quality.items() if not name.startswith("next_use")}
    left_out = [RESULT.quality["loo_force_rms_N"], RESULT.quality["loo_torque_rms_Nm"]]
    np.testing.assert_array_equal(replace(RESULT, quality=old).likely_error(), left_out)


def test_a_motion_has_its_sigmas_and_is_read_as_written() -> None:
    motion = MotionResult(np.eye(3), 0.01, 0.05, np.diag(np.arange(23.0) ** 2), 0.9, ({"t_s": 1.0},))
    np.testing.assert_array_equal(motion.sigma["inertia_kg_m2"], [[15, 18, 19], [18, 16, 20], [19, 20, 17]])
    assert (motion.sigma["height_m"], motion.sigma["delay_s"]) == (21, 22)
    again = MotionResult.from_dict(motion.to_dict())
    assert again is not None
    assert again.to_dict() == motion.to_dict()
    assert MotionResult.from_dict({}) is None


def test_arrays_of_another_shape_or_without_numbers_are_refused() -> None:
    good = np.zeros(6)
    for bad in (np.zeros(5), np.full(6, np.nan)):
        for change, sigma in ((bad, good), (good, bad)):
            with pytest.raises(ValueError, match=r"the drift's .* 6 finite numbers"):
                DriftResult(change, sigma)
    for inertia, covariance in (
        (np.eye(2), np.eye(23)),
        (np.eye(3), np.eye(22)),
        (np.eye(3), np.full((23, 23), np.inf)),
    ):
        with pytest.raises(ValueError, match=r"the motion's .* finite numbers"):
            MotionResult(inertia, 0.01, 0.05, covariance, 0.9)
    wrong: dict[str, Any] = {"weights": np.ones(9), "measured_sigma": np.full(6, np.nan), "cable_shift": np.ones(14)}
    for name, value in wrong.items():
        with pytest.raises(ValueError, match=f"{name} must be"):
            replace(RESULT, **{name: value})
    right: dict[str, Any] = {"measured_sigma": np.ones(6), "weights": np.ones(10), "cable_shift": np.ones(15)}
    assert replace(RESULT, **right).weights is not None
