"""Marks of bytes with wrong parity are undone whole, and a record with one damaged byte is never believed."""

import itertools
from collections.abc import Iterable

import numpy as np
from hypothesis import example, given, settings
from hypothesis import strategies as st

from ftdrivers.ati import modbus
from ftdrivers.wires.serial_port import Unmarker

RECORDS = [
    bytes.fromhex("00 64 01 2C 01 F4 FF 38 FE 70 FD A8 50"),
    bytes.fromhex("00 DD 00 45 09 26 FC 62 FB C2 04 F2 62"),
    b"\xff" * 12 + b"\x74",
    bytes(13),
]


def received(sent: bytes, arrived: bytes) -> bytes:
    """Mark as a port with even parity does, whose parity bits are those of `sent`."""
    marked = b""
    for one, other in zip(sent, arrived, strict=True):
        if (one.bit_count() + other.bit_count()) % 2:
            marked += b"\xff\x00" + bytes([other])
        else:
            marked += b"\xff\xff" if other == 0xFF else bytes([other])
    return marked


def undone(reads: Iterable[bytes]) -> tuple[bytes, list[int]]:
    """Undo one read after the other, as a driver does."""
    marks, true, damaged = Unmarker(), b"", list[int]()
    for data in reads:
        more, places = marks.undo(data)
        damaged += [len(true) + place for place in places]
        true += more
    return true, damaged


def cut(data: bytes, places: Iterable[int]) -> list[bytes]:
    edges = [0, *sorted(place % (len(data) + 1) for place in places), len(data)]
    return [data[start:end] for start, end in itertools.pairwise(edges)]


bytes_on_the_line = st.lists(st.tuples(st.sampled_from([0x00, 0xFF]) | st.integers(0, 255), st.booleans()), max_size=60)


@given(bytes_on_the_line, st.lists(st.integers(0, 200), max_size=20))
@example([(0xFF, True), (0x00, False), (0xFF, False), (0x00, True)], list(range(10)))
def test_whatever_is_marked_and_however_it_is_cut_comes_back(line: list[tuple[int, bool]], places: list[int]) -> None:
    true = bytes(byte for byte, _ in line)
    sent = bytes(byte ^ damaged for byte, damaged in line)  # its lowest bit flipped
    assert undone(cut(received(sent, true), places)) == (true, [at for at, (_, damaged) in enumerate(line) if damaged])


def test_a_cut_mark_is_forgotten_on_request() -> None:
    for beginning in (b"\xff", b"\xff\x00"):
        marks = Unmarker()
        assert marks.undo(b"1" + beginning) == (b"1", [])
        marks.forget()
        assert marks.undo(b"2") == (b"2", [])


def every_change(record: bytes) -> Iterable[bytes]:
    for place in range(13):
        for change in range(1, 256):
            yield record[:place] + bytes([record[place] ^ change]) + record[place + 1 :]


@settings(max_examples=5)
@given(st.sampled_from(RECORDS) | st.binary(min_size=12, max_size=12).map(lambda b: b + bytes([sum(b) & 0x7F])))
def test_no_single_damaged_byte_makes_a_record_that_is_believed(record: bytes) -> None:
    """Either its parity shows it, or the sum: of 13 x 255 changes only those of bit 7 pass the sum."""
    arrived = list(every_change(record))
    on_the_line = b"".join(received(record, other) for other in arrived)
    true, damaged = undone(on_the_line[at : at + 416] for at in range(0, len(on_the_line), 416))
    assert true == b"".join(arrived)
    assert np.flatnonzero(modbus.decode_records(true).intact).tolist() == [255 * place + 127 for place in range(13)]
    records = modbus.decode_records(true, damaged)
    assert not (records.intact & records.parity).any()
    undamaged = undone([received(record, record)])
    records = modbus.decode_records(*undamaged)
    assert (records.intact & records.parity).all()
