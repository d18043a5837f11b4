"""Recording of bytes inside pyserial and python-can."""

import contextlib
from collections.abc import Iterator
from types import ModuleType
from typing import Any

import can
import serial

from ftdrivers.transcript.recorder import Writer
from ftdrivers.wires.serial_port import marks_asked_for


@contextlib.contextmanager
def _replaced(module: ModuleType, name: str, other: object) -> Iterator[None]:
    """Put another object in the place of the one that a module has by this name, during the `with` block."""
    plain = getattr(module, name)
    setattr(module, name, other)
    try:
        yield
    finally:
        setattr(module, name, plain)


@contextlib.contextmanager
def recording(writer: Writer) -> Iterator[None]:
    """Record the bytes of all serial ports and CAN buses opened in the `with` block.

    They keep the driver's settings, so the device sees no difference.
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
            """Record the port's settings at its first use, because the driver sets the marks after opening."""
            if not self._noted:
                self._noted = True
                settings = {key: getattr(self, key) for key in ("baudrate", "bytesize", "parity", "stopbits")}
                marks = marks_asked_for(self)
                writer.event("open", port=self.port, **settings, parity_marks=marks)

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
            if waiting := self.in_waiting:  # they were on the wire although the driver drops them
                writer.received(super().read(waiting))
            super().reset_input_buffer()

    def recorded_bus(channel: str, **options: Any) -> can.BusABC:
        before = len(opened)
        bus = plain_bus(channel, **options)
        if len(opened) > before:  # it is on a recorded serial port, like slcan
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
    """Write a frame as an slcan adapter does; empty for one that it cannot carry."""
    # Frames of adapters without a serial port become lines of slcan, so one player serves both.
    if frame.is_error_frame or frame.is_fd:
        return b""
    kind, data = ("r", "") if frame.is_remote_frame else ("t", frame.data.hex().upper())
    head = f"{kind.upper()}{frame.arbitration_id:08X}" if frame.is_extended_id else f"{kind}{frame.arbitration_id:03X}"
    return f"{head}{frame.dlc}{data}\r".encode()
