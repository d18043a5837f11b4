"""Summaries of objects for `print` and notebooks: a title, a short table and notes, in at most ten lines of text."""

from collections.abc import Mapping, Sequence, Set
from dataclasses import fields, is_dataclass
from html import escape
from typing import Any, Final, NamedTuple

MOST_LINES: Final = 10
# Number of notes that the text form of a summary always shows; a notebook shows all notes.
_LEAST_NOTES = 2
# Longest text of a field in a summary, in characters; longer text is cut.
_LONGEST = 60
# Colours that are readable on white and on black pages.
_COLOURS: Final = {"good": "#2e8b57", "usable": "#b8860b", "rejected": "#d9534f"}


class Row(NamedTuple):
    """Row of the table of a summary."""

    name: str
    cells: Sequence[str]
    """A number, or the elements of a vector, as text."""
    unit: str = ""


class Summary(NamedTuple):
    """Summary of an object: title, table, notes and verdict."""

    title: str
    rows: Sequence[Row] = ()
    """Rows of the table, the most important ones first, because the text has at most ten lines."""
    notes: Sequence[str] = ()
    verdict: str = ""

    def text(self) -> str:
        """Return the summary as text of at most ten lines."""
        notes = list(self.notes[: max(_LEAST_NOTES, MOST_LINES - 1 - len(self.rows))])
        if more := len(self.notes) - len(notes):
            notes[-1] += f" (and {more} more)"
        room = MOST_LINES - 1 - len(notes)
        rows = [(row.name, f"{', '.join(row.cells)} {row.unit}".rstrip()) for row in self.rows]
        if len(rows) > room:
            rows[room - 1 :] = [("…", f"{len(rows) - room + 1} more")]
        width = max((len(name) for name, _ in rows), default=0)
        head = f"{self.title}: {self.verdict.upper()}" if self.verdict else self.title
        return "\n".join(
            [head, *(f"  {name:{width}}  {value}" for name, value in rows), *(f"  {note}" for note in notes)]
        )

    def html(self) -> str:
        """Return the summary as an HTML element with the colours of the page; all text is escaped."""
        most = max((len(row.cells) for row in self.rows), default=0)
        pad = 'style="text-align:left;padding-right:1.5em"'
        lines = []
        for name, (*first, last), unit in self.rows:
            filled = "".join(f"<td {pad}>{escape(cell)}</td>" for cell in first)
            # the last cell of a row spans the remaining columns
            filled += f'<td colspan="{most - len(first) + (not unit)}" {pad}>{escape(last)}</td>'
            filled += f"<td {pad}>{escape(unit)}</td>" if unit else ""
            lines.append(f'<tr><th scope="row" {pad}>{escape(name)}</th>{filled}</tr>')
        head = f"<strong>{escape(self.title)}</strong>"
        if self.verdict:
            colour = _COLOURS.get(self.verdict, "inherit")
            head += f' <strong style="color:{colour}">{escape(self.verdict.upper())}</strong>'
        table = f"<table><tbody>{''.join(lines)}</tbody></table>" if lines else ""
        notes = "".join(f"<li>{escape(note)}</li>" for note in self.notes)
        return f"<div><p>{head}</p>{table}{f'<ul>{notes}</ul>' if notes else ''}</div>"


class Displayed:
    """Base class of objects that print as a short summary and show a table in a notebook.

    A dataclass that inherits from this class needs ``repr=False``. The summary lists its fields, arrays by their shape.
    """

    __slots__ = ()

    def _summary(self) -> Summary:
        rows = [Row(each.name, [brief(getattr(self, each.name))]) for each in fields(self) if each.repr]  # type: ignore[arg-type]  # a dataclass
        return Summary(type(self).__name__, rows)

    def __repr__(self) -> str:
        return self._summary().text()

    def _repr_html_(self) -> str:
        return self._summary().html()


def brief(value: object) -> str:
    """Return a value as one short line: the shape of an array of more than nine numbers, the length of a long list.

    Examples
    --------
    >>> import numpy as np
    >>> brief(np.zeros((24, 6))), brief(np.array([0.1, 0.25, 3.0])), brief(0.123456789)
    ('array (24, 6)', '[0.1 0.25 3]', '0.123457')
    """
    if isinstance(value, Displayed):
        return repr(value).partition("\n")[0]
    if isinstance(value, float):
        return f"{value:.6g}"
    if hasattr(value, "shape") and hasattr(value, "tolist"):
        return _format_array(value)
    if is_dataclass(value) and len(text := repr(value)) > _LONGEST:
        return type(value).__name__
    if isinstance(value, Mapping | Set | Sequence) and not isinstance(value, str | bytes):
        return (
            text if len(text := str(value)) <= _LONGEST else f"{len(value)} {'entry' if len(value) == 1 else 'entries'}"
        )
    text = str(value)
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}…"


def _format_array(value: Any) -> str:
    if value.size > 9 or value.dtype.names:
        return f"array {value.shape}"
    if value.ndim == 0:
        return f"{value.item():.6g}"
    elements = [_format_array(part) if getattr(part, "ndim", 0) else f"{part:.6g}" for part in value]
    return f"[{' '.join(elements)}]"
