"""Distances between convex bodies that are never larger than the truth.

A body is a cylinder with flat ends, grown by a rounding radius: radius 0 with a rounding is a capsule. A direction u
from body A to body B separates them by at least `min_B(u·x) - max_A(u·x)`. The best direction is found by projecting
back and forth between the bodies; any other one only makes the answer smaller, so the search need not be perfect.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ftdrivers.ur.kinematics import Array

PROJECTIONS = 24
TINY_M = 1e-12
CLOSE_M = 1e-5
"""A lower bound that is as close to the true distance is good enough."""


@dataclass(frozen=True, slots=True, eq=False)
class Bodies:
    """Any number of bodies at once; metres, base axes."""

    centre_m: Array
    """(..., 3)"""
    axis: Array
    """(..., 3) unit vector along each cylinder."""
    half_length_m: Array
    """(...) of the cylinder, without the rounding."""
    radius_m: Array
    """(...) of the cylinder, without the rounding."""
    rounding_m: Array
    """(...)"""

    @property
    def reach_m(self) -> Array:
        """(...) Radius of a ball about the centre that holds the body."""
        return np.asarray(np.hypot(self.half_length_m, self.radius_m) + self.rounding_m)

    def centre_at(self, row: NDArray[np.intp], column: NDArray[np.intp]) -> Array:
        """Centres (m, 3) of some of the bodies of (n, k), one a pair of indices."""
        return self.centre_m.reshape(-1, 3).take(row * len(self.half_length_m) + column, axis=0)

    def at(self, row: NDArray[np.intp], column: NDArray[np.intp]) -> "Bodies":
        """Take some of the bodies of (n, k), one a pair of indices."""
        return Bodies(
            self.centre_at(row, column),
            self.axis.reshape(-1, 3).take(row * len(self.half_length_m) + column, axis=0),
            self.half_length_m.take(column),
            self.radius_m.take(column),
            self.rounding_m.take(column),
        )

    def some(self, index: NDArray[np.intp]) -> "Bodies":
        """Take some of a flat list of bodies."""
        return Bodies(
            self.centre_m.take(index, axis=0),
            self.axis.take(index, axis=0),
            self.half_length_m.take(index),
            self.radius_m.take(index),
            self.rounding_m.take(index),
        )


def dot(a: Array, b: Array) -> Array:
    """Scalar products (...) of vectors (..., 3)."""
    return np.asarray(np.einsum("...i,...i->...", a, b))


def extent(bodies: Bodies, direction: Array) -> Array:
    """How far each body reaches along a unit direction, from its centre."""
    along = dot(bodies.axis, direction)
    across = np.sqrt(np.maximum(1 - along**2, 0.0))
    return bodies.half_length_m * np.abs(along) + bodies.radius_m * across + bodies.rounding_m


def height_above(bodies: Bodies, normal: Array, offset_m: float) -> Array:
    """Exact distance (...) of bodies to the half-space `normal · x < offset_m`; negative inside."""
    return np.asarray(bodies.centre_m @ normal - offset_m - extent(bodies, -normal))


def separation(a: Bodies, b: Bodies, enough_m: Array) -> Array:
    """Lower bound (k,) of the distance between bodies, pair by pair; negative or zero where none can be shown.

    Parameters
    ----------
    a, b : Bodies
        k of each.
    enough_m : array, shape (k,)
        A pair that is shown to be this far apart is not looked at any more.
    """
    between, capsule_distance = _between_axes(a, b)
    bound = capsule_distance - (a.radius_m + a.rounding_m + b.radius_m + b.rounding_m)
    # Capsules are judged exactly by their axes; flat ends are not.
    open_ = np.flatnonzero((bound < enough_m) & (a.radius_m + b.radius_m > 0))
    if len(open_):
        inner_a, inner_b = (replace(body.some(open_), rounding_m=np.zeros(len(open_))) for body in (a, b))
        grown = (a.rounding_m + b.rounding_m)[open_]
        bound[open_] = np.maximum(bound[open_], _by_projections(inner_a, inner_b, between[open_]) - grown)
    return np.asarray(bound)


def separation_from_box(bodies: Bodies, low_m: Array, high_m: Array, enough_m: Array) -> Array:
    """Lower bound (k,) of the distance between each body and a box parallel to the base axes.

    A body that is shown to be `enough_m` (k,) away is not looked at any more.
    """
    centre, half = (low_m + high_m) / 2, (high_m - low_m) / 2
    point = bodies.centre_m
    best = np.full(len(point), -1.0)  # if a body intersects the box, the depth is not computed
    open_ = np.arange(len(point))
    for _ in range(PROJECTIONS):
        on_box = np.clip(point, low_m, high_m)
        gap = on_box - point
        length = np.sqrt(dot(gap, gap))
        u = gap / np.maximum(length, TINY_M)[:, None]
        reach = dot(u, centre - bodies.centre_m) - np.abs(u) @ half - extent(bodies, u)
        best[open_] = np.maximum(best[open_], np.where(length > TINY_M, reach, -1.0))
        still = np.flatnonzero((best[open_] < enough_m[open_]) & (length - bodies.rounding_m - best[open_] >= CLOSE_M))
        if not len(still):
            break
        open_, bodies = open_[still], bodies.some(still)
        point = _nearest(bodies, on_box[still])
    return best


def _by_projections(a: Bodies, b: Bodies, on_b: Array) -> Array:
    best = np.full(len(on_b), -1.0)
    open_ = np.arange(len(on_b))
    for _ in range(PROJECTIONS):
        on_a = _nearest(a, on_b)
        on_b = _nearest(b, on_a)
        gap = on_b - on_a
        length = np.sqrt(dot(gap, gap))
        u = gap / np.maximum(length, TINY_M)[:, None]
        reach = dot(u, b.centre_m - a.centre_m) - extent(a, u) - extent(b, u)
        best[open_] = np.maximum(best[open_], np.where(length > TINY_M, reach, -1.0))
        still = np.flatnonzero(length - best[open_] >= CLOSE_M)
        if not len(still):
            break
        open_, on_b, a, b = open_[still], on_b[still], a.some(still), b.some(still)
    return best


def _nearest(bodies: Bodies, point: Array) -> Array:
    """Point (k, 3) of each cylinder, without rounding, that is nearest to a given one."""
    from_centre = point - bodies.centre_m
    along = dot(from_centre, bodies.axis)
    across = from_centre - along[:, None] * bodies.axis
    radius = np.sqrt(dot(across, across))
    shrink = np.minimum(1.0, bodies.radius_m / np.maximum(radius, TINY_M))
    along = np.clip(along, -bodies.half_length_m, bodies.half_length_m)
    return np.asarray(bodies.centre_m + along[:, None] * bodies.axis + shrink[:, None] * across)


def _between_axes(a: Bodies, b: Bodies) -> tuple[Array, Array]:
    """Point (k, 3) of each segment b nearest to the segment a, and the distance (k,) of the two.

    The distance is convex in the two positions: the unconstrained answer, clipped on one and then on the other segment,
    is exact (Ericson, Real-Time Collision Detection, 2005, section 5.1.9).
    """
    gap = a.centre_m - b.centre_m
    cosine, on_a, on_b = dot(a.axis, b.axis), dot(a.axis, gap), dot(b.axis, gap)
    sine2 = 1 - cosine**2
    s = np.where(sine2 > 1e-9, (cosine * on_b - on_a) / np.maximum(sine2, 1e-9), 0.0)
    s = np.clip(s, -a.half_length_m, a.half_length_m)
    t = np.clip(cosine * s + on_b, -b.half_length_m, b.half_length_m)
    s = np.clip(cosine * t - on_a, -a.half_length_m, a.half_length_m)
    point = b.centre_m + t[:, None] * b.axis
    difference = a.centre_m + s[:, None] * a.axis - point
    return point, np.sqrt(dot(difference, difference))
