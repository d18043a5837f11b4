"""A CAN bus on any adapter of python-can, with the errors of `ftdrivers.errors`."""

import contextlib
import fcntl
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from typing import Any

import can
import serial
from can.interfaces.slcan import slcanBus

from ftdrivers.clock import REAL, Clock
from ftdrivers.errors import ConnectError, StreamBroken
from ftdrivers.wires.serial_port import LINK_ERRORS, refusal

BUS_ERRORS = (can.CanError, ValueError, *LINK_ERRORS)
_SEND_S, _LOOK_S = 0.1, 0.05
_DISCARD_S = 0.1


CanFrame = tuple[int, bytes]
"""Identifier and data of a CAN frame."""


class CanBus:
    """The connection to one device on a CAN bus with 11-bit identifiers.

    Parameters
    ----------
    owner : str
        Name of the device, with which every error message begins.
    channel, interface : str
        Names of python-can: ``can0`` and ``socketcan``, or a serial port and ``slcan``.
    bitrate : int
        Bit rate, bit/s. It is ignored on socketcan, where ``ip link`` sets it.
    identifiers : iterable of int
        Identifiers that the device sends; frames with others are ignored. If it is empty, all frames are accepted.
    clock : Clock
        Clock of the time-outs.
    """

    def __init__(
        self,
        owner: str,
        channel: str,
        interface: str,
        bitrate: int,
        identifiers: Iterable[int] = (),
        clock: Clock = REAL,
    ) -> None:
        self._owner = owner
        self._channel = channel
        self._interface = interface
        self._bitrate = bitrate
        self._identifiers = frozenset(identifiers)
        self._clock = clock
        self._bus: can.BusABC | None = None
        # File descriptor that locks the serial port of an slcan adapter.
        self._lock: int | None = None
        self.malformed = 0
        """Lines of an slcan adapter that are not frames."""

    def open(self) -> None:
        """Join the bus. Raises `ConnectError` if the adapter is missing, is in use or does not open."""
        self.malformed = 0
        filters: list[can.typechecking.CanFilter] = [
            {"can_id": identifier, "can_mask": 0x7FF, "extended": False} for identifier in self._identifiers
        ]
        options: dict[str, Any] = {}
        tty = self._channel
        if self._interface == "slcan":
            # python-can waits 2 s for adapters that reboot when their port is opened; an emulator does not reboot
            tty = tty.split("@", maxsplit=1)[0]
            with contextlib.suppress(OSError):  # the symbolic link to an adapter may vanish meanwhile
                tty = os.path.realpath(tty)
            if not os.access(tty, os.R_OK | os.W_OK):
                raise ConnectError(
                    f"{self._owner}: {self._channel} does not exist, or this user may not read and write it",
                    "plug the adapter in, and add this user to the group of the port",
                )
            if tty.startswith("/dev/pts/"):
                options["sleep_after_open"] = 0.0
        try:
            if self._interface == "slcan":  # python-can does not lock the port
                self._lock = os.open(tty, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
                fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            self._bus = can.Bus(
                self._channel,
                interface=self._interface,
                bitrate=self._bitrate,
                can_filters=filters,
                ignore_config=True,
                **options,
            )
        except Exception as exc:  # python-can raises any exception if the library of an adapter is missing
            self.close()
            fix = "plug the adapter in, and install the library that python-can needs for it"
            if "/" in self._channel and self._interface == "socketcan":
                fix = "add interface=slcan to the address of an adapter on a serial port"
            elif self._interface == "socketcan":
                up = f"sudo ip link set {self._channel} up type can bitrate {self._bitrate}"
                fix = f"plug the adapter in, then run {up}"
            raise refusal(self._owner, tty, exc, f"the bus does not open ({exc})", fix) from exc

    def close(self) -> None:
        """Leave the bus. Idempotent."""
        bus, self._bus = self._bus, None
        if bus is not None:
            with contextlib.suppress(*BUS_ERRORS):
                bus.shutdown()
            # the slcan bus of python-can leaves its port open if the last command to the adapter fails
            if port := getattr(bus, "serialPortOrig", None):
                with contextlib.suppress(*LINK_ERRORS):
                    port.close()
        lock, self._lock = self._lock, None
        if lock is not None:
            with contextlib.suppress(OSError):
                os.close(lock)

    def send(self, identifier: int, data: bytes) -> None:
        """Send one data frame; drop it silently if the adapter is too busy. Another failure raises `StreamBroken`."""
        if self._bus is None:
            raise StreamBroken(f"{self._owner}: the bus is closed", "open it first")
        timeout_s = self._clock.patience_s(_SEND_S)
        try:
            self._bus.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False), timeout=timeout_s)
        except BUS_ERRORS as exc:
            if not isinstance(exc.__cause__, serial.SerialTimeoutException):  # a time-out may be due to a busy computer
                raise self._broken(exc) from exc

    def receive(self, timeout_s: float) -> tuple[int, bytes] | None:
        """Wait for the next data frame of the device and return (identifier, data); None after the time-out.

        Raises `StreamBroken` if the bus is lost. Blocks also in an emulated cell: many short waits would delay polls.
        """
        for left_s in self._clock.looks(timeout_s):
            if frame := self.look(left_s):
                return frame
        return None

    def look(self, wait_s: float) -> tuple[int, bytes] | None:
        """Return the next data frame within `wait_s`, at most 0.05 s; else None. A lost bus raises `StreamBroken`."""
        if self._bus is None:
            raise StreamBroken(f"{self._owner}: the bus is closed", "open it first")
        while True:
            try:
                message = self._bus.recv(timeout=min(wait_s, _LOOK_S))
            except (ValueError, LookupError):
                self.malformed += 1
                return None
            except (can.CanError, *LINK_ERRORS) as exc:
                raise self._broken(exc) from exc
            if message is None:
                return None
            strange = message.is_extended_id or message.is_remote_frame or message.is_error_frame or message.is_fd
            if not strange and (not self._identifiers or message.arbitration_id in self._identifiers):
                return message.arbitration_id, bytes(message.data)

    def discard(self) -> None:
        """Drop all frames that have been received but not read. Raises `StreamBroken` if the bus is closed or lost."""
        if isinstance(self._bus, slcanBus):
            with contextlib.suppress(*BUS_ERRORS):  # the next `send` raises the error
                self._bus.flush()  # faster than `recv`, which waits 1 ms for each missing frame
            return
        for _ in self._clock.looks(_DISCARD_S):
            if self.look(0.0) is None:
                return

    def request(self, identifier: int, data: bytes, parts: Mapping[int, int], timeout_s: float = 0.25) -> bytes | None:
        """Send a request and return the first complete message, see `join_frames`; None after the time-out."""
        self.send(identifier, data)
        frames: list[CanFrame] = []
        for left_s in self._clock.looks(timeout_s):
            frame = self.look(min(left_s, self._clock.poll_s))
            if frame and len(frame[1]) == parts.get(frame[0]):
                frames.append(frame)
                if replies := join_frames(frames, parts):
                    return replies[0]
        return None

    def _broken(self, exc: Exception) -> StreamBroken:
        return StreamBroken(f"{self._owner}: the CAN interface was lost ({exc})", "plug it in and open it again")


