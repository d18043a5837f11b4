"""Checks of arm and sensor, shared by `doctor`, preflight and `live`: functions of what was read; nothing is opened."""

import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import EllipsisType
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ftcalib import CalibrationDataset, CalibrationResult
from ftcalib.data.dwell_mean import LEAST_SAMPLES, is_stationary, mean_and_covariance
from ftcalib.judge import described_cell
from ftcalib.poses.information import Guess, predicted_sigma, special
from ftdrive.cell.config import CellConfig, RobotConfig, ToolConfig
from ftdrive.checks.check import Check, State
from ftdrive.checks.computer import SensorAddress, latency_command
from ftdrive.planning.geometry.kinematics import frames
from ftdrivers.clock import Clock
from ftdrivers.errors import (
    ConnectError,
    DeviceError,
    DeviceFault,
    DeviceTimeout,
    ModelUnknown,
    PortInUse,
    ProtocolError,
    StreamBroken,
)
from ftdrivers.interfaces import (
    NOT_REPORTED,
    ArmStatus,
    Array,
    DeviceInfo,
    Diagnosis,
    Fact,
    FtSamples,
    Health,
    RobotArm,
)
from ftdrivers.ur.kinematics import MODELS, kinematics_of

_PUSH_N = 2.0
_BETTER_NETWORK = "give the sensor a network of its own, or run fewer programs on this computer"
_RATE_TOLERANCE = 0.1
_MUCH_NOISE: Final = 2.0
_LOAD: Final = 0.8
SATURATION: Final = 0.9
"""Share of the sensor's range at which a session stops the arm."""
_MUCH_AT_REST: Final = 0.5
_COMPENSATED: Final = 0.1
"""A smaller share of the weight at rest is likely to be compensated or zeroed."""
_PAYLOAD_MM: Final = 100.0
"""The centre of the payload may be this far outside the described tool."""
_LINK_S: Final = 0.5
_LINK_TRIES: Final = 3
_POSTURES: Final = 200
"""Random ones, in which an arm is compared with its model."""
SLOWEST_SLIDER = 0.05
"""The time-outs of moves allow for this one."""
AXES: Final = ("Fx", "Fy", "Fz", "Tx", "Ty", "Tz")


# ---------------------------------------------------------------------------------------------------------- the sensor


_SOURCE = {
    "device": "reported by the device",
    "documented": "fixed by its manual",
    "configured": "configured",
    "assumed": "assumed",
}


def who(info: DeviceInfo) -> str:
    """Return a device's model, serial number and firmware in words."""
    return f"{info.model}, serial {info.serial}, firmware {info.firmware}"


def check_identity(info: DeviceInfo) -> list[Check]:
    """Check who a sensor is, and the source of its scale, range and sign."""
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
        fix = "add range=N,Nm of its data sheet to the sensor's address, such as range=300,30"
        return Check(name, "warning", "range unknown: overload is not monitored", fix)
    *force, tx, ty, tz = (f"{value:g}" for value in fact.value)
    return Check(name, "ok", f"±({', '.join(force)}) N, ±({tx}, {ty}, {tz}) N·m, {_SOURCE[fact.source]}")


def _check_sign(fact: Fact | None) -> Check:
    if fact is None:
        return Check("sensor.sign", "ok", "the driver does not report its sign")
    return Check("sensor.sign", "ok", f"sign {fact.value}, {_SOURCE[fact.source]}; --push shows whether it is right")


def _check_settings(bias: Fact | None, transformation: Fact | None) -> list[Check]:
    """Report what the sensor itself adds to or changes about its readings; nothing where it does not."""
    checks = []
    if bias is not None and isinstance(bias.value, tuple) and any(bias.value):
        numbers = ", ".join(f"{value:g}" for value in bias.value)
        found = f"the sensor subtracts its software bias ({numbers}): a calibration holds only while it stays"
        checks.append(Check("sensor.bias", "ok", found))
    if transformation is not None:
        found = f"the driver undoes the tool transformation of the sensor: {transformation.value}"
        checks.append(Check("sensor.origin", "ok", found))
    return checks


