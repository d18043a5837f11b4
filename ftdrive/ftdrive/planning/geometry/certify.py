"""Proof that straight joint moves are clear along their whole length, not only at samples.

In a straight joint move, the distance between two bodies changes by at most the sum of |turn| times the longest lever
over the joints between the bodies. An interval is clear if the distance at its midpoint exceeds half of this change.
Other intervals are halved. Only undecided pairs are examined again.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ftdrive.planning.geometry.arm_model import ArmModel, Bodies, dot, separation, separation_from_box
from ftdrive.planning.geometry.scene import Scene
from ftdrivers.ur.kinematics import Array

FIRST_STEP_RAD = np.radians(15)
LAST_STEP_RAD = np.radians(0.4)
# A refined clearance is below the true smallest distance in the move by at most this fraction of it, or by 2 mm.
TIGHTNESS = 0.1


# Angles that, times the levers of the joints between two bodies, give their extra distance if only nominal kinematics
# are known. They cover the deviations of 15 real arms from their nominal models towards a plane (at most 8.3 mm).
# Bodies of the wrist come closer by up to 6.5 mm than in the model, which the margin between parts of the arm covers.
NOMINAL_RAD = np.array([0.0025, 0.0025, 0.0025, 0.0, 0.0, 0.0])


@dataclass(frozen=True, slots=True)
class Margins:
    """Smallest allowed distances, m."""

    self_m: float = 0.020
    """Between parts of the arm and the tool; larger than the errors of modelled shapes and of nominal kinematics."""
    scene_m: float = 0.030
    """Between the arm or its tool and the surroundings."""


@dataclass(frozen=True, slots=True, eq=False)
class Certificate:
    """The result of the proof for m moves."""

    clear: NDArray[np.bool_]
    """(m,) whether the whole move keeps the margins."""
    self_clearance_m: Array
    """(m,) lower bound on the distance between parts of arm and tool; an upper bound if the move is not clear."""
    scene_clearance_m: Array
    """(m,) the same bound on the distance to planes and boxes; infinite if there are none."""
    limited_by: tuple[str, ...]
    """(m,) the pair of bodies whose distance comes closest to the margin."""

    @property
    def clearance_m(self) -> Array:
        """(m,) the smaller of the two clearances."""
        return np.minimum(self.self_clearance_m, self.scene_clearance_m)


class Certifier:
    """Proves that moves of an arm with its tool are clear in a scene."""

    def __init__(self, arm: ArmModel, scene: Scene, margins: Margins | None = None) -> None:
        self.arm, self.scene, self.margins = arm, scene, margins or Margins()
        self._pairs = arm.pairs
        moving = np.flatnonzero(arm.moved_by > 0)
        obstacles = len(scene.planes) + len(scene.boxes)
        self._of_scene = np.array([(body, k) for k in range(obstacles) for body in moving], dtype=np.intp).reshape(
            -1, 2
        )
        joint = np.arange(6)
        low, high = arm.moved_by[self._pairs].T
        between = (joint >= low[:, None]) & (joint < high[:, None])
        own_m = arm.travel_m[self._pairs[:, 1]] * between
        self._margin_m = np.repeat([self.margins.self_m, self.margins.scene_m], [len(self._pairs), len(self._of_scene)])
        if (hung := arm.hung) is not None:
            # Seen from a body that a joint turns, the load turns about its hook by the same angle.
            own_m = own_m + hung.reach_m * ((self._pairs[:, 1:] >= len(arm.names) - 2) & ~between)
            string = np.flatnonzero(self._pairs[:, 1] == len(arm.names) - 2)
            # The string needs no margin from the tool, where it starts, but a larger one from other bodies: it swings.
            to_tool = low[string] == 6
            self._margin_m[string] += np.where(to_tool, -Margins().self_m, hung.swing_m)
        # (p, 6) largest approach per radian of each joint, m; the pairs with the scene follow those of the arm.
        self._lever_m = np.vstack([own_m, arm.travel_m[self._of_scene[:, 0]]])
        if arm.is_nominal:
            self._margin_m += self._lever_m @ NOMINAL_RAD
        self._names = [f"{arm.names[i]} - {arm.names[j]}" for i, j in self._pairs]
        things = [f"plane {i + 1}" for i in range(len(scene.planes))] + [
            f"box {i + 1}" for i in range(len(scene.boxes))
        ]
        self._names += [f"{arm.names[i]} - {things[k]}" for i, k in self._of_scene]

    @property
    def without_load(self) -> "Certifier":
        """Certifier for the tool without its hanging load."""
        arm = self.arm
        if arm.hung is None:
            return self
        own = None if arm.is_nominal else arm.kinematics
        return Certifier(ArmModel(arm.name, arm.tool, own), self.scene, self.margins)

    def reach_m(self, off_rad: Array) -> float:
        """Return a bound on how far two bodies approach each other if each joint is off by up to `off_rad` (6,), m."""
        return float((self._lever_m @ np.abs(off_rad)).max())

    def keeping(self, more_m: float) -> "Certifier":
        """Return a certifier with margins larger by `more_m`, for motion that deviates from its moves by that much."""
        return Certifier(self.arm, self.scene, Margins(self.margins.self_m + more_m, self.margins.scene_m + more_m))

    def free(self, q_rad: ArrayLike) -> NDArray[np.bool_]:
        """Return for each of the joint vectors (n, 6) whether the arm keeps the margins there, (n,) of bool."""
        q = np.asarray(q_rad, dtype=np.float64).reshape(-1, 6)
        row, pair = (index.ravel() for index in np.indices((len(q), len(self._margin_m))))
        needed = self._margin_m[pair]
        free = np.ones(len(q), dtype=np.bool_)
        free[row[self._distance(q, row, pair, needed) <= needed]] = False
        return free

    def too_near(self, q_rad: ArrayLike) -> list[list[str]]:
        """Return the pairs of bodies within their margin at joint angles (6,), such as ["forearm", "plane 2"]."""
        q, pair = np.asarray(q_rad, dtype=np.float64).reshape(1, 6), np.arange(len(self._margin_m))
        distance = self._distance(q, np.zeros_like(pair), pair, self._margin_m)
        return [self._names[i].split(" - ") for i in np.flatnonzero(distance <= self._margin_m)]

    def clear_around(self, q_rad: Array) -> bool:
        """Return whether all moves of a closed tour through joint vectors (n, 6) are proven clear."""
        return bool(self.certify(q_rad, np.roll(q_rad, -1, axis=0), tight=False).clear.all())

    def certify(self, start_rad: ArrayLike, end_rad: ArrayLike, *, tight: bool = True) -> Certificate:
        """Certify straight joint moves.

        Parameters
        ----------
        start_rad, end_rad : array_like, shape (m, 6)
        tight : bool
            Whether to refine the reported clearances; otherwise the proof ends as soon as the margins are proven.
        """
        start = np.asarray(start_rad, dtype=np.float64).reshape(-1, 6)
        turn = np.asarray(end_rad, dtype=np.float64).reshape(-1, 6) - start
        m, n_pairs, n_self = len(start), len(self._margin_m), len(self._pairs)
        approach_m = np.abs(turn) @ self._lever_m.T  # (m, p) most that a pair can come closer over the whole move
        leading = np.abs(turn).max(axis=1)
        proven = np.full((m, 2), np.inf)  # smallest lower bound of the settled intervals: self, scene
        nearest = np.full((m, 2), np.inf)  # smallest distance found so far: self, scene
        least_excess, limited_by = np.full(m, np.inf), np.zeros(m, dtype=np.intp)
        clear = np.ones(m, dtype=np.bool_)

        parts = np.maximum(1, np.ceil(leading / FIRST_STEP_RAD)).astype(int)
        move = np.repeat(np.arange(m), parts)
        middle = (np.arange(len(move)) - np.repeat(np.cumsum(parts) - parts, parts) + 0.5) / parts[move]
        half = 0.5 / parts[move]
        interval, pair = (index.ravel() for index in np.indices((len(move), n_pairs)))
        while len(interval):
            kind = (pair >= n_self).astype(int)
            own = move[interval]
            slack = approach_m[own, pair] * half[interval]
            enough = np.full(len(pair), np.inf) if tight else self._margin_m[pair] + slack
            distance = self._distance(start[move] + middle[:, None] * turn[move], interval, pair, enough)
            np.minimum.at(nearest, (own, kind), distance)
            excess = distance - self._margin_m[pair]
            before = least_excess[own]
            np.minimum.at(least_excess, own, excess)
            closest = (excess < before) & (excess == least_excess[own])
            limited_by[own[closest]] = pair[closest]
            bound = distance - slack
            settled = bound > self._margin_m[pair]
            if tight:
                allowed = np.maximum(0.002, TIGHTNESS * nearest[own, kind])
                settled &= bound >= nearest[own, kind] - allowed
            last = half[interval] * leading[own] < LAST_STEP_RAD / 2
            clear[own[(excess <= 0) | (last & (bound <= self._margin_m[pair]))]] = False
            settled |= last
            np.minimum.at(proven, (own[settled], kind[settled]), bound[settled])
            open_ = ~settled & clear[own]
            # Halve the intervals with an undecided pair.
            kept, position = np.unique(interval[open_], return_inverse=True)
            pair = np.concatenate([pair[open_]] * 2)
            interval = np.concatenate([position, position + len(kept)])
            move, middle, half = (np.concatenate([a[kept]] * 2) for a in (move, middle, half))
            half = half / 2
            middle = middle + np.repeat([-1.0, 1.0], len(kept)) * half
        stated = np.where(clear[:, None], proven, nearest)
        return Certificate(clear, stated[:, 0], stated[:, 1], tuple(self._names[i] for i in limited_by))

    def _distance(self, q_rad: Array, row: NDArray[np.intp], pair: NDArray[np.intp], enough_m: Array) -> Array:
        """Return lower bounds (k,) on the distances of pairs at joint vectors, m; coarse if a coarse bound suffices."""
        bodies = self.arm.bodies(q_rad)
        distance = np.empty(len(pair))
        of_arm = pair < len(self._pairs)
        own, others = np.flatnonzero(of_arm), np.flatnonzero(~of_arm)
        first, second = self._pairs.take(pair[own], axis=0).T
        at = row[own]
        gap = bodies.centre_at(at, first) - bodies.centre_at(at, second)
        apart = np.sqrt(dot(gap, gap)) - bodies.reach_m[first] - bodies.reach_m[second]
        near = np.flatnonzero(apart < enough_m[own])
        at, first, second = at[near], first[near], second[near]
        apart[near] = separation(bodies.at(at, first), bodies.at(at, second), enough_m[own[near]])
        distance[own] = apart
        body, thing = self._of_scene.take(pair[others] - len(self._pairs), axis=0).T
        distance[others] = self._to_scene(bodies, row[others], body, thing, enough_m[others])
        return distance

    def _to_scene(
        self, bodies: Bodies, row: NDArray[np.intp], body: NDArray[np.intp], thing: NDArray[np.intp], enough_m: Array
    ) -> Array:
        distance = np.empty(len(row))
        for k, plane in enumerate(self.scene.planes):
            at = np.flatnonzero(thing == k)
            distance[at] = bodies.at(row[at], body[at]).height_above(np.array(plane.normal), plane.offset_m)
        for k, box in enumerate(self.scene.boxes):
            at = np.flatnonzero(thing == len(self.scene.planes) + k)
            corners = np.array(box.low_m), np.array(box.high_m)
            distance[at] = separation_from_box(bodies.at(row[at], body[at]), *corners, enough_m[at])
        return distance
