"""The text of a vendor's status word."""

from collections.abc import Mapping


def describe_status(status: int, bits: Mapping[int, str], width: int = 16) -> str:
    """Describe a status word of `width` bits, such as ``0x0040 (bit 6: no valid calibration in the active slot)``."""
    words = [f"bit {n}: {bits.get(n, 'reserved')}" for n in range(width) if status >> n & 1]
    return f"0x{status:0{width // 4}X} ({', '.join(words) or 'ok'})"
