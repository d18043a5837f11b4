"""The Robotiq driver as a table of bytes: golden start-up and goodbye, and awkward answers."""

import struct
from contextlib import nullcontext
from itertools import count

import numpy as np
import pytest

from ftdrivers.clock import Clock
from ftdrivers.errors import ConnectError, DeviceFault
from ftdrivers.interfaces import Fact
from ftdrivers.robotiq.sensor import RobotiqFt300
from ftdrivers.wires.framing import crc16_modbus
from tests.unit.drivers.dialogue import Stream, Table
from tests.unit.drivers.in_one_thread import InOneThread

FRAME = bytes.fromhex("20 4E D2 04 C9 FD 10 27 96 00 E7 FF E8 03 86 DC")
START, STARTED = bytes.fromhex("09 10 01 9A 00 01 02 02 00 CD CA"), bytes.fromhex("09 10 01 9A 00 01 21 52")
HALT = b"\xff" * 50, b""


def modbus(text: str) -> bytes:
    body = bytes.fromhex(text)
    return body + crc16_modbus(body).to_bytes(2, "little")


SERIAL = modbus("09 03 01FE 0004"), modbus("09 03 08 4654 5300 04D2 0000")
FIRMWARE = modbus("09 03 01F4 0003"), modbus("09 03 06 4654 5302 0001")
RUN = START, Stream.of(FRAME, 0.01, STARTED)


class Sensor(InOneThread, RobotiqFt300):
    def __init__(self, clock: Clock) -> None:
        super().__init__("/dev/ttyUSB0", clock=clock)


def test_start_up_and_goodbye_are_golden(table: Table) -> None:
    with table.serial([HALT, SERIAL, FIRMWARE, RUN, HALT]) as wire, Sensor(wire.clock) as sensor:
        samples, info = sensor.collect(0.15), sensor.identify()
        assert sensor.health().nominal_rate_Hz == 100
    assert (info.serial, info.firmware) == ("FTS-1234", "FTS-2.0.1")
    assert info.facts["counts_per_Nm"] == Fact(1000, "documented")
    assert info.facts["range"] == Fact((300, 300, 300, 30, 30, 30), "documented")
    np.testing.assert_allclose(samples.wrench[0], [12.34, -5.67, 100, 0.15, -0.025, 1])
    assert len(samples) == pytest.approx(15, abs=1)


def test_sensor_without_a_firmware_register(table: Table) -> None:
    no_firmware = FIRMWARE[0], modbus("09 83 02")
    with table.serial([HALT, SERIAL, no_firmware, RUN, HALT]) as wire, Sensor(wire.clock) as sensor:
        assert sensor.identify().firmware == "not reported"


def test_sensor_that_refuses_to_stream(table: Table) -> None:
    refused = START, modbus("09 90 02")
    wire = table.serial([HALT, SERIAL, FIRMWARE, refused, HALT])
    with wire, pytest.raises(ConnectError, match="function 0x10"):
        Sensor(wire.clock).open()


@pytest.mark.parametrize(("count", "is_end"), [(32767, True), (-32768, True), (32766, False), (-32767, False)])
def test_a_count_at_the_end_of_its_range_is_a_fault(table: Table, count: int, is_end: bool) -> None:
    body = b"\x20\x4e" + struct.pack("<6h", 0, 0, count, 0, 0, 0)
    frames = Stream.of(body + crc16_modbus(body).to_bytes(2, "little"), 0.01, STARTED)
    with table.serial([HALT, SERIAL, FIRMWARE, (START, frames), HALT]) as wire:
        sensor = Sensor(wire.clock)
        with pytest.raises(DeviceFault, match="end of its range") if is_end else nullcontext():
            sensor.open()
        sensor.close()


@pytest.mark.parametrize(("rate_Hz", "hint"), [(62.5, "latency_timer"), (80.0, "lost"), (100.0, "")])
def test_slow_usb_adapter_is_named_with_its_fix(
    table: Table, rate_Hz: float, hint: str, caplog: pytest.LogCaptureFixture
) -> None:
    bodies = (b"\x20\x4e" + struct.pack("<6h", number % 7, 0, 0, 0, 0, 0) for number in count())
    run = Stream((body + crc16_modbus(body).to_bytes(2, "little") for body in bodies), 1 / rate_Hz, STARTED)
    with table.serial([HALT, SERIAL, FIRMWARE, (START, run), HALT]) as wire, Sensor(wire.clock) as sensor:
        sensor.collect(5.0)
        events = [event for _, event in sensor.health().events]
    warned = [record.message for record in caplog.records if record.levelname == "WARNING"]
    assert len(warned) == bool(hint)  # one fault, one warning
    assert all(hint in text for text in warned)
    assert events == [f"rate {rate_Hz:.1f} Hz instead of 100 Hz"] * bool(hint)


def test_sensor_that_streams_since_it_booted_is_stopped_and_its_silence_waited_for(table: Table) -> None:
    with table.serial([HALT, SERIAL, FIRMWARE, RUN, HALT], Stream.of(FRAME, 0.01)) as wire:
        start_s = wire.clock.now_s()
        wire.clock.advance(0.1)
        with Sensor(wire.clock) as sensor:
            assert len(sensor.collect(0.1)) > 3
        assert wire.clock.now_s() - start_s > 0.1 + 0.05
