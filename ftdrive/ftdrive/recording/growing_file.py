"""A file that grows under its name with `.partial`, and gets its name when it is complete."""

import os
from pathlib import Path
from typing import Self

from ftcalib.files import require_new


class GrowingFile:
    """A new file.

    Parameters
    ----------
    path : Path

    Raises
    ------
    OSError
        The file or its `.partial` exists already, or the folder cannot be written.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.partial = partial_of(path)
        self._file = self.partial.open("xb", buffering=0)

    @property
    def size(self) -> int:
        """Bytes so far."""
        return self._file.tell()

    def add(self, *contents: bytes) -> int:
        """Append; return where it begins. After an error the file holds what it held before."""
        start = self._file.tell()
        try:
            for content in contents:
                left = memoryview(content)
                while left:
                    left = left[self._file.write(left) :]
        except OSError:
            self._file.seek(start)
            self._file.truncate()
            raise
        return start

    def complete(self) -> None:
        """Fsync the file and give it its name. Raises `OSError`."""
        self._file.close()
        publish(self.partial, self.path)

    def discard(self) -> None:
        """Delete the file."""
        self._file.close()
        self.partial.unlink(missing_ok=True)

    def keep(self) -> None:
        """Close the file as it is."""
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.keep()


def publish(written: Path, path: Path) -> None:
    """Fsync a file and give it its name. Raises `OSError`, also if the name is taken."""
    with written.open("r+b") as file:
        os.fsync(file.fileno())
    require_new(path)
    written.rename(path)


def partial_of(path: Path) -> Path:
    """Return the name until a file is complete; raises `OSError` if it or the file exists or the folder does not."""
    partial = path.with_name(path.name + ".partial")
    require_new(path)
    if partial.exists():
        raise FileExistsError(
            f"{partial} exists: an earlier recording was interrupted. Save it with "
            f"`ftdrive convert {partial} NEW{path.suffix}`, then delete it"
        )
    return partial
