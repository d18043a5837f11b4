"""A recording that an emulated cell plays: the sensor sends the recorded wrench, the arm has the recorded joints.

The file is a CSV table with a header. Columns are found by name, with or without their unit, and others are ignored:
``t_s``; ``raw_fx`` to ``raw_fz`` in N and ``raw_tx`` to ``raw_tz`` in N·m; ``q0`` to ``q5`` in rad. Lines that begin
with ``#`` are comments.
"""

import re
from pathlib import Path

import numpy as np

from ftmocks.arrays import Array
from ftmocks.clock import CellClock
from ftmocks.kinematics import ZERO6, Dh, JointState, vector6
from ftmocks.ur.motion import Arm
from ftmocks.world import Truth, World

WRENCH_COLUMNS = tuple(f"raw_{axis}" for axis in ("fx", "fy", "fz", "tx", "ty", "tz"))
JOINT_COLUMNS = tuple(f"q{joint}" for joint in range(6))
COLUMNS = ("t_s", *WRENCH_COLUMNS, *JOINT_COLUMNS)
_UNIT = re.compile("_(N|Nm|rad)$")
_ROUNDING_S = 1e-9


class Recording:
    """Raw wrench and joint angles over time, and the current position of the playback.

    Parameters
    ----------
    t_s
        (n,) increasing times.
    wrench
        (n, 6) wrench in sensor axes, N and N·m.
    q_rad
        (n, 6) joint angles.

    Raises
    ------
    ValueError
        There are fewer than two rows, a value is not finite, or the time does not increase.
    """

    def __init__(self, t_s: Array, wrench: Array, q_rad: Array) -> None:
        if len(t_s) < 2:
            raise ValueError(f"a recording needs two rows or more, but this file has {len(t_s)}")
        finite = np.isfinite(t_s) & np.isfinite(wrench).all(axis=1) & np.isfinite(q_rad).all(axis=1)
        if not finite.all():
            raise ValueError(f"row {int(np.argmin(finite)) + 1} holds a value that is not finite")
        rising = np.diff(t_s) > 0.0
        if not rising.all():
            raise ValueError(f"the time does not rise from row {int(np.argmin(rising)) + 1} to the next")
        self._t_s, self._wrench, self._q_rad = t_s - t_s[0], wrench, q_rad
        self._played = (0.0, 0.0, 0.0)

    @classmethod
    def read(cls, path: Path) -> "Recording":
        """Read a CSV file.

        Raises
        ------
        ValueError
            A column is missing, or a value is not a number.
        OSError
            The file cannot be read.
        """
        with path.open(encoding="utf-8-sig") as file:
            line = next((line for line in file if line.strip() and not line.startswith("#")), "")
            names = [_UNIT.sub("", name.strip().strip('"')) for name in line.split(",")]
            if missing := [name for name in COLUMNS if name not in names]:
                raise ValueError(f"{path}: no column {', '.join(missing)}")
            try:
                table = np.loadtxt(file, delimiter=",", usecols=[names.index(name) for name in COLUMNS], ndmin=2)
                return cls(table[:, 0], table[:, 1:7], table[:, 7:])
            except ValueError as error:
                raise ValueError(f"{path}: {error}") from None

    def __len__(self) -> int:
        return len(self._t_s)

    @property
    def duration_s(self) -> float:
        """Time from the first to the last row, s."""
        return float(self._t_s[-1])

    @property
    def pace(self) -> float:
        """Speed of the playback: recorded time per time of the cell."""
        return self._played[2]

    def play(self, now_s: float, at_s: float, pace: float) -> None:
        """Continue at `at_s` of the recording when the cell's clock is at `now_s`.

        Raises
        ------
        ValueError
            `at_s` is not in the recording, or the pace is negative or not finite.
        """
        if not (0.0 <= at_s <= self.duration_s and 0.0 <= pace < np.inf):
            raise ValueError(f"at_s is {at_s} and pace {pace}; give 0 to {self.duration_s}, and a pace of 0 or more")
        self._played = (now_s, at_s, pace)

    def at_s(self, t_s: float) -> float:
        """Convert a time of the cell's clock to the time in the recording, s; after its end, that of the last row."""
        return float(self._at_s(np.array([t_s]))[0])

    def wrench(self, t_s: Array) -> Array:
        """Return the raw wrench (n, 6) at the given cell times: for each time, that of the latest row not after it."""
        rows = np.searchsorted(self._t_s, self._at_s(t_s) + _ROUNDING_S, side="right") - 1
        wrench: Array = self._wrench[rows]
        return wrench

    def joints(self, t_s: float) -> JointState:
        """Return the recorded joint angles and speeds at a time of the cell's clock, by linear interpolation."""
        at_s = self.at_s(t_s)
        row = min(int(np.searchsorted(self._t_s, at_s, side="right")), len(self) - 1)
        (before, after), (a, b) = self._t_s[row - 1 : row + 1].tolist(), self._q_rad[row - 1 : row + 1]
        share = (at_s - before) / (after - before)
        runs = at_s < self.duration_s and self.pace > 0.0
        speed: Array = (b - a) * (self.pace / (after - before))
        return JointState(vector6(a + share * (b - a)), vector6(speed) if runs else ZERO6)

    def _at_s(self, t_s: Array) -> Array:
        now_s, at_s, pace = self._played
        return np.clip(at_s + (t_s - now_s) * pace, 0.0, self._t_s[-1])


class RecordedWorld(World):
    """The cell of a recording, with the recorded wrench and the current contacts.

    Bias, noise and drift of this cell are added to those in the recording.
    """

    def __init__(self, recording: Recording, truth: Truth, dh: Dh, seed: int, clock: CellClock) -> None:
        super().__init__(truth, dh, recording.joints(0.0).q, seed, clock)
        self.recording = recording

    def load_wrench(self, t_s: float | None = None) -> Array:
        """Return the recorded wrench (6,) at a time of the cell's clock, by default now."""
        wrench: Array = self.recording.wrench(np.array([self.now_s if t_s is None else t_s]))[0]
        return wrench

    def _true_wrenches(self, t_s: Array) -> Array:
        now_s = float(t_s[-1])
        return self.recording.wrench(t_s) + self.contact_wrench(now_s) + self.bias(now_s)


class RecordedArm(Arm):
    """An arm that follows a recording and accepts no command."""

    obstacle = "the arm follows a recording"

    def __init__(self, dh: Dh, recording: Recording) -> None:
        super().__init__(dh, recording.joints(0.0).q)
        self._recording = recording

    def step(self, dt: float, t_s: float = 0.0) -> None:
        """Set the joints to those of the recording at `t_s` of the cell's clock."""
        q, qd, _qdd = self._recording.joints(t_s)
        if q != self.q:  # at rest, keep the same tuple: other code detects rest by comparing identities
            self.q = self.actual_q = q
        self.qd = self.actual_qd = qd if any(qd) else ZERO6
        self.still_s = 0.0 if any(qd) else self.still_s + dt
