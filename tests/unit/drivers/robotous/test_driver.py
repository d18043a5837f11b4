"""The Robotous driver on both wires as a table: golden start-up, halves that pair up, what is waited for."""

import struct
from typing import Any

import numpy as np
import pytest

from ftdrivers.errors import ConnectError, DeviceFault
from ftdrivers.interfaces import Fact
from ftdrivers.robotous.can import RobotousCan
from ftdrivers.robotous.sensor import RobotousSensor, RobotousSerial
from tests.unit.drivers.dialogue import CanWire, SerialWire, Stream, Table
from tests.unit.drivers.in_one_thread import InOneThread

STOP, GO, MODEL = "0C00000000000000", "0B00000000000000", "0100000000000000"
WRENCH = [10, -5, 20, 1, -0.5, 0.05]
ANSWERS = {
    MODEL: b"\x01RFT60-HA01".ljust(16, b"\0"),
    "0200000000000000": b"\x02A60HA00123".ljust(16, b"\0"),
    "0300000000000000": b"\x03VER 1.7".ljust(16, b"\0"),
    "1000000000000000": bytes.fromhex("1000").ljust(16, b"\0"),
}
SET_1_KHZ = {"0F08000000000000": bytes.fromhex("0F01").ljust(16, b"\0")}
SAMPLE = bytes.fromhex("0B 01F4 FF06 03E8 07D0 FC18 0064 00 0000".replace(" ", ""))
OVERLOAD = bytes.fromhex("0B 01F4 FF06 03E8 07D0 FC18 0064 21 0000".replace(" ", ""))


class Uart(InOneThread, RobotousSerial): ...


class Bus(InOneThread, RobotousCan): ...


def counts(field: bytes) -> tuple[int, ...]:
    return struct.unpack(">6h", field[1:13])


def frame(field: bytes) -> bytes:
    return b"\x55" + field + bytes([sum(field) & 0xFF, 0xAA])


def halves(field: bytes) -> list[str]:
    return [f"001 {field[:8].hex().upper()}", f"002 {field[8:].hex().upper()}"]


def on_uart(answers: dict[str, bytes], samples: Stream) -> list[tuple[bytes, Any]]:
    asked = [(frame(bytes.fromhex(request)), frame(reply)) for request, reply in answers.items()]
    stop = frame(bytes.fromhex(STOP)), b""
    turns = [turn for question in asked for turn in (stop, question)]
    return [*turns, (frame(bytes.fromhex(GO)), samples), stop]  # no bias, 0x11, anywhere


def on_can(answers: dict[str, bytes], samples: Stream) -> list[tuple[str, Any]]:
    asked = [(f"064 {request}", halves(reply)) for request, reply in answers.items()]
    stop: tuple[str, list[str]] = f"064 {STOP}", []
    return [*(turn for question in asked for turn in (stop, question)), (f"064 {GO}", samples), stop]


def uart(wire: SerialWire, rate_Hz: int | None = None) -> RobotousSensor:
    return Uart("/dev/ttyUSB0", baud=921_600, rate_Hz=rate_Hz, clock=wire.clock)


def bus(wire: CanWire, rate_Hz: int | None = None) -> RobotousSensor:
    return Bus("can0", rate_Hz=rate_Hz, clock=wire.clock)


def test_start_up_on_a_uart_is_golden(table: Table) -> None:
    with table.serial(on_uart(ANSWERS | SET_1_KHZ, Stream.of(frame(SAMPLE)))) as wire, uart(wire, 1000) as sensor:
        samples, info = sensor.collect(0.1), sensor.identify()
        assert sensor.health().nominal_rate_Hz == 1000
    assert (info.model, info.serial, info.firmware) == ("Robotous RFT60-HA01", "A60HA00123", "VER 1.7")
    assert info.facts["counts_per_N"] == Fact(50, "documented")
    np.testing.assert_allclose(samples.wrench, [WRENCH] * len(samples))
    assert samples.counts[0].tolist() == [500, -250, 1000, 2000, -1000, 100]
    assert (np.diff(samples.seq) == 1).all()
    assert len(samples) == pytest.approx(100, abs=2)


def test_unknown_model_is_refused_with_the_question_to_the_maker(table: Table) -> None:
    answers = {MODEL: b"\x01RFT99-XX01".ljust(16, b"\0")}
    turns = on_uart(answers, Stream.of(b""))
    with table.serial([*turns[:2], turns[-1]]) as wire, pytest.raises(ConnectError, match=r"RFT99-XX01.*ask Robotous"):
        uart(wire).open()


def test_halves_that_never_leave_a_silence_are_no_samples(table: Table) -> None:
    busy = Stream.of(halves(SAMPLE), 0.0004)  # no half period without a frame
    wire = table.can(on_can(ANSWERS | SET_1_KHZ, busy))
    with wire, pytest.raises(ConnectError, match="no sample"):
        bus(wire, 1000).open()


def test_overload_names_its_axes(table: Table) -> None:
    wire = table.can(on_can(ANSWERS, Stream.of(halves(OVERLOAD), 0.005)))
    with wire, pytest.raises(DeviceFault, match="Fx, Tz;"):
        bus(wire).open()


def test_noise_is_no_sensor(table: Table) -> None:
    turns = on_uart({MODEL: b""}, Stream.of(b""))[:2]
    mute = [(sent, b"") for sent, _ in turns]
    noise = Stream.of(b"\xaa" * 40, 0.005)
    wire = table.serial([*[mute[0], (mute[1][0], noise)] * 3, mute[0]], noise)
    found = r"to MODEL .*: bytes arrived, but no frames of 19 bytes at 921600 baud; set baud=… .* \(115200 by default"
    with wire, pytest.raises(ConnectError, match=found):
        uart(wire).open()
