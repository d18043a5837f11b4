"""The service for a program: which registers it writes, and how it answers."""

import threading
from collections.abc import Mapping
from typing import Any, cast

import numpy as np
import pytest

from ftdrive.servers.program import INTEGERS, ProgramService, doubles_of
from ftdrive.stream.samples import WrenchFrame
from ftdrivers.errors import StreamBroken
from tests.unit.ftdrive.stream.simulated import calibrated, info, replayed
from tests.unit.ftdrive.stream.test_weighing import NOTHING, POSE, part, rests
from tests.wire.waiting import wait_until

WEIGH, ZERO, STATUS = 1, 2, 3


class FakeRegisters:
    def __init__(self) -> None:
        self.request: tuple[int, int] | None = (5, WEIGH)
        """Of a program before."""
        self.written: list[dict[str, float]] = []
        self.broken = False
        self.names = INTEGERS + doubles_of("off")

    def write(self, integers: list[int], doubles: list[float]) -> None:
        if self.broken:
            raise StreamBroken("the cable is cut")
        self.written.append(dict(zip(self.names, [*integers, *doubles], strict=True)))

    def close(self) -> None:
        pass


class FakeLog:
    def __init__(self) -> None:
        self.kept: list[float | str] = []

    def keep(self, values: Mapping[str, Any]) -> None:
        self.kept.append(values["refused"] if "refused" in values else round(values["mass_kg"], 2))


class Cell:
    def __init__(self, *each: Any, seconds: float = 1.0) -> None:
        self.stream = replayed(
            info(calibrated()), rests(*each, seconds=seconds), frame=WrenchFrame("base", "tcp"), speed=float("inf")
        )
        self.registers: Any = FakeRegisters()
        self.said: list[str] = []
        self.log = FakeLog()
        self.is_off = False
        self.service = ProgramService(self.stream, self.connect, self.said.append, self.log.keep)

    def connect(self) -> Any:
        if self.is_off:
            raise StreamBroken("still off")
        return self.registers

    def run(self, seconds: float) -> dict[str, float]:
        n = 0
        while n < round(1000 * seconds) and not self.stream.has_ended:
            block = self.stream.read()
            n += len(block)
            self.service.add(block, [])
        return cast("dict[str, float]", self.registers.written[-1])

    def ask(self, number: int, command: int, seconds: float = 0.7) -> dict[str, float]:
        self.registers.request = number, command
        return self.run(seconds)


def test_a_request_is_answered_once_and_an_old_one_never() -> None:
    cell = Cell((POSE, NOTHING))
    first = cell.run(0.1)
    assert (first["state"], first["number"], first["mass"]) == (1, 5, 0), "that of a program before"
    assert cell.ask(6, STATUS, 0.02)["number"] == 6
    assert cell.ask(7, 99, 0.02)["code"] == 9
    busy = cell.ask(8, WEIGH, 0.3)
    assert (busy["state"], busy["number"], busy["code"]) == (2, 8, 0)
    done = cell.run(0.3)
    assert (done["state"], done["number"], done["code"], done["mass"]) == (1, 8, 0, 0)
    assert 0 < done["least_mass"] < 1.0
    lives = [one["live"] for one in cell.registers.written]
    assert np.diff(lives).tolist() == [1] * (len(lives) - 1)


@pytest.mark.slow
def test_a_cycle_weighs_the_part_and_takes_it_out_of_the_wrench() -> None:
    cell = Cell((POSE, NOTHING), (POSE, part(POSE, 0.8)), (POSE, part(POSE, 0.8)), (POSE, NOTHING))
    cell.run(0.2)
    assert cell.ask(6, ZERO)["state"] == 1
    loaded = cell.run(0.3)
    assert loaded["condition"] == 2
    assert loaded["fz"] == pytest.approx(-0.8 * 9.80665, abs=0.5)
    weighed = cell.ask(7, WEIGH)
    assert weighed["mass"] == pytest.approx(0.8, abs=4 * weighed["mass_sigma"])
    assert weighed["mass_sigma"] < 2e-3
    carried = cell.run(0.8)
    assert carried["condition"] == 0
    assert np.linalg.norm([carried[name] for name in ("fx", "fy", "fz")]) < 0.5
    released = cell.run(0.5)
    assert released["condition"] == 2
    assert released["fz"] > 6
    assert cell.ask(8, WEIGH)["mass"] == 0
    assert cell.run(0.2)["condition"] == 0
    assert [event.kind for event in cell.stream.take_events()].count("load") == 2


def test_a_zero_with_a_part_is_refused() -> None:
    cell = Cell((POSE, part(POSE, 2.0)))
    cell.run(0.1)
    assert cell.ask(6, ZERO, 0.8)["code"] == 8


