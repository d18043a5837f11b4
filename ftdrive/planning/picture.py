"""Stick figures of a plan."""

from pathlib import Path

import numpy as np

from ftdrive.errors import ConfigError
from ftdrive.planning.arm_model import ArmModel
from ftdrive.planning.plan import Plan


def draw(plan: Plan, arm: ArmModel, path: Path) -> None:
    """Write a PNG with the arm at every pose, seen from the front, the side and above. Needs the extra `viz`."""
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise ConfigError("a picture needs matplotlib: install ftdrive with its extra viz, `ftdrive[viz]`") from None
    if path.exists():
        raise ConfigError(f"{path} exists already and is never overwritten: choose another name")
    at = arm.frames([step.q_rad for step in plan.steps])
    axis_6 = at.R_base_flange[:, :, 2]
    tip = at.flange_m + max(part.to_m for part in arm.tool) * axis_6
    base = np.zeros_like(at.shoulder_m)
    joints = (base, at.shoulder_m, at.elbow_m, at.forearm_end_m, at.wrist_m, at.wrist_2_m, at.flange_m)
    figure = Figure(figsize=(12, 4.5), layout="constrained")
    for column, (across, up, title) in enumerate(
        ((1, 2, "along base x"), (0, 2, "along base y"), (0, 1, "from above"))
    ):
        axes = figure.add_subplot(1, 3, column + 1)
        for arm_line, tool_line in zip(np.stack(joints, axis=1), np.stack([at.flange_m, tip], axis=1), strict=True):
            axes.plot(arm_line[:, across], arm_line[:, up], "-o", color="tab:gray", markersize=3, linewidth=1)
            axes.plot(tool_line[:, across], tool_line[:, up], color="tab:orange", linewidth=2)
        turn = np.linspace(0, 2 * np.pi, 100)
        centre, ball = plan.ball_centre_m, plan.ball_m
        axes.plot(centre[across] + ball * np.cos(turn), centre[up] + ball * np.sin(turn), ":", color="tab:blue")
        axes.set_aspect("equal")
        axes.set_title(title)
        axes.set_xlabel(f"base {'xyz'[across]} [m]")
        axes.set_ylabel(f"base {'xyz'[up]} [m]")
    figure.suptitle(f"{arm.name}: {len(plan.steps)} poses; dotted: all that moves stays in this ball of {ball:.2f} m")
    figure.savefig(path, format="png", dpi=110)
