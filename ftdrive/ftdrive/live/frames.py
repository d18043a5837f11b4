"""A wrench in other axes and about another point."""

import numpy as np

from ftcalib.model import skew
from ftdrive.errors import ConfigError
from ftdrive.live.samples import StreamInfo, WrenchFrame
from ftdrivers.interfaces import Array


class FrameTransform:
    """Maps wrenches from sensor axes, about the sensor origin, to a frame.

    f' = R f and t' = R (t + p x f), with R the axes and p the sensor origin seen from the new point.

    Parameters
    ----------
    frame : WrenchFrame
    info : StreamInfo
        Its points of the flange.

    Raises
    ------
    ConfigError
        The frame needs a point that is not configured.
    """

    def __init__(self, frame: WrenchFrame, info: StreamInfo) -> None:
        R_flange_sensor = info.calibration.R_flange_sensor
        lever_m = R_flange_sensor.T @ _sensor_from(frame, info)
        if frame.axes == "tcp":
            _require_tcp(info)
        # base axes: to flange axes here, the rest differs from sample to sample
        R_axes_flange = {"sensor": R_flange_sensor.T, "tcp": info.R_flange_tcp.T}.get(frame.axes, np.eye(3))
        R = R_axes_flange @ R_flange_sensor
        self._matrix = np.block([[R, np.zeros((3, 3))], [R @ skew(lever_m), R]])
        self._is_identity = frame.axes == "sensor" and frame.about == "sensor"
        self._turns = frame.axes == "base"

    def __call__(self, wrench: Array, R_base_flange: Array) -> Array:
        """Return wrenches (n, 6) in the frame; `R_base_flange` is (n, 3, 3)."""
        if self._is_identity:
            return wrench
        wrench = wrench @ self._matrix.T
        if not self._turns:
            return wrench
        return (wrench.reshape(-1, 2, 3) @ np.swapaxes(R_base_flange, 1, 2)).reshape(-1, 6)

    def matrix(self, R_base_flange: Array) -> Array:
        """Return the matrix (6, 6) of the transform at one orientation (3, 3)."""
        if not self._turns:
            return self._matrix
        return np.asarray((R_base_flange @ self._matrix.reshape(2, 3, 6)).reshape(6, 6))


def frames_in_flange(frame: WrenchFrame, info: StreamInfo, R_base_flange: Array) -> dict[str, tuple[Array, Array]]:
    """Return orientation and origin in the flange frame of sensor, tcp and the frame of a wrench, by their `frame_id`.

    Parameters
    ----------
    frame : WrenchFrame
    info : StreamInfo
        Its sensor is drawn at the flange if its height is unknown.
    R_base_flange : array, shape (..., 3, 3)
        With base axes the orientation of the wrench's frame has this shape too.
    """
    sensor = info.calibration.R_flange_sensor, np.nan_to_num(info.p_flange_sensor_m)
    tcp = info.R_flange_tcp, info.p_flange_tcp_m
    found = {"sensor": sensor, "tcp": tcp} if np.isfinite(info.p_flange_tcp_m).all() else {"sensor": sensor}
    if (name := frame.id) not in ("base", "flange", *found):
        flange, base = (np.eye(3), np.zeros(3)), (np.swapaxes(R_base_flange, -1, -2), np.zeros(3))
        known = {"sensor": sensor, "flange": flange, "base": base, "tcp": tcp}
        origin = known[frame.about][1] if isinstance(frame.about, str) else np.array(frame.about)
        found[name] = known[frame.axes][0], np.nan_to_num(origin)
    return found


def gripping_point(info: StreamInfo) -> Array:
    """Return where the gripper holds parts, (3,) sensor frame: the TCP, or the tool's centre of mass without one."""
    p_flange_m = info.p_flange_tcp_m - info.p_flange_sensor_m
    if np.isfinite(p_flange_m).all() and info.p_flange_tcp_m.any():
        return np.asarray(info.calibration.R_flange_sensor.T @ p_flange_m)
    return info.calibration.p_sensor_com_m


def _sensor_from(frame: WrenchFrame, info: StreamInfo) -> Array:
    """Position of the sensor origin from the frame's point, in flange axes."""
    if frame.about == "sensor":
        return np.zeros(3)
    if not np.isfinite(info.p_flange_sensor_m).all():
        raise ConfigError(
            f"a torque {str(frame).partition(', ')[2]} needs the position of the sensor: set [sensor] height_mm, the "
            "height of its origin above the flange face, or choose --about sensor"
        )
    if frame.about == "tcp":
        _require_tcp(info)
    points = {"flange": np.zeros(3), "tcp": info.p_flange_tcp_m}
    point_m = points[frame.about] if isinstance(frame.about, str) else np.array(frame.about)
    return np.asarray(info.p_flange_sensor_m - point_m)


def _require_tcp(info: StreamInfo) -> None:
    if not np.isfinite(info.p_flange_tcp_m).all():
        raise ConfigError("the controller does not report its active TCP: choose another frame than tcp")


_I, _J, _K = np.arange(4), np.array([2, 0, 1]), np.array([1, 2, 0])


def quaternions(R: Array) -> Array:
    """Return unit quaternions x y z w (n, 4) of rotations (n, 3, 3), by the largest component (Shepperd 1978)."""
    x, y, z = R[:, 0, 0], R[:, 1, 1], R[:, 2, 2]
    squares = np.stack([1 + x - y - z, 1 - x + y - z, 1 - x - y + z, 1 + x + y + z], axis=1)  # 4 times
    largest = squares.argmax(axis=1)
    outer = np.empty((len(R), 4, 4))  # 4 q q^T
    outer[:, :3, :3] = R + np.swapaxes(R, 1, 2)
    outer[:, :3, 3] = outer[:, 3, :3] = R[:, _J, _K] - R[:, _K, _J]
    outer[:, _I, _I] = squares
    row = outer[np.arange(len(R)), largest]
    return np.asarray(row / np.sqrt(np.square(row).sum(axis=1, keepdims=True)))


def matrices(quat: Array) -> Array:
    """Return rotation matrices (n, 3, 3) of unit quaternions x y z w (n, 4)."""
    x, y, z, w = quat.T
    x2, y2, z2 = x + x, y + y, z + z
    xx, yy, zz = x * x2, y * y2, z * z2
    xy, xz, yz, wx, wy, wz = x * y2, x * z2, y * z2, w * x2, w * y2, w * z2
    columns = (1 - yy - zz, xy - wz, xz + wy, xy + wz, 1 - xx - zz, yz - wx, xz - wy, yz + wx, 1 - xx - yy)
    return np.stack(columns, axis=1).reshape(-1, 3, 3)
