"""From a cell's configuration, in millimetres and degrees, to its speeds, its certifier and a plan."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from ftdrive.cell.config import CellConfig
from ftdrive.errors import ConfigError, PlanRefused
from ftdrive.planning.geometry.arm_model import SHAPES, ArmModel, Cylinder
from ftdrive.planning.geometry.certify import Certifier, Margins
from ftdrive.planning.geometry.scene import BASE_PLANE, Box, Plane, Scene, lean_of
from ftdrive.planning.motion import Speeds, slower
from ftdrive.planning.plan import Plan
from ftdrive.planning.planner import TOOL_POSES, guess_of, plan_box, plan_cone, plan_sets, plan_tool, plan_tour
from ftdrive.planning.sweep_planner import plan_sweep
from ftdrivers.ur.kinematics import MODELS, Kinematics, model_named

# No move is faster, whatever a plan or an old configuration contains.
FASTEST = Speeds(joint_rad_s2=float(np.radians(300)))


def speeds_of(cell: CellConfig) -> Speeds:
    """Return the speed limits of a cell."""
    robot = cell.robot
    joint_rad_s, joint_rad_s2 = np.radians([robot.speed_deg_s, robot.acceleration_deg_s2])
    return slower(Speeds(float(joint_rad_s), float(joint_rad_s2), robot.tip_speed_mm_s / 1e3), FASTEST)


def plan_for(
    cell: CellConfig,
    certifier: Certifier,
    q_rad: ArrayLike,
    poses: int = 24,
    *,
    cone_deg: float | None = None,
    box_mm: float | None = None,
    sets: str | None = None,
    tip_unlimited: bool = False,
) -> Plan:
    """Plan a tour for a cell, with its certifier, from joint angles `q_rad` (6,).

    Raises as `plan_cone` with `cone_deg`, `plan_box` with `box_mm`, `plan_sets` with `sets`, `plan_tool` for four
    poses, else `plan_tour`.
    """
    speeds, guess = speeds_of(cell), guess_of(certifier, cell.tool.mass_kg)
    if tip_unlimited:
        speeds = replace(speeds, tip_m_s=None)
    if cone_deg is not None:
        half_angle_rad = float(np.radians(cone_deg))
        made = plan_cone(certifier, q_rad, poses, half_angle_rad=half_angle_rad, speeds=speeds, guess=guess)
    elif box_mm is not None:
        made = plan_box(certifier, q_rad, poses, half_size_m=box_mm / 1e3, speeds=speeds, guess=guess)
    elif sets is not None:
        made = plan_sets(certifier, q_rad, sets, speeds=speeds, guess=guess)
    elif poses == TOOL_POSES:
        made = plan_tool(certifier, q_rad, speeds=speeds, guess=guess)
    else:
        made = plan_tour(certifier, q_rad, poses, speeds=speeds, guess=guess)
    if not made.certified:
        raise PlanRefused("a move of the plan could not be proven clear")
    return made.marked(measured=cell.workcell.measured, emulated=cell.is_emulated)


def sweep_for(cell: CellConfig, certifier: Certifier, q_rad: ArrayLike, seconds: float) -> Plan:
    """Plan a sweep for a cell, with its certifier, from joint angles `q_rad` (6,); raises as `plan_sweep`."""
    made = plan_sweep(
        certifier,
        q_rad,
        seconds,
        speeds=speeds_of(cell),
        stop_rad_s2=float(np.radians(cell.robot.stop_deceleration_deg_s2)),
        guess=guess_of(certifier, cell.tool.mass_kg),
    )
    return made.marked(measured=cell.workcell.measured, emulated=cell.is_emulated)


def certifier_for(cell: CellConfig, model: str | None, kinematics: Kinematics | None = None) -> Certifier:
    """Describe arm, tool and surroundings of a cell to the certifier.

    Parameters
    ----------
    cell : CellConfig
    model : str or None
        Model of the arm, as reported by the controller or configured.
    kinematics : Kinematics, optional
        The arm's own; without them nominal ones, and more distance is kept.

    Raises
    ------
    ConfigError
        The arm or tool is missing, a shape is impossible, the arm has no measured shape, or see `require_possible`.
    """
    if model is None:
        raise ConfigError("which arm? Give --model, or [robot] model in ftdrive.toml")
    if not cell.tool.cylinders_mm:
        raise ConfigError("what is mounted? Give --tool FROM:TO:DIAMETER, or [tool] cylinders_mm in ftdrive.toml")
    planes = (BASE_PLANE, *map(plane_from_mm, cell.workcell.planes_mm))
    scene = Scene(planes, tuple(map(box_from_mm, cell.workcell.boxes_mm)), lean_of(cell.workcell.mounting))
    arm = ArmModel(model, [_cylinder_from_mm(values) for values in cell.tool.cylinders_mm], kinematics)
    certifier = Certifier(arm, scene)
    require_possible(cell, model)
    return certifier


def require_possible(cell: CellConfig, model: str | None) -> None:
    """Reject impossible cells: a tool shorter than its sensor, a plane or box that contains the arm itself.

    The test uses the shoulder, because it is in the same place in every posture. Objects at the base, such as a table
    around its plate, are allowed.

    Parameters
    ----------
    cell : CellConfig
        Without cylinders the tool is not checked.
    model : str or None
        Model of the arm; without a measured shape, planes and boxes are not checked.

    Raises
    ------
    ConfigError
        The message names the cylinders, plane or box, and the fix after the last colon.
    """
    end_mm, height_mm = max((row[1] for row in cell.tool.cylinders_mm), default=np.inf), cell.sensor.height_mm
    if height_mm is not None and end_mm < height_mm:
        raise ConfigError(
            f"the tool ends {end_mm:g} mm from the flange, before the sensor's origin at {height_mm:g} mm ([sensor] "
            "height_mm): describe everything that is mounted, including the sensor, in mm from the flange"
        )
    name = None if model is None else model_named(model, controller_major=0)
    if name not in SHAPES:
        return
    shoulder = _Shoulder(name)
    for words in (
        *map(shoulder.against_plane, cell.workcell.planes_mm),
        *map(shoulder.against_box, cell.workcell.boxes_mm),
    ):
        if words:
            raise ConfigError(words)


class _Shoulder:
    """The ball that the shoulder of an arm fills in every posture."""

    def __init__(self, name: str) -> None:
        self._centre_m = np.array([0.0, 0.0, MODELS[name].d_m[0]])
        self._radius_m, self._margin_m = SHAPES[name].shoulder_radius_m, Margins().scene_m

    def against_plane(self, row: Sequence[float]) -> str:
        """Return what is wrong with a plane and which plane was probably meant; empty if nothing is wrong."""
        gap_m, (x, y, z, place) = self._above_m(row), row
        if gap_m >= self._margin_m:
            return ""
        meant = (-x, -y, -z, -place), (x, y, z, -place)
        same, opposite = (_words(one) if self._above_m(one) >= self._margin_m else "" for one in meant)
        if gap_m > -self._radius_m or not same:
            return self._too_near(f"the plane {_words(row)}", gap_m)
        return (
            f"the arm's own {'base' if place > 0 else 'shoulder'} is on the wrong side of the plane {_words(row)}: "
            f"the arm stays where normal times point is at least {place:g} mm: give {same} if the plane is there"
            + (f", {opposite} if it is on the other side of the base" if opposite else "")
        )

    def against_box(self, row: Sequence[float]) -> str:
        """Return what is wrong with a box; empty if nothing is."""
        box = box_from_mm(row)
        away_m = float(np.linalg.norm(self._centre_m - np.clip(self._centre_m, box.low_m, box.high_m)))
        gap_m = away_m - self._radius_m
        return "" if gap_m >= self._margin_m else self._too_near(f"the box {_words(row)}", gap_m)

    def _above_m(self, row: Sequence[float]) -> float:
        plane = plane_from_mm(row)
        return float(np.dot(plane.normal, self._centre_m)) - plane.offset_m - self._radius_m

    def _too_near(self, what: str, gap_m: float) -> str:
        return (
            f"{what} is {1e3 * max(gap_m, 0.0):.0f} mm from the arm's shoulder, less than the margin of "
            f"{1e3 * self._margin_m:.0f} mm in every posture: measure it again in base coordinates, in mm"
        )


def _words(row: Sequence[float]) -> str:
    return f"[{', '.join(f'{value + 0.0:g}' for value in row)}]"


def _cylinder_from_mm(values: Sequence[float]) -> Cylinder:
    """Read from, to, diameter, and x, y of an axis beside the flange's."""
    return Cylinder(*_metres("a cylinder of the tool", "from, to, diameter, or these and x, y", values, (3, 5)))


def plane_from_mm(values: Sequence[float]) -> Plane:
    """Read a normal of any length, and the smallest allowed offset along it."""
    *normal, offset_m = _metres("a plane", "its normal and an offset", values, (4,))
    length = float(np.linalg.norm(normal))
    if not length:
        raise ConfigError(f"a plane is {list(values)}: its normal has no direction, give for example -1, 0, 0, -800")
    x, y, z = (value / length for value in normal)
    return Plane((x, y, z), offset_m)


def box_from_mm(values: Sequence[float]) -> Box:
    """Read any two opposite corners."""
    corners = np.array(_metres("a box", "two opposite corners", values, (6,))).reshape(2, 3)
    (x1, y1, z1), (x2, y2, z2) = np.sort(corners, axis=0).tolist()
    return Box((x1, y1, z1), (x2, y2, z2))


def _metres(what: str, content: str, values: Sequence[float], counts: Sequence[int]) -> list[float]:
    if len(values) not in counts or not all(map(np.isfinite, values)):
        wanted = " or ".join(map(str, counts))
        raise ConfigError(f"{what} is {list(values)}: give {wanted} numbers, {content}, in mm")
    return [float(value) / 1e3 for value in values]
