"""What every streaming sensor has in common: one reader thread, and no way for it to fail in silence."""

import copy
import logging
import sys
import threading
import time
from abc import abstractmethod
from collections import deque

import numpy as np

from drivers.errors import ConnectError, DeviceFault, DeviceTimeout, DriverError, StreamBroken
from drivers.interfaces import DeviceInfo, ForceTorqueSensor, FtSamples, Health

if sys.platform == "win32":
    LINK_ERRORS: tuple[type[Exception], ...] = (OSError,)
else:
    import termios

    LINK_ERRORS = (OSError, termios.error)
    """What a vanished serial port raises; `termios.error` is not an `OSError`."""

log = logging.getLogger(__name__)

NOTHING = FtSamples(
    t_host_ns=np.zeros(0, np.int64),
    t_device_s=np.zeros(0),
    seq=np.zeros(0, np.int64),
    counts=np.zeros((0, 0), np.int32),
    wrench=np.zeros((0, 6)),
    status=np.zeros(0, np.uint32),
)
"""What `_read_block` returns when nothing came in time."""

_JOIN_S = 0.6
_FIRST_SAMPLE_S = 1.0


class StreamingSensor(ForceTorqueSensor):
    """A sensor whose samples are fetched by a thread of its own.

    A subclass says how to connect, how to read the next samples and how to let go; this class does the waiting. The
    first exception in the reader thread ends the stream: every later call raises a copy of it, until `close`.

    Parameters
    ----------
    name : str
        The device as the user knows it; begins every error message.
    sign : int
        -1 for a sensor that reports the reaction. Applied here, once, to the wrench; counts stay raw.
    stale_after_s : float
        The longest silence that still counts as a stream.
    max_collect_samples : int
        What one `collect` may hold; more is an error, never a dropped sample.
    """

    def __init__(
        self, name: str, *, sign: int = 1, stale_after_s: float = 0.3, max_collect_samples: int = 1_000_000
    ) -> None:
        if sign not in {1, -1}:
            raise ValueError(f"sign is {sign}; it is 1, or -1 for a sensor that reports the reaction")
        self.name = name
        self._sign = sign
        self._stale_after_s = stale_after_s
        self._max_collect_samples = max_collect_samples
        self._thread: threading.Thread | None = None
        self._news = threading.Condition()
        self._info: DeviceInfo | None = None
        self._failure: Exception | None = None
        self._taps: list[deque[FtSamples]] = []
        self._arrivals: deque[tuple[int, int]] = deque()
        self._reset()

    @abstractmethod
    def _connect(self) -> DeviceInfo:
        """Open the port, do the whole start-up sequence, leave the stream running."""

    @abstractmethod
    def _read_block(self) -> FtSamples:
        """Return the next samples, or `NOTHING` after at most about 0.1 s. Raising ends the stream."""

    @abstractmethod
    def _disconnect(self) -> None:
        """Stop the stream and free the port within 0.3 s; also after a failed `_connect` or on a lost device."""

    def open(self) -> None:
        """Connect, start the stream and wait for its first sample. Idempotent.

        Raises
        ------
        ConnectError
            No connection, not the right device, or no sample.
        DeviceFault
            Connected, but the device reports a fault.
        """
        if self._thread is not None:
            return
        self._reset()
        try:
            self._info = self._connect()
        except BaseException as exc:
            self._let_go()
            if isinstance(exc, DriverError) and not isinstance(exc, ConnectError | DeviceFault):
                raise ConnectError(str(exc)) from exc
            raise
        self._opened_ns = time.monotonic_ns()
        self._thread = threading.Thread(target=self._run, name=f"reader of {self.name}", daemon=True)
        self._thread.start()
        try:
            self._await_first_sample()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Stop the stream, free the port and the thread within a second. Idempotent; never raises on a lost device."""
        thread, self._thread = self._thread, None
        if thread is None:
            return
        thread.join(_JOIN_S)
        if thread.is_alive():
            log.warning("%s: the reader thread is stuck in a read; freeing the port under it", self.name)
        self._let_go()
        with self._news:
            self._news.notify_all()

    def identify(self) -> DeviceInfo:
        """Tell who the device is, as read by the last successful `open`."""
        if self._info is None:
            raise ConnectError(f"{self.name}: not identified yet; open it first")
        return self._info

    def collect(self, duration_s: float) -> FtSamples:
        """Every sample received in the `duration_s` seconds that begin with this call. See `ForceTorqueSensor`.

        It returns with the first sample after the end, so that the last one inside is never missed.
        """
        if not duration_s > 0:
            raise ValueError(f"a duration of {duration_s} s collects nothing; give a positive one")
        blocks: deque[FtSamples] = deque()
        with self._news:
            self._check()
            start_ns = time.monotonic_ns()
            end_ns = start_ns + round(duration_s * 1e9)
            before = self._received
            self._taps.append(blocks)
            try:
                while self._newest_ns < end_ns:
                    self._news.wait(max(0.0, self._stale_after_s - self._age_s()) + 1e-3)
                    self._check()
                    if self._received - before > self._max_collect_samples:
                        raise StreamBroken(
                            f"{self.name}: more than {self._max_collect_samples} samples in one collect of "
                            f"{duration_s} s; collect in shorter pieces"
                        )
            finally:
                # by identity: blocks hold arrays, which do not compare
                self._taps = [tap for tap in self._taps if tap is not blocks]
            empty = _rows(self._newest, slice(0, 0))
        samples = FtSamples.concatenate([empty, *blocks])
        inside = (samples.t_host_ns >= start_ns) & (samples.t_host_ns < end_ns)
        samples = _rows(samples, inside)
        silence_s = float(np.diff(samples.t_host_ns, prepend=start_ns, append=end_ns).max()) / 1e9
        if silence_s > self._stale_after_s:
            raise self._stale(silence_s)
        return samples

    def latest(self, *, timeout_s: float) -> FtSamples:
        """The newest sample (one row), waiting up to `timeout_s` for one that is fresh. Never an old value."""
        deadline = time.monotonic() + timeout_s
        with self._news:
            self._raise_failure()
            while self._age_s() > self._stale_after_s:
                left_s = deadline - time.monotonic()
                if left_s <= 0:
                    raise self._stale(self._age_s())
                self._news.wait(left_s)
                self._raise_failure()
            return self._newest

    def check(self) -> None:
        """Raise the stream's failure, if it has one: broken, silent for too long, or a critical device status."""
        with self._news:
            self._check()

    def health(self) -> Health:
        """Counters since `open`."""
        with self._news:
            now_ns = time.monotonic_ns()
            since_ns = max(now_ns - 1_000_000_000, self._opened_ns)
            recent = sum(n for t_ns, n in self._arrivals if t_ns >= since_ns)
            return Health(
                received=self._received,
                lost=self._lost,
                malformed=self._malformed,
                rate_Hz=recent / max((now_ns - since_ns) / 1e9, 1e-3),
                age_s=self._age_s(),
            )

    def _reset(self) -> None:
        self._failure = None
        self._newest = NOTHING
        self._opened_ns = self._newest_ns = time.monotonic_ns()
        self._taps = []
        self._arrivals.clear()
        self._received = self._lost = self._malformed = 0

    def _run(self) -> None:
        try:
            while self._thread is threading.current_thread():
                block = self._read_block()
                if len(block):
                    self._publish(block)
        except Exception as exc:
            with self._news:
                if self._thread is threading.current_thread():
                    self._failure = exc
                    self._news.notify_all()

    def _publish(self, block: FtSamples) -> None:
        block = FtSamples(
            block.t_host_ns, block.t_device_s, block.seq, block.counts, self._sign * block.wrench, block.status
        )
        t_ns = int(block.t_host_ns[-1])
        with self._news:
            if self._thread is not threading.current_thread():
                return
            self._received += len(block)
            self._arrivals.append((t_ns, len(block)))
            while self._arrivals[0][0] < t_ns - 1_000_000_000:
                self._arrivals.popleft()
            self._newest, self._newest_ns = _rows(block, slice(-1, None)), t_ns
            for tap in self._taps:
                tap.append(block)
            self._news.notify_all()

    def _let_go(self) -> None:
        try:
            self._disconnect()
        except Exception as exc:
            log.info("%s: could not say goodbye to the device: %s", self.name, exc)

    def _await_first_sample(self) -> None:
        with self._news:
            arrived = self._news.wait_for(lambda: self._received or self._failure, _FIRST_SAMPLE_S)
            if isinstance(self._failure, DeviceFault):
                self._raise_failure()
            if not self._received or not arrived:
                reason = self._failure or f"connected, but no sample came within {_FIRST_SAMPLE_S} s; try again"
                raise ConnectError(f"{self.name}: {reason}") from self._failure

    def _age_s(self) -> float:
        return (time.monotonic_ns() - self._newest_ns) / 1e9

    def _stale(self, age_s: float) -> DeviceTimeout:
        return DeviceTimeout(
            f"{self.name}: silent for {age_s:.3f} s (allowed: {self._stale_after_s:g} s); check cable and supply"
        )

    def _raise_failure(self) -> None:
        if self._failure is not None:
            raise copy.copy(self._failure) from self._failure
        if self._thread is None:
            raise StreamBroken(f"{self.name}: not open; call open() first")

    def _check(self) -> None:
        self._raise_failure()
        age_s = self._age_s()
        if age_s > self._stale_after_s:
            raise self._stale(age_s)


def _rows(samples: FtSamples, which: slice | np.ndarray[tuple[int], np.dtype[np.bool_]]) -> FtSamples:
    return FtSamples(
        samples.t_host_ns[which],
        samples.t_device_s[which],
        samples.seq[which],
        samples.counts[which],
        samples.wrench[which],
        samples.status[which],
    )
