"""State and texts of a stream for screens and pages: `StreamSummary` reads a `Feed` and makes a `View` to show."""

import json
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from itertools import chain, groupby, islice
from math import isfinite
from typing import Any

import numpy as np

from ftcalib import CalibrationDataset
from ftcalib.after.weighing import Weight
from ftcalib.judge.observability import axes_along
from ftcalib.rounding import to_place_of
from ftdrive.checks.check import Check
from ftdrive.checks.sensor import AXES
from ftdrive.errors import ConfigError
from ftdrive.runs.calibration import EMULATED
from ftdrive.runs.verification import age_in_words
from ftdrive.stream.feed import MEAN_S, SPANS_S, Feed, FeedNote, History, NoiseWatch, PlotColumns
from ftdrive.stream.samples import Block, FrameTransform, LinkStatus, Stages, StreamInfo, StreamStatus, WrenchFrame
from ftdrive.stream.sources import STALE_S, RecordingSource
from ftdrive.stream.stream import RECOVER_S
from ftdrive.stream.weighing import Weighing
from ftdrivers.interfaces import NOT_REPORTED, Array

_MOST_NOTES = 200
# Kinds of events that plots mark. Contacts are coloured instead, and a change of the frame clears the plots.
_MARKS = ("tare", "tare-undone", "stages", "gap", "mark")
# A force or torque below this number of sigmas may be noise, so its direction or line of action is not shown.
_SIGNIFICANT = 4.0
# If the command has read nothing from the stream for longer than this, s, its output is probably blocked.
_HELD_S = 2.0
CONTACT, FREE, NOISE_UNKNOWN, WAITING = "contact", "free", "noise not known yet", "waiting for the first sample"
"""The contact states that `state` returns."""
# Smallest full scale of a plot, in sigmas of a sample, so that noise looks small if the tool is still.
_LEAST_FULL_SIGMA = 10.0
# Contact-test values above this are not shown; a limit above this means that the noise is not known yet.
_MOST_CHI2 = 1e5
_FRAMES = (WrenchFrame(), WrenchFrame("flange", "flange"), WrenchFrame("base", "tcp"), WrenchFrame("tcp", "tcp"))
# An estimate of the wrench's delay is shown as not measured if its sigma exceeds this, s.
_MEASURED_S = 0.03


@dataclass(frozen=True, slots=True, eq=False)
class ShownWrench:
    """The wrench to show: the mean of the samples of the last 0.1 s, with its sigmas and the newest pose."""

    t_host_ns: int
    wrench: Array
    """(6,) mean wrench after the stages, N and N·m, in `frame`."""
    raw: Array
    """(6,) mean measured wrench, N and N·m, sensor axes, about the sensor origin."""
    raw_in_frame: Array
    """(6,) the mean measured wrench `raw`, transformed to `frame`."""
    sigma: Array
    """(6,) sigma of `wrench` due to noise, calibration and sensor under this contact; NaN until the noise is known."""
    rest_sigma: Array
    """(6,) sigma of `wrench` for a tool without contact; NaN until the noise is known."""
    sample_sigma: Array
    """(6,) sigma of the wrench of a single sample for a tool without contact; NaN until the noise is known."""
    chi2: float
    """Squared Mahalanobis distance of the newest sample's wrench from that of a tool without contact."""
    in_contact: bool
    R_base_flange: Array
    p_base_flange_m: Array
    """(3,) position of the flange; NaN where unknown."""
    q_rad: Array
    """(6,) joint angles; NaN where unknown."""
    frame: WrenchFrame
    stages: Stages

    def size(self, first: int) -> tuple[float, float]:
        """Return the norm of the force (`first` is 0) or the torque (3), and the sigma along its direction."""
        part, sigma = self.wrench[first : first + 3], self.sigma[first : first + 3]
        size = float(np.linalg.norm(part))
        return size, float(np.linalg.norm(part * sigma)) / size if size else float(sigma.max())

    def is_significant(self, first: int) -> bool:
        """Whether the force (`first` is 0) or the torque (3) exceeds 4 sigma; False until the noise is known."""
        size, sigma = self.size(first)
        return size > _SIGNIFICANT * sigma


