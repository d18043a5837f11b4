"""Dataset of a calibration: one orientation and one mean wrench per pose; pooling of the covariances."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ftcalib.data.dwell_mean import CHANNELS
from ftcalib.display import Displayed, Row, Summary
from ftcalib.errors import BadDataset
from ftcalib.files import JSON, check_format, read_object, write_object
from ftcalib.model import ROUNDING, Array, Rotations, matrices_of, nearest_rotation, read_only
from ftcalib.rounding import counted
from ftcalib.shown import data_frame

FORMAT = "ftdrive.dataset/1"

# What orientations map: flange to base coordinates, like a robot pose, or the inverse, like e_bR in the papers.
Orientation = Literal["R_base_flange", "R_flange_base"]

# Largest accepted value in N, N·m or their squares, so that powers of it do not overflow.
LARGEST = 1e9
# Smallest accepted variance, N² or (N·m)², for a sigma of 1 nN. Products of smaller ones would lose all digits.
_LEAST_VARIANCE = 1e-18
_MATRIX_COLUMNS = ("r11", "r12", "r13", "r21", "r22", "r23", "r31", "r32", "r33")


@dataclass(frozen=True, eq=False, repr=False)
class CalibrationDataset(Displayed):
    """Dataset of n static poses, one row each. Arrays are read-only copies.

    Orientations rounded to three or more decimals are projected onto SO(3).

    Raises
    ------
    BadDataset
        The message names the row, counted from 1, and the fault.

    Examples
    --------
    >>> import ftdrive, numpy as np
    >>> from scipy.spatial.transform import Rotation
    >>> poses = [Rotation.from_rotvec([0, 0, 0]), Rotation.from_rotvec([np.pi / 2, 0, 0])]
    >>> dataset = ftdrive.CalibrationDataset.of(poses, np.zeros((2, 6)))
    >>> len(dataset), dataset.R_base_flange.shape
    (2, (2, 3, 3))
    """

    R_base_flange: Array
    """(n, 3, 3) orientations of the flange: map flange coordinates to base coordinates."""
    wrench: Array
    """(n, 6) mean wrench in N and N·m as measured, in the sensor frame: no bias, tare or compensation applied."""
    wrench_cov: Array | None
    """(n, 6, 6) covariances of the means; None = unknown."""
    n_samples: NDArray[np.int64]
    """(n,) number of samples of each mean; 0 = unknown."""
    t_s: Array
    """(n,) times since the first pose, s; NaN = unknown."""
    meta: Mapping[str, JSON] = field(default_factory=dict)
    """Metadata, such as serial numbers, versions and events."""

    def __post_init__(self) -> None:
        n = len(np.atleast_1d(np.asarray(self.R_base_flange)))
        if n == 0:
            raise BadDataset("the dataset has no pose: record at least four.")
        wrench = _require_measured("wrench", self.wrench, (n, 6))
        R_base_flange = proper_rotations(_require_measured("R_base_flange", self.R_base_flange, (n, 3, 3)))
        t_s = _require_shape("t_s", self.t_s, (n,))
        for i in np.flatnonzero(np.isinf(t_s)):
            raise BadDataset(f"row {i + 1}: t_s is {t_s[i]}, expected seconds or NaN for unknown.")
        n_samples = _require_shape("n_samples", self.n_samples, (n,))
        for i in np.flatnonzero(~((n_samples >= 0) & (n_samples == np.floor(n_samples)))):
            raise BadDataset(f"row {i + 1}: n_samples is {n_samples[i]:g}, expected a whole number, 0 for unknown.")
        n_samples = n_samples.astype(np.int64)
        n_samples.setflags(write=False)
        arrays = {"R_base_flange": R_base_flange, "wrench": wrench, "t_s": t_s}
        if self.wrench_cov is not None:
            arrays["wrench_cov"] = _covariances(_require_measured("wrench_cov", self.wrench_cov, (n, 6, 6)))
        try:
            meta = json.loads(json.dumps(dict(self.meta), allow_nan=False))
        except (TypeError, ValueError) as exc:
            raise BadDataset(f"meta cannot be written as JSON ({exc}): use text, numbers, lists and mappings.") from exc
        frozen = {name: read_only(array) for name, array in arrays.items()}
        for name, value in (frozen | {"n_samples": n_samples, "meta": MappingProxyType(meta)}).items():
            object.__setattr__(self, name, value)

    @classmethod
    def of(
        cls,
        R_base_flange: Rotations,
        wrench: ArrayLike,
        *,
        wrench_cov: ArrayLike | None = None,
        n_samples: ArrayLike = 0,
        t_s: ArrayLike = np.nan,
        meta: Mapping[str, JSON] | None = None,
    ) -> Self:
        """Return a dataset from rotations, such as a list of scipy rotations, and mean wrenches.

        Parameters
        ----------
        R_base_flange : array, shape (n, 3, 3), or n Rotations
        wrench : array_like, shape (n, 6)
        wrench_cov : array_like, shape (n, 6, 6) or (6, 6), optional
        n_samples, t_s : array_like, shape (n,) or one number for all

        Raises
        ------
        BadDataset
        """
        wrench = np.asarray(wrench)
        n = len(np.atleast_1d(wrench))

        def of_each(value: ArrayLike, ndim: int) -> Any:
            array = np.asarray(value)
            return array if array.ndim > ndim else np.broadcast_to(array, (n, *array.shape))

        return cls(
            R_base_flange=matrices_of(R_base_flange),
            wrench=wrench,
            wrench_cov=None if wrench_cov is None else of_each(wrench_cov, 2),
            n_samples=of_each(n_samples, 0),
            t_s=of_each(t_s, 0),
            meta=meta or {},
        )

    def __len__(self) -> int:
        """Return the number of poses."""
        return len(self.wrench)

    def _summary(self) -> Summary:
        least, most = self.wrench.min(axis=0), self.wrench.max(axis=0)
        ranges = [f"{low:.4g} to {high:.4g}" for low, high in zip(least, most, strict=True)]
        noise = "unknown"
        if self.wrench_cov is not None:
            force, torque = np.sqrt(
                np.diagonal(self.wrench_cov, axis1=1, axis2=2).mean(axis=0).reshape(2, 3).mean(axis=1)
            )
            noise = f"{force:.2g} N, {torque:.2g} N·m rms"
        rows = [
            Row("force x, y, z", ranges[:3], "N"),
            Row("torque x, y, z", ranges[3:], "N·m"),
            Row("sigma of a mean", [noise]),
            Row("duration", [f"{np.ptp(self.t_s):.6g} s" if np.isfinite(self.t_s).all() else "unknown"]),
            *([Row("source", [str(self.meta["source"])])] if "source" in self.meta else []),
        ]
        return Summary(f"Dataset of {counted(len(self), 'pose')}, wrenches as measured, in the sensor frame", rows)

    def to_frame(self) -> Any:
        """Return a pandas DataFrame, or a Polars one if pandas is not installed; `ftdrive.read_dataset` can read it.

        Returns
        -------
        DataFrame
            One row per pose: `t` in s, the rotation matrix R_base_flange `r11` to `r33`, `fx` to `tz` in N and N·m,
            and, if known, the standard errors `sigma_fx` to `sigma_tz`.

        Raises
        ------
        UsageError
            Neither package is installed.
        """
        columns = {"t": self.t_s} if np.isfinite(self.t_s).all() else {}
        columns |= dict(zip(_MATRIX_COLUMNS, self.R_base_flange.reshape(-1, 9).T, strict=True))
        columns |= dict(zip(CHANNELS, self.wrench.T, strict=True))
        if self.wrench_cov is not None:
            sigma = np.sqrt(np.diagonal(self.wrench_cov, axis1=1, axis2=2))
            columns |= {f"sigma_{name}": values for name, values in zip(CHANNELS, sigma.T, strict=True)}
        return data_frame(columns)

    def to_dict(self) -> dict[str, JSON]:
        """Return the document of a dataset file."""
        return {
            "format": FORMAT,
            "R_base_flange": self.R_base_flange.tolist(),
            "wrench": self.wrench.tolist(),
            "wrench_cov": None if self.wrench_cov is None else self.wrench_cov.tolist(),
            "n_samples": self.n_samples.tolist(),
            "t_s": [None if np.isnan(t) else t for t in self.t_s.tolist()],
            "meta": dict(self.meta),
        }

    @classmethod
    def from_dict(cls, document: Mapping[str, Any]) -> Self:
        """Return the dataset from the document of a file, ignoring unknown fields. Invalid data raise `BadDataset`."""
        check_format(document, FORMAT, BadDataset)
        names = ("R_base_flange", "wrench", "wrench_cov", "n_samples", "t_s", "meta")
        missing = [name for name in names if name not in document]
        if missing:
            raise BadDataset(f"the dataset lacks the field {', '.join(missing)}: the file is damaged.")
        t_s, meta = document["t_s"], document["meta"]
        if not isinstance(t_s, list) or not isinstance(meta, dict):
            raise BadDataset("t_s must be a list and meta an object: the file is damaged.")
        return cls(
            **{name: document[name] for name in names[:4]},
            t_s=np.array([np.nan if t is None else t for t in t_s], dtype=np.float64),
            meta=meta,
        )

    def save(self, path: str | Path) -> None:
        """Write a new file; raises `FileExistsError` if it exists."""
        write_object(path, self.to_dict(), indent=None)

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Return the dataset in a file. Raises `BadDataset` for invalid content, `OSError` for an unreadable file."""
        try:
            return cls.from_dict(read_object(path, BadDataset))
        except BadDataset as exc:
            raise BadDataset(f"{Path(path).name}: {exc}") from exc

    def sha256(self) -> str:
        """Return the SHA-256 of the content, independent of spacing and order of fields in the file.

        It covers the metadata as JSON with sorted keys, then each array: name, shape, and numbers as little-endian
        float64 row by row. An unknown covariance has no shape and no numbers.
        """
        digest = hashlib.sha256(json.dumps(dict(self.meta), allow_nan=False, sort_keys=True).encode())
        for name in ("R_base_flange", "wrench", "wrench_cov", "n_samples", "t_s"):
            array = getattr(self, name)
            digest.update(f"{name} {None if array is None else array.shape}".encode())
            digest.update(b"" if array is None else np.ascontiguousarray(array, dtype="<f8").tobytes())
        return digest.hexdigest()


