"""The page of the live wrench: the tool with force and torque, large numbers, six plots, events."""

from collections.abc import Sequence
from html import escape
from typing import Any, Final

import numpy as np

from ftcalib.rounding import to_place_of, with_sigma
from ftdrive.checks.check import Check
from ftdrive.checks.sensor import AXES
from ftdrive.live.samples import StreamInfo, frames_in_flange
from ftdrive.live.stages import stages_in_words
from ftdrive.planning.geometry.certify import Certifier
from ftdrive.terminal.live_feed import Feed
from ftdrive.terminal.live_panels import full_scale, line_of_force, meaning, time_of_day
from ftdrive.terminal.live_view import SPANS_S, PlotColumns, ShownWrench, Summary, View
from ftdrive.view.page import Page
from ftdrive.view.scene import DrawnArm, DrawnWrench, draw_surroundings, size_of, turned
from ftdrivers.interfaces import Array
from ftdrivers.ur.kinematics import forward

# The plots follow each so many drawings of the rest.
_PLOT_EACH: Final = 5
# A plot of a page is about 300 pixels wide; 256 columns cut the history without a rest.
_COLUMNS, _PLOT_PX = 256, 110
_EVENTS: Final = 12
# An arrow that noise alone explains is not drawn.
_SIGNIFICANT: Final = 4.0
# An arm that moves less is not drawn again.
_STILL_RAD: Final = 1e-4
_SPEEDS: Final = (0.25, 0.5, 1.0, 2.0, 4.0, 10.0)
# Sizes of letters: a force of six digits fits a phone in the large one, a torque in the one below.
_LARGE, _MIDDLE, _SMALL = "26px", "19px", "13px"
_RED, _ORANGE, _BLUE = "#e03131", "#e8590c", "#1c7ed6"


