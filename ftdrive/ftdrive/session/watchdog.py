"""The thread that runs the guards, 100 times per second on the cell's clock; after a trip it stops the arm.

A stop that the controller does not answer takes 1 to 2 s; the trip is then reported before the stop has ended.
"""

import logging
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import numpy as np

from ftcalib.model import Array
from ftcalib.routine import turned_rad
from ftdrive.session.events import Hazard
from ftdrive.session.guards import ExpectedMotion, Guard, Seen, Tripped, arm_lost, by_safety, fault
from ftdrive.session.open_session import OpenCell
from ftdrivers.clock import Follower
from ftdrivers.errors import DeviceError, DeviceFault
from ftdrivers.interfaces import ArmState

log = logging.getLogger(__name__)


class Watcher:
    """Runs the guards during each `watching` block; at other times it checks for emergency and safeguard stops.

    `on_trip` is called from the guard thread when the arm has stopped, or after 0.2 s if the stop takes longer.
    """

    def __init__(self, cell: OpenCell, guards: Sequence[Guard], on_trip: Callable[[Tripped], None]) -> None:
        self.clock, self._limits = cell.clock, cell.limits
        self._arm, self._sensor, self._guards, self._on_trip = cell.arm, cell.sensor, tuple(guards), on_trip
        self._motion: ExpectedMotion | None = None
        self._seen: ExpectedMotion | None = None  # the motion of which all guards have judged an observation last
        self._wake = threading.Event()
        self._end = threading.Event()
        self._reported = threading.Event()
        self._tripped: Tripped | None = None
        self.report_error: Exception | None = None
        """Error that occurred when the last trip was reported; the hold shows it with the trip."""
        self.safety_stop: Tripped | None = None
        """The last emergency or safeguard stop, of a moving or resting arm; kept until the session ends."""
        self.unseen = False
        """Whether the arm reported no status for so long that a stop may be unnoticed; the reader resets this flag."""
        self._blind_since_s: float | None = None
        self._stopped_by_safety = False
        self._judging = threading.RLock()
        self._begun = False
        self._last: tuple[float, ArmState] | None = None
        self._looked_s = 0.0
        self._thread = Follower(cell.clock, self._run, "guards")

    def __enter__(self) -> "Watcher":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._end.set()
        self._wake.set()
        self._thread.join(timeout=5.0)

    def begin(self) -> None:
        """Forget the last trip, and let each guard take the next observation as its reference."""
        self._tripped = self.report_error = None
        self._reported.clear()
        self._begun = False

    @contextmanager
    def watching(
        self, start_rad: Array, goal_rad: Array, *, moving: bool, curve_rad: Array | None = None
    ) -> Iterator[None]:
        """Run the guards during the block, which begins after their first observation.

        A trip is raised before the block, after it, and by `check`. The arm moves straight in joint space, or along
        `curve_rad` (n, 6).
        """
        self.check()
        self._last = None
        self._looked_s = self.clock.now_s()
        motion = self._motion = ExpectedMotion(np.asarray(start_rad), np.asarray(goal_rad), moving, curve_rad)
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
        """Check for emergency and safeguard stops while no motion is watched; one may be released before an answer.

        Shows nothing, because the screen may show a question.
        """
        with self._judging:
            try:
                status = self._arm.status()
            # An arm driver of another package may raise any error; its cause is reported when the arm is reopened.
            except Exception as error:
                log.debug("the arm reports no status: %r", error)
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
        """Store the trip as `safety_stop` if its hazard is an emergency or safeguard stop."""
        if trip.hazard == Hazard.EMERGENCY_STOP:
            with self._judging:
                self.safety_stop, self._stopped_by_safety = trip, True

    def check(self) -> None:
        """Raise the current trip, or one if the guards ended or hang. Every loop that waits for the arm calls this."""
        if self._tripped is not None:
            raise self._tripped
        if self._has_ended:
            raise fault(Hazard.UNGUARDED, "the guard thread has ended, so the arm is not watched", "quit this session")
        if self._motion is not None and (late_s := self.clock.now_s() - self._looked_s) > self._limits.hung_s:
            raise fault(
                Hazard.UNGUARDED,
                f"the guards have not checked the arm for {late_s:.1f} s: close other programs on this computer",
            )

    def tripped(self, *, wait_s: float) -> Tripped | None:
        """Wait for a trip, then until it is reported, and return it; None if no guard trips within `wait_s`."""
        deadline_s = self.clock.now_s() + wait_s
        while self._tripped is None and self.clock.now_s() < deadline_s:
            self.clock.sleep(0.005)
        if self._tripped is not None:
            self.clock.wait(self._reported, 5.0)
        return self._tripped

    def turn(self) -> float:
        """Run the guards once; return the time until the next run, s."""
        motion = self._motion
        if motion is None or self._tripped is not None:
            self.look_aside()
            return self._limits.aside_s
        started_s = self.clock.now_s()
        try:
            self._look(motion)
        except Tripped as trip:
            self._stop(trip)
        except DeviceError as error:
            self._stop(arm_lost(error, moving=motion.moving))
        except Exception as error:
            log.exception("a guard failed")
            self._stop(fault(Hazard.UNGUARDED, f"a guard failed ({error!r}): report this bug, and quit"))
        return started_s + self._limits.look_s - self.clock.now_s()

    @property
    def _has_ended(self) -> bool:
        return not self._thread.is_alive()

    def _run(self) -> None:
        while not self._end.is_set():
            pause_s = self.turn()
            self.clock.wait(self._wake if self._motion is None else self._end, pause_s)

    def _look(self, motion: ExpectedMotion) -> None:
        status = self._arm.status()
        try:
            state = self._arm.state()
        except DeviceFault as error:
            # The safety system may have stopped the arm between the two readings.
            status = self._arm.status()
            if status.fault is not None:
                raise by_safety(status, str(error)) from error
            raise Tripped(Hazard.WRONG_MODEL, error) from error
        try:
            self._sensor.check()
            sample = self._sensor.latest(timeout_s=0.0)
        except DeviceError as error:
            raise Tripped(Hazard.SENSOR_LOST, error) from error
        # The `watching` block has ended meanwhile: the readings may belong to the next block.
        if motion is not self._motion:
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
        # The screen or the disk failed; the guards must go on.
        except Exception as error:
            log.exception("a stop could not be reported")
            self.report_error = error
        while not self.clock.wait(stopped, 1.0):
            pass
        self._reported.set()

    def _begin_to_stop(self) -> threading.Event:
        """Stop the arm in a separate thread; return an event that is set when the stop has ended."""
        stopped = threading.Event()

        def stop() -> None:
            try:
                self._arm.stop()
            except Exception:
                log.exception("the stop could not be sent to the arm: press the emergency stop")
            finally:
                stopped.set()

        threading.Thread(target=stop, name="guards stop", daemon=True).start()
        return stopped
