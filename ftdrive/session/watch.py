"""The thread that watches: a hundred looks a second, by its own clock. It stops the arm, then it tells.

A stop that nobody answers takes a second or two: that is told while it goes on.
"""

import logging
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib.routine import turned_rad
from drivers.errors import DeviceFault, DriverError
from drivers.interfaces import ArmState, ForceTorqueSensor, RobotArm
from ftdrive.session.guards import Guard, Motion, Seen, Tripped, by_safety, out_of_sight

log = logging.getLogger(__name__)

Array = NDArray[np.float64]

PERIOD_S: Final = 0.01
_LATE_S: Final = 0.02
"""So much of the time between two looks counts as silence: when this process gets no time, nothing else is late."""
_ASIDE_S: Final = 0.05
"""Between two looks for a stop of the safety system, while nothing else is watched."""
_BLIND_S: Final = 1.0
"""Nobody presses a stop, releases it and has the arm ready again in less."""
_HUNG_S: Final = 1.0
_TELL_S: Final = 0.2
"""A stop that takes longer is told meanwhile. An arm that answers brakes from 60 deg/s in 0.26 s."""


class Watcher:
    """The thread. Watches from `begin` on, whenever a `watching` block is open; for row 11 it looks all the time.

    Parameters
    ----------
    arm, sensor
        Asked from the thread.
    guards : sequence of Guard
    on_trip : callable
        Is told from the thread, once the arm was stopped or is slow to.
    """

    def __init__(
        self,
        arm: RobotArm,
        sensor: ForceTorqueSensor,
        guards: Sequence[Guard],
        on_trip: Callable[[Tripped], None],
    ) -> None:
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
        self._looked_s = time.monotonic()
        motion = self._motion = Motion(np.asarray(start_rad), np.asarray(goal_rad), moving)
        self._wake.set()
        try:
            while self._seen is not motion:
                self.check()
                time.sleep(0.001)
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
                now_s = time.monotonic()
                self._blind_since_s = self._blind_since_s or now_s
                self.unseen |= now_s - self._blind_since_s > _BLIND_S
                return
            self._blind_since_s = None
            trip = None if status.fault is None else by_safety(status, f"the arm stopped: {status.fault}")
            if trip is None or trip.hazard != 11:
                self._stopped_by_safety = False
            elif not self._stopped_by_safety:
                self.keep(trip)

    def keep(self, trip: Tripped) -> None:
        """Remember it as `safety_stop` when it is one."""
        if trip.hazard == 11:
            with self._judging:
                self.safety_stop, self._stopped_by_safety = trip, True

    def check(self) -> None:
        """Raise what has tripped, or that nobody watches. Called in the loops that wait for the arm."""
        if self._tripped is not None:
            raise self._tripped
        if not self._thread.is_alive():
            raise Tripped(18, DeviceFault("the guards' thread has ended, nothing is watched", "end this session"))
        if self._motion is not None and time.monotonic() - self._looked_s > _HUNG_S:
            raise Tripped(18, DeviceFault("the guards have not looked for a second: give this computer less to do"))

    def tripped(self, *, wait_s: float) -> Tripped | None:
        """Tell what has tripped, once the arm was stopped and that was told; None after `wait_s` without."""
        deadline = time.monotonic() + wait_s
        while self._tripped is None and time.monotonic() < deadline:
            time.sleep(0.005)
        if self._tripped is not None:
            self._told.wait(5.0)
        return self._tripped

    def _run(self) -> None:
        while not self._end.is_set():
            motion = self._motion
            if motion is None or self._tripped is not None:
                self.look_aside()
                self._wake.wait(_ASIDE_S)
                if self._tripped is not None:
                    self._end.wait(0.02)
                continue
            started_s = time.monotonic()
            try:
                self._look(motion)
            except Tripped as trip:
                self._stop(trip)
            except DriverError as error:
                self._stop(out_of_sight(error, moving=motion.moving))
            except Exception as error:
                log.exception("a guard failed")
                self._stop(Tripped(18, DeviceFault(f"a guard failed ({error!r}): report this, and do not go on")))
            self._end.wait(max(0.0, started_s + PERIOD_S - time.monotonic()))

    def _look(self, motion: Motion) -> None:
        status = self._arm.status()
        try:
            state = self._arm.state()
        except DeviceFault as error:
            status = self._arm.status()  # what stopped the arm may have come between the two
            raise (Tripped(9, error) if status.fault is None else by_safety(status, str(error))) from error
        try:
            self._sensor.check()
            sample = self._sensor.latest(timeout_s=0.0)
        except DriverError as error:
            raise Tripped(15, error) from error
        if motion is not self._motion:  # the block has ended meanwhile: what was seen may belong to the next one
            return
        now_s = time.monotonic()
        dt_s = min(now_s - self._looked_s, _LATE_S)
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
        stopping = threading.Thread(target=self._stop_arm, name="guards stop", daemon=True)
        stopping.start()
        stopping.join(_TELL_S)
        try:
            self._on_trip(trip)
        except Exception as error:  # a screen or a disk: the arm has to be watched all the same
            log.exception("a stop could not be told")
            self.untold = error
        stopping.join()
        self._told.set()

    def _stop_arm(self) -> None:
        try:
            self._arm.stop()
        except Exception:
            log.exception("the arm could not be told to stop: press the emergency stop")
