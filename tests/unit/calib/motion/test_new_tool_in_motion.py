"""A new tool from a short recording in motion: mounting, base and gain are those of an earlier result."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ftcalib import CalibrationDataset, CalibrationResult, solve
from ftcalib.errors import NotObservable
from ftcalib.model import Parameters, predict
from ftcalib.motion.solve import solve_motion
from ftcalib.sensor_matrix import CROSS_TALK_M, GAIN
from tests.moving_load import Truth, means_of, record, sweep

SECONDS = 6.0
OLD = Truth()
NEW = replace(OLD, mass_kg=0.7, p_sensor_com_m=np.array([-0.02, 0.01, 0.11]), bias=OLD.bias + 0.4)


def earlier_of(truth: Truth) -> CalibrationResult:
    rng, sigma = np.random.default_rng(3), np.repeat([0.05, 0.002], 3) / 20
    R = Rotation.random(24, rng=rng).as_matrix()
    wrench = predict(Parameters(**truth.to_dict()), R)
    weight = wrench[:, :3] - truth.bias[:3]
    wrench += np.hstack([weight @ truth.gain, weight @ truth.cross_talk_m]) + sigma * rng.normal(size=(24, 6))
    covariance = np.tile(np.diag(sigma**2), (24, 1, 1))
    return solve(CalibrationDataset(R, wrench, covariance, np.zeros(24, np.int64), np.full(24, np.nan)))


@pytest.fixture(scope="module")
def earlier() -> CalibrationResult:
    return earlier_of(OLD)


def swept(truth: Truth, earlier: CalibrationResult | None) -> CalibrationResult:
    return solve_motion(*means_of(record(truth, sweep(SECONDS), SECONDS, 5, rates_Hz=(250.0, 250.0))), earlier=earlier)


def test_an_earlier_result_adds_what_it_knows(earlier: CalibrationResult) -> None:
    alone, joined = swept(NEW, None), swept(NEW, earlier)
    e = Parameters(**NEW.to_dict()).difference(joined.parameters)
    assert np.abs(e / np.sqrt(np.diag(joined.covariance))).max() < 4
    sigmas = [np.sqrt(np.diag(one.covariance)) for one in (alone, joined, earlier)]
    assert (sigmas[1] <= 1.01 * sigmas[0]).all()
    assert (sigmas[1][:3] <= 1.01 * sigmas[2][:3]).all()  # mounting
    assert joined.provenance["parent"] == {"id": earlier.id}
    assert "earlier_cell" in [one.code for one in joined.findings]
    assert CalibrationResult.from_dict(joined.to_dict()).id == joined.id


@pytest.mark.slow
def test_gain_and_cross_talk_are_kept() -> None:
    rng = np.random.default_rng(1)
    gain, cross_talk_m = (np.tensordot(0.02 * rng.normal(size=len(basis)), basis, 1) for basis in (GAIN, CROSS_TALK_M))
    response: dict[str, Any] = {"gain": gain, "cross_talk_m": cross_talk_m}
    found = swept(replace(NEW, **response), earlier_of(replace(OLD, **response))).response
    assert found is not None
    assert np.abs((found.force_gain - gain) / found.sigma["force_gain"]).max() < 4


@pytest.mark.slow
def test_what_holds_no_more_is_named(earlier: CalibrationResult) -> None:
    gravity_m_s2 = Rotation.from_rotvec([2, 0, 0], degrees=True).apply(OLD.gravity_m_s2)
    with pytest.raises(NotObservable, match="the base has tilted, by 2°"):
        swept(replace(NEW, gravity_m_s2=gravity_m_s2), earlier)
