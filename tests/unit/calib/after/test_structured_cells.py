"""Verification and a new tool in cells whose errors depend on joints and load."""

from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from ftcalib import CalibrationDataset, CalibrationResult, mean_and_covariance, solve
from ftcalib.after.new_tool import new_tool
from ftcalib.after.verification import verify_calibration
from tests.structured_cell import CELLS, Cell, Load, flange, postures, tour

Array = NDArray[np.float64]

PAUSE_S = 60.0


def dataset(q: Array, t_s: Array, samples: Array) -> CalibrationDataset:
    means = [mean_and_covariance(dwell) for dwell in samples]
    return CalibrationDataset.of(
        flange(q),
        [dwell.mean for dwell in means],
        wrench_cov=[dwell.covariance for dwell in means],
        n_samples=samples.shape[1],
        t_s=t_s,
    )


class Session(NamedTuple):
    cell: Cell
    data: CalibrationDataset
    result: CalibrationResult
    end_s: float


def calibrated(seed: int, name: str) -> Session:
    """Calibrate with 24 poses that turn the wrist only."""
    cell = Cell([seed], CELLS[name])
    q = tour(np.random.default_rng([seed, 1]), 24, "wrist")
    t, samples = cell.dwells(q, 0.0)
    data = dataset(q, t, samples)
    result = solve(data)
    assert result.verdict != "rejected"
    return Session(cell, data, result, float(t[-1]))


@pytest.mark.slow
def test_a_cable_does_not_fail_a_verification_in_poses_that_the_wrist_did_not_reach() -> None:
    cell, data, result, end_s = calibrated(506, "cable")
    q = postures(np.random.default_rng([506, 11]), 6, "whole")
    at_rest = [mean_and_covariance(dwell) for dwell in cell.dwells(q, end_s + PAUSE_S, kind=4)[1]]
    y, cov = (np.array(part) for part in zip(*((dwell.mean, dwell.covariance) for dwell in at_rest), strict=True))
    assert verify_calibration(result, flange(q), y, cov, fitted=data).passed


@pytest.mark.slow
def test_a_heavier_tool_is_accepted_where_the_response_depends_on_the_load() -> None:
    """Of four poses of another tool in the unchanged cell."""
    cell, _, earlier, end_s = calibrated(508, "load")
    rng = np.random.default_rng([508, 31])
    tool, q = Load.drawn(rng), tour(rng, 4, "wrist")
    new_tool(earlier, dataset(q, *cell.dwells(q, end_s + PAUSE_S, load=tool, kind=5)))
