"""What the model of a stream keeps: means, extremes, contact, and the recent past in memory of fixed size."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ftcalib import CalibrationDataset
from ftdrive.checks.check import Check
from ftdrive.stream.feed import History
from ftdrive.stream.samples import Block, WrenchFrame
from ftdrive.words.stream import ShownWrench, StreamSummary, View
from tests.unit.ftdrive.terminal.fake_stream import R_BASE_FLANGE, SIGMA, FakeStream, SteppedFeed

MS = 1_000_000
BEGIN_NS = 5_000_000_000_000


class Rig:
    def __init__(self, stream: FakeStream, dataset: CalibrationDataset | None = None, *checks: Check) -> None:
        self.stream = stream
        self.feed = SteppedFeed(stream)
        self.summary = StreamSummary(self.feed, checks, dataset)

    def run(self, blocks: int) -> View:
        self.feed.step(blocks)
        return self.summary.view()


def reading_of(view: View) -> ShownWrench:
    assert view.reading is not None
    return view.reading


def test_numbers_are_the_mean_of_the_last_tenth_of_a_second() -> None:
    rig = Rig(FakeStream("contact"))
    rig.run(23)
    last, _ = rig.feed.subscribe()
    rig.feed.step(10)
    view = rig.summary.view()
    np.testing.assert_allclose(reading_of(view).wrench, np.concatenate([block.wrench for block in last]).mean(axis=0))
    np.testing.assert_allclose(reading_of(view).raw, np.concatenate([block.raw for block in last]).mean(axis=0))


def test_a_recording_that_goes_back_between_two_drawings_leaves_nothing_in_the_mean() -> None:
    rig = Rig(FakeStream("contact", block_s=0.05))
    rig.feed.step(240)  # in contact, with 5 N
    rig.stream.blocks = 20
    reading = reading_of(rig.run(1))
    assert not reading.in_contact
    assert np.abs(reading.wrench).max() < SIGMA[0]


def test_peaks_are_of_single_samples_until_they_are_reset() -> None:
    rig = Rig(FakeStream(block_s=0.05))
    view = rig.run(124)  # a push of 8 N
    assert view.peaks.high[2] == pytest.approx(7.8, abs=0.3)
    assert view.peaks.sizes[0] == pytest.approx(8.1, abs=0.2)
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


def test_numbers_are_not_live_while_nothing_reads_the_stream() -> None:
    rig = Rig(FakeStream())
    assert not rig.run(1).silent
    rig.feed.turned_ns -= 3_000_000_000
    assert "no samples read for 3 s" in rig.summary.view().silent


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


def filled(span_s: float, duration_s: float, rate_Hz: int, block: int = 7) -> tuple[History, np.ndarray, np.ndarray]:
    n = round(duration_s * rate_Hz)
    t_ns = BEGIN_NS + np.arange(n) * (1_000_000_000 // rate_Hz)
    wrench = np.random.default_rng(1).normal(size=(n, 6))
    history = History(span_s)
    for i in range(0, n, block):
        rows = slice(i, i + block)
        history.add(t_ns[rows], wrench[rows], wrench[rows, 0] > 2.5)
    return history, t_ns, wrench


@pytest.mark.parametrize("n", [28, 146, 200])
def test_each_column_has_the_extremes_of_its_own_time(n: int) -> None:
    history, t_ns, wrench = filled(2.0, 5.0, 1000)
    columns = history.columns(int(t_ns[-1]), n, (int(t_ns[-1]), 0))
    assert columns.span_s == pytest.approx(2.0, rel=0.2)
    for column in range(n):
        start_ns = columns.start_ns + column * columns.column_ns
        inside = wrench[(t_ns >= start_ns) & (t_ns < start_ns + columns.column_ns)]
        np.testing.assert_array_equal(columns.low[:, column], inside.min(axis=0))
        np.testing.assert_array_equal(columns.high[:, column], inside.max(axis=0))
        assert columns.in_contact[column] == (inside[:, 0] > 2.5).any()
    assert columns.marks == {n - 1}


def test_a_column_does_not_change_when_time_goes_on() -> None:
    history, t_ns, _ = filled(2.0, 3.0, 1000)
    before = history.columns(int(t_ns[-1]), 100)
    later_ns = int(t_ns[-1]) + 3 * before.column_ns
    history.add(np.array([later_ns]), np.full((1, 6), 50.0), np.array([False]))
    after = history.columns(later_ns, 100)
    assert after.start_ns == before.start_ns + 3 * before.column_ns
    np.testing.assert_array_equal(after.low[:, :96], before.low[:, 3:99])


def test_what_was_not_sampled_stays_empty() -> None:
    history, t_ns, _ = filled(10.0, 1.0, 1000)
    columns = history.columns(int(t_ns[-1]), 100)
    assert np.isnan(columns.low[:, :85]).all()
    assert np.isfinite(columns.high[:, -8:]).all()
    history.clear()
    assert np.isnan(history.columns(int(t_ns[-1]), 100).low).all()


def test_a_recording_that_goes_back_shows_what_was_there() -> None:
    history, t_ns, wrench = filled(2.0, 3.0, 1000)
    then = history.columns(int(t_ns[2500]), 100)
    rows = slice(2384, 2501)
    history.add(t_ns[rows], wrench[rows], wrench[rows, 0] > 2.5)
    again = history.columns(int(t_ns[2500]), 100)
    np.testing.assert_array_equal(then.high[:, :-1], again.high[:, :-1])


def test_memory_is_flat() -> None:
    history, t_ns, _ = filled(2.0, 1.0, 1000)
    size = sum(value.nbytes for value in vars(history).values() if isinstance(value, np.ndarray))
    for k in range(1, 50):
        history.add(t_ns + k * 1000 * MS, np.zeros((len(t_ns), 6)), np.zeros(len(t_ns), np.bool_))
    assert size == sum(value.nbytes for value in vars(history).values() if isinstance(value, np.ndarray)) < 250_000
