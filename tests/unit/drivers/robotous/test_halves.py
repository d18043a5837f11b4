"""Which halves of a Robotous sensor on CAN are believed to be one sample: none that may be of two."""

import random
from collections.abc import Callable, Iterable
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ftdrivers.robotous.can import Halves, RobotousCan
from tests.fake_clock import FakeClock

PERIOD_S = 0.005
Half = tuple[float, int, bool]
"""When it can be received, of which sample it is, and whether it is the second."""


MANY = [f"F{number} S{number}" for number in range(200)]


def data(number: int) -> bytes:
    return bytes([0x0B]) + number.to_bytes(2, "big") + bytes(5)


def halves(pattern: str, period_s: float = PERIOD_S, *, begin: int = 0) -> list[Half]:
    """Halves such as ``F0 S0 F1 S1``, each when its sample is due or with the half before it, if that is later."""
    out: list[Half] = []
    for word in pattern.split():
        number = begin + int(word[1:])
        t_s = 1 + number * period_s + (1.3e-4 if word[0] == "S" else 0)
        out.append((max([t_s, *[half[0] + 1e-5 for half in out[-1:]]]), number, word[0] == "S"))
    return out


def heard(link: Halves, sent: Iterable[Half], late_s: Iterable[float] = ()) -> list[tuple[int, int, int]]:
    """Receive halves as a host does, by whom some are taken late; (number, sample, sample) of every field believed.

    The two samples are those of its first and of its second half.
    """
    now_s, fields, late = 0.0, [], iter(late_s)
    for t_s, number, second in sent:
        while not link.quiet and t_s > now_s + link.silence_s:
            now_s += link.silence_s
            fields += link.silence()
        now_s = max(now_s, t_s) + next(late, 0.0) + 2e-5
        link.take(round(now_s * 1e9), data(number), second=second)
    fields += link.silence()
    return [
        (field.number, int.from_bytes(field.data[1:3], "big"), int.from_bytes(field.data[9:11], "big"))
        for field in fields
    ]


def in_step() -> Halves:
    """Pairing that has heard of samples 0 and 1, which it needs to set its clock."""
    link = Halves(PERIOD_S)
    assert heard(link, halves(" ".join(MANY[:2]))) == []
    return link


def whole(samples: Iterable[int]) -> list[tuple[int, int, int]]:
    """Halves that belong together; the third sample of a stream is its number 1."""
    return [(sample - 1, sample, sample) for sample in samples]


@pytest.mark.parametrize(
    ("pattern", "believed"),
    [
        ("F0 S0 F1 S1 F2 S3 F4 S4 F5 S5", [0, 1, 4, 5]),  # two losses, and what is left takes turns
        ("F0 S0 F1 S1 F3 S3 F4 S4", [0, 1, 4]),  # one as a whole: it might have been two halves
        ("F0 S0 F1 S1 F2 F3 S3 F4 S4 F5 S5", [0, 1, 5]),
        ("F0 S0 F1 S1 S2 F3 S3 F4 S4", [0, 1, 4]),
        ("F0 S0 F1 F2 S1 S2 F3 S3 F4 S4", [0, 4]),  # changed places
        ("F0 S0 F1 S1 S1 F2 S2 F3 S3", [0, 3]),  # twice: a foreign half would look the same
        ("S0 F1 S1 F2 S2", [2]),
    ],
)
def test_what_is_out_of_turn_or_short_of_the_clock_is_thrown_away(pattern: str, believed: list[int]) -> None:
    got = heard(in_step(), halves(pattern, begin=2))
    assert [(first - 2, second - 2) for _, first, second in got] == [(number, number) for number in believed]


@given(
    loss=st.floats(0, 0.4),
    swaps=st.floats(0, 0.4),
    seed=st.integers(0, 2**32),
    period_s=st.sampled_from([0.001, 0.005, 0.1]),
)
def test_no_crosswise_pair_while_the_host_keeps_up(loss: float, swaps: float, seed: int, period_s: float) -> None:
    """Whatever is lost or changes places within its sample; lateness is below half a period."""
    chance = random.Random(seed)
    order = []
    for number in range(300):
        pair = [f"F{number}", f"S{number}"]
        order += pair[::-1] if chance.random() < swaps else pair
    sent = halves(" ".join(word for word in order if chance.random() >= loss), period_s)
    late_s = [chance.random() * 0.2 * period_s for _ in sent]
    link = Halves(period_s)
    got = heard(link, sent, late_s)
    assert all(first == second for _, first, second in got)
    numbers = [number for number, _, _ in got]
    assert numbers == sorted(set(numbers))
    assert len(got) > 290 or loss + swaps > 0


class Listening(RobotousCan):
    """A sensor whose bus hands over what `look` returns."""

    def __init__(self, look: Callable[[float], tuple[int, bytes] | None], clock: FakeClock) -> None:
        super().__init__("can0", clock=clock)
        self._bus = SimpleNamespace(look=look)  # type: ignore[assignment]

    def receive(self) -> list[Any]:
        return self._receive()

    @property
    def silence_fix(self) -> str:
        return self._stale(0.4).fix


@pytest.mark.parametrize(("slept_s", "fields"), [(0.0, 1), (0.02, 0)])
def test_a_silence_the_host_slept_through_is_none(slept_s: float, fields: int) -> None:
    """The second half that comes twice shows that the first may be foreign: unless it came after a silence."""
    clock = FakeClock()
    frames: list[tuple[int, bytes] | None] = [(1, data(1)), (2, data(1)), None, (2, data(1))]

    def look(wait_s: float) -> tuple[int, bytes] | None:
        frame = frames.pop(0) if frames else None
        if frame is None:
            clock.stall(wait_s + slept_s)
        return frame

    assert len(Listening(look, clock).receive()) == fields


def test_a_silence_while_halves_come_is_not_the_fault_of_cable_or_supply() -> None:
    clock = FakeClock()

    def look(_: float) -> tuple[int, bytes]:
        clock.stall(0.001)
        return 1, data(1)  # first halves only

    sensor = Listening(look, clock)
    assert "cable" in sensor.silence_fix
    assert sensor.receive() == []
    assert "to be paired" in sensor.silence_fix
    clock.stall(0.2)
    assert "cable" in sensor.silence_fix
