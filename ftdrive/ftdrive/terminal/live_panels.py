"""The parts of the live screen as lines of text, each a function of the `View` and the width."""

from collections.abc import Sequence
from datetime import UTC, datetime
from functools import cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from rich.cells import cell_len

from ftcalib.judge.observability import axes_along
from ftdrive.checks.check import Check, who
from ftdrive.checks.sensor import AXES, check_rate
from ftdrive.errors import ConfigError
from ftdrive.live.replay import ReplayedStream
from ftdrive.live.samples import FrameTransform, LinkStatus, Stages, StreamInfo, WrenchFrame
from ftdrive.runs.verification import EMULATED, age_in_words
from ftdrive.terminal.lines import (
    BAD,
    CONTACT,
    FAINT,
    GOOD,
    STRONG,
    TRACE,
    WARNING,
    Codes,
    Line,
    Part,
    characters,
    envelope,
    row_text,
)
from ftdrive.terminal.live_feed import Note
from ftdrive.terminal.live_view import PlotColumns, ShownWrench, View
from ftdrivers.interfaces import NOT_REPORTED, Array, DeviceInfo

LEAST_FULL_SIGMA = 10.0
"""The scale of a still tool, so that noise looks like noise."""
_SIGNIFICANT = 4.0
# A delay between the links that is less certain is still the assumed one.
_MEASURED_S = 0.03
# Width of the numbers of the table.
_NUMBERS = 37
_ARROWS = "→↗↑↖←↙↓↘"
# Number of the first stage that readings of a sensor alone can have.
_LOWPASS = 4
# Width of a half sphere.
_DISC = 16
_FRAMES = (WrenchFrame(), WrenchFrame("flange", "flange"), WrenchFrame("base", "tcp"), WrenchFrame("tcp", "tcp"))
_STATE = {"ok": ("✔", GOOD), "warning": ("!", WARNING), "failed": ("✘", BAD), "skipped": ("-", FAINT)}


# ---------------------------------------------------------------------------------------------------------- head


def head(view: View, width: int, page: Line | None = None) -> list[Line]:
    """Name devices, stages, calibration, and in the last line what is silent, or the page in the browser."""
    rule = Line() if page is None else page.add(" ")
    rule.add("─" * (width - rule.width), FAINT)
    if view.silent:
        rule = Line(f" {view.silent}", "bold white on red")
    return [_title(view, width), _provenance(view, width), _state(view, width), rule.fit(width)]


def _title(view: View, width: int) -> Line:
    line = Line(" ftdrive live", STRONG).add("  ")
    line.add(" · ".join(filter(None, [view.info.arm.model, _named(view.info.sensor), view.info.tool])))
    right = Line()
    for mark in view.info.marks:
        right.add(f" {mark} ", WARNING)
    if view.is_frozen:
        right.add(" FROZEN ", "reverse bold").add(" ")
    if view.replay is not None:
        right.join(_replay(view.replay)).add(" ")
    if view.recording_s is not None:
        right.add(f"● REC {_clock(view.recording_s)}", BAD).add(" ")
    return line.fit(max(width - right.width - 1, 0)).add(" ").join(right).fit(width)


def _replay(replay: ReplayedStream) -> Line:
    state = "ended" if replay.has_ended else "paused" if replay.is_paused else f"x {replay.speed:g}"
    at, end = (f"{int(t_s // 60):02d}:{t_s % 60:04.1f}" for t_s in (replay.at_s, replay.duration_s))
    return Line(f"REPLAY {at} of {end}, {state}", STRONG)


