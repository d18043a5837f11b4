"""Where the frames of a wrench are drawn."""

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ftdrive.stream.samples import WrenchFrame, frames_in_flange, sensor_origin_m
from tests.unit.ftdrive.stream.simulated import P_FLANGE_TCP_M, calibrated, info

INFO = info(calibrated())
R_BASE_FLANGE = Rotation.random(3, rng=np.random.default_rng(1)).as_matrix()


def test_the_axes_of_the_base_turn_against_the_flange() -> None:
    found = frames_in_flange(WrenchFrame("base", "tcp"), INFO, R_BASE_FLANGE)
    (name,) = found.keys() - {"sensor", "tcp"}
    R_flange_frame, p_flange_frame_m = found[name]
    assert np.allclose(R_BASE_FLANGE @ R_flange_frame, np.eye(3)), "those of the base, whatever the flange does"
    assert p_flange_frame_m == pytest.approx(P_FLANGE_TCP_M)


@pytest.mark.parametrize(
    ("height_mm", "sigma_m", "z_m"), [(None, 0.002, 0.042), (None, 0.004, np.nan), (30.0, 0.002, 0.03)]
)
def test_a_height_that_motion_showed_well_stands_in_for_one_that_is_not_configured(
    height_mm: float | None, sigma_m: float, z_m: float
) -> None:
    calibration = SimpleNamespace(motion=SimpleNamespace(height_m=0.042, covariance=np.eye(34) * sigma_m**2))
    assert sensor_origin_m(height_mm, cast("Any", calibration))[2] == pytest.approx(z_m, nan_ok=True)
