"""A simulated cell for the stream: a known truth, its calibration, and motions whose wrench is known exactly."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ftcalib import CalibrationDataset, CalibrationResult, Parameters, Setup, solve
from ftcalib.model import Array, predict
from ftdrive.stream.noise import SensorNoise
from ftdrive.stream.samples import Paired, StreamInfo
from ftdrive.stream.sources import RecordingSource
from ftdrive.stream.stream import Stream
from ftdrivers.interfaces import ArmStates, DeviceInfo, FtSamples
from tests.fake_clock import FakeClock

G = 9.80665
NOISE = np.repeat([0.05, 0.002], 3)
"""Standard deviation of one sample."""
TRUTH = Parameters(
    Rotation.from_euler("zx", [20, 3], degrees=True).as_matrix(),
    np.array([0.2, -0.1, -14.7]),
    np.array([3.0, -2.0, 5.0]),
    np.array([0.01, -0.005, 0.06]),
    np.array([0.1, 0.2, -0.1]),
)
P_FLANGE_SENSOR_M = np.array([0.0, 0.0, 0.03])
P_FLANGE_TCP_M = np.array([0.02, 0.0, 0.2])
R_FLANGE_TCP = Rotation.from_euler("y", 30, degrees=True).as_matrix()
T0_NS = 10**12
DEVICE = DeviceInfo("model", "serial", "1")


@lru_cache(maxsize=64)
def calibrated(poses: int = 24, seed: int = 1, samples: int = 400) -> CalibrationResult:
    """A calibration of the truth with random orientations, each the mean of so many samples."""
    rng = np.random.default_rng(seed)
    R = Rotation.random(poses, rng=rng).as_matrix()
    sigma = NOISE / np.sqrt(samples)
    wrench = predict(TRUTH, R) + rng.normal(size=(poses, 6)) * sigma
    covariance = np.tile(np.diag(sigma**2), (poses, 1, 1))
    dataset = CalibrationDataset(R, wrench, covariance, np.zeros(poses, np.int64), np.full(poses, np.nan))
    return solve(dataset, setup=Setup(sensor_accuracy_percent=0.0, orientation_accuracy_deg=0.0))


def calibrated_from(truth: Mapping[str, Any], seed: int = 1) -> CalibrationResult:
    """A calibration of an emulated cell with 24 poses, without the minutes of a tour."""
    names = ("R_flange_sensor", "gravity_force_base_N", "force_bias_N", "p_sensor_com_m", "torque_bias_Nm")
    parameters = Parameters(**{name: np.array(truth[name]) for name in names})
    sigma = np.repeat([truth["noise_force_N"], truth["noise_torque_Nm"]], 3) / 20
    rng = np.random.default_rng(seed)
    R = Rotation.random(24, rng=rng).as_matrix()
    wrench = predict(parameters, R) + sigma * rng.normal(size=(24, 6))
    covariance = np.tile(np.diag(sigma**2), (24, 1, 1))
    exact = Setup(orientation_accuracy_deg=0.0)
    return solve(CalibrationDataset(R, wrench, covariance, np.zeros(24, np.int64), np.full(24, np.nan)), setup=exact)


def info(calibration: CalibrationResult, rate_Hz: float = 1000.0, *, height: bool = True) -> StreamInfo:
    return StreamInfo(
        result=calibration,
        calibration_name="calibration.json",
        arm=DEVICE,
        sensor=DEVICE,
        tool="tool",
        utc_offset_ns=0,
        sensor_rate_Hz=rate_Hz,
        arm_rate_Hz=500.0,
        p_flange_sensor_m=P_FLANGE_SENSOR_M if height else np.full(3, np.nan),
        R_flange_tcp=R_FLANGE_TCP,
        p_flange_tcp_m=P_FLANGE_TCP_M,
        versions={},
    )


def replayed(known: StreamInfo, rows: Paired, *, speed: float = 1.0, **options: Any) -> Stream:
    """Open a recording in place of a cell, on a clock that only the stream advances."""
    return Stream(RecordingSource(known, rows, speed=speed, clock=options.pop("clock", FakeClock())), **options).open()


def paired(
    R_base_flange: Array, rate_Hz: float = 1000.0, *, seed: int = 1, push: Array | None = None, noise: float = 1.0
) -> Paired:
    """Samples of the tool at rest in these orientations (n, 3, 3); `push` (6,) or (n, 6) is in sensor axes."""
    n = len(R_base_flange)
    raw = predict(TRUTH, R_base_flange) + noise * NOISE * np.random.default_rng(seed).normal(size=(n, 6))
    return Paired(
        t_host_ns=T0_NS + np.rint(np.arange(n) * 1e9 / rate_Hz).astype(np.int64),
        t_device_s=np.full(n, np.nan),
        seq=np.arange(n),
        status=np.zeros(n, np.uint32),
        raw=raw if push is None else raw + push,
        q_rad=np.zeros((n, 6)),
        R_base_flange=R_base_flange,
        p_base_flange_m=np.zeros((n, 3)),
    )


def dwells(orientations: int, samples: int, seed: int) -> Array:
    """Random orientations, each for so many samples."""
    return np.repeat(Rotation.random(orientations, rng=np.random.default_rng(seed)).as_matrix(), samples, axis=0)


@dataclass(frozen=True)
class Motion:
    """The arm moves sinusoidally; what the sensor measures follows from Newton's law for a point mass."""

    turn_rad_s: float = 1.0
    """Largest rate of each of three axes, about."""
    acceleration_m_s2: float = 2.0
    """Largest acceleration of the flange along each axis."""

    def pose(self, t_s: Array) -> tuple[Array, Array]:
        """R_base_flange (n, 3, 3) and p_base_flange_m (n, 3)."""
        turn = 2 * np.pi * np.array([0.31, 0.23, 0.27])
        angles = 0.6 * self.turn_rad_s / turn * np.sin(np.outer(t_s, turn))
        R = (Rotation.from_rotvec(angles) * Rotation.from_euler("x", 150, degrees=True)).as_matrix()
        go = 2 * np.pi * np.array([0.5, 0.7, 0.6])
        return R, np.array([0.4, 0.1, 0.5]) + self.acceleration_m_s2 / go**2 * np.sin(np.outer(t_s, go))

    def wrench(self, t_s: Array) -> Array:
        """What the sensor measures without noise, (n, 6)."""
        com_m = P_FLANGE_SENSOR_M + TRUTH.R_flange_sensor @ TRUTH.p_sensor_com_m
        h = 1e-3
        n = len(t_s)
        R, p = self.pose(np.concatenate([t_s - h, t_s, t_s + h]))
        before, now, after = (p + R @ com_m).reshape(3, n, 3)
        acceleration = (after - 2 * now + before) / h**2
        R = R[n : 2 * n]
        mass_kg = np.linalg.norm(TRUTH.gravity_force_base_N) / G
        force_N = -mass_kg * np.einsum("nij,ni->nj", R @ TRUTH.R_flange_sensor, acceleration)
        inertial = np.concatenate([force_N, np.cross(TRUTH.p_sensor_com_m, force_N)], axis=1)
        return np.asarray(predict(TRUTH, R) + inertial)

    def links(
        self,
        duration_s: float,
        delay_s: float,
        *,
        rate_Hz: float = 7000.0,
        arm_Hz: float = 500.0,
        batch_s: float = 0.004,
        seed: int = 1,
    ) -> tuple[FtSamples, ArmStates]:
        """What both links deliver; samples arrive in batches, `delay_s` after a pose of the same time."""
        rng = np.random.default_rng(seed)
        t_s, arm_s = np.arange(0, duration_s, 1 / rate_Hz), np.arange(0, duration_s, 1 / arm_Hz)
        sent_s = np.ceil((t_s + delay_s) / batch_s) * batch_s
        received_s = np.maximum.accumulate(arm_s + rng.exponential(2e-4, len(arm_s)))
        samples = FtSamples.of(
            T0_NS + (sent_s * 1e9).astype(np.int64),
            np.arange(len(t_s)),
            self.wrench(t_s) + NOISE * rng.normal(size=(len(t_s), 6)),
        )
        R, p = self.pose(arm_s)
        nothing = np.zeros((len(arm_s), 6))
        return samples, ArmStates(T0_NS + (received_s * 1e9).astype(np.int64), arm_s + 55.0, nothing, nothing, R, p)


class KnownNoise:
    """The noise of every state is this one."""

    def __init__(self, noise: SensorNoise) -> None:
        self._noise = noise

    def of(self, _: int) -> SensorNoise:
        return self._noise


def moving(seconds: float, motion: Motion = Motion(), *, noise: float = 1.0) -> Paired:
    t_s = np.arange(0, seconds, 1e-3)
    R, p = motion.pose(t_s)
    raw = motion.wrench(t_s) + noise * NOISE * np.random.default_rng(3).normal(size=(len(t_s), 6))
    return replace(paired(R), raw=raw, p_base_flange_m=p)
