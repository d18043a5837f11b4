"""Frames in a stream of bytes: their boundaries, checksums and status words."""

from collections.abc import Callable, Mapping

ENOUGH_FRAMES = 5  # intact frames in a row that identify the stream of a sensor


def _table(polynomial: int) -> tuple[int, ...]:
    def entry(byte: int) -> int:
        for _ in range(8):
            byte = byte >> 1 ^ (polynomial if byte & 1 else 0)
        return byte

    return tuple(entry(byte) for byte in range(256))


_MODBUS, _X25 = _table(0xA001), _table(0x8408)


def crc16_modbus(data: bytes) -> int:
    """Return the checksum CRC-16/MODBUS; the check value, that of ``b"123456789"``, is 0x4B37."""
    return _crc(data, _MODBUS)


def crc16_x25(data: bytes) -> int:
    """Return the checksum CRC-16/X-25; the check value, that of ``b"123456789"``, is 0x906E."""
    return _crc(data, _X25) ^ 0xFFFF


def _crc(data: bytes, table: tuple[int, ...]) -> int:
    crc = 0xFFFF
    for byte in data:
        crc = crc >> 8 ^ table[(crc ^ byte) & 0xFF]
    return crc


class Deframer:
    """Divides a byte stream into intact frames and numbers them.

    After a false header the search continues at the next byte, so the next true frame is found. Dropped bytes are
    counted as damaged frames, at least one per interruption. Bytes before the first frame are not counted, because
    reading often starts in the middle of a stream.

    Parameters
    ----------
    header : bytes
        First bytes of every frame.
    size : int
        Length of a whole frame.
    is_intact : callable
        Returns whether `size` bytes that begin with the header are an intact frame, by checksum and end mark.
    """

    def __init__(self, header: bytes, size: int, is_intact: Callable[[bytes], bool]) -> None:
        self._header = header
        self._size = size
        self._is_intact = is_intact
        self._buffer = bytearray()
        self._skipped = 0
        self.number = 0
        """Number of the newest frame. Damaged frames are counted as well."""
        self.damaged = 0

    def feed(self, data: bytes) -> list[tuple[int, bytes]]:
        """Add received bytes; return the completed frames as a list of (number, frame)."""
        # The header may occur within a frame, because it is not escaped: after a wrong checksum, try the next byte.
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
        """Phrase for error messages that describes which data have arrived so far."""
        if self.number:
            return f"{self.number - self.damaged} frames arrived"
        return f"bytes arrived, but no frames of {self._size} bytes" if self.has_noise else "no bytes arrived"

    @property
    def has_noise(self) -> bool:
        """Whether bytes have arrived, but no intact frame: a sign of a wrong baud rate or of another device."""
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
    """Return a function that checks whether bytes contain enough intact frames to identify a stream."""
    return lambda data: len(deframer().feed(data)) >= ENOUGH_FRAMES


def describe_status(status: int, bits: Mapping[int, str], width: int = 16) -> str:
    """Return a status word of `width` bits with the meaning of each set bit: ``0x0040 (bit 6: EEPROM error)``."""
    words = [f"bit {n}: {bits.get(n, 'reserved')}" for n in range(width) if status >> n & 1]
    return f"0x{status:0{width // 4}X} ({', '.join(words) or 'ok'})"
