"""The page of a session as an operator: what it passes on, who stops, what it shows, and how it ends."""

import json
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from syrupy.assertion import SnapshotAssertion

from ftdrive.errors import Declined
from ftdrive.planning import sweep_planner
from ftdrive.planning.geometry.certify import Certifier
from ftdrive.planning.plan import Plan
from ftdrive.planning.planner import certifier_for
from ftdrive.runs.source import Outcome
from ftdrive.runs.verification import verify_run
from ftdrive.session import session
from ftdrive.session.events import (
    Compared,
    Estimated,
    Event,
    GuardTripped,
    Key,
    Noted,
    PoseTaken,
    Question,
    State,
    StateChanged,
)
from ftdrive.session.guards import ExpectedMotion, Limits, RangeGuard, Seen
from ftdrive.session.open_session import SessionOptions
from ftdrive.session.session import Calibrating
from ftdrive.session.verifying import Verifying
from ftdrive.view import session_page
from ftdrive.view.outcome import conclude_verification, on_page
from ftdrive.view.page import Page
from ftdrive.view.scene import arm_parts
from ftdrive.view.session_page import Onlooker, SessionPage
from ftdrive.words.text import as_typed
from ftdrivers.errors import DeviceFault
from ftdrivers.interfaces import ArmState
from tests.unit.ftdrive.fake_cell import MODEL, STATUS, Lab, Scripted
from tests.wire.waiting import wait_until


class Watched(SessionPage):
    onlooker = Onlooker()

    def __init__(self, page: Page, operator: Scripted, command: str = "calibrate") -> None:
        super().__init__(page, operator, command)
        self.page = page

    def watch(self, certifier: Certifier, load: RangeGuard) -> Onlooker:
        self.onlooker = super().watch(certifier, load)
        return self.onlooker

    def shown(self) -> dict[str, Any]:
        self.draw()
        return parts_of(self.page)


@pytest.fixture
def page() -> Page:
    return Page("test")


@pytest.fixture
def watched(page: Page) -> Watched:
    return Watched(page, Scripted())


def pose(stop: int, down: tuple[float, float, float]) -> PoseTaken:
    return PoseTaken(
        stop=stop,
        stops=7,
        number=stop,
        gravity_flange=np.array(down),
        mean=np.zeros(6),
        sigma=np.full(6, 0.01),
        samples=100,
        settle_s=0.5,
        average_s=1.0,
        attempts=1,
        steady=True,
    )


def estimated(sigmas: float | None, **values: float) -> Estimated:
    return Estimated(
        poses=5,
        values=values,
        sigma=dict.fromkeys(values, 0.00213),
        residual_sigma=sigmas,
        residual_force_N=0.1,
        faces=(1, 1, 1, 1, 1, 0),
        cond9=1.5,
        cond_u1=1.5,
        empty_cap_deg=60.0,
        light="amber",
        hint="",
    )


def seen(wrench: list[float], t_s: float = 1.0, sample: int = 1) -> Seen:
    """A look of the guards at an arm whose last joint turns at 30 degrees a second."""
    q = np.zeros(6)
    state = ArmState(0, 0.0, q, np.radians([0, 0, 0, 0, 0, -30.0]), np.eye(3), np.zeros(3))
    return Seen(t_s, 0.01, ExpectedMotion(q, q, moving=False), state, STATUS, np.array(wrench), sample, 0.0)


def parts_of(page: Page) -> dict[str, Any]:
    parts = json.loads(page.since(0)[1])
    return {name: part for name, part in parts.items() if part is not None}


def texts(part: dict[str, Any] | None) -> str:
    return "" if part is None else "\n".join([part["head"], *part["lines"]])


def panels(parts: dict[str, Any]) -> str:
    kept = {name: part for name, part in parts.items() if not name.startswith(("scene", "stop", "title"))}
    return "\n".join(f"{name}: {json.dumps(part, ensure_ascii=False)}" for name, part in kept.items())


def run_with(lab: Lab, watched: Watched) -> None:
    chosen = SessionOptions(lab.folder / "runs", poses=6, watch=watched.watch)
    session.take_poses(Calibrating(lab.cell, chosen), watched, chosen)


