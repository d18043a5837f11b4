"""Checks of this computer (disk, permissions, serial ports, CAN interfaces) and of the described tool and workcell.

Each finding names the exact command or action that fixes it. No check opens a device. The system folders /sys and /dev
are parameters; on a computer without them a check is skipped, which is not a failure.
"""

import json
import os
import re
import shutil
import stat
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryFile
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qsl, urlencode

from ftcalib.rounding import counted
from ftdrive.checks.check import Check, State
from ftdrive.errors import ConfigError
from ftdrivers.registry import in_url, split_url
from ftdrivers.sensors import SENSORS

if TYPE_CHECKING:
    from ftdrive.cell.config import CellConfig

SYS = Path("/sys")
DEV = Path("/dev")

# ARPHRD_CAN: the content of /sys/class/net/*/type for a CAN interface.
_CAN_INTERFACE = "280"
_LEAST_BYTES, _FEW_BYTES = 200_000_000, 1_000_000_000


@dataclass(frozen=True, slots=True)
class SensorAddress:
    """Address of a sensor, split into protocol, port or host, and options."""

    scheme: str
    address: str
    options: Mapping[str, str]

    @classmethod
    def of(cls, url: str) -> "SensorAddress":
        """Split a sensor's address into its parts. Raises `BadUrl` if it is not a valid address."""
        parts = split_url(url)
        return cls(parts.scheme, parts.address, dict(parse_qsl(parts.query)))

    @property
    def _wire(self) -> str | None:
        kind = SENSORS.get(self.scheme)
        return kind.wire if kind else None

    @property
    def serial_port(self) -> Path | None:
        """Serial port of the sensor or of its slcan adapter; None if there is none."""
        if self.scheme.endswith("-can") and self.options.get("interface") == "slcan":
            return Path(self.address.split("@")[0])
        is_path = self.address.startswith("/") and self.scheme != "ros2"
        return Path(self.address) if (self._wire == "serial" and self.host is None) or is_path else None

    @property
    def can_interface(self) -> str | None:
        """CAN interface of the kernel; None if there is none."""
        on_socketcan = self.scheme.endswith("-can") and self.options.get("interface", "socketcan") == "socketcan"
        return self.address if on_socketcan else None

    @property
    def host(self) -> str | None:
        """Host that sends the samples over Ethernet; None for another connection."""
        if self.scheme == "robotiq-ft300" and not self.address.startswith("/"):
            return re.sub(r":\d+$", "", self.address).strip("[]")
        return self.address.partition("/")[0] if self._wire == "ethernet" else None

    @property
    def place(self) -> str | None:
        """Argument for `ftdrive devices --probe` that finds this sensor; None if it cannot be probed."""
        if not self.scheme.endswith("-can"):
            return None if self.serial_port is None else str(self.serial_port)
        base = {key: self.options[key] for key in ("base",) if key in self.options}
        if self.options.get("interface") == "slcan":
            return f"slcan://{in_url(self.address)}?{urlencode({'bitrate': self.bitrate} | base)}"
        return f"socketcan://{self.address}?{urlencode(base)}" if self.can_interface and base else self.can_interface

    @property
    def bitrate(self) -> int:
        """Required bit rate of the CAN bus, bit/s."""
        kind = SENSORS.get(self.scheme)
        return int(self.options.get("bitrate", str(kind.bitrate if kind else 250_000)), 0)


def check_disk(folder: Path) -> Check:
    """Check that a folder, which may not exist yet, is writable and has enough free space."""
    name, there = "disk.runs", folder.absolute()
    while not there.exists():
        there = there.parent
    try:
        with TemporaryFile(dir=there) as file:
            file.write(b"ftdrive")
            file.flush()
        free = shutil.disk_usage(there).free
    except OSError as error:
        return Check(name, "failed", f"{there} cannot be written to ({error})", "give another folder with --runs DIR")
    state: State = "failed" if free < _LEAST_BYTES else "warning" if free < _FEW_BYTES else "ok"
    fix = None if state == "ok" else "free disk space, or give --runs DIR on another disk"
    return Check(name, state, f"{free / 1e9:.1f} GB free in {there}", fix)


