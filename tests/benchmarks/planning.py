"""Print the figures of plans beside their targets, and look for collisions in random plans.

Run: python -m tests.benchmarks.planning [--plans 1000]
"""

import argparse
import time
from collections.abc import Callable, Iterator
from functools import partial
from itertools import pairwise
from typing import TypeVar

import numpy as np

from ftdrive.errors import PlanRefused
from ftdrive.planning.approach import plan_approach
from ftdrive.planning.geometry.arm_model import SHAPES, ArmModel, Bodies, Cylinder
from ftdrive.planning.geometry.certify import Certifier
from ftdrive.planning.geometry.scene import BASE_PLANE, Box, Plane, Scene
from ftdrive.planning.motion import Speeds
from ftdrive.planning.plan import Plan
from ftdrive.planning.planner import USUAL_POSTURE_RAD, _plan_box, _plan_cone, guess_of, plan_tour
from ftdrive.planning.search.nodes import constant_tour
from ftdrivers.ur.kinematics import Array
from tests.benchmarks.common import show

MODELS = ("UR3e", "UR5e", "UR10e", "UR16e", "UR20", "UR30")
TOOLS = {
    "150 x 100": (Cylinder(0, 0.15, 0.1),),
    "200 x 100": (Cylinder(0, 0.2, 0.1),),
    "250 x 100": (Cylinder(0, 0.25, 0.1),),
    "150 from 50": (Cylinder(0, 0.05, 0.08), Cylinder(0.05, 0.2, 0.15)),
}
LUMP = (Cylinder(0, 0.2, 0.1), Cylinder(0.05, 0.1, 0.03, 0.06, 0.0))
FIXED_POINTS_M = {"UR3e": (0.283, 0.283, 0.3), "UR5e": (0.3, 0.52, 0.5), "UR10e": (0.742, 0.742, 0.55)}
"""Flange points at which all 24 orientations have a free posture."""
T = TypeVar("T")


def timed(make: Callable[[], T]) -> tuple[T, float]:
    """Give a result and the wall time it took, seconds."""
    begin = time.perf_counter()
    result = make()
    return result, time.perf_counter() - begin


def judged(*checks: bool) -> str:
    """Say in a word whether all targets are met."""
    return "pass" if all(checks) else "FAIL"


def certifier_of(model: str, tool: tuple[Cylinder, ...] = TOOLS["200 x 100"], scene: Scene | None = None) -> Certifier:
    return Certifier(ArmModel(model, tool), scene or Scene())


def constant_tours() -> None:
    """Every model with every tool at the usual posture."""
    show("Constant tour         certified  largest  60 deg/s  <= 250 mm/s  clearance   ball     check")
    show("target                 24 of 24  <= 90.1   <= 54.1       <= 62      > 20 mm           <= 50 ms")
    for model in MODELS:
        for name, tool in TOOLS.items():
            certifier = certifier_of(model, tool)
            q = constant_tour(USUAL_POSTURE_RAD)
            following = np.roll(q, -1, axis=0)
            checks = [timed(partial(certifier.certify, q, following, tight=False))[1] for _ in range(7)]
            fast, slow = (
                plan_tour(certifier, speeds=Speeds(tip_m_s=limit), guess=guess_of(certifier)) for limit in (None, 0.25)
            )
            one, two = fast.to_dict(), slow.to_dict()
            clear = 24 - one["uncertified_segments"]
            check_ms = 1e3 * float(np.median(checks))
            word = judged(
                one["kind"] == "constant",
                clear == 24,
                one["max_move_deg"] <= 90.1,
                one["motion_time_s"] <= 54.1,
                two["motion_time_s"] <= 62,
                two["min_clearance_mm"] > 20,
                check_ms <= 50,
            )
            figures = (
                f"{clear:2d} of 24   {one['max_move_deg']:5.1f}     {one['motion_time_s']:5.1f}",
                f"{two['motion_time_s']:5.1f}     {two['min_clearance_mm']:5.1f} mm   {two['ball_m']:.2f} m",
                f"{check_ms:3.0f} ms  {word}",
            )
            show(f"{model:6s} {name:12s}    {'       '.join(figures[:2])}   {figures[2]}")


