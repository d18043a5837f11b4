"""Joint vectors for given flange orientations: all branches and full turns within the windows of the joints.

Nodes (n, 6) have a group (n,), the index of the orientation of each node.

With base, shoulder and elbow at rest, the three wrist joints of every Universal Robots arm reach all 24 orientations of
Yu et al. (eq. 14, Fig. 3). The table of the constant tour holds for all models, because their wrists have the same
geometry. No wrist tour has fewer or shorter moves. Among the tours with as few moves that are clear on all models, it
is the fastest with limited tip speed: 16 moves turn joint 6 alone. Wrist 1 turns by 90 degrees only.
"""

from collections.abc import Iterator
from contextlib import suppress
from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ftdrive.errors import ConfigError
from ftdrive.planning.geometry.certify import Certifier
from ftdrive.planning.geometry.kinematics import checked_joints, frames, inverse, is_exact, wrist_inverse, wrist_refined
from ftdrivers.ur.kinematics import MODELS, Array, Kinematics

Nodes = NDArray[np.intp]

SHOULDER_RAD = float(np.radians(110))
# Wrist 3 winds the cable, so it stays within 200° of its current angle.
WRIST_6_RAD = float(np.radians(200))
# Half a turn in both directions, plus 3 degrees by which a real arm's wrist angles may differ from the nominal ones.
HALF_TURN_RAD = float(np.radians(183))
# Largest turn of each joint to either side of its current angle.
WINDOW_RAD = np.array([np.pi, SHOULDER_RAD, np.inf, HALF_TURN_RAD, HALF_TURN_RAD, WRIST_6_RAD])
# Largest elbow angle, 0 being the stretched arm. The elbow cannot fold further; the collision shapes do not show that.
ELBOW_RAD = float(np.radians(165))
# Flange positions to try along each edge of a box, from its centre, in units of half the edge.
STEPS = (-1.0, 0.0, 1.0)


def wrist_nodes(certifier: Certifier, q_rad: ArrayLike, R_base_flange: Array) -> tuple[Array, Nodes]:
    """Return all free joint vectors with joints 1 to 3 at rest and the flange in one of these orientations.

    Parameters
    ----------
    q_rad : array_like, shape (6,)
        Current joint angles; the wrist stays within its windows about them.
    R_base_flange : array, shape (m, 3, 3)

    Returns
    -------
    q : array, shape (n, 6)
    group : int array, shape (n,)
        Index of the orientation of each joint vector.
    """
    q_now = np.asarray(q_rad, dtype=np.float64)
    solutions = wrist_inverse(certifier.arm.kinematics, q_now[:3], R_base_flange)  # (m, 2, 6)
    group = np.repeat(np.arange(len(solutions)), 2)
    return _collision_free(certifier, *_within_windows(solutions.reshape(-1, 6), group, q_now, first=3))


def box_nodes(
    certifier: Certifier, q_rad: ArrayLike, R_base_flange: Array, centre_m: Array, half_size_m: float
) -> tuple[Array, Nodes]:
    """Return all free joint vectors with the flange in one of these orientations, at one of 27 positions in a box.

    The joints stay within their windows about `q_rad`. The edges of the box, twice `half_size_m` long, are along the
    base axes. Returns joint vectors (n, 6), and the index (n,) of the orientation of each.
    """
    places = centre_m + half_size_m * np.stack(np.meshgrid(STEPS, STEPS, STEPS), axis=-1).reshape(-1, 3)
    group, place = (index.ravel() for index in np.indices((len(R_base_flange), len(places))))
    return _at_places(certifier, q_rad, R_base_flange[group], places[place], group)


def hung_nodes(certifier: Certifier, q_rad: ArrayLike, R_base_flange: Array, hook_m: Array) -> tuple[Array, Nodes]:
    """Return all free joint vectors with the flange in one of these orientations and the hook of the load at one point.

    The joints stay within their windows about `q_rad`. Returns joint vectors (n, 6), and the index (n,) of the
    orientation of each.
    """
    hung = certifier.arm.hung
    p_flange_hook_m = np.zeros(3) if hung is None else np.array(hung.p_flange_m)
    places = hook_m - R_base_flange @ p_flange_hook_m
    return _at_places(certifier, q_rad, R_base_flange, places, np.arange(len(R_base_flange)))


