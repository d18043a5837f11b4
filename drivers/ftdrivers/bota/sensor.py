"""Bota SensONE or Rokubi force/torque sensor on a serial port.

Ref: Bota Systems, serial interface of SensONE and Rokubi, as in the vendor's example programs and ROS drivers.
Checked on hardware: no. Verified against: tests/unit/drivers/bota/test_codec.py and the emulator (tests/wire).

The sensor streams after power-up. Opening its port restarts it, unless it has its own supply; the vendor's driver waits
3 s. This driver only reads, unless the address configures the filter. `close` leaves the stream running. The boot text
is optional, because a sensor with its own supply may have sent it long ago.
"""

import contextlib
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
from ftdrivers.wires.framing import describe_status, is_stream
from ftdrivers.wires.serial_port import SerialPort, SerialProbe, other_baud

log = logging.getLogger(__name__)

# Baud rates of the vendor's examples, and of its ROS 2 driver.
_USUAL_BAUDS = (460_800, codec.DEFAULT_BAUD)
# Number of frames from whose median spacing the sample period is estimated.
_FIRST_FRAMES = 8
# Time-out for a sensor that boots, s.
_BOOT_S = 5.0
# If this many bytes, more than the boot text, contain no frame, the baud rate or the format is wrong.
_NOISE_BYTES = 40 * codec.FRAME_SIZE
# Time for which the port is closed, s. After a shorter time the sensor may not restart and prints no boot text.
_CLOSED_S = 0.1
_REPLY_S = 1.0
# The first commands are ignored while the sensor boots.
_ATTEMPTS = 5
_CLOCK = 1 << 32


