"""Texts about a session and about `ftdrive push`, and `SessionView`, the state that screen and page show."""

from dataclasses import dataclass, field
from itertools import pairwise
from statistics import median
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from ftcalib.rounding import decimals, to_place_of, with_sigma
from ftcalib.routine import DriftCheck
from ftdrive.checks.arm import FlangeLoad, margin_in_words
from ftdrive.planning.plan import Plan
from ftdrive.session.events import (
    Asked,
    Checked,
    Compared,
    Estimated,
    Event,
    GuardTripped,
    Key,
    MotionRecorded,
    Noted,
    Planned,
    PoseTaken,
    RunOpened,
    State,
    StateChanged,
    rms_sigma,
)
from ftdrive.session.live_fit import GREEN
from ftdrive.session.settings_push import Push
from ftdrive.words.result import drift_in_words
from ftdrive.words.text import TextLine
from ftdrivers.interfaces import ControllerSettings

# Estimates on the screen: label with unit, factor from SI, name, and rank (without enough room, the highest go first).
ESTIMATES = (
    ("mass kg", 1.0, "mass_kg", 1),
    ("centre mm", 1e3, "p_sensor_com_m", 2),
    ("F bias N", 1.0, "force_bias_N", 2),
    ("T bias N·m", 1.0, "torque_bias_Nm", 3),
    ("mounting deg", 180 / np.pi, "R_flange_sensor", 4),
    ("tilt a deg", 180 / np.pi, "tilt_alpha_rad", 6),
    ("tilt b deg", 180 / np.pi, "tilt_beta_rad", 6),
)
_NUMBER_WIDTH = 9
# A drift with a standard deviation below this, N or N·m, was not fitted.
_ROUNDED = 1e-9
OFF_SIGMA = 5.0
"""A pose is an outlier if it differs from the fit or prediction by more standard deviations than this."""

_ASCII = str.maketrans(
    dict(zip("┌┐└┘├┤┬┴┼─│━", "+++++++++-|=", strict=True))
    | {"±": "+-", "°": " deg", "·": ".", "…": "~", "✔": "ok", "✘": "FAIL"}
)


class SessionText:
    """Converts the events of a session to lines of text with headings; without `poses`, those of poses give none.

    `verbose` adds a line per check, the table of the plan, and the estimate after each pose. Otherwise, passed checks
    share one line, and the plan has three lines.
    """

    def __init__(self, *, verbose: bool = False, poses: bool = True) -> None:
        self._verbose, self._poses = verbose, verbose or poses
        self._sections = list[str]()
        self._sweeps = False
        self._passed = list[str]()

    def lines(self, event: Event) -> list[TextLine]:
        """Return the lines to print for an event, preceded by those that were held back, see `pending`."""
        if isinstance(event, Checked) and event.passed and not self._verbose:
            heading = [] if self._passed else self._heading("Checks")
            self._passed.append(event.name)
            return heading
        body, waiting = self._body(event), self.pending()
        if not body and not isinstance(event, RunOpened):
            return waiting
        return waiting + self._heading_before(event) + body

    def pending(self) -> list[TextLine]:
        """Return the line that was held back: the checks that have passed so far; empty if there are none."""
        passed, self._passed = self._passed, []
        return [TextLine(" ✔ ", ", ".join(passed), "green")] if passed else []

    def _heading_before(self, event: Event) -> list[TextLine]:
        match event:
            case Planned():
                self._sweeps = event.plan.sweep is not None
                return self._heading("Plan")
            case Checked():
                return self._heading("Checks")
            # no heading for a resumed run, which is opened before its plan is known
            case RunOpened() if not self._sections:
                return []
            case RunOpened() | PoseTaken() | StateChanged(state=State.APPROACH | State.MOVE | State.SWEEP):
                return self._heading("Motion" if self._sweeps else "Tour")
            case _:
                return []

    def _heading(self, name: str) -> list[TextLine]:
        """Return a heading, but only the first time, because checks after a stop belong to the tour."""
        if name in self._sections:
            return []
        self._sections.append(name)
        return [TextLine("", name, "bold cyan")]

    def _body(self, event: Event) -> list[TextLine]:
        match event:
            case Planned() if not self._verbose:
                return [
                    TextLine("   ", words)
                    for words in (*_plan_in_brief(event.plan), event.stop_words, event.way_words)
                    if words
                ]
            case RunOpened() | PoseTaken() | Compared() if not self._poses:
                return []
            case Estimated(hint="") if not self._verbose:
                return []
            case StateChanged(state=State.PREFLIGHT | State.CLOSE, words="") if not self._verbose:
                return []
        head, words = _head_and_words(event)
        if not words:
            return []
        style = ""
        if isinstance(event, GuardTripped) or (isinstance(event, Checked) and not event.passed):
            style = "bold red"
        elif isinstance(event, Noted) and event.warning:
            style = "yellow"
        elif isinstance(event, StateChanged) and event.state is State.HOLD:
            style = "bold yellow"
        return [TextLine(f" {head}" if head.strip() else "   ", words, style)]


