"""The browser page of a session: state, question, forces, estimates, the drawn arm, a Stop button, the result."""

import logging
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Final, Self

import numpy as np

from ftcalib.model import Array
from ftdrive.checks.sensor import AXES
from ftdrive.errors import Declined, SupervisorGone
from ftdrive.planning.geometry.certify import Certifier
from ftdrive.session import events
from ftdrive.session.events import Event, Key, Operator, Question, State
from ftdrive.session.guards import Guard, RangeGuard, Seen
from ftdrive.view import scene
from ftdrive.view.page import HUNG_S, Page
from ftdrive.view.parts import ASK, BAD, GOOD, QUIET, WARN, Part, bar, bars, controls, lines, readings, text_table
from ftdrive.view.plan_page import PLAN_LEGEND, PlanTimeline, describe_move, plan_parts
from ftdrive.words.session import (
    ESTIMATES,
    SessionView,
    differences,
    in_words,
    progress_in_words,
    rounded_estimate,
    sigmas_of,
    state_in_words,
)
from ftdrive.words.text import as_typed

log = logging.getLogger(__name__)

Parts = dict[str, Part | None]

_FRAME_S: Final = 0.05
# Guards that have not checked an observation for this time, s, are shown as inactive.
_REST_S: Final = 0.5
# A bar whose value is above this fraction of its limit has the colour of a warning.
_NEAR: Final = 0.8
# Colours of poses by their residual: for each colour, the largest residual in sigmas, and its text in the legend.
_COLOURS: Final = ((3.0, GOOD, "residual ≤ 3 sigma"), (5.0, WARN, "≤ 5 sigma"), (np.inf, BAD, "> 5 sigma"))
_POSES: Final = [
    (name, "ball", f"pose, {words}") for _, name, words in (*_COLOURS, (0, scene.UNKNOWN, "no residual yet"))
]
_SPHERE_M: Final = 0.18
# Camera and legend of a hand-guided session, in which no arm is drawn.
_ALONE: Final[Parts] = {"scene/camera": scene.camera([0, 0, 0], [0.5, 0.5, 0.3]), "scene/legend": scene.legend(*_POSES)}
# States of a session in which the arm has not reached the pose of its stop yet.
_TOWARDS: Final = frozenset({State.APPROACH, State.MOVE})
# Parts of the page that apply only to a running session, and are removed at its end.
_LIVE: Final = ("stop", "alert", "question", "question/along", "state/progress", "state/note", "bars", "bars/guards")
_ENDED: Final[Parts] = {**dict.fromkeys(_LIVE), "state": lines(head="ended")}


class Onlooker(Guard):
    """A guard that never trips: it stores the latest observation of the arm, so that a page can draw it."""

    def __init__(self) -> None:
        self.seen: Seen | None = None
        self.fresh_s = self.age_s = self.looked_s = 0.0
        """When the newest sample arrived; its age at the last `look`; when that was, on the computer's clock; s."""

    def look(self, seen: Seen) -> None:
        """Store the observation."""
        if self.seen is None or seen.sample != self.seen.sample:
            self.fresh_s = seen.t_s
        self.seen, self.age_s, self.looked_s = seen, seen.t_s - self.fresh_s, time.monotonic()


