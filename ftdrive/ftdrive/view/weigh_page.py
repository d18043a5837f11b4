"""The page of the scale: the mass in large letters, with what it is worth."""

from html import escape
from typing import Any, Final

from ftcalib.rounding import counted, with_sigma
from ftdrive.live.weighing import ScaleState, Weighing, line_of, worth_of
from ftdrive.view.live_page import devices, lines
from ftdrive.view.page import Page

_HUGE: Final = "34px"


class WeighPage:
    """Fills a page with the state of a scale.

    Parameters
    ----------
    controls : bool
        Whether viewers may tare the empty gripper.
    """

    def __init__(self, page: Page, weighing: Weighing, *, controls: bool = False) -> None:
        self._page, self._weighing = page, weighing
        gui: Any = page.gui
        self._shown = gui.add_html("")
        if controls and not weighing.moving:
            gui.add_button("Zero the empty gripper").on_click(lambda _: weighing.request_zero())

    def draw(self) -> None:
        """Draw the present state if there is a viewer."""
        if self._page.viewers:
            head = devices(self._weighing.stream.info)
            self._shown.content = lines([head]) + scale(self._weighing.shown, self._weighing.note)


def scale(shown: ScaleState, note: str = "") -> str:
    """Return the mass, the smallest mass, the count, and why nothing is weighed; HTML."""
    weight = shown.measured
    mass = "- - -" if weight is None else f"{with_sigma(weight.mass_kg, weight.mass_sigma_kg, 'z')} kg"
    count = "" if shown.count is None else counted(shown.count, "part")
    worth = "" if weight is None else worth_of(weight)
    return lines([mass], _HUGE) + lines([count], "26px") + lines([worth, escape(line_of(shown)), escape(note)], "14px")
