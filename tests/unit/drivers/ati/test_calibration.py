"""From gauges to wrench: worked vectors, units, saturation."""

import numpy as np
import pytest

from ftdrivers.ati.codec import NEWTON, NEWTON_METRE, Calibration
from ftdrivers.errors import ProtocolError

MATRIX = np.array(
    [
        [0, 0, 0, -4250, 0, 4250],
        [0, 4920, 0, -2460, 0, -2460],
        [7600, 0, 7600, 0, 7600, 0],
        [0, 0, -220, 0, 220, 0],
        [254, 0, -127, 0, -127, 0],
        [0, -134, 0, -134, 0, -134],
    ],
    dtype=float,
)
COUNTS = (1_000_000, 1_000_000)


@pytest.mark.parametrize(
    ("gauges", "wrench"),
    [
        ([100, -200, 300, -400, 500, -600], [-0.85, 1.476, 6.84, 0.044, -0.0762, 0.1608]),
        ([90, -210, 290, -410, 490, -610], [-0.85, 1.476, 6.612, 0.044, -0.0762, 0.16482]),
        ([221, -926, 69, -1086, 2342, 1266], [9.996, -4.99872, 20.0032, 0.50006, -0.250063, 0.099964]),
    ],
)
def test_worked_vectors(gauges: list[int], wrench: list[float]) -> None:
    calibration = Calibration.from_vendor(MATRIX, COUNTS, (NEWTON, NEWTON_METRE))
    np.testing.assert_allclose(calibration.wrench(np.array([gauges, gauges])), [wrench, wrench], atol=1e-12)


@pytest.mark.parametrize(
    ("codes", "force", "torque"),
    [
        ((1, 1), 4.4482216152605, 0.1129848290276167),
        ((2, 2), 1.0, 1.3558179483314004),
        ((3, 3), 4448.2216152605, 1.0),
        ((4, 4), 1000.0, 0.001),
        ((5, 5), 9.80665, 0.0980665),
        ((6, 6), 0.00980665, 1000.0),
    ],
)
def test_units(codes: tuple[int, int], force: float, torque: float) -> None:
    si = Calibration.from_vendor(MATRIX, COUNTS, (NEWTON, NEWTON_METRE)).wrench_per_count
    calibration = Calibration.from_vendor(MATRIX, COUNTS, codes)
    assert (calibration.counts_per_N, calibration.counts_per_Nm) == pytest.approx((1e6 / force, 1e6 / torque))
    other = calibration.wrench_per_count
    np.testing.assert_allclose(other[:3], force * si[:3], rtol=1e-15)
    np.testing.assert_allclose(other[3:], torque * si[3:], rtol=1e-15)


@pytest.mark.parametrize("codes", [(0, 3), (2, 0), (7, 3), (2, 255)])
def test_unknown_units_are_refused(codes: tuple[int, int]) -> None:
    with pytest.raises(ProtocolError, match="unit codes"):
        Calibration.from_vendor(MATRIX, COUNTS, codes)


@pytest.mark.parametrize("matrix", [np.zeros((6, 6)), np.full((6, 6), np.nan), np.diag([1.0, 1, 1, 1, 1, 0])])
def test_a_matrix_of_no_transducer_is_refused(matrix: np.ndarray[tuple[int, int], np.dtype[np.float64]]) -> None:
    with pytest.raises(ProtocolError, match="not invertible"):
        Calibration.from_vendor(matrix, COUNTS, (NEWTON, NEWTON_METRE))