@dataclass(slots=True, eq=False)
class Peaks:
    """Smallest and largest values of the wrench since the last reset; `low` > `high` without samples."""

    low: Array = field(default_factory=lambda: np.full(6, np.inf))
    high: Array = field(default_factory=lambda: np.full(6, -np.inf))
    sizes: Array = field(default_factory=lambda: np.zeros(2))
    """(2,) largest norms of force and torque since the last reset, N and N·m."""

    def add(self, wrench: Array) -> None:
        """Extend the extremes by the wrenches (n, 6) of samples."""
        np.minimum(self.low, wrench.min(axis=0), out=self.low)
        np.maximum(self.high, wrench.max(axis=0), out=self.high)
        np.maximum(self.sizes, np.linalg.norm(wrench.reshape(-1, 2, 3), axis=2).max(axis=0), out=self.sizes)


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """The state of a stream, as screens and pages show it."""

    info: StreamInfo
    status: StreamStatus
    reading: ShownWrench | None
    """The newest mean wrench; None before the first sample."""
    silent: str
    """Text that names the device without new samples and what is wrong; empty while samples arrive."""
    peaks: Peaks
    contact_s: float
    """Duration of the current contact, s."""
    notes: Sequence[FeedNote]
    """Notes about events of the stream, the newest first."""
    checks: Sequence[Check]
    columns: Callable[[int], PlotColumns]
    """Function that returns the recent wrench for plots, divided into the given number of columns."""
    recording_s: float | None
    """Duration of the current recording to a file, s; None if nothing is being recorded."""
    is_frozen: bool = False
    can_push: bool = False
    """Whether a key can push the emulated tool; False for a real cell."""
    replay: RecordingSource | None = None
    calibrated: Array | None = None
    """(n, 3) unit vectors of gravity in flange axes at the poses of the calibration; None if these are unknown."""

    @property
    def live(self) -> ShownWrench | None:
        """The newest mean wrench; None while a device sends no samples, because an old value must not look current."""
        return None if self.silent else self.reading

    @property
    def used_range(self) -> tuple[float, str] | None:
        """Largest fraction of the sensor's range in use, and on which axis; None if range or wrench are unknown."""
        fact = self.info.sensor.facts.get("range")
        if fact is None or not isinstance(fact.value, tuple) or self.reading is None:
            return None
        load = self.reading.raw
        if self.info.sensor.has_arbitrary_zero:
            tare = np.zeros(6) if self.status.tare is None else self.status.tare
            load = load - (tare if self.info.is_raw else self.info.calibration.parameters.bias)
        shares = np.abs(load) / np.array(fact.value)
        worst = int(np.argmax(shares))
        return float(shares[worst]), AXES[worst]

    def in_line(self, *, timed: bool) -> str:
        """Return a line with the wrench (as measured if not calibrated) and frame; `timed` adds time and contact."""
        reading, is_raw = self.reading, self.info.is_raw
        assert reading is not None  # noqa: S101 - there is one from the first sample on
        wrench = reading.raw_in_frame if is_raw else reading.wrench
        force, torque = (" ".join(f"{x:9.{n}f}" for x in part) for part, n in ((wrench[:3], 3), (wrench[3:], 5)))
        line = f"stale: {self.silent}" if self.silent else f"F {force} N   T {torque} N·m   ({reading.frame})"
        contact = "   contact" if reading.in_contact and not (is_raw or self.silent) else ""
        return f"{reading.t_host_ns * 1e-9:.1f} s   {line}{contact}" if timed else line

    def to_dict(self) -> dict[str, Any]:
        """Return the state of the stream as JSON; all wrenches are null while a device sends no samples."""
        status, calibration, verification = self.status, self.info.result, self.info.verification
        reading, is_raw = self.reading, self.info.is_raw
        assert reading is not None  # noqa: S101 - there is one from the first sample on

        def wrench(values: Array) -> dict[str, Any] | None:
            if self.silent:
                return None
            numbers = [float(value) if np.isfinite(value) else None for value in values]
            return {"force_N": numbers[:3], "torque_Nm": numbers[3:]}

        return {
            "schema_version": 1,
            "t_s": reading.t_host_ns * 1e-9,
            "axes": reading.frame.axes,
            "about": "sensor origin" if reading.frame.about == "sensor" else reading.frame.about,
            "raw": wrench(reading.raw_in_frame),
            "compensated": None if is_raw else wrench(reading.wrench),
            "sigma": wrench(reading.sigma),
            "sigma_at_rest": wrench(reading.rest_sigma),
            "contact": None if self.silent or is_raw else reading.in_contact,
            "stale": self.silent or None,
            "delay_s": None if is_raw else {"value": status.delay_s, "sigma": status.delay_sigma_s},
            "rate_Hz": status.sensor.rate_Hz,
            "lost": status.sensor.lost,
            "calibration": calibration and calibration.provenance.get("created_utc"),
            "calibration_id": calibration and calibration.id,
            "verdict": calibration and calibration.verdict,
            "marks": list(self.info.marks),
            "tracked": None if status.tracked is None else status.tracked.to_dict(),
            "verification": None if verification is None else verification.to_dict(),
        }


