"""Formatting of numbers with a sigma: the sigma has two significant digits, the value the same number of decimals."""

import math
from typing import Final, SupportsFloat

MOST_DECIMALS: Final = 9
# Number of decimals with which a value is shown if its sigma is zero or unknown.
_UNKNOWN: Final = 4


def decimals(sigma: float) -> int:
    """Return the number of decimals that shows two significant digits of a sigma.

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
    """Return a value as text, rounded to the last decimal of its sigma.

    Examples
    --------
    >>> to_place_of(1.18652, 0.00108), to_place_of(0.00108, 0.00108)
    ('1.1865', '0.0011')
    """
    return f"{float(value):{sign}.{decimals(sigma)}f}"


def with_sigma(value: SupportsFloat, sigma: float, sign: str = "") -> str:
    """Return a value with its sigma as text.

    Examples
    --------
    >>> with_sigma(1.18652, 0.00108), with_sigma(-0.2, 47.1)
    ('1.1865 ± 0.0011', '-0 ± 47')
    """
    return f"{to_place_of(value, sigma, sign)} ± {to_place_of(sigma, sigma)}"


def counted(number: int, noun: str) -> str:
    """Return a number with its noun, in the plural if needed.

    Examples
    --------
    >>> counted(1, "result"), counted(2, "result")
    ('1 result', '2 results')
    """
    return f"{number} {noun}{'' if number == 1 else 's'}"
