"""Targets that take everything: plain JSON and YAML."""

import json

import numpy as np

from ftcalib import CalibrationResult
from ftcalib.files import JSON
from ftdrive import __version__
from ftdrive.exports.calibration.settings import Settings
from ftdrive.exports.calibration.text import Exported, yaml_text
from ftdrive.runs.verification_record import marks_of

FORMAT = "ftdrive.export/1"

_FIELDS = (
    *("mass_kg", "g_m_s2", "weight_N", "gravity_force_base_N"),
    *("R_flange_sensor", "p_sensor_com_m", "force_bias_N", "torque_bias_Nm"),
)
"""Named and defined as in a calibration file."""


def as_json(calibration: CalibrationResult, settings: Settings) -> Exported:
    """Write a JSON object for a program of the user.

    Reader: none in particular. With u = R_flange_sensor^T R_base_flange^T gravity_force_base_N, the weight in the
    sensor frame, and zeros where there is no `response`:

        force = raw - force_bias_N - u - force_gain u
        torque = raw - torque_bias_Nm - p_sensor_com_m x u - cross_talk_m u
    """
    return Exported(json.dumps(_document(calibration, settings), indent=1, allow_nan=False) + "\n")


def as_yaml(calibration: CalibrationResult, settings: Settings) -> Exported:
    """Write the object of `as_json` as YAML, with the same fields and formula."""
    return Exported(yaml_text(_document(calibration, settings)))


def _document(calibration: CalibrationResult, settings: Settings) -> dict[str, JSON]:
    result = calibration.to_dict()
    response = calibration.response
    origin_m = None if settings.height_mm is None else settings.p_flange_sensor_m("json").tolist()
    made, last = calibration.provenance.get("created_utc"), settings.verification
    return {
        "format": FORMAT,
        "id": calibration.id,
        "marks": list(marks_of(calibration)),
        "created_utc": made if isinstance(made, str) else None,
        "verification": None
        if last is None
        else {"created_utc": last.created_utc.isoformat(), "passed": last.passed, "change": last.change},
        "made_by": f"ftdrive {__version__}",
        "sign": "wrench on the sensor, sensor axes, about the sensor origin; contact = raw - bias - weight",
        **{name: result[name] for name in _FIELDS},
        "p_flange_sensor_m": origin_m,
        "response": None
        if response is None
        else {"force_gain": response.force_gain.tolist(), "cross_talk_m": response.cross_talk_m.tolist()},
        "sigma": {name: np.asarray(value).tolist() for name, value in calibration.sigma.items()},
    }
