"""The text of Robotiq's URCap: readings in any pieces, and a connection in memory that fails."""

import socket
from collections.abc import Callable
from typing import Any

import pytest

from ftdrivers.clock import Clock
from ftdrivers.errors import BadUrl, ConnectError, DeviceFault, DeviceTimeout, StreamBroken
from ftdrivers.registry import sensor_from_url
from ftdrivers.robotiq.sensor import Readings, RobotiqUrcap
from tests.fake_clock import FakeClock
from tests.unit.drivers.in_one_thread import InOneThread

TEXT = b"( 1.500000 , -2.250000 , 30.000000 , 0.100000 , -0.050000 , 0.025000 )"
VALUES = [1.5, -2.25, 30.0, 0.1, -0.05, 0.025]


@pytest.mark.parametrize(
    "damaged",
    [b"( 1 , 2 , 3 , 4 , 5 )", b"( 1 , 2 , 3 , 4 , 5 , 6 , 7 )", b"( 1 , 2 , x , 4 , 5 , 6 )", b"1,2,3,4,5,6)"],
)
def test_damaged_readings_are_counted(damaged: bytes) -> None:
    readings = Readings()
    assert readings.feed(damaged + TEXT) == [(2, VALUES)]
    assert readings.damaged == 1


def test_a_stream_that_begins_within_a_reading_is_read_from_the_next_one() -> None:
    readings = Readings()
    assert readings.feed(TEXT[20:] + TEXT) == [(2, VALUES)]


class Socket:
    """Sends a reading each 10 ms, until `end` raises or returns other bytes."""

    def __init__(self, clock: FakeClock) -> None:
        self.clock, self.count, self.closed = clock, 0, False
        self.end: Callable[[], bytes] | None = None

    def connect(self, address: tuple[str, int], timeout_s: float) -> "Socket":
        assert address == ("10.0.0.2", 63351)
        assert timeout_s == 2.0
        return self

    def settimeout(self, timeout_s: float) -> None:
        self.timeout_s = timeout_s

    def recv(self, _: int) -> bytes:
        self.clock.advance(0.01)
        self.count += 1
        return TEXT.replace(b"1.5", b"1.%d" % (self.count % 7)) if self.end is None else self.end()

    def close(self) -> None:
        self.closed = True


class Sensor(InOneThread, RobotiqUrcap):
    def __init__(self, clock: Clock) -> None:
        super().__init__("10.0.0.2", clock=clock)


@pytest.fixture
def wire(monkeypatch: pytest.MonkeyPatch) -> Socket:
    wire = Socket(FakeClock())
    monkeypatch.setattr(socket, "create_connection", wire.connect)
    return wire


def silence(wire: Socket) -> bytes:
    wire.clock.advance(wire.timeout_s)
    raise TimeoutError


@pytest.mark.parametrize(
    ("end", "error"),
    [
        (lambda _: b"", StreamBroken),
        (lambda _: (_ for _ in ()).throw(ConnectionResetError()), StreamBroken),
        (silence, DeviceTimeout),
        (lambda _: TEXT.replace(b"30.0", b"-327.68"), DeviceFault),
    ],
    ids=["closed", "reset", "silent", "saturated"],
)
def test_lost_connection_silence_and_saturation_are_errors(wire: Socket, end: Any, error: type[Exception]) -> None:
    with Sensor(wire.clock) as sensor:
        wire.end = lambda: end(wire)
        with pytest.raises(error):
            sensor.collect(1.0)


def test_a_controller_without_the_urcap_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any) -> None:
        raise ConnectionRefusedError("refused")

    monkeypatch.setattr(socket, "create_connection", refuse)
    with pytest.raises(ConnectError, match=r"63351 does not answer.*URCap"):
        Sensor(FakeClock()).open()


@pytest.mark.parametrize(
    ("address", "message"),
    [
        ("//10.0.0.2:port", r"'10.0.0.2:port' is not a host with a port: write robotiq-ft300://HOST:63351 "),
        ("//dev/ttyUSB0", "robotiq-ft300:///dev/ttyUSB0 for a serial port"),
        ("//10.0.0.2:0", "allowed are 1 to 65535"),
        ("//10.0.0.2:63351?port=1234", "two ports, 63351 and 1234; leave one out"),
        ("10.0.0.2:63351", r"names no device; write it like robotiq-ft300://192\.168\.1\.10:63351$"),
    ],
)
def test_a_mistyped_address_is_answered_with_what_to_write(address: str, message: str) -> None:
    with pytest.raises(BadUrl, match=message):
        sensor_from_url(f"robotiq-ft300:{address}")
