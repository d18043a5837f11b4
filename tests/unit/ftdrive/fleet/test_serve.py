"""The loop of the server, on a fake clock: when it reads, and what it does while the store cannot be read."""

from datetime import datetime, timedelta

import pytest

from ftdrive.errors import BadStore
from ftdrive.fleet.state import EVERY_S, Fleet, serve_status
from tests.fake_clock import FakeClock
from tests.unit.ftdrive.fleet.fleets import NOW, cell, fleet


class Served:
    """A server whose store answers with these, and which Ctrl-C ends after the last."""

    def __init__(self, *answers: Fleet | Exception) -> None:
        self.clock = FakeClock()
        self.readings: list[tuple[float, Fleet, datetime, bool]] = []
        self.said: list[str] = []
        self._answers = [*answers, KeyboardInterrupt()]
        self._start_s = self.clock.now_s()

    @property
    def t_s(self) -> float:
        return self.clock.now_s() - self._start_s

    def update(self, fleet: Fleet, read: datetime, store_up: bool) -> None:
        self.readings.append((self.t_s, fleet, read, store_up))

    def run(self) -> None:
        def now() -> datetime:
            return NOW + timedelta(seconds=self.t_s)

        serve_status(self._fleet_at, self.update, self.clock, say=self.said.append, now=now)

    def _fleet_at(self, _now: datetime) -> Fleet:
        answer = self._answers.pop(0)
        if isinstance(answer, BaseException):
            raise answer
        return answer


def test_the_state_is_read_every_minute_until_ctrl_c() -> None:
    served = Served(fleet(cell("A")), fleet(cell("A"), cell("B")))
    with pytest.raises(KeyboardInterrupt):
        served.run()
    times, fleets, read, _ = zip(*served.readings, strict=True)
    assert (times, read) == ((0, EVERY_S), (NOW, NOW + timedelta(seconds=EVERY_S)))
    assert [len(one.cells) for one in fleets] == [1, 2]
    assert served.t_s == 2 * EVERY_S
    assert not served.said


def test_an_outage_keeps_the_last_state_with_its_age_and_is_said_once() -> None:
    served = Served(fleet(cell("A")), *[BadStore("the store db cannot be read (gone)")] * 3, fleet(cell("B")))
    with pytest.raises(KeyboardInterrupt):
        served.run()
    times, fleets, read, is_up = zip(*served.readings, strict=True)
    assert is_up == (True, False, False, False, True)
    assert [one.cells[0].cell for one in fleets] == ["A", "A", "A", "A", "B"]
    ages = [NOW + timedelta(seconds=t_s) - then for t_s, then in zip(times, read, strict=True)]
    assert [age / timedelta(seconds=EVERY_S) for age in ages] == [0, 1, 2, 3, 0]
    assert served.said == [
        "the store db cannot be read (gone). The server shows the last state, which is 1 min old.",
        "The store can be read again.",
    ]


def test_a_store_that_cannot_be_read_at_the_start_ends_the_server() -> None:
    served = Served(BadStore("password authentication failed"))
    with pytest.raises(BadStore, match="password authentication"):
        served.run()
    assert not served.readings
