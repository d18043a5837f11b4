"""Measure the constant tour against the convex hulls of collision meshes, with a foreign library.

Distances come from `coal`, the placing of the links from a URDF by code of its own: of the planner nothing is used but
the joint angles of the tour. Needs `coal` (PyPI), and a URDF with the meshes in the folder beside its own, such as
those of `example-robot-data` (PyPI): share/example-robot-data/robots/ur_description/urdf/ur5_robot.urdf. That package
has the older UR3, UR5 and UR10 only. `--stretch` places their hulls by the lengths of an arm that is planned for. As
they are, the hulls of their forearm and wrist 2 are never more than 16 to 20 mm apart, whatever the angles.

Run: python tests/benchmarks/mesh_check.py --urdf .../ur5_robot.urdf [--stretch UR5e] [--tool 0:200:100]
"""

import argparse
import importlib
import sys
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from drivers.ur.kinematics import MODELS, forward
from ftdrive.planning.constant_tour import constant_tour
from ftdrive.planning.planner import USUAL_POSTURE_RAD

coal: Any = importlib.import_module("coal")
TARGET_MM = 15.0
STEP_DEG = 1.0
FITS_M = 0.002
CHAIN = ("base_link", "shoulder_link", "upper_arm_link", "forearm_link", "wrist_1_link", "wrist_2_link", "wrist_3_link")
TOOL = "tool"
HELD_APART = {
    ("base_link", "upper_arm_link"),
    ("shoulder_link", "forearm_link"),
    ("wrist_1_link", "wrist_3_link"),
    ("wrist_2_link", TOOL),
}
"""No turn of the joint between them brings them together."""
Joints = list[tuple[Any, Any]]
"""Fixed transform (4, 4) and axis (3,) of each joint along the chain; the last one leads to the flange and is fixed."""


