"""The reader shared by all streaming sensors: nothing lost, nothing old, nothing silent, every limit to the tick."""

import threading
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from ftdrivers.clock import REAL, Clock
from ftdrivers.errors import ConnectError, DeviceFault, DeviceTimeout, Frozen, ProtocolError, StreamBroken
from ftdrivers.interfaces import Array, DeviceInfo, Fact, FtSamples
from ftdrivers.streaming.sensor import NOTHING, StreamingSensor, StreamLimits
from tests.fake_clock import FakeClock
from tests.unit.drivers.in_one_thread import InOneThread

READ_S = 0.02
Feed = int | FtSamples | Exception


class Fed(StreamingSensor):
    """A sensor whose blocks the test puts into `feed`; an exception among them is raised in the reader."""

    def __init__(self, clock: Clock, *, sign: int = 1, limits: StreamLimits | None = None, most: int = 10**6) -> None:
        super().__init__("fake", sign=sign, clock=clock, limits=limits or StreamLimits(), max_unread_samples=most)
        self.feed: deque[Feed] = deque()
        self.connect_error: Exception | None = None
        self.disconnect_error: Exception | None = None
        self.connects = self.disconnects = 0
        self.info = DeviceInfo("fake", "F1", "1.0")
        self.first = 1
        self.seq = 0
        self.arrived = threading.Condition()

    def _connect(self) -> DeviceInfo:
        self.connects += 1
        if self.connect_error:
            raise self.connect_error
        if self.first:
            self.feed.append(self.first)
        return self.info

    def _read_block(self) -> FtSamples:
        with self.arrived:
            for left_s in self._clock.looks(READ_S):
                if self.feed:
                    break
                self._clock.wait(self.arrived, left_s)
            else:
                return NOTHING
            item = self.feed.popleft()
        if isinstance(item, Exception):
            raise item
        if isinstance(item, FtSamples):
            return item
        seq = self.seq + np.arange(item)
        self.seq += item
        return FtSamples.of(self._clock.now_ns(), seq, self.wrench(seq), counts=np.ones((item, 6)))

    @property
    def is_awaited(self) -> bool:
        return bool(self._news._waiters)  # type: ignore[attr-defined]

    def wrench(self, seq: NDArray[np.int64]) -> Array:
        return np.arange(1.0, 7.0) + 1e-3 * seq[:, np.newaxis]

    def _disconnect(self) -> None:
        self.disconnects += 1
        if self.disconnect_error:
            raise self.disconnect_error


class FakeSensor(InOneThread, Fed):
    """On a fake clock of its own."""

    def __init__(
        self,
        *,
        sign: int = 1,
        limits: StreamLimits | None = None,
        most: int = 10**6,
        recover: bool = False,
        clock: FakeClock | None = None,
    ) -> None:
        self.time = clock or FakeClock()
        super().__init__(self.time, sign=sign, limits=limits, most=most)
        self.recover = recover

    def at(self, delay_s: float, *items: Feed) -> None:
        self.time.at(delay_s, lambda: self.feed.extend(items))

    def stream(self, size: int = 1, period_s: float = 0.005) -> None:
        """Feed for ever."""

        def send() -> None:
            self.feed.append(size)
            self.time.at(period_s, send)

        self.time.at(period_s, send)

    def expect_rate(self, nominal_Hz: float) -> None:
        self._nominal_Hz = nominal_Hz

    def take_turn(self) -> None:
        self._take_turn()

    @property
    def has_ended(self) -> bool:
        return self._has_ended

    def settle(self) -> None:
        """Let the reader take what it was fed."""
        while self.feed:
            self.time.advance(0.001)

    def block(self, seq: list[int], *, after_s: float = 0.0, **what: float) -> FtSamples:
        """Samples as a driver hands them over, received `after_s` from now."""
        made = block(seq, **what)
        return replace(made, t_host_ns=made.t_host_ns + self.time.now_ns() + round(after_s * 1e9))


def block(seq: list[int], *, wrench: float | None = None, t_device_s: float = np.nan) -> FtSamples:
    """A wrench that is not given is another one in each row."""
    n = len(seq)
    rows = np.arange(6.0) + np.array(seq)[:, np.newaxis] if wrench is None else np.full((n, 6), wrench)
    return FtSamples.of(0, seq, rows, t_device_s=t_device_s)


@pytest.fixture
def sensor() -> Iterator[FakeSensor]:
    with FakeSensor() as fake:
        yield fake


