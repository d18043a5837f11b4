"""The pages of a stream: the live wrench with the tool, arrows and six plots, and the scale with the mass."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import islice
from typing import Any, get_args

import numpy as np
from scipy.spatial.transform import Rotation

from ftcalib.rounding import to_place_of
from ftdrive.checks.check import Check
from ftdrive.checks.sensor import AXES
from ftdrive.errors import ConfigError
from ftdrive.planning.geometry.certify import Certifier
from ftdrive.stream.feed import SPANS_S, Feed
from ftdrive.stream.samples import Axes, Point, StreamInfo, frames_in_flange
from ftdrive.stream.stages import stages_in_words
from ftdrive.stream.weighing import Weighing, format_scale
from ftdrive.view import parts, scene
from ftdrive.view.page import Page
from ftdrive.view.parts import Part
from ftdrive.words import stream as words
from ftdrive.words.stream import NO_MASS, ShownWrench, StreamSummary, View, worth_of, zero_in_words
from ftdrivers.interfaces import Array
from ftdrivers.ur.kinematics import forward

# Plots are redrawn only at every fifth drawing of the page. A plot is about 250 pixels wide, two pixels per column.
_PLOT_EACH, _COLUMNS, _EVENTS = 5, 128, 30
# The arm is redrawn only if a joint has moved by more than this.
_STILL_RAD = 1e-4
_SPEEDS = (0.25, 0.5, 1.0, 2.0, 4.0, 10.0)
_M_PER_N, _M_PER_NM = 0.01, 0.1
_LEGEND = (
    ("force", "arrow", f"force, {1e3 * _M_PER_N:g} mm for 1 N"),
    ("torque", "arrow", f"torque, {1e3 * _M_PER_NM:g} mm for 1 N·m"),
    ("force", "line", "line of action of the force"),
    *((axis, "line", f"{axis} of base and flange") for axis in "xyz"),
)
_FOR_ALL = "Axes and point change for all viewers, in the terminal, and in printed and recorded data."
_PLOTS = "blue: smallest to largest value, grey: ± 1 sigma of a free tool, orange: contact"
# Colours of the contact state.
_TONES = {words.CONTACT: parts.WARN, words.FREE: parts.GOOD}
_ROWS = (("State", "", "large"), ("Force on the tool", "N", "huge"), ("Torque", "N·m", "large"))
# Shown in place of an empty line, so that the line keeps its height and buttons below it do not move.
_BLANK = "\u00a0"


class LivePage:
    """Fills the page of `ftdrive live` with the stream of a `Feed`.

    Without a `certifier`, which has the model of the arm, only the axes of base and flange are drawn. With `controls`,
    viewers can tare, and choose axes and reference point, which ends a contact and is recorded.
    """

    def __init__(
        self, page: Page, feed: Feed, checks: Sequence[Check], certifier: Certifier | None, *, controls: bool
    ) -> None:
        self._page, self._feed, self._tares = page, feed, controls
        self._summary = StreamSummary(feed, checks)
        self._drawn, self._q_rad = 0, np.full(6, np.inf)
        self._arm = None if certifier is None else certifier.arm
        page.put(_static_scene(certifier))
        page.on("tare", lambda *_: feed.do(feed.stream.tare))
        page.on("undo", lambda *_: feed.do(feed.stream.undo_tare))
        if (replay := self._summary.view().replay) is not None:
            page.on("play", lambda *_: feed.do(replay.toggle))
            page.on("seek", lambda _, t_s: feed.do(partial(replay.seek, t_s)))
            page.on("speed", lambda _, speed: feed.do(partial(setattr, replay, "speed", float(speed))))
        page.on("axes", lambda _, axes: self._set_frame(axes=axes))
        page.on("about", lambda _, about: self._set_frame(about=about))
        page.on("span", lambda _, span: setattr(self._summary, "span_s", int(span.split()[0])))

    def _set_frame(self, **change: Any) -> None:
        try:
            self._feed.stream.frame = replace(self._feed.stream.frame, **change)
        except ConfigError as error:  # shown on the page
            raise ValueError(str(error)) from error

    def draw(self) -> None:
        """Take the new data of the stream, and show them if a browser shows the page."""
        view = self._summary.view()
        if not self._page.viewers:
            self._drawn = 0
            return
        reading = view.live
        shown = {**texts(view, reading), **self._scene(view, reading), **self._controls(view)}
        if self._drawn % _PLOT_EACH == 0 or reading is None:
            shown["plots"] = None if reading is None else plots(view, reading)
        self._page.put(shown)
        self._drawn += 1

    def _controls(self, view: View) -> dict[str, Part | None]:
        replay, frame, span_s = view.replay, self._feed.stream.frame, self._summary.span_s
        found = [parts.button("tare", "Tare"), parts.button("undo", "Undo tare")] if self._tares else []
        if replay is not None:
            at, speeds = f"{replay.at_s:.1f} of {replay.duration_s:.1f} s", sorted({*_SPEEDS, replay.speed})
            found.append(parts.button("play", "Play" if replay.is_paused or replay.has_ended else "Pause"))
            found.append(parts.slider("seek", "Time", round(replay.at_s, 1), replay.duration_s, step=0.1, text=at))
            found.append(parts.choice("speed", "Speed", f"{replay.speed:g}", [f"{speed:g}" for speed in speeds]))
        shown: dict[str, Part | None] = {}
        if found:
            about = frame.about if isinstance(frame.about, str) else ""
            axes = parts.choice("axes", "Axes", frame.axes, get_args(Axes))
            point = parts.choice("about", "Torque about", about, get_args(Point))
            shown["controls/frame"] = parts.controls(axes, point, note=_FOR_ALL)
        span = parts.choice("span", "Plots of the last", f"{span_s} s", [f"{one} s" for one in SPANS_S], words=_PLOTS)
        return {"controls": parts.controls(*found, span), **shown}

    def _scene(self, view: View, reading: ShownWrench | None) -> dict[str, Part | None]:
        arm, shown = self._arm, dict[str, Part | None]()
        if reading is None:
            self._q_rad = np.full(6, np.inf)
            gone = {} if arm is None else scene.arm_parts(arm, None)
            return {**gone, **scene.NO_WRENCH, "scene/flange": None, "scene/flange name": None}
        p_m = reading.p_base_flange_m
        if arm is not None and np.isfinite(reading.q_rad).all():
            if np.abs(reading.q_rad - self._q_rad).max() > _STILL_RAD:
                shown, self._q_rad = scene.arm_parts(arm, reading.q_rad, clear=True), reading.q_rad
            if not np.isfinite(p_m).all():
                p_m = forward(arm.kinematics, reading.q_rad).p_m
        p_m = np.nan_to_num(p_m)
        turn = Rotation.from_matrix(reading.R_base_flange).as_quat(scalar_first=True)
        shown["scene/flange"] = scene.axes(0.1, p_m, turn)
        shown["scene/flange name"] = scene.label("flange", p_m)
        p_base_m, wrench_base = _in_base(reading, view.info, p_m)
        drawn = wrench_base * np.repeat([reading.is_significant(first) for first in (0, 3)], 3)
        return shown | scene.wrench_parts(p_base_m, drawn, _M_PER_N, _M_PER_NM)


def _static_scene(certifier: Certifier | None) -> dict[str, Part | None]:
    shown: dict[str, Part | None] = {"scene/base": scene.axes(0.25, named=True)}
    rows, size_m = [*_LEGEND], 2.0
    if certifier is not None:
        size_m = scene.size_of(certifier)
        rows = [("arm", "body", "arm"), ("tool", "body", "tool"), *_LEGEND]
        rows += [("obstacle", "body", "planes and boxes")] * bool(certifier.scene.planes or certifier.scene.boxes)
        shown = scene.surroundings(certifier.scene, size_m)
    camera = scene.camera((0, 0, 0.4), np.full(3, 0.6 * size_m))
    return shown | {"scene/camera": camera, "scene/legend": scene.legend(*rows)}


def _in_base(reading: ShownWrench, info: StreamInfo, p_base_flange_m: Array) -> tuple[Array, Array]:
    """Return the reference point (3,) of a shown wrench, and the wrench (6,), both in base axes."""
    R, frame = reading.R_base_flange, reading.frame
    R_flange_axes, p_flange_m = frames_in_flange(frame, info, R).get(frame.id, (np.eye(3), np.zeros(3)))
    return p_base_flange_m + R @ p_flange_m, (reading.wrench.reshape(2, 3) @ (R @ R_flange_axes).T).ravel()


def texts(view: View, reading: ShownWrench | None) -> dict[str, Part | None]:
    """Return the page's texts: device without samples, contact state, force and torque, their meaning, events."""
    what, (state, _), info = words.WAITING, words.state(view), view.info
    rows = [parts.reading(name, "--", unit, note=_BLANK, size=size, tone=parts.BAD) for name, unit, size in _ROWS]
    if reading is not None:
        what = f"{words.wrench_meaning(view)}, {reading.frame}; stages: {stages_in_words(reading.stages)}"
        value = f"{state}, {view.contact_s:.1f} s" if state == words.CONTACT else state
        note = words.line_of_force(reading) or _BLANK
        rows[0] |= {"value": value, "note": note, "tone": _TONES.get(state, parts.QUIET)}
        rows[1:] = [_size_line(view, reading, 0), _size_line(view, reading, 3)]
    notes = [
        note.words if note.t_host_ns is None else f"{words.time_of_day(info, note.t_host_ns)} {note.words}"
        for note in islice(view.notes, _EVENTS)
    ]
    return {
        "alert": parts.lines(view.silent, head="No live values", tone=parts.BAD) if view.silent else None,
        "numbers": parts.readings(*rows),
        "table": _devices(info),
        "table/what": parts.lines(what, tone=parts.QUIET),
        "events": parts.lines(*notes, head="Events, newest first") if notes else None,
    }