def _at_places(
    certifier: Certifier, q_rad: ArrayLike, R_base_flange: Array, p_base_flange_m: Array, group: Nodes
) -> tuple[Array, Nodes]:
    q = inverse(certifier.arm.kinematics, R_base_flange, p_base_flange_m)  # (k, 8, 6)
    group = np.repeat(group, q.shape[1])
    q = q.reshape(-1, 6)
    reached = ~np.isnan(q[:, 0]) & (np.abs(q[:, 2]) <= ELBOW_RAD)
    q_now = np.asarray(q_rad, dtype=np.float64)
    return _collision_free(certifier, *_within_windows(q[reached], group[reached], q_now, first=0))


def distinct(certifier: Certifier, q_rad: Array) -> tuple[Array, Nodes]:
    """Return the joint vectors (k, 6) with different shapes, and the index (n,) of each given vector among them.

    Joint angles that move no body are set to zero, such as that of joint 6 with a tool that is round about its axis.
    """
    moves = certifier.arm.travel_m.max(axis=0) > 0
    rounded = np.round(np.where(moves, q_rad, 0.0), 9)
    _, first, back = np.unique(rounded, axis=0, return_index=True, return_inverse=True)
    return np.where(moves, q_rad, 0.0)[first], back.ravel()


def _within_windows(q_rad: Array, group: Nodes, q_now: Array, first: int) -> tuple[Array, Nodes]:
    """Return all variants of joint vectors with full turns of joints from index `first`, within windows and limits."""
    # A joint more than half a turn from zero has no room on one side, so its window is centred on zero.
    middle = np.where(np.abs(q_now) > np.pi, 0.0, q_now)
    for joint in range(first, 6):
        turned = q_rad[:, None] + 2 * np.pi * np.array([-1, 0, 1])[:, None] * np.eye(6)[joint]
        angle = turned[:, :, joint]
        inside = (np.abs(angle - middle[joint]) <= WINDOW_RAD[joint] + 1e-9) & (np.abs(angle) <= 2 * np.pi + 1e-9)
        if joint == 2:
            inside = np.broadcast_to([False, True, False], inside.shape)
        q_rad, group = turned[inside], np.repeat(group[:, None], 3, axis=1)[inside]
    return q_rad, group


def _collision_free(certifier: Certifier, q_rad: Array, group: Nodes) -> tuple[Array, Nodes]:
    if not len(q_rad):
        return q_rad, group
    shapes, back = distinct(certifier, q_rad)
    free = certifier.free(shapes)[back]
    return q_rad[free], group[free]


_PANS_DEG = (0, 45, -45, 90, -90, 135, -135, 180)
_GRID_DEG = 10
_SHOULDER_DEG, _ELBOW_DEG = (-180, 0), (-160, 160)
_BATCH = 40
_LEVEL = 1e-9
# Most postures that are tried, which limits the search time in a cell where no posture has a tour.
MOST_POSTURES = 200


def grid(certifier: Certifier, q_rad: Array, step_deg: int = _GRID_DEG) -> Array:
    """Return a grid of postures (m, 3) of joints 1 to 3 at which a tour may have room, nearest first."""
    level = not certifier.scene.boxes and all(np.hypot(*plane.normal[:2]) < _LEVEL for plane in certifier.scene.planes)
    # In a scene of horizontal planes only, all angles of joint 1 are equivalent.
    pans = q_rad[0] + np.radians(_PANS_DEG[:1] if level else _PANS_DEG)
    shoulder, elbow = (np.radians(np.arange(low, high + 1, step_deg)) for low, high in (_SHOULDER_DEG, _ELBOW_DEG))
    postures = np.array(list(product(pans, shoulder, elbow)))
    postures = postures[np.abs(postures[:, 0]) <= 2 * np.pi]
    away = np.abs(postures - q_rad[:3])
    return np.asarray(postures[np.argsort(away.max(axis=1) + 0.01 * away.sum(axis=1), kind="stable")])


