"""A recording in motion: its file, and the times of measurement."""

from pathlib import Path

import numpy as np
import pytest

from ftcalib.errors import BadDataset
from ftdrive.runs.motion import MotionRecording, measured_s
from ftdrivers.interfaces import ArmStates, FtSamples


def recording(n: int = 500, rate_Hz: float = 100.0) -> MotionRecording:
    t_ns = (np.arange(n) / rate_Hz * 1e9).astype(np.int64)
    samples = FtSamples.of(t_ns, np.arange(n), np.tile([0, 0, -9.8, 0, 0, 0], (n, 1)))
    zeros, eye = np.zeros((n, 6)), np.tile(np.eye(3), (n, 1, 1))
    return MotionRecording(
        samples, ArmStates(t_ns, np.arange(n) / rate_Hz, zeros, zeros, eye, np.zeros((n, 3))), rate_Hz
    )


def test_it_reads_back_what_was_saved(tmp_path: Path) -> None:
    one = recording()
    one.save(tmp_path / "motion.npz")
    again = MotionRecording.load(tmp_path / "motion.npz")
    assert np.array_equal(again.samples.wrench, one.samples.wrench)
    assert np.array_equal(again.states.R_base_flange, one.states.R_base_flange)
    assert again.nominal_rate_Hz == one.nominal_rate_Hz
    wrench, poses = again.means()
    assert (wrench.samples, poses.samples) == (500, 500)


def test_a_damaged_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "motion.npz"
    recording().save(path)
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(bytes(content))
    with pytest.raises(BadDataset, match="not a recording in motion"):
        MotionRecording.load(path)


def test_samples_that_are_received_late_do_not_move_the_others() -> None:
    rng, count = np.random.default_rng(0), np.arange(2000)
    true_s = count / 500.0
    received_s = true_s + 0.002 + rng.exponential(2e-4, len(count))
    received_s[700:760] += 0.15  # this computer was busy
    received_s = np.maximum.accumulate(received_s)
    found = measured_s(count, (received_s * 1e9).astype(np.int64), 0)
    assert np.abs(found - true_s - 0.002).max() < 2e-4
