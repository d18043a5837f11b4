"""The rows of the hazard table."""

import re
from pathlib import Path

from ftdrive.session.events import Hazard

ROOT = Path(__file__).parents[4]
PAGE = ROOT / "docs/reference/hazards.md"


def test_the_table_has_a_row_for_each_hazard() -> None:
    assert [int(row) for row in re.findall(r"^\| (\d+) \|", PAGE.read_text(encoding="utf-8"), re.MULTILINE)] == list(
        Hazard
    )


def test_the_tests_that_the_page_names_exist() -> None:
    text = PAGE.read_text(encoding="utf-8")
    named = [
        name for row in re.findall(r"^\| row \d+ \|(.*)", text, re.MULTILINE) for name in re.findall(r"`([^`]+)`", row)
    ]
    assert len(named) > 50
    code = "".join(file.read_text(encoding="utf-8") for file in (ROOT / "tests").rglob("test_*.py"))
    assert [name for name in named if name not in code] == []
