"""Verification and a new tool in cells whose errors depend on joints and load."""

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ftcalib import CalibrationDataset, CalibrationResult, NotObservable, mean_and_covariance, solve
from ftcalib.after.new_tool import new_tool
from ftcalib.after.verification import verify_calibration
from tests.structured_cell import CELLS, Cell, Load, flange, postures, tour, unit

Array = NDArray[np.float64]

PAUSE_S = 60.0
EVIDENT_SIGMAS = 8.0
"""A change of a reading by more predicted standard deviations must be found."""


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


def failed_verifications(seed: int, name: str) -> dict[str, bool]:
    """Verify the unchanged cell ("") and evident changes of it in six poses of the whole workspace."""
    cell, data, result, end_s = calibrated(seed, name)
    rng = np.random.default_rng([seed, 11])
    q = postures(rng, 6, "whole")
    load, R = cell.load, flange(q)
    loads: Mapping[str, Load] = {
        "20 g": load.with_part(0.02, load.p_sensor_com_m),
        "3 mm": replace(load, p_sensor_com_m=load.p_sensor_com_m + 3e-3 * unit(rng)),
    }

    def means(part: Load | None) -> tuple[Array, Array]:
        at_rest = [mean_and_covariance(dwell) for dwell in cell.dwells(q, end_s + PAUSE_S, load=part, kind=4)[1]]
        return np.array([dwell.mean for dwell in at_rest]), np.array([dwell.covariance for dwell in at_rest])

    y, cov = means(None)
    changed = {name: means(part)[0] for name, part in loads.items()} | {".5 N": y + np.r_[0.5 * unit(rng), 0, 0, 0]}
    unchanged = verify_calibration(result, R, y, cov, fitted=data)
    return {"": not unchanged.passed} | {
        change: not verify_calibration(result, R, other, cov, fitted=data).passed
        for change, other in changed.items()
        if np.abs((other - y) / unchanged.predicted_sigma).max() >= EVIDENT_SIGMAS
    }


def refuses_a_heavier_tool(seed: int, name: str) -> bool:
    """Solve four poses of another tool in the unchanged cell with the earlier result."""
    cell, _, earlier, end_s = calibrated(seed, name)
    rng = np.random.default_rng([seed, 31])
    tool, q = Load.drawn(rng), tour(rng, 4, "wrist")
    data = dataset(q, *cell.dwells(q, end_s + PAUSE_S, load=tool, kind=5))
    try:
        new_tool(earlier, data)
    except NotObservable:
        return True
    return False


def test_a_cable_does_not_fail_a_verification_in_poses_that_the_wrist_did_not_reach() -> None:
    assert not failed_verifications(506, "cable")[""]


def test_a_heavier_tool_is_accepted_where_the_response_depends_on_the_load() -> None:
    assert not refuses_a_heavier_tool(508, "load")