class SessionPage:
    """An operator that passes everything to another one and shows the session on a page, where viewers can stop it.

    The other operator answers the questions. While a browser shows the page, a thread draws the current state, so that
    browsers do not delay the session. If drawing fails or hangs, the session continues and `pressed` reports it.
    """

    def __init__(self, page: Page, operator: Operator, command: str) -> None:
        self._page, self._operator = page, operator
        self._lock = threading.Lock()
        self._view = SessionView(command)
        self._question: Question | None = None
        self._stopped_by = self._note = self._failure = ""
        self._is_reported = False
        self._stop = 1  # the last stop; a hold names none
        # largest residual in sigmas of the pose at each stop; None if unknown
        self._residuals: dict[int, float | None] = {}
        self._plan: events.Planned | None = None
        self._cell: tuple[Certifier, RangeGuard] | None = None
        self._scene: _Cell | None = None
        self._onlooker = Onlooker()
        self._ended = threading.Event()
        self._drawer = threading.Thread(target=self._run, name="page", daemon=True)
        page.add_stop(self.stop)
        page.on("along", self._look_at)

    def __enter__(self) -> Self:
        self._page.beat()
        self._drawer.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._drawer.join(timeout=1.0)
        self._page.rest()
        self._page.put(_ENDED)

    def stop(self, viewer: str) -> None:
        """Stop the session for a viewer, like the key q. Only the first request counts."""
        self._stopped_by = self._stopped_by or viewer

    def watch(self, certifier: Certifier, load: RangeGuard) -> Onlooker:
        """Return a guard through which the page observes and draws this cell. See `SessionOptions.watch`."""
        self._cell = certifier, load
        return self._onlooker

    def show(self, event: Event) -> None:
        """Store what the page needs of an event, and pass the event to the other operator."""
        with self._lock:
            self._view.update(event, time.monotonic())
            match event:
                case events.Planned():
                    self._plan = event
                case events.Noted():
                    self._note = event.words
                case events.StateChanged(state=State.REPORT):
                    self._note = ""
                case events.StateChanged(stop=int(stop)):
                    self._stop = stop
                case events.PoseTaken():
                    self._note, self._residuals[event.stop] = "", None
                case events.Estimated() if self._view.last is not None:
                    self._residuals[self._view.last.stop] = event.residual_sigma
                case events.Compared():
                    self._residuals[event.stop] = sigmas_of(event)
        self._operator.show(event)

    def ask(self, question: Question) -> str:
        """Let the other operator answer, and show the question. Raises `Declined` too if a viewer stops the session."""
        self._report_failure()
        self._require_unstopped()
        self._question, self._view.keys = question, "asking"
        try:
            answer = self._operator.ask(question)
        finally:
            self._question, self._view.keys = None, "live"
        self._require_unstopped()
        return answer

    def absence(self) -> str | None:
        """Return why no operator follows the session; None if one does. Viewers of the page are no operators."""
        return self._operator.absence()

    @property
    def has_keys(self) -> bool:
        """Whether keys are read in the terminal."""
        return self._operator.has_keys

    def pressed(self) -> Key | None:
        """Return `Key.STOP` after a viewer has pressed Stop, else the key pressed in the terminal."""
        self._report_failure()
        return Key.STOP if self._stopped_by else self._operator.pressed()

    @property
    def pressed_by(self) -> str:
        """Name of the viewer or operator who pressed the key that `pressed` returned."""
        return self._stopped_by or self._operator.pressed_by

    @property
    def kept(self) -> Sequence[str]:
        """Lines of the closing message: after an early end, what is stored and how to continue. Empty without a run."""
        return self._note.split("\n") if self._view.folder else ()

    def _require_unstopped(self) -> None:
        if self._stopped_by:
            raise Declined(f"stopped by {self._stopped_by}")

    def _report_failure(self) -> None:
        hung = f"drawing has hung for {HUNG_S:.0f} s" if self._page.stale_s > HUNG_S else ""
        if (why := self._failure or hung) and not self._is_reported:
            self._is_reported = True
            words = f"The page cannot be updated: {why}. The session continues. Stop on the page still works."
            with suppress(SupervisorGone):  # a guard reports it too
                self._operator.show(events.Noted(words=words, warning=True))

    def _look_at(self, _: str, t_s: float) -> None:
        if self._scene is not None:
            self._scene.chosen_s = t_s

    def _run(self) -> None:
        ended = False
        try:
            while not ended:
                ended = self._ended.wait(_FRAME_S)
                if self._page.viewers or ended:
                    self.draw()
                self._page.beat()
        except Exception as error:  # the session goes on without its page
            self._failure = repr(error)
            log.debug("the page cannot be drawn", exc_info=True)

    def draw(self) -> None:
        """Draw the current state of the session on the page."""
        with self._lock:
            view = replace(self._view, taken=dict(self._view.taken), compared=dict(self._view.compared))
            residuals, note = dict(self._residuals), self._note
        question, seen, ended = self._question, self._onlooker.seen, self._ended.is_set()
        if self._scene is None and self._plan is not None and self._cell is not None:
            self._scene = _Cell(self._plan, self._cell[0])
            self._page.put(self._scene.fixed)
        parts = {"question": question_part(question), **_state_panel(view, note, self._stopped_by), **_results(view)}
        if self._scene is not None:
            parts |= self._scene.parts(view.now, self._stop, seen, question, ended=ended)
        if seen is not None and self._cell is not None:
            parts |= self._forces(seen, self._cell[1])
        downs = [(pose.gravity_flange, residuals.get(stop)) for stop, (pose, _) in view.taken.items()]
        parts |= _gravity_sphere(downs, None if self._scene is None else self._scene.sphere_m)
        # if the session has ended, remove its parts again, because a hung drawing may continue after the end
        self._page.put(parts | (_ENDED if self._ended.is_set() else {}))

    def _forces(self, seen: Seen, load: RangeGuard) -> Parts:
        """Return parts with force and torque and the limits of their guard, the joint speed, and the sample's age."""
        if time.monotonic() - self._onlooker.looked_s > _REST_S:
            rest = "The guards are inactive: the arm is drawn at their last observation."
            return {"bars": lines(rest, tone=QUIET), "bars/guards": None}
        limits = np.full(6, np.inf) if load.range is None else load.limits.saturation * load.range
        rows = []
        for axis, value, limit in zip(AXES, seen.wrench - load.zero, limits, strict=True):
            digits, unit = (1, "N") if axis.startswith("F") else (2, "N·m")
            words = f"{value:+.{digits}f} {f'of {limit:.3g} ' if np.isfinite(limit) else ''}{unit}"
            rows.append(bar(axis, value, limit, words, tone=WARN if abs(value) > _NEAR * limit else ""))
        head = "Force and torque, since the start" if load.zero.any() else "Force and torque"
        speed_deg_s, age_ms = np.degrees(np.abs(seen.state.qd_rad_s).max()), 1e3 * self._onlooker.age_s
        guards = text_table([("joint speed", f"{speed_deg_s:.0f} °/s"), ("age of the sample", f"{age_ms:.0f} ms")])
        if load.range is None:  # without limits, no bars can be drawn
            forces = [(row["label"], row["text"]) for row in rows]
            return {"bars": text_table(forces, head=f"{head}; range not known"), "bars/guards": guards}
        return {"bars": bars(*rows, head=head), "bars/guards": guards}


