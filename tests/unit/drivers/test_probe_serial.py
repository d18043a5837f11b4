"""Which sensor is on a serial port in memory: how long it is listened to, what is requested, and what is enough."""

from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np
import pytest
import serial

from ftdrivers.probe import Answer, probe_serial
from ftdrivers.wires.framing import crc16_modbus
from tests.fake_clock import FakeClock

EVEN, NONE = serial.PARITY_EVEN, serial.PARITY_NONE
BOTA = bytes.fromhex("AA 0000 0000803F 000000C0 C3F51C41 CDCCCC3D CDCC4CBE 9A99993E 40420F00 0000CC41 3D0D")
ROBOTIQ = bytes.fromhex("20 4E D2 04 C9 FD 10 27 96 00 E7 FF E8 03 86 DC")
ROBOTOUS = bytes.fromhex("55 0B 01F4 FF06 03E8 07D0 FC18 0064 00 0000 3F AA")
ATI = bytes.fromhex("00 64 01 2C 01 F4 FF 38 FE 70 FD A8 50"), bytes.fromhex("00 DD 00 45 09 26 FC 62 FB C2 04 F2 62")

ROBOTIQ_SERIAL = bytes.fromhex("09 03 01FE 0004 254D")
ROBOTOUS_MODEL = bytes.fromhex("55 01 00000000000000 01 AA")
ATI_SERIAL = bytes.fromhex("0A 03 00E3 0014 B548")


def with_crc(body: bytes) -> bytes:
    return body + crc16_modbus(body).to_bytes(2, "little")


def robotous_reply(text: bytes, code: int = 1) -> bytes:
    answer = bytes([code]) + text.ljust(15, b"\0")
    return b"\x55" + answer + bytes([sum(answer) & 0xFF, 0xAA])


@dataclass
class Line:
    """Stands in for `serial.Serial`, with a device that has one setting of the port."""

    setting: tuple[int, str] = (0, "")
    heard: bytes = b""
    """Arrives 0.23 s after it is opened."""
    replies: dict[bytes, bytes] = field(default_factory=dict)
    sent: list[tuple[int, str, bytes]] = field(default_factory=list)
    clock: FakeClock = field(default_factory=FakeClock)

    def __call__(self, _path: str, baud: int, *, parity: str, timeout: float, **_: Any) -> Self:
        self.now, self.timeout, self.data = (baud, parity), timeout, b""
        self.arrive(self.heard)
        return self

    def arrive(self, data: bytes) -> None:
        def add() -> None:
            self.data += data

        if self.now == self.setting:
            self.clock.at(0.23, add)

    def write(self, data: bytes) -> None:
        self.sent.append((*self.now, data))
        self.arrive(self.replies.get(data, b""))

    def read(self, size: int) -> bytes:
        self.clock.advance(self.timeout)
        data, self.data = self.data[:size], self.data[size:]
        return data

    def set_low_latency_mode(self, _: bool) -> None: ...

    def close(self) -> None: ...


def probed(line: Line, monkeypatch: pytest.MonkeyPatch) -> Answer | None:
    monkeypatch.setattr("serial.Serial", line)
    monkeypatch.setattr("ftdrivers.wires.serial_port.ask_for_marks", lambda _: False)
    return probe_serial("/dev/ttyX", line.clock)


def test_a_silent_port_is_listened_to_and_then_asked_by_readings_only(monkeypatch: pytest.MonkeyPatch) -> None:
    line = Line()
    asked = [
        (19_200, NONE, ROBOTIQ_SERIAL),
        (115_200, NONE, ROBOTOUS_MODEL),
        (921_600, NONE, ROBOTOUS_MODEL),
        (1_250_000, EVEN, ATI_SERIAL),
    ]
    assert probed(line, monkeypatch) is None
    assert [one for one in line.sent if one[2] in (ROBOTIQ_SERIAL, ROBOTOUS_MODEL, ATI_SERIAL)] == asked
    # Two parts of 0.27 s for each sensor, one to listen and one to ask; at the end the boot text of a Bota.
    assert line.clock.now_s() - 1000 < 2 * 0.29 * (len(line.sent) + 2) + 2.7