def _provenance(view: View, width: int) -> Line:
    line = Line(" ")
    if view.reading is None:
        return line.add("waiting for the first sample").fit(width)
    stages, frame = view.reading.stages, view.reading.frame
    chain = [Part("raw")]
    is_tared = view.info.is_raw and view.status.tare is not None
    if is_tared:
        chain.append(Part("tare"))
    for number, (name, is_on) in enumerate(_stages(stages), 1):
        if view.info.is_raw and number < _LOWPASS:
            continue
        chain.append(Part(f"{number} {name}") if is_on else Part(f"{number} {name}(off)", FAINT))
    usual = view.info.is_raw or (stages.bias and stages.gravity)
    right = Line("minus tare" if is_tared else meaning(stages), STRONG if usual else WARNING).add(", ")
    right.add(frame.axes, STRONG).add(" @ ").add(_point(frame), STRONG).add(" ")
    room = width - right.width - 2 - sum(cell_len(part.text) for part in chain)
    arrow = " ▸ " if room >= 3 * (len(chain) - 1) else "▸"
    for i, part in enumerate(chain):
        line.add(arrow if i else "", FAINT).add(*part)
    return line.fit(max(width - right.width - 1, 0)).add(" ").join(right).fit(width)


def _stages(stages: Stages) -> list[tuple[str, bool]]:
    lowpass = "LP" if stages.lowpass_Hz is None else f"LP {stages.lowpass_Hz:g} Hz"
    found = [
        ("bias", stages.bias),
        ("gravity", stages.gravity),
        ("inertia", stages.inertia),
        (lowpass, stages.lowpass_Hz is not None),
    ]
    if stages.notch_Hz is not None:
        found.append((f"notch {stages.notch_Hz:g} Hz", True))
    if stages.deadband_N or stages.deadband_Nm:
        found.append(("deadband", True))
    return found


def meaning(stages: Stages) -> str:
    """Return what the wrench is after these stages."""
    if stages.bias:
        return "contact wrench" if stages.gravity else "weight included"
    return "bias included" if stages.gravity else "as measured"


def _point(frame: WrenchFrame) -> str:
    if isinstance(frame.about, str):
        return frame.about
    return "({:g},{:g},{:g}) mm".format(*(1e3 * x for x in frame.about))


def _state(view: View, width: int) -> Line:
    calibration, status = view.info.calibration, view.status
    if view.info.is_raw:
        line = Line(" sensor alone: no arm, no calibration", WARNING)
    else:
        line = Line(" cal ")
        line.add(calibration.id[:6]).add(" ")
        trusted = calibration.verdict == "good" and not set(view.info.marks) - {EMULATED}
        line.add(calibration.verdict.upper(), GOOD if trusted else WARNING)
        line.add(_age(view)).add(", ").add(*_verified(view))
    if status.tare is not None and status.tare_t_host_ns is not None:
        force_N = float(np.linalg.norm(status.tare[:3]))
        line.add(f"  tare {time_of_day(view.info, status.tare_t_host_ns)[:5]} {force_N:.2f} N")
    elif status.tracked is None:
        line.add("  tare ").add("none", FAINT)
    if status.tracked is not None and not view.info.is_raw:
        line.add(f"  {status.tracked.in_words()}")
    elif not view.info.is_raw:
        line.add(f"  drift {_rounded(status.drift_N_h)} ± {_rounded(status.drift_sigma_N_h)} N/h")
    return line.fit(width)


def _rounded(value: float) -> str:
    return f"{value:.0f}" if value >= 10 else f"{value:.2g}"


def _age(view: View) -> str:
    created = view.info.calibration.provenance.get("created_utc")
    if not isinstance(created, str) or view.reading is None:
        return ""
    return f" {age_in_words(_now(view.info, view.reading) - datetime.fromisoformat(created))}"


def _verified(view: View) -> tuple[str, str]:
    found = view.info.verification
    if found is None:
        return "not verified", FAINT
    now = None if view.reading is None else _now(view.info, view.reading)
    return found.in_words(now), GOOD if found.passed else BAD


def _now(info: StreamInfo, reading: ShownWrench) -> datetime:
    return datetime.fromtimestamp((reading.t_host_ns + info.utc_offset_ns) * 1e-9, UTC)


# --------------------------------------------------------------------------------------------------------- table


