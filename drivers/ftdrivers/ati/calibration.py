"""From gauge counts to newton and newton metre, the same for every ATI wire.

Ref: ATI 9610-05-1030 revision 04: wrench counts are matrix (rows Fx..Tz, columns G0..G5) times gauges; force and torque
are counts divided by counts per unit. Unit codes are shared by NETCANOEM, Digital F/T, Axia and Net F/T.
Checked on hardware: no. Verified against: tests/unit/drivers/ati/test_calibration.py.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ftdrivers.errors import DeviceFault, ProtocolError
from ftdrivers.interfaces import Array

FORCE_UNITS_N = {
    "lbf": 4.4482216152605,
    "N": 1.0,
    "klbf": 4448.2216152605,
    "kN": 1000.0,
    "kgf": 9.80665,
    "gf": 0.00980665,
}
"""In the order of ATI's unit codes 1 to 6, as are the torque units."""
TORQUE_UNITS_NM = {
    "lbf-in": 0.1129848290276167,
    "lbf-ft": 1.3558179483314004,
    "N-m": 1.0,
    "N-mm": 0.001,
    "kgf-cm": 0.0980665,
    "kN-m": 1000.0,
}
NEWTON, NEWTON_METRE = 2, 3

_FORCES, _TORQUES = tuple(FORCE_UNITS_N), tuple(TORQUE_UNITS_NM)
_LOWEST, _HIGHEST = -32768, 32767


def unit_names(unit_codes: tuple[int, int]) -> tuple[str, str]:
    """Name the units of force and torque. Raises `ProtocolError` for unknown codes."""
    force, torque = unit_codes
    if not (1 <= force <= len(_FORCES) and 1 <= torque <= len(_TORQUES)):
        raise ProtocolError(f"unit codes are {force} (force) and {torque} (torque), known are 1 to 6")
    return _FORCES[force - 1], _TORQUES[torque - 1]


def units(unit_codes: tuple[int, int]) -> tuple[float, float]:
    """Return one unit of force in N and one of torque in N·m. Raises `ProtocolError` for unknown codes."""
    force, torque = unit_names(unit_codes)
    return FORCE_UNITS_N[force], TORQUE_UNITS_NM[torque]


def parse_units(text: str) -> tuple[int, int]:
    """Find the unit codes of an option such as ``lbf,lbf-in``. Raises `ValueError`."""
    force, _, torque = text.partition(",")
    if force not in _FORCES or torque not in _TORQUES:
        raise ValueError(
            f"units are '{text}'; give one of {' '.join(_FORCES)}, a comma, and one of {' '.join(_TORQUES)}"
        )
    return _FORCES.index(force) + 1, _TORQUES.index(torque) + 1


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """One calibration of one transducer."""

    wrench_per_count: Array
    """(6, 6) N and N·m (rows Fx..Tz) per gauge count (columns G0..G5)."""
    counts_per_N: float
    counts_per_Nm: float

    @classmethod
    def from_vendor(cls, matrix: Array, counts_per_unit: tuple[int, int], unit_codes: tuple[int, int]) -> "Calibration":
        """Build from the values that the device reports.

        Parameters
        ----------
        matrix : array, shape (6, 6)
            The run-time matrix, which includes the gauge gains.
        counts_per_unit, unit_codes : (int, int)
            For force, for torque.

        Raises
        ------
        ProtocolError
            An unknown unit code, or a matrix that is not finite or singular.
        """
        unit_N, unit_Nm = units(unit_codes)
        if not np.isfinite(matrix).all() or np.linalg.matrix_rank(matrix) < 6:
            raise ProtocolError("the calibration matrix is empty or not invertible")
        counts_per_N, counts_per_Nm = counts_per_unit[0] / unit_N, counts_per_unit[1] / unit_Nm
        return cls(matrix / np.repeat([counts_per_N, counts_per_Nm], 3)[:, np.newaxis], counts_per_N, counts_per_Nm)

    def wrench(self, gauges: NDArray[Any]) -> Array:
        """Convert gauges (n, 6) to wrenches (n, 6) in N and N·m."""
        return np.asarray(gauges @ self.wrench_per_count.T)


def refuse_saturated(name: str, gauges: NDArray[np.int32]) -> None:
    """Raise `DeviceFault` when a gauge of the sensor is at the end of its range in any of n rows (n, 6).

    The wrench is then meaningless. No status bit reports an overload or a broken cable.
    """
    saturated = np.flatnonzero(((gauges == _LOWEST) | (gauges == _HIGHEST)).any(axis=0))
    if len(saturated):
        names = ", ".join(f"G{gauge}" for gauge in saturated)
        raise DeviceFault(f"{name}: gauge {names} is at the end of its range", "take the load off, check the cable")