def failure_of(sensor: StreamingSensor) -> type[Exception] | None:
    try:
        sensor.check()
    except Exception as exc:
        return type(exc)
    return None


def test_collect_has_every_sample_of_the_window_and_no_other(sensor: FakeSensor) -> None:
    sensor.stream(3, 0.005)
    sensor.collect(0.012)
    start_ns = sensor.time.now_ns()
    samples = sensor.collect(0.2)
    assert (np.diff(samples.seq) == 1).all()
    assert 0 <= samples.t_host_ns[0] - start_ns <= 5_100_000
    assert 0 < start_ns + 200_000_000 - samples.t_host_ns[-1] <= 5_100_000
    assert sensor.time.now_ns() - start_ns <= 205_100_000  # with the first sample after the end


@pytest.mark.parametrize("error", [StreamBroken("gone"), ZeroDivisionError("bug")])
def test_death_of_the_reader_is_raised_at_every_consumer_at_once(sensor: FakeSensor, error: Exception) -> None:
    sensor.at(0.03, error)
    start_s = sensor.time.now_s()
    with pytest.raises(type(error), match=str(error)) as caught:
        sensor.collect(5.0)
    assert sensor.time.now_s() - start_s == pytest.approx(0.03, abs=1e-3)
    assert caught.value.__cause__ is error
    for call in (sensor.check, lambda: sensor.latest(timeout_s=0.1), lambda: sensor.collect(0.1)):
        with pytest.raises(type(error), match=str(error)):
            call()


def test_silence_is_a_timeout_never_an_old_value(sensor: FakeSensor) -> None:
    assert len(sensor.latest(timeout_s=0.0)) == 1
    heard_s = sensor.latest(timeout_s=0.0).t_host_ns[0] / 1e9
    failures: list[type[Exception] | None] = []
    for t_s in (0.2999, 0.3001):
        sensor.time.at(heard_s + t_s - sensor.time.now_s(), lambda: failures.append(failure_of(sensor)))
    with pytest.raises(DeviceTimeout, match=r"0\.3\d\d s"):
        sensor.collect(1.0)
    assert failures == [None, DeviceTimeout]
    assert sensor.time.now_s() - heard_s == pytest.approx(0.3, abs=READ_S + 0.002)
    for call in (sensor.check, lambda: sensor.latest(timeout_s=0.0)):
        with pytest.raises(DeviceTimeout):
            call()
    begin_s = sensor.time.now_s()
    with pytest.raises(DeviceTimeout):
        sensor.latest(timeout_s=0.5)
    assert sensor.time.now_s() - begin_s == pytest.approx(0.5, abs=READ_S + 1e-3)
    sensor.at(0.1, 1)
    assert sensor.latest(timeout_s=1.0).seq[0] == 1  # fresh again: silence counts from now
    sensor.check()


def test_a_gap_inside_a_collect_is_an_error_although_the_stream_came_back(sensor: FakeSensor) -> None:
    for t_s in (0.02, 0.04, 0.35, 0.37, 0.39, 0.41):
        sensor.at(t_s, 1)
    start_s = sensor.time.now_s()
    with pytest.raises(DeviceTimeout):
        sensor.collect(0.4)
    assert sensor.time.now_s() - start_s < 0.4
    for t_s in (0.02, 0.31, 0.42):  # no gap of 0.3 s
        sensor.at(t_s, 1)
    sensor.latest(timeout_s=0.1)
    assert len(sensor.collect(0.3)) >= 1


def test_more_samples_than_a_collect_may_hold_is_an_error() -> None:
    with FakeSensor(most=10) as fake:
        fake.stream(3)
        with pytest.raises(StreamBroken, match=r"12 samples .* limit is 10; .* in shorter pieces"):
            fake.collect(1.0)


def test_a_sensor_with_another_serial_number_is_refused() -> None:
    fake = FakeSensor()
    fake.configured = {"serial": Fact("F2", "configured")}
    with pytest.raises(ConnectError, match=r"F1.*F2"):
        fake.open()
    assert fake.disconnects == 1
    fake.configured = {"serial": Fact("F1", "configured"), "range": Fact((1.0,) * 6, "configured")}
    fake.info = DeviceInfo("fake", "F1", "1.0", {"range": Fact(2.0, "device")})
    with fake:
        assert fake.identify().facts["range"] == Fact((1.0,) * 6, "configured")  # the user knows why


