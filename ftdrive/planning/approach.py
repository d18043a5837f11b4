"""The way from where the arm stands to the first pose: a straight joint move if it is clear, else through via-poses.

Via-poses come from a roadmap that is proven lazily (Bohlin and Kavraki, Path planning using lazy PRM, ICRA 2000): the
shortest way through free poses is found first, its moves are judged, and those not clear are taken off the map. All
of it is deterministic.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse.csgraph import dijkstra

from drivers.ur.kinematics import Array
from ftdrive.errors import PlanRefused
from ftdrive.planning.geometry.certify import Certificate, Certifier
from ftdrive.planning.geometry.kinematics import checked_joints
from ftdrive.planning.motion import Speeds, move_duration_s, speed_of_leading_joint
from ftdrive.planning.search.nodes import ELBOW_RAD

NEAR_RAD = float(np.radians(30))
"""A person jogs every joint so near to the first pose where the way is not proven, then lets a program take over."""
ROOM_RAD = np.radians([120.0, 90.0, 100.0, 120.0, 120.0, 0.0])
"""How far via-poses may lie beyond what start and end span. Joint 6 needs no detour."""
AT_RAD = 1e-3
"""An arm so near to the first pose stands there."""
STILL_RAD = float(np.radians(0.5))
"""A joint that turns less does not count as moving: no part of any arm moves by 20 mm."""
NODES = 240
NEIGHBOURS = 16
ROUNDS = 80
"""Of proving; the roadmap is given up afterwards, after about a second."""


@dataclass(frozen=True, slots=True, eq=False)
class Approach:
    """k moves, one after the other; the last ends at the first pose. None where the arm stands there already."""

    way_rad: Array
    """(k + 1, 6) from where the arm stands to the first pose; (0, 6) without a move."""
    speed_rad_s: Array
    """(k,) of the leading joint of each move."""
    certified: bool
    """Every move is proven clear. Always so when made by `plan_approach`."""
    clearance_m: float
    """Lower bound of the distance to anything, over all moves."""
    limited_by: str
    """The two bodies that come closest to their margin."""

    @property
    def q_rad(self) -> Array:
        """(k, 6) where each move ends."""
        return self.way_rad[1:]


def arm_moves(way_rad: ArrayLike) -> bool:
    """Tell whether base, shoulder or elbow turn along a way (n, 6)."""
    way = np.asarray(way_rad)
    return len(way) > 0 and bool(np.ptp(way[:, :3], axis=0).max() >= STILL_RAD)


def plan_approach(certifier: Certifier, q_now: ArrayLike, q_first: ArrayLike, speeds: Speeds) -> Approach:
    """Plan the way to the first pose of a tour.

    Parameters
    ----------
    certifier : Certifier
    q_now : array_like, shape (6,)
        Where the arm stands. Joints are taken as they are told, within one turn of zero: a way never crosses a limit.
    q_first : array_like, shape (6,)
        First pose of the tour.
    speeds : Speeds

    Returns
    -------
    Approach

    Raises
    ------
    PlanRefused
        No way was proven clear: where to jog the arm is said.
    """
    if np.abs(np.subtract(q_now, q_first)).max() < AT_RAD:
        return Approach(np.zeros((0, 6)), np.zeros(0), certified=True, clearance_m=np.inf, limited_by="")
    now, first = checked_joints(q_now), checked_joints(q_first)
    if certifier.certify(now, first, tight=False).clear[0]:
        return _approach(certifier, now, first[None], speeds)
    stands = certifier.certify(now, now)
    if not stands.clear[0]:
        raise PlanRefused(_too_near(certifier, stands) + _where_to_jog(first))
    if not certifier.free(first)[0]:
        raise PlanRefused("the first pose of the plan is not clear here: make a new plan with `ftdrive plan`")
    path = _through_roadmap(certifier, now, first, speeds)
    if path is None:
        raise PlanRefused("no way from where the arm stands to the first pose is proven clear: " + _where_to_jog(first))
    return _approach(certifier, now, path, speeds)


def _approach(certifier: Certifier, now: Array, path: Array, speeds: Speeds) -> Approach:
    way = np.vstack([now, path])
    certificate = certifier.certify(way[:-1], path)
    nearest = int(np.argmin(certificate.clearance_m))
    return Approach(
        way,
        speed_of_leading_joint(certifier.arm, way[:-1], path, speeds),
        bool(certificate.clear.all()),
        float(certificate.clearance_m[nearest]),
        certificate.limited_by[nearest],
    )


def _through_roadmap(certifier: Certifier, now: Array, first: Array, speeds: Speeds) -> Array | None:
    """Via-poses and the first pose (k, 6); None where no way was proven."""
    nodes = _nodes(certifier, now, first)
    turn = np.abs(nodes[:, None] - nodes)
    cost = move_duration_s(turn.max(axis=2), speeds.joint_rad_s, speeds.joint_rad_s2) + 0.05 * turn.sum(axis=2)
    near = np.argsort(cost, axis=1, kind="stable")[:, 1 : NEIGHBOURS + 1]
    possible = np.zeros(cost.shape, dtype=np.bool_)
    possible[np.arange(len(nodes))[:, None], near] = True
    possible[:2] = True  # both ends see every node
    possible |= possible.T
    possible[0, 1] = possible[1, 0] = False
    np.fill_diagonal(possible, val=False)
    proven = np.zeros_like(possible)
    for _ in range(ROUNDS):
        # Two shortest-path trees give the best way through every node: a whole batch is judged at once.
        distance, before = dijkstra(
            np.where(possible, cost, 0.0), directed=False, indices=[0, 1], return_predecessors=True
        )
        if not np.isfinite(distance[0, 1]):
            return None
        path = _walk(before[0], 1)[::-1]
        if all(proven[i, j] for i, j in pairwise(path)):
            return nodes[path[1:]]
        through = np.argsort(distance.sum(axis=0), kind="stable")[:6]
        moves = {
            (min(i, j), max(i, j))
            for node in through
            for way in (_walk(before[0], int(node)), _walk(before[1], int(node)))
            for i, j in pairwise(way)
            if not proven[i, j]
        }
        start, end = np.array(sorted(moves)).T
        clear = certifier.certify(nodes[start], nodes[end], tight=False).clear
        for i, j, is_clear in zip(start, end, clear, strict=True):
            possible[i, j] = possible[j, i] = is_clear
            proven[i, j] = proven[j, i] = is_clear
    return None


def _nodes(certifier: Certifier, now: Array, first: Array) -> Array:
    """Both ends, the corners of the box they span, and random poses in a larger one; all free."""
    corner = (np.arange(1, 63)[:, None] >> np.arange(6)) % 2 == 1
    limit = np.full(6, 2 * np.pi)
    limit[2] = max(ELBOW_RAD, abs(now[2]), abs(first[2]))
    low = np.maximum(np.minimum(now, first) - ROOM_RAD, -limit)
    high = np.minimum(np.maximum(now, first) + ROOM_RAD, limit)
    spread = np.random.default_rng(0).uniform(low, high, (3 * NODES, 6))
    via = np.unique(np.vstack([np.where(corner, now, first), spread]), axis=0)
    # Both ends may be given to the same digit in some joints: corners then fall together, or onto an end.
    via = via[(via != now).any(axis=1) & (via != first).any(axis=1)]
    away = np.maximum(np.abs(via - now), np.abs(via - first)).max(axis=1)
    via = via[np.argsort(away, kind="stable")]
    return np.vstack([now, first, via[certifier.free(via)][:NODES]])


def _walk(before: NDArray[np.int32], node: int) -> list[int]:
    """Nodes from one back to the root of its tree; only itself where it is not reached."""
    way = [node]
    while before[way[-1]] >= 0:
        way.append(int(before[way[-1]]))
    return way


def _too_near(certifier: Certifier, stands: Certificate) -> str:
    found, margins = stands.limited_by[0], certifier.margins
    within = stands.self_clearance_m[0] - margins.self_m < stands.scene_clearance_m[0] - margins.scene_m
    distance, margin = (
        (stands.self_clearance_m[0], margins.self_m) if within else (stands.scene_clearance_m[0], margins.scene_m)
    )
    return (
        f"where the arm stands it is {1e3 * max(distance, 0.0):.0f} mm from contact ({found}), "
        f"less than the margin of {1e3 * margin:.0f} mm: "
    )


def _where_to_jog(first: Array) -> str:
    angles = ", ".join(f"{angle:.0f}" for angle in np.degrees(first))
    return f"jog the arm to within {np.degrees(NEAR_RAD):.0f} degrees of joints {angles}, then start again"
