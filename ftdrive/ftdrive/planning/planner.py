"""Planner: makes a plan for a cell, of the best kind that is proven clear, with the reason for the choice.

All 24 special orientations are preferred because they are the most informative. Tours with base, shoulder and elbow at
rest come first. If some orientations are out of reach, the most informative reachable poses replace them.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from ftcalib.known import Setup
from ftcalib.poses.information import SUBSET_6, T12, Guess, special
from ftcalib.poses.selection import COUNTS, FEWEST_TO_VERIFY, paper_set, set_names, set_numbers
from ftcalib.sensor_matrix import SensorMatrix
from ftdrive.cell.config import USUAL_KG, CellConfig, orientation_accuracy_deg
from ftdrive.cell.units import side_of
from ftdrive.errors import ConfigError, PlanRefused
from ftdrive.planning.geometry.arm_model import SHAPES, ArmModel, Cylinder, HungLoad
from ftdrive.planning.geometry.certify import Certifier, Margins
from ftdrive.planning.geometry.kinematics import checked_joints
from ftdrive.planning.geometry.scene import BASE_PLANE, Box, Plane, Scene, lean_of
from ftdrive.planning.motion import Speeds
from ftdrive.planning.plan import Plan, make_plan
from ftdrive.planning.search import nodes
from ftdrive.planning.search.chosen import Chosen, chosen_tour, hung_tour, tour_of_sets, verification_tour
from ftdrive.planning.search.nodes import WRIST_6_RAD, box_nodes, with_room, wrist_nodes
from ftdrive.planning.search.tours import clear_tour
from ftdrive.planning.sweep_planner import plan_sweep
from ftdrivers.ur.kinematics import MODELS, Array, Kinematics, model_named

# Posture in which all arm models with usual tools have room for the constant tour; the wrist is at its first pose.
USUAL_POSTURE_RAD = np.radians([45.0, -100.0, 60.0, -50.0, 90.0, 45.0])
NUMBERS = {24: tuple(range(1, 25)), 12: T12, 6: SUBSET_6}
# Number of poses for a new tool on a calibrated cell.
TOOL_POSES = 4
# Number of tilts with a load on a string.
HUNG_POSES = 12
BOX_HALF_SIZE_M = 0.1
FEWEST_CHOSEN = 6
# Number of extra orientations that a random set offers, in case some are out of reach.
SPARE = 100
# Upper limits of speed and acceleration, even if a plan or an old configuration contains higher values.
FASTEST = Speeds(joint_rad_s2=float(np.radians(300)))

# Assumed standard deviation of the mean wrench measured at a pose, per axis, N and N·m.
_NOISE = 0.05, 0.003
# A tour: numbers of the orientations and joint vectors (n, 6), in the order of travel.
Found = tuple[Sequence[int], Array]
# Kind of a tour, the reason for this kind, and the tour, which is None if there is none of this kind.
Attempt = tuple[str, Sequence[str], Found | None]


def guess_of(certifier: Certifier, cell: CellConfig | None = None) -> Guess:
    """Return the prior `guess_of_devices`, with the lean of the base and a centre of mass at half the tool length."""
    length_m = max(part.to_m for part in certifier.arm.tool)
    guess = Guess(USUAL_KG, *_NOISE, sensor=SensorMatrix.usual()) if cell is None else guess_of_devices(cell)
    return replace(guess, p_sensor_com_m=(0.0, 0.0, length_m / 2), tilt_beta_rad=certifier.scene.lean_rad)


def guess_of_devices(cell: CellConfig) -> Guess:
    """Return a prior with the mass of the tool and the accuracy of sensor and arm as configured, and typical noise."""
    sensor = cell.sensor
    setup = Setup(
        sensor_accuracy_percent=sensor.accuracy_percent,
        sensor_range=(sensor.range_N, sensor.range_Nm) if sensor.range_N and sensor.range_Nm else None,
        orientation_accuracy_deg=orientation_accuracy_deg(cell.robot.host, cell.robot.orientation_accuracy_deg),
    )
    errors = SensorMatrix.declared(setup)
    return Guess(cell.tool.mass_kg or USUAL_KG, *_NOISE, sensor=errors, orientation_rad=setup.orientation_rad)


def plan_tour(
    certifier: Certifier, q_rad: ArrayLike = USUAL_POSTURE_RAD, poses: int = 24, *, speeds: Speeds, guess: Guess
) -> Plan:
    """Plan a tour of the special orientations if one exists, else of the most informative reachable poses.

    Parameters
    ----------
    q_rad : array_like, shape (6,)
        Current joint angles.
    poses : {24, 12, 6}
    guess : Guess
        Assumed tool and noise.

    Returns
    -------
    Plan
        The kind is "constant", "wrist", "posture", "box" or "reachable", in this order of preference.

    Raises
    ------
    PlanRefused
        No tour has only moves that are proven clear.
    """
    q_now = checked_joints(q_rad)
    _pose_numbers(poses)
    for kind, why, tour in _attempts(certifier, q_now, poses, speeds, guess):
        if tour is not None:
            return make_plan(kind, why, certifier, *tour, speeds, guess)
    raise PlanRefused(
        f"{_reason(poses)}. No tour at another posture, with the flange in a box or with other poses is proven clear "
        "and informative enough to estimate all parameters. Describe the tool more closely, or clear the surroundings"
    )


def _attempts(certifier: Certifier, q_now: Array, poses: int, speeds: Speeds, guess: Guess) -> Iterator[Attempt]:
    numbers, reason = NUMBERS[poses], _reason(poses)
    if poses == 24:
        why = "The constant tour is proven clear at the present posture; base, shoulder and elbow stay at rest."
        q = nodes.constant_tour(q_now, certifier.arm.kinematics)
        fits = _winds_little(q, q_now) and certifier.clear_around(q)
        yield "constant", [why], (nodes.NUMBERS, q) if fits else None
    why = f"{reason}: the wrist alone visits the orientations in the fastest clear order."
    yield "wrist", [why], _wrist(certifier, q_now, numbers, speeds)
    for tour in filter(certifier.clear_around, with_room(certifier, q_now)):
        elsewhere: Found | None = nodes.NUMBERS, tour
        if poses != 24 or not _winds_little(tour, q_now):
            elsewhere = _wrist(certifier, np.append(tour[0, :5], q_now[5]), numbers, speeds)
        why = f"{reason}, and there is no clear tour of the wrist alone."
        yield "posture", [why, _elsewhere_words(tour[0])], elsewhere
    nowhere = f"{reason}, and no tried posture of joints 1 to 3 has a clear tour of the wrist alone."
    usual = np.array([q_now[0], *USUAL_POSTURE_RAD[1:]])  # the usual posture at this pan angle
    for centre_m in certifier.arm.frames([q_now, usual]).flange_m:
        found = _box(certifier, q_now, numbers, centre_m, BOX_HALF_SIZE_M, speeds)
        yield "box", [nowhere, _box_words(centre_m, BOX_HALF_SIZE_M)], found
    if (chosen := chosen_tour(certifier, q_now, poses, np.pi, speeds, guess)) is not None:
        why = "Some orientations are out of reach: these are the most informative reachable poses."
        yield "reachable", [why, nowhere, *_chosen_words(chosen)], (chosen.numbers, chosen.q_rad)


def _reason(poses: int) -> str:
    if poses == 24:
        return "The constant tour cannot be proven clear at the present posture"
    return f"{poses} of the 24 orientations were requested"


def _plan_tool(certifier: Certifier, q_rad: ArrayLike, *, speeds: Speeds, guess: Guess) -> Plan:
    """Plan a tour of the four most informative reachable poses, for a new tool on a calibrated cell.

    The poses determine all parameters, not only weight, centre of mass and bias of the tool. Their error is 3 % above
    the error of a tetrahedron of gravity directions.
    """
    tour = chosen_tour(certifier, checked_joints(q_rad), TOOL_POSES, np.pi, speeds, guess)
    if tour is None:
        raise PlanRefused(
            f"no tour of {TOOL_POSES} poses is reachable, proven clear and informative enough for a new tool: jog the "
            "arm to another posture, or clear the surroundings"
        )
    why = [f"{TOOL_POSES} poses for a new tool; mounting and base are known.", *_chosen_words(tour)]
    plan = make_plan("tool", why, certifier, tour.numbers, tour.q_rad, speeds, guess)
    return replace(plan, why=tuple(why))  # not the predicted error, which ignores the earlier calibration


def _plan_hung(certifier: Certifier, q_rad: ArrayLike, *, speeds: Speeds, guess: Guess) -> Plan:
    """Plan a tour of tilts with a load on a string; the arm turns about the hook, which stays at one point."""
    speeds = speeds.limited(Speeds.with_hung_load())
    q_now = checked_joints(q_rad)
    tour = hung_tour(certifier, q_now, HUNG_POSES, speeds)
    if tour is None:
        raise PlanRefused(
            f"no tour of {HUNG_POSES} tilts of 45 to 75 degrees is reachable and proven clear with the hanging load: "
            "jog the arm to where there is room around and below the load, or hang it from another point of the tool"
        )
    hook_m = tour[2]
    numbers, q = _start_nearest(q_now, tour[:2])
    share = np.linspace(0, 1, 41)[:, None, None]
    between = ((1 - share) * q + share * np.roll(q, -1, axis=0)).reshape(-1, 6)
    away_mm = 1e3 * np.linalg.norm(certifier.arm.hook_m(certifier.arm.frames(between)) - hook_m, axis=1).max()
    why = [
        f"{HUNG_POSES} tilts with a hanging load. Its hook stays at {_format_point(hook_m)} at each of them, and "
        f"within {away_mm:.0f} mm of it during the moves, below {1e3 * (speeds.tip_m_s or 0):.0f} mm/s."
    ]
    plan = make_plan("hung", why, certifier, numbers, q, speeds, guess)
    # The predicted error is left out, because it ignores the run of the tool alone.
    return replace(plan, why=tuple(why))


def _plan_cone(
    certifier: Certifier,
    q_rad: ArrayLike = USUAL_POSTURE_RAD,
    poses: int = 24,
    *,
    half_angle_rad: float,
    speeds: Speeds,
    guess: Guess,
) -> Plan:
    """Plan a tour of at least 6 chosen poses with the tool axis (flange z) within an angle of straight down."""
    q_now = checked_joints(q_rad)
    if not (0 < half_angle_rad <= np.pi and poses >= FEWEST_CHOSEN):
        raise ConfigError(
            f"a cone of {np.degrees(half_angle_rad):g} degrees with {poses} poses cannot be planned: give above 0 and "
            f"up to 180 degrees, and {FEWEST_CHOSEN} poses or more"
        )
    cone = f"within {np.degrees(half_angle_rad):.0f} degrees of straight down"
    tour = chosen_tour(certifier, q_now, poses, half_angle_rad, speeds, guess)
    if tour is None:
        raise PlanRefused(
            f"no tour of {poses} poses with the tool {cone} is reachable, proven clear and informative enough to "
            "estimate all parameters: widen the cone, or jog the arm to another posture"
        )
    why = [f"The tool axis stays {cone}.", *_chosen_words(tour)]
    return make_plan("cone", why, certifier, tour.numbers, tour.q_rad, speeds, guess)


def _plan_box(
    certifier: Certifier,
    q_rad: ArrayLike = USUAL_POSTURE_RAD,
    poses: int = 24,
    *,
    half_size_m: float = BOX_HALF_SIZE_M,
    centre_m: ArrayLike | None = None,
    speeds: Speeds,
    guess: Guess,
) -> Plan:
    """Plan a tour of the special orientations with the flange inside a box. Base, shoulder and elbow move too.

    The edges of the box, twice `half_size_m` long, are along the base axes. Its centre is by default at the flange.
    """
    q_now = checked_joints(q_rad)
    if not 0 <= half_size_m <= 1:
        raise ConfigError(f"the box is {1e3 * half_size_m:g} mm to each side: give 0 to 1000 mm")
    centre = certifier.arm.frames(q_now).flange_m[0] if centre_m is None else np.asarray(centre_m, dtype=np.float64)
    tour = _box(certifier, q_now, _pose_numbers(poses), centre, half_size_m, speeds)
    if tour is None:
        raise PlanRefused(
            f"with the flange within {1e3 * half_size_m:.0f} mm of {_format_point(centre)} not all {poses} "
            "orientations are reachable, or no tour of them is proven clear: give a larger box, or another centre"
        )
    return make_plan("box", [_box_words(centre, half_size_m)], certifier, *tour, speeds, guess)


def _plan_sets(certifier: Certifier, q_rad: ArrayLike, sets: str, *, speeds: Speeds, guess: Guess) -> Plan:
    """Plan one tour through sets of orientations of Yu's Fig. 6, such as A+E; `COUNTS` has their names."""
    q_now = checked_joints(q_rad)
    try:
        names = set_names(sets)
    except ValueError as error:
        raise ConfigError(str(error)) from error
    down = certifier.scene.down_base
    kinds = [
        (_at_pan(q_now, NUMBERS[24]) if name == "A" else paper_set(name, spare=SPARE, down_base=down), COUNTS[name])
        for name in names
    ]
    tour = tour_of_sets(certifier, q_now, kinds, speeds)
    if tour is None:
        raise PlanRefused(
            f"no tour of the sets {sets} is reachable and proven clear: jog the arm to another posture, clear the "
            "surroundings, or choose other sets"
        )
    numbers = np.concatenate([set_numbers(name) for name in names])[tour[0]]
    why = [f"{len(numbers)} poses: {', '.join(f'{name} {COUNTS[name]}' for name in names)} (Yu et al. 2021, Fig. 6)."]
    why += [] if np.array_equal(tour[1][0, :3], q_now[:3]) else [_elsewhere_words(tour[1][0])]
    return make_plan("sets", why, certifier, numbers.tolist(), tour[1], speeds, guess)


