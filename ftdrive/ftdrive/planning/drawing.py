"""A plan as stick figures, and in three dimensions in the browser."""

import os
import sys
import webbrowser
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager, redirect_stdout
from io import BytesIO, StringIO
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import ConvexHull

from ftcalib.files import write_new
from ftdrive.errors import ConfigError
from ftdrive.http_gate import Gate, hidden_host
from ftdrive.planning.geometry.arm_model import ArmModel, Cylinder
from ftdrive.planning.geometry.certify import Certifier
from ftdrive.planning.geometry.kinematics import Frames
from ftdrive.planning.geometry.scene import Plane, Scene
from ftdrive.planning.motion import tips
from ftdrive.planning.plan import JOINTS, Plan
from ftdrivers.sweep import WRISTS, Sweep
from ftdrivers.ur.kinematics import Array

# Axis to the right, axis up, title.
VIEWS = ((1, 2, "along base x"), (0, 2, "along base y"), (0, 1, "from above"))
# A plane is drawn where it is seen from its edge: of its unit normal, the share along the view is below this.
_ALONG = 0.1
# One in so many steps of a sweep is drawn.
_OF_SWEEP = 5
_FAR_M = 20.0
# How far from arm and ball surroundings are shown, and some room at the edge.
_NEAR_M, _EDGE_M = 1.0, 0.06
_TURN = np.linspace(0, 2 * np.pi, 100)


