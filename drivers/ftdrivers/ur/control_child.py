"""The process that runs ur_rtde's `RTDEControlInterface`. It is started by its path and imports no module of ftdrive.

Requests and replies are lines of JSON on stdin and stdout. When stdin ends, this process stops the arm, ends the
control script and exits. SIGALRM ends the process if ur_rtde hangs. The process also stops the arm if the parent, which
may be suspended, sends no request for too long during a move.

Arguments: host, frequency in Hz, deceleration of a stop in rad/s², and three time-outs of `UrTiming` in seconds:
`child_starting_s`, `child_leaving_s` and `unwatched_s`.

Ref: ur_rtde 1.6.5, API reference of `RTDEControlInterface`.
Checked on hardware: no.
"""

import json
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from importlib import import_module
from queue import Empty, SimpleQueue
from typing import Protocol, cast


class _Progress(Protocol):
    def operationId(self) -> int: ...

    def isAsyncOperationRunning(self) -> bool: ...


# setWatchdog is not used, because it cannot be disabled while an operator reads a question, and has caused a protective
# stop (C207A0).
class _Control(Protocol):
    def moveJ(self, q: list[float], speed: float, acceleration: float, asynchronous: bool, /) -> bool: ...

    def getAsyncOperationProgressEx(self) -> _Progress: ...

    def stopJ(self, deceleration: float, /) -> None: ...

    def stopScript(self) -> None: ...

    def isJointsWithinSafetyLimits(self, q: list[float], /) -> bool: ...

    def getTCPOffset(self) -> list[float]: ...

    def setPayload(self, mass: float, cog: list[float], /) -> bool: ...

    def setTargetPayload(self, mass: float, cog: list[float], inertia: list[float], /) -> bool: ...

    def setGravity(self, direction: list[float], /) -> bool: ...

    def isProgramRunning(self) -> bool: ...

    def isConnected(self) -> bool: ...


class Calls:
    """Methods of this process that the parent process calls by name."""

    def __init__(self, control: _Control, stop_rad_s2: float) -> None:
        self._control = control
        self._stop_rad_s2 = stop_rad_s2
        self._before = 0
        self._unwatched = False
        self.moving = False
        """Whether the arm moves. The parent must then call `progress` regularly."""

    def move(self, q_rad: list[float], speed_rad_s: float, acceleration_rad_s2: float) -> bool:
        """Start a move; return whether the controller accepted it."""
        self._before = self._control.getAsyncOperationProgressEx().operationId()
        self._unwatched = False
        self.moving = self._control.moveJ(q_rad, speed_rad_s, acceleration_rad_s2, True)
        return self.moving

    def progress(self) -> tuple[bool, bool]:
        """Return whether the move has ended, and whether it was stopped because the parent did not watch it."""
        progress = self._control.getAsyncOperationProgressEx()
        if not self._control.isConnected():  # without this check, a lost connection would look like an arrival
            raise RuntimeError("the control connection was lost")
        ended = progress.operationId() != self._before and not progress.isAsyncOperationRunning()
        self.moving = self.moving and not ended
        return ended, self._unwatched

    def stop_unwatched(self) -> None:
        """Stop a move that the parent has not watched for too long, because a guard may hang."""
        time.sleep(0.02)  # if this process was suspended, ur_rtde first has to receive the newest state
        ended, _ = self.progress()
        if not ended:
            self._unwatched = True
            self.stop()

    def stop(self) -> None:
        """Decelerate all joints and wait for standstill.

        The asynchronous stop of ur_rtde decelerates the tool instead of the joints, which fails at a singularity.
        """
        self.moving = False
        self._control.stopJ(self._stop_rad_s2)

    def within_safety_limits(self, q_rad: list[float]) -> bool:
        """Return whether the controller accepts these joint angles."""
        if self._control.isProgramRunning() and self._control.isJointsWithinSafetyLimits(q_rad):
            return True
        if self._control.isProgramRunning() and self._control.isConnected():
            return False
        raise RuntimeError("the control program is not running")  # ur_rtde would return False

    def tcp_offset(self) -> list[float]:
        """Return the pose (6,) of the active TCP in the flange."""
        return self._control.getTCPOffset()

    def set_payload(self, mass_kg: float, com_m: list[float], inertia_kg_m2: list[float] | None) -> bool:
        """Set the payload; return whether that succeeded. Without an inertia, the older command resets the inertia."""
        if inertia_kg_m2 is None:
            return self._control.setPayload(mass_kg, com_m)
        return self._control.setTargetPayload(mass_kg, com_m, inertia_kg_m2)

    def set_gravity(self, up_base_m_s2: list[float]) -> bool:
        """Set gravity in the controller; return whether that succeeded."""
        return self._control.setGravity(up_base_m_s2)

    def quit(self) -> None:
        """Stop the arm and end the control script, which would otherwise continue on the controller."""
        if self._control.getAsyncOperationProgressEx().isAsyncOperationRunning():
            self.stop()
        self._control.stopScript()


def _main() -> None:
    host = sys.argv[1]
    frequency_Hz, stop_rad_s2, starting_s, leaving_s, unwatched_s = map(float, sys.argv[2:])
    replies = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # the output of the C++ library must not mix with the replies

    def reply(**content: object) -> None:
        with suppress(OSError):  # the parent has ended; reading stdin will show it
            replies.write(json.dumps(content) + "\n")
            replies.flush()

    signal.setitimer(signal.ITIMER_REAL, starting_s)
    try:
        interface = import_module("rtde_control").RTDEControlInterface
        # rt_priority: by default the library gives this thread real-time priority, although it waits in a busy loop.
        # FLAG_NO_EXT_FT: another client may use this input to send readings of a sensor to the controller.
        flags = int(interface.FLAG_UPLOAD_SCRIPT) | int(interface.FLAG_NO_EXT_FT)
        control = cast(_Control, interface(hostname=host, frequency=frequency_Hz, flags=flags, rt_priority=-1))
    except Exception as error:
        reply(id=0, error=str(error))
        os._exit(1)
    signal.setitimer(signal.ITIMER_REAL, 0)
    calls = Calls(control, stop_rad_s2)
    reply(id=0, value=None)

    requests: SimpleQueue[str | None] = SimpleQueue()
    threading.Thread(target=_listen, args=(requests, leaving_s), daemon=True).start()
    serve(calls, requests, reply, unwatched_s)
    with suppress(Exception):
        calls.quit()
    os._exit(0)  # the normal shutdown of the library takes 0.5 s and may crash


def serve(calls: Calls, requests: "SimpleQueue[str | None]", reply: Callable[..., None], unwatched_s: float) -> None:
    """Answer the requests of the parent process until None is received."""
    while True:
        try:
            line = requests.get(timeout=unwatched_s if calls.moving else None)
        except Empty:
            with suppress(Exception):  # if this stop fails, a suspended parent stops the arm when it resumes
                calls.stop_unwatched()
            continue
        if line is None:
            return
        request = json.loads(line)
        call = cast(Callable[..., object], getattr(calls, request["call"]))
        try:
            reply(id=request["id"], value=call(*request["args"]))
        except Exception as error:  # the library may raise any exception; the parent handles it
            reply(id=request["id"], error=str(error))


def _listen(requests: "SimpleQueue[str | None]", leaving_s: float) -> None:
    # If the parent was killed, stdin ends, and this ends the control script within 0.5 s.
    for line in sys.stdin:
        requests.put(line)
    signal.setitimer(signal.ITIMER_REAL, leaving_s)
    requests.put(None)


if __name__ == "__main__":
    _main()
