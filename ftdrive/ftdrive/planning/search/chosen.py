"""A tour of chosen poses that the wrist reaches: the most informative ones, or those far from a calibration's.

Informative poses follow the design of `ftcalib.poses.selection`, which keeps the second solution away and the gravity
directions out of one plane.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ftcalib.poses.information import Guess, predicted_sigma
from ftcalib.poses.selection import choose, choose_verification_poses, cone_candidates
from ftdrive.planning.geometry.certify import Certifier
from ftdrive.planning.geometry.kinematics import wrist_inverse
from ftdrive.planning.motion import Speeds
from ftdrive.planning.search.nodes import Nodes, grid, wrist_nodes
from ftdrive.planning.search.tours import clear_tour, connected
from ftdrivers.ur.kinematics import Array

DIRECTIONS, SPINS = 150, 8
# If joint 6 changes what can collide: each spin is a shape of its own then.
DIRECTIONS_OF_A_LUMP, SPINS_OF_A_LUMP = 60, 4
# Number of disconnected parts of free space that are tried.
MOST_PARTS = 2
# Number of joint vectors of each part, the nearest ones, to which a straight move is tried.
FROM_HERE = 6
# No other posture is tried if the predicted error is within this factor of the best poses of the cone.
NEARLY = 1.05
OTHER_POSTURES = 2
POSTURE_STEP_DEG = 20
# Number of the first chosen pose; 1 to 24 are those of the paper.
FIRST_NUMBER = 101
# Number of tool directions that compare postures.
LOOKS = 24


@dataclass(frozen=True, slots=True, eq=False)
class Chosen:
    """Poses in the order of travel."""

    numbers: tuple[int, ...]
    """From 101 on, in the order of choice: not those of the paper."""
    q_rad: Array
    """(n, 6)"""
    force_rms_N: float
    """Predicted error of compensation."""
    ideal_force_rms_N: float
    """Predicted error of the best poses without limits of reach."""
    elsewhere: bool
    """Joints 1 to 3 differ from the present posture."""


def chosen_tour(
    certifier: Certifier,
    q_rad: ArrayLike,
    poses: int,
    half_angle_rad: float,
    speeds: Speeds,
    guess: Guess,
) -> Chosen | None:
    """Choose poses and find a short closed tour through them, base, shoulder and elbow at rest.

    Parameters
    ----------
    q_rad : array_like, shape (6,)
        Present joint angles; another posture of joints 1 to 3 is used if it lowers the predicted error.
    poses : int
        4 or more.
    half_angle_rad : float
        Between the tool axis (flange z) and straight down; pi for any orientation.

    Returns
    -------
    Chosen or None
        None if too few poses are reachable, or if they are not informative enough to estimate everything.
    """
    q_now = np.asarray(q_rad, dtype=np.float64)
    lumps = certifier.arm.travel_m[:, 5].any()
    spins, directions = (SPINS_OF_A_LUMP, DIRECTIONS_OF_A_LUMP) if lumps else (SPINS, DIRECTIONS)
    candidates = cone_candidates(half_angle_rad, spins, directions, certifier.scene.down_base)
    ideal = predicted_sigma(candidates[choose(candidates, poses, guess)], guess).force_rms_N
    best = _at(certifier, q_now, candidates, spins, poses, speeds, guess, ideal)
    if best is None or best.force_rms_N > NEARLY * ideal:
        for posture in _others(certifier, q_now, candidates):
            found = _at(certifier, np.array([*posture, *q_now[3:]]), candidates, spins, poses, speeds, guess, ideal)
            if found is not None and (best is None or found.force_rms_N * NEARLY < best.force_rms_N):
                best = Chosen(found.numbers, found.q_rad, found.force_rms_N, ideal, elsewhere=True)
    return best


def _at(
    certifier: Certifier,
    q_now: Array,
    candidates: Array,
    spins: int,
    poses: int,
    speeds: Speeds,
    guess: Guess,
    ideal: float,
) -> Chosen | None:
    """Choose the most informative of the poses that are reachable at this posture."""

    def choice(reached: Nodes) -> Nodes:
        return reached[choose(candidates[reached], poses, guess)]

    for numbers, q in _tours_at(certifier, q_now, candidates, spins, poses, choice, speeds):
        rms = predicted_sigma(certifier.arm.frames(q).R_base_flange, guess).force_rms_N
        if np.isfinite(rms):  # else these poses leave a parameter unobservable
            return Chosen(numbers, q, rms, ideal, elsewhere=False)
    return None


def verification_tour(
    certifier: Certifier, q_rad: ArrayLike, poses: int, R_fitted: Array, speeds: Speeds
) -> tuple[tuple[int, ...], Array] | None:
    """Choose poses far from those of a calibration, and find a short closed tour through them.

    Parameters
    ----------
    q_rad : array_like, shape (6,)
        Present joint angles; joints 1 to 3 move only if the wrist alone has no such tour here.
    poses : int
        2 or more.
    R_fitted : array, shape (k, 3, 3)
        Orientations R_base_flange of the calibration.

    Returns
    -------
    numbers : tuple of int
        From 101 on, in the order of choice.
    q_rad : array, shape (n, 6)
        In the order of travel. None instead of both if too few poses are reachable.
    """
    q_now = np.asarray(q_rad, dtype=np.float64)
    directions = max(DIRECTIONS_OF_A_LUMP, poses // 2)
    candidates = cone_candidates(np.pi, SPINS_OF_A_LUMP, directions, certifier.scene.down_base)

    def far_from_fitted(reached: Nodes) -> Nodes:
        down_base = certifier.scene.down_base
        return reached[
            choose_verification_poses(candidates[reached], R_fitted, poses, gravity_direction_base=down_base)
        ]

    return _first_tour(certifier, q_now, candidates, SPINS_OF_A_LUMP, poses, far_from_fitted, speeds)


def tour_of_sets(
    certifier: Certifier, q_rad: ArrayLike, kinds: Sequence[tuple[Array, int]], speeds: Speeds
) -> tuple[Nodes, Array] | None:
    """Find a short closed tour through a number of orientations of each of several kinds.

    Parameters
    ----------
    q_rad : array_like, shape (6,)
        As of `verification_tour`.
    kinds : sequence of (array of shape (m, 3, 3), int)
        Orientations R_base_flange, and how many of them are wanted: the first ones that are reachable.

    Returns
    -------
    index : int array, shape (n,)
        In the order of travel: the place among the wanted orientations, counted through all kinds.
    q_rad : array, shape (n, 6)
        None instead of both if too few poses of a kind are reachable.
    """
    kind = np.repeat(np.arange(len(kinds)), [len(R) for R, _ in kinds])
    wanted = [count for _, count in kinds]

    def first_of_each(reached: Nodes) -> Nodes:
        return np.concatenate([reached[kind[reached] == k][:count] for k, count in enumerate(wanted)])

    candidates = np.concatenate([R for R, _ in kinds])
    q_now = np.asarray(q_rad, dtype=np.float64)
    found = _first_tour(certifier, q_now, candidates, 1, sum(wanted), first_of_each, speeds)
    return None if found is None else (np.array(found[0]) - FIRST_NUMBER, found[1])


def _first_tour(
    certifier: Certifier,
    q_now: Array,
    candidates: Array,
    spins: int,
    poses: int,
    choice: Callable[[Nodes], Nodes],
    speeds: Speeds,
) -> tuple[tuple[int, ...], Array] | None:
    """Return the first tour of `_tours_at`, with joints 1 to 3 as they stand or at a posture with more room."""

    def tours(q: Array) -> Iterator[tuple[tuple[int, ...], Array]]:
        return _tours_at(certifier, q, candidates, spins, poses, choice, speeds)

    if (here := next(tours(q_now), None)) is not None:
        return here
    others = (np.array([*posture, *q_now[3:]]) for posture in _others(certifier, q_now, candidates))
    return next((tour for q in others for tour in tours(q)), None)


def _tours_at(
    certifier: Certifier,
    q_now: Array,
    candidates: Array,
    spins: int,
    poses: int,
    choice: Callable[[Nodes], Nodes],
    speeds: Speeds,
) -> Iterator[tuple[tuple[int, ...], Array]]:
    """Yield tours of chosen candidates that are reachable at this posture and connected by clear moves.

    Each is given as numbers from 101 on, in the order of choice, and joint vectors (n, 6) in the order of travel.
    `choice` gets the indices of the reachable candidates and returns `poses` of them.
    """
    q, group = wrist_nodes(certifier, q_now, candidates)
    if not len(q):
        return
    part = connected(certifier, q, group % spins)
    reached = [np.unique(group[part == p]) for p in range(part.max() + 1)]
    here = _begins_here(certifier, q_now, q, part)
    # The same orientations a whole turn of wrist 2 away are another part, with no approach: the arm is in between.
    for p in sorted(range(len(reached)), key=lambda p: (not here[p], -len(reached[p])))[:MOST_PARTS]:
        if len(reached[p]) < poses:
            break
        chosen = choice(reached[p])
        if len(chosen) < poses:
            continue
        nodes = np.flatnonzero((part == p) & np.isin(group, chosen))
        place = np.full(len(candidates), -1)
        place[chosen] = np.arange(poses)
        order = clear_tour(certifier, q[nodes], place[group[nodes]], speeds)
        if order is not None:
            nodes = nodes[order]
            yield tuple((FIRST_NUMBER + place[group[nodes]]).tolist()), q[nodes]


def _begins_here(certifier: Certifier, q_now: Array, q_rad: Array, part: Nodes) -> list[bool]:
    """Return for each part whether a straight move from the present joint angles leads into it."""
    near = np.argsort(np.abs(q_rad - q_now).max(axis=1), kind="stable")
    ends = [near[part[near] == p][:FROM_HERE] for p in range(part.max() + 1)]
    goals = q_rad[np.concatenate(ends)]
    clear = certifier.certify(np.tile(q_now, (len(goals), 1)), goals, tight=False).clear
    return [bool(one.any()) for one in np.split(clear, np.cumsum([len(end) for end in ends])[:-1])]


def _others(certifier: Certifier, q_now: Array, candidates: Array) -> Array:
    """Postures (k, 3) of joints 1 to 3 that reach the most tool directions."""
    postures = grid(certifier, q_now, POSTURE_STEP_DEG)
    looks = candidates[np.linspace(0, len(candidates) - 1, LOOKS).astype(int)]
    q = np.array([wrist_inverse(certifier.arm.kinematics, posture, looks) for posture in postures])  # (m, LOOKS, 2, 6)
    free = certifier.free(q.reshape(-1, 6)).reshape(q.shape[:3]).any(axis=2)
    return np.asarray(postures[np.argsort(-free.sum(axis=1), kind="stable")][:OTHER_POSTURES])
