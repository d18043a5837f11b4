"""Replayed recordings: the same numbers, at a chosen speed, with pause, seek and step."""

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ftcalib.errors import BadDataset
from ftdrive.recording.replay import source_of_run
from ftdrive.stream.samples import WrenchFrame
from ftdrive.stream.sources import RecordingSource
from ftdrive.stream.stream import Stream
from tests.fake_clock import FakeClock
from tests.unit.ftdrive.stream.simulated import NOISE, TRUTH, calibrated, dwells, info, paired


def replayed(seconds: float = 4.0, **options: Any) -> tuple[Stream, RecordingSource, FakeClock]:
    clock = FakeClock()
    rows = paired(dwells(1, round(seconds * 1000), seed=1))
    source = RecordingSource(info(calibrated()), rows, clock=clock, speed=options.pop("speed", 1.0))
    return Stream(source, **options).open(), source, clock


@pytest.mark.parametrize("speed", [0.5, 8.0])
def test_speed_scales_the_time(speed: float) -> None:
    stream, source, clock = replayed(0.8)
    source.speed = speed
    begin_s = clock.now_s()
    assert sum(1 for _ in stream) == 800
    assert clock.now_s() - begin_s == pytest.approx(0.8 / speed, rel=0.05)


def test_pause_step_seek_and_resume() -> None:
    stream, source, clock = replayed()
    for _ in range(10):
        stream.read()
    source.toggle()
    at_s = source.at_s
    clock.advance(5.0)
    assert len(stream.read()) == 0
    assert source.at_s == at_s
    source.step()
    assert len(stream.read()) == pytest.approx(10, abs=1)
    assert source.at_s == pytest.approx(at_s + 0.01, abs=2e-3)
    source.seek(3.0)
    source.step()
    assert len(stream.read()) == pytest.approx(10, abs=1)
    source.seek(1.0)
    source.toggle()
    block = stream.read()
    assert block.seq[0] == 1000
    assert len(block) <= 20
    assert source.at_s == pytest.approx(1.01, abs=0.02)
    assert [event.kind for event in stream.take_events()] == []  # a jump is no gap
    assert source.duration_s == pytest.approx(4.0, abs=0.01)
    assert stream.status().sensor.rate_Hz == pytest.approx(1000, rel=0.05)
    with pytest.raises(ValueError, match="positive"):
        source.speed = 0.0


def test_an_empty_recording_is_refused() -> None:
    with pytest.raises(BadDataset, match="no samples"):
        RecordingSource(info(calibrated()), paired(np.empty((0, 3, 3))))


def run_of(poses: int, n: int = 300) -> Any:
    """A guided run of a sensor of 500 Hz; one sample of the second pose was lost."""
    records, rng = [], np.random.default_rng(1)
    for k in range(poses):
        R = dwells(1, n, seed=k)
        seq = 10_000 * k + np.arange(n) + (np.arange(n) > 150) * (k == 1)
        samples = SimpleNamespace(
            t_host_ns=10**12 + k * 20 * 10**9 + np.arange(n) // 4 * 8_000_000,
            t_device_s=np.full(n, np.nan),
            seq=seq,
            status=np.zeros(n, np.uint32),
            wrench=paired(R, seed=k).raw + rng.normal(size=(n, 6)) * 0,
        )
        before = SimpleNamespace(q_rad=np.arange(6.0), R_base_flange=R[0])
        records.append(SimpleNamespace(samples=samples, before=before, clock_offset_ns=7))
    header = {
        "config": {"sensor": {"height_mm": 30.0}, "tool": {"name": "gripper"}},
        "devices": {"arm": {"model": "UR5e", "serial": "A1", "firmware": "5"}},
    }
    return SimpleNamespace(folder=Path("run"), header=lambda: header, records=lambda: records)


def test_the_poses_of_a_run_are_replayed_one_after_the_other() -> None:
    source = source_of_run(run_of(3), calibrated(), "calibration.json")
    source.speed = math.inf
    stream = Stream(source, frame=WrenchFrame("base", "flange")).open()
    blocks = []
    while not stream.has_ended:
        blocks.append(stream.read())
    assert sum(map(len, blocks)) == 900
    assert np.ptp(np.concatenate([block.t_host_ns for block in blocks])) == pytest.approx(1.8e9, rel=0.02)  # no moves
    wrench = np.concatenate([block.wrench for block in blocks])
    assert np.sqrt(np.square(wrench[:, :3]).mean()) == pytest.approx(NOISE[0], rel=0.1)
    assert [(event.kind, event.values["lost"]) for event in stream.take_events() if event.kind == "gap"] == [("gap", 1)]
    assert (stream.info.tool, stream.info.arm.model, stream.info.sensor.model) == ("gripper", "UR5e", "not reported")
    assert np.linalg.norm(TRUTH.gravity_force_base_N) > 10


def test_a_run_without_poses_is_refused() -> None:
    with pytest.raises(BadDataset, match="no pose"):
        source_of_run(run_of(0), calibrated())
