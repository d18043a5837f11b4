"""The operator's program that swings the arm: what the flange reaches, and where it ends."""

from itertools import pairwise

import numpy as np
import pytest

from ftmocks.factory_kinematics import drawn
from ftmocks.kinematics import MODELS, forward, rotvec, vector6
from ftmocks.ur.swing import Swing

HOME = vector6(np.radians([45, -100, 60, -50, 90, 45]))
STEP_S = 0.004


@pytest.mark.parametrize(("model", "limits"), [("UR3e", (1.0, 2.0, 2.0)), ("UR20", (1.5, 4.0, 3.0))])
def test_the_flange_reaches_the_speed_and_the_accelerations_of_the_request(
    model: str, limits: tuple[float, float, float]
) -> None:
    """By differences of its poses along the path."""
    speed, turning, moving = limits
    dh = drawn(model, 1)
    swing = Swing(dh, HOME, 5.0, speed_rad_s=speed, acceleration_rad_s2=turning, acceleration_m_s2=moving)
    times = np.arange(0.0, swing.period_s, STEP_S)
    poses = np.array([forward(dh, swing.at(t).q) for t in times])
    R, p = poses[:, :3, :3], poses[:, :3, 3]
    rates = np.array([rotvec(b @ a.T) for a, b in pairwise(R)]) / STEP_S
    reached = (
        np.linalg.norm(rates, axis=1).max(),
        np.linalg.norm(np.diff(rates, axis=0), axis=1).max() / STEP_S,
        np.linalg.norm(np.diff(p, 2, axis=0), axis=1).max() / STEP_S**2,
    )
    np.testing.assert_allclose(reached, limits, rtol=0.01)


def test_a_swing_starts_and_ends_at_rest_where_it_began_after_whole_periods() -> None:
    swing = Swing(MODELS["UR5e"], HOME, 10.0)
    assert 10.0 <= swing.duration_s < 10.0 + swing.period_s
    assert swing.duration_s / swing.period_s == pytest.approx(round(swing.duration_s / swing.period_s))
    for t in (0.0, swing.duration_s):
        np.testing.assert_allclose(swing.at(t).q, HOME, atol=1e-9)
        np.testing.assert_allclose(swing.at(t).qd, 0.0, atol=1e-9)
