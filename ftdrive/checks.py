"""What `doctor` looks at, as functions of what was seen: each finding with the exact words that mend it.

Nothing here opens a device. Where Linux keeps its facts (/sys, /dev) is a parameter. A computer without them is told
"not applicable", which is never a failure.
"""

import json
import os
import shutil
import stat
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal
from urllib.parse import parse_qs, urlsplit

import numpy as np
from numpy.typing import NDArray

from calib import CalibrationResult
from calib.design import Guess, predicted_sigma, special
from calib.noise import is_stationary, mean_and_covariance
from drivers.interfaces import FtSamples, Health

Array = NDArray[np.float64]
State = Literal["ok", "warning", "failed", "skipped"]

SYS = Path("/sys")
DEV = Path("/dev")

_CAN_INTERFACE = "280"
"""ARPHRD_CAN, in /sys/class/net/*/type."""
_ON_SERIAL = ("ati-serial", "bota", "robotiq-ft300", "robotous-serial")
_FREE_BYTES = 1_000_000_000
_PUSH_N = 2.0


@dataclass(frozen=True, slots=True)
class Check:
    """One thing looked at."""

    name: str
    """Subject and what about it, such as "sensor.rate"."""
    state: State
    found: str
    fix: str | None = None
    """The command, or the sentence, that mends it."""


def verdict(checks: Sequence[Check]) -> State:
    """Give the worst state of all."""
    states = {check.state for check in checks}
    return "failed" if "failed" in states else "warning" if "warning" in states else "ok"


@dataclass(frozen=True, slots=True)
class SensorAddress:
    """What the address of a sensor says about the way to it."""

    scheme: str
    address: str
    options: Mapping[str, str]

    @classmethod
    def of(cls, url: str) -> "SensorAddress":
        """Take a sensor's address apart."""
        parts = urlsplit(url)
        options = {key: values[-1] for key, values in parse_qs(parts.query).items()}
        return cls(parts.scheme, parts.netloc + parts.path, options)

    @property
    def serial_port(self) -> Path | None:
        """The serial port it is on, behind an slcan adapter too."""
        if self.scheme.endswith("-can") and self.options.get("interface") == "slcan":
            return Path(self.address.split("@")[0])
        return Path(self.address) if self.scheme in _ON_SERIAL or self.address.startswith("/") else None

    @property
    def can_interface(self) -> str | None:
        """The interface of the kernel it is on."""
        on_socketcan = self.scheme.endswith("-can") and self.options.get("interface", "socketcan") == "socketcan"
        return self.address if on_socketcan else None

    @property
    def bitrate(self) -> int:
        """Bit/s its bus must have."""
        if self.scheme == "robotous-can":
            return 1_000_000
        return int(self.options.get("bitrate", "250000"), 0)

    @property
    def nominal_rate_Hz(self) -> float | None:
        """Samples a second, where the device or the address says it; a polled sensor has none."""
        if "rate" in self.options:
            return float(self.options["rate"])
        if self.scheme == "bota" and "sinc" in self.options:
            return 1 / (19.53125e-6 * float(self.options["sinc"]))
        return {"ati-serial": 7000.0, "robotiq-ft300": 100.0, "ur-ft": 500.0}.get(self.scheme)

    @property
    def scale(self) -> str:
        """Where the counts per newton come from."""
        if self.scheme == "ur-ft":
            return "configured in the address"
        if self.scheme.startswith("ati-"):
            return "told by the device"
        return "fixed by the protocol" if self.scheme in {"bota", "robotiq-ft300"} else "as the driver knows them"


# ---------------------------------------------------------------------------------------------------------- the sensor


def check_stream(samples: FtSamples, health: Health, address: SensorAddress, duration_s: float) -> list[Check]:
    """Judge two seconds of a sensor: rate, losses, age, status, scale."""
    rate_Hz = len(samples) / duration_s
    return [
        _check_rate(rate_Hz, address),
        _check_lost(health),
        Check("sensor.age", "ok", f"the newest sample is {1e3 * health.age_s:.1f} ms old"),
        _check_status(samples.status),
        Check("sensor.counts", "ok", f"counts per N and N·m: {address.scale}"),
    ]


