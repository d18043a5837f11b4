"""The live screen: the compensated wrench in a terminal, with keys and mouse.

`Feed` reads the stream in a thread. Ten times a second `Summary` takes what is new, `layout.frame` draws its `View` as
lines, and only the lines that changed are sent to the terminal.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import ClassVar

from textual import events
from textual.app import ComposeResult
from textual.widgets import Input

from ftdrive.checks.belonging import check_calibration
from ftdrive.checks.check import Check
from ftdrive.live.stream import ProcessedStream
from ftdrive.runs.verification_record import fitted_dataset
from ftdrive.terminal.canvas import REFRESH_S, Canvas, ClosableApp
from ftdrive.terminal.console import messages
from ftdrive.terminal.live.feed import Feed, Sink, after
from ftdrive.terminal.live.layout import frame
from ftdrive.terminal.live.lines import Line
from ftdrive.terminal.live.view import SPANS_S, Summary

_HELP = """\
 ftdrive live: the wrench on the tool, ten times a second

 now      mean of the last 0.1 s
 ± σ      one sigma of that mean: noise and calibration
 peak     extremes since p
 bars     their scale follows the recent extremes

 t tare: change the bias so that a free tool reads zero        u undo the tare
 x axes: sensor, flange, base, tcp     a reference point: sensor, flange, tcp
 1 2 3 4 stages: bias, gravity, inertia, low-pass
 z freeze the screen; a recording goes on
 b mark: text for recording and plots  r start or complete a recording
 p reset the peaks                     g span of the plots: 2, 10, 60, 600 s

 Emulated cell: f push the tool with 8 N for 1 s
 Replay: space pause    ← → seek 5 s    . next samples    + - speed

 Plots: smallest and largest value of each column; dotted lines at 0 and at
        ± 1 sigma of a sample; ━ contact, ◆ mark, tare or change of stages
 The mouse works on stages, axes, point, peaks, span and keys.

 Any key returns."""


def run_live(
    stream: ProcessedStream,
    *,
    recorder: Callable[[Path], Sink] | None = None,
    push: Callable[[], object] | None = None,
    checks: Sequence[Check] = (),
) -> None:
    """Show a stream until the user quits.

    Parameters
    ----------
    stream : CompensatedStream or ReplayedStream
        Open; it is read here, and closed by the caller.
    recorder : callable, optional
        Opens a recording in a new file; the key r starts and completes one.
    push : callable, optional
        Pushes the tool of an emulated cell, by the key f.
    checks : sequence of Check
        Findings about the cell that the stream does not know, such as "robot.payload".

    Raises
    ------
    DeviceError
        The stream had failed when the user quit.
    """
    info = stream.info
    devices = check_calibration(info.calibration, {"arm": info.arm, "sensor": info.sensor})
    feed = Feed(stream, recorder, push)
    dataset = fitted_dataset(info.calibration, Path(info.calibration_name))
    app = LiveApp(feed, Summary(feed, [devices, *checks], dataset))
    feed.start()
    try:
        app.run_on_terminal()
    finally:
        feed.stop()
        for path in feed.recorded:
            messages.print(f" Recorded: {path}")
    if feed.crash is not None:
        raise feed.crash
    if feed.reader.failure is not None:
        raise feed.reader.failure


class LiveApp(ClosableApp):
    """Draws what a `Feed` knows."""

    ENABLE_COMMAND_PALETTE = False
    CSS = "Input { dock: bottom; height: 1; border: none; padding: 0 1; }"
    BINDINGS: ClassVar = [("ctrl+c", "press('q')", "quit")]
    TITLE = "ftdrive live"

    def __init__(self, feed: Feed, summary: Summary) -> None:
        # the terminal's own colours, light or dark
        super().__init__(ansi_color=True)
        self.theme = "ansi-dark"
        self._feed, self._summary = feed, summary
        self._canvas = Canvas()
        self._helping = False

    def compose(self) -> ComposeResult:
        """Build the screen."""
        yield self._canvas

    def on_mount(self) -> None:
        """Start to draw."""
        self.set_interval(REFRESH_S, self.draw)

    def on_resize(self) -> None:
        """Draw at the new size."""
        self.draw()

    def draw(self) -> None:
        """Draw the present state."""
        if self._feed.crash is not None:
            self.exit()
            return
        width, height = self.size
        view = self._summary.view()
        if self._helping:
            lines = [Line(text).fit(width) for text in _HELP.split("\n")]
            self._canvas.show((lines + [Line().to(width)] * height)[:height])
        else:
            self._canvas.show(frame(view, width, height))

    def on_key(self, event: events.Key) -> None:
        """Do what a key stands for."""
        if not self.query(Input):
            self.action_press(event.character if event.character and event.character > " " else event.key)
        elif event.key == "escape":
            self.query_one(Input).remove()

    def on_input_submitted(self, event: Input.Submitted) -> None:
        """Put the entered mark into the stream."""
        event.input.remove()
        if event.value:
            self._feed.request("b", event.value)

    def action_press(self, key: str) -> None:
        """Do what a key stands for."""
        if self._helping:
            self._helping = False
        elif key == "?":
            self._helping = True
        elif key == "q":
            self.exit()
        elif key == "z":
            self._summary.is_frozen = not self._summary.is_frozen
        elif key == "p":
            self._summary.reset_peaks()
        elif key == "g":
            self._summary.span_s = after(self._summary.span_s, SPANS_S)[0]
        elif key == "b":
            self.mount(entry := Input(placeholder="text of the mark, then Enter; Esc leaves"))
            entry.focus()
        else:
            self._feed.request(key)
        self.draw()
