"""The bytes both ATI drivers put on the wire, against small scripted peers: golden start-up, and awkward answers."""

import contextlib
import itertools
import math
import os
import select
import struct
import sys
import termios
import threading
import time
import tty
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from types import MappingProxyType, SimpleNamespace
from typing import Any, Self, TypeAlias, TypeVar

import can
import numpy as np
import pytest

from drivers.ati.can import AtiCanSensor
from drivers.ati.serial import AtiSerialSensor
from drivers.errors import ConnectError, DeviceFault, DeviceTimeout, DriverError, ProtocolError, StreamBroken
from drivers.interfaces import Fact, FtSamples

GAUGES = ["200 0000 0064 012C 01F4", "201 FF38 FE70 FDA8"]
WRENCH = [-0.85, 1.476, 6.84, 0.044, -0.0762, 0.1608]
START_UP = {
    "205": ["205 4654313233343500"],
    "20F": ["20F 03080002"],
    "206 00": ["206 00"],
    "202 00": ["202 00000000 00000000", "203 00000000 C584D000", "204 00000000 4584D000"],
    "202 01": ["202 00000000 4599C000", "203 00000000 C519C000", "204 00000000 C519C000"],
    "202 02": ["202 45ED8000 00000000", "203 45ED8000 00000000", "204 45ED8000 00000000"],
    "202 03": ["202 00000000 00000000", "203 C35C0000 00000000", "204 435C0000 00000000"],
    "202 04": ["202 437E0000 00000000", "203 C2FE0000 00000000", "204 C2FE0000 00000000"],
    "202 05": ["202 00000000 C3060000", "203 00000000 C3060000", "204 00000000 C3060000"],
    "207": ["207 000F4240000F4240"],
    "208": ["208 0203"],
    "200": GAUGES,
}
PATIENCE_S = 3.0
"""A silence the sensors of these tests may keep: their peers are threads beside them, and wait on a busy computer."""
_numbers = itertools.count()


T = TypeVar("T")
Pair: TypeAlias = tuple[int, int]
Script: TypeAlias = Mapping[str, Sequence[T]]
NONE: Mapping[str, Any] = MappingProxyType({})


