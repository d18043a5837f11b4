"""How a sensor with hysteresis reads: each axis lags behind by a share of its last swing.

    reading_i = wrench_i - share (wrench_i - wrench_(i-1))

Six shares, one for each axis, have one variance. Where the arm came from before the first pose is unknown, so that pose
is off by a share of a usual swing. Compensation knows no swing: hysteresis is part of the noise of a reading.
"""

import numpy as np

from ftcalib.model import Array, Parameters, gravity_wrench

FEW = 1000
"""More poses need no allowance for the first."""


def hysteresis_columns(parameters: Parameters, R_base_flange: Array) -> Array:
    """Give the derivative (n, 6, 12) of the wrench by the shares, and by those of the swing to the first pose.

    Parameters
    ----------
    parameters : Parameters
    R_base_flange : array, shape (n, 3, 3)
        In the order of measuring. More than 1000 poses have only the first 6 columns.
    """
    wrench = gravity_wrench(parameters, R_base_flange)
    n, axis = len(wrench), range(6)
    columns = np.zeros((n, 6, 12 if n <= FEW else 6))
    swing = np.diff(wrench, axis=0)
    columns[1:, axis, axis] = -swing
    if n <= FEW:
        columns[0, axis, range(6, 12)] = np.sqrt(np.mean(swing**2, axis=0))
    return columns
