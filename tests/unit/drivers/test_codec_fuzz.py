"""A small share of tests/benchmarks/fuzz.py: every codec refuses what it does not know, and nothing else happens."""

import pytest

from tests.benchmarks.fuzz import KEPT_BYTES, Target, fuzz, targets


@pytest.mark.parametrize("target", targets(), ids=lambda target: target.name)
def test_only_documented_exceptions(target: Target) -> None:
    outcome = fuzz(target, 100, seed=2, batch=50)
    assert not outcome.undocumented
    assert outcome.kept_bytes < KEPT_BYTES
    assert outcome.refused < outcome.inputs  # some golden frames stay as they are


def test_an_undocumented_exception_is_found() -> None:
    outcome = fuzz(Target("careless", lambda data: data[12], bytes(13)), 1000)
    assert "IndexError" in outcome.undocumented
    assert not outcome.passed
