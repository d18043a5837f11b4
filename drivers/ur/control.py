"""The parent's side of the process that moves the arm: requests with a time-out, and SIGKILL for one that hangs.

Ref: ur_rtde 1.6.5. Its control interface hangs for 301 s on a lost link, or ends its process with SIGSEGV, so it must
not live in ours.
"""

import json
import logging
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from queue import Empty, SimpleQueue
from typing import IO, Any, Final, cast

from drivers.errors import DeviceTimeout, DriverError, StreamBroken
from drivers.ur import control_child

log = logging.getLogger(__name__)

_STARTING_S: Final = 4.5
_CALL_S: Final = 2.0
"""An answer takes 10 ms, or a hundred times that on a busy computer; motion is watched meanwhile by other means."""


class ControlProcess:
    """A disposable process with ur_rtde's control interface in it. Any thread may call."""

    def __init__(self, host: str, frequency_Hz: float) -> None:
        """Start the process; `wait_until_ready` before the first call."""
        self._host = host
        # By path and not by forking or importing, so that nothing of the application runs again; in a session of its
        # own, so that Ctrl-C or a closed terminal cannot end it before it has stopped the arm.
        self._process = subprocess.Popen(
            [sys.executable, "-P", control_child.__file__, host, str(frequency_Hz)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            encoding="utf-8",
            errors="replace",
            start_new_session=True,
        )
        self._requests = cast(IO[str], self._process.stdin)
        self._replies: SimpleQueue[dict[str, Any] | None] = SimpleQueue()
        self._lock = threading.RLock()  # re-entrant: a signal handler may stop the arm in the middle of a call
        self._last_id = 0
        self._gone = threading.Event()
        self._readers = [
            threading.Thread(target=read, args=(pipe,), name=f"ur-control-{read.__name__}", daemon=True)
            for read, pipe in ((self._read_replies, self._process.stdout), (self._read_talk, self._process.stderr))
        ]
        for reader in self._readers:
            reader.start()

    @property
    def pid(self) -> int:
        """Process id."""
        return self._process.pid

    @property
    def alive(self) -> bool:
        """Whether it can still be called."""
        return not self._gone.is_set()

    def wait_until_ready(self, look_out: Callable[[], object]) -> None:
        """Return when the control script runs on the controller. Raises what `call` and `look_out` raise.

        `look_out` is called about 20 times a second.
        """
        self._answer(0, _STARTING_S, look_out)

    def call(
        self,
        name: str,
        *args: object,
        timeout_s: float = _CALL_S,
        look_out: Callable[[], object] = lambda: None,
    ) -> Any:
        """Call one of `control_child.Calls`.

        Raises `StreamBroken` when the process is gone or says that the call failed, `DeviceTimeout` after killing
        one that hangs, and what `look_out` raises, which is called about 20 times a second until the answer comes.
        """
        with self._lock:
            self._last_id += 1
            try:
                self._requests.write(json.dumps({"id": self._last_id, "call": name, "args": args}) + "\n")
                self._requests.flush()
            except (OSError, ValueError):  # ValueError: closed by `kill`
                raise self._loss() from None
            return self._answer(self._last_id, timeout_s, look_out)

    def quit(self, *, timeout_s: float) -> bool:
        """Stop the arm, end its script and the process; whether all that was confirmed in time."""
        try:
            self.call("quit", timeout_s=timeout_s)
        except DriverError as error:
            log.debug("control of %s did not end by itself: %s", self._host, error)
            return False
        finally:
            self.kill()
        return True

    def kill(self) -> None:
        """End the process at once, whatever it does. The arm goes on with what it was told: stop it another way."""
        self._gone.set()
        self._process.kill()
        self._process.wait()
        for reader in self._readers:
            reader.join()  # the pipes have ended with the process
        for pipe in (self._process.stdin, self._process.stdout, self._process.stderr):
            if pipe is not None:
                with suppress(OSError):  # a request that was never read
                    pipe.close()

    def _answer(self, to: int, timeout_s: float, look_out: Callable[[], object]) -> Any:
        left_s = timeout_s
        while True:
            t0 = time.monotonic()
            try:
                reply = self._replies.get(timeout=max(min(left_s, 0.05), 0.0))
            except Empty:
                # A process that was itself suspended has not been waiting: that time does not count in full.
                left_s -= min(time.monotonic() - t0, 0.1)
                if left_s > 0:
                    look_out()
                    continue
                self.kill()
                raise DeviceTimeout(
                    f"ur_rtde did not answer within {timeout_s:.1f} s and its process was ended",
                    "check the robot and the network, then open the arm again",
                ) from None
            if reply is None:
                self._replies.put(None)  # for whoever asks next
                raise self._loss()
            if reply["id"] != to:
                continue  # the answer to a call that was interrupted
            if "error" in reply:
                cure = "check the robot and the cable, then open the arm again" if to else ""  # at the start: `UrArm`
                raise StreamBroken(f"ur_rtde says: {reply['error']}", cure)
            return reply["value"]

    def _loss(self) -> StreamBroken:
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(0.2)  # its pipe may close a moment before it is dead
        return StreamBroken(
            f"the process that controls {self._host} ended (exit code {self._process.returncode})",
            "check the robot, then open the arm again",
        )

    def _read_replies(self, pipe: IO[str]) -> None:
        for line in pipe:
            try:
                self._replies.put(json.loads(line))
            except ValueError:  # something at the interpreter's start-up may print
                log.info("not a reply: %s", line.rstrip())
        self._gone.set()
        self._replies.put(None)

    def _read_talk(self, pipe: IO[str]) -> None:
        for line in pipe:
            log.info("ur_rtde: %s", line.rstrip())
