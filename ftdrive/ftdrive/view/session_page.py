"""The page of a session: arm, plan and poses in the scene; state, question and estimates beside it; Stop."""

import logging
import threading
import time
from collections.abc import Iterable
from contextlib import suppress
from html import escape
from typing import Any, Final, Self

import numpy as np

from ftcalib.model import Array
from ftcalib.rounding import with_sigma
from ftdrive.errors import Declined
from ftdrive.planning.geometry.certify import Certifier
from ftdrive.session.events import (
    Compared,
    Estimated,
    Event,
    GuardTripped,
    Key,
    Noted,
    Operator,
    Planned,
    PoseTaken,
    Question,
    State,
)
from ftdrive.session.guards import Guard, RangeGuard, Seen
from ftdrive.terminal.screen import ESTIMATES, SessionView, progress_in_words, rounded_estimate, state_lines
from ftdrive.terminal.session_text import in_words, sigmas_of
from ftdrive.view.page import Page
from ftdrive.view.plan_page import describe, draw_plan, path
from ftdrive.view.scene import BAD, DrawnArm, size_of

log = logging.getLogger(__name__)

_FRAME_S: Final = 0.05
# Guards that have not looked for so long rest.
_REST_S: Final = 0.5
# Colour of a pose by the largest residual that still has it, in sigmas.
_COLOURS: Final = ((3.0, (40, 160, 70), "≤ 3"), (5.0, (230, 150, 20), "≤ 5"), (np.inf, BAD, "more"))
_UNKNOWN: Final = (120, 120, 130)
_BALL_M: Final = 0.18
# In these states the stop is not reached yet.
_TOWARDS: Final = frozenset({State.APPROACH, State.MOVE})
_ALERT: Final = "color:#e03131"
_QUESTION: Final = "border-left:4px solid #3c82e6;padding-left:.6em"


class Onlooker(Guard):
    """Keeps the newest look of the guards; it never trips."""

    def __init__(self) -> None:
        self.seen: Seen | None = None
        self.fresh_s = self.looked_s = 0.0
        """When the newest sample was first seen, by `Seen.t_s`; the last look, by the computer's clock."""

    def look(self, seen: Seen) -> None:
        """Keep it."""
        if self.seen is None or seen.sample != self.seen.sample:
            self.fresh_s = seen.t_s
        self.seen, self.looked_s = seen, time.monotonic()


