"""The scale as a user sees it: which number, with what beside it, and what its keys do."""

from collections.abc import Iterator
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from syrupy.assertion import SnapshotAssertion

from ftcalib.after.weighing import Weight
from ftdrive.stream.weighing import WORDS, CannotWeigh, ScaleState, Weighing
from ftdrive.terminal.weigh_screen import WeighScreen, large_figures
from ftdrivers.errors import StreamBroken
from tests.fake_clock import FakeClock
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
    def __init__(self, shown: ScaleState, *, moving: bool = False, fails: Exception | None = None) -> None:
        self.refuses, self.zeroed_s = False, float("inf")
        processor = SimpleNamespace(monitor=SimpleNamespace(reference=lambda: (None, self.zeroed_s)))
        stream: Any = SimpleNamespace(info=replace(INFO, emulated=True), clock=FakeClock(), processor=processor)
        super().__init__(stream, joins=False, part_kg=None, moving=moving)
        self.given, self.fails = shown, fails
        self._scale = cast("Any", SimpleNamespace(zero=self._rest))

    def turns(self) -> Iterator[None]:
        while True:
            self.stream.clock.sleep(0.11)
            self.add(cast("Any", "a block"), ())
            yield
            if self.fails is not None:
                raise self.fails

    def _weighed(self) -> ScaleState:
        return self.given

    def _is_new(self, *_: object) -> bool:
        return False

    def _rest(self, since_ns: int) -> None:
        if self.stream.clock.now_ns() < since_ns + 0.5e9:
            raise CannotWeigh("samples")
        if self.refuses:
            raise CannotWeigh("not-empty")


class Scale:
    """The screen of a fake scale, without a thread and a terminal; with `keys` pressed, one after the other."""

    def __init__(self, weighing: FakeWeighing, *keys: str) -> None:
        self.turns = weighing.turns()
        self.screen = WeighScreen(weighing, self.turns)
        next(self.turns)
        self.press(*keys)

    def press(self, *keys: str) -> None:
        for key in keys:
            self.screen.press(key)
            next(self.turns)
        self.read()

    def read(self) -> list[str]:
        *self.rows, self.keys = (str(line).strip() for line in self.screen.lines(110, 20))
        self.title, _, _, *self.mass, _, self.sigma, self.line, self.note = self.rows[:10]
        return self.mass


def mass(text: str) -> list[str]:
    return [row.strip() for row in large_figures(text)]


@pytest.mark.parametrize(
    ("shown", "moving"),
    [
        pytest.param(ScaleState(PART, None, 3), False, id="parts"),
        pytest.param(ScaleState(NOTHING, None), False, id="no-zero"),
        pytest.param(ScaleState(PART, "contact"), False, id="contact"),
        pytest.param(ScaleState(None, None, stale="[sensor] silent for 0.3 s"), False, id="stale"),
        pytest.param(ScaleState(PART, "count"), False, id="count"),
        pytest.param(ScaleState(replace(NOTHING, poses=0, in_motion=True), None), True, id="in-motion"),
    ],
)
def test_what_the_screen_shows(shown: ScaleState, moving: bool, snapshot: SnapshotAssertion) -> None:
    scale = Scale(FakeWeighing(shown, moving=moving))
    assert "\n".join([*scale.rows, scale.keys]).rstrip() == snapshot


def test_poses_are_joined_until_the_key_is_pressed_again() -> None:
    weighing = FakeWeighing(ScaleState(PART, None))
    assert Scale(weighing, "p").sigma.endswith("4.8 g   1 pose combined, turn the tool for more")
    assert weighing.joins
    Scale(weighing, "p")
    assert not weighing.joins


@pytest.mark.parametrize(
    ("refuses", "note"), [(False, "zero: the empty gripper was tared"), (True, f"zero refused: {WORDS['not-empty']}")]
)
def test_a_zero_hides_the_number_of_before(refuses: bool, note: str) -> None:
    weighing = FakeWeighing(ScaleState(PART, None))
    weighing.refuses = refuses
    scale = Scale(weighing, "z")
    for _ in range(4):
        assert (scale.mass, scale.note) == (mass("- - -"), "zero: waiting for half a second at rest …")
        scale.press("")
    assert not weighing.is_zeroing
    assert str(weighing.refusal or weighing.note) == note
    scale.press("")
    assert (scale.mass, " ".join(scale.rows[9:]).strip()) == (mass("0.8123 kg"), note)


@pytest.mark.parametrize("error", [StreamBroken("the cable is cut"), OSError(28, "No space left on device")])
def test_what_ends_the_reading_ends_the_screen(error: Exception) -> None:
    """Else the last number would stay, as if it were live."""
    screen = Scale(FakeWeighing(ScaleState(PART, None), fails=error)).screen
    with pytest.raises(type(error)) as raised, screen.reading():
        wait_until(lambda: screen.lines(80, 24) == [])
    assert raised.value is error
