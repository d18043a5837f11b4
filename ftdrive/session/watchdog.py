"""The thread that watches: a hundred looks a second, by its own clock. It stops the arm, then it tells.

A stop that nobody answers takes a second or two: that is told while it goes on.
"""

import logging
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import numpy as np
from numpy.typing import NDArray

from calib.routine import turned_rad
from drivers.clock import Clock
from drivers.errors import DeviceFault, DriverError
from drivers.interfaces import ArmState, ForceTorqueSensor, RobotArm
from ftdrive.session.guards import Guard, Limits, Motion, Seen, Tripped, by_safety, out_of_sight
from ftdrive.session.hazards import Hazard

log = logging.getLogger(__name__)

Array = NDArray[np.float64]


class Watcher:
    """The thread. Watches from `begin` on, whenever a `watching` block is open; for row 11 it looks all the time.

    Parameters
    ----------
    arm, sensor
        Asked from the thread.
    guards : sequence of Guard
    on_trip : callable
        Is told from the thread, once the arm was stopped or is slow to.
    clock
        Of the cell; it waits for the thread where it can.
    limits
        Periods and limits of the thread itself.
    """

    def __init__(
        self,
        arm: RobotArm,
        sensor: ForceTorqueSensor,
        guards: Sequence[Guard],
        on_trip: Callable[[Tripped], None],
        *,
        clock: Clock,
        limits: Limits,
    ) -> None:
        self.clock, self._limits = clock, limits
        self._arm, self._sensor, self._guards, self._on_trip = arm, sensor, tuple(guards), on_trip
        self._motion: Motion | None = None
        self._seen: Motion | None = None  # which all guards have looked at
        self._wake = threading.Event()
        self._end = threading.Event()
        self._told = threading.Event()
        self._tripped: Tripped | None = None
        self.untold: Exception | None = None
        """What the last trip could not be told for: whoever holds the arm says both."""
        self.safety_stop: Tripped | None = None
        """The last emergency or safeguard stop that was seen, whatever the arm did; one for each, never forgotten."""
        self.unseen = False
        """Whether the arm told nothing for so long that a stop may have come and gone; reset by who asks."""
        self._blind_since_s: float | None = None
        self._stopped_by_safety = False
        self._judging = threading.RLock()
        self._begun = False
        self._last: tuple[float, ArmState] | None = None
        self._looked_s = 0.0
        self._thread = threading.Thread(target=self._run, name="guards", daemon=True)

    def __enter__(self) -> "Watcher":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._end.set()
        self._wake.set()
        self._thread.join(timeout=5.0)

    def begin(self) -> None:
        """Forget a trip, and take the next look as what is normal."""
        self._tripped = self.untold = None
        self._told.clear()
        self._begun = False

    @contextmanager
    def watching(self, start_rad: Array, goal_rad: Array, *, moving: bool) -> Iterator[None]:
        """Watch while the block runs, after a first look. What trips is raised before it, after it, and by `check`."""
        self.check()
        self._last = None
        self._looked_s = self.clock.now_s()
        motion = self._motion = Motion(np.asarray(start_rad), np.asarray(goal_rad), moving)
        self._wake.set()
        try:
            while self._seen is not motion:
                self.check()
                self.clock.sleep(0.001)
            yield
        finally:
            self._motion = None
            self._wake.clear()
        self.check()

    def look_aside(self) -> None:
        """Row 11 while the arm stands: who has pressed it may have let go again when a person says how it goes on.

        It is not told from here: a question may stand on the screen.
        """
        with self._judging:
            try:
                status = self._arm.status()
            except Exception as error:  # whatever the arm of another package raises: it is opened again, and says so
                log.debug("the arm does not tell how it is: %r", error)
                now_s = self.clock.now_s()
                self._blind_since_s = self._blind_since_s or now_s
                self.unseen |= now_s - self._blind_since_s > self._limits.blind_s
                return
            self._blind_since_s = None
            trip = None if status.fault is None else by_safety(status, f"the arm stopped: {status.fault}")
            if trip is None or trip.hazard != Hazard.EMERGENCY_STOP:
                self._stopped_by_safety = False
            elif not self._stopped_by_safety:
                self.keep(trip)

    def keep(self, trip: Tripped) -> None:
        """Remember it as `safety_stop` when it is one."""
        if trip.hazard == Hazard.EMERGENCY_STOP:
            with self._judging:
                self.safety_stop, self._stopped_by_safety = trip, True

    def check(self) -> None:
        """Raise what has tripped, or that nobody watches. Called in the loops that wait for the arm."""
        if self._tripped is not None:
            raise self._tripped
        if self._has_ended:
            raise Tripped(
                Hazard.UNGUARDED, DeviceFault("the guards' thread has ended, nothing is watched", "end this session")
            )
        if self._motion is not None and (late_s := self.clock.now_s() - self._looked_s) > self._limits.hung_s:
            raise Tripped(
                Hazard.UNGUARDED,
                DeviceFault(f"the guards have not looked for {late_s:.1f} s: give this computer less to do"),
            )

    def tripped(self, *, wait_s: float) -> Tripped | None:
        """Tell what has tripped, once the arm was stopped and that was told; None after `wait_s` without."""
        deadline_s = self.clock.now_s() + wait_s
        while self._tripped is None and self.clock.now_s() < deadline_s:
            self.clock.sleep(0.005)
        if self._tripped is not None:
            self.clock.wait(self._told, 5.0)
        return self._tripped

    def turn(self) -> float:
        """Look once; return after how many seconds the thread does so again."""
        motion = self._motion
        if motion is None or self._tripped is not None:
            self.look_aside()
            return self._limits.aside_s
        started_s = self.clock.now_s()
        try:
            self._look(motion)
        except Tripped as trip:
            self._stop(trip)
        except DriverError as error:
            self._stop(out_of_sight(error, moving=motion.moving))
        except Exception as error:
            log.exception("a guard failed")
            self._stop(
                Tripped(Hazard.UNGUARDED, DeviceFault(f"a guard failed ({error!r}): report this, and do not go on"))
            )
        return started_s + self._limits.look_s - self.clock.now_s()

    @property
    def _has_ended(self) -> bool:
        return not self._thread.is_alive()

    def _run(self) -> None:
        with self.clock.keeping_up():
            while not self._end.is_set():
                pause_s = self.turn()
                self.clock.wait(self._wake if self._motion is None else self._end, pause_s)

    def _look(self, motion: Motion) -> None:
        status = self._arm.status()
        try:
            state = self._arm.state()
        except DeviceFault as error:
            status = self._arm.status()  # what stopped the arm may have come between the two
            if status.fault is not None:
                raise by_safety(status, str(error)) from error
            raise Tripped(Hazard.WRONG_MODEL, error) from error
        try:
            self._sensor.check()
            sample = self._sensor.latest(timeout_s=0.0)
        except DriverError as error:
            raise Tripped(Hazard.SENSOR_LOST, error) from error
        if motion is not self._motion:  # the block has ended meanwhile: what was seen may belong to the next one
            return
        now_s = self.clock.now_s()
        dt_s = min(now_s - self._looked_s, self._limits.counted_s)
        turn_rad_s = 0.0
        if self._last is not None:
            then_s, before = self._last
            turn_rad_s = turned_rad(before, state) / max(now_s - then_s, 1e-3)
        self._last, self._looked_s = (now_s, state), now_s
        seen = Seen(now_s, dt_s, motion, state, status, sample.wrench[-1], int(sample.seq[-1]), turn_rad_s)
        if not self._begun:
            for guard in self._guards:
                guard.begin(seen)
            self._begun = True
        for guard in self._guards:
            guard.look(seen)
        self._seen = motion

    def _stop(self, trip: Tripped) -> None:
        self._tripped = trip
        self.keep(trip)
        stopped = self._begin_to_stop()
        self.clock.wait(stopped, self._limits.slow_stop_s)
        try:
            self._on_trip(trip)
        except Exception as error:  # a screen or a disk: the arm has to be watched all the same
            log.exception("a stop could not be told")
            self.untold = error
        while not self.clock.wait(stopped, 1.0):
            pass
        self._told.set()

    def _begin_to_stop(self) -> threading.Event:
        """Stop the arm in a thread of its own; the event is set when that has ended."""
        stopped = threading.Event()

        def stop() -> None:
            try:
                self._arm.stop()
            except Exception:
                log.exception("the arm could not be told to stop: press the emergency stop")
            finally:
                stopped.set()

        threading.Thread(target=stop, name="guards stop", daemon=True).start()
        return stopped