def table(view: View, width: int, *, with_trace: bool) -> list[Line]:
    """List each component with sigma, extremes, a bar and, if there is room, a trace."""
    trace_cells = width - _NUMBERS - 23 - 4 if with_trace else 0
    if trace_cells < 8:
        trace_cells = 0
    bar_cells = 23 if trace_cells else width - _NUMBERS - 5
    bar_cells = 0 if bar_cells < 11 else bar_cells - 1 + bar_cells % 2
    columns = view.columns(2 * trace_cells or 20)
    lines = []
    for first, unit in ((0, "N"), (3, "N·m")):
        places = decimals(view.reading, first)
        full = full_scale(columns, view.reading, first)
        head = Line("        now     ± σ   -peak   +peak ", FAINT) if first == 0 else _at_rest(view)
        head.to(_NUMBERS)
        head.join(_scale(full, unit, bar_cells))
        if trace_cells and first == 0:
            head.to(_NUMBERS + bar_cells + 4).add(span(columns), FAINT)
        lines.append(head.fit(width))
        for i in range(first, first + 3):
            line = _component(view, i, places)
            if bar_cells:
                line.to(_NUMBERS).join(_bar(view, i, full, bar_cells))
            if trace_cells:
                ink = characters(envelope(columns.low[i], columns.high[i], 1, full))[0]
                line.add("  ").join(layers(ink, np.zeros_like(ink), columns.contact_cells))
            lines.append(line.fit(width))
        size = _size(view, first, places).to(_NUMBERS)
        lines.append(size.join(_contact(view) if first == 0 else line_of_force(view.reading)).fit(width))
    return lines


def span(columns: PlotColumns) -> str:
    """Return the duration of all columns in words."""
    return f"{columns.span_s:.{0 if columns.span_s > 5 else 1}f} s"


def decimals(reading: ShownWrench | None, first: int) -> int:
    """Return how many decimals three components need to show their standard deviations without contact."""
    usual = 3 if first else 2
    return usual if reading is None or not reading.rest_sigma[first : first + 3].max() < 0.5 * 10**-usual else usual + 1


def full_scale(columns: PlotColumns, reading: ShownWrench | None, first: int) -> float:
    """Return a round full scale for three components: the recent extremes fit, and noise alone stays small."""
    rows = slice(first, first + 3)
    largest = np.abs([columns.low[rows], columns.high[rows]])
    sigma = np.zeros(3) if reading is None else np.nan_to_num(reading.sample_sigma[rows])
    least = LEAST_FULL_SIGMA * float(sigma.max())
    wanted = max(least, 1.05 * float(largest[np.isfinite(largest)].max(initial=0.0)), 1e-6)
    decade = 10.0 ** np.floor(np.log10(wanted))
    return float(next(step * decade for step in (1, 2, 5, 10) if step * decade >= wanted))


def _component(view: View, i: int, places: int) -> Line:
    reading, line = view.reading, Line(f" {AXES[i]} ", STRONG)
    if reading is None or view.silent:
        line.add(f"{'--.--':>8}", BAD if view.silent else FAINT).add(f"{'--':>8}", FAINT)
        return line.join(_peaks(view, i, places))
    line.add(_fixed(reading.wrench[i], places, 8), f"bold {CONTACT}" if reading.in_contact else STRONG)
    return line.add(f"{digits(reading.sigma[i], places):>8}", FAINT).join(_peaks(view, i, places))


def _at_rest(view: View) -> Line:
    """Show the sigma of a free tool, below that of the present contact."""
    reading = view.reading
    if reading is None or view.silent:
        return Line()
    force, torque = (digits(float(reading.rest_sigma[i : i + 3].max()), decimals(reading, i)) for i in (0, 3))
    return Line(f" {'σ at rest':<11}{force:>8} N  {torque} N·m", FAINT)


def digits(sigma: float, places: int) -> str:
    """Return a standard deviation, NaN until the noise is known, in fixed digits: no column jumps on a screen."""
    return "--" if np.isnan(sigma) else f"{sigma:.{places}f}"


def _peaks(view: View, i: int, places: int) -> Line:
    low, high = view.peaks.low[i], view.peaks.high[i]
    if low > high:
        return Line()
    return Line(f"{_fixed(low, places - 1, 7):>8}{_fixed(high, places - 1, 7):>8}")


