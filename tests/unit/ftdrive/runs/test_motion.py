"""A recording in motion: its file, and the times of measurement."""

import zipfile
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from ftcalib.errors import BadDataset
from ftcalib.motion.samples import measured_s
from ftdrive.runs import numbers
from ftdrive.runs.motion import MotionRecording, files_of, means_of
from ftdrivers.interfaces import ArmStates, FtSamples


def recording(n: int = 500, rate_Hz: float = 100.0) -> MotionRecording:
    t_ns = (np.arange(n) / rate_Hz * 1e9).astype(np.int64)
    samples = FtSamples.of(t_ns, np.arange(n), np.tile([0, 0, -9.8, 0, 0, 0], (n, 1)))
    zeros, eye = np.zeros((n, 6)), np.tile(np.eye(3), (n, 1, 1))
    return MotionRecording(
        samples, ArmStates(t_ns, np.arange(n) / rate_Hz, zeros, zeros, eye, np.zeros((n, 3))), rate_Hz
    )


@pytest.mark.slow
def test_no_single_bit_of_its_headers_can_end_in_another_error(tmp_path: Path) -> None:
    """A flipped bit is refused, or changes nothing that is read; one of a sample is refused."""
    path = tmp_path / "motion.npz"
    recording(20).save(path)
    content = path.read_bytes()
    directory = content.index(b"PK\x01\x02")
    for byte in [*range(0, 120, 2), *range(directory, len(content), 5)]:  # all bits of a header, in different arrays
        damaged = bytearray(content)
        damaged[byte] ^= 1 << (byte % 8)
        path.write_bytes(bytes(damaged))
        with suppress(BadDataset):
            MotionRecording.load(path)
    place = directory // 2
    path.write_bytes(content[:place] + bytes([content[place] ^ 1]) + content[place + 1 :])
    with pytest.raises(BadDataset, match="not a recording in motion"):
        MotionRecording.load(path)


def test_arrays_that_unpack_to_too_much_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "motion.npz"
    recording().save(path)
    monkeypatch.setattr(numbers, "MOST_BYTES", 10_000)
    with pytest.raises(BadDataset, match=r"not a recording in motion \(its unpacked size is 0 MB, above"):
        MotionRecording.load(path)


@pytest.mark.parametrize("shape", [(10**13, 6), (10**30, 6), (10**13, 0), (20, 5), (0, 6)])
def test_a_file_whose_shapes_are_wrong_is_refused(shape: tuple[int, int], tmp_path: Path) -> None:
    path = tmp_path / "motion.npz"
    recording(20).save(path)
    with zipfile.ZipFile(path) as file:
        arrays = {name: file.read(name) for name in file.namelist()}
    arrays["wrench_wrench.npy"] = arrays["wrench_wrench.npy"].replace(b"(20, 6), }", f"{shape}, }}".encode())
    with zipfile.ZipFile(path, "w") as file:
        for name, content in arrays.items():
            file.writestr(name, content)
    with pytest.raises(BadDataset, match="not a recording in motion"):
        MotionRecording.load(path)


def test_parts_are_read_like_one_file_and_an_incomplete_one_is_ignored(tmp_path: Path) -> None:
    whole, folder = recording(), tmp_path / "motion"
    folder.mkdir()
    whole.save(tmp_path / "motion.npz")
    for number, start in enumerate(range(0, 500, 45), 1):  # more than 9, so that names do not sort by text
        rows = slice(start, start + 45)
        MotionRecording(whole.samples.rows(rows), whole.states.rows(rows), 100.0).save(folder / f"{number}.npz")
    (folder / "13.npz.partial").write_bytes(b"PK")
    parts = map(MotionRecording.load, files_of(folder))
    assert np.array_equal(np.concatenate([one.samples.seq for one in parts]), whole.samples.seq)
    for one, other in zip(means_of(folder), means_of(tmp_path / "motion.npz"), strict=True):
        for found, expected in zip(one.result(), other.result(), strict=True):
            np.testing.assert_allclose(found, expected, atol=1e-9)


def test_samples_that_are_received_late_do_not_move_the_others() -> None:
    rng, count = np.random.default_rng(0), np.arange(2000.0)
    true_s = count / 500.0
    received_s = true_s + 0.002 + rng.exponential(2e-4, len(count))
    received_s[700:760] += 0.15  # this computer was busy
    received_s = np.maximum.accumulate(received_s)
    found = measured_s(count.astype(float), (received_s * 1e9).astype(np.int64), 0)
    assert np.abs(found - true_s - 0.002).max() < 2e-4
