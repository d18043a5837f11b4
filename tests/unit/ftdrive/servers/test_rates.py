"""Lower rates: means with their times, losses and interruptions, and rows that are picked."""

from dataclasses import replace

import numpy as np
import pytest

from ftdrive.servers.ros2 import Averaged
from ftdrive.stream.samples import Picked, WrenchFrame
from tests.unit.ftdrive.servers.fake_stream import block


def test_means_of_seven_kilohertz_have_the_rate_and_the_numbers() -> None:
    averaged = Averaged(7000.0, 500.0)
    means = [averaged.add(block(31, start)) for start in range(0, 31 * 100, 31)]
    t_ns = np.concatenate([one.t_host_ns for one in means])
    assert averaged.count == 14
    assert np.allclose(np.diff(t_ns), 2e6, atol=2)
    all_raw = block(31 * 100).raw[: 14 * len(t_ns)].reshape(-1, 14, 6).mean(axis=1)
    assert np.allclose(np.concatenate([one.raw for one in means]), all_raw)
    assert np.allclose(np.concatenate([one.wrench for one in means]), -all_raw)


def test_a_lost_sample_leaves_the_mean_of_the_others() -> None:
    sent = block(28)
    means = Averaged(7000.0, 500.0).add(sent.rows(sent.seq != 3))
    assert len(means.raw) == 2
    assert np.allclose(means.raw[0], np.delete(sent.raw[:14], 3, axis=0).mean(axis=0))


def test_the_rest_of_an_interval_is_dropped_where_its_mean_would_be_late_or_of_two_frames() -> None:
    averaged = Averaged(7000.0, 500.0)
    assert not len(averaged.add(block(7)).raw)
    later = averaged.add(block(28, 14 * 100))
    assert np.allclose(later.raw[0], block(14, 14 * 100).raw.mean(axis=0))
    averaged.add(block(7, 14 * 200))
    turned = replace(block(7, 14 * 200 + 7), frame=WrenchFrame("base"))
    assert np.allclose(averaged.add(turned).raw, turned.raw.mean(axis=0))


@pytest.mark.parametrize("size", [7, 7000])
def test_the_rate_of_picked_rows_does_not_depend_on_the_size_of_the_blocks(size: int) -> None:
    t_ns = (np.arange(7000) * 1_000_000_000) // 7000
    picked = Picked(60.0)
    chosen = np.concatenate([picked.rows(t_ns[i : i + size]) for i in range(0, len(t_ns), size)])
    assert chosen.sum() == 60
    assert np.ptp(np.diff(t_ns[chosen])) < 2 * (t_ns[1] + 1)
