"""The Bota driver as a table of bytes: it listens, is configured only when asked, and reads the sensor's clock."""

import re
from collections.abc import Iterable, Iterator, Sequence
from itertools import chain, count
from typing import Any

import numpy as np
import pytest

from ftdrivers.bota.sensor import BotaSensor
from ftdrivers.clock import Clock
from ftdrivers.errors import ConnectError, StreamBroken
from ftdrivers.wires.framing import crc16_x25
from tests.unit.drivers.dialogue import Stream, Table
from tests.unit.drivers.in_one_thread import InOneThread

NUMBERS = np.array([1, -2, 9.81, 0.1, -0.2, 0.3], "<f4")
PAYLOAD = bytes.fromhex("0000803F 000000C0 C3F51C41 CDCCCC3D CDCC4CBE 9A99993E")


def frame(t_us: int, payload: bytes = PAYLOAD) -> bytes:
    body = bytes(2) + payload + (t_us % 2**32).to_bytes(4, "little") + bytes.fromhex("0000CC41")
    return b"\xaa" + body + crc16_x25(body).to_bytes(2, "little")


def frames(times_us: Iterable[int]) -> Iterator[bytes]:
    """One each 10 ms, with noise: a repeated wrench would be a frozen sensor."""
    for number, t_us in enumerate(times_us):
        yield frame(t_us, (NUMBERS + np.float32(1e-3 * (number % 7))).astype("<f4").tobytes())


def stream(*times_us: int) -> Stream:
    """Send these times, then go on in steps of 10 ms."""
    last = times_us[-1] if times_us else 1_000_000
    return Stream(frames(chain(times_us, count(last + 10_000, 10_000))), 0.01)


class Sensor(InOneThread, BotaSensor):
    def __init__(self, clock: Clock, **options: Any) -> None:
        super().__init__("/dev/ttyUSB0", clock=clock, **options)


def test_it_is_only_listened_to(table: Table) -> None:
    with table.serial([], stream()) as wire, Sensor(wire.clock) as sensor:
        samples = sensor.collect(0.5)
        assert sensor.health().nominal_rate_Hz == pytest.approx(100)
        assert sensor.temperature_C() == 25.5
    assert wire.sent == []
    np.testing.assert_allclose(samples.wrench.min(axis=0), NUMBERS, rtol=1e-6)
    np.testing.assert_allclose(np.diff(samples.t_device_s), 0.01, atol=1e-9)


COMMANDS: Sequence[tuple[bytes, bytes]] = [
    (b"C", b"r,0,C,0"),
    (b"p?", b"p,0,1234,x,x,SensONE\r\nr,0,p,0"),
    (b"c,0,1,0,4", b"r,0,c,0"),
    (b"f,512,0,0,1", b"r,0,f,0"),
]


def test_it_is_configured_when_asked(table: Table) -> None:
    run = b"R", Stream(frames(count(0, 10_000)), 0.01, b"r,0,R,0")
    with table.serial([*COMMANDS, run], stream()) as wire, Sensor(wire.clock, sinc=512) as sensor:
        assert len(sensor.collect(0.1)) == pytest.approx(10, abs=1)
        assert (sensor.identify().model, sensor.identify().serial) == ("Bota SensONE", "1234")


BOOT = b"\x00junkApp Init\r\nname: SensONE T15\r\nS/N: 4711\r\nFW version: 1.2.3\r\n"


def test_a_sensor_that_has_just_booted_is_not_asked_for_its_serial_number(table: Table) -> None:
    run = b"R", Stream(frames(count(0, 10_000)), 0.01, b"r,0,R,0")
    turns = [(b"C", BOOT + b"r,0,C,0"), *COMMANDS[2:], run]
    with table.serial(turns) as wire, Sensor(wire.clock, sinc=512) as sensor:
        assert sensor.identify().serial == "4711"


def test_a_sensor_at_neither_usual_baud_rate_is_refused(table: Table) -> None:
    silent = (
        r"no bytes arrived within 5.0 s at 460800 baud, no bytes.* at 230400 baud; check supply and wiring; .*sinc="
    )
    with table.serial([]) as wire, pytest.raises(ConnectError, match=silent):
        Sensor(wire.clock).open()


def test_clock_wraps(table: Table) -> None:
    with table.serial([], stream(2**32 - 150_000)) as wire, Sensor(wire.clock) as sensor:
        samples = sensor.collect(0.25)
    assert (np.diff(samples.seq) == 1).all()
    assert samples.t_device_s[-1] > 2**32 / 1e6
    np.testing.assert_allclose(np.diff(samples.t_device_s), 0.01, atol=1e-9)


def test_a_clock_that_goes_back_is_a_restart(table: Table) -> None:
    wire = table.serial([], stream(*range(5_000_000, 5_200_000, 10_000), 10_000))
    with wire, Sensor(wire.clock) as sensor, pytest.raises(StreamBroken, match="restarted"):
        sensor.collect(1.0)


NOISE = Stream.of(b"\xaa" * 40, 0.05)
OTHER_BAUD = r"; set baud=… in its address .*\(230400 by default\), and check that no other device"


def test_bytes_without_frames_are_of_another_baud_rate_or_device(table: Table) -> None:
    noise = r": bytes arrived, but no frames of 37 bytes within (?P<s>\d\.\d) s at 115200 baud" + OTHER_BAUD
    with table.serial([], NOISE) as wire, pytest.raises(ConnectError, match=noise) as caught:
        Sensor(wire.clock, baud=115_200).open()
    found = re.search(noise, str(caught.value))
    assert found is not None
    assert float(found["s"]) == pytest.approx(wire.clock.now_s() - 1000, abs=0.1)
    assert "sinc=512" in str(caught.value)


def test_frames_that_end_name_the_line(table: Table) -> None:
    few = Stream(frames(range(0, 30_000, 10_000)), 0.01)
    wire = table.serial([], few)
    with wire, pytest.raises(ConnectError, match=r"3 frames arrived within 5\.\d s at 460800 baud; check supply"):
        Sensor(wire.clock, baud=460_800).open()


def test_a_sample_that_comes_twice_is_one(table: Table) -> None:
    times = [10_000 * k for k in range(1, 20)]
    with table.serial([], stream(*times, times[-1])) as wire, Sensor(wire.clock) as sensor:
        samples = sensor.collect(0.2)
        assert sensor.health().duplicated == 1
    assert (np.diff(samples.seq) == 1).all()


def test_bytes_without_frames_are_named_beside_a_command(table: Table) -> None:
    wire = table.serial([(b"C", NOISE)] * 5)
    with wire, pytest.raises(ConnectError, match="'C' was not confirmed .* at 115200 baud" + OTHER_BAUD) as caught:
        Sensor(wire.clock, baud=115_200, sinc=512).open()
    assert "sinc=512" not in str(caught.value)
