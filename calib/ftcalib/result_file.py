"""Calibration files: their content, its conversion to a result, and detection of edits."""

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import numpy as np

from ftcalib.errors import BadCalibration
from ftcalib.files import JSON, check_format, is_changed
from ftcalib.findings import Finding
from ftcalib.model import PARAMETER_NAMES, Array, DriftResult, Parameters, read_only
from ftcalib.sensor_matrix import Response, SensorMatrix

_FORMAT = "ftdrive.calibration/2"
# Earlier format of the file, in which the bias of a session with drift is the mean bias.
_EARLIER = "ftdrive.calibration/1"

# Fields of a calibration file, in their order.
_NAMES = (
    *("id", "method", "verdict", "findings", "n_poses", "mass_kg", "weight_N", "gravity_force_base_N"),
    *("R_flange_sensor", "force_bias_N", "torque_bias_Nm", "p_sensor_com_m", "tilt_alpha_rad", "tilt_beta_rad"),
    *("sigma", "residual", "predicted_error", "chi2", "dof", "p_value", "noise_factor", "noise_source"),
    *("measured_sigma", "components", "drift", "mean_bias", "response", "gain_sigma", "sensor", "weighed_kg"),
    *("cable_shift", "weights", "rejected_poses", "second_basin_chi2", "p_wrong", "quality", "g_m_s2"),
    *("parameter_names", "covariance", "hidden_covariance", "residuals", "provenance"),
)
# Fields of a file that are read unchanged, and array fields. Files of version 0.1.0 and earlier lack some arrays.
_PLAIN = (
    *("chi2", "dof", "noise_source", "g_m_s2", "method", "provenance", "p_value", "components", "gain_sigma"),
    *("second_basin_chi2", "quality"),
)
_ARRAYS, _LATER_ARRAYS = ("covariance", "residuals", "measured_sigma", "weights"), ("cable_shift", "mean_bias")


def document_of(result: object, **computed: JSON) -> dict[str, JSON]:
    """Return the document of a static calibration file, from attributes of a result and computed values."""
    computed |= {"parameter_names": list(PARAMETER_NAMES)}
    values = {name: computed[name] if name in computed else _json(getattr(result, name)) for name in _NAMES}
    return {"format": _FORMAT, "schema_version": 1, **values}


def _json(value: Any) -> JSON:
    if isinstance(value, DriftResult):
        return {"change": value.change.tolist(), "sigma": value.sigma.tolist()}
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, Mapping):
        return {name: _json(each) for name, each in value.items()}
    if isinstance(value, tuple):
        return [_json(each) for each in value]
    return value.to_dict() if hasattr(value, "to_dict") else value


def fields_of(document: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of a static `CalibrationResult` from the document of a file; unknown fields are ignored."""
    if document.get("format") != _EARLIER:
        check_format(document, _FORMAT, BadCalibration)
    drift, response, sensor = document["drift"], document["response"], document.get("sensor")
    weighed_kg = document.get("weighed_kg")
    return {
        "parameters": Parameters(**{each.name: document[each.name] for each in fields(Parameters)}),
        **{name: document[name] for name in _PLAIN},
        **{name: _array(document[name]) for name in _ARRAYS},
        **{name: _array(document.get(name)) for name in _LATER_ARRAYS},
        "hidden_covariance": _array(document.get("hidden_covariance", np.zeros((15, 15)))),
        "findings": tuple(Finding.from_dict(finding) for finding in document["findings"]),
        "drift": None if drift is None else DriftResult(drift["change"], drift["sigma"]),
        "response": None if response is None else Response(response["coefficients"], response["covariance"]),
        "sensor": None if sensor is None else SensorMatrix.from_dict(sensor),
        "weighed_kg": None if weighed_kg is None else tuple(weighed_kg),
    }


def _array(value: Any) -> Array | None:
    return None if value is None else read_only(value)


def is_edited(document: Mapping[str, Any], derived: Mapping[str, JSON], *, accept: bool) -> bool:
    """Whether a document differs from its checksum or from derived values; raise `BadCalibration` unless accepted."""
    edited = is_changed(document) or any(document.get(name, value) != value for name, value in derived.items())
    if edited and not accept:
        raise BadCalibration(
            f"the content is not that of calibration {document.get('id')}: the file is damaged or was edited. Restore "
            "it from a copy, or apply it as it is with --force (live, record, stream, compensate, export)."
        )
    return edited
