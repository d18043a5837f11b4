"""Named tools: the newest accepted calibration of a tool on this arm, sensor and mount."""

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

# Folder that is searched in addition to the store, for runs that are not in the store yet.
RUNS = Path("runs")


@dataclass(frozen=True, slots=True, eq=False)
class Tool:
    """The calibration that was found for a named tool, with what the store knows of the sensor."""

    calibration: CalibrationResult
    path: Path
    warnings: tuple[str, ...]
    temperature: BiasTemperature | None = None
    """Dependence of the sensor's bias on temperature; None unless it was shown to predict the bias of other runs."""
    hour_change: Array | None = None
    """(6,) standard deviation of the bias change in one hour, N and N·m; None if there are too few runs."""


def calibration_of_tool(
    name: str,
    arm: DeviceInfo,
    sensor: DeviceInfo,
    mount: str | None = None,
    *,
    url: str | None = None,
    force: bool = False,
) -> Tool:
    """Return the newest accepted calibration of a tool, a `[tool] name`, on this arm, sensor and `[sensor] mount`.

    With `force`, if this arm and sensor have none, use the newest one of any, even if edited by hand. `url` is the
    address of the store. If there is no calibration, raises `ConfigError`, whose message names the tools calibrated on
    this arm and sensor.
    """
    store, warnings = Store(url), list[str]()
    results: list[StoredResult] = []
    try:
        results = store.results()
    except BadStore as error:
        warnings.append(f"only the run folders in {RUNS} are searched, because {error}")
    indexed = {result.path for result in results}
    unindexed, _ = read_records(path for path in record_paths([RUNS]) if str(path) not in indexed)
    results += [result for result in unindexed if isinstance(result, StoredResult)]
    accepted = sorted(
        (row for row in results if row.verdict != "rejected"), key=lambda row: row.created_utc or "", reverse=True
    )
    ours = [result for result in accepted if _may_belong(result, arm, sensor)]
    for result in (result for result in ours if result.tool == name):
        loaded = _load_result(result)
        if loaded and not compare_devices(loaded, {"arm": arm, "sensor": sensor}, mount).others:
            return Tool(
                loaded, Path(result.path), (*warnings, *_failed(store, result)), *_of_sensor(store, result, results)
            )
    if force:
        for result in (result for result in accepted if result.tool == name):
            if loaded := _load_result(result, accept_edited=True):
                return Tool(loaded, Path(result.path), (*warnings, *_failed(store, result)))
    known = sorted({result.tool for result in ours if result.tool and result.tool != name})
    instead = f", or choose one of {', '.join(known)}" if known else ""
    raise ConfigError(
        f"there is no accepted calibration of the tool '{name}' with the arm {arm.serial}, the sensor {sensor.serial} "
        f"and {'no mount label' if mount is None else f'the mount {mount!r}'}: calibrate it with [tool] name = "
        f'"{name}"{instead}'
    )


def _may_belong(result: StoredResult, arm: DeviceInfo, sensor: DeviceInfo) -> bool:
    """Return whether no known serial number of a stored result differs from that of the arm or the sensor."""
    pairs: Iterable[tuple[str | None, str]] = ((result.arm_serial, arm.serial), (result.sensor_serial, sensor.serial))
    return all(made == now or made in {None, NOT_REPORTED} or now == NOT_REPORTED for made, now in pairs)


def _load_result(result: StoredResult, *, accept_edited: bool = False) -> CalibrationResult | None:
    try:
        return with_sensor(CalibrationResult.load(Path(result.path), accept_edited=accept_edited))
    except (BadCalibration, OSError):
        return None


def _of_sensor(
    store: Store, result: StoredResult, results: Iterable[StoredResult]
) -> tuple[BiasTemperature | None, Array | None]:
    """Return, from all runs of a result's sensor, the bias's temperature dependence and its change in one hour."""
    key = (result.sensor_serial, result.arm_serial, result.mount)
    of_sensor = [other for other in results if (other.sensor_serial, other.arm_serial, other.mount) == key]
    try:
        checks = [check for other in of_sensor for check in store.verifications(other.id)]
    except BadStore:
        return None, None
    fit, hour_change = next(iter(sensor_biases(of_sensor, checks).values()), (None, None))
    is_known = result.temperature_C is not None and fit is not None and any(fit.predicts)
    return fit if is_known else None, hour_change


def _failed(store: Store, result: StoredResult) -> Iterator[str]:
    """Yield one warning if the last verification of a result failed, else nothing."""
    try:
        last = store.last_verification(result.id)
    except BadStore:
        return
    if last is not None and not last.passed:
        yield f"the last verification of this calibration failed: {last.reason or f'see {last.path}'}; calibrate again"
