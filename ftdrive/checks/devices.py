"""What `doctor` and `calibrate` say of the devices, as functions of what was seen; nothing here opens one."""

import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from socket import gaierror
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib import CalibrationResult
from calib.data.dwell_mean import is_stationary, mean_and_covariance
from calib.poses.information import Guess, predicted_sigma, special
from drivers.errors import (
    ConnectError,
    DeviceFault,
    DeviceTimeout,
    DriverError,
    ModelUnknown,
    PortInUse,
    ProtocolError,
    StreamBroken,
    Unreachable,
)
from drivers.interfaces import NOT_REPORTED, ArmStatus, DeviceInfo, Fact, FtSamples, Health
from drivers.ur.kinematics import MODELS
from ftdrive.checks.computer import RATE_TOLERANCE, Check, SensorAddress, State, latency_command

Array = NDArray[np.float64]

_PUSH_N = 2.0
_SERVICES = "Settings, Security, Services"
_BETTER_NETWORK = "give the sensor a network of its own, or run fewer programs on this computer"
SLOWEST_SLIDER = 0.05
"""Moves are waited for as long as they last with this one."""
_OLDEST_MINOR = 4
"""Of PolyScope 3 and 5: ur_rtde cannot control older ones."""


# ---------------------------------------------------------------------------------------------------------- the sensor


_SAYS: Mapping[str, str] = MappingProxyType(
    {
        "device": "told by the device",
        "documented": "fixed by its manual",
        "configured": "configured",
        "assumed": "assumed",
    }
)


def who(info: DeviceInfo, firmware: str = "firmware") -> str:
    """Name a device in words; `firmware` is what its firmware is called."""
    return f"{info.model}, serial {info.serial}, {firmware} {info.firmware}"


def check_identity(info: DeviceInfo) -> list[Check]:
    """Say who a sensor is and what its numbers mean, and from where each of it is known."""
    identity = Check("sensor.identity", "ok", who(info))
    if "serial" not in info.facts:
        fix = "add serial=… (its label) to the sensor's address, so that a calibration knows its sensor"
        identity = Check("sensor.identity", "warning", who(info), fix)
    facts = info.facts
    return [
        identity,
        _check_scale(facts.get("counts_per_N"), facts.get("counts_per_Nm")),
        _check_range(facts.get("range")),
        _check_sign(facts.get("sign")),
    ]


def _check_scale(force: Fact | None, torque: Fact | None) -> Check:
    name = "sensor.counts"
    if force is None or torque is None:
        return Check(name, "ok", "the driver does not tell its scale")
    found = f"{force.value:.7g} counts per N and {torque.value:.7g} per N·m, {_SAYS[force.source]}"
    if force.source == "assumed":
        return Check(name, "warning", found, "compare with the calibration certificate, or hang a known weight on it")
    return Check(name, "ok", found)


def _check_range(fact: Fact | None) -> Check:
    name = "sensor.range"
    if fact is None or not isinstance(fact.value, tuple):
        fix = "add range=N,Nm of its data sheet to the sensor's address, such as range=300,30"
        return Check(name, "warning", "its range is not known, so nobody watches for an overload", fix)
    *force, tx, ty, tz = (f"{value:g}" for value in fact.value)
    return Check(name, "ok", f"±({', '.join(force)}) N, ±({tx}, {ty}, {tz}) N·m, {_SAYS[fact.source]}")


def _check_sign(fact: Fact | None) -> Check:
    if fact is None:
        return Check("sensor.sign", "ok", "the driver does not tell its sign")
    return Check("sensor.sign", "ok", f"sign {fact.value}, {_SAYS[fact.source]}; --push shows whether it is right")


def check_sensor_error(name: str, error: DriverError, address: SensorAddress, permissions: Sequence[Check]) -> Check:
    """Say what to do about the error of a sensor's driver.

    That is what it says itself; for a sensor that was not reached, what mends the way to it, if anything is wrong
    there; and only where neither is known, what usually helps against errors of this kind.
    """
    kind = error.__cause__ if isinstance(error, ConnectError) and isinstance(error.__cause__, DriverError) else error
    own = error.fix
    way = next((check.fix for check in permissions if check.state == "failed"), None)
    if way is not None and not isinstance(kind, PortInUse | DeviceFault) and (_not_reached(kind) or not own):
        own = way
    elif own and isinstance(kind, DeviceTimeout):
        own = f"{own}; see whom the address reaches: {_ask_who(address)}"
    return Check(name, "failed", error.found, own or _usual_cure(kind, address))


