"""Mass, centre of mass and inertia from motion: signs in words, exactness, honesty, and what is refused."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib import BadDataset, NotObservable, Parameters
from calib.extras.inertia import LoadInertia, Motion, estimate_inertia, inertial_wrench, motion_of_poses, regressor
from calib.model import Array, predict

G = 9.80665
MASS_KG = 1.6
COM_M = np.array([0.02, -0.015, 0.08])
INERTIA = Rotation.from_euler("xyz", [20, -30, 40], degrees=True).as_matrix()
INERTIA = INERTIA @ np.diag([0.012, 0.016, 0.009]) @ INERTIA.T
SIGMA = np.repeat([0.1, 0.0025], 3)
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


def motion(t_s: Array, turn: tuple[float, float, float] = (0.25, 0.25, 0.25), shift_m: float = 0.05) -> Motion:
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
    return Motion(
        t_s,
        R @ PARAMETERS.R_flange_sensor.T,
        omega(t_s),
        (omega(t_s + h) - omega(t_s - h)) / (2 * h),
        (acceleration_base[:, None] @ R)[:, 0],
    )


def reading(at: Motion) -> Array:
    """Newton and Euler for a rigid body, written independently of the regressor."""
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


def noisy(seed: int, delay_s: float = 0.0) -> Array:
    wrench = reading(motion(TIMES - delay_s)) if delay_s else reading(MOVING)
    return np.asarray(wrench + SIGMA * np.random.default_rng(seed).normal(size=wrench.shape))


def errors(found: LoadInertia) -> Array:
    difference = found.inertia_com_kg_m2 - INERTIA
    upper = [difference[i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]
    return np.array([found.mass_kg - MASS_KG, *(found.p_sensor_com_m - COM_M), *upper])


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
    forward = regressor(np.array([[-2.0, 0, 0, 0, 0, 0, 0, 0, 0]]))[0]
    np.testing.assert_allclose(forward[:, 0], [-2, 0, 0, 0, 0, 0])
    turned = regressor(np.array([[0.0, 0, 0, 0, 0, 3, 0, 0, 0]]))[0]
    np.testing.assert_allclose(turned[:, 6], [0, 0, 0, 0, 0, -3])
    # Swinging about z with the load out on x: it pulls outwards, along +x.
    swinging = regressor(np.array([[0.0, 0, 0, 0, 0, 0, 0, 0, 2]]))[0]
    np.testing.assert_allclose(swinging[:3, 1], [4, 0, 0])


def test_exact_readings_give_exact_parameters() -> None:
    found = estimate_inertia(PARAMETERS, MOVING, reading(MOVING), g_m_s2=G)
    np.testing.assert_allclose(errors(found), 0, atol=1e-9)
    np.testing.assert_allclose(found.bias, [3, -5, 8, 0.2, -0.1, 0.3], atol=1e-8)
    assert found.delay_s == 0
    assert found.implausibilities == ()


def test_the_figures_of_an_ordinary_excitation() -> None:
    """Weight alone leaves 2 N and 0.12 N·m; without inertia 0.06 N·m stay; with all ten only noise is left."""
    omega, alpha = MOVING.angular_velocity_rad_s, MOVING.angular_acceleration_rad_s2
    assert np.sqrt(np.mean(np.sum(MOVING.linear_acceleration_m_s2**2, axis=1))) == pytest.approx(1.8, rel=0.1)
    assert np.sqrt(np.mean(alpha**2)) == pytest.approx(6.7, rel=0.3)
    by_inertia_Nm = alpha @ INERTIA + np.cross(omega, omega @ INERTIA)
    assert np.sqrt(np.mean(by_inertia_Nm**2)) == pytest.approx(0.061, rel=0.2)
    wrench = noisy(0)
    static = np.sqrt(np.mean((wrench - predict(PARAMETERS, MOVING.R_base_flange)).reshape(-1, 2, 3) ** 2, axis=(0, 2)))
    assert static[0] == pytest.approx(2.1, rel=0.4)
    assert static[1] == pytest.approx(0.123, rel=0.2)
    found = estimate_inertia(PARAMETERS, MOVING, wrench, g_m_s2=G)
    assert found.residual_rms_N == pytest.approx(0.1, rel=0.05)
    assert found.residual_rms_Nm == pytest.approx(0.0025, rel=0.05)
    assert found.mass_kg == pytest.approx(MASS_KG, abs=5e-3)
    np.testing.assert_allclose(found.inertia_com_kg_m2, INERTIA, atol=2e-4)


def test_five_milliseconds_cost_more_than_the_noise_and_are_found() -> None:
    late = noisy(1, 0.005)
    skewed = estimate_inertia(PARAMETERS, MOVING, late, g_m_s2=G)
    assert skewed.residual_rms_N > 1.15 * 0.1
    assert skewed.residual_rms_Nm > 1.5 * 0.0025
    for delay_s in (0.005, -0.0173):
        found = estimate_inertia(PARAMETERS, MOVING, noisy(1, delay_s), g_m_s2=G, most_delay_s=0.03)
        assert abs(found.delay_s - delay_s) < 4 * found.delay_sigma_s < 1e-3
        assert found.residual_rms_N == pytest.approx(0.1, rel=0.05)
        assert found.residual_rms_Nm == pytest.approx(0.0025, rel=0.05)


def test_a_delay_that_is_not_there_costs_nothing() -> None:
    found = estimate_inertia(PARAMETERS, MOVING, reading(MOVING), g_m_s2=G, most_delay_s=0.02)
    assert abs(found.delay_s) < 1e-6
    np.testing.assert_allclose(errors(found), 0, atol=1e-6)


def test_the_covariance_is_honest() -> None:
    distances = []
    for seed in range(40):
        found = estimate_inertia(PARAMETERS, MOVING, noisy(seed), g_m_s2=G)
        error = errors(found)
        distances.append(error @ np.linalg.solve(found.covariance, error))
    assert np.mean(distances) == pytest.approx(10, rel=0.2)
    assert list(found.sigma) == ["mass_kg", *(f"p_sensor_com_m.{a}" for a in "xyz"), *list(found.sigma)[4:]]


@pytest.mark.parametrize(
    ("turn", "lacking"),
    [
        ((0.25, 0.25, 0.0), "turns about z"),
        ((0.25, 0.0, 0.0), "about y and z"),
        ((0.25, 0.25, 0.01), "turns about z"),
        ((0.0, 0.0, 0.0), "about all three axes"),
    ],
)
def test_missing_rotation_is_named(turn: tuple[float, float, float], lacking: str) -> None:
    at = motion(TIMES, turn)
    # With x and y alone their product turns the tool about z as well, a little: take small angles.
    small = at._replace(angular_acceleration_rad_s2=at.angular_acceleration_rad_s2 * (np.array(turn) > 0.02))
    with pytest.raises(NotObservable, match=lacking):
        estimate_inertia(PARAMETERS, small, reading(small), g_m_s2=G)


def test_without_change_of_specific_force_mass_and_bias_are_one() -> None:
    """In free fall a load weighs nothing: turning alone does not show its mass."""
    falling = MOVING._replace(
        linear_acceleration_m_s2=(PARAMETERS.gravity_force_base_N / MASS_KG)
        @ (MOVING.R_base_flange @ PARAMETERS.R_flange_sensor)
    )
    with pytest.raises(NotObservable, match=r"1 of 16 combinations of mass"):
        estimate_inertia(PARAMETERS, falling, reading(falling), g_m_s2=G)


def test_implausible_bodies_are_named() -> None:
    good = estimate_inertia(PARAMETERS, MOVING, reading(MOVING), g_m_s2=G)

    def doubts(mass_kg: float, moments: tuple[float, float, float]) -> str:
        return " ".join(
            LoadInertia(
                mass_kg, COM_M, np.diag(moments), good.bias, 0.0, 0.0, good.covariance, 0.1, 0.1
            ).implausibilities
        )

    assert doubts(1.0, (1, 2, 2.9)) == ""
    assert "impossible" in doubts(1.0, (1, 2, 3.1))
    assert "not all positive" in doubts(1.0, (-1, 2, 2))
    assert "check the sign" in doubts(-1.0, (1, 2, 2))


def test_data_that_do_not_fit_are_rejected() -> None:
    wrench = reading(MOVING)
    with pytest.raises(BadDataset, match=r"wrench has shape \(1999, 6\), expected \(2000, 6\)"):
        estimate_inertia(PARAMETERS, MOVING, wrench[1:], g_m_s2=G)
    with pytest.raises(BadDataset, match="each later than"):
        estimate_inertia(PARAMETERS, MOVING._replace(t_s=TIMES[::-1]), wrench, g_m_s2=G)
    with pytest.raises(ValueError, match="quarter of the recording"):
        estimate_inertia(PARAMETERS, MOVING, wrench, g_m_s2=G, most_delay_s=6)
    with pytest.raises(NotObservable, match="no delay within 5 ms"):
        estimate_inertia(PARAMETERS, MOVING, noisy(0, 0.05), g_m_s2=G, most_delay_s=0.005)


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