def shorten_list(names: Sequence[str], most: int = 20) -> str:
    """Return names for a message, at most `most` of them, with the number of the others."""
    shown = ", ".join(name if len(name) <= 40 else f"{name[:40]}…" for name in names[:most])
    return shown if len(names) <= most else f"{shown} and {len(names) - most} more"


def require_finite(name: str, value: object, shape: tuple[int, ...]) -> Array:
    """Return an array of given shape, one row per pose; raise `BadDataset`, naming the row, if it is not finite."""
    array = _require_shape(name, value, shape)
    _reject(name, array, ~np.isfinite(array), "not a finite number.")
    return array


def _require_shape(name: str, value: object, shape: tuple[int, ...]) -> Array:
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as exc:
        raise BadDataset(f"{name} is not an array of numbers ({exc}).") from exc
    if array.shape != shape:
        raise BadDataset(f"{name} has shape {array.shape}, expected {shape}: one row per pose.")
    return array


def _require_measured(name: str, value: object, shape: tuple[int, ...]) -> Array:
    array = require_finite(name, value, shape)
    _reject(name, array, np.abs(array) > LARGEST, f"more than any sensor measures ({LARGEST:g}): check the units.")
    return array


def _reject(name: str, array: Array, wrong: NDArray[np.bool_], why: str) -> None:
    """Raise `BadDataset` for the first wrong entry."""
    for row, *rest in np.argwhere(wrong):
        entry = "".join(f"[{j}]" for j in rest)
        raise BadDataset(f"row {row + 1}: {name}{entry} is {array[(row, *rest)]:.3g}, {why}")


