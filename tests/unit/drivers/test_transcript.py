"""A transcript as a file: what is written and in which order, what is refused, and what was broken off."""

import json
import math
from pathlib import Path
from typing import Any

import pytest

from ftdrivers import transcript
from ftdrivers.errors import BadTranscript
from ftdrivers.transcript import Transcript, Writer
from tests.fake_clock import FakeClock


def test_nothing_is_overwritten(tmp_path: Path) -> None:
    header = {"url": "x", "duration_s": 1}
    (tmp_path / "a.jsonl").write_text("mine")
    with pytest.raises(FileExistsError, match=r"a\.jsonl"):
        Writer(tmp_path / "a.jsonl", header)
    first = Writer(tmp_path / "b.jsonl", header)
    with pytest.raises(FileExistsError, match="partial"):
        Writer(tmp_path / "b.jsonl", header)
    (tmp_path / "b.jsonl").write_text("mine")
    with pytest.raises(FileExistsError, match="partial"):
        first.end()
    assert (tmp_path / "b.jsonl").read_text() == "mine"
    assert (tmp_path / "a.jsonl").read_text() == "mine"


def test_a_transcript_of_nothing_can_be_thrown_away(tmp_path: Path) -> None:
    writer = Writer(tmp_path / "a.jsonl", {"url": "x", "duration_s": 1})
    assert not writer.has_port
    writer.discard()
    writer.discard()
    assert list(tmp_path.iterdir()) == []


OPENED = '{"format": "ftdrive.transcript/1", "url": "x", "duration_s": 1}\n{"t_ns": 1, "event": "open"}\n'
END = {
    "identity": {"model": "A", "serial": "1"},
    "samples": 5,
    "mean_force_N": [1, 2, 3],
    "mean_torque_Nm": [0.1, 0.2, 0.3],
}

WRONG_ENDS: tuple[dict[str, Any], ...] = (
    {"identity": "bota"},
    {"mean_force_N": [1, 2]},
    {"mean_torque_Nm": [1, 2, math.nan]},
)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "empty"),
        ('{"format": "ftdrive.transcript/2"}', "first line"),
        ('{"format": "ftdrive.transcript/1"}', "url or duration_s is missing"),
        (OPENED.replace('"event": "open"', '"event": "note"'), "the driver opened no port"),
        ('{"format": "ftdrive.transcript/1", "url": "x", "duration_s": 1}', "no port"),
        (
            '{"format": "ftdrive.transcript/1", "url": "x", "duration_s": 1}\n{"t_ns": 1, "dir": "rx", "hex": "0"}',
            "line 2",
        ),
        ('{"format": "ftdrive.transcript/1", "url": "x", "duration_s": 1}\n{"t_ns"', "line 2"),
        ('{"format": "ftdrive.transcript/1", "url": "x", "duration_s": 1}\n{"t_ns": 1e999, "event": "open"}', "line 2"),
        ("[" * 100_000, "line 1|line 0"),
        *(
            (OPENED.replace('"duration_s": 1', f'"duration_s": {duration_s}'), "line 1")
            for duration_s in ("0", "NaN", "1" + "0" * 400)
        ),
        ('{"format": "ftdrive.transcript/1", "url": "bota://[x", "duration_s": 1}', r"line 1: .*bota://\[x: Invalid"),
        (OPENED + f'{{"t_ns": 1{"0" * 400}, "dir": "rx", "hex": "00"}}', "line 3"),
        *(
            (OPENED + json.dumps({"t_ns": 9, "event": "end", "error": None} | END | wrong), "line 3")
            for wrong in WRONG_ENDS
        ),
    ],
)
def test_what_is_no_transcript_is_refused(tmp_path: Path, text: str, says: str) -> None:
    (tmp_path / "bad.jsonl").write_text(text)
    with pytest.raises(BadTranscript, match=says):
        Transcript.load(tmp_path / "bad.jsonl")


def test_a_line_without_an_end_is_refused_before_it_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.jsonl"
    path.write_bytes(OPENED.encode() + bytes(1000))
    monkeypatch.setattr(transcript, "_LONGEST_LINE", 500)
    with pytest.raises(BadTranscript, match=rf"^{path}, line 3: .* \(it is longer than 0 MB\); record it again"):
        Transcript.load(path)


@pytest.mark.parametrize(
    ("end", "is_broken_off"),
    [({}, True), ({"error": "interrupted"}, True), ({"error": None}, False), ({"error": "x"}, False)],
)
def test_a_recording_without_its_end_is_broken_off(end: dict[str, Any], is_broken_off: bool) -> None:
    assert Transcript({}, 0, (), end).is_broken_off == is_broken_off


def test_reads_within_two_milliseconds_are_one_line_with_the_time_of_the_first(tmp_path: Path) -> None:
    clock = FakeClock()
    begin_ns = clock.now_ns()
    writer = Writer(tmp_path / "a.jsonl", {"url": "bota:///dev/ttyX", "duration_s": 1}, clock)
    for step_s, data in ((0.01, b"\x01"), (0.0019, b"\x02"), (0.0002, b"\x03"), (0.0, b"")):
        clock.advance(step_s)
        writer.received(data)
    clock.advance(0.001)
    assert not writer.has_port
    writer.event("open", port="/dev/ttyX", parity_marks=True)
    assert writer.has_port
    writer.sent(b"\x10")
    writer.event("open", port="/dev/ttyX", parity_marks=False)  # opened again
    writer.end(error=None, **END)
    made = Transcript.load(tmp_path / "a.jsonl")
    assert [(one.t_ns - begin_ns, one.sent, one.data) for one in made.passages] == [
        (10_000_000, False, b"\x01\x02"),
        (12_100_000, False, b"\x03"),
        (13_100_000, True, b"\x10"),
    ]
    assert (made.opened_ns - begin_ns, made.parity_marks, made.frames) == (13_100_000, True, False)
    assert made.end["samples"] == END["samples"]


@pytest.mark.parametrize(
    ("url", "frames", "at"),
    [
        ("bota:///dev/ttyUSB0", False, "bota:///dev/pts/3"),
        (
            "ati-can://can0?bitrate=500000&base=0x7F",
            True,
            "ati-can:///dev/pts/3?bitrate=500000&base=0x7F&interface=slcan",
        ),
        ("ati-can://can0?interface=slcan", False, "ati-can:///dev/pts/3?interface=slcan"),
    ],
)
def test_the_address_of_a_player(url: str, frames: bool, at: str) -> None:
    assert Transcript({"url": url}, 0, (), {}, frames=frames).url_at("/dev/pts/3") == at


def test_a_folder_that_is_not_there_is_said_to_be_the_fault(tmp_path: Path) -> None:
    path = tmp_path / "nope" / "a.jsonl"
    with pytest.raises(OSError, match=f"^{path} cannot be written .No such file"):
        Writer(path, {"url": "x", "duration_s": 1})
