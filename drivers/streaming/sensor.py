"""What every streaming sensor has in common: one reader thread, and no way for it to fail in silence."""

import copy
import logging
import math
import threading
from abc import abstractmethod
from collections import deque
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from drivers.clock import REAL, Clock, Follower
from drivers.errors import ConnectError, DeviceFault, DeviceTimeout, DriverError, StreamBroken
from drivers.interfaces import NOT_REPORTED, DeviceInfo, Fact, ForceTorqueSensor, FtSamples, Health
from drivers.streaming.plausibility import DeviceClock, Liveness, Rate

log = logging.getLogger(__name__)

NOTHING = FtSamples.of([], [], np.zeros((0, 6)))
"""What `_read_block` returns when nothing came in time."""


def scale_facts(
    counts_per_N: float, counts_per_Nm: float, source: Literal["device", "documented", "configured", "assumed"]
) -> dict[str, Fact]:
    """Say what the device's own numbers mean, for `DeviceInfo.facts`."""
    return {"counts_per_N": Fact(counts_per_N, source), "counts_per_Nm": Fact(counts_per_Nm, source)}


@dataclass(frozen=True, slots=True)
class StreamLimits:
    """Every limit of time of a stream, in seconds of its clock; the defaults are those of a real sensor."""

    stale_s: float = 0.3
    """The longest silence that still counts as a stream."""
    first_sample_s: float = 1.0
    """From the answer of a device to its first sample."""
    away_s: float = 0.3
    """A shorter pause between two reads is not told from a busy computer; at least `stale_s`."""
    settle_s: float = 0.05
    """After a pause: how long an adapter may still deliver what it has held back."""
    waited_s: float = 0.001
    """A read that lasts longer had to wait for something new."""
    discard_s: float = 0.5
    """After a pause: how long to try for a read that had to wait."""
    recover_s: float = 10.0
    """From an interruption to the first sample of the stream that follows."""
    retry_s: float = 0.2
    """Between two attempts to connect again."""
    join_s: float = 0.6
    """In real time: how long `close` waits for the reader before it frees the port under it."""


_PATIENCE_S = 30.0
"""`join_s` where the cell is emulated: the reader may be starved."""
_EVENTS = 1000


