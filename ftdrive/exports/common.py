"""What the exports of a plan share."""

from math import pi, radians

from ftdrive.errors import PlanRefused
from ftdrive.planning.plan import Plan

_FASTEST_RAD_S, _FASTEST_RAD_S2 = pi + 1e-9, radians(300) + 1e-9
_SPELLED = {"°": " deg", "·": " ", "±": "+/-", "×": "x", "–": "-", "µ": "u"}


def require_usable(plan: Plan) -> None:
    """Raise `PlanRefused` for placeholders, a move that is not proven clear, and numbers that no arm can follow."""
    if not plan.measured:
        raise PlanRefused(
            "nobody has said that tool, planes and boxes of this plan were measured, they may be placeholders: "
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
    """Reduce a text to what cannot end a string, a comment or a line where there are no escapes, as in URScript."""
    for sign, words in _SPELLED.items():
        text = text.replace(sign, words)
    return "".join(c if " " <= c <= "~" and c not in "\"'\\" else "?" for c in text)
