"""The bytes on the wire of a serial or CAN device, kept in a file, and played back to the unmodified driver.

A transcript (``ftdrive.transcript/1``) is JSON lines. The first says which sensor, when and with which versions; then
come, with `time.monotonic_ns()` as `t_ns`:

{"t_ns", "event": "open", "port", "baudrate", "bytesize", "parity", "stopbits", "parity_marks"}   a serial port
{"t_ns", "event": "open", "port", "frames": true}                                                 a CAN interface
{"t_ns", "dir": "tx", "hex"}    one write of the driver
{"t_ns", "dir": "rx", "hex"}    what the driver read within 2 ms, stamped with its first byte
{"t_ns", "event": "end", "error"}   the error it ended with; where there was none, what the driver made of it:
                                    "identity", "samples", "mean_force_N", "mean_torque_Nm" and more

Where `parity_marks` is true, the bytes that were read hold the marks of `drivers/_parity.py`; older transcripts do not
say it and hold none. Some CAN adapters, such as those of slcan, are on a serial port too. The frames of any other CAN
interface are written as the lines that an slcan adapter would carry, and such an adapter plays them; what python-can
tells it is not compared. Ethernet is not recorded.
"""

import contextlib
import json
import math
import os
import select
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Final, Self
from urllib.parse import parse_qsl, urlencode

import can
import serial

from drivers._parity import leave_marks_to_far_side, marks_asked_for
from drivers.registry import split_url

if sys.platform != "win32":
    import tty

FORMAT: Final = "ftdrive.transcript/1"

