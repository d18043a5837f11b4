"""The page of the scale: the mass in large digits, what it is worth, why there is none, and the age of the zero."""

from datetime import timedelta
from math import isfinite

from ftcalib.rounding import to_place_of
from ftdrive.live.weighing import UNZEROED_KG, Weighing, line_of, worth_of
from ftdrive.runs.verification import age_in_words
from ftdrive.view import parts
from ftdrive.view.live_page import BLANK, devices
from ftdrive.view.page import Page


class WeighPage:
    """Fills a page with the state of a scale; with `controls` viewers may tare the empty gripper."""

    def __init__(self, page: Page, weighing: Weighing, *, controls: bool) -> None:
        self._page, self._weighing = page, weighing
        page.on("zero", lambda *_: weighing.request_zero())
        if controls and not weighing.moving:
            page.put({"controls": parts.controls(parts.button("zero", "Zero the empty gripper"))})

    def draw(self) -> None:
        """Show the present state if there is a viewer."""
        if self._page.viewers:
            self._page.put(words(self._weighing))


def words(weighing: Weighing) -> dict[str, parts.Part | None]:
    """Return the mass, or why there is none, the count of parts and the age of the zero."""
    shown, zeroed_s, zero, tone = weighing.shown, weighing.stream.reference()[1], "", ""
    weight, mass = shown.measured, parts.number("Mass in the gripper", "- - -", "", note=BLANK, size="huge")
    if not weighing.moving:
        zero = f"zeroed {age_in_words(timedelta(seconds=zeroed_s))} ago" if isfinite(zeroed_s) else "not zeroed"
    if weight is not None:
        kg, sigma = (to_place_of(one, weight.mass_sigma_kg, "z") for one in (weight.mass_kg, weight.mass_sigma_kg))
        mass |= {"value": kg, "unit": "kg", "sigma": f"± {sigma} kg", "note": worth_of(weight)}
        if zero and weight.least_kg > UNZEROED_KG:
            zero, tone = f"{zero}: zero {'again' if isfinite(zeroed_s) else 'the empty gripper'}", parts.WARN
    rows = [mass]
    if weighing.part_kg is not None:
        rows.append(parts.number("Parts", "-" if shown.count is None else str(shown.count), "", size="large"))
    line = parts.lines(line_of(shown), tone=parts.BAD if shown.stale else parts.WARN if shown.refusal else "")
    return {
        "alert": line if shown.stale else None,
        "state": parts.lines(devices(info := weighing.stream.info), tone=parts.WARN if info.marks else parts.QUIET),
        "numbers": parts.numbers(*rows),
        "table/line": None if shown.stale else line,
        "table/zero": parts.lines(zero, weighing.note, tone=tone),
    }
