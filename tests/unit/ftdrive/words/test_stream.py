"""What the model of a stream keeps: means, extremes, what is silent, and the noise."""

import numpy as np
import pytest

from ftcalib import CalibrationDataset
from ftdrive.checks.check import Check
from ftdrive.stream.feed import History
from ftdrive.words.stream import ShownWrench, StreamSummary, View
from tests.unit.ftdrive.terminal.fake_stream import R_BASE_FLANGE, SIGMA, FakeStream, SteppedFeed

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
