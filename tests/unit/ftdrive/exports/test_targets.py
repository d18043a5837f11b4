"""What the numbers of test_round_trip.py do not show: formats of numbers, names, and what is not identified."""

import json
import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import yaml

from ftcalib import CalibrationResult
from ftcalib.result import MotionResult
from ftdrive import __version__
from ftdrive.exports.formats import FORMATS
from ftdrive.exports.registry import Exported, Settings, export_calibration
from tests.unit.ftdrive.exports.example import MEASURED, calibration, responding


def made(name: str, settings: Settings = MEASURED, limit_N: float = 1e3) -> Exported:
    return export_calibration(calibration(), name, settings, max_force_error_N=limit_N)


PAYLOAD_COM = [2 * 0.02 / 2.5, 2 * 0.01 / 2.5, (2 * 0.083 + 0.5 * 0.015) / 2.5]
"""2 kg of tool and 0.5 kg of sensor, 15 mm below the flange face."""


@pytest.mark.parametrize("name", ["franka", "urdf", "mujoco"])
def test_no_inertia_is_invented(name: str) -> None:
    text = made(name).text
    assert "not identified" in text or any("not identified" in note for note in made(name).notes)
    found = re.findall(r'(?:load_inertia: \[|diaginertia="|ix[xyz]="|iy[yz]="|izz=")([^]"]*)', text)
    assert {float(number) for numbers in found for number in re.split("[, ]+", numbers)} == {0.0}


def test_ur_payload_is_one_statement_without_exponents() -> None:
    comments, statement = made("ur-payload").text.rsplit("\n", 2)[:2]
    assert all(line.startswith("#") and line.isascii() for line in comments.splitlines())
    match = re.fullmatch(r"set_target_payload\(([\d.]+), \[([-\d., ]+)\], \[0, 0, 0, 0, 0, 0\]\)", statement)
    assert match
    assert float(match[1]) == pytest.approx(2.5, abs=1e-12)
    assert [float(x) for x in match[2].split(", ")] == pytest.approx(PAYLOAD_COM, abs=1e-12)


@pytest.mark.parametrize(("name", "parse"), [("json", json.loads), ("yaml", yaml.safe_load)])
def test_the_complete_formats_keep_every_bit_and_the_response(name: str, parse: Any) -> None:
    result = responding(0.01, 0.002)
    found = parse(export_calibration(result, name, MEASURED, max_force_error_N=0.0).text)
    saved = result.to_dict()
    for key in ("gravity_force_base_N", "R_flange_sensor", "force_bias_N", "torque_bias_Nm", "p_sensor_com_m", "id"):
        assert found[key] == saved[key]
    assert found["response"] == {key: saved["response"][key] for key in ("force_gain", "cross_talk_m")}
    assert found["p_flange_sensor_m"] == [0.0, 0.0, 0.033]
    assert parse(export_calibration(result, name, Settings()).text)["p_flange_sensor_m"] is None


@pytest.mark.parametrize("name", FORMATS)
def test_every_text_names_calibration_date_and_version(name: str) -> None:
    text = made(name).text
    for word in (calibration().id, "2026-11-14T08:00:00+00:00", f"ftdrive {__version__}"):
        assert word in text


def in_motion() -> CalibrationResult:
    moments = np.array([[2.0, 0.1, -0.2], [0.1, 2.4, 0.3], [-0.2, 0.3, 1.4]]) * 1e-3
    return replace(calibration(), motion=MotionResult(moments, 0.003, 0.02, np.eye(23) * 1e-8, 1.0))


def test_an_inertia_from_motion_is_written() -> None:
    found = {name: export_calibration(in_motion(), name, MEASURED, max_force_error_N=9) for name in ("urdf", "mujoco")}
    written = re.findall(r'i([xyz]{2})="(\S+)"', found["urdf"].text)
    moments = {"xx": 0.002, "yy": 0.0024, "zz": 0.0014, "xy": 0.0001, "xz": -0.0002, "yz": 0.0003}
    assert {axes: float(value) for axes, value in written} == moments
    in_order = re.findall(r'fullinertia="([^"]*)"', found["mujoco"].text)[0].split()
    assert [float(one) for one in in_order] == list(moments.values())
    assert all("identified from motion" in "".join(one.notes) for one in found.values())


def test_the_payload_has_the_inertia_of_tool_and_sensor_about_their_centre() -> None:
    statement = export_calibration(in_motion(), "ur-payload", MEASURED, max_force_error_N=1e3).text.rsplit("\n", 2)[1]
    xx, yy, zz, xy, xz, yz = map(float, statement.split("[")[2].split("]")[0].split(", "))
    found = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    calibrated = in_motion()
    assert calibrated.motion is not None
    Q = calibrated.R_flange_sensor
    tool_kg, com = calibrated.mass_kg, np.array(PAYLOAD_COM)
    points = [(tool_kg, np.array([0.02, 0.01, 0.083])), (0.5, np.array([0.0, 0.0, 0.015]))]
    expected = Q @ calibrated.motion.inertia_kg_m2 @ Q.T
    for mass_kg, at_m in points:
        off = at_m - com
        expected += mass_kg * (off @ off * np.eye(3) - np.outer(off, off))
    assert np.allclose(found, expected, atol=1e-9)