def test_sign_turns_the_wrench_once_and_leaves_counts_raw() -> None:
    with FakeSensor(sign=-1) as fake:
        newest = fake.latest(timeout_s=1.0)
        assert newest.wrench.tolist() == [[-1.0, -2.0, -3.0, -4.0, -5.0, -6.0]]
        assert newest.counts.tolist() == [[1] * 6]
    with pytest.raises(ValueError, match="sign is 0"):
        FakeSensor(sign=0)


def test_a_device_that_connects_and_stays_silent_for_a_second_is_not_open() -> None:
    fake = FakeSensor()
    fake.first = 0
    start_s = fake.time.now_s()
    with pytest.raises(ConnectError, match="no sample"):
        fake.open()
    assert fake.time.now_s() - start_s == pytest.approx(1.0, abs=READ_S)
    assert fake.disconnects == 1
    fake.at(0.99, 1)
    fake.open()


@pytest.mark.parametrize("duration_s", [0.0, float("nan")])
def test_a_duration_without_length_is_refused(sensor: FakeSensor, duration_s: float) -> None:
    with pytest.raises(ValueError, match="positive"):
        sensor.collect(duration_s)


class TestThread:
    """What takes a thread of its own."""

    def test_open_and_close_are_idempotent_and_a_closed_sensor_opens_again(self) -> None:
        fake = Fed(REAL)
        fake.close()
        fake.open()
        fake.open()
        assert fake.connects == 1
        assert len(readers()) == 1
        fake.close()
        fake.close()
        assert fake.disconnects == 1
        with pytest.raises(StreamBroken, match="not open"):
            fake.latest(timeout_s=0.1)
        fake.open()
        assert fake.health().received == 1
        fake.close()
        assert not readers()

    @pytest.mark.parametrize("wait", ["collect", "latest"])
    def test_close_ends_a_wait_elsewhere_at_once(self, wait: str) -> None:
        limits = StreamLimits(stale_s=3600.0)  # so that nothing else ends it

        class Waiting(Fed):
            def _age_s(self) -> float:
                return 4000.0 if wait == "latest" and threading.current_thread() is consumer else super()._age_s()

        fake = Waiting(REAL, limits=limits)
        ended: list[Exception] = []

        def consume() -> None:
            try:
                fake.collect(3600.0) if wait == "collect" else fake.latest(timeout_s=3600.0)
            except StreamBroken as exc:
                ended.append(exc)

        consumer = threading.Thread(target=consume, daemon=True)
        fake.disconnect_error = OSError("gone")  # and close does not raise it
        with fake:
            consumer.start()
            while not fake.is_awaited:
                time.sleep(0.001)
        consumer.join(30.0)
        assert len(ended) == 1
        assert not readers()

    def test_close_ends_attempts_to_connect_again(self) -> None:
        fake = Fed(REAL, limits=StreamLimits(retry_s=0.001))
        fake.recover = True
        with fake:
            fake.connect_error = ConnectError("not plugged in")
            fake.feed.append(StreamBroken("gone"))
            while fake.connects < 3:
                time.sleep(0.001)
        assert not readers()


def readers() -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if "fake" in thread.name]


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_wrench_that_is_no_number_is_never_delivered(sensor: FakeSensor, bad: float) -> None:
    sensor.feed.append(sensor.block([5, 6], wrench=bad))
    with pytest.raises(ProtocolError, match="not finite"):
        sensor.collect(1.0)
    assert sensor.health().received == 1


def test_a_frozen_sensor_is_a_fault_after_a_fifth_of_a_second(sensor: FakeSensor) -> None:
    start_s = sensor.time.now_s()
    for number in range(100):
        sensor.at(0.004 * number, sensor.block([10 + number], after_s=0.004 * number, wrench=3.0))
    with pytest.raises(Frozen, match="51 identical samples"):
        sensor.collect(1.0)
    assert sensor.time.now_s() - start_s == pytest.approx(0.2, abs=1e-3)


@pytest.mark.parametrize(("nominal_Hz", "enough"), [(7000.0, 50), (200.0, 40), (10.0, 20), (np.nan, 50)])
def test_how_many_identical_samples_are_enough_depends_on_the_rate(
    sensor: FakeSensor, nominal_Hz: float, enough: int
) -> None:
    sensor.expect_rate(nominal_Hz)
    frozen = [sensor.block([10 + number], after_s=0.011 * number, wrench=3.0) for number in range(enough)]
    sensor.feed.extend(frozen[:-1])
    sensor.settle()
    sensor.check()
    sensor.feed.append(frozen[-1])
    sensor.settle()
    assert failure_of(sensor) is Frozen


