"""The control path `ur-rtde`, as seen from the parent process: requests with a time-out, and SIGKILL after it.

Ref: ur_rtde 1.6.5. Its control interface hangs for 301 s after a lost connection, or ends its process with SIGSEGV.
Therefore it runs in a separate process.
"""

import json
import logging
import subprocess
import sys
import threading
from contextlib import suppress
from typing import IO, Any, Final, cast

from ftdrivers.clock import Clock
from ftdrivers.errors import DeviceTimeout, StreamBroken
from ftdrivers.ur import control_child
from ftdrivers.ur.control import Control, LookOut
from ftdrivers.ur.timing import Patience, UrTiming, held

log = logging.getLogger(__name__)

INPUTS: Final = (
    *(f"input_int_register_{k}" for k in range(8)),
    *(f"input_double_register_{k}" for k in range(18)),
)
"""RTDE inputs that ur_rtde's control interface reserves."""
PROGRAM_PORT: Final = 30003
"""TCP port to which ur_rtde sends its program."""
# Rate of ur_rtde's own connection, Hz: the full rate of the CB3 generation.
_FREQUENCY_HZ: Final = 125.0


class ControlProcess(Control):
    """A process with ur_rtde's control interface, which can be killed at any time."""

    def __init__(self, host: str, stop_rad_s2: float, *, clock: Clock, timing: UrTiming) -> None:
        """Start the process; call `wait_until_ready` before `call`."""
        self._host = host
        self._clock = clock
        self._timing = timing
        arguments = (_FREQUENCY_HZ, stop_rad_s2, timing.child_starting_s, timing.child_leaving_s, timing.unwatched_s)
        # The process is started by path, so that it runs no code of the application, and in a session of its own, so
        # that Ctrl-C or a closed terminal cannot end it before it has stopped the arm.
        self._process = subprocess.Popen(
            [sys.executable, "-P", control_child.__file__, host, *map(str, arguments)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            encoding="utf-8",
            errors="replace",
            start_new_session=True,
        )
        self._requests = cast(IO[str], self._process.stdin)
        self._changed = threading.Condition()
        self._replies: dict[int, dict[str, Any]] = {}
        self._lock = threading.RLock()  # re-entrant, because a signal handler may stop the arm during a call
        self._last_id = 0
        self._ended = False  # true when no further reply can come
        self._killed = False
        self._readers = [
            threading.Thread(target=read, args=(pipe,), name=f"ur-control-{read.__name__}", daemon=True)
            for read, pipe in ((self._read_replies, self._process.stdout), (self._log_output, self._process.stderr))
        ]
        for reader in self._readers:
            reader.start()

    @property
    def alive(self) -> bool:
        """Whether the control process accepts calls."""
        return not (self._ended or self._killed)

    def wait_until_ready(self, look_out: LookOut) -> None:
        """Return when the control script runs on the controller. Raises the exceptions of `call` and `look_out`."""
        self._answer(0, self._timing.starting_s, look_out)

    def call(self, name: str, *args: object, timeout_s: float | None = None, look_out: LookOut = lambda: None) -> Any:
        """Send a request to the process and wait for its reply, see `Control`."""
        with held(self._lock, self._clock):
            self._last_id += 1
            request = self._last_id
            try:
                self._requests.write(json.dumps({"id": request, "call": name, "args": args}) + "\n")
                self._requests.flush()
            except (OSError, ValueError):  # ValueError: closed by `kill`
                raise self._loss() from None
            return self._answer(request, self._timing.call_s if timeout_s is None else timeout_s, look_out)

    def kill(self) -> None:
        """Kill the process. The arm finishes its last command unless it is stopped through the dashboard server."""
        self._killed = True
        self._process.kill()
        self._process.wait()
        for reader in self._readers:
            reader.join()  # the pipes have ended with the process
        for pipe in (self._process.stdin, self._process.stdout, self._process.stderr):
            if pipe is not None:
                with suppress(OSError):  # a request was not read by the process
                    pipe.close()

    def _answer(self, to: int, timeout_s: float, look_out: LookOut) -> Any:
        patience = Patience(self._clock, timeout_s)
        while True:
            with self._changed:
                if to not in self._replies and not self._ended and not patience.is_over:
                    patience.wait(self._changed)
                reply = self._replies.pop(to, None)
                ended = self._ended
            if reply is not None:
                if "error" in reply:
                    fix = (
                        "check the robot and the cable, then open the arm again" if to else ""
                    )  # `UrArm` fills in an empty fix
                    raise StreamBroken(f"ur_rtde reports: {reply['error']}", fix)
                return reply["value"]
            if ended:
                raise self._loss()
            if patience.is_over:
                self.kill()
                raise DeviceTimeout(
                    f"ur_rtde did not answer within {timeout_s:.1f} s, so its process was killed",
                    "check the robot and the network, then open the arm again",
                )
            look_out()

    def _loss(self) -> StreamBroken:
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(0.2)  # pipes may close before the process ends
        return StreamBroken(
            f"the process that controls {self._host} ended (exit code {self._process.returncode})",
            "check the robot, then open the arm again",
        )

    def _read_replies(self, pipe: IO[str]) -> None:
        for line in pipe:
            try:
                reply = json.loads(line)
            except ValueError:  # a module may print when the interpreter starts
                log.info("not a reply: %s", line.rstrip())
                continue
            with self._changed:
                self._replies[reply["id"]] = reply
                self._changed.notify_all()
        with self._changed:
            self._ended = True
            self._changed.notify_all()

    def _log_output(self, pipe: IO[str]) -> None:
        for line in pipe:
            log.info("ur_rtde: %s", line.rstrip())