def check_load(limits: ArrayLike | None, cell: CellConfig) -> Check:
    """Check that twice the tool's weight, also at its end, fits into the sensor's range (6,); None is unknown."""
    name, mass_kg = "sensor.load", cell.tool.mass_kg
    if limits is None or mass_kg is None:
        unknown = "[tool] mass_kg is not set" if mass_kg is None else "the sensor's range is unknown"
        return Check(name, "skipped", f"not compared with the tool's weight: {unknown}")
    range_N, range_Nm = np.split(np.asarray(limits, dtype=np.float64), 2)
    weight_N, length_m = mass_kg * cell.site.g_m_s2, max((row[1] for row in cell.tool.cylinders_mm), default=0.0) / 1e3
    share = max(2 * weight_N / range_N.min(), 2 * weight_N * length_m / range_Nm.min())
    found = f"twice the tool's weight is {100 * share:.0f} % of the sensor's range"
    return Check(name, "ok", found) if share <= _LOAD else Check(name, "failed", found, "take a larger sensor")


def check_rest(wrench: Array, limits: ArrayLike | None, cell: CellConfig, *, zero_is_arbitrary: bool) -> Check:
    """Check that what a sensor reads at rest leaves enough of its range.

    Parameters
    ----------
    wrench : array, shape (n, 6)
        N and N·m.
    limits : array, shape (6,), optional
        The range; None is unknown.
    cell : CellConfig
        Has the mass of the tool, if that is known.
    zero_is_arbitrary : bool
        The range then holds for changes of the reading.
    """
    name = "sensor.rest"
    if zero_is_arbitrary:
        return Check(
            name, "skipped", "the zero of this sensor is arbitrary: its range holds for changes of the reading"
        )
    if limits is None:
        return Check(name, "skipped", "not compared with the reading at rest: the sensor's range is unknown")
    rest, range_ = np.abs(wrench.mean(axis=0)), np.asarray(limits, dtype=np.float64)
    weight_N = (cell.tool.mass_kg or 0.0) * cell.site.g_m_s2
    needed = (rest + np.repeat([weight_N, 0.0], 3)) / range_
    axis = int(np.argmax(needed))
    share = rest[axis] / range_[axis]
    unit = "N" if axis < 3 else "N·m"
    found = f"at rest the sensor reads {rest[axis]:.1f} {unit} in {AXES[axis]}, {100 * share:.0f} % of its range"
    fix = "take off what presses on the sensor, check its screws and its range, then zero it or take a larger one"
    if needed[axis] > SATURATION:
        return Check(name, "failed", found, fix)
    return Check(name, "ok", found) if share <= _MUCH_AT_REST else Check(name, "warning", found, fix)


def check_sensor_error(name: str, error: DeviceError, address: SensorAddress, permissions: Sequence[Check]) -> Check:
    """Return an error of a sensor's driver, and what to do about it.

    The error's own fix comes first. If the sensor was not reached and a permission is missing, that is the fix. If
    neither names one, it is the usual fix for errors of this kind.
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
    """Return whether nothing came from a device; one whose answer is refused raises an error without a cause."""
    silent = isinstance(error, DeviceTimeout | StreamBroken)
    return silent or (isinstance(error, ConnectError) and error.__cause__ is not None)


def _usual_fix(error: BaseException, address: SensorAddress) -> str:
    if isinstance(error, DeviceFault):
        return "look the fault up in the sensor's manual; switch it off and on, then ftdrive doctor again"
    if isinstance(error, ProtocolError):
        return f"switch the sensor off and on; is it the one its address names? {_who_answers(address)}"
    return f"check the sensor's supply and cable, then {_who_answers(address)}"


def _who_answers(address: SensorAddress) -> str:
    """Return the command that shows which device answers at an address."""
    if address.host is not None:
        return f"ping {address.host}"
    return "ftdrive doctor again" if address.place is None else f"ftdrive devices --probe {shlex.quote(address.place)}"


def check_compensated(wrench: Array, cell: CellConfig) -> Check:
    """Check that a topic's wrench (n, 6) at rest has the weight of the tool or a bias in it, and is not near 0."""
    name, mass_kg = "sensor.compensated", cell.tool.mass_kg
    if mass_kg is None:
        return Check(name, "skipped", "[tool] mass_kg is not set: whether the topic is compensated is not known")
    force_N, weight_N = float(np.linalg.norm(np.mean(wrench, axis=0)[:3])), mass_kg * cell.site.g_m_s2
    found = f"the wrench has {force_N:.1f} N at rest, the tool weighs {weight_N:.1f} N"
    if force_N > _COMPENSATED * weight_N:
        return Check(name, "ok", found)
    fix = "give the topic of the raw wrench, or switch the compensation off; a zeroing that stays does no harm"
    return Check(name, "warning", f"{found}: this wrench is already compensated or zeroed", fix)


