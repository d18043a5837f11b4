"""Noise model of a session: independent noise of every pose, and a bias that drifts from pose to pose.

    V = blockdiag(D_i) + S (K (x) I6) S + slopes + effects,    S = diag(walk)

K is the covariance of a random walk minus its mean over the poses, if the bias is the mean bias, or minus its value at
one pose, if the bias is that of the pose. Its inverse is tridiagonal: by Woodbury's identity, all operations are O(n).
"""

from collections.abc import Iterator
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dpbtrf, dpbtrs

from ftcalib.model import Array

# Rows per matrix product, so that a chunk stays in the cache.
CHUNK = 4096
# Shortest interval, in mean intervals, so that two poses at the same time have nearly the same bias.
SHORTEST_STEP = 1e-3
# Weight of a rejected pose: too small to influence the fit, but enough to compute its prediction.
FAINT = 1e-9


class Noise:
    """Covariance of the wrenches of all poses, and products with its inverse.

    Parameters
    ----------
    D : array, shape (n, 6, 6)
        Covariance of the independent noise of each pose.
    time : array, shape (n,), or None
        Ascending, in mean intervals between poses. Not needed without drift.
    walk : array, shape (6,), or None
        Standard deviation of the change of each channel's bias over one unit of time.
    slope : array, shape (6,), or None
        Standard deviation of each channel's linear change over the session; infinite = unknown.
    effects : tuple of array, shapes (n, 6, k) and (k,), or None
        Columns of coefficients common to all poses, and the variances of these coefficients.
    kept : bool array, shape (n,), or None
        Poses that are used. The others have almost no weight, as if they were deleted.
    origin : int or None
        Index of the pose at which walk and slope are zero; None: their mean over all poses is zero.
    """

    def __init__(
        self,
        D: Array,
        time: Array | None = None,
        walk: Array | None = None,
        slope: Array | None = None,
        effects: tuple[Array, Array] | None = None,
        kept: NDArray[np.bool_] | None = None,
        origin: int | None = None,
    ) -> None:
        self.D = D
        self.n = len(D)
        self.kept = np.ones(self.n, bool) if kept is None else kept
        self._logdet = 0.0
        self._low_rank: list[tuple[Array, Array]] = []
        self._walking = np.zeros(0, np.intp)
        if time is not None and walk is not None and walk.any():
            self._walking = np.flatnonzero(walk)
            self._s = walk[self._walking]
            self._add_walk(_intervals(time)[1:], origin)
        if time is not None and slope is not None and slope.any():
            sloping = np.flatnonzero(slope)
            self.add_effects(centre(time, origin)[:, None, None] * np.eye(6)[:, sloping], slope[sloping] ** 2)
        if effects is not None:
            self.add_effects(*effects)

    @cached_property
    def W(self) -> Array:
        """(n, 6, 6) inverse of the independent noise covariance of each pose."""
        if self.D.strides[0] == 0:
            W = np.broadcast_to(np.linalg.inv(self.D[:1]), self.D.shape)
        else:
            W = np.linalg.inv(self.D)
        return np.asarray(W if self.kept.all() else W * np.where(self.kept, 1.0, FAINT)[:, None, None])

    def parts(self) -> Iterator[tuple[slice, "Noise"]]:
        """Yield slices of poses with their noise; independent poses are split into parts that fit into the cache."""
        if not self.independent or self.n <= CHUNK:
            yield slice(None), self
            return
        for first in range(0, self.n, CHUNK):
            part = slice(first, first + CHUNK)
            yield part, Noise(self.D[part], kept=self.kept[part])

    def _add_walk(self, dt: Array, origin: int | None) -> None:
        """Add the walk: factorise M = K^+ + S W S, ordered by pose, then channel; constrain mean or origin to zero."""
        n, k, s = self.n, self._walking.size, self._s
        stiffness = 1 / dt
        blocks = s[:, None] * self.W[:, self._walking[:, None], self._walking] * s
        blocks[:-1, range(k), range(k)] += stiffness[:, None]
        blocks[1:, range(k), range(k)] += stiffness[:, None]
        banded = np.zeros((k + 1, n, k))
        for a in range(k):
            for b in range(a, k):
                banded[k - (b - a), :, b] = blocks[:, a, b]
        banded[0, 1:] = -stiffness[:, None]
        self._blocks, self._stiffness = blocks, stiffness
        self._cholesky = np.asarray(dpbtrf(banded.reshape(k + 1, -1), overwrite_ab=1)[0])
        zero = np.zeros((n, k, k))
        zero[slice(None) if origin is None else origin, range(k), range(k)] = 1.0
        M_zero = self._solve_walk(zero)
        total = np.einsum("nij,nik->jk", zero, M_zero)
        Q = self.W[:, :, self._walking] @ (s[:, None] * M_zero)
        self._low_rank.append((Q, np.linalg.inv(total)))
        self._logdet += 2 * float(np.log(self._cholesky[-1]).sum()) + float(np.linalg.slogdet(total)[1])
        # Log-determinant of the random walk whose mean or origin is fixed at zero.
        self._logdet += k * (float(np.log(dt).sum()) - 2 * float(np.log(n if origin is None else 1)))

    def add_effects(self, T: Array, variance: Array) -> None:
        """Add k random coefficients common to all poses to the noise: their columns T (n, 6, k) and variances (k,)."""
        Q = self.solve(T)
        core = np.diag(1 / variance) + summed_products(T, Q)
        self._low_rank.append((Q, -np.asarray(np.linalg.inv(core), dtype=np.float64)))
        self._logdet += float(np.linalg.slogdet(core)[1]) + float(np.log(variance[np.isfinite(variance)]).sum())

    def _solve_walk(self, X: Array) -> Array:
        """Return M^-1 X for X (n, k, m), with the banded matrix M that `_add_walk` has factorised."""
        Z = dpbtrs(self._cholesky, X.reshape(-1, X.shape[2]))[0]
        return np.asarray(Z.reshape(X.shape))

    def solve(self, X: Array) -> Array:
        """Return V^-1 X for X (n, 6, m), with V the covariance of all wrenches."""
        Y = np.asarray(self.W @ X)
        if self._walking.size:
            s = self._s[:, None]
            Y -= self.W[:, :, self._walking] @ (s * self._solve_walk(s * Y[:, self._walking]))
        for Q, core in self._low_rank:
            Y += Q @ (core @ summed_products(Q, X))
        return Y

    @cached_property
    def logdet(self) -> float:
        """Log-determinant of the covariance V of all wrenches; infinite variances are left out."""
        common = self.D.strides[0] == 0
        each = np.broadcast_to(np.linalg.slogdet(self.D[:1] if common else self.D)[1], self.n)
        return self._logdet + float(each[self.kept].sum())

    @cached_property
    def blocks(self) -> Array:
        """(n, 6, 6) diagonal blocks of V^-1, with V the covariance of all wrenches."""
        W = self.W
        if self._walking.size:
            WS = self.W[:, :, self._walking] * self._s
            above = -self._stiffness[:, None, None] * np.eye(self._walking.size)
            W = W - WS @ inverse_blocks(self._blocks, above)[0] @ _transposed(WS)
        for Q, core in self._low_rank:
            W = W + Q @ core @ _transposed(Q)
        return np.asarray(W, dtype=np.float64)

    @property
    def independent(self) -> bool:
        """Whether the noise is independent from pose to pose."""
        return not self._low_rank

    @property
    def walks(self) -> bool:
        """Whether the noise contains a random walk of the bias in any channel."""
        return self._walking.size > 0

    def walk_trace(self, time: Array, channels: NDArray[np.intp], low_rank: tuple[Array, Array]) -> float:
        """Return tr(K (V^-1 + Q core Q')) for walks of these channels; V itself has no walk."""
        trace = float(np.cumsum(_intervals(time)) @ self.W[:, channels, channels].sum(axis=1))
        for Q, core in (*self._low_rank, low_rank):
            F = _suffix_sums(Q[:, channels])
            trace += float(np.vdot(core, summed_products(_intervals(time)[:, None, None] * F, F)))
        return trace


