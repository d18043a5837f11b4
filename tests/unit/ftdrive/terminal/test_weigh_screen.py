"""The scale as a user sees it: which number, with what beside it, and what its keys do."""

import asyncio
import threading
from collections.abc import Iterator
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from textual.widgets import Digits, Static

from ftcalib.after.weighing import Weight
from ftdrive.errors import NotAccepted
from ftdrive.live.weighing import WORDS, ScaleState, Weighing, line_of
from ftdrive.terminal.weigh_screen import WeighApp, run_weigh
from ftdrivers.errors import StreamBroken
from tests.unit.ftdrive.terminal.fake_stream import INFO

COM_SIGMA_M = np.array([0.002, 0.003, 0.1])
PART = Weight(
    mass_kg=0.81234,
    mass_sigma_kg=0.0012,
    least_kg=0.0048,
    p_sensor_com_m=np.array([0.01, -0.02, 0.15]),
    com_covariance=np.diag(COM_SIGMA_M**2),
    line=np.array([0.0, 0.0, 1.0]),
    fault=None,
    chi2=1.0,
    dof=2,
    poses=1,
)
NOTHING = replace(PART, mass_kg=-0.00021, mass_sigma_kg=0.1, least_kg=0.4)


class FakeWeighing(Weighing):
    """A scale that stays in the state it is given."""

    def __init__(self, shown: ScaleState, *, moving: bool = False, fails: Exception | None = None) -> None:
        self.stream = cast("Any", SimpleNamespace(info=replace(INFO, emulated=True)))
        self.given, self.moving, self.joins, self.fails = shown, moving, False, fails
        self.zeros = 0
        self.refuses = False
        self.in_zero, self.may_zero = threading.Event(), threading.Event()
        self.ends = threading.Event()

    def _states(self, *, raises: bool) -> Iterator[tuple[ScaleState, bool]]:
        assert not raises
        while not self.ends.wait(0.001):
            yield self.given, False
            if self.fails is not None:
                raise self.fails

    def zero(self) -> None:
        self.in_zero.set()
        assert self.may_zero.wait(10)
        self.zeros += 1
        if self.refuses:
            raise NotAccepted("no zero: the arm moves")


class Scale:
    """The screen of a fake scale; with `keys` pressed, one after the other."""

    def __init__(self, weighing: FakeWeighing, *keys: str) -> None:
        self.weighing = weighing
        self.app = WeighApp(cast("Any", weighing))
        asyncio.run(self._run(keys))

    async def _run(self, keys: tuple[str, ...]) -> None:
        async with self.app.run_test(size=(90, 20)) as pilot:
            for key in keys:
                await pilot.press(key)
                if self.weighing._zero_requested or self.weighing.in_zero.is_set():
                    assert self.weighing.in_zero.wait(10)
                    self._read()
                    self.during_zero = self.mass
                    self.weighing.may_zero.set()
                    while not self.weighing.note.startswith(("zero: the", "no zero")):
                        await pilot.pause(0.001)
            while self.weighing.shown != self.weighing.given:
                await pilot.pause(0.001)
            self._read()
            self.weighing.ends.set()
            self.app.reader.join()

    def _read(self) -> None:
        self.app.draw()
        self.mass = self.app.query_one(Digits).value
        self.title, self.sigma, self.line, self.note, self.keys = (str(one.content) for one in self.app.query(Static))


def test_a_screen_that_closes_is_not_drawn_any_more() -> None:
    Scale(FakeWeighing(ScaleState(PART, None))).app.draw()


def test_the_number_ends_where_its_sigma_does() -> None:
    scale = Scale(FakeWeighing(ScaleState(PART, None, 3)))
    assert scale.title == "ftdrive weigh   tool gripper_a   EMULATED"
    assert scale.mass == " 0.8123 kg"
    assert scale.sigma == "3 parts   sigma 1.2 g, smallest mass 4.8 g"
    assert scale.line == "3 parts, 0.8123 ± 0.0012 kg at (10.0 ± 2.0, -20.0 ± 3.0, 150 ± 100) mm from the sensor origin"
    assert scale.keys == "z zero the empty gripper   p join poses of one load   q quit"