def check_stream(samples: FtSamples, health: Health, address: SensorAddress, duration_s: float) -> list[Check]:
    """Check two seconds of a sensor: rate, losses, age, status."""
    return [
        check_rate(len(samples) / duration_s, health.nominal_rate_Hz, address),
        _check_lost(health, address),
        Check("sensor.age", "ok", f"the newest sample is {1e3 * health.age_s:.1f} ms old"),
        _check_status(samples.status),
    ]


def check_rate(rate_Hz: float, nominal_Hz: float, address: SensorAddress | None = None) -> Check:
    """Compare the measured rate of a sensor with its nominal one."""
    if math.isnan(nominal_Hz):
        return Check("sensor.rate", "ok", f"{rate_Hz:.0f} Hz, the sensor has no nominal rate")
    found, share = f"{rate_Hz:.1f} Hz (nominal {nominal_Hz:g})", rate_Hz / nominal_Hz
    if 1 - _RATE_TOLERANCE / 2 < share < 1 + _RATE_TOLERANCE:
        return Check("sensor.rate", "ok", found)
    port = None if address is None else address.serial_port
    fix = "close other programs, and try another USB port or cable"
    if address is None:
        fix = "`ftdrive doctor` names likely causes"
    elif share > 1:
        fix = "records come twice, or the sensor has another setting: set its rate again, then ftdrive doctor again"
    elif address.host is not None:
        fix = _BETTER_NETWORK
    elif port is not None and (tty := port.resolve().name).startswith("ttyUSB"):
        fix = latency_command(tty)
    return Check("sensor.rate", "failed" if abs(share - 1) > _RATE_TOLERANCE else "warning", found, fix)


def _check_lost(health: Health, address: SensorAddress) -> Check:
    odd = ((health.out_of_order, "out of order"), (health.duplicated, "twice"))
    came = "".join(f", {count} came {how}" for count, how in odd if count)
    found = f"{health.lost} lost, {health.malformed} damaged of {health.received}{came}"
    gone = max(health.lost, health.malformed, health.out_of_order)
    if not gone and not health.duplicated:
        return Check("sensor.lost", "ok", found)
    state: State = "failed" if gone > 0.01 * health.received else "warning"  # of what comes twice nothing is missing
    fix = "check the cable, its shield and the termination of the bus" if address.host is None else _BETTER_NETWORK
    if address.scheme == "ati-can":  # it is polled
        fix += ", or run fewer programs on this computer: an answer that is read too late is lost too"
    return Check("sensor.lost", state, found, fix)


def _check_status(status: NDArray[np.uint32]) -> Check:
    found = f"status {', '.join(f'0x{int(word):x}' for word in np.unique(status))}"
    if not status.any():
        return Check("sensor.status", "ok", found)
    return Check("sensor.status", "warning", found, "look the bits up in the sensor's manual; the driver continues")


def check_noise(wrench: Array, duration_s: float, average_s: float, mass_kg: float) -> list[Check]:
    """Check the noise of a sensor at rest, and predict the accuracy of a calibration from it.

    Parameters
    ----------
    wrench : array, shape (n, 6)
        `duration_s` seconds of N and N·m.
    average_s : float
        How long each pose is averaged.
    mass_kg : float
        Expected, of all that hangs on the sensor.
    """
    level = check_level(wrench)
    if level.state == "failed":
        return [level]
    variance = np.diag(mean_and_covariance(wrench).covariance) * duration_s / average_s
    guess = Guess(mass_kg, float(np.sqrt(variance[:3].mean())), float(np.sqrt(variance[3:].mean())))
    expected = predicted_sigma(special(range(1, 25)), guess)
    com_mm, turn_deg = (
        factor * float(np.max(np.abs(expected.sigma[key])))
        for key, factor in (("p_sensor_com_m", 1e3), ("R_flange_sensor", 180 / np.pi))
    )
    mass_g = 1e3 * float(np.max(expected.sigma["mass_kg"]))
    accuracy = (
        f"from noise alone, for {mass_kg:g} kg and 24 poses of {average_s:g} s, one sigma: mass {mass_g:.2g} g, "
        f"centre of mass {com_mm:.2g} mm, rotation {turn_deg:.2g}°"
    )
    return [level, Check("noise.accuracy", "ok", accuracy)]


