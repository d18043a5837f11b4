"""What a control path does, and the path ur-rtde, whose library runs in a process of its own.

Ref: ur_rtde 1.6.5. Its control interface hangs for 301 s on a lost link, or ends its process with SIGSEGV, so it must
not live in ours.
"""

import json
import logging
import subprocess
import sys
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import suppress
from math import radians
from typing import IO, Any, Final, Literal, cast

from ftdrivers.clock import Clock
from ftdrivers.errors import ConnectError, DeviceError, DeviceTimeout, StreamBroken
from ftdrivers.ur import control_child
from ftdrivers.ur.timing import Patience, UrTiming, held

log = logging.getLogger(__name__)

ControlPath = Literal["ur-rtde", "script"]
ControlSetting = Literal["auto", "ur-rtde", "script"]
CONTROL_SETTINGS: Final[tuple[ControlSetting, ...]] = ("auto", "ur-rtde", "script")

# 300 °/s² is the most that UR's staff recommend for a joint; from 60 °/s the arm turns 1.8° less than at 4 rad/s².
STOP_RAD_S2: Final = radians(300)
"""Default deceleration of a stop: the most that UR's staff recommend for joints. UR's own programs stop with 2 to 4."""

LookOut = Callable[[], object]
"""Called about 20 times a second during a wait; may raise."""


class ProgramRefused(ConnectError):
    """The controller did not take our program, so none of ours runs there."""


class Control(ABC):
    """A program of ours on the controller, and the link to it. Any thread may call.

    A constructor connects or starts what is needed on this computer. It returns before a program can run.
    """

    stops_itself = False
    """Whether the program stops the arm and ends when the link is lost. Only such a program follows a sweep."""

    @property
    @abstractmethod
    def alive(self) -> bool:
        """Whether it accepts calls."""

    @property
    def has_ended(self) -> bool:
        """Whether our program has reported its end, so that a program on the controller is not ours."""
        return False

    @abstractmethod
    def wait_until_ready(self, look_out: LookOut) -> None:
        """Return when our program runs on the controller. Raises what `call` and `look_out` raise."""

    @abstractmethod
    def call(self, name: str, *args: object, timeout_s: float | None = None, look_out: LookOut = lambda: None) -> Any:
        """Call one of the methods of `control_child.Calls`, within `call_s` of the timing if no time-out is given.

        Raises `StreamBroken` when the link is gone or the call failed, `DeviceTimeout` after `kill` of a link that
        hangs, and the errors of `look_out`.
        """

    def quit(self, *, timeout_s: float) -> bool:
        """Stop the arm, end our program and the link; return whether that was confirmed in time."""
        try:
            self.call("quit", timeout_s=timeout_s)
        except DeviceError as error:
            log.debug("our program did not end by itself: %s", error)
            return False
        finally:
            self.kill()
        return True

    @abstractmethod
    def kill(self) -> None:
        """End the link at once, whatever the program does. Idempotent."""

    def end_reason(self) -> DeviceError | None:
        """Return why our program has ended, if that is known."""
        return None

    def explained(self, error: DeviceError) -> DeviceError:
        """Return the error of a lost controller, with what the arm does about it."""
        return error


INPUTS: Final = (
    *(f"input_int_register_{k}" for k in range(8)),
    *(f"input_double_register_{k}" for k in range(18)),
)
"""The RTDE inputs that ur_rtde's control interface writes, exclusively."""
PROGRAM_PORT: Final = 30003
"""To which ur_rtde sends its program."""
# Rate of ur_rtde's own connection: the full rate of the CB3 generation.
_FREQUENCY_HZ: Final = 125.0


class ControlProcess(Control):
    """A disposable process with ur_rtde's control interface."""

    def __init__(self, host: str, stop_rad_s2: float, *, clock: Clock, timing: UrTiming) -> None:
        """Start the process; call `wait_until_ready` before `call`."""
        self._host = host
        self._clock = clock
        self._timing = timing
        arguments = (_FREQUENCY_HZ, stop_rad_s2, timing.child_starting_s, timing.child_leaving_s, timing.unwatched_s)
        # Started by path, so that no code of the application runs in it. In its own session, so that Ctrl-C or a closed
        # terminal cannot end it before it has stopped the arm.
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
        self._lock = threading.RLock()  # re-entrant: a signal handler may stop the arm during a call
        self._last_id = 0
        self._ended = False  # its last reply has been read
        self._killed = False
        self._readers = [
            threading.Thread(target=read, args=(pipe,), name=f"ur-control-{read.__name__}", daemon=True)
            for read, pipe in ((self._read_replies, self._process.stdout), (self._log_output, self._process.stderr))
        ]
        for reader in self._readers:
            reader.start()

    @property
    def alive(self) -> bool:
        """Whether it accepts calls."""
        return not (self._ended or self._killed)

    def wait_until_ready(self, look_out: LookOut) -> None:
        """Return when the control script runs on the controller. Raises what `call` and `look_out` raise."""
        self._answer(0, self._timing.starting_s, look_out)

    def call(self, name: str, *args: object, timeout_s: float | None = None, look_out: LookOut = lambda: None) -> Any:
        """Send a request to the process and wait for its reply; see `Control`."""
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
        """Kill the process. The arm finishes its last command, so stop it through the dashboard server."""
        self._killed = True
        self._process.kill()
        self._process.wait()
        for reader in self._readers:
            reader.join()  # the pipes have ended with the process
        for pipe in (self._process.stdin, self._process.stdout, self._process.stderr):
            if pipe is not None:
                with suppress(OSError):  # an unread request
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
                    fix = "check the robot and the cable, then open the arm again" if to else ""  # `UrArm` adds one
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
            self._process.wait(0.2)  # its pipe may close before the process ends
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
