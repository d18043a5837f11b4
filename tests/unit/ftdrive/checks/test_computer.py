"""The findings of doctor in made-up states of a computer, and their fixes."""

import os
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from ftdrive.cell import config
from ftdrive.checks import computer as checks
from ftdrive.checks.check import Check
from ftdrive.checks.computer import SensorAddress
from ftdrivers.errors import BadUrl


@pytest.fixture
def computer(tmp_path: Path) -> Path:
    """/dev with an FTDI adapter that has a name by id, /sys that says how slow it is."""
    (tmp_path / "dev/serial/by-id").mkdir(parents=True)
    (tmp_path / "dev/ttyUSB0").touch(mode=0o660)
    (tmp_path / "dev/serial/by-id/usb-FTDI_X-if00-port0").symlink_to(tmp_path / "dev/ttyUSB0")
    timer = tmp_path / "sys/bus/usb-serial/devices/ttyUSB0"
    timer.mkdir(parents=True)
    (timer / "latency_timer").write_text("16\n")
    return tmp_path


def port_checks(computer: Path, port: str) -> dict[str, Check]:
    found = checks.check_serial_port(computer / "dev" / port, sys=computer / "sys", dev=computer / "dev")
    return {check.name.removeprefix("permissions."): check for check in found}


def test_the_workcell_is_counted_and_what_cannot_be_is_named() -> None:
    tool = config.ToolConfig(cylinders_mm=((0, 60, 90),))
    work = config.WorkcellConfig(planes_mm=((0, 0, 1, 0), (-1, 0, 0, -800)), boxes_mm=((600, 600, 0, 800, 800, 200),))
    cell = config.CellConfig(config.RobotConfig(""), config.SensorConfig(""), tool, replace(work, measured=True))
    found = checks.check_workcell(cell, "UR5e")
    assert (found.state, found.found) == ("ok", "tool of 1 cylinder, 2 planes, 1 box, measured")
    wrong = replace(cell, workcell=config.WorkcellConfig(planes_mm=((1, 0, 0, 800),)))
    found = checks.check_workcell(wrong, "UR5e")
    assert (found.name, found.state) == ("workcell.measured", "failed")
    assert "[1, 0, 0, 800]" in found.found
    assert "Give [-1, 0, 0, -800]" in found.found


def test_a_slow_adapter_with_a_short_name(computer: Path) -> None:
    found = port_checks(computer, "ttyUSB0")
    assert found["port"].state == "ok"
    assert found["by-id"].state == "warning"
    assert "by-id/usb-FTDI_X-if00-port0" in str(found["by-id"].fix)
    assert found["latency_timer"].state == "warning"
    assert found["latency_timer"].fix == "echo 1 | sudo tee /sys/bus/usb-serial/devices/ttyUSB0/latency_timer"


def test_a_quick_adapter_with_its_name_by_id(computer: Path) -> None:
    (computer / "sys/bus/usb-serial/devices/ttyUSB0/latency_timer").write_text("1\n")
    found = port_checks(computer, "serial/by-id/usb-FTDI_X-if00-port0")
    assert {check.state for check in found.values()} == {"ok"}


def test_a_port_without_id_and_timer_is_not_a_failure(computer: Path) -> None:
    (computer / "dev/ttyS0").touch()
    found = port_checks(computer, "ttyS0")
    assert [check.state for check in found.values()] == ["ok", "skipped", "skipped"]


def test_a_system_without_device_files_is_not_a_failure(tmp_path: Path) -> None:
    (found,) = checks.check_serial_port(Path("COM3"), sys=tmp_path / "sys", dev=tmp_path / "dev")
    assert found.state == "skipped"


@pytest.mark.parametrize(
    ("group", "mode", "fix"),
    [("uucp", 0o660, "sudo usermod -aG uucp $USER"), ("root", 0o600, 'KERNEL=="ttyUSB[0-9]*", GROUP="dialout"')],
)
def test_a_forbidden_port_names_its_group(
    computer: Path, monkeypatch: pytest.MonkeyPatch, group: str, mode: int, fix: str
) -> None:
    (computer / "dev/ttyUSB0").chmod(mode)
    monkeypatch.setattr(os, "access", lambda *_: False)
    monkeypatch.setattr("grp.getgrgid", lambda _: SimpleNamespace(gr_name=group))
    found = port_checks(computer, "ttyUSB0")["port"]
    assert found.state == "failed"
    assert fix in str(found.fix)


