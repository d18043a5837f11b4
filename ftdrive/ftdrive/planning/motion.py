"""Speed limits and durations of joint moves."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ftdrive.planning.geometry.arm_model import ArmModel
from ftdrivers.ur.kinematics import Array

SAMPLE_RAD = np.radians(0.5)
# A joint that turns by less than this counts as resting, because no part of any arm then moves by 20 mm.
STILL_RAD = float(np.radians(0.5))


@dataclass(frozen=True, slots=True)
class Speeds:
    """Limits of every move: speed and acceleration of the joint that turns most, and speed of the tool tips."""

    joint_rad_s: float = float(np.radians(60))
    joint_rad_s2: float = float(np.radians(80))
    tip_m_s: float | None = 0.25
    """Largest speed of a tip; None for no limit."""

    @classmethod
    def first_run(cls) -> "Speeds":
        """Return the slow limits for a plan that has not yet been completed in its workcell."""
        return cls(float(np.radians(30)), float(np.radians(40)))

    @classmethod
    def with_hung_load(cls) -> "Speeds":
        """Return the limits with a load on a string: slow compared with its period of 1 s, so it hardly swings."""
        return cls(float(np.radians(15)), float(np.radians(20)), 0.1)

    def limited(self, other: "Speeds") -> "Speeds":
        """Return limits that keep both these and the other limits: the smaller value of each."""
        return Speeds(
            min(self.joint_rad_s, other.joint_rad_s),
            min(self.joint_rad_s2, other.joint_rad_s2),
            min(self.tip_m_s or np.inf, other.tip_m_s or np.inf),
        )


def move_duration_s(turn_rad: Array, speed_rad_s: Array | float, acceleration_rad_s2: float) -> Array:
    """Return the duration of moves, s, from the angle of the joint that turns most; trapezoidal speed profile."""
    ramp = np.square(speed_rad_s) / acceleration_rad_s2
    whole = turn_rad / speed_rad_s + np.asarray(speed_rad_s) / acceleration_rad_s2
    return np.asarray(np.where(turn_rad > ramp, whole, 2 * np.sqrt(turn_rad / acceleration_rad_s2)))


def speed_of_leading_joint(arm: ArmModel, start_rad: Array, end_rad: Array, speeds: Speeds) -> Array:
    """Return the speed (m,), rad/s, that the joint that turns most may have in straight moves (m, 6) within limits."""
    turn = end_rad - start_rad
    leading = np.abs(turn).max(axis=1)
    speed = np.full(len(turn), speeds.joint_rad_s)
    if speeds.tip_m_s is None:
        return speed
    for i in np.flatnonzero(leading > 0):
        share = np.linspace(0, 1, int(np.ceil(leading[i] / SAMPLE_RAD)) + 1)
        points = tips(arm, start_rad[i] + share[:, None] * turn[i])
        path_m = np.linalg.norm(np.diff(points, axis=0), axis=2).max() * (len(share) - 1)
        speed[i] = min(speeds.joint_rad_s, speeds.tip_m_s * leading[i] / path_m) if path_m > 0 else speeds.joint_rad_s
    return speed


def durations_s(arm: ArmModel, q_rad: Array, speeds: Speeds) -> Array:
    """Return the durations (n, n) of straight moves between joint vectors (n, 6), for the comparison of tours, s.

    The tips are evaluated only at both ends and the middle of a move, so their true speed may be slightly higher.
    """
    turn = np.abs(q_rad[:, None] - q_rad).max(axis=2)
    speed = np.full(turn.shape, speeds.joint_rad_s)
    if speeds.tip_m_s is not None:
        at = tips(arm, q_rad)
        i, j = np.triu_indices(len(q_rad), 1)
        middle = tips(arm, (q_rad[i] + q_rad[j]) / 2)
        halves = [np.linalg.norm(middle - at[end], axis=2).max(axis=1) for end in (i, j)]
        path_m = np.maximum(2 * np.maximum(*halves), 1e-9)
        speed[i, j] = speed[j, i] = np.minimum(speeds.joint_rad_s, speeds.tip_m_s * turn[i, j] / path_m)
    return move_duration_s(turn, np.maximum(speed, 1e-9), speeds.joint_rad_s2)


def tips(arm: ArmModel, q_rad: Array) -> Array:
    """Return points (n, k, 3) in base, m: centres of the far ends of the tool's cylinders, and a load's hook."""
    at = arm.frames(q_rad)
    hook = [] if arm.hung is None else [arm.hung.p_flange_m]
    local = np.array([*((part.x_m, part.y_m, part.to_m) for part in arm.tool), *hook])
    return np.asarray(at.flange_m[:, None] + local @ np.swapaxes(at.R_base_flange, 1, 2))


def arm_moves(way_rad: ArrayLike) -> bool:
    """Return whether base, shoulder or elbow turns along a path of joint vectors (n, 6)."""
    path = np.asarray(way_rad)
    return len(path) > 0 and bool(np.ptp(path[:, :3], axis=0).max() >= STILL_RAD)