class SessionPage:
    """An operator that shows the session of another one on a page, where any viewer may stop it.

    Questions are answered by the other operator. A thread draws the newest state while the page is open in a browser,
    so that no browser delays the session.
    """

    def __init__(self, page: Page, operator: Operator, command: str) -> None:
        self._page, self._operator = page, operator
        self._lock = threading.Lock()
        self._view = SessionView(command)
        self._question: Question | None = None
        self._stopped_by = self._note = ""
        self._downs: dict[int, tuple[Array, float | None]] = {}
        self._plan: Planned | None = None
        self._cell: tuple[Certifier, RangeGuard] | None = None
        self._onlooker = Onlooker()
        self._ended = threading.Event()
        self._drawer = threading.Thread(target=self._run, name="page", daemon=True)
        page.add_stop(self.stop)
        self._texts = {part: page.gui.add_html("") for part in ("state", "alert", "question")}
        self._slider: Any = page.gui.add_slider("along the plan", min=0, max=1, step=1, initial_value=0, visible=False)
        self._texts |= {part: page.gui.add_html("") for part in ("guards", "results", "key")}
        self._scene: _Cell | None = None
        self._poses: Any = None
        page.look(np.zeros(3), np.array([0.4, 0.4, 0.25]))

    def __enter__(self) -> Self:
        self._drawer.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._drawer.join(timeout=2.0)

    def stop(self, viewer: str) -> None:
        """Stop the session in the name of a viewer, as the key q does; for good, so only the first one counts."""
        self._stopped_by = self._stopped_by or viewer

    def watch(self, certifier: Certifier, load: RangeGuard) -> Onlooker:
        """Draw this cell from now on, as the result sees it among the guards. See `SessionOptions.watch`."""
        self._cell = certifier, load
        return self._onlooker

    def show(self, event: Event) -> None:
        """Keep what the page draws, and show the event."""
        with self._lock:
            self._view.update(event, time.monotonic())
            match event:
                case Planned():
                    self._plan = event
                case Noted():
                    self._note = event.words
                case PoseTaken():
                    self._note = ""
                    self._downs[event.stop] = event.gravity_flange, None
                case Estimated() if self._view.last is not None:
                    stop = self._view.last.stop
                    self._downs[stop] = self._downs[stop][0], event.residual_sigma
                case Compared() if event.stop in self._downs:
                    self._downs[event.stop] = self._downs[event.stop][0], sigmas_of(event)
        self._operator.show(event)

    def ask(self, question: Question) -> str:
        """Ask in the terminal; raises `Declined` too if a viewer has stopped the session."""
        self._require_unstopped()
        self._question, self._view.keys = question, "asking"
        try:
            answer = self._operator.ask(question)
        finally:
            self._question, self._view.keys = None, "live"
        self._require_unstopped()
        return answer

    def absence(self) -> str | None:
        """As `Operator.absence`: the viewers of the page do not count."""
        return self._operator.absence()

    @property
    def has_keys(self) -> bool:
        """Whether the terminal has keys."""
        return self._operator.has_keys

    def pressed(self) -> Key | None:
        """Return `Key.STOP` from when a viewer has pressed Stop, else the key of the terminal."""
        return Key.STOP if self._stopped_by else self._operator.pressed()

    @property
    def pressed_by(self) -> str:
        """Who pressed it."""
        return self._stopped_by or self._operator.pressed_by

    def _require_unstopped(self) -> None:
        if self._stopped_by:
            raise Declined(f"stopped by {self._stopped_by}")

    def _run(self) -> None:
        ended = False
        try:
            while not ended:
                ended = self._ended.wait(_FRAME_S)
                if self._page.viewers or (self._scene is None and self._cell is not None):
                    self.draw()
        # Only a picture: the session goes on.
        except Exception:
            log.exception("the page cannot be drawn")
            with suppress(Exception):
                self._texts["alert"].content = _paragraph("This page has failed and shows old values.", _ALERT)

    def draw(self) -> None:
        """Show browsers the newest state."""
        plan, cell, question, seen = self._plan, self._cell, self._question, self._onlooker.seen
        if plan is not None and cell is not None and self._scene is None:
            self._scene = _Cell(self._page, plan, cell[0])
            self._slider.max = len(self._scene.path_rad) - 1
        with self._lock:
            downs, now = dict(self._downs), self._view.now
            texts = self._texts_now(question, seen)
        with self._page.at_once():
            for part, text in texts.items():
                if self._texts[part].content != text:
                    self._texts[part].content = text
            if self._scene is not None:
                stop = goes_on_to = None if now is None else now.stop
                if now is not None and stop is not None and now.state not in _TOWARDS:
                    goes_on_to = stop + 1
                if self._slider.visible != (question is not None):
                    self._slider.value = self._scene.index_of(stop)
                    self._slider.visible = question is not None
                self._scene.show(seen, goes_on_to, int(self._slider.value) if question is not None else None)
            self._draw_downs(downs)

    def _draw_downs(self, downs: dict[int, tuple[Array, float | None]]) -> None:
        """Draw the directions of gravity so far on a sphere, above the arm where there is one."""
        if not downs:
            return
        points_m = _BALL_M * np.array([down for down, _ in downs.values()], dtype=np.float32)
        colours = np.array([_colour(sigmas) for _, sigmas in downs.values()], dtype=np.uint8)
        if self._poses is None:
            centre_m, scene = np.zeros(3) if self._scene is None else self._scene.ball_m, self._page.scene
            scene.add_icosphere("/gravity", _BALL_M, _UNKNOWN, wireframe=True, opacity=0.3, position=centre_m)
            scene.add_frame("/gravity/flange", axes_length=1.3 * _BALL_M, axes_radius=0.004)
            scene.add_label("/gravity/name", "gravity in flange axes", position=(0.0, 0.0, 1.5 * _BALL_M))
            self._poses = scene.add_point_cloud(
                "/gravity/poses", points_m, colours, point_size=0.03, point_shape="circle", precision="float32"
            )
        elif not (np.array_equal(points_m, self._poses.points) and np.array_equal(colours, self._poses.colors)):
            self._poses.points, self._poses.colors = points_m, colours

    def _texts_now(self, question: Question | None, seen: Seen | None) -> dict[str, str]:
        view, now_s = self._view, time.monotonic()
        (state,) = state_lines(view, now_s, 10_000)
        lines = [f"<b>{escape(state.plain)}</b>", progress_in_words(view, now_s)]
        texts = {"state": _paragraph("<br>".join(lines)), "alert": self._alert(), "question": ""}
        if question is not None:
            place, words = "", f"Waits in the terminal: <b>{escape(question.text)}</b>"
            if self._scene is not None:
                move = int(self._scene.moves[int(self._slider.value)])
                shown = describe(self._scene.plan, move).replace("**", "").split("\n\n")[:2]
                place = _paragraph("<br>".join(map(escape, shown)))
            texts["question"] = _paragraph(words, _QUESTION) + place
        texts["guards"] = "" if seen is None else self._guard_values(seen)
        texts["results"] = self._results()
        key = (*_COLOURS, (0.0, _UNKNOWN, "no fit"))
        dots = " ".join(f'<span style="color:rgb{colour}">●</span> {words}' for _, colour, words in key)
        texts["key"] = _paragraph(f"Poses, residual in sigmas: {dots}") if self._downs else ""
        return texts

    def _alert(self) -> str:
        view, lines = self._view, []
        is_stopped = view.now is not None and view.now.state in {State.STOP, State.HOLD}
        if self._stopped_by:
            lines.append(f"Stop was pressed by {self._stopped_by}.")
        elif is_stopped and not view.tripped:
            lines.append(view.now.words if view.now else "")
        if view.note is not None:
            lines.append(in_words(view.note))
        is_red = bool(lines) and (is_stopped or bool(self._stopped_by) or isinstance(view.note, GuardTripped))
        return "".join(_paragraph(escape(line), _ALERT if is_red else "") for line in lines or [self._note] if line)

    def _guard_values(self, seen: Seen) -> str:
        if time.monotonic() - self._onlooker.looked_s > _REST_S:
            return _paragraph("The guards rest: the arm is drawn where they saw it last.")
        rows = [
            ["joint speed", f"{np.degrees(np.abs(seen.state.qd_rad_s).max()):.0f} °/s"],
            ["age of the sample", f"{1e3 * (seen.t_s - self._onlooker.fresh_s):.0f} ms"],
        ]
        if self._cell is not None and (load := self._cell[1]).range is not None:
            share = float((np.abs(seen.wrench - load.zero) / load.range).max())
            rows.append(["of the sensor's range", f"{100 * share:.0f} %"])
        return _table(rows)

    def _results(self) -> str:
        view = self._view
        if view.compared:
            table = [["", "N off", "N·m off", "sigmas"]]
            for one in view.compared.values():
                force, torque = (
                    with_sigma(np.linalg.norm(one.residual[part]), float(np.linalg.norm(one.sigma[part])))
                    for part in (slice(3), slice(3, 6))
                )
                table.append([f"R{one.number:02d}", force, torque, f"{sigmas_of(one):.1f}"])
            return _table(table) + _paragraph(escape(in_words(one).strip()))
        if (fit := view.estimated) is None:
            return ""
        found = [(label, *rounded_estimate(fit, factor, name)) for label, factor, name, _ in ESTIMATES]
        rows = [[label, "<br>".join(values), f"± {sigma}"] for label, values, sigma in found if sigma]
        return _table(rows) + _paragraph(escape(in_words(fit).strip()))


