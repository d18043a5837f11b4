"""Bota SensONE or Rokubi force/torque sensor on a serial port.

Ref: Bota Systems, serial interface of SensONE and Rokubi, as in the vendor's example programs.
Checked on hardware: no. Verified against: tests/unit/drivers/bota/test_codec.py and the emulator (tests/wire).

The sensor streams from power-up on. The driver only reads, unless the address configures the filter; `close` leaves the
stream running. The driver does not wait for the boot text, which may have been sent hours ago.
"""

import logging
import math
from itertools import pairwise
from statistics import median
from typing import Self

import numpy as np

from ftdrivers.bota import codec
from ftdrivers.clock import REAL, Clock
from ftdrivers.errors import ConnectError, DeviceFault, DeviceTimeout, StreamBroken
from ftdrivers.interfaces import NOT_REPORTED, DeviceInfo, FtSamples
from ftdrivers.registry import Options
from ftdrivers.streaming.sensor import NOTHING, StreamingSensor, scale_facts
from ftdrivers.wires.serial_port import SerialPort
from ftdrivers.wires.status_word import describe_status

log = logging.getLogger(__name__)

_BAUD = 460_800
_FIRST_FRAMES = 8
"""The median of their spacing is the sample period."""
_FIRST_FRAMES_S = 3.0
"""Enough for a sensor that is still booting."""
_REPLY_S = 1.0
_ATTEMPTS = 3
_CLOCK = 1 << 32


class BotaSensor(StreamingSensor):
    """A Bota SensONE or Rokubi with the serial interface of 37-byte frames.

    `t_device_s` is the sensor's clock, `seq` counts its sample periods, so that gaps are visible. `counts` are empty,
    because the sensor sends N and N·m. Overrange, invalid and uncalibrated samples are a `DeviceFault`.

    Parameters
    ----------
    port : str
        The serial port; ``/dev/serial/by-id/…`` survives replugging.
    sinc : int, optional
        Filter length, such as 512; the sample period is 19.53125 µs times this. With it, the driver configures the
        sensor to stream calibrated binary frames; without it, the driver never sends anything.
    sign : int
        -1 for a sensor mounted or wired to report the reaction.
    """

    def __init__(self, port: str, *, sinc: int | None = None, sign: int = 1, clock: Clock = REAL) -> None:
        super().__init__(f"Bota sensor on {port}", sign=sign, clock=clock)
        self._port = SerialPort(self.name, port, _BAUD, clock=clock)
        self._sinc = sinc
        self._temperature_C = math.nan

    @classmethod
    def from_url(cls, address: str, options: Options, *, sign: int = 1, clock: Clock = REAL) -> Self:
        """Build from ``bota:///dev/serial/by-id/…?sinc=512``."""
        return cls(address, sinc=options.integer("sinc", 0, 0, 512) or None, sign=sign, clock=clock)

    def temperature_C(self) -> float | None:
        """Return the temperature of the newest frame."""
        return self._temperature_C if math.isfinite(self._temperature_C) else None

    def _connect(self) -> DeviceInfo:
        self._port.open()
        self._seen_status = 0
        if self._sinc is not None:
            setup = codec.BINARY_AND_CALIBRATED, codec.filter_command(self._sinc)
            for command in (codec.ENTER_SETUP, *setup, codec.ENTER_RUN):
                self._command(command)
        self._frames = codec.deframer()
        first = self._first_frames()
        times = [frame.t_us for frame in first]
        self._period_us = median((b - a) % _CLOCK for a, b in pairwise(times))
        if not self._period_us:
            raise ConnectError(f"{self.name}: the sensor's clock stands still at {times[-1]} µs", "power it off and on")
        self._nominal_Hz = 1e6 / self._period_us
        self._t_us = times[-1]
        self._seq = 0
        return DeviceInfo(
            model="Bota force/torque sensor",
            serial=NOT_REPORTED,
            firmware=NOT_REPORTED,
            facts=scale_facts(1.0, 1.0, "documented"),
        )

    def _read_block(self) -> FtSamples:
        received = self._frames.feed(self._port.read_all(codec.FRAME_SIZE))
        t_host_ns = self._clock.now_ns()
        self._malformed = self._frames.damaged
        if not received:
            return NOTHING
        frames = [codec.decode_frame(frame) for _, frame in received]
        times = [self._elapse(frame.t_us) for frame in frames]
        status = np.array([frame.status for frame in frames], np.uint32)
        self._judge(int(np.bitwise_or.reduce(status)))
        self._temperature_C = frames[-1].temperature_C
        return FtSamples.of(
            t_host_ns,
            [seq for _, seq in times],
            [frame.wrench for frame in frames],
            t_device_s=np.array([t_us for t_us, _ in times]) * 1e-6,
            status=status,
        )

    def _disconnect(self) -> None:
        self._port.close()

    def _command(self, command: bytes) -> None:
        for _ in range(_ATTEMPTS):
            self._port.write(command)
            answer = b""  # its reply comes after frames that were already on the way
            for _ in self._clock.looks(_REPLY_S):
                answer = answer[-len(codec.success(command)) :] + self._port.read_all(1)
                if codec.success(command) in answer:
                    return
        raise DeviceTimeout(
            f"{self.name}: '{command.decode()}' was not confirmed within {_ATTEMPTS} times {_REPLY_S} s",
            "check supply and wiring, power it off and on",
        )

    def _first_frames(self) -> list[codec.Frame]:
        frames: list[codec.Frame] = []
        for _ in self._clock.looks(_FIRST_FRAMES_S):
            frames += [codec.decode_frame(frame) for _, frame in self._frames.feed(self._port.read_all(1))]
            if len(frames) >= _FIRST_FRAMES:
                return frames
        raise ConnectError(
            f"{self.name}: {len(frames)} intact frames within {_FIRST_FRAMES_S} s, {_FIRST_FRAMES} are needed",
            "check supply and wiring; add ?sinc=512 for a sensor in set-up, in text mode or at another rate",
        )

    def _elapse(self, t_us: int) -> tuple[int, int]:
        """Unwrap the sensor's clock; return (time in µs, sequence number)."""
        step_us = (t_us - self._t_us) % _CLOCK
        if step_us > _CLOCK // 2:
            raise StreamBroken(
                f"{self.name}: the sensor's clock went back to {t_us} µs: it has restarted", "open it again"
            )
        self._t_us += step_us
        if not step_us:
            return self._t_us, self._seq  # the same sample again
        periods = max(1, round(step_us / self._period_us))
        self._seq += periods
        self._lost += periods - 1
        return self._t_us, self._seq

    def _judge(self, status: int) -> None:
        """Raise when a sample is unusable; log other status bits once."""
        if status & (codec.RAW | codec.OVERRANGE | codec.INVALID):
            found = f"{self.name}: status {describe_status(status, codec.STATUS_BITS)}"
            if status & codec.RAW:
                raise DeviceFault(f"{found}, samples are not in N", "add ?sinc=512 to its address")
            raise DeviceFault(found, "take the load off, check the cable")
        if new := status & ~self._seen_status:
            log.warning("%s: status %s; measuring continues", self.name, describe_status(new, codec.STATUS_BITS))
            self._seen_status |= new
