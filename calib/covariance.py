"""The noise of a whole session: every pose its own, and a bias that drifts from pose to pose.

    V = blockdiag(D_i) + S (K (x) I6) S + slopes,    S = diag(walk)

K is the covariance of a random walk less its mean over the poses, so that "the bias" is the mean bias. Everything is
O(n): the inverse of K is tridiagonal, so with Woodbury's identity only a banded matrix is factorised.
"""

from functools import cached_property

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded

from calib.model import Array

SHORTEST_STEP = 1e-3  # in mean intervals: two poses at the same time have the same bias, nearly


class Noise:
    """Covariance of all wrenches, and its inverse applied.

    Parameters
    ----------
    D : array, shape (n, 6, 6)
        Independent noise of each pose.
    time : array, shape (n,), or None
        Ascending, in mean intervals between poses. Not needed without drift.
    walk : array, shape (6,), or None
        Standard deviation of the change of each channel's bias over one unit of time.
    slope : array, shape (6,), or None
        Standard deviation of each channel's linear change over the session; infinite = unknown.
    """

    def __init__(self, D: Array, time: Array | None = None, walk: Array | None = None, slope: Array | None = None):
        self.D = D
        self.n = len(D)
        common = D.strides[0] == 0
        self.W = np.broadcast_to(np.linalg.inv(D[:1]), D.shape) if common else np.linalg.inv(D)
        self._low_rank: tuple[Array, Array, Array] | None = None
        self._walking = np.flatnonzero(walk) if walk is not None else np.zeros(0, np.intp)
        sloping = np.flatnonzero(slope) if slope is not None else np.zeros(0, np.intp)
        logdet = np.linalg.slogdet(D[:1] if common else D)[1]
        self._logdet = float(logdet.sum()) * (self.n if common else 1)
        if time is None or not (self._walking.size or sloping.size):
            return
        k = self._walking.size
        U, M_inverse = [], []
        if walk is not None and k:
            self._s = walk[self._walking]
            dt = np.maximum(np.diff(time, prepend=time[0] - 1.0), SHORTEST_STEP)
            self._factorise(dt)
            mean = _walk_times(dt, np.ones((self.n, 1)))[:, 0] / self.n
            for c, s in zip(self._walking, self._s, strict=True):
                U += [_channel(c, np.full(self.n, s)), _channel(c, s * mean)]
                M_inverse.append(np.array([[0.0, -1.0], [-1.0, -mean.mean()]]))
            self._logdet += k * float(np.log(dt).sum())
        if slope is not None:
            for c in sloping:
                U.append(_channel(c, centred(time)))
                M_inverse.append(np.array([[1.0 / slope[c] ** 2]]))
                if np.isfinite(slope[c]):
                    self._logdet += 2 * float(np.log(slope[c]))
        columns = np.stack(U, axis=-1)
        Q = self._solve_without_low_rank(columns)
        core = _block_diagonal(M_inverse) + np.einsum("nik,nil->kl", columns, Q)
        self._low_rank = columns, Q, np.linalg.inv(core)
        self._logdet += float(np.linalg.slogdet(core)[1])

    def _factorise(self, dt: Array) -> None:
        """Factorise M = S W S + (inverse of the anchored walk's covariance), unknowns ordered by pose, then channel."""
        k, s = self._walking.size, self._s
        blocks = s[:, None] * self.W[:, self._walking[:, None], self._walking] * s
        stiffness = 1 / dt
        blocks[:, range(k), range(k)] += (stiffness + np.append(stiffness[1:], 0.0))[:, None]
        banded = np.zeros((k + 1, self.n, k))
        for a in range(k):
            for b in range(a, k):
                banded[k - (b - a), :, b] = blocks[:, a, b]
        banded[0, 1:] = -stiffness[1:, None]
        self._blocks, self._stiffness = blocks, stiffness
        self._cholesky = cholesky_banded(banded.reshape(k + 1, -1), check_finite=False)
        self._logdet += 2 * float(np.log(self._cholesky[-1]).sum())

    def _solve_without_low_rank(self, X: Array) -> Array:
        WX = np.asarray(self.W @ X)
        if not self._walking.size:
            return WX
        k = self._walking.size
        right = (self._s[:, None] * WX[:, self._walking]).reshape(self.n * k, -1)
        Z = cho_solve_banded((self._cholesky, False), right, check_finite=False).reshape(self.n, k, -1)
        return WX - self.W[:, :, self._walking] @ (self._s[:, None] * Z)

    def solve(self, X: Array) -> Array:
        """Give V^-1 X for X (n, 6, k)."""
        Y = self._solve_without_low_rank(X)
        if self._low_rank is not None:
            _, Q, core = self._low_rank
            Y = Y - Q @ (core @ np.einsum("nik,nil->kl", Q, X))
        return Y

    @property
    def logdet(self) -> float:
        """Logarithm of the determinant of V; of a slope of infinite variance only what depends on the rest."""
        return self._logdet

    @cached_property
    def blocks(self) -> Array:
        """(n, 6, 6) the diagonal blocks of V^-1."""
        W = self.W
        if self._walking.size:
            WS = self.W[:, :, self._walking] * self._s
            W = W - WS @ self._selected_inverse() @ np.swapaxes(WS, 1, 2)
        if self._low_rank is not None:
            _, Q, core = self._low_rank
            W = W - Q @ core @ np.swapaxes(Q, 1, 2)
        return W

    def _selected_inverse(self) -> Array:
        """Diagonal blocks of M^-1, by elimination forward and substitution back (Takahashi 1973)."""
        k = self._walking.size
        pivots = np.empty((self.n, k, k))
        pivots[0] = np.linalg.inv(self._blocks[0])
        for i in range(1, self.n):
            pivots[i] = np.linalg.inv(self._blocks[i] - self._stiffness[i] ** 2 * pivots[i - 1])
        inverse = pivots.copy()
        for i in range(self.n - 2, -1, -1):
            inverse[i] += self._stiffness[i + 1] ** 2 * pivots[i] @ inverse[i + 1] @ pivots[i]
        return inverse


def walk_times(time: Array, X: Array) -> Array:
    """Multiply X (n, k) by the covariance of a random walk of unit variance per unit time."""
    return _walk_times(np.maximum(np.diff(time, prepend=time[0] - 1.0), SHORTEST_STEP), X)


def walk_square(time: Array, X: Array) -> Array:
    """Give the trace of X' K X over the last axis but one, for X (n, ...) : sum over steps of dt (sum of what follows)²."""
    dt = np.maximum(np.diff(time, prepend=time[0] - 1.0), SHORTEST_STEP)
    after = np.cumsum(X[::-1], axis=0)[::-1]
    return np.einsum("n,n...->...", dt, after**2)


def _walk_times(dt: Array, X: Array) -> Array:
    after = np.cumsum(X[::-1], axis=0)[::-1]
    return np.asarray(np.cumsum(dt[:, None] * after, axis=0))


def centred(time: Array) -> Array:
    """Scale time to mean zero and unit length."""
    return np.asarray((time - time.mean()) / max(np.ptp(time), 1e-300))


def _channel(c: int, values: Array) -> Array:
    column = np.zeros((len(values), 6))
    column[:, c] = values
    return column


def _block_diagonal(blocks: list[Array]) -> Array:
    size = sum(len(block) for block in blocks)
    matrix, at = np.zeros((size, size)), 0
    for block in blocks:
        matrix[at : at + len(block), at : at + len(block)] = block
        at += len(block)
    return matrix