def _plan_in_brief(plan: Plan) -> tuple[str, str]:
    nearest = min(plan.steps, key=lambda step: step.clearance_m)
    count = len(plan.steps)
    clear = f"{1e3 * nearest.clearance_m:.0f} mm"
    proven = f"proven clear by {clear}" if plan.certified else f"NOT ALL PROVEN CLEAR (nearest: {clear})"
    moving = "only the wrist moves" if plan.arm_rests else "the whole arm moves"
    room = "" if plan.arm_rests else ", and the space around the whole arm"
    motion = f"{count} poses, {count} moves"
    if plan.sweep is not None:
        motion = f"sweep of {plan.sweep.duration_s:.0f} s,"
    return (
        f"{motion} {proven}; {moving}",
        f"keep clear: {plan.ball_in_words()}{room}",
    )


def in_words(event: Event) -> str:
    """Return an event of a session as text: several lines for a plan, else one; empty if only a screen shows it."""
    return "".join(_head_and_words(event))


def _head_and_words(event: Event) -> tuple[str, str]:
    """Return the mark before an event's text, such as "✔ ", and the text, whose further lines start after the mark."""
    match event:
        case RunOpened():
            return "", f"kept in {event.folder}" + (
                f"; after a stop, continue with\n{event.resume}" * bool(event.resume)
            )
        case StateChanged(state=State.HOLD):  # STOP has this text too
            return "", f"{event.state.upper()}: {event.words}"
        case StateChanged(state=State.PREFLIGHT | State.APPROACH | State.SWEEP | State.CLOSE):
            return "", f"{event.state}{': ' if event.words else ''}{event.words}"
        case Checked():
            return "✔ " if event.passed else "✘ ", f"{event.name}: {event.words}"
        case Planned():
            return "", "\n".join(filter(None, (event.plan.in_words(), event.stop_words, event.way_words)))
        case Noted():
            return "! " if event.warning else "", event.words
        case PoseTaken():
            return "", f"{event.stop}/{event.stops} {pose_in_words(event)}"
        case Estimated():
            return "  ", _estimate_in_words(event)
        case Compared():
            return "  ", _comparison_in_words(event)
        case _:
            return "", _event_sentence(event)


def _event_sentence(event: Event) -> str:
    match event:
        case MotionRecorded():
            amount = f"{event.samples} samples of the sensor, {event.states} of the arm"
            return f"recorded {amount}; {event.duration_s:.1f} s"
        case GuardTripped():
            return f"STOPPED by guard {event.hazard}: {event.words}"
        case Asked():
            colon = "" if event.question.endswith("?") else ":"
            return f"{event.question}{colon} {event.answer}{' (--yes)' if event.by == '--yes' else ''}"
        case _:
            return ""


def pose_in_words(event: PoseTaken) -> str:
    """Return a text about a recorded pose: orientation number, settling time, samples, sigma."""
    force_N, torque_Nm = rms_sigma(event.sigma)
    flags = [*["NOT STEADY"] * (not event.steady), *[f"{event.attempts} attempts"] * (event.attempts > 1)]
    settled = f"settled {event.settle_s:.1f} s, {event.samples} samples in {event.average_s:.1f} s"
    sigma = f"sigma {force_N:.2g} N {to_place_of(torque_Nm, torque_Nm)} N·m"
    return f"R{event.number:02d}: {', '.join([*flags, settled, sigma])}"