class StreamingSensor(ForceTorqueSensor):
    """A sensor whose samples are fetched by a thread of its own.

    A subclass says how to connect, how to read the next samples and how to let go; this class does the waiting. The
    first exception in the reader thread ends the stream: every later call raises a copy of it, until `open` or `close`.
    What has piled up while this program or computer was suspended is thrown away: it would be old and look new.

    Parameters
    ----------
    name : str
        The device as the user knows it; begins every error message.
    sign : int
        -1 for a sensor that reports the reaction. Applied here, once, to the wrench; counts stay raw.
    clock : Clock
        What every limit is measured by; samples are stamped with it.
    limits : StreamLimits
        How long anything may take.
    max_collect_samples : int
        What one `collect` may hold; more is an error, never a dropped sample.
    recover : bool
        After an interruption or silence connect again, until a sample comes or `recover_s` are over, instead of ending
        the stream. Every call made meanwhile is an error all the same, and so is a `collect` with an interruption
        inside. May be set until `open`.
    """

    def __init__(
        self,
        name: str,
        *,
        sign: int = 1,
        clock: Clock = REAL,
        limits: StreamLimits = StreamLimits(),
        max_collect_samples: int = 1_000_000,
        recover: bool = False,
    ) -> None:
        if sign not in {1, -1}:
            raise ValueError(f"sign is {sign}; it is 1, or -1 for a sensor that reports the reaction")
        self.name = name
        self._sign = sign
        self._clock = clock
        self._limits = limits
        self._max_collect_samples = max_collect_samples
        self.recover = recover
        self.configured: dict[str, Fact] = {}
        """`serial` and `range`, for a device that does not tell them; until `open`. A device that tells another serial
        number is refused; a range given here comes before the device's own."""
        self._nominal_Hz = math.nan
        """A subclass that knows its rate sets it in `_connect`."""
        self._thread: threading.Thread | None = None
        self._news = threading.Condition()
        self._info: DeviceInfo | None = None
        self._failure: Exception | None = None
        self._interruption: tuple[DriverError, float] | None = None
        """While it connects again: what began it, and when to give up."""
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

    def _discard_backlog(self) -> None:
        """Throw away what has piled up in port or socket while nobody read: until a read waits for what it returns."""
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

        Does nothing where the stream is open, or the driver is connecting again by itself (`recover`); opens one that
        has ended anew.

        Raises
        ------
        ConnectError
            No connection, not the right device, or no sample.
        DeviceFault
            Connected, but the device reports a fault.
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
                if isinstance(exc, DriverError) and not isinstance(exc, ConnectError | DeviceFault):
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
        """Stop the stream, free the port and the thread within a second. Idempotent; never raises on a lost device."""
        with self._news:
            thread, self._thread = self._thread, None
            self._news.notify_all()
        if thread is None:
            return
        thread.join(_PATIENCE_S if self._clock.emulated else self._limits.join_s)
        if thread.is_alive():
            log.warning("%s: the reader thread is stuck in a read; freeing the port under it", self.name)
        self._let_go()

    def identify(self) -> DeviceInfo:
        """Tell who the device is, as read by the last successful `open`."""
        if self._info is None:
            raise ConnectError(f"{self.name}: not identified yet", "open it first")
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
            start_ns = self._clock.now_ns()
            end_ns = start_ns + round(duration_s * 1e9)
            before, reconnects, pauses = self._received, self._reconnects, self._pauses
            self._taps.append(blocks)
            try:
                while self._newest_ns < end_ns:
                    self._clock.wait(self._news, max(0.0, self._limits.stale_s - self._age_s()) + 1e-3)
                    self._check()
                    if self._reconnects != reconnects:
                        raise StreamBroken(f"{self.name}: the stream was interrupted and came back", "collect again")
                    if self._pauses != pauses:
                        raise DeviceTimeout(f"{self.name}: {self._pause}", "collect again")
                    if self._received - before > self._max_collect_samples:
                        raise StreamBroken(
                            f"{self.name}: more than {self._max_collect_samples} samples in one collect of "
                            f"{duration_s} s",
                            "collect in shorter pieces",
                        )
            finally:
                # by identity: blocks hold arrays, which do not compare
                self._taps = [tap for tap in self._taps if tap is not blocks]
            empty = self._newest.rows(slice(0, 0))
        samples = FtSamples.concatenate([empty, *blocks])
        samples = samples.rows((samples.t_host_ns >= start_ns) & (samples.t_host_ns < end_ns))
        silence_s = float(np.diff(samples.t_host_ns, prepend=start_ns, append=end_ns).max()) / 1e9
        if silence_s > self._limits.stale_s:
            raise self._stale(silence_s)
        return samples

    def latest(self, *, timeout_s: float) -> FtSamples:
        """The newest sample (one row), waiting up to `timeout_s` for one that is fresh. Never an old value."""
        with self._news:
            self._raise_failure()
            for left_s in self._clock.looks(timeout_s):
                if self._age_s() <= self._limits.stale_s:
                    return self._newest
                self._clock.wait(self._news, left_s)
                self._raise_failure()
            raise self._stale(self._age_s())

    def check(self) -> None:
        """Raise the stream's failure, if it has one: broken, silent for too long, or a critical device status."""
        with self._news:
            self._check()

    def health(self) -> Health:
        """Counters since `open`."""
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

    def _connect_and_identify(self) -> DeviceInfo:
        """Connect, and complete what the device tells by what was configured."""
        info = self._connect()
        self._turn()
        told = {} if info.serial == NOT_REPORTED else {"serial": Fact(info.serial, "device")}
        facts = info.facts | told | self.configured | {"sign": Fact(self._sign, "configured")}
        if told and facts["serial"].value != info.serial:
            raise ConnectError(
                f"{self.name}: serial number {info.serial} answers, {facts['serial'].value} is configured",
                "check the address, or its option serial",
            )
        serial = str(facts["serial"].value) if "serial" in facts else info.serial
        return replace(info, serial=serial, facts=facts)

    def _reset(self) -> None:
        self._failure = None
        self._has_ended = False
        self._newest = NOTHING
        self._interruption = None
        self._opened_ns = self._newest_ns = self._clock.now_ns()
        self._heard_s = self._turn_s = self._clock.awake_s()
        """When the newest sample came, and when a read last returned."""
        self._pauses, self._pause, self._fresh_from_ns = 0, "", 0
        self._is_back = True
        """Whether a sample has come since the last pause."""
        self._taps = []
        self._arrivals.clear()
        self._received = self._duplicated = self._out_of_order = self._silences = self._reconnects = 0
        self._earlier_lost = self._earlier_malformed = 0
        self._lost = self._malformed = 0
        """Since the last `_connect`; a subclass may count or assign them."""
        self._events: deque[tuple[int, str]] = deque(maxlen=_EVENTS)
        self._rate = Rate(self.name, self._why_rate)
        self._seq_offset = 0
        self._start_watching()

    def _start_watching(self) -> None:
        """Forget what the checks of a running stream compare with."""
        self._liveness = Liveness(self.name)
        self._device_clock = DeviceClock(self.name)
        self._rate.forget()
        self._is_late = False

    def _start_reader(self) -> None:
        self._thread = Follower(self._clock, self._run, f"reader of {self.name}")
        self._thread.start()

    def _run(self) -> None:
        """Read until `close`, or until something ends the stream for good."""
        while self._is_mine() and not self._has_ended:
            self._take_turn()

    def _take_turn(self) -> None:
        """Read once and publish, or connect again; keep the error that ends the stream for good."""
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
        """Read once and publish."""
        block = self._read_block()
        turn_s = self._turn()  # after the read: a stamp tells when a sample was read, not how long it had waited
        if self._was_away(turn_s):
            self._start_afresh(turn_s, len(block))
        elif len(block):
            self._publish(block)
        elif self.recover and min(self._age_s(), self._settled_s()) > self._limits.stale_s:
            raise self._stale(self._age_s())

    def _turn(self) -> float:
        """Return how long ago this was called last; the time this computer has slept counts."""
        before_s, self._turn_s = self._turn_s, self._clock.awake_s()
        return self._turn_s - before_s

    def _was_away(self, turn_s: float) -> bool:
        return turn_s > max(self._limits.away_s, self._limits.stale_s)

    def _start_afresh(self, away_s: float, rows: int) -> None:
        """Forget `rows` samples just read, and all that waits, after nobody has read for a while."""
        with self._news:
            self._pauses += 1
            self._is_back = False
            self._pause = f"nobody read for {away_s:.2f} s: this program or computer was suspended or too busy"
            self._note(f"{self._pause}; what had piled up is thrown away")
            self._news.notify_all()
        self._earlier_lost += rows
        self._discard_backlog()
        with self._news:
            self._fresh_from_ns = self._clock.now_ns()
            self._liveness.forget()
            self._rate.forget()

    def _reconnect(self, error: DriverError) -> None:
        """Connect again to the same device; the first sample that comes then ends the failure."""
        if self._interruption is None:  # else no sample has come since: it is not over yet
            self._interruption = error, self._clock.now_s() + self._limits.recover_s
            self._note(str(error))
        first, deadline_s = self._interruption
        self._fail(StreamBroken(f"{self.name}: interrupted, connecting again ({error})"))
        self._earlier_lost += self._lost
        self._earlier_malformed += self._malformed
        self._lost = self._malformed = 0
        while self._is_mine():
            if self._clock.now_s() > deadline_s:
                found = f"{first.found}, not back within {self._limits.recover_s:g} s ({error})"
                raise StreamBroken(found, first.fix) from error
            self._let_go()
            try:
                info = self._connect_and_identify()
                break
            except DeviceFault:
                raise
            except DriverError as exc:
                error = exc
                self._clock.sleep(self._limits.retry_s)
        if not self._is_mine():
            self._let_go()
            return
        if info != self._info:
            raise ConnectError(f"{self.name}: {info} answers where {self._info} was", "open it again if that is meant")
        with self._news:
            self._start_watching()
            self._newest_ns, self._heard_s = self._clock.now_ns(), self._clock.awake_s()  # silence is judged anew

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
            # the earlier look at the one clock, the later at the other: a pause between them makes it older, not newer
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
            self._newest, self._newest_ns = block.rows(slice(-1, None)), t_ns
            if self._failure is not None:
                # an interruption is over when the device measures, not when it answers
                self._failure = self._interruption = None
                self._reconnects += 1
                self._note("connected again")
            for tap in self._taps:
                tap.append(block)
            self._news.notify_all()

    def _newer_rows(self, block: FtSamples) -> FtSamples:
        """Turn the wrench by the sign, let `seq` go on after a reconnection, drop what came twice or too late."""
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
        """Drop what was measured too long ago: it has waited in this computer, in the device or on its way."""
        late_s = self._device_clock.late_s(block.t_device_s, heard_s)
        is_late = bool(late_s[-1] > self._limits.stale_s)
        if is_late and not self._is_late:
            self._note(f"samples come {late_s[-1]:.2f} s late and are thrown away")
        self._is_late = is_late
        fresh = (block.t_host_ns >= self._fresh_from_ns) & (late_s <= self._limits.stale_s)
        if fresh.all():
            return block
        self._earlier_lost += int((~fresh).sum())
        return block.rows(fresh)

    def _not_opened(self, error: DriverError) -> ConnectError:
        """Put the device's name before what a codec says, which knows none."""
        found = error.found if error.found.startswith(self.name) else f"{self.name}: {error.found}"
        return ConnectError(found, error.fix)

    def _let_go(self) -> None:
        try:
            self._disconnect()
        except Exception as exc:
            log.info("%s: could not say goodbye to the device: %s", self.name, exc)

    def _await_first_sample(self) -> None:
        with self._news:
            for left_s in self._clock.looks(self._limits.first_sample_s):
                if self._received or self._failure:
                    break
                self._clock.wait(self._news, left_s)
            failure = self._failure
            if self._received and not isinstance(failure, DeviceFault):
                return
            if isinstance(failure, DriverError) and not isinstance(failure, DeviceFault):
                raise self._not_opened(failure) from failure
            self._raise_failure()
            raise ConnectError(
                f"{self.name}: connected, but no sample came within {self._limits.first_sample_s} s", "try again"
            )

    def _age_s(self) -> float:
        return self._clock.awake_s() - self._heard_s

    def _settled_s(self) -> float:
        """How long ago the last pause was over."""
        return (self._clock.now_ns() - self._fresh_from_ns) / 1e9

    def _stale(self, age_s: float) -> DeviceTimeout:
        hint = self._why_silent()
        if self._was_away(self._clock.awake_s() - self._turn_s) or not self._is_back:
            hint = "nobody read, for this program or computer was suspended or too busy: try again"
        return DeviceTimeout(f"{self.name}: silent for {age_s:.3f} s (allowed: {self._limits.stale_s:g} s)", hint)

    def _why_silent(self) -> str:
        """Say what to do about a silence; a subclass may know more."""
        return "check cable and supply"

    def _why_rate(self, rate_Hz: float) -> str:
        """Say what to do about a rate that is not the nominal one; a subclass may know more."""
        how = "are lost" if rate_Hz < self._nominal_Hz else "come twice"
        return f"samples {how} or the sensor is set differently, look at health()"

    def _raise_failure(self) -> None:
        if self._failure is not None:
            raise copy.copy(self._failure) from self._failure
        if self._thread is None:
            raise StreamBroken(f"{self.name}: not open", "call open() first")

    def _check(self) -> None:
        self._raise_failure()
        age_s = self._age_s()
        if age_s > self._limits.stale_s:
            raise self._stale(age_s)