def check_noise_change(wrench: Array, dataset: CalibrationDataset) -> Check:
    """Compare the noise of a resting sensor (n, 6) with that of the poses of a calibration.

    Compared is the variance of a mean times its number of samples, which does not depend on the averaging time.
    """
    name = "noise.change"
    if dataset.wrench_cov is None or not (sampled := dataset.n_samples > 0).any():
        return Check(name, "skipped", "the noise of the calibration is not known")
    if len(wrench) < LEAST_SAMPLES or not is_stationary(wrench):
        return Check(name, "skipped", "the reading is not steady")
    then = np.einsum("nii,n->ni", dataset.wrench_cov[sampled], dataset.n_samples[sampled])
    now = np.diag(mean_and_covariance(wrench).covariance) * len(wrench)
    ratio = np.sqrt(now / np.median(then, axis=0))
    most = int(np.argmax(ratio))
    found = f"noise is {ratio[most]:.1f} times that of the calibration in {AXES[most]}"
    if ratio[most] < _MUCH_NOISE:
        return Check(name, "ok", found)
    return Check(name, "warning", found, "look for vibration and loose cables, then ftdrive doctor")


def check_level(wrench: Array) -> Check:
    """Check that all six axes of a resting sensor (n, 6) are alive, finite and steady."""
    name = "noise.level"
    if len(wrench) < LEAST_SAMPLES:
        return Check(name, "failed", f"only {len(wrench)} samples", "check the sensor's rate")
    if not np.isfinite(wrench).all():
        return Check(name, "failed", "the sensor sends values that are not numbers", "check its cable and supply")
    if dead := [AXES[i] for i in np.flatnonzero(np.ptp(wrench, axis=0) == 0)]:
        found = f"{', '.join(dead)} did not change: the sensor is stuck"
        return Check(name, "failed", found, "switch the sensor off and on")
    sigma = wrench.std(axis=0, ddof=1)
    force, torque = ", ".join(f"{s:.4f}" for s in sigma[:3]), ", ".join(f"{s:.5f}" for s in sigma[3:])
    found = f"σ ({force}) N, ({torque}) N·m"
    if not is_stationary(wrench):
        return Check(name, "warning", f"{found}, but not steady", "keep hands and cables off, let it warm up")
    return Check(name, "ok", found)


# ------------------------------------------------------------------------------------------------------------- the arm


def check_unreachable(error: DeviceError, host: str) -> Check:
    """Return why an arm could not be opened, and what to do about it."""
    fix = error.fix or f"ping {host}"
    if isinstance(error, ModelUnknown):
        fix = f'write model = "ur5e" under [robot] in ftdrive.toml, or give --model: one of {", ".join(MODELS)}'
    return Check("robot.reachable", "failed", error.found, fix)


def check_arm(info: DeviceInfo, robot: RobotConfig) -> Check:
    """Check that the arm is the configured one, where [robot] serial is set."""
    name = "robot.identity"
    if robot.serial not in {None, info.serial}:
        found = f"the arm at {robot.host} has serial {info.serial}, [robot] serial is {robot.serial}"
        if info.serial == NOT_REPORTED:
            return Check(name, "failed", f"{found}: they cannot be compared", "remove [robot] serial")
        return Check(name, "failed", found, "correct one of the two")
    return Check(name, "ok", who(info))


def check_kinematics(info: DeviceInfo) -> Check:
    """Check that an arm reports its own kinematics, and how far they are from those of its model."""
    name, own = "robot.kinematics", kinematics_of(info)
    if info.model not in MODELS:
        return Check(name, "skipped", f"the kinematics of a {info.model} are not known here")
    if own is None:
        found = f"none reported: plans use those of a nominal {info.model}, with wider margins"
        return Check(name, "warning", found, "enable the primary client interface under Settings, Security, Services")
    q_rad = np.random.default_rng(0).uniform(-np.pi, np.pi, (_POSTURES, 6))
    real, nominal = frames(own, q_rad), frames(MODELS[info.model], q_rad)
    off_mm = 1e3 * np.linalg.norm(real.flange_m - nominal.flange_m, axis=1).max()
    chord = np.linalg.norm(real.R_base_flange - nominal.R_base_flange, axis=(1, 2)).max() / np.sqrt(8.0)
    off_deg = np.degrees(2 * np.arcsin(chord))
    found = f"own, up to {off_mm:.1f} mm and {off_deg:.2f}° from a nominal {info.model}"
    return Check(name, "ok", f"{found}; plans use them")


