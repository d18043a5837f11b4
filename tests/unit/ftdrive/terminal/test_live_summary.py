"""What the screen keeps: means, extremes, contact; cleared when they would mean something else."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ftcalib import CalibrationDataset
from ftdrive.checks.check import Check
from ftdrive.live.samples import Block, WrenchFrame
from ftdrive.terminal.live_feed import Feed
from ftdrive.terminal.live_view import ShownWrench, Summary, View
from tests.unit.ftdrive.terminal.fake_stream import R_BASE_FLANGE, SIGMA, FakeStream


class Rig:
    """A summary whose stream runs block by block."""

    def __init__(self, stream: FakeStream, dataset: CalibrationDataset | None = None, *checks: Check) -> None:
        self.stream = stream
        self.feed = Feed(stream)
        self.summary = Summary(self.feed, checks, dataset)

    def run(self, blocks: int) -> View:
        for _ in range(blocks):
            self.feed.step()
        return self.summary.view()


def reading_of(view: View) -> ShownWrench:
    assert view.reading is not None
    return view.reading


def test_numbers_are_the_mean_of_the_last_tenth_of_a_second() -> None:
    rig = Rig(FakeStream("contact"))
    rig.run(23)
    news = rig.feed.subscribe()
    for _ in range(10):
        rig.feed.step()
    last = list(news.blocks)
    view = rig.summary.view()
    np.testing.assert_allclose(reading_of(view).wrench, np.concatenate([block.wrench for block in last]).mean(axis=0))
    np.testing.assert_allclose(reading_of(view).raw, np.concatenate([block.raw for block in last]).mean(axis=0))


def test_the_result_does_not_depend_on_when_it_is_drawn() -> None:
    often, seldom = (Rig(FakeStream("contact", block_s=0.05)) for _ in range(2))
    for _ in range(80):
        often.run(3)
    a, b = often.run(1), seldom.run(241)
    np.testing.assert_allclose(reading_of(a).wrench, reading_of(b).wrench)
    np.testing.assert_array_equal(a.peaks.low, b.peaks.low)
    np.testing.assert_array_equal(a.columns(100).high, b.columns(100).high)
    assert a.contact_s == pytest.approx(b.contact_s)


def test_peaks_are_of_single_samples_until_they_are_reset() -> None:
    rig = Rig(FakeStream(block_s=0.05))
    view = rig.run(124)  # a push of 8 N
    assert view.peaks.high[2] == pytest.approx(7.8, abs=0.3)
    assert view.peaks.force_N == pytest.approx(8.1, abs=0.2)
    rig.summary.reset_peaks()
    assert rig.run(10).peaks.high[2] < 7 * SIGMA[0]


def test_contact_lasts_from_its_first_sample() -> None:
    view = Rig(FakeStream("contact", block_s=0.05)).run(240)
    assert view.contact_s == pytest.approx(12.0 - 11.604, abs=0.005)


@pytest.mark.parametrize(
    ("change", "keeps_history"),
    [
        (lambda stream: setattr(stream, "frame", WrenchFrame()), False),
        (lambda stream: setattr(stream, "stages", replace(stream.stages, gravity=False)), True),
    ],
)
def test_extremes_of_another_frame_or_stage_are_forgotten(
    change: Callable[[FakeStream], None], keeps_history: bool
) -> None:
    rig = Rig(FakeStream(block_s=0.05))
    rig.run(124)
    change(rig.stream)
    view = rig.run(1)
    assert reading_of(view).frame == rig.stream.frame
    assert np.ptp([view.peaks.low, view.peaks.high], axis=0).max() < 12 * SIGMA[0]
    assert np.isfinite(view.columns(100).low[:, 50]).all() == keeps_history


def test_a_frozen_screen_stands_still() -> None:
    rig = Rig(FakeStream(block_s=0.05))
    before = rig.run(20)
    rig.summary.is_frozen = True
    after = rig.run(120)
    assert reading_of(after).t_host_ns == reading_of(before).t_host_ns
    assert after.is_frozen
    rig.summary.is_frozen = False
    assert reading_of(rig.run(1)).t_host_ns == rig.stream.now_ns


def test_old_numbers_are_named_silent_with_their_device() -> None:
    view = Rig(FakeStream(silent_after=50)).run(51)
    assert view.silent == "ATI Mini45: no sample for 0.31 s"


def dataset(noise: float) -> CalibrationDataset:
    """Twelve poses of 1000 samples with white noise of this factor of `SIGMA`."""
    cov = np.tile(np.diag((noise * SIGMA) ** 2 / 1000), (12, 1, 1))
    R = np.tile(R_BASE_FLANGE, (12, 1, 1))
    return CalibrationDataset(R, np.zeros((12, 6)), cov, np.full(12, 1000), np.full(12, np.nan))


@pytest.mark.parametrize(("noise", "state"), [(1.0, "ok"), (0.25, "warning")])
def test_the_noise_is_compared_once_with_that_of_the_calibration(noise: float, state: str) -> None:
    rig = Rig(FakeStream(), dataset(noise))
    for _ in range(30):
        view = rig.run(10)
    assert [(check.name, check.state) for check in view.checks] == [("noise.change", state)]
    assert len(view.notes) == (state == "warning")


def test_noise_is_not_judged_while_the_arm_moves() -> None:
    class Moving(FakeStream):
        def read(self) -> Block:
            turn = Rotation.from_rotvec([0.0, 0.0, 0.01 * self.blocks]).as_matrix()
            block = super().read()
            return replace(block, R_base_flange=block.R_base_flange @ turn, raw=block.raw * 10)

    rig = Rig(Moving(), dataset(1.0))
    for _ in range(30):
        view = rig.run(10)
    assert not view.checks


def test_an_event_that_repeats_is_one_line() -> None:
    rig = Rig(FakeStream())
    for text in ("a", "b", "b", "b"):
        rig.feed.note(text)
    view = rig.run(1)
    assert [(note.text, note.times) for note in view.notes] == [("b", 3), ("a", 1)]


def test_a_failed_check_is_among_the_events() -> None:
    check = Check("calibration.devices", "failed", "the calibration was made with the sensor A", "ftdrive calibrate")
    view = Rig(FakeStream(), None, check).run(1)
    assert view.notes[0].text == "the calibration was made with the sensor A. Fix: ftdrive calibrate"
