"""What `ftdrive weigh` prints without a screen: each new weight once, or the one that was asked for."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
from click.testing import CliRunner

from ftdrive.cli import cli
from ftdrive.commands.options import SourceOptions
from ftdrive.stream.weighing import CannotWeigh, ScaleState
from tests.fake_clock import FakeClock
from tests.unit.ftdrive.terminal.fake_stream import INFO
from tests.unit.ftdrive.terminal.test_weigh_screen import PART

EMPTY = ScaleState(replace(PART, mass_kg=0.001), None)
ONE, TWO = ScaleState(PART, None), ScaleState(replace(PART, mass_kg=0.3, poses=2), None)
CABLE, MOVING = ScaleState(PART, "cable"), ScaleState(None, "moving")


class Scale:
    """A scale that shows one state after the other, each second."""

    def __init__(self, *states: tuple[ScaleState, bool]) -> None:
        self.stream = SimpleNamespace(clock=FakeClock(), info=replace(INFO, emulated=True))
        self._states: Sequence[tuple[ScaleState, bool]] = states
        self.zeros, self.is_zeroing, self.refusal = 0, False, None

    def request_zero(self) -> None:
        self.zeros += 1

    def turns(self) -> Iterator[None]:
        for shown, is_new in self._states:
            self.stream.clock.sleep(1.0)
            self.shown, self.is_new = shown, is_new
            yield

    def given_up(self, shown: ScaleState) -> CannotWeigh:
        return CannotWeigh(shown.refusal or "samples")


def weighed(scale: Scale, monkeypatch: pytest.MonkeyPatch, *options: str) -> tuple[dict[str, Any], str]:
    opened: dict[str, Any] = {}

    def open_(_source: object, _stack: object, _frame: object, track: str) -> Any:
        opened["track"] = track
        return scale.stream

    def weighing(_stream: object, **named: Any) -> Any:
        opened.update(named)
        return scale

    def pump(*_: object, patience_s: float) -> Any:
        assert (patience_s == 0.0) == ("--once" in options)
        return scale.turns()

    monkeypatch.setattr(SourceOptions, "open", open_)
    monkeypatch.setattr(SourceOptions, "open_log", lambda *_: None)
    monkeypatch.setattr("ftdrive.commands.weigh.Weighing", weighing)
    monkeypatch.setattr("ftdrive.commands.weigh.pump", pump)
    outcome = CliRunner().invoke(cli, ["weigh", "--simulate", *options])
    if outcome.exception is not None:
        raise outcome.exception
    return opened, outcome.stdout


def test_once_gives_up_after_ten_seconds_unless_it_waits_for_a_part(monkeypatch: pytest.MonkeyPatch) -> None:
    late = [(MOVING, False)] * 10
    assert weighed(Scale(*late[:-1], (ONE, True)), monkeypatch, "--once")[1]
    with pytest.raises(CannotWeigh) as error:
        weighed(Scale(*late, (MOVING, False), (ONE, True)), monkeypatch, "--once")
    assert error.value.code == "moving"
    for options in (("--once", "--zero"), ()):
        assert weighed(Scale(*late, (MOVING, False), (ONE, True)), monkeypatch, *options)[1]


def test_json_has_the_weight_and_why_there_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    scale = Scale((replace(ONE, count=3), True), (CABLE, True))
    weight, refused = map(json.loads, weighed(scale, monkeypatch, "--json")[1].splitlines())
    assert (weight["schema_version"], weight["mass_kg"], weight["count"], weight["refused"]) == (1, 0.81234, 3, None)
    assert weight["calibration_id"] == INFO.calibration.id
    assert weight["marks"] == ["EMULATED"]
    assert (refused["refused"], refused["mass_kg"]) == ("cable", 0.81234)


def test_in_motion_one_answer_to_a_part_is_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    carried = [
        (ScaleState(replace(one, poses=0, in_motion=True), None), True) for one in (replace(PART, mass_kg=0.001), PART)
    ]
    opened, out = weighed(Scale(*carried), monkeypatch, "--moving", "--once", "--count", "0.4")
    assert (opened["track"], opened["moving"], opened["joins"], opened["part_kg"]) == ("show", True, False, 0.4)
    assert out.startswith("0.8123 ")


def test_a_zero_comes_first_and_then_a_part_is_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    scale = Scale((EMPTY, True), (ONE, True), (TWO, True))
    opened, out = weighed(scale, monkeypatch, "--zero", "--once", "--poses", "2")
    assert (opened["track"], opened["moving"], opened["joins"], scale.zeros) == ("off", False, True, 1)
    assert out.startswith("0.3000 ")
    opened, out = weighed(Scale((EMPTY, True)), monkeypatch, "--once")
    assert (opened["joins"], out.startswith("nothing: ")) == (False, True)