class CanPeer:
    """Answers requests from a table on a virtual bus; an empty list is silence, a list of lists is one answer each."""

    def __init__(
        self, change: Mapping[str, Sequence[str | list[str]]] = MappingProxyType({}), *, echo: bool = False
    ) -> None:
        self.channel = f"ati-{next(_numbers)}"
        self.echo = echo
        self.answers: dict[str, Iterator[list[str]]] = {}
        for request, answer in {**START_UP, **change}.items():
            script = [a for a in answer if isinstance(a, list)]
            once = [a for a in answer if isinstance(a, str)]
            last = script.pop() if script else once
            self.answers[request] = itertools.chain(script, itertools.repeat(last))
        self.requests: list[str] = []
        self.extra: list[str] = []
        """Sent once, before the next answer."""
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def sensor(
        self, slot: int = 0, unit_codes: Pair | None = None, counts_per_unit: Pair | None = None
    ) -> AtiCanSensor:
        sensor = AtiCanSensor(
            self.channel, interface="virtual", slot=slot, unit_codes=unit_codes, counts_per_unit=counts_per_unit
        )
        sensor._stale_after_s = PATIENCE_S
        return sensor

    def __enter__(self) -> Self:
        self._bus = can.Bus(self.channel, interface="virtual", ignore_config=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
        self._bus.shutdown()

    def _run(self) -> None:
        while not self._stop.is_set():
            message = self._bus.recv(timeout=0.02)
            if message is None:
                continue
            request = f"{message.arbitration_id:03X} {message.data.hex().upper()}".strip()
            self.requests.append(request)
            extra, self.extra = self.extra, []
            echo = [request] if self.echo else []
            for line in [*echo, *extra, *next(self.answers.get(request, itertools.repeat([])))]:
                identifier, _, payload = line.partition(" ")
                data = bytes.fromhex(payload)
                self._bus.send(can.Message(arbitration_id=int(identifier, 16), data=data, is_extended_id=False))


def test_can_start_up_is_golden_and_then_only_gauges_are_asked() -> None:
    with CanPeer() as peer, peer.sensor() as sensor:
        samples = sensor.collect(0.1)
        info = sensor.identify()
        assert (info.serial, info.firmware) == ("FT12345", "3.8 build 2")
        assert info.facts["counts_per_N"] == info.facts["counts_per_Nm"] == Fact(1e6, "device")
        assert "range" not in info.facts
        assert samples.wrench.mean(axis=0).tolist() == pytest.approx(WRENCH)
        assert samples.counts[0].tolist() == [100, -200, 300, -400, 500, -600]
    assert peer.requests[:12] == list(START_UP)
    assert set(peer.requests[12:]) == {"200"}


@pytest.mark.parametrize(
    ("first_half", "second_half", "status", "wrench"),
    [
        ("0000 00DD 0045 0926", "FC62 FBC2 04F2", 0, [9.996, -4.99872, 20.0032, 0.50006, -0.250063, 0.099964]),
        ("C000 0064 012C 01F4", "FF38 FE70 FDA8", 0xC000, WRENCH),  # bits 14 and 15 make no sample unusable
    ],
)
def test_can_samples_are_golden(first_half: str, second_half: str, status: int, wrench: list[float]) -> None:
    with CanPeer({"200": [f"200 {first_half}", f"201 {second_half}"]}) as peer, peer.sensor() as sensor:
        sample = sensor.latest(timeout_s=1)
        assert sample.wrench[0].tolist() == pytest.approx(wrench)
        assert sample.status[0] == status


def test_can_slot_is_selected_and_its_echo_checked() -> None:
    with CanPeer({"206 03": ["206 03"]}) as peer, peer.sensor(slot=3):
        assert "206 03" in peer.requests
    with (
        CanPeer({"206 03": ["206 00"]}) as peer,
        pytest.raises(ConnectError, match="slot 3, the sensor answered 0; end"),
    ):
        peer.sensor(slot=3).open()


@pytest.mark.parametrize(
    "answers",
    [
        {"207": ["207 0000000000000000"]},
        {"208": ["208 0903"]},
        {"202 00": [f"20{n} {'7FC00000' * 2}" for n in (2, 3, 4)]},
        {"202 00": [f"20{n} {'00' * 8}" for n in (2, 3, 4)]},
    ],
    ids=["counts", "units", "not finite", "singular"],
)
def test_can_calibration_that_is_none_names_device_slot_and_cure(answers: dict[str, list[str]]) -> None:
    with CanPeer(answers) as peer, pytest.raises(ConnectError) as caught:
        peer.sensor().open()
    assert str(caught.value).startswith("ATI CAN sensor 0x20 on ")
    assert ": calibration slot 0: " in str(caught.value)
    assert str(caught.value).endswith("; choose another, slot=0 to 15 in its address")


def test_can_bus_that_echoes_does_not_fake_the_slot_echo() -> None:
    with CanPeer(echo=True) as peer, peer.sensor() as sensor:
        sensor.collect(0.05)
    with CanPeer({"206 03": []}, echo=True) as peer, pytest.raises(ConnectError, match="no answer to SELECT_SLOT"):
        peer.sensor(slot=3).open()


def test_can_old_firmware_has_a_million_counts_per_newton(caplog: pytest.LogCaptureFixture) -> None:
    with CanPeer({"20F": ["20F 03060001"], "207": [], "208": []}) as peer, peer.sensor() as sensor:
        assert sensor.latest(timeout_s=1).wrench[0].tolist() == pytest.approx(WRENCH)
        assert not {"207", "208"} & set(peer.requests)
        assert sensor.identify().facts["counts_per_N"] == Fact(1e6, "assumed")
    assert "does not tell its units; 1000000 counts per N and 1000000 per N·m assumed" in caplog.text


def test_can_old_firmware_in_units_of_the_certificate(caplog: pytest.LogCaptureFixture) -> None:
    old = {"20F": ["20F 03060001"], "207": [], "208": []}
    lbf, lbf_in = 4.4482216152605, 0.1129848290276167
    with CanPeer(old) as peer, peer.sensor(unit_codes=(1, 1)) as sensor:
        wrench = sensor.latest(timeout_s=1).wrench[0]
        assert wrench.tolist() == pytest.approx(np.array(WRENCH) * ([lbf] * 3 + [lbf_in] * 3))
        facts = sensor.identify().facts
        assert facts["counts_per_N"] == Fact(1e6 / lbf, "configured")
        assert facts["counts_per_Nm"] == Fact(1e6 / lbf_in, "configured")
    assert "does not tell" not in caplog.text
    with CanPeer(old) as peer, peer.sensor(unit_codes=(2, 3), counts_per_unit=(500_000, 1_000_000)) as sensor:
        assert sensor.latest(timeout_s=1).wrench[0, :3].tolist() == pytest.approx([2 * force for force in WRENCH[:3]])
        assert sensor.identify().facts["counts_per_N"] == Fact(5e5, "configured")
    with CanPeer(old) as peer, peer.sensor(counts_per_unit=(500_000, 1_000_000)) as sensor:
        assert sensor.identify().facts["counts_per_N"] == Fact(5e5, "assumed")  # the unit is
    assert "500000 counts per N and 1000000 per N·m assumed" in caplog.text


def test_can_scale_that_the_sensor_contradicts_is_refused() -> None:
    with CanPeer() as peer, peer.sensor(unit_codes=(2, 3), counts_per_unit=(1_000_000, 1_000_000)) as sensor:
        assert sensor.identify().facts["counts_per_N"] == Fact(1e6, "device")
    told = "tells 1000000 counts per N and 1000000 per N-m, configured are "
    with CanPeer() as peer:
        with pytest.raises(ConnectError, match=told + "1000000 counts per lbf and 1000000 per N-m"):
            peer.sensor(unit_codes=(1, 3)).open()
        with pytest.raises(ConnectError, match=told + "1000000 counts per N and 10000 per N-m"):
            peer.sensor(counts_per_unit=(1_000_000, 10_000)).open()


def test_can_halves_pair_up_by_identifier_among_foreign_frames() -> None:
    swapped = ["201 FF38 FE70 FDA8", "1FF 0102", "210 0000 0064 012C 01F4", "200", "201 FF", *GAUGES[:1]]
    with CanPeer({"200": swapped}) as peer, peer.sensor() as sensor:
        samples = sensor.collect(0.05)
        assert samples.wrench[0].tolist() == pytest.approx(WRENCH)
        assert sensor.health().lost == 0


def test_can_stale_frames_are_purged_before_a_request() -> None:
    """A duplicate left over from the last reading must not become half of the next one."""
    twice = [*GAUGES, "200 0000 7000 7000 7000"]
    with CanPeer({"200": twice}) as peer, peer.sensor() as sensor:
        counts = sensor.collect(0.05).counts
        assert (counts == [100, -200, 300, -400, 500, -600]).all()


def test_can_lost_half_is_a_lost_sample_and_no_wrong_one() -> None:
    script = [GAUGES, GAUGES, GAUGES[:1], GAUGES]
    with CanPeer({"200": script}) as peer, peer.sensor() as sensor:
        samples = sensor.collect(0.15)
        assert (samples.counts == [100, -200, 300, -400, 500, -600]).all()
        assert sensor.health().lost == 1
        assert (samples.seq == 3).sum() <= 1


class BusOfItsOwnTime:
    """A bus on which nobody has to wait: a poll is answered as the test says, by (ms after the poll, frame)."""

    malformed = 0

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *answers: list[tuple[float, str]]) -> None:
        self._answers = iter(answers)
        self._now_s = 100.0
        self._coming: list[tuple[float, int, bytes]] = []
        clock = SimpleNamespace(
            monotonic=lambda: self._now_s, monotonic_ns=lambda: round(self._now_s * 1e9), sleep=self._pass
        )
        monkeypatch.setattr("drivers.ati.can.time", clock)
        monkeypatch.setattr("drivers.ati.can._POLL_S", 0.05)

    def open(self) -> None: ...

    def close(self) -> None: ...

    def discard(self) -> None:
        self._coming = [frame for frame in self._coming if frame[0] > self._now_s]

    def send(self, identifier: int, data: bytes) -> None:
        request = f"{identifier:03X} {data.hex().upper()}".strip()
        start_up = [(1.0, frame) for frame in START_UP[request]]
        for after_ms, frame in next(self._answers, []) if request == "200" else start_up:
            number, _, payload = frame.partition(" ")
            self._coming.append((self._now_s + 1e-3 * after_ms, int(number, 16), bytes.fromhex(payload)))
        self._coming.sort(key=lambda frame: frame[0])

    def receive(self, timeout_s: float) -> tuple[int, bytes] | None:
        if not self._coming or self._coming[0][0] > self._now_s + timeout_s:
            self._pass(timeout_s)
            return None
        arrives_s, number, payload = self._coming.pop(0)
        self._pass(arrives_s - self._now_s)
        return number, payload

    def _pass(self, seconds: float) -> None:
        self._now_s += max(0.0, seconds)


