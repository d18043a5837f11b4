"""A tour of chosen poses that the wrist reaches: the most informative ones, or those far from a calibration's.

Informative poses follow the design of `ftcalib.poses.selection`, which keeps the second solution away and the gravity
directions out of one plane.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import ArrayLike

from ftcalib.poses.information import Guess, predicted_sigma
from ftcalib.poses.selection import choose, choose_verification_poses, cone_candidates, tilted_candidates
from ftdrive.planning.geometry.certify import Certificate, Certifier
from ftdrive.planning.geometry.kinematics import wrist_inverse
from ftdrive.planning.motion import Speeds
from ftdrive.planning.search.nodes import Nodes, grid, hung_nodes, wrist_nodes
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
# Tilts of the tool with a load on a string, and how many azimuths each has.
HUNG_TILTS_DEG, HUNG_AZIMUTHS = (75, 60, 45), 24
# Azimuths of each tilt that compare places of the hook, and how many places are tried.
LOOKS_OF_A_TILT, MOST_HOOKS = 8, 4
# How far the hook may be from its place between two tilts; the first that has a tour.
HOOK_M = (0.03, 0.06)


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
    """Choose four poses or more and find a short closed tour through them, base, shoulder and elbow at rest.

    Another posture of joints 1 to 3 than that of `q_rad` is used if it lowers the predicted error. The tool axis
    (flange z) stays within an angle of straight down. None if too few poses are reachable, or if they are not
    informative enough to estimate everything.
    """
    q_now = np.asarray(q_rad, dtype=np.float64)
    lumps = certifier.arm.travel_m[:, 5].any()
    spins, directions = (SPINS_OF_A_LUMP, DIRECTIONS_OF_A_LUMP) if lumps else (SPINS, DIRECTIONS)
    candidates = cone_candidates(half_angle_rad, spins, directions, certifier.scene.down_base)
    ideal = predicted_sigma(candidates[choose(candidates, poses, guess)], guess).force_rms_N
    best = _clear_candidates(certifier, q_now, candidates, spins, poses, speeds, guess, ideal)
    if best is None or best.force_rms_N > NEARLY * ideal:
        for posture in _others(certifier, q_now, candidates):
            found = _clear_candidates(
                certifier, np.array([*posture, *q_now[3:]]), candidates, spins, poses, speeds, guess, ideal
            )
            if found is not None and (best is None or found.force_rms_N * NEARLY < best.force_rms_N):
                best = Chosen(found.numbers, found.q_rad, found.force_rms_N, ideal, elsewhere=True)
    return best


def _clear_candidates(
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
    """Choose two poses or more far from those of a calibration, `R_fitted` (k, 3, 3), and find a short closed tour.

    Joints 1 to 3 move only if the wrist alone has no such tour here. Returns numbers, from 101 on in the order of
    choice, and joint angles (n, 6) in the order of travel; None if too few poses are reachable.
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

    Each kind has orientations (m, 3, 3) and how many of them are wanted: the first ones that are reachable. Returns,
    in the order of travel, the places among the wanted orientations, counted through all kinds, and joint angles
    (n, 6); None if too few poses of a kind are reachable.
    """
    kind = np.repeat(np.arange(len(kinds)), [len(R) for R, _ in kinds])
    wanted = [count for _, count in kinds]

    def first_of_each(reached: Nodes) -> Nodes:
        return np.concatenate([reached[kind[reached] == k][:count] for k, count in enumerate(wanted)])

    candidates = np.concatenate([R for R, _ in kinds])
    q_now = np.asarray(q_rad, dtype=np.float64)
    found = _first_tour(certifier, q_now, candidates, 1, sum(wanted), first_of_each, speeds)
    return None if found is None else (np.array(found[0]) - FIRST_NUMBER, found[1])


def hung_tour(
    certifier: Certifier, q_rad: ArrayLike, poses: int, speeds: Speeds
) -> tuple[tuple[int, ...], Array, Array] | None:
    """Choose tilts with a load on a string, spread evenly about straight down, and find a short closed tour.

    The hook stays at one point at each of them: nearest to where it is, with the tool turned least. Returns numbers,
    from 101 on in the order of choice, joint angles (n, 6) in the order of travel, and the hook (3,) in base; None if
    too few poses are reachable.
    """
    q_now, down = np.asarray(q_rad, dtype=np.float64), certifier.scene.down_base
    hooks = _hooks(certifier, q_now)
    for kept, (hook_m, heading_rad) in product((_HookKept(certifier, most_m) for most_m in HOOK_M), hooks):
        candidates = tilted_candidates(np.radians(HUNG_TILTS_DEG), HUNG_AZIMUTHS, heading_rad, down)
        q, group = hung_nodes(certifier, q_now, candidates, hook_m)
        part = connected(kept, q, np.zeros(len(q), dtype=np.intp))
        best = max(range(part.max() + 1), key=lambda p: len(np.unique(group[part == p])))
        reached = np.unique(group[part == best])
        if len(reached) < poses:
            continue
        chosen = reached[_evenly_spread(down @ candidates[reached], poses)]
        inside = part == best
        if (tour := _tour_through(kept, q[inside], group[inside], chosen, speeds)) is not None:
            return *tour, hook_m
    return None


class _HookKept(Certifier):
    """Proves only moves in which the hook of the load stays within a distance of where it is."""

    def __init__(self, certifier: Certifier, most_m: float) -> None:
        super().__init__(certifier.arm, certifier.scene, certifier.margins)
        self._most_m = most_m

    def certify(self, start_rad: ArrayLike, end_rad: ArrayLike, *, tight: bool = True) -> Certificate:
        """As `Certifier.certify`; a move that takes the hook along is not clear."""
        start, end = (np.asarray(q, dtype=np.float64).reshape(-1, 6) for q in (start_rad, end_rad))
        hooks_m = [self.arm.hook_m(self.arm.frames(start + share * (end - start))) for share in np.linspace(0, 1, 9)]
        stays = np.linalg.norm(np.subtract(hooks_m, hooks_m[0]), axis=2).max(axis=0) <= self._most_m
        certificate = super().certify(start, np.where(stays[:, None], end, start), tight=tight)
        return replace(certificate, clear=certificate.clear & stays)


def _hooks(certifier: Certifier, q_now: Array) -> list[tuple[Array, float]]:
    """Places of the hook (3,) that reach the most tilts, each with turns about the tool axis (rad), to be tried."""
    down, at = certifier.scene.down_base, certifier.arm.frames(q_now)
    present_rad = _heading(at.R_base_flange[0], down)
    looks = tilted_candidates(np.radians(HUNG_TILTS_DEG), LOOKS_OF_A_TILT, present_rad, down)
    places = certifier.arm.hook_m(at)[0] + _away(certifier, at.wrist_m[0])
    reached = np.array([len(np.unique(hung_nodes(certifier, q_now, looks, place)[1])) for place in places])
    best = np.argsort(-reached, kind="stable")[:MOST_HOOKS]
    return [(places[i], present_rad + turn) for i in best if reached[i] for turn in np.radians([0, 90, -90, 180])]


def _heading(R_base_flange: Array, down_base: Array) -> float:
    """Turn about the tool axis of `tilted_candidates` that is nearest to an orientation (3, 3)."""
    straight = tilted_candidates([0.0], 1, 0.0, down_base)[0]
    turn = straight.T @ R_base_flange
    # The tool is turned about -z there, seen along its axis.
    return float(np.arctan2(turn[0, 1] - turn[1, 0], turn[0, 0] + turn[1, 1]))


def _away(certifier: Certifier, wrist_m: Array) -> Array:
    """Shifts (k, 3) of the hook from where it is, the nearest first: up and down, towards the base and away from it."""
    down = certifier.scene.down_base
    outwards = wrist_m - wrist_m @ down * down
    outwards /= max(float(np.linalg.norm(outwards)), 1e-9)
    step_m = np.abs(certifier.arm.kinematics.links_m[1:3, 0]).sum() / 8
    up_m, out_m = step_m * np.arange(-9, 4), step_m * np.arange(-3, 5)
    shifts = (up_m[:, None, None] * -down + out_m[None, :, None] * outwards).reshape(-1, 3)
    return np.asarray(shifts[np.argsort(np.linalg.norm(shifts, axis=1), kind="stable")])


def _evenly_spread(directions: Array, count: int) -> Nodes:
    """Indices of directions (m, 3), each as far as possible from those before it, from the first on."""
    chosen = [0]
    while len(chosen) < count:
        nearest = (directions @ directions[chosen].T).max(axis=1)
        nearest[chosen] = np.inf
        chosen.append(int(nearest.argmin()))
    return np.array(chosen)


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
        if (tour := _tour_through(certifier, q[part == p], group[part == p], chosen, speeds)) is not None:
            yield tour


def _tour_through(
    certifier: Certifier, q: Array, group: Nodes, chosen: Nodes, speeds: Speeds
) -> tuple[tuple[int, ...], Array] | None:
    """Find a short closed tour through one of the joint vectors q (n, 6) of each chosen orientation.

    `group` (n,) has the orientation of each. The tour is given as numbers from 101 on, in the order of `chosen`, and
    joint vectors in the order of travel.
    """
    nodes = np.flatnonzero(np.isin(group, chosen))
    place = np.full(group.max() + 1, -1)
    place[chosen] = np.arange(len(chosen))
    order = clear_tour(certifier, q[nodes], place[group[nodes]], speeds)
    if order is None:
        return None
    return tuple((FIRST_NUMBER + place[group[nodes[order]]]).tolist()), q[nodes[order]]


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
