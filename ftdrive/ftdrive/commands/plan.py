"""`ftdrive plan`: plan a tour proven clear of collisions, without an arm."""

from contextlib import suppress
from dataclasses import replace
from math import inf, isfinite
from pathlib import Path
from shlex import quote
from threading import Event
from typing import Any

import click
import numpy as np

from ftdrive.cell.config import cell_of, settings
from ftdrive.cell.emulated import Station
from ftdrive.cell.units import parse_numbers, rows
from ftdrive.commands.options import (
    CONFIG,
    JSON,
    PLAN_FILES,
    SETS,
    Headed,
    ViewOptions,
    check_simulate,
    simulate,
    view_options,
    write_json,
)
from ftdrive.errors import ConfigError
from ftdrive.planning.drawing import draw_plan
from ftdrive.planning.planner import USUAL_POSTURE_RAD, certifier_for, plan_for
from ftdrive.terminal.console import answer, messages, working
from ftdrive.view.plan_page import PlanPage

HEADINGS = {
    "The cell": "--config --model --tool --mass --mounting --plane --box --simulate",
    "The tour": "--quick --minimal --set --cone --free-box --posture --tip-speed-limit",
    "Output": "--output --png --all --view --view-address --json --help",
}


def _tip_speed(_context: click.Context, _parameter: click.Parameter, text: str | None) -> float | None:
    if text is None or text.lower() == "none":
        return None if text is None else inf
    with suppress(ValueError):
        if isfinite(speed := float(text)):
            return speed
    raise ConfigError(f"--tip-speed-limit is '{text}': give mm/s, such as 250, or none")