class LivePage:
    """Fills a page with what a `Feed` reads.

    Parameters
    ----------
    checks : sequence of Check
        Findings to show among the events.
    certifier : Certifier, optional
        Arm, tool and surroundings; without it only the axes of the flange are drawn.
    controls : bool
        Whether viewers may tare.
    """

    def __init__(
        self,
        page: Page,
        feed: Feed,
        checks: Sequence[Check] = (),
        certifier: Certifier | None = None,
        *,
        controls: bool = False,
    ) -> None:
        self._page, self._feed, self._certifier = page, feed, certifier
        self._summary = Summary(feed, checks)
        self._drawn = 0
        self._scene()
        gui: Any = page.gui
        self._head, self._numbers = gui.add_html(""), gui.add_html("")
        if controls:
            for name, key in (("Tare", "t"), ("Undo tare", "u")):
                gui.add_button(name).on_click(lambda _, key=key: feed.request(key))
        self._replay_controls()
        span = gui.add_dropdown("span of the plots", [f"{span_s} s" for span_s in SPANS_S], initial_value="10 s")
        span.on_update(lambda _: setattr(self._summary, "span_s", int(span.value.split()[0])))
        self._plots = [self._add_plot(i) for i in range(6)]
        with gui.add_folder("events"):
            self._events = gui.add_html("")

    def _scene(self) -> None:
        scene, certifier = self._page.scene, self._certifier
        self._arm, self._q_rad = None, np.full(6, np.inf)
        if certifier is None:
            scene.add_frame("/base", axes_length=0.2, axes_radius=0.004)
            self._page.look(np.array([0.0, 0.0, 0.3]), np.array([1.5, 1.5, 1.2]))
        else:
            draw_surroundings(scene, certifier.scene, size_of(certifier))
            self._arm = DrawnArm(scene, certifier.arm)
            self._arm.hide()
            self._arm.reveal()
            self._page.look(np.array([0.0, 0.0, 0.4]), size_of(certifier) * np.array([0.5, 0.5, 0.5]))
        self._flange = scene.add_frame("/flange", axes_length=0.1, axes_radius=0.003)
        self._wrench = DrawnWrench(scene)

    def _replay_controls(self) -> None:
        gui: Any = self._page.gui
        replay = self._summary.view().replay
        if replay is None:
            return
        self._play: Any = gui.add_button("Pause")
        self._play.on_click(lambda _: self._feed.request("space"))
        self._seek: Any = gui.add_slider(
            "seconds", min=0.0, max=max(replay.duration_s, 0.1), step=0.1, initial_value=0.0
        )
        speed = gui.add_dropdown("speed", [f"{each:g}" for each in _SPEEDS], initial_value=nearest_speed(replay.speed))
        speed.on_update(lambda _: self._feed.request("speed", speed.value))
        self._seek.on_update(self._go_to)

    def _go_to(self, moved: Any) -> None:
        # the page itself moves the slider too
        if moved.client is not None:
            self._feed.request("seek", str(moved.target.value))

    def _add_plot(self, i: int) -> Any:
        series = [{"width": 1, "stroke": stroke, "points": {"show": False}} for stroke in _STROKES]
        gui: Any = self._page.gui
        return gui.add_uplot(
            data=(np.array([-1.0, 0.0]), *np.zeros((6, 2))),
            series=({}, *series),
            bands=tuple({"series": pair, "fill": fill} for pair, fill in _BANDS),
            scales=_scales(1.0, 1.0),
            axes=({"size": 26, "space": 40}, {"size": 46, "space": 18}),
            title=f"{AXES[i]}, {'N' if i < 3 else 'N·m'}",
            legend={"show": False},
            # zoom and cursor of one are those of all
            cursor={"sync": {"key": "live"}},
            height=_PLOT_PX,
            padding=(6, 10, 0, 0),
        )

    def draw(self) -> None:
        """Take what is new, and draw it if there is a viewer."""
        view = self._summary.view()
        if not self._page.viewers:
            return
        with self._page.at_once():
            self._draw_scene(view)
            self._head.content, self._numbers.content = head(view), numbers(view)
            self._events.content = events(view)
            if view.replay is not None:
                self._play.label = "Play" if view.replay.is_paused else "Pause"
                self._seek.value = round(view.replay.at_s, 1)
        if self._drawn % _PLOT_EACH == 0 and view.reading is not None:
            self._draw_plots(view, view.reading)
        self._drawn += 1

    def _draw_scene(self, view: View) -> None:
        reading = view.reading
        if reading is None or view.silent:
            self._wrench.hide()
            return
        p_base_flange_m = reading.p_base_flange_m
        if self._arm is not None and self._certifier is not None and np.isfinite(reading.q_rad).all():
            # half of the time of a drawing
            if np.abs(reading.q_rad - self._q_rad).max() > _STILL_RAD:
                self._arm.show(reading.q_rad)
                self._q_rad = reading.q_rad
            if not np.isfinite(p_base_flange_m).all():
                p_base_flange_m = forward(self._certifier.arm.kinematics, reading.q_rad).p_m
        p_base_flange_m = np.nan_to_num(p_base_flange_m)
        self._flange.position, self._flange.wxyz = p_base_flange_m, turned(reading.R_base_flange)
        p_base_m, wrench_base = in_base(reading, view.info, p_base_flange_m)
        self._wrench.show(p_base_m, wrench_base * np.repeat([is_significant(reading, i) for i in (0, 3)], 3))

    def _draw_plots(self, view: View, reading: ShownWrench) -> None:
        columns = view.columns(_COLUMNS)
        fulls = [full_scale(columns, reading, first) for first in (0, 3)]
        with self._page.at_once():
            for i, plot in enumerate(self._plots):
                full = fulls[i // 3]
                # else a browser makes the plot again, and a zoom is lost
                if plot.scales != (scales := _scales(columns.span_s, full)):
                    plot.scales = scales
                plot.data = plot_data(columns, i, full, float(reading.sample_sigma[i]))


# Smallest and largest value, ± sigma, contact and the lower edge.
_STROKES: Final = (_BLUE, _BLUE, "#868e96", "#868e96", "transparent", "transparent")
_BANDS: Final = (
    ((5, 6), "rgba(232, 89, 12, 0.25)"),
    ((3, 4), "rgba(134, 142, 150, 0.3)"),
    ((2, 1), "rgba(28, 126, 214, 0.5)"),
)


def _scales(span_s: float, full: float) -> dict[str, Any]:
    return {"x": {"time": False, "range": (-span_s, 0.0)}, "y": {"range": (-full, full)}}


def plot_data(columns: PlotColumns, i: int, full: float, sigma: float) -> tuple[Array, ...]:
    """Return what the plot of component `i` shows, seven arrays (n,).

    They are the time before now in s, the smallest and the largest value, plus and minus `sigma`, and an upper and a
    lower edge: apart by the height of the plot, ± `full`, where there is contact.
    """
    n = len(columns.in_contact)
    t_s = np.asarray((np.arange(n) + 1.0 - n) * columns.column_ns * 1e-9, np.float64)
    band: Array = np.full(n, np.nan_to_num(sigma))
    edge: Array = np.full(n, -full)
    contact: Array = np.where(columns.in_contact, full, edge)
    return t_s, columns.low[i], columns.high[i], band, -band, contact, edge


def in_base(reading: ShownWrench, info: StreamInfo, p_base_flange_m: Array) -> tuple[Array, Array]:
    """Return reference point (3,) and wrench (6,) in base axes."""
    R = reading.R_base_flange
    frames = frames_in_flange(reading.frame, info, R)
    R_flange_axes, p_flange_m = frames.get(reading.frame.id, (np.eye(3), np.zeros(3)))
    return p_base_flange_m + R @ p_flange_m, (reading.wrench.reshape(2, 3) @ (R @ R_flange_axes).T).ravel()


def is_significant(reading: ShownWrench, first: int) -> bool:
    """Whether the force (`first` 0) or the torque (3) is more than noise; it is not before the noise is known."""
    size, sigma = reading.size(first)
    return size > _SIGNIFICANT * sigma


def nearest_speed(speed: float) -> str:
    """Return the choice of the page that is nearest to a speed of a replay."""
    return f"{min(_SPEEDS, key=lambda each: abs(each - speed)):g}"


def head(view: View) -> str:
    """Name the devices, what the numbers are, and in red a silent device; HTML."""
    info, reading = view.info, view.reading
    parts = [devices(info)]
    if view.silent:
        parts.append(f'<b style="color: {_RED}">{escape(view.silent)}</b>')
    if reading is None:
        parts.append("waiting for the first sample")
    else:
        stages = stages_in_words(reading.stages)
        parts.append(f"{meaning(reading.stages)}, {escape(str(reading.frame))}. Stages: {escape(stages)}.")
    return lines(parts)


def devices(info: StreamInfo) -> str:
    """Name arm, sensor and tool, and whether they are emulated; HTML."""
    return escape(" · ".join(filter(None, [info.arm.model, info.sensor.model, info.tool, *info.marks])))


def numbers(view: View) -> str:
    """Show force and torque with their sigmas, and contact; HTML."""
    reading = view.reading
    if reading is None or view.silent:
        return lines(["-- N"], _LARGE) + lines(["-- N·m"], _MIDDLE)
    force, torque = (number(reading, first) for first in (0, 3))
    state = f'<span style="color: {_ORANGE}">contact, {view.contact_s:.1f} s</span>' if reading.in_contact else "free"
    line = str(line_of_force(reading))
    found = ((force, _LARGE), (torque, _MIDDLE))
    shown = "".join(lines([size], px) + lines([rest]) for (size, rest), px in found)
    return shown + lines([state, escape(line)], "14px")


def number(reading: ShownWrench, first: int) -> tuple[str, str]:
    """Return the size of the force (`first` 0) or the torque (3), and its sigma without contact, as words.

    Such as "98.0 ± 2.1 N" and "sigma 0.050 N at rest".
    """
    (size, sigma), unit = reading.size(first), "N·m" if first else "N"
    if not np.isfinite(sigma):
        return f"{size:.2f} {unit}", "the noise is not known yet"
    rest = float(reading.rest_sigma[first : first + 3].max())
    return f"{with_sigma(size, sigma)} {unit}", f"sigma {to_place_of(rest, rest)} {unit} at rest"


def events(view: View) -> str:
    """List the newest events first; HTML."""
    found = []
    for note, _ in zip(view.notes, range(_EVENTS), strict=False):
        at = "" if note.t_host_ns is None else f"{time_of_day(view.info, note.t_host_ns)} "
        found.append(f"{at}{escape(note.words)}")
    return lines(found)


def lines(texts: Sequence[str], size: str = _SMALL) -> str:
    """Return texts below each other; HTML."""
    inside = "".join(f"<div>{text}</div>" for text in texts if text)
    return f'<div style="font-size: {size}; padding: 0 8px; overflow-wrap: anywhere">{inside}</div>'
