"""The routine on small fakes: retries, what is steady, what becomes of many poses."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ftcalib.errors import TooFewSamples
from ftcalib.model import Array
from ftcalib.routine import PoseRecord, TourPose, dataset_from, drift_check, take_pose
from ftcalib.sampling import Sampling
from ftdrivers.interfaces import FtSamples


@dataclass
class Reading:
    t_host_ns: int
    q_rad: Array
    R_base_flange: Array


class Cell:
    """An arm whose flange turns with its last joint, and a sensor that feels a weight."""

    def __init__(self) -> None:
        self.log: list[str] = []
        self.q = np.zeros(6)
        self.rng = np.random.default_rng(5)
        self.restless = 0
        self.drifting = 0
        self.fails_at: str | None = None
        self.rate_Hz = 600

    def _did(self, what: str) -> None:
        self.log.append(what)
        if what == self.fails_at:
            raise ConnectionError(what)

    def state(self) -> Reading:
        turn = np.radians(5) if self.restless and "collect" in self.log[-1] else 0.0
        self.restless -= bool(turn)
        R = Rotation.from_euler("xz", [self.q[4], self.q[5] + turn]).as_matrix()
        return Reading(len(self.log), self.q, R)

    def wait_until_still(self, *, timeout_s: float, guard: Callable[[], None]) -> None:
        assert timeout_s > 0
        guard()
        self._did("still")

    def collect(self, duration_s: float) -> FtSamples:
        self._did(f"collect {duration_s}")
        n = int(duration_s * self.rate_Hz)
        slope = np.linspace(-1, 1, n)[:, None] if self.drifting else 0.0
        self.drifting -= bool(self.drifting)
        return FtSamples.of(np.arange(n), np.arange(n), self.rng.normal(0, 0.01, (n, 6)) + slope)

    def check(self) -> None:
        pass


TOUR = [TourPose(number, np.array([0, 0, 0, 0, 0, number], dtype=float)) for number in (1, 2, 3)]
STOPS = [*TOUR, TOUR[0]]


def take(cell: Cell, stop: int = 1, stages: list[str] | None = None, quiet_std: Array | None = None) -> PoseRecord:
    return take_pose(
        cell,
        cell,
        stop,
        STOPS[stop - 1],
        Sampling(average_s=0.5),
        on_stage=(stages if stages is not None else []).append,
        quiet_std=quiet_std,
    )


def test_a_quiet_pose_is_averaged_once() -> None:
    cell, stages = Cell(), list[str]()
    assert take(cell, stages=stages).steady
    assert cell.log == ["still", "collect 0.5"]
    assert stages == ["settle", "sample"]


@pytest.mark.parametrize("fault", ["restless", "drifting"])
def test_a_pose_that_turns_or_drifts_while_averaged_is_averaged_again(fault: str) -> None:
    cell = Cell()
    setattr(cell, fault, 1)
    assert take(cell).steady
    assert cell.log == ["still", "collect 0.5"] * 2


def test_a_pose_that_never_comes_to_rest_is_kept_and_marked() -> None:
    cell, stages = Cell(), list[str]()
    cell.drifting = 3
    assert not take(cell, stages=stages).steady
    assert stages == ["settle", "sample"] * 2


def test_samples_that_scatter_more_than_at_rest_are_not_steady() -> None:
    assert take(Cell(), quiet_std=np.full(6, 0.008)).steady
    assert not take(Cell(), quiet_std=np.full(6, 0.004)).steady


@pytest.mark.parametrize("fails_at", ["still", "collect 0.5"])
def test_a_failure_is_passed_on(fails_at: str) -> None:
    cell = Cell()
    cell.fails_at = fails_at
    with pytest.raises(ConnectionError):
        take(cell)


@pytest.mark.parametrize(("rate_Hz", "averages_s"), [(40, [0.5]), (39, [0.5, 1.0]), (19, [0.5, 1.0, 2.0])])
def test_a_slow_sensor_is_averaged_for_longer(rate_Hz: int, averages_s: list[float]) -> None:
    cell = Cell()
    cell.rate_Hz = rate_Hz
    assert len(take(cell).samples.wrench) == rate_Hz * averages_s[-1]
    assert cell.log == ["still", *(f"collect {average_s}" for average_s in averages_s)]


def test_a_sensor_that_is_too_slow_ends_the_tour() -> None:
    cell = Cell()
    cell.rate_Hz = 9
    with pytest.raises(TooFewSamples, match=r"18 samples in 2\.0 s"):
        take(cell)
    assert cell.log == ["still", "collect 0.5", "collect 1.0", "collect 2.0"]


def test_a_guard_that_trips_at_the_very_end_of_a_pose_discards_it() -> None:
    cell = Cell()

    def guard() -> None:
        if cell.log[-1:] == ["collect 0.5"]:
            raise InterruptedError

    with pytest.raises(InterruptedError):
        take_pose(cell, cell, 1, TOUR[0], Sampling(average_s=0.5), guard=guard)


def test_parts_of_a_run_share_one_clock() -> None:
    """A computer that was switched off between counts its time from nought again."""
    before, after = take(Cell(), 1), take(Cell(), 2)
    resumed = replace(after, clock_offset_ns=5_000_000_000)
    assert dataset_from([before, resumed], {}).t_s == pytest.approx([0, 5])


def test_the_return_serves_the_drift_check_and_stays_out_of_the_dataset() -> None:
    cell = Cell()
    kept = [take(cell, stop) for stop in (1, 2, 3, 4)]
    assert len(dataset_from(kept, {}).wrench) == 3
    drift = drift_check(kept)
    assert drift is not None
    np.testing.assert_array_equal(drift.change, kept[3].mean.mean - kept[0].mean.mean)
    assert drift_check(kept[:3]) is None
