"""The time of an emulated cell for tests whose devices live in their own process."""

import threading

from ftdrive.cell.emulated_clock import EmulatedClock
from ftmocks.clock import CellClock


class CellTime:
    """Time of an emulated cell that lives in this process."""

    def __init__(self) -> None:
        self.of_devices = CellClock()
        self.of_drivers = EmulatedClock(self.of_devices.path)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._tick)
        self._thread.start()

    def _tick(self) -> None:
        while not self._ended.wait(0.001):
            self.of_devices.now_ns()

    def close(self) -> None:
        self._ended.set()
        self._thread.join()
        self.of_devices.close()
