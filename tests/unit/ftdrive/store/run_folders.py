"""Run folders with calibrations and verifications, without a session."""

import json
from collections.abc import Mapping
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np

from ftcalib import CalibrationResult
from ftcalib.model import Array
from ftdrive.runs.run import RUN_FORMAT
from tests.unit.ftdrive.stream.simulated import calibrated

FIRST = datetime(2026, 3, 1, tzinfo=UTC)


def result(
    day: float = 0.0,
    step: Array | None = None,
    *,
    tool: str | None = "gripper",
    serials: tuple[str, str] = ("arm-1", "ft-1"),
    mount: str | None = None,
    **provenance: Any,
) -> CalibrationResult:
    """A calibration of some day; `step` (15,) moves its numbers, otherwise its noise does."""
    base = calibrated()
    noise = np.random.default_rng(round(100 * day) + 7).multivariate_normal(np.zeros(15), base.covariance)
    devices = {
        role: {"model": role.upper(), "serial": serial, "firmware": "1", "facts": {}}
        for role, serial in zip(("arm", "sensor"), serials, strict=True)
    }
    about = {
        "created_utc": (FIRST + timedelta(days=day)).isoformat(),
        "devices": devices,
        "setup": {"payload_kg": None, "sensor_mass_kg": None, "mounting": None, "tool": tool, "mount": mount},
        **base.provenance,
        **provenance,
    }
    return replace(base, parameters=base.parameters.moved(noise if step is None else step), provenance=about)


def new_run(runs: Path, name: str, calibration: CalibrationResult | None = None) -> Path:
    """Make a run folder."""
    folder = runs / name
    (folder / "poses").mkdir(parents=True)
    (folder / "run.json").write_text(json.dumps({"format": RUN_FORMAT, "created_utc": FIRST.isoformat()}))
    if calibration is not None:
        calibration.save(folder / "calibration.json")
    return folder


def verified(folder: Path, calibration_id: str, day: float = 1.0, *, passed: bool = True, **more: Any) -> None:
    """Add a verification to a run folder."""
    document: Mapping[str, Any] = {
        "format": "ftdrive.verification/1",
        "calibration": {"id": calibration_id, "path": "elsewhere"},
        "created_utc": (FIRST + timedelta(days=day)).isoformat(),
        "passed": passed,
        "change": None if passed else "bias",
        "reason": "the prediction holds" if passed else "the force bias has changed by 0.5 N",
        "force_max_N": 0.1,
        "torque_max_Nm": 0.01,
        **more,
    }
    (folder / "verification.json").write_text(json.dumps(document))
