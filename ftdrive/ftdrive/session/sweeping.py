"""A calibration from a sweep: which curve, at what speed, and what the guards know about the tool."""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from ftcalib.data.dwell_mean import LEAST_SAMPLES, noise_level
from ftcalib.model import Array
from ftdrive.cell.config import CellConfig
from ftdrive.errors import ConfigError, NotAccepted
from ftdrive.planning.cell_plan import sweep_for
from ftdrive.planning.geometry.certify import Certifier
from ftdrive.planning.geometry.scene import down_of
from ftdrive.planning.plan import Plan
from ftdrive.planning.sweep_planner import at_speed
from ftdrive.session.forecast import moves_s
from ftdrive.session.free_tool import FreeTool
from ftdrive.session.live_fit import Judge
from ftdrive.session.preflight import Before
from ftdrive.session.sweep import REST_S
from ftdrive.session.task import Calibrating
from ftdrive.session.tour import Pace

FIRST_SHARE: Final = 0.5
"""Of the planned speed, in the first run of a plan."""
LEAST_SLIDER: Final = 0.5
_HEAVIEST_KG: Final = 5.0


@dataclass(frozen=True, eq=False)
class Sweeping(Calibrating):
    """A calibration in motion."""

    seconds: float = 20.0
    """Of the sweep, at the planned speed."""

    def plan(self, certifier: Certifier, q_rad: Array, poses: int) -> Plan:
        """Return a sweep around joint angles (6,)."""
        del poses
        return sweep_for(self.cell, certifier, q_rad, self.seconds)

    def judge(self, *, by_hand: bool) -> Judge:
        """Return what learns the weight of the tool for the contact guard."""
        del by_hand
        return FreeTool(down_of(self.cell.workcell.mounting), self.cell.tool.mass_kg or _HEAVIEST_KG)


def on_script_path(cell: CellConfig) -> CellConfig:
    """Return the cell with the control path that follows a curve; raises `ConfigError` if another one is set."""
    if cell.robot.control == "ur-rtde":
        raise ConfigError(
            "a sweep needs the control path script, whose program evaluates the curve on the controller and stops "
            "with it: give --control script, or set [robot] control"
        )
    return replace(cell, robot=replace(cell.robot, control="script"))


def sweep_pace(before: Before, *, slow: bool) -> Pace:
    """Choose the speed of a sweep, on which the speed slider does not act while it runs, and show it.

    Raises `NotAccepted` if the slider is too low.
    """
    cell, slider = before.cell, before.cell.arm.status().speed_slider
    if slider < LEAST_SLIDER:
        raise NotAccepted(
            f"the speed slider is at {100 * slider:.0f} %, at which a sweep shows too little: set it to "
            f"{100 * LEAST_SLIDER:.0f} % or more"
        )
    share = min(slider, 1.0) * (FIRST_SHARE if slow else 1.0)
    plan = at_speed(before.plan, share)
    if plan.sweep is None:
        raise NotAccepted("the plan holds no sweep: make it with --sweep")
    why = "the first run of a plan is slow" if slow else f"speed slider {100 * slider:.0f} %"
    total_s = plan.sweep.duration_s + 2 * REST_S + moves_s(plan, (), before.approach)
    cell.note(
        f"sweep of {plan.sweep.duration_s:.0f} s at {100 * share:.0f} % of the planned speed ({why}), at most "
        f"{np.degrees(plan.top_speed_rad_s):.0f}°/s: about {total_s:.0f} s of motion"
    )
    quiet_std = noise_level(before.quiet.wrench, max(LEAST_SAMPLES, len(before.quiet) // 2))
    return Pace(
        plan,
        before.certifier,
        before.config.sampling,
        quiet_std=quiet_std,
        sensor_kg=before.config.sensor.mass_kg,
        trusted=before.known,
    )
