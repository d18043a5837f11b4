"""From a stop back to where the arm may move again: what has stopped it, and whether that is mended."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Final

from drivers.errors import DeviceFault, DriverError
from drivers.interfaces import ForceTorqueSensor, RobotArm
from ftdrive.session.events import GuardTripped, Noted, Witness
from ftdrive.session.guards import ContactGuard, Tripped, by_safety, out_of_sight
from ftdrive.session.hazards import Hazard
from ftdrive.session.journal import Journal
from ftdrive.session.watchdog import Watcher

_LOOK_AGAIN_S: Final = 0.4


@dataclass(frozen=True, slots=True, eq=False)
class GuardedCell:
    """Arm and sensor of a cell under control, with the guards that watch them."""

    arm: RobotArm
    sensor: ForceTorqueSensor
    journal: Journal
    watcher: Watcher


class Recovery:
    """Opens again what was lost, looks at everything once more, and sees that the questions come again after row 11.

    Parameters
    ----------
    contact
        Takes the zero of a sensor that was opened again as it is.
    recheck : callable
        Does the checks once more, and asks the questions of the beginning again where it is told so; raises when the
        arm may not go on.
    """

    def __init__(self, cell: GuardedCell, contact: ContactGuard, recheck: Callable[[bool], None]) -> None:
        self._arm, self._sensor, self._journal, self._watcher = cell.arm, cell.sensor, cell.journal, cell.watcher
        self._contact, self._recheck = contact, recheck
        self._witness = Witness(cell.sensor, cell.journal.show)
        self._told: Tripped | None = None  # last, as what the arm is held for
        self._answered: Tripped | None = None  # last stop of row 11 after which the questions were answered

    def show_new(self) -> None:
        """Tell what the sensor went through."""
        self._witness.show_new()

    def cause(self, error: Exception, *, moving: bool) -> Tripped | None:
        """What a guard has to say about it, or the row of the table that the error belongs to."""
        self._watcher.unseen = False
        self._told = self._row_of(error, moving=moving)
        if self._told is not None:
            self._watcher.keep(self._told)
        return self._told

    def require_answers(self) -> None:
        """Raise a stop of row 11, however short, after which the questions were not answered: no motion goes on."""
        self._watcher.look_aside()
        stop = self._watcher.safety_stop
        if stop is not None and stop is not self._answered:
            raise stop

    def make_sure(self) -> None:
        """Raise unless all is well again. A stop of the safety system is for the operator to clear."""
        self._watcher.look_aside()
        unseen = self._watcher.unseen
        try:
            self._arm.open(control=True)
        except DriverError:
            with suppress(DriverError):
                self._arm.open()  # so that it is seen when somebody presses the emergency stop meanwhile
            raise
        try:
            self._sensor.check()
        except DriverError:
            self._witness.show_new()
            self._sensor.close()
            self._sensor.open()
            self._contact.forget()
            self._witness = Witness(self._sensor, self._journal.show)
        stop = self._watcher.safety_stop
        if stop is not None and stop not in {self._answered, self._told}:  # pressed while the arm was held already
            self._told = stop
            self._journal.show(GuardTripped(hazard=stop.hazard, words=str(stop)))
        elif unseen:
            words = "the arm was out of sight: nobody knows whether its emergency stop was pressed meanwhile"
            self._journal.show(Noted(words=words, warning=True))
        self._recheck(unseen or stop is not self._answered)
        self._answered = stop
        self._watcher.begin()
        q = self._arm.state().q_rad
        with self._watcher.watching(q, q, moving=False):  # is what tripped them gone?
            self._watcher.clock.sleep(_LOOK_AGAIN_S)
        self.require_answers()

    def _row_of(self, error: Exception, *, moving: bool) -> Tripped | None:
        if isinstance(error, Tripped):
            return error
        if isinstance(error, OSError) and not isinstance(error, DriverError):
            return Tripped(Hazard.DISK_FULL, error)
        if not isinstance(error, DriverError):
            return None
        if (trip := self._watcher.tripped(wait_s=0.3)) is not None:
            return trip
        try:
            self._sensor.check()
        except DriverError:
            return Tripped(Hazard.SENSOR_LOST, error)
        try:
            status = self._arm.status()
        except DriverError:
            return out_of_sight(error, moving=moving)
        if status.fault is not None:
            return by_safety(status, str(error))
        return Tripped(Hazard.OTHER_CLIENT if isinstance(error, DeviceFault) else Hazard.CONTROLLER_LOST, error)
