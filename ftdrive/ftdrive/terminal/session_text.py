"""The texts of a session and of a push: what is planned, asked, estimated, changed."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ftcalib.rounding import to_place_of, with_sigma
from ftdrive.checks.arm import FlangeLoad, margin_in_words
from ftdrive.planning.plan import Plan
from ftdrive.session.events import (
    Asked,
    Checked,
    Compared,
    Estimated,
    Event,
    GuardTripped,
    MotionRecorded,
    Noted,
    Planned,
    PoseTaken,
    RunOpened,
    State,
    StateChanged,
    rms_sigma,
)
from ftdrive.session.settings_push import Push
from ftdrivers.interfaces import ControllerSettings


@dataclass(frozen=True, slots=True)
class TextLine:
    """A line of text."""

    head: str
    """A mark or indent; a folded line continues below the first word after it."""
    words: str
    style: str = ""
    """Style of rich, for a terminal with colour."""


class SessionText:
    """Turns events into lines, in sections with headings.

    Parameters
    ----------
    verbose : bool
        Print a line for each check, the table of the plan, and the estimate after each pose. Otherwise passed checks
        share one line, and the plan has three.
    poses : bool
        Print a line for each pose. A live screen shows them already.
    """

    def __init__(self, *, verbose: bool = False, poses: bool = True) -> None:
        self._verbose, self._poses = verbose, verbose or poses
        self._sections = list[str]()
        self._sweeps = False
        self._passed = list[str]()

    def lines(self, event: Event) -> list[TextLine]:
        """Return the lines to print for an event, those that waited for it first."""
        if isinstance(event, Checked) and event.passed and not self._verbose:
            heading = [] if self._passed else self._heading("Checks")
            self._passed.append(event.name)
            return heading
        body, waiting = self._body(event), self.pending()
        if not body and not isinstance(event, RunOpened):
            return waiting
        return waiting + self._heading_before(event) + body

    def pending(self) -> list[TextLine]:
        """Return the line of the checks that have passed so far."""
        passed, self._passed = self._passed, []
        return [TextLine(" ✔ ", ", ".join(passed), "green")] if passed else []

    def _heading_before(self, event: Event) -> list[TextLine]:
        match event:
            case Planned():
                self._sweeps = event.plan.sweep is not None
                return self._heading("Plan")
            case Checked():
                return self._heading("Checks")
            # a run that is continued is opened before its plan is known
            case RunOpened() if not self._sections:
                return []
            case RunOpened() | PoseTaken() | StateChanged(state=State.APPROACH | State.MOVE | State.SWEEP):
                return self._heading("Motion" if self._sweeps else "Tour")
            case _:
                return []

    def _heading(self, name: str) -> list[TextLine]:
        """Print each heading once: checks after a stop belong to the tour."""
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
    room = "" if plan.arm_rests else ", and the room of the whole arm"
    motion = f"{count} poses, {count} moves"
    if plan.sweep is not None:
        motion = f"sweep of {plan.sweep.duration_s:.0f} s,"
    return (
        f"{motion} {proven}; {moving}",
        f"keep clear: {plan.ball_in_words()}{room}",
    )


def in_words(event: Event) -> str:
    """Return all words of an event: a plan in many lines, others in one. Empty for events that only a screen shows."""
    return "".join(_head_and_words(event))


def _head_and_words(event: Event) -> tuple[str, str]:
    """Return the mark an event begins with, under which its lines are not continued, and its words."""
    match event:
        case RunOpened():
            return "", f"kept in {event.folder}" + (
                f"; after a stop, continue with\n{event.resume}" * bool(event.resume)
            )
        case StateChanged(state=State.HOLD):  # repeats the words of STOP
            return "", f"{event.state.upper()}: {event.words}"
        case StateChanged(state=State.PREFLIGHT | State.APPROACH | State.SWEEP | State.CLOSE):
            return "", f"{event.state}{': ' if event.words else ''}{event.words}"
        case Checked():
            return "✔ " if event.passed else "✘ ", f"{event.name}: {event.words}"
        case Planned():
            return "", "\n".join(filter(None, (event.plan.in_words(), event.stop_words, event.way_words)))
        case Noted():
            return "! " if event.warning else "", event.words
        case PoseTaken() | MotionRecorded():
            return "", _pose_in_words(event) if isinstance(event, PoseTaken) else _motion_in_words(event)
        case Estimated():
            return "  ", _estimate_in_words(event)
        case Compared():
            return "  ", _comparison_in_words(event)
        case GuardTripped():
            return "", f"STOPPED by guard {event.hazard}: {event.words}"
        case Asked():
            colon = "" if event.question.endswith("?") else ":"
            return "", f"{event.question}{colon} {event.answer}{' (--yes)' if event.by == '--yes' else ''}"
        case _:
            return "", ""


def _motion_in_words(event: MotionRecorded) -> str:
    words = f"recorded {event.samples} samples of the sensor, {event.states} of the arm"
    return f"{words}; {event.duration_s:.1f} s"


def _pose_in_words(event: PoseTaken) -> str:
    force_N, torque_Nm = rms_sigma(event.sigma)
    words = (
        f"{event.stop}/{event.stops} R{event.number:02d}: settled {event.settle_s:.1f} s, {event.samples} samples in "
        f"{event.average_s:.1f} s, sigma {force_N:.2g} N {to_place_of(torque_Nm, torque_Nm)} N·m"
    )
    if event.attempts > 1:
        words += f", {event.attempts} attempts"
    return words if event.steady else words + ", NOT STEADY"


def _estimate_in_words(event: Estimated) -> str:
    words = f"coverage {event.light}"
    if "mass_kg" in event.values:
        words += f", mass {with_sigma(event.values['mass_kg'], event.sigma['mass_kg'])} kg"
    if event.residual_sigma is not None and event.residual_force_N is not None:
        words += f", {event.residual_force_N:.3f} N from the fit before, {event.residual_sigma:.1f} sigma"
    return f"{words}; helps most: {event.hint}" if event.hint else words


def _comparison_in_words(event: Compared) -> str:
    """Describe how far a pose is from the prediction, and how far it is expected to be (one sigma)."""
    found, expected = (
        f"{np.linalg.norm(vector[:3]):.3f} N, {np.linalg.norm(vector[3:]):.4f} N·m"
        for vector in (event.residual, event.sigma)
    )
    words = f"{found} from the prediction, {expected} expected, {sigmas_of(event):.1f} sigma"
    return f"{words}; {event.hint}" if event.hint else words


def sigmas_of(event: Compared) -> float:
    """Largest of the six differences over its standard deviation."""
    return float(np.max(np.abs(event.residual) / event.sigma))


_LEVEL_DEG = 0.05


def proposal_in_lines(push: Push) -> list[str]:
    """Return the controller's values beside the new ones, and what speaks for and against the change."""
    lines = _table(push)
    if (restored := push.reason.get("restores")) is not None:
        lines.append(f"The new values are the old ones of {restored}.")
    if push.load is not None and push.new.mass_kg is not None:
        lines += _payload(push, push.load)
    before_kg = push.reason.get("payload_at_calibration_kg")
    if before_kg is not None and push.old.mass_kg is not None and abs(before_kg - push.old.mass_kg) > 1e-3:
        lines.append(f"At the calibration, the payload in the controller was {before_kg:.3f} kg.")
    if push.lean is not None:
        lines.append(_lean(push))
    if push.contact is not None:
        force_N, torque_Nm = np.linalg.norm(push.contact[:3]), np.linalg.norm(push.contact[3:])
        lines.append(
            f"The reading differs from a free tool by {force_N:.1f} N, {torque_Nm:.2f} N·m. "
            "A large difference is drift or contact."
        )
    return lines


