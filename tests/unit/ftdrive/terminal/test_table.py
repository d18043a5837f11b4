"""A table in wide and narrow terminals, and in a pipe."""

from collections.abc import Callable

import pytest

from ftdrive.terminal.text import print_table

TITLES = ("cell", "tool", "due")
ROWS = [("press-4", "a gripper with a long name", "now"), ("b", "", "in 5 d")]


Printed = Callable[[int | None], list[str]]


@pytest.fixture
def printed(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Printed:
    """Print the table to a terminal with so many columns, or to a pipe."""

    def run(columns: int | None) -> list[str]:
        monkeypatch.setattr("sys.stdout.isatty", lambda: columns is not None)
        monkeypatch.setenv("COLUMNS", str(columns or 10))
        monkeypatch.setenv("NO_COLOR", "1")
        print_table(TITLES, ROWS, folding={"tool"})
        return capsys.readouterr().out.splitlines()

    return run


@pytest.mark.parametrize("columns", [26, 22, 12])
def test_no_word_is_ever_broken(columns: int, printed: Printed) -> None:
    words = {word for row in ROWS for text in row for word in text.split()}
    assert words <= {word for line in printed(columns)[1:] for word in line.split()}
