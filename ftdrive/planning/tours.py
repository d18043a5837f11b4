"""The shortest closed tour through groups of joint vectors, one of each group, over allowed moves only.

A generalised travelling salesman: the order is improved by reversing parts of it, the choice within the groups is then
exact (dynamic programming), and the best tour is shaken until that no longer helps. Deterministic.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drivers.ur.kinematics import Array
from ftdrive.planning.certify import Certifier
from ftdrive.planning.kinematics import wrist_inverse
from ftdrive.planning.motion import Speeds, move_duration_s

Nodes = NDArray[np.intp]

WRIST_4_5_RAD = np.pi
WRIST_6_RAD = float(np.radians(200))
"""Windows of the wrist joints to both sides of where they stand: cables."""
FORBIDDEN_S = 1e6
COST_OF_TRAVEL_S = 0.02
"""Per radian, summed over the joints: among equally fast tours the calmer one."""
SHAKES = 150


def wrist_nodes(certifier: Certifier, q_rad: ArrayLike, R_base_flange: Array) -> tuple[Array, Nodes]:
    """All free joint vectors with joints 1 to 3 as they stand and the flange in one of these orientations.

    Parameters
    ----------
    q_rad : array_like, shape (6,)
        Where the arm stands; the wrist stays in its windows about it.
    R_base_flange : array, shape (m, 3, 3)

    Returns
    -------
    q : array, shape (n, 6)
    group : int array, shape (n,)
        Index of the orientation.
    """
    stands = np.asarray(q_rad, dtype=np.float64)
    solutions = wrist_inverse(stands[:3], R_base_flange)  # (m, 2, 6)
    turns = 2 * np.pi * np.array([(0, 0, 0, i, j, k) for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1)])
    q = solutions[:, :, None] + turns  # (m, 2, 27, 6)
    group = np.broadcast_to(np.arange(len(q))[:, None, None], q.shape[:3]).ravel()
    q = q.reshape(-1, 6)
    window = np.array([np.inf] * 3 + [WRIST_4_5_RAD, WRIST_4_5_RAD, WRIST_6_RAD]) + 1e-9
    # Far from zero a joint has no room on one side: the window about zero serves there.
    middle = np.where(np.abs(stands) > np.pi, 0.0, stands)
    inside = np.all((np.abs(q - middle) <= window) & (np.abs(q) <= 2 * np.pi + 1e-9), axis=1)
    q, group = q[inside], group[inside]
    shapes, back = _distinct(certifier, q)
    free = certifier.free(shapes)[back]
    return q[free], group[free]


def allowed_moves(certifier: Certifier, q_rad: Array, group: Nodes) -> NDArray[np.bool_]:
    """Say (n, n) which straight moves between nodes of different groups are certified."""
    shapes, back = _distinct(certifier, q_rad)
    start, end = np.triu_indices(len(shapes), 1)
    allowed = np.eye(len(shapes), dtype=np.bool_)
    allowed[start, end] = certifier.certify(shapes[start], shapes[end], tight=False).clear
    allowed |= allowed.T
    return np.asarray(allowed[np.ix_(back, back)] & (group[:, None] != group))


def shortest_tour(q_rad: Array, group: Nodes, allowed: NDArray[np.bool_], speeds: Speeds) -> Nodes | None:
    """Order of nodes of a short closed tour, one of each group; None where none was found."""
    groups = [np.flatnonzero(group == g) for g in range(group.max() + 1)] if len(group) else []
    if len(groups) < 3 or not all(len(nodes) for nodes in groups):
        return None
    turn = np.abs(q_rad[:, None] - q_rad)
    cost = move_duration_s(turn.max(axis=2), speeds.joint_rad_s, speeds.joint_rad_s2)
    cost = np.where(allowed, cost + COST_OF_TRAVEL_S * turn.sum(axis=2), FORBIDDEN_S)
    rng = np.random.default_rng(0)
    best = _improved(_nearest_neighbours(groups, cost), groups, cost)
    for _ in range(SHAKES):
        trial = _improved(_shaken(best, rng), groups, cost)
        if _length(trial, cost) < _length(best, cost) - 1e-9:
            best = trial
    return best if _length(best, cost) < FORBIDDEN_S else None


def _distinct(certifier: Certifier, q_rad: Array) -> tuple[Array, Nodes]:
    """Joint vectors that differ in what can collide: angle 6 does not matter to a tool that is round about its axis."""
    moves = certifier.arm.travel_m.max(axis=0) > 0
    rounded = np.round(np.where(moves, q_rad, 0.0), 9)
    _, first, back = np.unique(rounded, axis=0, return_index=True, return_inverse=True)
    return np.where(moves, q_rad, 0.0)[first], back.ravel()


def _length(tour: Nodes, cost: Array) -> float:
    return float(cost[tour, np.roll(tour, -1)].sum())


def _nearest_neighbours(groups: list[Nodes], cost: Array) -> Nodes:
    tour = [int(groups[0][0])]
    left = set(range(1, len(groups)))
    while left:
        g, node = min(((g, int(n)) for g in sorted(left) for n in groups[g]), key=lambda item: cost[tour[-1], item[1]])
        tour.append(node)
        left.remove(g)
    return np.array(tour)


def _improved(tour: Nodes, groups: list[Nodes], cost: Array) -> Nodes:
    of_node = {int(node): g for g, nodes in enumerate(groups) for node in nodes}
    tour, length = _choice(tour, groups, of_node, cost), np.inf
    while (now := _length(tour, cost)) < length - 1e-9:
        length = now
        tour = _choice(_reversed_parts(tour, cost), groups, of_node, cost)
    return tour


def _reversed_parts(tour: Nodes, cost: Array) -> Nodes:
    """Reverse the part of the tour that shortens it most, until none does."""
    n = len(tour)
    i, j = np.triu_indices(n, 2)
    while True:
        a, b, c, d = tour[i], tour[i + 1], tour[j], tour[(j + 1) % n]
        gain = cost[a, b] + cost[c, d] - cost[a, c] - cost[b, d]
        best = int(gain.argmax())
        if gain[best] <= 1e-9:
            return tour
        tour = tour.copy()
        tour[i[best] + 1 : j[best] + 1] = tour[i[best] + 1 : j[best] + 1][::-1]


def _choice(tour: Nodes, groups: list[Nodes], of_node: dict[int, int], cost: Array) -> Nodes:
    """Choose the best node of each group for the order of the groups in a closed tour."""
    order = [groups[of_node[int(node)]] for node in tour]
    first = min(range(len(order)), key=lambda k: len(order[k]))
    order = order[first:] + order[:first]
    total = cost[np.ix_(order[0], order[1])]  # (first, now)
    before = []
    for one, other in zip(order[1:], [*order[2:], order[0]], strict=True):
        sums = total[:, :, None] + cost[np.ix_(one, other)]
        before.append(sums.argmin(axis=1))
        total = sums.min(axis=1)
    start = int(np.diagonal(total).argmin())
    picks, now = [start], start
    for back in reversed(before):
        now = int(back[start, now])
        picks.append(now)
    picks = [start, *picks[:0:-1]]
    return np.array([nodes[pick] for nodes, pick in zip(order, picks, strict=True)])


def _shaken(tour: Nodes, rng: np.random.Generator) -> Nodes:
    """Exchange two neighbouring parts of the tour (double bridge)."""
    a, b, c = np.sort(rng.choice(np.arange(1, len(tour) + 1), 3, replace=False))
    return np.concatenate([tour[:a], tour[b:c], tour[a:b], tour[c:]])
