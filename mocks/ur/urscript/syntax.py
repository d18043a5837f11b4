"""URScript as text: from the characters of a program to its statements.

From: Universal Robots, "The URScript Programming Language", chapter 1. One statement a line; a block ends with ``end``.
An expression of this subset is an expression of Python too, so Python's parser reads it after every token was checked.

Does not model: all that the programs for this emulator do not use. Such a text is rejected as a syntax error: threads
and functions of the program, ``global``, ``elif``, ``else``, ``return``, ``break``, ``and``, ``or``, ``not``, poses.
"""

import ast
import keyword
import operator
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import chain
from typing import Any

OPERATORS: dict[type[ast.AST], Callable[[Any, Any], Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Lt: operator.lt,
    ast.Gt: operator.gt,
    ast.LtE: operator.le,
    ast.GtE: operator.ge,
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
}
"""Operators with two operands."""

_TOKEN = re.compile(
    r"(?P<blank>[ \t\r]+|#.*)|(?P<number>(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)"
    r'|"(?P<text>[^"]*)"|(?P<name>[A-Za-z_]\w*)|(?P<sign>==|!=|<=|>=|[-+*/<>=()\[\],:])',
    re.ASCII,
)
_NODES: tuple[type[ast.AST], ...] = (ast.Constant, ast.Name, ast.Load, ast.List, ast.Subscript, ast.Call, ast.keyword)
_NODES += (ast.BinOp, ast.UnaryOp, ast.USub, ast.Compare, *OPERATORS)
_RESERVED = {"end", "halt", "local", "global", "thread", "run", "kill", "join", *keyword.kwlist}


class UrscriptSyntaxError(Exception):
    """The text is no program."""


@dataclass(frozen=True)
class Assignment:
    """``name = value``, with or without ``local``."""

    name: str
    value: ast.expr


@dataclass(frozen=True)
class Block:
    """``if`` or ``while`` with its condition and its statements."""

    word: str
    condition: ast.expr
    body: tuple["Statement", ...]


@dataclass(frozen=True)
class Halt:
    """``halt``: the program ends."""


Statement = Assignment | Block | Halt | ast.Call


def parse(text: str) -> tuple[Statement, ...]:
    """Parse one program: a ``def`` without parameters, or bare statements.

    Raises
    ------
    UrscriptSyntaxError
        With the number of the line.
    """
    lines = ((number, found) for number, line in enumerate(text.split("\n"), 1) if (found := _tokens(number, line)))
    number, head = next(lines, (0, []))
    closed = head[:1] == ["def"]
    if closed and head[2:] != ["(", ")", ":"]:
        raise UrscriptSyntaxError(f"line {number}: a program starts with 'def NAME():'")
    rest = lines if closed or not head else chain([(number, head)], lines)
    try:
        statements = _block(rest, closed=closed)
    except RecursionError:
        raise UrscriptSyntaxError("the program is nested too deeply") from None
    if after := next(rest, None):
        raise UrscriptSyntaxError(f"line {after[0]}: nothing more expected")
    return statements


def _tokens(number: int, line: str) -> list[str]:
    """Return the tokens of one line, as Python writes them."""
    tokens, at = [], 0
    while at < len(line):
        found = _TOKEN.match(line, at)
        if found is None:
            raise UrscriptSyntaxError(f"line {number}: {line[at : at + 20]!r} is no URScript")
        if found.lastgroup == "text":
            tokens.append(repr(found["text"]))
        elif found.lastgroup != "blank":
            tokens.append(found[0])
        at = found.end()
    return tokens


def _block(lines: Iterator[tuple[int, list[str]]], *, closed: bool) -> tuple[Statement, ...]:
    """Take the statements of one block from `lines`: up to its ``end`` when it is `closed` by one, else all."""
    statements: list[Statement] = []
    for number, tokens in lines:
        match tokens:
            case ["end"] if closed:
                return tuple(statements)
            case ["if" | "while" as word, *condition, ":"]:
                statements.append(Block(word, _expression(number, condition), _block(lines, closed=True)))
            case ["halt"]:
                statements.append(Halt())
            case ["local", name, "=", *value] | [name, "=", *value] if name.isidentifier() and name not in _RESERVED:
                statements.append(Assignment(name, _expression(number, value)))
            case _:
                call = _expression(number, tokens)
                if not isinstance(call, ast.Call):
                    raise UrscriptSyntaxError(f"line {number}: an assignment or a call expected")
                statements.append(call)
    if closed:
        raise UrscriptSyntaxError("'end' expected after the last line")
    return tuple(statements)


def _expression(number: int, tokens: list[str]) -> ast.expr:
    source = " ".join(tokens)
    try:
        expression = ast.parse(source, mode="eval").body
    except (SyntaxError, ValueError, MemoryError, RecursionError):
        raise UrscriptSyntaxError(f"line {number}: {source[:40]!r} is no expression") from None
    for node in ast.walk(expression):
        known = isinstance(node, _NODES) and not (isinstance(node, ast.Constant) and node.value is None)
        known &= not isinstance(node, ast.Call) or isinstance(node.func, ast.Name)
        known &= not isinstance(node, ast.Compare) or len(node.ops) == 1
        if not known:
            raise UrscriptSyntaxError(f"line {number}: {source[:40]!r} is not modelled by this emulator")
    return expression