def check_diagnosis(diagnosis: Diagnosis, device: str = "robot") -> Check:
    """Return what the driver of a robot or a sensor found when it checked its own device."""
    state: State = "ok" if diagnosis.passed else "failed"
    return Check(f"{device}.{diagnosis.name}", state, diagnosis.found, diagnosis.fix or None)


def check_remote(arm: RobotArm) -> Check:
    """Check that the controller accepts programs from the network."""
    name = "robot.remote"
    try:
        remote = arm.in_remote_control()
    except DeviceError as error:
        return Check(name, "failed", error.found, error.fix or None)
    if remote is None:
        return Check(name, "skipped", "this controller does not report whether it accepts programs from the network")
    if remote:
        return Check(name, "ok", "remote control on")
    return Check(name, "failed", "local control", "press Local, Remote Control at the top right of the pendant")


def check_safety(status: ArmStatus) -> Check:
    """Check that the safety system lets the arm move."""
    if status.fault is not None:
        return Check("robot.safety", "failed", status.fault.found, status.fault.fix)
    if status.safety_mode != "normal":
        fix = "check at the pendant that this mode is intended; calibrate asks for it"
        return Check("robot.safety", "warning", f"safety mode {status.safety_mode}", fix)
    return Check("robot.safety", "ok", "powered, brakes released, no stop")


def check_program(status: ArmStatus) -> Check:
    """Check that no program runs on the controller."""
    if status.program == "stopped":
        return Check("robot.program", "ok", "no program runs; other clients that only read cannot be detected")
    found = f"a program is on the controller ({status.program})"
    return Check("robot.program", "warning", found, "stop it at the pendant: calibrate refuses to start beside it")


def check_speed(status: ArmStatus) -> Check:
    """Check that the speed slider lets the arm move in a reasonable time."""
    found = f"speed slider at {status.speed_slider:.0%}, the controller allows {status.speed_scaling:.0%}"
    if status.speed_slider < SLOWEST_SLIDER:
        fix = "raise the speed slider at the pendant, to 100 % if that is safe: ftdrive never moves it"
        return Check("robot.speed", "failed", f"{found}: the arm would hardly move", fix)
    return Check("robot.speed", "ok", found)


def check_payload(status: ArmStatus, tool: ToolConfig, sensor_kg: float | None) -> Check:
    """Check the payload configured in the controller, and compare it with tool and sensor as far as they are described.

    The mass may differ by the larger of `described_cell.PAYLOAD_KG` and its share; the centre must be at the tool.
    """
    name, payload_kg, p_m = "robot.payload", status.payload_kg, status.p_flange_payload_m
    if payload_kg is None:
        return Check(name, "skipped", "this controller does not report its payload: compare it at the pendant")
    if payload_kg <= 0:
        fix = "set mass and centre of mass of all that hangs on the flange at the pendant; else the arm may stop itself"
        return Check(name, "failed", "no payload is set in the controller", fix)
    found = f"payload {payload_kg:.2f} kg"
    if p_m is None:
        found += ", its centre is not reported"
    else:
        found += " at ({:.0f}, {:.0f}, {:.0f}) mm from the flange".format(*(1e3 * value for value in p_m))
        if tool.cylinders_mm and not _at_tool(p_m, tool):
            fix = "correct the centre of the payload at the pendant, or [tool] cylinders_mm"
            return Check(name, "failed", f"{found}, outside the tool", fix)
    if tool.mass_kg is not None:
        expected_kg = tool.mass_kg + (sensor_kg or 0.0)
        found += f", sensor and tool are {expected_kg:.2f} kg"
        if abs(payload_kg - expected_kg) > max(described_cell.PAYLOAD_KG, described_cell.PAYLOAD_SHARE * expected_kg):
            return Check(name, "failed", found, "correct the payload at the pendant, or the masses in [tool], [sensor]")
    if p_m is not None and not any(p_m):
        fix = "set the centre of gravity at the pendant: Installation, Payload"
        return Check(name, "warning", f"{found}; nothing hangs in the middle of the flange face", fix)
    return Check(name, "ok", found)


