"""Numbers in words: a sigma has two significant digits, and its value ends at the same place."""

import math
from typing import Final, SupportsFloat

MOST_DECIMALS: Final = 9
# Decimals of a value whose sigma is zero or not known.
_UNKNOWN: Final = 4


def decimals(sigma: float) -> int:
    """Return how many decimals show two significant digits of a sigma.

    Examples
    --------
    >>> decimals(0.0123), decimals(0.0996), decimals(12.3)
    (3, 2, 0)
    """
    if not (math.isfinite(sigma) and sigma > 0):
        return _UNKNOWN
    exponent = int(f"{sigma:.1e}".partition("e")[2])
    return min(max(1 - exponent, 0), MOST_DECIMALS)


def to_place_of(value: SupportsFloat, sigma: float, sign: str = "") -> str:
    """Write a value to the last place of its sigma; of the sigma itself, two significant digits.

    Examples
    --------
    >>> to_place_of(1.18652, 0.00108), to_place_of(0.00108, 0.00108)
    ('1.1865', '0.0011')
    """
    return f"{float(value):{sign}.{decimals(sigma)}f}"


def with_sigma(value: SupportsFloat, sigma: float, sign: str = "") -> str:
    """Write a value with its sigma.

    Examples
    --------
    >>> with_sigma(1.18652, 0.00108), with_sigma(-0.2, 47.1)
    ('1.1865 ± 0.0011', '-0 ± 47')
    """
    return f"{to_place_of(value, sigma, sign)} ± {to_place_of(sigma, sigma)}"


def counted(number: int, noun: str) -> str:
    """Write a number with its noun.

    Examples
    --------
    >>> counted(1, "result"), counted(2, "result")
    ('1 result', '2 results')
    """
    return f"{number} {noun}{'' if number == 1 else 's'}"
