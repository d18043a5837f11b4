"""What the exports of a plan share."""

from math import isfinite, pi, radians

from ftdrive.errors import PlanRefused
from ftdrive.planning.plan import Plan

_FASTEST_RAD_S, _FASTEST_RAD_S2 = pi, radians(300)
_SPELLED = {"°": " deg", "·": " ", "±": "+/-", "×": "x", "–": "-", "µ": "u"}


def require_usable(plan: Plan) -> None:
    """Raise `PlanRefused` for a move that is not proven clear, and for numbers that no arm can follow."""
    if not plan.certified:
        raise PlanRefused("a move of the plan is not proven clear: it is not exported")
    numbers = [*(q / (2 * pi) for step in plan.steps for q in step.q_rad)]
    speeds = [
        *(step.speed_rad_s / _FASTEST_RAD_S for step in plan.steps),
        plan.acceleration_rad_s2 / _FASTEST_RAD_S2,
    ]
    usable = all(isfinite(x) and abs(x) <= 1 + 1e-9 for x in (*numbers, *speeds)) and all(x > 0 for x in speeds)
    if not usable or any(len(step.q_rad) != 6 for step in plan.steps):
        raise PlanRefused("the plan holds a joint angle, speed or acceleration that no arm can follow: make a new plan")


def plain(text: str) -> str:
    """Reduce a text to what cannot end a string, a comment or a line in a language without escapes, such as URScript."""
    for sign, words in _SPELLED.items():
        text = text.replace(sign, words)
    return "".join(c if " " <= c <= "~" and c not in "\"'\\" else "?" for c in text)
