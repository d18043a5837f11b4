"""Panels of the live screen as lines of text: functions of the `View` and the width."""

from collections.abc import Iterable, Sequence
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
from rich.cells import cell_len
from rich.console import Group
from rich.live import Live

from ftdrive.checks.check import Check, who
from ftdrive.checks.sensor import AXES, check_rate
from ftdrive.stream.feed import FeedNote
from ftdrive.stream.samples import LinkStatus
from ftdrive.stream.stages import words_of
from ftdrive.terminal.console import answer
from ftdrive.terminal.keyboard import Keyboard
from ftdrive.terminal.lines import BAD, CONTACT, FAINT, GOOD, STRONG, TRACE, WARNING, Line, Part, characters, plot
from ftdrive.words import stream as words
from ftdrive.words.stream import ShownWrench, View
from ftdrivers.interfaces import Array

# Width of a table row's name and numbers, in cells; bars and traces are to their right.
_NUMBERS = 37
_ARROWS = "→↗↑↖←↙↓↘"
# Number of the first stage that also applies to a sensor without an arm: the low-pass filter.
_LOWPASS = 4
# Width of a drawn hemisphere, in cells.
_DISC = 16
_STATE = {"ok": ("✔", GOOD), "warning": ("!", WARNING), "failed": ("✘", BAD), "skipped": ("-", FAINT)}
_TONES = {"good": GOOD, "warning": WARNING, "bad": BAD}
# Colours of the notes about events, by the kind of the event.
_NOTES = {"contact": CONTACT, "mark": STRONG}
_NOTES |= dict.fromkeys(("tare", "recovered"), GOOD) | dict.fromkeys(("drift", "warning"), WARNING)
_NOTES |= dict.fromkeys(("tare-refused", "gap", "stale", "failed"), BAD)


# ---------------------------------------------------------------------------------------------------------- head


def head_lines(view: View, width: int, page: Line | None = None) -> list[Line]:
    """Return the top lines: devices; stages; calibration; the device without samples, if any, or the page's address."""
    rule = Line() if page is None else page.add(" ")
    rule.add("─" * (width - rule.width), FAINT)
    if view.silent:
        rule = Line(f" {view.silent}", "bold white on red")
    calibration = Line(" ")
    for text, tone in words.calibration_in_words(view):
        calibration.add(text, _TONES.get(tone, ""))
    for text in words.bias_in_words(view):
        calibration.add(f"  {text}")
    return [_live_title(view, width), _provenance(view, width), calibration, rule]


def _live_title(view: View, width: int) -> Line:
    line = Line(" ftdrive live", STRONG).add(f"  {words.name_devices(view.info)}")
    right = Line()
    for mark in view.info.marks:
        right.add(f" {mark} ", WARNING)
    if view.is_frozen:
        right.add(" FROZEN ", "reverse bold").add(" ")
    if (replay := view.replay) is not None:
        state = "ended" if replay.has_ended else "paused" if replay.is_paused else f"x {replay.speed:g}"
        at, end = (f"{int(t_s // 60):02d}:{t_s % 60:04.1f}" for t_s in (replay.at_s, replay.duration_s))
        right.add(f"REPLAY {at} of {end}, {state}", STRONG).add(" ")
    if view.recording_s is not None:
        minutes, seconds = divmod(int(view.recording_s), 60)
        right.add(f"● REC {minutes // 60:02d}:{minutes % 60:02d}:{seconds:02d}", BAD).add(" ")
    return line.fit(max(width - right.width - 1, 0)).add(" ").join(right)


def _provenance(view: View, width: int) -> Line:
    line = Line(" ")
    if view.reading is None:
        return line.add(words.WAITING)
    stages, chain = view.reading.stages, [Part("raw")]
    if view.info.is_raw and view.status.tare is not None:
        chain.append(Part("tare"))
    lowpass = "LP" if stages.lowpass_Hz is None else f"LP {stages.lowpass_Hz:g} Hz"
    numbered = {"bias": stages.bias, "gravity": stages.gravity, "inertia": stages.inertia, lowpass: lowpass != "LP"}
    rest = replace(stages, bias=False, gravity=False, inertia=False, lowpass_Hz=None)
    for number, (name, is_on) in enumerate((numbered | dict.fromkeys(words_of(rest), True)).items(), 1):
        if number >= _LOWPASS or not view.info.is_raw:
            chain.append(Part(f"{number} {name}") if is_on else Part(f"{number} {name}(off)", FAINT))
    usual = view.info.is_raw or (stages.bias and stages.gravity)
    right = Line(words.wrench_meaning(view), STRONG if usual else WARNING).add(", ")
    right.add(words.short_frame(view.reading.frame), STRONG).add(" ")
    room = width - right.width - 2 - sum(cell_len(part.text) for part in chain)
    arrow = " ▸ " if room >= 3 * (len(chain) - 1) else "▸"
    for i, part in enumerate(chain):
        line.add(arrow if i else "", FAINT).add(*part)
    return line.fit(max(width - right.width - 1, 0)).add(" ").join(right)


