"""Which sensors are on a CAN bus: found by what is heard or by their answer, with nothing but requests to read."""

import contextlib
import os
import re
import threading
import tty
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Self

import numpy as np
import pytest
import serial

from drivers import probe_can as module
from drivers.errors import ConnectError, PortInUse
from drivers.probe_can import probe_can
from drivers.registry import sensor_from_url
from mocks.ati_can import AtiCanNode
from mocks.robotous import RobotousCanNode

ATI_SERIAL, ATI_FIRMWARE = "t2050", "t20F0"
ROBOTOUS_MODEL = "t06480100000000000000"

STREAM = ["t00180BFF01020304050607", "t00280102030405000000"]


@pytest.fixture(autouse=True)
def _short(monkeypatch: pytest.MonkeyPatch) -> None:
    """All that these tests send comes many times in this time."""
    monkeypatch.setattr(module, "_LISTEN_S", 0.4)


class Bus:
    """An slcan adapter on a bus where somebody else sends the same frames again and again, and nobody answers."""

    def __init__(self, *frames: str, answers: dict[str, str] | None = None) -> None:
        self._cycle = "".join(f"{frame}\r" for frame in frames).encode()
        self._answers = answers or {}
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self.lines: list[str] = []

    def __enter__(self) -> Self:
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.path = os.ttyname(self._slave)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
        os.close(self._master)
        os.close(self._slave)

    @property
    def sent(self) -> list[str]:
        """Frames that were put on the bus."""
        return [line for line in self.lines if line.startswith(("t", "T", "r", "R"))]

    def _run(self) -> None:
        data, is_open = b"", False
        while not self._stop.wait(0.02):
            with contextlib.suppress(BlockingIOError):
                data += os.read(self._master, 4096)
            *lines, data = data.split(b"\r")
            for line in lines:
                self.lines.append(text := line.decode())
                is_open = {"O": True, "C": False}.get(text, is_open)
                if text in self._answers:
                    os.write(self._master, f"{self._answers[text]}\r".encode())
            if is_open and self._cycle:
                os.write(self._master, self._cycle)


@pytest.fixture
def start(cell_time: Any) -> Iterator[Callable[..., str]]:
    devices = []
    rng = np.random.default_rng(0)

    def measure(n: int) -> Any:
        return rng.normal(size=(n, 6)) + 3

    def run(kind: Any, **options: Any) -> str:
        devices.append(kind(measure, seed=1, clock=cell_time.of_devices, **options))
        return str(devices[-1].start())

    yield run
    for device in devices:
        device.stop()


@pytest.mark.parametrize(
    ("kind", "options", "bitrate", "base", "url", "what"),
    [
        (
            AtiCanNode,
            {},
            250_000,
            0x20,
            "ati-can://{}?interface=slcan&bitrate=250000",
            "ATI NETCANOEM, serial FT12345, firmware 3.8 build 2",
        ),
        (
            AtiCanNode,
            {"base": 0x7F, "bitrate": 500_000},
            500_000,
            0x7F,
            "ati-can://{}?interface=slcan&bitrate=500000&base=0x7F",
            "ATI NETCANOEM, serial FT12345, firmware 3.8 build 2",
        ),
        (RobotousCanNode, {}, 1_000_000, 0x20, "robotous-can://{}?interface=slcan", "Robotous RFT60-HA01"),
        (
            RobotousCanNode,
            {"streaming_at_start": True},
            1_000_000,
            0x20,
            "robotous-can://{}?interface=slcan",
            "it streams",
        ),
    ],
)
def test_a_sensor_shows_itself_and_its_address_works(
    start: Callable[..., str],
    cell_time: Any,
    kind: Any,
    options: dict[str, Any],
    bitrate: int,
    base: int,
    url: str,
    what: str,
) -> None:
    port = start(kind, **options)
    (answer,) = probe_can(port, interface="slcan", clock=cell_time.of_drivers, bitrate=bitrate, base=base)
    assert (answer.url, answer.what) == (url.format(port), what)
    assert answer.url is not None
    with sensor_from_url(answer.url, clock=cell_time.of_drivers) as sensor:
        assert len(sensor.collect(0.2).seq)


def test_the_address_of_an_adapter_with_a_strange_name_works(
    start: Callable[..., str], cell_time: Any, tmp_path: Path
) -> None:
    port = tmp_path / "my adapter #1?50%20"
    port.symlink_to(start(AtiCanNode))
    (answer,) = probe_can(str(port), interface="slcan", clock=cell_time.of_drivers, bitrate=250_000)
    assert answer.url is not None
    with sensor_from_url(answer.url, clock=cell_time.of_drivers) as sensor:
        assert len(sensor.collect(0.2).seq)


def test_a_sensor_elsewhere_is_not_found(start: Callable[..., str], cell_time: Any) -> None:
    assert probe_can(start(AtiCanNode, base=0x7F), interface="slcan", clock=cell_time.of_drivers, bitrate=250_000) == []
    assert probe_can(start(RobotousCanNode), interface="slcan", clock=cell_time.of_drivers, bitrate=500_000) == []


