"""The bytes of the ATI serial driver as a table: golden start-up and goodbye, awkward answers, and a damaged stream."""

import struct
from collections.abc import Iterable, Sequence
from itertools import repeat
from typing import Any

import numpy as np
import pytest

from ftdrivers.ati.serial import AtiSerialSensor
from ftdrivers.clock import Clock
from ftdrivers.errors import ConnectError, DeviceError, DeviceFault, ProtocolError, StreamBroken
from tests.unit.drivers.dialogue import Stream, Table
from tests.unit.drivers.in_one_thread import InOneThread

COUNTS = [100, -200, 300, -400, 500, -600]
WRENCH = [-0.85, 1.476, 6.84, 0.044, -0.0762, 0.1608]


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


RECORD = bytes.fromhex("0064012C01F4FF38FE70FDA850")
RECORD_BAD = RECORD[:12] + b"\x51"
RECORD_ERROR = RECORD[:12] + b"\xd0"
RECORD_SATURATED = bytes.fromhex("0064012C01F4FF38FE707FFF") + bytes(
    [0x64 + 1 + 0x2C + 1 + 0xF4 + 0xFF + 0x38 + 0xFE + 0x70 + 0x7F + 0xFF & 0x7F]
)
BATCH = RECORD * 7
"""A millisecond of stream."""

JAM = b"\xaa" * 14
STATUS = bytes.fromhex("0A03001D00011577")
FINE = bytes.fromhex("0A030200001D85")
START, STARTED = bytes.fromhex("0A4655A39D"), bytes.fromhex("0A4601A262")
UNLOCK, LOCK, DONE = bytes.fromhex("0A6AAAFF1D"), bytes.fromhex("0A6A187F68"), bytes.fromhex("0A6A01BEA2")
READS = [bytes.fromhex(text) for text in ("0A0300E30040B4B7", "0A0301230040B577", "0A0301630029748D")]
ACTIVE = bytes.fromhex("0A030000000C44B4")
"""Reads the active gains and offsets."""
BYE = (JAM, b"")
Turn = tuple[bytes, Any]


def start_up(block: bytes | None = None, status: bytes = FINE, *then: Turn, stream: Any = BATCH) -> list[Turn]:
    """The whole dialogue; `then` follows the start of the stream, and the goodbye comes last."""
    block = block or calibration_block()
    return [
        (JAM, b""),
        (STATUS, status),
        *zip(READS, (read_reply(block[:128]), read_reply(block[128:256]), read_reply(block[256:])), strict=True),
        (ACTIVE, read_reply(bytes(24))),
        (UNLOCK, DONE),
        (bytes.fromhex("0A10000000060C021F022B0239024302350237472D"), bytes.fromhex("0A10000000064170")),
        (bytes.fromhex("0A10000600060C" + "8000" * 6 + "7566"), bytes.fromhex("0A1000060006A171")),
        (LOCK, DONE),
        started(stream),
        *then,
        BYE,
    ]


def started(stream: Any = BATCH) -> Turn:
    return START, stream if isinstance(stream, Stream) else Stream.of(stream, reply=STARTED)


def changed(turns: Sequence[Turn], request: bytes, *answers: Any) -> list[Turn]:
    """The same, but this request is sent once for each answer."""
    at = [sent for sent, _ in turns].index(request)
    return [*turns[:at], *((request, answer) for answer in answers), *turns[at + 1 :]]


class Sensor(InOneThread, AtiSerialSensor):
    def __init__(self, clock: Clock) -> None:
        super().__init__("/dev/ttyUSB0", clock=clock)


def flagged(records: bytes) -> bytes:
    """Set the error bit of every record."""
    return bytes(byte | 0x80 if at % 13 == 12 else byte for at, byte in enumerate(records))


def marked(data: bytes, *damaged: int) -> bytes:
    """What the system makes of bytes that were received, `damaged` ones with wrong parity."""
    doubled = [b"\xff\xff" if byte == 0xFF else bytes([byte]) for byte in data]
    return b"".join(b"\xff\x00" + data[i : i + 1] if i in damaged else one for i, one in enumerate(doubled))


