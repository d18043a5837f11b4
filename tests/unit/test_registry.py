"""Addresses of sensors: what they build, and what is refused before any device is touched."""

import pytest

from drivers.ati.can import AtiCanSensor
from drivers.ati.serial import AtiSerialSensor
from drivers.registry import BadUrl, sensor_from_url


def test_can_addresses() -> None:
    sensor = sensor_from_url("ati-can://can0?bitrate=500000&base=0x7F&slot=3", sign=-1)
    assert isinstance(sensor, AtiCanSensor)
    assert sensor.name == "ATI CAN sensor 0x7F on socketcan can0"
    assert (sensor._bitrate, sensor._slot, sensor._sign) == (500_000, 3, -1)
    sensor = sensor_from_url("ati-can:///dev/ttyACM0?interface=slcan")
    assert isinstance(sensor, AtiCanSensor)
    assert sensor.name == "ATI CAN sensor 0x20 on slcan /dev/ttyACM0"


def test_serial_addresses() -> None:
    sensor = sensor_from_url("ati-serial:///dev/serial/by-id/usb-FTDI_My%20Box-if00?calibration=2")
    assert isinstance(sensor, AtiSerialSensor)
    assert sensor.name == "ATI serial sensor on /dev/serial/by-id/usb-FTDI_My Box-if00"
    assert sensor._calibration_index == 2


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("can0", "unknown sensor ''; known: ati-can, ati-serial"),
        ("kms40://dev", "unknown sensor 'kms40'"),
        ("ati-can://", "which device"),
        ("ati-can:can0", "which device"),
        ("ati-can://can0#1", "which device"),
        ("ati-can://[can0", "write it like"),
        ("ati-can://can0?bitrat=1", "unknown option bitrat; known: base, bitrate, interface, slot"),
        ("ati-can://can0?bitrate=fast", "whole number"),
        ("ati-can://can0?base=0x80", "allowed are 0 to 127"),
        ("ati-can://can0?base=", "empty"),
        ("ati-can://can0?base", "key=value"),
        ("ati-can://can0?base=1&base=2", "twice"),
        ("ati-serial:///dev/x?calibration=0", "allowed are 1 to 16"),
        ("ati-serial:///dev/x?parity=E", "unknown option parity; known: calibration"),
    ],
)
def test_mistakes_are_named(url: str, message: str) -> None:
    with pytest.raises(BadUrl, match=message.replace("?", r"\?")) as caught:
        sensor_from_url(url)
    assert url in str(caught.value)
