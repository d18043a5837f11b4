"""A plan as text, which the operator reads before anything moves."""

import numpy as np
from numpy.typing import ArrayLike

from ftdrive.cell.config import RobotConfig
from ftdrive.planning.approach import STILL_RAD, arm_moves
from ftdrive.planning.plan import Plan
from ftdrivers.sweep import WRISTS, Sweep
from ftdrivers.ur.kinematics import Array

JOINTS = ("base", "shoulder", "elbow", "wrist 1", "wrist 2", "wrist 3")


def plan_in_words(plan: Plan) -> str:
    """Return the reason for the plan, its moves, joint ranges, clearances, time, space and predicted accuracy.

    The table is at most 72 columns wide; each sentence is one line.
    """
    still = ", ".join(f"{angle:.0f}" for angle in np.degrees(plan.steps[0].q_rad[:3]))
    rest = [f"Base, shoulder and elbow stay at {still} degrees."] if plan.arm_rests else []
    if plan.sweep is not None:
        return "\n".join([*plan.why, *rest, *_sweep_table(plan.sweep), "", *_sweep_summary(plan)])
    return "\n".join([*plan.why, *rest, *_table(plan), "", *_summary(plan)])


def stop_in_words(plan: Plan, robot: RobotConfig) -> str:
    """Return time and angle from the begin of braking to rest, at the plan's highest speed; empty for other drivers."""
    if robot.driver != "ur":
        return ""
    speed_deg_s, stop_deg_s2 = np.degrees(plan.top_speed_rad_s), robot.stop_deceleration_deg_s2
    return (
        f"A stop from {speed_deg_s:.0f} °/s brakes with {stop_deg_s2:.0f} °/s²: at rest after "
        f"{speed_deg_s / stop_deg_s2:.2f} s and {speed_deg_s**2 / (2 * stop_deg_s2):.1f}°."
    )


def room_in_words(plan: Plan) -> str:
    """Return which space must be clear."""
    ball = f"ball of {plan.ball_m:.2f} m around {point_in_words(plan)}"
    if plan.arm_rests:
        return f"All moving parts stay in a {ball}, where the axes of wrist 1 and 2 cross: keep it clear, cables slack."
    return f"Wrist and tool stay in a {ball}, and the whole arm moves: keep the space of both clear, cables slack."


def point_in_words(plan: Plan) -> str:
    """Return the centre of the ball as text."""
    x, y, z = (f"{value:.2f}" for value in plan.ball_centre_m)
    return f"x {x}, y {y}, z {z} m in base"


def way_in_words(way_rad: ArrayLike, clearance_m: float) -> str:
    """Return the number of moves of an approach, the range of each joint, and whether the whole arm moves."""
    count = len(np.asarray(way_rad)) - 1
    words = f"{'1 move' if count == 1 else f'{count} moves'} ({turns_in_words(way_rad)}), "
    words += f"proven clear by {1e3 * clearance_m:.0f} mm"
    return words + "; the whole arm moves: keep its space clear" if arm_moves(way_rad) else words


def turns_in_words(way_rad: ArrayLike) -> str:
    """Return the joints that move along a path, each with its range."""
    ranges_deg = np.degrees(np.ptp(np.asarray(way_rad), axis=0))
    turns = [
        f"{name} {turn:.0f}°" for name, turn in zip(JOINTS, ranges_deg, strict=True) if turn >= np.degrees(STILL_RAD)
    ]
    return ", ".join(turns) or "no joint by half a degree"


