"""Joint vectors that bring the flange to wanted orientations: all branches and whole turns within the joints' windows.

Nodes (n, 6) come with a group (n,), the index of the orientation that each of them serves.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ftdrive.planning.geometry.certify import Certifier
from ftdrive.planning.geometry.kinematics import inverse, wrist_inverse
from ftdrivers.ur.kinematics import Array

Nodes = NDArray[np.intp]

SHOULDER_RAD = float(np.radians(110))
WRIST_6_RAD = float(np.radians(200))
HALF_TURN_RAD = float(np.radians(183))
"""So that a real arm, which is up to 3 degrees from the table, has both ways to an angle half a turn away."""
WINDOW_RAD = np.array([np.pi, SHOULDER_RAD, np.inf, HALF_TURN_RAD, HALF_TURN_RAD, WRIST_6_RAD])
"""To both sides of where the joints stand. Joint 6 is what winds the cable."""
ELBOW_RAD = float(np.radians(165))
"""From stretched. The elbow cannot fold further, and the shapes do not know it."""
STEPS = (-1.0, 0.0, 1.0)
"""Places of the flange along each edge of a box, as shares of its half size."""


def wrist_nodes(certifier: Certifier, q_rad: ArrayLike, R_base_flange: Array) -> tuple[Array, Nodes]:
    """All free joint vectors with joints 1 to 3 as they stand and the flange in one of these orientations.

    Parameters
    ----------
    q_rad : array_like, shape (6,)
        Present joint angles; the wrist stays in its windows around them.
    R_base_flange : array, shape (m, 3, 3)

    Returns
    -------
    q : array, shape (n, 6)
    group : int array, shape (n,)
        Index of the orientation.
    """
    q_now = np.asarray(q_rad, dtype=np.float64)
    solutions = wrist_inverse(certifier.arm.kinematics, q_now[:3], R_base_flange)  # (m, 2, 6)
    group = np.repeat(np.arange(len(solutions)), 2)
    return _free(certifier, *_within_windows(solutions.reshape(-1, 6), group, q_now, first=3))


def box_nodes(
    certifier: Certifier, q_rad: ArrayLike, R_base_flange: Array, centre_m: Array, half_size_m: float
) -> tuple[Array, Nodes]:
    """All free joint vectors with the flange in one of these orientations, at one of 27 places in a box.

    Parameters
    ----------
    q_rad : array_like, shape (6,)
        Present joint angles; the joints stay in their windows around them.
    R_base_flange : array, shape (m, 3, 3)
    centre_m : array, shape (3,)
        Of the box, for the centre of the flange, in base.
    half_size_m : float
        Half the length of its edges, which are along the base axes.

    Returns
    -------
    q : array, shape (n, 6)
    group : int array, shape (n,)
        Index of the orientation.
    """
    places = centre_m + half_size_m * np.stack(np.meshgrid(STEPS, STEPS, STEPS), axis=-1).reshape(-1, 3)
    group, place = (index.ravel() for index in np.indices((len(R_base_flange), len(places))))
    q = inverse(certifier.arm.kinematics, R_base_flange[group], places[place])  # (m * 27, 8, 6)
    group = np.repeat(group, q.shape[1])
    q = q.reshape(-1, 6)
    reached = ~np.isnan(q[:, 0]) & (np.abs(q[:, 2]) <= ELBOW_RAD)
    q_now = np.asarray(q_rad, dtype=np.float64)
    return _free(certifier, *_within_windows(q[reached], group[reached], q_now, first=0))


def distinct(certifier: Certifier, q_rad: Array) -> tuple[Array, Nodes]:
    """Joint vectors that differ in what can collide: angle 6 does not matter to a tool that is round about its axis."""
    moves = certifier.arm.travel_m.max(axis=0) > 0
    rounded = np.round(np.where(moves, q_rad, 0.0), 9)
    _, first, back = np.unique(rounded, axis=0, return_index=True, return_inverse=True)
    return np.where(moves, q_rad, 0.0)[first], back.ravel()


def _within_windows(q_rad: Array, group: Nodes, q_now: Array, first: int) -> tuple[Array, Nodes]:
    """Add whole turns to the joints from index `first` on, as far as windows and limits let them."""
    # Far from zero a joint has no room on one side: the window about zero serves there.
    middle = np.where(np.abs(q_now) > np.pi, 0.0, q_now)
    for joint in range(first, 6):
        turned = q_rad[:, None] + 2 * np.pi * np.array([-1, 0, 1])[:, None] * np.eye(6)[joint]
        angle = turned[:, :, joint]
        inside = (np.abs(angle - middle[joint]) <= WINDOW_RAD[joint] + 1e-9) & (np.abs(angle) <= 2 * np.pi + 1e-9)
        if joint == 2:
            inside = np.broadcast_to([False, True, False], inside.shape)
        q_rad, group = turned[inside], np.repeat(group[:, None], 3, axis=1)[inside]
    return q_rad, group


def _free(certifier: Certifier, q_rad: Array, group: Nodes) -> tuple[Array, Nodes]:
    if not len(q_rad):
        return q_rad, group
    shapes, back = distinct(certifier, q_rad)
    free = certifier.free(shapes)[back]
    return q_rad[free], group[free]
