"""A report as sections of sentences, tables and figures, whatever its format."""

from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Table:
    """Cells as text; the first of each row is its heading."""

    caption: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    folded: bool = False
    """A long one, which a page shows on request."""

    @property
    def narrow(self) -> bool:
        """Whether it fits beside a figure."""
        return 2 < len(self.columns) <= 4


@dataclass(frozen=True, slots=True)
class Figure:
    """A figure by its name, with what a reader sees in it and what good looks like."""

    name: str
    alt: str
    caption: str


@dataclass(frozen=True, slots=True)
class Section:
    """One heading; `name` is its anchor."""

    name: str
    title: str
    text: Sequence[str] = ()
    figures: Sequence[Figure] = ()
    tables: Sequence[Table] = ()