class StreamSummary:
    """Collects what a `Feed` reads, and the findings `checks`, into a `View` to show.

    If the `dataset` of the calibration is given, the stream's noise at rest is compared with the noise in it.
    """

    def __init__(self, feed: Feed, checks: Sequence[Check] = (), dataset: CalibrationDataset | None = None) -> None:
        self.span_s = SPANS_S[1]
        self.is_frozen = False
        self._feed = feed
        self._new_blocks, self._new_notes = feed.subscribe()
        self._found, self._checks = deque(checks), list[Check]()
        self._histories = {span_s: History(span_s) for span_s in SPANS_S}
        # samples of the last 0.1 s, for the mean
        self._recent: Block | None = None
        self._peaks = Peaks()
        self._contact_since_ns = 0
        self._notes: deque[FeedNote] = deque(maxlen=_MOST_NOTES)
        self._calibrated: Array | None = None
        if dataset is not None:
            feed.sinks.append(NoiseWatch(dataset, self._found.append))
            self._calibrated = feed.stream.info.calibration.parameters.down @ dataset.R_base_flange

    def reset_peaks(self) -> None:
        """Forget the smallest and largest values of the wrench so far."""
        self._peaks = Peaks()

    def view(self) -> View:
        """Take the new samples and notes of the feed, and return the state of the stream to show."""
        feed = self._feed
        while self._found:
            self._checks.append(check := self._found.popleft())
            if check.state in {"failed", "warning"}:
                text = f"{check.found}. Fix: {check.fix}" if check.fix else check.found
                self._notes.appendleft(FeedNote(None, text, "warning"))
        while self._new_notes:
            note = self._new_notes.popleft()
            times = 1 + (self._notes.popleft().times if self._notes and self._notes[0].text == note.text else 0)
            self._notes.appendleft(replace(note, times=times))
        blocks = [self._new_blocks.popleft() for _ in range(len(self._new_blocks))]
        if not self.is_frozen:
            for _, alike in groupby(blocks, lambda block: (block.frame, block.stages)):
                self._add(Block.concatenate(list(alike)))
        in_contact = self._recent is not None and self._recent.in_contact[-1]
        return View(
            info=feed.stream.info,
            status=feed.status,
            reading=self._reading(),
            silent=self._silent(),
            peaks=self._peaks,
            contact_s=(self._now_ns - self._contact_since_ns) * 1e-9 if in_contact else 0.0,
            notes=self._notes,
            checks=self._checks,
            columns=self._columns,
            recording_s=feed.recording_s,
            is_frozen=self.is_frozen,
            can_push=feed.push is not None,
            calibrated=self._calibrated,
            replay=feed.stream.source if isinstance(feed.stream.source, RecordingSource) else None,
        )

    def views(self, *, raises: bool = False) -> Iterator[View]:
        """Read; once the noise is known, yield a view per 0.1 s. A failure raises at once if `raises`, else later."""
        feed, stream = self._feed, self._feed.stream
        begin_ns: int | None = None
        is_known = False
        begin = feed.turns(0.0, until=lambda: is_known)
        for block in chain(begin, feed.turns(0.0 if raises else RECOVER_S)):
            if block is None:
                yield self.view()
                continue
            if feed.newest_ns is None:
                continue
            begin_ns = feed.newest_ns if begin_ns is None else begin_ns
            ends = stream.has_ended and not is_known
            if (feed.newest_ns - begin_ns) * 1e-9 >= MEAN_S - 0.5 / stream.info.sensor_rate_Hz or ends:
                begin_ns = feed.newest_ns
                is_known = bool(np.isfinite(feed.sigma).all()) or isinstance(stream.source, RecordingSource)
                view = self.view()
                if is_known:
                    yield view

    def lines(self, *, once: bool, as_json: bool) -> Iterator[str]:
        """Yield the stream's `views` as lines of text or JSON; with `once`, only the first."""
        for view in islice(self.views(raises=once), 1 if once else None):
            yield json.dumps(view.to_dict()) if as_json else view.in_line(timed=not once)

    @property
    def _now_ns(self) -> int:
        return 0 if self._recent is None else int(self._recent.t_host_ns[-1])

    def _columns(self, n: int) -> PlotColumns:
        marks_ns = (note.t_host_ns for note in self._notes if note.kind in _MARKS and note.t_host_ns is not None)
        return self._histories[self.span_s].columns(self._now_ns, n, marks_ns)

    def _silent(self) -> str:
        feed = self._feed
        for device, link in ((feed.stream.info.sensor, feed.status.sensor), (feed.stream.info.arm, feed.status.arm)):
            if link.error or link.age_s > STALE_S:
                return f"{device.model}: {link.error or f'no sample for {link.age_s:.1f} s'}"
        waits_s = (feed.stream.clock.now_ns() - feed.turned_ns) * 1e-9
        return f"no samples read for {waits_s:.0f} s: check the reader of the output" if waits_s > _HELD_S else ""

    def _reading(self) -> ShownWrench | None:
        if (recent := self._recent) is None:
            return None
        to_frame = FrameTransform(recent.frame, self._feed.stream.info)
        return ShownWrench(
            t_host_ns=self._now_ns,
            wrench=recent.wrench.mean(axis=0),
            raw=recent.raw.mean(axis=0),
            raw_in_frame=to_frame(recent.raw, recent.R_base_flange).mean(axis=0),
            sigma=self._feed.sigma,
            rest_sigma=self._feed.rest_sigma,
            sample_sigma=self._feed.sample_sigma,
            chi2=float(recent.chi2[-1]),
            in_contact=bool(recent.in_contact[-1]),
            R_base_flange=recent.R_base_flange[-1],
            p_base_flange_m=recent.p_base_flange_m[-1],
            q_rad=recent.q_rad[-1],
            frame=recent.frame,
            stages=recent.stages,
        )

    def _add(self, block: Block) -> None:
        before, t_ns, in_contact = self._recent, block.t_host_ns, block.in_contact
        goes_on = before is not None and t_ns[0] > before.t_host_ns[-1]
        if in_contact[-1]:
            free = np.flatnonzero(~in_contact)
            if len(free) or before is None or not goes_on or not before.in_contact[-1]:
                self._contact_since_ns = int(t_ns[free[-1] + 1 if len(free) else 0])
        if before is not None and (block.frame, block.stages) != (before.frame, before.stages):
            goes_on = False
            self.reset_peaks()
            if block.frame != before.frame:
                for history in self._histories.values():
                    history.clear()
        rows = Block.concatenate([before, block]) if before is not None and goes_on else block
        # Also drop samples with later times, which remain from before a jump back in a replayed recording.
        since_ns = t_ns[-1] - round(MEAN_S * 1e9)
        self._recent = rows.rows((since_ns < rows.t_host_ns) & (rows.t_host_ns <= t_ns[-1]))
        self._peaks.add(block.wrench)
        for history in self._histories.values():
            history.add(t_ns, block.wrench, in_contact)


