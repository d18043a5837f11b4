"""Tours of chosen poses: the most informative poses, poses far from those of a calibration, sets, or load tilts.

Informative poses are chosen by `ftcalib.poses.selection`, which excludes a second solution and gravity directions in
one plane.
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

# Candidate orientations: number of tool directions, and number of turns about the tool axis for each direction.
DIRECTIONS, SPINS = 150, 8
# The same for a tool that is not round about the axis of joint 6: fewer, as each turn needs its own collision check.
DIRECTIONS_OF_A_LUMP, SPINS_OF_A_LUMP = 60, 4
# Free joint space may fall into disconnected parts; a tour is searched in at most this many of them.
MOST_PARTS = 2
# A straight move is tried to this many of the nearest joint vectors in each connected part of free joint space.
FROM_HERE = 6
# No other posture is tried if the predicted error is within this factor of that of the best poses, reachable or not.
NEARLY = 1.05
OTHER_POSTURES = 2
POSTURE_STEP_DEG = 20
# Number of the first chosen pose; 1 to 24 are those of the paper.
FIRST_NUMBER = 101
# Postures of joints 1 to 3 are compared by how many of this number of tool directions they reach.
LOOKS = 24
# Tilts of the tool with a load on a string, degrees from straight down, and number of azimuths at each tilt.
HUNG_TILTS_DEG, HUNG_AZIMUTHS = (75, 60, 45), 24
# Number of azimuths at each tilt by which hook positions are compared, and number of hook positions that are tried.
LOOKS_OF_A_TILT, MOST_HOOKS = 8, 4
# Largest displacement of a load's hook, m, in a move between two tilts; the first value that yields a tour is used.
HOOK_M = (0.03, 0.06)


@dataclass(frozen=True, slots=True, eq=False)
class Chosen:
    """A tour of chosen poses, in the order of travel."""

    numbers: tuple[int, ...]
    """Numbers of the poses, from 101 in the order of choice; 1 to 24 are the special orientations."""
    q_rad: Array
    """(n, 6) joint vectors."""
    force_rms_N: float
    """Predicted RMS error of force compensation."""
    ideal_force_rms_N: float
    """Predicted RMS error of the best poses if every pose were reachable."""
    elsewhere: bool
    """Whether joints 1 to 3 differ from the current posture."""


def chosen_tour(
    certifier: Certifier,
    q_rad: ArrayLike,
    poses: int,
    half_angle_rad: float,
    speeds: Speeds,
    guess: Guess,
) -> Chosen | None:
    """Return a short closed tour through four or more chosen poses, with base, shoulder and elbow at rest.

    The posture of joints 1 to 3 differs from `q_rad` if that lowers the predicted error. The tool axis (flange z) stays
    within `half_angle_rad` of straight down. None if too few poses are reachable, or if they are not informative enough
    to estimate all parameters.
    """
    q_now = np.asarray(q_rad, dtype=np.float64)
    lumps = certifier.arm.travel_m[:, 5].any()
    spins, directions = (SPINS_OF_A_LUMP, DIRECTIONS_OF_A_LUMP) if lumps else (SPINS, DIRECTIONS)
    candidates = cone_candidates(half_angle_rad, spins, directions, certifier.scene.down_base)
    ideal = predicted_sigma(candidates[choose(candidates, poses, guess)], guess).force_rms_N
    best = _clear_candidates(certifier, q_now, candidates, spins, poses, speeds, guess, ideal)
    if best is None or best.force_rms_N > NEARLY * ideal:
        for posture in _others(certifier, q_now, candidates):
            candidate = _clear_candidates(
                certifier, np.array([*posture, *q_now[3:]]), candidates, spins, poses, speeds, guess, ideal
            )
            if candidate is not None and (best is None or candidate.force_rms_N * NEARLY < best.force_rms_N):
                best = Chosen(candidate.numbers, candidate.q_rad, candidate.force_rms_N, ideal, elsewhere=True)
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
    """Return a tour of the most informative poses that are reachable at this posture; None if there is none."""

    def choice(reached: Nodes) -> Nodes:
        return reached[choose(candidates[reached], poses, guess)]

    for numbers, q in _tours_at(certifier, q_now, candidates, spins, poses, choice, speeds):
        rms = predicted_sigma(certifier.arm.frames(q).R_base_flange, guess).force_rms_N
        if np.isfinite(rms):  # infinite if a parameter is not observable
            return Chosen(numbers, q, rms, ideal, elsewhere=False)
    return None


def verification_tour(
    certifier: Certifier, q_rad: ArrayLike, poses: int, R_fitted: Array, speeds: Speeds
) -> tuple[tuple[int, ...], Array] | None:
    """Return a short closed tour through two or more poses far from `R_fitted` (k, 3, 3), the poses of a calibration.

    Joints 1 to 3 move only if the wrist alone has no such tour. Returns numbers from 101, in the order of choice, and
    joint vectors (n, 6) in the order of travel; None if too few poses are reachable.
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
    """Return a short closed tour through orientations of several kinds.

    Each kind has orientations (m, 3, 3) and a number; the tour has the first reachable ones up to this number.
    Returns, in the order of travel, the indices of the selected orientations over all kinds, and joint vectors (n, 6).
    None if too few poses of a kind are reachable.
    """
    kind = np.repeat(np.arange(len(kinds)), [len(R) for R, _ in kinds])
    wanted = [count for _, count in kinds]

    def first_of_each(reached: Nodes) -> Nodes:
        return np.concatenate([reached[kind[reached] == k][:count] for k, count in enumerate(wanted)])

    candidates = np.concatenate([R for R, _ in kinds])
    q_now = np.asarray(q_rad, dtype=np.float64)
    tour = _first_tour(certifier, q_now, candidates, 1, sum(wanted), first_of_each, speeds)
    return None if tour is None else (np.array(tour[0]) - FIRST_NUMBER, tour[1])


