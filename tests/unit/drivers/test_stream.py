"""The reader thread shared by all streaming sensors: nothing lost, nothing old, nothing silent."""

import json
import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import asdict, replace

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers import _stream
from drivers._clock import awake_s
from drivers._stream import NOTHING, StreamingSensor
from drivers.errors import ConnectError, DeviceFault, DeviceTimeout, Frozen, ProtocolError, StreamBroken
from drivers.interfaces import NOT_REPORTED, Array, DeviceInfo, Fact, FtSamples


class FakeSensor(StreamingSensor):
    """A sensor whose blocks the test puts into a queue; an exception in the queue is raised in the reader thread."""

    def __init__(self, *, sign: int = 1, first: int = 1, stale_after_s: float = 0.1, limit: int = 1_000_000) -> None:
        super().__init__("fake", sign=sign, stale_after_s=stale_after_s, max_collect_samples=limit)
        self.feed: queue.Queue[int | FtSamples | Exception] = queue.Queue()
        self.connect_error: Exception | None = None
        self.disconnect_error: Exception | None = None
        self.connects = self.disconnects = 0
        self.first = first
        self.seq = 0

    def _connect(self) -> DeviceInfo:
        self.connects += 1
        if self.connect_error:
            raise self.connect_error
        if self.first:
            self.feed.put(self.first)
        return DeviceInfo("fake", "F1", "1.0")

    def _read_block(self) -> FtSamples:
        try:
            item = self.feed.get(timeout=0.02)
        except queue.Empty:
            return NOTHING
        if isinstance(item, Exception):
            raise item
        if isinstance(item, FtSamples):
            return item
        seq = self.seq + np.arange(item)
        self.seq += item
        return FtSamples(
            t_host_ns=np.full(item, time.monotonic_ns()),
            t_device_s=np.full(item, np.nan),
            seq=seq,
            counts=np.ones((item, 6), np.int32),
            wrench=self.wrench(seq),
            status=np.zeros(item, np.uint32),
        )

    def wrench(self, seq: NDArray[np.int64]) -> Array:
        return np.arange(1.0, 7.0) + 1e-3 * seq[:, np.newaxis]

    def await_received(self, samples: int) -> None:
        wait_for(lambda: self.health().received == samples)

    def _disconnect(self) -> None:
        self.disconnects += 1
        if self.disconnect_error:
            raise self.disconnect_error


@pytest.fixture
def sensor() -> Iterator[FakeSensor]:
    fake = FakeSensor()
    fake.open()
    yield fake
    fake.close()


def feeding(sensor: FakeSensor, blocks: int, size: int, period_s: float = 0.005) -> threading.Thread:
    """Feed in the background, at a steady pace."""

    def run() -> None:
        pause = threading.Event()
        for _ in range(blocks):
            sensor.feed.put(size)
            pause.wait(period_s)

    thread = threading.Thread(target=run)
    thread.start()
    return thread


def test_constructor_touches_nothing() -> None:
    fake = FakeSensor()
    assert fake.connects == 0
    with pytest.raises(StreamBroken, match="not open"):
        fake.check()
    with pytest.raises(ConnectError, match="open it first"):
        fake.identify()


def test_collect_has_every_sample_of_the_window_and_no_other(sensor: FakeSensor) -> None:
    feeder = feeding(sensor, 60, 3)
    start_ns = time.monotonic_ns()
    samples = sensor.collect(0.2)
    feeder.join()
    assert len(samples) > 60
    assert (np.diff(samples.seq) == 1).all()
    assert samples.t_host_ns[0] >= start_ns
    assert samples.t_host_ns[-1] - start_ns < 0.25e9


def test_two_threads_collect_the_same_samples(sensor: FakeSensor) -> None:
    feeder = feeding(sensor, 60, 2)
    results: list[FtSamples] = []
    other = threading.Thread(target=lambda: results.append(sensor.collect(0.15)))
    other.start()
    mine = sensor.collect(0.15)
    other.join()
    feeder.join()
    assert len(np.intersect1d(mine.seq, results[0].seq)) > 40


