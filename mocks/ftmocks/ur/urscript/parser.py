"""The parser of URScript: from the words of a program to its statements.

Source: Universal Robots, "The URScript Programming Language", chapter 1; the external control program of the client
library of Universal Robots for line breaks in a statement.

Chosen here: one statement per line, as in the manual. Operators have Python's precedence, ``xor`` between ``or`` and
``and``. A name is known if the program assigns it anywhere, or defines a function of that name anywhere.

The parser rejects what a published report says that a controller rejects. Where another source contradicts the report,
it accepts the text and records a doubt. The list with its sources: docs/reference/urscript-constructs.md.

Does not model: structs, matrices, ``^``, ``switch``, ``assert``, remote procedure calls. Such a program is rejected as
not emulated.
"""

from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from typing import NoReturn

from ftmocks.ur.controller_program import Place
from ftmocks.ur.urscript.syntax import (
    Assignment,
    Block,
    Call,
    Expression,
    Function,
    If,
    Item,
    Items,
    Keyword,
    Literal,
    Name,
    NotEmulated,
    Operation,
    Statement,
    Token,
    UrscriptSyntaxError,
    While,
    syntax_error,
    tokens_of,
)
from ftmocks.ur.urscript.types import check_types

_LEVELS = (("or",), ("xor",), ("and",), ("not",), ("==", "!=", "<", ">", "<=", ">="), ("+", "-"), ("*", "/", "%"))
"""Groups of operators in ascending order of precedence."""
_COMPARISONS, _ARITHMETIC = _LEVELS[4], _LEVELS[5:]
_ALONE = ("break", "continue", "halt", "pass", "enter_critical", "exit_critical")
_WITH_VALUE = ("kill", "join")
_RESERVED = {"def", "thread", "sec", "if", "elif", "else", "while", "end", "return", "run", "local", "global", "and"}
_NOT_EMULATED = ("switch", "assert")
LONGEST_NAME = 31
"""Longest name of a program; Universal Robots' client library cuts names to this length for older controllers."""
_RESERVED |= {"or", "xor", "not", "True", "False", "switch", "case", "assert", "None", "in", *_ALONE, *_WITH_VALUE}


@dataclass
class _Names:
    """Variables of one function: its own, those used without ``local`` or ``global``, and those assigned so far."""

    own: set[str] = field(default_factory=set)
    free: list[tuple[str, Place]] = field(default_factory=list)
    valued: set[str] = field(default_factory=set)
    loops: int = 0
    blocks: int = 0
    """`loops` and `blocks` count the loops, and the blocks of any kind, around the current statement."""


def parse(text: str, name: str, built_in: Collection[str]) -> tuple[Function, list[str]]:
    """Parse one program: a ``def`` without parameters, or single statements, which become a program called `name`.

    Return the program and its doubts: constructs that controllers are reported to reject, although sources differ.

    Parameters
    ----------
    built_in
        Names of the controller's functions.

    Raises
    ------
    UrscriptSyntaxError
        The text is not a program, or uses an unknown name.
    """
    try:
        return _Parser(text, built_in).program(name)
    except RecursionError:
        raise syntax_error(text, Place(), "the program is nested too deeply") from None


