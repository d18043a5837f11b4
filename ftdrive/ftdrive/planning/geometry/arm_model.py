"""Shapes of the arm and the tool, their positions at given joint angles, and distances between them.

A body is a cylinder with flat ends, enlarged by a rounding radius; a cylinder of radius 0 then becomes a capsule. Along
a direction u, the distance between bodies A and B is at least `min_B(u·x) - max_A(u·x)`. Alternating projections
between the bodies find the best direction. Any other direction gives a smaller bound, so the search need not be exact.

Radii and hub widths were measured from the convex hulls of the collision meshes in the ROS 2 description of the arms,
version 2.4.5. The shapes of UR3e, UR5e, UR10e and UR16e were then fitted to meshes with all lids and edges, which
exceed them by at most 1 mm. Those of UR20 and UR30 were widened in the same way, with lids scaled from the UR5e by the
length of wrist 2. Models without measured shapes are refused.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ftcalib.model import cross
from ftdrive.errors import ConfigError
from ftdrive.planning.geometry.kinematics import Frames, deviation, frames
from ftdrivers.ur.kinematics import MODELS, Array, Kinematics, model_named

PROJECTIONS = 24
TINY_M = 1e-12
# A lower bound on a distance is refined until it is within this of the true distance, m.
CLOSE_M = 1e-5


@dataclass(frozen=True, slots=True, eq=False)
class Bodies:
    """Arrays of bodies; metres, base axes."""

    centre_m: Array
    """(..., 3) centre of each cylinder."""
    axis: Array
    """(..., 3) unit vector along each cylinder."""
    half_length_m: Array
    """(...) half the length of the cylinder, without the rounding."""
    radius_m: Array
    """(...) radius of the cylinder, without the rounding."""
    rounding_m: Array
    """(...) rounding radius."""

    @property
    def reach_m(self) -> Array:
        """(...) radius of a ball about the centre that contains the body."""
        return np.asarray(np.hypot(self.half_length_m, self.radius_m) + self.rounding_m)

    def centre_at(self, row: NDArray[np.intp], column: NDArray[np.intp]) -> Array:
        """Return the centres (m, 3) of m of the bodies (n, k), one per pair of posture and body index."""
        return self.centre_m.reshape(-1, 3).take(row * len(self.half_length_m) + column, axis=0)

    def at(self, row: NDArray[np.intp], column: NDArray[np.intp]) -> "Bodies":
        """Return m of the bodies (n, k) as bodies (m,), one per pair of posture and body index."""
        return Bodies(
            self.centre_at(row, column),
            self.axis.reshape(-1, 3).take(row * len(self.half_length_m) + column, axis=0),
            self.half_length_m.take(column),
            self.radius_m.take(column),
            self.rounding_m.take(column),
        )

    def some(self, index: NDArray[np.intp]) -> "Bodies":
        """Return those bodies of a list (n,) that have the given indices."""
        return Bodies(
            self.centre_m.take(index, axis=0),
            self.axis.take(index, axis=0),
            self.half_length_m.take(index),
            self.radius_m.take(index),
            self.rounding_m.take(index),
        )

    def height_above(self, normal: Array, offset_m: float) -> Array:
        """Return the exact distance (...) to the half-space `normal · x < offset_m`, m; negative inside."""
        return np.asarray(self.centre_m @ normal - offset_m - _extent(self, -normal))


def dot(a: Array, b: Array) -> Array:
    """Return the scalar products (...) of vectors (..., 3)."""
    return np.asarray(np.einsum("...i,...i->...", a, b))


def _extent(bodies: Bodies, direction: Array) -> Array:
    """Return how far each body (...) extends from its centre along a unit direction, m."""
    along = dot(bodies.axis, direction)
    across = np.sqrt(np.maximum(1 - along**2, 0.0))
    return bodies.half_length_m * np.abs(along) + bodies.radius_m * across + bodies.rounding_m


def separation(a: Bodies, b: Bodies, enough_m: Array) -> Array:
    """Return a lower bound (k,) on the distance between each pair of bodies, m; at most zero if the pair may touch.

    Parameters
    ----------
    a, b : Bodies
        Bodies (k,) each.
    enough_m : array, shape (k,)
        A pair with a bound of at least this distance is not refined further.
    """
    between, capsule_distance = _between_axes(a, b)
    bound = capsule_distance - (a.radius_m + a.rounding_m + b.radius_m + b.rounding_m)
    # The distance computed from the axes is exact for capsules, but too small for cylinders with flat ends.
    open_ = np.flatnonzero((bound < enough_m) & (a.radius_m + b.radius_m > 0))
    if len(open_):
        inner_a, inner_b = (replace(body.some(open_), rounding_m=np.zeros(len(open_))) for body in (a, b))
        grown = (a.rounding_m + b.rounding_m)[open_]
        bound[open_] = np.maximum(bound[open_], _by_projections(inner_a, inner_b, between[open_]) - grown)
    return np.asarray(bound)


def separation_from_box(bodies: Bodies, low_m: Array, high_m: Array, enough_m: Array) -> Array:
    """Return a lower bound (k,) on the distance from each body to a box, m, which is refined up to `enough_m` (k,)."""
    centre, half = (low_m + high_m) / 2, (high_m - low_m) / 2
    point = bodies.centre_m
    # For a body that intersects the box the bound is -1 m, because the depth of penetration is not computed.
    best = np.full(len(point), -1.0)
    open_ = np.arange(len(point))
    for _ in range(PROJECTIONS):
        on_box = np.clip(point, low_m, high_m)
        gap = on_box - point
        length = np.sqrt(dot(gap, gap))
        u = gap / np.maximum(length, TINY_M)[:, None]
        reach = dot(u, centre - bodies.centre_m) - np.abs(u) @ half - _extent(bodies, u)
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
        reach = dot(u, b.centre_m - a.centre_m) - _extent(a, u) - _extent(b, u)
        best[open_] = np.maximum(best[open_], np.where(length > TINY_M, reach, -1.0))
        still = np.flatnonzero(length - best[open_] >= CLOSE_M)
        if not len(still):
            break
        open_, on_b, a, b = open_[still], on_b[still], a.some(still), b.some(still)
    return best


def _nearest(bodies: Bodies, point: Array) -> Array:
    """Return the point (k, 3) of each cylinder, without rounding, that is nearest to a given point."""
    from_centre = point - bodies.centre_m
    along = dot(from_centre, bodies.axis)
    across = from_centre - along[:, None] * bodies.axis
    radius = np.sqrt(dot(across, across))
    shrink = np.minimum(1.0, bodies.radius_m / np.maximum(radius, TINY_M))
    along = np.clip(along, -bodies.half_length_m, bodies.half_length_m)
    return np.asarray(bodies.centre_m + along[:, None] * bodies.axis + shrink[:, None] * across)


def _between_axes(a: Bodies, b: Bodies) -> tuple[Array, Array]:
    """Return the point (k, 3) of each axis segment b nearest to segment a, and their distance (k,), m.

    The distance is convex in the two positions, so the unconstrained solution, clipped to one segment and then to
    the other, is exact (Ericson, Real-Time Collision Detection, 2005, section 5.1.9).
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