_TOGETHER_NS: Final = 2_000_000
INTERRUPTED: Final = "interrupted"
"""The error of a recording that was broken off by the user."""
_EARLY_S: Final = 0.05
"""A driver may ask this much earlier than it did; what the device had sent before is then sent at once."""
_PORT_CLASS: Final = "Serial"
_BUS_CLASS: Final = "Bus"


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

    Raises
    ------
    OSError
        The file, or one of an unfinished recording, exists already, or cannot be written.
    """

    def __init__(self, path: Path, header: Mapping[str, Any]) -> None:
        self.has_port = False
        """Whether a port or a bus was opened: without one there is nothing to play."""
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
            cure = "give a file in a folder that exists and is yours"
            raise OSError(f"{path} cannot be written ({error.strerror}): {cure}") from error
        self._line({"format": FORMAT, **header})

    def event(self, name: str, **content: Any) -> None:
        """Note something that is not bytes."""
        with self._lock:
            self._flush_received()
            self.has_port |= name == "open"
            self._line({"t_ns": time.monotonic_ns(), "event": name, **content})

    def sent(self, data: bytes) -> None:
        """Note one write of the driver."""
        with self._lock:
            self._flush_received()
            self._line({"t_ns": time.monotonic_ns(), "dir": "tx", "hex": data.hex()})

    def received(self, data: bytes) -> None:
        """Note what the driver was given; reads that follow each other closely become one line."""
        if not data:
            return
        now_ns = time.monotonic_ns()
        with self._lock:
            if self._received and now_ns - self._received_ns > _TOGETHER_NS:
                self._flush_received()
            if not self._received:
                self._received_ns = now_ns
            self._received += data

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


@contextlib.contextmanager
def recording(writer: Writer) -> Iterator[None]:
    """Write down everything that passes through the serial ports and CAN buses which are opened in the `with` block.

    They are those of pyserial and python-can, with the driver's own settings: the device sees no difference.
    """
    plain, plain_bus = serial.Serial, can.Bus
    opened: list[serial.Serial] = []

    class RecordedPort(serial.Serial):
        _told = False

        def open(self) -> None:
            super().open()
            self._told = False
            opened.append(self)

        def _tell(self) -> None:
            """Note how the port is set: at its first use, for who opens it sets the marks after pyserial is done."""
            if not self._told:
                self._told = True
                settings = {key: getattr(self, key) for key in ("baudrate", "bytesize", "parity", "stopbits")}
                marks = marks_asked_for(self)
                writer.event("open", port=self.port, **settings, parity_marks=marks)

        def read(self, size: int = 1, /) -> bytes:
            self._tell()
            data: bytes = super().read(size)
            writer.received(data)
            return data

        def write(self, data: Any, /) -> int | None:
            self._tell()
            writer.sent(bytes(data))
            written: int | None = super().write(data)
            return written

        def reset_input_buffer(self) -> None:
            self._tell()
            if waiting := self.in_waiting:  # they were on the wire although the driver does not want them
                writer.received(super().read(waiting))
            super().reset_input_buffer()

    def recorded_bus(channel: str, **options: Any) -> can.BusABC:
        before = len(opened)
        bus = plain_bus(channel, **options)
        if len(opened) > before:  # it is on a recorded port, like slcan
            return bus
        writer.event("open", port=channel, frames=True)
        receive, send = bus.recv, bus.send

        def recv(timeout: float | None = None) -> can.Message | None:
            if (message := receive(timeout)) is not None:
                writer.received(_slcan_line(message))
            return message

        def recorded_send(message: can.Message, timeout: float | None = None) -> None:
            writer.sent(_slcan_line(message))
            send(message, timeout)

        vars(bus).update(recv=recv, send=recorded_send)
        return bus

    setattr(serial, _PORT_CLASS, RecordedPort)
    setattr(can, _BUS_CLASS, recorded_bus)
    try:
        yield
    finally:
        setattr(serial, _PORT_CLASS, plain)
        setattr(can, _BUS_CLASS, plain_bus)


def _slcan_line(frame: can.Message) -> bytes:
    """Write a frame as an slcan adapter does; nothing for one that it cannot carry."""
    if frame.is_error_frame or frame.is_fd:
        return b""
    kind, data = ("r", "") if frame.is_remote_frame else ("t", frame.data.hex().upper())
    head = f"{kind.upper()}{frame.arbitration_id:08X}" if frame.is_extended_id else f"{kind}{frame.arbitration_id:03X}"
    return f"{head}{frame.dlc}{data}\r".encode()


@dataclass(frozen=True, slots=True)
class Passage:
    """Bytes that went one way."""

    t_ns: int
    sent: bool
    """By the driver."""
    data: bytes


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

    @property
    def is_broken_off(self) -> bool:
        """Whether the recording was interrupted, or the file has lost its end."""
        return bool(self.end.get("error", INTERRUPTED) == INTERRUPTED)

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read a file. Raises `BadTranscript`, or `OSError` when it cannot be read."""
        header: Mapping[str, Any] = {}
        opened_ns: int | None = None
        parity_marks = frames = False
        passages: list[Passage] = []
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
                        frames = line.get("frames") is True
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
        return cls(header, opened_ns, tuple(passages), end, parity_marks, frames)

    def url_at(self, port: str) -> str:
        """Give the sensor's address with the port of a player in it."""
        parts = split_url(str(self.header["url"]))
        options = dict(parse_qsl(parts.query)) | ({"interface": "slcan"} if self.frames else {})
        return f"{parts.scheme}://{port}" + (f"?{urlencode(options)}" if options else "")


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


def _time_ns(line: Mapping[str, Any]) -> int:
    float(line["t_ns"])  # beyond its range no time can be told from another
    return int(line["t_ns"])