def _devices(info: StreamInfo) -> Part:
    texts = " · ".join([words.name_devices(info), *info.marks])
    return parts.lines(texts, tone=parts.WARN if info.marks else parts.QUIET)


def _size_line(view: View, reading: ShownWrench, first: int) -> Part:
    (size, sigma), (name, unit, large) = reading.size(first), _ROWS[2 if first else 1]
    name += f" {str(reading.frame).partition(', ')[2]}" if first else f", {words.wrench_meaning(view)}"
    around = f"± {to_place_of(sigma, sigma)} (1 sigma)" if np.isfinite(sigma) else ""
    note = words.direction_text(reading, first) or _BLANK
    return parts.reading(name, to_place_of(size, sigma), unit, sigma=around, note=note, size=large)


def plots(view: View, reading: ShownWrench) -> Part:
    """Return the plots of the six wrench components, each headed by the current value."""
    past, found, full = view.columns(_COLUMNS), list[Part](), dict[str, float]()
    low, high, sigma = (
        parts.rounded_list(past.low, 3),
        parts.rounded_list(past.high, 3),
        np.nan_to_num(reading.sample_sigma),
    )
    for i, (axis, unit) in enumerate(zip(AXES, ["N"] * 3 + ["N·m"] * 3, strict=True)):
        label = f"{axis} {to_place_of(reading.wrench[i], reading.sigma[i], '+z')}"
        full[unit] = words.full_scale(past, reading, i // 3 * 3)
        found.append({"label": label, "unit": unit, "low": low[i], "high": high[i], "sigma": float(sigma[i])})
    contact, step_s = past.in_contact.astype(int).tolist(), past.column_ns * 1e-9
    return {"kind": "plots", "span_s": past.span_s, "step_s": step_s, "full": full, "contact": contact, "plots": found}


class WeighPage:
    """Fills the page of `ftdrive weigh`: mass and sigma, or why there is no mass, and the age of the last zero.

    With `controls`, viewers can tare the empty gripper.
    """

    def __init__(self, page: Page, weighing: Weighing, *, controls: bool) -> None:
        self._page, self._weighing = page, weighing
        page.on("zero", lambda *_: weighing.request_zero())
        if controls and not weighing.moving:
            page.put({"controls": parts.controls(parts.button("zero", "Zero the empty gripper"))})

    def draw(self) -> None:
        """Show mass (or why there is none), number of parts and age of the zero, if a browser shows the page."""
        if not self._page.viewers:
            return
        weighing, shown = self._weighing, self._weighing.shown
        mass, (zero, helps) = (
            parts.reading("Mass in the gripper", NO_MASS, "", note=_BLANK, size="huge"),
            zero_in_words(weighing),
        )
        if (weight := shown.measured) is not None:
            kg, sigma = (to_place_of(one, weight.mass_sigma_kg, "z") for one in (weight.mass_kg, weight.mass_sigma_kg))
            mass |= {"value": kg, "unit": "kg", "sigma": f"± {sigma} kg", "note": worth_of(weight)}
        rows = [mass]
        if weighing.part_kg is not None:
            rows.append(parts.reading("Parts", "-" if shown.count is None else str(shown.count), "", size="large"))
        line = parts.lines(format_scale(shown), tone=parts.BAD if shown.stale else parts.WARN if shown.refusal else "")
        self._page.put(
            {
                "alert": line if shown.stale else None,
                "state": _devices(weighing.stream.info),
                "numbers": parts.readings(*rows),
                "table/line": None if shown.stale else line,
                "table/zero": parts.lines(zero, weighing.note, tone=parts.WARN if helps else ""),
            }
        )