@dataclass(frozen=True, slots=True)
class CanProbe:
    """Functions and identifiers with which a probe recognizes one kind of sensor on a CAN bus."""

    name: str
    url: str
    must_be_silent: AbstractSet[int]
    """Identifiers that no device may send before the sensor is asked, because they may be commands to other devices."""
    recognize: Callable[[Sequence[CanFrame]], str | None]
    """Returns what received frames show about the sensor; None if they are not its stream."""
    ask: Callable[[CanBus], str | None]
    """Sends read requests and returns what the sensor reports about itself; None without an answer."""


def join_frames(frames: Sequence[CanFrame], parts: Mapping[int, int]) -> list[bytes]:
    """Join frames into whole messages; return an empty list if a frame is out of order or of the wrong length.

    Parameters
    ----------
    parts : mapping
        Identifier and length in bytes of each frame of one message, in their order.
    """
    order = list(parts)
    if not frames or frames[0][0] not in order:
        return []
    begun = order.index(frames[0][0])
    for number, (identifier, data) in enumerate(frames, start=begun):
        if identifier != order[number % len(order)] or len(data) != parts[identifier]:
            return []
    whole = frames[-begun % len(order) :]
    return [
        b"".join(data for _, data in whole[start : start + len(order)])
        for start in range(0, len(whole) - len(order) + 1, len(order))
    ]