def test_gains_that_are_active_already_are_not_written(table: Table) -> None:
    """Programs written for real sensors stream without writing them."""
    block = calibration_block()
    turns = changed(start_up(), ACTIVE, read_reply(block[242:266]))
    kept = [turn for turn in turns if turn[0] not in {UNLOCK, LOCK} and turn[0][1] != 0x10]
    with table.serial(kept) as wire, Sensor(wire.clock) as sensor:
        np.testing.assert_allclose(sensor.collect(0.05).wrench[0], WRENCH)
    assert len(kept) == len(turns) - 4


def test_start_up_and_goodbye_are_golden(table: Table) -> None:
    with table.serial(start_up()) as wire, Sensor(wire.clock) as sensor:
        samples, info = sensor.collect(0.1), sensor.identify()
    assert (info.model, info.serial) == ("ATI Digital F/T SI-130-10", "FT54321")
    assert samples.wrench.mean(axis=0).tolist() == pytest.approx(WRENCH)
    assert (samples.counts == COUNTS).all()
    assert (np.diff(samples.seq) == 1).all()
    assert len(samples) == pytest.approx(700, abs=35)


def test_records_with_a_byte_of_wrong_parity_are_dropped_although_their_sum_holds(table: Table) -> None:
    turns = [(sent, marked(got) if isinstance(got, bytes) else got) for sent, got in start_up(stream=marked(BATCH))]
    with table.serial(turns, marks=True) as wire, Sensor(wire.clock) as sensor:
        for at in range(13):  # bit 7 of one byte, also the error bit
            record = RECORD[:at] + bytes([RECORD[at] ^ 0x80]) + RECORD[at + 1 :]
            wire.once.append(marked(RECORD * 3 + record, 39 + at))
        wire.once.append(BATCH_MARKED)
        samples = sensor.collect(0.05)
        assert (sensor.health().malformed, sensor.health().lost) == (13, 13)
        assert (samples.counts == COUNTS).all()
        wire.once.append(marked(RECORD * 5, *range(65)))  # an adapter that blames a whole packet: no slip
        assert (np.diff(sensor.collect(0.05).seq) - 1).sum() == 5


BATCH_MARKED = marked(BATCH)


def test_stream_that_never_makes_sense_ends(table: Table) -> None:
    again = [(JAM, b""), (STATUS, FINE), started(RECORD_BAD)] * 3
    wire = table.serial(start_up(None, FINE, *again, stream=RECORD_BAD))
    with wire, pytest.raises(ConnectError, match="3 restarts"):
        Sensor(wire.clock).open()


@pytest.mark.parametrize(
    ("status", "error", "says"),
    [
        (b"\x80\x80", DeviceFault, r"0x8080 \(bit 7: EEPROM error, bit 15: any error\)"),
        (b"\x80\x01", StreamBroken, "reset itself"),  # gains and offsets are volatile
    ],
)
def test_error_bit_ends_the_stream_with_the_status_in_words(
    table: Table, status: bytes, error: type[DeviceError], says: str
) -> None:
    look = [(JAM, b""), (STATUS, read_reply(status))]
    with table.serial(start_up(None, FINE, *look)) as wire, Sensor(wire.clock) as sensor:
        wire.once.append(RECORD_ERROR)
        with pytest.raises(error, match=says):
            sensor.collect(1.0)


@pytest.mark.parametrize("status", [0x8000, 0xC000, 0x8100, 0x8001])
def test_error_bit_that_nothing_critical_explains_is_no_damage(
    table: Table, status: int, caplog: pytest.LogCaptureFixture
) -> None:
    """Such as of a NETCANOEM whose CAN side is not connected."""
    status_reply = read_reply(status.to_bytes(2, "big"))
    with table.serial(start_up(None, status_reply, stream=flagged(BATCH))) as wire, Sensor(wire.clock) as sensor:
        samples = sensor.collect(0.1)
        assert (samples.status == status).all()
        assert (samples.counts == COUNTS).all()
        assert sensor.health().lost == sensor.health().malformed == 0
    assert len([record for record in caplog.records if record.levelname == "WARNING"]) == 1


