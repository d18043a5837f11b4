"""The choice of a plan: the constant tour where it fits, else what comes next, and why."""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from itertools import product

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from calib.design import SUBSET_6, T12, Guess, special
from calib.tour import wrist_tour
from drivers.ur.kinematics import Array
from ftdrive.errors import ConfigError, PlanRefused
from ftdrive.planning.approach import Approach, plan_approach
from ftdrive.planning.certify import Certifier
from ftdrive.planning.kinematics import checked_joints
from ftdrive.planning.motion import Speeds
from ftdrive.planning.plan import Plan, make_plan
from ftdrive.planning.tours import allowed_moves, shortest_tour, wrist_nodes

__all__ = ["NUMBERS", "USUAL_POSTURE_RAD", "Approach", "guess_of", "plan_approach", "plan_tour"]

USUAL_POSTURE_RAD = np.radians([45.0, -100.0, 60.0, -50.0, 90.0, 45.0])
"""Where all models have room for the constant tour with usual tools; the wrist is at its first pose."""
NUMBERS = {24: tuple(range(1, 25)), 12: T12, 6: SUBSET_6}
_GRID_DEG = 10
_SHOULDER_DEG, _ELBOW_DEG = range(-180, 1, _GRID_DEG), range(-160, 161, _GRID_DEG)
_PANS_DEG = (0, 45, -45, 90, -90, 135, -135, 180)
_DIFFERENT_SHAPES = (0, 1, 2, 5, 11, 19)
"""Stops of the constant tour that differ in psi and q5."""
_BATCH = 40
LEVEL = 1e-9
MOST_POSTURES = 200
"""Postures whose tour is tried, so that a hopeless cell is told within seconds."""


def guess_of(certifier: Certifier, mass_kg: float = 1.0) -> Guess:
    """Expect a tool of this mass, its centre half way down, noise of an averaged pose, and gravity as mounted."""
    length_m = max(part.to_m for part in certifier.arm.tool)
    return Guess(mass_kg, 0.05, 0.003, (0.0, 0.0, length_m / 2), tilt_beta_rad=certifier.scene.lean_rad)


def plan_tour(
    certifier: Certifier, q_rad: ArrayLike = USUAL_POSTURE_RAD, poses: int = 24, *, speeds: Speeds, guess: Guess
) -> Plan:
    """Plan a tour of the special orientations, with joints 1 to 3 as they stand if that is possible.

    Parameters
    ----------
    q_rad : array_like, shape (6,)
        Where the arm stands.
    poses : {24, 12, 6}

    Raises
    ------
    PlanRefused
        Neither here nor in another posture is there a tour whose moves are all proven clear.
    """
    stands = checked_joints(q_rad)
    if poses not in NUMBERS:
        raise ConfigError(f"a plan of {poses} poses is not known: take {', '.join(map(str, NUMBERS))}")
    if poses == 24:
        constant = _constant(certifier, stands)
        if constant is not None:
            why = ["The constant tour is proven clear where the arm stands; base, shoulder and elbow stay at rest."]
            return make_plan("constant", why, certifier, *constant, speeds, guess)
        reason = "The constant tour cannot be proven clear where the arm stands"
    else:
        reason = f"{poses} of the 24 orientations were asked for"
    short = _wrist(certifier, stands, poses, speeds)
    if short is not None:
        why = [f"{reason}: the wrist visits them in the order that is fastest here, base, shoulder and elbow at rest."]
        return make_plan("wrist", why, certifier, *short, speeds, guess)
    for posture in _postures(certifier, stands):
        elsewhere = _constant(certifier, posture)
        if elsewhere is not None and poses < 24:
            elsewhere = _wrist(certifier, posture, poses, speeds)
        if elsewhere is not None:
            first = np.degrees(posture[:3]).round().astype(int).tolist()
            why = [
                f"{reason}, and the wrist alone finds no way there.",
                f"With joints 1 to 3 at {first} degrees it does: jog there, that move is not part of the plan.",
            ]
            return make_plan("posture", why, certifier, *elsewhere, speeds, guess)
    raise PlanRefused(
        f"{reason}, and none of the other postures of joints 1 to 3 that were tried has a tour that is proven clear: "
        "describe the tool more closely, or free the scene"
    )


def _constant(certifier: Certifier, q_rad: Array) -> tuple[Sequence[int], Array] | None:
    try:
        tour = wrist_tour(q_rad)
    except ValueError:  # joint 4 would leave its range
        return None
    q = np.array([pose.q_rad for pose in tour])
    clear = certifier.certify(q, np.roll(q, -1, axis=0), tight=False).clear.all()
    return ([pose.number for pose in tour], q) if clear else None


def _wrist(certifier: Certifier, q_rad: Array, poses: int, speeds: Speeds) -> tuple[Sequence[int], Array] | None:
    numbers = NUMBERS[poses]
    pan = Rotation.from_euler("z", q_rad[0] - np.pi / 4).as_matrix()
    q, group = wrist_nodes(certifier, q_rad, pan @ special(numbers))
    if len(np.unique(group)) < poses:
        return None
    order = shortest_tour(q, group, allowed_moves(certifier, q, group), speeds)
    return None if order is None else ([numbers[g] for g in group[order]], q[order])


def _postures(certifier: Certifier, q_rad: Array) -> Iterator[Array]:
    """Other postures of joints 1 to 3 in which the poses of the constant tour are free, the nearest first."""
    level = not certifier.scene.boxes and all(np.hypot(*plane.normal[:2]) < LEVEL for plane in certifier.scene.planes)
    pans = q_rad[0] + np.radians(_PANS_DEG[:1] if level else _PANS_DEG)  # nothing distinguishes one pan from another
    grid = np.array(list(product(pans, np.radians(_SHOULDER_DEG), np.radians(_ELBOW_DEG))))
    grid = grid[np.abs(grid[:, 0]) <= 2 * np.pi]
    away = np.abs(grid - q_rad[:3])
    grid = grid[np.argsort(away.max(axis=1) + 0.01 * away.sum(axis=1), kind="stable")]
    tried = 0
    for batch in np.array_split(grid, max(1, len(grid) // _BATCH)):
        tours = []
        for first in batch:
            with suppress(ValueError):  # joint 4 would leave its range
                tours.append([pose.q_rad for pose in wrist_tour([*first, *q_rad[3:]])])
        if not tours:
            continue
        # Turning joint 6 alone brings a new pose, but hardly a new shape: the rest is for the proof.
        q = np.array(tours)[:, _DIFFERENT_SHAPES]
        for i in np.flatnonzero(certifier.free(q.reshape(-1, 6)).reshape(q.shape[:2]).all(axis=1)):
            tried += 1
            yield np.array(tours[i][0])
            if tried == MOST_POSTURES:
                return