def _estimate_in_words(event: Estimated) -> str:
    words = f"coverage {event.light}"
    if "mass_kg" in event.values:
        words += f", mass {with_sigma(event.values['mass_kg'], event.sigma['mass_kg'])} kg"
    if residual := residual_in_words(event):
        words += f", {residual}"
    return f"{words}; helps most: {event.hint}" if event.hint else words


def residual_in_words(event: Estimated) -> str:
    """Return a text with the newest pose's residual relative to the fit without it; empty without such a fit."""
    if event.residual_sigma is None or event.residual_force_N is None:
        return ""
    return f"{event.residual_force_N:.3f} N from the previous fit, {event.residual_sigma:.1f} sigma"


def _comparison_in_words(event: Compared) -> str:
    force, torque, sigmas = differences(event)
    words = f"{force} N, {torque} N·m from the prediction, {sigmas} sigma"
    return f"{words}; {event.hint}" if event.hint else words


def differences(event: Compared) -> tuple[str, str, str]:
    """Return texts of a pose's differences from the prediction ± sigma, N and N·m, and of the largest in sigmas."""
    (N, Nm), (N_sigma, Nm_sigma) = (np.linalg.norm(six.reshape(2, 3), axis=1) for six in (event.residual, event.sigma))
    return f"{N:.3f} ± {N_sigma:.3f}", f"{Nm:.4f} ± {Nm_sigma:.4f}", f"{sigmas_of(event):.1f}"


def sigmas_of(event: Compared) -> float:
    """Return the largest of a pose's six differences from the prediction, in standard deviations."""
    return float(np.max(np.abs(event.residual) / event.sigma))


_LEVEL_DEG = 0.05


def proposal_in_lines(push: Push) -> list[str]:
    """Return lines about a push: the controller's old and new values, and what speaks for and against the change."""
    lines = _push_table(push)
    if (restored := push.reason.get("restores")) is not None:
        lines.append(f"The new values restore those before {restored}.")
    if push.load is not None and push.new.mass_kg is not None:
        lines += _payload(push, push.load)
    before_kg = push.reason.get("payload_at_calibration_kg")
    if before_kg is not None and push.old.mass_kg is not None and abs(before_kg - push.old.mass_kg) > 1e-3:
        lines.append(f"At the calibration, the payload in the controller was {before_kg:.3f} kg.")
    if push.lean is not None:
        lines.append(_lean_text(push))
    if push.contact is not None:
        force_N, torque_Nm = np.linalg.norm(push.contact[:3]), np.linalg.norm(push.contact[3:])
        lines.append(
            f"The reading differs from a free tool by {force_N:.1f} N, {torque_Nm:.2f} N·m. "
            "A large difference is drift or contact."
        )
    return lines


def _push_table(push: Push) -> list[str]:
    values = {
        "mass, kg": (push.old.mass_kg, push.new.mass_kg, 1.0, 3),
        "centre, mm": (push.old.p_flange_com_m, push.new.p_flange_com_m, 1e3, 1),
        "gravity, m/s²": (push.old.up_base_m_s2, push.new.up_base_m_s2, 1.0, 3),
    }
    rows = [("", "controller", "new", "change")]
    for name, (old, new, scale, digits) in values.items():
        if new is not None:
            change = "" if old is None else _format_vector(np.subtract(new, old) * scale, f"+.{digits}f")
            rows.append(
                (name, _format_vector(old, f".{digits}f", scale), _format_vector(new, f".{digits}f", scale), change)
            )
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]


def _payload(push: Push, load: FlangeLoad) -> list[str]:
    centre = ", ".join(to_place_of(1e3 * sigma_m, 1e3 * sigma_m) for sigma_m in load.sigma_m)
    sigma = f"{to_place_of(load.sigma_kg, load.sigma_kg)} kg and {centre} mm"
    inertia = "stays that of a point mass" if not any(push.new.inertia_kg_m2 or ()) else "is kept"
    return [
        f"The centre is in flange axes. One sigma is {sigma}. The inertia {inertia}: gravity does not reveal it.",
        f"The load is {margin_in_words(load.mass_kg, push.devices['arm'].model)}.",
        "Included are sensor and adapter, {sensor_mass_kg:g} kg; their centre is assumed to be halfway up the sensor's "
        "height of {sensor_height_mm:g} mm.".format(**push.reason),
    ]