# --------------------------------------------------------------------------------------------------------------- texts


def state(view: View) -> tuple[str, str]:
    """Return the contact state of a stream, such as "contact", and a text with the value and limit of its test."""
    if (reading := view.reading) is None:
        return WAITING, ""
    if np.isnan(reading.chi2) or view.status.contact_limit > _MOST_CHI2:
        return NOISE_UNKNOWN, ""
    chi2 = f"{reading.chi2:.0f}" if reading.chi2 < _MOST_CHI2 else "over 99999"
    return CONTACT if reading.in_contact else FREE, f"test {chi2}, limit {view.status.contact_limit:.1f}"


def wrench_meaning(view: View) -> str:
    """Return what the shown wrench is, by the stages in use, such as "weight included"; empty before a sample."""
    if view.reading is None:
        return ""
    stages = view.reading.stages
    if view.info.is_raw and view.status.tare is not None:
        return "minus tare"
    if stages.bias:
        return "contact wrench" if stages.gravity else "weight included"
    return "bias included" if stages.gravity else "as measured"


def name_devices(info: StreamInfo) -> str:
    """Return a text that names the arm's model, the sensor with its serial number, and the tool."""
    serial = "" if info.sensor.serial == NOT_REPORTED else f" {info.sensor.serial}"
    return " · ".join(filter(None, [info.arm.model, info.sensor.model + serial, info.tool]))


