"""A page in a process of its own, as an attacker on this computer reaches it: raw HTTP, descriptors, memory."""

import json
import os
import re
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from tests.system.command_line import wait_until

SECRET = "name-behind-the-token"
# Every kind of control, and a scene that changes faster than a viewer that sleeps can take.
PAGE = f"""
import sys, time
from ftdrive.view.page import drawing
from ftdrive.view.site import serve_page
from ftdrive.view.parts import *
def use(name): page.on(name, lambda viewer, value: print(viewer, name, repr(value), flush=True))
def draw():
    dots = {{"kind": "dots", "points": [[time.monotonic()] * 3] * 2000}}
    page.put({{"state": lines("{SECRET}"), "scene/dots": dots}})
    HOOK
shown = [button("tare", "Tare"), button("off", "Off", disabled=True), check_box("check", "Check", value=False)]
shown += [choice("axes", "Axes", "base", ["base", "tcp"]), slider("time", "Time", 1, 10)]
shown += [text_field("name", "Name", "")]
with serve_page("{SECRET}") as page:
    page.put({{"controls": controls(*shown)}})
    page.add_stop(lambda viewer: print(viewer, "stop", flush=True))
    for one in (*shown, button("hidden", "")): use(one["name"])
    with drawing(page, draw):
        print(page.url, flush=True)
        sys.stdin.read()
"""


class Attacked:
    """A page of a process, for who knows its port, and in some attacks its token too."""

    def __init__(self, start: Callable[..., "subprocess.Popen[str]"], folder: Path) -> None:
        self.out, self.err, self.known = folder / "out", folder / "err", ""
        with self.out.open("w") as out, self.err.open("w") as err:
            self.process = start(stdout=out, stderr=err)
        wait_until(lambda: bool(re.search(r"token=\S+\s", self.printed())), self.process)
        self.port, self.token = re.findall(r"http://127.0.0.1:(\d+)/\?token=(\S+)", self.printed())[0]
        self.host = f"127.0.0.1:{self.port}"
        self.cookie = self.ask("GET", "/?token={token}").partition("Set-Cookie: ")[2].partition(";")[0]
        assert self.cookie
        self.own = {"Origin": f"http://{self.host}", "Cookie": self.cookie, "Content-Type": "application/json"}

    def printed(self) -> str:
        return self.err.read_text() + self.out.read_text()

    def connect(self, data: bytes = b"", receives: int = 1 << 16, timeout_s: float = 30) -> socket.socket:
        raw = socket.socket()
        raw.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receives)
        raw.settimeout(timeout_s)
        raw.connect(("127.0.0.1", int(self.port)))
        with suppress(OSError):  # what is refused early is not read to its end
            raw.sendall(data)
        return raw

    def raw(self, data: bytes, *, is_all: bool = False) -> str:
        """Return the answer, of a stream the first parts; empty if the connection is only closed."""
        answer = b""
        with self.connect(data) as raw, suppress(ConnectionResetError):
            if is_all:
                raw.shutdown(socket.SHUT_WR)
            while not (b"event-stream" in answer and answer.count(b"\n\n") > 2) and (piece := raw.recv(1 << 16)):
                answer += piece
        return answer.decode("utf-8", "replace")

    def head(self, method: str, target: str, **lines: str) -> bytes:
        """Return a head with more lines, "-" for none; the names of `known` may stand in all of it."""
        known = {"host": self.host, "port": self.port, "other": int(self.port) + 1, "token": self.token}
        shown = [f"{name}: {value}" for name, value in ({"Host": "{host}"} | lines).items() if value != "-"]
        text = "\r\n".join([f"{method} {target} HTTP/1.1", *shown, "", ""])
        return text.format(**known, TOKEN=self.token.swapcase()).encode()

    def ask(self, method: str, target: str, body: bytes = b"", **lines: str) -> str:
        return self.raw(self.head(method, target, **({"Content-Length": str(len(body))} | lines)) + body)

    def do(self, body: bytes, **lines: str) -> str:
        return self.ask("POST", "/do", body, **(self.own | lines))

    def unfinished(self, size: int, sent: int) -> bytes:
        return self.head("POST", "/do", **self.own, **{"Content-Length": str(size)}) + b"x" * sent

    def parts(self) -> dict[str, Any]:
        found: dict[str, Any] = {}
        for line in re.findall(r"^data: (\{.*\})$", self.ask("GET", "/parts", Cookie=self.cookie), re.MULTILINE):
            found |= json.loads(line)
        return {name: part for name, part in found.items() if part}

    def stop_s(self, has_stopped: Callable[[], object] | None = None) -> float:
        """Press Stop as a browser does; return after how many seconds the program has it."""
        before, begin_s = self.printed().count(" stop\n"), time.monotonic()
        with self.connect(self.unfinished(28, 0) + b'{"name":"stop","value":null}'):
            while not (has_stopped() if has_stopped else self.printed().count(" stop\n") > before):
                assert time.monotonic() < begin_s + 20, self.printed()[-2000:]
                time.sleep(0.005)
        return time.monotonic() - begin_s

    def memory_MB(self) -> float:
        return int(Path(f"/proc/{self.process.pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6

    def descriptors(self) -> list[str]:
        links = []
        for link in Path(f"/proc/{self.process.pid}/fd").iterdir():
            with suppress(OSError):
                links.append(str(link.readlink()))
        return links

    def listens_at(self) -> list[tuple[str, str]]:
        """Return the sockets at which the process listens: table of the kernel, and port; none of a Unix socket."""
        own, found = {link[8:-1] for link in self.descriptors() if link.startswith("socket:[")}, []
        for table, state in (("tcp", "0A"), ("tcp6", "0A"), ("udp", "07"), ("udp6", "07")):
            rows = [line.split() for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]]
            found += [(table, str(int(row[1].split(":")[1], 16))) for row in rows if row[9] in own and row[3] == state]
        rows = [line.split() for line in Path("/proc/net/unix").read_text().splitlines()[1:]]
        return found + [("unix", "") for row in rows if row[6] in own and row[3] == "00010000"]

    def is_well(self) -> None:
        """Raise if the process has ended, or has printed a traceback since this was asked last."""
        assert self.process.poll() is None
        new = self.err.read_text()[len(self.known) :]
        self.known += new
        assert "Traceback" not in new


def served(folder: Path, hook: str = "") -> Attacked:
    """Serve the page above, in whose drawing `hook` happens too."""
    command = [sys.executable, "-c", PAGE.replace("HOOK", hook)]
    return Attacked(lambda **how: subprocess.Popen(command, stdin=subprocess.PIPE, text=True, **how), folder)
