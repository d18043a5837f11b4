"""Times of measurement, interpolated poses, and which sample gets which pose."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from ftcalib.model import angle_between
from ftcalib.motion.samples import RATE_TOLERANCE, SampleClock
from ftdrive.stream.pairing import Pairing, PoseTrack
from tests.unit.ftdrive.stream.simulated import T0_NS, Motion


def received(seconds: float, rate_Hz: float, batch: int, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Counts and times of receipt: batches, each later than its newest sample by at least 0.2 ms."""
    count = np.arange(round(seconds * rate_Hz) // batch * batch)
    newest = count.reshape(-1, batch)[:, -1]
    late_s = 2e-4 + np.random.default_rng(seed).exponential(2e-3, len(newest))
    at_s = np.maximum.accumulate(newest / rate_Hz + late_s)
    return count, T0_NS + np.repeat(at_s * 1e9, batch).astype(np.int64)


def stamped(line: SampleClock, count: np.ndarray, t_ns: np.ndarray) -> np.ndarray:
    """Times of measurement of samples that arrive in batches of 8."""
    parts = [slice(i, i + 8) for i in range(0, len(count), 8)]
    return np.concatenate([line.stamp(count[part].astype(float), t_ns[part]) for part in parts])


def test_a_restarted_device_begins_a_new_line() -> None:
    line = SampleClock(1.0)
    first = line.stamp(np.array([5000.0, 5000.1]), T0_NS + np.array([0, 100_000_000]))
    again = line.stamp(np.array([3.0, 3.1]), T0_NS + np.array([900_000_000, 1_000_000_000]))
    np.testing.assert_array_equal(np.concatenate([first, again]) - T0_NS, [0, 100_000_000, 900_000_000, 1_000_000_000])


@settings(max_examples=25)
@given(st.integers(0, 2**32 - 1), st.floats(0.001, 1.5))
def test_orientations_are_interpolated_as_by_scipy(seed: int, step_rad: float) -> None:
    rng = np.random.default_rng(seed)
    steps = rng.normal(size=(9, 3))
    steps *= step_rad / np.linalg.norm(steps, axis=1, keepdims=True)
    rotations = [Rotation.random(rng=rng)]
    for step in steps:
        rotations.append(rotations[-1] * Rotation.from_rotvec(step))
    keys = Rotation.concatenate(rotations)
    t_ns = T0_NS + np.cumsum(rng.integers(1_000_000, 9_000_000, 10))
    poses = PoseTrack()
    for piece in (slice(0, 4), slice(4, 10)):
        poses.add(t_ns[piece], np.zeros((10, 6))[piece], keys.as_matrix()[piece], np.zeros((10, 3))[piece])
    at_ns = np.sort(rng.integers(t_ns[0], t_ns[-1], 30))
    expected = Slerp((t_ns - T0_NS).astype(float), keys)((at_ns - T0_NS).astype(float)).as_matrix()
    assert angle_between(poses.at(at_ns)[1], expected).max() < 1e-7


def test_a_sample_waits_for_the_pose_unless_the_next_one_is_due() -> None:
    pairing = Pairing(1000.0, 0.0)
    samples, states = Motion().links(0.2, 0.0, rate_Hz=1000.0, batch_s=0.001)
    pairing.add_samples(samples)
    assert pairing.take() is None
    half = slice(0, 50)
    pairing.add_states(states.rows(half))
    first = pairing.take()
    assert first is not None
    assert states.t_host_ns[49] < first.t_host_ns[-1] <= states.t_host_ns[49] + 2_000_000  # by one interval
    assert pairing.waits_for_pose
    pairing.add_states(states.rows(slice(50, None)))
    second = pairing.take()
    assert second is not None
    seq = np.concatenate([first.seq, second.seq])
    assert (np.diff(seq) == 1).all()
    assert len(seq) > 190


def test_the_pose_is_that_of_the_measurement() -> None:
    motion, delay_s = Motion(), 0.013
    samples, states = motion.links(2.0, delay_s, rate_Hz=1000.0)
    pairing, found = Pairing(1000.0, delay_s), []
    for i in range(100):
        pairing.add_states(states.rows(slice(10 * i, 10 * i + 10)))
        pairing.add_samples(samples.rows(slice(20 * i, 20 * i + 20)))
        if (paired := pairing.take()) is not None:
            found.append(paired)
    late = found[-50:]
    R = np.concatenate([paired.R_base_flange for paired in late])
    seq = np.concatenate([paired.seq for paired in late])
    assert angle_between(R, motion.pose(seq * 1e-3)[0]).max() < 5e-4  # half a millisecond at 1 rad/s


def test_lost_samples_that_nothing_counts_bend_the_line_for_some_seconds_only() -> None:
    count, t_ns = received(12.0, 1000.0, 8)
    t_ns[4000:] += 30_000_000  # 30 samples are missing
    line = SampleClock(1e-3, RATE_TOLERANCE)
    stamps = stamped(line, count, t_ns)
    error_s = (stamps - T0_NS) * 1e-9 - count * 1e-3 - 2e-4 - np.where(count < 4000, 0, 0.03)
    assert np.abs(error_s[7000:]).max() < 5e-4
    assert (np.diff(stamps) > 0).all()


def test_a_clock_of_coarse_steps_is_no_restart() -> None:
    _, t_ns = received(6.0, 1000.0, 1)
    coarse_s = np.floor(np.arange(len(t_ns)) / 4) * 4e-3
    line = SampleClock()
    stamps = np.concatenate([line.stamp(coarse_s[i : i + 1], t_ns[i : i + 1]) for i in range(len(t_ns))])
    assert (np.diff(stamps) >= 0).all()
    assert np.abs((stamps - T0_NS)[3000:] * 1e-9 - coarse_s[3000:] - 2e-4).max() < 5e-4
