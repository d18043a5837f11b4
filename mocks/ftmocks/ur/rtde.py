"""RTDE wire format, protocol version 2: packages, types and recipes. It uses no sockets.

Source: Universal Robots, "Real-Time Data Exchange (RTDE) Guide". All numbers are big-endian.
"""

import struct
from collections.abc import Iterator, Sequence

VERSION, CONTROLLER_VERSION, SETUP_OUTPUTS, SETUP_INPUTS = ord("V"), ord("v"), ord("O"), ord("I")
START, PAUSE, DATA, TEXT = ord("S"), ord("P"), ord("U"), ord("M")

_HEADER = struct.Struct(">HB")

TYPES = {
    "BOOL": "?",
    "UINT8": "B",
    "UINT32": "I",
    "UINT64": "Q",
    "INT32": "i",
    "DOUBLE": "d",
    "VECTOR3D": "3d",
    "VECTOR6D": "6d",
    "VECTOR6INT32": "6i",
    "VECTOR6UINT32": "6I",
}
"""Format of `struct` by the name of an RTDE type."""

Number = bool | int | float
Value = Number | Sequence[Number]


class RtdeError(Exception):
    """The received bytes are not RTDE packages."""


def package(kind: int, payload: bytes = b"") -> bytes:
    """Return the bytes of a package: total size, type, payload."""
    return _HEADER.pack(_HEADER.size + len(payload), kind) + payload


def take_packages(buffer: bytearray) -> Iterator[tuple[int, bytes]]:
    """Remove and yield every complete package (type, payload) at the start of `buffer`.

    Raises
    ------
    RtdeError
        The size in a header is smaller than the header, so the next package cannot be found.
    """
    while len(buffer) >= _HEADER.size:
        size, kind = _HEADER.unpack_from(buffer)
        if size < _HEADER.size:
            raise RtdeError(f"a package announces {size} bytes, less than its own header")
        if len(buffer) < size:
            return
        payload = bytes(buffer[_HEADER.size : size])
        del buffer[:size]
        yield kind, payload


def names_in(text: bytes) -> list[str]:
    """Return the variable names of a set-up request, which may end with a comma."""
    return [name for name in text.decode("ascii", "replace").split(",") if name]


class Recipe:
    """Order and packing of the variables in a data package.

    Parameters
    ----------
    names, types
        Variables and their RTDE types in their order. NOT_FOUND and IN_USE make the recipe invalid.
    """

    def __init__(self, recipe_id: int, names: Sequence[str], types: Sequence[str]) -> None:
        self.recipe_id = recipe_id
        self.names = list(names)
        self.types = list(types)
        self.valid = bool(types) and all(kind in TYPES for kind in types)
        self._packing = struct.Struct(">" + "".join(TYPES[kind] for kind in types) if self.valid else ">")
        self._widths = [struct.Struct(">" + TYPES[kind]) for kind in types] if self.valid else []
        self.size = self._packing.size
        """Number of bytes of a payload after the recipe id."""

    def answer(self) -> bytes:
        """Return the payload of the reply to the set-up request for this recipe."""
        return bytes([self.recipe_id]) + ",".join(self.types).encode("ascii")

    def pack(self, values: Sequence[Value]) -> bytes:
        """Return the bytes of a data package with its header."""
        flat: list[Number] = []
        for value in values:
            if isinstance(value, (bool, int, float)):
                flat.append(value)
            else:
                flat.extend(value)
        return package(DATA, bytes([self.recipe_id]) + self._packing.pack(*flat))

    def unpack(self, payload: bytes) -> dict[str, Value]:
        """Decode the fields of a payload of at least `size` bytes, which follows the recipe id."""
        fields: dict[str, Value] = {}
        offset = 0
        for name, width in zip(self.names, self._widths, strict=True):
            numbers = width.unpack_from(payload, offset)
            fields[name] = numbers[0] if len(numbers) == 1 else numbers
            offset += width.size
        return fields
