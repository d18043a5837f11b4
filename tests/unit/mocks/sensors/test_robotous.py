"""The Robotous emulator without a wire: packets, samples, commands."""

import numpy as np
import pytest
from numpy.typing import NDArray

from ftmocks.sensors.robotous import (
    RobotousCanNode,
    RobotousSensor,
    RobotousSerialBox,
    packet,
    sample_field,
)
from ftmocks.wires.slcan import CanFrame

WRENCH = np.array([10, -5, 20, 1, -0.5, 0.05])
SAMPLE = "0B 01F4 FF06 03E8 07D0 FC18 0064 00 0000"


def command(text: str) -> bytes:
    return bytes.fromhex(text).ljust(8, b"\0")


class Readings:
    def __init__(self) -> None:
        self.wrench: NDArray[np.float64] = WRENCH
        self.made = 0

    def __call__(self, count: int) -> NDArray[np.float64]:
        self.made += count
        return np.tile(self.wrench, (count, 1))


@pytest.fixture
def readings() -> Readings:
    return Readings()


@pytest.fixture
def sensor(readings: Readings) -> RobotousSerialBox:
    sensor = RobotousSerialBox(readings)
    sensor.boot()
    return sensor


@pytest.mark.parametrize(
    "frame",
    [
        "55 0B 00 00 00 00 00 00 00 0B AA",
        "55 0C 00 00 00 00 00 00 00 0C AA",
        "55 11 01 00 00 00 00 00 00 12 AA",
        "55 0F 08 00 00 00 00 00 00 17 AA",
        "55 0B 01F4 FF06 03E8 07D0 FC18 0064 00 0000 3F AA",
    ],
)
def test_documented_packets(frame: str) -> None:
    data = bytes.fromhex(frame)
    assert packet(data[1:-2]) == data


def test_documented_sample(sensor: RobotousSensor[bytes]) -> None:
    assert sample_field(0x0B, [500, -250, 1000, 2000, -1000, 100], 0) == bytes.fromhex(SAMPLE)
    assert sensor.samples(2) == [bytes.fromhex(SAMPLE)] * 2
    assert sensor.execute(command("0A")) == [b"\x0a" + bytes.fromhex(SAMPLE)[1:]]


@pytest.mark.parametrize(
    ("request_", "response"),
    [
        ("01", b"\x01RFT60-HA01\0\0\0\0\0"),
        ("02", b"\x02A60HA00123\0\0\0\0\0"),
        ("05", bytes.fromhex("05 64 01 02 64 01 02") + bytes(9)),
        ("10", bytes.fromhex("10 00") + bytes(14)),
        ("12", bytes.fromhex("12") + bytes(15)),
        ("06 01", bytes.fromhex("06 01 00") + bytes(13)),
        ("08 01 0F", bytes.fromhex("08 00 02") + bytes(13)),
        ("0F 06", bytes.fromhex("0F 01 00") + bytes(13)),
        ("0F 08", bytes.fromhex("0F 00 02") + bytes(13)),
        ("04 10 11 12", bytes.fromhex("04 00 01") + bytes(13)),
    ],
)
def test_commands(sensor: RobotousSensor[bytes], request_: str, response: bytes) -> None:
    assert sensor.execute(command(request_)) == [response]


@pytest.mark.parametrize("request_", ["00", "0B", "0C", "0D", "0E", "11 01", "11 00", "11 02", "13", "55", "FF"])
def test_commands_without_reply(sensor: RobotousSensor[bytes], request_: str) -> None:
    assert sensor.execute(command(request_)) == []


def test_can_node_answers_at_its_identifiers(readings: Readings) -> None:
    node = RobotousCanNode(readings)
    node.boot()
    strange = [
        CanFrame(0x65, command("0A")),
        CanFrame(0x64, b"\x0a"),
        CanFrame(0x64, command("0A"), extended=True),
        CanFrame(0x64, command("0A"), remote=True),
    ]
    assert [node.answer(frame) for frame in strange] == [[]] * 4
    sample = b"\x0a" + bytes.fromhex(SAMPLE)[1:]
    assert node.answer(CanFrame(0x64, command("0A"))) == [CanFrame(1, sample[:8]), CanFrame(2, sample[8:])]
    node.execute(command("04 70 71 72"))
    node.boot()
    assert node.answer(CanFrame(0x64, command("0A"))) == []
    assert node.answer(CanFrame(0x70, command("0A"))) == [CanFrame(0x71, sample[:8]), CanFrame(0x72, sample[8:])]


def test_readings_are_clipped_not_wrapped(sensor: RobotousSensor[bytes], readings: Readings) -> None:
    readings.wrench = np.array([1000, -1000, 0, 0, 0, 0.0])
    assert sensor.samples(1)[0][1:5] == b"\x7f\xff\x80\x00"
