"""Noise of rows in motion: its states, its correlation, and rows made independent, against their definitions."""

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_toeplitz
from scipy.signal import lfilter

from ftcalib.model import Array
from ftcalib.motion.model import FEWEST, RowNoise, _filters, motion_states, places_in_runs

REST, SLOW, QUICK = np.zeros(100), np.linspace(0.1, 0.5, 150), np.linspace(0.6, 2.0, 150)


def kept(count: int) -> NDArray[np.bool_]:
    return np.ones(count, np.bool_)


def test_rest_is_a_state_and_classes_of_speed_have_as_many_rows_each() -> None:
    speed = np.concatenate([REST, SLOW, QUICK])
    assert np.bincount(motion_states(speed, kept(400))).tolist() == [100, 100, 100, 100]
    assert motion_states(speed, kept(400)).tolist() == sorted(motion_states(speed, kept(400)))
    for moving, classes in ((2 * FEWEST - 1, 1), (2 * FEWEST, 2), (3 * FEWEST - 1, 2), (3 * FEWEST, 3)):
        state = motion_states(np.append(REST, np.linspace(0.03, 1, moving)), kept(100 + moving))
        assert np.bincount(state)[0] == 100
        assert state.max() == classes


def test_a_run_ends_at_a_gap() -> None:
    t = np.cumsum([5.0, 0.1, 0.14, 0.1, 0.16, 0.1, 0.4, 0.1, 0.1])
    assert places_in_runs(t, 0.1).tolist() == [0, 1, 2, 3, 0, 1, 0, 1, 2]


def correlated(rng: np.random.Generator, n: int, *poles: float) -> Array:
    """An autoregression, with these coefficients of the rows before."""
    return np.asarray(lfilter([1.0], np.append(1.0, -np.array(poles)), rng.normal(size=n + 100))[100:])


def test_predictors_solve_the_equations_of_yule_and_walker() -> None:
    x = 3.0 * correlated(np.random.default_rng(1), 2000, 0.5, -0.3, 0.4)
    place = np.arange(2000) % 500
    filters = _filters(x, place, bursts=False)
    lags = []
    for lag in range(4):
        pairs = np.concatenate([run[lag:] * run[: len(run) - lag] for run in x.reshape(4, 500)])
        lags.append(pairs.mean())
    r = np.array(lags) / lags[0]
    assert filters.shape == (4, 4)
    for k in range(4):
        a = solve_toeplitz(r[:k], r[1 : k + 1]) if k else np.zeros(0)
        expected = np.append(1.0, -a) / np.sqrt(1 - a @ r[1 : k + 1])
        np.testing.assert_allclose(filters[k], np.pad(expected, (0, 3 - k)), rtol=1e-9)


def test_weak_noise_at_low_frequencies_is_white_in_bursts() -> None:
    rng = np.random.default_rng(3)
    place = np.arange(1000)
    low, high = correlated(rng, 1000, 0.7), correlated(rng, 1000, -0.7)
    assert [len(_filters(x, place, bursts=True)) for x in (low, high)] == [2, 1]
    assert [len(_filters(x, place, bursts=False)) for x in (low, high)] == [2, 2]
    constant = _filters(np.ones(1000), place, bursts=True)[1]
    np.testing.assert_allclose(constant[:2], [1 / np.sqrt(1 - 0.98**2), -0.98 / np.sqrt(1 - 0.98**2)])


def noisy(n: int = 1200) -> tuple[Array, NDArray[np.intp], NDArray[np.intp]]:
    """Rows of two runs in which channels are correlated and the second half is three times as loud; state and place."""
    rng = np.random.default_rng(4)
    white = np.column_stack([correlated(rng, n, 0.6) for _ in range(6)])
    mixed = white @ (np.eye(6) + 0.3 * rng.normal(size=(6, 6))) * np.repeat([1.0, 0.03], 3)
    state, place = np.repeat(np.arange(2, dtype=np.intp), n // 2), np.tile(np.arange(n // 2, dtype=np.intp), 2)
    return mixed * np.array([1.0, 3.0])[state][:, None], state, place


def test_rows_become_independent_and_of_unit_variance() -> None:
    r, state, place = noisy()
    noise = RowNoise.of(r, np.zeros((len(r), 6, 0)), state, place)
    white = noise.whiten(r[:, :, None], state, place)[:, :, 0]
    np.testing.assert_allclose(white.T @ white / len(r), np.eye(6), atol=1e-8)
    assert np.abs(white[1:].T @ white[:-1] / len(r)).max() < 0.15
    assert np.abs(np.mean(white[1:] * white[:-1], axis=0)).max() < 0.1
    common = np.sqrt(np.mean(r**2, axis=0))
    for k in (0, 1):
        unit = (r / common)[state == k]
        groups = np.sqrt([np.mean(unit[:, :3] ** 2), np.mean(unit[:, 3:] ** 2)])
        np.testing.assert_allclose(noise.scale[k], common * np.repeat(groups, 3))


def test_what_a_fit_has_taken_from_the_residuals_counts() -> None:
    """A root of the covariance of the prediction acts as so many more samples of each row."""
    r, state, place = noisy()
    taken = np.stack([0.5 * r, 0.2 * r], axis=2)
    plain, noise = (RowNoise.of(r, some, state, place) for some in (np.zeros((len(r), 6, 0)), taken))
    np.testing.assert_allclose(noise.scale, np.sqrt(1 + 0.5**2 + 0.2**2) * plain.scale)
    white = noise.whiten(r[:, :, None], state, place)[:, :, 0]
    np.testing.assert_allclose(white.T @ white / len(r), np.eye(6) / (1 + 0.5**2 + 0.2**2), atol=1e-8)


def test_few_rows_are_enough() -> None:
    n = 40
    r = np.random.default_rng(5).normal(size=(n, 6))
    noise = RowNoise.of(r, np.zeros((n, 6, 0)), np.zeros(n, np.intp), np.arange(n))
    assert np.isfinite(noise.whiten(r[:, :, None], np.zeros(n, np.intp), np.arange(n))).all()
