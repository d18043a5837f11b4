"""The constant tour: the wrist alone takes the sensor through all 24 orientations in 24 moves of 90 degrees.

With base, shoulder and elbow at rest, the three wrist joints of every Universal Robots arm reach all 24 orientations of
Yu et al. (eq. 14, Fig. 3). The table is the same for all models: their wrists share one geometry. No tour of the wrist
can have fewer or shorter moves. Of those that have not more, and are clear on all models, this one is the fastest where
the speed of the tool's tip is limited: 16 moves turn joint 6 alone. Wrist 1 turns by 90 degrees only.
"""

import numpy as np
from numpy.typing import ArrayLike

from ftdrive.planning.geometry.kinematics import checked_joints, frames, is_exact, wrist_refined
from ftdrivers.ur.kinematics import MODELS, Array, Kinematics

# Orientation number in the paper, then psi = q2 + q3 + q4, q5 and q6 in degrees.
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
NUMBERS = tuple(row[0] for row in _TOUR_DEG)
"""Of the orientations, 1 to 24, in the order of travel."""
DIFFERENT_SHAPES = tuple(np.unique([row[1:3] for row in _TOUR_DEG], axis=0, return_index=True)[1].tolist())
"""Stops that differ in more than joint 6."""


_NOMINAL = MODELS["UR5e"]
"""The wrist angles of an orientation are the same for every nominal arm."""
_ROOM_RAD = float(np.radians(3))
"""Between the table and the wrist angles of a real arm, which is at most 1.3 degrees from the nominal one."""


def constant_tour(q_rad: ArrayLike, kinematics: Kinematics = _NOMINAL) -> Array:
    """Joint vectors (24, 6) of the tour at the present posture of joints 1 to 3.

    Joints 1 to 3 keep their angles. The flange orientation at a pose is `Rz(q1 - 45 deg) @ R_i.T` with the paper's
    matrix R_i, so at other base pans than 45 degrees the whole set is turned about the base's z axis. The wrist of an
    arm with its own kinematics turns up to a few degrees less or more to get there.

    Parameters
    ----------
    q_rad : array_like, shape (6,)
        Present joint angles. Joint 4 stays as close to it as whole turns allow.
    kinematics : Kinematics, optional
        The arm's own.

    Returns
    -------
    array
        In the order of travel; all joints within one turn of zero.
    """
    q = checked_joints(q_rad)
    psi, q5, q6 = np.radians(_TOUR_DEG)[:, 1:].T
    # Whole turns, chosen for the tour as one; as it turns joint 4 by 90 degrees only, some fit always.
    q4 = psi - q[1] - q[2] + 2 * np.pi * np.arange(-3, 4)[:, None]
    room = _ROOM_RAD if kinematics is not _NOMINAL else -1e-9
    inside = q4[(np.abs(q4) <= 2 * np.pi - room).all(axis=1)]
    nearest = inside[np.abs(inside[:, 0] - q[3]).argmin()]
    tour = np.column_stack([np.tile(q[:3], (len(psi), 1)), nearest, q5, q6])
    if is_exact(kinematics):
        return tour
    return wrist_refined(kinematics, tour, frames(_NOMINAL, tour).R_base_flange)