def read(sensor: AtiCanSensor, bus: BusOfItsOwnTime, monkeypatch: pytest.MonkeyPatch, polls: int) -> list[list[int]]:
    """Connect, poll, and return the gauges of every sample."""
    monkeypatch.setattr(sensor, "_bus", bus)
    sensor._connect()
    return [gauges for _ in range(polls) for gauges in sensor._read_block().counts.tolist()]


PROMPT = [(1.0, GAUGES[0]), (1.5, GAUGES[1])]


@pytest.mark.parametrize(
    "frames", [["200 0000 0001 0002 0003", *GAUGES], ["201 0004 0005 0006", *GAUGES]], ids=["twice", "wrong order"]
)
def test_can_halves_of_two_readings_are_no_sample(frames: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    mixed = [(1.0 + 0.5 * number, frame) for number, frame in enumerate(frames)]
    bus, sensor = BusOfItsOwnTime(monkeypatch, PROMPT, PROMPT, mixed, PROMPT), AtiCanSensor("can0")
    assert read(sensor, bus, monkeypatch, 3) == [[100, -200, 300, -400, 500, -600]] * 2
    assert (sensor.health().lost, sensor.health().malformed) == (1, 1)


def test_can_half_that_is_late_does_not_pair_up_with_the_next_reading(monkeypatch: pytest.MonkeyPatch) -> None:
    late = [(1.0, GAUGES[0]), (53.0, "201 0004 0005 0006")]  # a poll has 50 ms
    half = [(10.0, GAUGES[0])]
    bus, sensor = BusOfItsOwnTime(monkeypatch, PROMPT, PROMPT, late, half, PROMPT), AtiCanSensor("can0")
    assert read(sensor, bus, monkeypatch, 4) == [[100, -200, 300, -400, 500, -600]] * 2
    assert sensor.health().lost == 2


def test_can_sensor_that_stops_answering_times_out() -> None:
    script = [GAUGES, GAUGES, []]
    with CanPeer({"200": script}) as peer, peer.sensor() as sensor:
        sensor._stale_after_s = 0.3
        with pytest.raises(DeviceTimeout, match="silent for"):
            sensor.collect(1.0)


def test_can_nobody_there() -> None:
    with CanPeer({"205": []}) as peer, pytest.raises(ConnectError, match="no answer to SERIAL after 3 attempts"):
        peer.sensor().open()


def test_can_reply_lost_in_the_start_up_is_asked_again() -> None:
    with CanPeer({"205": [[], START_UP["205"]]}) as peer, peer.sensor():
        assert peer.requests[:3] == ["205", "205", "20F"]


@pytest.mark.parametrize(
    ("first_half", "error", "message"),
    [
        ("200 8040 0064 012C 01F4", DeviceFault, "bit 6: no valid calibration"),
        ("200 0800 0064 012C 01F4", DeviceFault, "temperature too high"),
        ("200 0000 7FFF 012C 01F4", DeviceFault, "gauge G0 at the end"),
        ("200 0000 0064 012C 8000", DeviceFault, "gauge G4 at the end"),
        ("200 0001 0064 012C 01F4", StreamBroken, "has reset itself"),
    ],
)
def test_can_status_that_ends_the_stream(first_half: str, error: type[DriverError], message: str) -> None:
    script = [*[GAUGES] * 50, [first_half, GAUGES[1]]]  # so many that `open` has returned
    with CanPeer({"200": script}) as peer, peer.sensor() as sensor, pytest.raises(error, match=message):
        sensor.collect(1.0)


def test_can_harmless_status_is_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    with CanPeer({"200": ["200 C101 0064 012C 01F4", GAUGES[1]]}) as peer, peer.sensor() as sensor:
        assert sensor.collect(0.05).status[0] == 0xC101
    assert caplog.text.count("measuring goes on") == 1
    assert "CAN bus error" in caplog.text


def test_can_empty_slot_is_a_fault() -> None:
    zeros = {f"202 0{axis}": [f"20{n} {'00' * 8}" for n in (2, 3, 4)] for axis in range(6)}
    with CanPeer(zeros) as peer, pytest.raises(DeviceFault, match="slot 0 is empty"):
        peer.sensor().open()


@pytest.mark.parametrize(
    ("interface", "channel"),
    [
        ("slcan", "/dev/does-not-exist"),
        ("socketcan", "no-such-can"),
        ("no-such-interface", "x"),
        ("kvaser", "0"),  # these three without their libraries: NameError, ImportError, TypeError
        ("neovi", "0"),
        ("socketcand", "can0"),
    ],
)
def test_can_bus_that_does_not_open(interface: str, channel: str) -> None:
    with pytest.raises(ConnectError, match=f"on {interface} {channel}: ") as caught:
        AtiCanSensor(channel, interface=interface).open()
    assert ("sudo ip link set no-such-can up" in str(caught.value)) == (interface == "socketcan")


def test_an_adapter_on_a_serial_port_without_its_interface_is_told_so() -> None:
    with pytest.raises(ConnectError, match=r"this is no CAN interface: .* wants interface=slcan") as caught:
        AtiCanSensor("/dev/ttyACM0").open()
    assert "ip link" not in str(caught.value)


# The serial peer -----------------------------------------------------------------------------------------------------


def crc(data: bytes) -> bytes:
    """CRC-16/MODBUS bit by bit, low byte first."""
    value = 0xFFFF
    for byte in data:
        value ^= byte
        for _ in range(8):
            value = value >> 1 ^ (0xA001 if value & 1 else 0)
    return struct.pack("<H", value)


def calibration_block(unit_codes: bytes = b"\x02\x03", max_rating: float = 0.0) -> bytes:
    data = bytearray(338)
    matrix = [
        *(0, 0, 0, -4250, 0, 4250),
        *(0, 4920, 0, -2460, 0, -2460),
        *(7600, 0, 7600, 0, 7600, 0),
        *(0, 0, -220, 0, 220, 0),
        *(254, 0, -127, 0, -127, 0),
        *(0, -134, 0, -134, 0, -134),
    ]
    data[0:8] = b"FT54321\0"
    data[8:17] = b"SI-130-10"
    data[64:208] = struct.pack(">36f", *matrix)
    data[208:210] = unit_codes
    data[210:234] = struct.pack(">6f", *[max_rating] * 6)
    data[234:242] = struct.pack(">ii", 1_000_000, 1_000_000)
    data[242:254] = struct.pack(">6H", 543, 555, 569, 579, 565, 567)
    data[254:266] = struct.pack(">6H", *[0x8000] * 6)
    return bytes(data)


def read_reply(data: bytes) -> bytes:
    body = bytes([0x0A, 0x03, len(data)]) + data
    return body + crc(body)


JAM = "AA" * 14
STATUS = "0A03001D00011577"
START = "0A4655A39D"
SERIAL_START_UP = [
    JAM,
    STATUS,
    "0A0300E30040B4B7",
    "0A0301230040B577",
    "0A0301630029748D",
    "0A6AAAFF1D",
    "0A10000000060C021F022B0239024302350237472D",
    "0A10000600060C" + "8000" * 6 + "7566",
    "0A6A187F68",
    START,
]
RECORD = bytes.fromhex("0064012C01F4FF38FE70FDA850")
RECORD_ERROR = RECORD[:12] + b"\xd0"
RECORD_SATURATED = bytes.fromhex("0064012C01F4FF38FE707FFF") + bytes(
    [0x64 + 1 + 0x2C + 1 + 0xF4 + 0xFF + 0x38 + 0xFE + 0x70 + 0x7F + 0xFF & 0x7F]
)


@pytest.fixture(autouse=True)
def _peers_are_simple(monkeypatch: pytest.MonkeyPatch) -> None:
    """Scripted peers send one record over and over, and on a busy computer they answer late."""
    monkeypatch.setattr("drivers._plausible._FROZEN_S", math.inf)
    for time_out in ("can._POLL_S", "can._TRANSACTION_S", "serial._REPLY_S"):
        monkeypatch.setattr(f"drivers.ati.{time_out}", 0.3)


def marked(data: bytes, *damaged: int) -> bytes:
    """What the system makes of bytes that were received, `damaged` ones with wrong parity."""
    doubled = [b"\xff\xff" if byte == 0xFF else bytes([byte]) for byte in data]
    return b"".join(b"\xff\x00" + data[i : i + 1] if i in damaged else one for i, one in enumerate(doubled))


class SerialPeer:
    """Answers requests from a table on a pseudo-terminal and, once started, streams what the test says."""

    def __init__(self, change: Script[bytes] = NONE, *, streaming: bool = False, makes_marks: bool = False) -> None:
        block = calibration_block()
        self._makes_marks = makes_marks
        answers: dict[str, Sequence[bytes]] = {
            STATUS: [bytes.fromhex("0A030200001D85")],
            SERIAL_START_UP[2]: [read_reply(block[:128])],
            SERIAL_START_UP[3]: [read_reply(block[128:256])],
            SERIAL_START_UP[4]: [read_reply(block[256:])],
            "0A6AAAFF1D": [bytes.fromhex("0A6A01BEA2")],
            SERIAL_START_UP[6]: [bytes.fromhex("0A10000000064170")],
            SERIAL_START_UP[7]: [bytes.fromhex("0A1000060006A171")],
            "0A6A187F68": [bytes.fromhex("0A6A01BEA2")],
            START: [bytes.fromhex("0A4601A262")],
            **change,
        }
        self.answers = {key: itertools.chain(value[:-1], itertools.repeat(value[-1])) for key, value in answers.items()}
        self.requests: list[str] = []
        self.records = RECORD * 7
        """Sent every millisecond."""
        self.once: deque[bytes] = deque()
        """Each sent once, before the next records."""
        self._streaming = streaming
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def sensor(self) -> AtiSerialSensor:
        sensor = AtiSerialSensor(self.path)
        sensor._stale_after_s = PATIENCE_S
        return sensor

    def __enter__(self) -> Self:
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.path = os.ttyname(self._slave)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
        os.close(self._master)
        os.close(self._slave)

    def _run(self) -> None:
        jam = unsent = b""
        while not self._stop.is_set():
            if not select.select([self._master], [], [], 0.001)[0]:
                if self._streaming:
                    unsent = unsent or (self.once.popleft() if self.once else b"") + self.records
                    with contextlib.suppress(BlockingIOError):  # nobody has read for a while: nothing is cut off
                        unsent = unsent[os.write(self._master, unsent) :]
                continue
            data = os.read(self._master, 4096)
            if self._makes_marks:  # like a port that checks parity, from the first request on
                settings = termios.tcgetattr(self._master)
                assert settings[0] & termios.INPCK
                settings[0] &= ~termios.PARMRK
                termios.tcsetattr(self._master, termios.TCSANOW, settings)
            if self._streaming:
                jam += data
                self._streaming = len(jam) < 14
                if self._streaming:
                    continue
                data, jam, unsent = jam, b"", b""
            text = data.hex().upper()
            while text.startswith(JAM) and text != JAM:  # heard late, with what followed
                self.requests.append(JAM)
                text = text.removeprefix(JAM)
            self.requests.append(text)
            if text in self.answers:
                reply = next(self.answers[text])
                os.write(self._master, marked(reply) if self._makes_marks else reply)
                self._streaming = text == START and reply == bytes.fromhex("0A4601A262")


def everything(sensor: AtiSerialSensor) -> Callable[[], FtSamples]:
    """Watch a stream without a limit of time: returns what gives all samples since now."""
    blocks: deque[FtSamples] = deque()
    with sensor._news:
        sensor._taps.append(blocks)
    return lambda: FtSamples.concatenate(list(blocks))


def gaps(samples: FtSamples) -> int:
    return int((np.diff(samples.seq) - 1).sum())


def wait_for(condition: Callable[[], bool]) -> None:
    """Wait as long as a busy computer may need."""
    deadline = time.monotonic() + 10
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.005)


