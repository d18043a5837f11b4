"""The bits of ATI's status words, by the words of the vendors' tables."""

from collections.abc import Mapping

import pytest

from ftdrivers.ati import codec, modbus
from ftdrivers.ati.netft import AXIA_BITS, NET_FT_BITS, ONROBOT_BITS

NETCANOEM = """
0 watchdog, 1 check too high, 2 check too low, 3 ground, 4 supply too high, 5 supply too low, 6 calibration, 7 EEPROM,
8 configuration, 11 temperature too high, 12 temperature too low, 14 CAN, 15 any"""
DIGITAL_FT = """
0 watchdog, 1 excitation voltage too high, 2 excitation voltage too low, 3 ground, 4 supply too high, 5 supply too low,
6 calibration, 7 EEPROM, 8 configuration, 9 bridge supply current too high, 10 bridge supply current too low,
11 thermistor too high, 12 thermistor too low, 13 DAC, 14 CAN, 15 any"""
NET_FT = """
1 HTTP, 2 temperature, 3 reference voltage, 4 no data, 5 too low, 6 too high, 7 ground, 8 current low, 9 current high,
10 analog watchdog, 11 flash, 12 EEPROM, 13 stack, 14 watchdog, 16 monitor, 17 saturated, 18 DeviceNet, 19 EtherNet/IP,
20 RDT, 21 CAN, 22 network, 23 calibration, 24 settings, 25 halted, 26 program, 27 link, 28 analog board,
29 digital board, 30 CPU, 31 any"""
AXIA = """
0 temperature, 1 supply, 2 broken gauge, 3 busy, 5 hardware, 16 monitor, 26 near its limit, 27 gauge out of range,
28 simulated, 29 checksum, 30 torque out of range, 31 any"""
ONROBOT = """
3 several, 4 Fx, 5 Fy, 6 Fz, 7 Tx, 8 Ty, 9 Tz, 10 not detected, 11 sensor failure, 12 temperature, 13 converter failure,
14 communication, 15 converter error"""


@pytest.mark.parametrize(
    ("table", "bits"),
    [
        (NETCANOEM, codec.STATUS_BITS),
        (DIGITAL_FT, modbus.STATUS_BITS),
        (NET_FT, NET_FT_BITS),
        (AXIA, AXIA_BITS),
        (ONROBOT, ONROBOT_BITS),
    ],
    ids=["NETCANOEM", "Digital F/T", "Net F/T", "Axia", "OnRobot"],
)
def test_every_bit_has_the_name_of_the_table(table: str, bits: Mapping[int, str]) -> None:
    expected = {int(number): words for number, words in (one.split(maxsplit=1) for one in table.split(","))}
    assert sorted(bits) == sorted(expected)
    assert {n: bits[n] for n in bits if expected[n] not in bits[n]} == {}


def test_which_bits_of_a_digital_sensor_make_its_data_unusable() -> None:
    assert {bit for bit in range(16) if modbus.CRITICAL >> bit & 1} == {*range(1, 8), *range(9, 14)}
    assert (modbus.ANY_ERROR, modbus.WATCHDOG_RESET, codec.WATCHDOG_RESET) == (1 << 15, 1, 1)
