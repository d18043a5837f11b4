"""A file that is written as NAME.partial, and renamed to NAME when it is complete."""

import os
from contextlib import suppress
from pathlib import Path
from typing import IO, ClassVar

from ftcalib.files import open_file, require_new


class GrowingFile:
    """A new file, written as `.partial`. Raises `OSError` if either file exists, or if the folder is not writable."""

    grows: ClassVar = True
    """Whether a file of this format can be read before it is complete."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.partial = partial_of(path, grows=self.grows)
        self._file = self.partial.open("xb", buffering=0)
        _lock(self._file)

    @property
    def size(self) -> int:
        """Size of the file so far, bytes."""
        return self._file.tell()

    def add(self, content: bytes) -> int:
        """Append bytes; return their offset in the file. If writing fails, the file keeps its old content."""
        start = self._file.tell()
        left = memoryview(content)
        try:
            while left:
                left = left[self._file.write(left) :]
        except OSError:
            self._file.seek(start)
            self._file.truncate()
            raise
        return start

    def complete(self) -> None:
        """Write the end, sync the file to disk and rename it. Raises `OSError` if that fails or the new name exists."""
        try:
            self._write_end()
            # Sync first, because it may take seconds, and closing releases the lock on the file.
            os.fsync(self._file.fileno())
        finally:
            self._file.close()
        require_new(self.path)
        self.partial.rename(self.path)

    def _write_end(self) -> None:
        """Write what a file of the format ends with, such as an index; nothing in this base class."""

    def discard(self) -> None:
        """Delete the file."""
        self._file.close()
        self.partial.unlink(missing_ok=True)

    def keep(self) -> None:
        """Close the file and leave it on disk as `.partial`."""
        self._file.close()


def _lock(file: IO[bytes]) -> bool:
    """Lock a file until it is closed; return False if another process has locked it."""
    try:
        import fcntl
    except ImportError:  # on Windows, where no stream is recorded
        return True
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # some network drives have no locks
        return True
    return True


def _lock_holder(file: IO[bytes]) -> str:
    """Return "process ID" for the process that locked a file, else "another process"; see proc_locks(5)."""
    with suppress(OSError):
        for line in Path("/proc/locks").read_text(encoding="ascii").splitlines():
            _, kind, *_, process, place, _, _ = line.split()
            if kind == "FLOCK" and place.endswith(f":{os.fstat(file.fileno()).st_ino}"):
                return f"process {process}"
    return "another process"


def partial_of(path: Path, *, grows: bool) -> Path:
    """Return the `.partial` of a new file. Raises `OSError` if either exists, or if their folder does not exist.

    `grows` is true if a file of this format can be read before it is complete; an error message depends on it.
    """
    partial = path.with_name(path.name + ".partial")
    require_new(path)
    if partial.exists():
        with open_file(partial) as file:
            if not _lock(file):
                raise FileExistsError(
                    f"{_lock_holder(file)} is still recording to {partial}: choose another name, or end that recording"
                )
        if not grows:
            raise FileExistsError(
                f"{partial} exists, but its end is missing: delete it. If `record` of an earlier ftdrive was "
                "interrupted, convert it with that version first"
            )
        raise FileExistsError(
            f"{partial} exists: an earlier recording was interrupted. Save it with "
            f"`ftdrive convert {partial} NEW{path.suffix}`, then delete it"
        )
    return partial