def wait_for_more(sensor: AtiSerialSensor) -> None:
    """Wait for a sample that is still to be received."""
    received = sensor.health().received
    wait_for(lambda: sensor.health().received > received)


def test_serial_start_up_and_goodbye_are_golden() -> None:
    with SerialPeer() as peer:
        with peer.sensor() as sensor:
            samples = everything(sensor)
            wait_for(lambda: sensor.health().received > 700)
            info = sensor.identify()
            assert (info.model, info.serial) == ("ATI Digital F/T SI-130-10", "FT54321")
            assert samples().wrench.mean(axis=0).tolist() == pytest.approx(WRENCH)
            assert samples().counts[0].tolist() == [100, -200, 300, -400, 500, -600]
        wait_for(lambda: len(peer.requests) > len(SERIAL_START_UP))
        assert peer.requests == [*SERIAL_START_UP, JAM]


def test_serial_what_is_left_of_an_answer_is_not_the_next_one() -> None:
    with SerialPeer({STATUS: [bytes.fromhex("0A030200001D85") + b"\x0a\x03"]}) as peer, peer.sensor():
        assert peer.requests == SERIAL_START_UP  # nothing had to be asked twice


@pytest.mark.parametrize(
    ("unit_codes", "max_rating", "counts_per_N", "range_"),
    [
        (b"\x02\x03", 25.0, 1e6, (25.0,) * 6),
        (b"\x04\x04", 2.0, 1e3, (2000.0,) * 3 + (0.002,) * 3),  # kN and N·mm
        (b"\x02\x03", 0.0, 1e6, None),
        (b"\x02\x03", math.nan, 1e6, None),
    ],
)
def test_serial_scale_and_range_are_the_devices(
    unit_codes: bytes, max_rating: float, counts_per_N: float, range_: tuple[float, ...] | None
) -> None:
    block = calibration_block(unit_codes, max_rating)
    change = {SERIAL_START_UP[3]: [read_reply(block[128:256])]}
    with SerialPeer(change) as peer, peer.sensor() as sensor:
        facts = sensor.identify().facts
    assert facts["counts_per_N"] == Fact(counts_per_N, "device")
    if range_ is None:
        assert "range" not in facts
    else:
        assert facts["range"].source == "device"
        assert facts["range"].value == pytest.approx(range_)


