"""The approach from the current posture to the first pose: a straight joint move if it is clear, else via poses.

Via poses come from a roadmap with lazy proofs (Bohlin and Kavraki, Path planning using lazy PRM, ICRA 2000). The
shortest path through free poses is searched first, then its moves are certified, and moves that are not clear are
removed from the roadmap. The result is deterministic.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse.csgraph import dijkstra

from ftdrive.errors import PlanRefused
from ftdrive.planning.geometry.certify import Certificate, Certifier
from ftdrive.planning.geometry.kinematics import checked_joints
from ftdrive.planning.motion import Speeds, move_duration_s, speed_of_leading_joint
from ftdrive.planning.search.nodes import ELBOW_RAD
from ftdrivers.ur.kinematics import Array

# If no approach is proven clear, the operator must jog every joint to within this angle of the first pose.
NEAR_RAD = float(np.radians(30))
# Via poses may leave each joint's range between start and goal by this much; joint 6 needs no detour.
ROOM_RAD = np.radians([120.0, 90.0, 100.0, 120.0, 120.0, 0.0])
# The arm needs no approach if every joint is within this angle, rad, of the first pose.
AT_RAD = 1e-3
NODES = 240
NEIGHBOURS = 16
# Maximum number of rounds, each of which certifies the best paths; all together take about 1 s.
ROUNDS = 80


@dataclass(frozen=True, slots=True, eq=False)
class Approach:
    """A sequence of k joint moves from the current posture to the first pose; k is 0 if the arm is already there."""

    way_rad: Array
    """Joint vectors (k + 1, 6) between the moves, from the current posture to the first pose; (0, 6) without a move."""
    speed_rad_s: Array
    """Speed (k,) in each move of the joint that turns most."""
    certified: bool
    """Whether every move is proven clear; always true for the result of `plan_approach`."""
    clearance_m: float
    """Lower bound on the smallest distance between bodies over all moves."""
    limited_by: str
    """The two bodies whose distance comes closest to the margin that it must keep."""

    @property
    def q_rad(self) -> Array:
        """Joint vectors (k, 6) at which each move ends."""
        return self.way_rad[1:]

    def duration_s(self, most_rad_s: float, acceleration_rad_s2: float) -> float:
        """Return the duration of the moves at speeds of at most `most_rad_s`, s."""
        turns = np.abs(np.diff(self.way_rad, axis=0)).max(axis=1)
        speeds = np.minimum(self.speed_rad_s, most_rad_s)
        return float(move_duration_s(turns, speeds, acceleration_rad_s2).sum())


def plan_approach(certifier: Certifier, q_now: ArrayLike, q_first: ArrayLike, speeds: Speeds) -> Approach:
    """Plan the approach to the first pose of a tour.

    Parameters
    ----------
    q_now : array_like, shape (6,)
        Current joint angles as reported, within one turn of zero, so that no move crosses a joint limit.
    q_first : array_like, shape (6,)
        First pose of the tour.

    Raises
    ------
    PlanRefused
        No approach is proven clear; the message says where to jog the arm.
    """
    if np.abs(np.subtract(q_now, q_first)).max() < AT_RAD:
        return Approach(np.zeros((0, 6)), np.zeros(0), certified=True, clearance_m=np.inf, limited_by="")
    now, first = checked_joints(q_now), checked_joints(q_first)
    if certifier.arm.hung is not None:
        speeds = speeds.limited(Speeds.with_hung_load())
    direct = certifier.certify(now, first, tight=False).clear[0]
    whole = np.vstack([now, first if direct else _around(certifier, now, first, speeds)])
    certificate = certifier.certify(whole[:-1], whole[1:])
    nearest = int(np.argmin(certificate.clearance_m))
    return Approach(
        whole,
        speed_of_leading_joint(certifier.arm, whole[:-1], whole[1:], speeds),
        bool(certificate.clear.all()),
        float(certificate.clearance_m[nearest]),
        certificate.limited_by[nearest],
    )


def _around(certifier: Certifier, now: Array, first: Array, speeds: Speeds) -> Array:
    """Return the via poses of an approach and its goal (k, 6). Raises `PlanRefused` if no path is proven clear."""
    here = certifier.certify(now, now)
    if not here.clear[0]:
        raise PlanRefused(_too_near(certifier, here) + _where_to_jog(first))
    if not certifier.free(first)[0]:
        raise PlanRefused("the first pose of the plan is not clear in this cell: make a new plan with `ftdrive plan`")
    path = _through_roadmap(certifier, now, first, speeds)
    if path is None:
        raise PlanRefused(
            "no approach from the present posture to the first pose is proven clear: " + _where_to_jog(first)
        )
    return path


def _through_roadmap(certifier: Certifier, now: Array, first: Array, speeds: Speeds) -> Array | None:
    """Return the via poses and the goal (k, 6) of the best path in a roadmap; None if no path is proven clear."""
    nodes = _nodes(certifier, now, first)
    turn = np.abs(nodes[:, None] - nodes)
    cost = move_duration_s(turn.max(axis=2), speeds.joint_rad_s, speeds.joint_rad_s2) + 0.05 * turn.sum(axis=2)
    near = np.argsort(cost, axis=1, kind="stable")[:, 1 : NEIGHBOURS + 1]
    possible = np.zeros(cost.shape, dtype=np.bool_)
    possible[np.arange(len(nodes))[:, None], near] = True
    # Start and goal are connected to every node.
    possible[:2] = True
    possible |= possible.T
    possible[0, 1] = possible[1, 0] = False
    np.fill_diagonal(possible, val=False)
    proven = np.zeros_like(possible)
    for _ in range(ROUNDS):
        # The shortest-path trees of start and goal give the best path through each node. Path batches are certified.
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
    """Return start, goal and free via poses: corners of the joint-space box between them, and random poses around."""
    corner = (np.arange(1, 63)[:, None] >> np.arange(6)) % 2 == 1
    limit = np.full(6, 2 * np.pi)
    limit[2] = max(ELBOW_RAD, abs(now[2]), abs(first[2]))
    low = np.maximum(np.minimum(now, first) - ROOM_RAD, -limit)
    high = np.minimum(np.maximum(now, first) + ROOM_RAD, limit)
    spread = np.random.default_rng(0).uniform(low, high, (3 * NODES, 6))
    via = np.unique(np.vstack([np.where(corner, now, first), spread]), axis=0)
    # If the start and the goal have equal joint angles, corners coincide with each other, with start or with goal.
    via = via[(via != now).any(axis=1) & (via != first).any(axis=1)]
    away = np.maximum(np.abs(via - now), np.abs(via - first)).max(axis=1)
    via = via[np.argsort(away, kind="stable")]
    return np.vstack([now, first, via[certifier.free(via)][:NODES]])


def _walk(before: NDArray[np.int32], node: int) -> list[int]:
    """Return the nodes from one back to the root of its tree; the node alone if the tree does not reach it."""
    way = [node]
    while before[way[-1]] >= 0:
        way.append(int(before[way[-1]]))
    return way


def _too_near(certifier: Certifier, here: Certificate) -> str:
    bodies, margins = here.limited_by[0], certifier.margins
    within = here.self_clearance_m[0] - margins.self_m < here.scene_clearance_m[0] - margins.scene_m
    distance, margin = (
        (here.self_clearance_m[0], margins.self_m) if within else (here.scene_clearance_m[0], margins.scene_m)
    )
    return (
        f"at the present posture the clearance is {1e3 * max(distance, 0.0):.0f} mm ({bodies}), "
        f"less than the margin of {1e3 * margin:.0f} mm: "
    )


def _where_to_jog(first: Array) -> str:
    angles = ", ".join(f"{angle:.0f}" for angle in np.degrees(first))
    return f"jog the arm to within {np.degrees(NEAR_RAD):.0f} degrees of the joint angles {angles}, then start again"
