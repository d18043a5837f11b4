"""From gauge counts to newton and newton metre, the same for every ATI wire.

Ref: ATI 9610-05-1030 revision 04: wrench counts are matrix (rows Fx..Tz, columns G0..G5) times gauges; force and torque
are counts divided by counts per unit. Unit codes are shared by NETCANOEM, Digital F/T, Axia and Net F/T.
Checked on hardware: no. Verified against: tests/unit/test_ati_calibration.py.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.errors import ProtocolError
from drivers.interfaces import Array

FORCE_UNITS_N: Mapping[int, float] = MappingProxyType(
    {
        1: 4.4482216152605,  # lbf
        2: 1.0,  # N
        3: 4448.2216152605,  # klbf
        4: 1000.0,  # kN
        5: 9.80665,  # kgf
        6: 0.00980665,  # gf
    }
)
TORQUE_UNITS_NM: Mapping[int, float] = MappingProxyType(
    {
        1: 0.1129848290276167,  # lbf-in
        2: 1.3558179483314004,  # lbf-ft
        3: 1.0,  # N-m
        4: 0.001,  # N-mm
        5: 0.0980665,  # kgf-cm
        6: 1000.0,  # kN-m
    }
)
NEWTON, NEWTON_METRE = 2, 3

_LOWEST, _HIGHEST = -32768, 32767


def units(unit_codes: tuple[int, int]) -> tuple[float, float]:
    """Look up what one unit of force is in N, and one of torque in N·m. Raises `ProtocolError` for unknown codes."""
    force, torque = unit_codes
    if force not in FORCE_UNITS_N or torque not in TORQUE_UNITS_NM:
        raise ProtocolError(f"unit codes are {force} (force) and {torque} (torque); codes 1 to 6 are known")
    return FORCE_UNITS_N[force], TORQUE_UNITS_NM[torque]


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """One calibration of one transducer."""

    wrench_per_count: Array
    """(6, 6) N and N·m (rows Fx..Tz) per gauge count (columns G0..G5)."""
    counts_per_N: float
    counts_per_Nm: float

    @classmethod
    def from_vendor(cls, matrix: Array, counts_per_unit: tuple[int, int], unit_codes: tuple[int, int]) -> "Calibration":
        """Build from what the device tells.

        Parameters
        ----------
        matrix : array, shape (6, 6)
            The run-time matrix: gauge gains are already inside.
        counts_per_unit, unit_codes : (int, int)
            For force, for torque.

        Raises
        ------
        ProtocolError
            An unknown unit code, or a matrix no transducer can have (not finite or singular).
        """
        unit_N, unit_Nm = units(unit_codes)
        if not np.isfinite(matrix).all() or np.linalg.matrix_rank(matrix) < 6:
            raise ProtocolError("the calibration matrix is not invertible; the slot is empty, select another one")
        counts_per_N, counts_per_Nm = counts_per_unit[0] / unit_N, counts_per_unit[1] / unit_Nm
        return cls(matrix / np.repeat([counts_per_N, counts_per_Nm], 3)[:, np.newaxis], counts_per_N, counts_per_Nm)

    def wrench(self, gauges: NDArray[Any]) -> Array:
        """Convert gauges (n, 6) to wrenches (n, 6) in N and N·m."""
        return np.asarray(gauges @ self.wrench_per_count.T)


def saturated_gauges(gauges: NDArray[np.int32]) -> list[int]:
    """Name the gauges at the end of their range in any of n rows (n, 6): the wrench is then meaningless.

    No status bit tells: an overload and a broken cable both show only here.
    """
    return [int(g) for g in np.flatnonzero(((gauges == _LOWEST) | (gauges == _HIGHEST)).any(axis=0))]