def _check_rate(rate_Hz: float, address: SensorAddress) -> Check:
    nominal_Hz = address.nominal_rate_Hz
    if nominal_Hz is None:
        return Check("sensor.rate", "ok", f"{rate_Hz:.0f} Hz (as fast as it answers, or as it is set)")
    found = f"{rate_Hz:.1f} Hz (nominal {nominal_Hz:g})"
    if rate_Hz > 0.95 * nominal_Hz:
        return Check("sensor.rate", "ok", found)
    port = address.serial_port
    fix = "close other programs, and try another USB port or cable"
    if port is not None:
        tty = Path(os.path.realpath(port)).name
        if tty.startswith("ttyUSB"):
            fix = _latency_command(tty)
    return Check("sensor.rate", "failed" if rate_Hz < 0.5 * nominal_Hz else "warning", found, fix)


def _check_lost(health: Health) -> Check:
    found = f"{health.lost} lost, {health.malformed} damaged of {health.received}"
    bad = max(health.lost, health.malformed)
    if not bad:
        return Check("sensor.lost", "ok", found)
    state: State = "failed" if bad > 0.01 * health.received else "warning"
    return Check("sensor.lost", state, found, "check the cable, its shield and the termination of the bus")


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


def check_clock(t_host_ns: Sequence[int], t_device_s: Sequence[float]) -> Check:
    """Compare the pace of the controller's clock with ours; their readings are never subtracted from each other."""
    host_s = (np.asarray(t_host_ns) - t_host_ns[0]) / 1e9
    pace = float(np.polyfit(host_s, np.asarray(t_device_s) - t_device_s[0], 1)[0])
    found = f"the controller's clock runs at {pace:.4f} of ours, over {host_s[-1]:.1f} s"
    if abs(pace - 1) < 0.02:
        return Check("clock.pace", "ok", found)
    return Check("clock.pace", "warning", found, "close other programs on this computer; look at the network's load")


def check_calibration(result: CalibrationResult, serials: Mapping[str, str]) -> Check:
    """See whether a calibration belongs to the devices that are connected."""
    made_with = result.provenance.get("devices") or {}
    for role, found in serials.items():
        told = made_with.get(role, {}).get("serial") if isinstance(made_with, Mapping) else None
        if told is not None and told != found:
            return Check(
                "calibration.devices",
                "failed",
                f"it belongs to {role} {told}, connected is {role} {found}",
                "ftdrive calibrate",
            )
    made = result.provenance.get("created_utc", "an unknown time")
    return Check("calibration.devices", "ok", f"verdict {result.verdict}, made at {made}, with these devices")


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


# ------------------------------------------------------------------------------------------------------- this computer


def check_disk(folder: Path) -> list[Check]:
    """See whether runs can be written into a folder, which need not exist yet."""
    there = folder.absolute()
    while not there.exists():
        there = there.parent
    if not (there.is_dir() and os.access(there, os.W_OK | os.X_OK)):
        return [Check("disk.runs", "failed", f"{there} may not be written", "give --runs DIR, a folder of yours")]
    free = shutil.disk_usage(there).free
    found = f"{free / 1e9:.1f} GB free in {there}"
    if free < _FREE_BYTES:
        return [Check("disk.runs", "warning", found, "make room, or give --runs DIR on another disk")]
    return [Check("disk.runs", "ok", found)]


def check_permissions(address: SensorAddress, *, sys: Path = SYS, dev: Path = DEV) -> list[Check]:
    """See whether this user may use the sensor's port, and whether the port is set up for it."""
    if (port := address.serial_port) is not None:
        return check_serial_port(port, sys=sys, dev=dev)
    if (interface := address.can_interface) is not None:
        return [check_can_interface(interface, address.bitrate, can_details(interface), sys=sys)]
    found = f"not applicable: {address.scheme} at {address.address} is on no serial port and no CAN interface of Linux"
    return [Check("permissions.port", "skipped", found)]


def check_serial_port(port: Path, *, sys: Path = SYS, dev: Path = DEV) -> list[Check]:
    """Judge a serial port: there, permitted, named so that it survives replugging, and quick."""
    if not dev.is_dir():
        return [Check("permissions.port", "skipped", f"not applicable: {port} has no file on this system")]
    if not port.exists():
        return [Check("permissions.port", "failed", f"there is no {port}", "plug it in; ftdrive devices")]
    real = Path(os.path.realpath(port))
    checks = [_check_access(port)]
    names = {Path(os.path.realpath(link)): link for link in _links(dev / "serial" / "by-id")}
    if port in names.values():
        checks.append(Check("permissions.by-id", "ok", "the name survives replugging"))
    elif real in names:
        found = f"{port} may be another device after replugging"
        checks.append(Check("permissions.by-id", "warning", found, f"write {names[real]} in the sensor's address"))
    else:
        checks.append(Check("permissions.by-id", "skipped", "not applicable: the port has no name by id"))
    timer = sys / "bus" / "usb-serial" / "devices" / real.name / "latency_timer"
    if not timer.exists():
        checks.append(Check("permissions.latency_timer", "skipped", "not applicable: the port has no latency timer"))
        return checks
    latency_ms = timer.read_text(encoding="ascii").strip()
    slow = latency_ms != "1"
    checks.append(
        Check(
            "permissions.latency_timer",
            "warning" if slow else "ok",
            f"the adapter holds data back for up to {latency_ms} ms",
            _latency_command(real.name) if slow else None,
        )
    )
    return checks


