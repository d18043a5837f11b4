"""No row of a table is lost without a word: whatever ends its lines, stands above it, or is damaged in it."""

import tracemalloc
from itertools import cycle, product
from pathlib import Path

import numpy as np
import pytest

from ftcalib.errors import BadDataset
from ftdrive.tables.table import Table
from ftdrive.tables.text import TextTable
from tests.unit.ftdrive.tables.test_layouts import CASES, POSES, W, quaternion, t, text, wrench

PLAIN = text(t(POSES) | wrench(POSES) | quaternion(POSES))
# Unicode calls all of these line breaks; in a file they are characters of a cell.
NO_ENDS = "\v\f\x1c\x1d\x1e\x85\u2028\u2029"
ENDS = {"LF": "\n", "CR LF": "\r\n", "CR": "\r"}
ABOVE = {
    "nothing": "",
    "comment": "# recorded by hand\n",
    "blank lines": "\n\n \n",
    "comment with other breaks": f"# first{NO_ENDS}second\n",
    "comments and blanks": "% a\n\n% b\n",
}
ENCODINGS = ("utf-8", "utf-8-sig", "utf-16")


def rows_of(path: Path, name: str) -> np.ndarray:
    table = Table(path, CASES[name]().options)
    use = range(len(table.source.names))
    return np.concatenate([block for block, _ in table.source.blocks(use)])


@pytest.mark.parametrize("name", [name for name in CASES if isinstance(CASES[name]().content, str)])
def test_no_line_end_and_nothing_above_the_names_loses_a_row(name: str, tmp_path: Path) -> None:
    content = str(CASES[name]().content).replace("\r\n", "\n")
    path = tmp_path / "t.csv"
    path.write_text(content, newline="")
    expected = rows_of(path, name)
    assert len(expected) in (24, 600, 1200)
    ways = zip(product(ENDS.values(), ABOVE.values()), cycle(ENCODINGS), strict=False)
    for (end, above), encoding in list(ways)[sorted(CASES).index(name) % 5 :: 5]:  # all of them in five tables
        path.write_bytes((above + content).replace("\n", end).encode(encoding))
        np.testing.assert_array_equal(rows_of(path, name), expected)


@pytest.mark.parametrize(
    ("above", "decimal"), [("point", ","), ("comma", "."), ("semicolons", ","), ("tabs", ","), ("spaces", ".")]
)
def test_first_rows_that_are_written_in_another_way_are_named(above: str, decimal: str, tmp_path: Path) -> None:
    table = t(POSES) | wrench(POSES) | quaternion(POSES)
    separator = "\t" if above == "semicolons" else ";"
    rows = text(table, separator, decimal).splitlines()
    other = dict(zip(("point", "comma", "semicolons", "tabs", "spaces"), (";.", ";,", ";,", "\t,", " ."), strict=True))
    rows[1:3] = text(table, *other[above]).splitlines()[1:3]
    path = tmp_path / "t.csv"
    path.write_text("\n".join(rows) + "\n")
    with pytest.raises(BadDataset, match=r"^t\.csv: line 2 is a row with .*rows below have .*use one format$"):
        Table(path)


def test_the_rows_that_were_left_out_are_counted(tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    path.write_text(PLAIN)
    table = Table(path)
    assert len(table.dataset().wrench) == 24
    assert table.words == ""  # the result says how many poses it has
    blank = PLAIN.splitlines()
    blank[3] = blank[3].split(",")[0] + "," * 10
    path.write_text("\n".join(blank))
    table = Table(path)
    assert table.dataset().wrench.shape == (23, 6)
    assert table.words == "1 of 24 rows without wrench or orientation left out"
    path.write_text(PLAIN.replace("\n32.0,", "\n# 32.0,"))
    table = Table(path)
    assert len(table.dataset().wrench) == 23
    assert table.words == "1 commented lines between the rows left out"


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 12))])
def test_a_damaged_table_is_read_whole_or_named(seed: int, tmp_path: Path) -> None:
    """A hundred mutations: every row that is still whole is read, or one sentence says what is wrong."""
    rng = np.random.default_rng(seed)
    path = tmp_path / "t.csv"
    pieces = [*"\n\r\t,;. #%\"'", "\r\n", "\0", "nan", "-", "1,5", "é", *NO_ENDS, "x" * 300]
    for _ in range(100):
        characters = list(PLAIN)
        for _ in range(rng.integers(1, 4)):
            at = int(rng.integers(len(characters)))
            characters[at : at + int(rng.integers(0, 3))] = [str(rng.choice(pieces))]
        content = "".join(characters)
        path.write_text(content, newline="", encoding="utf-8")
        words = ""
        try:
            table = Table(path)
            read = table.dataset().wrench
        except BadDataset as error:
            words = str(error)
        if words:
            assert len(words) < 600
            assert "\n" not in words
            continue
        kept = [row for row in POSES.wrench if f",{','.join(repr(float(value)) for value in row)}," in content]
        lost = [row for row in kept if not (np.abs(read - row).max(axis=1) == 0).any()]
        assert not lost or "left out" in table.words, content


def test_an_impossible_date_is_named_and_a_blank_may_stand_before_its_zone(tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    path.write_text("t,fx\n" + "2026-01-01 12:00:00 Z,1\n" * 40)
    ((values, _),) = TextTable(path).blocks([0, 1])
    assert values.tolist() == [[1_767_268_800, 1]] * 40
    for date in ("2026-13-01 12:00:00", "2026-01-01 25:00:00 Z"):
        path.write_text("t,fx\n2026-01-01 12:00:00,1\n" + f"{date},1\n")
        with pytest.raises(BadDataset, match=f"line 3: t is '{date}', which is not a number: correct or delete"):
            list(TextTable(path).blocks([0, 1]))


def test_a_file_without_line_ends_is_not_read_whole(tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    for encoding in ("utf-8", "utf-16"):
        with path.open("w", encoding=encoding) as file:
            file.write(PLAIN)
            for _ in range(64):
                file.write("1" * (1 << 20))
        tracemalloc.start()
        with pytest.raises(BadDataset, match=r"is longer than|is no number|has 1 values"):
            Table(path).dataset()
        assert tracemalloc.get_traced_memory()[1] < 120e6
        tracemalloc.stop()


def test_a_file_of_named_columns_alone_is_refused(tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text("\r".join(f"{name}," for name in W.split()))
    with pytest.raises(BadDataset, match="no row has two numbers"):
        Table(tmp_path / "t.csv")
