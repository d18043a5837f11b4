"""The parity of the emulated ATI Digital F/T, met by a bare client that asks for marks by termios, or does not."""

import re
import termios
from collections.abc import Iterator

import numpy as np
import pytest
import serial
from numpy.typing import NDArray

from ftmocks.sensors import ati_serial
from ftmocks.sensors.ati_serial import AtiSerialBox
from ftmocks.sensors.robotiq import RobotiqBox
from tests.wire.waiting import LIMIT_S, drain, read_to, wait_until

READ_STATUS = bytes.fromhex("0A 03 00 1D 00 01 15 77")
STATUS_OK = bytes.fromhex("0A 03 02 00 00 1D 85")
START, STARTED = bytes.fromhex("0A 46 55 A3 9D"), bytes.fromhex("0A 46 01 A2 62")
JAM = bytes(range(1, 15))
MINUS_ONE = b"\xff" * 12 + b"\x74"
TWICE = b"\xff" * 24 + b"\x74"
SINGLE = re.compile(rb"[^\xff]|\xff\xff|\xff\x00.", re.DOTALL)
WHOLE = re.compile(b"(?:%s)*" % SINGLE.pattern, re.DOTALL)


def flags(port: serial.Serial) -> int:
    return int(termios.tcgetattr(port.fileno())[0]) & (termios.INPCK | termios.PARMRK | termios.IGNPAR)


def ask_for_marks(port: serial.Serial, more: int = 0) -> None:
    """Set INPCK, PARMRK and more."""
    attributes = termios.tcgetattr(port.fileno())
    attributes[0] |= termios.INPCK | termios.PARMRK | more
    termios.tcsetattr(port.fileno(), termios.TCSANOW, attributes)


def ask(port: serial.Serial, request: bytes, reply_bytes: int) -> bytes:
    port.write(request)
    return port.read(reply_bytes)


def jam(box: AtiSerialBox, port: serial.Serial) -> None:
    """Stop the stream, wait for the pause after it, and throw away what was on its way."""
    faults, box.faults.corrupt = box.faults.corrupt, 0.0
    port.write(JAM)
    wait_until(lambda: not box.streaming and not box._burst)
    drain(port)
    port.write(READ_STATUS)
    read_to(port, STATUS_OK)
    box.faults.corrupt = faults


def unmarked(port: serial.Serial, count: int) -> tuple[bytes, list[bool]]:
    """So many bytes as the sensor sent them, and which of them had wrong parity, of a client that reads marks."""
    rest = b""
    characters: list[bytes] = []
    while len(characters) < count:
        read = port.read(count - len(characters) if not rest else 1)
        assert read, "nothing came"
        whole = WHOLE.match(rest + read)
        assert whole
        characters += SINGLE.findall(whole[0])
        rest = (rest + read)[whole.end() :]
        assert rest in (b"", b"\xff", b"\xff\x00"), rest.hex()
    return bytes(character[-1] for character in characters), [len(character) == 3 for character in characters]


def unmarked_records(port: serial.Serial, count: int) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """(count, 13) bytes, and which of them had wrong parity."""
    data, bad = unmarked(port, 13 * count)
    return np.frombuffer(data, np.uint8).reshape(-1, 13), np.array(bad).reshape(-1, 13)


def sums_are_right(records: NDArray[np.uint8]) -> NDArray[np.bool_]:
    right: NDArray[np.bool_] = (records[:, :12].sum(axis=1) & 0x7F) == (records[:, 12] & 0x7F)
    return right


@pytest.fixture
def box() -> Iterator[AtiSerialBox]:
    """Every gauge says -1."""
    box = AtiSerialBox(lambda n: np.zeros((n, 6)), needs_gains=False, gauge_offset=-1)
    yield box
    box.stop()


@pytest.fixture
def path(box: AtiSerialBox) -> str:
    return box.start()


@pytest.fixture
def port(path: str) -> Iterator[serial.Serial]:
    with serial.Serial(path, 1_250_000, parity=serial.PARITY_EVEN, timeout=LIMIT_S) as port:
        yield port


