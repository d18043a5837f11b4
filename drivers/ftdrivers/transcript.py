"""Transcripts: files with the bytes on a sensor's wire. `recording` writes them, `Player` plays them to a driver.

A transcript (``ftdrive.transcript/1``) consists of JSON lines. The first holds sensor, time and versions. The others
have the time of the driver's clock as `t_ns`:

{"t_ns", "event": "open", "port", "baudrate", "bytesize", "parity", "stopbits", "parity_marks"}   a serial port
{"t_ns", "event": "open", "port", "frames": true}                                                 a CAN interface
{"t_ns", "dir": "tx", "hex"}    one write of the driver
{"t_ns", "dir": "rx", "hex"}    bytes that the driver read within 2 ms, with the time of the first one
{"t_ns", "event": "end", "error"}   the error at the end, or the decoded values: "identity", "samples", "mean_force_N",
                                    "mean_torque_Nm" and more

If `parity_marks` is true, received bytes contain the marks of `drivers/ftdrivers/wires/serial_port.py`. An slcan
adapter is recorded as a serial port. Frames of other CAN interfaces are stored in the format of slcan and played by an
emulated slcan adapter; the commands of python-can to this adapter are not compared.
"""

import contextlib
import json
import math
import os
import select
import threading
import tty
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from types import ModuleType
from typing import IO, Any, Final, Self
from urllib.parse import parse_qsl, urlencode

import can
import numpy as np
import serial

from ftdrivers.clock import REAL, Clock, Follower
from ftdrivers.errors import BadTranscript, BadUrl, ConnectError, DeviceTimeout, ProtocolError
from ftdrivers.interfaces import ForceTorqueSensor
from ftdrivers.registry import sensor_from_url, split_url
from ftdrivers.wires.serial_port import leave_marks_to_far_side, marks_asked_for

FORMAT: Final = "ftdrive.transcript/1"

_TOGETHER_NS: Final = 2_000_000
# Duration of one `collect` in a recording, s; its limit of a million samples is reached after 143 s at 7 kHz.
_PIECE_S: Final = 60.0
# Time, s, recorded beyond the requested duration, because a playback may start slightly later.
_TAIL_S: Final = 0.3
# Longest line, characters: longer than the hexadecimal form of all that a serial port can buffer.
_LONGEST_LINE: Final = 16_000_000
INTERRUPTED: Final = "interrupted"
"""Value of `error` if the user interrupted the recording."""
# A driver may send a request by this time earlier than recorded, s. Pending data of the device are then sent at once.
_EARLY_S: Final = 0.05