def searches() -> None:
    """Posture search, free box and cones, with the wall time of planning."""
    show("\nPlans that are searched   planning     target   kind       motion  clearance  error of compensation")
    stretched = USUAL_POSTURE_RAD.copy()
    stretched[1:3] = np.radians([-30, 20])
    for model in MODELS:
        certifier = certifier_of(model)
        guess = guess_of(certifier)
        row(f"{model:6s} posture search", 3, partial(plan_tour, certifier, stretched, speeds=Speeds(), guess=guess))
    for model, point in FIXED_POINTS_M.items():
        certifier = certifier_of(model)
        guess = guess_of(certifier)
        for half in (0.0, 0.1):
            row(
                f"{model:6s} box +-{1e3 * half:3.0f} mm",
                5,
                partial(_plan_box, certifier, half_size_m=half, centre_m=point, speeds=Speeds(), guess=guess),
            )
    for model, tool, deg in [("UR3e", TOOLS["200 x 100"], deg) for deg in (30, 60, 90, 180)] + [
        ("UR5e", TOOLS["200 x 100"], 60),
        ("UR20", TOOLS["200 x 100"], 60),
        ("UR5e", LUMP, 60),
    ]:
        certifier = certifier_of(model, tool)
        guess = guess_of(certifier)
        lump = " lump" if len(tool) > 1 else ""
        row(
            f"{model:6s} cone {deg:3d} deg{lump}",
            5,
            partial(_plan_cone, certifier, half_angle_rad=np.radians(deg), speeds=Speeds(), guess=guess),
        )


def row(name: str, target_s: float, make: Callable[[], Plan]) -> None:
    """Plan, and show what came out."""
    plan, took_s = timed(make)
    document = plan.to_dict()
    show(
        f"{name:24s}  {took_s:5.2f} s   <= {target_s:.0f} s   {plan.kind:9s}  {document['motion_time_s']:5.1f} s  "
        f"{document['min_clearance_mm']:5.1f} mm   {document['predicted_sigma']['force_rms_N']:.3f} N  "
        f"{judged(took_s <= target_s, plan.certified)}"
    )


def random_plans(wanted: int) -> None:
    """Plans of all kinds at random postures in random cells; every move sampled at 0.5 degrees."""
    rng = np.random.default_rng(0)
    made, refused, below, within = 0, 0, 0, 0
    kinds: dict[str, int] = {}
    least, sampled = np.inf, np.inf
    for certifier, q, make in cells(rng):
        if made == wanted:
            break
        try:
            plan = make()
            tour = np.array([step.q_rad for step in plan.steps])
            ends = np.vstack([tour, tour[:1]])
            if certifier.free(q)[0]:
                ends = np.vstack([q, plan_approach(certifier, q, tour[0], Speeds.first_run()).q_rad, ends[1:]])
        except PlanRefused:
            refused += 1
            continue
        made += 1
        kinds[plan.kind] = kinds.get(plan.kind, 0) + 1
        for start, end in pairwise(ends):
            share = np.linspace(0, 1, int(np.ceil(np.degrees(np.abs(end - start).max()) / 0.5)) + 2)[:, None]
            below += not certifier.free((1 - share) * start + share * end).all()
        stated = min(step.clearance_m for step in plan.steps)
        least = min(least, stated)
        # Another way to the distances, at a few places: points all over the surfaces.
        start, end = ends[:-1], ends[1:]
        places = start + rng.random((len(start), 1)) * (end - start)
        found = surface_distance(certifier, places)
        sampled = min(sampled, found)
        within += found <= 0
    words = ", ".join(f"{count} {kind}" for kind, count in sorted(kinds.items()))
    show(f"\n{made} plans ({words}), {refused} refused")
    show(f"moves with a sample below a margin   {below:4d}   target 0   {judged(below == 0)}")
    show(f"plans with a point inside a body     {within:4d}   target 0   {judged(within == 0)}")
    show(f"smallest stated clearance {1e3 * least:.1f} mm, smallest between points of surfaces {1e3 * sampled:.1f} mm")


