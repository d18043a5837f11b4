"""The settings of the station's sensors."""

import numpy as np
import pytest

from ftmocks.__main__ import _parser
from ftmocks.sensor_errors import PERFECT, SensorErrors
from ftmocks.sensors.catalogue import parse_settings
from ftmocks.station import truth_from


@pytest.mark.parametrize(
    ("name", "setting", "says"),
    [
        ("can", "model=1", "leave --sensor-setting out"),
        ("netft", "bias", "give tool-transform=VALUE or bias=VALUE"),
        ("netft", "bias=1,2", "6 numbers"),
        ("bota", "baud=1000", "unknown baud rate '1000'"),
        ("robotous-can", "ids=1,1,2", "3 different"),
        ("robotous-serial", "model=RFT1", "unknown model 'RFT1'"),
    ],
)
def test_wrong_settings(name: str, setting: str, says: str) -> None:
    with pytest.raises(ValueError, match=says):
        parse_settings(name, [setting])


def test_biases_are_as_large_as_those_of_real_sensors() -> None:
    def biases(sensor: str, *more: str) -> tuple[list[float], list[float]]:
        options = _parser().parse_args(["station", "--sensor", sensor, "--seed", "3", *more])
        truth = truth_from(options)
        return truth.force_bias_N.tolist(), truth.torque_bias_Nm.tolist()

    force_N, torque_Nm = biases("can")
    for sensor, force_scale, torque_scale in (("robotiq", 3.3, 1.2), ("robotiq-urcap", 3.3, 1.2), ("netft", 1.1, 2.1)):
        force, torque = biases(sensor)
        assert force == pytest.approx([force_scale * value for value in force_N])
        assert torque == pytest.approx([torque_scale * value for value in torque_Nm])
    assert biases("robotiq", "--force-bias", "1,2,3")[0] == [1, 2, 3]
    assert biases("both") == biases("none") == (force_N, torque_Nm)


def test_a_sensor_has_the_errors_of_a_mounted_one_unless_options_leave_them_out() -> None:
    parser = _parser()

    def errors(*more: str) -> SensorErrors:
        return truth_from(parser.parse_args(["station", "--seed", "3", *more])).sensor_errors

    gains = [np.diag(errors("--seed", str(seed)).error) for seed in range(100)]
    assert np.std(gains) == pytest.approx(0.02, rel=0.1)
    assert errors("--gain", "0", "--cross-talk", "0") is PERFECT
    assert not np.any(np.diag(errors("--gain", "0").error))
