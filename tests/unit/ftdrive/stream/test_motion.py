"""States of motion at their limits, and the wrench of an accelerated load."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ftcalib.model import Array
from ftdrive.stream.noise import REST, MotionTracker
from tests.unit.ftdrive.stream.simulated import P_FLANGE_SENSOR_M, TRUTH

RATE_HZ, MASS_KG = 1000.0, 1.5
CENTRED = TRUTH.R_flange_sensor @ -TRUTH.p_sensor_com_m
"""Origin of a sensor whose centre of mass is that of the flange, so that turning does not move it."""


def follow(angle_rad: Array, p_m: Array | None = None, origin_m: Array = CENTRED) -> tuple[NDArray[np.int8], Array]:
    """States and wrench of a flange that turns by these angles about z and is at these places."""
    R = Rotation.from_rotvec(np.outer(angle_rad, [0.0, 0.0, 1.0])).as_matrix()
    p = np.zeros((len(R), 3)) if p_m is None else p_m
    return MotionTracker(RATE_HZ, MASS_KG, TRUTH, origin_m).follow(R, p)


def seconds(duration_s: float) -> Array:
    return np.arange(0, duration_s, 1 / RATE_HZ)


def test_rest_begins_half_a_second_after_the_last_motion_and_a_state_rings_for_less() -> None:
    t_s = seconds(3.0)
    fast_until_s, slow_until_s = 1.0, 2.0
    angle = 0.8 * np.minimum(t_s, fast_until_s) + 0.1 * np.clip(t_s - fast_until_s, 0, slow_until_s - fast_until_s)
    states, _ = follow(angle)
    first = {state: t_s[np.flatnonzero((states == state) & (t_s > 0.5))[0]] for state in (1, REST)}
    assert 1.4 < first[1] < 1.46
    assert 2.5 < first[REST] < 2.56
    assert states[0] == REST
    assert t_s[np.flatnonzero(states)[0]] < 0.02  # soon after the begin


def test_an_accelerated_load_pulls_back_at_its_centre_of_mass() -> None:
    t_s, R = seconds(0.5), Rotation.from_euler("xyz", [150, 20, 40], degrees=True).as_matrix()
    acceleration = np.array([0.01, 0.0, 0.0])
    tracker = MotionTracker(RATE_HZ, MASS_KG, TRUTH, P_FLANGE_SENSOR_M)
    states, felt = tracker.follow(np.tile(R, (len(t_s), 1, 1)), np.outer(t_s**2 / 2, acceleration))
    force_N = -MASS_KG * acceleration @ (R @ TRUTH.R_flange_sensor)
    np.testing.assert_allclose(felt[-1], np.r_[force_N, np.cross(TRUTH.p_sensor_com_m, force_N)], atol=1e-6)
    begin_s = t_s[np.flatnonzero(felt.any(axis=1))[0]]
    assert 0.2 < begin_s < 0.225  # at 2 mm/s, long before 10 mm/s are a motion
    assert not states.any()