# --------------------------------------------------------------------------------------------------------- table


def component_table(view: View, width: int, *, with_trace: bool) -> list[Line]:
    """Return the table of the wrench components, with sigma, extremes and a bar, and a trace if there is room."""
    trace_cells = width - _NUMBERS - 23 - 4 if with_trace else 0
    if trace_cells < 8:
        trace_cells = 0
    bar_cells = 23 if trace_cells else width - _NUMBERS - 5
    bar_cells = 0 if bar_cells < 11 else bar_cells - 1 + bar_cells % 2
    reading, columns, lines = view.reading, view.columns(2 * trace_cells or 20), list[Line]()
    for first, unit in ((0, "N"), (3, "N·m")):
        places = _decimals(reading, first)
        full = words.full_scale(columns, reading, first)
        head = Line("        now     ± σ   -peak   +peak ", FAINT) if first == 0 else _at_rest(view)
        head.to(_NUMBERS)
        head.join(_scale_line(full, unit, bar_cells))
        if trace_cells and first == 0:
            head.to(_NUMBERS + bar_cells + 4).add(columns.span, FAINT)
        lines.append(head)
        for i in range(first, first + 3):
            low, high = view.peaks.low[i], view.peaks.high[i]
            peaks = "" if low > high else "".join(f"{_fit_number(peak, places - 1, 7):>8}" for peak in (low, high))
            now = ("", "") if reading is None else format_component(reading, i)
            line = _component_row(view, f" {AXES[i]} ", now, peaks)
            if bar_cells:
                line.to(_NUMBERS).join(_bar(view, i, full, bar_cells))
            if trace_cells:
                line.add("  ").join(plot(columns.low[i], columns.high[i], 1, full, columns.contact_cells)[0])
            lines.append(line)
        size, along = (0.0, 0.0) if reading is None else reading.size(first)
        peak = "" if reading is None else f"{view.peaks.sizes[first // 3]:16.{places - 1}f}"
        now = f"{size:.{places}f}", _digits(along, places)
        line = _component_row(view, "|T| " if first else "|F| ", now, peak).to(_NUMBERS)
        beside = _contact_line(view) if first == 0 else Line(words.line_of_force(reading))
        lines.append(line.join(beside))
    return lines


