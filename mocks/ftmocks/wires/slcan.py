"""A CAN adapter on a serial port that exchanges bus frames as ASCII lines.

Ref: LAWICEL CAN232 manual, version 3 ("slcan"): S, O, L, C, t, T, r, R, F, V, N and the empty line; CR accepts, BEL
refuses, ``z`` and ``Z`` confirm a transmission.

Does not model: bus timing and arbitration, bit timing registers (s), time stamps (Z), filters (M, m), polling (A, P,
X), CAN FD.
"""

import re
from typing import NamedTuple

BITRATES = {
    b"S0": 10_000,
    b"S1": 20_000,
    b"S2": 50_000,
    b"S3": 100_000,
    b"S4": 125_000,
    b"S5": 250_000,
    b"S6": 500_000,
    b"S7": 800_000,
    b"S8": 1_000_000,
}
OK, REFUSED = b"\r", b"\a"
_LONGEST_LINE = len("T1111222281122334455667788")
_DATA_FRAME = re.compile(rb"(?:t([0-7][0-9A-F]{2})|T([01][0-9A-F]{7}))([0-8])((?:[0-9A-F]{2})*)", re.IGNORECASE)
_REMOTE_FRAME = re.compile(rb"(?:r([0-7][0-9A-F]{2})|R([01][0-9A-F]{7}))([0-8])", re.IGNORECASE)


class CanFrame(NamedTuple):
    """One CAN 2.0 frame; a remote frame carries no data."""

    identifier: int
    data: bytes = b""
    extended: bool = False
    remote: bool = False


class SlcanAdapter:
    """The adapter's state machine, which converts lines to answers and bus frames, without I/O."""

    def __init__(self) -> None:
        self.bitrate: int | None = None
        self.is_open = False
        self.listen_only = False
        self.bus_error = False
        self._line = bytearray()

    def feed(self, data: bytes) -> tuple[bytes, list[CanFrame]]:
        """Process bytes from the host; return the answers to the host and the frames that it sends on the bus."""
        answers = bytearray()
        frames: list[CanFrame] = []
        *complete, rest = (self._line + data).split(b"\r")
        for line in complete:
            answer, frame = self._execute(bytes(line))
            answers += answer
            if frame is not None:
                frames.append(frame)
        self._line = rest[
            : _LONGEST_LINE + 1
        ]  # a line that is too long is refused at its CR; its rest is dropped to save memory
        return bytes(answers), frames

    def line(self, frame: CanFrame) -> bytes:
        """Return the line that reports a frame on the bus; nothing while the channel is closed."""
        if not self.is_open:
            return b""
        head = f"T{frame.identifier:08X}" if frame.extended else f"t{frame.identifier:03X}"
        return f"{head}{len(frame.data)}{frame.data.hex().upper()}\r".encode("ascii")

    def _execute(self, line: bytes) -> tuple[bytes, CanFrame | None]:
        if line[:1] in (b"t", b"T", b"r", b"R"):
            return self._transmit(line)
        if line in BITRATES and not self.is_open:
            self.bitrate = BITRATES[line]
            return OK, None
        match line:
            case b"":
                return OK, None
            case b"O" | b"L" if self.bitrate is not None and not self.is_open:
                self.is_open, self.listen_only = True, line == b"L"
                return OK, None
            case b"C" if self.is_open:
                self.is_open = False
                return OK, None
            case b"F" if self.is_open:
                flags, self.bus_error = b"F80\r" if self.bus_error else b"F00\r", False
                return flags, None
            case b"V":
                return b"V1013\r", None
            case b"N":
                return b"NEMUL\r", None
        return REFUSED, None

    def _transmit(self, line: bytes) -> tuple[bytes, CanFrame | None]:
        data_frame, remote_frame = _DATA_FRAME.fullmatch(line), _REMOTE_FRAME.fullmatch(line)
        found = data_frame or remote_frame
        if found is None or not self.is_open or self.listen_only:
            return REFUSED, None
        data = bytes.fromhex(found[4].decode("ascii")) if data_frame else b""
        if data_frame and len(data) != int(found[3]):
            return REFUSED, None
        extended = found[1] is None
        frame = CanFrame(int(found[2] if extended else found[1], 16), data, extended, remote_frame is not None)
        return (b"Z\r" if extended else b"z\r"), frame
