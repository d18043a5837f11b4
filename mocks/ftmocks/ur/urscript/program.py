"""A program in URScript, run one control cycle at a time: threads, variables and statements.

Source: Universal Robots, "The URScript Programming Language", chapter 1 ("Scoping rules", "Threads", "Thread
scheduling"). What the program itself assigns is global. In a function or thread, a variable without ``local`` or
``global`` is the global one when that exists, else it is local. Every thread runs in every cycle until it waits:
``sync``, ``sleep``, ``join`` and motions use up its cycle.

Chosen here, where the manual is silent:

* The main program runs first in a cycle, then the threads in the order of their start. A thread runs in the cycle in
  which it is started.
* ``kill`` releases the arm from a thread that moves it, and so does the end of the thread. The arm then decelerates by
  itself, and a ``stopj`` in the same cycle replaces this deceleration. A motion command while another thread moves the
  arm is a run-time error.
* A critical section has no effect, because a thread is never interrupted before it waits. Others are not held while
  it waits: the external control program of the client library moves the arm in one, and is stopped meanwhile.
* Everything ends with the main program. ``return`` ends a thread, whatever its value is.
* A condition must be True or False. A variable keeps its type, of which all numbers have one, and a list its length.
  What a function returns keeps its type: see docs/reference/urscript-constructs.md for the reports.
* A thread that never stops computing in one cycle is a run-time error. According to the manual it
  continues in the next cycle, and the connection to the controller may be lost.
"""

from collections.abc import Generator
from inspect import isgenerator, signature

from ftmocks.ur.controller_program import ControllerProgram, Place, ScriptError
from ftmocks.ur.robot import Robot
from ftmocks.ur.urscript.library import functions
from ftmocks.ur.urscript.parser import parse
from ftmocks.ur.urscript.syntax import (
    Assignment,
    Block,
    Call,
    Expression,
    If,
    Item,
    Items,
    Keyword,
    Literal,
    Name,
    Operation,
    Statement,
    While,
)
from ftmocks.ur.urscript.threads import Halt, Leave, Run, Scope, Thread
from ftmocks.ur.urscript.types import same_type
from ftmocks.ur.urscript.values import Pose, Value, combined, element, negative, number, single, text_of, truth

STATEMENTS_PER_CYCLE = 2000