def check_workcell(cell: "CellConfig", model: str | None) -> Check:
    """Check that the tool and its surroundings are described, plausible for this arm, and measured."""
    from ftdrive.planning.planner import require_possible

    name = "workcell.measured"
    if not cell.tool.cylinders_mm:
        fix = "describe the mounted equipment: set [tool] cylinders_mm in ftdrive.toml, or give --tool to calibrate"
        return Check(name, "warning", "no tool is described", fix)
    try:
        require_possible(cell, model)
    except ConfigError as error:
        return Check(name, "failed", str(error))
    if not cell.workcell.measured:
        fix = "measure tool, planes and boxes, then set measured = true in [workcell] of ftdrive.toml"
        return Check(name, "failed", "tool and surroundings are placeholders", fix)
    cylinders, planes = counted(len(cell.tool.cylinders_mm), "cylinder"), counted(len(cell.workcell.planes_mm), "plane")
    boxes = "1 box" if len(cell.workcell.boxes_mm) == 1 else f"{len(cell.workcell.boxes_mm)} boxes"
    return Check(name, "ok", f"tool of {cylinders}, {planes}, {boxes}, measured")


def check_permissions(address: SensorAddress, *, sys: Path = SYS, dev: Path = DEV) -> list[Check]:
    """Check that this user may access the sensor's port, and that the port is set up."""
    if (port := address.serial_port) is not None:
        return check_serial_port(port, sys=sys, dev=dev)
    if (interface := address.can_interface) is not None:
        return [check_can_interface(interface, address.bitrate, can_details(interface), sys=sys)]
    found = f"not applicable: {address.scheme} at {address.address} uses neither a serial port nor a CAN interface"
    return [Check("permissions.port", "skipped", found)]


def check_serial_port(port: Path, *, sys: Path = SYS, dev: Path = DEV) -> list[Check]:
    """Check that a serial port exists and is accessible, that its name survives replugging, and its latency is low."""
    if not dev.is_dir():
        return [Check("permissions.port", "skipped", f"not applicable: this system has no device files such as {port}")]
    if not port.exists():
        fix = "plug the adapter in; ftdrive devices lists the ports"
        return [Check("permissions.port", "failed", f"{port} does not exist", fix)]
    real = Path(os.path.realpath(port))
    checks = [_check_access(port)]
    name = name_by_id(port, dev=dev)
    if name is None:
        checks.append(Check("permissions.by-id", "skipped", "not applicable: the port has no permanent name"))
    elif port.parent == name.parent:
        checks.append(Check("permissions.by-id", "ok", "the name survives replugging"))
    else:
        found = f"{port} may name another device after replugging"
        checks.append(Check("permissions.by-id", "warning", found, f"write {name} in the sensor's address"))
    timer = sys / "bus" / "usb-serial" / "devices" / real.name / "latency_timer"
    if not timer.exists():
        checks.append(Check("permissions.latency_timer", "skipped", "not applicable: the port has no latency timer"))
        return checks
    latency_ms = timer.read_text(encoding="ascii").strip()
    found = f"the adapter delays data by up to {latency_ms} ms"
    state: State = "ok" if latency_ms == "1" else "warning"
    command = None if state == "ok" else latency_command(real.name)
    return [*checks, Check("permissions.latency_timer", state, found, command)]


def name_by_id(port: Path, *, dev: Path = DEV) -> Path | None:
    """Return the permanent name of a serial port, which survives replugging; None if there is none."""
    by_id, real = dev / "serial" / "by-id", os.path.realpath(port)
    links = sorted(by_id.iterdir()) if by_id.is_dir() else []
    return next((link for link in links if os.path.realpath(link) == real), None)


def latency_command(tty: str) -> str:
    """Return the command that sets the latency of a USB serial adapter to 1 ms until it is unplugged."""
    return f"echo 1 | sudo tee /sys/bus/usb-serial/devices/{tty}/latency_timer"


