"""The routine on small fakes: order, retries, what is kept when something breaks."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calib.errors import TooFewSamples
from calib.routine import PoseRecord, Progress, Sampling, dataset_from, drift_check, run_tour
from calib.tour import TourPose

Array = NDArray[np.float64]


@dataclass
class Samples:
    wrench: Array
    t_host_ns: NDArray[np.int64] = field(default_factory=lambda: np.arange(300, dtype=np.int64))
    t_device_s: Array = field(default_factory=lambda: np.full(300, np.nan))
    seq: NDArray[np.int64] = field(default_factory=lambda: np.arange(300, dtype=np.int64))
    counts: NDArray[np.int32] = field(default_factory=lambda: np.zeros((300, 0), np.int32))
    status: NDArray[np.uint32] = field(default_factory=lambda: np.zeros(300, np.uint32))


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
        self.samples = 300

    def _did(self, what: str) -> None:
        self.log.append(what)
        if what == self.fails_at:
            raise ConnectionError(what)

    def state(self) -> Reading:
        turn = np.radians(5) if self.restless and "collect" in self.log[-1] else 0.0
        self.restless -= bool(turn)
        R = Rotation.from_euler("xz", [self.q[4], self.q[5] + turn]).as_matrix()
        return Reading(len(self.log), self.q, R)

    def move_to(self, q_rad: Sequence[float], *, timeout_s: float, guard: Callable[[], None]) -> None:
        assert timeout_s > 0
        guard()
        self.q = np.array(q_rad)
        self._did(f"move {q_rad[5]:.0f}")

    def wait_until_still(self, *, timeout_s: float, guard: Callable[[], None]) -> None:
        assert timeout_s > 0
        guard()
        self._did("still")

    def collect(self, duration_s: float) -> Samples:
        self._did(f"collect {duration_s}")
        slope = np.linspace(-1, 1, self.samples)[:, None] if self.drifting else 0.0
        self.drifting -= bool(self.drifting)
        return Samples(self.rng.normal(0, 0.01, (self.samples, 6)) + slope)

    def check(self) -> None:
        pass


TOUR = [TourPose(number, np.array([0, 0, 0, 0, 0, number], dtype=float)) for number in (1, 2, 3)]


def run(cell: Cell, kept: list[PoseRecord]) -> list[Progress]:
    def commit(record: PoseRecord) -> None:
        cell.log.append(f"commit {record.stop}")
        kept.append(record)

    return list(run_tour(cell, cell, TOUR, Sampling(average_s=0.5), commit))


def test_each_pose_is_safe_on_disk_before_the_arm_moves_on() -> None:
    cell, kept = Cell(), list[PoseRecord]()
    progress = run(cell, kept)
    once = ["still", "collect 0.5"]
    expected = [f"move 1|{'|'.join(once)}|commit 1", f"move 2|{'|'.join(once)}|commit 2"]
    expected += [f"move 3|{'|'.join(once)}|commit 3", f"move 1|{'|'.join(once)}|commit 4"]
    assert "|".join(cell.log) == "|".join(expected)
    assert [step.stage for step in progress] == ["moving", "settling", "averaging", "taken"] * 4


def test_a_pose_that_turns_or_drifts_while_averaged_is_averaged_again() -> None:
    for fault in ("restless", "drifting"):
        cell, kept = Cell(), list[PoseRecord]()
        setattr(cell, fault, 1)
        run(cell, kept)
        assert cell.log[:6] == ["move 1", "still", "collect 0.5", "still", "collect 0.5", "commit 1"]
        assert all(record.steady for record in kept)


def test_a_pose_that_never_comes_to_rest_is_kept_and_marked() -> None:
    cell, kept = Cell(), list[PoseRecord]()
    cell.drifting = 3
    run(cell, kept)
    assert cell.log.count("collect 0.5") == 6
    assert [record.steady for record in kept] == [False, True, True, True]


@pytest.mark.parametrize("fails_at", ["move 3", "still", "collect 0.5"])
def test_what_was_committed_before_a_failure_stands(fails_at: str) -> None:
    cell, kept = Cell(), list[PoseRecord]()
    cell.fails_at = fails_at
    with pytest.raises(ConnectionError):
        run(cell, kept)
    assert len(kept) == (2 if fails_at == "move 3" else 0)
    assert not cell.log[-1].startswith("commit")


def test_a_sensor_that_is_too_slow_ends_the_tour_with_a_sentence() -> None:
    cell, kept = Cell(), list[PoseRecord]()
    cell.samples = 7
    with pytest.raises(TooFewSamples, match=r"7 samples in 0\.5 s"):
        run(cell, kept)
    assert kept == []


def test_the_return_serves_the_drift_check_and_stays_out_of_the_dataset() -> None:
    cell, kept = Cell(), list[PoseRecord]()
    run(cell, kept)
    assert len(dataset_from(kept, {}).wrench) == 3
    drift = drift_check(kept)
    assert drift is not None
    np.testing.assert_array_equal(drift.change, kept[3].mean.mean - kept[0].mean.mean)
    assert drift_check(kept[:3]) is None