@pytest.mark.parametrize(
    "error", [StreamBroken("gone"), DeviceFault("hot"), ProtocolError("odd"), ZeroDivisionError("bug")]
)
def test_death_of_the_reader_is_raised_at_every_consumer(sensor: FakeSensor, error: Exception) -> None:
    threading.Timer(0.03, sensor.feed.put, [error]).start()
    start = time.monotonic()
    with pytest.raises(type(error), match=str(error)) as caught:
        sensor.collect(5.0)
    assert time.monotonic() - start < 0.5
    assert caught.value.__cause__ is error
    for call in (sensor.check, lambda: sensor.latest(timeout_s=0.1), lambda: sensor.collect(0.1)):
        with pytest.raises(type(error), match=str(error)):
            call()


def test_silence_is_a_timeout_never_an_old_value(sensor: FakeSensor) -> None:
    assert len(sensor.latest(timeout_s=0.0)) == 1
    sensor.check()
    start = time.monotonic()
    with pytest.raises(DeviceTimeout, match=r"fake: silent for 0\.1\d* s"):
        sensor.collect(1.0)
    assert time.monotonic() - start < 0.4
    with pytest.raises(DeviceTimeout, match="fake: silent"):
        sensor.check()
    with pytest.raises(DeviceTimeout, match="fake: silent"):
        sensor.latest(timeout_s=0.05)
    sensor.feed.put(1)
    assert sensor.latest(timeout_s=1.0).seq[0] == 1  # fresh again: silence is judged anew
    sensor.check()


def test_a_pause_inside_a_collect_is_an_error_although_the_stream_came_back() -> None:
    fake = FakeSensor(stale_after_s=0.05)
    with fake:
        feed = [threading.Timer(t, fake.feed.put, [1]) for t in (0.02, 0.04, 0.12, 0.14, 0.16, 0.18, 0.2, 0.22)]
        for timer in feed:
            timer.start()
        with pytest.raises(DeviceTimeout, match="silent"):
            fake.collect(0.2)
        for timer in feed:
            timer.join()


def test_more_samples_than_a_collect_may_hold_is_an_error() -> None:
    fake = FakeSensor(limit=10)
    with fake:
        feeder = feeding(fake, 20, 3)
        with pytest.raises(StreamBroken, match="more than 10 samples"):
            fake.collect(1.0)
        feeder.join()


def test_what_the_device_does_not_tell_is_configured(monkeypatch: pytest.MonkeyPatch) -> None:
    told = Fact((100.0,) * 6, "device")
    fake = FakeSensor(sign=-1)
    monkeypatch.setattr(fake, "_connect", lambda: DeviceInfo("fake", NOT_REPORTED, "1.0", {"range": told}))
    fake.feed.put(1)
    fake.configured = {"serial": Fact("F7", "configured")}
    with fake:
        info = fake.identify()
    assert info.serial == "F7"
    assert info.facts == {
        "serial": Fact("F7", "configured"),
        "range": told,
        "sign": Fact(-1, "configured"),
    }
    assert json.loads(json.dumps(asdict(info)))["facts"]["range"] == {"value": [100.0] * 6, "source": "device"}


def test_a_sensor_that_tells_another_serial_number_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    fake = FakeSensor()
    fake.configured = {"serial": Fact("F2", "configured")}
    with pytest.raises(ConnectError, match="serial number F1 answers, F2 is configured"):
        fake.open()
    assert fake.disconnects == 1
    fake.configured = {"serial": Fact("F1", "configured"), "range": Fact((1.0,) * 6, "configured")}
    monkeypatch.setattr(fake, "_connect", lambda: DeviceInfo("fake", "F1", "1.0", {"range": Fact(2.0, "device")}))
    fake.feed.put(1)
    with fake:
        assert fake.identify().facts["range"] == Fact((1.0,) * 6, "configured")  # the user knows why


def test_sign_turns_the_wrench_once_and_leaves_counts_raw() -> None:
    fake = FakeSensor(sign=-1)
    with fake:
        newest = fake.latest(timeout_s=1.0)
        assert newest.wrench.tolist() == [[-1.0, -2.0, -3.0, -4.0, -5.0, -6.0]]
        assert newest.counts.tolist() == [[1] * 6]
    with pytest.raises(ValueError, match="sign is 0"):
        FakeSensor(sign=0)


def test_open_and_close_are_idempotent_and_a_closed_sensor_opens_again() -> None:
    fake = FakeSensor()
    fake.close()
    fake.open()
    fake.open()
    assert fake.connects == 1
    fake.close()
    fake.close()
    assert fake.disconnects == 1
    with pytest.raises(StreamBroken, match="not open"):
        fake.latest(timeout_s=0.1)
    fake.open()
    assert fake.health().received == 1
    fake.close()