# Radius of the rounded edges of the joint housings. With it, the smallest self-clearance of a UR3e on the constant tour
# is 22 mm; that of the convex hulls of its meshes is 27 mm.
HUB_ROUNDING_M = 0.020

# Radius of the rounded edges of the housing at the end of the forearm.
FOREARM_END_ROUNDING_M = 0.010


@dataclass(frozen=True, slots=True)
class _Shape:
    """Dimensions of one arm, metres. Ranges are along the lift axis, from the centre of the shoulder."""

    upper_arm_offset_m: float
    forearm_offset_m: float
    base_radius_m: float
    shoulder_radius_m: float
    upper_arm_radius_m: float
    elbow_radius_m: float
    forearm_radius_m: float
    forearm_end_radius_m: float
    wrist_radius_m: float
    upper_arm_hub_m: tuple[float, float]
    elbow_hub_m: tuple[float, float]
    forearm_hub_m: tuple[float, float]
    forearm_end_hub_m: tuple[float, float]
    # Distance from the centres of joints 5 and 6 back to the lids of wrists 1 and 2.
    wrist_lid_m: float


_UR5E = _Shape(
    0.138, 0.007, 0.081, 0.088, 0.062, 0.062, 0.050, 0.042, 0.048, (0.065, 0.217), (0.053, 0.217), (-0.035, 0.068),
    (-0.052, 0.063), 0.057,
)  # fmt: skip
_UR10E = _Shape(
    0.1762, 0.0393, 0.101, 0.111, 0.077, 0.071, 0.059, 0.048, 0.057, (0.084, 0.275), (0.084, 0.256), (-0.005, 0.112),
    (-0.022, 0.109), 0.060,
)  # fmt: skip
_UR20 = _Shape(
    0.260, 0.043, 0.125, 0.150, 0.095, 0.097, 0.075, 0.070, 0.065, (0.117, 0.358), (0.134, 0.346), (-0.036, 0.154),
    (-0.033, 0.143), 0.091,
)  # fmt: skip
SHAPES = {
    "UR3e": _Shape(
        0.120, 0.027, 0.069, 0.073, 0.048, 0.048, 0.040, 0.035, 0.040, (0.054, 0.187), (0.062, 0.180), (0.004, 0.070),
        (-0.020, 0.080), 0.048,
    ),
    "UR5e": _UR5E,
    "UR7e": _UR5E,
    "UR10e": _UR10E,
    "UR12e": _UR10E,
    "UR16e": _Shape(
        0.176, 0.040, 0.101, 0.111, 0.077, 0.071, 0.059, 0.048, 0.057, (0.084, 0.275), (0.084, 0.256), (-0.005, 0.113),
        (-0.021, 0.110), 0.060,
    ),
    "UR20": _UR20,
    "UR30": _UR20,
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Cylinder:
    """A cylinder of the equipment on the flange: sensor, adapter, gripper or a part of it. Metres, flange axes."""

    from_m: float
    """Start of the cylinder along the flange z axis; 0 is the flange face."""
    to_m: float
    diameter_m: float
    x_m: float = 0.0
    """Position x, y of the axis of the cylinder, which is parallel to the flange z axis."""
    y_m: float = 0.0

    def __post_init__(self) -> None:
        if not 0 <= self.from_m < self.to_m <= 2:
            raise ConfigError(
                f"a cylinder of the tool reaches from {self.from_m * 1e3:g} to {self.to_m * 1e3:g} mm from the "
                "flange: give a start of 0 mm or more, and a larger end of at most 2000 mm"
            )
        if not 0 < self.diameter_m <= 1:
            raise ConfigError(f"a cylinder of the tool has a diameter of {self.diameter_m * 1e3:g} mm: give 1 to 1000")
        if not self.offset_m <= 1:
            raise ConfigError(
                f"a cylinder of the tool is {self.offset_m * 1e3:g} mm off the flange axis: give at most 1000"
            )

    @property
    def offset_m(self) -> float:
        """Distance of the axis of the cylinder from the axis of joint 6."""
        return float(np.hypot(self.x_m, self.y_m))

    @property
    def reach_m(self) -> float:
        """Largest distance of a point of the cylinder from the axis of joint 6."""
        return self.offset_m + self.diameter_m / 2


# Length of the longest string, and height and radius of the largest weight, for which a plan is proven clear.
STRING_M, WEIGHT_HEIGHT_M, WEIGHT_RADIUS_M = 0.25, 0.1, 0.06


@dataclass(frozen=True, slots=True)
class HungLoad:
    """A weight that hangs straight down on a string from a point of the tool."""

    p_flange_m: tuple[float, float, float]
    """Position of the hook from the centre of the flange face, flange axes."""
    down_base: tuple[float, float, float]
    """Unit vector along gravity, base axes."""
    string_m: float = STRING_M
    height_m: float = WEIGHT_HEIGHT_M
    """Height of the weight below the string."""
    radius_m: float = WEIGHT_RADIUS_M
    """Radius of the weight."""
    swing_rad: float = float(np.radians(10))
    """Largest swing angle; the modelled body of the weight is widened accordingly."""
    free_m: float = 0.05
    """Length of the upper part of the string, which may be close to the tool."""

    @property
    def swing_m(self) -> float:
        """Largest horizontal displacement of the end of the string."""
        return float(self.string_m * np.sin(self.swing_rad))

    @property
    def reach_m(self) -> float:
        """Largest distance of a point of the weight from the hook."""
        return float(np.hypot(self.string_m + self.height_m, self.radius_m + self.swing_m))


# Names of the bodies of a hanging load, after those of the tool.
_HUNG: Final = ("string", "load")

# Name of each body of the arm, and number of joints that move it.
_ARM = (
    ("base", 0),
    ("shoulder", 1),
    ("upper arm", 2),
    ("upper arm", 2),
    ("elbow", 2),
    *[("upper arm", 2)] * 4,
    ("forearm", 3),
    ("forearm", 3),
    ("forearm", 3),
    *[("forearm", 3)] * 2,
    ("wrist 1", 4),
    ("wrist 1", 4),
    ("wrist 2", 5),
    ("wrist 2", 5),
    ("wrist 3", 6),
)
_UPPER_ARM, _ELBOW_SIDE, _FOREARM = [*range(2, 9)], 9, [*range(10, 14)]
_WRIST_1, _WRIST_2_ALONG_6, _WRIST_3, _TOOL = (14, 15), 17, 18, 19

# A body: ends (n, 3) of its axis, radius and rounding.
_Part = tuple[Array, Array, float, float]
# The housing of a joint: centre (n, 3), range along the lift axis, radius and rounding.
_Housing = tuple[Array, tuple[float, float], float, float]


class ArmModel:
    """Model of one arm with its tool.

    Parameters
    ----------
    model : str
    tool : sequence of Cylinder
    kinematics : Kinematics, optional
        Kinematics of this arm. Without them nominal ones are used, and `Certifier` keeps more distance.
    hung : HungLoad, optional
        A load on a string.
    """

    def __init__(
        self,
        model: str,
        tool: Sequence[Cylinder],
        kinematics: Kinematics | None = None,
        hung: HungLoad | None = None,
    ) -> None:
        name = model_named(model, controller_major=0)
        if name is None:
            raise ConfigError(f"'{model}' is not a known model of Universal Robots: use one of {', '.join(MODELS)}")
        if name not in SHAPES:
            raise ConfigError(
                f"the shape of the {name} has not been measured, so collisions cannot be excluded: use one of "
                f"{', '.join(SHAPES)}"
            )
        if not tool:
            raise ConfigError("the tool is empty: describe at least the sensor as a cylinder, from:to:diameter in mm")
        self.name = name
        self.is_nominal = kinematics is None
        self.kinematics = kinematics or MODELS[name]
        self.shape = SHAPES[name]
        self.tool = tuple(tool)
        self.hung = hung
        beyond = [*(f"tool {i + 1}" for i in range(len(tool))), *(() if hung is None else _HUNG)]
        self.names = (*(name for name, _ in _ARM), *beyond)
        self.moved_by = np.array([joints for _, joints in _ARM] + [6] * len(beyond))
        self.pairs = _pairs(len(tool), len(beyond) - len(tool))
        self.travel_m = self._travel()

    def frames(self, q_rad: ArrayLike) -> Frames:
        """Return the positions and axes of the joints at joint vectors (n, 6)."""
        return frames(self.kinematics, q_rad)

    def bodies(self, q_rad: ArrayLike) -> Bodies:
        """Return the bodies (n, k) at joint vectors (n, 6), in the order of `names`."""
        at, s = self.frames(q_rad), self.shape
        *_, d1_m, d5_m, d6_m = self._lengths_m
        axis_6 = at.R_base_flange[:, :, 2]
        half_way = at.wrist_2_m - d5_m / 2 * at.axis_5
        wrist_3 = at.flange_m - d6_m / 2 * axis_6
        lid = s.wrist_lid_m - HUB_ROUNDING_M
        shoulder_side = at.shoulder_m, s.upper_arm_hub_m, s.upper_arm_radius_m, HUB_ROUNDING_M
        elbow = at.elbow_m, s.elbow_hub_m, s.elbow_radius_m, HUB_ROUNDING_M
        elbow_side = at.elbow_m, s.forearm_hub_m, s.elbow_radius_m, HUB_ROUNDING_M
        wrist_side = at.forearm_end_m, s.forearm_end_hub_m, s.forearm_end_radius_m, FOREARM_END_ROUNDING_M
        shoulder_end = at.shoulder_m + s.upper_arm_hub_m[0] * at.lift
        forearm_end = at.forearm_end_m + s.forearm_end_hub_m[1] * at.lift_4
        upper_arm, forearm = s.upper_arm_offset_m * at.lift, s.forearm_offset_m * at.lift_3
        wrist_hub, base = (s.wrist_radius_m - HUB_ROUNDING_M, HUB_ROUNDING_M), np.zeros(at.lift.shape)
        parts = [
            (base, base + d1_m * np.eye(3)[2], 0.0, s.base_radius_m),
            (at.shoulder_m, shoulder_end, 0.0, s.shoulder_radius_m),
            _hub(at.lift, shoulder_side),
            (at.shoulder_m + upper_arm, at.elbow_m + upper_arm, 0.0, s.upper_arm_radius_m),
            _hub(at.lift, elbow),
            *_edges(at.lift, 0, shoulder_side, elbow),
            *_edges(at.lift, 1, shoulder_side, elbow),
            _hub(at.lift_3, elbow_side),
            (at.elbow_m + forearm, at.forearm_end_m + forearm, 0.0, s.forearm_radius_m),
            _hub(at.lift_3, wrist_side),
            *_edges(at.lift_3, 1, elbow_side, wrist_side),
            (forearm_end, at.wrist_m, 0.0, s.wrist_radius_m),
            (at.wrist_m - lid * at.axis_5, half_way, *wrist_hub),
            (half_way, at.wrist_2_m, 0.0, s.wrist_radius_m),
            (at.wrist_2_m - lid * axis_6, wrist_3, *wrist_hub),
            (wrist_3, at.flange_m, s.wrist_radius_m, 0.0),
        ]
        for part in self.tool:
            foot = at.flange_m + at.R_base_flange[:, :, :2] @ np.array([part.x_m, part.y_m])
            parts.append((foot + part.from_m * axis_6, foot + part.to_m * axis_6, part.diameter_m / 2, 0.0))
        if (hung := self.hung) is not None:
            hook, down = self.hook_m(at), np.array(hung.down_base)
            string, bottom = hung.string_m * down, (hung.string_m + hung.height_m) * down
            parts += [
                (hook + hung.free_m * down, hook + string, 0.0, 0.0),
                (hook + string, hook + bottom, hung.radius_m + hung.swing_m, 0.0),
            ]
        starts, ends, radius, rounding = zip(*parts, strict=True)
        start, end = np.stack(starts, axis=1), np.stack(ends, axis=1)
        length = np.linalg.norm(end - start, axis=2)
        axis = (end - start) / np.maximum(length, 1e-12)[:, :, None]
        half_length = length.max(axis=0, initial=0.0) / 2  # the same in every posture
        return Bodies((start + end) / 2, axis, half_length, np.array(radius), np.array(rounding))

    def hook_m(self, at: Frames) -> Array:
        """Return the hook (n, 3) of the load in base, m; without a load the centre of the flange face."""
        return at.flange_m if self.hung is None else at.flange_m + at.R_base_flange @ np.array(self.hung.p_flange_m)

    @property
    def ball_m(self) -> float:
        """Radius of a ball about the wrist centre that contains all parts moved by the wrist joints, plus 15 mm."""
        (*_, d5_m, d6_m), r = self._lengths_m, self.shape.wrist_radius_m
        parts = [(r, d6_m), *((part.reach_m, d6_m + part.to_m) for part in self.tool)]
        ball_m = max(float(np.hypot(d5_m + reach, height)) for reach, height in parts)
        if (hung := self.hung) is not None:
            x_m, y_m, z_m = hung.p_flange_m
            ball_m = max(ball_m, float(np.hypot(d5_m + np.hypot(x_m, y_m), d6_m + abs(z_m))) + hung.reach_m)
        return ball_m + float(self._off_m[3:].sum()) + 0.015

    def describe(self) -> dict[str, Any]:
        """Return the model, nominal geometry and shape for the hash of a plan, which depends on them."""
        nominal = MODELS[self.name]
        lengths = nominal.d_m[0], *nominal.a_m[1:3], *nominal.d_m[3:]
        names = ("d1_m", "a2_m", "a3_m", "d4_m", "d5_m", "d6_m")
        return {"model": self.name, "geometry": dict(zip(names, lengths, strict=True)), "shape": asdict(self.shape)}

    @cached_property
    def _lengths_m(self) -> tuple[float, ...]:
        """Lengths of upper arm and forearm, then the Denavit-Hartenberg offsets d4, d1, d5 and d6, m."""
        links = self.kinematics.links_m
        upper, fore = np.hypot(links[1:3, 0], links[1:3, 1]).tolist()
        d1_m, _, _, d4_m, d5_m, d6_m = links[:, 2].tolist()
        return upper, fore, d4_m, d1_m, d5_m, d6_m

    @cached_property
    def _off_m(self) -> Array:
        """Bound (6,) on how far each link's axis errors displace what is beyond it from an arm with exact axes, m."""
        shift_m, tilt_rad = deviation(self.kinematics)
        length_m = np.linalg.norm(self.kinematics.links_m, axis=1)
        after_m = length_m[::-1].cumsum()[::-1] - length_m
        beyond_m = max(float(np.hypot(part.to_m, part.reach_m)) for part in self.tool)
        if self.hung is not None:
            beyond_m = max(beyond_m, float(np.linalg.norm(self.hung.p_flange_m)))
        thick_m = max(self.shape.shoulder_radius_m, *self.shape.upper_arm_hub_m, *self.shape.elbow_hub_m)
        return np.asarray(shift_m + tilt_rad * (after_m + beyond_m + thick_m))

    def _travel(self) -> Array:
        """Return a bound (k, 6) on the displacement of a point of body i per radian of joint j, m.

        It is the largest distance of a point of the body from the axis of the joint over all postures, for an arm with
        exact axes, plus the deviation of the links in between. Joint 6 does not move a body that is round about its
        axis.
        """
        (upper, fore, d4_m, _, d5_m, d6_m), s = self._lengths_m, self.shape
        # Reach of each body beyond the wrist centre: from axis 4, from axis 5, from axis 6, and along the lift axis.
        # Rounding is left out: if the core of a body does not move, neither does its rounding.
        r, lid = s.wrist_radius_m, s.wrist_lid_m - HUB_ROUNDING_M
        hub, back_4, back_5 = r - HUB_ROUNDING_M, max(lid, d5_m / 2), max(lid, d6_m / 2)
        wrist: list[tuple[float, float, float]] = [
            (0.0, 0.0, 0.0),
            (float(np.hypot(back_4, hub)), hub, 0.0),
            (d5_m, 0.0, 0.0),
            (float(np.hypot(d5_m + hub, back_5)), float(np.hypot(back_5, hub)), 0.0),
            (float(np.hypot(d5_m + r, d6_m)), float(np.hypot(d6_m, r)), 0.0),
        ]
        for part in self.tool:
            height, reach = d6_m + part.to_m, part.reach_m
            turned = reach if part.offset_m > 0 else 0.0
            wrist.append((float(np.hypot(d5_m + reach, height)), float(np.hypot(height, reach)), turned))
        if self.hung is not None:
            # The load does not turn with the flange, so every point of it moves as the hook does.
            x_m, y_m, z_m = self.hung.p_flange_m
            aside, height = float(np.hypot(x_m, y_m)), d6_m + abs(z_m)
            hook = float(np.hypot(d5_m + aside, height)), float(np.hypot(height, aside)), aside
            wrist += [hook] * len(_HUNG)
        rows = np.zeros((len(self.names), 6))
        hubs = s.upper_arm_hub_m, s.elbow_hub_m, s.forearm_hub_m, s.forearm_end_hub_m
        sideways = max(abs(end) for hub in hubs for end in hub)
        radius = max(s.upper_arm_radius_m, s.elbow_radius_m, s.forearm_radius_m)
        rows[1, 0] = sideways
        rows[_UPPER_ARM, :2] = np.hypot(sideways, upper + radius), upper + radius
        rows[_UPPER_ARM[0], :2] = np.hypot(sideways, radius), radius
        rows[_FOREARM, :3] = np.hypot(sideways, upper + fore + radius), upper + fore + radius, fore + radius
        rows[_ELBOW_SIDE, :3] = np.hypot(sideways, upper + radius), upper + radius, radius
        for row, (from_4, from_5, from_6) in zip(rows[_WRIST_1[0] :], wrist, strict=True):
            from_2 = upper + fore + from_4
            row[:] = np.hypot(from_2, d4_m + from_5 + radius), from_2, fore + from_4, from_4, from_5, from_6
        between = np.arange(6) < self.moved_by[:, None]
        # Sum over the links from the joint to the body, including the link of the body.
        off_m = np.where(between, self._off_m, 0.0)
        return np.asarray(rows + np.where(between, off_m[:, ::-1].cumsum(axis=1)[:, ::-1], 0.0))


def _hub(lift: Array, housing: _Housing) -> _Part:
    centre, (low, high), radius, rounding = housing
    return centre + (low + rounding) * lift, centre + (high - rounding) * lift, radius - rounding, rounding


def _edges(lift: Array, end: int, *housings: _Housing) -> list[_Part]:
    """Return two bars along the edges of the hull of two housings, at its low (0) or high (1) end of the lift axis.

    They close the gap between the tube of the arm and its housings, which nothing should enter.
    """
    (first, *_), (second, *_) = housings
    side = cross(lift, second - first)
    side /= np.linalg.norm(side, axis=1)[:, None]
    inwards = HUB_ROUNDING_M if end == 0 else -HUB_ROUNDING_M
    bars = []
    for sign in (-1, 1):
        start, stop = (
            centre + (range_m[end] + inwards) * lift + sign * (radius - HUB_ROUNDING_M) * side
            for centre, range_m, radius, _ in housings
        )
        bars.append((start, stop, 0.0, HUB_ROUNDING_M))
    return bars


def _pairs(n_tool: int, n_hung: int = 0) -> NDArray[np.intp]:
    """Return the pairs (p, 2) of bodies that can touch, without neighbours at a joint and pairs kept apart by design.

    Upper arm and forearm move past each other in parallel planes, as do the forearm and the part of wrist 2 along
    axis 5. Wrist 2 keeps wrists 1 and 3 apart.
    """
    tool = range(_TOOL, _TOOL + n_tool)
    hung = range(_TOOL + n_tool, _TOOL + n_tool + n_hung)
    beyond_forearm = (*range(_WRIST_1[0], _TOOL), *tool)
    pairs = [(low, high) for low in (0, 1) for high in (*_FOREARM, *beyond_forearm)]
    pairs += [(low, high) for low in _UPPER_ARM for high in beyond_forearm]
    pairs += [(low, high) for low in (_ELBOW_SIDE, *_FOREARM) for high in (_WRIST_2_ALONG_6, _WRIST_3, *tool)]
    pairs += [(low, high) for low in _WRIST_1 for high in tool]
    pairs += [(low, high) for low in range(_TOOL + n_tool) for high in hung]
    return np.array(pairs)
