"""The form of `ftdrive init` without a browser: no answer ends it, rows keep their names, a busy form says so."""

import json
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from threading import Event, Thread, current_thread, main_thread
from typing import Any

import pytest

from ftdrive.cell.config import settings
from ftdrive.checks.description import BOXES, MODEL, ROBOT, SENSOR, TOOL, WALLS, Description
from ftdrive.view.init_page import InitPage
from ftdrive.view.page import Page
from ftdrivers.clock import REAL

HUGE = "1" + "0" * 308
NASTY = (
    *("nan", "1e308", f"-{HUGE}", "-0", "none", "²", f"0:60:90:{HUGE}:0", f"0:60:90:0.{'0' * 320}1:0"),
    *(f"1:0:0:-{HUGE}", "0:0:0:0", f"-{HUGE}:{HUGE}:{HUGE}:0:0:1", "x" * 10_000, "<script>alert(1)</script>"),
)
IMPOSSIBLE_NAMES = ("a..b", "é" * 80, "/dev/" + "x" * 5_000)
ANSWERS = {ROBOT: "127.99.9.9", f"{MODEL} choice": "UR5e", SENSOR: "ati-serial:///dev/no-such-port"}
ANSWERS |= {"sensor.height_mm": "33", f"{TOOL} 1": "0 60 80"}


class Form:
    def __init__(self, folder: Path) -> None:
        self.page, self.draft = Page("test"), folder / ".ftdrive.toml.draft"
        self.described = Description(REAL, {key: setting.value for key, setting in settings().items()})
        self.form = InitPage(self.page, self.described, self.draft, "ftdrive.toml", lambda *_: None)
        self.thread = Thread(target=self.form.run, daemon=True)
        self.thread.start()
        self.wait(lambda: "form/write" in self.parts())

    def parts(self) -> dict[str, Any]:
        parts: dict[str, Any] = json.loads(self.page.since(0)[1])
        return parts

    def controls(self) -> dict[str, Any]:
        found = [part["controls"] for part in self.parts().values() if part and part["kind"] == "controls"]
        return {control["name"]: control for part in found for control in part}

    def enter(self, name: str, value: str | None = None) -> None:
        self.page.act("viewer 0", name, value)
        if value is not None:
            self.wait(lambda: self.controls()[name]["value"] == value)

    def wait(self, condition: Callable[[], object]) -> None:
        deadline_s = time.monotonic() + 30
        while not condition():
            assert self.thread.is_alive()
            assert time.monotonic() < deadline_s
            time.sleep(0.005)


@pytest.fixture
def form(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Iterator[Form]:
    made = Form(tmp_path)
    yield made
    assert capsys.readouterr().err == ""
    for name, text in ANSWERS.items():
        made.enter(name, text)
    made.wait(lambda: made.parts()["form/words"]["tone"] == "good")
    made.page.act("viewer 0", "write", None)
    made.thread.join(10)
    assert not made.thread.is_alive()
    assert made.described.cell().sensor.height_mm == 33


@pytest.mark.slow
def test_no_answer_ends_the_form(form: Form) -> None:
    for key in (WALLS, BOXES):
        form.enter(f"{key} add")
    form.wait(lambda: f"{BOXES} 1" in form.controls())
    for text in NASTY:
        for name, control in form.controls().items():
            if control["type"] == "text":
                form.enter(name, text)
        form.wait(lambda: form.parts()["form/words"]["tone"] == "bad")
        assert form.parts()["scene/camera"]["from"][0] < 10
    for name, was in (("tool.name", "tool"), ("sensor.mass_kg", ""), ("tool.mass_kg", ""), ("robot.speed_deg_s", "60")):
        form.enter(name, was)
    for key in (WALLS, BOXES):
        form.enter(f"{key} 1 remove")
    assert json.loads(form.draft.read_text())["texts"]["tool.name"] == ["tool"]


@pytest.mark.parametrize("name", IMPOSSIBLE_NAMES)
def test_an_address_that_cannot_exist_is_named(form: Form, name: str) -> None:
    for key in (ROBOT, SENSOR):
        form.enter(key, name)
    form.enter("look")
    form.wait(lambda: all(form.controls()[key]["words"].startswith("✘") for key in (ROBOT, SENSOR)))


def test_ctrl_c_ends_the_form_while_a_device_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page, ended = Page("test"), Event()
    described = Description(REAL, {key: setting.value for key, setting in settings().items()})

    def look(*_: str) -> str:
        assert current_thread() is not main_thread()  # where a lookup in C keeps Ctrl-C waiting
        signal.pthread_kill(main_thread().ident or 0, signal.SIGINT)
        ended.wait(30)
        return "found"

    monkeypatch.setattr(described, "look", look)
    form = InitPage(page, described, tmp_path / "draft", "ftdrive.toml", lambda *_: None)

    def use() -> None:
        while "form/write" not in page.since(0)[1]:
            time.sleep(0.005)
        page.act("viewer 0", ROBOT, "robot-of-another-network")
        page.act("viewer 0", "look", None)

    Thread(target=use).start()
    try:
        with pytest.raises(KeyboardInterrupt):
            form.run()
    finally:
        ended.set()


def test_a_busy_form_refuses_more(form: Form, monkeypatch: pytest.MonkeyPatch) -> None:
    reads, goes_on = Event(), Event()

    def look(key: str, text: str) -> str:
        reads.set()
        goes_on.wait(30)
        form.described.texts[key] = [text]
        return "found"

    monkeypatch.setattr(form.described, "look", look)
    form.enter(ROBOT, "10.0.0.2")
    form.enter("look")
    assert reads.wait(30)
    assert form.parts()["form/words"]["lines"] == ["Reading 10.0.0.2 …"]
    for _ in range(100):
        form.page.act("viewer 0", f"{WALLS} add", None)
    with pytest.raises(ValueError, match="busy"):
        form.page.act("viewer 0", f"{WALLS} add", None)
    goes_on.set()
    form.wait(lambda: f"{WALLS} 100" in form.controls())
    with pytest.raises(ValueError, match="does not have this control"):
        form.enter(f"{WALLS} add")
    assert form.controls()[ROBOT]["words"] == "✔ found"
    for number in range(1, 101):
        form.enter(f"{WALLS} {number} remove")
    form.wait(lambda: f"{WALLS} add" in form.controls() and not form.controls()[f"{WALLS} add"]["disabled"])