def _latency_command(tty: str) -> str:
    return f"echo 1 | sudo tee /sys/bus/usb-serial/devices/{tty}/latency_timer"


def _check_access(port: Path) -> Check:
    if os.access(port, os.R_OK | os.W_OK):
        return Check("permissions.port", "ok", f"{port} may be read and written")
    info = port.stat()
    try:
        import grp

        group = grp.getgrgid(info.st_gid).gr_name
    except (ImportError, KeyError):
        group = "dialout"
    if info.st_mode & stat.S_IRGRP and info.st_mode & stat.S_IWGRP and group != "root":
        fix = f"sudo usermod -aG {group} $USER    (then log out and in again)"
    else:
        fix = f"a udev rule that gives {port} to the group dialout; until the next plugging: sudo chmod a+rw {port}"
    return Check("permissions.port", "failed", f"{port} may not be read and written", fix)


def can_interfaces(sys: Path = SYS) -> list[str]:
    """List the names of the kernel's CAN interfaces."""
    found = sorted((sys / "class" / "net").glob("*/type"))
    return [path.parent.name for path in found if path.read_text(encoding="ascii").strip() == _CAN_INTERFACE]


def can_details(interface: str) -> Mapping[str, Any]:
    """Ask `ip`, which only reads, for kind, state and bitrate of a CAN interface; empty where it cannot tell."""
    if (ip := shutil.which("ip", path=f"{os.environ.get('PATH', '')}:/usr/sbin:/sbin")) is None:
        return {}
    command = [ip, "-details", "-json", "link", "show", interface]
    try:
        outcome = subprocess.run(command, capture_output=True, text=True, timeout=5, check=False)
        links = json.loads(outcome.stdout or "[]")
    except (OSError, ValueError, subprocess.TimeoutExpired):
        return {}
    info = (links[0] if links else {}).get("linkinfo", {})
    data = info.get("info_data", {})
    details = {
        "kind": info.get("info_kind"),
        "state": data.get("state"),
        "bitrate": data.get("bittiming", {}).get("bitrate"),
    }
    return {key: value for key, value in details.items() if value is not None}


def check_can_interface(interface: str, bitrate: int, details: Mapping[str, Any], *, sys: Path = SYS) -> Check:
    """Judge an interface of the kernel: there, up, not bus-off, and at the sensor's bitrate.

    Parameters
    ----------
    details : mapping
        As `can_details` gives them.
    """
    name = "permissions.can"
    up = f"sudo ip link set {interface} up type can bitrate {bitrate}"
    folder = sys / "class" / "net" / interface
    if not folder.exists():
        fix = f"plug the adapter in (ftdrive devices lists the interfaces), then {up}"
        return Check(name, "failed", f"there is no interface {interface}", fix)
    if (folder / "type").read_text(encoding="ascii").strip() != _CAN_INTERFACE:
        return Check(name, "failed", f"{interface} is not a CAN interface", "ftdrive devices lists them")
    flags = int((folder / "flags").read_text(encoding="ascii"), 16)
    if not flags & 1:
        return Check(name, "failed", f"{interface} is down", up)
    if details.get("state") == "BUS-OFF":
        fix = f"check wiring, termination and bitrate, then sudo ip link set {interface} type can restart"
        return Check(name, "failed", f"{interface} has switched itself off (bus-off)", fix)
    found = details.get("bitrate")
    if found is not None and found != bitrate:
        fix = f"sudo ip link set {interface} down && {up}"
        return Check(name, "failed", f"{interface} is at {found} bit/s, the sensor at {bitrate}", fix)
    state = details.get("state", details.get("kind", "state unknown"))
    rate = "bitrate unknown" if found is None else f"{found} bit/s"
    if state in {"ERROR-WARNING", "ERROR-PASSIVE"}:
        return Check(name, "warning", f"{interface} is up, {rate}, {state}", "check wiring and termination of the bus")
    return Check(name, "ok", f"{interface} is up, {rate}, {state}")


def _links(folder: Path) -> list[Path]:
    return sorted(folder.iterdir()) if folder.is_dir() else []
