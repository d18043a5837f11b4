"""Verification and a new tool in cells whose errors depend on joints and load."""

import numpy as np
import pytest

from tests.benchmarks.structured_errors import new_tool_run, verify_run

FRESH = [pytest.param(seed, marks=pytest.mark.slow) for seed in range(600, 612)]


@pytest.mark.parametrize("seed", [506, *FRESH])
def test_a_cable_does_not_fail_a_verification_in_poses_that_the_wrist_did_not_reach(seed: int) -> None:
    record = verify_run(seed, "cable", "wrist", "whole")
    found = np.array([record[change] for change in ("20 g", "3 mm", ".5 N")], dtype=np.float64)
    assert not record["alarm"]
    assert (found[np.isfinite(found)] == 1).all()


@pytest.mark.parametrize("seed", [508, *FRESH])
def test_a_heavier_tool_is_not_refused_where_the_response_depends_on_the_load(seed: int) -> None:
    assert not new_tool_run(seed, "load", "wrist")["refused"]