def with_room(certifier: Certifier, q_rad: Array) -> Iterator[Array]:
    """Yield constant tours (24, 6) at other postures, with poses free of collisions; their moves are not yet proven."""
    postures = grid(certifier, q_rad)
    offered = 0
    for batch in np.array_split(postures, max(1, len(postures) // _BATCH)):
        tours = np.array([constant_tour([*first, *q_rad[3:]]) for first in batch])
        # Of poses that differ in joint 6 alone one is tested here, as shapes are alike; the proof tests all later.
        q = tours[:, DIFFERENT_SHAPES]
        for i in np.flatnonzero(certifier.free(q.reshape(-1, 6)).reshape(q.shape[:2]).all(axis=1)):
            yield constant_tour(tours[i, 0], certifier.arm.kinematics)
            offered += 1
            if offered == MOST_POSTURES:
                return


# Orientation number in the paper, then psi = q2 + q3 + q4, q5 and q6 in degrees. Every order of 90° moves takes 54 s at
# 60 °/s. This order has only eight moves of the whole wrist, which the limit of the tip speed slows down.
_TOUR_DEG = (
    (1, -90, 90, 45),
    (10, -90, 90, -45),
    (6, -90, 90, -135),
    (11, -180, 135, -90),
    (3, -180, 135, 0),
    (15, -180, 135, 90),
    (7, -180, 135, 180),
    (17, -180, 45, 180),
    (4, -180, -45, 180),
    (22, -180, -135, 180),
    (24, -180, -135, 90),
    (21, -180, -135, 0),
    (23, -180, -135, -90),
    (14, -90, -90, -135),
    (5, -90, -90, -45),
    (9, -90, -90, 45),
    (2, -90, -90, 135),
    (12, -180, -45, 90),
    (8, -180, -45, 0),
    (16, -180, -45, -90),
    (20, -180, 45, -90),
    (18, -180, 45, 0),
    (19, -180, 45, 90),
    (13, -90, 90, 135),
)
# Numbers of the orientations, 1 to 24, in the order of travel.
NUMBERS = tuple(row[0] for row in _TOUR_DEG)
# Indices of poses that differ in more than joint 6.
DIFFERENT_SHAPES = tuple(np.unique([row[1:3] for row in _TOUR_DEG], axis=0, return_index=True)[1].tolist())


# Any model serves, because the wrist angles of an orientation are the same for every nominal arm.
_NOMINAL = MODELS["UR5e"]
# Largest deviation of a real arm's wrist angles from the table of the tour, for arms within 1.3° of their model.
_ROOM_RAD = float(np.radians(3))


def constant_tour(q_rad: ArrayLike, kinematics: Kinematics = _NOMINAL) -> Array:
    """Return the joint vectors (24, 6) of the constant tour at the current posture of joints 1 to 3.

    Joints 1 to 3 keep their angles. The flange orientation of a pose is `Rz(q1 - 45 deg) @ R_i.T` with the paper's
    matrix R_i, so at a base angle other than 45 degrees the whole set is turned about the base z axis. The wrist
    angles of a real arm differ from the table by up to a few degrees.

    Parameters
    ----------
    q_rad : array_like, shape (6,)
        Current joint angles. Joint 4 stays as close to its angle as full turns allow.
    kinematics : Kinematics, optional
        Kinematics of this arm; nominal if omitted.

    Returns
    -------
    array
        Joint vectors in the order of travel; all joints within one turn of zero.
    """
    # Wrist 3 turns between -135° and 180°; if it is now outside -20° to 65°, the planner uses another order.
    q = checked_joints(q_rad)
    psi, q5, q6 = np.radians(_TOUR_DEG)[:, 1:].T
    # One number of full turns for the whole tour; joint 4 turns by 90 degrees only, so one always fits.
    q4 = psi - q[1] - q[2] + 2 * np.pi * np.arange(-3, 4)[:, None]
    room = _ROOM_RAD if kinematics is not _NOMINAL else -1e-9
    inside = q4[(np.abs(q4) <= 2 * np.pi - room).all(axis=1)]
    nearest = inside[np.abs(inside[:, 0] - q[3]).argmin()]
    tour = np.column_stack([np.tile(q[:3], (len(psi), 1)), nearest, q5, q6])
    if is_exact(kinematics):
        return tour
    return wrist_refined(kinematics, tour, frames(_NOMINAL, tour).R_base_flange)


def from_usual_wrist(certifier: Certifier, q_rad: Array) -> Array:
    """Return joint angles (6,) with joints 4 and 5 as at the start of the constant tour; joint 6 keeps its angle."""
    q = q_rad.copy()
    # The planner reports this error with its remedy.
    with suppress(ConfigError):
        q[3:5] = constant_tour(q, certifier.arm.kinematics)[0, 3:5]
    return q
