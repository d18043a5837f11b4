"""The bytes on the wire of a sensor, kept in a file: `transcript_taps.py` writes it, `transcript_player.py` plays it.

A transcript (``ftdrive.transcript/1``) is JSON lines. The first says which sensor, when and with which versions; then
come, with the time of the driver's clock as `t_ns`:

{"t_ns", "event": "open", "port", "baudrate", "bytesize", "parity", "stopbits", "parity_marks"}   a serial port
{"t_ns", "event": "open", "port", "frames": true}                                                 a CAN interface
{"t_ns", "event": "open", "port", "datagrams": true}                                              UDP
{"t_ns", "event": "unreachable", "error"}   why a datagram did not get through, which the driver does not see
{"t_ns", "event": "page", "request", "reply", "took_s", "error"}   one question over HTTP, headers and all, in hex
{"t_ns", "dir": "tx", "hex"}    one write of the driver
{"t_ns", "dir": "rx", "hex"}    one datagram, or what the driver read within 2 ms, stamped with its first byte
{"t_ns", "event": "end", "error"}   the error it ended with; where there was none, what the driver made of it:
                                    "identity", "samples", "mean_force_N", "mean_torque_Nm" and more

Where `parity_marks` is true, the bytes that were read hold the marks of `drivers/wires/parity.py`; older transcripts
do not say it and hold none. Some CAN adapters, such as those of slcan, are on a serial port too. The frames of any
other CAN interface are written as the lines that an slcan adapter would carry, and such an adapter plays them; what
python-can tells it is not compared.
"""

import json
import math
import os
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Final, Self
from urllib.parse import parse_qsl, urlencode

from drivers.clock import REAL, Clock
from drivers.registry import split_url

FORMAT: Final = "ftdrive.transcript/1"

_TOGETHER_NS: Final = 2_000_000
INTERRUPTED: Final = "interrupted"
"""The error of a recording that was broken off by the user."""
_LONGEST_PAGE_S: Final = 60.0
"""Longer than any driver waits for a page."""


class BadTranscript(Exception):
    """The file is not a transcript, or a damaged one."""


class Writer:
    """A transcript being written to `path` with ``.partial`` behind it, and renamed by `end`.

    Parameters
    ----------
    path : Path
        Must not exist.
    header : mapping
        Goes into the first line.
    clock : Clock
        The driver's.

    Raises
    ------
    OSError
        The file, or one of an unfinished recording, exists already, or cannot be written.
    """

    def __init__(self, path: Path, header: Mapping[str, Any], clock: Clock = REAL) -> None:
        self.has_port = False
        """Whether a port of any kind was opened: without one there is nothing to play."""
        self.clock = clock
        self._path = path
        self._partial = path.parent / (path.name + ".partial")
        for existing in (path, self._partial):
            if existing.exists():
                raise FileExistsError(f"{existing} exists already and is not overwritten: give another name")
        self._lock = threading.Lock()
        self._received = bytearray()
        self._received_ns = 0
        try:
            self._file: IO[str] | None = self._partial.open("x", encoding="utf-8")
        except OSError as error:
            fix = "give a file in a folder that exists and is yours"
            raise OSError(f"{path} cannot be written ({error.strerror}): {fix}") from error
        self._line({"format": FORMAT, **header})

    def event(self, name: str, **content: Any) -> None:
        """Note something that is not bytes."""
        with self._lock:
            self._flush_received()
            self.has_port |= name == "open"
            self._line({"t_ns": self.clock.now_ns(), "event": name, **content})

    def sent(self, data: bytes) -> None:
        """Note one write of the driver."""
        with self._lock:
            self._flush_received()
            self._line({"t_ns": self.clock.now_ns(), "dir": "tx", "hex": data.hex()})

    def received(self, data: bytes) -> None:
        """Note what the driver was given; reads that follow each other closely become one line."""
        if not data:
            return
        now_ns = self.clock.now_ns()
        with self._lock:
            if self._received and now_ns - self._received_ns > _TOGETHER_NS:
                self._flush_received()
            if not self._received:
                self._received_ns = now_ns
            self._received += data

    def received_datagram(self, data: bytes) -> None:
        """Note one datagram for the driver, which stays one."""
        with self._lock:
            self._flush_received()
            self._line({"t_ns": self.clock.now_ns(), "dir": "rx", "hex": data.hex()})

    def end(self, **content: Any) -> None:
        """Write the last line, and give the file its name."""
        self.event("end", **content)
        with self._lock:
            file, self._file = self._file, None
        if file is None:
            return
        with file:
            file.flush()
            os.fsync(file.fileno())
        if self._path.exists():
            raise FileExistsError(f"{self._path} appeared meanwhile; the transcript is kept in {self._partial}")
        self._partial.rename(self._path)

    def discard(self) -> None:
        """Leave no file."""
        with self._lock:
            file, self._file = self._file, None
        if file is not None:
            file.close()
            self._partial.unlink()

    def _flush_received(self) -> None:
        if self._received:
            self._line({"t_ns": self._received_ns, "dir": "rx", "hex": self._received.hex()})
            self._received.clear()

    def _line(self, content: Mapping[str, Any]) -> None:
        if self._file is not None:
            self._file.write(json.dumps(content, ensure_ascii=False) + "\n")


