"""The bytes the sensor drivers put on the wire, against small scripted peers: golden start-up, and awkward answers."""

import contextlib
import math
import os
import select
import threading
import time
import tty
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, Self

import can
import numpy as np
import pytest

from drivers._crc import crc16_modbus, crc16_x25
from drivers.bota.sensor import BotaSensor
from drivers.errors import ConnectError, DeviceFault
from drivers.interfaces import Fact
from drivers.robotiq.sensor import RobotiqFt300
from drivers.robotous.can import CanLink
from drivers.robotous.sensor import RobotousSensor
from drivers.robotous.serial import SerialLink

NONE: Mapping[bytes, bytes] = MappingProxyType({})


def wait_for(condition: Callable[[], bool]) -> None:
    """The last bytes of a driver that closes reach its peer a little later."""
    deadline = time.monotonic() + 2
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.005)


class SerialPeer:
    """Answers requests from a table on a pseudo-terminal; streams from the request `start` on, or from the beginning.

    A request is recognised at the end of what was heard, so requests must not be the end of each other.
    """

    def __init__(
        self, answers: Mapping[bytes, bytes], *, stream: bytes, start: bytes, stop: bytes, period_s: float = 0.005
    ) -> None:
        self._answers = answers
        self._stream = stream
        self._start = start
        self._stop = stop
        self._period_s = period_s
        self.streaming = not start
        self.heard = bytearray()
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> Self:
        self._master, self._slave = os.openpty()
        tty.setraw(self._master)
        tty.setraw(self._slave)
        self.path = os.ttyname(self._slave)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._end.set()
        self._thread.join()
        os.close(self._master)
        os.close(self._slave)

    def _run(self) -> None:
        due = time.monotonic()
        while not self._end.is_set():
            if select.select([self._master], [], [], max(0.0, min(0.02, due - time.monotonic())))[0]:
                for byte in os.read(self._master, 4096):
                    self.heard.append(byte)
                    self._react()
            if time.monotonic() >= due:
                due += self._period_s
                if self.streaming:
                    os.write(self._master, self._stream)

    def _react(self) -> None:
        for request, answer in self._answers.items():
            if self.heard.endswith(request):
                os.write(self._master, answer)
        if self._stop and self.heard.endswith(self._stop):
            self.streaming = False
        if self._start and self.heard.endswith(self._start):
            self.streaming = True


# ------------------------------------------------------------------ Robotous

STOP, GO = "0C00000000000000", "0B00000000000000"
SAMPLE = "0B 01F4 FF06 03E8 07D0 FC18 0064 00 0000"
REPLIES = {
    "0100000000000000": b"\x01RFT60-HA01".ljust(16, b"\0"),
    "0200000000000000": b"\x02A60HA00123".ljust(16, b"\0"),
    "0300000000000000": b"\x03VER 1.7".ljust(16, b"\0"),
    "1000000000000000": bytes.fromhex("1000").ljust(16, b"\0"),
    "0F08000000000000": bytes.fromhex("0F01").ljust(16, b"\0"),
}
START_UP = [STOP, "0100000000000000", STOP, "0200000000000000", STOP, "0300000000000000"]
WITH_RATE = [*START_UP, STOP, "1000000000000000", STOP, "0F08000000000000", GO, STOP]


def framed(field: bytes) -> bytes:
    return b"\x55" + field + bytes([sum(field) & 0xFF, 0xAA])


def robotous(**options: Any) -> SerialPeer:
    answers = {framed(bytes.fromhex(request)): framed(reply) for request, reply in REPLIES.items()}
    start, stop = (framed(bytes.fromhex(field)) for field in (GO, STOP))
    return SerialPeer(answers, stream=framed(bytes.fromhex(SAMPLE)), start=start, stop=stop, **options)


def test_robotous_uart_start_up_is_golden() -> None:
    with robotous() as peer:
        with RobotousSensor(SerialLink(peer.path, baud=921_600), rate_Hz=1000) as sensor:
            samples = sensor.collect(0.05)
            info = sensor.identify()
        wait_for(lambda: len(peer.heard) >= 11 * len(WITH_RATE))
        fields = [bytes(peer.heard[at + 1 : at + 9]).hex().upper() for at in range(0, len(peer.heard), 11)]
    assert fields == WITH_RATE  # no bias, 0x11, anywhere
    assert (info.model, info.serial, info.firmware) == ("Robotous RFT60-HA01", "A60HA00123", "VER 1.7")
    assert info.facts["counts_per_N"] == Fact(50, "documented")
    np.testing.assert_allclose(samples.wrench[0], [10, -5, 20, 1, -0.5, 0.05])
    assert samples.counts[0].tolist() == [500, -250, 1000, 2000, -1000, 100]


