"""Attacks on a page by another user, a foreign page or a broken browser: nothing is read or changed, Stop works."""

import json
import os
import random
import re
import signal
import stat
import subprocess
import time
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from itertools import product
from pathlib import Path
from statistics import median
from typing import Any

import pytest

from ftdrive.cell.emulated import Station
from tests.system.attacked_page import SECRET, Attacked, served
from tests.system.command_line import CommandLine, exit_code_of, wait_until
from tests.unit.ftdrive.stream.simulated import calibrated_from

pytest.importorskip("uplot", reason="the extra viz is not installed")

STOP_S, GROWTH_MB, LARGE = 10.0, 50, 45_000_000
words = re.compile(r"\S+").findall
# What the controls of that page pass on.
VALUES = {"tare": "None", "check": "True|False", "axes": "'base'|'tcp'", "name": r"'[^\\]*'"}
VALUES["time"] = r"10\.0|\d(\.\d+)?"
METHODS = words("GET HEAD POST PUT DELETE PATCH OPTIONS TRACE CONNECT PROPFIND get X")
ADDRESSES = words("""
/ /parts /do /page.html /page.js /page.css /scene.js /uPlot.iife.js * // /ws /?token= /?token=x /?token=%00
/?token={token}x /?x&token={token} /?TOKEN={token} /?token={TOKEN} /\x7f
""")
MORE_LINES = (
    {"Accept": "text/event-stream"},
    {"Authorization": "Bearer {token}"},
    {"Connection": "Upgrade", "Upgrade": "websocket"},
)
# A line that is wrong in a head that is right otherwise; - leaves it out.
FOREIGN = """
Cookie: -|Cookie: |Cookie: {token}|Cookie: x={token}.0|Cookie: ftdrive-{port}={token}|Cookie: ftdrive-{port}=.0|
Cookie: ftdrive-{port}={token}x.0|Cookie: ftdrive-{port}={token}.-1|Cookie: ftdrive-{port}={token}.1e3|
Cookie: ftdrive-{port}={token}.٣|Cookie: ftdrive-{port}={TOKEN}.0|Cookie: ftdrive-{other}={token}.0|
Origin: -|Origin: |Origin: null|Origin: x|Origin: file://|Origin: https://evil.example|Origin: http://{host}.evil.example|
Origin: http://127.0.0.1:1|Origin: http://[|Origin: http://user@{host}|Origin: http://evil.example@{host}|
Host: -|Host: |Host: evil.example|Host: 127.0.0.1.evil.example:{port}|Host: {host}, evil.example|Host: 192.0.2.1:{port}|
Content-Type: -|Content-Type: |Content-Type: text/plain|Content-Type: application/x-www-form-urlencoded|
Content-Type: text/json|Content-Type: multipart/form-data; boundary=x|Content-Type: text/plain; application/json|
Content-Length: -|Content-Length: -1|Content-Length: +40|Content-Length: 0x20|Content-Length: 4_0|Content-Length: 1e3|
Content-Length: 45000000|Content-Length: 999999999999999999999999|Content-Length: ٤٠|Content-Length: 40, 40|
Transfer-Encoding: chunked|Transfer-Encoding: identity, chunked|Transfer-Encoding: xchunked|Transfer-Encoding: gzip
""".replace("\n", "").split("|")  # fmt: skip
# Requests of a viewer that use no control.
READ_ONLY = [(method, "/do") for method in METHODS if method != "POST"]
READ_ONLY += [("POST", one) for one in words("/ /parts /do/ /DO //do /./do /%64o /stop /page.js")]
READ_ONLY += [("GET", one) for one in words(f"/do?name=name&value={SECRET} /stop /?name=name&value={SECRET}")]
NO_FILES = words(r"""
/../page.py /../../../../etc/passwd /%2e%2e/page.py /..%2fpage.py //etc/passwd /page.js/../../page.py /shell/page.js
/page.py /__init__.py /.git/config /page.js%00.css /\..\page.py /etc/passwd
""")
# Heads that two readers may understand differently; | ends a line.
DO, OWN = "POST /do HTTP/1.1|Host: {host}|Cookie: {cookie}|", "Origin: {origin}|Content-Type: application/json|"
END = "Content-Length: {length}||{body}"
AMBIGUOUS = (
    DO + "Host: evil.example|" + OWN + END,
    DO + OWN + "Origin: null|" + END,
    DO + OWN.replace(":", " :", 1) + END,
    DO + " " + OWN + END,
    (DO + OWN + END).replace("|", "\n"),
    DO + OWN + "Content-Length: 0|" + END,
    DO + OWN + "Transfer-Encoding: chunked|" + END,
    DO + OWN + "Content-Length: 0||" + DO + OWN + END,
    DO.replace("POST /do", "GET /") + "Connection: keep-alive||" + DO + OWN + END,
    (DO + OWN + END).replace(" /do ", "  /do  "),
    "POST /do|{body}",
)


@pytest.fixture(scope="module")
def attacked(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Attacked]:
    page = served(tmp_path_factory.mktemp("page"))
    yield page
    page.process.communicate()