def test_open_after_a_failure_starts_clean(sensor: FakeSensor) -> None:
    sensor.feed.put(StreamBroken("gone"))
    with pytest.raises(StreamBroken, match="gone"):
        sensor.latest(timeout_s=1.0) if sensor._failure else sensor.collect(1.0)
    sensor.open()
    sensor.check()
    assert (sensor.connects, sensor.disconnects) == (2, 1)
    assert sensor.health().received == 1


def test_open_leaves_a_driver_alone_that_connects_again_by_itself() -> None:
    with FakeSensor() as sensor:
        sensor.recover = True
        sensor.connect_error = StreamBroken("still gone")
        sensor.feed.put(StreamBroken("gone"))
        wait_for(lambda: sensor.connects >= 2)
        sensor.open()
        with pytest.raises(StreamBroken, match="connecting again"):
            sensor.check()
        sensor.connect_error = None
        wait_for(lambda: sensor.health().reconnects == 1)


def test_what_a_codec_says_gets_the_name_of_the_device() -> None:
    fake = FakeSensor()
    for said in ("odd", "fake: odd"):
        fake.connect_error = ProtocolError(said)
        with pytest.raises(ConnectError, match=r"^fake: odd$"):
            fake.open()


@pytest.mark.parametrize(
    ("raised", "seen"),
    [(ProtocolError("odd"), ConnectError), (DeviceFault("hot"), DeviceFault), (KeyError(1), KeyError)],
)
def test_a_failed_connect_frees_the_port(raised: Exception, seen: type[Exception]) -> None:
    fake = FakeSensor()
    fake.connect_error = raised
    with pytest.raises(seen):
        fake.open()
    assert fake.disconnects == 1
    assert threading.active_count() == 1 or not any("fake" in t.name for t in threading.enumerate())


def test_a_device_that_connects_and_stays_silent_is_not_open() -> None:
    fake = FakeSensor(first=0)
    with pytest.raises(ConnectError, match="no sample"):
        fake.open()
    assert fake.disconnects == 1


def test_close_never_raises_and_ends_a_collect_elsewhere(sensor: FakeSensor) -> None:
    sensor.disconnect_error = OSError("gone")
    errors: list[BaseException] = []

    def collect() -> None:
        try:
            sensor.collect(5.0)
        except StreamBroken as exc:
            errors.append(exc)

    feeder = feeding(sensor, 20, 1)
    thread = threading.Thread(target=collect)
    thread.start()
    sensor.collect(0.05)
    start = time.monotonic()
    sensor.close()
    assert time.monotonic() - start < 1.0
    thread.join(1.0)
    feeder.join()
    assert len(errors) == 1
    assert not any("fake" in t.name for t in threading.enumerate())


def test_health_counts_and_tells_the_rate(sensor: FakeSensor) -> None:
    feeder = feeding(sensor, 40, 2, 0.01)
    sensor.collect(0.3)
    health = sensor.health()
    feeder.join()
    assert health.received == pytest.approx(1 + 60, abs=15)
    assert health.rate_Hz == pytest.approx(200, rel=0.3)
    assert health.age_s < 0.1


@pytest.mark.parametrize("duration_s", [0.0, -1.0, float("nan")])
def test_a_duration_without_length_is_refused(sensor: FakeSensor, duration_s: float) -> None:
    with pytest.raises(ValueError, match="positive"):
        sensor.collect(duration_s)


def block(seq: list[int], *, wrench: float | None = None, t_device_s: float = np.nan) -> FtSamples:
    """Samples as a driver hands them over; a wrench that is not given is another one in each row."""
    n = len(seq)
    rows = np.arange(6.0) + np.array(seq)[:, np.newaxis] if wrench is None else np.full((n, 6), wrench)
    return FtSamples(
        t_host_ns=np.full(n, time.monotonic_ns()),
        t_device_s=np.full(n, t_device_s),
        seq=np.array(seq),
        counts=np.zeros((n, 0), np.int32),
        wrench=rows,
        status=np.zeros(n, np.uint32),
    )


def at(t_s: float, seq: list[int], *, wrench: float | None = None, t_device_s: float = np.nan) -> FtSamples:
    """Samples that come `t_s` from now."""
    made = block(seq, wrench=wrench, t_device_s=t_device_s)
    return replace(made, t_host_ns=made.t_host_ns + round(t_s * 1e9))


def wait_for(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 5.0
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.002)


