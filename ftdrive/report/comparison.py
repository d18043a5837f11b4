"""Differences between two results in standard deviations, each group of parameters tested jointly."""

from typing import Any

import numpy as np
from scipy.special import chdtrc as chi2_sf

from calib import CalibrationResult
from calib.model import PARAMETER_NAMES, Array

GROUPS = (
    ("mounting of the sensor", slice(0, 3)),
    ("weight in base", slice(3, 6)),
    ("force bias", slice(6, 9)),
    ("centre of mass", slice(9, 12)),
    ("torque bias", slice(12, 15)),
    ("all but the biases", [*range(6), 9, 10, 11]),
    ("all", slice(0, 15)),
)
"""Of the error coordinates. A bias drifts from day to day, the rest should not."""
KNOWN_EXACTLY = 1e-9
"""Share of the largest sigma below which a parameter was taken as known."""


def compared(result: CalibrationResult, before: CalibrationResult) -> dict[str, Any]:
    """Compare a result with an earlier one of other data.

    The covariance of the difference is the sum of both. A group that no uncertain parameter belongs to is left out.

    Returns
    -------
    dict
        `parameters`: for each error coordinate its `name`, `change` (rad, N, m, N·m) and `sigmas`, null if it was known
        exactly in both; `groups`: `name`, `chi2`, `dof`, `p_value`; `same_data`: whether both rest on one dataset, so
        that the test does not apply.
    """
    change = before.parameters.difference(result.parameters)
    covariance = before.covariance + result.covariance
    sigma = np.sqrt(np.diag(covariance))
    uncertain = sigma > KNOWN_EXACTLY * sigma.max()
    data = [one.provenance.get("dataset_sha256") for one in (result, before)]
    return {
        "id": before.id,
        "verdict": before.verdict,
        "created_utc": before.provenance.get("created_utc"),
        "mass_kg": before.mass_kg,
        "same_data": data[0] is not None and data[0] == data[1],
        "parameters": [
            {"name": name, "change": float(value), "sigmas": float(value / one) if sure else None}
            for name, value, one, sure in zip(PARAMETER_NAMES, change, sigma, uncertain, strict=True)
        ],
        "groups": [
            {"name": name} | _tested(change[rows], covariance[np.ix_(rows, rows)])
            for name, group in GROUPS
            if (rows := np.arange(15)[group][uncertain[group]]).size
        ],
    }


def _tested(change: Array, covariance: Array) -> dict[str, Any]:
    scale = np.sqrt(np.diag(covariance))
    inverse = np.linalg.pinv(covariance / np.outer(scale, scale), hermitian=True)
    chi2, dof = float((change / scale) @ inverse @ (change / scale)), len(change)
    return {"chi2": chi2, "dof": dof, "p_value": float(chi2_sf(dof, chi2))}