def short_frame(frame: WrenchFrame) -> str:
    """Return a frame's axes and reference point as a short text, such as "base @ tcp"."""
    return f"{frame.axes} @ {_point_name(frame)}"


def _point_name(frame: WrenchFrame) -> str:
    return (
        frame.about if isinstance(frame.about, str) else "({:g},{:g},{:g}) mm".format(*(1e3 * x for x in frame.about))
    )


def direction_text(reading: ShownWrench, first: int) -> str:
    """Return a text with the direction of the force (`first` is 0) or torque (3); empty if it may be noise."""
    if not reading.is_significant(first):
        return ""
    axes, vector = str(reading.frame).partition(", ")[0], reading.wrench[first : first + 3]
    along = " and ".join(axes_along(vector / np.linalg.norm(vector)))
    return f"{'turns about' if first else 'towards'} {along} of {axes}"


def line_of_force(reading: ShownWrench | None) -> str:
    """Return how far from the reference point the contact force's line of action is; empty if it may be noise."""
    if reading is None or not reading.in_contact or not reading.is_significant(0):
        return ""
    force, torque = reading.wrench[:3], reading.wrench[3:]
    p_m = np.cross(force, torque) / float(force @ force)
    distance_m = float(np.linalg.norm(p_m))
    if distance_m < 5e-4:
        return f"line of force passes through {_point_name(reading.frame)}"
    along = " ".join(axes_along(p_m / distance_m))
    return f"line of force {1e3 * distance_m:.0f} mm from {_point_name(reading.frame)}, {along}"


def _utc(info: StreamInfo, t_host_ns: int) -> datetime:
    return datetime.fromtimestamp((t_host_ns + info.utc_offset_ns) * 1e-9, UTC)


def time_of_day(info: StreamInfo, t_host_ns: int) -> str:
    """Return a time on the clock of the stream as the local time of day, HH:MM:SS."""
    return _utc(info, t_host_ns).astimezone().strftime("%H:%M:%S")


def calibration_in_words(view: View) -> list[tuple[str, str]]:
    """Return texts with the calibration's id, verdict, age and last verification, each with a tone such as "good"."""
    calibration, found = view.info.result, view.info.verification
    if calibration is None:
        return [("sensor alone: no arm, no calibration", "warning")]
    now = None if view.reading is None else _utc(view.info, view.reading.t_host_ns)
    created = calibration.provenance.get("created_utc")
    age = ""
    if now is not None and isinstance(created, str):
        age = f" {age_in_words(now - datetime.fromisoformat(created))}"
    trusted = calibration.verdict == "good" and not set(view.info.marks) - {EMULATED}
    verified = ("not verified", "") if found is None else (found.in_words(now), "good" if found.passed else "bad")
    verdict = calibration.verdict.upper(), "good" if trusted else "warning"
    return [(f"cal {calibration.id[:6]} ", ""), verdict, (f"{age}, ", ""), verified]


def bias_in_words(view: View) -> list[str]:
    """Return texts about the tare, and about the drift of the bias or, if it is tracked, the bias and the part."""
    status, words = view.status, list[str]()
    if status.tare is not None and status.tare_t_host_ns is not None:
        force_N = float(np.linalg.norm(status.tare[:3]))
        words.append(f"tare {time_of_day(view.info, status.tare_t_host_ns)[:5]} {force_N:.2f} N")
    elif status.tracked is None:
        words.append("tare none")
    if view.info.is_raw:
        return words
    if status.tracked is not None:
        return [*words, status.tracked.in_words()]
    drift, sigma = (f"{v:.0f}" if v >= 10 else f"{v:.2g}" for v in (status.drift_N_h, status.drift_sigma_N_h))
    return [*words, f"drift {drift} ± {sigma} N/h"]


