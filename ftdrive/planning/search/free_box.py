"""A tour with the flange anywhere in a box at each pose: where no posture lets the wrist do it alone."""

import numpy as np
from numpy.typing import ArrayLike

from drivers.ur.kinematics import Array
from ftdrive.planning.geometry.certify import Certifier
from ftdrive.planning.motion import Speeds
from ftdrive.planning.search.nodes import Nodes, box_nodes
from ftdrive.planning.search.tours import clear_tour


def box_tour(
    certifier: Certifier, q_rad: ArrayLike, R_base_flange: Array, centre_m: Array, half_size_m: float, speeds: Speeds
) -> tuple[Nodes, Array] | None:
    """Find a short closed tour with the centre of the flange free in a box.

    Parameters
    ----------
    certifier : Certifier
    q_rad : array_like, shape (6,)
        Present joint angles.
    R_base_flange : array, shape (m, 3, 3)
        Orientations to visit.
    centre_m : array, shape (3,)
        Of the box, in base.
    half_size_m : float
    speeds : Speeds

    Returns
    -------
    order : int array, shape (m,)
        Indices of the orientations in the order of travel.
    q : array, shape (m, 6)
    """
    q_now = np.asarray(q_rad, dtype=np.float64)
    q, group = box_nodes(certifier, q_now, R_base_flange, centre_m, half_size_m)
    if len(np.unique(group)) < len(R_base_flange):
        return None
    # Preferred: what moves base, shoulder and elbow least.
    away = np.abs(q - q_now)
    calm = np.argsort(away[:, :3].max(axis=1) + 0.01 * away.sum(axis=1), kind="stable")
    order = clear_tour(certifier, q[calm], group[calm], speeds)
    return None if order is None else (group[calm][order], q[calm][order])
