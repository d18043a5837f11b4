"""A recorded run that replaces arm and sensor in the routine."""

from collections.abc import Sequence

import numpy as np

from ftcalib.model import Array
from ftcalib.routine import ArmReading, PoseRecord, WrenchSamples


class RecordedRun:
    """Arm and sensor in one, as `ftcalib.routine` wants them; neither moves nor waits."""

    def __init__(self, records: Sequence[PoseRecord]) -> None:
        self._records = list(records)
        self._stop = -1
        self._collected = False

    def go_on_to(self, q_rad: Array) -> None:
        """Go on to the next recorded stop, which must be at these joint angles (6,)."""
        self._stop += 1
        if not np.array_equal(q_rad, self._records[self._stop].pose.q_rad):
            raise ValueError(f"stop {self._stop + 1} of the recording went elsewhere than the routine now asks")

    def wait_until_still(self, **_: object) -> None:
        """Begin a look at the pose."""
        self._collected = False

    def state(self) -> ArmReading:
        """Return the state before or after the samples."""
        record = self._records[self._stop]
        return record.after if self._collected else record.before

    def collect(self, _duration_s: float, /) -> WrenchSamples:
        """Give the samples of this stop."""
        self._collected = True
        return self._records[self._stop].samples

    def check(self) -> None:
        """Do nothing: a recording cannot fail."""