def test_serial_sensor_left_streaming_is_jammed_first() -> None:
    with SerialPeer(streaming=True) as peer, peer.sensor() as sensor:
        sensor.collect(0.05)
        assert peer.requests == SERIAL_START_UP


def test_serial_single_bad_records_are_dropped_and_counted() -> None:
    with SerialPeer() as peer, peer.sensor() as sensor:
        before, samples = len(peer.requests), everything(sensor)
        peer.once.append(RECORD[:12] + b"\x51" + RECORD * 3 + RECORD[:12] + b"\x51")
        wait_for(lambda: sensor.health().malformed >= 2)
        wait_for_more(sensor)
        health = sensor.health()
        assert (health.malformed, health.lost) == (2, 2)
        assert (samples().counts == [100, -200, 300, -400, 500, -600]).all()
        assert gaps(samples()) == 2
        assert peer.requests[before:] == []


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere no marks are asked for")
def test_serial_records_with_a_byte_of_wrong_parity_are_dropped_although_their_sum_holds() -> None:
    changed = [RECORD[:at] + bytes([RECORD[at] ^ 0x80]) + RECORD[at + 1 :] for at in range(13)]  # also the error bit
    with SerialPeer(makes_marks=True) as peer:
        peer.records = marked(RECORD * 7)
        with peer.sensor() as sensor:
            before, samples = len(peer.requests), everything(sensor)
            for at, record in enumerate(changed):
                peer.once.append(marked(RECORD * 3 + record, 39 + at))
            wait_for(lambda: sensor.health().malformed >= 13)
            wait_for_more(sensor)
            health = sensor.health()
            assert (health.malformed, health.lost) == (13, 13)
            assert (samples().counts == [100, -200, 300, -400, 500, -600]).all()
            assert gaps(samples()) == 13
            peer.once.append(marked(RECORD * 5, *range(65)))  # an adapter that blames a whole packet: no slip
            wait_for(lambda: sensor.health().malformed >= 18)
            wait_for_more(sensor)
            assert gaps(samples()) == 18
            assert peer.requests[before:] == []


