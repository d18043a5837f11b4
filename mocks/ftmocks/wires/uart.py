"""Wrong parity of a byte, and its mark as a terminal sends it to the client.

Ref: POSIX.1-2017, section 11.2.2 (INPCK, PARMRK).

Does not model: more than one wrong parity in a frame, framing errors, breaks.
"""

from typing import Self, SupportsIndex, overload


class WrongParity(bytes):
    """Bytes of which one arrives with wrong parity. A slice keeps this property.

    Parameters
    ----------
    data
        The bytes as read by a receiver that does not check parity.
    at
        Index of the byte with wrong parity.
    """

    at: int

    def __new__(cls, data: bytes, at: int) -> Self:
        """Create the bytes, one of which has wrong parity."""
        self = super().__new__(cls, data)
        self.at = at
        return self

    @overload
    def __getitem__(self, index: SupportsIndex) -> int: ...

    @overload
    def __getitem__(self, index: slice) -> bytes: ...

    def __getitem__(self, index: SupportsIndex | slice) -> int | bytes:
        if not isinstance(index, slice):
            return super().__getitem__(index)
        part, origin = super().__getitem__(index), range(len(self))[index]
        return WrongParity(part, origin.index(self.at)) if self.at in origin else part


def marked(data: bytes) -> bytes:
    r"""Return bytes as a client with INPCK and PARMRK reads them: \377 doubled, and \377 \0 before wrong parity."""
    if isinstance(data, WrongParity):
        return marked(data[: data.at]) + bytes([0xFF, 0, data[data.at]]) + marked(data[data.at + 1 :])
    return data.replace(b"\xff", b"\xff\xff")
