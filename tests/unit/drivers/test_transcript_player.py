"""A recorded wire that is played in memory: what is sent when, which requests may be left out, and what diverges."""

import math
import sys
import threading
from dataclasses import dataclass, field, replace

import pytest
import serial

from ftdrivers.transcript import Passage, Player, Transcript
from ftdrivers.wires.serial_port import ask_for_marks
from tests.fake_clock import FakeClock

OPENED_NS = 7_000_000_000


def recorded(*passages: tuple[float, bool, bytes]) -> Transcript:
    """Make a transcript of passages: seconds since the port was opened, whether the driver sent it, and the bytes."""
    made = tuple(Passage(OPENED_NS + round(1e9 * t_s), sent, data) for t_s, sent, data in passages)
    return Transcript({"url": "x:///y", "duration_s": 1.0}, OPENED_NS, made, {})


@dataclass
class Far:
    """The driver's side, which accepts what is sent until it is full."""

    sent: list[bytes] = field(default_factory=list)
    is_full: bool = False

    def send(self, data: bytes) -> None:
        self.sent.append(data)


class Played(Player):
    """A player whose thread takes its turns in the test."""

    def __init__(self, transcript: Transcript) -> None:
        self.clock, self.far = FakeClock(), Far()
        super().__init__(transcript, self.clock)
        self._far = self.far  # type: ignore[assignment]
        self._t = self.clock.now_s()  # the driver has opened the port

    def ask(self, data: bytes) -> None:
        self._asked += data
        self._listen()

    def play(self) -> float:
        return self._play()

    def answers(self, after_s: float = 0.0) -> bytes:
        """Let the time pass and return what was sent meanwhile."""
        self.far.sent.clear()
        end_s = self.clock.now_s() + after_s
        while (wait_s := self.play()) < math.inf and self.clock.now_s() + wait_s <= end_s + 1e-9:
            assert wait_s > 0
            self.clock.advance(wait_s)
        self.clock.advance(end_s - self.clock.now_s())
        return b"".join(self.far.sent)


DIALOGUE = recorded(
    (0.30, True, b"ab"), (0.35, False, b"1"), (0.55, False, b"2"), (0.60, True, b"cd"), (0.61, False, b"3")
)


def test_a_request_is_answered_after_the_recorded_time() -> None:
    wire = Played(DIALOGUE)
    assert wire.answers(9.0) == b""  # nothing before the first request
    wire.ask(b"a")
    assert wire.answers(1.0) == b""  # it is not whole
    wire.ask(b"b")
    assert wire.answers(0.049) == b""
    assert wire.answers(0.002) == b"1"
    assert wire.answers(0.198) == b""
    assert wire.answers(0.002) == b"2"
    assert wire.answers(5.0) == b""
    wire.ask(b"cd")
    assert wire.answers(0.009) == b""
    assert wire.answers(0.002) == b"3"
    assert wire.play() == math.inf
    assert wire.divergence is None


@pytest.mark.parametrize(("early_s", "is_sent"), [(0.04, True), (0.06, False)])
def test_what_the_device_sends_before_a_request_that_comes_early(early_s: float, is_sent: bool) -> None:
    wire = Played(DIALOGUE)
    wire.ask(b"ab")
    assert wire.answers(0.25 - early_s) == b"1"
    wire.far.sent.clear()
    wire.ask(b"cd")
    assert wire.far.sent == ([b"2"] if is_sent else [])
    assert wire.answers(0.02) == b"3"


def test_a_request_without_an_answer_may_be_left_out() -> None:
    wire = Played(recorded((0.0, True, b"ab"), (0.0, True, b"cd"), (0.01, False, b"3"), (0.02, True, b"ef")))
    wire.ask(b"cd")
    assert wire.answers(0.02) == b"3"


def test_a_request_that_was_not_recorded_ends_in_silence_with_a_reason() -> None:
    wire = Played(DIALOGUE)
    wire.ask(b"ab")
    wire.ask(b"ax")
    assert wire.divergence == "the driver sent 61 78, the recording has 63 64"
    assert wire.answers(1.0) == b""
    wire.ask(b"cd")
    assert wire.answers(1.0) == b""


def test_a_driver_is_answered_on_a_pseudo_terminal_until_it_closes_it() -> None:
    player = Player(recorded((0.0, True, b"ab"), (0.0, False, b"1"), (0.0, True, b"cd"), (0.01, False, b"2")))
    with player as path:
        (thread,) = (thread for thread in threading.enumerate() if thread.name == f"player on {path}")
        with serial.Serial(path, timeout=5.0) as port:
            port.write(b"a")
            port.write(b"b")
            assert port.read(1) == b"1"
            port.write(b"cd")
            assert port.read(1) == b"2"
        thread.join(5.0)
        assert not thread.is_alive()


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere no marks are asked for")
def test_marks_are_not_played_before_the_driver_is_ready_for_them() -> None:
    marked = recorded((0.00, True, b"?"), (0.01, False, b"\xff\x00b"))
    player = Player(replace(marked, passages=marked.passages[1:], parity_marks=True))
    with player as path, serial.Serial(path, timeout=0.1) as port:
        assert port.read(1) == b""  # it has not asked for marks
        ask_for_marks(port)
        assert port.read(3) == b"\xff\x00b"


def test_frames_are_played_by_an_adapter_whose_commands_are_left_out() -> None:
    more = b"T000001230\rr02A3\rR000000010\r"
    frames = recorded(
        *((0.0, True, b"t2050\r"), (0.0, False, b"t20520102\r"), (0.0, True, more), (0.0, False, b"t20520304\r"))
    )
    with Player(replace(frames, frames=True)) as path, serial.Serial(path, timeout=5.0) as port:
        port.write(b"C\rS5\rO\rt2050\rT0000012")
        assert port.read(10) == b"t20520102\r"
        port.write(b"30\rr02A3\rR000000010\rV\r")
        assert port.read(10) == b"t20520304\r"


def test_what_the_driver_does_not_accept_yet_is_sent_later_and_in_order() -> None:
    data = bytes(range(256)) * 1000
    with (
        Player(recorded((0.0, True, b"ab"), (0.0, False, data), (0.0, False, b"end"))) as path,
        serial.Serial(path, timeout=5.0) as port,
    ):
        port.write(b"ab")
        assert port.read(len(data) + 3) == data + b"end"


def test_two_requests_may_arrive_at_once() -> None:
    wire = Played(recorded((0.0, True, b"ab"), (0.0, True, b"cd"), (0.01, False, b"3")))
    wire.ask(b"abcd")
    assert wire.answers(0.02) == b"3"
    wire.ask(b"xy")  # the driver says goodbye, or the recording was broken off
    assert wire.divergence is None


def test_a_player_that_is_never_opened_ends() -> None:
    before = threading.active_count()
    with Player(DIALOGUE):
        pass
    assert threading.active_count() == before


def test_how_much_is_left() -> None:
    wire = Played(DIALOGUE)
    assert wire.left_s == pytest.approx(0.31)
    wire.ask(b"ab")
    assert wire.left_s == pytest.approx(0.26)
    wire.answers(0.1)
    assert wire.left_s == pytest.approx(0.06)
    wire.ask(b"cd")
    wire.answers(0.1)
    assert wire.left_s == 0