def _fixed(value: float, places: int, width: int) -> str:
    """Return a number right in `width` cells; raw readings of some sensors are so large that decimals must go."""
    while places and len(f"{value:+z.{places}f}") > width:
        places -= 1
    return f"{value:+z.{places}f}".rjust(width)


def _size(view: View, first: int, places: int) -> Line:
    reading, peak = view.reading, view.peaks.torque_Nm if first else view.peaks.force_N
    line = Line("|T| " if first else "|F| ", STRONG)
    if reading is None or view.silent:
        return line.add(f"{'--.--':>8}", BAD if view.silent else FAINT)
    size, along = reading.size(first)
    line.add(f"{size:8.{places}f}", f"bold {CONTACT}" if reading.in_contact else STRONG)
    return line.add(f"{digits(along, places):>8}", FAINT).add(" " * 8).add(f"{peak:8.{places - 1}f}")


def _scale(full: float, unit: str, cells: int) -> Line:
    if not cells:
        return Line(unit, FAINT)
    left, right, half = f"-{full:g}", f"+{full:g} {unit}", cells // 2
    return Line(left.ljust(half) + "0", FAINT).to(cells - len(f"+{full:g}")).add(right, FAINT)


def _bar(view: View, i: int, full: float, cells: int) -> Line:
    half = cells // 2
    if view.reading is None or view.silent:
        return Line("·" * half + "│" + "·" * half, FAINT)
    value = float(view.reading.wrench[i]) / full
    halves = min(2 * half, round(2 * half * abs(value)))
    style = CONTACT if view.reading.in_contact else TRACE
    filled = "█" * (halves // 2) + ("▌" if value > 0 else "▐") * (halves % 2)
    rest = "·" * (half - len(filled))
    if value > 0:
        return Line("·" * half + "│", FAINT).add(filled, style).add(rest, FAINT)
    return Line(rest, FAINT).add(filled[::-1], style).add("│" + "·" * half, FAINT)


def layers(ink: Codes, paper: Codes, in_contact: NDArray[np.bool_]) -> Line:
    """Draw packed characters (n,), and the paper where there is no ink; contact has its own colour."""
    line = Line()
    kind = np.where(ink > 0, 1 + in_contact, 0)
    edges = [0, *(np.flatnonzero(np.diff(kind)) + 1).tolist(), len(ink)]
    for start, end in pairwise(edges):
        source = ink if kind[start] else paper
        line.add(row_text(source[start:end]), (FAINT, TRACE, CONTACT)[kind[start]])
    return line


def _contact(view: View) -> Line:
    reading, status = view.reading, view.status
    if reading is None or view.silent or view.info.is_raw:
        return Line()
    if np.isnan(reading.chi2):
        return Line("noise not known yet", FAINT)
    chi2 = f"{reading.chi2:.0f}" if reading.chi2 < 1e5 else "over 99999"
    test = f"test {chi2}, limit {status.contact_limit:.1f}"
    if reading.in_contact:
        return Line("▲ CONTACT ", f"bold {CONTACT}").add(f"{view.contact_s:.1f} s  ").add(test, FAINT)
    return Line("free  ", GOOD).add(test, FAINT)


def line_of_force(reading: ShownWrench | None) -> Line:
    """Return where the line of the contact force passes the reference point."""
    if reading is None or not reading.in_contact:
        return Line()
    force, torque = reading.wrench[:3], reading.wrench[3:]
    square = float(force @ force)
    # or the noise is not known
    if not square > (_SIGNIFICANT * float(reading.sigma[:3].max())) ** 2:
        return Line()
    p_m = np.cross(force, torque) / square
    distance_m = float(np.linalg.norm(p_m))
    point = _point(reading.frame)
    if distance_m < 5e-4:
        return Line(f"line of force passes through {point}")
    return Line(f"line of force {1e3 * distance_m:.0f} mm from {point}, {' '.join(axes_along(p_m / distance_m))}")


# --------------------------------------------------------------------------------------------------------- links


def links(view: View, width: int) -> list[Line]:
    """Show down in tool axes, the raw wrench, the used range, both links and the controller's payload."""
    if view.info.is_raw:
        return [line.fit(width) for line in (_raw(view), _range(view), _link("sensor", view.status.sensor))]
    dial = [""] * 5
    if view.reading is not None:
        dial = _arrow(view.reading.R_base_flange.T @ _unit(view.info.calibration.gravity_force_base_N))
    rows = [_raw(view), _range(view), _link("sensor", view.status.sensor), _link("robot", view.status.arm)]
    if view.replay is None:
        sigma_s = view.status.delay_sigma_s
        known = f" ± {1e3 * sigma_s:.1f} ms" if sigma_s else " ms, set"
        measured = sigma_s < _MEASURED_S
        rows[3].add(f"  delay {1e3 * view.status.delay_s:.1f}{known}" if measured else "  delay not measured yet")
    payload = next((check for check in view.checks if check.name == "robot.payload"), None)
    rows.append(Line(" payload   ", FAINT).join(_checked(payload) if payload else Line("not checked", FAINT)))
    return [Line(left).to(12).join(right).fit(width) for left, right in zip(dial, rows, strict=True)]


def _arrow(down_flange: Array) -> list[str]:
    angle_deg = float(np.degrees(np.arccos(np.clip(down_flange[2], -1, 1))))
    aside = float(np.hypot(down_flange[0], down_flange[1]))
    eighth = round(np.arctan2(down_flange[1], down_flange[0]) / (np.pi / 4)) % 8
    middle = ("•" if down_flange[2] > 0 else "×") if aside < 0.05 else _ARROWS[eighth]
    return [" down, in", " tool axes", "  · · ·", f"  · {middle} ·", f"  · · ·{angle_deg:4.0f}°"]


def _raw(view: View) -> Line:
    line = Line(" raw       ", FAINT)
    if view.reading is None or view.silent:
        return line.add("--.--", BAD if view.silent else FAINT)
    force = "  ".join(f"{value:.2f}" for value in view.reading.raw[:3])
    torque = "  ".join(f"{value:.3f}" for value in view.reading.raw[3:])
    return line.add("F ", FAINT).add(force).add(" N   T ", FAINT).add(torque).add(" N·m", FAINT)


def _range(view: View) -> Line:
    line, fact = Line(" range     ", FAINT), view.info.sensor.facts.get("range")
    if fact is None or not isinstance(fact.value, tuple):
        return line.add("unknown: overload is not monitored")
    if view.reading is None:
        return line
    load = view.reading.raw
    if view.info.sensor.has_arbitrary_zero:
        tare = np.zeros(6) if view.status.tare is None else view.status.tare
        known = np.concatenate([view.info.calibration.force_bias_N, view.info.calibration.torque_bias_Nm])
        load = load - (tare if view.info.is_raw else known)
    shares = np.abs(load) / np.array(fact.value)
    worst = int(np.argmax(shares))
    share = float(shares[worst])
    style = BAD if share > 0.95 else WARNING if share > 0.8 else ""
    line.add("▕").add(("█" * min(10, round(10 * share))).ljust(10, "·")).add("▏")
    return line.add(f" {100 * share:.0f} % used", style).add(f", most by {AXES[worst]}")


def _link(name: str, link: LinkStatus) -> Line:
    line = Line(f" {name:<10}", FAINT)
    nominal = "" if np.isnan(link.nominal_rate_Hz) else f" of {link.nominal_rate_Hz:.0f}"
    is_usual = check_rate(link.rate_Hz, link.nominal_rate_Hz).state == "ok"
    line.add(f"{link.rate_Hz:.0f}{nominal} Hz", "" if is_usual else WARNING)
    line.add("  ").add(f"lost {link.lost}", WARNING if link.lost else "")
    age = f"{1e3 * link.age_s:.0f} ms" if link.age_s < 1 else f"{link.age_s:.1f} s"
    return line.add("  ").add(f"age {age}", BAD if link.error else "")


def _checked(check: Check) -> Line:
    mark, style = _STATE[check.state]
    line = Line(f"{mark} ", style).add(check.found)
    return line.add(f": {check.fix}", STRONG) if check.fix and check.state != "ok" else line


# -------------------------------------------------------------------------------------------------------- others


def others(view: View, width: int) -> list[Line]:
    """Show the wrench with fewer stages, and in other frames."""
    reading, calibration = view.reading, view.info.calibration
    if reading is None or view.info.is_raw:
        return []
    raw = reading.raw
    bias = np.r_[calibration.force_bias_N, calibration.torque_bias_Nm]
    tare = np.zeros(6) if view.status.tare is None else view.status.tare
    contact = calibration.compensate(raw, reading.R_base_flange) - tare
    now = reading.frame
    rows = [("as measured", raw, now), ("without bias", raw - bias - tare, now), ("and without gravity", contact, now)]
    rows += [(f"{frame.axes} @ {_point(frame)}", contact, frame) for frame in _FRAMES if frame != now]
    lines = [Line(f" in {now.axes} @ {_point(now)}", FAINT).to(21).add("".join(f"{name:>9}" for name in AXES), FAINT)]
    for name, wrench, frame in rows:
        shown, line = _in_frame(wrench, frame, view, reading.R_base_flange), Line(f" {name:<20}", FAINT)
        if view.silent:
            line.add(f"{'--.--':>9}" * 6, BAD)
        elif shown is None:
            line.add("  not configured", FAINT)
        else:
            line.add("".join(f"{value:z9.{2 if i < 3 else 3}f}" for i, value in enumerate(shown)))
        lines.append(line)
    return [line.fit(width) for line in lines]


def _in_frame(wrench: Array, frame: WrenchFrame, view: View, R_base_flange: Array) -> Array | None:
    try:
        return FrameTransform(frame, view.info).matrix(R_base_flange) @ wrench
    except ConfigError:
        return None


def sphere(view: View, width: int) -> list[Line]:
    """Draw gravity in flange axes on two half spheres, with the calibrated orientations and the error expected here."""
    reading = view.reading
    if reading is None or view.info.is_raw:
        return []
    calibration, R = view.info.calibration, reading.R_base_flange
    down = R.T @ _unit(calibration.gravity_force_base_N)
    known = np.empty((0, 3)) if view.calibrated is None else view.calibrated
    lines = [Line(" ").add("+z".center(_DISC), FAINT).add("  ").add("-z".center(_DISC), FAINT)]
    halves = [_half_sphere(known[known[:, 2] * sign >= 0], down if down[2] * sign >= 0 else None) for sign in (1, -1)]
    lines += [Line(" ").join(a).add("  ").join(b) for a, b in zip(*halves, strict=True)]
    covariance = calibration.wrench_covariance(R)
    force_N, torque_Nm = (float(np.sqrt(np.trace(part))) for part in (covariance[:3, :3], covariance[3:, 3:]))
    words = ["direction of gravity", "in flange axes", "● now"]
    if len(known):
        nearest_deg = float(np.degrees(np.arccos(np.clip((known @ down).max(), -1, 1))))
        words += [f"∘ calibrated: {len(known)}", f"nearest {nearest_deg:.0f}° away"]
    words += ["", "calibration sigma here", f"{force_N:.3f} N, {1e3 * torque_Nm:.2f} mN·m"]
    for line, text in zip(lines[1:], words, strict=False):
        line.to(2 * _DISC + 6).add(text)
    return [line.fit(width) for line in lines]


def _half_sphere(known: Array, down: Array | None) -> list[Line]:
    """Draw one half of the sphere, seen along z; the distance from the middle is the angle."""
    disc = [list(row) for row in _rings()]
    rows = len(disc)
    styles = [[FAINT] * _DISC for _ in disc]
    for directions, sign, style in ((known, "∘", ""), (() if down is None else down[None], "●", BAD)):
        for x, y, z in directions:
            radius = np.arccos(min(abs(z), 1.0)) / (np.pi / 2) / max(np.hypot(x, y), 1e-9)
            row = min(rows - 1, int((1 - radius * y) * rows / 2))
            column = min(_DISC - 1, int((1 + radius * x) * _DISC / 2))
            disc[row][column], styles[row][column] = sign, style
    return [Line.of_cells(signs, kinds) for signs, kinds in zip(disc, styles, strict=True)]


@cache
def _rings() -> list[str]:
    rows, angle = _DISC // 2, np.linspace(0, 2 * np.pi, 200)
    dots = np.zeros((4 * rows, 2 * _DISC), np.bool_)
    for radius in (0.5, 1.0):
        y = np.round((2 * rows - 0.5) * (1 - radius * np.sin(angle)))
        x = np.round((_DISC - 0.5) * (1 + radius * np.cos(angle)))
        dots[y.astype(int), x.astype(int)] = True
    return [row_text(row) for row in characters(dots)]


def _unit(vector: Array) -> Array:
    return np.asarray(vector / np.linalg.norm(vector), np.float64)


def identity(view: View, width: int) -> list[Line]:
    """Name the devices with serial numbers, the calibration and the checks shared with `doctor`."""
    info = view.info
    lines = [Line(" sensor    ", FAINT).add(who(info.sensor))]
    if not info.is_raw:
        lines.insert(0, Line(" arm       ", FAINT).add(who(info.arm)))
        lines.append(Line(" cal       ", FAINT).add(info.calibration_name))
    for check in view.checks:
        # stands beside the links
        if check.name == "robot.payload" and check.state == "ok":
            continue
        words = _checked(check).parts
        lines += _hanging(Line(f" {check.name.partition('.')[2]:<10}", FAINT).add(*words[0]), words[1:], width)
    return [line.fit(width) for line in lines]


def events(view: View, width: int, rows: int) -> list[Line]:
    """List the newest events first; where few lines are left, several in a line."""
    lines = list[Line]()
    for note in view.notes:
        if len(lines) > rows:
            break
        item = _event(view, note, width)
        if rows <= 3 and lines and lines[-1].width + item[0].width + 3 <= width and len(item) == 1:
            lines[-1].add("   ").join(item[0])
        else:
            lines += item
    return [line.fit(width) for line in [*lines, *[Line()] * rows][:rows]]


def newest_rows(view: View, width: int) -> int:
    """Return how many lines the newest event takes."""
    return next((len(_event(view, note, width)) for note in view.notes), 0)


def _event(view: View, note: Note, width: int) -> list[Line]:
    head = Line(" ")
    if note.t_host_ns is not None:
        head.add(f"{time_of_day(view.info, note.t_host_ns)} ", FAINT)
    return _hanging(head, [Part(note.words, note.style)], width)


def _hanging(head: Line, words: Sequence[Part], width: int) -> list[Line]:
    """Put words behind a head; the next lines begin under the first word."""
    lines, indent = [head], head.width
    for part in words:
        for i, word in enumerate(part.text.split(" ")):
            blank = 1 if i else 0
            if lines[-1].width > indent and lines[-1].width + blank + cell_len(word) > width:
                lines.append(Line().to(indent))
                blank = 0
            lines[-1].add(" " * blank + word, part.style)
    return lines


def keys(view: View, width: int) -> Line:
    """List the keys."""
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
    return line.fit(width)


def _named(info: DeviceInfo) -> str:
    return info.model if info.serial == NOT_REPORTED else f"{info.model} {info.serial}"


def time_of_day(info: StreamInfo, t_host_ns: int) -> str:
    """Return a time of the stream as that of a clock on the wall."""
    return datetime.fromtimestamp((t_host_ns + info.utc_offset_ns) * 1e-9, UTC).astimezone().strftime("%H:%M:%S")


def _clock(duration_s: float) -> str:
    minutes, seconds = divmod(int(duration_s), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours:02d}:{minutes:02d}:{seconds:02d}"


def plain(view: View, width: int) -> list[Line]:
    """Draw the table and the state of both links, without keys and events."""
    separator = Line("─" * width, FAINT)
    return [*head(view, width), *table(view, width, with_trace=True), separator, *links(view, width)]
