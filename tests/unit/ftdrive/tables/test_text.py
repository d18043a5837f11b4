"""Text tables: the numbers are those of `numpy.loadtxt`, whatever the dialect; faults are named with their line."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ftcalib.errors import BadDataset
from ftdrive.tables.table import Table
from ftdrive.tables.text import TextTable

ROWS = st.lists(st.lists(st.floats(allow_nan=False), min_size=3, max_size=3), min_size=1, max_size=9)
DIALECTS = st.sampled_from([(",", "."), (";", "."), (";", ","), ("\t", "."), ("\t", ","), ("  ", "."), (" ", ",")])


@given(rows=ROWS, dialect=DIALECTS, names=st.booleans(), end=st.sampled_from(["\n", "\r\n", ""]))
def test_every_bit_is_kept_in_each_dialect(
    rows: list[list[float]], dialect: tuple[str, str], names: bool, end: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    separator, decimal = dialect
    lines = [separator.join("abc")] if names else []
    lines += [separator.join(repr(value).replace(".", decimal) for value in row) for row in rows]
    path = tmp_path_factory.mktemp("text") / "t.csv"
    path.write_text((end or "\n").join(lines) + end, newline="")
    table = TextTable(path)
    assert list(table.names) == (list("abc") if names else ["1", "2", "3"])
    found = np.concatenate([block for block, _ in table.blocks([2, 0])])
    np.testing.assert_array_equal(found, np.array(rows)[:, [2, 0]])


@pytest.mark.parametrize(
    "line", ["+1.5,.5,2.", " 1.5 , .5,2", "1.5,.5,2,", '"1.5","0.5",2', "1.5e0,5E-1,2", "1.5,.5,2\n\n# a comment\n"]
)
def test_a_number_may_be_written_in_several_ways(line: str, tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text(f"a,b,c\n0,0,0\n{line}\n1,1,1\n")
    (block, share), *_ = TextTable(tmp_path / "t.csv").blocks([0, 1, 2])
    np.testing.assert_array_equal(block[1], [1.5, 0.5, 2])
    assert share == 1.0


def test_a_first_row_without_end_is_refused_in_a_line(tmp_path: Path) -> None:
    path = tmp_path / "w.csv"
    for content in ("t," + "x" * 140_000 + "\n0,1\n", ",".join(f"x{i}" for i in range(100_000)) + "\n"):
        path.write_text(content)
        with pytest.raises(BadDataset, match=r"w\.csv: no row has two numbers") as raised:
            Table(path)
        assert len(str(raised.value)) < 300