def places(parts: dict[str, Any], name: str = "arm") -> list[list[float]]:
    return [parts[f"scene/{name}/{i}"]["at"] for i in range(len(MODEL.names))]


def places_at(q_rad: np.ndarray) -> list[list[float]]:
    parts = arm_parts(MODEL, q_rad)
    return [part["at"] for part in parts.values() if part is not None and part["kind"] == "body"]


def test_a_stop_in_mid_move_ends_the_session_in_the_name_of_the_viewer(lab: Lab, page: Page) -> None:
    lab.operator.has_keys = False
    watched = Watched(page, lab.operator)
    alerts: list[str] = []

    def press() -> None:
        page.act("viewer 2", "stop", None)
        page.act("viewer 3", "stop", None)
        alerts.append(texts(watched.shown()["alert"]))

    lab.arm.at_move[4] = press
    with pytest.raises(Declined, match="stopped by viewer 2"):
        run_with(lab, watched)
    assert len(lab.arm.moves) == 4
    stopped = [event.words for event in lab.operator.of(StateChanged) if event.state is State.STOP]
    assert stopped == ["stopped by viewer 2"]
    assert "stopped by viewer 2" in (lab.run().folder / "events.ndjson").read_text()
    assert "Stop was pressed by viewer 2" in alerts[0]
    assert watched.shown()["state"] == {"kind": "lines", "head": "STOP  0 s", "lines": stopped, "tone": "bad"}


@pytest.mark.parametrize("words", ["Is the tool free", "Type MOVE"])
def test_nothing_moves_after_a_stop_at_a_question(words: str, lab: Lab, page: Page) -> None:
    watched = Watched(page, lab.operator)
    lab.operator.at_question = [(words, lambda: watched.stop("viewer 1"))]
    with pytest.raises(Declined, match="stopped by viewer 1"):
        run_with(lab, watched)
    assert lab.arm.moves == []
    assert words in lab.operator.asked[-1].text
    for folder in (lab.folder / "runs").glob("*"):
        assert "stopped by viewer 1" in (folder / "events.ndjson").read_text()


def test_the_rest_is_that_of_the_terminal(page: Page) -> None:
    terminal = Scripted(keys=[Key.SKIP], gone="the terminal was closed")
    watched = Watched(page, terminal)
    assert watched.has_keys
    assert watched.absence() == "the terminal was closed"
    assert watched.pressed() is Key.SKIP
    assert watched.pressed_by == "the operator"
    assert watched.pressed() is None
    waiting: list[str] = []
    terminal.at_question = [("<Go>", lambda: waiting.append(texts(watched.shown()["question"])))]
    assert watched.ask(Question("<Go> on?")) == "yes"
    assert waiting == ["Answer in the terminal\n<Go> on?"]
    assert "question" not in watched.shown()
    watched.show(note := Noted(words="a note"))
    assert terminal.shown == [note]
    assert texts(watched.shown()["state/note"]).strip() == "a note"


@pytest.mark.slow
def test_the_arm_and_its_next_pose_are_drawn(lab: Lab, page: Page) -> None:
    watched = Watched(page, lab.operator)
    at: list[dict[str, Any]] = []
    following: list[list[list[float]] | None] = []

    def look(event: object) -> None:
        parts = watched.shown()
        if watched.onlooker.seen is not None and lab.operator.states()[-1] is State.MOVE:
            at.append(parts)
        if isinstance(event, StateChanged) and event.state is State.SAMPLE:
            following.append(places(parts, "ghost") if "scene/ghost/0" in parts else None)

    lab.operator.on_event = look
    with watched:
        run_with(lab, watched)
    nodes = Plan.load(lab.run().plan_path).nodes_rad
    assert len(at) == 6
    for k, parts in enumerate(at):
        np.testing.assert_allclose(places(parts), places_at(nodes[k]), atol=1e-2)
        np.testing.assert_allclose(places(parts, "ghost"), places_at(nodes[(k + 1) % 6]), atol=1e-4)
        assert parts["state"]["head"].startswith(f"pose {k + 2}/7 R")
        progress = parts["state/progress"]["rows"][0]
        assert progress["share"] == pytest.approx((k + 1) / 7, abs=1e-3)
        assert progress["text"].startswith(f"{k + 1} kept")
        assert parts["scene/path"]["kind"] == "path"
        assert parts["scene/ball"]["alpha"] < 1
    assert following.pop() is None  # the return to the first pose is the last stop
    for k, ghost in enumerate(following):
        np.testing.assert_allclose(np.array(ghost), places_at(nodes[(k + 1) % 6]), atol=1e-4)
    ended = parts_of(page)
    np.testing.assert_allclose(places(ended), places_at(nodes[0]), atol=1e-2)
    assert not [name for name in ended if name.startswith("scene/ghost")]


