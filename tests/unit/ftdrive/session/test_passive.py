"""A passive calibration: it ends by itself, by a key, or after its time, and its run solves again."""

from collections.abc import Iterator, Mapping
from concurrent.futures import Executor, Future
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from ftcalib import Setup
from ftdrive.errors import Declined
from ftdrive.runs import source
from ftdrive.runs.motion import MotionRecording, files_of
from ftdrive.runs.run import Run
from ftdrive.runs.source import Circumstances
from ftdrive.session.events import Key
from ftdrive.session.open_session import Journal, OpenCell
from ftdrive.session.passive import record_passively
from ftdrivers.errors import StreamBroken
from ftdrivers.interfaces import ArmStates, FtSamples
from tests.fake_clock import FakeClock
from tests.moving_load import Recorded, Truth, programme, record

SECONDS = 25.0
STEP_S = 2.0


def recording(contacts: Mapping[tuple[float, float], Any] | None = None) -> Recorded:
    return record(Truth(vibrates_at_rest=False), programme(1, SECONDS)[0], SECONDS, 1, contacts=contacts)


@pytest.fixture(scope="module")
def free() -> Recorded:
    return recording()


class FakeCell:
    """Sensor, arm and journal of a free tool that a program moves."""

    def __init__(self, recorded: Recorded, *, stop_s: float = np.inf, lost_s: float = np.inf) -> None:
        self.clock, self.shown, self._stop_s, self._lost_s = FakeClock(), list[Any](), stop_s, lost_s
        nothing = np.zeros((len(recorded.t_pose_s), 6))
        start_ns = self._start_ns = self.clock.now_ns()
        self._samples = FtSamples.of(
            start_ns + (1e9 * recorded.t_s).astype(np.int64), np.arange(len(recorded.t_s)), recorded.wrench
        )
        t_ns = start_ns + (1e9 * recorded.t_pose_s).astype(np.int64)
        self._states = ArmStates(
            t_ns, recorded.t_pose_s, nothing, nothing, recorded.R_base_flange, recorded.p_base_flange_m
        )
        health = SimpleNamespace(nominal_rate_Hz=500.0)
        self.sensor = SimpleNamespace(
            follow=lambda: self._follow(self._samples, STEP_S), health=lambda: health, temperature_C=lambda: None
        )
        self.arm = SimpleNamespace(follow=lambda: self._follow(self._states, 0.0))
        operator: Any = SimpleNamespace(pressed=self._pressed, pressed_by="the operator", show=self.shown.append)
        self.journal = Journal(operator)

    @contextmanager
    def _follow(self, rows: Any, step_s: float) -> Iterator[Any]:
        before = [self._start_ns]

        def read(_: float) -> Any:
            self.clock.sleep(step_s)
            if (self.clock.now_ns() - self._start_ns) * 1e-9 > self._lost_s:
                raise StreamBroken("sensor: it was unplugged", "check its plug")
            now_ns = self.clock.now_ns()
            since, until = np.searchsorted(rows.t_host_ns, [before[0], now_ns])
            before[0] = now_ns
            return type(rows)(*(getattr(rows, name)[since:until] for name in rows.__slots__))

        yield SimpleNamespace(read=read)

    def _pressed(self) -> Key | None:
        return Key.STOP if (self.clock.now_ns() - self._start_ns) * 1e-9 >= self._stop_s else None

    def note(self, words: str, *, warning: bool = False) -> None:
        del warning
        self.shown.append(words)


class AtOnce(Executor):
    """Fits in the thread that asks, because a fake clock waits for no other."""

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        future.set_result(fn(*args, **kwargs))
        return future


def passively(cell: Any, folder: Path, seconds: float) -> Run:
    run = Run.create(folder, "passive", {"mode": "passive"})
    record_passively(cell, run, seconds, Setup(), 9.80665, AtOnce())
    return run


@pytest.mark.slow
def test_it_ends_by_itself_when_the_result_is_good(free: Recorded, tmp_path: Path) -> None:
    cell = FakeCell(free)
    run = passively(cell, tmp_path, SECONDS)
    duration_s = cell.shown[-1].duration_s
    assert 10 < duration_s < SECONDS - 2 * STEP_S
    parts = map(MotionRecording.load, files_of(run.motion_path))
    assert sum(len(one.samples) for one in parts) == pytest.approx(500 * duration_s, rel=0.05)


def test_q_and_the_time_end_it_and_too_little_is_not_kept(free: Recorded, tmp_path: Path) -> None:
    by_key, by_time = FakeCell(free, stop_s=6.0), FakeCell(free)
    assert passively(by_key, tmp_path, SECONDS).in_motion
    assert by_key.shown[-1].duration_s == pytest.approx(6.0, abs=STEP_S)
    assert "stopped by the operator" in by_key.shown
    passively(by_time, tmp_path, 6.0)
    assert by_time.shown[-1].duration_s == pytest.approx(6.0, abs=STEP_S)
    with pytest.raises(Declined, match="record 10 s"):
        passively(FakeCell(free, stop_s=2.0), tmp_path, SECONDS)


@pytest.mark.slow
def test_what_was_recorded_before_a_failure_is_kept_and_solved(
    free: Recorded, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A device that is lost is named at its first silence; after the longest one the recording ends."""
    cell = FakeCell(free, lost_s=13.0)
    run = Run.create(tmp_path, "passive", {"mode": "passive"})
    with pytest.raises(StreamBroken, match="unplugged"):
        record_passively(cast(OpenCell, cell), run, 60.0, Setup(), 9.80665, AtOnce())
    *_, fit, lost, kept = [getattr(one, "words", one) for one in cell.shown]
    assert fit.startswith("10 s")  # and no fit after the loss
    assert "unplugged" in lost
    assert run.solve_command in kept
    assert MotionRecording.load(files_of(run.motion_path)[-1]).samples.seq[-1] >= 500 * (13.0 - STEP_S) - 1
    monkeypatch.setattr(source, "circumstances_of", lambda _: Circumstances(9.80665, Setup(), {}))
    assert source.solve_in_motion(run).verdict in {"good", "usable"}


@pytest.mark.slow
def test_a_touch_below_that_of_a_guard_is_left_out_of_the_result(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    touches = {(start, start + 2.0): np.array([1.0, 0.0, -0.8, 0.0, 0.05, 0.0]) for start in np.arange(4.0, 25.0, 7.0)}
    run = passively(FakeCell(recording(touches)), tmp_path, SECONDS)
    monkeypatch.setattr(source, "circumstances_of", lambda _: Circumstances(9.80665, Setup(), {}))
    found = source.solve_in_motion(run)
    assert found.verdict == "good"
    assert found.motion is not None
    assert found.motion.contacts
    assert float(np.linalg.norm(found.gravity_force_base_N - Truth().mass_kg * Truth().gravity_m_s2)) < 0.02
