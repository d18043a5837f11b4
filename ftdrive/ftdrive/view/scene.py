"""The cell in three dimensions: arm, tool and surroundings, and what acts on the tool. Metres, base axes."""

from collections.abc import Collection
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from ftdrive.planning.geometry.arm_model import ArmModel
from ftdrive.planning.geometry.certify import Certifier
from ftdrive.planning.geometry.scene import Plane, Scene
from ftdrivers.ur.kinematics import Array

if TYPE_CHECKING:
    from viser import SceneApi

Colour = tuple[int, int, int]
ARM: Final[Colour] = (150, 155, 165)
TOOL: Final[Colour] = (235, 130, 40)
GHOST: Final[Colour] = (60, 130, 230)
OBSTACLE: Final[Colour] = (90, 160, 110)
BAD: Final[Colour] = (215, 40, 40)
_TORQUE: Final[Colour] = (140, 60, 200)
# Facets around a body, and over a quarter of its rounding.
_AROUND, _ARC = 24, 6


class DrawnArm:
    """An arm with its tool, which `show` moves.

    Parameters
    ----------
    name : str
        In the tree of the scene.
    ghost : bool
        Transparent: where the arm will be.
    """

    def __init__(self, scene: "SceneApi", arm: ArmModel, name: str = "/arm", *, ghost: bool = False) -> None:
        self._arm = arm
        bodies = arm.bodies(np.zeros((1, 6)))
        beyond = carried(arm)
        self._colours = [GHOST if ghost else TOOL if i in beyond else ARM for i in range(len(arm.names))]
        self._meshes = [
            scene.add_mesh_simple(
                f"{name}/{i} {body}",
                *revolved(bodies.half_length_m[i], bodies.radius_m[i], bodies.rounding_m[i]),
                color=self._colours[i],
                opacity=0.25 if ghost else None,
                cast_shadow=not ghost,
            )
            for i, body in enumerate(arm.names)
        ]

    def show(self, q_rad: ArrayLike) -> None:
        """Move to joint angles (6,)."""
        bodies = self._arm.bodies(np.reshape(np.asarray(q_rad, dtype=np.float64), (1, 6)))
        for mesh, at_m, wxyz in zip(self._meshes, bodies.centre_m[0], turned_up(bodies.axis[0]), strict=True):
            mesh.position, mesh.wxyz, mesh.visible = at_m, wxyz, True

    def hide(self) -> None:
        """Draw nothing until it is shown again."""
        for mesh in self._meshes:
            mesh.visible = False

    def reveal(self) -> None:
        """Draw the tool transparent, so that a wrench inside it is seen."""
        for mesh, colour in zip(self._meshes, self._colours, strict=True):
            if colour == TOOL:
                mesh.opacity = 0.45

    def accuse(self, names: Collection[str]) -> None:
        """Draw these bodies red, the others as they are."""
        for mesh, name, colour in zip(self._meshes, self._arm.names, self._colours, strict=True):
            mesh.color = BAD if name in names else colour


def carried(arm: ArmModel) -> range:
    """Return the bodies beyond the flange by their place in `names`: the tool, and a load that hangs from it."""
    return range(arm.names.index("tool 1"), len(arm.names))


def draw_surroundings(scene: "SceneApi", surroundings: Scene, size_m: float, bad: Collection[str] = ()) -> None:
    """Draw base axes, planes as squares of `size_m`, and boxes; those named in `bad`, such as "plane 2", are red."""
    scene.add_frame("/base", axes_length=0.2, axes_radius=0.004)
    for i, plane in enumerate(surroundings.planes, start=1):
        scene.add_box(
            f"/surroundings/plane {i}",
            BAD if f"plane {i}" in bad else OBSTACLE,
            (size_m, size_m, 0.002),
            opacity=0.3,
            position=_foot(plane),
            wxyz=turned_up(np.array(plane.normal)),
            cast_shadow=False,
        )
    for i, box in enumerate(surroundings.boxes, start=1):
        low, high = np.array(box.low_m), np.array(box.high_m)
        colour = BAD if f"box {i}" in bad else OBSTACLE
        # Not transparent: a transparent plane before it would hide it.
        scene.add_box(f"/surroundings/box {i}", colour, high - low, position=(low + high) / 2)