def wait_for_end(sensor: FakeSensor, most_s: float) -> None:
    reader = sensor._thread
    assert reader
    reader.join(most_s)


def failure_of(sensor: FakeSensor) -> type[Exception] | None:
    try:
        sensor.check()
    except Exception as exc:
        return type(exc)
    return None


def test_what_came_twice_or_too_late_is_dropped_and_counted(sensor: FakeSensor) -> None:
    def feed(*blocks: list[int]) -> None:
        for seq in blocks:
            sensor.feed.put(block(seq))

    threading.Timer(0.02, feed, [[5, 5, 6], [6, 9, 7, 10], [8]]).start()
    threading.Timer(0.08, feed, [[11]]).start()
    samples = sensor.collect(0.06)
    health = sensor.health()
    assert samples.seq.tolist() == [5, 6, 9, 10]
    assert (health.duplicated, health.out_of_order) == (2, 2)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_wrench_that_is_no_number_is_never_delivered(sensor: FakeSensor, bad: float) -> None:
    sensor.feed.put(block([5, 6], wrench=bad))
    with pytest.raises(ProtocolError, match="not finite"):
        sensor.collect(1.0)
    assert sensor.health().received == 1


def test_a_frozen_sensor_is_a_fault() -> None:
    with FakeSensor(stale_after_s=1.0) as sensor:
        start = time.monotonic()
        for seq in range(10, 200, 2):
            sensor.feed.put(block([seq, seq + 1], wrench=3.0))
            time.sleep(0.004)
            if failure_of(sensor):
                break
        with pytest.raises(Frozen, match=r"frozen, \d+ identical samples in 0\.\d+ s"):
            sensor.check()
        assert time.monotonic() - start >= 0.2


def test_few_identical_samples_or_a_short_while_are_not_frozen() -> None:
    with FakeSensor(stale_after_s=1.0) as sensor:
        sensor.feed.put(block(list(range(10, 1000)), wrench=3.0))  # many, in no time
        wait_for(lambda: sensor.health().received > 900)
        sensor.feed.put(block([1000]))
        for seq in range(1001, 1031):  # a long while, few
            sensor.feed.put(block([seq], wrench=3.0))
            time.sleep(0.01)
        wait_for(lambda: sensor.health().received == 1 + 990 + 1 + 30)
        sensor.check()


@pytest.mark.parametrize(("nominal_Hz", "enough"), [(7000.0, 50), (200.0, 40), (100.0, 20), (10.0, 20), (np.nan, 50)])
def test_how_many_identical_samples_are_enough_depends_on_the_rate(nominal_Hz: float, enough: int) -> None:
    with FakeSensor(stale_after_s=1.0) as sensor:
        sensor._nominal_Hz = nominal_Hz
        frozen = [at(0.011 * number, [10 + number], wrench=3.0) for number in range(enough)]
        for made in frozen[:-1]:
            sensor.feed.put(made)
        sensor.await_received(enough)
        sensor.check()
        sensor.feed.put(frozen[-1])
        wait_for(lambda: failure_of(sensor) is Frozen)


def test_what_has_piled_up_while_the_computer_slept_is_never_delivered(monkeypatch: pytest.MonkeyPatch) -> None:
    asleep_s = [0.0]
    monkeypatch.setattr(_stream, "awake_s", lambda: awake_s() + asleep_s[0])
    with FakeSensor(stale_after_s=0.3) as sensor:
        told: list[Exception] = []

        def collect() -> None:
            try:
                sensor.collect(5.0)
            except DeviceTimeout as exc:
                told.append(exc)

        feeder = feeding(sensor, 200, 1)
        collecting = threading.Thread(target=collect)
        collecting.start()
        wait_for(lambda: sensor.health().received > 10)
        asleep_s[0] = 3600.0
        for _ in range(1000):
            sensor.feed.put(1)
        newest = sensor.latest(timeout_s=2.0)
        assert newest.seq[0] > 1000
        samples = sensor.collect(0.1)
        assert 5 < len(samples) < 100
        collecting.join()
        feeder.join()
        wait_for(lambda: sensor.health().lost + sensor.health().received == sensor.seq == 1 + 1000 + 200)
        health = sensor.health()
    assert "suspended" in str(told)
    assert health.stale == 1
    (event,) = health.events
    assert "nobody read for 3600" in event[1]


