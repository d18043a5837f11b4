"""The curve of a sweep: smooth from rest to rest, its derivatives and their bounds."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ftdrivers.sweep import Sweep

CENTRE = (0.1, -1.6, 1.7, -1.6, -1.5, 0.4)
NUMBER = st.floats(0.05, 1.0)


def waves(number: st.SearchStrategy[float]) -> st.SearchStrategy[list[list[float]]]:
    return st.lists(st.lists(number, min_size=2, max_size=2), min_size=3, max_size=3)


SWEEPS = st.builds(
    Sweep, st.just(CENTRE), waves(NUMBER), waves(st.floats(0.2, 6.0)), waves(NUMBER), st.just(10.0), NUMBER
)


@given(SWEEPS)
def test_it_begins_and_ends_at_rest(sweep: Sweep) -> None:
    for t in (0.0, sweep.duration_s):
        assert np.allclose(sweep.at(t), CENTRE)
        assert np.allclose(sweep.at(t, 1), 0)
        assert np.allclose(sweep.at(t, 2), 0, atol=1e-9)
    outside = -0.1, sweep.duration_s + 0.1
    assert np.array_equal(sweep.at(outside), [CENTRE, CENTRE])
    assert not any(sweep.at(outside, order).any() for order in (1, 2, 3))
    assert not np.ptp(sweep.at(np.linspace(0, 10, 50)), axis=0)[:3].any()


@given(SWEEPS, st.integers(1, 3))
def test_derivatives_are_those_of_the_curve(sweep: Sweep, order: int) -> None:
    t, h = np.linspace(0.3, 9.7, 60), 1e-5
    t = t[np.abs(t - sweep.ramp_s) > 2 * h]
    t = t[np.abs(t - sweep.duration_s + sweep.ramp_s) > 2 * h]
    numeric = (sweep.at(t + h, order - 1) - sweep.at(t - h, order - 1)) / (2 * h)
    assert np.allclose(sweep.at(t, order), numeric, rtol=1e-4, atol=1e-4 * (1 + np.abs(numeric).max()))


@given(SWEEPS, st.integers(0, 2))
def test_nothing_exceeds_the_largest_value(sweep: Sweep, order: int) -> None:
    fine = np.abs(sweep.at(np.linspace(0, sweep.duration_s, 6_011), order)).max(axis=0)
    assert (fine <= sweep.largest(order) + 1e-12).all()
    assert (fine[3:] <= sweep.bound(order)[3:] + (np.abs(CENTRE)[3:] if order == 0 else 0)).all()


def test_a_slower_sweep_has_the_same_path() -> None:
    sweep = Sweep(CENTRE, [[0.5, 0.1]] * 3, [[0.6, 3.0]] * 3, [[0.0, 1.0]] * 3, 10.0, 2.0)
    wrist = np.add(CENTRE[3:], 0.5 * np.sin(0.6 * 5) + 0.1 * np.sin(3.0 * 5 + 1.0))  # between the ramps
    assert np.allclose(sweep.at(5.0), [[*CENTRE[:3], *wrist]])
    t = np.linspace(0, 10, 101)
    assert np.allclose(sweep.slower(0.5).at(2 * t), sweep.at(t))
    assert np.allclose(sweep.slower(0.5).largest(1), sweep.largest(1) / 2, rtol=0.05)
    assert np.allclose(Sweep.from_dict(sweep.to_dict()).at(t), sweep.at(t))


@pytest.mark.parametrize("wrong", [{"duration_s": 3.0}, {"centre_rad": CENTRE[:5]}, {"ramp_s": float("nan")}])
def test_an_impossible_sweep_is_refused(wrong: dict[str, object]) -> None:
    good = Sweep(CENTRE, [[0.5, 0.1]] * 3, [[0.6, 3.0]] * 3, [[0.0, 1.0]] * 3, 10.0, 2.0).to_dict()
    assert Sweep.from_dict({**good, "duration_s": 4.0}).ramp_s == 2.0  # up and down at once
    with pytest.raises(ValueError, match=r"sweep|ramps"):
        Sweep.from_dict({**good, **wrong})