def proper_rotations(R: Array) -> Array:
    """Return rotation matrices (n, 3, 3) without rounding errors; raise `BadDataset`, naming the row, if invalid."""
    error = np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max(axis=(1, 2))
    for i in np.flatnonzero(error > ROUNDING):
        raise BadDataset(
            f"row {i + 1}: the orientation is not a rotation matrix, R^T R differs from the identity by {error[i]:.2g} "
            f"(rounding explains {ROUNDING:g}): check the columns and their order."
        )
    for i in np.flatnonzero(np.linalg.det(R) < 0):
        raise BadDataset(
            f"row {i + 1}: the orientation is a reflection (determinant {np.linalg.det(R[i]):.3f}), not a rotation: "
            "check the sign of one axis."
        )
    rounded = error > 1e-12  # exact rotations stay unchanged, so that a loaded dataset has the hash of the saved one
    R[rounded] = nearest_rotation(R[rounded])
    return R


def _covariances(cov: Array) -> Array:
    for i, C in enumerate(cov):
        if problem := _covariance_problem(C):
            raise BadDataset(f"row {i + 1}: wrench_cov is not a covariance matrix, {problem}.")
    return (cov + np.swapaxes(cov, 1, 2)) / 2


def _covariance_problem(C: Array) -> str | None:
    variance = np.diag(C)
    if variance.min() < _LEAST_VARIANCE:
        return f"the variance of {CHANNELS[variance.argmin()]} is {variance.min():g}, less than that of any sensor"
    correlation = C / np.outer(np.sqrt(variance), np.sqrt(variance))
    asymmetry = np.abs(correlation - correlation.T).max()
    if asymmetry > 1e-9:
        return f"it is not symmetric (correlations differ by {asymmetry:.2g})"
    smallest = np.linalg.eigvalsh(correlation).min()
    if smallest <= 1e-12:
        return f"it is not positive definite (smallest eigenvalue of the correlation {smallest:.2g})"
    return None


