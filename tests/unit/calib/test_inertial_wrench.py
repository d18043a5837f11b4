"""What a load in motion exerts, signs in words, and the motion from poses."""

import numpy as np
from scipy.spatial.transform import Rotation

from ftcalib import Parameters
from ftcalib.compensation import SensorMotion, inertial_wrench, motion_of_poses
from ftcalib.model import Array, predict

G = 9.80665
MASS_KG = 1.6
COM_M = np.array([0.02, -0.015, 0.08])
INERTIA = Rotation.from_euler("xyz", [20, -30, 40], degrees=True).as_matrix()
INERTIA = INERTIA @ np.diag([0.012, 0.016, 0.009]) @ INERTIA.T
PARAMETERS = Parameters(
    Rotation.from_euler("zy", [30, 3], degrees=True).as_matrix(),
    MASS_KG * G * Rotation.from_euler("xy", [2, -1], degrees=True).apply([0, 0, -1]),
    np.array([3.0, -5.0, 8.0]),
    COM_M,
    np.array([0.2, -0.1, 0.3]),
)


def multisine(t_s: Array, seed: int, amplitude: float, derivative: int = 0) -> Array:
    rng = np.random.default_rng(seed)
    value = np.zeros_like(t_s)
    for frequency_Hz in (0.31, 0.55, 0.83):
        rate, phase = 2 * np.pi * frequency_Hz, rng.uniform(0, 2 * np.pi)
        value += amplitude * rate**derivative * np.sin(rate * t_s + phase + derivative * np.pi / 2)
    return value


def motion(t_s: Array, turn: tuple[float, float, float] = (0.25, 0.25, 0.25), shift_m: float = 0.05) -> SensorMotion:
    """Euler angles about x, y, z of the sensor and positions in base that are multi-sines."""

    def R_base_sensor(t_s: Array) -> Array:
        angles = np.stack([multisine(t_s, k, turn[k]) for k in range(3)], axis=1)
        return np.asarray(UPSIDE_DOWN @ Rotation.from_euler("XYZ", angles).as_matrix())

    def omega(t_s: Array) -> Array:
        b, c = multisine(t_s, 1, turn[1]), multisine(t_s, 2, turn[2])
        da, db, dc = (multisine(t_s, k, turn[k], 1) for k in range(3))
        # R = Rx(a) Ry(b) Rz(c): the rates about x and y, seen from the frame they have been turned to.
        return np.stack(
            [
                da * np.cos(b) * np.cos(c) + db * np.sin(c),
                -da * np.cos(b) * np.sin(c) + db * np.cos(c),
                da * np.sin(b) + dc,
            ],
            axis=1,
        )

    h = 1e-5
    R = R_base_sensor(t_s)
    acceleration_base = np.stack([multisine(t_s, 10 + k, shift_m, 2) for k in range(3)], axis=1)
    return SensorMotion(
        t_s,
        R @ PARAMETERS.R_flange_sensor.T,
        omega(t_s),
        (omega(t_s + h) - omega(t_s - h)) / (2 * h),
        (acceleration_base[:, None] @ R)[:, 0],
    )


def reading(at: SensorMotion) -> Array:
    """Newton and Euler for a rigid body, about its centre of mass, with weight and bias."""
    gravity = (PARAMETERS.gravity_force_base_N / MASS_KG) @ (at.R_base_flange @ PARAMETERS.R_flange_sensor)
    omega, alpha = at.angular_velocity_rad_s, at.angular_acceleration_rad_s2
    com_acceleration = at.linear_acceleration_m_s2 + np.cross(alpha, COM_M) + np.cross(omega, np.cross(omega, COM_M))
    force_N = MASS_KG * (gravity - com_acceleration)
    about_com_Nm = -(alpha @ INERTIA + np.cross(omega, omega @ INERTIA))
    torque_Nm = about_com_Nm + np.cross(COM_M, force_N)
    bias = np.concatenate([PARAMETERS.force_bias_N, PARAMETERS.torque_bias_Nm])
    return np.asarray(np.concatenate([force_N, torque_Nm], axis=1) + bias)


UPSIDE_DOWN = Rotation.from_euler("x", 180, degrees=True).as_matrix()
TIMES = np.arange(0, 20, 0.01)
MOVING = motion(TIMES)