def plan_verification(
    certifier: Certifier, q_rad: ArrayLike, poses: int, R_fitted: Array, *, speeds: Speeds, guess: Guess
) -> Plan:
    """Plan a tour far from the orientations `R_fitted` (k, 3, 3) of a calibration; otherwise like `plan_tour`."""
    q_now = checked_joints(q_rad)
    if poses < FEWEST_TO_VERIFY:
        raise ConfigError(f"{poses} poses cannot verify a calibration: give {FEWEST_TO_VERIFY} or more")
    tour = verification_tour(certifier, q_now, poses, R_fitted, speeds)
    if tour is None:
        raise PlanRefused(
            f"no tour of {poses} new poses is reachable and proven clear: jog the arm to another posture, or clear "
            "the surroundings"
        )
    numbers, q = _start_nearest(q_now, tour)
    why = [f"{poses} poses that were not used in the calibration, far from its {len(R_fitted)} poses."]
    why += [] if np.array_equal(q[0, :3], q_now[:3]) else [_elsewhere_words(q[0])]
    plan = make_plan("verification", why, certifier, numbers, q, speeds, guess)
    return replace(plan, why=tuple(why))  # without the predicted error, because these poses calibrate nothing


def _start_nearest(q_now: Array, tour: Found) -> Found:
    """Return a closed tour that starts nearest to the current joint angles, where the cable is least wound."""
    numbers, q = tour
    nearest = -int(np.abs(q - q_now).max(axis=1).argmin())
    return np.roll(numbers, nearest).tolist(), np.roll(q, nearest, axis=0)