@pytest.fixture
def can0(tmp_path: Path) -> Path:
    for name, kind in (("can0", "280"), ("eth0", "1")):
        folder = tmp_path / "class/net" / name
        folder.mkdir(parents=True)
        (folder / "type").write_text(f"{kind}\n")
        (folder / "flags").write_text("0x40081\n")
    return tmp_path


@pytest.mark.parametrize(
    ("details", "state", "fix"),
    [
        ({"state": "ERROR-ACTIVE", "bitrate": 250_000}, "ok", None),
        ({"kind": "vcan"}, "ok", None),
        ({}, "ok", None),
        ({"state": "ERROR-PASSIVE", "bitrate": 250_000}, "warning", "termination"),
        ({"state": "BUS-OFF", "bitrate": 250_000}, "failed", "sudo ip link set can0 type can restart"),
        (
            {"state": "ERROR-ACTIVE", "bitrate": 500_000},
            "failed",
            "sudo ip link set can0 down && sudo ip link set can0 up type can bitrate 250000",
        ),
    ],
)
def test_can_interface_that_is_up(can0: Path, details: dict[str, Any], state: str, fix: str | None) -> None:
    found = checks.check_can_interface("can0", 250_000, details, sys=can0)
    assert found.state == state
    assert (found.fix is None) if fix is None else (fix in str(found.fix))


def test_can_interface_that_is_down_missing_or_something_else(can0: Path) -> None:
    (can0 / "class/net/can0/flags").write_text("0x40080\n")
    down = checks.check_can_interface("can0", 1_000_000, {}, sys=can0)
    assert (down.state, down.fix) == ("failed", "sudo ip link set can0 up type can bitrate 1000000")
    assert checks.check_can_interface("can1", 250_000, {}, sys=can0).state == "failed"
    assert checks.check_can_interface("eth0", 250_000, {}, sys=can0).state == "failed"
    assert checks.can_interfaces(can0) == ["can0"]
    assert checks.can_interfaces(can0 / "nothing") == []


@pytest.mark.parametrize(
    ("url", "place", "port", "interface"),
    [
        ("ati-can://can0?bitrate=500000", "can0", None, "can0"),
        ("ati-can://can0?base=0x7F", "socketcan://can0?base=0x7F", None, "can0"),
        ("robotous-can://can1?rate=500", "can1", None, "can1"),
        *(
            (f"{name}:///dev/{written}?interface=slcan{more}", f"slcan:///dev/{written}?bitrate={rate}", port, None)
            for name, written, more, rate, port in (
                ("ati-can", "ttyACM0", "&bitrate=500000", 500_000, "/dev/ttyACM0"),
                ("ati-can", "ttyACM0@1000000", "", 250_000, "/dev/ttyACM0"),
                ("robotous-can", "my%20port", "", 1_000_000, "/dev/my port"),
            )
        ),
        ("ati-can:///dev/ttyUSB0?interface=robotell", None, "/dev/ttyUSB0", None),
        ("ati-can://PCAN_USBBUS1?interface=pcan", None, None, None),
        ("bota:///dev/ttyUSB1?sinc=512", "/dev/ttyUSB1", "/dev/ttyUSB1", None),
        ("bota:///dev/serial/by-id/my%20port", "/dev/serial/by-id/my port", "/dev/serial/by-id/my port", None),
        ("bota://COM3", "COM3", "COM3", None),
        ("robotiq-ft300:///dev/ttyUSB0", "/dev/ttyUSB0", "/dev/ttyUSB0", None),
        ("robotiq-ft300://192.168.1.10", None, None, None),
        ("robotiq-ft300://192.168.1.10:63351", None, None, None),
        ("ur-ft://10.0.0.1?counts_per_N=1&counts_per_Nm=1", None, None, None),
        ("ati-netft://192.168.1.1", None, None, None),
    ],
)
def test_what_an_address_says(url: str, place: str | None, port: str | None, interface: str | None) -> None:
    address = SensorAddress.of(url)
    assert address.place == place
    assert address.serial_port == (None if port is None else Path(port))
    assert address.can_interface == interface
    assert address.host == next((host for host in ("10.0.0.1", "192.168.1.10", "192.168.1.1") if host in url), None)


def test_what_is_no_address_is_a_mistake_of_the_user() -> None:
    with pytest.raises(BadUrl, match=r"write it like ati-can://can0"):
        SensorAddress.of("ati-can://[can0")


@pytest.mark.parametrize(("free", "state"), [(1e8, "failed"), (5e8, "warning"), (5e9, "ok")])
def test_a_disk_with_little_room(free: float, state: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shutil.disk_usage", lambda _: SimpleNamespace(free=free))
    found = checks.check_disk(tmp_path)
    assert (found.state, found.fix is None) == (state, state == "ok")
