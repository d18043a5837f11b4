"""The page of a session as an operator: what it passes on, who stops, what it shows, and how it ends."""

import json
import logging
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ftdrive.commands import calibrate, verify
from ftdrive.errors import Declined
from ftdrive.planning.plan import Plan
from ftdrive.planning.planner import certifier_for
from ftdrive.runs.source import Outcome
from ftdrive.runs.verification import verify_run
from ftdrive.session import session
from ftdrive.session.events import (
    Compared,
    Estimated,
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
from ftdrive.view.outcome import on_page
from ftdrive.view.page import Page
from ftdrive.view.scene import arm_parts
from ftdrive.view.session_page import SessionPage
from ftdrive.words.text import as_typed
from ftdrivers.errors import DeviceFault
from ftdrivers.interfaces import ArmState
from tests.unit.ftdrive.fake_cell import MODEL, STATUS, Lab, Scripted
from tests.wire.waiting import wait_until

LONG_S = 30.0
"""What takes so long never happens."""


@pytest.fixture
def page() -> Page:
    return Page("test")


@pytest.fixture
def watched(page: Page) -> SessionPage:
    return SessionPage(page, Scripted(), "calibrate")


@pytest.fixture
def lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Lab:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    return Lab(tmp_path, monkeypatch)


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
    """Return the parts that browsers show."""
    parts = json.loads(page.since(0)[1])
    return {name: part for name, part in parts.items() if part is not None}


def shown(watched: SessionPage) -> dict[str, Any]:
    watched.draw()
    return parts_of(watched._page)


def texts(part: dict[str, Any] | None) -> str:
    """Return the texts of a part."""
    return "" if part is None else "\n".join([part["head"], *part["lines"]])


def run_with(lab: Lab, watched: SessionPage) -> None:
    chosen = lab._options(watch=watched.watch)
    session.take_poses(Calibrating(lab.cell, chosen), watched, chosen)


def places(parts: dict[str, Any], name: str = "arm") -> list[list[float]]:
    """Return where the bodies of an arm are."""
    return [parts[f"scene/{name}/{i}"]["at"] for i in range(len(MODEL.names))]


def places_at(q_rad: np.ndarray) -> list[list[float]]:
    parts = arm_parts(MODEL, q_rad)
    return [part["at"] for part in parts.values() if part is not None and part["kind"] == "body"]


def test_a_stop_in_mid_move_ends_the_session_in_the_name_of_the_viewer(lab: Lab, page: Page) -> None:
    lab.operator.has_keys = False
    watched = SessionPage(page, lab.operator, "calibrate")
    alerts: list[str] = []

    def press() -> None:
        page.act("viewer 2", "stop", None)
        page.act("viewer 3", "stop", None)
        alerts.append(texts(shown(watched)["alert"]))

    lab.arm.at_move[4] = press
    with pytest.raises(Declined, match="stopped by viewer 2"):
        run_with(lab, watched)
    assert len(lab.arm.moves) == 4
    stopped = [event.words for event in lab.operator.of(StateChanged) if event.state is State.STOP]
    assert stopped == ["stopped by viewer 2"]
    assert "stopped by viewer 2" in (lab.run().folder / "events.ndjson").read_text()
    assert "Stop was pressed by viewer 2" in alerts[0]
    assert shown(watched)["state"] == {"kind": "lines", "head": "STOP  0 s", "lines": stopped, "tone": "bad"}


@pytest.mark.parametrize("words", ["Is the tool free", "Type MOVE"])
def test_nothing_moves_after_a_stop_at_a_question(words: str, lab: Lab, page: Page) -> None:
    watched = SessionPage(page, lab.operator, "calibrate")
    lab.operator.at_question = [(words, lambda: watched.stop("viewer 1"))]
    with pytest.raises(Declined, match="stopped by viewer 1"):
        run_with(lab, watched)
    assert lab.arm.moves == []
    assert words in lab.operator.asked[-1].text
    for folder in (lab.folder / "runs").glob("*"):
        assert "stopped by viewer 1" in (folder / "events.ndjson").read_text()


def test_the_rest_is_that_of_the_terminal(page: Page) -> None:
    terminal = Scripted(keys=[Key.SKIP], gone="the terminal was closed")
    watched = SessionPage(page, terminal, "calibrate")
    assert watched.has_keys
    assert watched.absence() == "the terminal was closed"
    assert watched.pressed() is Key.SKIP
    assert watched.pressed_by == "the operator"
    assert watched.pressed() is None
    assert watched.ask(Question("Go on?")) == "yes"
    watched.show(note := Noted(words="a note"))
    assert terminal.shown == [note]
    assert texts(shown(watched)["state/note"]).strip() == "a note"


def test_a_question_is_shown_while_it_waits(page: Page) -> None:
    terminal = Scripted()
    watched = SessionPage(page, terminal, "calibrate")
    waiting: list[str] = []
    terminal.at_question = [("<Go>", lambda: waiting.append(texts(shown(watched)["question"])))]
    watched.ask(Question("<Go> on?"))
    assert waiting == ["Answer in the terminal\n<Go> on?"]
    assert "question" not in shown(watched)


def test_while_a_question_waits_a_slider_shows_the_plan(lab: Lab, page: Page) -> None:
    watched = SessionPage(page, lab.operator, "calibrate")
    looks: list[dict[str, Any]] = []

    def choose() -> None:
        for value in (None, 0.0):
            if value is not None:
                page.act("viewer 0", "along", value)
            looks.append(shown(watched))

    lab.operator.at_question = [("Is the tool free", choose)]
    run_with(lab, watched)
    first, chosen = looks
    plan = Plan.load(lab.run().plan_path)
    (slider,) = first["question/along"]["controls"]
    approach_s = slider["value"]
    assert approach_s > 0
    assert slider["text"].startswith(f"pose 1 of 6, {approach_s:.0f} of ")
    assert slider["max"] == pytest.approx(approach_s + plan.motion_time_s, abs=0.11)
    np.testing.assert_allclose(places(first, "ghost"), places_at(plan.nodes_rad[0]), atol=1e-4)
    assert first["question/along"]["note"].startswith("Move 1 of 6, ")
    assert chosen["question/along"]["controls"][0]["text"].startswith("approach, 0 of ")
    np.testing.assert_allclose(places(chosen, "ghost"), places(chosen), atol=1e-4)
    assert "question/along" not in shown(watched)
    with pytest.raises(ValueError, match="does not have this control now"):
        page.act("viewer 0", "along", 0.0)


def test_a_question_of_a_hold_shows_the_plan_where_the_arm_was(lab: Lab, page: Page) -> None:
    watched = SessionPage(page, lab.operator, "calibrate")
    asked: list[str] = []
    lab.operator.at_question = [
        ("resume: ", lambda: asked.append(shown(watched)["question/along"]["controls"][0]["text"]))
    ]
    lab.push_on_the_way(4)
    lab.arm.at_move[4] = lambda: lab.operator.keys.append(Key.PAUSE)
    with pytest.raises(Declined, match="paused by the operator"):
        run_with(lab, watched)
    assert asked[0].startswith("pose 4 of 6, ")


def test_the_arm_and_its_next_pose_are_drawn(lab: Lab, page: Page) -> None:
    watched = SessionPage(page, lab.operator, "calibrate")
    at: list[dict[str, Any]] = []
    following: list[list[list[float]] | None] = []

    def look(event: object) -> None:
        parts = shown(watched)
        if watched._onlooker.seen is not None and lab.operator.states()[-1] is State.MOVE:
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


def test_force_and_torque_stand_beside_the_limits_of_their_guard(watched: SessionPage, lab: Lab) -> None:
    load = RangeGuard(Limits(saturation=0.5), np.array([100.0] * 3 + [10.0] * 3))
    onlooker = watched.watch(certifier_for(lab.cell, "ur5e"), load)
    onlooker.look(seen([25.0, -49.0, 0.0, 0.0, 0.0, 1.0], t_s=1.0))
    onlooker.look(seen([25.0, -49.0, 0.0, 0.0, 0.0, 1.0], t_s=1.02))
    parts = shown(watched)
    rows = {row["label"]: row for row in parts["bars"]["rows"]}
    assert list(rows) == ["Fx", "Fy", "Fz", "Tx", "Ty", "Tz"]
    assert (rows["Fx"]["share"], rows["Fx"]["text"], rows["Fx"]["tone"]) == (0.5, "+25.0 of 50 N", "")
    assert (rows["Fy"]["share"], rows["Fy"]["text"], rows["Fy"]["tone"]) == (-0.98, "-49.0 of 50 N", "warn")
    assert (rows["Tz"]["share"], rows["Tz"]["text"]) == (0.2, "+1.00 of 5 N·m")
    assert parts["bars/guards"]["rows"] == [["joint speed", "30 °/s"], ["age of the sample", "20 ms"]]
    onlooker.looked_s -= 1
    parts = shown(watched)
    assert "The guards are at rest" in texts(parts["bars"])
    assert "bars/guards" not in parts


def test_an_arbitrary_zero_does_not_count_and_an_unknown_range_has_no_bars(watched: SessionPage, lab: Lab) -> None:
    certifier = certifier_for(lab.cell, "ur5e")
    load = RangeGuard(Limits(saturation=0.5), np.full(6, 100.0), np.full(6, 20.0))
    onlooker = watched.watch(certifier, load)
    onlooker.look(seen([45.0, 20, 20, 20, 20, 20]))
    bars = shown(watched)["bars"]
    assert bars["head"] == "Force and torque, since the start"
    assert [row["share"] for row in bars["rows"]] == [0.5, 0, 0, 0, 0, 0]
    watched.watch(certifier, RangeGuard(Limits(), None))
    table = shown(watched)["bars"]
    assert table["kind"] == "table"
    assert table["rows"][0] == ["Fx", "+45.0 N"]


def test_poses_have_the_colour_of_their_residual(watched: SessionPage) -> None:
    for stop, sigmas in ((1, None), (2, 1.0), (3, 4.0), (4, 20.0)):
        watched.show(pose(stop, (0.0, 0.0, 1.0)))
        watched.show(estimated(sigmas))
    before = shown(watched)
    assert before["scene/gravity/poses"]["colours"] == ["unknown", "good", "warn", "bad"]
    named = {(colour, words) for colour, _, words in before["scene/legend"]["rows"]}
    assert {colour for colour, words in named if words.startswith("pose, ")} == {"unknown", "good", "warn", "bad"}
    watched.show(pose(2, (1.0, 0.0, 0.0)))
    watched.show(Compared(stop=2, number=2, residual=np.ones(6), sigma=np.full(6, 0.1), poses=4, light="green"))
    dots = shown(watched)["scene/gravity/poses"]
    assert dots["colours"][1] == "bad"
    np.testing.assert_allclose(dots["points"][1] / np.linalg.norm(dots["points"][1]), np.eye(3)[0], atol=1e-3)


def test_everything_that_is_drawn_is_named(lab: Lab, page: Page) -> None:
    watched = SessionPage(page, lab.operator, "calibrate")
    run_with(lab, watched)
    parts = shown(watched)
    named = {colour for colour, _, _ in parts["scene/legend"]["rows"]}
    drawn = {part["colour"] for name, part in parts.items() if name.startswith("scene/") and "colour" in part}
    assert drawn | set(parts["scene/gravity/poses"]["colours"]) <= named
    assert parts["scene/gravity/name"]["text"] == "gravity in flange axes"


def test_by_hand_there_are_poses_and_no_arm(watched: SessionPage) -> None:
    watched.show(StateChanged(state=State.SETTLE, stop=1))
    watched.show(pose(1, (0.0, 0.0, 1.0)))
    parts = shown(watched)
    assert parts["state"]["head"].startswith("pose 1  SETTLE")
    assert texts(parts["state/progress"]).strip() == "1 kept"
    assert parts["scene/gravity/poses"]["points"] == [[0, 0, 0.18]]
    assert parts["scene/camera"]["at"] == [0, 0, 0]
    assert not [name for name in parts if name.startswith(("scene/arm", "bars"))]


def test_estimates_have_the_digits_of_their_sigma(watched: SessionPage) -> None:
    watched.show(pose(1, (0.0, 0.0, 1.0)))
    watched.show(estimated(1.0, mass_kg=1.2345678, p_sensor_com_m=0.0512345))
    assert shown(watched)["table/estimates"]["rows"] == [["mass kg", "1.2346 ± 0.0021"], ["centre mm", "51.2 ± 2.1"]]


def test_compared_poses_have_a_row_each(page: Page) -> None:
    watched = SessionPage(page, Scripted(), "verify")
    residual, sigma = np.array([0.3, 0, 0, 0, 0.02, 0]), np.full(6, 0.1)
    watched.show(Compared(stop=2, number=7, residual=residual, sigma=sigma, poses=4, light="green"))
    assert shown(watched)["table/compared"]["rows"] == [["R07", "0.300 ± 0.173", "0.0200 ± 0.1732", "3.0"]]


def test_a_trip_is_red_until_the_next_pose(watched: SessionPage) -> None:
    watched.show(GuardTripped(hazard=14, words="contact of 9 N"))
    alert = shown(watched)["alert"]
    assert "contact of 9 N" in texts(alert)
    assert alert["tone"] == "bad"
    watched.show(pose(1, (0.0, 0.0, 1.0)))
    assert "alert" not in shown(watched)


@pytest.mark.slow
def test_a_sweep_is_one_motion(lab: Lab, page: Page) -> None:
    watched = SessionPage(page, lab.operator, "calibrate")
    looks: list[dict[str, Any]] = []
    lab.operator.at_question = [("Type MOVE", lambda: looks.append(shown(watched)))]

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


def failing(_: SessionPage) -> None:
    raise RuntimeError("no memory")


def test_a_session_whose_page_cannot_be_drawn_goes_on_and_says_so_once(
    lab: Lab, page: Page, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(SessionPage, "draw", failing)
    page.viewers = 1
    threads: set[threading.Thread] = set()
    watched = SessionPage(page, lab.operator, "calibrate")
    lab.operator.on_event = lambda event: threads.add(threading.current_thread()) if is_failure(event) else None
    with caplog.at_level(logging.INFO), watched:
        wait_until(lambda: not watched._drawer.is_alive())
        run_with(lab, watched)
        watched.show(Noted(words="a note"))
    notes = list(filter(is_failure, lab.operator.of(Noted)))
    assert [note.words for note in notes] == [
        "The page cannot be updated: RuntimeError('no memory'). The session continues. Stop on the page still works."
    ]
    assert notes[0].warning
    assert threads == {threading.current_thread()}
    assert lab.taken() == [1, 2, 3, 4, 5, 6, 7]
    assert caplog.text == ""  # a traceback would stand in the middle of the screen


def is_failure(event: object) -> bool:
    return isinstance(event, Noted) and "cannot be updated" in event.words


def test_a_page_that_hangs_is_reported_and_not_waited_for(page: Page, monkeypatch: pytest.MonkeyPatch) -> None:
    released = threading.Event()

    def hang(_: SessionPage) -> None:
        released.wait()

    monkeypatch.setattr(SessionPage, "draw", hang)
    monkeypatch.setattr(session_page, "HUNG_S", 0.2)
    page.viewers = 1
    terminal = Scripted()
    watched = SessionPage(page, terminal, "calibrate")
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


def test_drawing_that_goes_on_after_the_end_shows_nothing_live(page: Page, monkeypatch: pytest.MonkeyPatch) -> None:
    drawing, released = threading.Event(), threading.Event()

    def hang(_: object) -> dict[str, Any]:
        drawing.set()
        released.wait()
        return {}

    monkeypatch.setattr(session_page, "_results", hang)
    page.viewers = 1
    watched = SessionPage(page, Scripted(), "calibrate")
    with watched:
        watched.show(Noted(words="a warning", warning=True))
        assert drawing.wait(LONG_S)
    released.set()
    watched._drawer.join(LONG_S)
    parts = parts_of(page)
    assert parts["state"]["head"] == "ended"
    assert not set(parts) & {"stop", "alert", "state/note"}


def end(lab: Lab, page: Page) -> dict[str, Any]:
    """Run a session on a page to its end; return what is shown then."""
    options = lab._options()
    with on_page(page, lab.operator, options) as (shown, options):
        session.take_poses(Calibrating(lab.cell, options), shown, options)
    return parts_of(page)


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


def interrupted(lab: Lab, _: Page) -> None:
    def interrupt() -> None:
        raise KeyboardInterrupt

    lab.arm.at_move[3] = interrupt


def broken(lab: Lab, _: Page) -> None:
    lab.arm.at_move[3] = lambda: lab.arm.set_status(fault=DeviceFault("protective stop", "unlock it"))


@pytest.mark.parametrize(
    ("happens", "head", "words"),
    [
        (stopped_by, "Stopped by viewer 2", ""),
        (interrupted, "Interrupted", ""),
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


def test_an_end_before_there_is_a_run_shows_no_note(lab: Lab, page: Page) -> None:
    lab.operator.answers = {"Is the tool free": ["no"]}
    with pytest.raises(Declined):
        end(lab, page)
    parts = parts_of(page)
    assert parts["result"]["head"] == "Not confirmed, nothing moves"
    (line,) = parts["result/words"]["lines"]
    assert line.startswith("Is the tool free")


def printed(capsys: pytest.CaptureFixture[str]) -> str:
    """Return what was printed, its lines joined."""
    return " ".join(" ".join(capsys.readouterr()).split())


def test_a_calibration_ends_with_verdict_estimates_and_next_command(
    lab: Lab, page: Page, capsys: pytest.CaptureFixture[str]
) -> None:
    outcome = lab.calibrate()
    assert isinstance(outcome, Outcome)
    capsys.readouterr()
    calibrate._report_calibration(outcome, page, simulate=False, every=False, as_json=False)
    terminal, parts = printed(capsys), parts_of(page)
    verdict = parts["result"]
    tones = {"GOOD": "good", "USABLE": "warn"}
    assert verdict["tone"] == tones[verdict["head"]]
    assert f"{verdict['head']} {parts['result/words']['lines'][0]}" in terminal
    assert all(words in terminal for words in parts["result/words"]["lines"])
    figures = {row["label"]: row for row in parts["result/figures"]["rows"]}
    assert list(figures) == ["mass", "centre of mass", "flange to sensor"]
    sigma = figures["mass"]["sigma"].removeprefix("± ").removesuffix(" (1 sigma)")
    assert f"mass, kg {figures['mass']['value']} {sigma}" in terminal
    assert len(figures["centre of mass"]["value"].split(", ")) == 3
    assert parts["result/next"]["head"] == "Next"
    for command in parts["result/next"]["lines"]:
        assert " ".join(command.split()) in terminal
    assert len(parts["result/next"]["lines"]) == 3


def test_the_result_of_json_is_shown_too(lab: Lab, page: Page, capsys: pytest.CaptureFixture[str]) -> None:
    outcome = lab.calibrate()
    assert isinstance(outcome, Outcome)
    calibrate._report_calibration(outcome, page, simulate=False, every=False, as_json=True)
    assert json.loads(capsys.readouterr().out)["verdict"].upper() == parts_of(page)["result"]["head"]


@pytest.mark.parametrize(("limit_N", "head", "tone"), [(10.0, "PASS", "good"), (1e-6, "FAILED", "bad")])
def test_a_verification_ends_with_its_verdict(
    lab: Lab, page: Page, capsys: pytest.CaptureFixture[str], limit_N: float, head: str, tone: str
) -> None:
    outcome = lab.calibrate()
    assert isinstance(outcome, Outcome)
    result, path, runs = outcome.result, outcome.run.calibration_path, lab.folder / "runs"
    about = {"verification": {"id": result.id, "path": str(path), "poses": 2}}
    options = SessionOptions(runs, "verify", poses=2, description=about)
    run = session.take_poses(Verifying(lab.cell, result, path, 2, runs), lab.operator, options)
    assert run is not None
    verified = verify_run(run, result, path, (limit_N, None))
    capsys.readouterr()
    verify._report_verification(verified, "no", page, again="", as_json=False)
    terminal, parts = printed(capsys), parts_of(page)
    assert (parts["result"]["head"], parts["result"]["tone"]) == (head, tone)
    assert f"{head} {parts['result/words']['lines'][0]}" in terminal
    assert [row["unit"] for row in parts["result/figures"]["rows"]] == ["N", "N·m"]
    assert float(parts["result/figures"]["rows"][0]["value"]) == pytest.approx(verified.force_N.max(), rel=0.1)
    (command,) = parts["result/next"]["lines"]
    assert " ".join(command.split()) in terminal


def test_the_question_of_a_verification_is_shown_while_it_waits(page: Page, monkeypatch: pytest.MonkeyPatch) -> None:
    waiting: list[str] = []

    def answer(_: object, question: Question) -> str:
        waiting.append(texts(parts_of(page)["question"]))
        assert question.text in waiting[0]
        return "yes"

    monkeypatch.setattr("ftdrive.terminal.operators.PlainOperator.ask", answer)
    assert verify._ask_on_page(page, False, Question("Save it?")) == "yes"
    assert waiting == ["Answer in the terminal\nSave it?"]
    assert "question" not in parts_of(page)
