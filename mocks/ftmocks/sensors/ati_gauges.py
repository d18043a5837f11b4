"""Six strain gauges and their calibration, for both emulated ATI interfaces.

Ref: ATI 9610-05-1030-04 (NETCANOEM): runtime matrix, counts per unit, unit codes; ATI 9620-05-Digital FT, section 8.

Not modelled: drift, temperature, hysteresis, cross-talk beyond the matrix, and noise, which the readings contain.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ftmocks.arrays import Array

UNIT_N = {1: 4.4482216152605, 2: 1.0, 3: 4448.2216152605, 4: 1000.0, 5: 9.80665, 6: 0.00980665}
UNIT_NM = {1: 0.1129848290276167, 2: 1.3558179483314004, 3: 1.0, 4: 0.001, 5: 0.0980665, 6: 1000.0}
GAUGE_MIN, GAUGE_MAX = -32768, 32767
WIRE_ORDER = np.array([0, 2, 4, 1, 3, 5])  # both interfaces send the even gauges first


@dataclass(frozen=True, eq=False, kw_only=True)
class Scale:
    """Scale of the counts of an ATI interface.

    Parameters
    ----------
    counts_per_force, counts_per_torque
        Counts per force unit and per torque unit.
    force_unit, torque_unit
        ATI unit codes 1 to 6, the keys of `UNIT_N` and `UNIT_NM`.
    """

    counts_per_force: int = 1_000_000
    counts_per_torque: int = 1_000_000
    force_unit: int = 2
    torque_unit: int = 3

    @cached_property
    def units_SI(self) -> Array:
        """(6,) one unit of force in N (three times) and one unit of torque in N·m (three times)."""
        return np.repeat([UNIT_N[self.force_unit], UNIT_NM[self.torque_unit]], 3)

    @cached_property
    def counts_per_SI(self) -> Array:
        """(6,) counts per N (three times) and per N·m (three times)."""
        return np.repeat([self.counts_per_force, self.counts_per_torque], 3) / self.units_SI


@dataclass(frozen=True, eq=False)
class Calibration(Scale):
    """Calibration of a transducer, as an ATI interface stores it.

    Parameters
    ----------
    matrix
        (6, 6) runtime matrix, rows Fx Fy Fz Tx Ty Tz, columns gauge 0 to 5: counts per gauge count.
    gauge_gains, gauge_offsets
        (6,) analogue settings, u16, for which the matrix is valid. A NETCANOEM does not report them.
    serial, part_number, date
        ASCII, at most 8, 32 and 20 characters.
    max_rating
        (6,) rated load in the calibration's units.
    """

    matrix: Array
    gauge_gains: Sequence[int] = (543, 555, 569, 579, 565, 567)
    gauge_offsets: Sequence[int] = (0x8000,) * 6
    serial: str = "FT12345"
    part_number: str = "SI-130-10"
    date: str = "2020-01-0100:00:00Z"
    max_rating: Sequence[float] = (130.0, 130.0, 400.0, 10.0, 10.0, 10.0)

    @cached_property
    def gauges_per_SI(self) -> Array:
        """(6, 6) gauge counts per N (columns 0 to 2) and per N·m (columns 3 to 5)."""
        return np.linalg.inv(self.matrix) * self.counts_per_SI

    def gauges(
        self,
        wrench: Array,
        *,
        gain: Array | float = 1.0,
        shift: Array | float = 0.0,
    ) -> NDArray[np.int16]:
        """Return gauge counts of wrenches, rounded and clipped as by the converter.

        Parameters
        ----------
        wrench
            (n, 6) wrench in sensor axes, N and N·m.
        gain, shift
            (6,) or scalar values of ``gain * gauges + shift``, which is applied before rounding, in gauge counts.

        Returns
        -------
        (n, 6) gauge counts, natural order.
        """
        counts = wrench @ self.gauges_per_SI.T
        counts *= gain
        counts += shift
        np.rint(counts, out=counts)
        np.maximum(counts, GAUGE_MIN, out=counts)
        np.minimum(counts, GAUGE_MAX, out=counts)
        return counts.astype(np.int16)


# All values are exact in float32. One gauge count is 4 to 8 mN, as in a small real transducer.
REFERENCE = Calibration(
    np.array(
        [
            [0, 0, 0, -4250, 0, 4250],
            [0, 4920, 0, -2460, 0, -2460],
            [7600, 0, 7600, 0, 7600, 0],
            [0, 0, -220, 0, 220, 0],
            [254, 0, -127, 0, -127, 0],
            [0, -134, 0, -134, 0, -134],
        ],
        dtype=np.float64,
    )
)
