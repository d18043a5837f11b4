"""Checks of a force/torque sensor."""

import math
import shlex
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ftcalib import CalibrationDataset
from ftcalib.data.dwell_mean import LEAST_SAMPLES, is_stationary, mean_and_covariance
from ftcalib.poses.information import Guess, predicted_sigma, special
from ftdrive.cell.config import CellConfig
from ftdrive.cell.emulated import Station
from ftdrive.checks.check import Check, State, check_diagnosis, who
from ftdrive.checks.computer import SensorAddress, latency_command
from ftdrivers.errors import (
    ConnectError,
    DeviceError,
    DeviceFault,
    DeviceTimeout,
    PortInUse,
    ProtocolError,
    StreamBroken,
)
from ftdrivers.interfaces import Array, DeviceInfo, Fact, ForceTorqueSensor, FtSamples, Health, RobotArm

# Function that returns the failed check of a given name for an error from a sensor's driver.
Blame = Callable[[str, DeviceError], Check]

_LOOK_S: Final = 2.0
_PUSH_N = 2.0
PUSH_S: Final = 3.0
_PUSH_WINDOW_S: Final = 0.2
_SIMULATED_PUSH_N, _SIMULATED_PUSH_S = 15.0, 0.6
_BETTER_NETWORK = "give the sensor a network of its own, or run fewer programs on this computer"
_RATE_TOLERANCE = 0.1
_MUCH_NOISE: Final = 2.0
_LOAD: Final = 0.8
# A session stops the arm if an axis of the sensor exceeds this fraction of its range.
SATURATION: Final = 0.9
_MUCH_AT_REST: Final = 0.5
# If the force at rest is below this fraction of the tool's weight, the wrench was probably compensated or zeroed.
_COMPENSATED: Final = 0.1
AXES: Final = ("Fx", "Fy", "Fz", "Tx", "Ty", "Tz")


_SOURCE = {
    "device": "reported by the device",
    "documented": "fixed by its manual",
    "configured": "configured",
    "assumed": "assumed",
}


def check_identity(info: DeviceInfo) -> list[Check]:
    """Return checks of the identity of a sensor, and of the source of its scale, range and sign."""
    facts = info.facts
    identity = Check("sensor.identity", "ok", who(info))
    if "serial" not in facts:
        fix = "add serial=… (from its label) to the sensor's address, so that a calibration names its sensor"
        identity = Check("sensor.identity", "warning", who(info), fix)
    return [
        identity,
        _check_scale(facts.get("counts_per_N"), facts.get("counts_per_Nm")),
        _check_range(facts.get("range")),
        _check_sign(facts.get("sign")),
        *_check_settings(facts.get("software_bias"), facts.get("tool_transformation")),
    ]


def _check_scale(force: Fact | None, torque: Fact | None) -> Check:
    name = "sensor.counts"
    if force is None or torque is None:
        return Check(name, "ok", "the driver does not report its scale")
    found = f"{force.value:.7g} counts per N and {torque.value:.7g} per N·m, {_SOURCE[force.source]}"
    if force.source == "assumed":
        return Check(name, "warning", found, "compare with the calibration certificate, or hang a known weight on it")
    return Check(name, "ok", found)


def _check_range(fact: Fact | None) -> Check:
    name = "sensor.range"
    if fact is None or not isinstance(fact.value, tuple):
        fix = "add range=N,Nm from its data sheet to the sensor's address, such as range=300,30"
        return Check(name, "warning", "range unknown: overload is not monitored", fix)
    *force, tx, ty, tz = (f"{value:g}" for value in fact.value)
    return Check(name, "ok", f"±({', '.join(force)}) N, ±({tx}, {ty}, {tz}) N·m, {_SOURCE[fact.source]}")


def _check_sign(fact: Fact | None) -> Check:
    if fact is None:
        return Check("sensor.sign", "ok", "the driver does not report its sign")
    return Check("sensor.sign", "ok", f"sign {fact.value}, {_SOURCE[fact.source]}; --push shows whether it is right")


def _check_settings(bias: Fact | None, transformation: Fact | None) -> list[Check]:
    """Return checks of the software bias and tool transformation of the sensor, if it has any."""
    checks = []
    if bias is not None and isinstance(bias.value, tuple) and any(bias.value):
        numbers = ", ".join(f"{value:g}" for value in bias.value)
        found = f"the sensor subtracts its software bias ({numbers}): changing it invalidates a calibration"
        checks.append(Check("sensor.bias", "ok", found))
    if transformation is not None:
        found = f"the driver undoes the tool transformation of the sensor: {transformation.value}"
        checks.append(Check("sensor.origin", "ok", found))
    return checks


