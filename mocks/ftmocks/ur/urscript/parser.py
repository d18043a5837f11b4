"""The parser of URScript: from the words of a program to its statements.

Source: Universal Robots, "The URScript Programming Language", chapter 1; the external control program of the client
library of Universal Robots for line breaks in a statement.

Chosen here: one statement a line, as the manual shows programs. Operators bind as in Python, ``xor`` between ``or`` and
``and``. A name is known when the program assigns it anywhere, or defines a function of that name anywhere.

Does not model: structs, matrices, ``switch``, ``assert``, program labels, ``+=``, remote procedure calls. Such a text
is rejected as a syntax error.
"""

from collections.abc import Collection
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
    Operation,
    Statement,
    Token,
    UrscriptSyntaxError,
    While,
    syntax_error,
    tokens_of,
)

_LEVELS = (("or",), ("xor",), ("and",), ("not",), ("==", "!=", "<", ">", "<=", ">="), ("+", "-"), ("*", "/", "%"))
"""Operators, from the weakest."""
_COMPARISONS = _LEVELS[4]
_ALONE = ("break", "continue", "halt", "pass", "enter_critical", "exit_critical")
_WITH_VALUE = ("kill", "join")
_RESERVED = {"def", "thread", "sec", "if", "elif", "else", "while", "end", "return", "run", "local", "global", "and"}
_RESERVED |= {"or", "xor", "not", "True", "False", "switch", "case", "assert", "None", "in", *_ALONE, *_WITH_VALUE}


def parse(text: str, name: str, built_in: Collection[str]) -> Function:
    """Parse one program: a ``def`` without parameters, or bare statements, which become a program called `name`.

    Parameters
    ----------
    built_in
        Names of the controller's functions.

    Raises
    ------
    UrscriptSyntaxError
        When the text is no program, or uses a name that is not known.
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
        """Raise the error at the next word, which may stand in a later line."""
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

    def program(self, name: str) -> Function:
        self._skip_newlines()
        if self._is("def", "sec"):
            main = self._function()
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
        return main

    def _function(self) -> Function:
        is_thread = self._take().text == "thread"
        name = self._new_name()
        parameters: list[tuple[str, Expression | None]] = []
        self._expect("(")
        while not self._accept(")"):
            if parameters:
                self._expect(",")
            parameters.append((self._new_name(), self._expression() if self._accept("=") else None))
        self._colon()
        functions: dict[str, Function] = {}
        body = self._block(functions, ("end",))
        self._take()
        self._end_line()
        return Function(name, tuple(parameters), body, is_thread, functions)

    def _block(self, functions: dict[str, Function], ends: tuple[str, ...]) -> Block:
        """Take statements up to one of the words in `ends`, or up to the end of the text when there are none."""
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
        if self._accept("if"):
            return self._if(place, functions)
        if self._accept("while"):
            condition = self._expression()
            self._colon()
            body = self._block(functions, ("end",))
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

    def _if(self, place: Place, functions: dict[str, Function]) -> If:
        branches: list[tuple[Expression, Block]] = []
        word: str | None = "if"
        while word != "end":
            condition = Literal(True) if word == "else" else self._expression()
            self._colon()
            branches.append(
                (condition, self._block(functions, ("end",) if word == "else" else ("end", "elif", "else")))
            )
            word = self._take().text
        self._end_line()
        return If(place, tuple(branches))

    def _assignment_or_call(self, place: Place) -> Statement:
        scope = self._accept("local", "global") or ""
        used = len(self._used)
        left = self._expression()
        if not self._accept("="):
            if scope or not isinstance(left, Call):
                self._fail("an assignment or a call expected")
            return left
        if isinstance(left, Name):
            del self._used[used:]
            self._known.add(left.name)
            return Assignment(place, scope, left.name, None, self._expression())
        if isinstance(left, Item) and isinstance(left.whole, Name) and not scope:
            return Assignment(place, scope, left.whole.name, left.index, self._expression())
        self._fail("only a variable or an element of one can be assigned to")

    def _expression(self, level: int = 0) -> Expression:
        if level == len(_LEVELS):
            return self._signed()
        operators = _LEVELS[level]
        if operators == ("not",):
            return Operation("not", (self._expression(level),)) if self._accept("not") else self._expression(level + 1)
        left = self._expression(level + 1)
        while operator := self._accept(*operators):
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
        if opened := self._accept("[", "p["):
            return Items(self._items(), opened == "p[")
        place = self._next.place
        if self._accept("run"):
            return self._call(place, self._name(), runs=True)
        if word := self._accept("True", "False"):
            return Literal(word == "True")
        if self._next.kind == "text":
            return Literal(self._take().text)
        if self._next.kind == "number":
            digits = self._take().text
            return Literal(int(digits) if digits.isdigit() else float(digits))
        name = self._name()
        if self._is("("):
            return self._call(place, name, runs=False)
        self._used.append((name, place))
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
                self._fail("an argument with a name expected behind one with a name")
            else:
                args.append(self._expression())
        return Call(place, name, tuple(args), named, runs)