@pytest.mark.parametrize(
    ("bitrate", "sent"), [(250_000, [ATI_SERIAL]), (1_000_000, [ATI_SERIAL, ROBOTOUS_MODEL]), (500_000, [ATI_SERIAL])]
)
def test_a_silent_bus_is_asked_by_readings_only(bitrate: int, sent: list[str]) -> None:
    with Bus() as bus:
        assert probe_can(bus.path, interface="slcan", bitrate=bitrate) == []
    assert bus.sent == sent


@pytest.mark.parametrize(
    ("frames", "sent", "refused"),
    [
        (["t201601020304050A"], [ROBOTOUS_MODEL], "ATI NETCANOEM at base 0x20 was not asked, .* sends on 0x201;"),
        (["t705105", "t18520102"], [ROBOTOUS_MODEL], "ATI .* something else sends on 0x705;"),
        (["t0648AABBCCDDEEFF0011"], [ATI_SERIAL], "Robotous was not asked, .* 0x064;"),
        (["t0012BEEF"], [ATI_SERIAL], "Robotous was not asked, .* 0x001;"),
        (STREAM[:1], [ATI_SERIAL], "Robotous was not asked, .* 0x001;"),
        ([STREAM[0].replace("0B", "33"), STREAM[1]], [ATI_SERIAL], "Robotous was not asked, .* 0x001, 0x002;"),
        ([STREAM[0], "t002801020304057F0000"], [ATI_SERIAL], "Robotous was not asked"),
        (["t3018AABBCCDDEEFF0011", "T000002050"], [ATI_SERIAL, ROBOTOUS_MODEL], None),
    ],
    ids=["a PDO", "CANopen", "command", "short", "half", "no sample", "no overload", "elsewhere"],
)
def test_identifiers_in_use_by_something_else_are_left_alone(
    frames: list[str], sent: list[str], refused: str | None
) -> None:
    with Bus(*frames) as bus:
        answers = probe_can(bus.path, interface="slcan", bitrate=1_000_000)
    assert bus.sent == sent
    assert all(answer.url is None for answer in answers)
    if refused is None:
        assert answers == []
    else:
        (answer,) = answers
        assert re.search(refused, answer.what), answer.what
        assert bus.path in answer.what  # the address, for who knows better


def test_a_sensor_that_another_host_reads_is_found_without_a_question() -> None:
    with Bus("t2000", "t200800000064012C01F4", "t2016FF38FE70FDA8") as bus:
        (answer,) = probe_can(bus.path, interface="slcan", bitrate=250_000)
    assert answer.what == "another host reads it"
    assert answer.url == f"ati-can://{bus.path}?interface=slcan&bitrate=250000"
    assert bus.sent == []


@pytest.mark.parametrize(
    "answers",
    [
        {ATI_SERIAL: "t20534142AA"},  # too short for a serial number
        {ATI_SERIAL: "t20584654313233343500"},  # and then no firmware
        {ROBOTOUS_MODEL: "t00180600000000000000\rt00280000000000000000"},  # to another command
        {ROBOTOUS_MODEL: "t00180152465436302D48"},  # half a name
        {ROBOTOUS_MODEL: "t001801FFFFFFFFFFFFFF\rt0028FFFFFFFFFFFFFFFF"},  # no name
    ],
)
def test_answers_of_something_else_are_no_sensor(answers: dict[str, str]) -> None:
    with Bus(answers=answers) as bus:
        assert probe_can(bus.path, interface="slcan", bitrate=1_000_000) == []
    assert set(answers) <= set(bus.sent)


def test_a_bus_that_does_not_open() -> None:
    with pytest.raises(ConnectError, match="no /dev/no-such-port"):
        probe_can("/dev/no-such-port", interface="slcan", bitrate=250_000)
    with pytest.raises(ConnectError, match="no-such-can up type can bitrate 250000"):
        probe_can("no-such-can", interface="socketcan", bitrate=None)
    with Bus() as bus, pytest.raises(ConnectError, match="Invalid bitrate"):
        probe_can(bus.path, interface="slcan", bitrate=300_000)


def test_an_adapter_that_another_program_reads_is_left_alone(start: Callable[..., str], cell_time: Any) -> None:
    port = start(AtiCanNode)
    with sensor_from_url(f"ati-can://{port}?interface=slcan", clock=cell_time.of_drivers) as sensor:
        with pytest.raises(PortInUse, match=f"in use by another program; end it, `fuser -v {port}` names it"):
            probe_can(port, interface="slcan", clock=cell_time.of_drivers, bitrate=250_000)
        with pytest.raises(serial.SerialException):
            serial.Serial(port, exclusive=True)
        assert len(sensor.collect(0.2))
        assert sensor.health().stale == sensor.health().lost == 0
    with serial.Serial(port, exclusive=True), pytest.raises(PortInUse):
        probe_can(port, interface="slcan", clock=cell_time.of_drivers, bitrate=250_000)
    (answer,) = probe_can(port, interface="slcan", clock=cell_time.of_drivers, bitrate=250_000)
    assert answer.url
