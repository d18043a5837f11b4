"""Frames of fixed size in a stream of bytes, whose header may also occur in the data."""

from collections.abc import Callable


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

    def _next_number(self) -> int:
        if self._skipped and self.number:
            missing = max(1, round(self._skipped / self._size))
            self.damaged += missing
            self.number += missing
        self._skipped = 0
        self.number += 1
        return self.number
