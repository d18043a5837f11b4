"""Readings of a sensor alone as a text table, which `solve` and `compensate` take beside a table of poses."""

from pathlib import Path
from typing import Final

import numpy as np

from ftdrive.live.samples import Block, StreamEvent, StreamInfo
from ftdrive.recording.growing_file import GrowingFile

_ROW: Final = "{:.6f}," + ",".join(["{:.7g}"] * 6) + "\n"


class RawTable:
    """A new .csv: time in UTC seconds, then the raw wrench in N and N·m, sensor axes, about the sensor origin.

    A tare is not subtracted. A text table has no place for events.

    Parameters
    ----------
    path : Path
    info : StreamInfo

    Raises
    ------
    OSError
        The file exists, or its folder cannot be written.
    """

    def __init__(self, path: Path, info: StreamInfo) -> None:
        self._utc_offset_ns = info.utc_offset_ns
        self._file = GrowingFile(path)
        self._file.add(b"t,fx,fy,fz,tx,ty,tz\n")

    def write(self, block: Block) -> None:
        """Take samples."""
        rows = np.column_stack([(block.t_host_ns + self._utc_offset_ns) * 1e-9, block.raw])
        self._file.add("".join(_ROW.format(*row) for row in rows).encode())

    def event(self, event: StreamEvent) -> None:
        """Do nothing."""

    def close(self) -> None:
        """Complete the file."""
        self._file.complete()