class AsleepClock(FakeClock):
    """Of a computer that was suspended: only one of its clocks went on."""

    asleep_s = 0.0

    def awake_s(self) -> float:
        return self.now_s() + self.asleep_s


def test_what_has_piled_up_while_the_computer_slept_is_never_delivered() -> None:
    clock = AsleepClock()
    with FakeSensor(clock=clock) as sensor:
        sensor.stream(1, 0.005)
        errors: list[str] = []

        def sleep() -> None:
            clock.asleep_s = 3600.0
            sensor.feed.extend([1] * 1000)

        clock.at(0.1, sleep)
        with pytest.raises(DeviceTimeout) as caught:
            sensor.collect(5.0)
        errors.append(str(caught.value))
        newest = sensor.latest(timeout_s=2.0)
        assert newest.seq[0] > 1000
        assert 10 < len(sensor.collect(0.1)) < 25
        health = sensor.health()
        assert health.lost + health.received == sensor.seq > 1000
    assert health.stale == 1
    ((_, what),) = health.events
    assert "3600" in what
    assert "3600" in errors[0]


class TestAway:
    """Other programs had the computer: `_take_turn` comes late, and finds accumulated samples."""

    def test_a_third_of_a_second_is_the_limit(self, sensor: FakeSensor) -> None:
        sensor.time.stall(0.29)
        sensor.feed.append(5)
        sensor.settle()
        assert (sensor.health().received, sensor.health().lost) == (6, 0)
        sensor.time.stall(0.31)
        sensor.feed.append(5)
        sensor.settle()
        assert (sensor.health().received, sensor.health().lost) == (6, 5)

    def test_the_backlog_is_thrown_away_until_a_read_has_to_wait(self, sensor: FakeSensor) -> None:
        sensor.time.stall(5.0)
        sensor.feed.extend([1, *[10] * 20])  # at once
        sensor.stream(1, 0.01)
        sensor.time.advance(1.0)
        health = sensor.health()
        assert health.lost == pytest.approx(1 + 200 + 5, abs=1)  # the first read to wait after 50 ms ends it
        assert health.received == sensor.seq - health.lost

    def test_a_sensor_has_time_before_it_is_connected_again(self) -> None:
        with FakeSensor(recover=True) as sensor:
            sensor.time.stall(3600.0)
            sensor.feed.append(1)
            sensor.at(0.75, 1)  # 0.5 s go to a backlog that is none
            sensor.time.advance(0.79)
            assert sensor.health().received == 2
            assert sensor.connects == 1
            sensor.time.stall(3600.0)
            sensor.time.advance(0.79)
            assert sensor.connects == 1
            sensor.time.advance(0.07)  # 0.5 s, and 0.3 s of silence
            assert sensor.connects == 2

    def test_a_collect_across_a_pause_too_short_to_be_seen_is_an_error(self, sensor: FakeSensor) -> None:
        sensor.stream(1, 0.005)

        def pause() -> None:
            sensor.time.stall(0.35)
            sensor.feed.append(1)
            sensor.take_turn()
            sensor.feed.append(1)
            sensor.take_turn()  # what was away is back before the collect has had a look

        sensor.time.at(0.1, pause)
        with pytest.raises(DeviceTimeout, match="the reader paused"):
            sensor.collect(5.0)


def test_samples_that_were_long_on_their_way_are_dropped_and_noted(sensor: FakeSensor) -> None:
    sensor.feed.append(sensor.block([5], t_device_s=10.0))
    for number in range(1, 11):  # all at once, half a second later
        sensor.feed.append(sensor.block([5 + number], after_s=0.5, t_device_s=10 + 0.01 * number))
    sensor.feed.append(sensor.block([60], after_s=0.501, t_device_s=10.48))
    sensor.settle()
    health = sensor.health()
    assert int(sensor.latest(timeout_s=0.1).seq[0]) == 60
    assert (health.received, health.lost) == (3, 10)
    ((_, what),) = health.events
    assert "0.48 s late" in what


