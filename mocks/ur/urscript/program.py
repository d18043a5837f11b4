"""A program in URScript, run one control cycle at a time.

From: Universal Robots, "The URScript Programming Language", chapter 1.

Chosen here: a condition must be true or false, a division of whole numbers is not rounded. A program that computes for
ever in one cycle ends with a run-time error; a real controller would lose its connection to the pendant.
"""

import ast
from collections.abc import Generator
from inspect import isgenerator, signature
from typing import TYPE_CHECKING, Any

from mocks.ur.urscript.library import FUNCTIONS, ScriptError, number, text_of
from mocks.ur.urscript.syntax import OPERATORS, Assignment, Block, Halt, Statement, parse

if TYPE_CHECKING:
    from mocks.ur.robot import Robot

STATEMENTS_PER_CYCLE = 2000

Value = Any
"""A number, a truth value, a text, a list of values, or None from a function without a value."""
Run = Generator[None, None, None]
"""Statements that are being executed; each `next()` is one control cycle."""


class _Halted(Exception):
    """The program ends itself."""


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
        self._variables: dict[str, Value] = {}
        self._steps = self._block(parse(text))
        self._left = 0

    def step(self) -> bool:
        """Run one control cycle; return False when the program has ended.

        Raises
        ------
        ScriptError, MotionError
            When the program stops with a run-time error.
        """
        self._left = STATEMENTS_PER_CYCLE
        try:
            next(self._steps)
        except (StopIteration, _Halted):
            return False
        except RecursionError:
            raise ScriptError("an expression is nested too deeply") from None
        return True

    def close(self) -> None:
        """End the program; a moving arm comes to rest."""
        self._steps.close()

    def _block(self, statements: tuple[Statement, ...]) -> Run:
        for statement in statements:
            self._count()
            match statement:
                case Assignment():
                    self._variables[statement.name] = self._value(statement.value)
                case Block(word="if"):
                    if self._truth(statement.condition):
                        yield from self._block(statement.body)
                case Block():
                    while self._truth(statement.condition):
                        self._count()
                        yield from self._block(statement.body)
                case Halt():
                    raise _Halted
                case _:
                    result = self._evaluate(statement)
                    if isgenerator(result):
                        yield from result

    def _count(self) -> None:
        self._left -= 1
        if self._left < 0:
            raise ScriptError(f"{STATEMENTS_PER_CYCLE} statements in one cycle: a loop needs sleep()")

    def _truth(self, condition: ast.expr) -> bool:
        value = self._value(condition)
        if not isinstance(value, bool):
            raise ScriptError(f"a condition must be True or False, not {text_of(value)}")
        return value

    def _value(self, expression: ast.expr) -> Value:
        value = self._evaluate(expression)
        if value is None or isgenerator(value):
            raise ScriptError("a function without a value stands for one")
        return value

    def _evaluate(self, expression: ast.expr) -> Value:
        """Return a value, or what a call statement has to wait for."""
        match expression:
            case ast.Constant():
                return expression.value
            case ast.Name(id=name):
                if name not in self._variables:
                    raise ScriptError(f"the variable {name} has no value here")
                return self._variables[name]
            case ast.List(elts=items):
                return [self._value(item) for item in items]
            case ast.Subscript(value=whole, slice=index):
                return _element(self._value(whole), self._value(index))
            case ast.UnaryOp(operand=operand):
                return -number(self._value(operand), "what follows the minus sign")
            case (
                ast.BinOp(left=left, op=operator, right=right)
                | ast.Compare(left=left, ops=[operator], comparators=[right])
            ):
                return _operate(operator, self._value(left), self._value(right))
            case ast.Call(func=ast.Name(id=name), args=args, keywords=keywords):
                return self._call(
                    name, *map(self._value, args), **{k.arg: self._value(k.value) for k in keywords if k.arg}
                )
        raise ScriptError("an expression is not modelled by this emulator")

    def _call(self, name: str, /, *args: Value, **named: Value) -> Value:
        function = FUNCTIONS.get(name)
        if function is None:
            raise ScriptError(f"the function {name} does not exist or is not modelled by this emulator")
        try:
            signature(function).bind(self, *args, **named)
        except TypeError as error:
            raise ScriptError(f"{name}: {error}") from None
        return function(self, *args, **named)


def _element(whole: Value, index: Value) -> Value:
    if not isinstance(whole, list) or type(index) is not int or not 0 <= index < len(whole):
        raise ScriptError(f"{text_of(whole)} has no element {text_of(index)}")
    return whole[index]


def _operate(operator: ast.AST, left: Value, right: Value) -> Value:
    """Combine two numbers; any two values may be tested for equality."""
    if not isinstance(operator, ast.Eq | ast.NotEq):
        left, right = (number(side, "what an operator combines") for side in (left, right))
    return OPERATORS[type(operator)](left, right)