@pytest.mark.parametrize(
    ("setting", "heard", "url"),
    [
        ((460_800, NONE), BOTA * 5, "bota:///dev/ttyX?baud=460800"),
        ((19_200, NONE), ROBOTIQ[5:] + ROBOTIQ * 5, "robotiq-ft300:///dev/ttyX"),
        ((115_200, NONE), ROBOTOUS * 5, "robotous-serial:///dev/ttyX"),
        ((1_250_000, EVEN), ATI[0][8:] + ATI[0] * 8 + ATI[1] * 12, "ati-serial:///dev/ttyX"),
        ((1_250_000, EVEN), bytes(range(256)) + ATI[1] * 100, "ati-serial:///dev/ttyX"),  # the last 100 count
        # too little, with another setting of the port, or damaged
        ((460_800, NONE), BOTA * 4, None),
        ((19_200, NONE), ROBOTIQ * 4 + ROBOTIQ[:-1], None),
        ((1_250_000, NONE), ATI[0] * 30, None),
        ((1_250_000, EVEN), ATI[0] * 20 + ATI[0][:-1] + ATI[0] * 15, None),
        ((1_250_000, EVEN), bytes(13 * 50), None),
        ((1_250_000, EVEN), np.random.default_rng(0).bytes(4000), None),
    ],
    ids=range(11),
)
def test_a_stream_is_known_by_enough_whole_frames(
    setting: tuple[int, str], heard: bytes, url: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    line = Line(setting, heard)
    assert probed(line, monkeypatch) == (None if url is None else Answer(url, "it streams"))
    assert bool(line.sent) == (url is None)  # a sensor that streams is not asked


@pytest.mark.parametrize(("code", "baud"), [(3, 230_400), (7, None)])
def test_a_bota_that_restarts_prints_its_baud_rate(
    code: int, baud: int | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    line = Line((230_400, NONE), b"\x00c,0,1,0,%d\r\n" % code)
    assert probed(line, monkeypatch) == (None if baud is None else Answer(f"bota:///dev/ttyX?baud={baud}", "it boots"))


@pytest.mark.parametrize(
    ("setting", "request_", "reply", "found"),
    [
        (
            (19_200, NONE),
            ROBOTIQ_SERIAL,
            with_crc(bytes.fromhex("09 03 08 4654 5300 04D2 0000")) + b"more",
            Answer("robotiq-ft300:///dev/ttyX", "Robotiq FT 300, serial FTS-1234"),
        ),
        (
            (921_600, NONE),
            ROBOTOUS_MODEL,
            robotous_reply(b"V1", 3) + robotous_reply(b"RFT60-HA01"),
            Answer("robotous-serial:///dev/ttyX?baud=921600", "Robotous RFT60-HA01"),
        ),
        (
            (1_250_000, EVEN),
            ATI_SERIAL,
            with_crc(b"\x0a\x03\x28" + b"FT12345\0" + b"SI-130-10".ljust(32, b"\0")) + b"more",
            Answer("ati-serial:///dev/ttyX", "ATI Digital F/T SI-130-10, serial FT12345"),
        ),
        ((19_200, NONE), ROBOTIQ_SERIAL, b"\x09\x03\x08damaged", None),
        ((115_200, NONE), ROBOTOUS_MODEL, robotous_reply(b"V1", 3), None),
        ((1_250_000, EVEN), ATI_SERIAL, ATI_SERIAL, None),  # an echo
    ],
    ids=["Robotiq", "Robotous", "ATI", "damaged", "to another command", "echo"],
)
def test_a_sensor_that_answers_is_named(
    setting: tuple[int, str], request_: bytes, reply: bytes, found: Answer | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    line = Line(setting, replies={request_: reply})
    assert probed(line, monkeypatch) == found
    if found is not None:
        assert line.sent[-1][2] == request_  # no other sensor is asked afterwards