def draw(plan: Plan, certifier: Certifier, path: Path, way_rad: ArrayLike = ()) -> None:
    """Write a PNG with the arm at every pose, its tool and its surroundings, seen from the front, side and above.

    Needs the extra `viz`.

    Parameters
    ----------
    certifier : Certifier
        For the same arm, tool and scene.
    path : Path
        A new file.
    way_rad : array_like, shape (k + 1, 6), optional
        From the present posture to the first pose; drawn in green.

    Raises
    ------
    ConfigError
        There is no matplotlib.
    OSError
        As `write_new`.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise ConfigError("a picture needs matplotlib: install ftdrive with its extra viz, `ftdrive[viz]`") from None
    arm, scene = certifier.arm, certifier.scene
    shown = plan.steps if plan.sweep is None else plan.steps[::_OF_SWEEP]
    poses = arm.frames([step.q_rad for step in shown])
    before = np.reshape(np.asarray(way_rad, dtype=np.float64), (-1, 6))[:-1]
    there = _skeletons(arm.frames(before)) if len(before) else np.zeros((0, 7, 3))
    limits = _limits(plan, poses, there.reshape(-1, 3), scene)
    rows = 1 if plan.sweep is None else 2
    figure = Figure(figsize=(12, 4.9 + 2.6 * (rows - 1)), layout="constrained")
    grid = figure.add_gridspec(rows, 3, height_ratios=[4.9, 2.6][:rows])
    if plan.sweep is not None:
        _joints(figure.add_subplot(grid[1, :]), plan.sweep)
    for column, (across, up, title) in enumerate(VIEWS):
        axes = figure.add_subplot(grid[0, column])
        view = [across, up]
        for one in _skeletons(poses):
            axes.plot(*one[:, view].T, "-o", color="tab:gray", markersize=3, linewidth=1)
        for one in there:
            axes.plot(*one[:, view].T, "--o", color="tab:green", markersize=3, linewidth=1)
        for outline in _tools(arm, poses, view):
            axes.fill(*outline.T, facecolor="tab:orange", edgecolor="tab:orange", alpha=0.12, linewidth=1)
        centre = np.array(plan.ball_centre_m)[view, None]
        axes.plot(*(centre + plan.ball_m * np.array([np.cos(_TURN), np.sin(_TURN)])), ":", color="tab:blue")
        axes.plot(0, 0, "ks", markersize=5)
        _surroundings(axes, scene, view)
        axes.set(xlim=limits[:, across], ylim=limits[:, up])
        axes.set_aspect("equal")
        axes.set_title(title)
        axes.set_xlabel(f"base {'xyz'[across]} [m]")
        axes.set_ylabel(f"base {'xyz'[up]} [m]")
    figure.suptitle(title_of(plan, certifier, on_its_way=len(before) > 0))
    picture = BytesIO()
    figure.savefig(picture, format="png", dpi=110)
    write_new(path, picture.getvalue())


def _joints(axes: Any, sweep: Sweep) -> None:
    """Draw the wrist joints against time."""
    t_s = np.linspace(0.0, sweep.duration_s, 400)
    q_deg = np.degrees(sweep.at(t_s))
    for joint in WRISTS:
        axes.plot(t_s, q_deg[:, joint], label=JOINTS[joint])
    axes.set(xlabel="time at the planned speed [s]", ylabel="joint [deg]", xlim=(0, sweep.duration_s))
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3, frameon=False)
    axes.grid(visible=True)


def title_of(plan: Plan, certifier: Certifier, *, on_its_way: bool) -> str:
    """Say what is seen, and what is not."""
    ball = f"ball of {plan.ball_m:.2f} m"
    moves = f"all that moves stays in this {ball}" if plan.arm_rests else f"wrist and tool stay in this {ball}"
    name = f"EMULATED {certifier.arm.name}" if plan.emulated else certifier.arm.name
    motion = f"{len(plan.steps)} poses" if plan.sweep is None else f"sweep of {plan.sweep.duration_s:.0f} s"
    lines = [f"{name}: {motion}; blue, dotted: {moves}"]
    if not plan.arm_rests:
        lines[0] += ", the WHOLE ARM moves"
    lines.append("grey: arm, orange: tool, at every pose; black: base; red: planes and boxes")
    if on_its_way:
        lines.append("green: the present posture, and the approach to the first pose")
    if slanting := sum(not _drawn(plane) for plane in certifier.scene.planes):
        lines.append(f"not drawn: slanting planes ({slanting})")
    return "\n".join(lines)


def _skeletons(at: Frames) -> Array:
    """Joints (n, 7, 3) of the arm, from base to flange."""
    base = np.zeros_like(at.shoulder_m)
    joints = (base, at.shoulder_m, at.elbow_m, at.forearm_end_m, at.wrist_m, at.wrist_2_m, at.flange_m)
    return np.stack(joints, axis=1)


def _tools(arm: ArmModel, at: Frames, view: list[int]) -> Iterator[Array]:
    """Outline (k, 2) of every cylinder of the tool at every pose."""
    for flange_m, R in zip(at.flange_m, at.R_base_flange, strict=True):
        for part in arm.tool:
            points = (flange_m + _rims(part) @ R.T)[:, view]
            yield points[ConvexHull(points).vertices]


def _rims(part: Cylinder) -> Array:
    """Points (n, 3) of both ends, flange axes."""
    radius = part.diameter_m / 2
    x, y = part.x_m + radius * np.cos(_TURN[::4]), part.y_m + radius * np.sin(_TURN[::4])
    return np.concatenate([np.stack([x, y, np.full_like(x, z)], axis=1) for z in (part.from_m, part.to_m)])


def _limits(plan: Plan, poses: Frames, before: Array, scene: Scene) -> Array:
    """Low and high corner (2, 3) of what is looked at: the arm, the ball, and of the surroundings what is near."""
    centre = np.array(plan.ball_centre_m)
    points = np.concatenate([_skeletons(poses).reshape(-1, 3), before, [centre - plan.ball_m, centre + plan.ball_m]])
    low, high = points.min(axis=0) - _NEAR_M, points.max(axis=0) + _NEAR_M
    around = [np.array(corner) for box in scene.boxes for corner in (box.low_m, box.high_m)]
    around += [plane.offset_m * np.array(plane.normal) for plane in scene.planes if _drawn(plane)]
    points = np.concatenate([points, np.clip(np.reshape(around, (-1, 3)), low, high)])
    return np.array([points.min(axis=0) - _EDGE_M, points.max(axis=0) + _EDGE_M])


def _surroundings(axes: Any, scene: Scene, view: list[int]) -> None:
    """Draw boxes, and planes that are seen from their edge."""
    for box in scene.boxes:
        (left, bottom), (right, top) = np.array([box.low_m, box.high_m])[:, view]
        axes.fill([left, right, right, left], [bottom, bottom, top, top], color="tab:red", alpha=0.3)
    for plane in scene.planes:
        if _seen(plane, view):
            normal = np.array(plane.normal)[view]
            length = np.linalg.norm(normal)
            normal = normal / length
            foot, along = plane.offset_m / length * normal, np.array([-normal[1], normal[0]])
            edge = np.array([foot - _FAR_M * along, foot + _FAR_M * along])
            behind = np.concatenate([edge, edge[::-1] - _FAR_M * normal])
            axes.fill(*behind.T, color="tab:red", alpha=0.15, linewidth=0)
            axes.plot(*edge.T, color="tab:red", linewidth=1.5)


def _drawn(plane: Plane) -> bool:
    return any(_seen(plane, [across, up]) for across, up, _ in VIEWS)


def _seen(plane: Plane, view: list[int]) -> bool:
    (depth,) = {0, 1, 2} - set(view)
    return abs(plane.normal[depth]) < _ALONG


# Only this computer can open the view.
HOST, PORT = "127.0.0.1", 8080
_FRAME_RAD = np.radians(3)
_ARM, _TOOL, _TIP, _BALL, _OBSTACLE = (150, 155, 165), (235, 130, 40), (200, 40, 40), (90, 140, 230), (90, 160, 110)
# Facets around a body, and over a quarter of its rounding.
_AROUND, _ARC = 24, 6


@contextmanager
def serve_view(plan: Plan, certifier: Certifier, way_rad: Sequence[Array] | Array = ()) -> Iterator[str]:
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
    # It prints a banner; our stdout is data.
    with redirect_stdout(StringIO()):
        server = ViserServer(host=behind, label=f"ftdrive plan, {certifier.arm.name}", verbose=False)
    try:
        _fill(server, plan, certifier, way_rad)
        with closing(_gate((behind, server.get_port()))) as gate:
            yield f"http://{HOST}:{gate.port}"
    finally:
        with redirect_stdout(StringIO()):
            server.stop()


def _gate(behind: tuple[str, int]) -> Gate:
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
        f"{plan.room_in_words()}"
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