def test_the_test_motion_is_consistent() -> None:
    """Angular velocity is the derivative of the orientation."""
    h = 1e-6
    before, after = (motion(TIMES[:5] + s).R_base_flange @ PARAMETERS.R_flange_sensor for s in (-h, h))
    rotvec = Rotation.from_matrix(np.swapaxes(before, 1, 2) @ after).as_rotvec() / (2 * h)
    np.testing.assert_allclose(rotvec, MOVING.angular_velocity_rad_s[:5], atol=1e-6)


def test_signs_in_words() -> None:
    at_rest = motion(np.array([0.0]))
    still = at_rest._replace(
        angular_velocity_rad_s=np.zeros((1, 3)),
        angular_acceleration_rad_s2=np.zeros((1, 3)),
        linear_acceleration_m_s2=np.zeros((1, 3)),
    )
    np.testing.assert_allclose(reading(still), predict(PARAMETERS, still.R_base_flange), atol=1e-12)
    # Accelerated along +x, the load pulls back, along -x; turned faster about +z, it resists, about -z.
    p, x, z = np.array([0.5, 0, 0]), np.array([[1.0, 0, 0]]), np.array([[0, 0, 1.0]])
    forward = inertial_wrench(2.0, 0 * p, still._replace(linear_acceleration_m_s2=3 * x))[0]
    np.testing.assert_allclose(forward, [-6, 0, 0, 0, 0, 0])
    turned = inertial_wrench(2.0, 0 * p, still._replace(angular_acceleration_rad_s2=3 * z), 0.1 * np.eye(3))[0]
    np.testing.assert_allclose(turned, [0, 0, 0, 0, 0, -0.3], atol=1e-12)
    # Swinging about z with the load out on x: it pulls outwards, along +x.
    swinging = inertial_wrench(2.0, p, still._replace(angular_velocity_rad_s=2 * z))[0]
    np.testing.assert_allclose(swinging, [4, 0, 0, 0, 0, 0], atol=1e-12)


def test_the_inertial_wrench_is_what_the_reading_has_beside_weight_and_bias() -> None:
    at = motion(TIMES[:300])
    inertial = reading(at) - predict(PARAMETERS, at.R_base_flange)
    np.testing.assert_allclose(inertial_wrench(MASS_KG, COM_M, at, INERTIA), inertial, atol=1e-9)


def test_poses_give_the_motion_of_the_sensor() -> None:
    p_flange_sensor_m = np.array([0.01, -0.02, 0.05])

    def poses(t_s: Array) -> tuple[Array, Array]:
        angles = np.stack([multisine(t_s, k, 0.25) for k in range(3)], axis=1)
        R = Rotation.from_euler("XYZ", angles).as_matrix()
        return R, np.stack([multisine(t_s, 10 + k, 0.05) for k in range(3)], axis=1)

    t_s = np.arange(1000) * 0.002 + np.random.default_rng(1).uniform(0, 5e-4, 1000)  # at uneven spacing
    R_flange_sensor = PARAMETERS.R_flange_sensor
    found = motion_of_poses(
        t_s, *poses(t_s), R_flange_sensor=R_flange_sensor, p_flange_sensor_m=p_flange_sensor_m, reach=5
    )
    h = 1e-4
    before, now, after = (poses(found.t_s + k * h) for k in (-1, 0, 1))
    sensor = [p + R @ p_flange_sensor_m for R, p in (before, now, after)]
    base_to_sensor = now[0] @ R_flange_sensor
    acceleration = ((sensor[0] - 2 * sensor[1] + sensor[2]) / h**2)[:, None] @ base_to_sensor
    steps = [Rotation.from_matrix(np.swapaxes(now[0], 1, 2) @ R).as_rotvec() for R, _ in (before, after)]
    expected = (
        (found.R_base_flange, now[0], 1e-12),
        (found.linear_acceleration_m_s2, acceleration[:, 0], 0.02),
        (found.angular_velocity_rad_s, (steps[1] - steps[0]) / (2 * h) @ R_flange_sensor, 0.002),
        (found.angular_acceleration_rad_s2, (steps[1] + steps[0]) / h**2 @ R_flange_sensor, 0.05),
    )
    assert len(found.t_s) == 990
    for value, wanted, tolerance in expected:
        np.testing.assert_allclose(value, wanted, atol=tolerance)
