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
    """What comes again and again from a turn on, until the next one: bytes, or lists of lines."""

    chunks: Iterable[Any]
    period_s: float = 1e-3
    reply: Any = None
    has_end: bool = True
    """Else the next turn does not end it: it is another device that sends."""

    @classmethod
    def of(cls, chunk: Any, period_s: float = 1e-3, reply: Any = None, *, has_end: bool = True) -> Self:
        return cls(repeat(chunk), period_s, reply, has_end)


class _Wire(Generic[T]):
    """What both wires share: time, what is on its way, and whether all went as it stands in the table."""

    def __init__(self, turns: Iterable[tuple[Any, Any]], streaming: Stream | None = None) -> None:
        self.clock = FakeClock()
        self.sent: list[T] = []
        self.wrong: list[str] = []
        self.once: list[T] = []
        """Comes before the next chunk of a stream."""
        self._turns: Iterator[tuple[Any, Any]] = iter(turns)
        self.arrived: list[T] = []
        self._news = threading.Condition()
        self.streams = 0
        if streaming:
            self.stream(streaming)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        assert not self.wrong, self.wrong
        if kind is None:
            assert next(self._turns, None) is None, "the driver has not sent all that stands in the table"

    def _take(self, sent: T) -> list[tuple[float, T]]:
        """Compare what is sent with the next turn; return what is received, and after how many seconds."""
        self.sent.append(sent)
        self.streams += 1
        expected, received = next(self._turns, (None, None))
        if sent != expected:
            self.wrong.append(f"sent {sent!r}, not {expected!r}")
            return []
        if isinstance(received, Stream):
            self.stream(received)
            received = received.reply
        items = received if isinstance(received, list) else [received] if received else []
        return [(item[0] * 1e-3, item[1]) if isinstance(item, tuple) else (DELAY_S, item) for item in items]

    def _arrive(self, after_s: float, what: T) -> None:
        self.clock.at(after_s, lambda: self.arrived.append(what))

    def _wait_for(self, enough: Callable[[], bool], timeout_s: float) -> None:
        for left_s in self.clock.looks(timeout_s):
            if enough():
                return
            self.clock.wait(self._news, left_s)

    def stream(self, stream: Stream) -> None:
        """Send in step with the clock: what a driver was too late for has piled up."""
        number, chunks = self.streams, iter(stream.chunks)
        due_s = self.clock.now_s() + DELAY_S

        def schedule() -> None:
            nonlocal due_s
            due_s += stream.period_s
            self.clock.at(due_s - self.clock.now_s(), send)

        def send() -> None:
            is_on = number == self.streams or not stream.has_end
            if is_on and (chunk := next(chunks, None)):
                self.arrived += [*self.once, *(chunk if isinstance(chunk, list) else [chunk])]
                self.once.clear()
                schedule()

        schedule()


class SerialWire(_Wire[bytes]):
    """Stands in for `serial.Serial`, and for its class."""

    def __call__(self, *_: object, timeout: float = 0.0, **__: object) -> Self:
        self.timeout = timeout
        return self

    def write(self, data: bytes) -> None:
        for after_s, received in self._take(data):
            self._arrive(after_s, received)

    def read(self, size: int) -> bytes:
        self._wait_for(lambda: self.in_waiting >= size, self.timeout)
        data = b"".join(self.arrived)
        self.arrived = [data[size:]]
        return data[:size]

    @property
    def in_waiting(self) -> int:
        return sum(map(len, self.arrived))

    def reset_input_buffer(self) -> None:
        self.arrived.clear()

    def set_low_latency_mode(self, _: bool) -> None: ...

    def close(self) -> None: ...


class CanWire(_Wire[str]):
    """Stands in for a bus of python-can, and for its class."""

    echoes = False

    def __call__(self, *_: object, **__: object) -> Self:
        return self

    def send(self, message: can.Message, timeout: float) -> None:
        assert timeout
        request = f"{message.arbitration_id:03X} {message.data.hex().upper()}".strip()
        if self.echoes:
            self._arrive(0.0, request)
        for after_s, line in self._take(request):
            self._arrive(after_s, line)

    def recv(self, timeout: float) -> can.Message | None:
        self._wait_for(lambda: bool(self.arrived), timeout)
        if not self.arrived:
            return None
        identifier, _, payload = self.arrived.pop(0).partition(" ")
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
        self.monkeypatch.setattr("ftdrivers.wires.serial_port.ask_for_marks", lambda _: marks)
        return wire

    def can(self, turns: Iterable[tuple[str, Any]], streaming: Stream | None = None, *, echo: bool = False) -> CanWire:
        wire = CanWire(turns, streaming)
        wire.echoes = echo
        self.monkeypatch.setattr("can.Bus", wire)
        return wire
