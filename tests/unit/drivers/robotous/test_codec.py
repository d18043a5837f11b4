"""Robotous RFT fields and frames: damage, marks inside the data, scales, rates and settings."""

import pytest

from ftdrivers.errors import ProtocolError
from ftdrivers.robotous import codec
from ftdrivers.robotous.codec import Command
from ftdrivers.robotous.sensor import RobotousSerial


def reply(text: str) -> bytes:
    return bytes.fromhex(text).ljust(16, b"\0")


def test_there_is_no_bias_command() -> None:
    assert 0x11 not in list(Command)


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


@pytest.mark.parametrize(
    ("baud", "fastest_Hz"), [(57_600, 200), (115_200, 333), (230_400, 500), (460_800, 500), (921_600, 1000)]
)
def test_what_a_uart_carries(baud: int, fastest_Hz: int) -> None:
    RobotousSerial("/dev/x", baud=baud, rate_Hz=fastest_Hz)
    if fastest_Hz < 1000:
        with pytest.raises(ValueError, match=f"at most {fastest_Hz} Hz"):
            RobotousSerial("/dev/x", baud=baud, rate_Hz=1000)