def cells(rng: np.random.Generator) -> Iterator[tuple[Certifier, Array, Callable[[], Plan]]]:
    """Give random cells without end, where the arm stands in them, and what to plan there."""
    models, tools = sorted(SHAPES), [*TOOLS.values(), LUMP]
    k = 0
    while True:
        k += 1
        x, y, high = rng.uniform(-1, 1), rng.uniform(-1, 1), rng.uniform(0.1, 1.0)
        wall = Plane((0.0, 1.0, 0.0), -rng.uniform(0.5, 1.5))
        crowded = Scene((BASE_PLANE, wall), (Box((x, y, 0.0), (x + 0.2, y + 0.2, high)),))
        model, tool = models[rng.integers(len(models))], tools[rng.integers(len(tools))]
        certifier = certifier_of(model, tool, crowded if k % 2 else Scene())
        q = USUAL_POSTURE_RAD + np.concatenate([rng.uniform(-0.6, 0.6, 3), rng.uniform(-1, 1, 3)])
        poses, half_angle = int(rng.choice([24, 12, 6])), rng.uniform(0.3, 2.5)
        guess = guess_of(certifier)
        if k % 10 == 0:
            make = partial(_plan_cone, certifier, q, poses, half_angle_rad=half_angle, speeds=Speeds(), guess=guess)
        elif k % 10 == 1:
            make = partial(_plan_box, certifier, q, poses, half_size_m=0.15, speeds=Speeds(), guess=guess)
        else:
            make = partial(plan_tour, certifier, q, poses, speeds=Speeds(), guess=guess)
        yield certifier, q, make


def surface_distance(certifier: Certifier, q_rad: Array) -> float:
    """Smallest distance of points on one body to another, and to planes and boxes, at joint vectors (n, 6)."""
    bodies = certifier.arm.bodies(q_rad)
    points = surface_points(bodies)
    least = np.inf
    for a, b in certifier.arm.pairs:
        for one, other in ((int(a), int(b)), (int(b), int(a))):
            least = min(least, point_distance(points[:, one], bodies, other).min())
    moving = points[:, certifier.arm.moved_by > 0].reshape(-1, 3)
    for plane in certifier.scene.planes:
        least = min(least, (moving @ np.array(plane.normal) - plane.offset_m).min())
    for box in certifier.scene.boxes:
        outside = moving - np.clip(moving, box.low_m, box.high_m)
        least = min(least, np.linalg.norm(outside, axis=1).min())
    return float(least)


def surface_points(bodies: Bodies) -> Array:
    """Points (n, k, p, 3) all over the surface of bodies (n, k), rounding included."""
    helper = np.where(np.abs(bodies.axis[..., :1]) < 0.7, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    x = np.cross(bodies.axis, helper)
    x /= np.linalg.norm(x, axis=2)[..., None]
    y = np.cross(bodies.axis, x)
    turn = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    around = np.cos(turn)[:, None] * x[..., None, :] + np.sin(turn)[:, None] * y[..., None, :]  # (n, k, 24, 3)
    half, radius, rounding = bodies.half_length_m, bodies.radius_m, bodies.rounding_m
    rings = []
    for share in np.linspace(-1, 1, 9):
        rings.append(((share * half)[:, None], (radius + rounding)[:, None]))
    for sign in (-1, 1):
        for lift in (np.pi / 8, np.pi / 4, 3 * np.pi / 8, np.pi / 2):
            height, reach = half + rounding * np.sin(lift), radius + rounding * np.cos(lift)
            rings.append(((sign * height)[:, None], reach[:, None]))
        rings += [((sign * (half + rounding))[:, None], (share * radius)[:, None]) for share in (0.0, 0.5)]
    centre, axis = bodies.centre_m[:, :, None], bodies.axis[:, :, None]
    return np.concatenate([centre + h[..., None] * axis + r[..., None] * around for h, r in rings], axis=2)


def point_distance(points: Array, bodies: Bodies, body: int) -> Array:
    """Distance (n, p) of points (n, p, 3) to one body; not above zero inside."""
    away = points - bodies.centre_m[:, None, body]
    along = np.einsum("npi,ni->np", away, bodies.axis[:, body])
    across = np.sqrt(np.maximum((away**2).sum(axis=2) - along**2, 0))
    outside = np.hypot(
        np.maximum(np.abs(along) - bodies.half_length_m[body], 0), np.maximum(across - bodies.radius_m[body], 0)
    )
    return np.asarray(outside - bodies.rounding_m[body])


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--plans", type=int, default=1000)
    arguments = parser.parse_args()
    constant_tours()
    searches()
    random_plans(arguments.plans)