def link_in_words(view: View, link: LinkStatus) -> tuple[str, str, str, str]:
    """Return texts with rate, losses and age of a device's samples, and the wrench's delay (empty for the sensor)."""
    nominal = "" if np.isnan(link.nominal_rate_Hz) else f" of {link.nominal_rate_Hz:.0f}"
    age = f"{1e3 * link.age_s:.0f} ms" if link.age_s < 1 else f"{link.age_s:.1f} s"
    sigma_s, delay = view.status.delay_sigma_s, f"delay {1e3 * view.status.delay_s:.1f}"
    delay += f" ± {1e3 * sigma_s:.1f} ms" if sigma_s else " ms, set"
    if link is view.status.sensor or view.replay is not None:  # recordings are already aligned
        delay = ""
    elif sigma_s >= _MEASURED_S:
        delay = "delay not measured yet"
    return f"{link.rate_Hz:.0f}{nominal} Hz", f"lost {link.lost}", f"age {age}", delay


def other_wrenches(view: View) -> list[tuple[str, Array | None]]:
    """Return named wrenches: after only some stages, and in other frames; None if a frame needs a missing setting."""
    if (reading := view.reading) is None or view.info.is_raw:
        return []
    calibration, raw, R, now = view.info.calibration, reading.raw, reading.R_base_flange, reading.frame
    tare = np.zeros(6) if view.status.tare is None else view.status.tare
    contact, unbiased = calibration.compensate(raw, R) - tare, raw - calibration.parameters.bias - tare
    rows = [("as measured", raw, now), ("without bias", unbiased, now), ("and without gravity", contact, now)]
    rows += [(short_frame(frame), contact, frame) for frame in _FRAMES if frame != now]
    found = list[tuple[str, Array | None]]()
    for name, wrench, frame in rows:
        try:
            found.append((name, FrameTransform(frame, view.info).matrix(R) @ wrench))
        except ConfigError:
            found.append((name, None))
    return found


def full_scale(columns: PlotColumns, reading: ShownWrench | None, first: int) -> float:
    """Return a round full scale for plots of force (`first` is 0) or torque (3): above the extremes and 10 sigma."""
    rows = slice(first, first + 3)
    largest = np.abs([columns.low[rows], columns.high[rows]])
    sigma = np.zeros(3) if reading is None else np.nan_to_num(reading.sample_sigma[rows])
    least = _LEAST_FULL_SIGMA * float(sigma.max())
    wanted = max(least, 1.05 * float(largest[np.isfinite(largest)].max(initial=0.0)), 1e-6)
    decade = 10.0 ** np.floor(np.log10(wanted))
    return float(next(step * decade for step in (1, 2, 5, 10) if step * decade >= wanted))


# -- the screen and page of a scale

NO_MASS = "- - -"
# A smallest detectable mass above this, kg, is due to the bias's drift since the calibration, so zeroing helps.
_UNZEROED_KG = 0.1


def worth_of(weight: Weight) -> str:
    """Return a text with the sigma of a weighed mass and the smallest mass that could be detected."""
    sigma_g, least_g = (to_place_of(1e3 * kg, 1e3 * kg) for kg in (weight.mass_sigma_kg, weight.least_kg))
    return f"sigma {sigma_g} g, smallest mass {least_g} g"


def zero_in_words(weighing: Weighing) -> tuple[str, bool]:
    """Return a text with the time since the last zero, and whether zeroing would help; empty if the bias is tracked."""
    if weighing.moving:
        return "", False
    zeroed_s, weight = weighing.stream.processor.monitor.reference()[1], weighing.shown.measured
    helps, zeroed = weight is not None and weight.least_kg > _UNZEROED_KG, isfinite(zeroed_s)
    age = f"zeroed {age_in_words(timedelta(seconds=zeroed_s))} ago" if zeroed else "not zeroed"
    return age + (f": zero {'again' if zeroed else 'the empty gripper'}" if helps else ""), helps
