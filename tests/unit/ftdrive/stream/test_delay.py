"""What the delay estimator makes of a moving tool: each of its unknowns by a recording in which it is not zero."""

import numpy as np

from ftdrive.stream.pairing import DelayEstimator
from ftdrive.stream.samples import Paired
from tests.unit.ftdrive.stream.simulated import NOISE, P_FLANGE_SENSOR_M, Motion, calibrated, paired

MOTION = Motion()


def moved(delay_s: float, seconds: float, seed: int) -> Paired:
    t_s = np.arange(0.0, seconds, 1e-3)
    R, p = MOTION.pose(t_s)
    rows = paired(R, seed=seed)
    noise = NOISE * np.random.default_rng(seed).standard_normal((len(t_s), 6))
    values = {name: getattr(rows, name) for name in ("t_device_s", "seq", "status", "q_rad", "R_base_flange")}
    return Paired(t_host_ns=rows.t_host_ns, raw=MOTION.wrench(t_s - delay_s) + noise, p_base_flange_m=p, **values)


def test_the_error_of_the_delay_is_as_its_sigma_says() -> None:
    left = []
    for seed in range(8):
        estimator = DelayEstimator(calibrated(), P_FLANGE_SENSOR_M)
        assert (estimator.delay_s, estimator.sigma_s) == (0.0, 0.05)
        estimator.add(moved(0.004, 2.01, seed))
        assert 5e-5 < estimator.sigma_s < 1.5e-4  # 6,000 numbers of 0.05 N, of a force that changes by 10 N/s
        left.append((estimator.delay_s - 0.004) / estimator.sigma_s)
    assert 0.4 < np.sqrt(np.mean(np.square(left))) < 1.6
