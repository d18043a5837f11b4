"""Moves of the emulated arm, as the tests of `UrArm` use them."""

from ftdrivers.ur.arm import UrArm

STEP_RAD = 1.2
"""1.3 s at the speed of these tests: long enough to be interrupted."""


def no_guard() -> None:
    pass


def away(arm: UrArm, by_rad: float = STEP_RAD) -> list[float]:
    """Joint angles with joint 6 turned away from where it is, back and forth."""
    q: list[float] = arm.state().q_rad.tolist()
    q[5] += by_rad if q[5] < 0.5 else -by_rad
    return q