class CanPeer:
    """A Robotous sensor on a virtual bus: answers from the same table, and streams `halves` when told to start."""

    def __init__(self, *halves: tuple[int, str], period_s: float = 0.005) -> None:
        self.heard: list[str] = []
        self._period_s = period_s
        self._halves = [(identifier, bytes.fromhex(data)) for identifier, data in halves]
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> Self:
        self.channel = f"robotous-{id(self)}"
        self._bus = can.Bus(self.channel, interface="virtual", ignore_config=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._end.set()
        self._thread.join()
        self._bus.shutdown()

    def _run(self) -> None:
        streaming, due = False, time.monotonic()
        while not self._end.is_set():
            message = self._bus.recv(timeout=max(0.0, due - time.monotonic()))
            if message is not None and message.arbitration_id == 0x64:
                field = message.data.hex().upper()
                self.heard.append(field)
                streaming = field == GO
                if reply := REPLIES.get(field):
                    self._send(1, reply[:8])
                    self._send(2, reply[8:])
            if time.monotonic() >= due:
                due += self._period_s
                for identifier, data in self._halves if streaming else ():
                    self._send(identifier, data)

    def _send(self, identifier: int, data: bytes) -> None:
        self._bus.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False))


FIRST, SECOND = (1, "0B01F4FF0603E807"), (2, "D0FC180064000000")


def test_robotous_can_speaks_the_same_commands() -> None:
    with CanPeer(FIRST, SECOND, period_s=0.001) as peer:
        with RobotousSensor(CanLink(peer.channel, interface="virtual"), rate_Hz=1000) as sensor:
            samples = sensor.collect(0.05)
        wait_for(lambda: len(peer.heard) >= len(WITH_RATE))
    assert peer.heard == WITH_RATE
    np.testing.assert_allclose(samples.wrench[0], [10, -5, 20, 1, -0.5, 0.05])


def test_robotous_can_foreign_frames_between_halves_do_not_matter() -> None:
    with (
        CanPeer(FIRST, (3, "0011223344556677"), SECOND) as peer,
        RobotousSensor(CanLink(peer.channel, interface="virtual")) as sensor,
    ):
        samples = sensor.collect(0.1)
    np.testing.assert_allclose(samples.wrench[0], [10, -5, 20, 1, -0.5, 0.05])


def test_robotous_rate_is_what_the_sensor_tells() -> None:
    with robotous() as peer, RobotousSensor(SerialLink(peer.path)) as sensor:
        assert sensor.health().nominal_rate_Hz == 200


def test_robotous_overload_names_its_axes() -> None:
    overloaded = (2, "D0FC180064210000")
    with (
        CanPeer(FIRST, overloaded) as peer,
        pytest.raises(DeviceFault, match="overload of Fx, Tz;"),
    ):
        RobotousSensor(CanLink(peer.channel, interface="virtual")).open()


# ------------------------------------------------------------------ Robotiq

FT300_FRAME = bytes.fromhex("20 4E D2 04 C9 FD 10 27 96 00 E7 FF E8 03 86 DC")
FT300_START, FT300_STARTED = bytes.fromhex("09 10 01 9A 00 01 02 02 00 CD CA"), bytes.fromhex("09 10 01 9A 00 01 21 52")
FT300_STOP = b"\xff" * 50


def modbus(text: str) -> bytes:
    body = bytes.fromhex(text)
    return body + crc16_modbus(body).to_bytes(2, "little")


ASK_SERIAL, ASK_FIRMWARE = modbus("09 03 01FE 0004"), modbus("09 03 01F4 0003")
FT300 = {
    ASK_SERIAL: modbus("09 03 08 4654 5300 04D2 0000"),
    ASK_FIRMWARE: modbus("09 03 06 4654 5302 0001"),
    FT300_START: FT300_STARTED,
}


def ft300(change: Mapping[bytes, bytes] = NONE, *, running: bool = False) -> SerialPeer:
    peer = SerialPeer({**FT300, **change}, stream=FT300_FRAME, start=FT300_START, stop=FT300_STOP, period_s=0.01)
    peer.streaming = running
    return peer


def test_robotiq_start_up_is_golden() -> None:
    with ft300() as peer:
        with RobotiqFt300(peer.path) as sensor:
            samples = sensor.collect(0.1)
            info = sensor.identify()
            assert sensor.health().nominal_rate_Hz == 100
        wait_for(lambda: not peer.streaming)
    assert bytes(peer.heard) == FT300_STOP + ASK_SERIAL + ASK_FIRMWARE + FT300_START + FT300_STOP
    assert (info.serial, info.firmware) == ("FTS-1234", "FTS-2.0.1")
    assert info.facts["counts_per_Nm"] == Fact(1000, "documented")
    assert info.facts["range"] == Fact((300, 300, 300, 30, 30, 30), "documented")
    np.testing.assert_allclose(samples.wrench[0], [12.34, -5.67, 100, 0.15, -0.025, 1])


def test_robotiq_that_streams_since_it_booted_is_stopped_first() -> None:
    with ft300(running=True) as peer, RobotiqFt300(peer.path) as sensor:
        assert len(sensor.collect(0.1)) > 3


def test_robotiq_without_a_firmware_register() -> None:
    with ft300({ASK_FIRMWARE: modbus("09 83 02")}) as peer, RobotiqFt300(peer.path) as sensor:
        assert sensor.identify().firmware == "not reported"


def test_robotiq_that_refuses_to_stream() -> None:
    with (
        ft300({FT300_START: modbus("09 90 02")}) as peer,
        pytest.raises(ConnectError, match="refused function 0x10"),
    ):
        RobotiqFt300(peer.path).open()


