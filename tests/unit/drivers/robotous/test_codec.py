"""Robotous RFT fields and frames: damage, marks inside the data, scales, rates and settings."""

import pytest

from ftdrivers.errors import ProtocolError
from ftdrivers.robotous import codec
from ftdrivers.robotous.codec import Command
from ftdrivers.robotous.sensor import RobotousSerial
from ftdrivers.wires.framing import Deframer

SAMPLE = bytes.fromhex("55 0B 01F4 FF06 03E8 07D0 FC18 0064 00 0000 3F AA")


def reply(text: str) -> bytes:
    return bytes.fromhex(text).ljust(16, b"\0")


def test_there_is_no_bias_command() -> None:
    assert 0x11 not in list(Command)


@pytest.mark.parametrize("at", range(19))
def test_a_changed_byte_is_noticed(at: int) -> None:
    assert codec.is_frame(SAMPLE)
    damaged = bytearray(SAMPLE)
    damaged[at] ^= 0x10
    assert not codec.is_frame(bytes(damaged))


def test_marks_in_the_data_are_data() -> None:
    """Nothing is escaped: 0x55 and 0xAA are ordinary values."""
    field = bytes.fromhex("0B 5555 AAAA 55AA AA55 0055 AA00 00 0000")
    frame = codec.encode_frame(field)
    frames = Deframer(b"\x55", codec.FRAME_SIZE, codec.is_frame)
    assert frames.feed(frame[7:] + frame * 2) == [(1, frame), (2, frame)]
    assert codec.decode_sample(field).counts == (21845, -21846, 21930, -21931, 85, -22016)


@pytest.mark.parametrize(
    ("overload", "axes"), [(0x20, ["Fx"]), (0x01, ["Tz"]), (0x12, ["Fy", "Ty"]), (0, []), (0xC0, [])]
)
def test_overload_bits(overload: int, axes: list[str]) -> None:
    assert codec.overloaded_axes(overload) == axes


@pytest.mark.parametrize(
    ("model", "torque"),
    [
        ("RFT40-SA01", 2000),
        ("RFT44-SB01", 2000),
        ("RFT60-HA01", 2000),
        ("RFT64-SB01", 2000),
        ("RFT64-6A01", 1000),
        ("RFT76-HA01", 2000),
        ("RFT80-6A01", 1000),
        ("RFT80-6A02", 1000),
        ("RFT82-HA02", 1000),
        ("RFT40-SA01-D", 2000),
    ],
)
def test_scale_of_each_model(model: str, torque: int) -> None:
    assert codec.counts_per_unit(model) == (50, torque)


@pytest.mark.parametrize("model", ["", "RFT", "RFT64", "RFT64-6B01", "RFT82-HA01", "X RFT60-HA01"])
def test_unknown_scale_is_refused(model: str) -> None:
    with pytest.raises(ProtocolError, match=r"scale of model.*ask Robotous.*counts=DF,DT"):
        codec.counts_per_unit(model)


def test_rates() -> None:
    rates = [codec.decode_rate(reply(f"10 0{code}")) for code in range(9)]
    assert rates == [200, 10, 20, 50, 100, 200, 333, 500, 1000]
    with pytest.raises(ProtocolError, match="code 9"):
        codec.decode_rate(reply("10 09"))


def test_settings_are_confirmed_or_refused() -> None:
    codec.check_set(reply("0F 01"))
    with pytest.raises(ProtocolError, match=r"out of range.* rate"):
        codec.check_set(reply("0F 00 02"))


def test_text() -> None:
    assert codec.decode_text(b"\x01RFT60-HA01\0\0\0\0\0") == "RFT60-HA01"
    assert codec.decode_text(b"\x02A1 " + b" " * 12) == "A1"
    assert codec.decode_text(b"\x01RFT 60~".ljust(16, b"\0")) == "RFT 60~"
    for bad in (bytes(16), b"\x01\xff" + bytes(14), b"\x01A\x7f" + bytes(13), b"\x01A\x1fB" + bytes(12)):
        with pytest.raises(ProtocolError, match="not text"):
            codec.decode_text(bad)


@pytest.mark.parametrize(
    ("baud", "fastest_Hz"), [(57_600, 200), (115_200, 333), (230_400, 500), (460_800, 500), (921_600, 1000)]
)
def test_what_a_uart_carries(baud: int, fastest_Hz: int) -> None:
    RobotousSerial("/dev/x", baud=baud, rate_Hz=fastest_Hz)
    if fastest_Hz < 1000:
        with pytest.raises(ValueError, match=f"at most {fastest_Hz} Hz"):
            RobotousSerial("/dev/x", baud=baud, rate_Hz=1000)