def _not_reached(error: BaseException) -> bool:
    """Tell whether nothing came from a device; one that is refused for what it says has no other error behind it."""
    silent = isinstance(error, DeviceTimeout | StreamBroken)
    return silent or (isinstance(error, ConnectError) and error.__cause__ is not None)


def _usual_cure(error: BaseException, address: SensorAddress) -> str:
    if isinstance(error, DeviceFault):
        return "look the fault up in the sensor's manual; switch it off and on, then ftdrive doctor again"
    if isinstance(error, ProtocolError):
        return f"switch the sensor off and on; is it the one its address names? {_ask_who(address)}"
    return f"check the sensor's supply and cable, then {_ask_who(address)}"


def _ask_who(address: SensorAddress) -> str:
    """Give the command that shows whether anybody answers there."""
    if address.host is not None:
        return f"ping {address.host}"
    return "ftdrive doctor again" if address.place is None else f"ftdrive devices --probe {shlex.quote(address.place)}"


def check_stream(samples: FtSamples, health: Health, address: SensorAddress, duration_s: float) -> list[Check]:
    """Judge two seconds of a sensor: rate, losses, age, status."""
    return [
        _check_rate(len(samples) / duration_s, health.nominal_rate_Hz, address),
        _check_lost(health, address),
        Check("sensor.age", "ok", f"the newest sample is {1e3 * health.age_s:.1f} ms old"),
        _check_status(samples.status),
    ]


def _check_rate(rate_Hz: float, nominal_Hz: float, address: SensorAddress) -> Check:
    if math.isnan(nominal_Hz):
        return Check("sensor.rate", "ok", f"{rate_Hz:.0f} Hz (as fast as it answers, or as it is set)")
    found, share = f"{rate_Hz:.1f} Hz (nominal {nominal_Hz:g})", rate_Hz / nominal_Hz
    if 1 - RATE_TOLERANCE / 2 < share < 1 + RATE_TOLERANCE:
        return Check("sensor.rate", "ok", found)
    port = address.serial_port
    fix = "close other programs, and try another USB port or cable"
    if share > 1:
        fix = "records come twice, or the sensor is set differently: set its rate anew, then ftdrive doctor again"
    elif address.host is not None:
        fix = _BETTER_NETWORK
    elif port is not None and (tty := port.resolve().name).startswith("ttyUSB"):
        fix = latency_command(tty)
    return Check("sensor.rate", "failed" if abs(share - 1) > RATE_TOLERANCE else "warning", found, fix)


def _check_lost(health: Health, address: SensorAddress) -> Check:
    strange = ((health.out_of_order, "out of order"), (health.duplicated, "twice"))
    came = "".join(f", {count} came {how}" for count, how in strange if count)
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
    words = [f"0x{int(word):x}" for word in np.unique(status)]
    found = f"status {', '.join(words)}"
    if words == ["0x0"]:
        return Check("sensor.status", "ok", found)
    return Check(
        "sensor.status", "warning", found, "look the bits up in the sensor's manual; the driver goes on with them"
    )


def check_noise(wrench: Array, duration_s: float, average_s: float, mass_kg: float) -> list[Check]:
    """Judge the noise of a sensor at rest, and say what a calibration with it will be worth.

    Parameters
    ----------
    wrench : array, shape (n, 6)
        `duration_s` seconds of N and N·m.
    average_s : float
        How long each pose is averaged.
    mass_kg : float
        Expected, of all that hangs on the sensor.
    """
    if len(wrench) < 40:
        return [Check("noise.level", "failed", f"only {len(wrench)} samples", "see the rate of the sensor above")]
    sigma = wrench.std(axis=0, ddof=1)
    force, torque = ", ".join(f"{s:.4f}" for s in sigma[:3]), ", ".join(f"{s:.5f}" for s in sigma[3:])
    found = f"σ ({force}) N, ({torque}) N·m"
    if not np.ptp(wrench, axis=0).any():
        return [Check("noise.level", "failed", "every sample is the same", "switch the sensor off and on")]
    level = Check("noise.level", "ok", found)
    if not is_stationary(wrench):
        level = Check("noise.level", "warning", f"{found}, but not steady", "keep hands and cables off, let it warm up")
    variance = np.diag(mean_and_covariance(wrench).covariance) * duration_s / average_s
    guess = Guess(mass_kg, float(np.sqrt(variance[:3].mean())), float(np.sqrt(variance[3:].mean())))
    expected = predicted_sigma(special(range(1, 25)), guess)
    com_mm, turn_deg = (
        factor * float(np.max(np.abs(expected.sigma[key])))
        for key, factor in (("p_sensor_com_m", 1e3), ("R_flange_sensor", 180 / np.pi))
    )
    mass_g = 1e3 * float(np.max(expected.sigma["mass_kg"]))
    accuracy = (
        f"from noise alone, for {mass_kg:g} kg and 24 poses of {average_s:g} s: mass ±{mass_g:.2g} g, "
        f"centre of mass ±{com_mm:.2g} mm, rotation ±{turn_deg:.2g}°"
    )
    return [level, Check("noise.accuracy", "ok", accuracy)]


