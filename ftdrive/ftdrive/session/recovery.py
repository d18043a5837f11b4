"""From a stop back to motion: what stopped the arm, and whether the cause is gone."""

from collections.abc import Callable
from contextlib import suppress
from typing import Final

from ftdrive.errors import SupervisorGone
from ftdrive.session.events import GuardTripped, Hazard, SensorEvents
from ftdrive.session.guards import ContactGuard, RangeGuard, Tripped, arm_lost, by_safety
from ftdrive.session.open_cell import OpenCell
from ftdrive.session.watchdog import Watcher
from ftdrivers.errors import DeviceError, DeviceFault

_LOOK_AGAIN_S: Final = 0.4


class GuardedCell:
    """A cell under control with its guards, and what leads from a stop back to motion.

    Of the guards, `contact` accepts the zero of a reopened sensor, and `load` judges every sample of a pose. `recheck`
    repeats the checks, with True the safety questions too; it raises if the arm may not go on.
    """

    def __init__(
        self,
        cell: OpenCell,
        watcher: Watcher,
        *,
        contact: ContactGuard,
        load: RangeGuard,
        recheck: Callable[[bool], None],
    ) -> None:
        self.cell, self.watcher, self.load = cell, watcher, load
        self._contact, self._recheck = contact, recheck
        self._sensor_events = SensorEvents(cell.sensor, cell.journal.show)
        self._cause: Tripped | None = None  # why the arm is held
        self._answered: Tripped | None = None  # last stop of row 11 whose questions were answered

    def show_new(self) -> None:
        """Show new events of the sensor."""
        self._sensor_events.show_new()

    def cause(self, error: Exception, *, moving: bool) -> Tripped | None:
        """Return the trip behind an error: that of a guard, or the row of the table that the error belongs to."""
        self.watcher.unseen = False
        self._cause = self._row_of(error, moving=moving)
        if self._cause is not None:
            self.watcher.keep(self._cause)
        return self._cause

    def require_answers(self) -> None:
        """Raise a stop of row 11, however short, until its questions are answered."""
        self.watcher.look_aside()
        stop = self.watcher.safety_stop
        if stop is not None and stop is not self._answered:
            raise stop

    def reopen(self) -> None:
        """Raise unless the cause is gone. Only the operator clears a stop of the safety system."""
        self.watcher.look_aside()
        unseen = self.watcher.unseen
        try:
            self.cell.arm.open(control=True)
        except DeviceError:
            with suppress(DeviceError):
                self.cell.arm.open()  # to see an emergency stop that is pressed meanwhile
            raise
        try:
            self.cell.sensor.check()
        except DeviceError:
            self._sensor_events.show_new()
            self.cell.sensor.close()
            self.cell.sensor.open()
            self._contact.forget()
            self._sensor_events = SensorEvents(self.cell.sensor, self.cell.journal.show)
        stop = self.watcher.safety_stop
        if stop is not None and stop not in {self._answered, self._cause}:  # pressed while the arm was already held
            self._cause = stop
            self.cell.journal.show(GuardTripped(hazard=stop.hazard, words=str(stop)))
        elif unseen:
            words = "the arm was out of sight: its emergency stop may have been pressed meanwhile"
            self.cell.note(words, warning=True)
        self._recheck(unseen or stop is not self._answered)
        self._answered = stop
        self.watcher.begin()
        q = self.cell.arm.state().q_rad
        with self.watcher.watching(q, q, moving=False):  # raises if the cause is still there
            self.watcher.clock.sleep(_LOOK_AGAIN_S)
        self.require_answers()

    def _row_of(self, error: Exception, *, moving: bool) -> Tripped | None:
        if isinstance(error, Tripped):
            return error
        if isinstance(error, SupervisorGone):
            return Tripped(Hazard.SUPERVISOR_GONE, error)
        if isinstance(error, OSError) and not isinstance(error, DeviceError):
            return Tripped(Hazard.DISK_FULL, error)
        if not isinstance(error, DeviceError):
            return None
        if (trip := self.watcher.tripped(wait_s=0.3)) is not None:
            return trip
        try:
            self.cell.sensor.check()
        except DeviceError:
            return Tripped(Hazard.SENSOR_LOST, error)
        try:
            status = self.cell.arm.status()
        except DeviceError:
            return arm_lost(error, moving=moving)
        if status.fault is not None:
            return by_safety(status, str(error))
        return Tripped(Hazard.OTHER_CLIENT if isinstance(error, DeviceFault) else Hazard.CONTROLLER_LOST, error)