@dataclass(frozen=True, slots=True)
class Passage:
    """Bytes that went one way."""

    t_ns: int
    sent: bool
    """By the driver."""
    data: bytes


@dataclass(frozen=True, slots=True)
class Page:
    """A question over HTTP and its answer, as they were on the wire."""

    request: bytes
    reply: bytes
    """Empty where none came."""
    took_s: float


def asked_for(request: bytes) -> bytes:
    """Take method and path from a request over HTTP: two clients that ask for one page differ in the rest."""
    return b" ".join(request.split(b"\r\n", 1)[0].split(b" ")[:2])


@dataclass(frozen=True, slots=True)
class Transcript:
    """A transcript read from a file."""

    header: Mapping[str, Any]
    opened_ns: int
    """When the driver had opened its port."""
    passages: tuple[Passage, ...]
    end: Mapping[str, Any]
    """What the driver made of it; empty if the recording was broken off."""
    parity_marks: bool = False
    """Whether what was received holds marks of bytes with wrong parity."""
    frames: bool = False
    """Whether these are frames of a CAN interface, as lines of slcan."""
    datagrams: bool = False
    """Whether each passage is a datagram."""
    pages: tuple[Page, ...] = ()

    @property
    def is_broken_off(self) -> bool:
        """Whether the recording was interrupted, or the file has lost its end."""
        return bool(self.end.get("error", INTERRUPTED) == INTERRUPTED)

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read a file. Raises `BadTranscript`, or `OSError` when it cannot be read."""
        header: Mapping[str, Any] = {}
        opened_ns: int | None = None
        parity_marks = frames = datagrams = False
        passages: list[Passage] = []
        pages: list[Page] = []
        end: Mapping[str, Any] = {}
        number = 0
        try:
            with path.open(encoding="utf-8") as file:
                for number, text in enumerate(file, start=1):
                    line = json.loads(text)
                    if number == 1:
                        header = _checked_header(path, line)
                    elif "dir" in line:
                        passages.append(Passage(_time_ns(line), line["dir"] == "tx", bytes.fromhex(line["hex"])))
                    elif line.get("event") == "open" and opened_ns is None:
                        opened_ns, parity_marks = _time_ns(line), line.get("parity_marks") is True
                        frames, datagrams = line.get("frames") is True, line.get("datagrams") is True
                    elif line.get("event") == "page":
                        pages.append(_checked_page(line))
                    elif line.get("event") == "end":
                        end = _checked_end(line)
        except (ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError) as error:
            raise BadTranscript(
                f"{path}, line {number}: not a line of a transcript ({error}): record it anew"
            ) from error
        if not header:
            raise BadTranscript(f"{path} is empty: record it anew")
        if opened_ns is None:
            raise BadTranscript(f"{path}: no port was opened in it, there is nothing to play: {end.get('error')}")
        return cls(header, opened_ns, tuple(passages), end, parity_marks, frames, datagrams, tuple(pages))

    def url_at(self, port: str) -> str:
        """Give the sensor's address with the port of a player in it, and with the options which that brings along."""
        parts = split_url(str(self.header["url"]))
        place, _, own = port.partition("?")
        options = dict(parse_qsl(parts.query)) | dict(parse_qsl(own)) | ({"interface": "slcan"} if self.frames else {})
        return f"{parts.scheme}://{place}" + (f"?{urlencode(options)}" if options else "")


def _checked_header(path: Path, line: Any) -> Mapping[str, Any]:
    found = line.get("format") if isinstance(line, dict) else None
    if found != FORMAT:
        raise BadTranscript(f"{path}: the first line must say {FORMAT}, found {found!r}")
    if not isinstance(line.get("url"), str) or not isinstance(line.get("duration_s"), int | float):
        raise BadTranscript(f"{path}: the first line must hold url and duration_s")
    split_url(line["url"])
    if not 0 < float(line["duration_s"]) < math.inf:
        raise ValueError(f"duration_s is {line['duration_s']}")
    return dict(line)


def _checked_end(line: Mapping[str, Any]) -> Mapping[str, Any]:
    if "identity" in line:
        _ = line["identity"]["model"], line["identity"]["serial"], line["samples"]
        for x, y, z in (line["mean_force_N"], line["mean_torque_Nm"]):
            if not all(map(math.isfinite, (x, y, z))):
                raise ValueError(f"a mean of {x}, {y}, {z}")
    return line


def _checked_page(line: Mapping[str, Any]) -> Page:
    page = Page(bytes.fromhex(line["request"]), bytes.fromhex(line["reply"]), float(line["took_s"]))
    if not 0 <= page.took_s <= _LONGEST_PAGE_S:
        raise ValueError(f"took_s is {page.took_s}")
    return page


def _time_ns(line: Mapping[str, Any]) -> int:
    float(line["t_ns"])  # beyond its range no time can be told from another
    return int(line["t_ns"])
