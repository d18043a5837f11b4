"""The constant wrist-only tour: 24 orientations, and back to the first, in 24 moves of 90 degrees.

With base, shoulder and elbow at rest, the three wrist joints of every Universal Robots arm reach all 24 orientations of
Yu et al. (eq. 14, Fig. 3). The table below is the same for all models: their wrists share one geometry.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Orientation number in the paper, then psi = q2 + q3 + q4, q5 and q6 in degrees.
_TOUR_DEG = (
    (1, -90, 90, 45),
    (19, -180, 45, 90),
    (12, -180, -45, 90),
    (8, -180, -45, 0),
    (16, -180, -45, -90),
    (14, -90, -90, -135),
    (5, -90, -90, -45),
    (9, -90, -90, 45),
    (2, -90, -90, 135),
    (4, -180, -45, 180),
    (17, -180, 45, 180),
    (7, -180, 135, 180),
    (15, -180, 135, 90),
    (3, -180, 135, 0),
    (11, -180, 135, -90),
    (20, -180, 45, -90),
    (18, -180, 45, 0),
    (10, -90, 90, -45),
    (6, -90, 90, -135),
    (24, 0, 135, -90),
    (22, 0, 135, 0),
    (23, 0, 135, 90),
    (21, 0, 135, 180),
    (13, -90, 90, 135),
)

JOINT_LIMIT_RAD = 2 * np.pi
"""All joints of all models turn at least this far either way."""


@dataclass(frozen=True, slots=True, eq=False)
class TourPose:
    """One stop of the tour."""

    number: int
    """Of the orientation, 1 to 24, as in the paper."""
    q_rad: Array
    """(6,) joint angles."""


def wrist_tour(q_rad: Sequence[float] | Array) -> tuple[TourPose, ...]:
    """Plan the 24 poses around the posture in which the arm stands.

    Joints 1 to 3 keep their angles. The flange orientation at a pose is `Rz(q1 - 45 deg) @ R_i.T` with the paper's
    matrix R_i, so at other base pans than 45 degrees the whole set is turned about the base's z axis.

    Parameters
    ----------
    q_rad : array_like, shape (6,)
        Where the arm stands.

    Returns
    -------
    tuple of 24 TourPose
        In the order of travel. No move between neighbours, nor from the last to the first, turns a joint by more than
        90 degrees.

    Raises
    ------
    ValueError
        If joint 4 would leave its range of one turn either way.
    """
    q = np.asarray(q_rad, dtype=np.float64)
    lift = q[1] + q[2]
    psi = np.radians([row[1] for row in _TOUR_DEG])
    # One whole turn, chosen for the tour as one, brings joint 4 close to where it stands without leaving its range.
    turns = [k for k in (-2, -1, 0, 1, 2) if np.all(np.abs(psi - lift + 2 * np.pi * k) <= JOINT_LIMIT_RAD + 1e-9)]
    if not turns:
        raise ValueError(
            f"joint 4 cannot follow the tour from q2 + q3 = {np.degrees(lift):.0f} deg: bring the elbow and shoulder "
            "closer to their home positions"
        )
    turn = min(turns, key=lambda k: abs(psi[0] - lift + 2 * np.pi * k - q[3]))
    return tuple(
        TourPose(
            number,
            np.array([*q[:3], np.radians(psi_deg) - lift + 2 * np.pi * turn, np.radians(q5_deg), np.radians(q6_deg)]),
        )
        for number, psi_deg, q5_deg, q6_deg in _TOUR_DEG
    )
