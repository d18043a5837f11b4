"""Subtracting weight and bias, fast: one sample in about a microsecond, recordings at memory speed.

For given parameters the expected wrench is affine in the nine entries of R_base_flange, so the contact wrench is

    contact = wrench - matrix @ vec(R_base_flange) - offset        vec: row by row

which is `wrench - predict(parameters, R_base_flange)` of `calib.model` with everything constant computed once.
"""

import ctypes
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray
from scipy.linalg import cython_blas

from calib.likelihood.gain_and_cross_talk import Response
from calib.model import Parameters, skew

Reals = NDArray[np.floating[Any]]

CHUNK_ROWS = 9600  # in and out stay in the caches of one core, and OpenBLAS does not wake its threads for it


class Compensator:
    """The compensation of one calibration.

    Parameters
    ----------
    parameters : Parameters
    dtype : float64 (default) or float32
        Of the arithmetic and of the result. float32 halves the memory traffic and costs about 1e-7 of the wrench.
    response : Response, optional
        Gain and cross-talk of the sensor.

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

    def __init__(
        self, parameters: Parameters, dtype: DTypeLike = np.float64, *, response: Response | None = None
    ) -> None:
        self.dtype: np.dtype[Any] = np.dtype(dtype)
        if self.dtype not in (np.float64, np.float32):
            raise TypeError(f"dtype is {self.dtype}, expected float64 or float32")
        by_force = np.einsum("i,jk->kij", parameters.gravity_force_base_N, parameters.R_flange_sensor).reshape(3, 9)
        matrix = np.concatenate([by_force, skew(parameters.p_sensor_com_m) @ by_force])
        if response is not None:
            matrix += np.concatenate([response.force_gain, response.cross_talk_m]) @ by_force
        offset = np.concatenate([parameters.force_bias_N, parameters.torque_bias_Nm])
        self.matrix: Reals = matrix.astype(self.dtype)
        self.offset: Reals = offset.astype(self.dtype)
        self.matrix.setflags(write=False)
        self.offset.setflags(write=False)
        self._tiled_offset: Reals = np.tile(self.offset, (CHUNK_ROWS, 1))  # broadcasting six numbers is slow
        self._subtract_product = _SubtractProduct(np.ascontiguousarray(self.matrix.T))
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
        wrench, entries = np.ascontiguousarray(wrench), np.ascontiguousarray(entries)
        first, *others = (slice(n * k // threads, n * (k + 1) // threads) for k in range(threads))
        with ThreadPoolExecutor(threads) as pool:
            jobs = [pool.submit(self._rows, wrench[rows], entries[rows], out[rows]) for rows in others]
            self._rows(wrench[first], entries[first], out[first])
            for job in jobs:
                job.result()
        return out

    def _rows(self, wrench: Reals, entries: Reals, out: Reals) -> None:
        """One subtraction and one product a chunk; other threads run beside both."""
        at_entries, at_out = entries.ctypes.data, out.ctypes.data
        for i in range(0, len(out), CHUNK_ROWS):
            part = out[i : i + CHUNK_ROWS]
            np.subtract(wrench[i : i + CHUNK_ROWS], self._tiled_offset[: len(part)], out=part)
            self._subtract_product(at_entries + i * entries.strides[0], len(part), at_out + i * out.strides[0])


class _SubtractProduct:
    """`out -= rows @ matrix`, by the BLAS that SciPy brings, for contiguous arrays of one type.

    Through the function pointer that `scipy.linalg.cython_blas` exports: ctypes lets other threads run during the call,
    which SciPy's own wrappers do not, and numpy's product cannot add to what is there.
    """

    def __init__(self, matrix: Reals) -> None:
        exported, real = cython_blas.__pyx_capi__, ctypes.c_double if matrix.dtype == np.float64 else ctypes.c_float
        capsule = exported["dgemm"] if real is ctypes.c_double else exported["sgemm"]
        python = ctypes.pythonapi
        name_of = ctypes.PYFUNCTYPE(ctypes.c_char_p, ctypes.py_object)(("PyCapsule_GetName", python))
        address_of = ctypes.PYFUNCTYPE(ctypes.c_void_p, ctypes.py_object, ctypes.c_char_p)(
            ("PyCapsule_GetPointer", python)
        )
        self._gemm = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * 13)(address_of(capsule, name_of(capsule)))
        k, m = matrix.shape
        # On a little-endian machine 64 bits hold sizes for a BLAS of either width.
        self._kept = matrix, ctypes.c_char(b"N"), ctypes.c_int64(k), ctypes.c_int64(m), real(-1), real(1)
        self._at = matrix.ctypes.data, *map(ctypes.addressof, self._kept[1:])

    def __call__(self, at_rows: int, n: int, at_out: int) -> None:
        """Subtract for n rows, both arrays given by their addresses."""
        # BLAS counts by columns: it sees the transposed arrays, and the product with its factors exchanged.
        matrix, no, k, m, minus, one = self._at
        count = ctypes.c_int64(n)  # lives until the call has ended
        self._gemm(no, no, m, ctypes.addressof(count), k, minus, matrix, m, at_rows, k, one, at_out, m)


def _check_shapes(wrench: Reals, R_base_flange: Reals) -> None:
    if wrench.shape[-1:] != (6,) or wrench.ndim > 2 or R_base_flange.shape != (*wrench.shape[:-1], 3, 3):
        raise ValueError(
            f"wrench has shape {wrench.shape} and R_base_flange {R_base_flange.shape}: "
            "expected (6,) with (3, 3), or (n, 6) with (n, 3, 3)"
        )
