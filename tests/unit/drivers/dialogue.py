"""Devices in memory: a table of what a driver must send and what it receives then, on a fake clock.

A turn is `(sent, received)`. A serial port takes and gives bytes, each write of the driver being one turn; a CAN bus
takes and gives lines such as ``"205 4654313233343500"``. What is received comes `DELAY_S` later, or after the
milliseconds that stand before it: `(5.0, b"...")`.
"""

import threading
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import repeat
from typing import Any, Generic, Self, TypeVar

import can
import pytest

from tests.fake_clock import FakeClock

DELAY_S = 1e-3
T = TypeVar("T")


@dataclass(frozen=True)
class Stream:
    """Bytes that come again and again from a turn on, until the next one."""

    reply: bytes
    chunks: Iterable[bytes]
    period_s: float = 1e-3

    @classmethod
    def of(cls, chunk: bytes, period_s: float = 1e-3, reply: bytes = b"") -> Self:
        return cls(reply, repeat(chunk), period_s)


class _Wire(Generic[T]):
    """What both wires share: time, what is on its way, and whether all went as it stands in the table."""

    def __init__(self, turns: Iterable[tuple[Any, Any]]) -> None:
        self.clock = FakeClock()
        self.sent: list[T] = []
        self.wrong: list[str] = []
        self._turns: Iterator[tuple[Any, Any]] = iter(turns)
        self._arrived: list[T] = []
        self._news = threading.Condition()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        assert not self.wrong, self.wrong
        if kind is None:
            assert next(self._turns, None) is None, "the driver has not sent all that stands in the table"

    def take(self, sent: T) -> Any:
        """Compare what is sent with the next turn, and return what is received."""
        self.sent.append(sent)
        expected, received = next(self._turns, (None, None))
        if sent != expected:
            self.wrong.append(f"sent {sent!r}, not {expected!r}")
            return None
        return received

    def arrive(self, after_s: float, what: T) -> None:
        self.clock.at(after_s, lambda: self._arrived.append(what))

    def wait_for(self, enough: Callable[[], bool], timeout_s: float) -> None:
        for left_s in self.clock.looks(timeout_s):
            if enough():
                return
            self.clock.wait(self._news, left_s)


class SerialWire(_Wire[bytes]):
    """Stands in for `serial.Serial`, and for its class."""

    def __init__(self, turns: Iterable[tuple[bytes, Any]], streaming: Stream | None = None) -> None:
        super().__init__(turns)
        self._flow = 0
        """Counts the streams: an older one ends."""
        self.timeout = 0.0
        self.once: list[bytes] = []
        """Comes before the next chunk of a stream."""
        if streaming:
            self._run(streaming)

    def __call__(self, *_: object, timeout: float, **__: object) -> Self:
        self.timeout = timeout
        return self

    def write(self, data: bytes) -> None:
        self._flow += 1
        received = self.take(data)
        if isinstance(received, Stream):
            self._run(received)
            received = received.reply
        after_ms, received = received if isinstance(received, tuple) else (DELAY_S * 1e3, received)
        if received:
            self.arrive(after_ms * 1e-3, received)

    def read(self, size: int) -> bytes:
        self.wait_for(lambda: self.in_waiting >= size, self.timeout)
        data = b"".join(self._arrived)
        self._arrived = [data[size:]]
        return data[:size]

    @property
    def in_waiting(self) -> int:
        return sum(map(len, self._arrived))

    def reset_input_buffer(self) -> None:
        self._arrived.clear()

    def set_low_latency_mode(self, _: bool) -> None: ...

    def close(self) -> None: ...

    def _run(self, stream: Stream) -> None:
        flow, chunks = self._flow, iter(stream.chunks)

        def send() -> None:
            if flow == self._flow and (chunk := next(chunks, b"")):
                self._arrived += [*self.once, chunk]
                self.once.clear()
                self.clock.at(stream.period_s, send)

        self.clock.at(DELAY_S + stream.period_s, send)


class CanWire(_Wire[str]):
    """Stands in for a bus of python-can, and for its class."""

    def __init__(self, turns: Iterable[tuple[str, Any]], *, echo: bool = False) -> None:
        super().__init__(turns)
        self._echo = echo

    def __call__(self, *_: object, **__: object) -> Self:
        return self

    def send(self, message: can.Message, timeout: float) -> None:
        assert timeout
        request = f"{message.arbitration_id:03X} {message.data.hex().upper()}".strip()
        received = self.take(request) or ()
        for item in [(0.0, request), *received] if self._echo else received:
            after_ms, line = item if isinstance(item, tuple) else (DELAY_S * 1e3, item)
            self.arrive(after_ms * 1e-3, line)

    def stream(self, lines: Iterable[str], period_s: float) -> None:
        """Send lines for ever, those of one turn together."""
        lines = list(lines)

        def send() -> None:
            self._arrived.extend(lines)
            self.clock.at(period_s, send)

        self.clock.at(period_s, send)

    def recv(self, timeout: float) -> can.Message | None:
        self.wait_for(lambda: bool(self._arrived), timeout)
        if not self._arrived:
            return None
        identifier, _, payload = self._arrived.pop(0).partition(" ")
        return can.Message(arbitration_id=int(identifier, 16), data=bytes.fromhex(payload), is_extended_id=False)

    def shutdown(self) -> None: ...


@dataclass(frozen=True)
class Table:
    """Puts a device in memory in place of the next port or bus that is opened."""

    monkeypatch: pytest.MonkeyPatch

    def serial(
        self, turns: Iterable[tuple[bytes, Any]], streaming: Stream | None = None, *, marks: bool = False
    ) -> SerialWire:
        wire = SerialWire(turns, streaming)
        self.monkeypatch.setattr("serial.Serial", wire)
        self.monkeypatch.setattr("drivers._serial.ask_for_marks", lambda _: marks)
        return wire

    def can(self, turns: Iterable[tuple[str, Any]], *, echo: bool = False) -> CanWire:
        wire = CanWire(turns, echo=echo)
        self.monkeypatch.setattr("can.Bus", wire)
        return wire
