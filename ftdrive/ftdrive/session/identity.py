"""Checks of the connected devices: a resumed run has its own, and a verification those of its calibration."""

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any, Final

import numpy as np

from ftcalib import CalibrationResult
from ftdrive.cell.config import SensorConfig
from ftdrive.checks.devices import belonging
from ftdrive.errors import ConfigError, PlanRefused
from ftdrive.runs.run import Run
from ftdrivers.interfaces import NOT_REPORTED, DeviceInfo
from ftdrivers.registry import Options, split_url

_CHOOSES_CALIBRATION: Final = {"slot": 0, "calibration": 1}
"""Options of a sensor's address that choose one of its calibrations, with their defaults."""
_OF_NUMBERS: Final = ("counts_per_N", "counts_per_Nm", "range", "software_bias")
"""Facts that differ for another scale or calibration."""


def require_devices(
    connected: Mapping[str, DeviceInfo], config: SensorConfig, *, calibration: CalibrationResult | None, run: Run | None
) -> tuple[str, ...]:
    """Return what is uncertain about the connected devices, where a calibration or a resumed run must have the same.

    Raises
    ------
    ConfigError
        Arm, sensor or mounting is not that of the calibration.
    PlanRefused
        As `_require_same_devices`.
    """
    belongs = None if calibration is None else belonging(calibration, connected, config.mount)
    if belongs is not None and belongs.others:
        raise ConfigError(f"{belongs.others[0]}: calibrate this cell")
    if run is not None:
        _require_same_devices(run, config, connected)
    return () if belongs is None else belongs.unknown


def _require_same_devices(run: Run, config: SensorConfig, connected: Mapping[str, DeviceInfo]) -> None:
    """Raise `PlanRefused` for other devices than those of the run, or a sensor that is scaled otherwise now.

    Without a serial number a device counts as the same if its model is, and the run has no serial number either.
    """
    header = run.header()
    devices = header["devices"]
    for name, info in connected.items():
        model, serial = devices[name]["model"], devices[name]["serial"]
        if (model, serial) == (info.model, info.serial):
            continue
        fix = "connect that of the run"
        if name == "sensor" and NOT_REPORTED in {serial, info.serial}:
            fix += ", or set serial=… in its address as in the run"
        raise PlanRefused(
            f"the run was made with the {name} {model}, serial {serial}, connected is {info.model}, serial "
            f"{info.serial}: {fix}, or start a new run"
        )
    then = _meaning(header["config"]["sensor"], devices["sensor"].get("facts", {}))
    now = _meaning(asdict(config), asdict(connected["sensor"])["facts"])
    if other := [name for name in then if name in now and not np.array_equal(then[name], now[name])]:
        changes = " and ".join(f"{name} was {then[name]} and is {now[name]}" for name in other)
        raise PlanRefused(
            f"the sensor is configured otherwise than in the run, {changes}: set it back, or start a new run"
        )


def _meaning(config: Mapping[str, Any], facts: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Return what defines a sensor's values: sign, calibration, scale and range."""
    options = Options(config["url"], split_url(config["url"]).query)
    chosen = {f"option {name}": options.integer(name, usual, 0, 255) for name, usual in _CHOOSES_CALIBRATION.items()}
    scale = {name: fact["value"] for name, fact in facts.items() if name in _OF_NUMBERS}
    return {"[sensor] sign": config.get("sign", 1), **chosen, **scale}