class _Parser:
    def __init__(self, text: str, built_in: Collection[str]) -> None:
        self._text = text
        self._tokens = list(tokens_of(text))
        self._at = 0
        self._known = set(built_in)
        self._used: list[tuple[str, Place]] = []
        self._names = self._main = _Names()
        self._globals: set[str] = set()
        self._functions: list[_Names] = []
        self._doubts: list[str] = []

    @property
    def _next(self) -> Token:
        return self._tokens[self._at]

    def _take(self) -> Token:
        token = self._next
        self._at += token.kind != "end"
        return token

    def _is(self, *texts: str) -> bool:
        return self._next.kind in ("name", "sign", "pose") and self._next.text in texts

    def _accept(self, *texts: str) -> str | None:
        return self._take().text if self._is(*texts) else None

    def _expect(self, text: str) -> None:
        if self._accept(text) is None:
            self._fail(f"{text!r} expected")

    def _skip_newlines(self) -> None:
        while self._next.kind == "newline":
            self._take()

    def _fail(self, what: str) -> NoReturn:
        """Raise a syntax error at the position of the next word, which may be in a later line."""
        found = "the end of the line" if self._next.kind == "newline" else repr(self._next.text)
        self._skip_newlines()
        raise syntax_error(self._text, self._next.place, f"{what}, found {found}")

    def _name(self) -> str:
        if self._next.kind != "name" or self._next.text in _RESERVED:
            self._fail("a name expected")
        return self._take().text

    def _new_name(self) -> str:
        self._known.add(name := self._name())
        return name

    def _end_line(self) -> None:
        if self._next.kind != "newline":
            self._fail("the end of the line expected")
        self._skip_newlines()

    def _colon(self) -> None:
        self._expect(":")
        self._end_line()

    def program(self, name: str) -> tuple[Function, list[str]]:
        self._skip_newlines()
        if self._is("def", "sec"):
            main = self._function(self._main)
        else:
            functions: dict[str, Function] = {}
            main = Function(name, (), self._block(functions, ()), functions=functions)
        if self._next.kind != "end":
            self._fail("nothing more expected")
        if main.parameters:
            raise syntax_error(self._text, Place(), f"a program has no parameters, {main.name} has")
        for used, place in self._used:
            if used not in self._known:
                sentence = f"the name {used} does not exist, or is not modelled by this emulator"
                raise UrscriptSyntaxError(place, sentence, f"compile_error_name_not_found:{used}:")
        check_types(main)
        return main, [*self._doubts, *self._other_doubts(main.name)]

    def _doubt(self, place: Place, sentence: str) -> None:
        self._doubts.append(f"URScript, line {place.line}: {sentence}")

    def _other_doubts(self, name: str) -> Iterator[str]:
        """Yield the doubts that can only be found in the whole program."""
        hidden = self._main.own - self._globals
        for names in self._functions:
            for used, place in {used: place for used, place in reversed(names.free) if used not in names.own}.items():
                if used in hidden:
                    yield f"URScript, line {place.line}: {used} is not declared global in the program"
        if any(line.lstrip().startswith("#") for line in self._text.split("\n")):
            yield "URScript: the program has lines of comment"
        if len(name) > LONGEST_NAME:
            yield f"URScript: the name {name} has more than {LONGEST_NAME} characters"

    def _function(self, names: _Names | None = None) -> Function:
        outer, self._names = self._names, names or _Names()
        if names is None:
            self._functions.append(self._names)
        is_thread = self._take().text == "thread"
        name = self._new_name()
        parameters: list[tuple[str, Expression | None]] = []
        self._expect("(")
        while not self._accept(")"):
            if parameters:
                self._expect(",")
            parameters.append((parameter := self._new_name(), self._expression() if self._accept("=") else None))
            self._names.own.add(parameter)
        self._colon()
        functions: dict[str, Function] = {}
        body = self._block(functions, ("end",))
        self._take()
        self._end_line()
        self._names = outer
        return Function(name, tuple(parameters), body, is_thread, functions)

    def _block(self, functions: dict[str, Function], ends: tuple[str, ...]) -> Block:
        """Parse statements up to one of the words in `ends`, or to the end of the text if `ends` is empty."""
        statements: list[Statement] = []
        while not self._is(*ends):
            if self._next.kind == "end":
                if ends:
                    self._fail("'end' expected")
                break
            if self._is("def", "thread"):
                function = self._function()
                functions[function.name] = function
            else:
                statements.append(self._statement(functions))
        return tuple(statements)

    def _statement(self, functions: dict[str, Function]) -> Statement:
        place = self._next.place
        if self._is(*_NOT_EMULATED):
            raise NotEmulated(place, repr(self._next.text))
        if self._accept("if"):
            return self._if(place, functions)
        if self._accept("while"):
            condition = self._expression()
            self._colon()
            self._names.loops += 1
            body = self._inner_block(functions, ("end",))
            self._names.loops -= 1
            self._take()
            statement: Statement = While(place, condition, body)
        elif word := self._accept(*_WITH_VALUE):
            statement = Keyword(place, word, self._expression())
        elif self._accept("return"):
            statement = Keyword(place, "return", None if self._next.kind == "newline" else self._expression())
        elif word := self._accept(*_ALONE):
            statement = Keyword(place, word)
            if word.endswith("critical") and self._accept("("):
                self._expect(")")
        else:
            statement = self._assignment_or_call(place)
        self._end_line()
        return statement

    def _inner_block(self, functions: dict[str, Function], ends: tuple[str, ...]) -> Block:
        self._names.blocks += 1
        block = self._block(functions, ends)
        self._names.blocks -= 1
        return block

    def _if(self, place: Place, functions: dict[str, Function]) -> If:
        branches: list[tuple[Expression, Block]] = []
        word: str | None = "if"
        while word != "end":
            condition = Literal(True) if word == "else" else self._expression()
            self._colon()
            branches.append(
                (condition, self._inner_block(functions, ("end",) if word == "else" else ("end", "elif", "else")))
            )
            word = self._take().text
        self._end_line()
        return If(place, tuple(branches))

    def _assignment_or_call(self, place: Place) -> Statement:
        scope = self._accept("local", "global") or ""
        if scope == "global" and self._names.blocks:
            self._doubt(place, "'global' inside an if or while")
        used, free = len(self._used), len(self._names.free)
        left = self._expression()
        if not self._accept("="):
            if scope or not isinstance(left, Call):
                self._fail("an assignment or a call expected")
            return left
        if isinstance(left, Name):
            del self._used[used:]
            del self._names.free[free:]
            self._known.add(left.name)
            value = self._expression()
            self._note_assignment(place, scope, left.name)
            return Assignment(place, scope, left.name, None, value)
        if isinstance(left, Item) and isinstance(left.whole, Name) and not scope:
            return Assignment(place, scope, left.whole.name, left.index, self._expression())
        self._fail("only a variable or an element of one can be assigned to")

    def _note_assignment(self, place: Place, scope: str, name: str) -> None:
        names = self._names
        if names.loops and name not in names.own | names.valued | self._main.valued | self._globals:
            self._doubt(place, f"{name} gets its first value inside a loop")
        names.valued.add(name)
        if scope == "global":
            self._globals.add(name)
        elif scope == "local" or names is self._main:
            names.own.add(name)
        else:
            names.free.append((name, place))

    def _expression(self, level: int = 0) -> Expression:
        if level == len(_LEVELS):
            return self._signed()
        operators = _LEVELS[level]
        if operators == ("not",):
            return Operation("not", (self._expression(level),)) if self._accept("not") else self._expression(level + 1)
        left = self._expression(level + 1)
        while operator := self._accept(*operators):
            if operators in _ARITHMETIC and self._is("-", "+"):
                self._doubt(self._next.place, f"a sign after {operator!r}")
            left = Operation(operator, (left, self._expression(level + 1)))
            if operators is _COMPARISONS and self._is(*_COMPARISONS):
                self._fail("one comparison expected")
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
        place = self._next.place
        if opened := self._accept("[", "p["):
            items = self._items()
            if any(isinstance(item, Items) and not item.is_pose for item in items):
                raise NotEmulated(place, "a list of lists (a matrix)")
            return Items(items, opened == "p[")
        if self._accept("run"):
            return self._call(place, self._name(), runs=True)
        if word := self._accept("True", "False"):
            return Literal(word == "True")
        if self._next.kind == "text":
            return Literal(self._take().text)
        if self._next.kind == "number":
            digits = self._take().text
            if not set(digits).isdisjoint("eE"):
                self._doubt(place, f"{digits} has an exponent")
            return Literal(int(digits) if digits.isdigit() else float(digits))
        name = self._name()
        if self._is("("):
            return self._call(place, name, runs=False)
        self._used.append((name, place))
        self._names.free.append((name, place))
        return Name(name)

    def _items(self) -> tuple[Expression, ...]:
        items: list[Expression] = []
        while not self._accept("]"):
            if items:
                self._expect(",")
            items.append(self._expression())
        return tuple(items)

    def _call(self, place: Place, name: str, *, runs: bool) -> Call:
        self._used.append((name, place))
        args: list[Expression] = []
        named: dict[str, Expression] = {}
        self._expect("(")
        while not self._accept(")"):
            if args or named:
                self._expect(",")
            parameter = self._tokens[self._at : self._at + 2]
            if [token.kind for token in parameter] == ["name", "sign"] and parameter[1].text == "=":
                name_given = self._name()
                self._expect("=")
                named[name_given] = self._expression()
            elif named:
                self._fail("a named argument expected after a named one")
            else:
                args.append(self._expression())
        return Call(place, name, tuple(args), named, runs)
