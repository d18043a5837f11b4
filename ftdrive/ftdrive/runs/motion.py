"""Recording of a free tool in motion: all samples of sensor and arm, in one file of a run or in several parts."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ftcalib.errors import BadDataset
from ftcalib.model import Array
from ftcalib.motion.samples import Means, measured_s
from ftdrive.runs.numbers import DAMAGE, read_arrays, write_arrays
from ftdrivers.interfaces import ArmStates, FtSamples

FORMAT: Final = "ftdrive.motion/1"
# Arrays in the file, with the shape of one sample in each; None is any shape, because sensors differ in `counts`.
_WRENCH: Final = {"t_host_ns": (), "t_device_s": (), "seq": (), "counts": None, "wrench": (6,), "status": ()}
_POSES: Final = {
    "t_host_ns": (),
    "t_device_s": (),
    "q_rad": (6,),
    "qd_rad_s": (6,),
    "R_base_flange": (3, 3),
    "p_base_flange_m": (3,),
}


@dataclass(frozen=True, slots=True, eq=False)
class MotionRecording:
    """All samples of sensor and arm that were recorded while a free tool moved."""

    samples: FtSamples
    states: ArmStates
    nominal_rate_Hz: float = math.nan
    """Nominal rate of the sensor; NaN for a polled sensor, which has none."""

    def save(self, path: Path) -> None:
        """Write the recording to a new file; return once it is on disk."""
        wrench = {f"wrench_{name}": getattr(self.samples, name) for name in _WRENCH}
        poses = {f"pose_{name}": getattr(self.states, name) for name in _POSES}
        arrays = {"format": np.array(FORMAT), "nominal_rate_Hz": np.array(self.nominal_rate_Hz), **wrench, **poses}
        write_arrays(path, arrays, compressed=False)

    @classmethod
    def load(cls, path: Path) -> "MotionRecording":
        """Read a file made by `save`. Raises `BadDataset` if it is damaged or has another format."""
        try:
            data = read_arrays(path)
            if str(data.get("format")) != FORMAT:
                raise ValueError(f"its format is {data.get('format')}, but this version reads {FORMAT}")
            return cls(
                FtSamples(*_signal_columns(data, "wrench", _WRENCH)),
                ArmStates(*_signal_columns(data, "pose", _POSES)),
                float(data["nominal_rate_Hz"]),
            )
        except DAMAGE as error:
            raise BadDataset(f"{path} is not a recording in motion ({error}): restore it from a copy") from error

    @property
    def count(self) -> Array:
        """Times on the sensor's clock, s, or, without a clock, its sample numbers; NaN if polled, without either."""
        if np.isfinite(self.samples.t_device_s).all():
            return self.samples.t_device_s
        even = math.isfinite(self.nominal_rate_Hz)
        return np.asarray(self.samples.seq, np.float64) if even else np.full(len(self.samples), np.nan)


def means_of(path: Path) -> tuple[Means, Means]:
    """Return means of wrench and pose for the motion estimator, with host times since the first sample, s.

    Each file is read twice, so that only one is in memory at a time. Damage or missing samples raise `BadDataset`.
    """
    files = files_of(path)  # the same for both passes, even if the recording grows
    times = [
        (part.samples.t_host_ns, part.count, part.states.t_host_ns, part.states.t_device_s)
        for part in map(MotionRecording.load, files)
    ]
    wrench_ns, counts, poses_ns, poses_s = (list(column) for column in zip(*times, strict=True))
    received = [np.concatenate(each) for each in (wrench_ns, poses_ns)]
    if not all(map(len, received)):
        raise BadDataset(f"{path} has samples of only one device: record again")
    start_ns = int(min(each[0] for each in received))
    clocks = (received[0], np.concatenate(counts)), (received[1], np.concatenate(poses_s))
    wrench_s, pose_s = (
        measured_s(count, t_ns, start_ns) if np.isfinite(count).all() else (t_ns - start_ns) * 1e-9
        for t_ns, count in clocks
    )
    wrench, poses = Means(), Means()
    ends = np.cumsum([list(map(len, pair)) for pair in zip(wrench_ns, poses_ns, strict=True)], axis=0)
    for part, t_w, t_p in zip(
        map(MotionRecording.load, files),
        np.split(wrench_s, ends[:-1, 0]),
        np.split(pose_s, ends[:-1, 1]),
        strict=True,
    ):
        wrench.add(t_w, part.samples.wrench)
        poses.add(t_p, np.hstack([part.states.R_base_flange.reshape(-1, 9), part.states.p_base_flange_m]))
    return wrench, poses


def _signal_columns(
    data: Mapping[str, Any], kind: str, shapes: Mapping[str, tuple[int, ...] | None]
) -> Iterator[NDArray[Any]]:
    n = len(data[f"{kind}_t_host_ns"])
    for name, shape in shapes.items():
        array = data[f"{kind}_{name}"]
        expected = (n, *(array.shape[1:] if shape is None else shape))
        if array.shape != expected or array.dtype.kind not in "iuf":
            raise ValueError(f"{kind}_{name} is {array.dtype} {array.shape}, expected numbers {expected}")
        yield array


def files_of(path: Path) -> list[Path]:
    """Return the files of a recording in motion: `path` itself, or its parts in order if it is a folder."""
    files = sorted(path.glob("*.npz"), key=lambda file: file.stem.zfill(9)) if path.is_dir() else [path]
    if not files:
        raise BadDataset(f"{path} has no samples yet: record for a few seconds")
    return files
