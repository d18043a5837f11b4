"""One stop of a moving arm at full speed, timed by the emulated controller."""

import threading
from contextlib import closing, suppress
from dataclasses import dataclass
from math import degrees, radians
from typing import Final, Literal

from ftdrive.cell.emulated_clock import EmulatedClock
from ftdrivers.errors import DeviceError
from ftdrivers.ur.arm import UrArm
from ftdrivers.ur.control import ControlPath
from ftdrivers.ur.timing import UrTiming
from tests.wire.conftest import Station

Cause = Literal["stop", "network"]
ACCELERATION_RAD_S2: Final = radians(80)
STEP_RAD: Final = 2.5
DEEP_S: Final = 1.0
"""After the move has begun, the arm has its full speed."""


@dataclass(frozen=True)
class Stop:
    """From the cause on, in the time of the cell."""

    brakes_s: float
    """Begin of braking."""
    rests_s: float
    """Standstill of the set-point."""
    turned_deg: float
    """Angle of the joint from the cause to its rest."""


def stop(station: Station, path: ControlPath, cause: Cause, speed_deg_s: float, stop_deg_s2: float) -> Stop:
    """Turn joint 6 of an arm that lives at real speed, and stop it at full speed: by a command, or without network."""
    speed_rad_s = radians(speed_deg_s)
    clock = station.clock
    assert isinstance(clock, EmulatedClock)
    since = len(station.ask("state")["events"])
    with closing(
        UrArm(
            station.host,
            speed_rad_s=speed_rad_s,
            acceleration_rad_s2=ACCELERATION_RAD_S2,
            stop_rad_s2=radians(stop_deg_s2),
            control=path,
            clock=clock,
            timing=UrTiming.emulated(),
        )
    ) as arm:
        arm.open(control=True)
        q = arm.state().q_rad.tolist()
        q[5] += STEP_RAD if q[5] < 0 else -STEP_RAD

        def move() -> None:
            with suppress(DeviceError):
                arm.move_to(q, timeout_s=60, guard=lambda: None)

        moving = threading.Thread(target=move)
        moving.start()
        station.wait_for_event("moves", since=since)
        clock.sleep(DEEP_S)
        with clock.keeping_up():
            cause_ns = clock.now_ns()
            with clock.held():
                before = station.ask("state")
                if cause == "network":
                    station.ask("silence-arm", on=True)
            if cause == "stop":
                arm.stop()
        stood = station.wait_for_event("stands", since=since)
        after = station.wait_for(lambda state: not state["moving"])
        station.ask("silence-arm", on=False)
        moving.join()
    assert abs(after["q_rad"][5] - q[5]) > 0.1, "the move went on to its end"
    rests_s = (stood["t_host_ns"] - cause_ns) / 1e9
    turned_deg = degrees(abs(after["q_rad"][5] - before["q_rad"][5]))
    return Stop(rests_s - speed_deg_s / stop_deg_s2, rests_s, turned_deg)
