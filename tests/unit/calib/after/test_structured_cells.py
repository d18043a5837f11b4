"""Verification and a new tool in cells whose errors depend on joints and load."""

import numpy as np
import pytest

from tests.benchmarks.structured_errors import new_tool_run, verify_run

FRESH = range(601, 604)
CHANGES = ("20 g", "3 mm", ".5 N")


def test_a_cable_does_not_fail_a_verification_in_poses_that_the_wrist_did_not_reach() -> None:
    record = verify_run(506, "cable", "wrist", "whole")
    assert not record["alarm"]


@pytest.mark.slow
def test_under_a_cable_changes_are_found_and_nothing_else() -> None:
    records = [verify_run(seed, "cable", "wrist", "whole") for seed in FRESH]
    assert not any(record["alarm"] for record in records)
    found = np.array([[record[change] for change in CHANGES] for record in records], dtype=np.float64)
    assert np.nanmean(found) > 0.85


def test_a_heavier_tool_is_accepted_where_the_response_depends_on_the_load() -> None:
    assert not new_tool_run(508, "load", "wrist")["refused"]


@pytest.mark.slow
def test_few_heavier_tools_are_refused_where_the_response_depends_on_the_load() -> None:
    assert np.mean([bool(new_tool_run(seed, "load", "wrist")["refused"]) for seed in FRESH]) < 0.25
