"""Parts of a page for the three-dimensional view of the cell, which `shell/scene.js` draws; m, base axes."""

from collections.abc import Collection, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from ftdrive.planning.geometry.arm_model import ArmModel
from ftdrive.planning.geometry.certify import Certifier
from ftdrive.planning.geometry.scene import Scene
from ftdrive.view.parts import Part, rounded_list
from ftdrivers.ur.kinematics import Array

# Names of the colours in the scene; `shell/page.css` defines each for light and dark mode.
ARM, TOOL, GHOST, OBSTACLE, BAD = "arm", "tool", "ghost", "obstacle", "bad"
FORCE, TORQUE, PATH, UNKNOWN = "force", "torque", "path", "unknown"


def body(half_length_m: float, radius_m: float, rounding_m: float, colour: str, **more: Any) -> Part:
    """Return a cylinder along z with rounded edges: a capsule if the radius is 0, a ball if the length is 0 too.

    `more`: position `at` (3,), quaternion `turn` (4,), w first, opacity `alpha`, `copies` (n, 7) with `at` and `turn`.
    """
    shape = rounded_list([half_length_m, radius_m, rounding_m])
    return {"kind": "body", "shape": shape, "colour": colour} | {
        name: rounded_list(value) for name, value in more.items()
    }


def ball(radius_m: float, colour: str, **more: Any) -> Part:
    """Return a ball; `more` as for `body`."""
    return body(0.0, 0.0, radius_m, colour, **more)


def box(size_m: ArrayLike, colour: str, **more: Any) -> Part:
    """Return a box centred at its origin; `more` as for `body`."""
    return {"kind": "box", "size": rounded_list(size_m), "colour": colour} | {
        name: rounded_list(one) for name, one in more.items()
    }


def path(points_m: Array, colour: str) -> Part:
    """Return a line through points (n, 3)."""
    return {"kind": "path", "points": rounded_list(points_m), "colour": colour}


def dots(points_m: ArrayLike, colours: Sequence[str], at: ArrayLike) -> Part:
    """Return round dots at points (n, 3) relative to `at`; their size on the screen does not depend on the zoom."""
    return {"kind": "dots", "points": rounded_list(points_m), "colours": list(colours), "at": rounded_list(at)}


def axes(length_m: float, at: ArrayLike = (0, 0, 0), turn: ArrayLike = (1, 0, 0, 0), *, named: bool = False) -> Part:
    """Return coordinate axes x, y, z in red, green and blue, with their names if `named`."""
    return {"kind": "axes", "length": length_m, "at": rounded_list(at), "turn": rounded_list(turn), "named": named}


def label(text: str, at: ArrayLike) -> Part:
    """Return a text at a point (3,), which no body hides."""
    return {"kind": "label", "text": text, "at": rounded_list(at)}


def camera(at_m: ArrayLike, from_m: ArrayLike) -> Part:
    """Return the camera with which a viewer starts: the point (3,) that it looks at, and its position (3,)."""
    return {"kind": "camera", "at": rounded_list(at_m), "from": rounded_list(from_m)}


def legend(*rows: tuple[str, str, str]) -> Part:
    """Return a legend; each row has a colour, a mark (`body`, `ball`, `line` or `arrow`) and a text."""
    return {"kind": "legend", "rows": [list(row) for row in rows]}


def arm_parts(
    arm: ArmModel,
    q_rad: ArrayLike | None,
    name: str = "arm",
    *,
    ghost: bool = False,
    clear: bool = False,
    bad: Collection[str] = (),
) -> dict[str, Part | None]:
    """Return parts that draw an arm with its tool at joint angles (6,), or that remove the arm if `q_rad` is None.

    A `ghost` is transparent and shows where the arm will be. With `clear`, the tool is transparent, so that a wrench
    drawn inside it is visible. Bodies named in `bad` are red.
    """
    names = [f"scene/{name}/{i}" for i in range(len(arm.names))]
    if q_rad is None:
        return dict.fromkeys([*names, f"scene/{name}/along"])
    q = np.reshape(np.asarray(q_rad, dtype=np.float64), (1, 6))
    bodies, beyond = arm.bodies(q), carried_bodies(arm)
    turns = turned_up(bodies.axis[0])
    parts: dict[str, Part | None] = {}
    for i, key in enumerate(names):
        colour = BAD if arm.names[i] in bad else GHOST if ghost else TOOL if i in beyond else ARM
        alpha = 0.25 if ghost else 0.45 if clear and i in beyond else 1.0
        shape = bodies.half_length_m[i], bodies.radius_m[i], bodies.rounding_m[i]
        parts[key] = body(*shape, colour, at=bodies.centre_m[0, i], turn=turns[i], alpha=alpha)
    if not ghost:
        # point and axis for the button "along the tool", with which the camera looks from the last body to the flange
        parts[f"scene/{name}/along"] = {
            "kind": "along",
            "at": rounded_list(bodies.centre_m[0, -1]),
            "axis": rounded_list(bodies.axis[0, -1]),
        }
    return parts


