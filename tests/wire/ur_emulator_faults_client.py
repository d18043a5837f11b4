"""Faults played to the unmodified ur_rtde, one scenario per process: ``python ur_emulator_faults_client.py NAME HOST``.

Some end in a crash or never: every fact is printed when it is known, as a line ``@fact {...}``. A line ``@ask {...}``
asks the test for something (a verb of the station, or one of its own) and reads the answer from standard input.
"""

import json
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from importlib import import_module
from typing import Any

from dashboard_client import DashboardClient
from rtde_control import RTDEControlInterface
from rtde_receive import RTDEReceiveInterface

FACTS = os.fdopen(os.dup(1), "w", encoding="utf-8")
os.dup2(2, 1)  # what the C++ library prints must not come between the facts
LIMIT_S = 30.0
"""Whatever must happen has happened by then."""
HANGS_S = 1.5
"""What has not ended by then hangs."""

BROKEN_PROGRAM: dict[str, dict[str, Any]] = {
    "crash-script": {},
    "dashboard-stop": {},
    "protective-stop": {},
    "emergency-stop": {},
    "safeguard": {},
    "mode": {"robot": 5},
}
"""What ends or holds the program, and with which arguments."""


def ask(**request: Any) -> dict[str, Any]:
    FACTS.write("@ask " + json.dumps(request) + "\n")
    FACTS.flush()
    answer: dict[str, Any] = json.loads(sys.stdin.readline())
    return answer


def report(**facts: Any) -> None:
    FACTS.write("@fact " + json.dumps(facts) + "\n")
    FACTS.flush()


def wait_for(condition: Callable[[], bool], timeout_s: float = LIMIT_S) -> bool:
    end = time.monotonic() + timeout_s
    while time.monotonic() < end:
        if condition():
            return True
        time.sleep(0.002)
    return False


def failure(call: Callable[[], Any]) -> str | None:
    try:
        call()
    except RuntimeError as error:
        return str(error)
    return None


class Move(threading.Thread):
    """A blocking moveJ of the last joint, in a thread of its own; wait until it is under way."""

    def __init__(
        self, receive: Any, control: Any, way_rad: float = 1.0, speed_rad_s: float = 0.02, *, wait: bool = True
    ) -> None:
        super().__init__(daemon=True)
        self._control, self._speed_rad_s = control, speed_rad_s
        self.goal = receive.getTargetQ()
        self.goal[5] += way_rad
        self.returned: bool | None = None
        self.start()
        if wait:
            report(moving=wait_for(lambda: abs(receive.getTargetQd()[5]) > 1e-3))

    def run(self) -> None:
        self.returned = self._control.moveJ(self.goal, self._speed_rad_s, 2.0)

    def ends(self) -> bool:
        self.join(LIMIT_S)
        return not self.is_alive()

    def hangs(self) -> bool:
        self.join(HANGS_S)
        return self.is_alive()


# -- loss of the server -----------------------------------------------------------------------------------------------


def killed(host: str) -> None:
    """Killed while idle, restarted on the same address."""
    r, c = RTDEReceiveInterface(host), RTDEControlInterface(host)
    q, stamp = r.getActualQ(), r.getTimestamp()
    ask(do="kill")
    report(receive_lost=wait_for(lambda: not r.isConnected()), control_lost=wait_for(lambda: not c.isConnected()))
    report(last_values=r.getActualQ() == q and r.getTimestamp() >= stamp, program_seems_to_run=c.isProgramRunning())
    ask(do="restart")
    report(receive_back=r.reconnect(), control_back=c.reconnect())
    report(moves=c.moveJ([*q[:5], q[5] + 0.1], 1.0, 2.0))


def killed_moving(host: str) -> None:
    """Killed in a blocking move, and restarted: the call does not notice."""
    r, c = RTDEReceiveInterface(host), RTDEControlInterface(host)
    move = Move(r, c)
    ask(do="kill")
    report(receive_lost=wait_for(lambda: not r.isConnected()))
    report(hangs_after_the_kill=move.hangs())
    ask(do="restart")
    report(hangs_after_the_restart=move.hangs())


def command_after_loss(host: str) -> None:
    """A command on a dead link neither fails nor returns."""
    r, c = RTDEReceiveInterface(host), RTDEControlInterface(host)
    ask(do="kill")
    wait_for(lambda: not c.isConnected())
    goal = r.getTargetQ()
    call = threading.Thread(target=lambda: c.moveJ(goal), daemon=True)
    call.start()
    call.join(HANGS_S)
    report(connected=c.isConnected(), hangs=call.is_alive())