def check_tool_weight(limits: ArrayLike | None, cell: CellConfig) -> Check:
    """Check that twice the tool's weight, even at the end of the tool, fits into the sensor's range (6,)."""
    name, mass_kg = "sensor.load", cell.tool.mass_kg
    if limits is None or mass_kg is None:
        unknown = "[tool] mass_kg is not set" if mass_kg is None else "the sensor's range is unknown"
        return Check(name, "skipped", f"not compared with the tool's weight: {unknown}")
    range_N, range_Nm = np.split(np.asarray(limits, dtype=np.float64), 2)
    weight_N, length_m = mass_kg * cell.site.g_m_s2, max((row[1] for row in cell.tool.cylinders_mm), default=0.0) / 1e3
    share = max(2 * weight_N / range_N.min(), 2 * weight_N * length_m / range_Nm.min())
    found = f"twice the tool's weight is {100 * share:.0f} % of the sensor's range"
    return Check(name, "ok", found) if share <= _LOAD else Check(name, "failed", found, "use a larger sensor")


def check_rest(wrench: Array, limits: ArrayLike | None, cell: CellConfig, *, zero_is_arbitrary: bool) -> Check:
    """Check that the reading at rest (n, 6), N and N·m, leaves enough of the sensor's range (6,).

    Skipped if the range is None, or if the zero is arbitrary: the range then applies to changes of the reading.
    """
    name = "sensor.rest"
    if zero_is_arbitrary:
        found = "the zero of this sensor is arbitrary, so its range applies to changes of the reading"
        return Check(name, "skipped", found)
    if limits is None:
        return Check(name, "skipped", "not compared with the reading at rest: the sensor's range is unknown")
    rest, range_ = np.abs(wrench.mean(axis=0)), np.asarray(limits, dtype=np.float64)
    weight_N = (cell.tool.mass_kg or 0.0) * cell.site.g_m_s2
    needed = (rest + np.repeat([weight_N, 0.0], 3)) / range_
    axis = int(np.argmax(needed))
    share = rest[axis] / range_[axis]
    unit = "N" if axis < 3 else "N·m"
    found = f"at rest the sensor reads {rest[axis]:.1f} {unit} in {AXES[axis]}, {100 * share:.0f} % of its range"
    fix = "remove contact and load, check the screws and the configured range, then zero the sensor or use a larger one"
    if needed[axis] > SATURATION:
        return Check(name, "failed", found, fix)
    return Check(name, "ok", found) if share <= _MUCH_AT_REST else Check(name, "warning", found, fix)


def check_sensor_error(name: str, error: DeviceError, address: SensorAddress, permissions: Sequence[Check]) -> Check:
    """Return the failed check for an error from a sensor's driver, with a remedy.

    The remedy of the error comes first. If the sensor was not reached and a permission is missing, the remedy is that
    of the permission. Without either it is the usual remedy for errors of this kind.
    """
    kind = error.__cause__ if isinstance(error, ConnectError) and isinstance(error.__cause__, DeviceError) else error
    fix = error.fix
    permission = next((check.fix for check in permissions if check.state == "failed"), None)
    if permission is not None and not isinstance(kind, PortInUse | DeviceFault) and (_not_reached(kind) or not fix):
        fix = permission
    elif fix and isinstance(kind, DeviceTimeout):
        fix = f"{fix}; find out what answers at the address: {_who_answers(address)}"
    return Check(name, "failed", error.found, fix or _usual_fix(kind, address))


def _not_reached(error: BaseException) -> bool:
    """Return whether an error means that the device sent nothing; one about a wrong answer has no `__cause__`."""
    silent = isinstance(error, DeviceTimeout | StreamBroken)
    return silent or (isinstance(error, ConnectError) and error.__cause__ is not None)


def _usual_fix(error: BaseException, address: SensorAddress) -> str:
    if isinstance(error, DeviceFault):
        return "look up the fault in the sensor's manual, switch the sensor off and on, then run ftdrive doctor again"
    if isinstance(error, ProtocolError):
        return f"switch the sensor off and on, and check that its address is right: {_who_answers(address)}"
    return f"check the sensor's power supply and cable, then {_who_answers(address)}"


