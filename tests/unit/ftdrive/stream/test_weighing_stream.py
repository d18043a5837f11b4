"""What the scale keeps: each part once, and each lasting fault once."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from ftdrive.stream.stream import pump
from ftdrive.stream.weighing import Weighing
from tests.fake_clock import FakeClock
from tests.unit.ftdrive.servers.test_program import FakeLog
from tests.unit.ftdrive.stream.simulated import calibrated, info, replayed
from tests.unit.ftdrive.stream.test_weighing import NOTHING, POSE, part, rests

CABLE = np.array([0, 0, 0, 0, 0, 3.0])


class Bench:
    """A scale on a recording of rests in one pose, on a fake clock."""

    def __init__(self, *wrenches: Any) -> None:
        rows = rests(*((POSE, wrench) for wrench in wrenches), seconds=1.8)
        clock = FakeClock()
        rows = replace(rows, t_host_ns=rows.t_host_ns - rows.t_host_ns[0] + clock.now_ns())
        self.stream = replayed(info(calibrated()), rows, clock=clock)
        self.log = FakeLog()
        self.weighing = Weighing(self.stream, joins=False, part_kg=None, keep=self.log.keep)


@pytest.mark.slow
def test_each_part_and_each_fault_is_kept_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ftdrive.stream.sources.STEP_S", 0.05)
    bench = Bench(part(POSE, 0.8), NOTHING, part(POSE, 0.3) + CABLE)
    for _ in pump(bench.stream, [bench.weighing]):
        pass
    assert [one for one in bench.log.kept if isinstance(one, str)] == ["cable"]
    assert [one for one in bench.log.kept if not isinstance(one, str)] == pytest.approx([0.8, 0.0], abs=0.1)


def test_a_weight_that_was_waited_for_in_vain_is_kept() -> None:
    bench = Bench(NOTHING)
    assert bench.weighing.given_up(bench.weighing.shown).code == "samples"
    assert bench.log.kept == ["samples"]
