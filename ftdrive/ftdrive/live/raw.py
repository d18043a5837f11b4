"""The readings of a sensor alone, as a stream: there is no arm and no calibration, and only a tare is subtracted."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ftcalib import CalibrationResult, Parameters
from ftcalib.after.series import BiasTemperature
from ftdrive.cell.config import CellConfig
from ftdrive.cell.emulated import Station
from ftdrive.live.samples import NO_ARM, Block, LinkStatus, Paired, Stages, StreamEvent, StreamStatus
from ftdrive.live.stages import TARE_S
from ftdrive.live.stream import CompensatedStream
from ftdrive.runs.verification import VerificationRecord
from ftdrivers.interfaces import ArmState, Array, DeviceInfo, ForceTorqueSensor, ReadOnlyArm

# Nothing is known of a tool, and so nothing is subtracted; the value is in no output.
_NOTHING = CalibrationResult(
    Parameters(np.eye(3), *np.zeros((4, 3))), np.eye(15), np.zeros((1, 6)), 0.0, 0, "residuals", 9.81, "ml", ()
)


class RawStream(CompensatedStream):
    """Samples of a sensor as they are read, minus a tare, as long as `with` lasts; axes and point are the sensor's.

    It knows neither contact nor drift of a bias. After an interruption it reconnects as `CompensatedStream` does.

    Parameters
    ----------
    cell : CellConfig or Station
        Only its sensor is used.
    sensor : ForceTorqueSensor, optional
        Used in place of that of the cell.

    Raises
    ------
    ConnectError
        On entry: the sensor does not answer.
    """

    def __init__(self, cell: CellConfig | Station, sensor: ForceTorqueSensor | None = None) -> None:
        stages = Stages(bias=False, gravity=False)
        super().__init__(cell, _NOTHING, stages=stages, devices=(sensor, _NoArm(self)))
        self._tare: tuple[Array, int] | None = None

    def _chosen(
        self, _arm: DeviceInfo, _sensor: DeviceInfo
    ) -> tuple[CalibrationResult, str, tuple[str, ...], BiasTemperature | None]:
        return _NOTHING, "", (), None

    def _trusted(self) -> tuple[VerificationRecord | None, str]:
        return None, "raw readings of the sensor alone: no arm, no calibration"

    def _compensate(self, rows: Paired, motion: tuple[NDArray[np.int8], Array], _: Array | None) -> Block:
        n = len(rows)
        self._noise.add(rows.raw, motion[0])
        raw = rows.raw if self._tare is None else rows.raw - self._tare[0]
        return Block(
            **rows.columns(),
            wrench=self._filter(raw),
            chi2=np.full(n, np.nan),
            in_contact=np.zeros(n, np.bool_),
            sigma=self.sigma_of_mean(np.eye(3)),
            frame=self.frame,
            stages=self.stages,
        )

    def tare(self) -> StreamEvent:
        """Subtract the mean of the last half second from now on, whatever is on the sensor."""
        with self._lock:
            if (rows := self.recent()) is None:
                return self.note("tare-refused", "tare refused: no sample has arrived yet; tare again", {})
            mean = rows.raw[rows.t_host_ns >= self._newest_ns - round(TARE_S * 1e9)].mean(axis=0)
            return self._set_tare(mean, f"tare: {float(np.linalg.norm(mean[:3])):.2f} N are subtracted")

    def undo_tare(self) -> StreamEvent:
        """Subtract nothing any more."""
        with self._lock:
            if self._tare is None:
                return self.note("tare-refused", "there is no tare to undo", {})
            return self._set_tare(None, "tare undone")

    def _set_tare(self, tare: Array | None, text: str) -> StreamEvent:
        self._tare = None if tare is None else (tare, self._newest_ns)
        self._filter = self._filter_of(self.stages)
        values: dict[str, Any] = {"tare": None if tare is None else tare.tolist()}
        return self.note("tare-undone" if tare is None else "tare", text, values)

    @property
    def tare_wrench(self) -> Array | None:
        """(6,) what is subtracted, N and N·m; None without a tare."""
        return None if self._tare is None else self._tare[0]

    def _status_of(self, sensor: LinkStatus, arm: LinkStatus, delay: tuple[float, float]) -> StreamStatus:
        tare_ns = None if self._tare is None else self._tare[1]
        # an arm that is not there has no silence
        arm = replace(arm, age_s=0.0, error="")
        status = super()._status_of(sensor, arm, delay)
        return replace(status, tare=self.tare_wrench, tare_t_host_ns=tare_ns)


class _NoArm(ReadOnlyArm):
    """Stands where a stream reads an arm: always in the same pose, joints and position unknown."""

    def __init__(self, stream: RawStream) -> None:
        self._stream = stream  # whose clock is known on entry

    def identify(self) -> DeviceInfo:
        return NO_ARM

    def state(self) -> ArmState:
        unknown = np.full(6, np.nan)
        return ArmState(self._stream.clock.now_ns(), math.nan, unknown, unknown, np.eye(3), np.full(3, np.nan))