def _who_answers(address: SensorAddress) -> str:
    if address.host is not None:
        return f"run ping {address.host}"
    place = address.place
    return "run ftdrive doctor again" if place is None else f"run ftdrive devices --probe {shlex.quote(place)}"


def check_compensated(wrench: Array, cell: CellConfig) -> Check:
    """Check that a topic's wrench (n, 6) at rest is not near 0, as it is if weight and bias are already subtracted."""
    name, mass_kg = "sensor.compensated", cell.tool.mass_kg
    if mass_kg is None:
        return Check(name, "skipped", "[tool] mass_kg is not set, so compensation of the topic cannot be detected")
    force_N, weight_N = float(np.linalg.norm(np.mean(wrench, axis=0)[:3])), mass_kg * cell.site.g_m_s2
    found = f"the force at rest is {force_N:.1f} N, and the tool weighs {weight_N:.1f} N"
    if force_N > _COMPENSATED * weight_N:
        return Check(name, "ok", found)
    fix = "give the topic of the raw wrench, or disable its compensation; subtracting a constant does no harm"
    return Check(name, "warning", f"{found}: the topic is already compensated or zeroed", fix)


def check_stream(samples: FtSamples, health: Health, address: SensorAddress, duration_s: float) -> list[Check]:
    """Return checks of a recording of `duration_s`: rate, lost samples, age and status."""
    return [
        check_rate(len(samples) / duration_s, health.nominal_rate_Hz, address),
        _check_lost(health, address),
        Check("sensor.age", "ok", f"the newest sample is {1e3 * health.age_s:.1f} ms old"),
        _check_status(samples.status),
    ]


def check_rate(rate_Hz: float, nominal_Hz: float, address: SensorAddress | None = None) -> Check:
    """Check that the measured rate of a sensor is near the nominal one."""
    if math.isnan(nominal_Hz):
        return Check("sensor.rate", "ok", f"{rate_Hz:.0f} Hz; the sensor has no nominal rate")
    found, share = f"{rate_Hz:.1f} Hz (nominal {nominal_Hz:g})", rate_Hz / nominal_Hz
    if 1 - _RATE_TOLERANCE / 2 < share < 1 + _RATE_TOLERANCE:
        return Check("sensor.rate", "ok", found)
    port = None if address is None else address.serial_port
    fix = "close other programs, and try another USB port or cable"
    if address is None:
        fix = "run `ftdrive doctor`, which names likely causes"
    elif share > 1:
        fix = "samples are duplicated, or the sensor has another rate: set its rate, then run ftdrive doctor again"
    elif address.host is not None:
        fix = _BETTER_NETWORK
    elif port is not None and (tty := port.resolve().name).startswith("ttyUSB"):
        fix = latency_command(tty)
    return Check("sensor.rate", "failed" if abs(share - 1) > _RATE_TOLERANCE else "warning", found, fix)


def _check_lost(health: Health, address: SensorAddress) -> Check:
    odd = ((health.out_of_order, "out of order"), (health.duplicated, "duplicated"))
    also = "".join(f", {count} {how}" for count, how in odd if count)
    found = f"{health.lost} lost, {health.malformed} damaged of {health.received}{also}"
    gone = max(health.lost, health.malformed, health.out_of_order)
    if not gone and not health.duplicated:
        return Check("sensor.lost", "ok", found)
    state: State = "failed" if gone > 0.01 * health.received else "warning"  # duplicates are not losses
    fix = "check the cable, its shield and the termination of the bus" if address.host is None else _BETTER_NETWORK
    if address.scheme == "ati-can":  # the sensor is polled
        fix += ", or run fewer programs on this computer: an answer that is read too late is also lost"
    return Check("sensor.lost", state, found, fix)


def _check_status(status: NDArray[np.uint32]) -> Check:
    found = f"status {', '.join(f'0x{int(word):x}' for word in np.unique(status))}"
    if not status.any():
        return Check("sensor.status", "ok", found)
    return Check("sensor.status", "warning", found, "look up the bits in the sensor's manual; the driver continues")


