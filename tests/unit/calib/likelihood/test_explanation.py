"""When poses stand out, and what it costs to reject them."""

from typing import Any

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation, RotationSpline

from ftcalib.likelihood import explanation
from ftcalib.likelihood.descent import Kept, agreeing_poses, fewest_kept
from ftcalib.likelihood.explanation import _are_gaussian, _criterion, _limit, _stand_out
from ftcalib.likelihood.session import SessionData, inverses
from ftcalib.likelihood.variance_components import FORCE, Component, Point, channel_component, point
from ftcalib.model import Array
from tests.unit.calib.likelihood.sessions import R24, SIGMA_N, SIGMA_NM, TOOL, session

SIGMA = np.repeat([SIGMA_N, SIGMA_NM], 3)


def tour(n: int, residuals: Array | float = 0.0) -> SessionData:
    return session(np.resize(R24, (n, 3, 3)), drift="none", residuals=residuals)


def at(own: SessionData, kept: Kept, components: tuple[Component, ...] = (), theta: tuple[float, ...] = ()) -> Point:
    return point(own.linearise(TOOL, kept), components, np.array(theta))


def usual(n: int) -> Array:
    """Squared distances as Gaussian noise has them."""
    return np.asarray(stats.chi2.ppf((np.arange(n) + 0.5) / n, 6))


def test_a_majority_must_agree() -> None:
    assert [fewest_kept(n) for n in (4, 7, 8, 11, 12, 13, 24)] == [4, 7, 7, 7, 8, 8, 15]


@pytest.mark.parametrize(("bumped", "enough"), [(0, True), (6, True), (9, True), (10, False)])
def test_poses_that_agree_are_found_from_any_minimum(bumped: int, enough: bool) -> None:
    rng = np.random.default_rng(2)
    residuals = SIGMA * rng.normal(size=(24, 6))
    good = np.arange(24) >= bumped
    residuals[~good] += 60 * SIGMA * rng.normal(size=(bumped, 6))
    own = tour(24, residuals)
    away = [TOOL.moved(turn * np.eye(15)[1]) for turn in (3.1, 1.0, 0.0)]
    found = agreeing_poses(own.descent, inverses(own.cov), away)
    assert (found is not None) == enough
    if found is not None:
        np.testing.assert_array_equal(found[1], good)
        only = tour(24, residuals).descent.minima(inverses(own.cov) * good[:, None, None])[0].parameters
        np.testing.assert_allclose(found[0].difference(only), 0, atol=1e-6)


@pytest.mark.parametrize("n", [8, 24])
def test_one_pose_in_fifty_sessions_stands_out_by_chance(n: int) -> None:
    limit = stats.chi2.isf(0.02 / n, 6)
    for far, stands_out in ((0.99 * limit, False), (1.01 * limit, True)):
        assert _stand_out(tour(n), np.append(usual(n)[:-1], far)) == stands_out
    assert not _stand_out(tour(7), np.append(usual(7)[:-1], 1000.0))


@pytest.mark.parametrize(("n", "off", "gaussian"), [(500, 0.98, True), (500, 1.02, False), (499, 0.98, False)])
def test_noise_is_gaussian_where_its_distribution_is(n: int, off: float, gaussian: bool) -> None:
    critical = stats.kstwobign.isf(0.01) / np.sqrt(n)
    share = np.maximum((np.arange(n) + 0.5) / n - off * critical, 1e-12)
    assert _are_gaussian(tour(n), stats.chi2.ppf(share, 6)) == gaussian


@pytest.mark.parametrize("scale", [1.0, 10.0, 30.0])
@pytest.mark.parametrize(("components", "theta"), [((), ()), ((channel_component("white", FORCE),), (0.001,))])
def test_a_rejected_pose_costs_the_limit_and_beyond_it_a_logarithm(
    scale: float, components: tuple[Component, ...], theta: tuple[float, ...]
) -> None:
    """Without a pose the likelihood lacks its density, of which the squared distance is a part."""
    others = np.arange(24) != 7
    residuals = SIGMA * np.random.default_rng(1).normal(size=(24, 6)) * np.where(others, 1.0, scale)[:, None]
    own = tour(24, residuals)
    counts, rejected = at(own, np.ones(24, bool), components, theta), at(own, others, components, theta)
    e, S = counts.left_out()
    distance, limit = float(e[7] @ np.linalg.solve(S[7], e[7])), _limit(own, rejected)
    assert (distance > limit) == (scale > 1)
    gained = _criterion(own, rejected, np.where(others, 6.0, distance)) - _criterion(own, counts, np.full(24, 6.0))
    assert gained == pytest.approx(limit + 6 * np.log(max(distance / limit, 1.0)) - distance, abs=1e-4)


def smooth_tour(n: int, *, bumped: int = 0) -> SessionData:
    """Return poses along a path, whose residuals are a cable's and noise."""
    rng = np.random.default_rng(5)
    corners = Rotation.random(40, rng=rng)
    R = RotationSpline(np.arange(40.0), corners)(np.linspace(0, 39, n)).as_matrix()
    residuals = SIGMA * rng.normal(size=(n, 6)) + 4 * SIGMA * (R.reshape(n, 9) @ rng.normal(size=(9, 6)))
    residuals[:bumped] += 100 * SIGMA
    return session(R, residuals=residuals)


def test_some_of_many_poses_show_errors_that_have_a_structure(monkeypatch: pytest.MonkeyPatch) -> None:
    searched, some = list[int](), SessionData.some

    def counted(own: SessionData, *arguments: Any) -> SessionData:
        chosen = some(own, *arguments)
        searched.append(chosen.n)
        return chosen

    monkeypatch.setattr(SessionData, "some", counted)
    own = smooth_tour(1200, bumped=3)
    found, minima, _ = explanation.explain(own)
    assert set(searched) == {explanation.SEARCHED}
    kinds = {c.kind for c in found.components}
    assert "cable" in kinds
    assert kinds.isdisjoint({"walk", "slope"})
    assert minima[0].settled
    assert set(np.flatnonzero(~found.kept)) >= {0, 1, 2}
    assert found.kept.sum() > 1190


def test_a_thousand_poses_are_all_searched(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(SessionData, "some", lambda *_: pytest.fail("only some poses were searched"))
    rng = np.random.default_rng(6)
    explanation.explain(tour(1000, 2 * SIGMA * rng.normal(size=(1000, 6))))


def test_some_poses_of_a_repeated_tour_have_all_orientations() -> None:
    some = tour(24 * 100).some(300)
    assert some.n == 300
    assert len(np.unique(some.R.round(6), axis=0)) == 24
    assert (np.diff(some.time) > 0).all()
