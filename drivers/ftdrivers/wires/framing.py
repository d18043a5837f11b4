"""Frames in a stream of bytes: their limits, checksums and status words."""

from collections.abc import Callable, Mapping


def _table(polynomial: int) -> tuple[int, ...]:
    def entry(byte: int) -> int:
        for _ in range(8):
            byte = byte >> 1 ^ (polynomial if byte & 1 else 0)
        return byte

    return tuple(entry(byte) for byte in range(256))


_MODBUS, _X25 = _table(0xA001), _table(0x8408)


def crc16_modbus(data: bytes) -> int:
    """CRC-16/MODBUS; of ``b"123456789"`` it is 0x4B37."""
    return _crc(data, _MODBUS)


def crc16_x25(data: bytes) -> int:
    """CRC-16/X-25; of ``b"123456789"`` it is 0x906E."""
    return _crc(data, _X25) ^ 0xFFFF


def _crc(data: bytes, table: tuple[int, ...]) -> int:
    crc = 0xFFFF
    for byte in data:
        crc = crc >> 8 ^ table[(crc ^ byte) & 0xFF]
    return crc


class Deframer:
    """Cuts a byte stream into intact frames and numbers them.

    Behind a false header the search continues one byte later, so the next true frame is still found. Dropped bytes are
    counted as whole frames, at least one for each interruption. Bytes before the first frame are not counted, because a
    stream is often joined in its middle.

    Parameters
    ----------
    header : bytes
        First bytes of every frame.
    size : int
        Length of a whole frame.
    is_intact : callable
        Returns whether `size` bytes that begin with the header are a frame: checksum, end mark.
    """

    def __init__(self, header: bytes, size: int, is_intact: Callable[[bytes], bool]) -> None:
        self._header = header
        self._size = size
        self._is_intact = is_intact
        self._buffer = bytearray()
        self._skipped = 0
        self.number = 0
        """Number of the newest frame; damaged frames are counted too."""
        self.damaged = 0

    def feed(self, data: bytes) -> list[tuple[int, bytes]]:
        """Take received bytes and return the frames that they complete as (number, frame)."""
        # A header occurs in data and nothing is escaped: after a failed checksum the search continues one byte later.
        buffer, at = self._buffer, 0
        buffer += data
        frames = []
        while True:
            start = buffer.find(self._header, at)
            found = start >= 0
            if not found:  # the last bytes may be the beginning of a header
                start = max(at, len(buffer) - len(self._header) + 1)
            self._skipped += start - at
            at = start
            if not found or len(buffer) - at < self._size:
                break
            frame = bytes(buffer[at : at + self._size])
            if self._is_intact(frame):
                at += self._size
                frames.append((self._next_number(), frame))
            else:
                at += 1
                self._skipped += 1
        del buffer[:at]
        return frames

    @property
    def arrived(self) -> str:
        """What has arrived so far, in words."""
        if self.number:
            return f"{self.number - self.damaged} frames arrive"
        return f"bytes arrive, but no frames of {self._size} bytes" if self.has_noise else "no bytes arrive"

    @property
    def has_noise(self) -> bool:
        """Whether bytes have arrived, but no frame, as with another baud rate or another device."""
        return not self.number and bool(self._skipped or self._buffer)

    def _next_number(self) -> int:
        if self._skipped and self.number:
            missing = max(1, round(self._skipped / self._size))
            self.damaged += missing
            self.number += missing
        self._skipped = 0
        self.number += 1
        return self.number


def is_stream(deframer: Callable[[], Deframer]) -> Callable[[bytes], bool]:
    """Build the test whether received bytes hold five intact frames or more, which identify a stream."""
    return lambda data: len(deframer().feed(data)) >= 5


def describe_status(status: int, bits: Mapping[int, str], width: int = 16) -> str:
    """Describe a status word of `width` bits, such as ``0x0040 (bit 6: no valid calibration in the active slot)``."""
    words = [f"bit {n}: {bits.get(n, 'reserved')}" for n in range(width) if status >> n & 1]
    return f"0x{status:0{width // 4}X} ({', '.join(words) or 'ok'})"
