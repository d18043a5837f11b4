"""The serial port of a driver on a pseudo-terminal; the far side, played by the test, checks parity and makes marks."""

import fcntl
import os
import select
import sys
import termios
import time
import tty
from collections.abc import Iterator
from typing import Any

import pytest
import serial

from ftdrivers.errors import ConnectError, PortInUse
from ftdrivers.wires.serial_port import SerialPort

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="elsewhere no marks are asked for")

ALL = bytes(range(256)) * 3


class FarSide:
    """The other end of a port."""

    def __init__(self) -> None:
        self.master, slave = os.openpty()
        tty.setraw(slave)
        settings = termios.tcgetattr(slave)
        settings[0] |= termios.IGNPAR | termios.BRKINT  # as another program may leave a port
        termios.tcsetattr(slave, termios.TCSANOW, settings)
        self.path = os.ttyname(slave)
        self._slave = slave

    def make_marks_itself(self) -> None:
        settings = termios.tcgetattr(self.master)
        settings[0] &= ~termios.PARMRK
        termios.tcsetattr(self.master, termios.TCSANOW, settings)

    def send(self, data: bytes) -> None:
        assert os.write(self.master, data) == len(data)

    def close(self) -> None:
        os.close(self._slave)
        os.close(self.master)


@pytest.fixture
def far_side() -> Iterator[FarSide]:
    far_side = FarSide()
    yield far_side
    far_side.close()


@pytest.fixture
def port(far_side: FarSide) -> Iterator[SerialPort]:
    port = SerialPort("sensor", far_side.path, 1_250_000, even_parity=True)
    port.open()
    yield port
    port.close()


def read_until(port: SerialPort, size: int, data: bytes = b"") -> tuple[bytes, list[int]]:
    damaged, deadline = list[int](), time.monotonic() + 5
    while len(data) < size:
        assert time.monotonic() < deadline
        more, places = port.read_marked(size - len(data))
        damaged += [len(data) + place for place in places]
        data += more
    return data, damaged


def send_and_read(far_side: FarSide, port: SerialPort, sent: bytes, size: int, at_once: int) -> tuple[bytes, list[int]]:
    """Read after every few bytes that are sent, so that marks are cut."""
    data, damaged = b"", list[int]()
    for start in range(0, len(sent), at_once):
        far_side.send(sent[start : start + at_once])
        more, places = port.read_marked(0)
        damaged += [len(data) + place for place in places]
        data += more
    data, rest = read_until(port, size, data)
    return data, damaged + rest


def test_asking_for_marks_keeps_an_unusual_bit_rate(far_side: FarSide, port: SerialPort) -> None:
    TCGETS2 = 0x802C542A
    port.read(1)
    settings = bytearray(64)
    fcntl.ioctl(far_side.master, TCGETS2, settings)
    assert int.from_bytes(settings[40:44], sys.byteorder) == 1_250_000


@pytest.mark.parametrize("at_once", [1, 416])
def test_what_the_system_doubles_is_undone(far_side: FarSide, port: SerialPort, at_once: int) -> None:
    assert send_and_read(far_side, port, ALL, len(ALL), at_once) == (ALL, [])


@pytest.mark.parametrize("at_once", [1, 416])
def test_damaged_bytes_are_reported(far_side: FarSide, port: SerialPort, at_once: int) -> None:
    far_side.make_marks_itself()
    sent = b"ab" + b"\xff\x00c" + b"\xff\xff" + b"\xff\x00\xff" + b"\x00" + b"\xff\x00\x00" + b"z"
    assert send_and_read(far_side, port, sent, 8, at_once) == (b"abc\xff\xff\x00\x00z", [2, 4, 6])


def test_a_port_opened_again_begins_empty(far_side: FarSide, port: SerialPort) -> None:
    far_side.make_marks_itself()
    far_side.send(b"a\xff")
    assert port.read(2) == b"a"
    port.close()
    port.open()
    far_side.send(b"\x00b")  # doubled by the system again
    assert read_until(port, 2) == (b"\x00b", [])


def test_what_came_before_the_flags_is_thrown_away(far_side: FarSide, monkeypatch: pytest.MonkeyPatch) -> None:
    """A stream that runs already: an FF that was not doubled must not be taken for a mark."""

    class Busy(serial.Serial):
        def __init__(self, *args: Any, **settings: Any) -> None:
            super().__init__(*args, **settings)
            far_side.send(b"\xff\x00a")
            assert select.select([self], [], [], 5)[0]

    monkeypatch.setattr(serial, "Serial", Busy)
    port = SerialPort("sensor", far_side.path, 1_250_000, even_parity=True)
    port.open()
    try:
        far_side.send(b"b")
        assert read_until(port, 1) == (b"b", [])
    finally:
        port.close()


def test_a_port_that_another_program_has_is_said_to_be_in_use(far_side: FarSide) -> None:
    port = SerialPort("sensor", far_side.path, 115_200)
    fuser = f"in use by another program; end it, `fuser -v {far_side.path}` names it"
    with serial.Serial(far_side.path, exclusive=True), pytest.raises(PortInUse, match=fuser):
        port.open()
    port.open()
    port.close()


def test_a_port_that_takes_no_flags_is_freed(far_side: FarSide, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(_: object) -> bool:
        raise termios.error(5, "gone")

    monkeypatch.setattr("ftdrivers.wires.serial_port.ask_for_marks", refuse)
    port = SerialPort("sensor", far_side.path, 1_250_000, even_parity=True)
    with pytest.raises(ConnectError, match="gone"):
        port.open()
    assert not port.is_open
    serial.Serial(far_side.path, exclusive=True).close()
