"""Speeds and durations of moves against the path of the tips that is sampled closely."""

import numpy as np

from ftdrive.planning.geometry.arm_model import ArmModel, Cylinder
from ftdrive.planning.motion import Speeds, durations_s, move_duration_s, speed_of_leading_joint, tips
from ftdrivers.ur.kinematics import Array

ARM = ArmModel("UR5e", [Cylinder(0.0, 0.2, 0.1), Cylinder(0.05, 0.3, 0.03, 0.06, -0.02)])
STANDS = np.radians([45, -100, 60, -50, 90, 45])


def postures(n: int, spread_rad: float) -> Array:
    return STANDS + np.random.default_rng(1).uniform(-spread_rad, spread_rad, (n, 6))


def test_the_leading_joint_is_as_fast_as_the_tips_may_be() -> None:
    speeds, start, end = Speeds(tip_m_s=0.1), postures(6, 0.3), postures(12, 0.3)[6:]
    end[5] = start[5]
    end[4] = start[4] + [0, 0, 0, 0, 0, 0.3]  # so near the axis of wrist 3 that the joint is the limit
    found = speed_of_leading_joint(ARM, start, end, speeds)
    share = np.linspace(0, 1, 2001)[:, None]
    for i in range(4):
        leading = np.abs(end[i] - start[i]).max()
        path = tips(ARM, start[i] + share * (end[i] - start[i]))
        fastest = np.linalg.norm(np.diff(path, axis=0), axis=2).max() * 2000 / leading * found[i]  # m/s
        assert fastest * 1.002 >= 0.1
        assert fastest < 0.1 * 1.02
    np.testing.assert_array_equal(found[4:], speeds.joint_rad_s)
    np.testing.assert_array_equal(speed_of_leading_joint(ARM, start, end, Speeds(tip_m_s=None)), speeds.joint_rad_s)


def test_durations_of_all_moves_are_about_those_of_each() -> None:
    q = postures(8, 0.2)
    i, j = np.triu_indices(8, 1)
    for speeds in (Speeds(tip_m_s=0.1), Speeds(tip_m_s=None), Speeds()):
        found = durations_s(ARM, q, speeds)
        np.testing.assert_array_equal(found, found.T)
        assert not np.diag(found).any()
        speed = speed_of_leading_joint(ARM, q[i], q[j], speeds)
        each = move_duration_s(np.abs(q[i] - q[j]).max(axis=1), speed, speeds.joint_rad_s2)
        np.testing.assert_allclose(found[i, j], each, rtol=0.1)
