"""A report as Markdown: the same sentences, tables and captions, without figures."""

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from ftdrive.report.document import Section, Table
from ftdrive.report.words import capital


def markdown(facts: Mapping[str, Any], sections: Sequence[Section]) -> str:
    """Write the report; what a file or a device named cannot become markup."""
    return "\n".join(_lines(facts, sections)) + "\n"


def _lines(facts: Mapping[str, Any], sections: Sequence[Section]) -> Iterator[str]:
    yield f"# Calibration {facts['id']}: {', '.join([facts['verdict'].upper(), *facts['marks']])}\n"
    if facts["about"]:
        yield f"{_escaped(facts['about'])}.\n"
    yield f"Compensation error {_escaped(facts['error']['words'])}.\n"
    if facts["trust"]:
        yield f"{_escaped(capital(facts['trust']['words']))}.\n"
    remarks = [*facts["marks"].values(), *(one["words"] for one in [*facts["findings"], *facts["hints"]])]
    yield from (f"* {_escaped(capital(one))}" for one in remarks)
    yield f"\n**Next:** {_escaped(facts['next_step'])}\n"
    for section in sections:
        yield f"## {section.title}\n"
        yield from (f"{_escaped(one)}\n" for one in section.text)
        for table in section.tables:
            yield from _table(table)


def _table(table: Table) -> Iterator[str]:
    if table.caption:
        yield f"{_escaped(table.caption)}:\n"
    yield _row(table.columns)
    numbers = "---:" if len(table.columns) > 2 else "---"
    yield _row(["---", *[numbers] * (len(table.columns) - 1)], escape=False)
    yield from map(_row, table.rows)
    yield ""


def _row(cells: Sequence[str], *, escape: bool = True) -> str:
    return f"| {' | '.join(map(_escaped, cells) if escape else cells)} |"


def _escaped(text: str) -> str:
    """Keep code between backticks; escape the rest, and let nothing start a new line."""
    parts = re.split(r"(`[^`<>|\n]*`)", " ".join(text.split()))
    return "".join(
        one if k % 2 else re.sub(r"([\\|*\[\]`#])", r"\\\1", one).replace("&", "&amp;").replace("<", "&lt;")
        for k, one in enumerate(parts)
    )
