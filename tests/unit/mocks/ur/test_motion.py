"""How the emulated arm moves: trapezoids on time, no jumps whatever is commanded, one owner at a time."""

import math

import numpy as np
import pytest

from ftmocks.kinematics import MODELS, Vector6, forward, matrix_of, pose_of, rotvec, vector6
from ftmocks.ur.motion import Arm, JointMove, LineMove, Trapezoid

DH = MODELS["UR5e"]
HOME = vector6(np.radians([45, -100, 60, -50, 90, 45]))
DT = 0.002


def run(arm: Arm, dt: float = DT, limit_s: float = 30.0) -> float:
    """Step until the path has ended; return the time it took."""
    t = 0.0
    while arm.busy and t < limit_s:
        arm.step(dt)
        t += dt
    return t


def shifted(q: Vector6, joint: int, angle_rad: float) -> Vector6:
    out = list(q)
    out[joint] += angle_rad
    return vector6(out)


@pytest.mark.parametrize(
    ("length", "speed", "acceleration", "duration_s"),
    [(1.0, 0.5, 1.0, 2.5), (2.0, 1.0, 2.0, 2.5), (0.25, 10.0, 1.0, 1.0), (0.0, 1.0, 1.0, 0.0)],
)
def test_trapezoid_takes_length_over_speed_plus_one_ramp(
    length: float, speed: float, acceleration: float, duration_s: float
) -> None:
    profile = Trapezoid(length, speed, acceleration)
    assert profile.duration_s == pytest.approx(duration_s)
    times = np.linspace(0.0, duration_s, 2001) if duration_s else np.zeros(1)
    way = np.array([profile.at(t)[0] for t in times])
    assert way[0] == pytest.approx(0.0)
    assert way[-1] == pytest.approx(length)
    if duration_s:
        rate = np.diff(way) / np.diff(times)
        assert rate.min() >= -1e-9
        assert rate.max() <= speed + 1e-9
        assert np.abs(np.diff(rate)).max() / np.diff(times)[0] <= acceleration * 1.01


def test_movel_moves_the_tcp_on_a_straight_line() -> None:
    arm = Arm(DH, HOME)
    X_flange_tcp = matrix_of([0.0, 0.02, 0.15, 0.1, 0.2, 0.3])
    start = forward(DH, HOME) @ X_flange_tcp
    goal = start.copy()
    goal[:3, 3] += [0.05, -0.1, -0.05]
    arm.start(LineMove(DH, X_flange_tcp, goal, 0.25, 1.2), "main")
    direction = np.array([0.05, -0.1, -0.05]) / math.hypot(0.05, 0.1, 0.05)
    while arm.busy:
        arm.step(DT)
        here = forward(DH, arm.q) @ X_flange_tcp
        off_line = (here[:3, 3] - start[:3, 3]) - direction * float(direction @ (here[:3, 3] - start[:3, 3]))
        assert math.hypot(*off_line) < 1e-9
        assert math.hypot(*rotvec(here[:3, :3] @ start[:3, :3].T)) < 1e-9
    assert pose_of(forward(DH, arm.q) @ X_flange_tcp) == pytest.approx(pose_of(goal), abs=1e-9)


def test_stopj_takes_speed_over_deceleration() -> None:
    arm = Arm(DH, HOME)
    arm.start(JointMove(DH, shifted(HOME, 5, 3.0), 1.0, 2.0), "main")
    for _ in range(500):
        arm.step(DT)
    assert arm.qd[5] == pytest.approx(1.0)
    arm.stop_joints(2.0, "main")
    assert run(arm) == pytest.approx(0.5, abs=2 * DT)
