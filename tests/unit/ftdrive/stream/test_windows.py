"""Windows of the tracker in motion, against the mechanics of the simulated tool."""

from typing import Any

import numpy as np
import pytest

from ftcalib.model import Array, skew
from ftdrive.stream.noise import SensorNoise, Window, Windows
from ftdrive.stream.samples import Paired
from tests.unit.ftdrive.stream.simulated import (
    P_FLANGE_SENSOR_M,
    T0_NS,
    TRUTH,
    G,
    KnownNoise,
    Motion,
    calibrated,
    info,
    moving,
)

NOISE = SensorNoise(np.eye(6), np.diag(np.arange(1.0, 7.0)), np.zeros((6, 6)), 100.0)
SYSTEMATIC = np.diag(np.arange(7.0, 13.0))
MASS_KG = float(np.linalg.norm(TRUTH.gravity_force_base_N)) / G
H_S = 1e-3


def windows(rows: Paired, state: int) -> list[Window]:
    noise: Any = KnownNoise(NOISE)
    collected, found = Windows(info(calibrated())), list[Window]()
    for i in range(0, len(rows), 70):
        part = rows.rows(slice(i, i + 70))
        found += collected.add(part, np.full(len(part), state, np.int8), noise, SYSTEMATIC)
    return found


def rates(motion: Motion, t_s: Array) -> tuple[Array, Array, Array]:
    """Acceleration of the sensor's origin, angular velocity and acceleration, sensor axes, by finite differences."""

    def sensor(t_s: Array) -> tuple[Array, Array]:
        R, p = motion.pose(t_s)
        return R @ TRUTH.R_flange_sensor, p + R @ P_FLANGE_SENSOR_M

    def omega(t_s: Array) -> Array:
        turn = (sensor(t_s + H_S / 2)[0] - sensor(t_s - H_S / 2)[0]) / H_S
        W = np.swapaxes(sensor(t_s)[0], 1, 2) @ turn
        return np.stack([W[:, 2, 1], W[:, 0, 2], W[:, 1, 0]], axis=1)

    R = sensor(t_s)[0]
    acceleration = (sensor(t_s + H_S)[1] - 2 * sensor(t_s)[1] + sensor(t_s - H_S)[1]) / H_S**2
    alpha = (omega(t_s + H_S) - omega(t_s - H_S)) / (2 * H_S)
    return np.einsum("nji,nj->ni", R, acceleration), omega(t_s), alpha


def test_a_window_has_the_motion_of_the_sensor() -> None:
    motion = Motion()
    found = windows(moving(1.0, motion, noise=0.0), 3)
    times_s = np.array([one.t_s for one in found]) - T0_NS * 1e-9
    np.testing.assert_allclose(np.diff(times_s), 0.15, atol=1e-9)
    assert times_s[0] == pytest.approx(0.02 + 0.15)  # after five knots of 4 ms
    assert len(found) == 5
    for middle_s, window in zip(times_s, found, strict=True):
        t_s = middle_s + np.arange(-150, 151) * 1e-3
        weights = np.cos(np.pi * (t_s - middle_s) / 0.3) ** 2
        weights /= weights.sum()
        acceleration, omega, alpha = rates(motion, t_s)
        R = motion.pose(t_s)[0] @ TRUTH.R_flange_sensor
        felt = np.einsum("n,nij,i->j", weights, R, TRUTH.gravity_force_base_N) / MASS_KG - weights @ acceleration
        np.testing.assert_allclose(window.felt_m_s2, felt, atol=0.06)
        np.testing.assert_allclose(
            window.lever_s2, np.einsum("n,nij->ij", weights, skew(alpha) + skew(omega) @ skew(omega)), atol=0.06
        )
        assert window.turning_rad_s2 == pytest.approx(weights @ np.linalg.norm(alpha, axis=1), abs=0.03)
        assert window.tensor_Nm == pytest.approx(MASS_KG * 0.08**2 * window.turning_rad_s2, rel=2e-3)
        assert (np.abs(window.residual) < np.repeat([0.06, 0.005], 3)).all()
        np.testing.assert_allclose(window.p_base_flange_m, motion.pose(t_s[150:151])[1][0])
        np.testing.assert_allclose(window.noise, 1.5 * 0.02 / 0.3 * NOISE.reading)
        assert window.state == 3
        np.testing.assert_allclose(window.R_base_flange, motion.pose(t_s[150:151])[0][0])
        assert window.systematic is SYSTEMATIC
