"""URScript as text: from the characters of a program to its statements and expressions.

From: Universal Robots, "The URScript Programming Language", chapter 1. One statement a line; a block ends with ``end``.

Left out: structs and matrices, remote procedure calls, ``switch``, ``assert``, program labels, line breaks inside
brackets (the manual shows none).
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, NoReturn


class UrscriptSyntaxError(Exception):
    """The text is no program."""


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
    pose: bool = False


@dataclass(frozen=True)
class Item:
    """One element of a list."""

    whole: "Expression"
    index: "Expression"


@dataclass(frozen=True)
class Call:
    """A function and its arguments, by place and by name; with `run` in front, a new thread."""

    name: str
    args: tuple["Expression", ...]
    named: dict[str, "Expression"]
    run: bool = False


@dataclass(frozen=True)
class Operation:
    """An operator with one or two operands."""

    operator: str
    operands: tuple["Expression", ...]


Expression = Literal | Name | Items | Item | Call | Operation


@dataclass(frozen=True)
class Assignment:
    """``scope target = value`` with scope ``local``, ``global`` or nothing."""

    scope: str
    name: str
    index: Expression | None
    value: Expression


@dataclass(frozen=True)
class If:
    """Conditions with their blocks; ``else`` has the condition true."""

    branches: tuple[tuple[Expression, tuple["Statement", ...]], ...]


@dataclass(frozen=True)
class While:
    """A loop."""

    condition: Expression
    body: tuple["Statement", ...]


@dataclass(frozen=True)
class Keyword:
    """``return``, ``kill``, ``join`` with a value, ``break``, ``continue``, ``halt``, ``pass`` without."""

    word: str
    value: Expression | None = None


@dataclass(frozen=True)
class Function:
    """``def`` or ``thread``: parameters, those with a value last, and what it does."""

    name: str
    parameters: tuple[tuple[str, Expression | None], ...]
    body: tuple["Statement", ...]
    thread: bool = False
    functions: dict[str, "Function"] = field(default_factory=dict)


Statement = Assignment | If | While | Keyword | Expression


class _Token(NamedTuple):
    kind: str
    text: str
    line: int


_TOKEN = re.compile(
    r"(?P<blank>[ \t\r]+|#[^\n]*)|(?P<newline>\n)|(?P<number>(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)"
    r'|"(?P<text>[^"\n]*)"|(?P<pose>p\[)|(?P<name>[A-Za-z_]\w*)|(?P<sign>==|!=|<=|>=|[-+*/%<>=()\[\],:])'
)
_LEVELS = (("or",), ("xor",), ("and",), ("not",), ("==", "!=", "<", ">", "<=", ">="), ("+", "-"), ("*", "/", "%"))
_BLOCK_ENDS = ("end", "elif", "else")
_RESERVED = {"def", "thread", "if", "while", "return", "kill", "join", "break", "continue", "halt", "pass", "run"}
_RESERVED |= {"local", "global", "and", "or", "xor", "not", "True", "False", "sec", "switch", "case", "assert"}
_RESERVED |= set(_BLOCK_ENDS)


def parse(text: str, name: str) -> Function:
    """Parse one program: a ``def`` without parameters, or bare statements, which become a program called `name`.

    Raises
    ------
    UrscriptSyntaxError
        With the line.
    """
    try:
        return _Parser(text).program(name)
    except RecursionError:
        raise UrscriptSyntaxError("it is nested too deeply") from None


def _tokens(text: str) -> list[_Token]:
    tokens, at, line = [], 0, 1
    while at < len(text):
        found = _TOKEN.match(text, at)
        if found is None:
            raise UrscriptSyntaxError(f"line {line}: {text[at : at + 20].splitlines()[0]!r} is no URScript")
        kind = str(found.lastgroup)
        if kind != "blank":
            tokens.append(_Token(kind, found.group(kind), line))
        line += kind == "newline"
        at = found.end()
    return [*tokens, _Token("newline", "\n", line), _Token("nothing", "the end of the program", line)]


class _Parser:
    def __init__(self, text: str) -> None:
        self._tokens = _tokens(text)
        self._at = 0

    @property
    def _next(self) -> _Token:
        return self._tokens[self._at]

    def _take(self) -> _Token:
        token = self._next
        self._at += token.kind != "nothing"
        return token

    def _is(self, *texts: str) -> bool:
        return self._next.kind in ("name", "sign", "pose") and self._next.text in texts

    def _accept(self, *texts: str) -> str | None:
        return self._take().text if self._is(*texts) else None

    def _expect(self, text: str) -> None:
        if self._accept(text) is None:
            self._fail(f"{text!r} expected")

    def _fail(self, what: str) -> NoReturn:
        found = {"\n": "the end of the line"}.get(self._next.text, repr(self._next.text))
        raise UrscriptSyntaxError(f"line {self._next.line}: {what}, found {found}")

    def _name(self) -> str:
        if self._next.kind != "name" or self._next.text in _RESERVED:
            self._fail("a name expected")
        return self._take().text

    def _end_of_line(self) -> None:
        if self._next.kind != "newline":
            self._fail("the end of the line expected")
        while self._next.kind == "newline":
            self._take()

    def program(self, name: str) -> Function:
        while self._next.kind == "newline":
            self._take()
        if self._is("def"):
            main = self._function()
        else:
            functions: dict[str, Function] = {}
            main = Function(name, (), self._block(functions, ()), functions=functions)
        if self._next.kind != "nothing":
            self._fail("nothing more expected")
        if main.parameters:
            raise UrscriptSyntaxError(f"line 1: a program has no parameters, {main.name} has")
        return main

    def _function(self) -> Function:
        thread = self._take().text == "thread"
        name = self._name()
        parameters: list[tuple[str, Expression | None]] = []
        self._expect("(")
        while not self._accept(")"):
            if parameters:
                self._expect(",")
            parameter = self._name()
            parameters.append((parameter, self._expression() if self._accept("=") else None))
        self._expect(":")
        self._end_of_line()
        functions: dict[str, Function] = {}
        body = self._block(functions, ("end",))
        self._take()
        self._end_of_line()
        return Function(name, tuple(parameters), body, thread, functions)

    def _block(self, functions: dict[str, Function], ends: Sequence[str]) -> tuple[Statement, ...]:
        statements: list[Statement] = []
        while not self._is(*ends):
            if self._next.kind == "nothing" and not ends:
                break
            if self._is("def", "thread"):
                function = self._function()
                functions[function.name] = function
            else:
                statements.append(self._statement(functions))
        return tuple(statements)

    def _statement(self, functions: dict[str, Function]) -> Statement:
        statement: Statement
        if self._accept("if"):
            return self._if(functions)
        if self._accept("while"):
            condition = self._expression()
            self._colon()
            body = self._block(functions, ("end",))
            self._take()
            statement = While(condition, body)
        elif word := self._accept("kill", "join"):
            statement = Keyword(word, self._expression())
        elif self._accept("return"):
            statement = Keyword("return", None if self._next.kind == "newline" else self._expression())
        elif word := self._accept("break", "continue", "halt", "pass"):
            statement = Keyword(word)
        else:
            statement = self._assignment_or_call()
        self._end_of_line()
        return statement

    def _colon(self) -> None:
        self._expect(":")
        self._end_of_line()

    def _if(self, functions: dict[str, Function]) -> If:
        branches: list[tuple[Expression, tuple[Statement, ...]]] = []
        word: str | None = "if"
        while word != "end":
            condition = Literal(True) if word == "else" else self._expression()
            self._colon()
            branches.append((condition, self._block(functions, ("end",) if word == "else" else _BLOCK_ENDS)))
            word = self._take().text
        self._end_of_line()
        return If(tuple(branches))

    def _assignment_or_call(self) -> Statement:
        scope = self._accept("local", "global") or ""
        left = self._expression()
        if not self._accept("="):
            if scope or not isinstance(left, Call):
                self._fail("an assignment or a call expected")
            return left
        if isinstance(left, Name):
            return Assignment(scope, left.name, None, self._expression())
        if isinstance(left, Item) and isinstance(left.whole, Name):
            return Assignment(scope, left.whole.name, left.index, self._expression())
        self._fail("only a variable or an element of one can be assigned to")

    def _expression(self, level: int = 0) -> Expression:
        if level == len(_LEVELS):
            return self._signed()
        if _LEVELS[level] == ("not",):
            return Operation("not", (self._expression(level),)) if self._accept("not") else self._expression(level + 1)
        left = self._expression(level + 1)
        while operator := self._accept(*_LEVELS[level]):
            left = Operation(operator, (left, self._expression(level + 1)))
        return left

    def _signed(self) -> Expression:
        if sign := self._accept("-", "+"):
            return Operation(f"{sign}x", (self._signed(),))
        value = self._value()
        while self._accept("["):
            value = Item(value, self._expression())
            self._expect("]")
        return value

    def _value(self) -> Expression:
        if self._accept("("):
            inner = self._expression()
            self._expect(")")
            return inner
        if opened := self._accept("[", "p["):
            return Items(self._items(), pose=opened == "p[")
        if run := self._accept("run"):
            return self._call(self._name(), run=bool(run))
        if word := self._accept("True", "False"):
            return Literal(word == "True")
        if self._next.kind == "text":
            return Literal(self._take().text)
        if self._next.kind == "number":
            digits = self._take().text
            return Literal(int(digits) if digits.isdigit() else float(digits))
        name = self._name()
        return self._call(name) if self._is("(") else Name(name)

    def _items(self) -> tuple[Expression, ...]:
        items: list[Expression] = []
        while not self._accept("]"):
            if items:
                self._expect(",")
            items.append(self._expression())
        return tuple(items)

    def _call(self, name: str, *, run: bool = False) -> Call:
        args: list[Expression] = []
        named: dict[str, Expression] = {}
        self._expect("(")
        while not self._accept(")"):
            if args or named:
                self._expect(",")
            value = self._expression()
            if self._accept("="):
                if not isinstance(value, Name):
                    self._fail("the name of a parameter expected")
                named[value.name] = self._expression()
            elif named:
                self._fail("an argument with a name expected after one with a name")
            else:
                args.append(value)
        return Call(name, tuple(args), named, run)
