"""The values of URScript (numbers, truth values, texts, lists and poses), and its operators.

Source: Universal Robots, "The URScript Programming Language", chapter 1.

Chosen here: a division of whole numbers is not rounded; ``%`` has the sign of its left operand.

Does not model: arithmetic on lists and poses.
"""

import math
import operator
from collections.abc import Callable
from typing import Any

from ftmocks.kinematics import Vector6, vector6
from ftmocks.ur.controller_program import ScriptError

Value = Any
"""A number, a truth value, a text, a list of values, a pose, a thread, or None from a function without a value."""

_ARITHMETIC: dict[str, Callable[[Any, Any], Any]] = {
    "+": operator.add,
    "-": operator.sub,
    "*": operator.mul,
    "/": operator.truediv,
    "%": math.fmod,
}
_ORDER: dict[str, Callable[[Any, Any], bool]] = {
    "<": operator.lt,
    ">": operator.gt,
    "<=": operator.le,
    ">=": operator.ge,
}


class Pose(list[Value]):
    """``p[x, y, z, rx, ry, rz]``: m and rad, a rotation vector."""


def text_of(value: Value) -> str:
    """Return a value as text, as in a message on the pendant."""
    if isinstance(value, list):
        return ("p" if isinstance(value, Pose) else "") + "[" + ", ".join(map(text_of, value)) + "]"
    return "nothing" if value is None else str(value)


def is_number(value: Value) -> bool:
    """Whether a value is a number; a bool does not count as one."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def number(value: Value, what: str) -> float:
    """Return a value unchanged; raise an error unless it is a finite number."""
    if not is_number(value) or not math.isfinite(value):
        raise ScriptError(f"{what} must be a number, not {text_of(value)}")
    found: float = value
    return found


def whole_number(value: Value, what: str, low: int, high: int) -> int:
    """Return a value unchanged; raise an error unless it is an integer from `low` to `high`."""
    if type(value) is not int or not low <= value <= high:
        raise ScriptError(f"{what} must be a whole number from {low} to {high}, not {text_of(value)}")
    return int(value)


def numbers(value: Value, what: str, count: int) -> list[float]:
    """Return a value as numbers; raise an error unless it is a list of `count` numbers."""
    if type(value) is not list or len(value) != count:
        raise ScriptError(f"{what} must be a list of {count} numbers, not {text_of(value)}")
    return [number(item, what) for item in value]


def joints(value: Value, what: str) -> Vector6:
    """Return a value as joint angles, rad; raise an error unless it is a list of six numbers."""
    return vector6(numbers(value, what, 6))


def element(whole: Value, index: Value) -> Value:
    """Return an element of a list."""
    if not isinstance(whole, list) or type(index) is not int or not 0 <= index < len(whole):
        raise ScriptError(f"{text_of(whole)} has no element {text_of(index)}")
    return whole[index]


def single(value: Value) -> Value:
    """Return a value; raise an error unless it may be an element of a list: a pose may, a list may not."""
    if type(value) is list:
        raise ScriptError(f"a list of lists is not emulated: {text_of(value)}")
    return value


def truth(value: Value) -> bool:
    """Return a value unchanged; raise an error unless it is a bool."""
    if not isinstance(value, bool):
        raise ScriptError(f"a condition must be True or False, not {text_of(value)}")
    return value


def combined(sign: str, a: Value, b: Value) -> Value:
    """Apply an operator with two operands, other than ``and``, ``or`` and ``xor``.

    Raises
    ------
    ScriptError
        The operator does not apply to these values.
    """
    if sign in ("==", "!="):
        same_kind = (type(a) is bool) == (type(b) is bool)
        return (same_kind and a == b) == (sign == "==")
    if is_number(a) and is_number(b):
        if sign in _ORDER:
            return _ORDER[sign](a, b)
        if sign in "/%" and b == 0:
            raise ScriptError(f"{a} {sign} {b}: division by zero")
        result = _ARITHMETIC[sign](a, b)
        return int(result) if sign == "%" and isinstance(a, int) and isinstance(b, int) else result
    raise ScriptError(f"{text_of(a)} {sign} {text_of(b)} is not possible")


def negative(value: Value) -> Value:
    """Return a value with reversed sign."""
    return combined("*", -1, value)