class Program(ControllerProgram):
    """One program from a client.

    Parameters
    ----------
    robot
        The controller on which the program runs.
    name
        Name of the program, as the dashboard shows it.
    text
        Text of the program in URScript.

    Raises
    ------
    UrscriptSyntaxError
        The text is not a program.
    """

    def __init__(self, robot: Robot, name: str, text: str) -> None:
        super().__init__(name)
        self.robot = robot
        self._built_in = functions(robot.settings.polyscope)
        self._globals: dict[str, Value] = {}
        main, self.doubts = parse(text, name, self._built_in)
        self._returned: dict[int, Value] = {}
        """For each function, by identity, a value that it has returned: later ones must have the same type."""
        self._main = Thread("main")
        self._main.steps = self._body(Scope(self._main, main, None, self._globals))
        self._threads = [self._main]
        self._started = 0
        self._current = self._main
        self._left = 0
        self._checked: set[int] = set()
        """Identities of the calls whose arguments were checked and fit the function."""

    @property
    def owner(self) -> str:
        """Name of the running thread: only one thread at a time may move the arm."""
        return self._current.name

    @property
    def place(self) -> Place:
        """Position of the running thread in the text."""
        return self._current.place

    def begin_cycle(self) -> None:
        """Give the running thread a full allowance of statements again, as at the start of a cycle."""
        self._left = STATEMENTS_PER_CYCLE

    def step(self) -> bool:
        """Run one control cycle; return False if the program has ended.

        Raises
        ------
        ScriptError, MotionError
            The program stops with a run-time error.
        """
        for thread in self._threads:  # a thread that was started in this cycle also runs in it
            self._current = thread
            self.begin_cycle()
            try:
                thread.step()
            except Halt:
                return False
            except RecursionError:
                raise ScriptError("functions call each other endlessly, or expressions are nested too deeply") from None
            if thread.is_done:
                self.robot.arm.release(thread.name)
        self._threads = [thread for thread in self._threads if not thread.is_done]
        return not self._main.is_done

    def close(self) -> None:
        """End the program and its threads; a moving arm comes to rest."""
        for thread in self._threads:
            thread.kill()

    def _body(self, scope: Scope) -> Run:
        try:
            yield from self._block(scope, scope.function.body)
        except Leave as leave:
            if leave.word != "return":
                raise ScriptError(f"{leave.word} outside of a loop") from None
            if not scope.function.is_thread:
                before = self._returned.setdefault(id(scope.function), leave.value)
                if type(before) is not type(leave.value):
                    raise _changed(f"the value of {scope.function.name}", before, leave.value) from None
            return leave.value

    def _block(self, scope: Scope, statements: Block) -> Run:
        for statement in statements:
            yield from self._statement(scope, statement)

    def _count(self) -> None:
        self._left -= 1
        if self._left < 0:
            raise ScriptError(f"{STATEMENTS_PER_CYCLE} statements in one cycle: a loop needs sync() or sleep()")

    def _statement(self, scope: Scope, statement: Statement) -> Run:
        self._count()
        scope.thread.place = statement.place
        match statement:
            case Assignment():
                yield from self._assign(scope, statement)
            case If():
                for condition, block in statement.branches:
                    if truth((yield from self._value(scope, condition))):
                        yield from self._block(scope, block)
                        break
            case While():
                yield from self._while(scope, statement)
            case Keyword():
                yield from self._keyword(scope, statement)
            case Call():
                yield from self._call(scope, statement)

    def _while(self, scope: Scope, loop: While) -> Run:
        while truth((yield from self._value(scope, loop.condition))):
            self._count()
            try:
                yield from self._block(scope, loop.body)
            except Leave as leave:
                if leave.word == "break":
                    return
                if leave.word == "return":
                    raise
            scope.thread.place = loop.place

    def _keyword(self, scope: Scope, statement: Keyword) -> Run:
        word = statement.word
        value = None if statement.value is None else (yield from self._value(scope, statement.value))
        match word:
            case "halt":
                raise Halt
            case "break" | "continue" | "return":
                raise Leave(word, value)
            case "kill" | "join":
                if not isinstance(value, Thread) or value is scope.thread:
                    raise ScriptError(f"{word} needs another thread, not {text_of(value)}")
                if word == "kill":
                    value.kill()
                    self.robot.arm.release(value.name)
                while not value.is_done:
                    yield

    def _assign(self, scope: Scope, statement: Assignment) -> Run:
        name, value = statement.name, (yield from self._value(scope, statement.value))
        if value is None:
            raise ScriptError(f"{name} = a function without a value")
        if statement.index is not None:
            whole, index = self._variable(scope, name), (yield from self._value(scope, statement.index))
            element(whole, index)  # raises if the element does not exist
            whole[index] = single(value)
            return
        is_global = statement.scope == "global" or (
            not statement.scope and name not in scope.variables and name in self._globals
        )
        variables = self._globals if is_global else scope.variables
        before = variables.get(name, value)
        if not same_type(type(before).__name__, type(value).__name__):
            raise _changed(f"the variable {name}", before, value)
        if isinstance(before, list) and len(before) != len(value):
            raise ScriptError(f"Resizing of 'List' is not supported: {name} has {len(before)} elements")
        variables[name] = type(value)(value) if isinstance(value, list) else value

    def _variable(self, scope: Scope, name: str) -> Value:
        for variables in (scope.variables, self._globals):
            if name in variables:
                return variables[name]
        raise ScriptError(f"the variable {name} has no value here")

    def _value(self, scope: Scope, expression: Expression) -> Run:
        match expression:
            case Literal():
                return expression.value
            case Name():
                return self._variable(scope, expression.name)
            case Items():
                values = yield from self._values(scope, expression.items)
                return Pose(values) if expression.is_pose else [single(value) for value in values]
            case Item():
                whole = yield from self._value(scope, expression.whole)
                return element(whole, (yield from self._value(scope, expression.index)))
            case Call():
                return (yield from self._call(scope, expression))
            case Operation():
                return (yield from self._operation(scope, expression))

    def _values(self, scope: Scope, expressions: tuple[Expression, ...]) -> Generator[None, None, list[Value]]:
        values = []
        for expression in expressions:
            values.append((yield from self._value(scope, expression)))
        return values

    def _operation(self, scope: Scope, expression: Operation) -> Run:
        word, (first, *rest) = expression.operator, expression.operands
        left = yield from self._value(scope, first)
        match word:
            case "not":
                return not truth(left)
            case "-x":
                return negative(left)
            case "+x":
                return number(left, "what follows the plus sign")
            case "and" | "or" if truth(left) == (word == "or"):
                return left
        right = yield from self._value(scope, rest[0])
        match word:
            case "and" | "or":
                return truth(right)
            case "xor":
                return truth(left) != truth(right)
        return combined(word, left, right)

    def _call(self, scope: Scope, call: Call) -> Run:
        args = yield from self._values(scope, call.args)
        named = dict(zip(call.named, (yield from self._values(scope, tuple(call.named.values()))), strict=True))
        scope.thread.place = call.place
        found = scope.find(call.name)
        if found is None:
            return (yield from self._call_built_in(call, args, named))
        function, home = found
        if function.is_thread != call.runs:
            raise ScriptError(f"{call.name} is {'a thread: write run' if function.is_thread else 'no thread'}")
        self._started += call.runs
        thread = Thread(f"{call.name} {self._started}") if call.runs else scope.thread
        inner = Scope(thread, function, home, {})
        yield from self._bind(inner, args, named)
        if not call.runs:
            return (yield from self._body(inner))
        thread.steps = self._body(inner)
        self._threads.append(thread)
        return thread

    def _bind(self, inner: Scope, args: list[Value], named: dict[str, Value]) -> Run:
        function = inner.function
        names = [name for name, _default in function.parameters]
        given = dict(zip(names, args, strict=False)) | named
        if len(args) > len(names) or len(given) < len(args) + len(named) or not given.keys() <= set(names):
            raise ScriptError(f"{function.name}({', '.join(names)}) is called with other arguments")
        for name, default in function.parameters:
            if name not in given:
                if default is None:
                    raise ScriptError(f"{function.name}: the argument {name} is missing")
                given[name] = yield from self._value(inner, default)
        inner.variables.update(given)

    def _call_built_in(self, call: Call, args: list[Value], named: dict[str, Value]) -> Run:
        function = self._built_in.get(call.name)
        if function is None or call.runs:
            raise ScriptError(f"{call.name} is {'no thread' if call.runs else 'not defined'} here")
        if id(call) not in self._checked:
            try:
                signature(function).bind(self, *args, **named)
            except TypeError as error:
                raise ScriptError(f"{call.name}: {error}") from None
            self._checked.add(id(call))
        result = function(self, *args, **named)
        return (yield from result) if isgenerator(result) else result


def _changed(what: str, before: Value, now: Value) -> ScriptError:
    one, other = ("nothing" if value is None else type(value).__name__ for value in (before, now))
    return ScriptError(f"Type error: {what} changes from {one} to {other}")
