"""The scale as a user sees it: which number, with what beside it, and what its keys do."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from ftcalib.after.weighing import Weight
from ftdrive.errors import NotAccepted
from ftdrive.live.weighing import WORDS, ScaleState, Weighing
from ftdrive.terminal.weigh_screen import WeighScreen, large
from ftdrivers.errors import StreamBroken
from tests.unit.ftdrive.terminal.fake_stream import INFO
from tests.wire.waiting import wait_until

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
        self.in_zero: Callable[[], object] = lambda: None

    def _states(self, *, raises: bool) -> Iterator[tuple[ScaleState, bool]]:
        assert not raises
        while True:
            yield self.given, False
            if self.fails is not None:
                raise self.fails

    def zero(self) -> None:
        self.zeros += 1
        self.in_zero()
        if self.refuses:
            raise NotAccepted("no zero: the arm moves")


class Scale:
    """The screen of a fake scale, without a thread and a terminal; with `keys` pressed, one after the other."""

    def __init__(self, weighing: FakeWeighing, *keys: str) -> None:
        self.screen, self.states = WeighScreen(weighing), weighing.states()
        next(self.states)
        self.press(*keys)

    def press(self, *keys: str) -> None:
        for key in keys:
            self.screen.press(key)
            next(self.states)
        self.read()

    def read(self) -> list[str]:
        *rows, self.keys = (str(line).strip() for line in self.screen.lines(110, 20))
        self.title, _, _, *self.mass, _, self.sigma, self.line, self.note = rows[:10]
        return self.mass


def mass(text: str) -> list[str]:
    return [row.strip() for row in large(text)]


def test_figures_are_three_rows_high_and_letters_one() -> None:
    assert [row.rstrip() for row in large("-4.06 kg")] == [
        "    █ █   █▀█ █▀▀",
        "▀▀▀ ▀▀█   █ █ █▀█",
        "      ▀ ▀ ▀▀▀ ▀▀▀  kg",
    ]


def test_the_number_ends_where_its_sigma_does() -> None:
    scale = Scale(FakeWeighing(ScaleState(PART, None, 3)))
    assert scale.title == "ftdrive weigh   tool gripper_a   EMULATED"
    assert scale.mass == mass("0.8123 kg")
    assert scale.sigma == "3 parts   sigma 1.2 g, smallest mass 4.8 g"
    assert scale.line == "3 parts, 0.8123 ± 0.0012 kg at (10.0 ± 2.0, -20.0 ± 3.0, 150 ± 100) mm from the sensor origin"
    assert scale.keys == "z zero the empty gripper   p join poses of one load   q quit"
    assert Scale(FakeWeighing(ScaleState(PART, None, 1))).line.startswith("1 part, 0.8123")


def test_a_scale_without_a_zero_asks_for_one() -> None:
    scale = Scale(FakeWeighing(ScaleState(NOTHING, None)))
    assert scale.mass == mass("0.00 kg")  # neither -0 nor another place of the digits
    hint = "   not zeroed: press z with an empty gripper"
    assert scale.sigma == f"sigma 100 g, smallest mass 400 g{hint}"
    assert scale.line == "nothing: -0.00 ± 0.10 kg, less than 0.4 kg"
    assert hint in Scale(FakeWeighing(ScaleState(replace(NOTHING, least_kg=0.101), None))).sigma
    assert hint not in Scale(FakeWeighing(ScaleState(replace(NOTHING, least_kg=0.099), None))).sigma


@pytest.mark.parametrize(
    ("shown", "number", "line"),
    [
        (ScaleState(PART, "contact"), "- - -", f"not weighed: {WORDS['contact']}"),
        (ScaleState(None, "moving"), "- - -", f"not weighed: {WORDS['moving']}"),
        (ScaleState(None, None, stale="[sensor] silent for 0.3 s"), "- - -", "stale: [sensor] silent for 0.3 s"),
        (ScaleState(PART, "count"), "0.8123 kg", f"not weighed: {WORDS['count']}"),
    ],
)
def test_what_is_not_weighed_has_no_number_but_a_mass_that_cannot_be_counted(
    shown: ScaleState, number: str, line: str
) -> None:
    scale = Scale(FakeWeighing(shown))
    assert (scale.mass, scale.line) == (mass(number), line)
    assert scale.sigma == ("sigma 1.2 g, smallest mass 4.8 g" if "kg" in number else "")


def test_poses_are_joined_until_the_key_is_pressed_again() -> None:
    weighing = FakeWeighing(ScaleState(PART, None))
    assert Scale(weighing, "p").sigma.endswith("4.8 g   1 pose joined, turn the tool for more")
    assert weighing.joins
    Scale(weighing, "p")
    assert not weighing.joins


@pytest.mark.parametrize(
    ("refuses", "note"), [(False, "zero: the empty gripper was tared"), (True, "no zero: the arm moves")]
)
def test_a_zero_hides_the_number_of_before(refuses: bool, note: str) -> None:
    weighing = FakeWeighing(ScaleState(PART, None))
    weighing.refuses = refuses
    during = list[str]()
    scale = Scale(weighing)
    weighing.in_zero = lambda: during.extend(scale.read())
    scale.press("z")
    assert weighing.zeros == 1
    assert during == mass("- - -")
    assert scale.note == note


def test_in_motion_neither_zero_nor_poses_are_offered() -> None:
    weighing = FakeWeighing(ScaleState(replace(NOTHING, poses=0, in_motion=True), None), moving=True)
    scale = Scale(weighing, "z", "p")
    assert (weighing.zeros, weighing.joins) == (0, False)
    assert (scale.keys, scale.note) == ("q quit", "")
    assert scale.sigma == "sigma 100 g, smallest mass 400 g"


@pytest.mark.parametrize("error", [StreamBroken("the cable is cut"), OSError(28, "No space left on device")])
def test_what_ends_the_reading_ends_the_screen(error: Exception) -> None:
    """Else the last number would stay, as if it were live."""
    screen = WeighScreen(FakeWeighing(ScaleState(PART, None), fails=error))
    with pytest.raises(type(error)) as raised, screen.reading():
        wait_until(lambda: screen.draw(80, 24) == [])
    assert raised.value is error