# ------------------------------------------------------------------------------------------------------------- the arm


def check_unreachable(error: DriverError, host: str) -> Check:
    """Say why an arm could not be opened, and what to do about just that."""
    cure = error.fix or f"ping {host}"
    if isinstance(error, Unreachable):
        if isinstance(error.__cause__, ConnectionRefusedError):
            cure = (
                f"{host} is there and takes no RTDE: enable RTDE at the pendant under {_SERVICES}, if it is the robot"
            )
        elif isinstance(error.__cause__, gaierror):
            cure = (
                "write the controller's IPv4 address, at the pendant under Settings, System, Network, as [robot] host"
            )
        else:
            cure = f"ping {host}"
    elif isinstance(error, ModelUnknown):
        cure = f'write model = "ur5e" under [robot] in ftdrive.toml, or give --model; it is one of {", ".join(MODELS)}'
    return Check("robot.reachable", "failed", error.found, cure)


def check_arm(info: DeviceInfo) -> Check:
    """Say who an arm is, and whether its PolyScope, such as "5.15.0.1261331", can be controlled."""
    name, found = "robot.identity", who(info, "PolyScope")
    major, _, rest = info.firmware.partition(".")
    minor = rest.partition(".")[0]
    if minor.isdecimal() and int(minor) < _OLDEST_MINOR:
        fix = f"update it to PolyScope {major}.{_OLDEST_MINOR} or later"
        return Check(name, "failed", f"{found}, which ur_rtde can read and not control", fix)
    return Check(name, "ok", found)


def check_registers(taken: Sequence[str]) -> Check:
    """Judge which of the RTDE registers that a control of ours needs belong to somebody else."""
    name = "robot.registers"
    if not taken:
        return Check(name, "ok", "its RTDE registers are free: nobody else controls it")
    fix = (
        "end the other program that controls the arm, or disable EtherNet/IP and PROFINET at the pendant under "
        "Installation, Fieldbus; after a cut cable wait for half a minute"
    )
    return Check(name, "failed", f"{len(taken)} RTDE registers are in use by another client, {taken[0]} first", fix)


def check_status(status: ArmStatus) -> list[Check]:
    """Judge what the controller says of itself: may the arm move, does a program run, how fast, with what payload."""
    return [check_safety(status), _check_program(status), check_speed(status), check_payload(status)]


def check_safety(status: ArmStatus) -> Check:
    """Judge whether the safety system lets the arm move."""
    if status.fault is not None:
        return Check("robot.safety", "failed", status.fault.found, status.fault.fix)
    if status.safety_mode != "normal":
        fix = "see the pendant for what puts it there; calibrate asks whether that is as it should be"
        return Check("robot.safety", "warning", f"safety mode {status.safety_mode}", fix)
    return Check("robot.safety", "ok", "powered, brakes released, no stop")


def _check_program(status: ArmStatus) -> Check:
    if status.program == "stopped":
        return Check("robot.program", "ok", "no program runs; other clients that only read cannot be seen")
    what = f"a program is on the controller ({status.program})"
    return Check("robot.program", "warning", what, "stop it at the pendant: calibrate does not begin beside it")


def check_speed(status: ArmStatus) -> Check:
    """Judge whether the speed slider lets the arm move in a reasonable time."""
    found = f"speed slider at {status.speed_slider:.0%}, the controller allows {status.speed_scaling:.0%}"
    if status.speed_slider < SLOWEST_SLIDER:
        fix = "raise the speed slider at the pendant, to 100 % if nothing speaks against it: ftdrive never does"
        return Check("robot.speed", "failed", f"{found}: the arm would hardly move", fix)
    return Check("robot.speed", "ok", found)


