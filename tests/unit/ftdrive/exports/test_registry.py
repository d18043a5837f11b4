"""What a target cannot express: how much that changes the force, the note, the error. What must be given."""

import re
from dataclasses import replace
from math import radians, sin, sqrt

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from ftcalib import CalibrationResult
from ftcalib.compensation import Compensator
from ftcalib.model import Parameters
from ftdrive.errors import ConfigError, NotAccepted
from ftdrive.exports.formats import FORMATS
from ftdrive.exports.registry import Settings, _largest_norm, export_calibration
from tests.unit.ftdrive.exports.example import MEASURED, UPRIGHT, WEIGHT_N, calibration, rejected, tilted

LEVER_M = sqrt(0.01**2 + 0.02**2 + 0.05**2)


@pytest.mark.parametrize("tilt_deg", [0.02, 1.8, 90, 180])
def test_a_tilt_that_is_lost_costs_twice_the_weight_times_the_sine_of_half_of_it(tilt_deg: float) -> None:
    made = export_calibration(tilted(tilt_deg), "admittance", MEASURED, max_force_error_N=100)
    expected_N = 2 * WEIGHT_N * sin(radians(tilt_deg) / 2)
    assert made.max_force_error_N == pytest.approx(expected_N, rel=1e-6)
    assert made.max_torque_error_Nm == pytest.approx(LEVER_M * expected_N, rel=1e-6)
    assert f"base tilt of {tilt_deg:.3g}°" in made.notes[0]
    assert f"{expected_N:.3g} N" in made.notes[0]


@pytest.mark.parametrize("name", [name for name, one in FORMATS.items() if "tilt" not in one.expresses])
def test_a_tilt_that_would_change_the_force_is_an_error(name: str) -> None:
    with pytest.raises(NotAccepted, match=r"1.8°.*0.616 N.*the limit is 0.1 N.*json.*--max-force-error"):
        export_calibration(tilted(1.8), name, MEASURED)
    assert export_calibration(tilted(0.2), name, MEASURED).max_force_error_N == pytest.approx(0.0685, abs=1e-4)


def test_no_model_is_proposed_in_place_of_a_target_that_reads_the_sensor() -> None:
    with pytest.raises(NotAccepted, match="Choose another format") as error:
        export_calibration(tilted(1.8), "admittance", MEASURED)
    assert "ros2-control" in str(error.value)
    assert not [name for name in ("urdf", "mujoco", "ur-payload") if name in str(error.value)]


@pytest.mark.parametrize("seed", range(5))
def test_no_orientation_differs_by_more_and_some_by_as_much(seed: int) -> None:
    rng = np.random.default_rng(seed)

    def arbitrary() -> Parameters:
        return Parameters(
            Rotation.random(rng=rng).as_matrix(), *(rng.normal(size=3) * size for size in (10, 3, 0.1, 0.3))
        )

    one, other = Compensator(arbitrary()), Compensator(arbitrary())
    R = Rotation.random(20_000, rng=rng).as_matrix()
    difference = other(np.zeros((len(R), 6)), R) - one(np.zeros((len(R), 6)), R)
    matrix, offset = other.matrix - one.matrix, other.offset - one.offset
    found = np.array([_largest_norm(matrix[part], offset[part]) for part in (slice(3), slice(3, 6))])
    seen = np.array([np.linalg.norm(part, axis=1).max() for part in (difference[:, :3], difference[:, 3:])])
    assert (seen <= found * (1 + 1e-9)).all()
    assert (seen >= 0.99 * found).all()


def test_a_rejected_calibration_is_not_exported() -> None:
    with pytest.raises(NotAccepted, match="a very different mounting"):
        export_calibration(rejected(), "json", MEASURED)


@pytest.mark.parametrize("name", ["urdf", "mujoco", "static-transform", "mc-rtc", "franka", "ur-payload"])
def test_the_place_of_the_sensor_is_never_invented(name: str) -> None:
    with pytest.raises(ConfigError, match="--height MM"):
        export_calibration(calibration(), name, replace(MEASURED, height_mm=None))


@pytest.mark.parametrize("name", ["franka", "ur-payload"])
def test_the_mass_of_the_sensor_is_never_invented(name: str) -> None:
    with pytest.raises(ConfigError, match="--sensor-mass KG"):
        export_calibration(calibration(), name, replace(MEASURED, sensor_mass_kg=None))


def numbers_in(text: str) -> list[float]:
    lines = [line for line in text.splitlines() if not line.startswith("#")]
    return [float(number) for number in re.findall(r"-?\d+\.\d+(?:e-?\d+)?", " ".join(lines))]


@pytest.mark.parametrize("name", ["franka", "ur-payload"])
def test_the_centre_of_the_sensor_is_half_way_up_unless_given(name: str) -> None:
    assert MEASURED.height_mm is not None
    half_way = (0.0, 0.0, MEASURED.height_mm / 2)
    assumed = export_calibration(calibration(), name, replace(MEASURED, sensor_com_mm=None))
    given = export_calibration(calibration(), name, replace(MEASURED, sensor_com_mm=half_way))
    assert numbers_in(assumed.text) == pytest.approx(numbers_in(given.text))
    assert any("--sensor-com" in note for note in assumed.notes)


@pytest.mark.parametrize("name", [name for name, one in FORMATS.items() if one.file.endswith("yaml")])
def test_what_needs_no_place_takes_none(name: str) -> None:
    if name not in ("franka", "mc-rtc"):
        export_calibration(calibration(R_flange_sensor=np.eye(3)), name, Settings())


@pytest.mark.parametrize("frame", ["", "a b", "a\nb: 1", "-x", "a--b", "a-", '"', "a#", "ö"])
def test_a_name_that_could_break_a_file_is_refused(frame: str) -> None:
    with pytest.raises(ConfigError, match=r"--sensor-frame is .*letters, digits"):
        Settings(sensor_frame=frame)


def test_two_frames_of_one_name_are_refused() -> None:
    with pytest.raises(ConfigError, match="own name"):
        Settings(tool_frame="tool0")


def with_date(text: str) -> CalibrationResult:
    return replace(calibration(), provenance={"created_utc": text})


def test_a_date_from_a_file_cannot_add_lines() -> None:
    text = export_calibration(with_date("2026\nmass: 99.0"), "ft-tools", MEASURED).text
    assert yaml.safe_load(text)["mass"] == pytest.approx(2.0)
    assert "-->" not in export_calibration(with_date("--><x/>"), "urdf", MEASURED).text.partition("\n-->\n")[0]


def test_without_a_load_gravity_points_down() -> None:
    empty = calibration(gravity_N=UPRIGHT * 0, R_flange_sensor=np.eye(3))
    for name in ("ros2-control", "kth", "xarm", "json"):
        assert "nan" not in export_calibration(empty, name, MEASURED).text.lower().replace("nanosec", "")
