"""The recent past: extremes per column, aligned to the clock, in memory of fixed size."""

import numpy as np
import pytest

from ftdrive.terminal.live_view import History

MS = 1_000_000
START_NS = 5_000_000_000_000


def filled(span_s: float, duration_s: float, rate_Hz: int, block: int = 7) -> tuple[History, np.ndarray, np.ndarray]:
    """A history fed in blocks, with the samples themselves."""
    n = round(duration_s * rate_Hz)
    t_ns = START_NS + np.arange(n) * (1_000_000_000 // rate_Hz)
    wrench = np.random.default_rng(1).normal(size=(n, 6))
    history = History(span_s)
    for i in range(0, n, block):
        rows = slice(i, i + block)
        history.add(t_ns[rows], wrench[rows], wrench[rows, 0] > 2.5)
    return history, t_ns, wrench


@pytest.mark.parametrize("n", [28, 146, 200])
def test_each_column_has_the_extremes_of_its_own_time(n: int) -> None:
    history, t_ns, wrench = filled(2.0, 5.0, 1000)
    columns = history.columns(int(t_ns[-1]), n)
    assert columns.span_s == pytest.approx(2.0, rel=0.2)
    for column in range(n):
        start_ns = columns.start_ns + column * columns.column_ns
        inside = wrench[(t_ns >= start_ns) & (t_ns < start_ns + columns.column_ns)]
        np.testing.assert_array_equal(columns.low[:, column], inside.min(axis=0))
        np.testing.assert_array_equal(columns.high[:, column], inside.max(axis=0))
        assert columns.in_contact[column] == (inside[:, 0] > 2.5).any()
    assert columns.column_of(int(t_ns[-1])) == n - 1


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
