"""The emulated transducer: gauge counts of wrenches, against the protocol document's vectors."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ftmocks.sensors.ati_gauges import REFERENCE, UNIT_N, UNIT_NM

V1_GAUGES = [100, -200, 300, -400, 500, -600]
V1_WRENCH = [-0.85, 1.476, 6.84, 0.044, -0.0762, 0.1608]
V2_WRENCH = [10, -5, 20, 0.5, -0.25, 0.1]
V2_GAUGES = [221, -926, 69, -1086, 2342, 1266]


@pytest.mark.parametrize(("wrench", "gauges"), [(V1_WRENCH, V1_GAUGES), (V2_WRENCH, V2_GAUGES)])
def test_gauges_of_reference_vectors(wrench: list[float], gauges: list[int]) -> None:
    assert REFERENCE.gauges(np.array([wrench, wrench])).tolist() == [gauges, gauges]


@given(st.sampled_from(sorted(UNIT_N)), st.sampled_from(sorted(UNIT_NM)))
def test_other_units_describe_the_same_wrench(force_unit: int, torque_unit: int) -> None:
    calibration = dataclasses.replace(REFERENCE, force_unit=force_unit, torque_unit=torque_unit)
    wrench = np.array([[4.4482216152605, 9.80665, -1.0, 0.0980665, 0.001, -0.1129848290276167]])
    gauges_exact = wrench @ calibration.gauges_per_SI.T
    in_units = gauges_exact @ calibration.matrix.T / 1e6
    expected = np.concatenate([wrench[0, :3] / UNIT_N[force_unit], wrench[0, 3:] / UNIT_NM[torque_unit]])
    np.testing.assert_allclose(in_units[0], expected, rtol=1e-9, atol=1e-12)


def test_overload_saturates_both_ways() -> None:
    overload = np.array([[400.0, 0, 0, 0, 0, 0]])
    gauges = REFERENCE.gauges(np.concatenate([overload, -overload]))
    assert gauges[:, 5].tolist() == [32767, -32768]


def test_gain_scales_before_shift() -> None:
    assert REFERENCE.gauges(np.array([V1_WRENCH]), gain=2.0, shift=10.0)[0].tolist() == [2 * g + 10 for g in V1_GAUGES]