def test_serial_slipped_stream_is_restarted() -> None:
    with SerialPeer() as peer, peer.sensor() as sensor:
        before, samples = len(peer.requests), everything(sensor)
        peer.once.append(b"\x77")
        wait_for(lambda: START in peer.requests[before:])
        wait_for_more(sensor)
        after = peer.requests[before:]
        assert (after[0], after[-1], set(after)) == (JAM, START, {JAM, STATUS, START})
        assert (samples().counts == [100, -200, 300, -400, 500, -600]).all()
        health = sensor.health()
        assert 50 < gaps(samples()) <= health.lost  # some 30 ms at 7 kHz
        assert health.malformed >= 3


def test_serial_stream_that_never_makes_sense_ends() -> None:
    with SerialPeer() as peer:
        peer.records = RECORD[:12] + b"\x51"
        with pytest.raises(ConnectError, match="no intact record after 3 restarts"):
            peer.sensor().open()


def test_serial_error_bit_ends_the_stream_with_the_status_in_words() -> None:
    status = [bytes.fromhex("0A030200001D85"), read_reply(b"\x80\x80")]
    with SerialPeer({STATUS: status}) as peer, peer.sensor() as sensor:
        peer.once.append(RECORD_ERROR)
        with pytest.raises(DeviceFault, match=r"0x8080 \(bit 7: EEPROM error, bit 15: any error\)"):
            sensor.collect(1.0)
        assert peer.requests[len(SERIAL_START_UP) :] == [JAM, STATUS]


