"""A program in URScript, run one control cycle at a time: threads, variables and statements.

From: Universal Robots, "The URScript Programming Language", chapter 1, with its rules of scope: what the program itself
declares is global; in a function a variable is global when one of that name exists and it was not declared ``local``.

Chosen here: a condition must be true or false, a division of whole numbers is not rounded, everything ends with the
main program. A thread that computes for ever in one cycle is a run-time error; a real controller would let it go on in
the next, and lose its connection to the pendant.
"""

import math
import operator
from collections.abc import Callable, Generator
from dataclasses import dataclass
from inspect import isgenerator, signature
from typing import TYPE_CHECKING, Any, cast

from mocks.ur.urscript.library import FUNCTIONS, Pose, ScriptError, is_number, shown
from mocks.ur.urscript.syntax import (
    Assignment,
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
    While,
    parse,
)

if TYPE_CHECKING:
    from mocks.ur.robot import Robot

STATEMENTS_PER_CYCLE = 2000

Value = Any
"""A number, a truth value, a text, a list of values, a pose, a thread, or None from a function without a value."""
Run = Generator[None, None, Value]
"""What is being computed; each `next()` is one control cycle."""

ARITHMETIC: dict[str, Callable[[Any, Any], Any]] = {
    "+": operator.add,
    "-": operator.sub,
    "*": operator.mul,
    "/": operator.truediv,
    "%": math.fmod,
}
ORDER: dict[str, Callable[[Any, Any], bool]] = {
    "<": operator.lt,
    ">": operator.gt,
    "<=": operator.le,
    ">=": operator.ge,
}


class _Halt(Exception):
    """The program ends itself."""


class _Leave(Exception):
    """A statement that leaves the block it is in: break, continue, return."""

    def __init__(self, word: str, value: Value = None) -> None:
        self.word, self.value = word, value


def _nothing() -> Run:
    yield from ()


