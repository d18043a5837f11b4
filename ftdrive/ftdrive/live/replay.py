"""A recording that replaces the cell: the same stream, with its own time."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any, Self

import numpy as np

from ftcalib import CalibrationResult
from ftcalib.errors import BadDataset
from ftdrive.live.processing import SENSOR_FRAME
from ftdrive.live.samples import (
    Block,
    LinkStatus,
    Paired,
    Sample,
    Stages,
    StreamInfo,
    StreamStatus,
    WrenchFrame,
    sensor_origin_m,
)
from ftdrive.live.stream import ProcessedStream
from ftdrive.runs.run import Run
from ftdrivers.clock import REAL, Clock
from ftdrivers.interfaces import NOT_REPORTED, DeviceInfo

STEP_S = 0.01
"""One block has so much of the recording."""


class ReplayedStream(ProcessedStream):
    """Paired rows of a recording through the same processing as a live stream, at a chosen speed.

    While it is paused and at its end, `read` returns a block without rows.

    Parameters
    ----------
    info : StreamInfo
    rows : Paired
        The recording.
    frame : WrenchFrame
    stages : Stages
    speed : float
        1 is that of the recording, infinity as fast as it is read.
    clock : Clock
        Of the one who watches.
    """

    def __init__(
        self,
        info: StreamInfo,
        rows: Paired,
        *,
        frame: WrenchFrame = SENSOR_FRAME,
        stages: Stages | None = None,
        speed: float = 1.0,
        clock: Clock = REAL,
    ) -> None:
        if not len(rows):
            raise BadDataset("the recording has no samples: replay another one")
        self._rows = rows
        self._seconds = (rows.t_host_ns - rows.t_host_ns[0]) * 1e-9
        self.clock = clock
        super().__init__(info, frame, stages)
        self.learn_noise([rows])
        self._speed = speed
        # The first row that was not read.
        self._next = 0
        # Time in the recording, and when the clock showed what.
        self._begin_s, self._begin_ns = 0.0, clock.now_ns()
        self.is_paused = False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    # ----------------------------------------------------------------------------------------------------------- time

    @property
    def at_s(self) -> float:
        """Time in the recording of the newest row that was read."""
        return float(self._seconds[max(self._next - 1, 0)])

    @property
    def duration_s(self) -> float:
        """Duration of the recording."""
        return float(self._seconds[-1])

    @property
    def has_ended(self) -> bool:
        """Whether all rows were read."""
        return self._next >= len(self._rows)

    @property
    def speed(self) -> float:
        """Relative to the recording; settable."""
        return self._speed

    @speed.setter
    def speed(self, speed: float) -> None:
        if not speed > 0:
            raise ValueError(f"a speed of {speed} does not replay: give a positive one")
        self._speed = speed
        self._set_out(self.at_s)

    def pause(self) -> None:
        """Hold at the present time."""
        self.is_paused = True

    def resume(self) -> None:
        """Go on after a pause."""
        self.is_paused = False
        self._set_out(self.at_s)

    def seek(self, t_s: float) -> None:
        """Go to a time in the recording; filters and contacts restart there."""
        self._next = int(np.searchsorted(self._seconds, min(max(t_s, 0.0), self.duration_s)))
        self.restart(elsewhere=True)
        self._set_out(float(self._seconds[self._next]))

    def step(self) -> Block:
        """Return the next `STEP_S` of the recording, also while it is paused."""
        block = self._until(float(self._seconds[min(self._next, len(self._rows) - 1)]) + STEP_S)
        self._set_out(self.at_s)
        return block

    def _set_out(self, at_s: float) -> None:
        self._begin_s, self._begin_ns = at_s, self.clock.now_ns()

    # -------------------------------------------------------------------------------------------------------- reading

    def read(self, timeout_s: float = 0.1) -> Block:
        """Return the rows that are due since the last read, and wait for them up to `timeout_s`."""
        if self.is_paused or self.has_ended:
            self.clock.sleep(timeout_s)
            return self._until(-1.0)
        next_s = float(self._seconds[self._next])
        if math.isinf(self._speed):
            return self._until(next_s + STEP_S)
        due_s = (next_s + STEP_S - self._begin_s) / self._speed - (self.clock.now_ns() - self._begin_ns) * 1e-9
        self.clock.sleep(min(due_s, timeout_s))
        return self._until(self._begin_s + (self.clock.now_ns() - self._begin_ns) * 1e-9 * self._speed)

    def _until(self, t_s: float) -> Block:
        end = max(self._next, int(np.searchsorted(self._seconds, t_s, "right")))
        rows = self._rows.rows(slice(self._next, end))
        self._next = end
        return self._process_read(rows, last=self.has_ended)

    def __iter__(self) -> Iterator[Sample]:
        while not self.has_ended:
            yield from self.read()

    def status(self) -> StreamStatus:
        """Return rates, tare and drift; a recording has no ages, and its delay is already subtracted."""
        recent = slice(int(np.searchsorted(self._seconds, self.at_s - 1.0, "right")), self._next)
        seq = self._rows.seq[: self._next]
        lost = int(seq[-1] - seq[0]) + 1 - len(seq) if len(seq) else 0
        span_s = min(1.0, max(self.at_s, 1e-3))
        sensor = LinkStatus(len(self._rows.seq[recent]) / span_s, self.info.sensor_rate_Hz, lost, 0.0)
        arm = LinkStatus(self.info.arm_rate_Hz, self.info.arm_rate_Hz, 0, 0.0)
        return self._status_of(sensor, arm, (0.0, 0.0))


def replay_run(run: Run, calibration: CalibrationResult, name: str = "", **options: Any) -> ReplayedStream:
    """Replay the poses of a guided run, one after the other; the moves between them were not recorded.

    Parameters
    ----------
    run : Run
    calibration : CalibrationResult
    name : str
        Of the calibration.
    **options
        As `ReplayedStream`.

    Raises
    ------
    BadDataset
        The run is damaged or has no pose.
    """
    header, records = run.header(), run.records()
    if not records:
        raise BadDataset(f"{run.folder} has no pose: replay another run")
    pieces: list[Paired] = []
    count, span_s = 0, 0.0
    for record in records:
        samples, at = record.samples, record.before
        n, sent = len(samples.seq), int(samples.seq[-1] - samples.seq[0]) + 1
        span_s += (samples.t_host_ns[-1] - samples.t_host_ns[0]) * 1e-9
        pieces.append(
            Paired(
                t_host_ns=np.empty(n, np.int64),
                t_device_s=samples.t_device_s,
                # lost samples stay visible
                seq=samples.seq - samples.seq[0] + count,
                status=samples.status,
                raw=samples.wrench,
                q_rad=np.tile(at.q_rad, (n, 1)),
                R_base_flange=np.tile(at.R_base_flange, (n, 1, 1)),
                p_base_flange_m=np.full((n, 3), np.nan),
            )
        )
        count += sent
    rate_Hz = (count - len(records)) / max(span_s, 1e-9)
    rows = Paired.concatenate(pieces)
    begin_ns = int(records[0].samples.t_host_ns[0])
    rows = replace(rows, t_host_ns=begin_ns + np.rint(rows.seq * 1e9 / rate_Hz).astype(np.int64))
    config: Mapping[str, Any] = header["config"]
    info = StreamInfo(
        calibration=calibration,
        calibration_name=name,
        arm=_device(header, "arm"),
        sensor=_device(header, "sensor"),
        tool=config["tool"].get("name", ""),
        utc_offset_ns=records[0].clock_offset_ns,
        sensor_rate_Hz=rate_Hz,
        arm_rate_Hz=rate_Hz,
        p_flange_sensor_m=sensor_origin_m(config["sensor"].get("height_mm")),
        R_flange_tcp=np.eye(3),
        p_flange_tcp_m=np.full(3, np.nan),
        versions=header.get("versions", {}),
        emulated=header.get("station") is not None,
    )
    return ReplayedStream(info, rows, **options)


def _device(header: Mapping[str, Any], role: str) -> DeviceInfo:
    found = header.get("devices", {}).get(role, {})
    return DeviceInfo(*(found.get(name, NOT_REPORTED) for name in ("model", "serial", "firmware")))