def test_serial_error_bit_that_the_status_does_not_confirm_is_damage() -> None:
    with SerialPeer() as peer, peer.sensor() as sensor:
        before, samples = len(peer.requests), everything(sensor)
        peer.once.append(RECORD_ERROR)
        wait_for(lambda: START in peer.requests[before:])
        wait_for(lambda: sensor.health().lost > 1)  # the stream is back
        wait_for_more(sensor)
        after = peer.requests[before:]
        assert (after[0], after[-1], set(after)) == (JAM, START, {JAM, STATUS, START})
        assert (samples().counts == [100, -200, 300, -400, 500, -600]).all()
        health = sensor.health()
    assert health.malformed == 1
    assert gaps(samples()) == health.lost > 1


def flagged(records: bytes) -> bytes:
    """Set the error bit of every record."""
    return bytes(byte | 0x80 if at % 13 == 12 else byte for at, byte in enumerate(records))


@pytest.mark.parametrize("status", [0x8000, 0xC000, 0x8100, 0x8001])
def test_serial_error_bit_that_nothing_critical_explains_is_no_damage(
    status: int, caplog: pytest.LogCaptureFixture
) -> None:
    """Such as of a NETCANOEM whose CAN side is not connected."""
    with SerialPeer({STATUS: [read_reply(status.to_bytes(2, "big"))]}) as peer:
        peer.records = flagged(RECORD * 7)
        with peer.sensor() as sensor:
            samples = sensor.collect(0.1)
            assert (samples.status == status).all()
            assert (samples.counts == [100, -200, 300, -400, 500, -600]).all()
            assert sensor.health().lost == sensor.health().malformed == 0
        wait_for(lambda: len(peer.requests) > len(SERIAL_START_UP))
        assert peer.requests == [*SERIAL_START_UP, JAM]
    assert caplog.text.count("measuring goes on") == 1