@pytest.mark.slow
def test_the_tracked_bias_ages_while_a_contact_hides_it() -> None:
    drifted = np.array([0.4, -0.3, 0.2, 0, 0, 0])
    cell = Cell((POSE, drifted), (POSE, drifted + np.array([5.0, 8.0, 0, 0, 0, 0])), seconds=1.5)
    assert cell.run(0.1)["tracking"] == 0
    cell.stream.track = "show"
    cell.registers.names = INTEGERS + doubles_of("show")
    new = cell.run(0.1)
    assert (new["tracking"], new["bias_age"], new["bias_fx"]) == (1, -1, 0), "not seen yet"
    seen = cell.run(1.2)
    assert 0 <= seen["bias_age"] < 1
    assert [seen["bias_fx"], seen["bias_fy"], seen["bias_fz"]] == pytest.approx(drifted[:3], abs=0.1)
    hidden = cell.run(1.3)
    assert hidden["bias_age"] > 1
    assert hidden["bias_fy"] == pytest.approx(-0.3, abs=0.1)


def test_a_program_sees_that_the_service_has_ended() -> None:
    cell = Cell((POSE, NOTHING))
    cell.run(0.1)
    closed: list[bool] = []
    cell.registers.close = lambda: closed.append(True)
    cell.service.end()
    last = cell.registers.written[-1]
    assert (last["state"], last["condition"], closed) == (0, 3, [True])


class WatchedClock:
    def __init__(self, newest_ns: int) -> None:
        self.newest_ns, self.age_s, self.looks = newest_ns, 0.04, 0

    def now_ns(self) -> int:
        self.looks += 1
        return self.newest_ns + round(self.age_s * 1e9)


def test_a_wrench_without_new_samples_is_stale_and_a_lost_controller_is_called_again() -> None:
    cell = Cell((POSE, NOTHING))
    block = cell.stream.read()
    cell.service.add(block, [])
    cell.stream.source.clock = clock = cast("Any", WatchedClock(int(block.t_host_ns[-1])))
    cell.service.begin(cell.stream)
    wait_until(lambda: clock.looks > 3)
    assert [one["condition"] for one in cell.registers.written] == [0]
    clock.age_s = 0.06
    wait_until(lambda: len(cell.registers.written) > 1)
    looks = clock.looks
    wait_until(lambda: clock.looks > looks + 3)
    assert [one["condition"] for one in cell.registers.written] == [0, 3], "once"
    cell.is_off = cell.registers.broken = True
    cell.service.add(cell.stream.read(), [])
    cell.service.add(cell.stream.read(), [])
    assert cell.said == ["the cable is cut. Trying again."], "without registers nothing is written"
    cell.is_off = cell.registers.broken = False
    wait_until(lambda: cell.said[-1] == "The controller answers again.")
    cell.service.end()
    assert cell.registers.written[-1]["state"] == 0


@pytest.mark.slow
def test_a_push_is_a_contact_and_its_weight_is_refused() -> None:
    cell = Cell(*[(POSE, NOTHING)] * 3, (POSE, np.array([5.0, 8.0, 0, 0, 0, 0])))
    cell.run(0.2)
    cell.ask(6, ZERO)
    cell.run(2.2)
    pushed = cell.ask(7, WEIGH, 0.8)
    assert (pushed["condition"], pushed["state"], pushed["code"], pushed["mass"]) == (1, 3, 4, 0)


class Unsteady:
    def __init__(self, stream: Any, *reads: Any) -> None:
        self.stream, self.reads, self.taken = stream, list(reads), 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)

    def read(self) -> Any:
        if not self.reads:
            raise KeyboardInterrupt
        found = self.reads.pop(0)
        if isinstance(found, Exception):
            raise found
        return found

    def take_events(self) -> list[Any]:
        self.taken += 1
        return []


def test_a_silent_stream_is_reported_once_and_its_return_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ftdrive.servers.program.WEIGH_S", 0.0)
    cell = Cell((POSE, NOTHING))
    blocks = [cell.stream.read() for _ in range(3)]
    broken = StreamBroken("no sample for 0.3 s")
    unsteady = Unsteady(cell.stream, broken, broken, *blocks[:2], broken, blocks[2])
    service = ProgramService(cast("Any", unsteady), cell.connect, cell.said.append)
    with pytest.raises(KeyboardInterrupt):
        service.run()
    lost, again = "no sample for 0.3 s. The program sees a stale wrench.", "Samples arrive again."
    assert cell.said == [lost, again, lost, again]
    assert unsteady.taken == 7, "else they would pile up"
    live = [one["live"] for one in cell.registers.written if one["condition"] != 3]
    assert (live, cell.registers.written[-1]["state"]) == ([1, 2, 3], 0)


def test_ctrl_c_ends_the_service_while_it_starts_and_says_nothing_of_a_controller_that_has_ended(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Interrupted(threading.Thread):
        def start(self) -> None:
            super().start()
            raise KeyboardInterrupt

    monkeypatch.setattr("ftdrive.servers.program.threading.Thread", Interrupted)
    cell = Cell((POSE, NOTHING))
    cell.registers.broken = True
    threads = threading.active_count()
    with pytest.raises(KeyboardInterrupt):
        cell.service.run()
    assert threading.active_count() == threads
    assert cell.said == []
