"""What a real cell does beside the model: sizes and spectrum of the vibration, noise, delay, friction and drift."""

from collections.abc import Iterator
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from ftmocks.clock import CellClock
from ftmocks.imperfections import IDEAL, Imperfections, Ringing
from ftmocks.kinematics import MODELS, ZERO6, vector6
from ftmocks.ur.motion import JointMove
from ftmocks.ur.robot import Robot, RobotSettings
from ftmocks.world import Truth, World
from tests.unit.mocks.real_time import RealTime

Array = NDArray[np.float64]

HOME = vector6(np.radians([45, -100, 60, -50, 90, 45]))
TRUTH = replace(Truth.drawn(3), mass_kg=0.93, noise_force_N=0.0, noise_torque_Nm=0.0)
SPEED_RAD_S, RATE_HZ, CYCLE_S = 0.78, 1000, 0.002


def cell(imperfections: Imperfections, truth: Truth = TRUTH) -> Robot:
    return Robot(World(truth, MODELS["UR5e"], HOME, 3, CellClock(RealTime()), imperfections), RobotSettings())


def cycles(robot: Robot, seconds: float) -> Iterator[float]:
    """Run control cycles; the time of each."""
    for _ in range(round(seconds / CYCLE_S)):
        robot.tick(robot.cycle_s + CYCLE_S)
        yield robot.cycle_s


@cache
def recorded(imperfections: Imperfections, joint: int, seconds: float = 4.0) -> Array:
    """Readings (n, 6) at `RATE_HZ` while a joint turns by 2 rad, and behind that."""
    robot = cell(imperfections)
    goal = np.add(HOME, 2.0 * np.eye(6)[joint])
    robot.arm.start(JointMove(robot.arm.dh, vector6(goal), SPEED_RAD_S, 1.4), "test")
    readings = []
    for t_s in cycles(robot, seconds):
        readings.append(robot.world.measure_at(t_s + np.array([0.0, 1 / RATE_HZ])))
    return np.vstack(readings)


def vibration(joint: int, **changes: float) -> Array:
    """What an imperfection adds to the readings, (n, 6)."""
    added: Array = recorded(replace(IDEAL, **changes), joint) - recorded(IDEAL, joint)
    return added


EVEN, ENDED = slice(700, 2500), slice(3200, None)
"""Samples at even speed, and behind the stop, which ends at 3.12 s."""


@pytest.mark.slow
def test_a_turning_joint_makes_a_ripple_as_large_as_that_of_a_real_arm() -> None:
    ripple = vibration(4, ripple=1.0)
    size = ripple[EVEN].std(axis=0)
    np.testing.assert_allclose(size[:3], [1.4, 0.65, 0.42], rtol=0.15)
    np.testing.assert_allclose(ripple[EVEN, 3:], np.cross(TRUTH.p_sensor_com_m, ripple[EVEN, :3]), atol=1e-9)
    assert not ripple[ENDED].any()


@pytest.mark.slow
def test_a_ringing_link_is_a_damped_mass_on_a_spring() -> None:
    """Against steps of 20 µs; half a cycle later it is where the next would have it."""
    rng = np.random.default_rng(0)
    pulls = np.repeat(rng.normal(size=(20, 6)), 10, axis=0)
    ringing = Ringing.at_rest(replace(IDEAL, ring=1.0), 4)
    off, speed, rates = np.zeros(6), np.zeros(6), np.abs(ringing.rates)
    for pull in pulls:
        ringing = ringing.after(CYCLE_S, vector6(pull))
        for k in range(100):
            acceleration = -20.0 * speed - rates**2 * off - pull
            if k == 50:
                np.testing.assert_allclose(ringing.at(CYCLE_S / 2), acceleration, atol=0.01)
            speed = speed + acceleration * CYCLE_S / 100
            off = off + speed * CYCLE_S / 100
    for _ in range(1000):
        ringing = ringing.after(CYCLE_S, ZERO6)
    assert ringing.amplitudes is None


def test_a_sensor_measures_before_it_sends() -> None:
    robot = cell(replace(IDEAL, wrench_delay_s=0.003))
    robot.arm.start(JointMove(robot.arm.dh, vector6(np.add(HOME, 1.0)), 1.0, 2.0), "test")
    for t_s in cycles(robot, 0.5):
        measured = robot.world.measure_at(np.array([t_s]))[0]
        np.testing.assert_allclose(measured, robot.world.true_wrench(t_s - 0.003), atol=1e-12)


def test_the_built_in_sensor_drifts_after_a_start_fastest_at_first() -> None:
    robot = cell(replace(IDEAL, wrist_drift_N=7.0))
    began_s, before = robot.cycle_s, np.array(robot.raw_wrench())
    drift_N = []
    for minutes in (1, 2, 5, 10):
        robot.tick(began_s + 60 * minutes)
        change = robot.raw_wrench() - before
        np.testing.assert_allclose(change[[0, 1, 3, 4, 5]], 0.0, atol=1e-9)
        drift_N.append(change[2])
    assert drift_N[3] == pytest.approx(7.0, rel=1e-3)
    assert drift_N[0] > drift_N[1] - drift_N[0] > (drift_N[3] - drift_N[2]) / 5 > 0


@pytest.mark.parametrize("text", ["ripples=1", "ripple", "ripple=-1", "ring=nan"])
def test_settings_of_no_cell_are_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r"setting|float"):
        Imperfections().changed(text)
