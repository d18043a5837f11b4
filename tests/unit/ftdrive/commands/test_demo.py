"""The error of a contact in a demo with loads: of a sensor whose gains are 2 % too large."""

from dataclasses import replace

import numpy as np
import pytest

from ftcalib.sensor_matrix import SensorMatrix
from ftdrive.session.rehearsal import contact_errors
from ftmocks.sensor_errors import SensorErrors
from ftmocks.world import Truth
from tests.unit.ftdrive.stream.simulated import calibrated_from


def test_a_gain_of_two_percent_is_two_newtons_until_it_is_known() -> None:
    error = 0.02 * np.eye(6)
    truth = replace(Truth.drawn(3), sensor_errors=SensorErrors(error, np.zeros((6, 2)))).to_json()
    unknown = calibrated_from(truth)
    known = replace(unknown, sensor=SensorMatrix(error, 1e-8 * np.eye(39), "loads", floor=0.0))
    before, after = (contact_errors(result, truth) for result in (unknown, known))
    assert before["as_read_N"] == pytest.approx(2.0, abs=1e-9)
    assert before["decoded_N"] == pytest.approx(2.0, rel=0.05)
    assert before["sigma_N"] > 1.0
    assert after["decoded_N"] < 0.05
    assert after["sigma_N"] < before["sigma_N"] / 3