class Writer:
    """Writes a transcript to `path` with the suffix ``.partial``; `end` removes the suffix.

    `header` is the content of the first line. Raises `OSError` if one of the two files exists already, or if the file
    cannot be written.
    """

    def __init__(self, path: Path, header: Mapping[str, Any], clock: Clock = REAL) -> None:
        self.has_port = False
        """Whether a port was opened. Otherwise there is nothing to play."""
        self.is_saved = False
        self.clock = clock
        self._path = path
        self._partial = path.parent / (path.name + ".partial")
        for existing in (path, self._partial):
            if existing.exists():
                raise FileExistsError(f"{existing} exists already and is not overwritten; give another name")
        self._lock = threading.Lock()
        self._received = bytearray()
        self._received_ns = 0
        try:
            self._file: IO[str] | None = self._partial.open("x", encoding="utf-8")
        except OSError as error:
            fix = "choose a folder that exists and is writable"
            raise OSError(f"{path} cannot be written ({error.strerror}); {fix}") from error
        self._line({"format": FORMAT, **header})

    def event(self, name: str, **content: Any) -> None:
        """Write an event, such as "open", to the transcript."""
        self.has_port |= name == "open"
        self._entry(event=name, **content)

    def sent(self, data: bytes) -> None:
        """Record the bytes of one write of the driver."""
        self._entry(dir="tx", hex=data.hex())

    def received(self, data: bytes) -> None:
        """Record bytes that the driver has read. Reads within 2 ms are joined to one line."""
        if not data:
            return
        now_ns = self.clock.now_ns()
        with self._lock:
            if self._received and now_ns - self._received_ns > _TOGETHER_NS:
                self._flush_received()
            if not self._received:
                self._received_ns = now_ns
            self._received += data

    def record(self, device: ForceTorqueSensor, duration_s: float) -> dict[str, Any]:
        """Record a sensor from opening to closing; return the decoded values.

        The file is kept if a port was opened or if the driver failed; its error is then stored at the end. Raises
        `DeviceError`.
        """
        seen: dict[str, Any] = {"error": INTERRUPTED}
        try:
            with recording(self), device:
                whole = _watch(device, duration_s)
                device.collect(_TAIL_S)
            seen = whole
        except Exception as error:
            seen = {"error": f"{type(error).__name__}: {error}"}
            raise
        finally:
            # The transcript of a failed attempt to open the port is kept, because its error may be worth a report.
            if not self.has_port and seen["error"] in {None, INTERRUPTED}:
                self.discard()
            else:
                self.end(**seen)
        return seen

    def end(self, **content: Any) -> None:
        """Write the last line and rename the file."""
        self.event("end", **content)
        with self._lock:
            file, self._file = self._file, None
        if file is None:
            return
        with file:
            file.flush()
            os.fsync(file.fileno())
        if self._path.exists():
            raise FileExistsError(f"{self._path} was created meanwhile; find the transcript in {self._partial}")
        self._partial.rename(self._path)
        self.is_saved = True

    def discard(self) -> None:
        """Delete the unfinished file."""
        with self._lock:
            file, self._file = self._file, None
        if file is not None:
            file.close()
            self._partial.unlink()

    def _entry(self, **content: Any) -> None:
        with self._lock:
            self._flush_received()
            self._line({"t_ns": self.clock.now_ns(), **content})

    def _flush_received(self) -> None:
        if self._received:
            self._line({"t_ns": self._received_ns, "dir": "rx", "hex": self._received.hex()})
            self._received.clear()

    def _line(self, content: Mapping[str, Any]) -> None:
        if self._file is not None:
            self._file.write(json.dumps(content, ensure_ascii=False) + "\n")


@dataclass(frozen=True, slots=True)
class Passage:
    """Bytes of a transcript that were sent together in one direction."""

    t_ns: int
    sent: bool
    """True if the driver sent the bytes, false if the device did."""
    data: bytes


