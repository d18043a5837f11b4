"""Quaternions of few rotations at a time, for which those of scipy take five times as long."""

import numpy as np

from ftdrivers.interfaces import Array

_I, _J, _K = np.arange(4), np.array([2, 0, 1]), np.array([1, 2, 0])


def quaternions(R: Array) -> Array:
    """Return unit quaternions x y z w (n, 4) of rotations (n, 3, 3), by the largest component (Shepperd 1978)."""
    x, y, z = R[:, 0, 0], R[:, 1, 1], R[:, 2, 2]
    squares = np.stack([1 + x - y - z, 1 - x + y - z, 1 - x - y + z, 1 + x + y + z], axis=1)  # 4 times
    largest = squares.argmax(axis=1)
    outer = np.empty((len(R), 4, 4))  # 4 q q^T
    outer[:, :3, :3] = R + np.swapaxes(R, 1, 2)
    outer[:, :3, 3] = outer[:, 3, :3] = R[:, _J, _K] - R[:, _K, _J]
    outer[:, _I, _I] = squares
    row = outer[np.arange(len(R)), largest]
    return np.asarray(row / np.sqrt(np.square(row).sum(axis=1, keepdims=True)))


def matrices(quat: Array) -> Array:
    """Return rotation matrices (n, 3, 3) of unit quaternions x y z w (n, 4)."""
    x, y, z, w = quat.T
    x2, y2, z2 = x + x, y + y, z + z
    xx, yy, zz = x * x2, y * y2, z * z2
    xy, xz, yz, wx, wy, wz = x * y2, x * z2, y * z2, w * x2, w * y2, w * z2
    columns = (1 - yy - zz, xy - wz, xz + wy, xy + wz, 1 - xx - zz, yz - wx, xz - wy, yz + wx, 1 - xx - yy)
    return np.stack(columns, axis=1).reshape(-1, 3, 3)
