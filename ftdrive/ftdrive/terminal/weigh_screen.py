"""The screen of `ftdrive weigh`: one large number, in the digits of Textual."""

import threading
from typing import ClassVar

from textual.app import ComposeResult
from textual.widgets import Digits, Static

from ftcalib.after.weighing import Weight
from ftcalib.rounding import counted, to_place_of
from ftdrive.live.weighing import Weighing, line_of, worth_of
from ftdrive.terminal.closable_app import REFRESH_S, ClosableApp

# With a larger smallest mass the drift since the calibration decides, and a zero helps.
_UNZEROED_KG = 0.1


class _Reader(threading.Thread):
    """Reads and weighs, because a screen that draws must not keep the stream waiting."""

    def __init__(self, weighing: Weighing) -> None:
        super().__init__(daemon=True)
        self._weighing = weighing
        self.failure: BaseException | None = None
        self.ends = False

    def run(self) -> None:
        try:
            for _ in self._weighing.states():
                if self.ends:
                    return
        except BaseException as error:  # the main thread raises it
            self.failure = error


class WeighApp(ClosableApp):
    """The scale.

    Parameters
    ----------
    weighing : Weighing
    """

    ENABLE_COMMAND_PALETTE = False
    CSS = "Screen { layout: vertical; } Digits { margin: 1 2 0 2; } Static { margin: 0 2; } #keys { dock: bottom; }"
    BINDINGS: ClassVar = [
        ("z", "zero", "zero"),
        ("p", "poses", "poses"),
        ("q", "quit", "quit"),
        ("ctrl+c", "quit", "quit"),
    ]

    def __init__(self, weighing: Weighing) -> None:
        super().__init__()
        self._weighing = weighing
        self.reader = _Reader(weighing)

    def compose(self) -> ComposeResult:
        """Yield the widgets."""
        info = self._weighing.stream.info
        yield Static("   ".join(["ftdrive weigh", f"tool {info.tool}", *info.marks]), markup=False)
        yield Digits("-", id="mass")
        yield Static("", id="sigma")
        yield Static("", id="line", markup=False)
        yield Static("", id="note", markup=False)
        keys = "" if self._weighing.moving else "z zero the empty gripper   p join poses of one load   "
        yield Static(f"{keys}q quit", id="keys")

    def on_mount(self) -> None:
        """Start reading."""
        self.reader.start()
        self.set_interval(REFRESH_S, self.draw)

    def draw(self) -> None:
        """Show the present state."""
        # it closes: the widgets go before the timer
        if not self.is_running:
            return
        if self.reader.failure is not None:
            self.exit()
            return
        shown = self._weighing.shown
        weight = shown.measured
        self.query_one("#mass", Digits).update(
            "- - -" if weight is None else f"{to_place_of(weight.mass_kg, weight.mass_sigma_kg, ' z')} kg"
        )
        self.query_one("#sigma", Static).update("" if weight is None else self._sigma_line(weight, shown.count))
        self.query_one("#line", Static).update(line_of(shown))
        self.query_one("#note", Static).update(self._weighing.note)

    def action_zero(self) -> None:
        """Tare the empty gripper."""
        if not self._weighing.moving:
            self._weighing.request_zero()

    def action_poses(self) -> None:
        """Join the poses of one load from now on, or stop that."""
        if not self._weighing.moving:
            self._weighing.joins = not self._weighing.joins

    def _sigma_line(self, weight: Weight, count: int | None) -> str:
        parts = "" if count is None else f"{counted(count, 'part')}   "
        words = f"{parts}{worth_of(weight)}"
        if self._weighing.moving:
            return words
        if self._weighing.joins:
            words += f"   {counted(weight.poses, 'pose')} joined, turn the tool for more"
        if weight.least_kg > _UNZEROED_KG:
            words += "   not zeroed: press z with an empty gripper"
        return words


def run_weigh(weighing: Weighing) -> None:
    """Show the scale until the user quits. Raises what ends it otherwise: of a device, or of the recording."""
    app = WeighApp(weighing)
    try:
        app.run_on_terminal()
    finally:
        app.reader.ends = True
        app.reader.join(2.0)
    if app.reader.failure is not None:
        raise app.reader.failure
