"""Log of a running program's weighings, in one file per day and in the store."""

from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from queue import Empty, SimpleQueue
from threading import Thread
from time import monotonic
from typing import Any, Final

from ftcalib.errors import DataError
from ftcalib.files import JSON
from ftdrive.cell.config import user_folder
from ftdrive.errors import ConfigError
from ftdrive.runs.weighings import FOLDER, WeighingDay, append_weighings

# Default time between two writes of the log to the store, s.
EVERY_S: Final = 30.0
# Time-out, s, of the last write at the end of a program, slightly longer than the store's time-out of 5 s.
_GOODBYE_S: Final = 6.0
# Largest number of lines that wait for a slow disk; if there are more, the oldest are lost.
_MOST_WAITING: Final = 1000
_NOT_INDEXED: Final = "Weighings are saved, but not yet in the history"
# A weighing to log: its day (UTC), and the JSON values of its line.
_Line = tuple[str, Mapping[str, JSON]]


class WeighingLog:
    """A log of weighings with a thread of its own for writing, so that a slow disk or database delays no stream.

    A failed write is reported once, and its lines are written with the next one. `origin` has `tool`,
    `calibration_id`, `arm_serial`, `sensor_serial`, `robot_host` and `emulated`; `url` is the address of the store.
    `say` receives a sentence for the operator, from any thread. `folder` is by default in the user's data folder;
    `every_s` is the time between two writes to the store, s.
    """

    def __init__(
        self,
        origin: Mapping[str, JSON],
        url: str | None,
        say: Callable[[str], object],
        *,
        folder: Path | None = None,
        every_s: float = EVERY_S,
        now: Callable[[], datetime] = lambda: datetime.now(UTC),
    ) -> None:
        self._origin, self._url, self._say, self._every_s, self._now = origin, url, say, every_s, now
        self._folder = folder or user_folder("data") / FOLDER
        self._lines = SimpleQueue[_Line | None]()
        self._waiting = list[_Line]()
        # day and path of the file that is written now, and its content when last read for the store
        self._day, self._path = "", Path()
        self._read: WeighingDay | None = None
        # whether this file has lines that the store lacks
        self._is_new = False
        # whether the store may lack files of earlier programs
        self._lacks_older = True
        self._store: Any = None
        self._said = set[str]()
        self._thread = Thread(target=self._run, daemon=True, name="weighings")
        self._thread.start()

    def keep(self, values: Mapping[str, JSON]) -> None:
        """Log the values of a weighing, or of the reason for a missing mass, from `load_values`; return at once."""
        t_utc = self._now().isoformat(timespec="milliseconds")
        self._lines.put((t_utc[:10], {"t_utc": t_utc, **values}))

    def close(self) -> None:
        """End the log: write the remaining lines, which may take a few seconds at most."""
        self._lines.put(None)
        self._thread.join(_GOODBYE_S)

    # -------------------------------------------------------------------------------------------------- its own thread

    def _run(self) -> None:
        self._attempt(_NOT_INDEXED, self._open)
        due_s, ends = monotonic(), False
        while not ends:
            new = self._next(max(0.0, due_s - monotonic()) if self._is_new else None)
            ends = None in new
            self._waiting = [*self._waiting, *(line for line in new if line is not None)][-_MOST_WAITING:]
            if self._waiting:
                self._attempt("Weighings are not saved", self._append)
            if self._is_new and (ends or monotonic() >= due_s):
                self._index()
                due_s = monotonic() + self._every_s

    def _next(self, timeout_s: float | None) -> list[_Line | None]:
        """Wait for lines to log, and return all that wait; None among them means that the log was closed."""
        try:
            lines = [self._lines.get(timeout=timeout_s)]
        except Empty:
            return []
        while not self._lines.empty():
            lines.append(self._lines.get())
        return lines

    def _open(self) -> None:
        """Open the store."""
        from ftdrive.store.store import Store

        self._store = Store(self._url)

    def _append(self) -> None:
        while self._waiting:
            day = self._waiting[0][0]
            if self._day != day:
                if self._is_new:
                    self._index()
                self._day, self._read = day, None
            lines = [line for at, line in self._waiting if at == day]
            self._path = append_weighings(self._folder, self._origin, day, lines)
            self._waiting = [line for line in self._waiting if line[0] != day]
            self._is_new = True

    def _index(self) -> None:
        self._attempt(_NOT_INDEXED, self._put_weighings)

    def _put_weighings(self) -> None:
        # The store gets one row per daily file, because one per weighing would be 6 million per cell and year.
        if self._store is None:
            self._open()
        if self._lacks_older:
            self._store.index(self._folder)  # also add files that an unreachable store missed
            self._lacks_older = False
        self._read = WeighingDay.load(self._path, self._read)
        self._store.put_weighings(self._read)
        self._is_new = False

    def _attempt(self, failure: str, write: Callable[[], None]) -> None:
        try:
            write()
        except (OSError, DataError, ConfigError) as error:
            if failure not in self._said:
                self._said.add(failure)
                self._say(f" {failure}, because {error}.")
