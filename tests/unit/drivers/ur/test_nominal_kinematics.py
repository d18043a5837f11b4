import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from ftdrivers.ur.kinematics import MODELS, Pose, flange_poses, forward, model_named
from ftmocks import kinematics as emulator
from tests.unit.drivers.ur.controller_in_memory import pose_from_ur

# The constant tour: (number of the orientation, psi, q5, q6) in degrees, psi = q2 + q3 + q4.
TOUR = [
    (1, -90, 90, 45), (19, -180, 45, 90), (12, -180, -45, 90), (8, -180, -45, 0), (16, -180, -45, -90),
    (14, -90, -90, -135), (5, -90, -90, -45), (9, -90, -90, 45), (2, -90, -90, 135), (4, -180, -45, 180),
    (17, -180, 45, 180), (7, -180, 135, 180), (15, -180, 135, 90), (3, -180, 135, 0), (11, -180, 135, -90),
    (20, -180, 45, -90), (18, -180, 45, 0), (10, -90, 90, -45), (6, -90, 90, -135), (24, 0, 135, -90),
    (22, 0, 135, 0), (23, 0, 135, 90), (21, 0, 135, 180), (13, -90, 90, 135),
]  # fmt: skip

pose_lists = st.tuples(
    *[st.floats(-2, 2)] * 3,
    *[st.floats(-1.7, 1.7)] * 3,  # a rotation vector shorter than pi, so that it comes back as it was
).map(list)


def tour_q_deg(psi: float, q5: float, q6: float, q2: float = -100, q3: float = 60) -> list[float]:
    return [45, q2, q3, psi - q2 - q3, q5, q6]


@pytest.mark.parametrize(
    ("model", "centre_m"),
    [("UR3e", (-0.01, -0.20, 0.56)), ("UR5e", (-0.09, -0.28, 0.87)), ("UR10e", (-0.14, -0.39, 1.19))],
)
def test_the_flange_circles_the_documented_centre(model: str, centre_m: tuple[float, float, float]) -> None:
    p = [forward(MODELS[model], np.radians(tour_q_deg(psi, q5, q6))).p_m for _, psi, q5, q6 in TOUR]
    assert np.abs(np.mean(p, axis=0) - centre_m).max() < 0.006  # the document rounds to 10 mm


def test_first_pose_of_the_tour_by_hand() -> None:
    # R_01 is the identity in the paper's Fig. 3: the flange stands parallel to the base.
    R = forward(MODELS["UR5e"], np.radians(tour_q_deg(-90, 90, 45))).R
    assert np.allclose(R, np.eye(3), atol=1e-12)


def test_stretched_ur5e_by_hand() -> None:
    # All joints zero: the arm lies along -x, the wrist offset and the flange point to -y, wrist 2 hangs down.
    pose = forward(MODELS["UR5e"], [0.0] * 6)
    assert np.allclose(pose.p_m, [-0.425 - 0.3922, -0.1333 - 0.0996, 0.1625 - 0.0997], atol=1e-12)
    assert np.allclose(pose.R @ [0, 0, 1], [0, -1, 0], atol=1e-12)


@pytest.mark.parametrize(("long", "a2_a3_m"), [("UR8long", 1.6138), ("UR15", 1.1639), ("UR18", 0.8139)])
def test_stretched_arms_that_are_not_emulated(long: str, a2_a3_m: float) -> None:
    assert np.allclose(forward(MODELS[long], [0.0] * 6).p_m, [-a2_a3_m, -0.3258, 0.0825], atol=1e-12)


def test_every_model_agrees_with_the_emulator_written_apart() -> None:
    q = [0.3, -1.1, 0.7, -0.4, 1.2, 0.5]
    emulated = {**emulator.MODELS, "UR7e": emulator.MODELS["UR5e"], "UR12e": emulator.MODELS["UR10e"]}
    assert set(emulated) == set(MODELS) - {"UR8long", "UR15", "UR18"}
    for name, parameters in emulated.items():
        pose = forward(MODELS[name], q)
        assert np.allclose(np.column_stack([pose.R, pose.p_m]), emulator.forward(parameters, q)[:3], atol=1e-12), name


@given(st.lists(st.tuples(pose_lists, pose_lists), max_size=4))
def test_taking_the_tcp_off_again_gives_the_flange(poses: list[tuple[list[float], list[float]]]) -> None:
    tcps = [pose_from_ur(flange) @ pose_from_ur(tcp) for flange, tcp in poses]
    tcp_poses = np.array([[*tcp.p_m, *Rotation.from_matrix(tcp.R).as_rotvec()] for tcp in tcps]).reshape(-1, 6)
    R, p_m = flange_poses(tcp_poses, np.array([tcp for _, tcp in poses]).reshape(-1, 6))
    assert (R.shape, p_m.shape) == ((len(poses), 3, 3), (len(poses), 3))
    for k, (flange, _) in enumerate(poses):
        assert np.allclose(p_m[k], flange[:3], atol=1e-12)
        assert np.allclose(Rotation.from_matrix(R[k]).as_rotvec(), flange[3:], atol=1e-7)


@given(pose_lists, st.tuples(*[st.floats(-1, 1)] * 3))
def test_a_pose_moves_a_point_like_a_rotation_and_a_shift(pose: list[float], point: tuple[float, float, float]) -> None:
    p = np.array(point)
    moved = (pose_from_ur(pose) @ Pose(np.eye(3), p)).p_m
    assert np.allclose(moved, Rotation.from_rotvec(pose[3:]).apply(p) + pose[:3], atol=1e-12)


@pytest.mark.parametrize(
    ("reported", "major", "name"),
    [
        ("UR5", 5, "UR5e"),
        ("UR5", 3, "UR5"),
        ("ur5e", 5, "UR5e"),
        ("UR10 \n", 5, "UR10e"),
        ("UR30", 5, "UR30"),
        ("UR99", 5, None),
    ],
)
def test_model_names(reported: str, major: int, name: str | None) -> None:
    assert model_named(reported, major) == name
