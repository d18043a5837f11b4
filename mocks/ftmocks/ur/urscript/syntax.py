"""URScript as text: the words of a program, and the statements and expressions they form.

Source: Universal Robots, "The URScript Programming Language", chapter 1. Wording and places of the errors: recorded
streams of port 30001 of URSim, published by the Pharmaceutical Bioinformatics group of Uppsala (README of robotlab).
What controllers reject: docs/reference/urscript-constructs.md.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

from ftmocks.ur.controller_program import Place


class UrscriptSyntaxError(Exception):
    """The text is not a program.

    Parameters
    ----------
    place
        Position at which the controller reports the error.
    sentence
        Description of the error.
    report
        Text that the controller reports.
    """

    def __init__(self, place: Place, sentence: str, report: str) -> None:
        super().__init__(f"line {place.line}: {sentence}")
        self.place = place
        self.report = report


class NotEmulated(UrscriptSyntaxError):
    """The text is valid URScript that this emulator does not support."""

    def __init__(self, place: Place, what: str) -> None:
        sentence = f"{what} is valid URScript, but not emulated here"
        super().__init__(place, sentence, f"not_emulated_on_line:{place.line}:{what}:")


@dataclass(frozen=True)
class Literal:
    """A number, a truth value or a text."""

    value: float | bool | str


@dataclass(frozen=True)
class Name:
    """A variable."""

    name: str


@dataclass(frozen=True)
class Items:
    """A list, or a pose ``p[…]``."""

    items: tuple["Expression", ...]
    is_pose: bool


@dataclass(frozen=True)
class Item:
    """One element of a list."""

    whole: "Expression"
    index: "Expression"


@dataclass(frozen=True)
class Call:
    """A call of a function with positional and named arguments; with `runs`, the start of a thread."""

    place: Place
    name: str
    args: tuple["Expression", ...]
    named: dict[str, "Expression"]
    runs: bool


@dataclass(frozen=True)
class Operation:
    """An operator with one or two operands."""

    operator: str
    operands: tuple["Expression", ...]


Expression = Literal | Name | Items | Item | Call | Operation


@dataclass(frozen=True)
class Assignment:
    """``scope name = value`` or ``name[index] = value``; the scope is ``local``, ``global`` or nothing."""

    place: Place
    scope: str
    name: str
    index: Expression | None
    value: Expression


@dataclass(frozen=True)
class If:
    """Conditions with their blocks; the condition of ``else`` is true."""

    place: Place
    branches: tuple[tuple[Expression, "Block"], ...]


@dataclass(frozen=True)
class While:
    """A loop."""

    place: Place
    condition: Expression
    body: "Block"


@dataclass(frozen=True)
class Keyword:
    """A statement of one keyword and its value, if any: ``return``, ``kill``, ``join``, ``break``, ``halt``, …."""

    place: Place
    word: str
    value: Expression | None = None


Statement = Assignment | If | While | Keyword | Call
Block = tuple[Statement, ...]


@dataclass(frozen=True)
class Function:
    """``def`` or ``thread``: its parameters, its statements, and the functions inside."""

    name: str
    parameters: tuple[tuple[str, Expression | None], ...]
    body: Block
    is_thread: bool = False
    functions: dict[str, "Function"] = field(default_factory=dict)


class Token(NamedTuple):
    """One word of a program; `kind` is name, number, text, sign, pose, newline or end."""

    kind: str
    text: str
    place: Place


_TOKEN = re.compile(
    r'(?P<blank>[ \t\r]+|#[^\n]*|\$[ \t]*\d+(?:[ \t]*"[^"\n]*")+)|(?P<newline>\n)'
    r"|(?P<number>(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)"
    r'|"(?P<text>[^"\n]*)"|(?P<pose>p\[)|(?P<name>[A-Za-z_]\w*)|(?P<sign>==|!=|<=|>=|[-+*/%<>=()\[\],:^.{}])',
    re.ASCII,
)


_CONTINUED_BY = {"and", "or", "xor", "not", "=", "==", "!=", "<", ">", "<=", ">=", "+", "-", "*", "/", "%"}
"""Words after which a statement continues in the next line."""


def syntax_error(text: str, place: Place, sentence: str) -> UrscriptSyntaxError:
    """Return the error that the controller reports for a line of `text`."""
    line = (*text.split("\n"), "")[place.line - 1]
    return UrscriptSyntaxError(place, sentence, f"syntax_error_on_line:{place.line}:{line}:")


def tokens_of(text: str) -> Iterator[Token]:
    """Yield the words of a program, without blanks, comments and program labels, and ``end`` after the last word.

    A program label is ``$ 2 "text" "noBreak"``: the node of the pendant's program to which the next lines belong, and
    in some versions where a step ends. A line break inside brackets, or after an operator, is a blank.

    Raises
    ------
    UrscriptSyntaxError
        A character belongs to no word, or a word is not emulated.
    """
    at, line, line_start, depth = 0, 1, 0, 0
    goes_on = False
    while at < len(text):
        place = Place(line, at - line_start + 1)
        found = _TOKEN.match(text, at)
        if found is None:
            raise syntax_error(text, place, f"{text[at : at + 20].splitlines()[0]!r} is not URScript")
        kind, at = str(found.lastgroup), found.end()
        word = found[kind]
        if kind == "newline":
            line, line_start = line + 1, at
        if kind == "sign" and word in "^.{}":
            raise NotEmulated(place, repr(word))
        if kind == "blank" or (kind == "newline" and (depth or goes_on)):
            continue
        yield Token(kind, word, place)
        goes_on = kind in ("name", "sign") and word in _CONTINUED_BY
        depth += (kind == "pose" or (kind == "sign" and word in "([")) - (kind == "sign" and word in ")]")
        depth = max(0, depth)
    yield Token("newline", "\n", Place(line, at - line_start + 1))
    yield Token("end", "the end of the program", Place(line, at - line_start + 1))