def _table(push: Push) -> list[str]:
    values = {
        "mass, kg": (push.old.mass_kg, push.new.mass_kg, 1.0, 3),
        "centre, mm": (push.old.p_flange_com_m, push.new.p_flange_com_m, 1e3, 1),
        "gravity, m/s²": (push.old.up_base_m_s2, push.new.up_base_m_s2, 1.0, 3),
    }
    rows = [("", "controller", "new", "change")]
    for name, (old, new, scale, digits) in values.items():
        if new is not None:
            change = "" if old is None else _numbers(np.subtract(new, old) * scale, f"+.{digits}f")
            rows.append((name, _numbers(old, f".{digits}f", scale), _numbers(new, f".{digits}f", scale), change))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]


def _payload(push: Push, load: FlangeLoad) -> list[str]:
    centre = ", ".join(to_place_of(1e3 * sigma_m, 1e3 * sigma_m) for sigma_m in load.sigma_m)
    sigma = f"{to_place_of(load.sigma_kg, load.sigma_kg)} kg and {centre} mm"
    inertia = "stays that of a point mass" if not any(push.new.inertia_kg_m2 or ()) else "is kept"
    return [
        f"The centre is in flange axes. One sigma is {sigma}. The inertia {inertia}: gravity does not reveal it.",
        f"The load is {margin_in_words(load.mass_kg, push.devices['arm'].model)}.",
        "Included are sensor and adapter, {sensor_mass_kg:g} kg; their centre is taken half way up the sensor's "
        "height of {sensor_height_mm:g} mm.".format(**push.reason),
    ]


def settings_in_words(settings: ControllerSettings | None) -> str:
    """Return what a controller reports."""
    if settings is None or settings.mass_kg is None:
        return "the controller does not report its payload: compare it at the pendant"
    up = "" if settings.up_base_m_s2 is None else f", gravity {_numbers(settings.up_base_m_s2, '.3f')} m/s²"
    return f"{settings.mass_kg:.3f} kg at {_numbers(settings.p_flange_com_m, '.1f', 1e3)} mm{up}"


def _lean(push: Push) -> str:
    up = push.old.up_base_m_s2
    if up is None:
        return f"The base {push.lean}, compared with [workcell] mounting; the controller does not report its gravity."
    off_deg = np.degrees(np.arccos(np.clip(up[2] / np.linalg.norm(up), -1, 1)))
    setting = "level" if off_deg < _LEVEL_DEG else f"{_numbers(up, '.3f')} m/s²"
    advice = (
        "" if push.lean is None or not push.lean.is_significant or push.new.up_base_m_s2 else "; --gravity sends it"
    )
    return f"The base {push.lean}; the controller is set to {setting}{advice}."


def _numbers(value: ArrayLike | None, form: str, scale: float = 1.0) -> str:
    if value is None:
        return "not reported"
    numbers = [f"{one:{form}}" for one in scale * np.atleast_1d(value)]
    return numbers[0] if np.ndim(value) == 0 else f"({', '.join(numbers)})"
