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


def test_registers(box: RobotiqBox) -> None:
    assert read(box, 190, 3) == (0, 0, 1000)
    assert read(box, 500, 3) == (0x4654, 0x5302, 0x0001)  # "FTS", 2.0.1
    assert read(box, 510, 4) == (0x4654, 0x5300, 1234, 0)
    assert read(box, 514, 1) == (2022,)
    assert read(box, 410, 1) == (0,)
    box.serial = ("FTS", 0x12345)
    assert read(box, 510, 5) == (0x4654, 0x5300, 0x2345, 0x0001, 2022)


@pytest.mark.parametrize(
    ("body", "code"),
    [
        ("09 04 00 B4 00 06", 1),
        ("09 06 01 9A 02 00", 1),
        ("09 03 00 B3 00 01", 2),
        ("09 03 00 B4 00 07", 2),
        ("09 03 00 B4 00 00", 3),
        ("09 03 00 B4 00 7E", 3),
        ("09 03 00 B4", 3),
        ("09 10 00 B4 00 01 02 00 00", 2),
        ("09 10 01 9A 00 02 04 02 00 00 00", 2),
        ("09 10 01 9A 00 01 02 02", 3),
    ],
)
def test_exceptions(box: RobotiqBox, body: str, code: int) -> None:
    request = bytes.fromhex(body)
    assert box.reply(with_crc(request)) == with_crc(bytes([9, request[1] | 0x80, code]))


def test_others_and_damaged_requests_are_met_with_silence(box: RobotiqBox) -> None:
    assert ask(box, "09 03 00 B4 00 06 84 A7") == ""
    assert box.reply(with_crc(bytes.fromhex("0A 03 00 B4 00 06"))) == b""
    assert box.reply(b"\xff" * 50) == b""


def test_saturation(box: Box) -> None:
    box.measure = lambda n: np.tile([500.0, -500, 0, 0, 0, 0], (n, 1))
    box.saturated_axis = 5
    assert read(box, 180, 6) == (0x7FFF, 0x8000, 0, 0, 0, 0x7FFF)
    assert box.frame()[2:14] == bytes.fromhex("FF7F 0080 0000 0000 0000 FF7F")
