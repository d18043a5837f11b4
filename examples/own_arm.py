"""An arm that ftdrive only reads: a pan-tilt unit that is turned by hand, with two encoders."""

import time
from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

import ftdrivers


class PanTilt(ftdrivers.ReadOnlyArm):
    """Pan about the vertical, then tilt; `read_deg` stands for the client library of the encoders."""

    def __init__(self, read_deg: Callable[[], tuple[float, float]]) -> None:
        self._read_deg = read_deg

    def identify(self) -> ftdrivers.DeviceInfo:
        return ftdrivers.DeviceInfo(model="pan-tilt unit", serial="P1", firmware="none")

    def state(self) -> ftdrivers.ArmState:
        pan_deg, tilt_deg = self._read_deg()
        t_ns = time.monotonic_ns()
        return ftdrivers.ArmState(
            t_host_ns=t_ns,
            t_device_s=t_ns * 1e-9,
            q_rad=np.radians([pan_deg, tilt_deg, 0, 0, 0, 0]),
            qd_rad_s=np.zeros(6),
            R_base_flange=Rotation.from_euler("ZX", [pan_deg, tilt_deg], degrees=True).as_matrix(),
            p_base_flange_m=np.zeros(3),
        )


turned_to = iter([(0.0, 0.0), (90.0, 45.0), (180.0, 180.0)])
with PanTilt(lambda: next(turned_to)) as arm:  # also: open_stream(calibration=…, arm=arm, sensor=…)
    print(arm.identify().model)
    for _ in range(3):
        print(f"flange z in base {arm.state().R_base_flange[:, 2].round(2) + 0.0}")