# -- trouble on the link ----------------------------------------------------------------------------------------------


def dropped_moving(host: str) -> None:
    """RTDE gone for good in a blocking move, dashboard alive: the call hangs, the robot finishes."""
    r, c = RTDEReceiveInterface(host), RTDEControlInterface(host)
    move = Move(r, c, 0.4, 0.2)
    ask(do="listen", what="rtde", on=False)
    ask(do="drop", what="rtde", reset=True)
    report(lost=wait_for(lambda: not r.isConnected()))
    report(robot_finishes=wait_for(lambda: abs(ask(do="state")["q_rad"][5] - move.goal[5]) < 1e-3))
    report(hangs=move.hangs())


def dropped_without_dashboard(host: str) -> None:
    """RTDE and dashboard gone: one attempt, then it stays disconnected; reconnect works when they are back."""
    r, c = RTDEReceiveInterface(host), RTDEControlInterface(host)
    ask(do="listen", what="dashboard", on=False)
    ask(do="drop", what="dashboard")
    ask(do="drop", what="rtde")
    report(lost=wait_for(lambda: not r.isConnected() and not c.isConnected()))
    ask(do="listen", what="dashboard", on=True)
    report(back=r.reconnect() and c.reconnect(), moves=c.moveJ(r.getTargetQ()))


def briefly_silent(host: str) -> None:
    """No samples for 1.5 s: no client notices, a blocking move ends well."""
    r, c = RTDEReceiveInterface(host), RTDEControlInterface(host)
    move = Move(r, c, 0.4, 0.2)
    ask(do="silent", what="rtde", on=True)
    stamp = r.getTimestamp()
    time.sleep(1.5)
    report(same_stamp=r.getTimestamp() - stamp < 0.05, connected=[r.isConnected(), c.isConnected()])
    ask(do="silent", what="rtde", on=False)
    report(ended=move.ends(), returned=move.returned)


def silent(host: str) -> None:
    """No samples for more than 2.5 s, but answers. When they come back, the control client may crash."""
    r, c = RTDEReceiveInterface(host), RTDEControlInterface(host)
    move = Move(r, c)
    begun = time.monotonic()
    ask(do="silent", what="rtde", on=True, answers=True)
    report(ended=move.ends(), returned=move.returned, after_s=time.monotonic() - begun)
    report(receive_lost=wait_for(lambda: not r.isConnected()))
    report(control_says_connected=c.isConnected(), program_runs=c.isProgramRunning())


def frozen(host: str) -> None:
    """Everything stands for more than 2.5 s: the blocking move hangs, even afterwards."""
    r, c = RTDEReceiveInterface(host), RTDEControlInterface(host)
    move = Move(r, c)
    begun = time.monotonic()
    ask(do="freeze", on=True)
    report(receive_lost=wait_for(lambda: not r.isConnected()), after_s=time.monotonic() - begun)
    time.sleep(2.8)  # the banner of its one attempt to reconnect must not come within 2.5 s
    ask(do="freeze", on=False)
    report(hangs=move.hangs(), receive_back=r.reconnect())


# -- the program goes away --------------------------------------------------------------------------------------------


def broken_program(host: str) -> None:
    """Whatever ends or holds the program: the blocking move returns False at once, and so does all that follows."""
    d = DashboardClient(host)
    d.connect()
    r, c = RTDEReceiveInterface(host), RTDEControlInterface(host)
    for verb, how in BROKEN_PROGRAM.items():
        move = Move(r, c, 1.0, 0.004)
        ask(do=verb, **how)
        facts: dict[str, Any] = {"ended": move.ends(), "returned": move.returned}
        wait_for(lambda: r.getRuntimeState() != 2)
        facts["state"] = [r.getRuntimeState(), r.getSafetyMode(), r.getRobotMode(), r.getSafetyStatusBits()]
        facts["next"] = [c.moveJ(move.goal), c.isJointsWithinSafetyLimits(move.goal), failure(c.getTCPOffset)]
        report(**{verb: facts})
        if verb == "emergency-stop":
            ask(do="emergency-stop", on=False)
            d.powerOn()
            d.brakeRelease()
        if verb == "protective-stop":
            wait_for(lambda: ask(do="unlock")["accepted"])
        if verb == "mode":
            d.brakeRelease()
        if verb == "safeguard":
            wait_for(lambda: not any(r.getTargetQd()))
            ask(do="safeguard", on=False)
            report(goes_on_by_itself=wait_for(lambda: any(r.getTargetQd())))
        wait_for(lambda: r.getRobotMode() == 7 and r.getSafetyMode() == 1)
        d.stop()
        c.reuploadScript()
        if not wait_for(c.isProgramRunning):
            report(stuck_after=verb)
            return


