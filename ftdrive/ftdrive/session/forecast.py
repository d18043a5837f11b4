"""Forecast of a tour: its speeds, its duration, and its accuracy with the noise of this sensor."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from ftcalib.model import Array
from ftcalib.poses.information import predicted_sigma
from ftcalib.result import LEAST_COMMON_GAIN
from ftdrive.planning.approach import Approach
from ftdrive.planning.geometry.certify import Certifier
from ftdrive.planning.motion import Speeds, move_duration_s, speed_of_leading_joint
from ftdrive.planning.plan import Plan
from ftdrive.planning.planner import guess_of
from ftdrive.session.tour import APPROACH_RAD_S, SLOW


def limit_speeds(plan: Plan, certifier: Certifier, speeds: Speeds) -> Plan:
    """Return a plan with its speeds reduced to these limits."""
    q = np.array([step.q_rad for step in plan.steps])
    allowed = speed_of_leading_joint(certifier.arm, q, np.roll(q, -1, axis=0), speeds)
    steps = (
        replace(step, speed_rad_s=min(step.speed_rad_s, float(most)))
        for step, most in zip(plan.steps, allowed, strict=True)
    )
    acceleration_rad_s2 = min(plan.acceleration_rad_s2, speeds.joint_rad_s2)
    return replace(plan, steps=tuple(steps), acceleration_rad_s2=acceleration_rad_s2)


def moves_s(plan: Plan, todo: Sequence[int], approach: Approach) -> float:
    """Return the time of all moves: the approach to the first stop, then moves of the plan to the rest.

    Parameters
    ----------
    plan : Plan
        With the speeds it is driven at.
    todo : sequence of int
        Stops, from 1; where some are left out between two, there is an approach too, counted as a straight move.
    """
    turns = np.abs(np.diff(approach.way_rad, axis=0)).max(axis=1)
    speeds = np.minimum(approach.speed_rad_s, APPROACH_RAD_S)
    total_s = float(move_duration_s(turns, speeds, SLOW.joint_rad_s2).sum())
    for stop, following in pairwise(todo):
        step = plan.steps[stop - 1]
        turn, speed, acceleration = step.turn_rad, step.speed_rad_s, plan.acceleration_rad_s2
        if following != stop + 1:
            goal = plan.steps[(following - 1) % len(plan.steps)].q_rad
            turn = float(np.abs(np.subtract(goal, step.q_rad)).max())
            speed, acceleration = APPROACH_RAD_S, SLOW.joint_rad_s2
        total_s += float(move_duration_s(np.array(turn), speed, acceleration))
    return total_s


def rms_sigma(sigma: Array) -> tuple[float, float]:
    """Return one standard deviation of one axis, force in N and torque in N·m, from those of all six axes."""
    force_N, torque_Nm = (float(np.sqrt(np.mean(part**2))) for part in (sigma[:3], sigma[3:]))
    return force_N, torque_Nm


def predict_accuracy(plan: Plan, certifier: Certifier, sigma: Array, mass_kg: float | None, *, assumed: bool) -> str:
    """Describe the accuracy of a calibration from averages with one standard deviation `sigma` (6,), N and N·m.

    `assumed` says that the mass of the tool is not configured.
    """
    force_N, torque_Nm = rms_sigma(sigma)
    guess = replace(guess_of(certifier, mass_kg), sigma_force_N=force_N, sigma_torque_Nm=torque_Nm)
    found = predicted_sigma(np.array([step.R_base_flange for step in plan.steps]), guess)
    mass_g = 1e3 * np.hypot(found.sigma["mass_kg"], LEAST_COMMON_GAIN * guess.mass_kg)
    mass = f"{guess.mass_kg:g} kg" + (" (assumed: [tool] mass_kg is not set)" if assumed else "")
    return (
        f"predicted from that for {mass}, one sigma: mass {mass_g:.2g} g, "
        f"force bias {np.max(found.sigma['force_bias_N']):.2g} N, compensation {found.force_rms_N:.2g} N, "
        f"{found.torque_rms_Nm:.2g} N·m"
    )
