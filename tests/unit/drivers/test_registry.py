"""Addresses of sensors: what they build, and what is refused before any device is touched."""

import contextlib
import json
from collections.abc import Callable
from importlib.metadata import EntryPoint
from inspect import signature
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
from click.testing import CliRunner

from ftdrive.cell.config import FORMAT, CellConfig, RobotConfig, SensorConfig
from ftdrive.cell.devices import build_arm
from ftdrive.commands import doctor
from ftdrive.errors import ConfigError
from ftdrivers.bota.sensor import BotaSensor
from ftdrivers.errors import BadUrl
from ftdrivers.interfaces import Fact
from ftdrivers.registry import Options, arm_class, in_url, sensor_from_url, split_url
from ftdrivers.sensors import SENSORS
from ftdrivers.streaming.sensor import StreamingSensor
from ftdrivers.ur.arm import UrArm
from ftdrivers.wires.serial_port import SerialPort


def test_a_strange_name_of_a_port_is_read_back_from_its_address() -> None:
    for path in ("/dev/my port #1?50%20", "/dev/ü&=+[x]", "a:b@c/d"):
        parts = split_url(f"bota://{in_url(path)}?baud=460800")
        assert (parts.address, parts.query, parts.fragment) == (path, "baud=460800", "")


def test_usual_names_stand_in_an_address_as_they_are() -> None:
    for path in ("/dev/serial/by-path/pci-0000:00:14.0-usb-0:2:1.0-port0", "COM3", "/dev/ttyACM0@1000000"):
        assert in_url(path) == path


def arguments(url: str) -> dict[str, Any]:
    """Return the arguments with which the driver is built from an address."""
    parts = split_url(url)
    driver = EntryPoint("", SENSORS[parts.scheme].driver, "").load()
    options = Options(url, parts.query)
    return dict(driver.from_url.__func__(lambda _, **arguments: arguments, parts.address, options, sign=-1))


@pytest.mark.parametrize(
    ("url", "name", "given"),
    [
        (
            "ati-can://can0",
            "ATI CAN sensor 0x20 on socketcan can0",
            {"bitrate": 250_000, "base": 0x20, "slot": 0, "unit_codes": None, "counts_per_unit": None},
        ),
        (
            "ati-can:///dev/ttyACM0?interface=slcan&units=lbf,N-mm&counts=1000000,2000000",
            "ATI CAN sensor 0x20 on slcan /dev/ttyACM0",
            {"interface": "slcan", "unit_codes": (1, 4), "counts_per_unit": (1_000_000, 2_000_000)},
        ),
        (
            "ati-serial:///dev/serial/by-id/usb-FTDI_My%20Box-if00?calibration=2",
            "ATI serial sensor on /dev/serial/by-id/usb-FTDI_My Box-if00",
            {"calibration": 2},
        ),
        (
            "robotous-serial:///dev/ttyUSB0?baud=921600&rate=1000",
            "Robotous sensor on /dev/ttyUSB0",
            {"baud": 921_600, "rate_Hz": 1000},
        ),
        ("robotiq-ft300:///dev/ttyUSB0", "Robotiq FT 300 on /dev/ttyUSB0", {}),
        ("bota:///dev/ttyUSB0?sinc=512", "Bota sensor on /dev/ttyUSB0", {"baud": None, "sinc": 512}),
        (
            "ati-netft://192.168.1.1?onrobot=1&rdt_port=65535&http_port=1",
            "OnRobot Ethernet sensor at 192.168.1.1",
            {"onrobot": True, "rdt_port": 65535, "http_port": 1},
        ),
        (
            "ur-ft://10.0.0.2?counts_per_N=1&counts_per_Nm=2",
            "wrist sensor of the arm at 10.0.0.2",
            {"counts_per_N": 1, "counts_per_Nm": 2},
        ),
    ],
)
def test_a_driver_gets_the_options_of_its_address(url: str, name: str, given: dict[str, Any]) -> None:
    sensor = sensor_from_url(url, sign=-1)
    assert isinstance(sensor, StreamingSensor)
    assert sensor.name == name
    assert given.items() | {("sign", -1)} <= arguments(url).items()