def test_a_scale_without_a_zero_asks_for_one() -> None:
    scale = Scale(FakeWeighing(ScaleState(NOTHING, None)))
    assert scale.mass == " 0.00 kg"  # neither -0 nor another place of the digits
    hint = "   not zeroed: press z with an empty gripper"
    assert scale.sigma == f"sigma 100 g, smallest mass 400 g{hint}"
    assert scale.line == "nothing: -0.00 ± 0.10 kg, less than 0.4 kg"
    assert hint in Scale(FakeWeighing(ScaleState(replace(NOTHING, least_kg=0.101), None))).sigma
    assert hint not in Scale(FakeWeighing(ScaleState(replace(NOTHING, least_kg=0.099), None))).sigma


@pytest.mark.parametrize(
    ("shown", "line"),
    [
        (ScaleState(PART, "contact"), f"not weighed: {WORDS['contact']}"),
        (ScaleState(None, "moving"), f"not weighed: {WORDS['moving']}"),
        (ScaleState(None, None, stale="[sensor] silent for 0.3 s"), "stale: [sensor] silent for 0.3 s"),
    ],
)
def test_what_is_not_weighed_has_no_number(shown: ScaleState, line: str) -> None:
    scale = Scale(FakeWeighing(shown))
    assert (scale.mass, scale.sigma, scale.line) == ("- - -", "", line)


def test_what_cannot_be_counted_has_a_mass() -> None:
    scale = Scale(FakeWeighing(ScaleState(PART, "count")))
    assert (scale.mass, scale.sigma) == (" 0.8123 kg", "sigma 1.2 g, smallest mass 4.8 g")
    assert scale.line == f"not weighed: {WORDS['count']}"


def test_poses_are_joined_until_the_key_is_pressed_again() -> None:
    scale = Scale(FakeWeighing(ScaleState(PART, None)), "p")
    assert scale.weighing.joins
    assert scale.sigma.endswith("4.8 g   1 pose joined, turn the tool for more")
    assert not Scale(FakeWeighing(ScaleState(PART, None)), "p", "p").weighing.joins


@pytest.mark.parametrize(
    ("refuses", "note"), [(False, "zero: the empty gripper was tared"), (True, "no zero: the arm moves")]
)
def test_a_zero_hides_the_number_of_before(refuses: bool, note: str) -> None:
    weighing = FakeWeighing(ScaleState(PART, None))
    weighing.refuses = refuses
    scale = Scale(weighing, "z")
    assert weighing.zeros == 1
    assert scale.during_zero == "- - -"
    assert scale.note == note


def test_in_motion_neither_zero_nor_poses_are_offered() -> None:
    weighing = FakeWeighing(ScaleState(replace(NOTHING, poses=0, in_motion=True), None), moving=True)
    scale = Scale(weighing, "z", "p")
    assert (weighing.zeros, weighing.joins) == (0, False)
    assert (scale.keys, scale.note) == ("q quit", "")
    assert scale.sigma == "sigma 100 g, smallest mass 400 g"


@pytest.mark.parametrize("error", [StreamBroken("the cable is cut"), OSError(28, "No space left on device")])
def test_what_ends_the_reading_ends_the_screen(error: Exception, monkeypatch: pytest.MonkeyPatch) -> None:
    """Else the last number would stay, as if it were live."""
    weighing, run = FakeWeighing(ScaleState(PART, None), fails=error), WeighApp.run
    monkeypatch.setattr(WeighApp, "run", lambda app: run(app, headless=True))
    with pytest.raises(type(error)) as raised:
        run_weigh(cast("Any", weighing))
    assert raised.value is error


@pytest.mark.parametrize("key", ["q", "ctrl+c"])
def test_two_keys_end_it(key: str) -> None:
    async def main() -> bool:
        weighing = FakeWeighing(ScaleState(PART, None))
        app = WeighApp(cast("Any", weighing))
        async with app.run_test() as pilot:
            await pilot.press(key)
            weighing.ends.set()
            return app._exit

    assert asyncio.run(main())


def test_one_part_is_no_plural() -> None:
    assert line_of(ScaleState(PART, None, 1)).startswith("1 part, 0.8123")