@pytest.mark.parametrize(
    ("range_N", "zero", "wrench"),
    [(100.0, 0.0, [25.0, -49.0, 0.0, 0.0, 0.0, 1.0]), (100.0, 20.0, [45.0] + [20.0] * 5), (None, 0.0, [45.0] * 6)],
    ids=["range", "zero", "no-range"],
)
def test_force_and_torque_are_shown_with_the_limits_of_their_guard(
    range_N: float | None, zero: float, wrench: list[float], watched: Watched, lab: Lab, snapshot: SnapshotAssertion
) -> None:
    measures = None if range_N is None else np.repeat([range_N, range_N / 10], 3)
    load = RangeGuard(Limits(saturation=0.5), measures, np.full(6, zero))
    onlooker = watched.watch(certifier_for(lab.cell, "ur5e"), load)
    for t_s in (1.0, 1.02):
        onlooker.look(seen(wrench, t_s))
    assert panels(watched.shown()) == snapshot
    onlooker.looked_s -= 1
    parts = watched.shown()
    assert "The guards are inactive" in texts(parts["bars"])
    assert "bars/guards" not in parts


R07 = Compared(
    stop=2, number=7, residual=np.array([0.3, 0, 0, 0, 0.02, 0]), sigma=np.full(6, 0.1), poses=4, light="green"
)


@pytest.mark.parametrize(
    ("command", "events"),
    [
        ("calibrate", [pose(1, (0.0, 0.0, 1.0)), estimated(1.0, mass_kg=1.2345678, p_sensor_com_m=0.0512345)]),
        ("verify", [R07]),
        ("calibrate", [pose(1, (0.0, 0.0, 1.0)), GuardTripped(hazard=14, words="contact of 9 N")]),
    ],
    ids=["hand-guided", "verify", "trip"],
)
def test_what_the_panels_show(command: str, events: list[Event], page: Page, snapshot: SnapshotAssertion) -> None:
    watched = Watched(page, Scripted(), command)
    for event in events:
        watched.show(event)
    parts = watched.shown()
    assert panels(parts) == snapshot
    assert not [name for name in parts if name.startswith(("scene/arm", "bars"))]
    watched.show(pose(2, (0.0, 0.0, 1.0)))
    assert "alert" not in watched.shown()


def test_a_sweep_is_one_motion(lab: Lab, page: Page, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sweep_planner, "RANDOM", 2)
    monkeypatch.setattr(sweep_planner, "CHANGED", 0)
    watched = Watched(page, lab.operator)
    looks: list[dict[str, Any]] = []
    lab.operator.at_question = [("Type MOVE", lambda: looks.append(watched.shown()))]

    def look(event: object) -> None:
        if isinstance(event, StateChanged) and event.state is State.SWEEP:
            watched.stop("viewer 0")

    lab.operator.on_event = look
    chosen = SessionOptions(lab.folder / "runs", mode="sweep", seconds=10.0, watch=watched.watch)
    with pytest.raises(Declined, match="stopped by viewer 0"):
        session.take_poses(Calibrating(lab.cell, chosen), watched, chosen)
    along = looks[0]["question/along"]
    assert "Sweep of 10 s" in along["note"]
    assert along["controls"][0]["text"] == f"{along['controls'][0]['value']:.0f} of {along['controls'][0]['max']:.0f} s"
    assert len(looks[0]["scene/path"]["points"]) > 100
    assert lab.operator.states()[-1] is State.STOP


def is_failure(event: object) -> bool:
    return isinstance(event, Noted) and "cannot be updated" in event.words


