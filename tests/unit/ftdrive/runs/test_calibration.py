"""A sensor's matrix serves the sensor that it was made for, and no other; an edited file is read or named."""

import copy
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ftcalib import CalibrationResult, solve
from ftcalib.errors import BadCalibration
from ftcalib.sensor_matrix import SensorMatrix
from ftdrive.runs.calibration import sensor_identity, with_sensor
from ftdrivers.interfaces import NOT_REPORTED
from tests.loaded_sensor import PROTOCOLS, LoadedSensor

RANGE = [290.0, 290.0, 580.0, 10.0, 10.0, 10.0]
OURS: dict[str, Any] = {
    "model": "ATI Mini45",
    "serial": "FT1",
    "facts": {
        "counts_per_N": {"value": 1000.0, "source": "device"},
        "counts_per_Nm": {"value": 20000.0, "source": "device"},
        "range": {"value": RANGE, "source": "device"},
        "sign": {"value": 1, "source": "configured"},
    },
}


def changed(**values: Any) -> dict[str, Any]:
    """Our sensor with another value; None takes it away."""
    sensor = copy.deepcopy(OURS)
    for name, value in values.items():
        place = sensor if name in ("model", "serial") else sensor["facts"]
        if value is None:
            place.pop(name)
        else:
            place[name] = value if place is sensor else {"value": value}
    return sensor


def origin(sensor: object, **more: Any) -> dict[str, Any]:
    return {"devices": {"sensor": sensor}, **more}


@pytest.fixture(scope="module")
def calibration() -> CalibrationResult:
    return solve(LoadedSensor(3).runs(PROTOCOLS["hung, tip"])[0].dataset)


def matrix(provenance: dict[str, Any]) -> SensorMatrix:
    usual = SensorMatrix.usual(0.005)
    return SensorMatrix(usual.error, usual.covariance, "loads", provenance=provenance)


def of(made: dict[str, Any], calibration: CalibrationResult, used: dict[str, Any], folder: Path) -> CalibrationResult:
    matrix({"sensor": sensor_identity(made)}).save(folder / "sensor.json")
    return with_sensor(CalibrationResult(**{**vars(calibration), "provenance": used}), folder)


SAME = {
    "the same sensor": (origin(OURS), origin(OURS)),
    "rounded by a file": (origin(changed(counts_per_N=1000.0000000001)), origin(OURS)),
    "a range as a tuple": (origin(changed(range=tuple(RANGE))), origin(OURS)),
    "emulated, both": (origin(OURS, station={"sensor": "can"}), origin(OURS, emulated=True)),
    "facts of neither": (origin({"model": "A", "serial": "B"}), origin({"model": "A", "serial": "B"})),
    "another firmware": (origin(OURS | {"firmware": "2"}), origin(OURS | {"firmware": "1"})),
}
OTHER = {
    "serial number": (origin(OURS), origin(changed(serial="FT2")), ""),
    "model": (origin(OURS), origin(changed(model="ATI Gamma")), "its model is ATI Mini45, but ATI Gamma in this"),
    "model not known": (origin(changed(model=None)), origin(OURS), "its model is unknown"),
    "slot": (origin(OURS), origin(changed(counts_per_N=500.0)), "its counts per N is 1000, but 500 in this"),
    "slot of torques": (origin(OURS), origin(changed(counts_per_Nm=1.0)), "its counts per N·m is 20000"),
    "range": (origin(OURS), origin(changed(range=[145.0] * 6)), "its range is 290, 290, 580, 10, 10, 10, but"),
    "range not known": (origin(OURS), origin(changed(range=None)), "but unknown in this calibration"),
    "sign": (origin(OURS), origin(changed(sign=-1)), "its sign is 1, but -1 in this calibration"),
    "emulated": (origin(OURS, emulated=True), origin(OURS), "its emulated is True"),
    "no serial number": (origin(changed(serial=None)), origin(changed(serial=None)), "has no serial number"),
    "not reported": (origin(changed(serial=NOT_REPORTED)), origin(changed(serial=NOT_REPORTED)), "serial=NAME"),
    "empty": (origin(changed(serial="")), origin(changed(serial="")), "number: add serial=NAME"),
    "ours not reported": (origin(OURS), origin(changed(serial=NOT_REPORTED)), "the sensor of this calibration has"),
    "theirs not reported": (origin(changed(serial=NOT_REPORTED)), origin(OURS), "the sensor of that file has no"),
    "no devices": (origin(OURS), {}, "the sensor of this calibration has no serial number"),
    "neither has devices": ({}, {}, "the sensor of this calibration has no serial number"),
    "devices of another kind": (origin(OURS), {"devices": "x"}, "the sensor of this calibration has no"),
    "facts of another kind": (origin(OURS), origin({**OURS, "facts": [1]}), "but unknown in this calibration"),
}  # fmt: skip