@dataclass(frozen=True, slots=True)
class Transcript:
    """A transcript read from a file."""

    header: Mapping[str, Any]
    opened_ns: int
    """Time at which the driver opened its port, ns."""
    passages: tuple[Passage, ...]
    end: Mapping[str, Any]
    """Values that the driver decoded; empty if the recording was interrupted."""
    parity_marks: bool = False
    """Whether received bytes contain marks of wrong parity."""
    frames: bool = False
    """Whether the passages are CAN frames in the format of slcan."""

    @property
    def is_broken_off(self) -> bool:
        """Whether the recording was interrupted, or its end is missing."""
        return bool(self.end.get("error", INTERRUPTED) == INTERRUPTED)

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read a transcript. Raises `BadTranscript`, or `OSError` if the file cannot be read."""
        header: Mapping[str, Any] = {}
        opened_ns: int | None = None
        parity_marks = frames = False
        passages: list[Passage] = []
        end: Mapping[str, Any] = {}
        number = 0
        try:
            with path.open("rb") as file:
                while text := file.readline(_LONGEST_LINE):
                    number += 1
                    line = _parsed(text)
                    if number == 1:
                        header = _checked_header(path, line)
                    elif "dir" in line:
                        passages.append(Passage(_time_ns(line), line["dir"] == "tx", bytes.fromhex(line["hex"])))
                    elif line.get("event") == "open" and opened_ns is None:
                        opened_ns, parity_marks = _time_ns(line), line.get("parity_marks") is True
                        frames = line.get("frames") is True
                    elif line.get("event") == "end":
                        end = _checked_end(line)
        except (BadUrl, ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError) as error:
            raise BadTranscript(
                f"{path}, line {number}: not a line of a transcript ({error}); record it again"
            ) from error
        if not header:
            raise BadTranscript(f"{path} is empty; record it again")
        if opened_ns is None:
            raise BadTranscript(f"{path}: nothing to play, the driver opened no port: {end.get('error')}")
        return cls(header, opened_ns, tuple(passages), end, parity_marks, frames)

    def url_at(self, port: str) -> str:
        """Return the address of the sensor with its port replaced by the port of a player."""
        parts = split_url(str(self.header["url"]))
        options = dict(parse_qsl(parts.query)) | ({"interface": "slcan"} if self.frames else {})
        return f"{parts.scheme}://{port}" + (f"?{urlencode(options)}" if options else "")

    def play(self, clock: Clock = REAL) -> dict[str, Any]:
        """Play the transcript to its driver, as far as it was recorded; return the decoded values.

        Raises `ProtocolError` if the driver sends bytes that were not recorded, `BadTranscript` if the recording has no
        samples, and the errors of the driver.
        """
        player = Player(self, clock)
        with player as port:
            device = sensor_from_url(self.url_at(port), clock=clock)
            duration_s = float(self.header["duration_s"])
            try:
                with device:
                    if self.is_broken_off:
                        duration_s = min(duration_s, player.left_s - _TAIL_S)
                    return _watch(device, duration_s)
            except Exception as error:
                if player.divergence:
                    raise ProtocolError(f"{error}; the transcript has no reply: {player.divergence}") from error
                silent = isinstance(error, ConnectError | DeviceTimeout)
                if silent and self.is_broken_off and player.left_s < _TAIL_S:
                    raise BadTranscript(
                        f"the recording was interrupted before the first sample ({error}): record it again"
                    ) from error
                raise


def _watch(device: ForceTorqueSensor, duration_s: float) -> dict[str, Any]:
    """Collect samples of an open sensor and return their statistics, with the sign as the device reports it."""
    pieces = math.ceil(duration_s / _PIECE_S)
    samples, total = 0, np.zeros(6)
    for _ in range(pieces):
        wrench = device.collect(duration_s / pieces).wrench
        samples, total = samples + len(wrench), total + wrench.sum(axis=0)
    if not samples:
        raise DeviceTimeout(f"no sample arrived in {duration_s:g} s: record for a longer time, with --duration")
    force_N, torque_Nm = np.split(total / samples, 2)
    return {
        "error": None,
        "identity": asdict(device.identify()),
        "duration_s": duration_s,
        "samples": samples,
        "lost": device.health().lost,
        "mean_force_N": force_N.tolist(),
        "mean_torque_Nm": torque_Nm.tolist(),
    }


def _parsed(line: bytes) -> Any:
    if len(line) == _LONGEST_LINE:
        raise ValueError(f"it is longer than {_LONGEST_LINE / 1e6:.0f} MB")
    return json.loads(line)


def _checked_header(path: Path, line: Any) -> Mapping[str, Any]:
    found = line.get("format") if isinstance(line, dict) else None
    if found != FORMAT:
        raise BadTranscript(f"{path}: the format in the first line is {found!r}; give a file in the format {FORMAT}")
    if not isinstance(line.get("url"), str) or not isinstance(line.get("duration_s"), int | float):
        raise BadTranscript(f"{path}: url or duration_s is missing in the first line; record it again")
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
    float(line["t_ns"])  # raises for a time beyond the range of a float
    return int(line["t_ns"])


@contextlib.contextmanager
def _replaced(module: ModuleType, name: str, other: object) -> Iterator[None]:
    """Replace an attribute of a module during the `with` block."""
    plain = getattr(module, name)
    setattr(module, name, other)
    try:
        yield
    finally:
        setattr(module, name, plain)


@contextlib.contextmanager
def recording(writer: Writer) -> Iterator[None]:
    """Record the bytes of all serial ports and CAN buses opened in the `with` block.

    The ports keep the settings of the driver, so the recording does not affect the device.
    """
    # Bytes are recorded inside pyserial: a pseudo-terminal in between would hide parity and latency settings from the
    # device.
    plain_bus = can.Bus
    opened: list[serial.Serial] = []

    class RecordedPort(serial.Serial):
        _noted = False

        def open(self) -> None:
            super().open()
            self._noted = False
            opened.append(self)

        def _note(self) -> None:
            """Record the settings of the port at its first use, because the driver requests marks after opening."""
            if not self._noted:
                self._noted = True
                settings = {key: getattr(self, key) for key in ("baudrate", "bytesize", "parity", "stopbits")}
                writer.event("open", port=self.port, **settings, parity_marks=marks_asked_for(self))

        def read(self, size: int = 1, /) -> bytes:
            self._note()
            data: bytes = super().read(size)
            writer.received(data)
            return data

        def write(self, data: Any, /) -> int | None:
            self._note()
            writer.sent(bytes(data))
            written: int | None = super().write(data)
            return written

        def reset_input_buffer(self) -> None:
            self._note()
            if waiting := self.in_waiting:  # the bytes were on the wire, although the driver drops them
                writer.received(super().read(waiting))
            super().reset_input_buffer()

    def recorded_bus(channel: str, **options: Any) -> can.BusABC:
        before = len(opened)
        bus = plain_bus(channel, **options)
        if len(opened) > before:  # the adapter is on a serial port, which is recorded
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

    with _replaced(serial, "Serial", RecordedPort), _replaced(can, "Bus", recorded_bus):
        yield


def _slcan_line(frame: can.Message) -> bytes:
    """Return a frame in the format of slcan; empty if an slcan adapter cannot transmit it."""
    if frame.is_error_frame or frame.is_fd:
        return b""
    kind, data = ("r", "") if frame.is_remote_frame else ("t", frame.data.hex().upper())
    head = f"{kind.upper()}{frame.arbitration_id:08X}" if frame.is_extended_id else f"{kind}{frame.arbitration_id:03X}"
    return f"{head}{frame.dlc}{data}\r".encode()


class Player:
    """Plays a recorded device on a pseudo-terminal, which one driver may open once.

    Replies have the recorded delay after their request, and other data the recorded timing. After a request that does
    not follow in the recording, the player is silent and sets `divergence`.
    """

    def __init__(self, transcript: Transcript, clock: Clock = REAL) -> None:
        self._clock = clock
        self._passages = transcript.passages
        self._far = _Terminal(transcript)
        self._next = 0
        self._t_ns = transcript.opened_ns  # time in the recording up to which it was played
        self._t = 0.0
        self._asked = bytearray()
        self._ended = threading.Event()
        self._thread: Follower | None = None
        self.divergence: str | None = None
        """Description of the request of the driver that was not recorded; None if there was none."""

    @property
    def left_s(self) -> float:
        """Duration of the part of the recording that was not played yet, s."""
        left = self._passages[self._next :]
        return (left[-1].t_ns - left[0].t_ns) / 1e9 if left else 0.0

    def __enter__(self) -> str:
        """Start the player and return the path of its pseudo-terminal."""
        path = self._far.open()
        self._thread = Follower(self._clock, self._serve, f"player on {path}")
        self._thread.start()
        return path

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
            self._far.close()

    def _serve(self) -> None:
        while not self._far.is_awaited():  # wait until the driver is ready to receive
            if self._clock.wait(self._ended, 0.001):
                return
        self._t = self._clock.now_s()
        while not self._ended.is_set():
            self._clock.now_ns()  # an emulated cell waits for this thread
            wait_s = min(self._clock.poll_s, max(0.0, self._play()))
            readable, _, _ = select.select([self._far], [], [], wait_s)
            if readable:
                data = self._far.read()
                if data is None:
                    return
                self._asked += data
                self._listen()

    def _play(self) -> float:
        """Send the data that are due; return the time until the next data may be due, s."""
        if self._far.is_full:
            self._far.send(b"")
        while self._next < len(self._passages) and not self.divergence and not self._passages[self._next].sent:
            passage = self._passages[self._next]
            wait_s = self._due_in_s(passage)
            if wait_s > 0:
                return wait_s
            self._far.send(passage.data)
            self._next += 1
        return 0.001 if self._far.is_full else math.inf

    def _due_in_s(self, passage: Passage) -> float:
        return self._t + (passage.t_ns - self._t_ns) / 1e9 - self._clock.now_s()

    def _listen(self) -> None:
        """Compare what the driver has written with the next recorded request; go on, or set `divergence`."""
        while self._asked and not self.divergence:
            first = self._request_from(self._next)
            if first is None:  # the driver is closing the port, or the recording was interrupted
                self._asked.clear()
                return
            expected = self._passages[first].data
            if len(expected) > len(self._asked) and expected.startswith(self._asked):
                return
            found: int | None = first
            while found is not None and not self._asked.startswith(self._passages[found].data):
                found = self._request_from(found + 1)
            if found is None:
                self.divergence = f"the driver sent {self._asked.hex(' ')}, the recording has {expected.hex(' ')}"
                return
            if found == first:
                for passage in self._passages[self._next : found]:
                    if self._due_in_s(passage) < _EARLY_S:
                        self._far.send(passage.data)
            request = self._passages[found]
            del self._asked[: len(request.data)]
            self._next = found + 1
            self._t, self._t_ns = self._clock.now_s(), request.t_ns

    def _request_from(self, start: int) -> int | None:
        return next((i for i in range(start, len(self._passages)) if self._passages[i].sent), None)


# A pseudo-terminal is used so that the driver runs with the real pyserial.
class _Terminal:
    """A pseudo-terminal. For CAN frames it also acts as an slcan adapter that accepts every command."""

    def __init__(self, transcript: Transcript) -> None:
        self._parity_marks = transcript.parity_marks
        self._frames = transcript.frames
        self._line = b""
        self._unsent = b""
        self._master = -1

    def open(self) -> str:
        self._master, slave = os.openpty()
        path = os.ttyname(slave)
        tty.setraw(slave)
        os.close(slave)  # only then the master shows whether a driver has the port open
        os.set_blocking(self._master, False)
        return path

    def close(self) -> None:
        os.close(self._master)

    def is_awaited(self) -> bool:
        """Return whether the driver has opened the port, and requested marks if the transcript has them."""
        poll = select.poll()
        poll.register(self._master, 0)
        if poll.poll(0):  # "hung up" until a driver has opened the other end
            return False
        if self._parity_marks:
            if not marks_asked_for(self._master):
                return False
            leave_marks_to_far_side(self._master)
        return True

    def fileno(self) -> int:
        return self._master

    def read(self) -> bytes | None:
        """Return the bytes that the driver has sent; None if it has closed the port."""
        try:
            data = os.read(self._master, 4096)
        except OSError:
            return None  # error: the driver has closed the port
        return self._frames_of(data) if self._frames else data

    def _frames_of(self, data: bytes) -> bytes:
        """Return the CAN frames in the data, without the commands to the adapter, which were not recorded."""
        *lines, self._line = (self._line + data).split(b"\r")
        return b"".join(line + b"\r" for line in lines if line[:1] in {b"t", b"T", b"r", b"R"})

    def send(self, data: bytes) -> None:
        """Send as many bytes as the driver accepts. The next call sends the remaining bytes first."""
        data = self._unsent + data
        try:
            written = os.write(self._master, data)
        except BlockingIOError:
            written = 0
        self._unsent = data[written:]

    @property
    def is_full(self) -> bool:
        return bool(self._unsent)