def test_serial_error_bit_that_comes_later_is_looked_at_and_may_be_harmless(caplog: pytest.LogCaptureFixture) -> None:
    fine, idle = bytes.fromhex("0A030200001D85"), read_reply(b"\xc0\0")
    with SerialPeer({STATUS: [fine, idle]}) as peer, peer.sensor() as sensor:
        before = len(peer.requests)
        peer.records = flagged(RECORD * 7)
        wait_for(lambda: START in peer.requests[before:])
        wait_for_more(sensor)
        sensor.collect(0.05)
        assert sensor.latest(timeout_s=0.5).status[0] == 0xC000
        assert peer.requests.count(START) == 2  # looked at once
        peer.records = RECORD * 7
        wait_for(lambda: sensor.latest(timeout_s=0.5).status[0] == 0x4000)  # it is over
        peer.answers[STATUS] = itertools.chain([read_reply(b"\x80\x80")])
        peer.once.append(RECORD_ERROR)  # and this is another one
        with pytest.raises(DeviceFault, match="EEPROM error"):
            sensor.collect(1.0)
    assert "CAN bus error" in caplog.text


def test_serial_watchdog_reset_during_a_stream_breaks_it() -> None:
    """Gains and offsets are volatile: what is measured afterwards is wrong."""
    status = [bytes.fromhex("0A030200001D85"), read_reply(b"\x80\x01")]
    with SerialPeer({STATUS: status}) as peer, peer.sensor() as sensor:
        peer.once.append(RECORD_ERROR)
        with pytest.raises(StreamBroken, match="has reset itself"):
            sensor.collect(1.0)


@pytest.mark.parametrize("records", [flagged(RECORD) * 7, (flagged(RECORD) + RECORD) * 4])
def test_serial_error_bits_that_the_status_never_confirms_end_the_stream(records: bytes) -> None:
    with SerialPeer() as peer, peer.sensor() as sensor:
        before = len(peer.requests)
        peer.records = records
        with pytest.raises(ProtocolError, match=r"error bit, but the status is 0x0000 \(ok\), 4 times in a row"):
            sensor.collect(5.0)
        assert peer.requests[before:].count(STATUS) == 4
    with SerialPeer() as peer:
        peer.records = flagged(RECORD) * 7
        with pytest.raises(ConnectError, match="error bit"):
            peer.sensor().open()


def test_serial_saturation_is_a_fault() -> None:
    with SerialPeer() as peer, peer.sensor() as sensor:
        peer.once.append(RECORD_SATURATED)
        with pytest.raises(DeviceFault, match="gauge G5 at the end"):
            sensor.collect(1.0)


def test_serial_critical_status_at_start_is_a_fault() -> None:
    with (
        SerialPeer({STATUS: [read_reply(b"\x80\x10")]}) as peer,
        pytest.raises(DeviceFault, match="power supply too high"),
    ):
        peer.sensor().open()


def test_serial_watchdog_bit_at_start_is_logged(caplog: pytest.LogCaptureFixture) -> None:
    with SerialPeer({STATUS: [bytes.fromhex("0A03020001DC45")]}) as peer, peer.sensor() as sensor:
        assert sensor.collect(0.05).status[0] == 1
    assert "watchdog reset" in caplog.text


def test_serial_damaged_and_missing_replies_are_asked_again() -> None:
    good = bytes.fromhex("0A6A01BEA2")
    with SerialPeer({"0A6AAAFF1D": [b"", good[:-1] + b"\0", good]}) as peer, peer.sensor():
        assert peer.requests.count("0A6AAAFF1D") == 3


def test_serial_lost_start_reply_is_recovered_by_a_jam() -> None:
    with SerialPeer({START: [b"", bytes.fromhex("0A4601A262")]}) as peer, peer.sensor() as sensor:
        sensor.collect(0.05)
        assert peer.requests[-3:] == [START, JAM, START]


@pytest.mark.parametrize(
    ("request_", "reply", "message"),
    [
        (START, "0A460063A2", "refused command 0x46 0x55"),
        ("0A6AAAFF1D", "0A6A00" + crc(bytes.fromhex("0A6A00")).hex(), "refused command 0x6A 0xAA"),
        (SERIAL_START_UP[2], "0A8302B133", "illegal register"),
        (STATUS, "", "no reply"),
    ],
)
def test_serial_refusals_end_the_start_up(request_: str, reply: str, message: str) -> None:
    with SerialPeer({request_: [bytes.fromhex(reply)]}) as peer, pytest.raises(ConnectError, match=message) as caught:
        peer.sensor().open()
    assert str(caught.value).startswith("ATI serial sensor on ")
    assert "; is it " in str(caught.value)  # what to do next


def test_serial_refusal_is_not_asked_again() -> None:
    with SerialPeer({START: [bytes.fromhex("0A460063A2")]}) as peer:
        with contextlib.suppress(ConnectError):
            peer.sensor().open()
        assert peer.requests.count(START) == 1


def test_serial_port_that_is_not_there() -> None:
    with pytest.raises(ConnectError, match="does not open"):
        AtiSerialSensor("/dev/does-not-exist").open()


def test_serial_port_is_ours_alone() -> None:
    with SerialPeer() as peer, peer.sensor(), pytest.raises(ConnectError, match="in use by another program"):
        peer.sensor().open()
