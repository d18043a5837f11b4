"""Checks and text conversion shared by the exports of a plan."""

from math import pi, radians

from ftdrive.errors import PlanRefused
from ftdrive.planning.plan import Plan

_FASTEST_RAD_S, _FASTEST_RAD_S2 = pi + 1e-9, radians(300) + 1e-9
_SPELLED = str.maketrans({"°": " deg", "·": " ", "±": "+/-", "×": "x", "–": "-", "µ": "u", "²": "2"})


def require_usable(plan: Plan) -> None:
    """Raise `PlanRefused` for sweeps, placeholders, moves that are not proven clear, and values no arm can follow."""
    if plan.sweep is not None:
        raise PlanRefused("this plan is a sweep, which no other program can follow: export the plan of a tour")
    if not plan.measured:
        raise PlanRefused(
            "tool, planes and boxes of this plan are not marked as measured: "
            "measure them, set measured = true in [workcell], and make a new plan"
        )
    if not plan.certified:
        raise PlanRefused("a move of the plan is not proven clear: it is not exported")
    angles = [angle for step in plan.steps for angle in step.q_rad]
    if (
        any(len(step.q_rad) != 6 for step in plan.steps)
        or not all(abs(angle) <= 2 * pi + 1e-9 for angle in angles)
        or not all(0 < step.speed_rad_s <= _FASTEST_RAD_S for step in plan.steps)
        or not 0 < plan.acceleration_rad_s2 <= _FASTEST_RAD_S2
    ):
        raise PlanRefused("the plan holds a joint angle, speed or acceleration that no arm can follow: make a new plan")


def plain(text: str) -> str:
    """Reduce a text to printable ASCII without quotes and backslashes, because URScript strings have no escapes."""
    return "".join(c if " " <= c <= "~" and c not in "\"'\\" else "?" for c in text.translate(_SPELLED))
