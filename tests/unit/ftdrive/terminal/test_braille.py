"""Plots of dots."""

import numpy as np

from ftdrive.terminal.lines import characters, envelope


def drawn(low: list[float], high: list[float], rows: int, full: float) -> list[str]:
    return ["".join(row) for row in characters(envelope(np.array(low), np.array(high), rows, full))]


def test_the_bits_are_those_of_unicode() -> None:
    for dot, code in enumerate((0x01, 0x02, 0x04, 0x40, 0x08, 0x10, 0x20, 0x80)):  # dots 1, 2, 3, 7, 4, 5, 6, 8
        dots = np.zeros((4, 2), np.bool_)
        dots[dot % 4, dot // 4] = True
        assert characters(dots)[0, 0] == chr(0x2800 + code)


def test_a_step_is_joined_and_a_gap_is_not() -> None:
    assert drawn([-1.0, 1.0], [-1.0, 1.0], 1, 1.0) == ["⣸"]
    assert drawn([0.0, np.nan, 0.0, 0.0], [0.0, np.nan, 0.0, 0.0], 1, 1.0) == ["⠄⠤"]
