"""The force/torque sensor in the wrist of an e-Series arm.

The controller reports two wrenches. `actual_TCP_force` is in base axes at the active TCP. The controller subtracts the
configured payload and the reading at the last zeroing from it, which cannot be undone, so it is useless for a
gravity calibration. `ft_raw_wrench` (PolyScope 5.9 and later) is in flange axes, neither compensated nor zeroed.
Universal Robots documents neither its unit nor its reference point. Therefore this driver reads `ft_raw_wrench`, and
requires a scale that the user has measured with a known weight. Its zero is arbitrary: recordings have zeros of about
1,800, 400 and 25,400 N and -76 N·m, and a drift of 7 N in the first ten minutes.

Ref: Universal Robots, "Real-Time Data Exchange (RTDE) Guide": `ft_raw_wrench`, `actual_TCP_force`.
Checked on hardware: no. Verified against: tests/unit/drivers/ur/test_wrist_sensor.py.
"""

from typing import TYPE_CHECKING, Self

import numpy as np

from ftdrivers.clock import REAL, Clock
from ftdrivers.errors import ConnectError, ProtocolError, StreamBroken
from ftdrivers.interfaces import NOT_REPORTED, WRIST_SENSOR, DeviceInfo, Fact, FtSamples
from ftdrivers.streaming.sensor import NOTHING, StreamingSensor, scale_facts
from ftdrivers.ur.rtde import Subscription
from ftdrivers.ur.timing import STRICT

if TYPE_CHECKING:
    from ftdrivers.registry import Options

_RATE_Hz = 500.0


class UrWristSensor(StreamingSensor):
    """The wrist sensor of an e-Series arm through its controller, 500 Hz.

    The wrench is `ft_raw_wrench` divided by the given scale, in flange axes; the flange is assumed as reference point.
    `counts` are empty, because the controller sends floating-point numbers. `t_device_s` is the controller's time and
    `seq` counts its cycles of 2 ms, so gaps are visible. `status` is 0, because the controller reports none.

    Parameters
    ----------
    host : str
        Address of the controller.
    counts_per_N, counts_per_Nm : float
        Value of `ft_raw_wrench` at 1 N and at 1 N·m; docs/how-to/connect-a-sensor.md describes how to measure it.
    sign : int
        -1 for a sensor that reports the reaction.
    clock : Clock
        Clock of the time stamps and time-outs.
    """

    def __init__(
        self, host: str, *, counts_per_N: float, counts_per_Nm: float, sign: int = 1, clock: Clock = REAL
    ) -> None:
        super().__init__(f"wrist sensor of the arm at {host}", sign=sign, clock=clock)
        self._host = host
        self._facts = {**scale_facts(counts_per_N, counts_per_Nm, "configured"), "zero": Fact("arbitrary", "assumed")}
        self._counts_per_unit = np.repeat([counts_per_N, counts_per_Nm], 3)
        self._stream: Subscription | None = None

    @classmethod
    def from_url(cls, address: str, options: "Options", *, sign: int = 1, clock: Clock = REAL) -> Self:
        """Build the driver from ``ur-ft://192.168.1.10?counts_per_N=…&counts_per_Nm=…``; both options are required."""
        why = "measure the undocumented unit of ft_raw_wrench as described in docs/how-to/connect-a-sensor.md"
        return cls(
            address,
            counts_per_N=options.positive("counts_per_N", why),
            counts_per_Nm=options.positive("counts_per_Nm", why),
            sign=sign,
            clock=clock,
        )

    def _connect(self) -> DeviceInfo:
        outputs = {"timestamp": "DOUBLE", "ft_raw_wrench": "VECTOR6D"}
        connect_s = self._clock.patience_s(STRICT.connect_s)
        self._stream = Subscription(self._host, outputs, _RATE_Hz, timeout_s=connect_s, clock=self._clock)
        version = ".".join(map(str, self._stream.version))
        if self._stream.missing:
            raise ConnectError(
                f"{self.name}: PolyScope {version} does not report {', '.join(self._stream.missing)}",
                "use an e-Series arm with PolyScope 5.9 or later",
            )
        self._seq: int | None = None
        self._nominal_Hz = _RATE_Hz
        return DeviceInfo(
            model=WRIST_SENSOR,
            serial=NOT_REPORTED,
            firmware=version,
            facts=self._facts,
        )

    def _read_block(self) -> FtSamples:
        stream = self._stream
        if stream is None:
            raise StreamBroken(f"{self.name}: the sensor is closed", "open it first")
        try:
            received = stream.read(self._clock.poll_s)
        except TimeoutError:
            return NOTHING
        except (OSError, StreamBroken) as exc:
            raise StreamBroken(
                f"{self.name}: the connection was lost ({exc})", "check the robot and the cable, then open it again"
            ) from exc
        t_host_ns = self._clock.now_ns()
        outputs = stream.decode(received)
        t_device_s, raw = outputs["timestamp"], outputs["ft_raw_wrench"]
        if not (np.isfinite(t_device_s).all() and np.isfinite(raw).all()):
            raise ProtocolError(f"{self.name}: the wrench at {t_device_s[-1]} s is not finite: {raw[-1].tolist()}")
        seq = np.rint(t_device_s * _RATE_Hz).astype(np.int64)
        before = seq[0] - 1 if self._seq is None else self._seq
        steps = seq - np.concatenate([[before], seq[:-1]])  # four times as fast as `np.diff`
        if (steps <= 0).any():
            raise StreamBroken(
                f"{self.name}: the controller's clock went back to {t_device_s[steps <= 0][0]:.3f} s", "open it again"
            )
        self._lost += int((steps - 1).sum())
        self._seq = int(seq[-1])
        return FtSamples.of(t_host_ns, seq, raw / self._counts_per_unit, t_device_s=t_device_s)

    def _disconnect(self) -> None:
        stream, self._stream = self._stream, None
        if stream is not None:
            stream.close()
