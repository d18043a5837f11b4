"""The Bota emulator without a wire: CRC and frames."""

import struct

import numpy as np
import pytest

from ftmocks.clock import CellClock
from ftmocks.sensors.bota import BotaBox, banner, stream_frame
from tests.unit.mocks.real_time import RealTime

WRENCH = [1, -2, 9.81, 0.1, -0.2, 0.3]
FRAME = "AA 0000 0000803F 000000C0 C3F51C41 CDCCCC3D CDCC4CBE 9A99993E 40420F00 0000CC41 3D0D"


def test_documented_frame() -> None:
    assert stream_frame(0, WRENCH, 1_000_000, 25.5) == bytes.fromhex(FRAME)


class Box(BotaBox):
    """An emulator whose wire the test reads."""

    def ask(self, written: bytes) -> bytes:
        self._received(written)
        return b"".join(self._wire.due(self.clock.now_s()))

    def turn(self) -> None:
        self._work(self.clock.now_s())

    def frame(self) -> tuple[int, list[float]]:
        """Return status and values of a frame."""
        status, *values = struct.unpack("<H6f", self._samples(1)[0][1:27])
        return status, values


@pytest.fixture
def box() -> Box:
    box = Box(lambda n: np.tile(WRENCH, (n, 1)), streaming_at_start=True)
    box.power_up()
    return box


def test_it_boots_for_three_seconds_then_says_who_it_is_and_streams() -> None:
    real = RealTime()
    box = Box(lambda n: np.tile(WRENCH, (n, 1)), serial=471, clock=CellClock(real))
    box.power_up()
    printed = b""
    for _ in range(300):
        box.turn()
        printed += box.ask(b"C")
        assert not box.streaming
        real.pass_s(0.01)
    assert printed == b"c,0,1,0,4\r\n"
    box.turn()
    assert box.ask(b"") == banner(471)
    assert box.streaming
    assert banner(471) == b"App Init\r\nname: SensONE\r\nS/N: 471\r\nFW version: 1.2.0\r\n"


def test_overrange_and_uncalibrated_bits(box: Box) -> None:
    box.measure = lambda n: np.tile([0, 0, -1300.0, 0, 0, 0], (n, 1))
    status, values = box.frame()
    assert status == 0x0002
    assert values[2] == -1200
    box.measure = lambda n: np.tile(WRENCH, (n, 1))
    box.calibrated, box.saturated_axis = False, 4
    status, values = box.frame()
    assert status == 0x000A
    assert values[4] == 15


@pytest.mark.parametrize(
    ("written", "answered"),
    [
        (b"f,0,0,0,0", b"r,1,f,0\r\n"),
        (b"x", b"r,1,x,0\r\n"),
        (b"\r\n c,1,1,0,4 f,512,0,0,0\r\n", b"r,0,c,0\r\nr,0,f,0\r\n"),
        (b"cccccccccccccccccc", b"r,1,c,0\r\n"),
    ],
)
def test_configuration_answers(box: Box, written: bytes, answered: bytes) -> None:
    assert box.ask(b"garbage C") == b"r,0,C,0\r\n"
    assert box.ask(written) == answered
    assert box.ask(b"C") == b"r,0,C,0\r\n", "and nothing else"


def test_serial_number_in_configuration_mode(box: Box) -> None:
    assert box.ask(b"p?") == b"", "it streams"
    assert box.ask(b"C") == b"r,0,C,0\r\n"
    assert box.ask(b"p") == b""
    assert box.ask(b"?") == b"p,0,12345,1,0,SensONE\r\nr,0,p,0\r\n"
