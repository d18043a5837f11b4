"""From a stop back to motion: what stopped the arm, and whether the cause is gone."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Final

from ftdrive.session.events import GuardTripped, Noted, SensorEvents
from ftdrive.session.guards import ContactGuard, Tripped, arm_lost, by_safety
from ftdrive.session.hazards import Hazard
from ftdrive.session.journal import Journal
from ftdrive.session.watchdog import Watcher
from ftdrivers.errors import DeviceError, DeviceFault
from ftdrivers.interfaces import ForceTorqueSensor, RobotArm

_LOOK_AGAIN_S: Final = 0.4


@dataclass(frozen=True, slots=True, eq=False)
class GuardedCell:
    """Arm and sensor of a cell under control, with the guards that watch them."""

    arm: RobotArm
    sensor: ForceTorqueSensor
    journal: Journal
    watcher: Watcher


class Recovery:
    """Reopens lost devices, repeats the checks, and asks the safety questions again after row 11.

    Parameters
    ----------
    contact
        Accepts the zero of a reopened sensor.
    recheck : callable
        Repeats the checks; with True, the safety questions too. Raises if the arm may not go on.
    """

    def __init__(self, cell: GuardedCell, contact: ContactGuard, recheck: Callable[[bool], None]) -> None:
        self._arm, self._sensor, self._journal, self._watcher = cell.arm, cell.sensor, cell.journal, cell.watcher
        self._contact, self._recheck = contact, recheck
        self._sensor_events = SensorEvents(cell.sensor, cell.journal.show)
        self._cause: Tripped | None = None  # why the arm is held
        self._answered: Tripped | None = None  # last stop of row 11 whose questions were answered

    def show_new(self) -> None:
        """Show new events of the sensor."""
        self._sensor_events.show_new()

    def cause(self, error: Exception, *, moving: bool) -> Tripped | None:
        """Return the trip behind an error: that of a guard, or the row of the table that the error belongs to."""
        self._watcher.unseen = False
        self._cause = self._row_of(error, moving=moving)
        if self._cause is not None:
            self._watcher.keep(self._cause)
        return self._cause

    def require_answers(self) -> None:
        """Raise a stop of row 11, however short, until its questions are answered."""
        self._watcher.look_aside()
        stop = self._watcher.safety_stop
        if stop is not None and stop is not self._answered:
            raise stop

    def reopen(self) -> None:
        """Raise unless the cause is gone. Only the operator clears a stop of the safety system."""
        self._watcher.look_aside()
        unseen = self._watcher.unseen
        try:
            self._arm.open(control=True)
        except DeviceError:
            with suppress(DeviceError):
                self._arm.open()  # to see an emergency stop that is pressed meanwhile
            raise
        try:
            self._sensor.check()
        except DeviceError:
            self._sensor_events.show_new()
            self._sensor.close()
            self._sensor.open()
            self._contact.forget()
            self._sensor_events = SensorEvents(self._sensor, self._journal.show)
        stop = self._watcher.safety_stop
        if stop is not None and stop not in {self._answered, self._cause}:  # pressed while the arm was already held
            self._cause = stop
            self._journal.show(GuardTripped(hazard=stop.hazard, words=str(stop)))
        elif unseen:
            words = "the arm was out of sight: its emergency stop may have been pressed meanwhile"
            self._journal.show(Noted(words=words, warning=True))
        self._recheck(unseen or stop is not self._answered)
        self._answered = stop
        self._watcher.begin()
        q = self._arm.state().q_rad
        with self._watcher.watching(q, q, moving=False):  # raises if the cause is still there
            self._watcher.clock.sleep(_LOOK_AGAIN_S)
        self.require_answers()

    def _row_of(self, error: Exception, *, moving: bool) -> Tripped | None:
        if isinstance(error, Tripped):
            return error
        if isinstance(error, OSError) and not isinstance(error, DeviceError):
            return Tripped(Hazard.DISK_FULL, error)
        if not isinstance(error, DeviceError):
            return None
        if (trip := self._watcher.tripped(wait_s=0.3)) is not None:
            return trip
        try:
            self._sensor.check()
        except DeviceError:
            return Tripped(Hazard.SENSOR_LOST, error)
        try:
            status = self._arm.status()
        except DeviceError:
            return arm_lost(error, moving=moving)
        if status.fault is not None:
            return by_safety(status, str(error))
        return Tripped(Hazard.OTHER_CLIENT if isinstance(error, DeviceFault) else Hazard.CONTROLLER_LOST, error)