def body(name: object = "name", value: object = SECRET) -> bytes:
    return json.dumps({"name": name, "value": value}).encode()


def stops_s(page: Attacked) -> float:
    """Return how long Stop takes, the median of three, because other tests share the computer."""
    return median(page.stop_s() for _ in range(3))


def status(answer: str) -> int:
    return int(answer[9:12]) if answer else 0


def test_without_token_nothing_is_read(attacked: Attacked) -> None:
    for method, address, lines in product(METHODS, ADDRESSES, ({}, *MORE_LINES)):
        answer = attacked.ask(method, address, body(), **lines)
        assert status(answer) in (0, 400, 403, 405), (method, address, answer)
        assert len(answer) < 600, answer
        assert not re.search(f"{SECRET}|ftdrive-|{attacked.token}|Set-Cookie|Access-Control", answer), (method, address)


def test_foreign_requests_change_nothing(attacked: Attacked) -> None:
    before = attacked.out.read_text()
    for line in FOREIGN:
        name, _, value = line.partition(": ")
        answer = attacked.do(body(), **{name: value})
        assert status(answer) in (0, 400, 403, 411, 413, 415), (line, answer)
    for method, address in READ_ONLY:
        assert status(attacked.ask(method, address, body(), **attacked.own)) != 204, (method, address)
    assert attacked.out.read_text() == before
    attacked.is_well()


@pytest.mark.parametrize("template", AMBIGUOUS)
def test_ambiguous_heads_change_nothing(attacked: Attacked, template: str) -> None:
    before, known = attacked.out.read_text(), {"host": attacked.host, "cookie": attacked.cookie}
    known |= {"origin": attacked.own["Origin"], "body": body().decode(), "length": str(len(body()))}
    assert status(attacked.raw(template.format(**known).replace("|", "\r\n").encode(), is_all=True)) != 204
    assert attacked.out.read_text() == before


def test_only_the_files_of_the_page_are_served(attacked: Attacked) -> None:
    for address in NO_FILES:
        assert status(attacked.ask("GET", address, Cookie=attacked.cookie)) in (400, 404), address
    for address in words("/ /page.js /scene.js /page.css /uPlot.iife.js"):
        answer = attacked.ask("GET", address, Cookie=attacked.cookie)
        assert status(answer) == 200, address
        for line in ("X-Content-Type-Options: nosniff", "default-src 'none'", "script-src 'self';", "no-store"):
            assert line in answer.partition("\r\n\r\n")[0], (address, line)


@pytest.mark.slow
def test_large_heads_and_bodies_are_refused(attacked: Attacked) -> None:
    before_MB = attacked.memory_MB()
    for data in (
        b"A" * LARGE,
        b"GET /" + b"a" * 1_000_000 + b" HTTP/1.1\r\n\r\n",
        b"GET / HTTP/1.1\r\n" + b"X: y\r\n" * 100_000 + b"\r\n",
        attacked.unfinished(LARGE, LARGE),
        attacked.head("GET", "/parts", Cookie=attacked.cookie) + b"x" * LARGE,
        attacked.head("POST", "/do", **attacked.own, **{"Transfer-Encoding": "chunked"})
        + b"fffffff\r\n"
        + b"x" * LARGE,
    ):
        attacked.connect(data, timeout_s=2).close()
        assert attacked.memory_MB() - before_MB < GROWTH_MB
    assert status(attacked.raw(attacked.unfinished(LARGE, 0))) == 413
    assert status(attacked.do(body("name", "x" * 10_001))) == 400
    assert stops_s(attacked) < STOP_S
    attacked.is_well()


UNFINISHED = "GET / HTTP/1.1\r\nHost: x\r\nX: "


@pytest.mark.parametrize(("count", "most", "data"), [
    (300, 350, UNFINISHED), (200, 220, "parts"), pytest.param(200, 220, "unfinished", marks=pytest.mark.slow),
    pytest.param(1000, 560, "", marks=pytest.mark.slow), pytest.param(1000, 560, UNFINISHED, marks=pytest.mark.slow),
])  # fmt: skip
def test_who_only_connects_keeps_nobody_out(attacked: Attacked, count: int, most: int, data: str) -> None:
    before_MB = attacked.memory_MB()
    sent = {"unfinished": attacked.unfinished(30_000, 29_999)}
    sent |= {"parts": attacked.head("GET", "/parts", Cookie=attacked.cookie)}
    with ExitStack() as stack:
        for _ in range(count):
            stack.enter_context(attacked.connect(sent.get(data, data.encode()), receives=4096))
        assert SECRET in str(attacked.parts())
        assert stops_s(attacked) < STOP_S
        time.sleep(1.0)
        assert len(attacked.descriptors()) < most
        assert attacked.memory_MB() - before_MB < GROWTH_MB
        assert stops_s(attacked) < STOP_S
    wait_until(lambda: len(attacked.descriptors()) < 20)
    attacked.is_well()


