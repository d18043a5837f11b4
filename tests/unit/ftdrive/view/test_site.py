"""A page over HTTP: who is served, what a viewer receives, and what it may ask for."""

import json
import socket
import threading
from collections.abc import Iterator
from contextlib import closing
from functools import partial
from http.client import HTTPConnection, HTTPResponse
from urllib.parse import urlsplit

import pytest

from ftdrive.view.page import Page, drawing
from ftdrive.view.parts import button, check_box, choice, controls, lines, slider, text_field
from ftdrive.view.site import serve_page
from tests.wire.waiting import wait_until

pytest.importorskip("uplot", reason="the extra viz is not installed")
JSON = "application/json"


class Viewer:
    def __init__(self, page: Page) -> None:
        self.port = urlsplit(page.url).port
        self.origin = f"http://127.0.0.1:{self.port}"
        self.cookie = ""
        opened = self.ask("GET", f"/?{urlsplit(page.url).query}")
        self.cookie = opened.headers["Set-Cookie"].split(";")[0]

    def ask(self, method: str, target: str, body: str = "", **headers: str) -> HTTPResponse:
        with closing(HTTPConnection("127.0.0.1", self.port, timeout=30)) as connection:
            connection.request(method, target, body, {"Cookie": self.cookie} | headers)
            answer = connection.getresponse()
            answer.body = answer.read()  # type: ignore[attr-defined]
        return answer

    def do(self, name: object, value: object = None, **headers: str) -> int:
        given = {"Origin": self.origin, "Content-Type": JSON} | headers
        return self.ask("POST", "/do", json.dumps({"name": name, "value": value}), **given).status

    def follow(self) -> Iterator[tuple[str, dict[str, object]]]:
        raw = socket.create_connection(("127.0.0.1", self.port), timeout=30)
        raw.sendall(f"GET /parts HTTP/1.1\r\nHost: 127.0.0.1:{self.port}\r\nCookie: {self.cookie}\r\n\r\n".encode())
        with closing(raw), raw.makefile("r", encoding="utf-8") as received:
            event = "message"
            for line in received:
                if line.startswith("event: "):
                    event = line[7:-1]
                elif line.startswith("data: "):
                    yield event, json.loads(line[6:])
                    event = "message"


@pytest.fixture
def page() -> Iterator[Page]:
    with serve_page("a <b>page</b>") as page:
        yield page


def wait_for(event: threading.Event) -> None:
    event.wait()


def test_parts_arrive_once_and_the_newest_counts(page: Page) -> None:
    page.put({"state": lines("one"), "alert": lines("gone")})
    events = Viewer(page).follow()
    seen: dict[str, object] = {}
    while not {"viewer", "title", "state"} <= seen.keys():
        seen |= next(events)[1]
    assert seen["title"] == {"kind": "title", "text": "a <b>page</b>"}
    page.put({"state": lines("one"), "alert": None})
    assert next(event for event in events if event[0] == "message")[1] == {"alert": None}
    wait_until(lambda: page.viewers == 1)
    events.close()  # type: ignore[attr-defined]
    wait_until(lambda: page.viewers == 0)


def test_stop_is_called_in_the_name_of_the_viewer_whatever_the_drawing_does(page: Page) -> None:
    stopped: list[str] = []
    page.add_stop(stopped.append)
    viewers = [Viewer(page), Viewer(page)]
    hangs = threading.Event()
    with drawing(page, lambda: wait_for(hangs)):
        assert viewers[1].do("stop") == 204
        hangs.set()
    assert stopped == ["viewer 1"]


def taken_by(taken: list[tuple[str, object]], name: str, _: str, value: object) -> None:
    taken.append((name, value))


def test_controls_take_only_their_own_values(page: Page) -> None:
    taken: list[tuple[str, object]] = []
    page.put(
        {
            "controls": controls(
                button("go", "Go"),
                button("off", "Off", disabled=True),
                choice("axes", "Axes", "base", ["base", "tcp"]),
                slider("at", "seconds", 0, 12),
                check_box("swept", "swept", value=False),
            ),
            "form/a": controls(text_field("name", "Name", "")),
        }
    )
    for name in ("go", "off", "axes", "at", "swept", "name", "hidden"):
        page.on(name, partial(taken_by, taken, name))
    viewer = Viewer(page)
    right: list[tuple[str, object]] = [("go", None), ("axes", "tcp"), ("at", 12), ("swept", True), ("name", "<script>")]
    for name, value in right:
        assert viewer.do(name, value) == 204
    wrong: list[tuple[object, object]] = [
        ("go", 1), ("off", None), ("hidden", None), ("axes", "world"), ("axes", ["tcp"]), ("at", 1e9), ("at", -1),
        ("at", True), ("at", "3"), ("swept", 1), ("name", "x" * 10_001), ("name", "a\nb"), ("name", {"a": 1}),
        (["go"], None), (None, None),
    ]  # fmt: skip
    for wrong_name, value in wrong:
        assert viewer.do(wrong_name, value) == 400
    for body in ("", "[]", "nothing", "{}", '{"name":"at","value":NaN}', '{"name":"at","value":Infinity}', "[" * 9999):
        headers = {"Origin": viewer.origin, "Content-Type": JSON}
        assert viewer.ask("POST", "/do", body, **headers).status == 400
    assert taken == right


def test_controls_are_not_used_from_another_site(page: Page) -> None:
    page.add_stop(lambda _: pytest.fail("a foreign page has stopped the arm"))
    viewer = Viewer(page)
    for headers in ({"Origin": "https://evil.example"}, {"Sec-Fetch-Site": "same-site"}, {"Host": "evil.example"}):
        assert viewer.do("stop", **headers) == 403
