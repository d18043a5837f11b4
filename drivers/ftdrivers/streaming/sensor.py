"""The base class of streaming sensors: one reader thread, all failures of which reach the caller."""

import copy
import logging
import math
import threading
from abc import abstractmethod
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import numpy as np

from ftdrivers.clock import REAL, Clock, Follower
from ftdrivers.errors import ConnectError, DeviceError, DeviceFault, DeviceTimeout, StreamBroken
from ftdrivers.follow import Follow, Unread
from ftdrivers.interfaces import NOT_REPORTED, DeviceInfo, Fact, ForceTorqueSensor, FtSamples, Health
from ftdrivers.streaming.plausibility import DeviceClock, Liveness, Rate

log = logging.getLogger(__name__)

NOTHING = FtSamples.of([], [], np.zeros((0, 6)))
"""Result of `_read_block` if no sample arrived in time."""


def scale_facts(
    counts_per_N: float, counts_per_Nm: float, source: Literal["device", "documented", "configured", "assumed"]
) -> dict[str, Fact]:
    """Return the scale of the raw counts as entries of `DeviceInfo.facts`."""
    return {"counts_per_N": Fact(counts_per_N, source), "counts_per_Nm": Fact(counts_per_Nm, source)}


# A busy computer may delay a sample by 0.1 s: a stale stream fails the call, but does not end the stream.
@dataclass(frozen=True, slots=True)
class StreamLimits:
    """Time-outs of a stream, in seconds of its clock. The defaults are those of a real sensor."""

    stale_s: float = 0.3
    """Longest time without a sample after which the stream counts as stale."""
    first_sample_s: float = 1.0
    """Time-out from the last reply of the device to the first sample."""
    away_s: float = 0.3
    """Longest pause between two reads, at least `stale_s`. After a longer one, the buffered samples are too old."""
    settle_s: float = 0.05
    """Time for which an adapter may deliver buffered samples after a pause."""
    waited_s: float = 0.001
    """A read that takes longer than this has waited for a new sample, which means that the buffer was empty."""
    discard_s: float = 0.5
    """Time-out for emptying the buffer after a pause."""
    recover_s: float = 10.0
    """Time-out from an interruption to the first sample after it."""
    retry_s: float = 0.2
    """Interval between two attempts to reconnect."""
    join_s: float = 0.6
    """Real time for which `close` waits for the reader thread before it closes the port."""


_EVENTS = 1000


