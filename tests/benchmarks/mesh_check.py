"""Measure tours, and our shapes of the arm, against the meshes of the arm, with a foreign library.

Distances come from `coal`, the placing of the links from a URDF by code of its own: of the planner nothing is used but
the joint angles of its tours and, to compare, its own distances. A link is the convex hull of its meshes; hulls fill
what is hollow, so the distance of the meshes themselves stands beside theirs.

Install: uv pip install coal airo-models; uv pip install --no-deps compas-fab
  airo-models 0.0.12 (MIT): UR3e and UR5e, airo_models/arms/ur5e/ur5e.urdf.
  compas-fab 2.0.1 (MIT): UR10e, compas_fab/data/robot_library/ur10e_robot/urdf/robot_description.urdf.

Run: python -m tests.benchmarks.mesh_check --urdf .../ur5e.urdf [--tool 0:200:100] [--arm 01] [--plan FILE]

`--arm` places the links as a real arm of that number does, by the file of FTDRIVE_REAL_DATA, and gives the planner its
kinematics. `--plan` checks a plan instead: every distance that it states against the meshes along its move.
"""

import argparse
import importlib
import sys
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from ftdrive.planning.geometry.arm_model import ArmModel, Cylinder
from ftdrive.planning.geometry.certify import Certifier
from ftdrive.planning.geometry.scene import Scene
from ftdrive.planning.motion import Speeds
from ftdrive.planning.plan import Plan
from ftdrive.planning.planner import USUAL_POSTURE_RAD, guess_of, plan_box, plan_cone, plan_tour
from ftdrive.planning.search.nodes import constant_tour
from ftdrivers.ur.kinematics import MODELS, Array, Kinematics, forward
from tests.benchmarks.planning import FIXED_POINTS_M
from tests.own_kinematics import of_dh
from tests.real_arms import RealArm, real_arms

coal: Any = importlib.import_module("coal")
TARGET_M = 0.015
SHAPES_M = 0.001
"""So far the meshes stand out of our shapes at most."""
FOREARM_WRIST_2, BUILD_M = (3, 5), 0.025
"""The planner leaves out the part of wrist 2 along axis 5: so far the build of a UR3e keeps it from the forearm."""
STEP_RAD = np.radians(1.0)
RANDOM = 3000
PARTS = ("base", "shoulder", "upper arm", "forearm", "wrist 1", "wrist 2", "wrist 3", "tool")
TOOL = 7
HELD_APART = {(0, 2), (1, 3), (4, 6), (5, TOOL)}
"""No turn of the joint between them brings them together."""
PAIRS = [(i, j) for i in range(8) for j in range(i + 2, 8) if (i, j) not in HELD_APART]
CRAMPED_RAD = USUAL_POSTURE_RAD + np.radians([0, 70, -40, 0, 0, 0])
"""Where the constant tour has no room: another posture must be searched."""
CONES_RAD = np.radians([60, 90, 180])
Joints = list[tuple[Array, Array]]
"""Fixed transform (4, 4) and axis (3,) of each joint; the last one leads to the flange and is fixed."""
Mesh = tuple[Array, NDArray[np.intp]]
"""Corners (n, 3) in metres, link axes, and the three corners (m, 3) of every facet."""


@dataclass
class Arm:
    """An arm as its URDF has it, with a tool."""

    model: str
    joints: Joints
    links: list[Mesh]
    """Of the seven links."""
    hulls: list[Any]
    """Of the links, then the tool."""
    meshes: list[Any]
    """Of the links, then the tool."""
    tool_m: float
    """From the flange to the middle of the tool."""

    def place(self, q_rad: Array) -> list[Array]:
        """Pose (4, 4) of every link, and of the flange."""
        pose, poses = np.eye(4), [np.eye(4)]
        for (fixed, axis), angle in zip(self.joints, (*q_rad, 0.0), strict=True):
            pose = pose @ fixed @ posed(Rotation.from_rotvec(angle * axis))
            poses.append(pose)
        return poses

    def distances_m(self, bodies: list[Any], q_rad: Array, pairs: list[tuple[int, int]]) -> Array:
        """Distances (p,) of pairs of bodies, zero or less where they overlap."""
        poses = self.place(q_rad)
        poses[TOOL] = poses[TOOL] @ posed(Rotation.identity(), (0, 0, self.tool_m))
        at = [coal.Transform3s(pose[:3, :3], pose[:3, 3]) for pose in poses]
        request = coal.DistanceRequest()
        return np.array(
            [coal.distance(bodies[a], at[a], bodies[b], at[b], request, coal.DistanceResult()) for a, b in pairs]
        )

    def closest(self, q_rad: Array) -> tuple[Array, str, int]:
        """Look for the smallest distances at joint vectors (n, 6).

        Returns
        -------
        hulls_m : array, shape (n,)
            Smallest distance of the hulls at each place.
        words : str
            The smallest of the hulls and of the meshes, with the pair and the verdict.
        place : int
            Where the meshes come closest.
        """
        hulls_m = np.array([self.distances_m(self.hulls, q, PAIRS) for q in q_rad])
        order = np.argsort(hulls_m, axis=None)
        least_m, at = np.inf, order[0]
        for i in order:
            place, pair = divmod(int(i), len(PAIRS))
            if hulls_m[place, pair] >= least_m:  # a mesh is inside its hull
                break
            found_m = self.distances_m(self.meshes, q_rad[place], [PAIRS[pair]])[0]
            if found_m < least_m:
                least_m, at = found_m, i
        words = f"hulls {judged(hulls_m.min(), order[0])}, meshes {judged(least_m, at)}"
        return hulls_m.min(axis=1), words, int(at) // len(PAIRS)


