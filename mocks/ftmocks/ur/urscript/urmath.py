"""The module urmath of URScript: numbers, lists and poses.

Source: Universal Robots, "The URScript Programming Language", module urmath.

Chosen here: `pose_sub` is the inverse of `pose_add`, whose rotation is that of the first pose times that of the second.
URScript has no ``abs``: `norm` of a number is its absolute value.
"""

import math
from collections.abc import Callable, Iterator

from ftmocks.arrays import Array
from ftmocks.kinematics import inverse_matrix, matrix_of, pose_of, rotation, rotvec
from ftmocks.ur.controller_program import ScriptError
from ftmocks.ur.urscript.values import Pose, Value, number, numbers, text_of

_OF_A_NUMBER: dict[str, Callable[[float], float]] = {
    "acos": math.acos,
    "asin": math.asin,
    "atan": math.atan,
    "ceil": math.ceil,
    "cos": math.cos,
    "d2r": math.radians,
    "floor": math.floor,
    "r2d": math.degrees,
    "sin": math.sin,
    "sqrt": math.sqrt,
    "tan": math.tan,
}


def functions_of_a_number() -> Iterator[tuple[str, Callable[..., float]]]:
    """Yield the names and the functions of one number `f`; angles are in radians."""
    for name, apply in _OF_A_NUMBER.items():

        def called(_program: object, f: Value, name: str = name, apply: Callable[[float], float] = apply) -> float:
            return apply(number(f, f"{name}: f"))

        yield name, called


def atan2(_program: object, x: Value, y: Value) -> float:
    """Return the angle of a point, rad; the manual calls the opposite side x."""
    return math.atan2(number(x, "atan2: x"), number(y, "atan2: y"))


def pow(_program: object, base: Value, exponent: Value) -> float:
    """Return `base` to the power of `exponent`."""
    return math.pow(number(base, "pow: base"), number(exponent, "pow: exponent"))


def length(_program: object, v: Value) -> int:
    """Return the number of elements of a list or text."""
    if not isinstance(v, list | str):
        raise ScriptError(f"length: {text_of(v)} is not a list")
    return len(v)


def norm(_program: object, a: Value) -> float:
    """Return the absolute value of a number, or the Euclidean length of a list or pose."""
    return math.hypot(*(number(value, "norm: a") for value in (a if isinstance(a, list) else [a])))


def normalize(program: object, v: Value) -> list[float]:
    """Return a list with the same direction and norm 1."""
    size = norm(program, v)
    if not (isinstance(v, list) and size):
        raise ScriptError(f"normalize: {text_of(v)} has no direction")
    return [value / size for value in v]


def matrix(value: Value, what: str) -> Array:
    """Return the (4, 4) matrix of a pose."""
    if not isinstance(value, Pose):
        raise ScriptError(f"{what} must be a pose, not {text_of(value)}")
    return matrix_of(numbers(list(value), what, 6))


def pose_trans(_program: object, p_from: Value, p_from_to: Value) -> Pose:
    """Return the second pose, given in the frame of the first pose, in the frame in which the first pose is given."""
    return Pose(pose_of(matrix(p_from, "pose_trans: p_from") @ matrix(p_from_to, "pose_trans: p_from_to")))


def pose_inv(_program: object, p_from: Value) -> Pose:
    """Return the inverse of a pose."""
    return Pose(pose_of(inverse_matrix(matrix(p_from, "pose_inv: p_from"))))


def pose_add(_program: object, p_1: Value, p_2: Value) -> Pose:
    """Add the positions, and multiply the first rotation by the second."""
    X_1, X_2 = matrix(p_1, "pose_add: p_1"), matrix(p_2, "pose_add: p_2")
    return Pose([*(X_1[:3, 3] + X_2[:3, 3]).tolist(), *rotvec(X_1[:3, :3] @ X_2[:3, :3]).tolist()])


def pose_sub(_program: object, p_to: Value, p_from: Value) -> Pose:
    """Return the pose that must be added to the second pose to give the first."""
    X_to, X_from = matrix(p_to, "pose_sub: p_to"), matrix(p_from, "pose_sub: p_from")
    return Pose([*(X_to[:3, 3] - X_from[:3, 3]).tolist(), *rotvec(X_from[:3, :3].T @ X_to[:3, :3]).tolist()])


def interpolate_pose(_program: object, p_from: Value, p_to: Value, alpha: Value) -> Pose:
    """Return a pose on the straight line between two poses: the first for 0, the second for 1."""
    X, X_to = matrix(p_from, "interpolate_pose: p_from"), matrix(p_to, "interpolate_pose: p_to")
    share = number(alpha, "interpolate_pose: alpha")
    turn = rotation(share * rotvec(X[:3, :3].T @ X_to[:3, :3]))
    place = X[:3, 3] + share * (X_to[:3, 3] - X[:3, 3])
    return Pose([*place.tolist(), *rotvec(X[:3, :3] @ turn).tolist()])


def point_dist(_program: object, p_from: Value, p_to: Value) -> float:
    """Return the distance between the positions of two poses, m."""
    way = matrix(p_to, "point_dist: p_to")[:3, 3] - matrix(p_from, "point_dist: p_from")[:3, 3]
    return math.hypot(*way.tolist())