def check_weighed_payload(payload_kg: float | None, result: CalibrationResult, sensor_kg: float | None) -> Check:
    """Compare the payload configured in the controller with the load that a calibration has weighed.

    Parameters
    ----------
    payload_kg : float, optional
        As the controller reports it.
    result : CalibrationResult
    sensor_kg : float, optional
        Mass of sensor and adapter, which the sensor cannot weigh.
    """
    name = "robot.payload"
    if payload_kg is None:
        return Check(name, "skipped", "this controller does not report its payload")
    for finding in described_cell.payload(payload_kg, result.mass_kg, sensor_kg):
        return Check(name, "warning", finding.found, finding.fix)
    known = "sensor" if sensor_kg is None else f"{sensor_kg:.2f} kg sensor"
    return Check(name, "ok", f"robot {payload_kg:.2f} kg; weighed {result.mass_kg:.2f} kg + {known}")


def _at_tool(p_flange_m: Sequence[float], tool: ToolConfig) -> bool:
    x_mm, y_mm, z_mm = (1e3 * value for value in p_flange_m)
    reach_mm = max(math.hypot(*row[3:]) + row[2] / 2 for row in tool.cylinders_mm)
    length_mm = max(row[1] for row in tool.cylinders_mm)
    return math.hypot(x_mm, y_mm) <= reach_mm + _PAYLOAD_MM and -_PAYLOAD_MM <= z_mm <= length_mm + _PAYLOAD_MM


def check_link(arm: RobotArm, clock: Clock, *, usual_s: float, gap_s: float) -> Check:
    """Check that states of the arm arrive soon and without gaps, in one of three half seconds.

    Parameters
    ----------
    usual_s : float
        Longest median of the time for an answer.
    gap_s : float
        Longest time for nine of ten answers.
    """
    name, found = "robot.link", ""
    for _ in range(_LINK_TRIES):  # a computer that is busy for a moment is not a bad link
        try:
            with clock.keeping_up():
                took_s = _answers_s(arm, clock)
        except DeviceError as error:
            return Check(name, "failed", error.found, error.fix or "check the robot and the network")
        median_s = float(np.median(took_s))
        found = f"the arm answers within {1e3 * median_s:.0f} ms, at worst {1e3 * max(took_s):.0f} ms"
        if median_s < usual_s and np.quantile(took_s, 0.9) < gap_s:
            return Check(name, "ok", found)
    limit = f"allowed are {1e3 * usual_s:.0f} ms, {1e3 * gap_s:.0f} ms for nine in ten"
    return Check(name, "failed", f"{found} ({limit})", "use a cable, and reduce the load of this computer and network")


def _answers_s(arm: RobotArm, clock: Clock) -> list[float]:
    took_s, end_s = list[float](), clock.now_s() + _LINK_S
    while (started_s := clock.now_s()) < end_s:
        arm.state()
        took_s.append(clock.now_s() - started_s)
    return took_s


def check_clock(t_host_ns: Sequence[int], t_device_s: Sequence[float]) -> Check:
    """Compare the pace of the controller's clock with ours; their readings are never subtracted from each other."""
    host_s = (np.asarray(t_host_ns) - t_host_ns[0]) / 1e9
    pace = float(np.polyfit(host_s, np.asarray(t_device_s) - t_device_s[0], 1)[0])
    found = f"the controller's clock runs at {pace:.4f} of ours, over {host_s[-1]:.1f} s"
    if abs(pace - 1) < 0.02:
        return Check("clock.pace", "ok", found)
    return Check("clock.pace", "warning", found, "close other programs on this computer; look at the network's load")


@dataclass(frozen=True, slots=True)
class Belonging:
    """Reasons against a calibration belonging to the connected devices, in words."""

    others: tuple[str, ...]
    """Devices that differ from those of the calibration."""
    unknown: tuple[str, ...]
    """Devices of the same model where a serial number is unknown."""