def check_payload(status: ArmStatus) -> Check:
    """Judge what the controller was told to carry, whatever the tool is."""
    name = "robot.payload"
    if status.payload_kg is None:
        return Check(name, "skipped", "not applicable: this controller does not tell its payload")
    if status.payload_kg <= 0:
        fix = "set mass and centre of mass of all that hangs on the flange at the pendant; else the arm may stop itself"
        return Check(name, "failed", "the controller was told of no payload", fix)
    if status.p_flange_payload_m is None:
        return Check(name, "ok", f"payload {status.payload_kg:.2f} kg, its centre is not told")
    if not any(status.p_flange_payload_m):
        found = f"payload {status.payload_kg:.2f} kg, its centre in the middle of the flange face, where nothing hangs"
        return Check(name, "warning", found, "set the centre of gravity at the pendant: Installation, Payload")
    where = ", ".join(f"{1e3 * value:.0f}" for value in status.p_flange_payload_m)
    return Check(name, "ok", f"payload {status.payload_kg:.2f} kg at ({where}) mm from the flange")


def check_remote(remote: bool | None) -> Check:
    """Judge whether the controller takes programs from the network; None where it does not tell."""
    name = "robot.remote"
    if remote is None:
        return Check(
            name, "skipped", "not applicable: this controller does not tell whether it takes programs from the network"
        )
    if remote:
        return Check(name, "ok", "remote control on")
    return Check(name, "failed", "local control", "press Local, Remote Control at the top right of the pendant")


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
    """What speaks against a calibration being of the devices that are connected, in words."""

    others: tuple[str, ...]
    """It was made with another one."""
    unknown: tuple[str, ...]
    """Cannot be told: a serial number is not known, and the model is the same."""


def belonging(result: CalibrationResult, connected: Mapping[str, DeviceInfo]) -> Belonging:
    """Compare the devices a calibration was made with and those that are connected, by role.

    Serial numbers decide where both sides tell one; elsewhere another model is another device all the same.
    """
    made_with = result.provenance.get("devices")
    others, unknown = [], []
    for role, device in connected.items():
        made = made_with.get(role, {}) if isinstance(made_with, Mapping) else {}
        told, found = made.get("serial", NOT_REPORTED), device.serial
        if NOT_REPORTED not in {told, found}:
            if told != found:
                others.append(f"the calibration was made with the {role} {told}, but the {role} {found} is connected")
        elif (model := made.get("model", device.model)).casefold() != device.model.casefold():
            others.append(f"the calibration was made with the {role} {model}, but {device.model} is connected")
        else:
            why = (
                "it was made with told no serial number" if told == NOT_REPORTED else "connected tells no serial number"
            )
            unknown.append(f"whether the calibration is of this {role} cannot be checked: the {role} {why}")
    return Belonging(tuple(others), tuple(unknown))


def check_calibration(result: CalibrationResult, connected: Mapping[str, DeviceInfo]) -> Check:
    """See whether a calibration belongs to the devices that are connected, as far as any are."""
    name = "calibration.devices"
    belongs = belonging(result, connected)
    if belongs.others:
        return Check(name, "failed", "; ".join(belongs.others), "ftdrive calibrate")
    made = f"verdict {result.verdict}, made at {result.provenance.get('created_utc', 'an unknown time')}"
    if belongs.unknown:
        fix = "add serial=… (its label) to the sensor's address, and calibrate with it once"
        return Check(name, "warning", f"{made}; {'; '.join(belongs.unknown)}", fix)
    return Check(name, "ok", f"{made}, with these devices" if connected else f"{made}; no device to compare with")


def check_push(
    change: Array, R_base_flange: Array | None, R_flange_sensor: Array | None, sign: int
) -> tuple[Check, dict[str, Any]]:
    """Judge a push along +X of the base.

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
    words = ", ".join(f"{frame} {'unknown' if told is None else told['axis']}" for frame, told in moved.items())
    size_N = float(np.linalg.norm(change))
    found = f"{size_N:.1f} N: {words}"
    if size_N < _PUSH_N:
        return Check("push.sign", "failed", found, f"push again, harder than {_PUSH_N:g} N, and hold"), moved
    if base is None:
        return Check("push.sign", "skipped", found, "give --calibration FILE: the mounting must be known"), moved
    if abs(base[0]) < 0.8 * size_N:
        fix = "push along +X of the base; if you did, the mounting is another one: ftdrive calibrate"
        return Check("push.sign", "failed", found, fix), moved
    if base[0] < 0:
        fix = f"set sign = {-sign} under [sensor] in the configuration, then calibrate again"
        return Check("push.sign", "failed", f"{found}: it reports the reaction", fix), moved
    return Check("push.sign", "ok", found), moved


def _axis(force: Array) -> str:
    i = int(np.argmax(np.abs(force)))
    return ("-" if force[i] < 0 else "+") + "XYZ"[i]
