"""A recording of a free tool in motion, raw: every sample of sensor and arm, in one file of a run."""

import hashlib
import io
import math
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from ftcalib import CalibrationResult, Known
from ftcalib.errors import BadDataset
from ftcalib.files import write_new
from ftcalib.model import Array
from ftcalib.motion.samples import Means
from ftcalib.motion.solve import solve_motion
from ftdrivers.interfaces import ArmStates, FtSamples

FORMAT: Final = "ftdrive.motion/1"
_WRENCH: Final = ("t_host_ns", "t_device_s", "seq", "counts", "wrench", "status")
_POSES: Final = ("t_host_ns", "t_device_s", "q_rad", "qd_rad_s", "R_base_flange", "p_base_flange_m")
_PASSES: Final = 50


@dataclass(frozen=True, slots=True, eq=False)
class MotionRecording:
    """What was received while the tool moved."""

    samples: FtSamples
    states: ArmStates
    nominal_rate_Hz: float = math.nan
    """Of a sensor that sends at an even rate; NaN for one that is polled."""

    def save(self, path: Path) -> None:
        """Write a new file; returns when it is on disk."""
        buffer = io.BytesIO()
        wrench = {f"wrench_{name}": getattr(self.samples, name) for name in _WRENCH}
        poses = {f"pose_{name}": getattr(self.states, name) for name in _POSES}
        rate = np.array(self.nominal_rate_Hz)
        np.savez(buffer, format=np.array(FORMAT), nominal_rate_Hz=rate, **wrench, **poses)
        write_new(path, buffer.getvalue())

    @classmethod
    def load(cls, path: Path) -> "MotionRecording":
        """Read a file; raises `BadDataset`."""
        try:
            with zipfile.ZipFile(path) as file:  # which checks the CRC-32 of each array
                data = {
                    name.removesuffix(".npy"): np.lib.format.read_array(io.BytesIO(file.read(name)), allow_pickle=False)
                    for name in file.namelist()
                }
            return cls._of(data)
        except (KeyError, OSError, ValueError, zipfile.BadZipFile, EOFError) as error:
            raise BadDataset(f"{path} is not a recording in motion ({error}): take it from a copy") from error

    @classmethod
    def _of(cls, data: Mapping[str, Any]) -> "MotionRecording":
        if str(data.get("format")) != FORMAT:
            raise ValueError(f"its format is {data.get('format')}, this version reads {FORMAT}")
        return cls(
            FtSamples(*(data[f"wrench_{name}"] for name in _WRENCH)),
            ArmStates(*(data[f"pose_{name}"] for name in _POSES)),
            float(data["nominal_rate_Hz"]),
        )

    def means(self) -> tuple[Means, Means]:
        """Return both streams as the estimator takes them, on the host's clock in s since the first sample."""
        start_ns = int(min(self.samples.t_host_ns[0], self.states.t_host_ns[0]))
        wrench, poses = Means(), Means()
        wrench.add(self._wrench_s(start_ns), self.samples.wrench)
        rotations = self.states.R_base_flange.reshape(-1, 9)
        t_s = measured_s(self.states.t_device_s, self.states.t_host_ns, start_ns)
        poses.add(t_s, np.hstack([rotations, self.states.p_base_flange_m]))
        return wrench, poses

    def _wrench_s(self, start_ns: int) -> Array:
        """Return the times of the wrenches by the sensor's clock, or its count; a polled one has neither."""
        samples = self.samples
        if np.isfinite(samples.t_device_s).all():
            return measured_s(samples.t_device_s, samples.t_host_ns, start_ns)
        if math.isfinite(self.nominal_rate_Hz):
            return measured_s(samples.seq, samples.t_host_ns, start_ns)
        return np.asarray((samples.t_host_ns - start_ns) * 1e-9)


def measured_s(count: Any, t_host_ns: Any, start_ns: int) -> Array:
    """Return the times of measurement (n,): the straight line below the times of receipt over the device's count.

    Of all lines with no sample below it, the one that is the nearest to all on average: however many samples a computer
    that starves receives late, it goes through those that came the soonest.
    """
    x, y = np.asarray(count, dtype=np.float64) - float(count[0]), (t_host_ns - start_ns) * 1e-9
    middle = int(np.clip(np.searchsorted(x, x.mean(), "right"), 1, len(x) - 1))
    slope = (y[-1] - y[0]) / (x[-1] - x[0])
    for _ in range(_PASSES):  # Newton's method: equal distances of the soonest sample in both parts
        above = y - slope * x
        i, j = int(np.argmin(above[:middle])), middle + int(np.argmin(above[middle:]))
        before, slope = slope, (y[j] - y[i]) / (x[j] - x[i])
        if slope == before:
            break
    return np.asarray(np.maximum.accumulate(slope * x + np.min(y - slope * x)))


def solve_motion_file(
    path: Path, *, height_m: float | None, known: Known | None, provenance: Mapping[str, Any], **circumstances: Any
) -> CalibrationResult:
    """Calibrate from the recording of a run; circumstances as for `ftcalib.motion.solve.solve_motion`."""
    wrench, poses = MotionRecording.load(path).means()
    source = {"recording": path.name, "recording_sha256": hashlib.sha256(path.read_bytes()).hexdigest()}
    return solve_motion(
        wrench,
        poses,
        known=known,
        guarded=True,
        height_m=height_m,
        provenance={**provenance, **source},
        **circumstances,
    )
