"""Other postures of joints 1 to 3, nearest to the present one first."""

from collections.abc import Iterator
from itertools import product

import numpy as np

from ftdrive.planning.geometry.certify import Certifier
from ftdrive.planning.search.constant_tour import DIFFERENT_SHAPES, constant_tour
from ftdrivers.ur.kinematics import Array

_PANS_DEG = (0, 45, -45, 90, -90, 135, -135, 180)
_GRID_DEG = 10
_SHOULDER_DEG, _ELBOW_DEG = (-180, 0), (-160, 160)
_BATCH = 40
_LEVEL = 1e-9
MOST_POSTURES = 200
"""At most so many postures are tried, so that a cell without a tour is reported in time."""


def grid(certifier: Certifier, q_rad: Array, step_deg: int = _GRID_DEG) -> Array:
    """Candidate postures (m, 3) of joints 1 to 3, the nearest first."""
    level = not certifier.scene.boxes and all(np.hypot(*plane.normal[:2]) < _LEVEL for plane in certifier.scene.planes)
    pans = q_rad[0] + np.radians(_PANS_DEG[:1] if level else _PANS_DEG)  # nothing distinguishes one pan from another
    shoulder, elbow = (np.radians(np.arange(low, high + 1, step_deg)) for low, high in (_SHOULDER_DEG, _ELBOW_DEG))
    postures = np.array(list(product(pans, shoulder, elbow)))
    postures = postures[np.abs(postures[:, 0]) <= 2 * np.pi]
    away = np.abs(postures - q_rad[:3])
    return np.asarray(postures[np.argsort(away.max(axis=1) + 0.01 * away.sum(axis=1), kind="stable")])


def with_room(certifier: Certifier, q_rad: Array) -> Iterator[Array]:
    """Constant tours (24, 6) at other postures whose poses are free; their moves may not be clear."""
    postures = grid(certifier, q_rad)
    offered = 0
    for batch in np.array_split(postures, max(1, len(postures) // _BATCH)):
        tours = np.array([constant_tour([*first, *q_rad[3:]]) for first in batch])
        # Turning joint 6 alone brings a new pose, but hardly a new shape: the rest is for the proof.
        q = tours[:, DIFFERENT_SHAPES]
        for i in np.flatnonzero(certifier.free(q.reshape(-1, 6)).reshape(q.shape[:2]).all(axis=1)):
            yield constant_tour(tours[i, 0], certifier.arm.kinematics)
            offered += 1
            if offered == MOST_POSTURES:
                return