def carried_bodies(arm: ArmModel) -> range:
    """Return the indices of an arm model's bodies beyond the flange: the tool, and a load that hangs from it."""
    return range(arm.names.index("tool 1"), len(arm.names))


def surroundings(scene: Scene, size_m: float, bad: Collection[str] = ()) -> dict[str, Part | None]:
    """Return parts that draw base axes, planes as squares, and boxes; those named in `bad`, as "plane 2", are red."""
    parts: dict[str, Part | None] = {"scene/base": axes(0.25, named=True)}
    for i, plane in enumerate(scene.planes, start=1):
        colour = BAD if f"plane {i}" in bad else OBSTACLE
        normal = np.array(plane.normal)
        foot_m, turn = plane.offset_m * normal, turned_up(normal)
        parts[f"scene/plane {i}"] = box((size_m, size_m, 0.002), colour, at=foot_m, turn=turn, alpha=0.3)
    for i, one in enumerate(scene.boxes, start=1):
        low, high = np.array(one.low_m), np.array(one.high_m)
        parts[f"scene/box {i}"] = box(high - low, BAD if f"box {i}" in bad else OBSTACLE, at=(low + high) / 2)
    return parts


def wrench_parts(p_base_m: Array, wrench_base: Array, m_per_N: float, m_per_Nm: float) -> dict[str, Part | None]:
    """Return parts that draw force and torque as arrows, and the line of action of the force.

    The wrench (6,), N and N·m, acts about a point (3,), base axes; a zero force or torque is not drawn.
    """
    parts: dict[str, Part | None] = dict.fromkeys(NO_WRENCH)
    for name, vector, m in (("force", wrench_base[:3], m_per_N), ("torque", wrench_base[3:], m_per_Nm)):
        if vector.any():
            ends = rounded_list([p_base_m, p_base_m + m * vector])
            parts[f"scene/{name}"] = {"kind": "arrow", "ends": ends, "colour": name}
    force, torque = wrench_base[:3], wrench_base[3:]
    if squared := float(force @ force):
        # On this line, the force alone explains as much of the torque as possible.
        foot, along = p_base_m + np.cross(force, torque) / squared, 0.5 * force / np.sqrt(squared)
        parts["scene/line of action"] = path(np.array([foot - along, foot + along]), FORCE)
    return parts


NO_WRENCH: Final[dict[str, Part | None]] = {"scene/force": None, "scene/torque": None, "scene/line of action": None}
"""Parts that remove the arrows and the line of action drawn by `wrench_parts`."""


def size_of(certifier: Certifier) -> float:
    """Return twice the reach of the arm, m: the size of the drawn scene and of its planes."""
    arm = certifier.arm
    return 2 * (arm.ball_m + float(np.linalg.norm(arm.kinematics.links_m[1:3], axis=1).sum()))


def turned_up(axis: Array) -> Array:
    """Return quaternions (..., 4), w first, that rotate z into these directions (..., 3)."""
    half = axis + np.array([0.0, 0.0, 1.0])
    length = np.linalg.norm(half, axis=-1, keepdims=True)
    down = length < 1e-6
    half = np.where(down, np.array([1.0, 0.0, 0.0]), half / np.where(down, 1.0, length))
    x, y, z = np.moveaxis(half, -1, 0)
    return np.stack([z, -y, x, np.zeros_like(x)], axis=-1)
