"""Six strain gauges and their calibration, shared by both emulated ATI interfaces.

Ref: ATI 9610-05-1030-04 (NETCANOEM): runtime matrix, counts per unit, unit codes; ATI 9620-05-Digital FT, section 8.

Does not model: drift, temperature, hysteresis, crosstalk beyond the matrix, and noise, which comes with the readings.
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
    """What the counts of an ATI interface mean.

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
        """(6,) force unit in newtons (three) and torque unit in newton metres (three)."""
        return np.repeat([UNIT_N[self.force_unit], UNIT_NM[self.torque_unit]], 3)

    @cached_property
    def counts_per_SI(self) -> Array:
        """(6,) counts per newton (three) and per newton metre (three)."""
        return np.repeat([self.counts_per_force, self.counts_per_torque], 3) / self.units_SI


@dataclass(frozen=True, eq=False)
class Calibration(Scale):
    """What an ATI interface stores about one transducer.

    Parameters
    ----------
    matrix
        (6, 6) runtime matrix, rows Fx Fy Fz Tx Ty Tz, columns gauge 0 to 5: counts per gauge count.
    gauge_gains, gauge_offsets
        (6,) analogue settings at which the matrix holds, u16; the NETCANOEM keeps them to itself.
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
        """(6, 6) gauge counts per newton (columns 0 to 2) and per newton metre (columns 3 to 5)."""
        return np.linalg.inv(self.matrix) * self.counts_per_SI

    def gauges(
        self,
        wrench: Array,
        *,
        gain: Array | float = 1.0,
        shift: Array | float = 0.0,
    ) -> NDArray[np.int16]:
        """Gauge counts of wrenches, rounded and clipped as the converter does.

        Parameters
        ----------
        wrench
            (n, 6) in N and N·m, sensor axes.
        gain, shift
            (6,) or scalar: `gain * gauges + shift`, in gauge counts, before rounding.

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


# Every value is exact in float32, and the size is that of a small real transducer: one gauge count is 4 to 8 mN.
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