@pytest.mark.slow
def test_a_page_that_hangs_is_reported_and_not_waited_for(page: Page, monkeypatch: pytest.MonkeyPatch) -> None:
    released = threading.Event()

    def hang(_: SessionPage) -> None:
        released.wait()

    monkeypatch.setattr(SessionPage, "draw", hang)
    monkeypatch.setattr(session_page, "HUNG_S", 0.2)
    page.viewers = 1
    terminal = Scripted()
    watched = Watched(page, terminal)
    try:
        with watched:
            assert watched.pressed() is None
            assert terminal.shown == []
            wait_until(lambda: page.stale_s > 0.2)
            watched.ask(Question("Go on?"))
            page.act("viewer 1", "stop", None)
            assert watched.pressed() is Key.STOP
            began_s = time.monotonic()
        assert time.monotonic() - began_s < 3
    finally:
        released.set()
    assert len(terminal.shown) == 1
    assert is_failure(terminal.shown[0])
    assert parts_of(page)["state"]["head"] == "ended"
    assert page.stale_s == 0


def end(lab: Lab, page: Page) -> dict[str, Any]:
    options = SessionOptions(lab.folder / "runs", poses=6)
    with on_page(page, lab.operator, options) as (shown, options):
        session.take_poses(Calibrating(lab.cell, options), shown, options)
    return parts_of(page)


@pytest.mark.slow
def test_at_the_end_nothing_looks_live(lab: Lab, page: Page) -> None:
    parts = end(lab, page)
    assert parts["state"]["head"] == "ended"
    gone = ("stop", "alert", "question", "question/along", "bars", "bars/guards", "state/progress", "state/note")
    assert not set(gone) & set(parts)
    assert "result" not in parts  # it is not known yet
    assert parts["scene/gravity/poses"]["points"]
    with pytest.raises(ValueError, match="does not have this control now"):
        page.act("viewer 0", "stop", None)


def stopped_by(lab: Lab, page: Page) -> None:
    lab.arm.at_move[3] = lambda: page.act("viewer 2", "stop", None)


def broken(lab: Lab, _: Page) -> None:
    lab.arm.at_move[3] = lambda: lab.arm.set_status(fault=DeviceFault("protective stop", "unlock it"))


@pytest.mark.parametrize(
    ("happens", "head", "words"),
    [
        (stopped_by, "Stopped by viewer 2", ""),
        (broken, "Error", "the arm stopped: protective stop"),
    ],
)
def test_an_early_end_is_shown_as_the_terminal_says_it(
    lab: Lab, page: Page, happens: Callable[[Lab, Page], None], head: str, words: str
) -> None:
    happens(lab, page)
    with pytest.raises((Declined, KeyboardInterrupt, DeviceFault)):
        end(lab, page)
    parts = parts_of(page)
    assert (parts["result"]["head"], parts["result"]["tone"]) == (head, "bad")
    lines = parts["result/words"]["lines"]
    assert words in lines[0]
    kept = as_typed(lab.operator.of(Noted)[-1].words).split("\n")
    assert "2 poses saved in" in kept[0]
    assert lines[-len(kept) :] == kept
    assert "--resume" in "".join(kept)
    assert parts["state"]["head"] == "ended"
    assert not set(parts) & {"stop", "alert", "question", "bars"}


@pytest.mark.slow
def test_a_verification_ends_with_its_verdict(lab: Lab, page: Page) -> None:
    outcome = lab.calibrate()
    assert isinstance(outcome, Outcome)
    result, path, runs = outcome.result, outcome.run.calibration_path, lab.folder / "runs"
    about = {"verification": {"id": result.id, "path": str(path), "poses": 2}}
    options = SessionOptions(runs, "verify", poses=2, description=about)
    run = session.take_poses(Verifying(lab.cell, result, path, 2, runs), lab.operator, options)
    assert run is not None
    conclude_verification(page, verified := verify_run(run, result, path, (1e-6, None)))
    parts = parts_of(page)
    assert (parts["result"]["head"], parts["result"]["tone"]) == ("FAILED", "bad")
    assert [row["unit"] for row in parts["result/figures"]["rows"]] == ["N", "N·m"]
    assert float(parts["result/figures"]["rows"][0]["value"]) == pytest.approx(verified.force_N.max(), rel=0.1)
