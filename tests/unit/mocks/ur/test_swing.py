"""The operator's program that swings the arm: where it ends."""

import numpy as np
import pytest

from ftmocks.kinematics import MODELS, vector6
from ftmocks.ur.swing import Swing

HOME = vector6(np.radians([45, -100, 60, -50, 90, 45]))


def test_a_swing_starts_and_ends_at_rest_where_it_began_after_whole_periods() -> None:
    swing = Swing(MODELS["UR5e"], HOME, 10.0)
    assert 10.0 <= swing.duration_s < 10.0 + swing.period_s
    assert swing.duration_s / swing.period_s == pytest.approx(round(swing.duration_s / swing.period_s))
    for t in (0.0, swing.duration_s):
        np.testing.assert_allclose(swing.at(t).q, HOME, atol=1e-9)
        np.testing.assert_allclose(swing.at(t).qd, 0.0, atol=1e-9)
