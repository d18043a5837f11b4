"""A cell in a session: its open devices, and how the session reports and asks."""

from dataclasses import dataclass

from ftdrive.session.events import Noted
from ftdrive.session.guards import Limits
from ftdrive.session.journal import Journal
from ftdrivers.clock import Clock
from ftdrivers.errors import DeviceError
from ftdrivers.interfaces import ForceTorqueSensor, FtSamples, RobotArm


@dataclass(frozen=True, slots=True, eq=False)
class OpenCell:
    """Arm and sensor, open; the clock that times them, the journal, and the limits of the session."""

    arm: RobotArm
    sensor: ForceTorqueSensor
    clock: Clock
    journal: Journal
    limits: Limits

    def note(self, words: str, *, warning: bool = False) -> None:
        """Show a note."""
        self.journal.show(Noted(words=words, warning=warning))

    def listen(self, duration_s: float) -> FtSamples:
        """Collect samples of the resting sensor; reopen it once if it fails, as after a killed session."""
        try:
            return self.sensor.collect(duration_s)
        except DeviceError as error:
            self.note(f"{error}; trying once more", warning=True)
        self.sensor.close()
        self.sensor.open()
        return self.sensor.collect(duration_s)
