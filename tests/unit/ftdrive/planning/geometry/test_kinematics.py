import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ftdrive.planning.geometry.kinematics import frames, inverse, wrist_inverse
from ftdrive.planning.planner import USUAL_POSTURE_RAD
from ftdrive.planning.search.nodes import constant_tour
from ftdrivers.ur.kinematics import MODELS, Array, Kinematics, forward
from tests.own_kinematics import drawn, of_dh, real
from tests.real_arms import RealArm, real_arms

OWN = [drawn(model) for model in MODELS] + [kinematics for _, kinematics in real().values()]

angles = st.lists(st.floats(-np.pi, np.pi), min_size=6, max_size=6)


def random_joints(n: int) -> Array:
    return np.random.default_rng(1).uniform(-np.pi, np.pi, (n, 6))


@pytest.mark.parametrize("model", MODELS)
def test_inverse_agrees_with_an_independent_one(model: str) -> None:
    oracle = getattr(pytest.importorskip("ur_analytic_ik"), model.lower())
    at = frames(MODELS[model], random_joints(100))
    ours = inverse(MODELS[model], at.R_base_flange, at.flange_m)
    for R, p, branches in zip(at.R_base_flange, at.flange_m, ours, strict=True):
        pose = np.block([[R, p[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])
        expected = np.array(oracle.inverse_kinematics(pose)).reshape(-1, 6)
        found = branches[~np.isnan(branches[:, 0])]
        apart = np.abs(np.exp(1j * expected[:, None]) - np.exp(1j * found)).max(axis=2)
        assert len(expected) == len(found)
        assert apart.min(axis=1).max() < 1e-6
        assert apart.min(axis=0).max() < 1e-6


@pytest.mark.parametrize("model", MODELS)
def test_every_branch_of_the_inverse_reaches_the_pose(model: str) -> None:
    q = random_joints(500)
    at = frames(MODELS[model], q)
    branches = inverse(MODELS[model], at.R_base_flange, at.flange_m)
    row, branch = np.nonzero(~np.isnan(branches[:, :, 0]))
    again = frames(MODELS[model], branches[row, branch])
    assert np.abs(again.flange_m - at.flange_m[row]).max() < 1e-9
    assert np.abs(again.R_base_flange - at.R_base_flange[row]).max() < 1e-9
    one_is_the_start = np.nanmin(np.abs(np.exp(1j * branches) - np.exp(1j * q[:, None])).max(axis=2), axis=1)
    assert one_is_the_start.max() < 1e-6


@given(angles)
def test_the_wrist_alone_gives_the_orientation_in_two_ways(q: list[float]) -> None:
    R = frames(MODELS["UR10e"], q).R_base_flange
    found = wrist_inverse(MODELS["UR10e"], q[:3], R)[0]
    assert np.array_equal(found[:, :3], [q[:3], q[:3]])
    assert np.allclose(frames(MODELS["UR10e"], found).R_base_flange, R, atol=1e-7)
    assert found[0, 4] >= 0 >= found[1, 4]


@pytest.mark.parametrize("arm", real_arms(), ids=lambda arm: str(arm.number))
def test_parameters_of_real_arms_give_the_pose_of_their_links(arm: RealArm) -> None:
    kinematics = of_dh(arm.dh())
    for q in random_joints(10):
        pose, X = forward(kinematics, q), arm.flange(q)
        assert np.allclose(pose.R, X[:3, :3], atol=1e-11)
        assert np.allclose(pose.p_m, X[:3, 3], atol=1e-11)


@pytest.mark.parametrize("kinematics", OWN)
def test_newton_reaches_the_poses_of_the_own_chain(kinematics: Kinematics) -> None:
    q = random_joints(100)
    at = frames(kinematics, q)
    branches = inverse(kinematics, at.R_base_flange, at.flange_m)
    row, branch = np.nonzero(~np.isnan(branches[:, :, 0]))
    again = frames(kinematics, branches[row, branch])
    assert np.abs(again.flange_m - at.flange_m[row]).max() < 1e-6
    assert np.abs(again.R_base_flange - at.R_base_flange[row]).max() < 1e-6
    starts = np.abs(np.exp(1j * branches) - np.exp(1j * q[:, None])).max(axis=2)
    assert (np.nan_to_num(starts, nan=9.0).min(axis=1) < 1e-4).mean() > 0.9  # others are nearly stretched out
    wrist = frames(kinematics, wrist_inverse(kinematics, q[0, :3], at.R_base_flange).reshape(-1, 6)).R_base_flange
    assert np.abs(wrist - np.repeat(at.R_base_flange, 2, axis=0)).max() < 1e-9


@pytest.mark.parametrize("kinematics", OWN)
def test_the_constant_tour_has_its_orientations_on_every_arm(kinematics: Kinematics) -> None:
    nominal, own = constant_tour(USUAL_POSTURE_RAD), constant_tour(USUAL_POSTURE_RAD, kinematics)
    assert np.array_equal(own[:, :3], nominal[:, :3])
    assert np.degrees(np.abs(own - nominal).max()) < 3
    wanted = frames(MODELS["UR5e"], nominal).R_base_flange
    assert np.abs(frames(kinematics, own).R_base_flange - wanted).max() < 1e-9
