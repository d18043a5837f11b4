"""What a target cannot express: how much that changes the force, the note, the error. What must be given."""

import re
from dataclasses import replace

import numpy as np
import pytest
import yaml

from ftcalib import CalibrationResult
from ftdrive.errors import ConfigError, NotAccepted
from ftdrive.exports.formats import FORMATS
from ftdrive.exports.registry import Settings, export_calibration
from tests.unit.ftdrive.exports.example import MEASURED, UPRIGHT, calibration, rejected, tilted


@pytest.mark.parametrize("name", [name for name, one in FORMATS.items() if "tilt" not in one.expresses])
def test_a_tilt_that_would_change_the_force_is_an_error(name: str) -> None:
    with pytest.raises(NotAccepted, match=r"1.8°.*0.616 N.*the limit is 0.1 N.*json.*--max-force-error"):
        export_calibration(tilted(1.8), name, MEASURED)
    assert export_calibration(tilted(0.2), name, MEASURED).max_force_error_N == pytest.approx(0.0685, abs=1e-4)


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
