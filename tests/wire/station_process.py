"""A station process and its control channel."""

import contextlib
import json
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Self

from tests.wire.waiting import LIMIT_S, wait_until

ROOT = Path(__file__).parents[2]


class StationProcess:
    """`python -m ftmocks station`, without sensor, imperfections and sensor errors unless the options say otherwise."""

    def __init__(self, *options: str) -> None:
        perfect = ("--imperfections", "none", "--gain", "0", "--cross-talk", "0")
        self._options = ("--sensor", "none", *perfect, *options)
        self.host = ""
        self.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        self.kill()

    def start(self) -> None:
        """Start it, on the address it had before."""
        host = ("--host", self.host) if self.host else ()
        self.process = subprocess.Popen(
            [sys.executable, "-m", "ftmocks", "station", *self._options, *host],
            cwd=ROOT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        try:
            self.hello = self._answer()
            self.host = self.hello["arm"]["host"]
        except BaseException:
            self.kill()
            raise

    def say(self, line: str) -> dict[str, Any]:
        assert self.process.stdin
        self.process.stdin.write(line + "\n")
        self.process.stdin.flush()
        return self._answer()

    def refusal(self, do: str, **how: Any) -> str:
        """Why a request is refused."""
        why: str = self.say(json.dumps({"do": do, **how}))["error"]
        return why

    def ask(self, do: str, **how: Any) -> dict[str, Any]:
        answer = self.say(json.dumps({"do": do, **how}))
        assert "error" not in answer, answer
        return answer

    def wait_for(self, condition: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        """Wait for a state and return it."""
        deadline_s = time.monotonic() + LIMIT_S
        while not condition(state := self.ask("state")):
            assert time.monotonic() < deadline_s, state
            time.sleep(0.01)
        return state

    def wait_for_event(self, what: str, *, accepted: bool = True, since: int = 0) -> dict[str, Any]:
        """Wait for the first such event."""

        def found() -> list[dict[str, Any]]:
            return [event for event in self.events(what, since) if event["accepted"] is accepted]

        wait_until(lambda: bool(found()))
        return found()[0]

    def events(self, what: str, since: int = 0) -> list[dict[str, Any]]:
        return [event for event in self.ask("state", since=since)["events"] if event["what"] == what]

    def connect(self, port: int) -> socket.socket:
        return socket.create_connection((self.host, port), LIMIT_S)

    def quit(self) -> int:
        """Close its standard input and return its exit code."""
        assert self.process.stdin
        with contextlib.suppress(BrokenPipeError):
            self.process.stdin.close()
        return self.process.wait(LIMIT_S)

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()
        for pipe in (self.process.stdin, self.process.stdout):
            if pipe:
                with contextlib.suppress(BrokenPipeError):
                    pipe.close()

    def _answer(self) -> dict[str, Any]:
        assert self.process.stdout
        answer: dict[str, Any] = json.loads(self.process.stdout.readline())
        return answer
