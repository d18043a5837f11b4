"""The loop that reads a stream over interruptions: how long it waits, and what it says."""

import math
from types import SimpleNamespace
from typing import Any

import pytest

from ftdrive.live.stream import RECOVER_S, BlockReader
from ftdrivers.errors import DeviceTimeout
from tests.fake_clock import FakeClock

STEP_S = 0.3
"""A read that fails takes so long."""


def reader_of(reads: str, patience_s: float, said: list[str]) -> BlockReader:
    """A reader of a stream whose reads fail at each `x`."""
    clock, left = FakeClock(), iter(reads)

    def read() -> str:
        if (one := next(left)) == "x":
            clock.sleep(STEP_S)
            raise DeviceTimeout("silent")
        return one

    stream: Any = SimpleNamespace(clock=clock, read=read)
    return BlockReader(stream, patience_s, say=said.append, meanwhile="Viewers wait.")


def test_an_interruption_is_said_once_and_so_is_its_end() -> None:
    said: list[str] = []
    reader = reader_of("axxbxc", RECOVER_S, said)
    blocks: list[object] = [reader.read() for _ in range(6)]
    assert blocks == ["a", None, None, "b", None, "c"]
    assert said == ["silent. Viewers wait.", "Samples arrive again."] * 2
    assert reader.failure is None


@pytest.mark.parametrize(("patience_s", "failures"), [(0.0, 1), (1.0, 5)])
def test_a_failure_that_lasts_is_raised(patience_s: float, failures: int) -> None:
    reader = reader_of("a" + "x" * 50, patience_s, [])
    blocks: list[object] = [reader.read() for _ in range(failures)]
    assert blocks == ["a"] + [None] * (failures - 1)
    with pytest.raises(DeviceTimeout):
        reader.read()


def test_without_end_of_patience_nothing_is_raised() -> None:
    reader = reader_of("x" * 50, math.inf, [])
    assert [reader.read() for _ in range(50)] == [None] * 50
