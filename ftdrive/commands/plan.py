"""`ftdrive plan`: where an arm would go and how clear it stays, without an arm."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ftdrive.commands.common import JSON, write_json
from ftdrive.errors import ConfigError, PlanRefused

if TYPE_CHECKING:
    from ftdrive.planning.arm_model import Cylinder
    from ftdrive.planning.plan import Plan
    from ftdrive.planning.scene import Box, Plane

USUAL_POSTURE = "45,-100,60"


@click.command()
@click.option("--model", required=True, help="Of the arm: ur3e, ur5e, ur7e, ur10e, ur12e, ur16e, ur20 or ur30.")
@click.option(
    "--tool",
    "tool",
    multiple=True,
    required=True,
    metavar="FROM:TO:DIAMETER[:X:Y]",
    help="A cylinder of what is mounted, in mm from the flange face; X:Y puts its axis aside. Repeatable.",
)
@click.option("--quick", is_flag=True, help="12 poses instead of 24.")
@click.option("--minimal", is_flag=True, help="6 poses.")
@click.option(
    "--posture",
    default=USUAL_POSTURE,
    show_default=True,
    metavar="Q1,Q2,Q3",
    help="Of the first three joints, degrees.",
)
@click.option(
    "--mounting",
    default="floor",
    show_default=True,
    help="floor, wall, ceiling, or degrees the base leans about its y.",
)
@click.option(
    "--plane",
    "planes",
    multiple=True,
    metavar="NX:NY:NZ:MM",
    help="A wall: the arm stays where normal times place, base axes, is MM or more. The mounting surface is known.",
)
@click.option("--box", "boxes", multiple=True, metavar="X:Y:Z:X:Y:Z", help="A block, two corners in mm, base axes.")
@click.option(
    "--tip-speed-limit", default="250", show_default=True, metavar="MM/S|none", help="Of the tool's farthest points."
)
@click.option(
    "--mass", "mass_kg", type=float, default=1.0, show_default=True, help="Of the tool in kg, for the prediction."
)
@click.option("--output", type=click.Path(dir_okay=False, path_type=Path), help="Save the plan as a new JSON file.")
@click.option("--png", type=click.Path(dir_okay=False, path_type=Path), help="Save stick figures (needs matplotlib).")
@JSON
def plan(
    model: str,
    tool: tuple[str, ...],
    quick: bool,
    minimal: bool,
    posture: str,
    mounting: str,
    planes: tuple[str, ...],
    boxes: tuple[str, ...],
    tip_speed_limit: str,
    mass_kg: float,
    output: Path | None,
    png: Path | None,
    as_json: bool,
) -> None:
    """Plan a tour that is proven clear of the arm itself, of the tool and of planes and boxes. Needs no robot.

    Real cables, fixtures and people are not in the model: look at the ball before anything moves.
    """
    import numpy as np

    from ftdrive.planning.arm_model import ArmModel
    from ftdrive.planning.certify import Certifier
    from ftdrive.planning.motion import Speeds
    from ftdrive.planning.planner import USUAL_POSTURE_RAD, guess_of, plan_tour
    from ftdrive.planning.scene import BASE_PLANE, Scene, lean_of

    if quick and minimal:
        raise ConfigError("give --quick (12 poses) or --minimal (6), not both")
    if not (np.isfinite(mass_kg) and mass_kg > 0):
        raise ConfigError(f"--mass is {mass_kg}: give the mass of the tool in kg, above zero")
    q_rad = USUAL_POSTURE_RAD.copy()
    q_rad[:3] = np.radians(_numbers("--posture", posture, ",", (3,)))
    scene = Scene((BASE_PLANE, *map(_plane, planes)), tuple(map(_box, boxes)), lean_of(mounting))
    certifier = Certifier(ArmModel(model, [_cylinder(text) for text in tool]), scene)
    speeds = Speeds(tip_m_s=_tip_speed(tip_speed_limit))
    poses = 6 if minimal else 12 if quick else 24
    made = plan_tour(certifier, q_rad, poses, speeds=speeds, guess=guess_of(certifier, mass_kg))
    if not made.certified:
        raise PlanRefused("a move of the plan could not be proven clear")
    if output is not None:
        made.save(output)
    if png is not None:
        from ftdrive.planning.picture import draw

        draw(made, certifier.arm, png)
    if as_json:
        write_json({"schema_version": 1} | made.to_dict())
    else:
        _show(made)


def _show(plan: "Plan") -> None:
    import numpy as np
    from rich.table import Table

    from ftdrive.report import talk

    document = plan.to_dict()
    for sentence in plan.why:
        talk.print(sentence)
    q_deg = np.degrees([step.q_rad for step in plan.steps])
    still = ", ".join(f"{angle:.0f}" for angle in q_deg[0, :3])
    talk.print(f"Base, shoulder and elbow stay at {still} degrees.")
    table = Table(title="Poses in degrees, and the move on to the next", title_justify="left", box=None)
    for title in ("", "R", "wrist 1", "wrist 2", "wrist 3", "turn", "°/s", "s", "clear mm"):
        table.add_column(title, justify="right")
    for i, (step, q) in enumerate(zip(plan.steps, q_deg, strict=True), start=1):
        turn, speed = np.degrees([step.turn_rad, step.speed_rad_s])
        cells = [f"{angle:.0f}" for angle in q[3:]] + [f"{turn:.0f}", f"{speed:.0f}", f"{step.duration_s:.1f}"]
        table.add_row(str(i), f"{step.number:02d}", *cells, f"{1e3 * step.clearance_m:.0f}")
    table.add_row("from", "", *(f"{angle:.0f}" for angle in q_deg[:, 3:].min(axis=0)))
    table.add_row("to", "", *(f"{angle:.0f}" for angle in q_deg[:, 3:].max(axis=0)))
    talk.print(table)
    nearest = min(plan.steps, key=lambda step: step.clearance_m)
    sigma = document["predicted_sigma"]
    tilt = np.degrees([sigma["tilt_alpha_rad"], sigma["tilt_beta_rad"]])
    guess = document["description"]["guess"]
    talk.print(
        f"\n{document['poses']} poses, {document['poses']} moves all proven clear, none above "
        f"{document['max_move_deg']:.0f}°: {document['motion_time_s']:.0f} s of motion.\n"
        f"Nearest: {document['min_clearance_mm']:.0f} mm, {nearest.limited_by}.\n"
        f"All that moves stays in a ball of {plan.ball_m:.2f} m about the crossing of the axes of wrist 1 and 2: "
        "keep it free, cables slack.\n"
        f"Predicted for {guess['mass_kg']:g} kg and averages good to {guess['sigma_force_N']} N, "
        f"{guess['sigma_torque_Nm']} N·m (one sigma): mass {1e3 * sigma['mass_kg']:.1f} g, "
        f"centre of mass {1e3 * np.max(sigma['p_sensor_com_m']):.2f} mm, "
        f"force bias {np.max(sigma['force_bias_N']):.3f} N, "
        f"tilt {tilt.max():.2f}°; compensation {sigma['force_rms_N']:.3f} N, {sigma['torque_rms_Nm']:.4f} N·m."
    )


def _numbers(option: str, text: str, separator: str, counts: Sequence[int]) -> list[float]:
    from math import isfinite

    try:
        values = [float(part) for part in text.split(separator)]
    except ValueError:
        values = []
    if len(values) not in counts or not all(map(isfinite, values)):
        wanted = " or ".join(map(str, counts))
        raise ConfigError(f"{option} is '{text}': give {wanted} numbers separated by '{separator}'")
    return values


def _cylinder(text: str) -> "Cylinder":
    from ftdrive.planning.arm_model import Cylinder

    return Cylinder(*(value / 1e3 for value in _numbers("--tool", text, ":", (3, 5))))


def _plane(text: str) -> "Plane":
    from math import hypot

    from ftdrive.planning.scene import Plane

    x, y, z, offset_mm = _numbers("--plane", text, ":", (4,))
    length = hypot(x, y, z)
    if not length:
        raise ConfigError(f"--plane is '{text}': its normal has no direction, give for example -1:0:0:-800")
    return Plane((x / length, y / length, z / length), offset_mm / 1e3)


def _box(text: str) -> "Box":
    from ftdrive.planning.scene import Box

    x1, y1, z1, x2, y2, z2 = (value / 1e3 for value in _numbers("--box", text, ":", (6,)))
    return Box((min(x1, x2), min(y1, y2), min(z1, z2)), (max(x1, x2), max(y1, y2), max(z1, z2)))


def _tip_speed(text: str) -> float | None:
    if text == "none":
        return None
    (speed_mm_s,) = _numbers("--tip-speed-limit", text, " ", (1,))
    if speed_mm_s <= 0:
        raise ConfigError(f"--tip-speed-limit is {text}: give mm/s above zero, or none")
    return speed_mm_s / 1e3