class _Cell:
    """The arm, its next pose as a ghost, and the plan, in the scene of a page."""

    def __init__(self, page: Page, planned: Planned, certifier: Certifier) -> None:
        self.plan = planned.plan
        self.path_rad, self.moves = path(planned.plan, planned.way_rad)
        self._arm = draw_plan(page, planned.plan, certifier, self.path_rad)
        self._ghost = DrawnArm(page.scene, certifier.arm, "/ghost", ghost=True)
        self._drawn: dict[DrawnArm, Array | None] = {self._arm: self.path_rad[0], self._ghost: None}
        self._ghost.hide()
        wrist_m = certifier.arm.frames(self.path_rad[:1]).wrist_m[0]
        self.ball_m = wrist_m + np.array([0.0, 0.0, 0.25 * size_of(certifier)])

    def index_of(self, stop: int | None) -> int:
        """Return where the path is at a stop, from 1; at the first where there is none."""
        return int(np.flatnonzero(self.moves == ((stop or 1) - 1) % len(self.plan.steps))[0])

    def show(self, seen: Seen | None, following: int | None, chosen: int | None) -> None:
        """Draw the arm where it was seen; as a ghost its goal, the following stop, or a chosen place of the path."""
        if seen is not None:
            self._move(self._arm, seen.state.q_rad)
        self._move(self._ghost, self._goal_rad(seen, following) if chosen is None else self.path_rad[chosen])

    def _goal_rad(self, seen: Seen | None, following: int | None) -> Array | None:
        if seen is not None and seen.motion.moving:
            return seen.motion.goal_rad
        nodes = self.plan.nodes_rad
        return None if following is None or following > len(nodes) + 1 else nodes[(following - 1) % len(nodes)]

    def _move(self, arm: DrawnArm, q_rad: Array | None) -> None:
        before = self._drawn[arm]
        if q_rad is None:
            if before is not None:
                arm.hide()
        elif before is None or not np.allclose(q_rad, before, rtol=0, atol=1e-4):
            arm.show(q_rad)
        else:
            return
        self._drawn[arm] = q_rad


def _colour(sigmas: float | None) -> tuple[int, int, int]:
    return _UNKNOWN if sigmas is None else next((colour for most, colour, _ in _COLOURS if sigmas <= most), BAD)


def _paragraph(html: str, style: str = "") -> str:
    return f'<p style="margin:.4em .75em;overflow-wrap:anywhere;{style}">{html}</p>'


def _table(rows: Iterable[Iterable[str]]) -> str:
    cell = '<td style="padding:0 .75em 0 0;vertical-align:top">'
    body = "".join(f"<tr>{''.join(f'{cell}{words}</td>' for words in row)}</tr>" for row in rows)
    return f'<table style="margin:.4em .75em;font-variant-numeric:tabular-nums">{body}</table>'
