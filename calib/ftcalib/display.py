"""What `print` and a notebook show of an object: a title, a short table and sentences, in at most ten lines of text."""

from collections.abc import Mapping, Sequence, Set
from dataclasses import fields, is_dataclass
from html import escape
from typing import Any, Final, NamedTuple

MOST_LINES: Final = 10
# Sentences for which the text always has room; a notebook shows all.
_LEAST_NOTES = 2
# Longer values of a field are cut.
_LONGEST = 60
# Dark enough for a white page, light enough for a black one.
_COLOURS: Final = {"good": "#2e8b57", "usable": "#b8860b", "rejected": "#d9534f"}


class Row(NamedTuple):
    """One line of the table."""

    name: str
    cells: Sequence[str]
    """A number, or the elements of a vector."""
    unit: str = ""


class Summary(NamedTuple):
    """What is shown of an object."""

    title: str
    rows: Sequence[Row] = ()
    """The most important one first: the text ends where it has ten lines."""
    notes: Sequence[str] = ()
    verdict: str = ""

    def text(self) -> str:
        """Return at most ten lines."""
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
            [head, *(f"  {name:{width}}  {value}" for name, value in rows), *(f"  {one}" for one in notes)]
        )

    def html(self) -> str:
        """Return an element that takes its colours from the page; every text is escaped."""
        most = max((len(row.cells) for row in self.rows), default=0)
        pad = 'style="text-align:left;padding-right:1.5em"'
        lines = []
        for name, (*first, last), unit in self.rows:
            filled = "".join(f"<td {pad}>{escape(one)}</td>" for one in first)
            # the last one is as wide as the rest of the row
            filled += f'<td colspan="{most - len(first) + (not unit)}" {pad}>{escape(last)}</td>'
            filled += f"<td {pad}>{escape(unit)}</td>" if unit else ""
            lines.append(f'<tr><th scope="row" {pad}>{escape(name)}</th>{filled}</tr>')
        head = f"<strong>{escape(self.title)}</strong>"
        if self.verdict:
            colour = _COLOURS.get(self.verdict, "inherit")
            head += f' <strong style="color:{colour}">{escape(self.verdict.upper())}</strong>'
        table = f"<table><tbody>{''.join(lines)}</tbody></table>" if lines else ""
        notes = "".join(f"<li>{escape(one)}</li>" for one in self.notes)
        return f"<div><p>{head}</p>{table}{f'<ul>{notes}</ul>' if notes else ''}</div>"


class Displayed:
    """An object that prints short, and as a table in a notebook. A dataclass needs ``repr=False`` beside it.

    Unless `_summary` is overridden, it shows the fields, of arrays and of other objects only shape and title.
    """

    __slots__ = ()

    def _summary(self) -> Summary:
        rows = [Row(one.name, [brief(getattr(self, one.name))]) for one in fields(self) if one.repr]  # type: ignore[arg-type]  # a dataclass
        return Summary(type(self).__name__, rows)

    def __repr__(self) -> str:
        return self._summary().text()

    def _repr_html_(self) -> str:
        return self._summary().html()


def brief(value: object) -> str:
    """Return a value in one short line: of an array with more than nine numbers the shape, of many things how many.

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
    elements = [_format_array(one) if getattr(one, "ndim", 0) else f"{one:.6g}" for one in value]
    return f"[{' '.join(elements)}]"