def settings_in_words(settings: ControllerSettings | None) -> str:
    """Return a text with the payload and gravity that a robot controller reports."""
    if settings is None or settings.mass_kg is None:
        return "the controller does not report its payload: compare it on the pendant"
    up = "" if settings.up_base_m_s2 is None else f", gravity {_format_vector(settings.up_base_m_s2, '.3f')} m/s²"
    return f"{settings.mass_kg:.3f} kg at {_format_vector(settings.p_flange_com_m, '.1f', 1e3)} mm{up}"


def _lean_text(push: Push) -> str:
    up = push.old.up_base_m_s2
    if up is None:
        return f"The base {push.lean}, relative to [workcell] mounting; the controller does not report its gravity."
    off_deg = np.degrees(np.arccos(np.clip(up[2] / np.linalg.norm(up), -1, 1)))
    setting = "level" if off_deg < _LEVEL_DEG else f"{_format_vector(up, '.3f')} m/s²"
    advice = (
        "" if push.lean is None or not push.lean.is_significant or push.new.up_base_m_s2 else "; --gravity sends it"
    )
    return f"The base {push.lean}; the controller is set to {setting}{advice}."


def _format_vector(value: ArrayLike | None, form: str, scale: float = 1.0) -> str:
    if value is None:
        return "not reported"
    numbers = [f"{one:{form}}" for one in scale * np.atleast_1d(value)]
    return numbers[0] if np.ndim(value) == 0 else f"({', '.join(numbers)})"


@dataclass
class SessionView:
    """State of a session, as the screen and the page show it."""

    command: str = "calibrate"
    now: StateChanged | None = None
    since_s: float = 0.0
    """Start time of the current state, s, on the clock of the screen or page."""
    folder: str = ""
    resume: str = ""
    taken: dict[int, tuple[PoseTaken, float]] = field(default_factory=dict)
    """Poses with the times of their events, s, by the number of the stop."""
    last: PoseTaken | None = None
    estimated: Estimated | None = None
    compared: dict[int, Compared] = field(default_factory=dict)
    """In a verification, the comparison of each pose with its prediction, by the number of the stop."""
    drift: DriftCheck | None = None
    note: Noted | GuardTripped | None = None
    tripped: bool = False
    """Whether a guard has stopped the arm. The states STOP and HOLD, whose text repeats the guard's, show none then."""
    waiting: tuple[Key, ...] = ()
    ascii_only: bool = False
    """Whether the terminal can show only ASCII characters."""
    keys: Literal["live", "asking", "over"] = "live"
    """"live" while single keys are read, "asking" while a line is read as an answer, "over" at the end."""

    def update(self, event: Event, now_s: float) -> None:
        """Update the state by an event of the session, which came at `now_s`."""
        match event:
            case RunOpened():
                self.folder, self.resume = event.folder, event.resume
            case StateChanged():
                self.now, self.since_s = event, now_s
                self.tripped = self.tripped and event.state in {State.STOP, State.HOLD}
            case PoseTaken():
                self._take(event, now_s)
            case Estimated():
                self.estimated = event
            case Compared():
                self.compared[event.stop] = event
            case Noted(warning=True):
                self.note = event
            case GuardTripped():
                self.note, self.tripped = event, True

    def shown(self, text: str) -> str:
        """Replace characters that the terminal cannot show. This can lengthen a text, so measure it afterwards."""
        return text.translate(_ASCII) if self.ascii_only else text

    @property
    def kept(self) -> int:
        """Number of stored poses. It includes poses from before a resume, which only the fit knows."""
        return max(len(self.taken), self.estimated.poses if self.estimated else 0)

    def _take(self, event: PoseTaken, now_s: float) -> None:
        self.taken[event.stop] = event, now_s
        self.last, self.note = event, None
        first, first_s = self.taken[min(self.taken)]
        if event.number == first.number and event.stop != first.stop:
            sigma = np.hypot(first.sigma, event.sigma)
            self.drift = DriftCheck(np.subtract(event.mean, first.mean), sigma, now_s - first_s)


