"""What the controller tells now, kept current by a thread.

ur_rtde does not tell a sample that has just been taken from one that has waited in the socket while this process was
suspended. Here a sample is live only if somebody had to wait for it.

Checked on hardware: no.
"""

import copy
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

from drivers._clock import awake_s
from drivers.errors import DeviceTimeout, DriverError, ProtocolError, StreamBroken
from drivers.ur.rtde import Subscription


@dataclass(frozen=True, slots=True)
class Sample:
    """What the controller told once."""

    t_host_ns: int
    t_awake_s: float
    """When it came, by `awake_s`."""
    t_device_s: float
    outputs: Mapping[str, tuple[float, ...]]


class LiveReader:
    """The controller's version, and its clock, active TCP offset and modes, kept current by a thread.

    Every sample carries the controller's time, the same clock the poses of ur_rtde carry, so that a pose can be matched
    with the offset that was active when it was taken.
    """

    _outputs: Mapping[str, str] = MappingProxyType(
        {
            "timestamp": "DOUBLE",
            "robot_mode": "INT32",
            "safety_mode": "INT32",
            "safety_status_bits": "UINT32",
            "runtime_state": "UINT32",
            "speed_scaling": "DOUBLE",
            "target_speed_fraction": "DOUBLE",
            "tcp_offset": "VECTOR6D",
            "payload": "DOUBLE",
            "payload_cog": "VECTOR3D",
        }
    )
    _frequency_Hz = 125.0  # the full rate of the CB3 generation; e-Series arms send every fourth cycle
    _live_s = (0.002, 0.1)
    """How long one waits for a sample that has just been taken: 8 ms. What has piled up comes without waiting."""

    def __init__(self, host: str) -> None:
        self._host = host
        self._stream: Subscription | None = None
        self._thread: threading.Thread | None = None
        self._changed = threading.Condition()
        self._newest: Sample | None = None
        self._live: Sample | None = None
        self._live_count = 0
        self._failure: DriverError | None = None
        self.version = (0, 0, 0, 0)
        """Of the controller, after `open`: major, minor, bugfix, build."""
        self.missing: frozenset[str] = frozenset()
        """What this controller does not know of what it was asked for, after `open`."""
        self.tells_tcp = False
        """Whether this controller tells its TCP offset; older ones do not."""
        self.silent = False
        """Whether nothing has come since somebody was told that the clock stands still."""

    def open(self, *, timeout_s: float) -> None:
        """Say hello and start to follow. Raises `ConnectError`."""
        self._stream = Subscription(self._host, self._outputs, self._frequency_Hz, timeout_s=timeout_s)
        self.version = self._stream.version
        self.missing = frozenset(self._stream.missing)
        self._names = [name for name in self._outputs if name not in self.missing]
        self.tells_tcp = "tcp_offset" in self._names
        self._thread = threading.Thread(target=self._run, args=(self._stream,), name="ur-live", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Let the connection go. Idempotent."""
        if self._stream is not None:
            self._stream.close()
            self._stream = None
        if self._thread is not None:
            self._thread.join(timeout=1.0)
            self._thread = None

    def now_s(self, *, limit_s: float) -> float:
        """Controller time of a sample taken after this call.

        However much has piled up in the sockets while this process was suspended: ur_rtde's samples of this time or
        later are new. Raises `StreamBroken` when the connection is lost and `DeviceTimeout` when the controller is
        silent for `limit_s`.
        """
        before = self._live_count
        return self._wait(lambda: self._live if self._live_count != before else None, limit_s).t_device_s

    def newest(self, *, since_s: float, limit_s: float) -> Sample:
        """Return the newest sample, taken at controller time `since_s` or later. Raises as `now_s`."""
        return self._wait(
            lambda: self._newest if self._newest is not None and self._newest.t_device_s >= since_s else None, limit_s
        )

    def live(self, *, max_age_s: float, limit_s: float) -> Sample:
        """Return the last sample that was new when it came, if that is `max_age_s` ago or less. Raises as `now_s`."""
        oldest_s = awake_s() - max_age_s
        return self._wait(
            lambda: self._live if self._live is not None and self._live.t_awake_s >= oldest_s else None, limit_s
        )

    def _wait(self, find: Callable[[], Sample | None], limit_s: float) -> Sample:
        silent_s = 0.0
        with self._changed:
            while True:
                self.check()
                if (found := find()) is not None:
                    return found
                if silent_s > limit_s:
                    self.silent = True
                    stands = "" if self._newest is None else f" at {self._newest.t_device_s:.3f} s"
                    raise DeviceTimeout(
                        f"the clock of {self._host} has stood still{stands} for {silent_s:.2f} s",
                        "check the robot and the network, and press the emergency stop if the arm moves",
                    )
                t0 = time.monotonic()
                self._changed.wait(0.02)
                # A process that was itself suspended has not been listening: that time does not count in full.
                silent_s += min(time.monotonic() - t0, 0.05)

    def check(self) -> None:
        """Raise what ended the stream, if it has ended."""
        if self._failure:
            raise copy.copy(self._failure) from self._failure

    def _run(self, stream: Subscription) -> None:
        """Follow the stream until it ends; what ended it is raised to whoever asks."""
        try:
            while True:
                t0 = awake_s()
                outputs = dict(zip(self._names, stream.read(None), strict=True))
                now_s = awake_s()
                with self._changed:
                    self.silent = False
                    self._newest = Sample(time.monotonic_ns(), now_s, outputs["timestamp"][0], outputs)
                    if self._live_s[0] <= now_s - t0 <= self._live_s[1]:
                        self._live = self._newest
                        self._live_count += 1
                    self._changed.notify_all()
        except (OSError, StreamBroken) as error:
            failure: DriverError = StreamBroken(
                f"the RTDE connection to {self._host} was lost ({error})",
                "check the robot and the cable, then open the arm again",
            )
        except ProtocolError as error:
            failure = error
        with self._changed:
            self._failure = failure
            self._changed.notify_all()