def _check_access(port: Path) -> Check:
    if os.access(port, os.R_OK | os.W_OK):
        return Check("permissions.port", "ok", f"{port} is readable and writable")
    info = port.stat()
    try:
        import grp

        group = grp.getgrgid(info.st_gid).gr_name
    except (ImportError, KeyError):
        group = "dialout"
    if info.st_mode & stat.S_IRGRP and info.st_mode & stat.S_IWGRP and group != "root":
        fix = f"sudo usermod -aG {group} $USER    (then log out and back in)"
    else:
        install = _udev_command(Path(os.path.realpath(port)).name)
        fix = f"{install}    (then log out and back in; for access until it is unplugged: sudo chmod a+rw {port})"
    return Check("permissions.port", "failed", f"{port} is not readable and writable", fix)


def _udev_command(tty: str) -> str:
    """Return the command that gives serial ports of this kind to the group dialout, and adds the user to it."""
    rule = f'SUBSYSTEM=="tty", KERNEL=="{tty.rstrip("0123456789")}[0-9]*", GROUP="dialout", MODE="0660"'
    return (
        f"echo '{rule}' | sudo tee /etc/udev/rules.d/60-ftdrive.rules && sudo udevadm control --reload && "
        "sudo udevadm trigger --subsystem-match=tty && sudo usermod -aG dialout $USER"
    )


def can_interfaces(sys: Path = SYS) -> list[str]:
    """Return the names of the kernel's CAN interfaces."""
    types = sorted((sys / "class" / "net").glob("*/type"))
    return [path.parent.name for path in types if path.read_text(encoding="ascii").strip() == _CAN_INTERFACE]


def can_details(interface: str) -> Mapping[str, Any]:
    """Return the kind, state and bit rate of a CAN interface as far as the command `ip` reports them."""
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
    bitrate = data.get("bittiming", {}).get("bitrate")
    details = {"kind": info.get("info_kind"), "state": data.get("state"), "bitrate": bitrate}
    return {key: value for key, value in details.items() if value is not None}


def check_can_interface(interface: str, bitrate: int, details: Mapping[str, Any], *, sys: Path = SYS) -> Check:
    """Check by `can_details` that a kernel CAN interface exists, is up, is not bus-off, and has the right bit rate."""
    name = "permissions.can"
    up = f"sudo ip link set {interface} up type can bitrate {bitrate}"
    if "/" in interface or interface.startswith("tty"):
        port = interface if "/" in interface else f"/dev/{interface}"
        fix = f"for a sensor on a serial port give {port}, for a CAN adapter give slcan://{port}?bitrate={bitrate}"
        return Check(name, "failed", f"{interface} is not a CAN interface", fix)
    folder = sys / "class" / "net" / interface
    if not folder.exists():
        fix = f"plug the adapter in (ftdrive devices lists the interfaces), then run {up}"
        return Check(name, "failed", f"there is no CAN interface {interface}", fix)
    if (folder / "type").read_text(encoding="ascii").strip() != _CAN_INTERFACE:
        return Check(name, "failed", f"{interface} is not a CAN interface", "ftdrive devices lists them")
    flags = int((folder / "flags").read_text(encoding="ascii"), 16)
    if not flags & 1:
        return Check(name, "failed", f"{interface} is down", up)
    if details.get("state") == "BUS-OFF":
        fix = f"check wiring, termination and bitrate, then run sudo ip link set {interface} type can restart"
        return Check(name, "failed", f"{interface} has switched off after bus errors (bus-off)", fix)
    found = details.get("bitrate")
    if found is not None and found != bitrate:
        fix = f"sudo ip link set {interface} down && {up}"
        return Check(name, "failed", f"{interface} runs at {found} bit/s, but the sensor at {bitrate}", fix)
    state = details.get("state", details.get("kind", "state unknown"))
    rate = "bitrate unknown" if found is None else f"{found} bit/s"
    if state in {"ERROR-WARNING", "ERROR-PASSIVE"}:
        return Check(name, "warning", f"{interface} is up, {rate}, {state}", "check wiring and termination of the bus")
    return Check(name, "ok", f"{interface} is up, {rate}, {state}")