def _pose_numbers(poses: int) -> tuple[int, ...]:
    if poses not in NUMBERS:
        raise ConfigError(f"there is no plan of {poses} poses: choose one of {', '.join(map(str, NUMBERS))}")
    return NUMBERS[poses]


def _winds_little(q_rad: Array, q_now: Array) -> bool:
    """Return whether joint 6 stays within 200° of its current angle in all poses, so that the cable winds little."""
    return bool(np.abs(q_rad[:, 5] - q_now[5]).max() <= WRIST_6_RAD + 1e-9)


def _wrist(certifier: Certifier, q_rad: Array, numbers: Sequence[int], speeds: Speeds) -> Found | None:
    q, group = wrist_nodes(certifier, q_rad, _at_pan(q_rad, numbers))
    if len(np.unique(group)) < len(numbers):
        return None
    order = clear_tour(certifier, q, group, speeds)
    return None if order is None else ([numbers[g] for g in group[order]], q[order])


def _box(
    certifier: Certifier, q_rad: Array, numbers: Sequence[int], centre_m: Array, half_size_m: float, speeds: Speeds
) -> Found | None:
    q, group = box_nodes(certifier, q_rad, _at_pan(q_rad, numbers), centre_m, half_size_m)
    if len(np.unique(group)) < len(numbers):
        return None
    # Prefer nodes that move base, shoulder and elbow least.
    away = np.abs(q - q_rad)
    calm = np.argsort(away[:, :3].max(axis=1) + 0.01 * away.sum(axis=1), kind="stable")
    order = clear_tour(certifier, q[calm], group[calm], speeds)
    return None if order is None else ([numbers[g] for g in group[calm][order]], q[calm][order])