def check_noise(wrench: Array, duration_s: float, average_s: float, guess: Guess) -> list[Check]:
    """Return checks of the noise at rest, and of the accuracy that a calibration with poses of `average_s` would have.

    `guess` has the assumed mass, and the accuracies of the sensor and the arm; its noise is not used.
    """
    level = check_level(wrench)
    if level.state == "failed":
        return [level]
    variance = np.diag(mean_and_covariance(wrench).covariance) * duration_s / average_s
    force_N, torque_Nm = (float(np.sqrt(variance[axes].mean())) for axes in (slice(3), slice(3, 6)))
    guess = replace(guess, sigma_force_N=force_N, sigma_torque_Nm=torque_Nm)
    expected = predicted_sigma(special(range(1, 25)), guess)
    com_mm, turn_deg = (
        factor * float(np.max(np.abs(expected.sigma[key])))
        for key, factor in (("p_sensor_com_m", 1e3), ("R_flange_sensor", 180 / np.pi))
    )
    mass_g = 1e3 * float(np.max(expected.sigma["mass_kg"]))
    off = f"a sensor gain error of {100 * guess.gain_sigma:.2g} %"
    accuracy = (
        f"for {guess.mass_kg:g} kg, 24 poses of {average_s:g} s and {off}, "
        f"one sigma: mass {mass_g:.2g} g, centre of mass {com_mm:.2g} mm, mounting {turn_deg:.2g}°"
    )
    return [level, Check("noise.accuracy", "ok", accuracy)]


def check_noise_change(wrench: Array, dataset: CalibrationDataset) -> Check:
    """Check that the noise of the resting sensor (n, 6) has not grown since a calibration.

    The comparison uses the variance of a mean times its number of samples, which is independent of the averaging time.
    """
    name = "noise.change"
    if dataset.wrench_cov is None or not (sampled := dataset.n_samples > 0).any():
        return Check(name, "skipped", "the noise of the calibration is unknown")
    if len(wrench) < LEAST_SAMPLES or not is_stationary(wrench):
        return Check(name, "skipped", "the reading is not steady")
    then = np.einsum("nii,n->ni", dataset.wrench_cov[sampled], dataset.n_samples[sampled])
    now = np.diag(mean_and_covariance(wrench).covariance) * len(wrench)
    ratio = np.sqrt(now / np.median(then, axis=0))
    most = int(np.argmax(ratio))
    found = f"noise is {ratio[most]:.1f} times that of the calibration in {AXES[most]}"
    if ratio[most] < _MUCH_NOISE:
        return Check(name, "ok", found)
    return Check(name, "warning", found, "look for vibration and loose cables, then run ftdrive doctor")


def check_level(wrench: Array) -> Check:
    """Check that the samples (n, 6) of a resting sensor are finite and steady, and that all six axes show noise."""
    name = "noise.level"
    if len(wrench) < LEAST_SAMPLES:
        return Check(name, "failed", f"only {len(wrench)} samples", "check the rate of the sensor")
    if not np.isfinite(wrench).all():
        return Check(name, "failed", "the sensor sends values that are not numbers", "check its cable and power supply")
    if dead := [AXES[i] for i in np.flatnonzero(np.ptp(wrench, axis=0) == 0)]:
        found = f"{', '.join(dead)} did not change: the sensor is stuck"
        return Check(name, "failed", found, "switch the sensor off and on")
    sigma = wrench.std(axis=0, ddof=1)
    force, torque = ", ".join(f"{s:.4f}" for s in sigma[:3]), ", ".join(f"{s:.5f}" for s in sigma[3:])
    found = f"σ ({force}) N, ({torque}) N·m"
    if not is_stationary(wrench):
        return Check(name, "warning", f"{found}, but not steady", "keep hands and cables off it, and let it warm up")
    return Check(name, "ok", found)


def examine_sensor(
    sensor: ForceTorqueSensor, address: SensorAddress, cell: CellConfig, guess: Guess, blame: Blame
) -> tuple[list[Check], bool]:
    """Open a sensor; return all checks at rest, and whether the sensor measures. `guess` is as in `check_noise`."""
    checks: list[Check] = []
    name = "sensor.identity"
    try:
        sensor.open()
        info = sensor.identify()
        checks += check_identity(info)
        name = "sensor.stream"
        checks += [check_diagnosis(diagnosis, "sensor") for diagnosis in sensor.diagnose()]
        samples = sensor.collect(_LOOK_S)
        health = sensor.health()
    except DeviceError as error:
        return [*checks, blame(name, error)], False
    fact = info.facts.get("range")
    limits = None if fact is None else np.asarray(fact.value, dtype=np.float64)
    return [
        *checks,
        check_tool_weight(limits, cell),
        check_rest(samples.wrench, limits, cell, zero_is_arbitrary=info.has_arbitrary_zero),
        *([check_compensated(samples.wrench, cell)] if address.scheme == "ros2" else []),
        *check_stream(samples, health, address, _LOOK_S),
        *check_noise(samples.wrench, _LOOK_S, cell.sampling.average_s, guess),
    ], True