def foreign_program(host: str) -> None:
    """Another client's program ends the move; while it plays, ours seems to run and a command is never answered."""
    r, c = RTDEReceiveInterface(host), RTDEControlInterface(host)
    move = Move(r, c)
    ask(do="foreign-program", seconds=1000)
    report(ended=move.ends(), returned=move.returned)
    report(seems_to_run=wait_for(c.isProgramRunning), stands=wait_for(lambda: not any(r.getTargetQd())))
    call = Move(r, c, wait=False)
    report(hangs=call.hangs(), moves=any(r.getTargetQd()))


def stop_of_a_blocking_move(host: str) -> None:
    """stopJ waits for the end of a blocking move instead of stopping it."""
    r, c = RTDEReceiveInterface(host), RTDEControlInterface(host)
    move = Move(r, c, 0.15, 0.2)
    c.stopJ(2.0)
    report(arrived=wait_for(lambda: abs(r.getActualQ()[5] - move.goal[5]) < 1e-3), ended=move.ends())


def protective_stop_of_an_async_move(host: str) -> None:
    """The operation word says "running" for ever; a replaced program says "finished"."""
    r, c = RTDEReceiveInterface(host), RTDEControlInterface(host)
    goal = r.getTargetQ()
    goal[5] += 1.0
    c.moveJ(goal, 0.004, 2.0, True)
    wait_for(lambda: abs(r.getTargetQd()[5]) > 1e-3)
    ask(do="protective-stop")
    wait_for(lambda: r.getRuntimeState() == 4 and not any(r.getTargetQd()))
    report(still_running=c.getAsyncOperationProgressEx().isAsyncOperationRunning())
    wait_for(lambda: ask(do="unlock")["accepted"])
    time.sleep(0.1)
    report(stands_after_unlock=r.getRuntimeState() == 4 and not any(r.getTargetQd()))
    report(play=ask(do="play")["accepted"], goes_on=wait_for(lambda: abs(r.getTargetQd()[5]) > 1e-3))
    c.stopJ(2.0)
    c.stopScript()


# -- constructors -----------------------------------------------------------------------------------------------------


def constructor(host: str) -> None:
    """Just make one."""
    report(begun=True)
    report(error=failure(lambda: RTDEControlInterface(host)))


def registers(host: str) -> None:
    """The fieldbus has the lower registers, then the upper ones too."""
    ask(do="claim-registers", range="lower", on=True)
    report(lower=failure(lambda: RTDEControlInterface(host)))
    report(io=failure(lambda: import_module("rtde_io").RTDEIOInterface(host)))
    upper = RTDEControlInterface.FLAG_UPPER_RANGE_REGISTERS | RTDEControlInterface.FLAG_UPLOAD_SCRIPT
    c = RTDEControlInterface(host, 500.0, upper)
    report(upper_works=c.isProgramRunning() and c.getTCPOffset() == [0.0] * 6)
    c.stopScript()
    c.disconnect()
    ask(do="claim-registers", range="upper", on=True)
    report(upper=failure(lambda: RTDEControlInterface(host, 500.0, upper)))
    ask(do="claim-registers", range="lower", on=False)
    report(free=failure(lambda: RTDEControlInterface(host)))


def die_in_async_move(host: str) -> None:
    """A long asynchronous move; then the client is killed."""
    r, c = RTDEReceiveInterface(host), RTDEControlInterface(host)
    goal = r.getTargetQ()
    goal[5] += 1.0
    c.moveJ(goal, 0.05, 2.0, True)
    wait_for(lambda: abs(r.getTargetQd()[5]) > 1e-3)
    report(goal=goal)
    os.kill(os.getpid(), signal.SIGKILL)


def die_in_blocking_move(host: str) -> None:
    """The same with a blocking one."""
    r, c = RTDEReceiveInterface(host), RTDEControlInterface(host)
    report(goal=Move(r, c, 0.5, 0.05).goal)
    os.kill(os.getpid(), signal.SIGKILL)


