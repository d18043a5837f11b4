"""Lower rates: means with their times, losses and interruptions, and rows that are picked."""

from dataclasses import replace

import numpy as np

from ftdrive.servers.ros2 import Averaged
from ftdrive.stream.samples import WrenchFrame
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


def test_the_rest_of_an_interval_is_dropped_where_its_mean_would_be_late_or_of_two_frames() -> None:
    averaged = Averaged(7000.0, 500.0)
    assert not len(averaged.add(block(7)).raw)
    later = averaged.add(block(28, 14 * 100))
    assert np.allclose(later.raw[0], block(14, 14 * 100).raw.mean(axis=0))
    averaged.add(block(7, 14 * 200))
    turned = replace(block(7, 14 * 200 + 7), frame=WrenchFrame("base"))
    assert np.allclose(averaged.add(turned).raw, turned.raw.mean(axis=0))
