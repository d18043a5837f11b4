"""Tables of numbers as CSV: the quick reader and `numpy.loadtxt` find the same numbers, and the same errors."""

import warnings
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from ftcalib.errors import BadDataset
from ftdrive.recording import csv_pair
from ftdrive.recording.csv_pair import WRENCH, Part, mean_rate_Hz, parse_numbers, read_table
from ftdrivers.interfaces import Array

_PARTS = ["0", "1", "97", ".", "-", "e", "+", ",", "\n", "1.5", "-2.25", "1e-05", "7,8", "\r\n", " ", "#", "inf", "E"]
LIKE_NUMBERS = st.lists(st.sampled_from(_PARTS), min_size=1, max_size=12).map("".join)
TABLES = st.lists(
    st.lists(st.floats(allow_nan=False), min_size=3, max_size=3).map(lambda row: ",".join(map(repr, row))), min_size=1
).map("\n".join)


def by_numpy(text: str, use: list[int]) -> Array | None:
    """Return columns (k, n); None if this is no table."""
    with warnings.catch_warnings(action="ignore"):  # of a text without a number
        try:
            return np.loadtxt(text.replace("\r\n", "\n").splitlines(), delimiter=",", usecols=use, ndmin=2).T
        except ValueError:
            return None


@given(text=LIKE_NUMBERS | TABLES, columns=st.integers(1, 3))
@example(text="1.2.3\n4\n", columns=1)
@example(text="1-2,3\n", columns=2)
@example(text="1e,3e+-4\n", columns=2)
@example(text="-,.\n", columns=2)
@example(text="1,2,3\n4\n5,6\n", columns=2)
def test_both_readers_find_the_same_bits_or_none(text: str, columns: int) -> None:
    use = list(range(columns))
    expected = by_numpy(text, use)
    with warnings.catch_warnings(action="ignore"):
        try:
            found = parse_numbers(text.encode(), columns, use)
        except ValueError:
            assert expected is None
        else:
            assert expected is not None
            np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("text", ["1.5,-2\n-.25,3.\n", "1.0e-05,-2e+10\r\n3e5,0", "0.1234567890123456789,5e-324\n"])
def test_decimals_need_no_slow_reader(text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    expected = by_numpy(text, [1, 0])
    monkeypatch.delattr(np, "loadtxt")
    np.testing.assert_array_equal(parse_numbers(text.encode(), 2, [1, 0]), expected)


def test_a_long_table_is_read_in_parts_up_to_its_fault(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(csv_pair, "_READ_BYTES", 1 << 18)
    path = tmp_path / "w.csv"
    rows = np.c_[np.arange(4000) / 1000, np.random.default_rng(3).normal(0, 10, (4000, 6))]
    with path.open("w") as file:
        file.write("seq,t,fx,fy,fz,tx,ty,tz\n")
        np.savetxt(file, np.c_[np.arange(len(rows)), rows], delimiter=",")
    parts = list(read_table(path, WRENCH))
    assert len(parts) > 2
    np.testing.assert_array_equal(np.concatenate([part.t_s for part in parts]), rows[:, 0])
    np.testing.assert_array_equal(np.concatenate([part.numbers for part in parts]), rows[:, 1:])
    assert parts[-1].place == path.stat().st_size
    assert mean_rate_Hz(path, WRENCH) == pytest.approx(1000)
    content = path.read_text()
    for line, words in (
        ("1,4,1,2,3,4,5,6.7.8", r"'6\.7\.8'.* row \d+, column 8"),
        ("1,4", "column index 2"),
    ):
        path.write_text(f"{content}{line}\n")
        valid = list[Part]()
        with pytest.raises(BadDataset, match=rf"{words}.*correct this line") as error:
            valid.extend(read_table(path, WRENCH))
        assert 0 < len(valid) < len(parts)
        assert f"w.csv, after row {sum(len(part.t_s) for part in valid)}: " in str(error.value)


def test_a_first_row_without_end_is_refused_in_a_line(tmp_path: Path) -> None:
    path = tmp_path / "w.csv"
    path.write_text("t," + "x" * 140_000 + "\n0,1\n")
    with pytest.raises(BadDataset, match=r"w\.csv: the first row is no list of columns"):
        list(read_table(path, WRENCH))
    path.write_text(",".join(f"x{i}" for i in range(100_000)) + "\n")
    with pytest.raises(BadDataset, match=r"x0, x1, .* and 99980 more") as raised:
        list(read_table(path, WRENCH))
    assert len(str(raised.value)) < 300
