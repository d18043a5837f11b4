"""Named tools: the newest accepted calibration of a tool on this arm, with this sensor and mount."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from ftcalib import CalibrationResult
from ftcalib.after.series import BiasTemperature
from ftcalib.errors import BadCalibration
from ftdrive.checks.check import compare_devices
from ftdrive.errors import BadStore, ConfigError
from ftdrive.runs.calibration import with_sensor
from ftdrive.store.records import StoredResult, read_records, record_paths
from ftdrive.store.store import Store
from ftdrive.store.trends import sensor_biases
from ftdrivers.interfaces import NOT_REPORTED, Array, DeviceInfo

# Searched beside the store, so that a run that is not indexed yet counts too.
RUNS = Path("runs")


@dataclass(frozen=True, slots=True, eq=False)
class Tool:
    """A calibration that was found by the name of its tool."""

    calibration: CalibrationResult
    path: Path
    warnings: tuple[str, ...]
    temperature: BiasTemperature | None = None
    """How the bias of the sensor follows its temperature, where that predicts other runs better."""
    hour_change: Array | None = None
    """(6,) how far that bias moves in an hour, one standard deviation, N and N·m; None where no runs show it."""


def calibration_of_tool(
    name: str,
    arm: DeviceInfo,
    sensor: DeviceInfo,
    mount: str | None = None,
    *,
    url: str | None = None,
    force: bool = False,
) -> Tool:
    """Return the newest accepted calibration of a tool, a `[tool] name`, on these devices and this `[sensor] mount`.

    With `force`, if none is of these devices, it is the newest of any, also one that was edited by hand. `url` is that
    of the store. Raises `ConfigError` if there is none, with the tools that are calibrated on these devices.
    """
    # A tool is a name in its runs, so nothing has to be edited after a calibration.
    store, warnings = Store(url), list[str]()
    results: list[StoredResult] = []
    try:
        results = store.results()
    except BadStore as error:
        warnings.append(f"the run folders in {RUNS} are searched, because {error}")
    indexed = {one.path for one in results}
    unindexed, _ = read_records(path for path in record_paths([RUNS]) if str(path) not in indexed)
    results += [one for one in unindexed if isinstance(one, StoredResult)]
    accepted = sorted(
        (one for one in results if one.verdict != "rejected"), key=lambda one: one.created_utc or "", reverse=True
    )
    ours = [one for one in accepted if _may_belong(one, arm, sensor)]
    for one in (one for one in ours if one.tool == name):
        if (loaded := _load_result(one)) and not compare_devices(loaded, {"arm": arm, "sensor": sensor}, mount).others:
            return Tool(loaded, Path(one.path), (*warnings, *_failed(store, one)), *_of_sensor(store, one, results))
    if force:
        for one in (one for one in accepted if one.tool == name):
            if loaded := _load_result(one, accept_edited=True):
                return Tool(loaded, Path(one.path), (*warnings, *_failed(store, one)))
    known = sorted({one.tool for one in ours if one.tool and one.tool != name})
    instead = f", or choose one of {', '.join(known)}" if known else ""
    raise ConfigError(
        f"there is no accepted calibration of the tool '{name}' with the arm {arm.serial}, the sensor {sensor.serial} "
        f"and {'no mount label' if mount is None else f'the mount {mount!r}'}: calibrate it with [tool] name = "
        f'"{name}"{instead}'
    )


def _may_belong(one: StoredResult, arm: DeviceInfo, sensor: DeviceInfo) -> bool:
    """Compare serial numbers, without reading the file."""
    pairs: Iterable[tuple[str | None, str]] = ((one.arm_serial, arm.serial), (one.sensor_serial, sensor.serial))
    return all(made == now or made in {None, NOT_REPORTED} or now == NOT_REPORTED for made, now in pairs)


def _load_result(one: StoredResult, *, accept_edited: bool = False) -> CalibrationResult | None:
    try:
        return with_sensor(CalibrationResult.load(Path(one.path), accept_edited=accept_edited))
    except (BadCalibration, OSError):
        return None


def _of_sensor(
    store: Store, one: StoredResult, results: Iterable[StoredResult]
) -> tuple[BiasTemperature | None, Array | None]:
    """Return what other runs of the sensor show: how its bias follows a known temperature, and moves in an hour."""
    same = (one.sensor_serial, one.arm_serial, one.mount)
    alike = [each for each in results if (each.sensor_serial, each.arm_serial, each.mount) == same]
    try:
        checks = [check for each in alike for check in store.verifications(each.id)]
    except BadStore:
        return None, None
    fit, hour_change = next(iter(sensor_biases(alike, checks).values()), (None, None))
    is_known = one.temperature_C is not None and fit is not None and any(fit.predicts)
    return fit if is_known else None, hour_change


def _failed(store: Store, one: StoredResult) -> Iterator[str]:
    """Yield a warning if the last verification has failed."""
    try:
        last = store.last_verification(one.id)
    except BadStore:
        return
    if last is not None and not last.passed:
        yield f"the last verification of this calibration failed: {last.reason or f'see {last.path}'}; calibrate again"
