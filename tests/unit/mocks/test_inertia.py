"""The wrench of a moved payload: against point masses whose accelerations are differences of their positions."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from ftmocks.factory_kinematics import drawn
from ftmocks.kinematics import JointState, forward, vector6
from ftmocks.world import Truth, World

Array = NDArray[np.float64]

DH = drawn("UR5e", 3)
HOME = np.radians([45, -100, 60, -50, 90, 45])
STEP_S = 1e-4
MASSES_KG = np.array([0.3, 0.2, 0.4, 0.1, 0.25])


def smooth(seed: int) -> Callable[[float], JointState]:
    """All joints swing about home with speeds and accelerations of a few rad/s and rad/s²."""
    rng = np.random.default_rng(seed)
    reach, rate, phase = rng.uniform(0.2, 0.6, 6), rng.uniform(1.0, 4.0, 6), rng.uniform(-3, 3, 6)

    def at(t: float) -> JointState:
        turn = rate * t + phase
        return JointState(
            vector6(HOME + reach * np.sin(turn)),
            vector6(reach * rate * np.cos(turn)),
            vector6(-reach * rate**2 * np.sin(turn)),
        )

    return at


def second_difference(of: Callable[[float], Array], t: float) -> Array:
    weights = {-2: -1 / 12, -1: 4 / 3, 0: -5 / 2, 1: 4 / 3, 2: -1 / 12}
    parts = [w * of(t + k * 10 * STEP_S) for k, w in weights.items()]
    return np.asarray(np.sum(parts, axis=0)) / (10 * STEP_S) ** 2


def point_masses(seed: int) -> tuple[Truth, Array]:
    """A cell whose payload is five point masses, (5, 3) in the sensor frame."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-0.08, 0.12, (5, 3))
    com = MASSES_KG @ points / MASSES_KG.sum()
    arms = points - com
    tensor = sum(m * (a @ a * np.eye(3) - np.outer(a, a)) for m, a in zip(MASSES_KG, arms, strict=True))
    truth = replace(
        Truth.drawn(seed),
        mass_kg=float(MASSES_KG.sum()),
        p_sensor_com_m=com,
        gyration_m2=tensor / MASSES_KG.sum(),
        p_flange_sensor_m=rng.uniform(-0.05, 0.05, 3),
    )
    return truth, points


@pytest.mark.parametrize("seed", range(2))
def test_a_moved_payload_exerts_what_its_points_do(seed: int) -> None:
    truth, points = point_masses(seed)
    at, t = smooth(seed), 0.7

    def positions(t: float) -> Array:
        X = forward(DH, at(t).q)
        return (points @ truth.R_flange_sensor.T + truth.p_flange_sensor_m) @ X[:3, :3].T + X[:3, 3]

    pulls = MASSES_KG[:, None] * (truth.gravity_m_s2 - second_difference(positions, t))
    R_base_sensor = forward(DH, at(t).q)[:3, :3] @ truth.R_flange_sensor
    forces = pulls @ R_base_sensor
    expected = np.concatenate((forces.sum(axis=0), np.cross(points, forces).sum(axis=0)))

    world = World(truth, DH, at(0.0).q)
    world.move(t, at(t).q, at)
    np.testing.assert_allclose(world.load_wrench(t), expected, atol=1e-6)
    still = World(truth, DH, at(t).q).load_wrench()
    assert np.linalg.norm(expected[:3] - still[:3]) > 1.0, "inertia is no trifle here"
