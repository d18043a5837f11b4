"""Fields of a Robotous sensor from their halves on CAN, which carry no number.

Pure: halves go in with the time of their receipt, fields come out that are not of two samples.
"""

import math

from drivers.robotous import codec
from drivers.robotous.codec import Field

_SILENCE_S = 0.002
"""The halves of a field follow each other on the bus; so long a silence, or half a period, lies between two fields."""
_DRIFT = 0.12
"""How much slower than it says the sensor may be: manual and vendor's header differ by a tenth on one rate."""
_LATE = 0.5
"""By how much of a period the host may be late when it has all fields."""
_EARLY = 0.25
"""By how much of a period the clock may be late when it counts what is missing."""
_MOST_WAITING = 1000


class Halves:
    """Pairs halves, and believes no pair that may be crosswise.

    Halves must take turns. That is not enough: where a second half and the next first one are lost, what is left takes
    turns, but it is a field short of the clock. So a run of fields is believed in the first silence after it, and only
    if all that were due since the last one have come. A late host has all of them, since it finds together what it
    missed: the next run tells late from lost, and meanwhile the fields wait. After a half that is out of turn all
    up to the next silence is thrown away, and the run that follows only sets the clock, as do the first two.

    Parameters
    ----------
    period_s : float
        Between two samples; NaN for replies, which come when they are asked for.
    late_s : float
        By how much the sensor itself may be late, as an emulated one is on a busy computer. A shorter lack is then no
        loss, so two neighbouring losses are not noticed.
    """

    def __init__(self, period_s: float = math.nan, late_s: float = 0.0) -> None:
        self.silence_s = _SILENCE_S if math.isnan(period_s) else min(_SILENCE_S, period_s / 2)
        """How long nothing must come for `silence` to be called."""
        self.lost = 0
        """Fields that were due and are not believed."""
        self.quiet = True
        """Whether nothing came since a silence."""
        self._period_ns = period_s * 1e9
        self._late_ns = late_s * 1e9
        self._number = 0
        self._clock_ns: float | None = None
        """When the field `_number` came."""
        self._first = b""
        self._waiting: list[Field] = []
        """Fields since then, which the clock has not confirmed yet."""
        self._doubtful = 0
        """How many of them came late or after a loss."""
        self._in_turn = True
        self._in_step = False
        """Whether the clock counts these fields: nothing was out of turn since it was set."""

    def take(self, t_host_ns: int, data: bytes, *, second: bool) -> None:
        """Take a half."""
        self.quiet = False
        if second != bool(self._first) or len(data) != codec.REPLY_SIZE // 2 or len(self._waiting) == _MOST_WAITING:
            self._in_turn = False
        if second:
            self._waiting.append(Field(self._number + len(self._waiting) + 1, t_host_ns, self._first + data))
            self._first = b""
        else:
            self._first = data

    def silence(self) -> list[Field]:
        """Return the fields that can be believed now that nothing has come for `silence_s`."""
        if self.quiet:
            return []
        self.quiet = True
        if not self._in_turn:
            # a first half that has come last may be the beginning of the next field, or all there is of its own
            self._first, self._waiting, self._doubtful = b"", [], 0
            self._in_turn, self._in_step = True, False
        if self._first or not self._waiting:
            return []
        if not self._in_step and not math.isnan(self._period_ns):
            self._set_clock(len(self._waiting))
        elif self._complete():
            return self._believe()
        elif not self._doubtful:
            self._doubtful = len(self._waiting)
        else:
            self._set_clock(self._doubtful)
            if self._complete():
                return self._believe()
            self._set_clock(len(self._waiting), by_period=False)  # twice: the sensor's own time has shifted
        return []

    def _complete(self) -> bool:
        """Tell whether all fields that were due since the clock was set have come."""
        if self._clock_ns is None:
            return True
        # there cannot be too many: it is the clock that was set late
        due_ns = (len(self._waiting) + _LATE) * self._period_ns + self._late_ns
        return self._waiting[-1].t_host_ns - self._clock_ns < due_ns

    def _believe(self) -> list[Field]:
        fields, self._waiting, self._doubtful = self._waiting, [], 0
        self._number = fields[-1].number
        if self._clock_ns is not None:
            latest_ns = self._clock_ns + len(fields) * self._period_ns * (1 + _DRIFT)
            self._clock_ns = min(latest_ns, fields[-1].t_host_ns)
        return fields

    def _set_clock(self, fields: int, *, by_period: bool = True) -> None:
        """Set the clock by the last of the oldest fields, and throw them away.

        The host may be late: a clock that was set before only moves on by whole periods.
        """
        clock_ns: float = self._waiting[fields - 1].t_host_ns
        self._in_step = by_period and self._clock_ns is not None  # else it may be late, and the next run sets it again
        if self._clock_ns is not None:
            missed = max(1, math.floor((clock_ns - self._clock_ns) / self._period_ns + _EARLY))
            if by_period:
                clock_ns = min(clock_ns, self._clock_ns + missed * self._period_ns)
            if self._number:  # the stream begins with the first that is believed
                self._number += missed
                self.lost += missed
        self._clock_ns = clock_ns
        self._waiting = [
            field._replace(number=self._number + place) for place, field in enumerate(self._waiting[fields:], 1)
        ]
        self._doubtful = 0
