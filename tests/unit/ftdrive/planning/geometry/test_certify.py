"""Shapes, their distances, and what the proof of a clear move is worth."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import ArrayLike

from ftdrive.errors import ConfigError
from ftdrive.planning.geometry.arm_model import (
    SHAPES,
    ArmModel,
    Bodies,
    Cylinder,
    separation,
    separation_from_box,
)
from ftdrive.planning.geometry.certify import Certifier, Margins
from ftdrive.planning.geometry.scene import Box, Plane, Scene
from ftdrive.planning.search.nodes import constant_tour
from ftdrivers.ur.kinematics import MODELS as NOMINAL
from ftdrivers.ur.kinematics import Array, Kinematics
from tests.own_kinematics import drawn, real

MODELS = ("UR3e", "UR5e", "UR10e", "UR16e", "UR20", "UR30")
TOOLS = (
    (Cylinder(0, 0.15, 0.1),),
    (Cylinder(0, 0.2, 0.1),),
    (Cylinder(0, 0.25, 0.1),),
    (Cylinder(0, 0.05, 0.08), Cylinder(0.05, 0.2, 0.15)),
)
STANDS = np.radians([45, -100, 60, -50, 90, 45])


def clearances(certifier: Certifier, q_rad: ArrayLike) -> tuple[Array, Array]:
    """Smallest distances (n,) within arm and tool, and to the scene, at joint vectors (n, 6)."""
    q, n_self = np.reshape(q_rad, (-1, 6)), len(certifier._pairs)
    row, pair = (index.ravel() for index in np.indices((len(q), len(certifier._margin_m))))
    distance = certifier._distance(q, row, pair, np.full(len(row), np.inf)).reshape(len(q), -1)
    return distance[:, :n_self].min(axis=1), distance[:, n_self:].min(axis=1, initial=np.inf)


def one(centre: tuple[float, float, float], axis: Array, half_length: float, radius: float, rounding: float) -> Bodies:
    sizes = (np.array([size]) for size in (half_length, radius, rounding))
    return Bodies(np.array([centre]), axis[None] / np.linalg.norm(axis), *sizes)


def surface(body: Bodies) -> Array:
    """Points (n, 3) on the rims and caps of a body without its rounding."""
    axis = body.axis[0]
    across = np.linalg.svd(axis[None])[2][1:]
    turn = np.linspace(0, 2 * np.pi, 31)
    rim = np.column_stack([np.cos(turn), np.sin(turn)]) @ across
    along = np.linspace(-1, 1, 11)[:, None] * body.half_length_m * axis
    side = (along[:, None] + body.radius_m * rim).reshape(-1, 3)
    caps = [(sign * body.half_length_m * axis + r * body.radius_m * rim) for sign in (-1, 1) for r in (0, 0.3, 0.6)]
    return np.asarray(np.concatenate([side, *caps]) + body.centre_m[0])


coordinate = st.floats(-0.4, 0.4)
direction = st.tuples(coordinate, coordinate, coordinate).map(np.array).filter(lambda v: np.linalg.norm(v) > 0.05)
size = st.floats(0.02, 0.2)


@pytest.mark.slow
@given(st.tuples(coordinate, coordinate, coordinate), direction, size, size, direction, size, size)
def test_separation_is_close_below_the_distance_of_the_surfaces(
    centre: tuple[float, float, float], axis: Array, l1: float, r1: float, other: Array, l2: float, r2: float
) -> None:
    a, b = one(centre, axis, l1, r1, 0.01), one((0.0, 0.0, 0.0), other, l2, r2, 0.0)
    gap = surface(a)[:, None] - surface(b)
    sampled = float(np.sqrt((gap**2).sum(axis=2)).min()) - 0.01
    found = float(separation(a, b, np.array([np.inf]))[0])
    assert found <= sampled + 1e-9
    if found > 0.02:  # apart; the samples are up to 40 mm apart themselves
        assert found > sampled - 0.04


@given(st.tuples(coordinate, coordinate, coordinate), direction, size)
def test_separation_from_a_box_and_a_plane_is_below_the_distance_of_the_surface(
    centre: tuple[float, float, float], axis: Array, radius: float
) -> None:
    body = one(centre, axis, 0.1, radius, 0.02)
    low, high = np.array([0.1, 0.1, 0.1]), np.array([0.3, 0.5, 0.2])
    points = surface(body)
    to_box = float(np.linalg.norm(points - np.clip(points, low, high), axis=1).min()) - 0.02
    found = float(separation_from_box(body, low, high, np.array([np.inf]))[0])
    assert found <= to_box + 1e-9
    if to_box > 0.1:
        assert found > to_box - 0.03
    height = float(body.height_above(np.array([0.0, 0.6, 0.8]), -0.3)[0])
    sampled = float((points @ [0.0, 0.6, 0.8]).min()) + 0.3 - 0.02
    assert sampled - 0.01 < height <= sampled + 1e-9


OWN = [(model, None) for model in SHAPES] + [(model, drawn(model, seed)) for model in SHAPES for seed in (0, 1)]
OWN += [one for one in real().values() if one[0] in SHAPES]
LUMPY = [Cylinder(0, 0.2, 0.1), Cylinder(0.05, 0.1, 0.04, 0.08, -0.03)]


@pytest.mark.parametrize(("model", "kinematics"), OWN[::5])
def test_everything_the_wrist_moves_stays_in_the_ball(model: str, kinematics: Kinematics | None) -> None:
    arm = ArmModel(model, LUMPY, kinematics)
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (200, 6))
    bodies, centre_m = arm.bodies(q), arm.frames(q).wrist_m
    beyond = np.flatnonzero(arm.moved_by > 4)
    for sign in (-1, 1):
        end = bodies.centre_m + sign * bodies.half_length_m[:, None] * bodies.axis
        away = np.linalg.norm(end - centre_m[:, None], axis=2) + bodies.radius_m * 0.5  # of an end, not of its rim
        assert away[:, beyond].max() < arm.ball_m


@pytest.mark.parametrize(("model", "kinematics"), OWN[::5])
def test_no_point_of_arm_or_tool_moves_faster_than_its_bound(model: str, kinematics: Kinematics | None) -> None:
    arm = ArmModel(model, LUMPY, kinematics)
    rng = np.random.default_rng(0)
    q, step = rng.uniform(-np.pi, np.pi, (50, 6)), 1e-5
    for joint in range(6):
        before, after = arm.bodies(q), arm.bodies(q + step * np.eye(6)[joint])
        for sign in (-1, 1):
            ends = [bodies.centre_m + sign * bodies.half_length_m[:, None] * bodies.axis for bodies in (before, after)]
            moved = np.linalg.norm(ends[1] - ends[0], axis=2).max(axis=0) / step
            assert (moved <= arm.travel_m[:, joint] + 1e-4).all()


FAR_POINTS_MM = {
    "UR3e": [
        ("upper arm", 2, (63, -9, -44)),
        ("forearm", 3, (66, -5, -38)),
        ("forearm", 3, (77, 31, 212)),
        ("wrist 1", 4, (-3, 27, -44)),
        ("wrist 2", 5, (28, 4, -40)),
    ],
    "UR5e": [
        ("upper arm", 2, (209, 0, 369)),
        ("upper arm", 2, (60, -24, 372)),
        ("forearm", 3, (60, 29, -51)),
        ("forearm", 3, (60, 48, -33)),
        ("wrist 1", 4, (-4, -31, -55)),
        ("wrist 2", 5, (32, -11, -51)),
    ],
}
"""Points of meshes on lids and edges: along the lift axis (of wrist 2: axis 5), across, and along the limb, from the
joint that moves it (of wrists: from the centre of the joint they carry)."""


@pytest.mark.parametrize("model", FAR_POINTS_MM)
def test_lids_and_edges_of_the_meshes_are_inside(model: str) -> None:
    arm = ArmModel(model, TOOLS[0])
    at, bodies = arm.frames(STANDS), arm.bodies(STANDS)
    axes = {
        2: (at.shoulder_m, at.lift, at.elbow_m - at.shoulder_m),
        3: (at.elbow_m, at.lift, at.forearm_end_m - at.elbow_m),
        4: (at.wrist_m, at.lift, at.axis_5),
        5: (at.wrist_2_m, at.axis_5, at.R_base_flange[:, :, 2]),
    }
    for name, moved_by, point_mm in FAR_POINTS_MM[model]:
        origin, x, along = (value[0] for value in axes[moved_by])
        z = along / np.linalg.norm(along)
        point = origin + np.array(point_mm) / 1e3 @ np.stack([x, np.cross(z, x), z])
        own = np.flatnonzero(arm.moved_by == moved_by)
        away = point - bodies.centre_m[0, own]
        height = (away * bodies.axis[0, own]).sum(axis=1)
        across = np.linalg.norm(away - height[:, None] * bodies.axis[0, own], axis=1)
        beyond = np.abs(height) - bodies.half_length_m[own], across - bodies.radius_m[own]
        outside = np.hypot(*np.maximum(beyond, 0)) - bodies.rounding_m[own]
        assert outside.min() < 0.001, (name, point_mm)


@pytest.mark.slow
def test_certified_moves_are_clear_where_they_are_sampled_and_others_are_not_called_clear() -> None:
    rng = np.random.default_rng(3)
    some_clear, some_not = 0, 0
    for model in MODELS:
        box = Box((0.3, -0.6, -0.1), (0.7, 0.0, 0.4))
        scene = Scene(planes=(*Scene().planes, Plane((0.0, -1.0, 0.0), -0.7)), boxes=(box,))
        certifier = Certifier(ArmModel(model, TOOLS[rng.integers(4)]), scene)
        start = STANDS + rng.uniform(-1.2, 1.2, (6, 6))
        end = start + rng.uniform(-1.2, 1.2, (6, 6))
        certificate = certifier.certify(start, end)
        for i, clear in enumerate(certificate.clear):
            n = int(np.degrees(np.abs(end[i] - start[i]).max()) / 0.5) + 2
            share = np.linspace(0, 1, n)[:, None]
            within, outside = (c.min() for c in clearances(certifier, (1 - share) * start[i] + share * end[i]))
            if clear:
                some_clear += 1
                assert within > 0.02 - 1e-6
                assert outside > 0.03 - 1e-6
                assert certificate.clearance_m[i] <= min(within, outside) + 1e-5
            elif within < 0.02 or outside < 0.03:
                some_not += 1
            else:  # refused without a sample that says so: only a graze of the margin
                assert min(within - 0.02, outside - 0.03) < 0.012
    assert some_clear > 3
    assert some_not > 3


@pytest.mark.parametrize(("model", "own"), [one for one in real().values() if one[0] in SHAPES])
def test_a_nominal_arm_keeps_as_much_more_distance_as_a_real_one_can_be_nearer(model: str, own: Kinematics) -> None:
    """To the scene all of it; to itself, the margin between its parts is three times that."""
    real_arm, nominal = (Certifier(ArmModel(model, TOOLS[2], k), Scene()) for k in (own, None))
    q = np.random.default_rng(3).uniform(-2, 2, (100, 6))
    row, pair = (index.ravel() for index in np.indices((len(q), len(nominal._margin_m))))
    far = np.full(len(row), np.inf)
    nearer = nominal._distance(q, row, pair, far) - real_arm._distance(q, row, pair, far)
    of_scene = pair >= len(nominal._pairs)
    more = nominal._margin_m - real_arm._margin_m
    assert (nearer <= more[pair])[of_scene].all()
    touching = nominal._distance(q, row, pair, far) <= 0
    assert nearer[~of_scene & ~touching].max() < 0.01


def test_a_thin_post_between_two_poses_is_not_missed() -> None:
    arm = ArmModel("UR5e", TOOLS[1])
    start, end = STANDS.copy(), STANDS.copy()
    start[0] -= 1.0
    end[0] += 1.0
    tip = arm.frames(STANDS)
    at = tip.flange_m[0] + 0.1 * tip.R_base_flange[0, :, 2]
    post = Box(tuple(at - 0.002), tuple(at + 0.002))
    certifier = Certifier(arm, Scene(boxes=(post,)))
    assert certifier.free([start, end]).all()
    assert not certifier.certify(start, end).clear[0]
    assert Certifier(arm, Scene()).certify(start, end).clear[0]


@pytest.mark.parametrize("tight", [True, False])
@pytest.mark.parametrize(("room_m", "clear"), [(-1e-4, False), (5e-4, True)])
def test_the_bound_holds_where_a_point_comes_as_fast_as_it_can(room_m: float, clear: bool, tight: bool) -> None:
    """Stretched out level, joint 2 alone turns: the tip comes up to a block at nearly lever times rate."""
    arm = ArmModel("UR5e", [Cylinder(0, 0.2, 0.01)], NOMINAL["UR5e"])

    def tip(q: Array) -> Array:
        at = arm.frames(q)
        return np.asarray(at.flange_m[0] + 0.2 * at.R_base_flange[0, :, 2])

    def below(gap_m: float) -> Certifier:
        x, y, z = tip(end)
        block = Box((x - 0.1, y - 0.02, z + gap_m), (x + 0.02, y + 0.02, z + 0.5))
        return Certifier(arm, Scene(planes=(), boxes=(block,)))

    end = np.array([0, 0, 0, np.radians(-18.5), np.pi / 2, 0])
    end[1] += np.arctan2(tip(end)[2] - arm.kinematics.d_m[0], -tip(end)[0])
    start = end + 0.2 * np.eye(6)[1]  # less than the first interval of the proof
    far, near = (clearances(below(0.05), [q])[1][0] for q in (start, end))
    assert 0.98 < (far - near) / (0.2 * arm.travel_m[-1, 1]) <= 1
    certifier = below(0.05 - near + Margins().scene_m + room_m)
    assert clearances(certifier, [end])[1][0] == pytest.approx(Margins().scene_m + room_m, abs=2e-5)
    assert certifier.certify(start, end, tight=tight).clear[0] is np.bool_(clear)


@pytest.mark.slow
def test_stated_clearance_is_not_above_the_distance_of_points_on_the_surfaces() -> None:
    arm = ArmModel("UR3e", TOOLS[3])
    poses = constant_tour(STANDS)
    following = np.roll(poses, -1, axis=0)
    stated = Certifier(arm, Scene()).certify(poses, following).self_clearance_m.min()
    share = np.random.default_rng(0).random((24, 1))
    bodies = arm.bodies(poses + share * (following - poses))
    least = np.inf
    for place in range(24):
        points = [surface(bodies.at(np.array([place]), np.array([k]))) for k in range(len(arm.names))]
        for a, b in arm.pairs:
            gap = np.sqrt(((points[a][::3, None] - points[b][::3]) ** 2).sum(axis=2)).min()
            least = min(least, gap - bodies.rounding_m[a] - bodies.rounding_m[b])
    assert 0.02 < stated <= least < stated + 0.04


@pytest.mark.parametrize("model", ["UR15", "Panda"])
def test_an_arm_of_unknown_shape_is_refused(model: str) -> None:
    with pytest.raises(ConfigError, match=model):
        ArmModel(model, TOOLS[0])


@pytest.mark.parametrize("sizes", [(0.1, 0.1, 0.1), (-0.01, 0.1, 0.1), (0, 0.1, 0), (0, np.nan, 0.1)])
def test_a_cylinder_that_cannot_be_is_refused(sizes: tuple[float, float, float]) -> None:
    with pytest.raises(ConfigError, match="cylinder of the tool"):
        Cylinder(*sizes)


def test_a_tool_of_nothing_is_refused() -> None:
    with pytest.raises(ConfigError, match="tool is empty"):
        ArmModel("UR5e", [])


def along(axis: str, centre: tuple[float, float, float], half_m: float, radius_m: float, rounding_m: float) -> Bodies:
    return one(centre, np.eye(3)["xyz".index(axis)], half_m, radius_m, rounding_m)


@pytest.mark.slow
@given(st.integers(0, 2**32 - 1))
def test_what_is_too_near_is_named_just_where_a_posture_is_not_free(seed: int) -> None:
    rng = np.random.default_rng(seed)
    scene = Scene(
        (Plane((0.0, 0.0, 1.0), 0.0), Plane((-1.0, 0.0, 0.0), -0.5)), (Box((0.2, 0.2, 0.0), (0.4, 0.4, 0.4)),)
    )
    certifier = Certifier(ArmModel("UR5e", TOOLS[3]), scene)
    q = rng.uniform(-np.pi, np.pi, 6)
    pairs = certifier.too_near(q)
    assert bool(pairs) != certifier.free(q)[0]
    known = {*certifier.arm.names, "plane 1", "plane 2", "box 1"}
    assert all(set(pair) <= known for pair in pairs)
    for name, alone in (("plane 2", Scene((scene.planes[1],))), ("box 1", Scene((), scene.boxes))):
        own = Certifier(certifier.arm, alone).too_near(q)
        assert {body for body, thing in pairs if thing == name} == {a for a, b in own if b in ("plane 1", "box 1")}