@pytest.mark.parametrize(("made", "used"), SAME.values(), ids=SAME)
def test_a_matrix_serves_its_sensor(
    made: dict[str, Any], used: dict[str, Any], calibration: CalibrationResult, tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:  # fmt: skip
    assert of(made, calibration, used, tmp_path).sensor is not None
    assert not caplog.messages


@pytest.mark.parametrize(("made", "used", "why"), OTHER.values(), ids=OTHER)
def test_a_foreign_matrix_is_not_used_and_that_is_said(
    made: dict[str, Any], used: dict[str, Any], why: str, calibration: CalibrationResult, tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:  # fmt: skip
    assert of(made, calibration, used, tmp_path).sensor is None
    assert bool(caplog.messages) is bool(why)  # another sensor's file beside it is nothing to report
    assert why in caplog.text
    assert all(message.startswith("sensor.json is not used: ") for message in caplog.messages)


def test_a_file_of_an_older_version_is_not_used_without_a_word(
    calibration: CalibrationResult, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    matrix({"serial": "FT1"}).save(tmp_path / "sensor.json")
    ours = CalibrationResult(**{**vars(calibration), "provenance": origin(OURS)})
    assert with_sensor(ours, tmp_path).sensor is None
    assert "run `ftdrive loads solve` again" in caplog.text
    matrix({"sensor": sensor_identity(origin(OURS))}).save(tmp_path / "sensor-2.json")
    assert with_sensor(ours, tmp_path).sensor is not None


def entry(name: str, i: int, j: int, value: object) -> Callable[[dict[str, Any]], None]:
    def edit(document: dict[str, Any]) -> None:
        document[name][i][j] = value

    return edit


def whole(name: str, value: object) -> Callable[[dict[str, Any]], None]:
    return lambda document: document.update({name: value})


EDITS: dict[str, Callable[[dict[str, Any]], object]] = {
    "+99,900 %": entry("error", 0, 0, 999.0),
    "-60 %": entry("error", 2, 2, -0.6),
    "1e308": entry("error", 1, 1, 1e308),
    "10 to the 400": entry("error", 1, 1, 10**400),
    "cross-talk of force on torque": entry("error", 3, 0, 0.5),
    "a string": entry("error", 0, 0, "0.01"),
    "a boolean": entry("error", 0, 0, True),
    "nothing": entry("error", 0, 0, None),
    "a list": entry("error", 0, 0, [0.01]),
    "no number": entry("error", 0, 0, float("nan")),
    "a negative variance": entry("covariance", 5, 5, -1e-6),
    "a variance of 1e308": entry("covariance", 5, 5, 1e308),
    "a sigma of 80 %": entry("covariance", 3, 3, 0.64),
    "a variance that is a string": entry("covariance", 3, 3, "1"),
    "not symmetric": entry("covariance", 3, 4, 1e-5),
    "a correlation above 1": lambda document: [entry("covariance", i, j, 1e-3)(document) for i, j in ((3, 4), (4, 3))],
    "too few rows": lambda document: document["error"].pop(),
    "a ragged matrix": lambda document: document["error"][2].pop(),
    "a matrix that is a number": whole("error", 0.01),
    "a source of another kind": whole("source", "guessed"),
    "a source that is a list": whole("source", ["loads"]),
    "a lever of 1e6 m": whole("lever_m", 1e6),
    "a lever that is a boolean": whole("lever_m", True),
    "a lever that is a string": whole("lever_m", "0.1"),
    "a negative lever": whole("lever_m", -0.1),
    "a floor of 90 %": whole("floor", 0.9),
    "a negative floor": whole("floor", -0.1),
    "a provenance that is a list": whole("provenance", [1]),
    "no provenance": lambda document: document.pop("provenance"),
    "another format": whole("format", "ftdrive.sensor/2"),
}


@pytest.mark.parametrize("edit", EDITS.values(), ids=EDITS)
def test_an_edited_file_without_a_checksum_is_named(edit: Callable[[dict[str, Any]], Any], tmp_path: Path) -> None:
    path = tmp_path / "sensor.json"
    matrix({"sensor": sensor_identity(origin(OURS))}).save(path)
    document = json.loads(path.read_text())
    del document["checksum"]
    path.write_text(json.dumps(document))
    np.testing.assert_array_equal(SensorMatrix.load(path).error, np.zeros((6, 6)))
    edit(document)
    path.write_text(json.dumps(document))
    with pytest.raises(BadCalibration, match=r"^sensor\.json: "):
        SensorMatrix.load(path)
