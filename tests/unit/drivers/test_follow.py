"""What one follower has not read yet: as many samples as may wait are read, one more is an error."""

import pytest

from ftdrivers.errors import StreamBroken
from ftdrivers.follow import Unread


def test_as_many_samples_as_may_wait_are_read_and_one_more_is_an_error() -> None:
    unread: Unread[str] = Unread("sensor", 3)
    unread.put("two", 2)
    unread.put("one")
    unread.check()
    assert unread.take() == ["two", "one"]
    assert unread.take() == []
    unread.put("two", 2)
    unread.put("two more", 2)
    with pytest.raises(StreamBroken, match="sensor: 4 samples are waiting to be read, and the limit is 3"):
        unread.take()