class Clocked(FakeSensor):
    """Its clock moves only in reads, as the test says: what waits in `script` is (s a read takes, samples)."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *, stale_after_s: float) -> None:
        super().__init__(stale_after_s=stale_after_s)
        self.now_s = 0.0
        self.script: deque[tuple[float, int]] = deque()
        self.silent_reads = 0
        monkeypatch.setattr(_stream, "awake_s", lambda: self.now_s)

    def _read_block(self) -> FtSamples:
        if self.script:
            read_s, samples = self.script.popleft()
            self.feed.put(samples)
        else:
            read_s = 0.02
        block = super()._read_block()
        self.silent_reads += not len(block)
        self.now_s += read_s
        return block


def test_who_is_away_again_while_the_backlog_is_thrown_away_begins_again(monkeypatch: pytest.MonkeyPatch) -> None:
    with Clocked(monkeypatch, stale_after_s=0.3) as sensor:
        backlog, live = (0.0005, 10), (0.02, 1)
        sensor.script += [(5.0, 1), backlog, (5.0, 10), *[backlog] * 5, *[live] * 4]
        wait_for(lambda: sensor.health().received == 2)
        health = sensor.health()
    assert health.lost == 1 + 10 + 10 + 5 * 10 + 3  # the last read to wait ends the 50 ms


def test_a_pause_shorter_than_a_silence_may_be_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    with Clocked(monkeypatch, stale_after_s=0.45) as sensor:
        sensor.script += [(0.4, 5)]
        wait_for(lambda: sensor.health().received == 6)
        assert sensor.health().events == ()
        sensor.script += [(0.5, 5)]
        wait_for(lambda: sensor.health().lost == 5)


def test_after_a_pause_a_sensor_has_time_before_it_is_connected_again(monkeypatch: pytest.MonkeyPatch) -> None:
    sensor = Clocked(monkeypatch, stale_after_s=5.0)
    sensor.recover = True
    with sensor:
        sensor.script += [(3600.0, 1)]
        wait_for(lambda: sensor._fresh_from_ns > 0)
        reads = sensor.silent_reads
        wait_for(lambda: sensor.silent_reads > reads + 2)
        sensor.feed.put(1)
        sensor.await_received(2)
        assert sensor.connects == 1


class Unseen(FakeSensor):
    """What interrupts it is over before anybody else has had a look: the lock is held from then to the next sample."""

    held = False

    def _read_block(self) -> FtSamples:
        try:
            return super()._read_block()
        except StreamBroken:
            self.hold()
            raise

    def hold(self) -> None:
        self._news.acquire()
        self.held = True

    def _publish(self, block: FtSamples) -> None:
        super()._publish(block)
        if self.held:
            self.held = False
            self._news.release()


def test_a_collect_across_a_pause_too_short_to_be_seen_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    asleep_s = [0.0]
    monkeypatch.setattr(_stream, "awake_s", lambda: awake_s() + asleep_s[0])

    class Suspended(Unseen):
        def _read_block(self) -> FtSamples:
            block = super()._read_block()
            if self.seq == 20:
                self.hold()
                asleep_s[0] = 3600.0
            return block

    with Suspended(stale_after_s=5.0) as sensor:
        feeder = feeding(sensor, 60, 1)
        with pytest.raises(DeviceTimeout, match="nobody read for 3600"):
            sensor.collect(0.25)
        feeder.join()


def test_samples_that_were_long_on_their_way_are_dropped_and_told(sensor: FakeSensor) -> None:
    sensor.feed.put(at(0.0, [5], t_device_s=10.0))
    for number in range(1, 11):  # all at once, half a second later
        sensor.feed.put(at(0.5, [5 + number], t_device_s=10 + 0.01 * number))
    sensor.feed.put(at(0.501, [60], t_device_s=10.48))
    sensor.await_received(3)
    health = sensor.health()
    assert int(sensor.latest(timeout_s=0.1).seq[0]) == 60
    assert health.lost == 10
    assert [what for _, what in health.events] == ["samples come 0.48 s late and are thrown away"]


def test_a_device_clock_that_is_a_hundredth_slow_is_not_late(sensor: FakeSensor) -> None:
    for number in range(200):
        sensor.feed.put(at(float(number), [5 + number], t_device_s=10 + 0.99 * number))
    sensor.await_received(201)
    assert sensor.health().events == ()


@pytest.mark.parametrize(
    ("clock", "says"),
    [
        ([1.0, 1.1, 1.09], "back by 0.010 s"),
        ([1.0, 1.1, 0.0], "back by 1.100 s to 0.000 s"),
        ([1.0, 1.1, 9.1], r"ahead by (7\.9\d+|8\.000) s to 9.100 s"),
    ],
)
def test_a_jump_of_the_devices_clock_is_named(sensor: FakeSensor, clock: list[float], says: str) -> None:
    for number, t_device_s in enumerate(clock):
        sensor.feed.put(block([5 + number], t_device_s=t_device_s))
    with pytest.raises(StreamBroken, match=f"clock jumped {says}"):
        sensor.collect(1.0)


def test_a_late_block_or_a_slow_reader_is_no_jump() -> None:
    with FakeSensor(stale_after_s=1.0) as sensor:
        sensor.feed.put(block([5], t_device_s=10.0))
        wait_for(lambda: sensor.health().received == 2)
        time.sleep(0.6)  # what came meanwhile waits in the port's buffer and is then read in pieces
        for seq in range(6, 66):
            sensor.feed.put(block([seq], t_device_s=10.0 + 0.01 * (seq - 5)))
        wait_for(lambda: sensor.health().received == 62)
        sensor.check()


def test_a_rate_off_by_more_than_a_tenth_is_said_once(caplog: pytest.LogCaptureFixture) -> None:
    for nominal_Hz, words in ((1000.0, "are lost"), (200.0, ""), (100.0, "come twice")):
        said = int(bool(words))
        caplog.clear()
        with FakeSensor(stale_after_s=1.0) as sensor:
            sensor._nominal_Hz = nominal_Hz
            t_ns = time.monotonic_ns()
            for number in range(1, 1001):  # five seconds at 200 Hz
                made = block([5 + number])
                sensor.feed.put(replace(made, t_host_ns=np.array([t_ns + number * 5_000_000])))
            sensor.await_received(1001)
            health = sensor.health()
        assert caplog.text.count(f"instead of {nominal_Hz:g} Hz; samples {words}") == said
        assert [what for _, what in health.events] == [f"rate 200.0 Hz instead of {nominal_Hz:g} Hz"] * said
        assert health.nominal_rate_Hz == nominal_Hz


def test_a_rate_that_is_right_again_is_said_and_so_is_the_next_wrong_one() -> None:
    with FakeSensor(stale_after_s=1.0) as sensor:
        sensor._nominal_Hz = 200.0
        t_s, seq = 0.0, 5
        for rate_Hz in (100.0, 200.0, 100.0):
            for _ in range(round(4.5 * rate_Hz)):
                t_s, seq = t_s + 1 / rate_Hz, seq + 1
                sensor.feed.put(at(t_s, [seq]))
        sensor.await_received(1 + seq - 5)
        told = ["again" in what for _, what in sensor.health().events]
    assert told == [False, True, False]


def test_silences_are_counted(sensor: FakeSensor) -> None:
    for received in (2, 3):
        time.sleep(0.12)
        sensor.feed.put(1)
        sensor.await_received(received)
    assert sensor.health().stale == 2


class TestRecover:
    @pytest.fixture
    def sensor(self) -> Iterator[FakeSensor]:
        fake = FakeSensor(stale_after_s=1.0)
        fake.recover = True
        fake.open()
        yield fake
        fake.close()

    def test_a_broken_stream_comes_back_and_says_so(self, sensor: FakeSensor) -> None:
        sensor.connect_error = ConnectError("not plugged in")
        sensor.feed.put(StreamBroken("gone"))
        wait_for(lambda: failure_of(sensor) is StreamBroken)
        with pytest.raises(StreamBroken, match=r"interrupted, connecting again \(gone\)"):
            sensor.latest(timeout_s=0.05)
        wait_for(lambda: sensor.connects >= 3)
        sensor.connect_error = None
        wait_for(lambda: failure_of(sensor) is None)
        health = sensor.health()
        assert health.reconnects == 1
        assert [what for _, what in health.events] == ["gone", "connected again"]
        assert health.events[0][0] < health.events[1][0]
        assert len(sensor.latest(timeout_s=0.5)) == 1

    def test_a_device_that_connects_again_and_stays_mute_is_not_mended(
        self, sensor: FakeSensor, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(_stream, "_RECOVER_S", 60.0)
        sensor._stale_after_s, sensor.first = 0.05, 0
        sensor.feed.put(StreamBroken("gone"))
        wait_for(lambda: sensor.connects >= 4)  # mute for a whole silence, again and again
        health = sensor.health()
        assert (health.reconnects, [what for _, what in health.events]) == (0, ["gone"])
        with pytest.raises(StreamBroken, match="connecting again"):
            sensor.check()
        sensor._stale_after_s = 5.0
        sensor.feed.put(1)
        wait_for(lambda: failure_of(sensor) is None)
        health = sensor.health()
        assert (health.reconnects, [what for _, what in health.events]) == (1, ["gone", "connected again"])

    def test_a_device_that_stays_mute_is_given_up(self, sensor: FakeSensor, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(_stream, "_RECOVER_S", 0.3)
        sensor._stale_after_s, sensor.first = 0.05, 0
        sensor.feed.put(StreamBroken("gone"))
        wait_for_end(sensor, 5.0)
        with pytest.raises(StreamBroken, match=r"^gone, not back within 0.3 s \(fake: silent for .*\)$"):
            sensor.check()
        assert sensor.connects > 1
        assert sensor.health().reconnects == 0

    def test_a_collect_across_a_reconnection_too_quick_to_be_seen_is_an_error(self) -> None:
        sensor = Unseen(stale_after_s=5.0)
        sensor.recover = True
        with sensor:
            feeder = feeding(sensor, 60, 1)
            threading.Timer(0.05, sensor.feed.put, [StreamBroken("gone")]).start()
            with pytest.raises(StreamBroken, match="the stream was interrupted and came back; collect again"):
                sensor.collect(0.25)
            feeder.join()
            assert sensor.health().reconnects == 1

    def test_silence_is_mended_too(self, sensor: FakeSensor) -> None:
        sensor._stale_after_s = 0.1
        wait_for(lambda: sensor.health().reconnects >= 1)

    def test_what_was_lost_and_damaged_before_stays_counted(self, sensor: FakeSensor) -> None:
        sensor._lost, sensor._malformed = 3, 2  # as a driver counts them since it has connected
        sensor.feed.put(StreamBroken("gone"))
        wait_for(lambda: sensor.health().reconnects == 1)
        sensor._lost, sensor._malformed = 10, 20
        assert (sensor.health().lost, sensor.health().malformed) == (13, 22)

    def test_a_fault_found_while_connecting_again_is_final(self, sensor: FakeSensor) -> None:
        sensor.connect_error = DeviceFault("hot")
        sensor.feed.put(StreamBroken("gone"))
        wait_for(lambda: failure_of(sensor) is DeviceFault)
        assert sensor.connects == 2

    def test_numbers_go_on(self, sensor: FakeSensor) -> None:
        sensor._nominal_Hz = 1000.0
        sensor.feed.put(block([40]))
        wait_for(lambda: sensor.health().received == 2)
        sensor.seq = 0  # the device counts anew
        sensor.feed.put(StreamBroken("gone"))
        wait_for(lambda: sensor.health().reconnects == 1 and sensor.health().received > 2)
        newest = int(sensor.latest(timeout_s=0.1).seq[0])
        assert newest - 40 - 1 == sensor.health().lost > 0

    def test_another_device_is_not_the_same_stream(self, sensor: FakeSensor, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(sensor, "_connect", lambda: DeviceInfo("fake", "F2", "1.0"))
        sensor.feed.put(StreamBroken("gone"))
        wait_for(lambda: failure_of(sensor) is ConnectError)

    def test_it_gives_up(self, sensor: FakeSensor, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr("drivers._stream._RECOVER_S", 0.3)
        sensor.connect_error = ConnectError("not plugged in")
        sensor.feed.put(StreamBroken("gone"))
        wait_for_end(sensor, 2.0)
        with pytest.raises(StreamBroken, match=r"gone, not back within 0.3 s \(not plugged in\)"):
            sensor.check()

    @pytest.mark.parametrize("error", [DeviceFault("hot"), ProtocolError("odd")])
    def test_a_fault_is_final_all_the_same(self, sensor: FakeSensor, error: Exception) -> None:
        sensor.feed.put(error)
        wait_for(lambda: failure_of(sensor) is type(error))
        assert sensor.connects == 1

    def test_close_ends_the_attempts(self, sensor: FakeSensor) -> None:
        sensor.connect_error = ConnectError("not plugged in")
        sensor.feed.put(StreamBroken("gone"))
        wait_for(lambda: sensor.connects > 1)
        sensor.close()
        assert not any("fake" in thread.name for thread in threading.enumerate())
