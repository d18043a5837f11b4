"""The serial emulator without a wire: frames, calibration block and stream records."""

from collections.abc import Iterator

import numpy as np
import pytest

from ftmocks.sensors.ati_serial import AtiSerialBox, stream_records
from ftmocks.wires.modbus import with_crc

V1 = [100, -200, 300, -400, 500, -600]
V2 = [221, -926, 69, -1086, 2342, 1266]


@pytest.fixture
def box() -> Iterator[AtiSerialBox]:
    box = AtiSerialBox(lambda n: np.zeros((n, 6)))
    box.power_up()
    yield box
    box.stop()


@pytest.mark.parametrize(
    ("gauges", "error", "record"),
    [
        (V1, False, "00 64 01 2C 01 F4 FF 38 FE 70 FD A8 50"),
        (V1, True, "00 64 01 2C 01 F4 FF 38 FE 70 FD A8 D0"),
        (V2, False, "00 DD 00 45 09 26 FC 62 FB C2 04 F2 62"),
        ([0] * 6, False, "00 " * 13),
    ],
)
def test_stream_record(gauges: list[int], error: bool, record: str) -> None:
    assert stream_records(np.array([gauges], dtype=np.int16), error=error).tobytes() == bytes.fromhex(record)


@pytest.mark.parametrize(
    ("request_hex", "reply_hex"),
    [
        ("0A 03 00 1D 00 01 15 77", "0A 03 02 00 00 1D 85"),
        ("0A 6A AA FF 1D", "0A 6A 01 BE A2"),
        ("0A 6A 18 7F 68", "0A 6A 01 BE A2"),
        ("0A 10 00 1E 00 01 02 00 01 17 1E", with_crc(bytes.fromhex("0A 10 00 1E 00 01")).hex()),
        ("0A 10 00 1F 00 01 02 00 02 56 CE", with_crc(bytes.fromhex("0A 10 00 1F 00 01")).hex()),
        ("0A 03 00 0C 00 01 45 72", with_crc(bytes.fromhex("0A 03 02 00 00")).hex()),
    ],
)
def test_documented_requests(box: AtiSerialBox, request_hex: str, reply_hex: str) -> None:
    assert box.reply(bytes.fromhex(request_hex)) == bytes.fromhex(reply_hex)


@pytest.mark.parametrize(
    ("body", "code"),
    [
        ("0A 01 00 00 00 01", 1),
        ("0A 03 00 0D 00 01", 2),
        ("0A 03 01 8C 00 01", 2),
        ("0A 10 00 E3 00 01 02 00 00", 2),
        ("0A 03 00 E3 00 41", 3),
        ("0A 10 00 1F 00 01 02 00 03", 3),
        ("0A 46 55 55", 3),
        ("0A 10 00 00 00 01 02 00 01", 4),
    ],
)
def test_exceptions(box: AtiSerialBox, body: str, code: int) -> None:
    request = bytes.fromhex(body)
    assert box.reply(with_crc(request)) == with_crc(bytes([0x0A, request[1] | 0x80, code]))


V1_WRENCH = [-0.85, 1.476, 6.84, 0.044, -0.0762, 0.1608]
WRITE_GAINS = "0A 10 00 00 00 06 0C 02 1F 02 2B 02 39 02 43 02 35 02 37 47 2D"
WRITE_OFFSETS = "0A 10 00 06 00 06 0C 80 00 80 00 80 00 80 00 80 00 80 00 75 66"


def made(*, loads_gains: bool = True) -> AtiSerialBox:
    box = AtiSerialBox(lambda n: np.tile(V1_WRENCH, (n, 1)), loads_gains=loads_gains)
    box.power_up()
    return box


def test_gauges_are_right_from_power_up_on_and_after_writing_the_same_gains() -> None:
    box = made()
    assert box.gauges(1)[0].tolist() == V1
    gains = with_crc(bytes.fromhex("0A 03 0C 02 1F 02 2B 02 39 02 43 02 35 02 37"))
    assert box.reply(with_crc(bytes.fromhex("0A 03 00 00 00 06"))) == gains
    for request in ("0A 6A AA FF 1D", WRITE_GAINS, WRITE_OFFSETS, "0A 6A 18 7F 68"):
        assert not box.reply(bytes.fromhex(request))[1] & 0x80
    assert box.gauges(1)[0].tolist() == V1