def die_under_watchdog(host: str) -> None:
    """The same with the watchdog on."""
    r, c = RTDEReceiveInterface(host), RTDEControlInterface(host)
    c.setWatchdog(1.0)
    goal = r.getTargetQ()
    goal[5] += 1.0
    c.moveJ(goal, 0.02, 2.0, True)
    wait_for(lambda: abs(r.getTargetQd()[5]) > 1e-3)
    report(died=True)
    os.kill(os.getpid(), signal.SIGKILL)


# -- generations, settings of the pendant -----------------------------------------------------------------------------


def generation(host: str) -> None:
    """Every call an arm needs, on whatever software this controller has."""
    d = DashboardClient(host)
    d.connect()
    r, c = RTDEReceiveInterface(host), RTDEControlInterface(host)
    report(version=d.polyscopeVersion(), model=d.getRobotModel(), serial=failure(d.getSerialNumber))
    report(registers=_running(c))
    q = r.getActualQ()
    report(limits=[c.isJointsWithinSafetyLimits(q), c.isJointsWithinSafetyLimits([7.0, *q[1:]])], tcp=c.getTCPOffset())
    before = c.getAsyncOperationProgressEx().operationId()
    report(started=c.moveJ([*q[:5], q[5] + 1.0], 0.02, 2.0, True))
    report(operation=wait_for(lambda: c.getAsyncOperationProgressEx().operationId() == before + 1))
    report(moving=wait_for(lambda: abs(r.getTargetQd()[5]) > 0.01))
    c.stopJ(4.0)
    report(stopped=wait_for(lambda: not any(r.getTargetQd())))
    report(ended=wait_for(lambda: not _running(c)), short=r.getTargetQ()[5] < q[5] + 0.9)
    report(watchdog=c.setWatchdog(5.0))
    report(bites=wait_for(lambda: not c.isProgramRunning()))
    report(uploaded=c.reuploadScript() and wait_for(c.isProgramRunning))
    c.stopScript()
    report(script_stopped=not c.isProgramRunning())


def _running(control: Any) -> bool:
    return bool(control.getAsyncOperationProgressEx().isAsyncOperationRunning())


def variables(host: str) -> None:
    """A variable that only the controller knows shifts the following ones; one it does not know is named."""
    r = RTDEReceiveInterface(host, 125.0, ["timestamp", "tcp_offset", "actual_q"])
    whole = RTDEReceiveInterface(host)
    report(shifted=r.getActualQ() != whole.getActualQ())


def variables_refused(host: str) -> None:
    """An unknown variable is named in the error."""
    report(error=failure(lambda: RTDEReceiveInterface(host, 125.0, ["timestamp", "tcp_offset"])))


def local_control(host: str) -> None:
    """The pendant goes to local control and back."""
    d = DashboardClient(host)
    d.connect()
    ask(do="remote-control", on=False)
    report(remote=d.isInRemoteControl(), stop=failure(d.stop), constructor=failure(lambda: RTDEControlInterface(host)))
    ask(do="remote-control", on=True)
    report(remote_again=d.isInRemoteControl(), still=failure(d.stop))
    d.disconnect()
    d.connect()
    report(reconnected=failure(d.stop))


def slider(host: str) -> None:
    """A quarter of the speed, then a limiter that halves it again, then standstill."""
    r, c = RTDEReceiveInterface(host), RTDEControlInterface(host)
    ask(do="slider", fraction=0.25)
    goal = r.getTargetQ()
    goal[5] += 1.0
    c.moveJ(goal, 0.04, 4.0, True)
    report(quarter=wait_for(lambda: abs(r.getTargetQd()[5] - 0.01) < 1e-6), fraction=r.getTargetSpeedFraction())
    ask(do="speed-scaling", fraction=0.5)
    report(eighth=wait_for(lambda: abs(r.getTargetQd()[5] - 0.005) < 1e-6), scaling=r.getSpeedScaling())
    ask(do="slider", fraction=0.0)
    report(stands=wait_for(lambda: not any(r.getTargetQd())), running=_running(c))
    c.stopScript()


SCENARIOS: dict[str, Callable[[str], None]] = {
    f.__name__: f
    for f in (
        killed, killed_moving, command_after_loss, dropped_moving, dropped_without_dashboard,
        briefly_silent, silent, frozen, broken_program, foreign_program, stop_of_a_blocking_move,
        protective_stop_of_an_async_move, constructor, registers, die_in_async_move, die_in_blocking_move,
        die_under_watchdog, generation, variables, variables_refused, local_control, slider,
    )
}  # fmt: skip

if __name__ == "__main__":
    SCENARIOS[sys.argv[1]](sys.argv[2])
    os._exit(0)  # without the destructors, which take half a second each when they do not hang