def examine_push(
    sensor: ForceTorqueSensor | None,
    arm: RobotArm | None,
    R_flange_sensor: Array | None,
    sign: int,
    station: Station | None,
    is_pushing: Callable[[], bool],
    blame: Blame,
) -> tuple[Check, dict[str, Any] | None]:
    """Measure a push along +X of the base, and return the result of `check_push`.

    An emulated cell pushes by itself. Otherwise `is_pushing` asks for the push, and returns whether it will follow.
    """
    if sensor is None:
        return Check("push.sign", "skipped", "the sensor does not measure"), None
    try:
        R_base_flange = None if arm is None else arm.state().R_base_flange
    except DeviceError:
        R_base_flange = None  # the check robot.flange reports that the pose is unknown
    try:
        before = sensor.collect(1.0).wrench[:, :3].mean(axis=0)
        with ExitStack() as stack:
            if station is None:
                if not is_pushing():
                    return Check("push.sign", "skipped", "no push: the standard input is closed"), None
            elif R_base_flange is not None and R_flange_sensor is not None:
                force = (R_base_flange @ R_flange_sensor).T @ [_SIMULATED_PUSH_N, 0.0, 0.0]
                station.control(do="push", wrench=[*force.tolist(), 0.0, 0.0, 0.0])
                stack.callback(station.control, do="push", wrench=[0.0] * 6)
            windows = round((PUSH_S if station is None else _SIMULATED_PUSH_S) / _PUSH_WINDOW_S)
            pieces = (sensor.collect(_PUSH_WINDOW_S).wrench[:, :3] for _ in range(windows))
            changes = [force_N.mean(axis=0) - before for force_N in pieces]
    except DeviceError as error:
        return blame("push.sign", error), None
    largest = max(changes, key=lambda change: float(np.linalg.norm(change)))
    return check_push(largest, R_base_flange, R_flange_sensor, sign)


def check_push(
    change: Array, R_base_flange: Array | None, R_flange_sensor: Array | None, sign: int
) -> tuple[Check, dict[str, Any]]:
    """Check the sign of a sensor by a push along +X of the base, in which direction the force must change.

    `change` is the force during the push minus that before it, N, sensor axes. Unknown orientations are None; `sign` is
    the configured one. The second result has, for sensor, flange and base axes, force_N and the axis of the largest
    change, such as "-Y"; None for unknown axes.
    """
    flange = None if R_flange_sensor is None else R_flange_sensor @ change
    base = None if flange is None or R_base_flange is None else R_base_flange @ flange
    moved = {
        frame: None if force is None else {"force_N": force.tolist(), "axis": _largest_axis(force)}
        for frame, force in (("sensor", change), ("flange", flange), ("base", base))
    }
    words = ", ".join(f"{frame} {'unknown' if it is None else it['axis']}" for frame, it in moved.items())
    size_N = float(np.linalg.norm(change))
    found = f"{size_N:.1f} N: {words}"
    if size_N < _PUSH_N:
        return Check("push.sign", "failed", found, f"push again with more than {_PUSH_N:g} N, and hold"), moved
    if base is None:
        return Check("push.sign", "skipped", found, "give --calibration FILE, which contains the mounting"), moved
    if abs(base[0]) < 0.8 * size_N:
        fix = "push along +X of the base; if you did, the sensor is mounted differently: run ftdrive calibrate"
        return Check("push.sign", "failed", found, fix), moved
    if base[0] < 0:
        fix = f"set sign = {-sign} under [sensor] in the configuration, then calibrate again"
        return Check("push.sign", "failed", f"{found}: the sensor reports the reaction force", fix), moved
    return Check("push.sign", "ok", found), moved


def _largest_axis(force: Array) -> str:
    i = int(np.argmax(np.abs(force)))
    return ("-" if force[i] < 0 else "+") + "XYZ"[i]