def _table(plan: Plan) -> list[str]:
    q_deg = np.degrees([step.q_rad for step in plan.steps])
    shown = range(3 if plan.arm_rests else 0, 6)
    widths = [max(len(JOINTS[j]), 5) + 1 for j in shown]

    def angles(row: Array) -> str:
        return "".join(f"{row[j]:{width}.0f}" for j, width in zip(shown, widths, strict=True))

    names = "".join(f"{JOINTS[j]:>{width}}" for j, width in zip(shown, widths, strict=True))
    lines = ["Poses in degrees, and the move to the next pose:", f"{'':4}{'R':>4}{names} turn  °/s    s clear mm"]
    for i, (step, q) in enumerate(zip(plan.steps, q_deg, strict=True), start=1):
        turn, speed = np.degrees([step.turn_rad, step.speed_rad_s])
        move = f"{turn:5.0f}{speed:5.0f}{step.duration_s:5.1f}{1e3 * step.clearance_m:9.0f}"
        lines.append(f"{i:4}  {step.number:02d}{angles(q)}{move}")
    return [*lines, f"{'from':8}{angles(q_deg.min(axis=0))}", f"{'to':8}{angles(q_deg.max(axis=0))}"]


def _sweep_table(sweep: Sweep) -> list[str]:
    t = np.arange(0.0, sweep.duration_s, 0.05)
    q_deg, speed, acceleration = np.degrees(sweep.at(t)), np.degrees(sweep.largest(1)), np.degrees(sweep.largest(2))
    lines = [f"Joints in degrees, within {sweep.duration_s:.0f} s:", f"{'':10}begin  from    to  °/s  °/s²"]
    for j in WRISTS:
        low, high = q_deg[:, j].min(), q_deg[:, j].max()
        lines.append(f"  {JOINTS[j]:8}{q_deg[0, j]:5.0f}{low:6.0f}{high:6.0f}{speed[j]:5.0f}{acceleration[j]:6.0f}")
    return lines


def _sweep_summary(plan: Plan) -> list[str]:
    nearest = min(plan.steps, key=lambda step: step.clearance_m)
    proven = "proven clear along its whole length" if plan.certified else "NOT PROVEN CLEAR"
    return [
        f"A smooth curve from rest to rest, {proven}, {1e3 * plan.off_curve_m:.0f} mm off the curve included.",
        f"Nearest: {1e3 * nearest.clearance_m:.0f} mm, {nearest.limited_by}.",
        room_in_words(plan),
    ]


def _summary(plan: Plan) -> list[str]:
    nearest = min(plan.steps, key=lambda step: step.clearance_m)
    count, most = len(plan.steps), np.degrees(max(step.turn_rad for step in plan.steps))
    proven = "all proven clear" if plan.certified else "NOT ALL PROVEN CLEAR"
    return [
        f"{count} poses, {count} moves {proven}, none above {most:.0f}°: "
        f"{sum(step.duration_s for step in plan.steps):.0f} s of motion at the plan's speeds.",
        f"Nearest: {1e3 * nearest.clearance_m:.0f} mm, {nearest.limited_by}.",
        room_in_words(plan),
        *([] if plan.kind in ("verification", "tool") else [_accuracy(plan)]),
    ]


def _accuracy(plan: Plan) -> str:
    sigma, guess = plan.predicted, plan.description["guess"]
    tilt_deg = np.degrees(_largest([sigma["tilt_alpha_rad"], sigma["tilt_beta_rad"]]))
    return (
        f"Predicted for {guess['mass_kg']:g} kg and averages good to {guess['sigma_force_N']} N, "
        f"{guess['sigma_torque_Nm']} N·m (one sigma): mass {1e3 * _largest(sigma['mass_kg']):.1f} g, "
        f"centre of mass {1e3 * _largest(sigma['p_sensor_com_m']):.2f} mm, "
        f"force bias {_largest(sigma['force_bias_N']):.3f} N, tilt {tilt_deg:.2f}°; "
        f"compensation {_largest(sigma['force_rms_N']):.3f} N, {_largest(sigma['torque_rms_Nm']):.4f} N·m."
    )


def _largest(sigma: object) -> float:
    """Largest value; NaN if the poses do not determine one, which is null in the file."""
    return float(np.max(np.array(sigma, dtype=np.float64)))