@click.command(cls=Headed, headings=HEADINGS)
@CONFIG
@click.option("--model", help="Model of the arm: ur3e, ur5e, ur7e, ur10e, ur12e, ur16e, ur20 or ur30.")
@click.option(
    "--tool",
    "tool",
    multiple=True,
    metavar="FROM:TO:DIAMETER[:X:Y]",
    help="Cylinder around tool or sensor, mm from the flange face; X:Y is the offset of its axis. Repeatable.",
)
@click.option("--quick", is_flag=True, help="Plan 12 poses instead of 24.")
@click.option("--minimal", is_flag=True, help="Plan 6 poses instead of 24.")
@SETS
@click.option(
    "--cone", "cone_deg", type=float, metavar="DEG", help="Use only poses with the tool within DEG of straight down."
)
@click.option(
    "--free-box", "box_mm", type=float, metavar="MM", help="Let the flange move MM to each side with the whole arm."
)
@click.option(
    "--posture",
    default=",".join(f"{angle:.0f}" for angle in np.degrees(USUAL_POSTURE_RAD[:3])),
    show_default=True,
    metavar="Q1,Q2,Q3",
    help="Angles of the first three joints, degrees.",
)
@click.option(
    "--mounting", help="Mounting: floor, wall, ceiling, or tilt of the base towards -x in degrees (wall: 90)."
)
@click.option(
    "--plane",
    "planes",
    multiple=True,
    metavar="NX:NY:NZ:MM",
    help="Wall: the arm stays where N·p >= MM, base axes. The mounting surface is always included.",
)
@click.option("--box", "boxes", multiple=True, metavar="X:Y:Z:X:Y:Z", help="Block: two corners in mm, base axes.")
@click.option(
    "--tip-speed-limit",
    metavar="MM/S|none",
    callback=_tip_speed,
    help="Largest speed of the tool's outermost points.  [default: [robot] tip_speed_mm_s, else 250]",
)
@click.option(
    "--mass",
    "mass_kg",
    metavar="KG",
    type=float,
    help="Mass of the tool, for the predicted accuracy.  [default: [tool] mass_kg, else 1]",
)
@PLAN_FILES
@click.option("--all", "every", is_flag=True, help="Also print each pose and move.")
@view_options
@simulate("Use arm and tool of an emulated cell, not the configuration.")
@JSON
def plan_command(
    config: Path | None,
    model: str | None,
    tool: tuple[str, ...],
    quick: bool,
    minimal: bool,
    sets: str | None,
    cone_deg: float | None,
    box_mm: float | None,
    posture: str,
    mounting: str | None,
    planes: tuple[str, ...],
    boxes: tuple[str, ...],
    tip_speed_limit: float | None,
    mass_kg: float | None,
    output: Path | None,
    png: Path | None,
    every: bool,
    view: ViewOptions,
    simulate: bool,
    as_json: bool,
) -> None:
    """Plan a tour proven clear of collisions with the arm, the tool, planes and boxes. Needs no robot.

    Arm, tool and surroundings come from the configuration; options replace its values. Cables, fixtures and people are
    not in the model: check the space that must be clear before the arm moves.
    """
    for one, other in ((quick, minimal), (cone_deg, box_mm)):
        if one and other:
            raise ConfigError("give --quick or --minimal, and --cone or --free-box, not both")
    if sets is not None and (quick or minimal or cone_deg or box_mm):
        raise ConfigError("--set defines the poses: leave out --quick, --minimal, --cone and --free-box")
    check_simulate(simulate, real={"--config": config})
    page = click.get_current_context().with_resource(view.page("ftdrive plan"))
    emulated = None
    if simulate:
        with working("Starting the emulated cell"), Station.of(None) as station:
            emulated = station.cell
    found = settings(
        config,
        {
            "robot.model": ("--model", model),
            "robot.tip_speed_mm_s": ("--tip-speed-limit", None if tip_speed_limit == inf else tip_speed_limit),
            "tool.cylinders_mm": ("--tool", rows("--tool", tool, (3, 5))),
            "tool.mass_kg": ("--mass", mass_kg),
            "workcell.mounting": ("--mounting", mounting),
            "workcell.planes_mm": ("--plane", rows("--plane", planes, (4,))),
            "workcell.boxes_mm": ("--box", rows("--box", boxes, (6,))),
        },
        cell=emulated,
    )
    cell = cell_of(found, devices=False)
    if emulated is not None:
        cell = replace(cell, clock=emulated.clock)
    described = {found[key].origin for key in ("tool.cylinders_mm", "workcell.planes_mm", "workcell.boxes_mm")}
    described -= {"default", "--tool", "--plane", "--box"}
    if not described:  # cylinders, planes and boxes are from options only
        cell = replace(cell, workcell=replace(cell.workcell, measured=True))
    if not cell.workcell.measured:
        messages.print(
            f"Placeholders in {', '.join(sorted(described))} (measured = false): this plan is for inspection only."
        )
    certifier = certifier_for(cell, cell.robot.model)
    again = "`ftdrive calibrate` proves the plan again with the kinematics of your arm"
    messages.print(f"Planned for a nominal {certifier.arm.name} with wider margins; {again}.")
    q_rad = np.array([*np.radians(parse_numbers("--posture", posture, ",", (3,))), *USUAL_POSTURE_RAD[3:]])
    with working("Planning"):
        poses, unlimited = 6 if minimal else 12 if quick else 24, tip_speed_limit == inf
        chosen: dict[str, Any] = {"sets": sets, "cone_deg": cone_deg, "box_mm": box_mm, "tip_unlimited": unlimited}
        made = plan_for(cell, certifier, q_rad, poses, **chosen)
    if png is not None:
        with working("Drawing"):
            draw_plan(made, certifier, png)
    if output is not None:
        made.save(output)
    saved = [f" Saved {path}" for path in (png, output) if path is not None]
    if as_json:
        write_json({"schema_version": 1} | made.to_dict())
        messages.print(*saved, sep="\n", end="\n" if saved else "")
    else:
        answer.print(*filter(None, (made.in_words(table=every), made.stop_in_words(cell.robot))), *saved, sep="\n")
        tour = {"--quick": quick, "--minimal": minimal, f"--set {sets}": sets}
        same = {"--simulate": simulate, **(tour if output is None else {f"--plan {quote(str(output))}": True})}
        command = " ".join(["ftdrive calibrate", *(option for option, given in same.items() if given)])
        messages.print_next(f"{command}   (asks before anything moves)")
    if page is not None:
        messages.print("Press Ctrl-C to stop.")
        with suppress(KeyboardInterrupt):
            PlanPage(page, made, certifier).play(Event())
