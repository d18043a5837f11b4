"""Drawing of a plan with the arm as stick figures."""

from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import ConvexHull

from ftcalib.files import write_new
from ftdrive.errors import ConfigError
from ftdrive.planning.geometry.arm_model import ArmModel, Cylinder
from ftdrive.planning.geometry.certify import Certifier
from ftdrive.planning.geometry.kinematics import Frames
from ftdrive.planning.geometry.scene import Plane, Scene
from ftdrive.planning.plan import JOINTS, Plan
from ftdrivers.installation import missing_extra
from ftdrivers.sweep import WRISTS, Sweep
from ftdrivers.ur.kinematics import Array

# Views of the drawing: index of the base axis to the right, index of that upwards, and title.
VIEWS = ((1, 2, "along base x"), (0, 2, "along base y"), (0, 1, "from above"))
# A plane is drawn in the views that look along it: its unit normal's component along the view is below this.
_ALONG = 0.1
# Only every fifth step of a sweep is drawn.
_OF_SWEEP = 5
_FAR_M = 20.0
# Surroundings are shown up to the first distance from the arm and its ball; the second is the width of the border.
_NEAR_M, _EDGE_M = 1.0, 0.06
_TURN = np.linspace(0, 2 * np.pi, 100)


def draw_plan(plan: Plan, certifier: Certifier, path: Path, way_rad: ArrayLike = ()) -> None:
    """Write a PNG of the arm, the tool and the surroundings at every pose, seen from the front, the side and above.

    Needs the extra `viz`.

    Parameters
    ----------
    certifier : Certifier
        The certifier of the same arm, tool and scene.
    path : Path
        A new file.
    way_rad : array_like, shape (k + 1, 6), optional
        The approach from the current posture to the first pose, drawn in green.

    Raises
    ------
    ConfigError
        Matplotlib is not installed.
    OSError
        Raised by `write_new`.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise ConfigError(missing_extra("a picture", "matplotlib", "viz")) from None
    arm, scene = certifier.arm, certifier.scene
    shown = plan.steps if plan.sweep is None else plan.steps[::_OF_SWEEP]
    poses = arm.frames([step.q_rad for step in shown])
    before = np.reshape(np.asarray(way_rad, dtype=np.float64), (-1, 6))[:-1]
    there = _skeletons(arm.frames(before)) if len(before) else np.zeros((0, 7, 3))
    limits = _view_corners(plan, poses, there.reshape(-1, 3), scene)
    rows = 1 if plan.sweep is None else 2
    figure = Figure(figsize=(12, 4.9 + 2.6 * (rows - 1)), layout="constrained")
    grid = figure.add_gridspec(rows, 3, height_ratios=[4.9, 2.6][:rows])
    if plan.sweep is not None:
        _plot_joints(figure.add_subplot(grid[1, :]), plan.sweep)
    for column, (across, up, title) in enumerate(VIEWS):
        axes = figure.add_subplot(grid[0, column])
        view = [across, up]
        for joints in _skeletons(poses):
            axes.plot(*joints[:, view].T, "-o", color="tab:gray", markersize=3, linewidth=1)
        for joints in there:
            axes.plot(*joints[:, view].T, "--o", color="tab:green", markersize=3, linewidth=1)
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
    figure.suptitle(_title_of(plan, certifier, on_its_way=len(before) > 0))
    picture = BytesIO()
    figure.savefig(picture, format="png", dpi=110)
    write_new(path, picture.getvalue())


def _plot_joints(axes: Any, sweep: Sweep) -> None:
    t_s = np.linspace(0.0, sweep.duration_s, 400)
    q_deg = np.degrees(sweep.at(t_s))
    for joint in WRISTS:
        axes.plot(t_s, q_deg[:, joint], label=JOINTS[joint])
    axes.set(xlabel="time at the planned speed [s]", ylabel="joint [deg]", xlim=(0, sweep.duration_s))
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3, frameon=False)
    axes.grid(visible=True)


def _title_of(plan: Plan, certifier: Certifier, *, on_its_way: bool) -> str:
    """Return the title of a drawing, which says what the drawing shows and which planes it does not."""
    ball = f"sphere of {plan.ball_m:.2f} m"
    moves = f"all moving parts stay in this {ball}" if plan.arm_rests else f"wrist and tool stay in this {ball}"
    name = f"EMULATED {certifier.arm.name}" if plan.emulated else certifier.arm.name
    motion = f"{len(plan.steps)} poses" if plan.sweep is None else f"sweep of {plan.sweep.duration_s:.0f} s"
    lines = [f"{name}: {motion}; blue, dotted: {moves}"]
    if not plan.arm_rests:
        lines[0] += ", the WHOLE ARM moves"
    lines.append("grey: arm at every pose; orange: tool; black: base; red: planes and boxes")
    if on_its_way:
        lines.append("green: the present posture, and the approach to the first pose")
    if slanting := sum(not _is_in_view(plane) for plane in certifier.scene.planes):
        lines.append(f"not drawn: slanting planes ({slanting})")
    return "\n".join(lines)


def _skeletons(at: Frames) -> Array:
    """Return the positions (n, 7, 3) of the joints from base to flange, m."""
    base = np.zeros_like(at.shoulder_m)
    joints = (base, at.shoulder_m, at.elbow_m, at.forearm_end_m, at.wrist_m, at.wrist_2_m, at.flange_m)
    return np.stack(joints, axis=1)


def _tools(arm: ArmModel, at: Frames, view: list[int]) -> Iterator[Array]:
    """Yield the outline (k, 2) of every cylinder of the tool at every pose, as seen in one view, m."""
    for flange_m, R in zip(at.flange_m, at.R_base_flange, strict=True):
        for part in arm.tool:
            points = (flange_m + _rims(part) @ R.T)[:, view]
            yield points[ConvexHull(points).vertices]


def _rims(part: Cylinder) -> Array:
    """Return points (n, 3) on the rims of both ends of a cylinder, flange axes, m."""
    radius = part.diameter_m / 2
    x, y = part.x_m + radius * np.cos(_TURN[::4]), part.y_m + radius * np.sin(_TURN[::4])
    return np.concatenate([np.stack([x, y, np.full_like(x, z)], axis=1) for z in (part.from_m, part.to_m)])


def _view_corners(plan: Plan, poses: Frames, before: Array, scene: Scene) -> Array:
    """Return the low and high corners (2, 3) of the drawing: arm, ball, and near surroundings, base axes, m."""
    centre = np.array(plan.ball_centre_m)
    points = np.concatenate([_skeletons(poses).reshape(-1, 3), before, [centre - plan.ball_m, centre + plan.ball_m]])
    low, high = points.min(axis=0) - _NEAR_M, points.max(axis=0) + _NEAR_M
    around = [np.array(corner) for box in scene.boxes for corner in (box.low_m, box.high_m)]
    around += [plane.offset_m * np.array(plane.normal) for plane in scene.planes if _is_in_view(plane)]
    points = np.concatenate([points, np.clip(np.reshape(around, (-1, 3)), low, high)])
    return np.array([points.min(axis=0) - _EDGE_M, points.max(axis=0) + _EDGE_M])


def _surroundings(axes: Any, scene: Scene, view: list[int]) -> None:
    """Draw the boxes of a scene, and its planes that lie along the view."""
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


def _is_in_view(plane: Plane) -> bool:
    return any(_seen(plane, [across, up]) for across, up, _ in VIEWS)


def _seen(plane: Plane, view: list[int]) -> bool:
    (depth,) = {0, 1, 2} - set(view)
    return abs(plane.normal[depth]) < _ALONG