# Pooling of covariances of pose means that were estimated from few samples each.

# Number of independent samples at which the covariance of a pose has the same weight as the common shape.
_TRUSTED_SAMPLES = 100.0
# Ratio of median to mean of the variance of six Gaussian values: the median of chi-square(5), divided by 5.
_MEDIAN_SCATTER = 0.8702920382191053
# A pose whose six variances scatter by more than this factor keeps its own covariance shape; 1 % do so by chance.
_UNLIKE = 3.0


def pooled_covariance(wrench_cov: Array, n_samples: NDArray[np.int64]) -> Array:
    """Return each covariance shrunk towards a shape common to all poses, scaled for each pose.

    A 6 x 6 covariance from N samples is so uncertain that weighting with it increases the mean square error of the
    calibration: 3 times with N = 10, 1.15 times with N = 50. The common shape has no such error. The scale of a pose
    keeps differences between poses that exceed the scatter of N samples.

    Samples of filtered noise are correlated, and their correlation is itself uncertain: 1000 samples after a 2 Hz
    low-pass filter may determine a variance no better than 4 independent samples. The degrees of freedom, a share of
    N - 1, are therefore estimated from the covariances: within a pose, the logarithms of six equal variances scatter
    with variance 2 / freedom.

    Parameters
    ----------
    wrench_cov : array, shape (n, 6, 6)
        Covariances of the means of the poses.
    n_samples : int array, shape (n,)
        Number of samples of each pose, independent or not; 0 = unknown, and the covariance is not changed.

    Returns
    -------
    array, shape (n, 6, 6)
    """
    known = n_samples > 1
    if known.sum() < 2:
        return wrench_cov
    S = (wrench_cov if known.all() else wrench_cov[known]).reshape(-1, 36)
    freedom = np.asarray(n_samples[known] - 1, dtype=np.float64)
    size = np.ones(len(S))
    for _ in range(8):
        shape = ((freedom / size) @ S / freedom.sum()).reshape(6, 6)
        before, size = size, S @ np.linalg.inv(shape).ravel() / 6
        if np.abs(size - before).max() <= 1e-12 * size.max():
            break
    spread = _spread_within(S, shape)
    typical = float(np.median(spread * freedom)) / _MEDIAN_SCATTER / (1 - 1 / len(S))
    freedom *= min(1.0, 2 / max(typical, 1e-12))
    # The logarithms of equal scales have the variance 2 / (6 freedom), and a bias of half of it: correct both.
    log_size, scatter = np.log(size), 2 / (6 * freedom)
    mean = float(np.average(log_size, weights=freedom))
    observed = float(np.average((log_size - mean) ** 2, weights=freedom))
    real = max(observed - float(np.average(scatter, weights=freedom)), 0.0)
    size = np.exp(mean + (log_size - mean) * real / (real + scatter) + np.minimum(scatter, observed) / 2)
    own, common = np.ones(len(known)), np.zeros(len(known))
    unlike = 1 - _UNLIKE * 2 / freedom / np.maximum(spread, 1e-12)
    own[known] = np.maximum(freedom / (freedom + _TRUSTED_SAMPLES), unlike)
    common[known] = (1 - own[known]) * size
    pooled = own[:, None, None] * wrench_cov
    for i, j in np.ndindex(6, 6):  # in place, which avoids a second array of this size
        pooled[:, i, j] += common * shape[i, j]
    return pooled


def _spread_within(S: Array, shape: Array) -> Array:
    """Return the variance (n,) of the logarithms of the six variances of each covariance after whitening by `shape`."""
    white = np.linalg.inv(np.linalg.cholesky(shape))
    log_variances = np.log(S @ np.einsum("ca,cb->abc", white, white).reshape(36, 6))
    log_variances -= np.median(log_variances, axis=0)  # robust against poses with another shape
    return np.asarray(log_variances.var(axis=1, ddof=1))
