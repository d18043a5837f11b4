"""A load on a string: what its hook feels, its period, its energy, and what makes it swing."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from ftmocks.hung_load import HungLoad
from ftmocks.kinematics import forward
from ftmocks.ur.robot import Robot
from ftmocks.workcell import Workcell
from ftmocks.world import World
from tests.unit.mocks.test_world import DH, POSTURE, plain, reach

Array = NDArray[np.float64]

TIP_M, CYCLE_S = np.array([0.0, 0.0, 0.2]), 0.002
DOWN = np.array([0.0, 0.0, -1.0])


def load(string_m: float = 0.25, swing_deg: float = 0.0) -> HungLoad:
    aside = np.array([math.radians(swing_deg), 0.0, 0.0])
    return HungLoad(2.0, TIP_M, TIP_M, string_m, 9.81 * DOWN, np.zeros(3), aside)


def hung(robot: Robot) -> HungLoad:
    assert robot.world.hung is not None
    return robot.world.hung


@pytest.mark.parametrize(
    ("rotation_vector", "wrench"),
    [
        ([math.pi, 0.0, 0.0], [0, 0, 19.62, 0, 0, 0]),  # flange z down, hook 200 mm below: no lever
        ([0.0, math.pi / 2, 0.0], [19.62, 0, 0, 0, 0.16 * 19.62, 0]),  # z along base x, x down: 160 mm
    ],
)
def test_two_kilograms_hang_from_a_hook(rotation_vector: list[float], wrench: list[float]) -> None:
    """The sensor is 40 mm from the flange."""
    world = World(plain(p_flange_sensor_m=np.array([0.0, 0.0, 0.04])), DH, reach(rotation_vector))
    free = world.true_wrench()
    world.hang(2.0, TIP_M, 0.25, 0.0)
    np.testing.assert_allclose(world.true_wrench() - free, wrench, atol=1e-9)
    world.unhang()
    np.testing.assert_array_equal(world.true_wrench(), free)


@pytest.mark.parametrize(
    ("wrong", "why"),
    [
        ({"mass_kg": 0}, "load of 0"),
        ({"string_mm": 0}, "string of 0"),
        ({"swing_deg": 90}, "swing of 90"),
        ({"at_mm": [0, 0]}, "3 numbers"),
    ],
)
def test_an_impossible_load_is_refused(wrong: dict[str, object], why: str) -> None:
    world = World(plain(), DH, POSTURE)
    with pytest.raises(ValueError, match=why):
        Workcell(world, {}).verbs["hang"]({"mass_kg": 2.0, "at_mm": [0, 0, 200], **wrong})
    assert world.hung is None


@pytest.mark.parametrize(("string_m", "cycle_s"), [(0.15, CYCLE_S), (0.25, 20 * CYCLE_S)])
def test_the_period_is_that_of_a_pendulum_and_its_swing_decays(string_m: float, cycle_s: float) -> None:
    """Half a percent of damping leaves exp(-2 pi 0.005) of the swing in each period."""
    one, period_s = load(string_m, 1.0), 2 * math.pi * math.sqrt(string_m / 9.81)
    sideways = []
    for _ in range(round(10 * period_s / cycle_s)):
        one.follow(cycle_s, np.zeros(3), np.zeros(3))
        sideways.append(one.force_base_N[0])
    crossings = np.flatnonzero(np.diff(np.sign(sideways)) > 0)
    exact = crossings - np.take(sideways, crossings) / np.diff(sideways)[crossings]
    assert np.diff(exact).mean() * cycle_s == pytest.approx(period_s, rel=1e-3)
    assert one.swing_deg <= math.exp(-2 * math.pi * 0.005 * 10) * 1.01
    assert max(sideways[-round(period_s / cycle_s) :]) == pytest.approx(
        19.62 * math.radians(1.0) * math.exp(-2 * math.pi * 0.005 * 9.5), rel=0.03
    )


def follow(one: HungLoad, at: Callable[[float], Array], seconds: float, cycle_s: float) -> list[Array]:
    """Let the hook follow a path; the pull at each cycle."""
    pulls = []
    for t in np.arange(1, round(seconds / cycle_s) + 1) * cycle_s:
        one.follow(cycle_s, at(t), (at(t + 1e-5) - at(t - 1e-5)) / 2e-5)
        pulls.append(one.force_base_N)
    return pulls


def hook(robot: Robot) -> Array:
    X = forward(DH, robot.world.q)
    return np.asarray(X[:3, :3] @ TIP_M + X[:3, 3])