def fuzzed(controls: list[dict[str, Any]], count: int) -> Iterator[bytes]:
    """Yield bodies, some of which use a control that is shown; none presses Stop."""
    chance = random.Random(count)
    names = (
        [one["name"] for one in controls] + words("off hidden title state __class__ _acts") + ["", "stop ", None, 1, []]
    )
    values = [
        *words("nan 1e308 base <script> ../../etc/passwd update_cb"),
        "x" * 9_000,
        "9" * 400,
        "\ud800",
        "\0\x1b[2J",
    ]
    values += [None, True, -1, 0.5, 3, 1e9, -1e9, [], {}, [None] * 5_000, {"value": 1}, {"__class__": "int"}, "\u202e"]
    texts = ["NaN", "Infinity", "1e999", "-" + "9" * 20_000, "[" * 30_000, '{"a":' * 5_000, "9" * 5_000]
    for _ in range(count):
        name, value = chance.choice(names), chance.choice(values)
        made = (
            body(name, value),
            body(name, value)[:-1] + b',"viewer":"viewer 0"}',
            f'{{"name": {json.dumps(name)}, "value": {chance.choice(texts)}}}'.encode(),
            b"[" + body(name, value) + b"]",
            chance.randbytes(chance.randrange(200)),
            body(name, value)[: chance.randrange(20)] + b"\xff\x00",
        )
        if (name, value) != ("stop", None):
            yield chance.choice(made)


def test_no_message_sets_more_than_the_value_of_a_control(attacked: Attacked) -> None:
    before, shown = attacked.out.read_text(), attacked.parts()
    for one in fuzzed(shown["controls"]["controls"], 300):
        assert status(attacked.do(one)) in (204, 400, 413)
    passed_on = [line.split(" ", 3) for line in attacked.out.read_text().removeprefix(before).splitlines()]
    assert {name for _, _, name, _ in passed_on} <= VALUES.keys()
    assert all(re.fullmatch(VALUES[name], value) for _, _, name, value in passed_on), passed_on
    assert attacked.parts()["controls"] == shown["controls"]
    assert stops_s(attacked) < STOP_S
    attacked.is_well()


# Run by another user: tries the page, and all files about the process, and prints what it gets.
OTHER_USER = """
import glob, socket, sys
pid, host, port = sys.argv[1:]
for more in ("", "Upgrade: websocket\\r\\nConnection: Upgrade\\r\\n", f"Origin: http://{host}\\r\\n"):
    for target in ("/", "/parts", "/do", "/page.js", "/?token="):
        with socket.create_connection(("127.0.0.1", int(port)), 10) as raw:
            raw.sendall(f"GET {target} HTTP/1.1\\r\\nHost: {host}\\r\\n{more}\\r\\n".encode())
            print(raw.recv(65536))
for path in glob.glob(f"/proc/{pid}/*") + glob.glob("/proc/[0-9]*/cmdline") + glob.glob("/tmp/ftdrive-*/*"):
    try:
        print(path, open(path, "rb").read(100000))
    except (OSError, ValueError):
        pass
"""


@pytest.mark.slow
def test_another_user_of_the_computer_reads_nothing(ftdrive: CommandLine, monkeypatch: pytest.MonkeyPatch) -> None:
    browser, opened = ftdrive.folder / "browser", ftdrive.folder / "opened"
    browser.write_text(f'#!/bin/sh\necho "$@" > {opened}\n')
    browser.chmod(0o755)
    monkeypatch.setenv("BROWSER", str(browser))
    monkeypatch.setenv("DISPLAY", ":99")
    page = Attacked(lambda **how: ftdrive.start("init", "--view", **how), ftdrive.folder)
    wait_until(lambda: opened.exists() and bool(opened.read_text()))
    file = Path(opened.read_text().strip().removeprefix("file://"))
    assert page.token in file.read_text()
    assert stat.S_IMODE(file.parent.stat().st_mode) == 0o700
    for line in Path("/proc").glob("[0-9]*/cmdline"):
        with suppress(OSError):
            assert page.token not in line.read_text(errors="replace")
    assert page.listens_at() == [("tcp", page.port)]
    if os.getuid() == 0 and Path("/usr/bin/python3").exists():
        child = subprocess.run(
            ["/usr/bin/python3", "-c", OTHER_USER, str(page.process.pid), page.host, page.port],
            user=65534, group=65534, extra_groups=[], capture_output=True, text=True, cwd="/", env={}, check=True,
        )  # fmt: skip
        assert child.stdout.count("HTTP/1.1 403") == 15
        assert not re.search(f"{page.token}|Set-Cookie", child.stdout)
    page.process.send_signal(signal.SIGINT)
    assert exit_code_of(page.process, page.err) == 130
    assert not file.parent.exists()


def command(name: str, ftdrive: CommandLine, station: Station) -> list[str | Path]:
    if name in ("live", "weigh"):
        calibrated_from(station.truth).save(path := ftdrive.folder / "calibration.json")
        cell = ("--config", ftdrive.connect(station), "--calibration", path, "--force")
        return [name, *cell, "--json", "--allow-control", "--view"]
    if name == "calibrate":
        return [name, "--config", ftdrive.connect(station), "--view"]
    return [name, *(("--model", "ur5e", "--tool", "0:200:100", "--minimal") if name == "plan" else ()), "--view"]