def test_a_client_that_does_not_ask_reads_plain_bytes(box: AtiSerialBox, port: serial.Serial) -> None:
    assert ask(port, START, 5) == STARTED
    assert port.read(13 * 50) == MINUS_ONE * 50
    box.faults.corrupt = 1.0
    wait_until(lambda: port.read(13) != MINUS_ONE)
    records = np.frombuffer(port.read(13 * 50), np.uint8).reshape(50, 13)
    assert ((records != np.frombuffer(MINUS_ONE, np.uint8)).sum(axis=1) == 1).all(), "one byte each, none more or less"
    assert flags(port) == 0


def test_a_client_that_asks_reads_marks(box: AtiSerialBox, port: serial.Serial) -> None:
    ask_for_marks(port)
    assert ask(port, READ_STATUS, 7) == STATUS_OK
    assert flags(port) == termios.INPCK, "and not PARMRK: the kernel must not double it again"
    assert ask(port, START, 5) == STARTED
    assert port.read(25 * 50) == TWICE * 50
    jam(box, port)
    box.faults.corrupt = 1.0
    marks = 0
    for _ in range(40):
        port.write(READ_STATUS)
        reply, bad = unmarked(port, 7)
        flipped = [(a ^ b).bit_count() for a, b in zip(reply, STATUS_OK, strict=True)]
        assert bad == [count % 2 == 1 for count in flipped]
        marks += sum(bad)
    assert 10 < marks < 30


def test_a_wrong_byte_is_found_by_its_sum_or_by_its_mark(
    box: AtiSerialBox, port: serial.Serial, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[bytes] = []
    random = np.random.default_rng(5)

    def records_of_noise(gauges: NDArray[np.int16], *, error: bool) -> NDArray[np.uint8]:
        records = encode(random.integers(-3000, 3000, gauges.shape).astype(np.int16), error=error)
        made.extend(record.tobytes() for record in records)
        return records

    encode = ati_serial.stream_records
    monkeypatch.setattr(ati_serial, "stream_records", records_of_noise)
    ask_for_marks(port)
    assert ask(port, START, 5) == STARTED
    box.faults.corrupt = 0.5
    records, bad = unmarked_records(port, 7_000)
    jam(box, port)
    number = {record: i for i, record in enumerate(made)}
    right, is_marked = sums_are_right(records), bad.any(axis=1)
    accepted = [number[record.tobytes()] for record in records[right & ~is_marked]]
    assert accepted == sorted(set(accepted)), "each was made, none comes twice, and in this order"
    assert 0.45 < len(accepted) / len(records) < 0.55
    assert (bad.sum(axis=1) <= 1).all()
    assert 0.45 < is_marked.sum() / (len(records) - len(accepted)) < 0.55
    hidden = [record for record in records[right & is_marked] if record.tobytes() not in number]
    assert hidden, "the sum alone would have passed wrong records"


def test_opening_again_without_asking_brings_plain_bytes(box: AtiSerialBox, path: str) -> None:
    with serial.Serial(path, timeout=LIMIT_S) as port:
        ask_for_marks(port)
        assert ask(port, START, 5) == STARTED
        assert port.read(25 * 5) == TWICE * 5
        jam(box, port)
    with serial.Serial(path, timeout=LIMIT_S) as port:
        assert ask(port, START, 5) == STARTED
        assert port.read(13 * 50) == MINUS_ONE * 50
        assert flags(port) == 0


def test_a_line_without_parity_has_no_marks() -> None:
    """There the kernel does what it does on a real port: it doubles, and the sensor leaves the flags alone."""
    box = RobotiqBox(lambda n: np.zeros((n, 6)), streaming_at_start=True)
    box.faults.corrupt = 1.0
    try:
        with serial.Serial(box.start(), 19_200, timeout=LIMIT_S) as port:
            ask_for_marks(port)
            port.reset_input_buffer()
            assert re.fullmatch(rb"(?:[^\xff]|\xff\xff)*\xff?", port.read(500), re.DOTALL)
            assert flags(port) == termios.INPCK | termios.PARMRK
    finally:
        box.stop()