def _at_pan(q_rad: Array, numbers: Sequence[int]) -> Array:
    """Return the constant tour's orientations (n, 3, 3), turned about base z to the angle of joint 1."""
    return np.asarray(Rotation.from_euler("z", q_rad[0] - np.pi / 4).as_matrix() @ special(numbers))


def _chosen_words(chosen: Chosen) -> list[str]:
    lost = chosen.force_rms_N / chosen.ideal_force_rms_N
    words = [f"Their predicted error is {lost:.2f} times that of the best poses without reach limits."]
    return [*words, _elsewhere_words(chosen.q_rad[0])] if chosen.elsewhere else words


def _elsewhere_words(q_rad: Array) -> str:
    first = np.degrees(q_rad[:3]).round().astype(int).tolist()
    return f"A tour exists with joints 1 to 3 at {first} degrees; the approach to them is not part of the plan."


def _box_words(centre_m: Array, half_size_m: float) -> str:
    return (
        f"The flange stays within {1e3 * half_size_m:.0f} mm of {_format_point(centre_m)}: base, shoulder and elbow "
        "move too, and the whole arm needs clear space."
    )


def _format_point(centre_m: Array) -> str:
    return "(" + ", ".join(f"{value:.2f}" for value in centre_m) + ") m in base"


def speeds_of(cell: CellConfig) -> Speeds:
    """Return the speed limits configured for a cell."""
    robot = cell.robot
    joint_rad_s, joint_rad_s2 = np.radians([robot.speed_deg_s, robot.acceleration_deg_s2])
    return Speeds(float(joint_rad_s), float(joint_rad_s2), robot.tip_speed_mm_s / 1e3).limited(FASTEST)


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
    """Plan a tour for a cell and its certifier, starting near joint angles `q_rad` (6,).

    Raises `PlanRefused` if too few poses are reachable by moves that are proven clear, `ConfigError` for bad values.
    """
    speeds, guess = speeds_of(cell), guess_of(certifier, cell)
    if tip_unlimited:
        speeds = replace(speeds, tip_m_s=None)
    if cone_deg is not None:
        half_angle_rad = float(np.radians(cone_deg))
        made = _plan_cone(certifier, q_rad, poses, half_angle_rad=half_angle_rad, speeds=speeds, guess=guess)
    elif box_mm is not None:
        made = _plan_box(certifier, q_rad, poses, half_size_m=box_mm / 1e3, speeds=speeds, guess=guess)
    elif sets is not None:
        made = _plan_sets(certifier, q_rad, sets, speeds=speeds, guess=guess)
    elif certifier.arm.hung is not None:
        made = _plan_hung(certifier, q_rad, speeds=speeds, guess=guess)
    elif poses == TOOL_POSES:
        made = _plan_tool(certifier, q_rad, speeds=speeds, guess=guess)
    else:
        made = plan_tour(certifier, q_rad, poses, speeds=speeds, guess=guess)
    if not made.certified:
        raise PlanRefused("a move of the plan could not be proven clear: jog the arm to another posture")
    return made.marked(measured=cell.workcell.measured, emulated=cell.is_emulated)