class StreamingSensor(ForceTorqueSensor):
    """Base class of a sensor whose samples are read in a thread.

    A subclass connects, reads the next samples and disconnects. This class waits, checks and publishes. The first
    exception in the reader thread ends the stream: each later call raises a copy of it, until `open` or `close`.
    Samples that were buffered while this program or computer was suspended are dropped, because they are old although
    they are received now.

    Parameters
    ----------
    name : str
        Name of the device, with which every error message begins.
    sign : int
        -1 for a sensor that reports the reaction. The wrench is multiplied by it; counts stay raw.
    clock : Clock
        Clock of the time stamps and time-outs.
    limits : StreamLimits
        Time-outs.
    max_unread_samples : int
        Largest number of samples in one `collect` or in the queue of a follower. More samples raise an error.
    recover : bool
        Reconnect after an interruption or silence, for up to `recover_s`, instead of ending the stream. Calls during
        the interruption still fail, as does a `collect` that contains one. It may be set before `open`.

    Examples
    --------
    >>> import ftdrivers, time, numpy as np
    >>> class Acme(ftdrivers.StreamingSensor):
    ...     def _connect(self):
    ...         self._seq = 0
    ...         return ftdrivers.DeviceInfo("Acme", "A1", "1.0")
    ...
    ...     def _read_block(self):
    ...         time.sleep(0.002)
    ...         self._seq += 1
    ...         return ftdrivers.FtSamples.of(time.monotonic_ns(), self._seq, np.random.normal(0, 0.1, (1, 6)))
    ...
    ...     def _disconnect(self): ...
    >>> with Acme("Acme on /dev/acme0") as sensor:
    ...     sensor.latest(timeout_s=10.0).wrench.shape
    (1, 6)
    """

    def __init__(
        self,
        name: str,
        *,
        sign: int = 1,
        clock: Clock = REAL,
        limits: StreamLimits = StreamLimits(),
        max_unread_samples: int = 1_000_000,
        recover: bool = False,
    ) -> None:
        if sign not in {1, -1}:
            raise ValueError(f"sign is {sign}; give 1, or -1 for a sensor that reports the reaction")
        self.name = name
        self._sign = sign
        self._clock = clock
        self._limits = limits
        self._max_unread_samples = max_unread_samples
        self.recover = recover
        self.configured: dict[str, Fact] = {}
        """Facts `serial` and `range` from the user; they may be set before `open`. A device that reports another serial
        number is rejected. The range replaces the one that the device reports."""
        # Nominal sample rate; a subclass that knows the rate of its device sets it in `_connect`.
        self._nominal_Hz = math.nan
        self._thread: threading.Thread | None = None
        self._news = threading.Condition()
        self._info: DeviceInfo | None = None
        self._failure: Exception | None = None
        # Set while the driver reconnects: the first error, and the time at which it gives up.
        self._interruption: tuple[DeviceError, float] | None = None
        self._taps: list[Unread[FtSamples]] = []
        self._arrivals: deque[tuple[int, int]] = deque()
        self._reset()

    @abstractmethod
    def _connect(self) -> DeviceInfo:
        """Open the port and run the start-up sequence. The stream runs afterwards."""

    @abstractmethod
    def _read_block(self) -> FtSamples:
        """Return the next samples, or `NOTHING` after at most about 0.1 s. An exception ends the stream."""

    @abstractmethod
    def _disconnect(self) -> None:
        """Stop the stream and close the port within 0.3 s, also after a failed `_connect` or if the device was lost."""

    def _discard_backlog(self) -> None:
        """Drop the samples that the port or the socket buffered while the reader paused."""
        # A read that has to wait shows that the buffer is empty.
        begin_s = self._turn_s
        while self._is_mine():
            rows = len(self._read_block())
            self._earlier_lost += rows
            turn_s = self._turn()
            if self._was_away(turn_s):
                begin_s = self._turn_s
            else:
                has_waited = rows and turn_s > self._limits.waited_s
                if self._turn_s - begin_s > (self._limits.settle_s if has_waited else self._limits.discard_s):
                    return

    def open(self) -> None:
        """Connect, start the stream and wait for its first sample.

        Does nothing while the stream is open or the driver reconnects (`recover`). Reopens a stream that has ended.

        Raises
        ------
        ConnectError
            The connection failed, another device answered, or no sample arrived.
        DeviceFault
            The device reports a fault.
        """
        if self._thread is not None and not self._has_ended:
            return
        self.close()
        self._reset()
        with self._clock.keeping_up():
            try:
                self._info = self._connect_and_identify()
            except BaseException as exc:
                self._let_go()
                if isinstance(exc, DeviceError) and not isinstance(exc, ConnectError | DeviceFault):
                    raise self._not_opened(exc) from exc
                raise
            self._opened_ns = self._clock.now_ns()
            try:
                self._start_reader()
                self._await_first_sample()
            except BaseException:
                self.close()
                raise

    def close(self) -> None:
        """Stop the stream and the reader thread within a second. Idempotent. Never raises if the device was lost."""
        with self._news:
            thread, self._thread = self._thread, None
            self._news.notify_all()
        if thread is None:
            return
        thread.join(self._clock.patience_s(self._limits.join_s))
        if thread.is_alive():
            log.warning("%s: the reader thread is blocked in a read; closing its port", self.name)
        self._let_go()

    def identify(self) -> DeviceInfo:
        """Return model, serial number, firmware and facts, as read by the last successful `open`."""
        if self._info is None:
            raise ConnectError(f"{self.name}: the device has not been identified", "open it first")
        return self._info

    def collect(self, duration_s: float) -> FtSamples:
        """Return every sample received within `duration_s` seconds from this call, see `ForceTorqueSensor`.

        The call returns when the first sample after the end arrives, so no sample before the end is missed.
        """
        if not duration_s > 0:
            raise ValueError(f"a duration of {duration_s} s collects nothing; give a positive one")
        with self._news, self._tap() as unread:
            start_ns = self._clock.now_ns()
            end_ns = start_ns + round(duration_s * 1e9)
            reconnects, pauses = self._reconnects, self._pauses
            while self._newest_ns < end_ns:
                self._clock.wait(self._news, self._until_stale_s())
                self._check()
                if self._reconnects != reconnects:
                    raise StreamBroken(f"{self.name}: the stream was interrupted and came back", "collect again")
                if self._pauses != pauses:
                    raise DeviceTimeout(f"{self.name}: {self._pause}", "collect again")
                unread.check()
            samples = self._joined(unread.take())
        samples = samples.rows((samples.t_host_ns >= start_ns) & (samples.t_host_ns < end_ns))
        silence_s = float(np.diff(samples.t_host_ns, prepend=start_ns, append=end_ns).max()) / 1e9
        if silence_s > self._limits.stale_s:
            raise self._stale(silence_s)
        return samples

    @contextmanager
    def follow(self) -> Iterator[Follow[FtSamples]]:
        """Read every sample from now on, see `ForceTorqueSensor`. Raises the exceptions of `check` immediately."""
        with self._tap() as unread:
            yield Follow(partial(self._read_on, unread))

    def latest(self, *, timeout_s: float) -> FtSamples:
        """Return the newest sample (one row). If it is stale, wait up to `timeout_s` for another one."""
        with self._news:
            self._raise_failure()
            for left_s in self._clock.looks(timeout_s):
                if self._age_s() <= self._limits.stale_s:
                    return self._newest
                self._clock.wait(self._news, left_s)
                self._raise_failure()
            raise self._stale(self._age_s())

    def check(self) -> None:
        """Raise the failure of the stream if it is broken or stale, or if the status of the device is critical."""
        with self._news:
            self._check()

    def health(self) -> Health:
        """Return the statistics of the stream since `open`."""
        with self._news:
            now_ns = self._clock.now_ns()
            since_ns = max(now_ns - 1_000_000_000, self._opened_ns)
            recent = sum(n for t_ns, n in self._arrivals if t_ns >= since_ns)
            return Health(
                received=self._received,
                lost=self._earlier_lost + self._lost,
                malformed=self._earlier_malformed + self._malformed,
                rate_Hz=recent / max((now_ns - since_ns) / 1e9, 1e-3),
                age_s=self._age_s(),
                duplicated=self._duplicated,
                out_of_order=self._out_of_order,
                stale=self._silences,
                reconnects=self._reconnects,
                nominal_rate_Hz=self._nominal_Hz,
                events=tuple(self._events),
            )

    @contextmanager
    def _tap(self) -> Iterator[Unread[FtSamples]]:
        """Yield a queue (`Unread`) that receives every sample from now on."""
        unread: Unread[FtSamples] = Unread(self.name, self._max_unread_samples)
        with self._news:
            self._check()
            self._taps.append(unread)
        try:
            yield unread
        finally:
            with self._news:
                self._taps = [tap for tap in self._taps if tap is not unread]

    def _read_on(self, unread: Unread[FtSamples], timeout_s: float) -> FtSamples:
        # Samples that arrived before a failure are returned before the failure is raised.
        with self._news:
            for left_s in self._clock.looks(timeout_s):
                if blocks := unread.take():
                    return self._joined(blocks)
                self._check()
                if unread not in self._taps:
                    raise StreamBroken(f"{self.name}: the sensor was reopened", "follow it again")
                self._clock.wait(self._news, min(left_s, self._until_stale_s()))
            return self._joined(unread.take())

    def _joined(self, blocks: list[FtSamples]) -> FtSamples:
        return FtSamples.concatenate(blocks or [self._newest.rows(slice(0, 0))])

    def _connect_and_identify(self) -> DeviceInfo:
        """Connect and return the facts that the device reports, merged with the configured facts."""
        info = self._connect()
        self._turn()
        reported = {} if info.serial == NOT_REPORTED else {"serial": Fact(info.serial, "device")}
        facts = info.facts | reported | self.configured | {"sign": Fact(self._sign, "configured")}
        if reported and facts["serial"].value != info.serial:
            raise ConnectError(
                f"{self.name}: the device has serial number {info.serial}, but {facts['serial'].value} is configured",
                "check the address and its option serial",
            )
        serial = str(facts["serial"].value) if "serial" in facts else info.serial
        return replace(info, serial=serial, facts=facts)

    def _reset(self) -> None:
        self._failure = None
        self._has_ended = False
        self._newest = NOTHING
        self._interruption = None
        self._opened_ns = self._newest_ns = self._clock.now_ns()
        # Clock time of the newest sample, and of the last completed read.
        self._heard_s = self._turn_s = self._clock.awake_s()
        self._pauses, self._pause, self._fresh_from_ns = 0, "", 0
        # Whether a sample has arrived since the last pause of the reader.
        self._is_back = True
        self._taps = []
        self._arrivals.clear()
        self._received = self._duplicated = self._out_of_order = self._silences = self._reconnects = 0
        self._earlier_lost = self._earlier_malformed = 0
        # Counters of lost samples and damaged frames since the last `_connect`; a subclass increments or assigns them.
        self._lost = self._malformed = 0
        self._events: deque[tuple[int, str]] = deque(maxlen=_EVENTS)
        self._rate = Rate(self.name, self._rate_fix)
        self._seq_offset = 0
        self._start_watching()

    def _start_watching(self) -> None:
        self._liveness = Liveness(self.name)
        self._device_clock = DeviceClock(self.name)
        self._rate.forget()
        self._is_late = False

    def _start_reader(self) -> None:
        # `open` continues after the thread has started to keep up, so no time-out expires earlier.
        self._thread = Follower(self._clock, self._run, f"reader of {self.name}")
        self._thread.start()

    def _run(self) -> None:
        while self._is_mine() and not self._has_ended:
            self._take_turn()

    def _take_turn(self) -> None:
        """Read one block of samples and publish it, or try to reconnect; store an error that ends the stream."""
        try:
            try:
                self._pump()
            except (StreamBroken, DeviceTimeout) as exc:
                if not self.recover:
                    raise
                self._reconnect(exc)
        except Exception as exc:
            self._fail(exc, for_good=True)

    def _fail(self, failure: Exception, *, for_good: bool = False) -> None:
        with self._news:
            if not self._is_mine():
                return
            self._failure, self._has_ended = failure, for_good
            if for_good:
                self._note(f"ended: {failure}")
            self._news.notify_all()

    def _pump(self) -> None:
        block = self._read_block()
        turn_s = self._turn()  # after the read, because a read stamps its samples
        if self._was_away(turn_s):
            self._drop_backlog(turn_s, len(block))
        elif len(block):
            self._publish(block)
        elif self.recover:
            since_pause_s = (self._clock.now_ns() - self._fresh_from_ns) / 1e9
            if min(self._age_s(), since_pause_s) > self._limits.stale_s:
                raise self._stale(self._age_s())

    def _turn(self) -> float:
        """Return the time since the last call of this function, s, including a suspension of the computer."""
        before_s, self._turn_s = self._turn_s, self._clock.awake_s()
        return self._turn_s - before_s

    def _was_away(self, turn_s: float) -> bool:
        # After Ctrl-Z, a suspended computer or a debugger, old samples are buffered and would look new. The clock that
        # runs during the suspension shows the pause.
        return turn_s > max(self._limits.away_s, self._limits.stale_s)

    def _drop_backlog(self, away_s: float, rows: int) -> None:
        """After a pause of the reader, drop the `rows` samples of the last read and all buffered samples."""
        with self._news:
            self._pauses += 1
            self._is_back = False
            self._pause = f"the reader paused for {away_s:.2f} s: this program or computer was suspended or too busy"
            self._note(f"{self._pause}; buffered samples are dropped")
            self._news.notify_all()
        self._earlier_lost += rows
        self._discard_backlog()
        with self._news:
            self._fresh_from_ns = self._clock.now_ns()
            self._liveness.forget()
            self._rate.forget()

    def _reconnect(self, error: DeviceError) -> None:
        """Try to reconnect to the same device. The first sample ends the interruption."""
        if self._interruption is None:  # an earlier interruption has not ended: continue it
            self._interruption = error, self._clock.now_s() + self._limits.recover_s
            self._note(str(error))
        first, deadline_s = self._interruption
        self._fail(StreamBroken(f"{self.name}: the stream was interrupted, reconnecting ({error})"))
        self._earlier_lost += self._lost
        self._earlier_malformed += self._malformed
        self._lost = self._malformed = 0
        while self._is_mine():
            if self._clock.now_s() > deadline_s:
                found = f"{first.found}, not reconnected within {self._limits.recover_s:g} s ({error})"
                raise StreamBroken(found, first.fix) from error
            self._let_go()
            try:
                info = self._connect_and_identify()
                break
            except DeviceFault:
                raise
            except DeviceError as exc:
                error = exc
                self._clock.sleep(self._limits.retry_s)
        if not self._is_mine():
            self._let_go()
            return
        if info != self._info:
            raise ConnectError(
                f"{self.name}: another device answers, {info} instead of {self._info}",
                "connect the first one, or open the sensor again to use the other",
            )
        with self._news:
            self._start_watching()
            self._newest_ns, self._heard_s = self._clock.now_ns(), self._clock.awake_s()  # silence counts from now

    def _is_mine(self) -> bool:
        return self._thread is threading.current_thread()

    def _note(self, what: str) -> None:
        self._events.append((self._clock.now_ns(), what))
        log.info("%s: %s", self.name, what)

    def _publish(self, block: FtSamples) -> None:
        with self._news:
            if not self._is_mine():
                return
            block = self._newer_rows(block)
            if not len(block):
                return
            # a pause between the readings of the two clocks makes the sample older, never newer
            heard_s = self._turn_s - (self._clock.now_ns() - int(block.t_host_ns[-1])) / 1e9
            block = self._fresh_rows(block, heard_s)
            if not len(block):
                return
            t_ns = int(block.t_host_ns[-1])
            self._liveness.judge(block, self._nominal_Hz)
            if note := self._rate.judge(len(block), t_ns, self._nominal_Hz):
                self._note(note)
            if self._received and heard_s - self._heard_s > self._limits.stale_s:
                self._silences += 1
            self._heard_s, self._is_back = heard_s, True
            self._received += len(block)
            self._arrivals.append((t_ns, len(block)))
            while self._arrivals[0][0] < t_ns - 1_000_000_000:
                self._arrivals.popleft()
            self._newest, self._newest_ns = block if len(block) == 1 else block.rows(slice(-1, None)), t_ns
            if self._failure is not None:
                # an interruption ends with the first sample, not with a reply of the device
                self._failure = self._interruption = None
                self._reconnects += 1
                self._note("reconnected")
            for tap in self._taps:
                tap.put(block, len(block))
            self._news.notify_all()

    def _newer_rows(self, block: FtSamples) -> FtSamples:
        """Apply the sign, continue `seq` after a reconnection, and drop duplicates and samples out of order."""
        seq = block.seq + self._seq_offset
        newest = int(self._newest.seq[-1]) if len(self._newest) else int(seq[0]) - 1
        if self._failure is not None and seq[0] <= newest:
            gap_s = (int(block.t_host_ns[0]) - int(self._newest.t_host_ns[-1])) / 1e9
            missed = 1 if math.isnan(self._nominal_Hz) else max(1, round(gap_s * self._nominal_Hz))
            self._seq_offset += newest + missed + 1 - int(seq[0])
            self._earlier_lost += missed
            seq = block.seq + self._seq_offset
        block = replace(block, seq=seq, wrench=self._sign * block.wrench)
        top = np.maximum.accumulate(np.concatenate([[newest], seq[:-1]]))
        newer = seq > top
        if newer.all():
            return block
        self._duplicated += int((seq == top).sum())
        self._out_of_order += int((seq < top).sum())
        return block.rows(newer)

    def _fresh_rows(self, block: FtSamples, heard_s: float) -> FtSamples:
        """Drop samples that are too late by the device's clock, because they were buffered in transit."""
        late_s = self._device_clock.late_s(block.t_device_s, heard_s)
        is_late = bool(late_s[-1] > self._limits.stale_s)
        if is_late and not self._is_late:
            self._note(f"samples are {late_s[-1]:.2f} s late and are dropped")
        self._is_late = is_late
        fresh = (block.t_host_ns >= self._fresh_from_ns) & (late_s <= self._limits.stale_s)
        if fresh.all():
            return block
        self._earlier_lost += int((~fresh).sum())
        return block.rows(fresh)

    def _not_opened(self, error: DeviceError) -> ConnectError:
        """Return an error of `open` as a `ConnectError` that begins with the name of the device."""
        found = error.found if error.found.startswith(self.name) else f"{self.name}: {error.found}"
        return ConnectError(found, error.fix)

    def _let_go(self) -> None:
        try:
            self._disconnect()
        except Exception as exc:
            log.info("%s: the device was not disconnected cleanly: %s", self.name, exc)

    def _await_first_sample(self) -> None:
        with self._news:
            for left_s in self._clock.looks(self._limits.first_sample_s):
                if self._received or self._failure:
                    break
                self._clock.wait(self._news, left_s)
            failure = self._failure
            if self._received and not isinstance(failure, DeviceFault):
                return
            if isinstance(failure, DeviceError) and not isinstance(failure, DeviceFault):
                raise self._not_opened(failure) from failure
            self._raise_failure()
            raise ConnectError(
                f"{self.name}: connected, but no sample arrived within {self._limits.first_sample_s} s", "open it again"
            )

    def _age_s(self) -> float:
        return self._clock.awake_s() - self._heard_s

    def _until_stale_s(self) -> float:
        return max(0.0, self._limits.stale_s - self._age_s()) + 1e-3

    def _stale(self, age_s: float) -> DeviceTimeout:
        found = f"{self.name}: no new sample for {age_s:.3f} s (allowed: {self._limits.stale_s:g} s)"
        if self._was_away(self._clock.awake_s() - self._turn_s) or not self._is_back:
            return DeviceTimeout(
                f"{found}, because this program or computer was suspended or too busy", "reduce its load and try again"
            )
        return DeviceTimeout(found, self._silence_fix())

    def _silence_fix(self) -> str:
        """Return a text: what the user should do if no sample arrives; a subclass may be more specific."""
        return "check cable and supply"

    def _rate_fix(self, rate_Hz: float) -> str:
        """Return a text: what the user should do if the rate is not nominal; a subclass may be more specific."""
        cause = "lost" if rate_Hz < self._nominal_Hz else "duplicated"
        return f"check health() for {cause} samples, and check the rate that is set in the sensor"

    def _raise_failure(self) -> None:
        # Each call raises a copy, because a raised exception accumulates its traceback.
        if self._failure is not None:
            raise copy.copy(self._failure) from self._failure
        if self._thread is None:
            raise StreamBroken(f"{self.name}: not open", "call open() first")

    def _check(self) -> None:
        self._raise_failure()
        age_s = self._age_s()
        if age_s > self._limits.stale_s:
            raise self._stale(age_s)
