"""Short closed tours through groups of joint vectors, one of each group, over moves that are proven clear.

This is a generalised travelling salesman problem. Reversals of segments (2-opt) improve the order, dynamic programming
finds the best choice within the groups, and random perturbations (double bridges) leave local minima. Moves are proven
lazily: first those to near neighbours, which show the connected parts, then those that a tour would use. The result is
deterministic.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from ftdrive.planning.geometry.certify import Certifier
from ftdrive.planning.motion import Speeds, durations_s
from ftdrive.planning.search.nodes import Nodes, distinct
from ftdrivers.ur.kinematics import Array

FORBIDDEN_S = 1e6
# Cost, s, per radian of the joints' total travel: among equally fast tours, one with less motion is preferred.
COST_OF_TRAVEL_S = 0.02
# Number of perturbations of the order in the final search, and in each earlier round.
SHAKES = 150
SHAKES_A_ROUND = 10
# Largest number of rounds; each certifies the moves of the best tour, and excludes those that are not clear.
ROUNDS = 60
# Up to `FEW` joint vectors all moves are considered; otherwise only those to the `NEAREST_OF_EACH` of each group.
FEW = 120
NEAREST_OF_EACH = 2
# From `MANY_GROUPS` groups on, only moves to the `NEAREST_OF_ALL` joint vectors, of whatever group, are considered.
MANY_GROUPS, NEAREST_OF_ALL = 60, 40
# Number of neighbours, about, to which each joint vector is linked when connected parts are searched.
NEIGHBOURS = 10
# At most this many joint vectors of each group are used; the larger number if no tour is found with the smaller.
MOST_NODES = (25, 60)


def connected(certifier: Certifier, q_rad: Array, layer: Nodes) -> Nodes:
    """Return the index (n,) of the connected part of free joint space, from 0, to which each joint vector belongs.

    Parameters
    ----------
    q_rad : array, shape (n, 6)
        Free joint vectors.
    layer : int array, shape (n,)
        Layer of each joint vector, from 0. Neighbours are searched in each layer separately, because joint vectors may
        be dense in some joints only.
    """
    shapes, of = distinct(certifier, q_rad)
    layer_of_shape = layer[np.unique(of, return_index=True)[1]]
    layers = np.unique(layer_of_shape, return_inverse=True)[1].ravel()
    moves = _to_every_group(shapes, layers, NEIGHBOURS // (layers.max() + 1) + 1)
    return _Proof(certifier, shapes).parts(np.arange(len(shapes)), *moves)[of]


def clear_tour(certifier: Certifier, q_rad: Array, group: Nodes, speeds: Speeds) -> Nodes | None:
    """Return a short closed tour of clear moves through one node of each group.

    Parameters
    ----------
    q_rad : array, shape (n, 6)
        Free joint vectors.
    group : int array, shape (n,)
        Group of each node, from 0 without gaps. In a group with many nodes, the preferred ones come first.
    speeds : Speeds

    Returns
    -------
    int array or None
        Indices of the nodes in the order of travel; None if no tour was found.
    """
    if not len(q_rad):
        return None
    proof, before = _Proof(certifier, q_rad), 0
    for most in MOST_NODES:
        nodes = np.sort(np.concatenate([np.flatnonzero(group == g)[:most] for g in np.unique(group)]))
        if (
            len(nodes) > before
            and (order := _tour_of(certifier, proof, q_rad[nodes], group[nodes], nodes, speeds)) is not None
        ):
            return nodes[order]
        before = len(nodes)
    return None


def _tour_of(
    certifier: Certifier, proof: "_Proof", q_rad: Array, group: Nodes, known_as: Nodes, speeds: Speeds
) -> Nodes | None:
    count = len(q_rad) if len(q_rad) <= FEW else NEAREST_OF_EACH
    near, count = (group, count) if group.max() < MANY_GROUPS else (np.zeros_like(group), NEAREST_OF_ALL)
    part = proof.parts(known_as, *_to_every_group(proof.shapes[proof.of[known_as]], near, count))
    covering = [p for p in range(part.max() + 1) if len(np.unique(group[part == p])) == group.max() + 1]
    if not covering:
        return None
    inside = np.flatnonzero(part == max(covering, key=lambda p: np.count_nonzero(part == p)))
    q, group, known_as = q_rad[inside], group[inside], known_as[inside]
    cost = durations_s(certifier.arm, q, speeds) + COST_OF_TRAVEL_S * np.abs(q[:, None] - q).sum(axis=2)
    order, best, shakes = None, None, SHAKES_A_ROUND
    for _ in range(ROUNDS):
        allowed = proof.not_refuted(known_as) & (group[:, None] != group)
        order = shortest_tour(cost, group, allowed, start=order, shakes=shakes)
        if order is None:
            break
        start, end = order, np.roll(order, -1)
        clear = proof.prove(known_as[start], known_as[end])
        if clear.all():
            if shakes == SHAKES:
                return inside[order]
            best, shakes = inside[order], SHAKES  # this tour is clear; search for a shorter one
        for i, j in zip(start[~clear], end[~clear], strict=True):
            # If a move is blocked, other moves from and to its ends may be blocked too: prove them now.
            others = np.flatnonzero(group == group[j]), np.flatnonzero(group == group[i])
            proof.prove(known_as[np.repeat(i, len(others[0]))], known_as[others[0]])
            proof.prove(known_as[np.repeat(j, len(others[1]))], known_as[others[1]])
    return best


def shortest_tour(
    cost_s: Array, group: Nodes, allowed: NDArray[np.bool_], *, start: Nodes | None = None, shakes: int = SHAKES
) -> Nodes | None:
    """Return the nodes of a short closed tour over allowed moves, one of each group; None if none was found."""
    groups = [np.flatnonzero(group == g) for g in range(group.max() + 1)] if len(group) else []
    if len(groups) < 2 or not all(len(nodes) for nodes in groups):
        return None
    cost = np.where(allowed, cost_s, FORBIDDEN_S)
    if len(groups) == 2:  # there and back
        both = (cost + cost.T)[np.ix_(*groups)]
        i, j = np.unravel_index(both.argmin(), both.shape)
        return np.array([groups[0][i], groups[1][j]]) if both[i, j] < FORBIDDEN_S else None
    rng = np.random.default_rng(0)
    best, shortest_s = _improved(_nearest_neighbours(groups, cost) if start is None else start, group, groups, cost)
    for _ in range(shakes):
        trial, length_s = _improved(_shaken(best, rng), group, groups, cost)
        if length_s < shortest_s - 1e-9:
            best, shortest_s = trial, length_s
    return best if shortest_s < FORBIDDEN_S else None


class _Proof:
    """Proofs of moves between joint vectors; every pair of shapes is certified at most once."""

    def __init__(self, certifier: Certifier, q_rad: Array) -> None:
        self._certifier = certifier
        self.shapes, self.of = distinct(certifier, q_rad)
        n = len(self.shapes)
        self._known = np.eye(n, dtype=np.bool_)
        self._clear = np.eye(n, dtype=np.bool_)

    def prove(self, start: Nodes, end: Nodes) -> NDArray[np.bool_]:
        """Return for each of m moves between nodes whether it is proven clear; certify those not yet certified."""
        i, j = self.of[start], self.of[end]
        open_ = np.unique(np.sort(np.stack([i, j], axis=1)[~self._known[i, j]], axis=1), axis=0)
        if len(open_):
            a, b = open_.T
            self._known[a, b] = self._known[b, a] = True
            clear = self._certifier.certify(self.shapes[a], self.shapes[b], tight=False).clear
            self._clear[a, b] = self._clear[b, a] = clear
        return np.asarray(self._clear[i, j])

    def not_refuted(self, nodes: Nodes) -> NDArray[np.bool_]:
        """Return (m, m) whether the move from node to node is proven clear or not yet certified."""
        of = self.of[nodes]
        return np.asarray((self._clear | ~self._known)[np.ix_(of, of)])

    def parts(self, nodes: Nodes, start: Nodes, end: Nodes) -> Nodes:
        """Return for each node the number (m,) of its connected part, linked by those given moves that are clear."""
        clear = self.prove(nodes[start], nodes[end])
        edges = coo_array((np.ones(clear.sum()), (start[clear], end[clear])), shape=(len(nodes), len(nodes)))
        return np.asarray(connected_components(edges, directed=False)[1], dtype=np.intp)


def _to_neighbours(q_rad: Array, count: int, among: Nodes) -> tuple[Nodes, Nodes]:
    """Return the moves (start, end) from every node to its nearest nodes in `among`."""
    near = cKDTree(q_rad[among]).query(q_rad, range(1, min(count, len(among)) + 1), p=np.inf)[1]
    return np.repeat(np.arange(len(q_rad)), near.shape[1]), among[near.ravel()]


def _to_every_group(q_rad: Array, group: Nodes, count: int) -> tuple[Nodes, Nodes]:
    """Return the moves (start, end) from every node to its nearest nodes in each group."""
    start, end = np.hstack([_to_neighbours(q_rad, count, np.flatnonzero(group == g)) for g in range(group.max() + 1)])
    return start, end


def _tour_length(tour: Nodes, cost: Array) -> float:
    return float(cost[tour, np.concatenate([tour[1:], tour[:1]])].sum())


def _nearest_neighbours(groups: list[Nodes], cost: Array) -> Nodes:
    tour = [int(groups[0][0])]
    left = set(range(1, len(groups)))
    while left:
        g, node = min(((g, int(n)) for g in sorted(left) for n in groups[g]), key=lambda item: cost[tour[-1], item[1]])
        tour.append(node)
        left.remove(g)
    return np.array(tour)


def _improved(tour: Nodes, group: Nodes, groups: list[Nodes], cost: Array) -> tuple[Nodes, float]:
    """Shorten a tour until no reversal of a segment and no other node of a group helps; return it and its cost, s."""
    tour, length = _choice(tour, group, groups, cost), np.inf
    while (now := _tour_length(tour, cost)) < length - 1e-9:
        length = now
        tour = _choice(_reversed_parts(tour, cost), group, groups, cost)
    return tour, now


def _reversed_parts(tour: Nodes, cost: Array) -> Nodes:
    """Return the tour after reversing segments until no reversal shortens it (2-opt)."""
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


def _choice(tour: Nodes, group: Nodes, groups: list[Nodes], cost: Array) -> Nodes:
    """Return the cheapest tour through one node of each group, in the order of groups of the given tour."""
    order = [groups[g] for g in group[tour]]
    first = min(range(len(order)), key=lambda k: len(order[k]))
    order = order[first:] + order[:first]
    total = cost[order[0][:, None], order[1]]  # (node of the first group, node now)
    before = []
    for one, other in zip(order[1:], [*order[2:], order[0]], strict=True):
        sums = total[:, :, None] + cost[one[:, None], other]
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
    """Return the tour with two random neighbouring segments swapped (double bridge), to leave a local minimum."""
    a, b, c = np.sort(rng.choice(np.arange(1, len(tour) + 1), 3, replace=False))
    return np.concatenate([tour[:a], tour[b:c], tour[a:b], tour[c:]])