def sweep_for(cell: CellConfig, certifier: Certifier, q_rad: ArrayLike, seconds: float) -> Plan:
    """Plan a sweep for a cell and its certifier, near joint angles `q_rad` (6,); raises the errors of `plan_sweep`."""
    made = plan_sweep(
        certifier,
        q_rad,
        seconds,
        speeds=speeds_of(cell),
        stop_rad_s2=float(np.radians(cell.robot.stop_deceleration_deg_s2)),
        guess=guess_of(certifier, cell),
    )
    return made.marked(measured=cell.workcell.measured, emulated=cell.is_emulated)


def certifier_for(
    cell: CellConfig,
    model: str | None,
    kinematics: Kinematics | None = None,
    p_flange_hook_m: tuple[float, float, float] | None = None,
    *,
    must_be_possible: bool = True,
) -> Certifier:
    """Return the certifier for the arm, tool and surroundings of a cell.

    Parameters
    ----------
    cell : CellConfig
    model : str or None
        Model of the arm, as reported by the controller or configured.
    kinematics : Kinematics, optional
        Kinematics of this arm. Without them nominal ones are used, and more distance is kept.
    p_flange_hook_m : (float, float, float), optional
        Point of the tool from which a load hangs on a string.
    must_be_possible : bool
        Whether to refuse impossible cells (see `require_possible`); a drawing shows them.

    Raises
    ------
    ConfigError
        The arm or the tool is missing, a shape is impossible, the arm has no measured shape, or see `require_possible`.
    """
    if model is None:
        raise ConfigError("the model of the arm is unknown: give --model, or set [robot] model in ftdrive.toml")
    if not cell.tool.cylinders_mm:
        raise ConfigError(
            "the tool is not described: give --tool FROM:TO:DIAMETER, or [tool] cylinders_mm in ftdrive.toml"
        )
    planes = (BASE_PLANE, *map(plane_from_mm, cell.workcell.planes_mm))
    scene = Scene(planes, tuple(map(box_from_mm, cell.workcell.boxes_mm)), lean_of(cell.workcell.mounting))
    x, y, z = scene.down_base.tolist()
    hung = None if p_flange_hook_m is None else HungLoad(p_flange_hook_m, (x, y, z))
    arm = ArmModel(model, [_cylinder_from_mm(values) for values in cell.tool.cylinders_mm], kinematics, hung)
    if must_be_possible:
        require_possible(cell, model)
    return Certifier(arm, scene)


