"""The screen of `ftdrive weigh`: one large number."""

import threading
from typing import ClassVar

from textual.app import App, ComposeResult
from textual.widgets import Digits, Static

from ftcalib.rounding import to_place_of
from ftdrive.errors import NotAccepted
from ftdrive.terminal.weighing import Shown, Weighing, line_of
from ftdrivers.errors import DeviceError

_REFRESH_S = 0.1


class _Reader(threading.Thread):
    """Reads and weighs, because a screen that draws must not keep the stream waiting."""

    def __init__(self, weighing: Weighing) -> None:
        super().__init__(daemon=True)
        self._weighing = weighing
        self.shown = Shown(None, "samples")
        self.note = ""
        self.failure: DeviceError | None = None
        self.zero_requested = False
        self.ends = False

    def run(self) -> None:
        """Read until `ends`."""
        try:
            for shown, _ in self._weighing.states():
                self.shown = shown
                if self.ends:
                    return
                if self.zero_requested:
                    self.zero_requested = False
                    self.note = self._zero()
        except DeviceError as error:
            self.failure = error

    def _zero(self) -> str:
        try:
            self._weighing.zero()
        except NotAccepted as error:
            return str(error)
        return "zero: the empty gripper was tared"


class WeighApp(App[None]):
    """The scale.

    Parameters
    ----------
    weighing : Weighing
    """

    ENABLE_COMMAND_PALETTE = False
    CSS = "Screen { layout: vertical; } Digits { margin: 1 2 0 2; } Static { margin: 0 2; } #keys { dock: bottom; }"
    BINDINGS: ClassVar = [("z", "zero", "zero"), ("p", "poses", "poses"), ("q", "quit", "quit")]

    def __init__(self, weighing: Weighing) -> None:
        super().__init__()
        self._weighing = weighing
        self.reader = _Reader(weighing)

    def compose(self) -> ComposeResult:
        """Yield the widgets."""
        yield Static(f"ftdrive weigh   tool {self._weighing.stream.info.tool}")
        yield Digits("-", id="mass")
        yield Static("", id="sigma")
        yield Static("", id="line")
        yield Static("", id="note")
        yield Static(" z zero the empty gripper   p join poses of one load   q quit", id="keys")

    def on_mount(self) -> None:
        """Start reading."""
        self.reader.start()
        self.set_interval(_REFRESH_S, self._show)

    def _show(self) -> None:
        if self.reader.failure is not None:
            self.exit()
            return
        shown = self.reader.shown
        weight = shown.weight if shown.refusal is None else None
        self.query_one("#mass", Digits).update(
            "- - -" if weight is None else f"{to_place_of(weight.mass_kg, weight.mass_sigma_kg)} kg"
        )
        self.query_one("#sigma", Static).update(
            "" if weight is None else _sigma_line(shown, joins=self._weighing.joins)
        )
        self.query_one("#line", Static).update(line_of(shown))
        self.query_one("#note", Static).update(self.reader.note)

    def action_zero(self) -> None:
        """Tare the empty gripper."""
        self.reader.note = "zero: half a second …"
        self.reader.zero_requested = True

    def action_poses(self) -> None:
        """Join the poses of one load from now on, or stop that."""
        self._weighing.joins = not self._weighing.joins


def _sigma_line(shown: Shown, *, joins: bool) -> str:
    weight = shown.weight
    assert weight is not None  # noqa: S101 - the caller has checked it
    parts = "" if shown.count is None else f"{shown.count} parts   "
    poses = f"   {weight.poses} poses joined, turn the tool for more" if joins else ""
    sigma_g, least_g = 1e3 * weight.mass_sigma_kg, 1e3 * weight.least_kg
    zero = "   zero first: drift since the calibration" if least_g > 100 else ""
    return f"{parts}sigma {sigma_g:.2g} g, smallest mass {least_g:.2g} g{zero}{poses}"


def run_weigh(weighing: Weighing) -> None:
    """Show the scale until the user quits. Raises the failure of the stream."""
    app = WeighApp(weighing)
    try:
        app.run()
    finally:
        app.reader.ends = True
        app.reader.join(2.0)
    if app.reader.failure is not None:
        raise app.reader.failure
