"""The Robotiq emulator without a wire: registers and stream frames."""

import struct

import numpy as np
import pytest

from ftmocks.sensors.robotiq import RobotiqBox, raw_values, stream_frame
from ftmocks.wires.modbus import with_crc

WRENCH = np.array([12.34, -5.67, 100, 0.15, -0.025, 1])


class Box(RobotiqBox):
    def frame(self) -> bytes:
        return self._samples(1)[0]


@pytest.fixture
def box() -> Box:
    return Box(lambda n: np.tile(WRENCH, (n, 1)))


def ask(box: RobotiqBox, request: str) -> str:
    return box.reply(bytes.fromhex(request)).hex(" ").upper()


def read(box: RobotiqBox, first: int, count: int) -> tuple[int, ...]:
    answer = box.reply(with_crc(struct.pack(">BBHH", 9, 3, first, count)))
    assert with_crc(answer[:-2]) == answer
    return struct.unpack(f">{count}H", answer[3:-2])


def test_documented_frame() -> None:
    frame = stream_frame(raw_values(WRENCH[None])[0].tolist())
    assert frame == bytes.fromhex("20 4E D2 04 C9 FD 10 27 96 00 E7 FF E8 03 86 DC")


def test_documented_requests(box: RobotiqBox) -> None:
    assert ask(box, "09 10 01 9A 00 01 02 02 00 CD CA") == "09 10 01 9A 00 01 21 52"
    answer = ask(box, "09 03 00 B4 00 06 84 A6")
    assert answer.startswith("09 03 0C 04 D2 FD C9 27 10 00 96 FF E7 03 E8")


@pytest.mark.parametrize(
    ("body", "code"),
    [
        ("09 04 00 B4 00 06", 1),
        ("09 03 00 B3 00 01", 2),
        ("09 03 00 B4 00 07", 2),
        ("09 03 00 B4 00 7E", 3),
        ("09 10 00 B4 00 01 02 00 00", 2),
    ],
)
def test_exceptions(box: RobotiqBox, body: str, code: int) -> None:
    request = bytes.fromhex(body)
    assert box.reply(with_crc(request)) == with_crc(bytes([9, request[1] | 0x80, code]))


def test_saturation(box: Box) -> None:
    box.measure = lambda n: np.tile([500.0, -500, 0, 0, 0, 0], (n, 1))
    box.saturated_axis = 5
    assert read(box, 180, 6) == (0x7FFF, 0x8000, 0, 0, 0, 0x7FFF)
    assert box.frame()[2:14] == bytes.fromhex("FF7F 0080 0000 0000 0000 FF7F")