def main() -> None:
    """Check the placing, then the tours, then our shapes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--urdf", type=Path, required=True)
    parser.add_argument("--tool", default="0:200:100", help="from:to:diameter in mm from the flange")
    parser.add_argument("--arm", help="number of a real arm")
    parser.add_argument("--plan", type=Path, nargs="+", default=[])
    arguments = parser.parse_args()
    tool = Cylinder(*(float(value) / 1e3 for value in arguments.tool.split(":")))
    real = next((arm for arm in real_arms() if arm.number == arguments.arm), None)
    if arguments.arm and real is None:
        parser.error(f"there is no arm {arguments.arm}: set FTDRIVE_REAL_DATA")
    arm = read(arguments.urdf, tool, real)
    own = None if real is None else of_dh(real.dh())
    show(f"{arm.model}, meshes of {arguments.urdf}{f', arm {real.number}' if real else ''}")
    placing(arm, own or MODELS[arm.model])
    for path in arguments.plan:
        stated(arm, path)
    if arguments.plan:
        return
    tour(arm, "constant tour", constant_tour(USUAL_POSTURE_RAD, own or MODELS["UR5e"]))
    certifier = Certifier(ArmModel(arm.model, [tool], own), Scene())
    planned(arm, certifier)
    compare(arm, certifier)
    cover(arm, certifier.arm)


def stated(arm: Arm, path: Path) -> None:
    """Check every distance that a plan states along its move, against hulls, and where these are nearer, meshes."""
    plan, over_m = Plan.load(path), []
    q_rad = np.array([step.q_rad for step in plan.steps])
    for step, start, end in zip(plan.steps, q_rad, np.roll(q_rad, -1, axis=0), strict=True):
        claim_m = np.full(len(PAIRS), step.clearance_m)
        claim_m[PAIRS.index(FOREARM_WRIST_2)] = min(step.clearance_m, BUILD_M)
        places = np.linspace(start, end, int(np.ceil(np.abs(end - start).max() / STEP_RAD)) + 1)
        over = claim_m - [arm.distances_m(arm.hulls, q, PAIRS) for q in places]
        for place, pair in np.argwhere(over > 0):  # a hull fills what is hollow
            over[place, pair] = claim_m[pair] - arm.distances_m(arm.meshes, places[place], [PAIRS[pair]])[0]
        over_m.append(float(over.max()))
    least_mm = 1e3 * min(step.clearance_m for step in plan.steps)
    farther_mm, verdict = -1e3 * max(over_m), "pass" if max(over_m) <= SHAPES_M else "FAIL"
    show(
        f"  {path.name}: {plan.kind}, {len(plan.steps)} distances of {least_mm:.1f} mm or more, meshes at least "
        f"{farther_mm:.1f} mm farther apart: {verdict}"
    )


def placing(arm: Arm, kinematics: Kinematics) -> None:
    """Show how far the flange is from ours, and how far neighbours are apart."""
    apart_m = turned_rad = gap_m = 0.0
    # The axes of a URDF's base are turned by 180 degrees about z.
    half_turn = np.diag([-1.0, -1.0, 1.0])
    for q in sampled(constant_tour(USUAL_POSTURE_RAD))[::10]:
        ours, theirs = forward(kinematics, q), arm.place(q)[TOOL]
        apart_m = max(apart_m, float(np.linalg.norm(theirs[:3, 3] - half_turn @ ours.p_m)))
        turned_rad = max(turned_rad, float(Rotation.from_matrix(theirs[:3, :3].T @ half_turn @ ours.R).magnitude()))
        gap_m = max(gap_m, arm.distances_m(arm.meshes, q, [(i, i + 1) for i in range(TOOL)]).max())
    show(f"  flange {1e3 * apart_m:.2f} mm and {np.degrees(turned_rad):.2f} degrees from ours")
    show(f"  neighbours at most {1e3 * gap_m:.1f} mm apart")


def planned(arm: Arm, certifier: Certifier) -> None:
    """Check tours that the planner searches: of another posture, in a box, and in cones."""
    guess, point, speeds = guess_of(certifier), FIXED_POINTS_M.get(arm.model), Speeds()
    plans = [
        *(plan_tour(certifier, CRAMPED_RAD, poses, speeds=speeds, guess=guess) for poses in (24, 12, 6)),
        *(plan_box(certifier, poses=poses, centre_m=point, speeds=speeds, guess=guess) for poses in (24, 12)),
        *(plan_cone(certifier, half_angle_rad=angle, speeds=speeds, guess=guess) for angle in CONES_RAD),
    ]
    for plan in plans:
        clearance_m = min(step.clearance_m for step in plan.steps)
        name = f"{plan.kind}, {len(plan.steps)} poses, {1e3 * clearance_m:.1f} mm certified"
        tour(arm, name, np.array([step.q_rad for step in plan.steps]))


def tour(arm: Arm, name: str, q_rad: Array) -> None:
    """Show the smallest distances along a closed tour."""
    path = sampled(q_rad)
    show(f"  {name}, {len(path)} places: {arm.closest(path)[1]}")


def compare(arm: Arm, certifier: Certifier) -> None:
    """Look at random angles that keep the margin by our shapes."""
    random = np.random.default_rng(1)
    for name, first in (("wrist", 3), ("arm", 0)):
        q = np.tile(USUAL_POSTURE_RAD, (RANDOM, 1))
        q[:, first:] = random.uniform(-np.pi, np.pi, (RANDOM, 6 - first))
        ours_m = certifier.certify(q, q).self_clearance_m
        clear = ours_m >= certifier.margins.self_m
        hulls_m, words, worst = arm.closest(q[clear])
        close = np.sum(hulls_m < TARGET_M)
        show(f"  random {name}: {clear.sum()} of {RANDOM} clear, {close} of them with hulls too close: {words}")
        angles = np.degrees(q[clear][worst]).round(1).tolist()
        show(f"    meshes closest at {angles}, our shapes {1e3 * ours_m[clear][worst]:.1f} mm apart there")


def cover(arm: Arm, ours: ArmModel) -> None:
    """Show how far the meshes stand out of our shapes."""
    bodies, poses = ours.bodies(USUAL_POSTURE_RAD), arm.place(USUAL_POSTURE_RAD)
    show("  meshes out of our shapes, mm:")
    for link, (points_m, _) in enumerate(arm.links):
        points = moved(points_m, poses[link]) * [-1, -1, 1]
        away = np.full(len(points), np.inf)
        for k in np.flatnonzero(ours.moved_by[: -len(ours.tool)] == link):
            offset, axis = points - bodies.centre_m[0, k], bodies.axis[0, k]
            along = offset @ axis
            across = np.linalg.norm(offset - along[:, None] * axis, axis=1)
            beyond = np.abs(along) - bodies.half_length_m[k], across - bodies.radius_m[k]
            away = np.minimum(away, np.hypot(*np.maximum(beyond, 0)) - bodies.rounding_m[k])
        worst = away.argmax()
        at_mm = (1e3 * points_m[worst]).round().astype(int).tolist()
        show(f"    {PARTS[link]:9s} {1e3 * away[worst]:5.1f} at {at_mm} of its axes")


def judged(distance_m: float, index: int) -> str:
    """Say a distance, whose it is (index into places x pairs), and whether it meets the target."""
    a, b = PAIRS[index % len(PAIRS)]
    verdict = "pass" if distance_m >= TARGET_M else f"below {1e3 * TARGET_M:.0f} mm"
    return f"{1e3 * distance_m:.1f} mm ({PARTS[a]}, {PARTS[b]}) {verdict}"


def sampled(q_rad: Array) -> Array:
    """Give joint vectors (n, 6) along a closed tour, the leading joint at most a step apart."""
    parts = []
    for a, b in zip(q_rad, np.roll(q_rad, -1, axis=0), strict=True):
        parts.append(np.linspace(a, b, int(np.ceil(np.abs(b - a).max() / STEP_RAD)), endpoint=False))
    return np.concatenate(parts)


def read(urdf: Path, tool: Cylinder, real: RealArm | None = None) -> Arm:
    """Read the chain from the root to the flange, and the meshes on it; the links of a real arm are in its places."""
    # airo-models uses the prefix drake: without declaring it.
    root: Any = ET.fromstring(urdf.read_text().replace("drake:", "drake_"))
    links = {link.get("name"): link for link in root.findall("link")}
    by_child = {joint.find("child").get("link"): joint for joint in root.iterfind("joint[child]")}
    chain, name = [], "tool0"
    while name in by_child:
        chain.append((by_child[name], name))
        name = by_child[name].find("parent").get("link")
    joints: Joints = []
    found, pose = [meshes_of(urdf, links[name])], np.eye(4)
    for joint, child in reversed(chain):
        turns = joint.get("type") != "fixed"
        pose = pose @ (transform(joint.find("origin")) if real is None or not turns else real.links[len(joints)])
        if turns:
            joints.append((pose, np.array([float(value) for value in joint.find("axis").get("xyz").split()])))
            found.append([])
            pose = np.eye(4)
        found[-1] += [(moved(points, pose), facets) for points, facets in meshes_of(urdf, links[child])]
    joints.append((pose, np.zeros(3)))
    bodies = [joined(meshes) for meshes in found]
    model = {name.lower(): name for name in MODELS}[root.get("name").partition("_")[0]]
    body = coal.Cylinder(tool.diameter_m / 2, tool.to_m - tool.from_m)
    hulls, meshes = [hull_of(points) for points, _ in bodies], [mesh_of(*mesh) for mesh in bodies]
    return Arm(model, joints, bodies, [*hulls, body], [*meshes, body], (tool.from_m + tool.to_m) / 2)


def meshes_of(urdf: Path, link: Any) -> list[Mesh]:
    """Read what is seen of a link, in OBJ files."""
    found = []
    for body in link.findall("visual"):
        # That of airo-models with its cable is 0.4 m long.
        name = body.find("geometry/mesh").get("filename").replace("base_cable_labels", "base")
        path = urdf.parent / name
        if "/meshes/" in name:  # of the ROS package around the folder of the URDF, or beside it
            (folder,) = urdf.parent.parent.glob("**/meshes")
            path = folder / name.split("/meshes/")[1]
        points, facets = read_obj(path.read_bytes())
        found.append((moved(points, transform(body.find("origin"))), facets))
    return found


def read_obj(data: bytes) -> Mesh:
    """Read the corners and faces of an OBJ; a face of more corners becomes a fan."""
    words = [line.split() for line in data.decode().splitlines()]
    points = np.array([line[1:4] for line in words if line[:1] == ["v"]], dtype=float)
    faces = [[int(corner.partition("/")[0]) - 1 for corner in line[1:]] for line in words if line[:1] == ["f"]]
    return points, np.array([(f[0], f[k], f[k + 1]) for f in faces for k in range(1, len(f) - 1)])


def joined(meshes: list[Mesh]) -> Mesh:
    """Join the meshes of a link."""
    starts = np.cumsum([0, *(len(points) for points, _ in meshes)])
    facets = [facets + start for (_, facets), start in zip(meshes, starts, strict=False)]
    return np.concatenate([points for points, _ in meshes]), np.concatenate(facets)


def hull_of(points_m: Array) -> Any:
    """Convex hull of points."""
    return coal.Convex.convexHull(vectors(points_m[ConvexHull(points_m).vertices]), False, None)


def mesh_of(points_m: Array, facets: NDArray[np.intp]) -> Any:
    """Body of facets, hollow inside."""
    triangles = coal.StdVec_Triangle()
    for facet in facets.tolist():
        triangles.append(coal.Triangle(*facet))
    body = coal.BVHModelOBBRSS()
    body.beginModel(len(facets), len(points_m))
    body.addSubModel(vectors(points_m), triangles)
    body.endModel()
    return body


def vectors(points_m: Array) -> Any:
    """Give points as the library takes them."""
    points = coal.StdVec_Vec3s()
    for point in points_m:
        points.append(point)
    return points


def transform(origin: Any) -> Array:
    """Read a URDF origin as (4, 4)."""
    if origin is None:
        return np.eye(4)
    rpy, xyz = ([float(value) for value in origin.get(name, "0 0 0").split()] for name in ("rpy", "xyz"))
    return posed(Rotation.from_euler("xyz", rpy), xyz)


def posed(R: Rotation, p_m: Any = (0, 0, 0)) -> Array:
    """Transform (4, 4) of a rotation and a shift."""
    X = np.eye(4)
    X[:3, :3], X[:3, 3] = R.as_matrix(), p_m
    return X


def moved(points_m: Array, X: Array) -> Array:
    """Move points (n, 3)."""
    return np.asarray(points_m @ X[:3, :3].T + X[:3, 3])


def show(line: str) -> None:
    """Write a line."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
