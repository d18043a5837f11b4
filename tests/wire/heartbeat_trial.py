"""One trial of the heartbeat: the computer that moves the arm fails in mid-move, and the controller is watched.

The victim is a process of its own. Everything that is measured comes from the event log of the emulated controller.
"""

import multiprocessing
import os
import signal
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import Final

from ftdrive.cell.emulated_clock import EmulatedClock
from ftdrivers.clock import REAL, Clock
from ftdrivers.errors import DeviceError
from ftdrivers.ur.arm import UrArm
from ftdrivers.ur.control_child import DECELERATION_RAD_S2
from ftdrivers.ur.timing import UrTiming
from tests.wire.conftest import Station

KINDS: Final = ("killed", "suspended", "network", "power")
SPEED_RAD_S: Final = 0.5
STEP_RAD: Final = 2.5
WITHIN_S: Final = 0.3
PERIOD_S: Final = 0.008
"""Between two heartbeats."""


def cut(station: Station, kind: str, pid: int) -> None:
    """Let the computer fail."""
    if kind == "suspended":
        os.kill(pid, signal.SIGSTOP)
        return
    if kind in {"network", "power"}:
        station.ask("silence-arm", on=True)  # in both directions; the end of a client is not noticed
    if kind in {"killed", "power"}:
        os.kill(pid, signal.SIGKILL)


def victim(host: str, page: str | None, ready: Connection) -> None:
    """Move joint 6 back and forth until this process fails."""
    clock: Clock = REAL if page is None else EmulatedClock(page)
    timing = UrTiming() if page is None else UrTiming.emulated()
    arm = UrArm(host, speed_rad_s=SPEED_RAD_S, acceleration_rad_s2=4.0, control="script", clock=clock, timing=timing)
    with suppress(DeviceError):
        arm.open(control=True)
        q = arm.state().q_rad.tolist()
        q[5] += STEP_RAD if q[5] < 0 else -STEP_RAD
        ready.send(q[5])
        arm.move_to(q, timeout_s=30, guard=lambda: None)
    os._exit(0)


def trial(station: Station, kind: str, delay_s: float, *, real_clock: bool) -> float | None:
    """Return after how long the arm decelerated, from the last heartbeat; None when it had stopped before.

    The controller's log has the failure and the standstill; braking from a constant speed is subtracted. The last
    heartbeat was sent at most one period before the failure, which is added. A busy computer may stop the arm before.

    Parameters
    ----------
    station : Station
    kind : one of `KINDS`
    delay_s : float
        Of the failure, after the arm has begun to move.
    real_clock : bool
        Whether the victim keeps the computer's time, so that the cell does not wait for it.
    """
    begin = len(station.ask("state")["events"])
    ready, theirs = multiprocessing.Pipe()
    page = None if real_clock else station.hello["clock"]
    process = multiprocessing.get_context("fork").Process(target=victim, args=(station.host, page, theirs))
    process.start()
    theirs.close()
    assert process.pid is not None
    try:
        try:
            goal_rad = ready.recv()
        except EOFError:
            return None
        station.wait_for_event("moves", since=begin)
        station.clock.sleep(delay_s)
        cut_ns = station.clock.now_ns()
        cut(station, kind, process.pid)
        stood = station.wait_for_event("stands", since=begin)
        state = station.wait_for(lambda state: state["runtime_state"] == "STOPPED" and not state["moving"])
        assert abs(state["q_rad"][5] - goal_rad) > 0.1, "the move went on to its end"
    finally:
        with suppress(ProcessLookupError):
            os.kill(process.pid, signal.SIGKILL)
        process.join()
        station.ask("silence-arm", on=False)
    braking_s = SPEED_RAD_S / DECELERATION_RAD_S2
    decelerates_s = (stood["t_host_ns"] - cut_ns) / 1e9 - braking_s
    return None if decelerates_s < 0 else decelerates_s + PERIOD_S
