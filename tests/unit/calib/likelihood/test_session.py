"""A session before the fit: what is open, what is exact, and which components the data may show."""

import numpy as np
import pytest
from numpy.typing import NDArray

from ftcalib.likelihood.descent import Minimum
from ftcalib.likelihood.session import SessionData
from ftcalib.likelihood.session_noise import pose_times
from ftcalib.likelihood.variance_components import RESPONSE, Component
from ftcalib.model import Array, predict
from tests.unit.calib.likelihood.sessions import NOTHING_KNOWN, R24, TOOL, session


def minimum(information: Array) -> Minimum:
    return Minimum(TOOL, 0.0, information)


def names(components: list[Component]) -> set[str]:
    return {one.name for one in components}


@pytest.mark.parametrize(("left", "lacks"), [(1.8e-9, True), (2.2e-9, False)])
def test_directions_are_open_whatever_their_units(left: float, lacks: bool) -> None:
    alike = np.eye(15)
    alike[3, 7] = alike[7, 3] = 1 - left  # eigenvalues `left` and 2 - `left`
    units = 10.0 ** np.arange(-7, 8)
    assert session(R24).lacks_rank(minimum(alike * np.outer(units, units))) == lacks


@pytest.mark.parametrize(("share", "exact"), [(0.9, True), (1.1, False)])
@pytest.mark.parametrize(("channel", "resolution"), [(1, 1e-3), (4, 2.5e-5)])
def test_data_are_exact_to_what_a_sensor_resolves_and_to_rounding(
    share: float, exact: bool, channel: int, resolution: float
) -> None:
    def is_exact(size: float, *, measured: bool) -> bool:
        residuals = np.zeros((24, 6))
        residuals[7, channel] = -share * size
        return session(R24, measured=measured, residuals=residuals).is_exact(TOOL)

    group = slice(0, 3) if channel < 3 else slice(3, 6)
    assert is_exact(resolution, measured=False) == exact
    assert is_exact(1e-10 * np.abs(predict(TOOL, R24)[:, group]).max(), measured=True) == exact


@pytest.mark.parametrize("order", [np.arange(24), np.random.default_rng(0).permutation(24)])
def test_poses_are_taken_in_the_order_of_time(order: NDArray[np.intp]) -> None:
    t_s = np.arange(24.0)[order] * 3 + 100
    cov = np.eye(6) * (1 + order)[:, None, None]
    own = SessionData(R24[order], predict(TOOL, R24)[order], cov, t_s, "auto", NOTHING_KNOWN)
    np.testing.assert_array_equal(own.R, R24)
    np.testing.assert_array_equal(own.wrench, predict(TOOL, R24))
    np.testing.assert_array_equal(own.cov[:, 0, 0], np.arange(1.0, 25))
    np.testing.assert_allclose(own.time, np.arange(24))


def test_time_counts_in_mean_intervals() -> None:
    np.testing.assert_array_equal(pose_times(np.full(4, 7.0)), np.arange(4))
    np.testing.assert_array_equal(pose_times(np.array([2.0, np.nan, 3.0])), np.arange(3))
    np.testing.assert_allclose(pose_times(np.array([8.0, 2.0, 4.0])), [2, 0, 2 / 3])


GAINS = {one.name for one in RESPONSE}
WHITES, WALKS = {"white_force_N", "white_torque_Nm"}, {"walk_force_N", "walk_torque_Nm"}


@pytest.mark.parametrize(
    ("n", "candidates"),
    [
        (5, set()),
        (6, {*WHITES, "rotation_rad", *WALKS}),
        (7, {*WHITES, "rotation_rad", *WALKS}),
        (11, {*WHITES, "rotation_rad", *WALKS}),
        (12, {*GAINS, *WHITES, "rotation_rad", *WALKS, "hysteresis"}),
        (49, {*GAINS, *WHITES, "rotation_rad", *WALKS, "hysteresis"}),
    ],
)
def test_poses_show_what_so_many_can_separate(n: int, candidates: set[str]) -> None:
    R = np.resize(R24, (n, 3, 3))
    few = GAINS if n < 12 else set()  # gain and cross-talk are assumed
    assert names(session(R).always()) == few
    assert names(session(R).candidates()) == candidates
    assert names(session(R, drift="none").candidates()) == candidates - WALKS
    assert names(session(R, drift="linear").candidates()) == candidates - WALKS
    walking = session(R, drift="random-walk")
    assert (names(walking.always()), names(walking.candidates())) == (WALKS | few, candidates - WALKS)
    unknown = session(R, measured=False)
    assert names(unknown.always()) == few | (WHITES if n > 5 else {"white_force_N"})
    late = {"rotation_rad", *WALKS} if n < 12 else set()
    assert names(unknown.candidates()) == candidates - WHITES - late
    if n == 5:
        assert unknown.always()[0].share == pytest.approx((1, 1, 1, 0.025**2, 0.025**2, 0.025**2))


def test_from_fifty_poses_on_each_axis_walks_by_itself() -> None:
    axes = {f"walk_{axis}" for axis in ("fx_N", "fy_N", "fz_N", "tx_Nm", "ty_Nm", "tz_Nm")}
    found = names(session(np.resize(R24, (50, 3, 3))).candidates())
    assert axes <= found
    assert not WALKS & found
