"""Differences between two results as facts of a report."""

from dataclasses import asdict
from typing import Any

import numpy as np

from ftcalib import CalibrationResult
from ftcalib.after.series import difference
from ftcalib.model import PARAMETER_NAMES

NAMES = {
    "R_flange_sensor": "mounting of the sensor",
    "gravity_force_base_N": "weight in base",
    "force_bias_N": "force bias",
    "p_sensor_com_m": "centre of mass",
    "torque_bias_Nm": "torque bias",
}


def compared(result: CalibrationResult, before: CalibrationResult) -> dict[str, Any]:
    """Compare a result with an earlier one of other data.

    Returns
    -------
    dict
        `parameters`: for each error coordinate its `name`, `change` (rad, N, m, N·m) and `sigmas`, null if it was known
        exactly in both; `groups`: `name`, `chi2`, `dof`, `p_value`; `same_data`: whether both rest on one dataset, so
        that the test does not apply.
    """
    found = difference(before, result)
    data = [one.provenance.get("dataset_sha256") for one in (result, before)]
    tests = {NAMES[name]: test for name, test in found.groups.items() if test.dof} | {"all": found.joint}
    return {
        "id": before.id,
        "verdict": before.verdict,
        "created_utc": before.provenance.get("created_utc"),
        "mass_kg": before.mass_kg,
        "same_data": data[0] is not None and data[0] == data[1],
        "parameters": [
            {"name": name, "change": change, "sigmas": sigmas if sigma > 0 and np.isfinite(sigmas) else None}
            for name, change, sigma, sigmas in zip(
                PARAMETER_NAMES, found.change.tolist(), found.sigma.tolist(), found.in_sigmas.tolist(), strict=True
            )
        ],
        "groups": [{"name": name, **asdict(test)} for name, test in tests.items()],
    }
