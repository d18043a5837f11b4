"""A compensated stream that never was: a calibration, its header and its blocks."""

from functools import cache

import numpy as np
from scipy.spatial.transform import Rotation

from ftcalib import CalibrationDataset, CalibrationResult, Setup, solve
from ftcalib.model import SPECIAL_R_flange_base, predict
from ftdrive.runs.verification import VerificationRecord
from ftdrive.stream.samples import Block, Stages, StreamInfo, WrenchFrame
from ftdrivers.interfaces import DeviceInfo, Fact
from tests.known_cells import TURNED

TRUTH = TURNED
NOISE = np.repeat([0.05, 0.002], 3)
BASE_TCP, USUAL = WrenchFrame("base", "tcp"), Stages()
UTC_OFFSET_NS = 1_700_000_000_123_456_789
CONFIGURATION = {"robot": {"host": "10.0.0.2"}, "sensor": {"url": "ati-can://can0"}}


@cache
def dataset() -> CalibrationDataset:
    R = np.swapaxes(SPECIAL_R_flange_base, 1, 2)
    means = predict(TRUTH, R) + np.random.default_rng(0).normal(0, NOISE / 20, (24, 6))
    cov = np.tile(np.diag((NOISE / 20) ** 2), (24, 1, 1))
    return CalibrationDataset(R, means, cov, np.full(24, 400), np.full(24, np.nan))


@cache
def calibration() -> CalibrationResult:
    return solve(dataset(), setup=Setup(orientation_accuracy_deg=0.0))


@cache
def info() -> StreamInfo:
    return StreamInfo(
        result=calibration(),
        calibration_name="cell's calibration.json",
        arm=DeviceInfo("UR5e", "A1", "5.15"),
        sensor=DeviceInfo(
            "Mini45", "FT1", "1", {"range": Fact((290.0,) * 6, "documented"), "sign": Fact(1, "configured")}
        ),
        tool="gripper",
        utc_offset_ns=UTC_OFFSET_NS,
        sensor_rate_Hz=1000.0,
        arm_rate_Hz=500.0,
        p_flange_sensor_m=np.array([0.0, 0.0, np.nan]),
        R_flange_tcp=np.eye(3),
        p_flange_tcp_m=np.array([0.0, 0.0, 0.1]),
        versions={"ftdrive": "1"},
        verification=VerificationRecord(
            "verification.json", "0" * 12, "2026-11-22T00:00:00.000000+00:00", False, "bias", "…", 0.5, 0.01
        ),
        calibration_state="calibration 29ce87, good, 3 d old, VERIFICATION FAILED 2 h ago (bias)",
    )


def block(
    n: int, start: int = 0, *, frame: WrenchFrame = BASE_TCP, stages: Stages = USUAL, step_ns: int = 10**6
) -> Block:
    """Make n samples from number `start` on: the flange turns, numbers have all their digits."""
    rng = np.random.default_rng(start)
    i = np.arange(start, start + n)
    R = Rotation.from_rotvec(np.outer(i * step_ns * 1e-9, [0.6, -0.5, 0.3])).as_matrix()
    return Block(
        t_host_ns=(5_000_000_000 + step_ns * i + rng.integers(0, 1000, n)).astype(np.int64),
        t_device_s=np.where(i % 7 == 0, np.nan, i * 1e-3 + 1 / 3),
        seq=i.astype(np.int64) + (1 << 33),
        status=np.where(i % 5 == 0, 0xFFFF_FFFF, 0).astype(np.uint32),
        raw=predict(TRUTH, R) + rng.normal(0, NOISE, (n, 6)),
        wrench=rng.normal(0, NOISE, (n, 6)),
        chi2=rng.chisquare(6, n),
        in_contact=i % 3 == 0,
        q_rad=rng.normal(size=(n, 6)),
        R_base_flange=R,
        p_base_flange_m=rng.normal(size=(n, 3)),
        sigma=NOISE,
        frame=frame,
        stages=stages,
    )
