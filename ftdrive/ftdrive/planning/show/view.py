"""A plan in three dimensions, in the browser, with a slider along the tour."""

import os
import sys
import webbrowser
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager, redirect_stdout
from io import StringIO
from itertools import pairwise
from typing import Any

import numpy as np

from ftdrive.errors import ConfigError
from ftdrive.http_gate import Gate, hidden_host
from ftdrive.planning.geometry.certify import Certifier
from ftdrive.planning.geometry.scene import Plane
from ftdrive.planning.motion import tips
from ftdrive.planning.plan import Plan
from ftdrive.planning.show.words import room_in_words
from ftdrivers.ur.kinematics import Array

HOST, PORT = "127.0.0.1", 8080
"""Only this computer can open the view."""
_FRAME_RAD = np.radians(3)
_ARM, _TOOL, _TIP, _BALL, _OBSTACLE = (150, 155, 165), (235, 130, 40), (200, 40, 40), (90, 140, 230), (90, 160, 110)
_AROUND, _ARC = 24, 6
"""Facets around a body, and over a quarter of its rounding."""


@contextmanager
def shown(plan: Plan, certifier: Certifier, way_rad: Sequence[Array] | Array = ()) -> Iterator[str]:
    """Serve the scene to browsers on this computer while the block runs; yields its address. Needs the extra `viz`.

    Parameters
    ----------
    certifier : Certifier
        For the same arm, tool and scene.
    way_rad : array, shape (k + 1, 6), optional
        From the present posture to the first pose; shown before the tour.
    """
    try:
        from viser import ViserServer
    except ImportError:
        raise ConfigError("a view needs viser: install ftdrive with its extra viz, `ftdrive[viz]`") from None
    behind = hidden_host()
    with redirect_stdout(StringIO()):  # it prints a banner; our stdout is data
        server = ViserServer(host=behind, label=f"ftdrive plan, {certifier.arm.name}", verbose=False)
    try:
        _fill(server, plan, certifier, way_rad)
        with closing(_gate((behind, server.get_port()))) as gate:
            yield f"http://{HOST}:{gate.port}"
    finally:
        with redirect_stdout(StringIO()):
            server.stop()


def _gate(behind: tuple[str, int]) -> Gate:
    """Return a gate at the usual port, or at a free one if that is in use."""
    try:
        return Gate((HOST, PORT), lambda _: behind)
    except OSError:
        return Gate((HOST, 0), lambda _: behind)


def open_in_browser(url: str) -> None:
    """Show a page where there is a screen."""
    if sys.platform != "linux" or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"):
        webbrowser.open(url)


def _fill(server: Any, plan: Plan, certifier: Certifier, way_rad: Sequence[Array] | Array) -> None:
    arm, (q, move) = certifier.arm, path(plan, way_rad)
    _draw_surroundings(server.scene, plan, certifier, q)
    look_at = 0.7 * arm.frames(q[:1]).wrist_m[0]
    server.initial_camera.look_at = look_at
    server.initial_camera.position = look_at + 0.5 * _size_m(certifier) * np.array([1.0, 1.0, 0.6])
    bodies = arm.bodies(q)
    n_arm = len(arm.names) - len(arm.tool)
    meshes = [
        server.scene.add_mesh_simple(
            f"/arm/{i} {name}",
            *revolved(bodies.half_length_m[i], bodies.radius_m[i], bodies.rounding_m[i]),
            color=_ARM if i < n_arm else _TOOL,
        )
        for i, name in enumerate(arm.names)
    ]
    wxyz = turned_up(bodies.axis)
    slider = server.gui.add_slider("along the tour", min=0, max=len(q) - 1, step=1, initial_value=0)
    words = server.gui.add_markdown("")

    def show(_: object = None) -> None:
        at = int(slider.value)
        with server.atomic():
            for i, mesh in enumerate(meshes):
                mesh.position, mesh.wxyz = bodies.centre_m[at, i], wxyz[at, i]
            words.content = describe(plan, int(move[at]))

    slider.on_update(show)
    show()


def path(plan: Plan, way_rad: Sequence[Array] | Array = ()) -> tuple[Array, Any]:
    """Joint vectors (m, 6) along all moves, and the move (m,) that each belongs to.

    The approach is move -1; the closed tour follows.
    """
    q = np.array([step.q_rad for step in plan.steps])
    legs = [(-1, start, end) for start, end in pairwise(way_rad)]
    legs += [(i, start, end) for i, (start, end) in enumerate(zip(q, np.roll(q, -1, axis=0), strict=True))]
    parts, moves = [], []
    for move, start, end in legs:
        n = max(1, int(np.ceil(np.abs(end - start).max() / _FRAME_RAD)))
        parts.append(start + np.linspace(0, 1, n, endpoint=False)[:, None] * (end - start))
        moves += [move] * n
    return np.concatenate([*parts, q[:1]]), np.array([*moves, len(q) - 1])


def describe(plan: Plan, move: int) -> str:
    """Return a move as text."""
    if move < 0:
        return "From the present posture to the first pose.\n\nIt is confirmed separately."
    step, following = plan.steps[move], plan.steps[(move + 1) % len(plan.steps)]
    turn_deg, speed_deg_s = np.degrees([step.turn_rad, step.speed_rad_s])
    return (
        f"Move **{move + 1} of {len(plan.steps)}**, R{step.number:02d} to R{following.number:02d}: {turn_deg:.0f}° at "
        f"{speed_deg_s:.0f}°/s.\n\nNearest: {1e3 * step.clearance_m:.0f} mm, {step.limited_by}.\n\n"
        f"{room_in_words(plan)}"
    )


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


def _draw_surroundings(scene: Any, plan: Plan, certifier: Certifier, q_rad: Array) -> None:
    arm = certifier.arm
    size_m = _size_m(certifier)
    scene.add_frame("/base", axes_length=0.2, axes_radius=0.004)
    for i, plane in enumerate(certifier.scene.planes, start=1):
        scene.add_box(
            f"/surroundings/plane {i}",
            _OBSTACLE,
            (size_m, size_m, 0.002),
            opacity=0.3,
            position=_foot(plane),
            wxyz=turned_up(np.array(plane.normal)),
        )
    for i, box in enumerate(certifier.scene.boxes, start=1):
        low, high = np.array(box.low_m), np.array(box.high_m)
        scene.add_box(f"/surroundings/box {i}", _OBSTACLE, high - low, opacity=0.6, position=(low + high) / 2)
    scene.add_icosphere("/ball", plan.ball_m, _BALL, opacity=0.15, position=plan.ball_centre_m, cast_shadow=False)
    farthest = int(np.argmax([part.to_m for part in arm.tool]))
    tip = tips(arm, q_rad)[:, farthest]
    scene.add_line_segments("/path of the tool tip", np.stack([tip[:-1], tip[1:]], axis=1), _TIP, thickness=0.004)


def _size_m(certifier: Certifier) -> float:
    arm = certifier.arm
    return 2 * (arm.ball_m + float(np.linalg.norm(arm.kinematics.links_m[1:3], axis=1).sum()))


def _foot(plane: Plane) -> Array:
    return plane.offset_m * np.array(plane.normal)
