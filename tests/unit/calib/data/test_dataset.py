"""Datasets: what is accepted, what is refused and with which words, files, CSV."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from syrupy.assertion import SnapshotAssertion

from ftcalib import BadDataset, CalibrationDataset
from ftcalib.data.dataset import pooled_covariance
from ftcalib.files import write_new

RNG = np.random.default_rng(3)
R = Rotation.random(4, rng=RNG).as_matrix()


def dataset(**changes: Any) -> CalibrationDataset:
    fields: dict[str, Any] = {
        "R_base_flange": R,
        "wrench": np.arange(24.0).reshape(4, 6) / 7,
        "wrench_cov": np.tile(np.eye(6) * 0.01, (4, 1, 1)),
        "n_samples": [100, 200, 300, 400],
        "t_s": [0.0, 1.5, np.nan, 4.0],
        "meta": {"sensor": "FT00001", "ports": [1, 2]},
    }
    return CalibrationDataset(**{**fields, **changes})


def changed(array: object, index: tuple[int, ...], value: float) -> np.ndarray[Any, Any]:
    copy = np.array(array, dtype=np.float64)
    copy[index] = value
    return copy


def wording(error: Exception) -> str:
    """Leave out what json and numpy say in their own words: they change with the version."""
    return re.sub(r"(JSON|numbers) \(.*?\)(?=[:.])", r"\1 (…)", str(error))


def test_arrays_are_copies_that_cannot_be_written_to() -> None:
    wrench = np.zeros((4, 6))
    data = dataset(wrench=wrench)
    wrench[0] = 1.0
    assert (data.wrench == 0).all()
    for array in (data.R_base_flange, data.wrench, data.wrench_cov, data.n_samples, data.t_s):
        assert array is not None
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0
    with pytest.raises(TypeError):
        data.meta["sensor"] = "other"  # type: ignore[index]  # the point of the test


@pytest.mark.parametrize("rotations", [R, list(R), Rotation.from_matrix(R), [Rotation.from_matrix(one) for one in R]])
def test_of_takes_rotations_in_any_form_and_fills_in_what_is_unknown(rotations: Any) -> None:
    data = CalibrationDataset.of(rotations, np.zeros((4, 6)).tolist(), wrench_cov=np.eye(6))
    np.testing.assert_allclose(data.R_base_flange, R, atol=1e-15)
    assert data.n_samples.tolist() == [0] * 4
    assert np.isnan(data.t_s).all()
    assert data.wrench_cov is not None
    np.testing.assert_array_equal(data.wrench_cov, [np.eye(6)] * 4)


def test_of_names_what_does_not_fit() -> None:
    with pytest.raises(BadDataset, match=r"wrench has shape \(3, 6\), expected \(4, 6\)"):
        CalibrationDataset.of(R, np.zeros((3, 6)))
    with pytest.raises(BadDataset, match=r"t_s has shape \(3,\), expected \(4,\)"):
        CalibrationDataset.of(R, np.zeros((4, 6)), t_s=[1, 2, 3])


NOT_SYMMETRIC = np.tile(np.eye(6), (4, 1, 1))
NOT_SYMMETRIC[1, 0, 1] = 0.5
INDEFINITE = np.tile(np.eye(6), (4, 1, 1))
INDEFINITE[3, 0, 1] = INDEFINITE[3, 1, 0] = 1.5


@pytest.mark.parametrize(
    "changes",
    [
        {"wrench": changed(np.zeros((4, 6)), (2, 3), np.nan)},
        {"wrench": np.zeros((3, 6))},
        {"wrench": [["a"] * 6] * 4},
        {"R_base_flange": changed(R, (1, 0, 0), np.nan)},
        {"R_base_flange": R * 1.01},
        {"R_base_flange": R * [[[1]], [[1]], [[1]], [[-1]]]},
        {"R_base_flange": np.zeros((0, 3, 3)), "wrench": np.zeros((0, 6))},
        {"wrench": changed(np.zeros((4, 6)), (2, 3), 1e30)},
        {"wrench_cov": np.tile(1e-200 * np.eye(6), (4, 1, 1))},
        {"wrench_cov": NOT_SYMMETRIC},
        {"wrench_cov": INDEFINITE},
        {"wrench_cov": np.eye(6)},
        {"t_s": [0.0, np.inf, 1.0, 2.0]},
        {"n_samples": [1, 2.5, 3, 4]},
        {"meta": {"x": float("nan")}},
    ],
)
def test_what_is_wrong_is_said_with_its_row(changes: dict[str, Any], snapshot: SnapshotAssertion) -> None:
    with pytest.raises(BadDataset) as caught:
        dataset(**changes)
    assert wording(caught.value) == snapshot


@pytest.mark.parametrize("decimals", [3, 6])
def test_rounded_rotations_are_put_back_onto_so3(decimals: int) -> None:
    exact = Rotation.random(500, rng=np.random.default_rng(1)).as_matrix()
    data = CalibrationDataset(
        exact.round(decimals), np.zeros((500, 6)), None, np.zeros(500, np.int64), np.full(500, np.nan)
    )
    assert np.abs(np.swapaxes(data.R_base_flange, 1, 2) @ data.R_base_flange - np.eye(3)).max() < 1e-14
    assert np.abs(data.R_base_flange - exact).max() < 10.0**-decimals


@pytest.mark.slow
@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.booleans(), st.integers(3, 17))
def test_a_file_gives_back_the_same_numbers(
    tmp_path_factory: pytest.TempPathFactory, seed: int, measured: bool, decimals: int
) -> None:
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(5, 6, 6)) * 10.0 ** rng.uniform(-6, 3)
    data = CalibrationDataset(
        Rotation.random(5, rng=rng).as_matrix().round(decimals),
        rng.uniform(-1, 1, size=(5, 6)) * 10.0 ** rng.uniform(-9, 9),  # what a dataset accepts
        A @ np.swapaxes(A, 1, 2) + np.eye(6) if measured else None,
        rng.integers(0, 10_000, 5),
        np.where(rng.random(5) < 0.3, np.nan, rng.random(5)),
        {"note": "µ", "seed": seed},
    )
    path = tmp_path_factory.mktemp("d") / "dataset.json"
    data.save(path)
    again = CalibrationDataset.load(path)
    for name in ("R_base_flange", "wrench", "wrench_cov", "n_samples", "t_s"):
        np.testing.assert_array_equal(getattr(again, name), getattr(data, name))
    assert dict(again.meta) == dict(data.meta)
    assert again.sha256() == data.sha256()


def test_the_hash_follows_the_content_not_the_layout() -> None:
    data = dataset()
    document = data.to_dict()
    shuffled = CalibrationDataset.from_dict({"unknown": 1, **dict(reversed(document.items()))})
    assert shuffled.sha256() == data.sha256()
    assert dataset(wrench=changed(data.wrench, (0, 0), 1e-300)).sha256() != data.sha256()


def test_a_failed_write_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OSError, match="No space left"):
        write_new(tmp_path / "x", "content")
    assert list(tmp_path.iterdir()) == []


def without(name: str) -> str:
    return json.dumps({k: v for k, v in dataset().to_dict().items() if k != name})


@pytest.mark.parametrize(
    "content",
    [
        "",
        "{",
        pytest.param("[" * 100_000, id="brackets in brackets"),
        "[1]",
        "{}",
        '{"format": "ftdrive.calibration/1"}',
        '{"format": "ftdrive.dataset/2"}',
        pytest.param(without("wrench"), id="no wrench"),
        pytest.param(without("t_s")[:-1] + ', "t_s": 3}', id="one time for all"),
        b"\xff\xfe\x00",
    ],
)
def test_a_file_that_is_something_else_is_named_in_one_sentence(
    tmp_path: Path, content: str | bytes, snapshot: SnapshotAssertion
) -> None:
    path = tmp_path / "d.json"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(BadDataset) as caught:
        CalibrationDataset.load(path)
    assert wording(caught.value) == snapshot


Array = NDArray[np.float64]
SHAPE = np.diag(np.square([1.0, 2.0, 3.0, 0.1, 0.2, 0.3]))


def sampled(rng: np.random.Generator, n_samples: NDArray[np.int64], scale: Array) -> Array:
    """Covariances of means of n samples of noise with SHAPE, times the scale of each pose."""
    return np.array(
        [
            k * np.cov(rng.multivariate_normal(np.zeros(6), SHAPE, n).T) / n
            for n, k in zip(n_samples, scale, strict=True)
        ]
    )


def test_two_poses_are_pooled_and_one_alone_is_not() -> None:
    cov = sampled(np.random.default_rng(1), np.array([20, 20, 20]), np.ones(3))
    for known in ([20, 20, 0], [20, 20, 1]):
        pooled = pooled_covariance(cov, np.array(known))
        assert not np.allclose(pooled[:2], cov[:2])
        np.testing.assert_array_equal(pooled[2], cov[2])
    np.testing.assert_array_equal(pooled_covariance(cov, np.array([20, 0, 1])), cov)


def test_a_noisy_pose_keeps_its_size() -> None:
    n_samples, scale = np.full(12, 50), np.ones(12)
    scale[4] = 25.0
    cov = sampled(np.random.default_rng(3), n_samples, scale)
    size = np.trace(np.linalg.solve(SHAPE / 50, pooled_covariance(cov, n_samples)), axis1=1, axis2=2) / 6
    assert 15 < size[4] < 40
    assert np.all(np.delete(size, 4) < 2)


def test_the_mean_noise_is_kept_where_few_samples_are_independent() -> None:
    own = SHAPE * np.random.default_rng(6).chisquare(4, (2000, 1, 6)) / 4
    pooled = np.diagonal(pooled_covariance(own, np.full(2000, 1000)), axis1=1, axis2=2) / np.diag(SHAPE)
    assert pooled.mean() == pytest.approx(1.0, abs=0.02)  # 0.96 with the mean of the logarithms