def inverse_blocks(diagonal: Array, above: Array) -> tuple[Array, Array]:
    """Return the tridiagonal blocks of the inverse of a symmetric block-tridiagonal matrix, by cyclic reduction.

    Arguments and results are the blocks on the diagonal (n, k, k) and above it (n - 1, k, k). Every second block is
    eliminated at once, and the remaining matrix is inverted recursively.
    """
    if len(diagonal) == 1:
        return np.asarray(np.linalg.inv(diagonal)), above
    inverse, beside = np.empty_like(diagonal), np.empty_like(above)
    before, after, own = above[::2], above[1::2], np.linalg.inv(diagonal[1::2])
    k = len(after)  # the last eliminated block may have no right neighbour
    left, right = own @ _transposed(before), own[:k] @ after
    rest = diagonal[::2].copy()
    rest[: len(own)] -= before @ left
    rest[1:] -= _transposed(after) @ right
    kept, between = inverse_blocks(rest, -before[:k] @ right)
    beside[::2] = -kept[: len(own)] @ _transposed(left)
    beside[::2][:k] -= between @ _transposed(right)
    beside[1::2] = -left[:k] @ between - right @ kept[1:]
    inverse[::2] = kept
    inverse[1::2] = own - _transposed(beside[::2]) @ _transposed(left)
    inverse[1::2][:k] -= beside[1::2] @ _transposed(right)
    return inverse, beside


def _transposed(X: Array) -> Array:
    return np.swapaxes(X, -1, -2)


def summed_products(X: Array, Y: Array) -> Array:
    """Return the sum over the poses of X_i' Y_i, shape (k, l), for X (n, m, k) and Y (n, m, l)."""
    rows = X.shape[0] * X.shape[1]
    return np.asarray(X.reshape(rows, X.shape[2]).T @ Y.reshape(rows, Y.shape[2]))


def pose_times(t_s: Array) -> Array:
    """Return times (n,) in mean intervals between poses, from 0; the indices of the poses if a time is missing."""
    n = len(t_s)
    if np.isnan(t_s).any() or np.ptp(t_s) == 0:
        return np.arange(n, dtype=np.float64)
    return np.asarray((t_s - t_s.min()) * (n - 1) / np.ptp(t_s))


def _intervals(time: Array) -> Array:
    """Return the intervals (n,) before each pose; the first is one unit, which the mean bias absorbs."""
    return np.maximum(np.diff(time, prepend=time[0] - 1.0), SHORTEST_STEP)


def walk_times(time: Array, X: Array) -> Array:
    """Return the covariance of a random walk, with unit variance per unit of time, times X (n, k)."""
    return np.asarray(np.cumsum(_intervals(time)[:, None] * _suffix_sums(X), axis=0))


def _suffix_sums(X: Array) -> Array:
    return np.asarray(np.cumsum(X[::-1], axis=0)[::-1])


def centre(time: Array, origin: int | None = None) -> Array:
    """Return time scaled to unit duration and shifted to zero mean, or to zero at one pose."""
    zero = time.mean() if origin is None else time[origin]
    return np.asarray((time - zero) / max(np.ptp(time), 1e-300))