@pytest.mark.parametrize(
    ("clock", "says"),
    [
        ([1.0, 1.1, 1.09], "back by 0.010 s"),
        ([1.0, 1.1, 9.1], "ahead by 8.000 s to 9.100 s"),
    ],
)
def test_a_jump_of_the_devices_clock_is_named(sensor: FakeSensor, clock: list[float], says: str) -> None:
    for number, t_device_s in enumerate(clock):
        sensor.feed.append(sensor.block([5 + number], t_device_s=t_device_s))
    with pytest.raises(StreamBroken, match=says):
        sensor.collect(1.0)


@pytest.mark.parametrize(("nominal_Hz", "hint"), [(1000.0, "lost"), (200.0, None), (100.0, "duplicated")])
def test_a_rate_off_by_more_than_a_tenth_is_said_once(
    sensor: FakeSensor, nominal_Hz: float, hint: str | None, caplog: pytest.LogCaptureFixture
) -> None:
    sensor.expect_rate(nominal_Hz)
    sensor.feed.extend(sensor.block([5 + number], after_s=0.005 * number) for number in range(1, 801))
    sensor.settle()
    health = sensor.health()
    warned = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert len(warned) == len(health.events) == bool(hint)
    if hint:
        assert hint in warned[0]
        assert health.events[0][1] == f"rate 200.0 Hz instead of {nominal_Hz:g} Hz"
    assert health.nominal_rate_Hz == nominal_Hz


class TestRecover:
    @pytest.fixture
    def sensor(self) -> Iterator[FakeSensor]:
        with FakeSensor(recover=True) as fake:
            yield fake

    def test_a_broken_stream_comes_back_and_says_so(self, sensor: FakeSensor) -> None:
        sensor.connect_error = ConnectError("not plugged in")
        sensor.feed.append(StreamBroken("gone"))
        seen: list[bool] = []

        def look() -> None:
            with pytest.raises(StreamBroken, match="gone"):
                sensor.latest(timeout_s=0.0)
            sensor.open()  # leaves alone what connects again by itself
            seen.append(failure_of(sensor) is StreamBroken)
            sensor.connect_error = None

        sensor.time.at(0.5, look)
        sensor.time.advance(0.7)
        assert seen == [True]
        assert sensor.connects == 1 + 3 + 1  # each 0.2 s
        health = sensor.health()
        assert health.reconnects == 1
        assert [what for _, what in health.events] == ["gone", "reconnected"]
        assert health.events[1][0] - health.events[0][0] == pytest.approx(0.6e9, abs=READ_S * 1e9)

    @pytest.mark.parametrize(
        ("error", "said"), [(ConnectError("not plugged in"), "not plugged in"), (None, "no new sample")]
    )
    def test_it_gives_up_after_ten_seconds(self, sensor: FakeSensor, error: Exception | None, said: str) -> None:
        sensor.connect_error, sensor.first = error, 0
        sensor.feed.append(StreamBroken("gone", "plug it in"))
        ended: list[bool] = []
        for t_s in (9.9, 10.6):
            sensor.time.at(t_s, lambda: ended.append(sensor.has_ended))
        sensor.time.advance(11.0)
        assert ended == [False, True]
        with pytest.raises(StreamBroken, match=rf"^gone, not reconnected within 10 s \(.*{said}.*\)") as caught:
            sensor.check()
        assert caught.value.fix == "plug it in"
        assert sensor.health().reconnects == 0

    def test_a_collect_across_a_reconnection_too_quick_to_be_seen_is_an_error(self, sensor: FakeSensor) -> None:
        sensor.stream(1, 0.005)

        def interrupt() -> None:
            sensor.feed.clear()
            sensor.feed.append(StreamBroken("gone"))
            sensor.take_turn()
            sensor.take_turn()

        sensor.time.at(0.05, interrupt)
        with pytest.raises(StreamBroken, match="came back"):
            sensor.collect(0.25)
        assert sensor.health().reconnects == 1

    def test_silence_is_an_interruption_too(self, sensor: FakeSensor) -> None:
        connects: list[int] = []
        for t_s in (0.29, 0.33):
            sensor.time.at(t_s, lambda: connects.append(sensor.connects))
        sensor.time.advance(0.35)
        assert connects == [1, 2]
        assert sensor.health().reconnects == 1

    def test_a_fault_found_while_connecting_again_is_final(self, sensor: FakeSensor) -> None:
        sensor.connect_error = DeviceFault("hot")
        sensor.feed.append(StreamBroken("gone"))
        sensor.settle()
        assert failure_of(sensor) is DeviceFault
        sensor.time.advance(5.0)
        assert sensor.connects == 2

    def test_another_device_is_not_the_same_stream(self, sensor: FakeSensor) -> None:
        sensor.info, sensor.first = DeviceInfo("fake", "F2", "1.0"), 0
        sensor.feed.append(StreamBroken("gone"))
        sensor.settle()
        assert failure_of(sensor) is ConnectError

    @pytest.mark.parametrize("error", [DeviceFault("hot"), ProtocolError("odd")])
    def test_a_fault_is_final_all_the_same(self, sensor: FakeSensor, error: Exception) -> None:
        sensor.feed.append(error)
        sensor.settle()
        assert failure_of(sensor) is type(error)
        assert sensor.connects == 1