@pytest.mark.parametrize(
    ("scheme", "module", "setting"),
    [
        ("ati-serial", "ati.serial", (1_250_000, True)),
        ("robotous-serial", "robotous.sensor", (115_200, False)),
        ("robotiq-ft300", "robotiq.sensor", (19_200, False)),
        ("bota", "bota.sensor", (460_800, False)),
    ],
)
def test_a_serial_sensor_has_the_bit_rate_and_parity_of_its_manual(
    scheme: str, module: str, setting: tuple[int, bool], monkeypatch: pytest.MonkeyPatch
) -> None:
    port = Mock()
    monkeypatch.setattr(f"ftdrivers.{module}.SerialPort", port)
    sensor_from_url(f"{scheme}:///dev/ttyUSB0")
    first = port.call_args_list[0]
    call = signature(SerialPort).bind(*first.args, **first.kwargs)
    call.apply_defaults()
    assert (call.arguments["baud"], call.arguments["even_parity"]) == setting


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("can0", "write it like ati-can://can0"),
        ("ati-cam://dev", "unknown sensor 'ati-cam': did you mean ati-can://?"),
        ("ati-can://", "names no device"),
        ("ati-can://[can0", "write it like"),
        (
            "ati-can://can0?bitrat=1",
            "bitrat; known: base, bitrate, counts, interface, range, recover, serial, slot, units",
        ),
        ("ati-can://can0?units=lbf", "units are 'lbf'; give one of lbf N klbf"),
        ("ati-can://can0?counts=1000000", "'counts' is '1000000'; give two"),
        ("robotous-can://can0?ids=0xF0,0xF1", "ids are '0xF0,0xF1'; give three"),
        ("ati-can://can0?bitrate=fast", "whole number"),
        ("ati-can://can0?base=0x80", "allowed are 0 to 127"),
        ("ati-can://can0?base", "key=value"),
        ("ati-can://can0?base=1&base=2", "twice"),
        ("ati-netft://x?rdt_port=65536", "allowed are 1 to 65535"),
        ("robotous-can://can0?rate=123", "rate is 123 Hz; choose one of 10, 20"),
        ("robotous-serial:///dev/x?rate=1000", "choose at most 333 Hz"),
        ("robotous-serial:///dev/x?baud=60000", "baud is 60000; choose"),
        ("bota:///dev/x?sinc=63", "choose 64 to 2048"),
        ("bota:///dev/x?baud=38400", "choose one of 9600"),
        ("bota:///dev/x?range=300", "such as 300,30 or"),
        ("bota:///dev/x?serial=", "empty"),
    ],
)
def test_mistakes_are_named(url: str, message: str) -> None:
    with pytest.raises(BadUrl, match=message.replace("?", r"\?")) as caught:
        sensor_from_url(url)
    assert url in str(caught.value)


ACME = """
import time
import numpy as np
from ftdrivers.interfaces import ArmStatus, DeviceInfo, Diagnosis, FtSamples
from ftdrivers.streaming import StreamingSensor
from ftdrivers.ur.arm import UrArm

class Sensor(StreamingSensor):
    @classmethod
    def from_url(cls, address, options, *, sign=1):
        sensor = cls(f"Acme sensor on {address}", sign=sign)
        sensor.gain = options.integer("gain", 1, 1, 10)
        return sensor

    def _connect(self):
        self.seq = 0
        return DeviceInfo("Acme", "1", "1.0")

    def _read_block(self):
        time.sleep(0.005)
        self.seq += 1
        return FtSamples(np.array([time.monotonic_ns()]), np.array([np.nan]), np.array([self.seq]),
                         np.zeros((1, 0), np.int32), self.gain * np.ones((1, 6)), np.zeros(1, np.uint32))

    def _disconnect(self):
        pass

class Arm(UrArm):
    def open(self, *, control=False):
        pass

    def close(self):
        pass

    def identify(self):
        return DeviceInfo("Acme arm", "7", "2.0")

    def in_remote_control(self):
        return None

    def diagnose(self):
        return [Diagnosis("brakes", False, "a brake is worn", "call Acme")]

    def status(self):
        now_ns = time.monotonic_ns()
        return ArmStatus(now_ns, now_ns / 1e9, "running", "normal", "stopped", None, 1.0, 1.0, None, None, None)
"""

