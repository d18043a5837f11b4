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
_BLOCKS: Final = 200
"""Of samples, from each of which the one counts that is received the soonest."""


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
    """Return the times of measurement (n,): the line over the device's count that is closest below all receipts.

    A computer that starves receives samples late, for seconds on end, but none early. Source: Moon, Skelly, Towsley,
    "Estimation and removal of clock skew from network delay measurements", INFOCOM 1999.
    """
    from scipy.optimize import linprog

    x, y = np.asarray(count, dtype=np.float64) - float(count[0]), (t_host_ns - start_ns) * 1e-9
    rough = (y[-1] - y[0]) / max(x[-1], 1.0)
    late_s = y - rough * x
    soonest = np.array(
        [block[np.argmin(late_s[block])] for block in np.array_split(np.arange(len(x)), _BLOCKS) if len(block)]
    )
    at, above = x[soonest] / max(x[-1], 1.0), 1e3 * (late_s[soonest] - late_s.min())
    line = linprog([-0.5, -1.0], np.column_stack([at, np.ones(len(at))]), above, bounds=(None, None))
    turn_s, offset_s = 1e-3 * np.asarray(line.x, dtype=np.float64)
    return np.asarray(rough * x + late_s.min() + offset_s + turn_s * x / max(x[-1], 1.0))


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
        height_m=height_m,
        provenance={**provenance, **source},
        **circumstances,
    )