class _Cell:
    def __init__(self, planned: events.Planned, certifier: Certifier) -> None:
        self._tour, self._arm = PlanTimeline(planned.plan, planned.way_rad), certifier.arm
        self._asked: Question | None = None
        self.chosen_s = 0.0
        """Time along the plan, s, that is drawn during a question, as chosen by viewers."""
        wrist_m, size_m = self._arm.frames(self._tour.q_rad[:1]).wrist_m[0], scene.size_of(certifier)
        self.sphere_m = wrist_m + np.array([0.0, 0.0, 0.25 * size_m])
        # the camera shows both the arm and the sphere of gravity directions above it
        look_at = 0.65 * self.sphere_m
        camera = scene.camera(look_at, look_at + 0.7 * size_m * np.array([1.0, 1.0, 0.4]))
        rows = *PLAN_LEGEND, (scene.GHOST, "body", "next pose"), *_POSES
        self.fixed = plan_parts(certifier, self._tour) | {"scene/camera": camera, "scene/legend": scene.legend(*rows)}

    def parts(
        self, now: events.StateChanged | None, stop: int, seen: Seen | None, question: Question | None, *, ended: bool
    ) -> Parts:
        """Return parts with the arm as last observed, its goal, and, during a question, the slider along the plan."""
        nodes, goal_rad, along = self._tour.plan.nodes_rad, None, None
        if question is not None:
            if question is not self._asked:
                self.chosen_s = float(self._tour.begins_s[(stop - 1) % len(self._tour.begins_s)])
            note = ". ".join(describe_move(self._tour.plan, self._tour.move(self.chosen_s))[:2])
            goal_rad, along = self._tour.at(self.chosen_s), controls(self._tour.slider(self.chosen_s), note=note)
        elif seen is not None and seen.motion.moving and not ended:
            goal_rad = seen.motion.goal_rad
        elif now is not None and now.stop is not None and not ended:
            following = now.stop + (now.state not in _TOWARDS)
            goal_rad = nodes[(following - 1) % len(nodes)] if following <= len(nodes) + 1 else None
        self._asked = question
        return {
            "question/along": along,
            **scene.arm_parts(self._arm, self._tour.q_rad[0] if seen is None else seen.state.q_rad),
            **scene.arm_parts(self._arm, goal_rad, "ghost", ghost=True),
        }


