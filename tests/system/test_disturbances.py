"""Sessions on an emulated cell that something disturbs: it is named in words, and the result holds or is refused."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from ftcalib.routine import Sampling
from ftdrive.cell.emulated import Station
from ftdrive.errors import Declined
from ftdrive.runs.outcome import Outcome
from ftdrive.session.events import Event, GuardTripped, PoseTaken, State, StateChanged
from ftdrive.session.operator import Question
from ftdrive.session.options import SessionOptions
from ftdrive.session.session import calibrate
from ftdrive.terminal.report import errors_in_sigma, print_result
from tests.system.command_line import assert_found

pytestmark = pytest.mark.slow

Array = NDArray[np.float64]
Happening = Callable[[Event], None]

POSES = 12
PUSH = [1.5, 1.0, 0.0, 0.0, 0.0, 0.0]
"""N in base axes: far below what stops the arm."""
CONTACT = 14
NOTHING = [0.0] * 6


@dataclass
class Unattended:
    """Lets the session run, and makes things happen at its events."""

    happening: Happening
    shown: list[Event] = field(default_factory=list)
    has_keys: bool = False

    def show(self, event: Event) -> None:
        self.shown.append(event)
        self.happening(event)

    def ask(self, question: Question) -> str:
        raise Declined(question.text)

    def absence(self) -> None:
        return None

    def pressed(self) -> None:
        return None

    def taken(self) -> dict[int, PoseTaken]:
        return {event.stop: event for event in self.shown if isinstance(event, PoseTaken)}


Tour = Callable[..., tuple[Outcome, Unattended]]


@pytest.fixture
def station() -> Iterator[Station]:
    with Station("serial", ["--seed", "5"]) as station:
        yield station


@pytest.fixture
def tour(station: Station, tmp_path: Path) -> Tour:
    def run(happening: Happening, average_s: float = 0.2) -> tuple[Outcome, Unattended]:
        operator = Unattended(happening)
        cell = replace(station.cell, sampling=Sampling(average_s=average_s, noise_record_s=0.0))
        outcome = calibrate(cell, operator, SessionOptions(tmp_path, poses=POSES, real=False, questions=False))
        assert outcome is not None
        assert len(outcome.run.stops()) == POSES + 1
        assert CONTACT not in [event.hazard for event in operator.shown if isinstance(event, GuardTripped)]
        return outcome, operator

    return run


@pytest.fixture
def words_of(capsys: pytest.CaptureFixture[str]) -> Callable[[Outcome], str]:
    """What a person reads at the end."""

    def read(outcome: Outcome) -> str:
        print_result(outcome.result, drift=outcome.drift, records=outcome.run.records())
        return capsys.readouterr().out

    return read


def names(outcome: Outcome, *stops: int) -> list[str]:
    return [f"R{record.pose.number:02d}" for record in outcome.run.records() if record.stop in stops]


def assert_rejected(outcome: Outcome, *stops: int) -> None:
    """The solver rejects these poses; it may reject one more, because it rejects one good pose in 1000."""
    rejected = set(outcome.result.rejected_poses)
    assert rejected >= set(stops)
    assert len(rejected) <= len(stops) + 1


def begins(event: Event, state: State, stop: int) -> bool:
    return isinstance(event, StateChanged) and event.state is state and event.stop == stop


def test_pushes_and_a_tap_while_poses_are_averaged(
    station: Station,
    tour: Tour,
    words_of: Callable[[Outcome], str],
) -> None:
    pushed, tapped, last = 4, 7, POSES + 1
    taps = 0

    def happening(event: Event) -> None:
        nonlocal taps
        if begins(event, State.SETTLE, pushed) or begins(event, State.SETTLE, last):
            station.control(do="push", wrench=PUSH, axes="base")
        elif isinstance(event, PoseTaken) and event.stop == pushed:
            station.control(do="push", wrench=NOTHING)
        elif begins(event, State.SAMPLE, tapped) and not taps:
            taps += 1
            station.control(do="bump", wrench=PUSH, seconds=0.15)

    outcome, operator = tour(happening)
    assert operator.taken()[tapped].attempts == 2
    assert operator.taken()[tapped].steady
    text = words_of(outcome)
    first, bumped = names(outcome, 1, pushed)
    assert f"? {bumped} is off by 1.8 N and" in text
    assert_rejected(outcome, pushed)
    assert f"? {first} reads otherwise at the end" in text
    assert text.count(" ? ") <= 2 + len(outcome.result.rejected_poses[1:])
    assert_found(errors_in_sigma(outcome.result, station.truth))


def test_a_sensor_that_drifts_by_half_a_newton(
    station: Station,
    tour: Tour,
    words_of: Callable[[Outcome], str],
) -> None:
    slope_N_s, began_ns = 0.08, 0

    def happening(event: Event) -> None:
        nonlocal began_ns
        if begins(event, State.SETTLE, 1):
            station.control(do="drift", force_N=[0, 0, slope_N_s * 100], seconds=100)
            began_ns = station.clock.now_ns()

    outcome, _ = tour(happening, average_s=0.1)  # each average is steady
    records = outcome.run.records()[:POSES]
    offset_ns = records[0].clock_offset_ns
    drifted_N = slope_N_s * np.array([(r.t_mid_ns - offset_ns - began_ns) * 1e-9 for r in records])
    assert drifted_N[-1] > 0.3
    text = words_of(outcome)
    assert "N/min" in text
    assert "and the poses between drift alike" in text
    assert_rejected(outcome)
    assert text.count(" ? ") == 1 + len(outcome.result.rejected_poses)
    found = outcome.result.drift
    assert found is not None
    assert found.change[2] == pytest.approx(drifted_N[-1] - drifted_N[0], abs=6 * found.sigma[2])
    truth = dict(station.truth)  # the bias is the mean over the poses
    truth["force_bias_N"] = np.add(truth["force_bias_N"], [0, 0, drifted_N.mean()])
    assert_found(errors_in_sigma(outcome.result, truth))