class Thread:
    """A thread of a program: its name for the arm, and how far it is."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.steps = _nothing()
        self.done = False

    def __str__(self) -> str:
        return self.name


@dataclass
class Scope:
    """Where a statement runs: the thread, the variables of its own function, and the functions it sees."""

    thread: Thread
    function: Function
    outer: "Scope | None"
    variables: dict[str, Value]

    def find(self, name: str) -> "tuple[Function, Scope] | None":
        """Find a function and the scope it was defined in."""
        if name in self.function.functions:
            return self.function.functions[name], self
        return self.outer.find(name) if self.outer else None


class Program:
    """One program from the script port.

    Parameters
    ----------
    robot
        The controller it runs on.
    name
        As the dashboard shows it.
    text
        Its URScript.

    Raises
    ------
    UrscriptSyntaxError
        When the text is no program.
    """

    def __init__(self, robot: "Robot", name: str, text: str) -> None:
        self.robot = robot
        self.name = name
        self._globals: dict[str, Value] = {}
        main = parse(text, name)
        self._main = Thread("main")
        self._main.steps = self._body(Scope(self._main, main, None, self._globals))
        self._threads = [self._main]
        self._started = 0
        self._current = self._main
        self._left = 0

    @property
    def owner(self) -> str:
        """Name of the thread that runs now: only one thread at a time may move the arm."""
        return self._current.name

    def step(self) -> bool:
        """One control cycle; False when the program has ended.

        Raises
        ------
        ScriptError, MotionError
            When the program stops with a run-time error.
        """
        for thread in self._threads:  # a thread started in this cycle runs in it
            self._current = thread
            self._left = STATEMENTS_PER_CYCLE
            try:
                if not thread.done:
                    next(thread.steps)
            except StopIteration:
                thread.done = True
            except _Halt:
                return False
            except RecursionError:
                raise ScriptError("functions call each other without an end") from None
        self._threads = [thread for thread in self._threads if not thread.done]
        return not self._main.done

    def close(self) -> None:
        """End the program and its threads; a moving arm comes to rest."""
        for thread in self._threads:
            thread.steps.close()

    # -- statements ---------------------------------------------------------------------------------------------------

    def _body(self, scope: Scope) -> Run:
        try:
            yield from self._block(scope, scope.function.body)
        except _Leave as leave:
            if leave.word != "return":
                raise ScriptError(f"{leave.word} outside of a loop") from None
            return leave.value

    def _block(self, scope: Scope, statements: tuple[Statement, ...]) -> Run:
        for statement in statements:
            yield from self._statement(scope, statement)

    def _count(self) -> None:
        self._left -= 1
        if self._left < 0:
            raise ScriptError(f"{STATEMENTS_PER_CYCLE} statements in one cycle: a loop needs sync() or sleep()")

    def _statement(self, scope: Scope, statement: Statement) -> Run:
        self._count()
        match statement:
            case Assignment():
                yield from self._assign(scope, statement)
            case If():
                for condition, block in statement.branches:
                    if (yield from self._truth(scope, condition)):
                        yield from self._block(scope, block)
                        break
            case While():
                yield from self._while(scope, statement)
            case Keyword():
                yield from self._keyword(scope, statement)
            case _:
                yield from self._value(scope, statement)

    def _while(self, scope: Scope, loop: While) -> Run:
        while (yield from self._truth(scope, loop.condition)):
            self._count()
            try:
                yield from self._block(scope, loop.body)
            except _Leave as leave:
                if leave.word == "break":
                    return
                if leave.word == "return":
                    raise

    def _keyword(self, scope: Scope, statement: Keyword) -> Run:
        value = None if statement.value is None else (yield from self._value(scope, statement.value))
        if statement.word == "halt":
            raise _Halt
        if statement.word in ("break", "continue", "return"):
            raise _Leave(statement.word, value)
        if statement.word in ("kill", "join"):
            if not isinstance(value, Thread):
                raise ScriptError(f"{statement.word} needs a thread, not {shown(value)}")
            if value is scope.thread:
                raise ScriptError(f"a thread cannot {statement.word} itself")
            if statement.word == "kill":
                value.done = True
                value.steps.close()
            while not value.done:
                yield

    def _assign(self, scope: Scope, statement: Assignment) -> Run:
        name, value = statement.name, (yield from self._value(scope, statement.value))
        if value is None:
            raise ScriptError(f"{name} = a function without a value")
        if statement.index is not None:
            index = yield from self._value(scope, statement.index)
            self._element(self._variable(scope, name), index)  # must exist
            self._variable(scope, name)[index] = value
            return
        free = not statement.scope and name not in scope.variables and name in self._globals
        variables = self._globals if free or statement.scope == "global" else scope.variables
        variables[name] = list(value) if type(value) is list else value

    def _variable(self, scope: Scope, name: str) -> Value:
        for variables in (scope.variables, self._globals):
            if name in variables:
                return variables[name]
        raise ScriptError(f"the variable {name} has no value here")

    # -- expressions --------------------------------------------------------------------------------------------------

    def _truth(self, scope: Scope, condition: Expression) -> Generator[None, None, bool]:
        value = yield from self._value(scope, condition)
        if not isinstance(value, bool):
            raise ScriptError(f"a condition must be True or False, not {shown(value)}")
        return value

    def _value(self, scope: Scope, expression: Expression) -> Run:
        match expression:
            case Literal():
                return expression.value
            case Name():
                return self._variable(scope, expression.name)
            case Items():
                values = yield from self._values(scope, expression.items)
                return Pose(values) if expression.pose else values
            case Item():
                whole = yield from self._value(scope, expression.whole)
                return self._element(whole, (yield from self._value(scope, expression.index)))
            case Call():
                return (yield from self._call(scope, expression))
            case Operation():
                return (yield from self._operation(scope, expression))

    def _values(self, scope: Scope, expressions: tuple[Expression, ...]) -> Generator[None, None, list[Value]]:
        values = []
        for expression in expressions:
            values.append((yield from self._value(scope, expression)))
        return values

    def _element(self, whole: Value, index: Value) -> Value:
        if not isinstance(whole, list) or type(index) is not int or not 0 <= index < len(whole):
            raise ScriptError(f"{shown(whole)} has no element {shown(index)}")
        return whole[index]

    def _operation(self, scope: Scope, expression: Operation) -> Run:
        word, first = expression.operator, expression.operands[0]
        if word in ("not", "and", "or", "xor"):
            left = yield from self._truth(scope, first)
            if word == "not":
                return not left
            if word != "xor" and left == (word == "or"):
                return left
            right = yield from self._truth(scope, expression.operands[1])
            return left != right if word == "xor" else right
        a = yield from self._value(scope, first)
        if word in ("-x", "+x"):
            return self._arithmetic("*", -1 if word == "-x" else 1, a)
        b = yield from self._value(scope, expression.operands[1])
        if word in ("==", "!="):
            return (a == b) == (word == "==")
        if word in ORDER:
            if not (is_number(a) and is_number(b)):
                raise ScriptError(f"{shown(a)} {word} {shown(b)} compares no numbers")
            return ORDER[word](a, b)
        return self._arithmetic(word, a, b)

    def _arithmetic(self, word: str, a: Value, b: Value) -> Value:
        if is_number(a) and is_number(b):
            if word in "/%" and b == 0:
                raise ScriptError(f"{a} {word} {b}: division by zero")
            result = ARITHMETIC[word](a, b)
            return int(result) if word == "%" and isinstance(a, int) and isinstance(b, int) else result
        if type(a) is list or type(b) is list:
            return self._elementwise(word, a, b)
        raise ScriptError(f"{shown(a)} {word} {shown(b)} is not possible")

    def _elementwise(self, word: str, a: Value, b: Value) -> list[Value]:
        """Arithmetic on lists; source: UR, "URScript command - Linear Algebra Examples": since 3.14 and 5.9."""
        major, minor, _bugfix = self.robot.settings.polyscope
        if minor < {3: 14, 5: 9}.get(major, 0):
            raise ScriptError(f"no arithmetic on lists before PolyScope 3.14 and 5.9: {shown(a)} {word} {shown(b)}")
        size = len(a if type(a) is list else b)
        if any(isinstance(side, list) and (type(side) is not list or len(side) != size) for side in (a, b)):
            raise ScriptError(f"{shown(a)} {word} {shown(b)} needs two lists of the same length")
        left, right = (side if isinstance(side, list) else [side] * size for side in (a, b))
        return [self._arithmetic(word, x, y) for x, y in zip(left, right, strict=True)]

    # -- calls --------------------------------------------------------------------------------------------------------

    def _call(self, scope: Scope, call: Call) -> Run:
        args = yield from self._values(scope, call.args)
        named = dict(zip(call.named, (yield from self._values(scope, tuple(call.named.values()))), strict=True))
        found = scope.find(call.name)
        if found is None:
            if call.run:
                raise ScriptError(f"there is no thread {call.name}")
            return (yield from self._built_in(call.name, args, named))
        function, home = found
        if function.thread != call.run:
            raise ScriptError(f"{call.name} is {'a thread: say run' if function.thread else 'no thread'}")
        self._started += call.run
        thread = Thread(f"{call.name} {self._started}") if call.run else scope.thread
        inner = Scope(thread, function, home, {})
        yield from self._bind(inner, args, named)
        if not call.run:
            return (yield from self._body(inner))
        thread.steps = self._body(inner)
        self._threads.append(thread)
        return thread

    def _bind(self, inner: Scope, args: list[Value], named: dict[str, Value]) -> Run:
        function = inner.function
        names = [name for name, _ in function.parameters]
        given = dict(zip(names, args, strict=False)) | named
        if len(args) > len(names) or len(given) < len(args) + len(named) or not given.keys() <= set(names):
            raise ScriptError(f"{function.name}({', '.join(names)}) is called with other arguments")
        for name, default in function.parameters:
            if name not in given:
                if default is None:
                    raise ScriptError(f"{function.name}: the argument {name} is missing")
                given[name] = yield from self._value(inner, default)
        inner.variables.update(given)

    def _built_in(self, name: str, args: list[Value], named: dict[str, Value]) -> Run:
        function = FUNCTIONS.get(name)
        if function is None:
            raise ScriptError(f"the function {name} does not exist or is not modelled by this emulator")
        try:
            signature(function).bind(self, *args, **named)
        except TypeError as error:
            raise ScriptError(f"{name}: {error}") from None
        result = function(self, *args, **named)
        return (yield from cast("Run", result)) if isgenerator(result) else result