class Player:
    """A pseudo-terminal behind which the recorded device seems to be, for one driver that opens it once.

    A request is answered as it was in the recording, with the recorded delays; what the device sent by itself comes
    with the recorded timing. A request that is not in the rest of the recording is a divergence: silence follows.
    """

    def __init__(self, transcript: Transcript) -> None:
        self._passages = transcript.passages
        self._parity_marks = transcript.parity_marks
        self._frames = transcript.frames
        self._line = b""
        self._next = 0
        self._t_ns = transcript.opened_ns  # of the recording, at `_t`
        self._t = 0.0
        self._asked = bytearray()
        self._unsent = b""
        self._master = -1
        self._ended = threading.Event()
        self._thread: threading.Thread | None = None
        self.divergence: str | None = None
        """What the driver asked that the recording cannot answer."""

    @property
    def left_s(self) -> float:
        """How much of the recording is not yet played, in its own time."""
        left = self._passages[self._next :]
        return (left[-1].t_ns - left[0].t_ns) / 1e9 if left else 0.0

    def __enter__(self) -> str:
        """Open the pseudo-terminal and return its path."""
        self._master, slave = os.openpty()
        path = os.ttyname(slave)
        tty.setraw(slave)
        os.close(slave)  # so that the master tells when a driver opens and leaves
        os.set_blocking(self._master, False)
        self._thread = threading.Thread(target=self._serve, name=f"player on {path}", daemon=True)
        self._thread.start()
        return path

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
            os.close(self._master)

    def _serve(self) -> None:
        poll = select.poll()
        poll.register(self._master, 0)
        while poll.poll(0):  # "hung up" until a driver has opened the other end
            if self._ended.wait(0.005):
                return
        if self._parity_marks:  # nothing is sent before the driver is ready for them
            while not marks_asked_for(self._master):
                if self._ended.wait(0.001):
                    return
            leave_marks_to_far_side(self._master)
        self._t = time.monotonic()
        while not self._ended.is_set():
            wait_s = min(0.05, max(0.0, self._play()))
            readable, _, _ = select.select([self._master], [], [], wait_s)
            if readable:
                try:
                    data = os.read(self._master, 4096)
                except OSError:
                    return  # the driver has closed the port
                self._asked += self._frames_of(data) if self._frames else data
                self._listen()

    def _frames_of(self, data: bytes) -> bytes:
        """Leave out what the adapter is told: it was another one in the recording."""
        *lines, self._line = (self._line + data).split(b"\r")
        return b"".join(line + b"\r" for line in lines if line[:1] in {b"t", b"T", b"r", b"R"})

    def _play(self) -> float:
        """Send what is due; return the seconds until something else may be."""
        if self._unsent:
            self._send(b"")
        while self._next < len(self._passages) and not self.divergence:
            passage = self._passages[self._next]
            if passage.sent:
                break
            wait_s = self._due_in_s(passage)
            if wait_s > 0:
                return wait_s
            self._send(passage.data)
            self._next += 1
        return 0.001 if self._unsent else 0.05

    def _due_in_s(self, passage: Passage) -> float:
        return self._t + (passage.t_ns - self._t_ns) / 1e9 - time.monotonic()

    def _send(self, data: bytes) -> None:
        data = self._unsent + data
        try:
            written = os.write(self._master, data)
        except BlockingIOError:
            written = 0
        self._unsent = data[written:]

    def _listen(self) -> None:
        """Compare what the driver writes with the next request of the recording."""
        while self._asked and not self.divergence:
            first = self._request_from(self._next)
            if first is None:  # a goodbye, or a recording that was broken off
                self._asked.clear()
                return
            expected = self._passages[first].data
            if len(expected) > len(self._asked) and expected.startswith(self._asked):
                return
            found: int | None = first
            while found is not None and not self._asked.startswith(self._passages[found].data):
                found = self._request_from(found + 1)
            if found is None:
                self.divergence = (
                    f"the driver sent {self._asked.hex(' ')}, where {expected.hex(' ')} was sent in the recording"
                )
                return
            if found == first:
                before = self._passages[self._next : found]
                self._send(b"".join(passage.data for passage in before if self._due_in_s(passage) < _EARLY_S))
            request = self._passages[found]
            del self._asked[: len(request.data)]
            self._next = found + 1
            self._t, self._t_ns = time.monotonic(), request.t_ns

    def _request_from(self, start: int) -> int | None:
        return next((i for i in range(start, len(self._passages)) if self._passages[i].sent), None)