@pytest.mark.parametrize(("rate_Hz", "hint"), [(62.5, "latency_timer"), (80.0, "are lost"), (100.0, "")])
def test_robotiq_slow_usb_adapter_is_named_with_its_cure(
    rate_Hz: float, hint: str, caplog: pytest.LogCaptureFixture
) -> None:
    sensor = RobotiqFt300("/dev/ttyUSB0")
    sensor._nominal_Hz = 100.0
    note = [sensor._rate.judge(1, round(1e9 * (5 + n / rate_Hz)), 100.0) for n in range(round(5 * rate_Hz))]
    warned = [record.message for record in caplog.records if "instead of" in record.message]
    assert len(warned) == bool(hint)  # one fault, one warning
    assert all(hint in text for text in warned)
    assert note.count(f"rate {rate_Hz:.1f} Hz instead of 100 Hz") == bool(hint)


# ------------------------------------------------------------------ Bota

PAYLOAD = bytes.fromhex("0000803F 000000C0 C3F51C41 CDCCCC3D CDCC4CBE 9A99993E")


def bota_frame(t_us: int, status: int = 0) -> bytes:
    body = status.to_bytes(2, "little") + PAYLOAD + (t_us % 2**32).to_bytes(4, "little") + bytes.fromhex("0000CC41")
    return b"\xaa" + body + crc16_x25(body).to_bytes(2, "little")


class Bota(SerialPeer):
    """Streams for ever; `times` are told one after the other, the last one advances by 10 ms each."""

    def __init__(self, answers: Mapping[bytes, bytes] = NONE, *, times: list[int] | None = None) -> None:
        super().__init__(answers, stream=b"", start=b"", stop=b"", period_s=0.01)
        self._times = times or []
        self._t_us = 1_000_000

    def _run(self) -> None:
        while not self._end.is_set():
            self._t_us = self._times.pop(0) if self._times else self._t_us + 10_000
            os.write(self._master, bota_frame(self._t_us))
            if select.select([self._master], [], [], 0.01)[0]:
                for byte in os.read(self._master, 4096):
                    self.heard.append(byte)
                    self._react()


def test_bota_is_only_listened_to() -> None:
    with Bota() as peer:
        with BotaSensor(peer.path) as sensor:
            samples = sensor.collect(0.1)
        assert not peer.heard
    np.testing.assert_allclose(samples.wrench[0], [1, -2, 9.81, 0.1, -0.2, 0.3], rtol=1e-6)
    np.testing.assert_allclose(np.diff(samples.t_device_s), 0.01, atol=1e-9)


def test_bota_is_configured_when_asked() -> None:
    answers = {b"C": b"r,0,C,0", b"c,0,1,0,4": b"r,0,c,0", b"f,512,0,0,1": b"r,0,f,0", b"R": b"r,0,R,0"}
    with Bota(answers) as peer:
        with BotaSensor(peer.path, sinc=512):
            pass
        assert bytes(peer.heard) == b"Cc,0,1,0,4f,512,0,0,1R"


def test_bota_clock_wraps(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("drivers._plausible._FROZEN_S", math.inf)  # the peer repeats one wrench
    begin = 2**32 - 150_000
    with Bota(times=[begin + 10_000 * k for k in range(30)]) as peer, BotaSensor(peer.path) as sensor:
        samples = sensor.collect(0.25)
    assert (np.diff(samples.seq) == 1).all()
    assert samples.t_device_s[-1] > 2**32 / 1e6
    np.testing.assert_allclose(np.diff(samples.t_device_s), 0.01, atol=1e-9)


def test_bota_gaps_are_seen_on_its_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("drivers._plausible._FROZEN_S", math.inf)  # the peer repeats one wrench
    times = [10_000 * k for k in range(1, 40) if k not in {25, 26, 30}]
    with Bota(times=times) as peer, BotaSensor(peer.path) as sensor:
        samples = sensor.collect(0.35)
        health = sensor.health()
    assert sorted(np.diff(samples.seq))[-2:] == [2, 3]
    assert health.lost == 3


def test_bota_sample_that_comes_twice_is_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("drivers._plausible._FROZEN_S", math.inf)  # the peer repeats one wrench
    with Bota() as peer:
        sensor = BotaSensor(peer.path)
        sensor._stale_after_s = 3.0  # the peer is a thread beside it, and may be late
        with sensor:
            begin_us = peer._t_us + 300_000  # it tells the time meanwhile
            peer._times += [begin_us, begin_us, begin_us + 10_000]
            wait_for(lambda: sensor.latest(timeout_s=0.0).t_device_s[0] > begin_us / 1e6)
            assert sensor.health().duplicated == 1


def test_noise_is_no_sensor() -> None:
    with SerialPeer({}, stream=b"\xaa" * 40, start=b"", stop=b"") as peer:
        for sensor in (RobotousSensor(SerialLink(peer.path)), BotaSensor(peer.path)):
            with pytest.raises(ConnectError, match=r"check (supply|wiring)"), contextlib.closing(sensor):
                sensor.open()