def belonging(
    result: CalibrationResult, connected: Mapping[str, DeviceInfo], mount: str | EllipsisType | None = ...
) -> Belonging:
    """Compare the devices of a calibration with the connected ones, by role.

    Serial numbers decide where both sides have one; elsewhere another model is another device. The label `mount` of the
    mounting, None without one, must be the same; it is not compared if it is left out, or if the file is older.
    """
    made_with = result.provenance.get("devices")
    others, unknown = [], []
    for role, device in connected.items():
        made = made_with.get(role, {}) if isinstance(made_with, Mapping) else {}
        serial, model = made.get("serial", NOT_REPORTED), made.get("model", device.model)
        if NOT_REPORTED not in {serial, device.serial}:
            if serial != device.serial:
                pair = f"the {role} {serial}, but the {role} {device.serial}"
                others.append(f"the calibration was made with {pair} is connected")
        elif model.casefold() != device.model.casefold():
            others.append(f"the calibration was made with the {role} {model}, but {device.model} is connected")
        else:
            which = "it was made with" if serial == NOT_REPORTED else "connected"
            why = f"the {role} {which} reports no serial number"
            unknown.append(f"whether the calibration is of this {role} cannot be checked: {why}")
    setup = result.provenance.get("setup")
    if mount is not ... and isinstance(setup, Mapping) and setup.get("mount", mount) != mount:
        made_as, now = (f"[sensor] mount = {one!r}" if one else "no [sensor] mount" for one in (setup["mount"], mount))
        others.append(f"the calibration was made with {made_as}, but {now} is configured")
    return Belonging(tuple(others), tuple(unknown))


def check_calibration(
    result: CalibrationResult, connected: Mapping[str, DeviceInfo], mount: str | EllipsisType | None = ...
) -> Check:
    """Check that a calibration belongs to the connected devices, and as `belonging` does to the mounting."""
    name = "calibration.devices"
    belongs = belonging(result, connected, mount)
    if belongs.others:
        return Check(name, "failed", "; ".join(belongs.others), "ftdrive calibrate")
    created = result.provenance.get("created_utc")
    made = f"verdict {result.verdict}, made at an unknown time"
    if isinstance(created, str):
        made = f"verdict {result.verdict}, made on {created[:10]} at {created[11:16]} UTC"
    if belongs.unknown:
        fix = "add serial=… (from its label) to the sensor's address, and calibrate with it once"
        return Check(name, "warning", f"{made}; {'; '.join(belongs.unknown)}", fix)
    return Check(name, "ok", f"{made}, with these devices" if connected else f"{made}; no device to compare with")


def check_push(
    change: Array, R_base_flange: Array | None, R_flange_sensor: Array | None, sign: int
) -> tuple[Check, dict[str, Any]]:
    """Check the sign of a sensor from a push along +X of the base.

    Parameters
    ----------
    change : array, shape (3,)
        Force during the push minus force before, N, sensor axes.
    R_base_flange, R_flange_sensor : array, shape (3, 3), or None
        Where unknown.
    sign : int
        As configured now.

    Returns
    -------
    Check
        A reading is exerted on the sensor, so it must move along +X of the base.
    dict
        For sensor, flange and base: force_N and the axis that moved most, such as "-Y"; None where unknown.
    """
    flange = None if R_flange_sensor is None else R_flange_sensor @ change
    base = None if flange is None or R_base_flange is None else R_base_flange @ flange
    moved = {
        frame: None if force is None else {"force_N": force.tolist(), "axis": _axis(force)}
        for frame, force in (("sensor", change), ("flange", flange), ("base", base))
    }
    words = ", ".join(f"{frame} {'unknown' if it is None else it['axis']}" for frame, it in moved.items())
    size_N = float(np.linalg.norm(change))
    found = f"{size_N:.1f} N: {words}"
    if size_N < _PUSH_N:
        return Check("push.sign", "failed", found, f"push again, harder than {_PUSH_N:g} N, and hold"), moved
    if base is None:
        return Check("push.sign", "skipped", found, "give --calibration FILE: the mounting must be known"), moved
    if abs(base[0]) < 0.8 * size_N:
        fix = "push along +X of the base; if you did, the sensor is mounted differently: ftdrive calibrate"
        return Check("push.sign", "failed", found, fix), moved
    if base[0] < 0:
        fix = f"set sign = {-sign} under [sensor] in the configuration, then calibrate again"
        return Check("push.sign", "failed", f"{found}: it reports the reaction", fix), moved
    return Check("push.sign", "ok", found), moved


def _axis(force: Array) -> str:
    i = int(np.argmax(np.abs(force)))
    return ("-" if force[i] < 0 else "+") + "XYZ"[i]
