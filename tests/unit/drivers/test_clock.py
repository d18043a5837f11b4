"""A clock of an emulated cell that has no place left for another thread."""

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from ftdrivers.clock import Follower
from ftdrivers.errors import ConnectError
from tests.fake_clock import FakeClock


class Full(FakeClock):
    @contextmanager
    def keeping_up(self) -> Iterator[None]:
        raise ConnectError("too many threads use one emulated cell")
        yield


def test_a_clock_that_has_no_place_left_ends_the_start() -> None:
    follower = Follower(Full(), lambda: pytest.fail("it works without a place"), "late")
    with pytest.raises(ConnectError, match="too many"):
        follower.start()
    follower.join()