def require_possible(cell: CellConfig, model: str | None) -> None:
    """Reject impossible cells: a tool that ends inside the sensor, or a plane or box that contains the arm itself.

    The test uses the shoulder, whose position is the same in every posture. Objects at the base, such as a table around
    its mounting plate, are allowed.

    Parameters
    ----------
    cell : CellConfig
        The cell. A tool without cylinders is not checked.
    model : str or None
        Model of the arm. If its shape is not measured, planes and boxes are not checked.

    Raises
    ------
    ConfigError
        The message names the cylinders, plane or box, and the remedy after the last colon.
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
    """The ball that the shoulder of an arm occupies in every posture."""

    def __init__(self, name: str) -> None:
        self._centre_m = np.array([0.0, 0.0, MODELS[name].d_m[0]])
        self._radius_m, self._margin_m = SHAPES[name].shoulder_radius_m, Margins().scene_m

    def against_plane(self, row: Sequence[float]) -> str:
        """Describe why a configured plane is impossible, and which one was probably meant; empty if it is possible."""
        gap_m, (x, y, z, place) = self._above_m(row), row
        if gap_m >= self._margin_m:
            return ""
        meant = (-x, -y, -z, -place), (x, y, z, -place)
        same, opposite = (_plane_words(plane) if self._above_m(plane) >= self._margin_m else "" for plane in meant)
        if gap_m > -self._radius_m or not same:
            return self._too_near(f"the plane {_plane_words(row)}", gap_m)
        return (
            f"the arm's own {'base' if place > 0 else 'shoulder'} is on the wrong side of the plane "
            f"{_format_row(row)}: the arm must stay where normal · point is at least {place:g} mm. "
            f"Give {same} if the plane is there"
            + (f", {opposite} if it is on the other side of the base" if opposite else "")
        )

    def against_box(self, row: Sequence[float]) -> str:
        """Describe why a configured box is impossible; empty if it is possible."""
        box = box_from_mm(row)
        away_m = float(np.linalg.norm(self._centre_m - np.clip(self._centre_m, box.low_m, box.high_m)))
        gap_m = away_m - self._radius_m
        return "" if gap_m >= self._margin_m else self._too_near(f"the box {_format_row(row)}", gap_m)

    def _above_m(self, row: Sequence[float]) -> float:
        plane = plane_from_mm(row)
        return float(np.dot(plane.normal, self._centre_m)) - plane.offset_m - self._radius_m

    def _too_near(self, what: str, gap_m: float) -> str:
        return (
            f"{what} is {1e3 * max(gap_m, 0.0):.0f} mm from the arm's shoulder, less than the margin of "
            f"{1e3 * self._margin_m:.0f} mm in every posture: measure it again in base coordinates, in mm"
        )


def _format_row(row: Sequence[float]) -> str:
    return f"[{', '.join(f'{value + 0.0:g}' for value in row)}]"


def _plane_words(row: Sequence[float]) -> str:
    return f"{_format_row(row)} ({side})" if (side := side_of(row)) else _format_row(row)


def _cylinder_from_mm(values: Sequence[float]) -> Cylinder:
    """Return a cylinder from its values in mm: from, to, diameter, and optionally x and y of its axis."""
    return Cylinder(*_metres("a cylinder of the tool", "from, to, diameter, or these and x, y", values, (3, 5)))


def plane_from_mm(values: Sequence[float]) -> Plane:
    """Return a plane from values x, y, z of a normal of any length, and the smallest allowed offset along it, mm."""
    *normal, offset_m = _metres("a plane", "its normal and an offset", values, (4,))
    length = float(np.linalg.norm(normal))
    if not length:
        raise ConfigError(f"a plane is {list(values)}: its normal is zero, give for example -1, 0, 0, -800")
    x, y, z = (value / length for value in normal)
    return Plane((x, y, z), offset_m)


def box_from_mm(values: Sequence[float]) -> Box:
    """Return a box from any two opposite corners, mm."""
    corners = np.array(_metres("a box", "two opposite corners", values, (6,))).reshape(2, 3)
    (x1, y1, z1), (x2, y2, z2) = np.sort(corners, axis=0).tolist()
    return Box((x1, y1, z1), (x2, y2, z2))


def _metres(what: str, content: str, values: Sequence[float], counts: Sequence[int]) -> list[float]:
    if len(values) not in counts or not all(map(np.isfinite, values)):
        wanted = " or ".join(map(str, counts))
        raise ConfigError(f"{what} is {list(values)}: give {wanted} numbers, {content}, in mm")
    return [float(value) / 1e3 for value in values]