def hung_tour(
    certifier: Certifier, q_rad: ArrayLike, poses: int, speeds: Speeds
) -> tuple[tuple[int, ...], Array, Array] | None:
    """Return a short closed tour through tilts with a load on a string, spread evenly about straight down.

    The hook is at the same point in all tilts, near its current position, and the tool is turned little. Returns
    numbers from 101, in the order of choice, joint vectors (n, 6) in the order of travel, and the hook (3,) in base, m;
    None if too few poses are reachable.
    """
    q_now, down = np.asarray(q_rad, dtype=np.float64), certifier.scene.down_base
    hooks = _hooks(certifier, q_now)
    for steady, (hook_m, heading_rad) in product((_SteadyHook(certifier, most_m) for most_m in HOOK_M), hooks):
        candidates = tilted_candidates(np.radians(HUNG_TILTS_DEG), HUNG_AZIMUTHS, heading_rad, down)
        q, group = hung_nodes(certifier, q_now, candidates, hook_m)
        part = connected(steady, q, np.zeros(len(q), dtype=np.intp))
        best = max(range(part.max() + 1), key=lambda p: len(np.unique(group[part == p])))
        reached = np.unique(group[part == best])
        if len(reached) < poses:
            continue
        chosen = reached[_evenly_spread(down @ candidates[reached], poses)]
        inside = part == best
        if (tour := _tour_through(steady, q[inside], group[inside], chosen, speeds)) is not None:
            return *tour, hook_m
    return None


class _SteadyHook(Certifier):
    """Certifier that accepts only moves in which the hook of a hanging load stays within `most_m` of its start."""

    def __init__(self, certifier: Certifier, most_m: float) -> None:
        super().__init__(certifier.arm, certifier.scene, certifier.margins)
        self._most_m = most_m

    def certify(self, start_rad: ArrayLike, end_rad: ArrayLike, *, tight: bool = True) -> Certificate:
        """Certify like `Certifier.certify`, but a move that displaces the hook too far counts as not clear."""
        start, end = (np.asarray(q, dtype=np.float64).reshape(-1, 6) for q in (start_rad, end_rad))
        hooks_m = [self.arm.hook_m(self.arm.frames(start + share * (end - start))) for share in np.linspace(0, 1, 9)]
        stays = np.linalg.norm(np.subtract(hooks_m, hooks_m[0]), axis=2).max(axis=0) <= self._most_m
        certificate = super().certify(start, np.where(stays[:, None], end, start), tight=tight)
        return replace(certificate, clear=certificate.clear & stays)


def _hooks(certifier: Certifier, q_now: Array) -> list[tuple[Array, float]]:
    """Return pairs: a hook position (3,), m, where many tilts are reachable, and a turn about the tool axis, rad."""
    down, at = certifier.scene.down_base, certifier.arm.frames(q_now)
    present_rad = _heading(at.R_base_flange[0], down)
    looks = tilted_candidates(np.radians(HUNG_TILTS_DEG), LOOKS_OF_A_TILT, present_rad, down)
    places = certifier.arm.hook_m(at)[0] + _away(certifier, at.wrist_m[0])
    reached = np.array([len(np.unique(hung_nodes(certifier, q_now, looks, place)[1])) for place in places])
    best = np.argsort(-reached, kind="stable")[:MOST_HOOKS]
    return [(places[i], present_rad + turn) for i in best if reached[i] for turn in np.radians([0, 90, -90, 180])]


