"""Subtracting weight and bias, fast: one sample in about a microsecond, recordings at memory speed.

For given parameters the expected wrench is affine in the nine entries of R_base_flange, so the contact wrench is

    contact = wrench - matrix @ vec(R_base_flange) - offset        vec: row by row

which is `wrench - predict(parameters, R_base_flange)` of `calib.model` with everything constant computed once.
"""

from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray
from scipy.linalg.blas import dgemm, sgemm

from calib.model import Parameters, skew

Reals = NDArray[np.floating[Any]]

CHUNK_ROWS = 4096  # in and out stay in the second-level cache, and OpenBLAS does not wake its threads for it


class Compensator:
    """The compensation of one calibration.

    Parameters
    ----------
    parameters : Parameters
    dtype : float64 (default) or float32
        Of the arithmetic and of the result. float32 halves the memory traffic and costs about 1e-7 of the wrench.

    Attributes
    ----------
    matrix : array, shape (6, 9)
        N and N·m per entry of R_base_flange.
    offset : array, shape (6,)
        The bias, N and N·m.

    Notes
    -----
    Nothing is written after construction: threads may share one.
    """

    def __init__(self, parameters: Parameters, dtype: DTypeLike = np.float64) -> None:
        self.dtype: np.dtype[Any] = np.dtype(dtype)
        if self.dtype not in (np.float64, np.float32):
            raise TypeError(f"dtype is {self.dtype}, expected float64 or float32")
        by_force = np.einsum("i,jk->kij", parameters.gravity_force_base_N, parameters.R_flange_sensor).reshape(3, 9)
        matrix = np.concatenate([by_force, skew(parameters.p_sensor_com_m) @ by_force])
        offset = np.concatenate([parameters.force_bias_N, parameters.torque_bias_Nm])
        self.matrix: Reals = matrix.astype(self.dtype)
        self.offset: Reals = offset.astype(self.dtype)
        self.matrix.setflags(write=False)
        self.offset.setflags(write=False)
        self._transposed: Reals = np.ascontiguousarray(self.matrix.T)
        self._tiled_offset: Reals = np.tile(self.offset, (CHUNK_ROWS, 1))  # broadcasting six numbers is slow
        self._gemm = dgemm if self.dtype == np.float64 else sgemm
        # One sample is a single product with (wrench, vec(R_base_flange), 1).
        self._product = np.concatenate([np.eye(6), -matrix, -offset[:, None]], axis=1).astype(self.dtype).dot
        self._operand: Reals = np.zeros(16, self.dtype)
        self._operand[15] = 1

    def __call__(self, wrench: Reals, R_base_flange: Reals) -> Reals:
        """Compensate one sample or many, with every check: `sample` and `batch` are the quick ways.

        Parameters
        ----------
        wrench : array, shape (6,) or (n, 6)
            As measured, N and N·m, in the sensor frame.
        R_base_flange : array, shape (3, 3) or (n, 3, 3)

        Returns
        -------
        array, same shape as `wrench`
            Contact wrench on the sensor, in the sensor frame, about the sensor origin.
        """
        wrench, R_base_flange = np.asarray(wrench), np.asarray(R_base_flange)
        _check_shapes(wrench, R_base_flange)
        return self.sample(wrench, R_base_flange) if wrench.ndim == 1 else self.batch(wrench, R_base_flange)

    def sample(self, wrench: Reals, R_base_flange: Reals, out: Reals | None = None) -> Reals:
        """Compensate one sample in a loop that must be quick. Shapes are checked only where numpy does it for nothing.

        Parameters
        ----------
        wrench : array, shape (6,)
            As measured, N and N·m, in the sensor frame. A NaN in any channel makes all six NaN.
        R_base_flange : array, shape (3, 3)
        out : array, shape (6,), optional
            Where the result goes, may be `wrench` itself; of the type of the compensator. A new array by default.

        Returns
        -------
        array, shape (6,)
            Contact wrench on the sensor, in the sensor frame, about the sensor origin.
        """
        operand = self._operand.copy()
        operand[:6] = wrench
        operand[6:15] = R_base_flange.ravel()
        return self._product(operand, out)

    def batch(
        self,
        wrench: Reals,
        R_base_flange: Reals,
        out: Reals | None = None,
        threads: int = 1,
    ) -> Reals:
        """Compensate a recording.

        Parameters
        ----------
        wrench : array, shape (n, 6)
            As measured, N and N·m, in the sensor frame.
        R_base_flange : array, shape (n, 3, 3)
            Arrays that are not contiguous or of another type than the compensator are copied first.
        out : array, shape (n, 6), optional
            Where the result goes, may be `wrench` itself; contiguous, of the type of the compensator. A new array by
            default.
        threads : int
            Over how many threads the rows are spread; worth it from about 100 000 rows on.

        Returns
        -------
        array, shape (n, 6)
            Contact wrenches on the sensor, in the sensor frame, about the sensor origin.
        """
        wrench, R_base_flange = np.asarray(wrench, self.dtype), np.asarray(R_base_flange, self.dtype)
        _check_shapes(wrench, R_base_flange)
        if wrench.ndim != 2:
            raise ValueError(f"wrench has shape {wrench.shape}, expected (n, 6): use sample for one.")
        if threads < 1:
            raise ValueError(f"threads is {threads}, expected 1 or more")
        n = len(wrench)
        if out is None:
            out = np.empty((n, 6), self.dtype)
        elif out.shape != (n, 6) or out.dtype != self.dtype:
            raise ValueError(f"out is {out.dtype} {out.shape}, expected {self.dtype} {(n, 6)}")
        if not out.flags.c_contiguous:
            raise ValueError(f"out has strides {out.strides}, expected a contiguous array")
        entries = R_base_flange.reshape(n, 9)
        if threads == 1:
            self._rows(wrench, entries, out)
            return out
        with ThreadPoolExecutor(threads) as pool:
            bounds = [n * k // threads for k in range(threads + 1)]
            spans = [slice(start, stop) for start, stop in pairwise(bounds)]
            jobs = [pool.submit(self._rows_beside_others, wrench[s], entries[s], out[s]) for s in spans]
            for job in jobs:
                job.result()
        return out

    def _rows(self, wrench: Reals, entries: Reals, out: Reals) -> None:
        """One subtraction and one product a chunk; BLAS adds the product to what is there. Holds the interpreter."""
        for i in range(0, len(out), CHUNK_ROWS):
            part = out[i : i + CHUNK_ROWS]
            np.subtract(wrench[i : i + CHUNK_ROWS], self._tiled_offset[: len(part)], out=part)
            self._gemm(-1.0, self._transposed.T, entries[i : i + CHUNK_ROWS].T, 1.0, part.T, overwrite_c=True)

    def _rows_beside_others(self, wrench: Reals, entries: Reals, out: Reals) -> None:
        """The same with a product that lets other threads run, which is a pass over the chunk slower on its own."""
        expected = np.empty((min(CHUNK_ROWS, len(out)), 6), self.dtype)
        for i in range(0, len(out), CHUNK_ROWS):
            part = expected[: len(out) - i]
            np.matmul(entries[i : i + CHUNK_ROWS], self._transposed, out=part)
            np.add(part, self._tiled_offset[: len(part)], out=part)
            np.subtract(wrench[i : i + CHUNK_ROWS], part, out=out[i : i + CHUNK_ROWS])


def _check_shapes(wrench: Reals, R_base_flange: Reals) -> None:
    if wrench.shape[-1:] != (6,) or wrench.ndim > 2 or R_base_flange.shape != (*wrench.shape[:-1], 3, 3):
        raise ValueError(
            f"wrench has shape {wrench.shape} and R_base_flange {R_base_flange.shape}: "
            "expected (6,) with (3, 3), or (n, 6) with (n, 3, 3)"
        )
