"""Fewer rows of blocks."""

import numpy as np
import pytest

from ftdrive.servers.rates import Picked


@pytest.mark.parametrize("size", [1, 7, 70, 7000])
def test_the_rate_does_not_depend_on_the_size_of_the_blocks(size: int) -> None:
    t_ns = (np.arange(7000) * 1_000_000_000) // 7000
    picked = Picked(60.0)
    chosen = np.concatenate([picked.rows(t_ns[i : i + size]) for i in range(0, len(t_ns), size)])
    assert chosen.sum() == 60
    assert np.ptp(np.diff(t_ns[chosen])) < 2 * (t_ns[1] + 1)


def test_a_slow_stream_is_sent_whole() -> None:
    assert Picked(500.0).rows(np.arange(10) * 8_000_000).all()


def test_a_pause_is_no_debt() -> None:
    picked = Picked(100.0)
    picked.rows(np.array([0]))
    assert picked.rows(np.array([5_000_000_000, 5_001_000_000, 5_002_000_000])).tolist() == [True, False, False]