class DrawnWrench:
    """Force and torque at a point as arrows, and the line of action of the force."""

    def __init__(self, scene: "SceneApi", m_per_N: float = 0.01, m_per_Nm: float = 0.1) -> None:
        nowhere = np.zeros((1, 2, 3))
        self._scales = m_per_N, m_per_Nm
        self._arrows: list[Any] = [
            scene.add_arrows(f"/wrench/{name}", nowhere, colour, shaft_radius=0.008, head_radius=0.02, head_length=0.04)
            for name, colour in (("force", BAD), ("torque", _TORQUE))
        ]
        self._line: Any = scene.add_line_segments("/wrench/line of action", nowhere, BAD, thickness=0.003)
        self.hide()

    def show(self, p_base_m: Array, wrench_base: Array) -> None:
        """Draw a wrench (6,) about a point (3,), N and N·m, base axes; a force or a torque of zero is not drawn."""
        for arrow, vector, scale in zip(self._arrows, wrench_base.reshape(2, 3), self._scales, strict=True):
            arrow.visible = bool(vector.any())
            if arrow.visible:
                arrow.points = np.array([[p_base_m, p_base_m + scale * vector]])
        self._line.visible = self._arrows[0].visible
        if self._line.visible:
            self._line.points = line_of_action(p_base_m, wrench_base)

    def hide(self) -> None:
        """Draw nothing until it is shown again."""
        for drawn in (*self._arrows, self._line):
            drawn.visible = False


def line_of_action(p_m: Array, wrench: Array, half_m: float = 0.5) -> Array:
    """Return the line (1, 2, 3) along which a force alone explains force and, as far as one can, torque about `p_m`."""
    force, torque = wrench[:3], wrench[3:]
    squared = float(force @ force)
    if squared == 0:
        return np.broadcast_to(p_m, (1, 2, 3)).copy()
    foot, along = p_m + np.cross(force, torque) / squared, half_m * force / np.sqrt(squared)
    return np.array([[foot - along, foot + along]])


def size_of(certifier: Certifier) -> float:
    """Return twice the reach of an arm, metres: planes are drawn so large."""
    arm = certifier.arm
    return 2 * (arm.ball_m + float(np.linalg.norm(arm.kinematics.links_m[1:3], axis=1).sum()))


def revolved(half_length_m: float, radius_m: float, rounding_m: float) -> tuple[Array, Any]:
    """Vertices (n, 3) and faces (m, 3) of a cylinder along z with rounded edges; a capsule where its radius is zero."""
    arc = np.linspace(0, np.pi / 2, _ARC + 1) if rounding_m else np.zeros(1)
    radius = radius_m + rounding_m * np.cos(arc)
    height = half_length_m + rounding_m * np.sin(arc)
    radius, height = np.append(radius, 0.0), np.append(height, height[-1])
    radius, height = np.concatenate([radius[::-1], radius]), np.concatenate([-height[::-1], height])
    turn = np.linspace(0, 2 * np.pi, _AROUND, endpoint=False)
    ring = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    vertices = np.concatenate(
        [radius[:, None, None] * ring, np.broadcast_to(height[:, None, None], (len(radius), _AROUND, 1))], axis=2
    )
    low = np.arange((len(radius) - 1) * _AROUND).reshape(-1, _AROUND)
    right, up = np.roll(low, -1, axis=1), low + _AROUND
    faces = np.stack([low, right, up, right, np.roll(up, -1, axis=1), up], axis=2)
    return vertices.reshape(-1, 3), faces.reshape(-1, 3)


def turned_up(axis: Array) -> Array:
    """Quaternions (..., 4), w first, that turn z into these directions (..., 3)."""
    half = axis + np.array([0.0, 0.0, 1.0])
    length = np.linalg.norm(half, axis=-1, keepdims=True)
    down = length < 1e-6
    half = np.where(down, np.array([1.0, 0.0, 0.0]), half / np.where(down, 1.0, length))
    x, y, z = np.moveaxis(half, -1, 0)
    return np.stack([z, -y, x, np.zeros_like(x)], axis=-1)


def turned(R: Array) -> Array:
    """Return the quaternion (4,), w first, of a rotation (3, 3)."""
    return np.asarray(Rotation.from_matrix(R).as_quat(scalar_first=True))


def _foot(plane: Plane) -> Array:
    return plane.offset_m * np.array(plane.normal)
