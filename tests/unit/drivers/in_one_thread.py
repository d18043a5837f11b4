"""A stream on a fake clock: the reader takes its turns in the test's thread whenever a caller waits."""

from ftdrivers.streaming.sensor import StreamingSensor
from tests.fake_clock import FakeClock

TURN_S = 1e-4
"""Between two turns: time passes also where a read never has to wait."""


class _Reader:
    def join(self, _: float) -> None: ...

    def is_alive(self) -> bool:
        return False


class InOneThread(StreamingSensor):
    """Comes before the class of a driver; its clock is a `FakeClock`."""

    def _start_reader(self) -> None:
        self._thread = _Reader()  # type: ignore[assignment]
        self._schedule_turn()

    def _is_mine(self) -> bool:
        return self._thread is not None

    def _schedule_turn(self) -> None:
        assert isinstance(self._clock, FakeClock)
        reader = self._thread

        def turn() -> None:
            if self._thread is reader and not self._has_ended:
                self._take_turn()
                self._schedule_turn()

        if reader is not None:
            self._clock.at(TURN_S, turn)