def question_part(question: Question | None) -> Part | None:
    """Return a part with the question that waits for its answer in the terminal; None without a question."""
    return None if question is None else lines(question.text, head="Answer in the terminal", tone=ASK)


def _state_panel(view: SessionView, note: str, stopped_by: str) -> Parts:
    now, last, now_s = view.now, view.last, time.monotonic()
    where, state, words = state_in_words(view, now_s)
    stopped = now is not None and now.state in {State.STOP, State.HOLD}
    progress = None if last is None else lines(left := progress_in_words(view, now_s))
    if last is not None and now is not None and now.stops is not None:
        progress = bars(bar("", last.stop, last.stops, left, signed=False))
    alert = None if view.note is None else in_words(view.note)
    red = isinstance(view.note, events.GuardTripped)
    if stopped_by:
        alert, red = f"Stop was pressed by {stopped_by}.", True
    return {
        "alert": None if alert is None else lines(alert, tone=BAD if red else WARN),
        "state": lines(words, head=f"{where}  {state}".strip(), tone=BAD if stopped else ""),
        "state/progress": progress,
        "state/note": lines(note, tone=QUIET) if note else None,
    }


def _results(view: SessionView) -> Parts:
    parts: Parts = {}
    if (fit := view.estimated) is not None:
        found = [(label, *rounded_estimate(fit, factor, name)) for label, factor, name, _ in ESTIMATES]
        estimates = [(label, f"{', '.join(values)} ± {sigma}") for label, values, sigma in found if sigma]
        parts["table/estimates"] = text_table(estimates, ("estimate", "± 1 sigma")) if estimates else None
        parts["table/words"] = lines(in_words(fit).strip())
    rows = []
    for one in view.compared.values():
        rows.append((f"R{one.number:02d}", *differences(one)))
        parts["table/words"] = lines(in_words(one).strip())
    return parts | ({"table/compared": text_table(rows, ("", "N off", "N·m off", "sigmas"))} if rows else {})


def _gravity_sphere(downs: Sequence[tuple[Array, float | None]], above_m: Array | None) -> Parts:
    if not downs:
        return {}
    colours = [
        scene.UNKNOWN if sigmas is None else next((colour for most, colour, _ in _COLOURS if sigmas <= most), BAD)
        for _, sigmas in downs
    ]
    at_m, parts = (np.zeros(3), _ALONE) if above_m is None else (above_m, {})
    return parts | {
        "scene/gravity": scene.ball(_SPHERE_M, scene.UNKNOWN, at=at_m, alpha=0.3),
        "scene/gravity/axes": scene.axes(1.3 * _SPHERE_M, at_m, named=True),
        "scene/gravity/name": scene.label("gravity in flange axes", at_m + np.array([0, 0, 1.6 * _SPHERE_M])),
        "scene/gravity/poses": scene.dots(_SPHERE_M * np.array([down for down, _ in downs]), colours, at_m),
    }


def conclude(
    page: Page, head: str, *words: str, tone: str = "", figures: Sequence[Part] = (), following: Sequence[str] = ()
) -> None:
    """Show on a page how a session ended; `figures` are made by `reading`, `following` are commands to type next."""
    page.put(
        {
            "result": lines(head=head, tone=tone),
            "result/figures": readings(*figures) if figures else None,
            "result/words": lines(*map(as_typed, words)),
            "result/next": lines(*map(as_typed, following), head="Next") if following else None,
            **dict.fromkeys(("table/estimates", "table/words")),
        }
    )
