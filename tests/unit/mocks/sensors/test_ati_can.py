"""The CAN emulator without a wire: payloads and the adapter's lines."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ftmocks.sensors.ati_can import AtiCanNode, matrix_row_payloads, sg_payloads
from ftmocks.sensors.ati_gauges import REFERENCE
from ftmocks.wires.slcan import CanFrame, SlcanAdapter


@pytest.mark.parametrize(
    ("status", "gauges", "first", "second"),
    [
        (0x0000, [100, -200, 300, -400, 500, -600], "0000 0064 012C 01F4", "FF38 FE70 FDA8"),
        (0x0000, [221, -926, 69, -1086, 2342, 1266], "0000 00DD 0045 0926", "FC62 FBC2 04F2"),
        (0x4000, [18, 1274, -454, -1389, -6488, 323], "4000 0012 FE3A E6A8", "04FA FA93 0143"),
    ],
)
def test_sg_payloads(status: int, gauges: list[int], first: str, second: str) -> None:
    assert sg_payloads(status, np.array(gauges, dtype=np.int16)) == [bytes.fromhex(first), bytes.fromhex(second)]


def test_matrix_rows() -> None:
    rows = [b"".join(matrix_row_payloads(row)).hex(" ", 4).upper() for row in REFERENCE.matrix]
    assert rows == [
        "00000000 00000000 00000000 C584D000 00000000 4584D000",
        "00000000 4599C000 00000000 C519C000 00000000 C519C000",
        "45ED8000 00000000 45ED8000 00000000 45ED8000 00000000",
        "00000000 00000000 C35C0000 00000000 435C0000 00000000",
        "437E0000 00000000 C2FE0000 00000000 C2FE0000 00000000",
        "00000000 C3060000 00000000 C3060000 00000000 C3060000",
    ]


WRENCH = [-0.85, 1.476, 6.84, 0.044, -0.0762, 0.1608]
READING = ["200#0000 0064 012C 01F4", "201#FF38 FE70 FDA8"]
FIRMWARE = "20F#0308 0002"


@pytest.mark.parametrize(
    ("options", "requests", "answers"),
    [
        ({}, ["200#00", "207#00"], [*READING, "207#000F 4240 000F 4240"]),
        ({}, ["205#", "209#02", "20D#21", "20E#03"], ["205#4654 3132 3334 3500", "209#0A3C", "20D#", "20E#"]),
        ({}, ["210#", "201#00", "203#", "204#", "20B#", "20D#", "20E#", "202#FF", "209#06", "20F#"], [FIRMWARE]),
        ({}, ["206#0F", "200#"], ["206#0F", "200#8040 0064 012C 01F4", READING[1]]),
        ({}, ["206#0F", "202#02"], ["206#0F", *(f"{i}#0000 0000 0000 0000" for i in (202, 203, 204))]),
        ({"wrong_echo": 7}, ["206#00"], ["206#07"]),
        ({"firmware": (3, 8, 0)}, ["207#", "208#", "209#00"], ["207#000F 4240 000F 4240", "208#0203", "209#07FF"]),
        ({"firmware": (3, 6, 9)}, ["207#", "208#", "209#00"], []),
    ],
)
def test_answers(options: dict[str, Any], requests: list[str], answers: list[str]) -> None:
    node = AtiCanNode(lambda n: np.tile(WRENCH, (n, 1)), boot_s=0.0, **options)
    frames = [
        node.answer(CanFrame(int(head, 16), bytes.fromhex(tail))) for head, tail in (r.split("#") for r in requests)
    ]
    assert [f"{one.identifier:03X}#{one.data.hex(' ', -2).upper()}" for some in frames for one in some] == answers


def opened_adapter() -> SlcanAdapter:
    adapter = SlcanAdapter()
    assert adapter.feed(b"S5\rO\r") == (b"\r\r", [])
    return adapter


def test_adapter_needs_a_bit_rate_and_an_open_channel() -> None:
    adapter = SlcanAdapter()
    assert adapter.feed(b"O\rt2000\rC\rF\r") == (b"\a\a\a\a", [])
    assert adapter.feed(b"\rS5\rO\rO\rS6\r") == (b"\r\r\r\a\a", [])
    assert adapter.bitrate == 250_000
    assert adapter.feed(b"V\rN\r") == (b"V1013\rNEMUL\r", [])


@given(
    st.booleans().flatmap(
        lambda extended: st.builds(
            CanFrame,
            st.integers(0, 0x1FFFFFFF if extended else 0x7FF),
            st.binary(max_size=8),
            st.just(extended),
            st.just(False),
        )
    )
)
def test_a_reported_line_reads_back_as_the_same_frame(frame: CanFrame) -> None:
    adapter = opened_adapter()
    assert adapter.feed(adapter.line(frame)) == ((b"Z\r" if frame.extended else b"z\r"), [frame])