Install = Callable[..., None]


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Install:
    """Put a package in place as pip would: a module, and its metadata with entry points."""

    def install(name: str, entry_points: str, source: str = "") -> None:
        site = tmp_path / name
        metadata = site / f"{name}-1.0.dist-info"
        metadata.mkdir(parents=True)
        (site / f"{name}.py").write_text(source, encoding="utf-8")
        (metadata / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n", encoding="utf-8")
        (metadata / "entry_points.txt").write_text(entry_points, encoding="utf-8")
        monkeypatch.syspath_prepend(site)

    return install


def test_another_package_brings_a_sensor_and_an_arm(install: Install) -> None:
    points = "[ftdrive.sensors]\nacme-usb = acme_ft:Sensor\n[ftdrive.arms]\nacme = acme_ft:Arm\n"
    install("acme_ft", points, ACME)
    sensor = sensor_from_url("acme-usb:///dev/acme0?gain=3&range=300,30", sign=-1)
    with contextlib.closing(sensor):
        sensor.open()
        assert sensor.identify().model == "Acme"
        assert sensor.identify().facts == {
            "serial": Fact("1", "device"),
            "range": Fact((300, 300, 300, 30, 30, 30), "configured"),
            "sign": Fact(-1, "configured"),
        }
        assert (sensor.collect(0.05).wrench == -3).all()
    with pytest.raises(BadUrl, match=r"gian.* gain, range, recover, serial"):
        sensor_from_url("acme-usb:///dev/acme0?gian=3")
    with pytest.raises(BadUrl, match=r"one of ati-can, .*, acme-usb"):
        sensor_from_url("kms40:///dev/acme0")
    assert issubclass(arm_class("acme"), UrArm)
    assert arm_class("acme") is not UrArm
    anything = SensorConfig("acme-usb:///dev/acme0")
    assert type(build_arm(CellConfig(RobotConfig("127.0.0.1", driver="acme"), anything))) is arm_class("acme")
    with pytest.raises(ConfigError, match=r"^\[robot\] driver: .*'acmee'; .*\bacme\b"):
        build_arm(CellConfig(RobotConfig("127.0.0.1", driver="acmee"), anything))


def test_our_own_names_cannot_be_taken(install: Install) -> None:
    install("thief", "[ftdrive.sensors]\nbota = thief:Sensor\n")
    assert isinstance(sensor_from_url("bota:///dev/x"), BotaSensor)


def test_two_packages_with_one_name_are_both_named(install: Install) -> None:
    install("first_ft", "[ftdrive.sensors]\nshared = first_ft:Sensor\n")
    install("other_ft", "[ftdrive.sensors]\nshared = other_ft:Sensor\n")
    with pytest.raises(BadUrl, match=r"'shared' .*first_ft.* other_ft"):
        sensor_from_url("shared://x")


@pytest.mark.parametrize(
    ("source", "error"),
    [
        ("import no_such_library", "ModuleNotFoundError: No module named 'no_such_library'"),
        ("", "AttributeError: .*"),
    ],
)
def test_a_package_that_cannot_be_imported_is_named(install: Install, source: str, error: str) -> None:
    name = f"broken_ft_{len(source)}"
    install(name, f"[ftdrive.sensors]\nbroken = {name}:Sensor\n", source)
    with pytest.raises(BadUrl, match=f"the driver 'broken' cannot be imported .{error}.: reinstall {name}"):
        sensor_from_url("broken://x")


def test_a_driver_that_this_system_cannot_run_asks_for_linux(install: Install) -> None:
    lacking = "raise ModuleNotFoundError('as on Windows', name='termios')"
    install("posix_ft", "[ftdrive.sensors]\nposix = posix_ft:Sensor\n", lacking)
    with pytest.raises(BadUrl, match=r"the driver 'posix' cannot be imported .*: use Linux"):
        sensor_from_url("posix://x")


def test_a_class_that_is_no_driver_is_named(install: Install) -> None:
    install("odd_ft", "[ftdrive.sensors]\nodd = odd_ft:Sensor\n", "class Sensor:\n    pass\n")
    with pytest.raises(BadUrl, match=r"odd://x: odd_ft:Sensor has no from_url, .*; reinstall odd_ft"):
        sensor_from_url("odd://x")


@pytest.mark.slow
def test_doctor_asks_the_arm_of_another_package_only_what_any_arm_knows(install: Install, tmp_path: Path) -> None:
    points = "[ftdrive.sensors]\nacme-usb = acme_arm:Sensor\n[ftdrive.arms]\nacme = acme_arm:Arm\n"
    install("acme_arm", points, ACME)
    path = tmp_path / "ftdrive.toml"
    path.write_text(
        f'format = "{FORMAT}"\n[robot]\nhost = "127.0.0.1"\ndriver = "acme"\n[sensor]\nurl = "acme-usb:///dev/acme0"\n',
        encoding="utf-8",
    )
    arguments = ["--config", str(path), "--runs", str(tmp_path), "--json"]
    outcome = CliRunner().invoke(doctor.doctor, arguments)
    checks = {check["name"]: check for check in json.loads(outcome.stdout)["checks"]}
    robot = {name: check for name, check in checks.items() if name.startswith("robot.")}
    assert robot["robot.reachable"]["found"] == "127.0.0.1 answers"
    assert robot["robot.identity"]["found"] == "Acme arm, serial 7, firmware 2.0"
    brakes = robot.pop("robot.brakes")
    assert (brakes["state"], brakes["found"], brakes["fix"]) == ("failed", "a brake is worn", "call Acme")
    assert {check["state"] for check in robot.values()} == {"ok", "skipped"}
    assert checks["clock.pace"]["state"] == "ok"


PLAIN = """
class Sensor:
    @classmethod
    def from_url(cls, address, options, *, sign=1):
        return cls()
"""


def test_a_driver_that_is_no_stream_of_ours_takes_no_options_of_ours(install: Install) -> None:
    install("plain_ft", "[ftdrive.sensors]\nplain = plain_ft:Sensor\n", PLAIN)
    assert type(sensor_from_url("plain://x")).__module__ == "plain_ft"
    for option in ("recover=1", "range=1,1", "serial=A"):
        with pytest.raises(BadUrl, match="no options recover, serial and range"):
            sensor_from_url(f"plain://x?{option}")
