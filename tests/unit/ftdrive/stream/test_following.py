"""The tracked bias beside the calibration: shown, written as events, and applied only if that is wanted."""

import numpy as np
import pytest

from ftdrive.stream.processing import Processor
from ftdrive.stream.samples import Tracking
from tests.unit.ftdrive.stream.simulated import calibrated, dwells, info, paired

DRIFTED = np.array([0.2, -0.1, 0.15, 0.004, -0.003, 0.002])


@pytest.mark.parametrize(("track", "left"), [("show", DRIFTED), ("apply", np.zeros(6)), ("off", DRIFTED)])
def test_only_apply_corrects_the_wrench(track: Tracking, left: np.ndarray) -> None:
    processor = Processor(info(calibrated()))
    processor.monitor.track = track
    rows = paired(dwells(1, 6000, seed=2), push=DRIFTED)
    blocks = [processor.process(rows.rows(slice(i, i + 100))) for i in range(0, len(rows), 100)]
    wrench = np.concatenate([block.wrench for block in blocks[-10:]]).mean(axis=0)
    assert wrench == pytest.approx(left, abs=0.02)
    tracked = processor.monitor.tracked
    events = [event for event in processor.take_events() if event.kind == "tracked"]
    if track == "off":
        assert tracked is None
        assert not events
        return
    assert tracked is not None
    assert (np.abs(tracked.bias - DRIFTED) < 4 * tracked.sigma).all()
    assert tracked.part_kg == pytest.approx(0.0, abs=4 * tracked.part_sigma_kg)
    assert 4 <= len(events) <= 6
    assert events[-1].values["last_seen_s"] < 1.0


@pytest.mark.parametrize("seed", [2, 3])
def test_a_contact_without_a_part_is_reported_once(seed: int) -> None:
    processor = Processor(info(calibrated()))
    processor.monitor.track = "show"
    motion = dwells(1, 6000, seed=seed)
    rows = paired(motion)
    rows.raw[3000:3600] += [0, 0, -5.0, 0, 0, 0]
    for i in range(0, len(rows), 100):
        processor.process(rows.rows(slice(i, i + 100)))
    assert len([event for event in processor.take_events() if event.kind == "contact"]) == 1
