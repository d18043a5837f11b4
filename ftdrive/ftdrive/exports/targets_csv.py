"""A plan as a table of joint targets."""

from ftdrive.exports.common import plain, require_usable
from ftdrive.planning.plan import Plan

FORMAT = "ftdrive.targets/1"
COLUMNS = "pose,orientation,q1_rad,q2_rad,q3_rad,q4_rad,q5_rad,q6_rad,speed_rad_s,acceleration_rad_s2,clearance_m"


def table(plan: Plan) -> str:
    """Write one line per pose, with speed, acceleration and clearance of the move to the next (last: first).

    The first line is a comment with the format, the plan's hash, the model, and whether the cell was emulated.
    """
    require_usable(plan)
    lines = [f"# {FORMAT} plan {plan.to_dict()['sha256']} {plain(plan.description['model'])}{_emulated(plan)}", COLUMNS]
    for i, step in enumerate(plan.steps, start=1):
        numbers = (*step.q_rad, step.speed_rad_s, plan.acceleration_rad_s2, step.clearance_m)
        lines.append(",".join([str(i), str(step.number), *(f"{number:.9g}" for number in numbers)]))
    return "\n".join(lines) + "\n"


def _emulated(plan: Plan) -> str:
    return ", EMULATED cell: no real arm may follow this plan" if plan.emulated else ""