def progress_in_words(view: SessionView, now_s: float) -> str:
    """Return a text with the number of stored poses and the remaining time; `now_s` is on the clock of `since_s`."""
    times_s = sorted(at_s for _, at_s in view.taken.values())
    kept = view.kept
    left = view.last.stops - kept if view.last else 0
    if len(times_s) <= 2 or left <= 0:
        return f"{kept} kept"
    # median time per pose, because a stop with questions takes longer
    usual_s = median(b - a for a, b in pairwise(times_s))
    # limited, so that the remaining time does not shrink during a hold
    rest_s = usual_s * left - min(now_s - times_s[-1], usual_s)
    return f"{kept} kept, about {_minutes(rest_s)} left"


def state_in_words(view: SessionView, now_s: float) -> tuple[str, str, str]:
    """Return three texts: the pose, such as "pose 3/24 R05"; the state and its duration; a text about the state."""
    now = view.now
    if now is None:
        return "", "recording" if view.folder else "starting", ""
    if view.keys == "asking" and now.state in {State.MOVE, State.SETTLE, State.SAMPLE}:
        # not the stored state, because the arm rests during a question
        return "", "WAITS for an answer", ""
    where = "" if now.stop is None else f"pose {now.stop}" + (f"/{now.stops}" if now.stops is not None else "")
    where += f" R{now.number:02d}" if where and now.number is not None else ""
    lasts = "" if now.state is State.HOLD else f"  {_minutes(now_s - view.since_s)}"
    return where, f"{now.state.upper()}{lasts}", "" if view.tripped else now.words


def coverage_in_words(fit: Estimated) -> str:
    """Return a text about how well the poses so far determine the result: condition numbers and largest gap."""
    words = ""
    for name, what in (("cond9", "condition"), ("cond_u1", "out of plane")):
        value, goal = getattr(fit, name), GREEN[name]
        words += f"   {what} {f'{value:.1f}' if value < 100 else '>100'}" + (
            f" (goal {goal:g})" if value > goal else ""
        )
    return f"{words}   gap {fit.empty_cap_deg:.0f}°"


def drift_so_far(view: SessionView) -> TextLine:
    """Return a line about the drift of the bias since the first pose, from the fit or the repeated first pose."""
    fit = view.estimated
    if view.drift is not None:
        words, bad = drift_in_words(view.drift)
        return TextLine("", words, "bold yellow" if bad else "")
    if fit is None or not fit.values:
        when = "the fit" if view.command == "calibrate" else "the first pose is measured again"
        return TextLine("", f"not known before {when}", "dim")
    if "drift" not in fit.values:
        return TextLine("", "none seen so far")
    change, sigma = fit.values["drift"], fit.sigma["drift"]
    fitted = sigma > _ROUNDED
    sure = bool((np.abs(change) > 4 * sigma)[fitted].any())
    parts = [
        f"{with_sigma(np.linalg.norm(change[some]), np.max(sigma[some]))} {unit}"
        for some, unit in ((slice(3), "N"), (slice(3, 6), "N·m"))
        if fitted[some].any()
    ]
    words = f"{', '.join(parts)} since the first pose"
    return TextLine("", words if sure else f"{words}, perhaps", "yellow" if sure else "")


def rounded_estimate(fit: Estimated | None, factor: float, name: str) -> tuple[list[str], str]:
    """Return an estimate's values times `factor` as texts, and its largest sigma; empty before the first fit."""
    if fit is None or name not in fit.values:
        return [], ""
    value: ArrayLike = fit.values[name]
    if name == "R_flange_sensor":
        value = Rotation.from_matrix(np.asarray(value)).as_rotvec()
    values, sigma = factor * np.atleast_1d(value), factor * float(np.max(fit.sigma[name]))
    digits = decimals(sigma)
    while digits and len(f"{-np.abs(values).max():.{digits}f}") > _NUMBER_WIDTH - 1:
        digits -= 1
    return [f"{one:.{digits}f}" for one in values], to_place_of(sigma, sigma)


def _minutes(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 59.5 else f"{int(seconds) // 60}:{int(seconds) % 60:02d} min"