def main() -> None:
    """Print the smallest distance of every pair of links that are no neighbours."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--urdf", type=Path, required=True)
    parser.add_argument("--stretch", choices=sorted(MODELS), help="place the links by the lengths of this model")
    parser.add_argument("--tool", default="0:200:100", help="from:to:diameter in mm from the flange")
    arguments = parser.parse_args()
    joints, hulls = read(arguments.urdf)
    if arguments.stretch:
        stretch(joints, arguments.stretch)
    model = arguments.stretch or arguments.urdf.name.partition("_")[0].upper()
    ours = forward(MODELS[model], USUAL_POSTURE_RAD).p_m
    theirs = place(joints, USUAL_POSTURE_RAD)[TOOL][:3, 3]
    # The axes of a URDF's base are turned by 180 degrees about z.
    sys.stdout.write(
        f"{model}: flange of the URDF {1e3 * np.linalg.norm(theirs - ours * [-1, -1, 1]):.2f} mm from ours\n"
    )
    low, high, diameter = (float(value) / 1e3 for value in arguments.tool.split(":"))
    hulls[TOOL] = [coal.Cylinder(diameter / 2, high - low)]
    tour = constant_tour(USUAL_POSTURE_RAD)
    share = np.linspace(0, 1, int(np.ceil(90 / STEP_DEG)), endpoint=False)[:, None, None]
    path = ((1 - share) * tour + share * np.roll(tour, -1, axis=0)).reshape(-1, 6)
    order = (*CHAIN, TOOL)
    pairs = [(a, b) for i, a in enumerate(order) for b in order[i + 2 :]]
    found = np.empty((len(path), len(pairs)))
    for row, q in zip(found, path, strict=True):
        poses = place(joints, q)
        poses[TOOL] = poses[TOOL] @ moved(2, (low + high) / 2)
        row[:] = [min(distance_m(x, poses[a], y, poses[b]) for x in hulls[a] for y in hulls[b]) for a, b in pairs]
    smallest = 1e3 * found.min(axis=0)
    judged = [i for i, (a, b) in enumerate(pairs) if (a, b) not in HELD_APART]
    for i in sorted(range(len(pairs)), key=lambda i: smallest[i])[:8]:
        note = "" if i in judged else "   (held apart by the build, not judged)"
        sys.stdout.write(f"{smallest[i]:7.1f} mm  {' - '.join(pairs[i])}{note}\n")
    least = smallest[judged].min()
    verdict = "pass" if least >= TARGET_MM else "FAIL"
    sys.stdout.write(f"smallest at {len(path)} places: {least:.1f} mm (target {TARGET_MM:.0f} mm)  {verdict}\n")


def read(urdf: Path) -> tuple[Joints, dict[str, list[Any]]]:
    """Joints along the chain, and the hulls of the links."""
    root: Any = ET.parse(urdf).getroot()
    by_child = {joint.find("child").get("link"): joint for joint in root.findall("joint")}
    joints = []
    for child in (*CHAIN[1:], "tool0"):
        axis = by_child[child].find("axis")
        turns = np.zeros(3) if axis is None else np.array([float(value) for value in axis.get("xyz").split()])
        joints.append((transform(by_child[child].find("origin")), turns))
    hulls: dict[str, list[Any]] = {}
    for link in root.findall("link"):
        if link.get("name") in CHAIN:
            hulls[str(link.get("name"))] = [hull_of(urdf, collision) for collision in link.findall("collision")]
    return joints, hulls


def hull_of(urdf: Path, collision: Any) -> Any:
    """Convex hull of a binary STL."""
    name = collision.find("geometry/mesh").get("filename").split("/meshes/")[1]
    data = (urdf.parent.parent / "meshes" / name).read_bytes()
    count = int.from_bytes(data[80:84], "little")
    kind = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("pad", "<u2")])
    facets = np.frombuffer(data[84:], dtype=kind, count=count)
    corners = facets["corners"].reshape(-1, 3).astype(float)
    at = transform(collision.find("origin"))
    corners = corners @ at[:3, :3].T + at[:3, 3]
    corners = corners[ConvexHull(corners).vertices]
    points = coal.StdVec_Vec3s()
    for corner in corners:
        points.append(corner)
    return coal.Convex.convexHull(points, False, None)


def transform(origin: Any) -> Any:
    """Read a URDF origin as (4, 4)."""
    X = np.eye(4)
    if origin is not None:
        X[:3, :3] = Rotation.from_euler("xyz", [float(v) for v in origin.get("rpy", "0 0 0").split()]).as_matrix()
        X[:3, 3] = [float(v) for v in origin.get("xyz", "0 0 0").split()]
    return X


def moved(axis: int, by_m: float) -> Any:
    """Transform that moves along an axis."""
    X = np.eye(4)
    X[axis, 3] = by_m
    return X


def place(joints: Joints, q_rad: Any) -> dict[str, Any]:
    """Pose of every link and, as the tool's, of the flange."""
    pose, poses = np.eye(4), {CHAIN[0]: np.eye(4)}
    for name, (fixed, axis), angle in zip((*CHAIN[1:], TOOL), joints, (*q_rad, 0.0), strict=True):
        turn = np.eye(4)
        turn[:3, :3] = Rotation.from_rotvec(angle * axis).as_matrix()
        pose = pose @ fixed @ turn
        poses[name] = pose
    return poses


def stretch(joints: Joints, model: str) -> None:
    """Put the lengths of another model into the joints' transforms."""
    g = MODELS[model]
    if max(abs(joints[2][0][2, 3] + g.a2_m), abs(joints[3][0][2, 3] + g.a3_m)) > FITS_M:
        raise SystemExit(f"upper arm and forearm of the {model} have other lengths than the hulls: they do not fit")
    # d4 is spread over three joints: the two offsets along the lift axis stay, wrist 1 takes the rest.
    offsets = joints[1][0][1, 3] + joints[2][0][1, 3]
    lengths = (
        (0, 2, g.d1_m),
        (2, 2, -g.a2_m),
        (3, 2, -g.a3_m),
        (4, 1, g.d4_m - offsets),
        (5, 2, g.d5_m),
        (6, 1, g.d6_m),
    )
    for joint, axis, length in lengths:
        joints[joint][0][axis, 3] = length


def distance_m(a: Any, pose_a: Any, b: Any, pose_b: Any) -> float:
    """Distance of two bodies, negative where they overlap."""
    request, result = coal.DistanceRequest(), coal.DistanceResult()
    place_a, place_b = (coal.Transform3s(pose[:3, :3], pose[:3, 3]) for pose in (pose_a, pose_b))
    return float(coal.distance(a, place_a, b, place_b, request, result))


if __name__ == "__main__":
    main()