class BotaSensor(StreamingSensor):
    """A Bota SensONE or Rokubi with the serial interface of 37-byte frames.

    `t_device_s` is the time on the sensor's clock. `seq` counts its sample periods, so gaps are visible. `counts`
    are empty, because the sensor sends N and N·m. Overrange, invalid and uncalibrated samples raise `DeviceFault`.

    Parameters
    ----------
    port : str
        Serial port. A path such as ``/dev/serial/by-id/…`` remains valid after replugging.
    baud : int, optional
        Baud rate, one of `codec.BAUDS`. By default the driver tries 460800, then 230400.
    sinc : int, optional
        Filter length, 64 to 2048, such as 512; the sample period is 19.53125 µs times the length. If it is given, the
        driver configures the sensor to stream calibrated binary frames; otherwise the driver sends nothing.
    sign : int
        -1 for a sensor that reports the reaction.
    """

    def __init__(
        self, port: str, *, baud: int | None = None, sinc: int | None = None, sign: int = 1, clock: Clock = REAL
    ) -> None:
        super().__init__(f"Bota sensor on {port}", sign=sign, clock=clock)
        if baud is not None and baud not in codec.BAUDS:
            raise ValueError(f"baud is {baud}; choose one of {', '.join(map(str, codec.BAUDS))}")
        if sinc is not None and not 64 <= sinc <= 2048:
            raise ValueError(f"sinc is {sinc}; choose 64 to 2048")
        bauds = _USUAL_BAUDS if baud is None else (baud,)
        # Port settings to try, that with the last used baud rate first.
        self._ports = [(baud, SerialPort(self.name, port, baud, clock=clock)) for baud in bauds]
        self._port = self._ports[0][1]
        self._sinc = sinc
        # Bytes received between opening the port and the first frames.
        self._text = b""
        self._temperature_C = math.nan

    @classmethod
    def from_url(cls, address: str, options: Options, *, sign: int = 1, clock: Clock = REAL) -> Self:
        """Build the driver from an address such as ``bota:///dev/serial/by-id/…?baud=460800&sinc=512``."""
        return cls(
            address,
            baud=options.integer("baud", 0, 0, 460_800) or None,
            sinc=options.integer("sinc", 0, 0, 2048) or None,
            sign=sign,
            clock=clock,
        )

    def temperature_C(self) -> float | None:
        """Return the temperature of the newest frame, °C."""
        return self._temperature_C if math.isfinite(self._temperature_C) else None

    def _connect(self) -> DeviceInfo:
        self._seen_status = 0
        times = [frame.t_us for frame in self._find()]
        self._period_us = median((b - a) % _CLOCK for a, b in pairwise(times))
        if not self._period_us:
            raise ConnectError(f"{self.name}: the sensor's clock is stuck at {times[-1]} µs", "power it off and on")
        self._nominal_Hz = 1e6 / self._period_us
        self._t_us = times[-1]
        self._seq = 0
        identity = codec.find_identity(self._text)
        return DeviceInfo(
            model=f"Bota {identity.name or 'force/torque sensor'}",
            serial=identity.serial or NOT_REPORTED,
            firmware=identity.firmware or NOT_REPORTED,
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
        # Nothing is sent: the sensor continues to stream, as before it was opened.
        self._port.close()

    def _find(self) -> list[codec.Frame]:
        """Open the port at the baud rate of the sensor, configure it if requested, and return its first frames."""
        # The boot text is not awaited, because a running sensor sends none.
        found, has_noise = list[str](), False
        for baud, port in tuple(self._ports):
            self._port, self._text, self._frames = port, b"", codec.deframer()
            self._ports.sort(key=lambda port: port[0] != baud)  # a reconnection tries this baud rate first
            if found:
                self._clock.sleep(_CLOSED_S)
            port.open()
            try:
                if self._sinc is not None:
                    self._configure(baud, self._sinc)
                return self._first_frames()
            except DeviceTimeout as exc:
                found.append(f"{exc.found} at {baud} baud")
                has_noise = has_noise or self._frames.has_noise
                port.close()
        fix = other_baud(codec.DEFAULT_BAUD) if has_noise else "check supply and wiring"
        if self._sinc is None:
            fix += "; if the sensor is in set-up or text mode, add sinc=512 to its address"
        raise ConnectError(f"{self.name}: {', '.join(found)}", fix)

    def _configure(self, baud: int, sinc: int) -> None:
        # The sensor is configured only if the address requests it; a sensor in another mode needs ?sinc=512 once.
        self._command(codec.ENTER_SETUP)
        if not codec.find_identity(self._text).serial:  # the sensor has not just booted, so it must be asked
            with contextlib.suppress(DeviceTimeout):
                self._command(codec.ASK_SERIAL, attempts=1)
        for command in (*codec.setup_commands(baud, sinc), codec.ENTER_RUN):
            self._command(command)

    def _command(self, command: bytes, attempts: int = _ATTEMPTS) -> None:
        """Send a command until the sensor confirms it. Frames may arrive before the reply."""
        for _ in range(attempts):
            begin = len(self._text)
            self._port.write(command)
            for _ in self._clock.looks(_REPLY_S):
                data = self._port.read_all(1)
                self._text += data
                self._frames.feed(data)
                if codec.success(command) in self._text[begin:]:
                    return
        raise DeviceTimeout(f"'{command.decode()}' was not confirmed in {attempts} attempts of {_REPLY_S:g} s")

    def _first_frames(self) -> list[codec.Frame]:
        frames: list[codec.Frame] = []
        begin, begin_s = len(self._text), self._clock.now_s()
        self._frames = codec.deframer()
        for _ in self._clock.looks(_BOOT_S):
            data = self._port.read_all(1)
            self._text += data
            frames += [codec.decode_frame(frame) for _, frame in self._frames.feed(data)]
            if len(frames) >= _FIRST_FRAMES:
                return frames
            if not frames and len(self._text) - begin > _NOISE_BYTES:
                break
        raise DeviceTimeout(f"{self._frames.arrived} within {self._clock.now_s() - begin_s:.1f} s")

    def _elapse(self, t_us: int) -> tuple[int, int]:
        """Undo the overflow of a time on the sensor's clock; return (time in µs, sequence number)."""
        step_us = (t_us - self._t_us) % _CLOCK
        if step_us > _CLOCK // 2:
            raise StreamBroken(
                f"{self.name}: the sensor's clock went back to {t_us} µs: it has restarted", "open it again"
            )
        self._t_us += step_us
        if not step_us:
            return self._t_us, self._seq  # a duplicate
        periods = max(1, round(step_us / self._period_us))
        self._seq += periods
        self._lost += periods - 1
        return self._t_us, self._seq

    def _judge(self, status: int) -> None:
        """Raise `DeviceFault` if a sample is unusable; log other status bits once."""
        if status & (codec.RAW | codec.OVERRANGE | codec.INVALID):
            found = f"{self.name}: status {describe_status(status, codec.STATUS_BITS)}"
            if status & codec.RAW:
                raise DeviceFault(f"{found}, samples are not in N", "add ?sinc=512 to its address")
            raise DeviceFault(found, "remove the load and check the cable")
        if new := status & ~self._seen_status:
            log.warning("%s: status %s; measurement continues", self.name, describe_status(new, codec.STATUS_BITS))
            self._seen_status |= new


def _boot_url(data: bytes) -> str | None:
    return None if (baud := codec.find_baud(data)) is None else f"bota://{{port}}?baud={baud}"


SERIAL_PROBES = (
    SerialProbe("bota://{port}?baud=460800", 460_800, is_stream(codec.deframer)),
    SerialProbe("bota://{port}?baud=230400", 230_400, is_stream(codec.deframer), boot_url=_boot_url),
)