class TestFollow:
    def test_every_sample_comes_once_and_in_order(self, sensor: FakeSensor) -> None:
        sensor.stream(3, 0.004)
        with sensor.follow() as follow:
            pieces = []
            for k in range(20):
                sensor.time.advance(0.01 * (k % 4))
                pieces.append(follow.read(0.1))
        assert all(len(piece) for piece in pieces)
        whole = FtSamples.concatenate(pieces)
        assert whole.seq.tolist() == list(range(1, len(whole) + 1))
        assert whole.wrench == pytest.approx(sensor.wrench(whole.seq))

    @pytest.mark.parametrize("error", [StreamBroken("gone"), DeviceFault("hot")])
    def test_a_failure_is_raised_after_what_came_before_it(self, sensor: FakeSensor, error: Exception) -> None:
        with sensor.follow() as follow:
            sensor.feed.extend([2, error])
            sensor.settle()
            assert len(follow.read(1.0)) == 2
            for _ in range(2):
                with pytest.raises(type(error), match=str(error)):
                    follow.read(1.0)
        with pytest.raises(type(error)), sensor.follow():
            pytest.fail("a stream that has failed was followed")

    def test_more_samples_than_may_wait_are_an_error_and_none_is_skipped(self) -> None:
        with FakeSensor(most=10) as fake, fake.follow() as follow, fake.follow() as idle:
            for _ in range(4):
                fake.feed.append(5)
                fake.settle()
                assert len(follow.read(0.0)) == 5  # reads in time
            for _ in range(2):
                with pytest.raises(StreamBroken, match=r"20 samples .* limit is 10; read more often"):
                    idle.read(0.0)

    def test_an_old_follower_does_not_read_a_stream_that_was_opened_again(self, sensor: FakeSensor) -> None:
        with sensor.follow() as follow:
            sensor.close()
            with pytest.raises(StreamBroken, match="not open"):
                follow.read(0.0)
            sensor.open()
            with pytest.raises(StreamBroken, match="follow it again"):
                follow.read(0.0)

    def test_a_follower_outlives_a_reconnection(self) -> None:
        with FakeSensor(recover=True) as fake, fake.follow() as follow:
            fake.expect_rate(1000.0)
            fake.connect_error = ConnectError("not plugged in")
            fake.feed.extend([1, StreamBroken("gone")])
            seen: list[int] = []

            def plug_in() -> None:
                seen.append(len(follow.read(0.0)))
                with pytest.raises(StreamBroken, match="interrupted"):
                    follow.read(0.0)
                fake.connect_error, fake.first = None, 3
                fake.seq = 0  # the device restarts its count

            fake.time.at(0.1, plug_in)
            fake.time.advance(0.3)
            samples = follow.read(0.0)
            assert seen == [1]
            assert fake.health().reconnects == 1
            assert samples.seq[0] > 100
            assert len(samples) == 3


def test_constructor_touches_nothing() -> None:
    fake = FakeSensor()
    assert fake.connects == 0
    with pytest.raises(StreamBroken, match="not open"):
        fake.check()
    with pytest.raises(ConnectError, match="open it first"):
        fake.identify()


def test_a_rate_that_is_right_again_is_said_and_so_is_the_next_wrong_one(sensor: FakeSensor) -> None:
    sensor.expect_rate(200.0)
    t_s, seq = 0.0, 5
    for rate_Hz in (100.0, 200.0, 100.0):
        for _ in range(round(4.5 * rate_Hz)):
            t_s, seq = t_s + 1 / rate_Hz, seq + 1
            sensor.feed.append(sensor.block([seq], after_s=t_s))
    sensor.settle()
    assert ["again" in what for _, what in sensor.health().events] == [False, True, False]