def format_component(reading: ShownWrench, i: int) -> tuple[str, str]:
    """Return texts of wrench component i and of its sigma, with the same number of decimals."""
    places = _decimals(reading, i // 3 * 3)
    return _fit_number(reading.wrench[i], places, 8), _digits(reading.sigma[i], places)


def _decimals(reading: ShownWrench | None, first: int) -> int:
    """Return the number of decimals for force (`first` 0) or torque (3) that shows their sigmas without contact."""
    usual = 3 if first else 2
    return usual if reading is None or not reading.rest_sigma[first : first + 3].max() < 0.5 * 10**-usual else usual + 1


def _component_row(view: View, name: str, now: tuple[str, str], peaks: str) -> Line:
    """Return a line with name, current value, sigma and extremes; while no samples arrive, dashes replace the value."""
    line = Line(name, STRONG)
    if view.live is None:
        return line.add(f"{'--.--':>8}", BAD if view.silent else FAINT).add(f"{'--':>8}", FAINT).add(peaks)
    line.add(f"{now[0]:>8}", f"bold {CONTACT}" if view.live.in_contact else STRONG)
    return line.add(f"{now[1]:>8}", FAINT).add(peaks)


def _at_rest(view: View) -> Line:
    if (reading := view.live) is None:
        return Line()
    force, torque = (_digits(float(reading.rest_sigma[i : i + 3].max()), _decimals(reading, i)) for i in (0, 3))
    return Line(f" {'σ at rest':<11}{force:>8} N  {torque} N·m", FAINT)


def _digits(sigma: float, places: int) -> str:
    """Format a standard deviation with `places` decimals, so that columns stay aligned; NaN becomes "--"."""
    return "--" if np.isnan(sigma) else f"{sigma:.{places}f}"


def _fit_number(value: float, places: int, width: int) -> str:
    while places and len(f"{value:+z.{places}f}") > width:
        places -= 1
    return f"{value:+z.{places}f}"


def _scale_line(full: float, unit: str, cells: int) -> Line:
    if not cells:
        return Line(unit, FAINT)
    left, right, half = f"-{full:g}", f"+{full:g} {unit}", cells // 2
    return Line(left.ljust(half) + "0", FAINT).to(cells - len(f"+{full:g}")).add(right, FAINT)


def _bar(view: View, i: int, full: float, cells: int) -> Line:
    half = cells // 2
    if (reading := view.live) is None:
        return Line("·" * half + "│" + "·" * half, FAINT)
    value = float(reading.wrench[i]) / full
    halves = min(2 * half, round(2 * half * abs(value)))
    style = CONTACT if reading.in_contact else TRACE
    filled = "█" * (halves // 2) + ("▌" if value > 0 else "▐") * (halves % 2)
    rest = "·" * (half - len(filled))
    if value > 0:
        return Line("·" * half + "│", FAINT).add(filled, style).add(rest, FAINT)
    return Line(rest, FAINT).add(filled[::-1], style).add("│" + "·" * half, FAINT)


def _contact_line(view: View) -> Line:
    if view.live is None or view.info.is_raw:
        return Line()
    state, test = words.state(view)
    line = Line(f"{state}  ", GOOD if state == words.FREE else FAINT)
    if state == words.CONTACT:
        line = Line(f"▲ {state.upper()} ", f"bold {CONTACT}").add(f"{view.contact_s:.1f} s  ")
    return line.add(test, FAINT)


# --------------------------------------------------------------------------------------------------------- links


def links(view: View) -> list[Line]:
    """Return lines with gravity's direction in tool axes, raw wrench, share of range, rates of the devices, payload."""
    if view.info.is_raw:
        return [_raw(view), _range(view), _link_line(view, "sensor", view.status.sensor)]
    dial = [""] * 5
    if view.reading is not None:
        dial = _gravity_arrow(view.reading.R_base_flange.T @ view.info.calibration.parameters.down)
    rows = [
        _raw(view),
        _range(view),
        _link_line(view, "sensor", view.status.sensor),
        _link_line(view, "robot", view.status.arm),
    ]
    payload = next((check for check in view.checks if check.name == "robot.payload"), None)
    rows.append(Line(" payload   ", FAINT).join(_check_line(payload) if payload else Line("not checked", FAINT)))
    return [Line(left).to(12).join(right) for left, right in zip(dial, rows, strict=True)]


def _gravity_arrow(down_flange: Array) -> list[str]:
    angle_deg = float(np.degrees(np.arccos(np.clip(down_flange[2], -1, 1))))
    aside = float(np.hypot(down_flange[0], down_flange[1]))
    eighth = round(np.arctan2(down_flange[1], down_flange[0]) / (np.pi / 4)) % 8
    middle = ("•" if down_flange[2] > 0 else "×") if aside < 0.05 else _ARROWS[eighth]
    return [" down, in", " tool axes", "  · · ·", f"  · {middle} ·", f"  · · ·{angle_deg:4.0f}°"]


def _raw(view: View) -> Line:
    line = Line(" raw       ", FAINT)
    if (reading := view.live) is None:
        return line.add("--.--", BAD if view.silent else FAINT)
    force, torque = ("  ".join(f"{x:.{n}f}" for x in part) for n, part in ((2, reading.raw[:3]), (3, reading.raw[3:])))
    return line.add("F ", FAINT).add(force).add(" N   T ", FAINT).add(torque).add(" N·m", FAINT)


def _range(view: View) -> Line:
    line, used = Line(" range     ", FAINT), view.used_range
    if used is None:
        return line.add("" if view.reading is None else "unknown: overload is not monitored")
    share, axis = used
    style = BAD if share > 0.95 else WARNING if share > 0.8 else ""
    line.add("▕").add(("█" * min(10, round(10 * share))).ljust(10, "·")).add("▏")
    return line.add(f" {100 * share:.0f} % used", style).add(f", most by {axis}")


def _link_line(view: View, name: str, link: LinkStatus) -> Line:
    rate, lost, age, delay = words.link_in_words(view, link)
    is_usual = check_rate(link.rate_Hz, link.nominal_rate_Hz).state == "ok"
    line = Line(f" {name:<10}", FAINT).add(rate, "" if is_usual else WARNING)
    line.add("  ").add(lost, WARNING if link.lost else "").add("  ").add(age, BAD if link.error else "")
    return line.add(f"  {delay}")


def _check_line(check: Check) -> Line:
    mark, style = _STATE[check.state]
    line = Line(f"{mark} ", style).add(check.found)
    return line.add(f": {check.fix}", STRONG) if check.fix and check.state != "ok" else line


# -------------------------------------------------------------------------------------------------------- others


def other_wrench_lines(view: View) -> list[Line]:
    """Return lines with the wrench after only some of the compensation stages, and in other frames."""
    if view.reading is None or not (rows := words.other_wrenches(view)):
        return []
    lines = [Line(f" in {words.short_frame(view.reading.frame)}", FAINT).to(21)]
    lines[0].add("".join(f"{name:>9}" for name in AXES), FAINT)
    for name, wrench in rows:
        line = Line(f" {name:<20}", FAINT)
        if view.silent:
            line.add(f"{'--.--':>9}" * 6, BAD)
        elif wrench is None:
            line.add("  not configured", FAINT)
        else:
            line.add("".join(f"{value:z9.{2 if i < 3 else 3}f}" for i, value in enumerate(wrench)))
        lines.append(line)
    return lines


def sphere(view: View) -> list[Line]:
    """Draw the directions of gravity in flange axes, now and at the calibrated poses, on two hemispheres, and sigma."""
    reading = view.reading
    if reading is None or view.info.is_raw:
        return []
    calibration, R = view.info.calibration, reading.R_base_flange
    down = R.T @ calibration.parameters.down
    known = np.empty((0, 3)) if view.calibrated is None else view.calibrated
    lines = [Line(" ").add("+z".center(_DISC), FAINT).add("  ").add("-z".center(_DISC), FAINT)]
    halves = [_half_sphere(*(one[one[:, 2] * sign >= 0] for one in (known, down[None]))) for sign in (1, -1)]
    lines += [Line(" ").join(a).add("  ").join(b) for a, b in zip(*halves, strict=True)]
    covariance = calibration.wrench_covariance(R)
    force_N, torque_Nm = (float(np.sqrt(np.trace(part))) for part in (covariance[:3, :3], covariance[3:, 3:]))
    texts = ["direction of gravity", "in flange axes", "● now"]
    if len(known):
        nearest_deg = float(np.degrees(np.arccos(np.clip((known @ down).max(), -1, 1))))
        texts += [f"∘ calibrated: {len(known)}", f"nearest {nearest_deg:.0f}° away"]
    texts += ["", "calibration sigma here", f"{force_N:.3f} N, {1e3 * torque_Nm:.2f} mN·m"]
    for line, text in zip(lines[1:], texts, strict=False):
        line.to(2 * _DISC + 6).add(text)
    return lines


def _half_sphere(known: Array, down: Array) -> list[Line]:
    """Draw directions (n, 3) on a hemisphere seen along z; the distance from the centre is linear in the angle."""
    rows, angle = _DISC // 2, np.linspace(0, 2 * np.pi, 200)
    dots = np.zeros((4 * rows, 2 * _DISC), np.bool_)
    for radius in (0.5, 1.0):
        y = np.round((2 * rows - 0.5) * (1 - radius * np.sin(angle)))
        x = np.round((_DISC - 0.5) * (1 + radius * np.cos(angle)))
        dots[y.astype(int), x.astype(int)] = True
    disc, styles = characters(dots), np.full((rows, _DISC), FAINT, object)
    for directions, sign, style in ((known, "∘", ""), (down, "●", BAD)):
        x, y, z = directions.T
        shrink = np.arccos(np.minimum(np.abs(z), 1)) / (np.pi / 2) / np.maximum(np.hypot(x, y), 1e-9)
        row, column = (1 - shrink * y) * rows / 2, (1 + shrink * x) * _DISC / 2
        at = np.minimum(row.astype(int), rows - 1), np.minimum(column.astype(int), _DISC - 1)
        disc[at], styles[at] = sign, style
    return [Line.of_cells(signs, kinds) for signs, kinds in zip(disc.tolist(), styles.tolist(), strict=True)]


def identity(view: View, width: int) -> list[Line]:
    """Return lines with devices and serial numbers, the calibration, and the checks shared with `doctor`."""
    info = view.info
    lines = [Line(" sensor    ", FAINT).add(who(info.sensor))]
    if not info.is_raw:
        lines.insert(0, Line(" arm       ", FAINT).add(who(info.arm)))
        lines.append(Line(" cal       ", FAINT).add(info.calibration_name))
    for check in view.checks:
        # omitted here, because `links` already shows it
        if check.name == "robot.payload" and check.state == "ok":
            continue
        mark, *found = _check_line(check).parts
        lines += _hanging(Line(f" {check.name.partition('.')[2]:<10}", FAINT).add(*mark), found, width)
    return lines


def events(view: View, width: int, rows: int) -> list[Line]:
    """Return `rows` lines with the newest events first; if `rows` is at most 3, short events share a line."""
    lines = list[Line]()
    for note in view.notes:
        if len(lines) > rows:
            break
        item = _event_lines(view, note, width)
        if rows <= 3 and lines and lines[-1].width + item[0].width + 3 <= width and len(item) == 1:
            lines[-1].add("   ").join(item[0])
        else:
            lines += item
    return [*lines, *[Line()] * rows][:rows]


def newest_rows(view: View, width: int) -> int:
    """Return the number of lines that the newest event needs; 0 without events."""
    return next((len(_event_lines(view, note, width)) for note in view.notes), 0)


def _event_lines(view: View, note: FeedNote, width: int) -> list[Line]:
    head = Line(" ")
    if note.t_host_ns is not None:
        head.add(f"{words.time_of_day(view.info, note.t_host_ns)} ", FAINT)
    return _hanging(head, [Part(note.words, _NOTES.get(note.kind, ""))], width)


def _hanging(head: Line, parts: Sequence[Part], width: int) -> list[Line]:
    lines, indent = [head], head.width
    for part in parts:
        for i, word in enumerate(part.text.split(" ")):
            blank = 1 if i else 0
            if lines[-1].width > indent and lines[-1].width + blank + cell_len(word) > width:
                lines.append(Line().to(indent))
                blank = 0
            lines[-1].add(" " * blank + word, part.style)
    return lines


def keys(view: View, width: int) -> Line:
    """Return a line that lists the keys of the live screen, as many as fit."""
    names = ["t tare", "u undo", "x axes", "a about", "1-4 stage", "z freeze", "b mark", "r rec", "p peak", "g span"]
    if view.info.is_raw:
        names = ["t tare", "u undo", "4 low-pass", "z freeze", "b mark", "r rec", "p peak", "g span"]
    if view.can_push:
        names.insert(0, "f push")
    if view.replay is not None:
        names = ["space pause", "←→ seek", ". step", "+- speed", "x axes", "a about", "1-4 stage", "b mark", "g span"]
    last = ["? help", "q quit"] if sum(map(cell_len, names)) + len(names) + 15 <= width else ["?", "q"]
    room = width - sum(cell_len(name) + 1 for name in last)
    line = Line(" ")
    for name in (*names, *last):
        if name in last or line.width + cell_len(name) + 1 <= room:
            key, _, word = name.partition(" ")
            line.add(key, STRONG).add(f" {word} " if word else " ", FAINT)
    return line


def show_table(views: Iterable[View]) -> None:
    """Show each view of a stream as a table, without keys and events, until they end or the operator interrupts."""
    shown = Group()
    with (
        # read keys only so that the terminal does not echo them: an echoed Enter would break the screen
        Keyboard(0) if Keyboard.usable(0) else nullcontext(),
        Live(console=answer, refresh_per_second=10) as screen,
    ):
        for view in views:
            width = answer.width
            separator = Line("─" * width, FAINT)
            lines = [*head_lines(view, width), *component_table(view, width, with_trace=True), separator, *links(view)]
            shown = Group(*(line.fit(width).as_text() for line in lines))
            screen.update(Group(shown, "Ctrl-C ends"))
        screen.update(Group(shown, "The recording has ended."))
