"""Types of URScript that the text shows: variables keep their type, and so do the values that a function returns.

Types that the text does not show are checked when the program runs. These rules and their sources:
docs/reference/urscript-constructs.md.
"""

from collections.abc import Iterator

from ftmocks.ur.controller_program import Place
from ftmocks.ur.urscript.syntax import (
    Assignment,
    Block,
    Call,
    Expression,
    Function,
    If,
    Items,
    Keyword,
    Literal,
    Operation,
    Statement,
    UrscriptSyntaxError,
    While,
)

_TRUTH = {"not", "and", "or", "xor", "==", "!=", "<", ">", "<=", ">="}
Types = dict[str, str]
"""Type of each variable, by its name."""


def check_types(main: Function) -> None:
    """Reject a program in which a variable changes its type, or a function returns values of two types.

    Raises
    ------
    UrscriptSyntaxError
        A second type occurs; the error is at its position.
    """
    everywhere = {
        name for function in _functions(main) for _, scope, name, _ in _assignments(function) if scope == "global"
    }
    program = everywhere | {name for _, _, name, _ in _assignments(main)}
    shared: Types = {}
    for function in _functions(main):
        _check(function, shared, program, is_main=function is main)


def same_type(one: str, other: str) -> bool:
    """Whether a variable may have values of both types, by their names in Python; integers and floats are numbers."""
    return one == other or {one, other} == {"int", "float"}


def _functions(function: Function) -> Iterator[Function]:
    yield function
    for inner in function.functions.values():
        yield from _functions(inner)


def _check(function: Function, shared: Types, program: set[str], *, is_main: bool) -> None:
    local: Types = {}
    for place, scope, name, kind in _assignments(function):
        types = shared if is_main or scope == "global" or (not scope and name in program) else local
        if kind and not same_type(types.setdefault(name, kind), kind):
            raise _error(place, f"the variable {name} changes its type from {types[name]} to {kind}", name)
    returned: set[str] = set()
    for statement in _statements(function.body):
        if isinstance(statement, Keyword) and statement.word == "return" and not function.is_thread:
            kind = "nothing" if statement.value is None else type_of(statement.value)
            returned |= {kind} if kind else set()
            if len(returned) > 1:
                kinds = " and ".join(sorted(returned))
                raise _error(statement.place, f"{function.name} returns {kinds}", function.name)


def _error(place: Place, sentence: str, name: str) -> UrscriptSyntaxError:
    return UrscriptSyntaxError(place, sentence, f"compile_error_type:{name}:")


def _assignments(function: Function) -> Iterator[tuple[Place, str, str, str | None]]:
    """Yield place, qualifier, name and type of the values that are assigned to variables of a function."""
    for statement in _statements(function.body):
        if isinstance(statement, Assignment) and statement.index is None:
            yield statement.place, statement.scope, statement.name, type_of(statement.value)


def _statements(block: Block) -> Iterator[Statement]:
    for statement in block:
        yield statement
        if isinstance(statement, While):
            yield from _statements(statement.body)
        if isinstance(statement, If):
            for _, inner in statement.branches:
                yield from _statements(inner)


def type_of(expression: Expression) -> str | None:
    """Return the type of the value as the name of a Python type; None if the text does not show the type."""
    match expression:
        case Literal():
            return type(expression.value).__name__
        case Items():
            return "Pose" if expression.is_pose else "list"
        case Call(runs=True):
            return "Thread"
        case Operation(operator=word) if word in _TRUTH:
            return "bool"
        case Operation(operator="-x" | "+x", operands=(value,)):
            return type_of(value)
    return None
