"""The process that holds ur_rtde's control interface: from inside, with ur_rtde replaced, and from the parent."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

import pytest

from ftdrivers.ur import control_child
from tests.fake_clock import FakeClock
from tests.unit.drivers.ur.controller_in_memory import Controller

UNWATCHED_S = 0.5


class Requests(SimpleQueue[str | None]):
    """Requests that come at these times of the fake clock; then the end of stdin."""

    def __init__(self, clock: FakeClock, requests: list[tuple[float, str]]) -> None:
        self._clock = clock
        self._due = [
            (clock.now_s() + t_s, json.dumps({"id": k, "call": name, "args": [[0.0] * 6, 1.0, 2.0] * (name == "move")}))
            for k, (t_s, name) in enumerate(requests, 1)
        ]

    def get(self, _: bool = True, timeout: float | None = None) -> str | None:
        if not self._due:
            return None
        left_s = self._due[0][0] - self._clock.now_s()
        if timeout is not None and left_s > timeout:
            self._clock.advance(timeout)
            raise Empty
        self._clock.advance(max(0.0, left_s))
        return self._due.pop(0)[1]


def served(controller: Controller, requests: list[tuple[float, str]]) -> list[Any]:
    """Serve these requests; return the values of the answers."""
    answers: list[dict[str, Any]] = []
    serve: Callable[..., None] = control_child.serve
    serve(
        control_child.Calls(controller, 2.5),
        Requests(controller.clock, requests),
        lambda **answer: answers.append(answer),
        UNWATCHED_S,
    )
    assert [answer["id"] for answer in answers] == list(range(1, len(requests) + 1))
    return [answer["value"] for answer in answers]


@pytest.mark.parametrize(("gap_s", "stopped"), [(0.49, False), (0.51, True), (60.0, True)])
def test_a_move_that_no_caller_watches_is_stopped(controller: Controller, gap_s: float, stopped: bool) -> None:
    times = [(0.0, "move"), (0.1, "progress"), (0.1 + gap_s, "progress")]
    assert served(controller, times) == [True, (False, False), (stopped, stopped)]
    assert ("stop softly" in controller.did) == stopped


def test_a_move_that_had_ended_before_anybody_could_ask_was_not_stopped(controller: Controller) -> None:
    controller.clock.at(0.3, lambda: setattr(controller, "goal_rad", None))
    assert served(controller, [(0.0, "move"), (60.0, "progress")]) == [True, (True, False)]
    assert controller.did == ["move"]


LIBRARY = """
import threading

class RTDEControlInterface:
    FLAG_UPLOAD_SCRIPT, FLAG_NO_EXT_FT = 1, 2

    def __init__(self, hostname, **how):
        if hostname == "hangs":
            threading.Event().wait()

    def getAsyncOperationProgressEx(self):
        return self

    def isAsyncOperationRunning(self):
        return False

    def stopScript(self):
        threading.Event().wait()
"""


@pytest.mark.slow
@pytest.mark.parametrize(("host", "starting_s", "leaving_s"), [("hangs", "0.2", "60"), ("answers", "60", "0.2")])
def test_a_library_that_hangs_does_not_keep_its_process(
    host: str, starting_s: str, leaving_s: str, tmp_path: Path
) -> None:
    (tmp_path / "rtde_control.py").write_text(LIBRARY)
    with subprocess.Popen(
        [sys.executable, "-P", control_child.__file__, host, "125", "5", starting_s, leaving_s, "0.5"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env=os.environ | {"PYTHONPATH": str(tmp_path)},
    ) as child:
        try:
            if host == "answers":
                assert child.stdout is not None
                assert child.stdout.readline() == b'{"id": 0, "value": null}\n'
                assert child.stdin is not None
                child.stdin.close()
            assert child.wait(60) == -signal.SIGALRM
        finally:
            child.kill()