def test_error_bit_that_comes_later_may_be_harmless_and_the_next_one_not(table: Table) -> None:
    def records() -> Iterable[bytes]:
        yield from [flagged(BATCH)] * 20
        yield from [BATCH] * 20  # it is over
        yield flagged(RECORD)  # and this is another one
        yield from repeat(BATCH)

    harmless = [(JAM, b""), (STATUS, read_reply(b"\xc0\0")), started(Stream(records(), reply=STARTED))]
    critical = [(JAM, b""), (STATUS, read_reply(b"\x80\x80"))]
    with table.serial(start_up(None, FINE, *harmless, *critical)) as wire, Sensor(wire.clock) as sensor:
        wire.clock.at(0.02, lambda: wire.once.append(RECORD_ERROR))
        seen: list[int] = []
        with pytest.raises(DeviceFault, match="EEPROM error"):  # noqa: PT012
            while True:
                seen.append(int(sensor.latest(timeout_s=0.1).status[0]))
                wire.clock.advance(0.005)
    assert list(dict.fromkeys(seen)) == [0, 0xC000, 0x4000]


@pytest.mark.parametrize("records", [flagged(RECORD) * 7, (flagged(RECORD) + RECORD) * 4])
def test_error_bits_that_the_status_never_confirms_end_the_stream(table: Table, records: bytes) -> None:
    looks = [(JAM, b""), (STATUS, FINE), started(records)]
    turns = start_up(None, FINE, *looks * 3, *looks[:2], stream=records)
    wire = table.serial(turns)
    with wire, pytest.raises((ConnectError, ProtocolError), match="error bit"), Sensor(wire.clock) as sensor:
        sensor.collect(5.0)


def test_saturation_is_a_fault(table: Table) -> None:
    with table.serial(start_up()) as wire, Sensor(wire.clock) as sensor:
        wire.once.append(RECORD_SATURATED)
        with pytest.raises(DeviceFault, match="gauge G5"):
            sensor.collect(1.0)


def test_critical_status_at_start_is_a_fault(table: Table) -> None:
    wire = table.serial([(JAM, b""), (STATUS, read_reply(b"\x80\x10")), BYE])
    with wire, pytest.raises(DeviceFault, match="power supply too high"):
        Sensor(wire.clock).open()


def test_damaged_and_missing_replies_are_asked_again(table: Table) -> None:
    with table.serial(changed(start_up(), UNLOCK, b"", DONE[:-1] + b"\0", DONE)) as wire, Sensor(wire.clock):
        pass


@pytest.mark.parametrize(
    ("request_", "reply", "message"),
    [
        (START, "0A460063A2", "command 0x46 0x55"),
        (UNLOCK, "0A6A00" + crc(bytes.fromhex("0A6A00")).hex(), "command 0x6A 0xAA"),
        (READS[0], "0A8302B133", "illegal register"),
    ],
)
def test_refusals_end_the_start_up_at_once(table: Table, request_: bytes, reply: str, message: str) -> None:
    turns = start_up()
    at = [sent for sent, _ in turns].index(request_)
    wire = table.serial([*turns[:at], (request_, bytes.fromhex(reply)), BYE])
    with wire, pytest.raises(ConnectError, match=rf"^ATI serial sensor on .*{message}") as caught:
        Sensor(wire.clock).open()
    assert "address" in caught.value.fix


def test_a_missing_device_is_known_within_a_second(table: Table) -> None:
    with table.serial([*[(JAM, b""), (STATUS, b"")] * 3, BYE]) as wire:
        start_s = wire.clock.now_s()
        with pytest.raises(ConnectError, match="no reply"):
            Sensor(wire.clock).open()
        assert wire.clock.now_s() - start_s < 0.5