def _heading(R_base_flange: Array, down_base: Array) -> float:
    """Return the turn about the tool axis, rad, with which `tilted_candidates` comes nearest to this orientation."""
    straight = tilted_candidates([0.0], 1, 0.0, down_base)[0]
    turn = straight.T @ R_base_flange
    # `tilted_candidates` turns the tool about its -z axis.
    return float(np.arctan2(turn[0, 1] - turn[1, 0], turn[0, 0] + turn[1, 1]))


def _away(certifier: Certifier, wrist_m: Array) -> Array:
    """Return shifts (k, 3) of the hook to try, m, smallest first: up and down, towards the base and away from it."""
    down = certifier.scene.down_base
    outwards = wrist_m - wrist_m @ down * down
    outwards /= max(float(np.linalg.norm(outwards)), 1e-9)
    step_m = np.abs(certifier.arm.kinematics.links_m[1:3, 0]).sum() / 8
    up_m, out_m = step_m * np.arange(-9, 4), step_m * np.arange(-3, 5)
    shifts = (up_m[:, None, None] * -down + out_m[None, :, None] * outwards).reshape(-1, 3)
    return np.asarray(shifts[np.argsort(np.linalg.norm(shifts, axis=1), kind="stable")])


def _evenly_spread(directions: Array, count: int) -> Nodes:
    """Return indices of directions (m, 3), beginning with the first, each as far as possible from those before it."""
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
    """Return the first tour that `_tours_at` finds with joints 1 to 3 as now, or else at a posture with more room."""

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

    A tour has numbers from 101, in the order of choice, and joint vectors (n, 6) in the order of travel. `choice`
    receives the indices of the reachable candidates and returns `poses` of them.
    """
    q, group = wrist_nodes(certifier, q_now, candidates)
    if not len(q):
        return
    part = connected(certifier, q, group % spins)
    reached = [np.unique(group[part == p]) for p in range(part.max() + 1)]
    here = _begins_here(certifier, q_now, q, part)
    # Joint vectors with wrist 2 turned by 360° form a separate part, which no collision-free approach reaches.
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
    """Return a short closed tour through one of the joint vectors q (n, 6) of each chosen orientation.

    `group` (n,) has the orientation of each joint vector. The tour has numbers from 101, in the order of `chosen`, and
    joint vectors in the order of travel; None if there is no tour.
    """
    nodes = np.flatnonzero(np.isin(group, chosen))
    place = np.full(group.max() + 1, -1)
    place[chosen] = np.arange(len(chosen))
    order = clear_tour(certifier, q[nodes], place[group[nodes]], speeds)
    if order is None:
        return None
    return tuple((FIRST_NUMBER + place[group[nodes[order]]]).tolist()), q[nodes[order]]


def _begins_here(certifier: Certifier, q_now: Array, q_rad: Array, part: Nodes) -> list[bool]:
    """Return for each connected part of free joint space whether a clear straight move from `q_now` leads into it."""
    near = np.argsort(np.abs(q_rad - q_now).max(axis=1), kind="stable")
    ends = [near[part[near] == p][:FROM_HERE] for p in range(part.max() + 1)]
    goals = q_rad[np.concatenate(ends)]
    clear = certifier.certify(np.tile(q_now, (len(goals), 1)), goals, tight=False).clear
    return [bool(one.any()) for one in np.split(clear, np.cumsum([len(end) for end in ends])[:-1])]


def _others(certifier: Certifier, q_now: Array, candidates: Array) -> Array:
    """Return those postures (k, 3) of joints 1 to 3 on a grid that reach the most tool directions."""
    postures = grid(certifier, q_now, POSTURE_STEP_DEG)
    looks = candidates[np.linspace(0, len(candidates) - 1, LOOKS).astype(int)]
    q = np.array([wrist_inverse(certifier.arm.kinematics, posture, looks) for posture in postures])  # (m, LOOKS, 2, 6)
    free = certifier.free(q.reshape(-1, 6)).reshape(q.shape[:3]).any(axis=2)
    return np.asarray(postures[np.argsort(-free.sum(axis=1), kind="stable")][:OTHER_POSTURES])
